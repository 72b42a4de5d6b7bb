//! Publishes samples of the graph as topics of ROS 2 (operator `ros2`), or as JSON on keys of Zenoh (operator `zenoh`).
//!
//! Its inputs must be `latest`: the network never holds up the graph. All that is read from the network are calls of the
//! service `decide`, which tells a decision and changes nothing.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::ros2_markers::hand_markers;
use anyhow::{Context as _, bail};
use blindgrasp_bridge::certificates::key_files;
use blindgrasp_bridge::config::KeyFiles;
use blindgrasp_messages::{
    ContactSet, GraspFeature, LiftDecision, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::Subscriber;
use blindgrasp_operator::source::{self, Source, Step};
use blindgrasp_recording::cdr;
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::node::{
    KeyPublisher, Keys, MAX_DOMAIN, MessageType, Network, Quality, Request, RosError, RosNode, RosPublisher,
    RosService, Session, topic_name,
};
use blindgrasp_ros::standard;
use blindgrasp_stages::hand::Hand;
use serde::{Deserialize, Serialize};

/// The router of rmw_zenoh.
const ROUTER: &str = "tcp/localhost:7447";
/// The name of this program's files in a folder of keys.
const KEY_NAME: &str = "ros2";
/// The definition of decisions, made for programs that move an arm.
const DECISION: &str = include_str!("Decision.msg");
const DECISION_SCHEMA: &str = "blindgrasp_msgs/msg/Decision";
/// The service that waits for a decision.
const DECIDE: &str = include_str!("Decide.srv");
const DECIDE_SCHEMA: &str = "blindgrasp_msgs/srv/Decide";
const MAX_TIMEOUT_SECS: f64 = 60.0;
/// Calls that wait at the same time; others are answered at once, without a decision.
const MAX_WAITING: usize = 16;
/// The least time between two pictures of the hand: 10 a second.
const MARKER_NANOS: u64 = 100_000_000;
/// The pause between two attempts to reach the router.
const RETRY_NANOS: u64 = 1_000_000_000;

/// The parameters of a connection to ROS 2.
#[derive(Deserialize, Clone)]
pub(crate) struct NetworkParams {
    pub(crate) connect: Option<String>,
    pub(crate) listen: Option<String>,
    pub(crate) keys: Option<PathBuf>,
    pub(crate) domain: Option<u32>,
    pub(crate) namespace: Option<String>,
}

#[derive(Deserialize)]
struct Params {
    hand: Option<PathBuf>,
    #[serde(flatten)]
    network: NetworkParams,
}

/// Adds the parameters of a connection.
pub(crate) fn with_network_params(description: OperatorDescription) -> OperatorDescription {
    description
        .optional_param("connect", ParamKind::String {}, "A Zenoh router or node, like tcp/localhost:7447, the default")
        .optional_param("listen", ParamKind::String {}, "An endpoint at which nodes connect, like tcp/127.0.0.1:7448")
        .optional_param(
            "keys",
            ParamKind::Path { must_exist: true },
            "A folder with ca.pem, ros2.pem and ros2.key.pem, for endpoints tls/HOST:PORT",
        )
        .optional_param(
            "domain",
            ParamKind::Integer { min: Some(0), max: Some(MAX_DOMAIN.into()) },
            "The ROS domain, 0 by default",
        )
        .optional_param("namespace", ParamKind::String {}, "Before the names of topics, /blindgrasp by default")
}

impl NetworkParams {
    /// # Errors
    /// An endpoint or the namespace is not valid.
    pub(crate) fn network(&self) -> anyhow::Result<(Network, u32, String)> {
        let keys = self.keys.as_deref().map(|folder| {
            let KeyFiles { authority, certificate, private_key } = key_files(folder, KEY_NAME);
            Keys { authority, certificate, private_key }
        });
        let connect = match (&self.connect, &self.listen) {
            (Some(endpoint), _) => vec![endpoint.clone()],
            (None, Some(_)) => vec![],
            (None, None) => vec![ROUTER.to_owned()],
        };
        let network = Network { connect, listen: self.listen.iter().cloned().collect(), keys };
        network.check()?;
        let namespace = self.namespace.clone().unwrap_or_else(|| "/blindgrasp".into());
        topic_name(&namespace, "decision").with_context(|| format!("namespace '{namespace}'"))?;
        if network.keys.is_none() {
            let mut endpoints = network.connect.iter().chain(&network.listen);
            if let Some(endpoint) = endpoints.find(|endpoint| !is_on_loopback(endpoint)) {
                print_diagnostic(&format!(
                    "WARNING: {endpoint} without TLS: everybody who reaches it can read and send what passes there"
                ));
            }
        }
        Ok((network, self.domain.unwrap_or(0), namespace))
    }
}

/// Whether no other machine reaches an endpoint like `tcp/localhost:7447`.
fn is_on_loopback(endpoint: &str) -> bool {
    let host = endpoint.split_once('/').and_then(|(_, address)| address.rsplit_once(':')).map_or("", |(host, _)| host);
    let address = host.trim_matches(['[', ']']).parse::<IpAddr>();
    host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

pub(crate) fn describe() -> OperatorDescription {
    let mut description = OperatorDescription::new("ros2", "Publishes samples as topics of ROS 2");
    for (name, type_name, summary) in INPUTS {
        description = description.optional_input(name, type_name, summary);
    }
    with_network_params(description.uses_network()).optional_param(
        "hand",
        ParamKind::Path { must_exist: true },
        "The hand's pad layout (YAML), for joint_states and hand_markers",
    )
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let (network, domain, namespace) = params.network.network()?;
    let hand = params.hand.as_deref().map(Hand::load).transpose()?;
    let mut edges: Vec<Box<dyn Forward>> = Vec::new();
    let last = Arc::new(LastDecision::default());
    edges.extend(edge::<LiftDecision>(operator, "decision", vec![decision_topic(&last)?])?);
    let decides = !edges.is_empty();
    let mut tactile = vec![topic_of::<TactileFrame>("tactile")?];
    if let Some(hand) = hand {
        let joint_names: Vec<String> = hand.joints.iter().map(|joint| joint.name.clone()).collect();
        tactile.push(Topic {
            name: "joint_states",
            message: Some(standard_type("sensor_msgs/msg/JointState")?),
            quality: Quality::Sensor,
            encode: Box::new(move |sample, data| cdr::joint_state(&sample.header, &joint_names, &sample.message, data)),
            interval_nanos: 0,
        });
        tactile.push(Topic {
            name: "hand_markers",
            message: Some(standard_type("visualization_msgs/msg/MarkerArray")?),
            quality: Quality::Sensor,
            encode: Box::new(move |sample, data| hand_markers(&hand, sample, data)),
            interval_nanos: MARKER_NANOS,
        });
    }
    edges.extend(edge::<TactileFrame>(operator, "tactile", tactile)?);
    let points = Topic {
        name: "contact_points",
        message: Some(standard_type("sensor_msgs/msg/PointCloud2")?),
        quality: Quality::Sensor,
        encode: Box::new(|sample: &Stamped<ContactSet>, data: &mut Vec<u8>| {
            cdr::contact_points(&sample.header, &sample.message, data)
        }),
        interval_nanos: 0,
    };
    edges.extend(edge::<ContactSet>(operator, "contacts", vec![topic_of::<ContactSet>("contacts")?, points])?);
    edges.extend(edge::<GraspFeature>(operator, "feature", vec![topic_of::<GraspFeature>("feature")?])?);
    edges.extend(edge::<Prediction>(operator, "prediction", vec![topic_of::<Prediction>("prediction")?])?);
    let form = if decides { Form::Ros(Some(last)) } else { Form::Ros(None) };
    publish(operator, network, domain, namespace, edges, form)
}

/// The inputs of both operators.
const INPUTS: [(&str, &str, &str); 5] = [
    ("decision", LiftDecision::TYPE_NAME, "Topic decision, and when it ceases to be valid"),
    ("tactile", TactileFrame::TYPE_NAME, "Topic tactile; with the param 'hand', joint_states and hand_markers as well"),
    ("contacts", ContactSet::TYPE_NAME, "Topics contacts and contact_points"),
    ("feature", GraspFeature::TYPE_NAME, "Topic feature"),
    ("prediction", Prediction::TYPE_NAME, "Topic prediction"),
];

/// What other programs see.
enum Form {
    /// Topics of a node, in CDR, and the service that tells the last decision.
    Ros(Option<Arc<LastDecision>>),
    /// Keys, with JSON.
    Json,
}

pub(crate) fn describe_json() -> OperatorDescription {
    let mut description = OperatorDescription::new("zenoh", "Publishes samples as JSON on keys of Zenoh");
    for (name, type_name, _) in INPUTS {
        description = description.optional_input(name, type_name, &format!("Key PREFIX/{name}"));
    }
    description
        .uses_network()
        .optional_param("connect", ParamKind::String {}, "A Zenoh router or node, like tcp/localhost:7447, the default")
        .optional_param(
            "listen",
            ParamKind::String {},
            "An endpoint at which programs connect, like tcp/127.0.0.1:7448",
        )
        .optional_param(
            "keys",
            ParamKind::Path { must_exist: true },
            "A folder with ca.pem, ros2.pem and ros2.key.pem, for endpoints tls/HOST:PORT",
        )
        .optional_param("prefix", ParamKind::String {}, "Before the names of keys, blindgrasp by default")
}

pub(crate) fn work_json(operator: &Operator) -> anyhow::Result<()> {
    #[derive(Deserialize)]
    struct Params {
        prefix: Option<String>,
        #[serde(flatten)]
        network: NetworkParams,
    }
    let params: Params = operator.params()?;
    let (network, ..) = params.network.network()?;
    let prefix = params.prefix.unwrap_or_else(|| "blindgrasp".into());
    topic_name("/", &prefix.replace('/', "_"))
        .ok()
        .filter(|_| !prefix.is_empty() && !prefix.starts_with('/') && !prefix.ends_with('/'))
        .with_context(|| format!("prefix '{prefix}': expected words of letters, digits and _, with / between them"))?;
    let mut edges: Vec<Box<dyn Forward>> = Vec::new();
    edges.extend(json_edge::<LiftDecision>(operator, "decision", Quality::KeepLast(1))?);
    edges.extend(json_edge::<TactileFrame>(operator, "tactile", Quality::Sensor)?);
    edges.extend(json_edge::<ContactSet>(operator, "contacts", Quality::Sensor)?);
    edges.extend(json_edge::<GraspFeature>(operator, "feature", Quality::Sensor)?);
    edges.extend(json_edge::<Prediction>(operator, "prediction", Quality::Sensor)?);
    publish(operator, network, 0, prefix, edges, Form::Json)
}

/// An input whose samples are published as JSON.
fn json_edge<M: Message + Serialize>(
    operator: &Operator,
    name: &'static str,
    quality: Quality,
) -> anyhow::Result<Option<Box<dyn Forward>>> {
    #[derive(Serialize)]
    struct Sample<'a, M> {
        seq: u64,
        stamp_nanos: u64,
        /// For how long a decision is still valid when it is sent.
        #[serde(skip_serializing_if = "Option::is_none")]
        valid_for_nanos: Option<u64>,
        data: &'a M,
    }
    let encode: Encode<M> = Box::new(move |sample: &Stamped<M>, data: &mut Vec<u8>| {
        let Stamped { header, message } = sample;
        let until = header.valid_until_nanos().unwrap_or(0);
        let valid_for_nanos = (name == "decision").then(|| until.saturating_sub(monotonic_nanos()));
        let sample = Sample { seq: header.seq, stamp_nanos: header.stamp_nanos, valid_for_nanos, data: message };
        data.clear();
        serde_json::to_writer(data, &sample).map_err(|error| error.to_string())
    });
    edge(operator, name, vec![Topic { name, message: None, quality, encode, interval_nanos: 0 }])
}

/// Publishes the samples of all edges until the graph ends.
fn publish(
    operator: &Operator,
    network: Network,
    domain: u32,
    namespace: String,
    edges: Vec<Box<dyn Forward>>,
    form: Form,
) -> anyhow::Result<()> {
    if edges.is_empty() {
        bail!("it has no input: connect one of decision, tactile, contacts, feature and prediction");
    }
    let publisher = Publishing {
        operator,
        network,
        domain,
        namespace,
        edges,
        decide: matches!(form, Form::Ros(Some(_))).then(decide_type).transpose()?,
        form,
        node: None,
        service: None,
        retry_nanos: 0,
        said: None,
        n_published: 0,
        n_unpublished: 0,
        reported: (0, 0),
    };
    source::run(operator, BTreeMap::new(), publisher)
}

/// A topic that the samples of an edge make.
struct Topic<M> {
    name: &'static str,
    /// The type in ROS 2; `None` for JSON.
    message: Option<MessageType>,
    quality: Quality,
    encode: Encode<M>,
    /// Samples that come sooner after the last one make no message.
    interval_nanos: u64,
}

type Encode<M> = Box<dyn Fn(&Stamped<M>, &mut Vec<u8>) -> Result<(), String>>;

fn topic_of<M: Recorded>(name: &'static str) -> anyhow::Result<Topic<M>> {
    let message = type_of(M::SCHEMA, &M::definition())?;
    Ok(Topic {
        name,
        message: Some(message),
        quality: Quality::Sensor,
        encode: Box::new(cdr::encode),
        interval_nanos: 0,
    })
}

fn type_of(name: &str, definition: &str) -> anyhow::Result<MessageType> {
    let hash = Definition::parse(name, definition).with_context(|| name.to_owned())?.hash();
    Ok(MessageType { name: name.into(), hash })
}

fn standard_type(name: &str) -> anyhow::Result<MessageType> {
    type_of(name, &standard::text(name).with_context(|| format!("no definition of {name}"))?)
}

/// The topic of decisions, for programs that move an arm.
fn decision_topic(last: &Arc<LastDecision>) -> anyhow::Result<Topic<LiftDecision>> {
    let last = Arc::clone(last);
    Ok(Topic {
        name: "decision",
        message: Some(type_of(DECISION_SCHEMA, &standard::with_parts(DECISION, &["builtin_interfaces/Time"]))?),
        quality: Quality::KeepLast(1),
        encode: Box::new(move |sample, data| {
            let until_nanos = sample.header.valid_until_nanos().unwrap_or(0);
            last.set(&sample.message, until_nanos);
            cdr::encode(&Decision::new(&sample.message, until_nanos), data)
        }),
        interval_nanos: 0,
    })
}

/// `blindgrasp_msgs/msg/Decision`.
#[derive(Serialize, Default)]
struct Decision {
    stamp: Time,
    valid_until: Time,
    grasp_id: u64,
    action: u8,
    reason: String,
    probability_stable: f64,
}

#[derive(Serialize, Default)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl Decision {
    /// As it is said now, of a decision that is valid until a time of this machine.
    fn new(decision: &LiftDecision, until_nanos: u64) -> Decision {
        let time = |nanos: u64| Time {
            sec: i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX),
            nanosec: (nanos % 1_000_000_000) as u32,
        };
        let now = unix_nanos();
        Decision {
            stamp: time(now),
            valid_until: time(now + until_nanos.saturating_sub(monotonic_nanos())),
            grasp_id: decision.grasp_id,
            action: decision.action.code() as u8,
            reason: decision.reason.as_str().into(),
            probability_stable: decision.probability_stable,
        }
    }
}

