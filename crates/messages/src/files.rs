//! Names of files that are being written.

use std::path::{Path, PathBuf};

/// Where a file is written until it is complete: beside its place, so that a rename puts it there at once.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}
