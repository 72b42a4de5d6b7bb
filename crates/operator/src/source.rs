//! An operator that has samples of its own, such as a hand or a recording.
//!
//! The source itself says what comes next. [`run`] makes it an operator that can be killed and swapped: it follows the
//! launcher's commands, gives signs of life, and tells the source where the node's last instance left off.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde_json::{Map, Value};

use blindgrasp_messages::{Header, Message};

use crate::monotonic_nanos;
use crate::operator::{Operator, TICK};
use crate::port::{PortError, Publisher, Sent};
use crate::waiter::PollFd;
use crate::wiring::Command;

/// What a step of a source has led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// The source may have more at once.
    Next,
    /// The source has nothing before that time, unless a sample or a descriptor wakes it.
    Wait(Option<Instant>),
    /// The source has sent everything. It is still asked for steps, in case that something remains to be received.
    Done,
    /// A publisher gave way to another instance: the source is resumed before its next step.
    GaveWay,
}

impl From<Sent> for Step {
    fn from(sent: Sent) -> Step {
        match sent {
            Sent::Yes => Step::Next,
            Sent::GaveWay => Step::GaveWay,
        }
    }
}

/// An operator's samples and where they come from.
pub trait Source {
    /// Finds the place at which to go on: called before the first step, and again after another instance was active or a
    /// publisher gave way. With `is_handed_over`, readers will receive everything that the other instance has sent;
    /// otherwise, only what they have answered is certain. Returns false if a command interrupted it.
    ///
    /// # Errors
    /// The source cannot go on.
    fn resume(&mut self, _is_handed_over: bool) -> anyhow::Result<bool> {
        Ok(true)
    }

    /// Sends the next sample if it is due, or does the next bit of work. It must not wait for anything but readers.
    ///
    /// # Errors
    /// The source cannot go on.
    fn step(&mut self) -> anyhow::Result<Step>;

    /// Lets the publishers look for readers that have come back, and the subscribers for their writers: called some times
    /// a second, also while another instance is active.
    ///
    /// # Errors
    /// The reason of a port.
    fn look(&mut self) -> anyhow::Result<()>;

    /// Adds the descriptors that wake the source while it takes steps.
    fn watch<'a>(&'a self, _fds: &mut Vec<PollFd<'a>>) {}

    /// Becomes the active instance beside others of the node: opens a device, for example.
    ///
    /// # Errors
    /// The source cannot go on.
    fn take_over(&mut self) -> anyhow::Result<()> {
        Ok(())
    }

    /// Lets go of what another instance needs, such as a device: called when another instance takes over, and at the end.
    fn close(&mut self) {}

    /// Takes new values of its live parameters.
    ///
    /// # Errors
    /// Values that it cannot take; it goes on with the old ones.
    fn set(&mut self, _params: &Map<String, Value>) -> anyhow::Result<()> {
        anyhow::bail!("it has no parameters that can be changed while it runs")
    }

    /// The number of the next sample, to which new values of parameters apply.
    fn next_seq(&self) -> Option<u64> {
        None
    }
}

