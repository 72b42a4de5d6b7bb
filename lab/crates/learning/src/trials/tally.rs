//! Counts of trials: targets kept, drops that the decision avoided, and the cost in attempts.
//!
//! These are pure statistics over records. Intervals are Wilson's 95 % intervals and
//! take lifts as independent of each other.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::evaluation::statistics::{Estimate, wilson_interval};
use crate::promise::{ObjectTrials, promise};
use blindgrasp_messages::{LiftOutcome, Stamped};
use blindgrasp_simulator::trial::targets::{N_PAPER_TRIALS_EACH, held_in_paper};
use blindgrasp_simulator::wrench_space::{STABLE_EPSILON, STABLE_VOLUME};
use blindgrasp_stages::training_summary::Promise;

/// The outcome of one attempt.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrialRecord {
    /// Number of the trial, from 0.
    pub trial: u64,
    /// Number of the attempt within its trial, from 0.
    pub attempt: u32,
    /// The grasp, as the other messages of the graph name it.
    pub grasp_id: u64,
    /// The name of the object.
    pub thing: String,
    /// The group of the object.
    pub group: String,
    /// The mass of the object.
    pub mass_kg: f64,
    /// Coulomb friction of its surface on the hand's rubber.
    pub friction: f64,
    /// Whether the hand lifted; otherwise it let go and tried again.
    pub lifted: bool,
    /// Whether the object was kept: in the hand and off the stand at the end. False if it was not lifted.
    pub held: bool,
    /// Movement of the object in the hand.
    pub slip_m: f64,
    /// Turn of the object in the hand.
    pub turn_rad: f64,
    /// Epsilon of the settled grasp, with all its contacts; `None` if the hull failed.
    pub epsilon: Option<f64>,
    /// Volume of its wrench space.
    pub volume: Option<f64>,
    /// Whether the hand made a probe before it lifted or let go.
    pub probed: bool,
    /// Whether a test lift that was not followed by a lift left the object elsewhere in the hand.
    pub disturbed: bool,
    /// Whether the hand tightened, and whether it set the object down, while it lifted.
    pub tightened: bool,
    pub set_down: bool,
    /// When it was over, robot time since the run began, seconds.
    pub end_secs: f64,
}

impl From<Stamped<LiftOutcome>> for TrialRecord {
    fn from(outcome: Stamped<LiftOutcome>) -> Self {
        let end_secs = outcome.header.stamp_nanos as f64 * 1e-9;
        let outcome = outcome.message;
        let LiftOutcome { probed, disturbed, .. } = outcome;
        let LiftOutcome { grasp_id, trial, attempt, lifted, held, has_quality, .. } = outcome;
        let LiftOutcome { slip_m, turn_rad, epsilon, volume, mass_kg, friction, thing, group, .. } = outcome;
        let [epsilon, volume] = [epsilon, volume].map(|value| has_quality.then_some(value));
        TrialRecord {
            trial,
            attempt,
            grasp_id,
            thing,
            group,
            mass_kg,
            friction,
            lifted,
            held,
            slip_m,
            turn_rad,
            epsilon,
            volume,
            probed,
            disturbed,
            tightened: false,
            set_down: false,
            end_secs,
        }
    }
}

/// Counts of some trials.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tally {
    /// What they have in common: a thing's or group's name, or `total`.
    pub name: String,
    /// The smallest and the largest mass.
    pub mass_kg: [f64; 2],
    /// Trials that came to an end.
    pub n_trials: usize,
    /// Attempts in these trials.
    pub n_attempts: usize,
    /// Trials that ended in a lift.
    pub n_lifts: usize,
    /// Lifts that held.
    pub n_held: usize,
    /// Trials in which no attempt was lifted.
    pub n_given_up: usize,
    /// Of the lifts, those that held; `None` without lifts.
    pub success: Option<Estimate>,
    /// Attempts for each lift, those of trials given up included; `None` without lifts.
    pub attempts_per_lift: Option<f64>,
    /// Attempts for each lift that held.
    pub attempts_per_held: Option<f64>,
    /// What the paper's robot held, and of how many lifts, if all these things are the paper's.
    pub paper: Option<[usize; 2]>,
}

