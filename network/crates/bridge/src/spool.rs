//! The samples that a link has committed and still keeps for another machine, in a file of the graph's folder: a link that is
//! killed and started again finds them there. The file ends with the graph. A link follows no link of the file system: it has
//! no sandbox, and could be led anywhere.

use std::borrow::Cow;
use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Read, Result, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use bincode::config::Configuration;
use rustix::fs::OFlags;
use serde::{Deserialize, Serialize};

use super::outgoing::KeptSample;

/// The file is written anew when it is longer than this, and longer than twice the samples in it that are still kept.
const SLACK_BYTES: u64 = 1 << 20;
const FORMAT: Configuration = bincode::config::standard();

#[derive(Serialize, Deserialize)]
enum Record<'a> {
    Sample(Cow<'a, KeptSample>),
    /// The number of samples that were lost so far.
    Lost(u64),
}

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
        spool.replace(saved.samples.iter(), saved.n_lost)?;
        Ok((spool, saved))
    }

    /// Saves a sample.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn save(&mut self, sample: &KeptSample) -> Result<()> {
        self.append(&Record::Sample(Cow::Borrowed(sample)))
    }

    /// Saves the number of lost samples, if it is another one.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn save_lost(&mut self, n_lost: u64) -> Result<()> {
        if n_lost == self.n_lost {
            return Ok(());
        }
        self.append(&Record::Lost(n_lost))?;
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
    pub(super) fn replace<'a>(&mut self, samples: impl Iterator<Item = &'a KeptSample>, n_lost: u64) -> Result<()> {
        let mut bytes = Vec::new();
        push(&mut bytes, &Record::Lost(n_lost))?;
        for sample in samples {
            push(&mut bytes, &Record::Sample(Cow::Borrowed(sample)))?;
        }
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

    fn append(&mut self, record: &Record<'_>) -> Result<()> {
        let mut bytes = Vec::new();
        push(&mut bytes, record)?;
        self.file.write_all(&bytes)?;
        self.n_bytes += bytes.len() as u64;
        Ok(())
    }
}

fn push(bytes: &mut Vec<u8>, record: &Record<'_>) -> Result<()> {
    bincode::serde::encode_into_std_write(record, bytes, FORMAT).map_err(Error::other)?;
    Ok(())
}

/// The records up to the first that is not complete.
fn read(mut bytes: &[u8]) -> Saved {
    let mut saved = Saved::default();
    while let Ok((record, n_bytes)) = bincode::serde::decode_from_slice(bytes, FORMAT) {
        match record {
            Record::Sample(sample) => saved.samples.push(sample.into_owned()),
            Record::Lost(n_lost) => saved.n_lost = n_lost,
        }
        bytes = &bytes[n_bytes..];
    }
    saved
}

#[cfg(test)]
mod tests {
    use blindgrasp_operator::cursors::SampleId;

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
            spool.save(sample).expect("saved");
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
        spool.save(&sample(5)).expect("saved");
        assert_eq!(Spool::open(&path).expect("opened").1.samples, (0..6).map(sample).collect::<Vec<_>>());
    }

    #[test]
    fn no_other_file_is_read_or_written_under_a_planted_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let (keys, path) = (folder.path().join("authorized_keys"), folder.path().join("spool"));
        std::fs::write(&keys, "mine").expect("written");
        std::os::unix::fs::symlink(&keys, path.with_extension("partial")).expect("planted");
        let (mut spool, _) = Spool::open(&path).expect("opened");
        spool.save(&sample(1)).expect("saved");
        std::os::unix::fs::symlink(&keys, path.with_extension("partial")).expect("planted");
        spool.replace([sample(2)].iter(), 0).expect("written");
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
            spool.save(&long).expect("saved");
            if spool.is_long(1) {
                spool.replace([&long].into_iter(), 0).expect("written");
            }
            most = most.max(spool.n_bytes);
        }
        assert!(most < 2_000_000, "{most}");
    }
}
