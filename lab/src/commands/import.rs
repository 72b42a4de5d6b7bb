//! `blindgrasp import`

use std::path::PathBuf;

use clap::{ArgGroup, Args};

use super::{Outcome, check_new, completions, percent, print_line, print_text};
use blindgrasp_cli::frame_lines::{FrameLines, read_frames};
use blindgrasp_cli::joint;
use blindgrasp_learning::file_name;
use blindgrasp_learning::import::{Day, ImportOptions, ImportReport, Joints, import_frames, import_table};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_stages::hand::Hand;

/// Turn a table (CSV) or lines of frames into a recording
///
/// Turn a table of tactile readings (CSV), a robot's own or a published one, into a recording: one grasp a row, or one frame a row
/// with --grasp-column. Or the frames that a bridge sends as lines of JSON, with --lines.
#[derive(Debug, Args)]
#[command(
    group = ArgGroup::new("posture").args(["joints", "joint_columns", "lines"]).required(true),
    after_help = "Example: blindgrasp import grasps.csv --hand shadow-biotac-sp --joints palm_pitch=0 \\\n           \
                  --cells 'ff_biotac_*,mf_biotac_*,th_biotac_*' --label slipped --stable-value 0 \\\n           \
                  --group object --out grasps.mcap\n\n\
                  A row that is a grasp is one reading: its frames are alike, so the arbiter's votes always agree."
)]
pub(super) struct Arguments {
    /// The table: CSV with a header, in UTF-8, with commas, in the units of the hand's cells and in radians; blindgrasp.from_table
    /// in Python takes others. With --lines, the lines (- for stdin).
    table: PathBuf,
    /// The file has frames as lines of JSON, of a bridge (docs/hardware.md) or of blindgrasp export: phases, senses and outcomes
    /// of lifts are read as they are. Every line needs its grasp_id.
    #[arg(long, conflicts_with_all = ["cells", "joints", "joint_columns", "label", "stable_value", "group", "class", "day", "day_column",
        "grasp_column", "frames", "grasp_id_start"])]
    lines: bool,
    /// Pad layout (YAML) of the hand, or the name of a built-in one.
    #[arg(long, add = completions::hands())]
    hand: PathBuf,
    /// Columns of the cells, names or patterns with *, separated by commas; they fill the hand's pads in order.
    #[arg(long, required_unless_present = "lines", value_delimiter = ',', value_name = "PATTERNS")]
    cells: Vec<String>,
    /// The posture of all grasps, NAME=VALUE,…; joints not given are 0, or follow their coupling.
    #[arg(long, value_delimiter = ',', value_parser = joint, conflicts_with = "joint_columns")]
    joints: Vec<(String, f64)>,
    /// Columns of the joint angles, names or patterns with *, separated by commas, in the hand's order of joints.
    #[arg(long, value_delimiter = ',', value_name = "PATTERNS")]
    joint_columns: Vec<String>,
    /// Column of the label: how the grasp ended, one of two values.
    #[arg(long, value_name = "COLUMN", required_unless_present = "lines", default_value = "")]
    label: String,
    /// The label's value that means stable, to the letter.
    #[arg(
        long,
        value_name = "TEXT",
        allow_hyphen_values = true,
        required_unless_present = "lines",
        default_value = ""
    )]
    stable_value: String,
    /// Column of the object: training keeps the grasps of an object in one fold.
    #[arg(long, value_name = "COLUMN", required_unless_present = "lines", default_value = "")]
    group: String,
    /// Column of the object's class, by which evaluation lists results [default: the group's].
    #[arg(long, value_name = "COLUMN")]
    class: Option<String>,
    /// The day on which the table was recorded, a date or a name: its grasps have one baseline (train --day-baseline).
    #[arg(long, value_name = "NAME", conflicts_with = "day_column", value_parser = clap::builder::NonEmptyStringValueParser::new())]
    day: Option<String>,
    /// Column of the recording day, a date or a name in each row.
    #[arg(long, value_name = "COLUMN")]
    day_column: Option<String>,
    /// Each row is a frame: this column names its grasp. The rows of a grasp follow each other in order of time, 10 ms apart.
    #[arg(long, value_name = "COLUMN", conflicts_with = "frames")]
    grasp_column: Option<String>,
    /// Column of the frame's phase (open, closing, settled, squeezing …) [default: all frames are settled].
    #[arg(long, value_name = "COLUMN", requires = "grasp_column")]
    phase_column: Option<String>,
    /// Settled frames for each grasp, all with the same reading; the arbiter asks for 3 by default.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    frames: u32,
    /// Number of the first grasp, so that the grasps of several tables can be told apart.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=1 << 52))]
    grasp_id_start: u64,
    /// Where to write the recording (MCAP).
    #[arg(short, long)]
    out: PathBuf,
    /// Replace a file of this name
    #[arg(long)]
    overwrite: bool,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let hand = Hand::load(&arguments.hand)?;
    if arguments.lines {
        return import_lines(arguments, &hand);
    }
    check_new(&arguments.out, std::slice::from_ref(&arguments.table), arguments.overwrite)?;
    let options = ImportOptions {
        cells: arguments.cells.iter().map(|pattern| pattern.trim().into()).collect(),
        joints: joints(arguments, &hand)?,
        label: arguments.label.clone(),
        stable_value: arguments.stable_value.clone(),
        group: arguments.group.clone(),
        class: arguments.class.clone(),
        day: match (&arguments.day, &arguments.day_column) {
            (Some(day), _) => Day::Fixed(day.clone()),
            (None, Some(column)) => Day::Column(column.clone()),
            (None, None) => Day::Unknown,
        },
        grasp: arguments.grasp_column.clone(),
        phase: arguments.phase_column.clone(),
        n_frames: arguments.frames,
        first_grasp_id: arguments.grasp_id_start,
    };
    let report = import_table(&arguments.table, &hand, &options, &arguments.out)?;
    if arguments.json {
        print_text(&serde_json::to_string_pretty(&report)?)?;
    } else {
        print_report(arguments, &hand, &options, &report)?;
    }
    Ok(Outcome::Done)
}

