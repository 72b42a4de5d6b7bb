//! `record --keep`: a flight recorder. It holds the last seconds of every edge in memory. It writes them to a file of their own
//! when a lift has dropped its object, when a fault holds a grasp, or when somebody asks for it.
//!
//! A file holds whole grasps from its first frame on, so that `blindgrasp test` repeats it: a grasp is kept until the next one
//! has begun and is itself older than the time to keep.

use std::collections::{HashSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use serde::Serialize;

use blindgrasp_graph::client::observer::{Sink, bears_source_number};
use blindgrasp_graph::control::AttachedEdge;
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_messages::{Action, Phase, Reason, Record};
use blindgrasp_recording::{LiveOptions, LiveRecorder, RecordingError, RecordingInfo};

/// Samples that are still under way when the file ends have this long to arrive.
const UNDER_WAY_NANOS: u64 = 500_000_000;
/// A label may come before the first frame of its grasp, and an answer may be read before the frame that it answers.
const BEFORE_GRASP_NANOS: u64 = 1_000_000_000;
/// The oldest samples go when more bytes than this are held: a hand of 1,000 cells at 1 kHz fills it in a minute.
const MAX_BYTES: usize = 512 << 20;
/// The memory that each sample takes beside its values, roughly.
const ALLOCATION_BYTES: usize = 64;

/// Why a file is written after a lift that dropped its object.
const DROPPED: &str = "dropped";

/// The moment that makes the flight recorder write.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Trigger {
    /// Why, each reason once.
    why: Vec<String>,
    since_nanos: u64,
    until_nanos: u64,
}

struct KeptEdge {
    topic: String,
    is_numbered: bool,
}

struct Kept {
    edge_idx: usize,
    record: Arc<Record>,
    received_nanos: u64,
    begins_grasp: bool,
}

/// The last seconds of a graph. Times are of CLOCK_BOOTTIME.
#[derive(Default)]
pub struct FlightRecorder {
    edges: Vec<KeptEdge>,
    /// The edge with the source's frames.
    leader_idx: usize,
    keep_nanos: u64,
    after_nanos: u64,
    samples: VecDeque<Kept>,
    n_bytes: usize,
    /// Samples younger than the time to keep have been forgotten, for lack of room.
    is_full: bool,
    /// The grasp of the last frame, with its epoch.
    grasp: Option<(u64, u64)>,
    /// The grasp that was last reported as dropped, with its epoch.
    dropped: Option<(u64, u64)>,
    /// The fault that held the last grasp. The next grasps that it holds write no further files.
    last_fault: Option<Reason>,
    trigger: Option<Trigger>,
    /// The next one, while the last samples of a file are under way.
    later: Option<Trigger>,
}

/// The samples for a file, and the facts about it.
#[derive(Serialize, Default)]
pub struct Excerpt {
    /// Empty until it is written.
    pub file: PathBuf,
    pub why: Vec<String>,
    pub frames: usize,
    pub grasps: usize,
    pub secs: f64,
    /// Samples that edges lack of the frames in the file.
    pub missing: u64,
    #[serde(skip)]
    samples: Vec<(String, Arc<Record>)>,
    #[serde(skip)]
    ending: Ending,
}

impl FlightRecorder {
    /// `None` if no edge bears frames.
    pub fn new(edges: &[AttachedEdge], keep: Duration, after: Duration) -> Option<Self> {
        let kept = |edge: &AttachedEdge| KeptEdge {
            topic: edge.topic.clone(),
            is_numbered: bears_source_number(&edge.input.service.type_name),
        };
        Self::of(edges.iter().map(kept).collect(), keep, after)
    }

