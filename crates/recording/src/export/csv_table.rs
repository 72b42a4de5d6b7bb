//! A topic as a CSV file.

use std::io::Write;

use super::row::{Row, Value};
use super::{ExportError, Length, TableShape};

/// A CSV file being written.
///
/// Numbers read back exactly; NaN is `NaN`, infinity `inf`. A list of numbers that has one length throughout is a column
/// per number, `joints_rad[0]`, `joints_rad[1]`, …; any other list is JSON in a cell.
pub struct CsvTable<W: Write> {
    writer: csv::Writer<W>,
    /// For each column of a row, into how many columns of the file it is spread, if it is.
    spread: Vec<Option<usize>>,
}

impl<W: Write> CsvTable<W> {
    /// Begins a file with its line of names.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn new(to: W, shape: &TableShape) -> Result<Self, ExportError> {
        let mut writer = csv::Writer::from_writer(to);
        let spread: Vec<_> = shape.exemplar.iter().map(|(name, value)| n_columns(shape, name, value)).collect();
        for ((name, _), spread) in shape.exemplar.iter().zip(&spread) {
            match spread {
                Some(n) => (0..*n).try_for_each(|idx| writer.write_field(format!("{name}[{idx}]")))?,
                None => writer.write_field(name)?,
            }
        }
        writer.write_record(None::<&[u8]>)?;
        Ok(CsvTable { writer, spread })
    }

    /// Appends a sample.
    ///
    /// # Errors
    /// It cannot be written, or is not like those that the table was made for.
    pub fn write(&mut self, row: &Row) -> Result<(), ExportError> {
        for ((_, value), spread) in row.iter().zip(&self.spread) {
            match (spread, value) {
                (Some(_), Value::List(items)) => {
                    items
                        .iter()
                        .try_for_each(|item| self.writer.write_field(cell(item)?).map_err(ExportError::from))?;
                }
                _ => self.writer.write_field(cell(value)?)?,
            }
        }
        Ok(self.writer.write_record(None::<&[u8]>)?)
    }

    /// Completes the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(mut self) -> Result<W, ExportError> {
        self.writer.flush()?;
        self.writer.into_inner().map_err(|error| error.into_error().into())
    }
}

fn n_columns(shape: &TableShape, name: &str, exemplar: &Value) -> Option<usize> {
    let Value::List(items) = exemplar else { return None };
    let are_numbers =
        matches!(items.first(), Some(Value::I32(_) | Value::I64(_) | Value::U32(_) | Value::U64(_) | Value::F64(_)));
    match shape.lengths.get(name) {
        // A list that is always empty is a column all the same: nothing goes missing without a word.
        Some(Length::Always(n @ 1..)) if are_numbers => Some(*n),
        _ => None,
    }
}

fn cell(value: &Value) -> Result<String, ExportError> {
    Ok(match value {
        Value::Bool(value) => value.to_string(),
        Value::I32(value) => value.to_string(),
        Value::I64(value) => value.to_string(),
        Value::U32(value) => value.to_string(),
        Value::U64(value) => value.to_string(),
        // The fewest digits that read back exactly, with an exponent where plain digits would be many.
        Value::F64(value) => format!("{value:?}"),
        Value::Text(value) => value.clone(),
        Value::List(_) | Value::Struct(_) => {
            serde_json::to_string(value).map_err(|error| ExportError::Shape(error.to_string()))?
        }
    })
}
