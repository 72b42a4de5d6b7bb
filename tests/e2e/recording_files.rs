//! Recordings as files: live recording, splitting, full disks, killed recorders, repair, versions, selection.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use blindgrasp_messages::{
    Action, Contact, ContactSet, GraspTruth, Header, LiftDecision, Phase, Prediction, Stamped, TactileFrame,
};
use blindgrasp_recording::{
    LiveOptions, LiveRecorder, Oddity, Problems, Record, RecordingError, RecordingIndex, RecordingInfo,
    RecordingReader, RecordingWriter, RepairReport, ShownHand, repair, repaired_path,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::common::program;

const EPOCH: u64 = 7;
const N_CELLS: usize = 96;

fn info() -> RecordingInfo {
    RecordingInfo { hand: "barrett-bh8-280".into(), hand_id: 0, made_by: "a test".into(), version: "0.1.0".into() }
}

fn header(seq: u64) -> Header {
    Header { seq, stamp_nanos: 1_000_000_000 + seq * 1_000_000, epoch: EPOCH, ..Header::default() }
}

/// Noise, so that chunks stay large when they are compressed.
fn frame(seq: u64, grasp_id: u64) -> Record {
    let mut rng = ChaCha8Rng::seed_from_u64(seq);
    let mut values = |n: usize| (0..n).map(|_| rng.random_range(0.0..1.0)).collect();
    let message = TactileFrame {
        grasp_id,
        phase: Phase::Settled,
        joints: values(7),
        cells_newtons: values(N_CELLS),
        ..TactileFrame::default()
    };
    Record::Tactile(Stamped { header: header(seq), message })
}

fn contacts(seq: u64, grasp_id: u64) -> Record {
    let contact = Contact { position_m: [0.01, 0.02, seq as f64], force_newtons: 2.0, ..Contact::default() };
    let message = ContactSet { grasp_id, contacts: vec![contact; 3], ..ContactSet::default() };
    Record::Contacts(Stamped { header: header(seq), message })
}

fn prediction(seq: u64, grasp_id: u64) -> Record {
    Record::Prediction(Stamped { header: header(seq), message: Prediction { grasp_id, ..Prediction::default() } })
}

fn decision(grasp_id: u64) -> Record {
    let message = LiftDecision { grasp_id, action: Action::Lift, ..LiftDecision::default() };
    Record::Decision(Stamped { header: Header { seq: grasp_id, ..header(grasp_id * 10 + 9) }, message })
}

fn truth(grasp_id: u64) -> Record {
    let message = GraspTruth { grasp_id, object: "mug".into(), object_class: "cup".into(), ..GraspTruth::default() };
    Record::Truth(Stamped { header: Header { seq: grasp_id, ..header(grasp_id * 10 + 9) }, message })
}

fn read(path: &Path) -> Result<Vec<(String, Record)>, RecordingError> {
    RecordingReader::open(path)?.collect()
}

/// Grasps of ten frames each: frame, contacts and prediction of each number, and a decision at each grasp's end.
fn run_of(n_frames: u64) -> Vec<(&'static str, Record)> {
    let mut samples = Vec::new();
    for seq in 0..n_frames {
        let grasp_id = seq / 10;
        samples.push(("/tactile", frame(seq, grasp_id)));
        samples.push(("/contacts", contacts(seq, grasp_id)));
        samples.push(("/prediction", prediction(seq, grasp_id)));
        if seq % 10 == 9 {
            samples.push(("/decision", decision(grasp_id)));
        }
    }
    samples
}

fn live_file(path: &Path, samples: &[(&str, Record)]) {
    let mut recorder = LiveRecorder::create(path, &info(), LiveOptions::default()).expect("created");
    samples.iter().for_each(|(topic, record)| recorder.write(topic, record).expect("written"));
    recorder.finish().expect("finished");
}

fn written_file(path: &Path, samples: &[(&str, Record)]) {
    let mut writer = RecordingWriter::create(path, &info()).expect("created");
    samples.iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
    writer.finish().expect("finished");
}

fn info_command(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(program()).arg("info").args(arguments).output().expect("run");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

/// A test of this file, in a process of its own.
fn this_test(name: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("a path"));
    let path = format!("{}::{name}", module_path!().split_once("::").expect("a module").1);
    command.args(["--exact", &path, "--nocapture", "--test-threads", "1"]);
    command
}

#[test]
fn a_live_recording_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("live.mcap");
    let graph = BTreeMap::from([("yaml".to_string(), "name: x\n".to_string())]);
    let hand = ShownHand {
        joint_names: (0..7).map(|idx| format!("joint_{idx}")).collect(),
        layout: "name: x".into(),
        urdf: "<robot/>".into(),
        link_poses: Arc::new(|_| Vec::new()),
    };
    let options = LiveOptions {
        hand: Some(hand),
        attachments: BTreeMap::from([("model.json".to_string(), b"{}".to_vec())]),
        metadata: BTreeMap::from([("graph".to_string(), graph.clone())]),
        ..LiveOptions::default()
    };
    let samples = run_of(2000);
    let mut recorder = LiveRecorder::create(&path, &info(), options.clone()).expect("created");
    let Err(refused) = LiveRecorder::create(&path, &info(), options.clone()) else { panic!("two recorders") };
    assert!(refused.to_string().contains("there is a file of that name"), "{refused}");
    let overwriting = LiveOptions { overwrite: true, ..options };
    let Err(refused) = LiveRecorder::create(&path, &info(), overwriting.clone()) else { panic!("two recorders") };
    assert!(refused.to_string().contains("another process is writing it"), "{refused}");
    for (topic, record) in &samples {
        recorder.write(topic, record).expect("written");
        recorder.tick().expect("ticked");
    }
    let Err(refused) = RecordingReader::open(&path) else { panic!("read while it is written") };
    assert!(refused.to_string().contains("still being recorded"), "{refused}");
    let summary = recorder.finish().expect("finished");
    assert_eq!(summary.files, std::slice::from_ref(&path));
    assert_eq!(summary.n_samples["/tactile"], 2000);
    assert_eq!(summary.n_samples.values().sum::<u64>(), samples.len() as u64);
    assert_eq!(summary.n_bytes, std::fs::metadata(&path).expect("there").len());

    let reader = RecordingReader::open(&path).expect("opened");
    assert_eq!((reader.info(), reader.metadata("graph")), (&info(), Some(&graph)));
    let found = read(&path).expect("read");
    assert!(found.iter().map(|(topic, record)| (topic.as_str(), record)).eq(samples.iter().map(|(t, r)| (*t, r))));

    let index = RecordingIndex::open(&path).expect("indexed");
    assert_eq!(index.topics["/contacts"].n_messages, Some(2000));
    assert_eq!(index.topics["/joint_states"].n_messages, Some(2000));
    assert_eq!(index.topics["/contact_points"].schema, "sensor_msgs/msg/PointCloud2");
    assert!(index.topics["/tactile"].is_ours && !index.topics["/joint_states"].is_ours);
    assert_eq!((index.topics["/robot_description"].n_messages, index.topics["/tf"].n_messages), (Some(1), Some(2000)));
    assert_eq!(index.n_messages, Some(samples.len() as u64 + 6001));
    assert_eq!((index.first_stamp_nanos, index.duration_nanos()), (Some(1_000_000_000), Some(1_999_000_000)));
    assert!(index.n_chunks > 3 && index.n_compressed_bytes < index.n_uncompressed_bytes, "{index:?}");

    // An existing file is overwritten only when that was asked for.
    assert!(LiveRecorder::create(&path, &info(), LiveOptions::default()).is_err());
    LiveRecorder::create(&path, &info(), overwriting).expect("overwritten").finish().expect("finished");
    assert_eq!(read(&path).expect("whole").len(), 0);
}

