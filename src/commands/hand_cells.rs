//! `blindgrasp info HAND.yaml`: the poses of a hand's tactile cells.

use std::path::Path;

use serde::Serialize;

use super::{Outcome, print_line, print_text};
use blindgrasp_stages::hand::{Cell, Hand};

#[derive(Serialize)]
struct CellRow<'a> {
    pad: &'a str,
    cell: usize,
    position_m: [f64; 3],
    normal: [f64; 3],
    link: &'a str,
    #[serde(flatten)]
    in_link: &'a Cell,
}

/// Whether the argument is a pad layout, and no recording: its name ends so, or it is the name of a built-in hand.
pub(super) fn is_hand(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "yaml" || extension == "yml")
        || (!path.exists() && path.extension().is_none() && Hand::load(path).is_ok())
}

/// Prints the positions and normals of the cells in the palm frame.
pub(super) fn print(hand: &Path, joints: &[(String, f64)], json: bool) -> anyhow::Result<Outcome> {
    let hand = Hand::load(hand)?;
    let joints = hand.posture(joints.iter().map(|(name, value)| (name.as_str(), *value)))?;
    let poses = hand.cells_in_palm(&joints)?;
    let mut rows = Vec::new();
    for (idx, ((pad_idx, in_link), pose)) in hand.cells().zip(poses).enumerate() {
        let pad = &hand.pads[pad_idx];
        rows.push(CellRow {
            pad: &pad.name,
            cell: idx - pad.first_cell_idx,
            position_m: pose.position_in_palm_m.coords.into(),
            normal: pose.normal_in_palm.into_inner().into(),
            link: &hand.links[pad.link_idx].name,
            in_link,
        });
    }
    if json {
        print_text(&serde_json::to_string_pretty(&rows)?)?;
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
