//! What a recording of a running graph says about the graph.

use std::collections::BTreeMap;

use blindgrasp_recording::RecordingInfo;
use serde::{Deserialize, Serialize};

/// When a recording began.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beginning {
    /// Before the graph had sent anything.
    Start,
    /// While it ran.
    Attached,
}

/// How a recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// With the graph.
    Graph,
    /// The graph went on.
    Detached,
    /// With the graph, but not with all that was on its way: it failed, or was killed.
    Broken,
}

impl Ending {
    /// As it stands in the recording.
    pub fn word(self) -> &'static str {
        match self {
            Ending::Graph => "graph",
            Ending::Detached => "detached",
            Ending::Broken => "broken",
        }
    }
}

/// What a recording needs to know of its graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recording {
    /// Hand and graph.
    pub info: RecordingInfo,
    /// The hand's; empty if it is not known.
    pub joint_names: Vec<String>,
    /// By name, then by key: MCAP's metadata.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}
