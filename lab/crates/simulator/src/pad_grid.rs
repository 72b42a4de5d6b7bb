//! Grids of cells on the face of a link that meets the object as the hand closes: on the part of it that was touched.

use blindgrasp_stages::hand::{Cell, Hand, JointError, pose_from_isometry};
use nalgebra::{Point3, Unit, UnitVector3, Vector3};
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::query::Ray;
use parry3d_f64::shape::SharedShape;

use crate::mechanism::Mechanism;
use crate::touches::Touch;

/// Of a face with fewer than [`LEAST_TOUCHES`] touches, the cells take this part along each of its directions.
const SHARE_OF_FACE: f64 = 0.85;
/// A face is known by so many touches.
pub const LEAST_TOUCHES: usize = 4;
/// Of the touches of a face, this part at each end is not covered: objects seldom come there.
const SELDOM: f64 = 0.03;
/// A touch whose normal is within 45° of an axis belongs to the side of that axis.
const AXIS_COS: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// The cells reach this far beyond the outermost touches, metres, where the link does: about the radius of a patch.
const AROUND_TOUCHES_M: f64 = 0.003;
/// A cell that looks farther aside than this from the side that it is on is left out: it lies on a flank. 65°.
const LEAST_FACING: f64 = 0.42;

/// Cells in a grid of `rows` × `columns` on a link, on the side towards which it moves as the open hand closes. A link that does
/// not move has them on the side that was touched most, or that of the palm's +z. The grid covers the part of that side that was
/// touched, up to the link's edges. Its rows follow the longer direction of the side, outwards. Each cell lies on the link's
/// collision shapes, where a line against the direction of closing meets them. A row is as wide as the face under it. Cells that
/// would lie beside the shapes, or on their flanks, are left out.
///
/// # Errors
/// A link without collision shapes, or a grid of which no cell lies on them.
pub fn pad_grid(
    mechanism: &Mechanism<'_>,
    link_idx: usize,
    [n_rows, n_columns]: [usize; 2],
    touches: &[Touch],
    noise_threshold_newtons: f64,
) -> Result<Vec<Cell>, String> {
    let hand = mechanism.hand;
    let link = &hand.links[link_idx];
    if link.shapes.is_empty() {
        return Err("it has no <collision> in the URDF, on which cells could lie".into());
    }
    let inner = inner_direction(mechanism, link_idx, touches).map_err(|error| error.to_string())?;
    let (along, across) = face_directions(hand, link_idx, &inner);
    let touched = |touch: &&Touch| touch.link_idx == link_idx && touch.normal_in_link.dot(&inner) >= LEAST_FACING;
    let touched: Vec<Point3<f64>> = touches.iter().filter(touched).map(|touch| touch.point_in_link_m).collect();
    let row_range = covered(extent(hand, link_idx, &along), &along, &touched);
    let column_range = covered(extent(hand, link_idx, &across), &across, &touched);
    let row_ends = row_ends(row_range, &along, &touched, n_rows);
    let [_, outermost_m] = extent(hand, link_idx, &inner);
    let surfaces: Vec<(Pose, SharedShape)> =
        link.shapes.iter().map(|shape| (pose_from_isometry(&shape.link_from_shape), shape.rounded())).collect();
    // The face under a place of the grid.
    let face_at = |along_m: f64, across_m: f64| {
        let from = along.into_inner() * along_m + across.into_inner() * across_m;
        let met = meet(&surfaces, &(from + inner.into_inner() * (outermost_m + 0.01)), &inner)?;
        (met.1.dot(&inner) >= LEAST_FACING).then_some(met)
    };
    let mut cells: Vec<Cell> = Vec::new();
    for ends in row_ends.windows(2) {
        let row_m = (ends[0] + ends[1]) / 2.0;
        let Some([left_m, right_m]) = width_of_face(column_range, |across_m| face_at(row_m, across_m).is_some()) else {
            continue;
        };
        let pitch_m = (right_m - left_m) / n_columns as f64;
        for column in 0..n_columns {
            let Some((position_in_link_m, normal_in_link)) = face_at(row_m, left_m + pitch_m * (column as f64 + 0.5))
            else {
                continue;
            };
            let in_face = along.into_inner() - normal_in_link.into_inner() * normal_in_link.dot(&along);
            let Some(along_in_link) = Unit::try_new(in_face, 1e-6) else { continue };
            let size_m = [ends[1] - ends[0], pitch_m];
            cells.push(Cell { position_in_link_m, normal_in_link, along_in_link, size_m, noise_threshold_newtons });
        }
    }
    if cells.is_empty() {
        return Err(format!(
            "no cell of {n_rows} x {n_columns} lies on its shapes: give another size, or a table of cells with --cells"
        ));
    }
    Ok(cells)
}

