//! Publisher and subscriber of one message type over iceoryx2.
//!
//! A port is a publish-subscribe service and an event service of one name, with safe overflow: iceoryx2 itself never
//! blocks, and a reader that is behind keeps its newest samples. What makes an edge lossless is credit: the publisher
//! reads on the [board](crate::board) how far each reader has come that it must not lose, and waits, for a bounded
//! time, before it overtakes one by more than its capacity. Its history reaches back as far, so a reader that comes
//! back after a crash, or takes over in a swap, still finds all that nobody has answered. A reader on a `latest` edge,
//! a tool or a standby is on nobody's list: it can be as slow as it likes.
//!
//! A trap of iceoryx2 0.10: a subscriber that exists but has not looked for its publishers yet gets samples up to its
//! buffer's size, and what comes then is dropped without an error. Within the credit that cannot happen.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node, ServiceName, ipc};
use iceoryx2::sample::Sample;
use iceoryx2::service::port_factory::{PortFactory, event, publish_subscribe};

use crate::board::{Board, Key, OutputCell};
use crate::monotonic_nanos;
use crate::sequencer::{Sequencer, Verdict};
use crate::wiring::EdgePolicy;
use crate::wiring::{ConsumerWiring, InputCounts, InputWiring, OutputWiring, ServiceWiring};
use blindgrasp_messages::{Header, Message};

/// How often a waiting publisher yields before it sleeps between tries.
const N_YIELDS: u32 = 64;
/// How long a waiting publisher sleeps between tries after that.
const RETRY_PAUSE: Duration = Duration::from_micros(50);
/// How often a waiting publisher looks for readers that have come back.
const LOOK_PAUSE: Duration = Duration::from_millis(1);
/// How long a publisher waits for a guest that is a whole capacity behind before it gives it up: well below the 200 ms
/// after which an arbiter holds by default, so that whoever records a graph cannot stop it.
pub const GUEST_LIMIT: Duration = Duration::from_millis(100);
/// The most that a pause between two tries counts: while the whole machine stands still, no guest is slow.
const LONGEST_TRY: Duration = Duration::from_millis(1);

/// How often a service is opened before that counts as failed, and how long after each time.
const N_OPENINGS: u32 = 20;
const OPENING_PAUSE: Duration = Duration::from_millis(10);
/// How many items a publisher that grows has room for at first.
const N_FIRST_ITEMS: usize = 64;

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

/// Which sample a header names.
pub fn key_of(header: &Header) -> Key {
    Key { epoch: header.epoch, seq: header.seq }
}

/// What became of a sample that was to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub enum Sent {
    /// It is on its way.
    Yes,
    /// The publisher was waiting for a reader when it was asked to give way: the sample was not sent.
    GaveWay,
}

/// A publisher without an eye on its readers: the bare port.
struct Sender<M: Message> {
    service: String,
    pub_sub: PubSub<M>,
    publisher: iceoryx2::port::publisher::Publisher<ipc::Service, [M::Item], M::Head>,
    notifier: Notifier<ipc::Service>,
    n_subscribers: usize,
}

