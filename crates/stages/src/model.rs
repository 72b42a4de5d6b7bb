//! The model file: what training makes and the operators run on.
//!
//! JSON, so that anything can read it; `f64` survive it bit for bit. `checksum` is the SHA-256 of the file's text with
//! the checksum itself left empty, so that a truncated or edited file is refused rather than trusted with a lift.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::approach::ApproachPrior;
use crate::classifier::{Classifier, Predictor, Verdict};
use crate::day::{DayMemory, DayModel, GraspPlace};
use crate::encoder::{FeatureExtractor, FeltReading, PartNames};
use crate::hand::Hand;
use crate::out_of_distribution::{Limits, TrainingRange, Violation, quantities, short};
use crate::own_lifts::{Adapt, Looked, OwnLifts};
use crate::probe::{GraspHistory, ProbeModel, pad_newtons, signals};
use crate::shift_test::numbers;
use crate::training_summary::TrainingSummary;
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::{open_regular, write_whole};
use blindgrasp_messages::{Fault, Phase};

/// The format that this program writes and reads.
pub const FORMAT: &str = "blindgrasp-model/2";

/// Greatest size of a model: the paper's support vectors of 25,000 grasps take about 17 MiB, the shipped models 1 MiB.
const MAX_BYTES: u64 = 128 << 20;
/// The checksum's field in the text that is summed.
const UNSIGNED: &str = r#""checksum":"""#;

/// All that is learned: features, classifier, and for which hand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    pub format: String,
    /// The hand it was trained for.
    pub hand: ModelHand,
    /// What makes features of contacts and joint angles: the dictionary, too.
    pub features: FeatureExtractor,
    pub classifier: Classifier,
    /// What grasps look like that it was trained on.
    pub training_range: TrainingRange,
    /// The judgement of the tight hand, before the arm moves; the classifier then judges which grasps are worth a probe.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub squeezed: Option<ProbeModel>,
    /// The judgement after a test lift.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub test_lifted: Option<ProbeModel>,
    /// How often lifts keep their object after an approach, before anything is touched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub approach: Option<ApproachPrior>,
    /// How it deals with recording days.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub day: Option<DayModel>,
    /// How it was trained.
    pub training: TrainingSummary,
    /// SHA-256 in hex of the file's text with this field empty.
    pub checksum: String,
}

/// The part of earlier frames that later judgements need.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// The open grasp, for models that judge probes.
    grasp: GraspHistory,
    /// The day, for models that judge a grasp by others.
    day: DayMemory,
    /// The outcomes of the robot's lifts.
    pub lifts: OwnLifts,
    /// The option that says how outcomes are used. It is not part of the state.
    #[serde(skip)]
    pub adapt: Adapt,
}

impl Memory {
    /// An empty memory.
    pub fn new(adapt: Adapt) -> Memory {
        Memory { adapt, ..Memory::default() }
    }

    /// Begins with a recording: its grasps belong to those before only if both say the same day.
    pub fn begin_recording(&mut self) {
        self.forget_grasp();
        self.day.begin_recording();
    }

    /// Forgets the frames of the open grasp, of which some were missed.
    pub fn forget_grasp(&mut self) {
        self.grasp = GraspHistory::default();
    }
}

/// The hand of a model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelHand {
    pub name: String,
    /// Its identity, [`crate::hand::Hand::id`] in hex: what is compared.
    #[serde(with = "blindgrasp_messages::hex_id")]
    pub id: u64,
}

/// A model and a hand that do not belong together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the model is for the hand '{model_hand}' ({model_hand_id:016x}), not for '{hand}' ({hand_id:016x}): take a model of \
     this hand, or train one (blindgrasp train)"
)]
pub struct OtherHand {
    pub model_hand: String,
    pub model_hand_id: u64,
    pub hand: String,
    pub hand_id: u64,
}

/// Why a model could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file could not be read or written.
    #[error("model {}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// The file is not a model that this program can run.
    #[error("model {}: {reason}", path.display())]
    Invalid { path: PathBuf, reason: InvalidModel },
}