/// The part of a face, from end to end along a direction, that cells cover: where it was touched.
fn covered([least, most]: [f64; 2], direction: &UnitVector3<f64>, touched: &[Point3<f64>]) -> [f64; 2] {
    if touched.len() < LEAST_TOUCHES {
        let bare = (most - least) * (1.0 - SHARE_OF_FACE) / 2.0;
        return [least + bare, most - bare];
    }
    let mut places: Vec<f64> = touched.iter().map(|point| point.coords.dot(direction)).collect();
    places.sort_by(f64::total_cmp);
    let n_seldom = (places.len() as f64 * SELDOM) as usize;
    let (first, last) = (places[n_seldom], places[places.len() - 1 - n_seldom]);
    [(first - AROUND_TOUCHES_M).max(least), (last + AROUND_TOUCHES_M).min(most)]
}

/// Where the rows begin and end. They are narrower where the face was touched often, by half at most.
fn row_ends([least, most]: [f64; 2], along: &UnitVector3<f64>, touched: &[Point3<f64>], n_rows: usize) -> Vec<f64> {
    let mut places: Vec<f64> = touched.iter().map(|point| point.coords.dot(along).clamp(least, most)).collect();
    places.sort_by(f64::total_cmp);
    let mut ends = vec![least];
    for row in 1..n_rows {
        let part = row as f64 / n_rows as f64;
        let even = least + (most - least) * part;
        let of_touches =
            if places.len() < LEAST_TOUCHES { even } else { places[(places.len() as f64 * part) as usize] };
        ends.push((even + of_touches) / 2.0);
    }
    ends.push(most);
    ends
}

/// The part of a range over which a row has a face under it.
fn width_of_face([least, most]: [f64; 2], has_face: impl Fn(f64) -> bool) -> Option<[f64; 2]> {
    const N_SLICES: usize = 64;
    let slice_m = (most - least) / N_SLICES as f64;
    let with_face = |idx: &usize| has_face(least + slice_m * (*idx as f64 + 0.5));
    let first = (0..N_SLICES).find(with_face)?;
    let last = (0..N_SLICES).rfind(with_face)?;
    Some([least + slice_m * first as f64, least + slice_m * (last + 1) as f64])
}

/// The mean direction in the link's frame in which its middle moves until the hand is half closed, along the nearest axis of the
/// frame, so that a grid lies flat on a box. Of a link that does not move it is the axis of most touches, or the palm's +z. Of
/// the joints that move the link, the nearest one that closes counts: those above it may spread the finger.
fn inner_direction(
    mechanism: &Mechanism<'_>,
    link_idx: usize,
    touches: &[Touch],
) -> Result<UnitVector3<f64>, JointError> {
    /// Postures from open to closed, of which the first half counts.
    const N_STEPS: usize = 20;
    let hand = mechanism.hand;
    let middle = middle(hand, link_idx);
    let nearest = mechanism.nearest_closing_joint(link_idx);
    let mut sum = Vector3::zeros();
    let postures = hand.closing_postures(&hand.open_joints(), N_STEPS);
    for posture in &postures[..=N_STEPS / 2] {
        let palm_from_links = hand.palm_from_links(posture)?;
        let palm_from_link = &palm_from_links[link_idx];
        let in_palm = nearest.map_or_else(Vector3::z, |joint| {
            let velocity =
                mechanism.velocity_of_joint(link_idx, &(palm_from_link * middle), joint.joint_idx, &palm_from_links);
            (velocity * joint.rate).try_normalize(1e-9).unwrap_or_else(Vector3::z)
        });
        sum += palm_from_link.rotation.inverse() * in_palm;
    }
    let mut best = (0, sum);
    let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
    let axes = axes.into_iter().flat_map(|axis| [axis, -axis]);
    if nearest.is_none() {
        for axis in axes.clone() {
            let faces_it = |touch: &&Touch| touch.link_idx == link_idx && touch.normal_in_link.dot(&axis) > AXIS_COS;
            let n_touches = touches.iter().filter(faces_it).count();
            if n_touches >= LEAST_TOUCHES && n_touches > best.0 {
                best = (n_touches, axis.into_inner());
            }
        }
    }
    Ok(axes.max_by(|a, b| a.dot(&best.1).total_cmp(&b.dot(&best.1))).unwrap_or_else(Vector3::z_axis))
}

/// The longer and the shorter direction of the face, the longer one away from the link's joint.
fn face_directions(hand: &Hand, link_idx: usize, inner: &UnitVector3<f64>) -> (UnitVector3<f64>, UnitVector3<f64>) {
    let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
    let mut across = axes.into_iter().filter(|axis| axis.dot(inner).abs() < 0.5);
    let pair = (across.next().unwrap_or(Vector3::x_axis()), across.next().unwrap_or(Vector3::y_axis()));
    let length =
        |direction: &UnitVector3<f64>| extent(hand, link_idx, direction).iter().fold(0.0, |sum, end| end - sum);
    let along = if length(&pair.0) > length(&pair.1) { pair.0 } else { pair.1 };
    let along = if middle(hand, link_idx).coords.dot(&along) < 0.0 { -along } else { along };
    (along, Unit::new_normalize(inner.cross(&along)))
}

fn middle(hand: &Hand, link_idx: usize) -> Point3<f64> {
    let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()];
    Point3::from(axes.map(|axis| extent(hand, link_idx, &axis).iter().sum::<f64>() / 2.0))
}

