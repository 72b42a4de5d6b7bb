//! Files that are complete or not there.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Where a file is written until it is complete: beside its place, so that a rename puts it there at once.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

/// Writes a file whole or not at all: under [`partial_path`], onto the disk, and then into its place.
///
/// # Errors
/// The file cannot be written; nothing is left of it, and what was in its place still is.
pub fn write_whole(path: &Path, content: impl AsRef<[u8]>) -> std::io::Result<()> {
    let partial = partial_path(path);
    let written = File::create(&partial)
        .and_then(|mut file| file.write_all(content.as_ref()).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&partial, path));
    if written.is_err() {
        let _ = std::fs::remove_file(&partial);
    }
    written
}
