//! The report: all figures of an evaluation in one structure, from which JSON and the page are made.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::baselines::Baselines;
use super::comparison::{Comparison, compare};
use super::cross_validation::{HeldOut, HeldOutOptions, N_INNER_FOLDS, used_words};
use super::decisions::{JudgedGrasp, JudgedRecipe, Unit};
use super::looks::{Look, looks};
use super::predictions::{OutsideModel, OutsidePredictions};
use super::split::Split;
use super::statistics::{Estimate, N_RESAMPLES};
use super::{Evaluated, Evaluation, Trained};
use crate::file_name;
use crate::training::{Example, Examples};
use blindgrasp_grasps::reading::SELF_CONTACT;
use blindgrasp_messages::Fault;
use blindgrasp_pictures::DrawnWord;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::recipe::{BlendParams, Learner, Recipe};

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    pub made: Made,
    /// The decisions as the graph makes them, by class and by reason; only of a model.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub graph: Option<Evaluation>,
    /// Which of the grasps a model was trained on; only of a model that names them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained: Option<Trained>,
    /// The looks of a model with probes; empty otherwise.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub looks: Vec<Look>,
    /// Plain rules beside a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub baselines: Option<Baselines>,
    pub data: Data,
    /// The paper's Table I, and the same rows for these data.
    pub table_1: Vec<TableRow>,
    /// The outside models, then the recipes or the model.
    pub judges: Vec<JudgedRecipe>,
    /// Each pair of judges.
    pub comparisons: Vec<Comparison>,
    /// The contact dictionary (the paper's Figure 1).
    pub dictionary: DictionaryUse,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Made {
    pub command: String,
    pub version: String,
    pub hand: String,
    pub recordings: Vec<String>,
    /// The file with predictions of outside models.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub predictions: Option<String>,
    /// The programs that made the recordings, with the number of recordings of each.
    pub made_by: BTreeMap<String, usize>,
    /// The number of simulated recordings with each definition of stable.
    pub labels: BTreeMap<Label, usize>,
    /// How the grasps were split; `None` for a model, which is trained already.
    pub split: Option<SplitMade>,
    /// How intervals are computed.
    pub intervals: String,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SplitMade {
    pub by: Split,
    pub n_folds: usize,
    /// The seed of folds, K-means and boosting.
    pub seed: u64,
    /// Inner folds on which the calibration was fitted.
    pub n_calibration_folds: usize,
}

/// The numbers of grasps that figures are about.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Data {
    /// Grasps with labels: figures over all grasps are about these.
    pub n_grasps: usize,
    pub n_stable: usize,
    /// Grasps that a classifier judged.
    pub n_judged: usize,
    /// The objects of these.
    pub n_judged_objects: usize,
    /// Grasps that were held without a judgement, such as grasps without contact.
    pub n_held_unjudged: usize,
    pub n_held_unjudged_stable: usize,
    /// Grasps that were left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    pub n_objects: usize,
    pub n_classes: usize,
}

/// A row of Table I.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TableRow {
    /// Whether the row is the paper's.
    pub of_paper: bool,
    pub data_set: String,
    /// For folds, the mean over the folds.
    pub n_grasps: f64,
    pub n_stable: f64,
    pub stable_share: f64,
    pub n_unstable: f64,
    /// `None` for training data.
    pub accuracy: Option<Estimate>,
    /// False positives among all grasps; `None` for training data. The paper has it in its text.
    pub false_positive_share: Option<Estimate>,
}

/// A contact dictionary and the use of its words.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct DictionaryUse {
    /// The model or fold that it is of.
    pub from: String,
    /// The posture of the drawn hand: the median of each joint over the grasps, radians.
    pub joints: Vec<f64>,
    pub words: Vec<DrawnWord>,
}

/// The part of [`Made`] that the caller knows.
#[derive(Debug, Clone, PartialEq)]
pub struct Origin {
    pub command: String,
    pub hand: String,
    pub recordings: Vec<String>,
}

/// A judged recipe lifts from this probability on.
pub const THRESHOLD_PROBABILITY: f64 = 0.5;
/// The seed of the intervals of predictions without recipes or a model.
const INTERVAL_SEED: u64 = 1;

