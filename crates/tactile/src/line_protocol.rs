//! The line protocol: lines of JSON, one frame each, and the source's answers. Pure: no I/O, no clock.

use std::borrow::Cow;

use blindgrasp_messages::{MAX_NAME_BYTES, TactileFrame};
use serde::Serialize;

use super::{ExpectedHand, Place, Reading, Refusal};

/// The protocol's version in the greeting. It changes when old bridges can no longer send.
pub const PROTOCOL: u32 = 1;
/// The begin of the checksum in a line.
const CRC_KEY: &str = ",\"crc\":";
/// Bytes read at a time.
const READ_BYTES: usize = 64 << 10;
/// The most bytes of a line beside its numbers.
const KEYS_BYTES: usize = 4096;
/// The most bytes of a number: an `f64` with all its digits, comma and space takes 26.
const NUMBER_BYTES: usize = 32;

/// The length of the longest line that can be a frame of this hand.
pub fn max_line_bytes(hand: &ExpectedHand) -> usize {
    KEYS_BYTES + NUMBER_BYTES * TactileFrame::max_items(hand.n_joints, hand.n_cells)
}

/// Reads a line, without its end.
///
/// # Errors
/// The line is not JSON, or it has an unknown or missing key, a value of another type, or a wrong checksum.
pub fn parse(line: &[u8]) -> Result<Reading, Refusal> {
    let text = std::str::from_utf8(line).map_err(|error| Refusal::malformed(format!("not UTF-8: {error}")))?;
    let text = &*without_checksum(text).map_err(Refusal::malformed)?;
    // serde would accept a list of the values as well.
    if !text.trim_start().starts_with('{') {
        return Err(Refusal::malformed("not a frame: expected an object with joints, cells_newtons and phase".into()));
    }
    let text = &*with_null_for_nan(text);
    let reading: Reading =
        serde_json::from_str(text).map_err(|error| Refusal::malformed(format!("not a frame: {error}")))?;
    match reading.object.as_ref().map(String::len) {
        Some(n_bytes @ (0 | NAME_TOO_LONG..)) => {
            Err(Refusal::malformed(format!("object has {n_bytes} bytes: expected a name of 1 to {MAX_NAME_BYTES}")))
        }
        _ => Ok(reading),
    }
}

const NAME_TOO_LONG: usize = MAX_NAME_BYTES + 1;

/// A line as JSON has it: Python's json writes NaN for a number that is none, which the standard does not know.
pub fn with_null_for_nan(text: &str) -> Cow<'_, str> {
    if !text.contains("NaN") {
        return text.into();
    }
    let (mut plain, mut in_name) = (String::new(), false);
    for part in text.split_inclusive('"') {
        plain += &if in_name { part.into() } else { part.replace("NaN", "null") };
        let before_quote = part.trim_end_matches('"');
        let n_escapes = before_quote.len() - before_quote.trim_end_matches('\\').len();
        if n_escapes.is_multiple_of(2) {
            in_name = !in_name;
        }
    }
    plain.into()
}

/// A line without its checksum: the last key `crc`, if it has one, is the CRC-32 of the line without that key.
fn without_checksum(text: &str) -> Result<Cow<'_, str>, String> {
    let Some((before, after)) = text.rsplit_once(CRC_KEY) else { return Ok(text.into()) };
    let given = after.trim_end().strip_suffix('}').and_then(|number| number.trim().parse::<u32>().ok());
    let given = given.ok_or("crc must be the last key, a whole number below 2^32")?;
    let line = format!("{before}}}");
    let found = crc32fast::hash(line.as_bytes());
    if found == given {
        Ok(line.into())
    } else {
        Err(format!("crc is {given}, expected {found}: the line has changed on its way"))
    }
}

/// The source's first line to a new sender.
pub fn greeting(hand: &ExpectedHand, place: &Place) -> String {
    #[derive(Serialize)]
    struct Greeting<'a> {
        blindgrasp: &'static str,
        protocol: u32,
        #[serde(flatten)]
        hand: &'a ExpectedHand,
        max_line_bytes: usize,
        last_seq: Option<u64>,
        last_grasp_id: Option<u64>,
    }
    json_line(&Greeting {
        blindgrasp: "tactile",
        protocol: PROTOCOL,
        hand,
        max_line_bytes: max_line_bytes(hand),
        last_seq: place.seq,
        last_grasp_id: place.grasp_id,
    })
}

