//! `blindgrasp hand`

use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde::Serialize;

use super::{Outcome, print_line};
use blindgrasp_stages::hand::Hand;

/// Look at a hand.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Cells(CellsArguments),
}

/// Print where a hand's tactile cells are for given joint angles, in the palm frame.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp hand cells hands/barrett-bh8-280.yaml --joints spread=0.5,finger_1=1.2")]
struct CellsArguments {
    /// Pad layout (YAML) of the hand, or the name of a built-in one.
    hand: PathBuf,
    /// Joint angles in radians, NAME=RADIANS,…; others are 0, or follow their coupling.
    #[arg(long, value_delimiter = ',', value_parser = joint)]
    joints: Vec<(String, f64)>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct CellRow<'a> {
    pad: &'a str,
    cell: usize,
    position_m: [f64; 3],
    normal: [f64; 3],
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let Command::Cells(arguments) = &arguments.command;
    let hand = Hand::load(&arguments.hand)?;
    let joints_rad = hand.posture(arguments.joints.iter().map(|(name, value)| (name.as_str(), *value)))?;
    let poses = hand.cells_in_palm(&joints_rad)?;
    let rows: Vec<CellRow<'_>> = hand
        .cells()
        .zip(poses)
        .enumerate()
        .map(|(idx, ((pad_idx, _), pose))| CellRow {
            pad: &hand.pads[pad_idx].name,
            cell: idx - hand.pads[pad_idx].first_cell_idx,
            position_m: pose.position_in_palm_m.coords.into(),
            normal: pose.normal_in_palm.into_inner().into(),
        })
        .collect();
    if arguments.json {
        print_line(&serde_json::to_string_pretty(&rows)?)?;
        return Ok(Outcome::Done);
    }
    print_line("pad        cell    x m       y m       z m       normal (palm frame)")?;
    for row in rows {
        let ([x, y, z], [nx, ny, nz]) = (row.position_m, row.normal);
        let (pad, cell) = (row.pad, row.cell);
        print_line(&format!("{pad:<10} {cell:>4} {x:>9.6} {y:>9.6} {z:>9.6}   {nx:>7.4} {ny:>7.4} {nz:>7.4}"))?;
    }
    Ok(Outcome::Done)
}

pub(super) fn joint(text: &str) -> Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=RADIANS")?;
    let value = value.trim().parse().map_err(|_| format!("'{value}' is not a number of radians"))?;
    Ok((name.trim().into(), value))
}
