//! The checks of a replay: its edges against the recorded ones, its decisions against the expectations.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::comparison::{ComparedEdge, EdgeComparison};
use super::expectations::Expectations;
use super::rewrite::{FedEdge, Origin};
use blindgrasp_messages::{Action, GraspScene, GraspTruth, LiftDecision, LiftOutcome, Reason, Recorded};
use blindgrasp_operator::text::counted;
use blindgrasp_recording::{Record, RecordingError, RecordingReader};

/// Fewest labelled grasps of which an accuracy is expected: one of three lifts that is held instead is a third.
const FEWEST_FOR_ACCURACY: usize = 20;

/// The outcome of one check.
#[derive(Debug, Serialize, Deserialize)]
pub struct Check {
    /// A topic, or an expectation's key.
    pub name: String,
    pub has_passed: bool,
    /// The findings, and the expectation if they do not meet it.
    pub text: String,
    /// The comparison, if an edge was checked.
    pub edge: Option<EdgeComparison>,
}

/// The expectations name a topic that is no edge of the graph.
#[derive(Debug, thiserror::Error)]
#[error("expectations: tolerances: the graph has no edge {topic}; it has {}", topics.join(", "))]
pub struct UnknownTopic {
    topic: String,
    topics: Vec<String>,
}

/// The decisions and labels of a replay, by grasp.
#[derive(Default)]
pub struct Decisions {
    decisions: BTreeMap<u64, LiftDecision>,
    truths: BTreeMap<u64, GraspTruth>,
    /// Of the grasps whose lift was reported, whether the object was kept: by a robot's frames, or by a simulated hand.
    outcomes: BTreeMap<u64, bool>,
    /// Decisions and labels of a grasp that had one already: a restarted source may number its grasps anew.
    n_again: usize,
}

/// The numbers of decisions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    pub n_lifts: usize,
    pub n_holds: usize,
    /// Decisions about grasps with a label.
    pub n_labelled: usize,
    /// Those that lift a stable grasp or hold an unstable one.
    pub n_right: usize,
    /// Those that lift an unstable grasp.
    pub n_false_positive: usize,
}

impl Tally {
    pub fn add(&mut self, other: Tally) {
        self.n_lifts += other.n_lifts;
        self.n_holds += other.n_holds;
        self.n_labelled += other.n_labelled;
        self.n_right += other.n_right;
        self.n_false_positive += other.n_false_positive;
    }
}

/// A grasp whose action is another one than before.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChangedDecision {
    pub grasp_id: u64,
    /// Action and reason before; `None` if there was no decision.
    pub before: Option<(Action, Reason)>,
    pub after: Option<(Action, Reason)>,
    /// The grasp's label, if it has one.
    pub is_stable: Option<bool>,
}

impl ChangedDecision {
    /// Whether the grasp is lifted only after the change.
    pub fn is_lifted_now(&self) -> bool {
        self.after.is_some_and(|(action, _)| action == Action::Lift)
    }
}

impl fmt::Display for ChangedDecision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = |decision: Option<(Action, Reason)>| {
            decision.map_or("no decision".into(), |(action, reason)| format!("{} {}", action.shown(), reason.as_str()))
        };
        write!(f, "grasp {}: {} -> {}", self.grasp_id, shown(self.before), shown(self.after))?;
        match self.is_stable {
            Some(true) => f.write_str(" (stable)"),
            Some(false) => f.write_str(" (unstable)"),
            None => Ok(()),
        }
    }
}

/// The changed actions as a text, the first ones by grasp; `None` if there are none.
pub fn describe_changes(changed: &[ChangedDecision]) -> Option<String> {
    const N_TOLD: usize = 10;
    let (n, n_more) = (changed.len(), changed.len().saturating_sub(N_TOLD));
    let told: Vec<String> = changed.iter().take(N_TOLD).map(ToString::to_string).collect();
    let more = if n_more > 0 { format!("; and {n_more} more") } else { String::new() };
    (n > 0).then(|| {
        format!("{n} {}: {}{more}", if n == 1 { "action changed" } else { "actions changed" }, told.join("; "))
    })
}

