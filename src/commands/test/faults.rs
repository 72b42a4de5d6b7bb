//! `test --faults`: the decisions about recordings with faults of sensors and transports.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde_json::json;

use super::Outcome;
use super::case::Runner;
use crate::commands::text_table::TextTable;
use crate::commands::{print_line, print_text};
use blindgrasp_graph::dataflow::Graph;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_recording::RecordingReader;
use blindgrasp_replay::checks::{ChangedDecision, Decisions};
use blindgrasp_replay::expectations::Expectations;
use blindgrasp_replay::faults::{InjectedFault, write_with_fault};
use blindgrasp_stages::hand::Hand;

pub(super) fn run(runner: &Runner<'_>, recordings: &[PathBuf], is_json: bool) -> anyhow::Result<Outcome> {
    let (mut n_lifted_now, mut all, mut n_replayed) = (0, Vec::new(), 0);
    for recording in recordings {
        let shown = recording.display().to_string();
        let expected = Expectations::of(recording)?.unwrap_or_default();
        let graph = runner.graph(&expected, runner.overrides)?;
        let (hand, of_recording) = (hand_of(&graph)?, RecordingReader::open(recording)?.info().hand_id);
        if of_recording != 0 && of_recording != hand.id() {
            print_diagnostic(&format!("{}: left out: it is of another hand than graph '{}'", shown, graph.name));
            continue;
        }
        let (fed, whole) = runner.decide(recording, &graph, runner.overrides)?;
        n_replayed += 1;
        if fed.replaced.played_port != "tactile" {
            bail!("{}: --faults are of frames, and the recording plays {}", shown, fed.topic);
        }
        let found = runner.scratch.path(recording);
        let pad_of_cell: Vec<usize> = hand.cells().map(|(pad_idx, _)| pad_idx).collect();
        let mut table = TextTable::new(["fault", "held -> lifted", "lifted -> held"], 1);
        let mut told = Vec::new();
        for (fault, words) in InjectedFault::ALL {
            let faulty = runner.scratch.path(Path::new(&format!(".{}-with-fault.mcap", std::process::id())));
            write_with_fault(recording, &fed.topic, fault, &pad_of_cell, &faulty).with_context(|| shown.clone())?;
            // A doubled frame is dropped on the way, which counts as a loss.
            let replayed = runner.replay(&faulty, &graph, runner.overrides, &found);
            replayed.with_context(|| format!("{shown} with a fault: {words}"))?;
            let changed = Decisions::read(&found)?.changed_since(&whole);
            let (lifted, held): (Vec<_>, Vec<_>) = changed.iter().partition(|changed| changed.is_lifted_now());
            n_lifted_now += lifted.len();
            table.row([words.into(), lifted.len().to_string(), held.len().to_string()]);
            told.extend(lifted.into_iter().map(|changed: &ChangedDecision| format!("{words}: {changed}")));
            all.push(json!({"recording": &shown, "fault": fault, "changed_actions": changed}));
        }
        if !is_json {
            print_line(&format!("{shown}: {} without a fault", counted(whole.tally().n_lifts, "lift")))?;
            for line in table.lines().iter().chain(&told) {
                print_line(&format!("  {line}"))?;
            }
        }
    }
    if is_json {
        print_text(&serde_json::to_string_pretty(
            &json!({"faults": all, "n_lifted_only_with_a_fault": n_lifted_now}),
        )?)?;
    }
    if n_replayed == 0 {
        bail!("no recording of this graph's hand was named: nothing was tested");
    }
    if n_lifted_now > 0 {
        bail!("lifted with a fault and held without it: {}", counted(n_lifted_now, "grasp"));
    }
    let replayed = counted(n_replayed, "recording");
    print_diagnostic(&format!("no grasp of {replayed} is lifted with a fault that is held without it"));
    Ok(Outcome::Done)
}

/// The hand of the graph's first node that names one.
pub(super) fn hand_of(graph: &Graph) -> anyhow::Result<Hand> {
    let path = graph.nodes.iter().find_map(|node| node.params.get("hand")?.as_str().map(PathBuf::from));
    let path = path.with_context(|| format!("no node of graph '{}' names the hand", graph.name))?;
    Ok(Hand::load(&path)?)
}
