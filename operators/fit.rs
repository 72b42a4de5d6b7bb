//! Whether arbiter, model and hand of a graph fit together, and whether the keys of its nodes protect something, as far as params
//! and files tell before it starts. A graph that does not fit runs and holds every grasp, and nobody would know why.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use blindgrasp_graph::control::GraphStatus;
use blindgrasp_graph::dataflow::Graph;
use blindgrasp_graph::link::config::REVOKED_FILE;
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::Classifier;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::lift_arbiter::Probe;
use blindgrasp_stages::model::Model;
use serde_json::{Map, Value};

use super::connection::ConnectionParams;

/// A node, its operator, and where its samples come from.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    pub node: String,
    /// The name of a shipped operator; empty for a program of somebody's own.
    pub operator: String,
    pub params: Map<String, Value>,
    /// The nodes that its inputs read, by input.
    pub inputs: BTreeMap<String, String>,
}

/// The nodes of a graph.
pub fn parts_of(graph: &Graph) -> Vec<Part> {
    let part = |node: &blindgrasp_graph::dataflow::Node| Part {
        node: node.id.clone(),
        operator: shipped_operator(&node.args).into(),
        params: node.params.clone(),
        inputs: node.inputs.iter().map(|input| (input.port.clone(), input.from_node.clone())).collect(),
    };
    graph.nodes.iter().map(part).collect()
}

/// The nodes of a running graph.
pub fn running_parts(status: &GraphStatus) -> Vec<Part> {
    let inputs = |node: &str| {
        let edges = status.edges.iter().filter_map(|edge| {
            let (reader, port) = edge.to.split_once('/')?;
            let (writer, _) = edge.from.split_once('/')?;
            (reader == node).then(|| (port.to_owned(), writer.to_owned()))
        });
        edges.collect()
    };
    let part = |node: &blindgrasp_graph::control::NodeStatus| Part {
        node: node.node.clone(),
        operator: shipped_operator(&node.args).into(),
        params: node.params.clone(),
        inputs: inputs(&node.node),
    };
    status.nodes.iter().map(part).collect()
}

/// The name after `operator`, with which a program starts one that it ships.
fn shipped_operator(args: &[String]) -> &str {
    match args {
        [word, name, ..] if word == "operator" => name,
        _ => "",
    }
}

/// A reason for which nothing would be lifted, or something by the wrong measure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Misfit {
    pub kind: MisfitKind,
    pub node: String,
    pub message: String,
    /// What to do about it.
    pub help: String,
}

/// The part that does not fit the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MisfitKind {
    /// The arbiter's probe.
    Probe,
    /// The encoder's features.
    Features,
    Hand,
    /// The source: the model's label says nothing of its lifts.
    Label,
    /// The arbiter's probe again: the lifts have a weaker bound than they could have.
    Bound,
    /// The endpoints and keys of a node that speaks Zenoh.
    Network,
}

/// The outcome of the check.
#[derive(Debug, Default)]
pub struct Fit {
    /// With these nothing can be lifted.
    pub errors: Vec<Misfit>,
    pub warnings: Vec<Misfit>,
}

/// Compares each lift arbiter with the model, the hand and the source behind it. Files that cannot be read are left to the
/// operators, which say so; programs of somebody's own may do anything.
pub fn check_fit(parts: &[Part]) -> Fit {
    let mut check = Check { parts, models: BTreeMap::new(), fit: Fit::default() };
    for arbiter in parts.iter().filter(|part| part.operator == "lift_arbiter") {
        check.arbiter(arbiter);
    }
    parts.iter().for_each(|part| check.network(part));
    check.fit
}

struct Check<'a> {
    parts: &'a [Part],
    /// By path; `None` for a file that cannot be read.
    models: BTreeMap<PathBuf, Option<Rc<Model>>>,
    fit: Fit,
}