/// Fills a disk of 2 MB and looks at what is on it then.
fn fill_disk(folder: &Path) {
    for (name, rotate_bytes) in [("one.mcap", None), ("parts.mcap", Some(300_000))] {
        let path = folder.join(name);
        let options = LiveOptions { rotate_bytes, ..LiveOptions::default() };
        let mut recorder = LiveRecorder::create(&path, &info(), options).expect("created");
        let mut n_taken = 0;
        let full = loop {
            match recorder.write("/tactile", &frame(n_taken, n_taken / 10)) {
                Ok(()) => n_taken += 1,
                Err(error) => break error,
            }
            assert!(n_taken < 100_000, "the disk has no end");
        };
        let RecordingError::Full { n_samples, .. } = &full else { panic!("{full}") };
        assert!(*n_samples > 0 && *n_samples <= n_taken, "{n_samples} of {n_taken}: {full}");
        assert!(full.to_string().contains("No space left") && full.to_string().contains("complete"), "{full}");
        let again = recorder.write("/tactile", &frame(n_taken, 0)).expect_err("still full");
        assert_eq!(again.to_string(), full.to_string());
        recorder.tick().expect("nothing to do");
        let summary = recorder.finish().expect("completed");
        assert_eq!((summary.n_samples["/tactile"], summary.n_refused), (n_taken, 2));
        assert_eq!(summary.files.len() > 1, rotate_bytes.is_some(), "{summary:?}");
        let mut n_read = 0;
        for file in &summary.files {
            for (seq, (_, record)) in (n_read..).zip(read(file).expect("whole")) {
                assert_eq!(record, frame(seq, seq / 10));
                n_read = seq + 1;
            }
            // Reserved space that was not needed is free again: pages of 4 KiB.
            let found = rustix::fs::stat(file).expect("there");
            assert!(found.st_blocks * 512 < found.st_size + 8192, "{} blocks, {}", found.st_blocks, found.st_size);
            std::fs::remove_file(file).expect("removed");
        }
        assert_eq!(n_read, n_taken);
    }
    println!("the disk was filled");
}

