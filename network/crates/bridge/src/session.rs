//! The Zenoh session of a link: explicit endpoints, mutual TLS, access control, no discovery.

use serde_json::{Value, json};
use time::OffsetDateTime;
use zenoh::{Config, Session, Wait};

use super::access;
use super::certificates::{self, CertificateError, CertificateSummary, RENEWAL};
use super::wire::MAX_FRAME_BYTES;
use blindgrasp_graph::dataflow::Endpoint;
use blindgrasp_graph::link::config::{KeyFiles, LinkConfig};
use blindgrasp_operator::control_socket;

/// Maximum length of Zenoh's sending queue in batches: the largest value that Zenoh allows.
const QUEUE_BATCHES: usize = 16;
/// A message that waits longer for the connection is dropped and requested again. This is below the shortest
/// deadline.
const DROP_MICROS: i64 = 15_000;
/// Zenoh closes a connection after this silence. The link itself notices silence sooner: see
/// [`LinkConfig::deadline_millis`].
const LEASE_MILLIS: u64 = 2000;
/// First and longest pause between two attempts to connect; each pause is twice as long as the one before.
const RETRY_MILLIS: [u64; 2] = [100, 1000];
/// Time limit of one attempt, with TLS.
const ATTEMPT_MILLIS: u64 = 3000;
/// Time for which [`open`] waits for a router.
const ROUTER_MILLIS: u64 = 2000;
/// Zenoh drops longer messages. This is more than the maximum size of a frame, so that the link itself can count frames
/// that are too long.
const MAX_MESSAGE_BYTES: usize = 2 * MAX_FRAME_BYTES;
/// Two machines that both listen and dial may have two links.
const MAX_LINKS: usize = 2;
/// Maximum number of connections beyond one for each other machine of the file. A restarted machine comes back before
/// Zenoh has noticed the end of its old connection, and one certificate must not take all places.
const MORE_SESSIONS: usize = 8;

/// Why there is no session.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// An endpoint is not valid or not allowed.
    #[error("machine '{machine}': endpoint '{endpoint}': {message}")]
    Endpoint { machine: String, endpoint: String, message: String },
    #[error(
        "machine '{0}' does not listen and has no other machine or router to connect to: give one of the machines \
         `listen`, like tls/192.168.1.10:7447"
    )]
    NoEndpoint(String),
    /// The machine's certificate or key cannot be used.
    #[error("machine '{machine}': {source}")]
    Keys { machine: String, source: CertificateError },
    /// This machine cannot listen at its endpoints.
    #[error("machine '{machine}' cannot listen on {endpoints}: {message}")]
    Listen { machine: String, endpoints: String, message: String },
    /// No router has answered yet. It may be started later, so that another attempt makes sense.
    #[error("machine '{machine}' cannot reach the router {endpoints} yet: {message}")]
    Router { machine: String, endpoints: String, message: String },
    /// Zenoh rejects the configuration.
    #[error("machine '{machine}': Zenoh does not start: {message}")]
    Zenoh { machine: String, message: String },
}

impl SessionError {
    /// Whether the next attempt may succeed without a change on this machine.
    pub fn is_passing(&self) -> bool {
        matches!(self, SessionError::Router { .. })
    }
}

/// Opens the session. Other machines may be started later: Zenoh tries to connect until it succeeds, also after a
/// connection breaks.
///
/// A router must answer within some seconds. Otherwise the error [is passing](SessionError::is_passing).
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
    let refused = |message: String| SessionError::Zenoh { machine: machine.clone(), message };
    let zenoh_config = zenoh_config(config, keys).map_err(|error| refused(error.to_string()))?;
    let zenoh_config = Config::from_json5(&zenoh_config.to_string()).map_err(|error| refused(error.to_string()))?;
    zenoh::open(zenoh_config).wait().map_err(|error| open_error(config, &error.to_string()))
}

