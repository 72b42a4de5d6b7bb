//! Predictions of outside models, which are not blindgrasp's, as a table (CSV): read to be judged like blindgrasp's own, and
//! written of these.
//!
//! A row is a grasp and a model: `recording`, `grasp_id`, `fold`, `model`, `probability_stable`. Whether a model has seen the
//! grasps that it predicts cannot be found out here.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::decisions::{JudgedGrasp, JudgedRecipe};
use crate::file_name;
use crate::import::columns::shortened;
use crate::import::lines::{Lines, RowLimit};
use crate::import::{BYTE_ORDER_MARK, bad_row, found, read as read_bytes};
use crate::training::{Example, Examples};
use blindgrasp_messages::MAX_NAME_BYTES;

/// The most models of a table: more would be a number or a path in the column of models.
const MAX_MODELS: usize = 16;
/// The most grasps that an error lists.
const MAX_SHOWN_GRASPS: usize = 8;

/// The index of a recording, and the number of a grasp in it.
type GraspInRecording = (usize, u64);

/// Models with a prediction for each grasp that is judged.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OutsidePredictions {
    pub path: PathBuf,
    /// In the order in which the table has them.
    pub models: Vec<OutsideModel>,
    /// The models lift from this probability on.
    pub threshold_probability: f64,
    /// Predictions for grasps that are not judged.
    pub n_unused: usize,
}

#[derive(Debug, Clone, PartialEq)]
pub struct OutsideModel {
    pub name: String,
    predictions: BTreeMap<GraspInRecording, OutsidePrediction>,
}

#[derive(Debug, Clone, PartialEq)]
struct OutsidePrediction {
    probability_stable: f64,
    /// From 1.
    fold: Option<u64>,
    /// The line of the table, from 1.
    line: u64,
}

#[derive(Debug, thiserror::Error)]
pub enum PredictionsError {
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// The table does not fit the recordings.
    #[error("{}: {message}", path.display())]
    Table { path: PathBuf, message: String },
    #[error("these recordings have no grasp with a label and a contact: there is nothing to judge predictions by")]
    NoGrasps,
}

impl OutsidePredictions {
    /// Reads a table of predictions for the examples of these recordings.
    ///
    /// # Errors
    /// The table cannot be read, a row has no probability from 0 to 1 of a grasp of these recordings, a model has two
    /// predictions for a grasp, or none for an example.
    pub fn read(
        path: &Path,
        recordings: &[PathBuf],
        read: &Examples,
        threshold_probability: f64,
    ) -> Result<OutsidePredictions, PredictionsError> {
        let refused = |message: String| PredictionsError::Table { path: path.into(), message };
        if read.examples.is_empty() {
            return Err(PredictionsError::NoGrasps);
        }
        let bytes = read_bytes(path).map_err(|source| PredictionsError::Read { path: path.into(), source })?;
        let text = bytes.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&bytes);
        let grasps = KnownGrasps { recordings, grasps: &read.grasps };
        let default_name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut models = read_models(text, &default_name, &grasps).map_err(refused)?;
        let judged: BTreeSet<GraspInRecording> = read.examples.iter().map(key_of).collect();
        let mut n_unused = 0;
        for model in &mut models {
            let n_read = model.predictions.len();
            model.predictions.retain(|place, _| judged.contains(place));
            n_unused += n_read - model.predictions.len();
            model.check_complete(&judged, &grasps).map_err(refused)?;
        }
        Ok(OutsidePredictions { path: path.into(), models, threshold_probability, n_unused })
    }

    /// Refuses a fold of the table that is not the fold of the grasp, and a missing one of a model that has folds. A model without
    /// folds passes.
    ///
    /// * `folds` - the fold of each example, from 0.
    ///
    /// # Errors
    /// The line, and both folds.
    pub fn check_folds(&self, examples: &[Example], folds: &[usize]) -> Result<(), PredictionsError> {
        for model in &self.models {
            let has_folds = model.predictions.values().any(|prediction| prediction.fold.is_some());
            if !has_folds {
                continue;
            }
            for (example, fold) in examples.iter().zip(folds) {
                let Some(prediction) = model.predictions.get(&key_of(example)) else { continue };
                let expected = *fold as u64 + 1;
                if prediction.fold != Some(expected) {
                    let given = prediction.fold.map_or("no fold".into(), |fold| format!("fold {fold}"));
                    return Err(self.refused(format!(
                        "line {}: {given}, but grasp {} is in fold {expected} of this evaluation: train on the folds in \
                         predictions.csv, which --figures writes with the same --split, --folds and --seed",
                        prediction.line, example.grasp_id
                    )));
                }
            }
        }
        Ok(())
    }

    /// Refuses a model with the name of another judge.
    ///
    /// # Errors
    /// The name.
    pub fn check_names(&self, others: &[String]) -> Result<(), PredictionsError> {
        match self.models.iter().find(|model| others.contains(&model.name)) {
            Some(model) => Err(self.refused(format!(
                "a model is called '{}', like one of blindgrasp's: expected another name in the column model or, without that \
                 column, another file name",
                model.name
            ))),
            None => Ok(()),
        }
    }

    fn refused(&self, message: String) -> PredictionsError {
        PredictionsError::Table { path: self.path.clone(), message }
    }
}

