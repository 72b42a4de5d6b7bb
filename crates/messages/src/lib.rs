//! The samples that travel along the graph's edges.
//!
//! Each message has two shapes of one content. In shared memory it is a fixed-size `…Head` (`repr(C)`, iceoryx2's user
//! header, beginning with [`Header`]) and a slice of [`Message::Item`]s (the payload), so that memory is taken for the
//! hand at hand and not for the largest one. Elsewhere it is an owned struct, which recordings (CDR) and JSON use.
//!
//! A message in shared memory may come from a process that nobody here wrote, so nothing in a head can be invalid as
//! such: enums travel as integer codes, and [`Message::from_parts`] checks them and every length.

use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

pub mod files;
#[cfg(test)]
mod layout;
mod regrasp;

pub use regrasp::{MAX_PROPOSALS, RegraspAdvice, RegraspAdviceHead, RegraspProposal};

/// The most joints that a message carries.
pub const MAX_JOINTS: usize = 32;
/// The most pads that a message carries.
pub const MAX_PADS: usize = 32;
/// The most tactile cells that a message carries.
pub const MAX_CELLS: usize = 1024;
/// The longest histogram that a message carries.
pub const MAX_FEATURES: usize = 4096;
/// The longest name in a [`GraspTruth`] or a [`LiftOutcome`], bytes of UTF-8.
pub const MAX_NAME_BYTES: usize = 64;

/// On each sample: which one it is and where it comes from.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ZeroCopySend)]
#[type_name("blindgrasp/Header/1")]
pub struct Header {
    /// Counts the samples of the source, from 0, without gaps; a stage answers each input with one output of its number.
    pub seq: u64,
    /// When the source took the sample: nanoseconds of the source's own clock (recorded time in a replay).
    pub stamp_nanos: u64,
    /// Generation of the source: changes when it starts anew.
    pub epoch: u64,
    /// Identity of the hand (the `hand` module's `Hand::id`); 0 if the source doesn't know.
    pub hand_id: u64,
    /// When the source published the sample on this machine (CLOCK_MONOTONIC), for latencies only: it is no part of
    /// the data, recordings hold 0.
    #[serde(skip)]
    pub origin_nanos: u64,
}

/// What a recording can hold.
pub trait Recorded: Serialize + for<'de> Deserialize<'de> + Clone + std::fmt::Debug + Send + 'static {
    /// Identifies the type in `--describe` and in recordings.
    const TYPE_NAME: &'static str;
    /// The topic in recordings where a graph has one port of this type.
    const TOPIC: &'static str;

    /// Whether its lengths are such that it can travel: what comes from a recording may have any.
    ///
    /// # Errors
    /// A length that can't be.
    fn check(&self) -> Result<(), MessageError>;
}

/// What can travel along an edge.
pub trait Message: Recorded {
    /// The fixed-size part in shared memory.
    type Head: ZeroCopySend + Copy + Default + std::fmt::Debug;
    /// An element of the variable part in shared memory.
    type Item: ZeroCopySend + Copy + Default + std::fmt::Debug;

    /// The header in a head.
    fn header(head: &Self::Head) -> &Header;
    /// The message as it lies in shared memory.
    fn to_parts(&self, header: Header) -> (Self::Head, Vec<Self::Item>);
    /// The message from shared memory.
    ///
    /// # Errors
    /// A code or a length that can't be.
    fn from_parts(head: &Self::Head, items: &[Self::Item]) -> Result<Self, MessageError>;
}

/// The types of all messages here, as `--describe` says them. Those of operators of one's own may be others.
pub const MESSAGE_TYPES: [&str; 8] = [
    TactileFrame::TYPE_NAME,
    ContactSet::TYPE_NAME,
    GraspFeature::TYPE_NAME,
    Prediction::TYPE_NAME,
    LiftDecision::TYPE_NAME,
    GraspTruth::TYPE_NAME,
    LiftOutcome::TYPE_NAME,
    RegraspAdvice::TYPE_NAME,
];

/// A message and its header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stamped<M> {
    /// Which sample it is.
    pub header: Header,
    /// What it says.
    pub message: M,
}

/// Why a message from shared memory or from a recording can't be what it claims to be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// An enum's code.
    #[error("{field} has the unknown code {code}")]
    Code {
        /// The field.
        field: &'static str,
        /// The code found.
        code: u32,
    },
    /// A length.
    #[error("{field} has length {found}, expected {expected}")]
    Length {
        /// The field.
        field: &'static str,
        /// The length found.
        found: usize,
        /// What was expected.
        expected: String,
    },
    /// A name that is no UTF-8.
    #[error("{field} is not UTF-8")]
    Text {
        /// The field.
        field: &'static str,
    },
}