impl<'a> Check<'a> {
    fn arbiter(&mut self, arbiter: &'a Part) {
        let Some(classifier) = self.before(arbiter, "prediction", "classifier") else {
            return;
        };
        let Some(model) = self.model(classifier) else {
            return;
        };
        self.probe(arbiter, classifier, &model);
        let Some(encoder) = self.before(classifier, "feature", "encoder") else {
            return;
        };
        if let Some(other) = self.model(encoder)
            && other.dictionary_id() != model.dictionary_id()
        {
            self.refuse(
                MisfitKind::Features,
                classifier,
                format!("its model judges other features than node '{}' makes: nothing would be lifted", encoder.node),
                "give both the same model (params: {model: …} of the file, or --set model=…)".into(),
            );
        }
        let Some(contacts) = self.before(encoder, "contacts", "contacts") else {
            return;
        };
        self.hand(contacts, classifier, &model);
        let mut source = self.part_before(contacts, "tactile");
        while let Some(part) = source {
            self.hand(part, classifier, &model);
            if part.operator == "tactile_source" {
                if learned_from_wrench_space(&model) {
                    self.label(part, classifier);
                } else {
                    self.bound(arbiter, classifier, &model);
                }
            }
            source = if part.operator == "senses" { self.part_before(part, "tactile") } else { None };
        }
    }

    /// The probe that the arbiter asks for, and what the model can judge.
    fn probe(&mut self, arbiter: &Part, classifier: &Part, model: &Model) {
        let name = arbiter.params.get("probe").and_then(Value::as_str).unwrap_or("none");
        let Ok(probe) = serde_json::from_value::<Probe>(name.into()) else {
            return;
        };
        let (phase, judge) = match probe {
            Probe::None => ("settled", Some(&model.classifier)),
            Probe::Squeeze => ("squeezed", model.squeezed.as_ref().map(|probe| &probe.classifier)),
            Probe::TestLift => ("test_lifted", test_lifted(model)),
        };
        let of = format!("the model of node '{}' ({})", classifier.node, path_of(classifier, "model").display());
        let instead = probes_of(model);
        match judge {
            None => self.refuse(
                MisfitKind::Probe,
                arbiter,
                format!("probe is {name}, and {of} judges no {phase} grasps: nothing would be lifted"),
                format!("expected {instead}, or a model that was trained on lifts with that probe"),
            ),
            Some(judge) if judge.threshold_probability >= 1.0 => self.refuse(
                MisfitKind::Probe,
                arbiter,
                format!("probe is {name}, and {of} never calls {phase} grasps stable: nothing would be lifted"),
                format!("expected {instead}, or a model that lifts (blindgrasp learn)"),
            ),
            Some(_) => {}
        }
    }

    fn hand(&mut self, part: &Part, classifier: &Part, model: &Model) {
        if !part.params.contains_key("hand") {
            return;
        }
        let path = path_of(part, "hand");
        let Ok(hand) = Hand::load(&path) else {
            return;
        };
        if hand.id() != model.hand.id {
            self.refuse(
                MisfitKind::Hand,
                part,
                format!(
                    "its hand ({}) is not the one that the model of node '{}' was trained for, '{}': nothing would be lifted",
                    path.display(),
                    classifier.node,
                    model.hand.name
                ),
                "expected the same hand file, unchanged, or a model trained for this hand".into(),
            );
        }
    }

    /// A live hand may lift an object, which the paper's label says nothing of.
    fn label(&mut self, source: &Part, classifier: &Part) {
        self.fit.warnings.push(Misfit {
            kind: MisfitKind::Label,
            node: source.node.clone(),
            message: format!(
                "its hand is real, and the model of node '{}' ({}) learned the paper's label, which does not say whether \
                 a lifted object stays in the hand",
                classifier.node,
                path_of(classifier, "model").display()
            ),
            help: "expected a model that was trained on lifts (blindgrasp learn)".into(),
        });
    }

