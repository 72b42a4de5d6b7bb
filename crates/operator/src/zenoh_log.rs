//! What Zenoh says of itself, made fit for a graph's log: refused connections with their reason, once a minute each, and
//! warnings; nothing else.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::wiring::{LogEntry, LogLevel};

/// What the log must be given of Zenoh for [`ZenohLog::shaped`] to see: it tells failures to connect at `debug`.
pub(super) const ORCHESTRATOR: &str = "zenoh::net::runtime::orchestrator";
/// It tells at `info` when a certificate's name has no rights.
const ACCESS_CONTROL: &str = "zenoh::net::routing::interceptor::access_control";
/// The same line is not said again sooner.
const INTERVAL: Duration = Duration::from_secs(60);
/// More different lines than this are not told apart.
const MAX_LINES: usize = 256;

/// Lines that were said.
#[derive(Default)]
pub(super) struct ZenohLog {
    said: Mutex<BTreeMap<String, Said>>,
}

struct Said {
    at: Instant,
    n_held_back: u64,
}

impl ZenohLog {
    /// What becomes of an event: other libraries' and the operator's own stay as they are.
    pub(super) fn shaped(&self, target: &str, entry: LogEntry, now: Instant) -> Option<LogEntry> {
        // Zenoh says itself what its TLS library says.
        let is_of_tls = entry.fields.get("log.target").and_then(|target| target.as_str());
        if is_of_tls.is_some_and(|target| target.starts_with("rustls")) {
            return None;
        }
        if !target.starts_with("zenoh") {
            return Some(entry);
        }
        let (level, text) = reworded(target, entry.level?, &entry.text)?;
        let n_held_back = self.n_held_back(&text, now)?;
        let again = if n_held_back > 0 { format!(" ({n_held_back} times more since)") } else { String::new() };
        Some(LogEntry { level: Some(level), text: format!("{text}{again}"), ..LogEntry::default() })
    }

    /// How often a line was held back since it was last said; `None` if it is now as well.
    fn n_held_back(&self, text: &str, now: Instant) -> Option<u64> {
        let mut said = self.said.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        // Ports and times differ from one to the next.
        let key: String = text.chars().filter(|char| !char.is_ascii_digit()).collect();
        if let Some(before) = said.get_mut(&key) {
            if now.saturating_duration_since(before.at) < INTERVAL {
                before.n_held_back += 1;
                return None;
            }
            before.at = now;
            return Some(std::mem::take(&mut before.n_held_back));
        }
        if said.len() >= MAX_LINES {
            said.clear();
        }
        said.insert(key, Said { at: now, n_held_back: 0 });
        Some(0)
    }
}

fn reworded(target: &str, level: LogLevel, text: &str) -> Option<(LogLevel, String)> {
    if target == ORCHESTRATOR
        && let Some((endpoint, why)) =
            text.strip_prefix("Unable to connect to configured peer ").and_then(|rest| rest.split_once("! "))
    {
        let why = why.rsplit_once(". Retry in").map_or(why, |(why, _)| why);
        return Some(match refused_by(why) {
            Some(reason) => (LogLevel::Warn, format!("no link to {endpoint}: {reason}")),
            None => (LogLevel::Info, format!("no link to {endpoint} yet: {}", without_places(why))),
        });
    }
    if target == ACCESS_CONTROL && text.contains("did not match any configured ACL subject") {
        let text = "a connection was made with a certificate that names no machine of this graph and namespace: it may \
                    say and hear nothing (blindgrasp keys DIR --show lists names)";
        return Some((LogLevel::Warn, text.into()));
    }
    if level > LogLevel::Warn
        || text.starts_with("Skipping name verification")
        || text.starts_with("Gossip is disabled")
    {
        return None;
    }
    if let Some(reason) = target.starts_with("zenoh_link_tls").then(|| refused_here(text)).flatten() {
        return Some((LogLevel::Warn, format!("a connection to this machine was refused: {reason}")));
    }
    Some((level, format!("Zenoh: {}", without_places(text))))
}

/// Why a connection of this machine to another failed, if a certificate or TLS is the reason.
fn refused_by(why: &str) -> Option<&'static str> {
    Some(if why.contains("invalid peer certificate") {
        invalid_certificate(why)
    } else if why.contains("fatal alert: UnknownCA") || why.contains("fatal alert: DecryptError") {
        "it refuses this machine's certificate: the authority that signed it is not in ca.pem there"
    } else if why.contains("fatal alert: CertificateExpired") {
        "it refuses this machine's certificate, which has ended by the clock there"
    } else if why.contains("fatal alert: Certificate") || why.contains("fatal alert: BadCertificate") {
        "it refuses this machine's certificate"
    } else if why.contains("corrupt message") {
        "no TLS is spoken there: is its endpoint tcp/…?"
    } else if why.contains("TCP link") && why.contains("eof") {
        "it hangs up: is its endpoint tls/…?"
    } else {
        return None;
    })
}

/// Why another's connection to this machine failed, if a certificate or TLS is the reason.
fn refused_here(why: &str) -> Option<&'static str> {
    Some(if why.contains("peer sent no certificates") {
        "it showed no certificate"
    } else if why.contains("invalid peer certificate") {
        invalid_certificate(why)
    } else if why.contains("fatal alert: UnknownCA") || why.contains("fatal alert: DecryptError") {
        "it does not trust this machine's certificate: the authority that signed it is not in ca.pem there"
    } else if why.contains("fatal alert: CertificateExpired") {
        "it does not trust this machine's certificate, which has ended by the clock there"
    } else if why.contains("fatal alert") {
        "it does not trust this machine's certificate"
    } else if why.contains("corrupt message") {
        "it does not speak TLS"
    } else if why.contains("handshake eof") || why.contains("Timeout during TLS handshake") {
        "it did not finish the TLS handshake"
    } else {
        return None;
    })
}

