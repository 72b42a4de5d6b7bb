//! The selection of the part of a recording that is played, and its numbers.
//!
//! Whole grasps are selected, by the time of their beginning or by their number, so that each is decided as it was amid the
//! others.
//!
//! The stream that goes out begins at 0, as a source's does. Grasps that are not selected take up no numbers. Lost,
//! repeated and re-ordered frames of the recording stay so.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fmt;
use std::str::FromStr;

use blindgrasp_messages::{GraspTruth, Header, Stamped};

/// The number of latest grasps whose selection is remembered, for their late frames and labels.
const MAX_REMEMBERED: usize = 4096;

/// A selection; by default, the whole recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Selection {
    /// Leaves out grasps that begin earlier, counted from the recording's first sample.
    pub from_nanos: Option<u64>,
    /// Leaves out grasps that begin then or later.
    pub to_nanos: Option<u64>,
    pub grasps: Option<GraspIds>,
}

/// Grasp ids, written as `3,7-9`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GraspIds(Vec<(u64, u64)>);

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectionError {
    /// Two recordings were mixed into one.
    #[error(
        "sample {seq} is of the source's epoch {epoch:016x}, after samples of a later epoch: two recordings were mixed into one, \
         and the order of their samples is unknown; record them apart"
    )]
    Interleaved { seq: u64, epoch: u64 },
}

/// Selects and numbers a recording's samples, one after the other.
#[derive(Debug, Default)]
pub struct Selector {
    selection: Selection,
    first_stamp_nanos: Option<u64>,
    /// Whether each of the latest grasps is selected.
    verdicts: HashMap<u64, bool>,
    remembered: VecDeque<u64>,
    frames: Renumbering,
    truths: Renumbering,
    n_truths: u64,
    /// Labels of grasps that have not begun.
    waiting: VecDeque<Stamped<GraspTruth>>,
}

impl Selection {
    pub fn is_whole(&self) -> bool {
        *self == Selection::default()
    }
}

impl fmt::Display for Selection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let secs = |nanos: u64| nanos as f64 / 1e9;
        let from = self.from_nanos.map(|nanos| format!("begins {} s or later", secs(nanos)));
        let to = self.to_nanos.map(|nanos| format!("begins before {} s", secs(nanos)));
        let grasps = self.grasps.as_ref().map(|grasps| format!("is one of {grasps}"));
        let parts: Vec<String> = [from, to, grasps].into_iter().flatten().collect();
        f.write_str(&parts.join(" and "))
    }
}

impl GraspIds {
    fn contains(&self, grasp_id: u64) -> bool {
        self.0.iter().any(|(first, last)| (*first..=*last).contains(&grasp_id))
    }
}

impl FromStr for GraspIds {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.trim().parse::<u64>().ok();
        let range = |text: &str| match text.split_once('-') {
            Some((first, last)) => Some((number(first)?, number(last)?)).filter(|(first, last)| first <= last),
            None => number(text).map(|only| (only, only)),
        };
        let ranges: Option<Vec<_>> = text.split(',').map(range).collect();
        ranges.map(GraspIds).ok_or_else(|| format!("'{text}': expected numbers of grasps, like 3,7-9"))
    }
}

impl fmt::Display for GraspIds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ranges = self
            .0
            .iter()
            .map(|(first, last)| if first == last { first.to_string() } else { format!("{first}-{last}") });
        f.write_str(&ranges.collect::<Vec<_>>().join(","))
    }
}

impl Selector {
    pub fn new(selection: Selection) -> Self {
        Selector { selection, ..Selector::default() }
    }

    /// Takes the recording's next frame and returns its new number, if it is selected.
    ///
    /// # Errors
    /// See [`SelectionError`].
    pub fn frame(&mut self, header: &Header, grasp_id: u64) -> Result<Option<u64>, SelectionError> {
        let first = *self.first_stamp_nanos.get_or_insert(header.stamp_nanos);
        let is_selected = match self.verdicts.get(&grasp_id) {
            Some(is_selected) => *is_selected,
            None => {
                let is_selected = self.is_selected(header.stamp_nanos.saturating_sub(first), grasp_id);
                self.remember(grasp_id, is_selected);
                is_selected
            }
        };
        self.frames.number(header, is_selected)
    }

    /// Takes the recording's next label. Labels of grasps that have not begun wait; see [`Selector::next_truth`].
    pub fn truth(&mut self, truth: Stamped<GraspTruth>) {
        self.waiting.push_back(truth);
        // Label and frames of a grasp are recorded together: a label that waits longer has no grasp.
        while self.waiting.len() > MAX_REMEMBERED {
            self.waiting.pop_front();
        }
    }

