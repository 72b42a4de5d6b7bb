//! `blindgrasp simulate`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use serde::Serialize;

use super::object_list::list;
use super::trials::physics;
use super::{Outcome, check_new, completions, number_in, percent, print_line, print_text, word};
use blindgrasp_cli::shard::Shard;
use blindgrasp_cli::stop_signal;
use blindgrasp_grasps::dataset::REPORT_METADATA;
use blindgrasp_grasps::shown_hand::shown_hand;
use blindgrasp_messages::{GraspScene, GraspTruth, Header, Record, Recorded, Stamped, TactileFrame};
use blindgrasp_objects::{objects_id, objects_named};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::{Manifest, RecordingError, RecordingInfo, RecordingReader, RecordingWriter, part_path};
use blindgrasp_simulator::candidate::SimulatedGrasp;
use blindgrasp_simulator::options::{LiftOptions, SimulatorOptions, Thresholds, check_hand};
use blindgrasp_simulator::protocol::Approach;
use blindgrasp_simulator::simulator::{Part, SimulateError, Simulation, SimulationReport};
use blindgrasp_simulator::trial::{PhysicsEngine, read_options};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;

/// Time between the last frame of a grasp and the first of the next.
const PAUSE_NANOS: u64 = 100_000_000;

/// Simulate grasps with labels, or list the objects
///
/// Simulate grasps and record them with their tactile frames and labels, or list the objects.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp simulate --objects train --grasps 1000 --seed 1 --out train.mcap\n  \
                  blindgrasp simulate --grasps 36960 --out data/paper               in parts; go on after Ctrl-C by the same command\n  \
                  blindgrasp simulate --grasps 1000 --label lift --out lifted.mcap  a grasp is stable if a lift keeps the object\n  \
                  blindgrasp simulate --grasps 1000000 --out data/big --shard 3/16  one of 16 machines\n  \
                  blindgrasp simulate --list --objects can --out /tmp/cans          the objects, and their meshes\n\n\
                  The same seed and options give the same bytes, with any number of threads and shards.")]
