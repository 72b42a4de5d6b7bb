//! The description of an operator: the JSON that its program prints for `--describe`.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::param::{ParamDescription, ParamKind};
use crate::text::is_name;
use crate::text::quote;

/// The version of [`OperatorDescription`], and of the protocol behind it, that this module understands.
pub const PROTOCOL: u32 = 5;

/// The operator that carries edges to other machines. The launcher adds it; a dataflow file cannot name it.
pub const LINK_OPERATOR: &str = "link";

/// The answer of an operator to `--describe`.
///
/// ```json
/// {
///   "protocol": 5, "operator": "contacts", "version": "0.1.0", "summary": "Contacts from tactile cells",
///   "inputs": [{"name": "tactile", "type": "blindgrasp/TactileFrame/5"}],
///   "outputs": [{"name": "contacts", "type": "blindgrasp/ContactSet/2"}],
///   "params": [{"name": "hand", "kind": "path"},
///              {"name": "threshold_newtons", "kind": "number", "above": 0, "default": 0.2}],
///   "answers_each": true
/// }
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OperatorDescription {
    /// The version of the protocol: [`PROTOCOL`].
    pub protocol: u32,
    pub operator: String,
    pub version: String,
    /// One sentence for a person.
    #[serde(default)]
    pub summary: String,
    #[serde(default)]
    pub inputs: Vec<PortDescription>,
    /// A graph may leave outputs unread.
    #[serde(default)]
    pub outputs: Vec<PortDescription>,
    #[serde(default)]
    pub params: Vec<ParamDescription>,
    /// It answers each sample of its first input with one of the same number, whether it has a state or not. The node before
    /// it keeps the samples that readers behind it have not answered. So an instance with a state can take the place of one
    /// without, and the other way round, and can be killed together with its neighbours.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub answers_each: bool,
    /// It opens sockets of the network while it runs: its sandbox leaves it those.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub uses_network: bool,
    /// Its program knows nothing of shared memory: a process of blindgrasp has its ports, and gives it the samples over two
    /// pipes ([`host`](crate::host)).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub hosted: bool,
}

/// An input or output of an operator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PortDescription {
    /// Unique among the inputs or outputs.
    pub name: String,
    /// The name of the type of its samples, like `blindgrasp/TactileFrame/5`. An edge joins equal names.
    #[serde(rename = "type")]
    pub type_name: String,
    /// A node may leave this input unconnected.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
    /// The samples of this input may come, by way of other nodes, from the node's own outputs. Such an input does not count
    /// where nodes are put in order, and a node that has no other inputs is a source.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub feedback: bool,
    /// Its samples are found by the stamps of those of the first input: see [`partner`](crate::partner).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partner: bool,
    /// One sentence for a person.
    #[serde(default)]
    pub summary: String,
}

impl PortDescription {
    fn new(name: &str, type_name: &str, summary: &str) -> Self {
        Self {
            name: name.into(),
            type_name: type_name.into(),
            optional: false,
            feedback: false,
            partner: false,
            summary: summary.into(),
        }
    }
}

/// Why a text is not an [`OperatorDescription`].
#[derive(Debug, thiserror::Error)]
pub enum DescriptionError {
    #[error("not a description: {0}")]
    Json(#[from] serde_json::Error),
    #[error("speaks protocol {found}, but this blindgrasp speaks protocol {PROTOCOL}")]
    Protocol { found: u32 },
    #[error("contradictory description: {0}")]
    Contradiction(String),
}

impl OperatorDescription {
    /// The description of an operator that is built with this version of blindgrasp, without ports and params.
    pub fn new(operator: &str, summary: &str) -> Self {
        let version = env!("CARGO_PKG_VERSION").into();
        let (inputs, outputs, params) = (Vec::new(), Vec::new(), Vec::new());
        Self {
            protocol: PROTOCOL,
            operator: operator.into(),
            version,
            summary: summary.into(),
            inputs,
            outputs,
            params,
            answers_each: false,
            uses_network: false,
            hosted: false,
        }
    }

    /// Of an operator that answers each sample with one of the same number.
    #[must_use]
    pub fn answers_each(self) -> Self {
        Self { answers_each: true, ..self }
    }

    /// Of an operator that opens sockets of the network while it runs.
    #[must_use]
    pub fn uses_network(self) -> Self {
        Self { uses_network: true, ..self }
    }

    /// With one more required input.
    #[must_use]
    pub fn input(mut self, name: &str, type_name: &str, summary: &str) -> Self {
        self.inputs.push(PortDescription::new(name, type_name, summary));
        self
    }

