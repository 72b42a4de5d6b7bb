//! The report of a run as a page: its decisions in time, latencies, losses, changes, and pictures of wrong decisions.

use std::collections::VecDeque;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use blindgrasp_graph::log::AUDIT;
use blindgrasp_graph::log::{LogFolder, LogTail};
use blindgrasp_graph::run::{RunSummary, SeenDecision};
use blindgrasp_messages::{Action, GraspTruth, LiftDecision, Phase, Record, Stamped, TactileFrame};
use blindgrasp_operator::wiring::LogLevel;
use blindgrasp_pictures::{DrawnFrames, ObjectSurface, RecordedGrasp, ReportKind, report_html};
use blindgrasp_stages::hand::Hand;
use serde::Serialize;

use crate::output::write_report;

/// Decisions in the chart, but for wrong ones; of more, every nth is drawn.
const MAX_DRAWN: usize = 2000;
/// Wrong decisions of a kind in the chart.
const MAX_WRONG: usize = 500;
/// Pictures of wrong lifts, and of wrong holds.
const MAX_PICTURES: usize = 6;
/// The last grasps: their decision or truth may come late, and frames may come after these.
const MAX_GRASPS: usize = 256;
/// Lines of the log.
const MAX_LINES: usize = 200;

/// A grasp: the source's epoch, and its number.
type GraspKey = (u64, u64);

/// A decision in the chart: seconds since the start, and the probability.
type Point = [f64; 2];

/// The things that a report needs of a run, in bounded memory.
pub(super) struct RunReport {
    start: Instant,
    hand: Option<Hand>,
    /// The last grasps, in the order in which they came: neither epochs nor numbers need to rise.
    grasps: VecDeque<(GraspKey, ReportedGrasp)>,
    /// Decisions that count as right, or of which the truth is not known: every `step`th.
    others: Vec<Point>,
    step: usize,
    n_others: usize,
    wrong_lifts: Wrong,
    wrong_holds: Wrong,
}

/// The things that are known of a grasp.
#[derive(Default)]
struct ReportedGrasp {
    /// The last settled frame, or the last one.
    frame: Option<Stamped<TactileFrame>>,
    decision: Option<(f64, LiftDecision)>,
    truth: Option<GraspTruth>,
    is_counted: bool,
}

#[derive(Default, Serialize)]
struct Wrong {
    n: usize,
    points: Vec<Point>,
    #[serde(rename = "shown", serialize_with = "count")]
    pictures: Vec<RecordedGrasp>,
}

/// The data of the page.
#[derive(Serialize)]
struct RunPage<'a> {
    summary: &'a RunSummary,
    /// Every `step`th of the right decisions.
    step: usize,
    others: &'a [Point],
    wrong_lifts: &'a Wrong,
    wrong_holds: &'a Wrong,
    changes: Changes,
    /// The reason for the lack of cards, if there is one.
    problem: Option<String>,
}

/// Lines of the log: time, operator, level and text.
#[derive(Default, Serialize)]
struct Changes {
    lines: Vec<[String; 4]>,
    n_left_out: usize,
    problem: Option<String>,
}

impl RunReport {
    pub(super) fn begin(hand: Option<Hand>) -> RunReport {
        RunReport {
            start: Instant::now(),
            hand,
            grasps: VecDeque::new(),
            others: Vec::new(),
            step: 1,
            n_others: 0,
            wrong_lifts: Wrong::default(),
            wrong_holds: Wrong::default(),
        }
    }

    fn grasp(&mut self, key: GraspKey) -> &mut ReportedGrasp {
        // Most often it is one of the last.
        let known = self.grasps.iter().rposition(|(known, _)| *known == key);
        let idx = known.unwrap_or_else(|| {
            if self.grasps.len() >= MAX_GRASPS
                && let Some((_, oldest)) = self.grasps.pop_front()
            {
                self.add_without_truth(&oldest);
            }
            self.grasps.push_back((key, ReportedGrasp::default()));
            self.grasps.len() - 1
        });
        &mut self.grasps[idx].1
    }

    /// Counts a decision whose truth has not come.
    fn add_without_truth(&mut self, grasp: &ReportedGrasp) {
        if let (false, Some((secs, decision))) = (grasp.is_counted, &grasp.decision) {
            self.add([*secs, decision.probability_stable]);
        }
    }

