//! Runs a graph from a program of one's own, and prints its decisions.
//!
//! ```sh
//! cargo build --release && cargo run --release --example run_graph -- target/release/blindgrasp dataflow.yaml
//! ```
//!
//! The operators that the file names by a word (`contacts`, `classifier`, …) are those of the program `blindgrasp`.

use std::path::Path;
use std::sync::atomic::AtomicUsize;

use anyhow::Context;
use blindgrasp_graph::dataflow::{self, Scope};
use blindgrasp_graph::describe::describe;
use blindgrasp_graph::run::{Run, RunOptions, RunSink, SeenDecision};
use blindgrasp_operators::operators_of;

/// Prints what it hears of the graph.
struct Print;

impl RunSink for Print {
    fn decision(&mut self, seen: &SeenDecision<'_>) -> anyhow::Result<()> {
        let decision = seen.decision;
        println!("grasp {}: {} ({})", decision.grasp_id, decision.action.as_str(), decision.reason.as_str());
        Ok(())
    }
}

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let program = args.next().context("expected the program blindgrasp, then a dataflow file")?;
    let file = args.next().context("expected a dataflow file after the program")?;

    let operators = operators_of(&std::path::absolute(program)?);
    let file = dataflow::load(Path::new(&file))?;
    let graph = dataflow::check(&file, &operators, &[], Scope::Everything, describe)?;
    // A caller that wants to stop the graph counts up.
    let n_stops = AtomicUsize::new(0);
    let ended = Run::prepare(&graph, &graph.name, RunOptions::default())?.run(Print, &n_stops)?;
    ended.outcome?;
    println!("{} grasps were decided", ended.summary.grasps);
    Ok(())
}
