//! The receiving end of a channel. It decides which samples are taken, and what the sender is asked for and told. It
//! does no I/O and reads no clock.

use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::link_status::ChannelStatus;
use blindgrasp_operator::wiring::EdgePolicy;

/// A request without an answer is repeated after the first pause. Each further pause is twice as long. The request
/// keeps its number, because a sender that has nothing to send is silent too.
const FIRST_RESUME_PAUSE_NANOS: u64 = 50_000_000;
const LONGEST_RESUME_PAUSE_NANOS: u64 = 1_000_000_000;
/// Interval of acknowledgements while the channel makes progress, and while it does not.
const ACK_PAUSE_NANOS: u64 = 2_000_000;
const ACK_REPEAT_NANOS: u64 = 100_000_000;

/// The receiving end of a channel.
#[derive(Debug, Default)]
pub struct Incoming {
    policy: EdgePolicy,
    run: u32,
    asking: Option<Asking>,
    /// The index of the next sample that answers the request.
    expected: u64,
    last: Option<SampleId>,
    has_ended: bool,
    last_ack: Option<(Progress, u64)>,
    n_samples: u64,
    n_repeated: u64,
    n_lost: u64,
    n_stale: u64,
}

/// What is done with a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Admission {
    /// It is the next one: publish it. It counts as received from now on.
    Deliver,
    /// It was received before.
    Repeated,
    /// It answers an earlier request.
    Stale,
    /// A sample before it was lost. It will be sent again.
    Gap,
}

/// The progress of a channel, for [`Body::Ack`](super::wire::Body::Ack).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// The number of the latest request.
    pub run: u32,
    /// The number of samples of this request that were delivered.
    pub n_received: u64,
    /// The last sample that all readers have answered.
    pub answered: Option<SampleId>,
}

#[derive(Debug)]
struct Asking {
    due_nanos: u64,
    pause_nanos: u64,
    is_heard: bool,
}

impl Asking {
    const NOW: Asking = Asking { due_nanos: 0, pause_nanos: FIRST_RESUME_PAUSE_NANOS, is_heard: false };
}

impl Incoming {
    /// A channel whose readers on this machine have the samples up to `after`. Request numbers begin at a number made
    /// of `instance`, so that samples for requests of an earlier process are not taken for this one's.
    pub fn new(policy: EdgePolicy, instance: u64, after: Option<SampleId>) -> Self {
        Incoming {
            policy,
            // Half of the range is left to count upwards.
            run: (instance as u32) >> 1,
            last: after,
            ..Incoming::default()
        }
    }

    /// The sender is there, for the first time or again: requests the samples after the last delivered one.
    pub fn reconnected(&mut self) {
        self.run += 1;
        self.expected = 0;
        self.asking = Some(Asking::NOW);
        self.last_ack = None;
    }

    /// The sender has started again: its earlier samples no longer count.
    pub fn begin_anew(&mut self) {
        self.last = None;
        self.has_ended = false;
    }

    /// The sender is gone: samples that still arrive are stale.
    pub fn cut_off(&mut self) {
        self.asking = None;
    }

    /// The request that is due: its number and the last sample that was delivered.
    pub fn resume_to_send(&mut self, now_nanos: u64) -> Option<(u32, Option<SampleId>)> {
        let asking = self.asking.as_mut().filter(|asking| !asking.is_heard && now_nanos >= asking.due_nanos)?;
        asking.due_nanos = now_nanos.saturating_add(asking.pause_nanos);
        asking.pause_nanos = (2 * asking.pause_nanos).min(LONGEST_RESUME_PAUSE_NANOS);
        Some((self.run, self.last))
    }

    pub fn on_sample(&mut self, run: u32, index: u64, key: SampleId) -> Admission {
        let asking = match &mut self.asking {
            Some(asking) if run == self.run => asking,
            _ => {
                self.n_stale += 1;
                return Admission::Stale;
            }
        };
        asking.is_heard = true;
        if index < self.expected {
            self.n_repeated += 1;
            return Admission::Repeated;
        }
        if index > self.expected {
            if self.policy == EdgePolicy::Lossless {
                self.reconnected();
                return Admission::Gap;
            }
            self.n_lost = self.n_lost.saturating_add(index - self.expected);
        }
        self.expected = index.saturating_add(1);
        self.last = Some(key);
        self.n_samples += 1;
        Admission::Deliver
    }

    /// The writer has ended, and the readers here have answered all its samples. Returns whether the sender must be
    /// told that this is known; an answer to an earlier request is ignored.
    pub fn on_end(&mut self, run: u32) -> bool {
        let asking = match &mut self.asking {
            Some(asking) if run == self.run => asking,
            _ => return false,
        };
        asking.is_heard = true;
        self.has_ended = true;
        true
    }

    /// Whether the writer has ended and all its samples were delivered.
    pub fn has_ended(&self) -> bool {
        self.has_ended
    }

    /// The last sample delivered.
    pub fn last(&self) -> Option<SampleId> {
        self.last
    }

    /// The acknowledgement that is due. `answered` is the last sample that all readers here have answered.
    pub fn ack_to_send(&mut self, answered: Option<SampleId>, now_nanos: u64) -> Option<Progress> {
        self.asking.as_ref()?;
        let progress = Progress { run: self.run, n_received: self.expected, answered };
        let due_nanos = match self.last_ack {
            Some((last, at_nanos)) if last == progress => at_nanos.saturating_add(ACK_REPEAT_NANOS),
            Some((_, at_nanos)) => at_nanos.saturating_add(ACK_PAUSE_NANOS),
            None if self.expected == 0 && answered.is_none() => return None,
            None => 0,
        };
        if now_nanos < due_nanos {
            return None;
        }
        self.last_ack = Some((progress, now_nanos));
        Some(progress)
    }

    /// Number of samples that answered an earlier request.
    pub fn n_stale(&self) -> u64 {
        self.n_stale
    }

    /// For `ps`; `port` is `NODE/PORT`. Lost samples are those of a `latest` channel that were sent and did not arrive.
    pub fn status(&self, port: &str) -> ChannelStatus {
        ChannelStatus {
            port: port.to_owned(),
            is_sent: false,
            n_samples: self.n_samples,
            n_repeated: self.n_repeated,
            n_waiting: 0,
            n_lost: self.n_lost,
            blocked_nanos: 0,
        }
    }
}

#[cfg(test)]
mod tests;