    pub(super) fn sample(&mut self, record: &Record) {
        match record {
            Record::Tactile(sample) => {
                let is_shown = self.hand.as_ref().is_some_and(|hand| {
                    let TactileFrame { joints, cells_newtons, .. } = &sample.message;
                    let fits = joints.len() == hand.joints.len() && cells_newtons.len() == hand.n_cells();
                    let is_finite = joints.iter().all(|joint| joint.is_finite());
                    [0, hand.id()].contains(&sample.header.hand_id) && fits && is_finite
                });
                if is_shown {
                    let grasp = self.grasp((sample.header.epoch, sample.message.grasp_id));
                    let is_settled = |frame: &TactileFrame| frame.phase == Phase::Settled;
                    let has_settled = grasp.frame.as_ref().is_some_and(|last| is_settled(&last.message));
                    if !grasp.is_counted && (is_settled(&sample.message) || !has_settled) {
                        grasp.frame = Some(sample.clone());
                    }
                }
            }
            Record::Truth(truth) => {
                let key = (truth.header.epoch, truth.message.grasp_id);
                self.grasp(key).truth = Some(truth.message.clone());
                self.settle(key);
            }
            _ => {}
        }
    }

    pub(super) fn decision(&mut self, seen: &SeenDecision<'_>) {
        // Another decision follows a probe.
        if !seen.decision.action.decides() {
            return;
        }
        let key = (seen.header.epoch, seen.decision.grasp_id);
        let secs = self.start.elapsed().as_secs_f64();
        let grasp = self.grasp(key);
        grasp.decision = Some((secs, seen.decision.clone()));
        grasp.truth = grasp.truth.take().or_else(|| seen.truth.cloned());
        self.settle(key);
    }

    /// Counts a grasp whose decision and truth are known.
    fn settle(&mut self, key: GraspKey) {
        let grasp = self.grasp(key);
        let ReportedGrasp { decision: Some((secs, decision)), truth: Some(truth), is_counted: false, .. } = grasp
        else {
            return;
        };
        let (secs, decision, truth) = (*secs, decision.clone(), truth.clone());
        grasp.is_counted = true;
        let frame = grasp.frame.take();
        let point = [secs, decision.probability_stable];
        let wrong = match (decision.action, truth.stable) {
            (Action::Lift, false) => &mut self.wrong_lifts,
            (Action::Hold, true) => &mut self.wrong_holds,
            _ => return self.add(point),
        };
        wrong.n += 1;
        if wrong.points.len() < MAX_WRONG {
            wrong.points.push(point);
        }
        if let Some(frame) = frame
            && wrong.pictures.len() < MAX_PICTURES
        {
            wrong.pictures.push(RecordedGrasp {
                grasp_id: decision.grasp_id,
                frames: vec![frame],
                truth: Some(truth),
                scene: None,
                object: ObjectSurface::Unknown(String::new()),
                prediction: None,
                decision: Some(decision),
                is_hand_alone: false,
            });
        }
    }

    fn add(&mut self, point: Point) {
        if self.n_others.is_multiple_of(self.step) {
            self.others.push(point);
        }
        self.n_others += 1;
        if self.others.len() > MAX_DRAWN {
            let mut idx = 0;
            self.others.retain(|_| {
                idx += 1;
                idx % 2 == 1
            });
            self.step *= 2;
        }
    }

    /// Writes the page.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn write(mut self, path: &Path, summary: &RunSummary) -> anyhow::Result<()> {
        for (_, grasp) in std::mem::take(&mut self.grasps) {
            self.add_without_truth(&grasp);
        }
        write_report(path, &self.page(summary)?).context("--report")
    }

    fn page(&self, summary: &RunSummary) -> anyhow::Result<String> {
        let mut page = RunPage {
            summary,
            step: self.step,
            others: &self.others,
            wrong_lifts: &self.wrong_lifts,
            wrong_holds: &self.wrong_holds,
            changes: changes(summary),
            problem: None,
        };
        let mut cards = None;
        let wrong: Vec<_> = self.wrong_lifts.pictures.iter().chain(&self.wrong_holds.pictures).collect();
        if let Some(hand) = &self.hand
            && !wrong.is_empty()
        {
            match DrawnFrames::of_grasps(hand, &wrong) {
                Ok(made) => cards = Some(made),
                Err(error) => page.problem = Some(error.to_string()),
            }
        }
        Ok(report_html(ReportKind::Run, &page, cards.as_ref())?)
    }
}

