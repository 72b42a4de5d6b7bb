//! `blindgrasp info`

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;

use super::simulate::report_in;
use super::{Outcome, cases, completions, hand_cells, percent, print_line, print_text};
use blindgrasp_graph::client::{is_graph_name, running_graphs};
use blindgrasp_learning::dataset::{REPORT_METADATA, hand_of, label_of, reported_truth};
use blindgrasp_learning::evaluation::paper_label::PaperLabel;
use blindgrasp_learning::evaluation::statistics::Interval;
use blindgrasp_messages::{GraspTruth, Phase, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::did_you_mean;
use blindgrasp_recording::{
    IndexedTopic, Problem, Problems, Record, RecordingIndex, RecordingReader, RepairReport, recordings_in, repair,
};
use blindgrasp_simulator::simulator::SimulationReport;
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::hand::{Hand, builtin_names};
use blindgrasp_stages::label::Label;

/// Recordings that together are larger than this are read only with --full.
const MAX_READ_BYTES: u64 = 256 << 20;

/// Describe recordings, a hand or grasp cases.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  blindgrasp info recordings/held-out.mcap\n  blindgrasp info data/paper --json\n  \
                        blindgrasp info grasps.json                 epsilon and volume of grasps given by their contacts\n  \
                        blindgrasp info hands/barrett-bh8-280.yaml --joints spread=0.5     where the cells are\n\n\
                        Quantiles are of the grasps with force closure; contacts are of each grasp's last settled frame.\n\n\
                        Recordings of more than 256 MiB together are not read: their index says how long and large they\n\
                        are and what topics they have; --full reads them."
)]
pub(super) struct Arguments {
    /// Recordings (MCAP) or folders of them; or one pad layout, or one file of cases
    ///
    /// A pad layout is a YAML file, or the name of a built-in hand. Grasp cases are a JSON file (docs/simulator.md), - for
    /// stdin.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Read all of it, however large, and sum up the grasps.
    #[arg(long)]
    full: bool,
    /// Write the undamaged samples of a cut or damaged recording to NAME.repaired.mcap beside it; the recording
    /// stays as it is.
    #[arg(long, conflicts_with_all = ["full", "hand"])]
    repair: bool,
    /// Joint values of a hand, radians or metres of a slide; other joints are open or follow their coupling
    #[arg(long, value_name = "NAME=VALUE,…", value_delimiter = ',', value_parser = hand_cells::joint)]
    joints: Vec<(String, f64)>,
    /// Print JSON, with every object
    #[arg(long)]
    json: bool,
}

