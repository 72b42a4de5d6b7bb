//! The import of a table of tactile readings to a recording: one grasp a row, or one frame a row.
//!
//! A row that is a grasp becomes settled frames, all with the row's reading, and a label. Values that the table does not have
//! stay unknown: epsilon and volume are NaN, and there is no scene. Nothing is guessed: a table that does not fit the hand, or a
//! row that cannot be read, is an error.

pub(crate) mod columns;
mod frames;
mod grasps;
pub(crate) mod lines;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Serialize;

pub use self::frames::{FramesReport, import_frames};

use self::columns::{Columns, in_one_line, shortened};
use self::grasps::{Grasps, TableGrasp, TableReading};
use self::lines::{Lines, RowLimit};
use crate::file_name;
use blindgrasp_grasps::shown_hand::shown_hand;
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::open_regular;
use blindgrasp_messages::{GraspTruth, Header, MAX_NAME_BYTES, Phase, Record, Recorded, Stamped, TactileFrame};
use blindgrasp_recording::{RecordingError, RecordingInfo, RecordingWriter};
use blindgrasp_stages::contacts::{LIMIT_TOLERANCE_RAD, MAX_CELL_NEWTONS};
use blindgrasp_stages::day::day_number;
use blindgrasp_stages::hand::{CellUnit, Hand};

/// The first bytes of UTF-8 files by spreadsheets.
pub(crate) const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();
/// The time between two frames of a grasp, as in the simulator.
const PERIOD_NANOS: u64 = 10_000_000;
/// The time between the last frame of a grasp and the first of the next.
const PAUSE_NANOS: u64 = 100_000_000;
/// The size limit of a table: millions of grasps.
const MAX_BYTES: u64 = 1 << 30;
/// No cell of a known sensor for hands reads so much.
const UNLIKELY_NEWTONS: f64 = 200.0;
/// What to do with a table that is not as the import reads it.
pub(crate) const BY_PANDAS: &str = "read it with pandas and give it to blindgrasp.from_table (docs/python.md)";
/// A table with more bad rows is refused without reading on, because they are kept until the end.
const MAX_BAD_ROWS: usize = 1_000_000;
/// The most bad rows that an error shows.
const MAX_SHOWN_ROWS: usize = 20;
/// The most values of the label that an error shows.
const MAX_SHOWN_VALUES: usize = 10;

/// How a table is read. In patterns, `*` stands for any text.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImportOptions {
    /// Patterns of the cells' columns. The columns fill the hand's pads in order: pattern after pattern, and within a pattern
    /// in the table's order. If there is one pattern for each pad, each must fit its pad.
    pub cells: Vec<String>,
    pub joints: Joints,
    /// The column of the label: it has two values.
    pub label: String,
    /// The label's value that means stable, to the letter.
    pub stable_value: String,
    /// The column of the object: training keeps the grasps of an object in one fold.
    pub group: String,
    /// The column of the object's class; without it, the class is the group.
    pub class: Option<String>,
    pub day: Day,
    /// The column that names a row's grasp, if each row is a frame: the rows of a grasp follow each other in order of time.
    pub grasp: Option<String>,
    /// The column of a frame's phase, if each row is a frame; without it, all frames are settled.
    pub phase: Option<String>,
    /// The frames of a grasp that is one row.
    pub n_frames: u32,
    pub first_grasp_id: u64,
}

/// The source of the joint angles.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Joints {
    /// One posture for all grasps, radians in the hand's order.
    Fixed(Vec<f64>),
    /// Patterns of columns of the table, in the hand's order of joints; radians, or metres of joints that slide.
    Columns(Vec<String>),
}

