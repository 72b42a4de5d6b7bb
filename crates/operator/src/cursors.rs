//! The cursors of a graph's processes: one small file in shared memory that says how far each of them has come.
//!
//! Each port has a slot, and each instance of a node. The active instance of a node writes the slots of its ports after
//! each sample; the slots outlive it, so an instance that takes over knows where it left off. Writers read the cursors of
//! their readers: a lossless writer never gets further ahead of a reader than its history reaches back, so no sample that a
//! reader has not answered can be lost when a process is killed.
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
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

use crate::ages::{AgeCounter, N_BUCKETS};
use crate::wiring::InputCounts;

/// "bg-board" in ASCII.
const MAGIC: u64 = u64::from_be_bytes(*b"bg-board");
/// Changes with the layout.
const LAYOUT: u64 = 2;
/// The offset of the first slot.
const HEADER_BYTES: usize = 4096;
/// The size of a slot: two cache lines, so that neighbours don't disturb each other.
pub const SLOT_BYTES: usize = 128;
/// The number of slots that the histogram of an input's ages takes, right behind the input's own slot.
pub const N_AGE_SLOTS: usize = N_BUCKETS * size_of::<u64>() / SLOT_BYTES;
/// The largest state of a node.
pub const STATE_BYTES: usize = 64 << 10;
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
    n_cells: usize,
    n_regions: usize,
    file: File,
}

// SAFETY: everything behind `base` is accessed through atomics, except the states, of which only the node's active
// instance writes one half, and no process reads that half meanwhile.
unsafe impl Send for SharedCursors {}
// SAFETY: as above.
unsafe impl Sync for SharedCursors {}

/// The number of a sample in a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct SampleId {
    /// The generation of the source.
    pub epoch: u64,
    pub seq: u64,
}

/// The cursor of a reader, and counts of its samples.
#[repr(C, align(128))]
pub struct InputSlot {
    last: SeqLock,
    n_received: AtomicU64,
    n_missing: AtomicU64,
    n_repeated: AtomicU64,
    n_reordered: AtomicU64,
    n_late: AtomicU64,
    /// 1 when no process reads on: its node was given up, or it is the slot of a guest and no guest is there.
    is_given_up: AtomicU64,
}

/// The cursor of a writer, and counts of its samples.
#[repr(C, align(128))]
pub struct OutputSlot {
    last: SeqLock,
    n_sent: AtomicU64,
    n_resent: AtomicU64,
    blocked_nanos: AtomicU64,
    /// 1 when the writer is on another machine whose link is cut off.
    is_cut_off: AtomicU64,
}

/// An instance's sign of life.
#[repr(C, align(128))]
pub struct InstanceSlot {
    heartbeat_nanos: AtomicU64,
}

/// A sample's number that one process writes and others read, who read again if it changed meanwhile (a seqlock).
#[repr(C)]
struct SeqLock {
    version: AtomicU64,
    epoch: AtomicU64,
    seq: AtomicU64,
}

impl SeqLock {
    fn store(&self, key: SampleId) {
        let version = self.version.load(Ordering::Relaxed);
        // The version is odd while the number is being written. A writer that was killed meanwhile leaves it odd.
        let begun = version | 1;
        self.version.store(begun, Ordering::Relaxed);
        std::sync::atomic::fence(Ordering::Release);
        self.epoch.store(key.epoch, Ordering::Relaxed);
        self.seq.store(key.seq, Ordering::Relaxed);
        self.version.store(begun + 1, Ordering::Release);
    }

    /// `None` before the first sample.
    fn load(&self) -> Option<SampleId> {
        const N_TRIES: u32 = 1000;
        for attempt in 0.. {
            let version = self.version.load(Ordering::Acquire);
            if version == 0 {
                return None;
            }
            let key = SampleId { epoch: self.epoch.load(Ordering::Relaxed), seq: self.seq.load(Ordering::Relaxed) };
            std::sync::atomic::fence(Ordering::Acquire);
            let is_whole = version.is_multiple_of(2) && self.version.load(Ordering::Relaxed) == version;
            // A writer that was killed between its two stores wrote the epoch first, which hardly ever changes.
            if is_whole || attempt == N_TRIES {
                return Some(key);
            }
            std::hint::spin_loop();
        }
        None
    }
}

