//! A direction in which a set of wrenches is weak: proof that a grasp is unstable, without a hull.
//!
//! The radius of the largest ball around the origin within the convex hull of points w_j is the least of
//! h(d) = max_j w_j·d over all unit directions d. So *any* d bounds it from above, and six multiplications per point
//! prove the bound. Which directions are tried is heuristic, what counts is the proof: see [`weak_direction`].
//!
//! The search: h(d) is least at the normal of a facet, and facets are the vertices x of the polar polytope
//! {x : w_j·x ≤ 1 for all j}, with h(x/|x|) = 1/|x|. So it walks along that polytope's edges to vertices ever further
//! from the origin, as the simplex method does for a linear objective. An edge without end is a direction with h ≤ 0:
//! the origin is not inside.

use crate::hull::{DIM, SplitMix64, dot};

/// Steps after which a walk is given up. Walks take 5 to 30 steps.
const MAX_STEPS: usize = 200;

/// Walks towards random directions, after the one against the mean wrench. Of 330 simulated grasps with epsilon up to 0.07
/// this many miss two, and without a proof it is 20 µs lost.
const N_RANDOM_WALKS: usize = 1;

/// The bounds 1 of the polar polytope are raised by up to this, at random: wrenches are degenerate, and a walk would
/// stand still where more than six edges meet. Only the search sees it, not the proof.
const PERTURBATION: f64 = 1e-7;

/// A step is blocked only by points that grow faster along it than this.
const LEAST_RATE: f64 = 1e-12;

const SEED: u64 = 0x0070_6f6c_6172;

/// A direction d, not of unit length, with w·d ≤ `limit`·|d| for all points w, if the search finds one. `limit` ≥ 0.
///
/// With one, the hull of the points holds no ball around the origin larger than `limit`; that is certain up to the
/// rounding of a dot product. Without one, nothing is known. The same points always give the same answer.
pub fn weak_direction(points: &[[f64; DIM]], limit: f64) -> Option<[f64; DIM]> {
    let is_proof = |x: &[f64; DIM]| {
        let length = dot(x, x).sqrt();
        // False also for what is NaN.
        length > 0.0 && length.is_finite() && points.iter().all(|point| dot(point, x) <= limit * length)
    };
    let mut random = SplitMix64(SEED);
    let mut walk = Walk::new(points, &mut random);
    let mean: [f64; DIM] = std::array::from_fn(|axis| points.iter().map(|point| point[axis]).sum());
    let random_targets = (0..N_RANDOM_WALKS).map(|_| std::array::from_fn(|_| random.symmetric()));
    for target in std::iter::once(mean.map(|x| -x)).chain(random_targets) {
        for objective in [Some(target), None] {
            let found = walk.climb(objective, limit).filter(is_proof);
            if found.is_some() {
                return found;
            }
        }
    }
    None
}

/// A vertex of the polar polytope.
struct Walk {
    /// Coordinates of the points, axis by axis: all points are measured at once.
    axes: [Vec<f64>; DIM],
    x: [f64; DIM],
    /// What is left of each point's bound: b_j - w_j·x, with b_j = 1 and a little.
    slacks: Vec<f64>,
    rates: Vec<f64>,
    /// The points whose bounds meet at x; at first there are none, and coordinate planes are in their place.
    active: [Option<usize>; DIM],
    /// Inverse of the matrix with the active points as rows, column by column: column i is the edge along which
    /// bound i grows and the others stay.
    edges: [[f64; DIM]; DIM],
}

impl Walk {
    fn new(points: &[[f64; DIM]], random: &mut SplitMix64) -> Self {
        Walk {
            axes: std::array::from_fn(|axis| points.iter().map(|point| point[axis]).collect()),
            x: [0.0; DIM],
            slacks: points.iter().map(|_| 1.0 + PERTURBATION * random.symmetric().abs()).collect(),
            rates: vec![0.0; points.len()],
            active: [None; DIM],
            edges: std::array::from_fn(|i| std::array::from_fn(|axis| if axis == i { 1.0 } else { 0.0 })),
        }
    }

    /// Walks to the vertex furthest along the objective, or, without one, away from the origin to a vertex none of
    /// whose edges leads further out. Returns what looks like a proof of `limit`, a vertex or an edge, as soon as it
    /// comes to one.
    fn climb(&mut self, objective: Option<[f64; DIM]>, limit: f64) -> Option<[f64; DIM]> {
        for _ in 0..MAX_STEPS {
            if dot(&self.x, &self.x).sqrt() * limit >= 1.0 {
                return Some(self.x);
            }
            let objective = objective.unwrap_or(self.x);
            let (leaving, direction) = self.steepest(&objective)?;
            let Some((blocking, step)) = self.blocked(&direction) else { return Some(direction) };
            for (x, along) in self.x.iter_mut().zip(&direction) {
                *x += step * along;
            }
            for (slack, rate) in self.slacks.iter_mut().zip(&self.rates) {
                *slack -= step * rate;
            }
            self.exchange(leaving, blocking);
        }
        None
    }

