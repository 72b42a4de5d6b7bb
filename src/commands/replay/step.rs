//! A replay frame by frame, led by lines on stdin.

use std::collections::BTreeMap;
use std::io::{BufRead, IsTerminal};
use std::iter::Peekable;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use serde_json::{Value, json};

use super::Fed;
use crate::commands::print_line;
use crate::commands::run::Tap;
use blindgrasp_graph::client::Connection;
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_graph::run::observed_topics;
use blindgrasp_messages::{
    ContactSet, Fault, GraspFeature, GraspTruth, LiftDecision, LiftOutcome, Prediction, Recorded, TactileFrame,
};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::{Reach, Record};
use blindgrasp_replay::playback::{Next, Playback};
use blindgrasp_replay::played::Played;
use blindgrasp_replay::selection::Selection;

/// The limit for the graph to start, and to answer a step.
const LIMIT: Duration = Duration::from_secs(60);
/// The pause between two looks whether the graph has started.
const POLL: Duration = Duration::from_millis(20);
/// After such a silence on all edges, a frame counts as shown.
const SILENCE: Duration = Duration::from_secs(1);

/// The number of shown samples of each edge that has one for each frame.
type Shown = (Mutex<BTreeMap<String, u64>>, Condvar);

/// Starts a thread that takes steps in the running graph as stdin says. The returned function prints the samples.
pub(super) fn start(
    recording: &Path,
    selection: &Selection,
    fed: &Fed,
    graph_name: &str,
    is_json: bool,
    n_stops: &Arc<AtomicUsize>,
) -> anyhow::Result<Tap> {
    let types = fed
        .graph
        .nodes
        .iter()
        .flat_map(|node| node.output_ports().map(|(port, output)| (port, output.type_name.as_str())));
    let types: BTreeMap<_, _> = types.collect();
    let is_per_frame = |type_name: &&str| {
        ![LiftDecision::TYPE_NAME, GraspTruth::TYPE_NAME, LiftOutcome::TYPE_NAME].contains(type_name)
    };
    let topics = observed_topics(&fed.graph, true);
    let counts: BTreeMap<String, u64> = topics
        .into_iter()
        .filter(|(port, _)| types.get(port).is_some_and(is_per_frame))
        .map(|(_, topic)| (topic, 0))
        .collect();
    let shown = Arc::new((Mutex::new(counts), Condvar::new()));
    let steps = Steps {
        graph: graph_name.into(),
        node: fed.replaced.node.clone(),
        connection: None,
        shown: Arc::clone(&shown),
        n_steps: 0,
        n_stops: Arc::clone(n_stops),
    };
    let (recording, selection, topic): (PathBuf, _, _) = (recording.into(), selection.clone(), fed.topic.clone());
    let port = fed.replaced.played_port;
    let n_stops = Arc::clone(n_stops);
    std::thread::spawn(move || {
        let outcome = match port {
            ContactSet::PORT => steps.take::<ContactSet>(&recording, &selection, &topic),
            GraspFeature::PORT => steps.take::<GraspFeature>(&recording, &selection, &topic),
            Prediction::PORT => steps.take::<Prediction>(&recording, &selection, &topic),
            _ => steps.take::<TactileFrame>(&recording, &selection, &topic),
        };
        if let Err(error) = outcome {
            print_diagnostic(&format!("blindgrasp: {error:#}"));
            n_stops.fetch_add(1, Ordering::Relaxed);
        }
    });
    if std::io::stdin().is_terminal() {
        print_diagnostic("Enter: next frame, g: to the end of the grasp, c: go on, q: stop");
    }
    Ok(Box::new(move |topic, record, _| {
        show(topic, record, is_json)?;
        let (counts, has_come) = &*shown;
        if let Some(count) = counts.lock().unwrap_or_else(PoisonError::into_inner).get_mut(topic) {
            *count += 1;
        }
        has_come.notify_all();
        Ok(())
    }))
}

/// Takes steps in a running graph.
struct Steps {
    graph: String,
    /// The player's node.
    node: String,
    connection: Option<Connection>,
    shown: Arc<Shown>,
    n_steps: u64,
    /// Requests to stop the run.
    n_stops: Arc<AtomicUsize>,
}

impl Steps {
    fn take<M: Played>(mut self, recording: &Path, selection: &Selection, topic: &str) -> anyhow::Result<()> {
        let frames = Playback::<M>::open(recording, selection, Some(topic), Reach::ByIndex)?;
        let mut grasp_ids = frames
            .filter_map(|next| match next {
                Ok(Next::Frame(frame)) => Some(frame.grasp_id),
                _ => None,
            })
            .peekable();
        for line in std::io::stdin().lock().lines() {
            match line?.trim() {
                "" => self.step(&mut grasp_ids, false)?,
                "g" => self.step(&mut grasp_ids, true)?,
                "c" => return self.allow(json!("unlimited")),
                "q" => {
                    self.stop();
                    return Ok(());
                }
                other => print_diagnostic(&format!(
                    "'{other}': expected Enter for the next frame, g to the end of the grasp, c to go on, q to stop"
                )),
            }
            if grasp_ids.peek().is_none() {
                // The source may go on to the end of the recording.
                return self.allow(json!("unlimited"));
            }
        }
        self.stop();
        Ok(())
    }

