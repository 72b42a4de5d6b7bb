//! The sending end of an edge.

use std::cell::Cell;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node};
use iceoryx2::service::port_factory::PortFactory;

use super::bytes::{Envelope, Layout, Parts, Word};
use super::service::{self, Connections, PubSub};
use super::{PortError, sample_id};
use crate::credit::{Credit, Reader};
use crate::cursors::{COMPARE_BELL, OutputSlot, SampleId, SharedCursors};
use crate::private_service::PrivateService;
use crate::sequencer::START_HOLD_LIMIT;
use crate::wiring::{OutputWiring, ServiceWiring};
use crate::written::Written;
use blindgrasp_messages::{Header, Message};

/// A waiting publisher yields so often before it sleeps between tries, and gives heartbeats.
const N_YIELDS: u32 = 64;
/// On a busy machine it yields no longer: each time may last as long as others want to run.
const YIELD_LIMIT: Duration = Duration::from_millis(5);
/// A waiting publisher then sleeps so long between tries.
const RETRY_PAUSE: Duration = Duration::from_micros(50);
/// A waiting publisher looks so often for readers that have come back.
const LOOK_PAUSE: Duration = Duration::from_millis(1);
/// A longer pause between two tries counts as this much: while the whole machine stands still, no attached reader is slow.
const LONGEST_TRY: Duration = Duration::from_millis(5);
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
struct Sender {
    service: String,
    pub_sub: PubSub,
    publisher: iceoryx2::port::publisher::Publisher<PrivateService, [Word], Envelope>,
    cursors: Arc<SharedCursors>,
    /// The slots of the bells that wake its readers.
    bells: Vec<usize>,
    n_subscribers: usize,
    connections: Connections,
    /// Whether its readers were not woken for a sample.
    is_unrung: Cell<bool>,
}

/// The memory for the samples of a message.
struct Room {
    layout: Layout,
    n_items: usize,
    strategy: AllocationStrategy,
}

impl Room {
    /// Without a limit of items, a larger message takes more memory.
    fn of<M: Message>(max_items: Option<usize>) -> Room {
        let strategy = if max_items.is_some() { AllocationStrategy::Static } else { AllocationStrategy::PowerOfTwo };
        Room { layout: Layout::of::<M>(), n_items: max_items.unwrap_or(N_FIRST_ITEMS), strategy }
    }
}

impl Sender {
    fn open(
        node: &Node<PrivateService>,
        cursors: &Arc<SharedCursors>,
        bells: &[usize],
        wiring: &ServiceWiring,
        room: &Room,
    ) -> Result<Self, PortError> {
        let pub_sub = service::pub_sub(node, wiring, room.layout.type_name)?;
        let connections = Connections::default();
        let publisher = pub_sub
            .publisher_builder()
            .set_degradation_handler(connections.handler())
            .initial_max_slice_len(room.layout.n_words(room.n_items))
            .allocation_strategy(room.strategy)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| service::open_failed(wiring, error))?;
        let (service, cursors, bells) = (wiring.name.clone(), Arc::clone(cursors), bells.to_vec());
        Ok(Sender {
            service,
            pub_sub,
            publisher,
            cursors,
            bells,
            n_subscribers: 0,
            connections,
            is_unrung: Cell::new(false),
        })
    }

    fn send(&self, seq: u64, parts: &Parts<'_>) -> Result<(), PortError> {
        let failed = |source| PortError::new(&self.service, format!("cannot send sample {seq}"), Some(source));
        let mut sample = self.publisher.loan_slice(parts.n_words()).map_err(|error| failed(error.into()))?;
        *sample.user_header_mut() = parts.envelope();
        parts.write(sample.payload_mut());
        sample.send().map_err(|error| failed(error.into()))?;
        self.is_unrung.set(true);
        Ok(())
    }

    fn ring(&self) {
        self.is_unrung.set(false);
        self.bells.iter().for_each(|slot| self.cursors.bell(*slot).ring());
    }

    /// Gives the history to readers that have come since the last sample, and wakes them.
    fn look_for_readers(&mut self) -> Result<(), PortError> {
        let n_subscribers = self.pub_sub.dynamic_config().number_of_subscribers();
        let failed = |source| PortError::new(&self.service, "cannot be connected", Some(source));
        self.publisher.update_connections().map_err(|error| failed(error.into()))?;
        let (pub_sub, publisher) = (&self.pub_sub, &self.publisher);
        let mended = self.connections.mend(|| {
            // A port that comes and goes lets iceoryx2 look at all of them again.
            pub_sub.subscriber_builder().buffer_size(1).create().is_ok() && publisher.update_connections().is_ok()
        });
        mended.map_err(|error| failed(error.into()))?;
        if std::mem::replace(&mut self.n_subscribers, n_subscribers) != n_subscribers {
            self.ring();
        }
        Ok(())
    }
}