    /// The edge along which the objective grows fastest.
    fn steepest(&self, objective: &[f64; DIM]) -> Option<(usize, [f64; DIM])> {
        let mut best = (0, 1e-9 * dot(objective, objective).sqrt(), 0.0);
        for (i, edge) in self.edges.iter().enumerate() {
            let along = dot(objective, edge) / dot(edge, edge).sqrt();
            // A bound may only fall; a coordinate plane is no bound.
            let gain = if self.active[i].is_some() { -along } else { along.abs() };
            if gain > best.1 {
                best = (i, gain, if along < 0.0 { -1.0 } else { 1.0 });
            }
        }
        (best.2 != 0.0).then(|| (best.0, self.edges[best.0].map(|value| best.2 * value)))
    }

    /// The first point whose bound a step in this direction reaches, and the step.
    fn blocked(&mut self, direction: &[f64; DIM]) -> Option<(usize, f64)> {
        let [a, b, c, d, e, f] = &self.axes;
        let n = self.rates.len();
        let (a, b, c, d, e, f) = (&a[..n], &b[..n], &c[..n], &d[..n], &e[..n], &f[..n]);
        for (i, rate) in self.rates.iter_mut().enumerate() {
            *rate = a[i] * direction[0]
                + b[i] * direction[1]
                + c[i] * direction[2]
                + d[i] * direction[3]
                + e[i] * direction[4]
                + f[i] * direction[5];
        }
        let mut first: Option<(usize, f64)> = None;
        let least_rate = LEAST_RATE * dot(direction, direction).sqrt();
        for (i, (rate, slack)) in self.rates.iter().zip(&self.slacks).enumerate() {
            if *rate > least_rate
                && first.is_none_or(|(_, step)| *slack < step * rate)
                && !self.active.contains(&Some(i))
            {
                first = Some((i, slack.max(0.0) / rate));
            }
        }
        first
    }

    /// Puts a point in the place of an active one.
    fn exchange(&mut self, leaving: usize, entering: usize) {
        let point: [f64; DIM] = std::array::from_fn(|axis| self.axes[axis][entering]);
        let pivot = dot(&point, &self.edges[leaving]);
        let edge = self.edges[leaving].map(|value| value / pivot);
        for (i, other) in self.edges.iter_mut().enumerate() {
            let along = dot(&point, other);
            if i != leaving {
                for (value, taken) in other.iter_mut().zip(&edge) {
                    *value -= along * taken;
                }
            }
        }
        self.edges[leaving] = edge;
        self.active[leaving] = Some(entering);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The corners of a cube of half-width 1 with its centre at (0, …, 0, `shift`), stretched along the axes.
    fn cube(shift: f64, stretch: [f64; DIM]) -> Vec<[f64; DIM]> {
        let corner = |bits: u32, axis: usize| if bits >> axis & 1 == 1 { stretch[axis] } else { -stretch[axis] };
        (0..64)
            .map(|bits| {
                let mut point: [f64; DIM] = std::array::from_fn(|axis| corner(bits, axis));
                point[DIM - 1] += shift;
                point
            })
            .collect()
    }

    #[track_caller]
    fn check(points: &[[f64; DIM]], limit: f64, is_weak: bool) {
        let found = weak_direction(points, limit);
        assert_eq!(found.is_some(), is_weak, "{found:?}");
        if let Some(d) = found {
            let most = points.iter().map(|point| dot(point, &d)).fold(f64::MIN, f64::max);
            assert!(most <= limit * dot(&d, &d).sqrt(), "{most} along {d:?}");
        }
    }

    #[test]
    fn a_cube_is_as_weak_as_its_nearest_facet() {
        check(&cube(0.0, [1.0; DIM]), 1.0 + 1e-6, true);
        check(&cube(0.0, [1.0; DIM]), 1.0 - 1e-12, false);
        check(&cube(-0.9, [1.0; DIM]), 0.1 + 1e-6, true);
        check(&cube(-0.9, [1.0; DIM]), 0.1 - 1e-12, false);
        check(&cube(0.0, [5.0, 4.0, 0.01, 3.0, 2.0, 6.0]), 0.010001, true);
        check(&cube(0.0, [5.0, 4.0, 0.01, 3.0, 2.0, 6.0]), 0.01 - 1e-12, false);
    }

    #[test]
    fn an_origin_outside_or_in_a_flat_is_weak_without_limit() {
        check(&cube(1.5, [1.0; DIM]), 0.0, true);
        check(&cube(-1.0, [1.0; DIM]), 1e-6, true);
        check(&cube(0.0, [1.0, 1.0, 1.0, 0.0, 1.0, 1.0]), 1e-12, true);
        check(&vec![[0.3, 0.0, 0.0, 0.0, 0.1, 0.0]; 30], 0.0, true);
    }

    #[test]
    fn what_is_no_number_proves_nothing() {
        assert_eq!(weak_direction(&[[f64::NAN; DIM]; 9], 0.07), None);
        let mut points = cube(1.5, [1.0; DIM]);
        points[40][3] = f64::NAN;
        assert_eq!(weak_direction(&points, 0.07), None);
    }
}