/// Trials, all made in one way: all with the gate, or all without.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tallies {
    /// All of them.
    pub total: Tally,
    /// By group, in the order in which they first came.
    pub groups: Vec<Tally>,
    /// By thing, in the order in which they first came.
    pub things: Vec<Tally>,
    /// Lifts that held, and of how many, by what the wrench space of the grasp said: stable by the paper's label (epsilon
    /// greater than 0.07 and volume greater than 0.1). The others have no more than force closure (epsilon greater than
    /// 0), or not even that.
    pub held_by_closure: [[usize; 2]; 3],
    /// Attempts with a probe.
    pub n_probes: usize,
    /// Of these, attempts that were not lifted and left the object elsewhere in the hand.
    pub n_disturbed: usize,
    /// Attempts in which the hand tightened, and those in which it set the object down, while it lifted.
    pub n_tightened: usize,
    pub n_set_down: usize,
    /// Objects kept in an hour of the robot's time; putting an object back takes none.
    pub kept_per_hour: Option<f64>,
    /// Trials with an attempt.
    pub n_reached: usize,
    /// Trials that had no end: the run was stopped.
    pub n_unfinished: usize,
    /// The bounds of drops for new objects under the same policy; `None` without lifts, and for the paper's things, which are one
    /// object with several masses.
    pub promise: Option<Promise>,
}

/// The effect of the decision, trial by trial: the same trials with it, and with every settled grasp lifted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GateEffect {
    /// Trials that came to an end both ways.
    pub n_trials: usize,
    /// Dropped when every settled grasp was lifted.
    pub n_dropped_without: usize,
    /// Dropped with the gate.
    pub n_dropped_with: usize,
    /// Dropped without the gate, and with it held or not lifted.
    pub n_avoided: usize,
    /// Held without the gate and dropped with it: a good first grasp was held back, a later one was not good.
    pub n_caused: usize,
    /// Not lifted at all with the gate, though the first grasp would have held.
    pub n_needlessly_given_up: usize,
    /// Attempts with the gate for each attempt without.
    pub attempts_ratio: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ending {
    Held,
    Dropped,
    GivenUp,
}

/// A trial that came to an end.
pub(super) struct Trial<'a> {
    last: &'a TrialRecord,
    n_attempts: usize,
    ending: Ending,
}

impl Tallies {
    /// Counts the trials of a run; `is_finished` says that it was not stopped.
    pub fn new(records: &[TrialRecord], max_attempts: u32, is_finished: bool) -> Self {
        let (trials, n_unfinished) = trials(records, max_attempts, is_finished);
        let mut held_by_closure = [[0; 2]; 3];
        for trial in trials.values().filter(|trial| trial.ending != Ending::GivenUp) {
            // A hull that failed says nothing.
            let (Some(epsilon), Some(volume)) = (trial.last.epsilon, trial.last.volume) else { continue };
            let closure_idx = match (epsilon > STABLE_EPSILON && volume > STABLE_VOLUME, epsilon > 0.0) {
                (true, _) => 0,
                (false, true) => 1,
                (false, false) => 2,
            };
            let [n_held, n] = &mut held_by_closure[closure_idx];
            *n_held += usize::from(trial.ending == Ending::Held);
            *n += 1;
        }
        let total = tally("total", trials.values());
        let of_ended = records.iter().filter(|record| trials.contains_key(&record.trial));
        let unique: BTreeMap<u64, &TrialRecord> = of_ended.map(|record| (record.grasp_id, record)).collect();
        let robot_secs = records.iter().map(|record| record.end_secs).fold(0.0, f64::max);
        let things = by_name(&trials, |record| &record.thing);
        Tallies {
            promise: if total.paper.is_some() { None } else { promise_of(&things) },
            n_probes: unique.values().filter(|record| record.probed).count(),
            n_disturbed: unique.values().filter(|record| record.disturbed).count(),
            n_tightened: unique.values().filter(|record| record.tightened).count(),
            n_set_down: unique.values().filter(|record| record.set_down).count(),
            kept_per_hour: (robot_secs > 0.0).then(|| 3600.0 * total.n_held as f64 / robot_secs),
            total,
            groups: by_name(&trials, |record| &record.group),
            things,
            held_by_closure,
            n_reached: trials.len() + n_unfinished,
            n_unfinished,
        }
    }
}

