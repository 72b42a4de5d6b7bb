//! The source, the stages and the lift arbiter as tasks of Copper, and what travels between them.
//!
//! The payloads have the fields of blindgrasp's messages that the stages use, and keep their memory from frame to frame.
//! Keyframes hold no state of the tasks, which makes them cheaper for Copper.

use std::sync::{Mutex, OnceLock};
use std::time::Instant;

use bincode::{Decode, Encode};
use blindgrasp_messages::{Contact, Fault, Header, LiftDecision, Phase, Prediction, Stamped, TactileFrame};
use blindgrasp_stages::contacts::ContactFinder;
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp_stages::{Hand, Model};
use cu29::prelude::*;
use serde::{Deserialize, Serialize};

/// A simulated grasp's frames, and the time between two of them: 100 Hz.
pub const N_GRASP_FRAMES: u64 = 14;
const FRAME_NANOS: u64 = 10_000_000;
const EMPTY: &str = "a message is empty: the task before it must fill it";

/// What the tasks work with. `main` sets it, because Copper makes the tasks.
pub static SETUP: OnceLock<Setup> = OnceLock::new();
/// For each frame that brought a decision, the nanoseconds from its stamp by the source to the decision.
pub static LATENCIES_NANOS: Mutex<Vec<u64>> = Mutex::new(Vec::new());

pub struct Setup {
    pub frames: Vec<Stamped<TactileFrame>>,
    pub hand: Hand,
    pub model: Model,
    /// The stamps for the latency count from here.
    pub begin: Instant,
}

/// What all stages pass on.
#[derive(Default, Debug, Clone, Copy, Encode, Decode, Serialize, Deserialize, Reflect)]
pub struct Head {
    #[bincode(with_serde)]
    header: Header,
    grasp_id: u64,
    #[bincode(with_serde)]
    phase: Phase,
    #[bincode(with_serde)]
    fault: Fault,
}

#[derive(Default, Debug, Clone, Encode, Decode, Serialize, Deserialize, Reflect)]
pub struct FramePayload {
    head: Head,
    joints: Vec<f64>,
    cells_newtons: Vec<f64>,
}

#[derive(Default, Debug, Clone, Encode, Decode, Serialize, Deserialize, Reflect)]
pub struct ContactsPayload {
    head: Head,
    joints: Vec<f64>,
    #[bincode(with_serde)]
    contacts: Vec<Contact>,
}

#[derive(Default, Debug, Clone, Encode, Decode, Serialize, Deserialize, Reflect)]
pub struct FeaturePayload {
    head: Head,
    values: Vec<f64>,
}

#[derive(Default, Debug, Clone, Encode, Decode, Serialize, Deserialize, Reflect)]
pub struct PredictionPayload {
    #[bincode(with_serde)]
    header: Header,
    #[bincode(with_serde)]
    prediction: Prediction,
}

