//! A recording played once or several times, from wherever its readers are.
//!
//! Samples keep their recorded numbers and times; each repetition continues the numbers, times and grasps of the one
//! before it. So a player that comes back after a crash finds its place by the number that its readers answered last.

use std::path::PathBuf;

use super::playback::{Next, Playback, PlaybackError};
use super::played::Played;
use super::selection::Selection;
use blindgrasp_messages::{GraspTruth, Header, Stamped};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::port::sample_id;
use blindgrasp_recording::RecordingReader;

/// A larger recording is not read through before its first sample goes out: that would take seconds.
const MAX_CHECKED_BYTES: u64 = 64 << 20;

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
pub enum Playing<M> {
    /// A sample to send. So many frames come before it, those included that its readers have.
    Frame {
        sample: Stamped<M>,
        n_before: u64,
    },
    Truth(Stamped<GraspTruth>),
    /// Nothing to send yet.
    Nothing,
    /// All repetitions are over.
    End,
}

/// Plays a recording's samples of one type, and its truths.
pub struct Player<M> {
    program: Program,
    hand_id: u64,
    /// `None` until the recording was read through.
    extent: Option<Extent>,
    /// The samples of the repetition that is under way; `None` between repetitions.
    playback: Option<Playback<M>>,
    repetition: u64,
    /// What the repetition under way has had so far.
    so_far: Extent,
    n_frames: u64,
    frames: Resume,
    truths: Resume,
}

impl<M: Played> Player<M> {
    /// Opens a recording. A small one is read through, so that damage is found before the first sample goes out.
    ///
    /// # Errors
    /// The recording cannot be played.
    pub fn open(program: Program) -> Result<Self, PlaybackError> {
        let hand_id = RecordingReader::open(&program.recording)?.info().hand_id;
        let mut player = Player {
            program,
            hand_id,
            extent: None,
            playback: None,
            repetition: 0,
            so_far: Extent::default(),
            n_frames: 0,
            frames: Resume { after: None },
            truths: Resume { after: None },
        };
        let is_small = std::fs::metadata(&player.program.recording).is_ok_and(|file| file.len() <= MAX_CHECKED_BYTES);
        if is_small {
            player.extent = player.read_through(&mut || true)?;
        }
        Ok(player)
    }

    /// The hand of the recording; 0 if the recording does not say.
    pub fn hand_id(&self) -> u64 {
        self.hand_id
    }

    /// The most items that a frame has.
    pub fn max_items(&self) -> usize {
        self.extent.as_ref().map_or(M::MAX_ITEMS, |extent| extent.max_items)
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
        self.playback = None;
        if self.program.n_repetitions > 1 && self.extent.is_none() && frame.is_some() {
            // The readers can be in any repetition.
            self.extent = self.read_through(go_on)?;
            if self.extent.is_none() {
                return Ok(false);
            }
        }
        let n_frames = self.extent.as_ref().map_or(0, |extent| extent.n_frames);
        self.repetition = self.extent.as_ref().map_or(0, |extent| match extent.n_truth_numbers {
            0 => self.frames.repetition(extent.n_frame_numbers),
            n => self.frames.repetition(extent.n_frame_numbers).min(self.truths.repetition(n)),
        });
        self.n_frames = self.repetition.saturating_mul(n_frames);
        Ok(true)
    }