/// The source of the recording day, whose grasps have one baseline.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Day {
    #[default]
    Unknown,
    /// The name or date of the day of the whole table: see [`day_number`].
    Fixed(String),
    /// A column of names or dates.
    Column(String),
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ImportReport {
    pub hand: String,
    /// The unit of the recorded readings.
    pub cell_unit: CellUnit,
    /// Rows of the table, without its header.
    pub n_rows: usize,
    /// Rows with a reading below zero, which counts as 0.
    pub n_below_zero: usize,
    /// Rows with a missing reading, which counts as 0.
    pub n_missing: usize,
    /// Recorded frames.
    pub n_frames: u64,
    pub n_grasps: usize,
    pub n_stable: usize,
    pub first_grasp_id: u64,
    /// The label's values of the recorded grasps.
    pub label_values: BTreeMap<String, usize>,
    pub groups: BTreeMap<String, GroupReport>,
    pub pads: Vec<PadReport>,
    /// The number of each day and of its grasps, by its name; empty if no day is known.
    pub days: BTreeMap<String, DayReport>,
    /// The columns of the joints in the hand's order; empty for a fixed posture.
    pub joint_columns: Vec<String>,
    /// A unit of readings, or an order of columns, that is probably another than the hand's.
    pub warnings: Vec<String>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct GroupReport {
    pub n_grasps: usize,
    pub n_stable: usize,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct DayReport {
    pub day: u32,
    pub n_grasps: usize,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PadReport {
    pub pad: String,
    /// A column for each cell, in the pad's order.
    pub columns: Vec<String>,
}

/// A row that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BadRow {
    /// Its first line in the file, from 1.
    pub line: u64,
    pub problem: String,
}

#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// The table does not fit the options.
    #[error("{}: {message}", path.display())]
    Table { path: PathBuf, message: String },
    #[error(
        "{}: {} of {n_rows} rows cannot be used; mend them, or leave them out with pandas and blindgrasp.from_table:{}",
        path.display(), rows.len(), listed(rows)
    )]
    Rows { path: PathBuf, n_rows: usize, rows: Vec<BadRow> },
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// Writes the grasps of a table (CSV with a header, UTF-8, comma and dot) to a recording at `out`. After an error there is no
/// recording.
///
/// # Errors
/// The table cannot be read, or does not fit hand and options; rows cannot be used; the recording cannot be written.
pub fn import_table(
    table: &Path,
    hand: &Hand,
    options: &ImportOptions,
    out: &Path,
) -> Result<ImportReport, ImportError> {
    let refused = |message: String| ImportError::Table { path: table.into(), message };
    require_forces(hand).map_err(refused)?;
    let bytes = read(table).map_err(|source| ImportError::Read { path: table.into(), source })?;
    if let Some(kind) = FileKind::of(&bytes).filter(|kind| !matches!(kind, FileKind::Table | FileKind::Empty)) {
        return Err(refused(format!("expected a table (CSV), found {}", kind.description())));
    }
    let text = bytes.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&bytes);
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(RowLimit::new(text));
    let header = match reader.headers() {
        Ok(header) => header.iter().map(in_one_line).collect::<Vec<String>>(),
        Err(error) => return Err(table_error(table, error, 1)),
    };
    if header.iter().all(String::is_empty) {
        return Err(refused(
            "the table is empty: expected a line with the columns' names, then a row for each grasp or frame".into(),
        ));
    }
    let columns = Columns::find(&header, hand, options).map_err(refused)?;
    let row_reader = RowReader { header: &header, columns: &columns, hand, options };
    let mut report = row_reader.empty_report();
    let mut writer = GraspWriter::create(table, hand, options, out)?;
    let mut grasps = Grasps::default();
    let largest_reading = import_rows(table, text, reader, &row_reader, &mut grasps, &mut writer, &mut report)?;
    if report.n_rows == 0 {
        return Err(refused("there is no row below the header: expected one for each grasp or frame".into()));
    }
    if !grasps.bad_rows.is_empty() {
        return Err(ImportError::Rows { path: table.into(), n_rows: report.n_rows, rows: grasps.bad_rows });
    }
    check_label(&report.label_values, &grasps.first_lines, options).map_err(refused)?;
    if hand.cell_unit == CellUnit::Newtons && largest_reading > UNLIKELY_NEWTONS {
        report.warnings.push(format!(
            "the largest reading of a cell is {largest_reading:.0} N: if the table is in another unit, convert it to newtons"
        ));
    }
    report.warnings.extend(columns.warnings);
    report.n_frames = writer.header.seq;
    writer.recording.finish()?;
    Ok(report)
}

