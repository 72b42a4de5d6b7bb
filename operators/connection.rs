//! The parameters of a connection to Zenoh, which several operators have.

use std::net::IpAddr;
use std::path::PathBuf;

use blindgrasp_bridge::certificates::key_files;
use blindgrasp_bridge::config::KeyFiles;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_ros::node::{Keys, Network, RosError};
use serde::Deserialize;

/// The router of rmw_zenoh.
const ROUTER: &str = "tcp/localhost:7447";
/// The name of this program's files in a folder of keys.
const KEY_NAME: &str = "ros2";

/// A connection: the router on this machine by default.
#[derive(Debug, Deserialize, Clone, Default)]
pub struct ConnectionParams {
    /// A router or node, like `tcp/localhost:7447`.
    pub connect: Option<String>,
    /// An endpoint at which others connect.
    pub listen: Option<String>,
    /// A folder with `ca.pem`, `ros2.pem` and `ros2.key.pem`.
    pub keys: Option<PathBuf>,
}

/// Adds the parameters of a connection.
pub(crate) fn with_connection_params(description: OperatorDescription) -> OperatorDescription {
    description
        .optional_param("connect", ParamKind::String {}, "A Zenoh router or node, like tcp/localhost:7447, the default")
        .optional_param("listen", ParamKind::String {}, "An endpoint at which others connect, like tcp/127.0.0.1:7448")
        .optional_param(
            "keys",
            ParamKind::Path { must_exist: true },
            "A folder with ca.pem, ros2.pem and ros2.key.pem, for endpoints tls/HOST:PORT",
        )
}

impl ConnectionParams {
    /// The network, with a warning if others can reach it.
    ///
    /// # Errors
    /// An endpoint is not valid.
    pub fn network(&self) -> Result<Network, RosError> {
        let keys = self.keys.as_deref().map(|folder| {
            let KeyFiles { authority, certificate, private_key } = key_files(folder, KEY_NAME);
            Keys { authority, certificate, private_key }
        });
        let connect = match (&self.connect, &self.listen) {
            (Some(endpoint), _) => vec![endpoint.clone()],
            (None, Some(_)) => vec![],
            (None, None) => vec![ROUTER.to_owned()],
        };
        let network = Network { connect, listen: self.listen.iter().cloned().collect(), keys };
        network.check()?;
        if network.keys.is_none() {
            let mut endpoints = network.connect.iter().chain(&network.listen);
            if let Some(endpoint) = endpoints.find(|endpoint| !is_on_loopback(endpoint)) {
                print_diagnostic(&format!(
                    "WARNING: {endpoint} without TLS: everybody who reaches it can read and send what passes there"
                ));
            }
        }
        Ok(network)
    }
}

/// Whether no other machine reaches an endpoint like `tcp/localhost:7447`.
fn is_on_loopback(endpoint: &str) -> bool {
    let host = endpoint.split_once('/').and_then(|(_, address)| address.rsplit_once(':')).map_or("", |(host, _)| host);
    let address = host.trim_matches(['[', ']']).parse::<IpAddr>();
    host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_other_machines_reach_are_told_from_those_on_loopback() {
        for local in ["tcp/localhost:7447", "tcp/127.0.0.1:1", "tls/[::1]:7447"] {
            assert!(is_on_loopback(local), "{local}");
        }
        for remote in ["tcp/0.0.0.0:1", "tcp/127.example.org:1", "tls/robot:7447", "tcp/[::]:1"] {
            assert!(!is_on_loopback(remote), "{remote}");
        }
    }
}
