//! A ROS 2 node over Zenoh, as rmw_zenoh has them: nodes, publishers and subscribers show themselves by liveliness tokens,
//! samples go to `DOMAIN/TOPIC/TYPE/HASH` and carry their number, time and sender.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::Deserialize;
use serde_json::json;
use twox_hash::XxHash3_128;
use zenoh::bytes::Encoding;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::PublisherBuilder;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Sample;
use zenoh::{Config, Wait};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilder, AdvancedPublisherBuilderExt as _, AdvancedSubscriberBuilderExt as _,
    CacheConfig, HistoryConfig,
};

pub use blindgrasp_ros::network::{Keys, Network, RosError};
pub use zenoh::Session;

pub use super::access::Rights;
use super::access::access_control;

/// A longer message is dropped by Zenoh.
const MAX_MESSAGE_BYTES: usize = 16 << 20;
/// Of a longer message, only the length is passed on.
pub const MAX_RECEIVED_BYTES: usize = 4 << 20;
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
pub fn open(network: &Network, rights: &Rights) -> Result<Session, RosError> {
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
    if let Some(Keys { authority, certificate, private_key }) = &network.keys {
        config["transport"]["link"]["tls"] = json!({
            "root_ca_certificate": authority,
            "enable_mtls": true,
            "listen_certificate": certificate,
            "listen_private_key": private_key,
            "connect_certificate": certificate,
            "connect_private_key": private_key,
            // Access control goes by the common name, at any address. The certificates of `blindgrasp keys` bear no address,
            // and public authorities, which Zenoh's connecting side accepts as well, sign no name without a dot.
            "verify_name_on_connect": false,
            "close_link_on_expiration": true,
        });
    }
    let refused = |error: zenoh::Error| {
        let endpoints = [network.connect.as_slice(), &network.listen].concat().join(", ");
        let message = error.to_string();
        // Zenoh appends the place in its source code.
        let message = message.split(" at /").next().unwrap_or_default();
        if message.contains(NO_ANSWER) {
            RosError::NoRouter { endpoints, with_keys: network.keys.is_some() }
        } else {
            RosError::Open { endpoints, message: message.into() }
        }
    };
    let config = Config::from_json5(&config.to_string()).map_err(refused)?;
    zenoh::open(config).wait().map_err(refused)
}

/// A topic name with the namespace before it, unless it begins with `/`.
///
/// # Errors
/// It is no name of a topic.
pub fn topic_name(namespace: &str, topic: &str) -> Result<String, RosError> {
    let full =
        if topic.starts_with('/') { topic.to_owned() } else { format!("{}/{topic}", namespace.trim_end_matches('/')) };
    let rest = full.strip_prefix('/').ok_or_else(|| RosError::Topic(topic.into()))?;
    if rest.split('/').all(is_word) { Ok(full) } else { Err(RosError::Topic(topic.into())) }
}

fn is_word(word: &str) -> bool {
    word.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && word.chars().all(|char| char.is_ascii_alphanumeric() || char == '_')
}

/// The program that speaks Zenoh for the nodes. It decides how the keys of topics are named.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Convention {
    /// The nodes themselves, by rmw_zenoh: `DOMAIN/TOPIC/TYPE/HASH`, with attachments, and nodes show themselves.
    #[default]
    RmwZenoh,
    /// A `zenoh-bridge-ros2dds`, for nodes of DDS: the topic's name alone, and messages in CDR alone. Types, numbers and
    /// senders are not told.
    Ros2dds,
}

impl Convention {
    /// The key expression of a topic's messages, of all types.
    pub fn key(self, domain: u32, topic: &str) -> String {
        match self {
            Convention::RmwZenoh => format!("{domain}{topic}/*/*"),
            Convention::Ros2dds => topic.trim_start_matches('/').into(),
        }
    }

    /// The key expression of all topics in a namespace.
    pub fn keys_below(self, domain: u32, namespace: &str) -> String {
        let namespace = namespace.trim_end_matches('/');
        match self {
            Convention::RmwZenoh => format!("{domain}{namespace}/**"),
            Convention::Ros2dds => format!("{namespace}/**").trim_start_matches('/').into(),
        }
    }
}

