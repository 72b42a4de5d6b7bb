//! One recording: replayed, compared, held against what is expected.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde::Serialize;
use serde_json::{Value, json};

use super::scratch::Scratch;
use super::update;
use crate::commands::percent;
use crate::commands::replay::{Fed, FedEdge, Feed, Origin};
use crate::commands::run::{RecordOptions, Session};
use blindgrasp_graph::dataflow::{self, Graph, Override};
use blindgrasp_graph::describe::{describe, shipped};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::run::{Summary, observed_topics};
use blindgrasp_learning::evaluation::Score;
use blindgrasp_messages::{Action, GraspScene, GraspTruth, LiftDecision, LiftOutcome, Reason, Recorded};
use blindgrasp_operator::wiring::Clock;
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_replay::bare_chain;
use blindgrasp_replay::comparison::{ComparedEdge, Coverage, EdgeComparison, compare_edge};
use blindgrasp_replay::expectations::{self, Expectations};
use blindgrasp_replay::played::played;
use blindgrasp_replay::selection::Selection;

/// How much of a recording is played to measure the latency.
const MEASURED_NANOS: u64 = 10_000_000_000;

/// What all recordings are tested with.
pub(super) struct Runner<'a> {
    pub(super) dataflow: &'a Path,
    pub(super) replace: Option<&'a str>,
    pub(super) scratch: Scratch,
    pub(super) n_stops: &'a AtomicUsize,
}

/// What became of a recording.
#[derive(Debug, Serialize)]
pub(super) struct Case {
    pub(super) recording: PathBuf,
    pub(super) checks: Vec<Check>,
    /// What could not be compared, and why.
    pub(super) notes: Vec<String>,
    pub(super) secs: f64,
}

/// One thing that was looked at.
#[derive(Debug, Serialize)]
pub(super) struct Check {
    /// A topic, or an expectation's key.
    pub(super) name: String,
    pub(super) has_passed: bool,
    /// What was found, and what was expected if that is something else.
    pub(super) text: String,
    /// Of an edge.
    pub(super) edge: Option<EdgeComparison>,
}

/// A recording that was replayed.
pub(super) struct Replayed {
    /// The recording of the replay.
    pub(super) found: PathBuf,
    pub(super) fed: Fed,
    pub(super) summary: Summary,
}

impl Case {
    pub(super) fn has_passed(&self) -> bool {
        self.checks.iter().all(|check| check.has_passed)
    }
}

impl Check {
    fn new(name: &str, has_passed: bool, text: String) -> Check {
        Check { name: name.into(), has_passed, text, edge: None }
    }
}

