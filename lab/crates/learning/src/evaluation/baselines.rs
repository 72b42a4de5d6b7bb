//! Plain rules beside a model, on the same grasps.

use serde::Serialize;

use super::looks::judged_looks;
use super::measures::{CurvePoint, area_under_roc, curve};
use crate::training::{Example, Examples, reading_at};
use blindgrasp_messages::Phase;
use blindgrasp_stages::encoder::wrist_values;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::training_summary::ThresholdPoint;

/// A model and plain rules at the look that decides.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Baselines {
    /// The phase whose frame is judged: the last one that the model judges and these grasps have.
    pub look: String,
    pub n_grasps: usize,
    /// The share of the unstable grasps that the model's thresholds lift. No rule lifts more of them.
    pub false_positive_rate: f64,
    /// The model, and then the rules that the recordings have values for.
    pub rules: Vec<Rule>,
    /// What other thresholds of the model lead to if these are lifts; empty if a label is the paper's.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub curve: Vec<ThresholdPoint>,
}

/// A value that is greater for stable grasps, and what a threshold on it is worth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rule {
    pub name: String,
    pub roc_area: Option<f64>,
    /// The share of the stable grasps that are lifted. The threshold of a rule is the best one on these grasps.
    pub recall: f64,
}

impl Baselines {
    /// Judges the examples that have the look; `None` if all of them are stable, or none, and for a model that looks at days, which
    /// judges no grasp alone. `joints` has for each example the probability by a model of the joint angles alone that has not
    /// learned from its object; it may be empty.
    pub fn new(model: &Model, read: &Examples, joints: &[f64]) -> Option<Baselines> {
        let examples = &read.examples;
        if model.day.is_some() {
            return None;
        }
        let look =
            judged_looks(model, examples).into_iter().rfind(|look| look.probabilities.iter().any(Option::is_some))?;
        let (mut probabilities, mut stable, mut idxs, mut n_lifted) = (Vec::new(), Vec::new(), Vec::new(), [0, 0]);
        for (idx, example) in examples.iter().enumerate() {
            let Some(probability) = look.probabilities[idx] else { continue };
            probabilities.push(probability);
            stable.push(example.stable);
            idxs.push(idx);
            n_lifted[usize::from(example.stable)] += usize::from(look.lifts(idx));
        }
        let of_model = curve(&probabilities, &stable);
        if of_model.is_empty() {
            return None;
        }
        let n_stable = stable.iter().filter(|stable| **stable).count();
        let false_positive_rate = n_lifted[0] as f64 / (stable.len() - n_stable) as f64;
        let recall = n_lifted[1] as f64 / n_stable as f64;
        let mut rules = vec![Rule { name: "model".into(), roc_area: area_under_roc(&of_model), recall }];
        for (name, value) in RULES {
            let values: Option<Vec<f64>> = idxs.iter().map(|idx| value(look.phase, &examples[*idx])).collect();
            rules.extend(values.map(|values| Rule::new(name, &values, &stable, false_positive_rate)));
        }
        if joints.len() == examples.len() {
            let values: Vec<f64> = idxs.iter().map(|idx| joints[*idx]).collect();
            rules.push(Rule::new(
                "joints alone, learned from other objects here",
                &values,
                &stable,
                false_positive_rate,
            ));
        }
        let is_of_lifts = !read.labels.contains_key(&Label::WrenchSpace);
        let curve = if is_of_lifts { look.curve(examples) } else { Vec::new() };
        Some(Baselines { look: look.phase.as_str().into(), n_grasps: stable.len(), false_positive_rate, rules, curve })
    }

    /// Says which rules are as good as the model.
    pub fn in_words(&self) -> String {
        let Some((model, rules)) = self.rules.split_first() else { return String::new() };
        let as_good: Vec<&str> =
            rules.iter().filter(|rule| rule.recall >= model.recall).map(|rule| rule.name.as_str()).collect();
        let found = if as_good.is_empty() {
            "no plain rule lifts as many".into()
        } else {
            format!("as good as the model, or better: {}", as_good.join("; "))
        };
        format!("with at most as many false positives, {found}; a rule's threshold is the best one on these grasps")
    }
}

impl Rule {
    fn new(name: &str, values: &[f64], stable: &[bool], false_positive_rate: f64) -> Rule {
        let curve = curve(values, stable);
        Rule { name: name.into(), roc_area: area_under_roc(&curve), recall: recall_at(&curve, false_positive_rate) }
    }
}

