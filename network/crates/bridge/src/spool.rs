//! The samples that a link has committed and still keeps for another machine, in a file of the graph's folder: a link that is
//! killed and started again finds them there. The file ends with the graph. A link follows no link of the file system: it has
//! no sandbox, and could be led anywhere.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Result, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use blindgrasp_operator::cursors::SampleId;
use rustix::fs::OFlags;

use super::outgoing::KeptSample;

/// The file is written anew when it is longer than this, and longer than twice the samples in it that are still kept.
const SLACK_BYTES: u64 = 1 << 20;
/// The kinds of records: a sample, and the number of samples that were lost so far.
const SAMPLE: u8 = 0;
const LOST: u8 = 1;

#[derive(Debug)]
pub(super) struct Spool {
    path: PathBuf,
    file: File,
    n_bytes: u64,
    most_bytes: u64,
    n_lost: u64,
}

/// The content of a file.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Saved {
    pub(super) samples: Vec<KeptSample>,
    pub(super) n_lost: u64,
}

impl Spool {
    /// Opens a file, and reads what an earlier process has saved in it.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub(super) fn open(path: &Path) -> Result<(Spool, Saved)> {
        let no_follow = OFlags::NOFOLLOW.bits() as i32;
        let mut options = OpenOptions::new();
        let mut file = options.read(true).append(true).create(true).mode(0o600).custom_flags(no_follow).open(path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let (saved, n_bytes) = (read(&bytes), bytes.len() as u64);
        let mut spool = Spool { path: path.into(), file, n_bytes, most_bytes: 0, n_lost: saved.n_lost };
        // The end of the file may be half of a record.
        spool.replace(saved.samples.iter().map(KeptSample::as_parts), saved.n_lost)?;
        Ok((spool, saved))
    }

    /// Saves a sample.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn save(&mut self, (key, origin_nanos, message): (SampleId, u64, &[u8])) -> Result<()> {
        let mut record = Vec::with_capacity(32 + message.len());
        push_sample(&mut record, key, origin_nanos, message);
        self.append(&record)
    }

    /// Saves the number of lost samples, if it is another one.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn save_lost(&mut self, n_lost: u64) -> Result<()> {
        if n_lost == self.n_lost {
            return Ok(());
        }
        let mut record = Vec::new();
        push_lost(&mut record, n_lost);
        self.append(&record)?;
        self.n_lost = n_lost;
        Ok(())
    }

    /// Whether the file is due to be written anew, if that many of its samples are still kept.
    pub(super) fn is_long(&self, n_kept: usize) -> bool {
        self.n_bytes > self.most_bytes || (n_kept == 0 && self.n_bytes > SLACK_BYTES)
    }

    /// Writes the file anew with these samples alone.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn replace<'a>(
        &mut self,
        samples: impl Iterator<Item = (SampleId, u64, &'a [u8])>,
        n_lost: u64,
    ) -> Result<()> {
        let mut bytes = Vec::new();
        push_lost(&mut bytes, n_lost);
        samples.for_each(|(key, origin_nanos, message)| push_sample(&mut bytes, key, origin_nanos, message));
        let partial = self.path.with_extension("partial");
        // A link that was killed may have left one.
        match std::fs::remove_file(&partial) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let mut file = OpenOptions::new().append(true).create_new(true).mode(0o600).open(&partial)?;
        file.write_all(&bytes)?;
        std::fs::rename(&partial, &self.path)?;
        self.file = file;
        (self.n_bytes, self.n_lost) = (bytes.len() as u64, n_lost);
        self.most_bytes = 2 * self.n_bytes + SLACK_BYTES;
        Ok(())
    }

    fn append(&mut self, record: &[u8]) -> Result<()> {
        self.file.write_all(record)?;
        self.n_bytes += record.len() as u64;
        Ok(())
    }
}

fn push_sample(bytes: &mut Vec<u8>, key: SampleId, origin_nanos: u64, message: &[u8]) {
    bytes.push(SAMPLE);
    bytes.extend((message.len() as u64).to_le_bytes());
    [key.epoch, key.seq, origin_nanos].iter().for_each(|number| bytes.extend(number.to_le_bytes()));
    bytes.extend(message);
}

