//! What tables a recording becomes.

use std::collections::BTreeMap;
use std::path::Path;

use super::ExportError;
use super::row::{Row, Value, exemplar_row, row, type_name};
use crate::RecordingReader;

/// How long a list is in the samples of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Length {
    /// In all of them this long.
    Always(usize),
    /// Not equally long in all of them.
    Varies,
}

/// What the table of a topic looks like.
#[derive(Debug, Clone)]
pub struct TableShape {
    /// The type of its messages.
    pub type_name: &'static str,
    /// A row like those of the topic, in which every list has at least one element.
    pub exemplar: Row,
    /// How long the lists in its columns are.
    pub lengths: BTreeMap<&'static str, Length>,
}

/// Looks through a recording for the topics `wanted`, all if there are none, and says what their tables look like.
///
/// # Errors
/// The recording cannot be read, a topic that is wanted is not there, or one holds messages of several types.
pub fn survey(path: &Path, wanted: &[String]) -> Result<BTreeMap<String, TableShape>, ExportError> {
    let mut found: BTreeMap<String, Option<TableShape>> = BTreeMap::new();
    for record in RecordingReader::open(path)? {
        let (topic, record) = record?;
        if !wanted.is_empty() && !wanted.contains(&topic) {
            found.entry(topic).or_default();
            continue;
        }
        let type_name = type_name(&record);
        let entry = found.entry(topic.clone()).or_default();
        let row = row(&record)?;
        let Some(shape) = entry else {
            let lengths =
                row.iter().filter_map(|(name, value)| Some((*name, Length::Always(length(value)?)))).collect();
            *entry = Some(TableShape { type_name, exemplar: exemplar_row(&record)?, lengths });
            continue;
        };
        if shape.type_name != type_name {
            let (path, first) = (path.into(), shape.type_name);
            return Err(ExportError::TwoTypes { path, topic, first, second: type_name });
        }
        for (name, value) in &row {
            if let (Some(length), Some(known)) = (length(value), shape.lengths.get_mut(name))
                && *known != Length::Always(length)
            {
                *known = Length::Varies;
            }
        }
    }
    if let Some(missing) = wanted.iter().find(|topic| !found.contains_key(*topic)) {
        return Err(ExportError::NoTopic {
            path: path.into(),
            wanted: missing.clone(),
            found: found.into_keys().collect(),
        });
    }
    Ok(found.into_iter().filter_map(|(topic, shape)| Some((topic, shape?))).collect())
}

fn length(value: &Value) -> Option<usize> {
    match value {
        Value::List(items) => Some(items.len()),
        _ => None,
    }
}
