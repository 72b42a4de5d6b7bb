//! A recording played once or several times, from wherever its readers are.
//!
//! Samples keep their recorded numbers and times; each repetition continues the numbers, times and grasps of the one
//! before it. Of a recording with several epochs, it repeats the numbers and has other epochs: as in the first round, each of
//! them begins with its source's first sample. So a player that comes back after a crash finds its place by the sample that
//! its readers answered last.
//!
//! A small recording is read through when it is opened, and its samples are kept in the form in which they lie in shared
//! memory: to play them, nothing is read, decoded or allocated. Other recordings are read while they are played.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::PathBuf;

use super::playback::{Next, Playback, PlaybackError};
use super::played::Played;
use super::samples::{Sample, Samples};
use super::selection::Selection;
use blindgrasp_messages::{GraspTruthHead, Header, Message};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::port::sample_id;
use blindgrasp_recording::{Reach, RecordingIndex};

/// A larger recording is not read through before its first sample goes out: that would take seconds.
const MAX_CHECKED_BYTES: u64 = 64 << 20;
/// The distance of the epochs of two repetitions is a multiple of this that is greater than all distances in the recording.
const EPOCH_STEP: u64 = 1 << 32;
/// Samples that take more memory are not kept. Every graph on the machine may have a player.
const MAX_KEPT_BYTES: usize = 64 << 20;

/// What is played.
#[derive(Debug, Clone)]
pub struct Program {
    pub recording: PathBuf,
    pub selection: Selection,
    /// The topic, if the recording has several of the type.
    pub topic: Option<String>,
    pub n_repetitions: u64,
}

/// What comes next.
#[derive(Debug)]
pub enum Playing<'a, M: Message> {
    /// A sample to send. So many frames come before it, those included that its readers have.
    Frame {
        head: M::Head,
        items: &'a [M::Item],
        n_before: u64,
    },
    Truth {
        head: GraspTruthHead,
        items: &'a [u8],
    },
    /// Nothing to send yet.
    Nothing,
    /// All repetitions are over.
    End,
}

/// Plays a recording's samples of one type, and its truths.
pub struct Player<M: Played> {
    program: Program,
    hand_id: u64,
    /// The most items that a frame has.
    max_items: usize,
    /// `None` until the recording was read through.
    extent: Option<Extent>,
    /// Whether `samples` has all of the recording, and not only the one that goes out.
    is_kept: bool,
    samples: Samples<M>,
    /// The repetition that is under way; `None` between repetitions.
    under_way: Option<UnderWay<M>>,
    /// The sample to be sent; its items lie in `samples`.
    current: Option<Sample<M>>,
    repetition: u64,
    /// What the repetition under way has had so far.
    so_far: Extent,
    /// Frames so far, those included that the readers have.
    n_frames: u64,
    frames: Resume,
    truths: Resume,
}

/// Where the samples of a repetition come from.
enum UnderWay<M> {
    /// The index of the next one among the kept samples.
    Kept(usize),
    Read(Box<Playback<M>>),
}

impl<M: Played> Player<M> {
    /// Opens a recording. A small one is read through, so that damage is found before the first sample goes out.
    ///
    /// # Errors
    /// The recording cannot be played.
    pub fn open(program: Program) -> Result<Self, PlaybackError> {
        Self::open_with(program, MAX_CHECKED_BYTES, MAX_KEPT_BYTES)
    }

    fn open_with(program: Program, max_checked_bytes: u64, max_kept_bytes: usize) -> Result<Self, PlaybackError> {
        let index = RecordingIndex::open(&program.recording)?;
        let mut player = Player {
            program,
            hand_id: index.info.hand_id,
            max_items: M::MAX_ITEMS,
            extent: None,
            is_kept: false,
            samples: Samples::default(),
            under_way: None,
            current: None,
            repetition: 0,
            so_far: Extent::default(),
            n_frames: 0,
            frames: Resume { after: None },
            truths: Resume { after: None },
        };
        if index.n_file_bytes <= max_checked_bytes {
            player.keep(max_kept_bytes)?;
        }
        Ok(player)
    }

    /// The hand of the recording; 0 if the recording does not say.
    pub fn hand_id(&self) -> u64 {
        self.hand_id
    }