/// The type of a topic's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MessageType {
    /// Like `sensor_msgs/msg/JointState`.
    pub name: String,
    /// Like `RIHS01_a13e…`.
    pub hash: String,
}

/// How a publisher's or a subscriber's samples are to be carried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// Samples of a sensor: one that the network has no room for is dropped.
    Sensor,
    /// None is dropped, and a subscriber that comes later gets the last ones, as many as this (`transient_local`).
    KeepLast(usize),
}

impl Quality {
    /// As in a token: `[reliability]:[durability]:[history],[depth]:…`, where nothing stands for the default.
    fn word(self) -> String {
        match self {
            Quality::Sensor => "2::,5:,:,:,,".into(),
            Quality::KeepLast(n) => format!(":1:,{n}:,:,:,,"),
        }
    }
}

/// A node that other nodes see.
pub struct RosNode {
    session: Session,
    convention: Convention,
    domain: u32,
    /// `ENCLAVE/NAMESPACE/NODE`, as in tokens.
    place: String,
    next_id: usize,
    tokens: Vec<LivelinessToken>,
    services: Vec<zenoh::query::Queryable<()>>,
}

/// The name of an endpoint in the attachments of its messages: the hash XXH3 of its token.
fn gid_of(token: &str) -> [u8; 16] {
    XxHash3_128::oneshot(token.as_bytes()).to_le_bytes()
}

/// A name as a part of a key.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// A type's name as in keys: `sensor_msgs::msg::dds_::JointState_`.
fn dds_name(message: &MessageType) -> Result<String, RosError> {
    hiroz_schema::type_name::dds_from_canonical(&message.name)
        .ok_or_else(|| RosError::Zenoh(format!("'{}' is no name of a message type", message.name)))
}

impl RosNode {
    /// # Errors
    /// Zenoh refuses its token.
    pub fn new(
        session: Session,
        convention: Convention,
        domain: u32,
        namespace: &str,
        name: &str,
    ) -> Result<RosNode, RosError> {
        let namespace = Some(mangled(namespace.trim_end_matches('/'))).filter(|namespace| !namespace.is_empty());
        let place = format!("%/{}/{name}", namespace.as_deref().unwrap_or("%"));
        let mut node =
            RosNode { session, convention, domain, place, next_id: 1, tokens: Vec::new(), services: Vec::new() };
        node.declare(&format!("0/NN/{}", node.place))?;
        Ok(node)
    }

    /// Declares a token `@ros2_lv/DOMAIN/SESSION/NODE/…`; returns the hash of it.
    fn declare(&mut self, rest: &str) -> Result<[u8; 16], RosError> {
        let token = format!("@ros2_lv/{}/{}/0/{rest}", self.domain, self.session.zid());
        let gid = gid_of(&token);
        if self.convention == Convention::Ros2dds {
            // The bridge looks for other bridges there.
            return Ok(gid);
        }
        self.tokens.push(self.session.liveliness().declare_token(token).wait().map_err(of_zenoh)?);
        Ok(gid)
    }

    /// Makes an endpoint known; returns the hash of its token, by which its samples name it.
    fn endpoint(
        &mut self,
        kind: &str,
        topic: &str,
        message: &MessageType,
        quality: Quality,
    ) -> Result<[u8; 16], RosError> {
        let (id, place, topic, dds) = (self.next_id, &self.place, mangled(topic), dds_name(message)?);
        self.next_id += 1;
        self.declare(&format!("{id}/{kind}/{place}/{topic}/{dds}/{}/{}", message.hash, quality.word()))
    }

