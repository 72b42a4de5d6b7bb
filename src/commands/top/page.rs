//! The lines that `top` shows.

use std::time::Duration;

use crate::commands::promises::shown_counts;
use crate::commands::text_table::TextTable;
use blindgrasp_graph::client::activity::{Look, Measured, MeasuredEdge, MeasuredNode, RUN, measure};
use blindgrasp_graph::client::words::{node_state_word, short_rate, short_time, state_word, warnings};
use blindgrasp_graph::control::{DecidedGrasp, GraphState, NodeState};
use blindgrasp_graph::log::printable;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_session::console::{RED, YELLOW};

/// Titles are bold (ECMA-48, Select Graphic Rendition).
const BOLD: u8 = 1;

/// A line, and the style of all of it where there are colours.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Line {
    pub(super) text: String,
    pub(super) style: Option<u8>,
}

/// Lines that are always shown, and rows that are counted if they do not fit.
struct Part {
    titles: Vec<Line>,
    rows: Vec<Line>,
    /// The word for a row.
    noun: &'static str,
}

/// The graph now, with rates since the look before, or since its start.
pub(super) fn lines(now: &Look, before: Option<&Look>, n_rows: usize, n_columns: usize) -> Vec<Line> {
    let measured = measure(now, before);
    let name_width = n_columns / 2;
    let parts = [
        head(now, &measured),
        node_part(&measured, name_width),
        edge_part(&measured, name_width),
        decision_part(now, &measured),
    ];
    let mut fitting = fitting(parts, n_rows);
    for line in &mut fitting {
        line.text = cut(&printable(&line.text), n_columns);
    }
    fitting
}

/// Of each part the titles and as many rows as of the others, as far as it has them; then the number of rows left out.
fn fitting(parts: [Part; 4], n_lines: usize) -> Vec<Line> {
    let n_titles: usize = parts.iter().map(|part| part.titles.len()).sum();
    let n_rows: usize = parts.iter().map(|part| part.rows.len()).sum();
    let mut n_free = n_lines.saturating_sub(n_titles);
    if n_free < n_rows {
        n_free = n_free.saturating_sub(1);
    }
    let mut n_shown = [0; 4];
    for _ in 0..n_free.min(n_rows) {
        let unfinished = (0..parts.len()).filter(|&idx| n_shown[idx] < parts[idx].rows.len());
        let Some(least) = unfinished.min_by_key(|&idx| n_shown[idx]) else { break };
        n_shown[least] += 1;
    }
    let mut lines = Vec::new();
    let mut left_out = Vec::new();
    for (mut part, n_shown) in parts.into_iter().zip(n_shown) {
        let n_more = part.rows.len() - n_shown;
        if n_more > 0 {
            left_out.push(format!("{n_more} more {}{}", part.noun, if n_more == 1 { "" } else { "s" }));
        }
        part.rows.truncate(n_shown);
        lines.append(&mut part.titles);
        lines.append(&mut part.rows);
    }
    if !left_out.is_empty() {
        // The first line stays in any case.
        lines.truncate(n_lines.saturating_sub(1).max(1));
        lines.push(plain(format!("… {}", left_out.join(", "))));
    }
    lines.truncate(n_lines);
    lines
}

/// The state of the graph and its warnings, or where its file is.
fn head(now: &Look, measured: &Measured) -> Part {
    let cpu = measured.cpu_percent.map_or("-".into(), |percent| format!("{percent:.1} %"));
    let load = measured.load_average.map_or("-".into(), |load| format!("{load:.2}"));
    // Whole seconds: more of them nobody reads.
    let uptime = humantime::format_duration(Duration::from_secs(measured.uptime_secs.max(0.0) as u64));
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    let text = format!(
        "{}  {}  up {uptime}  pid {}  cpu {cpu}  load {load} of {n_processors}",
        measured.graph,
        state_word(measured.state),
        measured.pid,
    );
    let style = if measured.state == GraphState::Degraded { RED } else { BOLD };
    let mut titles = vec![Line { text, style: Some(style) }];
    let warnings = warnings(&now.status);
    if warnings.is_empty() {
        titles.push(plain(now.status.file.display().to_string()));
    }
    let rows = warnings.into_iter().map(|text| Line { text, style: Some(RED) }).collect();
    Part { titles, rows, noun: "warning" }
}

