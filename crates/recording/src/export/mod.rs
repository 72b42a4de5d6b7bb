//! Recordings as tables, for pandas, polars, DuckDB and spreadsheets: a topic is a table, a sample a row.
//!
//! The columns are the header's fields, then the message's, as serde finds them: a field that a message gains appears by
//! itself. Not here: JSON lines, which are [`Record::to_json`](crate::Record::to_json), and where tables are
//! put.

mod csv_table;
mod exemplar;
mod parquet_table;
mod row;
mod survey;

use std::path::PathBuf;

use crate::RecordingError;

pub use csv_table::CsvTable;
pub use parquet_table::ParquetTable;
pub use row::{Row, Value, row, type_name};
pub use survey::{Length, TableShape, survey};

/// Why a recording could not become tables.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The recording could not be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A topic was asked for that is not there.
    #[error(
        "recording {}: it has no samples of blindgrasp's under {wanted}: expected {}",
        path.display(),
        if found.is_empty() { "some, it has none at all".into() } else { format!("one of {}", found.join(", ")) }
    )]
    NoTopic {
        /// The file.
        path: PathBuf,
        /// The topic.
        wanted: String,
        /// The topics that are there.
        found: Vec<String>,
    },
    /// A topic holds messages of two types, which are no one table.
    #[error("recording {}: {topic} holds both {first} and {second}: expected one type in a topic", path.display())]
    TwoTypes {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// The first type.
        first: &'static str,
        /// The other one.
        second: &'static str,
    },
    /// A message has a field of a kind that tables don't have, or is not like those before it.
    #[error("{0}")]
    Shape(String),
    /// A table could not be written.
    #[error("cannot be written")]
    Io(#[from] std::io::Error),
    /// A Parquet file could not be written.
    #[error(transparent)]
    Parquet(#[from] parquet::errors::ParquetError),
}

impl From<csv::Error> for ExportError {
    fn from(error: csv::Error) -> Self {
        let message = error.to_string();
        match error.into_kind() {
            csv::ErrorKind::Io(error) => ExportError::Io(error),
            // Such as a row that has not as many columns as the first line.
            _ => ExportError::Shape(message),
        }
    }
}

impl serde::ser::Error for ExportError {
    fn custom<T: std::fmt::Display>(message: T) -> Self {
        ExportError::Shape(message.to_string())
    }
}

impl serde::de::Error for ExportError {
    fn custom<T: std::fmt::Display>(message: T) -> Self {
        ExportError::Shape(message.to_string())
    }
}

#[cfg(test)]
mod tests;
