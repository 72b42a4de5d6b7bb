//! `record --keep` and `record --write-kept`: the commands of the flight recorder.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde_json::{Value, json};

use super::{Arguments, Outcome, attach, follow, how, print_line, stop_signal};
use blindgrasp_graph::client::observer::Observer;
use blindgrasp_graph::client::{ANSWER_LIMIT, Connection, Heard, pick_graph};
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_messages::{Recorded as _, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::text::counted;
use blindgrasp_recording::{LiveOptions, RecordingInfo};
use blindgrasp_session::flight::{Excerpt, FlightRecorder, SharedRecorder};
use blindgrasp_session::of_graph::{nodes, of_graph};

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
    let attachment = attach(&mut connection, &[], out, true)?;
    if n_sources_of_frames(&attachment.graph) > 1 {
        bail!(
            "graph '{}' has several sources of frames, and --keep is for one: use blindgrasp record without --keep",
            connection.graph()
        );
    }
    let (info, options) = of_graph(&attachment.graph, false, LiveOptions::default())?;
    let recorder = FlightRecorder::new(&attachment.edges, kept, Duration::from_secs_f64(arguments.after));
    let Some(recorder) = recorder.map(SharedRecorder::new) else {
        bail!("graph '{}' has no edge with frames to keep", connection.graph());
    };
    let observer = Observer::start_attached(&attachment.domain, attachment.observed(), recorder.clone());
    let observer = observer.context("cannot read the graph's edges")?;
    let end = arguments.for_secs.map(|secs| Instant::now() + Duration::from_secs_f64(secs));
    print_diagnostic(&format!(
        "keeping the last {} s of graph '{}'; Ctrl-C ends it",
        kept.as_secs_f64(),
        connection.graph()
    ));
    let is_json = arguments.json;
    let mut keeping = Keeping { recorder, asked, out, info, options, is_json, has_loss: false, is_full: false };
    let ending = follow(&mut connection, &observer, end, &mut |is_asked| {
        keeping.look(is_asked)?;
        Ok(stop.load(Ordering::Relaxed))
    })?;
    let finished = if ending == Ending::Detached { observer.leave() } else { observer.finish() };
    let graph = connection.graph().to_string();
    // Somebody may have asked since the last look.
    while let Ok(Heard::Keep) = connection.hear(Duration::ZERO) {
        keeping.asked.store(true, Ordering::Relaxed);
    }
    drop(connection);
    keeping.finish(ending)?;
    finished.context("cannot read the graph's edges any more")?;
    print_diagnostic(&format!("graph '{graph}' is kept no longer: {}", how(ending)));
    Ok(Outcome::of(keeping.has_loss))
}

/// A flight recorder and the orders that it follows.
struct Keeping<'a> {
    recorder: SharedRecorder,
    out: &'a Path,
    info: RecordingInfo,
    options: LiveOptions,
    is_json: bool,
    has_loss: bool,
    is_full: bool,
    asked: Arc<AtomicBool>,
}

impl Keeping<'_> {
    /// Writes the file that is asked for, once it is due.
    fn look(&mut self, is_asked: bool) -> anyhow::Result<()> {
        if self.asked.swap(false, Ordering::Relaxed) || is_asked {
            self.ask(ASKED);
        }
        if let Some(excerpt) = self.recorder.with(|recorder| recorder.excerpt_when_due(monotonic_nanos())) {
            self.write(excerpt)?;
        }
        if !self.is_full && self.recorder.with(|recorder| recorder.is_full()) {
            self.is_full = true;
            print_diagnostic(
                "blindgrasp: --keep holds 512 MiB, which is less than that time: older samples are forgotten",
            );
        }
        Ok(())
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

    fn write(&mut self, mut excerpt: Excerpt) -> anyhow::Result<()> {
        if excerpt.is_empty() {
            self.has_loss = true;
            print_diagnostic("blindgrasp: nothing is written: no frame has come yet");
            return Ok(());
        }
        if let Err(error) = excerpt.write(self.out, &self.info, &self.options) {
            // The next file may be written: the disk may have room again.
            self.has_loss = true;
            print_diagnostic(&format!("blindgrasp: the kept samples are not written: {error}"));
            return Ok(());
        }
        self.has_loss |= excerpt.missing > 0;
        let line = if self.is_json {
            json!(excerpt).to_string()
        } else {
            let Excerpt { file, why, frames, grasps, secs, missing, .. } = &excerpt;
            let missing =
                if *missing > 0 { format!(", missing: {}", counted(missing, "sample")) } else { String::new() };
            let (grasps, frames) = (counted(grasps, "grasp"), counted(frames, "frame"));
            format!("{} ({}): {secs:.1} s, {grasps}, {frames}{missing}", file.display(), why.join(", "))
        };
        Ok(print_line(&line)?)
    }
}

/// The nodes that send frames and read none.
fn n_sources_of_frames(graph: &Value) -> usize {
    let (mut senders, mut frames) = (Vec::new(), BTreeSet::new());
    for node in nodes(graph) {
        for port in node["outputs"].as_array().into_iter().flatten() {
            if port["type"] == TactileFrame::TYPE_NAME {
                senders.push(node);
                frames.insert(format!("{}/{}", word(&node["id"]), word(&port["port"])));
            }
        }
    }
    senders.dedup();
    senders.retain(|node| {
        let mut inputs = node["inputs"].as_array().into_iter().flatten();
        !inputs.any(|input| frames.contains(word(&input["from"])))
    });
    senders.len()
}

fn word(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}