/// The contents of the recordings' indexes.
#[derive(Debug, Default, Serialize)]
struct Overview {
    hand: String,
    made_by: BTreeSet<String>,
    n_recordings: usize,
    /// Whether the recordings were read whole.
    is_full: bool,
    /// `None` if an index does not say.
    n_samples: BTreeMap<String, Option<u64>>,
    /// The sum over all recordings, by their stamps; `None` if an index does not say and the recordings were not read.
    duration_secs: Option<f64>,
    n_file_bytes: u64,
    n_chunks: u64,
    n_compressed_bytes: u64,
    n_uncompressed_bytes: u64,
    /// All topics, also those of other types than blindgrasp's.
    topics: BTreeMap<String, IndexedTopic>,
    /// The first recording's metadata by name, without the simulation's report.
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

/// The summary of recordings.
#[derive(Debug, Default, Serialize)]
struct FileReport {
    #[serde(flatten)]
    overview: Overview,
    n_grasps: usize,
    n_with_truth: usize,
    n_stable: usize,
    /// Grasps whose epsilon is known.
    n_with_quality: usize,
    n_force_closure: usize,
    n_settled: usize,
    n_without_contact: usize,
    n_self_collisions: usize,
    /// Frames of other hands than the one that sums up.
    n_frames_of_other_hands: u64,
    /// Quantiles at 5, 25, 50, 75 and 95 % over the grasps with force closure.
    epsilon_quantiles: Option<[f64; 5]>,
    volume_quantiles: Option<[f64; 5]>,
    pads: BTreeMap<String, PadSummary>,
    classes: BTreeMap<String, Group>,
    objects: BTreeMap<String, Group>,
    /// The simulation's report, if a simulation made all recordings.
    simulation: Option<SimulationReport>,
    /// The definitions of stable in the simulated recordings.
    labels: BTreeSet<Label>,
    /// The paper's label compared with the recorded labels, if those are others.
    paper_label: Option<PaperLabel>,
    problems: Vec<FoundProblem>,
}

/// A problem in a recording.
#[derive(Debug, Serialize)]
struct FoundProblem {
    recording: String,
    #[serde(flatten)]
    problem: Problem,
    message: String,
}

#[derive(Debug, Default, Serialize)]
struct PadSummary {
    /// Grasps in which the pad has a contact.
    n_grasps: usize,
    /// Active cells in these grasps.
    n_contacts: usize,
}

#[derive(Debug, Default, Serialize)]
struct Group {
    n_grasps: usize,
    n_stable: usize,
    /// The stable share of the simulation's candidates, before balancing.
    natural_stable_rate: Option<f64>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let [path] = arguments.recordings.as_slice() {
        if hand_cells::is_hand(path) {
            return hand_cells::print(path, &arguments.joints, arguments.json);
        }
        if cases::are_at(path) {
            return cases::print(path, arguments.json);
        }
    }
    if let [path] = arguments.recordings.as_slice()
        && let Some(name) = path.to_str()
        && is_graph_name(name)
        && !path.exists()
    {
        if running_graphs().unwrap_or_default().iter().any(|graph| graph == name) {
            bail!("'{name}' is a running graph: blindgrasp ps {name} describes it, blindgrasp view {name} shows it");
        }
        let hands = builtin_names();
        let alike = did_you_mean(name, hands.iter().copied()).map(|alike| format!("{alike} ")).unwrap_or_default();
        bail!("no file, folder or built-in hand is called '{name}'; {alike}built-in hands: {}", hands.join(", "));
    }
    if !arguments.joints.is_empty() {
        bail!("--joints is for a hand: name its pad layout (YAML)");
    }
    let recordings = recordings_in(&arguments.recordings)?;
    if arguments.repair {
        return repair_all(&recordings, arguments.json);
    }
    let mut indexes = Vec::new();
    for path in &recordings {
        indexes.push(RecordingIndex::open(path)?);
    }
    let overview = Overview::of(indexes);
    if overview.n_file_bytes > MAX_READ_BYTES && !arguments.full {
        if arguments.json {
            print_text(&serde_json::to_string_pretty(&overview)?)?;
        } else {
            print_lines(overview.lines())?;
        }
        print_diagnostic("these are the contents of the index; --full reads the recordings and sums up the grasps too");
        return Ok(Outcome::Done);
    }
    let first = recordings.first().context("expected a recording")?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let summary = summarise(&hand, &recordings, overview)?;
    if arguments.json {
        print_text(&serde_json::to_string_pretty(&summary)?)?;
    } else {
        print_summary(&hand, &summary)?;
    }
    Ok(Outcome::Done)
}

fn repair_all(recordings: &[PathBuf], json: bool) -> anyhow::Result<Outcome> {
    let mut reports = Vec::new();
    for path in recordings {
        let report = repair(path)?;
        if !json {
            print_repair(&report)?;
        }
        reports.push(report);
    }
    if json {
        print_text(&serde_json::to_string_pretty(&serde_json::json!({ "repairs": reports }))?)?;
    }
    // Exit code 0 promises that nothing is lost.
    let has_loss = reports.iter().any(|report| report.has_loss() || !report.n_unverified.is_empty());
    Ok(if has_loss { Outcome::FinishedWithLoss } else { Outcome::Done })
}

fn print_repair(report: &RepairReport) -> anyhow::Result<()> {
    let Some(output) = &report.output else {
        print_line(&format!("{} is whole: there is nothing to repair", report.input.display()))?;
        return Ok(());
    };
    let counts = |counts: &BTreeMap<String, u64>| {
        let counts: Vec<_> = counts.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
        counts.join(", ")
    };
    let mut lost: Vec<String> = Vec::new();
    if report.n_damaged_chunks > 0 {
        lost.push(format!("{} damaged chunks", report.n_damaged_chunks));
    }
    if report.has_partial_chunk {
        lost.push("the end of a chunk that is cut off".into());
    }
    if !report.n_lost.is_empty() {
        lost.push(counts(&report.n_lost));
    }
    if report.n_of_unknown_topics > 0 {
        lost.push(format!("{} messages of unknown topics", report.n_of_unknown_topics));
    }
    if report.n_skipped_bytes > 0 {
        lost.push(format!("{} bytes that are no record", report.n_skipped_bytes));
    }
    let mut lines = vec![
        ("repaired", output.display().to_string()),
        ("recovered", counts(&report.n_recovered)),
        ("lost", if lost.is_empty() { "nothing that is known".into() } else { lost.join("; ") }),
    ];
    if !report.n_unverified.is_empty() {
        let unverified = counts(&report.n_unverified);
        lines.push(("unverified", format!("{unverified}: recovered, but no checksum tells whether they are damaged")));
    }
    if !report.has_data_end {
        lines.push(("end", "missing: samples after the last chunk may be lost".into()));
    } else if !report.has_end {
        lines.push(("end", "missing: all samples lie before it".into()));
    }
    if !report.has_info {
        lines.push(("hand", "unknown: what the recording said of itself is lost; name the hand with --hand".into()));
    }
    print_lines(lines)
}

impl Overview {
    fn of(indexes: Vec<RecordingIndex>) -> Self {
        let mut overview = Overview { n_recordings: indexes.len(), duration_secs: Some(0.0), ..Overview::default() };
        let added = |sum: Option<u64>, more: Option<u64>| sum.zip(more).map(|(sum, more)| sum.saturating_add(more));
        for (idx, index) in indexes.into_iter().enumerate() {
            let secs = index.duration_nanos().map(|nanos| nanos as f64 / 1e9);
            overview.duration_secs = overview.duration_secs.zip(secs).map(|(sum, more)| sum + more);
            overview.n_file_bytes += index.n_file_bytes;
            overview.n_chunks += index.n_chunks;
            overview.n_compressed_bytes = overview.n_compressed_bytes.saturating_add(index.n_compressed_bytes);
            overview.n_uncompressed_bytes = overview.n_uncompressed_bytes.saturating_add(index.n_uncompressed_bytes);
            overview.made_by.insert(index.info.made_by);
            if idx == 0 {
                overview.hand = index.info.hand;
                overview.metadata = index.metadata;
                overview.metadata.remove(REPORT_METADATA);
            }
            for (name, topic) in index.topics {
                if topic.is_ours {
                    let n_samples = overview.n_samples.entry(name.clone()).or_insert(Some(0));
                    *n_samples = added(*n_samples, topic.n_messages);
                }
                match overview.topics.get_mut(&name) {
                    Some(known) => known.n_messages = added(known.n_messages, topic.n_messages),
                    None => {
                        overview.topics.insert(name, topic);
                    }
                }
            }
        }
        overview
    }

