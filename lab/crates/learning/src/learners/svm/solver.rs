//! The solver of the dual problem stated at [`super::train_svm`], in its notation.
//!
//! Sequential minimal optimisation on two levels. The outer one picks a working set: the samples that violate the
//! optimality conditions most. The inner one moves pairs of the working set only, whose part of the kernel matrix fits
//! into a cache, until the set is optimal by itself. Then the gradient of all samples is brought up to date at once. So
//! the many small steps cost as much as the working set is large rather than as there are samples, and kernel rows
//! become products of matrices.

use super::SvmReport;
use super::kernel::Kernel;
use blindgrasp_stages::classifier::svm::SvmParams;
use blindgrasp_stages::classifier::svm::lanes::{InstructionSet, LANES, Lanes, for_instruction_set};

/// Samples of a working set. On 24,640 samples of 64 features at c = 100, 256, 512, 1024 and 2048 took 48, 11, 4.0 and
/// 3.9 s of processor time. At c = 1, where most samples only move to their bound once, it took 2.9 to 4.3 s.
const WORKING_SET: usize = 1024;
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

/// Solves the problem from β = 0 on; `kernel` is new.
pub(super) fn solve(kernel: &mut Kernel, labels: &[bool], params: &SvmParams, max_iterations: usize) -> Solution {
    let mut beta = vec![0.0; labels.len()];
    let y: Vec<f64> = labels.iter().map(|&positive| if positive { 1.0 } else { -1.0 }).collect();
    let problem = Problem {
        lower: y.iter().map(|y| y.min(0.0) * params.c * params.weight_negative).collect(),
        upper: y.iter().map(|y| y.max(0.0) * params.c * params.weight_positive).collect(),
        y,
    };
    let mut gradient: Vec<f64> = problem.y.iter().map(|y| -y).collect();
    let instruction_set = InstructionSet::detect();
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
        inner.tolerance = (INNER_SHARE * violation).max(params.tolerance);
        inner.max_iterations = (INNER_ITERATIONS_PER_SAMPLE * working_set.len()).min(max_iterations - n_iterations);
        solve_inner(instruction_set, &mut inner);
        n_iterations += inner.n_iterations;
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

/// The samples to work on, the most violating pair among them. Of those whose β can grow these are the ones with the
/// smallest gradients, of those whose β can shrink the ones with the largest, as many of each. Half of the places may
/// be kept by members of the last set that are free (`lower < β < upper`): they are coupled with each other.
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

/// The problem of a working set, the others' β held. All lists are as long as a row of the kernel in memory; those
/// beyond the working set can neither grow nor shrink.
struct Inner<'a> {
    beta: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
    gradient: Vec<f64>,
    /// 0 where β can grow, else +∞: added to the gradient, it keeps the others from being the smallest.
    growing: Vec<f64>,
    /// 0 where β can shrink, else -∞.
    shrinking: Vec<f64>,
    kernel: &'a [f32],
    width: usize,
    /// The violation at which it is solved.
    tolerance: f64,
    max_iterations: usize,
    /// Pairs that were moved.
    n_iterations: usize,
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
        let of = |values: &[f64]| {
            let mut values: Vec<f64> = working_set.iter().map(|&idx| values[idx]).collect();
            values.resize(width, 0.0);
            values
        };
        let mut inner = Self {
            beta: of(beta),
            lower: of(&problem.lower),
            upper: of(&problem.upper),
            gradient: of(gradient),
            growing: vec![0.0; width],
            shrinking: vec![0.0; width],
            kernel,
            width,
            tolerance: 0.0,
            max_iterations: 0,
            n_iterations: 0,
        };
        (0..width).for_each(|idx| inner.note_bounds(idx));
        inner
    }

    fn note_bounds(&mut self, idx: usize) {
        self.growing[idx] = if self.beta[idx] < self.upper[idx] { 0.0 } else { f64::INFINITY };
        self.shrinking[idx] = if self.beta[idx] > self.lower[idx] { 0.0 } else { f64::NEG_INFINITY };
    }

    fn row(&self, idx: usize) -> &'a [[f32; LANES]] {
        self.kernel[idx * self.width..][..self.width].as_chunks().0
    }

    /// Moves β_i up and β_j down as far as is best, and returns by how much; `None` if that is below rounding.
    fn move_pair(&mut self, i: usize, j: usize) -> Option<f64> {
        let k_ij = self.kernel[i * self.width + j];
        // ‖φ(x_i) - φ(x_j)‖² = K_ii + K_jj - 2 K_ij, where K_ii = K_jj = 1.
        let curvature = (2.0 - 2.0 * f64::from(k_ij)).max(MIN_CURVATURE);
        let unbounded = (self.gradient[j] - self.gradient[i]) / curvature;
        let (room_i, room_j) = (self.upper[i] - self.beta[i], self.beta[j] - self.lower[j]);
        let step = unbounded.min(room_i).min(room_j);
        let before = (self.beta[i], self.beta[j]);
        // A sample that reaches its bound gets exactly that value, or rounding would leave it looking free.
        self.beta[i] = if step == room_i { self.upper[i] } else { self.beta[i] + step };
        self.beta[j] = if step == room_j { self.lower[j] } else { self.beta[j] - step };
        self.note_bounds(i);
        self.note_bounds(j);
        (before != (self.beta[i], self.beta[j])).then_some(step)
    }
}

