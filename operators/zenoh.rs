//! Publishes samples of the graph as JSON on keys of Zenoh. It reads nothing from the network.

use anyhow::Context as _;
use blindgrasp_messages::{
    ContactSet, GraspFeature, LiftDecision, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_ros::node::{Quality, topic_name};
use serde::{Deserialize, Serialize};

use super::connection::{ConnectionParams, with_connection_params};
use super::publishing::{Encode, Forward, Node, Outside, Topic, edge, publish};

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
    let params: Params = operator.params()?;
    let network = params.connection.network()?;
    let prefix = params.prefix.unwrap_or_else(|| "blindgrasp".into());
    // The words of a prefix are those of a topic's name.
    topic_name("/", &format!("/{prefix}"))
        .with_context(|| format!("prefix '{prefix}': expected words of letters, digits and _, with / between them"))?;
    let mut edges: Vec<Box<dyn Forward>> = Vec::new();
    edges.extend(json_edge::<LiftDecision>(operator, "decision", Quality::KeepLast(1))?);
    edges.extend(json_edge::<TactileFrame>(operator, "tactile", Quality::Sensor)?);
    edges.extend(json_edge::<ContactSet>(operator, "contacts", Quality::Sensor)?);
    edges.extend(json_edge::<GraspFeature>(operator, "feature", Quality::Sensor)?);
    edges.extend(json_edge::<Prediction>(operator, "prediction", Quality::Sensor)?);
    let opened = format!("publishes on {prefix}/*");
    let open = Box::new(move || Ok(Node::Json(network.open()?)));
    publish(operator, Outside { open, prefix, opened }, edges)
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