/// Declares an enum that travels as a `u32` code in shared memory and CDR, and as a snake_case word in JSON.
macro_rules! coded_enum {
    ($(#[$doc:meta])* $name:ident, $field:literal, { $($(#[$variant_doc:meta])* $variant:ident = $code:literal, $word:literal;)+ }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub enum $name { $($(#[$variant_doc])* $variant,)+ }

        impl $name {
            /// All there are.
            pub const ALL: &[$name] = &[$($name::$variant),+];

            /// The code in shared memory and in recordings.
            pub fn code(self) -> u32 { match self { $($name::$variant => $code,)+ } }
            /// The word in JSON.
            pub fn word(self) -> &'static str { match self { $($name::$variant => $word,)+ } }
            /// From a code.
            ///
            /// # Errors
            /// An unknown code.
            pub fn from_code(code: u32) -> Result<Self, MessageError> {
                match code { $($code => Ok($name::$variant),)+ _ => Err(MessageError::Code { field: $field, code }) }
            }
        }

        impl Serialize for $name {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                if serializer.is_human_readable() {
                    serializer.serialize_str(self.word())
                } else {
                    serializer.serialize_u32(self.code())
                }
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                use serde::de::Error;
                if deserializer.is_human_readable() {
                    match String::deserialize(deserializer)?.as_str() {
                        $($word => Ok($name::$variant),)+
                        other => Err(D::Error::unknown_variant(other, &[$($word),+])),
                    }
                } else {
                    $name::from_code(u32::deserialize(deserializer)?).map_err(D::Error::custom)
                }
            }
        }
    };
}

coded_enum! {
    /// Where in a grasp a frame was taken.
    Phase, "phase", {
        /// The fingers have not begun to close.
        #[default]
        Open = 0, "open";
        /// The fingers are closing.
        Closing = 1, "closing";
        /// Every finger is blocked or at its limit: the frames that decide.
        Settled = 2, "settled";
        /// The source has no more frames of this grasp: its last reading once more. What is not decided yet is held.
        Ended = 3, "ended";
    }
}

coded_enum! {
    /// Why a stage has nothing to say about a frame. It travels on to the arbiter, which holds.
    Fault, "fault", {
        /// Nothing is wrong.
        #[default]
        None = 0, "none";
        /// No cell is active: there is no feature (never a NaN).
        NoContact = 1, "no_contact";
        /// Not as many joints or cells as the hand has.
        WrongLength = 2, "wrong_length";
        /// A joint, a force or a feature is NaN, infinite or negative where it can't be.
        InvalidValue = 3, "invalid_value";
        /// The frame comes from another hand than the stage's hand or model.
        WrongHand = 4, "wrong_hand";
        /// Links of the hand touch each other, and the stage would not tell their contacts from the object's.
        SelfCollision = 5, "self_collision";
        /// A stage could not read its input message.
        Malformed = 6, "malformed";
        /// The feature was made with another dictionary than the model's.
        WrongModel = 7, "wrong_model";
        /// The grasp is unlike those that the model was trained on.
        OutOfDistribution = 8, "out_of_distribution";
    }
}

coded_enum! {
    /// What the arm should do.
    Action, "action", {
        /// Don't lift. What is decided when in doubt.
        #[default]
        Hold = 0, "hold";
        /// The grasp will hold: lift.
        Lift = 1, "lift";
        /// Don't lift, and grasp anew as the advice for this grasp says. To whoever knows no advice it is [`Action::Hold`].
        Regrasp = 2, "regrasp";
    }
}

impl Action {
    /// The word as people are shown it: `LIFT`.
    pub fn shown(self) -> &'static str {
        match self {
            Action::Hold => "HOLD",
            Action::Lift => "LIFT",
            Action::Regrasp => "REGRASP",
        }
    }
}

