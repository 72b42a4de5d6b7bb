//! How far a publisher may be ahead of its readers, and which samples an instance that takes over must send again.
//!
//! It decides on the places of readers that the [cursors](crate::cursors) show, and does no I/O: the publishers of all
//! operators and the search through all histories (`recovery_model.rs`) call the same code.

use std::collections::VecDeque;

use crate::cursors::{SampleId, SharedCursors};
use crate::wiring::{ConsumerWiring, ReaderWiring};
use crate::written::Written;

/// The places of readers, by slot.
pub(crate) trait Places {
    /// The last sample that a reader has answered.
    fn answered(&self, slot: usize) -> Option<SampleId>;
    /// The last sample that the writer with this slot has sent.
    fn sent(&self, slot: usize) -> Option<SampleId>;
    /// How many samples it has answered whose number was not above those before.
    fn n_repeated(&self, slot: usize) -> u64;
    /// Whether no process will read on.
    fn is_given_up(&self, slot: usize) -> bool;
}

impl Places for SharedCursors {
    fn answered(&self, slot: usize) -> Option<SampleId> {
        self.input(slot).key()
    }

    fn sent(&self, slot: usize) -> Option<SampleId> {
        self.output(slot).key()
    }

    fn n_repeated(&self, slot: usize) -> u64 {
        self.input(slot).counts().n_repeated
    }

    fn is_given_up(&self, slot: usize) -> bool {
        self.input(slot).is_given_up()
    }
}

/// The readers of an output, and the part of its samples that this very publisher has sent.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Credit {
    readers: Vec<Reader>,
    /// The last sample that others have sent before this publisher; `None` if it cannot send such samples again.
    begun_after: Option<Option<SampleId>>,
    /// The first sample of this publisher in the current epoch.
    own_first: Option<SampleId>,
    /// Its last sample, without those whose number was not above the ones before: a recording may have such.
    own_last: Option<SampleId>,
    /// Its last samples, as many as an attached reader may leave unanswered.
    newest: VecDeque<SampleId>,
    n_newest: usize,
    /// The last sample that was sent, if readers lack samples up to it that no publisher has any more.
    lost: Option<SampleId>,
}

/// A reader whose unanswered samples the publisher must be able to send again.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Reader {
    pub(crate) slot: usize,
    /// Of a reader behind another one: the slot of the output that it reads.
    writer_slot: Option<usize>,
    limit: Limit,
    /// Its place at the last look, and its count of repeated samples.
    key: Option<SampleId>,
    n_repeated: u64,
    /// How many repeated samples of this very publisher it had not answered then. They take places in its queue, too.
    n_repeats: u64,
    /// If it is an attached reader, the slots of all its readers, and how long the publisher waits for it.
    pub(crate) attached_slots: Vec<usize>,
    pub(crate) attached_limit_millis: u64,
    /// The readers of its answers, if it answers each sample under the same number.
    behind: Vec<Reader>,
}

/// How many samples a reader may leave unanswered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Limit {
    /// Of the samples of this very publisher, as many as the reader's queue takes. The samples of an earlier publisher lie in
    /// a queue of their own, or have died with it: waiting for a reader to answer them could last for ever.
    Queue(u64),
    /// Of all samples, as many as the publisher keeps.
    History(u64),
}

/// The sample that is to be sent, for [`Reader::has_room`].
struct Next<'a> {
    /// Of a repeated sample, the number behind the last one that was sent.
    key: SampleId,
    is_repeat: bool,
    written: Option<Written>,
    /// The number of the first sample of this publisher in the epoch.
    own_first: u64,
    /// See [`Credit::begun_after`].
    begun_after: Option<Option<SampleId>>,
    /// See [`Credit::newest`].
    newest: &'a VecDeque<SampleId>,
    /// See [`Credit::lost`].
    lost: Option<SampleId>,
}

impl Reader {
    fn of_port(wiring: &ConsumerWiring, history: usize) -> Reader {
        Reader {
            slot: wiring.slot,
            writer_slot: None,
            limit: Limit::Queue(wiring.capacity as u64),
            key: None,
            n_repeated: 0,
            n_repeats: 0,
            attached_slots: wiring.attached_slots.clone(),
            attached_limit_millis: wiring.attached_limit_millis,
            behind: wiring.behind.iter().map(|behind| Reader::further_on(behind, history)).collect(),
        }
    }

