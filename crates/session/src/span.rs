//! The samples of a running graph that belong to a recording: all edges begin and end at the same sample of the source.
//!
//! A recorder attaches while samples are on their way. Edges with the source's numbers begin after the furthest sample
//! of any of them; samples in flight at that moment are before the beginning, not lost. A decision belongs to the
//! recording if its frame does, and all truths after the beginning do. At the end, edges that are behind are read until
//! they reach the furthest edge.

use serde::Serialize;

use crate::recorder::{Recorded, Recorder};
use blindgrasp_graph::client::observer::{Sink, bears_source_number};
use blindgrasp_graph::control::AttachedEdge;
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_messages::{Header, LiftDecision, Recorded as _};
use blindgrasp_operator::cursors::{SampleId, SharedCursors};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::port::sample_id;
use blindgrasp_operator::written::Written;
use blindgrasp_recording::Record;

/// The first gaps of an edge are printed one by one.
const N_GAPS_TOLD: u64 = 5;

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SpanOfEdge {
    pub topic: String,
    pub samples: u64,
    pub first: Option<u64>,
    pub last: Option<u64>,
    /// Missing numbers between the first and the last, or samples that were sent and have not come, if there are more of them.
    pub missing: u64,
}

#[derive(Default)]
pub struct EdgeSpan {
    topic: String,
    /// Whether it has the source's numbers.
    is_numbered: bool,
    /// Whether it has one sample a grasp, with numbers of its own.
    is_said_once: bool,
    answered_slots: Vec<usize>,
    writer_slot: usize,
    /// The last sample before the recorder attached.
    place: Option<SampleId>,
    has_begun: bool,
    first: Option<u64>,
    /// The last sample recorded.
    last: Option<SampleId>,
    /// The last sample seen.
    seen: Option<SampleId>,
    /// The last decision on the frames up to the end, once it is known.
    until: Option<Option<SampleId>>,
    n_samples: u64,
    n_missing: u64,
    n_gaps: u64,
    /// See [`Sink::lacks`].
    n_lost: u64,
}

/// The part of the stream that is recorded.
pub struct Span {
    /// The progress of the graph.
    cursors: SharedCursors,
    edges: Vec<EdgeSpan>,
    recorder: Recorder,
    /// The furthest sample before the recording; `None` if there was none.
    before: Option<SampleId>,
    /// When the first recorded frame was taken, by the source's clock.
    first_stamp_nanos: Option<u64>,
    /// The last sample recorded of the furthest edge, and when its frame was taken.
    end: Option<(SampleId, u64)>,
    /// The furthest sample of the source that was recorded.
    furthest: Option<Header>,
    is_leaving: bool,
}

impl EdgeSpan {
    pub fn of(edge: &AttachedEdge) -> Self {
        let type_name = &edge.input.service.type_name;
        EdgeSpan {
            topic: edge.topic.clone(),
            is_numbered: bears_source_number(type_name),
            is_said_once: type_name == LiftDecision::TYPE_NAME,
            answered_slots: edge.answered_slots.clone(),
            writer_slot: edge.input.writer_slot,
            ..EdgeSpan::default()
        }
    }

    /// Whether a sample is before the recording.
    fn is_before(&self, key: &SampleId, before: Option<SampleId>) -> bool {
        let Some(before) = before else { return false };
        if key.epoch == before.epoch {
            return key.seq <= before.seq;
        }
        // The sample is of the epoch in which the edge was when the recorder attached, or of a later one.
        self.place.is_some_and(|place| place.epoch == key.epoch)
    }

    /// Counts a recorded sample, and the missing samples before it.
    fn count(&mut self, key: SampleId, before: Option<SampleId>) {
        let before = if self.is_numbered { before } else { None };
        let last = self.last.or(before);
        let n_missing = match last {
            Some(last) if last.epoch == key.epoch && key.seq > last.seq => key.seq - last.seq - 1,
            _ => 0,
        };
        if n_missing > 0 {
            self.n_missing += n_missing;
            self.n_gaps += 1;
            if self.n_gaps <= N_GAPS_TOLD {
                let (first, last) = (key.seq - n_missing, key.seq - 1);
                print_diagnostic(&format!("blindgrasp: {}: samples {first} to {last} are missing", self.topic));
            }
        }
        self.has_begun = true;
        self.first.get_or_insert(key.seq);
        self.last = Some(key);
        self.n_samples += 1;
    }

