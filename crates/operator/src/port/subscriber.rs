//! The receiving end of an edge.

use std::collections::VecDeque;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;
use std::time::Instant;

use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::Node;
use iceoryx2::service::port_factory::PortFactory;

use super::bytes::{Envelope, Layout, Word};
use super::service::{self, Connections, PubSub};
use super::{PortError, PortSample, UntypedSample, sample_id};
use crate::cursors::{SampleId, SharedCursors};
use crate::monotonic_nanos;
use crate::private_service::PrivateService;
use crate::sequencer::{Placing, Sequencer};
use crate::wiring::{EdgePolicy, InputCounts, InputWiring, OnLate};
use crate::written::Written;
use blindgrasp_messages::{Header, Message};

type Port = iceoryx2::port::subscriber::Subscriber<PrivateService, [Word], Envelope>;

fn open_port(
    pub_sub: &PubSub,
    buffer_size: usize,
    handler: impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + 'static,
) -> Result<Port, SubscriberCreateError> {
    pub_sub.subscriber_builder().buffer_size(buffer_size).set_degradation_handler(handler).create()
}

/// The receiving end of an edge.
pub struct Subscriber<M: Message> {
    port: UntypedSubscriber,
    message: PhantomData<M>,
}

impl<M: Message> Deref for Subscriber<M> {
    type Target = UntypedSubscriber;

    fn deref(&self) -> &UntypedSubscriber {
        &self.port
    }
}

impl<M: Message> DerefMut for Subscriber<M> {
    fn deref_mut(&mut self) -> &mut UntypedSubscriber {
        &mut self.port
    }
}

impl<M: Message> Subscriber<M> {
    /// Opens the port. With a file of cursors and a slot in the wiring, writers wait for it; otherwise it only reads along.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn open(
        node: &Node<PrivateService>,
        cursors: Option<&Arc<SharedCursors>>,
        wiring: &InputWiring,
    ) -> Result<Self, PortError> {
        let port = UntypedSubscriber::open(node, cursors, wiring, Layout::of::<M>())?;
        Ok(Subscriber { port, message: PhantomData })
    }

    /// The next sample in order, if one is there.
    ///
    /// # Errors
    /// An error of iceoryx2, or a sample that is not of this message.
    pub fn receive(&mut self) -> Result<Option<PortSample<M>>, PortError> {
        Ok(self.port.receive()?.map(PortSample::of_untyped))
    }

    /// The port without the type of its message.
    pub(crate) fn into_untyped(self) -> UntypedSubscriber {
        self.port
    }
}

/// The receiving end of an edge, whatever its message.
pub struct UntypedSubscriber {
    service: String,
    layout: Layout,
    pub_sub: PubSub,
    subscriber: Port,
    connections: Connections,
    /// The number of samples that the queue takes.
    buffer_size: usize,
    cursors: Option<(Arc<SharedCursors>, usize)>,
    writer_slot: usize,
    deadline_nanos: Option<u64>,
    on_late: OnLate,
    /// The age of the last sample, if it came too late.
    late_nanos: Option<u64>,
    /// See [`UntypedSubscriber::received_nanos`].
    received_nanos: Option<u64>,
    /// Whether samples wait for those before them. On an edge that may drop samples, they don't.
    may_hold: bool,
    /// Samples that were taken and not answered, and wait until this reader begins anew.
    put_back: VecDeque<UntypedSample>,
    sequencer: Sequencer<UntypedSample>,
    /// The number of samples that its writer had sent before an attached reader began.
    n_sent_before: u64,
}