coded_enum! {
    /// Why the arbiter decided so.
    Reason, "reason", {
        /// Enough consecutive settled predictions agreed on stable. The only reason to lift.
        Stable = 0, "stable";
        /// Enough consecutive settled predictions agreed on unstable.
        Unstable = 1, "unstable";
        /// The grasp ended before enough consecutive settled predictions agreed.
        #[default]
        NoAgreement = 2, "no_agreement";
        /// The grasp ended, or the stream did, without a settled prediction.
        Missing = 3, "missing";
        /// A prediction was lost on the way (a gap in the sequence) or came twice or out of order.
        OutOfOrder = 4, "out_of_order";
        /// Predictions came too late, or too far apart.
        Stale = 5, "stale";
        /// No cell is active.
        NoContact = 6, "no_contact";
        /// A frame or a prediction was malformed, of wrong length, NaN or negative.
        Invalid = 7, "invalid";
        /// The fingers touch each other.
        SelfCollision = 8, "self_collision";
        /// Frame, hand and model don't belong together.
        WrongHand = 9, "wrong_hand";
        /// Feature and classifier come from different models.
        WrongModel = 10, "wrong_model";
        /// The grasp is unlike those that the model was trained on.
        OutOfDistribution = 11, "out_of_distribution";
        /// Enough consecutive settled predictions agreed that the model cannot tell.
        Unsure = 12, "unsure";
        /// The link to the machine that predicts was cut off while a grasp was open.
        LinkDown = 13, "link_down";
    }
}

/// What the tactile source sends: one reading of all joints and cells.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TactileFrame {
    /// Which grasp.
    pub grasp_id: u64,
    /// Where in the grasp.
    pub phase: Phase,
    /// Joint angles in the hand's order, radians.
    #[serde(deserialize_with = "any_list")]
    pub joints_rad: Vec<f64>,
    /// Force on each cell, pad after pad in the hand's order, newtons; or what the hand's cells read, if its layout says
    /// that it is another unit.
    #[serde(deserialize_with = "any_list")]
    pub cells_newtons: Vec<f64>,
}

/// [`TactileFrame`] in shared memory; its items are the joint angles, then the cells' forces.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/TactileFrameHead/2")]
pub struct TactileFrameHead {
    /// Which sample it is.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// [`Phase::code`].
    pub phase: u32,
    /// How many of the items are joints.
    pub n_joints: u32,
}

/// One active cell.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, ZeroCopySend)]
#[type_name("blindgrasp/Contact/1")]
pub struct Contact {
    /// The cell's centre in the palm frame, metres.
    pub position_m: [f64; 3],
    /// The pad's outward normal there, in the palm frame.
    pub normal: [f64; 3],
    /// The force on the cell.
    pub force_newtons: f64,
    /// Index of the pad.
    pub pad: u32,
    /// Index of the cell on its pad.
    pub cell: u32,
}

/// A frame's contacts: its active cells in the palm frame (Dang & Allen, Eq. 1).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ContactSet {
    /// Which grasp.
    pub grasp_id: u64,
    /// Where in the grasp.
    pub phase: Phase,
    /// Joint angles in the hand's order, radians, as the frame has them.
    #[serde(deserialize_with = "any_list")]
    pub joints_rad: Vec<f64>,
    /// The active cells, in the order of the hand's cells.
    #[serde(deserialize_with = "any_list")]
    pub contacts: Vec<Contact>,
    /// How many pads have at least one contact.
    pub n_pads_in_contact: u32,
    /// Whether links of the hand touch each other in this posture.
    pub self_collision: bool,
    /// How many active cells were left out because they feel another link of the hand.
    pub n_self_contacts: u32,
    /// Why there is nothing to go by.
    pub fault: Fault,
}

/// [`ContactSet`] in shared memory; its items are the contacts.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/ContactSetHead/4")]
pub struct ContactSetHead {
    /// Which sample it is.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// [`Phase::code`].
    pub phase: u32,
    /// How many pads have at least one contact.
    pub n_pads_in_contact: u32,
    /// 1 if links of the hand touch each other, else 0.
    pub self_collision: u32,
    /// How many active cells were left out because they feel another link of the hand.
    pub n_self_contacts: u32,
    /// [`Fault::code`].
    pub fault: u32,
    /// How many joints the hand has.
    pub n_joints: u32,
    /// Their angles, radians; 0 beyond the last.
    pub joints_rad: [f64; MAX_JOINTS],
}

/// A frame's feature: the paper's histogram over the dictionary (Eq. 2-4), and whatever else the model's recipe asks for.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct GraspFeature {
    /// Which grasp.
    pub grasp_id: u64,
    /// Where in the grasp.
    pub phase: Phase,
    /// The values, in the order of the model's feature blocks; empty where there is no feature.
    #[serde(deserialize_with = "any_list")]
    pub values: Vec<f64>,
    /// How many pads have at least one contact.
    pub n_pads_in_contact: u32,
    /// Identity of what made it: hand, dictionary, σ, blocks (the `model` module's `Model::dictionary_id`).
    #[serde(with = "hex_id")]
    pub dictionary_id: u64,
    /// Why there is nothing to go by.
    pub fault: Fault,
}