/// The last decision, for calls that wait for one.
#[derive(Default)]
struct LastDecision {
    /// The decision, and until when it is valid by the clock of this machine.
    decision: Mutex<Option<(LiftDecision, u64)>>,
    comes: Condvar,
    n_waiting: AtomicUsize,
}

impl LastDecision {
    fn set(&self, decision: &LiftDecision, until_nanos: u64) {
        *self.decision.lock().unwrap_or_else(PoisonError::into_inner) = Some((decision.clone(), until_nanos));
        self.comes.notify_all();
    }

    /// The last decision if it is valid, or else the next one that is, within the time.
    fn wait(&self, longest: Duration) -> Option<Decision> {
        let is_too_old = |decision: &mut Option<(LiftDecision, u64)>| {
            decision.as_ref().is_none_or(|(_, until_nanos)| *until_nanos <= monotonic_nanos())
        };
        let decision = self.decision.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.comes.wait_timeout_while(decision, longest, is_too_old);
        let (decision, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        let (decision, until_nanos) = decision.as_ref().filter(|_| !timeout.timed_out())?;
        Some(Decision::new(decision, *until_nanos))
    }

    /// Answers a call, in a thread of its own, because it waits.
    fn answer(self: &Arc<Self>, request: Request) {
        let last = Arc::clone(self);
        // CDR: four bytes of its kind, then the number.
        let timeout_secs = request.bytes.get(4..12).and_then(|bytes| Some(f64::from_le_bytes(bytes.try_into().ok()?)));
        let timeout_secs = timeout_secs.filter(|secs| (0.0..=MAX_TIMEOUT_SECS).contains(secs)).unwrap_or(0.0);
        let has_room = self.n_waiting.fetch_add(1, Ordering::Relaxed) < MAX_WAITING;
        let longest = Duration::from_secs_f64(if has_room { timeout_secs } else { 0.0 });
        let answering = move || {
            let decision = last.wait(longest);
            let mut data = Vec::new();
            let answer = (decision.is_some(), decision.unwrap_or_default());
            if cdr::encode(&answer, &mut data).is_ok()
                && let Err(error) = request.answer(&data)
            {
                print_diagnostic(&format!("a call of decide is not answered: {error}"));
            }
            last.n_waiting.fetch_sub(1, Ordering::Relaxed);
        };
        if std::thread::Builder::new().name("decide".into()).spawn(answering).is_err() {
            self.n_waiting.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

fn decide_type() -> anyhow::Result<MessageType> {
    let (request, response) = DECIDE.split_once("---").context("Decide.srv has no line ---")?;
    let line = "=".repeat(80);
    let parts = format!("{line}\nMSG: blindgrasp_msgs/Decision\n{DECISION}\n");
    let definition = standard::service(DECIDE_SCHEMA, request, response, &parts)?;
    Ok(MessageType { name: DECIDE_SCHEMA.into(), hash: definition.hash() })
}

fn unix_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}

/// An input and its topics.
trait Forward {
    fn open(&mut self, node: &mut Node, namespace: &str) -> Result<(), RosError>;
    fn close(&mut self);
    fn connect(&self) -> anyhow::Result<()>;
    /// Publishes the next sample, if there is a session.
    fn forward(&mut self, data: &mut Vec<u8>) -> anyhow::Result<Forwarded>;
}

/// The outcome of an attempt to publish a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Forwarded {
    NoSample,
    Published,
    /// There is no session, or the sample cannot be read.
    Unpublished,
}

struct Edge<M: Message> {
    subscriber: Subscriber<M>,
    topics: Vec<Topic<M>>,
    publishers: Vec<Publisher>,
    /// For each topic, the time of the last sample that made a message.
    sent_nanos: Vec<Option<u64>>,
}

/// The graph as other programs see it.
enum Node {
    Ros(RosNode),
    Json(Session),
}

enum Publisher {
    Ros(RosPublisher),
    Json(KeyPublisher),
}

fn edge<M: Message>(
    operator: &Operator,
    port: &str,
    topics: Vec<Topic<M>>,
) -> anyhow::Result<Option<Box<dyn Forward>>> {
    if operator.is_lossless(port) {
        bail!(
            "input '{port}' is lossless, and the network must not hold up the graph: write \
             {port}: {{from: NODE/PORT, policy: latest, capacity: 256}}"
        );
    }
    let subscriber = operator.optional_subscriber::<M>(port)?;
    Ok(subscriber.map(|subscriber| {
        let sent_nanos = vec![None; topics.len()];
        Box::new(Edge { subscriber, topics, publishers: Vec::new(), sent_nanos }) as Box<dyn Forward>
    }))
}

impl<M: Message> Forward for Edge<M> {
    fn open(&mut self, node: &mut Node, namespace: &str) -> Result<(), RosError> {
        let open = |topic: &Topic<M>| match (&mut *node, &topic.message) {
            (Node::Ros(node), Some(message)) => {
                Ok(Publisher::Ros(node.publisher(&topic_name(namespace, topic.name)?, message, topic.quality)?))
            }
            (Node::Ros(_), None) => Err(RosError::Topic(topic.name.into())),
            (Node::Json(session), _) => {
                let key = format!("{namespace}/{}", topic.name);
                let publisher = KeyPublisher::new(session, &key, topic.quality)?;
                Ok(Publisher::Json(publisher))
            }
        };
        self.publishers = self.topics.iter().map(open).collect::<Result<_, _>>()?;
        Ok(())
    }

    fn close(&mut self) {
        self.publishers.clear();
    }

    fn connect(&self) -> anyhow::Result<()> {
        self.subscriber.connect()?;
        Ok(())
    }

    fn forward(&mut self, data: &mut Vec<u8>) -> anyhow::Result<Forwarded> {
        let Some(sample) = self.subscriber.receive()? else {
            return Ok(Forwarded::NoSample);
        };
        let header = *M::header(sample.user_header());
        let message = M::from_parts(sample.user_header(), sample.payload());
        self.subscriber.commit(&header);
        let message = match message {
            Ok(message) => message,
            Err(error) => {
                print_diagnostic(&format!("sample {} is not published: {error}", header.seq));
                return Ok(Forwarded::Unpublished);
            }
        };
        if self.publishers.is_empty() {
            return Ok(Forwarded::Unpublished);
        }
        let stamped = Stamped { header, message };
        for ((topic, publisher), sent_nanos) in self.topics.iter().zip(&mut self.publishers).zip(&mut self.sent_nanos) {
            let is_soon = |sent: u64| header.stamp_nanos.wrapping_sub(sent) < topic.interval_nanos;
            if sent_nanos.is_some_and(is_soon) {
                continue;
            }
            *sent_nanos = Some(header.stamp_nanos);
            (topic.encode)(&stamped, data).map_err(|error| anyhow::anyhow!("{}: {error}", topic.name))?;
            match publisher {
                Publisher::Ros(publisher) => publisher.publish(data)?,
                Publisher::Json(publisher) => publisher.publish(data, header.seq, unix_nanos())?,
            }
        }
        Ok(Forwarded::Published)
    }
}

struct Publishing<'a> {
    operator: &'a Operator,
    network: Network,
    domain: u32,
    namespace: String,
    edges: Vec<Box<dyn Forward>>,
    form: Form,
    /// The type of the service.
    decide: Option<MessageType>,
    node: Option<Node>,
    service: Option<RosService>,
    retry_nanos: u64,
    said: Option<String>,
    n_published: u64,
    n_unpublished: u64,
    reported: (u64, u64),
}

impl Publishing<'_> {
    fn open(&mut self) -> Result<(), RosError> {
        let session = self.network.open()?;
        let mut node = match &self.form {
            Form::Json => Node::Json(session),
            Form::Ros(last) => {
                let mut node = RosNode::new(session, self.domain, &self.namespace, "blindgrasp")?;
                if let (Some(last), Some(service)) = (last, &self.decide) {
                    let last = Arc::clone(last);
                    let name = topic_name(&self.namespace, "decide")?;
                    self.service = Some(node.service(&name, service, move |request| last.answer(request))?);
                }
                Node::Ros(node)
            }
        };
        for edge in &mut self.edges {
            edge.open(&mut node, &self.namespace)?;
        }
        self.node = Some(node);
        Ok(())
    }

