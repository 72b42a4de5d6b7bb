//! Publisher and subscriber of one message type over iceoryx2.
//!
//! A port is a publish-subscribe service and an event service of one name, with safe overflow: iceoryx2 itself never
//! blocks, and a reader that is behind keeps its newest samples. Credit makes an edge lossless: the publisher reads on
//! the [cursors](crate::cursors) how far each reader of a lossless edge has come, and waits, for a bounded time, before it
//! overtakes a reader by more than its capacity. Its history reaches back as far, so a reader that comes back after a
//! crash, or takes over in a swap, still finds all samples that are not answered. Nobody waits for a reader on a `latest`
//! edge, a tool or a standby: such a reader can be as slow as it likes.
//!
//! A trap of iceoryx2 0.10: a subscriber that exists but has not looked for its publishers yet gets samples up to its
//! buffer's size, and later ones are dropped without an error. Within the credit that cannot happen.

mod publisher;
mod service;
mod subscriber;

use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;

use crate::cursors::SampleId;
use blindgrasp_messages::{Header, Message};

pub(crate) use publisher::{LONGEST_TRY, LOOK_PAUSE, RETRY_PAUSE};
pub use publisher::{Publisher, Sent, ShadowPublisher};
pub use subscriber::Subscriber;

/// Why a port does not work. The sources are errors of iceoryx2.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    #[error("port {service} carries {found}, expected {expected}")]
    WrongType { service: String, found: String, expected: &'static str },
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

/// A sample that was received.
pub struct PortSample<M: Message>(Place<M>);

enum Place<M: Message> {
    /// In shared memory, borrowed from its publisher.
    Lent(Sample<ipc::Service, [M::Item], M::Head>),
    Copied(M::Head, Vec<M::Item>),
}

impl<M: Message> PortSample<M> {
    pub fn user_header(&self) -> &M::Head {
        match &self.0 {
            Place::Lent(sample) => sample.user_header(),
            Place::Copied(head, _) => head,
        }
    }

    pub fn payload(&self) -> &[M::Item] {
        match &self.0 {
            Place::Lent(sample) => sample.payload(),
            Place::Copied(_, items) => items,
        }
    }

    /// A sample that was received before, from a copy.
    pub(crate) fn of_copy(head: M::Head, items: Vec<M::Item>) -> Self {
        PortSample(Place::Copied(head, items))
    }

    /// The sample in memory of this process, so that its publisher gets its own back. For each sample that a publisher must
    /// be able to lend at a time, iceoryx2 reserves 3.6 KB in each of its subscribers.
    fn copied(self) -> Self {
        PortSample(Place::Copied(*self.user_header(), self.payload().to_vec()))
    }
}

/// The sample that a header belongs to.
pub fn sample_id(header: &Header) -> SampleId {
    SampleId { epoch: header.epoch, seq: header.seq }
}
