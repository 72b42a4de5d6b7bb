//! Support vector classification with an RBF kernel, the classifier of Dang & Allen, section IV-D.
//!
//! The paper uses LIBSVM; this is the same problem under the same parameter names, solved by
//! sequential minimal optimisation. It trains one binary classifier with one penalty for both
//! classes. It does not scale features, choose parameters, or turn decision values into
//! probabilities (see [`super::calibration`]), and its solver does not shrink.
//!
//! The same samples give the same bytes on any number of threads: only kernel rows are computed in
//! parallel, each of their values by itself.

mod lanes;
mod prepared;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use prepared::PreparedSvm;

/// Parameters of the training, named as in LIBSVM and scikit-learn.
#[derive(Debug, Clone, PartialEq)]
pub struct SvmParams {
    /// Penalty of a sample on the wrong side of its margin, the upper bound of every α; above 0.
    pub c: f64,
    /// Width of the kernel `exp(-gamma ‖x - z‖²)`, per squared unit of the features; above 0.
    pub gamma: f64,
    /// How far the optimality conditions may be violated, in units of the decision value; above 0.
    pub tolerance: f64,
}

impl Default for SvmParams {
    /// LIBSVM's `c` and `tolerance`; `gamma` is 0, which [`train_svm`] refuses, because it depends
    /// on the features.
    fn default() -> Self {
        Self { c: 1.0, gamma: 0.0, tolerance: 1e-3 }
    }
}

/// A trained classifier: `f(x) = Σ_i y_i α_i exp(-gamma ‖x_i - x‖²) - rho`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RbfSvm {
    /// Width of the kernel, per squared unit of the features.
    pub gamma: f64,
    /// What is subtracted from the sum of kernels.
    pub rho: f64,
    /// Number of features of a sample.
    pub n_features: usize,
    /// `y_i α_i` of each support vector; positive for the positive class.
    pub dual_coefficients: Vec<f64>,
    /// The support vectors in the order of the training samples: row-major, n_support_vectors ×
    /// n_features.
    pub support_vectors: Vec<f64>,
}

impl RbfSvm {
    /// Decision value of one sample of `n_features` features; above 0 = the positive class.
    ///
    /// # Errors
    /// [`SvmError::FeatureCount`] or [`SvmError::NonFiniteFeature`] when the sample does not fit
    /// the model.
    pub fn decision_value(&self, features: &[f64]) -> Result<f64, SvmError> {
        if features.len() != self.n_features {
            return Err(SvmError::FeatureCount { expected: self.n_features, found: features.len() });
        }
        check_finite(features, self.n_features)?;
        let kernels: f64 = self
            .support_vectors
            .chunks_exact(self.n_features.max(1))
            .zip(&self.dual_coefficients)
            .map(|(support_vector, coefficient)| coefficient * rbf(self.gamma, support_vector, features))
            .sum();
        Ok(kernels - self.rho)
    }

    /// Number of support vectors.
    pub fn n_support_vectors(&self) -> usize {
        self.dual_coefficients.len()
    }

    /// Checks shapes and values of a model that was read from a file.
    ///
    /// # Errors
    /// [`SvmError::Model`] names the first thing that is wrong.
    pub fn validate(&self) -> Result<(), SvmError> {
        let wrong = |problem: String| Err(SvmError::Model { problem });
        let n_support_vectors = self.n_support_vectors();
        if !is_positive(self.gamma) {
            return wrong(format!("gamma is {}, expected a finite number above 0", self.gamma));
        }
        if !self.rho.is_finite() {
            return wrong(format!("rho is {}, expected a finite number", self.rho));
        }
        if self.n_features == 0 {
            return wrong("n_features is 0, expected at least 1".to_owned());
        }
        if n_support_vectors == 0 {
            return wrong("there is no support vector".to_owned());
        }
        if n_support_vectors.checked_mul(self.n_features) != Some(self.support_vectors.len()) {
            return wrong(format!(
                "support_vectors has {} values, expected {n_support_vectors} dual coefficients × {} features",
                self.support_vectors.len(),
                self.n_features
            ));
        }
        if let Some(index) = self.dual_coefficients.iter().position(|coefficient| !coefficient.is_finite()) {
            return wrong(format!("dual coefficient {index} is {}", self.dual_coefficients[index]));
        }
        if let Err(error) = check_finite(&self.support_vectors, self.n_features) {
            return wrong(format!("support vectors: {error}"));
        }
        Ok(())
    }
}

