//! What is wrong with a mesh, and the repair of what can be repaired.
//!
//! Holes are not filled, overlaps not cut and nothing is moved: [`super::mass`] copes with both.

use std::collections::HashSet;

use nalgebra::Point3;
use serde::Serialize;

use super::topology::{EdgeUse, balance, by_edge, caps, determinant, edge_uses, winding_number};
use super::{Mesh, MeshError};

/// The shortest an object may be along its longest side.
pub const LEAST_SIZE_M: f64 = 0.005;
/// The longest an object may be along its longest side.
pub const GREATEST_SIZE_M: f64 = 2.0;

/// A triangle whose height is below this share of its longest side has no area: its corners are in a line.
const FLAT: f64 = 1e-10;
/// A patch that, capped, holds less than this share of its box's diagonal to the third has no inside.
const NO_INSIDE: f64 = 1e-9;
/// How many points of a patch are asked whether they are inside another.
const N_SAMPLES: usize = 16;

/// What was wrong with a mesh, and what the repair did.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct MeshSurvey {
    /// Vertices, after the repair.
    pub n_vertices: usize,
    /// Triangles, after the repair.
    pub n_triangles: usize,
    /// Dropped: vertices that belong to no triangle.
    pub n_unused_vertices: usize,
    /// Dropped: triangles whose corners coincide or are in a line.
    pub n_zero_area: usize,
    /// Dropped: triangles with the same three corners as another, whatever their order.
    pub n_duplicate_triangles: usize,
    /// Turned round: triangles that faced the wrong way.
    pub n_misoriented: usize,
    /// Edges of one triangle only: the rims of holes.
    pub n_open_edges: usize,
    /// Edges that more than two triangles share.
    pub n_crowded_edges: usize,
    /// Edges that, after the repair, are not run through as often in one direction as in the other: those of rims, and
    /// those where no orientation fits.
    pub n_unbalanced_edges: usize,
    /// Parts of the surface, each connected over edges that exactly two triangles share.
    pub n_components: usize,
}

impl MeshSurvey {
    /// The surface, as repaired, separates an inside from an outside everywhere.
    pub fn is_closed(&self) -> bool {
        self.n_triangles > 0 && self.n_unbalanced_edges == 0
    }

    /// What a user should know of, in words.
    pub fn warnings(&self) -> Vec<String> {
        let n_unclear = self.n_unbalanced_edges.saturating_sub(self.n_open_edges);
        let lines = [
            (self.n_unused_vertices, "vertices belong to no triangle: dropped"),
            (self.n_zero_area, "triangles have no area: dropped"),
            (self.n_duplicate_triangles, "triangles lie on others with the same corners: dropped"),
            (self.n_misoriented, "triangles face the wrong way: turned round"),
            (self.n_open_edges, "edges are open: the surface has holes, over which flat caps are assumed"),
            (self.n_crowded_edges, "edges are shared by more than two triangles"),
            (n_unclear, "edges have an unclear side: inside and outside cannot be told there"),
        ];
        lines.into_iter().filter(|(n, _)| *n > 0).map(|(n, text)| format!("{n} {text}")).collect()
    }
}

/// Checks that an object, read with `scale`, is of a size that a hand can grasp.
///
/// # Errors
/// A longest side below [`LEAST_SIZE_M`] or above [`GREATEST_SIZE_M`], with the scales that would do.
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

/// Repairs a mesh and says what was wrong.
///
/// Zero-area triangles, duplicates and unused vertices are dropped. Each component is oriented consistently, as most of
/// its area is already, and then turned outwards; a component with holes as if capped. One inside another stays inwards
/// where it is a cavity: where it faces the other way than the component around it did in the file. One that faces the
/// same way is a solid within a solid, and counts once; one in a cavity is a solid again. Components without inside, like
/// a sheet, are left as they face.
pub fn repair(mesh: Mesh) -> (Mesh, MeshSurvey) {
    let mut survey = MeshSurvey::default();
    let mut triangles = distinct_triangles(&mesh, &mut survey);
    let uses = edge_uses(triangles.iter().copied());
    let patches = orient_patches(&mesh, &triangles, &uses);
    survey.n_components = patches.len();
    for edge in by_edge(&uses) {
        survey.n_open_edges += usize::from(edge.len() == 1);
        survey.n_crowded_edges += usize::from(edge.len() > 2);
    }
    for (patch, is_flipped) in patches.iter().zip(to_be_flipped(&patches)) {
        for oriented in &patch.triangles {
            let flip = oriented.is_flipped != is_flipped;
            survey.n_misoriented += usize::from(flip);
            if flip {
                triangles[oriented.triangle_idx].swap(1, 2);
            }
        }
    }
    survey.n_unbalanced_edges =
        by_edge(&edge_uses(triangles.iter().copied())).filter(|uses| balance(uses) != 0).count();
    // Only now, because a triangle without area may join its neighbours: three corners in a line where one long edge
    // meets two short ones.
    let n_before = triangles.len();
    triangles.retain(|triangle| !is_flat(&triangle.map(|idx| mesh.vertices_m[idx as usize])));
    survey.n_zero_area += n_before - triangles.len();
    let mesh = without_unused_vertices(&mesh, triangles);
    survey.n_vertices = mesh.vertices_m.len();
    survey.n_triangles = mesh.triangles.len();
    (mesh, survey)
}

