//! Zenoh as the link uses it: explicit endpoints, mutual TLS, access control, nothing found by itself.

use std::net::{IpAddr, SocketAddr};

use serde_json::{Value, json};
use time::OffsetDateTime;
use zenoh::{Config, Session, Wait};

use super::access;
use super::certificates::{self, CertificateError, CertificateSummary, RENEWAL};
use super::config::{KeyFiles, LinkConfig};
use super::wire::MAX_FRAME_BYTES;

/// How many messages wait for the line before one has to wait itself: the most that Zenoh allows.
const QUEUE_BATCHES: usize = 16;
/// How long a message waits for the line before it is dropped, and has to be asked for again: well below the pings' rhythm.
const DROP_MICROS: i64 = 15_000;
/// How long a message that must not be dropped may wait before Zenoh ends the connection. Only commands are such, which end
/// themselves long before: samples must not be cut off by a recording that is too large for the line.
const BLOCK_MICROS: u64 = 60_000_000;
/// A connection that says nothing for longer is closed. The link itself looks sooner: see
/// [`LinkConfig::deadline_millis`].
const LEASE_MILLIS: u64 = 2000;
/// How long after a failed attempt the next one follows: from the first to the last value, doubling.
const RETRY_MILLIS: [u64; 2] = [100, 1000];
/// How long one attempt may take, TLS and all.
const ATTEMPT_MILLIS: u64 = 3000;
/// How long [`open`] waits for a router.
const ROUTER_MILLIS: u64 = 2000;
/// Zenoh takes messages apart that are longer than 64 KiB and keeps the parts; a message longer than this it drops. Frames
/// that are too long but not that long are the link's to count.
const MAX_MESSAGE_BYTES: usize = 4 * MAX_FRAME_BYTES;
/// Connections at a time.
const MAX_SESSIONS: usize = 256;

/// Why there is no session.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// An endpoint that is none, or that must not be used like that.
    #[error("machine '{machine}': endpoint '{endpoint}': {message}")]
    Endpoint {
        /// This machine.
        machine: String,
        /// The endpoint.
        endpoint: String,
        /// What is wrong, what was expected and what to do.
        message: String,
    },
    /// It has none.
    #[error(
        "machine '{0}' neither listens nor has another machine or router to connect to: give one of the machines \
         `listen`, like tls/192.168.1.10:7447"
    )]
    NoEndpoint(String),
    /// The machine's certificate or key cannot be used.
    #[error("machine '{machine}': {source}")]
    Keys {
        /// This machine.
        machine: String,
        /// Why.
        source: CertificateError,
    },
    /// Nobody else can reach this machine.
    #[error("machine '{machine}' cannot listen on {endpoints}: {message}")]
    Listen {
        /// This machine.
        machine: String,
        /// Where it was to listen.
        endpoints: String,
        /// Why, and what to do.
        message: String,
    },
    /// No router has answered yet: the order of start does not matter, so try again.
    #[error("machine '{machine}' cannot reach the router {endpoints} yet: {message}")]
    Router {
        /// This machine.
        machine: String,
        /// The router.
        endpoints: String,
        /// What Zenoh says.
        message: String,
    },
    /// Zenoh refuses the configuration.
    #[error("machine '{machine}': Zenoh does not start: {message}")]
    Zenoh {
        /// This machine.
        machine: String,
        /// What Zenoh says.
        message: String,
    },
}

impl SessionError {
    /// Whether it may go well at the next attempt, with nothing changed here.
    pub fn is_passing(&self) -> bool {
        matches!(self, SessionError::Router { .. })
    }
}

/// Opens the session. Other machines need not be there yet: Zenoh goes on trying, and so it does when a connection breaks.
///
/// A router must be there: without one it fails after some seconds with an error that [is passing](SessionError::is_passing).
///
/// # Errors
/// See [`SessionError`].
pub fn open(config: &LinkConfig) -> Result<Session, SessionError> {
    let machine = config.machine.clone();
    let keys = checked(config)?;
    if let Some(keys) = keys {
        certificates::check(keys, &machine, config.namespace.as_deref(), OffsetDateTime::now_utc())
            .map_err(|source| SessionError::Keys { machine: machine.clone(), source })?;
    }
    let refused = |error: zenoh::Error| SessionError::Zenoh { machine: machine.clone(), message: error.to_string() };
    let zenoh_config = Config::from_json5(&zenoh_config(config, keys).to_string()).map_err(refused)?;
    zenoh::open(zenoh_config).wait().map_err(|error| open_error(config, &error.to_string()))
}