#[test]
fn a_recording_ends_whole_when_the_disk_is_full() {
    if let Some(folder) = std::env::var_os("BLINDGRASP_TEST_DISK") {
        return fill_disk(Path::new(&folder));
    }
    let folder = tempfile::tempdir().expect("a folder");
    let mount = |then: &Command| {
        let mut command = Command::new("unshare");
        command.args([
            "--mount",
            "sh",
            "-c",
            "mount -t tmpfs -o size=2m none \"$BLINDGRASP_TEST_DISK\" && exec \"$@\"",
            "sh",
        ]);
        command.arg(then.get_program()).args(then.get_args()).env("BLINDGRASP_TEST_DISK", folder.path());
        command.output()
    };
    if !mount(&Command::new("true")).is_ok_and(|output| output.status.success()) {
        crate::common::skipped("no disk of 2 MB can be mounted here (needs root)");
        return;
    }
    let output = mount(&this_test("a_recording_ends_whole_when_the_disk_is_full")).expect("started");
    let said = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("the disk was filled"), "{said}");
}

/// The files that hold each grasp's samples. It asserts that each file is whole in itself.
fn files_of_grasps(files: &[PathBuf]) -> BTreeMap<u64, BTreeSet<usize>> {
    let mut grasps: BTreeMap<u64, BTreeSet<usize>> = BTreeMap::new();
    for (idx, path) in files.iter().enumerate() {
        let reader = RecordingReader::open(path).expect("opened");
        assert_eq!(reader.info(), &info());
        assert_eq!(reader.metadata("part").expect("numbered")["number"], idx.to_string());
        assert_eq!(reader.metadata("graph").expect("there")["name"], "x");
        for (_, record) in read(path).expect("whole") {
            grasps.entry(record.grasp_id()).or_default().insert(idx);
        }
    }
    grasps
}

fn split_options(rotate_bytes: u64) -> LiveOptions {
    let graph = BTreeMap::from([("name".to_string(), "x".to_string())]);
    let metadata = BTreeMap::from([("graph".to_string(), graph)]);
    LiveOptions { rotate_bytes: Some(rotate_bytes), metadata, ..LiveOptions::default() }
}

