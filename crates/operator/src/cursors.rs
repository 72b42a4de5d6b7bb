//! The cursors of a graph's processes: one small file in shared memory that says how far each of them has come.
//!
//! Each port has a slot, and each instance of a node. The active instance of a node writes the slots of its ports after
//! each sample; the slots outlive it, so an instance that takes over knows where it left off. A slot is committed as a
//! whole: a process that is killed at any moment leaves the record before or the record after, and nothing between. Writers
//! read the cursors of their readers. A lossless writer never gets further ahead of a reader than its history reaches back,
//! so no sample that a reader has not answered can be lost when a process is killed.
//!
//! The slot of an input is followed by [`N_AGE_SLOTS`] slots with the [histogram](crate::ages) of the ages of its samples on
//! arrival.
//!
//! Each node also has a region for its state: two halves of [`STATE_BYTES`], written in turn, so that one of them is always
//! complete.
//!
//! Layout: a page of header (magic, layout version, number of slots, number of regions, each 8 bytes, native order),
//! then [`SLOT_BYTES`] a slot, then the state regions. Every number is 64 bits, aligned.

use std::fs::{File, OpenOptions};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use serde::{Deserialize, Serialize};

use crate::ages::{AgeCounter, N_BUCKETS};
use crate::bell::Bell;
use crate::wiring::InputCounts;
use crate::written::Written;

/// "bgcursor" in ASCII.
const MAGIC: u64 = u64::from_be_bytes(*b"bgcursor");
/// Changes with the layout.
const LAYOUT: u64 = 5;
/// The offset of the first slot.
const HEADER_BYTES: usize = 4096;
/// The size of a slot: two cache lines, so that neighbours don't disturb each other.
pub const SLOT_BYTES: usize = 128;
/// The number of slots that the histogram of an input's ages takes, right behind the input's own slot.
pub const N_AGE_SLOTS: usize = N_BUCKETS * size_of::<u64>() / SLOT_BYTES;
/// The slot of the bell of the launching command, which reads decisions.
pub const RUN_BELL: usize = 0;
/// The slot of the bell of the command that compares an operator with its replacement.
pub const COMPARE_BELL: usize = 1;
/// The number of slots with bells of commands. The slots of nodes and ports follow.
pub const N_COMMAND_BELLS: usize = 2;
/// The largest state of a node.
pub const STATE_BYTES: usize = 256 << 10;
/// A state region: the number of the valid half, the length of each half, the halves.
const REGION_BYTES: usize = 4096 + 2 * STATE_BYTES;

/// Why the file of cursors cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CursorsError {
    #[error("the graph's file of cursors {path} cannot be made or opened")]
    Io { path: String, source: std::io::Error },
    #[error("{path} is not a file of cursors of this version of blindgrasp")]
    Alien { path: String },
}

/// The mapped file of cursors.
pub struct SharedCursors {
    base: NonNull<u8>,
    n_bytes: usize,
    n_slots: usize,
    n_regions: usize,
    file: File,
}

// SAFETY: everything behind `base` is accessed through atomics.
unsafe impl Send for SharedCursors {}
// SAFETY: as above.
unsafe impl Sync for SharedCursors {}

/// The number of a sample in a stream. Two of them have no order: see [`Written`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SampleId {
    /// The generation of the source.
    pub epoch: u64,
    pub seq: u64,
}

/// A record of `N` words that one process writes and others read. There are two records, written in turn, and the word
/// that says whose turn it is: it changes last, so the record that it names is always complete.
#[repr(C)]
struct Commits<const N: usize, W = AtomicU64> {
    /// The number of commits; record `turn % 2` is valid. 0: none is.
    turn: W,
    records: [[W; N]; 2],
}

/// A word of shared memory. Tests put one in its place whose orders of memory are all tried.
trait Word {
    fn load(&self, order: Ordering) -> u64;
    fn store(&self, value: u64, order: Ordering);
    fn fence(order: Ordering);
}

impl Word for AtomicU64 {
    fn load(&self, order: Ordering) -> u64 {
        self.load(order)
    }

    fn store(&self, value: u64, order: Ordering) {
        self.store(value, order);
    }

