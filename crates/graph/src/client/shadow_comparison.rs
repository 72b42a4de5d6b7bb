//! Compares the samples of a replacement with those of the running operator, one by one.
//!
//! The comparison is pure: the caller reads both streams and gives samples and times. It does not say which side is
//! right.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};

use serde::Serialize;

use blindgrasp_messages::Fault;
use blindgrasp_messages::Record;

/// A sample of the last second may still be under way on the other side.
const IN_FLIGHT_NANOS: u64 = 1_000_000_000;
/// The replacement must have answered this share of the samples that it had time for: fewer answers are a selection,
/// and say nothing of the other samples. It is below 1 because the reader beside the graph may itself drop samples.
const MIN_ANSWERED_SHARE: f64 = 0.9;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    Active,
    Shadow,
}

/// The samples of both sides at one output.
#[derive(Debug, Default)]
pub struct ShadowComparison {
    /// Samples that came from one side only.
    alone: HashMap<PairKey, (Side, Sample)>,
    paired: HashSet<PairKey>,
    n_agreeing: u64,
    first_pair_nanos: Option<u64>,
    disagreements: BTreeMap<u64, Disagreement>,
    active_latencies_nanos: Vec<u64>,
    shadow_latencies_nanos: Vec<u64>,
}

/// How far both sides agree at one output.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComparisonReport {
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
    /// The part of `n_only_active` that came after the replacement's first answer and before the last second.
    pub n_unanswered: u64,
    /// The grasps in which they disagree.
    pub disagreements: Vec<Disagreement>,
    /// From the source's publishing of a sample to the running operator's answer, as a reader beside the graph sees it.
    pub active_latency: Option<Latency>,
    /// The same latency of the replacement.
    pub shadow_latency: Option<Latency>,
}

/// A grasp in which the two sides disagree.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Disagreement {
    pub grasp_id: u64,
    /// The number of its samples in which they disagree.
    pub n_samples: u64,
    /// The running operator's answer at the first disagreement.
    pub active: Saying,
    /// The replacement's answer to the same sample.
    pub shadow: Saying,
}

/// An answer in words.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Saying {
    pub says: String,
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

/// What a comparison must find at every output before the replacement may take over; `None` asks nothing.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PromotionLimits {
    /// The smallest share of samples on which both sides agree.
    pub min_agreement: Option<f64>,
    /// The largest number of grasps in which they disagree.
    pub max_disagreements: Option<usize>,
    /// The longest 99 % quantile of the replacement's latency, in microseconds.
    pub max_latency_p99_micros: Option<f64>,
}

/// Which sample: the source's generation, and the sequence number or, for decisions, the grasp.
type PairKey = (u64, u64);

#[derive(Debug)]
struct Sample {
    grasp_id: u64,
    /// A hash of the fields on which both sides must agree: the samples of a side that is alone pile up.
    content: u64,
    /// The sample in words; `None` for a message that has no short form.
    says: Option<String>,
    probability_stable: Option<f64>,
    received_nanos: u64,
}

