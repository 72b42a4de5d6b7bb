//! The edges of a graph that cross to other machines.

use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::sandbox;

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Carries the edges that go to other machines; the launcher adds it where a file names machines";
    OperatorDescription::new("link", summary).uses_network()
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    // It reads the network, and has no sandbox because it reads its keys again and again and opens sockets of all kinds.
    if let Err(error) = sandbox::deny_programs() {
        tracing::warn!("the link could run programs: {:#}", anyhow::Error::from(error));
    }
    blindgrasp_bridge::operator::work(operator)
}