impl UntypedSubscriber {
    fn open(
        node: &Node<PrivateService>,
        cursors: Option<&Arc<SharedCursors>>,
        wiring: &InputWiring,
        layout: Layout,
    ) -> Result<Self, PortError> {
        let pub_sub = service::pub_sub(node, &wiring.service, layout.type_name)?;
        // A reader that comes back finds all that its writer keeps; the cursors limit how much may be unanswered.
        let buffer_size = match wiring.policy {
            EdgePolicy::Lossless => wiring.service.max_capacity,
            EdgePolicy::Latest => wiring.capacity.min(wiring.service.max_capacity),
        };
        let connections = Connections::default();
        let subscriber = open_port(&pub_sub, buffer_size, connections.handler())
            .map_err(|error| service::open_failed(&wiring.service, error))?;
        let mut subscriber = UntypedSubscriber {
            service: wiring.service.name.clone(),
            layout,
            pub_sub,
            subscriber,
            connections,
            buffer_size,
            cursors: cursors.zip(wiring.slot).map(|(cursors, slot)| (Arc::clone(cursors), slot)),
            writer_slot: wiring.writer_slot,
            deadline_nanos: wiring.deadline_nanos,
            on_late: wiring.on_late,
            late_nanos: None,
            received_nanos: None,
            may_hold: wiring.policy == EdgePolicy::Lossless,
            put_back: VecDeque::new(),
            sequencer: Sequencer::onlooker(),
            n_sent_before: 0,
        };
        subscriber.begin_with(Sequencer::onlooker());
        Ok(subscriber)
    }

    fn begin_with(&mut self, sequencer: Sequencer<UntypedSample>) {
        let now = Instant::now();
        let written = self.writer();
        let sequencer = if self.is_given_up() {
            sequencer.after_giving_up()
        } else {
            sequencer.beginning_at(now, written.map(|written| written.last))
        };
        let sequencer = if self.may_hold { sequencer } else { sequencer.without_waiting() };
        let before = std::mem::replace(&mut self.sequencer, sequencer);
        // Samples that this reader has received and not answered exist nowhere else any more.
        let put_back = std::mem::take(&mut self.put_back).into_iter().map(|sample| (sample.key(), sample.copied()));
        self.sequencer.hold_again(before, put_back, written.as_ref(), now);
    }

    /// Connects to its publishers; false if there is none yet.
    ///
    /// # Errors
    /// An error of iceoryx2, or a connection could not be made again and again.
    pub fn connect(&mut self) -> Result<bool, PortError> {
        let failed = |service: &str, source| PortError::new(service, "cannot be connected", Some(source));
        self.subscriber.update_connections().map_err(|error| failed(&self.service, error.into()))?;
        let (pub_sub, buffer_size, handler) = (&self.pub_sub, self.buffer_size, self.connections.handler());
        let (subscriber, sequencer) = (&mut self.subscriber, &mut self.sequencer);
        let mended = self.connections.mend(|| {
            // A new port connects to all publishers, and gets what they keep.
            let Ok(port) = open_port(pub_sub, buffer_size, handler) else { return false };
            *subscriber = port;
            sequencer.has_reconnected();
            subscriber.update_connections().is_ok()
        });
        mended.map_err(|error| failed(&self.service, error.into()))?;
        Ok(self.pub_sub.dynamic_config().number_of_publishers() > 0 && self.connections.are_made())
    }

    /// How far its writer has come; `None` for a reader that only reads along.
    pub fn writer(&self) -> Option<Written> {
        self.cursors.as_ref().and_then(|(cursors, _)| cursors.output(self.writer_slot).written())
    }

    /// Goes on after the last sample that the node has answered, which the cursors name. All answers up to `answered` have
    /// been received.
    pub fn take_over(&mut self, answered: Option<SampleId>) {
        if let Some((cursors, slot)) = &self.cursors {
            let slot = cursors.input(*slot);
            let sequencer = Sequencer::resume(answered, slot.key(), slot.counts());
            self.begin_with(sequencer);
        }
    }

    /// Goes on with all samples that its writer still has, those that were committed too.
    pub(crate) fn take_over_all(&mut self) {
        if let Some((cursors, slot)) = &self.cursors {
            let slot = cursors.input(*slot);
            self.begin_with(Sequencer::resume(None, slot.key(), slot.counts()).taking_what_comes());
        }
    }