/// A connected part of the surface, consistently oriented, the way most of its area is.
struct Patch {
    triangles: Vec<Oriented>,
    /// Triangles as oriented, and caps over the holes.
    surface: Vec<[Point3<f64>; 3]>,
    bounds: [Point3<f64>; 2],
    signed_volume_m3: f64,
}

struct Oriented {
    triangle_idx: usize,
    is_flipped: bool,
}

/// Drops triangles with coinciding corners, duplicates, and counts vertices that no triangle of the file names.
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

/// The patches, each flooded from its first triangle over the edges that two triangles share.
fn orient_patches(mesh: &Mesh, triangles: &[[u32; 3]], uses: &[EdgeUse]) -> Vec<Patch> {
    // Neighbour, and whether it runs along the common edge in the same direction, which it must not.
    let mut neighbours: Vec<Vec<(usize, bool)>> = vec![Vec::with_capacity(3); triangles.len()];
    for edge in by_edge(uses) {
        if let [a, b] = edge {
            let is_opposed = a.is_upwards == b.is_upwards;
            neighbours[a.triangle_idx].push((b.triangle_idx, is_opposed));
            neighbours[b.triangle_idx].push((a.triangle_idx, is_opposed));
        }
    }
    let mut is_reached = vec![false; triangles.len()];
    let mut patches = Vec::new();
    for first in 0..triangles.len() {
        if is_reached[first] {
            continue;
        }
        is_reached[first] = true;
        let mut members = vec![Oriented { triangle_idx: first, is_flipped: false }];
        let mut n_expanded = 0;
        while let Some(&Oriented { triangle_idx, is_flipped }) = members.get(n_expanded) {
            n_expanded += 1;
            for &(neighbour, is_opposed) in &neighbours[triangle_idx] {
                if !std::mem::replace(&mut is_reached[neighbour], true) {
                    members.push(Oriented { triangle_idx: neighbour, is_flipped: is_flipped != is_opposed });
                }
            }
        }
        patches.push(Patch::new(mesh, triangles, members));
    }
    patches
}

impl Patch {
    fn new(mesh: &Mesh, triangles: &[[u32; 3]], mut members: Vec<Oriented>) -> Patch {
        let corners = |triangle: [u32; 3]| triangle.map(|idx| mesh.vertices_m[idx as usize]);
        let area = |member: &Oriented| {
            let [a, b, c] = corners(triangles[member.triangle_idx]);
            (b - a).cross(&(c - a)).norm() * if member.is_flipped { -1.0 } else { 1.0 }
        };
        if members.iter().map(area).sum::<f64>() < 0.0 {
            members.iter_mut().for_each(|member| member.is_flipped = !member.is_flipped);
        }
        let turned: Vec<[u32; 3]> = members
            .iter()
            .map(|member| {
                let [a, b, c] = triangles[member.triangle_idx];
                if member.is_flipped { [a, c, b] } else { [a, b, c] }
            })
            .collect();
        let mut surface: Vec<_> = turned.iter().map(|triangle| corners(*triangle)).collect();
        surface.extend(caps(mesh, turned));
        let points = || surface.iter().flatten();
        let least = points().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let most = points().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        let signed_volume_m3 = surface.iter().map(|corners| determinant(corners, &least)).sum::<f64>() / 6.0;
        Patch { triangles: members, surface, bounds: [least, most], signed_volume_m3 }
    }

    fn has_inside(&self) -> bool {
        let [least, most] = self.bounds;
        self.signed_volume_m3.abs() > NO_INSIDE * (most - least).norm().powi(3)
    }

