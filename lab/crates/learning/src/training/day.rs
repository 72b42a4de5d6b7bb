//! Learns the part of a model that deals with recording days: see [`blindgrasp_stages::day`].
//!
//! A recording without days counts as one day of its own. For a baseline, the features of the training are scaled day by day.
//! Calibration and figures come from pseudo-days: grasps of up to ten objects that the machine has not seen, of one day, in
//! random order, each judged by those before it alone, as in the graph.

use std::collections::{BTreeMap, BTreeSet};

use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::{Example, Fitted, OutOfFold, TrainingError, fit};
use crate::learners::decision_values;
use crate::learners::training_range::FALSE_ALARM_SHARE;
use blindgrasp_stages::day::{
    Baseline, DayMethod, DayModel, DayStatistics, MIN_BASELINE_GRASPS, MIN_NOVELTY_GRASPS, TrainingDays, day_distance,
    root_mean_square,
};
use blindgrasp_stages::encoder::FeatureExtractor;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::recipe::Recipe;

/// Grasps of a pseudo-day: those of the baseline, and at most three times as many after it.
const MAX_PSEUDO_GRASPS: usize = 4 * MIN_BASELINE_GRASPS as usize;
/// The fewest, so that a few are judged.
const MIN_PSEUDO_GRASPS: usize = MIN_BASELINE_GRASPS as usize + 10;
/// Objects of a pseudo-day.
const MAX_PSEUDO_OBJECTS: usize = 10;
/// Grasps of a day for each pseudo-day that is drawn from them.
const GRASPS_PER_PSEUDO_DAY: usize = 60;

/// Short days, of few objects, that are drawn to learn how far apart such days are.
const N_SHORT_DAYS: usize = 1000;
const N_SHORT_DAY_OBJECTS: usize = 3;
/// This share of them is nearer to the training day that they are of than the limit.
const SHORT_DAYS_WITHIN: f64 = 0.99;

/// A recording day, or a recording without days.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Day {
    Numbered(u32),
    Recording(usize),
}

impl Day {
    fn of(example: &Example) -> Day {
        match example.day {
            0 => Day::Recording(example.recording_idx),
            day => Day::Numbered(day),
        }
    }
}

/// The indices of the examples of each day.
fn by_day(examples: &[&Example]) -> BTreeMap<Day, Vec<usize>> {
    let mut days: BTreeMap<Day, Vec<usize>> = BTreeMap::new();
    for (idx, example) in examples.iter().enumerate() {
        days.entry(Day::of(example)).or_default().push(idx);
    }
    days
}

/// Scales the features of each day to mean 0 and standard deviation 1, and returns the variance of each value within a day: the mean
/// over the days.
pub(super) fn scale_by_day(rows: &mut [f64], n_values: usize, examples: &[&Example]) -> Vec<f64> {
    let days: Vec<Vec<usize>> = by_day(examples).into_values().collect();
    let statistics: Vec<DayStatistics> =
        days.iter().map(|idxs| statistics_of(rows, n_values, idxs.iter().copied())).collect();
    let variance = |value_idx: usize| {
        let of_day = |day: &DayStatistics| day.squares[value_idx] / day.n_grasps as f64;
        statistics.iter().map(of_day).sum::<f64>() / statistics.len() as f64
    };
    let variances: Vec<f64> = (0..n_values).map(variance).collect();
    for (idxs, statistics) in days.iter().zip(&statistics) {
        let scaling = statistics.scaling();
        idxs.iter().for_each(|idx| scaling.apply(&mut rows[idx * n_values..][..n_values]));
    }
    variances
}

/// The statistics of some rows.
fn statistics_of(rows: &[f64], n_values: usize, idxs: impl Iterator<Item = usize>) -> DayStatistics {
    let mut statistics = DayStatistics::default();
    idxs.for_each(|idx| statistics.add(&rows[idx * n_values..][..n_values]));
    statistics
}

/// The part of a model that is about days. It is `None` if no baseline is asked for, and the recordings do not say days or
/// each day has one object, so that a day cannot be told from an object.
///
/// # Errors
/// An example without a feature.
pub(super) fn learn(
    recipe: &Recipe,
    fitted: &Fitted,
    examples: &[&Example],
    seed: u64,
) -> Result<Option<DayModel>, TrainingError> {
    let method = if recipe.day_baseline {
        DayMethod::Baseline(baseline(fitted, examples, seed)?)
    } else if examples.iter().all(|example| example.day != 0) {
        match training_days(&fitted.features, examples, seed)? {
            Some(days) => DayMethod::Novelty(days),
            None => return Ok(None),
        }
    } else {
        return Ok(None);
    };
    Ok(Some(DayModel { method, recalibration: None }))
}

fn baseline(fitted: &Fitted, examples: &[&Example], seed: u64) -> Result<Baseline, TrainingError> {
    let rows = pseudo_days(fitted, examples, seed)?.1;
    let mut sizes: Vec<f64> = rows.chunks(fitted.features.len()).map(root_mean_square).collect();
    sizes.sort_by(f64::total_cmp);
    let limit = sizes.get(((1.0 - FALSE_ALARM_SHARE) * sizes.len() as f64) as usize).copied().unwrap_or(f64::MAX);
    Ok(Baseline { min_grasps: MIN_BASELINE_GRASPS, limit, variances: fitted.day_variances.clone() })
}

