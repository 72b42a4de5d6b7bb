//! Live tactile frames from topics of ROS 2 or a key of Zenoh. The source itself, its parameters and its other drivers are
//! those of the robot's program.

use std::path::PathBuf;

use anyhow::{Context as _, bail};
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operators::beginning::FileNode;
use blindgrasp_operators::connection::{ConnectionParams, warn_if_open};
use blindgrasp_operators::tactile_source::{AskedDriver, check_with, robot_driver, work_with};
use blindgrasp_ros_node::node::topic_name;
use blindgrasp_stages::hand::Hand;
use blindgrasp_tactile::{ExpectedHand, TactileDriver};
use serde::Deserialize;

use super::joint_map::hand_joints;
use super::ros2::{NetworkParams, definition_of};
use crate::drivers::phases::PhaseFinder;
use crate::drivers::ros2::{Ros2, Topics};
use crate::drivers::zenoh_key::ZenohKey;

/// ROS 2: a joint that is slower stands still.
const MOVING_RAD_PER_S: f64 = 0.05;

/// The parameters of the driver ros2.
#[derive(Deserialize)]
struct Ros2Params {
    #[serde(flatten)]
    network: NetworkParams,
    joints_topic: Option<String>,
    joint_prefix: Option<String>,
    joint_map: Option<PathBuf>,
    cells_topic: Option<String>,
    cells_type: Option<String>,
    cells_field: Option<String>,
    cells_definition: Option<PathBuf>,
    phase_topic: Option<String>,
    wrench_topic: Option<String>,
    imu_topic: Option<String>,
    tf_topic: Option<String>,
    gravity_frame: Option<String>,
    palm_frame: Option<String>,
    tolerance_ms: Option<f64>,
    moving_rad_per_s: Option<f64>,
    still_ms: Option<f64>,
}

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
    match asked.name {
        "ros2" => Ok(Box::new(ros2(&parse_params(asked.params)?, asked.hand)?)),
        "zenoh" => {
            let params: ZenohParams = parse_params(asked.params)?;
            let key = params.key.context("driver zenoh needs the param 'key', like hand/frames")?;
            Ok(Box::new(ZenohKey::new(params.connection.network()?, key, ExpectedHand::of(asked.hand))?))
        }
        _ => robot_driver(asked),
    }
}

/// The driver for topics of ROS 2.
fn ros2(params: &Ros2Params, hand: &Hand) -> anyhow::Result<Ros2> {
    let (network, domain, namespace) = params.network.network()?;
    let convention = params.network.convention();
    let named = |name: &Option<String>| {
        name.as_ref().map(|name| topic_name(&namespace, name)).transpose().map_err(anyhow::Error::from)
    };
    let cells = named(&params.cells_topic)?.context("driver ros2 needs the param 'cells_topic', like /hand/tactile")?;
    let cells_type = params.cells_type.as_deref().unwrap_or("std_msgs/msg/Float64MultiArray");
    let prefix = params.joint_prefix.as_deref().unwrap_or_default();
    let [gravity_frame, palm_frame] = [&params.gravity_frame, &params.palm_frame]
        .map(|name| name.as_deref().map(|name| name.trim_start_matches('/').to_owned()));
    let gravity = match (gravity_frame, palm_frame) {
        (Some(_), _) if params.imu_topic.is_some() => {
            bail!("params 'gravity_frame' and 'imu_topic' both tell gravity: leave one of them out")
        }
        (Some(upright), Some(palm)) if upright != palm => {
            let topic = named(&params.tf_topic)?.unwrap_or_else(|| "/tf".into());
            Some((topic, [upright, palm]))
        }
        (None, None) if params.tf_topic.is_none() => None,
        _ => bail!(
            "params 'gravity_frame' (a frame whose z axis points upwards, like world) and 'palm_frame' (the frame of the hand's \
             {}) belong together, and are different frames",
            hand.palm_link().name
        ),
    };
    let topics = Topics {
        network,
        convention,
        domain,
        joints: named(&params.joints_topic)?.unwrap_or_else(|| "/joint_states".into()),
        cells,
        cells_definition: definition_of(cells_type, params.cells_definition.as_deref())?,
        cells_field: params.cells_field.clone().unwrap_or_else(|| "data".into()),
        phase: named(&params.phase_topic)?,
        wrench: named(&params.wrench_topic)?,
        imu: named(&params.imu_topic)?,
        gravity,
        hand_joints: hand_joints(hand, prefix, params.joint_map.as_deref())?,
        tolerance_nanos: (params.tolerance_ms.unwrap_or(20.0) * 1e6) as u64,
        still_per_s: params.moving_rad_per_s.unwrap_or(MOVING_RAD_PER_S),
        namespace,
    };
    let still_nanos = (params.still_ms.unwrap_or(200.0) * 1e6) as u64;
    let finder = PhaseFinder::new(params.moving_rad_per_s.unwrap_or(MOVING_RAD_PER_S), still_nanos);
    Ok(Ros2::new(topics, finder))
}