impl<M: Message> Sender<M> {
    fn open(
        node: &Node<ipc::Service>,
        wiring: &ServiceWiring,
        max_items: usize,
        strategy: AllocationStrategy,
    ) -> Result<Self, PortError> {
        let refused = |message: String| PortError { service: wiring.name.clone(), message };
        let pub_sub = pub_sub::<M>(node, wiring)?;
        let publisher = pub_sub
            .publisher_builder()
            .initial_max_slice_len(max_items.max(1))
            .allocation_strategy(strategy)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| refused(format!("{error:?}")))?;
        let notifier =
            events(node, wiring)?.notifier_builder().create().map_err(|error| refused(format!("{error:?}")))?;
        Ok(Sender { service: wiring.name.clone(), pub_sub, publisher, notifier, n_subscribers: 0 })
    }

    fn send(&self, head: M::Head, items: &[M::Item]) -> Result<(), PortError> {
        let refused = |error: String| PortError {
            service: self.service.clone(),
            message: format!("sample {} could not be sent: {error}", M::header(&head).seq),
        };
        let mut sample =
            self.publisher.loan_slice_uninit(items.len()).map_err(|error| refused(format!("{error:?}")))?;
        *sample.user_header_mut() = head;
        sample.write_from_slice(items).send().map_err(|error| refused(format!("{error:?}")))?;
        // A listener that went away is no error: its subscriber is gone as well.
        let _ = self.notifier.notify();
        Ok(())
    }

    /// Gives the history to readers that have come since the last sample, and wakes them.
    fn look_for_readers(&mut self) -> Result<(), PortError> {
        let n_subscribers = self.pub_sub.dynamic_config().number_of_subscribers();
        self.publisher
            .update_connections()
            .map_err(|error| PortError { service: self.service.clone(), message: format!("{error:?}") })?;
        if std::mem::replace(&mut self.n_subscribers, n_subscribers) != n_subscribers {
            let _ = self.notifier.notify();
        }
        Ok(())
    }
}

/// The sending end of an edge.
pub struct Publisher<M: Message> {
    sender: Sender<M>,
    board: Arc<Board>,
    cell: usize,
    consumers: Vec<Consumer>,
    wait_limit: Duration,
    /// The first sample that this publisher, and not an earlier one, has sent.
    own_first: Option<Key>,
    /// The last one.
    own_last: Option<Key>,
}

/// A reader that the publisher waits for.
struct Consumer {
    wiring: ConsumerWiring,
    /// How far it was when last looked at.
    key: Option<Key>,
}