/// Makes the report on recipes that were judged on grasps held out, and on predictions of outside models if there are any.
pub fn report_on_recipes(
    origin: Origin,
    read: &Examples,
    options: &HeldOutOptions,
    held_out: &HeldOut,
    outside: Option<&OutsidePredictions>,
) -> Report {
    let unit = if options.split == Split::Grasp { Unit::Grasp } else { Unit::Object };
    let undecided = undecided(read);
    // The decisions of each recipe; the judged grasps come first.
    let main: Vec<Vec<JudgedGrasp>> =
        held_out.probabilities.iter().map(|of_recipe| decided(&undecided, of_recipe, &held_out.folds)).collect();
    let any = main.first().map_or(&[][..], Vec::as_slice);
    let judge = |(recipe, decided): (&Recipe, &Vec<JudgedGrasp>)| {
        JudgedRecipe::new(&recipe.name, about(recipe), THRESHOLD_PROBABILITY, decided.clone(), unit, options.seed)
    };
    let mut judges = outside_judges(outside, any, unit, options.seed);
    judges.extend(options.recipes.iter().zip(&main).map(judge));
    let n_examples = read.examples.len() as f64;
    let n_stable = read.examples.iter().filter(|example| example.stable).count() as f64;
    let in_training = 1.0 - 1.0 / options.n_folds as f64;
    let training =
        row(format!("Training, mean of {} folds", options.n_folds), [n_examples, n_stable].map(|n| n * in_training));
    Report {
        made: made(origin, read, unit, Some(options), outside),
        data: data(any, read.n_excluded.clone()),
        table_1: table_1(Some(training), &judges),
        comparisons: comparisons(&judges, unit, options.seed),
        judges,
        dictionary: DictionaryUse {
            from: format!("what recipe {} learned from all folds but the first", options.recipes[0].name),
            joints: median_joints(&read.examples),
            words: held_out.words.clone(),
        },
        ..Report::default()
    }
}

/// Makes the report on a model, whose decisions are those of the graph, and on predictions of outside models if there are any.
///
/// * `name` - the model's file.
/// * `baselines` - plain rules beside it.
/// * `read` - the same recordings as examples without those that the model was trained on, for its looks and the dictionary's
///   picture.
pub fn report_on_model(
    origin: Origin,
    name: &str,
    model: &Model,
    evaluated: Evaluated,
    read: &Examples,
    baselines: Option<Baselines>,
    outside: Option<&OutsidePredictions>,
) -> Report {
    let Evaluated { evaluation: graph, decided, trained } = evaluated;
    let training = &model.training;
    let unit = Unit::Object;
    let recipe = &training.recipe;
    let about = format!("{}: {}", about(recipe), model.classifier.predictor.summary());
    let without_truth = (graph.n_without_truth > 0).then(|| ("no truth".to_string(), graph.n_without_truth));
    let data = data(&decided, without_truth.into_iter().collect());
    let mut judges = outside_judges(outside, &decided, unit, training.seed);
    let threshold = model.classifier.threshold_probability;
    judges.push(JudgedRecipe::new(name, about, threshold, decided, unit, training.seed));
    let learned_from = row("Training, as the model says".into(), [training.n_grasps as f64, training.n_stable as f64]);
    Report {
        made: made(origin, read, unit, None, outside),
        data,
        table_1: table_1(Some(learned_from), &judges),
        comparisons: comparisons(&judges, unit, training.seed),
        judges,
        dictionary: DictionaryUse {
            from: format!("the model's, and the contacts of these recordings ({name})"),
            joints: median_joints(&read.examples),
            words: used_words(&model.features.dictionary, read.examples.iter()),
        },
        graph: Some(graph),
        trained,
        looks: looks(model, &read.examples),
        baselines,
    }
}

/// Makes the report on predictions of outside models alone.
pub fn report_on_predictions(origin: Origin, read: &Examples, outside: &OutsidePredictions) -> Report {
    let unit = Unit::Object;
    let judges = outside_judges(Some(outside), &undecided(read), unit, INTERVAL_SEED);
    Report {
        made: made(origin, read, unit, None, Some(outside)),
        data: data(judges.first().map_or(&[][..], |judge| judge.decided.as_slice()), read.n_excluded.clone()),
        table_1: table_1(None, &judges),
        comparisons: comparisons(&judges, unit, INTERVAL_SEED),
        judges,
        ..Report::default()
    }
}