    fn lines(&self) -> Vec<(&str, String)> {
        let unknown = || "unknown".to_string();
        let number = |n: &Option<u64>| n.map_or_else(unknown, |n| n.to_string());
        let samples: Vec<_> = self.n_samples.iter().map(|(topic, n)| format!("{topic} {}", number(n))).collect();
        let mebibytes = |n_bytes: u64| n_bytes as f64 / f64::from(1 << 20);
        let mut lines = vec![
            ("recordings", self.n_recordings.to_string()),
            ("hand", self.hand.clone()),
            ("samples", samples.join(", ")),
            ("duration", self.duration_secs.map_or_else(unknown, |secs| format!("{secs:.1} s"))),
            (
                "size",
                format!(
                    "{:.1} MiB in {} chunks, {:.1} MiB before compression",
                    mebibytes(self.n_file_bytes),
                    self.n_chunks,
                    mebibytes(self.n_uncompressed_bytes)
                ),
            ),
        ];
        for (name, topic) in self.topics.iter().filter(|(_, topic)| !topic.is_ours) {
            let n_messages = topic.n_messages.map_or("?".into(), |n| n.to_string());
            lines.push(("not ours", format!("{name} {n_messages} ({})", topic.schema)));
        }
        for (name, metadata) in &self.metadata {
            for (key, value) in metadata {
                let value = match value.split_once('\n') {
                    Some((first, rest)) => format!("{first} … ({} more lines)", rest.lines().count()),
                    None => value.clone(),
                };
                lines.push((name, format!("{key}: {value}")));
            }
        }
        lines
    }
}

fn summarise(hand: &Hand, recordings: &[PathBuf], overview: Overview) -> anyhow::Result<FileReport> {
    let overview = Overview { hand: hand.name.clone(), is_full: true, ..overview };
    let mut summary = FileReport { overview, ..FileReport::default() };
    let mut n_samples: BTreeMap<String, u64> = BTreeMap::new();
    let mut read_secs = 0.0;
    for pad in &hand.pads {
        summary.pads.insert(pad.name.clone(), PadSummary::default());
    }
    let mut qualities: Vec<(f64, f64)> = Vec::new();
    let mut truths: Vec<GraspTruth> = Vec::new();
    let mut reports: Option<SimulationReport> = Some(SimulationReport::default());
    for path in recordings {
        let reader = RecordingReader::open(path)?;
        let report = report_in(&reader, path)?;
        summary.labels.extend(label_of(path, &reader)?);
        match (report, &mut reports) {
            (Some(report), Some(reports)) => reports.add(&report),
            _ => reports = None,
        }
        let mut last: Option<TactileFrame> = None;
        // The outcomes of lifts that frames report, for grasps without a label.
        let mut reported = BTreeMap::new();
        let mut labelled = BTreeSet::new();
        let mut seen = BTreeSet::new();
        let mut problems = Problems::default();
        let mut stamps_nanos: Option<(u64, u64)> = None;
        for record in reader {
            let (topic, record) = record?;
            problems.add(&topic, &record);
            let stamp_nanos = record.header().stamp_nanos;
            let (begin, end) = stamps_nanos.unwrap_or((stamp_nanos, stamp_nanos));
            stamps_nanos = Some((begin.min(stamp_nanos), end.max(stamp_nanos)));
            *n_samples.entry(topic).or_default() += 1;
            match record {
                Record::Tactile(frame) => {
                    // 0 stands for an unknown hand.
                    let is_of_other = ![0, hand.id()].contains(&frame.header.hand_id);
                    summary.n_frames_of_other_hands += u64::from(is_of_other);
                    if last.as_ref().is_some_and(|last| last.grasp_id != frame.message.grasp_id) {
                        summary.count_contacts(hand, last.take());
                    }
                    summary.n_grasps += usize::from(seen.insert(frame.message.grasp_id));
                    if matches!(frame.message.phase, Phase::Kept | Phase::Dropped) {
                        reported.entry(frame.message.grasp_id).or_insert(frame.message.phase == Phase::Kept);
                    }
                    if frame.message.phase == Phase::Settled || last.is_none() {
                        last = Some(frame.message);
                    }
                }
                Record::Truth(truth) => {
                    labelled.insert(truth.message.grasp_id);
                    summary.count_truth(&truth.message, &mut qualities);
                    truths.push(truth.message);
                }
                _ => {}
            }
        }
        summary.count_contacts(hand, last);
        read_secs += stamps_nanos.map_or(0.0, |(first, last)| (last - first) as f64 / 1e9);
        for (grasp_id, is_kept) in reported.into_iter().filter(|(grasp_id, _)| !labelled.contains(grasp_id)) {
            summary.count_truth(&reported_truth(path, grasp_id, is_kept), &mut qualities);
        }
        summary.problems.extend(problems.found().into_iter().map(|problem| FoundProblem {
            recording: path.display().to_string(),
            message: problem.to_string(),
            problem,
        }));
    }
    summary.overview.n_samples = n_samples.into_iter().map(|(topic, n)| (topic, Some(n))).collect();
    summary.overview.duration_secs.get_or_insert(read_secs);
    summary.simulation = reports;
    let paper_label = PaperLabel::of(&truths);
    let is_other = summary.labels.contains(&Label::Lift) || paper_label.all.n_different() > 0;
    summary.paper_label = is_other.then_some(paper_label);
    summary.add_natural_rates();
    summary.n_force_closure = qualities.len();
    summary.epsilon_quantiles = quantiles(qualities.iter().map(|(epsilon, _)| *epsilon).collect());
    summary.volume_quantiles = quantiles(qualities.iter().map(|(_, volume)| *volume).collect());
    Ok(summary)
}

impl FileReport {
    fn count_truth(&mut self, truth: &GraspTruth, qualities: &mut Vec<(f64, f64)>) {
        self.n_with_truth += 1;
        self.n_stable += usize::from(truth.stable);
        self.n_with_quality += usize::from(!truth.epsilon.is_nan());
        if truth.epsilon > 0.0 {
            qualities.push((truth.epsilon, truth.volume));
        }
        for group in [
            self.classes.entry(truth.class.clone()).or_default(),
            self.objects.entry(truth.object.clone()).or_default(),
        ] {
            group.n_grasps += 1;
            group.n_stable += usize::from(truth.stable);
        }
    }