    fn further_on(wiring: &ReaderWiring, history: usize) -> Reader {
        Reader {
            slot: wiring.slot,
            writer_slot: Some(wiring.writer_slot),
            limit: Limit::History(history as u64),
            key: None,
            n_repeated: 0,
            n_repeats: 0,
            attached_slots: Vec::new(),
            attached_limit_millis: 0,
            behind: wiring.behind.iter().map(|behind| Reader::further_on(behind, history)).collect(),
        }
    }

    /// The last sample that it has answered. A reader that has answered all that was sent to it has passed as well what the
    /// reader before it, which has come to `before`, has left without an answer.
    fn place(&self, places: &impl Places, written: Option<&Written>, before: Option<SampleId>) -> Option<SampleId> {
        let answered = places.answered(self.slot);
        match (self.writer_slot, written) {
            (Some(slot), Some(written)) if places.sent(slot) == answered => written.ahead(answered, before),
            _ => answered,
        }
    }

    /// `before` is the place of the reader before it.
    fn has_room(&mut self, places: &impl Places, next: &Next<'_>, before: Option<SampleId>) -> bool {
        if next.is_repeat || !(self.key.is_some() && self.is_near(next)) {
            self.key = self.place(places, next.written.as_ref(), before);
            let n_repeated = places.n_repeated(self.slot);
            self.n_repeats = self.n_repeats.saturating_sub(n_repeated.saturating_sub(self.n_repeated));
            self.n_repeated = n_repeated;
            if !self.is_near(next) {
                return places.is_given_up(self.slot);
            }
        }
        let key = self.key;
        if self.behind.iter_mut().all(|reader| reader.has_room(places, next, key)) {
            return true;
        }
        // It is looked at again, because the places of those behind may depend on its own.
        self.key = None;
        places.is_given_up(self.slot)
    }

    fn is_near(&self, next: &Next<'_>) -> bool {
        let Some(written) = &next.written else { return true };
        let (Limit::Queue(limit) | Limit::History(limit)) = self.limit;
        let limit = limit.saturating_sub(self.n_repeats);
        // A reader that has answered all samples has room for one more, however far the numbers jump.
        if self.key == Some(written.last) {
            return limit > 0;
        }
        let is_within_epoch = self.key.filter(|key| written.is_current(*key));
        let begins_epoch = next.key.epoch != written.last.epoch;
        if self.is_attached() && (begins_epoch || is_within_epoch.is_none()) {
            let n_answered = next.newest.iter().rposition(|sent| Some(*sent) == self.key).map_or(0, |idx| idx + 1);
            return ((next.newest.len() - n_answered) as u64) < limit;
        }
        // A new epoch begins when every reader that is not attached has answered the one before.
        if begins_epoch {
            return next.lost == Some(written.last);
        }
        // It had answered the epoch before, or it has just come.
        let first_unanswered = is_within_epoch.map_or(written.first_seq, |key| key.seq + 1);
        // Others still have the samples up to `begun_after` for it. Behind that, this publisher sends all that there are again:
        // no sample has the numbers before its first one.
        let needs_others = match (self.limit, next.begun_after) {
            (Limit::History(_), Some(Some(begun_after))) => {
                !self.key.is_some_and(|key| written.is_past(key, begun_after))
            }
            _ => false,
        };
        let first_unanswered = if needs_others { first_unanswered } else { first_unanswered.max(next.own_first) };
        next.key.seq.saturating_sub(first_unanswered) < limit
    }

    /// Of the places of this reader and of those behind it, without readers that were given up, the one furthest behind; the
    /// outer `None` if there is no reader.
    fn least(
        &self,
        places: &impl Places,
        written: Option<&Written>,
        before: Option<SampleId>,
    ) -> Option<Option<SampleId>> {
        if places.is_given_up(self.slot) {
            return None;
        }
        let place = self.place(places, written, before);
        let mut least = place;
        // No writer goes back to an earlier epoch for an attached reader.
        if self.is_attached()
            && let Some(written) = written
            && !least.is_some_and(|key| written.is_current(key))
        {
            least = written.before;
        }
        for reader in &self.behind {
            if let Some(key) = reader.least(places, written, place) {
                least = written.and_then(|written| written.behind(least, key));
            }
        }
        Some(least)
    }

