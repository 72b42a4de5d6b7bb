//! The experience file: lifted grasps and their outcomes.

use std::io::Read;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use crate::encoder::Scaling;
use crate::model::{Model, ModelHand};
use blindgrasp_messages::files::partial_path;
use blindgrasp_messages::{MAX_FEATURES, MAX_JOINTS};

/// The format that this program writes and reads.
pub const FORMAT: &str = "blindgrasp-experience/1";

/// Steps of a feature's value per standard deviation: far finer than the difference of similar grasps.
const STEPS_PER_DEVIATION: f64 = 16.0;
/// Greatest size of a file: about a million grasps.
const MAX_BYTES: u64 = 256 << 20;
/// Poses are kept to a tenth of a millimetre, joints and quaternions to about as much of a radian.
const DECIMALS: f64 = 1e4;

/// Lifted grasps with the features of one model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experience {
    pub format: String,
    pub hand: ModelHand,
    /// Identity of the features, [`Model::dictionary_id`].
    #[serde(with = "blindgrasp_messages::hex_id")]
    pub dictionary_id: u64,
    /// Mean and spread of each value of the features over the grasps.
    pub scaling: Scaling,
    /// The preshape joints. Grasps with different preshapes are different grasps.
    pub preshape_idxs: Vec<usize>,
    pub objects: Vec<String>,
    pub grasps: Vec<LiftedGrasp>,
}

/// A grasp that was lifted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LiftedGrasp {
    /// Index into the experience's objects.
    pub object_idx: usize,
    /// Whether the object stayed in the hand.
    pub held: bool,
    /// The object's pose when the grasp had settled: its centre of mass, metres, and its orientation.
    #[serde(with = "pose")]
    pub palm_from_object: Isometry3<f64>,
    /// The joint angles at the beginning of the grasp, radians.
    #[serde(serialize_with = "rounded")]
    pub open_joints_rad: Vec<f64>,
    /// The settled frame's feature in steps of a sixteenth of each value's standard deviation from its mean.
    #[serde(with = "base64_codes")]
    pub feature: Vec<i8>,
}

/// Why an experience could not be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum ExperienceError {
    /// The file could not be read or written.
    #[error("experience {}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// The file is invalid or does not fit.
    #[error("experience {}: {message}", path.display())]
    Invalid {
        path: PathBuf,
        /// The problem, what was expected, what to do.
        message: String,
    },
}

impl Experience {
    /// Reads and checks an experience.
    ///
    /// # Errors
    /// A file that cannot be read, is no experience, or has another format version or inconsistent contents.
    pub fn load(path: &Path) -> Result<Experience, ExperienceError> {
        let mut text = String::new();
        std::fs::File::open(path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_string(&mut text))
            .map_err(|source| ExperienceError::Io { path: path.into(), source })?;
        let invalid = |message| ExperienceError::Invalid { path: path.into(), message };
        if text.len() as u64 > MAX_BYTES {
            let most = MAX_BYTES >> 20;
            return Err(invalid(format!("more than {most} MiB: expected a file of blindgrasp train --experience")));
        }
        Experience::parse(&text).map_err(invalid)
    }

