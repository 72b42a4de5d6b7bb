//! Publisher and subscriber of one message type over iceoryx2.
//!
//! A port is a publish-subscribe service and an event service of one name. Every edge is lossless: a publisher whose
//! subscriber is full waits for a bounded time and then fails loudly. Sequence gaps are counted, never silent.
//!
//! A trap of iceoryx2 0.10: a subscriber that exists but has not looked for its publishers yet gets samples up to its
//! buffer's size, and what comes then is dropped without waiting and without an error. So subscribers
//! [connect](Subscriber::connect) before the graph starts, and a publisher counts how many each sample has reached.

use std::time::Duration;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{BackpressureAction, BackpressureInfo};
use iceoryx2::prelude::{AllocationStrategy, Node, ServiceName, ipc};
use iceoryx2::sample::Sample;
use iceoryx2::service::port_factory::{PortFactory, event, publish_subscribe};

use super::wiring::{InputCounts, ServiceWiring};
use crate::message::Message;

/// How often a waiting publisher yields before it sleeps between tries.
const N_YIELDS: u64 = 64;
/// How long a waiting publisher sleeps between tries after that.
const RETRY_PAUSE: Duration = Duration::from_micros(50);

/// What went wrong on a port.
#[derive(Debug, thiserror::Error)]
#[error("port {service}: {message}")]
pub struct PortError {
    service: String,
    message: String,
}

/// A sample in shared memory, borrowed.
pub type PortSample<M> = Sample<ipc::Service, [<M as Message>::Item], <M as Message>::Head>;

type PubSub<M> = publish_subscribe::PortFactory<ipc::Service, [<M as Message>::Item], <M as Message>::Head>;

/// The sending end of an edge.
pub struct Publisher<M: Message> {
    service: String,
    pub_sub: PubSub<M>,
    publisher: iceoryx2::port::publisher::Publisher<ipc::Service, [M::Item], M::Head>,
    notifier: Notifier<ipc::Service>,
    n_consumers: usize,
    wait_limit_millis: u64,
    n_sent: u64,
}

/// The receiving end of an edge.
pub struct Subscriber<M: Message> {
    service: String,
    pub_sub: PubSub<M>,
    subscriber: iceoryx2::port::subscriber::Subscriber<ipc::Service, [M::Item], M::Head>,
    listener: Listener<ipc::Service>,
    counts: InputCounts,
    last: Option<(u64, u64)>,
}

impl<M: Message> Publisher<M> {
    /// Opens the port, for messages of up to `max_items` items (more are possible, at the cost of new memory).
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open(node: &Node<ipc::Service>, wiring: &ServiceWiring, max_items: usize) -> Result<Self, PortError> {
        let refused = |message: String| PortError { service: wiring.name.clone(), message };
        let pub_sub = pub_sub::<M>(node, wiring)?;
        let wait_limit = Duration::from_millis(wiring.wait_limit_millis);
        let publisher = pub_sub
            .publisher_builder()
            .initial_max_slice_len(max_items.max(1))
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .set_backpressure_handler(move |info: &BackpressureInfo| wait_for_room(info, wait_limit))
            .create()
            .map_err(|error| refused(format!("{error:?}")))?;
        let notifier =
            events(node, wiring)?.notifier_builder().create().map_err(|error| refused(format!("{error:?}")))?;
        Ok(Publisher {
            service: wiring.name.clone(),
            pub_sub,
            publisher,
            notifier,
            n_consumers: wiring.n_consumers,
            wait_limit_millis: wiring.wait_limit_millis,
            n_sent: 0,
        })
    }

    /// Whether all consumers that the graph names are there.
    pub fn has_all_consumers(&self) -> bool {
        self.pub_sub.dynamic_config().number_of_subscribers() >= self.n_consumers
    }

    /// Sends a message, written straight into shared memory.
    ///
    /// # Errors
    /// A subscriber stayed full for longer than the limit, or iceoryx2's reason.
    pub fn send(&mut self, head: M::Head, items: &[M::Item]) -> Result<(), PortError> {
        let refused = |message: String| PortError { service: self.service.clone(), message };
        let mut sample =
            self.publisher.loan_slice_uninit(items.len()).map_err(|error| refused(format!("{error:?}")))?;
        *sample.user_header_mut() = head;
        let seq = M::header(&head).seq;
        let n_reached = sample.write_from_slice(items).send().map_err(|error| {
            refused(format!(
                "sample {seq} could not be delivered within {} ms: a consumer is stopped or too slow ({error:?})",
                self.wait_limit_millis
            ))
        })?;
        if n_reached < self.n_consumers {
            return Err(refused(format!("sample {seq} reached {n_reached} of {} consumers", self.n_consumers)));
        }
        self.n_sent += 1;
        // A listener that went away is no error: its subscriber is gone as well.
        let _ = self.notifier.notify();
        Ok(())
    }

