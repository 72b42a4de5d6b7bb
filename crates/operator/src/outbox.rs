//! The answers of a stage with state that its readers may still need.
//!
//! A stage without state answers a sample again if its answer was lost. A stage with state cannot: its state already includes
//! the sample. So its answers are saved together with its state, before they are sent, and stay there until every reader
//! has answered them. An instance that takes over sends the rest, as it was.

use std::collections::VecDeque;
use std::marker::PhantomData;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use blindgrasp_messages::{Header, Message, Stamped};

use crate::cursors::SampleId;
use crate::port::sample_id;
use crate::stage::{STATE_FORMAT, encode_state};

/// Head and items of an answer.
type Answer<M> = (<M as Message>::Head, Vec<<M as Message>::Item>);

/// An answer, and the part of its header that is not serialised with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Entry {
    key: SampleId,
    origin_nanos: u64,
    valid_nanos: u64,
    made_by: u64,
    #[serde(with = "as_bytes")]
    sample: Vec<u8>,
}

/// Bytes at once: serde takes a list of them one by one.
mod as_bytes {
    use serde::de::{Deserializer, Error, Visitor};
    use serde::ser::Serializer;

    pub(super) fn serialize<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(bytes)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<u8>, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Vec<u8>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }

            fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Vec<u8>, E> {
                Ok(bytes.to_vec())
            }
        }
        deserializer.deserialize_bytes(Bytes)
    }
}

/// A sample with its number.
pub(crate) trait Keyed {
    fn key(&self) -> SampleId;
}

impl Keyed for Entry {
    fn key(&self) -> SampleId {
        self.key
    }
}

/// Answers in the order in which they are sent, from the first that a reader may still need on.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Kept<E> {
    entries: VecDeque<E>,
    /// So many of the first entries were sent.
    n_sent: usize,
}

impl<E> Default for Kept<E> {
    fn default() -> Self {
        Kept { entries: VecDeque::new(), n_sent: 0 }
    }
}

impl<E: Keyed> Kept<E> {
    pub(crate) fn push(&mut self, entry: E) {
        self.entries.push_back(entry);
    }

    /// The first answer that was not sent.
    pub(crate) fn next(&self) -> Option<&E> {
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
        self.entries.front().map(Keyed::key)
    }

    /// Takes out the answers that were sent and that no reader needs again: those up to `answered`, or all if there is no
    /// reader.
    pub(crate) fn forget(
        &mut self,
        has_readers: bool,
        answered: Option<SampleId>,
    ) -> std::collections::vec_deque::Drain<'_, E> {
        let n_answered = if has_readers { self.n_up_to(answered) } else { self.n_sent };
        let n_forgotten = n_answered.min(self.n_sent);
        self.n_sent -= n_forgotten;
        self.entries.drain(..n_forgotten)
    }

    pub(crate) fn entries(&self) -> &VecDeque<E> {
        &self.entries
    }

    /// The answers of an earlier instance; those up to `known` need not be sent again.
    pub(crate) fn restored(entries: VecDeque<E>, known: Option<SampleId>) -> Self {
        let kept = Kept { entries, n_sent: 0 };
        Kept { n_sent: kept.n_up_to(known), ..kept }
    }

    /// The number of entries up to that answer. Answers are in order, and an answer that is not there is older than all.
    fn n_up_to(&self, key: Option<SampleId>) -> usize {
        let found = key.and_then(|key| self.entries.iter().rposition(|entry| entry.key() == key));
        found.map_or(0, |idx| idx + 1)
    }
}

/// The answers of a stage in Rust.
pub(crate) struct Outbox<M> {
    kept: Kept<Entry>,
    /// Memory of entries that were dropped.
    spare: Vec<Vec<u8>>,
    _message: PhantomData<M>,
}

impl<M: Message> Outbox<M> {
    pub(crate) fn new() -> Self {
        Outbox { kept: Kept::default(), spare: Vec::new(), _message: PhantomData }
    }

