//! Forward kinematics: poses of links and cells for given joint angles (Dang & Allen, Eq. 1).

use nalgebra::{Isometry3, Point3, UnitVector3};

use super::{Coupling, Hand, Joint, Motion};

/// Why joint angles are refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum JointError {
    #[error("{found} joint angles, the hand has {expected}")]
    Count { expected: usize, found: usize },
    #[error("joint '{joint}' is {value}, expected a number")]
    NotFinite { joint: String, value: f64 },
    #[error("the hand has no joint '{name}' (it has {known})")]
    Unknown { name: String, known: String },
    #[error("joint '{joint}' is given twice")]
    Twice { joint: String },
    /// The hint is empty, or says which value was probably meant.
    #[error("joint '{joint}' is {value} {unit}, expected {lower:.4} to {upper:.4}{hint}")]
    OutOfRange { joint: String, value: f64, unit: &'static str, lower: f64, upper: f64, hint: String },
}

/// A cell's position and normal in the palm frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellPose {
    /// Centre, metres.
    pub position_in_palm_m: Point3<f64>,
    /// Outward normal.
    pub normal_in_palm: UnitVector3<f64>,
}

impl Hand {
    /// `palm_from_link` of every link for `joints` (in the order of [`Hand::joints`]).
    ///
    /// # Errors
    /// Not one finite angle per joint.
    pub fn palm_from_links(&self, joints: &[f64]) -> Result<Vec<Isometry3<f64>>, JointError> {
        let mut palm_from_links = Vec::with_capacity(self.links.len());
        self.write_palm_from_links(joints, &mut palm_from_links)?;
        Ok(palm_from_links)
    }

    /// As [`Hand::palm_from_links`], in memory that is there already. After an error it holds nothing.
    pub(crate) fn write_palm_from_links(
        &self,
        joints: &[f64],
        palm_from_links: &mut Vec<Isometry3<f64>>,
    ) -> Result<(), JointError> {
        palm_from_links.clear();
        self.check_joints(joints)?;
        let root_from_links = palm_from_links;
        for link in &self.links {
            let parent_from_link = match link.motion {
                Motion::Fixed => link.parent_from_joint,
                _ => link.parent_from_joint * link.motion.joint_from_link(joints),
            };
            let root_from_parent = link.parent_idx.map_or_else(Isometry3::identity, |idx| root_from_links[idx]);
            root_from_links.push(root_from_parent * parent_from_link);
        }
        let palm_from_root = root_from_links[self.reference_link_idx].inverse();
        root_from_links.iter_mut().for_each(|from_link| *from_link = palm_from_root * *from_link);
        Ok(())
    }

    /// Every cell's centre and normal in the palm frame, in the order of [`Hand::cells`]
    /// (Eq. 1: `palm_from_cell = palm_from_link(joints) * link_from_cell`).
    ///
    /// # Errors
    /// As [`Hand::palm_from_links`].
    pub fn cells_in_palm(&self, joints: &[f64]) -> Result<Vec<CellPose>, JointError> {
        let palm_from_links = self.palm_from_links(joints)?;
        Ok(self
            .cells()
            .map(|(pad_idx, cell)| {
                let palm_from_link = &palm_from_links[self.pads[pad_idx].link_idx];
                CellPose {
                    position_in_palm_m: palm_from_link * cell.position_in_link_m,
                    normal_in_palm: palm_from_link.rotation * cell.normal_in_link,
                }
            })
            .collect())
    }

