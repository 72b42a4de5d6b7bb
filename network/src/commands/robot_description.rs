//! `blindgrasp-network robot-description`, which `blindgrasp new hand --robot-description` calls.

use std::io::Write;
use std::time::Duration;

use anyhow::{Context, bail};
use blindgrasp_cli::ros2_network::Ros2Network;
use blindgrasp_ros::cdr::{self, Value};
use blindgrasp_ros::standard;
use blindgrasp_ros_node::node::{
    self, Convention, MAX_RECEIVED_BYTES, MessageType, Quality, Rights, RosNode, topic_name,
};
use clap::Args;

use super::{Outcome, data_on_stdout};

/// Print the URDF that a robot in ROS 2 publishes
#[derive(Debug, Args)]
#[command(hide = true)]
pub(super) struct Arguments {
    /// The topic, like /robot_description.
    topic: String,
    #[command(flatten)]
    network: Ros2Network,
}

/// The description of a robot must come within this time.
const DESCRIPTION_LIMIT: Duration = Duration::from_secs(10);

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    data_on_stdout().write_all(described(&arguments.topic, &arguments.network)?.as_bytes())?;
    Ok(Outcome::Done)
}

/// The URDF that a robot publishes, as its `robot_state_publisher` does.
fn described(topic: &str, network: &Ros2Network) -> anyhow::Result<String> {
    let (network, domain) = network.network()?;
    let topic = topic_name("/", topic)?;
    let definition = standard::definition("std_msgs/msg/String").context("no definition of std_msgs/msg/String")?;
    let message = MessageType { name: definition.name.clone(), hash: definition.hash() };
    let rights = Rights { takes: vec![Convention::RmwZenoh.key(domain, &topic)], ..Rights::default() };
    let mut node =
        RosNode::new(node::open(&network, &rights)?, Convention::RmwZenoh, domain, "/", "blindgrasp_new_hand")?;
    let (sender, received) = std::sync::mpsc::channel();
    let _subscriber = node.subscriber(&topic, &message, Quality::KeepLast(1), move |it| drop(sender.send(it)))?;
    let received = received.recv_timeout(DESCRIPTION_LIMIT).map_err(|_| {
        anyhow::anyhow!(
            "{topic}: no message has come in {} s: does robot_state_publisher run, with rmw_zenoh and in domain {domain}?",
            DESCRIPTION_LIMIT.as_secs()
        )
    })?;
    if received.message.name != message.name || received.n_bytes > MAX_RECEIVED_BYTES {
        bail!(
            "{topic}: a message of type {} and {} bytes, expected {}",
            received.message.name,
            received.n_bytes,
            message.name
        );
    }
    let value = cdr::read(&definition, &received.bytes).with_context(|| topic.clone())?;
    let text = value.at("data").as_ref().and_then(Value::text).unwrap_or_default().to_owned();
    if !text.contains("<robot") {
        bail!("{topic}: the message is no URDF: it has no <robot> element");
    }
    Ok(text)
}