impl OutsideModel {
    /// The probability that this grasp is stable; `None` if the grasp is not judged.
    pub fn probability(&self, grasp: &JudgedGrasp) -> Option<f64> {
        let prediction = self.predictions.get(&(grasp.recording_idx, grasp.grasp_id));
        prediction.map(|prediction| prediction.probability_stable)
    }

    fn check_complete(&self, judged: &BTreeSet<GraspInRecording>, grasps: &KnownGrasps<'_>) -> Result<(), String> {
        let missing: Vec<&GraspInRecording> =
            judged.iter().filter(|place| !self.predictions.contains_key(*place)).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let shown: Vec<String> = missing
            .iter()
            .take(MAX_SHOWN_GRASPS)
            .map(|(recording_idx, grasp_id)| format!("grasp {grasp_id} of {}", grasps.name(*recording_idx)))
            .collect();
        let more = if missing.len() > MAX_SHOWN_GRASPS { ", …" } else { "" };
        Err(format!(
            "model '{}' has no prediction for {} of the {} grasps with a label and a contact: {}{more}",
            self.name,
            missing.len(),
            judged.len(),
            shown.join(", ")
        ))
    }
}

/// The table of the judges' predictions: a row for each judge and each grasp for which it has a probability. That of recipes
/// can be read as predictions of outside models; that of a model lacks grasps for which it has no single probability.
///
/// # Errors
/// A row cannot be written.
pub fn predictions_csv(judges: &[JudgedRecipe], recordings: &[PathBuf]) -> Result<String, csv::Error> {
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record([
        "recording",
        "grasp_id",
        "object",
        "class",
        "stable",
        "fold",
        "model",
        "probability_stable",
    ])?;
    for judge in judges {
        for grasp in &judge.decided {
            let Some(probability_stable) = grasp.probability else { continue };
            table.write_record([
                recordings[grasp.recording_idx].display().to_string(),
                grasp.grasp_id.to_string(),
                grasp.object.clone(),
                grasp.class.clone(),
                u8::from(grasp.stable).to_string(),
                grasp.fold.map(|fold| (fold + 1).to_string()).unwrap_or_default(),
                judge.name.clone(),
                probability_stable.to_string(),
            ])?;
        }
    }
    let bytes = table.into_inner().map_err(|error| error.into_error())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

fn key_of(example: &Example) -> GraspInRecording {
    (example.recording_idx, example.grasp_id)
}

/// Errors do not name the file.
fn read_models(text: &[u8], default_name: &str, grasps: &KnownGrasps<'_>) -> Result<Vec<OutsideModel>, String> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(RowLimit::new(text));
    let header = reader.headers().map_err(|error| format!("line 1: expected the names of columns, found {error}"))?;
    let columns = PredictionColumns::find(header)?;
    let mut lines = Lines::new(text);
    let mut models: Vec<OutsideModel> = Vec::new();
    let mut records = reader.records();
    loop {
        records.reader_mut().get_mut().begin_row();
        let line = lines.line_of(records.reader().position().byte());
        let Some(record) = records.next() else { break };
        let at_line = |problem: String| format!("line {line}: {problem}");
        let record = record
            .map_err(|error| at_line(bad_row(&error, line).map_or_else(|| error.to_string(), |row| row.problem)))?;
        let name = columns.model_name(&record, default_name).map_err(at_line)?;
        let (place, prediction) = columns.prediction(&record, line, grasps).map_err(at_line)?;
        let model_idx = match models.iter().position(|model| model.name == name) {
            Some(idx) => idx,
            None if models.len() == MAX_MODELS => {
                return Err(at_line(format!("column 'model': expected at most {MAX_MODELS} models, found one more")));
            }
            None => {
                models.push(OutsideModel { name: name.into(), predictions: BTreeMap::new() });
                models.len() - 1
            }
        };
        if let Some(earlier) = models[model_idx].predictions.insert(place, prediction) {
            return Err(at_line(format!(
                "model '{name}' has a prediction for grasp {} of {} on line {} already: expected one",
                place.1,
                grasps.name(place.0),
                earlier.line
            )));
        }
    }
    if models.is_empty() {
        return Err("there is no row below the header: expected one for each grasp".into());
    }
    Ok(models)
}

/// Indices of the columns that are read.
struct PredictionColumns {
    recording: Option<usize>,
    grasp_id: usize,
    fold: Option<usize>,
    model: Option<usize>,
    probability_stable: usize,
}

impl PredictionColumns {
    fn find(header: &csv::StringRecord) -> Result<PredictionColumns, String> {
        let optional = |name: &str| -> Result<Option<usize>, String> {
            let same: Vec<usize> = (0..header.len()).filter(|idx| &header[*idx] == name).collect();
            match same[..] {
                [] => Ok(None),
                [idx] => Ok(Some(idx)),
                [first, second, ..] => Err(format!(
                    "line 1: columns {} and {} are both called '{name}': expected one of this name",
                    first + 1,
                    second + 1
                )),
            }
        };
        let needed = |name: &str| {
            optional(name)?.ok_or_else(|| {
                let found: Vec<String> = header.iter().map(shortened).collect();
                format!(
                    "line 1: there is no column '{name}': expected grasp_id and probability_stable, and for several \
                     recordings recording; found {}",
                    found.join(", ")
                )
            })
        };
        let recording = optional("recording")?;
        Ok(PredictionColumns {
            // The name that `blindgrasp predict --json` has for it.
            recording: if recording.is_some() { recording } else { optional("file")? },
            grasp_id: needed("grasp_id")?,
            fold: optional("fold")?,
            model: optional("model")?,
            probability_stable: needed("probability_stable")?,
        })
    }

    fn model_name<'a>(&self, record: &'a csv::StringRecord, default_name: &'a str) -> Result<&'a str, String> {
        let Some(idx) = self.model else { return Ok(default_name) };
        let name = &record[idx];
        // Figures have the name in the names of their files.
        let is_usable = (1..=MAX_NAME_BYTES).contains(&name.len())
            && !name.contains(|letter: char| letter == '/' || letter.is_control());
        if is_usable {
            return Ok(name);
        }
        Err(format!(
            "column 'model': expected a name of 1 to {MAX_NAME_BYTES} bytes without '/', found {}",
            found(name)
        ))
    }

    fn prediction(
        &self,
        record: &csv::StringRecord,
        line: u64,
        grasps: &KnownGrasps<'_>,
    ) -> Result<(GraspInRecording, OutsidePrediction), String> {
        let whole_number = |name: &str, idx: usize| {
            let number = record[idx].parse::<u64>();
            number.map_err(|_| format!("column '{name}': expected a whole number, found {}", found(&record[idx])))
        };
        let grasp_id = whole_number("grasp_id", self.grasp_id)?;
        let place = match self.recording {
            Some(idx) => grasps.of_recording(&record[idx], grasp_id)?,
            None => grasps.of_only_recording(grasp_id)?,
        };
        let probability = &record[self.probability_stable];
        // NaN is in no range.
        let in_range = probability.parse::<f64>().ok().filter(|probability| (0.0..=1.0).contains(probability));
        let probability_stable = in_range.ok_or_else(|| {
            format!("column 'probability_stable': expected a number from 0 to 1, found {}", found(probability))
        })?;
        // Predictions of a model that belong to no fold have an empty column.
        let fold = self.fold.filter(|idx| !record[*idx].is_empty());
        let fold = fold.map(|idx| whole_number("fold", idx)).transpose()?;
        Ok((place, OutsidePrediction { probability_stable, fold, line }))
    }
}

/// The grasps of the recordings.
struct KnownGrasps<'a> {
    recordings: &'a [PathBuf],
    grasps: &'a BTreeSet<GraspInRecording>,
}

