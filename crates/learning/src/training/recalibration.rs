//! Corrects a model for one day by the labelled grasps of that day.
//!
//! The log-odds of the model are scaled and shifted, by the two numbers that are most probable given the labels and a normal
//! prior: a slope near 1, because the ranking of grasps survives another day, and an offset that may be large.

use std::path::PathBuf;

use super::{Example, Examples, Relabelling, TrainingError};
use crate::learners::decision_values;
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::day::{DayMethod, DayStatistics, Recalibration};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

/// The fewest labelled grasps.
const MIN_LABELLED: usize = 20;
/// Standard deviations of the prior of the slope about 1 and of the offset about 0.
const SLOPE_DEVIATION: f64 = 0.3;
const OFFSET_DEVIATION: f64 = 1.5;

/// The model, corrected for the day of labelled recordings. The grasps count as trained on.
///
/// # Errors
/// Recordings of several days or of none, that the model was trained on, or with too few labelled grasps; or a model that does
/// not look at days.
pub fn recalibrate(hand: &Hand, model: &Model, recordings: &[PathBuf]) -> Result<Model, TrainingError> {
    let refused = |message: String| Err(TrainingError::Data(message));
    let Some(day_model) = &model.day else {
        return refused(
            "the model does not look at days: expected one that was trained with --day-baseline, or on recordings with days \
             (import --day)"
                .into(),
        );
    };
    if model.hand.id != hand.id() {
        return refused(format!("the recordings are of the hand '{}', the model of '{}'", hand.name, model.hand.name));
    }
    let read = Examples::read(hand, recordings, &Relabelling::default(), |_, _| {})?;
    let day = match &read.examples[..] {
        [first, rest @ ..] if first.day != 0 && rest.iter().all(|example| example.day == first.day) => first.day,
        _ => return refused("expected labelled grasps of one day, which each frame says (import --day)".into()),
    };
    let trained_on = model.training.trained_on.clone().unwrap_or_default();
    if let Some(known) = read.examples.iter().find(|example| trained_on.grasps.contains(&example.reading_id)) {
        return refused(format!(
            "the model was trained on grasp {} of these: expected grasps of a new day",
            known.grasp_id
        ));
    }
    let (log_odds, stable, statistics) = judged(model, &day_model.method, &read.examples)?;
    let n_stable = stable.iter().filter(|stable| **stable).count();
    if stable.len() < MIN_LABELLED || n_stable == 0 || n_stable == stable.len() {
        return refused(format!(
            "of {} labelled grasps of the day the model can judge {}, {n_stable} of them stable: expected at least \
             {MIN_LABELLED}, some stable and some not (the others are unlike those that it was trained on)",
            read.examples.len(),
            stable.len()
        ));
    }
    let (a, b) = most_probable(&log_odds, &stable);
    let mut corrected = model.clone();
    let mut day_model = day_model.clone();
    day_model.recalibration = Some(Recalibration { day, n_labelled: stable.len(), a, b, statistics });
    corrected.day = Some(day_model);
    // They were for the probabilities before.
    corrected.training.withdraw_promises();
    let mut known = trained_on;
    let new = read.trained_on();
    known.objects.extend(new.objects);
    known.grasps.extend(new.grasps);
    corrected.training.trained_on = Some(known);
    Ok(corrected)
}

/// The log-odds and the outcome of each grasp that can be judged, and the statistics of all of these. Against a baseline each is
/// judged by all of them: in the graph only later grasps of the day are judged.
fn judged(
    model: &Model,
    method: &DayMethod,
    examples: &[Example],
) -> Result<(Vec<f64>, Vec<bool>, DayStatistics), TrainingError> {
    let mut statistics = DayStatistics::default();
    let (mut rows, mut stable, mut values) = (Vec::new(), Vec::new(), Vec::new());
    for example in examples {
        // A grasp without a feature is held in the graph too.
        if model.extract(Phase::Settled, &example.reading(), &mut values).is_ok() {
            statistics.add(&values);
            rows.extend_from_slice(&values);
            stable.push(example.stable);
        }
    }
    if matches!(method, DayMethod::Baseline(_)) && !rows.is_empty() {
        statistics.scaling().apply(&mut rows);
    }
    let decision_values = decision_values(&model.classifier.predictor, &rows)?;
    let PlattCalibration { a, b } = model.classifier.calibration;
    Ok((decision_values.iter().map(|value| -(a * value + b)).collect(), stable, statistics))
}

/// The slope and the offset of log-odds that are most probable: Newton's method on a convex function of two numbers.
fn most_probable(log_odds: &[f64], stable: &[bool]) -> (f64, f64) {
    let (slope_weight, offset_weight) = (SLOPE_DEVIATION.powi(-2), OFFSET_DEVIATION.powi(-2));
    let cost = |a: f64, b: f64| {
        let of_grasp = |(l, stable): (&f64, &bool)| {
            let z = if *stable { a * l + b } else { -(a * l + b) };
            (-z.abs()).exp().ln_1p() + (-z).max(0.0)
        };
        let of_prior = slope_weight * (a - 1.0).powi(2) + offset_weight * b.powi(2);
        log_odds.iter().zip(stable).map(of_grasp).sum::<f64>() + 0.5 * of_prior
    };
    let (mut a, mut b) = (1.0, 0.0);
    for _ in 0..100 {
        let (mut ga, mut gb) = (slope_weight * (a - 1.0), offset_weight * b);
        let (mut haa, mut hab, mut hbb) = (slope_weight, 0.0, offset_weight);
        for (l, stable) in log_odds.iter().zip(stable) {
            let probability = 1.0 / (1.0 + (-(a * l + b)).exp());
            let (miss, weight) = (probability - f64::from(u8::from(*stable)), probability * (1.0 - probability));
            (ga, gb) = (ga + miss * l, gb + miss);
            (haa, hab, hbb) = (haa + weight * l * l, hab + weight * l, hbb + weight);
        }
        let determinant = haa * hbb - hab * hab;
        let (da, db) = ((hbb * ga - hab * gb) / determinant, (haa * gb - hab * ga) / determinant);
        // Halved until the cost falls.
        let mut step = 1.0;
        while step > 1e-6 && cost(a - step * da, b - step * db) > cost(a, b) {
            step /= 2.0;
        }
        (a, b) = (a - step * da, b - step * db);
        if (step * da).abs() + (step * db).abs() < 1e-10 {
            break;
        }
    }
    // A slope at or below 0 would turn the ranking round.
    (a.max(0.05), b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shifted_day_is_shifted_back() {
        // Stable with the probability of log-odds l - 2.
        let log_odds: Vec<f64> = (0..4000).map(|idx| 8.0 * (f64::from(idx % 400) / 400.0 - 0.5)).collect();
        let stable: Vec<bool> = (0..4000)
            .map(|idx| {
                let threshold = 1.0 / (1.0 + (2.0 - log_odds[idx]).exp());
                (idx / 400) as f64 / 10.0 + 0.05 < threshold
            })
            .collect();
        let (a, b) = most_probable(&log_odds, &stable);
        assert!((a - 1.0).abs() < 0.1 && (b + 2.0).abs() < 0.2, "{a} {b}");
        // No labels: the prior.
        assert_eq!(most_probable(&[], &[]), (1.0, 0.0));
        // All wrong: the ranking is kept.
        let wrong: Vec<bool> = log_odds.iter().map(|l| *l < 0.0).collect();
        let (a, _) = most_probable(&log_odds, &wrong);
        assert!(a > 0.0, "{a}");
    }
}