    fn has_been_sent_a_repeat(&mut self) {
        self.n_repeats += 1;
        self.behind.iter_mut().for_each(Reader::has_been_sent_a_repeat);
    }

    fn is_attached(&self) -> bool {
        !self.attached_slots.is_empty()
    }

    pub(crate) fn is_among(&self, slots: &[usize]) -> bool {
        slots.contains(&self.slot) || self.behind.iter().any(|reader| reader.is_among(slots))
    }
}

impl Credit {
    /// The credit of a publisher whose wiring names these readers and so many samples that it keeps.
    pub(crate) fn new(consumers: &[ConsumerWiring], history: usize) -> Credit {
        let attached = consumers.iter().filter(|reader| !reader.attached_slots.is_empty());
        let n_newest = attached.map(|reader| reader.capacity).max().unwrap_or(0);
        let readers = consumers.iter().map(|reader| Reader::of_port(reader, history)).collect();
        let newest = VecDeque::with_capacity(n_newest);
        Credit { readers, begun_after: None, own_first: None, own_last: None, newest, n_newest, lost: None }
    }

    /// The first reader that has no room for a sample, if there is one.
    pub(crate) fn first_without_room(
        &mut self,
        places: &impl Places,
        written: Option<Written>,
        key: SampleId,
    ) -> Option<&Reader> {
        let own_first = self.own_first.filter(|first| first.epoch == key.epoch).map_or(key.seq, |first| first.seq);
        let is_repeat = self.is_repeat(key);
        let last = if is_repeat { self.own_last } else { None };
        let key = last.map_or(key, |last| SampleId { seq: last.seq + 1, ..last });
        let (begun_after, newest, lost) = (self.begun_after, &self.newest, self.lost);
        let next = Next { key, is_repeat, written, own_first, begun_after, newest, lost };
        self.readers.iter_mut().find_map(|reader| (!reader.has_room(places, &next, None)).then_some(&*reader))
    }

    /// Notes, after a long wait, that samples which an earlier instance has sent exist nowhere any more if there is no other
    /// publisher. The next epoch may begin without the readers' answers to them, which readers count as missing. If this
    /// publisher can begin again, it sends them: see [`Credit::lost_predecessor`].
    pub(crate) fn has_waited_long(&mut self, places: &impl Places, written: Option<Written>, n_publishers: usize) {
        let last = written.map(|written| written.last);
        let may_begin_again = self.lost_predecessor(places, written, n_publishers).is_some();
        let is_alone = n_publishers == 1 && self.own_last != last;
        self.lost = if is_alone && !may_begin_again { last } else { None };
    }

    /// Whether a reader without room, or one behind it, is among these: it cannot go on while this publisher waits for it in
    /// the same process.
    pub(crate) fn waits_for_one_of(
        &mut self,
        slots: &[usize],
        places: &impl Places,
        written: Option<Written>,
        key: SampleId,
    ) -> bool {
        self.first_without_room(places, written, key).is_some_and(|reader| reader.is_among(slots))
    }

    /// Notes a sample that this publisher sends.
    pub(crate) fn has_sent(&mut self, key: SampleId) {
        if self.is_repeat(key) {
            return self.readers.iter_mut().for_each(Reader::has_been_sent_a_repeat);
        }
        self.own_first = self.own_first.filter(|first| first.epoch == key.epoch).or(Some(key));
        self.own_last = Some(key);
        self.newest.push_back(key);
        if self.newest.len() > self.n_newest {
            self.newest.pop_front();
        }
    }

    /// Whether a number is not above the last one of this publisher.
    fn is_repeat(&self, key: SampleId) -> bool {
        self.own_last.is_some_and(|last| last.epoch == key.epoch && key.seq <= last.seq)
    }

    /// The last sample that need not be sent again by an instance that takes over with this publisher. If another one has
    /// handed over, it is the last that was sent, otherwise the last that the readers have answered.
    pub(crate) fn known(
        &self,
        is_handed_over: bool,
        places: &impl Places,
        written: Option<Written>,
    ) -> Option<SampleId> {
        if is_handed_over { written.map(|written| written.last) } else { self.answered(places, written) }
    }