    /// Publishes a sample of each edge; false if there was none.
    fn forward(&mut self) -> anyhow::Result<bool> {
        let mut data = Vec::new();
        let mut has_any = false;
        for edge in &mut self.edges {
            match edge.forward(&mut data)? {
                Forwarded::NoSample => continue,
                Forwarded::Published => self.n_published += 1,
                Forwarded::Unpublished => self.n_unpublished += 1,
            }
            has_any = true;
        }
        Ok(has_any)
    }

    fn report_counts(&mut self) {
        let counts = (self.n_published, self.n_unpublished);
        if std::mem::replace(&mut self.reported, counts) != counts {
            let counts = [("published", counts.0), ("unpublished", counts.1)];
            self.operator.has_counted(counts.map(|(name, count)| (name.to_owned(), count)).into());
        }
    }

    /// Opens the session, or tries again after a pause. Samples that come meanwhile are counted and not published.
    fn reach(&mut self) {
        if self.node.is_some() || monotonic_nanos() < self.retry_nanos {
            return;
        }
        match self.open() {
            Ok(()) => match &self.form {
                Form::Ros(_) => print_diagnostic(&format!("publishes in {}, domain {}", self.namespace, self.domain)),
                Form::Json => print_diagnostic(&format!("publishes on {}/*", self.namespace)),
            },
            Err(error) => {
                self.edges.iter_mut().for_each(|edge| edge.close());
                self.service = None;
                self.retry_nanos = monotonic_nanos() + RETRY_NANOS;
                let error = error.to_string();
                if self.said.as_ref() != Some(&error) {
                    print_diagnostic(&format!("{error}; nothing is published until it answers"));
                    self.said = Some(error);
                }
            }
        }
        self.operator.beat();
    }
}