    /// Reads and checks an experience's text.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Experience, String> {
        #[derive(Deserialize)]
        struct AnyExperience {
            format: String,
        }
        let any: AnyExperience =
            serde_json::from_str(text).map_err(|error| format!("not an experience, or cut off: {error}"))?;
        if any.format != FORMAT {
            return Err(format!(
                "format '{}', expected '{FORMAT}': make it again with this version (blindgrasp train --experience)",
                any.format
            ));
        }
        let experience: Experience =
            serde_json::from_str(text).map_err(|error| format!("not a valid experience: {error}"))?;
        experience.validate()?;
        Ok(experience)
    }

    /// Writes the file, completely or not at all.
    ///
    /// # Errors
    /// It is inconsistent, or the file could not be written.
    pub fn save(&self, path: &Path) -> Result<(), ExperienceError> {
        let io = |source| ExperienceError::Io { path: path.into(), source };
        self.validate().map_err(|message| ExperienceError::Invalid { path: path.into(), message })?;
        // One grasp per line, so that files are compared easily.
        let text = serde_json::to_string(self).map_err(|error| io(error.into()))?;
        let text = text.replace("{\"object_idx\"", "\n{\"object_idx\"") + "\n";
        let partial = partial_path(path);
        std::fs::write(&partial, text).and_then(|()| std::fs::rename(&partial, path)).map_err(|error| {
            let _ = std::fs::remove_file(&partial);
            io(error)
        })
    }

    /// Checks that the features are those of a model.
    ///
    /// # Errors
    /// The features are another model's.
    pub fn check_model(&self, path: &Path, model: &Model) -> Result<(), ExperienceError> {
        let (found, expected) = (self.dictionary_id, model.dictionary_id());
        if found == expected && self.hand.id == model.hand.id {
            return Ok(());
        }
        Err(ExperienceError::Invalid {
            path: path.into(),
            message: format!(
                "it is of the hand '{}' with the features {found:016x}, the model of '{}' with {expected:016x}: make it \
                 again for this model (blindgrasp train LIFTS.mcap --experience MODEL --out EXPERIENCE.json)",
                self.hand.name, model.hand.name
            ),
        })
    }

    /// A feature in the steps of [`LiftedGrasp::feature`].
    pub fn code(&self, values: &[f64]) -> Vec<i8> {
        let Scaling { mean, per_deviation } = &self.scaling;
        let code = |((value, mean), per_deviation): ((&f64, &f64), &f64)| {
            // It saturates: a value so far out is unlike every other one.
            ((value - mean) * per_deviation * STEPS_PER_DEVIATION).round() as i8
        };
        values.iter().zip(mean).zip(per_deviation).map(code).collect()
    }

    /// Squared Euclidean distance of two features, in units of each value's standard deviation.
    pub fn distance_squared(one: &[i8], other: &[i8]) -> f64 {
        let sum: i32 = one.iter().zip(other).map(|(one, other)| (i32::from(*one) - i32::from(*other)).pow(2)).sum();
        f64::from(sum) / (STEPS_PER_DEVIATION * STEPS_PER_DEVIATION)
    }

    /// Share of the grasps that held.
    pub fn share_held(&self) -> f64 {
        self.grasps.iter().filter(|grasp| grasp.held).count() as f64 / self.grasps.len().max(1) as f64
    }

    /// The angles of the preshape joints.
    pub fn preshape_rad(&self, joints_rad: &[f64]) -> impl Iterator<Item = f64> {
        self.preshape_idxs.iter().map(|idx| joints_rad.get(*idx).copied().unwrap_or_default())
    }

    fn validate(&self) -> Result<(), String> {
        let n_values = self.scaling.mean.len();
        if n_values == 0 || n_values > MAX_FEATURES || self.scaling.per_deviation.len() != n_values {
            return Err(format!(
                "a scaling of {n_values} values, expected as many means as deviations, 1 to {MAX_FEATURES}"
            ));
        }
        if !self.scaling.mean.iter().chain(&self.scaling.per_deviation).all(|number| number.is_finite()) {
            return Err("its scaling is not finite".into());
        }
        let Some(first) = self.grasps.first() else {
            return Err("there is no grasp in it".into());
        };
        let n_joints = first.open_joints_rad.len();
        if n_joints > MAX_JOINTS || self.preshape_idxs.iter().any(|idx| *idx >= n_joints) {
            return Err(format!("{n_joints} joints, expected all preshape joints among them and at most {MAX_JOINTS}"));
        }
        for (grasp_idx, grasp) in self.grasps.iter().enumerate() {
            let wrong = |what: String| Err(format!("grasp {grasp_idx} {what}"));
            if grasp.object_idx >= self.objects.len() {
                return wrong(format!("is of object {}, there are {}", grasp.object_idx, self.objects.len()));
            }
            if grasp.feature.len() != n_values {
                return wrong(format!("has a feature of {} values, expected {n_values}", grasp.feature.len()));
            }
            if grasp.open_joints_rad.len() != n_joints || !grasp.open_joints_rad.iter().all(|angle| angle.is_finite()) {
                return wrong(format!("does not begin with {n_joints} finite joint angles"));
            }
        }
        Ok(())
    }
}

/// Without the sign of a zero.
fn round(number: f64) -> f64 {
    (number * DECIMALS).round() / DECIMALS + 0.0
}

fn rounded<S: serde::Serializer>(numbers: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(numbers.iter().map(|number| round(*number)))
}

