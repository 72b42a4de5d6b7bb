//! Publishes samples of the graph as topics of ROS 2.
//!
//! It reads calls of the service `decide` from the network, and nothing else; a call tells a decision and changes nothing.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail};
use blindgrasp_messages::files::read_regular;
use blindgrasp_messages::{ContactSet, GraspFeature, LiftDecision, Prediction, Recorded, Stamped, TactileFrame};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operators::beginning::FileNode;
use blindgrasp_operators::connection::{ConnectionParams, warn_if_open, with_network_params};
use blindgrasp_operators::{cell_points, hand_markers};
use blindgrasp_recording::cdr;
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::network::Network;
use blindgrasp_ros::standard;
use blindgrasp_ros_node::node::{Convention, MessageType, Quality, Rights, RosNode, open, topic_name};
use blindgrasp_stages::hand::Hand;
use serde::Deserialize;

use super::publishing::{Forward, Node, Outside, Topic, check_inputs, edge, publish};
use super::ros2_decision::{Decision, LastDecision, decide_type, decision_type};

/// The least time between two pictures of the hand: 10 a second.
const MARKER_NANOS: u64 = 100_000_000;

/// The parameters of a connection to ROS 2.
#[derive(Deserialize, Clone)]
pub(crate) struct NetworkParams {
    #[serde(flatten)]
    pub(crate) connection: ConnectionParams,
    pub(crate) convention: Option<Convention>,
    pub(crate) domain: Option<u32>,
    pub(crate) namespace: Option<String>,
}

#[derive(Deserialize)]
struct Params {
    hand: Option<PathBuf>,
    #[serde(flatten)]
    network: NetworkParams,
}

impl NetworkParams {
    /// # Errors
    /// An endpoint or the namespace is not valid.
    pub(crate) fn network(&self) -> anyhow::Result<(Network, u32, String)> {
        let network = self.connection.network()?;
        let namespace = self.namespace.clone().unwrap_or_else(|| "/blindgrasp".into());
        topic_name(&namespace, "decision").with_context(|| format!("namespace '{namespace}'"))?;
        if self.convention() == Convention::Ros2dds && self.domain.is_some() {
            bail!(
                "the keys of zenoh-bridge-ros2dds have no domain: give it to the bridge, and leave the param 'domain' out"
            );
        }
        Ok((network, self.domain.unwrap_or(0), namespace))
    }

    pub(crate) fn convention(&self) -> Convention {
        self.convention.unwrap_or_default()
    }
}

pub(crate) fn describe() -> OperatorDescription {
    let mut description = OperatorDescription::new("ros2", "Publishes samples as topics of ROS 2");
    for (name, type_name, summary) in [
        ("decision", LiftDecision::TYPE_NAME, "Topic and service: decision, decide"),
        (
            "tactile",
            TactileFrame::TYPE_NAME,
            "Topic tactile; with the param 'hand', joint_states, cell_points and hand_markers as well",
        ),
        ("contacts", ContactSet::TYPE_NAME, "Topics contacts and contact_points"),
        ("feature", GraspFeature::TYPE_NAME, "Topic feature"),
        ("prediction", Prediction::TYPE_NAME, "Topic prediction"),
    ] {
        description = description.optional_input(name, type_name, summary);
    }
    with_network_params(description.uses_network()).optional_param(
        "hand",
        ParamKind::Path { must_exist: true },
        "The hand's pad layout (YAML), for joint_states, cell_points and hand_markers",
    )
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let ((network, domain, namespace), hand) = network_and_hand(&params)?;
    check_inputs(operator.inputs())?;
    warn_if_open(&network);
    let convention = params.network.convention();
    let mut edges: Vec<Box<dyn Forward>> = Vec::new();
    let last = Arc::new(LastDecision::default());
    edges.extend(edge::<LiftDecision>(operator, "decision", vec![decision_topic(&last)?])?);
    let decides = !edges.is_empty();
    edges.extend(edge::<TactileFrame>(operator, "tactile", tactile_topics(hand)?)?);
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
    let opened = match convention {
        Convention::RmwZenoh => format!("publishes in {namespace}, domain {domain}"),
        Convention::Ros2dds => format!("publishes in {namespace}, for zenoh-bridge-ros2dds"),
    };
    // A service of the bridge has another attachment than one of rmw_zenoh.
    let decides = decides && convention == Convention::RmwZenoh;
    let service = if decides { Some(decide_type()?) } else { None };
    let prefix = namespace.clone();
    let answers = if decides { vec![convention.key(domain, &topic_name(&namespace, "decide")?)] } else { vec![] };
    let sends = vec![convention.keys_below(domain, &namespace)];
    let rights = Rights { takes: vec![], sends, answers };
    let open = Box::new(move || {
        let mut node = RosNode::new(open(&network, &rights)?, convention, domain, &namespace, "blindgrasp")?;
        if let Some((message, request_type)) = service.clone() {
            let (name, last) = (topic_name(&namespace, "decide")?, Arc::clone(&last));
            node.service(&name, &message, move |request| last.answer(&request_type, request))?;
        }
        Ok(Node::Ros(node))
    });
    publish(operator, Outside { open, prefix, opened }, edges)
}