#[test]
fn splitting_tears_no_grasp_though_samples_come_late_or_early() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut recorder = LiveRecorder::create(&path, &info(), split_options(400_000)).expect("created");
    let (n_frames, per_grasp) = (6000_u64, 25_u64);
    let mut n_written = 0;
    let mut write = |topic: &str, record: Record| {
        recorder.write(topic, &record).expect("written");
        n_written += 1;
    };
    for now in 0..n_frames + 100 {
        // Truths come before their grasps, contacts before their frames, predictions and decisions long after.
        if now % per_grasp == 20 && now / per_grasp + 1 < n_frames / per_grasp {
            write("/truth", truth(now / per_grasp + 1));
        }
        for (topic, delay, make) in [
            ("/contacts", 0, contacts as fn(u64, u64) -> Record),
            ("/tactile", 3, frame),
            ("/prediction", 60, prediction),
        ] {
            if let Some(seq) = now.checked_sub(delay).filter(|seq| *seq < n_frames) {
                write(topic, make(seq, seq / per_grasp));
            }
        }
        if let Some(seq) = now.checked_sub(90).filter(|seq| seq % per_grasp == 0 && *seq < n_frames) {
            write("/decision", decision(seq / per_grasp));
        }
    }
    let summary = recorder.finish().expect("finished");
    assert!(summary.files.len() > 3, "{summary:?}");
    assert_eq!(summary.files[1], folder.path().join("run-00001.mcap"));
    assert!(!path.exists());
    assert_eq!(summary.n_samples.values().sum::<u64>(), n_written);
    let grasps = files_of_grasps(&summary.files);
    assert_eq!(grasps.len() as u64, n_frames / per_grasp);
    let torn: Vec<_> = grasps.iter().filter(|(_, files)| files.len() > 1).collect();
    assert!(torn.is_empty(), "{torn:?}");

    // Parts of an earlier recording are not accepted as parts of this one.
    assert!(LiveRecorder::create(&path, &info(), split_options(400_000)).is_err());
    let overwriting = LiveOptions { overwrite: true, ..split_options(400_000) };
    LiveRecorder::create(&path, &info(), overwriting).expect("overwritten").finish().expect("finished");
    assert!(summary.files[0].exists() && !summary.files[1].exists());
}

#[test]
fn a_grasp_that_does_not_end_is_split_at_a_frame() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hold.mcap");
    let mut recorder = LiveRecorder::create(&path, &info(), split_options(500_000)).expect("created");
    let n_frames = 6000;
    for now in 0..n_frames + 10 {
        if now < n_frames {
            recorder.write("/tactile", &frame(now, 0)).expect("written");
        }
        if let Some(seq) = now.checked_sub(10) {
            recorder.write("/contacts", &contacts(seq, 0)).expect("written");
        }
    }
    let files = recorder.finish().expect("finished").files;
    assert!(files.len() > 1, "{files:?}");
    let mut next_seq = 0;
    for path in &files {
        let mut seqs: BTreeMap<String, Vec<u64>> = BTreeMap::new();
        for (topic, record) in read(path).expect("whole") {
            seqs.entry(topic).or_default().push(record.header().seq);
        }
        // Both topics have the same numbers, and go on where the file before ended.
        assert_eq!(seqs["/tactile"], seqs["/contacts"]);
        assert_eq!(seqs["/tactile"][0], next_seq);
        next_seq = seqs["/tactile"].last().expect("some") + 1;
    }
    assert_eq!(next_seq, n_frames);
}

/// A file with one channel of any definition, and `n` messages of it.
fn foreign_file(path: &Path, topic: &str, schema: &str, definition: &str, data: &[u8]) {
    let mut writer = mcap::WriteOptions::new()
        .compression(Some(mcap::Compression::Zstd))
        .create(std::io::BufWriter::new(std::fs::File::create(path).expect("created")))
        .expect("begun");
    let metadata = BTreeMap::from(
        [("hand", "h"), ("hand_id", "0"), ("made_by", "m"), ("version", "9.8.7")]
            .map(|(k, v)| (k.to_string(), v.to_string())),
    );
    writer.write_metadata(&mcap::records::Metadata { name: "blindgrasp".into(), metadata }).expect("written");
    let schema_id = writer.add_schema(schema, "ros2msg", definition.as_bytes()).expect("added");
    let channel_id = writer.add_channel(schema_id, topic, "cdr", &BTreeMap::new()).expect("added");
    let header = mcap::records::MessageHeader { channel_id, sequence: 0, log_time: 5, publish_time: 5 };
    writer.write_to_known_channel(&header, data).expect("written");
    writer.finish().expect("finished");
}

