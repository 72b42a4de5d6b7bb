use super::*;

const EPOCH: u64 = 5;
const NONE: [u64; 0] = [];
const STALL_LIMIT: u64 = 3_000_000_000;
const OPTIONS: OutgoingOptions = OutgoingOptions {
    policy: EdgePolicy::Lossless,
    window: 8,
    capacity: 8,
    buffer: 100,
    stall_limit_nanos: STALL_LIMIT,
};

fn key(seq: u64) -> SampleId {
    SampleId { epoch: EPOCH, seq }
}

fn outgoing(policy: EdgePolicy, window: usize, capacity: usize, buffer: usize) -> Outgoing {
    Outgoing::new(OutgoingOptions { policy, window, capacity, buffer, stall_limit_nanos: STALL_LIMIT }, None, None)
}

fn push(outgoing: &mut Outgoing, seqs: std::ops::Range<u64>) {
    seqs.for_each(|seq| outgoing.push(key(seq), vec![seq as u8], 100 + seq, 0));
}

/// The sequence numbers of the samples that are due. Checks that they belong to one request and that their indices
/// count.
fn sent(outgoing: &mut Outgoing, now_nanos: u64) -> Vec<u64> {
    let mut seqs = Vec::new();
    while let Some(next) = outgoing.next(now_nanos) {
        assert_eq!((next.message, next.origin_nanos), (&[next.key.seq as u8][..], 100 + next.key.seq));
        seqs.push(next.key.seq);
    }
    seqs
}

/// Saves the samples that must be, and returns the last one that may be committed.
fn saved(outgoing: &mut Outgoing, now_nanos: u64) -> Option<SampleId> {
    while outgoing.next_to_save(now_nanos).is_some() {
        outgoing.saved();
    }
    outgoing.commit_point()
}

#[test]
fn nothing_goes_before_it_is_asked_for_and_then_from_there() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 8, 8, 100);
    push(&mut outgoing, 0..6);
    assert_eq!(sent(&mut outgoing, 0), NONE);
    outgoing.on_resume(3, Some(key(1)));
    let first = outgoing.next(0).expect("sent");
    assert_eq!((first.run, first.index, first.key, first.is_repeat), (3, 0, key(2), false));
    assert_eq!(sent(&mut outgoing, 0), [3, 4, 5]);
    // The same request and an earlier one change nothing; a later one does.
    outgoing.on_resume(3, None);
    outgoing.on_resume(2, None);
    assert_eq!(sent(&mut outgoing, 0), NONE);
    outgoing.on_resume(4, Some(key(3)));
    let again = outgoing.next(0).expect("sent");
    assert_eq!((again.run, again.index, again.key, again.is_repeat), (4, 0, key(4), true));
    let status = outgoing.status("a/b", 0);
    assert_eq!((status.n_samples, status.n_repeated, status.n_waiting, status.n_lost), (4, 1, 6, 0));
    outgoing.cut_off();
    assert_eq!(sent(&mut outgoing, u64::MAX), NONE);
    // After it was cut off, the receiver may start counting again.
    outgoing.on_resume(1, Some(key(4)));
    assert_eq!(sent(&mut outgoing, 0), [5]);
}

#[test]
fn a_receiver_may_have_samples_that_are_no_longer_kept_or_not_yet_pushed() {
    for (after, expected) in [
        (None, vec![3, 4, 5]),
        (Some(key(1)), vec![3, 4, 5]),
        (Some(key(2)), vec![3, 4, 5]),
        (Some(key(5)), vec![]),
        // Samples of an earlier run, whose clock was ahead, or of an epoch that is over.
        (Some(SampleId { epoch: EPOCH + 1, seq: 2 }), vec![3, 4, 5]),
        (Some(SampleId { epoch: EPOCH - 1, seq: 2 }), vec![3, 4, 5]),
    ] {
        let mut outgoing = outgoing(EdgePolicy::Lossless, 8, 8, 100);
        push(&mut outgoing, 0..6);
        outgoing.on_resume(1, None);
        assert_eq!(sent(&mut outgoing, 0).len(), 6);
        outgoing.on_ack(1, 6, Some(key(2)), 0);
        outgoing.on_resume(2, after);
        assert_eq!(sent(&mut outgoing, 0), expected, "{after:?}");
    }
    // This process has taken over, and reads samples again that the receiver has from the earlier process.
    let mut outgoing = Outgoing::new(OPTIONS, Some(key(1)), Written::with(None, key(4)));
    outgoing.on_resume(1, Some(key(4)));
    push(&mut outgoing, 2..7);
    assert_eq!(sent(&mut outgoing, 0), [5, 6]);
    // The readers have not answered the sample, so that it is sent again on request.
    outgoing.on_resume(2, Some(key(2)));
    assert_eq!(sent(&mut outgoing, 0), [3, 4, 5, 6]);
    assert_eq!(outgoing.status("a/b", 0).n_lost, 3 - 3);
}