/// The labelled grasps without a decision: the examples, then those that no cell feels.
fn undecided(read: &Examples) -> Vec<JudgedGrasp> {
    let mut grasps: Vec<JudgedGrasp> = read.examples.iter().map(of_example).collect();
    grasps.extend(read.unfelt.iter().map(|(recording_idx, truth)| JudgedGrasp {
        recording_idx: *recording_idx,
        grasp_id: truth.grasp_id,
        object: truth.object.clone(),
        class: truth.object_class.clone(),
        stable: truth.stable,
        ..JudgedGrasp::default()
    }));
    grasps
}

fn of_example(example: &Example) -> JudgedGrasp {
    JudgedGrasp {
        recording_idx: example.recording_idx,
        grasp_id: example.grasp_id,
        object: example.object.clone(),
        class: example.class.clone(),
        stable: example.stable,
        ..JudgedGrasp::default()
    }
}

/// The decisions of a recipe by its probabilities of the examples, which come first; the others stay held.
fn decided(undecided: &[JudgedGrasp], probabilities: &[f64], folds: &[usize]) -> Vec<JudgedGrasp> {
    let mut grasps = undecided.to_vec();
    for ((grasp, probability), fold) in grasps.iter_mut().zip(probabilities).zip(folds) {
        *grasp = decide(grasp, Some(*probability), THRESHOLD_PROBABILITY);
        grasp.fold = Some(*fold);
    }
    grasps
}

/// A grasp with the decision by this probability. Without one it is held.
fn decide(grasp: &JudgedGrasp, probability: Option<f64>, threshold_probability: f64) -> JudgedGrasp {
    JudgedGrasp {
        lifted: probability.is_some_and(|probability| probability >= threshold_probability),
        judged: probability.is_some(),
        probability,
        ..grasp.clone()
    }
}

/// The outside models as judges of the same grasps.
fn outside_judges(
    outside: Option<&OutsidePredictions>,
    grasps: &[JudgedGrasp],
    unit: Unit,
    seed: u64,
) -> Vec<JudgedRecipe> {
    let Some(outside) = outside else { return Vec::new() };
    let threshold = outside.threshold_probability;
    let judge = |model: &OutsideModel| {
        let decided = grasps.iter().map(|grasp| decide(grasp, model.probability(grasp), threshold)).collect();
        let about = format!("predictions of {}", file_name(&outside.path));
        JudgedRecipe::new(&model.name, about, threshold, decided, unit, seed)
    };
    outside.models.iter().map(judge).collect()
}

/// Each pair of judges.
fn comparisons(judges: &[JudgedRecipe], unit: Unit, seed: u64) -> Vec<Comparison> {
    let side = |idx: usize| (judges[idx].name.as_str(), judges[idx].decided.as_slice());
    pairs(judges.len()).map(|(first, second)| compare([side(first), side(second)], unit, seed)).collect()
}

/// Each pair of so many, by index.
fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |first| (first + 1..n).map(move |second| (first, second)))
}

fn about(recipe: &Recipe) -> String {
    let blocks: Vec<&str> = recipe.blocks.iter().map(|block| block.about()).collect();
    let learner = match &recipe.learner {
        Learner::Svm(params) => format!("RBF SVM (C {}, gamma {})", params.c, params.gamma),
        Learner::Boosting(params) => format!("{} boosted trees", params.n_rounds),
        Learner::Loads => "a plain rule".into(),
        Learner::Blend(BlendParams { boosting, svm, svm_weight }) => {
            format!("{} boosted trees + {svm_weight} x RBF SVM (C {}, gamma {})", boosting.n_rounds, svm.c, svm.gamma)
        }
    };
    format!("{learner} on {}", blocks.join(", "))
}