#[test]
fn messages_of_another_version_are_refused_and_unknown_ones_passed_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let ours = folder.path().join("ours.mcap");
    written_file(&ours, &[("/prediction", prediction(0, 3))]);
    let bytes = std::fs::read(&ours).expect("read");
    let message = mcap::MessageStream::new(&bytes).expect("MCAP").next().expect("one").expect("whole");
    let schema = message.channel.schema.as_ref().expect("typed");
    let definition = String::from_utf8(schema.data.to_vec()).expect("text");

    let path = folder.path().join("other.mcap");
    // Comments and blanks do not change the version.
    let commented = format!("# another comment\n\n{}", definition.replace("bool stable", "bool   stable  # or not"));
    foreign_file(&path, "/prediction", &schema.name, &commented, &message.data);
    assert_eq!(read(&path).expect("the same")[0].1, prediction(0, 3));

    // Bags of rosbag2: names as ROS 1 wrote them, no definition, messages that are compressed one by one.
    foreign_file(&path, "/prediction", &schema.name.replace("/msg/", "/"), &definition, &message.data);
    assert_eq!(read(&path).expect("the same")[0].1, prediction(0, 3));
    foreign_file(&path, "/prediction", &schema.name, "", &message.data);
    let error = read(&path).expect_err("no definition").to_string();
    assert!(error.contains("no definition") && error.contains("ros2 bag convert"), "{error}");
    foreign_file(&path, "/prediction", &schema.name, &definition, &[0x28, 0xb5, 0x2f, 0xfd, 0, 0]);
    let error = read(&path).expect_err("compressed").to_string();
    assert!(error.contains("--compression-mode message") && !error.contains("--repair"), "{error}");

    let other = definition.replace("bool unsure\n", "float32 unsure\n");
    assert_ne!(other, definition);
    foreign_file(&path, "/grip/prediction", &schema.name, &other, &message.data);
    for error in [
        read(&path).expect_err("another version").to_string(),
        RecordingIndex::open(&path).expect_err("another version").to_string(),
    ] {
        for part in
            ["other.mcap", "/grip/prediction", "'float32 unsure'", "'bool unsure'", "read it with blindgrasp 9.8.7"]
        {
            assert!(error.contains(part), "{error}: no {part}");
        }
    }

    foreign_file(&path, "/camera", "sensor_msgs/msg/Image", "uint32 height", &[0, 1, 0, 0, 7, 0, 0, 0]);
    assert_eq!(read(&path).expect("passed over").len(), 0);
    let camera = &RecordingIndex::open(&path).expect("indexed").topics["/camera"];
    assert_eq!((camera.is_ours, camera.n_messages, camera.schema.as_str()), (false, Some(1), "sensor_msgs/msg/Image"));
}

fn chunk_offsets(path: &Path) -> Vec<u64> {
    let bytes = std::fs::read(path).expect("read");
    let summary = mcap::Summary::read(&bytes).expect("whole").expect("a summary");
    let mut offsets: Vec<_> = summary.chunk_indexes.iter().map(|index| index.chunk_start_offset).collect();
    offsets.sort_unstable();
    offsets
}

/// The length of the chunk there, opcode and all.
fn chunk_bytes(bytes: &[u8], at: usize) -> usize {
    9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8")) as usize
}

/// Damages a recording of 3000 frames and repairs it.
fn repair_after(damage: impl FnOnce(&mut Vec<u8>, &[u64])) -> (RepairReport, Vec<(String, Record)>) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("damaged.mcap");
    live_file(&path, &run_of(3000));
    let offsets = chunk_offsets(&path);
    assert!(offsets.len() > 4, "{offsets:?}");
    let mut bytes = std::fs::read(&path).expect("read");
    damage(&mut bytes, &offsets);
    std::fs::write(&path, &bytes).expect("written");
    // A child of another test has the recorder's lock for a moment, until it begins its program.
    let report = loop {
        match repair(&path) {
            Err(error) if error.to_string().contains("still being recorded") => std::thread::yield_now(),
            ended => break ended.expect("repaired"),
        }
    };
    assert_eq!(report.output, Some(repaired_path(&path)));
    assert!(std::fs::read(&path).expect("read") == bytes, "the original was touched");
    let recovered = read(&repaired_path(&path)).expect("what is repaired is whole");
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    recovered.iter().for_each(|(topic, _)| *counts.entry(topic.clone()).or_default() += 1);
    counts.extend(report.n_recovered.get("/contact_points").map(|n| ("/contact_points".to_string(), *n)));
    assert_eq!(counts, report.n_recovered);
    // The recovered samples are in order and unchanged.
    let mut all = run_of(3000).into_iter();
    for (topic, record) in &recovered {
        assert!(all.any(|(expected_topic, expected)| topic == expected_topic && *record == expected));
    }
    (report, recovered)
}

