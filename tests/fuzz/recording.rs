//! Damages small recordings in many ways: reading never panics and never takes huge memory,
//! samples that are read were written, and a repaired recording is whole.

use std::collections::BTreeMap;
use std::path::Path;

use blindgrasp_messages::{Contact, ContactSet, Header, Prediction, Stamped, TactileFrame};
use blindgrasp_recording::{
    Problems, Record, RecordingError, RecordingIndex, RecordingInfo, RecordingReader, RecordingWriter, repair,
    repaired_path,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::seeds::seeds;

/// Compressed and not, of a record of the greatest length that is read, and as much again.
const MAX_MEMORY_KIB: u64 = 4 * (256 << 10);

/// About ten seconds' worth.
const N_CASES: u64 = 5000;

/// A recording as bytes, and what it holds.
struct Base {
    bytes: Vec<u8>,
    records: Vec<(String, Record)>,
}

fn info() -> RecordingInfo {
    RecordingInfo { hand: "h".into(), hand_id: 1, made_by: "a test".into(), version: "0".into() }
}

fn records(epoch: u64, n_frames: u64) -> Vec<(String, Record)> {
    let mut rng = ChaCha8Rng::seed_from_u64(epoch);
    let mut records = Vec::new();
    for seq in 0..n_frames {
        let header = Header { seq, stamp_nanos: 10 * seq, epoch, hand_id: 1, ..Header::default() };
        let grasp_id = seq / 5;
        let cells_newtons = (0..rng.random_range(1..40)).map(|_| rng.random_range(0.0..3.0)).collect();
        let frame = TactileFrame { grasp_id, joints: vec![0.5; 7], cells_newtons, ..TactileFrame::default() };
        records.push(("/tactile".into(), Record::Tactile(Stamped { header, message: frame })));
        let contacts = vec![Contact { force_newtons: 1.0, ..Contact::default() }; (seq % 4) as usize];
        let contacts = ContactSet { grasp_id, contacts, ..ContactSet::default() };
        records.push(("/contacts".into(), Record::Contacts(Stamped { header, message: contacts })));
        let prediction = Prediction { grasp_id, ..Prediction::default() };
        records.push(("/prediction".into(), Record::Prediction(Stamped { header, message: prediction })));
    }
    records
}

/// The same recording again in chunks of this size, compressed or not.
fn in_chunks(bytes: &[u8], chunk_bytes: u64, compression: Option<mcap::Compression>) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new()
        .compression(compression)
        .chunk_size(Some(chunk_bytes))
        .compression_threads(0)
        .create(&mut out)
        .expect("begun");
    let metadata = [("hand", "h"), ("hand_id", "1"), ("made_by", "a test"), ("version", "0")];
    let metadata = BTreeMap::from(metadata.map(|(key, value)| (key.to_string(), value.to_string())));
    writer.write_metadata(&mcap::records::Metadata { name: "blindgrasp".into(), metadata }).expect("written");
    for message in mcap::MessageStream::new(bytes).expect("MCAP") {
        writer.write(&message.expect("whole")).expect("written");
    }
    writer.finish().expect("finished");
    drop(writer);
    out.into_inner()
}

fn bases(folder: &Path) -> Vec<Base> {
    let mut bases = Vec::new();
    for (epoch, n_frames) in [(1, 60), (2, 25)] {
        let path = folder.join("base.mcap");
        let records = records(epoch, n_frames);
        let mut writer = RecordingWriter::create(&path, &info()).expect("created");
        records.iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
        writer.finish().expect("finished");
        let bytes = std::fs::read(&path).expect("read");
        for (chunk_bytes, compression) in [(2000, Some(mcap::Compression::Zstd)), (3000, None)] {
            bases.push(Base { bytes: in_chunks(&bytes, chunk_bytes, compression), records: records.clone() });
        }
        bases.push(Base { bytes, records });
    }
    bases
}

fn read(path: &Path) -> Result<Vec<(String, Record)>, RecordingError> {
    RecordingReader::open(path)?.collect()
}

/// The offsets of the records of a whole file.
fn record_offsets(bytes: &[u8]) -> Vec<usize> {
    let mut offsets = Vec::new();
    let mut at = mcap::MAGIC.len();
    while let Some(prefix) = bytes.get(at..at + 9) {
        offsets.push(at);
        let n_bytes = u64::from_le_bytes(prefix[1..].try_into().expect("8"));
        at = at.saturating_add(9).saturating_add(usize::try_from(n_bytes).unwrap_or(usize::MAX));
    }
    offsets
}

