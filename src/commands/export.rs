//! `blindgrasp export`

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde_json::json;

use super::{Outcome, check_output, print_line};
use blindgrasp_messages::files::partial_path;
use blindgrasp_recording::export::{CsvTable, ExportError, ParquetTable, Row, TableShape, row, survey};
use blindgrasp_recording::{RecordingReader, present_topic};

/// Write a recording as JSON lines, CSV or Parquet.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp export recordings/held-out.mcap --topic /truth\n          \
                        blindgrasp export recordings/held-out.mcap --format parquet --out tables/\n\n\
                        jsonl: a line is {\"topic\", \"seq\", \"stamp_nanos\", \"data\": {…}}; what JSON cannot say (NaN, \
                        infinity) is null.\n\
                        csv: a table a topic. A list of numbers that has one length throughout is a column per number, \
                        joints_rad[0], joints_rad[1], …; any other list is JSON in a cell.\n\
                        parquet: a table a topic, lists and structs as nested columns.\n\
                        Both begin with seq, stamp_nanos, epoch and hand_id; numbers are exact.")]
pub(super) struct Arguments {
    /// The recording (MCAP).
    recording: PathBuf,
    /// Only this topic; may be given more than once.
    #[arg(long, value_parser = |topic: &str| Ok::<_, String>(present_topic(topic).to_string()))]
    topic: Vec<String>,
    /// What to write.
    #[arg(long, value_enum, default_value_t = Format::Jsonl)]
    format: Format,
    /// Where to write it; default: stdout. Tables of several topics go to a folder, /a/b as a.b.csv.
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Format {
    /// One JSON object a line, all topics in one.
    Jsonl,
    /// A comma-separated table a topic.
    Csv,
    /// A Parquet file a topic, compressed with zstd.
    Parquet,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match arguments.format {
        Format::Jsonl => export_lines(arguments),
        Format::Csv | Format::Parquet => export_tables(arguments),
    }
}

fn export_lines(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let Arguments { recording, topic: wanted, out, .. } = arguments;
    match out {
        None => write_lines(recording, wanted, std::io::stdout().lock())?,
        Some(path) => {
            let file = NewFile::create(path, recording)?;
            write_lines(recording, wanted, &file.file).with_context(|| path.display().to_string())?;
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
            let header = record.header();
            let line = json!({
                "topic": topic,
                "seq": header.seq,
                "stamp_nanos": header.stamp_nanos,
                "data": record.to_json()?,
            });
            writeln!(to, "{line}")?;
        }
        topics.insert(topic);
    }
    to.flush()?;
    match wanted.iter().find(|topic| !topics.contains(*topic)) {
        None => Ok(()),
        Some(missing) => {
            let (path, wanted, found) = (recording.into(), missing.clone(), topics.into_iter().collect());
            Err(ExportError::NoTopic { path, wanted, found }.into())
        }
    }
}

fn export_tables(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let Arguments { recording, topic: wanted, format, out } = arguments;
    let shapes = survey(recording, wanted)?;
    if shapes.is_empty() {
        anyhow::bail!("recording {}: it has no samples of blindgrasp's, so there is no table", recording.display());
    }
    let Some(out) = out else {
        let topics = shapes.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
        if !matches!(format, Format::Csv) {
            anyhow::bail!("Parquet is no text: name a file for it with --out");
        }
        if shapes.len() > 1 {
            anyhow::bail!(
                "recording {}: {topics} are a table each: choose one with --topic, or name a folder for them with --out",
                recording.display()
            );
        }
        let tables = shapes.iter().map(|(topic, shape)| {
            let stdout: Box<dyn Write + Send> = Box::new(BufWriter::new(std::io::stdout()));
            Ok((topic.clone(), (Table::new(*format, stdout, shape)?, 0)))
        });
        write_tables(recording, tables.collect::<anyhow::Result<_>>()?)?;
        return Ok(Outcome::Done);
    };
    let (mut files, mut tables) = (Vec::new(), BTreeMap::new());
    for (topic, path) in places(out, shapes.keys(), *format)? {
        let file = NewFile::create(&path, recording)?;
        let to = file.file.try_clone().with_context(|| path.display().to_string())?;
        let table = Table::new(*format, Box::new(BufWriter::new(to)), &shapes[&topic])
            .with_context(|| path.display().to_string())?;
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

enum Table {
    Csv(CsvTable<Box<dyn Write + Send>>),
    Parquet(ParquetTable<Box<dyn Write + Send>>),
}

impl Table {
    fn new(format: Format, to: Box<dyn Write + Send>, shape: &TableShape) -> Result<Table, ExportError> {
        Ok(match format {
            Format::Parquet => Table::Parquet(ParquetTable::new(to, shape)?),
            Format::Csv | Format::Jsonl => Table::Csv(CsvTable::new(to, shape)?),
        })
    }

    fn write(&mut self, row: &Row) -> Result<(), ExportError> {
        match self {
            Table::Csv(table) => table.write(row),
            Table::Parquet(table) => table.write(row),
        }
    }

    fn finish(self) -> anyhow::Result<()> {
        let mut to = match self {
            Table::Csv(table) => table.finish()?,
            Table::Parquet(table) => table.finish()?,
        };
        Ok(to.flush()?)
    }
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
            table.finish()?;
            Ok((topic, n_rows))
        })
        .collect()
}

/// The file of each topic.
fn places<'a>(
    out: &Path,
    topics: impl ExactSizeIterator<Item = &'a String>,
    format: Format,
) -> anyhow::Result<BTreeMap<String, PathBuf>> {
    let extension = match format {
        Format::Jsonl => "jsonl",
        Format::Csv => "csv",
        Format::Parquet => "parquet",
    };
    let is_meant_as_folder = out.is_dir() || out.as_os_str().as_encoded_bytes().ends_with(b"/");
    if topics.len() == 1 && !is_meant_as_folder {
        return Ok(topics.map(|topic| (topic.clone(), out.into())).collect());
    }
    if !out.is_dir() {
        if out.exists() || (!is_meant_as_folder && out.extension().is_some_and(|found| found == extension)) {
            anyhow::bail!(
                "{}: expected a folder, for a file of each of {} topics; or choose one with --topic",
                out.display(),
                topics.len()
            );
        }
        std::fs::create_dir(out)
            .with_context(|| format!("{}: there is no such folder, and it cannot be made", out.display()))?;
    }
    let mut places = BTreeMap::new();
    let mut taken: BTreeMap<PathBuf, &String> = BTreeMap::new();
    for topic in topics {
        let path = out.join(format!("{}.{extension}", topic.trim_matches('/').replace('/', ".")));
        if let Some(other) = taken.insert(path.clone(), topic) {
            anyhow::bail!(
                "{topic} and {other} would both be {}: export one after the other, with --topic",
                path.display()
            );
        }
        places.insert(topic.clone(), path);
    }
    Ok(places)
}

/// A file that is written beside its place and takes it once complete; given up, it leaves nothing.
struct NewFile {
    path: PathBuf,
    file: File,
    is_finished: bool,
}

impl NewFile {
    fn create(path: &Path, input: &Path) -> anyhow::Result<NewFile> {
        let partial = partial_path(path);
        for written in [path, &partial] {
            check_output(written, &[input.into()])?;
        }
        if path.exists() && !path.is_file() {
            anyhow::bail!("{}: expected a file that can be replaced; leave --out away for a pipe", path.display());
        }
        let file = File::create(&partial).with_context(|| partial.display().to_string())?;
        Ok(NewFile { path: path.into(), file, is_finished: false })
    }

    fn finish(mut self) -> anyhow::Result<()> {
        std::fs::rename(partial_path(&self.path), &self.path).with_context(|| self.path.display().to_string())?;
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
