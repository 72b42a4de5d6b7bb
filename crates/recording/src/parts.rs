//! Folders of recordings: one data set in several files, such as a simulation made in parts.
//!
//! The file `simulation.json` of a simulation's folder has the simulation's options and its number of parts. An
//! interrupted run, or other machines, can add missing parts, and an incomplete data set is refused.

use std::path::{Path, PathBuf};

use blindgrasp_messages::files::read_regular;
use serde::{Deserialize, Serialize};

use super::RecordingError;

const MANIFEST_NAME: &str = "simulation.json";
const FORMAT: &str = "blindgrasp-simulation/1";

/// The content of a simulation's folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    format: String,
    /// The version of the program.
    pub version: String,
    /// The hand's name.
    pub hand: String,
    /// Identifies the hand's description, shapes and thresholds included.
    #[serde(with = "blindgrasp_messages::hex_id")]
    pub hand_description_id: u64,
    /// The objects, as the user named them.
    pub objects: String,
    /// Identifies the objects: the same for the same names, classes, shapes and masses.
    #[serde(with = "blindgrasp_messages::hex_id")]
    pub objects_id: u64,
    /// All options of the simulation.
    pub options: serde_json::Value,
    /// The number of parts of the whole simulation.
    pub n_parts: usize,
}

impl Manifest {
    pub fn new(hand: (&str, u64), objects: (&str, u64), options: serde_json::Value, n_parts: usize) -> Self {
        Manifest {
            format: FORMAT.into(),
            version: env!("CARGO_PKG_VERSION").into(),
            hand: hand.0.into(),
            hand_description_id: hand.1,
            objects: objects.0.into(),
            objects_id: objects.1,
            options,
            n_parts,
        }
    }

    /// Reads a folder's manifest; `None` if it has none.
    ///
    /// # Errors
    /// It cannot be read or is invalid.
    pub fn read(folder: &Path) -> Result<Option<Manifest>, RecordingError> {
        let path = folder.join(MANIFEST_NAME);
        let text = match read_regular(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(RecordingError::Io { path, source }),
        };
        let invalid = |message: String| RecordingError::Invalid { path: path.clone(), message };
        let manifest: Manifest =
            serde_json::from_str(&text).map_err(|error| invalid(format!("not a simulation's manifest: {error}")))?;
        if manifest.format != FORMAT {
            return Err(invalid(format!("format '{}', expected '{FORMAT}'", manifest.format)));
        }
        Ok(Some(manifest))
    }

    /// Prepares a folder for parts of this simulation: a new folder, or one with some parts.
    ///
    /// # Errors
    /// The folder has another simulation or other files, or cannot be written.
    pub fn claim(&self, folder: &Path) -> Result<(), RecordingError> {
        let io = |source| RecordingError::Io { path: folder.into(), source };
        let invalid = |message: String| RecordingError::Invalid { path: folder.into(), message };
        if folder.exists() && !folder.is_dir() {
            return Err(invalid("this is a file: expected the name of a folder, or one that ends in .mcap".into()));
        }
        std::fs::create_dir_all(folder).map_err(io)?;
        if !folder.join(MANIFEST_NAME).exists() {
            let is_other = |name: std::ffi::OsString| !name.to_string_lossy().starts_with(MANIFEST_NAME);
            let mut entries = std::fs::read_dir(folder).map_err(io)?;
            if entries.any(|entry| entry.is_ok_and(|entry| is_other(entry.file_name()))) {
                let message = "this folder holds other files: name a new folder, or that of an interrupted simulation";
                return Err(invalid(message.into()));
            }
            self.write(folder).map_err(io)?;
        }
        // Another shard may have written the manifest meanwhile.
        let found = Manifest::read(folder)?.ok_or_else(|| invalid(format!("{MANIFEST_NAME} is gone")))?;
        match self.first_difference(&found) {
            None => Ok(()),
            Some(difference) => Err(invalid(format!(
                "this folder holds another simulation ({difference}): name another folder, or delete this one"
            ))),
        }
    }

    /// Writes the manifest, whole or not at all, unless there is one by now.
    fn write(&self, folder: &Path) -> std::io::Result<()> {
        // Processes in containers may all have the same id, so the name contains the time too.
        let since_epoch = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        let name = format!("{MANIFEST_NAME}.{}-{}", std::process::id(), since_epoch.as_nanos());
        let (partial, manifest) = (folder.join(name), folder.join(MANIFEST_NAME));
        let text = serde_json::to_string_pretty(self)? + "\n";
        let written = std::fs::write(&partial, text).and_then(|()| {
            // A link never replaces a file. On a file system without links, the last process wins.
            match std::fs::hard_link(&partial, &manifest) {
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Ok(()),
                Err(_) => std::fs::rename(&partial, &manifest),
                Ok(()) => Ok(()),
            }
        });
        let _ = std::fs::remove_file(&partial);
        written
    }

    fn first_difference(&self, found: &Manifest) -> Option<String> {
        let [ours, theirs] = [self, found].map(|manifest| serde_json::to_value(manifest).unwrap_or_default());
        let mut differences = Vec::new();
        collect_differences("", &theirs, &ours, &mut differences);
        differences.into_iter().next()
    }
}

pub fn part_path(folder: &Path, part_idx: usize) -> PathBuf {
    folder.join(format!("part-{part_idx:05}.mcap"))
}