fn damaged(bases: &[Base], rng: &mut ChaCha8Rng) -> Vec<u8> {
    let base = &bases[rng.random_range(0..bases.len())];
    let mut bytes = base.bytes.clone();
    for _ in 0..rng.random_range(1..=3) {
        if bytes.len() < 16 {
            return bytes;
        }
        let at = rng.random_range(0..bytes.len());
        let offsets = record_offsets(&bytes);
        let record =
            |rng: &mut ChaCha8Rng| offsets.get(rng.random_range(0..offsets.len().max(1))).copied().unwrap_or(8);
        match rng.random_range(0..8) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes.truncate(at),
            2 => {
                let other = &bases[rng.random_range(0..bases.len())].bytes;
                let from = rng.random_range(0..other.len());
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            // At the borders of records, so that the halves fit.
            3 => {
                let other = &bases[rng.random_range(0..bases.len())].bytes;
                let others = record_offsets(other);
                bytes.truncate(record(rng));
                bytes.extend(&other[others[rng.random_range(0..others.len())]..]);
            }
            // Any length in it, and those of records.
            4 | 5 => {
                let at = if rng.random_bool(0.5) { record(rng) + 1 } else { at };
                let length: u64 =
                    [u64::MAX, 1 << 60, 1 << 40, 200 << 20, u64::from(u32::MAX), 0][rng.random_range(0..6)];
                let n_bytes = if rng.random_bool(0.5) { 8 } else { 4 };
                for (byte, new) in bytes.iter_mut().skip(at).zip(&length.to_le_bytes()[..n_bytes]) {
                    *byte = *new;
                }
            }
            // A record twice, or not at all.
            6 => {
                let (from, to) = (record(rng), record(rng));
                let copied = bytes[from.min(to)..from.max(to)].to_vec();
                let into = record(rng);
                bytes.splice(into..into, copied);
            }
            _ => {
                let (from, to) = (record(rng), record(rng));
                bytes.drain(from.min(to)..from.max(to));
            }
        }
    }
    bytes
}

/// Reads, selects, indexes and repairs a recording, and asserts what must hold.
fn check(bytes: &[u8], bases: &[Base], folder: &Path) {
    let path = folder.join("damaged.mcap");
    std::fs::write(&path, bytes).expect("written");
    let whole = read(&path);
    if let Ok(found) = &whole {
        assert!(
            bases.iter().any(|base| base.records == *found),
            "{} records passed for a whole recording",
            found.len()
        );
        let mut problems = Problems::default();
        found.iter().for_each(|(topic, record)| problems.add(topic, record));
        assert_eq!(problems.found(), []);
    }
    if let Ok(index) = RecordingIndex::open(&path) {
        assert_eq!(index.n_file_bytes, bytes.len() as u64);
    }
    if let Ok(report) = repair(&path) {
        assert_eq!(report.output.is_none(), whole.is_ok(), "{report:?}");
        if let Some(output) = &report.output {
            let found = read(output).expect("what a repair writes is whole");
            assert_eq!(found.len() as u64, report.n_recovered.values().sum::<u64>());
            // A sample that no checksum covers may be any readable one, and the report says so.
            let mut n_made_up: BTreeMap<&str, u64> = BTreeMap::new();
            for record in &found {
                if !bases.iter().any(|base| base.records.contains(record)) {
                    *n_made_up.entry(&record.0).or_default() += 1;
                }
            }
            for (topic, n_made_up) in n_made_up {
                let n_unverified = report.n_unverified.get(topic).copied().unwrap_or(0);
                assert!(n_made_up <= n_unverified, "{n_made_up} samples of {topic} were made up: {report:?}");
            }
        }
    }
    let _ = std::fs::remove_file(repaired_path(&path));
}

fn peak_memory_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).expect("there");
    line.split_whitespace().nth(1).expect("a number").parse().expect("KiB")
}

#[test]
fn damaged_recordings_are_never_accepted_as_whole() {
    // In memory: each repair waits until it is on the disk, which would be most of the time.
    let folder = tempfile::tempdir_in("/dev/shm").expect("a folder");
    let bases = bases(folder.path());
    for base in &bases {
        check(&base.bytes, &bases, folder.path());
    }
    let mut n_done = 0;
    for seed in seeds(N_CASES) {
        let outcome = std::panic::catch_unwind(|| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            check(&damaged(&bases, &mut rng), &bases, folder.path());
        });
        if outcome.is_err() {
            panic!("it fails at once with BLINDGRASP_FUZZ_SEED={seed}");
        }
        n_done += 1;
        let peak_kib = peak_memory_kib();
        assert!(peak_kib < MAX_MEMORY_KIB, "{peak_kib} KiB with BLINDGRASP_FUZZ_SEED={seed}");
    }
    println!("{n_done} damaged recordings");
}
