//! The graph of trials: the node that lifts, and the params of the nodes.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::{Arguments, Way, physics};
use crate::operators::simulated_hand::DEFAULT_HAND;
use blindgrasp_cli::graph_file::{OnMisfit, checked, fitting};
use blindgrasp_cli::shard::Shard;
use blindgrasp_graph::dataflow::{self, DataflowFile, Graph, Node, Override, Scope};
use blindgrasp_messages::{LiftOutcome, Recorded};
use blindgrasp_simulator::trial::{PhysicsEngine, ProbeMove, TrialOptions};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

/// The source of trials, where a file has the variable `SOURCE`.
const SOURCE: &str = "simulated_hand";
/// While the hand waits for a decision nothing moves, and a simulation on a busy machine may take its time.
const LEAST_MAX_AGE_MS: f64 = 5000.0;
/// The limit of gaps where every grasp is lifted: the arm goes on without the decision, so none should be called stale.
const NO_MAX_GAP_MS: &str = "3600000";

/// A dataflow file and what it is run with.
pub(super) struct Setup {
    file: DataflowFile,
    overrides: Vec<Override>,
    /// The node that lifts.
    pub(super) node: String,
    /// The nodes that limit gaps, unless the user set the limit.
    judges: Vec<String>,
    /// The hand of the node that lifts.
    pub(super) hand: Hand,
    pub(super) options: TrialOptions,
    /// File name of the model.
    pub(super) model: String,
    /// The prior with which the hand chooses its approaches.
    pub(super) prior: Option<ApproachPrior>,
    /// The probe that the arbiter asks for.
    pub(super) probe: Option<ProbeMove>,
}

/// The params of the node that tries, which say what is tried.
fn course_params(arguments: &Arguments, node: &str) -> Vec<Override> {
    let mut params = vec![
        set(node, "things", arguments.objects.clone()),
        set(node, "trials", arguments.trials.to_string()),
        set(node, "attempts", arguments.attempts.to_string()),
        set(node, "seed", arguments.seed.to_string()),
    ];
    if let Some(Shard { idx, n }) = arguments.shard {
        params.push(set(node, "shard", format!("{idx}/{n}")));
    }
    params
}

impl Setup {
    /// Reads the file and finds the node whose outcomes are counted.
    pub(super) fn new(arguments: &Arguments) -> anyhow::Result<Setup> {
        let variable = |name: &str| if name == "SOURCE" { Some(SOURCE.into()) } else { std::env::var(name).ok() };
        let file = dataflow::load_with(&arguments.dataflow, &variable)?;
        let graph = checked(&file, &arguments.overrides, Scope::Everything)?;
        if graph.machines.is_some() {
            bail!("{}: trials run on one machine, and the file names several", arguments.dataflow.display());
        }
        let node = graph.nodes.iter().find(|node| reports_lifts(node)).with_context(|| {
            format!(
                "{}: no node reports the outcomes of lifts; expected a source with run: ${{SOURCE:-…}} and the input \
                 \"decision?\", as in the dataflow-live.yaml that 'blindgrasp init DIR' writes",
                arguments.dataflow.display()
            )
        })?;
        let mut overrides = arguments.overrides.clone();
        let mut judges = Vec::new();
        for judge in &graph.nodes {
            adjust(judge, &mut overrides);
            if has_own_limit(judge, &overrides) {
                judges.push(judge.id.clone());
            }
        }
        if let Some(set) = overrides.iter().find(|set| set.is_of(&node.id) && own_option(&set.param).is_some()) {
            bail!("--set {set}: use {} instead", own_option(&set.param).unwrap_or_default());
        }
        overrides.extend(course_params(arguments, &node.id));
        let mut model = text_param(&graph, "model").unwrap_or_default();
        if let Some(path) = &arguments.model {
            let path = path.to_str().context("--model: the path is not UTF-8")?;
            let judges = graph.nodes.iter().filter(|node| node.params.contains_key("model"));
            overrides.extend(judges.map(|node| set(&node.id, "model", path.into())));
            model = path.into();
        }
        let options = trial_options(arguments, node, &mut overrides)?;
        let hand = node.params.get("hand").and_then(|hand| hand.as_str()).unwrap_or(DEFAULT_HAND);
        let hand = Hand::load(Path::new(hand))?;
        let prior = approach_prior(arguments, node);
        let probe = match text_param(&graph, "probe").as_deref() {
            Some("squeeze") => Some(ProbeMove::Squeeze),
            Some("test_lift") => Some(ProbeMove::TestLift),
            _ => None,
        };
        // A hand is watched while it lifts if the model can, and nothing else was asked for.
        let is_auto = node.params.get("watch").and_then(|watch| watch.as_str()) == Some("auto");
        if probe == Some(ProbeMove::TestLift)
            && is_auto
            && Model::load(Path::new(&model)).is_ok_and(|model| model.can_watch())
        {
            overrides.push(set(&node.id, "watch", "on".into()));
        }
        let model = PathBuf::from(&model).file_name().map_or(model, |name| name.to_string_lossy().into_owned());
        Ok(Setup { node: node.id.clone(), judges, file, overrides, hand, options, model, prior, probe })
    }