#[test]
fn a_damaged_chunk_is_left_out_and_its_samples_are_counted() {
    let mut n_lost = Vec::new();
    for cut_summary in [false, true] {
        let (report, _) = repair_after(|bytes, offsets| {
            bytes[offsets[2] as usize + 5000] ^= 4;
            if cut_summary {
                bytes.truncate(bytes.len() - 100);
            }
        });
        assert_eq!((report.n_damaged_chunks, report.has_info, report.has_end), (1, true, !cut_summary), "{report:?}");
        assert_eq!(report.n_recovered["/tactile"] + report.n_lost["/tactile"], 3000);
        assert!(report.n_lost["/tactile"] > 100 && report.has_loss());
        n_lost.push(report.n_lost);
    }
    // With and without the summary: the chunks' own indexes say the same.
    assert_eq!(n_lost[0], n_lost[1]);
}

#[test]
fn records_after_a_damaged_length_are_found_again() {
    let (report, recovered) = repair_after(|bytes, offsets| {
        let at = offsets[1] as usize + 1;
        bytes[at..at + 8].copy_from_slice(&(1_u64 << 60).to_le_bytes());
        bytes.truncate(bytes.len() - 100);
    });
    // Only the record's length was wrong: the chunk has one of its own.
    assert_eq!((report.n_damaged_chunks, recovered.len()), (0, run_of(3000).len()));
    let (report, recovered) = repair_after(|bytes, offsets| {
        // The chunk's header as a whole.
        let at = offsets[1] as usize;
        bytes[at..at + 60].fill(0xff);
        bytes.truncate(bytes.len() - 100);
    });
    assert!(report.n_skipped_bytes > 10_000 && report.has_loss(), "{report:?}");
    assert_eq!(
        report.n_recovered["/tactile"],
        recovered.iter().filter(|(topic, _)| topic == "/tactile").count() as u64
    );
    assert!(recovered.len() > run_of(3000).len() / 2);
}

#[test]
fn the_beginning_of_a_chunk_that_is_cut_off_is_recovered() {
    let (report, recovered) = repair_after(|bytes, offsets| {
        let from = offsets[3] as usize;
        bytes.truncate(from + chunk_bytes(bytes, from) / 4 * 3);
    });
    assert!(report.has_partial_chunk && !report.has_end && report.has_loss(), "{report:?}");
    let (shorter, _) = repair_after(|bytes, offsets| bytes.truncate(offsets[3] as usize));
    assert!(!shorter.has_partial_chunk, "{shorter:?}");
    assert!(shorter.n_unverified.is_empty(), "{shorter:?}");
    let n_more = report.n_recovered["/tactile"] - shorter.n_recovered["/tactile"];
    assert!(n_more > 50 && report.n_unverified["/tactile"] == n_more, "{n_more} more, {report:?}");
    // Without a gap up to the cut.
    let mut problems = Problems::default();
    recovered.iter().for_each(|(topic, record)| problems.add(topic, record));
    assert_eq!(problems.found(), []);
}

#[test]
fn a_channel_without_a_checksum_replaces_no_other_channel() {
    // The summary repeats the channels behind all chunks; there, a topic has changed.
    let (report, recovered) = repair_after(|bytes, offsets| {
        let at = bytes.windows(8).rposition(|found| found == b"/tactile").expect("there");
        bytes[at + 3] ^= 1;
        // The chunk behind it is damaged as well.
        let from = *offsets.last().expect("there") as usize;
        let chunk: Vec<u8> = bytes.drain(from..from + chunk_bytes(bytes, from)).collect();
        bytes.extend(chunk);
    });
    assert!(recovered.len() > 3000);
    assert!(!report.n_recovered.contains_key("/tabtile") && report.n_unverified.is_empty(), "{report:?}");
}

