//! The folder for the recordings of replays.

use std::collections::BTreeSet;
use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail};

/// A folder for the recordings of replays. It is removed with this value, unless they are to be kept.
pub(super) struct Scratch {
    folder: PathBuf,
    is_kept: bool,
}

impl Scratch {
    pub(super) fn new(keep: Option<&Path>, recordings: &[PathBuf]) -> anyhow::Result<Scratch> {
        let mut private = DirBuilder::new();
        let folder = match keep {
            Some(folder) => {
                let mut names = BTreeSet::new();
                if let Some(twice) = recordings.iter().find(|path| !names.insert(path.file_name())) {
                    bail!("--keep: two recordings are called {}: test them apart", file_name(twice));
                }
                private.recursive(true);
                folder.to_path_buf()
            }
            // Another user may have made a folder of any name there: this one must be new.
            None => {
                let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
                let name = format!("blindgrasp-test-{}-{}", std::process::id(), since_epoch.as_nanos());
                std::env::temp_dir().join(name)
            }
        };
        private.mode(0o700).create(&folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
        Ok(Scratch { folder, is_kept: keep.is_some() })
    }

    /// The path of the recording of a replay.
    pub(super) fn path(&self, recording: &Path) -> PathBuf {
        self.folder.join(file_name(recording))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if !self.is_kept {
            let _ = std::fs::remove_dir_all(&self.folder);
        }
    }
}

pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
