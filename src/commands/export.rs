//! `blindgrasp export`

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use csv::StringRecord;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{Outcome, check_new, completions, data_on_stdout, print_line};
use blindgrasp_cli::shard::{Place, Shard, hash, merge_files};
use blindgrasp_grasps::dataset::{hand_of_all, label_of};
use blindgrasp_grasps::feature_table::{COLUMNS, FeatureTable, merge_feature_rows, write_feature_table};
use blindgrasp_messages::files::{keep_mode, open_regular, partial_path, private_file};
use blindgrasp_operator::text::counted;
use blindgrasp_recording::{Record, RecordingReader, recordings_in};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::training_summary::ReadingId;

/// Write a recording as JSON lines, or a table of features
///
/// Write a recording as JSON lines, or the features that a model sees of recorded grasps.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp export recordings/held-out.mcap --topic /truth\n          \
                        blindgrasp export data/train --features models/barrett-bh8-280.json --out features.csv\n\n\
                        A line is {\"topic\", \"seq\", \"stamp_nanos\", \"data\": {…}}; NaN and infinity are null. \
                        One of a label also says what stable means, if that is known: label is lift or wrench-space.\n\
                        features: a row for each grasp with a label and a contact, of its first settled frame: recording, \
                        grasp_id, object, object_class, stable (1 or 0), hand_id, dictionary_id, then the values as the encoder \
                        sends them, each under its name: hist_3, finger_1.load, spread.position …")]
pub(super) struct Arguments {
    /// The recording (MCAP); with --features, recordings or folders of them.
    #[arg(required_unless_present = "merge", value_name = "RECORDING")]
    recordings: Vec<PathBuf>,
    /// Only this topic; may be given more than once.
    #[arg(long)]
    topic: Vec<String>,
    /// Where to write it; default: stdout.
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Replace files of these names
    #[arg(long)]
    overwrite: bool,
    /// Write the table of features (CSV) that this model sees of recorded grasps, for other tools to learn from.
    #[arg(long, value_name = "MODEL", requires = "out", conflicts_with = "topic")]
    features: Option<PathBuf>,
    /// With --features, take only every N-th recording, from the I-th on (0/N to N-1/N). The table's first line has the shard's
    /// place in the whole (JSON), and the header follows.
    #[arg(long, value_name = "I/N", requires = "features")]
    shard: Option<Shard>,
    /// Merge the tables of all shards into that of the whole.
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "out",
          conflicts_with_all = ["recordings", "topic", "features", "shard", "hand"])]
    merge: Vec<PathBuf>,
    /// Pad layout of the hand, for --features; default: that of the first recording, if its name is a built-in one.
    #[arg(long, requires = "features", add = completions::hands())]
    hand: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let made = match (&arguments.features, &arguments.out) {
        (Some(model), Some(out)) => Some(export_features(arguments, model, out)),
        (None, Some(out)) if !arguments.merge.is_empty() => Some(merge_features(arguments, out)),
        _ => None,
    };
    if let (Some(made), Some(out)) = (made, &arguments.out) {
        return made.with_context(|| format!("cannot make {}", out.display()));
    }
    let [recording] = arguments.recordings.as_slice() else {
        anyhow::bail!("{} recordings: expected one; only --features takes several", arguments.recordings.len());
    };
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

fn export_features(arguments: &Arguments, model: &Path, out: &Path) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let file = NewFile::create(out, &[&recordings[..], &[model.to_path_buf()]].concat(), arguments.overwrite)?;
    let model = Model::load(model)?;
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    model.check_hand(&hand).with_context(|| recordings[0].display().to_string())?;
    let shard = arguments.shard.unwrap_or_default();
    // The rows of a shard wait for the line before them, which counts them.
    let (mut rows, mut to_file) = (Vec::new(), BufWriter::new(&file.file));
    let to: &mut dyn Write = if arguments.shard.is_some() { &mut rows } else { &mut to_file };
    let table = write_feature_table(&hand, &model, &recordings, |idx| shard.has(idx), to)?;
    if arguments.shard.is_some() {
        let place = Place::new(shard, (model.hand.id, model.dictionary_id(), hand.description_id()), &recordings);
        let place = place.of_output(table.readings.iter().map(Vec::len).collect(), hash(&rows));
        let FeatureTable { readings, n_excluded } = &table;
        let placed = PlacedTable { place, readings: readings.concat(), n_excluded: n_excluded.clone() };
        writeln!(to_file, "{}", serde_json::to_string(&placed)?)?;
        to_file.write_all(&rows)?;
    }
    to_file.flush()?;
    drop(to_file);
    file.finish()?;
    print_table(out, &table, model.features.len())
}

