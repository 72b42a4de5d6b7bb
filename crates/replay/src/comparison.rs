//! The comparison of a recording with the recording of its replay, edge by edge.
//!
//! Samples are compared bit by bit, floats too, unless a tolerance is given; all NaN are equal. Times of this machine in
//! the header are not compared. Missing, additional and re-ordered samples are differences. Memory does not grow with the
//! recordings.

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::played::is_played;
use blindgrasp_graph::recorded_graph::GRAPH_METADATA;
use blindgrasp_messages::{Header, with_sample};
use blindgrasp_recording::cdr;
use blindgrasp_recording::{ChosenSamples, Reach, Record, RecordingError, RecordingReader};

/// A sample counts as re-ordered if it is at most so many samples away in the other recording.
const WINDOW: usize = 512;

/// The allowed difference of floats: `absolute + relative * |recorded value|`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    pub absolute: f64,
    pub relative: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ComparedEdge {
    pub recorded_topic: String,
    pub found_topic: String,
    pub tolerance: Tolerance,
    /// Whether the replay plays the edge from the recording, rather than a stage making it.
    pub is_played: bool,
}

/// The part of a run that a recording covers: samples that depend on the rest cannot be compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// The first source sample. The numbers of its epoch are shifted so that it is 0.
    first: Header,
    first_grasp_id: u64,
    last_grasp_id: u64,
    hand_id: u64,
    /// Whether the recording begins amid the stream.
    pub is_attached: bool,
    /// Whether the recording ends amid the stream. Edges with the source's numbers all end with the same sample.
    pub is_detached: bool,
    /// Whether each edge may end anywhere: the recorder was killed, or the disk was full.
    pub is_cut_off: bool,
}

/// The result of comparing an edge.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct EdgeComparison {
    pub topic: String,
    pub n_recorded: u64,
    pub n_found: u64,
    /// Samples that differ, are missing, additional or re-ordered.
    pub n_differing: u64,
    pub n_grasps: usize,
    /// The grasps with such samples.
    pub grasps: BTreeSet<u64>,
    /// The first difference.
    pub first: Option<Difference>,
    /// Samples that were not compared, because they depend on samples that were not recorded.
    pub n_not_compared: u64,
}

/// A difference between recording and replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    pub grasp_id: u64,
    /// The sample's recorded number.
    pub seq: u64,
    #[serde(flatten)]
    pub what: What,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub enum What {
    /// The sample is only in the recording.
    Missing,
    /// The sample is only in the replay.
    Extra,
    /// The sample is at another place.
    Reordered,
    Field {
        /// The path of the value, like `contacts[2].position_m[0]`.
        path: String,
        /// The recorded value; `None` if a list is longer in the replay.
        expected: Option<String>,
        /// The value in the replay; `None` if a list is shorter there.
        found: Option<String>,
        /// The difference `found - expected` of numbers.
        difference: Option<String>,
    },
}

#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error("a message cannot be encoded: {0}")]
    Encode(String),
    #[error("recording {path}: it holds no {topic}")]
    NoSource { path: String, topic: String },
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
                difference.as_ref().map_or(Ok(()), |difference| write!(f, ", difference {}", shortened(difference)))
            }
        }
    }
}

/// A difference of floats with as many digits as a person needs.
fn shortened(difference: &str) -> String {
    match difference.parse::<f64>() {
        Ok(value) if difference.contains('e') && (1e-3..1e6).contains(&value.abs()) => format!("{value:.4}"),
        Ok(value) if difference.contains('e') => format!("{value:.2e}"),
        _ => difference.into(),
    }
}