fn made(
    origin: Origin,
    read: &Examples,
    unit: Unit,
    options: Option<&HeldOutOptions>,
    outside: Option<&OutsidePredictions>,
) -> Made {
    let mut makers: BTreeMap<String, usize> = BTreeMap::new();
    read.made_by.iter().for_each(|maker| *makers.entry(maker.clone()).or_default() += 1);
    let intervals = match unit {
        Unit::Grasp => format!(
            "95 %: Wilson's for shares, {N_RESAMPLES} bootstrap resamples of grasps for comparisons; grasps count as \
             independent"
        ),
        Unit::Object => format!(
            "95 %: percentiles of {N_RESAMPLES} bootstrap resamples of whole objects, because grasps of one object go \
             right or wrong together; of shares of 0 and 100 % Wilson's, each object counting once"
        ),
    };
    Made {
        command: origin.command,
        version: env!("CARGO_PKG_VERSION").into(),
        hand: origin.hand,
        recordings: origin.recordings,
        predictions: outside.map(|outside| file_name(&outside.path)),
        made_by: makers,
        labels: read.labels.clone(),
        split: options.map(|options| SplitMade {
            by: options.split,
            n_folds: options.n_folds,
            seed: options.seed,
            n_calibration_folds: N_INNER_FOLDS,
        }),
        intervals,
    }
}

fn data(decided: &[JudgedGrasp], n_excluded: BTreeMap<String, usize>) -> Data {
    let distinct = |of: fn(&JudgedGrasp) -> &String| decided.iter().map(of).collect::<BTreeSet<_>>().len();
    let judged = decided.iter().filter(|grasp| grasp.judged);
    let count = |wanted: fn(&JudgedGrasp) -> bool| decided.iter().filter(|grasp| wanted(grasp)).count();
    Data {
        n_grasps: decided.len(),
        n_stable: count(|grasp| grasp.stable),
        n_judged: count(|grasp| grasp.judged),
        n_judged_objects: judged.map(|grasp| &grasp.object).collect::<BTreeSet<_>>().len(),
        n_held_unjudged: count(|grasp| !grasp.judged),
        n_held_unjudged_stable: count(|grasp| !grasp.judged && grasp.stable),
        // Grasps without contact are in the figures over all grasps.
        n_excluded: n_excluded
            .into_iter()
            .filter(|(reason, _)| reason != Fault::NoContact.as_str() && reason != SELF_CONTACT)
            .collect(),
        n_objects: distinct(|grasp| &grasp.object),
        n_classes: distinct(|grasp| &grasp.class),
    }
}

fn row(data_set: String, [n_grasps, n_stable]: [f64; 2]) -> TableRow {
    TableRow {
        of_paper: false,
        data_set,
        n_grasps,
        n_stable,
        stable_share: if n_grasps > 0.0 { n_stable / n_grasps } else { 0.0 },
        n_unstable: n_grasps - n_stable,
        accuracy: None,
        false_positive_share: None,
    }
}

/// The paper's rows, then the rows of these data.
fn table_1(training: Option<TableRow>, judges: &[JudgedRecipe]) -> Vec<TableRow> {
    let exactly = |value| Some(Estimate { value, interval: None });
    let paper = |data_set: &str, numbers| TableRow { of_paper: true, ..row(data_set.into(), numbers) };
    let mut rows = vec![
        paper("Training", [24_640.0, 11_849.0]),
        TableRow {
            accuracy: exactly(0.81),
            false_positive_share: exactly(0.086),
            ..paper("Test", [12_320.0, 5_914.0])
        },
    ];
    rows.extend(training);
    for judge in judges {
        for (what, measures) in [("", &judge.judged), (", and grasps held unjudged", &judge.all)] {
            if what.is_empty() || judge.all.n_grasps > judge.judged.n_grasps {
                rows.push(TableRow {
                    accuracy: measures.accuracy,
                    false_positive_share: measures.false_positive_share,
                    ..row(format!("Test, {}{what}", judge.name), [measures.n_grasps as f64, measures.n_stable as f64])
                });
            }
        }
    }
    rows
}

/// The median of each joint; empty without examples.
fn median_joints(examples: &[Example]) -> Vec<f64> {
    let n_joints = examples.first().map_or(0, |example| example.joints.len());
    (0..n_joints)
        .map(|joint| {
            let mut angles: Vec<f64> =
                examples.iter().filter_map(|example| example.joints.get(joint).copied()).collect();
            angles.sort_by(f64::total_cmp);
            angles[angles.len() / 2]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recipe_is_described_in_words() {
        let of = |name: &str| about(&Recipe::named(name).expect("known"));
        assert!(
            of("boosted")
                .ends_with("on contact histogram, load of each pad, joint angles, breakaway of coupled joints")
        );
        let expected = "on force on each cell, force on each cell relative to its pad, joint angles";
        assert!(of("blend").ends_with(expected), "{}", of("blend"));
    }
}
