//! Work that several processes share.

use std::str::FromStr;

/// The part of the work of one of several processes, as `--shard I/N` says it. The parts together are the whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
}
