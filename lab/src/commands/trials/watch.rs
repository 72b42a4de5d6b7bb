//! Collects and shows the outcomes of trials while the graph runs.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use indicatif::{ProgressBar, ProgressStyle};

use blindgrasp_learning::trials::tally::TrialRecord;
use blindgrasp_messages::{Action, LiftDecision};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::Record;
use blindgrasp_session::run::Tap;

/// Trials between two lines of progress where no bar can be shown.
const N_TRIALS_A_LINE: u64 = 10;

/// The outcomes and decisions of attempts.
#[derive(Default)]
pub(super) struct Watched {
    /// Outcomes, in order.
    pub(super) records: Vec<TrialRecord>,
    /// Decisions, by grasp.
    pub(super) decisions: BTreeMap<u64, LiftDecision>,
    /// What the arm was told to do while it lifted, by grasp.
    reactions: BTreeMap<u64, Vec<Action>>,
}

#[derive(Default)]
struct Seen {
    watched: Watched,
    n_ended: u64,
    n_lifts: u64,
    n_held: u64,
}

pub(super) struct Watch {
    seen: Arc<Mutex<Seen>>,
    bar: ProgressBar,
    max_attempts: u32,
    n_trials: u64,
    way: &'static str,
}

impl Watch {
    pub(super) fn new(n_trials: u64, max_attempts: u32, way: &'static str) -> Self {
        let bar = ProgressBar::new(n_trials);
        if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} trials, {elapsed} ({msg})") {
            bar.set_style(style);
        }
        bar.set_message(way);
        Watch { seen: Arc::default(), bar, max_attempts, n_trials, way }
    }

    /// The observer of a session's samples.
    pub(super) fn tap(&self) -> Tap {
        let (seen, bar) = (Arc::clone(&self.seen), self.bar.clone());
        let (max_attempts, n_trials, way) = (self.max_attempts, self.n_trials, self.way);
        Box::new(move |_, record, _| {
            let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
            let record = match record {
                Record::Outcome(outcome) => TrialRecord::from(outcome.clone()),
                Record::Decision(decision) => {
                    let LiftDecision { grasp_id, action, .. } = decision.message;
                    if action.decides() {
                        seen.watched.decisions.insert(grasp_id, decision.message.clone());
                    } else {
                        seen.watched.reactions.entry(grasp_id).or_default().push(action);
                    }
                    return Ok(());
                }
                _ => return Ok(()),
            };
            seen.n_lifts += u64::from(record.lifted);
            seen.n_held += u64::from(record.held);
            let has_ended = record.lifted || record.attempt + 1 >= max_attempts;
            seen.n_ended += u64::from(has_ended);
            bar.set_position(seen.n_ended);
            let said = format!("{way}: {} of {} lifts kept, {}", seen.n_held, seen.n_lifts, record.thing);
            if bar.is_hidden() && has_ended && (seen.n_ended % N_TRIALS_A_LINE == 0 || seen.n_ended == n_trials) {
                print_diagnostic(&format!("{} of {n_trials} trials, {said}", seen.n_ended));
            }
            bar.set_message(said);
            seen.watched.records.push(record);
            Ok(())
        })
    }

    pub(super) fn finish(self) -> Watched {
        self.bar.finish_and_clear();
        let mut watched = std::mem::take(&mut self.seen.lock().unwrap_or_else(PoisonError::into_inner).watched);
        for record in &mut watched.records {
            let was_told =
                |action: Action| watched.reactions.get(&record.grasp_id).is_some_and(|told| told.contains(&action));
            (record.tightened, record.set_down) = (was_told(Action::Tighten), was_told(Action::SetDown));
        }
        watched
    }
}