impl<M: Message> Publisher<M> {
    /// Opens the port, for messages of up to `max_items` items.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open(
        node: &Node<ipc::Service>,
        board: &Arc<Board>,
        wiring: &OutputWiring,
        max_items: usize,
    ) -> Result<Self, PortError> {
        Self::open_with(node, board, wiring, max_items, AllocationStrategy::Static)
    }

    /// As [`Publisher::open`], for messages of which nobody knows how many items they may have: when one has more than
    /// any before, more memory is taken.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open_growing(
        node: &Node<ipc::Service>,
        board: &Arc<Board>,
        wiring: &OutputWiring,
    ) -> Result<Self, PortError> {
        Self::open_with(node, board, wiring, N_FIRST_ITEMS, AllocationStrategy::PowerOfTwo)
    }

    fn open_with(
        node: &Node<ipc::Service>,
        board: &Arc<Board>,
        wiring: &OutputWiring,
        max_items: usize,
        strategy: AllocationStrategy,
    ) -> Result<Self, PortError> {
        Ok(Publisher {
            sender: Sender::open(node, &wiring.service, max_items, strategy)?,
            board: Arc::clone(board),
            cell: wiring.cell,
            consumers: wiring.consumers.iter().map(|wiring| Consumer { wiring: wiring.clone(), key: None }).collect(),
            wait_limit: Duration::from_millis(wiring.wait_limit_millis),
            own_first: None,
            own_last: None,
        })
    }

    fn cell(&self) -> &OutputCell {
        self.board.output(self.cell)
    }

    /// The last sample that every lossless reader has answered, and whether there are such readers: where whoever takes
    /// over has to go on, so that nothing is lost that died with its publisher.
    pub fn answered(&self) -> Option<Key> {
        let last = self.cell().key();
        let least = self.least_answered(last);
        let least = least.unwrap_or(last);
        // What this very publisher has sent lies in the readers' queues.
        match (least, self.own_last) {
            (Some(least), Some(own)) if least.epoch == own.epoch => Some(least.max(own)),
            (None, own) => own,
            (least, _) => least,
        }
    }

    /// The last sample that every lossless reader has answered; `None` if there is none, or no such reader.
    pub fn answered_by_readers(&self) -> Option<Key> {
        self.least_answered(self.cell().key()).flatten()
    }

    /// The place of the reader that is furthest behind; the outer `None` if there is no reader.
    fn least_answered(&self, last: Option<Key>) -> Option<Option<Key>> {
        let place = |consumer: &Consumer| self.board.input(consumer.wiring.cell).key();
        let live = self.consumers.iter().filter(|consumer| !self.board.input(consumer.wiring.cell).is_given_up());
        live.map(place).reduce(|a, b| match (a, b, last) {
            (Some(a), Some(b), _) if a.epoch == b.epoch => Some(a.min(b)),
            // One is in the epoch before the last: it is the one behind.
            (Some(a), Some(b), Some(last)) => Some(if a.epoch == last.epoch { b } else { a }),
            _ => None,
        })
    }

    /// Whether a reader is waited for.
    pub fn has_readers(&self) -> bool {
        self.consumers.iter().any(|consumer| !self.board.input(consumer.wiring.cell).is_given_up())
    }

    /// Says whether its samples come from another machine and the link to that is cut off: readers may want to know.
    pub fn set_cut_off(&self, is_cut_off: bool) {
        self.cell().set_cut_off(is_cut_off);
    }

    /// The last sample that any instance of the node has sent.
    pub fn last(&self) -> Option<Key> {
        self.cell().key()
    }

    /// Samples that the node has sent, each counted once.
    pub fn n_sent(&self) -> u64 {
        self.cell().n_sent()
    }

    /// Sends a message, written straight into shared memory, once every lossless reader has room for it. While it waits
    /// it calls `is_to_give_way` now and then, and gives up when that says so.
    ///
    /// # Errors
    /// A reader had no room for longer than the limit, or iceoryx2's reason.
    pub fn send(
        &mut self,
        head: M::Head,
        items: &[M::Item],
        is_to_give_way: &mut dyn FnMut() -> bool,
    ) -> Result<Sent, PortError> {
        let key = key_of(M::header(&head));
        if !self.has_room(&key) && self.wait_for_room(&key, is_to_give_way)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        // Counted first: whoever is killed in between sends it again, and it is counted once. The other way round a reader
        // could have answered a sample that nobody has counted.
        self.cell().commit(key);
        self.sender.send(head, items)?;
        self.own_first = self.own_first.filter(|first| first.epoch == key.epoch).or(Some(key));
        self.own_last = Some(key);
        Ok(Sent::Yes)
    }

    /// To be called when there is nothing to send: readers that have come back get what they missed.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn look_for_readers(&mut self) -> Result<(), PortError> {
        self.sender.look_for_readers()
    }

    /// Whether a sample could be sent without waiting, for a publisher that must not wait. `waited` is for how long it has
    /// asked: guests are given up after [`GUEST_LIMIT`].
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn has_room_for(&mut self, header: &Header, waited: Duration) -> Result<bool, PortError> {
        let key = key_of(header);
        if self.has_room(&key) {
            return Ok(true);
        }
        if waited > GUEST_LIMIT {
            self.give_up_guests(&key);
        }
        self.sender.look_for_readers()?;
        Ok(self.has_room(&key))
    }

    fn has_room(&mut self, key: &Key) -> bool {
        self.first_without_room(key).is_none()
    }

    /// The first reader that has no room for a sample, if there is one.
    fn first_without_room(&mut self, key: &Key) -> Option<&ConsumerWiring> {
        let last = self.cell().key();
        // What an earlier publisher has sent lies in a queue of its own, or has died with it: waiting for a reader to answer
        // that could be waiting for ever.
        let own_first = self.own_first.filter(|first| first.epoch == key.epoch).map_or(key.seq, |first| first.seq);
        let board = &self.board;
        let has_room = |consumer: &mut Consumer| {
            // However far the numbers jump: a reader that has answered all has room for one more.
            let is_within = |first_unanswered: u64| {
                key.seq.saturating_sub(first_unanswered.max(own_first)) < consumer.wiring.capacity as u64
            };
            let is_near = |place: &Option<Key>| match (place, &last) {
                (Some(place), last) if place.epoch == key.epoch => is_within(place.seq + 1) || *last == Some(*place),
                // A new epoch begins when everybody has answered the one before.
                (Some(place), Some(last)) => place == last,
                (None, Some(last)) => last.epoch == key.epoch && is_within(0),
                (Some(_) | None, None) => true,
            };
            if is_near(&consumer.key) && consumer.key.is_some() {
                return true;
            }
            let cell = board.input(consumer.wiring.cell);
            consumer.key = cell.key();
            is_near(&consumer.key) || cell.is_given_up()
        };
        self.consumers.iter_mut().find_map(|consumer| (!has_room(consumer)).then_some(&consumer.wiring))
    }

    /// Gives up the guests that have no room for a sample, with all their readers: the others need not wait as well.
    fn give_up_guests(&mut self, key: &Key) {
        let board = Arc::clone(&self.board);
        while let Some(consumer) = self.first_without_room(key) {
            if consumer.guest_cells.is_empty() {
                return;
            }
            consumer.guest_cells.iter().for_each(|cell| board.input(*cell).give_up(true));
        }
    }

    fn wait_for_room(&mut self, key: &Key, is_to_give_way: &mut dyn FnMut() -> bool) -> Result<Sent, PortError> {
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
            if is_to_give_way() {
                break Ok(Sent::GaveWay);
            }
            let now = Instant::now();
            waited += now.duration_since(std::mem::replace(&mut last_try, now)).min(LONGEST_TRY);
            if waited > GUEST_LIMIT {
                self.give_up_guests(key);
            }
            if start.elapsed() > self.wait_limit {
                break Err(PortError {
                    service: self.sender.service.clone(),
                    message: format!(
                        "sample {} could not be delivered within {} ms: a reader is stopped or too slow",
                        key.seq,
                        self.wait_limit.as_millis()
                    ),
                });
            }
            if last_look.elapsed() > LOOK_PAUSE {
                last_look = Instant::now();
                self.sender.look_for_readers()?;
            }
            std::thread::sleep(RETRY_PAUSE);
        };
        self.cell().add_blocked(start.elapsed().as_nanos() as u64);
        outcome
    }
}