/// [`GraspFeature`] in shared memory; its items are the values.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/GraspFeatureHead/2")]
pub struct GraspFeatureHead {
    /// Which sample it is.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// Identity of the dictionary and σ that made it.
    pub dictionary_id: u64,
    /// [`Phase::code`].
    pub phase: u32,
    /// How many pads have at least one contact.
    pub n_pads_in_contact: u32,
    /// [`Fault::code`].
    pub fault: u32,
    /// Always 0.
    pub reserved: u32,
}

/// What the classifier says of a frame.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Prediction {
    /// Which grasp.
    pub grasp_id: u64,
    /// Where in the grasp.
    pub phase: Phase,
    /// The machine's decision value, > 0 on the stable side; 0 where there is no feature.
    pub decision_value: f64,
    /// Calibrated probability that the grasp is stable; 0 where there is no feature.
    pub probability_stable: f64,
    /// Whether the probability reaches the model's threshold; false where there is no feature.
    pub stable: bool,
    /// Whether the probability is neither high enough for stable nor low enough for unstable.
    pub unsure: bool,
    /// Why there is nothing to go by.
    pub fault: Fault,
}

/// [`Prediction`] in shared memory, without items.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/PredictionHead/3")]
pub struct PredictionHead {
    /// Which sample it is.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// The machine's decision value.
    pub decision_value: f64,
    /// Calibrated probability.
    pub probability_stable: f64,
    /// [`Phase::code`].
    pub phase: u32,
    /// 1 or 0.
    pub stable: u32,
    /// [`Fault::code`].
    pub fault: u32,
    /// 1 or 0.
    pub unsure: u32,
}

/// The arbiter's decision, one per grasp.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LiftDecision {
    /// Which grasp.
    pub grasp_id: u64,
    /// What the arm should do.
    pub action: Action,
    /// Why.
    pub reason: Reason,
    /// The lowest probability among the predictions that decided; 0 where none did.
    pub probability_stable: f64,
}

/// [`LiftDecision`] in shared memory, without items.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/LiftDecisionHead/2")]
pub struct LiftDecisionHead {
    /// Which sample it is: the sequence counts decisions.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// The lowest probability among the predictions that decided.
    pub probability_stable: f64,
    /// [`Action::code`].
    pub action: u32,
    /// [`Reason::code`].
    pub reason: u32,
}

/// What a simulated or labelled grasp really was.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct GraspTruth {
    /// Which grasp.
    pub grasp_id: u64,
    /// Epsilon quality: the least wrench that breaks the grasp; -1 without force closure, NaN where nobody computed it.
    pub epsilon: f64,
    /// Volume quality: 6-D volume of the L1 grasp wrench space; NaN where nobody computed it.
    pub volume: f64,
    /// Whether both exceed their thresholds; of a grasp that was lifted, whether it held.
    pub stable: bool,
    /// The object's name.
    pub object: String,
    /// The object's class.
    pub class: String,
}

/// [`GraspTruth`] in shared memory; its items are the UTF-8 bytes of the object's name, then of the class.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/GraspTruthHead/1")]
pub struct GraspTruthHead {
    /// Which sample it is: the sequence counts truths.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// Epsilon quality.
    pub epsilon: f64,
    /// Volume quality.
    pub volume: f64,
    /// 1 or 0.
    pub stable: u32,
    /// How many of the items are the object's name.
    pub n_object_bytes: u32,
}

/// What became of a grasp that a hand tried: whether it was lifted, and then whether the object stayed in the hand.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LiftOutcome {
    /// Which grasp.
    pub grasp_id: u64,
    /// Which trial, from 0.
    pub trial: u64,
    /// Which attempt of the trial, from 0.
    pub attempt: u32,
    /// Whether the hand lifted.
    pub lifted: bool,
    /// Whether the object was in the hand at the end; false if it was not lifted.
    pub held: bool,
    /// Whether `epsilon` and `volume` could be computed.
    pub has_quality: bool,
    /// Whether the attempt began as the advice for the grasp before it said, and not at random.
    pub advised: bool,
    /// How far the object's centre of mass moved in the hand since the lift began; of a dropped one, until it was lost; 0
    /// if it was not lifted.
    pub slip_m: f64,
    /// How far it turned in the hand.
    pub turn_rad: f64,
    /// Epsilon quality of the settled grasp; -1 without force closure.
    pub epsilon: f64,
    /// Volume quality of the settled grasp.
    pub volume: f64,
    /// The object's mass.
    pub mass_kg: f64,
    /// Coulomb friction of its surface on the hand.
    pub friction: f64,
    /// What was to be lifted.
    pub thing: String,
    /// What it belongs to in tables.
    pub group: String,
}

