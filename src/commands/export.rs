//! `blindgrasp export`

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde_json::json;

use super::{Outcome, check_new, data_on_stdout, print_line};
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_grasps::feature_table::{FeatureTableError, write_feature_table};
use blindgrasp_messages::files::{keep_mode, partial_path, private_file};
use blindgrasp_operator::text::counted;
use blindgrasp_recording::export::{CsvTable, ExportError, row, table_shapes};
use blindgrasp_recording::{Record, RecordingReader, recordings_in};
use blindgrasp_stages::model::Model;

/// Write a recording as JSON lines or CSV, or a table of features
///
/// Write a recording as JSON lines or CSV, or the features that a model sees of recorded grasps.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp export recordings/held-out.mcap --topic /truth\n          \
                        blindgrasp export recordings/held-out.mcap --format csv --out tables/\n          \
                        blindgrasp export data/train --features models/barrett-bh8-280.json --out features.csv\n\n\
                        jsonl: a line is {\"topic\", \"seq\", \"stamp_nanos\", \"data\": {…}}; NaN and infinity are null.\n\
                        csv: a table a topic, with seq, stamp_nanos, epoch and hand_id first; numbers are exact. A list of \
                        numbers that is equally long in all samples is a column per number, joints[0], joints[1], \
                        …; any other list is JSON in one column.\n\
                        features: a row for each grasp with a label and a contact, of its first settled frame: recording, \
                        grasp_id, object, class, stable (1 or 0), hand_id, dictionary_id, then the values as the encoder sends \
                        them, each under its name: hist_3, finger_1.load, spread.position …")]
pub(super) struct Arguments {
    /// The recording (MCAP); with --features, recordings or folders of them.
    #[arg(required = true, value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Only this topic; may be given more than once.
    #[arg(long)]
    topic: Vec<String>,
    /// The format of the output.
    #[arg(long, value_enum, default_value_t = Format::Jsonl)]
    format: Format,
    /// Where to write it; default: stdout. Tables of several topics go to a folder, /a/b as a.b.csv.
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Replace files of these names
    #[arg(long)]
    overwrite: bool,
    /// Write the table of features (CSV) that this model sees of recorded grasps, for other tools to learn from.
    #[arg(long, value_name = "MODEL", requires = "out", conflicts_with_all = ["topic", "format"])]
    features: Option<PathBuf>,
    /// Pad layout of the hand, for --features; default: the built-in hand that the first recording names.
    #[arg(long, requires = "features")]
    hand: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Format {
    /// One JSON object a line, all topics together.
    Jsonl,
    /// A comma-separated table a topic.
    Csv,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let (Some(model), Some(out)) = (&arguments.features, &arguments.out) {
        return export_features(arguments, model, out);
    }
    let [recording] = arguments.recordings.as_slice() else {
        anyhow::bail!("{} recordings: expected one; only --features takes several", arguments.recordings.len());
    };
    match arguments.format {
        Format::Jsonl => export_lines(arguments, recording),
        Format::Csv => export_tables(arguments, recording),
    }
}

fn export_features(arguments: &Arguments, model: &Path, out: &Path) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    let file = NewFile::create(out, &[&recordings[..], &[model.to_path_buf()]].concat(), arguments.overwrite)?;
    let (path, model) = (model, Model::load(model)?);
    let hand = hand_of(first, arguments.hand.as_deref())?;
    if hand.id() != model.hand.id {
        anyhow::bail!(
            "{} is of the hand '{}' ({:016x}), {} of '{}' ({:016x}): expected the same",
            path.display(),
            model.hand.name,
            model.hand.id,
            first.display(),
            hand.name,
            hand.id()
        );
    }
    let written = write_feature_table(&hand, &model, &recordings, BufWriter::new(&file.file));
    let written = written.map_err(|error| match error {
        FeatureTableError::Dataset(of_recordings) => anyhow::Error::from(of_recordings),
        error => anyhow::Error::from(error).context(format!("cannot write {}", out.display())),
    })?;
    file.finish()?;
    let grasps = counted(written.n_rows, "grasp");
    print_line(&format!("{}: {grasps}, {} values each", out.display(), model.features.len()))?;
    for (reason, n) in &written.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    Ok(Outcome::Done)
}

fn export_lines(arguments: &Arguments, recording: &Path) -> anyhow::Result<Outcome> {
    match &arguments.out {
        None => write_lines(recording, &arguments.topic, data_on_stdout())?,
        Some(path) => {
            let file = NewFile::create(path, &[recording.into()], arguments.overwrite)?;
            write_lines(recording, &arguments.topic, &file.file).with_context(|| path.display().to_string())?;
            file.finish()?;
        }
    }
    Ok(Outcome::Done)
}

fn write_lines(recording: &Path, wanted: &[String], to: impl Write) -> anyhow::Result<()> {
    let mut to = BufWriter::new(to);
    let mut topics = BTreeSet::new();
    for record in RecordingReader::open(recording)? {
        let (topic, record) = record?;
        if wanted.is_empty() || wanted.contains(&topic) {
            writeln!(to, "{}", json_line(&topic, &record)?)?;
        }
        topics.insert(topic);
    }
    to.flush()?;
    Ok(ExportError::check_topics(recording, wanted, topics.iter())?)
}

type Table = CsvTable<Box<dyn Write>>;