#[test]
fn epochs_are_in_the_order_in_which_they_came() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 100, 100, 100);
    for (epoch, seq) in [(9, 0), (9, 1), (2, 0), (2, 1), (7, 0)] {
        outgoing.push(SampleId { epoch, seq }, Vec::new(), 0, 0);
    }
    let mut after = |run, epoch, seq| {
        outgoing.on_resume(run, Some(SampleId { epoch, seq }));
        std::iter::from_fn(|| outgoing.next(0).map(|next| (next.key.epoch, next.key.seq))).collect::<Vec<_>>()
    };
    assert_eq!(after(1, 9, 1), [(2, 0), (2, 1), (7, 0)]);
    assert_eq!(after(2, 2, 0), [(2, 1), (7, 0)]);
    assert_eq!(after(3, 7, 0), []);
    outgoing.on_ack(3, 0, Some(SampleId { epoch: 2, seq: 0 }), 0);
    assert_eq!(outgoing.n_waiting(), 2);
}

#[test]
fn samples_are_sent_in_the_order_in_which_they_were_pushed() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 100, 100, 100);
    for seq in [5, 7, 6, 6, 8] {
        outgoing.push(key(seq), vec![seq as u8], 100 + seq, 0);
    }
    outgoing.on_resume(1, None);
    assert_eq!(sent(&mut outgoing, 0), [5, 7, 6, 6, 8]);
    outgoing.on_resume(2, Some(key(7)));
    assert_eq!(sent(&mut outgoing, 0), [6, 6, 8]);
    outgoing.on_ack(2, 0, Some(key(6)), 0);
    assert_eq!(outgoing.n_waiting(), 2);
}

#[test]
fn a_receiver_that_is_behind_holds_the_writer_up_and_that_is_counted() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 4, 8, 10);
    outgoing.on_resume(1, None);
    push(&mut outgoing, 0..4);
    assert_eq!(sent(&mut outgoing, 0), [0, 1, 2, 3]);
    // The receiver is up from the start, so that the buffer is not used.
    outgoing.on_ack(1, 4, Some(key(3)), 0);
    assert!(outgoing.wants_more(true, 0));
    push(&mut outgoing, 4..8);
    assert_eq!(sent(&mut outgoing, 0), [4, 5, 6, 7]);
    assert!(!outgoing.wants_more(true, 10) && !outgoing.wants_more(true, 20));
    assert_eq!(outgoing.status("a/b", 25).blocked_nanos, 15);
    outgoing.on_ack(1, 5, Some(key(4)), 0);
    assert!(outgoing.wants_more(true, 40));
    assert_eq!(outgoing.status("a/b", 100).blocked_nanos, 30);
    // A machine that is away does not block the writer.
    push(&mut outgoing, 8..12);
    outgoing.cut_off();
    assert!(outgoing.wants_more(false, 200));
    push(&mut outgoing, 12..15);
    assert_eq!(outgoing.status("a/b", 200).n_lost, 0);
    push(&mut outgoing, 15..16);
    // Sample 5 was sent, so that only the receiver knows whether it is lost.
    assert_eq!(outgoing.status("a/b", 200).n_lost, 0);
    // After the receiver is back, kept samples are sent window by window, and the writer is blocked only by a full
    // buffer.
    outgoing.on_resume(9, Some(key(4)));
    let status = outgoing.status("a/b", 200);
    assert_eq!((status.n_lost, status.n_waiting, status.blocked_nanos), (1, 10, 30));
    assert_eq!(sent(&mut outgoing, 0), [6, 7, 8, 9]);
    assert!(!outgoing.wants_more(true, 300));
    outgoing.on_ack(9, 4, Some(key(9)), 0);
    assert!(outgoing.wants_more(true, 300));
    assert_eq!(sent(&mut outgoing, 0), [10, 11, 12, 13]);
}