/// Writes the grasps of all rows, but stops at too many bad ones. Returns the largest reading of a cell.
fn import_rows(
    table: &Path,
    text: &[u8],
    mut reader: csv::Reader<RowLimit<'_>>,
    rows: &RowReader<'_>,
    grasps: &mut Grasps,
    writer: &mut GraspWriter,
    report: &mut ImportReport,
) -> Result<f64, ImportError> {
    let mut lines = Lines::new(text);
    let mut largest_reading = 0.0_f64;
    let mut records = reader.records();
    loop {
        records.reader_mut().get_mut().begin_row();
        let line = lines.line_of(records.reader().position().byte());
        let Some(record) = records.next() else { break };
        report.n_rows += 1;
        let mut name = None;
        let row = match record {
            Ok(record) => {
                name = rows.columns.grasp.map(|idx| record[idx].to_string());
                report.n_below_zero += usize::from(rows.has(&record, is_below_zero));
                report.n_missing += usize::from(rows.has(&record, is_missing));
                rows.read(&record, line).map_err(|problem| BadRow { line, problem })
            }
            Err(error) => Err(bad_row(&error, line).ok_or_else(|| table_error(table, error, line))?),
        };
        if let Ok(grasp) = &row {
            largest_reading = grasp.readings[0].cells.iter().copied().fold(largest_reading, f64::max);
        }
        if let Some(grasp) =
            grasps.add(name, row, line).map_err(|message| ImportError::Table { path: table.into(), message })?
        {
            report.count(&grasp);
            writer.write(grasp)?;
        }
        if grasps.bad_rows.len() > MAX_BAD_ROWS {
            return Ok(largest_reading);
        }
    }
    if let Some(grasp) = grasps.close() {
        report.count(&grasp);
        writer.write(grasp)?;
    }
    Ok(largest_reading)
}

/// A table and a bridge's lines hold readings as they are, of which nobody knows the zero.
fn require_forces(hand: &Hand) -> Result<(), String> {
    match hand.pads.iter().find(|pad| pad.falls_under_load) {
        Some(pad) => Err(format!(
            "the readings of pad '{}' fall under load: subtract each from that of the open hand, and give a layout without \
             falls_under_load",
            pad.name
        )),
        None => Ok(()),
    }
}

fn is_below_zero(reading: &str) -> bool {
    reading.parse().is_ok_and(|reading: f64| reading < 0.0)
}

fn is_missing(reading: &str) -> bool {
    matches!(reading, "" | "null") || reading.parse().is_ok_and(f64::is_nan)
}

/// Reads rows. Errors do not name the line.
struct RowReader<'a> {
    header: &'a [String],
    columns: &'a Columns,
    hand: &'a Hand,
    options: &'a ImportOptions,
}

