//! Two recordings of one graph, edge by edge: what was recorded, and what a replay found.
//!
//! Samples are compared bit by bit, floats too, unless a tolerance is given; of the header, all that is not of this
//! machine. What is missing, comes in addition or in another order is a difference. Memory does not grow with the
//! recordings.

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::fields::{FieldError, Leaf, fields};
use super::played::played;
use blindgrasp_messages::{Header, Recorded};
use blindgrasp_recording::{Record, RecordingError, RecordingReader};

/// How far apart a sample may be in both recordings to count as re-ordered.
const WINDOW: usize = 512;
const FORMAT: bincode::config::Configuration = bincode::config::standard();

/// How much a float may differ.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// By this much.
    pub absolute: f64,
    /// Or by this share of the recorded value, both together.
    pub relative: f64,
}

/// An edge in both recordings.
#[derive(Debug, Clone, PartialEq)]
pub struct ComparedEdge {
    /// Its topic in the recording.
    pub recorded_topic: String,
    /// Its topic in the replay.
    pub found_topic: String,
    /// How much its floats may differ.
    pub tolerance: Tolerance,
    /// Whether the replay plays it, rather than that a stage makes it.
    pub is_played: bool,
}

/// What a recording covers, and what the replay of it can therefore not tell.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// The recording's first source sample: its epoch's numbers are shifted so that it is 0.
    first: Header,
    first_grasp_id: u64,
    last_grasp_id: u64,
    hand_id: u64,
    /// Whether it begins amid the stream.
    pub is_attached: bool,
    /// Whether it ends amid the stream, on all edges that bear the source's numbers with the same sample.
    pub is_detached: bool,
    /// Whether it ends anywhere on each edge: the recorder was killed, or the disk was full.
    pub is_cut_off: bool,
}

/// How an edge's samples differ.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct EdgeComparison {
    /// The topic in the recording.
    pub topic: String,
    /// Samples in the recording.
    pub n_recorded: u64,
    /// Samples in the replay.
    pub n_found: u64,
    /// Samples that differ, are missing, come in addition or in another order.
    pub n_differing: u64,
    /// Grasps with such samples.
    pub n_grasps: usize,
    /// The first of them.
    pub first: Option<Difference>,
    /// Samples that were not compared, because the recording does not cover what they follow from.
    pub n_not_compared: u64,
}

/// A difference between recording and replay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The grasp.
    pub grasp_id: u64,
    /// The sample, by its recorded number.
    pub seq: u64,
    /// What is different.
    #[serde(flatten)]
    pub what: What,
}

/// What is different.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub enum What {
    /// It is only in the recording.
    Missing,
    /// It is only in the replay.
    Extra,
    /// It comes at another place.
    Reordered,
    /// A value.
    Field {
        /// Where it stands, like `contacts[2].position_m[0]`.
        path: String,
        /// The recorded value, as text; nothing where a list is longer in the replay.
        expected: Option<String>,
        /// The value in the replay; nothing where a list is shorter there.
        found: Option<String>,
        /// Found less expected, of numbers, as text.
        difference: Option<String>,
    },
}

/// Why two recordings cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// One cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A message cannot be taken apart.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// A message cannot be encoded.
    #[error("a message cannot be encoded: {0}")]
    Encode(#[from] bincode::error::EncodeError),
    /// The recording has none of what was played.
    #[error("recording {path}: it holds no {topic}")]
    NoSource {
        /// The recording.
        path: String,
        /// The topic.
        topic: String,
    },
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "grasp {}, seq {}: ", self.grasp_id, self.seq)?;
        match &self.what {
            What::Missing => f.write_str("missing in the replay"),
            What::Extra => f.write_str("not in the recording"),
            What::Reordered => f.write_str("in another place than recorded"),
            What::Field { path, expected, found, difference } => {
                let shown = |value: &Option<String>| value.clone().unwrap_or_else(|| "nothing".into());
                write!(f, "{path}: expected {}, found {}", shown(expected), shown(found))?;
                difference.as_ref().map_or(Ok(()), |difference| write!(f, ", difference {difference}"))
            }
        }
    }
}