pub(super) struct Arguments {
    /// Pad layout (YAML) of the hand, or the name of a built-in one.
    #[arg(long, default_value = "barrett-bh8-280", add = completions::hands())]
    hand: PathBuf,
    /// Objects: train, held-out or all (builtin) of the built-in ones, names and classes separated by commas, or a folder
    /// of meshes. --list also takes paper, the objects of the paper's lift trials.
    #[arg(long, default_value = "all", add = completions::objects())]
    objects: String,
    /// Number of grasps to record [default: 1000].
    #[arg(long)]
    grasps: Option<usize>,
    /// Seed of everything random [default: 0].
    #[arg(long)]
    seed: Option<u64>,
    /// Meaning of stable: wrench-space, epsilon > 0.07 and volume > 0.1; lift, kept while lifted and shaken in physics,
    /// which takes 0.3 to 0.6 s of CPU time [default: wrench-space].
    #[arg(long, value_parser = label)]
    label: Option<Label>,
    /// Physics engine of lifts: rapier, the built-in one; mujoco (pip install 'blindgrasp[mujoco]') [default: rapier].
    #[arg(long, value_parser = physics)]
    physics: Option<PhysicsEngine>,
    /// Least epsilon and volume of a stable grasp with label wrench-space [default: 0.07,0.1, the paper's].
    #[arg(long, value_name = "EPSILON,VOLUME", value_parser = thresholds)]
    thresholds: Option<Thresholds>,
    /// Approach of the palm: blind, from anywhere; planned, by a planner that knows the object [default: blind].
    #[arg(long, value_parser = |text: &str| word::<Approach>(text, "blind or planned"))]
    protocol: Option<Approach>,
    /// Share of stable grasps to keep (0 to 1), or natural to keep the natural share [default: 0.48, the paper's].
    #[arg(long, value_parser = stable_fraction)]
    stable_fraction: Option<StableFraction>,
    /// Coulomb friction of every contact, and of the object in a lift [default: 1.0, the paper's].
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-6..=100.0), allow_negative_numbers = true)]
    friction: Option<f64>,
    /// YAML file with any of the simulator's options; --print-options prints them all with their defaults.
    #[arg(long)]
    options: Option<PathBuf>,
    /// Print all options with their values, as YAML, and stop.
    #[arg(long)]
    print_options: bool,
    /// List the objects instead; with --out, write them to a folder as meshes with a catalogue.csv.
    #[arg(long, conflicts_with_all = ["print_options", "shard", "grasps"])]
    list: bool,
    /// Output: a recording (a name that ends in .mcap), or a folder, in which each part becomes a recording.
    #[arg(short, long, required_unless_present_any = ["print_options", "list"])]
    out: Option<PathBuf>,
    /// Replace a recording of this name; a folder of parts is completed
    #[arg(long)]
    overwrite: bool,
    /// Make only the parts of shard I of N (0/N to N-1/N) of a folder; all shards together complete it.
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if arguments.list {
        return list(&arguments.objects, arguments.out.as_deref(), arguments.json);
    }
    let options = options(arguments)?;
    let out = match &arguments.out {
        Some(out) if !arguments.print_options => out,
        _ => {
            let all = AllOptions {
                label: (options.label == Label::default()).then_some(options.label),
                thresholds: options.thresholds.is_default().then_some(options.thresholds),
                // Without the label `lift` they must not be set.
                lift: (options.label == Label::Lift && options.lift.is_default()).then_some(&options.lift),
                options: &options,
            };
            print_text(serde_saphyr::to_string(&all)?.trim_end())?;
            return Ok(Outcome::Done);
        }
    };
    options.check()?;
    let is_file = out.extension().is_some_and(|extension| extension == "mcap");
    let is_of_another_kind =
        |extension: &str| ["csv", "json", "jsonl", "yaml", "html", "bag", "db3"].contains(&extension);
    if out.extension().and_then(|extension| extension.to_str()).is_some_and(is_of_another_kind) && !out.is_dir() {
        bail!(
            "{}: expected a name that ends in .mcap, or that of a folder; blindgrasp export writes a recording as JSON",
            out.display()
        );
    }
    if is_file && arguments.shard.is_some() {
        bail!("--shard needs a folder to share: --out {} names a file", out.display());
    }
    let hand = Hand::load(&arguments.hand)?;
    check_hand(&hand)?;
    let (objects, warnings) = objects_named(&arguments.objects)?;
    print_mesh_warnings(&warnings);
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let stop = stop_signal()?;
    let simulation = Simulation { hand: &hand, objects: &objects, options: &options };
    let job = Job::new(simulation, &arguments.objects, &stop)?;
    let shard = arguments.shard.unwrap_or_default();
    let report = if is_file { job.to_file(out, arguments.overwrite)? } else { job.to_folder(out, shard)? };
    match report {
        Some(report) => print_report(arguments.json, out, &report)?,
        None if arguments.json => print_line("null")?,
        None => print_line("this shard has no parts")?,
    }
    Ok(Outcome::Done)
}

/// Makes the parts of a simulation that its folder does not have.
///
/// # Errors
/// As of the command; it was interrupted.
pub(super) fn complete_folder(
    hand: &Hand,
    objects_name: &str,
    options: &SimulatorOptions,
    folder: &Path,
    stop: &AtomicBool,
) -> anyhow::Result<()> {
    let (objects, _) = objects_named(objects_name)?;
    let simulation = Simulation { hand, objects: &objects, options };
    Job::new(simulation, objects_name, stop)?.to_folder(folder, Shard::default())?;
    Ok(())
}

/// Most warnings of meshes that are printed.
const MAX_WARNINGS: usize = 10;

fn print_mesh_warnings(warnings: &[String]) {
    warnings.iter().take(MAX_WARNINGS).for_each(|warning| print_diagnostic(&format!("warning: {warning}")));
    if warnings.len() > MAX_WARNINGS {
        let n_more = warnings.len() - MAX_WARNINGS;
        print_diagnostic(&format!(
            "warning: and {n_more} more (blindgrasp simulate --list --objects FOLDER prints all)"
        ));
    }
}

/// Time between two lines of progress where there is no terminal.
const TELL_EVERY: Duration = Duration::from_secs(30);
/// The first line comes after so many grasps: it says how long the others will take.
const N_FIRST: usize = 10;
/// So many grasps without a stable one are told.
const MANY_UNSTABLE: usize = 50;

/// Advice where no candidate is stable.
fn none_is_stable(n: usize) -> String {
    format!(
        "none of the first {n} grasps is stable, but stable ones are asked for: --stable-fraction natural keeps grasps as they \
         come, --label lift and --thresholds call others stable; blindgrasp view HAND.yaml --out hand.html draws the hand: does it \
         close on what lies before +z of its palm frame?"
    )
}

/// Everything that all parts have in common.
struct Job<'a> {
    simulation: Simulation<'a>,
    /// As the user named them.
    objects: &'a str,
    info: RecordingInfo,
    stop: &'a AtomicBool,
}