/// How the training went.
#[derive(Debug, Clone, PartialEq)]
pub struct SvmReport {
    /// Value of the dual problem's objective, `½ αᵀQα - eᵀα`, below 0.
    pub objective: f64,
    /// Pairs of α that were optimised.
    pub n_iterations: usize,
    /// Whether the optimality conditions hold to `tolerance`; false when the iterations ran out or
    /// rounding stopped them.
    pub converged: bool,
}

/// Why a classifier could not be trained, read or asked.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SvmError {
    /// A parameter is not a finite number above 0.
    #[error("{name} is {value}, expected a finite number above 0")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// The value given.
        value: f64,
    },
    /// The training matrix is not n_labels × n_features with at least one feature.
    #[error("{n_values} feature values do not make {n_labels} samples (one a label) of {n_features} features")]
    Shape {
        /// Number of feature values given.
        n_values: usize,
        /// Number of labels given.
        n_labels: usize,
        /// Number of features given.
        n_features: usize,
    },
    /// A class has no sample.
    #[error("training needs samples of both classes, found {n_positive} positive and {n_negative} negative")]
    OneClass {
        /// Number of positive labels.
        n_positive: usize,
        /// Number of negative labels.
        n_negative: usize,
    },
    /// A feature is NaN or infinite.
    #[error("feature at row {row}, column {column} is {value}: every feature must be finite")]
    NonFiniteFeature {
        /// Index of the sample; 0 for a single one.
        row: usize,
        /// Index of the feature.
        column: usize,
        /// What was found there.
        value: f64,
    },
    /// A sample has another number of features than the model.
    #[error("the model takes {expected} features, found {found}")]
    FeatureCount {
        /// Number of features of the model.
        expected: usize,
        /// Number of features given.
        found: usize,
    },
    /// A model read from a file is not consistent.
    #[error("invalid SVM model: {problem}")]
    Model {
        /// What is wrong.
        problem: String,
    },
}

/// Trains a C-SVC with RBF kernel on samples (row-major, n_samples × n_features) and labels
/// (`true` = the positive class).
///
/// The dual problem, with y_i = ±1 for the labels and Q_ij = y_i y_j K(x_i, x_j), K(x, z) =
/// exp(-gamma ‖x - z‖²):
///
/// ```text
/// minimise    ½ αᵀQα - eᵀα
/// subject to  yᵀα = 0,   0 ≤ α_i ≤ c
/// ```
///
/// The solver works with β_i = y_i α_i, in which the classes differ only by their bounds (0 ≤ β_i ≤
/// c for positive and -c ≤ β_i ≤ 0 for negative samples), the constraint is Σ β_i = 0, and the
/// gradient is g_i = Σ_j K_ij β_j - y_i. That is the decision value before rho, minus the label. β
/// is optimal if and only if some rho has g_i ≥ rho wherever β_i can still grow and g_i ≤ rho
/// wherever it can still shrink; the training stops when these are violated by less than
/// `tolerance` (LIBSVM's rule). Each step moves one pair, β_i up and β_j down by the same amount: i
/// has the smallest gradient of those that can grow, j brings the largest decrease of the objective
/// to second order ("WSS 2" of Fan, Chen and Lin, "Working set selection using second order
/// information for training support vector machines", 2005).
///
/// Not converging is not an error: see [`SvmReport::converged`]. Kernel rows are kept in single
/// precision, like LIBSVM's, so a `tolerance` below about 1e-6 makes the solution more exact than
/// the kernel it is the solution for.
///
/// # Errors
/// When a parameter is not above 0, the shapes disagree, a feature is not finite, or a class is
/// missing.
pub fn train_svm(
    features: &[f64],
    n_features: usize,
    labels: &[bool],
    params: &SvmParams,
) -> Result<(RbfSvm, SvmReport), SvmError> {
    train_within(features, n_features, labels, params, &Limits::default())
}