impl Coverage {
    /// Reads the played topic of a recording.
    ///
    /// # Errors
    /// The recording cannot be read, or has no such topic.
    pub fn of(recording: &Path, source_topic: &str) -> Result<Coverage, CompareError> {
        let reader = RecordingReader::open(recording)?;
        let says = |name: &str, key: &str| reader.metadata(name).and_then(|metadata| metadata.get(key)).cloned();
        let is_attached = says(GRAPH_METADATA, "began").as_deref() == Some("attached");
        let ended = says("end", "ended");
        let is_detached = ended.as_deref() == Some("detached");
        // A killed recorder leaves no `end`; its last samples are on some edges and not on others.
        let is_live = reader.metadata(GRAPH_METADATA).is_some();
        let is_cut_off =
            reader.metadata("repair").is_some() || (is_live && !is_detached && ended.as_deref() != Some("graph"));
        let hand_id = reader.info().hand_id;
        let mut ends: Option<(Header, u64, u64)> = None;
        for record in reader {
            let (topic, record) = record?;
            if topic == source_topic && is_played(&record) {
                let grasp_id = record.grasp_id();
                let (header, first, _) = ends.unwrap_or((*record.header(), grasp_id, grasp_id));
                ends = Some((header, first, grasp_id));
            }
        }
        let Some((first, first_grasp_id, last_grasp_id)) = ends else {
            return Err(CompareError::NoSource { path: recording.display().to_string(), topic: source_topic.into() });
        };
        let is_attached = is_attached || first.seq != 0;
        Ok(Coverage { first, first_grasp_id, last_grasp_id, hand_id, is_attached, is_detached, is_cut_off })
    }

    /// Whether the recording has all frames on which the decision about a grasp depends.
    pub fn covers_decision(&self, grasp_id: u64) -> bool {
        !(self.is_attached && grasp_id == self.first_grasp_id)
    }

    /// The samples that cannot be compared, for people.
    pub fn notes(&self) -> Vec<String> {
        let attached =
            "it was attached midway: its first two frames and the decision of its first grasp are not compared";
        let detached = "it was detached midway: a decision of its last grasp that it does not have is not compared";
        let cut_off = "it was cut off: what it does not have at the end of an edge is not compared";
        let notes = [(self.is_attached, attached), (self.is_detached, detached), (self.is_cut_off, cut_off)];
        notes.into_iter().filter(|(is_so, _)| *is_so).map(|(_, note)| note.to_string()).collect()
    }

    /// The recorded number of a sample of the replay.
    pub fn recorded_seq(&self, found: &Header) -> u64 {
        if found.epoch == self.first.epoch { found.seq.saturating_add(self.first.seq) } else { found.seq }
    }

    /// The number in the replay of a recorded sample; `None` if it comes before the first played sample.
    fn found_seq(&self, recorded: &Header) -> Option<u64> {
        since(&self.first, recorded)
    }
}

/// The number of a sample, counted from the first one; numbers of another epoch stay.
fn since(first: &Header, header: &Header) -> Option<u64> {
    if header.epoch == first.epoch { header.seq.checked_sub(first.seq) } else { Some(header.seq) }
}

/// Compares an edge of a recording with the same edge of its replay.
///
/// # Errors
/// One of the recordings cannot be read.
pub fn compare_edge(
    recording: &Path,
    replay: &Path,
    edge: &ComparedEdge,
    coverage: &Coverage,
) -> Result<EdgeComparison, CompareError> {
    let mut sides = Sides {
        recorded: Side::open(recording, &edge.recorded_topic)?,
        found: Side::open(replay, &edge.found_topic)?,
        edge,
        coverage,
        first_own: None,
        comparison: EdgeComparison { topic: edge.recorded_topic.clone(), ..EdgeComparison::default() },
    };
    sides.compare()?;
    sides.comparison.n_grasps = sides.comparison.grasps.len();
    Ok(sides.comparison)
}

/// The next samples of an edge in one of the recordings.
struct Side {
    samples: ChosenSamples,
    window: VecDeque<Sample>,
}

struct Sample {
    /// The header with the number of the replay.
    header: Header,
    record: Record,
}

struct Sides<'a> {
    recorded: Side,
    found: Side,
    edge: &'a ComparedEdge,
    coverage: &'a Coverage,
    /// The first recorded sample of an edge with numbers of its own, such as labels.
    first_own: Option<Header>,
    comparison: EdgeComparison,
}

