//! The effect of advice: the same trials with attempts that follow advice, and with all attempts at random.
//!
//! The first attempt of a trial is the same both ways. So are, then, the trials in which the second one follows advice one
//! way and comes from anywhere the other: these pairs say what advice is worth, whatever came before. The other counts
//! say what it comes to.

use serde::Serialize;

use crate::trials::tables::{Table, part_of_whole};
use crate::trials::tally::{Tallies, TrialRecord, trials};

/// The effect of advice, over trials that came to an end both ways.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegraspEffect {
    /// Trials that came to an end both ways.
    pub n_trials: usize,
    /// Totals with attempts that follow advice.
    pub advised: Totals,
    /// Totals with all attempts at random.
    pub at_random: Totals,
    /// Attempts for each held lift with advice, for each without it; `None` if nothing was held one way.
    pub attempts_per_held_ratio: Option<f64>,
    /// Second attempts that followed advice, in trials where the other way has a second attempt as well.
    pub second_advised: NextAttempts,
    /// Second attempts of the same trials at random.
    pub second_at_random: NextAttempts,
    /// All attempts that followed advice.
    pub next_advised: NextAttempts,
    /// All attempts but the first of the trials at random.
    pub next_at_random: NextAttempts,
}

/// Totals of trials.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Totals {
    /// Attempts.
    pub n_attempts: usize,
    /// Trials that ended in a lift that held.
    pub n_held: usize,
    /// Trials that ended in a drop.
    pub n_dropped: usize,
    /// Trials in which nothing was lifted.
    pub n_given_up: usize,
    /// Attempts for each lift that held.
    pub attempts_per_held: Option<f64>,
}

/// Counts of attempts that are not the first of their trial.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct NextAttempts {
    pub n: usize,
    /// Of these, lifted.
    pub n_lifted: usize,
    /// Of these, lifted and held.
    pub n_held: usize,
}

impl RegraspEffect {
    /// Compares trials of the same number. A trial without a lift has come to its end if it has `max_attempts` attempts.
    pub fn new(advised: &[TrialRecord], at_random: &[TrialRecord], max_attempts: u32) -> Self {
        let ended = [advised, at_random].map(|records| trials(records, max_attempts).0);
        let of_both = |records: &[TrialRecord]| -> Vec<TrialRecord> {
            let is_of_both = |record: &&TrialRecord| ended.iter().all(|trials| trials.contains_key(&record.trial));
            records.iter().filter(is_of_both).cloned().collect()
        };
        let (advised, at_random) = (of_both(advised), of_both(at_random));
        let mut effect = RegraspEffect {
            n_trials: ended[0].keys().filter(|trial| ended[1].contains_key(trial)).count(),
            advised: Totals::new(&advised, max_attempts),
            at_random: Totals::new(&at_random, max_attempts),
            attempts_per_held_ratio: None,
            second_advised: NextAttempts::default(),
            second_at_random: NextAttempts::default(),
            next_advised: advised.iter().filter(|record| record.advised).collect(),
            next_at_random: at_random.iter().filter(|record| record.attempt > 0).collect(),
        };
        effect.attempts_per_held_ratio = effect
            .advised
            .attempts_per_held
            .zip(effect.at_random.attempts_per_held)
            .map(|(with, without)| with / without);
        let second = |records: &[TrialRecord], trial: u64| {
            records.iter().find(|record| record.trial == trial && record.attempt == 1).cloned()
        };
        for record in advised.iter().filter(|record| record.advised && record.attempt == 1) {
            if let Some(other) = second(&at_random, record.trial) {
                effect.second_advised.add(record);
                effect.second_at_random.add(&other);
            }
        }
        effect
    }
}