/// What whoever starts the link ought to hear although it starts: that it goes without TLS, that the certificate ends soon,
/// that others can read the private key.
pub fn warning(config: &LinkConfig) -> Option<String> {
    let mut warnings = Vec::new();
    let open: Vec<&str> = endpoints(config)
        .filter(|endpoint| parsed(endpoint).is_ok_and(|(scheme, host)| scheme == Scheme::Tcp && !is_loopback(&host)))
        .collect();
    if config.insecure && !open.is_empty() {
        warnings.push(format!(
            "insecure: {} without TLS: whoever reaches it can read what the graph says, and say what it likes in any \
             machine's name",
            open.join(", ")
        ));
    }
    if let Ok(Some(keys)) = checked(config) {
        warnings.extend(key_warnings(keys, OffsetDateTime::now_utc()));
    }
    (!warnings.is_empty()).then(|| warnings.join("; "))
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scheme {
    Tcp,
    Tls,
}

fn endpoints(config: &LinkConfig) -> impl Iterator<Item = &str> {
    let endpoints = &config.endpoints;
    let used = match endpoints.router.is_empty() {
        true => [&endpoints.listen, &endpoints.connect].map(Vec::as_slice),
        false => [endpoints.router.as_slice(), &[]],
    };
    used.into_iter().flatten().map(String::as_str)
}

/// Refuses endpoints that must not be used, and gives the keys if they are needed.
fn checked(config: &LinkConfig) -> Result<Option<&KeyFiles>, SessionError> {
    let refused = |endpoint: &str, message: String| SessionError::Endpoint {
        machine: config.machine.clone(),
        endpoint: endpoint.into(),
        message,
    };
    let mut schemes = Vec::new();
    for endpoint in endpoints(config) {
        let (scheme, host) = parsed(endpoint).map_err(|message| refused(endpoint, message))?;
        if scheme == Scheme::Tcp && !is_loopback(&host) && !config.insecure {
            let message = "it goes beyond this machine without TLS. Make it tls/… with `link: {keys: DIR}` (`blindgrasp \
                           keys DIR` makes keys), keep to tcp/127.0.0.1:PORT (a tunnel of your own, like ssh -L, then \
                           protects it), or say `link: {insecure: true}` where nobody else can reach the network";
            return Err(refused(endpoint, message.into()));
        }
        if scheme == Scheme::Tls && config.keys.is_none() {
            let message = "TLS needs this machine's certificate: `link: {keys: DIR}` or --keys DIR (`blindgrasp keys DIR` \
                           makes keys)";
            return Err(refused(endpoint, message.into()));
        }
        schemes.push((scheme, endpoint));
    }
    let first = schemes.first().ok_or_else(|| SessionError::NoEndpoint(config.machine.clone()))?.0;
    match schemes.iter().find(|(scheme, _)| *scheme != first) {
        // Who connects without TLS has no name, and so no right to anything.
        Some(_) => {
            let (_, endpoint) = schemes.iter().find(|(scheme, _)| *scheme == Scheme::Tcp).unwrap_or(&schemes[0]);
            Err(refused(endpoint, "this machine's other endpoints use TLS: make this one tls/… as well".into()))
        }
        None => Ok(config.keys.as_ref().filter(|_| first == Scheme::Tls)),
    }
}

/// `SCHEME/HOST:PORT`
fn parsed(endpoint: &str) -> Result<(Scheme, String), String> {
    let expected = "expected tcp/HOST:PORT or tls/HOST:PORT, like tls/192.168.1.10:7447";
    let (scheme, address) = endpoint.split_once('/').ok_or(expected)?;
    let scheme = match scheme {
        "tcp" => Scheme::Tcp,
        "tls" => Scheme::Tls,
        _ => return Err(expected.into()),
    };
    // What Zenoh takes after the address could undo what is set here.
    let (host, port) = address.rsplit_once(':').filter(|(host, _)| !host.is_empty()).ok_or(expected)?;
    if port.parse::<u16>().is_err() || address.contains(['#', '?', ';', '/', ' ']) {
        return Err(expected.into());
    }
    if host.contains(':') && address.parse::<SocketAddr>().is_err() {
        return Err(format!("{expected}; an IPv6 address stands in brackets, like tls/[fd00::1]:7447"));
    }
    Ok((scheme, host.into()))
}

/// Other names than `localhost` may lead anywhere.
fn is_loopback(host: &str) -> bool {
    let address = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || address.parse::<IpAddr>().is_ok_and(|address| address.to_canonical().is_loopback())
}

fn zenoh_config(config: &LinkConfig, keys: Option<&KeyFiles>) -> Value {
    let by_router = !config.endpoints.router.is_empty();
    let (mode, listen, connect) = match by_router {
        true => ("client", &Vec::new(), &config.endpoints.router),
        false => ("peer", &config.endpoints.listen, &config.endpoints.connect),
    };
    // -1: for ever, in the background. A client would not start before it is connected.
    let connect_millis = if by_router { i64::try_from(ROUTER_MILLIS).unwrap_or(0) } else { -1 };
    let [first, last] = RETRY_MILLIS;
    let retry = json!({"period_init_ms": first, "period_max_ms": last, "period_increase_factor": 2.0});
    let mut zenoh = json!({
        "mode": mode,
        "listen": {"endpoints": listen, "timeout_ms": 0, "exit_on_failure": true},
        "connect": {"endpoints": connect, "timeout_ms": connect_millis, "exit_on_failure": false, "retry": retry},
        "open": {"return_conditions": {"connect_scouted": false, "declares": false}},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "timestamping": {"enabled": false},
        "adminspace": {"enabled": false},
        "transport": {
            "unicast": {
                "open_timeout": ATTEMPT_MILLIS,
                "accept_timeout": ATTEMPT_MILLIS,
                "max_sessions": MAX_SESSIONS,
            },
            "link": {
                "protocols": [if keys.is_some() { "tls" } else { "tcp" }],
                "tx": {
                    "lease": LEASE_MILLIS,
                    "queue": {
                        "size": {"interactive_high": QUEUE_BATCHES, "data": QUEUE_BATCHES},
                        "congestion_control": {
                            "drop": {"wait_before_drop": DROP_MICROS},
                            "block": {"wait_before_close": BLOCK_MICROS},
                        },
                    },
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
            "shared_memory": {"enabled": false},
        },
    });
    if let Some(KeyFiles { authority, certificate, private_key }) = keys {
        zenoh["transport"]["link"]["tls"] = json!({
            "root_ca_certificate": authority,
            "enable_mtls": true,
            "listen_certificate": certificate,
            "listen_private_key": private_key,
            "connect_certificate": certificate,
            "connect_private_key": private_key,
            // A machine is known by its common name, wherever it is: that is what access control goes by.
            "verify_name_on_connect": false,
            "close_link_on_expiration": true,
        });
        zenoh["access_control"] = access::for_machine(config);
    }
    zenoh
}

fn open_error(config: &LinkConfig, found: &str) -> SessionError {
    // Zenoh adds where in its source it gave up.
    let found = found.split(" at /").next().unwrap_or(found);
    let machine = config.machine.clone();
    let endpoints = &config.endpoints;
    if !endpoints.router.is_empty() {
        return SessionError::Router { machine, endpoints: endpoints.router.join(", "), message: found.into() };
    }
    let help = if found.contains("os error 98") {
        "something else listens there: another graph or run of this machine? Give it another port"
    } else if found.contains("os error 99") {
        "this machine has no such address: `ip address` shows those that it has; tls/0.0.0.0:PORT listens on all"
    } else if found.contains("os error 13") {
        "ports below 1024 need the right to use them: take a higher one"
    } else if found.contains("lookup") || found.contains("resolve") {
        "nobody knows this name: write the address"
    } else {
        return SessionError::Zenoh { machine, message: found.into() };
    };
    SessionError::Listen { machine, endpoints: endpoints.listen.join(", "), message: format!("{help} ({found})") }
}

fn key_warnings(keys: &KeyFiles, now: OffsetDateTime) -> Vec<String> {
    use std::os::unix::fs::PermissionsExt;

    let mut warnings = Vec::new();
    for file in [&keys.certificate, &keys.authority] {
        let Some(found) = certificates::read(file).ok().and_then(|found| soonest(found, now)) else {
            continue;
        };
        let what = if found.is_authority { "the authority" } else { "the certificate" };
        warnings.push(format!(
            "{}: {what} '{}' ends on {}: renew it (docs/security.md)",
            file.display(),
            found.common_name,
            found.until()
        ));
    }
    if std::fs::metadata(&keys.private_key).is_ok_and(|found| found.permissions().mode() & 0o077 != 0) {
        let file = keys.private_key.display();
        warnings.push(format!("{file}: others on this machine can read this private key: chmod 600 {file}"));
    }
    warnings
}

/// The certificate that ends within [`RENEWAL`]; of several authorities only if none lasts longer.
fn soonest(found: Vec<CertificateSummary>, now: OffsetDateTime) -> Option<CertificateSummary> {
    let until = (now + RENEWAL).unix_timestamp();
    found.into_iter().max_by_key(|found| found.until_unix_secs).filter(|found| found.until_unix_secs < until)
}
