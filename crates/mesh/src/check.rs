//! Checks a mesh, and repairs its triangles where that is unambiguous.
//!
//! The repair moves no vertex, fills no hole and cuts no overlap: [`crate::mass`] copes with holes and overlaps.

use std::collections::HashSet;

use nalgebra::Point3;
use serde::Serialize;

use crate::topology::{EdgeUse, balance, by_edge, caps, determinant, edge_uses};
use crate::{Mesh, MeshError};

/// Least length of an object's longest side, metres.
pub const LEAST_SIZE_M: f64 = 0.005;
/// Greatest length of an object's longest side, metres.
pub const GREATEST_SIZE_M: f64 = 2.0;

/// A triangle whose height is below this share of its longest side counts as one without area.
const FLAT: f64 = 1e-10;
/// The faults of a mesh, and what the repair did about them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct MeshSurvey {
    /// Vertices after the repair.
    pub n_vertices: usize,
    /// Triangles after the repair.
    pub n_triangles: usize,
    /// Dropped vertices, which belonged to no triangle.
    pub n_unused_vertices: usize,
    /// Dropped triangles whose corners coincide or lie in a line.
    pub n_zero_area: usize,
    /// Dropped triangles with the same three corners as another triangle, in any order.
    pub n_duplicate_triangles: usize,
    /// Triangles that faced the wrong way and were turned round.
    pub n_misoriented: usize,
    /// Edges of one triangle only: the rims of holes.
    pub n_open_edges: usize,
    /// Edges that more than two triangles share.
    pub n_crowded_edges: usize,
    /// Edges, after the repair, that triangles use more often in one direction than in the other: the rims of holes, and
    /// the edges at which no orientation fits.
    pub n_unbalanced_edges: usize,
    /// Parts of the surface, each connected over edges that exactly two triangles share.
    pub n_components: usize,
}

impl MeshSurvey {
    /// Whether the repaired surface separates an inside from an outside everywhere.
    pub fn is_closed(&self) -> bool {
        self.n_triangles > 0 && self.n_unbalanced_edges == 0
    }

    /// One line for each kind of fault.
    pub fn warnings(&self) -> Vec<String> {
        let n_unclear = self.n_unbalanced_edges.saturating_sub(self.n_open_edges);
        let lines = [
            (self.n_unused_vertices, "vertices belong to no triangle: dropped"),
            (self.n_zero_area, "triangles have no area: dropped"),
            (self.n_duplicate_triangles, "triangles lie on others with the same corners: dropped"),
            (self.n_misoriented, "triangles face the wrong way: turned round"),
            (self.n_open_edges, "edges are open: the surface has holes, which count as closed by flat caps"),
            (self.n_crowded_edges, "edges are shared by more than two triangles"),
            (n_unclear, "edges have an unclear side: inside and outside cannot be told there"),
        ];
        lines.into_iter().filter(|(n, _)| *n > 0).map(|(n, text)| format!("{n} {text}")).collect()
    }
}

