//! A model that no grasp has taught, for a hand in its first minute.

use std::collections::BTreeMap;

use crate::training::TrainingError;
use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::loads::LoadRule;
use blindgrasp_stages::classifier::{Classifier, Predictor};
use blindgrasp_stages::dictionary::Dictionary;
use blindgrasp_stages::encoder::{Block, FeatureExtractor};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::{FORMAT, Model, ModelHand};
use blindgrasp_stages::out_of_distribution::{Limits, Quantity, TrainingRange, quantities};
use blindgrasp_stages::probe::{ProbeModel, n_values, signals};
use blindgrasp_stages::recipe::{Learner, Recipe};
use blindgrasp_stages::training_summary::TrainingSummary;

/// Fingers that must feel the object.
const LEAST_FINGERS: usize = 2;
/// The greatest limit of a quantity that can have any value.
const NO_LIMIT: f64 = 1e6;

/// The model of a plain rule: it asks for a test lift of a grasp that two fingers feel, and lifts if two fingers feel it then and
/// the hand feels `least_newtons` or more. The palm counts as a finger. A newton more counts as a log-odds of one, until `model adapt` has learned from
/// the robot's lifts.
///
/// # Errors
/// The hand has pads on one finger alone.
pub fn plain_rule(hand: &Hand, least_newtons: f64, made_by: String) -> Result<Model, TrainingError> {
    let recipe = Recipe {
        name: "loads".into(),
        blocks: vec![Block::Pads],
        n_words: 1,
        learner: Learner::Loads,
        ..Recipe::default()
    };
    // No value is of the histogram.
    let features = FeatureExtractor::new(hand, &recipe.blocks, Dictionary { words_m: vec![[0.0; 3]] }, recipe.sigma_m);
    let training_range = all_that_is_possible(hand);
    if loads_of_fingers(hand, &features, 0).len() < LEAST_FINGERS {
        return Err(TrainingError::Data(format!(
            "the pads of {} are on one finger, and the rule needs them on {LEAST_FINGERS}",
            hand.name
        )));
    }
    // A probe's values begin with the feature before it.
    let classifier = |n_features, first, least_newtons, threshold_probability| Classifier {
        predictor: Predictor::Loads(LoadRule {
            n_features,
            fingers: loads_of_fingers(hand, &features, first),
            least_fingers: LEAST_FINGERS,
            least_newtons,
        }),
        calibration: PlattCalibration { a: -1.0, b: 0.0 },
        threshold_probability,
        unsure_from_probability: 0.5,
    };
    let probe = |least_newtons, threshold_probability| ProbeModel {
        classifier: classifier(n_values(&features), features.len(), least_newtons, threshold_probability),
        training_range: training_range.clone(),
        cross_validated_roc_area: 0.5,
        cross_validated_ece: 0.0,
    };
    Ok(Model {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        // Before the test lift, a threshold of 1 is never reached.
        classifier: classifier(features.len(), 0, 0.0, 1.0),
        squeezed: Some(probe(0.0, 1.0)),
        test_lifted: Some(probe(least_newtons, 0.5)),
        features: features.clone(),
        training_range: training_range.clone(),
        approach: None,
        day: None,
        training: TrainingSummary {
            made_by: vec![made_by],
            recipe,
            version: env!("CARGO_PKG_VERSION").into(),
            ..TrainingSummary::default()
        },
        checksum: String::new(),
    })
}

fn all_that_is_possible(hand: &Hand) -> TrainingRange {
    let limits = quantities(hand).into_iter().map(|Quantity { name, possible, resolution, .. }| Limits {
        quantity: name,
        lower: possible.start() - resolution,
        upper: (possible.end() + resolution).min(NO_LIMIT),
    });
    TrainingRange { limits: limits.collect(), share_flagged: 0.0 }
}

/// The places of the pads' loads among values that begin with `first` others, finger by finger.
fn loads_of_fingers(hand: &Hand, features: &FeatureExtractor, first: usize) -> Vec<Vec<usize>> {
    let mut fingers: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (pad, load) in hand.pads.iter().zip(signals(features)) {
        fingers.entry(hand.finger_of(pad.link_idx)).or_default().push(first + load);
    }
    fingers.into_values().collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_messages::{Contact, Phase};
    use blindgrasp_stages::day::GraspPlace;
    use blindgrasp_stages::encoder::FeltReading;
    use blindgrasp_stages::model::Memory;

    /// A phase, what its pads feel, newtons, and whether the grasp is stable or unsure then.
    type Look<'a> = (Phase, &'a [f64], Option<(bool, bool)>);

    #[test]
    fn a_grasp_of_two_fingers_is_tried_and_is_lifted_if_they_bear_enough() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let model = plain_rule(&hand, 10.0, "a test".into()).expect("a model");
        let pads: Vec<&str> = hand.pads.iter().map(|pad| pad.name.as_str()).collect();
        assert_eq!(pads.len(), 4, "the palm and three fingers: {pads:?}");
        let judge = |looks: &[Look<'_>]| {
            let mut memory = Memory::default();
            for (phase, newtons, expected) in looks {
                let contact = |(pad, force): (usize, &f64)| Contact {
                    pad: pad as u32,
                    force_newtons: *force,
                    ..Contact::default()
                };
                let felt = newtons.iter().enumerate().filter(|(_, force)| **force > 0.0);
                let contacts: Vec<Contact> = felt.map(contact).collect();
                let joints = vec![0.0; hand.joints.len()];
                let mut values = Vec::new();
                model.extract(*phase, &FeltReading::new(&joints, &contacts), &mut values).expect("a feature");
                let verdict = model.judge(&mut memory, 0, GraspPlace::default(), *phase, Ok(&values));
                if let Some(expected) = expected {
                    let verdict = verdict.expect("a verdict");
                    assert_eq!((verdict.stable, verdict.unsure), *expected, "{phase:?} {newtons:?}");
                }
            }
        };
        let probed = |newtons: &[f64], is_lifted| {
            let light: &[f64] = &[0.0, 0.5, 0.5];
            judge(&[
                (Phase::Settled, light, Some((false, true))),
                (Phase::Squeezing, light, None),
                (Phase::Squeezed, light, Some((false, true))),
                (Phase::TestLifting, newtons, None),
                (Phase::TestLifted, newtons, Some((is_lifted, false))),
            ]);
        };
        probed(&[0.0, 6.0, 4.1], true);
        probed(&[0.0, 6.0, 3.9], false);
        probed(&[0.0, 16.0, 0.0], false);
        judge(&[(Phase::Settled, &[0.0, 20.0], Some((false, false)))]);
        let mut one = hand.clone();
        one.pads.retain(|pad| pad.name == "finger_1");
        let refused = plain_rule(&one, 10.0, "a test".into()).expect_err("one finger").to_string();
        assert!(refused.contains("the pads of barrett-bh8-280 are on one finger"), "{refused}");
    }
}
