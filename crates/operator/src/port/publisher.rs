//! The sending end of an edge.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node, ipc};
use iceoryx2::service::port_factory::PortFactory;

use super::service::{self, PubSub};
use super::{PortError, sample_id};
use crate::cursors::{COMPARE_BELL, OutputSlot, SampleId, SharedCursors};
use crate::wiring::{ConsumerWiring, OutputWiring, ReaderWiring, ServiceWiring};
use blindgrasp_messages::{Header, Message};

/// A waiting publisher yields so often before it sleeps between tries.
const N_YIELDS: u32 = 64;
/// A waiting publisher then sleeps so long between tries.
pub(crate) const RETRY_PAUSE: Duration = Duration::from_micros(50);
/// A waiting publisher looks so often for readers that have come back.
pub(crate) const LOOK_PAUSE: Duration = Duration::from_millis(1);
/// A longer pause between two tries counts as this much: while the whole machine stands still, no attached reader is slow.
pub(crate) const LONGEST_TRY: Duration = Duration::from_millis(5);
/// A publisher that grows has room for so many items at first.
const N_FIRST_ITEMS: usize = 64;

/// The outcome of sending a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub enum Sent {
    Yes,
    /// The publisher was asked to give way while it waited for a reader: the sample was not sent.
    GaveWay,
}

/// A publisher that does not wait for readers.
struct Sender<M: Message> {
    service: String,
    pub_sub: PubSub<M>,
    publisher: iceoryx2::port::publisher::Publisher<ipc::Service, [M::Item], M::Head>,
    cursors: Arc<SharedCursors>,
    /// The slots of the bells that wake its readers.
    bells: Vec<usize>,
    n_subscribers: usize,
}

impl<M: Message> Sender<M> {
    fn open(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        bells: &[usize],
        wiring: &ServiceWiring,
        max_items: usize,
        strategy: AllocationStrategy,
    ) -> Result<Self, PortError> {
        let pub_sub = service::pub_sub::<M>(node, wiring)?;
        let publisher = pub_sub
            .publisher_builder()
            .initial_max_slice_len(max_items.max(1))
            .allocation_strategy(strategy)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| service::open_failed(wiring, error))?;
        let (service, cursors, bells) = (wiring.name.clone(), Arc::clone(cursors), bells.to_vec());
        Ok(Sender { service, pub_sub, publisher, cursors, bells, n_subscribers: 0 })
    }

    fn send(&self, head: M::Head, items: &[M::Item]) -> Result<(), PortError> {
        let failed = |source| PortError::Send { service: self.service.clone(), seq: M::header(&head).seq, source };
        let mut sample = self.publisher.loan_slice_uninit(items.len()).map_err(|error| failed(error.into()))?;
        *sample.user_header_mut() = head;
        sample.write_from_slice(items).send().map_err(|error| failed(error.into()))?;
        self.ring();
        Ok(())
    }

    fn ring(&self) {
        self.bells.iter().for_each(|slot| self.cursors.bell(*slot).ring());
    }

    /// Gives the history to readers that have come since the last sample, and wakes them.
    fn look_for_readers(&mut self) -> Result<(), PortError> {
        let n_subscribers = self.pub_sub.dynamic_config().number_of_subscribers();
        self.publisher
            .update_connections()
            .map_err(|error| PortError::Connect { service: self.service.clone(), source: error.into() })?;
        if std::mem::replace(&mut self.n_subscribers, n_subscribers) != n_subscribers {
            self.ring();
        }
        Ok(())
    }
}

/// The sending end of an edge.
pub struct Publisher<M: Message> {
    sender: Sender<M>,
    cursors: Arc<SharedCursors>,
    slot: usize,
    readers: Vec<Reader>,
    wait_limit: Duration,
    /// The first sample that this publisher, and not an earlier one, has sent.
    own_first: Option<SampleId>,
    /// The last sample that this publisher has sent.
    own_last: Option<SampleId>,
}

/// A reader whose unanswered samples the publisher must be able to send again.
struct Reader {
    slot: usize,
    limit: Limit,
    /// The last sample that it had answered at the last look.
    key: Option<SampleId>,
    /// If it is an attached reader, the slots of all its readers, and how long the publisher waits for it.
    attached_slots: Vec<usize>,
    attached_limit: Duration,
    /// The readers of its answers, if it answers each sample under the same number.
    behind: Vec<Reader>,
}

/// How many samples a reader may leave unanswered.
#[derive(Clone, Copy)]
enum Limit {
    /// Of the samples of this very publisher, as many as the reader's queue takes. The samples of an earlier publisher lie in
    /// a queue of their own, or have died with it: waiting for a reader to answer them could last for ever.
    Queue(u64),
    /// Of all samples, as many as the publisher keeps.
    History(u64),
}

