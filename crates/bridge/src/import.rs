//! An edge of another machine on its way in: what has come, and a publisher that writes it as the writer itself would.

use std::collections::VecDeque;
use std::time::Duration;

use super::config::Channel;
use super::incoming::{Incoming, Verdict};
use super::sample;
use super::wire::SampleFrame;
use blindgrasp_messages::{Message, Stamped};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::{Publisher, Sent, sample_id};

/// How many samples may wait for readers: twice what a sender has on their way.
const MAX_QUEUE: usize = 2 * super::export::WINDOW;

/// What became of a sample that came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Accepted {
    /// It is on its way to its readers.
    Yes,
    /// It was there already, or belongs to an earlier request.
    Repeated,
    /// Something before it is missing.
    Gap,
    /// Its sender has begun anew, with numbers that were used here before: readers would take it for a repetition.
    UsedNumber,
    /// Nobody can read it: it is left out.
    Malformed,
    /// More than may be on their way at a time: it will be asked for again.
    TooMany,
}

/// An edge on its way in, of any type.
pub(super) trait Import {
    /// What it is.
    fn channel(&self) -> &Channel;
    /// Its type's number on the wire.
    fn schema_id(&self) -> u32;
    /// What has come.
    fn incoming(&mut self) -> &mut Incoming;
    /// The same, to look at.
    fn status(&self) -> &Incoming;
    /// Takes a sample; `origin_nanos` is when it began by this machine's clock, 0 if that is unknown.
    fn accept(
        &mut self,
        frame: &SampleFrame<'_>,
        origin_of: &mut dyn FnMut(SampleId) -> u64,
    ) -> anyhow::Result<Accepted>;
    /// The sender begins anew: what it sent before does not count.
    fn begin_anew(&mut self);
    /// Publishes what its readers have room for; true if something waits.
    ///
    /// # Errors
    /// A port's.
    fn flush(&mut self) -> anyhow::Result<bool>;
    /// Takes no more.
    fn close(&mut self);
    /// Up to where the readers here have answered.
    fn answered(&self) -> Option<SampleId>;
    /// The last sample published here.
    fn published(&self) -> Option<SampleId>;
    /// How many samples wait for readers.
    fn n_waiting(&self) -> usize;
    /// Tells readers whether anything can come.
    fn set_cut_off(&self, is_cut_off: bool);
    /// Looks for readers that have come.
    ///
    /// # Errors
    /// A port's.
    fn look_for_readers(&mut self) -> anyhow::Result<()>;
}

struct Writer<M: Message> {
    channel: Channel,
    schema_id: u32,
    publisher: Publisher<M>,
    incoming: Incoming,
    queue: VecDeque<(M::Head, Vec<M::Item>)>,
    /// The last sample before the sender began anew.
    before: Option<SampleId>,
    /// The newest sample, if nobody can read it.
    unreadable: Option<SampleId>,
    /// This part of the graph is being stopped: what still comes is left with its sender.
    is_closed: bool,
    /// Since when the first of the queue has no room.
    waits_since_nanos: Option<u64>,
}

/// Opens the publisher of a channel's port.
///
/// # Errors
/// A port that the wiring doesn't have, or iceoryx2's reason.
pub(super) fn open<M: Message>(
    operator: &Operator,
    channel: &Channel,
    instance: u64,
) -> anyhow::Result<Box<dyn Import>> {
    let publisher = operator.growing_publisher::<M>(&channel.port)?;
    // What an earlier instance published and nobody has answered may have died with it.
    let incoming = Incoming::new(channel.policy, instance, publisher.answered());
    Ok(Box::new(Writer {
        channel: channel.clone(),
        schema_id: sample::schema_id(M::TYPE_NAME).unwrap_or_default(),
        publisher,
        incoming,
        queue: VecDeque::new(),
        before: None,
        unreadable: None,
        is_closed: false,
        waits_since_nanos: None,
    }))
}

impl<M: Message> Import for Writer<M> {
    fn channel(&self) -> &Channel {
        &self.channel
    }

    fn schema_id(&self) -> u32 {
        self.schema_id
    }

    fn incoming(&mut self) -> &mut Incoming {
        &mut self.incoming
    }

    fn status(&self) -> &Incoming {
        &self.incoming
    }

    fn accept(
        &mut self,
        frame: &SampleFrame<'_>,
        origin_of: &mut dyn FnMut(SampleId) -> u64,
    ) -> anyhow::Result<Accepted> {
        if self.is_closed {
            return Ok(Accepted::Repeated);
        }
        if self.queue.len() >= MAX_QUEUE {
            return Ok(Accepted::TooMany);
        }
        let decoded: Option<Stamped<M>> = sample::decode(frame.message).ok();
        let unreadable = sample::decode_unreadable(frame.message).filter(|_| decoded.is_none());
        // What is neither a message nor the place of one leaves the place as it is.
        let key = decoded.as_ref().map(|stamped| sample_id(&stamped.header)).or(unreadable).or(self.incoming.last());
        let key = key.unwrap_or(SampleId { epoch: 0, seq: 0 });
        match self.incoming.on_sample(frame.run, frame.index, key) {
            Verdict::Deliver => {}
            Verdict::Gap => return Ok(Accepted::Gap),
            _ => return Ok(Accepted::Repeated),
        }
        if self.before.is_some_and(|before| before.epoch == key.epoch && before.seq >= key.seq) {
            return Ok(Accepted::UsedNumber);
        }
        self.unreadable = unreadable;
        let Some(Stamped { mut header, message }) = decoded else {
            return Ok(Accepted::Malformed);
        };
        header.origin_nanos = origin_of(key);
        self.queue.push_back(message.to_parts(header));
        self.flush()?;
        Ok(Accepted::Yes)
    }

    fn begin_anew(&mut self) {
        if self.channel.is_from_source {
            self.incoming.begin_anew();
            self.before = self.publisher.last();
        }
    }

    fn flush(&mut self) -> anyhow::Result<bool> {
        while let Some((head, items)) = self.queue.front() {
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
            self.queue.pop_front();
        }
        Ok(false)
    }

    fn close(&mut self) {
        self.is_closed = true;
    }

    fn answered(&self) -> Option<SampleId> {
        // What readers have of an earlier run of the sender says nothing of this one.
        if self.is_closed || (self.before.is_some() && self.before == self.publisher.last()) {
            return None;
        }
        let answered = match self.publisher.has_readers() {
            true => self.publisher.answered_by_readers(),
            false => self.publisher.last(),
        };
        // Nobody will answer what nobody can read.
        let is_at_rest = self.queue.is_empty() && answered == self.publisher.last();
        self.unreadable.filter(|_| is_at_rest).or(answered)
    }

    fn published(&self) -> Option<SampleId> {
        self.publisher.last()
    }

    fn n_waiting(&self) -> usize {
        self.queue.len()
    }

    fn set_cut_off(&self, is_cut_off: bool) {
        self.publisher.set_cut_off(is_cut_off);
    }

    fn look_for_readers(&mut self) -> anyhow::Result<()> {
        Ok(self.publisher.look_for_readers()?)
    }
}
