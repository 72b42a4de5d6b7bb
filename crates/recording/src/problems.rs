//! Finds oddities in a recording's samples, each of which is whole.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::Serialize;

use blindgrasp_messages::{Header, Record, Recorded, TactileFrame};

/// The most gaps that are remembered per topic and epoch, to recognise numbers that come late.
const MAX_GAPS: usize = 4096;

/// Looks for oddities, sample by sample, in the recording's order.
///
/// Numbers and times are compared within a topic and an epoch of its source. A recording may begin anywhere.
#[derive(Debug, Clone, Default)]
pub struct Problems {
    topics: BTreeMap<String, Topic>,
    has_tactile: bool,
}

/// An oddity of a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Problem {
    pub oddity: Oddity,
    pub topic: String,
    /// How many samples it concerns.
    pub n_samples: u64,
    /// The number of the first of these samples.
    pub first_seq: u64,
    /// The epoch of the first of these samples.
    pub epoch: u64,
}

/// The kinds of oddities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Oddity {
    /// Numbers are left out.
    MissingNumbers,
    /// Numbers come again.
    RepeatedNumbers,
    /// Numbers come behind greater ones.
    NumbersGoBack,
    /// Times come behind later ones.
    StampsGoBack,
    /// An epoch goes on after another came.
    EpochComesBack,
    /// There are no tactile frames, from which all other topics are made.
    NoTactileFrames,
}

#[derive(Debug, Clone, Default)]
struct Topic {
    n_samples: u64,
    first_seq: u64,
    /// The epoch of the last sample.
    epoch: Option<u64>,
    epochs: BTreeMap<u64, Epoch>,
    found: BTreeMap<Oddity, Problem>,
}

#[derive(Debug, Clone)]
struct Epoch {
    first_seq: u64,
    greatest_seq: u64,
    last_stamp_nanos: u64,
    /// Numbers left out so far: the first of each gap, and the last.
    gaps: BTreeMap<u64, u64>,
}

impl Problems {
    pub fn add(&mut self, topic: &str, record: &Record) {
        self.has_tactile |= matches!(record, Record::Tactile(_));
        let header = record.header();
        if !self.topics.contains_key(topic) {
            self.topics.insert(topic.into(), Topic { first_seq: header.seq, ..Topic::default() });
        }
        if let Some(known) = self.topics.get_mut(topic) {
            known.add(topic, header);
        }
    }

    /// The oddities so far, topic by topic.
    pub fn found(&self) -> Vec<Problem> {
        let mut problems = Vec::new();
        if !self.has_tactile && !self.topics.is_empty() {
            let n_samples = self.topics.values().map(|topic| topic.n_samples).sum();
            let first = self.topics.values().next();
            problems.push(Problem {
                oddity: Oddity::NoTactileFrames,
                topic: TactileFrame::TOPIC.into(),
                n_samples,
                first_seq: first.map_or(0, |topic| topic.first_seq),
                epoch: first.and_then(|topic| topic.epochs.keys().next().copied()).unwrap_or(0),
            });
        }
        for (name, topic) in &self.topics {
            problems.extend(topic.missing(name));
            problems.extend(topic.found.values().cloned());
        }
        problems
    }
}

impl Topic {
    fn add(&mut self, topic: &str, &Header { epoch, seq, stamp_nanos, .. }: &Header) {
        self.n_samples += 1;
        if self.epoch.is_some_and(|last| last != epoch) && self.epochs.contains_key(&epoch) {
            self.note(Oddity::EpochComesBack, topic, epoch, seq);
        }
        self.epoch = Some(epoch);
        let Some(known) = self.epochs.get_mut(&epoch) else {
            let gaps = BTreeMap::new();
            let new = Epoch { first_seq: seq, greatest_seq: seq, last_stamp_nanos: stamp_nanos, gaps };
            self.epochs.insert(epoch, new);
            return;
        };
        let mut odd = BTreeSet::new();
        if stamp_nanos < known.last_stamp_nanos {
            odd.insert(Oddity::StampsGoBack);
        }
        known.last_stamp_nanos = stamp_nanos;
        if seq > known.greatest_seq {
            let next = known.greatest_seq + 1;
            if seq > next && known.gaps.len() < MAX_GAPS {
                known.gaps.insert(next, seq - 1);
            } else if seq > next {
                // There are too many gaps to remember: the last one grows instead.
                if let Some(mut last) = known.gaps.last_entry() {
                    *last.get_mut() = last.get().saturating_add(seq - next);
                }
            }
            known.greatest_seq = seq;
        } else if known.fill(seq) {
            odd.insert(Oddity::NumbersGoBack);
        } else {
            // A number before the recording's first was not there before either.
            let is_again = seq == known.greatest_seq || seq >= known.first_seq;
            odd.insert(if is_again { Oddity::RepeatedNumbers } else { Oddity::NumbersGoBack });
        }
        for oddity in odd {
            self.note(oddity, topic, epoch, seq);
        }
    }

    fn note(&mut self, oddity: Oddity, topic: &str, epoch: u64, first_seq: u64) {
        let problem = Problem { oddity, topic: topic.into(), n_samples: 0, first_seq, epoch };
        self.found.entry(oddity).or_insert(problem).n_samples += 1;
    }

    fn missing(&self, topic: &str) -> Option<Problem> {
        let gaps = || self.epochs.iter().flat_map(|(epoch, found)| found.gaps.iter().map(move |gap| (epoch, gap)));
        let (epoch, (first, _)) = gaps().next()?;
        let n_samples =
            gaps().fold(0_u64, |sum, (_, (first, last))| sum.saturating_add(last - first).saturating_add(1));
        let oddity = Oddity::MissingNumbers;
        Some(Problem { oddity, topic: topic.into(), n_samples, first_seq: *first, epoch: *epoch })
    }
}