impl Runner<'_> {
    /// Tests a recording. What goes wrong with it is a failed check; an error is the end of all tests.
    pub(super) fn test(&self, recording: &Path, is_update: bool) -> anyhow::Result<Case> {
        let start = Instant::now();
        let mut case = Case { recording: recording.into(), checks: Vec::new(), notes: Vec::new(), secs: 0.0 };
        let outcome = self.fill(&mut case, is_update);
        self.check_stop()?;
        if let Err(error) = outcome {
            case.checks.push(Check::new("error", false, format!("{error:#}")));
        }
        case.secs = start.elapsed().as_secs_f64();
        Ok(case)
    }

    fn fill(&self, case: &mut Case, is_update: bool) -> anyhow::Result<()> {
        let recording = case.recording.clone();
        let expected = Expectations::of(&recording)?.unwrap_or_default();
        let graph = self.graph(&expected, &[])?;
        let found = self.scratch.path(&recording);
        let replayed = self.replay(&recording, &graph, &[], &found)?;
        let summary = &replayed.summary;
        let n_lost = summary.samples_lost + summary.samples_dropped;
        let has_lost = n_lost > 0 || summary.edges_unknown > 0;
        let text = match has_lost {
            true => format!("{n_lost} samples lost, unknown on {} edges", summary.edges_unknown),
            false => format!("{} grasps decided, nothing lost", summary.grasps),
        };
        case.checks.push(Check::new("replay", !has_lost, text));

        let edges = self.edges(&replayed, &graph, &recording, &expected, is_update, case)?;
        if edges.is_empty() && !is_update && !expected.has_demands() {
            bail!(
                "nothing to hold it against: it holds no stage's output, and its expectations demand nothing; --update \
                 records the edges, or write {}",
                expectations::path_of(&recording).display()
            );
        }
        let coverage = Coverage::of(&recording, &replayed.fed.topic)?;
        for edge in &edges {
            self.check_stop()?;
            let comparison = compare_edge(&recording, &found, edge, &coverage)?;
            case.checks.push(edge_check(comparison, is_update));
        }
        case.notes.extend(not_covered(&coverage));
        if is_update && !has_lost {
            let updated = update::update(&recording, &found, &replayed.fed, &coverage)?;
            case.notes.push(updated);
        }
        let decided = Decided::read(&found, &replayed.fed.graph)?;
        case.checks.extend(decided.check(&expected));
        if let Some(most) = expected.latency_ratio_at_most {
            case.checks.push(self.latency(&recording, &graph, most)?);
        }
        Ok(())
    }

    pub(super) fn graph(&self, expected: &Expectations, overrides: &[Override]) -> anyhow::Result<Graph> {
        let file = dataflow::load(expected.dataflow.as_deref().unwrap_or(self.dataflow))?;
        Ok(dataflow::check(&file, &shipped()?, overrides, dataflow::Scope::Everything, describe)?)
    }

    /// Plays a recording as fast as the graph takes it, and records every edge.
    pub(super) fn replay(
        &self,
        recording: &Path,
        graph: &Graph,
        overrides: &[Override],
        found: &Path,
    ) -> anyhow::Result<Replayed> {
        let fed = self.feed(recording, &Selection::default(), json!("max")).into_graph(graph, overrides)?;
        let summary = self.run(&fed.graph, Some(found))?;
        Ok(Replayed { found: found.into(), fed, summary })
    }

    fn feed<'b>(&'b self, recording: &'b Path, selection: &'b Selection, rate: Value) -> Feed<'b> {
        let (repeat, steps) = (json!(1.0), json!("unlimited"));
        Feed { recording, replace: self.replace, selection, rate, repeat, steps }
    }

    fn run(&self, graph: &Graph, record: Option<&Path>) -> anyhow::Result<Summary> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("test-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let session = Session {
            launch: LaunchOptions {
                startup_limit: Duration::from_secs(60),
                is_on_terminal: false,
                ..LaunchOptions::default()
            },
            clock: Clock::Recording,
            record: record.map(Path::to_path_buf),
            record_options: RecordOptions { overwrite: true, ..RecordOptions::default() },
            metrics: None,
            json: false,
            is_quiet: true,
            tap: None,
        };
        let ended = session.run(graph, &name, self.n_stops)?;
        self.check_stop()?;
        if ended.summary.run.end != "finished" {
            bail!("the replay was {}", ended.summary.run.end);
        }
        if ended.summary.samples_not_recorded > 0 {
            let why = ended.summary.recording_error.as_deref().unwrap_or("the disk was too slow");
            bail!("{} samples of the replay could not be recorded: {why}", ended.summary.samples_not_recorded);
        }
        Ok(ended.summary.run)
    }

    /// The edges to compare, in the graph's order: those of stages that the recording has; of those that it should have
    /// and has not, a failed check.
    fn edges(
        &self,
        replayed: &Replayed,
        graph: &Graph,
        recording: &Path,
        expected: &Expectations,
        is_update: bool,
        case: &mut Case,
    ) -> anyhow::Result<Vec<ComparedEdge>> {
        let (recorded, found) = (RecordingReader::open(recording)?, RecordingReader::open(&replayed.found)?);
        let edges = &replayed.fed.edges;
        let whole = observed_topics(graph, true);
        let has = |topic: &str| {
            whole.values().any(|known| known == topic) || edges.iter().any(|edge| edge.recorded_topic == topic)
        };
        if let Some(topic) = expected.tolerances.keys().find(|topic| !has(topic)) {
            let topics: Vec<&str> = whole.values().map(String::as_str).collect();
            bail!("expectations: tolerances: the graph has no edge {topic}; it has {}", topics.join(", "));
        }
        let is_recorded = |edge: &FedEdge| recorded.topics().contains_key(&edge.recorded_topic);
        if !is_update && !edges.iter().any(|edge| edge.origin == Origin::Stage && is_recorded(edge)) {
            // Only what was played: there is nothing to compare.
            return Ok(Vec::new());
        }
        if !is_update {
            let of_sources = [GraspScene::TOPIC, GraspTruth::TOPIC, LiftOutcome::TOPIC];
            let is_known = |topic: &str| of_sources.contains(&topic) || has(topic);
            let ours = recorded.topics().iter().filter(|(_, schema)| schema.starts_with("blindgrasp_msgs/"));
            for (topic, _) in ours.filter(|(topic, _)| !is_known(topic)) {
                case.checks.push(Check::new(topic, false, "recorded, but the graph has no such edge".into()));
            }
        }
        let mut compared = Vec::new();
        for edge in edges {
            let topic = &edge.recorded_topic;
            if is_recorded(edge) {
                let tolerance = expected.tolerances.get(topic).copied().unwrap_or_default();
                let (recorded_topic, found_topic) = (topic.clone(), edge.found_topic.clone());
                let is_played = edge.origin != Origin::Stage;
                compared.push(ComparedEdge { recorded_topic, found_topic, tolerance, is_played });
            } else if found.topics().contains_key(&edge.found_topic) {
                let text = match is_update {
                    true => "was not recorded",
                    false => "the graph has this edge, but the recording does not: record it again, or --update",
                };
                case.checks.push(Check::new(topic, is_update, text.into()));
            }
        }
        Ok(compared)
    }

    /// Plays the recording's beginning at its own speed, and a bare chain before and after at the same pace.
    fn latency(&self, recording: &Path, graph: &Graph, most: f64) -> anyhow::Result<Check> {
        let selection = Selection { to_nanos: Some(MEASURED_NANOS), ..Selection::default() };
        let fed = self.feed(recording, &selection, json!(1.0)).into_graph(graph, &[])?;
        let pauses = pauses(recording, &fed.topic)?;
        let n_threads = longest_path(&fed.graph);
        let should_stop = || self.n_stops.load(Ordering::Relaxed) > 0;
        let mut chain = bare_chain::latencies_nanos(n_threads, &pauses[..pauses.len() / 2], &should_stop)?;
        let summary = self.run(&fed.graph, None)?;
        chain.extend(bare_chain::latencies_nanos(n_threads, &pauses[pauses.len() / 2..], &should_stop)?);
        self.check_stop()?;
        let graph_nanos = summary.latency_nanos.as_ref().context("no grasp was decided: there is no latency")?.p50;
        let chain_nanos = bare_chain::median(chain).context("too few frames to measure a latency")?;
        let ratio = graph_nanos as f64 / chain_nanos.max(1) as f64;
        let text = format!(
            "{ratio:.2}, at most {most}: {:.0} µs from source to decision, {:.0} µs in a bare chain of {n_threads} threads",
            graph_nanos as f64 / 1e3,
            chain_nanos as f64 / 1e3
        );
        Ok(Check::new("latency_ratio_at_most", ratio <= most, text))
    }
}