/// The greatest recall of a threshold with at most this false positive rate.
fn recall_at(curve: &[CurvePoint], false_positive_rate: f64) -> f64 {
    let within = curve.iter().take_while(|point| point.false_positive_rate <= false_positive_rate + 1e-12);
    within.last().map_or(0.0, |point| point.recall)
}

type Value = fn(Phase, &Example) -> Option<f64>;

const RULES: [(&str, Value); 3] = [
    ("sum of the cells", load),
    ("sum of the cells, after the last motion / before", load_left),
    ("load on the wrist along gravity, gained in the last motion", weight),
];

/// The sum of the forces on all cells, newtons.
fn load(look: Phase, example: &Example) -> Option<f64> {
    Some(reading_at(look, example)?.contacts.iter().map(|contact| contact.force_newtons).sum())
}

fn load_left(look: Phase, example: &Example) -> Option<f64> {
    let before = load(look_before(look)?, example)?;
    Some(if before > 0.0 { load(look, example)? / before } else { 0.0 })
}

fn weight(look: Phase, example: &Example) -> Option<f64> {
    let on_wrist = |look| Some(wrist_values(&reading_at(look, example)?.senses).ok()?[0]);
    Some(on_wrist(look)? - on_wrist(look_before(look)?)?)
}

fn look_before(look: Phase) -> Option<Phase> {
    match look {
        Phase::TestLifted => Some(Phase::Squeezed),
        Phase::Squeezed => Some(Phase::Settled),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use blindgrasp_grasps::reading::Felt;
    use blindgrasp_messages::{Contact, OwnedSenses};
    use blindgrasp_stages::hand::Hand;

    fn project(path: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..").join(path)
    }

    #[test]
    fn a_model_stands_beside_the_sum_of_the_cells() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let model = Model::load(&project("models/barrett-bh8-280.json")).expect("a model");
        let read = Examples::read(&hand, &[project("recordings/held-out.mcap")], |_, _| {}).expect("readable");
        let found = Baselines::new(&model, &read, &[]).expect("both kinds");
        assert_eq!(found.curve, [], "these grasps were not lifted");
        assert_eq!((found.look.as_str(), found.n_grasps), ("settled", read.examples.len()));
        let names: Vec<&str> = found.rules.iter().map(|rule| rule.name.as_str()).collect();
        assert_eq!(names, ["model", "sum of the cells"], "the other rules need a test lift");
        assert!(found.rules[0].roc_area > found.rules[1].roc_area && found.rules[0].recall > found.rules[1].recall);
        assert!(found.in_words().contains("no plain rule lifts as many"));
        // A rule that knows the labels.
        let labels: Vec<f64> = read.examples.iter().map(|example| f64::from(u8::from(example.stable))).collect();
        let found = Baselines::new(&model, &read, &labels).expect("both kinds");
        assert_eq!((found.rules[2].roc_area, found.rules[2].recall), (Some(1.0), 1.0));
        assert!(found.in_words().contains("as good as the model, or better: joints alone"), "{}", found.in_words());
    }

    #[test]
    fn the_values_of_rules_by_hand() {
        let felt = |newtons: &[f64]| Felt {
            joints: Vec::new(),
            contacts: newtons.iter().map(|force| Contact { force_newtons: *force, ..Contact::default() }).collect(),
            senses: OwnedSenses::default(),
        };
        let example =
            Example { squeezed: Some(felt(&[3.0, 5.0])), test_lifted: Some(felt(&[6.0])), ..Example::default() };
        let of = |value: Value, look| value(look, &example);
        assert_eq!((of(load, Phase::Squeezed), of(load, Phase::TestLifted)), (Some(8.0), Some(6.0)));
        assert_eq!((of(load_left, Phase::TestLifted), of(load_left, Phase::Settled)), (Some(0.75), None));
        assert_eq!(of(weight, Phase::TestLifted), None, "no wrist");
    }

    #[test]
    fn a_recall_is_that_of_the_last_threshold_within_the_false_positives() {
        let points = curve(&[0.9, 0.8, 0.7, 0.6], &[true, false, true, false]);
        assert_eq!([0.0, 0.4, 0.5, 1.0].map(|rate| recall_at(&points, rate)), [0.5, 0.5, 1.0, 1.0]);
    }
}
