//! The facts about a graph that its recording holds, and how a recording begins and ends.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// When a recording began.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beginning {
    /// Before the graph had sent a sample.
    Start,
    /// While the graph ran.
    Attached,
}

/// How a recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// With the graph.
    Graph,
    /// The graph went on.
    Detached,
    /// With the graph, which failed or was killed: the last samples may be missing.
    Broken,
}

impl Ending {
    /// The word in the recording.
    pub fn word(self) -> &'static str {
        match self {
            Ending::Graph => "graph",
            Ending::Detached => "detached",
            Ending::Broken => "broken",
        }
    }
}

/// The facts about a graph that its recording holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordedGraph {
    /// The hand's name; `unknown` if no node has a hand.
    pub hand: String,
    /// The hand's identity; 0 if unknown.
    pub hand_id: u64,
    pub made_by: String,
    /// The joint names of the hand; empty if it is not known.
    pub joint_names: Vec<String>,
    /// MCAP's metadata, by name, then by key.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}
