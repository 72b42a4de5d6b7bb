//! Whether a replacement says what the running operator says, sample by sample.
//!
//! Pure: samples and times come from whoever reads both streams. It compares what the two say, not who is right.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::str::FromStr;

use serde::Serialize;

use blindgrasp_messages::{Action, Fault, Reason};
use blindgrasp_recording::Record;

/// What came this shortly before the end may still be under way on the other side.
const IN_FLIGHT_NANOS: u64 = 1_000_000_000;
/// Of the samples that the replacement had time for, it must have answered this share: what it says of fewer is a selection,
/// from which nothing follows about the others. Not all of them, since a reader beside the graph may itself drop some.
const MIN_ANSWERED_SHARE: f64 = 0.9;

/// Who said it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The running operator.
    Active,
    /// Its replacement.
    Shadow,
}

/// What both sides have said at one output.
#[derive(Debug, Default)]
pub struct Agreement {
    /// What one side has said and the other hasn't.
    alone: HashMap<Place, (Side, Sample)>,
    paired: HashSet<Place>,
    n_agreeing: u64,
    first_pair_nanos: Option<u64>,
    disagreements: BTreeMap<u64, Disagreement>,
    active_latencies_nanos: Vec<u64>,
    shadow_latencies_nanos: Vec<u64>,
}

/// How far both sides agree at one output.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AgreementReport {
    /// `node/port`.
    pub output: String,
    /// Samples that both have answered.
    pub n_pairs: u64,
    /// Of the pairs, the share in which both say the same; unknown without pairs.
    pub agreement: Option<f64>,
    /// Samples that only the running operator answered.
    pub n_only_active: u64,
    /// Samples that only the replacement answered.
    pub n_only_shadow: u64,
    /// Those of `n_only_active` that the replacement had time for: not before its first answer, not in the last second.
    pub n_unanswered: u64,
    /// The grasps in which they disagree.
    pub disagreements: Vec<Disagreement>,
    /// From the source's publishing of a sample to the running operator's answer, as a reader beside the graph sees it.
    pub active_latency: Option<Latency>,
    /// The same of the replacement.
    pub shadow_latency: Option<Latency>,
}

/// A grasp in which the two sides disagree.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Disagreement {
    /// Which grasp.
    pub grasp_id: u64,
    /// In how many of its samples.
    pub n_samples: u64,
    /// What the running operator said first that the other did not.
    pub active: Saying,
    /// What the replacement said instead.
    pub shadow: Saying,
}

/// What somebody said, for a person.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Saying {
    /// In words.
    pub says: String,
    /// With which probability that the grasp is stable.
    pub probability_stable: Option<f64>,
}

/// Quantiles of a latency, by nearest rank.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Latency {
    /// Half are shorter.
    pub p50_micros: f64,
    /// All but one in a hundred are shorter.
    pub p99_micros: f64,
}

/// When a replacement may take over, such as `agreement>=0.99`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Condition {
    measure: Measure,
    comparison: Comparison,
    limit: f64,
}

/// What a condition is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Measure {
    Agreement,
    Disagreements,
    LatencyP99Micros,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Comparison {
    AtLeast,
    MoreThan,
    AtMost,
    LessThan,
}

/// Which sample: the source's generation, and the sequence number or, for decisions, the grasp.
type Place = (u64, u64);

#[derive(Debug)]
struct Sample {
    grasp_id: u64,
    said: Said,
    received_nanos: u64,
}

#[derive(Debug)]
enum Said {
    Prediction {
        stable: bool,
        unsure: bool,
        fault: Fault,
        probability_stable: f64,
    },
    Decision {
        action: Action,
        reason: Reason,
        probability_stable: f64,
    },
    /// A hash of everything, since the samples of a side that is alone pile up.
    Other {
        content: u64,
    },
}

impl Agreement {
    /// Takes what a side said, and when it was received (CLOCK_MONOTONIC). What it says again does not count.
    pub fn add(&mut self, side: Side, record: &Record, received_nanos: u64) {
        let header = record.header();
        let (place, sample) = sample_of(record, received_nanos);
        if self.paired.contains(&place) {
            return;
        }
        let other = match self.alone.get(&place) {
            Some((earlier, _)) if *earlier == side => return,
            Some(_) => self.alone.remove(&place),
            None => None,
        };
        if header.origin_nanos != 0 {
            let latencies = match side {
                Side::Active => &mut self.active_latencies_nanos,
                Side::Shadow => &mut self.shadow_latencies_nanos,
            };
            latencies.push(received_nanos.saturating_sub(header.origin_nanos));
        }
        match (side, other) {
            (_, None) => {
                self.alone.insert(place, (side, sample));
            }
            (Side::Active, Some((_, shadow))) => self.add_pair(place, &sample, &shadow),
            (Side::Shadow, Some((_, active))) => self.add_pair(place, &active, &sample),
        }
    }