/// The bounds of drops for objects like these things.
fn promise_of(things: &[Tally]) -> Option<Promise> {
    let trials = |thing: &Tally| {
        let share = |n: usize| n as f64 / thing.n_trials as f64;
        ObjectTrials { lifted: share(thing.n_lifts), dropped: share(thing.n_lifts - thing.n_held) }
    };
    promise(&things.iter().map(trials).collect::<Vec<_>>())
}

impl GateEffect {
    /// Compares trials of the same number; `is_finished` says that no run was stopped.
    pub fn new(with: &[TrialRecord], without: &[TrialRecord], max_attempts: u32, is_finished: bool) -> Self {
        let (with, _) = trials(with, max_attempts, is_finished);
        let (without, _) = trials(without, max_attempts, is_finished);
        let pairs: Vec<(&Trial<'_>, &Trial<'_>)> =
            with.iter().filter_map(|(number, trial)| Some((trial, without.get(number)?))).collect();
        let count = |is_counted: &dyn Fn(Ending, Ending) -> bool| {
            pairs.iter().filter(|(with, without)| is_counted(with.ending, without.ending)).count()
        };
        let attempts = |n: fn(&(&Trial<'_>, &Trial<'_>)) -> usize| pairs.iter().map(n).sum::<usize>() as f64;
        let (n_with, n_without) = (attempts(|pair| pair.0.n_attempts), attempts(|pair| pair.1.n_attempts));
        GateEffect {
            n_trials: pairs.len(),
            n_dropped_without: count(&|_, without| without == Ending::Dropped),
            n_dropped_with: count(&|with, _| with == Ending::Dropped),
            n_avoided: count(&|with, without| without == Ending::Dropped && with != Ending::Dropped),
            n_caused: count(&|with, without| without == Ending::Held && with == Ending::Dropped),
            n_needlessly_given_up: count(&|with, without| without == Ending::Held && with == Ending::GivenUp),
            attempts_ratio: (n_without > 0.0).then(|| n_with / n_without),
        }
    }
}

/// Trials that came to an end by their number, and how many did not. A trial without a lift ends with `max_attempts` attempts, or
/// with fewer if no approach leads to the object any more: then another trial follows, or the run is finished. A record that
/// comes twice counts once.
fn trials(records: &[TrialRecord], max_attempts: u32, is_finished: bool) -> (BTreeMap<u64, Trial<'_>>, usize) {
    let mut by_number: BTreeMap<u64, BTreeMap<u32, &TrialRecord>> = BTreeMap::new();
    for record in records {
        by_number.entry(record.trial).or_default().insert(record.attempt, record);
    }
    let n_begun = by_number.len();
    let last_number = by_number.last_key_value().map_or(0, |(number, _)| *number);
    let ended: BTreeMap<u64, Trial<'_>> = by_number
        .into_iter()
        .filter_map(|(number, attempts)| {
            let (&last_attempt, last) = attempts.last_key_value()?;
            let ending = match (last.lifted, last.held) {
                (true, true) => Ending::Held,
                (true, false) => Ending::Dropped,
                (false, _) if is_finished || number < last_number || last_attempt + 1 >= max_attempts => {
                    Ending::GivenUp
                }
                (false, _) => return None,
            };
            // Attempts are numbered without gaps.
            let n_attempts = last_attempt as usize + 1;
            Some((number, Trial { last, n_attempts, ending }))
        })
        .collect();
    let n_unfinished = n_begun - ended.len();
    (ended, n_unfinished)
}