/// [`LiftOutcome`] in shared memory; its items are the UTF-8 bytes of the thing's name, then of the group.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("blindgrasp/LiftOutcomeHead/2")]
pub struct LiftOutcomeHead {
    /// Which sample it is: the sequence counts outcomes.
    pub header: Header,
    /// Which grasp.
    pub grasp_id: u64,
    /// Which trial.
    pub trial: u64,
    /// Metres.
    pub slip_m: f64,
    /// Radians.
    pub turn_rad: f64,
    /// Epsilon quality.
    pub epsilon: f64,
    /// Volume quality.
    pub volume: f64,
    /// Kilograms.
    pub mass_kg: f64,
    /// Coulomb friction.
    pub friction: f64,
    /// Which attempt of the trial.
    pub attempt: u32,
    /// 1 or 0.
    pub lifted: u32,
    /// 1 or 0.
    pub held: u32,
    /// 1 or 0.
    pub has_quality: u32,
    /// How many of the items are the thing's name.
    pub n_thing_bytes: u32,
    /// 1 or 0.
    pub advised: u32,
}

/// How a simulated grasp really came about: what no robot knows. Recorded beside the tactile frames, never sent.
///
/// Everything is in the palm frame. The contacts hold all that the grasp's quality depends on, so that it can be
/// computed anew, for another friction say, without simulating again.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct GraspScene {
    /// Which grasp.
    pub grasp_id: u64,
    /// Number of the candidate: with the simulation's seed, it identifies the grasp.
    pub candidate: u64,
    /// Where the origin of the object's frame is, metres.
    pub object_position_m: [f64; 3],
    /// How the object is turned: a unit quaternion x, y, z, w.
    pub object_rotation_xyzw: [f64; 4],
    /// The object's centre of mass, metres.
    pub centre_of_mass_m: [f64; 3],
    /// The largest distance of a point of the object from its centre of mass.
    pub max_radius_m: f64,
    /// The object's mass.
    pub mass_kg: f64,
    /// Coulomb friction of the contacts with the object.
    pub friction: f64,
    /// The settled joints, exactly; the frames hold what the encoders say.
    pub joints_rad: Vec<f64>,
    /// Whether links of the hand press on each other.
    pub self_collision: bool,
    /// All contacts, sensed or not, of links with the object and with each other.
    pub contacts: Vec<SceneContact>,
}

/// A contact of a [`GraspScene`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneContact {
    /// Index of the link among the hand's links.
    pub link: u32,
    /// Index of the other link where the hand touches itself; -1 for the object.
    pub other_link: i32,
    /// The point on the object's (the other link's) surface, metres.
    pub point_m: [f64; 3],
    /// Unit normal into the object: the direction in which the link pushes.
    pub inward_normal: [f64; 3],
    /// A unit tangent, from which a soft finger's edges are counted.
    pub tangent: [f64; 3],
    /// The load.
    pub force_newtons: f64,
    /// The part of the load that cells feel, along their normals.
    pub felt_newtons: f64,
    /// Torsional radius of the patch, metres.
    pub torsion_m: f64,
}

impl Recorded for GraspScene {
    const TYPE_NAME: &'static str = "blindgrasp/GraspScene/1";
    const TOPIC: &'static str = "/scene";

    fn check(&self) -> Result<(), MessageError> {
        at_most("joints_rad", self.joints_rad.len(), MAX_JOINTS)?;
        at_most("contacts", self.contacts.len(), MAX_CELLS)
    }
}

impl Recorded for TactileFrame {
    const TYPE_NAME: &'static str = "blindgrasp/TactileFrame/2";
    const TOPIC: &'static str = "/tactile";

    fn check(&self) -> Result<(), MessageError> {
        at_most("joints_rad", self.joints_rad.len(), MAX_JOINTS)?;
        at_most("cells_newtons", self.cells_newtons.len(), MAX_CELLS)
    }
}

impl Message for TactileFrame {
    type Head = TactileFrameHead;
    type Item = f64;