    /// How far they agree, seen at the end of the comparison (CLOCK_MONOTONIC).
    pub fn report(self, output: String, end_nanos: u64) -> AgreementReport {
        let n_pairs = self.paired.len() as u64;
        let count = |wanted: Side| self.alone.values().filter(|(side, _)| *side == wanted).count() as u64;
        let had_time = |sample: &Sample| {
            self.first_pair_nanos.is_some_and(|first| sample.received_nanos >= first)
                && sample.received_nanos < end_nanos.saturating_sub(IN_FLIGHT_NANOS)
        };
        let unanswered = self.alone.values().filter(|(side, sample)| *side == Side::Active && had_time(sample));
        AgreementReport {
            output,
            n_pairs,
            agreement: (n_pairs > 0).then(|| self.n_agreeing as f64 / n_pairs as f64),
            n_only_active: count(Side::Active),
            n_only_shadow: count(Side::Shadow),
            n_unanswered: unanswered.count() as u64,
            disagreements: self.disagreements.into_values().collect(),
            active_latency: latency(self.active_latencies_nanos),
            shadow_latency: latency(self.shadow_latencies_nanos),
        }
    }

    fn add_pair(&mut self, place: Place, active: &Sample, shadow: &Sample) {
        self.paired.insert(place);
        let first = self.first_pair_nanos.get_or_insert(active.received_nanos);
        *first = (*first).min(active.received_nanos);
        if active.said.agrees_with(&shadow.said) {
            self.n_agreeing += 1;
            return;
        }
        let disagreement = self.disagreements.entry(active.grasp_id).or_insert_with(|| Disagreement {
            grasp_id: active.grasp_id,
            n_samples: 0,
            active: active.said.saying("the one"),
            shadow: shadow.said.saying("another"),
        });
        disagreement.n_samples += 1;
    }
}

/// Why a replacement may not take over: the conditions that do not hold, in words; none if all hold at every output.
pub fn objections(reports: &[AgreementReport], conditions: &[Condition]) -> Vec<String> {
    if reports.is_empty() {
        return vec!["there is no output to compare".into()];
    }
    let mut objections = Vec::new();
    for report in reports {
        let output = &report.output;
        let n_with_time = report.n_pairs + report.n_unanswered;
        if report.n_pairs == 0 {
            objections.push(format!("{output}: no sample was answered by both, so whether they agree is unknown"));
            continue;
        }
        if (report.n_pairs as f64) < MIN_ANSWERED_SHARE * n_with_time as f64 {
            objections.push(format!(
                "{output}: the replacement answered only {} of {n_with_time} samples that it had time for",
                report.n_pairs
            ));
        }
        for condition in conditions {
            match condition.measure.of(report) {
                Some(value) if condition.comparison.holds(value, condition.limit) => {}
                Some(value) => {
                    objections.push(format!("{output}: {condition} does not hold, {} is {value}", condition.measure))
                }
                None => {
                    objections.push(format!("{output}: {condition} does not hold, {} is unknown", condition.measure))
                }
            }
        }
    }
    objections
}

impl Said {
    fn agrees_with(&self, other: &Said) -> bool {
        match (self, other) {
            (
                Said::Prediction { stable, unsure, fault, .. },
                Said::Prediction { stable: other_stable, unsure: other_unsure, fault: other_fault, .. },
            ) => (stable, unsure, fault) == (other_stable, other_unsure, other_fault),
            (
                Said::Decision { action, reason, .. },
                Said::Decision { action: other_action, reason: other_reason, .. },
            ) => (action, reason) == (other_action, other_reason),
            (Said::Other { content }, Said::Other { content: other_content }) => content == other_content,
            _ => false,
        }
    }

    /// In words; a content has none, so it is given some.
    fn saying(&self, content: &str) -> Saying {
        let (says, probability_stable) = match *self {
            Said::Prediction { fault, probability_stable, .. } if fault != Fault::None => {
                (format!("fault {}", fault.word()), Some(probability_stable))
            }
            Said::Prediction { stable, unsure, probability_stable, .. } => {
                let word = match (stable, unsure) {
                    (true, false) => "stable",
                    (true, true) => "stable and unsure",
                    (false, true) => "unsure",
                    (false, false) => "unstable",
                };
                (word.into(), Some(probability_stable))
            }
            Said::Decision { action, reason, probability_stable } => {
                (format!("{} {}", action.shown(), reason.word()), Some(probability_stable))
            }
            Said::Other { .. } => (format!("{content} content"), None),
        };
        Saying { says, probability_stable }
    }
}

