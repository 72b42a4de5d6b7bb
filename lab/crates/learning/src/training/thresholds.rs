//! Chooses the thresholds of all looks of a model, each for hands that can do this probe and no other.

use std::collections::{BTreeMap, BTreeSet};

use super::probes::{Attempted, LOOKS, LearnedProbes, NO_FEATURE, Policies, Policy, threshold_curve};
use super::{OutOfFold, TrainingError, out_of_fold_probabilities};
use crate::evaluation::measures::{area_under_roc, curve};
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::Classifier;
use blindgrasp_stages::training_summary::{Bounded, PolicySummary, Promise};

/// The aim of thresholds that are chosen for trials, in which a hand grasps again until it lifts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aim {
    /// The fewest attempts for each kept object if a drop costs as much as so many.
    DropCosts(f64),
    /// At most this share of the lifts drops.
    MaxDrops(f64),
}

/// The prices of a drop that are tried for [`Aim::MaxDrops`], from strict to loose: fixed, so that the tests in this order need no
/// correction (fixed sequence testing, Angelopoulos et al. 2021, section 3).
const DROP_COSTS: [f64; 10] = [300.0, 150.0, 80.0, 40.0, 20.0, 10.0, 5.0, 2.5, 1.2, 0.0];

/// The threshold of a look that never lifts.
const NEVER: f64 = 1.0;

/// A look's policy with the price of a drop that it was chosen for, and its promise.
struct Chosen {
    look: Phase,
    policy: Policy,
    drop_costs: f64,
    promise: Option<Promise>,
}

/// Why a look has no policy, and the least bound on drops that it has; 1 for none.
struct Refusal {
    why: String,
    at_most: f64,
}

/// How many more grasps a bound needs that is missed after `n_grasps`: it comes nearer to the estimate with the root of the number of
/// grasps, as a rule. Beyond so many times the grasps nothing is foretold.
fn more_grasps(found: Bounded, max_drops: f64, n_grasps: usize) -> String {
    const MOST_TIMES: f64 = 20.0;
    let times = ((found.at_most - found.estimate) / (max_drops - found.estimate)).powi(2);
    if found.estimate >= max_drops || times > MOST_TIMES {
        return "many times as many grasps".into();
    }
    format!("about {:.0} more grasps of more objects", ((times - 1.0) * n_grasps as f64 / 100.0).ceil() * 100.0)
}

impl Aim {
    /// Chooses the policy of a look. The error is the reason why the look has none.
    fn choose(self, policies: &Policies, look: Phase, n_grasps: usize) -> Result<Chosen, Refusal> {
        let max_drops = match self {
            Aim::MaxDrops(max_drops) => max_drops,
            Aim::DropCosts(drop_costs) => {
                let Some(policy) = policies.cheapest(drop_costs) else {
                    let why = format!(
                        "no threshold leads to a lift when the hand is {}: record more grasps of more objects",
                        look.as_str()
                    );
                    return Err(Refusal { why, at_most: 1.0 });
                };
                return Ok(Chosen { look, policy, drop_costs, promise: policies.promise(drop_costs) });
            }
        };
        let mut passed = None;
        for drop_costs in DROP_COSTS {
            match policies.promise(drop_costs) {
                Some(promise) if promise.drops_of_lifts.at_most <= max_drops => passed = Some((drop_costs, promise)),
                _ => break,
            }
        }
        if let Some((drop_costs, mut promise)) = passed
            && let Some(policy) = policies.cheapest(drop_costs)
        {
            // The sequence of tests bounds drops by this share, and not by the bound that the last test alone gives.
            promise.drops_of_lifts = Bounded { at_most: max_drops, ..promise.drops_of_lifts };
            promise.drops_of_trials = Bounded { at_most: max_drops, ..promise.drops_of_trials };
            return Ok(Chosen { look, policy, drop_costs, promise: Some(promise) });
        }
        let look = look.as_str();
        let Some(promise) = policies.promise(DROP_COSTS[0]) else {
            let why = format!("nothing is lifted when the hand is {look}: record more grasps of more objects");
            return Err(Refusal { why, at_most: 1.0 });
        };
        let found = promise.drops_of_lifts;
        let why = format!(
            "when the hand is {look}, the strictest threshold promises at most {:.1} % of the lifts to drop, from {} objects: record \
             {}, or allow more drops",
            100.0 * found.at_most,
            found.n_objects,
            more_grasps(found, max_drops, n_grasps)
        );
        Err(Refusal { why, at_most: found.at_most })
    }
}

