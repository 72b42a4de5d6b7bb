//! A running graph's figures for Prometheus: OpenMetrics text over HTTP, on the loopback interface only.
//!
//! Each request is answered from the graph's status at that moment ([`GraphStatus`]); without requests it costs
//! nothing. A client's request's head is read, answered, and the connection closed. Other users of this machine can ask
//! as well; a web page of elsewhere cannot, because its requests bear another host's name.

use std::fmt;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, Ipv6Addr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};

use crate::client;
use crate::client::usage::{ProcessUsage, usage};
use crate::control::{EdgeStatus, GraphState, GraphStatus, NodeState, NodeStatus};
use blindgrasp_messages::Reason;
use blindgrasp_operator::ages::Ages;
use blindgrasp_operator::link_status::{ChannelStatus, LinkStatus, PeerState};

/// A client must send its request, and then read the answer, within this time each.
const CLIENT_LIMIT: Duration = Duration::from_millis(500);
/// This many clients are served at a time; further clients are turned away.
const MAX_CLIENTS: usize = 8;
/// The pause after a failure to accept a client: without descriptors, the next attempt fails at once.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// The longest head of a request.
const MAX_HEAD_BYTES: usize = 16 << 10;
const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Bounds of the histogram of ages, seconds.
const AGE_BOUNDS_SECS: [f64; 16] =
    [0.0001, 0.000_25, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0];

/// Listens on a port of the loopback interface; 0 is any free port.
///
/// # Errors
/// The port is taken.
pub fn listen(port: u16) -> std::io::Result<TcpListener> {
    match TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
        // A machine of IPv6 alone has only the other address.
        Err(error) if error.kind() == std::io::ErrorKind::AddrNotAvailable => {
            TcpListener::bind((Ipv6Addr::LOCALHOST, port))
        }
        bound => bound,
    }
}

/// Answers clients on threads of their own, until the process ends.
pub fn serve(listener: TcpListener, graph: String) {
    let graph = Arc::new(graph);
    std::thread::spawn(move || {
        for client in listener.incoming() {
            let Ok(client) = client else {
                std::thread::sleep(RETRY_PAUSE);
                continue;
            };
            // Each thread holds the name while it serves a client.
            if Arc::strong_count(&graph) <= MAX_CLIENTS {
                let graph = Arc::clone(&graph);
                std::thread::spawn(move || answer(&client, &graph));
            }
        }
    });
}

/// A graph's figures as OpenMetrics text.
///
/// # Errors
/// The encoder fails.
pub fn text(status: GraphStatus) -> Result<String, fmt::Error> {
    let usages = status.nodes.iter().map(|node| node.pid.and_then(usage)).collect();
    let mut registry = Registry::with_prefix("blindgrasp");
    registry.register_collector(Box::new(Figures { status, usages }));
    let mut text = String::new();
    prometheus_client::encoding::text::encode(&mut text, &registry)?;
    Ok(text)
}

fn answer(client: &TcpStream, graph: &str) -> std::io::Result<()> {
    client.set_write_timeout(Some(CLIENT_LIMIT))?;
    let head = head_of_request(client);
    let request = head.lines().next().unwrap_or_default();
    let plain = "text/plain; charset=utf-8";
    let mut words = request.split(' ');
    let (method, path) = (words.next(), words.next().and_then(|path| path.split('?').next()));
    let (status, content_type, body) = match (method, path) {
        _ if !is_for_loopback(&head) => {
            ("403 Forbidden", plain, "expected Host: localhost, 127.0.0.1 or [::1], with or without a port\n".into())
        }
        (Some("GET" | "HEAD"), Some("/metrics" | "/")) => match client::status(graph) {
            Ok(status) => match text(status) {
                Ok(text) => ("200 OK", CONTENT_TYPE, text),
                Err(error) => ("500 Internal Server Error", plain, format!("{error}\n")),
            },
            Err(error) => ("503 Service Unavailable", plain, format!("{error}\n")),
        },
        (Some("GET" | "HEAD"), Some(_)) => ("404 Not Found", plain, "the metrics are at /metrics\n".into()),
        _ => ("405 Method Not Allowed", plain, "expected GET /metrics\n".into()),
    };
    let mut response = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    if !request.starts_with("HEAD ") {
        response += &body;
    }
    let mut client = client;
    client.write_all(response.as_bytes())?;
    client.shutdown(std::net::Shutdown::Write)
}

