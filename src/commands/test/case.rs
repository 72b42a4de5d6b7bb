//! One recording: replayed, compared, checked.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::json;

use super::faults::hand_of;
use super::scratch::Scratch;
use super::settings;
use crate::commands::replay::{Fed, Feed};
use blindgrasp_cli::graph_file::{OnMisfit, fitting};
use blindgrasp_graph::dataflow::{self, Graph, Override};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::run::{RunSummary, observed_topics};
use blindgrasp_grasps::shown_hand::shown_hand;
use blindgrasp_messages::{LiftDecision, Recorded};
use blindgrasp_operator::text::counted;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_recording::{LiveOptions, RecordingReader};
use blindgrasp_replay::checks::{self, ChangedDecision, Check, Decisions, describe_changes};
use blindgrasp_replay::comparison::{ComparedEdge, Coverage, compare_edge};
use blindgrasp_replay::expectations::{self, Expectations};
use blindgrasp_replay::selection::Selection;
use blindgrasp_replay::update::update;
use blindgrasp_session::run::Session;

/// The options that all recordings have in common.
pub(super) struct Runner<'a> {
    pub(super) dataflow: &'a Path,
    /// Parameters that have other values than in the dataflow file.
    pub(super) overrides: &'a [Override],
    pub(super) replace: Option<&'a str>,
    pub(super) scratch: Scratch,
    pub(super) n_stops: &'a AtomicUsize,
}

/// The outcome of a recording.
#[derive(Debug, Deserialize)]
pub(super) struct Case {
    pub(super) recording: PathBuf,
    pub(super) checks: Vec<Check>,
    /// The grasps whose action is another one than recorded.
    #[serde(rename = "changed_actions")]
    pub(super) changed: Vec<ChangedDecision>,
    /// The samples that could not be compared, and why.
    pub(super) notes: Vec<String>,
    pub(super) secs: f64,
}

impl Case {
    pub(super) fn has_passed(&self) -> bool {
        self.checks.iter().all(|check| check.has_passed)
    }
}

