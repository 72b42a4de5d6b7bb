//! A sample that was received.

use std::marker::PhantomData;

use blindgrasp_messages::{Header, Message};
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;

use super::bytes::{Envelope, Parts, Word, head_len, is_length_of};
use super::sample_id;
use crate::cursors::SampleId;

/// The bytes of a sample, whatever its message.
pub struct UntypedSample(Place);

enum Place {
    /// In shared memory, borrowed from its publisher.
    Lent(Sample<ipc::Service, [Word], Envelope>),
    Copied(Envelope, Vec<Word>),
}

impl UntypedSample {
    /// `None` if its envelope says that it is longer than it is.
    pub(super) fn lent(sample: Sample<ipc::Service, [Word], Envelope>) -> Option<Self> {
        let is_whole = sample.user_header().n_bytes <= size_of_val(sample.payload()) as u64;
        is_whole.then_some(UntypedSample(Place::Lent(sample)))
    }

    fn parts(&self) -> (&Envelope, &[Word]) {
        match &self.0 {
            Place::Lent(sample) => (sample.user_header(), sample.payload()),
            Place::Copied(envelope, words) => (envelope, words),
        }
    }

    pub(super) fn header(&self) -> &Header {
        &self.parts().0.header
    }

    pub(super) fn key(&self) -> SampleId {
        sample_id(self.header())
    }

    /// Head and items.
    pub(super) fn bytes(&self) -> &[u8] {
        let (envelope, words) = self.parts();
        // SAFETY: the words have at least so many bytes, see `UntypedSample::lent`.
        unsafe { std::slice::from_raw_parts(words.as_ptr().cast(), envelope.n_bytes as usize) }
    }

    /// The sample in memory of this process, so that its publisher gets its own back. For each sample that a publisher must
    /// be able to lend at a time, iceoryx2 reserves 3.6 KB in each of its subscribers.
    pub(super) fn copied(self) -> Self {
        let (envelope, words) = self.parts();
        UntypedSample(Place::Copied(*envelope, words.to_vec()))
    }
}

/// A sample that was received.
pub struct PortSample<M: Message> {
    /// Its length is one of this message's.
    sample: UntypedSample,
    message: PhantomData<M>,
}

impl<M: Message> PortSample<M> {
    /// `None` if no sample of this message has this length.
    pub(super) fn of_untyped(sample: UntypedSample) -> Option<Self> {
        is_length_of::<M>(sample.bytes().len()).then_some(PortSample { sample, message: PhantomData })
    }

    /// A sample that was received before, from a copy.
    pub(crate) fn of_copy(head: &M::Head, items: &[M::Item]) -> Self {
        let parts = Parts::of::<M>(head, items);
        let mut words = Vec::with_capacity(parts.n_words());
        parts.write(words.spare_capacity_mut());
        // SAFETY: so many words were written.
        unsafe { words.set_len(parts.n_words()) };
        PortSample { sample: UntypedSample(Place::Copied(parts.envelope(), words)), message: PhantomData }
    }

    pub(super) fn into_untyped(self) -> UntypedSample {
        self.sample
    }

    pub fn user_header(&self) -> &M::Head {
        // SAFETY: the length was checked and the bytes begin with a word. No bytes are invalid as a head,
        // because enums travel as integers.
        unsafe { &*self.sample.bytes().as_ptr().cast() }
    }

    pub fn payload(&self) -> &[M::Item] {
        let items = &self.sample.bytes()[head_len::<M>()..];
        // SAFETY: as for the head; the items begin at a multiple of their alignment.
        unsafe { std::slice::from_raw_parts(items.as_ptr().cast(), items.len() / size_of::<M::Item>()) }
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Phase, TactileFrame};

    use super::*;

    #[test]
    fn a_copy_has_the_head_and_the_items() {
        let frame = TactileFrame { phase: Phase::Settled, cells_newtons: vec![0.25, 3.0], ..TactileFrame::default() };
        let (head, items) = frame.to_parts(Header { seq: 7, ..Header::default() });
        let sample = PortSample::<TactileFrame>::of_copy(&head, &items);
        let sample =
            PortSample::<TactileFrame>::of_untyped(sample.into_untyped().copied()).expect("a length of a frame");
        assert_eq!(TactileFrame::from_parts(sample.user_header(), sample.payload()).expect("a frame"), frame);
        assert_eq!(sample.sample.key(), SampleId { epoch: 0, seq: 7 });
    }

    #[test]
    fn a_sample_of_another_length_is_refused() {
        let sample = UntypedSample(Place::Copied(Envelope { n_bytes: 3, ..Envelope::default() }, vec![0]));
        assert!(PortSample::<TactileFrame>::of_untyped(sample).is_none());
    }
}