/// The least and the greatest coordinate of the link's shapes along a direction.
pub(crate) fn extent(hand: &Hand, link_idx: usize, direction: &UnitVector3<f64>) -> [f64; 2] {
    let mut ends = [f64::INFINITY, f64::NEG_INFINITY];
    for shape in &hand.links[link_idx].shapes {
        let in_shape = shape.link_from_shape.inverse() * direction;
        let Some(core) = shape.core.as_support_map() else { continue };
        let far = |sign: f64| {
            let point = core.local_support_point(Vector::new(in_shape.x, in_shape.y, in_shape.z) * sign);
            let point = shape.link_from_shape * Point3::new(point.x, point.y, point.z);
            point.coords.dot(direction) + sign * shape.edge_radius_m
        };
        ends = [ends[0].min(far(-1.0)), ends[1].max(far(1.0))];
    }
    ends
}

/// Where a line from `from` against `inner` meets the surfaces, and the normal there.
fn meet(
    surfaces: &[(Pose, SharedShape)],
    from: &Vector3<f64>,
    inner: &UnitVector3<f64>,
) -> Option<(Point3<f64>, UnitVector3<f64>)> {
    let ray = Ray::new(Vector::new(from.x, from.y, from.z), Vector::new(-inner.x, -inner.y, -inner.z));
    let hits = surfaces.iter().filter_map(|(pose, surface)| surface.cast_ray_and_get_normal(pose, &ray, 1.0, true));
    let hit = hits.min_by(|a, b| a.time_of_impact.total_cmp(&b.time_of_impact))?;
    let normal = Unit::try_new(Vector3::new(hit.normal.x, hit.normal.y, hit.normal.z), 1e-9)?;
    Some((Point3::from(from - inner.into_inner() * hit.time_of_impact), normal))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use blindgrasp_stages::hand::{BareHand, Pad};

    use super::*;
    use crate::touches::{all_touches, closings};

    /// A gripper whose fingers are thin at the tip, set back below it, and thick at the root, as those of the Franka hand.
    fn stepped_gripper() -> Hand {
        let mut urdf =
            "<robot name='stepped'><link name='base'><collision><origin xyz='0 0 0.03'/><geometry><box size='0.06 \
                        0.2 0.06'/></geometry></collision></link>"
                .to_owned();
        for (finger, side) in [("left", 1.0), ("right", -1.0)] {
            urdf += &format!("<link name='{finger}'>");
            for (y, z, size) in [
                (0.0185, 0.011, "0.022 0.015 0.02"),
                (0.0159, 0.0285, "0.0175 0.007 0.0235"),
                (0.0076, 0.0452, "0.0175 0.0152 0.0185"),
            ] {
                urdf += &format!(
                    "<collision><origin xyz='0 {} {z}'/><geometry><box size='{size}'/></geometry></collision>",
                    side * y
                );
            }
            urdf += &format!(
                "</link><joint name='{finger}_slide' type='prismatic'><parent link='base'/><child link='{finger}'/><origin \
                 xyz='0 0 0.0584'/><axis xyz='0 {side} 0'/><limit lower='0' upper='0.04'/>{}</joint>",
                if finger == "right" { "<mimic joint='left_slide'/>" } else { "" }
            );
        }
        let bare = BareHand {
            padded_links: vec!["left".into(), "right".into()],
            name: "stepped".into(),
            palm: None,
            open: [("left_slide".into(), 0.04)].into(),
            preshape_joints: Vec::new(),
        };
        Hand::without_cells(Path::new("stepped.urdf"), &(urdf + "</robot>"), &bare).expect("a hand")
    }

    /// The hand with a grid on each finger.
    fn with_grids(bare: &Hand, touches: &[Touch]) -> Hand {
        let mechanism = Mechanism::new(bare);
        let mut hand = bare.clone();
        for link_idx in [1, 2] {
            let cells = pad_grid(&mechanism, link_idx, [4, 3], touches, 0.05).expect("cells");
            hand.pads.push(Pad { link_idx, first_cell_idx: hand.n_cells(), cells, ..Pad::default() });
        }
        hand
    }

    #[test]
    fn a_grid_lies_where_the_hand_touches_objects() {
        let bare = stepped_gripper();
        let spread = with_grids(&bare, &[]);
        let touches = all_touches(closings(&spread, 0..48, 1).expect("closes"));
        let laid = with_grids(&bare, &touches);
        let felt = |hand: &Hand| {
            let closings = closings(hand, 0..24, 16).expect("closes");
            closings.iter().filter(|closing| closing.touches.iter().any(|touch| touch.is_felt)).count() as f64
                / closings.len() as f64
        };
        let (before, after) = (felt(&spread), felt(&laid));
        assert!(after > 0.75 && after > before + 0.3, "{before} {after}");
        for pad in &laid.pads {
            let outermost_m =
                pad.cells.iter().map(|cell| cell.position_in_link_m.z + cell.size_m[0] / 2.0).fold(0.0, f64::max);
            assert!(
                outermost_m > 0.05345,
                "the cells end {outermost_m} m from the finger's root, the tip is at 0.05445 m"
            );
        }
    }
}