impl Side {
    fn open(path: &Path, topic: &str) -> Result<Side, RecordingError> {
        let topic = topic.to_owned();
        let samples = ChosenSamples::open(path, Box::new(move |found, _| found == topic), Reach::Whole)?;
        Ok(Side { samples, window: VecDeque::new() })
    }

    /// The next sample, while the window has room.
    fn read(&mut self) -> Result<Option<Record>, RecordingError> {
        if self.window.len() >= WINDOW {
            return Ok(None);
        }
        let sample = self.samples.advance()?;
        sample.map(|sample| self.samples.decode(&sample)).transpose()
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
                let what = first_difference(recorded, found, self.edge.tolerance)?;
                if let (Some(recorded), Some(what)) = (self.recorded.window.pop_front(), what) {
                    self.add(&recorded.record, recorded.record.header().seq, what);
                }
                self.found.window.pop_front();
                continue;
            }
            match (self.found.position(recorded), self.recorded.position(found)) {
                // Both samples are in both recordings, at other places.
                (Some(found_idx), Some(_)) => {
                    // The place of the sample is a difference already: its values are not compared.
                    self.found.window.remove(found_idx);
                    self.pop_recorded(What::Reordered);
                }
                (Some(_), None) => self.pop_found(),
                (None, Some(_)) => self.pop_recorded(What::Missing),
                (None, None) => {
                    self.pop_recorded(What::Missing);
                    self.pop_found();
                }
            }
        }
        while !self.recorded.window.is_empty() {
            self.pop_recorded(What::Missing);
            self.fill()?;
        }
        while let Some(sample) = self.found.window.front() {
            // Samples after the end of the recording, or that depend on them, cannot be compared.
            let is_of_the_end = sample.record.is_said_once() && sample.record.grasp_id() == self.coverage.last_grasp_id;
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

    /// Fills both windows.
    fn fill(&mut self) -> Result<(), CompareError> {
        while let Some(record) = self.recorded.read()? {
            let Some(seq) = self.number_in_replay(&record) else {
                self.comparison.n_not_compared += 1;
                continue;
            };
            let mut header = Header { seq, ..*record.header() };
            if header.hand_id == 0 && self.edge.is_played {
                // The player takes the hand from the recording's metadata.
                header.hand_id = self.coverage.hand_id;
            }
            self.comparison.n_recorded += 1;
            self.recorded.window.push_back(Sample { header, record });
        }
        while let Some(record) = self.found.read()? {
            if self.is_uncovered(&record, record.header().seq) {
                continue;
            }
            let mut header = *record.header();
            if self.coverage.is_attached && record.is_said_once() {
                header.seq = record.grasp_id();
            }
            self.comparison.n_found += 1;
            self.found.window.push_back(Sample { header, record });
        }
        Ok(())
    }

    /// The number in the replay of a recorded sample; `None` if it cannot be compared.
    fn number_in_replay(&mut self, record: &Record) -> Option<u64> {
        let header = record.header();
        if self.is_uncovered(record, since(&self.coverage.first, header).unwrap_or(0)) {
            return None;
        }
        match record {
            Record::Truth(_) | Record::Outcome(_) => since(self.first_own.get_or_insert(*header), header),
            // Their numbers began before the recording; there is one for each grasp.
            _ if record.is_said_once() && self.coverage.is_attached => Some(record.grasp_id()),
            _ if record.is_said_once() => Some(header.seq),
            _ => self.coverage.found_seq(header),
        }
    }

    /// Whether the sample with this number of the replay depends on frames that were not recorded, as the decision about the grasp
    /// in which the recording begins does. The contacts of a frame depend on the two before it.
    fn is_uncovered(&self, record: &Record, seq: u64) -> bool {
        if record.is_said_once() {
            return !self.coverage.covers_decision(record.grasp_id());
        }
        let Coverage { first, is_attached, .. } = self.coverage;
        *is_attached && !self.edge.is_played && record.header().epoch == first.epoch && seq < 2
    }

    fn pop_recorded(&mut self, what: What) {
        if let Some(sample) = self.recorded.window.pop_front() {
            self.add(&sample.record, sample.record.header().seq, what);
        }
    }

    fn pop_found(&mut self) {
        if let Some(sample) = self.found.window.pop_front() {
            let seq = match sample.record {
                Record::Decision(_) | Record::Truth(_) | Record::Outcome(_) => sample.record.header().seq,
                _ => self.coverage.recorded_seq(&sample.header),
            };
            self.add(&sample.record, seq, What::Extra);
        }
    }

    fn add(&mut self, record: &Record, seq: u64, what: What) {
        let grasp_id = record.grasp_id();
        self.comparison.n_differing += 1;
        self.comparison.grasps.insert(grasp_id);
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
    let [recorded_data, found_data] = [encoded(&recorded.record)?, encoded(&found.record)?];
    if recorded_data == found_data {
        return Ok(None);
    }
    let (was, is) = (leaves(&recorded.record)?, leaves(&found.record)?);
    let found_at: HashMap<&str, &Value> = is.iter().map(|(path, leaf)| (path.as_str(), leaf)).collect();
    for (path, expected) in &was {
        match found_at.get(path.as_str()) {
            Some(found) if are_equal(expected, found, tolerance) => {}
            found => return Ok(Some(different(path, Some(expected), found.copied()))),
        }
    }
    // A list may be longer in the replay.
    let expected_at: HashSet<&str> = was.iter().map(|(path, _)| path.as_str()).collect();
    let extra = is.iter().find(|(path, _)| !expected_at.contains(path.as_str()));
    if let Some((path, found)) = extra {
        return Ok(Some(different(path, None, Some(found))));
    }
    // JSON has null for NaN and infinity. As all paths are the same, each float has the same place in both encodings.
    for (was, is) in floats(&recorded_data).zip(floats(&found_data)) {
        if was.is_finite() && is.is_finite() {
            continue;
        }
        let [expected, found] = [was, is].map(|float| Value::from(float.to_string()));
        if expected != found {
            return Ok(Some(different("a value that is not finite", Some(&expected), Some(&found))));
        }
    }
    Ok(None)
}

/// The 8 bytes at each place where CDR may have a float: at multiples of 8 behind the encapsulation.
fn floats(data: &[u8]) -> impl Iterator<Item = f64> {
    data[4..].as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes))
}