    fn count_contacts(&mut self, hand: &Hand, frame: Option<TactileFrame>) {
        let Some(frame) = frame.filter(|frame| frame.phase == Phase::Settled) else { return };
        let mut contacts = Vec::new();
        let found = contacts_from_frame(hand, 0, &frame.joints, &frame.cells_newtons, &mut contacts);
        self.n_settled += 1;
        self.n_self_collisions += usize::from(found.self_collision);
        self.n_without_contact += usize::from(contacts.is_empty());
        for (pad_idx, pad) in hand.pads.iter().enumerate() {
            let n_contacts = contacts.iter().filter(|contact| contact.pad as usize == pad_idx).count();
            if let Some(pad) = self.pads.get_mut(&pad.name) {
                pad.n_grasps += usize::from(n_contacts > 0);
                pad.n_contacts += n_contacts;
            }
        }
    }

    fn add_natural_rates(&mut self) {
        let Some(report) = &self.simulation else { return };
        let rate = |n_stable: usize, n: usize| (n > 0).then(|| n_stable as f64 / n as f64);
        let mut of_classes: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
        for (name, object) in &report.objects {
            if let Some(group) = self.objects.get_mut(name) {
                group.natural_stable_rate = rate(object.n_judged_stable, object.n_judged);
            }
            let sums = of_classes.entry(&object.class).or_default();
            sums.0 += object.n_judged_stable;
            sums.1 += object.n_judged;
        }
        for (class, (n_stable, n)) in of_classes {
            if let Some(group) = self.classes.get_mut(class) {
                group.natural_stable_rate = rate(n_stable, n);
            }
        }
    }
}

fn quantiles(mut values: Vec<f64>) -> Option<[f64; 5]> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some([0.05, 0.25, 0.5, 0.75, 0.95].map(|part| values[(part * last as f64).round() as usize]))
}