    /// Samples sent.
    pub fn n_sent(&self) -> u64 {
        self.n_sent
    }
}

impl<M: Message> Subscriber<M> {
    /// Opens the port.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<Self, PortError> {
        let refused = |message: String| PortError { service: wiring.name.clone(), message };
        // The listener first: whoever sees the subscriber can already wake it.
        let listener =
            events(node, wiring)?.listener_builder().create().map_err(|error| refused(format!("{error:?}")))?;
        let pub_sub = pub_sub::<M>(node, wiring)?;
        let subscriber = pub_sub
            .subscriber_builder()
            .buffer_size(wiring.capacity)
            .create()
            .map_err(|error| refused(format!("{error:?}")))?;
        Ok(Subscriber {
            service: wiring.name.clone(),
            pub_sub,
            subscriber,
            listener,
            counts: InputCounts::default(),
            last: None,
        })
    }

    /// Takes up its end of the connection to the publisher; false if there is no publisher yet.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn connect(&self) -> Result<bool, PortError> {
        if self.pub_sub.dynamic_config().number_of_publishers() == 0 {
            return Ok(false);
        }
        self.subscriber
            .update_connections()
            .map_err(|error| PortError { service: self.service.clone(), message: format!("{error:?}") })?;
        Ok(true)
    }

    /// The next sample, if one is there.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn receive(&mut self) -> Result<Option<PortSample<M>>, PortError> {
        let sample = self
            .subscriber
            .receive()
            .map_err(|error| PortError { service: self.service.clone(), message: format!("{error:?}") })?;
        if let Some(sample) = &sample {
            let header = M::header(sample.user_header());
            self.count(header.epoch, header.seq);
        }
        Ok(sample)
    }

    /// Waits until something may have come, at most `limit`. May return early: receive until there is nothing.
    pub fn wait(&self, limit: Duration) {
        // A signal interrupts the wait with an error; the caller looks at its signals after each wait.
        let _ = self.listener.timed_wait(|_| {}, limit);
    }

    /// What [`Subscriber::wait`] waits for, to wait for several at once.
    pub fn listener(&self) -> &Listener<ipc::Service> {
        &self.listener
    }

    /// What has come in.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    fn count(&mut self, epoch: u64, seq: u64) {
        self.counts.n_received += 1;
        match self.last {
            Some((last_epoch, last_seq)) if last_epoch == epoch && seq <= last_seq => {
                self.counts.n_repeated += 1;
                return;
            }
            Some((last_epoch, last_seq)) if last_epoch == epoch => self.counts.n_missing += seq - last_seq - 1,
            // The subscriber was there before the source began, and the source counts from 0.
            None => self.counts.n_missing += seq,
            _ => {}
        }
        self.last = Some((epoch, seq));
    }
}

fn wait_for_room(info: &BackpressureInfo, limit: Duration) -> BackpressureAction {
    if info.elapsed_time > limit {
        return BackpressureAction::DiscardDataAndFail;
    }
    if info.retries < N_YIELDS {
        std::thread::yield_now();
    } else {
        std::thread::sleep(RETRY_PAUSE);
    }
    BackpressureAction::Retry
}

/// Whoever comes first creates the service, the others must ask for the same: the wiring decides for all.
fn pub_sub<M: Message>(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<PubSub<M>, PortError> {
    let refused = |message: String| PortError { service: wiring.name.clone(), message };
    if wiring.type_name != M::TYPE_NAME {
        return Err(refused(format!("carries {}, expected {}", wiring.type_name, M::TYPE_NAME)));
    }
    node.service_builder(&service_name(wiring)?)
        .publish_subscribe::<[M::Item]>()
        .user_header::<M::Head>()
        .enable_safe_overflow(false)
        .subscriber_max_buffer_size(wiring.capacity)
        .subscriber_max_borrowed_samples(wiring.max_borrowed)
        .history_size(0)
        .max_publishers(wiring.max_publishers)
        .max_subscribers(wiring.max_subscribers)
        .max_nodes(wiring.max_nodes)
        .open_or_create()
        .map_err(|error| refused(format!("{error:?}")))
}

fn events(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<event::PortFactory<ipc::Service>, PortError> {
    node.service_builder(&service_name(wiring)?)
        .event()
        .max_notifiers(wiring.max_publishers)
        .max_listeners(wiring.max_subscribers)
        .max_nodes(wiring.max_nodes)
        .open_or_create()
        .map_err(|error| PortError { service: wiring.name.clone(), message: format!("{error:?}") })
}

fn service_name(wiring: &ServiceWiring) -> Result<ServiceName, PortError> {
    ServiceName::new(&wiring.name)
        .map_err(|error| PortError { service: wiring.name.clone(), message: format!("{error:?}") })
}
