//! The bytes of a sample in shared memory: its head, and behind it its items.

use blindgrasp_messages::Message;
use blindgrasp_messages::zerocopy::{FromBytes as _, IntoBytes as _};
use iceoryx2::prelude::ZeroCopySend;

/// The unit in which iceoryx2 lends memory: heads and items need no greater alignment. (Of single bytes that are aligned,
/// iceoryx2 0.10 takes eight times as much memory.)
pub(super) type Word = u64;

/// iceoryx2's user header: the lengths of head and items. The last word may have bytes behind them.
#[derive(Debug, Clone, Copy, Default, PartialEq, ZeroCopySend)]
#[repr(C)]
#[type_name("blindgrasp/Envelope/1")]
pub(crate) struct Envelope {
    pub(super) n_head_bytes: u32,
    pub(super) n_item_bytes: u32,
}

/// The bytes that a message's head and each of its items take.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    pub(super) type_name: &'static str,
    n_head_bytes: usize,
    n_bytes_per_item: usize,
}

impl Layout {
    pub(super) const fn of<M: Message>() -> Layout {
        Layout { type_name: M::TYPE_NAME, n_head_bytes: head_len::<M>(), n_bytes_per_item: size_of::<M::Item>() }
    }

    /// The words that a sample with so many items takes.
    pub(super) const fn n_words(&self, n_items: usize) -> usize {
        n_words(self.n_head_bytes + n_items * self.n_bytes_per_item)
    }

    /// The length of a sample with this envelope in so many words; `None` if it is no sample of this message.
    pub(super) fn n_bytes(&self, envelope: Envelope, n_words: usize) -> Option<usize> {
        let [head, items] = [envelope.n_head_bytes, envelope.n_item_bytes].map(|n_bytes| n_bytes as usize);
        let is_whole = head == self.n_head_bytes && items.is_multiple_of(self.n_bytes_per_item);
        (is_whole && head + items <= n_words * size_of::<Word>()).then_some(head + items)
    }
}

/// The length of a head, behind which the items begin.
pub(super) const fn head_len<M: Message>() -> usize {
    const { assert!(align_of::<M::Head>() == align_of::<Word>() && align_of::<M::Item>() <= align_of::<Word>()) };
    size_of::<M::Head>()
}

/// The words that so many bytes take.
const fn n_words(n_bytes: usize) -> usize {
    n_bytes.div_ceil(size_of::<Word>())
}

/// The bytes of a sample that is to be sent.
pub(super) struct Parts<'a> {
    head: &'a [u8],
    items: &'a [u8],
}

impl<'a> Parts<'a> {
    pub(super) fn of<M: Message>(head: &'a M::Head, items: &'a [M::Item]) -> Parts<'a> {
        Parts { head: head.as_bytes(), items: items.as_bytes() }
    }

    pub(super) fn n_bytes(&self) -> usize {
        self.head.len() + self.items.len()
    }

    pub(super) fn n_words(&self) -> usize {
        n_words(self.n_bytes())
    }

    pub(super) fn envelope(&self) -> Envelope {
        Envelope { n_head_bytes: self.head.len() as u32, n_item_bytes: self.items.len() as u32 }
    }

    /// Writes the first [`Parts::n_bytes`] bytes of as many words as [`Parts::n_words`].
    pub(super) fn write(&self, words: &mut [Word]) {
        let (head, rest) = words.as_mut_bytes().split_at_mut(self.head.len());
        head.copy_from_slice(self.head);
        rest[..self.items.len()].copy_from_slice(self.items);
    }
}

/// A head of these bytes; `None` if it has another length.
pub(crate) fn head_of<M: Message>(bytes: &[u8]) -> Option<M::Head> {
    M::Head::read_from_bytes(bytes).ok()
}

/// The items of these bytes; `None` if they are no whole number of items.
pub(crate) fn items_of<M: Message>(bytes: &[u8]) -> Option<Vec<M::Item>> {
    if !bytes.len().is_multiple_of(size_of::<M::Item>()) {
        return None;
    }
    let mut items = vec![M::Item::default(); bytes.len() / size_of::<M::Item>()];
    items.as_mut_bytes().copy_from_slice(bytes);
    Some(items)
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Header, Phase, TactileFrame};

    use super::*;

    #[test]
    fn heads_and_items_are_read_back_from_their_bytes_and_other_lengths_are_refused() {
        let frame = TactileFrame { phase: Phase::Settled, cells_newtons: vec![0.25, 3.0], ..TactileFrame::default() };
        let (head, items) = frame.to_parts(Header { seq: 7, ..Header::default() });
        let bytes = head.as_bytes();
        let read = head_of::<TactileFrame>(bytes).expect("a head");
        let items = items_of::<TactileFrame>(items.as_bytes()).expect("items");
        assert_eq!(read.header, head.header);
        assert_eq!(TactileFrame::from_parts(&read, &items).expect("a frame"), frame);
        assert!(head_of::<TactileFrame>(&bytes[1..]).is_none());
        assert!(items_of::<TactileFrame>(&[0; 15]).is_none());
    }

    #[test]
    fn a_sample_of_other_lengths_is_refused() {
        let layout = Layout::of::<TactileFrame>();
        let head = size_of::<<TactileFrame as Message>::Head>() as u32;
        let n_words = layout.n_words(3);
        let n_bytes = |n_head_bytes, n_item_bytes| layout.n_bytes(Envelope { n_head_bytes, n_item_bytes }, n_words);
        assert_eq!(n_bytes(head, 24), Some(head as usize + 24));
        assert_eq!(n_bytes(head, 0), Some(head as usize));
        for (head, items) in [(head + 8, 16), (head - 8, 24), (head, 23), (head, 32), (u32::MAX, u32::MAX)] {
            assert_eq!(n_bytes(head, items), None, "{head} {items}");
        }
    }
}