/// Where a standby says what it would have said: nobody waits for anybody.
pub struct ShadowPublisher<M: Message> {
    sender: Sender<M>,
}

impl<M: Message> ShadowPublisher<M> {
    /// Opens the port.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open(node: &Node<ipc::Service>, wiring: &OutputWiring, max_items: usize) -> Result<Self, PortError> {
        Ok(ShadowPublisher { sender: Sender::open(node, &wiring.shadow, max_items, AllocationStrategy::Static)? })
    }

    /// Sends a message to whoever listens.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn send(&self, head: M::Head, items: &[M::Item]) -> Result<(), PortError> {
        self.sender.send(head, items)
    }
}

/// The receiving end of an edge.
pub struct Subscriber<M: Message> {
    service: String,
    pub_sub: PubSub<M>,
    subscriber: iceoryx2::port::subscriber::Subscriber<ipc::Service, [M::Item], M::Head>,
    /// `None` if it is not to be woken.
    listener: Option<Listener<ipc::Service>>,
    board: Option<(Arc<Board>, usize)>,
    writer_cell: usize,
    deadline_nanos: Option<u64>,
    /// Whether samples wait for those before them: on an edge that drops them, these may never come.
    may_hold: bool,
    /// How many samples may wait: iceoryx2 lends no more.
    max_held: usize,
    /// A sample that was taken and not answered.
    put_back: Option<(Key, PortSample<M>)>,
    sequencer: Sequencer<PortSample<M>>,
}

