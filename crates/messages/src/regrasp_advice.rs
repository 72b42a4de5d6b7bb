//! How to grasp better: where the palm should be next, seen from where it is.

use serde::{Deserialize, Serialize};

use crate::declare::at_most;
use crate::{Header, MAX_JOINTS, Message, MessageError, ZeroCopySend};

/// The most proposals in a [`RegraspAdvice`].
pub const MAX_PROPOSALS: usize = 32;
/// The numbers of a proposal beside its joints: position, rotation, probability.
const N_POSE_NUMBERS: usize = 8;

declared! {
    /// A better grasp than the present one, as far as experience tells.
    #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
    pub struct RegraspProposal {
        /// Where the palm should settle next, in the frame of the palm that sent the frames (`palm_from_next`), and how
        /// it should be turned: a unit quaternion.
        #[ros = "The next palm in the palm frame, metres; x, y, z, w."]
        pub palm_position_m: [f64; 3],
        pub palm_rotation_xyzw: [f64; 4],
        /// The joints to begin with: the preshape set, the fingers open.
        #[ros = "Radians, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        pub open_joints_rad: Vec<f64>,
        /// The share of like experience that kept the object.
        pub probability_held: f64,
    }
}

message! {
    /// How to grasp better than in one grasp; one advice per grasp. The header's sequence counts advice.
    #[derive(serde::Serialize)]
    pub struct RegraspAdvice = "blindgrasp/RegraspAdvice/1" on "/advice" {
        pub grasp_id: u64,
        /// No proposals where nothing better is known. All have the same number of joints.
        #[ros = "The best one first."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_PROPOSALS)]
        pub proposals: Vec<RegraspProposal>,
    }
    also check RegraspAdvice::check_joints;

    /// The items are the proposals: position, rotation, probability, `n_joints` joint angles each.
    pub struct RegraspAdviceHead = "blindgrasp/RegraspAdviceHead/1" {
        grasp_id: u64, n_proposals: u32, n_joints: u32,
    }
}

impl RegraspAdvice {
    /// The most items of an advice to a hand of so many joints.
    pub const fn max_items(n_joints: usize) -> usize {
        MAX_PROPOSALS * (N_POSE_NUMBERS + n_joints)
    }

    fn n_joints(&self) -> usize {
        self.proposals.first().map_or(0, |first| first.open_joints_rad.len())
    }

    fn check_joints(&self) -> Result<(), MessageError> {
        let n_joints = self.n_joints();
        at_most("open_joints_rad", n_joints, MAX_JOINTS)?;
        match self.proposals.iter().map(|proposal| proposal.open_joints_rad.len()).find(|found| *found != n_joints) {
            Some(found) => {
                Err(MessageError::Length { field: "open_joints_rad", found, expected: n_joints.to_string() })
            }
            None => Ok(()),
        }
    }
}

impl Message for RegraspAdvice {
    type Head = RegraspAdviceHead;
    type Item = f64;

    fn header(head: &RegraspAdviceHead) -> &Header {
        &head.header
    }

    fn header_mut(head: &mut RegraspAdviceHead) -> &mut Header {
        &mut head.header
    }

    fn to_parts(&self, header: Header) -> (RegraspAdviceHead, Vec<f64>) {
        let head = RegraspAdviceHead {
            header,
            grasp_id: self.grasp_id,
            n_proposals: self.proposals.len() as u32,
            n_joints: self.n_joints() as u32,
        };
        let items = self.proposals.iter().flat_map(|proposal| {
            let pose = proposal.palm_position_m.iter().chain(&proposal.palm_rotation_xyzw);
            pose.chain([&proposal.probability_held]).chain(&proposal.open_joints_rad).copied()
        });
        (head, items.collect())
    }

    fn from_parts(head: &RegraspAdviceHead, items: &[f64]) -> Result<Self, MessageError> {
        let (n_proposals, n_joints) = (head.n_proposals as usize, head.n_joints as usize);
        at_most("proposals", n_proposals, MAX_PROPOSALS)?;
        at_most("open_joints_rad", n_joints, MAX_JOINTS)?;
        let n_items = n_proposals * (N_POSE_NUMBERS + n_joints);
        if items.len() != n_items {
            return Err(MessageError::Length { field: "items", found: items.len(), expected: n_items.to_string() });
        }
        let proposals = items.chunks_exact(N_POSE_NUMBERS + n_joints).map(|numbers| {
            let number = |idx: usize| numbers.get(idx).copied().unwrap_or_default();
            RegraspProposal {
                palm_position_m: std::array::from_fn(number),
                palm_rotation_xyzw: std::array::from_fn(|idx| number(3 + idx)),
                probability_held: number(7),
                open_joints_rad: numbers[N_POSE_NUMBERS..].to_vec(),
            }
        });
        Ok(RegraspAdvice { grasp_id: head.grasp_id, proposals: proposals.collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Recorded as _;

    fn advice() -> RegraspAdvice {
        let proposal = |first: f64| RegraspProposal {
            palm_position_m: [first, 0.2, 0.3],
            palm_rotation_xyzw: [0.0, 0.6, 0.0, 0.8],
            open_joints_rad: vec![0.5, -0.5],
            probability_held: 0.75,
        };
        RegraspAdvice { grasp_id: 7, proposals: vec![proposal(0.1), proposal(-0.1)] }
    }

    #[test]
    fn advice_travels_with_and_without_proposals() {
        for advice in [advice(), RegraspAdvice { grasp_id: 8, proposals: vec![] }] {
            let (head, items) = advice.to_parts(Header::default());
            assert_eq!(items.len(), advice.proposals.len() * 10);
            assert_eq!(RegraspAdvice::from_parts(&head, &items), Ok(advice.clone()));
            assert_eq!(advice.check(), Ok(()));
        }
        assert_eq!(advice().to_parts(Header::default()).1[..9], [0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8, 0.75, 0.5]);
    }

    #[test]
    fn lengths_that_cannot_be_are_refused() {
        let (head, items) = advice().to_parts(Header::default());
        let refused = |head: RegraspAdviceHead, items: &[f64]| {
            RegraspAdvice::from_parts(&head, items).expect_err("refused").to_string()
        };
        assert_eq!(refused(head, &items[1..]), "items has length 19, expected 20");
        let many = RegraspAdviceHead { n_proposals: u32::MAX, n_joints: u32::MAX, ..head };
        assert_eq!(refused(many, &items), "proposals has length 4294967295, expected 0 to 32");
        let joints = RegraspAdviceHead { n_joints: 33, ..head };
        assert_eq!(refused(joints, &items), "open_joints_rad has length 33, expected 0 to 32");
        let mut uneven = advice();
        uneven.proposals[1].open_joints_rad.pop();
        assert_eq!(uneven.check().expect_err("uneven").to_string(), "open_joints_rad has length 1, expected 2");
        let crowd = RegraspAdvice { proposals: vec![RegraspProposal::default(); MAX_PROPOSALS + 1], ..advice() };
        crowd.check().expect_err("too many");
    }
}