    /// Joint values from pairs of name and value. Joints that are not given are open or follow their coupling, within
    /// their limits.
    ///
    /// # Errors
    /// An unknown joint, one given twice, a value that is not finite or outside the joint's range.
    pub fn posture<'a>(&self, given: impl IntoIterator<Item = (&'a str, f64)>) -> Result<Vec<f64>, JointError> {
        let mut values: Vec<Option<f64>> = vec![None; self.joints.len()];
        for (name, value) in given {
            let joint_idx = self.joint_idx(name).ok_or_else(|| JointError::Unknown {
                name: name.into(),
                known: self.joints.iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().join(", "),
            })?;
            let joint = &self.joints[joint_idx];
            if !value.is_finite() {
                return Err(JointError::NotFinite { joint: name.into(), value });
            }
            if !joint.allows(value, 1e-6) {
                let (unit, lower, upper) = (joint.kind.unit(), joint.lower, joint.upper);
                let hint = joint.degrees_hint(value).map(|hint| format!("; {hint}")).unwrap_or_default();
                return Err(JointError::OutOfRange { joint: name.into(), value, unit, lower, upper, hint });
            }
            if values[joint_idx].replace(value).is_some() {
                return Err(JointError::Twice { joint: name.into() });
            }
        }
        let leaders: Vec<f64> =
            values.iter().zip(&self.joints).map(|(value, joint)| value.unwrap_or(joint.open())).collect();
        let follow = |joint: &Joint, coupling: Coupling| {
            let leader = &self.joints[coupling.follows_idx];
            let value = joint.open() + coupling.ratio * (leaders[coupling.follows_idx] - leader.open());
            value.clamp(joint.lower, joint.upper)
        };
        Ok((0..self.joints.len())
            .map(|idx| match (values[idx], self.joints[idx].coupling) {
                (Some(value), _) => value,
                (None, Some(coupling)) => follow(&self.joints[idx], coupling),
                (None, None) => leaders[idx],
            })
            .collect())
    }

    fn check_joints(&self, joints: &[f64]) -> Result<(), JointError> {
        if joints.len() != self.joints.len() {
            return Err(JointError::Count { expected: self.joints.len(), found: joints.len() });
        }
        match joints.iter().zip(&self.joints).find(|(value, _)| !value.is_finite()) {
            Some((value, joint)) => Err(JointError::NotFinite { joint: joint.name.clone(), value: *value }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn barrett() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    #[test]
    fn open_hand_by_hand() {
        // All joints at 0: finger 3 stands at (-0.0008, 0.05, 0.0754) of the base, its links along +y with their own y
        // up; the distal link is turned up by 0.698132.
        let hand = barrett();
        let cells = hand.cells_in_palm(&[0.0; 7]).expect("7 joints");
        let (sin, cos) = libm::sincos(0.698132);
        let (x, y, z) = (0.02225, 0.0095, 0.0052);
        let along = 0.0699357 + cos * x - sin * y;
        let up = 0.003 + sin * x + cos * y;
        let expected = Point3::new(-0.0008 + 0.0002 + z, 0.05 + along, 0.0754 + up - 0.0775);
        assert!((cells[72].position_in_palm_m - expected).norm() < 1e-9, "{} {expected}", cells[72].position_in_palm_m);
    }

    #[test]
    fn fingers_1_and_2_mirror_each_other() {
        let hand = barrett();
        let cells = hand.cells_in_palm(&[0.7, 1.1, 1.1, 0.3, 0.2, 0.2, 0.1]).expect("7 joints");
        for row in 0..8 {
            for column in 0..3 {
                let one = cells[24 + row * 3 + column].position_in_palm_m;
                let two = cells[48 + row * 3 + (2 - column)].position_in_palm_m;
                // The proximal joint's 0.8 mm along y and the distal joint's 0.2 mm along z are the same for both, not
                // mirrored, so the mirror holds to 2 * (0.8 - 0.2) mm.
                let off = libm::hypot(one.x + two.x, one.y - two.y);
                assert!((off - 1.2e-3).abs() < 1e-9 && (one.z - two.z).abs() < 1e-9, "{one} {two}");
            }
        }
    }

    #[test]
    fn posture_follows_the_coupling_unless_told() {
        let hand = barrett();
        let posture = hand.posture([("finger_1", 1.4), ("finger_2", 0.7), ("distal_2", 0.5)]).expect("in range");
        assert!((posture[4] - 1.4 * 45.0 / 140.0).abs() < 1e-12);
        assert_eq!(posture[5], 0.5);
        assert!(matches!(hand.posture([("thumb", 0.0)]), Err(JointError::Unknown { .. })));
        assert!(matches!(hand.posture([("spread", 4.0)]), Err(JointError::OutOfRange { .. })));
        let error = hand.posture([("spread", 45.0)]).expect_err("degrees").to_string();
        assert!(error.ends_with("expected 0.0000 to 3.1416; 45 degrees are 0.7854 rad"), "{error}");
        assert!(matches!(hand.posture([("spread", f64::NAN)]), Err(JointError::NotFinite { .. })));
    }

    #[test]
    fn wrong_joints_are_refused() {
        let hand = barrett();
        assert_eq!(hand.palm_from_links(&[0.0; 6]).err(), Some(JointError::Count { expected: 7, found: 6 }));
        let mut joints = [0.0; 7];
        joints[3] = f64::INFINITY;
        assert!(matches!(hand.cells_in_palm(&joints), Err(JointError::NotFinite { .. })));
    }
}