impl<'a> Job<'a> {
    fn new(simulation: Simulation<'a>, objects: &'a str, stop: &'a AtomicBool) -> anyhow::Result<Self> {
        let Simulation { hand, options, .. } = simulation;
        let info = RecordingInfo {
            hand: hand.name.clone(),
            hand_id: hand.id(),
            made_by: format!("simulation of objects '{objects}' with {}", serde_json::to_string(options)?),
            version: env!("CARGO_PKG_VERSION").into(),
        };
        Ok(Job { simulation, objects, info, stop })
    }

    /// Makes one recording of all parts.
    fn to_file(&self, out: &Path, overwrite: bool) -> anyhow::Result<Option<SimulationReport>> {
        check_new(out, &[], overwrite)?;
        let mut writer = GraspWriter::create(out, &self.info, self.simulation.hand)?;
        let bar = progress_bar(self.simulation.options.n_grasps);
        let mut report = SimulationReport::default();
        for part in self.simulation.options.parts() {
            let (why, done) = match self.simulate(&part, &bar, &mut writer) {
                Ok(done) => {
                    report.add(&done);
                    continue;
                }
                Err(SimulateError::Stopped { done }) => ("interrupted".to_owned(), done),
                Err(ref error @ SimulateError::GaveUp { ref done, .. }) => (error.to_string(), done.clone()),
                Err(error) => return Err(error.into()),
            };
            report.add(&done);
            if report.n_grasps == 0 {
                bail!("{why}: nothing is recorded");
            }
            // What took hours must not take the place of a whole recording, nor be lost.
            let mut of_before = String::new();
            if let Ok(before) = out.canonicalize() {
                let mut names = (1..).map(|number| before.with_extension(format!("before-{number}.mcap")));
                let kept = names.find(|name| !name.exists()).unwrap_or(before.clone());
                std::fs::rename(&before, &kept).with_context(|| format!("cannot make {}", kept.display()))?;
                of_before = format!(", the recording that was there in {}", kept.display());
            }
            writer.finish(&report)?;
            bail!(
                "{why}: the first {} of {} grasps are in {}{of_before} (--out with a folder goes on from what is done)",
                report.n_grasps,
                self.simulation.options.n_grasps,
                out.display()
            );
        }
        bar.finish_and_clear();
        writer.finish(&report)?;
        Ok(Some(report))
    }

    /// Makes a recording of each part of a shard that is missing.
    fn to_folder(&self, out: &Path, shard: Shard) -> anyhow::Result<Option<SimulationReport>> {
        let Simulation { hand, objects, options } = self.simulation;
        let parts: Vec<Part> = options.parts().collect();
        let objects = (self.objects, objects_id(objects));
        let options = serde_json::to_value(options)?;
        Manifest::new((&hand.name, hand.description_id()), objects, options, parts.len()).claim(out)?;
        let mine: Vec<&Part> = parts.iter().filter(|part| shard.has(part.idx)).collect();
        let bar = progress_bar(mine.iter().map(|part| part.n_grasps).sum());
        let (there, missing): (Vec<&Part>, Vec<&Part>) = mine.iter().partition(|part| self.is_there(out, part));
        // Parts made before do not count for the rate.
        bar.set_position(there.iter().map(|part| part.n_grasps as u64).sum());
        bar.reset_eta();
        for (n_done, part) in missing.iter().enumerate() {
            let path = part_path(out, part.idx);
            let mut writer = GraspWriter::create(&path, &self.info, hand)?;
            let done = self.simulate(part, &bar, &mut writer).map_err(|error| match error {
                SimulateError::Stopped { .. } => anyhow::anyhow!(
                    "interrupted: {} of {} parts are in {}; the same command goes on from there",
                    there.len() + n_done,
                    mine.len(),
                    out.display()
                ),
                other => other.into(),
            })?;
            writer.finish(&done)?;
            if bar.is_hidden() {
                print_diagnostic(&format!("{}: {} of {} parts", path.display(), there.len() + n_done + 1, mine.len()));
            }
        }
        bar.finish_and_clear();
        let mut report = None;
        for part in &mine {
            let of_part = report_of(&part_path(out, part.idx))?;
            report.get_or_insert_with(SimulationReport::default).add(&of_part);
        }
        Ok(report)
    }

