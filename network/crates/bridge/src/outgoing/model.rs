//! A model of a lossless channel: a writer with a history, the sending end, the file of saved samples, and a receiver. All orders
//! of a few steps are tried, kills of the sending process between any two among them. No order may lose a sample or send one
//! that the receiver has.

use std::collections::BTreeSet;

use super::*;

/// The samples that are written. The values of their epochs fall and rise.
const KEYS: [SampleId; 4] = [key(5, 0), key(2, 0), key(2, 1), key(9, 0)];
const N_SAMPLES: usize = KEYS.len();
/// The writer's limit; its history holds what is not committed.
const CAPACITY: usize = 2;
/// Late enough for a sample to be committed while the receiver is away.
const NOW_NANOS: u64 = COMMIT_AFTER_NANOS;
const OPTIONS: OutgoingOptions = OutgoingOptions {
    policy: EdgePolicy::Lossless,
    window: 2,
    capacity: CAPACITY,
    buffer: 100,
    stall_limit_nanos: u64::MAX,
};

const fn key(epoch: u64, seq: u64) -> SampleId {
    SampleId { epoch, seq }
}

/// How many samples there are up to this one.
fn n_up_to(key: Option<SampleId>) -> usize {
    key.map_or(0, |key| 1 + KEYS.iter().position(|other| *other == key).expect("one of them"))
}

/// The last of the first `n` samples.
fn last_of(n: usize) -> Option<SampleId> {
    Some(KEYS[n.checked_sub(1)?])
}

#[derive(Debug, Clone)]
struct State {
    n_written: usize,
    /// On the cursors: the sample up to which the writer forgets.
    committed: Option<SampleId>,
    /// The number of samples that the link has read.
    n_read: usize,
    sender: Outgoing,
    spool: Vec<KeptSample>,
    n_received: usize,
    is_wrong: bool,
    run: u32,
    n_kills: u32,
    n_cuts: u32,
}

#[derive(Debug, Clone, Copy)]
enum Step {
    Write,
    Read,
    Save,
    Commit,
    ForgetAnswered,
    Kill,
    Resume,
    Deliver,
    Answer,
    CutOff,
}

const STEPS: [Step; 10] = [
    Step::Write,
    Step::Read,
    Step::Save,
    Step::Commit,
    Step::ForgetAnswered,
    Step::Kill,
    Step::Resume,
    Step::Deliver,
    Step::Answer,
    Step::CutOff,
];

impl State {
    fn new() -> State {
        State {
            n_written: 0,
            committed: None,
            n_read: 0,
            sender: Outgoing::new(OPTIONS, None, None),
            spool: Vec::new(),
            n_received: 0,
            is_wrong: false,
            run: 0,
            n_kills: 0,
            n_cuts: 0,
        }
    }

    /// The state after a step; `None` if the step is not possible.
    fn after(&self, step: Step, saves: bool) -> Option<State> {
        let mut next = self.clone();
        let n_committed = n_up_to(self.committed);
        match step {
            Step::Write => {
                let written = KEYS.get(self.n_written)?;
                // A new epoch begins when the one before is answered.
                let n_most =
                    if last_of(self.n_written).is_some_and(|last| last.epoch != written.epoch) { 1 } else { CAPACITY };
                if self.n_written - n_committed >= n_most {
                    return None;
                }
                next.n_written += 1;
            }
            Step::Read => {
                if self.n_read == self.n_written || !next.sender.wants_more(self.sender.run.is_some(), NOW_NANOS) {
                    return None;
                }
                next.sender.push(KEYS[self.n_read], vec![self.n_read as u8], 0, 0);
                next.n_read += 1;
            }
            Step::Save => {
                let sample = self.sender.next_to_save(NOW_NANOS)?;
                if saves {
                    next.spool.push(sample.clone());
                }
                next.sender.saved();
            }
            Step::Commit => {
                next.committed = self.sender.commit_point();
                if next.committed == self.committed {
                    return None;
                }
            }
            Step::ForgetAnswered => {
                let kept = self.sender.committed();
                if kept.len() >= self.spool.len() {
                    return None;
                }
                next.spool = self.sender.committed().cloned().collect();
            }
            Step::Kill => {
                if self.n_kills == 2 {
                    return None;
                }
                next.n_kills += 1;
                let written = KEYS[..self.n_written].iter().fold(None, |written, key| Written::with(written, *key));
                next.sender = Outgoing::new(OPTIONS, self.committed, written);
                next.sender.restore(self.spool.clone(), 0);
                next.spool = next.sender.committed().cloned().collect();
                next.n_read = n_committed;
            }
            Step::Resume => {
                if self.sender.run.is_some() || self.run == 3 {
                    return None;
                }
                next.resume();
            }
            Step::Deliver => {
                if !next.deliver() {
                    return None;
                }
            }
            Step::Answer => {
                if self.n_received == 0 {
                    return None;
                }
                next.answer();
            }
            Step::CutOff => {
                if self.sender.run.is_none() || self.n_cuts == 1 {
                    return None;
                }
                next.n_cuts += 1;
                next.sender.cut_off();
            }
        }
        Some(next)
    }

    fn resume(&mut self) {
        self.run += 1;
        self.sender.on_resume(self.run, last_of(self.n_received));
    }

    /// Hands the next sample to the receiver; false if none is due.
    fn deliver(&mut self) -> bool {
        let Some(next) = self.sender.next(NOW_NANOS) else { return false };
        // The receiver takes what comes, as from a writer whose numbers have gaps.
        let n_received = n_up_to(Some(next.key));
        self.is_wrong |= n_received != self.n_received + 1;
        self.n_received = self.n_received.max(n_received);
        true
    }

    fn answer(&mut self) {
        let n = self.n_received;
        self.sender.on_ack(self.run, n as u64, last_of(n), NOW_NANOS);
    }

    /// Whether the receiver gets all samples from here on without any fault.
    fn loses_nothing(&self) -> bool {
        let mut state = self.clone();
        state.sender.cut_off();
        state.resume();
        for _ in 0..4 * N_SAMPLES {
            for step in [Step::Write, Step::Read] {
                if let Some(next) = state.after(step, true) {
                    state = next;
                }
            }
            while state.deliver() {}
            state.answer();
            state.committed = state.sender.commit_point();
        }
        state.n_received == N_SAMPLES && !state.is_wrong && state.sender.n_lost == 0
    }
}

/// The number of states that were found, and whether some of them has lost a sample. `saves` is the rule: a sample that is
/// committed without an answer is saved before.
fn explore(saves: bool) -> (usize, bool) {
    let mut seen = BTreeSet::new();
    let mut open = vec![State::new()];
    while let Some(state) = open.pop() {
        if !seen.insert(format!("{state:?}")) {
            continue;
        }
        if !state.loses_nothing() {
            return (seen.len(), true);
        }
        for step in STEPS {
            open.extend(state.after(step, saves));
        }
    }
    (seen.len(), false)
}

#[test]
fn no_order_of_steps_and_kills_loses_a_sample() {
    let (n_states, has_lost) = explore(true);
    assert!(!has_lost);
    assert!(n_states > 1000, "{n_states}");
}

#[test]
fn samples_that_are_committed_and_not_saved_are_lost() {
    assert!(explore(false).1);
}
