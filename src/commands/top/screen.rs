//! From what is known to what is seen.

use std::time::Duration;

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Paragraph, RenderDirection, Sparkline};

use super::table::{Cell, Column, table};
use super::view::{Condition, Table, View};
use crate::commands::promises::shown_counts;
use blindgrasp_graph::client::activity::{Measured, MeasuredEdge, MeasuredNode, RUN};
use blindgrasp_graph::client::words::{
    clock_offset, node_state_word, peer_state_word, short_rate, short_time, state_word, warnings,
};
use blindgrasp_graph::control::{DecidedGrasp, GraphState, NodeState};
use blindgrasp_graph::log::printable;
use blindgrasp_messages::Action;
use blindgrasp_operator::link_status::{LinkStatus, PeerState};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::wiring::EdgePolicy;

/// Losses and failures.
const LOUD: Style = Style::new().fg(Color::Red).add_modifier(Modifier::BOLD);
/// What gave way as the dataflow file allows.
const NOTED: Style = Style::new().fg(Color::Yellow);
const QUIET: Style = Style::new().add_modifier(Modifier::DIM);
const STRONG: Style = Style::new().add_modifier(Modifier::BOLD);
const BAR: Style = Style::new().add_modifier(Modifier::REVERSED);

/// How many lines each part of the screen gets; 0: it is not shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Heights {
    header: u16,
    /// Nodes, edges, the decisions' latency, decisions; each with its title.
    parts: [u16; 4],
    footer: u16,
}

const LATENCY: usize = 2;

/// Draws it, and says how many rows of each table are to be seen.
pub(super) fn draw(frame: &mut Frame, view: &View) -> [usize; 3] {
    let area = frame.area();
    let measured = view.measured();
    let (edge_titles, edges) = edge_table(&measured, area.width);
    let (node_titles, nodes) = node_table(&measured, area.width);
    let (decision_titles, decisions) = decision_table(view, area.width);
    let wanted = [nodes.len() + 1, edges.len() + 1, 2, decisions.len().max(1) + 1];
    let header = header(view, &measured);
    let heights = heights(area.height, header.len() as u16, wanted);

    let mut y = area.y;
    let mut part = |height: u16| {
        let rect = Rect { y, height, ..area };
        y += height;
        rect
    };
    frame.render_widget(Paragraph::new(header), part(heights.header));
    let mut n_visible = [0; 3];
    let mut show = |frame: &mut Frame, table: Table, titles: Line<'static>, rows: Vec<Line<'static>>, rect: Rect| {
        let offset = view.offsets[table as usize];
        n_visible[table as usize] = usize::from(rect.height.saturating_sub(1));
        let (n_shown, n_rows) = (n_visible[table as usize], rows.len());
        let mut titles = titles.patch_style(BAR);
        if n_rows > n_shown {
            let mark = if view.focus == table { "▸" } else { " " };
            let last = (offset + n_shown).min(n_rows);
            titles.push_span(Span::styled(format!(" {mark}{}-{last} of {n_rows}", offset + 1), BAR));
        }
        let shown = rows.into_iter().skip(offset).take(n_shown);
        frame.render_widget(Block::new().style(BAR), Rect { height: rect.height.min(1), ..rect });
        frame.render_widget(Paragraph::new([titles].into_iter().chain(shown).collect::<Vec<_>>()), rect);
    };
    show(frame, Table::Nodes, node_titles, nodes, part(heights.parts[0]));
    show(frame, Table::Edges, edge_titles, edges, part(heights.parts[1]));
    let latency_rect = part(heights.parts[LATENCY]);
    show(frame, Table::Decisions, decision_titles, decisions, part(heights.parts[3]));
    draw_latency(frame, view, &measured, latency_rect);
    let footer_rect = Rect { y: area.y + area.height.saturating_sub(heights.footer), height: heights.footer, ..area };
    frame.render_widget(Paragraph::new(footer(view, area.width)), footer_rect);
    if view.is_help_shown {
        draw_help(frame);
    }
    n_visible
}

/// The header first, then the nodes, edges, latency and decisions, at least a row of each; what is left, by turns.
fn heights(total: u16, n_header: u16, wanted: [usize; 4]) -> Heights {
    let mut left = total;
    let mut take = |n_lines: u16| {
        let taken = if left >= n_lines { n_lines } else { 0 };
        left -= taken;
        taken
    };
    let header = take(1);
    let mut parts = [0; 4];
    for (part, n_least) in parts.iter_mut().zip([2, 2, 1, 2]) {
        *part = take(n_least);
    }
    let footer = take(1);
    let header = header + if header > 0 { take(n_header - 1) } else { 0 };
    loop {
        let mut has_grown = false;
        for (part, &wanted) in parts.iter_mut().zip(&wanted) {
            if *part > 0 && usize::from(*part) < wanted && left > 0 {
                *part += 1;
                left -= 1;
                has_grown = true;
            }
        }
        if !has_grown {
            return Heights { header, parts, footer };
        }
    }
}