/// A pose as seven numbers: x, y, z, metres, and a unit quaternion x, y, z, w.
mod pose {
    use super::*;
    use serde::de::Error as _;
    use serde::{Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(pose: &Isometry3<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        let numbers: Vec<f64> = pose.translation.vector.iter().chain(pose.rotation.coords.iter()).copied().collect();
        serializer.collect_seq(numbers.into_iter().map(round))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Isometry3<f64>, D::Error> {
        let [x, y, z, qx, qy, qz, qw] = <[f64; 7]>::deserialize(deserializer)?;
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if !([x, y, z].iter().all(|number| number.is_finite()) && (quaternion.norm() - 1.0).abs() < 1e-2) {
            return Err(D::Error::custom("a pose that is none: expected a position and a unit quaternion"));
        }
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
    }
}

/// One byte per value in base64, which takes a third of the size of numbers.
mod base64_codes {
    use super::*;
    use serde::de::Error as _;
    use serde::{Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(codes: &[i8], serializer: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<u8> = codes.iter().map(|code| code.cast_unsigned()).collect();
        serializer.serialize_str(&STANDARD.encode(bytes))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<i8>, D::Error> {
        let bytes = STANDARD.decode(String::deserialize(deserializer)?).map_err(D::Error::custom)?;
        Ok(bytes.into_iter().map(u8::cast_signed).collect())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A hand of two joints, the first a preshape joint; features of two values.
    pub(in super::super) fn experience(grasps: Vec<LiftedGrasp>) -> Experience {
        Experience {
            format: FORMAT.into(),
            hand: ModelHand { name: "h".into(), id: 7 },
            dictionary_id: 0xabc,
            scaling: Scaling { mean: vec![1.0, 0.0], per_deviation: vec![2.0, 1.0] },
            preshape_idxs: vec![0],
            objects: vec!["ball".into(), "box".into()],
            grasps,
        }
    }

    pub(in super::super) fn grasp(object_idx: usize, held: bool, x_m: f64, feature: [i8; 2]) -> LiftedGrasp {
        LiftedGrasp {
            object_idx,
            held,
            palm_from_object: Isometry3::translation(x_m, 0.0, 0.05),
            open_joints_rad: vec![0.5, 0.0],
            feature: feature.to_vec(),
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("experience.json");
        let mut turned = grasp(1, false, -0.0123, [-128, 127]);
        turned.palm_from_object.rotation = UnitQuaternion::from_euler_angles(0.3, -0.2, 0.1);
        let written = experience(vec![grasp(0, true, 0.02, [3, -4]), turned.clone()]);
        written.save(&path).expect("written");
        let read = Experience::load(&path).expect("read");
        assert_eq!((&read.grasps[0], &read.objects), (&written.grasps[0], &written.objects));
        let found = &read.grasps[1];
        assert_eq!((found.held, &found.feature), (false, &turned.feature));
        assert!(found.palm_from_object.rotation.angle_to(&turned.palm_from_object.rotation) < 2e-4);
        assert_eq!(found.palm_from_object.translation.x, -0.0123);
        // A grasp is a line.
        assert_eq!(std::fs::read_to_string(&path).expect("text").lines().count(), 3);
    }

    #[test]
    fn features_are_coded_in_steps_of_their_deviations() {
        let experience = experience(vec![grasp(0, true, 0.0, [0, 0])]);
        assert_eq!(experience.code(&[1.5, -1.0]), [16, -16]);
        assert_eq!(experience.code(&[1e9, -1e9]), [127, -128]);
        assert_eq!(Experience::distance_squared(&[16, -16], &[0, 0]), 2.0);
        assert_eq!(Experience::distance_squared(&[127, 0], &[-128, 0]), 255.0 * 255.0 / 256.0);
    }

    #[test]
    fn what_cannot_be_is_refused_with_what_to_do() {
        let text = |experience: &Experience| serde_json::to_string(experience).expect("JSON");
        let refused = |experience: &Experience| Experience::parse(&text(experience)).expect_err("refused");
        let good = experience(vec![grasp(0, true, 0.0, [0, 0])]);
        assert_eq!(Experience::parse(&text(&good)), Ok(good.clone()));
        assert_eq!(refused(&experience(vec![])), "there is no grasp in it");
        assert_eq!(refused(&experience(vec![grasp(2, true, 0.0, [0, 0])])), "grasp 0 is of object 2, there are 2");
        let other = Experience { format: "blindgrasp-experience/9".into(), ..good.clone() };
        assert!(refused(&other).contains("make it again with this version (blindgrasp train --experience)"));
        let mut bad = good.clone();
        bad.grasps[0].feature.pop();
        assert_eq!(refused(&bad), "grasp 0 has a feature of 1 values, expected 2");
        let cut = Experience::parse(&text(&good)[..100]).expect_err("cut off");
        assert!(cut.starts_with("not an experience, or cut off"), "{cut}");
        let turned = text(&good).replace("0.0,0.0,0.0,1.0]", "0.0,0.0,0.0,2.0]");
        assert!(Experience::parse(&turned).expect_err("no rotation").contains("a pose that is none"));
    }
}
