//! The graph of trials: which node tries, and what it and the others are told.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::Arguments;
use crate::dataflow::{self, DataflowFile, Graph, Node, Override, Scope};
use crate::hand::Hand;
use crate::message::{LiftOutcome, Recorded};
use crate::runtime::describe::{describe, shipped};
use crate::trial::TrialOptions;

/// The hand of a node that names none.
const DEFAULT_HAND: &str = "barrett-bh8-280";

/// A dataflow file and what it is run with.
pub(super) struct Setup {
    file: DataflowFile,
    overrides: Vec<Override>,
    /// The node that tries to lift.
    pub(super) node: String,
    /// That node's hand.
    pub(super) hand: Hand,
    /// The friction that it gives all things, if it does.
    pub(super) friction: Option<f64>,
    /// How it tries.
    pub(super) options: TrialOptions,
    /// The model that judges: its file.
    pub(super) model: String,
}

impl Setup {
    /// Reads the file and finds the node whose outcomes are counted.
    ///
    /// # Errors
    /// The file is none, or has no such node; with what to do.
    pub(super) fn new(arguments: &Arguments) -> anyhow::Result<Setup> {
        let file = dataflow::load(&arguments.dataflow)?;
        let graph = dataflow::check(&file, &shipped()?, &arguments.overrides, Scope::Everything, describe)?;
        if graph.machines.is_some() {
            bail!("{}: trials run on one machine, and the file names several", arguments.dataflow.display());
        }
        let tries = |node: &&Node| node.outputs().iter().any(|output| output.type_name == LiftOutcome::TYPE_NAME);
        let node = graph.nodes.iter().find(tries).with_context(|| {
            format!(
                "{}: no node says what became of lifts; expected one like simulated_hand in dataflow-trials.yaml, \
                 which 'blindgrasp init DIR' writes",
                arguments.dataflow.display()
            )
        })?;
        let set = |node: &str, param: &str, text: String| Override { node: node.into(), param: param.into(), text };
        let mut overrides = arguments.overrides.clone();
        if let Some(set) = overrides.iter().find(|set| set.node == node.id && own_option(&set.param).is_some()) {
            bail!("--set {set}: say that with {}", own_option(&set.param).unwrap_or_default());
        }
        for (param, text) in [
            ("things", arguments.objects.clone()),
            ("trials", arguments.trials.to_string()),
            ("attempts", arguments.attempts.to_string()),
            ("seed", arguments.seed.to_string()),
        ] {
            overrides.push(set(&node.id, param, text));
        }
        let mut model = text_param(&graph, "model").unwrap_or_default();
        if let Some(path) = &arguments.model {
            let path = path.to_str().context("--model: the path is not UTF-8")?;
            let judges = graph.nodes.iter().filter(|node| node.params.contains_key("model"));
            overrides.extend(judges.map(|node| set(&node.id, "model", path.into())));
            model = path.into();
        }
        let options = match (&arguments.options, node.params.get("options").and_then(|path| path.as_str())) {
            (Some(path), _) => {
                let text = path.to_str().context("--options: the path is not UTF-8")?;
                overrides.push(set(&node.id, "options", text.into()));
                TrialOptions::load(path)?
            }
            (None, Some(path)) => TrialOptions::load(Path::new(path))?,
            (None, None) => TrialOptions::default(),
        };
        let hand = node.params.get("hand").and_then(|hand| hand.as_str()).unwrap_or(DEFAULT_HAND);
        let hand = Hand::load(Path::new(hand))?;
        let friction = node.params.get("friction").and_then(|friction| friction.as_f64());
        let model = PathBuf::from(&model).file_name().map_or(model, |name| name.to_string_lossy().into_owned());
        Ok(Setup { node: node.id.clone(), file, overrides, hand, friction, options, model })
    }

    /// The checked graph, with the gate or without.
    ///
    /// # Errors
    /// A value that a node does not take.
    pub(super) fn graph(&self, gate: bool) -> anyhow::Result<Graph> {
        let mut overrides = self.overrides.clone();
        let text = if gate { "on" } else { "off" };
        overrides.push(Override { node: self.node.clone(), param: "gate".into(), text: text.into() });
        Ok(dataflow::check(&self.file, &shipped()?, &overrides, Scope::Everything, describe)?)
    }
}

/// The option of the command that says what a param of the trying node would.
fn own_option(param: &str) -> Option<&'static str> {
    let options = [
        ("things", "--objects"),
        ("trials", "--trials"),
        ("attempts", "--attempts"),
        ("seed", "--seed"),
        ("gate", "--gate"),
    ];
    options.iter().find(|(own, _)| *own == param).map(|(_, option)| *option)
}

/// The first value of a param of that name.
fn text_param(graph: &Graph, param: &str) -> Option<String> {
    graph.nodes.iter().find_map(|node| Some(node.params.get(param)?.as_str()?.to_owned()))
}