fn node_part(measured: &Measured, name_width: usize) -> Part {
    let mut table = TextTable::new(["NODE", "STATE", "PID", "CPU%", "MEMORY", "RESTARTS"], 2);
    for node in &measured.nodes {
        table.row(node_row(node, name_width));
    }
    let mut part = part("node", &table, measured.nodes.iter().map(node_style));
    for (line, node) in part.rows.iter_mut().zip(&measured.nodes) {
        // Behind the table: a node may have many counts, and few nodes have any.
        let counts = shown_counts(&node.counts).join(", ");
        if !counts.is_empty() {
            line.text += &format!("  {counts}");
        }
    }
    part
}

fn node_row(node: &MeasuredNode, name_width: usize) -> Vec<String> {
    let pid = node.pid.map_or("-".into(), |pid| pid.to_string());
    vec![
        shortened(&node.node, name_width),
        node_state_word(node.state).into(),
        // A standby is there for a moment only: a second number would make the column jump.
        if node.standby_pid.is_some() { format!("{pid}+") } else { pid },
        node.cpu_percent.map_or("-".into(), |percent| format!("{percent:.1}")),
        node.resident_bytes.map_or("-".into(), |bytes| format!("{:.1}M", bytes as f64 / f64::from(1 << 20))),
        node.n_restarts.to_string(),
    ]
}

fn node_style(node: &MeasuredNode) -> Option<u8> {
    let is_down = matches!(node.state, NodeState::Failed | NodeState::Restarting);
    if is_down || node.n_restarts > 0 { Some(RED) } else { None }
}

fn edge_part(measured: &Measured, name_width: usize) -> Part {
    // A terminal of 80 columns has room for those in which a loss or a slow operator shows.
    let mut table = TextTable::new(["EDGE", "RATE/S", "P50", "P99", "DROP", "MISS", "LATE", "QUEUE", "BLOCKED"], 1);
    for edge in &measured.edges {
        table.row(edge_row(edge, name_width));
    }
    part("edge", &table, measured.edges.iter().map(edge_style))
}

fn edge_row(edge: &MeasuredEdge, name_width: usize) -> Vec<String> {
    let [p50, p99] = match edge.age_nanos {
        Some(age) => [age.p50, age.p99].map(short_time),
        None => ["-"; 2].map(String::from),
    };
    vec![
        shortened(&edge_label(edge), name_width),
        short_rate(edge.rate_hz),
        p50,
        p99,
        edge.dropped.to_string(),
        edge.missing.to_string(),
        edge.late.to_string(),
        edge.n_queued.to_string(),
        short_time(edge.blocked_nanos),
    ]
}

/// A `latest` edge loses samples as the dataflow file allows.
fn edge_style(edge: &MeasuredEdge) -> Option<u8> {
    let is_lossy = edge.dropped + edge.missing > 0;
    if edge.late > 0 || (is_lossy && edge.policy == EdgePolicy::Lossless) {
        Some(RED)
    } else if is_lossy {
        Some(YELLOW)
    } else {
        None
    }
}

/// The reader's port is left out where it is called as the writer's.
fn edge_label(edge: &MeasuredEdge) -> String {
    let writers_port = edge.from.split_once('/').map(|(_, port)| port);
    match edge.to.split_once('/') {
        Some((node, port)) if edge.to != RUN && writers_port == Some(port) => format!("{} → {node}", edge.from),
        _ => format!("{} → {}", edge.from, edge.to),
    }
}