impl Coverage {
    /// Reads through what was played.
    ///
    /// # Errors
    /// The recording cannot be read, or has none of it.
    pub fn of(recording: &Path, source_topic: &str) -> Result<Coverage, CompareError> {
        let reader = RecordingReader::open(recording)?;
        let says = |name: &str, key: &str| reader.metadata(name).and_then(|metadata| metadata.get(key)).cloned();
        let is_attached = says("graph", "began").as_deref() == Some("attached");
        let ended = says("end", "ended");
        let is_detached = ended.as_deref() == Some("detached");
        // Of a recorder that was killed there is no word; what was on its way then is on some edges and not on others.
        let is_live = reader.metadata("graph").is_some();
        let is_cut_off =
            reader.metadata("repair").is_some() || (is_live && !is_detached && ended.as_deref() != Some("graph"));
        let hand_id = reader.info().hand_id;
        let mut ends: Option<(Header, u64, u64)> = None;
        for record in reader {
            let (topic, record) = record?;
            if topic == source_topic
                && let Some((grasp_id, _)) = played(&record)
            {
                let (header, first, _) = ends.unwrap_or((*record.header(), grasp_id, grasp_id));
                ends = Some((header, first, grasp_id));
            }
        }
        let no_source =
            || CompareError::NoSource { path: recording.display().to_string(), topic: source_topic.to_string() };
        let (first, first_grasp_id, last_grasp_id) = ends.ok_or_else(no_source)?;
        let is_attached = is_attached || first.seq != 0;
        Ok(Coverage { first, first_grasp_id, last_grasp_id, hand_id, is_attached, is_detached, is_cut_off })
    }

    /// The number in the recording of a sample of the replay.
    pub fn recorded_seq(&self, found: &Header) -> u64 {
        if found.epoch == self.first.epoch { found.seq.saturating_add(self.first.seq) } else { found.seq }
    }

    /// The number in the replay of a sample of the recording; `None` if it comes before what was played.
    fn found_seq(&self, recorded: &Header) -> Option<u64> {
        if recorded.epoch == self.first.epoch { recorded.seq.checked_sub(self.first.seq) } else { Some(recorded.seq) }
    }
}

/// Compares an edge of a recording, which has what was played, with that of a replay of it.
///
/// # Errors
/// One of them cannot be read.
pub fn compare_edge(
    recording: &Path,
    replay: &Path,
    edge: &ComparedEdge,
    coverage: &Coverage,
) -> Result<EdgeComparison, CompareError> {
    let comparison = EdgeComparison { topic: edge.recorded_topic.clone(), ..EdgeComparison::default() };
    let mut sides = Sides {
        recorded: Side::open(recording, &edge.recorded_topic)?,
        found: Side::open(replay, &edge.found_topic)?,
        tolerance: edge.tolerance,
        coverage,
        is_played: edge.is_played,
        grasp_ids: BTreeSet::new(),
        comparison,
    };
    sides.compare()?;
    Ok(EdgeComparison { n_grasps: sides.grasp_ids.len(), ..sides.comparison })
}

/// The next samples of an edge in one of the recordings.
struct Side {
    reader: RecordingReader,
    topic: String,
    window: VecDeque<Sample>,
    /// The first sample of an edge that counts for itself: decisions, truths.
    first_own: Option<Header>,
}

struct Sample {
    /// With the number that it has in the replay.
    header: Header,
    record: Record,
    grasp_id: u64,
}

struct Sides<'a> {
    recorded: Side,
    found: Side,
    tolerance: Tolerance,
    coverage: &'a Coverage,
    /// Whether the edge is the recording's own: what was played, and what it knows of the grasps.
    is_played: bool,
    grasp_ids: BTreeSet<u64>,
    comparison: EdgeComparison,
}

impl Side {
    fn open(path: &Path, topic: &str) -> Result<Side, RecordingError> {
        Ok(Side { reader: RecordingReader::open(path)?, topic: topic.into(), window: VecDeque::new(), first_own: None })
    }

    /// The edge's next record.
    fn read(&mut self) -> Result<Option<Record>, RecordingError> {
        for record in self.reader.by_ref() {
            let (topic, record) = record?;
            if topic == self.topic {
                return Ok(Some(record));
            }
        }
        Ok(None)
    }

    /// The number of a sample that counts for itself, from the first one on.
    fn since_first(&mut self, header: &Header) -> Option<u64> {
        let first = *self.first_own.get_or_insert(*header);
        if header.epoch == first.epoch { header.seq.checked_sub(first.seq) } else { Some(header.seq) }
    }

    fn position(&self, sample: &Sample) -> Option<usize> {
        self.window.iter().position(|other| other.is_named_as(sample))
    }
}

impl Sample {
    fn is_named_as(&self, other: &Sample) -> bool {
        (self.header.epoch, self.header.seq) == (other.header.epoch, other.header.seq)
    }
}