impl Check {
    pub fn new(name: &str, has_passed: bool, text: String) -> Check {
        Check { name: name.into(), has_passed, text, edge: None }
    }

    /// The check of an edge; with `is_update`, differences pass.
    pub fn of_edge(comparison: EdgeComparison, is_update: bool) -> Check {
        let EdgeComparison { n_recorded, n_found, n_differing, n_grasps, first, n_not_compared, .. } = &comparison;
        let text = match first {
            None if *n_not_compared > 0 => {
                format!("{}, {n_not_compared} more were not compared", counted(n_recorded, "sample"))
            }
            None => counted(n_recorded, "sample"),
            Some(first) => format!(
                "{n_differing} of {n_recorded} samples differ ({n_found} found), grasps: {n_grasps}; first: {first}"
            ),
        };
        let has_passed = is_update || *n_differing == 0;
        Check { name: comparison.topic.clone(), has_passed, text, edge: Some(comparison) }
    }
}

/// Returns the edges of a replay to compare, in the graph's order, and a check for each edge that only one side has.
///
/// * `fed` - the edges of the replay. `topics_of_graph` - the topics of the whole graph.
/// * `recorded`, `found` - the topics of the recording and of the replay's recording, with their types.
/// * `is_update` - the recording is updated: missing edges pass.
///
/// # Errors
/// [`UnknownTopic`].
pub fn edges_to_compare(
    fed: &[FedEdge],
    topics_of_graph: &BTreeSet<&str>,
    recorded: &BTreeMap<String, String>,
    found: &BTreeMap<String, String>,
    expected: &Expectations,
    is_update: bool,
) -> Result<(Vec<ComparedEdge>, Vec<Check>), UnknownTopic> {
    let (mut compared, mut checks) = (Vec::new(), Vec::new());
    let has = |topic: &str| topics_of_graph.contains(topic) || fed.iter().any(|edge| edge.recorded_topic == topic);
    if let Some(topic) = expected.tolerances.keys().find(|topic| !has(topic)) {
        let topics = topics_of_graph.iter().map(ToString::to_string).collect();
        return Err(UnknownTopic { topic: topic.clone(), topics });
    }
    let is_recorded = |edge: &FedEdge| recorded.contains_key(&edge.recorded_topic);
    if !is_update {
        if !fed.iter().any(|edge| edge.origin == Origin::Stage && is_recorded(edge)) {
            // The recording holds no output of a stage: there is nothing to compare.
            return Ok((compared, checks));
        }
        let of_sources = [GraspScene::TOPIC, GraspTruth::TOPIC, LiftOutcome::TOPIC];
        for (topic, schema) in recorded {
            let is_ours = schema.starts_with("blindgrasp_msgs/");
            if is_ours && !of_sources.contains(&topic.as_str()) && !has(topic) {
                checks.push(Check::new(topic, false, "recorded, but the graph has no such edge".into()));
            }
        }
    }
    for edge in fed {
        let topic = &edge.recorded_topic;
        if is_recorded(edge) {
            compared.push(ComparedEdge {
                recorded_topic: topic.clone(),
                found_topic: edge.found_topic.clone(),
                tolerance: expected.tolerances.get(topic).copied().unwrap_or_default(),
                is_played: edge.origin != Origin::Stage,
            });
        } else if found.contains_key(&edge.found_topic) {
            let text = if is_update {
                "was not recorded"
            } else {
                "the graph has this edge, but the recording does not: record it again, or --update"
            };
            checks.push(Check::new(topic, is_update, text.into()));
        }
    }
    Ok((compared, checks))
}