/// The sending end of an edge.
pub struct Publisher<M: Message> {
    port: UntypedPublisher,
    message: PhantomData<M>,
}

impl<M: Message> Deref for Publisher<M> {
    type Target = UntypedPublisher;

    fn deref(&self) -> &UntypedPublisher {
        &self.port
    }
}

impl<M: Message> DerefMut for Publisher<M> {
    fn deref_mut(&mut self) -> &mut UntypedPublisher {
        &mut self.port
    }
}

impl<M: Message> Publisher<M> {
    /// Opens the port, for messages of up to `max_items` items. If their largest number is unknown, a larger message takes more
    /// memory.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn open(
        node: &Node<PrivateService>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        max_items: Option<usize>,
    ) -> Result<Self, PortError> {
        let port = UntypedPublisher::open(node, cursors, wiring, &Room::of::<M>(max_items))?;
        Ok(Publisher { port, message: PhantomData })
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
        let key = sample_id(M::header(&head));
        if self.port.wait_for_room(key, should_yield)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        self.port.send_now(key, &Parts::of::<M>(&head, items))?;
        Ok(Sent::Yes)
    }

    /// The port without the type of its message.
    pub(crate) fn into_untyped(self) -> UntypedPublisher {
        self.port
    }
}

/// The sending end of an edge, whatever its message.
pub struct UntypedPublisher {
    sender: Sender,
    slot: usize,
    credit: Credit,
    wait_limit: Duration,
    /// The slots of the readers in this process, which cannot go on while this publisher waits.
    own_readers: Vec<usize>,
    /// See [`Credit::has_sent_all`].
    has_sent_all: Arc<AtomicBool>,
    /// The last sample that had no room at first, and since when.
    waits_since: Option<(SampleId, Instant)>,
    /// See [`UntypedPublisher::delay_bells`].
    delays_bells: bool,
}

impl UntypedPublisher {
    fn open(
        node: &Node<PrivateService>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        room: &Room,
    ) -> Result<Self, PortError> {
        Ok(UntypedPublisher {
            sender: Sender::open(node, cursors, &wiring.bells, &wiring.service, room)?,
            slot: wiring.slot,
            credit: Credit::new(&wiring.consumers, wiring.service.history),
            wait_limit: Duration::from_millis(wiring.wait_limit_millis),
            own_readers: Vec::new(),
            has_sent_all: Arc::new(AtomicBool::new(true)),
            waits_since: None,
            delays_bells: false,
        })
    }

    /// Whether it sends the next samples without waking their readers: see [`UntypedPublisher::ring_if_due`].
    pub(crate) fn delay_bells(&mut self, delays: bool) {
        self.delays_bells = delays;
    }

    /// Wakes the readers of samples that were sent without.
    pub(crate) fn ring_if_due(&self) {
        if self.sender.is_unrung.get() {
            self.sender.ring();
        }
    }

    fn slot(&self) -> &OutputSlot {
        self.sender.cursors.output(self.slot)
    }

    /// Names the readers in this process, by their slots: the publisher gives way at once if one of them has no room.
    pub(crate) fn shares_process_with(&mut self, slots: Vec<usize>) {
        self.own_readers = slots;
    }