fn sample_of(record: &Record, received_nanos: u64) -> (Place, Sample) {
    let header = record.header();
    let by_seq = (header.epoch, header.seq);
    let (place, grasp_id, said) = match record {
        Record::Prediction(sample) => {
            let message = &sample.message;
            let said = Said::Prediction {
                stable: message.stable,
                unsure: message.unsure,
                fault: message.fault,
                probability_stable: message.probability_stable,
            };
            (by_seq, message.grasp_id, said)
        }
        Record::Decision(sample) => {
            let message = &sample.message;
            let said = Said::Decision {
                action: message.action,
                reason: message.reason,
                probability_stable: message.probability_stable,
            };
            // By grasp: one may decide it a sample earlier than the other.
            ((header.epoch, message.grasp_id), message.grasp_id, said)
        }
        Record::Tactile(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
        Record::Contacts(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
        Record::Histogram(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
        Record::Truth(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
        Record::Outcome(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
        // By grasp, as a decision.
        Record::Advice(sample) => {
            ((header.epoch, sample.message.grasp_id), sample.message.grasp_id, content(&sample.message))
        }
        Record::Scene(sample) => (by_seq, sample.message.grasp_id, content(&sample.message)),
    };
    (place, Sample { grasp_id, said, received_nanos })
}

/// Written out, a NaN is what another NaN is.
fn content(message: &impl fmt::Debug) -> Said {
    let mut hasher = DefaultHasher::new();
    format!("{message:?}").hash(&mut hasher);
    Said::Other { content: hasher.finish() }
}

fn latency(mut nanos: Vec<u64>) -> Option<Latency> {
    nanos.sort_unstable();
    let at = |percent: usize| {
        let rank = (percent * nanos.len()).div_ceil(100);
        Some(*nanos.get(rank.checked_sub(1)?)? as f64 / 1e3)
    };
    Some(Latency { p50_micros: at(50)?, p99_micros: at(99)? })
}

impl Measure {
    const ALL: [Measure; 3] = [Measure::Agreement, Measure::Disagreements, Measure::LatencyP99Micros];

    fn of(self, report: &AgreementReport) -> Option<f64> {
        match self {
            Measure::Agreement => report.agreement,
            Measure::Disagreements => Some(report.disagreements.len() as f64),
            Measure::LatencyP99Micros => report.shadow_latency.map(|latency| latency.p99_micros),
        }
    }
}

impl fmt::Display for Measure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Measure::Agreement => "agreement",
            Measure::Disagreements => "disagreements",
            Measure::LatencyP99Micros => "latency_p99_us",
        })
    }
}

impl Comparison {
    /// The longer signs first: `>=` begins with `>`.
    const ALL: [Comparison; 4] = [Comparison::AtLeast, Comparison::AtMost, Comparison::MoreThan, Comparison::LessThan];

    fn holds(self, value: f64, limit: f64) -> bool {
        match self {
            Comparison::AtLeast => value >= limit,
            Comparison::MoreThan => value > limit,
            Comparison::AtMost => value <= limit,
            Comparison::LessThan => value < limit,
        }
    }

    fn sign(self) -> &'static str {
        match self {
            Comparison::AtLeast => ">=",
            Comparison::MoreThan => ">",
            Comparison::AtMost => "<=",
            Comparison::LessThan => "<",
        }
    }
}