    /// Goes on after `last`, with counts that include the samples up to `counted`. The cursor is put at `cursor`: the last sample
    /// that a saved state includes, or the last one that is counted.
    pub fn take_over_at(
        &mut self,
        last: Option<SampleId>,
        counted: Option<SampleId>,
        counts: InputCounts,
        cursor: Option<SampleId>,
    ) {
        if let Some((cursors, slot)) = &self.cursors {
            cursors.input(*slot).place_at(cursor, &counts);
            self.begin_with(Sequencer::resume(last, counted, counts));
        }
    }

    /// Reads along after `last`, the last sample that a saved state includes.
    pub fn look_on_from(&mut self, last: SampleId) {
        self.begin_with(Sequencer::resume(Some(last), Some(last), InputCounts::default()));
    }

    /// Whether all samples that its writer has sent are answered.
    pub fn is_caught_up(&self) -> bool {
        let Some((cursors, slot)) = &self.cursors else { return true };
        let sent = cursors.output(self.writer_slot).key();
        let answered = cursors.input(*slot).key();
        sent.is_none_or(|sent| {
            answered.is_some_and(|answered| answered.epoch == sent.epoch && answered.seq >= sent.seq)
        })
    }

    /// The last sample that its writer has sent.
    pub fn written(&self) -> Option<SampleId> {
        self.writer().map(|written| written.last)
    }

    /// Whether a sample is one that its writer has sent after another one, if it has sent both.
    pub(crate) fn is_after(&self, key: SampleId, other: Option<SampleId>) -> bool {
        Written::is_after(self.writer(), key, other)
    }

    /// Whether its writer is on another machine whose link is cut off.
    pub fn is_cut_off(&self) -> bool {
        self.cursors.as_ref().is_some_and(|(cursors, _)| cursors.output(self.writer_slot).is_cut_off())
    }

    /// The last sample that any instance of the node has answered, and its counts of that time.
    pub(crate) fn place(&self) -> (Option<SampleId>, InputCounts) {
        let Some((cursors, slot)) = &self.cursors else { return (None, InputCounts::default()) };
        (cursors.input(*slot).key(), cursors.input(*slot).counts())
    }

    /// The last sample that any instance of the node has answered.
    pub fn last(&self) -> Option<SampleId> {
        self.cursors.as_ref().and_then(|(cursors, slot)| cursors.input(*slot).key())
    }

    /// When it delivered the last sample (CLOCK_BOOTTIME), if it knows the age of its samples.
    pub(crate) fn received_nanos(&self) -> Option<u64> {
        self.received_nanos
    }

    /// Whether samples wait that were not received.
    pub(crate) fn has_more(&self) -> bool {
        self.subscriber.has_samples().unwrap_or(false)
    }

    /// Keeps a sample that was not answered, in case that this reader goes on.
    pub(crate) fn put_back(&mut self, sample: UntypedSample) {
        self.put_back.push_back(sample);
    }

    /// The next sample in order, if one is there.
    pub(crate) fn receive(&mut self) -> Result<Option<UntypedSample>, PortError> {
        if let Some(sample) = self.sequencer.next_in_order() {
            return Ok(Some(self.delivered(sample)));
        }
        loop {
            let sample = self.subscriber.receive();
            let sample = sample.map_err(|error| PortError::new(&self.service, "cannot receive", Some(error.into())))?;
            let Some(sample) = sample else {
                // Only now, because the samples that a held one waits for may have been in the queue.
                let overdue =
                    if self.sequencer.n_held() > 0 { self.sequencer.next_overdue(Instant::now()) } else { None };
                return Ok(overdue.map(|sample| self.delivered(sample)));
            };
            let publisher = sample.header().publisher_id().value();
            let may_reorder = || self.pub_sub.dynamic_config().number_of_publishers() > 1;
            let sample = UntypedSample::lent(sample, &self.layout).ok_or_else(|| {
                let expected = self.layout.type_name;
                let what = format!(
                    "has a sample without the lengths of {expected}: its writer was built with another version"
                );
                PortError::new(&self.service, what, None)
            })?;
            let key = sample.key();
            let written = self.cursors.as_ref().and_then(|(cursors, _)| cursors.output(self.writer_slot).written());
            match self.sequencer.push(sample, key, publisher, written.as_ref(), may_reorder, Instant::now) {
                Placing::Deliver(sample) => return Ok(Some(self.delivered(sample))),
                Placing::Hold => self.sequencer.keep_as(key, UntypedSample::copied),
                Placing::Drop => {}
            }
        }
    }