/// One line of what is, one of what is wrong or where the file is, and one of the other machines, if there are any.
fn header(view: &View, measured: &Measured) -> Vec<Line<'static>> {
    let state = match (&view.condition, measured.state) {
        (Condition::Ended { .. }, _) => Span::styled("ended", LOUD),
        (Condition::Silent { .. }, _) => Span::styled("NOT ANSWERING", LOUD),
        (_, state @ GraphState::Degraded) => Span::styled(state_word(state), LOUD),
        (_, state) => Span::styled(state_word(state), STRONG),
    };
    let cpu = measured.cpu_percent.map_or("-".into(), |percent| format!("{percent:.1} %"));
    let load = measured.load_average.map_or("-".into(), |load| format!("{load:.2}"));
    let mut facts = vec![
        Span::styled(printable(&measured.graph), STRONG),
        "  ".into(),
        state,
        format!(
            "  up {}  pid {}  cpu {cpu}  load {load} of {}",
            clock(measured.uptime_secs),
            measured.pid,
            view.n_processors
        )
        .into(),
    ];
    if view.is_paused {
        facts.extend(["  ".into(), Span::styled("PAUSED", STRONG)]);
    }
    let second = match (&view.condition, &view.notice) {
        (Condition::Ended { message }, _) => Line::styled(printable(message), LOUD),
        (Condition::Silent { secs }, _) => Line::styled(
            format!(
                "no answer for {secs} s; the launcher may be stopped (kill -CONT {pid}) or hang (kill {pid})",
                pid = measured.pid
            ),
            LOUD,
        ),
        (_, Some(notice)) => Line::styled(printable(notice), STRONG),
        _ => match warnings(&view.now.status).into_iter().next() {
            Some(warning) => Line::styled(printable(&warning), LOUD),
            None => Line::styled(printable(&view.now.status.file.display().to_string()), QUIET),
        },
    };
    let mut lines = vec![Line::from(facts), second];
    lines.extend(measured.link.as_ref().map(link_line));
    lines
}

/// How the other machines are linked.
fn link_line(link: &LinkStatus) -> Line<'static> {
    let mut spans = vec![Span::styled(printable(&link.machine), STRONG), " ↔".into()];
    for peer in &link.peers {
        let style = if peer.state == PeerState::Up { Style::new() } else { LOUD };
        spans.push(format!("  {} ", printable(&peer.machine)).into());
        spans.push(Span::styled(peer_state_word(peer.state), style));
        if let (PeerState::Up, Some(round_trip)) = (peer.state, peer.round_trip_nanos) {
            spans.push(format!(" clock {} round trip {}", clock_offset(peer), short_time(round_trip)).into());
        }
    }
    Line::from(spans)
}

fn column(title: &'static str, expendable: u8) -> Column {
    Column { title, expendable, is_left: false, is_rare: false }
}

fn left(title: &'static str, expendable: u8) -> Column {
    Column { is_left: true, ..column(title, expendable) }
}

fn rare(column: Column) -> Column {
    Column { is_rare: true, ..column }
}

fn node_table(measured: &Measured, width: u16) -> (Line<'static>, Vec<Line<'static>>) {
    let columns = [
        left("NODE", 0),
        left("STATE", 1),
        column("PID", 4),
        column("CPU%", 2),
        column("MEMORY", 5),
        column("RESTARTS", 3),
        column("SWAPS", 7),
        column("HEARTBEAT", 6),
        rare(left("COUNTS", 8)),
    ];
    let rows: Vec<Vec<Cell>> = measured.nodes.iter().map(node_row).collect();
    table(&columns, &rows, width.into())
}