/// The source's answer to a refused line: the line's number in the connection, from 1; why; and the number of refused
/// lines before it without an answer.
pub fn refusal_line(n_line: u64, refusal: &Refusal, n_untold: u64) -> String {
    #[derive(Serialize)]
    struct Told<'a> {
        refused: &'static str,
        line: u64,
        why: &'a str,
        #[serde(skip_serializing_if = "is_zero")]
        untold: u64,
    }
    json_line(&Told { refused: refusal.kind.word(), line: n_line, why: &refusal.why, untold: n_untold })
}

/// The source's answer to a client that connects while another one sends.
pub fn busy_line(peer: &str) -> String {
    #[derive(Serialize)]
    struct Busy {
        refused: &'static str,
        why: String,
    }
    json_line(&Busy { refused: "busy", why: format!("{peer} is connected; one at a time") })
}

fn json_line(value: &impl Serialize) -> String {
    // This cannot fail: the maps have text keys and numbers only.
    serde_json::to_string(value).unwrap_or_default() + "\n"
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks for it")]
fn is_zero(number: &u64) -> bool {
    *number == 0
}

/// Cuts bytes into lines, in bounded memory: a line that is too long becomes one [`Piece::TooLong`].
#[derive(Debug, Default)]
pub struct LineSplitter {
    buffer: Vec<u8>,
    /// The buffer holds bytes from `start`, where a line begins, to `end`.
    start: usize,
    end: usize,
    /// There is no end of line between `start` and here.
    scanned: usize,
    max_line_bytes: usize,
    /// Whether the rest of a line that was too long is being skipped.
    is_skipping: bool,
    /// The place in the buffer where the last read began.
    read_at: usize,
    /// The earliest time at which the bytes of the last read can have arrived.
    read_since_nanos: u64,
    /// The earliest time at which the bytes before the last read can have arrived.
    carried_since_nanos: u64,
}

#[derive(Debug, PartialEq, Eq)]
pub enum Piece<'a> {
    /// A line without its end, and the earliest time at which its beginning can have arrived.
    Line(&'a [u8], u64),
    /// A line that is longer than allowed; returned as soon as that is known.
    TooLong,
}

impl LineSplitter {
    /// A splitter for lines of at most `max_line_bytes`, without their end.
    pub fn new(max_line_bytes: usize) -> Self {
        LineSplitter { buffer: vec![0; max_line_bytes + READ_BYTES], max_line_bytes, ..LineSplitter::default() }
    }

    /// Room for the next read. Call it only after [`LineSplitter::next_piece`] returned `None`.
    pub fn space(&mut self) -> &mut [u8] {
        self.buffer.copy_within(self.start..self.end, 0);
        self.read_at = self.read_at.saturating_sub(self.start);
        (self.start, self.end, self.scanned) = (0, self.end - self.start, self.scanned - self.start);
        &mut self.buffer[self.end..]
    }

    /// Adds bytes that were read to [`LineSplitter::space`] and cannot have arrived before `since_nanos`.
    pub fn filled(&mut self, n_bytes: usize, since_nanos: u64) {
        // The current line began in the last read.
        if self.start >= self.read_at {
            self.carried_since_nanos = self.read_since_nanos;
        }
        (self.read_at, self.read_since_nanos) = (self.end, since_nanos);
        self.end = (self.end + n_bytes).min(self.buffer.len());
    }

    /// The next whole line. Empty lines are skipped.
    pub fn next_piece(&mut self) -> Option<Piece<'_>> {
        loop {
            let Some(found) = self.buffer[self.scanned..self.end].iter().position(|byte| *byte == b'\n') else {
                self.scanned = self.end;
                if self.is_skipping {
                    self.start = self.end;
                } else if self.end - self.start > self.max_line_bytes + 1 {
                    // The line may end in `\r`, one byte more than allowed.
                    self.start = self.end;
                    self.is_skipping = true;
                    return Some(Piece::TooLong);
                }
                return None;
            };
            let (start, stop) = (self.start, self.scanned + found);
            (self.start, self.scanned) = (stop + 1, stop + 1);
            if std::mem::take(&mut self.is_skipping) {
                continue;
            }
            let line = &self.buffer[start..stop];
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            if line.is_empty() {
                continue;
            }
            if line.len() > self.max_line_bytes {
                return Some(Piece::TooLong);
            }
            let is_carried = start < self.read_at;
            let since_nanos = if is_carried { self.carried_since_nanos } else { self.read_since_nanos };
            return Some(Piece::Line(line, since_nanos));
        }
    }

    /// Whether a line has begun and not ended. The rest of a line that was too long does not count.
    pub fn is_amid_a_line(&self) -> bool {
        self.start < self.end && !self.is_skipping
    }
}