impl RowReader<'_> {
    fn read(&self, record: &csv::StringRecord, line: u64) -> Result<TableGrasp, String> {
        let options = self.options;
        let label = &record[self.columns.label];
        if label.is_empty() {
            return Err(format!("column '{}': expected a label, found nothing", options.label));
        }
        let object = self.name(record, self.columns.group)?;
        let class = self.columns.class.map_or(Ok(object.clone()), |class| self.name(record, class))?;
        let mut cells = Vec::new();
        for (idx, (pad_idx, cell)) in self.columns.cells.iter().zip(self.hand.cells()) {
            let may_be_missing = self.hand.pads[pad_idx].may_be_missing;
            cells.push(self.reading(record, *idx, cell.noise_threshold_newtons, may_be_missing)?);
        }
        let joints = match &options.joints {
            Joints::Fixed(joints) => joints.clone(),
            Joints::Columns(_) => (0..self.columns.joints.len())
                .map(|joint_idx| self.joint_value(record, joint_idx))
                .collect::<Result<_, _>>()?,
        };
        let day = match (&options.day, self.columns.day) {
            (Day::Fixed(name), _) => Some(name.clone()),
            (_, Some(idx)) => Some(self.name(record, idx)?),
            _ => None,
        };
        let day = day.map(|name| (name.clone(), day_number(&name)));
        let phase = match self.columns.phase {
            None => Phase::Settled,
            Some(idx) => Phase::ALL.iter().copied().find(|phase| phase.as_str() == &record[idx]).ok_or_else(|| {
                let words = Phase::ALL.iter().map(|phase| phase.as_str()).collect::<Vec<_>>().join(", ");
                format!("column '{}': expected a phase ({words}), found {}", self.header[idx], found(&record[idx]))
            })?,
        };
        if let Some(idx) = self.columns.grasp.filter(|idx| record[*idx].is_empty()) {
            return Err(format!("column '{}': expected the name of a grasp, found nothing", self.header[idx]));
        }
        let (readings, label) = (vec![TableReading { phase, cells, joints }], label.to_string());
        let stable = label == options.stable_value;
        Ok(TableGrasp { line, readings, label, stable, object, class, day })
    }

    fn name(&self, record: &csv::StringRecord, idx: usize) -> Result<String, String> {
        let (column, name) = (&self.header[idx], &record[idx]);
        match name.len() {
            0 => Err(format!("column '{column}': expected a name, found nothing")),
            n_bytes if n_bytes > MAX_NAME_BYTES => Err(format!(
                "column '{column}': expected a name of at most {MAX_NAME_BYTES} bytes, found {n_bytes} ('{}')",
                shortened(name)
            )),
            _ => Ok(name.into()),
        }
    }

    fn reading(
        &self,
        record: &csv::StringRecord,
        idx: usize,
        threshold: f64,
        may_be_missing: bool,
    ) -> Result<f64, String> {
        let reading: Option<f64> = record[idx].parse().ok();
        let is_missing = is_missing(&record[idx]);
        if is_missing && may_be_missing {
            return Ok(0.0);
        }
        // Sensors that are tared read a little below zero. The stages take larger readings for those of a broken sensor.
        if let Some(usable) = reading.filter(|reading| (-threshold..=MAX_CELL_NEWTONS).contains(reading)) {
            return Ok(usable.max(0.0));
        }
        let (column, found) = (&self.header[idx], found(&record[idx]));
        let mut advice = String::new();
        if is_missing {
            advice = "; a pad whose cells may be missing says may_be_missing in the hand's layout".into();
        } else if reading.is_some_and(|reading| reading < 0.0) {
            advice = format!("; take readings below zero for 0: {BY_PANDAS}");
        } else if record[idx].replace(',', ".").parse::<f64>().is_ok() && reading.is_none() {
            advice = format!("; the decimal point is a dot: {BY_PANDAS}");
        }
        Err(format!("column '{column}': expected a number from 0 to {MAX_CELL_NEWTONS}, found {found}{advice}"))
    }

    /// Whether a row has such a reading, which counts as 0 if the row can be used.
    fn has(&self, record: &csv::StringRecord, is_such: fn(&str) -> bool) -> bool {
        self.columns.cells.iter().any(|idx| record.get(*idx).is_some_and(is_such))
    }

    fn joint_value(&self, record: &csv::StringRecord, joint_idx: usize) -> Result<f64, String> {
        let idx = self.columns.joints[joint_idx];
        let joint = &self.hand.joints[joint_idx];
        let value: Option<f64> = record[idx].parse().ok();
        if let Some(usable) = value.filter(|value| joint.allows(*value, LIMIT_TOLERANCE_RAD)) {
            return Ok(usable);
        }
        let tolerance = LIMIT_TOLERANCE_RAD * joint.kind.per_radian();
        let mut advice = String::new();
        if value.is_some_and(|value| joint.degrees_hint(value).is_some()) {
            advice = format!("; convert degrees to radians: {BY_PANDAS}");
        }
        Err(format!(
            "column '{}': expected {:.3} to {:.3} {} for the joint {}, found {}{advice}",
            self.header[idx],
            joint.lower - tolerance,
            joint.upper + tolerance,
            joint.kind.unit(),
            joint.name,
            found(&record[idx])
        ))
    }

    fn empty_report(&self) -> ImportReport {
        let names = |idxs: &[usize]| idxs.iter().map(|idx| self.header[*idx].clone()).collect::<Vec<String>>();
        let pads = self.hand.pads.iter().map(|pad| PadReport {
            pad: pad.name.clone(),
            columns: names(&self.columns.cells[pad.first_cell_idx..][..pad.cells.len()]),
        });
        ImportReport {
            hand: self.hand.name.clone(),
            cell_unit: self.hand.cell_unit,
            first_grasp_id: self.options.first_grasp_id,
            pads: pads.collect(),
            joint_columns: names(&self.columns.joints),
            ..ImportReport::default()
        }
    }
}

impl ImportReport {
    fn count(&mut self, grasp: &TableGrasp) {
        if let Some((name, day)) = &grasp.day {
            self.days.entry(name.clone()).or_insert(DayReport { day: *day, n_grasps: 0 }).n_grasps += 1;
        }
        *self.label_values.entry(grasp.label.clone()).or_default() += 1;
        let group = self.groups.entry(grasp.object.clone()).or_default();
        for (n_grasps, n_stable) in
            [(&mut self.n_grasps, &mut self.n_stable), (&mut group.n_grasps, &mut group.n_stable)]
        {
            *n_grasps += 1;
            *n_stable += usize::from(grasp.stable);
        }
    }
}

/// Turns grasps into a recording: numbers, times, headers.
struct GraspWriter {
    recording: RecordingWriter,
    header: Header,
    grasp_id: u64,
    /// How often a reading is repeated.
    n_frames: u32,
    n_grasps: u64,
}

