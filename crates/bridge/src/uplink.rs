//! The sending side of an edge to another machine: it reads a local port and keeps what the other machine has not
//! answered.

use std::collections::VecDeque;

use super::clock::Origins;
use super::config::{Channel, LinkConfig};
use super::outgoing::{Outgoing, OutgoingOptions};
use super::sample;
use blindgrasp_graph::client::observer::bears_source_number;
use blindgrasp_messages::{Header, Message};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::{Subscriber, sample_id};
use blindgrasp_operator::wiring::InputCounts;

/// Maximum number of samples of a channel that are on their way to a peer that is up.
pub(super) const WINDOW: usize = 1024;
/// A peer stalls when a full window has waited for so many deadlines without an answer.
const N_DEADLINES_STALLED: u64 = 20;
/// It stalls after this time in any case: a writer that waits for 5 s fails.
const LONGEST_STALL_NANOS: u64 = 4_000_000_000;
/// Maximum number of samples of a port that are read in a row.
const MAX_PER_ROUND: usize = 64;

pub(super) struct Uplink {
    pub(super) channel: Channel,
    pub(super) schema_id: u32,
    pub(super) outgoing: Outgoing,
    /// The last sample that was read, by this process or an earlier one.
    pub(super) last: Option<SampleId>,
    reader: Box<dyn Reader>,
    /// The samples that are not committed yet, each with the counts of the input at the time when it was read.
    uncommitted: VecDeque<(SampleId, InputCounts)>,
    bears_source_number: bool,
}

/// A subscriber of any message type.
trait Reader {
    /// The next sample's header and encoded message.
    fn next(&mut self, port: &str) -> anyhow::Result<Option<(Header, Vec<u8>)>>;
    fn counts(&self) -> InputCounts;
    fn commit_late(&mut self, key: SampleId, counts: &InputCounts);
    fn written(&self) -> Option<SampleId>;
    fn connect(&mut self) -> anyhow::Result<()>;
}

impl Uplink {
    /// Opens the reader of a channel's port.
    ///
    /// # Errors
    /// The wiring does not have this port, or iceoryx2 fails.
    pub(super) fn open<M: Message>(
        operator: &Operator,
        channel: &Channel,
        config: &LinkConfig,
    ) -> anyhow::Result<Uplink> {
        let mut subscriber = operator.subscriber::<M>(&channel.input_port())?;
        let last = subscriber.last();
        subscriber.take_over(last);
        let deadlines_nanos = config.deadline_millis.saturating_mul(1_000_000 * N_DEADLINES_STALLED);
        let options = OutgoingOptions {
            policy: channel.policy,
            window: WINDOW,
            capacity: channel.capacity,
            buffer: config.buffer,
            stall_limit_nanos: deadlines_nanos.min(LONGEST_STALL_NANOS),
        };
        Ok(Uplink {
            channel: channel.clone(),
            schema_id: sample::schema_id(M::TYPE_NAME).unwrap_or_default(),
            outgoing: Outgoing::new(options, last),
            last,
            reader: Box::new(subscriber),
            uncommitted: VecDeque::new(),
            bears_source_number: bears_source_number(M::TYPE_NAME),
        })
    }

    /// At the start: the last sample of a source here, or of a node behind it, that an earlier process has sent.
    pub(super) fn sent_before(&self) -> Option<SampleId> {
        if self.bears_source_number { self.last } else { None }
    }

    /// Reads the writer's samples as long as there is room for them; returns whether there may be more.
    ///
    /// # Errors
    /// The port fails.
    pub(super) fn take_in(&mut self, is_up: bool, origins: &mut Origins) -> anyhow::Result<bool> {
        for _ in 0..MAX_PER_ROUND {
            let now_nanos = monotonic_nanos();
            if !self.outgoing.wants_more(is_up, now_nanos) {
                return Ok(false);
            }
            let Some((header, message)) = self.reader.next(&self.channel.port)? else {
                return Ok(false);
            };
            let key = sample_id(&header);
            if self.bears_source_number {
                origins.remember(key, header.origin_nanos);
            }
            self.outgoing.push(key, message, header.origin_nanos, now_nanos);
            self.last = Some(key);
            self.uncommitted.push_back((key, self.reader.counts()));
        }
        Ok(true)
    }

    /// Lets the writer go on as far as the other machine has answered.
    pub(super) fn commit(&mut self) {
        let Some(point) = self.outgoing.commit_point(monotonic_nanos()) else {
            return;
        };
        let Some(idx) = self.uncommitted.iter().position(|(key, _)| *key == point) else {
            return;
        };
        // A reader that is restarted continues after this sample, with the counts of that time.
        if let Some((key, counts)) = self.uncommitted.drain(..=idx).next_back() {
            self.reader.commit_late(key, &counts);
        }
    }

    /// Whether all samples of the writer were read.
    pub(super) fn has_taken_all(&self) -> bool {
        let is_past =
            |written: SampleId| self.last.is_some_and(|last| last.epoch == written.epoch && last.seq >= written.seq);
        self.reader.written().is_none_or(is_past)
    }

    /// Connects to publishers that are new.
    ///
    /// # Errors
    /// The port fails.
    pub(super) fn connect(&mut self) -> anyhow::Result<()> {
        self.reader.connect()
    }
}

impl<M: Message> Reader for Subscriber<M> {
    fn next(&mut self, port: &str) -> anyhow::Result<Option<(Header, Vec<u8>)>> {
        let Some(received) = self.receive()? else {
            return Ok(None);
        };
        let head = received.user_header();
        let header = *M::header(head);
        let mut message = Vec::new();
        if let Err(error) = sample::encode::<M>(head, received.payload(), &mut message) {
            tracing::warn!(port, seq = header.seq, "a sample cannot be sent: {error}");
            message = sample::encode_unreadable(sample_id(&header)).to_vec();
        }
        Ok(Some((header, message)))
    }

    fn counts(&self) -> InputCounts {
        Subscriber::counts(self)
    }

    fn commit_late(&mut self, key: SampleId, counts: &InputCounts) {
        Subscriber::commit_late(self, key, counts);
    }

    fn written(&self) -> Option<SampleId> {
        Subscriber::written(self)
    }

    fn connect(&mut self) -> anyhow::Result<()> {
        Subscriber::connect(self)?;
        Ok(())
    }
}