fn export_tables(arguments: &Arguments, recording: &Path) -> anyhow::Result<Outcome> {
    let shapes = table_shapes(recording, &arguments.topic)?;
    if shapes.is_empty() {
        anyhow::bail!("recording {}: it has no samples of blindgrasp's, so there is no table", recording.display());
    }
    let mut tables: BTreeMap<String, (Table, u64)> = BTreeMap::new();
    let Some(out) = &arguments.out else {
        if shapes.len() > 1 {
            let topics = shapes.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
            anyhow::bail!(
                "recording {}: {topics} are a table each: choose one with --topic, or name a folder for them with --out",
                recording.display()
            );
        }
        for (topic, shape) in &shapes {
            let stdout: Box<dyn Write> = Box::new(BufWriter::new(data_on_stdout()));
            tables.insert(topic.clone(), (CsvTable::new(stdout, shape)?, 0));
        }
        write_tables(recording, tables)?;
        return Ok(Outcome::Done);
    };
    let mut files = Vec::new();
    for (topic, path) in paths_of_topics(out, shapes.keys())? {
        let file = NewFile::create(&path, &[recording.into()], arguments.overwrite)?;
        let to = file.file.try_clone().with_context(|| path.display().to_string())?;
        let to: Box<dyn Write> = Box::new(BufWriter::new(to));
        let table = CsvTable::new(to, &shapes[&topic]).with_context(|| path.display().to_string())?;
        files.push((topic.clone(), file));
        tables.insert(topic, (table, 0));
    }
    let n_rows = write_tables(recording, tables).with_context(|| out.display().to_string())?;
    for (topic, file) in files {
        let path = file.path.display().to_string();
        file.finish()?;
        print_line(&format!("{path}: {} rows", n_rows[&topic]))?;
    }
    Ok(Outcome::Done)
}

/// Writes the recording's samples to their topics' tables. Returns how many rows each has.
fn write_tables(recording: &Path, mut tables: BTreeMap<String, (Table, u64)>) -> anyhow::Result<BTreeMap<String, u64>> {
    for record in RecordingReader::open(recording)? {
        let (topic, record) = record?;
        if let Some((table, n_rows)) = tables.get_mut(&topic) {
            table.write(&row(&record)?).with_context(|| format!("{topic}, seq {}", record.header().seq))?;
            *n_rows += 1;
        }
    }
    tables
        .into_iter()
        .map(|(topic, (table, n_rows))| {
            table.finish()?.flush()?;
            Ok((topic, n_rows))
        })
        .collect()
}

fn paths_of_topics<'a>(
    out: &Path,
    topics: impl ExactSizeIterator<Item = &'a String>,
) -> anyhow::Result<BTreeMap<String, PathBuf>> {
    let is_meant_as_folder = out.is_dir() || out.as_os_str().as_encoded_bytes().ends_with(b"/");
    if topics.len() == 1 && !is_meant_as_folder {
        return Ok(topics.map(|topic| (topic.clone(), out.into())).collect());
    }
    if !out.is_dir() {
        if out.exists() || (!is_meant_as_folder && out.extension().is_some_and(|found| found == "csv")) {
            anyhow::bail!(
                "{}: expected a folder, for a file of each of {} topics; or choose one with --topic",
                out.display(),
                topics.len()
            );
        }
        std::fs::create_dir(out)
            .with_context(|| format!("{}: there is no such folder, and it cannot be made", out.display()))?;
    }
    let mut paths = BTreeMap::new();
    let mut taken: BTreeMap<PathBuf, &String> = BTreeMap::new();
    for topic in topics {
        let path = out.join(format!("{}.csv", topic.trim_matches('/').replace('/', ".")));
        if let Some(other) = taken.insert(path.clone(), topic) {
            anyhow::bail!(
                "{topic} and {other} would both be {}: export one after the other, with --topic",
                path.display()
            );
        }
        paths.insert(topic.clone(), path);
    }
    Ok(paths)
}

/// A file that is written under another name and renamed once complete; if it is dropped before, nothing is left.
struct NewFile {
    path: PathBuf,
    file: File,
    is_finished: bool,
}

impl NewFile {
    fn create(path: &Path, inputs: &[PathBuf], overwrite: bool) -> anyhow::Result<NewFile> {
        let partial = partial_path(path);
        check_new(path, inputs, overwrite)?;
        check_new(&partial, inputs, true)?;
        if path.exists() && !path.is_file() {
            anyhow::bail!("{}: expected a file that can be replaced; leave --out away for a pipe", path.display());
        }
        let file =
            private_file().create(true).truncate(true).open(&partial).with_context(|| partial.display().to_string())?;
        Ok(NewFile { path: path.into(), file, is_finished: false })
    }

    fn finish(mut self) -> anyhow::Result<()> {
        keep_mode(&self.file, &self.path)
            .and_then(|()| std::fs::rename(partial_path(&self.path), &self.path))
            .with_context(|| self.path.display().to_string())?;
        self.is_finished = true;
        Ok(())
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if !self.is_finished {
            let _ = std::fs::remove_file(partial_path(&self.path));
        }
    }
}

/// A sample as a line of JSON.
pub(super) fn json_line(topic: &str, record: &Record) -> serde_json::Result<String> {
    let header = record.header();
    let data = record.to_json()?;
    Ok(json!({
        "topic": topic,
        "seq": header.seq,
        "stamp_nanos": header.stamp_nanos,
        "epoch": header.epoch,
        "hand_id": format!("{:016x}", header.hand_id),
        "data": data,
    })
    .to_string())
}