    /// Takes over; see [`Credit::known`].
    pub(crate) fn begin(
        &mut self,
        is_handed_over: bool,
        places: &impl Places,
        written: Option<Written>,
    ) -> Option<SampleId> {
        let known = self.known(is_handed_over, places, written);
        // If it goes on after its own last sample, it still needs the others for those before its first one.
        if self.begun_after.is_none() || self.own_last.is_none() || known != self.own_last {
            self.begun_after = Some(known);
        }
        known
    }

    /// The last sample that every lossless reader has answered, and every reader of an answer to it. An instance that takes
    /// over goes on after it, so that no sample is lost that died with its publisher.
    fn answered(&self, places: &impl Places, written: Option<Written>) -> Option<SampleId> {
        let written = written?;
        let least = self.least_answered(places, Some(written)).unwrap_or(Some(written.last));
        // The samples of this very publisher lie in the readers' queues and in its history.
        written.ahead(least, self.own_last)
    }

    /// Whether all samples that were sent and not answered lie in the memory of this publisher, or in that of one which has
    /// handed over to it. If not, an instance that takes over from it must send them again.
    pub(crate) fn has_sent_all(&self, written: Option<Written>) -> bool {
        let (Some(written), Some(begun_after)) = (written, self.begun_after) else { return true };
        let reached = written.ahead(begun_after, self.own_last);
        reached.is_some_and(|reached| written.is_past(reached, written.last))
    }

    /// The sample up to which another instance was to keep the samples for the readers, if a reader has not come so far and
    /// no other publisher is left that has them.
    pub(crate) fn lost_predecessor(
        &self,
        places: &impl Places,
        written: Option<Written>,
        n_publishers: usize,
    ) -> Option<SampleId> {
        let (written, begun_after) = (written?, self.begun_after??);
        let least = self.least_answered(places, Some(written))?;
        let is_behind = least.is_none_or(|least| !written.is_past(least, begun_after));
        (n_publishers == 1 && is_behind).then_some(begun_after)
    }

    /// The last sample that every lossless reader, and those behind it, have answered; `None` if there is none, or no such
    /// reader.
    pub(crate) fn answered_by_readers(&self, places: &impl Places, written: Option<Written>) -> Option<SampleId> {
        self.least_answered(places, written).flatten()
    }

    /// The last sample that the reader furthest behind has answered; the outer `None` if there is no reader.
    fn least_answered(&self, places: &impl Places, written: Option<Written>) -> Option<Option<SampleId>> {
        let written = written.as_ref();
        let least = self.readers.iter().filter_map(|reader| reader.least(places, written, None));
        least.reduce(|a, b| written.and_then(|written| written.behind(a, b)))
    }

    /// Whether there is a reader that the publisher waits for.
    pub(crate) fn has_readers(&self, places: &impl Places) -> bool {
        self.readers.iter().any(|reader| !places.is_given_up(reader.slot))
    }

