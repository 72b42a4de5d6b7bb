//! A run of a graph as a command does it: with decisions on stdout, a recording, and the summary at the end.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::Context;
use serde::Serialize;
use serde_json::json;

use crate::console::Console;
use crate::of_graph::of_graph;
use crate::output::check_output;
use crate::recorder::{Recorded, Recorder, check_recording};
use crate::table::table;
use blindgrasp_graph::client::metrics;
use blindgrasp_graph::dataflow::Graph;
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_graph::run::{self, Run, RunOptions};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_recording::{LiveOptions, Record};

/// Receives every sample of a run: its topic and content, and the time of its receipt (CLOCK_BOOTTIME).
pub type Tap = Box<dyn FnMut(&str, &Record, u64) -> anyhow::Result<()> + Send>;

/// How a graph is run. The default prints decisions and the summary, and records nothing.
#[derive(Default)]
pub struct Session {
    pub launch: LaunchOptions,
    pub clock: Clock,
    /// Every edge is recorded to this file.
    pub record: Option<PathBuf>,
    pub record_options: LiveOptions,
    /// Prometheus is answered on this port.
    pub metrics: Option<u16>,
    /// Decisions and summary are printed as JSON.
    pub json: bool,
    /// Neither decisions nor the summary go to stdout; warnings and errors still go to stderr.
    pub is_quiet: bool,
    pub tap: Option<Tap>,
}

/// The summary of a run, and of its recording if there is one.
#[derive(Serialize)]
pub struct SessionSummary {
    #[serde(flatten)]
    pub run: run::RunSummary,
    #[serde(rename = "recorded")]
    recorded_samples: Option<BTreeMap<String, u64>>,
    recorded_files: Vec<String>,
    /// Why the recording ended before the graph.
    pub recording_error: Option<String>,
    /// Samples that were received and are not in the recording.
    pub samples_not_recorded: u64,
}

/// A graph that has run.
pub struct Ended {
    pub summary: SessionSummary,
    /// Samples were lost, or are not in the recording.
    pub is_lossy: bool,
}

impl Session {
    /// Runs a checked graph to its end, or until `n_stops` counts a request to stop.
    ///
    /// # Errors
    /// The graph cannot start, or an operator failed; the summary has been printed then.
    pub fn run(self, graph: &Graph, name: &str, n_stops: &AtomicUsize) -> anyhow::Result<Ended> {
        self.check_files(graph)?;
        let options = RunOptions {
            launch: self.launch,
            clock: self.clock,
            reads_all: self.record.is_some() || self.tap.is_some(),
            metrics: self.metrics.map(listen).transpose()?,
            is_quiet: self.is_quiet,
        };
        let run = Run::prepare(graph, name, options)?;
        let recorder = match &self.record {
            Some(path) => {
                let (info, options) = of_graph(&run.description(), true, self.record_options)?;
                Some(Recorder::create(path, &info, options)?)
            }
            None => None,
        };
        let is_recorded = recorder.is_some();
        let run::Ended { summary, sink, outcome } =
            run.run(Console::new(self.json, self.is_quiet, recorder, self.tap), n_stops)?;
        let n_seen = n_stops.load(Ordering::Relaxed);

        let Console { mut printer, recorder, .. } = sink;
        let ending = if outcome.is_ok() { Ending::Graph } else { Ending::Broken };
        let mut recorded: Recorded = recorder.map(|recorder| recorder.finish(ending)).unwrap_or_default();
        if outcome.is_err() {
            recorded.remove_if_empty();
        }
        let summary = SessionSummary::new(summary, recorded, is_recorded);
        let has_table = outcome.is_ok() || summary.run.grasps > 0;
        for line in summary.lines(self.is_quiet, self.json, has_table) {
            printer.print(&line);
        }
        printer.flush(&|| n_stops.load(Ordering::Relaxed) > n_seen);
        let n = printer.n_dropped();
        if n > 0 {
            print_diagnostic(&format!("blindgrasp: {n} lines were not printed: the reader of stdout was too slow"));
        }
        if !self.is_quiet {
            summary.print_recording();
        }
        outcome?;
        if let Some(error) = printer.take_failure() {
            return Err(error).context("decisions were made that could not be written to stdout");
        }
        let is_lossy =
            summary.run.is_lossy(self.clock) || summary.recording_error.is_some() || summary.samples_not_recorded > 0;
        Ok(Ended { summary, is_lossy })
    }

    /// Refuses a recording that would overwrite another file.
    fn check_files(&self, graph: &Graph) -> anyhow::Result<()> {
        let Some(path) = &self.record else { return Ok(()) };
        let params = graph.nodes.iter().flat_map(|node| node.params.values());
        let inputs: Vec<PathBuf> = params.filter_map(|param| Some(PathBuf::from(param.as_str()?))).collect();
        check_output(path, &inputs)?;
        check_recording(path, &self.record_options)
    }
}

/// Answers Prometheus on a port.
fn listen(port: u16) -> anyhow::Result<std::net::TcpListener> {
    metrics::listen(port).with_context(|| format!("cannot answer on port {port} (--metrics)"))
}

impl SessionSummary {
    fn new(run: run::RunSummary, recorded: Recorded, is_recorded: bool) -> SessionSummary {
        SessionSummary {
            run,
            recorded_samples: is_recorded.then_some(recorded.samples),
            recorded_files: recorded.files.iter().map(|file| file.display().to_string()).collect(),
            recording_error: recorded.error,
            samples_not_recorded: recorded.n_not_recorded,
        }
    }

    /// The summary as printed on stdout.
    fn lines(&self, is_quiet: bool, is_json: bool, has_table: bool) -> Vec<String> {
        if is_quiet {
            Vec::new()
        } else if is_json {
            vec![json!({ "summary": self }).to_string()]
        } else if has_table {
            table(&self.run)
        } else {
            Vec::new()
        }
    }

    fn print_recording(&self) {
        if let Some(samples) = self.recorded_samples.as_ref()
            && !self.recorded_files.is_empty()
        {
            let topics: Vec<_> = samples.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
            print_diagnostic(&format!("recorded to {}: {}", self.recorded_files.join(", "), topics.join(", ")));
        }
    }
}
