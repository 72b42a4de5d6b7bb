//! An edge of this machine on its way out: a port's reader, and what the other machine has not answered yet.

use std::collections::VecDeque;

use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::ipc;

use super::clock::Origins;
use super::config::Channel;
use super::outgoing::{Outgoing, OutgoingOptions};
use super::sample;
use blindgrasp_graph::observer::bears_source_number;
use blindgrasp_messages::Message;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::{Subscriber, sample_id};
use blindgrasp_operator::wiring::InputCounts;

/// How many samples of a channel may be on their way to a peer that is there.
pub(super) const WINDOW: usize = 1024;
/// How many samples of a port are read in a row.
const MAX_PER_ROUND: usize = 64;

/// An edge on its way out, of any type.
pub(super) trait Export {
    /// What it is.
    fn channel(&self) -> &Channel;
    /// Its type's number on the wire.
    fn schema_id(&self) -> u32;
    /// Its samples that are on their way.
    fn outgoing(&mut self) -> &mut Outgoing;
    /// The same, to look at.
    fn status(&self) -> &Outgoing;
    /// Reads what the writer has sent, as far as there is room for it; true if there may be more.
    ///
    /// # Errors
    /// A port's.
    fn take_in(&mut self, is_up: bool, origins: &mut Origins) -> anyhow::Result<bool>;
    /// Lets the writer go on as far as the other machine has answered.
    fn commit(&mut self);
    /// Whether everything that its writer has sent was taken in.
    fn has_taken_all(&self) -> bool;
    /// The last sample taken in, by this instance or an earlier one.
    fn last(&self) -> Option<SampleId>;
    /// Looks for publishers that have come.
    ///
    /// # Errors
    /// A port's.
    fn connect(&self) -> anyhow::Result<()>;
    /// What wakes it.
    fn listener(&self) -> Option<&Listener<ipc::Service>>;
}

struct Reader<M: Message> {
    channel: Channel,
    schema_id: u32,
    subscriber: Subscriber<M>,
    outgoing: Outgoing,
    last: Option<SampleId>,
    /// What had come in when each sample was received that is not committed yet.
    uncommitted: VecDeque<(SampleId, InputCounts)>,
    bears_source_number: bool,
}

/// Opens the reader of a channel's port.
///
/// # Errors
/// A port that the wiring doesn't have, or iceoryx2's reason.
pub(super) fn open<M: Message>(
    operator: &Operator,
    channel: &Channel,
    buffer: usize,
) -> anyhow::Result<Box<dyn Export>> {
    let mut subscriber = operator.subscriber::<M>(&channel.input_port())?;
    let last = subscriber.last();
    subscriber.take_over(last);
    let options = OutgoingOptions { policy: channel.policy, window: WINDOW, capacity: channel.capacity, buffer };
    let outgoing = Outgoing::new(options, last);
    let bears_source_number = bears_source_number(M::TYPE_NAME);
    Ok(Box::new(Reader {
        channel: channel.clone(),
        schema_id: sample::schema_id(M::TYPE_NAME).unwrap_or_default(),
        subscriber,
        outgoing,
        last,
        uncommitted: VecDeque::new(),
        bears_source_number,
    }))
}

impl<M: Message> Export for Reader<M> {
    fn channel(&self) -> &Channel {
        &self.channel
    }

    fn schema_id(&self) -> u32 {
        self.schema_id
    }

    fn outgoing(&mut self) -> &mut Outgoing {
        &mut self.outgoing
    }

    fn status(&self) -> &Outgoing {
        &self.outgoing
    }

    fn take_in(&mut self, is_up: bool, origins: &mut Origins) -> anyhow::Result<bool> {
        for _ in 0..MAX_PER_ROUND {
            let now_nanos = monotonic_nanos();
            if !self.outgoing.wants_more(is_up, now_nanos) {
                return Ok(false);
            }
            let Some(received) = self.subscriber.receive()? else {
                return Ok(false);
            };
            let head = received.user_header();
            let header = M::header(head);
            let key = sample_id(header);
            let mut message = Vec::new();
            if let Err(error) = sample::encode::<M>(head, received.payload(), &mut message) {
                tracing::warn!(port = self.channel.port, seq = key.seq, "a sample cannot be read: {error}");
                message = sample::encode_unreadable(key).to_vec();
            }
            if self.bears_source_number {
                origins.remember(key, header.origin_nanos);
            }
            self.outgoing.push(key, message, header.origin_nanos, now_nanos);
            self.last = Some(key);
            self.uncommitted.push_back((key, self.subscriber.counts()));
        }
        Ok(true)
    }

    fn commit(&mut self) {
        let Some(point) = self.outgoing.commit_point(monotonic_nanos()) else {
            return;
        };
        let Some(idx) = self.uncommitted.iter().position(|(key, _)| *key == point) else {
            return;
        };
        // A reader that comes back goes on after its place, with the counts of then.
        if let Some((key, counts)) = self.uncommitted.drain(..=idx).next_back() {
            self.subscriber.commit_late(key, &counts);
        }
    }

    fn has_taken_all(&self) -> bool {
        let written = self.subscriber.written();
        let is_past =
            |written: SampleId| self.last.is_some_and(|last| last.epoch == written.epoch && last.seq >= written.seq);
        written.is_none_or(is_past)
    }

    fn last(&self) -> Option<SampleId> {
        self.last
    }

    fn connect(&self) -> anyhow::Result<()> {
        self.subscriber.connect()?;
        Ok(())
    }

    fn listener(&self) -> Option<&Listener<ipc::Service>> {
        self.subscriber.listener()
    }
}