/// Why a text is not a model that this program can run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidModel {
    #[error(
        "more than {} MiB: expected a model made by blindgrasp train; train it with fewer words or on fewer grasps",
        MAX_BYTES >> 20
    )]
    TooLarge,
    /// It is a file of another kind, which the text describes.
    #[error("not a model: expected JSON made by blindgrasp train, found {0}")]
    OtherKind(&'static str),
    #[error("not a model, or cut off: expected JSON made by blindgrasp train ({0})")]
    NotAModel(String),
    /// It has the format, but not what belongs to it.
    #[error("not a valid model: {0}")]
    Malformed(String),
    /// The file is whole, and another program with the same format wrote it.
    #[error(
        "another build of blindgrasp, version {version}, wrote it, and this one, version {}, does not know its fields \
         ({reason}): train it again with this one (blindgrasp train)",
        env!("CARGO_PKG_VERSION")
    )]
    OtherBuild { version: String, reason: String },
    #[error("format '{found}', expected '{FORMAT}': train it again with this version (blindgrasp train)")]
    OtherFormat { found: String },
    #[error(
        "its checksum does not match its contents: it was damaged or edited; restore it, or train it again (blindgrasp \
         train)"
    )]
    Checksum,
    /// Its parts do not fit each other. The text names the part, what was found and what was expected.
    #[error("{0}")]
    Inconsistent(String),
}