impl ShadowComparison {
    /// Adds a sample of a side and the time of its receipt (CLOCK_BOOTTIME). A repeated sample does not count.
    pub fn add(&mut self, side: Side, record: &Record, received_nanos: u64) {
        let header = record.header();
        let (key, sample) = sample_of(record, received_nanos);
        if self.paired.contains(&key) {
            return;
        }
        let other = match self.alone.get(&key) {
            Some((earlier, _)) if *earlier == side => return,
            Some(_) => self.alone.remove(&key),
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
                self.alone.insert(key, (side, sample));
            }
            (Side::Active, Some((_, shadow))) => self.add_pair(key, &sample, &shadow),
            (Side::Shadow, Some((_, active))) => self.add_pair(key, &active, &sample),
        }
    }

    /// The result, with the time at which the comparison ended (CLOCK_BOOTTIME).
    pub fn report(self, output: String, end_nanos: u64) -> ComparisonReport {
        let n_pairs = self.paired.len() as u64;
        let count = |wanted: Side| self.alone.values().filter(|(side, _)| *side == wanted).count() as u64;
        let had_time = |sample: &Sample| {
            self.first_pair_nanos.is_some_and(|first| sample.received_nanos >= first)
                && sample.received_nanos < end_nanos.saturating_sub(IN_FLIGHT_NANOS)
        };
        let unanswered = self.alone.values().filter(|(side, sample)| *side == Side::Active && had_time(sample));
        ComparisonReport {
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

    fn add_pair(&mut self, key: PairKey, active: &Sample, shadow: &Sample) {
        self.paired.insert(key);
        let first = self.first_pair_nanos.get_or_insert(active.received_nanos);
        *first = (*first).min(active.received_nanos);
        if active.content == shadow.content {
            self.n_agreeing += 1;
            return;
        }
        let disagreement = self.disagreements.entry(active.grasp_id).or_insert_with(|| Disagreement {
            grasp_id: active.grasp_id,
            n_samples: 0,
            active: active.saying("the one content"),
            shadow: shadow.saying("another content"),
        });
        disagreement.n_samples += 1;
    }
}

/// Why a replacement may not take over, in words; empty if the comparison keeps all limits at every output.
pub fn objections(reports: &[ComparisonReport], limits: &PromotionLimits) -> Vec<String> {
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
        objections.extend(limits.broken_by(report).into_iter().map(|broken| format!("{output}: {broken}")));
    }
    objections
}

impl Sample {
    fn saying(&self, of_content: &str) -> Saying {
        let says = self.says.clone().unwrap_or_else(|| of_content.into());
        Saying { says, probability_stable: self.probability_stable }
    }
}

fn sample_of(record: &Record, received_nanos: u64) -> (PairKey, Sample) {
    let (header, grasp_id) = (record.header(), record.grasp_id());
    // A sample that is said once of each grasp may come a frame earlier from one side than from the other.
    let key = (header.epoch, if record.is_said_once() { grasp_id } else { header.seq });
    let (content, says, probability_stable) = match record {
        Record::Prediction(sample) => {
            let message = &sample.message;
            let says = match (message.fault, message.stable, message.unsure) {
                (fault, _, _) if fault != Fault::None => format!("fault {}", fault.as_str()),
                (_, true, false) => "stable".into(),
                (_, true, true) => "stable and unsure".into(),
                (_, false, true) => "unsure".into(),
                (_, false, false) => "unstable".into(),
            };
            let content = hash(&(message.stable, message.unsure, message.fault.as_str()));
            (content, Some(says), Some(message.probability_stable))
        }
        Record::Decision(sample) => {
            let message = &sample.message;
            let says = format!("{} {}", message.action.shown(), message.reason.as_str());
            (hash(&says), Some(says), Some(message.probability_stable))
        }
        // In JSON, a NaN equals another NaN.
        other => (hash(&other.to_json().unwrap_or_default().to_string()), None, None),
    };
    (key, Sample { grasp_id, content, says, probability_stable, received_nanos })
}

fn hash(content: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    content.hash(&mut hasher);
    hasher.finish()
}

fn latency(mut nanos: Vec<u64>) -> Option<Latency> {
    nanos.sort_unstable();
    let at = |percent: usize| {
        let rank = (percent * nanos.len()).div_ceil(100);
        Some(*nanos.get(rank.checked_sub(1)?)? as f64 / 1e3)
    };
    Some(Latency { p50_micros: at(50)?, p99_micros: at(99)? })
}

impl PromotionLimits {
    /// Whether any limit is set.
    pub fn is_any(&self) -> bool {
        *self != PromotionLimits::default()
    }