impl Source for Publishing<'_> {
    fn step(&mut self) -> anyhow::Result<Step> {
        self.reach();
        Ok(if self.forward()? { Step::Next } else { Step::Wait(None) })
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.report_counts();
        self.edges.iter().try_for_each(|edge| edge.connect())
    }

    /// Publishes the samples that are there, and ends the session.
    fn close(&mut self) {
        loop {
            match self.forward() {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => {
                    print_diagnostic(&format!("the last samples are not published: {error:#}"));
                    break;
                }
            }
        }
        self.edges.iter_mut().for_each(|edge| edge.close());
        self.service = None;
        self.node = None;
        self.report_counts();
    }
}

/// The definition of the messages with cells: that of a file, or a standard one.
///
/// # Errors
/// The type is unknown, or the file has no definition of it.
pub(crate) fn definition_of(name: &str, file: Option<&Path>) -> anyhow::Result<Definition> {
    if let Some(path) = file {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        return Definition::parse(name, &text).with_context(|| path.display().to_string());
    }
    standard::definition(name).with_context(|| {
        let known: Vec<&str> = standard::names().collect();
        format!(
            "the message type '{name}' is unknown: give its definition as 'cells_definition', or use one of {}",
            known.join(", ")
        )
    })
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{GraspScene, GraspTruth, LiftOutcome, RegraspAdvice};

    use super::*;

    /// The files of messages: `Header.msg` and so on.
    fn message_files() -> BTreeMap<String, String> {
        let mut files = BTreeMap::from([("Decision".to_owned(), DECISION.to_owned())]);
        let mut add = |schema: &str, definition: String| {
            let first = schema.rsplit('/').next().unwrap_or_default();
            let sections = format!("{}\nMSG: blindgrasp_msgs/{first}\n{definition}", "=".repeat(80));
            for section in sections.split(&format!("{}\nMSG: blindgrasp_msgs/", "=".repeat(80))).skip(1) {
                let (name, fields) = section.split_once('\n').expect("a name and fields");
                files.insert(name.into(), fields.into());
            }
        };
        add(TactileFrame::SCHEMA, TactileFrame::definition());
        add(ContactSet::SCHEMA, ContactSet::definition());
        add(GraspFeature::SCHEMA, GraspFeature::definition());
        add(Prediction::SCHEMA, Prediction::definition());
        add(LiftDecision::SCHEMA, LiftDecision::definition());
        add(GraspTruth::SCHEMA, GraspTruth::definition());
        add(LiftOutcome::SCHEMA, LiftOutcome::definition());
        add(RegraspAdvice::SCHEMA, RegraspAdvice::definition());
        add(GraspScene::SCHEMA, GraspScene::definition());
        files
    }

    #[test]
    fn a_call_gets_the_valid_decision_or_waits_for_the_next_or_gets_none() {
        let last = Arc::new(LastDecision::default());
        let decision = |grasp_id| LiftDecision { grasp_id, ..LiftDecision::default() };
        assert!(last.wait(Duration::ZERO).is_none());
        // One that is no longer valid is not told.
        last.set(&decision(1), monotonic_nanos() - 1);
        assert!(last.wait(Duration::from_millis(20)).is_none());
        last.set(&decision(2), monotonic_nanos() + 60_000_000_000);
        assert_eq!(last.wait(Duration::ZERO).map(|decision| decision.grasp_id), Some(2));
        last.set(&decision(3), 0);
        let other = Arc::clone(&last);
        let waiting = std::thread::spawn(move || other.wait(Duration::from_secs(60)).map(|found| found.grasp_id));
        std::thread::sleep(Duration::from_millis(20));
        last.set(&decision(4), monotonic_nanos() + 60_000_000_000);
        assert_eq!(waiting.join().expect("ended"), Some(4));
    }

    /// The file of the service.
    #[test]
    fn the_package_has_the_service_of_this_version() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/blindgrasp_msgs/srv/Decide.srv");
        if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
            std::fs::write(&path, DECIDE).expect("written");
        }
        assert_eq!(std::fs::read_to_string(&path).expect("readable"), DECIDE);
    }

    /// With BLINDGRASP_REMAKE the files are written.
    #[test]
    fn the_package_of_messages_is_that_of_this_version() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/blindgrasp_msgs/msg");
        let files = message_files();
        let is_made = std::env::var_os("BLINDGRASP_REMAKE").is_some();
        if is_made {
            std::fs::create_dir_all(&folder).expect("made");
        }
        for (name, text) in &files {
            let path = folder.join(format!("{name}.msg"));
            if is_made {
                std::fs::write(&path, text).expect("written");
            }
            assert_eq!(&std::fs::read_to_string(&path).expect("readable"), text, "{}", path.display());
        }
        assert_eq!(std::fs::read_dir(folder).expect("a folder").count(), files.len());
    }

    #[test]
    fn our_types_have_hashes() {
        let hashes = [
            decision_topic(&Arc::default()).map(|topic| topic.message),
            topic_of::<TactileFrame>("tactile").map(|topic| topic.message),
            topic_of::<ContactSet>("contacts").map(|topic| topic.message),
            topic_of::<GraspFeature>("feature").map(|topic| topic.message),
            topic_of::<Prediction>("prediction").map(|topic| topic.message),
        ];
        for message in hashes {
            assert!(message.expect("a definition").expect("of ROS 2").hash.starts_with("RIHS01_"));
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
