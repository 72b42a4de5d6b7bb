//! The network of ROS 2 that options name.

use blindgrasp_cli::ros2_network::Ros2Network;
use blindgrasp_ros_node::node::Network;

use crate::operators::connection::{ConnectionParams, warn_if_open};

/// The network and the domain.
///
/// # Errors
/// The endpoint is not valid.
pub(super) fn network_of(options: &Ros2Network) -> anyhow::Result<(Network, u32)> {
    let Ros2Network { connect, keys, from, domain } = options;
    let connection =
        ConnectionParams { connect: connect.clone(), listen: None, keys: keys.clone(), from: from.clone() };
    let network = connection.network()?;
    warn_if_open(&network);
    Ok((network, domain.unwrap_or(0)))
}