fn count<S: serde::Serializer>(pictures: &[RecordedGrasp], serializer: S) -> Result<S::Ok, S::Error> {
    pictures.len().serialize(serializer)
}

/// The lines of this run in the logs of the launcher and of its clients, and the warnings and errors of its operators.
fn changes(summary: &RunSummary) -> Changes {
    let mut lines = match LogTail::open(LogFolder::of_graph(&summary.graph), None, usize::MAX, 1 << 20) {
        Ok((_, lines)) => lines,
        Err(error) => return Changes { problem: Some(error.to_string()), ..Changes::default() },
    };
    // All logs begin the run at the same time.
    let begin = lines.iter().rposition(|line| line.operator == "run" && line.text.starts_with("== new run"));
    let mut lines = lines.split_off(begin.unwrap_or(0));
    lines.retain(|line| {
        let is_telling = ["run", AUDIT].contains(&line.operator.as_str())
            || matches!(line.level, Some(LogLevel::Error | LogLevel::Warn));
        is_telling && !line.text.starts_with("== new run")
    });
    let n_left_out = lines.len().saturating_sub(MAX_LINES);
    let mut shown = Vec::new();
    for line in lines.drain(n_left_out..) {
        let level = line.level.map(|level| format!("{level:?}").to_lowercase()).unwrap_or_default();
        let fields: String = line.fields.iter().map(|(name, value)| format!(" {name}={value}")).collect();
        shown.push([line.time, line.operator, level, line.text + &fields]);
    }
    Changes { lines: shown, n_left_out, problem: None }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Header, Reason};

    use super::*;

    /// A source that starts again may count its grasps from 0, in an epoch that is not above the one before.
    #[test]
    fn each_decision_is_counted_once_whatever_the_order_of_grasps_and_epochs() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let (joints, n_cells) = (vec![0.0; hand.joints.len()], hand.n_cells());
        let mut report = RunReport::begin(Some(hand));
        let n_grasps = 3 * MAX_GRASPS as u64;
        for (epoch, grasp_id) in [9, 4].into_iter().flat_map(|epoch| (0..n_grasps).rev().map(move |id| (epoch, id))) {
            let header = Header { epoch, ..Header::default() };
            let frame = TactileFrame {
                grasp_id,
                phase: Phase::Settled,
                joints: joints.clone(),
                cells_newtons: vec![0.0; n_cells],
                ..TactileFrame::default()
            };
            let frame = Record::Tactile(Stamped { header, message: frame });
            report.sample(&frame);
            let action = if grasp_id % 3 == 0 { Action::Lift } else { Action::Hold };
            let decision = LiftDecision { grasp_id, action, reason: Reason::Stable, ..LiftDecision::default() };
            // The truth of every second grasp comes after its decision; of every fifth, never.
            let truth = GraspTruth { grasp_id, stable: false, ..GraspTruth::default() };
            let is_early = grasp_id % 2 == 0 && grasp_id % 5 != 0;
            let seen = SeenDecision {
                header: &header,
                decision: &decision,
                latency_nanos: None,
                truth: is_early.then_some(&truth),
            };
            report.decision(&seen);
            if grasp_id % 5 != 0 {
                report.sample(&Record::Truth(Stamped { header, message: truth }));
            }
            // The hand still holds the object after the decision.
            report.sample(&frame);
        }
        for (_, grasp) in std::mem::take(&mut report.grasps) {
            report.add_without_truth(&grasp);
        }
        let n_wrong = 2 * (0..n_grasps).filter(|id| id % 3 == 0 && id % 5 != 0).count();
        assert_eq!((report.wrong_lifts.n, report.wrong_holds.n), (n_wrong, 0));
        assert_eq!(report.n_others, 2 * n_grasps as usize - n_wrong);
        assert_eq!(report.wrong_lifts.pictures.len(), MAX_PICTURES);
    }
}