fn node_row(node: &MeasuredNode) -> Vec<Cell> {
    let state_style = match node.state {
        NodeState::Failed | NodeState::Restarting => LOUD,
        NodeState::Done => QUIET,
        _ => Style::new(),
    };
    let pid = node.pid.map_or("-".into(), |pid| pid.to_string());
    let counts = shown_counts(&node.counts);
    vec![
        Cell::new(printable(&node.node)),
        Cell::styled(node_state_word(node.state), state_style),
        // A standby is there for a moment only: a second number would make the column jump.
        Cell::new(if node.standby_pid.is_some() { format!("{pid}+") } else { pid }),
        Cell::new(node.cpu_percent.map_or("-".into(), |percent| format!("{percent:.1}"))),
        Cell::new(node.resident_bytes.map_or("-".into(), |bytes| format!("{:.1}M", bytes as f64 / f64::from(1 << 20)))),
        Cell::styled(node.n_restarts.to_string(), loud_if(node.n_restarts > 0)),
        Cell::new(node.n_swaps.to_string()),
        Cell::new(node.heartbeat_age_millis.map_or("-".into(), |millis| {
            if millis < 1000 { format!("{millis}ms") } else { short_time(millis * 1_000_000) }
        })),
        Cell::new(counts.join(", ")),
    ]
}

fn edge_table(measured: &Measured, width: u16) -> (Line<'static>, Vec<Line<'static>>) {
    let columns = [
        left("EDGE", 0),
        column("RATE/S", 2),
        column("P50", 1),
        column("P90", 8),
        column("P99", 5),
        column("QUEUE", 6),
        column("DROP", 3),
        column("MISS", 4),
        rare(column("LATE", 7)),
        rare(column("REPEATED", 9)),
        rare(column("BLOCKED", 10)),
    ];
    let rows: Vec<Vec<Cell>> = measured.edges.iter().map(edge_row).collect();
    table(&columns, &rows, width.into())
}

fn edge_row(edge: &MeasuredEdge) -> Vec<Cell> {
    let ages = match edge.age_nanos {
        Some(age) => [age.p50, age.p90, age.p99].map(short_time),
        None => ["-"; 3].map(String::from),
    };
    let [p50, p90, p99] = ages.map(Cell::new);
    let [dropped, missing] = [edge.dropped, edge.missing].map(|count| match edge.policy {
        EdgePolicy::Latest if count > 0 => Cell::styled(short_count(count), NOTED),
        _ => Cell::styled(short_count(count), loud_if(count > 0)),
    });
    vec![
        Cell::new(printable(&edge_label(edge))),
        Cell::new(short_rate(edge.rate_hz)),
        p50,
        p90,
        p99,
        Cell::new(edge.n_queued.to_string()),
        dropped,
        missing,
        Cell::styled(short_count(edge.late), loud_if(edge.late > 0)),
        Cell::new(short_count(edge.repeated)),
        Cell::new(short_time(edge.blocked_nanos)),
    ]
}

/// The reader's port is left out where it is called as the writer's.
fn edge_label(edge: &MeasuredEdge) -> String {
    let writers_port = edge.from.split_once('/').map(|(_, port)| port);
    match edge.to.split_once('/') {
        Some((node, port)) if edge.to != RUN && writers_port == Some(port) => format!("{} → {node}", edge.from),
        _ => format!("{} → {}", edge.from, edge.to),
    }
}

fn decision_table(view: &View, width: u16) -> (Line<'static>, Vec<Line<'static>>) {
    let columns = [
        left("GRASP", 0),
        left("DECISION", 1),
        left("REASON", 2),
        column("P STABLE", 4),
        column("LATENCY", 3),
        column("AGO", 6),
        left("TRUTH", 5),
    ];
    let now_nanos = monotonic_nanos();
    let latest = view.now.status.decisions.latest.iter().rev();
    let rows: Vec<Vec<Cell>> = latest.map(|decided| decision_row(decided, now_nanos)).collect();
    table(&columns, &rows, width.into())
}

fn decision_row(decided: &DecidedGrasp, now_nanos: u64) -> Vec<Cell> {
    let is_wrong = decided.is_false_positive();
    let style = match decided.action {
        Action::Lift if is_wrong => LOUD,
        Action::Lift => STRONG,
        _ => Style::new(),
    };
    let truth = match decided.truth {
        Some(true) => "stable",
        Some(false) if is_wrong => "UNSTABLE",
        Some(false) => "unstable",
        None => "-",
    };
    vec![
        Cell::new(decided.grasp_id.to_string()),
        Cell::styled(decided.action.shown(), style),
        Cell::new(decided.reason.as_str()),
        Cell::new(format!("{:.3}", decided.probability_stable)),
        Cell::new(decided.latency_nanos.map_or("-".into(), short_time)),
        Cell::new(short_time(now_nanos.saturating_sub(decided.decided_nanos))),
        Cell::styled(truth, loud_if(is_wrong)),
    ]
}