    /// A digest of the params of all nodes, and of the files that they name: equal in all shards of a run.
    pub(super) fn graph_id(&self) -> anyhow::Result<u64> {
        Ok(self.graph(Way { obeys: true, name: "" })?.content_id(Some("shard"))?)
    }

    /// The checked graph of a way.
    pub(super) fn graph(&self, way: Way) -> anyhow::Result<Graph> {
        let mut overrides = self.overrides.clone();
        let text = if way.obeys { "on" } else { "off" };
        overrides.push(Override { node: Some(self.node.clone()), param: "gate".into(), text: text.into() });
        if !way.obeys {
            overrides.extend(self.judges.iter().map(|judge| set(judge, "max_gap_ms", NO_MAX_GAP_MS.into())));
        }
        fitting(&self.file, &overrides, Scope::Everything, OnMisfit::Refuse)
    }
}

fn set(node: &str, param: &str, text: String) -> Override {
    Override { node: Some(node.into()), param: param.into(), text }
}

fn reports_lifts(node: &Node) -> bool {
    node.outputs().iter().any(|output| output.type_name == LiftOutcome::TYPE_NAME)
}

/// Sets the params of a node that trials need otherwise than robots, unless the user gave them.
fn adjust(judge: &Node, overrides: &mut Vec<Override>) {
    let is_short = judge.params.get("max_age_ms").is_some_and(|age| age.as_f64() < Some(LEAST_MAX_AGE_MS));
    // Trials count the drops; a promise that is withdrawn would end them.
    let is_promised = judge.params.contains_key("promised_drops");
    for (is_unfit, param, text) in
        [(is_short, "max_age_ms", LEAST_MAX_AGE_MS.to_string()), (is_promised, "promised_drops", "1".into())]
    {
        if is_unfit && !overrides.iter().any(|set| set.is_of(&judge.id) && set.param == param) {
            overrides.push(set(&judge.id, param, text));
        }
    }
}

/// Whether a node limits gaps as its file says.
fn has_own_limit(judge: &Node, overrides: &[Override]) -> bool {
    let is_set = overrides.iter().any(|set| set.is_of(&judge.id) && set.param == "max_gap_ms");
    judge.params.contains_key("max_gap_ms") && !is_set
}

/// The options of the node that lifts, and the overrides that give it those of the command.
fn trial_options(arguments: &Arguments, node: &Node, overrides: &mut Vec<Override>) -> anyhow::Result<TrialOptions> {
    let mut options = match (&arguments.options, node.params.get("options").and_then(|path| path.as_str())) {
        (Some(path), _) => {
            let text = path.to_str().context("--options: the path is not UTF-8")?;
            overrides.push(set(&node.id, "options", text.into()));
            TrialOptions::load(path)?
        }
        (None, Some(path)) => TrialOptions::load(Path::new(path))?,
        (None, None) => TrialOptions::default(),
    };
    if let Some(engine) = arguments.physics {
        let engine_word = if engine == PhysicsEngine::Mujoco { "mujoco" } else { "rapier" };
        overrides.push(set(&node.id, "physics", engine_word.into()));
    }
    let own = node.params.get("physics").and_then(|engine| engine.as_str()).and_then(|word| physics(word).ok());
    options.physics.engine = arguments.physics.or(own).unwrap_or(options.physics.engine);
    Ok(options)
}

/// The prior with which the hand chooses its approaches. It may have a model of its own, or none.
fn approach_prior(arguments: &Arguments, node: &Node) -> Option<ApproachPrior> {
    let own = node.params.get("model")?.as_str()?;
    // The nodes refuse a model that cannot be read, and say why.
    Model::load(arguments.model.as_deref().unwrap_or(Path::new(own))).ok()?.approach
}

/// The command's option for a param of the node that lifts.
fn own_option(param: &str) -> Option<&'static str> {
    let options = [
        ("things", "--objects"),
        ("trials", "--trials"),
        ("attempts", "--attempts"),
        ("seed", "--seed"),
        ("shard", "--shard"),
        ("gate", "--lift-policy"),
    ];
    options.iter().find(|(own, _)| *own == param).map(|(_, option)| *option)
}

/// The first value of a param of that name in the graph.
fn text_param(graph: &Graph, param: &str) -> Option<String> {
    graph.nodes.iter().find_map(|node| Some(node.params.get(param)?.as_str()?.to_owned()))
}