/// Runs a source until the operator is asked to stop. The launcher is told the `identity` (see [`Operator::ready`]).
///
/// # Errors
/// An error of the source.
pub fn run(operator: &Operator, identity: BTreeMap<String, String>, mut source: impl Source) -> anyhow::Result<()> {
    let (mut is_active, mut may_go) = (!operator.begins_as_standby(), false);
    let (mut is_handed_over, mut is_placed, mut is_done) = (false, false, false);
    let mut last_look = Instant::now();
    operator.ready(identity);
    while !operator.should_stop() {
        while let Some(command) = operator.next_command() {
            match command {
                Command::Go => may_go = true,
                Command::TakeOver { is_handed_over: handed_over } => {
                    source.take_over()?;
                    (is_active, is_handed_over, is_placed) = (true, handed_over, false);
                    operator.took_over();
                }
                Command::HandOver => {
                    (is_active, is_placed) = (false, false);
                    source.close();
                    operator.handed_over();
                }
                Command::Set { id, params } => {
                    let from_seq = source.next_seq();
                    operator.has_set(id, source.set(&params), from_seq);
                }
                Command::NodeEnded { .. } | Command::TakeNoMore { .. } | Command::Drain | Command::Quit => {}
            }
        }
        operator.beat();
        let takes_steps = is_active && may_go;
        if takes_steps && !is_placed {
            is_placed = source.resume(is_handed_over)?;
            is_done = false;
        }
        let step = if takes_steps && is_placed { source.step()? } else { Step::Wait(None) };
        if last_look.elapsed() >= TICK {
            last_look = Instant::now();
            operator.look_at_descriptors()?;
            source.look()?;
        }
        is_placed &= step != Step::GaveWay;
        let until = match step {
            Step::Next | Step::GaveWay => continue,
            Step::Wait(until) => until,
            Step::Done => {
                if !std::mem::replace(&mut is_done, true) {
                    operator.finished();
                }
                None
            }
        };
        let mut fds = Vec::new();
        if takes_steps {
            source.watch(&mut fds);
        }
        operator.wait_for(&fds, until.map_or(TICK, |until| until.saturating_duration_since(Instant::now())));
    }
    source.close();
    operator.drained(|| source.look())
}

/// Sends a message under this header, whose `origin_nanos` is set to the current time.
///
/// # Errors
/// A reader had no room for too long, or the reason of the port.
pub fn send<M: Message>(
    operator: &Operator,
    publisher: &mut Publisher<M>,
    message: &M,
    header: Header,
) -> Result<Sent, PortError> {
    let (head, items) = message.to_parts(Header { origin_nanos: monotonic_nanos(), ..header });
    operator.beat();
    publisher.send(head, &items, &mut || operator.should_yield())
}

/// Turns the times of samples into waiting.
#[derive(Debug)]
pub struct Pace {
    /// How many times faster than the samples' own time they are due; `None`: at once.
    pub rate: Option<f64>,
    longest_pause: Duration,
    /// When the last sample was due, and its own time.
    last: Option<(Instant, u64)>,
}

impl Pace {
    /// A pace at which longer pauses between two samples than `longest_pause` are cut to that.
    pub fn new(rate: Option<f64>, longest_pause: Duration) -> Pace {
        Pace { rate, longest_pause, last: None }
    }

    /// Forgets the last sample: the next one is due at once.
    pub fn restart(&mut self) {
        self.last = None;
    }

    /// When the next sample is due, which bears that time.
    pub fn due(&mut self, stamp_nanos: u64) -> Instant {
        let Some(rate) = self.rate else {
            self.last = None;
            return Instant::now();
        };
        let (last_due, last_stamp_nanos) = self.last.unwrap_or((Instant::now(), stamp_nanos));
        let recorded = Duration::from_nanos(stamp_nanos.saturating_sub(last_stamp_nanos));
        if recorded > self.longest_pause {
            tracing::warn!(stamp_nanos, "skipping a pause of {:.0} s in the recording", recorded.as_secs_f64());
        }
        let pause = Duration::try_from_secs_f64(recorded.min(self.longest_pause).as_secs_f64() / rate);
        let due = last_due.checked_add(pause.unwrap_or(self.longest_pause)).unwrap_or(last_due);
        self.last = Some((due, stamp_nanos));
        due
    }
}

/// As [`send`], for a message in the form in which it lies in shared memory.
///
/// # Errors
/// As [`send`].
pub fn send_parts<M: Message>(
    operator: &Operator,
    publisher: &mut Publisher<M>,
    mut head: M::Head,
    items: &[M::Item],
) -> Result<Sent, PortError> {
    M::header_mut(&mut head).origin_nanos = monotonic_nanos();
    operator.beat();
    publisher.send(head, items, &mut || operator.should_yield())
}
