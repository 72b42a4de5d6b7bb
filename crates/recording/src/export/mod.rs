//! Recordings as CSV tables, for pandas, polars, DuckDB and spreadsheets: a topic is a table, a sample a row.
//!
//! The columns are the header's fields, then the message's, as serde finds them: a new field of a message becomes a column
//! by itself. JSON lines are made by [`Record::to_json`](crate::Record::to_json).

mod csv_table;
mod value;

use std::path::{Path, PathBuf};

use crate::RecordingError;

pub use csv_table::{CsvTable, TableShape, table_shapes};
pub use value::{Row, Value, ValueError, leaves, row};

/// Why a recording could not become tables.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Value(#[from] ValueError),
    #[error(
        "recording {}: it has no samples of blindgrasp's under {wanted}: expected {}",
        path.display(),
        if found.is_empty() { "some, it has none at all".into() } else { format!("one of {}", found.join(", ")) }
    )]
    NoTopic { path: PathBuf, wanted: String, found: Vec<String> },
    #[error("recording {}: {topic} holds both {first} and {second}: expected one type in a topic", path.display())]
    TwoTypes { path: PathBuf, topic: String, first: &'static str, second: &'static str },
    /// A row has other columns than the table.
    #[error("{0}")]
    Shape(String),
    #[error("the table cannot be written")]
    Io(#[from] std::io::Error),
}

impl ExportError {
    /// Checks that each wanted topic is among those found in the recording `path`.
    ///
    /// # Errors
    /// [`ExportError::NoTopic`].
    pub fn check_topics<'a>(
        path: &Path,
        wanted: &[String],
        found: impl Iterator<Item = &'a String>,
    ) -> Result<(), ExportError> {
        let found: Vec<String> = found.cloned().collect();
        match wanted.iter().find(|topic| !found.contains(topic)) {
            None => Ok(()),
            Some(missing) => Err(ExportError::NoTopic { path: path.into(), wanted: missing.clone(), found }),
        }
    }
}

impl From<csv::Error> for ExportError {
    fn from(error: csv::Error) -> Self {
        let message = error.to_string();
        match error.into_kind() {
            csv::ErrorKind::Io(error) => ExportError::Io(error),
            _ => ExportError::Shape(message),
        }
    }
}

#[cfg(test)]
mod tests;
