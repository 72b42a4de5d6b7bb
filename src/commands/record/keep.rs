//! `record --keep` and `record --write-kept`: the commands of the flight recorder.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde_json::{Value, json};

use super::{Arguments, Outcome, POLL, attach, observed, print_line, stop_signal};
use blindgrasp_graph::client::observer::Observer;
use blindgrasp_graph::client::{ANSWER_LIMIT, ClientError, Connection, pick_graph};
use blindgrasp_graph::control::{Attachment, Reply, Request};
use blindgrasp_graph::recorded_graph::{Beginning, Ending, RecordedGraph};
use blindgrasp_messages::{Recorded as _, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_session::flight::{Excerpt, FlightRecorder, SharedRecorder};
use blindgrasp_session::of_graph::of_graph;

/// The reason in the names of files that somebody asked for.
const ASKED: &str = "asked";

/// `record --write-kept`
pub(super) fn ask(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let mut connection = Connection::open(&pick_graph(arguments.graph.as_deref())?)?;
    let n_flight_recorders = match connection.ask(&Request::Keep, ANSWER_LIMIT)? {
        Reply::Asked { n_flight_recorders } => n_flight_recorders,
        other => return Err(connection.unexpected(&other).into()),
    };
    if n_flight_recorders == 0 {
        bail!(
            "no flight recorder reads graph '{0}': start one with `blindgrasp record {0} --keep 30s --out FILE.mcap`",
            connection.graph()
        );
    }
    let line = if arguments.json {
        json!({"graph": connection.graph(), "asked": n_flight_recorders}).to_string()
    } else {
        format!("{n_flight_recorders} asked; each prints the name of its file where it runs")
    };
    print_line(&line)?;
    Ok(Outcome::Done)
}

/// `record --keep`
pub(super) fn keep(arguments: &Arguments, out: &Path, kept: Duration) -> anyhow::Result<Outcome> {
    let stop = stop_signal()?;
    let asked = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGUSR1, Arc::clone(&asked))
        .context("cannot listen for SIGUSR1")?;
    let mut connection = Connection::open(&pick_graph(arguments.graph.as_deref())?)?;
    let Attachment { domain, edges, graph, .. } = attach(&mut connection, &[], out, true)?;
    if n_sources_of_frames(&graph) > 1 {
        bail!(
            "graph '{}' has several sources of frames, and --keep is for one: use blindgrasp record without --keep",
            connection.graph()
        );
    }
    let about = of_graph(&graph, Beginning::Attached)?;
    let recorder = FlightRecorder::new(&edges, kept, Duration::from_secs_f64(arguments.after));
    let Some(recorder) = recorder.map(SharedRecorder::new) else {
        bail!("graph '{}' has no edge with frames to keep", connection.graph());
    };
    let observer = Observer::start_attached(&domain, observed(&edges), recorder.clone());
    let observer = observer.context("cannot read the graph's edges")?;
    let start = Instant::now();
    print_diagnostic(&format!(
        "keeping the last {} s of graph '{}'; Ctrl-C ends it",
        kept.as_secs_f64(),
        connection.graph()
    ));
    let end = arguments.for_secs.map(|secs| start + Duration::from_secs_f64(secs));
    let mut keeping = Keeping { recorder, stop, asked, end, out, about, is_json: arguments.json, has_loss: false };
    let ending = keeping.follow(&mut connection, &observer)?;
    let finished = if ending == Ending::Detached { observer.leave() } else { observer.finish() };
    let graph = connection.graph().to_string();
    // Somebody may have asked since the last look.
    while let Ok(Some(Reply::Keep)) = connection.receive_within(Duration::ZERO) {
        keeping.asked.store(true, Ordering::Relaxed);
    }
    drop(connection);
    keeping.finish(ending)?;
    finished.context("cannot read the graph's edges any more")?;
    let how = match ending {
        Ending::Graph => "the graph has ended",
        Ending::Broken => "the graph broke off",
        Ending::Detached => "the graph goes on",
    };
    print_diagnostic(&format!("graph '{graph}' is kept no longer: {how}"));
    Ok(Outcome::of(keeping.has_loss))
}

