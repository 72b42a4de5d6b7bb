//! The samples that travel along the graph's edges, each declared once in a file of its own.
//!
//! ```
//! use blindgrasp_messages::{Header, Message, Phase, TactileFrame};
//!
//! let frame = TactileFrame {
//!     grasp_id: 7,
//!     phase: Phase::Settled,
//!     joints: vec![0.1, 0.9],
//!     cells_newtons: vec![0.0, 1.5, 0.2],
//!     ..TactileFrame::default()
//! };
//! let (head, items) = frame.to_parts(Header { seq: 3, ..Header::default() });
//! assert_eq!(TactileFrame::header(&head).seq, 3);
//! assert_eq!(TactileFrame::from_parts(&head, &items)?, frame);
//! # Ok::<(), blindgrasp_messages::MessageError>(())
//! ```
//!
//! A declaration gives a message all its shapes. In shared memory a message is a fixed-size `…Head` (`repr(C)` without
//! padding, beginning with [`Header`]) and behind it a slice of [`Message::Item`]s. So the memory taken is that of the
//! hand in use and not that of the largest one. Elsewhere it is an owned struct: recordings (CDR with a ROS 2
//! definition), the bridge between machines (bincode) and JSON serialise it with serde.
//! `operators/blindgrasp_messages.py` is generated from the same declarations.
//!
//! A message in shared memory may come from a process of a stranger. Therefore no bit pattern of a head is invalid as
//! such ([`PlainBytes`]): enums travel as integer codes, and [`Message::from_parts`] checks the codes and every length.
//!
//! A new message type is a file with its `message!`, which this file names as a module, and a line in the list below.

#[macro_use]
mod declare;
#[macro_use]
mod senses;
mod coded;
mod contact_set;
pub mod file_kind;
pub mod files;
mod grasp_feature;
mod grasp_scene;
mod grasp_truth;
mod header;
#[cfg(all(test, feature = "ipc"))]
mod layout;
mod lift_decision;
mod lift_outcome;
mod prediction;
mod ros;
pub mod score;
mod serialized;
mod tactile_frame;
#[cfg(all(test, feature = "ipc"))]
mod tests;

pub use coded::{Action, Codes, Fault, Phase, Reason, coded_enums};
pub use contact_set::{Contact, ContactSet, ContactSetHead};
pub use grasp_feature::{GraspFeature, GraspFeatureHead};
pub use grasp_scene::{GraspScene, SceneContact};
pub use grasp_truth::{GraspTruth, GraspTruthHead};
pub use header::{Header, Stamped};
pub use lift_decision::{LiftDecision, LiftDecisionHead};
pub use lift_outcome::{LiftOutcome, LiftOutcomeHead};
pub use prediction::{Prediction, PredictionHead};
pub use ros::{first_difference, signature};
pub use senses::{OwnedSenses, Sense, Senses};
pub use serialized::{hex_id, read_list};
pub use tactile_frame::{FrameParts, FramePartsMut, TactileFrame, TactileFrameHead};
#[cfg(feature = "ipc")]
pub use zerocopy;

use serde::{Deserialize, Serialize};

/// The most joints that a message carries.
pub const MAX_JOINTS: usize = 32;
/// The most pads that a message carries.
pub const MAX_PADS: usize = 32;
/// The most tactile cells that a message carries: a skin of a whole arm has some 10,000.
pub const MAX_CELLS: usize = 16_384;
/// The most values of a feature that a message carries.
pub const MAX_FEATURES: usize = 4096;
/// The longest name in a message, bytes of UTF-8.
pub const MAX_NAME_BYTES: usize = 64;