    /// The limits that a report does not keep, in words.
    fn broken_by(&self, report: &ComparisonReport) -> Vec<String> {
        let n_disagreements = Some(report.disagreements.len() as f64);
        let latency = report.shadow_latency.map(|latency| latency.p99_micros);
        let checks = [
            ("agreement", report.agreement, "at least", self.min_agreement),
            ("disagreements", n_disagreements, "at most", self.max_disagreements.map(|n| n as f64)),
            ("latency_p99_us", latency, "at most", self.max_latency_p99_micros),
        ];
        let mut broken = Vec::new();
        for (name, found, bound, limit) in checks {
            let Some(limit) = limit else { continue };
            let is_kept = |found: f64| if bound == "at least" { found >= limit } else { found <= limit };
            if !found.is_some_and(is_kept) {
                let found = found.map_or("unknown".into(), |found| found.to_string());
                broken.push(format!("{name} is {found}, expected {bound} {limit}"));
            }
        }
        broken
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{Action, GraspFeature, Header, LiftDecision, Prediction, Reason, Stamped};

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

    fn report(samples: &[(Side, Record, u64)], end_nanos: u64) -> ComparisonReport {
        let mut agreement = ShadowComparison::default();
        for (side, record, received_nanos) in samples {
            agreement.add(*side, record, *received_nanos);
        }
        agreement.report("node/port".into(), end_nanos)
    }

    fn at_least(min_agreement: f64) -> PromotionLimits {
        PromotionLimits { min_agreement: Some(min_agreement), ..PromotionLimits::default() }
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
            Record::Feature(Stamped { header: header(seq), message })
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
        let none = PromotionLimits::default();
        let limits = [
            at_least(0.0),
            PromotionLimits { max_disagreements: Some(99), ..none },
            PromotionLimits { max_latency_p99_micros: Some(1e9), ..none },
        ];
        for limits in limits {
            let found = objections(std::slice::from_ref(&silent), &limits);
            assert_eq!(found.len(), 1, "{limits:?}: {found:?}");
        }
        assert_eq!(objections(&[], &at_least(0.0)).len(), 1);
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
        assert_eq!(objections(&[all_but_last], &at_least(1.0)), Vec::<String>::new());
        let every_second = run(&|seq| seq % 2 == 0);
        assert_eq!((every_second.n_pairs, every_second.agreement, every_second.n_unanswered), (9, Some(1.0), 8));
        let found = objections(&[every_second], &at_least(1.0));
        assert_eq!(found, ["node/port: the replacement answered only 9 of 17 samples that it had time for"]);
    }

    #[test]
    fn limits_hold_inclusively_and_at_every_output() {
        let report = ComparisonReport {
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
        let holds = |limits: &PromotionLimits| objections(std::slice::from_ref(&report), limits).is_empty();
        let latency = |micros: f64| PromotionLimits { max_latency_p99_micros: Some(micros), ..at_least(0.9) };
        assert!(holds(&at_least(0.99)) && !holds(&at_least(0.995)));
        assert!(holds(&latency(500.0)) && !holds(&latency(499.0)));
        assert!(holds(&PromotionLimits { max_disagreements: Some(0), ..latency(500.0) }));
        let unlike = Saying { says: "stable".into(), probability_stable: None };
        let disagreement = Disagreement { grasp_id: 1, n_samples: 1, active: unlike.clone(), shadow: unlike };
        let differing = ComparisonReport { disagreements: vec![disagreement], ..report.clone() };
        let none = PromotionLimits { max_disagreements: Some(0), ..PromotionLimits::default() };
        assert_eq!(objections(&[differing], &none), ["a/b: disagreements is 1, expected at most 0"]);
        let worse = ComparisonReport { output: "c/d".into(), agreement: Some(0.5), ..report.clone() };
        let unknown = ComparisonReport { output: "e/f".into(), shadow_latency: None, ..report.clone() };
        let found = objections(&[report, worse, unknown], &latency(500.0));
        let expected =
            ["c/d: agreement is 0.5, expected at least 0.9", "e/f: latency_p99_us is unknown, expected at most 500"];
        assert_eq!(found, expected);
    }
}
