//! Pads as heat maps: each pad unrolled flat, each cell a rectangle in the colour of its force.

use nalgebra::Vector3;

use super::PictureError;
use super::colour::{SILENT_CELL, force_colour, hex, lightness};
use super::grasp::{Placed, active_newtons};
use super::svg::{Anchor, Svg, fit_text, px, text_width};
use blindgrasp_messages::TactileFrame;
use blindgrasp_stages::hand::{Cell, CellUnit, Hand, Pad};

/// Cells whose coordinates differ by less are in one row.
const SAME_ROW_M: f64 = 0.0005;
/// Room above a pad for its name and sum.
const CAPTION_HEIGHT: f64 = 34.0;
/// Between pads.
const GAP: f64 = 18.0;
/// A pad's caption needs this width, however narrow the pad.
const LEAST_WIDTH: f64 = 74.0;

/// On colours darker than this, numbers are white.
pub(super) const DARK: f64 = 0.68;

/// A pad laid flat, looked at from outside; up is away from the link's joint.
pub(super) struct FlatPad {
    /// Each cell: left, top, width, height, metres.
    cells: Vec<[f64; 4]>,
    width_m: f64,
    height_m: f64,
}

/// Unrolls a pad: rows and columns keep their distance along the surface, which a curved pad's projection would not.
pub(super) fn flatten(pad: &Pad) -> FlatPad {
    let n = pad.cells.len().max(1) as f64;
    let normal = pad.cells.iter().map(|cell| cell.normal_in_link.into_inner()).sum::<Vector3<f64>>();
    let normal = normal.try_normalize(1e-9).unwrap_or_else(Vector3::z);
    let middle = pad.cells.iter().map(|cell| cell.position_in_link_m.coords).sum::<Vector3<f64>>() / n;
    let flat = |direction: Vector3<f64>| direction - normal * direction.dot(&normal);
    let along = pad.cells.first().map_or_else(Vector3::x, |cell| flat(cell.along_in_link.into_inner()));
    let along = along.try_normalize(1e-9).unwrap_or_else(|| flat(Vector3::new(0.6, 0.0, 0.8)).normalize());
    let across = normal.cross(&along);
    let outwards = |direction: &Vector3<f64>| direction.dot(&middle);
    let up = if flat(middle).norm() < 0.001 {
        across
    } else {
        [along, -along, across, -across]
            .into_iter()
            .max_by(|a, b| outwards(a).total_cmp(&outwards(b)))
            .unwrap_or(across)
    };
    let right = up.cross(&normal);
    let (columns, rows) = (unrolled(&pad.cells, right, normal), unrolled(&pad.cells, up, normal));
    let mut cells: Vec<[f64; 4]> = pad
        .cells
        .iter()
        .zip(columns.into_iter().zip(rows))
        .map(|(cell, (x, y))| {
            let lies_across = cell.along_in_link.dot(&right).abs() > cell.along_in_link.dot(&up).abs();
            let [width, height] = if lies_across { cell.size_m } else { [cell.size_m[1], cell.size_m[0]] };
            [x - width / 2.0, -y - height / 2.0, width, height]
        })
        .collect();
    let least = |idx: usize| cells.iter().map(|cell| cell[idx]).fold(f64::MAX, f64::min);
    let most = |idx: usize| cells.iter().map(|cell| cell[idx] + cell[idx + 2]).fold(f64::MIN, f64::max);
    let (left, top, width_m, height_m) = (least(0), least(1), most(0) - least(0), most(1) - least(1));
    for cell in &mut cells {
        cell[0] -= left;
        cell[1] -= top;
    }
    FlatPad { cells, width_m, height_m }
}

/// Each cell's coordinate in `direction`, measured along the surface.
fn unrolled(cells: &[Cell], direction: Vector3<f64>, normal: Vector3<f64>) -> Vec<f64> {
    let coordinate = |cell: &Cell| cell.position_in_link_m.coords.dot(&direction);
    let mut order: Vec<usize> = (0..cells.len()).collect();
    order.sort_by(|a, b| coordinate(&cells[*a]).total_cmp(&coordinate(&cells[*b])));
    let rows = order.chunk_by(|a, b| coordinate(&cells[*b]) - coordinate(&cells[*a]) < SAME_ROW_M);
    let mut unrolled = vec![0.0; cells.len()];
    let (mut at, mut last): (f64, Option<&[usize]>) = (0.0, None);
    for row in rows {
        if let Some(last) = last {
            let between = |a: usize, b: usize| cells[b].position_in_link_m - cells[a].position_in_link_m;
            let pairs = last.iter().flat_map(|a| row.iter().map(move |b| between(*a, *b)));
            let step = pairs.min_by(|a, b| a.norm().total_cmp(&b.norm())).unwrap_or_default();
            at += step.dot(&direction).hypot(step.dot(&normal));
        }
        row.iter().for_each(|idx| unrolled[*idx] = at);
        last = Some(row);
    }
    unrolled
}