/// Sends the recording's frames over and over, each with the next number and time. `main` waits until a frame is due.
#[derive(Reflect)]
pub struct RecordedSource(&'static Setup, u64);
#[derive(Reflect)]
pub struct FindContacts(&'static Setup, ContactFinder);
#[derive(Reflect)]
pub struct EncodeFeature(&'static Setup);
#[derive(Reflect)]
pub struct Classify(&'static Setup);
#[derive(Reflect)]
pub struct DecideLift(&'static Setup, LiftArbiter, Vec<LiftDecision>);

impl Freezable for RecordedSource {}
impl Freezable for FindContacts {}
impl Freezable for EncodeFeature {}
impl Freezable for Classify {}
impl Freezable for DecideLift {}

impl CuSrcTask for RecordedSource {
    type Resources<'r> = ();
    type Output<'m> = output_msg!(FramePayload);
    fn new(_config: Option<&ComponentConfig>, _resources: Self::Resources<'_>) -> CuResult<Self> {
        Ok(RecordedSource(SETUP.wait(), 0))
    }

    fn process(&mut self, _ctx: &CuContext, output: &mut Self::Output<'_>) -> CuResult<()> {
        let RecordedSource(setup, seq) = self;
        let origin_nanos = setup.begin.elapsed().as_nanos() as u64;
        let recorded = &setup.frames[(*seq % setup.frames.len() as u64) as usize];
        let header = Header { seq: *seq, stamp_nanos: *seq * FRAME_NANOS, origin_nanos, ..recorded.header };
        let frame = output.payload_mut().get_or_insert_default();
        let TactileFrame { phase, joints, cells_newtons, .. } = &recorded.message;
        frame.head = Head { header, grasp_id: *seq / N_GRASP_FRAMES, phase: *phase, fault: Fault::None };
        frame.joints.clone_from(joints);
        frame.cells_newtons.clone_from(cells_newtons);
        *seq += 1;
        Ok(())
    }
}

impl CuTask for FindContacts {
    type Resources<'r> = ();
    type Input<'m> = input_msg!(FramePayload);
    type Output<'m> = output_msg!(ContactsPayload);
    fn new(_config: Option<&ComponentConfig>, _resources: Self::Resources<'_>) -> CuResult<Self> {
        Ok(FindContacts(SETUP.wait(), ContactFinder::default()))
    }

    fn process(&mut self, _ctx: &CuContext, input: &Self::Input<'_>, output: &mut Self::Output<'_>) -> CuResult<()> {
        let FindContacts(setup, finder) = self;
        let FramePayload { head, joints, cells_newtons } = input.payload().ok_or(EMPTY)?;
        let found = output.payload_mut().get_or_insert_default();
        let summary = finder.find(&setup.hand, head.header.hand_id, joints, cells_newtons, &mut found.contacts);
        found.head = Head { fault: summary.fault, ..*head };
        found.joints.clone_from(joints);
        Ok(())
    }
}

impl CuTask for EncodeFeature {
    type Resources<'r> = ();
    type Input<'m> = input_msg!(ContactsPayload);
    type Output<'m> = output_msg!(FeaturePayload);
    fn new(_config: Option<&ComponentConfig>, _resources: Self::Resources<'_>) -> CuResult<Self> {
        Ok(EncodeFeature(SETUP.wait()))
    }

    fn process(&mut self, _ctx: &CuContext, input: &Self::Input<'_>, output: &mut Self::Output<'_>) -> CuResult<()> {
        let ContactsPayload { head, joints, contacts } = input.payload().ok_or(EMPTY)?;
        let feature = output.payload_mut().get_or_insert_default();
        feature.values.clear();
        let outcome = match head.fault {
            Fault::None => self.0.model.extract(head.phase, &FeltReading::new(joints, contacts), &mut feature.values),
            fault => Err(fault),
        };
        feature.head = Head { fault: outcome.err().unwrap_or_default(), ..*head };
        Ok(())
    }
}

impl CuTask for Classify {
    type Resources<'r> = ();
    type Input<'m> = input_msg!(FeaturePayload);
    type Output<'m> = output_msg!(PredictionPayload);
    fn new(_config: Option<&ComponentConfig>, _resources: Self::Resources<'_>) -> CuResult<Self> {
        Ok(Classify(SETUP.wait()))
    }

    fn process(&mut self, _ctx: &CuContext, input: &Self::Input<'_>, output: &mut Self::Output<'_>) -> CuResult<()> {
        let FeaturePayload { head, values } = input.payload().ok_or(EMPTY)?;
        let verdict = match head.fault {
            Fault::None => self.0.model.classifier.classify(values),
            fault => Err(fault),
        };
        let prediction = Prediction {
            grasp_id: head.grasp_id,
            phase: head.phase,
            decision_value: verdict.map_or(0.0, |verdict| verdict.decision_value),
            probability_stable: verdict.map_or(0.0, |verdict| verdict.probability_stable),
            stable: verdict.is_ok_and(|verdict| verdict.stable),
            unsure: verdict.is_ok_and(|verdict| verdict.unsure),
            fault: verdict.err().unwrap_or_default(),
        };
        output.set_payload(PredictionPayload { header: head.header, prediction });
        Ok(())
    }
}

impl CuSinkTask for DecideLift {
    type Resources<'r> = ();
    type Input<'m> = input_msg!(PredictionPayload);
    fn new(_config: Option<&ComponentConfig>, _resources: Self::Resources<'_>) -> CuResult<Self> {
        Ok(DecideLift(SETUP.wait(), LiftArbiter::new(ArbiterOptions::default()), Vec::new()))
    }

    fn process(&mut self, _ctx: &CuContext, input: &Self::Input<'_>) -> CuResult<()> {
        let DecideLift(setup, arbiter, decided) = self;
        let PredictionPayload { header, prediction } = input.payload().ok_or(EMPTY)?;
        let age_nanos = || setup.begin.elapsed().as_nanos() as u64 - header.origin_nanos;
        arbiter.on_prediction(header, prediction, age_nanos(), decided);
        if !decided.is_empty() {
            LATENCIES_NANOS.lock().map_err(|_| "the latencies are lost")?.push(age_nanos());
            decided.clear();
        }
        Ok(())
    }
}