fn import_lines(arguments: &Arguments, hand: &Hand) -> anyhow::Result<Outcome> {
    // Stdin has no name.
    let inputs: &[PathBuf] = if arguments.table.is_file() { std::slice::from_ref(&arguments.table) } else { &[] };
    check_new(&arguments.out, inputs, arguments.overwrite)?;
    let FrameLines { frames, truths, outcomes, label, n_left_out } = read_frames(&arguments.table, hand)?;
    let name = file_name(&arguments.table);
    let report = import_frames(&name, hand, &frames, &truths, &outcomes, label, &arguments.out)?;
    for (topic, n) in &n_left_out {
        print_diagnostic(&format!("left out: {} of {topic}", counted(*n, "sample")));
    }
    if arguments.json {
        print_text(&serde_json::to_string_pretty(&report)?)?;
        return Ok(Outcome::Done);
    }
    for (what, value) in [
        ("recorded to", arguments.out.display().to_string()),
        ("grasps", format!("{} in {} frames", report.n_grasps, report.n_frames)),
        ("outcomes", format!("{} kept, {} dropped", report.n_kept, report.n_dropped)),
        ("objects", format!("{} named", report.n_objects)),
        ("without frames", format!("{} labels or outcomes, which are left out", report.n_without_frames)),
        ("senses", if report.senses.is_empty() { "none".into() } else { report.senses.join(", ") }),
    ] {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(Outcome::Done)
}

fn joints(arguments: &Arguments, hand: &Hand) -> anyhow::Result<Joints> {
    if arguments.joint_columns.is_empty() {
        let given = arguments.joints.iter().map(|(name, value)| (name.as_str(), *value));
        return Ok(Joints::Fixed(hand.posture(given)?));
    }
    Ok(Joints::Columns(arguments.joint_columns.iter().map(|pattern| pattern.trim().into()).collect()))
}

fn print_report(
    arguments: &Arguments,
    hand: &Hand,
    options: &ImportOptions,
    report: &ImportReport,
) -> anyhow::Result<()> {
    let values: Vec<_> = report.label_values.iter().map(|(value, n)| format!("'{value}' {n}")).collect();
    let range = |columns: &[String]| match columns {
        [first, .., last] => format!("{first} … {last} ({})", columns.len()),
        _ => columns.join(", "),
    };
    let mut lines = vec![
        ("recorded to", arguments.out.display().to_string()),
        (
            "grasps",
            format!(
                "{} of {} rows, {} stable ({}: {})",
                report.n_grasps,
                report.n_rows,
                percent(Some(report.n_stable as f64 / report.n_grasps as f64)),
                options.label,
                values.join(", ")
            ),
        ),
        ("groups", format!("{} ({})", report.groups.len(), options.group)),
        ("cells", format!("in {}", report.cell_unit.word())),
    ];
    for (name, day) in &report.days {
        lines.push(("day", format!("{name} ({}), {}", day.day, counted(day.n_grasps, "grasp"))));
    }
    for pad in &report.pads {
        lines.push(("pad", format!("{:<12} {}", pad.pad, range(&pad.columns))));
    }
    let names = hand.joints.iter().map(|joint| &joint.name);
    let (what, joints): (_, Vec<_>) = match &options.joints {
        Joints::Fixed(joints) => {
            ("posture, rad", names.zip(joints).map(|(name, value)| format!("{name} {value}")).collect())
        }
        Joints::Columns(_) => {
            ("joints", names.zip(&report.joint_columns).map(|(name, column)| format!("{name} {column}")).collect())
        }
    };
    lines.push((what, joints.join(", ")));
    if report.n_missing > 0 {
        lines.push(("missing", format!("{} rows have missing readings, which count as 0", report.n_missing)));
    }
    if report.n_below_zero > 0 {
        lines.push(("below zero", format!("{} rows have readings below zero, which count as 0", report.n_below_zero)));
    }
    for warning in &report.warnings {
        lines.push(("warning", warning.clone()));
    }
    for (what, value) in lines {
        print_line(&format!("{what:<17} {value}"))?;
    }
    Ok(())
}
