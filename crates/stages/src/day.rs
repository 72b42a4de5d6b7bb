//! Judges a grasp by the other grasps of its recording day.
//!
//! Skins drift: on the fingertips of a BioTac SP hand, the mean of an electrode moves by more than a standard deviation from one
//! day to another. A threshold that was right on one day is wrong on the next. A model can do one of two things about it
//! ([`DayModel`]): judge each value relative to the mean and the deviation of the day's earlier grasps, without labels. Or it
//! can hold while the day is unlike the days that it was trained on.
//!
//! Pure: no clock, no I/O. [`DayMemory`] is the state. A grasp is judged by earlier grasps alone, never by itself.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::classifier::{Classifier, Verdict};
use crate::encoder::Scaling;
use blindgrasp_messages::Fault;

/// Grasps of a day before a baseline judges.
pub const MIN_BASELINE_GRASPS: u64 = 30;

/// Grasps of a day before it is compared with the days of the training.
pub const MIN_NOVELTY_GRASPS: u64 = 10;

/// The greatest number that a day is given by; names of days have greater ones.
pub const MAX_DAY: u32 = 999_999_999;

/// The number of a day. Dates (20261124; 2026-11-24, also with a time) and whole numbers from 1 to [`MAX_DAY`] (also 3.0, as pandas
/// writes them) are their digits. Any other name has a number above, made of its SHA-256, which is the same in all recordings.
pub fn day_number(name: &str) -> u32 {
    let name = name.trim();
    let is_time = matches!(name.as_bytes(), [_, _, _, _, b'-', _, _, b'-', _, _, b' ' | b'T', _, _, b':', ..]);
    let name = if is_time { &name[..10] } else { name };
    let digits: String = name.strip_suffix(".0").unwrap_or(name).split('-').collect();
    let is_number = digits.len() <= 9 && digits.bytes().all(|byte| byte.is_ascii_digit());
    match digits.parse() {
        Ok(day @ 1..=MAX_DAY) if is_number => day,
        _ => {
            let digest = Sha256::digest(name);
            let first = digest.iter().take(4).fold(0, |sum, byte| (sum << 8) | u32::from(*byte));
            MAX_DAY + 1 + first % 3_000_000_000
        }
    }
}

/// Number, mean and sum of squared differences from the mean (Welford) of the features of grasps.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DayStatistics {
    pub n_grasps: u64,
    pub mean: Vec<f64>,
    pub squares: Vec<f64>,
}

impl DayStatistics {
    /// Adds the feature of a grasp. A feature of another length replaces the statistics.
    pub fn add(&mut self, values: &[f64]) {
        if self.mean.len() != values.len() {
            *self = DayStatistics { n_grasps: 0, mean: vec![0.0; values.len()], squares: vec![0.0; values.len()] };
        }
        self.n_grasps += 1;
        for ((value, mean), squares) in values.iter().zip(&mut self.mean).zip(&mut self.squares) {
            let before = value - *mean;
            *mean += before / self.n_grasps as f64;
            *squares += before * (value - *mean);
        }
    }

    /// The map of each value to mean 0 and standard deviation 1 over these grasps.
    pub fn scaling(&self) -> Scaling {
        let deviations = self.squares.iter().map(|squares| (squares / self.n_grasps.max(1) as f64).max(0.0).sqrt());
        Scaling::new(self.mean.clone(), deviations)
    }

    fn validate(&self, n_values: usize) -> Result<(), String> {
        let is_finite = self.mean.iter().chain(&self.squares).all(|number| number.is_finite());
        if self.mean.len() != n_values || self.squares.len() != n_values || !is_finite || self.n_grasps == 0 {
            return Err(format!("expected statistics of {n_values} finite values over at least one grasp"));
        }
        Ok(())
    }
}

/// A model's account of days.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DayModel {
    pub method: DayMethod,
    /// The correction for one day, by its labelled grasps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recalibration: Option<Recalibration>,
}

/// How a model deals with a day that it was not trained on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum DayMethod {
    /// Each value is judged relative to the earlier grasps of the day. Training data are scaled day by day.
    Baseline(Baseline),
    /// The day's mean is compared with those of the training's days; the grasp is held if it is too far from all of them.
    Novelty(TrainingDays),
}

/// Judging relative to the day.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    pub min_grasps: u64,
    /// A grasp is unlike those trained on from this root mean square of its scaled values on.
    pub limit: f64,
    /// The variance of each value within a day of the training.
    pub variances: Vec<f64>,
}