    /// The readers that have not answered a sample that was sent.
    pub(crate) fn readers_that_lack(
        &self,
        key: SampleId,
        places: &impl Places,
        written: Option<Written>,
    ) -> Vec<&Reader> {
        let lacking =
            self.readers.iter().filter(|reader| match (reader.least(places, written.as_ref(), None), written) {
                (None, _) | (_, None) => false,
                (Some(None), _) => true,
                (Some(Some(place)), Some(written)) => !written.is_past(place, key),
            });
        lacking.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The last sample that the only reader has answered, and its count of repeated samples.
    struct Place(Option<SampleId>, u64);

    impl Places for Place {
        fn answered(&self, _: usize) -> Option<SampleId> {
            self.0
        }

        fn sent(&self, _: usize) -> Option<SampleId> {
            None
        }

        fn n_repeated(&self, _: usize) -> u64 {
            self.1
        }

        fn is_given_up(&self, _: usize) -> bool {
            false
        }
    }

    /// A reader in the first slot.
    fn reader(attached_slots: Vec<usize>) -> ConsumerWiring {
        ConsumerWiring { slot: 0, capacity: 4, attached_slots, attached_limit_millis: 0, behind: vec![] }
    }

    /// So many of the samples can be sent until the reader has no room.
    fn n_sent(credit: &mut Credit, written: &mut Option<Written>, keys: &[SampleId], place: &impl Places) -> usize {
        let is_sent = |key: &&SampleId| {
            let has_room = credit.first_without_room(place, *written, **key).is_none();
            if has_room {
                *written = Written::with(*written, **key).or(*written);
                credit.has_sent(**key);
            }
            has_room
        };
        keys.iter().take_while(is_sent).count()
    }

    /// An observer that stands still while epochs change was given up with most of its places free.
    #[test]
    fn an_attached_reader_has_room_for_its_places_whatever_the_epochs() {
        let keys = [id(9, 0), id(2, 0), id(5, 0), id(5, 1), id(1, 0), id(1, 1), id(1, 2)];
        let (mut credit, mut written) = (Credit::new(&[reader(vec![])], 4), None);
        assert_eq!(n_sent(&mut credit, &mut written, &keys, &Place(None, 0)), 1, "another reader is waited for");
        let (mut credit, mut written) = (Credit::new(&[reader(vec![0])], 4), None);
        assert_eq!(n_sent(&mut credit, &mut written, &keys, &Place(None, 0)), 4);
        assert_eq!(n_sent(&mut credit, &mut written, &keys[4..], &Place(Some(id(2, 0)), 0)), 2);
        assert_eq!(n_sent(&mut credit, &mut written, &keys[6..], &Place(Some(id(2, 0)), 0)), 0);
        assert_eq!(n_sent(&mut credit, &mut written, &keys[6..], &Place(Some(id(5, 0)), 0)), 1);
        // An instance that takes over goes back to no epoch that is over: its writer cannot send that again.
        assert_eq!(credit.answered_by_readers(&Place(Some(id(9, 0)), 0), written), Some(id(5, 1)));
        assert_eq!(credit.answered_by_readers(&Place(Some(id(1, 0)), 0), written), Some(id(1, 0)));
    }

    #[test]
    fn repeated_samples_take_places_in_the_queue_until_they_are_answered() {
        let ids = |seqs: &[u64]| seqs.iter().map(|seq| id(7, *seq)).collect::<Vec<_>>();
        let place = |seq, n_repeated| Place(Some(id(7, seq)), n_repeated);
        let (mut credit, mut written) = (Credit::new(&[reader(vec![])], 4), None);
        let mut send = |seqs: &[u64], place: Place| n_sent(&mut credit, &mut written, &ids(seqs), &place);
        // The reader has counted repeated samples of an earlier writer.
        assert_eq!(send(&[0, 1, 1, 0, 2, 2], Place(None, 10)), 4);
        // It has answered 0 and 1 and one of the two repeated ones; then all but the repeated ones.
        assert_eq!(send(&[2, 3, 3, 4], place(1, 11)), 3);
        assert_eq!(send(&[3, 3, 3, 3], place(3, 11)), 2);
        assert_eq!(send(&[3, 4, 4, 4, 4], place(3, 13)), 2);
        // It has answered all.
        assert_eq!(send(&[5, 6, 7, 8, 9], place(4, 16)), 4);
        // Also in that of a reader behind another one.
        let (mut credit, mut written) = (credit_of_chain(), None);
        let places = Chain([Some(id(7, 9)), None], Some(id(7, 9)));
        let sent: Vec<_> = ids(&[0, 0, 0, 1, 1]);
        assert_eq!(n_sent(&mut credit, &mut written, &sent, &places), 4);
    }

    /// The places of two readers in a row, and the last sample that the first one has sent to the second.
    struct Chain([Option<SampleId>; 2], Option<SampleId>);

    impl Places for Chain {
        fn answered(&self, slot: usize) -> Option<SampleId> {
            self.0[slot]
        }

        fn sent(&self, _: usize) -> Option<SampleId> {
            self.1
        }

        fn n_repeated(&self, _: usize) -> u64 {
            0
        }

        fn is_given_up(&self, _: usize) -> bool {
            false
        }
    }

    fn id(epoch: u64, seq: u64) -> SampleId {
        SampleId { epoch, seq }
    }

    /// The credit of the writer before a [`Chain`].
    fn credit_of_chain() -> Credit {
        let behind = vec![ReaderWiring { slot: 1, writer_slot: 2, behind: vec![] }];
        Credit::new(&[ConsumerWiring { behind, ..reader(vec![]) }], 4)
    }

    /// F3: the last sample of an epoch was left without an answer.
    #[test]
    fn an_epoch_begins_when_readers_have_answered_all_that_they_were_sent() {
        let written = Written { last: id(7, 1), first_seq: 0, before: None };
        let mut credit = credit_of_chain();
        let mut has_room = |answered: [u64; 2], sent| {
            let places = Chain(answered.map(|seq| Some(id(7, seq))), Some(id(7, sent)));
            credit.first_without_room(&places, Some(written), id(2, 0)).is_none()
        };
        assert!(!has_room([0, 0], 0), "the first one has not answered 1");
        assert!(!has_room([1, 0], 1), "the answer to 1 is on its way");
        assert!(has_room([1, 0], 0), "the first one has left 1 without an answer");
        assert!(has_room([1, 1], 1));
        let left_out = Chain([Some(id(7, 1)), Some(id(7, 0))], Some(id(7, 0)));
        assert_eq!(credit.known(false, &left_out, Some(written)), Some(id(7, 1)), "nobody needs it again");
    }

    /// F3: a source that cannot give its samples again dies together with its reader.
    #[test]
    fn an_epoch_begins_in_the_end_if_no_publisher_has_the_samples_before_it() {
        let mut written = Written { last: id(7, 1), first_seq: 0, before: None };
        let places = Chain([Some(id(7, 0)); 2], Some(id(7, 0)));
        let mut credit = credit_of_chain();
        credit.begin(false, &places, Some(written));
        for (n_publishers, has_room) in [(2, false), (1, true)] {
            credit.has_waited_long(&places, Some(written), n_publishers);
            assert_eq!(credit.first_without_room(&places, Some(written), id(2, 0)).is_none(), has_room);
        }
        // Its own samples are not lost, however long it waits.
        written = Written::with(Some(written), id(2, 0)).expect("a new sample");
        credit.has_sent(id(2, 0));
        credit.has_waited_long(&places, Some(written), 1);
        assert!(credit.first_without_room(&places, Some(written), id(9, 0)).is_some());
        // Its predecessor has ended with them: it begins again.
        let mut credit = credit_of_chain();
        credit.begin(true, &places, Some(written));
        credit.has_waited_long(&places, Some(written), 1);
        assert!(credit.first_without_room(&places, Some(written), id(9, 0)).is_some());
    }

    /// The numbers jump by more than the history, or a source that cannot give its samples again goes on after those that it
    /// has lost; then the writer and its reader die.
    #[test]
    fn numbers_that_no_sample_has_hold_up_no_instance_that_begins_again() {
        let ids = [9, 10, 11, 12, 13].map(|seq| id(7, seq));
        let places = Chain([Some(id(7, 0)); 2], Some(id(7, 0)));
        for (is_handed_over, n_with_room) in [(false, 4), (true, 0)] {
            let mut written = Some(Written { last: id(7, 9), first_seq: 0, before: None });
            let mut credit = credit_of_chain();
            credit.begin(is_handed_over, &places, written);
            let keys = if is_handed_over { &ids[1..] } else { &ids[..] };
            assert_eq!(n_sent(&mut credit, &mut written, keys, &places), n_with_room);
        }
    }

    /// L8: it was handed over to, or has begun again and has not sent again what its predecessor had sent.
    #[test]
    fn an_instance_knows_whether_its_memory_has_all_that_is_not_answered() {
        let written = Some(Written { last: id(7, 2), first_seq: 0, before: None });
        let places = Chain([Some(id(7, 0)); 2], Some(id(7, 0)));
        let mut credit = credit_of_chain();
        assert!(credit.has_sent_all(None), "nothing was sent");
        credit.begin(true, &places, written);
        assert!(credit.has_sent_all(written));
        assert_eq!(credit.readers_that_lack(id(7, 1), &Chain([None; 2], None), written).len(), 1);
        let mut credit = credit_of_chain();
        credit.begin(false, &places, written);
        assert!(!credit.has_sent_all(written));
        credit.has_sent(id(7, 1));
        assert!(!credit.has_sent_all(written));
        credit.has_sent(id(7, 2));
        assert!(credit.has_sent_all(written));
    }
}