    fn fence(order: Ordering) {
        fence(order);
    }
}

impl<const N: usize, W: Word> Commits<N, W> {
    /// Replaces the record. Only one process at a time may.
    fn store(&self, words: [u64; N]) {
        let next = self.turn.load(Ordering::Relaxed).wrapping_add(1);
        // A reader that sees a word of the new record also sees that the turn has changed since its record was valid.
        W::fence(Ordering::Release);
        for (word, value) in self.records[(next % 2) as usize].iter().zip(words) {
            word.store(value, Ordering::Relaxed);
        }
        self.turn.store(next, Ordering::Release);
    }

    /// The last record; `None` before the first commit.
    fn load(&self) -> Option<[u64; N]> {
        loop {
            let turn = self.turn.load(Ordering::Acquire);
            if turn == 0 {
                return None;
            }
            let record = &self.records[(turn % 2) as usize];
            let words = std::array::from_fn(|idx| record[idx].load(Ordering::Relaxed));
            W::fence(Ordering::Acquire);
            // Otherwise the writer has come round to this record again meanwhile.
            if self.turn.load(Ordering::Relaxed) == turn {
                return Some(words);
            }
        }
    }
}

/// The cursor of a reader, and counts of its samples.
#[repr(C, align(128))]
pub struct InputSlot {
    /// Epoch and number of the last sample; received, missing, repeated, reordered, late.
    last: Commits<7>,
    /// 1 when no process reads on: its node was given up, or it is a slot for attached readers that none uses.
    is_given_up: AtomicU64,
}

/// The cursor of a writer, and counts of its samples.
#[repr(C, align(128))]
pub struct OutputSlot {
    /// Epoch and number of the last sample, the first number of its epoch; sent, nanoseconds of waiting for readers; epoch and
    /// number of the last sample of the epoch before.
    last: Commits<7>,
    /// 1 when the writer is on another machine whose link is cut off.
    is_cut_off: AtomicU64,
}

/// An instance's sign of life, the sample that it works on, and its bell.
#[repr(C, align(128))]
pub struct InstanceSlot {
    heartbeat_nanos: AtomicU64,
    epoch: AtomicU64,
    /// The number of the sample and 1; 0 between samples.
    seq_and_1: AtomicU64,
    /// The instance alone writes the words before, its writers the bell: they are in different cache lines.
    _rest_of_line: [u64; 5],
    bell: Bell,
}

/// The number of a record that names no sample yet.
const NO_SEQ: u64 = u64::MAX;

fn to_words(key: Option<SampleId>) -> [u64; 2] {
    key.map_or([0, NO_SEQ], |key| [key.epoch, key.seq])
}

fn from_words(epoch: u64, seq: u64) -> Option<SampleId> {
    (seq != NO_SEQ).then_some(SampleId { epoch, seq })
}