impl FromStr for Condition {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut parts = Comparison::ALL.iter().filter_map(|comparison| {
            let (measure, limit) = text.split_once(comparison.sign())?;
            Some((measure.trim(), *comparison, limit.trim()))
        });
        let (name, comparison, limit) = parts.next().ok_or(
            "expected agreement, disagreements or latency_p99_us, then >=, >, <= or <, and a number; as agreement>=0.99",
        )?;
        let measure = Measure::ALL
            .into_iter()
            .find(|measure| measure.to_string() == name)
            .ok_or_else(|| format!("'{name}' is not measured; expected agreement, disagreements or latency_p99_us"))?;
        let limit = limit.parse().ok().filter(|limit: &f64| limit.is_finite() && *limit >= 0.0);
        let limit = limit.ok_or("expected a number, at least 0, on the right")?;
        if measure == Measure::Agreement && limit > 1.0 {
            return Err("agreement is a share: expected 0 to 1".into());
        }
        Ok(Condition { measure, comparison, limit })
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}{}", self.measure, self.comparison.sign(), self.limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{GraspFeature, Header, LiftDecision, Prediction, Stamped};

    /// 3 µs after the source.
    fn header(seq: u64) -> Header {
        Header { seq, epoch: 1, origin_nanos: 1000 * seq + 1, ..Header::default() }
    }

    fn prediction(seq: u64, grasp_id: u64, stable: bool, unsure: bool, probability_stable: f64) -> Record {
        let message = Prediction { grasp_id, stable, unsure, probability_stable, ..Prediction::default() };
        Record::Prediction(Stamped { header: header(seq), message })
    }

    fn decision(seq: u64, grasp_id: u64, action: Action, reason: Reason) -> Record {
        let message = LiftDecision { grasp_id, action, reason, probability_stable: 0.5 };
        Record::Decision(Stamped { header: header(seq), message })
    }

    fn report(samples: &[(Side, Record, u64)], end_nanos: u64) -> AgreementReport {
        let mut agreement = Agreement::default();
        for (side, record, received_nanos) in samples {
            agreement.add(*side, record, *received_nanos);
        }
        agreement.report("node/port".into(), end_nanos)
    }

    fn conditions(text: &str) -> Vec<Condition> {
        text.split(',').map(|text| text.parse().expect("a condition")).collect()
    }

    use Side::{Active, Shadow};

    #[test]
    fn predictions_are_paired_by_number_whoever_comes_first() {
        let found = report(
            &[
                (Active, prediction(0, 7, true, false, 0.9), 3001),
                (Shadow, prediction(1, 7, false, true, 0.5), 4001),
                (Shadow, prediction(0, 7, true, false, 0.8), 5001),
                (Active, prediction(1, 7, true, false, 0.9), 4001),
                (Active, prediction(2, 7, true, false, 0.7), 5001),
                (Shadow, prediction(2, 7, false, false, 0.2), 5001),
                (Active, prediction(3, 8, false, false, 0.1), 6001),
                (Shadow, prediction(3, 8, false, false, 0.3), 7001),
                // Said before: a restart sends it again.
                (Active, prediction(3, 8, true, false, 0.1), 6002),
                (Active, prediction(4, 8, false, false, 0.1), 7001),
                (Active, prediction(4, 8, false, false, 0.1), 7002),
                (Shadow, prediction(9, 8, false, false, 0.1), 12001),
            ],
            20_000,
        );
        assert_eq!((found.n_pairs, found.agreement), (4, Some(0.5)));
        assert_eq!((found.n_only_active, found.n_only_shadow, found.n_unanswered), (1, 1, 0));
        let expected = Disagreement {
            grasp_id: 7,
            n_samples: 2,
            active: Saying { says: "stable".into(), probability_stable: Some(0.9) },
            shadow: Saying { says: "unsure".into(), probability_stable: Some(0.5) },
        };
        assert_eq!(found.disagreements, [expected]);
        // 3 µs, five times; the shadow's 3, 5, 3, 4 and 3.
        assert_eq!(found.active_latency, Some(Latency { p50_micros: 3.0, p99_micros: 3.0 }));
        assert_eq!(found.shadow_latency, Some(Latency { p50_micros: 3.0, p99_micros: 5.0 }));
    }

    #[test]
    fn decisions_are_paired_by_grasp_and_differ_in_action_and_reason() {
        let found = report(
            &[
                (Active, decision(10, 1, Action::Lift, Reason::Stable), 1),
                (Shadow, decision(12, 1, Action::Lift, Reason::Stable), 1),
                (Active, decision(20, 2, Action::Hold, Reason::Unsure), 1),
                (Shadow, decision(20, 2, Action::Hold, Reason::Unstable), 1),
                (Active, decision(30, 3, Action::Hold, Reason::Unsure), 1),
                (Shadow, decision(30, 3, Action::Lift, Reason::Stable), 1),
            ],
            2,
        );
        assert_eq!((found.n_pairs, found.agreement), (3, Some(1.0 / 3.0)));
        let sayings: Vec<_> = found.disagreements.iter().map(|one| (&*one.active.says, &*one.shadow.says)).collect();
        assert_eq!(sayings, [("HOLD unsure", "HOLD unstable"), ("HOLD unsure", "LIFT stable")]);
    }

    #[test]
    fn other_messages_agree_when_their_content_is_equal() {
        let feature = |seq: u64, value: f64| {
            let message = GraspFeature { grasp_id: 5, values: vec![value, 0.5], ..GraspFeature::default() };
            Record::Histogram(Stamped { header: header(seq), message })
        };
        let nan = f64::NAN;
        let pairs = [(0.25, 0.25), (0.25, 0.250_000_000_1), (nan, nan), (nan, 0.0)];
        let samples: Vec<_> = pairs
            .iter()
            .zip(0..)
            .flat_map(|(&(active, shadow), seq)| {
                [(Active, feature(seq, active), 9000), (Shadow, feature(seq, shadow), 9000)]
            })
            .collect();
        let found = report(&samples, 1);
        assert_eq!((found.n_pairs, found.agreement), (4, Some(0.5)));
        assert_eq!((found.disagreements.len(), found.disagreements[0].n_samples), (1, 2));
    }

    #[test]
    fn silence_is_not_agreement() {
        let alone: Vec<_> = (0..100).map(|seq| (Active, prediction(seq, 1, true, false, 0.9), 1000 * seq)).collect();
        let silent = report(&alone, 10_000_000_000);
        assert_eq!((silent.n_pairs, silent.agreement, silent.n_only_active), (0, None, 100));
        assert_eq!((silent.shadow_latency, silent.n_unanswered), (None, 0));
        for text in ["agreement>=0", "disagreements<=99", "latency_p99_us<=1e9"] {
            let found = objections(std::slice::from_ref(&silent), &conditions(text));
            assert_eq!(found.len(), 1, "{text}: {found:?}");
        }
        assert_eq!(objections(&[], &conditions("agreement>=0")).len(), 1);
    }

    #[test]
    fn a_replacement_that_answers_some_samples_only_does_not_pass() {
        let secs = 1_000_000_000;
        // One sample a second; the replacement begins with the third.
        let run = |answers: &dyn Fn(u64) -> bool| {
            let samples: Vec<_> = (0..20)
                .flat_map(|seq| {
                    let record = prediction(seq, 1, true, false, 0.9);
                    let active = (Active, record.clone(), (seq + 1) * secs);
                    let shadow = (seq >= 2 && answers(seq)).then_some((Shadow, record, (seq + 1) * secs));
                    [Some(active), shadow].into_iter().flatten()
                })
                .collect();
            report(&samples, 20 * secs + secs / 2)
        };
        // The last one may be under way, the first two came before it was there.
        let all_but_last = run(&|seq| seq != 19);
        assert_eq!((all_but_last.n_pairs, all_but_last.n_only_active, all_but_last.n_unanswered), (17, 3, 0));
        assert_eq!(objections(&[all_but_last], &conditions("agreement>=1")), Vec::<String>::new());
        let every_second = run(&|seq| seq % 2 == 0);
        assert_eq!((every_second.n_pairs, every_second.agreement, every_second.n_unanswered), (9, Some(1.0), 8));
        let found = objections(&[every_second], &conditions("agreement>=1"));
        assert_eq!(found, ["node/port: the replacement answered only 9 of 17 samples that it had time for"]);
    }

    #[test]
    fn conditions_hold_at_their_limit_as_they_say_and_at_every_output() {
        let report = AgreementReport {
            output: "a/b".into(),
            n_pairs: 100,
            agreement: Some(0.99),
            n_only_active: 0,
            n_only_shadow: 0,
            n_unanswered: 0,
            disagreements: Vec::new(),
            active_latency: None,
            shadow_latency: Some(Latency { p50_micros: 100.0, p99_micros: 500.0 }),
        };
        let holds = |text: &str| objections(std::slice::from_ref(&report), &conditions(text)).is_empty();
        assert!(holds("agreement>=0.99") && !holds("agreement>0.99") && holds("agreement <= 0.99"));
        assert!(holds("latency_p99_us<=500") && !holds("latency_p99_us<500") && holds("latency_p99_us<501"));
        assert!(holds("disagreements<=0,agreement>=0.9,latency_p99_us<=500"));
        assert!(!holds("disagreements<=0,agreement>=0.995,latency_p99_us<=500"));
        let worse = AgreementReport { output: "c/d".into(), agreement: Some(0.5), ..report.clone() };
        let unknown = AgreementReport { output: "e/f".into(), shadow_latency: None, ..report.clone() };
        let found = objections(&[report, worse, unknown], &conditions("agreement>=0.9,latency_p99_us<=500"));
        let expected = [
            "c/d: agreement>=0.9 does not hold, agreement is 0.5",
            "e/f: latency_p99_us<=500 does not hold, latency_p99_us is unknown",
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn conditions_that_cannot_be_meant_are_refused() {
        for text in
            ["", "agreement", "agreement=0.9", "agreement>=99", "accuracy>=0.9", "agreement>=nan", "agreement>="]
        {
            text.parse::<Condition>().expect_err(text);
        }
    }
}