#[test]
fn a_sample_that_is_given_up_counts_as_lost_unless_the_receiver_has_it() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 3, 3, 4);
    outgoing.on_resume(1, None);
    push(&mut outgoing, 0..3);
    assert_eq!(sent(&mut outgoing, 0), [0, 1, 2]);
    outgoing.cut_off();
    push(&mut outgoing, 3..9);
    // Samples 0, 1, 2 were sent; 3 and 4 were not.
    assert_eq!(outgoing.status("a/b", 0).n_lost, 2);
    outgoing.on_resume(2, Some(key(1)));
    assert_eq!(outgoing.status("a/b", 0).n_lost, 3);
    assert_eq!(sent(&mut outgoing, 0), [5, 6, 7]);
    // The loss is counted once.
    outgoing.on_resume(3, Some(key(1)));
    assert_eq!(outgoing.status("a/b", 0).n_lost, 3);
    outgoing.on_ack(3, 0, Some(key(5)), 0);
    outgoing.give_up();
    let status = outgoing.status("a/b", 0);
    assert_eq!((status.n_lost, status.n_waiting), (6, 0));
}

#[test]
fn the_last_sample_goes_again_until_something_says_that_it_came() {
    for policy in [EdgePolicy::Lossless, EdgePolicy::Latest] {
        let mut outgoing = outgoing(policy, 8, 8, 100);
        outgoing.on_resume(1, None);
        push(&mut outgoing, 0..1);
        assert_eq!(sent(&mut outgoing, 0), [0]);
        assert_eq!(sent(&mut outgoing, FIRST_PROBE_NANOS - 1), NONE);
        let probe = outgoing.next(FIRST_PROBE_NANOS).expect("again");
        assert_eq!((probe.index, probe.key, probe.is_repeat), (0, key(0), true));
        assert_eq!(sent(&mut outgoing, FIRST_PROBE_NANOS), NONE);
        // Each pause is longer.
        assert_eq!(sent(&mut outgoing, 3 * FIRST_PROBE_NANOS - 1), NONE);
        assert_eq!(sent(&mut outgoing, 3 * FIRST_PROBE_NANOS), [0]);
        outgoing.on_ack(1, 1, None, 4 * FIRST_PROBE_NANOS);
        assert_eq!(sent(&mut outgoing, u64::MAX), NONE, "{policy}");
        // The sample was received and not answered.
        assert_eq!(outgoing.status("a/b", 0).n_waiting, 0);
        outgoing.on_resume(2, None);
        assert_eq!(sent(&mut outgoing, 0), [0]);
    }
}

#[test]
fn of_latest_only_the_newest_waits() {
    let mut outgoing = outgoing(EdgePolicy::Latest, 2, 8, 100);
    push(&mut outgoing, 0..5);
    assert!(outgoing.wants_more(true, 0));
    assert_eq!(outgoing.status("a/b", 0).n_lost, 4);
    outgoing.on_resume(1, None);
    assert_eq!(sent(&mut outgoing, 0), [4]);
    push(&mut outgoing, 5..6);
    assert_eq!(sent(&mut outgoing, 0), [5]);
    // The window is full: later samples wait, and only the newest of them is kept.
    push(&mut outgoing, 6..8);
    assert_eq!(sent(&mut outgoing, 0), NONE);
    assert_eq!(outgoing.status("a/b", 0).n_lost, 5);
    outgoing.on_ack(1, 1, None, 0);
    let next = outgoing.next(0).expect("room");
    assert_eq!((next.index, next.key), (2, key(7)));
    // Sample 5 was lost and is not sent again: the receiver has sample 4.
    outgoing.on_resume(2, Some(key(4)));
    assert_eq!(outgoing.status("a/b", 0).n_lost, 6);
    assert_eq!(sent(&mut outgoing, 0), [7]);
    assert_eq!(saved(&mut outgoing, u64::MAX), Some(key(6)));
    outgoing.on_ack(2, 1, Some(key(7)), 0);
    assert_eq!(saved(&mut outgoing, u64::MAX), Some(key(7)));
}