impl SharedCursors {
    /// Makes a file of zeros.
    ///
    /// # Errors
    /// The file cannot be made or mapped.
    pub fn create(path: &Path, n_slots: usize, n_regions: usize) -> Result<SharedCursors, CursorsError> {
        let failed = |source: std::io::Error| CursorsError::Io { path: path.display().to_string(), source };
        let file = OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(path).map_err(failed)?;
        let n_bytes = HEADER_BYTES + n_slots * SLOT_BYTES;
        // The memory of the slots is taken now: an operator must not die of a full memory because it counts.
        rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, n_bytes as u64)
            .map_err(|error| failed(error.into()))?;
        file.set_len((page_aligned(n_bytes) + n_regions * REGION_BYTES) as u64).map_err(failed)?;
        let cursors = Self::map(file, n_slots, n_regions).map_err(failed)?;
        for (word, value) in [LAYOUT, n_slots as u64, n_regions as u64].into_iter().enumerate() {
            cursors.word((word + 1) * 8).store(value, Ordering::Relaxed);
        }
        cursors.word(0).store(MAGIC, Ordering::Release);
        Ok(cursors)
    }

    /// Opens a file that another process has made.
    ///
    /// # Errors
    /// The file cannot be opened or mapped, or has another layout.
    pub fn open(path: &Path) -> Result<SharedCursors, CursorsError> {
        let failed = |source: std::io::Error| CursorsError::Io { path: path.display().to_string(), source };
        let no_follow = rustix::fs::OFlags::NOFOLLOW.bits() as i32;
        let file = OpenOptions::new().read(true).write(true).custom_flags(no_follow).open(path).map_err(failed)?;
        let metadata = file.metadata().map_err(failed)?;
        let n_bytes = metadata.len() as usize;
        let is_own = metadata.is_file() && metadata.uid() == rustix::process::getuid().as_raw();
        if !is_own || n_bytes < HEADER_BYTES {
            return Err(CursorsError::Alien { path: path.display().to_string() });
        }
        let header = Self::map(file.try_clone().map_err(failed)?, 0, 0).map_err(failed)?;
        let words: Vec<u64> = (0..4).map(|word| header.word(word * 8).load(Ordering::Acquire)).collect();
        let (n_slots, n_regions) = (words[2] as usize, words[3] as usize);
        if words[..2] != [MAGIC, LAYOUT] || size_of_cursors(n_slots, n_regions) != Some(n_bytes) {
            return Err(CursorsError::Alien { path: path.display().to_string() });
        }
        Self::map(file, n_slots, n_regions).map_err(failed)
    }

    fn map(file: File, n_slots: usize, n_regions: usize) -> std::io::Result<SharedCursors> {
        use rustix::mm::{MapFlags, ProtFlags, mmap};
        let n_bytes = size_of_cursors(n_slots, n_regions).ok_or(std::io::ErrorKind::InvalidInput)?;
        // SAFETY: a new mapping anywhere, of a file at least as large as the header says.
        let base = unsafe {
            mmap(std::ptr::null_mut(), n_bytes, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, &file, 0)?
        };
        let base = NonNull::new(base.cast()).ok_or(std::io::ErrorKind::OutOfMemory)?;
        Ok(SharedCursors { base, n_bytes, n_slots, n_regions, file })
    }

    fn word(&self, offset: usize) -> &AtomicU64 {
        self.at(offset)
    }

    /// The part of the mapping at an offset.
    fn at<T>(&self, offset: usize) -> &T {
        assert!(
            offset + size_of::<T>() <= self.n_bytes && offset.is_multiple_of(align_of::<T>()),
            "beyond the file of cursors"
        );
        // SAFETY: within the mapping, aligned, and all types used are made of atomics, for which any bits are valid.
        unsafe { self.base.add(offset).cast().as_ref() }
    }

    fn slot<T>(&self, idx: usize) -> &T {
        const { assert!(size_of::<T>() == SLOT_BYTES) }
        assert!(idx < self.n_slots, "slot {idx} of {}", self.n_slots);
        self.at(HEADER_BYTES + idx * SLOT_BYTES)
    }

    pub fn input(&self, idx: usize) -> &InputSlot {
        self.slot(idx)
    }

    /// The ages of an input's samples on arrival, in the slots behind the input's own.
    pub fn ages(&self, input_idx: usize) -> &AgeCounter {
        assert!(input_idx + N_AGE_SLOTS < self.n_slots, "slot {input_idx} of {}", self.n_slots);
        self.at(HEADER_BYTES + (input_idx + 1) * SLOT_BYTES)
    }

    pub fn output(&self, idx: usize) -> &OutputSlot {
        self.slot(idx)
    }

    pub fn instance(&self, idx: usize) -> &InstanceSlot {
        self.slot(idx)
    }

    /// The bell of an instance, or of a reader that is no node.
    pub fn bell(&self, idx: usize) -> &Bell {
        &self.instance(idx).bell
    }

    fn region_offset(&self, idx: usize) -> usize {
        assert!(idx < self.n_regions, "state region {idx} of {}", self.n_regions);
        page_aligned(HEADER_BYTES + self.n_slots * SLOT_BYTES) + idx * REGION_BYTES
    }

    /// Takes the memory for a node's state now, so that saving it cannot fail later.
    ///
    /// # Errors
    /// There is no room in shared memory.
    pub fn reserve_state(&self, region: usize) -> std::io::Result<()> {
        let offset = self.region_offset(region) as u64;
        rustix::fs::fallocate(&self.file, rustix::fs::FallocateFlags::empty(), offset, REGION_BYTES as u64)?;
        Ok(())
    }

    /// Saves a node's state in place of the last one; only its active instance may. False if the state is too long.
    #[must_use]
    pub fn save_state(&self, region: usize, state: &[u8]) -> bool {
        if state.len() > STATE_BYTES {
            return false;
        }
        let offset = self.region_offset(region);
        let n_saved = self.word(offset);
        let next = n_saved.load(Ordering::Relaxed).wrapping_add(1);
        let half = (next % 2) as usize;
        // As in `Commits::store`.
        fence(Ordering::Release);
        for (word, chunk) in self.half(offset, half).iter().zip(state.chunks(8)) {
            let mut bytes = [0; 8];
            bytes[..chunk.len()].copy_from_slice(chunk);
            word.store(u64::from_ne_bytes(bytes), Ordering::Relaxed);
        }
        self.word(offset + 8 + 8 * half).store(state.len() as u64, Ordering::Relaxed);
        n_saved.store(next, Ordering::Release);
        true
    }

    /// The state that a node's active instance saved last, if any.
    pub fn state(&self, region: usize) -> Option<Vec<u8>> {
        let offset = self.region_offset(region);
        loop {
            let n_saved = self.word(offset).load(Ordering::Acquire);
            if n_saved == 0 {
                return None;
            }
            let half = (n_saved % 2) as usize;
            let len = (self.word(offset + 8 + 8 * half).load(Ordering::Relaxed) as usize).min(STATE_BYTES);
            let words = self.half(offset, half)[..len.div_ceil(8)].iter();
            let mut state: Vec<u8> = words.flat_map(|word| word.load(Ordering::Relaxed).to_ne_bytes()).collect();
            state.truncate(len);
            fence(Ordering::Acquire);
            if self.word(offset).load(Ordering::Relaxed) == n_saved {
                return Some(state);
            }
        }
    }

    /// Drops a node's state; only its active instance may.
    pub fn forget_state(&self, region: usize) {
        let offset = self.region_offset(region);
        // A region that was never used takes no memory, and a look at it through the mapping would take some.
        let mut n_saved = [0; 8];
        let is_used = rustix::io::pread(&self.file, &mut n_saved, offset as u64) != Ok(8) || n_saved != [0; 8];
        if is_used {
            self.word(offset).store(0, Ordering::Release);
        }
    }

    /// One half of a state region.
    fn half(&self, region_offset: usize, half: usize) -> &[AtomicU64; STATE_BYTES / 8] {
        self.at(region_offset + 4096 + half * STATE_BYTES)
    }
}

