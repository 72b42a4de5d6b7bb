//! A run of a graph as a command does it: with decisions on stdout, a recording, and the summary at the end.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde::Serialize;
use serde_json::json;

use super::super::view::Rights;
use super::super::{Outcome, check_new, check_output, check_page};
use super::console::Console;
use super::recorder::{RecordOptions, Recorded, Recorder};
use super::report::RunReport;
use super::table::table;
use blindgrasp_graph::client::metrics;
use blindgrasp_graph::dataflow::Graph;
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::recorded_graph::{Beginning, Ending};
use blindgrasp_graph::run::{self, Run, RunOptions};
use blindgrasp_learning::of_graph::of_graph;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_recording::Record;
use blindgrasp_stages::hand::Hand;

/// The page of a graph that ends has this time to show its end.
const PAGE_LIMIT: Duration = Duration::from_secs(3);

/// Receives every sample of a run: its topic and content, and the time of its receipt (CLOCK_BOOTTIME).
pub(in crate::commands) type Tap = Box<dyn FnMut(&str, &Record, u64) -> anyhow::Result<()> + Send>;

/// How a command runs a graph.
pub(in crate::commands) struct Session {
    pub(in crate::commands) launch: LaunchOptions,
    pub(in crate::commands) clock: Clock,
    /// Every edge is recorded to this file.
    pub(in crate::commands) record: Option<PathBuf>,
    pub(in crate::commands) record_options: RecordOptions,
    /// Prometheus is answered on this port.
    pub(in crate::commands) metrics: Option<u16>,
    /// Port of the page in a browser.
    pub(in crate::commands) view: Option<u16>,
    /// The abilities of the page beside showing the graph.
    pub(in crate::commands) rights: Rights,
    /// The report is written to this file (HTML) at the end.
    pub(in crate::commands) report: Option<PathBuf>,
    /// Decisions and summary are printed as JSON.
    pub(in crate::commands) json: bool,
    /// Neither decisions nor the summary go to stdout; warnings and errors still go to stderr.
    pub(in crate::commands) is_quiet: bool,
    pub(in crate::commands) tap: Option<Tap>,
}

/// The summary of a run, and of its recording if there is one.
#[derive(Serialize)]
pub(in crate::commands) struct Summary {
    #[serde(flatten)]
    pub(in crate::commands) run: run::Summary,
    #[serde(rename = "recorded")]
    recorded_samples: Option<BTreeMap<String, u64>>,
    recorded_files: Vec<PathBuf>,
    /// Why the recording ended before the graph.
    pub(in crate::commands) recording_error: Option<String>,
    /// Samples that were received and are not in the recording.
    pub(in crate::commands) samples_not_recorded: u64,
}

/// A graph that has run.
pub(in crate::commands) struct Ended {
    pub(in crate::commands) summary: Summary,
    pub(in crate::commands) outcome: Outcome,
}