impl Decisions {
    /// Reads the recording of a replay.
    ///
    /// # Errors
    /// See [`RecordingError`].
    pub fn read(found: &Path) -> Result<Decisions, RecordingError> {
        let mut read = Decisions::default();
        for record in RecordingReader::open(found)? {
            let is_again = match record?.1 {
                // A probe comes before the decision about its grasp.
                Record::Decision(sample) if !sample.message.action.decides() => continue,
                Record::Decision(sample) => read.decisions.insert(sample.message.grasp_id, sample.message).is_some(),
                Record::Tactile(sample) => {
                    if let Some(is_kept) = sample.message.phase.outcome() {
                        *read.outcomes.entry(sample.message.grasp_id).or_insert(true) &= is_kept;
                    }
                    false
                }
                Record::Outcome(sample) if sample.message.lifted => {
                    read.outcomes.insert(sample.message.grasp_id, sample.message.held);
                    false
                }
                // An object that was kept may be dropped after that.
                Record::Truth(sample) => {
                    let is_drop = !sample.message.stable;
                    let before = read.truths.insert(sample.message.grasp_id, sample.message);
                    before.is_some_and(|before| !(before.stable && is_drop))
                }
                _ => false,
            };
            read.n_again += usize::from(is_again);
        }
        Ok(read)
    }

    /// The grasps whose action differs from the one in `before`, where that has a decision of the grasp.
    pub fn changed_since(&self, before: &Decisions) -> Vec<ChangedDecision> {
        let said = |of: &Decisions, grasp_id| of.decisions.get(&grasp_id).map(|said| (said.action, said.reason));
        let changed = before.decisions.keys().map(|&grasp_id| ChangedDecision {
            grasp_id,
            before: said(before, grasp_id),
            after: said(self, grasp_id),
            is_stable: self.truths.get(&grasp_id).or_else(|| before.truths.get(&grasp_id)).map(|truth| truth.stable),
        });
        let action = |decision: Option<(Action, Reason)>| decision.map(|(action, _)| action);
        changed.filter(|changed| action(changed.before) != action(changed.after)).collect()
    }

    pub fn is_empty(&self) -> bool {
        self.decisions.is_empty()
    }

    /// Counts the decisions, of which the labels say whether they are right.
    pub fn tally(&self) -> Tally {
        let mut tally = Tally::default();
        for (grasp_id, decision) in &self.decisions {
            let is_lift = decision.action == Action::Lift;
            tally.n_lifts += usize::from(is_lift);
            tally.n_holds += usize::from(!is_lift);
            if let Some(truth) = self.truths.get(grasp_id) {
                tally.n_labelled += 1;
                tally.n_right += usize::from(is_lift == truth.stable);
                tally.n_false_positive += usize::from(is_lift && !truth.stable);
            }
        }
        tally
    }

    /// The decisions as expectations of later replays: a lift that dropped its object should have been held. With labels,
    /// false positives are expected as they are, and of 20 or more the accuracy, of fewer the right lifts;
    /// without labels, every decision.
    pub fn to_expectations(&self) -> Expectations {
        let mut expected = Expectations::default();
        if self.truths.is_empty() {
            let said = self.decisions.iter().map(|(id, said)| (*id, (said.action, Some(said.reason))));
            expected.decisions.extend(said);
        } else {
            let Tally { n_right, n_false_positive, .. } = self.tally();
            if self.truths.len() >= FEWEST_FOR_ACCURACY {
                // Rounded down, so that the text reads back as a bound that is met.
                let accuracy = n_right as f64 / self.truths.len() as f64;
                expected.accuracy_at_least = Some((1e4 * accuracy).floor() / 1e4);
            }
            expected.false_positives_at_most = Some(n_false_positive);
            if self.truths.len() < FEWEST_FOR_ACCURACY {
                // Else a graph that holds everything would pass.
                expected.decisions.extend(self.right_lifts().map(|grasp_id| (grasp_id, (Action::Lift, None))));
            }
        }
        expected.decisions.extend(self.dropped().map(|grasp_id| (grasp_id, (Action::Hold, None))));
        expected
    }