/// The sample that is to be sent, for [`Reader::has_room`].
struct Next {
    key: SampleId,
    /// The last sample that was sent.
    last: Option<SampleId>,
    /// The number of the first sample of this publisher.
    own_first: u64,
}

impl Reader {
    fn of_port(wiring: &ConsumerWiring, history: usize) -> Reader {
        let behind = wiring.behind.iter().map(|behind| Reader::further_on(behind, history)).collect();
        let limit = Limit::Queue(wiring.capacity as u64);
        Reader {
            slot: wiring.slot,
            limit,
            key: None,
            attached_slots: wiring.attached_slots.clone(),
            attached_limit: Duration::from_millis(wiring.attached_limit_millis),
            behind,
        }
    }

    fn further_on(wiring: &ReaderWiring, history: usize) -> Reader {
        let behind = wiring.behind.iter().map(|behind| Reader::further_on(behind, history)).collect();
        let limit = Limit::History(history as u64);
        let (attached_slots, attached_limit) = (Vec::new(), Duration::ZERO);
        Reader { slot: wiring.slot, limit, key: None, attached_slots, attached_limit, behind }
    }

    fn has_room(&mut self, cursors: &SharedCursors, next: &Next) -> bool {
        let slot = cursors.input(self.slot);
        if !(self.key.is_some() && self.is_near(next)) {
            self.key = slot.key();
            if !self.is_near(next) {
                return slot.is_given_up();
            }
        }
        self.behind.iter_mut().all(|reader| reader.has_room(cursors, next)) || slot.is_given_up()
    }

    fn is_near(&self, next: &Next) -> bool {
        let is_within = |first_unanswered: u64| match self.limit {
            Limit::Queue(limit) => next.key.seq.saturating_sub(first_unanswered.max(next.own_first)) < limit,
            Limit::History(limit) => next.key.seq.saturating_sub(first_unanswered) < limit,
        };
        match (self.key, next.last) {
            // A reader that has answered all samples has room for one more, however far the numbers jump.
            (Some(key), last) if key.epoch == next.key.epoch => is_within(key.seq + 1) || last == Some(key),
            // A new epoch begins when every reader has answered the one before.
            (Some(key), Some(last)) => key == last,
            (None, Some(last)) => last.epoch == next.key.epoch && is_within(0),
            (Some(_) | None, None) => true,
        }
    }

    /// Of the cursors of this reader and of those behind it, without readers that were given up, the one furthest behind; the
    /// outer `None` if there is no reader.
    fn least(&self, cursors: &SharedCursors, last: Option<SampleId>) -> Option<Option<SampleId>> {
        let slot = cursors.input(self.slot);
        if slot.is_given_up() {
            return None;
        }
        let behind = self.behind.iter().filter_map(|reader| reader.least(cursors, last));
        Some(behind.fold(slot.key(), |least, key| further_behind(least, key, last)))
    }
}

/// The cursor that is further behind, where `last` is the last sample that was sent.
fn further_behind(a: Option<SampleId>, b: Option<SampleId>, last: Option<SampleId>) -> Option<SampleId> {
    match (a, b, last) {
        (Some(a), Some(b), _) if a.epoch == b.epoch => Some(a.min(b)),
        // The reader in the earlier epoch is behind.
        (Some(a), Some(b), Some(last)) => Some(if a.epoch == last.epoch { b } else { a }),
        _ => None,
    }
}

