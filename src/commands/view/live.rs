//! The page of a running graph: the hand, the touch, the decisions and the graph itself, as they change.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{BuildHasher, RandomState};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use blindgrasp_graph::client::activity::{Look, measure};
use blindgrasp_graph::client::observer::{Observer, Sink};
use blindgrasp_graph::client::poller::Poller;
use blindgrasp_graph::client::words::warnings;
use blindgrasp_graph::client::{Connection, Heard};
use blindgrasp_graph::log::{LogFolder, LogLine, LogTail};
use blindgrasp_messages::{
    Action, ContactSet, GraspFeature, Header, LiftDecision, Phase, Reason, Record, Sense, TactileFrame, with_sample,
};
use blindgrasp_operator::control_socket::tactile_path;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_pictures::{HandScene, link_poses};
use blindgrasp_stages::{Hand, Judge, Judged, Model};
use blindgrasp_viewer::{Abilities, Viewer};
use serde_json::{Value, json};

use super::super::{Outcome, print_line, promises::shown_counts, stop_signal};
use super::Rights;
use super::control::control_of;
use super::foxglove::Streams;
use super::grasp::judge_of;
use super::model::ShownModel;

/// The page gets frames so often: 30 a second. More cost the graph more than a viewer sees.
const TICK: Duration = Duration::from_millis(33);
/// A decision goes to the page at once, but for this time.
const POLL: Duration = Duration::from_millis(8);
const GRAPH_PAUSE: Duration = Duration::from_secs(1);
/// A graph that does not run is looked for so often.
const RETRY: Duration = Duration::from_millis(500);
/// Probabilities of a tick that are drawn.
const MAX_PROBABILITIES: usize = 200;
/// Lines of the log that are shown.
const MAX_LOG_LINES: usize = 100;
/// Cells in all of the frames that wait for the decisions about them: 8 MiB.
const MAX_RECENT_CELLS: usize = 1 << 20;
/// Labels of grasps that wait for their decision.
const MAX_TRUTHS: usize = 256;
/// Decisions that wait for their frame, and grasps whose settled feature is kept for the decision.
const MAX_WAITING: usize = 64;

/// Serves the page until the command is interrupted. A graph that ends may run again. With `waits`, it need not run yet, and the
/// end of stdin ends the page: the process that started it has gone.
///
/// Frames are judged by the model `shadow` as well, if there is one.
pub(super) fn show(
    graph: &str,
    port: u16,
    waits: bool,
    rights: Rights,
    shadow: Option<&Path>,
) -> anyhow::Result<Outcome> {
    // A file that cannot be read is a mistake at the start only.
    shadow.map(Model::load).transpose()?;
    let stop = stop_signal()?;
    // A graph that does not run is a mistake at the start only.
    let mut connection = if waits { None } else { Some(Connection::open(graph)?) };
    let control = rights.view_control.then(|| control_of(graph)).transpose().context("no token for the page")?;
    let viewer = Viewer::serve(port, Abilities { grasps: None, control, foxglove: rights.foxglove })?;
    if waits {
        let stop = Arc::clone(&stop);
        std::thread::spawn(move || {
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            stop.store(true, Ordering::Relaxed);
        });
    }
    let address = viewer.address();
    print_diagnostic(&format!("shows graph '{graph}' in a browser on this machine: {address}"));
    if let Some(address) = viewer.foxglove_address() {
        print_diagnostic(&format!("Foxglove: open the connection {address}"));
    }
    print_line(&address)?;
    viewer.keep("ended", &json!(format!("waits for graph '{graph}'")).to_string());
    while !stop.load(Ordering::Relaxed) {
        let opened = match connection.take() {
            Some(connection) => Ok(connection),
            None => Connection::open(graph),
        };
        // The graph may not run at this moment.
        if let Ok(connection) = opened
            && let Err(error) = watch(connection, &viewer, shadow, &stop)
        {
            viewer.forget("graph");
            viewer.keep("ended", &json!(format!("{error:#}")).to_string());
        }
        std::thread::sleep(RETRY);
    }
    viewer.finish(if waits {
        "the run has ended; its last minutes stay on this page"
    } else {
        "blindgrasp view has ended; the last minutes stay on this page"
    });
    Ok(Outcome::Done)
}

