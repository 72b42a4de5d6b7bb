//! `blindgrasp sensors`

use std::path::PathBuf;

use anyhow::bail;
use clap::{Args, Subcommand};
use indicatif::ProgressBar;
use serde_json::json;

use super::{Outcome, check_new, completions, print_line, print_text};
use blindgrasp_grasps::dataset::hand_of_all;
use blindgrasp_learning::sensors::{alarms, learn, read};
use blindgrasp_operator::text::counted;
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::sensors::{Described, SensorCheck};

/// Learn a healthy hand's sensors, or look for faults in recordings
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Learn(LearnArguments),
    Check(CheckArguments),
}

/// Learn how joints and cells of a healthy hand read.
///
/// Labels are not needed; objects are, so that grasps of one object are not taken for a fault. The operator contacts watches
/// the hand by the file (params: sensors).
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp sensors learn healthy.mcap --out sensors.json")]
struct LearnArguments {
    /// Recordings (MCAP) with all frames of 200 or more grasps; some thousand are good.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Seed of the faults that are put in.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where to write the sensor check.
    #[arg(short, long)]
    out: PathBuf,
    /// Replace a file of this name
    #[arg(long)]
    overwrite: bool,
}

/// Look for sensor faults in recordings: exit code 1 if there are some.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp sensors check sensors.json today.mcap --json")]
struct CheckArguments {
    /// A file of blindgrasp sensors learn.
    check: PathBuf,
    /// Recordings (MCAP), in the order in which they were made.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match &arguments.command {
        Command::Learn(arguments) => learn_check(arguments),
        Command::Check(arguments) => check(arguments),
    }
}

fn learn_check(arguments: &LearnArguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    check_new(&arguments.out, &recordings, arguments.overwrite)?;
    let grasps = read(&hand, &recordings)?;
    let bar = ProgressBar::new(0);
    let check = learn(&hand, &grasps, &recordings, arguments.seed, |n, of| {
        bar.set_length(of as u64);
        bar.set_position(n as u64);
    })?;
    bar.finish_and_clear();
    check.save(&arguments.out)?;
    let weak = check.detectors.iter().filter(|detector| detector.power < 0.5);
    print_line(&format!(
        "{}: {}, {}, {} of them weak",
        arguments.out.display(),
        counted(check.n_grasps, "grasp"),
        counted(check.detectors.len(), "detector"),
        weak.count()
    ))?;
    Ok(Outcome::Done)
}

fn check(arguments: &CheckArguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    let check = SensorCheck::load(&arguments.check, &hand)?;
    let grasps = read(&hand, &recordings)?;
    let alarms = alarms(&check, &hand, &grasps);
    let held: Vec<_> =
        grasps.iter().zip(&alarms).filter_map(|(grasp, alarm)| alarm.map(|fault| (grasp.grasp_id, fault))).collect();
    if arguments.json {
        let faults: Vec<_> = held
            .iter()
            .map(|(grasp_id, fault)| json!({"grasp_id": grasp_id, "fault": fault.kind(), "part": fault.part(&hand)}))
            .collect();
        print_text(&serde_json::to_string_pretty(&json!({"n_grasps": grasps.len(), "faults": faults}))?)?;
    } else {
        print_line(&counted(grasps.len(), "grasp"))?;
        // A fault that goes on is said once.
        for (idx, (grasp_id, fault)) in held.iter().enumerate() {
            if idx == 0 || held[idx - 1].1 != *fault {
                print_line(&format!("from grasp {grasp_id} on: {}", Described(*fault, &hand)))?;
            }
        }
    }
    if !held.is_empty() {
        bail!("{} of {} grasps have a sensor fault", held.len(), grasps.len());
    }
    Ok(Outcome::Done)
}
