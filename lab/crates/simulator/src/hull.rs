//! The convex hull of points in the six dimensions of a wrench: quickhull (Barber, Dobkin & Huhdanpaa 1996), of fixed
//! dimension and simplicial, made for degenerate input.
//!
//! Wrenches are degenerate by nature: the eight edges of a point contact lie in one plane, the twenty of a soft finger
//! in one three-dimensional flat, contacts coincide. Nearly every facet then has more than six points on it. So the
//! surface is kept on two levels:
//!
//! * a **plane** is a true facet of the hull: its equation and the points still outside it. Visibility is
//!   decided once per plane, so that all parts of a facet agree;
//! * a **simplex** is a 5-simplex of the triangulation of a plane. Simplices carry the topology: vertices and neighbours.
//!
//! A new point that lies on a plane within the tolerance extends that plane by simplices and leaves its equation alone;
//! simplices over ridges between the same two planes share one new plane. No equation is ever taken from a sliver that only
//! rounding made, which is where naive hulls break. The new plane is a mean of the ridge's two, so weighted that it goes
//! through the point, or, where that misses the simplex's vertices, the plane of the best determined of its simplices.
//!
//! A finished hull is checked: every point below every plane, every vertex on its planes, no fold in the surface. A
//! hull that fails a check, or whose topology broke on the way, is built again with another tolerance, and after those
//! from points moved at random (a joggle). It says so, and how far it may be off. The module does not merge planes that
//! meet at an angle within rounding, as Qhull does; they stay two that agree within the tolerance.

use std::cell::RefCell;

use thiserror::Error;

/// Dimension of the space: three of force, three of torque.
pub const DIM: usize = 6;

/// A simplex of the hull's surface. Facets with more than six points appear as several, with the same plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Facet {
    /// Outward unit normal n of the facet's plane.
    pub normal: [f64; DIM],
    /// Offset of the plane: inside the hull, n·x ≤ offset.
    pub offset: f64,
    /// Indices of the simplex' vertices in the input, ordered so that all simplices have the same orientation.
    pub vertex_idxs: [u32; DIM],
}

/// A convex hull of positive volume.
#[derive(Debug, Clone, PartialEq)]
pub struct Hull {
    /// The surface, triangulated.
    pub facets: Vec<Facet>,
    /// Number of distinct planes among the facets.
    pub n_planes: usize,
    /// Six-dimensional volume, in the product of the coordinates' units.
    pub volume: f64,
    /// How far a positive [`Hull::least_offset`] may be from the truth: no point is further outside any facet's plane,
    /// no vertex further below its facet's plane. When the origin is outside, the nearest facet may be a sliver and
    /// says little.
    pub uncertainty: f64,
    /// Number of attempts that broke before this one; 0 in the normal case.
    pub n_retries: u32,
    /// The largest distance by which any coordinate was moved to obtain this hull; `None` when the points were taken as
    /// they are, as always unless every tolerance failed.
    pub joggle: Option<f64>,
}

impl Hull {
    /// Signed distance from the origin to the nearest facet's plane; positive only if the origin is strictly inside.
    pub fn least_offset(&self) -> f64 {
        self.facets.iter().map(|facet| facet.offset).fold(f64::INFINITY, f64::min)
    }
}

/// Why there is no hull.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum HullError {
    /// Fewer points than a simplex has vertices.
    #[error("a hull in six dimensions needs at least {} points, found {found}", DIM + 1)]
    TooFewPoints { found: usize },
    /// A coordinate is NaN, infinite, or so large that a volume might not be finite.
    #[error("coordinate {axis} of point {point_idx} is {value}, expected a number between -{LIMIT:e} and {LIMIT:e}")]
    NonFinite { point_idx: usize, axis: usize, value: f64 },
    /// The points lie in a flat of fewer dimensions, within [`FLAT_TOLERANCE`]: the volume is zero.
    #[error("the points span {rank} of six dimensions, the next is {width:e} wide: the hull has no volume")]
    NotFullDimensional {
        /// Dimension of the flat.
        rank: usize,
        /// Largest distance of a point from that flat.
        width: f64,
    },
    /// The topology broke or the checks failed, for the points as given at every tolerance, and for every joggle.
    #[error(
        "no consistent hull of {n_points} points, last broken by: {reason}; \
         gave up after {n_attempts} attempts, with joggles of up to {largest_joggle:e}"
    )]
    Topology {
        n_points: usize,
        reason: &'static str,
        n_attempts: u32,
        /// Size of the largest joggle, in the coordinates' units.
        largest_joggle: f64,
    },
}

/// Points count as lying in a flat if no point is farther from it than this times the largest absolute coordinate.
///
/// Flat input is flat up to rounding (1e-15); the thinnest real wrench space has the torsion of a soft finger as its
/// width (1e-3). A thinner space has an epsilon below it, too.
pub const FLAT_TOLERANCE: f64 = 1e-8;

/// A point is on a plane when it is nearer than this times the largest absolute coordinate m; the others are tried in
/// turn when the hull breaks.
///
/// Rounding of one distance n·x - offset, two sums of six products of at most √6·m, is at most 2·8·√6·m·ε/2 ≈ 20·ε·m. A
/// plane through a simplex A times longer than high amplifies that by A. The normal case allows A = 2⁹, 2.3e-12: far
/// above the noise of degenerate input, far below any feature that is meant. It breaks on input with features of just
/// that size (contacts that nearly coincide). A finer tolerance then sees them as features, a coarser one sees past
/// them; what is left between 1e-9 and 1e-7 the coarsest settle.
const TOLERANCES: [f64; 7] = [
    ROUNDING * 512.0,
    ROUNDING * 32.0,
    ROUNDING * 8e3,
    ROUNDING * 64e3,
    ROUNDING * 512e3,
    ROUNDING * 4e6,
    ROUNDING * 32e6,
];