/// How long decisions take, with its history, the newest at the right end; and what was decided.
fn draw_latency(frame: &mut Frame, view: &View, measured: &Measured, rect: Rect) {
    let decisions = &measured.decisions;
    let latency = measured.decision_latency_nanos.map_or("-".into(), |latency| {
        let [p50, p90, p99] = [latency.p50, latency.p90, latency.p99].map(short_time);
        format!("p50 {p50}  p90 {p90}  p99 {p99}")
    });
    let took = Line::from(vec![Span::styled("source to decision  ", STRONG), latency.into(), "  ".into()]);
    let took_width = (took.width() as u16).min(rect.width);
    let mut decided = vec![
        Span::styled("decided ", STRONG),
        format!("{}/s  LIFT {}  HOLD {}", short_rate(decisions.rate_hz), decisions.n_lift, decisions.n_hold).into(),
    ];
    if decisions.n_false_positives > 0 {
        decided.push(Span::styled(format!("  FALSE POSITIVES {}", decisions.n_false_positives), LOUD));
    }
    frame.render_widget(Paragraph::new(vec![took, Line::from(decided)]), rect);
    let bars = Rect { x: rect.x + took_width, width: rect.width - took_width, height: rect.height.min(1), ..rect };
    let newest = view.p99_history_nanos.iter().rev().copied().take(bars.width.into());
    let sparkline = Sparkline::default().data(newest.collect::<Vec<_>>()).direction(RenderDirection::RightToLeft);
    frame.render_widget(sparkline, bars);
}

/// As many keys as there is room for, the most needed first.
fn footer(view: &View, width: u16) -> Line<'static> {
    let secs = view.interval.as_secs_f64();
    let counted = if view.is_counted_anew() { "from r" } else { "from start" };
    let rates = if view.is_rate_since_base { counted.into() } else { format!("{secs} s") };
    let keys = if view.has_ended() {
        vec!["q quit".to_string(), "g another running graph".into()]
    } else {
        vec![
            "q quit".to_string(),
            "? help".into(),
            "p pause".into(),
            format!("+- {secs} s"),
            format!("r counts {counted}"),
            format!("w rates {rates}"),
            "Tab ↑↓ scroll".into(),
            "g graph".into(),
        ]
    };
    let mut line = String::new();
    for key in keys {
        let longer = format!("{line} {key} ");
        if longer.chars().count() > width.into() {
            break;
        }
        line = longer;
    }
    Line::styled(line, BAR)
}

const HELP: [&str; 21] = [
    "q Esc Ctrl-C  quit",
    "space p       pause, go on",
    "+ -           look less, more often",
    "r             count losses and decisions from",
    "              now, or again since the start",
    "w             rates and ages since then too, or",
    "              over the last interval",
    "Tab           which table the arrows scroll",
    "↑ ↓ PgUp PgDn Home End   scroll",
    "g             the next running graph",
    "Ctrl-Z        suspend",
    "? h           this help",
    "",
    "P50 P90 P99   age of samples on arrival, since",
    "              their source published them",
    "QUEUE         sent, not yet answered",
    "DROP          lost, or gave way (latest edges)",
    "MISS          gaps in what came, from anywhere",
    "LATE          older than the edge's deadline",
    "",
    "red: a loss, a failure, an unstable grasp lifted",
];

fn draw_help(frame: &mut Frame) {
    let area = frame.area();
    let widest = HELP.iter().map(|line| line.chars().count()).max().unwrap_or(0) as u16 + 4;
    let (width, height) = (widest.min(area.width), (HELP.len() as u16 + 2).min(area.height));
    let rect = Rect { x: area.x + (area.width - width) / 2, y: area.y + (area.height - height) / 2, width, height };
    frame.render_widget(Clear, rect);
    let lines: Vec<Line> = HELP.iter().map(|line| Line::raw(format!(" {line}"))).collect();
    frame.render_widget(Paragraph::new(lines).block(Block::bordered().title(" blindgrasp top ")), rect);
}

fn loud_if(is_loud: bool) -> Style {
    if is_loud { LOUD } else { Style::new() }
}

fn short_count(count: u64) -> String {
    match count {
        0..100_000 => count.to_string(),
        100_000..10_000_000 => format!("{}k", count / 1000),
        _ => format!("{}M", count / 1_000_000),
    }
}

/// Whole seconds: more of them nobody reads.
fn clock(secs: f64) -> String {
    humantime::format_duration(Duration::from_secs(secs.max(0.0) as u64)).to_string()
}

#[cfg(test)]
mod tests;