/// How long decisions take, how many there were, and the last ones, the latest first.
fn decision_part(now: &Look, measured: &Measured) -> Part {
    let mut table = TextTable::new(["GRASP", "DECISION", "REASON", "P STABLE", "LATENCY", "AGO", "TRUTH"], 3);
    let now_nanos = monotonic_nanos();
    let latest = now.status.decisions.latest.iter().rev();
    for decided in latest.clone() {
        table.row(decision_row(decided, now_nanos));
    }
    let mut part =
        part("decision", &table, latest.map(|decided| if decided.is_false_positive() { Some(RED) } else { None }));
    let latency = measured.decision_latency_nanos.map_or("-".into(), |latency| {
        let [p50, p90, p99] = [latency.p50, latency.p90, latency.p99].map(short_time);
        format!("p50 {p50}  p90 {p90}  p99 {p99}")
    });
    let decisions = &measured.decisions;
    let mut text =
        format!("decided {}/s  LIFT {}  HOLD {}", short_rate(decisions.rate_hz), decisions.n_lift, decisions.n_hold);
    let mut style = None;
    if decisions.n_false_positives > 0 {
        text += &format!("  FALSE POSITIVES {}", decisions.n_false_positives);
        style = Some(RED);
    }
    part.titles.splice(0..0, [plain(format!("source to decision  {latency}")), Line { text, style }]);
    part
}

fn decision_row(decided: &DecidedGrasp, now_nanos: u64) -> Vec<String> {
    let truth = match decided.truth {
        Some(true) => "stable",
        Some(false) if decided.is_false_positive() => "UNSTABLE",
        Some(false) => "unstable",
        None => "-",
    };
    vec![
        decided.grasp_id.to_string(),
        decided.action.shown().into(),
        decided.reason.as_str().into(),
        format!("{:.3}", decided.probability_stable),
        decided.latency_nanos.map_or("-".into(), short_time),
        short_time(now_nanos.saturating_sub(decided.decided_nanos)),
        truth.into(),
    ]
}

fn part(noun: &'static str, table: &TextTable, styles: impl Iterator<Item = Option<u8>>) -> Part {
    let mut texts = table.lines().into_iter();
    let titles = texts.next().map(|text| Line { text, style: Some(BOLD) });
    let rows = texts.zip(styles).map(|(text, style)| Line { text, style });
    Part { titles: titles.into_iter().collect(), rows: rows.collect(), noun }
}

fn plain(text: String) -> Line {
    Line { text, style: None }
}

/// At most so wide: cut in its middle, since names differ at their ends.
fn shortened(text: &str, width: usize) -> String {
    let n_chars = text.chars().count();
    if n_chars <= width {
        return text.into();
    }
    let Some(n_kept) = width.checked_sub(1) else { return String::new() };
    let n_head = n_kept.div_ceil(2);
    let tail = text.chars().skip(n_chars - (n_kept - n_head));
    text.chars().take(n_head).chain(['…']).chain(tail).collect()
}