/// Memory of the kernel row cache; LIBSVM and scikit-learn have the same default.
const CACHE_BYTES: usize = 200_000_000;
/// Iterations after which training gives up, LIBSVM's cap; 24,640 synthetic samples with many
/// outliers took 28,000 at c = 1.
const MAX_ITERATIONS: usize = 10_000_000;
/// Stands in for the curvature ‖φ(x_i) - φ(x_j)‖² of a pair when the samples coincide, as in Fan,
/// Chen and Lin.
const MIN_CURVATURE: f64 = 1e-12;
/// Samples of a kernel row per unit of parallel work, some 10 µs at 64 features: less would go into
/// handing them out.
const CHUNK: usize = 512;

/// What the training may use.
struct Limits {
    cache_bytes: usize,
    max_iterations: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { cache_bytes: CACHE_BYTES, max_iterations: MAX_ITERATIONS }
    }
}

fn train_within(
    features: &[f64],
    n_features: usize,
    labels: &[bool],
    params: &SvmParams,
    limits: &Limits,
) -> Result<(RbfSvm, SvmReport), SvmError> {
    for (name, value) in [("c", params.c), ("gamma", params.gamma), ("tolerance", params.tolerance)] {
        if !is_positive(value) {
            return Err(SvmError::Parameter { name, value });
        }
    }
    if n_features == 0 || labels.len().checked_mul(n_features) != Some(features.len()) {
        return Err(SvmError::Shape { n_values: features.len(), n_labels: labels.len(), n_features });
    }
    check_finite(features, n_features)?;
    let n_positive = labels.iter().filter(|&&positive| positive).count();
    let n_negative = labels.len() - n_positive;
    if n_positive == 0 || n_negative == 0 {
        return Err(SvmError::OneClass { n_positive, n_negative });
    }

    let mut kernel = KernelRows::new(features, n_features, params.gamma, limits.cache_bytes);
    let solution = solve(&mut kernel, labels, params, limits.max_iterations);
    let support = || (0..labels.len()).filter(|&sample_idx| solution.beta[sample_idx] != 0.0);
    let model = RbfSvm {
        gamma: params.gamma,
        rho: solution.rho,
        n_features,
        dual_coefficients: support().map(|sample_idx| solution.beta[sample_idx]).collect(),
        support_vectors: support().flat_map(|sample_idx| kernel.sample(sample_idx)).copied().collect(),
    };
    // Parameters near the limits of f64 can overflow on the way, and a tolerance above 2 leaves no
    // support vector.
    model.validate()?;
    Ok((model, solution.report))
}

fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

fn check_finite(features: &[f64], n_features: usize) -> Result<(), SvmError> {
    match features.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(SvmError::NonFiniteFeature {
            row: index / n_features.max(1),
            column: index % n_features.max(1),
            value: features[index],
        }),
    }
}

fn rbf(gamma: f64, left: &[f64], right: &[f64]) -> f64 {
    (-gamma * squared_distance(left, right)).exp()
}

/// ‖left - right‖². Eight sums side by side let the compiler use vector instructions, which a
/// single one forbids because it fixes the order of additions.
///
/// Squared norms computed beforehand would leave only a scalar product to do, but `‖x‖² + ‖z‖² - 2
/// x·z` cancels for samples far from the origin, and training on 24,640 samples of 64 features was
/// no faster with it (23 s against 21 s, 2 cores).
fn squared_distance(left: &[f64], right: &[f64]) -> f64 {
    let (left_blocks, left_rest) = left.as_chunks::<8>();
    let (right_blocks, right_rest) = right.as_chunks::<8>();
    let mut sums = [0.0; 8];
    for (left, right) in left_blocks.iter().zip(right_blocks) {
        for lane in 0..8 {
            let difference = left[lane] - right[lane];
            sums[lane] += difference * difference;
        }
    }
    let rest: f64 = left_rest.iter().zip(right_rest).map(|(left, right)| (left - right) * (left - right)).sum();
    ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7])) + rest
}

/// Rows of the kernel matrix, computed when asked for; those used least recently make room for new
/// ones.
struct KernelRows<'a> {
    features: &'a [f64],
    n_features: usize,
    gamma: f64,
    slot_of_sample: Vec<Option<usize>>,
    slots: Vec<Slot>,
    max_slots: usize,
    n_requests: u64,
}