/// Feeds the page until the graph ends, which is an error, or the command is interrupted.
fn watch(mut connection: Connection, viewer: &Viewer, shadow: Option<&Path>, stop: &AtomicBool) -> anyhow::Result<()> {
    let attachment = connection.attach(&[], false)?;
    let hand = hand_of(&attachment.graph);
    let (mut poller, before) = Poller::connect(connection.graph())?;
    let first = graph_event(&before, None)?;
    // The decision and the hand of an earlier run are not shown any more.
    viewer.forget("decision");
    viewer.keep("scene", &serde_json::to_string(&hand.as_ref().map(HandScene::new))?);
    let shadow = match (shadow, &hand) {
        (Some(model), Some(hand)) => Some(judge_of(model, hand)?),
        (Some(_), None) => bail!("the graph has no hand that is known: --shadow cannot judge its frames"),
        (None, _) => None,
    };
    viewer.forget("shadow");
    let streams = viewer.foxglove_address().map(|_| Streams::begin(viewer, &attachment.edges, hand.as_ref()));
    let latest = Arc::new(Mutex::new(Latest::default()));
    let hand_id = hand.as_ref().map(Hand::id);
    let reader = Reader { latest: Arc::clone(&latest), hand_id, streams, shadow, epochs: RandomState::new() };
    let observer = Observer::start_attached(&attachment.domain, attachment.observed(), reader);
    let observer = observer.context("cannot read the graph's edges")?;
    viewer.forget("ended");
    viewer.keep("graph", &first);
    let (model, log) = (ShownModel::default(), ShownLog::open(&before.status.log_folder));
    let mut page = GraphPage { viewer, hand, latest, model, log };
    page.show_model_and_log(&before);
    let followed = page.follow(&mut connection, &observer, &mut poller, before, stop);
    // A graph that goes on has no end to wait for.
    drop(if let Ok(true) = followed { observer.finish() } else { observer.leave() });
    page.show_decision();
    page.show_frame(true);
    page.show_log();
    if followed? {
        bail!("graph '{}' has ended; waiting for it", connection.graph());
    }
    Ok(())
}

/// The page of one run of the graph.
struct GraphPage<'a> {
    viewer: &'a Viewer,
    hand: Option<Hand>,
    latest: Arc<Mutex<Latest>>,
    model: ShownModel,
    log: ShownLog,
}

impl GraphPage<'_> {
    /// Shows the changes until the graph ends, which is `true`, or the command is interrupted.
    fn follow(
        &mut self,
        connection: &mut Connection,
        observer: &Observer<Reader>,
        poller: &mut Poller,
        mut before: Look,
        stop: &AtomicBool,
    ) -> anyhow::Result<bool> {
        let mut frame_due = Instant::now();
        let mut graph_due = Instant::now() + GRAPH_PAUSE;
        while !stop.load(Ordering::Relaxed) {
            match connection.hear(POLL)? {
                Heard::Ended(_) => return Ok(true),
                _ if observer.has_failed() => bail!("the graph cannot be read any more"),
                _ => {}
            }
            self.show_decision();
            if Instant::now() >= frame_due {
                frame_due = Instant::now() + TICK;
                self.show_frame(false);
            }
            if Instant::now() >= graph_due {
                graph_due = Instant::now() + GRAPH_PAUSE;
                let now = poller.look()?;
                self.viewer.keep("graph", &graph_event(&now, Some(&before))?);
                self.show_model_and_log(&now);
                before = now;
            }
        }
        Ok(false)
    }

    fn latest(&self) -> MutexGuard<'_, Latest> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn show_model_and_log(&mut self, now: &Look) {
        if let Some(event) = self.model.update(&now.status) {
            self.viewer.keep("model", &event);
        }
        self.show_log();
    }

    fn show_log(&mut self) {
        if self.log.update() {
            self.viewer.show_log(json!(self.log.lines).to_string());
        }
    }

    fn show_decision(&self) {
        let mut latest = self.latest();
        if std::mem::take(&mut latest.is_decided)
            && let Some(mut decided) = latest.decisions.pop()
        {
            latest.find_grounds(&mut decided, self.hand.as_ref(), &self.model);
            let event = decision_event(&decided, &latest.truths);
            latest.decisions.push(decided);
            drop(latest);
            self.viewer.keep("decision", &event.to_string());
        }
    }

    /// Shows the samples since the last tick. Decisions wait for their frames, unless no more come.
    fn show_frame(&self, is_last: bool) {
        let mut latest = self.latest();
        let mut taken = std::mem::take(&mut *latest);
        for mut decided in std::mem::take(&mut taken.decisions) {
            if !is_last && taken.is_before_frame_of(&decided) && latest.decisions.len() < MAX_WAITING {
                latest.decisions.push(decided);
            } else {
                taken.find_grounds(&mut decided, self.hand.as_ref(), &self.model);
                taken.decisions.push(decided);
            }
        }
        // Labels wait for decisions that come later.
        latest.truths.clone_from(&taken.truths);
        latest.recent = std::mem::take(&mut taken.recent);
        latest.settled = std::mem::take(&mut taken.settled);
        drop(latest);
        if let Some(decision) = &taken.shadow_decision {
            self.viewer.keep("shadow", &shadow_event(decision).to_string());
        }
        if self.viewer.n_browsers() > 0
            && let Some(event) = frame_event(self.hand.as_ref(), &self.model, taken)
        {
            self.viewer.send("frame", &event);
        }
    }
}