    fn header(head: &TactileFrameHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (TactileFrameHead, Vec<f64>) {
        let head = TactileFrameHead {
            header,
            grasp_id: self.grasp_id,
            phase: self.phase.code(),
            n_joints: self.joints_rad.len() as u32,
        };
        (head, self.joints_rad.iter().chain(&self.cells_newtons).copied().collect())
    }

    fn from_parts(head: &TactileFrameHead, items: &[f64]) -> Result<Self, MessageError> {
        let (joints_rad, cells_newtons) = head.split(items)?;
        Ok(TactileFrame {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints_rad: joints_rad.to_vec(),
            cells_newtons: cells_newtons.to_vec(),
        })
    }
}

impl TactileFrameHead {
    /// The joint angles and the cells' forces among the frame's items.
    ///
    /// # Errors
    /// More joints than items, or more of either than a hand can have.
    pub fn split<'a>(&self, items: &'a [f64]) -> Result<(&'a [f64], &'a [f64]), MessageError> {
        let n_joints = self.n_joints as usize;
        let length =
            |field, found, most: usize| MessageError::Length { field, found, expected: format!("0 to {most}") };
        if n_joints > MAX_JOINTS.min(items.len()) {
            return Err(length("joints_rad", n_joints, MAX_JOINTS.min(items.len())));
        }
        let (joints_rad, cells_newtons) = items.split_at(n_joints);
        if cells_newtons.len() > MAX_CELLS {
            return Err(length("cells_newtons", cells_newtons.len(), MAX_CELLS));
        }
        Ok((joints_rad, cells_newtons))
    }
}

impl Recorded for ContactSet {
    const TYPE_NAME: &'static str = "blindgrasp/ContactSet/4";
    const TOPIC: &'static str = "/contacts";

    fn check(&self) -> Result<(), MessageError> {
        at_most("joints_rad", self.joints_rad.len(), MAX_JOINTS)?;
        at_most("contacts", self.contacts.len(), MAX_CELLS)?;
        at_most("n_self_contacts", self.n_self_contacts as usize, MAX_CELLS)?;
        at_most("n_pads_in_contact", self.n_pads_in_contact as usize, MAX_PADS)
    }
}

impl Message for ContactSet {
    type Head = ContactSetHead;
    type Item = Contact;

    fn header(head: &ContactSetHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (ContactSetHead, Vec<Contact>) {
        let head = ContactSetHead {
            header,
            grasp_id: self.grasp_id,
            phase: self.phase.code(),
            n_pads_in_contact: self.n_pads_in_contact,
            self_collision: self.self_collision.into(),
            n_self_contacts: self.n_self_contacts,
            fault: self.fault.code(),
            n_joints: self.joints_rad.len() as u32,
            joints_rad: ContactSetHead::joints(&self.joints_rad),
        };
        (head, self.contacts.clone())
    }

    fn from_parts(head: &ContactSetHead, items: &[Contact]) -> Result<Self, MessageError> {
        let message = ContactSet {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints_rad: head.joints_rad()?.to_vec(),
            contacts: items.to_vec(),
            n_pads_in_contact: head.n_pads_in_contact,
            self_collision: flag("self_collision", head.self_collision)?,
            n_self_contacts: head.n_self_contacts,
            fault: Fault::from_code(head.fault)?,
        };
        message.check()?;
        Ok(message)
    }
}

impl ContactSetHead {
    /// Joint angles as a head holds them: at most [`MAX_JOINTS`].
    pub fn joints(joints_rad: &[f64]) -> [f64; MAX_JOINTS] {
        std::array::from_fn(|idx| joints_rad.get(idx).copied().unwrap_or_default())
    }

    /// The joint angles, radians.
    ///
    /// # Errors
    /// More joints than a hand can have.
    pub fn joints_rad(&self) -> Result<&[f64], MessageError> {
        let found = self.n_joints as usize;
        let expected = || format!("0 to {MAX_JOINTS}");
        self.joints_rad.get(..found).ok_or_else(|| MessageError::Length {
            field: "joints_rad",
            found,
            expected: expected(),
        })
    }
}

impl Recorded for GraspFeature {
    const TYPE_NAME: &'static str = "blindgrasp/GraspFeature/2";
    const TOPIC: &'static str = "/histogram";

    fn check(&self) -> Result<(), MessageError> {
        at_most("values", self.values.len(), MAX_FEATURES)?;
        at_most("n_pads_in_contact", self.n_pads_in_contact as usize, MAX_PADS)
    }
}

impl Message for GraspFeature {
    type Head = GraspFeatureHead;
    type Item = f64;