    /// The most items that a frame has.
    pub fn max_items(&self) -> usize {
        self.max_items
    }

    /// Goes on after the last frame and the last truth that need not be sent again. That may take reading the recording
    /// through; returns false if `go_on` ended it.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn resume(
        &mut self,
        frame: Option<SampleId>,
        truth: Option<SampleId>,
        go_on: &mut dyn FnMut() -> bool,
    ) -> Result<bool, PlaybackError> {
        (self.frames, self.truths) = (Resume { after: frame }, Resume { after: truth });
        (self.under_way, self.current) = (None, None);
        if self.program.n_repetitions > 1 && self.extent.is_none() && frame.is_some() {
            // The readers can be in any repetition.
            self.extent = self.read_through(go_on)?;
            if self.extent.is_none() {
                return Ok(false);
            }
        }
        let n_frames = self.extent.as_ref().map_or(0, |extent| extent.n_frames);
        self.repetition = self.extent.as_ref().map_or(0, |extent| match extent.n_truth_numbers {
            0 => self.frames.repetition(extent, extent.n_frame_numbers),
            n => self.frames.repetition(extent, extent.n_frame_numbers).min(self.truths.repetition(extent, n)),
        });
        self.n_frames = self.repetition.saturating_mul(n_frames);
        Ok(true)
    }

    /// Goes on to the next sample.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn advance(&mut self) -> Result<(), PlaybackError> {
        self.current = None;
        let mut under_way = match self.under_way.take() {
            Some(under_way) => under_way,
            None if self.repetition >= self.program.n_repetitions => return Ok(()),
            None => {
                self.so_far = Extent::default();
                if self.is_kept {
                    UnderWay::Kept(0)
                } else {
                    UnderWay::Read(Box::new(self.program.open(Reach::ByIndex)?))
                }
            }
        };
        let is_over = match &mut under_way {
            UnderWay::Kept(next) => {
                *next += 1;
                self.take_kept(*next - 1)
            }
            UnderWay::Read(playback) => self.take_read(playback)?,
        };
        if is_over {
            self.repetition += 1;
            self.extent.get_or_insert(std::mem::take(&mut self.so_far));
        } else {
            self.under_way = Some(under_way);
        }
        Ok(())
    }

    /// The sample to be sent now, until [`Player::advance`] is called again.
    pub fn current(&self) -> Playing<'_, M> {
        match &self.current {
            Some(Sample::Frame(head, items)) => {
                Playing::Frame { head: *head, items: &self.samples.items[items.clone()], n_before: self.n_frames - 1 }
            }
            Some(Sample::Truth(head, items)) => {
                Playing::Truth { head: *head, items: &self.samples.names[items.clone()] }
            }
            None if self.under_way.is_none() && self.repetition >= self.program.n_repetitions => Playing::End,
            None => Playing::Nothing,
        }
    }

    /// Goes to a kept sample, and returns whether there is none.
    fn take_kept(&mut self, idx: usize) -> bool {
        match self.samples.all.get(idx).cloned() {
            Some(Sample::Frame(head, items)) => {
                if let Some(header) = self.next_frame(M::header(&head)) {
                    self.set_frame(head, items, header);
                }
            }
            Some(Sample::Truth(head, items)) => self.set_truth(head, items),
            None => return true,
        }
        false
    }

    /// Goes to the next sample in the file, and returns whether there is none.
    fn take_read(&mut self, playback: &mut Playback<M>) -> Result<bool, PlaybackError> {
        let Some(next) = playback.next().transpose()? else { return Ok(true) };
        self.so_far.add(&next);
        match next {
            Next::Frame(frame) => {
                // Frames that the readers have are not decoded.
                if let Some(header) = self.next_frame(&frame.header) {
                    self.samples.clear();
                    let (head, items) = self.samples.add_frame(&playback.decode(&frame)?);
                    self.set_frame(head, items, header);
                }
            }
            Next::Truth(truth) => {
                self.samples.clear();
                let (head, items) = self.samples.add_truth(&truth);
                self.set_truth(head, items);
            }
            Next::Nothing => {}
        }
        Ok(false)
    }

    /// Counts a frame. Returns the header as it goes out, unless the readers have the frame.
    fn next_frame(&mut self, recorded: &Header) -> Option<Header> {
        let header = self.shifted(recorded, |extent| extent.n_frame_numbers);
        self.n_frames += 1;
        if self.frames.has(&header) { None } else { Some(header) }
    }

    fn set_frame(&mut self, mut head: M::Head, items: Range<usize>, header: Header) {
        let grasp_id = M::grasp_id_mut(&mut head);
        *grasp_id = self.shifted_grasp_id(*grasp_id);
        *M::header_mut(&mut head) = header;
        self.current = Some(Sample::Frame(head, items));
    }

    fn set_truth(&mut self, head: GraspTruthHead, items: Range<usize>) {
        let header = self.shifted(&head.header, |extent| extent.n_truth_numbers);
        if !self.truths.has(&header) {
            let grasp_id = self.shifted_grasp_id(head.grasp_id);
            self.current = Some(Sample::Truth(GraspTruthHead { header, grasp_id, ..head }, items));
        }
    }

    /// The header as it goes out in this repetition.
    fn shifted(&self, recorded: &Header, n_numbers: impl Fn(&Extent) -> u64) -> Header {
        let (n_numbers, duration_nanos) =
            self.extent.as_ref().map_or((0, 0), |extent| (n_numbers(extent), extent.duration_nanos()));
        let mut header = Header {
            stamp_nanos: recorded.stamp_nanos.saturating_add(self.repetition.saturating_mul(duration_nanos)),
            hand_id: if recorded.hand_id == 0 { self.hand_id } else { recorded.hand_id },
            ..*recorded
        };
        if self.extent.as_ref().is_some_and(Extent::has_several_epochs) {
            header.epoch = recorded
                .epoch
                .wrapping_add(self.repetition.wrapping_mul(self.extent.as_ref().map_or(0, Extent::epoch_step)));
        } else {
            header.seq = recorded.seq.saturating_add(self.repetition.saturating_mul(n_numbers));
        }
        header
    }

    fn shifted_grasp_id(&self, recorded: u64) -> u64 {
        let n_grasp_ids = self.extent.as_ref().map_or(0, |extent| extent.n_grasp_ids);
        recorded.saturating_add(self.repetition.saturating_mul(n_grasp_ids))
    }

    /// Reads a small recording through, and decodes and keeps the samples to be played, unless they take too much memory.
    fn keep(&mut self, max_kept_bytes: usize) -> Result<(), PlaybackError> {
        let mut playback = self.program.open::<M>(Reach::Whole)?;
        let mut extent = Extent::default();
        (self.is_kept, self.max_items) = (true, 0);
        while let Some(next) = playback.next() {
            let next = next?;
            extent.add(&next);
            match next {
                Next::Frame(frame) => {
                    let (_, items) = self.samples.add_frame(&playback.decode(&frame)?);
                    self.max_items = self.max_items.max(items.len());
                }
                Next::Truth(truth) => drop(self.samples.add_truth(&truth)),
                Next::Nothing => {}
            }
            self.is_kept &= self.samples.n_bytes() <= max_kept_bytes;
            if !self.is_kept {
                self.samples = Samples::default();
            }
        }
        self.samples.shrink_to_fit();
        self.extent = Some(extent);
        Ok(())
    }

    /// The extent of the recording; `None` if `go_on` ended the reading.
    fn read_through(&self, go_on: &mut dyn FnMut() -> bool) -> Result<Option<Extent>, PlaybackError> {
        let mut extent = Extent::default();
        for next in self.program.open::<M>(Reach::ByIndex)? {
            extent.add(&next?);
            if !go_on() {
                return Ok(None);
            }
        }
        Ok(Some(extent))
    }
}