/// All numbers, flags and texts of a message as JSON has them, with their paths, like `contacts[2].position_m[0]`. A number
/// that is not finite is null.
fn leaves(record: &Record) -> Result<Vec<(String, Value)>, CompareError> {
    let message = record.to_json().map_err(|error| CompareError::Encode(error.to_string()))?;
    let mut found = Vec::new();
    add_leaves(String::new(), message, &mut found);
    Ok(found)
}

fn add_leaves(path: String, value: Value, found: &mut Vec<(String, Value)>) {
    match value {
        Value::Array(items) => {
            for (idx, item) in items.into_iter().enumerate() {
                add_leaves(format!("{path}[{idx}]"), item, found);
            }
        }
        Value::Object(fields) => {
            let before = if path.is_empty() { path } else { path + "." };
            for (name, value) in fields {
                add_leaves(format!("{before}{name}"), value, found);
            }
        }
        leaf => found.push((path, leaf)),
    }
}

fn different(path: &str, expected: Option<&Value>, found: Option<&Value>) -> What {
    let mut difference = None;
    if let (Some(Value::Number(was)), Some(Value::Number(is))) = (expected, found) {
        difference = match (was.as_i128(), is.as_i128()) {
            (Some(was), Some(is)) => Some((is - was).to_string()),
            _ => was.as_f64().zip(is.as_f64()).map(|(was, is)| format!("{:e}", is - was)),
        };
    }
    let text = |leaf: &Value| match leaf {
        Value::String(text) => text.clone(),
        Value::Null => "NaN or infinity".into(),
        leaf => leaf.to_string(),
    };
    What::Field { path: path.into(), expected: expected.map(text), found: found.map(text), difference }
}

