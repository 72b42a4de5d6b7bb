//! The samples of a recording in playing order.

use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use super::played::Played;
use super::selection::{Selection, Selector};
use blindgrasp_messages::{GraspTruth, Recorded, Stamped};
use blindgrasp_recording::{ChosenSamples, RawSample, Reach, Record, RecordingError, RecordingInfo};

/// Labels and late frames of a grasp are recorded within this time of it.
const LATE_NANOS: u64 = 60_000_000_000;

#[derive(Debug, thiserror::Error)]
pub enum PlaybackError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The recording does not fit its metadata, or the caller's selection.
    #[error("recording {}: {message}", path.display())]
    Unfit { path: PathBuf, message: String },
}

#[derive(Debug, Clone)]
pub enum Next {
    /// A frame with its number in the stream that goes out; [`Playback::decode`] decodes it.
    Frame(RawSample),
    Truth(Stamped<GraspTruth>),
    Nothing,
}

/// The selected samples of one type in a recording, and its labels, in order and with the numbers of the stream that goes
/// out. It reads while it iterates, and ends with an error if no sample was selected. Only labels are decoded.
///
/// With [`Reach::ByIndex`] it skips chunks that were recorded long before or after the selected time.
pub struct Playback<M> {
    path: PathBuf,
    samples: ChosenSamples,
    reach: Reach,
    info: RecordingInfo,
    selection: Selection,
    selector: Selector,
    topic: Option<String>,
    /// A sample that waits for the labels of its grasp to go first.
    held: Option<RawSample>,
    n_selected: u64,
    seen: Option<Seen>,
    has_ended: bool,
    message: PhantomData<M>,
}

/// The range of the samples of this type, selected or not.
#[derive(Debug, Clone, Copy)]
struct Seen {
    first_stamp_nanos: u64,
    last_stamp_nanos: u64,
    least_grasp_id: u64,
    greatest_grasp_id: u64,
}

impl<M: Played> Playback<M> {
    /// Opens a recording. `topic` chooses among several topics of this type.
    ///
    /// # Errors
    /// The recording cannot be opened.
    pub fn open(path: &Path, selection: &Selection, topic: Option<&str>, reach: Reach) -> Result<Self, PlaybackError> {
        let given = topic.map(str::to_owned);
        let choice = move |topic: &str, schema: &str| match schema {
            GraspTruth::SCHEMA => is_of_same_node(topic, given.as_deref()),
            schema => schema == M::SCHEMA && given.as_ref().is_none_or(|given| given == topic),
        };
        let samples = ChosenSamples::open(path, Box::new(choice), reach)?;
        Ok(Playback {
            path: path.into(),
            info: samples.info().clone(),
            samples,
            reach,
            selection: selection.clone(),
            selector: Selector::new(selection.clone()),
            topic: topic.map(str::to_owned),
            held: None,
            n_selected: 0,
            seen: None,
            has_ended: false,
            message: PhantomData,
        })
    }

    pub fn info(&self) -> &RecordingInfo {
        &self.info
    }

    /// Decodes a frame of this recording.
    ///
    /// # Errors
    /// It is no message of its type.
    pub fn decode(&self, frame: &RawSample) -> Result<Stamped<M>, PlaybackError> {
        let sample = M::of_record(self.samples.decode(frame)?);
        let sample = sample.ok_or_else(|| self.unfit(format!("{} holds no {}", frame.topic, M::TYPE_NAME)))?;
        Ok(Stamped { header: frame.header, ..sample })
    }

    fn advance(&mut self) -> Result<Option<Next>, PlaybackError> {
        if let Some(truth) = self.selector.next_truth().map_err(|error| self.unfit(error.to_string()))? {
            return Ok(Some(Next::Truth(truth)));
        }
        if let Some(frame) = self.held.take() {
            return Ok(Some(Next::Frame(frame)));
        }
        let Some(sample) = self.samples.advance()? else {
            return if self.n_selected > 0 { Ok(None) } else { Err(self.nothing()) };
        };
        if sample.schema == M::SCHEMA {
            let is_past = self.take(sample)?;
            return Ok((!is_past).then_some(Next::Nothing));
        }
        // In a graph with several sources, each has labels of its own.
        if is_of_same_node(&sample.topic, self.topic.as_deref())
            && let Record::Truth(truth) = self.samples.decode(&sample)?
        {
            self.selector.truth(truth);
        }
        Ok(Some(Next::Nothing))
    }

