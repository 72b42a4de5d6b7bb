//! Publisher and subscriber of one message type over iceoryx2.
//!
//! iceoryx2 carries the bytes of samples, and their lengths beside them: ports of all messages are the same code, which is compiled
//! once ([`UntypedPublisher`], [`UntypedSubscriber`]). [`Publisher`] and [`Subscriber`] give the bytes their type; the name of the
//! type is compared when a port opens, and the lengths when a sample comes.
//!
//! A port is a publish-subscribe service, with safe overflow, whose readers are woken by bells in the cursors: iceoryx2 itself
//! never blocks, and a reader that is behind keeps its newest samples. Credit makes an edge lossless. The publisher reads on the
//! [cursors](crate::cursors) how far each reader of a lossless edge has come, and waits, for a bounded time, before it overtakes a
//! reader by more than its capacity. Its history reaches back as far, so a reader that comes back after a crash, or takes over in a
//! swap, still finds all samples that are not answered. Nobody waits for a reader on a `latest` edge, a tool or a standby: such a
//! reader can be as slow as it likes.
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

pub(crate) use publisher::ShadowPublisher;
pub use publisher::{Publisher, Sent, UntypedPublisher};
pub use sample::PortSample;
pub(crate) use sample::UntypedSample;
pub use subscriber::{Subscriber, UntypedSubscriber};

/// Why a port does not work, perhaps with an error of iceoryx2.
#[derive(Debug, thiserror::Error)]
#[error("port {service} {what}")]
pub struct PortError {
    service: String,
    what: String,
    source: Option<BoxedError>,
}

impl PortError {
    fn new(service: &str, what: impl Into<String>, source: Option<BoxedError>) -> PortError {
        PortError { service: service.into(), what: what.into(), source }
    }
}

/// An error of iceoryx2.
pub type BoxedError = Box<dyn std::error::Error + Send + Sync>;

/// The sample that a header belongs to.
pub fn sample_id(header: &Header) -> SampleId {
    SampleId { epoch: header.epoch, seq: header.seq }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::sync::Arc;
    use std::time::Duration;

    use blindgrasp_messages::{LiftDecision, Message, Recorded};

    use super::*;
    use crate::cursors::{N_AGE_SLOTS, SharedCursors};
    use crate::namespace;
    use crate::wiring::{
        ConsumerWiring, EdgePolicy, InputCounts, InputWiring, NamespaceWiring, OnLate, OutputWiring, ServiceWiring,
    };

    const OUTPUT: usize = 0;
    const INPUT: usize = 1;

    fn service(name: &str) -> ServiceWiring {
        ServiceWiring {
            name: name.into(),
            type_name: LiftDecision::TYPE_NAME.into(),
            history: 2,
            max_capacity: 2,
            max_borrowed: 3,
            max_publishers: 2,
            max_subscribers: 2,
            max_nodes: 2,
        }
    }

    /// Both ends of an edge in one process, and its cursors.
    pub(crate) fn edge(
        folder: &std::path::Path,
    ) -> (Publisher<LiftDecision>, Subscriber<LiftDecision>, Arc<SharedCursors>, InputWiring) {
        std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o700)).expect("its own");
        let domain = NamespaceWiring { folder: folder.into() };
        std::fs::create_dir_all(domain.ports()).expect("a folder");
        let node = namespace::join(&domain, "test").expect("joined");
        let n_slots = INPUT + 2 + N_AGE_SLOTS;
        let cursors = Arc::new(SharedCursors::create(&folder.join("test"), n_slots, 0).expect("cursors"));
        let consumer = ConsumerWiring {
            slot: INPUT,
            capacity: 2,
            attached_slots: vec![],
            attached_limit_millis: 0,
            behind: vec![],
        };
        let output = OutputWiring {
            service: service("edge"),
            shadow: service("shadow"),
            slot: OUTPUT,
            consumers: vec![consumer],
            bells: vec![],
            wait_limit_millis: 60_000,
        };
        let input = InputWiring {
            service: service("edge"),
            policy: EdgePolicy::Lossless,
            capacity: 2,
            deadline_nanos: None,
            on_late: OnLate::Count,
            tolerance_nanos: 0,
            partner_wait_nanos: 0,
            slot: Some(INPUT),
            writer_slot: OUTPUT,
        };
        let publisher = Publisher::open(&node, &cursors, &output, Some(0)).expect("opened");
        let subscriber = Subscriber::open(&node, Some(&cursors), &input).expect("opened");
        (publisher, subscriber, cursors, input)
    }

    fn head(seq: u64) -> <LiftDecision as Message>::Head {
        LiftDecision::default().to_parts(Header { seq, epoch: 7, ..Header::default() }).0
    }

    /// L9, and what an instance with a state finds that takes over.
    #[test]
    fn a_publisher_gives_way_to_its_own_reader_and_the_cursor_follows_the_saved_state() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut publisher, mut subscriber, cursors, _) = edge(folder.path());
        let key = |seq| Some(SampleId { epoch: 7, seq });
        publisher.begin(false);
        subscriber.take_over(None);
        subscriber.connect().expect("connected");
        for seq in 0..2 {
            assert_eq!(publisher.send(head(seq), &[], &mut || false).expect("sent"), Sent::Yes);
        }
        publisher.shares_process_with(vec![INPUT]);
        let mut n_asked = 0;
        let sent = publisher.send(head(2), &[], &mut || {
            n_asked += 1;
            n_asked > 100
        });
        assert_eq!((sent.expect("no error"), n_asked), (Sent::GaveWay, 0), "waiting is in vain");
        assert!(
            !publisher.has_room_for(&Header { seq: 2, epoch: 7, ..Header::default() }, Duration::ZERO).expect("ok")
        );
        assert_eq!(cursors.output(OUTPUT).key(), key(1), "a sample that was not sent is not counted");
        for seq in 0..2 {
            let sample = subscriber.receive().expect("no error").expect("a sample");
            assert_eq!(sample.head().header.seq, seq);
            subscriber.commit(&sample.head().header);
        }
        assert!(subscriber.is_caught_up());
        // A sample that is answered again does not move the cursor back; a saved state does.
        subscriber.commit(&Header { seq: 0, epoch: 7, ..Header::default() });
        assert_eq!(cursors.input(INPUT).key(), key(1));
        let counts = InputCounts { n_received: 1, ..InputCounts::default() };
        subscriber.take_over_at(key(0), key(0), counts, key(0));
        assert_eq!((cursors.input(INPUT).key(), cursors.input(INPUT).counts()), (key(0), counts));
        assert_eq!(publisher.begin(false), key(1), "its own samples lie in its memory");
    }
}
