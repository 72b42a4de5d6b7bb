//! The frames of a robot as ROS tells them in `/tf` and `/tf_static`: which way each is turned in its parent.

use std::collections::BTreeMap;

use blindgrasp_ros::cdr::Value;
use nalgebra::{Quaternion, UnitQuaternion};

/// Of further frames nothing is kept: no robot has so many.
const MAX_FRAMES: usize = 4096;
const MAX_NAME_BYTES: usize = 255;
/// A frame that two nodes have sent within this time is not known.
const CONTESTED_NANOS: u64 = 2_000_000_000;
/// A transform that is older than the last one is passed over, unless it is so much older: a clock was set back.
const SET_BACK_NANOS: u64 = 10_000_000_000;

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
    sender: [u8; 16],
    came_nanos: u64,
    /// The time at which another node sent this frame as well.
    contested_nanos: Option<u64>,
}

impl Transforms {
    /// Takes a `tf2_msgs/msg/TFMessage` that came at a time. As `tf2`, it passes over a transform whose rotation is no unit
    /// quaternion; the frame is not known until the next one.
    pub(super) fn take(&mut self, message: &Value, is_static: bool, sender: [u8; 16], at_nanos: u64) {
        let Some(Value::List(transforms)) = message.at("transforms") else { return };
        for transform in &transforms {
            let [parent, frame] = ["header.frame_id", "child_frame_id"].map(|path| {
                let found = transform.at(path);
                found.as_ref().and_then(Value::text).unwrap_or_default().trim_start_matches('/').to_owned()
            });
            if parent.len().max(frame.len()) > MAX_NAME_BYTES {
                continue;
            }
            let rotation = transform.at("transform.rotation").and_then(|it| it.numbers()).unwrap_or_default();
            let rotation = match rotation.as_slice() {
                &[x, y, z, w] => Quaternion::new(w, x, y, z),
                _ => Quaternion::default(),
            };
            // The bound of tf2. It has no room for NaN and infinity.
            if (rotation.norm_squared() - 1.0).abs() >= 0.01 || !rotation.norm_squared().is_finite() {
                self.by_frame.remove(&frame);
                continue;
            }
            let stamp_nanos = if is_static { None } else { Some(transform.stamp_nanos().unwrap_or(0)) };
            let before = self.by_frame.get(&frame);
            if before.is_none() && self.by_frame.len() >= MAX_FRAMES {
                continue;
            }
            let is_older = before.and_then(|before| Some(before.stamp_nanos?.saturating_sub(stamp_nanos?)));
            if is_older.is_some_and(|nanos| nanos > 0 && nanos < SET_BACK_NANOS) {
                continue;
            }
            let contested_nanos = match before {
                Some(before) if before.sender != sender && at_nanos < before.came_nanos + CONTESTED_NANOS => {
                    Some(at_nanos)
                }
                Some(before) => before.contested_nanos,
                None => None,
            };
            let parent_from_frame = UnitQuaternion::new_normalize(rotation);
            let transform =
                Transform { parent, parent_from_frame, stamp_nanos, sender, came_nanos: at_nanos, contested_nanos };
            self.by_frame.insert(frame, transform);
        }
    }

    /// The rotation that takes vectors of the frame `from` to the frame `to`, one of its descendants, as the frames were at
    /// `stamp_nanos`; `None` if it is not known now, at `at_nanos`. A transform that is farther than `tolerance_nanos` from that
    /// time is not used.
    pub(super) fn rotation(
        &self,
        to: &str,
        from: &str,
        stamp_nanos: u64,
        tolerance_nanos: u64,
        at_nanos: u64,
    ) -> Option<UnitQuaternion<f64>> {
        let mut frame = to;
        let mut above_from_to = UnitQuaternion::identity();
        // A circle has no end.
        for _ in 0..MAX_FRAMES {
            if frame == from {
                return Some(above_from_to.inverse());
            }
            let transform = self.by_frame.get(frame)?;
            let is_old = transform.stamp_nanos.is_some_and(|stamp| stamp.abs_diff(stamp_nanos) > tolerance_nanos);
            if is_old || transform.contested_nanos.is_some_and(|since| at_nanos < since + CONTESTED_NANOS) {
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

    const SEC_NANOS: u64 = 1_000_000_000;
    const NODE: [u8; 16] = [1; 16];
    const UNTURNED: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

    fn message(parent: &str, frame: &str, rotation: [f64; 4], secs: i128) -> Value {
        let text = |text: &str| Value::Text(text.into());
        let field = |name: &str, value: Value| (name.to_owned(), value);
        let stamp = Value::Message(vec![field("sec", Value::Integer(secs)), field("nanosec", Value::Integer(0))]);
        let header = Value::Message(vec![field("stamp", stamp), field("frame_id", text(parent))]);
        let transform = Value::Message(vec![field("rotation", Value::Numbers(rotation.into()))]);
        let stamped =
            vec![field("header", header), field("child_frame_id", text(frame)), field("transform", transform)];
        Value::Message(vec![field("transforms", Value::List(vec![Value::Message(stamped)]))])
    }

    #[test]
    fn frames_in_a_circle_or_without_a_rotation_are_not_joined() {
        let mut transforms = Transforms::default();
        for (parent, frame) in [("/b", "a"), ("a", "b"), ("world", "c")] {
            transforms.take(&message(parent, frame, UNTURNED, 0), true, NODE, 0);
        }
        assert_eq!(transforms.rotation("c", "world", 0, 0, 0), Some(UnitQuaternion::identity()));
        assert_eq!(transforms.rotation("a", "world", 0, 0, 0), None);
        assert_eq!(transforms.rotation("world", "c", 0, 0, 0), None);
        let no_rotations = [
            [0.0; 4],
            [f64::NAN, 0.0, 0.0, 1.0],
            [f64::INFINITY, 0.0, 0.0, 1.0],
            [1e200, 0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0, 0.0],
        ];
        for bad in no_rotations {
            transforms.take(&message("world", "c", UNTURNED, 0), true, NODE, 0);
            transforms.take(&message("world", "c", bad, 0), true, NODE, 0);
            assert_eq!(transforms.rotation("c", "world", 0, 0, 0), None, "{bad:?}");
        }
    }

    #[test]
    fn a_frame_of_two_nodes_is_not_known_and_an_older_transform_is_passed_over() {
        let mut transforms = Transforms::default();
        let mut known = |secs: i128, sender: [u8; 16], at: u64| {
            transforms.take(&message("world", "palm", UNTURNED, secs), false, sender, at * SEC_NANOS);
            transforms.rotation("palm", "world", secs as u64 * SEC_NANOS, 0, at * SEC_NANOS).is_some()
        };
        assert!(known(100, NODE, 100));
        assert!(!known(101, [2; 16], 101));
        assert!(!known(102, NODE, 102));
        // One of them has stopped.
        assert!(known(105, NODE, 105));
        // It was on its way for long; a clock that was set back is followed.
        assert!(!known(104, NODE, 106));
        assert!(known(50, NODE, 107));
    }

    #[test]
    fn frames_without_end_take_no_memory_without_end() {
        let mut transforms = Transforms::default();
        for idx in 0..MAX_FRAMES + 10 {
            transforms.take(&message("world", &format!("thing_{idx}"), UNTURNED, 0), true, NODE, 0);
        }
        transforms.take(&message("world", &"x".repeat(MAX_NAME_BYTES + 1), UNTURNED, 0), true, NODE, 0);
        assert_eq!(transforms.by_frame.len(), MAX_FRAMES);
    }
}
