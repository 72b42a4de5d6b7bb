//! The features that a model sees of recorded grasps, as a table for other tools to learn from.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use super::{Examples, Relabelling, TrainingError};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

/// How many grasps a table of features has, and how many were left out, by reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FeatureTable {
    pub n_rows: usize,
    pub n_excluded: BTreeMap<String, usize>,
}

/// Why a table of features cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FeatureTableError {
    #[error(transparent)]
    Examples(#[from] TrainingError),
    #[error(transparent)]
    Csv(#[from] csv::Error),
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Writes a row (CSV) for each grasp with a label and a contact: where it was recorded, its label, the identities of
/// hand and features, then the features of its first settled frame, each under its name. The limits of the model's training
/// data are not applied.
///
/// # Errors
/// A recording cannot be read, or the table cannot be written.
pub fn write_feature_table(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    to: impl Write,
) -> Result<FeatureTable, FeatureTableError> {
    let Examples { examples, mut n_excluded, .. } =
        Examples::read(hand, recordings, &Relabelling::default(), |_, _| {})?;
    let identity = [format!("{:016x}", model.hand.id), format!("{:016x}", model.dictionary_id())];
    let mut table = csv::Writer::from_writer(to);
    let names = ["recording", "grasp_id", "object", "class", "stable", "hand_id", "dictionary_id"].map(String::from);
    table.write_record(names.into_iter().chain(model.features.value_names(hand)))?;
    let mut n_rows = 0;
    let mut values = Vec::new();
    for example in &examples {
        if let Err(fault) = model.features.extract(&example.reading(), &mut values) {
            *n_excluded.entry(fault.as_str().into()).or_default() += 1;
            continue;
        }
        let row = [
            recordings[example.recording_idx].display().to_string(),
            example.grasp_id.to_string(),
            example.object.clone(),
            example.class.clone(),
            u8::from(example.stable).to_string(),
        ];
        table.write_record(row.into_iter().chain(identity.clone()).chain(values.iter().map(f64::to_string)))?;
        n_rows += 1;
    }
    table.flush()?;
    Ok(FeatureTable { n_rows, n_excluded })
}
