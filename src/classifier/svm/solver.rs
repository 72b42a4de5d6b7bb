//! The solver of the dual problem stated at [`super::train_svm`], in its notation.
//!
//! Sequential minimal optimisation on two levels. The outer one picks a working set: the samples that violate the
//! optimality conditions most. The inner one moves pairs of the working set only, whose part of the kernel matrix fits
//! into a cache, until the set is optimal by itself; then the gradient of all samples is brought up to date at once. So
//! the many small steps cost as much as the working set is large rather than as there are samples, and kernel rows
//! become products of matrices.

use super::kernel::Kernel;
use super::{SvmParams, SvmReport};

/// Samples of a working set.
const WORKING_SET: usize = 512;
/// Steps on a working set per sample of it, after which it is left as it is.
const INNER_ITERATIONS_PER_SAMPLE: usize = 100;
/// The inner problem is solved until its violation is this share of the outer one's (or below the tolerance): more
/// would be lost when the other samples move.
const INNER_SHARE: f64 = 0.1;
/// Stands in for the curvature ‖φ(x_i) - φ(x_j)‖² of a pair when the samples coincide, as in Fan, Chen and Lin.
const MIN_CURVATURE: f64 = 1e-12;

pub(super) struct Solution {
    pub(super) beta: Vec<f64>,
    pub(super) rho: f64,
    pub(super) report: SvmReport,
}

struct Problem {
    y: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

pub(super) fn solve(kernel: &mut Kernel, labels: &[bool], params: &SvmParams, max_iterations: usize) -> Solution {
    let y: Vec<f64> = labels.iter().map(|&positive| if positive { 1.0 } else { -1.0 }).collect();
    let problem = Problem {
        lower: y.iter().map(|y| y.min(0.0) * params.c * params.weight_negative).collect(),
        upper: y.iter().map(|y| y.max(0.0) * params.c * params.weight_positive).collect(),
        y,
    };
    let mut beta = vec![0.0; labels.len()];
    let mut gradient: Vec<f64> = problem.y.iter().map(|y| -y).collect();
    let mut working_set = Vec::new();
    let (mut n_iterations, mut converged) = (0, false);
    loop {
        let violation = violation(&problem, &beta, &gradient);
        if violation < params.tolerance {
            converged = true;
            break;
        }
        if n_iterations >= max_iterations {
            break;
        }
        working_set = select_working_set(&problem, &beta, &gradient, &working_set);
        let (values, width) = kernel.among(&working_set);
        let mut inner = Inner::new(&problem, &working_set, &beta, &gradient, &values, width);
        let most = (INNER_ITERATIONS_PER_SAMPLE * working_set.len()).min(max_iterations - n_iterations);
        n_iterations += inner.solve((INNER_SHARE * violation).max(params.tolerance), most);
        let mut changes = Vec::new();
        for (&sample_idx, &new) in working_set.iter().zip(&inner.beta) {
            if new != beta[sample_idx] {
                changes.push((sample_idx, new - beta[sample_idx]));
                beta[sample_idx] = new;
            }
        }
        if changes.is_empty() {
            // The steps are below rounding, and would be chosen again for ever.
            break;
        }
        kernel.add_rows(&changes);
        for ((gradient, sum), y) in gradient.iter_mut().zip(kernel.sums()).zip(&problem.y) {
            *gradient = sum - y;
        }
    }

    // αᵀQα = Σ β_i (g_i + y_i) and eᵀα = Σ β_i y_i.
    let objective = beta.iter().zip(&gradient).zip(&problem.y).map(|((beta, g), y)| 0.5 * beta * (g - y)).sum();
    let rho = rho(&problem, &beta, &gradient);
    Solution { beta, rho, report: SvmReport { objective, n_iterations, converged } }
}

/// By how much the largest gradient of those whose β can shrink is above the smallest of those whose β can grow.
fn violation(problem: &Problem, beta: &[f64], gradient: &[f64]) -> f64 {
    let (mut smallest, mut largest) = (f64::INFINITY, f64::NEG_INFINITY);
    for (((&g, beta), lower), upper) in gradient.iter().zip(beta).zip(&problem.lower).zip(&problem.upper) {
        if beta < upper {
            smallest = g.min(smallest);
        }
        if beta > lower {
            largest = g.max(largest);
        }
    }
    largest - smallest
}

/// The samples to work on, the most violating pair among them: of those whose β can grow the ones with the smallest
/// gradients, of those whose β can shrink the ones with the largest, as many of each. Half of the places may be kept by
/// members of the last set that are free (`lower < β < upper`): they are coupled with each other.
fn select_working_set(problem: &Problem, beta: &[f64], gradient: &[f64], last: &[usize]) -> Vec<usize> {
    let n_samples = beta.len();
    if n_samples <= WORKING_SET {
        return (0..n_samples).collect();
    }
    let is_free = |idx: usize| beta[idx] > problem.lower[idx] && beta[idx] < problem.upper[idx];
    let mut chosen = vec![false; n_samples];
    let mut working_set: Vec<usize> = Vec::with_capacity(WORKING_SET);
    let growing: Vec<usize> = (0..n_samples).filter(|&idx| beta[idx] < problem.upper[idx]).collect();
    let shrinking: Vec<usize> = (0..n_samples).filter(|&idx| beta[idx] > problem.lower[idx]).collect();
    let n_new = if last.is_empty() { WORKING_SET } else { WORKING_SET / 2 };
    let mut take = |mut candidates: Vec<usize>, n: usize, key: &dyn Fn(usize) -> f64, set: &mut Vec<usize>| {
        candidates.retain(|&idx| !chosen[idx]);
        let by_key = |a: &usize, b: &usize| key(*a).total_cmp(&key(*b)).then(a.cmp(b));
        if n < candidates.len() {
            candidates.select_nth_unstable_by(n, by_key);
            candidates.truncate(n);
        }
        candidates.iter().for_each(|&idx| chosen[idx] = true);
        set.append(&mut candidates);
    };
    take(growing.clone(), n_new / 2, &|idx| gradient[idx], &mut working_set);
    take(shrinking.clone(), n_new / 2, &|idx| -gradient[idx], &mut working_set);
    let kept: Vec<usize> = last.iter().copied().filter(|&idx| is_free(idx)).collect();
    let room = WORKING_SET - working_set.len();
    take(kept, room, &|_| 0.0, &mut working_set);
    let room = WORKING_SET - working_set.len();
    take(growing, room / 2, &|idx| gradient[idx], &mut working_set);
    let room = WORKING_SET - working_set.len();
    take(shrinking, room, &|idx| -gradient[idx], &mut working_set);
    working_set.sort_unstable();
    working_set
}

/// The problem of a working set, the others' β held.
struct Inner<'a> {
    beta: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
    gradient: Vec<f64>,
    kernel: &'a [f32],
    width: usize,
}