/// Rounding of a distance, per unit of the largest absolute coordinate.
const ROUNDING: f64 = 20.0 * f64::EPSILON;

/// Sizes of the joggles tried in turn after that, times the largest absolute coordinate. A joggle must be far coarser
/// than rounding: a sliver of its height must still determine a plane (1e-15 / 1e-7 = 1e-8).
const JOGGLES: [f64; 3] = [1e-8, 1e-7, 1e-6];

/// Largest coordinate: the sixth power of twice it, times any number of facets, is finite.
const LIMIT: f64 = 1e45;

/// Seed of the joggles: a fixed one, so that the same points always give the same hull.
const JOGGLE_SEED: u64 = 0x6a6f_6767_6c65;

/// Seed of the points' random words.
const WORD_SEED: u64 = 0x776f_7264;

/// A finished hull may miss the tolerance by this factor. A point is dropped against planes whose successors, through
/// vertices that were themselves on a plane only within the tolerance, need not be the same to the last bit.
const CHECK_SLACK: f64 = 4.0;

/// A blended plane may miss its simplex' vertices by this share of the tolerance: errors add up from blend to blend.
const BLEND_TOLERANCE: f64 = 1.0 / 16.0;

/// [`Plane::quality`] of a blended plane: better than any pivot.
const BLENDED: f64 = f64::INFINITY;

/// Largest share of the surface's cones that may be turned inside out: slivers of no size have no certain sign.
const FOLD_TOLERANCE: f64 = 1e-9;

/// The convex hull of points in six dimensions, and its volume.
///
/// The result depends on nothing but the points and their order, and on the order only within rounding.
///
/// # Errors
/// Too few points, coordinates that are not finite, points in a flat ([`HullError::NotFullDimensional`]); and
/// [`HullError::Topology`] when no attempt gave a hull that passes its checks.
pub fn convex_hull(points: &[[f64; DIM]]) -> Result<Hull, HullError> {
    first_unbroken(points, &TOLERANCES)
}

thread_local! {
    /// Hulls are made by the thousand: their memory is kept, per thread.
    static SURFACE: RefCell<Surface> = RefCell::default();
}

/// Tries the tolerances on the points as they are, then joggles.
fn first_unbroken(points: &[[f64; DIM]], tolerances: &[f64]) -> Result<Hull, HullError> {
    let scale = largest_coordinate(points)?;
    if points.len() <= DIM {
        return Err(HullError::TooFewPoints { found: points.len() });
    }
    let corners = initial_simplex(points, FLAT_TOLERANCE * scale)?;
    let build = |points: &[[f64; DIM]], relative_tolerance: f64, blends: bool| {
        SURFACE.with_borrow_mut(|surface| surface.build(points, &corners, relative_tolerance * scale, blends))
    };
    let mut n_retries = 0;
    let mut reason = "";
    for (tolerance, blends) in attempts(tolerances) {
        match build(points, tolerance, blends) {
            Ok(hull) => return Ok(Hull { n_retries, ..hull }),
            Err(Broken(why)) => reason = why,
        }
        n_retries += 1;
    }
    let mut random = SplitMix64(JOGGLE_SEED);
    for size in JOGGLES.map(|relative| relative * scale) {
        let joggled: Vec<_> = points.iter().map(|point| point.map(|x| x + size * random.symmetric())).collect();
        match build(&joggled, TOLERANCES[0], false) {
            Ok(hull) => {
                // A point moves by up to √6 times the movement of its coordinates.
                let uncertainty = hull.uncertainty + size * (DIM as f64).sqrt();
                return Ok(Hull { uncertainty, n_retries, joggle: Some(size), ..hull });
            }
            Err(Broken(why)) => reason = why,
        }
        n_retries += 1;
    }
    let largest_joggle = JOGGLES[JOGGLES.len() - 1] * scale;
    Err(HullError::Topology { n_points: points.len(), reason, n_attempts: n_retries, largest_joggle })
}

/// Tolerances in turn, and whether planes are blended. Blending is a matter of speed: before the tolerance is blamed, it
/// is tried without.
fn attempts(tolerances: &[f64]) -> impl Iterator<Item = (f64, bool)> {
    let blended = tolerances.iter().take(1).map(|tolerance| (*tolerance, true));
    blended.chain(tolerances.iter().map(|tolerance| (*tolerance, false)))
}