impl Chosen {
    fn summary(self, roc_area: f64, grasps: &[Attempted], promises: bool) -> PolicySummary {
        let mut curve = threshold_curve(grasps, self.policy.thresholds, self.look);
        for point in &mut curve {
            if !promises {
                point.drops_at_most = None;
            } else if point.threshold_probability == self.policy.thresholds.lift {
                // Of thresholds that the other objects choose, as the model promises.
                point.drops_at_most = self.promise.map(|promise| promise.drops_of_lifts.at_most);
            }
        }
        PolicySummary {
            roc_area,
            look: self.look.as_str().into(),
            drop_costs: self.drop_costs,
            kept: self.policy.expected.kept,
            attempts_per_lift: self.policy.expected.attempts_per_lift,
            given_up: self.policy.expected.given_up,
            promise: self.promise,
            curve,
        }
    }
}

/// Chooses the thresholds and sets them. A look without a policy never lifts. Attempts are grasps with contact: those that no
/// cell feels are attempts of a robot as well, and are not counted. `promises` says whether the labels are outcomes of lifts, for
/// which a promise can be made; `n_grasps` were recorded.
pub(super) fn choose_thresholds(
    aim: Aim,
    promises: bool,
    n_grasps: usize,
    judged: &OutOfFold<'_>,
    classifier: &mut Classifier,
    probes: &mut LearnedProbes,
    progress: &mut impl FnMut(&str),
) -> Result<Vec<PolicySummary>, TrainingError> {
    check_aim(aim, promises)?;
    let settled = out_of_fold_probabilities(judged)?;
    let (chosen_looks, refusals) = choose_looks(aim, n_grasps, judged, &settled, probes);
    let best = refusals.iter().min_by(|a, b| a.at_most.total_cmp(&b.at_most));
    if (chosen_looks.is_empty() || matches!(aim, Aim::DropCosts(_)))
        && let Some(Refusal { why, at_most }) = best
    {
        return Err(TrainingError::Promise { why: why.clone(), at_most: *at_most });
    }
    classifier.threshold_probability = NEVER;
    let stable: Vec<bool> = judged.examples.iter().map(|example| example.stable).collect();
    let settled_roc_area = area_under_roc(&curve(&settled, &stable)).unwrap_or(0.5);
    let has_test_lift = chosen_looks.iter().any(|chosen| chosen.look == Phase::TestLifted);
    let (mut summaries, mut unsure_from) = (Vec::new(), NEVER);
    for mut chosen in chosen_looks {
        let policy = chosen.policy.thresholds;
        let is_before_test_lift = chosen.look == Phase::Squeezed && has_test_lift;
        // Without a promise a look does not lift, if one was asked for, and that of this look was for another choice of
        // the grasps to probe.
        if is_before_test_lift && matches!(aim, Aim::MaxDrops(_)) {
            progress("squeezed hands are never lifted: the thresholds are for the test lift");
            continue;
        }
        if is_before_test_lift || !promises {
            chosen.promise = None;
        }
        let mut roc_area = settled_roc_area;
        if let Some(learned) = probes.after(chosen.look) {
            learned.set_threshold(policy.lift);
            unsure_from = policy.promising;
            roc_area = learned.probe.cross_validated_roc_area;
        } else {
            classifier.threshold_probability = policy.lift;
            unsure_from = policy.lift;
        }
        if chosen.look == Phase::TestLifted
            && let Some(squeezed) = &mut probes.squeezed
        {
            squeezed.probe.classifier.unsure_from_probability = policy.promising_squeezed.max(0.0);
        }
        let grasps = attempts(judged, &settled, probes, chosen.look);
        summaries.push(chosen.summary(roc_area, &grasps, promises));
    }
    classifier.unsure_from_probability = unsure_from;
    for refusal in refusals {
        progress(&format!("not lifted: {}", refusal.why));
    }
    Ok(summaries)
}