impl<M: Message> Subscriber<M> {
    /// Opens the port. On the board it has a place if the wiring gives it one and there is a board: it then goes on where
    /// [`Subscriber::take_over`] says, otherwise it looks on.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open(
        node: &Node<ipc::Service>,
        board: Option<&Arc<Board>>,
        wiring: &InputWiring,
    ) -> Result<Self, PortError> {
        // The listener first: whoever sees the subscriber can already wake it.
        let listener = events(node, &wiring.service)?
            .listener_builder()
            .create()
            .map_err(|error| PortError { service: wiring.service.name.clone(), message: format!("{error:?}") })?;
        Self::open_with(node, board, wiring, Some(listener))
    }

    /// As [`Subscriber::open`], for a reader that looks now and then: no writer spends time on waking it.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn open_unwoken(
        node: &Node<ipc::Service>,
        board: Option<&Arc<Board>>,
        wiring: &InputWiring,
    ) -> Result<Self, PortError> {
        Self::open_with(node, board, wiring, None)
    }

    fn open_with(
        node: &Node<ipc::Service>,
        board: Option<&Arc<Board>>,
        wiring: &InputWiring,
        listener: Option<Listener<ipc::Service>>,
    ) -> Result<Self, PortError> {
        let refused = |message: String| PortError { service: wiring.service.name.clone(), message };
        let pub_sub = pub_sub::<M>(node, &wiring.service)?;
        let subscriber = pub_sub
            .subscriber_builder()
            .buffer_size(wiring.capacity.min(wiring.service.max_capacity))
            .create()
            .map_err(|error| refused(format!("{error:?}")))?;
        let mut subscriber = Subscriber {
            service: wiring.service.name.clone(),
            pub_sub,
            subscriber,
            listener,
            board: board.zip(wiring.cell).map(|(board, cell)| (Arc::clone(board), cell)),
            writer_cell: wiring.writer_cell,
            deadline_nanos: wiring.deadline_nanos,
            may_hold: wiring.policy == EdgePolicy::Lossless,
            max_held: wiring.service.max_capacity,
            put_back: None,
            sequencer: Sequencer::onlooker(),
        };
        subscriber.begin_with(Sequencer::onlooker());
        Ok(subscriber)
    }

    fn begin_with(&mut self, sequencer: Sequencer<PortSample<M>>) {
        let sequencer = if self.may_hold { sequencer } else { sequencer.without_waiting() };
        let before = std::mem::replace(&mut self.sequencer, sequencer);
        // What this very reader has taken and not answered lies nowhere else any more.
        self.sequencer.hold_again(before, self.put_back.take(), Instant::now());
    }

    /// Takes up its end of the connection to its publishers; false if there is none yet.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn connect(&self) -> Result<bool, PortError> {
        self.subscriber
            .update_connections()
            .map_err(|error| PortError { service: self.service.clone(), message: format!("{error:?}") })?;
        Ok(self.pub_sub.dynamic_config().number_of_publishers() > 0)
    }

    /// Goes on where the board says that the node left off. `answered` is up to where its answers have been received.
    pub fn take_over(&mut self, answered: Option<Key>) {
        if let Some((board, cell)) = &self.board {
            let cell = board.input(*cell);
            let sequencer = Sequencer::resume(answered, cell.key(), cell.counts());
            self.begin_with(sequencer);
        }
    }

    /// Goes on after `last`, up to which a saved state knows the stream, with the counts of then.
    pub fn take_over_at(&mut self, last: Option<Key>, counts: InputCounts) {
        if let Some((board, cell)) = &self.board {
            board.input(*cell).commit(last, &counts);
            self.begin_with(Sequencer::resume(last, last, counts));
        }
    }

    /// Looks on from after `last`, which a saved state has seen.
    pub fn look_on_from(&mut self, last: Key) {
        self.begin_with(Sequencer::resume(Some(last), Some(last), InputCounts::default()));
    }

    /// Whether everything that its writer has sent is answered.
    pub fn is_caught_up(&self) -> bool {
        let Some((board, cell)) = &self.board else {
            return true;
        };
        let sent = board.output(self.writer_cell).key();
        let answered = board.input(*cell).key();
        sent.is_none_or(|sent| {
            answered.is_some_and(|answered| answered.epoch == sent.epoch && answered.seq >= sent.seq)
        })
    }

    /// The last sample that its writer has sent.
    pub fn written(&self) -> Option<Key> {
        self.board.as_ref().and_then(|(board, _)| board.output(self.writer_cell).key())
    }

    /// Whether its writer is on another machine, and the link to that is cut off.
    pub fn is_cut_off(&self) -> bool {
        self.board.as_ref().is_some_and(|(board, _)| board.output(self.writer_cell).is_cut_off())
    }

    /// The last sample that any instance of the node has answered.
    pub fn last(&self) -> Option<Key> {
        self.board.as_ref().and_then(|(board, cell)| board.input(*cell).key())
    }

    /// The next sample in order, if one is there.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn receive(&mut self) -> Result<Option<PortSample<M>>, PortError> {
        if let Some(sample) = self.sequencer.next_in_order() {
            return Ok(Some(self.delivered(sample)));
        }
        while self.sequencer.n_held() < self.max_held {
            let sample = self
                .subscriber
                .receive()
                .map_err(|error| PortError { service: self.service.clone(), message: format!("{error:?}") })?;
            let Some(sample) = sample else {
                // Only now: what a held sample waits for may have been lying there.
                let overdue =
                    if self.sequencer.n_held() > 0 { self.sequencer.next_overdue(Instant::now()) } else { None };
                return Ok(overdue.map(|sample| self.delivered(sample)));
            };
            let key = key_of(M::header(sample.user_header()));
            let publisher = sample.header().publisher_id().value();
            let may_reorder = || self.pub_sub.dynamic_config().number_of_publishers() > 1;
            match self.sequencer.push(sample, key, publisher, may_reorder, Instant::now) {
                Verdict::Deliver(sample) => return Ok(Some(self.delivered(sample))),
                Verdict::Hold | Verdict::Drop => {}
            }
        }
        let first = self.sequencer.first_held();
        Ok(first.map(|sample| self.delivered(sample)))
    }

    fn delivered(&mut self, sample: PortSample<M>) -> PortSample<M> {
        let origin_nanos = M::header(sample.user_header()).origin_nanos;
        // What looks on counts nothing, and a sample without a time has no age.
        if let Some((board, cell)) = self.board.as_ref().filter(|_| origin_nanos != 0) {
            let age_nanos = monotonic_nanos().saturating_sub(origin_nanos);
            board.ages(*cell).count(age_nanos);
            if self.deadline_nanos.is_some_and(|limit| age_nanos > limit) {
                self.sequencer.count_late();
            }
        }
        sample
    }

    /// Says that nobody reads on, or that somebody does.
    pub fn give_up(&self, is_given_up: bool) {
        if let Some((board, cell)) = &self.board {
            board.input(*cell).give_up(is_given_up);
        }
    }

    /// Whether the writer waits for this reader no longer.
    pub fn is_given_up(&self) -> bool {
        self.board.as_ref().is_some_and(|(board, cell)| board.input(*cell).is_given_up())
    }

    /// Begins after what its writer has sent so far, and is waited for from now on. The last sample that is not for it.
    pub fn begin_here(&mut self) -> Option<Key> {
        let (board, cell) = self.board.as_ref()?;
        let last = board.output(self.writer_cell).key();
        board.input(*cell).begin_after(last);
        self.begin_with(Sequencer::resume(last, last, InputCounts::default()));
        last
    }

    /// Keeps a sample that was not answered, for when this reader is to go on.
    pub fn put_back(&mut self, sample: PortSample<M>) {
        self.put_back = Some((key_of(M::header(sample.user_header())), sample));
    }

    /// Says that everything up to this sample is answered: its writer may overwrite it, and whoever takes over goes on
    /// after it.
    pub fn commit(&self, header: &Header) {
        if let Some((board, cell)) = &self.board {
            let key = key_of(header);
            let cell = board.input(*cell);
            // A sample that went back in order is answered, but the place stays.
            let is_ahead = cell.key().is_none_or(|last| last.epoch != key.epoch || last.seq < key.seq);
            cell.commit(is_ahead.then_some(key), &self.sequencer.counts());
        }
    }

    /// As [`Subscriber::commit`], for a reader that answers long after it has received: what had come in when it received
    /// this sample.
    pub fn commit_late(&self, key: Key, counts: &InputCounts) {
        if let Some((board, cell)) = &self.board {
            board.input(*cell).commit(Some(key), counts);
        }
    }

    /// Waits until something may have come, at most `limit`. May return early: receive until there is nothing.
    pub fn wait(&self, limit: Duration) {
        // A signal interrupts the wait with an error; the caller looks at its signals after each wait.
        match &self.listener {
            Some(listener) => drop(listener.timed_wait(|_| {}, limit)),
            None => std::thread::sleep(limit),
        }
    }

    /// When a sample that came early has waited long enough for those before it.
    pub fn hold_deadline(&self) -> Option<Instant> {
        self.sequencer.deadline()
    }

    /// What [`Subscriber::wait`] waits for, to wait for several at once; `None` if it was opened unwoken.
    pub fn listener(&self) -> Option<&Listener<ipc::Service>> {
        self.listener.as_ref()
    }

    /// What has come in.
    pub fn counts(&self) -> InputCounts {
        self.sequencer.counts()
    }
}