impl Drop for SharedCursors {
    fn drop(&mut self) {
        // SAFETY: the mapping is our own, and all borrows of it have ended.
        let _ = unsafe { rustix::mm::munmap(self.base.as_ptr().cast(), self.n_bytes) };
    }
}

impl InputSlot {
    /// The last sample that was answered.
    pub fn key(&self) -> Option<SampleId> {
        self.last.load().and_then(|[epoch, seq, ..]| from_words(epoch, seq))
    }

    pub fn counts(&self) -> InputCounts {
        let [_, _, n_received, n_missing, n_repeated, n_reordered, n_late] = self.last.load().unwrap_or_default();
        InputCounts { n_received, n_missing, n_repeated, n_reordered, n_late }
    }

    /// Marks all samples up to `key` as answered; with `None`, only the counts are new.
    pub fn commit(&self, key: Option<SampleId>, counts: &InputCounts) {
        self.place_at(key.or_else(|| self.key()), counts);
    }

    /// Puts the cursor behind `key`, or at the start of the stream.
    pub fn place_at(&self, key: Option<SampleId>, counts: &InputCounts) {
        let [epoch, seq] = to_words(key);
        let InputCounts { n_received, n_missing, n_repeated, n_reordered, n_late } = *counts;
        self.last.store([epoch, seq, n_received, n_missing, n_repeated, n_reordered, n_late]);
    }