fn are_equal(expected: &Value, found: &Value, tolerance: Tolerance) -> bool {
    if !expected.is_f64() || !found.is_f64() {
        return expected == found;
    }
    let (Some(expected), Some(found)) = (expected.as_f64(), found.as_f64()) else { return false };
    let allowed = tolerance.absolute + tolerance.relative * expected.abs();
    let is_near = allowed > 0.0 && allowed.is_finite() && (found - expected).abs() <= allowed;
    expected.to_bits() == found.to_bits() || is_near
}

/// The bytes of the message: messages with the same bytes are the same in every bit.
fn encoded(record: &Record) -> Result<Vec<u8>, CompareError> {
    let mut data = Vec::new();
    with_sample!(record, sample => cdr::encode(&sample.message, &mut data)).map_err(CompareError::Encode)?;
    Ok(data)
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Contact, ContactSet, Fault, Phase, Stamped};

    use super::*;

    fn sample(change: impl FnOnce(&mut ContactSet)) -> Sample {
        let contacts = vec![Contact::default(); 2];
        let mut message = ContactSet { grasp_id: 7, phase: Phase::Settled, contacts, ..ContactSet::default() };
        change(&mut message);
        let header = Header::default();
        Sample { header, record: Record::Contacts(Stamped { header, message }) }
    }

    /// The first difference of a changed sample, as it is shown.
    fn shown(change: impl FnOnce(&mut ContactSet), tolerance: Tolerance) -> Option<String> {
        let what = first_difference(&sample(|_| {}), &sample(change), tolerance).expect("compared")?;
        Some(Difference { grasp_id: 7, seq: 0, what }.to_string())
    }

    #[test]
    fn the_first_value_that_differs_is_named() {
        let exact = Tolerance::default();
        let near = Tolerance { absolute: 0.1, relative: 0.0 };
        let move_it = |message: &mut ContactSet| message.contacts[1].position_m[0] = 0.0625;
        assert_eq!(
            shown(move_it, exact).as_deref(),
            Some("grasp 7, seq 0: contacts[1].position_m[0]: expected 0.0, found 0.0625, difference 0.0625")
        );
        assert_eq!(shown(move_it, near), None);
        let says = |found: Option<String>, what: &str| {
            let found = found.expect("a difference");
            assert!(found.contains(what), "{found}");
        };
        says(shown(|message| message.contacts[1].pad = 3, near), "contacts[1].pad: expected 0, found 3, difference 3");
        says(shown(|message| message.fault = Fault::NoContact, near), "fault: expected none, found no_contact");
        says(shown(|message| message.contacts[0].normal[2] = -0.0, exact), "expected 0.0, found -0.0");
        says(shown(|message| message.contacts[0].normal[2] = f64::NAN, near), "expected 0.0, found NaN or infinity");
        says(shown(|message| message.contacts.truncate(1), near), "expected 0, found nothing");
        says(shown(|message| message.contacts.push(Contact::default()), near), "expected nothing, found 0");
    }

    #[test]
    fn nan_and_the_infinities_differ_within_any_tolerance() {
        let numbers = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
        let of = |number: f64| sample(|message| message.contacts[1].force_newtons = number);
        for tolerance in [Tolerance::default(), Tolerance { absolute: 0.1, relative: 0.1 }] {
            for (was, is) in numbers.iter().flat_map(|was| numbers.map(|is| (*was, is))) {
                let found = first_difference(&of(was), &of(is), tolerance).expect("compared");
                assert_eq!(found.is_none(), was.to_string() == is.to_string(), "{was} and {is}: {found:?}");
            }
            assert!(first_difference(&of(f64::NAN), &of(-f64::NAN), tolerance).expect("compared").is_none());
        }
    }
}