fn edge_check(comparison: EdgeComparison, is_update: bool) -> Check {
    let EdgeComparison { n_recorded, n_found, n_differing, n_grasps, first, n_not_compared, .. } = &comparison;
    let text = match first {
        None if *n_not_compared > 0 => format!("{n_recorded} samples, {n_not_compared} more were not compared"),
        None => format!("{n_recorded} samples"),
        Some(first) => format!(
            "{n_differing} samples differ ({n_recorded} recorded, {n_found} found), in {n_grasps} grasps; first: {first}"
        ),
    };
    let has_passed = is_update || *n_differing == 0;
    Check { name: comparison.topic.clone(), has_passed, text, edge: Some(comparison) }
}

fn not_covered(coverage: &Coverage) -> Vec<String> {
    let attached = "it was attached midway: the decision of its first grasp is not compared";
    let detached = "it was detached midway: a decision of its last grasp that it does not have is not compared";
    let cut_off = "it was cut off: what it does not have at the end of an edge is not compared";
    let notes = [(coverage.is_attached, attached), (coverage.is_detached, detached), (coverage.is_cut_off, cut_off)];
    notes.into_iter().filter(|(is_so, _)| *is_so).map(|(_, note)| note.to_string()).collect()
}

/// What lies before each frame of the part that is measured.
fn pauses(recording: &Path, topic: &str) -> anyhow::Result<Vec<Duration>> {
    let mut pauses = Vec::new();
    let mut stamps: Option<(u64, u64)> = None;
    for record in RecordingReader::open(recording)? {
        let (of, record) = record?;
        if of != topic || played(&record).is_none() {
            continue;
        }
        let stamp_nanos = record.header().stamp_nanos;
        let (first, last) = stamps.unwrap_or((stamp_nanos, stamp_nanos));
        if stamp_nanos.saturating_sub(first) >= MEASURED_NANOS {
            break;
        }
        pauses.push(Duration::from_nanos(stamp_nanos.saturating_sub(last).min(MEASURED_NANOS)));
        stamps = Some((first, stamp_nanos));
    }
    Ok(pauses)
}

/// The number of nodes on it.
fn longest_path(graph: &Graph) -> usize {
    let mut lengths: BTreeMap<&str, usize> = BTreeMap::new();
    for node in &graph.nodes {
        let before = node
            .inputs
            .iter()
            .filter(|input| !input.feedback)
            .filter_map(|input| lengths.get(input.from_node.as_str()));
        let length = before.max().copied().unwrap_or(0) + 1;
        lengths.insert(&node.id, length);
    }
    lengths.into_values().max().unwrap_or(0)
}

/// What a replay decided.
#[derive(Default)]
pub(super) struct Decided {
    pub(super) decisions: BTreeMap<u64, LiftDecision>,
    pub(super) truths: BTreeMap<u64, GraspTruth>,
    /// Decisions and truths of a grasp that had one already, which a source that started anew may have numbered the
    /// same.
    n_again: usize,
}

