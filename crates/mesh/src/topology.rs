//! The edges of triangles, and caps over the holes of a surface.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};

use crate::Mesh;

/// A triangle's use of one of its edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct EdgeUse {
    /// The edge: its vertices, the lower index first.
    pub(crate) ends: [u32; 2],
    pub(crate) triangle_idx: usize,
    /// Whether the triangle runs from the lower to the higher index.
    pub(crate) is_upwards: bool,
}

/// All edges of triangles, sorted, so that the uses of one edge are neighbours.
pub(crate) fn edge_uses(triangles: impl IntoIterator<Item = [u32; 3]>) -> Vec<EdgeUse> {
    let of_triangle = |(triangle_idx, [a, b, c]): (usize, [u32; 3])| {
        [[a, b], [b, c], [c, a]].map(|[from, to]| EdgeUse {
            ends: [from.min(to), from.max(to)],
            triangle_idx,
            is_upwards: from < to,
        })
    };
    let mut uses: Vec<EdgeUse> = triangles.into_iter().enumerate().flat_map(of_triangle).collect();
    uses.sort_unstable();
    uses
}

/// The uses, edge by edge.
pub(crate) fn by_edge(uses: &[EdgeUse]) -> impl Iterator<Item = &[EdgeUse]> {
    uses.chunk_by(|a, b| a.ends == b.ends)
}

/// How often more an edge is run through upwards than downwards. Around a closed surface every edge has 0.
pub(crate) fn balance(uses_of_edge: &[EdgeUse]) -> i64 {
    uses_of_edge.iter().map(|edge_use| if edge_use.is_upwards { 1 } else { -1 }).sum()
}

/// Triangles that close the holes of a surface: a fan over each rim from the rim's mean point.
///
/// The edges that do not cancel form closed rims for any surface (a boundary has no boundary). So surface and caps
/// together always wind around each point a whole number of times, also for edges shared by many triangles.
pub(crate) fn caps(mesh: &Mesh, triangles: impl IntoIterator<Item = [u32; 3]>) -> Vec<[Point3<f64>; 3]> {
    let uses = edge_uses(triangles);
    let rim: Vec<([u32; 2], i64)> = by_edge(&uses)
        .filter_map(|uses| Some((uses.first()?.ends, balance(uses))).filter(|(_, balance)| *balance != 0))
        .collect();
    let vertex = |idx: u32| mesh.vertices_m[idx as usize];
    // Numbers for the vertices of rims only: a patch's rim may be small against the mesh.
    let mut ranks: Vec<u32> = rim.iter().flat_map(|(ends, _)| *ends).collect();
    ranks.sort_unstable();
    ranks.dedup();
    let rank = |idx: u32| ranks.partition_point(|other| *other < idx);
    let mut rims = Groups::new(ranks.len());
    rim.iter().for_each(|([low, high], _)| rims.join(rank(*low), rank(*high)));
    let mut sums: BTreeMap<usize, (Vector3<f64>, f64)> = BTreeMap::new();
    for ([low, high], balance) in &rim {
        let weight = balance.unsigned_abs() as f64;
        let (sum, n) = sums.entry(rims.of(rank(*low))).or_default();
        *sum += (vertex(*low).coords + vertex(*high).coords) * weight;
        *n += 2.0 * weight;
    }
    let mut caps = Vec::new();
    for ([low, high], balance) in &rim {
        let (sum, n) = sums[&rims.of(rank(*low))];
        let middle = Point3::from(sum / n);
        let [from, to] = if *balance > 0 { [*high, *low] } else { [*low, *high] };
        let cap = [vertex(from), vertex(to), middle];
        caps.extend(std::iter::repeat_n(cap, balance.unsigned_abs() as usize));
    }
    caps
}

/// Six times the signed volume of the tetrahedron from `origin` to a triangle.
pub(crate) fn determinant([a, b, c]: &[Point3<f64>; 3], origin: &Point3<f64>) -> f64 {
    (a - origin).dot(&(b - origin).cross(&(c - origin)))
}

/// Numbers joined into groups (union-find).
pub(crate) struct Groups(Vec<usize>);

impl Groups {
    pub(crate) fn new(n: usize) -> Self {
        Groups((0..n).collect())
    }

    /// The number of one member stands for the group.
    pub(crate) fn of(&mut self, mut member: usize) -> usize {
        while self.0[member] != member {
            self.0[member] = self.0[self.0[member]];
            member = self.0[member];
        }
        member
    }

    pub(crate) fn join(&mut self, a: usize, b: usize) {
        let [a, b] = [self.of(a), self.of(b)];
        self.0[a.max(b)] = a.min(b);
    }
}