/// Checks that an object, read with `scale`, is of a size that a hand can grasp.
///
/// # Errors
/// A longest side below [`LEAST_SIZE_M`] or above [`GREATEST_SIZE_M`]; the error names the scales that would do.
pub fn check_size(mesh: &Mesh, scale: f64) -> Result<(), MeshError> {
    const UNITS: [(&str, f64); 4] =
        [("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254), ("metres", 1.0)];
    let [least, most] = mesh.bounds();
    let longest_side_m = (most - least).max();
    if (LEAST_SIZE_M..=GREATEST_SIZE_M).contains(&longest_side_m) {
        return Ok(());
    }
    let suggestions: Vec<String> = UNITS
        .into_iter()
        .map(|(unit, other)| (unit, other, longest_side_m / scale * other))
        .filter(|(_, _, longest_side_m)| (LEAST_SIZE_M..=GREATEST_SIZE_M).contains(longest_side_m))
        .map(|(unit, other, longest_side_m)| {
            format!("if the file is in {unit} give scale {other} ({} m long)", rounded(longest_side_m))
        })
        .collect();
    let suggestion = if suggestions.is_empty() { String::new() } else { format!(": {}", suggestions.join(", ")) };
    Err(MeshError::Size { longest_side_m: rounded(longest_side_m), scale, suggestion })
}

/// Repairs a mesh and reports its faults.
///
/// Triangles without area, duplicates and unused vertices are dropped. Each component is oriented consistently, as most
/// of its area already is. If the surface, holes capped, then encloses a negative volume, all of it is turned round. A
/// component that faces inwards among others that face outwards stays as it is: it may be a cavity.
pub fn repair(mesh: Mesh) -> (Mesh, MeshSurvey) {
    let mut survey = MeshSurvey::default();
    let mut triangles = distinct_triangles(&mesh, &mut survey);
    let uses = edge_uses(triangles.iter().copied());
    for edge in by_edge(&uses) {
        survey.n_open_edges += usize::from(edge.len() == 1);
        survey.n_crowded_edges += usize::from(edge.len() > 2);
    }
    let as_read = triangles.clone();
    survey.n_components = orient_components(&mesh, &mut triangles, &uses);
    if capped_volume_m3(&mesh, &triangles) < 0.0 {
        triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
    }
    survey.n_misoriented = triangles.iter().zip(&as_read).filter(|(now, before)| now != before).count();
    survey.n_unbalanced_edges =
        by_edge(&edge_uses(triangles.iter().copied())).filter(|uses| balance(uses) != 0).count();
    // Only now, because a triangle without area may join its neighbours: its three corners may lie in a line where one
    // long edge meets two short ones.
    let n_before = triangles.len();
    triangles.retain(|triangle| !is_flat(&triangle.map(|idx| mesh.vertices_m[idx as usize])));
    survey.n_zero_area += n_before - triangles.len();
    let mesh = without_unused_vertices(&mesh, triangles);
    survey.n_vertices = mesh.vertices_m.len();
    survey.n_triangles = mesh.triangles.len();
    (mesh, survey)
}

/// Drops duplicates and triangles with coinciding corners, and counts the vertices that no triangle uses.
fn distinct_triangles(mesh: &Mesh, survey: &mut MeshSurvey) -> Vec<[u32; 3]> {
    let mut is_used = vec![false; mesh.vertices_m.len()];
    mesh.triangles.iter().flatten().for_each(|idx| is_used[*idx as usize] = true);
    survey.n_unused_vertices = is_used.iter().filter(|is_used| !**is_used).count();
    let mut seen = HashSet::with_capacity(mesh.triangles.len());
    let mut distinct = Vec::with_capacity(mesh.triangles.len());
    for triangle in &mesh.triangles {
        let mut sorted = *triangle;
        sorted.sort_unstable();
        if sorted[0] == sorted[1] || sorted[1] == sorted[2] {
            survey.n_zero_area += 1;
        } else if seen.insert(sorted) {
            distinct.push(*triangle);
        } else {
            survey.n_duplicate_triangles += 1;
        }
    }
    distinct
}

/// Turns triangles until neighbours over edges of exactly two triangles agree, each component the way that most of its
/// area faces. Returns the number of components.
fn orient_components(mesh: &Mesh, triangles: &mut [[u32; 3]], uses: &[EdgeUse]) -> usize {
    // A neighbour, and whether it uses the common edge in the same direction, which it must not.
    let mut neighbours: Vec<Vec<(usize, bool)>> = vec![Vec::with_capacity(3); triangles.len()];
    for edge in by_edge(uses) {
        if let [a, b] = edge {
            let is_opposed = a.is_upwards == b.is_upwards;
            neighbours[a.triangle_idx].push((b.triangle_idx, is_opposed));
            neighbours[b.triangle_idx].push((a.triangle_idx, is_opposed));
        }
    }
    let area = |[a, b, c]: [u32; 3]| {
        let [a, b, c] = [a, b, c].map(|idx| mesh.vertices_m[idx as usize]);
        (b - a).cross(&(c - a)).norm()
    };
    let mut is_reached = vec![false; triangles.len()];
    let mut n_components = 0;
    for first in 0..triangles.len() {
        if std::mem::replace(&mut is_reached[first], true) {
            continue;
        }
        n_components += 1;
        let mut members = vec![(first, false)];
        let mut n_expanded = 0;
        while let Some(&(triangle_idx, is_flipped)) = members.get(n_expanded) {
            n_expanded += 1;
            for &(neighbour, is_opposed) in &neighbours[triangle_idx] {
                if !std::mem::replace(&mut is_reached[neighbour], true) {
                    members.push((neighbour, is_flipped != is_opposed));
                }
            }
        }
        let unturned: f64 = members
            .iter()
            .map(|(idx, is_flipped)| if *is_flipped { -area(triangles[*idx]) } else { area(triangles[*idx]) })
            .sum();
        for (idx, is_flipped) in members {
            if is_flipped != (unturned < 0.0) {
                triangles[idx].swap(1, 2);
            }
        }
    }
    n_components
}

fn capped_volume_m3(mesh: &Mesh, triangles: &[[u32; 3]]) -> f64 {
    let origin = mesh.bounds()[0];
    let corners = triangles.iter().map(|triangle| triangle.map(|idx| mesh.vertices_m[idx as usize]));
    let surface = corners.chain(caps(mesh, triangles.iter().copied()));
    surface.map(|corners| determinant(&corners, &origin)).sum::<f64>() / 6.0
}

fn is_flat([a, b, c]: &[Point3<f64>; 3]) -> bool {
    let longest_squared = (b - a).norm_squared().max((c - b).norm_squared()).max((a - c).norm_squared());
    (b - a).cross(&(c - a)).norm() <= FLAT * longest_squared
}

fn without_unused_vertices(mesh: &Mesh, triangles: Vec<[u32; 3]>) -> Mesh {
    const UNUSED: u32 = u32::MAX;
    let mut new_idx = vec![UNUSED; mesh.vertices_m.len()];
    triangles.iter().flatten().for_each(|idx| new_idx[*idx as usize] = 0);
    let mut kept = Mesh::default();
    for (vertex, new_idx) in mesh.vertices_m.iter().zip(&mut new_idx).filter(|(_, idx)| **idx != UNUSED) {
        *new_idx = kept.vertices_m.len() as u32;
        kept.vertices_m.push(*vertex);
    }
    kept.triangles = triangles.into_iter().map(|triangle| triangle.map(|idx| new_idx[idx as usize])).collect();
    kept
}

/// Rounds to three digits.
fn rounded(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{block, inside_out, together};

    fn cube() -> Mesh {
        block([0.0; 3], [1.0; 3])
    }

    #[test]
    fn a_good_mesh_is_left_alone() {
        let (mesh, survey) = repair(cube());
        assert_eq!(mesh, cube());
        assert_eq!(survey, MeshSurvey { n_vertices: 8, n_triangles: 12, n_components: 1, ..MeshSurvey::default() });
        assert!(survey.is_closed() && survey.warnings().is_empty());
    }

    #[test]
    fn what_is_wrong_is_counted() {
        let mut mesh = inside_out(cube());
        mesh.vertices_m.push(Point3::new(5.0, 5.0, 5.0));
        // No area, unlike its neighbours, of which one is there already in another order.
        mesh.triangles.push([0, 1, 1]);
        mesh.triangles.push([mesh.triangles[3][2], mesh.triangles[3][1], mesh.triangles[3][0]]);
        // One face the right way round among eleven wrong ones.
        mesh.triangles[5].swap(0, 1);
        let (repaired, survey) = repair(mesh);
        assert!((repaired.signed_volume_m3() - 1.0).abs() < 1e-15);
        let expected = MeshSurvey {
            n_vertices: 8,
            n_triangles: 12,
            n_unused_vertices: 1,
            n_zero_area: 1,
            n_duplicate_triangles: 1,
            n_misoriented: 11,
            n_components: 1,
            ..MeshSurvey::default()
        };
        assert_eq!(survey, expected);
        assert!(survey.is_closed());
        assert_eq!(survey.warnings().len(), 4);
        assert_eq!(survey.warnings()[3], "11 triangles face the wrong way: turned round");
    }

    #[test]
    fn open_and_crowded_edges() {
        let mut open = inside_out(cube());
        open.triangles.truncate(10);
        let (repaired, survey) = repair(open);
        assert_eq!((survey.n_open_edges, survey.n_unbalanced_edges, survey.n_misoriented), (4, 4, 10));
        assert!(!survey.is_closed());
        assert!((0..10).all(|idx| repaired.normal(idx) == cube().normal(idx)));

        // Two cubes that share an edge, and a fin on one of its other edges.
        let mut two = together(&[cube(), block([1.0, 1.0, 0.0], [2.0, 2.0, 1.0])]);
        two.triangles.iter_mut().flatten().for_each(|idx| {
            *idx = match *idx {
                8 => 3,
                12 => 7,
                idx => idx,
            }
        });
        let (_, survey) = repair(two.clone());
        assert_eq!((survey.n_crowded_edges, survey.n_components, survey.n_unused_vertices), (1, 2, 2));
        assert!(survey.is_closed(), "{survey:?}");
        two.vertices_m.push(Point3::new(0.0, -1.0, 0.0));
        two.triangles.push([0, 1, 16]);
        let (_, survey) = repair(two);
        assert_eq!((survey.n_crowded_edges, survey.n_open_edges, survey.n_components), (2, 2, 3));
        assert!(!survey.is_closed());
    }

    #[test]
    fn a_moebius_strip_has_no_side() {
        let vertices_m = (0..10).map(|idx| Point3::new(f64::from(idx), f64::from(idx * idx), 1.0)).collect();
        // Five quads around; the last is joined with a twist.
        let rail = |idx: u32| if idx < 5 { [2 * idx, 2 * idx + 1] } else { [1, 0] };
        let triangles = (0..5)
            .flat_map(|idx| {
                let ([a, b], [c, d]) = (rail(idx), rail(idx + 1));
                [[a, c, b], [b, c, d]]
            })
            .collect();
        let (_, survey) = repair(Mesh { vertices_m, triangles });
        assert_eq!(survey.n_open_edges, 10);
        assert!(survey.n_unbalanced_edges > 10, "{survey:?}");
        assert!(survey.warnings().iter().any(|line| line.contains("unclear side")), "{survey:?}");
    }

    #[test]
    fn a_cavity_stays_and_a_mesh_inside_out_is_turned() {
        let [outer, inner] = [(0.0, 1.0), (0.25, 0.75)].map(|(least, most)| block([least; 3], [most; 3]));
        let hollow = together(&[outer, inside_out(inner)]);
        for (mesh, n_misoriented) in [(hollow.clone(), 0), (inside_out(hollow), 24)] {
            let (repaired, survey) = repair(mesh);
            assert!((repaired.signed_volume_m3() - 0.875).abs() < 1e-12);
            assert_eq!((survey.n_misoriented, survey.n_components, survey.is_closed()), (n_misoriented, 2, true));
        }
    }

    #[test]
    fn corners_in_a_line_join_their_neighbours() {
        // A cube's edge 0-1 is split on one side only; a triangle without area fills the gap.
        let mut mesh = cube();
        let halved = mesh.triangles.iter().position(|triangle| triangle.contains(&0) && triangle.contains(&1));
        let halved = halved.expect("a triangle at the edge");
        while mesh.triangles[halved][2] <= 1 {
            mesh.triangles[halved].rotate_left(1);
        }
        let [a, b, c] = mesh.triangles[halved];
        mesh.vertices_m.push(Point3::new(0.5, 0.0, 0.0));
        mesh.triangles[halved] = [a, 8, c];
        mesh.triangles.push([8, b, c]);
        mesh.triangles.push([a, b, 8]);
        let (repaired, survey) = repair(mesh);
        assert_eq!((survey.n_zero_area, survey.n_open_edges, survey.n_misoriented), (1, 0, 0));
        assert!(survey.is_closed());
        assert_eq!(repaired.triangles.len(), 13);
    }

    #[test]
    fn sizes() {
        let sized = |side_m: f64| block([0.0; 3], [side_m, side_m / 2.0, side_m / 3.0]);
        for side_m in [0.006, 0.1, 1.9] {
            assert!(check_size(&sized(side_m), 1.0).is_ok());
        }
        let error = |side_m, scale| check_size(&sized(side_m), scale).expect_err("no object").to_string();
        assert_eq!(
            error(110.0, 1.0),
            "the object is 110 m long at scale 1, expected 0.005 to 2 m: if the file is in millimetres give scale 0.001 \
             (0.11 m long), if the file is in centimetres give scale 0.01 (1.1 m long)"
        );
        let small = error(0.00012, 0.001);
        assert!(small.ends_with("0.005 to 2 m: if the file is in metres give scale 1 (0.12 m long)"), "{small}");
        assert!(error(1e9, 1.0).ends_with("expected 0.005 to 2 m"));
    }
}