#[test]
fn the_writer_can_always_go_on_while_the_receiver_is_cut_off() {
    // Sequence numbers grow by one or more; the writer's limit is a difference of sequence numbers.
    for (capacity, step) in [(1, 1), (2, 1), (8, 1), (64, 1), (64, 10)] {
        let mut outgoing = outgoing(EdgePolicy::Lossless, 4, capacity, 1000);
        let mut place: Option<SampleId> = None;
        for n in 0..500 {
            let next = key(n * step);
            // The rule of `port::Publisher`.
            let first_unanswered = place.map_or(0, |place| place.seq + 1);
            let is_all_answered = n > 0 && place == Some(key((n - 1) * step));
            assert!(next.seq - first_unanswered.min(next.seq) < capacity as u64 || is_all_answered, "{n}");
            outgoing.push(next, Vec::new(), 0, 1000);
            place = saved(&mut outgoing, 1000);
            if capacity == 64 && step == 1 {
                let n_in_memory_only = place.map_or(0, |place| place.seq + 1);
                assert_eq!(n_in_memory_only, (n + 1).saturating_sub(48), "the last ones lie in the history as well");
            }
        }
        // A new epoch begins when the old one is answered.
        assert_eq!(saved(&mut outgoing, 1000 + COMMIT_AFTER_NANOS), Some(key(499 * step)));
    }
}

#[test]
fn a_place_goes_on_as_answers_come() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 100, 8, 100);
    assert_eq!(saved(&mut outgoing, 0), None);
    outgoing.on_resume(1, None);
    push(&mut outgoing, 0..5);
    sent(&mut outgoing, 0);
    assert_eq!(saved(&mut outgoing, u64::MAX), None);
    outgoing.on_ack(1, 3, Some(key(1)), 0);
    assert_eq!(saved(&mut outgoing, u64::MAX), Some(key(1)));
    push(&mut outgoing, 5..10);
    assert_eq!(saved(&mut outgoing, 0), Some(key(3)));
    // A sample that was not sent cannot be answered.
    outgoing.on_ack(1, 900, Some(key(9)), 0);
    assert_eq!((saved(&mut outgoing, 0), outgoing.n_waiting()), (Some(key(4)), 5));
}

#[test]
fn the_end_is_sent_when_all_is_answered_and_after_each_request() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 8, 8, 100);
    push(&mut outgoing, 0..2);
    outgoing.end(Some(key(1)));
    assert_eq!(outgoing.end_to_send(0), None);
    outgoing.on_resume(1, None);
    sent(&mut outgoing, 0);
    outgoing.on_ack(1, 2, Some(key(0)), 0);
    assert_eq!(outgoing.end_to_send(0), None);
    outgoing.on_ack(1, 2, Some(key(1)), 0);
    assert_eq!(outgoing.end_to_send(0), Some((1, Some(key(1)))));
    assert_eq!(outgoing.end_to_send(END_PAUSE_NANOS - 1), None);
    assert_eq!(outgoing.end_to_send(END_PAUSE_NANOS), Some((1, Some(key(1)))));
    assert!(!outgoing.is_done());
    outgoing.on_ended();
    assert!(outgoing.is_done());
    assert_eq!(outgoing.end_to_send(u64::MAX), None);
    outgoing.on_resume(2, Some(key(1)));
    assert_eq!(outgoing.end_to_send(0), Some((2, Some(key(1)))));
    assert!(outgoing.is_done());
}

#[test]
fn a_process_that_takes_over_goes_on_with_what_was_saved() {
    let kept = |seq| KeptSample { key: key(seq), origin_nanos: 100 + seq, message: vec![seq as u8] };
    // Saved samples, the last committed one, the last one that the receiver has, and the samples that it gets. The writer sends
    // those behind the committed one again.
    for (saved, committed, after, expected) in [
        (4..8, 7, Some(3), vec![4, 5, 6, 7, 8, 9]),
        (4..8, 7, Some(5), vec![6, 7, 8, 9]),
        (4..8, 7, None, vec![4, 5, 6, 7, 8, 9]),
        (4..8, 7, Some(8), vec![9]),
        // It was killed before it committed them, or after later ones were answered.
        (4..8, 5, Some(3), vec![4, 5, 6, 7, 8, 9]),
        (4..8, 3, Some(3), vec![4, 5, 6, 7, 8, 9]),
        (4..6, 7, Some(7), vec![8, 9]),
    ] {
        let mut outgoing = Outgoing::new(OPTIONS, Some(key(committed)), Written::with(None, key(8)));
        outgoing.restore(saved.clone().map(kept).collect(), 0);
        assert_eq!(outgoing.commit_point(), Some(key(committed)));
        push(&mut outgoing, committed + 1..10);
        outgoing.on_resume(1, after.map(key));
        assert_eq!(sent(&mut outgoing, 0), expected, "{saved:?} {committed} {after:?}");
        outgoing.on_ack(1, 100, Some(key(9)), 0);
        assert_eq!((outgoing.n_waiting(), outgoing.status("a/b", 0).n_lost), (0, 0));
        assert_eq!((outgoing.commit_point(), outgoing.committed().len()), (Some(key(9)), 0));
    }
}