    /// The next label that goes out now, with its new number. Call it until it returns `None`, before a frame goes out and
    /// after a label has come.
    ///
    /// # Errors
    /// See [`SelectionError`].
    pub fn next_truth(&mut self) -> Result<Option<Stamped<GraspTruth>>, SelectionError> {
        if self.selection.is_whole() {
            let Some(mut truth) = self.waiting.pop_front() else { return Ok(None) };
            truth.header.seq = self.truths.number(&truth.header, true)?.unwrap_or(truth.header.seq);
            return Ok(Some(truth));
        }
        let verdicts = &self.verdicts;
        self.waiting.retain(|truth| verdicts.get(&truth.message.grasp_id) != Some(&false));
        let is_due = |truth: &Stamped<GraspTruth>| verdicts.contains_key(&truth.message.grasp_id);
        let Some(idx) = self.waiting.iter().position(is_due) else { return Ok(None) };
        let Some(mut truth) = self.waiting.remove(idx) else { return Ok(None) };
        truth.header.seq = self.n_truths;
        self.n_truths += 1;
        Ok(Some(truth))
    }

    fn is_selected(&self, since_first_nanos: u64, grasp_id: u64) -> bool {
        let Selection { from_nanos, to_nanos, grasps } = &self.selection;
        from_nanos.is_none_or(|from| since_first_nanos >= from)
            && to_nanos.is_none_or(|to| since_first_nanos < to)
            && grasps.as_ref().is_none_or(|grasps| grasps.contains(grasp_id))
    }

    fn remember(&mut self, grasp_id: u64, is_selected: bool) {
        self.verdicts.insert(grasp_id, is_selected);
        self.remembered.push_back(grasp_id);
        if self.remembered.len() > MAX_REMEMBERED
            && let Some(oldest) = self.remembered.pop_front()
        {
            self.verdicts.remove(&oldest);
        }
    }
}

/// Turns recorded numbers into those of a stream that begins at 0 and leaves some samples out.
#[derive(Debug, Default)]
pub struct Renumbering {
    epoch: Option<u64>,
    past_epochs: BTreeSet<u64>,
    /// The greatest recorded number of this epoch.
    greatest: Option<u64>,
    /// By recorded number: from it on, so many numbers are subtracted.
    removed: BTreeMap<u64, u64>,
}

impl Renumbering {
    pub fn number(&mut self, header: &Header, is_selected: bool) -> Result<Option<u64>, SelectionError> {
        let Header { seq, epoch, .. } = *header;
        if self.epoch != Some(epoch) {
            if self.past_epochs.contains(&epoch) {
                return Err(SelectionError::Interleaved { seq, epoch });
            }
            self.removed.clear();
            match self.epoch.replace(epoch) {
                Some(past) => drop(self.past_epochs.insert(past)),
                // A recording may begin midway. A later epoch that does not begin at 0 has lost its first samples.
                None => drop(self.removed.insert(0, seq)),
            }
            self.greatest = None;
        }
        if !is_selected && self.greatest.is_none_or(|greatest| seq > greatest) {
            // The numbers since the sample before are all left out.
            let n_since = self
                .greatest
                .map_or_else(|| seq.saturating_add(1).saturating_sub(self.n_removed(seq)), |greatest| seq - greatest);
            self.removed.insert(seq.saturating_add(1), self.n_removed(seq).saturating_add(n_since));
            while self.removed.len() > MAX_REMEMBERED {
                self.removed.pop_first();
            }
        }
        self.greatest = self.greatest.max(Some(seq));
        Ok(is_selected.then(|| seq.saturating_sub(self.n_removed(seq))))
    }