/// Where the pads of a hand are in a panel of this width, and how large a millimetre is.
struct Panel {
    pads: Vec<FlatPad>,
    /// Upper left corner of each pad's caption.
    at: Vec<[f64; 2]>,
    pixels_per_m: f64,
    height: f64,
}

fn panel(hand: &Hand, width: f64, most_height: f64) -> Panel {
    let pads: Vec<FlatPad> = hand.pads.iter().map(flatten).collect();
    let place = |pixels_per_m: f64| {
        let (mut at, mut x, mut y, mut row_height) = (Vec::new(), 0.0, 0.0, 0.0_f64);
        let mut widest = 0.0_f64;
        for pad in &pads {
            let pad_width = (pad.width_m * pixels_per_m).max(LEAST_WIDTH);
            if x > 0.0 && x + pad_width > width {
                (x, y, row_height) = (0.0, y + row_height + GAP, 0.0);
            }
            at.push([x, y]);
            x += pad_width + GAP;
            widest = widest.max(x - GAP);
            row_height = row_height.max(CAPTION_HEIGHT + pad.height_m * pixels_per_m);
        }
        (at, widest, y + row_height)
    };
    // The largest scale that fits, in steps of 2 %; 4.5 pixels a millimetre is enough for any cell's number.
    let mut pixels_per_m = 4500.0;
    loop {
        let (at, widest, height) = place(pixels_per_m);
        if (widest <= width && height <= most_height) || pixels_per_m < 100.0 {
            return Panel { pads, at, pixels_per_m, height };
        }
        pixels_per_m *= 0.98;
    }
}

/// Draws the heat maps of all pads with their scale at `[x, y]`; returns the height used.
pub(super) fn draw_pads(
    svg: &mut Svg,
    placed: &Placed<'_>,
    [x, y]: [f64; 2],
    width: f64,
    most_height: f64,
) -> Result<f64, PictureError> {
    const SCALE_HEIGHT: f64 = 44.0;
    let hand = placed.hand;
    let panel = panel(hand, width, most_height - SCALE_HEIGHT);
    for (pad_idx, (pad, [left, top])) in hand.pads.iter().zip(&panel.at).enumerate() {
        let (left, top) = (x + left, y + top);
        let flat = &panel.pads[pad_idx];
        let room = (flat.width_m * panel.pixels_per_m).max(LEAST_WIDTH);
        svg.text([left, top + 11.0], Anchor::Start, "strong", &fit_text(&pad.name.replace('_', " "), 13.0, room));
        let n_cells = pad.cells.len();
        let sum = if placed.grasp.is_hand_alone {
            format!("{n_cells} cells").replace("1 cells", "1 cell")
        } else {
            pad_summary(placed.frame, pad, hand.cell_unit)
        };
        // Where the numbers of newtons and cells would run into the next caption, the newtons have the room.
        let sum = match sum.split_once(',') {
            Some((newtons, _)) if text_width(&sum, 12.0) > room + GAP - 4.0 => newtons.into(),
            _ => sum,
        };
        svg.text_with([left, top + 27.0], Anchor::Start, "note", &sum, &[("data-pad", &pad_idx)]);
        draw_cells(svg, placed, pad, flat, [left, top + CAPTION_HEIGHT], panel.pixels_per_m);
    }
    if placed.grasp.is_hand_alone {
        return Ok(panel.height);
    }
    draw_scale(svg, [x, y + panel.height + 16.0], width.min(230.0), placed.scale_newtons, hand.cell_unit);
    Ok(panel.height + SCALE_HEIGHT)
}