/// Whether the request names a host of the loopback interface, or none. A browser always sends the name by which it has
/// found the host, so that a web page cannot read the figures through a name that leads here (DNS rebinding).
fn is_for_loopback(head: &str) -> bool {
    let fields = head.lines().skip(1).filter_map(|line| line.split_once(':'));
    let mut hosts = fields.filter(|(name, _)| name.trim().eq_ignore_ascii_case("host")).map(|(_, host)| host.trim());
    hosts.all(|host| {
        let port_idx = host.rfind(':').filter(|idx| host[idx + 1..].bytes().all(|byte| byte.is_ascii_digit()));
        let name = &host[..port_idx.unwrap_or(host.len())];
        ["localhost", "127.0.0.1", "[::1]"].iter().any(|known| name.eq_ignore_ascii_case(known))
    })
}

/// The head of a request. All of it must be read: closing before that would cut the answer off. A slow client, or one
/// that sends too much, is answered by what has come.
fn head_of_request(mut client: &TcpStream) -> String {
    let start = Instant::now();
    let mut head = Vec::new();
    let mut bytes = [0; 1024];
    while head.len() < MAX_HEAD_BYTES && !head.ends_with(b"\r\n\r\n") && head != b"\r\n" {
        let left = CLIENT_LIMIT.saturating_sub(start.elapsed());
        if left.is_zero() || client.set_read_timeout(Some(left)).is_err() {
            break;
        }
        match client.read(&mut bytes) {
            Ok(n_bytes @ 1..) => head.extend_from_slice(&bytes[..n_bytes]),
            _ => break,
        }
    }
    String::from_utf8_lossy(&head).into_owned()
}

#[derive(Debug)]
struct Figures {
    status: GraphStatus,
    /// By node, in the graph's order.
    usages: Vec<Option<ProcessUsage>>,
}

type Labels<'a> = Vec<(&'static str, &'a str)>;
type Count = fn(&EdgeStatus) -> u64;
type ChannelCount = fn(&ChannelStatus) -> u64;

impl Collector for Figures {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        let encoder = &mut encoder;
        let (of_graph, decisions) = (("graph", self.status.graph.as_str()), &self.status.decisions);
        let is_up = flag(self.status.state == GraphState::Running);
        gauge(encoder, "up", "1 if the graph runs and no operator was given up", None, [(vec![of_graph], is_up)])?;
        let uptime = [(vec![of_graph], self.status.uptime_secs)];
        gauge(encoder, "uptime", "How long the graph has been running", Some(Unit::Seconds), uptime)?;
        self.nodes(encoder)?;
        self.edges(encoder)?;
        if let Some(link) = &self.status.link {
            self.link(link, encoder)?;
        }
        let mut decided =
            vec![(vec![of_graph, ("action", "lift"), ("reason", Reason::Stable.as_str())], decisions.n_lift)];
        for (reason, n) in &decisions.holds {
            decided.push((vec![of_graph, ("action", "hold"), ("reason", reason)], *n));
        }
        counter(encoder, "decisions", "Grasps decided", decided)?;
        let help = "Grasps lifted that were unstable, where the source knows the truth";
        counter(encoder, "false_positives", help, [(vec![of_graph], decisions.n_false_positives)])
    }
}

impl Figures {
    fn nodes(&self, encoder: &mut DescriptorEncoder) -> fmt::Result {
        let nodes = || self.status.nodes.iter().map(|node| (self.node_labels(node), node));
        let used = || nodes().zip(&self.usages).filter_map(|((labels, _), usage)| Some((labels, (*usage)?)));
        let up =
            nodes().map(|(labels, node)| (labels, flag(matches!(node.state, NodeState::Running | NodeState::Done))));
        gauge(encoder, "node_up", "1 if the node answers samples, or has done its work", None, up)?;
        let restarts = nodes().map(|(labels, node)| (labels, node.n_restarts.into()));
        counter(encoder, "node_restarts", "Times that the node was started again after a failure", restarts)?;
        let swaps = nodes().map(|(labels, node)| (labels, node.n_swaps.into()));
        counter(encoder, "node_swaps", "Times that the node was swapped", swaps)?;
        let ages = nodes().filter_map(|(labels, node)| Some((labels, node.heartbeat_age_millis? as f64 / 1e3)));
        gauge(encoder, "node_heartbeat_age", "Since the last heartbeat", Some(Unit::Seconds), ages)?;
        // It begins at 0 with each process, as Prometheus expects of a counter.
        let help = "Processor time of the node's active process";
        let mut metric = encoder.encode_descriptor("node_cpu", help, Some(&Unit::Seconds), MetricType::Counter)?;
        for (labels, usage) in used() {
            ConstCounter::new(usage.cpu_secs).encode(metric.encode_family(&labels)?)?;
        }
        let help = "Memory of the node's active process, shared memory included";
        let memory = used().map(|(labels, usage)| (labels, usage.resident_bytes as f64));
        gauge(encoder, "node_resident_memory", help, Some(Unit::Bytes), memory)?;
        let mut events = Vec::new();
        for (labels, node) in nodes() {
            for (kind, count) in &node.counts {
                events.push(([&labels[..], &[("kind", kind.as_str())]].concat(), *count));
            }
        }
        counter(encoder, "node_events", "Other counts of the node, by kind", events)
    }