    /// Adds an answer that is to be sent.
    ///
    /// # Errors
    /// The answer has an invalid code or length.
    pub(crate) fn push(&mut self, head: &M::Head, items: &[M::Item]) -> anyhow::Result<()> {
        let header = *M::header(head);
        let message = M::from_parts(head, items).with_context(|| format!("answer {} cannot be saved", header.seq))?;
        let mut sample = self.spare.pop().unwrap_or_default();
        sample.clear();
        encode_state(Stamped { header, message }, &mut sample)?;
        let Header { origin_nanos, valid_nanos, made_by, .. } = header;
        self.kept.push(Entry { key: sample_id(&header), origin_nanos, valid_nanos, made_by, sample });
        Ok(())
    }

    /// The first answer that was not sent.
    ///
    /// # Errors
    /// It was saved by another version.
    pub(crate) fn next(&self) -> anyhow::Result<Option<Answer<M>>> {
        let Some(entry) = self.kept.next() else { return Ok(None) };
        let (sample, _): (Stamped<M>, _) = bincode::serde::decode_from_slice(&entry.sample, STATE_FORMAT)
            .context("a saved answer of the node cannot be read")?;
        let Entry { origin_nanos, valid_nanos, made_by, .. } = *entry;
        Ok(Some(sample.message.to_parts(Header { origin_nanos, valid_nanos, made_by, ..sample.header })))
    }

    /// See [`Kept::has_sent_next`].
    pub(crate) fn has_sent_next(&mut self) {
        self.kept.has_sent_next();
    }

    /// See [`Kept::first_sent`].
    pub(crate) fn first_sent(&self) -> Option<SampleId> {
        self.kept.first_sent()
    }

    /// See [`Kept::forget`].
    pub(crate) fn forget(&mut self, has_readers: bool, answered: Option<SampleId>) {
        self.spare.extend(self.kept.forget(has_readers, answered).map(|entry| entry.sample));
    }

    /// What is saved with the state.
    pub(crate) fn entries(&self) -> &VecDeque<Entry> {
        self.kept.entries()
    }

    /// Takes over the saved answers; those up to `known` need not be sent again.
    pub(crate) fn restore(&mut self, entries: VecDeque<Entry>, known: Option<SampleId>) {
        self.kept = Kept::restored(entries, known);
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Action, LiftDecision};

    use super::*;

    fn head(seq: u64) -> <LiftDecision as Message>::Head {
        let header = Header { seq, epoch: 3, origin_nanos: 100 + seq, valid_nanos: 7, made_by: 9, ..Header::default() };
        LiftDecision { grasp_id: seq, action: Action::Lift, ..LiftDecision::default() }.to_parts(header).0
    }

    fn next(outbox: &Outbox<LiftDecision>) -> Option<Header> {
        outbox.next().expect("readable").map(|(head, _)| head.header)
    }

    #[test]
    fn answers_stay_until_all_readers_have_answered_them_and_are_sent_again_as_they_were() {
        let key = |seq| Some(SampleId { epoch: 3, seq });
        let mut outbox = Outbox::<LiftDecision>::new();
        for seq in 0..4 {
            outbox.push(&head(seq), &[]).expect("saved");
        }
        for seq in 0..3 {
            assert_eq!(next(&outbox), Some(head(seq).header));
            outbox.has_sent_next();
        }
        outbox.forget(true, key(1));
        outbox.forget(true, None);
        assert_eq!(outbox.entries().len(), 2, "2 was not answered, 3 was not sent");
        // The successor of an instance that was killed after it had sent 2.
        let mut successor = Outbox::<LiftDecision>::new();
        successor.restore(outbox.entries().clone(), key(1));
        assert_eq!(next(&successor), Some(head(2).header));
        successor.restore(outbox.entries().clone(), key(2));
        assert_eq!(next(&successor), Some(head(3).header));
        successor.has_sent_next();
        assert_eq!(next(&successor), None);
        successor.forget(false, None);
        assert!(successor.entries().is_empty());
    }
}
