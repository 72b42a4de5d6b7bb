//! The features that a model sees of recorded grasps, as a table for other tools to learn from.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use crate::dataset::{DatasetError, Grasp, check_once, labels_of, read_grasps};
use crate::reading::{SeenReadings, Settled, check_classes, note_reading};
use blindgrasp_messages::{Fault, GraspTruth};
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
    Dataset(#[from] DatasetError),
    #[error(transparent)]
    Csv(#[from] csv::Error),
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Writes a row (CSV) for each grasp with a label and a contact. A row has where the grasp was recorded, its label, the
/// identities of hand and features, then the features of its first settled frame, each under its name. The limits of the
/// model's training data are not applied.
///
/// # Errors
/// A recording cannot be used or is given twice, an object is of two classes, or the table cannot be written.
pub fn write_feature_table(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    to: impl Write,
) -> Result<FeatureTable, FeatureTableError> {
    check_once(recordings)?;
    labels_of(recordings)?;
    let identity = [format!("{:016x}", model.hand.id), format!("{:016x}", model.dictionary_id())];
    let mut table = csv::Writer::from_writer(to);
    let names =
        ["recording", "grasp_id", "object", "object_class", "stable", "hand_id", "dictionary_id"].map(String::from);
    table.write_record(names.into_iter().chain(model.features.value_names(hand)))?;
    let (mut n_rows, mut n_excluded) = (0, BTreeMap::new());
    let (mut values, mut objects, mut seen) = (Vec::new(), Vec::new(), SeenReadings::new());
    for (recording_idx, path) in recordings.iter().enumerate() {
        for Grasp { grasp_id, value, truth } in read_grasps(path, hand, |_, frames| Settled::of(hand, &frames))? {
            let (settled, truth) = match usable(value, truth, recording_idx, &mut seen) {
                Ok(usable) => usable,
                Err(reason) => {
                    *n_excluded.entry(reason.into()).or_default() += 1;
                    continue;
                }
            };
            objects.push((truth.object.clone(), truth.object_class.clone()));
            if let Err(fault) = model.features.extract(&settled.felt.reading(), &mut values) {
                *n_excluded.entry(fault.as_str().into()).or_default() += 1;
                continue;
            }
            let (recording, stable) = (path.display().to_string(), u8::from(truth.stable).to_string());
            let row = [recording, grasp_id.to_string(), truth.object, truth.object_class, stable];
            table.write_record(row.into_iter().chain(identity.clone()).chain(values.iter().map(f64::to_string)))?;
            n_rows += 1;
        }
    }
    check_classes(objects.iter().map(|(object, class)| (object.as_str(), class.as_str())))?;
    table.flush()?;
    Ok(FeatureTable { n_rows, n_excluded })
}

/// The settled frame and the label of a grasp, or the reason why it is left out.
fn usable(
    settled: Option<Settled>,
    truth: Option<GraspTruth>,
    recording_idx: usize,
    seen: &mut SeenReadings,
) -> Result<(Settled, GraspTruth), &'static str> {
    let truth = truth.ok_or("no truth")?;
    let settled = settled.ok_or("no settled frame")?;
    let noted = note_reading(seen, settled.reading_id, recording_idx, truth.stable);
    if settled.fault != Fault::None {
        return Err(settled.left_out_as());
    }
    noted?;
    Ok((settled, truth))
}