fn push_lost(bytes: &mut Vec<u8>, n_lost: u64) {
    bytes.push(LOST);
    bytes.extend(n_lost.to_le_bytes());
}

/// The records up to the first that is not complete.
fn read(mut bytes: &[u8]) -> Saved {
    let mut saved = Saved::default();
    while next_record(&mut bytes, &mut saved).is_some() {}
    saved
}

/// Takes a record from the front; `None` if there is no complete one.
fn next_record(bytes: &mut &[u8], saved: &mut Saved) -> Option<()> {
    let kind = bytes.split_off_first()?;
    match *kind {
        SAMPLE => {
            let length = usize::try_from(number(bytes)?).ok()?;
            let (epoch, seq, origin_nanos) = (number(bytes)?, number(bytes)?, number(bytes)?);
            let message = bytes.split_off(..length)?.to_vec();
            saved.samples.push(KeptSample { key: SampleId { epoch, seq }, origin_nanos, message });
        }
        LOST => saved.n_lost = number(bytes)?,
        _ => return None,
    }
    Some(())
}

fn number(bytes: &mut &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.split_off(..8)?.try_into().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(seq: u64) -> KeptSample {
        KeptSample { key: SampleId { epoch: 3, seq }, origin_nanos: 100 + seq, message: vec![seq as u8; seq as usize] }
    }

    #[test]
    fn a_new_process_finds_the_complete_samples_of_one_that_was_killed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("spool");
        let (mut spool, saved) = Spool::open(&path).expect("opened");
        assert_eq!(saved, Saved::default());
        let samples: Vec<KeptSample> = (0..5).map(sample).collect();
        for sample in &samples {
            spool.save(sample.as_parts()).expect("saved");
        }
        spool.save_lost(7).expect("saved");
        // It is killed while it writes.
        let whole = std::fs::read(&path).expect("readable");
        std::fs::write(&path, &whole[..whole.len() - 1]).expect("written");
        let (_, found) = Spool::open(&path).expect("opened");
        assert_eq!(found, Saved { samples: samples.clone(), n_lost: 0 });
        std::fs::write(&path, whole).expect("written");
        let (mut spool, found) = Spool::open(&path).expect("opened");
        assert_eq!(found, Saved { samples: samples.clone(), n_lost: 7 });
        // It goes on behind them.
        spool.save(sample(5).as_parts()).expect("saved");
        assert_eq!(Spool::open(&path).expect("opened").1.samples, (0..6).map(sample).collect::<Vec<_>>());
    }

    #[test]
    fn no_other_file_is_read_or_written_under_a_planted_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let (keys, path) = (folder.path().join("authorized_keys"), folder.path().join("spool"));
        std::fs::write(&keys, "mine").expect("written");
        std::os::unix::fs::symlink(&keys, path.with_extension("partial")).expect("planted");
        let (mut spool, _) = Spool::open(&path).expect("opened");
        spool.save(sample(1).as_parts()).expect("saved");
        std::os::unix::fs::symlink(&keys, path.with_extension("partial")).expect("planted");
        spool.replace([sample(2).as_parts()].into_iter(), 0).expect("written");
        std::fs::remove_file(&path).expect("removed");
        std::os::unix::fs::symlink(&keys, &path).expect("planted");
        assert!(Spool::open(&path).is_err());
        assert_eq!(std::fs::read(&keys).expect("there"), b"mine");
    }

    #[test]
    fn answered_samples_do_not_fill_the_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut spool, _) = Spool::open(&folder.path().join("spool")).expect("opened");
        let long = KeptSample { message: vec![1; 100_000], ..sample(1) };
        let mut most = 0;
        for _ in 0..100 {
            spool.save(long.as_parts()).expect("saved");
            if spool.is_long(1) {
                spool.replace([long.as_parts()].into_iter(), 0).expect("written");
            }
            most = most.max(spool.n_bytes);
        }
        assert!(most < 2_000_000, "{most}");
    }
}