    /// Whether no process will read on.
    pub fn is_given_up(&self) -> bool {
        self.is_given_up.load(Ordering::Acquire) != 0
    }

    /// Begins after `last` with nothing counted, as an attached reader does; its writers wait for it from now on.
    pub fn begin_after(&self, last: Option<SampleId>) {
        self.place_at(last, &InputCounts::default());
        self.is_given_up.store(0, Ordering::Release);
    }

    /// Sets whether its node was given up, so that writers wait for it no longer.
    pub fn give_up(&self, is_given_up: bool) {
        self.is_given_up.store(is_given_up.into(), Ordering::Relaxed);
    }
}

impl OutputSlot {
    /// The last sample that was sent.
    pub fn key(&self) -> Option<SampleId> {
        self.written().map(|written| written.last)
    }

    /// How far the instances of the node have come.
    pub fn written(&self) -> Option<Written> {
        written_of(&self.record())
    }

    pub fn n_sent(&self) -> u64 {
        self.record()[3]
    }

    /// The last sample that was sent, and the number of samples up to it.
    pub(crate) fn sent(&self) -> (Option<SampleId>, u64) {
        let record = self.record();
        (from_words(record[0], record[1]), record[3])
    }

    /// How many of the samples after the first `n_before` a reader lacks; 0 while it has not answered the last one.
    pub(crate) fn n_lost(&self, reader: &InputSlot, n_before: u64) -> u64 {
        let (last, n_sent) = self.sent();
        if reader.key() != last {
            return 0;
        }
        (n_sent - n_before).saturating_sub(reader.counts().n_received)
    }

    /// The time for which the writer has waited for readers.
    pub fn blocked_nanos(&self) -> u64 {
        self.record()[4]
    }

    fn record(&self) -> [u64; 7] {
        self.last.load().unwrap_or([0, NO_SEQ, 0, 0, 0, 0, NO_SEQ])
    }

    /// Counts a sample that is sent. One that is sent again moves nothing.
    pub fn commit(&self, key: SampleId) {
        let record = self.record();
        if let Some(written) = Written::with(written_of(&record), key) {
            let [before_epoch, before_seq] = to_words(written.before);
            let [.., n_sent, blocked_nanos, _, _] = record;
            let Written { last, first_seq, .. } = written;
            self.last.store([last.epoch, last.seq, first_seq, n_sent + 1, blocked_nanos, before_epoch, before_seq]);
        }
    }

    /// Whether the link to the writer's machine is cut off.
    pub fn is_cut_off(&self) -> bool {
        self.is_cut_off.load(Ordering::Acquire) != 0
    }

    pub fn set_cut_off(&self, is_cut_off: bool) {
        self.is_cut_off.store(is_cut_off.into(), Ordering::Release);
    }

    pub fn add_blocked(&self, nanos: u64) {
        let mut record = self.record();
        record[4] += nanos;
        self.last.store(record);
    }
}

fn written_of(record: &[u64; 7]) -> Option<Written> {
    let [epoch, seq, first_seq, _, _, before_epoch, before_seq] = *record;
    Some(Written { last: from_words(epoch, seq)?, first_seq, before: from_words(before_epoch, before_seq) })
}

impl InstanceSlot {
    /// Gives a sign of life.
    pub fn beat(&self, now_nanos: u64) {
        self.heartbeat_nanos.store(now_nanos, Ordering::Relaxed);
    }

    /// The last sign of life (CLOCK_BOOTTIME); 0 if there was none.
    pub fn last_beat_nanos(&self) -> u64 {
        self.heartbeat_nanos.load(Ordering::Relaxed)
    }

    /// Names the sample that the instance works on from now.
    pub fn works_on(&self, sample: Option<SampleId>) {
        if let Some(sample) = sample {
            self.epoch.store(sample.epoch, Ordering::Relaxed);
        }
        self.seq_and_1.store(sample.map_or(0, |sample| sample.seq.wrapping_add(1)), Ordering::Release);
    }

