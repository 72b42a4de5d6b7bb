//! A sample that was received.

use std::marker::PhantomData;

use blindgrasp_messages::zerocopy::{FromBytes as _, IntoBytes as _};
use blindgrasp_messages::{Header, Message, PlainBytes};
use iceoryx2::sample::Sample;

use super::bytes::{Envelope, Layout, Word};
use super::sample_id;
use crate::cursors::SampleId;
use crate::private_service::PrivateService;

/// The bytes of a sample, whatever its message.
pub(crate) struct UntypedSample {
    place: Place,
    /// Checked once: a writer could change what its envelope says.
    n_bytes: usize,
    n_head_bytes: usize,
}

enum Place {
    /// In shared memory, borrowed from its publisher.
    Lent(Sample<PrivateService, [Word], Envelope>),
    Copied(Vec<Word>),
}

impl UntypedSample {
    /// `None` if it is no sample of this message.
    pub(super) fn lent(sample: Sample<PrivateService, [Word], Envelope>, layout: &Layout) -> Option<Self> {
        let n_bytes = layout.n_bytes(*sample.user_header(), sample.payload().len())?;
        Some(UntypedSample { place: Place::Lent(sample), n_bytes, n_head_bytes: layout.n_head_bytes })
    }

    fn words(&self) -> &[Word] {
        match &self.place {
            Place::Lent(sample) => sample.payload(),
            Place::Copied(words) => words,
        }
    }

    /// Head and items.
    pub(crate) fn parts(&self) -> (&[u8], &[u8]) {
        self.words().as_bytes()[..self.n_bytes].split_at(self.n_head_bytes)
    }

    /// The header, with which each head begins.
    pub(crate) fn header(&self) -> &Header {
        self.beginning()
    }

    /// What the bytes begin with: a header, or a head of the message.
    pub(crate) fn beginning<T: PlainBytes>(&self) -> &T {
        const { assert!(align_of::<T>() <= align_of::<Word>()) };
        let (beginning, _) = T::ref_from_prefix(self.parts().0).expect("the length was checked when the sample came");
        beginning
    }

    pub(super) fn key(&self) -> SampleId {
        sample_id(self.header())
    }

    /// The sample in memory of this process, so that its publisher gets its own back. For each sample that a publisher must
    /// be able to lend at a time, iceoryx2 reserves 3.6 KB in each of its subscribers.
    pub(crate) fn copied(self) -> Self {
        UntypedSample { place: Place::Copied(self.words().to_vec()), ..self }
    }

    /// The items of the message.
    pub(crate) fn items<T: PlainBytes>(&self) -> &[T] {
        <[T]>::ref_from_bytes(self.parts().1).expect("the length was checked when the sample came")
    }
}

/// A sample that was received.
pub struct PortSample<M: Message> {
    sample: UntypedSample,
    message: PhantomData<M>,
}

impl<M: Message> PortSample<M> {
    pub(super) fn of_untyped(sample: UntypedSample) -> Self {
        PortSample { sample, message: PhantomData }
    }

    pub fn head(&self) -> &M::Head {
        self.sample.beginning()
    }

    pub fn items(&self) -> &[M::Item] {
        self.sample.items()
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Phase, TactileFrame};

    use super::super::bytes::Parts;
    use super::*;

    #[test]
    fn a_copy_has_the_head_and_the_items() {
        let frame = TactileFrame { phase: Phase::Settled, cells_newtons: vec![0.25, 3.0], ..TactileFrame::default() };
        let (head, items) = frame.to_parts(Header { seq: 7, ..Header::default() });
        let parts = Parts::of::<TactileFrame>(&head, &items);
        let mut words = vec![0; parts.n_words()];
        parts.write(&mut words);
        let (n_bytes, n_head_bytes) = (parts.n_bytes(), size_of_val(&head));
        let sample = UntypedSample { place: Place::Copied(words), n_bytes, n_head_bytes }.copied();
        let sample = PortSample::<TactileFrame>::of_untyped(sample);
        assert_eq!(TactileFrame::from_parts(sample.head(), sample.items()).expect("a frame"), frame);
        assert_eq!(sample.sample.key(), SampleId { epoch: 0, seq: 7 });
    }
}