    fn of(edges: Vec<KeptEdge>, keep: Duration, after: Duration) -> Option<Self> {
        Some(FlightRecorder {
            // The edges are in the graph's order, sources first.
            leader_idx: edges.iter().position(|edge| edge.is_numbered)?,
            edges,
            keep_nanos: keep.as_nanos() as u64,
            after_nanos: after.as_nanos() as u64,
            ..FlightRecorder::default()
        })
    }

    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) {
        let Some(edge_idx) = self.edges.iter().position(|edge| edge.topic == topic) else { return };
        if let Some(why) = self.reason_to_write(&record) {
            self.ask(why, received_nanos);
        }
        let mut begins_grasp = false;
        if edge_idx == self.leader_idx {
            let grasp = (record.header().epoch, record.grasp_id());
            // The first grasp that is seen may have begun before.
            begins_grasp = self.grasp.map_or(record.header().seq == 0, |last| last != grasp);
            self.grasp = Some(grasp);
        }
        self.n_bytes += n_bytes(&record);
        self.samples.push_back(Kept { edge_idx, record: Arc::new(record), received_nanos, begins_grasp });
        if begins_grasp {
            self.forget(received_nanos);
        }
        let limit_nanos = self.limit_nanos(received_nanos);
        while self.n_bytes > MAX_BYTES {
            self.is_full |= self.samples.front().is_some_and(|kept| kept.received_nanos >= limit_nanos);
            self.forget_first();
        }
    }

    /// A dropped object, an object that slips while the arm lifts, or a fault that did not hold the grasp before as well.
    fn reason_to_write(&mut self, record: &Record) -> Option<&'static str> {
        match record {
            Record::Tactile(sample) if sample.message.phase == Phase::Dropped => {
                let grasp = (record.header().epoch, record.grasp_id());
                (self.dropped.replace(grasp) != Some(grasp)).then_some(DROPPED)
            }
            Record::Outcome(sample) => (sample.message.lifted && !sample.message.held).then_some(DROPPED),
            Record::Decision(sample) if sample.message.action == Action::SetDown => Some(Reason::Slipping.as_str()),
            Record::Decision(sample) if sample.message.action.decides() => {
                let reason = sample.message.reason;
                let fault = (sample.message.action == Action::Hold && reason.is_fault()).then_some(reason);
                let is_new = fault != self.last_fault;
                self.last_fault = fault;
                if is_new { fault.map(Reason::as_str) } else { None }
            }
            _ => None,
        }
    }

    /// Asks for a file. What happens before it is complete goes into the same file, and what happens meanwhile prolongs it, by no
    /// more than the time to keep.
    pub fn ask(&mut self, why: &str, now_nanos: u64) {
        let (after_nanos, keep_nanos) = (self.after_nanos, self.keep_nanos);
        let is_over = self.trigger.as_ref().is_some_and(|trigger| now_nanos > trigger.until_nanos);
        let trigger = if is_over { &mut self.later } else { &mut self.trigger };
        let trigger =
            trigger.get_or_insert_with(|| Trigger { why: Vec::new(), since_nanos: now_nanos, until_nanos: now_nanos });
        trigger.until_nanos = (now_nanos + after_nanos).min(trigger.since_nanos + keep_nanos.max(after_nanos));
        if !trigger.why.iter().any(|known| known == why) {
            trigger.why.push(why.into());
        }
    }

    /// The graph has been stopped. A grasp that was open then is held as missing, which is no fault.
    pub fn graph_has_ended(&mut self) {
        let last_nanos =
            self.samples.iter().rfind(|kept| kept.edge_idx == self.leader_idx).map(|kept| kept.received_nanos);
        let is_of_the_end = |trigger: &mut Trigger| {
            trigger.why == [Reason::Missing.as_str()] && last_nanos.is_none_or(|last| trigger.since_nanos >= last)
        };
        self.trigger.take_if(is_of_the_end);
        self.later.take_if(is_of_the_end);
        if self.trigger.is_none() {
            self.trigger = self.later.take();
        }
    }

    /// The samples for the file that was asked for, once they have come.
    pub fn excerpt_when_due(&mut self, now_nanos: u64) -> Option<Excerpt> {
        let until_nanos = self.trigger.as_ref()?.until_nanos;
        if now_nanos < until_nanos + UNDER_WAY_NANOS { None } else { self.excerpt(until_nanos) }
    }

    /// Whether the time to keep does not fit into memory.
    pub fn is_full(&self) -> bool {
        self.is_full
    }

    /// The samples for a file that was asked for and is not due yet.
    pub fn excerpt_now(&mut self) -> Option<Excerpt> {
        self.excerpt(u64::MAX)
    }

    fn excerpt(&mut self, until_nanos: u64) -> Option<Excerpt> {
        let Trigger { why, since_nanos, .. } = self.trigger.take()?;
        self.trigger = self.later.take();
        let mut excerpt = Excerpt { why, ..Excerpt::default() };
        let held = || self.samples.iter().filter(|kept| kept.edge_idx == self.leader_idx);
        // From the first whole grasp on, unless that began after the moment that is to be kept.
        let has_whole = held().any(|kept| kept.begins_grasp && kept.received_nanos <= since_nanos);
        let frames: Vec<&Kept> = held()
            .skip_while(|kept| has_whole && !kept.begins_grasp)
            .take_while(|kept| kept.received_nanos <= until_nanos)
            .collect();
        let (Some(first), Some(last)) = (frames.first(), frames.last()) else { return Some(excerpt) };
        let from_nanos = first.received_nanos.saturating_sub(BEFORE_GRASP_NANOS);
        let ids: HashSet<(u64, u64)> = frames.iter().map(|kept| id(&kept.record)).collect();
        let grasps: HashSet<u64> = frames.iter().map(|kept| kept.record.grasp_id()).collect();
        let mut found = vec![HashSet::new(); self.edges.len()];
        for kept in self.samples.iter().filter(|kept| kept.received_nanos >= from_nanos) {
            let (edge, header) = (&self.edges[kept.edge_idx], kept.record.header());
            let belongs = if edge.is_numbered {
                ids.contains(&id(&kept.record))
            } else {
                // An answer to a later frame is after the end.
                grasps.contains(&kept.record.grasp_id()) && header.stamp_nanos <= last.record.header().stamp_nanos
            };
            if belongs {
                found[kept.edge_idx].insert(id(&kept.record));
                excerpt.samples.push((edge.topic.clone(), Arc::clone(&kept.record)));
            }
        }
        // Numbers that no frame has: the recorder was too slow, or the source had a gap.
        let mut n_gaps = 0;
        for pair in frames.windows(2) {
            let (before, after) = (pair[0].record.header(), pair[1].record.header());
            if before.epoch == after.epoch {
                n_gaps += after.seq.saturating_sub(before.seq.saturating_add(1));
            }
        }
        for (_, found) in self.edges.iter().zip(&found).filter(|(edge, _)| edge.is_numbered) {
            excerpt.missing += (ids.len() - found.len()) as u64 + n_gaps;
            // An edge that lacks the end, because its node does not answer, is compared up to where it ends.
            if !found.contains(&id(&last.record)) {
                excerpt.ending = Ending::Broken;
            }
        }
        (excerpt.frames, excerpt.grasps) = (frames.len(), grasps.len());
        excerpt.secs = (last.received_nanos - first.received_nanos) as f64 / 1e9;
        Some(excerpt)
    }

    /// When the time to keep begins, which ends now or when a file was asked for.
    fn limit_nanos(&self, now_nanos: u64) -> u64 {
        let until_nanos = self.trigger.as_ref().map_or(now_nanos, |trigger| trigger.since_nanos);
        until_nanos.saturating_sub(self.keep_nanos)
    }

    /// Forgets all before the last grasp that began before the time to keep.
    fn forget(&mut self, now_nanos: u64) {
        let limit_nanos = self.limit_nanos(now_nanos);
        let begins = self.samples.iter().filter(|kept| kept.begins_grasp).map(|kept| kept.received_nanos);
        let Some(begins_nanos) = begins.take_while(|nanos| *nanos <= limit_nanos).last() else { return };
        let is_old = |kept: &Kept| kept.received_nanos + BEFORE_GRASP_NANOS < begins_nanos;
        while self.samples.front().is_some_and(is_old) {
            self.forget_first();
        }
    }

    fn forget_first(&mut self) {
        if let Some(kept) = self.samples.pop_front() {
            self.n_bytes -= n_bytes(&kept.record);
        }
    }
}