/// A message that a recording can hold.
pub trait Recorded: Serialize + for<'de> Deserialize<'de> + Clone + std::fmt::Debug + Send + 'static {
    /// Identifies the type in `--describe` and between machines. The number at its end changes with the layout.
    const TYPE_NAME: &'static str;
    /// The topic in recordings where a graph has one port of this type.
    const TOPIC: &'static str;
    /// The ROS 2 name, e.g. `blindgrasp_msgs/msg/TactileFrame`.
    const SCHEMA: &'static str;

    /// A sample of this type among samples of all types.
    fn record(sample: Stamped<Self>) -> Record;

    /// The ROS 2 definition, followed by the definitions of the structs in it.
    fn definition() -> String;

    /// Checks every length and count: a message out of a recording may have any.
    ///
    /// # Errors
    /// The first length that is too large.
    fn check(&self) -> Result<(), MessageError>;
}

/// What a struct in shared memory implements.
#[cfg(feature = "ipc")]
mod shared_memory {
    /// Programs may send it with iceoryx2 alone.
    pub(crate) use iceoryx2::prelude::ZeroCopySend;
    /// See [`PlainBytes`](crate::PlainBytes).
    pub(crate) use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};
}

/// The condition on what lies in shared memory: all bytes of its length are a value, and a value is nothing but its
/// bytes. (Without the feature `ipc`, there is no condition, because nothing reads the bytes.)
///
/// A head has it by `derive`; no other dependency is needed:
///
/// ```
/// use blindgrasp_messages::zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};
/// use blindgrasp_messages::{Header, PlainBytes};
///
/// #[derive(FromBytes, IntoBytes, Immutable, KnownLayout)]
/// #[zerocopy(crate = "blindgrasp_messages::zerocopy")]
/// #[repr(C)]
/// struct SlipHead {
///     header: Header,
///     slips: [u8; 8],
/// }
///
/// fn may_be_shared<T: PlainBytes>() {}
/// may_be_shared::<SlipHead>();
/// ```
///
/// Bytes from another process may be anything, and no `bool` is 7. The compiler refuses such a head, one that has an
/// enum or a reference, and one with padding:
///
/// ```compile_fail,E0277
/// # use blindgrasp_messages::zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};
/// # use blindgrasp_messages::Header;
/// #[derive(FromBytes, IntoBytes, Immutable, KnownLayout)]
/// #[zerocopy(crate = "blindgrasp_messages::zerocopy")]
/// #[repr(C)]
/// struct SlipHead {
///     header: Header,
///     slips: [bool; 8],
/// }
/// ```
#[cfg(feature = "ipc")]
pub trait PlainBytes: zerocopy::FromBytes + zerocopy::IntoBytes + zerocopy::Immutable + zerocopy::KnownLayout {}
#[cfg(feature = "ipc")]
impl<T: zerocopy::FromBytes + zerocopy::IntoBytes + zerocopy::Immutable + zerocopy::KnownLayout> PlainBytes for T {}

#[cfg(not(feature = "ipc"))]
pub trait PlainBytes {}
#[cfg(not(feature = "ipc"))]
impl<T> PlainBytes for T {}

/// A message that can travel along an edge.
pub trait Message: Recorded {
    /// The fixed-size part in shared memory, which begins with the header.
    type Head: PlainBytes + Copy + Default + std::fmt::Debug;
    /// An element of the variable part in shared memory.
    type Item: PlainBytes + Copy + Default + std::fmt::Debug;

    /// The header in a head.
    fn header(head: &Self::Head) -> &Header;
    /// The header in a head, to change it.
    fn header_mut(head: &mut Self::Head) -> &mut Header;
    /// The message as it lies in shared memory.
    fn to_parts(&self, header: Header) -> (Self::Head, Vec<Self::Item>);
    /// The message from shared memory.
    ///
    /// # Errors
    /// An unknown code or a length that is too large.
    fn from_parts(head: &Self::Head, items: &[Self::Item]) -> Result<Self, MessageError>;
}

