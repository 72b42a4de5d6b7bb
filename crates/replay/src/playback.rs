//! The samples of a recording in playing order.

use std::path::{Path, PathBuf};

use super::played::Played;
use super::selection::{Selection, SelectionError, Selector};
use blindgrasp_messages::{GraspTruth, Stamped};
use blindgrasp_recording::{Record, RecordingError, RecordingInfo, RecordingReader};

#[derive(Debug, thiserror::Error)]
pub enum PlaybackError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error("recording {}: {source}", path.display())]
    Selection { path: PathBuf, source: SelectionError },
    /// The recording does not fit its metadata, or the caller's selection.
    #[error("recording {}: {message}", path.display())]
    Unfit { path: PathBuf, message: String },
}

#[derive(Debug, Clone, PartialEq)]
pub enum Next<M> {
    Frame(Stamped<M>),
    Truth(Stamped<GraspTruth>),
    Nothing,
}

/// The selected samples of one type in a recording, and its labels, in order and with the numbers of the stream that goes
/// out. It reads while it iterates, and ends with an error if no sample was selected.
pub struct Playback<M> {
    path: PathBuf,
    reader: RecordingReader,
    info: RecordingInfo,
    selection: Selection,
    selector: Selector,
    topic: Option<String>,
    is_topic_given: bool,
    /// A sample that waits for the labels of its grasp to go first.
    held: Option<Stamped<M>>,
    n_selected: u64,
    seen: Option<Seen>,
    has_ended: bool,
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
    pub fn open(path: &Path, selection: &Selection, topic: Option<&str>) -> Result<Self, PlaybackError> {
        let reader = RecordingReader::open(path)?;
        Ok(Playback {
            path: path.into(),
            info: reader.info().clone(),
            reader,
            selection: selection.clone(),
            selector: Selector::new(selection.clone()),
            topic: topic.map(str::to_owned),
            is_topic_given: topic.is_some(),
            held: None,
            n_selected: 0,
            seen: None,
            has_ended: false,
        })
    }

    pub fn info(&self) -> &RecordingInfo {
        &self.info
    }

    fn advance(&mut self) -> Result<Option<Next<M>>, PlaybackError> {
        if let Some(truth) = self.selector.next_truth().map_err(|source| self.mixed(source))? {
            return Ok(Some(Next::Truth(truth)));
        }
        if let Some(frame) = self.held.take() {
            return Ok(Some(Next::Frame(frame)));
        }
        let Some(record) = self.reader.next() else {
            return if self.n_selected > 0 { Ok(None) } else { Err(self.nothing()) };
        };
        let (topic, record) = record?;
        match record {
            Record::Truth(truth) if self.is_of_same_node(&topic) => self.selector.truth(truth),
            record => {
                if let Some(sample) = M::of_record(record) {
                    self.take(topic, sample)?;
                }
            }
        }
        Ok(Some(Next::Nothing))
    }

    fn take(&mut self, topic: String, mut sample: Stamped<M>) -> Result<(), PlaybackError> {
        match &self.topic {
            None => self.topic = Some(topic),
            Some(expected) if *expected == topic => {}
            Some(_) if self.is_topic_given => return Ok(()),
            Some(other) => {
                let what = format!("both {other} and {topic} are of type {}: choose one (param topic)", M::TYPE_NAME);
                return Err(self.unfit(what));
            }
        }
        let (header, grasp_id) = (sample.header, sample.message.grasp_id());
        if header.hand_id != 0 && self.info.hand_id != 0 && header.hand_id != self.info.hand_id {
            return Err(self.unfit(format!(
                "sample {} is of the hand {:016x}, the recording says {:016x} ({})",
                header.seq, header.hand_id, self.info.hand_id, self.info.hand
            )));
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
        if let Some(seq) = self.selector.frame(&header, grasp_id).map_err(|source| self.mixed(source))? {
            self.n_selected += 1;
            sample.header.seq = seq;
            self.held = Some(sample);
        }
        Ok(())
    }

    /// In a graph with several sources, each has labels of its own.
    fn is_of_same_node(&self, truth_topic: &str) -> bool {
        let node = |topic: &str| topic.rfind('/').map_or(String::new(), |at| topic[..at].to_string());
        let of_truth = node(truth_topic);
        of_truth.is_empty() || self.topic.as_ref().is_none_or(|topic| node(topic) == of_truth)
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

    fn mixed(&self, source: SelectionError) -> PlaybackError {
        PlaybackError::Selection { path: self.path.clone(), source }
    }

    fn unfit(&self, message: String) -> PlaybackError {
        PlaybackError::Unfit { path: self.path.clone(), message }
    }
}

impl<M: Played> Iterator for Playback<M> {
    type Item = Result<Next<M>, PlaybackError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.has_ended {
            return None;
        }
        let next = self.advance().transpose();
        self.has_ended = !matches!(next, Some(Ok(_)));
        next
    }
}