    fn simulate(
        &self,
        part: &Part,
        bar: &ProgressBar,
        writer: &mut GraspWriter,
    ) -> Result<SimulationReport, SimulateError<RecordingError>> {
        let before = bar.position();
        let options = self.simulation.options;
        let (begun, mut is_warned) = (Instant::now(), false);
        let (mut told_at, mut is_first) = (begun, before == 0);
        let report = self.simulation.part(
            part,
            || self.stop.load(Ordering::Relaxed),
            |report| {
                bar.set_position(before + report.n_grasps as u64);
                let lifted = if options.label == Label::Lift { " by lifts" } else { "" };
                bar.set_message(format!("part {}, {} tried{lifted}", part.idx, report.n_candidates));
                let wants_stable = options.stable_fraction.is_some_and(|fraction| fraction > 0.0);
                if !is_warned && wants_stable && report.n_judged >= MANY_UNSTABLE && report.n_judged_stable == 0 {
                    is_warned = true;
                    let n = report.n_judged;
                    bar.suspend(|| print_diagnostic(&none_is_stable(n)));
                }
                // Without a terminal there is no bar.
                let is_due = told_at.elapsed() >= TELL_EVERY || (is_first && report.n_grasps >= N_FIRST);
                if bar.is_hidden() && is_due {
                    (told_at, is_first) = (Instant::now(), false);
                    // Of this shard, if it is one.
                    let (n, n_all) = (before as usize + report.n_grasps, bar.length().unwrap_or(0));
                    let (n_tried, rate) = (report.n_candidates, 100.0 * report.natural_stable_rate());
                    let each = begun.elapsed() / report.n_grasps.max(1) as u32;
                    let left = HumanDuration(each * (n_all as usize).saturating_sub(n) as u32);
                    print_diagnostic(&format!(
                        "{n} of {n_all} grasps, about {left} left; part {}: {n_tried} candidates tried, {rate:.1} % stable before balancing",
                        part.idx
                    ));
                }
            },
            |grasp| writer.write(grasp),
        );
        if report.is_err() {
            bar.finish_and_clear();
        }
        report
    }

    /// Whether a part's recording is complete.
    fn is_there(&self, folder: &Path, part: &Part) -> bool {
        let path = part_path(folder, part.idx);
        if !path.is_file() {
            return false;
        }
        match report_of(&path) {
            Ok(report) if report.n_grasps == part.n_grasps => true,
            Ok(report) => {
                let (found, expected) = (report.n_grasps, part.n_grasps);
                print_diagnostic(&format!("{}: {found} grasps, expected {expected}: made again", path.display()));
                false
            }
            Err(error) => {
                print_diagnostic(&format!("{error:#}: made again"));
                false
            }
        }
    }
}

fn progress_bar(n_grasps: usize) -> ProgressBar {
    let bar = ProgressBar::new(n_grasps as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} grasps, {per_sec}, {eta} left ({msg})") {
        bar.set_style(style);
    }
    bar
}

fn report_of(recording: &Path) -> anyhow::Result<SimulationReport> {
    let reader = RecordingReader::open(recording)?;
    let report = reader.metadata(REPORT_METADATA).and_then(|metadata| metadata.get("report"));
    let report =
        report.with_context(|| format!("recording {}: expected one that a simulation made", recording.display()))?;
    serde_json::from_str(report).with_context(|| format!("recording {}: its simulation's report", recording.display()))
}

fn options(arguments: &Arguments) -> anyhow::Result<SimulatorOptions> {
    let mut options = match &arguments.options {
        Some(path) => read_options(path)?,
        None => SimulatorOptions::default(),
    };
    options.n_grasps = arguments.grasps.unwrap_or(options.n_grasps);
    options.seed = arguments.seed.unwrap_or(options.seed);
    options.label = arguments.label.unwrap_or(options.label);
    options.lift.engine = arguments.physics.unwrap_or(options.lift.engine);
    options.protocol.approach = arguments.protocol.unwrap_or(options.protocol.approach);
    options.thresholds = arguments.thresholds.unwrap_or(options.thresholds);
    options.friction = arguments.friction.unwrap_or(options.friction);
    if let Some(StableFraction(fraction)) = arguments.stable_fraction {
        options.stable_fraction = fraction;
    }
    Ok(options)
}

/// A share, or `None` for the natural share.
#[derive(Debug, Clone, Copy)]
struct StableFraction(Option<f64>);

fn stable_fraction(text: &str) -> Result<StableFraction, String> {
    match text {
        "natural" => Ok(StableFraction(None)),
        _ => number_in(text, 0.0..=1.0)
            .map(|fraction| StableFraction(Some(fraction)))
            .map_err(|expected| expected.replacen("expected ", "expected natural, or ", 1)),
    }
}

