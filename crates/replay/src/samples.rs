//! Samples in the form in which they lie in shared memory.

use std::ops::Range;

use super::played::Played;
use blindgrasp_messages::{GraspTruth, GraspTruthHead, Message, Stamped};

/// Samples in playing order: heads, and the items of all of them one after the other.
pub(super) struct Samples<M: Played> {
    pub(super) all: Vec<Sample<M>>,
    /// The items of the frames.
    pub(super) items: Vec<M::Item>,
    /// The items of the truths.
    pub(super) names: Vec<u8>,
}

/// The head of a sample and the place of its items.
#[derive(Clone)]
pub(super) enum Sample<M: Played> {
    Frame(M::Head, Range<usize>),
    Truth(GraspTruthHead, Range<usize>),
}

impl<M: Played> Samples<M> {
    pub(super) fn add_frame(&mut self, frame: &Stamped<M>) -> (M::Head, Range<usize>) {
        let (head, items) = frame.message.to_parts(frame.header);
        let place = self.items.len()..self.items.len() + items.len();
        self.items.extend(items);
        self.all.push(Sample::Frame(head, place.clone()));
        (head, place)
    }

    pub(super) fn add_truth(&mut self, truth: &Stamped<GraspTruth>) -> (GraspTruthHead, Range<usize>) {
        let (head, names) = truth.message.to_parts(truth.header);
        let place = self.names.len()..self.names.len() + names.len();
        self.names.extend(names);
        self.all.push(Sample::Truth(head, place.clone()));
        (head, place)
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&self.all[..]) + size_of_val(&self.items[..]) + self.names.len()
    }

    pub(super) fn clear(&mut self) {
        self.all.clear();
        self.items.clear();
        self.names.clear();
    }

    pub(super) fn shrink_to_fit(&mut self) {
        self.all.shrink_to_fit();
        self.items.shrink_to_fit();
        self.names.shrink_to_fit();
    }
}

impl<M: Played> Default for Samples<M> {
    fn default() -> Self {
        Samples { all: Vec::new(), items: Vec::new(), names: Vec::new() }
    }
}