/// The last lines of a graph's logs. Logs that cannot be read are left out.
struct ShownLog {
    tail: Option<LogTail>,
    lines: VecDeque<LogLine>,
    is_new: bool,
}

impl ShownLog {
    fn open(folder: &Path) -> ShownLog {
        match LogTail::open(LogFolder::at(folder.into()), None, MAX_LOG_LINES) {
            Ok((tail, lines)) => ShownLog { tail: Some(tail), lines: lines.into(), is_new: true },
            Err(_) => ShownLog { tail: None, lines: VecDeque::new(), is_new: true },
        }
    }

    /// Reads on; whether the lines are others than before.
    fn update(&mut self) -> bool {
        let more = self.tail.as_mut().and_then(|tail| tail.more().ok()).unwrap_or_default();
        let is_new = std::mem::take(&mut self.is_new) || !more.is_empty();
        self.lines.extend(more);
        self.lines.drain(..self.lines.len().saturating_sub(MAX_LOG_LINES));
        is_new
    }
}

/// The hand of the first node with a pad layout. A layout that cannot be read is said, and nothing shows a hand.
pub(in crate::commands) fn hand_of(graph: &Value) -> Option<Hand> {
    let nodes = graph["nodes"].as_array()?;
    let path = nodes.iter().find_map(|node| node["params"]["hand"].as_str())?;
    match Hand::load(Path::new(path)) {
        Ok(hand) => Some(hand),
        Err(error) => {
            print_diagnostic(&format!("no hand is shown: {:#}", anyhow::Error::from(error)));
            None
        }
    }
}

/// A grasp: the source's epoch, or its hash on the page of a graph, and its number.
pub(super) type GraspKey = (u64, u64);

/// A frame with the hash of its epoch, and its stamp.
#[derive(Clone)]
struct ShownFrame {
    epoch: u64,
    stamp_nanos: u64,
    frame: Arc<TactileFrame>,
}

/// A decision, and the frame that it was made about if that is known.
struct Decided {
    key: GraspKey,
    stamp_nanos: u64,
    decision: LiftDecision,
    frame: Option<ShownFrame>,
    /// The two values that spoke most against an unstable grasp.
    against: Option<String>,
}

/// The samples since the last tick.
#[derive(Default)]
struct Latest {
    frame: Option<ShownFrame>,
    /// The last frames, also of earlier ticks.
    recent: VecDeque<ShownFrame>,
    contacts: Option<ContactSet>,
    feature: Option<GraspFeature>,
    /// The last settled feature of each of the last grasps, also of earlier ticks.
    settled: BTreeMap<GraspKey, GraspFeature>,
    probabilities: Vec<f64>,
    /// Those of the model beside.
    shadow_probabilities: Vec<f64>,
    shadow_decision: Option<LiftDecision>,
    decisions: Vec<Decided>,
    /// Whether the last one is not on the page yet.
    is_decided: bool,
    /// Whether a grasp was stable.
    truths: BTreeMap<GraspKey, bool>,
    /// The labels that are new: their decision may be on the page already.
    new_truths: Vec<(GraspKey, bool)>,
}