/// At most so wide: cut at its end.
fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.into();
    }
    text.chars().take(width.saturating_sub(1)).chain(['…']).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_graph::testing::made_looks;

    fn shown(n_rows: usize, n_columns: usize, change: fn(&mut Look)) -> Vec<Line> {
        let (before, mut now) = made_looks();
        change(&mut now);
        lines(&now, Some(&before), n_rows, n_columns)
    }

    fn words(line: &Line) -> Vec<&str> {
        line.text.split_whitespace().collect()
    }

    #[test]
    fn a_terminal_of_80_by_24_shows_it_all() {
        let lines = shown(24, 80, |_| {});
        assert!(
            lines[0].text.starts_with("gate  DEGRADED  up 1h 2m 7s  pid 4242  cpu 26.0 %  load 0.75 of "),
            "{lines:?}"
        );
        assert_eq!(lines[1].text, "classifier was given up after 5 restarts");
        assert!(lines[2].text.starts_with("grasps are not decided without classifier") && lines[2].text.ends_with('…'));
        assert_eq!(words(&lines[3]), ["NODE", "STATE", "PID", "CPU%", "MEMORY", "RESTARTS"]);
        assert_eq!(words(&lines[4]), ["contacts", "running", "4243+", "25.0", "3.0M", "2", "refused", "3"]);
        assert_eq!(words(&lines[5]), ["classifier", "FAILED", "-", "-", "-", "0", "refused", "3"]);
        assert_eq!(words(&lines[6]), ["EDGE", "RATE/S", "P50", "P99", "DROP", "MISS", "LATE", "QUEUE", "…"]);
        let edge = ["contacts/contacts", "→", "classifier", "999", "205µs", "205µs", "10", "13", "8", "0", "…"];
        assert_eq!(words(&lines[7]), edge);
        assert!(lines[8].text.starts_with("classifier/prediction → run "), "{lines:?}");
        assert_eq!(lines[9].text, "source to decision  p50 205µs  p90 205µs  p99 1.0ms");
        assert_eq!(lines[10].text, "decided 0.5/s  LIFT 60  HOLD 41  FALSE POSITIVES 1");
        assert!(lines[11].text.starts_with("GRASP  DECISION  REASON "), "{lines:?}");
        let row = words(&lines[12]);
        assert_eq!((&row[..4], row[6]), (&["100", "HOLD", "unstable", "0.875"][..], "unstable"));
        assert!(lines[13].text.starts_with("99     LIFT ") && lines[13].text.ends_with("UNSTABLE"), "{lines:?}");
        assert_eq!(lines.len(), 14);
    }

    #[test]
    fn losses_and_failures_alone_have_colours() {
        let style = |at: usize, change| shown(24, 80, change)[at].style;
        let styles: Vec<_> = shown(24, 80, |_| {}).iter().map(|line| line.style).collect();
        let (bold, red) = (Some(BOLD), Some(RED));
        assert_eq!(styles, [red, red, red, bold, red, red, bold, red, red, None, red, bold, None, red]);
        let harmless = |now: &mut Look| {
            now.status.nodes[0].n_restarts = 0;
            now.status.edges.iter_mut().for_each(|edge| edge.late = 0);
        };
        assert_eq!((style(4, harmless), style(7, harmless), style(8, harmless)), (None, Some(YELLOW), None));
        let lossy = |now: &mut Look| (now.status.edges[1].late, now.status.edges[1].missing) = (0, 1);
        assert_eq!(style(8, lossy), red);
    }

    #[test]
    fn rows_that_do_not_fit_are_counted_and_no_size_is_too_small() {
        let many = |now: &mut Look| {
            (now.status.state, now.status.message) = (GraphState::Running, None);
            let latest = &mut now.status.decisions.latest;
            (101..120).for_each(|grasp_id| latest.push_back(DecidedGrasp { grasp_id, ..latest[1].clone() }));
        };
        let texts = |n_rows, n_columns| -> Vec<String> {
            shown(n_rows, n_columns, many).into_iter().map(|line| line.text).collect()
        };
        let whole = texts(24, 80);
        assert_eq!(
            (whole.len(), whole[1].as_str(), whole[23].as_str()),
            (24, "/robot/dataflow.yaml", "… 9 more decisions")
        );
        assert!(whole[11].starts_with("119 "), "{whole:?}");
        // A row of each table.
        assert_eq!(texts(11, 80)[10], "… 1 more node, 1 more edge, 20 more decisions");
        for n_rows in 1..30 {
            for n_columns in [1, 2, 3, 7, 20, 41, 80, 300] {
                let lines = texts(n_rows, n_columns);
                assert!(
                    lines.len() <= n_rows && lines.iter().all(|line| line.chars().count() <= n_columns),
                    "{lines:?}"
                );
                assert!(lines[0].starts_with(if n_columns == 1 { '…' } else { 'g' }), "{lines:?}");
            }
        }
    }

    #[test]
    fn what_others_say_is_made_harmless() {
        let lines = shown(24, 80, |now| now.status.message = Some("\u{1b}[2Jgone\u{202e}".into()));
        assert_eq!(lines[1].text, "\\u{1b}[2Jgone\\u{202e}");
    }

    #[test]
    fn names_are_cut_in_their_middle() {
        assert_eq!(shortened("lift_arbiter", 12), "lift_arbiter");
        assert_eq!(shortened("lift_arbiter", 7), "lif…ter");
        assert_eq!((shortened("ab", 1), shortened("ab", 0)), ("…".into(), String::new()));
    }
}
