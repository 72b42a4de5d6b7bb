//! The report of a run as a page: its decisions in time, latencies, losses, changes, and pictures of wrong decisions.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use blindgrasp_graph::log::AUDIT;
use blindgrasp_graph::log::{LogFolder, LogTail};
use blindgrasp_graph::run::{RunSummary, SeenDecision};
use blindgrasp_messages::{Action, GraspTruth, LiftDecision, Phase, Record, Stamped, TactileFrame};
use blindgrasp_operator::ages::Ages;
use blindgrasp_operator::wiring::LogLevel;
use blindgrasp_pictures::chart::{
    Axis, BarChart, COLOURS, Chart, Line, NumberFormat, Series, bar_chart_svg, chart_svg, range_from_zero,
};
use blindgrasp_pictures::{GraspCards, ObjectSurface, PictureError, RecordedGrasp, ReportPage, escape, report_table};
use blindgrasp_stages::hand::Hand;

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

#[derive(Default)]
struct Wrong {
    n: usize,
    points: Vec<Point>,
    pictures: Vec<RecordedGrasp>,
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
        write_report(path, &self.page(summary)).context("--report")
    }

    fn page(&self, summary: &RunSummary) -> String {
        let mut page = ReportPage::begin(&format!("Run of {}", summary.graph), &lead(summary));
        page.section("Decisions", &reasons(summary));
        page.figure(&chart_svg(&self.timeline()), &self.timeline_caption());
        page.section("Edges", &edges(summary));
        let decided = summary.edges.iter().rev().find(|edge| edge.to == "run" && edge.ages.n_samples() > 0);
        let charts = decided.into_iter().chain(summary.edges.iter().filter(|edge| edge.to != "run"));
        page.pairs(charts.filter(|edge| edge.ages.n_samples() > 0).map(|edge| {
            bar_chart_svg(&histogram(&format!("Age on arrival, {} to {}", edge.from, edge.to), &edge.ages))
        }));
        page.section("Changes and messages", &changes(summary));
        if let Some(hand) = &self.hand {
            self.add_wrong(&mut page, hand).unwrap_or_else(|error| {
                page.raw(&format!("<p>{}</p>\n", escape(&error.to_string())));
            });
        }
        page.finish()
    }

    /// The wrong decisions as cards, which the page draws.
    fn add_wrong(&self, page: &mut ReportPage, hand: &Hand) -> Result<(), PictureError> {
        let mut cards = GraspCards::new(hand);
        let mut sections = Vec::new();
        for (title, wrong) in
            [("Lifts of unstable grasps", &self.wrong_lifts), ("Holds of stable grasps", &self.wrong_holds)]
        {
            if wrong.n > 0 {
                let shown = wrong.pictures.len();
                let count = format!("<p>{} in all; the first {shown} are shown.</p>\n", wrong.n);
                sections.push((title, count + &cards.add(&wrong.pictures)?));
            }
        }
        if !cards.is_empty() {
            page.section("Wrong decisions", &cards.view());
        }
        for (title, body) in sections {
            page.section(title, &body);
        }
        if !cards.is_empty() {
            page.raw(&cards.scripts()?);
        }
        Ok(())
    }

    fn timeline(&self) -> Chart {
        let series = |name: &str, colour, points: &[Point], radius| Series {
            name: name.into(),
            colour,
            line: Line::Solid,
            points: Vec::new(),
            discs: points.iter().map(|[secs, probability]| [*secs, *probability, radius]).collect(),
            intervals: Vec::new(),
        };
        let all = [&self.others, &self.wrong_holds.points, &self.wrong_lifts.points];
        Chart {
            title: "Probability of stable, by decision".into(),
            size: [860.0, 340.0],
            x: Axis {
                label: "seconds since the start".into(),
                range: range_around(all.into_iter().flatten().map(|[secs, _]| *secs)),
                format: NumberFormat::Count,
            },
            y: Axis { label: "probability (%)".into(), range: [0.0, 1.0], format: NumberFormat::Percent },
            series: vec![
                series("right, or without a label", COLOURS[4], &self.others, 2.0),
                series("held, stable", COLOURS[1], &self.wrong_holds.points, 3.5),
                series("lifted, unstable", COLOURS[5], &self.wrong_lifts.points, 4.5),
            ],
        }
    }

    fn timeline_caption(&self) -> String {
        let others = match self.step {
            1 => String::new(),
            n => format!("Of the right decisions, every {n}th is drawn. "),
        };
        match self.wrong_lifts.n.max(self.wrong_holds.n) {
            n if n > MAX_WRONG => format!("{others}Of the wrong ones of a kind, the first {MAX_WRONG} are drawn."),
            _ => others,
        }
    }
}

/// From a round value up to the first one to a round value from the last one on.
fn range_around(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let [first, last] = values.fold([f64::INFINITY, 0.0], |[first, last], value| [value.min(first), value.max(last)]);
    if !first.is_finite() {
        return [0.0, 1.0];
    }
    let step = if last > first { 10_f64.powf((last - first).log10().floor()) } else { 1.0 };
    let from = (first / step).floor() * step;
    [from, ((last / step).ceil() * step).max(from + step)]
}

