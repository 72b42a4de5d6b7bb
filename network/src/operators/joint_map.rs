//! The joints of a hand under the names and with the values that a topic of ROS 2 has for them.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, bail};
use blindgrasp_messages::files::read_regular;
use blindgrasp_stages::hand::Hand;
use serde::Deserialize;

use crate::drivers::ros2::JointTopic;

/// An entry of a joint map.
#[derive(Debug, Clone, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct MappedJoint {
    from: Option<String>,
    scale: f64,
    offset: f64,
}

impl Default for MappedJoint {
    fn default() -> Self {
        MappedJoint { from: None, scale: 1.0, offset: 0.0 }
    }
}

/// The hand's joints as a topic has them: by the map, else by their names behind the prefix.
///
/// # Errors
/// The map cannot be read, has a joint that the hand has not, or a number that makes no value.
pub(crate) fn hand_joints(hand: &Hand, prefix: &str, map: Option<&Path>) -> anyhow::Result<Vec<JointTopic>> {
    let mut mapped: BTreeMap<String, MappedJoint> = match map {
        Some(path) => {
            let text = read_regular(path).with_context(|| format!("joint_map {}", path.display()))?;
            serde_saphyr::from_str(&text).with_context(|| {
                format!("joint_map {}: expected {{JOINT: {{from: NAME, scale: 1, offset: 0}}}}", path.display())
            })?
        }
        None => BTreeMap::new(),
    };
    let joints = (0..hand.joints.len()).map(|idx| {
        let joint = &hand.joints[idx];
        let closing_rate = Some(hand.closing_rate(idx)).filter(|rate| !joint.is_preshape && *rate != 0.0);
        let MappedJoint { from, scale, offset } = mapped.remove(&joint.name).unwrap_or_default();
        if !(scale.is_finite() && scale != 0.0 && offset.is_finite()) {
            bail!(
                "joint_map: {}: scale {scale}, offset {offset}: expected finite numbers, and no scale of 0",
                joint.name
            );
        }
        Ok(JointTopic { name: from.unwrap_or(format!("{prefix}{}", joint.name)), scale, offset, closing_rate })
    });
    let joints = joints.collect::<anyhow::Result<_>>()?;
    if let Some(name) = mapped.keys().next() {
        let known: Vec<&str> = hand.joints.iter().map(|joint| joint.name.as_str()).collect();
        bail!("joint_map: the hand {} has no joint '{name}': it has {}", hand.name, known.join(", "));
    }
    Ok(joints)
}
