//! The header of each sample.

use serde::{Deserialize, Serialize};

use crate::{Recorded, ZeroCopySend};

declared! { shared
    /// On each sample: which one it is and where it comes from.
    #[derive(PartialEq, Eq, Serialize, Deserialize)]
    #[type_name("blindgrasp/Header/1")]
    pub struct Header {
        /// Counts the samples of the source, from 0, without gaps. A stage gives its output the number of the input.
        #[ros = "Which sample it is and where it comes from."]
        pub seq: u64,
        /// In a replay, this is the recorded time.
        #[ros = "When the source took it, nanoseconds of the source's clock."]
        pub stamp_nanos: u64,
        /// Changes when the source starts anew.
        #[ros = "Generation of the source."]
        pub epoch: u64,
        /// `Hand::id`.
        #[ros = "Identity of the hand, 0 if unknown."]
        pub hand_id: u64,
        /// When the source published the sample on this machine (CLOCK_MONOTONIC), for latencies only. It is not part
        /// of the data: recordings hold 0.
        #[serde(skip)]
        pub origin_nanos: u64,
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