#[test]
fn a_receiver_that_answers_nothing_is_cut_off_until_it_answers() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 4, 8, 6);
    outgoing.on_resume(1, None);
    assert!(outgoing.wants_more(true, 0));
    push(&mut outgoing, 0..4);
    assert_eq!(sent(&mut outgoing, 0), [0, 1, 2, 3]);
    assert!(!outgoing.wants_more(true, 10));
    // An answer begins the time anew; a sample that was only received does not.
    outgoing.on_ack(1, 4, Some(key(0)), 20);
    push(&mut outgoing, 4..5);
    assert_eq!(sent(&mut outgoing, 20), [4]);
    assert!(!outgoing.wants_more(true, 20));
    outgoing.on_ack(1, 5, Some(key(0)), 30);
    assert!(!outgoing.wants_more(true, 19 + STALL_LIMIT) && !outgoing.is_stalled());
    // The writer goes on, and the oldest samples beyond the buffer are given up.
    let mut now_nanos = 20 + STALL_LIMIT;
    assert!(outgoing.wants_more(true, now_nanos) && outgoing.is_stalled());
    for seq in 5..1000 {
        assert!(outgoing.wants_more(true, now_nanos));
        push(&mut outgoing, seq..seq + 1);
        assert!(saved(&mut outgoing, now_nanos + COMMIT_AFTER_NANOS).is_some_and(|point| point.seq == seq));
    }
    // Samples 1 to 4 were sent, so that only the receiver knows whether they are lost.
    assert_eq!(outgoing.status("a/b", 0).n_lost, 994 - 5);
    assert_eq!(outgoing.status("a/b", 0).n_waiting, 6);
    // Only one sample is on its way, and it is repeated.
    now_nanos += LONGEST_PROBE_NANOS;
    assert_eq!(sent(&mut outgoing, now_nanos), [994]);
    now_nanos += LONGEST_PROBE_NANOS;
    assert_eq!(sent(&mut outgoing, now_nanos), [994]);
    // A new request alone changes nothing but the count.
    outgoing.on_resume(2, Some(key(3)));
    assert!(outgoing.wants_more(true, now_nanos) && outgoing.is_stalled());
    assert_eq!(outgoing.status("a/b", 0).n_lost, 994 - 4);
    assert_eq!(sent(&mut outgoing, now_nanos), [994]);
    // It answers: it gets the samples that are left, and blocks the writer only once it has caught up.
    outgoing.on_ack(2, 1, Some(key(994)), now_nanos);
    assert!(!outgoing.is_stalled());
    assert_eq!(sent(&mut outgoing, now_nanos), [995, 996, 997, 998]);
    assert!(outgoing.wants_more(true, now_nanos));
    outgoing.on_ack(2, 5, Some(key(998)), now_nanos);
    assert!(outgoing.wants_more(true, now_nanos));
    push(&mut outgoing, 1000..1003);
    assert_eq!(sent(&mut outgoing, now_nanos), [999, 1000, 1001, 1002]);
    assert!(!outgoing.wants_more(true, now_nanos));
    assert_eq!(outgoing.status("a/b", 0).n_lost, 994 - 4);
}

#[test]
fn a_receiver_that_comes_back_and_answers_nothing_again_blocks_nobody() {
    let mut outgoing = outgoing(EdgePolicy::Lossless, 4, 8, 6);
    let mut now_nanos = 0;
    assert!(outgoing.wants_more(true, now_nanos));
    push(&mut outgoing, 0..4);
    assert!(!outgoing.wants_more(true, now_nanos));
    now_nanos += STALL_LIMIT;
    assert!(outgoing.wants_more(true, now_nanos) && outgoing.is_stalled());
    for run in 1..20 {
        // A hello of a new process.
        outgoing.cut_off();
        assert!(!outgoing.is_stalled());
        outgoing.on_resume(run, None);
        assert!(outgoing.wants_more(true, now_nanos));
        sent(&mut outgoing, now_nanos);
        now_nanos += STALL_LIMIT - 1;
        assert!(outgoing.wants_more(true, now_nanos) && !outgoing.is_stalled());
        now_nanos += 1;
        assert!(outgoing.wants_more(true, now_nanos) && outgoing.is_stalled());
    }
    assert_eq!(outgoing.status("a/b", now_nanos).blocked_nanos, STALL_LIMIT);
}