impl<'a> Inner<'a> {
    fn new(
        problem: &Problem,
        working_set: &[usize],
        beta: &[f64],
        gradient: &[f64],
        kernel: &'a [f32],
        width: usize,
    ) -> Self {
        let of = |values: &[f64]| working_set.iter().map(|&idx| values[idx]).collect::<Vec<f64>>();
        Self {
            beta: of(beta),
            lower: of(&problem.lower),
            upper: of(&problem.upper),
            gradient: of(gradient),
            kernel,
            width,
        }
    }

    fn row(&self, idx: usize) -> &'a [f32] {
        &self.kernel[idx * self.width..][..self.beta.len()]
    }

    /// Moves pairs until the violation is below `tolerance`, at most `max_iterations`, and returns how many were moved.
    fn solve(&mut self, tolerance: f64, max_iterations: usize) -> usize {
        for n_iterations in 0..max_iterations {
            let Some(i) = self.smallest_growing() else { return n_iterations };
            let row_i = self.row(i);
            let (violation, j) = self.select_shrinking(self.gradient[i], row_i);
            let Some(j) = j.filter(|_| violation >= tolerance) else { return n_iterations };
            let row_j = self.row(j);
            let unbounded = (self.gradient[j] - self.gradient[i]) / curvature(row_i[j]);
            let (room_i, room_j) = (self.upper[i] - self.beta[i], self.beta[j] - self.lower[j]);
            let step = unbounded.min(room_i).min(room_j);
            let before = (self.beta[i], self.beta[j]);
            // A sample that reaches its bound gets exactly that value, or rounding would leave it looking free.
            self.beta[i] = if step == room_i { self.upper[i] } else { self.beta[i] + step };
            self.beta[j] = if step == room_j { self.lower[j] } else { self.beta[j] - step };
            if before == (self.beta[i], self.beta[j]) {
                return n_iterations;
            }
            for ((gradient, &k_i), &k_j) in self.gradient.iter_mut().zip(row_i).zip(row_j) {
                *gradient += step * (f64::from(k_i) - f64::from(k_j));
            }
        }
        max_iterations
    }

    /// The sample with the smallest gradient of those whose β can grow.
    fn smallest_growing(&self) -> Option<usize> {
        let mut smallest = (None, f64::INFINITY);
        for (idx, ((&g, beta), upper)) in self.gradient.iter().zip(&self.beta).zip(&self.upper).enumerate() {
            if beta < upper && g < smallest.1 {
                smallest = (Some(idx), g);
            }
        }
        smallest.0
    }

    /// The largest violation of optimality, and the sample to pair with i: of those whose β can shrink, the one for
    /// which moving the pair without regard to bounds lowers the objective most, by (g_j - g_i)² / (2 curvature).
    fn select_shrinking(&self, gradient_i: f64, row_i: &[f32]) -> (f64, Option<usize>) {
        let mut violation = 0.0;
        let mut best = (None, 0.0);
        let candidates = self.gradient.iter().zip(&self.beta).zip(&self.lower).zip(row_i);
        for (idx, (((&g, beta), lower), &k)) in candidates.enumerate() {
            let difference = g - gradient_i;
            if beta > lower && difference > 0.0 {
                violation = difference.max(violation);
                let decrease = difference * difference / curvature(k);
                if decrease > best.1 {
                    best = (Some(idx), decrease);
                }
            }
        }
        (violation, best.0)
    }
}

/// ‖φ(x_i) - φ(x_j)‖² = K_ii + K_jj - 2 K_ij, where K_ii = K_jj = 1.
fn curvature(k_ij: f32) -> f64 {
    (2.0 - 2.0 * f64::from(k_ij)).max(MIN_CURVATURE)
}

/// The threshold at which free samples (0 < α < c) lie on their margins: the mean of their gradients. When none is free,
/// every value between the gradients of those that can grow and those that can shrink will do; the middle is taken.
fn rho(problem: &Problem, beta: &[f64], gradient: &[f64]) -> f64 {
    let (mut free_sum, mut n_free) = (0.0, 0_usize);
    let (mut at_most, mut at_least) = (f64::INFINITY, f64::NEG_INFINITY);
    for (((&g, &beta), &lower), &upper) in gradient.iter().zip(beta).zip(&problem.lower).zip(&problem.upper) {
        match (beta < upper, beta > lower) {
            (true, true) => {
                free_sum += g;
                n_free += 1;
            }
            (true, false) => at_most = g.min(at_most),
            (false, _) => at_least = g.max(at_least),
        }
    }
    if n_free > 0 { free_sum / n_free as f64 } else { 0.5 * (at_most + at_least) }
}