fn check_aim(aim: Aim, promises: bool) -> Result<(), TrainingError> {
    if matches!(aim, Aim::MaxDrops(_)) && !promises {
        return Err(TrainingError::Data(
            "a share of drops can be promised for lifts alone: expected recordings of lifts (simulate --label lift, import), without \
             --day-baseline"
                .into(),
        ));
    }
    Ok(())
}

/// Chooses the policies of all looks that the model has, and says why looks have none.
fn choose_looks(
    aim: Aim,
    n_grasps: usize,
    judged: &OutOfFold<'_>,
    settled: &[f64],
    probes: &mut LearnedProbes,
) -> (Vec<Chosen>, Vec<Refusal>) {
    let (mut chosen_looks, mut refusals) = (Vec::new(), Vec::new());
    let mut stable_from = [NEVER; 2];
    for look in LOOKS {
        if look != Phase::Settled && probes.after(look).is_none() {
            continue;
        }
        let policies = Policies::new(&attempts(judged, settled, probes, look), look, stable_from);
        match aim.choose(&policies, look, n_grasps) {
            Ok(chosen) => {
                match (look, aim) {
                    (Phase::Settled, _) => stable_from[0] = chosen.policy.thresholds.lift,
                    (Phase::Squeezed, Aim::DropCosts(_)) => stable_from[1] = chosen.policy.thresholds.lift,
                    // With a promise, a tight hand is not lifted before its test lift, so that no threshold of its own lets
                    // it go on.
                    _ => {}
                }
                chosen_looks.push(chosen);
            }
            Err(refusal) => refusals.push(refusal),
        }
    }
    (chosen_looks, refusals)
}

/// The grasps as attempts that a look decides.
fn attempts(judged: &OutOfFold<'_>, settled: &[f64], probes: &LearnedProbes, look: Phase) -> Vec<Attempted> {
    let names: BTreeSet<&String> = judged.examples.iter().map(|example| &example.object).collect();
    let objects: BTreeMap<&String, usize> = names.into_iter().zip(0..).collect();
    let mut attempts = Vec::new();
    for (idx, example) in judged.examples.iter().enumerate() {
        let squeezed = probes.squeezed.as_ref().and_then(|learned| learned.probabilities[idx]);
        let test_lifted = probes.test_lifted.as_ref().and_then(|learned| learned.probabilities[idx]);
        attempts.push(Attempted {
            object: objects[&example.object],
            fold: judged.folds[idx],
            settled: settled[idx],
            // A tight hand that feels nothing is given up.
            squeezed: if look == Phase::TestLifted { squeezed.unwrap_or(NO_FEATURE) } else { 1.0 },
            decided: match look {
                Phase::Squeezed => squeezed,
                Phase::TestLifted => test_lifted,
                _ => Some(settled[idx]),
            },
            stable: example.stable,
        });
    }
    attempts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_that_is_missed_says_how_many_more_grasps_it_needs() {
        let more = |at_most, estimate| more_grasps(Bounded { estimate, at_most, n_objects: 80 }, 0.1, 600);
        // From 0.13 to 0.1 above 0.05: (8 / 5)^2 - 1 = 1.56 times as many more.
        assert_eq!(more(0.13, 0.05), "about 1000 more grasps of more objects");
        assert_eq!((more(0.13, 0.11), more(0.3, 0.09)), (more(1.0, 0.5), more(1.0, 0.5)));
    }
}