/// Why a message from shared memory or from a recording is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    #[error("{field} has the unknown code {code}")]
    Code { field: &'static str, code: u32 },
    #[error("{field} has length {found}, expected {expected}")]
    Length { field: &'static str, found: usize, expected: String },
    #[error("{field} is not UTF-8")]
    Text { field: &'static str },
}

/// An action that is generic over the message type, for [`with_message`].
pub trait WithMessage {
    type Output;

    fn with<M: Message>(self) -> Self::Output;
}

/// Makes the list of message types into [`Record`], [`MESSAGE_TYPES`], [`with_message`], `with_sample!` and
/// `of_each_type!`. The first argument is a dollar sign, for the macros that it makes.
macro_rules! messages {
    ($dollar:tt sent { $($sent_variant:ident($sent:ident),)+ } only_recorded { $($variant:ident($type:ident),)* }) => {
        /// One recorded sample.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        pub enum Record {
            $($sent_variant(Stamped<$sent>),)+
            $($variant(Stamped<$type>),)*
        }

        $(impl From<Stamped<$sent>> for Record {
            fn from(sample: Stamped<$sent>) -> Self { Record::$sent_variant(sample) }
        })+
        $(impl From<Stamped<$type>> for Record {
            fn from(sample: Stamped<$type>) -> Self { Record::$variant(sample) }
        })*

        /// The names of all types here that travel along edges, as `--describe` prints them.
        pub const MESSAGE_TYPES: [&str; [$($sent::TYPE_NAME),+].len()] = [$($sent::TYPE_NAME),+];

        /// Does something with the type of this name; `None` if no message that travels along edges has it.
        pub fn with_message<W: WithMessage>(type_name: &str, work: W) -> Option<W::Output> {
            match type_name {
                $($sent::TYPE_NAME => Some(work.with::<$sent>()),)+
                _ => None,
            }
        }

        /// Evaluates an expression with the [`Stamped`] sample in a [`Record`], whatever its type:
        /// `with_sample!(record, sample => sample.header.seq)`.
        #[macro_export]
        macro_rules! with_sample {
            ($dollar record:expr, $dollar sample:ident => $dollar body:expr) => {
                match $dollar record {
                    $($crate::Record::$sent_variant($dollar sample) => $dollar body,)+
                    $($crate::Record::$variant($dollar sample) => $dollar body,)*
                }
            };
        }

        /// An array of what a generic function returns for each type that can be recorded: `of_each_type!(name)`.
        #[macro_export]
        macro_rules! of_each_type {
            ($dollar function:ident) => {
                [$($dollar function::<$crate::$sent>(),)+ $($dollar function::<$crate::$type>(),)*]
            };
        }

        #[cfg(all(test, feature = "ipc"))]
        pub(crate) fn layouts() -> Vec<layout::MessageLayout> {
            vec![$(layout::of_message::<$sent>()),+]
        }
    };
}

messages! { $
    sent {
        Tactile(TactileFrame),
        Contacts(ContactSet),
        Feature(GraspFeature),
        Prediction(Prediction),
        Decision(LiftDecision),
        Truth(GraspTruth),
        Outcome(LiftOutcome),
    }
    only_recorded {
        Scene(GraspScene),
    }
}

impl Record {
    pub fn header(&self) -> &Header {
        with_sample!(self, sample => &sample.header)
    }

    pub fn grasp_id(&self) -> u64 {
        with_sample!(self, sample => sample.message.grasp_id)
    }

    /// Whether a stage sends few samples per grasp and numbers these samples itself. Such a sample does not bear the
    /// number of a frame.
    pub fn is_said_once(&self) -> bool {
        matches!(self, Record::Decision(_))
    }

    /// [`Recorded::TYPE_NAME`] of its message.
    pub fn type_name(&self) -> &'static str {
        with_sample!(self, sample => sample.type_name())
    }

    /// As [`Recorded::check`].
    ///
    /// # Errors
    /// The first length that is too large.
    pub fn check(&self) -> Result<(), MessageError> {
        with_sample!(self, sample => sample.message.check())
    }

    /// The message as JSON, without the header.
    ///
    /// # Errors
    /// A number that JSON cannot hold; serde_json writes NaN and infinity as null, so there is none today.
    pub fn to_json(&self) -> serde_json::Result<serde_json::Value> {
        with_sample!(self, sample => serde_json::to_value(&sample.message))
    }
}
