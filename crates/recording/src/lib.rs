//! Recordings: MCAP files with zstd chunks, profile `ros2`, CDR messages and `ros2msg` schemas, so that Foxglove,
//! rosbag2 and PlotJuggler open them. They are also the data sets: the simulator writes them, training reads them.
//!
//! ```
//! use blindgrasp_recording::{Record, RecordingReader};
//!
//! let reader = RecordingReader::open("../../recordings/ordinary.mcap".as_ref())?;
//! assert_eq!(reader.info().hand, "barrett-bh8-280");
//! let mut n_frames = 0;
//! for record in reader {
//!     let (_topic, record) = record?;
//!     n_frames += usize::from(matches!(record, Record::Tactile(_)));
//! }
//! assert!(n_frames > 0);
//! # Ok::<(), blindgrasp_recording::RecordingError>(())
//! ```
//!
//! Not here: what the messages mean. A recording that was cut off or damaged is an error that names the file, never a
//! shorter recording; [`repair()`] makes a recording of the whole samples in it.

mod channels;
mod chosen;
mod index;
mod live;
mod live_file;
mod parts;
mod problems;
mod reader;
mod repair;
mod source;
mod split;
mod summary;
mod types;
mod viewer;
mod writer;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Messages as CDR, for topics of ROS 2: little-endian, behind the four bytes of its encapsulation.
pub mod cdr {
    pub use super::types::{decode, encode};
    pub use super::viewer::{JOINT_STATE, POINT_CLOUD, contact_points, force_points, joint_state};
}

pub use blindgrasp_messages::Record;
pub use mcap::Attachment;

pub use chosen::{Choice, ChosenSamples, RawSample, Reach};
pub use index::{IndexedTopic, RecordingIndex};
pub use live::{LiveOptions, LiveRecorder, LiveSummary};
pub use parts::{Manifest, part_path, recordings_in};
pub use problems::{Oddity, Problem, Problems};
pub use reader::RecordingReader;
pub use repair::{RepairReport, repair, repaired_path};
pub use summary::attachments;
pub use viewer::{LinkPose, LinkPoses, ShownHand, TOPICS_FOR_VIEWERS};
pub use writer::RecordingWriter;

/// The metadata with a recording's [`RecordingInfo`].
pub const METADATA_NAME: &str = "blindgrasp";
/// The metadata that numbers the files of a recording that was split.
pub const PART_METADATA_NAME: &str = "part";
/// The metadata of a live recording's last file, about how the recording ended.
pub const END_METADATA_NAME: &str = "end";
/// The program that wrote the file, in MCAP's header.
const LIBRARY: &str = concat!("blindgrasp ", env!("CARGO_PKG_VERSION"));

/// Where a recording comes from: its MCAP metadata `blindgrasp`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingInfo {
    /// The hand's name.
    pub hand: String,
    /// The hand's identity, `Hand::id`; 0 if unknown.
    #[serde(with = "blindgrasp_messages::hex_id")]
    pub hand_id: u64,
    /// A simulation with its options, or a graph's name.
    pub made_by: String,
    /// The version of the program that wrote the recording.
    pub version: String,
}