    fn step(&mut self, grasp_ids: &mut Peekable<impl Iterator<Item = u64>>, whole_grasp: bool) -> anyhow::Result<()> {
        let Some(grasp_id) = grasp_ids.next() else { return Ok(()) };
        self.n_steps += 1;
        while whole_grasp && grasp_ids.next_if_eq(&grasp_id).is_some() {
            self.n_steps += 1;
        }
        self.allow(json!(self.n_steps))?;
        self.wait_until_shown();
        Ok(())
    }

    fn stop(&self) {
        self.n_stops.fetch_add(1, Ordering::Relaxed);
    }

    fn allow(&mut self, steps: Value) -> anyhow::Result<()> {
        let request = Request::Set { node: self.node.clone(), param: "steps".into(), value: steps };
        let connection = match &mut self.connection {
            Some(connection) => connection,
            slot => slot.insert(connect(&self.graph)?),
        };
        match connection.ask(&request, LIMIT)? {
            Reply::Set { .. } => Ok(()),
            other => Err(connection.unexpected(&other).into()),
        }
    }

    /// Waits until every edge has shown its samples of this step.
    fn wait_until_shown(&self) {
        let (counts, has_come) = &*self.shown;
        let mut counts = counts.lock().unwrap_or_else(PoisonError::into_inner);
        while counts.values().any(|count| *count < self.n_steps) {
            let (next, waited) = has_come.wait_timeout(counts, SILENCE).unwrap_or_else(PoisonError::into_inner);
            counts = next;
            if waited.timed_out() {
                return;
            }
        }
    }
}

/// Connects to the graph once it runs.
fn connect(graph: &str) -> anyhow::Result<Connection> {
    let start = std::time::Instant::now();
    loop {
        let ready = Connection::open(graph).and_then(|mut connection| {
            let reply = connection.ask(&Request::Status, LIMIT)?;
            Ok((connection, reply))
        });
        match ready {
            Ok((connection, Reply::Status(status)))
                if status.state == blindgrasp_graph::control::GraphState::Running =>
            {
                return Ok(connection);
            }
            Err(error) if start.elapsed() > LIMIT => return Err(error.into()),
            _ => std::thread::sleep(POLL),
        }
    }
}

/// Prints a sample. The run itself prints decisions.
fn show(topic: &str, record: &Record, is_json: bool) -> anyhow::Result<()> {
    let header = record.header();
    if is_json {
        if !matches!(record, Record::Decision(_)) {
            let message = record.to_json()?;
            let line =
                json!({"topic": topic, "seq": header.seq, "stamp_nanos": header.stamp_nanos, "message": message});
            print_line(&line.to_string())?;
        }
        return Ok(());
    }
    let fault = |fault: Fault| if fault == Fault::None { String::new() } else { format!("  {}", fault.as_str()) };
    let what = match record {
        Record::Tactile(sample) => {
            let frame = &sample.message;
            let active = frame.cells_newtons.iter().filter(|newtons| **newtons > 0.0);
            let (phase, n_cells) = (frame.phase.as_str(), frame.cells_newtons.len());
            let at_secs = header.stamp_nanos as f64 / 1e9;
            let sum: f64 = active.clone().sum();
            format!(
                "grasp {} {phase}  {at_secs:.3} s  {} of {n_cells} cells read something, {sum:.3} in all",
                frame.grasp_id,
                active.count()
            )
        }
        Record::Contacts(sample) => {
            let contacts = &sample.message;
            format!(
                "grasp {} {}  {} contacts on {} pads{}",
                contacts.grasp_id,
                contacts.phase.as_str(),
                contacts.contacts.len(),
                contacts.n_pads_in_contact,
                fault(contacts.fault)
            )
        }
        Record::Feature(sample) => {
            let feature = &sample.message;
            let largest = feature.values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let values = match feature.values.len() {
                0 => "no values".into(),
                n => format!("{n} values up to {largest:.4}"),
            };
            format!("grasp {} {}  {values}{}", feature.grasp_id, feature.phase.as_str(), fault(feature.fault))
        }
        Record::Prediction(sample) => {
            let said = &sample.message;
            let word = match (said.stable, said.unsure) {
                (true, _) => "stable",
                (false, true) => "unsure",
                (false, false) => "unstable",
            };
            format!(
                "grasp {} {}  {word}, p {:.4}, decision value {:.4}{}",
                said.grasp_id,
                said.phase.as_str(),
                said.probability_stable,
                said.decision_value,
                fault(said.fault)
            )
        }
        Record::Truth(sample) => {
            let truth = &sample.message;
            let word = if truth.stable { "stable" } else { "unstable" };
            format!("grasp {}  {word} ({})", truth.grasp_id, truth.object)
        }
        Record::Decision(_) | Record::Outcome(_) | Record::Scene(_) => return Ok(()),
    };
    print_line(&format!("{topic:<14} {:>6}  {what}", header.seq))?;
    Ok(())
}
