//! `blindgrasp info`

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use serde::Serialize;

use super::simulate::report_in;
use super::{Outcome, percent, print_line};
use crate::contacts::contacts_from_frame;
use crate::dataset::hand_of;
use crate::diagnostics::print_diagnostic;
use crate::grasp::simulator::SimulationReport;
use crate::hand::Hand;
use crate::message::{GraspTruth, Phase, TactileFrame};
use crate::recording::{Record, RecordingReader, recordings_in};

/// Sum up recordings: grasps, classes, stable share, quality, contacts per pad.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  blindgrasp info recordings/held-out.mcap\n  blindgrasp info data/paper --json\n\n\
                        Quantiles are of the grasps with force closure; contacts are of each grasp's last settled frame."
)]
pub(super) struct Arguments {
    /// Recordings (MCAP), or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long)]
    hand: Option<PathBuf>,
    /// Print JSON, with each object too.
    #[arg(long)]
    json: bool,
}

/// What is said of recordings.
#[derive(Debug, Default, Serialize)]
struct Summary {
    hand: String,
    made_by: BTreeSet<String>,
    n_recordings: usize,
    n_samples: BTreeMap<String, u64>,
    n_grasps: usize,
    n_with_truth: usize,
    n_stable: usize,
    /// Grasps whose epsilon is known.
    n_with_quality: usize,
    n_force_closure: usize,
    n_settled: usize,
    n_without_contact: usize,
    n_self_collisions: usize,
    /// At 5, 25, 50, 75 and 95 %, of the grasps with force closure.
    epsilon_quantiles: Option<[f64; 5]>,
    volume_quantiles: Option<[f64; 5]>,
    pads: BTreeMap<String, PadSummary>,
    classes: BTreeMap<String, Group>,
    objects: BTreeMap<String, Group>,
    /// What the simulation dropped; where one made all the recordings.
    simulation: Option<SimulationReport>,
}

#[derive(Debug, Default, Serialize)]
struct PadSummary {
    /// Grasps in which the pad has a contact.
    n_grasps: usize,
    /// Active cells in those.
    n_contacts: usize,
}

#[derive(Debug, Default, Serialize)]
struct Group {
    n_grasps: usize,
    n_stable: usize,
    /// Stable by nature, before any balance: of the simulation's candidates.
    natural_stable_rate: Option<f64>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let summary = summarise(&hand, &recordings)?;
    if arguments.json {
        print_line(&serde_json::to_string_pretty(&summary)?)?;
    } else {
        print_summary(&hand, &summary)?;
    }
    Ok(Outcome::Done)
}

fn summarise(hand: &Hand, recordings: &[PathBuf]) -> anyhow::Result<Summary> {
    let mut summary = Summary { hand: hand.name.clone(), n_recordings: recordings.len(), ..Summary::default() };
    for pad in &hand.pads {
        summary.pads.insert(pad.name.clone(), PadSummary::default());
    }
    let mut qualities: Vec<(f64, f64)> = Vec::new();
    let mut reports: Option<SimulationReport> = Some(SimulationReport::default());
    for path in recordings {
        let reader = RecordingReader::open(path)?;
        summary.made_by.insert(reader.info().made_by.clone());
        match (report_in(&reader, path)?, &mut reports) {
            (Some(report), Some(reports)) => reports.add(&report),
            _ => reports = None,
        }
        let mut last: Option<TactileFrame> = None;
        let mut seen = BTreeSet::new();
        for record in reader {
            let (topic, record) = record?;
            *summary.n_samples.entry(topic).or_default() += 1;
            match record {
                Record::Tactile(frame) => {
                    if last.as_ref().is_some_and(|last| last.grasp_id != frame.message.grasp_id) {
                        summary.count_contacts(hand, last.take());
                    }
                    summary.n_grasps += usize::from(seen.insert(frame.message.grasp_id));
                    if frame.message.phase == Phase::Settled || last.is_none() {
                        last = Some(frame.message);
                    }
                }
                Record::Truth(truth) => {
                    summary.count_truth(&truth.message, &mut qualities);
                }
                _ => {}
            }
        }
        summary.count_contacts(hand, last);
    }
    summary.simulation = reports;
    summary.add_natural_rates();
    summary.n_force_closure = qualities.len();
    summary.epsilon_quantiles = quantiles(qualities.iter().map(|(epsilon, _)| *epsilon).collect());
    summary.volume_quantiles = quantiles(qualities.iter().map(|(_, volume)| *volume).collect());
    Ok(summary)
}

impl Summary {
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
        let found = contacts_from_frame(hand, 0, &frame.joints_rad, &frame.cells_newtons, &mut contacts);
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

fn print_summary(hand: &Hand, summary: &Summary) -> anyhow::Result<()> {
    let share = |part: usize, whole: usize| percent((whole > 0).then(|| part as f64 / whole as f64));
    let quantiles = |quantiles: Option<[f64; 5]>| {
        quantiles.map_or("n/a".into(), |values| values.map(|value| format!("{value:.3}")).join("  "))
    };
    let samples: Vec<_> = summary.n_samples.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
    let mut lines = vec![
        ("recordings", summary.n_recordings.to_string()),
        ("hand", summary.hand.clone()),
        ("samples", samples.join(", ")),
        ("grasps", format!("{}, {} with truth", summary.n_grasps, summary.n_with_truth)),
        ("stable", share(summary.n_stable, summary.n_with_truth)),
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
    ];
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
                "{} candidates, {} stable by nature; {} without touch, {} over their quota, {} hull failures",
                report.n_candidates,
                share(report.n_judged_stable, report.n_judged),
                report.n_without_touch,
                report.n_over_quota,
                report.n_hull_failures
            ),
        ));
    }
    for (what, value) in lines {
        print_line(&format!("{what:<17} {value}"))?;
    }
    if !summary.classes.is_empty() {
        print_line("\nclass              grasps    stable  by nature")?;
    }
    for (class, group) in &summary.classes {
        let natural = percent(group.natural_stable_rate);
        let stable = share(group.n_stable, group.n_grasps);
        print_line(&format!("{class:<16} {:>8} {stable:>9} {natural:>10}", group.n_grasps))?;
    }
    Ok(())
}