fn print_summary(hand: &Hand, summary: &FileReport) -> anyhow::Result<()> {
    let share = |part: usize, whole: usize| percent((whole > 0).then(|| part as f64 / whole as f64));
    let quantiles = |quantiles: Option<[f64; 5]>| {
        quantiles.map_or("n/a".into(), |values| values.map(|value| format!("{value:.3}")).join("  "))
    };
    let mut lines = summary.overview.lines();
    lines.extend([
        ("grasps", format!("{}, {} with a label", summary.n_grasps, summary.n_with_truth)),
        ("stable", share(summary.n_stable, summary.n_with_truth)),
        ("label", labels(&summary.labels)),
        ("force closure", share(summary.n_force_closure, summary.n_with_quality)),
        ("epsilon", format!("{}   (at 5, 25, 50, 75, 95 %)", quantiles(summary.epsilon_quantiles))),
        ("volume", quantiles(summary.volume_quantiles)),
        (
            "without contact",
            format!(
                "{} of the settled grasps (cells that feel another link of the hand don't count)",
                share(summary.n_without_contact, summary.n_settled)
            ),
        ),
        (
            "self-collision",
            format!("{}, as far as the encoders can tell", share(summary.n_self_collisions, summary.n_settled)),
        ),
    ]);
    for pad in &hand.pads {
        if let Some(found) = summary.pads.get(&pad.name) {
            let mean = found.n_contacts as f64 / found.n_grasps.max(1) as f64;
            let felt = share(found.n_grasps, summary.n_settled);
            lines.push(("pad", format!("{:<12} feels {felt} of the grasps, {mean:.1} cells each", pad.name)));
        }
    }
    if let Some(report) = &summary.simulation {
        lines.push((
            "simulation",
            format!(
                "{} candidates, {} stable before balancing; {} without touch, {} over their quota, {} hull failures",
                report.n_candidates,
                share(report.n_judged_stable, report.n_judged),
                report.n_without_touch,
                report.n_over_quota,
                report.n_hull_failures
            ),
        ));
    }
    for found in &summary.problems {
        lines.push(("problem", format!("{}: {}", found.recording, found.message)));
    }
    if summary.n_frames_of_other_hands > 0 {
        let n_frames = summary.n_frames_of_other_hands;
        lines.push(("problem", format!("{n_frames} frames are of other hands than {}", hand.name)));
    }
    print_lines(lines)?;
    if !summary.classes.is_empty() {
        print_text("\nclass              grasps    stable  by nature")?;
    }
    for (class, group) in &summary.classes {
        let natural = percent(group.natural_stable_rate);
        let stable = share(group.n_stable, group.n_grasps);
        print_line(&format!("{class:<16} {:>8} {stable:>9} {natural:>10}", group.n_grasps))?;
    }
    summary.paper_label.as_ref().map_or(Ok(()), print_paper_label)
}