/// The root mean square of the values of a feature.
pub fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// The days of the training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingDays {
    pub min_grasps: u64,
    /// The mean feature of each day.
    pub means: Vec<Vec<f64>>,
    /// The standard deviation of each value within a day.
    pub deviations: Vec<f64>,
    /// The distance ([`TrainingDays::distance`]) from which a day is unlike all of them.
    pub limit: f64,
}

impl TrainingDays {
    /// The root mean square difference of a day's mean to that of the nearest training day, in standard deviations within
    /// a day.
    pub fn distance(&self, mean: &[f64]) -> f64 {
        self.means.iter().map(|day| day_distance(mean, day, &self.deviations)).fold(f64::INFINITY, f64::min)
    }
}

/// The root mean square difference of two means, in `deviations`. A value without deviation counts if the means differ.
pub fn day_distance(mean: &[f64], other: &[f64], deviations: &[f64]) -> f64 {
    let sum: f64 =
        mean.iter().zip(other).zip(deviations).map(|((a, b), deviation)| ratio(a - b, *deviation).powi(2)).sum();
    (sum / mean.len().max(1) as f64).sqrt()
}

fn ratio(difference: f64, deviation: f64) -> f64 {
    if deviation > 1e-9 {
        difference / deviation
    } else {
        // The posture of a whole day may be one number: another one is a difference of its own.
        f64::from(u8::from(difference.abs() > 1e-6))
    }
}

/// The correction of the log-odds of a day's grasps by its labelled ones. A grasp's correction is the sum over the labelled grasps of
/// their weight times their covariance with it: the most probable value of a Gaussian process given the labels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recalibration {
    pub day: u32,
    /// The day's grasps so far, with which an operator begins that has seen none of them.
    pub statistics: DayStatistics,
    /// The variance of each value within a day of the training, in units of which grasps are compared.
    pub variances: Vec<f64>,
    pub grasps: Vec<LabelledGrasp>,
}

/// A labelled grasp of a day.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelledGrasp {
    /// Its feature.
    pub values: Vec<f64>,
    /// The model's log-odds.
    pub log_odds: f64,
    pub weight: f64,
}

/// The covariance of two corrections is this variance times exp(-rate × d²), where d² is the mean squared difference of the two
/// grasps' values in units of `variances`. To it comes that of an offset, the same for all grasps, and of a slope, in
/// proportion to the log-odds. Chosen on the training tables of the BioTac SP set, one left out in turn.
const KERNEL_VARIANCE: f64 = 8.0;
const KERNEL_RATE: f64 = 3.0;
const OFFSET_DEVIATION: f64 = 0.5;
const SLOPE_DEVIATION: f64 = 0.1;

/// The covariance of the corrections of two grasps, by their values and log-odds. Within a day, differences of values need no
/// baseline.
pub fn covariance((a, a_log_odds): (&[f64], f64), (b, b_log_odds): (&[f64], f64), variances: &[f64]) -> f64 {
    let of_value =
        |((a, b), variance): ((&f64, &f64), &f64)| if *variance > 0.0 { (a - b).powi(2) / variance } else { 0.0 };
    let distance = a.iter().zip(b).zip(variances).map(of_value).sum::<f64>() / variances.len().max(1) as f64;
    KERNEL_VARIANCE * libm::exp(-KERNEL_RATE * distance)
        + OFFSET_DEVIATION.powi(2)
        + SLOPE_DEVIATION.powi(2) * a_log_odds * b_log_odds
}

impl Recalibration {
    /// The corrected log-odds of a grasp of the day.
    pub fn correct(&self, values: &[f64], log_odds: f64) -> f64 {
        let alike = |grasp: &LabelledGrasp| {
            grasp.weight * covariance((values, log_odds), (&grasp.values, grasp.log_odds), &self.variances)
        };
        log_odds + self.grasps.iter().map(alike).sum::<f64>()
    }
}

/// The frame's place: which day and grasp it is of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GraspPlace {
    pub epoch: u64,
    pub grasp_id: u64,
    /// 0 if it is not known: then each run of the source counts as a day.
    pub day: u32,
}

impl GraspPlace {
    fn day_key(&self) -> (u32, u64) {
        (self.day, if self.day == 0 { self.epoch } else { 0 })
    }
}