    fn link(&self, link: &LinkStatus, encoder: &mut DescriptorEncoder) -> fmt::Result {
        let of_graph = ("graph", self.status.graph.as_str());
        let peers = || link.peers.iter().map(|peer| (vec![of_graph, ("machine", peer.machine.as_str())], peer));
        let up = peers().map(|(labels, peer)| (labels, flag(peer.state == PeerState::Up)));
        gauge(encoder, "machine_up", "1 if the other machine is linked", None, up)?;
        let round_trips = peers().filter_map(|(labels, peer)| Some((labels, peer.round_trip_nanos? as f64 / 1e9)));
        let help = "To the other machine and back, median";
        gauge(encoder, "machine_round_trip", help, Some(Unit::Seconds), round_trips)?;
        let counts: [(&str, &str, ChannelCount); 3] = [
            ("channel_samples", "Samples that went to or came from the other machine, each once", |c| c.n_samples),
            ("channel_repeated", "Samples that went or came again", |c| c.n_repeated),
            ("channel_lost", "Samples given up for the other machine", |c| c.n_lost),
        ];
        for (name, help, count) in counts {
            let mut channels = Vec::new();
            for (labels, peer) in peers() {
                for channel in &peer.channels {
                    let direction = if channel.is_sent { "to" } else { "from" };
                    let of_channel = [("port", channel.port.as_str()), ("direction", direction)];
                    channels.push(([&labels[..], &of_channel].concat(), count(channel)));
                }
            }
            counter(encoder, name, help, channels)?;
        }
        let rejected = link.rejected.iter().map(|(why, count)| (vec![of_graph, ("why", why.as_str())], *count));
        counter(encoder, "link_rejected", "Messages of other machines dropped unread, by why", rejected)
    }

    fn edges(&self, encoder: &mut DescriptorEncoder) -> fmt::Result {
        let edges = || self.status.edges.iter().map(|edge| (self.edge_labels(edge), edge));
        let counts: [(&str, &str, Count); 7] = [
            ("edge_sent", "Samples sent, each counted once", |edge| edge.sent),
            ("edge_received", "Samples received, each counted once", |edge| edge.received),
            ("edge_missing", "Sequence numbers missing in the samples received", |edge| edge.missing),
            ("edge_repeated", "Samples that came again after a restart; each was used once", |edge| edge.repeated),
            ("edge_reordered", "Samples that came early and were put in order", |edge| edge.reordered),
            ("edge_late", "Samples older than the edge's deadline", |edge| edge.late),
            ("edge_blocked_nanoseconds", "How long the writer has waited for its readers", |edge| edge.blocked_nanos),
        ];
        for (name, help, count) in counts {
            counter(encoder, name, help, edges().map(|(labels, edge)| (labels, count(edge))))?;
        }
        // Not a counter: while samples are on their way it is not known.
        let help = "Samples dropped for newer ones on a latest edge, lost on a lossless one";
        let dropped = edges().map(|(labels, edge)| (labels, edge.dropped as f64));
        gauge(encoder, "edge_dropped", help, None, dropped)?;
        let help = "Age of samples on arrival since their source published them";
        let mut metric = encoder.encode_descriptor("edge_age", help, Some(&Unit::Seconds), MetricType::Histogram)?;
        for (labels, edge) in edges() {
            let (sum_secs, buckets) = age_buckets(&edge.ages);
            let mut metric = metric.encode_family(&labels)?;
            metric.encode_histogram::<NoLabelSet>(sum_secs, edge.ages.n_samples(), &buckets, None)?;
        }
        Ok(())
    }

    fn node_labels<'a>(&'a self, node: &'a NodeStatus) -> Labels<'a> {
        vec![("graph", &self.status.graph), ("node", &node.node)]
    }

    fn edge_labels<'a>(&'a self, edge: &'a EdgeStatus) -> Labels<'a> {
        vec![("graph", &self.status.graph), ("from", &edge.from), ("to", &edge.to)]
    }
}