fn labels(labels: &BTreeSet<Label>) -> String {
    let meanings: Vec<&str> = labels.iter().map(|label| label.meaning()).collect();
    if meanings.is_empty() { "as recorded; not from a simulation".into() } else { meanings.join("; ") }
}

/// So many classes are printed whose truth and paper's label disagree most.
const N_CLASSES: usize = 5;

/// The paper's label beside another truth.
fn print_paper_label(found: &PaperLabel) -> anyhow::Result<()> {
    let all = &found.all;
    print_text("\nthe paper's label (epsilon > 0.07 and volume > 0.1) beside the truth, in grasps")?;
    print_line("                    truth stable  truth unstable")?;
    for (row, stable, unstable) in [
        ("label stable", all.n_stable_by_both, all.n_stable_by_paper_only),
        ("label unstable", all.n_stable_by_truth_only, all.n_unstable_by_both),
    ] {
        print_line(&format!("{row:<18} {stable:>13} {unstable:>15}"))?;
    }
    let interval = all.accuracy.and_then(|accuracy| accuracy.interval);
    let interval = interval.map(|Interval { low, high }| format!(" ({:.1}..{:.1})", 100.0 * low, 100.0 * high));
    let area = |area: Option<f64>| area.map_or("n/a".into(), |area| format!("{area:.3}"));
    print_line(&format!(
        "they agree in {}{}, always the same would in {}; ROC area of epsilon {}, of the volume {}",
        percent(all.accuracy.map(|accuracy| accuracy.value)),
        interval.unwrap_or_default(),
        percent(all.majority_class),
        area(found.epsilon_roc_auc),
        area(found.volume_roc_auc),
    ))?;
    for (class, agreement) in found.by_disagreement().into_iter().take(N_CLASSES) {
        print_line(&format!(
            "  {class:<16} differs in {} of {}: {} stable by the label only, {} by the truth only",
            agreement.n_different(),
            agreement.n(),
            agreement.n_stable_by_paper_only,
            agreement.n_stable_by_truth_only
        ))?;
    }
    if found.n_without_quality > 0 {
        print_line(&format!("  without epsilon and volume, not counted: {}", found.n_without_quality))?;
    }
    Ok(())
}

fn print_lines(lines: Vec<(&str, String)>) -> anyhow::Result<()> {
    for (what, value) in lines {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(())
}
