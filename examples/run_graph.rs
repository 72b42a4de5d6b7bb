//! Runs a graph from a program of one's own, and prints its decisions.
//!
//! ```sh
//! cargo build --release && cargo run --release --example run_graph -- target/release/blindgrasp dataflow.yaml
//! ```
//!
//! The operators that the file names by a word (`contacts`, `classifier`, …) are those of the program `blindgrasp`.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicUsize;

use anyhow::Context;
use blindgrasp_graph::dataflow::{self, Program, Scope};
use blindgrasp_graph::describe::{SHIPPED, describe};
use blindgrasp_graph::run::{Run, RunOptions, RunSink, SeenDecision};

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

    let program = std::path::absolute(program)?;
    let started = |name: &str| Program { path: program.clone(), args: vec!["operator".into(), name.into()] };
    let operators: BTreeMap<String, Program> =
        SHIPPED.into_iter().map(|name| (name.to_owned(), started(name))).collect();
    let file = dataflow::load(Path::new(&file))?;
    let graph = dataflow::check(&file, &operators, &[], Scope::Everything, describe)?;
    // Whoever wants to stop the graph counts up.
    let n_stops = AtomicUsize::new(0);
    let ended = Run::prepare(&graph, &graph.name, RunOptions::default())?.run(Print, &n_stops)?;
    ended.outcome?;
    println!("{} grasps were decided", ended.summary.grasps);
    Ok(())
}