/// The recordings that `paths` name: files as they are, folders as the recordings in them, in the order of their names.
/// Folders with parts of one simulation count as one folder.
///
/// # Errors
/// A folder without a recording, or folders with a simulation that is not complete.
pub fn recordings_in(paths: &[PathBuf]) -> Result<Vec<PathBuf>, RecordingError> {
    let mut all = Vec::new();
    let mut simulations: Vec<(Manifest, Vec<&PathBuf>)> = Vec::new();
    for path in paths {
        if path.is_dir()
            && let Some(manifest) = Manifest::read(path)?
        {
            match simulations.iter_mut().find(|(known, _)| *known == manifest) {
                Some((_, folders)) => folders.push(path),
                None => simulations.push((manifest, vec![path])),
            }
        }
    }
    for path in paths {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let invalid = |message: String| RecordingError::Invalid { path: path.clone(), message };
        if let Some((manifest, folders)) = simulations.iter().find(|(_, folders)| folders.contains(&path)) {
            if folders[0] != path {
                continue;
            }
            let mut n_missing = 0;
            for idx in 0..manifest.n_parts {
                match folders.iter().map(|folder| part_path(folder, idx)).find(|part| part.is_file()) {
                    Some(part) => all.push(part),
                    None => n_missing += 1,
                }
            }
            if n_missing > 0 {
                return Err(invalid(format!(
                    "{n_missing} of the simulation's {} parts are missing: repeat the simulate command to add them, name the \
                     other folders with its parts as well, or name the files that are there",
                    manifest.n_parts
                )));
            }
            continue;
        }
        let io = |source| RecordingError::Io { path: path.clone(), source };
        let mut found = Vec::new();
        for entry in std::fs::read_dir(path).map_err(io)? {
            let file = entry.map_err(io)?.path();
            if file.to_string_lossy().ends_with(".mcap.zstd") {
                let file = file.display();
                return Err(invalid(format!("{file} is compressed: unpack it (zstd -d {file})")));
            } else if file.extension().is_some_and(|extension| extension == "mcap") {
                found.push(file);
            }
        }
        if found.is_empty() {
            return Err(invalid("there is no recording in this folder: expected files that end in .mcap".into()));
        }
        found.sort();
        all.extend(found);
    }
    Ok(all)
}

fn collect_differences(at: &str, found: &serde_json::Value, wanted: &serde_json::Value, differences: &mut Vec<String>) {
    match (found, wanted) {
        (serde_json::Value::Object(found), serde_json::Value::Object(wanted)) => {
            for key in found.keys().chain(wanted.keys().filter(|key| !found.contains_key(*key))) {
                let inner = if at.is_empty() { key.clone() } else { format!("{at}.{key}") };
                let null = serde_json::Value::Null;
                let [found, wanted] = [found, wanted].map(|object| object.get(key).unwrap_or(&null));
                collect_differences(&inner, found, wanted, differences);
            }
        }
        _ if found != wanted => differences.push(format!("its {at} is {found}, now it is {wanted}")),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(seed: u64) -> Manifest {
        Manifest::new(("h", 1), ("builtin", 2), serde_json::json!({"seed": seed, "sensor": {"noise": 0.1}}), 2)
    }

    #[test]
    fn a_folder_is_claimed_once_and_again_by_the_same_simulation_only() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("data");
        manifest(1).claim(&path).expect("new");
        manifest(1).claim(&path).expect("the same");
        let error = manifest(2).claim(&path).expect_err("another").to_string();
        assert!(error.contains("options.seed is 1, now it is 2") && error.contains("data"), "{error}");
        let full = folder.path().join("full");
        std::fs::create_dir(&full).expect("made");
        std::fs::write(full.join("x"), "").expect("written");
        assert!(manifest(1).claim(&full).expect_err("full").to_string().contains("other files"));
    }

    #[test]
    fn a_compressed_file_of_a_folder_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("bag_0.mcap.zstd"), "").expect("written");
        let error = recordings_in(&[folder.path().into()]).expect_err("compressed").to_string();
        assert!(error.contains("bag_0.mcap.zstd is compressed: unpack it (zstd -d "), "{error}");
    }

    #[test]
    fn a_folder_with_missing_parts_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().to_path_buf();
        manifest(1).claim(&path).expect("new");
        std::fs::write(part_path(&path, 1), "").expect("written");
        let error = recordings_in(std::slice::from_ref(&path)).expect_err("one missing").to_string();
        assert!(error.contains("1 of the simulation's 2 parts"), "{error}");
        std::fs::write(part_path(&path, 0), "").expect("written");
        let found = recordings_in(&[path.clone(), "other.mcap".into()]).expect("complete");
        assert_eq!(found, [part_path(&path, 0), part_path(&path, 1), "other.mcap".into()]);
    }

    #[test]
    fn two_folders_that_are_whole_together_are_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let [one, two, other] = ["one", "two", "other"].map(|name| folder.path().join(name));
        for (path, seed) in [(&one, 1), (&two, 1), (&other, 2)] {
            manifest(seed).claim(path).expect("new");
        }
        std::fs::write(part_path(&one, 1), "").expect("written");
        std::fs::write(part_path(&two, 0), "").expect("written");
        std::fs::write(part_path(&other, 0), "").expect("written");
        let found = recordings_in(&[one.clone(), "a.mcap".into(), two.clone()]).expect("whole");
        assert_eq!(found, [part_path(&two, 0), part_path(&one, 1), "a.mcap".into()]);
        let error = recordings_in(&[one, other]).expect_err("two simulations").to_string();
        assert!(error.contains("1 of the simulation's 2 parts are missing"), "{error}");
    }

    #[test]
    fn a_folder_without_a_manifest_is_its_recordings_in_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().to_path_buf();
        assert!(recordings_in(std::slice::from_ref(&path)).is_err());
        for name in ["b.mcap", "a.mcap", "a.mcap.partial", "notes.txt"] {
            std::fs::write(path.join(name), "").expect("written");
        }
        let found = recordings_in(std::slice::from_ref(&path)).expect("two");
        assert_eq!(found, [path.join("a.mcap"), path.join("b.mcap")]);
    }
}
