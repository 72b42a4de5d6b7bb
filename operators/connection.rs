//! The parameters of a connection to Zenoh, which several operators have.

use std::net::IpAddr;
use std::path::PathBuf;

use blindgrasp_graph::link::config::{ROUTER_COMMON_NAME, key_files};
use blindgrasp_graph::link::network::{Network, NetworkError};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::param::ParamKind;
use serde::Deserialize;

/// The endpoint of a router of Zenoh on this machine.
const ROUTER: &str = "tcp/localhost:7447";
/// The name of this program's files in a folder of keys.
const KEY_NAME: &str = "zenoh";

/// A connection: the router on this machine by default.
#[derive(Debug, Deserialize, Clone, Default)]
pub struct ConnectionParams {
    /// A router or program, like `tcp/localhost:7447`.
    pub connect: Option<String>,
    /// An endpoint at which others connect.
    pub listen: Option<String>,
    /// A folder with `ca.pem`, `zenoh.pem` and `zenoh.key.pem`.
    pub keys: Option<PathBuf>,
    /// With keys: common names of certificates, with commas between them.
    pub from: Option<String>,
}

/// Adds the parameters of a connection.
pub fn with_connection_params(description: OperatorDescription) -> OperatorDescription {
    description
        .optional_param("connect", ParamKind::String {}, "A router or program of Zenoh, like tcp/localhost:7447, the default")
        .optional_param("listen", ParamKind::String {}, "An endpoint at which others connect, like tcp/127.0.0.1:7448")
        .optional_param(
            "keys",
            ParamKind::Path { must_exist: true },
            "A folder with ca.pem, zenoh.pem and zenoh.key.pem, for endpoints tls/HOST:PORT",
        )
        .optional_param(
            "from",
            ParamKind::String {},
            "With keys: the common names of the certificates at the other end that take part, like zenoh,arm; zenoh by default, and \
             with connect also @router",
        )
}

impl ConnectionParams {
    /// The network.
    ///
    /// # Errors
    /// An endpoint is not valid, or the keys are of no use to it.
    pub fn network(&self) -> Result<Network, NetworkError> {
        let keys = self.keys.as_deref().map(|folder| key_files(folder, KEY_NAME));
        let connect = match (&self.connect, &self.listen) {
            (Some(endpoint), _) => vec![endpoint.clone()],
            (None, Some(_)) => vec![],
            (None, None) => vec![ROUTER.to_owned()],
        };
        if keys.is_none() && self.from.is_some() {
            return Err(NetworkError::Keys(
                "'from' without keys: names come from certificates, so give 'keys' as well".into(),
            ));
        }
        let has_tls = connect.iter().chain(&self.listen).any(|endpoint| endpoint.starts_with("tls/"));
        if keys.is_some() && !has_tls {
            return Err(NetworkError::Keys(
                "keys without an endpoint that uses them: expected 'connect' or 'listen' like tls/HOST:PORT, or no keys".into(),
            ));
        }
        let names = match (&self.from, &keys) {
            (Some(from), _) => from.split(',').map(|name| name.trim().to_owned()).collect(),
            (None, Some(_)) if connect.is_empty() => vec![KEY_NAME.into()],
            (None, Some(_)) => vec![KEY_NAME.into(), ROUTER_COMMON_NAME.into()],
            (None, None) => vec![],
        };
        if names.iter().any(String::is_empty) {
            return Err(NetworkError::Keys(
                "'from' has an empty name: expected names of certificates, like zenoh,arm".into(),
            ));
        }
        let network = Network { connect, listen: self.listen.iter().cloned().collect(), keys, names };
        network.check()?;
        Ok(network)
    }
}

/// Warns if others can reach a network.
pub fn warn_if_open(network: &Network) {
    if network.keys.is_some() {
        return;
    }
    let mut endpoints = network.connect.iter().chain(&network.listen);
    if let Some(endpoint) = endpoints.find(|endpoint| !is_on_loopback(endpoint)) {
        print_diagnostic(&format!(
            "WARNING: {endpoint} without TLS: everybody who reaches it can read and send what passes there"
        ));
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
    use serde_json::json;

    use super::*;

    fn params(yaml: &serde_json::Value) -> Result<Network, NetworkError> {
        serde_json::from_value::<ConnectionParams>(yaml.clone()).expect("params").network()
    }

    #[test]
    fn by_default_the_name_zenoh_takes_part_and_where_it_connects_the_routers() {
        let names = |yaml| params(&yaml).map(|network| network.names);
        let of = |names: &[&str]| Ok(names.iter().map(|name| (*name).to_owned()).collect());
        assert_eq!(names(json!({"keys": "/k", "listen": "tls/0.0.0.0:1"})), of(&["zenoh"]));
        assert_eq!(names(json!({"keys": "/k", "connect": "tls/robot:1"})), of(&["zenoh", "@router"]));
        assert_eq!(names(json!({"keys": "/k", "listen": "tls/0.0.0.0:1", "from": "arm, hand"})), of(&["arm", "hand"]));
        assert_eq!(names(json!({})), of(&[]));
    }

    #[test]
    fn keys_and_names_that_mean_nothing_are_refused() {
        for (yaml, expected) in [
            (json!({"keys": "/k"}), "keys without an endpoint that uses them"),
            (json!({"keys": "/k", "listen": "tcp/127.0.0.1:1"}), "keys without an endpoint that uses them"),
            (json!({"keys": "/k", "listen": "tls/a:1", "connect": "tls/b:1"}), "expected one of them"),
            (json!({"keys": "/k", "listen": "tls/a:1", "from": "zenoh,"}), "'from' has an empty name"),
            (json!({"listen": "tls/a:1"}), "is no endpoint"),
            (json!({"from": "zenoh"}), "'from' without keys"),
        ] {
            let error = params(&yaml).expect_err("refused").to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

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
