//! What writing and reading recordings costs beside the mcap crate alone, for `scripts/benchsuite mcap`.
//!
//! `mcap_throughput RECORDING FOLDER SAMPLES REPEATS` prints JSON. Our side makes messages of samples and samples of
//! messages; the other side writes the same messages as bytes, with the same compression and chunks, and reads them as
//! bytes. The sides take turns; times are medians of the repeats, in seconds.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, bail};
use blindgrasp_messages::Stamped;
use blindgrasp_recording::{LiveOptions, LiveRecorder, Record, RecordingInfo, RecordingReader, RecordingWriter};
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};
use serde_json::json;

/// As LiveRecorder closes its chunks.
const LIVE_CHUNK_BYTES: u64 = 512 << 10;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [recording, folder, n_samples, n_repeats] = &arguments[..] else {
        bail!("expected RECORDING FOLDER SAMPLES REPEATS");
    };
    let (n_samples, n_repeats): (usize, usize) = (n_samples.parse()?, n_repeats.parse()?);
    let folder = Path::new(folder);
    let (info, samples) = samples(Path::new(recording), n_samples)?;
    let [ours, live, theirs, theirs_live] =
        ["ours", "live", "theirs", "theirs-live"].map(|name| folder.join(format!("mcap-throughput-{name}.mcap")));
    write_ours(&ours, &info, &samples)?;
    write_live(&live, &info, &samples)?;
    let (messages, live_messages) = (messages(&ours)?, messages(&live)?);
    let mut times: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for _ in 0..n_repeats {
        for (name, run) in [
            ("write", &(|| write_ours(&ours, &info, &samples)) as &dyn Fn() -> anyhow::Result<()>),
            ("write_mcap", &|| write_theirs(&theirs, &messages, None)),
            ("live", &|| write_live(&live, &info, &samples)),
            ("live_mcap", &|| write_theirs(&theirs_live, &live_messages, Some(LIVE_CHUNK_BYTES))),
            ("read", &|| read_ours(&ours)),
            ("read_mcap", &|| read_theirs(&ours)),
        ] {
            let begun = Instant::now();
            run()?;
            times.entry(name).or_default().push(begun.elapsed().as_secs_f64());
        }
    }
    let median = |name: &str| {
        let mut sorted = times[name].clone();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    let n_bytes = |messages: &[Message]| messages.iter().map(|message| message.data.len()).sum::<usize>();
    let result = json!({
        "n_samples": samples.len(),
        "n_message_bytes": n_bytes(&messages),
        "n_live_messages": live_messages.len(),
        "n_live_message_bytes": n_bytes(&live_messages),
        "ratio": {
            "write": median("write") / median("write_mcap"),
            "live": median("live") / median("live_mcap"),
            "read": median("read") / median("read_mcap"),
        },
        "median_secs": times.keys().map(|name| (*name, median(name))).collect::<BTreeMap<_, _>>(),
        "secs": times,
    });
    println!("{result}");
    for path in [ours, live, theirs, theirs_live] {
        std::fs::remove_file(path)?;
    }
    Ok(())
}

/// A message as it lies in a file.
struct Message {
    topic: String,
    schema: (String, Vec<u8>),
    header: MessageHeader,
    data: Vec<u8>,
}

/// A recording's frames, repeated, each with its contacts.
fn samples(recording: &Path, n_samples: usize) -> anyhow::Result<(RecordingInfo, Vec<(&'static str, Record)>)> {
    let reader = RecordingReader::open(recording)?;
    let info = reader.info().clone();
    let hand = blindgrasp_grasps::dataset::hand_of(recording, None)?;
    let mut recorded = Vec::new();
    for record in reader {
        if let (_, Record::Tactile(frame)) = record? {
            let mut contacts = blindgrasp_messages::ContactSet {
                grasp_id: frame.message.grasp_id,
                phase: frame.message.phase,
                joints: frame.message.joints.clone(),
                ..Default::default()
            };
            let (joints, cells_newtons) = (&frame.message.joints, &frame.message.cells_newtons);
            blindgrasp_stages::contacts::contacts_from_frame(&hand, 0, joints, cells_newtons, &mut contacts.contacts);
            let contacts = Stamped { header: frame.header, message: contacts };
            recorded.push([("/tactile", Record::Tactile(frame)), ("/contacts", Record::Contacts(contacts))]);
        }
    }
    if recorded.is_empty() {
        bail!("{}: no frames", recording.display());
    }
    Ok((info, recorded.into_iter().cycle().flatten().take(n_samples).collect()))
}

fn write_ours(path: &Path, info: &RecordingInfo, samples: &[(&str, Record)]) -> anyhow::Result<()> {
    let mut writer = RecordingWriter::create(path, info)?;
    for (topic, record) in samples {
        writer.write_record(topic, record)?;
    }
    writer.finish()?;
    Ok(())
}

fn write_live(path: &Path, info: &RecordingInfo, samples: &[(&str, Record)]) -> anyhow::Result<()> {
    let joint_names = match samples.first() {
        Some((_, Record::Tactile(frame))) => {
            (0..frame.message.joints.len()).map(|idx| format!("joint_{idx}")).collect()
        }
        _ => Vec::new(),
    };
    let options = LiveOptions { overwrite: true, joint_names, ..LiveOptions::default() };
    let mut recorder = LiveRecorder::create(path, info, options)?;
    for (idx, (topic, record)) in samples.iter().enumerate() {
        recorder.write(topic, record)?;
        if idx % 256 == 0 {
            recorder.tick()?;
        }
    }
    recorder.finish()?;
    Ok(())
}

fn messages(path: &Path) -> anyhow::Result<Vec<Message>> {
    let bytes = std::fs::read(path)?;
    let mut messages = Vec::new();
    for message in mcap::MessageStream::new(&bytes)? {
        let message = message?;
        let schema = message.channel.schema.as_ref().context("expected a schema")?;
        messages.push(Message {
            topic: message.channel.topic.clone(),
            schema: (schema.name.clone(), schema.data.to_vec()),
            header: MessageHeader {
                channel_id: message.channel.id,
                sequence: message.sequence,
                log_time: message.log_time,
                publish_time: message.publish_time,
            },
            data: message.data.into_owned(),
        });
    }
    Ok(messages)
}

fn write_theirs(path: &Path, messages: &[Message], chunk_bytes: Option<u64>) -> anyhow::Result<()> {
    let mut options = WriteOptions::new().profile("ros2").compression(Some(Compression::Zstd)).compression_threads(0);
    if chunk_bytes.is_some() {
        options = options.chunk_size(chunk_bytes).disable_seeking(true);
    }
    let mut writer = options.create(BufWriter::new(File::create(path)?))?;
    let mut known = 0;
    for message in messages {
        // Our files number their channels as they come.
        if message.header.channel_id > known {
            let schema_id = writer.add_schema(&message.schema.0, "ros2msg", &message.schema.1)?;
            known = writer.add_channel(schema_id, &message.topic, "cdr", &BTreeMap::new())?;
        }
        writer.write_to_known_channel(&message.header, &message.data)?;
    }
    writer.finish()?;
    // Both sides wait for the disk.
    writer.into_inner().into_inner()?.sync_all()?;
    Ok(())
}

fn read_ours(path: &Path) -> anyhow::Result<()> {
    for record in RecordingReader::open(path)? {
        std::hint::black_box(record?);
    }
    Ok(())
}

fn read_theirs(path: &Path) -> anyhow::Result<()> {
    let bytes = std::fs::read(path)?;
    for message in mcap::MessageStream::new(&bytes)? {
        std::hint::black_box(message?);
    }
    Ok(())
}