    fn header(head: &GraspFeatureHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (GraspFeatureHead, Vec<f64>) {
        let head = GraspFeatureHead {
            header,
            grasp_id: self.grasp_id,
            phase: self.phase.code(),
            n_pads_in_contact: self.n_pads_in_contact,
            dictionary_id: self.dictionary_id,
            fault: self.fault.code(),
            reserved: 0,
        };
        (head, self.values.clone())
    }

    fn from_parts(head: &GraspFeatureHead, items: &[f64]) -> Result<Self, MessageError> {
        let message = GraspFeature {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            values: items.to_vec(),
            n_pads_in_contact: head.n_pads_in_contact,
            dictionary_id: head.dictionary_id,
            fault: Fault::from_code(head.fault)?,
        };
        message.check()?;
        Ok(message)
    }
}

impl Recorded for Prediction {
    const TYPE_NAME: &'static str = "blindgrasp/Prediction/3";
    const TOPIC: &'static str = "/prediction";

    fn check(&self) -> Result<(), MessageError> {
        Ok(())
    }
}

impl Message for Prediction {
    type Head = PredictionHead;
    type Item = u8;

    fn header(head: &PredictionHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (PredictionHead, Vec<u8>) {
        let head = PredictionHead {
            header,
            grasp_id: self.grasp_id,
            decision_value: self.decision_value,
            probability_stable: self.probability_stable,
            phase: self.phase.code(),
            stable: self.stable.into(),
            fault: self.fault.code(),
            unsure: self.unsure.into(),
        };
        (head, Vec::new())
    }

    fn from_parts(head: &PredictionHead, _: &[u8]) -> Result<Self, MessageError> {
        Ok(Prediction {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            decision_value: head.decision_value,
            probability_stable: head.probability_stable,
            stable: flag("stable", head.stable)?,
            unsure: flag("unsure", head.unsure)?,
            fault: Fault::from_code(head.fault)?,
        })
    }
}

impl Recorded for LiftDecision {
    const TYPE_NAME: &'static str = "blindgrasp/LiftDecision/2";
    const TOPIC: &'static str = "/decision";

    fn check(&self) -> Result<(), MessageError> {
        Ok(())
    }
}

impl Message for LiftDecision {
    type Head = LiftDecisionHead;
    type Item = u8;

    fn header(head: &LiftDecisionHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (LiftDecisionHead, Vec<u8>) {
        let head = LiftDecisionHead {
            header,
            grasp_id: self.grasp_id,
            probability_stable: self.probability_stable,
            action: self.action.code(),
            reason: self.reason.code(),
        };
        (head, Vec::new())
    }

    fn from_parts(head: &LiftDecisionHead, _: &[u8]) -> Result<Self, MessageError> {
        Ok(LiftDecision {
            grasp_id: head.grasp_id,
            action: Action::from_code(head.action)?,
            reason: Reason::from_code(head.reason)?,
            probability_stable: head.probability_stable,
        })
    }
}

impl Recorded for GraspTruth {
    const TYPE_NAME: &'static str = "blindgrasp/GraspTruth/1";
    const TOPIC: &'static str = "/truth";

    fn check(&self) -> Result<(), MessageError> {
        at_most("object", self.object.len(), MAX_NAME_BYTES)?;
        at_most("class", self.class.len(), MAX_NAME_BYTES)
    }
}

impl Message for GraspTruth {
    type Head = GraspTruthHead;
    type Item = u8;

    fn header(head: &GraspTruthHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (GraspTruthHead, Vec<u8>) {
        let head = GraspTruthHead {
            header,
            grasp_id: self.grasp_id,
            epsilon: self.epsilon,
            volume: self.volume,
            stable: self.stable.into(),
            n_object_bytes: self.object.len() as u32,
        };
        (head, self.object.bytes().chain(self.class.bytes()).collect())
    }

    fn from_parts(head: &GraspTruthHead, items: &[u8]) -> Result<Self, MessageError> {
        let [object, class] = two_names(["object", "class"], head.n_object_bytes, items)?;
        Ok(GraspTruth {
            grasp_id: head.grasp_id,
            epsilon: head.epsilon,
            volume: head.volume,
            stable: flag("stable", head.stable)?,
            object,
            class,
        })
    }
}

impl Recorded for LiftOutcome {
    const TYPE_NAME: &'static str = "blindgrasp/LiftOutcome/2";
    const TOPIC: &'static str = "/outcome";

    fn check(&self) -> Result<(), MessageError> {
        at_most("thing", self.thing.len(), MAX_NAME_BYTES)?;
        at_most("group", self.group.len(), MAX_NAME_BYTES)
    }
}

impl Message for LiftOutcome {
    type Head = LiftOutcomeHead;
    type Item = u8;

    fn header(head: &LiftOutcomeHead) -> &Header {
        &head.header
    }