    /// Takes the next frame, and returns whether no later one is selected.
    fn take(&mut self, mut sample: RawSample) -> Result<bool, PlaybackError> {
        match &self.topic {
            None => self.topic = Some(sample.topic.clone()),
            Some(expected) if *expected == sample.topic => {}
            Some(other) => {
                let topic = &sample.topic;
                let what = format!("both {other} and {topic} are of type {}: choose one (param topic)", M::TYPE_NAME);
                return Err(self.unfit(what));
            }
        }
        let (header, grasp_id) = (sample.header, sample.grasp_id);
        if header.hand_id != 0 && self.info.hand_id != 0 && header.hand_id != self.info.hand_id {
            return Err(self.unfit(format!(
                "sample {} is of the hand {:016x}, the recording says {:016x} ({})",
                header.seq, header.hand_id, self.info.hand_id, self.info.hand
            )));
        }
        if let (None, Some(from)) = (self.seen, self.selection.from_nanos) {
            self.samples.skip_to(header.stamp_nanos.saturating_add(from).saturating_sub(LATE_NANOS));
        }
        let seen = self.seen.get_or_insert(Seen {
            first_stamp_nanos: header.stamp_nanos,
            last_stamp_nanos: header.stamp_nanos,
            least_grasp_id: grasp_id,
            greatest_grasp_id: grasp_id,
        });
        seen.last_stamp_nanos = seen.last_stamp_nanos.max(header.stamp_nanos);
        seen.least_grasp_id = seen.least_grasp_id.min(grasp_id);
        seen.greatest_grasp_id = seen.greatest_grasp_id.max(grasp_id);
        let since_first_nanos = header.stamp_nanos.saturating_sub(seen.first_stamp_nanos);
        if let Some(seq) = self.selector.frame(&header, grasp_id).map_err(|error| self.unfit(error.to_string()))? {
            self.n_selected += 1;
            sample.header.seq = seq;
            self.held = Some(sample);
            return Ok(false);
        }
        let is_long_past = |to: u64| since_first_nanos >= to.saturating_add(LATE_NANOS);
        let is_past = self.selection.to_nanos.is_some_and(is_long_past);
        Ok(is_past && self.reach == Reach::ByIndex && self.n_selected > 0)
    }

    fn nothing(&self) -> PlaybackError {
        self.unfit(match (&self.seen, &self.topic) {
            (Some(seen), _) => format!(
                "nothing is selected: no grasp {}; it has the grasps {} to {}, within {:.3} s",
                self.selection,
                seen.least_grasp_id,
                seen.greatest_grasp_id,
                (seen.last_stamp_nanos - seen.first_stamp_nanos) as f64 / 1e9
            ),
            (None, Some(topic)) => format!("it holds no {topic} to replay"),
            (None, None) => format!("it holds no {} to replay", M::TOPIC),
        })
    }

    fn unfit(&self, message: String) -> PlaybackError {
        PlaybackError::Unfit { path: self.path.clone(), message }
    }
}

impl<M: Played> Iterator for Playback<M> {
    type Item = Result<Next, PlaybackError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.has_ended {
            return None;
        }
        let next = self.advance().transpose();
        self.has_ended = !matches!(next, Some(Ok(_)));
        next
    }
}

/// Whether labels are of the node whose samples are played, as the topics say.
fn is_of_same_node(truth_topic: &str, played_topic: Option<&str>) -> bool {
    let of_truth = node_in(truth_topic);
    of_truth.is_empty() || played_topic.is_none_or(|topic| node_in(topic) == of_truth)
}

/// The part of a topic before its last `/`.
fn node_in(topic: &str) -> &str {
    topic.rfind('/').map_or("", |at| &topic[..at])
}