    /// # Errors
    /// Zenoh refuses it.
    pub fn publisher(
        &mut self,
        topic: &str,
        message: &MessageType,
        quality: Quality,
    ) -> Result<RosPublisher, RosError> {
        let gid = self.endpoint("MP", topic, message, quality)?;
        let key = match self.convention {
            Convention::RmwZenoh => format!("{}{topic}/{}/{}", self.domain, dds_name(message)?, message.hash),
            convention @ Convention::Ros2dds => convention.key(self.domain, topic),
        };
        let builder = self.session.declare_publisher(key).encoding(Encoding::APPLICATION_CDR);
        let publisher = with_quality(builder, quality).wait().map_err(of_zenoh)?;
        let attaches = self.convention == Convention::RmwZenoh;
        Ok(RosPublisher { publisher, gid, next_seq: 1, attaches })
    }

    /// Calls `take` with each call of a service, from a thread of Zenoh, until the node is dropped.
    ///
    /// # Errors
    /// Zenoh refuses it.
    pub fn service(
        &mut self,
        name: &str,
        service: &MessageType,
        take: impl Fn(Request) + Send + Sync + 'static,
    ) -> Result<(), RosError> {
        self.endpoint("SS", name, service, Quality::KeepLast(1))?;
        let key = format!("{}{name}/{}/{}", self.domain, dds_name(service)?, service.hash);
        let queryable =
            self.session.declare_queryable(key).complete(true).callback(move |query| match Request::of(&query) {
                Some(request) => take(request),
                // The caller learns it; an answer that does not reach it is lost with the call.
                None => drop(query.reply_err("expected a request of a ROS 2 node, with its attachment").wait()),
            });
        self.services.push(queryable.wait().map_err(of_zenoh)?);
        Ok(())
    }

    /// Calls `take` with each message on a topic, of whatever type, from a thread of Zenoh. The node says that it expects
    /// `message`. With [`Quality::KeepLast`] it gets the last messages of each publisher that keeps them.
    ///
    /// # Errors
    /// Zenoh refuses it.
    pub fn subscriber(
        &mut self,
        topic: &str,
        message: &MessageType,
        quality: Quality,
        take: impl Fn(Received) + Send + Sync + 'static,
    ) -> Result<RosSubscriber, RosError> {
        self.endpoint("MS", topic, message, quality)?;
        // Of a message of a bridge, the type is the one that is expected.
        let told = (self.convention == Convention::Ros2dds).then(|| message.clone());
        let builder = self.session.declare_subscriber(self.convention.key(self.domain, topic));
        let builder = builder.callback(move |sample| take(Received::of(&sample, told.as_ref())));
        let subscriber: Box<dyn Send> = match quality {
            Quality::Sensor => Box::new(builder.wait().map_err(of_zenoh)?),
            Quality::KeepLast(n) => {
                let history = HistoryConfig::default().detect_late_publishers().max_samples(n);
                Box::new(builder.advanced().history(history).wait().map_err(of_zenoh)?)
            }
        };
        Ok(RosSubscriber { _subscriber: subscriber })
    }
}

fn with_quality<'a>(
    builder: PublisherBuilder<'a, 'static>,
    quality: Quality,
) -> AdvancedPublisherBuilder<'a, 'static, 'static> {
    match quality {
        Quality::Sensor => builder.congestion_control(CongestionControl::Drop).advanced(),
        Quality::KeepLast(n) => builder
            .congestion_control(CongestionControl::Block)
            .priority(Priority::InteractiveHigh)
            .express(true)
            .advanced()
            .cache(CacheConfig::default().max_samples(n))
            .publisher_detection(),
    }
}

fn of_zenoh(error: zenoh::Error) -> RosError {
    RosError::Zenoh(error.to_string())
}

/// A call of a service.
pub struct Request {
    query: zenoh::query::Query,
    seq: [u8; 8],
    client: [u8; 16],
    /// Of the request, in CDR.
    pub bytes: Vec<u8>,
}

impl Request {
    /// `None` for a call that is not a node's: it has no number, no caller or no request.
    fn of(query: &zenoh::query::Query) -> Option<Request> {
        let attachment = query.attachment()?.to_bytes().into_owned();
        let payload = query.payload().filter(|payload| payload.len() <= MAX_RECEIVED_BYTES)?;
        // The caller's hash comes behind its length.
        let (seq, client) = (attachment.get(..8)?.try_into().ok()?, attachment.get(17..33)?.try_into().ok()?);
        Some(Request { query: query.clone(), seq, client, bytes: payload.to_bytes().into_owned() })
    }