/// Why an attempt broke.
#[derive(Debug)]
struct Broken(&'static str);

/// No simplex, no point.
const NONE: u32 = u32::MAX;

/// A 5-simplex of the surface.
#[derive(Clone, Copy)]
struct Simplex {
    vertices: [u32; DIM],
    /// `neighbours[i]` is the simplex across the ridge opposite `vertices[i]`.
    neighbours: [u32; DIM],
    plane: u32,
    /// The last insertion that saw this simplex from outside; `NONE` when the simplex is free.
    seen_at: u32,
}

/// A facet's equation, and its state in the current insertion.
struct Plane {
    normal: [f64; DIM],
    offset: f64,
    /// How well the simplex that gave the equation determines it: the least pivot.
    quality: f64,
    alive: bool,
    n_simplices: u32,
    /// Any one of its simplices.
    simplex: u32,
    /// The last insertion that measured this plane, and its point's distance.
    measured_at: u32,
    distance: f64,
    n_reached: u32,
    /// The last insertion that gave this plane new simplices.
    grown_at: u32,
}

/// A point still outside the surface, with the plane it is furthest outside of.
#[derive(Clone, Copy)]
struct Outsider {
    point: u32,
    plane: u32,
    distance: f64,
}

/// A ridge at the border of the region that the new point sees.
#[derive(Clone, Copy)]
struct HorizonRidge {
    visible: u32,
    opposite: usize,
    hidden: u32,
}

/// The hull so far. Its memory is used again for the next hull.
#[derive(Default)]
struct Surface {
    points: Vec<[f64; DIM]>,
    tolerance: f64,
    blends: bool,
    interior: [f64; DIM],
    simplices: Vec<Simplex>,
    free_simplices: Vec<u32>,
    planes: Vec<Plane>,
    free_planes: Vec<u32>,
    outsiders: Vec<Outsider>,
    /// One random word per point: the exclusive or of a ridge's words is its hash.
    words: Vec<u64>,
    n_insertions: u32,
    ridges: Table,
    ridge_planes: Table,
    visible: Vec<u32>,
    horizon: Vec<HorizonRidge>,
    /// Planes that the current insertion removes, and those that it gives simplices.
    dead: Vec<u32>,
    grown: Vec<u32>,
}

impl Surface {
    fn build(
        &mut self,
        points: &[[f64; DIM]],
        corners: &[u32; DIM + 1],
        tolerance: f64,
        blends: bool,
    ) -> Result<Hull, Broken> {
        self.clear();
        points.iter().for_each(|point| self.push(*point));
        (self.tolerance, self.blends) = (tolerance, blends);
        self.start(corners)?;
        while let Some(outsider) = self.take_furthest() {
            self.insert(outsider)?;
        }
        self.check()?;
        self.finish()
    }

    fn push(&mut self, point: [f64; DIM]) {
        self.words.push(SplitMix64(WORD_SEED.wrapping_add(self.points.len() as u64)).next());
        self.points.push(point);
    }

    /// Keeps the memory, and the tables, whose stamps go on.
    fn clear(&mut self) {
        self.points.clear();
        self.simplices.clear();
        self.free_simplices.clear();
        self.planes.clear();
        self.free_planes.clear();
        self.outsiders.clear();
        self.words.clear();
        self.n_insertions = 0;
    }

    /// The surface of the first simplex, and every other point handed to a plane it is outside of.
    fn start(&mut self, corners: &[u32; DIM + 1]) -> Result<(), Broken> {
        self.interior = centroid(&self.points, corners);
        for omitted in 0..=DIM {
            // Neighbour k of the simplex without vertex i is the simplex without vertex k.
            let mut vertices = [0; DIM];
            let mut neighbours = [0; DIM];
            for (slot, kept) in (0..=DIM).filter(|kept| *kept != omitted).enumerate() {
                vertices[slot] = corners[kept];
                neighbours[slot] = kept as u32;
            }
            if omitted % 2 == 1 {
                // The boundary of a simplex alternates in orientation.
                vertices.swap(0, 1);
                neighbours.swap(0, 1);
            }
            let plane = self.plane_through(&vertices)?;
            self.planes.push(plane);
            self.simplices.push(Simplex { vertices, neighbours, plane: NONE, seen_at: 0 });
            self.attach(omitted as u32, omitted as u32);
        }
        let planes: Vec<u32> = (0..=DIM as u32).collect();
        for point in 0..self.points.len() as u32 {
            if !corners.contains(&point) {
                let outsider = self.outside_of(point, &planes);
                self.outsiders.extend(outsider);
            }
        }
        Ok(())
    }

    /// The furthest point first: it leaves the fewest facets to be made and thrown away, and the fewest slivers.
    fn take_furthest(&mut self) -> Option<Outsider> {
        let mut furthest = None;
        for (idx, outsider) in self.outsiders.iter().enumerate() {
            if furthest.is_none_or(|(_, distance)| outsider.distance > distance) {
                furthest = Some((idx, outsider.distance));
            }
        }
        furthest.map(|(idx, _)| self.outsiders.swap_remove(idx))
    }

    /// Adds a point outside: the region that it sees is replaced by the cone from it to the horizon.
    fn insert(&mut self, Outsider { point: apex, plane, .. }: Outsider) -> Result<(), Broken> {
        self.n_insertions += 1;
        self.look_from(apex, self.planes[plane as usize].simplex);
        self.dead.clear();
        for &simplex in &self.visible {
            let idx = self.simplices[simplex as usize].plane;
            let plane = &mut self.planes[idx as usize];
            // A plane is one connected facet, so it is seen as a whole or the surface is torn.
            if plane.n_reached != plane.n_simplices {
                return Err(Broken("a facet seen in part"));
            }
            if plane.alive {
                plane.alive = false;
                self.dead.push(idx);
            }
        }
        self.cone(apex)?;
        for &simplex in &self.visible {
            self.free_simplices.push(simplex);
            self.simplices[simplex as usize].seen_at = NONE;
        }
        // A point outside of a removed facet is outside of a new one, or inside.
        let mut outsiders = std::mem::take(&mut self.outsiders);
        outsiders.retain_mut(|outsider| {
            if self.planes[outsider.plane as usize].alive {
                return true;
            }
            let moved = self.outside_of(outsider.point, &self.grown);
            *outsider = moved.unwrap_or(*outsider);
            moved.is_some()
        });
        self.outsiders = outsiders;
        self.free_planes.extend_from_slice(&self.dead);
        Ok(())
    }

    /// Finds the connected simplices whose planes have the apex outside, by a search from one of them, and the ridges
    /// around them: `visible` and `horizon`.
    fn look_from(&mut self, apex: u32, first: u32) {
        let stamp = self.n_insertions;
        let apex = self.points[apex as usize];
        self.visible.clear();
        self.visible.push(first);
        self.horizon.clear();
        self.simplices[first as usize].seen_at = stamp;
        let plane = &mut self.planes[self.simplices[first as usize].plane as usize];
        (plane.measured_at, plane.distance, plane.n_reached) = (stamp, plane.distance_to(&apex), 1);
        let mut n_expanded = 0;
        while n_expanded < self.visible.len() {
            let simplex = self.visible[n_expanded];
            n_expanded += 1;
            let neighbours = self.simplices[simplex as usize].neighbours;
            for (opposite, &neighbour) in neighbours.iter().enumerate() {
                let Simplex { plane, seen_at, .. } = self.simplices[neighbour as usize];
                if seen_at == stamp {
                    continue;
                }
                let plane = &mut self.planes[plane as usize];
                if plane.measured_at != stamp {
                    (plane.measured_at, plane.distance, plane.n_reached) = (stamp, plane.distance_to(&apex), 0);
                }
                if plane.distance > self.tolerance {
                    plane.n_reached += 1;
                    self.simplices[neighbour as usize].seen_at = stamp;
                    self.visible.push(neighbour);
                } else {
                    self.horizon.push(HorizonRidge { visible: simplex, opposite, hidden: neighbour });
                }
            }
        }
    }

    /// Joins the apex to every ridge of the horizon. The planes that get simplices are then in `grown`.
    fn cone(&mut self, apex: u32) -> Result<(), Broken> {
        self.grown.clear();
        self.ridges.clear_for(self.horizon.len() * (DIM - 1));
        self.ridge_planes.clear_for(self.horizon.len());
        let mut n_unmatched = 0_i64;
        for ridge_idx in 0..self.horizon.len() {
            let HorizonRidge { visible, opposite, hidden } = self.horizon[ridge_idx];
            // Taking the removed vertex' place keeps the orientation.
            let Simplex { mut vertices, plane: visible_plane, .. } = self.simplices[visible as usize];
            vertices[opposite] = apex;
            let mut neighbours = [NONE; DIM];
            neighbours[opposite] = hidden;
            let hidden_plane = self.simplices[hidden as usize].plane;
            let plane = if self.planes[hidden_plane as usize].distance >= -self.tolerance {
                hidden_plane
            } else {
                self.plane_over_ridge(visible_plane, hidden_plane, &vertices)?
            };
            let idx = self.new_simplex(Simplex { vertices, neighbours, plane: NONE, seen_at: 0 });
            self.attach(idx, plane);
            if self.planes[plane as usize].grown_at != self.n_insertions {
                self.planes[plane as usize].grown_at = self.n_insertions;
                self.grown.push(plane);
            }
            let back = self.simplices[hidden as usize].neighbours.iter().position(|neighbour| *neighbour == visible);
            let back = back.ok_or(Broken("neighbours that do not know each other"))?;
            self.simplices[hidden as usize].neighbours[back] = idx;

            let ridge = (0..DIM).filter(|slot| *slot != opposite);
            let all = ridge.clone().fold(0, |hash, slot| hash ^ self.words[vertices[slot] as usize]);
            for slot in ridge {
                // The simplex across this side is the other one with the same four vertices besides the apex.
                let entry = self.ridges.entry(all ^ self.words[vertices[slot] as usize]);
                let here = idx * DIM as u32 + slot as u32;
                match *entry {
                    Table::EMPTY => {
                        *entry = here;
                        n_unmatched += 1;
                    }
                    Table::DONE => return Err(Broken("a ridge of more than two simplices")),
                    there => {
                        *entry = Table::DONE;
                        n_unmatched -= 1;
                        let (other, other_slot) = (there as usize / DIM, there as usize % DIM);
                        self.simplices[other].neighbours[other_slot] = idx;
                        self.simplices[idx as usize].neighbours[slot] = other as u32;
                    }
                }
            }
        }
        if n_unmatched != 0 {
            return Err(Broken("a ridge of one simplex"));
        }
        Ok(())
    }

    /// The plane through the apex and the ridge between two planes. All ridges between the two share it.
    fn plane_over_ridge(&mut self, visible: u32, hidden: u32, vertices: &[u32; DIM]) -> Result<u32, Broken> {
        let key = (u64::from(visible) << 32) | u64::from(hidden);
        let known = *self.ridge_planes.entry(key);
        if known == Table::EMPTY {
            let blended = if self.blends { self.blended_plane(visible, hidden, vertices) } else { None };
            let plane = match blended {
                Some(plane) => plane,
                None => self.plane_through(vertices)?,
            };
            let idx = self.new_plane(plane);
            *self.ridge_planes.entry(key) = idx;
            return Ok(idx);
        }
        if self.planes[known as usize].quality < BLENDED {
            // The best determined of the simplices gives the equation.
            let candidate = self.plane_through(vertices)?;
            let plane = &mut self.planes[known as usize];
            if candidate.quality > plane.quality {
                (plane.normal, plane.offset, plane.quality) = (candidate.normal, candidate.offset, candidate.quality);
            }
        }
        Ok(known)
    }

    /// The plane over a ridge as a mean of the ridge's two planes, so weighted that it goes through the apex. Both
    /// weights are positive, which makes it well determined where the simplex is a sliver. `None` when the simplex'
    /// vertices are not on it, by what the two planes' own errors add up to.
    fn blended_plane(&self, visible: u32, hidden: u32, vertices: &[u32; DIM]) -> Option<Plane> {
        let [visible, hidden] = [visible, hidden].map(|plane| &self.planes[plane as usize]);
        let (of_visible, of_hidden) = (-hidden.distance, visible.distance);
        let sum: [f64; DIM] =
            std::array::from_fn(|axis| of_visible * visible.normal[axis] + of_hidden * hidden.normal[axis]);
        let length = dot(&sum, &sum).sqrt();
        let normal = sum.map(|x| x / length);
        let offset = (of_visible * visible.offset + of_hidden * hidden.offset) / length;
        let limit = BLEND_TOLERANCE * self.tolerance;
        let mut off = vertices.iter().map(|vertex| (dot(&normal, &self.points[*vertex as usize]) - offset).abs());
        off.all(|off| off <= limit).then(|| Plane::new(normal, offset, BLENDED))
    }

    /// The plane that a point is furthest outside of. A point outside of no plane is inside or on the hull.
    fn outside_of(&self, point: u32, planes: &[u32]) -> Option<Outsider> {
        let position = self.points[point as usize];
        let mut furthest = Outsider { point, plane: NONE, distance: self.tolerance };
        for &plane in planes {
            let distance = self.planes[plane as usize].distance_to(&position);
            if distance > furthest.distance {
                furthest = Outsider { point, plane, distance };
            }
        }
        (furthest.plane != NONE).then_some(furthest)
    }

    fn new_simplex(&mut self, simplex: Simplex) -> u32 {
        match self.free_simplices.pop() {
            Some(idx) => {
                self.simplices[idx as usize] = simplex;
                idx
            }
            None => {
                self.simplices.push(simplex);
                (self.simplices.len() - 1) as u32
            }
        }
    }

    fn new_plane(&mut self, plane: Plane) -> u32 {
        match self.free_planes.pop() {
            Some(idx) => {
                self.planes[idx as usize] = plane;
                idx
            }
            None => {
                self.planes.push(plane);
                (self.planes.len() - 1) as u32
            }
        }
    }

    fn attach(&mut self, simplex: u32, plane: u32) {
        self.simplices[simplex as usize].plane = plane;
        self.planes[plane as usize].simplex = simplex;
        self.planes[plane as usize].n_simplices += 1;
    }

    /// The plane of a simplex, its normal away from the interior point.
    fn plane_through(&self, vertices: &[u32; DIM]) -> Result<Plane, Broken> {
        let corners = vertices.map(|vertex| self.points[vertex as usize]);
        let mut edges = [[0.0; DIM]; DIM - 1];
        for (edge, corner) in edges.iter_mut().zip(&corners[1..]) {
            *edge = difference(corner, &corners[0]);
        }
        let (mut normal, quality) = null_vector(&mut edges).ok_or(Broken("a simplex without a plane"))?;
        let mut offset = corners.iter().map(|corner| dot(&normal, corner)).sum::<f64>() / DIM as f64;
        let depth = offset - dot(&normal, &self.interior);
        if depth < 0.0 {
            normal = normal.map(|x| -x);
            offset = -offset;
        }
        if depth.abs() <= self.tolerance {
            return Err(Broken("a facet through the interior"));
        }
        Ok(Plane::new(normal, offset, quality))
    }

    /// Every point below every plane, every vertex on its plane.
    fn check(&self) -> Result<(), Broken> {
        let limit = CHECK_SLACK * self.tolerance;
        let blocks = blocks(&self.points);
        for plane in self.planes.iter().filter(|plane| plane.alive) {
            if greatest(&blocks, &plane.normal) - plane.offset > limit {
                return Err(Broken("a point outside the finished hull"));
            }
        }
        for simplex in self.simplices.iter().filter(|simplex| simplex.seen_at != NONE) {
            let plane = &self.planes[simplex.plane as usize];
            if simplex.vertices.iter().any(|vertex| plane.distance_to(&self.points[*vertex as usize]) < -limit) {
                return Err(Broken("a vertex below its facet"));
            }
        }
        Ok(())
    }

    /// Sums the cones from the interior point and lists the facets.
    fn finish(&self) -> Result<Hull, Broken> {
        let facets: Vec<Facet> = self
            .simplices
            .iter()
            .filter(|simplex| simplex.seen_at != NONE)
            .map(|simplex| {
                let Plane { normal, offset, .. } = self.planes[simplex.plane as usize];
                Facet { normal, offset, vertex_idxs: simplex.vertices }
            })
            .collect();
        let arms: Vec<[f64; DIM]> = self.points.iter().map(|point| difference(point, &self.interior)).collect();
        let (mut total, mut total_abs) = (0.0, 0.0_f64);
        for group in facets.chunks(LANES) {
            let mut rows = [[[0.0; LANES]; DIM]; DIM];
            for (lane, facet) in group.iter().enumerate() {
                for (row, vertex) in rows.iter_mut().zip(&facet.vertex_idxs) {
                    for (values, value) in row.iter_mut().zip(&arms[*vertex as usize]) {
                        values[lane] = *value;
                    }
                }
            }
            for cone in determinants(&rows) {
                total += cone;
                total_abs += cone.abs();
            }
        }
        // All simplices have the orientation of the first simplex, so that cones of the other sign are folds.
        if total_abs - total.abs() > FOLD_TOLERANCE * total_abs {
            return Err(Broken("a folded surface"));
        }
        let n_planes = self.planes.iter().filter(|plane| plane.alive).count();
        Ok(Hull {
            facets,
            n_planes,
            volume: total.abs() / FACTORIAL,
            uncertainty: CHECK_SLACK * self.tolerance,
            n_retries: 0,
            joggle: None,
        })
    }
}

/// 6!: a simplex has this share of the volume of its parallelotope.
const FACTORIAL: f64 = 720.0;

impl Plane {
    fn new(normal: [f64; DIM], offset: f64, quality: f64) -> Self {
        Plane {
            normal,
            offset,
            quality,
            alive: true,
            n_simplices: 0,
            simplex: NONE,
            measured_at: 0,
            distance: 0.0,
            n_reached: 0,
            grown_at: 0,
        }
    }

    fn distance_to(&self, point: &[f64; DIM]) -> f64 {
        dot(&self.normal, point) - self.offset
    }
}

/// A hash table of small numbers by 64-bit keys, emptied in no time.
#[derive(Default)]
struct Table {
    slots: Vec<(u64, u32, u32)>,
    stamp: u32,
}

impl Table {
    const EMPTY: u32 = u32::MAX;
    const DONE: u32 = u32::MAX - 1;

    fn clear_for(&mut self, n_keys: usize) {
        let n_slots = (2 * n_keys).next_power_of_two().max(64);
        if n_slots > self.slots.len() || self.stamp == u32::MAX {
            self.slots = vec![(0, 0, 0); n_slots.max(self.slots.len())];
            self.stamp = 0;
        }
        self.stamp += 1;
    }

    /// The value under a key, `EMPTY` at first. There must be room: never more keys than announced.
    fn entry(&mut self, key: u64) -> &mut u32 {
        let mask = self.slots.len() - 1;
        // Fibonacci hashing: the upper half of the product depends on all bits of the key.
        let mut slot = (key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize & mask;
        while self.slots[slot].1 == self.stamp && self.slots[slot].0 != key {
            slot = (slot + 1) & mask;
        }
        if self.slots[slot].1 != self.stamp {
            self.slots[slot] = (key, self.stamp, Self::EMPTY);
        }
        &mut self.slots[slot].2
    }
}

/// Steele, Lea & Flood's SplitMix64.
struct SplitMix64(u64);

impl SplitMix64 {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in -1..1.
    fn symmetric(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

fn largest_coordinate(points: &[[f64; DIM]]) -> Result<f64, HullError> {
    let mut largest = 0.0_f64;
    for (point_idx, point) in points.iter().enumerate() {
        for (axis, &value) in point.iter().enumerate() {
            if value.is_nan() || value.abs() > LIMIT {
                return Err(HullError::NonFinite { point_idx, axis, value });
            }
            largest = largest.max(value.abs());
        }
    }
    Ok(largest)
}

/// Seven points far apart: each in turn is the furthest from the flat through those before it.
fn initial_simplex(points: &[[f64; DIM]], flat_tolerance: f64) -> Result<[u32; DIM + 1], HullError> {
    let first = (0..points.len()).fold(0, |least, idx| if points[idx][0] < points[least][0] { idx } else { least });
    let mut corners = [first as u32; DIM + 1];
    // The part of each point that is perpendicular to the flat so far.
    let mut residuals: Vec<_> = points.iter().map(|point| difference(point, &points[first])).collect();
    for rank in 0..DIM {
        let (mut furthest, mut furthest_squared) = (0, -1.0);
        for (idx, residual) in residuals.iter().enumerate() {
            let squared = dot(residual, residual);
            if squared > furthest_squared {
                (furthest, furthest_squared) = (idx, squared);
            }
        }
        let width = furthest_squared.sqrt();
        if width <= flat_tolerance {
            return Err(HullError::NotFullDimensional { rank, width });
        }
        corners[rank + 1] = furthest as u32;
        let direction = residuals[furthest].map(|x| x / width);
        for residual in &mut residuals {
            // Twice is enough (Kahan): the second pass takes off what the first left by rounding.
            for _ in 0..2 {
                let along = dot(residual, &direction);
                for (x, d) in residual.iter_mut().zip(&direction) {
                    *x -= along * d;
                }
            }
        }
    }
    Ok(corners)
}

fn centroid(points: &[[f64; DIM]], corners: &[u32; DIM + 1]) -> [f64; DIM] {
    let mut sum = [0.0; DIM];
    for &vertex in corners {
        for (total, x) in sum.iter_mut().zip(&points[vertex as usize]) {
            *total += x;
        }
    }
    sum.map(|x| x / (DIM + 1) as f64)
}

/// The unit vector perpendicular to five rows, by elimination with full pivoting, and the least pivot.
fn null_vector(rows: &mut [[f64; DIM]; DIM - 1]) -> Option<([f64; DIM], f64)> {
    let mut columns = [0, 1, 2, 3, 4, 5];
    let mut least = f64::INFINITY;
    for k in 0..DIM - 1 {
        let (mut pivot_row, mut pivot_column, mut pivot) = (k, k, 0.0_f64);
        for (row, values) in rows.iter().enumerate().skip(k) {
            for (column, value) in values.iter().enumerate().skip(k) {
                if value.abs() > pivot {
                    (pivot_row, pivot_column, pivot) = (row, column, value.abs());
                }
            }
        }
        if pivot == 0.0 {
            return None;
        }
        least = least.min(pivot);
        rows.swap(k, pivot_row);
        if pivot_column != k {
            columns.swap(k, pivot_column);
            for row in rows.iter_mut() {
                row.swap(k, pivot_column);
            }
        }
        let pivot_values = rows[k];
        for row in rows.iter_mut().skip(k + 1) {
            let factor = row[k] / pivot_values[k];
            for column in k + 1..DIM {
                row[column] -= factor * pivot_values[column];
            }
        }
    }
    let mut solution = [0.0; DIM];
    solution[DIM - 1] = 1.0;
    for k in (0..DIM - 1).rev() {
        let rest: f64 = (k + 1..DIM).map(|column| rows[k][column] * solution[column]).sum();
        solution[k] = -rest / rows[k][k];
    }
    let length = dot(&solution, &solution).sqrt();
    if !length.is_finite() {
        return None;
    }
    let mut normal = [0.0; DIM];
    for (column, value) in columns.iter().zip(&solution) {
        normal[*column] = value / length;
    }
    Some((normal, least))
}

/// Numbers computed side by side, which the compiler turns into vector instructions.
const LANES: usize = 4;

/// Points, [`LANES`] together, axis by axis.
type Block = [[f64; LANES]; DIM];

/// The last block is filled up with its last point.
fn blocks(points: &[[f64; DIM]]) -> Vec<Block> {
    let mut blocks = Vec::with_capacity(points.len().div_ceil(LANES));
    for group in points.chunks(LANES) {
        blocks.push(std::array::from_fn(|axis| std::array::from_fn(|lane| group[lane.min(group.len() - 1)][axis])));
    }
    blocks
}

/// The greatest n·x over points x.
fn greatest(blocks: &[Block], normal: &[f64; DIM]) -> f64 {
    let mut greatest = [f64::NEG_INFINITY; LANES];
    for block in blocks {
        for (lane, so_far) in greatest.iter_mut().enumerate() {
            let along = block[0][lane] * normal[0]
                + block[1][lane] * normal[1]
                + block[2][lane] * normal[2]
                + block[3][lane] * normal[3]
                + block[4][lane] * normal[4]
                + block[5][lane] * normal[5];
            *so_far = if along > *so_far { along } else { *so_far };
        }
    }
    greatest.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

/// The ways to choose three of six columns i < j < k, in lexicographic order: then the complement of number m is
/// number 19 - m.
const TRIPLES: [[usize; 3]; 20] = {
    let mut triples = [[0; 3]; 20];
    let (mut n, mut i) = (0, 0);
    while i < DIM {
        let mut j = i + 1;
        while j < DIM {
            let mut k = j + 1;
            while k < DIM {
                triples[n] = [i, j, k];
                n += 1;
                k += 1;
            }
            j += 1;
        }
        i += 1;
    }
    triples
};

/// Determinants of [`LANES`] matrices, by Laplace's expansion along the first three rows: no pivots, so no branches.
/// Its error is that of rounding the products of the rows' lengths, as for elimination.
fn determinants(rows: &[[[f64; LANES]; DIM]; DIM]) -> [f64; LANES] {
    let top = minors(&rows[0], &rows[1], &rows[2]);
    let bottom = minors(&rows[3], &rows[4], &rows[5]);
    let mut sum = [0.0; LANES];
    for (n, [i, j, k]) in TRIPLES.iter().enumerate() {
        let sign = if (i + j + k) % 2 == 1 { 1.0 } else { -1.0 };
        for lane in 0..LANES {
            sum[lane] += sign * top[n][lane] * bottom[TRIPLES.len() - 1 - n][lane];
        }
    }
    sum
}

/// The determinants of all choices of three columns of three rows, in the order of [`TRIPLES`].
fn minors(a: &[[f64; LANES]; DIM], b: &[[f64; LANES]; DIM], c: &[[f64; LANES]; DIM]) -> [[f64; LANES]; 20] {
    let mut pairs = [[[0.0; LANES]; DIM]; DIM];
    for i in 0..DIM {
        for j in i + 1..DIM {
            for lane in 0..LANES {
                pairs[i][j][lane] = a[i][lane] * b[j][lane] - a[j][lane] * b[i][lane];
            }
        }
    }
    let mut minors = [[0.0; LANES]; 20];
    for (minor, [i, j, k]) in minors.iter_mut().zip(TRIPLES) {
        for (lane, value) in minor.iter_mut().enumerate() {
            *value = c[k][lane] * pairs[i][j][lane] - c[j][lane] * pairs[i][k][lane] + c[i][lane] * pairs[j][k][lane];
        }
    }
    minors
}

fn dot(a: &[f64; DIM], b: &[f64; DIM]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
}

fn difference(a: &[f64; DIM], b: &[f64; DIM]) -> [f64; DIM] {
    std::array::from_fn(|axis| a[axis] - b[axis])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube() -> Vec<[f64; DIM]> {
        (0..64).map(|bits| std::array::from_fn(|axis| if bits >> axis & 1 == 1 { 1.0 } else { -1.0 })).collect()
    }

    fn unit_vectors(sign: f64) -> Vec<[f64; DIM]> {
        (0..DIM).map(|axis| std::array::from_fn(|i| if i == axis { sign } else { 0.0 })).collect()
    }

    /// Two octagons and a triangle, multiplied: like wrenches, nearly all faces have more corners than a simplex.
    fn octagons_by_triangle(noise: f64) -> Vec<[f64; DIM]> {
        let mut random = SplitMix64(3);
        let corner = |k: u32| {
            let angle = f64::from(k) * std::f64::consts::FRAC_PI_4;
            [angle.cos(), angle.sin()]
        };
        let mut points = Vec::new();
        for (a, b, c) in (0..192).map(|k| (corner(k % 8), corner(k / 8 % 8), corner(2 * (k / 64)))) {
            points.push([a[0], a[1], b[0], b[1], c[0], c[1]].map(|x| x + noise * random.symmetric()));
        }
        points
    }

    fn inside(n: usize, radius: f64) -> Vec<[f64; DIM]> {
        let mut random = SplitMix64(5);
        (0..n).map(|_| std::array::from_fn(|_| radius * random.symmetric())).collect()
    }

    #[test]
    fn hulls_by_hand() {
        let simplex = [unit_vectors(1.0), vec![[0.0; DIM]]].concat();
        let cross_polytope = [unit_vectors(1.0), unit_vectors(-1.0)].concat();
        let moved: Vec<_> = cube().iter().map(|point| point.map(|x| x + 3.0)).collect();
        let with_others = [inside(60, 0.99), cube(), cube(), unit_vectors(1.0), vec![[0.0; DIM]; 3]].concat();
        for (name, points, volume, least_offset, n_planes) in [
            ("a cube", cube(), 64.0, 1.0, 12),
            ("a simplex", simplex, 1.0 / 720.0, 0.0, 7),
            ("a cross polytope", cross_polytope, 64.0 / 720.0, 1.0 / 6.0_f64.sqrt(), 64),
            // A regular octagon of radius 1 has the area 2√2; the triangle of three of a square's corners has 1.
            ("a product of polygons", octagons_by_triangle(0.0), 8.0, 0.0, 8 + 8 + 3),
            ("a cube beside the origin", moved, 64.0, -2.0, 12),
            ("a cube with duplicates and points inside", with_others, 64.0, 1.0, 12),
        ] {
            let hull = convex_hull(&points).expect(name);
            assert!((hull.volume - volume).abs() <= 1e-12 * volume, "{name}: volume {} for {volume}", hull.volume);
            let offset = hull.least_offset();
            assert!((offset - least_offset).abs() <= 1e-12, "{name}: least offset {offset} for {least_offset}");
            assert_eq!((hull.n_planes, hull.n_retries, hull.joggle), (n_planes, 0, None), "{name}");
        }
    }

    #[test]
    fn facets_look_outward_and_touch_their_vertices() {
        let points = octagons_by_triangle(0.01);
        let hull = convex_hull(&points).expect("a hull");
        for Facet { normal, offset, vertex_idxs } in &hull.facets {
            assert!((dot(normal, normal) - 1.0).abs() < 1e-12);
            assert!(points.iter().all(|point| dot(normal, point) - offset <= hull.uncertainty));
            assert!(
                vertex_idxs.iter().all(|idx| (dot(normal, &points[*idx as usize]) - offset).abs() <= hull.uncertainty)
            );
        }
    }

    #[test]
    fn the_order_of_points_does_not_matter() {
        for noise in [0.0, 0.01] {
            let mut points = octagons_by_triangle(noise);
            let volume = convex_hull(&points).expect("a hull").volume;
            let mut random = SplitMix64(9);
            for _ in 0..4 {
                for last in (1..points.len()).rev() {
                    points.swap(last, (random.next() % (last as u64 + 1)) as usize);
                }
                let permuted = convex_hull(&points).expect("a hull").volume;
                assert!((permuted - volume).abs() <= 1e-9 * volume, "{permuted} instead of {volume}");
            }
        }
    }

    #[test]
    fn noise_of_any_size_is_survived() {
        let mut n_retries = 0;
        for exponent in -16..-2 {
            let noise = 10.0_f64.powi(exponent);
            for points in
                [octagons_by_triangle(noise), [octagons_by_triangle(0.0), octagons_by_triangle(noise)].concat()]
            {
                let hull = convex_hull(&points).expect("a hull");
                // Each of 19 facets moves by at most √6 times the noise, and has an area of at most 12.
                let limit = 600.0 * (noise + hull.uncertainty) + 1e-12;
                assert!((hull.volume - 8.0).abs() <= limit, "noise {noise:e}: volume {}", hull.volume);
                n_retries += hull.n_retries;
            }
        }
        assert!(n_retries > 0, "other tolerances were never needed, so never tested");
    }

    #[test]
    fn a_joggle_is_a_last_resort_that_states_its_size() {
        let hull = first_unbroken(&cube(), &[]).expect("a hull");
        let size = hull.joggle.expect("a joggle");
        assert!(JOGGLES.contains(&size));
        assert!(hull.uncertainty > size);
        assert!((hull.least_offset() - 1.0).abs() <= hull.uncertainty);
        assert!((hull.volume - 64.0).abs() <= 12.0 * 32.0 * hull.uncertainty);
        assert_eq!(first_unbroken(&cube(), &[]), Ok(hull), "not the same again");
    }

    #[test]
    fn a_flat_says_its_dimension() {
        for rank in 0..DIM {
            // Turned by a shear, so that the flat is not along the axes.
            let flat: Vec<_> = inside(40, 1.0)
                .iter()
                .map(|point| {
                    let sum: f64 = point[..rank].iter().sum();
                    std::array::from_fn(|axis| if axis < rank { point[axis] } else { sum * axis as f64 })
                })
                .collect();
            match convex_hull(&flat) {
                Err(HullError::NotFullDimensional { rank: found, width }) => {
                    assert_eq!(found, rank);
                    assert!(width < 1e-13, "{width}");
                }
                other => panic!("rank {rank}: {other:?}"),
            }
        }
    }

    #[test]
    fn bad_points_are_errors() {
        assert_eq!(convex_hull(&cube()[..6]), Err(HullError::TooFewPoints { found: 6 }));
        assert_eq!(convex_hull(&[]), Err(HullError::TooFewPoints { found: 0 }));
        for value in [f64::NAN, f64::INFINITY, -1e46] {
            let mut points = cube();
            points[7][2] = value;
            let found = convex_hull(&points);
            assert!(matches!(found, Err(HullError::NonFinite { point_idx: 7, axis: 2, .. })), "{found:?}");
        }
    }

    #[test]
    fn any_scale_has_the_same_hull() {
        for scale in [1e-40, 1e-3, 1e44] {
            let points: Vec<_> = cube().iter().map(|point| point.map(|x| x * scale)).collect();
            let hull = convex_hull(&points).expect("a hull");
            assert!((hull.volume / scale.powi(6) - 64.0).abs() < 1e-9);
            assert!((hull.least_offset() / scale - 1.0).abs() < 1e-12);
        }
    }
}
