//! The options of commands that speak to nodes of ROS 2.

use std::path::PathBuf;

use blindgrasp_operators::connection::{ConnectionParams, warn_if_open};
use blindgrasp_ros::network::{MAX_DOMAIN, Network};
use clap::Args;

#[derive(Debug, Args)]
pub(super) struct Ros2Network {
    /// Zenoh router of the robot [default: tcp/localhost:7447]
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    /// Folder with ca.pem, ros2.pem and ros2.key.pem, for an endpoint tls/HOST:PORT
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
    /// With --keys: common names of the certificates at the other end that take part [default: ros2,@router]
    #[arg(long, value_name = "NAMES", requires = "keys")]
    from: Option<String>,
    /// ROS domain [default: 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    domain: Option<u32>,
}

impl Ros2Network {
    /// Whether there is any of the options.
    pub(super) fn is_given(&self) -> bool {
        self.connect.is_some() || self.keys.is_some() || self.from.is_some() || self.domain.is_some()
    }

    /// The network and the domain.
    ///
    /// # Errors
    /// The endpoint is not valid.
    pub(super) fn network(&self) -> anyhow::Result<(Network, u32)> {
        let (connect, keys, from) = (self.connect.clone(), self.keys.clone(), self.from.clone());
        let connection = ConnectionParams { connect, listen: None, keys, from };
        let network = connection.network()?;
        warn_if_open(&network);
        Ok((network, self.domain.unwrap_or(0)))
    }
}