impl Sides<'_> {
    fn compare(&mut self) -> Result<(), CompareError> {
        loop {
            self.fill()?;
            let (Some(recorded), Some(found)) = (self.recorded.window.front(), self.found.window.front()) else {
                break;
            };
            if recorded.is_named_as(found) {
                self.compare_at(0, 0)?;
                continue;
            }
            match (self.found.position(recorded), self.recorded.position(found)) {
                // Both are there, at other places.
                (Some(found_idx), Some(_)) => {
                    let (grasp_id, seq) = (recorded.grasp_id, recorded.record.header().seq);
                    self.add(grasp_id, seq, What::Reordered);
                    // Its content has been said to differ already, by its place.
                    self.recorded.window.pop_front();
                    self.found.window.remove(found_idx);
                }
                (Some(_), None) => self.pop_found(),
                (None, Some(_)) => self.pop_recorded(),
                (None, None) => {
                    self.pop_recorded();
                    self.pop_found();
                }
            }
        }
        while !self.recorded.window.is_empty() {
            self.pop_recorded();
            self.fill()?;
        }
        while let Some(sample) = self.found.window.front() {
            let is_said_once = sample.record.is_said_once();
            // Of what came after the end of the recording, or follows from that, nobody knows.
            let is_of_the_end = is_said_once && sample.grasp_id == self.coverage.last_grasp_id;
            if self.coverage.is_cut_off || (self.coverage.is_detached && is_of_the_end) {
                self.comparison.n_not_compared += 1;
                self.found.window.pop_front();
            } else {
                self.pop_found();
            }
            self.fill()?;
        }
        Ok(())
    }

    /// Reads on, as far as the windows go.
    fn fill(&mut self) -> Result<(), CompareError> {
        while self.recorded.window.len() < WINDOW
            && let Some(record) = self.recorded.read()?
        {
            let grasp_id = grasp_id(&record);
            if self.is_uncovered(&record, grasp_id) {
                self.comparison.n_not_compared += 1;
                continue;
            }
            let mut header = *record.header();
            let seq = match record {
                Record::Truth(_) | Record::Outcome(_) => self.recorded.since_first(&header),
                // They were numbered before the recording began: there is one for each grasp.
                _ if record.is_said_once() && self.coverage.is_attached => Some(grasp_id),
                _ if record.is_said_once() => Some(header.seq),
                _ => self.coverage.found_seq(&header),
            };
            let Some(seq) = seq else {
                self.comparison.n_not_compared += 1;
                continue;
            };
            header.seq = seq;
            if header.hand_id == 0 && self.is_played {
                // The player knows it from what the recording says of itself.
                header.hand_id = self.coverage.hand_id;
            }
            self.comparison.n_recorded += 1;
            self.recorded.window.push_back(Sample { header, record, grasp_id });
        }
        while self.found.window.len() < WINDOW
            && let Some(record) = self.found.read()?
        {
            let grasp_id = grasp_id(&record);
            if self.is_uncovered(&record, grasp_id) {
                self.comparison.n_not_compared += 1;
                continue;
            }
            let mut header = *record.header();
            if self.coverage.is_attached && record.is_said_once() {
                header.seq = grasp_id;
            }
            self.comparison.n_found += 1;
            self.found.window.push_back(Sample { header, record, grasp_id });
        }
        Ok(())
    }

    /// Of the grasp amid which the recording begins, decision and advice follow from what was not recorded.
    fn is_uncovered(&self, record: &Record, grasp_id: u64) -> bool {
        self.coverage.is_attached && record.is_said_once() && grasp_id == self.coverage.first_grasp_id
    }

    fn compare_at(&mut self, recorded_idx: usize, found_idx: usize) -> Result<(), CompareError> {
        let (Some(recorded), Some(found)) =
            (self.recorded.window.remove(recorded_idx), self.found.window.remove(found_idx))
        else {
            return Ok(());
        };
        if let Some(what) = first_difference(&recorded, &found, self.tolerance)? {
            self.add(recorded.grasp_id, recorded.record.header().seq, what);
        }
        Ok(())
    }

    fn pop_recorded(&mut self) {
        if let Some(sample) = self.recorded.window.pop_front() {
            self.add(sample.grasp_id, sample.record.header().seq, What::Missing);
        }
    }

    fn pop_found(&mut self) {
        if let Some(sample) = self.found.window.pop_front() {
            let seq = match sample.record {
                Record::Decision(_) | Record::Truth(_) | Record::Outcome(_) | Record::Advice(_) => {
                    sample.record.header().seq
                }
                _ => self.coverage.recorded_seq(&sample.header),
            };
            self.add(sample.grasp_id, seq, What::Extra);
        }
    }

    fn add(&mut self, grasp_id: u64, seq: u64, what: What) {
        self.comparison.n_differing += 1;
        self.grasp_ids.insert(grasp_id);
        self.comparison.first.get_or_insert(Difference { grasp_id, seq, what });
    }
}