#[test]
fn records_without_a_checksum_are_recovered_and_called_unverified() {
    let (report, _) = repair_after(|bytes, offsets| {
        let checksum_at = offsets[1] as usize + 9 + 24;
        bytes[checksum_at..checksum_at + 4].fill(0);
        bytes.truncate(bytes.len() - 100);
    });
    let (n_unverified, n_recovered) = (report.n_unverified["/tactile"], report.n_recovered["/tactile"]);
    assert!((1..n_recovered).contains(&n_unverified) && n_recovered == 3000, "{report:?}");
    // Of the first chunk, which has the channels of all others.
    let (report, _) = repair_after(|bytes, offsets| {
        let checksum_at = offsets[0] as usize + 9 + 24;
        bytes[checksum_at..checksum_at + 4].fill(0);
        bytes.truncate(bytes.len() - 100);
    });
    assert_eq!((&report.n_unverified, report.has_loss()), (&report.n_recovered, false));
}

#[test]
fn a_recording_without_our_metadata_is_of_an_unknown_hand() {
    let (report, _) = repair_after(|bytes, _| {
        let at = bytes.windows(7).position(|found| found == b"hand_id").expect("there");
        bytes[at] = b'b';
        bytes.truncate(bytes.len() - 100);
    });
    assert!(!report.has_info && !report.has_loss(), "{report:?}");
}

#[test]
fn info_names_oddities_and_foreign_topics() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("odd.mcap");
    let text = path.to_str().expect("UTF-8");
    let mut samples = run_of(30);
    // One frame is missing, one comes twice.
    samples.retain(|(topic, record)| *topic != "/tactile" || record.header().seq != 11);
    samples.push(("/tactile", frame(20, 2)));
    live_file(&path, &samples);
    let (code, stdout, stderr) = info_command(&[text, "--json"]);
    assert_eq!(code, 0, "{stderr}");
    let found: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    let oddities: Vec<_> =
        found["problems"].as_array().expect("a list").iter().map(|problem| &problem["oddity"]).collect();
    assert_eq!(oddities, ["missing_numbers", "repeated_numbers", "stamps_go_back"]);
    assert_eq!((&found["problems"][0]["first_seq"], &found["problems"][0]["n_samples"]), (&11.into(), &1.into()));
    assert_eq!(found["topics"]["/contact_points"]["is_ours"], false);
    assert_eq!(
        (&found["n_samples"]["/contacts"], &found["n_grasps"], &found["is_full"]),
        (&30.into(), &3.into(), &true.into())
    );
    let (_, stdout, _) = info_command(&[text]);
    for part in [
        "others            /contact_points 30 (sensor_msgs/msg/PointCloud2)",
        "/tactile: 1 numbers are missing",
        "duration ",
    ] {
        assert!(stdout.contains(part), "{stdout}: no {part}");
    }
    // Two recordings in one, with times that go back.
    let other = |record: Record| match record {
        Record::Tactile(sample) => {
            Record::Tactile(Stamped { header: Header { epoch: 8, stamp_nanos: 5, ..sample.header }, ..sample })
        }
        other => other,
    };
    let interleaved: Vec<_> =
        (0..10).flat_map(|seq| [("/tactile", frame(seq, 0)), ("/tactile", other(frame(seq, 0)))]).collect();
    written_file(&path, &interleaved);
    let mut problems = Problems::default();
    read(&path).expect("whole").iter().for_each(|(topic, record)| problems.add(topic, record));
    let found: Vec<_> = problems.found().iter().map(|problem| (problem.oddity, problem.n_samples)).collect();
    assert_eq!(found, [(Oddity::EpochComesBack, 18)]);
    let (_, stdout, _) = info_command(&[text]);
    assert!(stdout.contains("two recordings interleaved?"), "{stdout}");
}