fn training_days(
    features: &FeatureExtractor,
    examples: &[&Example],
    seed: u64,
) -> Result<Option<TrainingDays>, TrainingError> {
    let (rows, n_values) = (super::rows(features, examples)?, features.len());
    let statistics = |idxs: &mut dyn Iterator<Item = usize>| statistics_of(&rows, n_values, idxs);
    let days: Vec<Vec<usize>> = by_day(examples).into_values().collect();
    let of_days: Vec<DayStatistics> = days.iter().map(|idxs| statistics(&mut idxs.iter().copied())).collect();
    let variance = |value_idx: usize| {
        let squares: f64 = of_days.iter().map(|day| day.squares[value_idx]).sum();
        squares / examples.len() as f64
    };
    let deviations: Vec<f64> = (0..n_values).map(|value_idx| variance(value_idx).sqrt()).collect();
    // How far a day is from itself that has seen other objects.
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut distances = Vec::new();
    for draw in 0..N_SHORT_DAYS {
        let idxs = &days[draw % days.len()];
        let objects = drawn_objects(idxs, examples, N_SHORT_DAY_OBJECTS, &mut rng);
        let (mut short, rest): (Vec<usize>, Vec<usize>) =
            idxs.iter().partition(|idx| objects.contains(examples[**idx].object.as_str()));
        if rest.is_empty() {
            continue;
        }
        short.shuffle(&mut rng);
        short.truncate(MIN_NOVELTY_GRASPS as usize);
        let (short, rest) = (statistics(&mut short.into_iter()), statistics(&mut rest.into_iter()));
        distances.push(day_distance(&short.mean, &rest.mean, &deviations));
    }
    distances.sort_by(f64::total_cmp);
    let limit = distances.get((SHORT_DAYS_WITHIN * distances.len() as f64) as usize).copied();
    let Some(limit) = limit.filter(|limit| *limit > 0.0) else { return Ok(None) };
    let means = of_days.into_iter().map(|day| day.mean).collect();
    Ok(Some(TrainingDays { min_grasps: MIN_NOVELTY_GRASPS, means, deviations, limit }))
}

fn drawn_objects<'a>(
    idxs: &[usize],
    examples: &[&'a Example],
    n_most: usize,
    rng: &mut ChaCha8Rng,
) -> BTreeSet<&'a str> {
    let objects: BTreeSet<&str> = idxs.iter().map(|idx| examples[*idx].object.as_str()).collect();
    let mut objects: Vec<&str> = objects.into_iter().collect();
    objects.shuffle(rng);
    objects.into_iter().take(n_most).collect()
}

/// Judges each fold's examples in pseudo-days, by a machine that was trained without them.
///
/// # Errors
/// As of [`fit`], or no fold has enough grasps of a day.
pub(super) fn cross_validate<'a>(
    hand: &Hand,
    recipe: &Recipe,
    examples: &[&'a Example],
    folds: &[usize],
    seed: u64,
    mut progress: impl FnMut(usize),
) -> Result<OutOfFold<'a>, TrainingError> {
    let mut judged = OutOfFold::default();
    for fold in folds.iter().copied().collect::<BTreeSet<_>>() {
        progress(fold);
        let of = |is_held_out: bool| {
            let idxs = (0..examples.len()).filter(|idx| (folds[*idx] == fold) == is_held_out);
            idxs.map(|idx| examples[idx]).collect::<Vec<&Example>>()
        };
        let fitted = fit(hand, recipe, &of(false), seed)?;
        let of_fold = judge(&fitted, &of(true), seed)?;
        judged.folds.extend(std::iter::repeat_n(fold, of_fold.examples.len()));
        judged.examples.extend(of_fold.examples);
        judged.decision_values.extend(of_fold.decision_values);
    }
    if judged.examples.is_empty() {
        return Err(TrainingError::Data(format!(
            "a baseline of the day needs {MIN_PSEUDO_GRASPS} grasps of one day in a fold, and no fold has them: expected longer \
             days (import --day, --day-column), or a model without --day-baseline"
        )));
    }
    Ok(judged)
}

/// Judges examples in pseudo-days.
///
/// # Errors
/// An example without a feature.
fn judge<'a>(fitted: &Fitted, examples: &[&'a Example], seed: u64) -> Result<OutOfFold<'a>, TrainingError> {
    let (examples, rows) = pseudo_days(fitted, examples, seed)?;
    let decision_values = decision_values(&fitted.predictor, &rows)?;
    Ok(OutOfFold { examples, decision_values, folds: Vec::new() })
}

/// The grasps of pseudo-days after the first ones, and their values relative to those before them, row after row.
fn pseudo_days<'a>(
    fitted: &Fitted,
    examples: &[&'a Example],
    seed: u64,
) -> Result<(Vec<&'a Example>, Vec<f64>), TrainingError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (rows, n_values) = (super::rows(&fitted.features, examples)?, fitted.features.len());
    let (mut judged, mut judged_rows) = (Vec::new(), Vec::new());
    for idxs in by_day(examples).into_values() {
        for _ in 0..idxs.len().div_ceil(GRASPS_PER_PSEUDO_DAY) {
            let objects = drawn_objects(&idxs, examples, MAX_PSEUDO_OBJECTS, &mut rng);
            let mut order: Vec<usize> =
                idxs.iter().copied().filter(|idx| objects.contains(examples[*idx].object.as_str())).collect();
            order.shuffle(&mut rng);
            order.truncate(MAX_PSEUDO_GRASPS);
            if order.len() < MIN_PSEUDO_GRASPS {
                continue;
            }
            let mut statistics = DayStatistics::default();
            for idx in order {
                let row = &rows[idx * n_values..][..n_values];
                if statistics.n_grasps >= MIN_BASELINE_GRASPS {
                    let start = judged_rows.len();
                    judged_rows.extend_from_slice(row);
                    statistics.scaling().apply(&mut judged_rows[start..]);
                    judged.push(examples[idx]);
                }
                statistics.add(row);
            }
        }
    }
    Ok((judged, judged_rows))
}
