//! The summary of a run, for a person.

use std::collections::BTreeMap;

use crate::text_table::{TextTable, percent};
use blindgrasp_graph::client::words::shown_counts;
use blindgrasp_graph::run::{Latency, RunSummary};
use blindgrasp_operator::link_status::{ChannelStatus, PeerStatus};
use blindgrasp_operator::text::counted;

/// The lines of the summary: figures, then a table of the edges.
pub(super) fn table(summary: &RunSummary) -> Vec<String> {
    let rows = figures(summary).into_iter().map(|(name, value)| format!("{name:<16} {value}"));
    let mut edges = TextTable::new(["edge from", "to", "sent", "received", "dropped", "missing", "late"], 2);
    for edge in &summary.edges {
        let counts = [edge.sent, edge.received, edge.dropped, edge.missing, edge.late].map(|count| count.to_string());
        edges.row([edge.from.clone(), edge.to.clone()].into_iter().chain(counts));
    }
    std::iter::once(String::new()).chain(rows).chain([String::new()]).chain(edges.lines()).collect()
}

fn figures(summary: &RunSummary) -> Vec<(&'static str, String)> {
    let probes =
        if summary.probes > 0 { format!(", after {}", counted(summary.probes, "probe")) } else { String::new() };
    let end = if summary.end == "finished" { String::new() } else { format!("; the graph was {}", summary.end) };
    let (grasps, lift, hold, undecided) = (summary.grasps, summary.lift, summary.hold, summary.undecided);
    let mut figures =
        vec![("grasps", format!("{grasps} ({lift} LIFT, {hold} HOLD{probes}), {undecided} undecided{end}"))];
    // Live grasps have no truth to be measured by.
    if summary.with_truth > 0 {
        let (accuracy, majority) = (percent(summary.accuracy), percent(summary.majority_class));
        let judged = &summary.judged;
        figures.extend([
            ("accuracy", format!("{accuracy} of {} with a label (majority class {majority})", summary.with_truth)),
            (
                "false positives",
                format!("{} ({} of all grasps)", summary.false_positives, percent(summary.false_positive_share)),
            ),
            (
                "judged",
                format!(
                    "{}: accuracy {}, {} ({})",
                    counted(judged.n_grasps, "grasp"),
                    percent(judged.accuracy),
                    counted(judged.n_false_positive, "false positive"),
                    percent(judged.false_positive_share)
                ),
            ),
        ]);
    }
    let reasons: Vec<String> = summary.reasons.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    let lost = match (summary.edges_unknown, summary.samples_dropped) {
        (0, 0) => summary.samples_lost.to_string(),
        (0, n) => format!("{}, dropped for newer ones: {n}", summary.samples_lost),
        (n, _) => format!("{}, unknown on {}", summary.samples_lost, counted(n, "edge")),
    };
    figures.extend([
        ("reasons", reasons.join(", ")),
        ("latency", summary.latency_nanos.as_ref().map_or("n/a".into(), latency)),
        ("samples lost", lost),
        ("restarts, swaps", format!("{}, {}", summary.restarts, summary.swaps)),
    ]);
    let machines: Vec<String> = summary.link.iter().flat_map(|link| &link.peers).map(machine).collect();
    let rare = [("machines", machines.join("; ")), ("counts", counts(&summary.counts))];
    figures.extend(rare.into_iter().filter(|(_, text)| !text.is_empty()));
    figures
}

/// The counts of the nodes in words, without zeros. If no lift was reported, as none is in a recording, the number of those
/// without a report says nothing.
fn counts(of_nodes: &BTreeMap<String, BTreeMap<String, u64>>) -> String {
    let mut shown = Vec::new();
    for (node, counts) in of_nodes {
        let is_reported = ["lifts/kept", "lifts/dropped"].iter().any(|name| counts.get(*name) > Some(&0));
        let mut words = shown_counts(counts);
        words.retain(|word| is_reported || !word.starts_with("lifts/unreported "));
        if !words.is_empty() {
            shown.push(format!("{node}: {}", words.join(", ")));
        }
    }
    shown.join("; ")
}

fn latency(latency: &Latency) -> String {
    let [p50, p90, p99, max] =
        [latency.p50, latency.p90, latency.p99, latency.max].map(|nanos| format!("{:.0} µs", nanos as f64 / 1e3));
    format!("source to decision: p50 {p50}, p90 {p90}, p99 {p99}, max {max}")
}

fn machine(peer: &PeerStatus) -> String {
    let total = |count: fn(&ChannelStatus) -> u64, is_sent: bool| {
        peer.channels.iter().filter(|channel| channel.is_sent == is_sent).map(count).sum::<u64>()
    };
    format!(
        "{} found {}×, {} samples to it ({} again, {} lost), {} from it",
        peer.machine,
        peer.n_times_up,
        total(|channel| channel.n_samples, true),
        total(|channel| channel.n_repeated, true),
        total(|channel| channel.n_lost, true),
        total(|channel| channel.n_samples, false)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_has_no_zeros_and_counts_no_lifts_that_nobody_reports() {
        let of_node = |kept, unreported| {
            let counts = [("lifts/dropped", 0), ("lifts/kept", kept), ("lifts/unreported", unreported)];
            BTreeMap::from([("lift_arbiter".to_owned(), counts.map(|(name, n)| (name.to_owned(), n)).into())])
        };
        assert_eq!(counts(&of_node(0, 116)), "");
        assert_eq!(counts(&of_node(3, 2)), "lift_arbiter: lifts/kept 3, lifts/unreported 2");
    }
}
