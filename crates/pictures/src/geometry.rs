//! What there is to draw, as triangles: shapes, links, cells, arrows' directions; and how round a mesh looks.

use std::collections::HashMap;

use blindgrasp_mesh::Mesh;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_stages::hand::{Hand, Link};
use nalgebra::{Point3, Vector3};

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

/// Two triangles.
pub(super) fn quad_mesh(corners: [Point3<f64>; 4]) -> Mesh {
    Mesh { vertices_m: corners.to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]] }
}

/// The normals with which each triangle's corners are lit: the mean of the faces around the corner that meet this one
/// at less than `crease_rad`, by area, so that round things look round and edges stay sharp.
pub(super) fn corner_normals(mesh: &Mesh, crease_rad: f64) -> Vec<[Vector3<f64>; 3]> {
    // Corners are the same where they are at the same place: files often repeat them for each triangle.
    let mut place_of: HashMap<[i64; 3], usize> = HashMap::new();
    let places: Vec<usize> = mesh
        .vertices_m
        .iter()
        .map(|vertex| {
            let n_places = place_of.len();
            let key = std::array::from_fn(|axis| (vertex[axis] * 1e7).round() as i64);
            *place_of.entry(key).or_insert(n_places)
        })
        .collect();
    let mut around: Vec<Vec<usize>> = vec![Vec::new(); place_of.len()];
    let mut weighted: Vec<Vector3<f64>> = Vec::with_capacity(mesh.triangles.len());
    for (idx, triangle) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = triangle.map(|idx| mesh.vertices_m[idx as usize]);
        weighted.push((b - a).cross(&(c - a)));
        triangle.iter().for_each(|vertex| around[places[*vertex as usize]].push(idx));
    }
    let least_cosine = crease_rad.cos();
    mesh.triangles
        .iter()
        .enumerate()
        .map(|(idx, triangle)| {
            let own = mesh.normal(idx);
            triangle.map(|vertex| {
                let near = around[places[vertex as usize]]
                    .iter()
                    .map(|other| weighted[*other])
                    .filter(|other| own.dot(other) > least_cosine * other.norm());
                near.sum::<Vector3<f64>>().try_normalize(0.0).unwrap_or(own)
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
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
    fn a_box_has_sharp_edges_and_a_ball_has_none() {
        let block = mesh_of_shape(&SharedShape::cuboid(0.01, 0.02, 0.03));
        for (idx, normals) in corner_normals(&block, 0.6).into_iter().enumerate() {
            assert!(normals.iter().all(|normal| (normal - block.normal(idx)).norm() < 1e-9));
        }
        let ball = mesh_of_shape(&SharedShape::ball(0.05));
        for (corners, normals) in ball.corners().zip(corner_normals(&ball, 0.6)) {
            for (corner, normal) in corners.iter().zip(normals) {
                let outwards = corner.coords.normalize();
                assert!(normal.dot(&outwards).abs() > 0.98, "{corner} {normal}");
            }
        }
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
            assert!((quad_mesh(corners).normal(0) - cell.normal_in_link.into_inner()).norm() < 1e-9);
        }
    }
}