/// The grasps of the present day.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DayMemory {
    /// [`Model::dictionary_id`](crate::model::Model::dictionary_id) of the features, and the day.
    of: Option<(u64, (u32, u64))>,
    /// Of the grasps before the present one.
    statistics: DayStatistics,
    /// The present grasp, and its feature when the hand settled.
    present: Option<(GraspPlace, Vec<f64>)>,
}

impl DayMemory {
    /// Begins with another recording or run of a source: a day without a number ends.
    pub(crate) fn begin_recording(&mut self) {
        self.finish();
        if self.of.is_some_and(|(_, (day, _))| day == 0) {
            *self = DayMemory::default();
        }
    }

    fn finish(&mut self) {
        if let Some((_, values)) = self.present.take() {
            self.statistics.add(&values);
        }
    }

    /// Begins with a frame: another day forgets, another grasp finishes the one before.
    pub(crate) fn begin(&mut self, dictionary_id: u64, place: GraspPlace, model: &DayModel) {
        let of = Some((dictionary_id, place.day_key()));
        if self.of != of {
            let known = model.recalibration.as_ref().filter(|known| known.day == place.day && place.day != 0);
            let statistics = known.map(|known| known.statistics.clone()).unwrap_or_default();
            *self = DayMemory { of, statistics, present: None };
        }
        if self.present.as_ref().is_some_and(|(present, _)| *present != place) {
            self.finish();
        }
    }

    /// Takes the feature of the settled hand. The first one of a grasp counts.
    pub(crate) fn settle(&mut self, place: GraspPlace, values: &[f64]) {
        if self.present.is_none() {
            self.present = Some((place, values.to_vec()));
        }
    }
}

impl DayModel {
    /// Judges a feature by the day's earlier grasps.
    ///
    /// # Errors
    /// [`Fault::NoBaseline`] if there are too few of them, [`Fault::UnlikeDay`], [`Fault::OutOfDistribution`], and as of [`Classifier::classify`].
    pub(crate) fn classify(
        &self,
        classifier: &Classifier,
        values: &[f64],
        day: u32,
        memory: &DayMemory,
    ) -> Result<Verdict, Fault> {
        let statistics = &memory.statistics;
        let recalibration = self.recalibration.as_ref().filter(|known| known.day == day && day != 0);
        let mut scaled = values.to_vec();
        match &self.method {
            DayMethod::Baseline(baseline) => {
                if statistics.n_grasps < baseline.min_grasps || statistics.mean.len() != values.len() {
                    return Err(Fault::NoBaseline);
                }
                statistics.scaling().apply(&mut scaled);
                if root_mean_square(&scaled) >= baseline.limit {
                    return Err(Fault::OutOfDistribution);
                }
            }
            DayMethod::Novelty(days) => {
                if statistics.n_grasps < days.min_grasps || statistics.mean.len() != values.len() {
                    return Err(Fault::NoBaseline);
                }
                // The labels of a day have corrected the model for it, even if it is unlike the training's days.
                if recalibration.is_none() && days.distance(&statistics.mean) > days.limit {
                    return Err(Fault::UnlikeDay);
                }
            }
        }
        let verdict = classifier.classify(&scaled)?;
        match recalibration {
            Some(known) => classifier
                .verdict(verdict.decision_value, known.correct(values, classifier.log_odds(verdict.decision_value))),
            None => Ok(verdict),
        }
    }