struct Slot {
    sample_idx: usize,
    last_request: u64,
    row: Vec<f32>,
}

impl<'a> KernelRows<'a> {
    fn new(features: &'a [f64], n_features: usize, gamma: f64, cache_bytes: usize) -> Self {
        let n_samples = features.len() / n_features;
        // A step needs two rows at once.
        let max_slots = (cache_bytes / (n_samples * size_of::<f32>())).max(2);
        Self {
            features,
            n_features,
            gamma,
            slot_of_sample: vec![None; n_samples],
            slots: Vec::new(),
            max_slots,
            n_requests: 0,
        }
    }

    fn sample(&self, sample_idx: usize) -> &'a [f64] {
        &self.features[sample_idx * self.n_features..][..self.n_features]
    }

    /// Makes sure that the row of a sample is there and returns its slot, valid until the next but
    /// one request.
    fn request(&mut self, sample_idx: usize) -> usize {
        self.n_requests += 1;
        if let Some(slot_idx) = self.slot_of_sample[sample_idx] {
            self.slots[slot_idx].last_request = self.n_requests;
            return slot_idx;
        }
        let slot_idx = if self.slots.len() < self.max_slots {
            self.slots.push(Slot { sample_idx, last_request: 0, row: vec![0.0; self.slot_of_sample.len()] });
            self.slots.len() - 1
        } else {
            // There are fewer slots than samples here, so looking at all of them is little next to
            // computing a row.
            let oldest = (0..self.slots.len()).min_by_key(|&slot_idx| self.slots[slot_idx].last_request).unwrap_or(0);
            self.slot_of_sample[self.slots[oldest].sample_idx] = None;
            oldest
        };
        let (n_features, gamma, sample) = (self.n_features, self.gamma, self.sample(sample_idx));
        let slot = &mut self.slots[slot_idx];
        slot.sample_idx = sample_idx;
        slot.last_request = self.n_requests;
        slot.row.par_chunks_mut(CHUNK).zip(self.features.par_chunks(CHUNK * n_features)).for_each(|(row, samples)| {
            for (value, other) in row.iter_mut().zip(samples.chunks_exact(n_features)) {
                *value = rbf(gamma, sample, other) as f32;
            }
        });
        self.slot_of_sample[sample_idx] = Some(slot_idx);
        slot_idx
    }

    fn row(&self, slot_idx: usize) -> &[f32] {
        &self.slots[slot_idx].row
    }
}

struct Solution {
    beta: Vec<f64>,
    rho: f64,
    report: SvmReport,
}

/// Sequential minimal optimisation of the problem stated at [`train_svm`], in its notation.
fn solve(kernel: &mut KernelRows, labels: &[bool], params: &SvmParams, max_iterations: usize) -> Solution {
    let y: Vec<f64> = labels.iter().map(|&positive| if positive { 1.0 } else { -1.0 }).collect();
    let lower: Vec<f64> = y.iter().map(|y| y.min(0.0) * params.c).collect();
    let upper: Vec<f64> = y.iter().map(|y| y.max(0.0) * params.c).collect();
    let mut beta = vec![0.0; y.len()];
    let mut gradient: Vec<f64> = y.iter().map(|y| -y).collect();

    let mut n_iterations = 0;
    let mut converged = false;
    while let Some(i) = smallest_growing(&gradient, &beta, &upper) {
        let slot_i = kernel.request(i);
        let (violation, j) = select_shrinking(&gradient, &beta, &lower, gradient[i], kernel.row(slot_i));
        let Some(j) = j.filter(|_| violation >= params.tolerance) else {
            converged = true;
            break;
        };
        if n_iterations == max_iterations {
            break;
        }
        n_iterations += 1;

        let slot_j = kernel.request(j);
        let (row_i, row_j) = (kernel.row(slot_i), kernel.row(slot_j));
        let unbounded = (gradient[j] - gradient[i]) / curvature(row_i[j]);
        let (room_i, room_j) = (upper[i] - beta[i], beta[j] - lower[j]);
        let step = unbounded.min(room_i).min(room_j);
        let before = (beta[i], beta[j]);
        // A sample that reaches its bound gets exactly that value, or rounding would leave it
        // looking free.
        beta[i] = if step == room_i { upper[i] } else { beta[i] + step };
        beta[j] = if step == room_j { lower[j] } else { beta[j] - step };
        if before == (beta[i], beta[j]) {
            // The step is below rounding, and would be chosen again for ever.
            break;
        }
        for ((gradient, &k_i), &k_j) in gradient.iter_mut().zip(row_i).zip(row_j) {
            *gradient += step * (f64::from(k_i) - f64::from(k_j));
        }
    }

    // αᵀQα = Σ β_i (g_i + y_i) and eᵀα = Σ β_i y_i.
    let objective = beta.iter().zip(&gradient).zip(&y).map(|((beta, g), y)| 0.5 * beta * (g - y)).sum();
    let rho = rho(&gradient, &beta, &lower, &upper);
    Solution { beta, rho, report: SvmReport { objective, n_iterations, converged } }
}

