//! Publisher and subscriber of one message type over iceoryx2.
//!
//! iceoryx2 carries the bytes of samples, and their lengths beside them: ports of all messages are the same code, which is compiled
//! once ([`UntypedPublisher`], [`UntypedSubscriber`]). [`Publisher`] and [`Subscriber`] give the bytes their type; the name of the
//! type is compared when a port opens, and the lengths when a sample comes.
//!
//! A port is a publish-subscribe service, with safe overflow, whose readers are woken by bells in the cursors: iceoryx2 itself never
//! blocks, and a reader that is behind keeps its newest samples. Credit makes an edge lossless: the publisher reads on
//! the [cursors](crate::cursors) how far each reader of a lossless edge has come, and waits, for a bounded time, before it
//! overtakes a reader by more than its capacity. Its history reaches back as far, so a reader that comes back after a
//! crash, or takes over in a swap, still finds all samples that are not answered. Nobody waits for a reader on a `latest`
//! edge, a tool or a standby: such a reader can be as slow as it likes.
//!
//! A trap of iceoryx2 0.10: a subscriber that exists but has not looked for its publishers yet gets samples up to its
//! buffer's size, and later ones are dropped without an error. Within the credit that cannot happen.

pub(crate) mod bytes;
mod publisher;
mod sample;
mod service;
mod subscriber;

use crate::cursors::SampleId;
use blindgrasp_messages::Header;

pub(crate) use publisher::{LONGEST_TRY, LOOK_PAUSE, RETRY_PAUSE};
pub use publisher::{Publisher, Sent, ShadowPublisher, UntypedPublisher};
pub use sample::PortSample;
use sample::UntypedSample;
pub use subscriber::{Subscriber, UntypedSubscriber};

/// Why a port does not work. The sources are errors of iceoryx2.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    #[error("port {service} carries {found}, expected {expected}")]
    WrongType { service: String, found: String, expected: &'static str },
    #[error("port {service}: a sample has not the lengths of {expected}: its writer was built with another version")]
    WrongLength { service: String, expected: &'static str },
    #[error("port {service} cannot be opened")]
    Open { service: String, source: BoxedError },
    #[error("port {service} cannot be connected")]
    Connect { service: String, source: BoxedError },
    #[error("sample {seq} of port {service} cannot be sent")]
    Send { service: String, seq: u64, source: BoxedError },
    #[error(
        "sample {seq} of port {service} could not be delivered within {limit_millis} ms: a reader is stopped or too slow"
    )]
    Stalled { service: String, seq: u64, limit_millis: u128 },
    #[error(
        "the readers of port {service} lack samples up to {seq}, which ended with the instance that has handed over: this one \
         begins again after their last sample"
    )]
    PredecessorGone { service: String, seq: u64 },
    #[error("port {service} cannot receive")]
    Receive { service: String, source: BoxedError },
}

/// An error of iceoryx2.
pub type BoxedError = Box<dyn std::error::Error + Send + Sync>;

/// The sample that a header belongs to.
pub fn sample_id(header: &Header) -> SampleId {
    SampleId { epoch: header.epoch, seq: header.seq }
}