    /// Checks a model that was read from a file.
    ///
    /// # Errors
    /// The first problem found.
    pub(crate) fn validate(&self, n_values: usize) -> Result<(), String> {
        let are_variances = |variances: &[f64]| {
            variances.len() == n_values && variances.iter().all(|variance| variance.is_finite() && *variance >= 0.0)
        };
        if let DayMethod::Baseline(Baseline { limit, variances, .. }) = &self.method {
            if !(limit.is_finite() && *limit > 0.0) {
                return Err(format!("the limit of scaled values is {limit}, expected more than 0"));
            }
            if !are_variances(variances) {
                return Err(format!("expected variances of {n_values} values within a day"));
            }
        }
        if let DayMethod::Novelty(days) = &self.method {
            let rows = days.means.iter().chain([&days.deviations]);
            let fits = |row: &Vec<f64>| row.len() == n_values && row.iter().all(|number| number.is_finite());
            if days.means.is_empty() || !rows.clone().all(fits) || !(days.limit.is_finite() && days.limit > 0.0) {
                return Err(format!("expected means of days of {n_values} finite values, and a limit above 0"));
            }
        }
        let Some(Recalibration { statistics, variances, grasps, .. }) = &self.recalibration else { return Ok(()) };
        let is_whole = |grasp: &LabelledGrasp| {
            let LabelledGrasp { values, log_odds, weight } = grasp;
            values.len() == n_values && values.iter().chain([log_odds, weight]).all(|number| number.is_finite())
        };
        if !are_variances(variances) || !grasps.iter().all(is_whole) {
            return Err(format!(
                "the recalibration: expected labelled grasps of {n_values} finite values, and variances"
            ));
        }
        statistics.validate(n_values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn running_statistics_are_those_of_all_grasps() {
        let rows = [[1.0, 5.0, 7.0], [2.0, 5.0, -7.0], [6.0, 5.0, 0.5]];
        let mut statistics = DayStatistics::default();
        rows.iter().for_each(|row| statistics.add(row));
        let (found, expected) = (statistics.scaling(), Scaling::of(&rows.concat(), 3));
        for (a, b) in
            found.mean.iter().zip(&expected.mean).chain(found.per_deviation.iter().zip(&expected.per_deviation))
        {
            assert!((a - b).abs() < 1e-12, "{found:?} {expected:?}");
        }
        assert_eq!(found.per_deviation[1], 0.0, "a value that never changes says nothing");
    }

    #[test]
    fn dates_and_numbers_are_their_own_days() {
        for (name, day) in [(" 20261124 ", 20_261_124), ("3", 3), ("3.0", 3), ("999999999", MAX_DAY)] {
            assert_eq!(day_number(name), day);
        }
        for name in ["2026-11-24", "2026-11-24 10:00:01.5", "2026-11-24T00:00:00.000000000", "20261124.0"] {
            assert_eq!(day_number(name), 20_261_124, "{name}");
        }
        assert!(day_number("2026-11-24 evening") > MAX_DAY);
        let named = ["palm down", "palm 45", "0", ".0.0", "", "-", "+3", "1000000000", "0000000000001"].map(day_number);
        let distinct: std::collections::BTreeSet<u32> = named.into_iter().collect();
        assert!(named.iter().all(|day| *day > MAX_DAY) && distinct.len() == named.len(), "{named:?}");
    }

    #[test]
    fn a_grasp_is_judged_by_those_of_its_day_before_it_alone() {
        let method = DayMethod::Baseline(Baseline { min_grasps: 2, limit: 10.0, variances: vec![1.0] });
        let model = DayModel { method, recalibration: None };
        let mut memory = DayMemory::default();
        for (epoch, grasp_id, day, value, n_before, mean) in [
            (3, 0, 5, 1.0, 0, None),
            // A second frame of the grasp changes nothing.
            (3, 0, 5, 9.0, 0, None),
            (3, 1, 5, 3.0, 1, Some(1.0)),
            (3, 2, 5, 7.0, 2, Some(2.0)),
            // Another day has no statistics yet.
            (3, 3, 6, 7.0, 0, None),
            (3, 4, 6, 7.0, 1, Some(7.0)),
            // Without a day, each run of the source is one.
            (4, 5, 0, 0.5, 0, None),
            (4, 6, 0, 0.5, 1, Some(0.5)),
            (5, 7, 0, 0.5, 0, None),
            (5, 8, 9, 0.5, 0, None),
            (6, 9, 9, 0.5, 1, Some(0.5)),
        ] {
            let place = GraspPlace { epoch, grasp_id, day };
            memory.begin(1, place, &model);
            let before = &memory.statistics;
            assert_eq!((before.n_grasps, before.mean.first().copied()), (n_before, mean), "{place:?}");
            memory.settle(place, &[value]);
        }
    }

    #[test]
    fn the_nearest_training_day_counts() {
        let days = TrainingDays {
            min_grasps: 1,
            means: vec![vec![0.0, 0.0, 1.0], vec![10.0, 0.0, 1.0]],
            deviations: vec![2.0, 1.0, 0.0],
            limit: 1.0,
        };
        assert_eq!(days.distance(&[10.0, 0.0, 1.0]), 0.0);
        assert_eq!(days.distance(&[4.0, 0.0, 1.0]), (4.0_f64 / 3.0).sqrt());
        assert_eq!(days.distance(&[0.0, 0.0, 3.0]), (1.0_f64 / 3.0).sqrt(), "a value that was always the same");
    }
}
