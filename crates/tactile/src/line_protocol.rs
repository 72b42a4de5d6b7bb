//! The line protocol: lines of JSON, one frame each, and what the source answers. Pure: no I/O, no clock.

use serde::Serialize;

use super::{ExpectedHand, Place, Reading, Refusal, RefusalKind};

/// The version that the greeting names. It changes when an old bridge would no longer be understood.
pub const PROTOCOL: u32 = 1;
/// How much is read at a time.
const READ_BYTES: usize = 64 << 10;
/// What a line may take beside its numbers.
const KEYS_BYTES: usize = 4096;
/// What a number may take: a `f64` with all its digits, comma and space take 26.
const NUMBER_BYTES: usize = 32;

/// The longest line that can be a frame of this hand.
pub fn max_line_bytes(hand: &ExpectedHand) -> usize {
    KEYS_BYTES + NUMBER_BYTES * (hand.n_joints + hand.n_cells)
}

/// Reads a line, without its end.
///
/// # Errors
/// It is not JSON, or not of the form of a frame: an unknown or missing key, a value of another type.
pub fn parse(line: &[u8]) -> Result<Reading, Refusal> {
    let malformed = |why: String| Refusal { kind: RefusalKind::Malformed, why };
    let text = std::str::from_utf8(line).map_err(|error| malformed(format!("not UTF-8: {error}")))?;
    // serde would take a list of the values as well.
    if !text.trim_start().starts_with('{') {
        return Err(malformed("not a frame: expected an object with joints_rad, cells_newtons and phase".into()));
    }
    serde_json::from_str(text).map_err(|error| malformed(format!("not a frame: {error}")))
}

/// What the source says to whoever connects.
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

/// What the source says of a line that it refused: of which of the connection's lines, counted from 1, why, and how many
/// refused ones before it were not told.
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

/// What the source says to somebody who connects while somebody else sends.
pub fn busy_line(peer: &str) -> String {
    #[derive(Serialize)]
    struct Busy {
        refused: &'static str,
        why: String,
    }
    json_line(&Busy { refused: "busy", why: format!("{peer} is connected; one at a time") })
}

fn json_line(value: &impl Serialize) -> String {
    // Maps with text keys and numbers only: this cannot fail.
    serde_json::to_string(value).unwrap_or_default() + "\n"
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks for it")]
fn is_zero(number: &u64) -> bool {
    *number == 0
}

/// Cuts bytes into lines, in bounded memory: of a line that is too long, one [`Piece::TooLong`] is left.
#[derive(Debug)]
pub struct LineSplitter {
    buffer: Vec<u8>,
    /// What lies in the buffer: from the line at hand on.
    start: usize,
    end: usize,
    /// Up to where there is no end of line.
    scanned: usize,
    max_line_bytes: usize,
    /// Whether the line at hand was too long: its rest is nobody's.
    is_skipping: bool,
    /// Where the last read began, and since when what it brought, and what was there before it, can have waited.
    read_at: usize,
    read_since_nanos: u64,
    carried_since_nanos: u64,
}

/// A part of what came.
#[derive(Debug, PartialEq, Eq)]
pub enum Piece<'a> {
    /// A line without its end, and since when its beginning can have waited.
    Line(&'a [u8], u64),
    /// A line that is longer than allowed, as soon as that is known.
    TooLong,
}

impl LineSplitter {
    /// A splitter for lines of at most so many bytes, without their end.
    pub fn new(max_line_bytes: usize) -> Self {
        LineSplitter {
            buffer: vec![0; max_line_bytes + READ_BYTES],
            start: 0,
            end: 0,
            scanned: 0,
            max_line_bytes,
            is_skipping: false,
            read_at: 0,
            read_since_nanos: 0,
            carried_since_nanos: 0,
        }
    }

    /// Where to read to; to be asked for only when [`LineSplitter::next_piece`] has nothing.
    pub fn space(&mut self) -> &mut [u8] {
        self.buffer.copy_within(self.start..self.end, 0);
        self.read_at = self.read_at.saturating_sub(self.start);
        (self.start, self.end, self.scanned) = (0, self.end - self.start, self.scanned - self.start);
        &mut self.buffer[self.end..]
    }

    /// Says that so many bytes were read to [`LineSplitter::space`], which cannot have been there before `since_nanos`.
    pub fn filled(&mut self, n_bytes: usize, since_nanos: u64) {
        // The line at hand began with the last read, or before it.
        if self.start >= self.read_at {
            self.carried_since_nanos = self.read_since_nanos;
        }
        (self.read_at, self.read_since_nanos) = (self.end, since_nanos);
        self.end = (self.end + n_bytes).min(self.buffer.len());
    }

    /// The next whole line, if there is one. Empty lines are passed over.
    pub fn next_piece(&mut self) -> Option<Piece<'_>> {
        loop {
            let Some(found) = self.buffer[self.scanned..self.end].iter().position(|byte| *byte == b'\n') else {
                self.scanned = self.end;
                if self.is_skipping {
                    self.start = self.end;
                } else if self.end - self.start > self.max_line_bytes + 1 {
                    // One more byte than allowed may be the `\r` of its end.
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

    /// Whether a line has begun that has not ended; the rest of one that was too long is none.
    pub fn is_amid_a_line(&self) -> bool {
        self.start < self.end && !self.is_skipping
    }
}
