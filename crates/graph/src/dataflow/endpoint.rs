//! Where a machine can be reached: `tcp/HOST:PORT` or `tls/HOST:PORT`, as Zenoh writes it.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

/// Longest name of a host (RFC 1035).
const MAX_HOST_CHARS: usize = 253;

/// A Zenoh endpoint of the two kinds that machines are linked by. Displayed as it is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    /// Whether it is `tls/`, else `tcp/`.
    pub is_tls: bool,
    /// A name, an IPv4 address, or an IPv6 address without its brackets.
    pub host: String,
    /// The port, at least 1.
    pub port: u16,
}

impl Endpoint {
    /// Reads an endpoint.
    ///
    /// # Errors
    /// The protocol or the form is wrong; the error says what to write instead.
    pub fn parse(text: &str) -> Result<Self, String> {
        let like = "write it like tls/192.168.1.10:7447";
        let (is_tls, address) = match text.split_once('/') {
            Some(("tls", address)) => (true, address),
            Some(("tcp", address)) => (false, address),
            Some((protocol, _)) if protocol.bytes().all(|byte| byte.is_ascii_alphanumeric()) => {
                return Err("machines are linked by tcp or tls only; ".to_owned() + like);
            }
            _ => return Err(like.to_owned()),
        };
        let Some((host, port)) = address.rsplit_once(':') else {
            return Err("the port is missing; ".to_owned() + like);
        };
        let digits = !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit());
        let port = match port.parse::<u16>() {
            Ok(port) if digits && port > 0 => port,
            _ => return Err("a port is a number from 1 to 65535".to_owned()),
        };
        let host = match host.strip_prefix('[').map(|host| host.strip_suffix(']')) {
            Some(Some(address)) if address.parse::<Ipv6Addr>().is_ok() => address,
            Some(_) => return Err("what stands in brackets is an IPv6 address, like tls/[fd00::1]:7447".to_owned()),
            None if host.contains(':') => {
                return Err("an IPv6 address stands in brackets, like tls/[fd00::1]:7447".to_owned());
            }
            None if !is_host(host) => {
                return Err(format!("before the port stands a host's name or address; {like}"));
            }
            None => host,
        };
        Ok(Self { is_tls, host: host.to_owned(), port })
    }

    /// Whether only processes of the same computer can reach it: 127.0.0.0/8, `::1`, `localhost`.
    pub fn is_loopback(&self) -> bool {
        match self.host.parse::<IpAddr>() {
            Ok(address) => address.to_canonical().is_loopback(),
            Err(_) => self.host.eq_ignore_ascii_case("localhost"),
        }
    }

    /// Whether it stands for all addresses of a computer: a machine can listen there, but not connect to it.
    pub fn is_unspecified(&self) -> bool {
        self.host.parse::<IpAddr>().is_ok_and(|address| address.to_canonical().is_unspecified())
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let protocol = if self.is_tls { "tls" } else { "tcp" };
        match self.host.contains(':') {
            true => write!(f, "{protocol}/[{}]:{}", self.host, self.port),
            false => write!(f, "{protocol}/{}:{}", self.host, self.port),
        }
    }
}

/// A name of labels, or four numbers that are an address.
fn is_host(text: &str) -> bool {
    let is_label = |label: &str| {
        (1..=63).contains(&label.len())
            && !label.starts_with('-')
            && label.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_')
    };
    let last = text.rsplit('.').next().unwrap_or_default();
    let is_numeric = last.bytes().all(|byte| byte.is_ascii_digit());
    text.len() <= MAX_HOST_CHARS && text.split('.').all(is_label) && (!is_numeric || text.parse::<Ipv4Addr>().is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_read_and_written() {
        for (text, is_tls, host, port, is_loopback) in [
            ("tcp/127.0.0.1:7447", false, "127.0.0.1", 7447, true),
            ("tcp/127.8.9.1:1", false, "127.8.9.1", 1, true),
            ("tcp/LocalHost:7447", false, "LocalHost", 7447, true),
            ("tcp/[::1]:7447", false, "::1", 7447, true),
            ("tcp/[::ffff:127.0.0.1]:7447", false, "::ffff:127.0.0.1", 7447, true),
            ("tls/192.168.1.10:65535", true, "192.168.1.10", 65535, false),
            ("tls/gateway:7447", true, "gateway", 7447, false),
            ("tls/brain-2.lab_a.example:7447", true, "brain-2.lab_a.example", 7447, false),
            ("tls/[fd00::1]:7447", true, "fd00::1", 7447, false),
            ("tcp/localhost.example:7447", false, "localhost.example", 7447, false),
        ] {
            let endpoint = Endpoint::parse(text).expect(text);
            assert_eq!(endpoint, Endpoint { is_tls, host: host.into(), port });
            assert_eq!((endpoint.to_string().as_str(), endpoint.is_loopback()), (text, is_loopback));
            assert!(!endpoint.is_unspecified());
        }
        for text in ["tcp/0.0.0.0:7447", "tcp/[::]:7447"] {
            let endpoint = Endpoint::parse(text).expect(text);
            assert!(endpoint.is_unspecified() && !endpoint.is_loopback(), "{text}");
        }
    }

    #[test]
    fn other_endpoints_are_refused() {
        for (text, expected) in [
            ("", "write it like"),
            ("192.168.1.10:7447", "write it like"),
            ("udp/192.168.1.10:7447", "tcp or tls only"),
            ("TCP/192.168.1.10:7447", "tcp or tls only"),
            ("quic/[::1]:7447", "tcp or tls only"),
            ("tcp/192.168.1.10", "the port is missing"),
            ("tcp/192.168.1.10:", "1 to 65535"),
            ("tcp/192.168.1.10:0", "1 to 65535"),
            ("tcp/192.168.1.10:65536", "1 to 65535"),
            ("tcp/192.168.1.10:+7", "1 to 65535"),
            ("tcp/192.168.1.10:7447?rel=0", "1 to 65535"),
            ("tcp/192.168.1.10#iface=eth0:7447", "a host's name or address"),
            ("tcp/:7447", "a host's name or address"),
            ("tcp/a b:7447", "a host's name or address"),
            ("tcp/a..b:7447", "a host's name or address"),
            ("tcp/-a:7447", "a host's name or address"),
            ("tcp/256.1.1.1:7447", "a host's name or address"),
            ("tcp/1.2.3:7447", "a host's name or address"),
            ("tcp/::1:7447", "stands in brackets"),
            ("tcp/[::1:7447", "in brackets is an IPv6 address"),
            ("tcp/[gateway]:7447", "in brackets is an IPv6 address"),
            ("tcp/[fe80::1%eth0]:7447", "in brackets is an IPv6 address"),
        ] {
            let error = Endpoint::parse(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
        assert!(Endpoint::parse(&format!("tcp/{}:1", "a.".repeat(126) + "bb")).is_err());
    }
}