/// Reads a graph's edges. It takes each sample at once, so that no writer waits for a browser.
struct Reader {
    latest: Arc<Mutex<Latest>>,
    hand_id: Option<u64>,
    streams: Option<Streams>,
    shadow: Option<Judge>,
    /// The key of the hashes that stand for the graph's epochs.
    epochs: RandomState,
}

impl Sink for Reader {
    fn take(&mut self, topic: &str, mut record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        // Every user of this machine can read the page, and a user who forges samples needs the epoch.
        with_sample!(&mut record, sample => sample.header.epoch = self.epochs.hash_one(sample.header.epoch));
        // A graph may have several hands: the page shows one. 0 stands for an unknown hand.
        let hand_id = record.header().hand_id;
        let is_shown = hand_id == 0 || self.hand_id.is_none_or(|shown| shown == hand_id);
        if let Some(streams) = &mut self.streams {
            streams.send(topic, &record);
        }
        let judged = match (&mut self.shadow, &record) {
            (Some(judge), Record::Tactile(sample)) if is_shown => Some(judge.sample(sample)),
            _ => None,
        };
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(Judged { prediction, decisions }) = judged {
            if latest.shadow_probabilities.len() < MAX_PROBABILITIES {
                latest.shadow_probabilities.push(prediction.probability_stable);
            }
            let decided = decisions.into_iter().rfind(|decision| decision.action.decides());
            latest.shadow_decision = decided.or(latest.shadow_decision.take());
        }
        latest.take(record, is_shown);
        Ok(())
    }
}

impl Latest {
    /// Takes a sample, which `is_shown` if it is of the hand on the page.
    fn take(&mut self, record: Record, is_shown: bool) {
        match record {
            Record::Tactile(sample) if is_shown => {
                let Header { epoch, stamp_nanos, .. } = sample.header;
                let shown = ShownFrame { epoch, stamp_nanos, frame: Arc::new(sample.message) };
                if self.recent.len() * shown.frame.cells_newtons.len().max(64) >= MAX_RECENT_CELLS {
                    self.recent.pop_front();
                }
                self.recent.push_back(shown.clone());
                self.frame = Some(shown);
            }
            Record::Contacts(sample) if is_shown => self.contacts = Some(sample.message),
            Record::Feature(sample) if is_shown => {
                if sample.message.phase == Phase::Settled {
                    let key = (sample.header.epoch, sample.message.grasp_id);
                    self.settled.insert(key, sample.message.clone());
                    cut_to(&mut self.settled, MAX_WAITING, key.0);
                }
                self.feature = Some(sample.message);
            }
            Record::Prediction(sample) if is_shown && self.probabilities.len() < MAX_PROBABILITIES => {
                self.probabilities.push(sample.message.probability_stable);
            }
            // Several a second, and nothing to look at.
            Record::Decision(sample) if sample.message.action == Action::GoOn => {}
            Record::Decision(sample) if is_shown => {
                self.is_decided = true;
                let Header { epoch, stamp_nanos, .. } = sample.header;
                let (key, decision) = ((epoch, sample.message.grasp_id), sample.message);
                self.decisions.push(Decided { key, stamp_nanos, decision, frame: None, against: None });
            }
            Record::Truth(sample) => {
                let key = (sample.header.epoch, sample.message.grasp_id);
                self.truths.insert(key, sample.message.stable);
                self.new_truths.push((key, sample.message.stable));
                cut_to(&mut self.truths, MAX_TRUTHS, key.0);
            }
            _ => {}
        }
    }
}

impl Latest {
    /// Whether the frame of a decision is still to come: a reader of many samples may be further with decisions than with frames.
    fn is_before_frame_of(&self, decided: &Decided) -> bool {
        let last = self.recent.back();
        last.is_some_and(|last| last.epoch == decided.key.0 && last.stamp_nanos < decided.stamp_nanos)
    }

    /// Finds the frame of a decision, and the values that speak against an unstable grasp. An arbiter decides under the stamp of the last
    /// prediction. That may be of the next grasp, so the last frame of the grasp itself is meant.
    fn find_grounds(&self, decided: &mut Decided, hand: Option<&Hand>, model: &ShownModel) {
        let key = decided.key;
        let mut latest_first = self.recent.iter().rev();
        let until = decided.stamp_nanos;
        let frame = latest_first.find(|it| (it.epoch, it.frame.grasp_id) == key && it.stamp_nanos <= until);
        decided.frame = frame.cloned();
        // After a probe, another model has judged.
        let is_settled = decided.frame.as_ref().is_none_or(|shown| shown.frame.phase == Phase::Settled);
        if matches!(decided.decision.reason, Reason::Unstable | Reason::Unsure)
            && is_settled
            && let (Some(hand), Some(feature)) = (hand, self.settled.get(&key))
        {
            decided.against = model.speak_against(hand, feature);
        }
    }
}