impl RegraspEffect {
    /// The counts, with advice and at random.
    pub fn table(&self) -> Table {
        let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.2}"));
        let of_both = |of: &dyn Fn(&Totals) -> String| [of(&self.advised), of(&self.at_random)];
        let trials = |of: fn(&Totals) -> usize| of_both(&|totals| format!("{} of {}", of(totals), self.n_trials));
        let next = |of: fn(&NextAttempts) -> usize, both: [&NextAttempts; 2]| {
            both.map(|next| if next.n == 0 { "-".into() } else { part_of_whole([of(next), next.n]) })
        };
        let second = [&self.second_advised, &self.second_at_random];
        let all = [&self.next_advised, &self.next_at_random];
        let rows = [
            ("trials that kept the object", trials(|totals| totals.n_held)),
            ("trials that dropped", trials(|totals| totals.n_dropped)),
            ("trials given up", trials(|totals| totals.n_given_up)),
            ("attempts", of_both(&|totals| totals.n_attempts.to_string())),
            ("attempts per kept object", of_both(&|totals| number(totals.attempts_per_held))),
            ("attempts per kept object, for each at random", [number(self.attempts_per_held_ratio), String::new()]),
            ("second attempts of the same trials lifted", next(|next| next.n_lifted, second)),
            ("second attempts of the same trials that kept it", next(|next| next.n_held, second)),
            ("all next attempts lifted", next(|next| next.n_lifted, all)),
            ("all next attempts that kept it", next(|next| next.n_held, all)),
        ];
        Table {
            title: "What advice changed, in the same trials".into(),
            head: vec![String::new(), "advised".into(), "at random".into()],
            rows: rows.into_iter().map(|(name, [with, without])| vec![name.into(), with, without]).collect(),
        }
    }
}

impl Totals {
    fn new(records: &[TrialRecord], max_attempts: u32) -> Self {
        let total = Tallies::new(records, max_attempts).total;
        Totals {
            n_attempts: total.n_attempts,
            n_held: total.n_held,
            n_dropped: total.n_lifts - total.n_held,
            n_given_up: total.n_given_up,
            attempts_per_held: total.attempts_per_held,
        }
    }
}

impl NextAttempts {
    fn add(&mut self, record: &TrialRecord) {
        self.n += 1;
        self.n_lifted += usize::from(record.lifted);
        self.n_held += usize::from(record.held);
    }
}

impl<'a> FromIterator<&'a TrialRecord> for NextAttempts {
    fn from_iter<I: IntoIterator<Item = &'a TrialRecord>>(records: I) -> Self {
        let mut counted = NextAttempts::default();
        records.into_iter().for_each(|record| counted.add(record));
        counted
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trials::tally::tests::records;

    #[test]
    fn the_same_trials_with_advice_and_without_are_compared() {
        let made = |attempts: [&'static str; 5]| {
            records(&attempts.map(|attempts| ("decorative rock", "rock", 0.28, attempts)))
        };
        // `A` and `a`: an advised attempt that held or was dropped, `+` one that was held back.
        let advised = made(["-A", "-a", "-+A", "h", "--"]);
        let at_random = made(["--h", "-h", "---d", "h", "-"]);
        let found = RegraspEffect::new(&advised, &at_random, 4);
        assert_eq!(found.n_trials, 4, "the last trials have no end");
        assert_eq!((found.advised.n_attempts, found.advised.n_held, found.advised.n_dropped), (8, 3, 1));
        assert_eq!((found.at_random.n_attempts, found.at_random.n_held, found.at_random.n_dropped), (10, 3, 1));
        assert!((found.attempts_per_held_ratio.expect("held") - 0.8).abs() < 1e-12);
        assert_eq!(found.next_advised, NextAttempts { n: 4, n_lifted: 3, n_held: 2 });
        assert_eq!(found.next_at_random, NextAttempts { n: 6, n_lifted: 3, n_held: 2 });
        assert_eq!(found.second_advised, NextAttempts { n: 3, n_lifted: 2, n_held: 1 });
        assert_eq!(found.second_at_random, NextAttempts { n: 3, n_lifted: 1, n_held: 1 });
        assert_eq!(RegraspEffect::new(&[], &[], 4).attempts_per_held_ratio, None);
    }
}
