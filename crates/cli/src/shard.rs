//! Work that several processes share.

use std::fmt;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, bail, ensure};
use blindgrasp_messages::files::open_regular;
use blindgrasp_messages::hex_id;
use serde::{Deserialize, Serialize};

/// The part of the work of one of several processes, as `--shard I/N` says it. The parts together are the whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    pub idx: u64,
    pub n: u64,
}

impl Shard {
    /// Whether the work of this number belongs to it.
    pub fn has(self, number: usize) -> bool {
        number as u64 % self.n == self.idx
    }

    /// Of all items, its own.
    pub fn of<T>(self, items: Vec<T>) -> Vec<T> {
        let numbered = items.into_iter().enumerate();
        numbered.filter(|(number, _)| self.has(*number)).map(|(_, item)| item).collect()
    }
}

impl Default for Shard {
    /// The whole.
    fn default() -> Self {
        Shard { idx: 0, n: 1 }
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(idx, n)| Some((idx.parse().ok()?, n.parse().ok()?)));
        match numbers {
            Some((idx, n)) if idx < n => Ok(Shard { idx, n }),
            _ => Err("expected I/N with I from 0 to N-1, such as 3/16".into()),
        }
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.idx, self.n)
    }
}

/// The place of a shard's output in the whole. The output has it, and [`merge_files`] asks for it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Place {
    shard: Shard,
    /// Of the program's version and the options.
    #[serde(with = "hex_id")]
    options_id: u64,
    /// Of the names of all files of the whole, their lengths and their ends.
    #[serde(with = "hex_id")]
    files_id: u64,
    /// The number of lines of each of the shard's files.
    n_lines: Vec<usize>,
    /// Of all these and the lines.
    #[serde(with = "hex_id")]
    output_id: u64,
}

/// A hash that another process of this build finds as well.
pub fn hash(content: impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    content.hash(&mut hasher);
    hasher.finish()
}

/// The length of a file and its last bytes. In those of a recording, its index and the checksum of its samples lie.
fn end_of(path: &Path) -> std::io::Result<(u64, Vec<u8>)> {
    const MOST_BYTES: u64 = 256 << 10;
    let mut file = open_regular(path)?;
    let n_bytes = file.metadata()?.len();
    file.seek(SeekFrom::Start(n_bytes.saturating_sub(MOST_BYTES)))?;
    let mut end = Vec::new();
    file.take(MOST_BYTES).read_to_end(&mut end)?;
    Ok((n_bytes, end))
}

impl Place {
    /// The place of an output without a line so far, of a whole with these options and files.
    pub fn new(shard: Shard, options: impl Hash, files: &[PathBuf]) -> Place {
        let mut hasher = DefaultHasher::new();
        for path in files {
            (path, end_of(path).ok()).hash(&mut hasher);
        }
        let options_id = hash((env!("CARGO_PKG_VERSION"), options));
        Place { shard, options_id, files_id: hasher.finish(), n_lines: Vec::new(), output_id: 0 }
    }

    /// The place of an output with so many lines of each file, whose content has this [`hash`].
    pub fn of_output(mut self, n_lines: Vec<usize>, content_id: u64) -> Place {
        self.n_lines = n_lines;
        self.output_id = self.id_with(content_id);
        self
    }

    fn id_with(&self, content_id: u64) -> u64 {
        hash((self.shard.to_string(), self.options_id, self.files_id, &self.n_lines, content_id))
    }

    /// What differs from the whole of another place.
    fn difference(&self, other: &Place) -> Option<&'static str> {
        if self.options_id != other.options_id {
            return Some("program, options, model and hand");
        }
        if self.files_id == other.files_id { None } else { Some("files under the same paths") }
    }
}

/// The lines of the whole in its order, from the files with the outputs of all shards. `read` gives the place, the content's
/// [`hash`] and the lines of a file.
///
/// # Errors
/// A file cannot be read or is not as it was written, or those of [`all_shards`].
pub fn merge_files<T>(
    paths: &[PathBuf],
    mut read: impl FnMut(&Path) -> anyhow::Result<(Place, u64, Vec<T>)>,
) -> anyhow::Result<Vec<T>> {
    let mut shards = Vec::new();
    for path in paths {
        let (place, content_id, lines) = read(path).with_context(|| path.display().to_string())?;
        let Place { shard, output_id, .. } = place;
        ensure!(
            output_id == place.id_with(content_id),
            "{}: it is not as it was written: make shard {shard} again",
            path.display()
        );
        shards.push((shard, (place, lines)));
    }
    let (mut inputs, mut whole) = (Vec::new(), Vec::new());
    for (place, lines) in all_shards(shards, |(one, _), (other, _)| one.difference(other))? {
        inputs.push((place.n_lines.into_iter(), lines.into_iter()));
    }
    // The shards take turns, a file each. The first one without a file is behind the last file of all.
    for idx in (0..inputs.len()).cycle() {
        let (n_lines, lines) = &mut inputs[idx];
        let Some(n) = n_lines.next() else { break };
        whole.extend(lines.take(n));
    }
    Ok(whole)
}