/// Removes a grasp if there are more than so many: one of an earlier run of the source than `epoch`, or the first.
fn cut_to<T>(of_grasps: &mut BTreeMap<GraspKey, T>, most: usize, epoch: u64) {
    if of_grasps.len() > most {
        let earlier = of_grasps.keys().find(|key| key.0 != epoch).or(of_grasps.keys().next()).copied();
        earlier.map(|key| of_grasps.remove(&key));
    }
}

/// Numbers are texts: JavaScript has no integers beyond 2^53.
fn decision_event(decided: &Decided, truths: &BTreeMap<GraspKey, bool>) -> Value {
    let mut event = shadow_event(&decided.decision);
    event["epoch"] = decided.key.0.to_string().into();
    event["truth"] = json!(truths.get(&decided.key));
    event["against"] = json!(decided.against);
    event
}

/// The decision of the model beside.
pub(super) fn shadow_event(decision: &LiftDecision) -> Value {
    json!({
        "grasp_id": decision.grasp_id.to_string(), "action": decision.action, "reason": decision.reason,
        "probability_stable": decision.probability_stable,
    })
}

/// `None` if there is nothing new.
fn frame_event(hand: Option<&Hand>, model: &ShownModel, latest: Latest) -> Option<String> {
    let Latest { frame, contacts, feature, probabilities, shadow_probabilities, decisions, truths, .. } = latest;
    if frame.is_none() && probabilities.is_empty() && decisions.is_empty() && latest.new_truths.is_empty() {
        return None;
    }
    let decisions = decisions.iter().map(|decided| {
        let mut event = decision_event(decided, &truths);
        if let (Some(hand), Some(shown)) = (hand, &decided.frame) {
            let mut frame = json!({});
            add_frame(&mut frame, hand, &shown.frame, contacts.as_ref());
            event["frame"] = frame;
        }
        event
    });
    let decisions: Vec<Value> = decisions.collect();
    let labels = latest.new_truths.iter();
    let labels = labels.map(|((epoch, grasp_id), stable)| json!([epoch.to_string(), grasp_id.to_string(), stable]));
    let labels: Vec<Value> = labels.collect();
    let mut event = json!({
        "probabilities": probabilities, "shadow": shadow_probabilities, "decisions": decisions, "labels": labels,
    });
    if let Some(feature) = feature {
        event["feature"] = json!(feature.values);
        event["words"] = model.words(feature.dictionary_id, &feature.values).into();
    }
    if let (Some(hand), Some(shown)) = (hand, frame) {
        event["epoch"] = shown.epoch.to_string().into();
        add_frame(&mut event, hand, &shown.frame, contacts.as_ref());
    }
    Some(event.to_string())
}

/// Adds a frame with the contacts of its grasp, unless its joints are not those of the hand.
pub(super) fn add_frame(event: &mut Value, hand: &Hand, frame: &TactileFrame, contacts: Option<&ContactSet>) {
    let Ok(links) = link_poses(hand, &frame.joints) else { return };
    let contacts = contacts.filter(|contacts| contacts.grasp_id == frame.grasp_id);
    // Each as its point, the outward normal of its pad, and its force.
    let contacts = contacts.into_iter().flat_map(|contacts| &contacts.contacts);
    let contacts = contacts.map(|it| [&it.position_m[..], &it.normal, &[it.force_newtons]].concat());
    event["grasp_id"] = frame.grasp_id.to_string().into();
    event["phase"] = json!(frame.phase);
    event["joints"] = json!(frame.joints);
    event["links"] = json!(links);
    // JSON has no NaN: null stands for it.
    event["cells"] = json!(frame.cells_newtons);
    event["contacts"] = contacts.collect::<Vec<_>>().into();
    let gravity = frame.senses.get(Sense::Gravity);
    event["gravity"] = if gravity.is_empty() { Value::Null } else { json!(gravity) };
}

