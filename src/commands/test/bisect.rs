//! What another model makes of the recordings.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::Serialize;
use serde_json::json;

use super::case::{Decided, Runner};
use super::scratch::file_name;
use crate::commands::replay::Origin;
use crate::commands::{Outcome, print_line};
use blindgrasp_graph::dataflow::Override;
use blindgrasp_messages::{Action, GraspTruth, LiftDecision};
use blindgrasp_replay::comparison::{ComparedEdge, Coverage, Difference, Tolerance, compare_edge};
use blindgrasp_replay::expectations::Expectations;

/// A grasp that the two models decide otherwise.
#[derive(Serialize)]
struct Changed {
    grasp_id: u64,
    old: Option<LiftDecision>,
    new: Option<LiftDecision>,
    truth: Option<GraspTruth>,
}

/// What changed in a recording.
#[derive(Serialize)]
struct Changes {
    recording: PathBuf,
    n_grasps: usize,
    changed: Vec<Changed>,
    /// The first edge that differs, and its first difference.
    first: Option<Place>,
}

#[derive(Serialize)]
struct Place {
    topic: String,
    #[serde(flatten)]
    difference: Difference,
}

/// How many grasps changed, and for better or worse.
#[derive(Default, Serialize)]
struct Sums {
    n_grasps: usize,
    n_changed: usize,
    n_newly_right: usize,
    n_newly_wrong: usize,
    n_new_false_positives: usize,
}

/// Replays each recording with the old model and with the graph's own, and shows what is decided otherwise.
pub(super) fn run(
    runner: &Runner<'_>,
    recordings: &[PathBuf],
    old_model: &Path,
    is_json: bool,
) -> anyhow::Result<Outcome> {
    let mut sums = Sums::default();
    let mut all = Vec::new();
    for recording in recordings {
        let changes = changes(runner, recording, old_model)?;
        runner.check_stop()?;
        sums.add(&changes);
        match is_json {
            true => all.push(changes),
            false => print(&changes)?,
        }
    }
    if is_json {
        print_line(&serde_json::to_string_pretty(&json!({"recordings": all, "summary": sums}))?)?;
    } else {
        print_line(&format!(
            "{} of {} grasps decided otherwise: {} newly right, {} newly wrong, {} new false positives",
            sums.n_changed, sums.n_grasps, sums.n_newly_right, sums.n_newly_wrong, sums.n_new_false_positives
        ))?;
    }
    Ok(Outcome::Done)
}

fn changes(runner: &Runner<'_>, recording: &Path, old_model: &Path) -> anyhow::Result<Changes> {
    let expected = Expectations::of(recording)?.unwrap_or_default();
    let graph = runner.graph(&expected, &[])?;
    let text = old_model.to_str().context("the model's path is not UTF-8")?;
    let with_model =
        graph.nodes.iter().filter(|node| node.description.params.iter().any(|param| param.name == "model"));
    let overrides: Vec<Override> =
        with_model.map(|node| Override { node: node.id.clone(), param: "model".into(), text: text.into() }).collect();
    if overrides.is_empty() {
        bail!("--bisect: no node of graph '{}' has a param 'model'", graph.name);
    }
    let old_graph = runner.graph(&expected, &overrides)?;
    let new_path = runner.scratch.path(recording);
    let old_path = new_path.with_file_name(format!("old-{}", file_name(recording)));
    // Nodes that the recording stands for have models, too: they don't run.
    let old = runner.replay(recording, &old_graph, &[], &old_path)?;
    let runs = |set: &Override| {
        set.node != old.fed.replaced.node && old.fed.graph.nodes.iter().any(|node| node.id == set.node)
    };
    if !overrides.iter().any(runs) {
        bail!("--bisect: no node with a model runs behind '{}'", old.fed.replaced.node);
    }
    let new = runner.replay(recording, &graph, &[], &new_path)?;
    let (before, after) = (Decided::read(&old.found, &old.fed.graph)?, Decided::read(&new.found, &new.fed.graph)?);
    let grasp_ids: BTreeSet<u64> = before.decisions.keys().chain(after.decisions.keys()).copied().collect();
    let n_grasps = grasp_ids.len();
    let changed = grasp_ids.into_iter().filter_map(|grasp_id| {
        let (old, new) = (before.decisions.get(&grasp_id), after.decisions.get(&grasp_id));
        let said = |decision: Option<&LiftDecision>| decision.map(|decision| (decision.action, decision.reason));
        let truth = after.truths.get(&grasp_id).cloned();
        (said(old) != said(new)).then(|| Changed { grasp_id, old: old.cloned(), new: new.cloned(), truth })
    });
    let changed = changed.collect();
    // Both are replays: their numbers begin at 0.
    let played = new.fed.edges.iter().find(|edge| edge.origin == Origin::Played).context("nothing was played")?;
    let coverage = Coverage::of(&old.found, &played.found_topic)?;
    let mut first = None;
    for edge in &new.fed.edges {
        let topic = edge.found_topic.clone();
        let edge = ComparedEdge {
            recorded_topic: topic.clone(),
            found_topic: topic,
            tolerance: Tolerance::default(),
            is_played: false,
        };
        if let Some(difference) = compare_edge(&old.found, &new.found, &edge, &coverage)?.first {
            first = Some(Place { topic: edge.recorded_topic, difference });
            break;
        }
    }
    Ok(Changes { recording: recording.into(), n_grasps, changed, first })
}

impl Sums {
    fn add(&mut self, changes: &Changes) {
        self.n_grasps += changes.n_grasps;
        self.n_changed += changes.changed.len();
        for Changed { old, new, truth, .. } in &changes.changed {
            let Some(truth) = truth else { continue };
            // A grasp that nobody decides is not lifted.
            let is_lifted =
                |decision: &Option<LiftDecision>| decision.as_ref().is_some_and(|said| said.action == Action::Lift);
            let (before, after) = (is_lifted(old), is_lifted(new));
            self.n_newly_right += usize::from(before != truth.stable && after == truth.stable);
            self.n_newly_wrong += usize::from(before == truth.stable && after != truth.stable);
            self.n_new_false_positives += usize::from(!before && after && !truth.stable);
        }
    }
}

fn print(changes: &Changes) -> anyhow::Result<()> {
    print_line(&changes.recording.display().to_string())?;
    let shown = |decision: &Option<LiftDecision>| match decision {
        Some(LiftDecision { action, reason, probability_stable, .. }) => {
            format!("{} {} (p {probability_stable:.4})", action.shown(), reason.as_str())
        }
        None => "no decision".into(),
    };
    for Changed { grasp_id, old, new, truth } in &changes.changed {
        let truth = truth.as_ref().map_or(String::new(), |truth| {
            format!("  truth: {} ({})", if truth.stable { "stable" } else { "unstable" }, truth.object)
        });
        print_line(&format!("  grasp {grasp_id:>5}  {} → {}{truth}", shown(old), shown(new)))?;
    }
    match &changes.first {
        Some(Place { topic, difference }) => print_line(&format!("  first difference: {topic}, {difference}"))?,
        None => print_line("  no edge differs")?,
    }
    Ok(())
}