impl Session {
    /// Runs a checked graph to its end, or until `n_stops` counts a request to stop.
    ///
    /// # Errors
    /// The graph cannot start, or an operator failed; the summary has been printed then.
    pub(in crate::commands) fn run(self, graph: &Graph, name: &str, n_stops: &AtomicUsize) -> anyhow::Result<Ended> {
        let params = graph.nodes.iter().flat_map(|node| node.params.values());
        let inputs: Vec<PathBuf> = params.filter_map(|param| Some(PathBuf::from(param.as_str()?))).collect();
        if let Some(path) = &self.record {
            check_output(path, &inputs)?;
            self.record_options.check(path)?;
        }
        if let Some(path) = &self.report {
            check_page(path, &inputs)?;
            check_new(path, &inputs, self.record_options.overwrite)?;
            if self.record.as_ref() == Some(path) {
                bail!("{} is given for --record and for --report: choose two files", path.display());
            }
        }
        let listen = |port| metrics::listen(port).with_context(|| format!("cannot answer on port {port} (--metrics)"));
        let options = RunOptions {
            launch: self.launch,
            clock: self.clock,
            reads_all: self.record.is_some() || self.tap.is_some() || self.report.is_some(),
            metrics: self.metrics.map(listen).transpose()?,
            is_quiet: self.is_quiet,
        };
        let run = Run::prepare(graph, name, options)?;
        let recorder = match &self.record {
            Some(path) => {
                let about = of_graph(&run.description(), Beginning::Start)?;
                Some(Recorder::create(path, about, &self.record_options)?)
            }
            None => None,
        };
        let _page = self.view.map(|port| Page::start(name, port, self.rights)).transpose()?;
        let is_recorded = recorder.is_some();
        let report = self.report.as_ref().map(|_| RunReport::begin(hand_of(graph)));
        let run::Ended { summary, sink, outcome } =
            run.run(Console::new(self.json, self.is_quiet, recorder, report, self.tap), n_stops)?;
        let n_seen = n_stops.load(Ordering::Relaxed);

        let Console { mut printer, recorder, report, .. } = sink;
        let ending = if outcome.is_ok() { Ending::Graph } else { Ending::Broken };
        let mut recorded: Recorded = recorder.map(|recorder| recorder.finish(ending)).unwrap_or_default();
        if outcome.is_err() {
            recorded.remove_if_empty();
        }
        let summary = Summary {
            run: summary,
            recorded_samples: is_recorded.then_some(recorded.samples),
            recorded_files: recorded.files,
            recording_error: recorded.error,
            samples_not_recorded: recorded.n_not_recorded,
        };
        let lines = match self.json {
            _ if self.is_quiet => Vec::new(),
            true => vec![json!({ "summary": summary }).to_string()],
            false if outcome.is_ok() || summary.run.grasps > 0 => table(&summary.run),
            false => Vec::new(),
        };
        lines.into_iter().for_each(|line| printer.print(line));
        printer.flush(&|| n_stops.load(Ordering::Relaxed) > n_seen);
        if printer.n_dropped() > 0 {
            let n = printer.n_dropped();
            print_diagnostic(&format!("blindgrasp: {n} lines were not printed: the reader of stdout was too slow"));
        }
        if !self.is_quiet {
            summary.print_recording();
        }
        let reported = match (report, &self.report) {
            (Some(report), Some(path)) => report.write(path, &summary.run),
            _ => Ok(()),
        };
        outcome?;
        reported?;
        if let Some(path) = self.report.filter(|_| !self.is_quiet) {
            print_diagnostic(&format!("the report of the run is {}", path.display()));
        }
        if let Some(error) = printer.take_failure() {
            return Err(error).context("decisions were made that could not be written to stdout");
        }
        let is_recording_lossy = summary.recording_error.is_some() || summary.samples_not_recorded > 0;
        let is_lossy = summary.run.is_lossy(self.clock) || is_recording_lossy;
        Ok(Ended { summary, outcome: if is_lossy { Outcome::FinishedWithLoss } else { Outcome::Done } })
    }
}

/// The hand of the first node with a pad layout. The operator itself says if it cannot be read.
fn hand_of(graph: &Graph) -> Option<Hand> {
    let paths = graph.nodes.iter().filter_map(|node| node.params.get("hand")?.as_str());
    Hand::load(Path::new(paths.into_iter().next()?)).ok()
}

/// The process that serves the page of the graph. It ends when its stdin does, also if this process is killed.
struct Page(Child);

impl Page {
    /// Starts it, and waits until the page is served.
    fn start(graph: &str, port: u16, rights: Rights) -> anyhow::Result<Page> {
        let program = std::env::current_exe().context("the program of the page is not known")?;
        let mut command = Command::new(program);
        command.args(["view", graph, "--wait", "--port", &port.to_string()]);
        command.args(rights.options());
        // Ctrl-C is for the graph: the page shows its end.
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).process_group(0);
        let mut page = Page(command.spawn().context("cannot start the page (--view)")?);
        let mut address = String::new();
        if let Some(stdout) = page.0.stdout.take() {
            BufReader::new(stdout).read_line(&mut address).context("the page does not answer (--view)")?;
        }
        if address.is_empty() {
            bail!("the page cannot be served (--view)");
        }
        Ok(page)
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        let limit = Instant::now() + PAGE_LIMIT;
        while matches!(self.0.try_wait(), Ok(None)) && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(10));
        }
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Summary {
    fn print_recording(&self) {
        if let Some(samples) = self.recorded_samples.as_ref().filter(|_| !self.recorded_files.is_empty()) {
            let topics: Vec<_> = samples.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
            let files: Vec<_> = self.recorded_files.iter().map(|file| file.display().to_string()).collect();
            print_diagnostic(&format!("recorded to {}: {}", files.join(", "), topics.join(", ")));
        }
    }
}