impl<M: Message> Publisher<M> {
    /// Opens the port, for messages of up to `max_items` items.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn open(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        max_items: usize,
    ) -> Result<Self, PortError> {
        Self::open_with(node, cursors, wiring, max_items, AllocationStrategy::Static)
    }

    /// As [`Publisher::open`], for messages whose largest number of items is unknown: a larger message takes more memory.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn open_growing(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
    ) -> Result<Self, PortError> {
        Self::open_with(node, cursors, wiring, N_FIRST_ITEMS, AllocationStrategy::PowerOfTwo)
    }

    fn open_with(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        max_items: usize,
        strategy: AllocationStrategy,
    ) -> Result<Self, PortError> {
        Ok(Publisher {
            sender: Sender::open(node, cursors, &wiring.bells, &wiring.service, max_items, strategy)?,
            cursors: Arc::clone(cursors),
            slot: wiring.slot,
            readers: wiring.consumers.iter().map(|reader| Reader::of_port(reader, wiring.service.history)).collect(),
            wait_limit: Duration::from_millis(wiring.wait_limit_millis),
            own_first: None,
            own_last: None,
        })
    }

    fn slot(&self) -> &OutputSlot {
        self.cursors.output(self.slot)
    }

    /// The last sample that every lossless reader has answered, and every reader of an answer to it: an instance that takes
    /// over goes on after it, so that no sample is lost that died with its publisher.
    pub fn answered(&self) -> Option<SampleId> {
        let last = self.slot().key();
        let least = self.least_answered(last).unwrap_or(last);
        // The samples of this very publisher lie in the readers' queues and in its history.
        match (least, self.own_last) {
            (Some(least), Some(own)) if least.epoch == own.epoch => Some(least.max(own)),
            // An epoch begins when all readers have answered the one before.
            (Some(_), Some(own)) if last.is_some_and(|last| last.epoch == own.epoch) => Some(own),
            (None, own) => own,
            (least, _) => least,
        }
    }

    /// The last sample that need not be sent again: if another instance has handed over, the last that it has sent;
    /// otherwise, the last that the readers have answered.
    pub fn known(&self, is_handed_over: bool) -> Option<SampleId> {
        if is_handed_over { self.last() } else { self.answered() }
    }

    /// The last sample that every lossless reader, and those behind it, have answered; `None` if there is none, or no such
    /// reader.
    pub fn answered_by_readers(&self) -> Option<SampleId> {
        self.least_answered(self.slot().key()).flatten()
    }

    /// The last sample that the reader furthest behind has answered; the outer `None` if there is no reader.
    fn least_answered(&self, last: Option<SampleId>) -> Option<Option<SampleId>> {
        let least = self.readers.iter().filter_map(|reader| reader.least(&self.cursors, last));
        least.reduce(|a, b| further_behind(a, b, last))
    }

    /// Whether there is a reader that the publisher waits for.
    pub fn has_readers(&self) -> bool {
        self.readers.iter().any(|reader| !self.cursors.input(reader.slot).is_given_up())
    }

    /// Tells readers whether its samples come from another machine whose link is cut off.
    pub fn set_cut_off(&self, is_cut_off: bool) {
        self.slot().set_cut_off(is_cut_off);
    }

    /// The last sample that any instance of the node has sent.
    pub fn last(&self) -> Option<SampleId> {
        self.slot().key()
    }

    /// The number of samples that the node has sent, each counted once.
    pub fn n_sent(&self) -> u64 {
        self.slot().n_sent()
    }

    /// Sends a message, written straight into shared memory, once every lossless reader has room for it. While it waits it
    /// calls `should_yield` now and then, and gives up when that returns true.
    ///
    /// # Errors
    /// A reader had no room for longer than the limit, or an error of iceoryx2.
    pub fn send(
        &mut self,
        head: M::Head,
        items: &[M::Item],
        should_yield: &mut dyn FnMut() -> bool,
    ) -> Result<Sent, PortError> {
        self.send_checked(head, items, should_yield, |_| true)
    }

    /// As [`Publisher::send`]; `check` may change the head at the last moment, when the readers have room. If it returns
    /// false, nothing is sent ([`Sent::GaveWay`]).
    ///
    /// # Errors
    /// As [`Publisher::send`].
    pub(crate) fn send_checked(
        &mut self,
        mut head: M::Head,
        items: &[M::Item],
        should_yield: &mut dyn FnMut() -> bool,
        check: impl FnOnce(&mut M::Head) -> bool,
    ) -> Result<Sent, PortError> {
        let key = sample_id(M::header(&head));
        if !self.has_room(&key) && self.wait_for_room(&key, should_yield)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        if !check(&mut head) {
            return Ok(Sent::GaveWay);
        }
        // It is counted first: a publisher that is killed in between sends it again, and it is counted once. The other way
        // round, a reader could answer a sample that is not counted.
        self.slot().commit(key);
        self.sender.send(head, items)?;
        self.own_first = self.own_first.filter(|first| first.epoch == key.epoch).or(Some(key));
        self.own_last = Some(key);
        Ok(Sent::Yes)
    }

    /// Gives readers that have come back the samples that they missed. Call it when there is nothing to send.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn look_for_readers(&mut self) -> Result<(), PortError> {
        self.sender.look_for_readers()
    }

    /// Whether a sample could be sent without waiting. `waited` is the time since the caller first asked: attached readers are given up
    /// after their time.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn has_room_for(&mut self, header: &Header, waited: Duration) -> Result<bool, PortError> {
        let key = sample_id(header);
        if self.has_room(&key) {
            return Ok(true);
        }
        self.give_up_attached(&key, waited);
        self.sender.look_for_readers()?;
        Ok(self.has_room(&key))
    }

    fn has_room(&mut self, key: &SampleId) -> bool {
        self.first_without_room(key).is_none()
    }

    /// The first reader that has no room for a sample, if there is one.
    fn first_without_room(&mut self, key: &SampleId) -> Option<&Reader> {
        let own_first = self.own_first.filter(|first| first.epoch == key.epoch).map_or(key.seq, |first| first.seq);
        let next = Next { key: *key, last: self.slot().key(), own_first };
        let cursors = &self.cursors;
        self.readers.iter_mut().find_map(|reader| (!reader.has_room(cursors, &next)).then_some(&*reader))
    }

    /// Gives up the attached readers that have had no room for a sample for longer than their time, with all their readers: the other
    /// ports need not wait for them as well.
    fn give_up_attached(&mut self, key: &SampleId, waited: Duration) {
        let cursors = Arc::clone(&self.cursors);
        while let Some(reader) = self.first_without_room(key) {
            if reader.attached_slots.is_empty() || waited <= reader.attached_limit {
                return;
            }
            reader.attached_slots.iter().for_each(|slot| cursors.input(*slot).give_up(true));
        }
    }

    /// How long the publisher waits for its readers before it fails.
    pub(crate) fn wait_limit(&self) -> Duration {
        self.wait_limit
    }

    /// Counts time for which the node waited for its readers.
    pub(crate) fn has_waited(&self, time: Duration) {
        self.slot().add_blocked(time.as_nanos() as u64);
    }

    /// Whether attached readers alone have not answered a sample that was sent. Those that have had longer than their time are given up.
    pub(crate) fn give_up_attached_that_lack(&self, key: SampleId, waited: Duration) -> bool {
        let last = self.slot().key();
        let lacks = |reader: &Reader| match reader.least(&self.cursors, last) {
            None => false,
            Some(None) => true,
            Some(Some(place)) if place.epoch == key.epoch => place.seq < key.seq,
            // A reader in an earlier epoch is behind.
            Some(Some(place)) => last.is_none_or(|last| place.epoch != last.epoch),
        };
        let behind: Vec<&Reader> = self.readers.iter().filter(|reader| lacks(reader)).collect();
        if behind.is_empty() || behind.iter().any(|reader| reader.attached_slots.is_empty()) {
            return false;
        }
        for reader in behind {
            if waited > reader.attached_limit {
                reader.attached_slots.iter().for_each(|slot| self.cursors.input(*slot).give_up(true));
            }
        }
        true
    }

    fn wait_for_room(&mut self, key: &SampleId, should_yield: &mut dyn FnMut() -> bool) -> Result<Sent, PortError> {
        let start = Instant::now();
        let mut last_look = start;
        let (mut last_try, mut waited) = (start, Duration::ZERO);
        let mut n_tries = 0;
        let outcome = loop {
            if self.has_room(key) {
                break Ok(Sent::Yes);
            }
            n_tries += 1;
            if n_tries < N_YIELDS {
                std::thread::yield_now();
                continue;
            }
            if should_yield() {
                break Ok(Sent::GaveWay);
            }
            let now = Instant::now();
            waited += now.duration_since(std::mem::replace(&mut last_try, now)).min(LONGEST_TRY);
            self.give_up_attached(key, waited);
            if start.elapsed() > self.wait_limit {
                break Err(PortError::Stalled {
                    service: self.sender.service.clone(),
                    seq: key.seq,
                    limit_millis: self.wait_limit.as_millis(),
                });
            }
            if last_look.elapsed() > LOOK_PAUSE {
                last_look = Instant::now();
                self.sender.look_for_readers()?;
            }
            std::thread::sleep(RETRY_PAUSE);
        };
        self.slot().add_blocked(start.elapsed().as_nanos() as u64);
        outcome
    }
}

/// The output of a standby, for comparison. It waits for no reader.
pub struct ShadowPublisher<M: Message> {
    sender: Sender<M>,
}

impl<M: Message> ShadowPublisher<M> {
    /// Opens the port.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn open(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        max_items: usize,
    ) -> Result<Self, PortError> {
        let sender =
            Sender::open(node, cursors, &[COMPARE_BELL], &wiring.shadow, max_items, AllocationStrategy::Static)?;
        Ok(ShadowPublisher { sender })
    }

    /// As [`ShadowPublisher::open`], for messages whose largest number of items is unknown.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub(crate) fn open_growing(
        node: &Node<ipc::Service>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
    ) -> Result<Self, PortError> {
        let strategy = AllocationStrategy::PowerOfTwo;
        let sender = Sender::open(node, cursors, &[COMPARE_BELL], &wiring.shadow, N_FIRST_ITEMS, strategy)?;
        Ok(ShadowPublisher { sender })
    }

    /// Sends a message to the readers that are there.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn send(&self, head: M::Head, items: &[M::Item]) -> Result<(), PortError> {
        self.sender.send(head, items)
    }
}