impl KnownGrasps<'_> {
    /// The file name of a recording.
    fn name(&self, recording_idx: usize) -> String {
        file_name(&self.recordings[recording_idx])
    }

    /// A grasp of the recording with this path, or of the only one with this file name.
    fn of_recording(&self, wanted: &str, grasp_id: u64) -> Result<GraspInRecording, String> {
        let recording_idx = self.recording_idx(wanted)?;
        if self.grasps.contains(&(recording_idx, grasp_id)) {
            return Ok((recording_idx, grasp_id));
        }
        Err(self.no_such_grasp(recording_idx, grasp_id))
    }

    fn no_such_grasp(&self, recording_idx: usize, grasp_id: u64) -> String {
        let mut ids = self.grasps.range((recording_idx, 0)..=(recording_idx, u64::MAX)).map(|(_, grasp_id)| grasp_id);
        let range = match (ids.next(), ids.next_back()) {
            (Some(first), Some(last)) => format!("its {} grasps are from {first} to {last}", ids.count() + 2),
            (Some(only), None) => format!("it has only grasp {only}"),
            _ => "it has none".into(),
        };
        format!("{} has no grasp {grasp_id}: {range}", self.name(recording_idx))
    }

    fn recording_idx(&self, wanted: &str) -> Result<usize, String> {
        let wanted_path = Path::new(wanted);
        if let Some(idx) = self.recordings.iter().position(|path| path == wanted_path) {
            return Ok(idx);
        }
        let is_same = |idx: &usize| self.recordings[*idx].file_name() == wanted_path.file_name();
        let same: Vec<usize> = (0..self.recordings.len()).filter(is_same).collect();
        match same[..] {
            [idx] => Ok(idx),
            [] => Err(format!(
                "column 'recording': expected the name or path of one of these recordings, found {}",
                found(wanted)
            )),
            _ => Err(format!(
                "column 'recording': {} recordings are called '{}': expected the path as it was given to evaluate",
                same.len(),
                self.name(same[0])
            )),
        }
    }

    /// A grasp of the only recording.
    fn of_only_recording(&self, grasp_id: u64) -> Result<GraspInRecording, String> {
        match self.recordings {
            [_] if self.grasps.contains(&(0, grasp_id)) => Ok((0, grasp_id)),
            [_] => Err(self.no_such_grasp(0, grasp_id)),
            several => {
                Err(format!("grasp {grasp_id} of one of {} recordings: expected a column 'recording'", several.len()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::decisions::Unit;
    use super::super::split::tests::examples;
    use super::*;

    /// Two recordings: grasps 0 to 2 in the first, grasps 2 and 3 in the second. All but grasp 3 are examples.
    fn read() -> (Vec<PathBuf>, Examples) {
        let mut of_a = examples(&[("cup", "mug", 3)]);
        let mut of_b = examples(&[("box", "box", 1)]);
        of_b[0].recording_idx = 1;
        of_b[0].grasp_id = 2;
        of_a.append(&mut of_b);
        let grasps = BTreeSet::from([(0, 0), (0, 1), (0, 2), (1, 2), (1, 3)]);
        let read = Examples { examples: of_a, grasps, ..Examples::default() };
        (vec!["data/a.mcap".into(), "data/b.mcap".into()], read)
    }

    fn read_table(text: impl AsRef<[u8]>) -> Result<OutsidePredictions, String> {
        let name = format!("blindgrasp-predictions-{}-{:?}", std::process::id(), std::thread::current().id());
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&folder).expect("a folder");
        let path = folder.join("mine.csv");
        std::fs::write(&path, text).expect("written");
        let (recordings, examples) = read();
        let outside = OutsidePredictions::read(&path, &recordings, &examples, 0.5).map_err(|error| error.to_string());
        std::fs::remove_dir_all(&folder).expect("removed");
        outside
    }

    const WHOLE: &str = "recording,grasp_id,probability_stable\n\
                         a.mcap,0,0.1\na.mcap,1,0.2\ndata/a.mcap,2,1\nelsewhere/b.mcap,2,0\n";

    fn probability(model: &OutsideModel, recording_idx: usize, grasp_id: u64) -> Option<f64> {
        model.predictions.get(&(recording_idx, grasp_id)).map(|prediction| prediction.probability_stable)
    }

    #[test]
    fn predictions_are_matched_by_recording_and_grasp() {
        let outside = read_table(format!("{WHOLE}b.mcap,3,0.9\n")).expect("readable");
        let [model] = &outside.models[..] else { panic!("{outside:?}") };
        assert_eq!((model.name.as_str(), outside.n_unused), ("mine", 1), "grasp 3 of b is not judged");
        let found =
            [(0, 0), (0, 1), (0, 2), (1, 2), (1, 3)].map(|(recording, grasp)| probability(model, recording, grasp));
        assert_eq!(found, [Some(0.1), Some(0.2), Some(1.0), Some(0.0), None]);
        // With the bytes that spreadsheets write first and at the end of lines, the name of predict --json, and another column.
        let head = "\u{feff}note, file ,grasp_id,probability_stable\r\n";
        let rows: String = WHOLE.lines().skip(1).map(|row| format!("x,{row}\r\n")).collect();
        assert_eq!(read_table(format!("{head}{rows}")).expect("readable").models[0].predictions.len(), 4);
    }

    #[test]
    fn a_column_names_the_models() {
        let header = "model,recording,grasp_id,fold,probability_stable\n";
        let rows = |model: &str| {
            [("a", 0, 1), ("a", 1, 1), ("a", 2, 1), ("b", 2, 2)]
                .map(|(recording, grasp, fold)| format!("{model},{recording}.mcap,{grasp},{fold},0.5\n"))
                .concat()
        };
        let outside = read_table(format!("{header}{}{}", rows("svm"), rows("forest"))).expect("readable");
        assert_eq!(outside.models.iter().map(|model| model.name.as_str()).collect::<Vec<_>>(), ["svm", "forest"]);
        let (_, examples) = read();
        outside.check_folds(&examples.examples, &[0, 0, 0, 1]).expect("the same folds");
        let error = outside.check_folds(&examples.examples, &[0, 1, 0, 1]).expect_err("another fold").to_string();
        assert!(error.contains("line 3: fold 1, but grasp 1 is in fold 2"), "{error}");
        let partly = read_table(format!("{header}{}", rows("svm").replace(",1,1,0.5", ",1,,0.5"))).expect("readable");
        let error = partly.check_folds(&examples.examples, &[0, 0, 0, 1]).expect_err("a fold is missing").to_string();
        assert!(error.contains("line 3: no fold, but grasp 1 is in fold 1"), "{error}");
        let without =
            read_table(format!("{header}{}", rows("svm").replace(",1,0.5", ",,0.5").replace(",2,0.5", ",,0.5")));
        without.expect("readable").check_folds(&examples.examples, &[0, 1, 0, 1]).expect("no folds");
        outside.check_names(&["boosted".into()]).expect("other names");
        let error = outside.check_names(&["boosted".into(), "forest".into()]).expect_err("a twin").to_string();
        assert!(error.contains("'forest'"), "{error}");
    }

    #[test]
    fn a_table_that_does_not_fit_is_refused_by_its_line() {
        for (table, expected) in [
            (String::new(), "line 1: there is no column 'grasp_id'"),
            ("grasp_id,probability\n".into(), "no column 'probability_stable': expected grasp_id and"),
            ("grasp_id,grasp_id,probability_stable\n".into(), "columns 1 and 2 are both called 'grasp_id'"),
            ("grasp_id,probability_stable\n".into(), "no row below the header"),
            (WHOLE.replace("a.mcap,1,0.2", "a.mcap,1"), "line 3: expected 3 fields, as the header has, found 2"),
            (
                WHOLE.replace("1,0.2", "1,1.5"),
                "line 3: column 'probability_stable': expected a number from 0 to 1, found '1.5'",
            ),
            (WHOLE.replace("1,0.2", "1,nan"), "line 3: column 'probability_stable'"),
            (WHOLE.replace("1,0.2", "1,-0.2"), "line 3: column 'probability_stable'"),
            (WHOLE.replace("1,0.2", "1,"), "found nothing"),
            (
                WHOLE.replace("a.mcap,1,", "a.mcap,1.0,"),
                "line 3: column 'grasp_id': expected a whole number, found '1.0'",
            ),
            (
                WHOLE.replace("a.mcap,1,", "a.mcap,0,"),
                "line 3: model 'mine' has a prediction for grasp 0 of a.mcap on line 2",
            ),
            (WHOLE.replace("a.mcap,1,", "a.mcap,7,"), "line 3: a.mcap has no grasp 7: its 3 grasps are from 0 to 2"),
            (WHOLE.replace("a.mcap,1,", "c.mcap,1,"), "line 3: column 'recording': expected the name or path of one"),
            (
                WHOLE.replace("a.mcap,1,0.2\n", ""),
                "no prediction for 1 of the 4 grasps with a label and a contact: grasp 1 of a.mcap",
            ),
            (
                "grasp_id,probability_stable\n0,0.5\n2,0.5\n".into(),
                "line 2: grasp 0 of one of 2 recordings: expected a column 'recording'",
            ),
            ("model,grasp_id,probability_stable\na/b,0,0.5\n".into(), "line 2: column 'model': expected a name"),
            (
                "fold,recording,grasp_id,probability_stable\nx,a.mcap,0,0.5\n".into(),
                "line 2: column 'fold': expected a whole number, found 'x'",
            ),
        ] {
            let error = read_table(&table).expect_err(expected);
            assert!(error.contains(expected), "{table:?}: {error}");
        }
        let error = read_table(b"grasp_id,probability_stable\n\xff,0.5\n").expect_err("no UTF-8");
        assert!(error.contains("line 2: field 1: expected UTF-8"), "{error}");
        let many: String = (0..17).map(|idx| format!("m{idx},a.mcap,0,0.5\n")).collect();
        let error = read_table(format!("model,recording,grasp_id,probability_stable\n{many}")).expect_err("too many");
        assert!(error.contains("line 18") && error.contains("at most 16 models"), "{error}");
    }

    #[test]
    fn a_written_table_can_be_read() {
        let (recordings, examples) = read();
        let grasp = |example: &Example| JudgedGrasp {
            recording_idx: example.recording_idx,
            grasp_id: example.grasp_id,
            fold: Some(example.recording_idx),
            object: example.object.clone(),
            class: "with, a comma".into(),
            stable: example.stable,
            lifted: true,
            judged: true,
            probability: Some(1.0 / (3.0 + example.grasp_id as f64)),
        };
        let decided: Vec<JudgedGrasp> = examples.examples.iter().map(grasp).collect();
        let judge = JudgedRecipe::new("a \"b\"", String::new(), 0.5, decided, Unit::Object, 1);
        let table = predictions_csv(std::slice::from_ref(&judge), &recordings).expect("written");
        let header = "recording,grasp_id,object,class,stable,fold,model,probability_stable";
        assert_eq!(table.lines().next(), Some(header));
        let outside = read_table(&table).expect("readable");
        assert_eq!(outside.models[0].name, "a \"b\"");
        for grasp in &judge.decided {
            assert_eq!(outside.models[0].probability(grasp), grasp.probability);
        }
        outside.check_folds(&examples.examples, &[0, 0, 0, 1]).expect("the same folds");
        let without_folds = judge.decided.iter().map(|grasp| JudgedGrasp { fold: None, ..grasp.clone() }).collect();
        let judge = JudgedRecipe::new("m", String::new(), 0.5, without_folds, Unit::Object, 1);
        let table = predictions_csv(std::slice::from_ref(&judge), &recordings).expect("written");
        assert_eq!(read_table(&table).expect("readable").models[0].name, "m");
    }
}
