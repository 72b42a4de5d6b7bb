//! The features that a model sees of recorded grasps, as a table for other tools to learn from.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use csv::StringRecord;

use crate::dataset::{DatasetError, Grasp, check_once, labels_of, read_grasps};
use crate::reading::{SeenReadings, Settled, check_classes, note_reading};
use blindgrasp_messages::{Fault, GraspTruth};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::training_summary::ReadingId;

/// The columns before those of the values.
pub const COLUMNS: [&str; 7] =
    ["recording", "grasp_id", "object", "object_class", "stable", "hand_id", "dictionary_id"];

/// The readings of a table's rows, by recording unless it was merged, and how many grasps were left out, by reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FeatureTable {
    pub readings: Vec<Vec<ReadingId>>,
    pub n_excluded: BTreeMap<String, usize>,
}

/// Why a table of features cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FeatureTableError {
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error(transparent)]
    Csv(#[from] csv::Error),
}

/// Writes a row (CSV) for each grasp with a label and a contact, of the recordings whose index `is_own`. A row has where the
/// grasp was recorded, its label, the identities of hand and features, then the features of its first settled frame, each
/// under its name. The limits of the model's training data are not applied.
///
/// # Errors
/// A recording cannot be used or is given twice, an object is of two classes, or the table cannot be written.
pub fn write_feature_table(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    is_own: impl Fn(usize) -> bool,
    to: impl Write,
) -> Result<FeatureTable, FeatureTableError> {
    check_once(recordings)?;
    labels_of(recordings)?;
    let identity = [format!("{:016x}", model.hand.id), format!("{:016x}", model.dictionary_id())];
    let mut table = csv::Writer::from_writer(to);
    table.write_record(COLUMNS.map(String::from).into_iter().chain(model.features.value_names(hand)))?;
    let (mut readings, mut n_excluded) = (Vec::new(), BTreeMap::new());
    let (mut values, mut objects, mut seen) = (Vec::new(), Vec::new(), SeenReadings::new());
    for (recording_idx, path) in recordings.iter().enumerate().filter(|(idx, _)| is_own(*idx)) {
        let mut of_rows = Vec::new();
        for Grasp { grasp_id, value, truth } in read_grasps(path, hand, |_, frames| Settled::of(hand, &frames))? {
            let (settled, truth) = match usable(value, truth) {
                Ok(usable) => usable,
                Err(reason) => {
                    *n_excluded.entry(reason.into()).or_default() += 1;
                    continue;
                }
            };
            objects.push((truth.object.clone(), truth.object_class.clone()));
            let noted = match model.features.extract(&settled.felt.reading(), &mut values) {
                // Only a row takes the place of others with its reading.
                Ok(_) => note_reading(&mut seen, settled.reading_id, recording_idx, truth.stable),
                Err(fault) => Err(fault.as_str()),
            };
            if let Err(reason) = noted {
                *n_excluded.entry(reason.into()).or_default() += 1;
                continue;
            }
            let (recording, stable) = (path.display().to_string(), u8::from(truth.stable).to_string());
            let row = [recording, grasp_id.to_string(), truth.object, truth.object_class, stable];
            table.write_record(row.into_iter().chain(identity.clone()).chain(values.iter().map(f64::to_string)))?;
            of_rows.push(settled.reading_id);
        }
        readings.push(of_rows);
    }
    check_classes(objects.iter().map(|(object, class)| (object.as_str(), class.as_str())))?;
    table.flush().map_err(csv::Error::from)?;
    Ok(FeatureTable { readings, n_excluded })
}

/// Writes the table of the whole from the header of one and the rows of all shards, each with its reading. Of grasps with one
/// reading, the first one has a row, as in [`write_feature_table`].
///
/// # Errors
/// An object is of two classes, or the table cannot be written.
pub fn merge_feature_rows(
    header: &StringRecord,
    rows: Vec<(ReadingId, StringRecord)>,
    mut n_excluded: BTreeMap<String, usize>,
    to: impl Write,
) -> Result<FeatureTable, FeatureTableError> {
    check_classes(rows.iter().map(|(_, row)| (&row[2], &row[3])))?;
    let mut table = csv::Writer::from_writer(to);
    table.write_record(header)?;
    let (mut seen, mut of_rows) = (SeenReadings::new(), Vec::new());
    for (reading, row) in rows {
        match note_reading(&mut seen, reading, 0, &row[4] == "1") {
            Ok(()) => {
                table.write_record(&row)?;
                of_rows.push(reading);
            }
            Err(reason) => *n_excluded.entry(reason.into()).or_default() += 1,
        }
    }
    table.flush().map_err(csv::Error::from)?;
    Ok(FeatureTable { readings: vec![of_rows], n_excluded })
}

/// The settled frame and the label of a grasp, or the reason why it is left out.
fn usable(settled: Option<Settled>, truth: Option<GraspTruth>) -> Result<(Settled, GraspTruth), &'static str> {
    let truth = truth.ok_or("no truth")?;
    let settled = settled.ok_or("no settled frame")?;
    if settled.fault != Fault::None { Err(settled.left_out_as()) } else { Ok((settled, truth)) }
}