    /// Whether an instance that takes over from this one finds all samples that are not answered in its memory, or in that of
    /// one before it.
    pub(crate) fn has_sent_all(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.has_sent_all)
    }

    /// Takes over: returns the last sample that need not be sent again. If another instance has handed over, that is the last
    /// one that it has sent; otherwise, the last one that the readers, and those behind them, have answered.
    pub fn begin(&mut self, is_handed_over: bool) -> Option<SampleId> {
        let written = self.written();
        self.waits_since = None;
        let known = self.credit.begin(is_handed_over, &*self.sender.cursors, written);
        self.has_sent_all.store(self.credit.has_sent_all(written), Ordering::Relaxed);
        known
    }

    /// The last sample that every lossless reader, and those behind it, have answered; `None` if there is none, or no such
    /// reader.
    pub fn answered_by_readers(&self) -> Option<SampleId> {
        self.credit.answered_by_readers(&*self.sender.cursors, self.written())
    }

    /// Whether there is a reader that the publisher waits for.
    pub fn has_readers(&self) -> bool {
        self.credit.has_readers(&*self.sender.cursors)
    }

    /// How far the instances of the node have come.
    pub(crate) fn written(&self) -> Option<Written> {
        self.slot().written()
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

    /// As [`UntypedPublisher::send_now`], of a head and items in bytes.
    pub(crate) fn send_bytes(&mut self, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError> {
        self.send_now(key, &Parts::of_bytes(head, items))
    }

    /// Counts a sample and sends it. The readers have room for it.
    fn send_now(&mut self, key: SampleId, parts: &Parts<'_>) -> Result<(), PortError> {
        // It is counted first: a publisher that is killed in between sends it again, and it is counted once. The other way
        // round, a reader could answer a sample that is not counted.
        self.slot().commit(key);
        self.sender.send(key.seq, parts)?;
        if !self.delays_bells {
            self.sender.ring();
        }
        self.credit.has_sent(key);
        if !self.has_sent_all.load(Ordering::Relaxed) {
            self.has_sent_all.store(self.credit.has_sent_all(self.written()), Ordering::Relaxed);
        }
        Ok(())
    }

    /// Gives readers that have come back the samples that they missed. Call it when there is nothing to send.
    ///
    /// # Errors
    /// An error of iceoryx2, or readers lack samples that died with the instance that has handed over: this one must begin
    /// again, so that it sends them.
    pub fn look_for_readers(&mut self) -> Result<(), PortError> {
        self.sender.look_for_readers()?;
        let n_publishers = self.sender.pub_sub.dynamic_config().number_of_publishers();
        match self.credit.lost_predecessor(&*self.sender.cursors, self.written(), n_publishers) {
            Some(SampleId { seq, .. }) => {
                let what = format!(
                    "has readers that lack samples up to {seq}, which ended with the instance that has handed over: this one \
                     begins again after their last sample"
                );
                Err(PortError::new(&self.sender.service, what, None))
            }
            None => Ok(()),
        }
    }

    /// Whether a sample could be sent without waiting. `waited` is the time since the caller first asked: attached readers are given up
    /// after their time.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn has_room_for(&mut self, header: &Header, waited: Duration) -> Result<bool, PortError> {
        let key = sample_id(header);
        if self.has_room(key) {
            return Ok(true);
        }
        self.give_up_attached(key, waited);
        self.pass_lost_samples(waited);
        self.look_for_readers()?;
        Ok(self.has_room(key))
    }

    fn has_room(&mut self, key: SampleId) -> bool {
        let written = self.written();
        self.credit.first_without_room(&*self.sender.cursors, written, key).is_none()
    }

    /// Gives up the attached readers that have had no room for a sample for longer than their time, with all their readers:
    /// the other ports need not wait for them as well.
    fn give_up_attached(&mut self, key: SampleId, waited: Duration) {
        let written = self.written();
        while let Some(reader) = self.credit.first_without_room(&*self.sender.cursors, written, key) {
            if !gives_up(reader, waited, &self.sender.cursors) {
                return;
            }
        }
    }

    /// Begins the next epoch without the last samples of the one before, if no publisher has them any more.
    fn pass_lost_samples(&mut self, waited: Duration) {
        if waited > START_HOLD_LIMIT.min(self.wait_limit / 2) {
            let n_publishers = self.sender.pub_sub.dynamic_config().number_of_publishers();
            let written = self.written();
            self.credit.has_waited_long(&*self.sender.cursors, written, n_publishers);
        }
    }

    /// Waits until every lossless reader has room for a sample. While it waits it calls `should_yield` now and then, and gives
    /// up when that returns true.
    ///
    /// # Errors
    /// A reader had no room for longer than the limit, or an error of iceoryx2.
    pub(crate) fn wait_for_room(
        &mut self,
        key: SampleId,
        should_yield: &mut dyn FnMut() -> bool,
    ) -> Result<Sent, PortError> {
        if self.has_room(key) {
            return Ok(Sent::Yes);
        }
        // A publisher that gives way to its reader, in one process, comes back with the same sample.
        let since = match self.waits_since {
            Some((waiting, since)) if waiting == key => since,
            _ => Instant::now(),
        };
        self.waits_since = Some((key, since));
        self.wait(key, should_yield, |publisher, waited| {
            publisher.pass_lost_samples(since.elapsed());
            if publisher.has_room(key) {
                return Wait::Over;
            }
            publisher.give_up_attached(key, waited);
            let written = publisher.written();
            let own_readers = &publisher.own_readers;
            if publisher.credit.waits_for_one_of(own_readers, &*publisher.sender.cursors, written, key) {
                return Wait::InVain;
            }
            Wait::On
        })
    }

    /// Waits until the readers, and those behind them, have answered a sample that was sent. While it waits it calls
    /// `should_yield` now and then, and gives up when that returns true.
    ///
    /// # Errors
    /// A reader did not answer within the limit, or an error of iceoryx2.
    pub(crate) fn wait_for_answers(
        &mut self,
        key: SampleId,
        should_yield: &mut dyn FnMut() -> bool,
    ) -> Result<Sent, PortError> {
        self.wait(key, should_yield, |publisher, waited| {
            let behind = publisher.credit.readers_that_lack(key, &*publisher.sender.cursors, publisher.written());
            if behind.is_empty() {
                return Wait::Over;
            }
            if behind.iter().any(|reader| reader.is_among(&publisher.own_readers)) {
                return Wait::InVain;
            }
            if behind.iter().all(|reader| !reader.attached_slots.is_empty()) {
                for reader in behind {
                    gives_up(reader, waited, &publisher.sender.cursors);
                }
            }
            Wait::On
        })
    }

    fn wait(
        &mut self,
        key: SampleId,
        should_yield: &mut dyn FnMut() -> bool,
        mut look: impl FnMut(&mut Self, Duration) -> Wait,
    ) -> Result<Sent, PortError> {
        self.ring_if_due();
        let start = Instant::now();
        let mut last_look = start;
        let (mut last_try, mut waited) = (start, Duration::ZERO);
        let mut n_tries = 0;
        let outcome = loop {
            match look(self, waited) {
                Wait::Over => break Ok(Sent::Yes),
                Wait::InVain => break Ok(Sent::GaveWay),
                Wait::On => {}
            }
            n_tries += 1;
            if n_tries < N_YIELDS && start.elapsed() < YIELD_LIMIT {
                std::thread::yield_now();
                continue;
            }
            if should_yield() {
                break Ok(Sent::GaveWay);
            }
            let now = Instant::now();
            waited += now.duration_since(std::mem::replace(&mut last_try, now)).min(LONGEST_TRY);
            if start.elapsed() > self.wait_limit {
                let (seq, millis) = (key.seq, self.wait_limit.as_millis());
                let what =
                    format!("could not deliver sample {seq} within {millis} ms: a reader is stopped or too slow");
                break Err(PortError::new(&self.sender.service, what, None));
            }
            if last_look.elapsed() > LOOK_PAUSE {
                last_look = Instant::now();
                self.look_for_readers()?;
            }
            std::thread::sleep(RETRY_PAUSE);
        };
        self.slot().add_blocked(start.elapsed().as_nanos() as u64);
        outcome
    }
}

