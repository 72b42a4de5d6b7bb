//! The receiving side of an edge from another machine: it publishes the samples on a local port as the writer itself
//! would.

use std::collections::VecDeque;
use std::time::Duration;

use super::incoming::{Admission, Incoming};
use super::sample;
use super::wire::SampleFrame;
use blindgrasp_graph::link::config::Channel;
use blindgrasp_messages::{Message, Stamped};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::{Publisher, Sent, UntypedPublisher, sample_id};

/// Maximum number of samples that wait for readers: twice the number that a sender has on their way.
const MAX_QUEUE: usize = 2 * super::uplink::WINDOW;

/// What happened to a sample that arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Accepted {
    /// It is on its way to its readers.
    Yes,
    /// It arrived before, or it answers an earlier request.
    Repeated,
    /// An earlier sample is missing.
    Gap,
    /// The sender has started again with sequence numbers that were used here before. Readers would drop the sample as
    /// a repetition.
    UsedNumber,
    /// It cannot be decoded and is left out.
    Malformed,
    /// The sender has more samples on their way than it may; the sample will be requested again.
    TooMany,
}

pub(super) struct Downlink {
    pub(super) channel: Channel,
    pub(super) schema_id: u32,
    pub(super) incoming: Incoming,
    pub(super) writer: Box<dyn Writer>,
    /// The last sample before the sender started again.
    before: Option<SampleId>,
    /// The newest sample, if it cannot be decoded.
    unreadable: Option<SampleId>,
    /// This part of the graph is being stopped: samples that still arrive are left with their sender.
    is_closed: bool,
}

/// A publisher of any message type, with the samples that wait for readers.
pub(super) trait Writer {
    /// Decodes a message and holds it for [`Writer::push`]; `None` if it cannot be decoded.
    fn decode(&mut self, message: &[u8]) -> Option<SampleId>;
    /// Queues the message that was decoded last.
    fn push(&mut self, origin_nanos: u64);
    /// Publishes the samples for which readers have room; returns whether samples still wait.
    ///
    /// # Errors
    /// The port fails.
    fn flush(&mut self) -> anyhow::Result<bool>;
    fn n_waiting(&self) -> usize;
    fn port(&self) -> &UntypedPublisher;
    fn port_mut(&mut self) -> &mut UntypedPublisher;
}

impl Downlink {
    /// Opens the publisher of a channel's port.
    ///
    /// # Errors
    /// The wiring does not have this port, or iceoryx2 fails.
    pub(super) fn open<M: Message>(operator: &Operator, channel: &Channel, instance: u64) -> anyhow::Result<Downlink> {
        let mut publisher = operator.publisher_for::<M>(&channel.port, None)?;
        // Samples that an earlier process published and that have no answer may have been lost with that process.
        let incoming = Incoming::new(channel.policy, instance, publisher.begin(false));
        Ok(Downlink {
            channel: channel.clone(),
            schema_id: sample::schema_id(M::TYPE_NAME).unwrap_or_default(),
            incoming,
            writer: Box::new(Queue { publisher, waiting: VecDeque::new(), decoded: None, waits_since_nanos: None }),
            before: None,
            unreadable: None,
            is_closed: false,
        })
    }

    /// Takes a sample. `origin_of` gives the time of its source by this machine's clock, 0 if that is unknown.
    ///
    /// # Errors
    /// The port fails.
    pub(super) fn accept(
        &mut self,
        frame: &SampleFrame<'_>,
        origin_of: &mut dyn FnMut(SampleId) -> u64,
    ) -> anyhow::Result<Accepted> {
        if self.is_closed {
            return Ok(Accepted::Repeated);
        }
        if self.writer.n_waiting() >= MAX_QUEUE {
            return Ok(Accepted::TooMany);
        }
        let decoded = self.writer.decode(frame.message);
        let unreadable = if decoded.is_none() { sample::decode_unreadable(frame.message) } else { None };
        // Bytes that are neither a message nor the place of one leave the place as it is.
        let key = decoded.or(unreadable).or(self.incoming.last()).unwrap_or(SampleId { epoch: 0, seq: 0 });
        match self.incoming.on_sample(frame.run, frame.index, key) {
            Admission::Deliver => {}
            Admission::Gap => return Ok(Accepted::Gap),
            _ => return Ok(Accepted::Repeated),
        }
        if self.before.is_some_and(|before| before.epoch == key.epoch && before.seq >= key.seq) {
            return Ok(Accepted::UsedNumber);
        }
        self.unreadable = unreadable;
        if decoded.is_none() {
            return Ok(Accepted::Malformed);
        }
        self.writer.push(origin_of(key));
        self.writer.flush()?;
        Ok(Accepted::Yes)
    }

    /// The sender has started again: its earlier samples no longer count.
    pub(super) fn begin_anew(&mut self) {
        if self.channel.is_from_source {
            self.incoming.begin_anew();
            self.before = self.writer.port().last();
        }
    }

    /// Takes no more samples.
    pub(super) fn close(&mut self) {
        self.is_closed = true;
    }

    pub(super) fn is_closed_and_empty(&self) -> bool {
        self.is_closed && self.writer.n_waiting() == 0
    }

    /// The last sample that all readers here have answered.
    pub(super) fn answered(&self) -> Option<SampleId> {
        let port = self.writer.port();
        let published = port.last();
        // Answers to an earlier run of the sender do not count for this run.
        if self.is_closed || (self.before.is_some() && self.before == published) {
            return None;
        }
        let answered = if port.has_readers() { port.answered_by_readers() } else { published };
        // No reader will answer a sample that cannot be decoded.
        let is_at_rest = self.writer.n_waiting() == 0 && answered == published;
        if is_at_rest && self.unreadable.is_some() { self.unreadable } else { answered }
    }
}

struct Queue<M: Message> {
    publisher: Publisher<M>,
    waiting: VecDeque<(M::Head, Vec<M::Item>)>,
    decoded: Option<Stamped<M>>,
    /// Since when there is no room for the first waiting sample.
    waits_since_nanos: Option<u64>,
}

impl<M: Message> Writer for Queue<M> {
    fn decode(&mut self, message: &[u8]) -> Option<SampleId> {
        self.decoded = sample::decode(message).ok();
        self.decoded.as_ref().map(|stamped| sample_id(&stamped.header))
    }

    fn push(&mut self, origin_nanos: u64) {
        if let Some(Stamped { mut header, message }) = self.decoded.take() {
            header.origin_nanos = origin_nanos;
            self.waiting.push_back(message.to_parts(header));
        }
    }

    fn flush(&mut self) -> anyhow::Result<bool> {
        while let Some((head, items)) = self.waiting.front() {
            let now_nanos = monotonic_nanos();
            let waited = self.waits_since_nanos.map_or(0, |since| now_nanos.saturating_sub(since));
            if !self.publisher.has_room_for(M::header(head), Duration::from_nanos(waited))? {
                self.waits_since_nanos.get_or_insert(now_nanos);
                return Ok(true);
            }
            self.waits_since_nanos = None;
            if self.publisher.send(*head, items, &mut || true)? == Sent::GaveWay {
                return Ok(true);
            }
            self.waiting.pop_front();
        }
        Ok(false)
    }

    fn n_waiting(&self) -> usize {
        self.waiting.len()
    }

    fn port(&self) -> &UntypedPublisher {
        &self.publisher
    }

    fn port_mut(&mut self) -> &mut UntypedPublisher {
        &mut self.publisher
    }
}