/// Draws the cells of a pad at `[left, top]`, with their numbers where there is room.
fn draw_cells(svg: &mut Svg, placed: &Placed<'_>, pad: &Pad, flat: &FlatPad, [left, top]: [f64; 2], pixels_per_m: f64) {
    for (idx, (cell, [cell_x, cell_y, cell_width, cell_height])) in pad.cells.iter().zip(&flat.cells).enumerate() {
        let cell_idx = pad.first_cell_idx + idx;
        let corner = [left + cell_x * pixels_per_m, top + cell_y * pixels_per_m];
        let size = [cell_width * pixels_per_m, cell_height * pixels_per_m];
        let active = placed.active_newtons(cell_idx, cell.noise_threshold_newtons);
        let fill = active.map_or(SILENT_CELL, |newtons| force_colour(newtons / placed.scale_newtons));
        svg.element(
            "rect",
            &[
                ("x", &px(corner[0] + 0.5)),
                ("y", &px(corner[1] + 0.5)),
                ("width", &px((size[0] - 1.0).max(1.0))),
                ("height", &px((size[1] - 1.0).max(1.0))),
                ("rx", &1.5),
                ("fill", &hex(fill)),
                ("class", &"cell"),
                ("data-cell", &cell_idx),
            ],
        );
        if size[0] >= 15.0 && size[1] >= 10.5 {
            let label = match active {
                Some(newtons) if !placed.grasp.is_hand_alone => cell_label(newtons),
                _ => String::new(),
            };
            let class = if lightness(fill) < DARK { "cell-force on-dark" } else { "cell-force" };
            let at = [corner[0] + size[0] / 2.0, corner[1] + size[1] / 2.0 + 3.2];
            svg.text_with(at, Anchor::Middle, class, &label, &[("data-force", &cell_idx)]);
        }
    }
}

/// The sum of a pad's active cells, and how many they are.
pub(super) fn pad_summary(frame: &TactileFrame, pad: &Pad, unit: CellUnit) -> String {
    let active: Vec<f64> = pad
        .cells
        .iter()
        .enumerate()
        .filter_map(|(idx, cell)| active_newtons(frame, pad.first_cell_idx + idx, cell.noise_threshold_newtons))
        .collect();
    match active.len() {
        0 => "no contact".into(),
        n => {
            let sum = active.iter().sum::<f64>();
            format!("{sum:.1} {}, {n} cells", unit.symbol()).replace(" 1 cells", " 1 cell")
        }
    }
}

fn cell_label(newtons: f64) -> String {
    if newtons < 9.95 { format!("{newtons:.1}") } else { format!("{newtons:.0}") }
}

/// The colours of the forces from 0 to the largest.
fn draw_scale(svg: &mut Svg, [x, y]: [f64; 2], width: f64, largest_newtons: f64, unit: CellUnit) {
    const N_STEPS: usize = 46;
    let step = width / N_STEPS as f64;
    for idx in 0..N_STEPS {
        let fill = hex(force_colour((idx as f64 + 0.5) / N_STEPS as f64));
        svg.element(
            "rect",
            &[
                ("x", &px(x + idx as f64 * step)),
                ("y", &px(y)),
                // A little wider than the step: no seams.
                ("width", &px(step + 0.5)),
                ("height", &8),
                ("fill", &fill),
            ],
        );
    }
    let tick = |newtons: f64| format!("{}", (newtons * 1000.0).round() / 1000.0);
    svg.text([x, y + 23.0], Anchor::Start, "note", "0");
    svg.text([x + width / 2.0, y + 23.0], Anchor::Middle, "note", &tick(largest_newtons / 2.0));
    svg.text(
        [x + width, y + 23.0],
        Anchor::End,
        "note",
        &format!("{} {} a cell", tick(largest_newtons), unit.symbol()),
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn a_curved_pad_keeps_its_length_and_points_up() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let palm = flatten(&hand.pads[0]);
        // Seven cells of 10 mm at a pitch of 11 mm; four of 9.7 mm at 10.6 mm.
        assert!((palm.width_m - 0.076).abs() < 1e-9 && (palm.height_m - 0.0415).abs() < 1e-9);
        let finger = flatten(&hand.pads[1]);
        assert!((finger.width_m - (2.0 * 0.0052 + 0.0047)).abs() < 1e-6, "{}", finger.width_m);
        // The rows' distances along the profile, and half a cell at each end.
        let rows = [
            (22.25_f64, 9.5_f64),
            (28.25, 9.5),
            (34.2484, 9.41371),
            (40.2349, 9.05695),
            (46.1912, 8.35887),
            (51.0813, 7.1884),
            (53.8108, 5.14222),
            (55.4163, 2.13234),
        ];
        let length_mm: f64 = rows.windows(2).map(|pair| (pair[1].0 - pair[0].0).hypot(pair[1].1 - pair[0].1)).sum();
        let ends_mm = (hand.pads[1].cells[0].size_m, hand.pads[1].cells[23].size_m);
        let expected_m = length_mm / 1000.0 + (ends_mm.0[0].max(ends_mm.0[1]) + ends_mm.1[0].min(ends_mm.1[1])) / 2.0;
        assert!((finger.height_m - expected_m).abs() < 1e-3, "{} {expected_m}", finger.height_m);
        // The last row is the finger's tip: at the top.
        assert!(finger.cells[23][1] < finger.cells[0][1]);
    }
}