    /// Answers it.
    ///
    /// # Errors
    /// The session is closed.
    pub fn answer(self, cdr: &[u8]) -> Result<(), RosError> {
        let attachment = attachment(&self.seq, &self.client);
        let key = self.query.key_expr().clone();
        self.query.reply(key, cdr).attachment(attachment).wait().map_err(of_zenoh)
    }
}

/// Beside a message: its number, the time, and the hash of its sender behind its length.
fn attachment(seq: &[u8; 8], gid: &[u8; 16]) -> Vec<u8> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as i64;
    [&seq[..], &now.to_le_bytes(), &[gid.len() as u8], gid].concat()
}

/// Sends messages to a topic.
pub struct RosPublisher {
    publisher: AdvancedPublisher<'static>,
    gid: [u8; 16],
    next_seq: i64,
    attaches: bool,
}

impl RosPublisher {
    /// Sends a message in CDR.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&mut self, cdr: &[u8]) -> Result<(), RosError> {
        if !self.attaches {
            return self.publisher.put(cdr).wait().map_err(of_zenoh);
        }
        let attachment = attachment(&self.next_seq.to_le_bytes(), &self.gid);
        self.next_seq += 1;
        self.publisher.put(cdr).attachment(attachment).wait().map_err(of_zenoh)
    }
}

/// Sends samples to a key of its own, for programs that are no nodes of ROS 2.
pub struct KeyPublisher {
    publisher: AdvancedPublisher<'static>,
}

impl KeyPublisher {
    /// A publisher of JSON.
    ///
    /// # Errors
    /// It is no key, or Zenoh refuses it.
    pub fn new(session: &Session, key: &str, quality: Quality) -> Result<KeyPublisher, RosError> {
        let builder = session.declare_publisher(key.to_owned()).encoding(Encoding::APPLICATION_JSON);
        let publisher = with_quality(builder, quality).wait().map_err(of_zenoh)?;
        Ok(KeyPublisher { publisher })
    }

    /// Sends a sample, with its number and its time (nanoseconds since 1970) as the attachment: two integers of 64 bits,
    /// little endian.
    ///
    /// # Errors
    /// The session is closed.
    pub fn publish(&self, payload: &[u8], seq: u64, unix_nanos: u64) -> Result<(), RosError> {
        let attachment = [seq.to_le_bytes(), unix_nanos.to_le_bytes()].concat();
        self.publisher.put(payload).attachment(attachment).wait().map_err(of_zenoh)
    }
}

/// It receives until it is dropped.
pub struct RosSubscriber {
    _subscriber: Box<dyn Send>,
}

/// A message from the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// The last two parts of its key; empty if it has none.
    pub message: MessageType,
    /// Empty if there are more than [`MAX_RECEIVED_BYTES`].
    pub bytes: Vec<u8>,
    pub n_bytes: usize,
    /// The sender's time, nanoseconds since 1970; `None` without an attachment.
    pub source_nanos: Option<u64>,
    /// The sender's number of it.
    pub seq: Option<u64>,
    /// The identity of the sender.
    pub sender: Option<[u8; 16]>,
}

impl Received {
    /// A message of a sample, whose type is `told` or that of its key.
    fn of(sample: &Sample, told: Option<&MessageType>) -> Received {
        let attachment = sample.attachment().map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default();
        let n_bytes = sample.payload().len();
        let bytes = if n_bytes > MAX_RECEIVED_BYTES { Vec::new() } else { sample.payload().to_bytes().into_owned() };
        let received = Received::new(sample.key_expr().as_str(), &attachment, bytes, n_bytes);
        match told {
            Some(message) => Received { message: message.clone(), ..received },
            None => received,
        }
    }