impl SharedCursors {
    /// Makes a file of zeros.
    ///
    /// # Errors
    /// The file cannot be made or mapped.
    pub fn create(path: &Path, n_cells: usize, n_regions: usize) -> Result<SharedCursors, CursorsError> {
        let failed = |source: std::io::Error| CursorsError::Io { path: path.display().to_string(), source };
        let file = OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(path).map_err(failed)?;
        let n_bytes = HEADER_BYTES + n_cells * SLOT_BYTES;
        // The memory of the slots is taken now: an operator must not die of a full memory because it counts.
        rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, n_bytes as u64)
            .map_err(|error| failed(error.into()))?;
        file.set_len((page_aligned(n_bytes) + n_regions * REGION_BYTES) as u64).map_err(failed)?;
        let cursors = Self::map(file, n_cells, n_regions).map_err(failed)?;
        for (word, value) in [LAYOUT, n_cells as u64, n_regions as u64].into_iter().enumerate() {
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
        let alien = || CursorsError::Alien { path: path.display().to_string() };
        let file = OpenOptions::new().read(true).write(true).open(path).map_err(failed)?;
        let n_bytes = file.metadata().map_err(failed)?.len() as usize;
        if n_bytes < HEADER_BYTES {
            return Err(alien());
        }
        let header = Self::map(file.try_clone().map_err(failed)?, 0, 0).map_err(failed)?;
        let words: Vec<u64> = (0..4).map(|word| header.word(word * 8).load(Ordering::Acquire)).collect();
        let (n_cells, n_regions) = (words[2] as usize, words[3] as usize);
        if words[..2] != [MAGIC, LAYOUT] || size_of_cursors(n_cells, n_regions) != Some(n_bytes) {
            return Err(alien());
        }
        Self::map(file, n_cells, n_regions).map_err(failed)
    }

    fn map(file: File, n_cells: usize, n_regions: usize) -> std::io::Result<SharedCursors> {
        use rustix::mm::{MapFlags, ProtFlags, mmap};
        let n_bytes = size_of_cursors(n_cells, n_regions).ok_or(std::io::ErrorKind::InvalidInput)?;
        // SAFETY: a new mapping anywhere, of a file at least as large as the header says.
        let base = unsafe {
            mmap(std::ptr::null_mut(), n_bytes, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, &file, 0)?
        };
        let base = NonNull::new(base.cast()).ok_or(std::io::ErrorKind::OutOfMemory)?;
        Ok(SharedCursors { base, n_bytes, n_cells, n_regions, file })
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

    fn cell<T>(&self, idx: usize) -> &T {
        const { assert!(size_of::<T>() == SLOT_BYTES) }
        assert!(idx < self.n_cells, "slot {idx} of {}", self.n_cells);
        self.at(HEADER_BYTES + idx * SLOT_BYTES)
    }

    pub fn input(&self, idx: usize) -> &InputSlot {
        self.cell(idx)
    }

    /// The ages of an input's samples on arrival, in the slots behind the input's own.
    pub fn ages(&self, input_idx: usize) -> &AgeCounter {
        assert!(input_idx + N_AGE_SLOTS < self.n_cells, "slot {input_idx} of {}", self.n_cells);
        self.at(HEADER_BYTES + (input_idx + 1) * SLOT_BYTES)
    }

    pub fn output(&self, idx: usize) -> &OutputSlot {
        self.cell(idx)
    }

    pub fn instance(&self, idx: usize) -> &InstanceSlot {
        self.cell(idx)
    }

    fn region_offset(&self, idx: usize) -> usize {
        assert!(idx < self.n_regions, "state region {idx} of {}", self.n_regions);
        page_aligned(HEADER_BYTES + self.n_cells * SLOT_BYTES) + idx * REGION_BYTES
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
        let next = n_saved.load(Ordering::Relaxed) + 1;
        let slot = (next % 2) as usize;
        // SAFETY: within the region; no process reads this half before the counter names it.
        let bytes = unsafe {
            std::slice::from_raw_parts_mut(self.base.add(offset + 4096 + slot * STATE_BYTES).as_ptr(), state.len())
        };
        bytes.copy_from_slice(state);
        self.word(offset + 8 + 8 * slot).store(state.len() as u64, Ordering::Relaxed);
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
            let slot = (n_saved % 2) as usize;
            let len = (self.word(offset + 8 + 8 * slot).load(Ordering::Relaxed) as usize).min(STATE_BYTES);
            let mut state = vec![0; len];
            // SAFETY: within the region. The counter shows whether the active instance has written this half meanwhile.
            unsafe {
                let from = self.base.add(offset + 4096 + slot * STATE_BYTES);
                std::ptr::copy_nonoverlapping(from.as_ptr(), state.as_mut_ptr(), len);
            }
            std::sync::atomic::fence(Ordering::Acquire);
            if self.word(offset).load(Ordering::Relaxed) == n_saved {
                return Some(state);
            }
        }
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
        self.last.load()
    }

    pub fn counts(&self) -> InputCounts {
        let [n_received, n_missing, n_repeated, n_reordered, n_late] =
            [&self.n_received, &self.n_missing, &self.n_repeated, &self.n_reordered, &self.n_late]
                .map(|count| count.load(Ordering::Relaxed));
        InputCounts { n_received, n_missing, n_repeated, n_reordered, n_late }
    }

