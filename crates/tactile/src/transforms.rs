//! The frames of a robot as ROS tells them in `/tf` and `/tf_static`: which way each is turned in its parent.

use std::collections::BTreeMap;

use blindgrasp_ros::cdr::Value;
use nalgebra::{Quaternion, UnitQuaternion};

/// No robot has more frames.
const MAX_FRAMES: usize = 4096;

/// The last transform of each frame.
#[derive(Debug, Default)]
pub(super) struct Transforms {
    by_frame: BTreeMap<String, Transform>,
}

#[derive(Debug)]
struct Transform {
    parent: String,
    parent_from_frame: UnitQuaternion<f64>,
    /// `None` for a static one.
    stamp_nanos: Option<u64>,
}

impl Transforms {
    /// Takes a `tf2_msgs/msg/TFMessage`.
    ///
    /// # Errors
    /// Why a transform cannot be used, for a person. Those before it are taken.
    pub(super) fn take(&mut self, message: &Value, is_static: bool) -> Result<(), String> {
        let Some(Value::List(transforms)) = message.at("transforms") else {
            return Err("it has no transforms".into());
        };
        for transform in &transforms {
            let name = |path: &str| {
                let found = transform.at(path);
                found.as_ref().and_then(Value::text).unwrap_or_default().trim_start_matches('/').to_owned()
            };
            let (parent, frame) = (name("header.frame_id"), name("child_frame_id"));
            let rotation = transform.at("transform.rotation").and_then(|it| it.numbers()).unwrap_or_default();
            let &[x, y, z, w] = rotation.as_slice() else {
                return Err(format!("frame '{frame}' has no rotation"));
            };
            let parent_from_frame = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-3)
                .filter(|rotation| rotation.coords.iter().all(|part| part.is_finite()))
                .ok_or_else(|| format!("the rotation of frame '{frame}' is {rotation:?}"))?;
            if !self.by_frame.contains_key(&frame) && self.by_frame.len() >= MAX_FRAMES {
                return Err(format!("more than {MAX_FRAMES} frames"));
            }
            let stamp_nanos = if is_static { None } else { Some(transform.stamp_nanos().unwrap_or(0)) };
            self.by_frame.insert(frame, Transform { parent, parent_from_frame, stamp_nanos });
        }
        Ok(())
    }

    /// The rotation that takes vectors of the frame `from` to the frame `to`, one of its descendants; `None` if it is not known
    /// at this time. A transform that is farther than `tolerance_nanos` from it is not used.
    pub(super) fn rotation(
        &self,
        to: &str,
        from: &str,
        at_nanos: u64,
        tolerance_nanos: u64,
    ) -> Option<UnitQuaternion<f64>> {
        let mut frame = to;
        let mut above_from_to = UnitQuaternion::identity();
        // A circle has no end.
        for _ in 0..MAX_FRAMES {
            if frame == from {
                return Some(above_from_to.inverse());
            }
            let transform = self.by_frame.get(frame)?;
            if transform.stamp_nanos.is_some_and(|stamp| stamp.abs_diff(at_nanos) > tolerance_nanos) {
                return None;
            }
            above_from_to = transform.parent_from_frame * above_from_to;
            frame = &transform.parent;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(parent: &str, frame: &str, rotation: [f64; 4]) -> Value {
        let text = |text: &str| Value::Text(text.into());
        let field = |name: &str, value: Value| (name.to_owned(), value);
        let header = Value::Message(vec![field("frame_id", text(parent))]);
        let transform = Value::Message(vec![field("rotation", Value::Numbers(rotation.into()))]);
        let stamped =
            vec![field("header", header), field("child_frame_id", text(frame)), field("transform", transform)];
        Value::Message(vec![field("transforms", Value::List(vec![Value::Message(stamped)]))])
    }

    #[test]
    fn frames_in_a_circle_or_without_a_way_up_are_not_joined() {
        let mut transforms = Transforms::default();
        for (parent, frame) in [("/b", "a"), ("a", "b"), ("world", "c")] {
            transforms.take(&message(parent, frame, [0.0, 0.0, 0.0, 1.0]), true).expect("taken");
        }
        assert_eq!(transforms.rotation("c", "world", 0, 0), Some(UnitQuaternion::identity()));
        assert_eq!(transforms.rotation("a", "world", 0, 0), None);
        assert_eq!(transforms.rotation("world", "c", 0, 0), None);
        for bad in [[0.0; 4], [f64::NAN, 0.0, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0, 1.0]] {
            let refused = transforms.take(&message("world", "c", bad), true).expect_err("no rotation");
            assert!(refused.contains("the rotation of frame 'c'"), "{refused}");
        }
    }
}
