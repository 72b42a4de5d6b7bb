//! The launcher's knowledge of the other machines of its graph.

use std::collections::BTreeSet;
use std::time::Instant;

use crate::dataflow::{LocalView, Node};
use blindgrasp_operator::link_status::{LinkStatus, PeerState};

/// When the graph ends, a machine that is cut off is waited for this long.
const AWAY_MILLIS: u64 = 3000;

/// What the link to the other machines has said, over all its processes.
#[derive(Clone, Default)]
pub(super) struct LinkBook {
    /// The ports that come from other machines; `None` for a graph on one machine.
    local: Option<LocalView>,
    status: Option<LinkStatus>,
    /// The counts of earlier processes of the link.
    before: LinkStatus,
    /// The process that gave the status.
    process: u64,
    /// Ports of other machines that have ended.
    ended_imports: BTreeSet<String>,
    /// Nodes that are drained, in the order in which they were.
    pub(super) ended_nodes: Vec<String>,
    /// The graph ends on request, even if sources on other machines go on.
    pub(super) was_stopped: bool,
    /// Until when the link is awaited to say that it takes no more samples of those sources.
    pub(super) takes_more_until: Option<Instant>,
}

impl LinkBook {
    pub(super) fn new(local: Option<LocalView>) -> LinkBook {
        LinkBook { local, ..LinkBook::default() }
    }

    /// Takes a status of the link's process with this id.
    pub(super) fn on_status(&mut self, process: u64, status: LinkStatus) {
        if std::mem::replace(&mut self.process, process) != process {
            self.before = self.status.take().unwrap_or_default();
        }
        self.status = Some(status.with_counts_of(&self.before));
    }

    pub(super) fn on_ended_imports(&mut self, ports: Vec<String>) {
        self.ended_imports = ports.into_iter().collect();
    }

    pub(super) fn status(&self) -> Option<&LinkStatus> {
        self.status.as_ref()
    }

    /// Whether this is one machine's part of a graph.
    pub(super) fn is_part(&self) -> bool {
        self.local.is_some()
    }

    /// The other machine that runs a node.
    pub(super) fn machine_of(&self, node: &str) -> Option<&String> {
        self.local.as_ref()?.elsewhere.get(node)
    }

    /// Whether a source on another machine goes on, whose samples are awaited here.
    pub(super) fn awaits_source(&self) -> bool {
        self.driven_ports().any(|port| !self.ended_imports.contains(port))
    }

    /// The ports of sources on other machines.
    pub(super) fn driven_ports(&self) -> impl Iterator<Item = &String> {
        let imports = self.local.iter().flat_map(|local| &local.imports);
        imports.filter(|(_, is_driven)| *is_driven).map(|(port, _)| port)
    }

    /// Whether a sample may still come to a node from a machine that is there.
    pub(super) fn may_feed(&self, node: &Node) -> bool {
        let Some(local) = &self.local else { return false };
        node.inputs.iter().any(|input| {
            let port = format!("{}/{}", input.from_node, input.from_port);
            // A graph that is stopped does not wait for the sources of other machines to end, but for its own link.
            let is_link_awaited = self.takes_more_until.is_some_and(|until| Instant::now() < until);
            let is_awaited = local
                .imports
                .iter()
                .any(|(import, is_driven)| *import == port && (!(*is_driven && self.was_stopped) || is_link_awaited));
            is_awaited && !self.ended_imports.contains(&port) && self.may_come(&port)
        })
    }

    fn may_come(&self, port: &str) -> bool {
        let peers = self.status.iter().flat_map(|status| &status.peers);
        let mut with_port =
            peers.filter(|peer| peer.channels.iter().any(|channel| !channel.is_sent && channel.port == port));
        with_port.any(|peer| match peer.state {
            PeerState::Up => true,
            PeerState::Down => peer.silent_millis.is_some_and(|silent| silent < AWAY_MILLIS),
            PeerState::Waiting => peer.n_times_up > 0, // A link that was started again looks for it.
            PeerState::Left | PeerState::Refused => false,
        })
    }
}