fn graph_event(now: &Look, before: Option<&Look>) -> anyhow::Result<String> {
    let mut event = serde_json::to_value(measure(now, before))?;
    event["warnings"] = json!(warnings(&now.status));
    let said = now.status.nodes.iter().map(|node| (&node.node, shown_counts(&node.counts)));
    event["said"] = json!(said.collect::<BTreeMap<_, _>>());
    let params = now.status.nodes.iter().map(|node| (&node.node, &node.params));
    event["params"] = json!(params.collect::<BTreeMap<_, _>>());
    if let Some(node) = now.status.nodes.iter().find(|node| node.params.get("driver") == Some(&"listen".into())) {
        let usual =
            tactile_path(&now.status.graph).map_or(Value::Null, |path| format!("unix:{}", path.display()).into());
        event["listens"] = node.params.get("address").cloned().unwrap_or(usual);
    }
    Ok(event.to_string())
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{GraspTruth, Stamped};

    use super::*;

    const EPOCH: u64 = 1_795_879_623_871_224_034;

    #[test]
    fn a_decision_waits_for_the_frame_of_its_own_grasp() {
        let mut latest = Latest::default();
        let at = |stamp_nanos| Header { epoch: 1, stamp_nanos, ..Header::default() };
        let frame = |grasp_id, stamp_nanos| -> Record {
            Stamped { header: at(stamp_nanos), message: TactileFrame { grasp_id, ..TactileFrame::default() } }.into()
        };
        latest.take(frame(5, 10), true);
        // The first frame of the next grasp decides, and is not read yet.
        let decision = LiftDecision { grasp_id: 5, ..LiftDecision::default() };
        latest.take(Stamped { header: at(30), message: decision }.into(), true);
        let mut decided = latest.decisions.pop().expect("a decision");
        assert!(latest.is_before_frame_of(&decided));
        latest.take(frame(5, 20), true);
        latest.take(frame(6, 30), true);
        assert!(!latest.is_before_frame_of(&decided));
        latest.find_grounds(&mut decided, None, &ShownModel::default());
        let found = decided.frame.expect("its frame");
        assert_eq!((found.frame.grasp_id, found.stamp_nanos), (5, 20));
    }

    #[test]
    fn the_page_tells_no_epoch_and_labels_find_their_decision() {
        let layout = Path::new(env!("CARGO_MANIFEST_DIR")).join("hands/barrett-bh8-280.yaml");
        let hand = Hand::load(&layout).expect("a hand");
        let latest = Arc::new(Mutex::new(Latest::default()));
        let shared = Arc::clone(&latest);
        let mut reader =
            Reader { latest: shared, hand_id: None, streams: None, shadow: None, epochs: RandomState::new() };
        let header = Header { epoch: EPOCH, stamp_nanos: 7, ..Header::default() };
        let frame = TactileFrame { grasp_id: 5, joints: vec![0.0; hand.joints.len()], ..TactileFrame::default() };
        let decision = LiftDecision { grasp_id: 5, action: Action::Lift, ..LiftDecision::default() };
        let truth = GraspTruth { grasp_id: 5, stable: true, ..GraspTruth::default() };
        let records: [Record; 3] = [
            Stamped { header, message: frame }.into(),
            Stamped { header, message: decision }.into(),
            Stamped { header, message: truth }.into(),
        ];
        for record in records {
            reader.take("/topic", record, 0).expect("taken");
        }
        let mut latest = std::mem::take(&mut *latest.lock().expect("a lock"));
        let mut decided = latest.decisions.pop().expect("a decision");
        latest.find_grounds(&mut decided, None, &ShownModel::default());
        latest.decisions.push(decided);
        let event = frame_event(Some(&hand), &ShownModel::default(), latest).expect("an event");
        assert!(!event.contains(&EPOCH.to_string()), "{event}");
        let event: Value = serde_json::from_str(&event).expect("JSON");
        let epoch = &event["epoch"];
        let decided = &event["decisions"][0];
        assert!(epoch.is_string(), "{event}");
        assert_eq!(&decided["epoch"], epoch);
        assert_eq!(decided["truth"], true);
        assert_eq!(decided["frame"]["grasp_id"], "5", "the frame of the decision is known by its epoch");
        assert_eq!(event["labels"], json!([[epoch, "5", true]]));
    }
}
