//! The header of each sample.

use serde::{Deserialize, Serialize};

use crate::ros::RosType;
use crate::{Recorded, ZeroCopySend};

shared! {
    /// On each sample: which one it is and where it comes from.
    #[derive(PartialEq, Eq, Serialize, Deserialize)]
    #[type_name("blindgrasp/Header/1")]
    pub struct Header {
        /// Counts the samples of the source, from 0, without gaps. A stage gives its output the number of the input.
        pub seq: u64,
        /// When the source took the sample: nanoseconds of the source's own clock (recorded time in a replay).
        pub stamp_nanos: u64,
        /// Generation of the source: changes when the source starts anew.
        pub epoch: u64,
        /// Identity of the hand (`Hand::id`); 0 if the source does not know it.
        pub hand_id: u64,
        /// When the source published the sample on this machine (CLOCK_MONOTONIC), for latencies only. It is not part of
        /// the data: recordings hold 0.
        #[serde(skip)]
        pub origin_nanos: u64,
    }
}

impl RosType for Header {
    fn ros_name() -> String {
        "blindgrasp_msgs/Header".into()
    }

    fn ros_part() -> String {
        let fields = "\
# Which sample it is and where it comes from.
uint64 seq
# When the source took it, nanoseconds of the source's clock.
uint64 stamp_nanos
# Generation of the source.
uint64 epoch
# Identity of the hand, 0 if unknown.
uint64 hand_id
";
        crate::ros::part(&Self::ros_name(), fields)
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