    /// What comes next.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn advance(&mut self) -> Result<Playing<M>, PlaybackError> {
        if self.playback.is_none() {
            if self.repetition >= self.program.n_repetitions {
                return Ok(Playing::End);
            }
            self.playback = Some(self.program.open()?);
            self.so_far = Extent::default();
        }
        Ok(match self.playback.as_mut().and_then(Iterator::next).transpose()? {
            Some(Next::Frame(frame)) => self.frame(frame),
            Some(Next::Truth(truth)) => self.truth(truth),
            Some(Next::Nothing) => Playing::Nothing,
            None => {
                self.playback = None;
                self.repetition += 1;
                self.extent.get_or_insert(std::mem::take(&mut self.so_far));
                Playing::Nothing
            }
        })
    }

    fn frame(&mut self, frame: Stamped<M>) -> Playing<M> {
        self.so_far.add_frame(&frame);
        let header = self.shifted(frame.header, |extent| extent.n_frame_numbers);
        let n_before = self.n_frames;
        self.n_frames += 1;
        if self.frames.has(&header) {
            return Playing::Nothing;
        }
        let grasp_id = self.shifted_grasp_id(frame.message.grasp_id());
        Playing::Frame { sample: Stamped { header, message: frame.message.with_grasp_id(grasp_id) }, n_before }
    }

    fn truth(&mut self, truth: Stamped<GraspTruth>) -> Playing<M> {
        self.so_far.add_truth(&truth);
        let header = self.shifted(truth.header, |extent| extent.n_truth_numbers);
        if self.truths.has(&header) {
            return Playing::Nothing;
        }
        let grasp_id = self.shifted_grasp_id(truth.message.grasp_id);
        Playing::Truth(Stamped { header, message: GraspTruth { grasp_id, ..truth.message } })
    }

    /// The header as it goes out in this repetition.
    fn shifted(&self, recorded: Header, n_numbers: impl Fn(&Extent) -> u64) -> Header {
        let (n_numbers, duration_nanos) =
            self.extent.as_ref().map_or((0, 0), |extent| (n_numbers(extent), extent.duration_nanos()));
        Header {
            seq: recorded.seq.saturating_add(self.repetition.saturating_mul(n_numbers)),
            stamp_nanos: recorded.stamp_nanos.saturating_add(self.repetition.saturating_mul(duration_nanos)),
            hand_id: if recorded.hand_id == 0 { self.hand_id } else { recorded.hand_id },
            ..recorded
        }
    }

    fn shifted_grasp_id(&self, recorded: u64) -> u64 {
        let n_grasp_ids = self.extent.as_ref().map_or(0, |extent| extent.n_grasp_ids);
        recorded.saturating_add(self.repetition.saturating_mul(n_grasp_ids))
    }

    /// The extent of the recording; `None` if `go_on` ended the reading.
    fn read_through(&self, go_on: &mut dyn FnMut() -> bool) -> Result<Option<Extent>, PlaybackError> {
        let mut extent = Extent::default();
        for next in self.program.open::<M>()? {
            match next? {
                Next::Frame(frame) => extent.add_frame(&frame),
                Next::Truth(truth) => extent.add_truth(&truth),
                Next::Nothing => {}
            }
            if !go_on() {
                return Ok(None);
            }
        }
        Ok(Some(extent))
    }
}

impl Program {
    fn open<M: Played>(&self) -> Result<Playback<M>, PlaybackError> {
        Playback::open(&self.recording, &self.selection, self.topic.as_deref())
    }
}

/// The sample after which to go on.
struct Resume {
    after: Option<SampleId>,
}

impl Resume {
    /// The repetition of that sample.
    fn repetition(&self, n_numbers: u64) -> u64 {
        self.after.map_or(0, |key| key.seq / n_numbers.max(1))
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
    /// The items of its largest frame.
    max_items: usize,
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
    fn add_frame<M: Played>(&mut self, frame: &Stamped<M>) {
        let Header { seq, stamp_nanos, .. } = frame.header;
        self.n_frames += 1;
        self.max_items = self.max_items.max(frame.message.to_parts(frame.header).1.len());
        self.n_frame_numbers = self.n_frame_numbers.max(seq.saturating_add(1));
        self.n_grasp_ids = self.n_grasp_ids.max(frame.message.grasp_id().saturating_add(1));
        let (first, last, step) = self.stamps.unwrap_or((stamp_nanos, stamp_nanos, 0));
        self.stamps = Some((first, stamp_nanos, if step == 0 { stamp_nanos.saturating_sub(last) } else { step }));
    }

    fn add_truth(&mut self, truth: &Stamped<GraspTruth>) {
        self.n_truth_numbers = self.n_truth_numbers.max(truth.header.seq.saturating_add(1));
        self.n_grasp_ids = self.n_grasp_ids.max(truth.message.grasp_id.saturating_add(1));
    }

    /// From the first frame to the time at which the first frame of the next repetition is due.
    fn duration_nanos(&self) -> u64 {
        self.stamps.map_or(0, |(first, last, step)| last.saturating_sub(first) + step)
    }
}
