//! `blindgrasp simulate`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{Outcome, check_output, number_in, percent, print_line};
use crate::diagnostics::print_diagnostic;
use crate::grasp::candidate::SimulatedGrasp;
use crate::grasp::objects::select;
use crate::grasp::simulator::{SimulateError, SimulationReport, SimulatorOptions, simulate};
use crate::hand::Hand;
use crate::message::{GraspTruth, Header, Recorded, Stamped, TactileFrame};
use crate::recording::{RecordingError, RecordingInfo, RecordingWriter};

/// Between the last frame of a grasp and the first of the next.
const PAUSE_NANOS: u64 = 100_000_000;

/// Simulate blind grasps, with their tactile frames and their true quality, and record them.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp simulate --objects train --grasps 1000 --seed 1 --out train.mcap\n\n\
                  The same seed and options give the same bytes, with any number of threads.")]
pub(super) struct Arguments {
    /// Pad layout (YAML) of the hand, or the name of a built-in one.
    #[arg(long, default_value = "barrett-bh8-280")]
    hand: PathBuf,
    /// Objects: train, held-out or all (builtin) of the built-in ones, or names and classes of them, separated by commas.
    #[arg(long, default_value = "all")]
    objects: String,
    /// How many grasps to record [default: 1000].
    #[arg(long)]
    grasps: Option<usize>,
    /// Everything random comes from it [default: 0].
    #[arg(long)]
    seed: Option<u64>,
    /// The share of stable grasps to keep (0 to 1), or natural for whatever comes [default: 0.48, the paper's].
    #[arg(long, value_parser = stable_fraction)]
    stable_fraction: Option<StableFraction>,
    /// Coulomb friction of every contact [default: 1.0, the paper's].
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-6..=100.0), allow_negative_numbers = true)]
    friction: Option<f64>,
    /// YAML file with any of the simulator's options (--print-options shows them all with their defaults).
    #[arg(long)]
    options: Option<PathBuf>,
    /// Print all options with the values they would have, as YAML, and stop.
    #[arg(long)]
    print_options: bool,
    /// Where to write the recording (MCAP).
    #[arg(long, required_unless_present = "print_options")]
    out: Option<PathBuf>,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let options = options(arguments)?;
    let out = match &arguments.out {
        Some(out) if !arguments.print_options => out,
        _ => {
            print_line(serde_saphyr::to_string(&options)?.trim_end())?;
            return Ok(Outcome::Done);
        }
    };
    let hand = Hand::load(&arguments.hand)?;
    let objects = select(&arguments.objects)?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    options.check()?;
    check_output(out, &[])?;
    let info = RecordingInfo {
        hand: hand.name.clone(),
        hand_id: hand.id(),
        made_by: format!("simulation of objects '{}' with {}", arguments.objects, serde_json::to_string(&options)?),
        version: env!("CARGO_PKG_VERSION").into(),
    };
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }
    let mut writer = GraspWriter::create(out, &info)?;
    let bar = ProgressBar::new(options.n_grasps as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} grasps, {per_sec}, {eta} left ({msg})") {
        bar.set_style(style);
    }
    let report = simulate(
        &hand,
        &objects,
        &options,
        |n_kept, n_tried| {
            bar.set_position(n_kept as u64);
            bar.set_message(format!("{n_tried} tried"));
        },
        |grasp| {
            if stop.load(Ordering::Relaxed) {
                bail!("interrupted after {} grasps: nothing is recorded", writer.n_grasps);
            }
            Ok(writer.write(grasp)?)
        },
    );
    bar.finish_and_clear();
    let report = report.map_err(|error| match error {
        SimulateError::Sink(error) => error,
        other => other.into(),
    })?;
    writer.finish()?;
    print_report(arguments.json, out, &report)?;
    Ok(Outcome::Done)
}

fn options(arguments: &Arguments) -> anyhow::Result<SimulatorOptions> {
    let mut options = match &arguments.options {
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| format!("options {}", path.display()))?;
            serde_saphyr::from_str(&text).with_context(|| format!("options {}", path.display()))?
        }
        None => SimulatorOptions::default(),
    };
    options.n_grasps = arguments.grasps.unwrap_or(options.n_grasps);
    options.seed = arguments.seed.unwrap_or(options.seed);
    options.friction = arguments.friction.unwrap_or(options.friction);
    if let Some(StableFraction(fraction)) = arguments.stable_fraction {
        options.stable_fraction = fraction;
    }
    Ok(options)
}

/// A share, or `None` for what comes by nature.
#[derive(Debug, Clone, Copy)]
struct StableFraction(Option<f64>);

fn stable_fraction(text: &str) -> Result<StableFraction, String> {
    match text {
        "natural" => Ok(StableFraction(None)),
        _ => number_in(text, 0.0..=1.0)
            .map(|fraction| StableFraction(Some(fraction)))
            .map_err(|expected| format!("{expected}, or natural")),
    }
}

/// Turns simulated grasps into a recording: numbers, times, headers.
struct GraspWriter {
    recording: RecordingWriter,
    header: Header,
    n_grasps: u64,
}

impl GraspWriter {
    fn create(path: &Path, info: &RecordingInfo) -> Result<Self, RecordingError> {
        let header = Header { hand_id: info.hand_id, ..Header::default() };
        Ok(GraspWriter { recording: RecordingWriter::create(path, info)?, header, n_grasps: 0 })
    }

    fn write(&mut self, grasp: SimulatedGrasp) -> Result<(), RecordingError> {
        let truth = Stamped { header: Header { seq: self.n_grasps, ..self.header }, message: grasp.truth };
        self.recording.write(GraspTruth::TOPIC, &truth)?;
        self.n_grasps += 1;
        let start_nanos = self.header.stamp_nanos;
        for timed in grasp.frames {
            self.header.stamp_nanos = start_nanos + timed.offset_nanos;
            self.recording.write(TactileFrame::TOPIC, &Stamped { header: self.header, message: timed.frame })?;
            self.header.seq += 1;
        }
        self.header.stamp_nanos += PAUSE_NANOS;
        Ok(())
    }

    fn finish(self) -> Result<(), RecordingError> {
        self.recording.finish().map(|_| ())
    }
}

fn print_report(json: bool, out: &Path, report: &SimulationReport) -> anyhow::Result<()> {
    if json {
        print_line(&serde_json::to_string_pretty(report)?)?;
        return Ok(());
    }
    let share = |part: usize, whole: usize| percent((whole > 0).then(|| part as f64 / whole as f64));
    for (what, value) in [
        ("recorded to", out.display().to_string()),
        ("grasps", format!("{}, {} stable", report.n_grasps, share(report.n_stable, report.n_grasps))),
        (
            "candidates",
            format!(
                "{} tried: {} without touch, {} over their quota, {} hull failures, {} joggled hulls",
                report.n_candidates,
                report.n_without_touch,
                report.n_over_quota,
                report.n_hull_failures,
                report.n_joggled
            ),
        ),
        ("stable by nature", share(report.n_judged_stable, report.n_judged)),
        (
            "unsensed",
            format!(
                "{} of the grasps have a contact that no cell feels, {} are not felt at all",
                share(report.n_with_unsensed_contacts, report.n_grasps),
                share(report.n_without_active_cell, report.n_grasps)
            ),
        ),
    ] {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(())
}