    /// Warns of a threshold of the arbiter below the model's own, if there is one.
    fn is_loosened(&mut self, arbiter: &Part, classifier: &Part, model: &Model, look: Phase) -> bool {
        let own = model.look(look).map(|of_look| of_look.threshold_probability);
        if let (Some(least), Some(own)) = (arbiter.params.get("min_probability_stable").and_then(Value::as_f64), own)
            && least > 0.0
            && least < own
        {
            let message = format!(
                "min_probability_stable is {least}, below the threshold of the model of node '{}', {own:.4}: the model's bound on \
                 drops does not hold",
                classifier.node
            );
            let help = "expected 0, which takes the model's own threshold".into();
            self.fit.warnings.push(Misfit { kind: MisfitKind::Bound, node: arbiter.node.clone(), message, help });
            return true;
        }
        false
    }

    /// A live hand with a promise that the model does not back, or without the test lift for which it promises fewer drops.
    fn bound(&mut self, arbiter: &Part, classifier: &Part, model: &Model) {
        let name = arbiter.params.get("probe").and_then(Value::as_str).unwrap_or("none");
        let best = if name == "test_lift" { None } else { most_drops(model, "test_lifted") };
        let look = match name {
            "squeeze" => Phase::Squeezed,
            "test_lift" => Phase::TestLifted,
            _ => Phase::Settled,
        };
        let own = most_drops(model, look.as_str());
        let number = |name: &str| arbiter.params.get(name).and_then(Value::as_f64);
        let promised = number("promised_drops");
        if self.is_loosened(arbiter, classifier, model, look) {
            return;
        }
        let is_weaker = best.is_some_and(|best| own.is_none_or(|own| own > best));
        let is_unbacked = promised.is_some_and(|promised| promised < own.unwrap_or(1.0));
        if !is_weaker && !is_unbacked {
            return;
        }
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let mut message = format!(
            "probe is {name}, and so the model of node '{}' ({}) {}",
            classifier.node,
            path_of(classifier, "model").display(),
            own.map_or("has no bound on drops".into(), |own| format!(
                "lets at most {} of the lifts drop",
                percent(own)
            ))
        );
        let mut remedies = Vec::new();
        if let Some(best) = best
            && is_weaker
        {
            message += &format!("; after a test lift, at most {} (95 % confidence)", percent(best));
            remedies.push("probe: test_lift, if the arm can lift by 10 mm and wait".into());
        }
        match own {
            None => remedies
                .push(format!("another model, because no promised_drops is backed by this one with probe: {name}")),
            Some(own) if promised.is_none_or(|promised| promised < own) => {
                remedies.push(format!("promised_drops of at least {:.2}", (100.0 * own).ceil() / 100.0));
            }
            Some(_) => {}
        }
        let help = format!("expected {}", remedies.join("; otherwise "));
        self.fit.warnings.push(Misfit { kind: MisfitKind::Bound, node: arbiter.node.clone(), message, help });
    }

    /// The endpoints and keys of a node that speaks Zenoh.
    fn network(&mut self, part: &Part) {
        let driver = part.params.get("driver").and_then(Value::as_str).unwrap_or_default();
        let speaks_zenoh = match part.operator.as_str() {
            "zenoh" => true,
            "tactile_source" => driver == "zenoh",
            _ => return,
        };
        if !speaks_zenoh {
            if part.params.contains_key("keys") {
                let message = format!("its keys protect nothing: the driver {driver} has no TLS");
                self.refuse(MisfitKind::Network, part, message, "leave out keys, or use the driver zenoh".into());
            }
            return;
        }
        let Ok(params) = serde_json::from_value::<ConnectionParams>(Value::Object(part.params.clone())) else {
            return;
        };
        if let Err(error) = params.network() {
            let help = "docs/ros2.md says what endpoints and keys a node can have".into();
            self.refuse(MisfitKind::Network, part, error.to_string(), help);
        } else if let Some(keys) = &params.keys
            && keys.join(REVOKED_FILE).exists()
        {
            self.fit.warnings.push(Misfit {
                kind: MisfitKind::Network,
                node: part.node.clone(),
                message: format!(
                    "{} is not read here: a revoked certificate whose name may take part still does",
                    keys.join(REVOKED_FILE).display()
                ),
                help: "take its name out of the param from, and start the node again".into(),
            });
        }
    }

