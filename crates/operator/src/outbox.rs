//! The answers of a stage that its readers may still need.
//!
//! A stage without state answers a sample again if its answer was lost. A stage with state cannot: its state already includes
//! the sample. So its answers are saved together with its state, before they are sent, and stay there until every reader
//! has answered them. An instance that takes over sends the rest, as it was.

use std::collections::VecDeque;

use crate::cursors::SampleId;

/// An answer as it lies in shared memory: the bytes of its head, which begins with the header, and of its items.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Entry {
    pub(crate) key: SampleId,
    pub(crate) n_head_bytes: usize,
    pub(crate) bytes: Vec<u8>,
}

impl Entry {
    /// Head and items.
    pub(crate) fn parts(&self) -> (&[u8], &[u8]) {
        self.bytes.split_at(self.n_head_bytes)
    }
}

/// Answers in the order in which they are sent, from the first that a reader may still need on.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(crate) struct Kept {
    entries: VecDeque<Entry>,
    /// So many of the first entries were sent.
    n_sent: usize,
}

impl Kept {
    pub(crate) fn push(&mut self, entry: Entry) {
        self.entries.push_back(entry);
    }

    /// The first answer that was not sent.
    pub(crate) fn next(&self) -> Option<&Entry> {
        self.entries.get(self.n_sent)
    }

    pub(crate) fn has_sent_next(&mut self) {
        self.n_sent += 1;
    }

    /// The first answer that was sent and may still be needed.
    pub(crate) fn first_sent(&self) -> Option<SampleId> {
        if self.n_sent == 0 {
            return None;
        }
        self.entries.front().map(|entry| entry.key)
    }

    /// Takes out the answers that were sent and that no reader needs again: those up to `answered`, or all if there is no
    /// reader.
    pub(crate) fn forget(
        &mut self,
        has_readers: bool,
        answered: Option<SampleId>,
    ) -> std::collections::vec_deque::Drain<'_, Entry> {
        let n_answered = if has_readers { self.n_up_to(answered) } else { self.n_sent };
        let n_forgotten = n_answered.min(self.n_sent);
        self.n_sent -= n_forgotten;
        self.entries.drain(..n_forgotten)
    }

    pub(crate) fn entries(&self) -> &VecDeque<Entry> {
        &self.entries
    }

    /// The answers of an earlier instance; those up to `known` need not be sent again.
    pub(crate) fn restored(entries: VecDeque<Entry>, known: Option<SampleId>) -> Self {
        let kept = Kept { entries, n_sent: 0 };
        Kept { n_sent: kept.n_up_to(known), ..kept }
    }

    /// The number of entries up to that answer. Answers are in order, and an answer that is not there is older than all.
    fn n_up_to(&self, key: Option<SampleId>) -> usize {
        let found = key.and_then(|key| self.entries.iter().rposition(|entry| entry.key == key));
        found.map_or(0, |idx| idx + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_stay_until_all_readers_have_answered_them_and_are_sent_again_as_they_were() {
        let id = |seq| SampleId { epoch: 3, seq };
        let entry = |seq: u64| Entry { key: id(seq), n_head_bytes: 8, bytes: seq.to_ne_bytes().to_vec() };
        let mut kept = Kept::default();
        for seq in 0..4 {
            kept.push(entry(seq));
        }
        assert_eq!(kept.forget(true, Some(id(2))).count(), 0, "nothing was sent");
        for seq in 0..3 {
            assert_eq!(kept.next(), Some(&entry(seq)));
            kept.has_sent_next();
        }
        assert_eq!(kept.forget(true, Some(id(1))).count(), 2);
        assert_eq!(kept.forget(true, None).count(), 0);
        assert_eq!(kept.entries().len(), 2, "2 was not answered, 3 was not sent");
        assert_eq!(kept.first_sent(), Some(id(2)));
        // The successor of an instance that was killed after it had sent 2.
        let successor = Kept::restored(kept.entries().clone(), Some(id(1)));
        assert_eq!(successor.next(), Some(&entry(2)));
        let mut successor = Kept::restored(kept.entries().clone(), Some(id(2)));
        assert_eq!(successor.next(), Some(&entry(3)));
        successor.has_sent_next();
        assert_eq!(successor.next(), None);
        assert_eq!(successor.forget(false, None).count(), 2);
    }
}