/// ‖φ(x_i) - φ(x_j)‖² = K_ii + K_jj - 2 K_ij, where K_ii = K_jj = 1.
fn curvature(k_ij: f32) -> f64 {
    (2.0 - 2.0 * f64::from(k_ij)).max(MIN_CURVATURE)
}

/// The sample with the smallest gradient of those whose β can grow.
fn smallest_growing(gradient: &[f64], beta: &[f64], upper: &[f64]) -> Option<usize> {
    let mut smallest = (None, f64::INFINITY);
    for (sample_idx, ((&g, beta), upper)) in gradient.iter().zip(beta).zip(upper).enumerate() {
        if beta < upper && g < smallest.1 {
            smallest = (Some(sample_idx), g);
        }
    }
    smallest.0
}

/// The largest violation of optimality, and the sample to pair with i: of those whose β can shrink,
/// the one for which moving the pair without regard to bounds lowers the objective most, by (g_j -
/// g_i)² / (2 curvature).
fn select_shrinking(
    gradient: &[f64],
    beta: &[f64],
    lower: &[f64],
    gradient_i: f64,
    row_i: &[f32],
) -> (f64, Option<usize>) {
    let mut violation = 0.0;
    let mut best = (None, 0.0);
    for (sample_idx, (((&g, beta), lower), &k)) in gradient.iter().zip(beta).zip(lower).zip(row_i).enumerate() {
        let difference = g - gradient_i;
        if beta > lower && difference > 0.0 {
            violation = difference.max(violation);
            let decrease = difference * difference / curvature(k);
            if decrease > best.1 {
                best = (Some(sample_idx), decrease);
            }
        }
    }
    (violation, best.0)
}