    fn refuse(&mut self, kind: MisfitKind, part: &Part, message: String, help: String) {
        self.fit.errors.push(Misfit { kind, node: part.node.clone(), message, help });
    }

    /// The node that an input reads, if it runs this operator.
    fn before(&self, part: &Part, input: &str, operator: &str) -> Option<&'a Part> {
        self.part_before(part, input).filter(|before| before.operator == operator)
    }

    fn part_before(&self, part: &Part, input: &str) -> Option<&'a Part> {
        let node = part.inputs.get(input)?;
        self.parts.iter().find(|before| before.node == *node)
    }

    fn model(&mut self, part: &Part) -> Option<Rc<Model>> {
        let path = path_of(part, "model");
        let read = |path: &Path| Model::load(path).ok().map(Rc::new);
        self.models.entry(path.clone()).or_insert_with(|| read(&path)).clone()
    }
}

fn path_of(part: &Part, param: &str) -> PathBuf {
    part.params.get(param).and_then(Value::as_str).unwrap_or_default().into()
}

/// The share of the lifts that at most drop when a look decides, by training or by the robot's own lifts. Lifts that changed the
/// model have withdrawn the bound of its training; others count where they speak against it.
fn most_drops(model: &Model, look: &str) -> Option<f64> {
    let own_lifts = model.training.own_lifts.as_ref().filter(|own| own.look == look);
    let policy = model.training.policies.iter().find(|policy| policy.look == look);
    let own = own_lifts.and_then(|own| own.promise).map(|promise| promise.drops_of_lifts);
    let trained = policy.and_then(|policy| policy.promise).map(|promise| promise.drops_of_lifts);
    let refuting = own.filter(|own| trained.is_none_or(|trained| own.estimate > trained.at_most));
    Some(refuting.or(trained)?.at_most)
}

/// The judge of a test lift, which follows a squeeze that is judged as well.
fn test_lifted(model: &Model) -> Option<&Classifier> {
    model.squeezed.as_ref().and(model.test_lifted.as_ref()).map(|probe| &probe.classifier)
}

/// The values of `probe` with which grasps can be lifted by this model.
fn probes_of(model: &Model) -> String {
    let mut probes = Vec::new();
    if model.classifier.threshold_probability < 1.0 {
        probes.push("none");
    }
    let squeezed = model.squeezed.as_ref().map(|probe| &probe.classifier);
    for (name, judge) in [("squeeze", squeezed), ("test_lift", test_lifted(model))] {
        if judge.is_some_and(|judge| judge.threshold_probability < 1.0) {
            probes.push(name);
        }
    }
    if probes.is_empty() { "another model".into() } else { format!("probe: {}", probes.join(" or ")) }
}

