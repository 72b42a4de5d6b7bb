//! Enums that travel as `u32` codes.

use serde::{Deserialize, Serialize};

use crate::MessageError;

/// A coded enum's name, the name of the fields that hold it, and its words with their codes.
pub struct Codes {
    pub name: &'static str,
    pub field: &'static str,
    pub words: Vec<(&'static str, u32)>,
}

/// Declares an enum that travels as a `u32` code in shared memory, CDR and between machines, and as a snake_case word
/// in JSON.
macro_rules! coded_enums {
    ($(
        $(#[$doc:meta])*
        $name:ident in $field:literal { $($(#[$variant_doc:meta])* $variant:ident = $code:literal, $word:literal;)+ }
    )+) => {
        $(
            $(#[$doc])*
            #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
            pub enum $name { $($(#[$variant_doc])* $variant,)+ }

            impl $name {
                /// All values, by code.
                pub const ALL: &[$name] = &[$($name::$variant),+];

                /// The code in shared memory and in recordings.
                pub fn code(self) -> u32 { match self { $($name::$variant => $code,)+ } }

                /// The word in JSON.
                pub fn as_str(self) -> &'static str { match self { $($name::$variant => $word,)+ } }

                /// From a code.
                ///
                /// # Errors
                /// An unknown code.
                pub fn from_code(code: u32) -> Result<Self, MessageError> {
                    match code { $($code => Ok($name::$variant),)+ _ => Err(MessageError::Code { field: $field, code }) }
                }

                fn codes() -> Codes {
                    Codes { name: stringify!($name), field: $field, words: vec![$(($word, $code)),+] }
                }
            }

            impl Serialize for $name {
                fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                    if serializer.is_human_readable() {
                        serializer.serialize_str(self.as_str())
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

            impl crate::ros::RosType for $name {
                fn ros_name() -> String { "uint32".into() }
                fn ros_comment() -> String { crate::ros::comment_of_codes(&$name::codes()) }
            }

            impl crate::declare::Raw<u32> for $name {
                fn to_raw(&self) -> u32 { self.code() }
                fn from_raw(_: &'static str, code: u32) -> Result<Self, MessageError> { $name::from_code(code) }
            }
        )+

        /// All coded enums of the messages.
        pub fn coded_enums() -> Vec<Codes> { vec![$($name::codes()),+] }
    };
}

/// The fault in plain words.
impl std::fmt::Display for Fault {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "no result for the frame: {}", self.as_str().replace('_', " "))
    }
}

impl std::error::Error for Fault {}

coded_enums! {
    /// Where in a grasp a frame was taken.
    Phase in "phase" {
        /// The fingers have not begun to close.
        #[default]
        Open = 0, "open";
        /// The fingers are closing.
        Closing = 1, "closing";
        /// Every finger is blocked or at its limit. These frames decide, unless a probe follows.
        Settled = 2, "settled";
        /// The source repeats its last reading and has no more frames of this grasp. An undecided grasp is held.
        Ended = 3, "ended";
        /// The fingers tighten to the force of a lift, because the arbiter asked for a probe.
        Squeezing = 4, "squeezing";
        /// The fingers are tight and the arm has not moved. These frames decide after the probe [`Action::Squeeze`].
        Squeezed = 5, "squeezed";
        /// The arm lifts by a few millimetres.
        TestLifting = 6, "test_lifting";
        /// The arm rests after the test lift. These frames decide after the probe [`Action::TestLift`].
        TestLifted = 7, "test_lifted";
        /// The arm has lifted, and the object was kept. The readings do not matter.
        Kept = 8, "kept";
        /// The arm has lifted, and the object was dropped. The readings do not matter.
        Dropped = 9, "dropped";
        /// The arm lifts the object, holds it or moves it, after [`Action::Lift`].
        Lifting = 10, "lifting";
    }

    /// Why a stage has no result for a frame. The fault travels on to the arbiter, which holds.
    Fault in "fault" {
        #[default]
        None = 0, "none";
        /// No cell is active, so there is no feature (never a NaN).
        NoContact = 1, "no_contact";
        /// The frame has another number of joints or cells than the hand.
        WrongLength = 2, "wrong_length";
        /// A joint, a force or a feature is NaN, infinite, or negative where that is impossible.
        InvalidValue = 3, "invalid_value";
        /// The frame comes from another hand than the stage's hand or model.
        WrongHand = 4, "wrong_hand";
        /// Links of the hand touch each other, and the stage cannot tell their contacts from the object's.
        SelfCollision = 5, "self_collision";
        /// A stage could not read its input message.
        Malformed = 6, "malformed";
        /// The feature was made by another model than the classifier's.
        WrongModel = 7, "wrong_model";
        /// The grasp is unlike the grasps that the model was trained on.
        OutOfDistribution = 8, "out_of_distribution";
        /// The model needs a sense that the frame does not have, or a reading of an earlier phase that did not come.
        MissingReading = 9, "missing_reading";
        /// The model judges a grasp by the earlier ones of its day, and there were too few of them.
        NoBaseline = 10, "no_baseline";
        /// The readings of this day are unlike those of the days that the model was trained on.
        UnlikeDay = 11, "unlike_day";
        /// Joints or cells of the hand do not work as they should.
        SensorFault = 12, "sensor_fault";
        /// Of the outcome of a lift: the hand's readings have changed, so outcomes before it say nothing of it.
        Changed = 13, "changed";
    }

    /// What the arm should do.
    Action in "action" {
        /// Do not lift: the decision in doubt.
        #[default]
        Hold = 0, "hold";
        /// The grasp will keep the object: lift.
        Lift = 1, "lift";
        /// Tighten to the force of a lift, do not move the arm, and send frames: the decision follows. A reader that
        /// cannot do this treats it as [`Action::Hold`].
        Squeeze = 3, "squeeze";
        /// Tighten to the force of a lift, lift by a few millimetres, rest, and send frames: the decision follows. A
        /// reader that cannot do this treats it as [`Action::Hold`].
        TestLift = 4, "test_lift";
        /// Tighten by a third of the way to the force of a lift, hold this force from now on, and go on lifting. The second and
        /// the third order in a lift ask for the other thirds. A hand without steps may take the whole way at the first one.
        Tighten = 5, "tighten";
        /// Stop lifting, and set the object down: most of the load on the fingers is gone.
        SetDown = 6, "set_down";
        /// Go on lifting: the answer to a source that asks while it lifts, by a frame of [`Phase::Ended`].
        GoOn = 7, "go_on";
    }

    /// Why the arbiter decided so.
    Reason in "reason" {
        /// Enough consecutive settled predictions agreed on stable. The only reason to lift.
        Stable = 0, "stable";
        /// Enough consecutive settled predictions agreed on unstable.
        Unstable = 1, "unstable";
        /// The grasp ended before enough consecutive settled predictions agreed.
        #[default]
        NoAgreement = 2, "no_agreement";
        /// The grasp ended, or the stream did, without a settled prediction.
        Missing = 3, "missing";
        /// A prediction was lost on the way (a gap in the sequence), came twice, or came out of order.
        OutOfOrder = 4, "out_of_order";
        /// Predictions came too late, or too far apart.
        Stale = 5, "stale";
        /// No cell is active.
        NoContact = 6, "no_contact";
        /// A frame or a prediction was malformed, of wrong length, NaN or negative.
        Invalid = 7, "invalid";
        /// The fingers touch each other.
        SelfCollision = 8, "self_collision";
        /// Frame, hand and model do not belong together.
        WrongHand = 9, "wrong_hand";
        /// Feature and classifier come from different models.
        WrongModel = 10, "wrong_model";
        /// The grasp is unlike the grasps that the model was trained on.
        OutOfDistribution = 11, "out_of_distribution";
        /// Enough consecutive settled predictions agreed that the model cannot tell.
        Unsure = 12, "unsure";
        /// The link to the machine that predicts was cut off while a grasp was open.
        LinkDown = 13, "link_down";
        /// Enough consecutive settled predictions agreed that the grasp is worth a probe.
        Promising = 14, "promising";
        /// The model needs a sense or a reading of an earlier phase that did not come.
        MissingReading = 15, "missing_reading";
        /// The model judges a grasp by the earlier ones of its day, and there were too few of them.
        NoBaseline = 16, "no_baseline";
        /// The readings of this day are unlike those of the days that the model was trained on.
        UnlikeDay = 17, "unlike_day";
        /// Joints or cells of the hand do not work as they should.
        SensorFault = 18, "sensor_fault";
        /// More lifts dropped their objects than was promised.
        PromiseWithdrawn = 19, "promise_withdrawn";
        /// While the arm lifts, enough consecutive predictions agreed that the fingers lose the object's load.
        Slipping = 20, "slipping";
    }
}

impl Phase {
    /// Whether it comes before `other` in a grasp, so that another grasp has begun if it follows `other`.
    pub fn is_before(self, other: Phase) -> bool {
        let place = |phase: Phase| match phase {
            Phase::Open => 0,
            Phase::Closing => 1,
            Phase::Settled => 2,
            Phase::Squeezing => 3,
            Phase::Squeezed => 4,
            Phase::TestLifting => 5,
            Phase::TestLifted => 6,
            // A source may ask while it lifts, by a frame of `ended`.
            Phase::Ended | Phase::Lifting => 7,
            Phase::Kept | Phase::Dropped => 8,
        };
        place(self) < place(other)
    }

    /// Whether the source has no more frames that could decide the grasp.
    pub fn is_over(self) -> bool {
        matches!(self, Phase::Ended | Phase::Kept | Phase::Dropped)
    }

    /// Of a frame that reports how a lift ended, whether its object was kept.
    pub fn outcome(self) -> Option<bool> {
        match self {
            Phase::Kept => Some(true),
            Phase::Dropped => Some(false),
            _ => None,
        }
    }

    /// Whether the hand and the arm are at rest, so that the frame may decide.
    pub fn decides(self) -> bool {
        matches!(self, Phase::Settled | Phase::Squeezed | Phase::TestLifted)
    }
}

impl Reason {
    /// Whether it says that something does not work or does not fit together, rather than what the grasp is like.
    pub fn is_fault(self) -> bool {
        match self {
            Reason::Missing
            | Reason::OutOfOrder
            | Reason::Stale
            | Reason::Invalid
            | Reason::WrongHand
            | Reason::WrongModel
            | Reason::LinkDown
            | Reason::MissingReading
            | Reason::SensorFault
            | Reason::PromiseWithdrawn => true,
            Reason::Stable
            | Reason::Unstable
            | Reason::NoAgreement
            | Reason::NoContact
            | Reason::SelfCollision
            | Reason::OutOfDistribution
            | Reason::Unsure
            | Reason::Promising
            | Reason::NoBaseline
            | Reason::UnlikeDay
            | Reason::Slipping => false,
        }
    }
}

impl Action {
    /// The word as people are shown it: `LIFT`.
    pub fn shown(self) -> &'static str {
        match self {
            Action::Hold => "HOLD",
            Action::Lift => "LIFT",
            Action::Squeeze => "SQUEEZE",
            Action::TestLift => "TEST LIFT",
            Action::Tighten => "TIGHTEN",
            Action::SetDown => "SET DOWN",
            Action::GoOn => "GO ON",
        }
    }

    /// Whether it decides the grasp, as one action for each grasp does. Probes come before it, and what the arm should do
    /// while it lifts comes after it.
    pub fn decides(self) -> bool {
        matches!(self, Action::Hold | Action::Lift)
    }
}