impl Model {
    /// Reads and verifies a model.
    ///
    /// # Errors
    /// A file that cannot be read, is no model, has another format version, a wrong checksum or inconsistent contents.
    pub fn load(path: &Path) -> Result<Model, ModelError> {
        let mut bytes = Vec::new();
        open_regular(path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes))
            .map_err(|source| ModelError::Io { path: path.into(), source })?;
        let invalid = |reason| ModelError::Invalid { path: path.into(), reason };
        if bytes.len() as u64 > MAX_BYTES {
            return Err(invalid(InvalidModel::TooLarge));
        }
        // Other JSON may be a model of another version.
        if let Some(kind) = FileKind::of(&bytes).filter(|kind| !matches!(kind, FileKind::Model | FileKind::Json)) {
            return Err(invalid(InvalidModel::OtherKind(kind.description())));
        }
        let text = String::from_utf8(bytes).map_err(|_| invalid(InvalidModel::NotAModel("not UTF-8".into())))?;
        Model::parse(&text).map_err(invalid)
    }

    /// Reads and verifies a model's text.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Model, InvalidModel> {
        let model: Model = serde_json::from_str(text).map_err(|error| why_not_a_model(text, &error))?;
        if model.format != FORMAT {
            return Err(InvalidModel::OtherFormat { found: model.format });
        }
        let expected = checksum(text, &model.checksum);
        if model.checksum != expected {
            return Err(InvalidModel::Checksum);
        }
        model.validate().map_err(InvalidModel::Inconsistent)?;
        Ok(model)
    }

    /// Writes the model with its checksum, at once or not at all.
    ///
    /// # Errors
    /// The model is inconsistent, or the file could not be written.
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        let io = |source| ModelError::Io { path: path.into(), source };
        let invalid = |reason| ModelError::Invalid { path: path.into(), reason };
        // What could not be read again must not take the place of what can.
        self.validate().map_err(|message| invalid(InvalidModel::Inconsistent(message)))?;
        let unsigned = Model { checksum: String::new(), ..self.clone() };
        let mut text = serde_json::to_string(&unsigned).map_err(|error| io(error.into()))? + "\n";
        if let Some(at) = text.find(UNSIGNED) {
            text.insert_str(at + UNSIGNED.len() - 1, &digest(&[&text]));
        }
        if text.len() as u64 > MAX_BYTES {
            return Err(invalid(InvalidModel::TooLarge));
        }
        write_whole(path, text).map_err(io)
    }

    /// Checks that the model was trained for this hand.
    ///
    /// # Errors
    /// It was trained for another one.
    pub fn check_hand(&self, hand: &Hand) -> Result<(), OtherHand> {
        if self.hand.id == hand.id() {
            return Ok(());
        }
        Err(OtherHand {
            model_hand: self.hand.name.clone(),
            model_hand_id: self.hand.id,
            hand: hand.name.clone(),
            hand_id: hand.id(),
        })
    }

    /// Identifies what makes features: hand, dictionary, σ, blocks, scaling, the limits of what it was trained on. A
    /// classifier understands the features of its own dictionary only.
    pub fn dictionary_id(&self) -> u64 {
        let mut hasher = Sha256::new();
        hasher.update(self.hand.id.to_le_bytes());
        // What cannot be written has not been read either: a model's numbers are finite.
        hasher.update(serde_json::to_vec(&(&self.features, &self.training_range)).unwrap_or_default());
        for probe in [&self.squeezed, &self.test_lifted].into_iter().flatten() {
            hasher.update(serde_json::to_vec(&probe.training_range).unwrap_or_default());
        }
        let digest = hasher.finalize();
        let mut first = [0; 8];
        first.copy_from_slice(&digest[..8]);
        u64::from_le_bytes(first)
    }

    /// What neighbours in a graph must have in common with this model: the hand, and what makes the features.
    pub fn identity(&self) -> BTreeMap<String, String> {
        let hex = |id: u64| format!("{id:016x}");
        BTreeMap::from([("hand".into(), hex(self.hand.id)), ("dictionary".into(), hex(self.dictionary_id()))])
    }

    /// Writes the feature of a frame to `values`, if the frame is like those trained on, and returns how many pads have
    /// contact.
    ///
    /// # Errors
    /// The fault, with `values` empty: as of [`FeatureExtractor::extract`], or [`Fault::OutOfDistribution`].
    pub fn extract(&self, phase: Phase, reading: &FeltReading<'_>, values: &mut Vec<f64>) -> Result<u32, Fault> {
        // First, because a malformed frame has a fault of its own.
        let n_pads_in_contact = self.features.extract(reading, values)?;
        let checked = self
            .training_range_in(phase)
            .map_or(Ok(()), |range| range.check(&self.features, reading.joints, reading.contacts));
        checked.inspect_err(|_| values.clear())?;
        Ok(n_pads_in_contact)
    }

    /// The limits that a frame is held to.
    fn training_range_in(&self, phase: Phase) -> Option<&TrainingRange> {
        match phase {
            // The readings of a moving hand are part of no training range.
            Phase::Squeezing | Phase::TestLifting | Phase::Lifting => None,
            Phase::Squeezed => self.squeezed.as_ref().map(|probe| &probe.training_range),
            Phase::TestLifted => self.test_lifted.as_ref().map(|probe| &probe.training_range),
            _ => Some(&self.training_range),
        }
    }

    /// The limits that a frame with [`Fault::OutOfDistribution`] violates, each with the value found.
    pub fn violations(&self, phase: Phase, reading: &FeltReading<'_>) -> Vec<Violation> {
        let range = self.training_range_in(phase);
        range.map_or(Vec::new(), |range| range.violations(&self.features, reading.joints, reading.contacts))
    }

    /// Names pads and joints in its limits: files of older versions hold their numbers.
    pub fn name_quantities(&mut self, hand: &Hand) {
        let names = quantities(hand);
        let probes = [&mut self.squeezed, &mut self.test_lifted].into_iter().flatten();
        let ranges = std::iter::once(&mut self.training_range).chain(probes.map(|probe| &mut probe.training_range));
        for range in ranges {
            for (limits, quantity) in range.limits.iter_mut().zip(&names) {
                limits.quantity.clone_from(&quantity.name);
            }
        }
    }

    /// The names of a feature's values ([`FeatureExtractor::value_names`]) without the hand: by the limits of training, which a
    /// model of this version has with names. The hand of an older one's is known if it is built in.
    pub fn value_names(&self) -> Vec<String> {
        if let Ok(hand) = Hand::load(Path::new(&self.hand.name))
            && hand.id() == self.hand.id
        {
            return self.features.value_names(&hand);
        }
        let mut parts = PartNames::default();
        for Limits { quantity, .. } in &self.training_range.limits {
            // Behind the name is the unit.
            let Some((quantity, _)) = quantity.rsplit_once(", ") else { continue };
            parts.joints.extend(quantity.strip_prefix("position of joint "));
            parts.coupled.extend(quantity.strip_prefix("breakaway of joint "));
            parts.pads.extend(quantity.strip_prefix("load of pad "));
        }
        self.features.names_of_values(&parts)
    }

    /// The two values of pads and joints in the feature of a settled frame that speak most against the grasp, and the pad that feels
    /// alone, for people. Only trees can tell, and no model that judges by the day's earlier grasps. `names` are those of the values.
    pub fn speak_against(&self, names: &[String], values: &[f64]) -> Option<String> {
        let trees = match &self.classifier.predictor {
            Predictor::Boosting(trees) => trees,
            Predictor::Blend(blend) => &blend.trees,
            Predictor::Svm(_) | Predictor::Loads(_) => return None,
        };
        if self.day.is_some() || values.len() != trees.n_features || names.len() != values.len() {
            return None;
        }
        let mut against = Vec::new();
        for (idx, contribution) in trees.contributions(values).into_iter().enumerate() {
            // A name with a dot is of a pad or joint; a word of the histogram or a wrench has none.
            if contribution < 0.0 && names[idx].contains('.') {
                against.push((contribution, idx));
            }
        }
        against.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut said = Vec::new();
        for (_, idx) in against.into_iter().take(2) {
            said.push(format!("{} is {}", names[idx], short(self.features.unscaled(idx, values[idx]))));
        }
        if said.is_empty() {
            return None;
        }
        let mut against = format!("of pads and joints, most against it: {}", said.join(", "));
        let mut pads_that_feel = Vec::new();
        for (idx, name) in names.iter().enumerate() {
            if let Some(pad) = name.strip_suffix(".load")
                && self.features.unscaled(idx, values[idx]) > 0.0
            {
                pads_that_feel.push(pad);
            }
        }
        if let [pad] = pads_that_feel[..] {
            against += &format!("; pad {pad} alone feels");
        }
        Some(against)
    }

    /// Whether it judges anything but settled grasps.
    pub fn has_probes(&self) -> bool {
        self.squeezed.is_some() || self.test_lifted.is_some()
    }

    /// Whether it judges frames while the arm lifts.
    pub fn can_watch(&self) -> bool {
        self.test_lifted.is_some() && pad_newtons(&self.features, &vec![0.0; self.features.len()]).is_some()
    }

    /// Whether its answers depend on earlier frames.
    pub fn has_memory(&self) -> bool {
        self.has_probes() || self.day.is_some()
    }

    /// Judges the next frame, by its feature or its fault, and keeps in `memory` what later frames need. `dictionary_id` is
    /// [`Model::dictionary_id`].
    ///
    /// # Errors
    /// The fault: the frame's own, [`Fault::WrongModel`] if the model does not judge this phase, that of the phase before,
    /// [`Fault::MissingReading`] if that did not come. Also [`Fault::NoBaseline`] and [`Fault::UnlikeDay`] if the day
    /// forbids a judgement, and as of [`Classifier::classify`].
    pub fn judge(
        &self,
        memory: &mut Memory,
        dictionary_id: u64,
        place: GraspPlace,
        phase: Phase,
        values: Result<&[f64], Fault>,
    ) -> Result<Verdict, Fault> {
        if let Some(day) = &self.day {
            memory.day.begin(dictionary_id, place, day);
        }
        let verdict = match values {
            // A hand that feels nothing any more while it lifts bears nothing.
            Err(Fault::NoContact) if phase == Phase::Lifting && self.can_watch() => memory.grasp.judge_lifting(0.0),
            values => values.and_then(|values| self.classify(phase, values, place.day, memory)),
        };
        if let (true, Phase::Settled, Ok(values)) = (self.day.is_some(), phase, values) {
            memory.day.settle(place, values);
        }
        match (phase, verdict) {
            (Phase::Kept | Phase::Dropped, _) if memory.adapt != Adapt::Frozen && values != Err(Fault::WrongHand) => {
                let classifier = |look: Phase| Some((self.look(look)?, self.drop_costs(look)));
                let is_kept = phase == Phase::Kept;
                if memory.lifts.lifted(place.grasp_id, is_kept, memory.adapt == Adapt::On, classifier) {
                    return Err(Fault::Changed);
                }
            }
            (_, Ok(verdict)) => {
                if let (Some(classifier), Ok(values)) = (self.look(phase), values) {
                    let settled = if phase == Phase::Settled { numbers(&self.features, values) } else { None };
                    let log_odds = classifier.log_odds(verdict.decision_value);
                    let is_unstable = !verdict.stable && !verdict.unsure;
                    let grasp_id = place.grasp_id;
                    memory.lifts.look(Looked { grasp_id, look: phase, log_odds, is_unstable, settled });
                }
            }
            _ => {}
        }
        if self.has_probes() {
            // A frame that is at fault leaves no feature behind, but its fault.
            let values = verdict.and(values);
            memory.grasp.add((place.epoch, place.grasp_id), phase, values, &signals(&self.features));
            if let (Phase::TestLifted, Ok(values)) = (phase, values)
                && let Some(newtons) = pad_newtons(&self.features, values)
            {
                memory.grasp.bears(newtons);
            }
        }
        verdict
    }

    /// Judges the feature of a frame, with the memory of the frames before it.
    ///
    /// # Errors
    /// As of [`Model::judge`].
    pub fn classify(&self, phase: Phase, values: &[f64], day: u32, memory: &Memory) -> Result<Verdict, Fault> {
        let learned = if memory.adapt == Adapt::Off { None } else { memory.lifts.learned(phase) };
        let classify = |classifier: &Classifier, values: &[f64]| match learned {
            Some(learned) => classifier.classify_by(learned.apply(classifier), values),
            None => classifier.classify(values),
        };
        match (phase, &self.day) {
            (Phase::Squeezed | Phase::TestLifted, _) => {
                let classifier = self.look(phase).ok_or(Fault::WrongModel)?;
                let mut composed = Vec::new();
                memory.grasp.compose(phase, values, &signals(&self.features), &mut composed)?;
                classify(classifier, &composed)
            }
            (Phase::Lifting, _) => {
                if self.test_lifted.is_none() {
                    return Err(Fault::WrongModel);
                }
                memory.grasp.judge_lifting(pad_newtons(&self.features, values).ok_or(Fault::WrongModel)?)
            }
            (_, None) => classify(&self.classifier, values),
            (_, Some(model)) => model.classify(&self.classifier, values, day, &memory.day),
        }
    }

    /// The price of a drop that the threshold of a look was chosen for, in attempts.
    pub fn drop_costs(&self, look: Phase) -> Option<f64> {
        self.training.policies.iter().find(|policy| policy.look == look.as_str()).map(|policy| policy.drop_costs)
    }

    /// The classifier of a look at a grasp that a lift can follow; `None` for the frames between looks. A grasp that is judged by
    /// its day has none: its probability is that day's.
    pub fn look(&self, phase: Phase) -> Option<&Classifier> {
        match phase {
            Phase::Settled if self.day.is_none() => Some(&self.classifier),
            Phase::Squeezed => self.squeezed.as_ref().map(|probe| &probe.classifier),
            Phase::TestLifted => self.test_lifted.as_ref().map(|probe| &probe.classifier),
            _ => None,
        }
    }

    fn validate(&self) -> Result<(), String> {
        self.features.validate().map_err(|error| format!("the features: {error}"))?;
        self.training_range.validate(&self.features).map_err(|error| format!("the training range: {error}"))?;
        self.classifier.validate(self.features.len())?;
        let day = self.day.as_ref().map_or(Ok(()), |day| day.validate(self.features.len()));
        day.map_err(|error| format!("the day: {error}"))?;
        let approach = self.approach.as_ref().map_or(Ok(()), |prior| prior.validate(self.features.couplings.len()));
        approach.map_err(|error| format!("the approach: {error}"))?;
        for (phase, probe) in [(Phase::Squeezed, &self.squeezed), (Phase::TestLifted, &self.test_lifted)] {
            let checked = probe.as_ref().map_or(Ok(()), |probe| probe.validate(&self.features));
            checked.map_err(|error| format!("{}: {error}", phase.as_str()))?;
        }
        Ok(())
    }
}

