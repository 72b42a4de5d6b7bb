//! `blindgrasp info`

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::{Outcome, completions, hand_cells, percent, print_line, print_text};
use blindgrasp_cli::joint;
use blindgrasp_graph::client::{is_graph_name, running_graphs};
use blindgrasp_grasps::dataset::{REPORT_METADATA, hand_of_all};
use blindgrasp_grasps::summary::{Overview, RecordingsSummary};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::{counted, did_you_mean};
use blindgrasp_recording::{RepairReport, recordings_in, repair};
use blindgrasp_stages::hand::{Hand, builtin_names};
use blindgrasp_stages::label::Label;

/// Recordings that together are larger than this are read only with --full.
const MAX_READ_BYTES: u64 = 256 << 20;

/// Describe recordings or a hand.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  blindgrasp info recordings/held-out.mcap\n  blindgrasp info data/paper --json\n  \
                        blindgrasp info hands/barrett-bh8-280.yaml --joints spread=0.5     where the cells are\n\n\
                        Quantiles are of the grasps with force closure; contacts are of each grasp's last settled frame.\n\n\
                        Recordings of more than 256 MiB together are not read: their index says how long and large they\n\
                        are and what topics they have; --full reads them."
)]
pub(super) struct Arguments {
    /// Recordings (MCAP) or folders of them; or one pad layout: a YAML file, or the name of a built-in hand
    #[arg(required = true, add = completions::hands())]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
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
    #[arg(long, value_name = "NAME=VALUE,…", value_delimiter = ',', value_parser = joint)]
    joints: Vec<(String, f64)>,
    /// Print JSON, with every object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let [path] = arguments.recordings.as_slice()
        && hand_cells::is_hand(path)
    {
        return hand_cells::print(path, &arguments.joints, arguments.json);
    }
    if let [path] = arguments.recordings.as_slice()
        && let Some(name) = path.to_str()
        && is_graph_name(name)
        && !path.exists()
    {
        if running_graphs().iter().any(|graph| graph == name) {
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
    let overview = Overview::of(&recordings)?;
    if overview.n_file_bytes > MAX_READ_BYTES && !arguments.full {
        if arguments.json {
            print_text(&serde_json::to_string_pretty(&overview)?)?;
        } else {
            print_lines(overview_lines(&overview))?;
        }
        print_diagnostic("these are the contents of the index; --full reads the recordings and sums up the grasps too");
        return Ok(Outcome::Done);
    }
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let summary = RecordingsSummary::read(&hand, &recordings, overview)?;
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
    if report.n_lost_attachments > 0 {
        lost.push(counted(report.n_lost_attachments, "attachment"));
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

fn counts(counts: &BTreeMap<String, u64>) -> String {
    let counts: Vec<_> = counts.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
    counts.join(", ")
}

fn overview_lines(overview: &Overview) -> Vec<(&str, String)> {
    let samples = overview.n_samples.iter();
    let samples = samples.map(|(topic, n)| format!("{topic} {}", n.map_or("unknown".into(), |n| n.to_string())));
    let [on_disk_mib, raw_mib] =
        [overview.n_file_bytes, overview.n_uncompressed_bytes].map(|n_bytes| n_bytes as f64 / f64::from(1 << 20));
    let mut lines = vec![
        ("recordings", overview.recordings.len().to_string()),
        ("hand", overview.hand.clone()),
        ("samples", samples.collect::<Vec<String>>().join(", ")),
        ("duration", overview.duration_secs.map_or("unknown".into(), |secs| format!("{secs:.1} s"))),
        ("size", format!("{on_disk_mib:.1} MiB in {} chunks, {raw_mib:.1} MiB before compression", overview.n_chunks)),
    ];
    for (name, topic) in overview.topics.iter().filter(|(_, topic)| !topic.is_ours) {
        let n_messages = topic.n_messages.map_or("?".into(), |n| n.to_string());
        lines.push(("others", format!("{name} {n_messages} ({})", topic.schema)));
    }
    // A simulation's report is long; --json has it.
    for (name, metadata) in overview.metadata.iter().filter(|(name, _)| *name != REPORT_METADATA) {
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

fn print_summary(hand: &Hand, summary: &RecordingsSummary) -> anyhow::Result<()> {
    let mut lines = overview_lines(&summary.overview);
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
    for found in &summary.problems {
        lines.push(("problem", format!("{}: {}", found.recording, found.message)));
    }
    if summary.n_frames_of_other_hands > 0 {
        let n_frames = summary.n_frames_of_other_hands;
        lines.push(("problem", format!("{n_frames} frames are of other hands than {}", hand.name)));
    }
    print_lines(lines)?;
    if !summary.classes.is_empty() {
        print_text("\nclass              grasps    stable")?;
    }
    for (class, group) in &summary.classes {
        let stable = share(group.n_stable, group.n_grasps);
        print_line(&format!("{class:<16} {:>8} {stable:>9}", group.n_grasps))?;
    }
    Ok(())
}

fn share(part: usize, whole: usize) -> String {
    percent((whole > 0).then(|| part as f64 / whole as f64))
}

fn quantiles(quantiles: Option<[f64; 5]>) -> String {
    quantiles.map_or("n/a".into(), |values| values.map(|value| format!("{value:.3}")).join("  "))
}

fn labels(labels: &BTreeSet<Label>) -> String {
    let meanings: Vec<&str> = labels.iter().map(|label| label.meaning()).collect();
    if meanings.is_empty() { "as recorded; not from a simulation".into() } else { meanings.join("; ") }
}

fn print_lines(lines: Vec<(&str, String)>) -> anyhow::Result<()> {
    for (what, value) in lines {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(())
}