    fn n_removed(&self, seq: u64) -> u64 {
        self.removed.range(..=seq).next_back().map_or(0, |(_, n_removed)| *n_removed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NANOS: u64 = 1_000_000_000;

    /// Epoch, number and grasp of each frame, a second apart; where it ends up.
    fn numbers(selection: &Selection, frames: &[(u64, u64, u64)]) -> Vec<Option<u64>> {
        let mut selector = Selector::new(selection.clone());
        let numbered = frames.iter().enumerate().map(|(idx, (epoch, seq, grasp_id))| {
            let stamp_nanos = 5 + idx as u64 * STEP_NANOS;
            let header = Header { seq: *seq, epoch: *epoch, stamp_nanos, ..Header::default() };
            selector.frame(&header, *grasp_id).expect("not mixed")
        });
        numbered.collect()
    }

    fn grasps(text: &str) -> Selection {
        Selection { grasps: Some(text.parse().expect("grasps")), ..Selection::default() }
    }

    #[test]
    fn what_is_whole_keeps_its_numbers_and_its_faults() {
        let frames = [(1, 0, 0), (1, 1, 0), (1, 4, 0), (1, 4, 0), (1, 3, 1), (2, 2, 1), (2, 3, 1)];
        let expected = [0, 1, 4, 4, 3, 2, 3].map(Some);
        assert_eq!(numbers(&Selection::default(), &frames), expected);
    }

    #[test]
    fn what_begins_in_the_middle_begins_at_0() {
        let frames = [(1, 70, 9), (1, 71, 9), (1, 74, 9), (2, 0, 10)];
        assert_eq!(numbers(&Selection::default(), &frames), [0, 1, 4, 0].map(Some));
    }

    #[test]
    fn what_is_left_out_leaves_no_gap_and_lost_frames_do() {
        // Grasp 1 is left out; 5 was lost before grasp 2, 8 within it.
        let frames = [(1, 0, 0), (1, 1, 0), (1, 2, 1), (1, 4, 1), (1, 6, 2), (1, 7, 2), (1, 9, 2)];
        let expected = [Some(0), Some(1), None, None, Some(3), Some(4), Some(6)];
        assert_eq!(numbers(&grasps("0,2-3"), &frames), expected);
        // What comes first begins at 0, unless its own first frames were lost.
        let expected = [None, None, None, None, Some(1), Some(2), Some(4)];
        assert_eq!(numbers(&grasps("2"), &frames), expected);
        assert_eq!(numbers(&grasps("1"), &frames), [None, None, Some(0), Some(2), None, None, None]);
    }

    #[test]
    fn times_select_the_grasps_that_begin_within_them() {
        let frames = [(1, 0, 0), (1, 1, 0), (1, 2, 1), (1, 3, 1), (1, 4, 2)];
        let selection = |from, to| Selection { from_nanos: from, to_nanos: to, ..Selection::default() };
        let (second, fourth) = (Some(STEP_NANOS), Some(4 * STEP_NANOS));
        assert_eq!(numbers(&selection(second, fourth), &frames), [None, None, Some(0), Some(1), None]);
        assert_eq!(numbers(&selection(None, second), &frames), [Some(0), Some(1), None, None, None]);
        assert_eq!(numbers(&selection(fourth, None), &frames), [None, None, None, None, Some(0)]);
    }

    #[test]
    fn a_start_of_the_source_that_comes_back_is_an_error() {
        let mut selector = Selector::new(Selection::default());
        let header = |epoch, seq| Header { seq, epoch, ..Header::default() };
        selector.frame(&header(1, 0), 0).expect("the first");
        selector.frame(&header(2, 0), 0).expect("another");
        assert_eq!(selector.frame(&header(1, 1), 0), Err(SelectionError::Interleaved { seq: 1, epoch: 1 }));
    }

    #[test]
    fn a_truth_goes_out_with_its_grasp_wherever_it_was_recorded() {
        let truth = |grasp_id, seq| Stamped {
            header: Header { seq, epoch: 1, ..Header::default() },
            message: GraspTruth { grasp_id, ..GraspTruth::default() },
        };
        let all = |selector: &mut Selector| {
            std::iter::from_fn(|| selector.next_truth().expect("not mixed"))
                .map(|truth| (truth.message.grasp_id, truth.header.seq))
                .collect::<Vec<_>>()
        };
        let frame = |selector: &mut Selector, seq, grasp_id| {
            let header = Header { seq, epoch: 1, ..Header::default() };
            selector.frame(&header, grasp_id).expect("not mixed");
        };
        let mut selector = Selector::new(grasps("1-2"));
        for (grasp_id, seq) in [(0, 7), (1, 8), (2, 9)] {
            selector.truth(truth(grasp_id, seq));
        }
        frame(&mut selector, 0, 0);
        assert_eq!(all(&mut selector), []);
        frame(&mut selector, 1, 1);
        assert_eq!(all(&mut selector), [(1, 0)]);
        frame(&mut selector, 2, 2);
        assert_eq!(all(&mut selector), [(2, 1)]);

        // Of a whole recording none waits.
        let mut selector = Selector::new(Selection::default());
        selector.truth(truth(3, 7));
        selector.truth(truth(4, 9));
        assert_eq!(all(&mut selector), [(3, 0), (4, 2)]);
    }

    #[test]
    fn grasps_are_numbers_and_ranges() {
        let ids: GraspIds = "3,7-9".parse().expect("grasps");
        assert_eq!((0..12).filter(|id| ids.contains(*id)).collect::<Vec<_>>(), [3, 7, 8, 9]);
        assert_eq!(ids.to_string(), "3,7-9");
        for text in ["", "a", "9-7", "3,,4", "-1", "1-2-3"] {
            text.parse::<GraspIds>().expect_err(text);
        }
    }
}
