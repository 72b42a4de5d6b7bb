//! Pads unrolled flat, so that a page can draw each cell as a rectangle in the colour of its force.

use nalgebra::Vector3;
use serde::Serialize;

use super::scene::rounded;
use blindgrasp_stages::hand::{Cell, Pad};

/// Cells whose coordinates differ by less are in one row.
const SAME_ROW_M: f64 = 0.0005;

/// A pad laid flat, looked at from outside; up is away from the link's joint.
#[derive(Serialize)]
pub(super) struct FlatPad {
    /// Each cell: left, top, width, height.
    cells_m: Vec<[f64; 4]>,
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
    let cells_m = cells.into_iter().map(|cell| cell.map(rounded)).collect();
    FlatPad { cells_m, width_m: rounded(width_m), height_m: rounded(height_m) }
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

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_stages::hand::Hand;
    use std::path::Path;

    #[test]
    fn a_curved_pad_keeps_its_length_and_points_up() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let palm = flatten(&hand.pads[0]);
        // Seven cells of 10 mm at a pitch of 11 mm; four of 9.7 mm at 10.6 mm.
        assert!((palm.width_m - 0.076).abs() < 1e-9 && (palm.height_m - 0.0415).abs() < 1e-9);
        let finger = flatten(&hand.pads[1]);
        assert!((finger.width_m - (2.0 * 0.0052 + 0.0047)).abs() < 1e-5, "{}", finger.width_m);
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
        assert!(finger.cells_m[23][1] < finger.cells_m[0][1]);
    }
}
