//! Publishes samples of the graph as JSON on keys of Zenoh. It reads nothing from the network.

use anyhow::ensure;
use blindgrasp_bridge::outside::{Rights, open};
use blindgrasp_graph::link::network::Network;
use blindgrasp_messages::{
    ContactSet, GraspFeature, Header, LiftDecision, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operators::beginning::FileNode;
use blindgrasp_operators::connection::{ConnectionParams, warn_if_open, with_connection_params};
use serde::{Deserialize, Serialize};

use super::publishing::{Encode, Forward, Outside, check_inputs, edge, publish};

pub(crate) fn describe() -> OperatorDescription {
    let mut description = OperatorDescription::new("zenoh", "Publishes samples as JSON on keys of Zenoh");
    for (name, type_name) in [
        ("decision", LiftDecision::TYPE_NAME),
        ("tactile", TactileFrame::TYPE_NAME),
        ("contacts", ContactSet::TYPE_NAME),
        ("feature", GraspFeature::TYPE_NAME),
        ("prediction", Prediction::TYPE_NAME),
    ] {
        description = description.optional_input(name, type_name, &format!("Key PREFIX/{name}"));
    }
    with_connection_params(description.uses_network()).optional_param(
        "prefix",
        ParamKind::String {},
        "Before the names of keys, blindgrasp by default",
    )
}

#[derive(Deserialize)]
struct Params {
    prefix: Option<String>,
    #[serde(flatten)]
    connection: ConnectionParams,
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let (network, prefix) = network_and_prefix(operator.params()?)?;
    check_inputs(operator.inputs())?;
    warn_if_open(&network);
    let mut edges: Vec<Box<dyn Forward>> = Vec::new();
    edges.extend(decision_edge(operator)?);
    edges.extend(json_edge::<TactileFrame>(operator, "tactile")?);
    edges.extend(json_edge::<ContactSet>(operator, "contacts")?);
    edges.extend(json_edge::<GraspFeature>(operator, "feature")?);
    edges.extend(json_edge::<Prediction>(operator, "prediction")?);
    let opened = format!("publishes on {prefix}/*");
    let rights = Rights { sends: vec![format!("{prefix}/**")], ..Rights::default() };
    let open = Box::new(move || open(&network, &rights));
    publish(operator, Outside { open, prefix, opened }, edges)
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    network_and_prefix(parse_params(&node.params)?)?;
    check_inputs(node.inputs.iter().map(|(port, is_lossless)| (port.as_str(), *is_lossless)))
}

fn network_and_prefix(params: Params) -> anyhow::Result<(Network, String)> {
    let network = params.connection.network()?;
    let prefix = params.prefix.unwrap_or_else(|| "blindgrasp".into());
    let is_word = |word: &str| {
        word.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
            && word.chars().all(|char| char.is_ascii_alphanumeric() || char == '_')
    };
    ensure!(
        prefix.split('/').all(is_word),
        "prefix '{prefix}': expected words of letters, digits and _, with / between them"
    );
    Ok((network, prefix))
}

/// A sample as it is published.
#[derive(Serialize)]
struct Sample<'a, M> {
    seq: u64,
    stamp_nanos: u64,
    /// For how long a decision is still valid when it is sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    valid_for_nanos: Option<u64>,
    data: &'a M,
}

/// An input whose samples are published as JSON.
fn json_edge<M: Message + Serialize>(
    operator: &Operator,
    name: &'static str,
) -> anyhow::Result<Option<Box<dyn Forward>>> {
    let encode: Encode<M> = Box::new(|Stamped { header, message }, data| write_json(header, None, message, data));
    edge(operator, name, false, encode)
}

/// The input of decisions: none is published as a lift once its time is over.
fn decision_edge(operator: &Operator) -> anyhow::Result<Option<Box<dyn Forward>>> {
    let encode: Encode<LiftDecision> = Box::new(|Stamped { header, message }, data| {
        let (until_nanos, now_nanos) = (header.valid_until_nanos(), monotonic_nanos());
        let mut decision = message.clone();
        decision.expire(until_nanos, now_nanos);
        write_json(header, Some(until_nanos.unwrap_or(0).saturating_sub(now_nanos)), &decision, data)
    });
    edge(operator, "decision", true, encode)
}

fn write_json(
    header: &Header,
    valid_for_nanos: Option<u64>,
    message: &impl Serialize,
    data: &mut Vec<u8>,
) -> Result<(), String> {
    let sample = Sample { seq: header.seq, stamp_nanos: header.stamp_nanos, valid_for_nanos, data: message };
    data.clear();
    serde_json::to_writer(data, &sample).map_err(|error| error.to_string())
}