    fn to_parts(&self, header: Header) -> (LiftOutcomeHead, Vec<u8>) {
        let head = LiftOutcomeHead {
            header,
            grasp_id: self.grasp_id,
            trial: self.trial,
            slip_m: self.slip_m,
            turn_rad: self.turn_rad,
            epsilon: self.epsilon,
            volume: self.volume,
            mass_kg: self.mass_kg,
            friction: self.friction,
            attempt: self.attempt,
            lifted: self.lifted.into(),
            held: self.held.into(),
            has_quality: self.has_quality.into(),
            n_thing_bytes: self.thing.len() as u32,
            advised: self.advised.into(),
        };
        (head, self.thing.bytes().chain(self.group.bytes()).collect())
    }

    fn from_parts(head: &LiftOutcomeHead, items: &[u8]) -> Result<Self, MessageError> {
        let [thing, group] = two_names(["thing", "group"], head.n_thing_bytes, items)?;
        Ok(LiftOutcome {
            grasp_id: head.grasp_id,
            trial: head.trial,
            attempt: head.attempt,
            lifted: flag("lifted", head.lifted)?,
            held: flag("held", head.held)?,
            has_quality: flag("has_quality", head.has_quality)?,
            advised: flag("advised", head.advised)?,
            slip_m: head.slip_m,
            turn_rad: head.turn_rad,
            epsilon: head.epsilon,
            volume: head.volume,
            mass_kg: head.mass_kg,
            friction: head.friction,
            thing,
            group,
        })
    }
}

/// Two names that lie one behind the other.
fn two_names(fields: [&'static str; 2], n_first: u32, items: &[u8]) -> Result<[String; 2], MessageError> {
    let n_first = n_first as usize;
    at_most(fields[0], n_first, MAX_NAME_BYTES.min(items.len()))?;
    let (first, second) = items.split_at(n_first);
    at_most(fields[1], second.len(), MAX_NAME_BYTES)?;
    let text = |field, bytes: &[u8]| String::from_utf8(bytes.to_vec()).map_err(|_| MessageError::Text { field });
    Ok([text(fields[0], first)?, text(fields[1], second)?])
}

/// Identities as 16 hex digits in JSON, whose readers in other languages would round a 64-bit number.
pub mod hex_id {
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    pub fn serialize<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            format!("{id:016x}").serialize(serializer)
        } else {
            id.serialize(serializer)
        }
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
        if !deserializer.is_human_readable() {
            return u64::deserialize(deserializer);
        }
        let text = String::deserialize(deserializer)?;
        u64::from_str_radix(&text, 16).map_err(|_| D::Error::custom(format!("'{text}' is not 16 hex digits")))
    }
}

/// A list whose claimed length takes no memory before its items are there: the bytes may come from anybody.
///
/// # Errors
/// More than `most` items, or what the deserializer says.
pub fn read_list<'de, D, T>(deserializer: D, most: usize) -> Result<Vec<T>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    use serde::de::{Error as _, SeqAccess, Visitor};

    /// No list that can travel is longer.
    const MAX_RESERVED_BYTES: usize = 64 << 10;

    struct List<T>(usize, std::marker::PhantomData<T>);

    impl<'de, T: Deserialize<'de>> Visitor<'de> for List<T> {
        type Value = Vec<T>;

        fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            f.write_str("a list")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Vec<T>, A::Error> {
            let most_reserved = MAX_RESERVED_BYTES / size_of::<T>().max(1);
            let mut list = Vec::with_capacity(items.size_hint().unwrap_or(0).min(most_reserved).min(self.0));
            while let Some(item) = items.next_element()? {
                if list.len() == self.0 {
                    return Err(A::Error::custom(format!("a list of more than {} items", self.0)));
                }
                list.push(item);
            }
            Ok(list)
        }
    }

    deserializer.deserialize_seq(List(most, std::marker::PhantomData))
}

/// [`Recorded::check`] says afterwards what is too long, by the field's name.
fn any_list<'de, D, T>(deserializer: D) -> Result<Vec<T>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    read_list(deserializer, usize::MAX)
}

fn at_most(field: &'static str, found: usize, most: usize) -> Result<(), MessageError> {
    if found > most {
        return Err(MessageError::Length { field, found, expected: format!("0 to {most}") });
    }
    Ok(())
}

fn flag(field: &'static str, code: u32) -> Result<bool, MessageError> {
    match code {
        0 => Ok(false),
        1 => Ok(true),
        _ => Err(MessageError::Code { field, code }),
    }
}
