//! Reading some topics of a recording, or the chunks that hold something of them.
//!
//! Messages of other topics are not decoded, and those of the chosen topics only on demand.

use std::ops::Range;
use std::path::Path;

use blindgrasp_messages::{Header, Record};

use super::reader::{RecordingReader, undecodable};
use super::types::OurType;
use super::{RecordingError, RecordingInfo};

/// Says of a topic and the name of its schema, like `blindgrasp_msgs/msg/TactileFrame`, whether it is chosen.
pub type Choice = Box<dyn Fn(&str, &str) -> bool + Send>;

/// The part of a file that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// The whole file, so that every checksum in it is checked.
    Whole,
    /// The chunks that the file's index lists with a chosen topic. Damage in the other chunks is not found.
    ByIndex,
}

/// The samples of the chosen topics of a recording, in the file's order.
pub struct ChosenSamples {
    reader: RecordingReader,
    choice: Choice,
    reach: Reach,
    /// The chunks that were not skipped from the start.
    chunks: Vec<Chunk>,
}

/// A sample whose message is not decoded yet.
#[derive(Debug, Clone)]
pub struct RawSample {
    pub header: Header,
    pub grasp_id: u64,
    pub topic: String,
    /// The name of the message's schema, like `blindgrasp_msgs/msg/TactileFrame`.
    pub schema: &'static str,
    pub(super) sequence: u32,
    pub(super) ours: &'static OurType,
    pub(super) data: Vec<u8>,
}

/// A chunk as the index lists it.
struct Chunk {
    bytes: Range<u64>,
    last_stamp_nanos: u64,
}

impl ChosenSamples {
    /// Opens a recording and reads its summary.
    ///
    /// # Errors
    /// As [`RecordingReader::open`].
    pub fn open(path: &Path, choice: Choice, reach: Reach) -> Result<Self, RecordingError> {
        let (mut reader, indices) = RecordingReader::open_with(path, reach)?;
        let mut chunks = Vec::new();
        for index in &indices {
            let is_chosen = |channel_id: &u16| {
                let known = reader.channels().get(*channel_id);
                let is_it = |ours: &OurType, topic| choice(topic, ours.schema);
                // The summary may lack a channel that the chunk declares.
                known.is_none_or(|known| known.ours.is_some_and(|ours| is_it(ours, &known.channel.topic)))
            };
            let bytes = index.chunk_start_offset..index.chunk_start_offset + index.chunk_length;
            // A file may have an index of its chunks without an index of their messages.
            let offsets = &index.message_index_offsets;
            if offsets.is_empty() || offsets.keys().any(is_chosen) {
                chunks.push(Chunk { bytes, last_stamp_nanos: index.message_end_time });
            } else if reach == Reach::ByIndex {
                reader.input.skip(bytes);
            }
        }
        Ok(ChosenSamples { reader, choice, reach, chunks })
    }

    pub fn info(&self) -> &RecordingInfo {
        &self.reader.info
    }

    /// With [`Reach::ByIndex`], skips the next chunks whose samples were all recorded before this time, except for the
    /// last of these chunks, with which the numbers of the samples go on.
    pub fn skip_to(&mut self, stamp_nanos: u64) {
        if self.reach == Reach::Whole {
            return;
        }
        let is_ahead = |chunk: &&Chunk| chunk.bytes.start >= self.reader.input.at;
        let is_earlier = |chunk: &&Chunk| chunk.last_stamp_nanos < stamp_nanos;
        let earlier: Vec<_> = self.chunks.iter().filter(is_ahead).take_while(is_earlier).collect();
        if let Some((_, skipped)) = earlier.split_last() {
            skipped.iter().for_each(|chunk| self.reader.input.skip(chunk.bytes.clone()));
        }
    }

    /// The next sample; `None` at the end.
    ///
    /// # Errors
    /// The file is damaged, or holds something else than expected.
    pub fn advance(&mut self) -> Result<Option<RawSample>, RecordingError> {
        let choice = &self.choice;
        self.reader.next_with(|(topic, sequence, ours, data)| {
            choice(topic, ours.schema).then(|| RawSample::new(topic, sequence, ours, data))
        })
    }

    /// Decodes a sample of this recording.
    ///
    /// # Errors
    /// It is not of its schema.
    pub fn decode(&self, sample: &RawSample) -> Result<Record, RecordingError> {
        let RawSample { topic, sequence, ours, data, .. } = sample;
        ours.decode(data).map_err(|what| self.reader.damaged(undecodable(topic, *sequence, &what)))
    }
}