/// Warnings about a link that can be started: it has no TLS, or its certificate ends soon.
pub fn warning(config: &LinkConfig) -> Option<String> {
    let mut warnings = Vec::new();
    let open: Vec<&str> =
        endpoints(config).filter(|it| matches!(Endpoint::parse(it), Ok(Endpoint::Tcp { .. }))).collect();
    // With keys, links sign and encrypt by themselves.
    if config.insecure && !open.is_empty() && config.keys.is_none() {
        warnings.push(format!(
            "insecure: {} without TLS: everybody who can reach it can read all samples of the graph, and send samples in the \
             name of any machine",
            open.join(", ")
        ));
    }
    if let Some(keys) = &config.keys {
        warnings.extend(key_warnings(keys, OffsetDateTime::now_utc()));
    }
    (!warnings.is_empty()).then(|| warnings.join("; "))
}

fn endpoints(config: &LinkConfig) -> impl Iterator<Item = &str> {
    let endpoints = &config.endpoints;
    let used = if endpoints.router.is_empty() {
        [&endpoints.listen, &endpoints.connect].map(Vec::as_slice)
    } else {
        [endpoints.router.as_slice(), &[]]
    };
    used.into_iter().flatten().map(String::as_str)
}

/// Checks the endpoints, and returns the keys if they are needed.
fn checked(config: &LinkConfig) -> Result<Option<&KeyFiles>, SessionError> {
    let refused = |endpoint: &str, message: String| SessionError::Endpoint {
        machine: config.machine.clone(),
        endpoint: endpoint.into(),
        message,
    };
    let mut parsed = Vec::new();
    for text in endpoints(config) {
        let endpoint = Endpoint::parse(text)
            .map_err(|help| refused(text, format!("expected tls/HOST:PORT, tcp/HOST:PORT or unix/NAME; {help}")))?;
        let message = match &endpoint {
            Endpoint::Tcp { .. } if !config.insecure => Some(
                "this endpoint has no TLS. Use tls/… with `link: {keys: DIR}` (`blindgrasp keys DIR` makes keys), or \
                 unix/NAME between machines that are one computer, or `link: {insecure: true}` if nobody else can reach it"
                    .to_owned(),
            ),
            Endpoint::Tls { .. } if config.keys.is_none() => Some(
                "TLS needs this machine's certificate: `link: {keys: DIR}` or --keys DIR (`blindgrasp keys DIR` makes keys)"
                    .to_owned(),
            ),
            _ => None,
        };
        if let Some(message) = message {
            return Err(refused(text, message));
        }
        parsed.push((text, matches!(endpoint, Endpoint::Tls { .. })));
    }
    if parsed.is_empty() {
        return Err(SessionError::NoEndpoint(config.machine.clone()));
    }
    let has_tls = parsed.iter().any(|(_, is_tls)| *is_tls);
    match parsed.iter().find(|(_, is_tls)| !is_tls) {
        // A connection without TLS has no common name, and so no rights.
        Some((text, _)) if has_tls => {
            Err(refused(text, "this machine's other endpoints use TLS: make this one tls/… as well".into()))
        }
        _ if has_tls => Ok(config.keys.as_ref()),
        _ => Ok(None),
    }
}

/// The endpoints as Zenoh writes them.
///
/// # Errors
/// The folder of sockets cannot be made, or is open to other users.
fn of_zenoh(endpoints: &[String]) -> std::io::Result<Vec<String>> {
    let mut written = Vec::new();
    for endpoint in endpoints {
        written.push(match Endpoint::parse(endpoint) {
            Ok(Endpoint::Unix { name }) => format!("unixsock-stream/{}", control_socket::link_path(&name)?.display()),
            _ => endpoint.clone(),
        });
    }
    Ok(written)
}

