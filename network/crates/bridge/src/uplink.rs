//! The sending side of an edge to another machine: it reads a local port and keeps what the other machine has not
//! answered.

use std::collections::VecDeque;

use anyhow::Context as _;

use super::clock::Origins;
use super::outgoing::{Outgoing, OutgoingOptions};
use super::sample;
use super::spool::Spool;
use blindgrasp_graph::client::observer::bears_source_number;
use blindgrasp_graph::link::config::{Channel, LinkConfig};
use blindgrasp_messages::{Header, Message};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::{Subscriber, UntypedSubscriber, sample_id};
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
    /// What a process that takes over needs.
    spool: Spool,
    /// The log says that the spool cannot be written.
    cannot_save: bool,
    /// The samples that are not committed yet, each with the counts of the input at the time when it was read.
    uncommitted: VecDeque<(SampleId, InputCounts)>,
    bears_source_number: bool,
}

/// A subscriber of any message type.
trait Reader {
    /// The next sample's header and encoded message.
    fn next(&mut self, port: &str) -> anyhow::Result<Option<(Header, Vec<u8>)>>;
    fn port(&mut self) -> &mut UntypedSubscriber;
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
        let path = operator.link_folder().join(format!("spool_{}", channel.input_port().replace('/', "_")));
        let (mut spool, saved) = Spool::open(&path).with_context(|| path.display().to_string())?;
        let options = OutgoingOptions {
            policy: channel.policy,
            window: WINDOW,
            capacity: channel.capacity,
            buffer: config.buffer,
            stall_limit_nanos: deadlines_nanos.min(LONGEST_STALL_NANOS),
        };
        let mut outgoing = Outgoing::new(options, last, subscriber.writer());
        outgoing.restore(saved.samples, saved.n_lost);
        // Samples that were saved and not committed come again, and must not be there twice.
        spool.replace(outgoing.committed(), saved.n_lost).with_context(|| path.display().to_string())?;
        Ok(Uplink {
            channel: channel.clone(),
            schema_id: sample::schema_id(M::TYPE_NAME).unwrap_or_default(),
            outgoing,
            spool,
            cannot_save: false,
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
            let Some((header, message)) = self.reader.next(&self.channel.port)? else { return Ok(false) };
            let key = sample_id(&header);
            if self.bears_source_number {
                origins.remember(key, header.origin_nanos);
            }
            self.outgoing.push(key, message, header.origin_nanos, now_nanos);
            self.last = Some(key);
            self.uncommitted.push_back((key, self.reader.port().counts()));
        }
        Ok(true)
    }

    /// Saves the samples for which the writer must not wait. Without room for them, the graph goes on as if they were saved.
    fn save(&mut self) {
        let now_nanos = monotonic_nanos();
        let mut outcome = self.spool.save_lost(self.outgoing.n_lost_to_save());
        while let Some(sample) = self.outgoing.next_to_save(now_nanos) {
            // All that the file has is answered. Samples of earlier epochs there would be sent once more.
            if self.outgoing.committed().len() == 0 {
                let emptied = self.spool.replace(std::iter::empty(), self.outgoing.n_lost_to_save());
                outcome = outcome.and(emptied);
            }
            let saved = self.spool.save(sample);
            outcome = outcome.and(saved);
            self.outgoing.saved();
        }
        if self.spool.is_long(self.outgoing.committed().len()) {
            let replaced = self.spool.replace(self.outgoing.committed(), self.outgoing.n_lost_to_save());
            outcome = outcome.and(replaced);
        }
        if let Err(error) = outcome
            && !std::mem::replace(&mut self.cannot_save, true)
        {
            let port = &self.channel.port;
            tracing::warn!(
                "samples of {port} cannot be saved for machine '{}' ({error}): if the link is killed while that machine is away, \
                 they are lost",
                self.channel.to
            );
        }
    }

    /// Lets the writer go on as far as the other machine has answered, or samples are saved for it.
    pub(super) fn commit(&mut self) {
        self.save();
        let Some(point) = self.outgoing.commit_point() else { return };
        let Some(idx) = self.uncommitted.iter().position(|(key, _)| *key == point) else { return };
        // A reader that is restarted continues after this sample, with the counts of that time.
        if let Some((key, counts)) = self.uncommitted.drain(..=idx).next_back() {
            self.reader.port().commit_late(key, &counts);
        }
    }

    /// Whether all samples of the writer were read.
    pub(super) fn has_taken_all(&mut self) -> bool {
        let Some(written) = self.reader.port().written() else { return true };
        self.last.is_some_and(|last| last.epoch == written.epoch && last.seq >= written.seq)
    }

    /// Connects to publishers that are new.
    ///
    /// # Errors
    /// The port fails.
    pub(super) fn connect(&mut self) -> anyhow::Result<()> {
        self.reader.port().connect()?;
        Ok(())
    }
}

impl<M: Message> Reader for Subscriber<M> {
    fn next(&mut self, port: &str) -> anyhow::Result<Option<(Header, Vec<u8>)>> {
        let Some(received) = self.receive()? else { return Ok(None) };
        let head = received.head();
        let header = *M::header(head);
        let mut message = Vec::new();
        if let Err(error) = sample::encode::<M>(head, received.items(), &mut message) {
            tracing::warn!(port, seq = header.seq, "a sample cannot be sent: {error}");
            message = sample::encode_unreadable(sample_id(&header)).to_vec();
        }
        Ok(Some((header, message)))
    }

    fn port(&mut self) -> &mut UntypedSubscriber {
        self
    }
}
