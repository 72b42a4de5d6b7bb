//! A topic as a CSV file.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use super::ExportError;
use super::value::{Row, Value, row};
use crate::RecordingReader;

/// The columns of a topic's table.
#[derive(Debug, Clone)]
pub struct TableShape {
    type_name: &'static str,
    columns: Vec<Column>,
}

#[derive(Debug, Clone)]
struct Column {
    name: &'static str,
    /// The length of a list of numbers that is equally long in all samples: each number has a column of the file.
    n_numbers: Option<usize>,
}

/// A CSV file being written.
///
/// Numbers read back exactly; NaN is `NaN`, infinity `inf`. A list of numbers that is equally long in all samples is a
/// column per number, `joints[0]`, `joints[1]`, …; any other list is JSON in one column.
pub struct CsvTable<W: Write> {
    writer: csv::Writer<W>,
    columns: Vec<Column>,
}

/// Reads a recording and returns the shapes of the tables of the topics `wanted`; of all topics if `wanted` is empty.
///
/// # Errors
/// The recording cannot be read, a wanted topic is not in it, or a topic holds messages of several types.
pub fn table_shapes(path: &Path, wanted: &[String]) -> Result<BTreeMap<String, TableShape>, ExportError> {
    let mut found: BTreeMap<String, Option<TableShape>> = BTreeMap::new();
    for record in RecordingReader::open(path)? {
        let (topic, record) = record?;
        if !wanted.is_empty() && !wanted.contains(&topic) {
            found.entry(topic).or_default();
            continue;
        }
        let (type_name, row) = (record.type_name(), row(&record)?);
        match found.entry(topic.clone()).or_default() {
            Some(shape) if shape.type_name != type_name => {
                let (path, first) = (path.into(), shape.type_name);
                return Err(ExportError::TwoTypes { path, topic, first, second: type_name });
            }
            Some(shape) => {
                for (column, (_, value)) in shape.columns.iter_mut().zip(&row) {
                    column.n_numbers = column.n_numbers.filter(|n| n_numbers(value) == Some(*n));
                }
            }
            none => {
                let columns = row.iter().map(|(name, value)| Column { name, n_numbers: n_numbers(value) }).collect();
                *none = Some(TableShape { type_name, columns });
            }
        }
    }
    ExportError::check_topics(path, wanted, found.keys())?;
    Ok(found.into_iter().filter_map(|(topic, shape)| Some((topic, shape?))).collect())
}

impl<W: Write> CsvTable<W> {
    /// Begins a file with its line of names.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn new(to: W, shape: &TableShape) -> Result<Self, ExportError> {
        let mut writer = csv::Writer::from_writer(to);
        for Column { name, n_numbers } in &shape.columns {
            match n_numbers {
                Some(n) => (0..*n).try_for_each(|idx| writer.write_field(format!("{name}[{idx}]")))?,
                None => writer.write_field(name)?,
            }
        }
        writer.write_record(None::<&[u8]>)?;
        Ok(CsvTable { writer, columns: shape.columns.clone() })
    }

    /// Appends a sample.
    ///
    /// # Errors
    /// The file cannot be written, or the row has not the table's columns.
    pub fn write(&mut self, row: &Row) -> Result<(), ExportError> {
        for ((_, value), column) in row.iter().zip(&self.columns) {
            match (column.n_numbers, value) {
                (Some(_), Value::List(items)) => {
                    items.iter().try_for_each(|item| self.writer.write_field(item.to_string()))?;
                }
                _ => self.writer.write_field(value.to_string())?,
            }
        }
        Ok(self.writer.write_record(None::<&[u8]>)?)
    }

    /// Completes the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<W, ExportError> {
        self.writer.flush()?;
        self.writer.into_inner().map_err(|error| error.into_error().into())
    }
}

/// The length of a list of numbers. An empty list is `None`: it keeps a column of its own.
fn n_numbers(value: &Value) -> Option<usize> {
    match value {
        Value::List(items) => match items.first()? {
            Value::Signed(_) | Value::Unsigned(_) | Value::Float(_) => Some(items.len()),
            _ => None,
        },
        _ => None,
    }
}