impl Decided {
    pub(super) fn read(found: &Path, graph: &Graph) -> anyhow::Result<Decided> {
        let mut decided = Decided::default();
        let deciders = graph.nodes.iter().flat_map(|node| node.outputs());
        if deciders.filter(|output| output.type_name == LiftDecision::TYPE_NAME).count() > 1 {
            bail!(
                "graph '{}' decides each grasp several times: expectations of decisions are for one arbiter",
                graph.name
            );
        }
        for record in RecordingReader::open(found)? {
            match record?.1 {
                Record::Decision(sample) => {
                    let before = decided.decisions.insert(sample.message.grasp_id, sample.message);
                    decided.n_again += usize::from(before.is_some());
                }
                Record::Truth(sample) => {
                    let before = decided.truths.insert(sample.message.grasp_id, sample.message);
                    decided.n_again += usize::from(before.is_some());
                }
                _ => {}
            }
        }
        Ok(decided)
    }

    fn check(&self, expected: &Expectations) -> Vec<Check> {
        let mut checks = Vec::new();
        if self.n_again > 0 && expected.has_demands() {
            let text =
                "grasps of one number are decided or known several times: which of them is meant, nobody can say";
            checks.push(Check::new("grasps", false, text.into()));
        }
        let mut score = Score::default();
        let (mut n_right, mut n_undecided) = (0, 0);
        for (grasp_id, truth) in &self.truths {
            match self.decisions.get(grasp_id).map(|decision| decision.action == Action::Lift) {
                Some(is_lift) => {
                    score.add(is_lift, truth.stable);
                    n_right += usize::from(is_lift == truth.stable);
                }
                None => n_undecided += 1,
            }
        }
        if let Some(least) = expected.accuracy_at_least {
            // What was never decided was not decided rightly.
            let n_grasps = score.n_grasps + n_undecided;
            let accuracy = (n_grasps > 0).then(|| n_right as f64 / n_grasps as f64);
            let undecided = if n_undecided > 0 { format!(", {n_undecided} undecided") } else { String::new() };
            let text = format!(
                "{} of {n_grasps} grasps with truth{undecided}, at least {}",
                percent(accuracy),
                percent(Some(least))
            );
            let is_enough = accuracy.is_some_and(|accuracy| accuracy >= least);
            checks.push(Check::new("accuracy_at_least", is_enough, text));
        }
        if let Some(most) = expected.false_positives_at_most {
            let has_truth = score.n_grasps > 0;
            let text = match has_truth {
                true => format!("{} of {} grasps with truth, at most {most}", score.n_false_positive, score.n_grasps),
                false => "the recording knows of no grasp what it really was (/truth)".into(),
            };
            checks.push(Check::new("false_positives_at_most", has_truth && score.n_false_positive <= most, text));
        }
        if !expected.decisions.is_empty() {
            let wrong: Vec<String> = expected.decisions.iter().filter_map(|wanted| self.wrong(wanted)).collect();
            let text = match wrong.as_slice() {
                [] => format!("{} grasps as expected", expected.decisions.len()),
                wrong => wrong.join("; "),
            };
            checks.push(Check::new("decisions", wrong.is_empty(), text));
        }
        if !expected.reasons.is_empty() {
            let n_of = |word: &str| self.decisions.values().filter(|decision| decision.reason.as_str() == word).count();
            let counts = expected.reasons.iter().map(|(word, wanted)| (word, n_of(word), *wanted));
            let texts = counts.clone().map(|(word, n, wanted)| match n == wanted {
                true => format!("{word} {n}"),
                false => format!("{word} {n}, expected {wanted}"),
            });
            let text = texts.collect::<Vec<_>>().join("; ");
            checks.push(Check::new("reasons", counts.clone().all(|(_, n, wanted)| n == wanted), text));
        }
        checks
    }

    fn wrong(&self, (grasp_id, (action, reason)): (&u64, &(Action, Option<Reason>))) -> Option<String> {
        let expected =
            reason.map_or(action.as_str().to_string(), |reason| format!("{} {}", action.as_str(), reason.as_str()));
        let Some(found) = self.decisions.get(grasp_id) else {
            return Some(format!("grasp {grasp_id}: expected {expected}, found no decision"));
        };
        // What is to be grasped anew is held as well.
        let is_action = found.action == *action || (*action, found.action) == (Action::Hold, Action::Regrasp);
        let is_right = is_action && reason.is_none_or(|reason| found.reason == reason);
        let said = || {
            format!("grasp {grasp_id}: expected {expected}, found {} {}", found.action.as_str(), found.reason.as_str())
        };
        (!is_right).then(said)
    }
}