for_instruction_set! {
    /// Moves pairs until the violation is below the tolerance or the iterations have run out.
    fn solve_inner(inner: &mut Inner<'_>) = solve_inner_body
}

#[inline(always)]
fn solve_inner_body(inner: &mut Inner<'_>) {
    let any_row = inner.row(0);
    let mut i = update_gradient(inner, 0.0, any_row, any_row);
    while inner.n_iterations < inner.max_iterations {
        let Some(growing_idx) = i else { return };
        let (violation, j) = select_shrinking(inner, growing_idx);
        if violation < inner.tolerance {
            return;
        }
        let Some(shrinking_idx) = j else { return };
        let Some(step) = inner.move_pair(growing_idx, shrinking_idx) else { return };
        inner.n_iterations += 1;
        i = update_gradient(inner, step, inner.row(growing_idx), inner.row(shrinking_idx));
    }
}

/// Adds `step (row_i - row_j)` to the gradient and returns the sample with the smallest gradient of those whose β can
/// grow.
#[inline(always)]
fn update_gradient(inner: &mut Inner<'_>, step: f64, row_i: &[[f32; LANES]], row_j: &[[f32; LANES]]) -> Option<usize> {
    let step = Lanes::splat(step);
    let mut smallest = Lanes::splat(f64::INFINITY);
    let mut chunk_of_smallest = Lanes::splat(-1.0);
    let (mut chunk_idx, one) = (Lanes::splat(0.0), Lanes::splat(1.0));
    let gradient = inner.gradient.as_chunks_mut::<LANES>().0.iter_mut();
    let rows = row_i.iter().zip(row_j);
    for ((gradient, growing), (k_i, k_j)) in gradient.zip(inner.growing.as_chunks().0).zip(rows) {
        let difference = Lanes::load_f32(k_i).subtract(Lanes::load_f32(k_j));
        let new = difference.multiply_add(step, Lanes::load(gradient));
        new.store(gradient);
        let candidate = new.add(Lanes::load(growing));
        chunk_of_smallest = candidate.if_at_least(smallest, chunk_of_smallest, chunk_idx);
        smallest = candidate.if_at_least(smallest, smallest, candidate);
        chunk_idx = chunk_idx.add(one);
    }
    let (values, chunks) = arrays(smallest, chunk_of_smallest);
    first_of_best(values, chunks, |value, best| value < best)
}

/// The largest violation of optimality, and the sample to pair with i. Of those whose β can shrink it is the one for
/// which moving the pair without regard to bounds lowers the objective most, by (g_j - g_i)² / (2 curvature).
#[inline(always)]
fn select_shrinking(inner: &Inner<'_>, i: usize) -> (f64, Option<usize>) {
    let gradient_i = Lanes::splat(inner.gradient[i]);
    let (zero, one, two) = (Lanes::splat(0.0), Lanes::splat(1.0), Lanes::splat(2.0));
    let mut violation = zero;
    let mut largest = zero;
    let mut chunk_of_largest = Lanes::splat(-1.0);
    let mut chunk_idx = zero;
    let candidates = inner.gradient.as_chunks().0.iter().zip(inner.shrinking.as_chunks().0).zip(inner.row(i));
    for ((gradient, shrinking), k) in candidates {
        let difference = Lanes::load(gradient).add(Lanes::load(shrinking)).subtract(gradient_i).max(zero);
        violation = difference.max(violation);
        let curvature = Lanes::load_f32(k).negated_multiply_add(two, two).max(Lanes::splat(MIN_CURVATURE));
        let decrease = difference.multiply(difference).divide(curvature);
        chunk_of_largest = largest.if_at_least(decrease, chunk_of_largest, chunk_idx);
        largest = largest.if_at_least(decrease, largest, decrease);
        chunk_idx = chunk_idx.add(one);
    }
    let (values, chunks) = arrays(largest, chunk_of_largest);
    let (violations, _) = arrays(violation, violation);
    let violation = violations.iter().fold(0.0, |most: f64, value| most.max(*value));
    (violation, first_of_best(values, chunks, |value, best| value > best))
}

#[inline(always)]
fn arrays(values: Lanes, chunks: Lanes) -> ([f64; LANES], [f64; LANES]) {
    let mut stored = ([0.0; LANES], [0.0; LANES]);
    values.store(&mut stored.0);
    chunks.store(&mut stored.1);
    stored
}

/// The best of the lanes' values and where it was found, the first of equals; -1 stands for nowhere.
fn first_of_best(values: [f64; LANES], chunks: [f64; LANES], is_better: impl Fn(f64, f64) -> bool) -> Option<usize> {
    let mut best: (f64, Option<usize>) = (f64::NAN, None);
    for lane in (0..LANES).filter(|&lane| chunks[lane] >= 0.0) {
        let idx = chunks[lane] as usize * LANES + lane;
        let is_first = best.1.is_none_or(|best_idx| idx < best_idx);
        if best.1.is_none() || is_better(values[lane], best.0) || (values[lane] == best.0 && is_first) {
            best = (values[lane], Some(idx));
        }
    }
    best.1
}

/// The threshold at which free samples (0 < α < c) lie on their margins: the mean of their gradients. When none is
/// free, every value between the gradients of those that can grow and those that can shrink will do; the middle is
/// taken.
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