    /// The grasps that were lifted and are labelled as stable.
    fn right_lifts(&self) -> impl Iterator<Item = u64> + '_ {
        let lifted = self.decisions.iter().filter(|(_, decision)| decision.action == Action::Lift);
        lifted
            .map(|(grasp_id, _)| *grasp_id)
            .filter(|grasp_id| self.truths.get(grasp_id).is_some_and(|truth| truth.stable))
    }

    /// The first grasp that is held because hand or model are others than the graph's.
    pub fn held_as_another(&self) -> Option<(u64, Reason)> {
        let is_another = |reason: Reason| matches!(reason, Reason::WrongHand | Reason::WrongModel);
        let held = self.decisions.iter().find(|(_, decision)| is_another(decision.reason));
        held.map(|(grasp_id, decision)| (*grasp_id, decision.reason))
    }

    /// The grasps that were lifted and dropped their objects.
    pub fn dropped(&self) -> impl Iterator<Item = u64> + '_ {
        self.outcomes.iter().filter(|(_, is_kept)| !**is_kept).map(|(grasp_id, _)| *grasp_id)
    }

    /// Checks the decisions against the expectations.
    pub fn check(&self, expected: &Expectations) -> Vec<Check> {
        let mut checks = Vec::new();
        if self.n_again > 0 && expected.has_demands() {
            let text = "several decisions or labels have the same grasp_id: expected one of each for a grasp";
            checks.push(Check::new("grasps", false, text.into()));
        }
        checks.extend(self.check_labels(expected));
        if !expected.decisions.is_empty() {
            let wrong: Vec<String> = expected.decisions.iter().filter_map(|wanted| self.wrong(wanted)).collect();
            let text = match wrong.as_slice() {
                [] => format!("{} as expected", counted(expected.decisions.len(), "grasp")),
                wrong => wrong.join("; "),
            };
            checks.push(Check::new("decisions", wrong.is_empty(), text));
        }
        if !expected.reasons.is_empty() {
            let n_of = |word: &str| self.decisions.values().filter(|decision| decision.reason.as_str() == word).count();
            let counts = expected.reasons.iter().map(|(word, wanted)| (word, n_of(word), *wanted));
            let texts = counts.clone().map(|(word, n, wanted)| {
                if n == wanted { format!("{word} {n}") } else { format!("{word} {n}, expected {wanted}") }
            });
            let text = texts.collect::<Vec<_>>().join("; ");
            checks.push(Check::new("reasons", counts.clone().all(|(_, n, wanted)| n == wanted), text));
        }
        checks
    }

    fn check_labels(&self, expected: &Expectations) -> Vec<Check> {
        let mut checks = Vec::new();
        let Tally { n_labelled: n_decided, n_right, n_false_positive, .. } = self.tally();
        if let Some(least) = expected.accuracy_at_least {
            // A grasp without a decision counts as a wrong decision.
            let n_grasps = self.truths.len();
            let n_undecided = n_grasps - n_decided;
            let accuracy = (n_grasps > 0).then(|| n_right as f64 / n_grasps as f64);
            let percent = |share: f64| format!("{:.1} %", 100.0 * share);
            let text = format!(
                "{} of {} with a label{}, at least {}",
                accuracy.map_or("n/a".into(), percent),
                counted(n_grasps, "grasp"),
                if n_undecided > 0 { format!(", {n_undecided} undecided") } else { String::new() },
                percent(least)
            );
            let has_passed = accuracy.is_some_and(|accuracy| accuracy >= least);
            checks.push(Check::new("accuracy_at_least", has_passed, text));
        }
        if let Some(most) = expected.false_positives_at_most {
            let text = match n_decided {
                0 => "the recording has labels (/truth) of no decided grasp: expected some".into(),
                _ => format!("{n_false_positive} of {} with a label, at most {most}", counted(n_decided, "grasp")),
            };
            let has_passed = n_decided > 0 && n_false_positive <= most;
            checks.push(Check::new("false_positives_at_most", has_passed, text));
        }
        checks
    }

    fn wrong(&self, (grasp_id, (action, reason)): (&u64, &(Action, Option<Reason>))) -> Option<String> {
        let expected =
            reason.map_or(action.as_str().to_string(), |reason| format!("{} {}", action.as_str(), reason.as_str()));
        let Some(found) = self.decisions.get(grasp_id) else {
            return Some(format!("grasp {grasp_id}: expected {expected}, found no decision"));
        };
        let is_action = found.action == *action;
        let is_right = is_action && reason.is_none_or(|reason| found.reason == reason);
        let (action, reason) = (found.action.as_str(), found.reason.as_str());
        (!is_right).then(|| format!("grasp {grasp_id}: expected {expected}, found {action} {reason}"))
    }
}
