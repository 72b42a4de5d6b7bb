//! What there is to draw: links as triangles, cells as rectangles.

use blindgrasp_mesh::Mesh;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_stages::hand::{Hand, Link};
use nalgebra::Point3;

/// Cells are drawn so far above their pad, so that the pad's surface doesn't hide them.
const CELL_LIFT_M: f64 = 0.0004;
/// How much of a cell's size is drawn: the gap shows where a cell ends.
const CELL_PART: f64 = 0.9;

/// All shapes of a link, in the link's frame.
pub(super) fn link_mesh(link: &Link) -> Mesh {
    let mut mesh = Mesh::default();
    for shape in &link.shapes {
        let mut of_shape = mesh_of_shape(&shape.rounded());
        of_shape.transform(&shape.link_from_shape);
        mesh.append(&of_shape);
    }
    mesh
}

/// Every cell's corners in its link's frame, a little above the pad, counter-clockwise seen from outside.
pub(super) fn cells_in_link(hand: &Hand) -> Vec<[Point3<f64>; 4]> {
    hand.cells()
        .map(|(_, cell)| {
            let normal = cell.normal_in_link.into_inner();
            let along = cell.along_in_link.into_inner();
            let half_along = along * (CELL_PART * cell.size_m[0] / 2.0);
            let half_across = normal.cross(&along) * (CELL_PART * cell.size_m[1] / 2.0);
            let centre = cell.position_in_link_m + normal * CELL_LIFT_M;
            [
                centre - half_along - half_across,
                centre + half_along - half_across,
                centre + half_along + half_across,
                centre - half_along + half_across,
            ]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use parry3d_f64::math::Vector;
    use parry3d_f64::shape::SharedShape;
    use std::path::Path;

    #[test]
    fn shapes_have_their_size_and_face_outwards() {
        for (shape, volume_m3) in [
            (SharedShape::cuboid(0.01, 0.02, 0.03), 8.0 * 6e-6),
            (SharedShape::cylinder(0.05, 0.02), std::f64::consts::PI * 4e-5),
            (SharedShape::ball(0.03), 4.0 / 3.0 * std::f64::consts::PI * 2.7e-5),
            (SharedShape::cone(0.05, 0.02), std::f64::consts::PI * 4e-5 / 3.0),
            (SharedShape::capsule_y(0.03, 0.02), std::f64::consts::PI * (2.4e-5 + 4.0 / 3.0 * 8e-6)),
        ] {
            let mesh = mesh_of_shape(&shape);
            let found_m3 = mesh.signed_volume_m3().abs();
            assert!((found_m3 / volume_m3 - 1.0).abs() < 0.02, "{:?}: {found_m3} {volume_m3}", shape.shape_type());
        }
        assert!(mesh_of_shape(&SharedShape::halfspace(Vector::new(0.0, 0.0, 1.0))).triangles.is_empty());
    }

    #[test]
    fn a_cells_corners_surround_it_and_face_outwards() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        for ((_, cell), corners) in hand.cells().zip(cells_in_link(&hand)) {
            let middle = corners.iter().map(|corner| corner.coords).sum::<Vector3<f64>>() / 4.0;
            assert!(
                (middle - cell.position_in_link_m.coords - cell.normal_in_link.into_inner() * CELL_LIFT_M).norm()
                    < 1e-12
            );
            let outwards = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])).normalize();
            assert!((outwards - cell.normal_in_link.into_inner()).norm() < 1e-9);
        }
    }
}