/// The first line of a shard's table.
#[derive(Serialize, Deserialize)]
struct PlacedTable {
    #[serde(flatten)]
    place: Place,
    /// The reading of each row: the whole leaves out those that an earlier grasp has.
    readings: Vec<ReadingId>,
    n_excluded: BTreeMap<String, usize>,
}

fn merge_features(arguments: &Arguments, out: &Path) -> anyhow::Result<Outcome> {
    const EXPECTED: &str = "expected a whole table of export --features --shard I/N";
    let file = NewFile::create(out, &arguments.merge, arguments.overwrite)?;
    let (mut header, mut n_excluded) = (StringRecord::new(), BTreeMap::new());
    let rows = merge_files(&arguments.merge, |path| {
        let mut text = BufReader::new(open_regular(path)?);
        let (mut line, mut rows) = (String::new(), Vec::new());
        text.read_line(&mut line).context(EXPECTED)?;
        text.read_to_end(&mut rows)?;
        let of_shard: PlacedTable = serde_json::from_str(&line).context(EXPECTED)?;
        let content_id = hash(&rows);
        let mut table = csv::Reader::from_reader(rows.as_slice());
        header.clone_from(table.headers().context(EXPECTED)?);
        let rows = table.records().collect::<Result<Vec<_>, _>>().context(EXPECTED)?;
        anyhow::ensure!(
            header.iter().take(COLUMNS.len()).eq(COLUMNS) && rows.len() == of_shard.readings.len(),
            EXPECTED
        );
        for (reason, n) in of_shard.n_excluded {
            *n_excluded.entry(reason).or_default() += n;
        }
        Ok((of_shard.place, content_id, of_shard.readings.into_iter().zip(rows).collect()))
    })?;
    let table = merge_feature_rows(&header, rows, n_excluded, BufWriter::new(&file.file))?;
    file.finish()?;
    print_table(out, &table, header.len() - COLUMNS.len())
}

fn print_table(out: &Path, table: &FeatureTable, n_values: usize) -> anyhow::Result<Outcome> {
    let grasps = counted(table.readings.iter().map(Vec::len).sum::<usize>(), "grasp");
    print_line(&format!("{}: {grasps}, {n_values} values each", out.display()))?;
    for (reason, n) in &table.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    Ok(Outcome::Done)
}

fn write_lines(recording: &Path, wanted: &[String], to: impl Write) -> anyhow::Result<()> {
    let mut to = BufWriter::new(to);
    let mut topics = BTreeSet::new();
    let reader = RecordingReader::open(recording)?;
    let label = label_of(recording, &reader)?;
    for record in reader {
        let (topic, record) = record?;
        if wanted.is_empty() || wanted.contains(&topic) {
            let mut line = json_of(&topic, &record)?;
            if let (Some(label), Record::Truth(_)) = (label, &record) {
                line["label"] = label.word().into();
            }
            writeln!(to, "{line}")?;
        }
        topics.insert(topic);
    }
    to.flush()?;
    for topic in wanted {
        if !topics.contains(topic) {
            let found = if topics.is_empty() { "none at all".into() } else { Vec::from_iter(topics).join(", ") };
            anyhow::bail!(
                "recording {}: it has no samples of blindgrasp's under {topic}: expected a topic of the recording, found {found}",
                recording.display()
            );
        }
    }
    Ok(())
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

/// A sample as JSON.
pub(super) fn json_of(topic: &str, record: &Record) -> serde_json::Result<Value> {
    let header = record.header();
    let data = record.to_json()?;
    Ok(json!({
        "topic": topic,
        "seq": header.seq,
        "stamp_nanos": header.stamp_nanos,
        "epoch": header.epoch,
        "hand_id": format!("{:016x}", header.hand_id),
        "data": data,
    }))
}
