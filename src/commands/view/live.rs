//! The page of a running graph: the hand, the touch, the decisions and the graph itself, as they change.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use blindgrasp_graph::client::{ANSWER_LIMIT, ClientError, Connection, machine_of};
use blindgrasp_graph::control::{Attachment, Reply, Request};
use blindgrasp_graph::observer::{ObservedEdge, Observer, Sink, can_observe};
use blindgrasp_messages::{ContactSet, LiftDecision, Record, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_pictures::{HandScene, link_poses};
use blindgrasp_stages::hand::Hand;
use blindgrasp_viewer::Viewer;
use serde_json::{Value, json};

use super::super::ps::warnings;
use super::super::top::poller::Poller;
use super::super::top::sample::{Look, Window, measure};
use super::super::{Outcome, print_line, stop_signal};

/// The page gets frames so often: 30 a second.
const TICK: Duration = Duration::from_millis(33);
const GRAPH_PAUSE: Duration = Duration::from_secs(1);
/// A graph that does not run is looked for so often.
const RETRY: Duration = Duration::from_millis(500);
/// Probabilities of a tick that are drawn.
const MAX_PROBABILITIES: usize = 200;
/// Labels of grasps that wait for their decision.
const MAX_TRUTHS: usize = 256;

/// Serves the page until the command is interrupted. A graph that ends may run again. With `waits`, it need not run yet.
pub(super) fn show(graph: &str, port: u16, waits: bool) -> anyhow::Result<Outcome> {
    if machine_of(graph).is_some() {
        bail!("{graph}: the page shows graphs of this machine; run the command there, or use blindgrasp top {graph}");
    }
    let stop = stop_signal()?;
    let is_interrupted = || stop.load(Ordering::Relaxed);
    // A graph that does not run is a mistake at the start only.
    let mut connection = if waits { None } else { Some(Connection::open(graph)?) };
    let viewer = Viewer::serve(port)?;
    let address = format!("http://{}", viewer.address());
    print_diagnostic(&format!("shows graph '{graph}' in a browser on this machine: {address}"));
    print_line(&address)?;
    let say = |message: &str| viewer.keep("ended", &json!(message).to_string());
    say(&format!("waits for graph '{graph}'"));
    while !is_interrupted() {
        // It may not run yet, or not any more.
        if let Ok(connection) = connection.take().map_or_else(|| Connection::open(graph), Ok)
            && let Err(error) = watch(connection, &viewer, &is_interrupted)
        {
            viewer.forget("graph");
            say(&format!("{error:#}"));
        }
        std::thread::sleep(RETRY);
    }
    Ok(Outcome::Done)
}

/// Feeds the page until the graph ends, which is an error, or the command is interrupted.
fn watch(mut connection: Connection, viewer: &Viewer, is_interrupted: &dyn Fn() -> bool) -> anyhow::Result<()> {
    let attachment = match connection.ask(&Request::Attach { ports: Vec::new() }, ANSWER_LIMIT)? {
        Reply::Attached(attachment) => attachment,
        other => return Err(connection.unexpected(&other).into()),
    };
    let Attachment { domain, edges, graph, .. } = attachment;
    let hand = hand_path(&graph).map(|path| Hand::load(&path)).transpose()?;
    if let Some(hand) = &hand {
        viewer.keep("scene", &serde_json::to_string(&HandScene::new(hand))?);
    }
    let edges = edges.into_iter().filter(|edge| can_observe(&edge.input.service.type_name));
    let edges = edges.map(|edge| ObservedEdge { topic: edge.topic, input: edge.input, is_prompt: false }).collect();
    let latest = Arc::new(Mutex::new(Latest::default()));
    let observer = Observer::start_attached(&domain, edges, Reader { latest: Arc::clone(&latest) })
        .context("cannot read the graph's edges")?;
    let (mut poller, mut before) = Poller::connect(connection.graph())?;
    viewer.forget("ended");
    viewer.keep("graph", &graph_event(&before, None)?);
    let mut graph_due = Instant::now() + GRAPH_PAUSE;
    let ended = loop {
        if is_interrupted() {
            break Ok(());
        }
        match connection.receive_within(TICK) {
            Ok(None) if observer.has_failed() => break Err(anyhow::anyhow!("the graph cannot be read any more")),
            Ok(None) => {}
            Ok(Some(Reply::Drained)) | Err(ClientError::Ended { .. }) => {
                break Err(anyhow::anyhow!("graph '{}' has ended; waiting for it", connection.graph()));
            }
            Ok(Some(other)) => break Err(connection.unexpected(&other).into()),
            Err(error) => break Err(error.into()),
        }
        let taken = std::mem::take(&mut *latest.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some(decision) = taken.decisions.last() {
            viewer.keep("decision", &decision_event(decision, &taken.truths));
        }
        // The labels wait for decisions that come later.
        latest.lock().unwrap_or_else(PoisonError::into_inner).keep(&taken);
        if viewer.n_browsers() > 0
            && let Some(event) = frame_event(hand.as_ref(), taken)
        {
            viewer.send("frame", &event);
        }
        if Instant::now() >= graph_due {
            graph_due = Instant::now() + GRAPH_PAUSE;
            let now = match poller.look() {
                Ok(now) => now,
                Err(error) => break Err(error.into()),
            };
            viewer.keep("graph", &graph_event(&now, Some(&before))?);
            before = now;
        }
    };
    drop(if ended.is_ok() { observer.leave() } else { observer.finish() });
    ended
}

/// The pad layout that a node of the graph reads.
fn hand_path(graph: &Value) -> Option<PathBuf> {
    let nodes = graph["nodes"].as_array()?;
    nodes.iter().find_map(|node| node["params"]["hand"].as_str()).map(|path| Path::new(path).to_owned())
}

/// The samples since the last tick.
#[derive(Default)]
struct Latest {
    frame: Option<TactileFrame>,
    contacts: Option<ContactSet>,
    probabilities: Vec<f64>,
    decisions: Vec<LiftDecision>,
    /// Whether a grasp was stable, by its number.
    truths: BTreeMap<u64, bool>,
}

impl Latest {
    /// Takes over what still matters of an earlier tick.
    fn keep(&mut self, earlier: &Latest) {
        for (grasp_id, stable) in &earlier.truths {
            self.truths.entry(*grasp_id).or_insert(*stable);
        }
        while self.truths.len() > MAX_TRUTHS {
            self.truths.pop_first();
        }
    }
}

/// Reads a graph's edges. It takes each sample at once, so that no writer waits for a browser.
struct Reader {
    latest: Arc<Mutex<Latest>>,
}

impl Sink for Reader {
    fn take(&mut self, _topic: &str, record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        match record {
            Record::Tactile(sample) => latest.frame = Some(sample.message),
            Record::Contacts(sample) => latest.contacts = Some(sample.message),
            Record::Prediction(sample) if latest.probabilities.len() < MAX_PROBABILITIES => {
                latest.probabilities.push(sample.message.probability_stable);
            }
            Record::Decision(sample) => latest.decisions.push(sample.message),
            Record::Truth(sample) => {
                latest.truths.insert(sample.message.grasp_id, sample.message.stable);
            }
            _ => {}
        }
        Ok(())
    }
}

fn decision_event(decision: &LiftDecision, truths: &BTreeMap<u64, bool>) -> String {
    json!({
        "grasp_id": decision.grasp_id, "action": decision.action, "reason": decision.reason,
        "probability_stable": decision.probability_stable, "truth": truths.get(&decision.grasp_id),
    })
    .to_string()
}

/// `None` if there is nothing new. Of a frame that is not of this hand, only what needs no hand is told.
fn frame_event(hand: Option<&Hand>, latest: Latest) -> Option<String> {
    let Latest { frame, contacts, probabilities, decisions, .. } = latest;
    if frame.is_none() && probabilities.is_empty() && decisions.is_empty() {
        return None;
    }
    let actions: Vec<_> = decisions.iter().map(|decision| decision.action).collect();
    let mut event = json!({"probabilities": probabilities, "actions": actions});
    if let (Some(hand), Some(frame)) = (hand, frame)
        && let Ok(links) = link_poses(hand, &frame.joints_rad)
    {
        let contacts = contacts.filter(|contacts| contacts.grasp_id == frame.grasp_id);
        let contacts = contacts.map_or_else(Vec::new, |contacts| contacts.contacts);
        let contacts = contacts.iter().map(|contact| {
            // The arrow shows the force on the object's side of the pad: along the outward normal.
            [&contact.position_m[..], &contact.normal, &[contact.force_newtons]].concat()
        });
        event["grasp_id"] = frame.grasp_id.into();
        event["phase"] = json!(frame.phase);
        event["joints"] = json!(frame.joints_rad);
        event["links"] = json!(links);
        // JSON has no NaN: null stands for it.
        event["cells"] = json!(frame.cells_newtons);
        event["contacts"] = contacts.collect::<Vec<_>>().into();
        event["gravity"] = if frame.gravity_m_per_s2.is_empty() { Value::Null } else { json!(frame.gravity_m_per_s2) };
    }
    Some(event.to_string())
}

fn graph_event(now: &Look, before: Option<&Look>) -> anyhow::Result<String> {
    let window = Window { previous: before.unwrap_or(now), rates_since: before, counts_since: None };
    let mut event = serde_json::to_value(measure(now, window))?;
    event["warnings"] = json!(warnings(&now.status));
    Ok(event.to_string())
}