/// A tally of each name, in the order of the trials.
fn by_name<'a>(trials: &BTreeMap<u64, Trial<'a>>, name: impl Fn(&'a TrialRecord) -> &'a String) -> Vec<Tally> {
    let mut names: Vec<&String> = Vec::new();
    for trial in trials.values() {
        let own = name(trial.last);
        if !names.contains(&own) {
            names.push(own);
        }
    }
    names.into_iter().map(|own| tally(own, trials.values().filter(|trial| name(trial.last) == own))).collect()
}

fn tally<'t, 'a: 't>(name: &str, trials: impl Iterator<Item = &'t Trial<'a>>) -> Tally {
    let trials: Vec<&Trial<'_>> = trials.collect();
    let count = |ending: Ending| trials.iter().filter(|trial| trial.ending == ending).count();
    let (n_held, n_given_up) = (count(Ending::Held), count(Ending::GivenUp));
    let n_lifts = trials.len() - n_given_up;
    let n_attempts = trials.iter().map(|trial| trial.n_attempts).sum();
    let per = |n: usize| (n > 0).then(|| n_attempts as f64 / n as f64);
    let masses = trials.iter().map(|trial| trial.last.mass_kg);
    let things: BTreeSet<&str> = trials.iter().map(|trial| trial.last.thing.as_str()).collect();
    let in_paper: Option<Vec<usize>> = things.iter().map(|thing| held_in_paper(thing)).collect();
    Tally {
        name: name.into(),
        mass_kg: [masses.clone().reduce(f64::min).unwrap_or(0.0), masses.reduce(f64::max).unwrap_or(0.0)],
        n_trials: trials.len(),
        n_attempts,
        n_lifts,
        n_held,
        n_given_up,
        success: (n_lifts > 0)
            .then(|| Estimate { value: n_held as f64 / n_lifts as f64, interval: wilson_interval(n_held, n_lifts) }),
        attempts_per_lift: per(n_lifts),
        attempts_per_held: per(n_held),
        paper: in_paper
            .filter(|held| !held.is_empty())
            .map(|held| [held.iter().sum(), held.len() * N_PAPER_TRIALS_EACH]),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Trials, each with its thing and what became of its attempts: `-` held back, `h` held, `d` dropped.
    pub(in crate::trials) fn records(trials: &[(&str, &str, f64, &str)]) -> Vec<TrialRecord> {
        let mut records = Vec::new();
        for (number, (thing, group, mass_kg, attempts)) in trials.iter().enumerate() {
            for (attempt, what) in attempts.chars().enumerate() {
                records.push(TrialRecord {
                    trial: number as u64,
                    attempt: attempt as u32,
                    grasp_id: records.len() as u64,
                    thing: (*thing).into(),
                    group: (*group).into(),
                    mass_kg: *mass_kg,
                    friction: 1.0,
                    lifted: what != '-',
                    held: what == 'h',
                    epsilon: Some(if what == 'h' { 0.1 } else { -0.1 }),
                    volume: Some(0.2),
                    ..TrialRecord::default()
                });
            }
        }
        records
    }

    #[test]
    fn trials_attempts_lifts_and_holds_are_counted() {
        let records = records(&[
            ("mug, 0.43 kg", "mug", 0.43, "h"),
            ("mug, 0.93 kg", "mug", 0.93, "--d"),
            ("decorative rock", "rock", 0.28, "---"),
            // No approach led to it any more.
            ("lemon", "lemon", 0.06, "--"),
            ("decorative rock", "rock", 0.28, "-h"),
            // The run was stopped here.
            ("mug, 0.43 kg", "mug", 0.43, "-"),
        ]);
        let found = Tallies::new(&records, 3, false);
        let Tally { n_trials, n_attempts, n_lifts, n_held, n_given_up, .. } = found.total;
        assert_eq!([n_trials, n_attempts, n_lifts, n_held, n_given_up], [5, 11, 3, 2, 2]);
        assert_eq!(found.total.attempts_per_lift, Some(11.0 / 3.0));
        assert_eq!(found.total.attempts_per_held, Some(5.5));
        assert_eq!((found.n_reached, found.n_unfinished), (6, 1));
        let finished = Tallies::new(&records, 3, true);
        assert_eq!((finished.total.n_given_up, finished.n_reached, finished.n_unfinished), (3, 6, 0));
        assert_eq!(found.held_by_closure, [[2, 2], [0, 0], [0, 1]]);
        let closed = records.iter().map(|record| TrialRecord { epsilon: Some(0.07), ..record.clone() });
        let closed = Tallies::new(&closed.collect::<Vec<_>>(), 3, false);
        assert_eq!(closed.held_by_closure, [[0, 0], [2, 3], [0, 0]], "the paper asks for more than 0.07");
        let without_hull = records.iter().map(|record| TrialRecord { epsilon: None, ..record.clone() });
        let without_hull = Tallies::new(&without_hull.collect::<Vec<_>>(), 3, false);
        assert_eq!(without_hull.held_by_closure, [[0, 0]; 3], "a failed hull is no verdict");
        let mug = &found.groups[0];
        assert_eq!((mug.name.as_str(), mug.mass_kg, mug.paper), ("mug", [0.43, 0.93], Some([20, 20])));
        let success = mug.success.expect("lifts");
        assert_eq!(success.value, 0.5);
        // Wilson's interval of one in two, by hand: (0.5 + 1.9208) / (1 + 1.9207) ∓ ...
        let interval = success.interval.expect("lifts");
        assert!((interval.low - 0.0945).abs() < 1e-3 && (interval.high - 0.9055).abs() < 1e-3, "{interval:?}");
        assert_eq!(found.groups.iter().map(|tally| tally.name.as_str()).collect::<Vec<_>>(), ["mug", "rock", "lemon"]);
        assert_eq!(found.things.len(), 4);
    }

    #[test]
    fn nothing_is_nothing() {
        let found = Tallies::new(&[], 20, true);
        assert_eq!((found.total.n_trials, found.total.success, found.total.paper), (0, None, None));
        assert_eq!(GateEffect::new(&[], &[], 20, true).attempts_ratio, None);
    }

    #[test]
    fn a_record_that_comes_again_counts_once() {
        let mut twice = records(&[("box-02", "box", 0.1, "-h")]);
        twice.extend_from_within(..);
        let found = Tallies::new(&twice, 20, true);
        assert_eq!((found.total.n_trials, found.total.n_attempts, found.total.paper), (1, 2, None));
    }

    #[test]
    fn the_gates_effect_is_of_the_same_trials_both_ways() {
        let made = |attempts: [&'static str; 6]| {
            records(&attempts.map(|attempts| ("decorative rock", "rock", 0.28, attempts)))
        };
        // Avoided by another grasp, avoided by none, not avoided, caused, given up for nothing, fine; the last one was
        // stopped before it ended.
        let with = made(["--h", "----", "-d", "-d", "----", "-"]);
        let without = made(["d", "d", "d", "h", "h", "h"]);
        let found = GateEffect::new(&with, &without, 4, false);
        assert_eq!(
            found,
            GateEffect {
                n_trials: 5,
                n_dropped_without: 3,
                n_dropped_with: 2,
                n_avoided: 2,
                n_caused: 1,
                n_needlessly_given_up: 1,
                attempts_ratio: Some(3.0),
            }
        );
    }
}