impl Runner<'_> {
    /// Tests a recording. An error in it is a failed check; only a stop ends all tests.
    pub(super) fn test(&self, recording: &Path, is_update: bool) -> Option<Case> {
        let start = Instant::now();
        let mut case =
            Case { recording: recording.into(), checks: Vec::new(), changed: Vec::new(), notes: Vec::new(), secs: 0.0 };
        let outcome = self.fill(&mut case, is_update);
        self.check_stop().ok()?;
        if let Err(error) = outcome {
            case.checks.push(Check::new("error", false, format!("{error:#}")));
        }
        case.secs = start.elapsed().as_secs_f64();
        Some(case)
    }

    fn fill(&self, case: &mut Case, is_update: bool) -> anyhow::Result<()> {
        let recording = case.recording.clone();
        let expected = Expectations::of(&recording)?.unwrap_or_default();
        let graph = self.graph(&expected, self.overrides)?;
        let found = self.scratch.path(&recording);
        let (fed, summary) = self.replay(&recording, &graph, self.overrides, &found)?;
        let n_lost = summary.samples_lost + summary.samples_dropped;
        let has_lost = n_lost > 0 || summary.edges_unknown > 0;
        let text = if has_lost {
            format!("{} lost, unknown on {}", counted(n_lost, "sample"), counted(summary.edges_unknown, "edge"))
        } else {
            format!("{} decided, nothing lost", counted(summary.grasps, "grasp"))
        };
        case.checks.push(Check::new("replay", !has_lost, text));

        let (edges, checks) = edges_to_compare(&recording, &found, &fed, &graph, &expected, is_update)?;
        case.checks.extend(checks);
        if edges.is_empty() && !is_update && !expected.has_demands() {
            bail!(
                "nothing to compare: the recording holds no stage's output, and it has no expectations of decisions; \
                 record the edges with --update, or write {}",
                expectations::path_of(&recording).display()
            );
        }
        let coverage = Coverage::of(&recording, &fed.topic)?;
        let compared = edges.par_iter().map(|edge| {
            self.check_stop()?;
            Ok(Check::of_edge(compare_edge(&recording, &found, edge, &coverage)?, is_update))
        });
        let compared: Vec<anyhow::Result<Check>> = compared.collect();
        for check in compared {
            case.checks.push(check?);
        }
        let decisions = Decisions::read(&found)?;
        if let Some(of_decisions) = decisions_edge(&recording, &mut case.checks)? {
            let mut changed = decisions.changed_since(&Decisions::read(&recording)?);
            changed.retain(|changed| coverage.covers_decision(changed.grasp_id));
            of_decisions.text += &describe_changes(&changed).map_or(String::new(), |text| format!("; {text}"));
            case.changed = changed;
        }
        case.notes.extend(coverage.notes());
        if !case.has_passed() {
            case.notes.extend(settings::differing(&RecordingReader::open(&recording)?, &graph));
        }
        if is_update && !has_lost {
            let hand_id = RecordingReader::open(&recording)?.info().hand_id;
            let hand = hand_of(&graph).ok().filter(|hand| hand.id() == hand_id).as_ref().map(shown_hand);
            case.notes.push(update(&recording, &found, &fed.topic, &fed.edges, &coverage, hand)?);
        }
        let deciders = fed.graph.nodes.iter().flat_map(|node| node.outputs());
        if deciders.filter(|output| output.type_name == LiftDecision::TYPE_NAME).count() > 1 {
            bail!(
                "graph '{}' decides each grasp several times: expectations of decisions are for one arbiter",
                graph.name
            );
        }
        case.checks.extend(decisions.check(&expected));
        Ok(())
    }

    /// The graph of the dataflow file that is expected, or of the usual one. The command's overrides come before those that are
    /// expected.
    pub(super) fn graph(&self, expected: &Expectations, overrides: &[Override]) -> anyhow::Result<Graph> {
        let file = dataflow::load(expected.dataflow.as_deref().unwrap_or(self.dataflow))?;
        let mut all = overrides.to_vec();
        for text in &expected.set {
            let set = Override::parse(text).map_err(|reason| anyhow::anyhow!("set of the expectations: {reason}"))?;
            let is_given = |given: &Override| {
                given.param == set.param && (given.node.is_none() || set.node.is_none() || given.node == set.node)
            };
            if !overrides.iter().any(is_given) {
                all.push(set);
            }
        }
        fitting(&file, &all, dataflow::Scope::Everything, OnMisfit::Warn)
    }

    /// The decisions of a replay. Lost samples are an error.
    pub(super) fn decide(
        &self,
        recording: &Path,
        graph: &Graph,
        overrides: &[Override],
    ) -> anyhow::Result<(Fed, Decisions)> {
        let (shown, found) = (recording.display().to_string(), self.scratch.path(recording));
        let (fed, summary) = self.replay(recording, graph, overrides, &found).context(shown.clone())?;
        if summary.samples_lost + summary.samples_dropped > 0 || summary.edges_unknown > 0 {
            bail!("{shown}: the replay lost samples, so its decisions say nothing: run the command again");
        }
        Ok((fed, Decisions::read(&found)?))
    }

    /// Plays a recording as fast as the graph takes it, and records every edge to `found`.
    pub(super) fn replay(
        &self,
        recording: &Path,
        graph: &Graph,
        overrides: &[Override],
        found: &Path,
    ) -> anyhow::Result<(Fed, RunSummary)> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let feed = Feed {
            recording,
            replace: self.replace,
            selection: &Selection::default(),
            rate: json!("max"),
            repeat: json!(1.0),
        };
        let fed = feed.into_graph(graph, overrides)?;
        let name = format!("test-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let session = Session {
            launch: LaunchOptions {
                startup_limit: Duration::from_secs(60),
                is_on_terminal: false,
                ..LaunchOptions::default()
            },
            clock: Clock::Recording,
            record: Some(found.to_path_buf()),
            record_options: LiveOptions { overwrite: true, ..LiveOptions::default() },
            is_quiet: true,
            ..Session::default()
        };
        let ended = session.run(&fed.graph, &name, self.n_stops)?;
        self.check_stop()?;
        if ended.summary.run.end != "finished" {
            bail!("the replay was {}", ended.summary.run.end);
        }
        if ended.summary.samples_not_recorded > 0 {
            let why = ended.summary.recording_error.as_deref().unwrap_or("the disk was too slow");
            bail!("{} samples of the replay could not be recorded: {why}", ended.summary.samples_not_recorded);
        }
        Ok((fed, ended.summary.run))
    }
}

/// The check of the edge with the decisions, if the recording has one.
fn decisions_edge<'a>(recording: &Path, checks: &'a mut [Check]) -> anyhow::Result<Option<&'a mut Check>> {
    let reader = RecordingReader::open(recording)?;
    let is_of_decisions =
        |topic: &str| reader.topics().get(topic).is_some_and(|schema| schema.ends_with("/LiftDecision"));
    Ok(checks.iter_mut().find(|check| check.edge.is_some() && is_of_decisions(&check.name)))
}

fn edges_to_compare(
    recording: &Path,
    found: &Path,
    fed: &Fed,
    graph: &Graph,
    expected: &Expectations,
    is_update: bool,
) -> anyhow::Result<(Vec<ComparedEdge>, Vec<Check>)> {
    let (recorded, found) = (RecordingReader::open(recording)?, RecordingReader::open(found)?);
    let topics = observed_topics(graph, true);
    let topics = topics.values().map(String::as_str).collect();
    Ok(checks::edges_to_compare(&fed.edges, &topics, recorded.topics(), found.topics(), expected, is_update)?)
}
