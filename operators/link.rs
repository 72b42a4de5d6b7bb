//! The edges of a graph that cross to other machines.

use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Carries the edges that go to other machines; the launcher adds it where a file names machines";
    OperatorDescription::new("link", summary).uses_network()
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    blindgrasp_bridge::operator::work(operator)
}