/// The threshold at which free samples (0 < α < c) lie on their margins: the mean of their
/// gradients. When none is free, every value between the gradients of those that can grow and those
/// that can shrink will do; the middle is taken.
fn rho(gradient: &[f64], beta: &[f64], lower: &[f64], upper: &[f64]) -> f64 {
    let (mut free_sum, mut n_free) = (0.0, 0_usize);
    let (mut at_most, mut at_least) = (f64::INFINITY, f64::NEG_INFINITY);
    for (((&g, &beta), &lower), &upper) in gradient.iter().zip(beta).zip(lower).zip(upper) {
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

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    use super::*;

    fn params(c: f64, gamma: f64, tolerance: f64) -> SvmParams {
        SvmParams { c, gamma, tolerance }
    }

    /// Overlapping classes: positive where the first two features agree in sign, 10 % of labels
    /// flipped.
    fn random_problem(n_samples: usize, n_features: usize) -> (Vec<f64>, Vec<bool>) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut uniform = || f64::from(rng.next_u32()) / f64::from(u32::MAX) * 2.0 - 1.0;
        let features: Vec<f64> = (0..n_samples * n_features).map(|_| uniform()).collect();
        let labels = features.chunks_exact(n_features).map(|x| (x[0] * x[1] > 0.0) != (uniform() > 0.8)).collect();
        (features, labels)
    }

    fn decision_values(model: &RbfSvm, features: &[f64]) -> Vec<f64> {
        features.chunks_exact(model.n_features).map(|sample| model.decision_value(sample).unwrap()).collect()
    }

    fn largest_difference(left: &[f64], right: &[f64]) -> f64 {
        assert_eq!(left.len(), right.len());
        left.iter().zip(right).map(|(l, r)| (l - r).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn two_points_in_closed_form() {
        // α² (1 - k) - 2 α is least at α = 1 / (1 - k), k the kernel between the points; rho is 0
        // by symmetry.
        let features = [0.25, -1.0, 1.0, 1.0];
        let k = (-0.3 * (0.75_f64.powi(2) + 4.0)).exp();
        let alpha = 1.0 / (1.0 - k);
        let (model, report) = train_svm(&features, 2, &[false, true], &params(10.0, 0.3, 1e-9)).unwrap();
        assert!(report.converged);
        assert!(largest_difference(&model.dual_coefficients, &[-alpha, alpha]) < 1e-6, "{model:?}");
        assert!(model.rho.abs() < 1e-9, "{model:?}");
        assert!((report.objective + alpha).abs() < 1e-6, "{report:?}");
        assert!(largest_difference(&decision_values(&model, &features), &[-1.0, 1.0]) < 1e-6);

        // The same, with α held at c = 1/2.
        let (model, report) = train_svm(&features, 2, &[false, true], &params(0.5, 0.3, 1e-9)).unwrap();
        assert_eq!(model.dual_coefficients, [-0.5, 0.5]);
        assert!(model.rho.abs() < 1e-9, "{model:?}");
        assert!((report.objective - (0.25 * (1.0 - k) - 1.0)).abs() < 1e-6, "{report:?}");
    }

    #[test]
    fn xor_in_closed_form() {
        let features = [1.0, 1.0, -1.0, -1.0, 1.0, -1.0, -1.0, 1.0];
        let labels = [true, true, false, false];
        // Neighbours are 2 apart: k = exp(-4 gamma), across k²; α (1 + k² - 2 k) = 1 puts each on
        // its margin.
        let k = (-4.0 * 0.1_f64).exp();
        let alpha = 1.0 / (1.0 - k).powi(2);
        let (model, report) = train_svm(&features, 2, &labels, &params(100.0, 0.1, 1e-9)).unwrap();
        assert!(report.converged);
        assert!(largest_difference(&model.dual_coefficients, &[alpha, alpha, -alpha, -alpha]) < 1e-4, "{model:?}");
        assert!(model.decision_value(&[0.9, 0.8]).unwrap() > 0.0);
        assert!(model.decision_value(&[-0.9, 0.8]).unwrap() < 0.0);
        assert!(model.decision_value(&[0.0, 0.5]).unwrap().abs() < 1e-5);
    }

    #[test]
    fn optimality_conditions_hold_on_a_random_problem() {
        let (features, labels) = random_problem(300, 5);
        for (c, tolerance) in [(0.1, 1e-3), (1.0, 1e-3), (50.0, 1e-2), (1.0, 1e-8)] {
            let (model, report) = train_svm(&features, 5, &labels, &params(c, 0.7, tolerance)).unwrap();
            assert!(report.converged);
            assert!(model.dual_coefficients.iter().sum::<f64>().abs() < 1e-9);
            // Find each sample's α again: the support vectors are in the order of the samples.
            let mut support = model.support_vectors.chunks_exact(5).zip(&model.dual_coefficients).peekable();
            let (mut linear, mut quadratic) = (0.0, 0.0);
            for (sample, &positive) in features.chunks_exact(5).zip(&labels) {
                let y = if positive { 1.0 } else { -1.0 };
                let alpha = y * support.next_if(|(vector, _)| *vector == sample).map_or(0.0, |(_, beta)| *beta);
                assert!((0.0..=c).contains(&alpha), "{alpha}");
                let f = model.decision_value(sample).unwrap();
                let margin = y * f;
                // Single precision of the kernel adds some 1e-7 per unit of Σ α.
                let slack = tolerance + 1e-6 * c.max(1.0);
                assert!(alpha == c || margin >= 1.0 - slack, "alpha {alpha}, margin {margin}");
                assert!(alpha == 0.0 || margin <= 1.0 + slack, "alpha {alpha}, margin {margin}");
                linear += alpha;
                quadratic += alpha * y * (f + model.rho);
            }
            assert!(support.next().is_none());
            let objective = 0.5 * quadratic - linear;
            assert!((report.objective - objective).abs() < 1e-6 * objective.abs(), "{report:?} {objective}");
        }
    }

    #[test]
    fn number_of_threads_changes_no_bit() {
        let (features, labels) = random_problem(2 * CHUNK + 33, 11);
        let train = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            pool.install(|| train_svm(&features, 11, &labels, &params(1.0, 0.3, 1e-3))).unwrap()
        };
        assert_eq!(train(1), train(2));
        assert_eq!(train(1), train(3));
    }

    #[test]
    fn size_of_the_cache_changes_no_bit() {
        let (features, labels) = random_problem(200, 5);
        let train = |cache_bytes| {
            let limits = Limits { cache_bytes, ..Limits::default() };
            train_within(&features, 5, &labels, &params(1.0, 0.3, 1e-3), &limits).unwrap()
        };
        let reference = train(CACHE_BYTES);
        for n_rows in [0, 1, 2, 3, 50] {
            assert_eq!(train(n_rows * 200 * size_of::<f32>()), reference);
        }
    }

    #[test]
    fn cached_rows_are_the_kernel() {
        let (features, _) = random_problem(20, 3);
        let mut kernel = KernelRows::new(&features, 3, 0.5, 3 * 20 * size_of::<f32>());
        for sample_idx in [0, 1, 2, 0, 3, 19, 0, 1, 7, 7, 2] {
            let slot_idx = kernel.request(sample_idx);
            for (other_idx, &value) in kernel.row(slot_idx).iter().enumerate() {
                let squared: f64 = (0..3)
                    .map(|column| (features[sample_idx * 3 + column] - features[other_idx * 3 + column]).powi(2))
                    .sum();
                assert!((f64::from(value) - (-0.5 * squared).exp()).abs() < 1e-7);
            }
            assert!(kernel.slots.len() <= 3);
        }
    }

    #[test]
    fn order_of_samples_and_features_changes_no_decision() {
        let (features, labels) = random_problem(150, 9);
        let strict = params(1.0, 0.3, 1e-8);
        let (model, _) = train_svm(&features, 9, &labels, &strict).unwrap();
        let backwards: Vec<f64> = features.iter().rev().copied().collect();
        let labels_backwards: Vec<bool> = labels.iter().rev().copied().collect();
        let (permuted, _) = train_svm(&backwards, 9, &labels_backwards, &strict).unwrap();
        let mut decisions = decision_values(&permuted, &backwards);
        decisions.reverse();
        assert!(largest_difference(&decision_values(&model, &features), &decisions) < 1e-5);
    }

    #[test]
    fn swapped_labels_swap_the_sign() {
        let (features, labels) = random_problem(150, 4);
        let strict = params(2.0, 0.5, 1e-8);
        let (model, _) = train_svm(&features, 4, &labels, &strict).unwrap();
        let swapped: Vec<bool> = labels.iter().map(|positive| !positive).collect();
        let (mirrored, _) = train_svm(&features, 4, &swapped, &strict).unwrap();
        let negated: Vec<f64> = decision_values(&mirrored, &features).iter().map(|f| -f).collect();
        assert!(largest_difference(&decision_values(&model, &features), &negated) < 1e-5);
    }

    #[test]
    fn a_sample_with_both_labels_is_undecided() {
        let (model, report) = train_svm(&[1.0; 2], 1, &[true, false], &params(1.0, 1.0, 1e-3)).unwrap();
        assert!(report.converged);
        assert_eq!(model.dual_coefficients, [1.0, -1.0]);
        assert_eq!(model.decision_value(&[1.0]), Ok(0.0));
    }

    #[test]
    fn running_out_of_iterations_is_reported() {
        let (features, labels) = random_problem(100, 4);
        let limits = Limits { max_iterations: 5, ..Limits::default() };
        let (_, report) = train_within(&features, 4, &labels, &params(1.0, 0.5, 1e-3), &limits).unwrap();
        assert_eq!((report.converged, report.n_iterations), (false, 5));
    }

    #[test]
    fn extreme_parameters_neither_panic_nor_yield_an_invalid_model() {
        let (features, labels) = random_problem(20, 2);
        for c in [f64::MIN_POSITIVE, 1e-300, 1e300, f64::MAX] {
            for gamma in [f64::MIN_POSITIVE, 1e300] {
                for scale in [1e-300, 1.0, 1e300] {
                    let scaled: Vec<f64> = features.iter().map(|x| x * scale).collect();
                    let limits = Limits { max_iterations: 10_000, ..Limits::default() };
                    match train_within(&scaled, 2, &labels, &params(c, gamma, 1e-3), &limits) {
                        Ok((model, _)) => assert!(model.validate().is_ok()),
                        Err(error) => assert!(matches!(error, SvmError::Model { .. }), "{error}"),
                    }
                }
            }
        }
    }

    #[test]
    fn training_errors_say_what_is_wrong() {
        let features = [0.0, 1.0, 2.0, 3.0];
        let labels = [true, false];
        let good = params(1.0, 0.5, 1e-3);
        for (name, value) in [("c", 0.0), ("gamma", -1.0), ("tolerance", f64::NAN), ("c", f64::INFINITY)] {
            let mut bad = good.clone();
            match name {
                "c" => bad.c = value,
                "gamma" => bad.gamma = value,
                _ => bad.tolerance = value,
            }
            let error = train_svm(&features, 2, &labels, &bad).unwrap_err();
            assert!(matches!(error, SvmError::Parameter { name: found, .. } if found == name), "{error}");
        }
        assert!(matches!(
            train_svm(&features, 2, &labels, &SvmParams::default()),
            Err(SvmError::Parameter { name: "gamma", .. })
        ));
        for (n_features, n_labels) in [(3, 2), (2, 1), (0, 0), (usize::MAX, 2)] {
            assert_eq!(
                train_svm(&features, n_features, &labels[..n_labels], &good),
                Err(SvmError::Shape { n_values: 4, n_labels, n_features })
            );
        }
        assert_eq!(train_svm(&[], 2, &[], &good), Err(SvmError::OneClass { n_positive: 0, n_negative: 0 }));
        assert_eq!(
            train_svm(&features, 2, &[true; 2], &good),
            Err(SvmError::OneClass { n_positive: 2, n_negative: 0 })
        );
        assert_eq!(
            train_svm(&[0.0, 1.0, f64::INFINITY, 3.0], 2, &labels, &good),
            Err(SvmError::NonFiniteFeature { row: 1, column: 0, value: f64::INFINITY })
        );
    }

    #[test]
    fn models_and_samples_are_checked() {
        let (model, _) = train_svm(&[0.0, 1.0, 2.0, 3.0], 2, &[true, false], &params(1.0, 0.5, 1e-3)).unwrap();
        assert_eq!(model.validate(), Ok(()));
        assert_eq!(model.n_support_vectors(), 2);
        assert_eq!(model.decision_value(&[0.0]), Err(SvmError::FeatureCount { expected: 2, found: 1 }));
        assert!(matches!(
            model.decision_value(&[0.0, f64::NAN]),
            Err(SvmError::NonFiniteFeature { row: 0, column: 1, .. })
        ));
        let broken: [fn(&mut RbfSvm); 9] = [
            |model| model.gamma = 0.0,
            |model| model.gamma = f64::NAN,
            |model| model.rho = f64::INFINITY,
            |model| model.n_features = 0,
            |model| model.n_features = usize::MAX,
            |model| model.dual_coefficients[1] = f64::NAN,
            |model| model.support_vectors[3] = f64::NEG_INFINITY,
            |model| model.support_vectors.truncate(3),
            |model| (model.dual_coefficients, model.support_vectors) = (Vec::new(), Vec::new()),
        ];
        for (case, break_it) in broken.iter().enumerate() {
            let mut model = model.clone();
            break_it(&mut model);
            assert!(matches!(model.validate(), Err(SvmError::Model { .. })), "case {case}");
            // Even unchecked, a broken model answers something rather than panic.
            let _ = model.decision_value(&vec![0.0; model.n_features.min(4)]);
        }
    }
}
