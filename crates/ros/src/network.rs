//! The way to nodes of ROS 2 and to keys of Zenoh: endpoints and keys, checked before there is a connection.

use std::path::PathBuf;

/// The domains that ROS 2 has.
pub const MAX_DOMAIN: u32 = 232;

/// The way to the other nodes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Network {
    /// Endpoints of routers or nodes, like `tcp/localhost:7447`.
    pub connect: Vec<String>,
    /// Endpoints at which other nodes connect.
    pub listen: Vec<String>,
    pub keys: Option<Keys>,
    /// With keys: the common names of the certificates that take part.
    pub names: Vec<String>,
}

/// The files for TLS, in PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    pub authority: PathBuf,
    pub certificate: PathBuf,
    pub private_key: PathBuf,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RosError {
    #[error("'{0}' is no endpoint: expected tcp/HOST:PORT without keys, or tls/HOST:PORT with keys")]
    Endpoint(String),
    #[error("{0}")]
    Keys(String),
    #[error("{endpoints}: {message}")]
    Open { endpoints: String, message: String },
    #[error(
        "{endpoints}: no router of Zenoh answers{}; start the router: ros2 run rmw_zenoh_cpp rmw_zenohd, or for nodes \
         of DDS zenoh-bridge-ros2dds",
        if *.with_keys { ", or one end refuses the other's certificate" } else { "" }
    )]
    NoRouter { endpoints: String, with_keys: bool },
    #[error("'{0}' is no name of a topic: expected words of letters, digits and '_', joined by '/'")]
    Topic(String),
    #[error("Zenoh: {0}")]
    Zenoh(String),
}

impl Network {
    /// Checks the endpoints.
    ///
    /// # Errors
    /// An endpoint that is not allowed.
    pub fn check(&self) -> Result<(), RosError> {
        let is_valid = |endpoint: &&String| {
            let prefix = if self.keys.is_some() { "tls/" } else { "tcp/" };
            endpoint.strip_prefix(prefix).and_then(|rest| rest.rsplit_once(':')).is_some_and(|(host, port)| {
                !host.is_empty() && !host.contains(['#', '?']) && port.parse::<u16>().is_ok()
            })
        };
        let mut endpoints = self.connect.iter().chain(&self.listen);
        if let Some(bad) = endpoints.find(|endpoint| !is_valid(endpoint)) {
            return Err(RosError::Endpoint(bad.clone()));
        }
        if self.keys.is_none() {
            return Ok(());
        }
        // Zenoh looks at a certificate once per connection. A connection that this side has made takes a link from outside that
        // bears the other end's number, which is no secret, whatever its certificate.
        if !self.connect.is_empty() && !self.listen.is_empty() {
            return Err(RosError::Keys("both 'connect' and 'listen' with keys: expected one of them".into()));
        }
        if self.names.is_empty() {
            return Err(RosError::Keys(
                "no name may take part: expected the common names of certificates, like ros2".into(),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_with_keys_use_tls_and_others_do_not() {
        let network = |endpoint: &str| Network { connect: vec![endpoint.into()], ..Network::default() };
        assert_eq!(network("tcp/localhost:7447").check(), Ok(()));
        for bad in ["tls/localhost:7447", "udp/localhost:7447", "tcp/localhost", "tcp/:1", "tcp/a:1#iface=x"] {
            assert!(network(bad).check().is_err(), "{bad}");
        }
        let keys = Keys { authority: "a".into(), certificate: "b".into(), private_key: "c".into() };
        assert!(Network { keys: Some(keys), ..network("tcp/localhost:7447") }.check().is_err());
    }
}