/// The outputs of all shards, in the order of the shards. `difference` names the property by which two are not of one whole.
///
/// # Errors
/// A shard is missing, there twice, or of another whole.
pub fn all_shards<T>(
    mut outputs: Vec<(Shard, T)>,
    difference: impl Fn(&T, &T) -> Option<&'static str>,
) -> anyhow::Result<Vec<T>> {
    outputs.sort_by_key(|(shard, _)| shard.idx);
    let n = outputs.first().context("--merge: expected all shards, found none")?.0.n;
    for (at, (shard, output)) in outputs.iter().enumerate() {
        for (known, other) in &outputs[..at] {
            let differs = if shard.n == known.n { difference(other, output) } else { Some("number of shards") };
            if let Some(differs) = differs {
                bail!("--merge: shard {shard} is of another run than {known}: expected the same {differs}");
            }
            ensure!(shard != known, "--merge: shard {shard} is there twice");
        }
    }
    for idx in 0..n {
        match outputs.get(idx as usize) {
            Some((shard, _)) if shard.idx == idx => {}
            _ => bail!("--merge: expected {n} shards, found {}: {idx}/{n} is missing", outputs.len()),
        }
    }
    ensure!(outputs.len() as u64 == n, "--merge: expected {n} shards, found {}", outputs.len());
    Ok(outputs.into_iter().map(|(_, output)| output).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_together_are_the_whole_once() {
        let shards = ["0/3", "1/3", "2/3"].map(|text| text.parse::<Shard>().expect("a shard"));
        let mut all = Vec::new();
        for shard in shards {
            let own = shard.of(Vec::from_iter(0..8));
            assert!(own.iter().all(|number| shard.has(*number)));
            all.extend(own);
        }
        all.sort_unstable();
        assert_eq!(all, Vec::from_iter(0..8));
        assert_eq!(Shard::default().of(vec![1, 2]), [1, 2]);
        for text in ["3/3", "0/0", "1", "-1/2", "a/b"] {
            text.parse::<Shard>().expect_err(text);
        }
    }

    /// The lines of files that have 0, 1, 2, … lines, each with the number of its file.
    fn output(shard: Shard, n_files: usize, options: &str) -> (Place, Vec<usize>) {
        let files: Vec<PathBuf> = (0..n_files).map(|number| number.to_string().into()).collect();
        let n_lines = shard.of(Vec::from_iter(0..n_files));
        let lines = n_lines.iter().flat_map(|number| vec![*number; *number]).collect();
        (Place::new(shard, options, &files).of_output(n_lines, 0), lines)
    }

    fn merged(outputs: &[(Place, Vec<usize>)]) -> anyhow::Result<Vec<usize>> {
        let (mut next, paths) = (outputs.iter(), vec![PathBuf::new(); outputs.len()]);
        merge_files(&paths, |_| {
            let (place, lines) = next.next().context("no output")?;
            Ok((place.clone(), 0, lines.clone()))
        })
    }

    #[test]
    fn the_lines_of_all_shards_are_those_of_the_whole() {
        for (n, n_files) in [(1, 0), (1, 4), (3, 2), (3, 6), (3, 7), (3, 8)] {
            let (_, whole) = output(Shard::default(), n_files, "");
            let shards: Vec<_> = (0..n).rev().map(|idx| output(Shard { idx, n }, n_files, "")).collect();
            assert_eq!(merged(&shards).expect("whole"), whole, "{n} shards of {n_files} files");
        }
    }

    #[test]
    fn other_data_under_the_same_name_is_another_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        let place = |content: &str| {
            std::fs::write(&path, content).expect("written");
            Place::new(Shard::default(), (), std::slice::from_ref(&path))
        };
        assert!(place("one").difference(&place("one")).is_none());
        assert!(place("one").difference(&place("two")).is_some());
    }

    #[test]
    fn holes_are_refused() {
        let shard = |idx, n| output(Shard { idx, n }, 7, "");
        for (shards, says) in [
            (vec![], "found none"),
            (vec![shard(1, 2)], "expected 2 shards, found 1: 0/2 is missing"),
            (vec![shard(0, 3), shard(2, 3)], "1/3 is missing"),
            (vec![shard(0, 2)], "1/2 is missing"),
            (vec![shard(1, 2), shard(0, 2), shard(1, 2)], "1/2 is there twice"),
            (
                vec![shard(0, 2), shard(1, 3)],
                "shard 1/3 is of another run than 0/2: expected the same number of shards",
            ),
            (vec![shard(0, 2), output(Shard { idx: 1, n: 2 }, 7, "other")], "expected the same program, options"),
            (vec![shard(0, 2), output(Shard { idx: 1, n: 2 }, 8, "")], "expected the same files"),
            (vec![shard(0, 2), shard(1, 2), shard(5, 2)], "expected 2 shards, found 3"),
        ] {
            let refused = merged(&shards).expect_err(says).to_string();
            assert!(refused.contains(says), "{refused}");
        }
    }

    #[test]
    fn an_output_that_was_changed_is_refused() {
        let (place, lines) = output(Shard::default(), 4, "");
        let read = |place: &Place, content_id| {
            merge_files(&[PathBuf::new()], |_| Ok((place.clone(), content_id, lines.clone())))
        };
        assert_eq!(read(&place, 0).expect("as it was written"), lines);
        read(&place, 1).expect_err("another content");
        for n_lines in [vec![], vec![0, 1, 2, 4], vec![usize::MAX, 3]] {
            read(&Place { n_lines, ..place.clone() }, 0).expect_err("other numbers of lines");
        }
        read(&Place { shard: Shard { idx: 0, n: 0 }, ..place.clone() }, 0).expect_err("another shard");
    }
}
