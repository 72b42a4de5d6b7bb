//! `blindgrasp record`: records a graph that runs, from a process of its own.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;
use serde_json::json;

use super::recording_arguments::RecordingArguments;
use super::text_table::TextTable;
use super::{Outcome, check_output, completions, print_line, secs_in, stop_signal};
use blindgrasp_graph::client::observer::{Observer, Sink, can_observe};
use blindgrasp_graph::client::{Connection, Heard, pick_graph};
use blindgrasp_graph::control::Attachment;
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_operator::cursors::SharedCursors;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_session::of_graph::{nodes, of_graph};
use blindgrasp_session::recorder::{Recorded, Recorder, check_recording};
use blindgrasp_session::span::{EdgeSpan, Span, SpanOfEdge};

mod keep;

/// The command checks this often whether it was interrupted or its time is over.
const POLL: Duration = Duration::from_millis(50);

/// Record a running graph without loss
///
/// No sample is missing, and the graph is not held up.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp record grasp_gate --out /tmp/robot.mcap --rotate-size 1GB\n\n\
                        Ctrl-C ends the recording; the graph goes on. The graph does not wait for a recorder that is too slow.\n\n\
                        With --keep it is a flight recorder: it writes nothing until a lift drops its object, a fault holds a \
                        grasp, or `blindgrasp record GRAPH --write-kept` (or SIGUSR1) asks for it. `blindgrasp test --init FILE` \
                        makes the file a test.\n  \
                        blindgrasp record grasp_gate --keep 30s --out recordings/robot.mcap\n\n\
                        Exit code 3 if samples are missing, or if the disk was full.")]
pub(super) struct Arguments {
    /// Graph [default: the only one running]
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    /// File to write; with --keep, each file has the time and the reason behind its name
    #[arg(short, long, value_name = "FILE", required_unless_present = "write_kept")]
    out: Option<PathBuf>,
    /// Hold the last so many seconds in memory, and write them when something has happened
    #[arg(long, value_name = "TIME", value_parser = |text: &str| secs_in(text, 1.0..=3600.0),
          conflicts_with_all = ["edges", "rotate_size", "rotate_every", "overwrite"])]
    keep: Option<f64>,
    /// With --keep, go on for so many seconds after it has happened
    #[arg(long, value_name = "TIME", default_value = "3", requires = "keep", value_parser = |text: &str| secs_in(text, 0.0..=600.0))]
    after: f64,
    /// Ask the recorders of the graph that have --keep to write now
    #[arg(long, conflicts_with_all = ["out", "keep", "edges", "for_secs"])]
    write_kept: bool,
    /// Record only the edges from these outputs, separated by commas
    #[arg(long, value_name = "NODE/PORT", value_delimiter = ',')]
    edges: Vec<String>,
    /// End after so many seconds
    #[arg(long = "for", value_name = "TIME", value_parser = |text: &str| secs_in(text, 0.01..=1e8))]
    for_secs: Option<f64>,
    #[command(flatten)]
    recording: RecordingArguments,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct RecordSummary {
    graph: String,
    ended: Ending,
    secs: f64,
    edges: Vec<SpanOfEdge>,
    /// Missing samples of all edges together.
    missing: u64,
    #[serde(flatten)]
    recorded: Recorded,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if arguments.write_kept {
        return keep::ask(arguments);
    }
    let out = arguments.out()?;
    if let Some(secs) = arguments.keep {
        return keep::keep(arguments, out, Duration::from_secs_f64(secs));
    }
    check_output(out, &[])?;
    check_recording(out, &arguments.recording.options())?;
    let summary = record(arguments, out)?;
    // The exit code tells of a loss, even if stdout is closed.
    summary.lines(arguments.json).iter().try_for_each(|line| print_line(line))?;
    Ok(summary.outcome())
}

impl Arguments {
    fn out(&self) -> anyhow::Result<&Path> {
        self.out.as_deref().context("--out FILE is missing")
    }
}

/// Attaches to the edges of a graph that can be recorded. `out` must be no file that the graph reads.
fn attach(
    connection: &mut Connection,
    ports: &[String],
    out: &Path,
    is_flight_recorder: bool,
) -> anyhow::Result<Attachment> {
    let mut attachment = connection.attach(ports, is_flight_recorder)?;
    attachment.edges.retain(|edge| {
        let type_name = &edge.input.service.type_name;
        let is_known = can_observe(type_name);
        if !is_known {
            print_diagnostic(&format!("blindgrasp: {} is not recorded: its type {type_name} is unknown", edge.port));
        }
        is_known
    });
    if attachment.edges.is_empty() {
        bail!("graph '{}' has no edge that can be recorded", connection.graph());
    }
    // The files that the graph reads, its recording, hand or model, must not be written over.
    let params = nodes(&attachment.graph).filter_map(|node| node["params"].as_object());
    let inputs: Vec<PathBuf> =
        params.flat_map(|params| params.values()).filter_map(|value| value.as_str()).map(PathBuf::from).collect();
    check_output(out, &inputs)?;
    Ok(attachment)
}