impl Program {
    fn open<M: Played>(&self, reach: Reach) -> Result<Playback<M>, PlaybackError> {
        Playback::open(&self.recording, &self.selection, self.topic.as_deref(), reach)
    }
}

/// The sample after which to go on.
struct Resume {
    after: Option<SampleId>,
}

impl Resume {
    /// The repetition of that sample.
    fn repetition(&self, extent: &Extent, n_numbers: u64) -> u64 {
        let Some(after) = self.after else { return 0 };
        if !extent.has_several_epochs() {
            return after.seq / n_numbers.max(1);
        }
        let step = extent.epoch_step();
        let distances = extent.epochs.iter().map(|epoch| after.epoch.wrapping_sub(*epoch));
        distances.filter(|distance| distance % step == 0).min().map_or(0, |distance| distance / step)
    }

    /// Whether the readers have this sample. Samples must be asked for in order.
    fn has(&mut self, header: &Header) -> bool {
        let Some(after) = self.after else {
            return false;
        };
        let key = sample_id(header);
        let is_past = key.epoch == after.epoch && key.seq >= after.seq;
        if is_past {
            self.after = None;
        }
        !is_past || key == after
    }
}

/// What a recording has, once it was read through.
#[derive(Default)]
struct Extent {
    /// Those of the frames.
    epochs: BTreeSet<u64>,
    n_frames: u64,
    /// One more than the greatest number of a frame.
    n_frame_numbers: u64,
    /// One more than the greatest number of a truth.
    n_truth_numbers: u64,
    n_grasp_ids: u64,
    /// The times of the first and the last frame, and the distance between the first two.
    stamps: Option<(u64, u64, u64)>,
}