/// The outcome of a look at the readers.
enum Wait {
    Over,
    /// The reader cannot go on while the publisher waits.
    InVain,
    On,
}

/// Gives up an attached reader, with all its readers, if it has had longer than its time.
fn gives_up(reader: &Reader, waited: Duration, cursors: &SharedCursors) -> bool {
    let limit = Duration::from_millis(reader.attached_limit_millis);
    if reader.attached_slots.is_empty() || waited <= limit {
        return false;
    }
    reader.attached_slots.iter().for_each(|slot| cursors.input(*slot).give_up(true));
    true
}

/// The output of a standby, for comparison. It waits for no reader.
pub(crate) struct ShadowPublisher(Sender);

impl ShadowPublisher {
    /// Opens the port, as [`Publisher::open`].
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub(crate) fn open<M: Message>(
        node: &Node<PrivateService>,
        cursors: &Arc<SharedCursors>,
        wiring: &OutputWiring,
        max_items: Option<usize>,
    ) -> Result<Self, PortError> {
        let sender = Sender::open(node, cursors, &[COMPARE_BELL], &wiring.shadow, &Room::of::<M>(max_items))?;
        Ok(ShadowPublisher(sender))
    }

    /// Sends a sample to the readers that are there.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub(crate) fn send_bytes(&self, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError> {
        self.0.send(key.seq, &Parts::of_bytes(head, items))?;
        self.0.ring();
        Ok(())
    }
}