    fn new(key: &str, attachment: &[u8], bytes: Vec<u8>, n_bytes: usize) -> Received {
        let mut parts = key.rsplit('/');
        let hash = parts.next().unwrap_or_default().into();
        let name = hiroz_schema::type_name::ros_from_dds(parts.next().unwrap_or_default());
        let number = |at: usize| {
            let bytes = attachment.get(at..at + 8)?.try_into().ok()?;
            u64::try_from(i64::from_le_bytes(bytes)).ok()
        };
        Received {
            message: MessageType { name, hash },
            bytes,
            n_bytes,
            source_nanos: number(8),
            seq: number(0),
            // Behind a byte with its length.
            sender: attachment.get(17..33).and_then(|bytes| bytes.try_into().ok()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_the_convention() {
        let keys = |convention: Convention| {
            [convention.key(3, "/hand/touch"), convention.keys_below(3, "/hand"), convention.keys_below(3, "/")]
        };
        assert_eq!(keys(Convention::RmwZenoh), ["3/hand/touch/*/*", "3/hand/**", "3/**"]);
        assert_eq!(keys(Convention::Ros2dds), ["hand/touch", "hand/**", "**"]);
    }

    #[test]
    fn topics_are_names() {
        assert_eq!(topic_name("/hand", "decision").as_deref(), Ok("/hand/decision"));
        assert_eq!(topic_name("/", "decision").as_deref(), Ok("/decision"));
        assert_eq!(topic_name("/hand", "/joint_states").as_deref(), Ok("/joint_states"));
        for bad in ["/a//b", "/a*", "", "/9", "/a b"] {
            assert!(topic_name("/hand", bad).is_err(), "{bad}");
        }
    }

    /// Of nodes with rmw_zenoh_cpp 0.2.11 (Jazzy), as others captured them: the token of a publisher, and the attachment of a
    /// message of it.
    const CAPTURED: [(&str, &str); 4] = [
        (
            "@ros2_lv/0/45000cc3452ec777e9664270c90b5af/0/4/MP/%/%/p_be/%q_best_effort/std_msgs::msg::dds_::String_/HASH/2::,10:,:,:,,",
            "150000000000000058d1b24cf9a2dc1810a4461b1ae3b3b1de4a54c9c5e9e88fd0",
        ),
        (
            "@ros2_lv/0/914ec2c920f5151f26394cf0ba959999/0/4/MP/%/%/p_tl/%q_transient/std_msgs::msg::dds_::String_/HASH/:1:,10:,:,:,,",
            "15000000000000008903674cf9a2dc1810b9249d3fec6b1be4c0c8a0e3eb3550bb",
        ),
        (
            "@ros2_lv/0/a52f44b281e33efee354a095ad96d9e9/0/11/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/HASH/::,7:,:,:,,",
            "1a0000000000000005301f32f9a2dc18103e1e8c9234b1602a9dba5860eed86e33",
        ),
        (
            "@ros2_lv/7/6977b59f87229328a8d406ad77b301a6/0/11/MP/%/%cell4/gw/%cell4%chatter/std_msgs::msg::dds_::String_/HASH/::,7:,:,:,,",
            "1a00000000000000699e1332f9a2dc1810b7aef695b2cd04ba45f9eed0c4a6c584",
        ),
    ];
    const STRING_HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    #[test]
    fn captured_messages_of_rmw_zenoh_are_read_and_their_senders_known() {
        for (token, attachment) in CAPTURED {
            let token = token.replace("HASH", STRING_HASH);
            let bytes: Vec<u8> = (0..attachment.len())
                .step_by(2)
                .map(|at| u8::from_str_radix(&attachment[at..at + 2], 16).expect("hexadecimal"))
                .collect();
            let key = format!("0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}");
            let received = Received::new(&key, &bytes, vec![0, 1, 0, 0], 4);
            assert_eq!(received.sender, Some(gid_of(&token)), "{token}");
            assert_eq!(received.message, MessageType { name: "std_msgs/msg/String".into(), hash: STRING_HASH.into() });
            assert!(received.seq.is_some_and(|seq| (21..=26).contains(&seq)), "{received:?}");
            let secs = received.source_nanos.expect("a time") / 1_000_000_000;
            assert!((1_700_000_000..1_900_000_000).contains(&secs), "{secs}");
        }
    }

    /// The same publishers, declared here, have those tokens, but for the session and the numbers.
    #[test]
    fn tokens_are_those_of_rmw_zenoh() {
        let listens = Network { listen: vec!["tcp/127.0.0.1:0".into()], ..Network::default() };
        let session = open(&listens, &Rights::default()).expect("a session");
        let message = MessageType { name: "std_msgs/msg/String".into(), hash: STRING_HASH.into() };
        let tokens: Vec<String> = [(0, "/", "p_tl", "/q_transient"), (7, "/cell4", "gw", "/cell4/chatter")]
            .into_iter()
            .map(|(domain, namespace, name, topic)| {
                let mut node =
                    RosNode::new(session.clone(), Convention::RmwZenoh, domain, namespace, name).expect("a node");
                let _publisher = node.publisher(topic, &message, Quality::KeepLast(10)).expect("a publisher");
                let replies = session.liveliness().get("@ros2_lv/*/*/*/*/MP/**").wait().expect("tokens");
                let reply = replies.recv().expect("a token").into_result().expect("a token");
                reply.key_expr().to_string()
            })
            .collect();
        let without_numbers = |token: &str| {
            let mut parts: Vec<&str> = token.split('/').collect();
            parts.drain(2..5);
            parts[..parts.len() - 1].join("/")
        };
        for (token, (captured, _)) in tokens.iter().zip([CAPTURED[1], CAPTURED[3]]) {
            assert_eq!(without_numbers(token), without_numbers(&captured.replace("HASH", STRING_HASH)));
        }
        assert!(tokens[0].ends_with("/:1:,10:,:,:,,"), "{}", tokens[0]);
    }

    /// A publisher as in Lyrical, after rmw_zenoh's pull request 930. Its token has a further part behind the qualities, and
    /// it sends the same message on keys below the topic's own to subscribers whose tokens have one.
    #[test]
    fn a_publisher_of_lyrical_is_heard_once() {
        let message = MessageType { name: "sensor_msgs/msg/Image".into(), hash: format!("RIHS01_{}", "7f".repeat(32)) };
        let port = std::net::TcpListener::bind("127.0.0.1:0").and_then(|it| it.local_addr()).expect("a port").port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let listens = Network { listen: vec![endpoint.clone()], ..Network::default() };
        let takes = Rights { takes: vec![Convention::RmwZenoh.key(0, "/touch")], ..Rights::default() };
        let session = open(&listens, &takes).expect("a session");
        let mut hearer = RosNode::new(session, Convention::RmwZenoh, 0, "/", "hearer").expect("a node");
        let (sender, heard) = std::sync::mpsc::channel();
        let _subscriber = hearer
            .subscriber("/touch", &message, Quality::Sensor, move |received| drop(sender.send(received)))
            .expect("a subscriber");

        let scouting = json!({"multicast": {"enabled": false}});
        let config = json!({"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": scouting});
        let config = Config::from_json5(&config.to_string()).expect("a configuration");
        let robot = zenoh::open(config).wait().expect("a session");
        let dds = dds_name(&message).expect("a type");
        let token =
            format!("@ros2_lv/0/{}/0/1/MP/%/%/camera/%touch/{dds}/{}/2::,5:,:,:,,/cpu:", robot.zid(), message.hash);
        let _token = robot.liveliness().declare_token(token.clone()).wait().expect("a token");
        let gid = gid_of(&token);
        let key = format!("0/touch/{dds}/{}", message.hash);
        let send = |seq: i64| {
            for key in [format!("{key}/_buf_cpu"), format!("{key}/_buf/00ff"), key.clone()] {
                let beside = attachment(&seq.to_le_bytes(), &gid);
                robot.put(key, [0, 1, 0, 0]).attachment(beside).wait().expect("sent");
            }
        };
        // Until the subscription is known, messages go nowhere.
        let (mut seq, mut first) = (0, None);
        while first.is_none() && seq < 200 {
            seq += 1;
            send(seq);
            first = heard.recv_timeout(std::time::Duration::from_millis(50)).ok();
        }
        let first = first.expect("a message");
        assert_eq!((&first.message, first.sender), (&message, Some(gid)));
        send(1000);
        // Each number comes once, up to the last one.
        let mut numbers = vec![first.seq];
        while numbers.last() != Some(&Some(1000)) {
            let next = heard.recv_timeout(std::time::Duration::from_secs(10)).expect("a message");
            assert_eq!(next.message, message);
            numbers.push(next.seq);
        }
        assert!(heard.recv_timeout(std::time::Duration::from_millis(100)).is_err());
        assert!(numbers.is_sorted_by(|one, next| one < next), "{numbers:?}");
    }

    /// One node on loopback hears another one.
    #[test]
    fn a_message_and_its_sender_are_known_at_the_other_node() {
        let message = MessageType { name: "std_msgs/msg/String".into(), hash: format!("RIHS01_{}", "7f".repeat(32)) };
        let port = std::net::TcpListener::bind("127.0.0.1:0").and_then(|it| it.local_addr()).expect("a port").port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let listens = Network { listen: vec![endpoint.clone()], ..Network::default() };
        let takes = Rights { takes: vec![Convention::RmwZenoh.key(3, "/robot/words")], ..Rights::default() };
        let session = open(&listens, &takes).expect("a session");
        let mut heard_at = RosNode::new(session, Convention::RmwZenoh, 3, "/robot", "hearer").expect("a node");
        let (sender, heard) = std::sync::mpsc::channel();
        let topic = topic_name("/robot", "words").expect("a topic");
        let _subscriber = heard_at
            .subscriber(&topic, &message, Quality::Sensor, move |received| drop(sender.send(received)))
            .expect("a subscriber");
        let connects = Network { connect: vec![endpoint], ..Network::default() };
        let sends = Rights {
            sends: [3, 4].map(|domain| Convention::RmwZenoh.key(domain, "/robot/words")).to_vec(),
            ..Rights::default()
        };
        let session = open(&connects, &sends).expect("a session");
        let mut said_at = RosNode::new(session, Convention::RmwZenoh, 3, "/robot", "sayer").expect("a node");
        let mut publisher = said_at.publisher(&topic, &message, Quality::KeepLast(1)).expect("a publisher");
        // Until the subscription is known, samples go nowhere.
        let received = (0..200).find_map(|_| {
            publisher.publish(&[0, 1, 0, 0]).expect("sent");
            heard.recv_timeout(std::time::Duration::from_millis(50)).ok()
        });
        let received = received.expect("a message");
        assert_eq!((&received.message, received.bytes.as_slice()), (&message, &[0, 1, 0, 0][..]));
        assert!(received.seq.is_some() && received.source_nanos.is_some());
        assert_eq!(received.sender, Some(publisher.gid));
        // A subscriber that comes later gets the last message if it asks for it.
        let (sender, late) = std::sync::mpsc::channel();
        let _late = heard_at
            .subscriber(&topic, &message, Quality::KeepLast(1), move |received| drop(sender.send(received)))
            .expect("a subscriber");
        let kept = late.recv_timeout(std::time::Duration::from_secs(10)).expect("a message");
        assert_eq!((kept.message, kept.sender), (message.clone(), Some(publisher.gid)));
        // Another domain hears nothing.
        let mut other =
            RosNode::new(said_at.session.clone(), Convention::RmwZenoh, 4, "/robot", "other").expect("a node");
        let mut elsewhere = other.publisher(&topic, &message, Quality::Sensor).expect("a publisher");
        elsewhere.publish(&[0, 1, 0, 0, 9]).expect("sent");
        publisher.publish(&[0, 1, 0, 0, 1]).expect("sent");
        let next = heard.recv_timeout(std::time::Duration::from_secs(10)).expect("a message");
        assert_eq!(next.bytes, [0, 1, 0, 0, 1]);
    }
}