impl Extent {
    fn add(&mut self, next: &Next) {
        let grasp_id = match next {
            Next::Frame(frame) => {
                let Header { seq, stamp_nanos, epoch, .. } = frame.header;
                self.epochs.insert(epoch);
                self.n_frames += 1;
                self.n_frame_numbers = self.n_frame_numbers.max(seq.saturating_add(1));
                let (first, last, step) = self.stamps.unwrap_or((stamp_nanos, stamp_nanos, 0));
                let step = if step == 0 { stamp_nanos.saturating_sub(last) } else { step };
                self.stamps = Some((first, stamp_nanos, step));
                frame.grasp_id
            }
            Next::Truth(truth) => {
                self.n_truth_numbers = self.n_truth_numbers.max(truth.header.seq.saturating_add(1));
                truth.message.grasp_id
            }
            Next::Nothing => return,
        };
        self.n_grasp_ids = self.n_grasp_ids.max(grasp_id.saturating_add(1));
    }

    fn has_several_epochs(&self) -> bool {
        self.epochs.len() > 1
    }

    fn epoch_step(&self) -> u64 {
        let (Some(first), Some(last)) = (self.epochs.first(), self.epochs.last()) else { return EPOCH_STEP };
        EPOCH_STEP.saturating_mul(1 + (last - first) / EPOCH_STEP)
    }