#[test]
fn info_counts_what_the_index_does_not_say_and_tells_of_other_hands() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, path) = (folder.path().join("whole.mcap"), folder.path().join("plain.mcap"));
    let mut samples = run_of(30);
    let Record::Tactile(mut of_other_hand) = frame(30, 3) else { panic!("expected a frame") };
    of_other_hand.header.hand_id = 5;
    samples.push(("/tactile", Record::Tactile(of_other_hand)));
    written_file(&whole, &samples);
    let bytes = std::fs::read(&whole).expect("read");
    let file = std::io::BufWriter::new(std::fs::File::create(&path).expect("created"));
    let mut writer = mcap::WriteOptions::new().emit_statistics(false).create(file).expect("begun");
    for message in mcap::MessageStream::new(&bytes).expect("MCAP") {
        writer.write(&message.expect("read")).expect("written");
    }
    writer.finish().expect("finished");
    let arguments = [path.to_str().expect("UTF-8"), "--hand", "barrett-bh8-280"];
    let (code, stdout, stderr) = info_command(&[&arguments[..], &["--json"]].concat());
    assert_eq!(code, 0, "{stderr}");
    let found: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!((&found["n_samples"]["/tactile"], &found["duration_secs"]), (&31.into(), &0.03.into()));
    assert_eq!(found["topics"]["/tactile"]["n_messages"], serde_json::Value::Null);
    let (_, stdout, _) = info_command(&arguments);
    assert!(stdout.contains("1 frames are of other hands than barrett-bh8-280"), "{stdout}");
}

#[test]
fn info_repairs_and_says_with_its_exit_code_whether_something_is_lost() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("cut.mcap");
    let text = path.to_str().expect("UTF-8");
    live_file(&path, &run_of(3000));
    let (code, stdout, _) = info_command(&[text, "--repair"]);
    assert!(code == 0 && stdout.contains("nothing to repair"), "{code}: {stdout}");
    // A name that is not UTF-8.
    let other = folder.path().join(OsStr::from_bytes(b"other\xff.mcap"));
    std::fs::copy(&path, &other).expect("copied");
    let mut command = Command::new(program());
    let output = command.args(["info", "--repair", "--json"]).arg(&other).output().expect("run");
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(found["repairs"][0]["input"], other.to_string_lossy().into_owned());
    let offsets = chunk_offsets(&path);
    let bytes = std::fs::read(&path).expect("read");
    std::fs::write(&path, &bytes[..offsets[2] as usize + 200_000]).expect("written");
    let (code, _, stderr) = info_command(&[text]);
    assert!(code == 1 && stderr.contains("cut.mcap") && stderr.contains("--repair"), "{code}: {stderr}");
    let (code, stdout, _) = info_command(&[text, "--repair", "--json"]);
    let found: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    assert_eq!((code, &found["repairs"][0]["has_partial_chunk"]), (3, &true.into()), "{stdout}");
    let (code, stdout, stderr) = info_command(&[repaired_path(&path).to_str().expect("UTF-8")]);
    assert!(code == 0 && stdout.contains("repair            of: cut.mcap"), "{stdout}{stderr}");
    // Cut off behind a chunk, or within the index behind all samples.
    for (n_bytes, code, says) in [
        (offsets[2] as usize, 3, "end               missing: samples after the last chunk may be lost"),
        (bytes.len() - 100, 0, "end               missing: all samples lie before it"),
    ] {
        std::fs::write(&path, &bytes[..n_bytes]).expect("written");
        std::fs::remove_file(repaired_path(&path)).expect("removed");
        let (found, stdout, _) = info_command(&[text, "--repair"]);
        assert!(found == code && stdout.contains(says), "{found}: {stdout}");
    }
    // No checksum covers the recovered part of a chunk that is cut off.
    std::fs::write(&path, &bytes[..offsets[2] as usize + 200_000]).expect("written");
    std::fs::remove_file(repaired_path(&path)).expect("removed");
    let (_, stdout, _) = info_command(&[text, "--repair"]);
    assert!(stdout.contains("unverified        /contact") && stdout.contains("no checksum tells"), "{stdout}");
    let (code, _, stderr) = info_command(&[text, "--repair"]);
    assert!(code == 1 && stderr.contains("there is a repaired recording"), "{stderr}");
    // A file that is no recording is not repaired.
    let other = folder.path().join("text.mcap");
    std::fs::write(&other, "some text, and not even short").expect("written");
    let (code, _, stderr) = info_command(&[other.to_str().expect("UTF-8"), "--repair"]);
    assert!(code == 1 && stderr.contains("expected an MCAP file") && !repaired_path(&other).exists(), "{stderr}");
}
