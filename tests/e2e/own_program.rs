//! A program that is not blindgrasp runs a graph: this one. It must never be started as an operator.

use std::path::Path;
use std::sync::atomic::AtomicUsize;

use crate::common::{assert_nothing_left, dataflow, program, unique_name};
use blindgrasp_graph::dataflow::{self, Graph, Override, Scope};
use blindgrasp_graph::describe::describe;
use blindgrasp_graph::operators::Operators;
use blindgrasp_graph::run::{Run, RunOptions, RunSink, SeenDecision};

/// Counts decisions.
struct Counter(usize);

impl RunSink for Counter {
    fn decision(&mut self, _decision: &SeenDecision<'_>) -> anyhow::Result<()> {
        self.0 += 1;
        Ok(())
    }
}

fn checked(folder: &Path, operators: &Operators) -> Result<Graph, String> {
    let file = dataflow::load(&dataflow(folder, &[])).expect("readable");
    let fast = Override::parse("recorded_source.rate=max").expect("an override");
    dataflow::check(&file, operators, &[fast], Scope::Everything, describe).map_err(|error| error.to_string())
}

#[test]
fn another_program_runs_a_graph_with_the_operators_of_blindgrasp() {
    let folder = tempfile::tempdir().expect("a folder");
    let names = ["recorded_source", "contacts", "encoder", "classifier", "lift_arbiter"];
    let operators = Operators::of_program(Path::new(program()), names);
    let graph = checked(folder.path(), &operators).expect("a graph");
    let name = unique_name();
    let options = RunOptions { is_quiet: true, ..RunOptions::default() };
    let ended = Run::prepare(&graph, &name, options).expect("prepared").run(Counter(0), &AtomicUsize::new(0));
    let ended = ended.expect("run");
    ended.outcome.expect("finished");
    assert_eq!((ended.sink.0, ended.summary.samples_lost), (240, 0));
    assert_nothing_left(&name);
}

#[test]
fn without_operators_a_program_starts_nothing_and_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = checked(folder.path(), &Operators::default()).expect_err("no operators");
    assert!(error.contains("unknown operator 'contacts'; there are no operators by name here"), "{error}");
}
