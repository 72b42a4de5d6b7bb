//! Live tactile frames from a key of Zenoh. The source itself, its parameters and its other drivers are those of the robot's
//! program.

use anyhow::Context as _;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operators::beginning::FileNode;
use blindgrasp_operators::connection::{ConnectionParams, warn_if_open};
use blindgrasp_operators::tactile_source::{AskedDriver, check_with, robot_driver, work_with};
use blindgrasp_tactile::{ExpectedHand, TactileDriver};
use serde::Deserialize;

use crate::drivers::zenoh_key::ZenohKey;

/// The parameters of the driver zenoh.
#[derive(Deserialize)]
struct ZenohParams {
    key: Option<String>,
    #[serde(flatten)]
    connection: ConnectionParams,
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    warn_if_open(&operator.params::<ConnectionParams>()?.network()?);
    work_with(operator, driver)
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    check_with(node, driver)
}

fn driver(asked: &AskedDriver<'_>) -> anyhow::Result<Box<dyn TactileDriver>> {
    if asked.name != "zenoh" {
        return robot_driver(asked);
    }
    let params: ZenohParams = parse_params(asked.params)?;
    let key = params.key.context("driver zenoh needs the param 'key', like hand/frames")?;
    Ok(Box::new(ZenohKey::new(params.connection.network()?, key, ExpectedHand::of(asked.hand))?))
}