    /// The sample that the instance works on, or worked on when it died.
    pub fn sample(&self) -> Option<SampleId> {
        let seq_and_1 = self.seq_and_1.load(Ordering::Acquire);
        (seq_and_1 != 0).then(|| SampleId { epoch: self.epoch.load(Ordering::Relaxed), seq: seq_and_1.wrapping_sub(1) })
    }
}

fn page_aligned(n_bytes: usize) -> usize {
    n_bytes.next_multiple_of(4096)
}

fn size_of_cursors(n_slots: usize, n_regions: usize) -> Option<usize> {
    let slots = n_slots.checked_mul(SLOT_BYTES)?.checked_add(HEADER_BYTES)?;
    slots.checked_next_multiple_of(4096)?.checked_add(n_regions.checked_mul(REGION_BYTES)?)
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    fn cursors(folder: &tempfile::TempDir) -> (SharedCursors, std::path::PathBuf) {
        let path = folder.path().join("cursors");
        (SharedCursors::create(&path, 3, 2).expect("a file of cursors"), path)
    }

    #[test]
    fn a_whole_epoch_that_a_reader_lacks_is_counted() {
        let folder = tempfile::tempdir().expect("a folder");
        let cursors = SharedCursors::create(&folder.path().join("cursors"), 2, 0).expect("made");
        let (writer, reader) = (cursors.output(0), cursors.input(1));
        for (epoch, seq) in [(9, 0), (9, 1), (2, 0), (2, 1), (5, 0)] {
            writer.commit(SampleId { epoch, seq });
        }
        // It has begun after the first sample, and received two: 9.1 and 5.0.
        reader.place_at(Some(SampleId { epoch: 9, seq: 1 }), &InputCounts { n_received: 1, ..InputCounts::default() });
        assert_eq!(writer.n_lost(reader, 1), 0, "it has not read all");
        reader.place_at(Some(SampleId { epoch: 5, seq: 0 }), &InputCounts { n_received: 2, ..InputCounts::default() });
        assert_eq!(writer.n_lost(reader, 1), 2);
    }

    #[test]
    fn what_one_process_writes_another_reads() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mine, path) = cursors(&folder);
        let theirs = SharedCursors::open(&path).expect("opened");
        assert_eq!((theirs.input(0).key(), theirs.output(1).key(), theirs.state(1)), (None, None, None));
        let (key, counts) = (SampleId { epoch: 7, seq: 0 }, InputCounts { n_received: 1, ..Default::default() });
        mine.input(0).commit(Some(key), &counts);
        assert_eq!((theirs.input(0).key(), theirs.input(0).counts()), (Some(key), counts));
        for seq in [0, 1, 1, 2] {
            mine.output(1).commit(SampleId { epoch: 7, seq });
        }
        mine.output(1).add_blocked(4);
        mine.output(1).add_blocked(5);
        let output = theirs.output(1);
        assert_eq!((output.key(), output.n_sent()), (Some(SampleId { epoch: 7, seq: 2 }), 3));
        assert_eq!(output.blocked_nanos(), 9);
        mine.input(0).give_up(true);
        assert!(theirs.input(0).is_given_up());
        mine.input(0).begin_after(None);
        assert!(!theirs.input(0).is_given_up());
        assert_eq!((theirs.input(0).key(), theirs.input(0).counts()), (None, InputCounts::default()));
        for sample in [None, Some(key), None] {
            mine.instance(2).works_on(sample);
            assert_eq!(theirs.instance(2).sample(), sample);
        }
        for state in [&b"one"[..], b"", b"three"] {
            assert!(mine.save_state(1, state));
            assert_eq!(theirs.state(1).as_deref(), Some(state));
        }
        assert_eq!(theirs.state(0), None);
        assert!(mine.save_state(0, &vec![0; STATE_BYTES]));
        mine.forget_state(0);
        assert!(!mine.save_state(1, &vec![0; STATE_BYTES + 1]));
        assert_eq!(theirs.state(1).as_deref(), Some(&b"three"[..]));
        mine.forget_state(0);
        mine.forget_state(1);
        assert_eq!((theirs.state(0), theirs.state(1)), (None, None));
        assert!(mine.save_state(1, b"four"));
        assert_eq!(theirs.state(1).as_deref(), Some(&b"four"[..]));
    }

    loom::thread_local! {
        /// The stores that a process can still make before it is killed.
        static N_STORES_LEFT: Cell<u32> = Cell::new(u32::MAX);
    }

    #[derive(Default)]
    struct ModelWord(loom::sync::atomic::AtomicU64);

    impl Word for ModelWord {
        fn load(&self, order: Ordering) -> u64 {
            self.0.load(order)
        }

        fn store(&self, value: u64, order: Ordering) {
            let n_left = N_STORES_LEFT.with(Cell::get);
            if n_left > 0 {
                N_STORES_LEFT.with(|left| left.set(n_left - 1));
                self.0.store(value, order);
            }
        }

        fn fence(order: Ordering) {
            loom::sync::atomic::fence(order);
        }
    }

    /// A process is interrupted at most so often in a run. Without a bound the test takes five minutes, and passes as well.
    const N_PREEMPTIONS: usize = 3;

    /// The interleavings and orders of memory that the Rust memory model allows, x86 or ARM, of a writer that is killed after
    /// any of its stores, its successor, and a reader beside them. The reader sees whole records, in order.
    #[test]
    fn no_reader_sees_a_record_that_was_not_committed_as_a_whole() {
        for n_stores in 0..=3 {
            let mut model = loom::model::Builder::new();
            model.preemption_bound = Some(N_PREEMPTIONS);
            model.check(move || {
                let slot = loom::sync::Arc::new(Commits::<2, ModelWord> {
                    turn: ModelWord::default(),
                    records: Default::default(),
                });
                slot.store([1, 1]);
                let theirs = loom::sync::Arc::clone(&slot);
                let writers = loom::thread::spawn(move || {
                    let of_first = loom::sync::Arc::clone(&theirs);
                    let first = loom::thread::spawn(move || {
                        N_STORES_LEFT.with(|left| left.set(n_stores));
                        of_first.store([2, 2]);
                    });
                    first.join().expect("killed or done");
                    theirs.store([3, 3]);
                    theirs.store([4, 4]);
                });
                let mut last = 1;
                for _ in 0..2 {
                    let [one, other] = slot.load().expect("there is a record");
                    assert!(one == other && one >= last, "{one} {other} after {last}");
                    last = one;
                }
                writers.join().expect("done");
                assert_eq!(slot.load(), Some([4, 4]));
            });
        }
    }

    #[test]
    fn a_reader_beside_a_writer_sees_whole_records_and_states_in_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let (cursors, path) = cursors(&folder);
        let n_rounds: u64 = 20_000;
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let slot = cursors.input(0);
                for round in 1..=n_rounds {
                    let counts = InputCounts { n_received: round, n_missing: 2 * round, ..InputCounts::default() };
                    slot.commit(Some(SampleId { epoch: round, seq: 3 * round }), &counts);
                    assert!(cursors.save_state(0, &round.to_le_bytes().repeat((round % 40) as usize)));
                }
            });
            scope.spawn(|| {
                let theirs = SharedCursors::open(&path).expect("opened");
                let mut last = 0;
                while last < n_rounds {
                    if let Some([epoch, seq, n_received, n_missing, ..]) = theirs.input(0).last.load() {
                        assert_eq!([seq, n_received, n_missing], [3 * epoch, epoch, 2 * epoch]);
                        assert!(epoch >= last);
                        last = epoch;
                    }
                    if let Some(state) = theirs.state(0) {
                        let rounds: Vec<&[u8]> = state.chunks(8).collect();
                        assert!(rounds.windows(2).all(|pair| pair[0] == pair[1]), "{state:?}");
                    }
                }
            });
        });
    }

    #[test]
    fn another_file_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("alien");
        let (_, own) = cursors(&folder);
        let own = std::fs::read(own).expect("read");
        let other = [&[0][..], &own[1..]].concat();
        for content in [vec![], vec![1; HEADER_BYTES], other, own[..own.len() - 1].to_vec()] {
            std::fs::write(&path, content).expect("written");
            assert!(matches!(SharedCursors::open(&path), Err(CursorsError::Alien { .. })));
        }
    }
}