/// What is wrong with the other's certificate.
fn invalid_certificate(why: &str) -> &'static str {
    if why.contains("UnknownIssuer") || why.contains("BadSignature") {
        "its certificate was signed by an authority that is not in ca.pem here"
    } else if why.contains("xpired") {
        "its certificate has ended: renew it there, or set the clock here"
    } else if why.contains("not valid yet") || why.contains("NotValidYet") {
        "its certificate does not count yet: set the clock here or where it was made"
    } else {
        "its certificate is not fit for this"
    }
}

/// Zenoh's errors say where in its source they were made, by the paths of the machine that built it.
fn without_places(text: &str) -> String {
    let mut words = Vec::new();
    let mut rest = text.split(' ').peekable();
    while let Some(word) = rest.next() {
        if word == "at" && rest.peek().is_some_and(|place| place.contains(".rs:")) {
            rest.next();
        } else {
            words.push(word);
        }
    }
    words.join(" ").trim_end_matches(['.', ' ']).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(level: LogLevel, text: &str) -> LogEntry {
        LogEntry { level: Some(level), ..LogEntry::plain(text) }
    }

    #[test]
    fn refusals_say_why_and_what_to_do() {
        let connecting =
            |why: &str| format!("Unable to connect to configured peer tls/127.0.0.1:7447! {why} Retry in 100ms.");
        // As Zenoh 1.10.2 says them.
        let issuer = "Can not create a new TLS link bound to IpAddress(V4(Ipv4Addr([127, 0, 0, 1]))): invalid peer \
                      certificate: UnknownIssuer at /home/a/zenoh-link-tls-1.10.2/src/unicast.rs:378..";
        let expired = "received fatal alert: CertificateExpired at /home/a/zenoh-link-tls-1.10.2/src/unicast.rs:226..";
        let nobody = "Can not create a new TLS link: Connection refused (os error 111) at /home/a/src/unicast.rs:61..";
        let here = "peer sent no certificates. Hint: increase the system open file limit.";
        let cases = [
            (
                ORCHESTRATOR,
                LogLevel::Debug,
                connecting(issuer),
                "WARN no link to tls/127.0.0.1:7447: its certificate was signed by",
            ),
            (
                ORCHESTRATOR,
                LogLevel::Debug,
                connecting(expired),
                "WARN no link to tls/127.0.0.1:7447: it refuses this machine's certificate, which has ended",
            ),
            (
                ORCHESTRATOR,
                LogLevel::Debug,
                connecting(nobody),
                "INFO no link to tls/127.0.0.1:7447 yet: Can not create a new TLS link: Connection refused (os error 111)",
            ),
            (
                "zenoh_link_tls::unicast",
                LogLevel::Warn,
                here.into(),
                "WARN a connection to this machine was refused: it showed no certificate",
            ),
            ("zenoh_link_tcp::unicast", LogLevel::Error, "broken at /a/b.rs:7.".into(), "ERROR Zenoh: broken"),
        ];
        for (target, level, text, expected) in cases {
            let shaped =
                ZenohLog::default().shaped(target, entry(level, &text), Instant::now()).expect("said").to_string();
            assert!(shaped.starts_with(expected) && !shaped.contains(".rs"), "{shaped}");
        }
    }

    #[test]
    fn the_rest_of_what_zenoh_says_is_not_said() {
        let log = ZenohLog::default();
        let now = Instant::now();
        for (target, level, text) in [
            ("zenoh::net::runtime", LogLevel::Info, "Using ZID: 51bc"),
            (ORCHESTRATOR, LogLevel::Debug, "Try to connect: tls/127.0.0.1:1"),
            ("zenoh_link_tls::utils", LogLevel::Warn, "Skipping name verification of TLS server"),
        ] {
            assert_eq!(log.shaped(target, entry(level, text), now), None, "{text}");
        }
        let mut of_tls = entry(LogLevel::Warn, "Illegal SNI extension");
        of_tls.fields.insert("log.target".into(), "rustls::msgs::handshake".into());
        assert_eq!(log.shaped("log", of_tls, now), None);
        let own = entry(LogLevel::Info, "hello");
        assert_eq!(log.shaped("my_operator", own.clone(), now), Some(own));
    }

    #[test]
    fn a_line_comes_once_a_minute_and_says_how_often_it_was_held_back() {
        let log = ZenohLog::default();
        let start = Instant::now();
        let say = |after_secs: u64, port: u16| {
            let text = format!("Read error on 127.0.0.1:{port}");
            let entry = entry(LogLevel::Warn, &text);
            log.shaped("zenoh_transport", entry, start + Duration::from_secs(after_secs)).map(|entry| entry.to_string())
        };
        assert_eq!(say(0, 1).as_deref(), Some("WARN Zenoh: Read error on 127.0.0.1:1"));
        assert_eq!(say(1, 2), None);
        assert_eq!(say(59, 3), None);
        assert_eq!(say(60, 4).as_deref(), Some("WARN Zenoh: Read error on 127.0.0.1:4 (2 times more since)"));
        assert_eq!(say(121, 5).as_deref(), Some("WARN Zenoh: Read error on 127.0.0.1:5"));
    }
}
