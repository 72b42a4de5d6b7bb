//! `test --init`: expectations from the decisions of a replay.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde_json::json;

use super::case::Runner;
use super::{Outcome, project_recordings, settings};
use crate::commands::{print_line, print_text, write_out};
use blindgrasp_cli::graph_file::checked;
use blindgrasp_graph::dataflow::{self, Graph, Scope};
use blindgrasp_operator::text::counted;
use blindgrasp_recording::RecordingReader;
use blindgrasp_replay::checks::{Decisions, describe_changes};
use blindgrasp_replay::expectations::{Expectations, path_of};

/// The file's first lines.
const HEAD: &str = "# What `blindgrasp test` expects of the recording's replay (docs/replay.md#expectations).\n";

/// The project's recordings that have no expectations.
pub(super) fn without_expectations(dataflow: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let (folder, files) = project_recordings(dataflow)?;
    let recordings = files.into_iter().filter(|path| path.extension().is_some_and(|end| end == "mcap"));
    let found: Vec<PathBuf> = recordings.filter(|path| !path_of(path).exists()).collect();
    if found.is_empty() {
        bail!("each recording in {} has expectations: name the recording", folder.display());
    }
    Ok(found)
}

pub(super) fn write(runner: &Runner<'_>, recordings: &[PathBuf], is_json: bool) -> anyhow::Result<Outcome> {
    for recording in recordings {
        let path = path_of(recording);
        if path.exists() {
            bail!("{}: the file exists: edit it, or remove it first", path.display());
        }
    }
    let mut written = Vec::new();
    for recording in recordings {
        let (graph, decisions, expected) = replayed(runner, recording)?;
        let remarks: BTreeMap<u64, String> =
            decisions.dropped().map(|grasp_id| (grasp_id, "its lift dropped the object".into())).collect();
        let path = path_of(recording);
        write_out(&path, &(HEAD.to_string() + &expected.to_yaml(&remarks)))?;
        let changed = decisions.changed_since(&Decisions::read(recording)?);
        let fails = decisions.check(&expected).iter().any(|check| !check.has_passed);
        if !is_json {
            print_line(&format!(
                "{}: {}",
                path.display(),
                counted(decisions.tally().n_lifts + decisions.tally().n_holds, "grasp")
            ))?;
            for grasp_id in remarks.keys() {
                print_line(&format!("  grasp {grasp_id} dropped its object: it is expected to be held"))?;
            }
            if fails {
                print_line("  the graph does not meet this yet: `blindgrasp test` fails until it does")?;
            }
            if let Some(text) = describe_changes(&changed) {
                print_line(&format!("  the replay decides otherwise than recorded, {text}"))?;
            }
            if let Some(note) = settings::differing(&RecordingReader::open(recording)?, &graph) {
                print_line(&format!("  {note}"))?;
            }
        }
        written.push(json!({
            "recording": recording.display().to_string(), "expectations": path.display().to_string(),
            "dropped": remarks.keys().collect::<Vec<_>>(),
            "is_met": !fails, "changed_actions": changed,
        }));
    }
    if is_json {
        print_text(&serde_json::to_string_pretty(&json!({ "recordings": written }))?)?;
    }
    Ok(Outcome::Done)
}

/// The graph that a recording is replayed with, what it decides, and the expectations that follow.
fn replayed(runner: &Runner<'_>, recording: &Path) -> anyhow::Result<(Graph, Decisions, Expectations)> {
    // The recording's own dataflow file is not known yet: all are replayed with the one of the command, and with the params of
    // the recorded graph.
    let given = checked(&dataflow::load(runner.dataflow)?, runner.overrides, Scope::Everything)?;
    let set = settings::recorded(&RecordingReader::open(recording)?, &given);
    let graph = runner.graph(&Expectations { set, ..Expectations::default() }, runner.overrides)?;
    let (_fed, decisions) = runner.decide(recording, &graph, runner.overrides)?;
    if let Some((grasp_id, reason)) = decisions.held_as_another() {
        bail!(
            "{}: the replay holds grasp {grasp_id} as {}, so it says nothing of the graph that was recorded: give that graph's \
             --dataflow, or --set hand=HAND.yaml and --set model=MODEL.json",
            recording.display(),
            reason.as_str()
        );
    }
    let mut expected = decisions.to_expectations();
    expected.dataflow = other_dataflow(runner.dataflow, recording)?;
    // The file as `test` reads it later: without the command's params, and elsewhere without the variables of this environment.
    let plain = dataflow::load_with(runner.dataflow, &|_| None);
    let plain = plain.ok().and_then(|file| checked(&file, &[], Scope::Everything).ok());
    expected.set = other_params(plain.as_ref(), &graph, recording)?;
    Ok((graph, decisions, expected))
}

fn absolute(path: &Path) -> anyhow::Result<PathBuf> {
    path.canonicalize().with_context(|| path.display().to_string())
}

/// The dataflow file relative to the recording's folder; `None` if it is the one that `test` takes by itself.
fn other_dataflow(dataflow: &Path, recording: &Path) -> anyhow::Result<Option<PathBuf>> {
    let (given, recording) = (dataflow, absolute(recording)?);
    let dataflow = absolute(given)?;
    let folder = recording.parent().unwrap_or(Path::new("/"));
    let is_the_projects = folder.parent().is_some_and(|project| project.join("dataflow.yaml") == dataflow);
    if given == Path::new("dataflow.yaml") || is_the_projects {
        return Ok(None);
    }
    Ok(Some(relative(&dataflow, folder)))
}

/// The params that have other values than in the dataflow file, or all if it cannot be used alone, with paths relative to the
/// recording's folder. The recording takes the place of the source.
fn other_params(plain: Option<&Graph>, graph: &Graph, recording: &Path) -> anyhow::Result<Vec<String>> {
    let recording = absolute(recording)?;
    let folder = recording.parent().unwrap_or(Path::new("/"));
    let mut sets = Vec::new();
    for node in graph.nodes.iter().filter(|node| !node.is_source()) {
        for (name, value) in &node.params {
            let in_file = plain.and_then(|graph| graph.node(&node.id)).and_then(|node| node.params.get(name));
            if value.is_null() || in_file == Some(value) {
                continue;
            }
            let text = match value.as_str() {
                Some(path) if settings::is_path(node, name) => {
                    Path::new(".").join(relative(Path::new(path), folder)).display().to_string()
                }
                Some(text) => text.into(),
                None => value.to_string(),
            };
            sets.push(format!("{}.{name}={text}", node.id));
        }
    }
    Ok(sets)
}

/// A path as seen from a folder. Both begin at the root.
fn relative(path: &Path, folder: &Path) -> PathBuf {
    let n_common = path.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
    let mut relative = PathBuf::new();
    for _ in folder.components().skip(n_common) {
        relative.push("..");
    }
    relative.extend(path.components().skip(n_common));
    relative
}
