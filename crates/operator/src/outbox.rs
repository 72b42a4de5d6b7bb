//! The answers of a stage that its readers may still need.
//!
//! A stage without state answers a sample again if its answer was lost. A stage with state cannot: its state already includes
//! the sample. So its answers are saved together with its state, before they are sent, and stay there until every reader
//! has answered them. An instance that takes over sends the rest, as it was.

use std::collections::VecDeque;

use crate::cursors::SampleId;
use crate::written::Written;

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

    /// Takes out the answers that were sent, by a writer that has come to `written`, and that no reader needs again: those up to
    /// `answered`, or all if there is no reader.
    pub(crate) fn forget(
        &mut self,
        has_readers: bool,
        answered: Option<SampleId>,
        written: Option<Written>,
    ) -> std::collections::vec_deque::Drain<'_, Entry> {
        let n_forgotten = if has_readers { self.n_passed(answered, written) } else { self.n_sent };
        self.n_sent -= n_forgotten;
        self.entries.drain(..n_forgotten)
    }

    pub(crate) fn entries(&self) -> &VecDeque<Entry> {
        &self.entries
    }

    /// The answers of an earlier instance; those up to `known` need not be sent again.
    pub(crate) fn restored(entries: VecDeque<Entry>, known: Option<SampleId>, written: Option<Written>) -> Self {
        let sent = entries.iter().take_while(|entry| written.is_some_and(|written| written.has_sent(entry.key)));
        let n_sent = sent.count();
        let kept = Kept { entries, n_sent };
        Kept { n_sent: kept.n_passed(known, written), ..kept }
    }

    /// The number of sent answers, from the first on, that readers which have come to `reached` have passed. Of answers with one
    /// number, readers may have the first alone.
    fn n_passed(&self, reached: Option<SampleId>, written: Option<Written>) -> usize {
        let (Some(reached), Some(written)) = (reached, written) else { return 0 };
        let mut before = None;
        for (idx, entry) in self.entries.iter().take(self.n_sent).enumerate() {
            if before == Some(entry.key) || !written.is_past(reached, entry.key) {
                return idx;
            }
            before = Some(entry.key);
        }
        self.n_sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Readers that have come to this sample, which is the last that was sent.
    fn at(epoch: u64, seq: u64) -> (Option<SampleId>, Option<Written>) {
        let last = SampleId { epoch, seq };
        (Some(last), Some(Written { last, first_seq: 0, before: Some(SampleId { epoch: 3, seq: 9 }) }))
    }

    #[test]
    fn readers_that_are_ahead_of_all_answers_need_none_and_may_lack_the_second_of_one_number() {
        let entry = |seq| Entry { key: SampleId { epoch: 3, seq }, n_head_bytes: 0, bytes: Vec::new() };
        let mut kept = Kept { entries: [4, 4, 7].map(entry).into(), n_sent: 2 };
        for n_freed in [1, 1, 0] {
            let (answered, written) = at(3, 8);
            assert_eq!(kept.forget(true, answered, written).count(), n_freed);
        }
        assert_eq!(kept.next(), Some(&entry(7)), "it was not sent");
        for ((known, written), n_known) in [(at(3, 6), 1), (at(2, 0), 2)] {
            let kept = Kept::restored([4, 7].map(entry).into(), known, written);
            assert_eq!(kept.n_sent, n_known, "{known:?}");
        }
        // The first answer of an epoch that the writer has not begun.
        let (known, written) = at(5, 0);
        assert_eq!(
            Kept::restored([entry(7), Entry { key: SampleId { epoch: 6, seq: 0 }, ..entry(0) }].into(), known, written)
                .n_sent,
            1
        );
    }

    #[test]
    fn answers_stay_until_all_readers_have_answered_them_and_are_sent_again_as_they_were() {
        let id = |seq| SampleId { epoch: 3, seq };
        let entry = |seq: u64| Entry { key: id(seq), n_head_bytes: 8, bytes: seq.to_ne_bytes().to_vec() };
        let written = Some(Written { last: id(2), first_seq: 0, before: None });
        let mut kept = Kept::default();
        for seq in 0..4 {
            kept.push(entry(seq));
        }
        assert_eq!(kept.forget(true, Some(id(2)), written).count(), 0, "nothing was sent");
        for seq in 0..3 {
            assert_eq!(kept.next(), Some(&entry(seq)));
            kept.has_sent_next();
        }
        assert_eq!(kept.forget(true, Some(id(1)), written).count(), 2);
        assert_eq!(kept.forget(true, None, written).count(), 0);
        assert_eq!(kept.entries().len(), 2, "2 was not answered, 3 was not sent");
        assert_eq!(kept.first_sent(), Some(id(2)));
        // The successor of an instance that was killed after it had sent 2.
        let successor = Kept::restored(kept.entries().clone(), Some(id(1)), written);
        assert_eq!(successor.next(), Some(&entry(2)));
        let mut successor = Kept::restored(kept.entries().clone(), Some(id(2)), written);
        assert_eq!(successor.next(), Some(&entry(3)));
        successor.has_sent_next();
        assert_eq!(successor.next(), None);
        assert_eq!(successor.forget(false, None, written).count(), 2);
    }
}
