//! The bytes of a sample in shared memory: its head, and behind it its items.

use blindgrasp_messages::Message;
use blindgrasp_messages::zerocopy::IntoBytes as _;
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
pub(crate) struct Layout {
    pub(super) type_name: &'static str,
    pub(super) n_head_bytes: usize,
    n_bytes_per_item: usize,
}

impl Layout {
    pub(crate) const fn of<M: Message>() -> Layout {
        Layout { type_name: M::TYPE_NAME, n_head_bytes: head_len::<M>(), n_bytes_per_item: size_of::<M::Item>() }
    }

    /// The bytes that a sample with so many items takes.
    pub(crate) const fn n_bytes_of(&self, n_items: usize) -> usize {
        self.n_head_bytes + n_items * self.n_bytes_per_item
    }

    /// The words that a sample with so many items takes.
    pub(super) const fn n_words(&self, n_items: usize) -> usize {
        n_words(self.n_bytes_of(n_items))
    }

    /// The number of items in parts of these lengths; `None` if they are those of another message.
    pub(crate) fn n_items(&self, n_head_bytes: usize, n_item_bytes: usize) -> Option<usize> {
        let is_whole = n_head_bytes == self.n_head_bytes && n_item_bytes.is_multiple_of(self.n_bytes_per_item);
        is_whole.then(|| n_item_bytes / self.n_bytes_per_item)
    }

    /// The length of a sample with this envelope in so many words; `None` if it is no sample of this message.
    pub(super) fn n_bytes(&self, envelope: Envelope, n_words: usize) -> Option<usize> {
        let [head, items] = [envelope.n_head_bytes, envelope.n_item_bytes].map(|n_bytes| n_bytes as usize);
        self.n_items(head, items)?;
        (head + items <= n_words * size_of::<Word>()).then_some(head + items)
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
        Parts::of_bytes(head.as_bytes(), items.as_bytes())
    }

    pub(super) fn of_bytes(head: &'a [u8], items: &'a [u8]) -> Parts<'a> {
        Parts { head, items }
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

#[cfg(test)]
mod tests {
    use blindgrasp_messages::TactileFrame;

    use super::*;

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
