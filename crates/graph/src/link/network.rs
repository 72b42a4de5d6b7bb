//! The way to keys of Zenoh: endpoints and certificates, checked before there is a connection.

use super::config::KeyFiles;

/// The way to other programs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Network {
    /// Endpoints of routers or programs, like `tcp/localhost:7447`.
    pub connect: Vec<String>,
    /// Endpoints at which others connect.
    pub listen: Vec<String>,
    pub keys: Option<KeyFiles>,
    /// With keys: the common names of the certificates that take part.
    pub names: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NetworkError {
    #[error("'{0}' is no endpoint: expected tcp/HOST:PORT without keys, or tls/HOST:PORT with keys")]
    Endpoint(String),
    #[error("{0}")]
    Keys(String),
    #[error("{endpoints}: {message}")]
    Open { endpoints: String, message: String },
    #[error(
        "{endpoints}: no router of Zenoh answers{}; start zenohd, or give another endpoint",
        if *.with_keys { ", or one end refuses the other's certificate" } else { "" }
    )]
    NoRouter { endpoints: String, with_keys: bool },
    #[error("Zenoh: {0}")]
    Zenoh(String),
}

impl Network {
    /// Checks the endpoints.
    ///
    /// # Errors
    /// An endpoint that is not allowed.
    pub fn check(&self) -> Result<(), NetworkError> {
        let is_valid = |endpoint: &&String| {
            let prefix = if self.keys.is_some() { "tls/" } else { "tcp/" };
            endpoint.strip_prefix(prefix).and_then(|rest| rest.rsplit_once(':')).is_some_and(|(host, port)| {
                !host.is_empty() && !host.contains(['#', '?']) && port.parse::<u16>().is_ok()
            })
        };
        let mut endpoints = self.connect.iter().chain(&self.listen);
        if let Some(bad) = endpoints.find(|endpoint| !is_valid(endpoint)) {
            return Err(NetworkError::Endpoint(bad.clone()));
        }
        if self.keys.is_none() {
            return Ok(());
        }
        // Zenoh looks at a certificate once per connection. A connection that this side has made takes a link from outside that
        // bears the other end's number, which is no secret, whatever its certificate.
        if !self.connect.is_empty() && !self.listen.is_empty() {
            return Err(NetworkError::Keys("both 'connect' and 'listen' with keys: expected one of them".into()));
        }
        if self.names.is_empty() {
            return Err(NetworkError::Keys(
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
        let keys = KeyFiles { authority: "a".into(), certificate: "b".into(), private_key: "c".into() };
        assert!(Network { keys: Some(keys), ..network("tcp/localhost:7447") }.check().is_err());
    }
}