impl Epoch {
    /// Whether this number was missing until now.
    fn fill(&mut self, seq: u64) -> bool {
        let Some((first, last)) = self.gaps.range(..=seq).next_back().map(|(first, last)| (*first, *last)) else {
            return false;
        };
        if seq > last {
            return false;
        }
        self.gaps.remove(&first);
        if first < seq {
            self.gaps.insert(first, seq - 1);
        }
        if seq < last {
            self.gaps.insert(seq + 1, last);
        }
        true
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Problem { oddity, topic, n_samples, first_seq, epoch } = self;
        let at = format!("the first is {first_seq} of epoch {epoch}");
        match oddity {
            Oddity::MissingNumbers => write!(formatter, "{topic}: {n_samples} numbers are missing; {at}"),
            Oddity::RepeatedNumbers => write!(formatter, "{topic}: {n_samples} samples repeat a number; {at}"),
            Oddity::NumbersGoBack => write!(formatter, "{topic}: {n_samples} samples come behind later ones; {at}"),
            Oddity::StampsGoBack => {
                write!(formatter, "{topic}: {n_samples} samples are stamped earlier than the one before; {at}")
            }
            Oddity::EpochComesBack => write!(
                formatter,
                "{topic}: {n_samples} times an epoch goes on after another came (two recordings interleaved?); {at}"
            ),
            Oddity::NoTactileFrames => {
                write!(formatter, "{topic}: there are no tactile frames, from which the other topics are made")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{Prediction, Stamped};

    fn found(samples: &[(u64, u64, u64)]) -> Vec<(Oddity, u64, u64, u64)> {
        let mut problems = Problems::default();
        for (epoch, seq, stamp_nanos) in samples {
            let header = Header { epoch: *epoch, seq: *seq, stamp_nanos: *stamp_nanos, ..Header::default() };
            let record = Record::Tactile(Stamped { header, message: TactileFrame::default() });
            problems.add("/tactile", &record);
        }
        let found = problems.found();
        assert!(found.iter().all(|problem| problem.topic == "/tactile" && problem.to_string().contains("/tactile")));
        found.iter().map(|problem| (problem.oddity, problem.n_samples, problem.first_seq, problem.epoch)).collect()
    }

    #[test]
    fn samples_in_order_are_not_odd() {
        assert_eq!(found(&[]), []);
        // From the middle of a run, with equal times, into another epoch whose clock begins anew.
        assert_eq!(found(&[(1, 40, 9), (1, 41, 9), (2, 0, 3), (2, 1, 4), (3, 7, 0)]), []);
    }

    #[test]
    fn each_oddity_is_found_where_it_is() {
        use Oddity::{EpochComesBack, MissingNumbers, NumbersGoBack, RepeatedNumbers, StampsGoBack};
        assert_eq!(found(&[(1, 0, 0), (1, 3, 1), (1, 4, 2), (1, 6, 3)]), [(MissingNumbers, 3, 1, 1)]);
        assert_eq!(found(&[(1, 0, 0), (1, 1, 1), (1, 1, 1), (1, 2, 2)]), [(RepeatedNumbers, 1, 1, 1)]);
        // Out of order is neither missing nor repeated.
        assert_eq!(found(&[(1, 0, 0), (1, 2, 0), (1, 1, 0), (1, 3, 0)]), [(NumbersGoBack, 1, 1, 1)]);
        assert_eq!(found(&[(1, 5, 0), (1, 4, 0), (1, 6, 0)]), [(NumbersGoBack, 1, 4, 1)]);
        assert_eq!(found(&[(1, 0, 5), (1, 1, 4), (1, 2, 6)]), [(StampsGoBack, 1, 1, 1)]);
        assert_eq!(found(&[(1, 0, 0), (2, 0, 1), (1, 1, 2), (2, 1, 3)]), [(EpochComesBack, 2, 1, 1)]);
        // The same recording twice.
        let twice = found(&[(1, 0, 0), (1, 1, 1), (1, 0, 0), (1, 1, 1)]);
        assert_eq!(twice, [(RepeatedNumbers, 2, 0, 1), (StampsGoBack, 1, 0, 1)]);
    }

    #[test]
    fn gaps_are_filled_from_both_ends_and_within() {
        let samples = [(1, 0, 0), (1, 9, 0), (1, 5, 0), (1, 1, 0), (1, 8, 0)];
        // 2, 3, 4, 6 and 7 stay missing.
        assert_eq!(found(&samples), [(Oddity::MissingNumbers, 5, 2, 1), (Oddity::NumbersGoBack, 3, 5, 1)]);
    }

    #[test]
    fn so_many_gaps_are_still_counted() {
        let samples: Vec<_> = (0..2 * MAX_GAPS as u64).map(|idx| (1, 2 * idx, 0)).collect();
        assert_eq!(found(&samples), [(Oddity::MissingNumbers, 2 * MAX_GAPS as u64 - 1, 1, 1)]);
    }

    #[test]
    fn frames_are_missed_where_something_was_made_of_them() {
        let mut problems = Problems::default();
        let header = Header::default();
        problems.add("/prediction", &Record::Prediction(Stamped { header, message: Prediction::default() }));
        let found = problems.found();
        assert_eq!((found.len(), found[0].oddity), (1, Oddity::NoTactileFrames));
    }
}
