//! The options of commands that speak to nodes of ROS 2.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::Args;

/// The largest domain of ROS 2.
pub const MAX_DOMAIN: u32 = 232;

#[derive(Debug, Args)]
pub struct Ros2Network {
    /// Zenoh router of the robot [default: tcp/localhost:7447]
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Option<String>,
    /// Folder with ca.pem, ros2.pem and ros2.key.pem, for an endpoint tls/HOST:PORT
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,
    /// With --keys: common names of the certificates at the other end that take part [default: ros2,@router]
    #[arg(long, value_name = "NAMES", requires = "keys")]
    pub from: Option<String>,
    /// ROS domain [default: 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN)))]
    pub domain: Option<u32>,
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
}
