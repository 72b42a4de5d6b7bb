//! Sessions with programs that are no part of the graph: hands that send frames on a key, readers of its samples.

mod access;

use blindgrasp_graph::link::network::{Network, NetworkError};
use serde_json::json;
use zenoh::bytes::Encoding;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Config, Session, Wait};

use super::session::tls_config;
pub use access::Rights;
use access::access_control;

/// A longer message is dropped by Zenoh.
const MAX_MESSAGE_BYTES: usize = 16 << 20;
/// A reader that takes nothing for so long is disconnected, so that it does not hold up the others.
const BLOCK_MICROS: u64 = 500_000;
/// A connection is over after this silence.
const LEASE_MILLIS: u64 = 2000;
/// The time in which a router must answer.
const OPEN_MILLIS: u64 = 1000;
/// A client's session cannot be opened because no endpoint answers it; Zenoh says so in its message alone.
const NO_ANSWER: &str = "Unable to connect to any of";

/// Opens a session for these rights. A router must answer within a second.
///
/// # Errors
/// An endpoint cannot be used.
pub fn open(network: &Network, rights: &Rights) -> Result<Session, NetworkError> {
    network.check()?;
    let is_client = network.listen.is_empty();
    let mut config = json!({
        "mode": if is_client { "client" } else { "peer" },
        "listen": {"endpoints": network.listen, "timeout_ms": 0, "exit_on_failure": true},
        "connect": {
            "endpoints": network.connect,
            "timeout_ms": if is_client { OPEN_MILLIS as i64 } else { -1 },
            "exit_on_failure": is_client,
            "retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2.0},
        },
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "timestamping": {"enabled": true},
        "adminspace": {"enabled": false},
        "transport": {
            "unicast": {"open_timeout": OPEN_MILLIS, "accept_timeout": OPEN_MILLIS},
            "link": {
                "protocols": [if network.keys.is_some() { "tls" } else { "tcp" }],
                "tx": {"lease": LEASE_MILLIS,
                       "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_MICROS}}}},
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
            "shared_memory": {"enabled": false},
        },
    });
    let names = network.keys.is_some().then_some(network.names.as_slice());
    config["access_control"] = access_control(rights, names);
    if let Some(keys) = &network.keys {
        config["transport"]["link"]["tls"] = tls_config(keys);
    }
    let refused = |error: zenoh::Error| {
        let endpoints = [network.connect.as_slice(), &network.listen].concat().join(", ");
        let message = error.to_string();
        // Zenoh appends the place in its source code.
        let message = message.split(" at /").next().unwrap_or_default();
        if message.contains(NO_ANSWER) {
            NetworkError::NoRouter { endpoints, with_keys: network.keys.is_some() }
        } else {
            NetworkError::Open { endpoints, message: message.into() }
        }
    };
    let config = Config::from_json5(&config.to_string()).map_err(refused)?;
    zenoh::open(config).wait().map_err(refused)
}

/// Sends samples to a key.
pub struct KeyPublisher {
    publisher: Publisher<'static>,
}

impl KeyPublisher {
    /// A publisher of JSON. Where the network has no room, it waits with a sample if these are kept, and drops any other.
    ///
    /// # Errors
    /// It is no key, or Zenoh refuses it.
    pub fn new(session: &Session, key: &str, is_kept: bool) -> Result<KeyPublisher, NetworkError> {
        let mut builder = session.declare_publisher(key.to_owned()).encoding(Encoding::APPLICATION_JSON);
        builder = builder.congestion_control(CongestionControl::Drop);
        if is_kept {
            builder =
                builder.congestion_control(CongestionControl::Block).priority(Priority::InteractiveHigh).express(true);
        }
        Ok(KeyPublisher { publisher: builder.wait().map_err(of_zenoh)? })
    }

    /// Sends a sample, with its number and its time (nanoseconds since 1970) as the attachment: two integers of 64 bits,
    /// little endian.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&self, payload: &[u8], seq: u64, unix_nanos: u64) -> Result<(), NetworkError> {
        let attachment = [seq.to_le_bytes(), unix_nanos.to_le_bytes()].concat();
        self.publisher.put(payload).attachment(attachment).wait().map_err(of_zenoh)
    }
}

fn of_zenoh(error: zenoh::Error) -> NetworkError {
    NetworkError::Zenoh(error.to_string())
}
