//! Where a machine can be reached: `tls/HOST:PORT`, `tcp/HOST:PORT`, or `unix/NAME` on one computer.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use blindgrasp_operator::text::is_name;

/// Longest name of a host (RFC 1035).
const MAX_HOST_CHARS: usize = 253;
const LIKE: &str = "write it like tls/192.168.1.10:7447";

/// An endpoint of one of the three kinds that machines are linked by. Displayed as it is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Endpoint {
    /// A socket in a folder of this user alone, between machines of the file that are one computer.
    Unix { name: String },
    /// With certificates. The host is a name, an IPv4 address, or an IPv6 address without its brackets.
    Tls { host: String, port: u16 },
    /// Open to everybody who can reach it.
    Tcp { host: String, port: u16 },
}

impl Endpoint {
    /// Reads an endpoint.
    ///
    /// # Errors
    /// The protocol or the form is wrong; the error says what to write instead.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (protocol, address) = text.split_once('/').ok_or(LIKE)?;
        match protocol {
            "unix" if is_name(address) => Ok(Self::Unix { name: address.to_owned() }),
            "unix" => Err("a name has letters, digits, _ and -, like unix/gate".to_owned()),
            "tls" => read_address(address).map(|(host, port)| Self::Tls { host, port }),
            "tcp" => read_address(address).map(|(host, port)| Self::Tcp { host, port }),
            _ if protocol.bytes().all(|byte| byte.is_ascii_alphanumeric()) => {
                Err(format!("machines are linked by tls, tcp or unix only; {LIKE}"))
            }
            _ => Err(LIKE.to_owned()),
        }
    }

    /// Whether it stands for all addresses of a computer: a machine can listen there, but not connect to it.
    pub fn is_unspecified(&self) -> bool {
        match self {
            Self::Unix { .. } => false,
            Self::Tls { host, .. } | Self::Tcp { host, .. } => {
                host.parse::<IpAddr>().is_ok_and(|address| address.to_canonical().is_unspecified())
            }
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (protocol, host, port) = match self {
            Self::Unix { name } => return write!(f, "unix/{name}"),
            Self::Tls { host, port } => ("tls", host, port),
            Self::Tcp { host, port } => ("tcp", host, port),
        };
        if host.contains(':') { write!(f, "{protocol}/[{host}]:{port}") } else { write!(f, "{protocol}/{host}:{port}") }
    }
}

/// `HOST:PORT`
fn read_address(address: &str) -> Result<(String, u16), String> {
    let (host, port) = address.rsplit_once(':').ok_or_else(|| format!("the port is missing; {LIKE}"))?;
    let digits = !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit());
    let port = match port.parse::<u16>() {
        Ok(port) if digits && port > 0 => port,
        _ => return Err("a port is a number from 1 to 65535".to_owned()),
    };
    let host = match host.strip_prefix('[').map(|host| host.strip_suffix(']')) {
        Some(Some(address)) if address.parse::<Ipv6Addr>().is_ok() => address,
        Some(_) => return Err("the text in brackets must be an IPv6 address, like tls/[fd00::1]:7447".to_owned()),
        None if host.contains(':') => {
            return Err("an IPv6 address stands in brackets, like tls/[fd00::1]:7447".to_owned());
        }
        None if !is_host(host) => return Err(format!("a host's name or address stands before the port; {LIKE}")),
        None => host,
    };
    Ok((host.to_owned(), port))
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
        for (text, is_tls, host, port) in [
            ("tcp/127.0.0.1:7447", false, "127.0.0.1", 7447),
            ("tcp/LocalHost:7447", false, "LocalHost", 7447),
            ("tcp/[::ffff:127.0.0.1]:7447", false, "::ffff:127.0.0.1", 7447),
            ("tls/192.168.1.10:65535", true, "192.168.1.10", 65535),
            ("tls/gateway:7447", true, "gateway", 7447),
            ("tls/brain-2.lab_a.example:7447", true, "brain-2.lab_a.example", 7447),
            ("tls/[fd00::1]:7447", true, "fd00::1", 7447),
        ] {
            let endpoint = Endpoint::parse(text).expect(text);
            let host = host.to_owned();
            assert_eq!(endpoint, if is_tls { Endpoint::Tls { host, port } } else { Endpoint::Tcp { host, port } });
            assert_eq!(endpoint.to_string(), text);
            assert!(!endpoint.is_unspecified());
        }
        for text in ["tcp/0.0.0.0:7447", "tls/[::]:7447"] {
            assert!(Endpoint::parse(text).expect(text).is_unspecified(), "{text}");
        }
        let unix = Endpoint::parse("unix/gate-2").expect("a name");
        assert_eq!((unix.to_string().as_str(), unix.is_unspecified()), ("unix/gate-2", false));
    }

    #[test]
    fn other_endpoints_are_refused() {
        for (text, expected) in [
            ("", "write it like"),
            ("192.168.1.10:7447", "write it like"),
            ("udp/192.168.1.10:7447", "tls, tcp or unix only"),
            ("TCP/192.168.1.10:7447", "tls, tcp or unix only"),
            ("quic/[::1]:7447", "tls, tcp or unix only"),
            ("unix/", "letters, digits"),
            ("unix//tmp/gate", "letters, digits"),
            ("unix/../gate", "letters, digits"),
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
            ("tcp/[::1:7447", "in brackets must be an IPv6 address"),
            ("tcp/[gateway]:7447", "in brackets must be an IPv6 address"),
            ("tcp/[fe80::1%eth0]:7447", "in brackets must be an IPv6 address"),
        ] {
            let error = Endpoint::parse(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
        assert!(Endpoint::parse(&format!("tcp/{}:1", "a.".repeat(126) + "bb")).is_err());
    }
}
