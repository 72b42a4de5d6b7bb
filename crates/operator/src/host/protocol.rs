//! The messages between a host and its program: docs/operators.md describes them for programs.
//!
//! A message is the length of its body and its kind, 32 bits each, and the body. Bodies of messages that come once for a
//! sample have a fixed form, `Work`; all others are JSON. Numbers have the order of bytes of the machine.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The environment variable that names the descriptors from which a program reads and to which it writes, like `3,4`.
pub const PIPES_VARIABLE: &str = "BLINDGRASP_HOST";
/// The version of these messages.
pub(super) const VERSION: u32 = 1;
/// The longest body.
pub(super) const MAX_BODY_BYTES: usize = 16 << 20;
/// The most answers to one message.
const MAX_PARTS: usize = 256;
pub(super) const FRAME_BYTES: usize = 8;
const WORK_BYTES: usize = 16;
const PART_BYTES: usize = 16;

/// Of [`Work::flags`] to the program: more samples follow, and all are answered then.
pub(super) const MORE: u32 = 1;
/// Of [`Work::flags`] to the program: there is a state, which may be empty.
pub(super) const HAS_STATE: u32 = 2;
/// Of [`Work::flags`] from a source: it has nothing yet.
pub(super) const NOTHING_YET: u32 = 1;
/// Of [`Work::flags`] from a source: it has sent everything.
pub(super) const FINISHED: u32 = 2;

/// The kinds of messages from the host to the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Ask {
    /// [`Start`]; the program answers [`Say::Ready`].
    Start = 1,
    Restore,
    Sample,
    Silence,
    End,
    CutOff,
    /// New values of its live parameters.
    Set,
    /// The next sample of a source.
    Next,
    /// A source is to go on after these samples: [`Resume`].
    Resume,
    Open,
    Close,
    /// An answer that is about to be sent, which the program may change.
    Check,
}

/// The kinds of messages from the program to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Say {
    /// [`Ready`], in answer to [`Ask::Start`].
    Ready = 1,
    /// [`Work`], in answer to all other messages of the host.
    Done,
    /// The reason why it does not take new values of its parameters.
    Refused,
    /// The reason why it cannot go on.
    Failed,
    /// A line for the log, at any time.
    Log,
    /// Its counts of things other than samples, at any time.
    Counts,
    /// In answer to several samples at once: it wants them one by one.
    OneByOne,
}

impl Say {
    pub(super) fn of(kind: u32) -> Option<Say> {
        use Say::{Counts, Done, Failed, Log, OneByOne, Ready, Refused};
        [Ready, Done, Refused, Failed, Log, Counts, OneByOne].into_iter().find(|say| *say as u32 == kind)
    }
}

/// The body of [`Ask::Start`].
#[derive(Debug, Serialize)]
pub(super) struct Start<'a> {
    pub(super) version: u32,
    pub(super) params: &'a Map<String, Value>,
    /// The inputs that are connected.
    pub(super) inputs: Vec<&'a str>,
    pub(super) is_standby: bool,
    pub(super) clock: crate::wiring::Clock,
}

/// The body of [`Ask::Resume`]: epoch and number of the last sample that readers have, by output.
pub(super) type Resume = BTreeMap<String, Option<(u64, u64)>>;

/// The program's answer once it has its parameters.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Ready {
    /// Its neighbours, and an instance that takes its place, must have the same values.
    #[serde(default)]
    pub(super) identity: BTreeMap<String, String>,
    /// It has samples of its own.
    #[serde(default)]
    pub(super) is_source: bool,
    /// Each of its answers comes with its state.
    #[serde(default)]
    pub(super) has_state: bool,
    /// A source that can give its samples again, and numbers them itself.
    #[serde(default)]
    pub(super) resumes: bool,
    /// By output, the input whose samples it answers under their numbers.
    #[serde(default)]
    pub(super) answers: BTreeMap<String, String>,
    /// By output, the most items of a sample. The memory of an output that is not named grows.
    #[serde(default)]
    pub(super) max_items: BTreeMap<String, usize>,
    /// The most samples that it takes at once.
    #[serde(default)]
    pub(super) batch: usize,
    /// The messages that it wants to hear besides samples.
    #[serde(default)]
    pub(super) hears: Vec<Hears>,
    /// How long a source that has nothing waits before it is asked again.
    #[serde(default)]
    pub(super) pause_secs: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Hears {
    /// [`Ask::End`].
    End,
    /// [`Ask::CutOff`].
    CutOff,
    /// [`Ask::Check`].
    Check,
}

/// A sample in a message: the number of its port in the description, the bytes of its head and of its items.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Part {
    pub(super) port: usize,
    /// Of a source: so many numbers of the output are left out before it.
    pub(super) n_lost: u32,
    pub(super) head: Vec<u8>,
    pub(super) items: Vec<u8>,
}