fn thresholds(text: &str) -> Result<Thresholds, String> {
    let numbers = text.split_once(',').and_then(|(epsilon, volume)| {
        Some(Thresholds { epsilon: epsilon.trim().parse().ok()?, volume: volume.trim().parse().ok()? })
    });
    numbers.ok_or_else(|| "expected two numbers, as in 0.03,0.02".into())
}

fn label(text: &str) -> Result<Label, String> {
    let found = Label::ALL.into_iter().find(|label| label.word() == text);
    found.ok_or_else(|| "expected wrench-space or lift".into())
}

/// The options, with the default of those that are otherwise written only if set.
#[derive(Debug, Serialize)]
struct AllOptions<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    label: Option<Label>,
    #[serde(skip_serializing_if = "Option::is_none")]
    thresholds: Option<Thresholds>,
    #[serde(skip_serializing_if = "Option::is_none")]
    lift: Option<&'a LiftOptions>,
    #[serde(flatten)]
    options: &'a SimulatorOptions,
}

/// Writes simulated grasps to a recording, with numbers, times and headers.
struct GraspWriter {
    recording: RecordingWriter,
    header: Header,
    n_grasps: u64,
}

impl GraspWriter {
    fn create(path: &Path, info: &RecordingInfo, hand: &Hand) -> Result<Self, RecordingError> {
        let header = Header { hand_id: info.hand_id, ..Header::default() };
        let mut recording = RecordingWriter::create(path, info)?;
        recording.show(shown_hand(hand))?;
        Ok(GraspWriter { recording, header, n_grasps: 0 })
    }

    fn write(&mut self, grasp: SimulatedGrasp) -> Result<(), RecordingError> {
        let truth = Stamped { header: Header { seq: self.n_grasps, ..self.header }, message: grasp.truth };
        self.recording.write(GraspTruth::TOPIC, &truth)?;
        let scene = Stamped { header: Header { seq: self.n_grasps, ..self.header }, message: grasp.scene };
        self.recording.write(GraspScene::TOPIC, &scene)?;
        self.n_grasps += 1;
        let start_nanos = self.header.stamp_nanos;
        for timed in grasp.frames {
            self.header.stamp_nanos = start_nanos + timed.offset_nanos;
            let frame = Record::Tactile(Stamped { header: self.header, message: timed.frame });
            self.recording.write_record(TactileFrame::TOPIC, &frame)?;
            self.header.seq += 1;
        }
        self.header.stamp_nanos += PAUSE_NANOS;
        Ok(())
    }

    fn finish(mut self, report: &SimulationReport) -> anyhow::Result<()> {
        let metadata = BTreeMap::from([("report".into(), serde_json::to_string(report)?)]);
        self.recording.write_metadata(REPORT_METADATA, metadata)?;
        self.recording.finish()?;
        Ok(())
    }
}

fn print_report(json: bool, out: &Path, report: &SimulationReport) -> anyhow::Result<()> {
    if json {
        print_text(&serde_json::to_string_pretty(report)?)?;
        return Ok(());
    }
    let Thresholds { epsilon, volume } = report.thresholds;
    let meaning = match report.label {
        Label::WrenchSpace => format!("wrench-space (stable: epsilon > {epsilon} and volume > {volume})"),
        label => label.meaning().into(),
    };
    let share = |part: usize, whole: usize| percent((whole > 0).then(|| part as f64 / whole as f64));
    for (what, value) in [
        ("recorded to", out.display().to_string()),
        ("label", meaning),
        ("grasps", format!("{}, {} stable", report.n_grasps, share(report.n_stable, report.n_grasps))),
        (
            "candidates",
            format!(
                "{} tried: {} without touch, {} over their quota, {} hull failures, {} joggled hulls, {} lifts that diverged",
                report.n_candidates,
                report.n_without_touch,
                report.n_over_quota,
                report.n_hull_failures,
                report.n_joggled,
                report.n_diverged
            ),
        ),
        ("natural share", format!("{} of the candidates are stable", share(report.n_judged_stable, report.n_judged))),
        (
            "unsensed",
            format!(
                "{} of the grasps have a contact that no cell feels, {} are not felt at all",
                share(report.n_with_unsensed_contacts, report.n_grasps),
                share(report.n_without_active_cell, report.n_grasps)
            ),
        ),
        (
            "self-collision",
            format!("links of the hand press on each other in {}", share(report.n_self_collisions, report.n_grasps)),
        ),
    ] {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(())
}