/// Whoever comes first creates the service, the others must ask for the same: the wiring decides for all.
fn pub_sub<M: Message>(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<PubSub<M>, PortError> {
    let refused = |message: String| PortError { service: wiring.name.clone(), message };
    if wiring.type_name != M::TYPE_NAME {
        return Err(refused(format!("carries {}, expected {}", wiring.type_name, M::TYPE_NAME)));
    }
    let name = service_name(wiring)?;
    let open = || {
        node.service_builder(&name)
            .publish_subscribe::<[M::Item]>()
            .user_header::<M::Head>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(wiring.max_capacity)
            .subscriber_max_borrowed_samples(wiring.max_borrowed)
            .history_size(wiring.history)
            .max_publishers(wiring.max_publishers)
            .max_subscribers(wiring.max_subscribers)
            .max_nodes(wiring.max_nodes)
            .open_or_create()
    };
    again_and_again(open).map_err(|error| refused(format!("{error:?}")))
}

fn events(node: &Node<ipc::Service>, wiring: &ServiceWiring) -> Result<event::PortFactory<ipc::Service>, PortError> {
    let name = service_name(wiring)?;
    let open = || {
        node.service_builder(&name)
            .event()
            .max_notifiers(wiring.max_publishers)
            .max_listeners(wiring.max_subscribers)
            .max_nodes(wiring.max_nodes)
            .open_or_create()
    };
    again_and_again(open).map_err(|error| PortError { service: wiring.name.clone(), message: format!("{error:?}") })
}

/// On a busy machine two that open a service at once can each take the other for its maker, and iceoryx2 0.10 says that it does
/// not exist.
fn again_and_again<T, E>(mut open: impl FnMut() -> Result<T, E>) -> Result<T, E> {
    for _ in 1..N_OPENINGS {
        if let Ok(opened) = open() {
            return Ok(opened);
        }
        std::thread::sleep(OPENING_PAUSE);
    }
    open()
}

fn service_name(wiring: &ServiceWiring) -> Result<ServiceName, PortError> {
    ServiceName::new(&wiring.name)
        .map_err(|error| PortError { service: wiring.name.clone(), message: format!("{error:?}") })
}