    /// Whether the other patch lies in this one's solid or cavity as a whole, by the winding number of this one around
    /// points spread over the other.
    fn surrounds(&self, other: &Patch) -> bool {
        let is_within = (0..3)
            .all(|axis| self.bounds[0][axis] <= other.bounds[0][axis] && other.bounds[1][axis] <= self.bounds[1][axis]);
        let step = other.triangles.len().div_ceil(N_SAMPLES);
        is_within
            && self.signed_volume_m3.abs() > other.signed_volume_m3.abs()
            && other.surface[..other.triangles.len()].iter().step_by(step).all(|[a, b, c]| {
                let centre = Point3::from((a.coords + b.coords + c.coords) / 3.0);
                winding_number(&self.surface, &centre).abs() > 0.5
            })
    }
}

/// Which patches must be turned round.
fn to_be_flipped(patches: &[Patch]) -> Vec<bool> {
    // From the outermost to the innermost, so that what is around a patch is decided before it.
    let mut order: Vec<usize> = (0..patches.len()).filter(|idx| patches[*idx].has_inside()).collect();
    order.sort_by(|a, b| patches[*b].signed_volume_m3.abs().total_cmp(&patches[*a].signed_volume_m3.abs()));
    let mut is_cavity = vec![false; patches.len()];
    let mut is_flipped = vec![false; patches.len()];
    for (rank, &idx) in order.iter().enumerate() {
        let patch = &patches[idx];
        let around = order[..rank].iter().rev().find(|other| patches[**other].surrounds(patch));
        is_cavity[idx] = around.is_some_and(|&around| {
            let faces_the_same_way = patches[around].signed_volume_m3.signum() == patch.signed_volume_m3.signum();
            !is_cavity[around] && !faces_the_same_way
        });
        is_flipped[idx] = (patch.signed_volume_m3 < 0.0) != is_cavity[idx];
    }
    is_flipped
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

/// To three digits.
fn rounded(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::super::tests::block;
    use super::*;

    fn cube() -> Mesh {
        block([0.0; 3], [1.0; 3])
    }

    fn inside_out(mut mesh: Mesh) -> Mesh {
        mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
        mesh
    }

    fn together(meshes: &[Mesh]) -> Mesh {
        let mut all = Mesh::default();
        meshes.iter().for_each(|mesh| all.append(mesh));
        all
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
    fn cavities_stay_and_solids_within_solids_too() {
        let [outer, inner, core] =
            [(0.0, 1.0), (0.25, 0.75), (0.4, 0.6)].map(|(least, most)| block([least; 3], [most; 3]));
        let hollow = together(&[outer.clone(), inside_out(inner.clone()), core.clone()]);
        let (volume, core_volume) = (1.0 - 0.125, 0.2_f64.powi(3));
        // As it is; all turned round; the core facing the wrong way.
        for (mesh, n_misoriented) in [
            (hollow.clone(), 0),
            (inside_out(hollow), 36),
            (together(&[outer.clone(), inside_out(inner.clone()), inside_out(core.clone())]), 12),
        ] {
            let (repaired, survey) = repair(mesh);
            assert!((repaired.signed_volume_m3() - volume - core_volume).abs() < 1e-12);
            assert_eq!((survey.n_misoriented, survey.n_components, survey.is_closed()), (n_misoriented, 3, true));
        }
        let (_, survey) = repair(together(&[outer.clone(), inner.clone()]));
        assert_eq!(survey.n_misoriented, 0, "a solid within a solid");
        // Beside, not within: what faces inwards is wrong.
        let beside = inside_out(block([2.0; 3], [2.5; 3]));
        let (repaired, survey) = repair(together(&[outer, beside]));
        assert_eq!(survey.n_misoriented, 12);
        assert!((repaired.signed_volume_m3() - 1.125).abs() < 1e-12);
    }

    #[test]
    fn corners_in_a_line_join_their_neighbours() {
        // A cube's edge 0-1 is split on one side only; a triangle without area fills the gap.
        let mut mesh = cube();
        let halved = mesh.triangles.iter().position(|triangle| triangle.contains(&0) && triangle.contains(&1));
        let halved = halved.expect("a triangle at the edge");
        let [a, b, c] = mesh.triangles[halved];
        let [a, b, c] = if a > 1 {
            [b, c, a]
        } else if b > 1 {
            [c, a, b]
        } else {
            [a, b, c]
        };
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