impl GraspWriter {
    fn create(table: &Path, hand: &Hand, options: &ImportOptions, out: &Path) -> Result<Self, ImportError> {
        let name = file_name(table);
        let how = serde_json::to_string(options)
            .map_err(|error| ImportError::Read { path: table.into(), source: error.into() })?;
        let info = RecordingInfo {
            hand: hand.name.clone(),
            hand_id: hand.id(),
            made_by: format!("import of {name} with {how}"),
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let mut recording = RecordingWriter::create(out, &info)?;
        recording.show(shown_hand(hand))?;
        Ok(GraspWriter {
            recording,
            header: Header { hand_id: hand.id(), ..Header::default() },
            grasp_id: options.first_grasp_id,
            n_frames: if options.grasp.is_some() { 1 } else { options.n_frames },
            n_grasps: 0,
        })
    }

    fn write(&mut self, grasp: TableGrasp) -> Result<(), RecordingError> {
        let truth = GraspTruth {
            grasp_id: self.grasp_id,
            epsilon: f64::NAN,
            volume: f64::NAN,
            stable: grasp.stable,
            object: grasp.object,
            object_class: grasp.class,
        };
        let header = Header { seq: self.n_grasps, ..self.header };
        self.recording.write(GraspTruth::TOPIC, &Stamped { header, message: truth })?;
        let day = grasp.day.map_or(0, |(_, day)| day);
        for TableReading { phase, cells: cells_newtons, joints } in grasp.readings {
            let message =
                TactileFrame { grasp_id: self.grasp_id, phase, joints, cells_newtons, day, ..TactileFrame::default() };
            for _ in 0..self.n_frames {
                let sample = Record::Tactile(Stamped { header: self.header, message: message.clone() });
                self.recording.write_record(TactileFrame::TOPIC, &sample)?;
                self.header.seq += 1;
                self.header.stamp_nanos += PERIOD_NANOS;
            }
        }
        self.header.stamp_nanos += PAUSE_NANOS;
        self.grasp_id += 1;
        self.n_grasps += 1;
        Ok(())
    }
}

/// `values` counts the rows of each value, `first_lines` says where it stands first.
fn check_label(
    values: &BTreeMap<String, usize>,
    first_lines: &BTreeMap<String, u64>,
    options: &ImportOptions,
) -> Result<(), String> {
    if values.len() == 2 && values.contains_key(&options.stable_value) {
        return Ok(());
    }
    let mut by_count: Vec<_> = values.iter().collect();
    by_count.sort_by_key(|(_, n)| std::cmp::Reverse(**n));
    let show = |(value, n): &(&String, &usize)| {
        let line = first_lines.get(*value).copied().unwrap_or_default();
        format!("'{}' in {n} (line {line} first)", shortened(value))
    };
    let shown: Vec<_> = by_count.iter().take(MAX_SHOWN_VALUES).map(show).collect();
    let n_more = values.len().saturating_sub(MAX_SHOWN_VALUES);
    let more = if n_more > 0 { format!(" and {n_more} values more") } else { String::new() };
    Err(format!(
        "column '{}': expected two values, one of them '{}' (--stable-value) to the letter; rows have {}{more}",
        options.label,
        options.stable_value,
        shown.join(", ")
    ))
}

/// A field as an error shows it.
pub(crate) fn found(field: &str) -> String {
    if field.is_empty() { "nothing".into() } else { format!("'{}'", shortened(field)) }
}

/// The bytes of a table, of at most [`MAX_BYTES`].
pub(crate) fn read(table: &Path) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_regular(table)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(std::io::Error::other("more than 1 GiB: expected a table (CSV); split it"));
    }
    Ok(bytes)
}

/// The bad row of an error; `None` if the whole file failed.
pub(crate) fn bad_row(error: &csv::Error, line: u64) -> Option<BadRow> {
    let problem = match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("expected {expected_len} fields, as the header has, found {len}")
        }
        csv::ErrorKind::Utf8 { err, .. } => format!("field {}: expected UTF-8", err.field() + 1),
        _ => return None,
    };
    Some(BadRow { line, problem })
}

/// Why the row that begins on a line cannot be read.
fn table_error(table: &Path, error: csv::Error, line: u64) -> ImportError {
    let message = match error.kind() {
        csv::ErrorKind::Utf8 { .. } => format!("line 1: expected a table (CSV) in UTF-8; for another one: {BY_PANDAS}"),
        _ => format!("line {line}: {error}"),
    };
    ImportError::Table { path: table.into(), message }
}

/// The rows of an error, line by line.
fn listed(rows: &[BadRow]) -> String {
    let shown: String =
        rows.iter().take(MAX_SHOWN_ROWS).map(|row| format!("\n  line {}: {}", row.line, row.problem)).collect();
    match rows.len().saturating_sub(MAX_SHOWN_ROWS) {
        0 => shown,
        n_more => format!("{shown}\n  and {n_more} more"),
    }
}