fn first_difference(recorded: &Sample, found: &Sample, tolerance: Tolerance) -> Result<Option<What>, CompareError> {
    let header = |name: &str, expected: String, found: String| {
        let (path, difference) = (format!("header.{name}"), None);
        Some(What::Field { path, expected: Some(expected), found: Some(found), difference })
    };
    let (was, is) = (&recorded.header, &found.header);
    if was.stamp_nanos != is.stamp_nanos {
        return Ok(header("stamp_nanos", was.stamp_nanos.to_string(), is.stamp_nanos.to_string()));
    }
    if was.hand_id != is.hand_id {
        return Ok(header("hand_id", format!("{:016x}", was.hand_id), format!("{:016x}", is.hand_id)));
    }
    if encoded(&recorded.record)? == encoded(&found.record)? {
        return Ok(None);
    }
    let (was, is) = (fields(&recorded.record)?, fields(&found.record)?);
    let found_at: HashMap<&str, &Leaf> = is.iter().map(|(path, leaf)| (path.as_str(), leaf)).collect();
    for (path, expected) in &was {
        match found_at.get(path.as_str()) {
            Some(found) if are_equal(expected, found, tolerance) => {}
            found => return Ok(Some(different(path, Some(expected), found.copied()))),
        }
    }
    // What is only in the replay: a list is longer there.
    let expected_at: HashSet<&str> = was.iter().map(|(path, _)| path.as_str()).collect();
    let extra = is.iter().find(|(path, _)| !expected_at.contains(path.as_str()));
    Ok(extra.map(|(path, found)| different(path, None, Some(found))))
}

fn different(path: &str, expected: Option<&Leaf>, found: Option<&Leaf>) -> What {
    let difference = match (expected, found) {
        (Some(Leaf::Float(was)), Some(Leaf::Float(is))) => Some(format!("{:e}", is - was)),
        (Some(Leaf::Unsigned(was)), Some(Leaf::Unsigned(is))) => Some((i128::from(*is) - i128::from(*was)).to_string()),
        (Some(Leaf::Signed(was)), Some(Leaf::Signed(is))) => Some((i128::from(*is) - i128::from(*was)).to_string()),
        _ => None,
    };
    let text = |leaf: Option<&Leaf>| leaf.map(Leaf::to_string);
    What::Field { path: path.into(), expected: text(expected), found: text(found), difference }
}

fn are_equal(expected: &Leaf, found: &Leaf, tolerance: Tolerance) -> bool {
    match (expected, found) {
        (Leaf::Float(expected), Leaf::Float(found)) => {
            let allowed = tolerance.absolute + tolerance.relative * expected.abs();
            let is_near = allowed > 0.0 && allowed.is_finite() && (found - expected).abs() <= allowed;
            expected.to_bits() == found.to_bits() || is_near
        }
        _ => expected == found,
    }
}

/// The message, byte by byte: what is the same here is the same in every bit.
fn encoded(record: &Record) -> Result<Vec<u8>, CompareError> {
    fn encode<M: Recorded>(message: &M) -> Result<Vec<u8>, bincode::error::EncodeError> {
        bincode::serde::encode_to_vec(message, FORMAT)
    }
    Ok(match record {
        Record::Tactile(sample) => encode(&sample.message),
        Record::Contacts(sample) => encode(&sample.message),
        Record::Feature(sample) => encode(&sample.message),
        Record::Prediction(sample) => encode(&sample.message),
        Record::Decision(sample) => encode(&sample.message),
        Record::Truth(sample) => encode(&sample.message),
        Record::Outcome(sample) => encode(&sample.message),
        Record::Advice(sample) => encode(&sample.message),
        Record::Scene(sample) => encode(&sample.message),
    }?)
}

fn grasp_id(record: &Record) -> u64 {
    match record {
        Record::Decision(sample) => sample.message.grasp_id,
        Record::Truth(sample) => sample.message.grasp_id,
        Record::Outcome(sample) => sample.message.grasp_id,
        Record::Advice(sample) => sample.message.grasp_id,
        Record::Scene(sample) => sample.message.grasp_id,
        record => played(record).map_or(0, |(grasp_id, _)| grasp_id),
    }
}