    fn missing(&self) -> u64 {
        self.n_missing.max(self.n_lost)
    }

    /// Whether the edge has come as far as the end. The source has come to `source`.
    fn has_reached(&mut self, end: SampleId, source: &Written, cursors: &SharedCursors) -> bool {
        if self.is_numbered {
            let own = cursors.output(self.writer_slot).written().map(|own| own.last.epoch);
            // The samples of another source have epochs of their own.
            let is_of_source = own.is_none_or(|epoch| source.knows(epoch));
            return !is_of_source || self.seen.is_some_and(|seen| source.is_past(seen, end));
        }
        if !self.is_said_once {
            return true;
        }
        let writer = cursors.output(self.writer_slot);
        if self.until.is_none() {
            // Its answered samples are read before its sent samples, which then include the answers.
            let answered = |slot: &usize| cursors.input(*slot).key().is_some_and(|key| source.is_past(key, end));
            if !self.answered_slots.iter().all(answered) {
                return false;
            }
            self.until = Some(writer.key());
        }
        let (Some(until), Some(written)) = (self.until.flatten(), writer.written()) else { return true };
        self.seen.or(self.place).is_some_and(|seen| written.is_past(seen, until))
    }
}

impl Span {
    pub fn new(cursors: SharedCursors, edges: Vec<EdgeSpan>, recorder: Recorder) -> Self {
        Span {
            cursors,
            edges,
            recorder,
            before: None,
            first_stamp_nanos: None,
            end: None,
            furthest: None,
            is_leaving: false,
        }
    }

    pub fn finish(mut self, ending: Ending) -> (Vec<SpanOfEdge>, Recorded) {
        let end = self.end.map(|(end, _)| end);
        for edge in self.edges.iter_mut().filter(|edge| edge.is_numbered) {
            // The samples that it has not reached in time.
            if let (Some(end), Some(last)) = (end, edge.last.or(self.before))
                && end.epoch == last.epoch
            {
                edge.n_missing += end.seq.saturating_sub(last.seq);
            }
        }
        let edges = self.edges.into_iter().map(|edge| SpanOfEdge {
            missing: edge.missing(),
            topic: edge.topic,
            samples: edge.n_samples,
            first: edge.first,
            last: edge.last.map(|last| last.seq),
        });
        (edges.collect(), self.recorder.finish(ending))
    }

    /// Whether a sample of an edge belongs to the recording.
    fn belongs(&self, edge: &EdgeSpan, header: &Header) -> bool {
        let key = sample_id(header);
        if edge.is_numbered {
            let is_behind_end = self.end.is_some_and(|(end, _)| {
                if key.epoch == end.epoch {
                    key.seq > end.seq
                } else {
                    // A later epoch, if it has come to the end's already.
                    edge.last.is_some_and(|last| last.epoch == end.epoch)
                }
            });
            return !is_behind_end && (edge.has_begun || !edge.is_before(&key, self.before));
        }
        if edge.is_said_once && self.edges.iter().any(|edge| edge.is_numbered) {
            let is_after_end = self.end.is_some_and(|(_, stamp_nanos)| header.stamp_nanos > stamp_nanos);
            let is_after_start = self.first_stamp_nanos.is_some_and(|first| header.stamp_nanos >= first);
            return !is_after_end && (edge.has_begun || is_after_start);
        }
        !self.is_leaving
    }
}

impl Sink for Span {
    fn take(&mut self, topic: &str, record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        let Some(edge_idx) = self.edges.iter().position(|edge| edge.topic == topic) else {
            return Ok(());
        };
        let header = *record.header();
        let is_leader = self.edges[..edge_idx].iter().all(|edge| !edge.is_numbered);
        let belongs = self.belongs(&self.edges[edge_idx], &header);
        let edge = &mut self.edges[edge_idx];
        edge.seen = Some(sample_id(&header));
        if !belongs {
            return Ok(());
        }
        if edge.is_numbered {
            self.first_stamp_nanos.get_or_insert(header.stamp_nanos);
            let is_furthest = |furthest: &Header| furthest.epoch != header.epoch || furthest.seq < header.seq;
            // A reader that is still in an earlier epoch is not ahead.
            let may_lead = is_leader || self.furthest.is_none_or(|furthest| furthest.epoch == header.epoch);
            if may_lead && self.furthest.as_ref().is_none_or(is_furthest) {
                self.furthest = Some(header);
            }
        }
        edge.count(sample_id(&header), self.before);
        self.recorder.push(topic, record);
        Ok(())
    }