/// What a text is that could not be read as a model. A model of another version is not one that is damaged.
fn why_not_a_model(text: &str, error: &serde_json::Error) -> InvalidModel {
    #[derive(Deserialize)]
    struct AnyModel {
        format: String,
        #[serde(default)]
        checksum: String,
        #[serde(default)]
        training: serde_json::Value,
    }
    let any: AnyModel = match serde_json::from_str(text) {
        Ok(any) => any,
        Err(error) => return InvalidModel::NotAModel(error.to_string()),
    };
    if any.format != FORMAT {
        return InvalidModel::OtherFormat { found: any.format };
    }
    let reason = error.to_string();
    match any.training["version"].as_str() {
        Some(version) if any.checksum == checksum(text, &any.checksum) => {
            InvalidModel::OtherBuild { version: version.into(), reason }
        }
        _ => InvalidModel::Malformed(reason),
    }
}

/// The checksum that a file with this text should have, given the one that it has.
fn checksum(text: &str, found: &str) -> String {
    match text.split_once(&format!(r#""checksum":"{found}""#)) {
        Some((before, after)) => digest(&[before, UNSIGNED, after]),
        None => digest(&[text]),
    }
}

/// SHA-256 in hex of the parts one after the other, so that no copy of a whole file is needed.
fn digest(parts: &[&str]) -> String {
    let hasher = parts.iter().fold(Sha256::new(), |hasher, part| hasher.chain_update(part));
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_values_have_the_names_of_a_hand_that_is_no_more_known() {
        let mut model = Model::parse(include_str!("../../../models/barrett-bh8-280.json")).expect("a model");
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let names = model.features.value_names(&hand);
        assert_eq!(model.value_names(), names, "of a built-in hand");
        // As training writes them.
        model.name_quantities(&hand);
        model.hand.name = "of-a-stranger".into();
        assert_eq!(model.value_names(), names);
        assert!(names.contains(&"finger_1.load".to_owned()), "{names:?}");
    }

    #[test]
    fn a_file_of_any_size_is_refused_before_it_is_parsed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("model.json");
        // A sparse file, which takes no room on the disk.
        let file = std::fs::File::create(&path).expect("created");
        file.set_len(MAX_BYTES + 1).expect("long");
        let error = Model::load(&path).expect_err("too long").to_string();
        assert!(error.contains("more than 128 MiB"), "{error}");
    }

    #[test]
    fn the_shipped_models_are_read_and_written_with_the_same_text() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("model.json");
        for text in [
            include_str!("../../../models/barrett-bh8-280.json"),
            include_str!("../../../recordings/paper-recipe.json"),
        ] {
            let model = Model::parse(text).expect("a model");
            let hand = crate::hand::Hand::load(Path::new(&model.hand.name)).expect("built in");
            assert_eq!(model.hand.id, hand.id());
            model.save(&path).expect("saved");
            assert_eq!(std::fs::read_to_string(&path).expect("read"), text);
            let edited = text.replacen("0.5", "0.6", 1);
            assert_eq!(Model::parse(&edited), Err(InvalidModel::Checksum));
        }
    }

    #[test]
    fn a_look_after_a_faulty_one_has_its_fault() {
        let model = Model::parse(include_str!("../../../models/barrett-bh8-280-lifts.json")).expect("a model");
        let values = vec![0.0; model.features.len()];
        let felt = Ok(&values[..]);
        let judge_all = |looks: &[(Phase, Result<&[f64], Fault>)]| {
            let mut memory = Memory::default();
            let judge = |(phase, values)| model.judge(&mut memory, 0, GraspPlace::default(), phase, values);
            looks.iter().copied().map(judge).last().expect("a look").map(|_| ())
        };
        let faulty = |phase, fault| (phase, Err(fault));
        let [settled, squeezing, squeezed, lifting, lifted] =
            [Phase::Settled, Phase::Squeezing, Phase::Squeezed, Phase::TestLifting, Phase::TestLifted];
        assert_eq!(judge_all(&[(settled, felt), (squeezing, felt), (squeezed, felt)]), Ok(()));
        for fault in [Fault::NoContact, Fault::OutOfDistribution] {
            let settled = faulty(settled, fault);
            assert_eq!(judge_all(&[settled, (squeezing, felt), (squeezed, felt)]), Err(fault));
            let looks = [settled, (squeezing, felt), (squeezed, felt), (lifting, felt), (lifted, felt)];
            assert_eq!(judge_all(&looks), Err(fault));
        }
        assert_eq!(judge_all(&[(squeezing, felt), (squeezed, felt)]), Err(Fault::MissingReading));
        assert_eq!(judge_all(&[(settled, felt), (squeezed, felt)]), Err(Fault::MissingReading));
    }

    #[test]
    fn other_formats_and_damage_are_told_apart() {
        for (text, expected) in [
            ("", "not a model, or cut off"),
            ("{\"format\": \"blindgrasp-model/1\"}", "format 'blindgrasp-model/1', expected 'blindgrasp-model/2'"),
            ("{\"format\": \"blindgrasp-model/2\"}", "not a valid model"),
        ] {
            let error = Model::parse(text).expect_err("no model").to_string();
            assert!(error.contains(expected), "{error}");
        }
        // A whole file with a field that this version does not know.
        let shipped = include_str!("../../../models/barrett-bh8-280.json");
        let (before, after) = shipped.rsplit_once(r#""checksum":""#).expect("a checksum");
        let old = |checksum: &str| format!("{before}\"machine\":{{}},\"checksum\":\"{checksum}{}", &after[64..]);
        for (checksum, expected) in [
            (digest(&[&old("")]), "another build of blindgrasp, version 0.1.0, wrote it, and this one, version 0."),
            ("0".repeat(64), "not a valid model: unknown field `machine`"),
        ] {
            let error = Model::parse(&old(&checksum)).expect_err("of another build").to_string();
            assert!(error.contains(expected) && error.contains("unknown field `machine`"), "{error}");
        }
    }
}
