//! The state of a graph in words for people.

use std::collections::BTreeMap;

use crate::control::{EdgeStatus, GraphState, GraphStatus, NodeState};
use crate::log::printable;
use blindgrasp_operator::link_status::{PeerState, PeerStatus};
use blindgrasp_operator::wiring::EdgePolicy;

/// Another machine's clock minus this machine's.
pub fn clock_offset(peer: &PeerStatus) -> String {
    let Some(offset) = peer.offset_nanos else { return "-".into() };
    let uncertainty = peer.uncertainty_nanos.map_or(String::new(), |nanos| format!(" ±{}", short_time(nanos)));
    format!("{}{}{uncertainty}", if offset < 0 { '-' } else { '+' }, short_time(offset.unsigned_abs()))
}

/// A state in which a machine takes no part is written large.
pub fn peer_state_word(state: PeerState) -> &'static str {
    match state {
        PeerState::Waiting => "waiting",
        PeerState::Up => "up",
        PeerState::Down => "CUT OFF",
        PeerState::Left => "left",
        PeerState::Refused => "REFUSED",
    }
}

/// The troubles of a graph, in words.
pub fn warnings(status: &GraphStatus) -> Vec<String> {
    let mut warnings: Vec<String> = status.message.iter().cloned().collect();
    let failed: Vec<&str> =
        status.nodes.iter().filter(|node| node.state == NodeState::Failed).map(|node| node.node.as_str()).collect();
    if status.state == GraphState::Degraded {
        let which = if failed.is_empty() { "an operator".into() } else { failed.join(", ") };
        warnings.push(format!("grasps are not decided without {which}: swap it (blindgrasp swap) or stop the graph"));
    }
    for EdgeStatus { policy, dropped, from, to, capacity, .. } in &status.edges {
        // The last samples wait for the swap of a reader that has failed.
        let has_failed = failed.iter().any(|node| to.split('/').next() == Some(node));
        let n_lost = dropped.saturating_sub(if has_failed { *capacity as u64 } else { 0 });
        if *policy == EdgePolicy::Lossless && n_lost > 0 {
            warnings.push(format!("{n_lost} samples were lost between {from} and {to}, whose edge is lossless"));
        }
    }
    warnings.extend(status.link.iter().flat_map(|link| &link.peers).filter_map(trouble));
    warnings
}

/// The reason why another machine takes no part.
fn trouble(peer: &PeerStatus) -> Option<String> {
    let machine = &peer.machine;
    let reason = peer.reason.as_ref().map_or(String::new(), |reason| format!(": {reason}"));
    match peer.state {
        PeerState::Up => None,
        PeerState::Waiting => Some(format!("machine '{machine}' has not been found yet{reason}")),
        PeerState::Left => Some(format!("machine '{machine}' has left the graph: it was stopped there{reason}")),
        PeerState::Refused => Some(format!("machine '{machine}' and this one do not fit{reason}")),
        PeerState::Down => {
            let silent = peer.silent_millis.map_or(String::new(), |millis| {
                format!(": it has said nothing for {}", short_time(millis.saturating_mul(1_000_000)))
            });
            Some(format!("machine '{machine}' is cut off{silent}{reason}"))
        }
    }
}

/// A state in which grasps are not decided is written large.
pub fn state_word(state: GraphState) -> &'static str {
    match state {
        GraphState::Starting => "starting",
        GraphState::Running => "running",
        GraphState::Degraded => "DEGRADED",
        GraphState::Stopping => "stopping",
    }
}

/// A failure is written large.
pub fn node_state_word(state: NodeState) -> &'static str {
    match state {
        NodeState::Starting => "starting",
        NodeState::Running => "running",
        NodeState::Restarting => "restarting",
        NodeState::Done => "done",
        NodeState::Failed => "FAILED",
    }
}

/// The counts of a node in words, without zeros.
pub fn shown_counts(counts: &BTreeMap<String, u64>) -> Vec<String> {
    let counted = counts.iter().filter(|(_, count)| **count > 0);
    counted.map(|(name, count)| printable(&format!("{name} {count}"))).collect()
}

/// A duration in at most six letters.
pub fn short_time(nanos: u64) -> String {
    let micros = nanos as f64 / 1e3;
    match micros {
        0.0..9.95 => format!("{micros:.1}µs"),
        9.95..999.5 => format!("{micros:.0}µs"),
        999.5..9_950.0 => format!("{:.1}ms", micros / 1e3),
        9_950.0..999_500.0 => format!("{:.0}ms", micros / 1e3),
        999_500.0..9_950_000.0 => format!("{:.1}s", micros / 1e6),
        9_950_000.0..1e9 => format!("{:.0}s", micros / 1e6),
        _ => format!("{:.0}min", micros / 6e7),
    }
}

/// Samples a second in at most five letters.
pub fn short_rate(rate_hz: f64) -> String {
    match rate_hz {
        0.0 => "0".into(),
        0.0..99.95 => format!("{rate_hz:.1}"),
        _ => format!("{rate_hz:.0}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::made_status;

    #[test]
    fn a_machine_that_takes_no_part_says_why() {
        let of = |state, silent_millis| {
            let peer = PeerStatus { machine: "brain".into(), state, silent_millis, ..PeerStatus::default() };
            trouble(&peer).unwrap_or_default()
        };
        assert_eq!(of(PeerState::Up, Some(5)), "");
        assert_eq!(of(PeerState::Down, Some(1300)), "machine 'brain' is cut off: it has said nothing for 1.3s");
        assert_eq!(of(PeerState::Waiting, None), "machine 'brain' has not been found yet");
        assert!(of(PeerState::Left, None).contains("stopped there"));
        assert_eq!(clock_offset(&PeerStatus::default()), "-");
    }

    #[test]
    fn a_loss_on_a_lossless_edge_is_said_in_words() {
        let mut status = made_status("gate");
        (status.state, status.message) = (GraphState::Running, None);
        assert_eq!(warnings(&status), Vec::<String>::new());
        status.edges[0].policy = EdgePolicy::Lossless;
        let expected = "samples were lost between contacts/contacts and classifier/contacts, whose edge is lossless";
        // The last four wait for the swap of the classifier, which has failed.
        assert_eq!(warnings(&status), [format!("6 {expected}")]);
        status.nodes[1].state = NodeState::Running;
        assert_eq!(warnings(&status), [format!("10 {expected}")]);
    }

    #[test]
    fn numbers_stay_short() {
        let cases = [
            (0, "0.0µs"),
            (1_500, "1.5µs"),
            (84_300, "84µs"),
            (999_499, "999µs"),
            (999_500, "1.0ms"),
            (12_400_000, "12ms"),
            (1_240_000_000, "1.2s"),
            (59_000_000_000, "59s"),
            (3_600_000_000_000, "60min"),
        ];
        for (nanos, expected) in cases {
            assert_eq!(short_time(nanos), expected);
        }
        assert_eq!([0.0, 0.25, 99.94, 991.6].map(short_rate), ["0", "0.2", "99.9", "992"]);
    }
}