/// Why a recording could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file could not be opened, read or written.
    #[error("recording {}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// The file is no recording, or holds something else than expected.
    #[error("recording {}: {message}", path.display())]
    Invalid { path: PathBuf, message: String },
    /// The file was cut off or is damaged.
    #[error("recording {}: {message} (`blindgrasp info --repair` recovers its undamaged samples)", path.display())]
    Damaged { path: PathBuf, message: String },
    /// The disk is full; `reason` is the system's message.
    #[error("recording {}: {reason}: it ends here, complete in itself, with {n_samples} samples", path.display())]
    Full { path: PathBuf, n_samples: u64, reason: String },
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{
        Action, Contact, ContactSet, Fault, GraspFeature, GraspScene, GraspTruth, Header, LiftDecision, LiftOutcome,
        Phase, Prediction, Reason, SceneContact, Stamped, TactileFrame,
    };

    pub(super) fn info() -> RecordingInfo {
        RecordingInfo { hand: "h".into(), hand_id: u64::MAX, made_by: "a test".into(), version: "0".into() }
    }

    /// A sample of each type, on its topic.
    pub(super) fn records() -> Vec<(&'static str, Record)> {
        fn record<M>(seq: u64, message: M) -> Record
        where
            Stamped<M>: Into<Record>,
        {
            let header = Header { seq, stamp_nanos: 1 + seq, epoch: 3, hand_id: u64::MAX, ..Header::default() };
            Stamped { header, message }.into()
        }
        let contact = Contact { position_m: [0.1; 3], normal: [0.0, 0.0, 1.0], force_newtons: 2.5, pad: 1, cell: 23 };
        let (joints, cells_newtons) = (vec![0.1, 0.2], vec![0.3; 5]);
        let frame =
            TactileFrame { grasp_id: 7, phase: Phase::Closing, joints, cells_newtons, ..TactileFrame::default() };
        let contacts = ContactSet {
            grasp_id: 7,
            phase: Phase::Settled,
            joints: vec![0.2, -0.4],
            contacts: vec![contact; 2],
            n_pads_in_contact: 1,
            self_collision: true,
            n_self_contacts: 3,
            fault: Fault::SelfCollision,
            ..ContactSet::default()
        };
        let feature = GraspFeature { values: vec![0.5; 64], ..GraspFeature::default() };
        let prediction = Prediction { decision_value: -0.1, stable: true, ..Prediction::default() };
        let (action, reason) = (Action::Lift, Reason::Stable);
        let decision = LiftDecision { grasp_id: 7, action, reason, probability_stable: 0.75 };
        let contacts_of_scene = vec![SceneContact { other_link: -1, ..SceneContact::default() }; 2];
        let scene = GraspScene { joints: vec![0.5; 7], contacts: contacts_of_scene, ..GraspScene::default() };
        let (object, object_class) = ("bücher-1".into(), "book".into());
        let truth = GraspTruth { epsilon: -1.0, object, object_class, ..GraspTruth::default() };
        let outcome = LiftOutcome { attempt: 3, lifted: true, thing: "tasse".into(), ..LiftOutcome::default() };
        vec![
            ("/tactile", record(0, frame)),
            ("/contacts", record(1, contacts)),
            ("/feature", record(2, feature)),
            ("/prediction", record(3, prediction)),
            ("/decision", record(4, decision)),
            ("/scene", record(5, scene)),
            ("/truth", record(5, truth)),
            ("/outcome", record(6, outcome)),
        ]
    }

    pub(super) fn write_all(path: &std::path::Path) {
        let mut writer = RecordingWriter::create(path, &info()).expect("created");
        records().iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
        writer.finish().expect("finished");
    }

    #[test]
    fn written_samples_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("round-trip.mcap");
        write_all(&path);
        let reader = RecordingReader::open(&path).expect("opened");
        assert_eq!(reader.info(), &info());
        let found: Vec<_> = reader.collect::<Result<_, _>>().expect("read");
        let expected: Vec<_> = records().into_iter().map(|(topic, record)| (topic.to_string(), record)).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn two_writers_cannot_write_the_same_recording_and_leftovers_are_written_over() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("shared.mcap");
        std::fs::write(folder.path().join("shared.mcap.partial"), [7; 100_000]).expect("left by a killed writer");
        let mut writer = RecordingWriter::create(&path, &info()).expect("created");
        let Err(refused) = RecordingWriter::create(&path, &info()) else { panic!("two writers") };
        assert!(refused.to_string().contains("another process is writing it"), "{refused}");
        records().iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
        writer.finish().expect("finished");
        assert_eq!(RecordingReader::open(&path).expect("opened").count(), records().len());
        RecordingWriter::create(&path, &info()).expect("free again");
    }

    #[test]
    fn a_link_stays_and_the_file_that_it_leads_to_is_replaced() {
        use std::os::unix::fs::{PermissionsExt, symlink};

        let folder = tempfile::tempdir().expect("a folder");
        let (file, link) = (folder.path().join("key"), folder.path().join("run.mcap"));
        std::fs::write(&file, "of yesterday").expect("written");
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o640)).expect("set");
        symlink("key", &link).expect("linked");
        write_all(&link);
        assert!(link.is_symlink());
        assert_eq!(RecordingReader::open(&file).expect("opened").count(), records().len());
        assert_eq!(std::fs::metadata(&file).expect("there").permissions().mode() & 0o777, 0o640);
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 2);
        // A new one is for its owner alone, also where the umask would open it.
        let new = folder.path().join("new.mcap");
        write_all(&new);
        assert_eq!(std::fs::metadata(&new).expect("there").permissions().mode() & 0o777, 0o600);
    }

    #[test]
    fn without_statistics_counts_are_unknown_and_without_an_index_the_metadata_are_found() {
        let folder = tempfile::tempdir().expect("a folder");
        let (whole, path) = (folder.path().join("whole.mcap"), folder.path().join("plain.mcap"));
        write_all(&whole);
        let bytes = std::fs::read(&whole).expect("read");
        let file = std::io::BufWriter::new(std::fs::File::create(&path).expect("created"));
        let options = writer::write_options().emit_statistics(false).emit_metadata_indexes(false);
        let mut plain = options.create(file).expect("begun");
        for message in mcap::MessageStream::new(&bytes).expect("MCAP") {
            plain.write(&message.expect("read")).expect("written");
        }
        let metadata = writer::info_metadata(&info());
        plain.write_metadata(&mcap::records::Metadata { name: METADATA_NAME.into(), metadata }).expect("written");
        plain.finish().expect("finished");
        let index = RecordingIndex::open(&path).expect("opened");
        assert_eq!((&index.info, index.n_messages, index.duration_nanos()), (&info(), None, None));
        assert_eq!(index.topics["/truth"].n_messages, None);
        let reader = RecordingReader::open(&path).expect("opened");
        assert_eq!(reader.info(), &info());
        assert_eq!(reader.flatten().count(), records().len());
    }

    #[test]
    fn a_recording_cut_off_or_damaged_anywhere_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("whole.mcap");
        write_all(&path);
        let whole = std::fs::read(&path).expect("read");
        let damaged = folder.path().join("damaged.mcap");
        let check = |bytes: &[u8], what: &str| {
            std::fs::write(&damaged, bytes).expect("written");
            let error = match RecordingReader::open(&damaged) {
                Err(error) => error,
                Ok(reader) => match reader.collect::<Result<Vec<_>, _>>() {
                    Err(error) => error,
                    Ok(_) => panic!("{what} went unnoticed"),
                },
            };
            assert!(error.to_string().contains("damaged.mcap"), "{error}");
        };
        for n_bytes in (0..whole.len()).step_by(7) {
            check(&whole[..n_bytes], &format!("cut to {n_bytes} of {} bytes", whole.len()));
        }
        check(b"not a recording", "another file");
        // Flips in the data section are caught by checksums; the summary behind it has one of its own.
        for at in (8..whole.len() / 2).step_by(11) {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x10;
            check(&bytes, &format!("a flipped bit at {at} of {}", whole.len()));
        }
    }
}
