//! Work that several processes share.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
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

/// The place of a shard's output in the whole. The output has it, and [`merge_files`] asks for it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Place {
    shard: Shard,
    /// Identifies the whole: the program, its settings and all files.
    #[serde(with = "hex_id")]
    whole_id: u64,
    /// The number of lines of each of the shard's files.
    pub n_lines: Vec<usize>,
}

impl Place {
    /// The place of an output without a line so far, of a whole with these settings and files.
    pub fn new(shard: Shard, settings: impl Hash, files: &[PathBuf]) -> Place {
        let mut hasher = DefaultHasher::new();
        (env!("CARGO_PKG_VERSION"), settings, files).hash(&mut hasher);
        Place { shard, whole_id: hasher.finish(), n_lines: Vec::new() }
    }
}

/// The lines of the whole in its order, from the files with the outputs of all shards, of which `read` gives place and lines.
///
/// # Errors
/// A file cannot be read, or those of [`merge`].
pub fn merge_files<T>(
    paths: &[PathBuf],
    mut read: impl FnMut(&Path) -> anyhow::Result<(Place, Vec<T>)>,
) -> anyhow::Result<Vec<T>> {
    let mut shards = Vec::new();
    for path in paths {
        shards.push(read(path).with_context(|| path.display().to_string())?);
    }
    merge(shards).map_err(|error| anyhow::anyhow!("--merge: {error}"))
}

/// The lines of the whole in its order, from those of all shards.
///
/// # Errors
/// As those of [`all_shards`], or a shard has other lines than its place says.
fn merge<T>(shards: Vec<(Place, Vec<T>)>) -> Result<Vec<T>, String> {
    let placed = shards.into_iter().map(|(place, lines)| (place.shard, (place.whole_id, place.n_lines, lines)));
    let mut shards = Vec::new();
    for (idx, (_, n_lines, lines)) in
        all_shards(placed.collect(), |one, other| one.0 == other.0)?.into_iter().enumerate()
    {
        let (n, expected) = (lines.len(), n_lines.iter().sum::<usize>());
        if n != expected {
            return Err(format!("shard {idx} has {n} of {expected} lines: make it again"));
        }
        shards.push((n_lines.into_iter(), lines.into_iter()));
    }
    let mut whole = Vec::new();
    // The shards take turns, a file each. The first one without a file is behind the last file of all.
    for idx in (0..shards.len()).cycle() {
        let (n_lines, lines) = &mut shards[idx];
        let Some(n) = n_lines.next() else { break };
        whole.extend(lines.take(n));
    }
    Ok(whole)
}

/// The outputs of all shards, in the order of the shards.
///
/// # Errors
/// A shard is missing, there twice, or of another whole.
pub fn all_shards<T>(mut outputs: Vec<(Shard, T)>, are_of_one: impl Fn(&T, &T) -> bool) -> Result<Vec<T>, String> {
    outputs.sort_by_key(|(shard, _)| shard.idx);
    let n = outputs.first().map(|(shard, _)| shard.n).ok_or("expected all shards, found none")?;
    for (at, (Shard { idx, n: of }, output)) in outputs.iter().enumerate() {
        let earlier = &outputs[..at];
        if let Some((known, _)) = earlier.iter().find(|(known, other)| known.n != *of || !are_of_one(other, output)) {
            return Err(format!(
                "shard {idx}/{of} is of another run than {}/{}: expected the same program, options and files",
                known.idx, known.n
            ));
        }
        if let Some((known, _)) = earlier.last()
            && known.idx == *idx
        {
            return Err(format!("shard {idx}/{n} is there twice"));
        }
    }
    for idx in 0..n {
        match outputs.get(idx as usize) {
            Some((shard, _)) if shard.idx == idx => {}
            _ => return Err(format!("expected {n} shards, found {}: {idx}/{n} is missing", outputs.len())),
        }
    }
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
    fn output(shard: Shard, n_files: usize, settings: &str) -> (Place, Vec<usize>) {
        let files: Vec<PathBuf> = (0..n_files).map(|number| number.to_string().into()).collect();
        let mut place = Place::new(shard, settings, &files);
        place.n_lines = shard.of(Vec::from_iter(0..n_files));
        let lines = place.n_lines.iter().flat_map(|number| vec![*number; *number]).collect();
        (place, lines)
    }

    #[test]
    fn the_lines_of_all_shards_are_those_of_the_whole() {
        for (n, n_files) in [(1, 0), (1, 4), (3, 2), (3, 6), (3, 7), (3, 8)] {
            let (_, whole) = output(Shard::default(), n_files, "");
            let shards = (0..n).rev().map(|idx| output(Shard { idx, n }, n_files, "")).collect();
            assert_eq!(merge(shards).expect("whole"), whole, "{n} shards of {n_files} files");
        }
    }

    #[test]
    fn holes_are_refused() {
        let shard = |idx, n| output(Shard { idx, n }, 7, "");
        let (place, mut lines) = shard(0, 2);
        lines.pop();
        for (shards, says) in [
            (vec![], "found none"),
            (vec![shard(1, 2)], "expected 2 shards, found 1: 0/2 is missing"),
            (vec![shard(0, 3), shard(2, 3)], "1/3 is missing"),
            (vec![shard(0, 2)], "1/2 is missing"),
            (vec![shard(1, 2), shard(0, 2), shard(1, 2)], "1/2 is there twice"),
            (vec![shard(0, 2), shard(1, 3)], "shard 1/3 is of another run than 0/2"),
            (vec![shard(0, 2), output(Shard { idx: 1, n: 2 }, 7, "other")], "shard 1/2 is of another run"),
            (vec![shard(0, 2), output(Shard { idx: 1, n: 2 }, 8, "")], "shard 1/2 is of another run"),
            (vec![(place, lines), shard(1, 2)], "shard 0 has 11 of 12 lines"),
        ] {
            let refused = merge(shards).expect_err(says);
            assert!(refused.contains(says), "{refused}");
        }
    }
}
