//! The header of each sample.

use serde::{Deserialize, Serialize};

use crate::Recorded;
#[cfg(feature = "ipc")]
use crate::shared_memory::{FromBytes, Immutable, IntoBytes, KnownLayout, ZeroCopySend};

declared! { shared
    /// On each sample: which one it is and where it comes from.
    #[derive(PartialEq, Eq, Serialize, Deserialize)]
    #[cfg_attr(feature = "ipc", type_name("blindgrasp/Header/2"))]
    pub struct Header {
        /// Counts the samples of the source, from 0, without gaps. A stage gives its output the number of the input.
        #[ros = "Which sample it is and where it comes from."]
        pub seq: u64,
        /// In a replay, this is the recorded time.
        #[ros = "When the source took it, nanoseconds of the source's clock."]
        pub stamp_nanos: u64,
        /// Changes when the source starts anew. The page, Foxglove and topics of ROS 2 have a keyed hash of it,
        /// because another user who forges samples needs it.
        #[ros = "Generation of the source."]
        pub epoch: u64,
        /// `Hand::id`.
        #[ros = "Identity of the hand, 0 if unknown."]
        pub hand_id: u64,
        /// When the source published the sample on this machine (CLOCK_BOOTTIME). It is not part of the data: recordings
        /// hold 0.
        #[serde(skip)]
        pub origin_nanos: u64,
        /// How long after `origin_nanos` the sample may be acted upon; 0: there is no limit. Recordings hold 0.
        #[serde(skip)]
        pub valid_nanos: u64,
        /// Identity of the operators that the sample has passed, with their parameters and files: it changes if any of them
        /// is replaced by a different one. Recordings hold 0.
        #[serde(skip)]
        pub made_by: u64,
    }
}

impl Header {
    /// The time until which the sample may be acted upon (CLOCK_BOOTTIME); `None` if there is no limit.
    pub fn valid_until_nanos(&self) -> Option<u64> {
        (self.valid_nanos != 0).then(|| self.origin_nanos.saturating_add(self.valid_nanos))
    }
}

/// A message and its header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stamped<M> {
    pub header: Header,
    pub message: M,
}

impl<M: Recorded> Stamped<M> {
    /// [`Recorded::TYPE_NAME`] of the message.
    pub fn type_name(&self) -> &'static str {
        M::TYPE_NAME
    }
}
