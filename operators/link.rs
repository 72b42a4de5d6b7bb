//! The edges of a graph that cross to other machines.

use blindgrasp_operator::description::OperatorDescription;

pub(crate) use blindgrasp_bridge::operator::work;

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Carries the edges that go to other machines; the launcher adds it where a file names machines";
    OperatorDescription::new("link", summary)
}
