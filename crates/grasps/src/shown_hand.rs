//! A hand for the viewers of recordings.

use std::sync::Arc;

use blindgrasp_recording::{LinkPose, ShownHand};
use blindgrasp_stages::hand::Hand;

/// The frame of contacts in the messages for viewers.
const PALM: &str = "palm";

/// What a recording needs so that viewers draw the hand.
pub fn shown_hand(hand: &Hand) -> ShownHand {
    let [layout, urdf] = hand.files().clone();
    let joint_names = hand.joints.iter().map(|joint| joint.name.clone()).collect();
    let hand = hand.clone();
    ShownHand { joint_names, layout, urdf, link_poses: Arc::new(move |joints| link_poses(&hand, joints)) }
}

fn link_poses(hand: &Hand, joints: &[f64]) -> Vec<LinkPose> {
    let mut poses = Vec::new();
    for link in &hand.links {
        let Some(parent_idx) = link.parent_idx else { continue };
        let pose = link.parent_from_joint * link.motion.joint_from_link(joints);
        poses.push(LinkPose {
            parent: hand.links[parent_idx].name.clone(),
            link: link.name.clone(),
            position_m: pose.translation.vector.into(),
            rotation_xyzw: pose.rotation.coords.into(),
        });
    }
    if hand.links.iter().all(|link| link.name != PALM) {
        poses.push(LinkPose {
            parent: hand.palm_link().name.clone(),
            link: PALM.into(),
            position_m: [0.0; 3],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        });
    }
    poses
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_lie_where_the_kinematics_have_them() {
        for name in ["barrett-bh8-280", "parallel-gripper"] {
            let hand = Hand::built_in(name).expect("a hand");
            let joints: Vec<f64> = hand.joints.iter().map(|joint| 0.5 * (joint.lower + joint.upper)).collect();
            let shown = shown_hand(&hand);
            assert!(shown.urdf.contains("<robot") && shown.layout.contains(name));
            let poses = (shown.link_poses)(&joints);
            let palm_from_links = hand.palm_from_links(&joints).expect("poses");
            for (idx, link) in hand.links.iter().enumerate() {
                let Some(parent_idx) = link.parent_idx else { continue };
                let expected = palm_from_links[parent_idx].inverse() * palm_from_links[idx];
                let pose = poses.iter().find(|pose| pose.link == link.name).expect("a pose");
                assert_eq!(pose.parent, hand.links[parent_idx].name);
                for axis in 0..3 {
                    assert!((pose.position_m[axis] - expected.translation.vector[axis]).abs() < 1e-12);
                }
                let dot: f64 = (0..4).map(|idx| pose.rotation_xyzw[idx] * expected.rotation.coords[idx]).sum();
                assert!((dot.abs() - 1.0).abs() < 1e-12, "{}", link.name);
            }
            assert!(poses.iter().any(|pose| pose.link == PALM || pose.parent == PALM), "{name}");
        }
    }
}