/// Waits until the graph, the observer or the command ends. Before each wait, `look` hears whether somebody has asked for the kept
/// samples, and says whether the command ends.
fn follow<S: Sink>(
    connection: &mut Connection,
    observer: &Observer<S>,
    end: Option<Instant>,
    look: &mut dyn FnMut(bool) -> anyhow::Result<bool>,
) -> anyhow::Result<Ending> {
    let mut is_asked = false;
    loop {
        let left = end.map_or(POLL, |end| end.saturating_duration_since(Instant::now()).min(POLL));
        if look(is_asked)? || left.is_zero() {
            return Ok(Ending::Detached);
        }
        let heard = connection.hear(left)?;
        is_asked = heard == Heard::Keep;
        match heard {
            Heard::Nothing if observer.has_failed() => return Ok(Ending::Broken),
            Heard::Nothing | Heard::Keep => {}
            Heard::Ended(ending) => return Ok(ending),
        }
    }
}

/// The end of the graph, for a person.
fn how(ending: Ending) -> &'static str {
    match ending {
        Ending::Graph => "the graph has ended",
        Ending::Broken => "the graph broke off",
        Ending::Detached => "the graph goes on",
    }
}

/// Records a graph of this machine to `out`.
fn record(arguments: &Arguments, out: &Path) -> anyhow::Result<RecordSummary> {
    let stop = stop_signal()?;
    let mut connection = Connection::open(&pick_graph(arguments.graph.as_deref())?)?;
    let attachment = attach(&mut connection, &arguments.edges, out, false)?;
    let Attachment { domain, edges, graph, is_at_start } = &attachment;
    let (info, options) = of_graph(graph, *is_at_start, arguments.recording.options())?;
    let recorder = Recorder::create(out, &info, options)?;
    let has_failed = recorder.has_failed();
    let cursors = SharedCursors::open(&domain.cursors())?;
    let span = Span::new(cursors, edges.iter().map(EdgeSpan::of).collect(), recorder);
    let observer = Observer::start_attached(domain, attachment.observed(), span);
    let observer = observer.context("cannot read the graph's edges")?;
    let start = Instant::now();
    print_diagnostic(&format!(
        "recording {} edges of graph '{}' to {}; Ctrl-C ends the recording",
        edges.len(),
        connection.graph(),
        out.display()
    ));
    let end = arguments.for_secs.map(|secs| start + Duration::from_secs_f64(secs));
    let ending = follow(&mut connection, &observer, end, &mut |_is_asked| {
        Ok(stop.load(Ordering::Relaxed) || has_failed.load(Ordering::Relaxed))
    })?;
    let finished = if ending == Ending::Detached { observer.leave() } else { observer.finish() };
    let graph = connection.graph().to_string();
    // A graph that ends waits for the end of the connection, not for the disk.
    drop(connection);
    let secs = start.elapsed().as_secs_f64();
    let (edges, recorded) = finished.context("cannot read the graph's edges any more")?.0.finish(ending);
    let missing = edges.iter().map(|edge| edge.missing).sum();
    Ok(RecordSummary { graph, ended: ending, secs, edges, missing, recorded })
}

impl RecordSummary {
    fn lines(&self, json: bool) -> Vec<String> {
        if json { vec![json!(self).to_string()] } else { table(self) }
    }

    fn outcome(&self) -> Outcome {
        let recorded = &self.recorded;
        let is_lossy = self.missing > 0 || recorded.n_not_recorded > 0 || recorded.error.is_some();
        if is_lossy { Outcome::FinishedWithLoss } else { Outcome::Done }
    }
}

/// The summary for a person.
fn table(summary: &RecordSummary) -> Vec<String> {
    let mut edges = TextTable::new(["topic", "samples", "first", "last", "missing"], 1);
    for edge in &summary.edges {
        let (samples, missing) = (edge.samples.to_string(), edge.missing.to_string());
        let [first, last] = [edge.first, edge.last].map(|seq| seq.map_or("-".to_string(), |seq| seq.to_string()));
        edges.row([edge.topic.clone(), samples, first, last, missing]);
    }
    let how = how(summary.ended);
    let files: Vec<String> = summary.recorded.files.iter().map(|file| file.display().to_string()).collect();
    let tail = format!("{:.1} s of graph '{}' recorded, {how}: {}", summary.secs, summary.graph, files.join(", "));
    let lost = summary.recorded.n_not_recorded;
    let lost = (lost > 0).then(|| format!("{lost} samples came and are not recorded"));
    edges.lines().into_iter().chain([tail]).chain(lost).collect()
}