    /// With one more input that may be left unconnected.
    #[must_use]
    pub fn optional_input(mut self, name: &str, type_name: &str, summary: &str) -> Self {
        let port = PortDescription::new(name, type_name, summary);
        self.inputs.push(PortDescription { optional: true, ..port });
        self
    }

    /// With one more required input whose samples may come from the node's own outputs.
    #[must_use]
    pub fn feedback_input(mut self, name: &str, type_name: &str, summary: &str) -> Self {
        self.inputs.push(PortDescription { feedback: true, ..PortDescription::new(name, type_name, summary) });
        self
    }

    /// With one more required input, whose samples are found by the stamps of those of the first input.
    #[must_use]
    pub fn partner_input(mut self, name: &str, type_name: &str, summary: &str) -> Self {
        self.inputs.push(PortDescription { partner: true, ..PortDescription::new(name, type_name, summary) });
        self
    }

    /// With one more output.
    #[must_use]
    pub fn output(mut self, name: &str, type_name: &str, summary: &str) -> Self {
        self.outputs.push(PortDescription::new(name, type_name, summary));
        self
    }

    /// With one more param. Without a default it is required.
    #[must_use]
    pub fn param(mut self, name: &str, kind: ParamKind, default: Option<Value>, summary: &str) -> Self {
        let (name, summary) = (name.into(), summary.into());
        self.params.push(ParamDescription { name, kind, default, optional: false, live: false, summary });
        self
    }

    /// With one more param that may be left out.
    #[must_use]
    pub fn optional_param(mut self, name: &str, kind: ParamKind, summary: &str) -> Self {
        let (name, summary) = (name.into(), summary.into());
        self.params.push(ParamDescription { name, kind, default: None, optional: true, live: false, summary });
        self
    }

    /// As [`OperatorDescription::param`], for a param that can be changed while the operator runs.
    #[must_use]
    pub fn live_param(mut self, name: &str, kind: ParamKind, default: Option<Value>, summary: &str) -> Self {
        let (name, summary) = (name.into(), summary.into());
        self.params.push(ParamDescription { name, kind, default, optional: false, live: true, summary });
        self
    }

    /// Reads the answer of a program to `--describe`.
    ///
    /// # Errors
    /// The answer is not JSON, lacks or adds a field, is of another protocol or contradicts itself.
    pub fn from_json(json: &str) -> Result<Self, DescriptionError> {
        #[derive(Deserialize)]
        struct Spoken {
            protocol: u32,
        }
        // This comes first, because another protocol may have other fields.
        let Spoken { protocol: found } = serde_json::from_str(json)?;
        if found != PROTOCOL {
            return Err(DescriptionError::Protocol { found });
        }
        let description: Self = serde_json::from_str(json)?;
        description.validate()?;
        Ok(description)
    }

    /// Checks protocol, names, bounds and defaults.
    ///
    /// # Errors
    /// The description is of another protocol or contradicts itself.
    pub fn validate(&self) -> Result<(), DescriptionError> {
        if self.protocol != PROTOCOL {
            return Err(DescriptionError::Protocol { found: self.protocol });
        }
        let names = [
            ("input", self.inputs.iter().map(|port| port.name.as_str()).collect::<Vec<_>>()),
            ("output", self.outputs.iter().map(|port| port.name.as_str()).collect()),
            ("param", self.params.iter().map(|param| param.name.as_str()).collect()),
        ];
        for (what, names) in names {
            let mut seen = BTreeSet::new();
            for name in names {
                if !is_name(name) {
                    return contradiction(format!("{} is not a name for an {what}", quote(name)));
                }
                if !seen.insert(name) {
                    return contradiction(format!("{what} {} is there twice", quote(name)));
                }
            }
        }
        for port in self.inputs.iter().chain(&self.outputs) {
            if port.type_name.is_empty() {
                return contradiction(format!("port {} has no type", quote(&port.name)));
            }
        }
        if let Some(port) = self.outputs.iter().find(|port| port.optional) {
            return contradiction(format!("output {} is optional; every output is", quote(&port.name)));
        }
        if let Some(port) = self.outputs.iter().find(|port| port.feedback) {
            return contradiction(format!("output {} is feedback; only an input can be", quote(&port.name)));
        }
        self.params.iter().try_for_each(|param| param.validate()).map_err(DescriptionError::Contradiction)
    }
}

fn contradiction(what: String) -> Result<(), DescriptionError> {
    Err(DescriptionError::Contradiction(what))
}