/// The sum of ages in seconds, to within 3 %, and the number of samples between each bound and the one before.
fn age_buckets(ages: &Ages) -> (f64, Vec<(f64, u64)>) {
    let mut buckets: Vec<(f64, u64)> =
        AGE_BOUNDS_SECS.into_iter().chain([f64::INFINITY]).map(|bound| (bound, 0)).collect();
    let mut sum_secs = 0.0;
    for &(upper_nanos, count) in ages.buckets() {
        let upper_secs = upper_nanos as f64 / 1e9;
        // The middle of a bucket that is a seventeenth of its upper bound wide.
        sum_secs += count as f64 * upper_secs * (1.0 - 0.5 / 17.0);
        // A bucket that a bound cuts through counts above the bound, so that no sample looks younger than it was.
        if let Some(bucket) = buckets.iter_mut().find(|(bound, _)| upper_secs <= *bound) {
            bucket.1 += count;
        }
    }
    (sum_secs, buckets)
}

fn counter<'a>(
    encoder: &mut DescriptorEncoder,
    name: &str,
    help: &str,
    figures: impl IntoIterator<Item = (Labels<'a>, u64)>,
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, None, MetricType::Counter)?;
    for (labels, count) in figures {
        ConstCounter::new(count).encode(metric.encode_family(&labels)?)?;
    }
    Ok(())
}

fn gauge<'a>(
    encoder: &mut DescriptorEncoder,
    name: &str,
    help: &str,
    unit: Option<Unit>,
    figures: impl IntoIterator<Item = (Labels<'a>, f64)>,
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
    for (labels, value) in figures {
        ConstGauge::new(value).encode(metric.encode_family(&labels)?)?;
    }
    Ok(())
}

/// 1 stands for yes.
fn flag(is_so: bool) -> f64 {
    f64::from(u8::from(is_so))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn a_request_by_the_name_of_another_host_is_refused() {
        let head = |host: &str| format!("GET /metrics HTTP/1.1\r\nAccept: */*\r\nhost: {host}\r\n\r\n");
        for host in ["localhost", "LOCALHOST:9090", "127.0.0.1", "127.0.0.1:1", "[::1]", "[::1]:9090"] {
            assert!(is_for_loopback(&head(host)), "{host}");
        }
        for host in
            ["evil.example", "evil.example:9090", "localhost.evil.example", "127.0.0.1.evil.example:1", "", "x:y"]
        {
            assert!(!is_for_loopback(&head(host)), "{host}");
        }
        assert!(is_for_loopback("GET / HTTP/1.0\r\n\r\n"), "not a browser's");
        assert!(!is_for_loopback(&head("localhost\r\nHost: evil.example")));
    }

    #[test]
    fn the_dashboard_asks_for_figures_that_there_are() {
        let mut status = crate::testing::made_status("gate");
        status.nodes[0].counts.insert("lifts/dropped".into(), 2);
        let text = text(status).expect("figures");
        let mut names = BTreeSet::new();
        for line in text.lines() {
            if let Some((name, kind)) = line.strip_prefix("# TYPE ").and_then(|line| line.split_once(' ')) {
                let ending = match kind {
                    "counter" => "_total",
                    "histogram" => "_bucket",
                    _ => "",
                };
                names.insert(format!("{name}{ending}"));
            }
        }
        let dashboard = include_str!("../../../../docs/grafana.json");
        let dashboard: serde_json::Value = serde_json::from_str(dashboard).expect("JSON");
        for panel in dashboard["panels"].as_array().expect("panels") {
            for target in panel["targets"].as_array().expect("targets") {
                let asked = target["expr"].as_str().expect("an expression");
                let words = asked.split(|char: char| !char.is_ascii_alphanumeric() && char != '_');
                let found: Vec<&str> = words.filter(|word| word.starts_with("blindgrasp_")).collect();
                assert!(!found.is_empty() && found.iter().all(|name| names.contains(*name)), "{asked}: {names:?}");
            }
        }
        let lifts = "kind=\"lifts/dropped\"} 2";
        for label in ["action=\"hold\",reason=\"no_contact\"", "action=\"lift\",reason=\"stable\"", lifts] {
            assert!(text.contains(label), "{text}");
        }
    }

    #[test]
    fn clients_that_say_nothing_keep_no_other_waiting_for_good() {
        let listener = listen(0).expect("a port");
        let address = listener.local_addr().expect("bound");
        serve(listener, "no such graph".into());
        let idle: Vec<TcpStream> = (0..100).map(|_| TcpStream::connect(address).expect("connected")).collect();
        let ask = || {
            let mut client = TcpStream::connect(address).ok()?;
            client.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").ok()?;
            let mut answer = String::new();
            client.read_to_string(&mut answer).ok()?;
            Some(answer).filter(|answer| !answer.is_empty())
        };
        // Clients are turned away until the idle ones have had their time.
        let answer = std::iter::repeat_with(ask).flatten().next().expect("endless");
        assert!(answer.starts_with("HTTP/1.1 503"), "{answer}");
        drop(idle);
    }
}