fn zenoh_config(config: &LinkConfig, keys: Option<&KeyFiles>) -> std::io::Result<Value> {
    let by_router = !config.endpoints.router.is_empty();
    let (mode, listen, connect) = if by_router {
        ("client", &Vec::new(), &config.endpoints.router)
    } else {
        ("peer", &config.endpoints.listen, &config.endpoints.connect)
    };
    let (listen, connect) = (of_zenoh(listen)?, of_zenoh(connect)?);
    // -1 means for ever, in the background. A client (with a router) would not start before it is connected.
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
                "max_sessions": config.peers.len() + MORE_SESSIONS,
                // Zenoh looks at a certificate once per connection, and a connection is known by a number that is no secret:
                // without this, a link of a stranger with that number joins it unseen. With it, all links of a connection
                // must show one key, which the stranger has not.
                "max_links": MAX_LINKS,
            },
            "link": {
                "protocols": if keys.is_some() { vec!["tls"] } else { vec!["tcp", "unixsock-stream"] },
                "tx": {
                    "lease": LEASE_MILLIS,
                    "queue": {
                        "size": {"interactive_high": QUEUE_BATCHES, "data": QUEUE_BATCHES},
                        "congestion_control": {
                            "drop": {"wait_before_drop": DROP_MICROS},
                        },
                    },
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
            "shared_memory": {"enabled": false},
        },
    });
    if let Some(keys) = keys {
        zenoh["transport"]["link"]["tls"] = tls_config(keys);
        zenoh["access_control"] = access::for_machine(config);
    }
    Ok(zenoh)
}

/// TLS with these files. A machine's address does not matter: access control goes by the common name of its certificate, which
/// may bear no address. Public authorities, which Zenoh's connecting side accepts as well, sign no name without a dot.
pub(super) fn tls_config(KeyFiles { authority, certificate, private_key }: &KeyFiles) -> Value {
    json!({
        "root_ca_certificate": authority,
        "enable_mtls": true,
        "listen_certificate": certificate,
        "listen_private_key": private_key,
        "connect_certificate": certificate,
        "connect_private_key": private_key,
        "verify_name_on_connect": false,
        "close_link_on_expiration": true,
    })
}

fn open_error(config: &LinkConfig, found: &str) -> SessionError {
    // Zenoh appends the place in its source code.
    let found = found.split(" at /").next().unwrap_or(found);
    let machine = config.machine.clone();
    let endpoints = &config.endpoints;
    if !endpoints.router.is_empty() {
        return SessionError::Router { machine, endpoints: endpoints.router.join(", "), message: found.into() };
    }
    let help = if found.contains("os error 98") {
        "the port is in use, perhaps by another graph or run on this machine; use another port"
    } else if found.contains("os error 99") {
        "this machine does not have this address; `ip address` shows its addresses, and tls/0.0.0.0:PORT listens on all of them"
    } else if found.contains("os error 13") {
        "this process has no right to use a port below 1024; use a higher port"
    } else if found.contains("acquire lock") {
        "another graph of this user listens there; use another name"
    } else if found.contains("lookup") || found.contains("resolve") {
        "the host name does not resolve; use an IP address"
    } else {
        return SessionError::Zenoh { machine, message: found.into() };
    };
    SessionError::Listen { machine, endpoints: endpoints.listen.join(", "), message: format!("{help} ({found})") }
}

fn key_warnings(keys: &KeyFiles, now: OffsetDateTime) -> Vec<String> {
    let mut warnings = Vec::new();
    for file in [&keys.certificate, &keys.authority] {
        let Some(found) = certificates::read(file).ok().and_then(|found| soonest(found, now)) else { continue };
        let kind = if found.is_authority { "the authority" } else { "the certificate" };
        warnings.push(format!(
            "{}: {kind} '{}' ends on {}: renew it (docs/security.md)",
            file.display(),
            found.common_name,
            found.until()
        ));
    }
    warnings
}

/// The certificate that ends within [`RENEWAL`]. Of several authorities, only the one that ends last counts.
fn soonest(found: Vec<CertificateSummary>, now: OffsetDateTime) -> Option<CertificateSummary> {
    let until = (now + RENEWAL).unix_timestamp();
    found.into_iter().max_by_key(|found| found.until_unix_secs).filter(|found| found.until_unix_secs < until)
}