fn lead(summary: &RunSummary) -> String {
    let losses = [
        (summary.samples_lost, "samples were lost"),
        (summary.samples_dropped, "samples were dropped for newer ones"),
        (summary.edges_unknown as u64, "edges do not tell their losses"),
        (summary.undecided as u64, "grasps were not decided"),
    ];
    let losses = losses.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("<b>{n} {what}.</b>"));
    let losses: Vec<String> = losses.collect();
    let loss = if losses.is_empty() { "No sample was lost.".into() } else { losses.join(" ") };
    let truth = match summary.with_truth {
        0 => "No grasp has a label.".into(),
        n => format!("Of {n} grasps with a label, {} were lifted and unstable.", summary.false_positives),
    };
    let latency = summary.latency_nanos.as_ref().map_or(String::new(), |latency| {
        format!(" A decision took {} in the median and {} at 99 %.", time(latency.p50), time(latency.p99))
    });
    format!(
        "{}: {} grasps, {} lifted, {} held. {truth}{latency} {loss} {} restarts, {} swaps.",
        escape(summary.end),
        summary.grasps,
        summary.lift,
        summary.hold,
        summary.restarts,
        summary.swaps
    )
}

fn time(nanos: u64) -> String {
    match nanos as f64 {
        nanos if nanos < 1e6 => format!("{:.0} µs", nanos / 1e3),
        nanos if nanos < 1e9 => format!("{:.1} ms", nanos / 1e6),
        nanos => format!("{:.1} s", nanos / 1e9),
    }
}

fn reasons(summary: &RunSummary) -> String {
    let rows = summary.reasons.iter().map(|(reason, n)| (false, vec![escape(reason), n.to_string()]));
    report_table(&[("reason", false), ("grasps", true)], &rows.collect::<Vec<_>>())
}

fn edges(summary: &RunSummary) -> String {
    let rows = summary.edges.iter().map(|edge| {
        let age = |share| edge.ages.quantile_nanos(share).map_or("–".into(), time);
        let cells = vec![
            escape(&edge.from),
            escape(&edge.to),
            edge.sent.to_string(),
            edge.received.to_string(),
            edge.missing.to_string(),
            edge.dropped.to_string(),
            edge.late.to_string(),
            age(0.5),
            age(0.99),
        ];
        (edge.missing > 0, cells)
    });
    let head = ["from", "to", "sent", "received", "missing", "dropped", "late", "age p50", "age p99"];
    let head: Vec<(&str, bool)> = head.iter().enumerate().map(|(idx, name)| (*name, idx > 1)).collect();
    report_table(&head, &rows.collect::<Vec<_>>())
}

/// A bar for each doubling of the age.
fn histogram(title: &str, ages: &Ages) -> BarChart {
    let mut octaves: BTreeMap<u32, u64> = BTreeMap::new();
    for (upper_nanos, count) in ages.buckets() {
        *octaves.entry(upper_nanos.saturating_sub(1).max(1).ilog2()).or_default() += count;
    }
    let n = ages.n_samples().max(1) as f64;
    let (first, last) = (octaves.keys().next().copied(), octaves.keys().last().copied());
    let all: Vec<u32> = first.zip(last).map(|(first, last)| (first..=last).collect()).unwrap_or_default();
    let shares: Vec<f64> =
        all.iter().map(|octave| octaves.get(octave).copied().unwrap_or_default() as f64 / n).collect();
    BarChart {
        title: title.into(),
        size: [566.0, 280.0],
        y: Axis {
            label: "share of samples (%)".into(),
            range: range_from_zero(shares.iter().copied()),
            format: NumberFormat::Percent,
        },
        groups: all.iter().map(|octave| format!("≤ {}", time(2_u64 << octave))).collect(),
        series: vec![(String::new(), COLOURS[0], shares)],
    }
}

/// The lines of this run in the logs of the launcher and of its clients, and the warnings and errors of its operators.
fn changes(summary: &RunSummary) -> String {
    let mut lines = match LogTail::open(LogFolder::of_graph(&summary.graph), None, usize::MAX, 1 << 20) {
        Ok((_, lines)) => lines,
        Err(error) => return format!("<p>The logs cannot be read: {}</p>\n", escape(&error.to_string())),
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
    let rows = lines.iter().skip(n_left_out).map(|line| {
        let level = line.level.map(|level| format!("{level:?}").to_lowercase()).unwrap_or_default();
        let fields: String = line.fields.iter().map(|(name, value)| format!(" {name}={value}")).collect();
        let text = escape(&format!("{}{fields}", line.text));
        (level == "error", vec![escape(&line.time), escape(&line.operator), level, text])
    });
    let rows: Vec<_> = rows.collect();
    if rows.is_empty() {
        return "<p>None.</p>\n".into();
    }
    let left_out = match n_left_out {
        0 => String::new(),
        n => format!("<p class=\"caption\">{n} earlier lines are left out: see blindgrasp logs.</p>\n"),
    };
    report_table(&[("time", false), ("operator", false), ("level", false), ("text", false)], &rows) + &left_out
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Header, Reason};

    use super::*;

    #[test]
    fn the_time_axis_begins_near_the_first_decision() {
        assert_eq!(range_around([62.4, 61.9, 70.0].into_iter()), [61.0, 70.0]);
        assert_eq!(range_around([3.0].into_iter()), [3.0, 4.0]);
        assert_eq!(range_around(std::iter::empty()), [0.0, 1.0]);
        let short = range_around([0.058, 0.097].into_iter());
        assert!((short[0] - 0.05).abs() < 1e-9 && (short[1] - 0.1).abs() < 1e-9, "{short:?}");
    }

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
