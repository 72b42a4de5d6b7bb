//! Files of a node whose content the dataflow file fixes by its SHA-256: the program under `run`, others under the param that
//! names them.
//!
//! A file is read before it is used, and may be changed in between: a pin finds the wrong file, it does not keep an attacker
//! who may write to the file from the graph.

use std::collections::{BTreeMap, HashMap};
use std::fs::Metadata;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use blindgrasp_messages::files::open_regular;
use serde::Serialize;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};

/// The name of the program among the pins.
pub const RUN: &str = "run";
const CHUNK_BYTES: usize = 1 << 16;
/// A file may change twice within the resolution of its times, which some file systems have in seconds.
const SETTLED_SECS: i64 = 2;

/// The digests, in lower case, that each file may have.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Pins(pub BTreeMap<String, Vec<String>>);

/// Why a pinned file is not used.
#[derive(Debug, thiserror::Error)]
pub enum PinError {
    #[error(
        "{of} is {}, whose SHA-256 is {found}, expected {}: bring back that file, or write the new digest into 'sha256' of the \
         node if the new content is meant",
        file.display(), expected.join(" or ")
    )]
    Other { of: String, file: PathBuf, found: String, expected: Vec<String> },
    #[error("{of} is {}, which cannot be read to compare its SHA-256", file.display())]
    Unreadable { of: String, file: PathBuf, source: std::io::Error },
    #[error("'sha256' names {of}, which has no value: set it, or leave its digest out")]
    NoFile { of: String },
}

impl Pins {
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Checks the program, if it is pinned.
    ///
    /// # Errors
    /// The file has another digest or cannot be read.
    pub fn check_program(&self, program: &Path) -> Result<(), PinError> {
        self.0.get(RUN).map_or(Ok(()), |expected| check_file("the program", program, expected))
    }

    /// Checks all files of a node.
    ///
    /// # Errors
    /// A file has another digest, cannot be read or is not named by its param.
    pub fn check(&self, program: &Path, params: &Map<String, Value>) -> Result<(), PinError> {
        self.check_program(program)?;
        let of_params = self.0.keys().filter(|name| *name != RUN);
        of_params.into_iter().try_for_each(|name| self.check_param(name, params))
    }

    /// Checks the file that a param names.
    ///
    /// # Errors
    /// As [`Pins::check`].
    pub(super) fn check_param(&self, name: &str, params: &Map<String, Value>) -> Result<(), PinError> {
        let (of, expected) = (format!("param '{name}'"), self.0.get(name).map_or(&[][..], Vec::as_slice));
        match params.get(name).and_then(Value::as_str) {
            Some(file) => check_file(&of, Path::new(file), expected),
            None => Err(PinError::NoFile { of }),
        }
    }
}

fn check_file(of: &str, file: &Path, expected: &[String]) -> Result<(), PinError> {
    let found = digest(file).map_err(|source| PinError::Unreadable { of: of.into(), file: file.into(), source })?;
    if expected.contains(&found) {
        return Ok(());
    }
    Err(PinError::Other { of: of.into(), file: file.into(), found, expected: expected.to_vec() })
}

/// The numbers that change with a file's content.
type Stamp = (u64, u64, u64, i64, i64, i64, i64);

/// A file's digest. That of a file that has not changed since is remembered: the launcher must not read a long recording
/// each time that it restarts a node.
fn digest(path: &Path) -> std::io::Result<String> {
    static KNOWN: Mutex<Option<HashMap<PathBuf, (Stamp, String)>>> = Mutex::new(None);
    let mut file = open_regular(path)?;
    let metadata = file.metadata()?;
    let stamp = stamp(&metadata);
    let found =
        KNOWN.lock().unwrap_or_else(PoisonError::into_inner).as_ref().and_then(|known| known.get(path).cloned());
    if let Some((_, digest)) = found.filter(|(before, _)| *before == stamp) {
        return Ok(digest);
    }
    let now_secs = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_secs() as i64);
    let (mut hasher, mut chunk) = (Sha256::new(), vec![0; CHUNK_BYTES]);
    loop {
        match file.read(&mut chunk)? {
            0 => break,
            n => hasher.update(&chunk[..n]),
        }
    }
    let digest: String = hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    if metadata.ctime() + SETTLED_SECS < now_secs {
        KNOWN
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get_or_insert_default()
            .insert(path.into(), (stamp, digest.clone()));
    }
    Ok(digest)
}

fn stamp(metadata: &Metadata) -> Stamp {
    (
        metadata.dev(),
        metadata.ino(),
        metadata.len(),
        metadata.mtime(),
        metadata.mtime_nsec(),
        metadata.ctime(),
        metadata.ctime_nsec(),
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// `printf abc | sha256sum`
    const ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

    fn pins(name: &str) -> Pins {
        Pins([(name.to_string(), vec!["0".repeat(64), ABC.into()])].into())
    }

    #[test]
    fn a_file_must_have_one_of_its_digests() {
        let folder = tempfile::tempdir().expect("a folder");
        let model = folder.path().join("model.json");
        let params = json!({ "model": model });
        let params = params.as_object().expect("a map");
        std::fs::write(&model, "abc").expect("written");
        pins("model").check(Path::new("any"), params).expect("the right content");
        pins(RUN).check_program(&model).expect("the right content");
        std::fs::write(&model, "abd").expect("written");
        let error = pins("model").check(Path::new("any"), params).expect_err("another content").to_string();
        for part in
            ["param 'model'", "model.json", "a52d159f262b2c6ddb724a61840befc36eb30c88877a4030b65cbe86298449c9", ABC]
        {
            assert!(error.contains(part), "{error}");
        }
        assert!(matches!(pins(RUN).check(&model, params), Err(PinError::Other { .. })));
        assert!(matches!(pins(RUN).check(folder.path(), params), Err(PinError::Unreadable { .. })));
        assert!(matches!(pins("hand").check(Path::new("any"), params), Err(PinError::NoFile { .. })));
    }

    #[test]
    fn a_file_that_changes_after_its_digest_was_remembered_is_read_again() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), "abc").expect("written");
        // Until its times are old enough.
        std::thread::sleep(std::time::Duration::from_secs(SETTLED_SECS as u64 + 2));
        (0..2).for_each(|_| assert_eq!(digest(file.path()).expect("read"), ABC));
        std::fs::write(file.path(), "abd").expect("written");
        assert_ne!(digest(file.path()).expect("read"), ABC);
    }
}