impl RawSample {
    fn new(topic: &str, sequence: u32, ours: &'static OurType, data: &[u8]) -> Result<Self, String> {
        let (header, grasp_id) = ours.decode_start(data).map_err(|what| undecodable(topic, sequence, &what))?;
        Ok(RawSample { header, grasp_id, topic: topic.into(), schema: ours.schema, sequence, ours, data: data.into() })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use mcap::records::{MessageHeader, Metadata};

    use super::*;
    use crate::tests::{info, records, write_all};
    use crate::types::{MESSAGE_ENCODING, SCHEMA_ENCODING, encode};
    use crate::writer::{info_metadata, write_options};
    use crate::{METADATA_NAME, RecordingIndex};
    use blindgrasp_messages::{Prediction, Recorded, Stamped};

    const REACHES: [Reach; 2] = [Reach::Whole, Reach::ByIndex];

    /// A recording of predictions, each in a chunk of its own, with its topic and its time. Those on `/damaged` are no
    /// predictions.
    fn in_chunks(chunks: &[(&str, u64)]) -> tempfile::TempPath {
        let path = tempfile::NamedTempFile::new().expect("a file").into_temp_path();
        let file = std::io::BufWriter::new(std::fs::File::create(&path).expect("created"));
        let mut writer = write_options().create(file).expect("begun");
        let metadata = Metadata { name: METADATA_NAME.into(), metadata: info_metadata(&info()) };
        writer.write_metadata(&metadata).expect("written");
        let definition = Prediction::definition();
        let schema_id = writer.add_schema(Prediction::SCHEMA, SCHEMA_ENCODING, definition.as_bytes()).expect("added");
        for (idx, (topic, stamp_nanos)) in chunks.iter().enumerate() {
            let channel_id = writer.add_channel(schema_id, topic, MESSAGE_ENCODING, &BTreeMap::new()).expect("added");
            let header = Header { seq: idx as u64, stamp_nanos: *stamp_nanos, ..Header::default() };
            let mut data = Vec::new();
            encode(&Stamped { header, message: Prediction::default() }, &mut data).expect("encoded");
            if *topic == "/damaged" {
                data.truncate(7);
            }
            let (sequence, log_time) = (idx as u32, *stamp_nanos);
            let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &data).expect("written");
            writer.flush().expect("flushed");
        }
        writer.finish().expect("finished");
        assert_eq!(RecordingIndex::open(&path).expect("opened").n_chunks, chunks.len() as u64);
        path
    }

    fn open(path: &Path, topic: &'static str, reach: Reach) -> ChosenSamples {
        ChosenSamples::open(path, Box::new(move |found, _| found == topic), reach).expect("opened")
    }

    fn rest(samples: &mut ChosenSamples) -> Result<Vec<u64>, RecordingError> {
        std::iter::from_fn(|| samples.advance().transpose()).map(|sample| Ok(sample?.header.seq)).collect()
    }

    /// Damages the chunk that holds the sample of that number.
    fn damage(path: &Path, seq: usize) {
        let (_, summary) = crate::summary::open(path).expect("opened");
        let at = summary.chunks[seq].chunk_start_offset + summary.chunks[seq].chunk_length - 1;
        let mut bytes = std::fs::read(path).expect("read");
        bytes[at as usize] ^= 1;
        std::fs::write(path, bytes).expect("written");
    }

    #[test]
    fn chosen_samples_are_those_of_the_whole_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("all.mcap");
        write_all(&path);
        for (topic, record) in records() {
            for reach in REACHES {
                let mut samples = open(&path, topic, reach);
                let sample = samples.advance().expect("read").expect("one");
                assert_eq!((&sample.header, sample.grasp_id), (record.header(), record.grasp_id()), "{topic}");
                assert_eq!(samples.decode(&sample).expect("decoded"), record);
                assert!(samples.advance().expect("read").is_none());
            }
        }
    }

    #[test]
    fn samples_of_other_topics_are_not_decoded() {
        let path = in_chunks(&[("/a", 0), ("/damaged", 1), ("/a", 2)]);
        for reach in REACHES {
            assert_eq!(rest(&mut open(&path, "/a", reach)).expect("read"), [0, 2]);
            let error = rest(&mut open(&path, "/damaged", reach)).expect_err("no prediction").to_string();
            assert!(error.contains("/damaged, sample 1: not a"), "{error}");
        }
    }

    #[test]
    fn chunks_without_a_chosen_topic_are_skipped_by_the_index_alone() {
        let path = in_chunks(&[("/b", 0), ("/a", 1), ("/b", 2), ("/b", 3), ("/a", 4)]);
        for reach in REACHES {
            assert_eq!(rest(&mut open(&path, "/a", reach)).expect("read"), [1, 4]);
        }
        damage(&path, 2);
        assert_eq!(rest(&mut open(&path, "/a", Reach::ByIndex)).expect("read"), [1, 4]);
        rest(&mut open(&path, "/a", Reach::Whole)).expect_err("damaged");
        rest(&mut open(&path, "/b", Reach::ByIndex)).expect_err("damaged");
    }

    #[test]
    fn chunks_of_an_earlier_time_are_skipped_but_for_the_last_one() {
        // The clock of the source once went back.
        let path = in_chunks(&[("/a", 10), ("/a", 11), ("/b", 12), ("/a", 13), ("/a", 14), ("/a", 15), ("/a", 9)]);
        let read = |reach, stamp_nanos| {
            let mut samples = open(&path, "/a", reach);
            assert_eq!(samples.advance().expect("read").map(|sample| sample.header.seq), Some(0));
            samples.skip_to(stamp_nanos);
            rest(&mut samples)
        };
        for stamp_nanos in [0, 11, 12, 13] {
            assert_eq!(read(Reach::ByIndex, stamp_nanos).expect("read"), [1, 3, 4, 5, 6], "{stamp_nanos}");
        }
        assert_eq!(read(Reach::ByIndex, 14).expect("read"), [3, 4, 5, 6]);
        assert_eq!(read(Reach::ByIndex, 15).expect("read"), [4, 5, 6]);
        assert_eq!(read(Reach::ByIndex, 99).expect("read"), [6]);
        assert_eq!(read(Reach::Whole, 99).expect("read"), [1, 3, 4, 5, 6]);
        damage(&path, 3);
        assert_eq!(read(Reach::ByIndex, 15).expect("read"), [4, 5, 6]);
        read(Reach::ByIndex, 14).expect_err("damaged");
        read(Reach::Whole, 15).expect_err("damaged");
    }
}