/// Whether simulated grasps taught it, labelled by the wrench space. Models of the paper's label alone do not name it.
fn learned_from_wrench_space(model: &Model) -> bool {
    let training = &model.training;
    let is_simulated = training.made_by.iter().any(|made_by| made_by.starts_with("simulation of "));
    training.labels.contains_key(&Label::WrenchSpace) || (training.labels.is_empty() && is_simulated)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn project(path: &str) -> String {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the project");
        root.join(path).to_str().expect("UTF-8").into()
    }

    fn part(node: &str, params: &[(&str, &str)], inputs: &[(&str, &str)]) -> Part {
        Part {
            node: node.into(),
            operator: node.into(),
            params: params.iter().map(|(name, value)| (name.to_string(), Value::from(*value))).collect(),
            inputs: inputs.iter().map(|(port, from)| (port.to_string(), from.to_string())).collect(),
        }
    }

    /// The nodes of a gate behind a live hand.
    fn gate(hand: &str, model: &str, probe: &str) -> Vec<Part> {
        let (hand, model) = (project(hand), project(model));
        vec![
            part("tactile_source", &[("hand", &hand), ("driver", "listen")], &[]),
            part("contacts", &[("hand", &hand)], &[("tactile", "tactile_source")]),
            part("encoder", &[("model", &model)], &[("contacts", "contacts")]),
            part("classifier", &[("model", &model)], &[("feature", "encoder")]),
            part("lift_arbiter", &[("probe", probe)], &[("prediction", "classifier")]),
        ]
    }

    const HAND: &str = "hands/barrett-bh8-280.yaml";
    const LIFTS: &str = "models/barrett-bh8-280-lifts.json";
    const PAPER: &str = "models/barrett-bh8-280.json";

    fn only_error(parts: &[Part]) -> Misfit {
        let mut errors = check_fit(parts).errors;
        assert_eq!(errors.len(), 1, "{errors:?}");
        errors.remove(0)
    }

    #[test]
    fn graphs_that_can_lift_fit() {
        for probe in ["none", "squeeze", "test_lift"] {
            let fit = check_fit(&gate(HAND, LIFTS, probe));
            assert!(fit.errors.is_empty(), "{probe}: {fit:?}");
            let bounds: Vec<&str> = fit.warnings.iter().map(|misfit| misfit.message.as_str()).collect();
            let expected = match probe {
                "none" => vec!["lets at most 11.2 % of the lifts drop; after a test lift, at most 4.3 %"],
                "squeeze" => vec!["has no bound on drops; after a test lift, at most 4.3 %"],
                _ => Vec::new(),
            };
            assert_eq!(bounds.len(), expected.len(), "{bounds:?}");
            assert!(bounds.iter().zip(expected).all(|(bound, expected)| bound.contains(expected)), "{bounds:?}");
        }
        // Programs of somebody's own, and files that are not there.
        let mut own = gate(HAND, PAPER, "test_lift");
        own[3].operator = String::new();
        assert!(check_fit(&own).errors.is_empty());
        assert!(check_fit(&gate(HAND, "models/none.json", "test_lift")).errors.is_empty());
    }

    #[test]
    fn a_promise_that_the_look_in_use_does_not_keep_is_warned_of() {
        for (probe, promised, expected) in [
            ("test_lift", 0.1, None),
            ("test_lift", 0.03, Some("lets at most 4.3 % of the lifts drop: expected promised_drops of at least 0.05")),
            ("squeeze", 1.0, Some("otherwise another model, because no promised_drops is backed by this one")),
        ] {
            let mut parts = gate(HAND, LIFTS, probe);
            parts[4].params.insert("promised_drops".into(), promised.into());
            let warnings = check_fit(&parts).warnings;
            assert_eq!(warnings.len(), usize::from(expected.is_some()), "{probe}: {warnings:?}");
            for (Misfit { message, help, .. }, expected) in warnings.iter().zip(expected) {
                assert!(format!("{message}: {help}").contains(expected), "{message}: {help}");
            }
        }
        let mut parts = gate(HAND, LIFTS, "test_lift");
        parts[4].params.insert("min_probability_stable".into(), 0.3.into());
        let warnings = check_fit(&parts).warnings;
        assert!(warnings.len() == 1 && warnings[0].message.contains("is 0.3, below the threshold"), "{warnings:?}");
        // The graph of a live hand promises what its model does, in tenths of a percent.
        let model = Model::load(Path::new(&project(LIFTS))).expect("a model");
        let own = (1000.0 * most_drops(&model, "test_lifted").expect("a bound")).ceil() / 1000.0;
        let live = std::fs::read_to_string(project("dataflow-live.yaml")).expect("a file");
        assert!(live.contains(&format!("promised_drops: ${{PROMISED_DROPS:-{own}}}")), "{own}");
        // A model without a test lift.
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("settled.json");
        let mut model = model;
        model.test_lifted = None;
        model.training.policies.retain(|policy| policy.look == "settled");
        model.save(&path).expect("saved");
        let mut parts = gate(HAND, path.to_str().expect("UTF-8"), "none");
        assert!(check_fit(&parts).warnings.is_empty(), "nothing is promised");
        parts[4].params.insert("promised_drops".into(), 0.1.into());
        let warnings = check_fit(&parts).warnings;
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        assert_eq!(warnings[0].help, "expected promised_drops of at least 0.12");
    }

    #[test]
    fn a_probe_that_the_model_does_not_judge_is_refused() {
        for (probe, phase) in [("squeeze", "squeezed"), ("test_lift", "test_lifted")] {
            let Misfit { node, message, help, .. } = only_error(&gate(HAND, PAPER, probe));
            assert_eq!(node, "lift_arbiter");
            assert!(message.contains(&format!("judges no {phase} grasps: nothing would be lifted")), "{message}");
            assert!(help.starts_with("expected probe: none, or a model"), "{help}");
        }
    }

    #[test]
    fn a_model_that_never_says_stable_without_a_probe_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("careful.json");
        let mut model = Model::load(Path::new(&project(LIFTS))).expect("a model");
        model.classifier.threshold_probability = 1.0;
        model.save(&path).expect("saved");
        let path = path.to_str().expect("UTF-8");
        assert!(check_fit(&gate(HAND, path, "test_lift")).errors.is_empty());
        let Misfit { message, help, .. } = only_error(&gate(HAND, path, "none"));
        assert!(message.contains("never calls settled grasps stable"), "{message}");
        assert!(help.contains("probe: squeeze or test_lift"), "{help}");
    }

    #[test]
    fn another_hand_or_another_model_of_the_encoder_is_refused() {
        let errors = check_fit(&gate("hands/parallel-gripper.yaml", LIFTS, "test_lift")).errors;
        let nodes: Vec<&str> = errors.iter().map(|misfit| misfit.node.as_str()).collect();
        assert_eq!(nodes, ["contacts", "tactile_source"], "{errors:?}");
        let mut mixed = gate(HAND, LIFTS, "test_lift");
        mixed[2].params.insert("model".into(), project(PAPER).into());
        assert!(only_error(&mixed).message.contains("other features than node 'encoder'"));
    }

    #[test]
    fn the_papers_label_behind_a_live_hand_is_warned_of() {
        let mut parts = gate(HAND, PAPER, "none");
        let fit = check_fit(&parts);
        assert_eq!((fit.errors.len(), fit.warnings.len()), (0, 1), "{fit:?}");
        assert!(fit.warnings[0].message.contains("learned the paper's label"), "{fit:?}");
        parts[0].operator = "recorded_source".into();
        assert!(check_fit(&parts).warnings.is_empty());
    }

    #[test]
    fn keys_that_protect_nothing_are_refused_and_a_list_of_revoked_certificates_is_warned_of() {
        let fit = |operator: &str, params: &[(&str, &str)]| check_fit(&[part(operator, params, &[])]);
        for (operator, params) in [
            ("zenoh", &[("keys", "/k")][..]),
            ("zenoh", &[("keys", "/k"), ("listen", "tcp/127.0.0.1:1")]),
            ("tactile_source", &[("driver", "zenoh"), ("keys", "/k"), ("connect", "tcp/127.0.0.1:1")]),
            ("tactile_source", &[("driver", "listen"), ("keys", "/k")]),
        ] {
            let errors = fit(operator, params).errors;
            assert!(errors.len() == 1 && errors[0].kind == MisfitKind::Network, "{operator}: {errors:?}");
        }
        let folder = tempfile::tempdir().expect("a folder");
        let keys = folder.path().to_str().expect("UTF-8");
        let params = [("keys", keys), ("listen", "tls/127.0.0.1:1")];
        assert!(fit("zenoh", &params).errors.is_empty() && fit("zenoh", &params).warnings.is_empty());
        std::fs::write(folder.path().join("crl.pem"), "").expect("written");
        assert_eq!(fit("zenoh", &params).warnings.len(), 1);
    }
}
