//! The operators that come with blindgrasp: `blindgrasp operator NAME` runs one in a process of its own.
//!
//! Each file describes an operator's ports and parameters and joins a stage or source to them; the work itself is done by
//! the library crates.

#[cfg(test)]
mod allocations;
mod classifier;
pub mod connection;
mod contacts;
mod encoder;
mod lift_arbiter;
mod link;
mod publishing;
mod recorded_source;
mod ros2;
mod ros2_decision;
mod ros2_markers;
mod senses;
mod simulated_hand;
mod tactile_source;
mod zenoh;

pub use ros2_markers::hand_markers;

use blindgrasp_messages::{ContactSet, GraspFeature, Prediction, TactileFrame};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;

/// The module for operators in Python, and the messages that it knows.
pub const PYTHON_OPERATOR: &str = include_str!("blindgrasp_operator.py");
pub const PYTHON_MESSAGES: &str = include_str!("blindgrasp_messages.py");

/// An operator that comes with blindgrasp.
#[derive(Debug, Clone, Copy)]
pub struct Shipped {
    pub name: &'static str,
    /// The argument after the name; empty if there is none.
    pub variant: &'static str,
    pub describe: fn() -> OperatorDescription,
    pub work: fn(&Operator) -> anyhow::Result<()>,
}

/// All of them, with their variants.
#[rustfmt::skip]
pub const SHIPPED: [Shipped; 18] = [
    of("recorded_source", "", recorded_source::describe::<TactileFrame>, recorded_source::work::<TactileFrame>),
    of("recorded_source", "tactile", recorded_source::describe::<TactileFrame>, recorded_source::work::<TactileFrame>),
    of("recorded_source", "contacts", recorded_source::describe::<ContactSet>, recorded_source::work::<ContactSet>),
    of("recorded_source", "feature", recorded_source::describe::<GraspFeature>, recorded_source::work::<GraspFeature>),
    of("recorded_source", "prediction", recorded_source::describe::<Prediction>, recorded_source::work::<Prediction>),
    of("tactile_source", "", tactile_source::describe, tactile_source::work),
    of("simulated_hand", "", simulated_hand::describe, simulated_hand::work),
    of("senses", "", senses::describe, senses::work),
    of("contacts", "", contacts::describe, contacts::work),
    of("checked_contacts", "", contacts::describe_checked, contacts::work_checked),
    of("encoder", "", encoder::describe, encoder::work),
    of("classifier", "", classifier::describe, classifier::work),
    of("probe_classifier", "", classifier::describe_with_probes, classifier::work_with_probes),
    of("day_classifier", "", classifier::describe_with_days, classifier::work_with_days),
    of("lift_arbiter", "", lift_arbiter::describe, lift_arbiter::work),
    of("ros2", "", ros2::describe, ros2::work),
    of("zenoh", "", zenoh::describe, zenoh::work),
    of("link", "", link::describe, link::work),
];

const fn of(
    name: &'static str,
    variant: &'static str,
    describe: fn() -> OperatorDescription,
    work: fn(&Operator) -> anyhow::Result<()>,
) -> Shipped {
    Shipped { name, variant, describe, work }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_launcher_knows_the_same_operators() {
        let names = SHIPPED.iter().filter(|operator| operator.variant.is_empty()).map(|operator| operator.name);
        let known = blindgrasp_graph::describe::SHIPPED.into_iter().chain([blindgrasp_graph::describe::LINK_OPERATOR]);
        assert!(names.eq(known));
    }

    /// A source would not let the others of its group have a turn.
    #[test]
    fn the_operators_that_can_share_a_process_answer_samples() {
        for name in blindgrasp_graph::describe::GROUPABLE {
            let operator = SHIPPED.iter().find(|operator| operator.name == name).expect("shipped");
            let inputs = (operator.describe)().inputs;
            assert!(inputs.iter().any(|input| !input.feedback), "{name}");
        }
    }

    #[test]
    fn every_operator_describes_itself_under_its_own_name() {
        for operator in SHIPPED {
            let description = (operator.describe)();
            assert_eq!(description.operator, operator.name);
            description.validate().expect("a description without contradictions");
            assert!(operator.variant.is_empty() || description.outputs[0].name == operator.variant);
        }
    }
}
