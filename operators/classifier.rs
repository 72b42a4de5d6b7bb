//! From the feature to a calibrated probability.

use std::collections::BTreeMap;
use std::path::PathBuf;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Phase, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, Stage, decode_state, encode_state};
use blindgrasp_stages::model::{Memory, Model};
use blindgrasp_stages::own_lifts::{Adapt, OwnLifts};
use blindgrasp_stages::steps;
use serde::Deserialize;
use serde_json::{Map, Value};

use crate::beginning::FileNode;

/// The shortest pause between two lines of the log about grasps: a recording may be played fast.
const LOG_PAUSE_NANOS: u64 = 1_000_000_000;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
    adapt: Adapt,
}

pub(crate) fn describe() -> OperatorDescription {
    OperatorDescription::new("classifier", "Predicts from each frame's feature whether the grasp is stable")
        .answers_each()
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .param(
            "model",
            ParamKind::Path { must_exist: true },
            None,
            "The model file. It says what is judged: settled grasps, and with a memory of earlier frames also probes, and grasps \
             by the earlier ones of their day",
        )
        .live_param(
            "adapt",
            ParamKind::Choice { values: ["off", "on", "frozen"].map(String::from).into() },
            Some("off".into()),
            "Whether the outcomes of lifts (frames of the phases kept and dropped) correct the probabilities of the look that decided: \
             off keeps them and judges as the model does, on corrects after each one, frozen takes no more",
        )
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    let params: Params = parse_params(&node.params)?;
    Model::load(&params.model)?;
    Ok(())
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let classify = Classify {
        operator: operator.clone(),
        has_state: model.has_memory() || params.adapt != Adapt::Off,
        value_names: model.value_names(),
        model,
        dictionary_id,
        memory: Memory::new(params.adapt),
        adapt: params.adapt,
        reported: None,
        told: None,
    };
    stage::run(operator, "feature", "prediction", 0, identity, classify)
}

struct Classify {
    operator: Operator,
    /// It is fixed at the start, because the instance after this one reads the state.
    has_state: bool,
    model: Model,
    /// Those of a feature's values.
    value_names: Vec<String>,
    dictionary_id: u64,
    /// Earlier frames of the open grasp, or of the day. It stays empty if the model judges each frame alone.
    memory: Memory,
    adapt: Adapt,
    /// Kept and dropped lifts, and changes of the readings, in the node's status; `None` if the launcher does not know them.
    reported: Option<[u64; 3]>,
    /// The last grasp of which the log says what speaks against it, and when it did.
    told: Option<(u64, u64)>,
}

impl Stage for Classify {
    type In = GraspFeature;
    type Out = Prediction;

    fn has_state(&self) -> bool {
        self.has_state
    }

    fn answer(&mut self, head: &GraspFeatureHead, values: &[f64], now_nanos: u64, answers: &mut Answers<Prediction>) {
        let prediction = steps::classify(&self.model, self.dictionary_id, &mut self.memory, head, values);
        self.explain(&prediction, values, now_nanos);
        answers.push(prediction);
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state("classifier", (self.dictionary_id, &self.model.checksum, &self.memory), bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        self.memory = Memory::default();
        let mut is_of_this_model = false;
        if let Some(bytes) = state {
            let (dictionary_id, checksum, memory): (u64, String, Memory) = decode_state("classifier", bytes)?;
            // Features of another model say nothing to this one.
            if dictionary_id == self.dictionary_id {
                self.memory = memory;
            }
            is_of_this_model = checksum == self.model.checksum;
            // Another model has other log-odds.
            if !is_of_this_model {
                self.memory.lifts = OwnLifts::default();
            }
        }
        self.memory.adapt = self.adapt;
        self.reported = None;
        self.report();
        Ok(is_of_this_model)
    }

    fn has_missed_samples(&mut self) {
        self.memory.forget_grasp();
    }

    fn look(&mut self) {
        self.report();
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<()> {
        let adapt = parse_params::<Params>(params)?.adapt;
        anyhow::ensure!(
            adapt == Adapt::Off || self.has_state,
            "adapt: this classifier has kept no outcomes, because its model judges each frame alone: swap it with \
             --set adapt={}",
            if adapt == Adapt::On { "on" } else { "frozen" }
        );
        (self.adapt, self.memory.adapt) = (adapt, adapt);
        Ok(())
    }
}

impl Classify {
    /// Says once a grasp what speaks most against it, if the model does not find the settled hand stable.
    fn explain(&mut self, prediction: &PredictionHead, values: &[f64], now_nanos: u64) {
        let PredictionHead { grasp_id, phase, stable, unsure, fault, .. } = *prediction;
        // A grasp of which the model is unsure may be probed.
        let is_against = stable == 0 && (unsure == 0 || !self.model.has_probes());
        let is_told = is_against && phase == Phase::Settled.code() && fault == Fault::None.code();
        let (told, at) = self.told.unwrap_or((u64::MAX, 0));
        if !is_told || told == grasp_id || now_nanos.saturating_sub(at) < LOG_PAUSE_NANOS {
            return;
        }
        self.told = Some((grasp_id, now_nanos));
        if let Some(against) = self.model.speak_against(&self.value_names, values) {
            let seems = if unsure == 0 { "seems unstable" } else { "may be unstable" };
            print_diagnostic(&format!("grasp {grasp_id} {seems}: {against}"));
        }
    }

    /// Counts the outcomes that it has learned from in the node's status.
    fn report(&mut self) {
        let lifts = &self.memory.lifts;
        let counts = [lifts.n_kept(), lifts.n_dropped(), lifts.n_changes()];
        if self.reported == Some(counts) {
            return;
        }
        if self.reported.is_some_and(|reported| counts[2] > reported[2]) && self.adapt == Adapt::On {
            tracing::warn!(
                "the hand's readings have changed (another skin, another gain): outcomes of lifts before are forgotten, and the \
                 model judges as it was trained until there are new ones"
            );
        }
        self.reported = Some(counts);
        let names = ["outcomes/kept", "outcomes/dropped", "outcomes/changes"].map(String::from);
        self.operator.has_counted_in_all(names.into_iter().zip(counts).collect::<BTreeMap<_, _>>());
    }
}