impl Excerpt {
    /// Whether no frame has come yet.
    pub fn is_empty(&self) -> bool {
        self.frames == 0
    }

    /// Writes `STEM-TIME-WHY.mcap` beside `out`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&mut self, out: &Path, info: &RecordingInfo, options: &LiveOptions) -> Result<(), RecordingError> {
        self.file = path_for(out, &self.why);
        let mut live = LiveRecorder::create(&self.file, info, options.clone())?;
        for (topic, record) in &self.samples {
            live.write(topic, record)?;
        }
        live.set_ending(self.ending.word());
        live.finish().map(drop)
    }
}

/// The flight recorder as the observer's sink: the command looks at it beside.
#[derive(Clone)]
pub struct SharedRecorder(Arc<Mutex<FlightRecorder>>);

impl SharedRecorder {
    pub fn new(recorder: FlightRecorder) -> Self {
        SharedRecorder(Arc::new(Mutex::new(recorder)))
    }

    pub fn with<T>(&self, act: impl FnOnce(&mut FlightRecorder) -> T) -> T {
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Sink for SharedRecorder {
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        self.with(|recorder| recorder.take(topic, record, received_nanos));
        Ok(())
    }
}

fn id(record: &Record) -> (u64, u64) {
    (record.header().epoch, record.header().seq)
}

/// The bytes that a sample holds in memory, roughly.
fn n_bytes(record: &Record) -> usize {
    let of_lists = match record {
        Record::Tactile(sample) => 8 * (sample.message.joints.len() + sample.message.cells_newtons.len()),
        Record::Contacts(sample) => 64 * sample.message.contacts.len() + 8 * sample.message.joints.len(),
        Record::Feature(sample) => 8 * sample.message.values.len(),
        _ => 0,
    };
    size_of::<Kept>() + size_of::<Record>() + ALLOCATION_BYTES + of_lists
}

fn path_for(out: &Path, why: &[String]) -> PathBuf {
    let stem = out.file_stem().unwrap_or_default().to_string_lossy();
    let time = humantime::format_rfc3339_seconds(SystemTime::now()).to_string().replace(['-', ':'], "");
    let name = format!("{stem}-{time}-{}", why.join("-"));
    let names = std::iter::once(name.clone()).chain((2..).map(|n| format!("{name}-{n}")));
    let mut paths = names.map(|name| out.with_file_name(format!("{name}.mcap")));
    paths.find(|path| !path.exists()).unwrap_or_else(|| out.to_path_buf())
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{Header, LiftDecision, LiftOutcome, Prediction, Stamped, TactileFrame};

    const SEC: u64 = 1_000_000_000;

    fn recorder(keep_secs: u64, after_secs: u64) -> FlightRecorder {
        let edge = |topic: &str, is_numbered| KeptEdge { topic: topic.into(), is_numbered };
        let edges =
            vec![edge("/tactile", true), edge("/prediction", true), edge("/decision", false), edge("/outcome", false)];
        let (keep, after) = (Duration::from_secs(keep_secs), Duration::from_secs(after_secs));
        FlightRecorder::of(edges, keep, after).expect("an edge with frames")
    }

    fn header(seq: u64, nanos: u64) -> Header {
        Header { epoch: 1, seq, stamp_nanos: nanos, ..Header::default() }
    }

    /// A frame a second, four to a grasp, and its prediction.
    fn feed(recorder: &mut FlightRecorder, secs: std::ops::Range<u64>) {
        for sec in secs {
            let (grasp_id, nanos) = (sec / 4, sec * SEC);
            let frame = TactileFrame { grasp_id, ..TactileFrame::default() };
            recorder.take("/tactile", Stamped { header: header(sec, nanos), message: frame }.into(), nanos);
            let prediction = Prediction { grasp_id, ..Prediction::default() };
            recorder.take("/prediction", Stamped { header: header(sec, nanos), message: prediction }.into(), nanos);
        }
    }

    fn decide(recorder: &mut FlightRecorder, grasp_id: u64, reason: Reason, nanos: u64) {
        let action = if reason == Reason::Stable { Action::Lift } else { Action::Hold };
        let message = LiftDecision { grasp_id, action, reason, ..LiftDecision::default() };
        recorder.take("/decision", Stamped { header: header(grasp_id, nanos), message }.into(), nanos);
    }

    fn seqs(excerpt: &Excerpt, topic: &str) -> Vec<u64> {
        excerpt.samples.iter().filter(|(of, _)| of == topic).map(|(_, record)| record.header().seq).collect()
    }

    #[test]
    fn a_file_holds_whole_grasps_of_at_least_the_time_to_keep() {
        let mut recorder = recorder(9, 20);
        feed(&mut recorder, 0..50);
        recorder.ask("asked", 50 * SEC);
        feed(&mut recorder, 50..80);
        assert!(recorder.excerpt_when_due(70 * SEC).is_none(), "samples are under way");
        let excerpt = recorder.excerpt_when_due(71 * SEC).expect("due");
        // The last grasp that began before 50 s - 9 s did so at 40 s.
        assert_eq!(seqs(&excerpt, "/tactile"), (40..=70).collect::<Vec<_>>());
        assert_eq!(seqs(&excerpt, "/prediction"), (40..=70).collect::<Vec<_>>());
        assert_eq!((excerpt.missing, excerpt.grasps, excerpt.ending), (0, 8, Ending::Detached));
        assert!(recorder.excerpt_when_due(99 * SEC).is_none(), "a file is written once");
        feed(&mut recorder, 80..200);
        assert!(recorder.samples.len() < 40, "older samples are forgotten");
    }

    #[test]
    fn drops_and_new_faults_ask_for_a_file_and_opinions_do_not() {
        let mut recorder = recorder(10, 1);
        feed(&mut recorder, 0..8);
        for reason in [Reason::Stable, Reason::Unstable, Reason::NoContact, Reason::OutOfDistribution] {
            decide(&mut recorder, 0, reason, 8 * SEC);
            assert_eq!(recorder.trigger, None, "{reason:?}");
        }
        decide(&mut recorder, 1, Reason::Stale, 8 * SEC);
        assert_eq!(recorder.excerpt_now().expect("a fault").why, ["stale"]);
        decide(&mut recorder, 2, Reason::Stale, 8 * SEC);
        assert_eq!(recorder.trigger, None, "the same fault again");
        decide(&mut recorder, 3, Reason::Stable, 8 * SEC);
        for (lifted, held, expected) in [(true, true, None), (false, false, None), (true, false, Some("dropped"))] {
            let message = LiftOutcome { grasp_id: 1, lifted, held, ..LiftOutcome::default() };
            recorder.take("/outcome", Stamped { header: header(0, 8 * SEC), message }.into(), 8 * SEC);
            assert_eq!(recorder.trigger.as_ref().map(|trigger| trigger.why[0].as_str()), expected);
        }
        decide(&mut recorder, 4, Reason::SensorFault, 8 * SEC);
        let excerpt = recorder.excerpt_now().expect("a drop, and a fault soon after it");
        assert_eq!(excerpt.why, ["dropped", "sensor_fault"]);
        // A robot reports a drop by the phase of its frames, perhaps of several.
        for (seq, expected) in [(8, true), (9, false)] {
            let message = TactileFrame { grasp_id: 1, phase: Phase::Dropped, ..TactileFrame::default() };
            recorder.take("/tactile", Stamped { header: header(seq, 8 * SEC), message }.into(), 8 * SEC);
            assert_eq!(recorder.trigger.take().is_some(), expected);
        }
    }

    #[test]
    fn an_answer_to_a_frame_after_the_end_is_not_in_the_file() {
        let mut recorder = recorder(10, 0);
        feed(&mut recorder, 0..6);
        recorder.ask("asked", 5 * SEC);
        decide(&mut recorder, 0, Reason::Stable, 3 * SEC);
        feed(&mut recorder, 6..8);
        decide(&mut recorder, 1, Reason::Stable, 7 * SEC);
        let excerpt = recorder.excerpt_when_due(8 * SEC).expect("due");
        assert_eq!((seqs(&excerpt, "/tactile"), seqs(&excerpt, "/decision")), ((0..=5).collect(), vec![0]));
    }

    #[test]
    fn an_edge_that_lacks_the_end_is_told() {
        let mut recorder = recorder(10, 0);
        feed(&mut recorder, 0..6);
        let frame = TactileFrame { grasp_id: 1, ..TactileFrame::default() };
        recorder.take("/tactile", Stamped { header: header(6, 6 * SEC), message: frame }.into(), 6 * SEC);
        recorder.ask("asked", 6 * SEC);
        let excerpt = recorder.excerpt_now().expect("asked");
        assert_eq!((excerpt.missing, excerpt.ending), (1, Ending::Broken));
    }

    #[test]
    fn triggers_go_on_for_no_longer_than_the_time_to_keep() {
        let mut recorder = recorder(10, 3);
        (0..=10).for_each(|sec| recorder.ask("asked", sec * SEC));
        assert_eq!(
            recorder.trigger,
            Some(Trigger { why: vec!["asked".into()], since_nanos: 0, until_nanos: 10 * SEC })
        );
        // The next one has a file of its own.
        feed(&mut recorder, 0..12);
        recorder.ask("stale", 10 * SEC + 1);
        assert_eq!(recorder.excerpt_when_due(11 * SEC).expect("due").why, ["asked"]);
        assert_eq!(recorder.excerpt_when_due(20 * SEC).expect("due").why, ["stale"]);
        assert!(recorder.trigger.is_none());
    }

    #[test]
    fn a_moment_before_the_first_whole_grasp_is_written_from_the_oldest_frame_on() {
        let mut recorder = recorder(10, 0);
        // It attached amid grasp 0.
        feed(&mut recorder, 1..3);
        recorder.ask("dropped", 2 * SEC);
        feed(&mut recorder, 3..6);
        let excerpt = recorder.excerpt_when_due(3 * SEC).expect("due");
        assert_eq!(seqs(&excerpt, "/tactile"), [1, 2]);
        let mut idle = super::tests::recorder(10, 0);
        idle.ask("asked", SEC);
        assert!(idle.excerpt_now().expect("told").is_empty());
    }

    #[test]
    fn a_grasp_that_is_open_when_the_graph_is_stopped_is_no_fault() {
        let mut recorder = recorder(10, 1);
        feed(&mut recorder, 0..6);
        decide(&mut recorder, 1, Reason::Missing, 6 * SEC);
        recorder.graph_has_ended();
        assert!(recorder.excerpt_now().is_none());
        decide(&mut recorder, 2, Reason::Stale, 6 * SEC);
        recorder.graph_has_ended();
        assert!(recorder.excerpt_now().is_some());
        // A file is under way.
        recorder.ask("asked", 6 * SEC);
        decide(&mut recorder, 3, Reason::Missing, 8 * SEC);
        recorder.graph_has_ended();
        assert_eq!(recorder.excerpt_now().expect("asked").why, ["asked"]);
        assert!(recorder.excerpt_now().is_none());
        // Somebody asks for a file after the end.
        decide(&mut recorder, 4, Reason::Stale, 9 * SEC);
        recorder.trigger = None;
        decide(&mut recorder, 5, Reason::Missing, 9 * SEC);
        recorder.ask("asked", 20 * SEC);
        recorder.graph_has_ended();
        assert_eq!(recorder.excerpt_now().expect("asked").why, ["asked"]);
    }

    #[test]
    fn a_long_grasp_does_not_make_the_time_to_keep_too_long() {
        let mut recorder = recorder(10, 0);
        let n_cells = MAX_BYTES / 8 / 40;
        for sec in 0..60 {
            let message = TactileFrame { cells_newtons: vec![0.0; n_cells], ..TactileFrame::default() };
            recorder.take("/tactile", Stamped { header: header(sec, sec * SEC), message }.into(), sec * SEC);
        }
        assert!(recorder.samples.len() < 41, "the oldest samples are forgotten");
        assert!(!recorder.is_full(), "they were older than 10 s");
    }

    #[test]
    fn frames_that_were_missed_are_counted_on_every_edge() {
        let mut recorder = recorder(10, 0);
        feed(&mut recorder, 0..2);
        feed(&mut recorder, 5..7);
        recorder.ask("asked", 6 * SEC);
        assert_eq!(recorder.excerpt_now().expect("asked").missing, 2 * 3);
    }
}