    fn lacks(&mut self, topic: &str, n_lost: u64) {
        if let Some(edge) = self.edges.iter_mut().find(|edge| edge.topic == topic) {
            edge.n_lost = n_lost;
        }
    }

    fn begin(&mut self, places: &[Option<SampleId>]) {
        for (edge, place) in self.edges.iter_mut().zip(places) {
            edge.place = *place;
        }
        let numbered = || self.edges.iter().filter(|edge| edge.is_numbered).filter_map(|edge| edge.place);
        // The edges are in the graph's order: the first is in the latest epoch.
        let epoch = numbered().next().map(|first| first.epoch);
        self.before = numbered().filter(|place| Some(place.epoch) == epoch).max_by_key(|place| place.seq);
    }

    fn leave(&mut self) {
        self.is_leaving = true;
        self.end = self.furthest.map(|furthest| (sample_id(&furthest), furthest.stamp_nanos));
    }

    fn has_enough(&mut self) -> bool {
        let Some((end, _)) = self.end else { return true };
        // The edges are in the graph's order: the first has the source's samples before all others.
        let first = self.edges.iter().find(|edge| edge.is_numbered);
        let Some(source) = first.and_then(|edge| self.cursors.output(edge.writer_slot).written()) else { return true };
        self.edges.iter_mut().all(|edge| edge.has_reached(end, &source, &self.cursors))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn key(epoch: u64, seq: u64) -> SampleId {
        SampleId { epoch, seq }
    }

    fn edge(is_numbered: bool, place: Option<SampleId>) -> EdgeSpan {
        EdgeSpan { topic: "/tactile".into(), is_numbered, place, ..EdgeSpan::default() }
    }

    #[test]
    fn what_was_in_flight_is_before_the_recording() {
        // The source was at 100 when the recorder came, this edge at 97.
        let before = Some(key(5, 100));
        let behind = edge(true, Some(key(5, 97)));
        assert!(behind.is_before(&key(5, 98), before) && behind.is_before(&key(5, 100), before));
        assert!(!behind.is_before(&key(5, 101), before));
        // A new epoch has begun since.
        assert!(!behind.is_before(&key(6, 0), before));
        // This edge was still in the epoch before.
        let in_the_old = edge(true, Some(key(4, 1000)));
        assert!(in_the_old.is_before(&key(4, 1001), before) && in_the_old.is_before(&key(5, 3), before));
        assert!(!in_the_old.is_before(&key(5, 101), before));
        // Nothing had been sent.
        assert!(!edge(true, None).is_before(&key(5, 0), None));
    }

    /// The end of the recording is in an epoch that this edge has not come to.
    #[test]
    fn an_edge_in_an_earlier_epoch_has_not_reached_the_end() {
        let folder = tempfile::tempdir().expect("a folder");
        let cursors = SharedCursors::create(&folder.path().join("cursors"), 1, 0).expect("made");
        let source = Written { last: key(3, 1), first_seq: 0, before: Some(key(9, 4)) };
        let mut edge = edge(true, None);
        let ends = [key(9, 3), key(3, 0)];
        for (seen, has_reached) in [
            (key(5, 7), [false, false]),
            (key(9, 2), [false, false]),
            (key(9, 4), [true, false]),
            (key(3, 0), [true, true]),
        ] {
            edge.seen = Some(seen);
            assert_eq!(ends.map(|end| edge.has_reached(end, &source, &cursors)), has_reached, "{seen:?}");
        }
    }

    #[test]
    fn gaps_are_counted_from_the_beginning_on_and_not_across_epochs() {
        let before = Some(key(5, 100));
        let mut numbered = edge(true, Some(key(5, 97)));
        for seq in [102, 103, 107] {
            numbered.count(key(5, seq), before);
        }
        numbered.count(key(6, 4), before);
        numbered.count(key(6, 3), before);
        assert_eq!((numbered.n_samples, numbered.missing(), numbered.n_gaps), (5, 1 + 3, 2));
        // With a whole epoch that leaves no gap.
        numbered.n_lost = 9;
        assert_eq!(numbered.missing(), 9);
        assert_eq!((numbered.first, numbered.last), (Some(102), Some(key(6, 3))));
        // Decisions have numbers of their own: the first is the first.
        let mut decisions = edge(false, Some(key(5, 7)));
        decisions.count(key(5, 9), before);
        assert_eq!(decisions.n_missing, 0);
    }
}