/// The topics of frames. Three of them need the hand.
fn tactile_topics(hand: Option<Hand>) -> anyhow::Result<Vec<Topic<TactileFrame>>> {
    let mut topics = vec![topic_of::<TactileFrame>("tactile")?];
    let Some(hand) = hand else { return Ok(topics) };
    let joint_names: Vec<String> = hand.joints.iter().map(|joint| joint.name.clone()).collect();
    topics.push(Topic {
        name: "joint_states",
        message: Some(standard_type("sensor_msgs/msg/JointState")?),
        quality: Quality::Sensor,
        encode: Box::new(move |sample, data| cdr::joint_state(&sample.header, &joint_names, &sample.message, data)),
        interval_nanos: 0,
    });
    let hand = Arc::new(hand);
    let of_cells = Arc::clone(&hand);
    topics.push(Topic {
        name: "cell_points",
        message: Some(standard_type("sensor_msgs/msg/PointCloud2")?),
        quality: Quality::Sensor,
        encode: Box::new(move |sample, data| cell_points(&of_cells, sample, data)),
        interval_nanos: 0,
    });
    topics.push(Topic {
        name: "hand_markers",
        message: Some(standard_type("visualization_msgs/msg/MarkerArray")?),
        quality: Quality::Sensor,
        encode: Box::new(move |sample, data| hand_markers(&hand, sample, data)),
        interval_nanos: MARKER_NANOS,
    });
    Ok(topics)
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    network_and_hand(&parse_params(&node.params)?)?;
    check_inputs(node.inputs.iter().map(|(port, is_lossless)| (port.as_str(), *is_lossless)))
}

type NetworkAndHand = ((Network, u32, String), Option<Hand>);

fn network_and_hand(params: &Params) -> anyhow::Result<NetworkAndHand> {
    let network = params.network.network()?;
    Ok((network, params.hand.as_deref().map(Hand::load).transpose()?))
}

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
        message: Some(decision_type()?),
        quality: Quality::KeepLast(1),
        encode: Box::new(move |sample, data| {
            let until_nanos = sample.header.valid_until_nanos();
            last.set(&sample.message, until_nanos);
            cdr::encode(&Decision::new(&sample.message, until_nanos), data)
        }),
        interval_nanos: 0,
    })
}

/// The definition of the messages with cells: that of a file, or a standard one.
///
/// # Errors
/// The type is unknown, or the file has no definition of it.
pub(crate) fn definition_of(name: &str, file: Option<&Path>) -> anyhow::Result<Definition> {
    if let Some(path) = file {
        let text = read_regular(path).with_context(|| path.display().to_string())?;
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
    use blindgrasp_messages::{GraspScene, GraspTruth, LiftOutcome};

    use std::collections::BTreeMap;

    use super::super::ros2_decision::DECISION;
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
        add(LiftOutcome::SCHEMA, LiftOutcome::definition());
        add(GraspScene::SCHEMA, GraspScene::definition());
        add(GraspTruth::SCHEMA, GraspTruth::definition());
        files
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
}
