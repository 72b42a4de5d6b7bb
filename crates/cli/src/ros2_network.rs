//! The options of commands that speak to nodes of ROS 2.

use std::ffi::OsString;
use std::path::PathBuf;

use blindgrasp_operators::connection::{ConnectionParams, warn_if_open};
use blindgrasp_ros::network::{MAX_DOMAIN, Network};
use clap::Args;

#[derive(Debug, Args)]
pub struct Ros2Network {
    /// Zenoh router of the robot [default: tcp/localhost:7447]
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    /// Folder with ca.pem, ros2.pem and ros2.key.pem, for an endpoint tls/HOST:PORT
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
    /// With --keys: common names of the certificates at the other end that take part; ros2,@router by default
    #[arg(long, value_name = "NAMES", requires = "keys")]
    from: Option<String>,
    /// ROS domain [default: 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    domain: Option<u32>,
}

impl Ros2Network {
    /// The options as they were given, for another command.
    pub fn arguments(&self) -> Vec<OsString> {
        let domain = self.domain.map(|domain| domain.to_string());
        let options = [
            ("--connect", self.connect.as_ref().map(OsString::from)),
            ("--keys", self.keys.as_ref().map(OsString::from)),
            ("--from", self.from.as_ref().map(OsString::from)),
            ("--domain", domain.map(OsString::from)),
        ];
        let given = options.into_iter().filter_map(|(name, value)| Some([name.into(), value?]));
        given.flatten().collect()
    }

    /// The network and the domain.
    ///
    /// # Errors
    /// The endpoint is not valid.
    pub fn network(&self) -> anyhow::Result<(Network, u32)> {
        let (connect, keys, from) = (self.connect.clone(), self.keys.clone(), self.from.clone());
        let network = ConnectionParams { connect, listen: None, keys, from }.network()?;
        warn_if_open(&network);
        Ok((network, self.domain.unwrap_or(0)))
    }
}