/// The body of a message about samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Work {
    /// To the program: the time of arrival. From the program: when it wants to hear of silence, or 0.
    pub(super) nanos: u64,
    pub(super) flags: u32,
    pub(super) state: Vec<u8>,
    pub(super) parts: Vec<Part>,
}

impl Work {
    /// When a program wants to hear of silence.
    pub(super) fn deadline_nanos(&self) -> Option<u64> {
        if self.nanos == 0 { None } else { Some(self.nanos) }
    }
}

/// Why a message of a program cannot be read.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("its message of {n_bytes} bytes has {what} where they end: expected whole ones, at most {MAX_PARTS} samples")]
pub(super) struct WorkError {
    n_bytes: usize,
    what: &'static str,
}

/// Adds a message about samples to `bytes`. The first part is the sample, the others are its partners.
pub(super) fn write_work<'a>(
    nanos: u64,
    flags: u32,
    state: &[u8],
    parts: impl Iterator<Item = (usize, &'a [u8], &'a [u8])>,
    bytes: &mut Vec<u8>,
) {
    bytes.extend_from_slice(&nanos.to_ne_bytes());
    bytes.extend_from_slice(&flags.to_ne_bytes());
    bytes.extend_from_slice(&(state.len() as u32).to_ne_bytes());
    bytes.extend_from_slice(state);
    for (port, head, items) in parts {
        for number in [port, 0, head.len(), items.len()] {
            bytes.extend_from_slice(&(number as u32).to_ne_bytes());
        }
        bytes.extend_from_slice(head);
        bytes.extend_from_slice(items);
    }
}

/// Reads the body of [`Say::Done`].
///
/// # Errors
/// A length in it is longer than the rest.
pub(super) fn read_work(body: &[u8]) -> Result<Work, WorkError> {
    let mut rest = Rest { rest: body, n_bytes: body.len() };
    let fixed = rest.take(WORK_BYTES, "a beginning")?;
    let (nanos, flags, n_state) = (number(fixed, 0) | number(fixed, 4) << 32, number(fixed, 8), number(fixed, 12));
    let state = rest.take(n_state as usize, "a state")?.to_vec();
    let mut parts = Vec::new();
    while !rest.rest.is_empty() {
        if parts.len() == MAX_PARTS {
            return Err(rest.failed("more samples"));
        }
        let fixed = rest.take(PART_BYTES, "the beginning of a sample")?;
        let [port, n_lost, n_head, n_items] = [0, 4, 8, 12].map(|at| number(fixed, at));
        let head = rest.take(n_head as usize, "a head")?.to_vec();
        let items = rest.take(n_items as usize, "items")?.to_vec();
        parts.push(Part { port: port as usize, n_lost: n_lost as u32, head, items });
    }
    Ok(Work { nanos, flags: flags as u32, state, parts })
}

struct Rest<'a> {
    rest: &'a [u8],
    n_bytes: usize,
}

impl<'a> Rest<'a> {
    fn take(&mut self, n_bytes: usize, what: &'static str) -> Result<&'a [u8], WorkError> {
        let Some((taken, rest)) = self.rest.split_at_checked(n_bytes) else { return Err(self.failed(what)) };
        self.rest = rest;
        Ok(taken)
    }

    fn failed(&self, what: &'static str) -> WorkError {
        WorkError { n_bytes: self.n_bytes, what }
    }
}

/// The 32 bits at a place, which is there.
pub(super) fn number(bytes: &[u8], at: usize) -> u64 {
    let mut four = [0; 4];
    four.copy_from_slice(&bytes[at..at + 4]);
    u32::from_ne_bytes(four).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_read_back_and_no_part_of_them_is() {
        let mut bytes = Vec::new();
        let parts = [(1, &b"head"[..], &b"items"[..]), (0, &b""[..], &b"x"[..])];
        write_work(u64::MAX - 1, 3, b"state", parts.into_iter(), &mut bytes);
        let work = read_work(&bytes).expect("whole");
        assert_eq!((work.nanos, work.flags, &work.state[..]), (u64::MAX - 1, 3, &b"state"[..]));
        let read: Vec<_> = work.parts.iter().map(|part| (part.port, &part.head[..], &part.items[..])).collect();
        assert_eq!(read, parts);
        let whole_parts = [WORK_BYTES + 5, WORK_BYTES + 5 + PART_BYTES + 9];
        for n_bytes in 0..bytes.len() {
            assert_eq!(read_work(&bytes[..n_bytes]).is_ok(), whole_parts.contains(&n_bytes), "{n_bytes}");
        }
    }

    #[test]
    fn a_length_that_no_memory_has_is_refused() {
        let mut bytes = vec![0; WORK_BYTES];
        bytes[12..].copy_from_slice(&u32::MAX.to_ne_bytes());
        assert!(read_work(&bytes).is_err());
        let too_many = vec![0; WORK_BYTES + (MAX_PARTS + 1) * PART_BYTES];
        assert!(read_work(&too_many).is_err());
    }
}