    /// From the first frame to the time at which the first frame of the next repetition is due.
    fn duration_nanos(&self) -> u64 {
        self.stamps.map_or(0, |(first, last, step)| last.saturating_sub(first) + step)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_messages::{GraspFeature, GraspTruth, MAX_FEATURES, Stamped, TactileFrame};
    use blindgrasp_recording::{RecordingInfo, RecordingReader, RecordingWriter};
    use tempfile::TempPath;

    const HAND_ID: u64 = 5;

    /// Whether the recording is checked before it is played, and whether its samples are kept.
    const WAYS: [(u64, usize); 3] = [(u64::MAX, usize::MAX), (u64::MAX, 0), (0, 0)];

    /// A recording with the samples that `write` adds.
    fn recording(write: impl FnOnce(&mut RecordingWriter)) -> TempPath {
        let path = tempfile::NamedTempFile::new().expect("a file").into_temp_path();
        let info = RecordingInfo { hand: "h".into(), hand_id: HAND_ID, made_by: "a test".into(), version: "0".into() };
        let mut writer = RecordingWriter::create(&path, &info).expect("created");
        write(&mut writer);
        writer.finish().expect("finished");
        path
    }

    /// Grasps of three frames each, a second apart, with a label before each grasp. The fifth frame was lost.
    fn write(writer: &mut RecordingWriter, n_grasps: u64, n_cells: usize) {
        write_in_epochs(writer, n_grasps, n_cells, u64::MAX);
    }

    /// As [`write`]. Each `n_in_epoch` grasps are of an epoch of their own, whose numbers begin at 0.
    fn write_in_epochs(writer: &mut RecordingWriter, n_grasps: u64, n_cells: usize, n_in_epoch: u64) {
        for grasp_id in 0..n_grasps {
            let epoch = 2 + grasp_id / n_in_epoch;
            let seq = grasp_id % n_in_epoch;
            let header = Header { seq, stamp_nanos: grasp_id * 3_000_000_000, epoch, ..Header::default() };
            let object = format!("object {grasp_id}");
            let message = GraspTruth { grasp_id, epsilon: 0.1 * grasp_id as f64, object, ..GraspTruth::default() };
            writer.write("/truth", &Stamped { header, message }).expect("written");
            for seq in (grasp_id * 3..).take(3).filter(|seq| *seq != 4) {
                let stamp_nanos = seq * 1_000_000_000;
                let header =
                    Header { seq: seq % n_in_epoch.saturating_mul(3), stamp_nanos, epoch, ..Header::default() };
                let cells_newtons = (0..n_cells).map(|idx| (seq as f64 + idx as f64 * 0.7).sin()).collect();
                let joints = vec![seq as f64; 1 + grasp_id as usize % 4];
                let message = TactileFrame { grasp_id, joints, cells_newtons, ..TactileFrame::default() };
                writer.write("/tactile", &Stamped { header, message }).expect("written");
            }
        }
    }

    fn program(path: &Path, selection: Selection, n_repetitions: u64) -> Program {
        Program { recording: path.into(), selection, topic: None, n_repetitions }
    }

    fn from_to(from_secs: u64, to_secs: u64) -> Selection {
        let nanos = |secs: u64| Some(secs * 1_000_000_000);
        Selection { from_nanos: nanos(from_secs), to_nanos: nanos(to_secs), grasps: None }
    }

    /// A sample as text that shows every bit, whether it is a frame, and which one.
    type Sent = (String, bool, SampleId);

    /// All that goes out.
    fn play(player: &mut Player<TactileFrame>) -> Result<Vec<Sent>, PlaybackError> {
        let mut found = Vec::new();
        loop {
            player.advance()?;
            found.push(match player.current() {
                Playing::Frame { head, items, n_before } => {
                    (format!("{n_before} {head:?} {items:?}"), true, sample_id(&head.header))
                }
                Playing::Truth { head, items } => (format!("{head:?} {items:?}"), false, sample_id(&head.header)),
                Playing::Nothing => continue,
                Playing::End => return Ok(found),
            });
        }
    }

    fn open(program: &Program, (max_checked_bytes, max_kept_bytes): (u64, usize)) -> Player<TactileFrame> {
        Player::open_with(program.clone(), max_checked_bytes, max_kept_bytes).expect("opened")
    }

    #[test]
    fn repetitions_from_memory_are_those_from_the_file() {
        let path = recording(|writer| write(writer, 4, 2));
        let grasps = Selection { grasps: Some("0,2-3".parse().expect("grasps")), ..Selection::default() };
        for (selection, n_samples) in [(Selection::default(), 15), (grasps, 12), (from_to(3, 9), 7)] {
            let program = program(&path, selection, 3);
            let found = WAYS.map(|way| play(&mut open(&program, way)).expect("played"));
            assert_eq!(found[0].len(), 3 * n_samples);
            assert_eq!((&found[1], &found[2]), (&found[0], &found[0]));
        }
        // The samples that go out, in one case in full.
        let mut player = open(&program(&path, from_to(9, 100), 2), WAYS[0]);
        assert_eq!((player.max_items(), player.hand_id()), (6, HAND_ID));
        let mut seqs = Vec::new();
        loop {
            player.advance().expect("played");
            match player.current() {
                Playing::Frame { head, items, n_before } => {
                    assert_eq!((head.header.hand_id, n_before, items.len()), (HAND_ID, seqs.len() as u64, 6));
                    seqs.push((head.header.seq, head.header.stamp_nanos / 1_000_000_000, head.grasp_id));
                }
                Playing::Truth { items, .. } => assert_eq!(items, b"object 3"),
                Playing::Nothing => {}
                Playing::End => break,
            }
        }
        assert_eq!(seqs, [(0, 9, 3), (1, 10, 3), (2, 11, 3), (3, 12, 7), (4, 13, 7), (5, 14, 7)]);
    }

    #[test]
    fn a_player_that_comes_back_goes_on_in_the_middle_of_a_repetition() {
        for n_in_epoch in [u64::MAX, 2] {
            let path = recording(|writer| write_in_epochs(writer, 4, 2, n_in_epoch));
            let program = program(&path, Selection::default(), 3);
            let whole = play(&mut open(&program, WAYS[0])).expect("played");
            for way in WAYS {
                for n_sent in 0..=whole.len() {
                    let (sent, rest) = whole.split_at(n_sent);
                    let last =
                        |of_frames| sent.iter().rfind(|(_, is_frame, _)| *is_frame == of_frames).map(|(.., id)| *id);
                    let mut player = open(&program, way);
                    assert!(player.resume(last(true), last(false), &mut || true).expect("resumed"));
                    assert_eq!(play(&mut player).expect("played"), rest, "after {n_sent} samples, {way:?}");
                }
            }
        }
    }

    /// The arbiter trusts a new epoch from its source's first sample on, which has the number 0.
    #[test]
    fn each_epoch_of_a_repetition_begins_as_that_of_the_first_round() {
        let path = recording(|writer| write_in_epochs(writer, 4, 2, 2));
        let played = play(&mut open(&program(&path, Selection::default(), 3), WAYS[0])).expect("played");
        let frames: Vec<SampleId> = played.iter().filter(|(_, is_frame, _)| *is_frame).map(|(.., id)| *id).collect();
        let firsts: Vec<&[SampleId]> = frames.chunk_by(|a, b| a.epoch == b.epoch).collect();
        assert!(firsts.len() == 6 && firsts.iter().all(|samples| samples[0].seq == 0), "{firsts:?}");
        let epochs: BTreeSet<u64> = frames.iter().map(|id| id.epoch).collect();
        assert_eq!(epochs.len(), 6, "none comes again");
    }

    #[test]
    fn topics_that_are_not_played_are_not_decoded() {
        let header = Header::default();
        let feature = GraspFeature { values: vec![0.0; MAX_FEATURES + 1], ..GraspFeature::default() };
        let path = recording(|writer| {
            writer.write("/feature", &Stamped { header, message: feature }).expect("written");
            writer.write("/tactile", &Stamped { header, message: TactileFrame::default() }).expect("written");
        });
        RecordingReader::open(&path).expect("opened").collect::<Result<Vec<_>, _>>().expect_err("too long");
        for way in WAYS {
            let program = program(&path, Selection::default(), 2);
            assert_eq!(play(&mut open(&program, way)).expect("played").len(), 2);
            // The played topic is decoded, before the first sample goes out if the recording is small.
            let opened = Player::<GraspFeature>::open_with(program, way.0, way.1);
            let outcome = opened.and_then(|mut player| (0..9).try_for_each(|_| player.advance()));
            assert!(outcome.expect_err("too long").to_string().contains("/feature, sample 0: values"));
        }
    }

    #[test]
    fn a_part_of_a_long_recording_is_played_without_reading_the_rest() {
        // 720 s in six chunks.
        let path = recording(|writer| write(writer, 240, 1_024));
        for (from_secs, to_secs) in [(300, 330), (0, 20), (1, 50), (601, 2_000), (450, 451)] {
            let program = program(&path, from_to(from_secs, to_secs), 2);
            let whole = play(&mut open(&program, WAYS[1])).expect("played");
            assert_eq!(play(&mut open(&program, WAYS[2])).expect("played"), whole, "{from_secs} s to {to_secs} s");
        }
        let bytes = std::fs::read(&path).expect("read");
        for (from_secs, tenths, is_read) in [(600, 3, false), (600, 8, true), (60, 1, true), (60, 7, false)] {
            let program = program(&path, from_to(from_secs, from_secs + 30), 2);
            std::fs::write(&path, &bytes).expect("written");
            let whole = play(&mut open(&program, WAYS[2])).expect("played");
            let mut damaged = bytes.clone();
            damaged[bytes.len() / 10 * tenths] ^= 1;
            std::fs::write(&path, damaged).expect("written");
            assert!(Player::<TactileFrame>::open(program.clone()).is_err(), "a small recording is checked");
            match play(&mut open(&program, WAYS[2])) {
                Ok(found) => assert!(!is_read && found == whole, "from {from_secs} s, damage after {tenths} tenths"),
                Err(error) => assert!(is_read, "from {from_secs} s, damage after {tenths} tenths: {error}"),
            }
        }
    }
}