    /// Marks all samples up to `key` as answered.
    pub fn commit(&self, key: Option<SampleId>, counts: &InputCounts) {
        for (cell, count) in [
            (&self.n_received, counts.n_received),
            (&self.n_missing, counts.n_missing),
            (&self.n_repeated, counts.n_repeated),
            (&self.n_reordered, counts.n_reordered),
            (&self.n_late, counts.n_late),
        ] {
            cell.store(count, Ordering::Relaxed);
        }
        if let Some(key) = key {
            self.last.store(key);
        }
    }

    /// Whether no process will read on.
    pub fn is_given_up(&self) -> bool {
        self.is_given_up.load(Ordering::Acquire) != 0
    }

    /// Begins after `last` with nothing counted, as a guest does; its writers wait for it from now on.
    pub fn begin_after(&self, last: Option<SampleId>) {
        self.commit(last, &InputCounts::default());
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
        self.last.load()
    }

    pub fn n_sent(&self) -> u64 {
        self.n_sent.load(Ordering::Relaxed)
    }

    pub fn n_resent(&self) -> u64 {
        self.n_resent.load(Ordering::Relaxed)
    }

    /// The time for which the writer has waited for readers.
    pub fn blocked_nanos(&self) -> u64 {
        self.blocked_nanos.load(Ordering::Relaxed)
    }

    /// Counts a sample that was sent.
    pub fn commit(&self, key: SampleId) {
        if self.key().is_some_and(|last| last.epoch == key.epoch && key.seq <= last.seq) {
            self.n_resent.fetch_add(1, Ordering::Relaxed);
        } else {
            self.last.store(key);
            self.n_sent.fetch_add(1, Ordering::Relaxed);
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
        self.blocked_nanos.fetch_add(nanos, Ordering::Relaxed);
    }
}

impl InstanceSlot {
    /// Gives a sign of life.
    pub fn beat(&self, now_nanos: u64) {
        self.heartbeat_nanos.store(now_nanos, Ordering::Relaxed);
    }

    /// The last sign of life (CLOCK_MONOTONIC); 0 if there was none.
    pub fn last_beat_nanos(&self) -> u64 {
        self.heartbeat_nanos.load(Ordering::Relaxed)
    }
}

fn page_aligned(n_bytes: usize) -> usize {
    n_bytes.next_multiple_of(4096)
}

fn size_of_cursors(n_cells: usize, n_regions: usize) -> Option<usize> {
    let cells = n_cells.checked_mul(SLOT_BYTES)?.checked_add(HEADER_BYTES)?;
    cells.checked_next_multiple_of(4096)?.checked_add(n_regions.checked_mul(REGION_BYTES)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cursors(folder: &tempfile::TempDir) -> (SharedCursors, std::path::PathBuf) {
        let path = folder.path().join("cursors");
        (SharedCursors::create(&path, 3, 2).expect("a file of cursors"), path)
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
        let output = theirs.output(1);
        assert_eq!((output.key(), output.n_sent(), output.n_resent()), (Some(SampleId { epoch: 7, seq: 2 }), 3, 1));
        for state in [&b"one"[..], b"", b"three"] {
            assert!(mine.save_state(1, state));
            assert_eq!(theirs.state(1).as_deref(), Some(state));
        }
        assert_eq!(theirs.state(0), None);
        assert!(!mine.save_state(1, &vec![0; STATE_BYTES + 1]));
        assert_eq!(theirs.state(1).as_deref(), Some(&b"three"[..]));
    }

    #[test]
    fn a_writer_killed_amid_a_place_leaves_it_readable() {
        let folder = tempfile::tempdir().expect("a folder");
        let (cursors, _) = cursors(&folder);
        let cell = cursors.input(2);
        cell.commit(Some(SampleId { epoch: 1, seq: 5 }), &InputCounts::default());
        cell.last.version.fetch_add(1, Ordering::Relaxed);
        assert_eq!(cell.key(), Some(SampleId { epoch: 1, seq: 5 }));
        cell.commit(Some(SampleId { epoch: 1, seq: 6 }), &InputCounts::default());
        assert_eq!(cell.key(), Some(SampleId { epoch: 1, seq: 6 }));
        assert!(cell.last.version.load(Ordering::Relaxed).is_multiple_of(2));
    }

    #[test]
    fn something_else_is_not_a_board() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("alien");
        for content in [vec![], vec![1; HEADER_BYTES]] {
            std::fs::write(&path, content).expect("written");
            assert!(matches!(SharedCursors::open(&path), Err(CursorsError::Alien { .. })));
        }
    }
}
