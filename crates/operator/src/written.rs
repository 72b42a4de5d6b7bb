//! How far a writer has come, and the order of its samples.
//!
//! Numbers order samples only within an epoch, and the value of an epoch says nothing: a recording that is played has its
//! recorded epochs, in any order, and may come back to one of them. So the order of epochs is the order in which the writer
//! began them. A writer begins an epoch only once all its readers, except attached ones, have answered the one before, so
//! that they are in one of these two.

use serde::{Deserialize, Serialize};

use crate::cursors::SampleId;

/// How far the instances of a node have come with the samples of an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Written {
    /// The last sample that was sent.
    pub last: SampleId,
    /// The number of the first sample of its epoch.
    pub first_seq: u64,
    /// The last sample of the epoch before, if there was one.
    pub before: Option<SampleId>,
}

/// The place of a sample in the order of its stream: the generation of its epoch, then its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    /// Of an epoch that ended before the one before began. Such samples have an order among themselves that is not known.
    Older,
    Before(u64),
    Current(u64),
}

impl Written {
    /// The record after this sample was sent; `None` if it was sent before, so that the record stays.
    pub fn with(record: Option<Written>, key: SampleId) -> Option<Written> {
        let Some(record) = record else { return Some(Written { last: key, first_seq: key.seq, before: None }) };
        if key.epoch == record.last.epoch {
            return (key.seq > record.last.seq).then_some(Written { last: key, ..record });
        }
        if record.place(key) != Place::Older {
            return None;
        }
        Some(Written { last: key, first_seq: key.seq, before: Some(record.last) })
    }

    fn place(&self, key: SampleId) -> Place {
        if key.epoch == self.last.epoch && key.seq >= self.first_seq {
            return Place::Current(key.seq);
        }
        match self.before {
            Some(before) if key.epoch == before.epoch && key.seq <= before.seq => Place::Before(key.seq),
            _ => Place::Older,
        }
    }

    /// Whether a sample that was sent is of the epoch in which the writer is.
    pub fn is_current(&self, key: SampleId) -> bool {
        matches!(self.place(key), Place::Current(_))
    }

    /// Whether the writer is in this epoch, or was in it right before.
    pub fn knows(&self, epoch: u64) -> bool {
        self.last.epoch == epoch || self.before.is_some_and(|before| before.epoch == epoch)
    }

    /// Whether a sample of the writer's epoch, or of the one before, was sent.
    pub fn has_sent(&self, key: SampleId) -> bool {
        match self.place(key) {
            Place::Older => false,
            Place::Before(_) => true,
            Place::Current(seq) => seq <= self.last.seq,
        }
    }

    /// Whether a reader that has come to `reached` has passed a sample that was sent. If both are of older epochs than the
    /// writer remembers, that is only known within one of them.
    pub fn is_past(&self, reached: SampleId, key: SampleId) -> bool {
        match (self.place(reached), self.place(key)) {
            (Place::Older, Place::Older) => reached.epoch == key.epoch && reached.seq >= key.seq,
            (reached, key) => reached >= key,
        }
    }

    /// Whether a sample is one that a writer with this record has sent after another one, if it has sent both.
    pub fn is_after(record: Option<Written>, key: SampleId, other: Option<SampleId>) -> bool {
        let Some(other) = other else { return true };
        match record {
            Some(written) => !written.is_past(other, key),
            None => other.epoch != key.epoch || other.seq < key.seq,
        }
    }

    /// Of two places of readers, the one further behind; a reader that has answered nothing has none.
    pub fn behind(&self, a: Option<SampleId>, b: Option<SampleId>) -> Option<SampleId> {
        let (a, b) = (a?, b?);
        Some(if self.is_past(a, b) { b } else { a })
    }

    /// Of two places, the one further ahead.
    pub fn ahead(&self, a: Option<SampleId>, b: Option<SampleId>) -> Option<SampleId> {
        match (a, b) {
            (Some(a), Some(b)) => Some(if self.is_past(a, b) { a } else { b }),
            _ => a.or(b),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(epoch: u64, seq: u64) -> SampleId {
        SampleId { epoch, seq }
    }

    fn after(keys: &[SampleId]) -> Written {
        let mut record = None;
        for key in keys {
            record = Written::with(record, *key).or(record);
        }
        record.expect("a sample")
    }

    #[test]
    fn epochs_have_the_order_in_which_they_began_whatever_their_values() {
        let written = after(&[id(9, 0), id(9, 1), id(2, 5), id(2, 6)]);
        assert_eq!(written, Written { last: id(2, 6), first_seq: 5, before: Some(id(9, 1)) });
        assert!(written.is_past(id(2, 5), id(9, 1)) && !written.is_past(id(9, 1), id(2, 5)));
        assert_eq!(written.behind(Some(id(2, 5)), Some(id(9, 1))), Some(id(9, 1)));
        assert_eq!(written.ahead(Some(id(9, 1)), Some(id(2, 5))), Some(id(2, 5)));
        assert_eq!(written.behind(Some(id(2, 5)), None), None);
        // A reader of an epoch that nobody remembers is behind all others.
        assert!(written.is_past(id(9, 0), id(4, 8)) && !written.is_past(id(4, 8), id(9, 0)));
        assert!(written.is_past(id(4, 8), id(4, 8)) && written.knows(2) && written.knows(9) && !written.knows(4));
        assert!(written.is_past(id(4, 8), id(4, 7)) && !written.is_past(id(4, 8), id(3, 7)));
    }

    #[test]
    fn a_sample_that_is_sent_again_does_not_move_the_record_back() {
        let written = after(&[id(9, 0), id(9, 1), id(2, 0)]);
        for again in [id(9, 0), id(9, 1), id(2, 0)] {
            assert_eq!(Written::with(Some(written), again), None, "{again:?}");
        }
    }

    /// A source may go on with an epoch that it has left.
    #[test]
    fn an_epoch_that_comes_back_with_higher_numbers_is_a_later_one() {
        let written = after(&[id(1, 0), id(1, 1), id(2, 0), id(1, 2)]);
        assert_eq!(written, Written { last: id(1, 2), first_seq: 2, before: Some(id(2, 0)) });
        assert!(written.is_current(id(1, 2)) && !written.is_current(id(1, 1)));
        assert!(written.is_past(id(2, 0), id(1, 1)) && !written.is_past(id(1, 1), id(2, 0)));
    }
}