    fn delivered(&mut self, sample: UntypedSample) -> UntypedSample {
        let origin_nanos = sample.header().origin_nanos;
        // A reader without a slot counts nothing, and a sample without a time has no age.
        if let Some((cursors, slot)) = self.cursors.as_ref()
            && origin_nanos != 0
        {
            let now_nanos = monotonic_nanos();
            self.received_nanos = Some(now_nanos);
            let age_nanos = now_nanos.saturating_sub(origin_nanos);
            cursors.ages(*slot).count(age_nanos);
            self.late_nanos = self.deadline_nanos.filter(|limit| age_nanos > *limit).map(|_| age_nanos);
            if self.late_nanos.is_some() {
                self.sequencer.count_late();
            }
        }
        sample
    }

    /// The consequence of the last sample's lateness, and the sample's age in nanoseconds; `None` if it came in time.
    pub fn lateness(&self) -> Option<(OnLate, u64)> {
        self.late_nanos.map(|age_nanos| (self.on_late, age_nanos))
    }

    /// Sets whether its writer waits for this reader no longer.
    pub fn give_up(&self, is_given_up: bool) {
        if let Some((cursors, slot)) = &self.cursors {
            cursors.input(*slot).give_up(is_given_up);
        }
    }

    /// Whether the writer waits for this reader no longer.
    pub fn is_given_up(&self) -> bool {
        self.cursors.as_ref().is_some_and(|(cursors, slot)| cursors.input(*slot).is_given_up())
    }

    /// Begins after the samples that its writer has sent so far; the writer waits for it from now on. Returns the last sample
    /// before it.
    pub fn begin_here(&mut self) -> Option<SampleId> {
        let (cursors, slot) = self.cursors.as_ref()?;
        let (last, n_sent) = cursors.output(self.writer_slot).sent();
        self.n_sent_before = n_sent;
        cursors.input(*slot).begin_after(last);
        self.begin_with(Sequencer::resume(last, last, InputCounts::default()));
        last
    }

    /// How many samples were sent since it began and have not come; 0 while some that were sent are not answered.
    pub fn n_lost(&self) -> u64 {
        let Some((cursors, slot)) = &self.cursors else { return 0 };
        cursors.output(self.writer_slot).n_lost(cursors.input(*slot), self.n_sent_before)
    }

    /// Marks all samples up to this one as answered: its writer may overwrite them, and an instance that takes over goes on
    /// after them.
    pub fn commit(&self, header: &Header) {
        self.commit_late(sample_id(header), &self.sequencer.counts());
    }

    /// As [`UntypedSubscriber::commit`], for a reader that answers long after it has received; with the counts of the time at which
    /// it received this sample.
    pub fn commit_late(&self, key: SampleId, counts: &InputCounts) {
        if let Some((cursors, slot)) = &self.cursors {
            let slot = cursors.input(*slot);
            // A sample that goes back in order is answered, but does not move the cursor.
            let is_ahead = self.is_after(key, slot.key());
            slot.commit(is_ahead.then_some(key), counts);
        }
    }

    /// When the wait of the next early sample is over.
    pub fn hold_deadline(&self) -> Option<Instant> {
        self.sequencer.deadline()
    }

    pub fn counts(&self) -> InputCounts {
        self.sequencer.counts()
    }
}