/// A flight recorder and the orders that it follows.
struct Keeping<'a> {
    recorder: SharedRecorder,
    out: &'a Path,
    about: RecordedGraph,
    is_json: bool,
    has_loss: bool,
    stop: Arc<AtomicBool>,
    asked: Arc<AtomicBool>,
    /// When it ends, if not earlier.
    end: Option<Instant>,
}

impl Keeping<'_> {
    /// Writes the files that are asked for until the graph or the command ends.
    fn follow(&mut self, connection: &mut Connection, observer: &Observer<SharedRecorder>) -> anyhow::Result<Ending> {
        let mut is_full = false;
        loop {
            if self.stop.load(Ordering::Relaxed) || self.end.is_some_and(|end| Instant::now() >= end) {
                return Ok(Ending::Detached);
            }
            if self.asked.swap(false, Ordering::Relaxed) {
                self.ask(ASKED);
            }
            if let Some(excerpt) = self.recorder.with(|recorder| recorder.excerpt_when_due(monotonic_nanos())) {
                self.write(excerpt)?;
            }
            if !is_full && self.recorder.with(|recorder| recorder.is_full()) {
                is_full = true;
                print_diagnostic(
                    "blindgrasp: --keep holds 512 MiB, which is less than that time: older samples are forgotten",
                );
            }
            match connection.receive_within(POLL) {
                Ok(None) if observer.has_failed() => return Ok(Ending::Broken),
                Ok(None) => {}
                Ok(Some(Reply::Keep)) => self.ask(ASKED),
                Ok(Some(Reply::Drained)) => return Ok(Ending::Graph),
                Err(ClientError::Ended { .. }) => return Ok(Ending::Broken),
                Ok(Some(other)) => return Err(connection.unexpected(&other).into()),
                Err(error) => return Err(error.into()),
            }
        }
    }

    fn ask(&self, why: &str) {
        self.recorder.with(|recorder| recorder.ask(why, monotonic_nanos()));
    }

    /// Writes the files that are asked for, and one of a graph that broke off.
    fn finish(&mut self, ending: Ending) -> anyhow::Result<()> {
        if ending == Ending::Graph {
            self.recorder.with(FlightRecorder::graph_has_ended);
        }
        if self.asked.load(Ordering::Relaxed) {
            self.ask(ASKED);
        }
        if ending == Ending::Broken {
            self.ask(Ending::Broken.word());
        }
        while let Some(excerpt) = self.recorder.with(FlightRecorder::excerpt_now) {
            self.write(excerpt)?;
        }
        Ok(())
    }

    fn write(&mut self, excerpt: Excerpt) -> anyhow::Result<()> {
        if excerpt.is_empty() {
            self.has_loss = true;
            print_diagnostic("blindgrasp: nothing is written: no frame has come yet");
            return Ok(());
        }
        let written = match excerpt.write(self.out, &self.about) {
            Ok(written) => written,
            Err(error) => {
                // The next file may be written: the disk may have room again.
                self.has_loss = true;
                print_diagnostic(&format!("blindgrasp: the kept samples are not written: {error}"));
                return Ok(());
            }
        };
        self.has_loss |= written.missing > 0;
        let line = if self.is_json {
            json!(written).to_string()
        } else {
            let missing = match written.missing {
                0 => String::new(),
                missing => format!(", {missing} samples are missing"),
            };
            format!(
                "{} ({}): {:.1} s, {} grasps, {} frames{missing}",
                written.file.display(),
                written.why.join(", "),
                written.secs,
                written.grasps,
                written.frames
            )
        };
        Ok(print_line(&line)?)
    }
}

/// The nodes that send frames and read none.
fn n_sources_of_frames(graph: &Value) -> usize {
    let nodes = list(&graph["nodes"]);
    let frames: BTreeSet<String> = nodes.iter().flat_map(ports_of_frames).collect();
    let senders = nodes.iter().filter(|node| !ports_of_frames(node).is_empty());
    senders.filter(|node| !list(&node["inputs"]).iter().any(|input| frames.contains(word(&input["from"])))).count()
}

fn ports_of_frames(node: &Value) -> Vec<String> {
    let ports = list(&node["outputs"]).iter().filter(|port| port["type"] == TactileFrame::TYPE_NAME);
    ports.map(|port| format!("{}/{}", word(&node["id"]), word(&port["port"]))).collect()
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn word(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}
