//! Trains support vector machines with an RBF kernel, the classifier of Dang & Allen, section IV-D.
//!
//! The paper uses LIBSVM; this is the same problem under the same parameter names, solved by
//! sequential minimal optimisation. It trains one binary classifier with one penalty for both
//! classes. It does not scale features, choose parameters, or turn decision values into
//! probabilities (see [`super::platt`]), and its solver does not shrink.
//!
//! The same samples give the same bytes on any number of threads: only kernel rows are computed in
//! parallel, each of their values by itself.

mod kernel;
mod solver;

use blindgrasp_stages::classifier::svm::{RbfSvm, SvmError, SvmParams, check_finite};
use kernel::Kernel;
use solver::solve;

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
/// The solver works with β_i = y_i α_i, in which the classes differ only by their bounds (0 ≤ β_i ≤ c for positive and
/// -c ≤ β_i ≤ 0 for negative samples). The constraint is Σ β_i = 0, and the gradient is g_i = Σ_j K_ij β_j - y_i. That
/// is the decision value before rho, minus the label. β is optimal if and only if some rho has g_i ≥ rho wherever β_i
/// can still grow and g_i ≤ rho wherever it can still shrink. The training stops when these are violated by less than
/// `tolerance` (LIBSVM's rule). Each step moves one pair, β_i up and β_j down by the same amount. i has the smallest
/// gradient of those that can grow. j brings the largest decrease of the objective to second order. ("WSS 2" of Fan,
/// Chen and Lin, "Working set selection using second order information for training support vector machines", 2005).
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
    train_within(features, n_features, labels, params, MAX_ITERATIONS)
}

/// Iterations after which training gives up, LIBSVM's cap for as many samples.
const MAX_ITERATIONS: usize = 10_000_000;

fn train_within(
    features: &[f64],
    n_features: usize,
    labels: &[bool],
    params: &SvmParams,
    max_iterations: usize,
) -> Result<(RbfSvm, SvmReport), SvmError> {
    for (name, value) in [
        ("c", params.c),
        ("gamma", params.gamma),
        ("tolerance", params.tolerance),
        ("weight_positive", params.weight_positive),
        ("weight_negative", params.weight_negative),
    ] {
        if !value.is_finite() || value <= 0.0 {
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
    let mut kernel = Kernel::new(features, n_features, params.gamma, params.cache_bytes);
    if !kernel.is_finite() {
        return Err(SvmError::Model { problem: "the features are so large that their squares overflow".into() });
    }
    let solution = solve(&mut kernel, labels, params, max_iterations);
    let (mut dual_coefficients, mut support_vectors) = (Vec::new(), Vec::new());
    for (sample, beta) in features.chunks_exact(n_features).zip(solution.beta) {
        if beta != 0.0 {
            dual_coefficients.push(beta);
            support_vectors.extend(sample);
        }
    }
    let model = RbfSvm { gamma: params.gamma, rho: solution.rho, n_features, dual_coefficients, support_vectors };
    // Parameters near the limits of f64 can overflow on the way, and a tolerance above 2 leaves no support vector.
    model.validate()?;
    Ok((model, solution.report))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    use super::*;

    fn params(c: f64, gamma: f64, tolerance: f64) -> SvmParams {
        SvmParams { c, gamma, tolerance, ..SvmParams::default() }
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
    fn number_of_threads_and_size_of_the_cache_change_no_bit() {
        // More samples than a working set holds, and so more rows than one.
        let (features, labels) = random_problem(2 * 1024 + 33, 5);
        let train = |n_threads, cache_bytes| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            let params = SvmParams { cache_bytes, ..params(1.0, 0.3, 1e-3) };
            pool.install(|| train_svm(&features, 5, &labels, &params)).unwrap()
        };
        let usual_bytes = SvmParams::default().cache_bytes;
        let reference = train(1, usual_bytes);
        for (n_threads, cache_bytes) in [(2, usual_bytes), (3, usual_bytes)] {
            assert_eq!(train(n_threads, cache_bytes), reference, "{n_threads} threads");
        }
        for n_rows in [0, 1, 2, 3, 50, 600] {
            assert_eq!(train(2, n_rows * 2112 * size_of::<f32>()), reference, "{n_rows} rows");
        }
    }

    /// Objective and rho of LIBSVM 3.24 at tolerance 1e-5, as `scripts/benchsuite libsvm` prints them.
    #[test]
    fn agrees_with_libsvm() {
        let n_samples = 1500_u64;
        let feature =
            |i: u64, column: u64| ((i * i * (column + 1) * 37 + i * 101 * (column + 2)) % 1009) as f64 / 1009.0;
        let features: Vec<f64> = (0..n_samples).flat_map(|i| (0..6).map(move |column| feature(i, column))).collect();
        let labels: Vec<bool> =
            (0..n_samples).map(|i| ((feature(i, 0) - 0.5) * (feature(i, 1) - 0.5) > 0.0) != (i % 10 == 5)).collect();
        for (c, gamma, weight_positive, objective, rho) in [
            (1.0, 0.5, 1.0, -794.516808, 1.658594),
            (100.0, 3.0, 1.0, -33458.031602, 1.081805),
            (10.0, 2.0, 2.5, -6771.969983, -0.48394),
        ] {
            let (model, report) =
                train_svm(&features, 6, &labels, &SvmParams { weight_positive, ..params(c, gamma, 1e-5) }).unwrap();
            assert!(report.converged);
            assert!((report.objective / objective - 1.0).abs() < 1e-5, "{report:?}, expected {objective}");
            assert!((model.rho - rho).abs() < 1e-3, "rho {}, expected {rho}", model.rho);
        }
    }

    #[test]
    fn a_weight_is_a_penalty_of_its_class() {
        let (features, labels) = random_problem(300, 3);
        let train = |params: &SvmParams| train_svm(&features, 3, &labels, params).unwrap().0;
        let weighted = SvmParams { weight_positive: 3.0, weight_negative: 0.5, ..params(2.0, 0.5, 1e-3) };
        let model = train(&weighted);
        let largest = model.dual_coefficients.iter().fold(0.0, |most: f64, beta| most.max(*beta));
        let smallest = model.dual_coefficients.iter().fold(0.0, |least: f64, beta| least.min(*beta));
        assert_eq!((largest, smallest), (6.0, -1.0));
        // Both weights together are nothing but another c.
        let doubled = SvmParams { weight_positive: 2.0, weight_negative: 2.0, ..params(1.0, 0.5, 1e-3) };
        assert_eq!(train(&doubled), train(&params(2.0, 0.5, 1e-3)));
    }

    #[test]
    fn place_order_and_names_of_the_classes_change_no_decision() {
        let (features, labels) = random_problem(150, 9);
        let decided = |features: &[f64], labels: &[bool]| {
            decision_values(&train_svm(features, 9, labels, &params(1.0, 0.3, 1e-8)).unwrap().0, features)
        };
        let expected = decided(&features, &labels);
        let far: Vec<f64> = features.iter().map(|x| x + 1024.0).collect();
        assert!(largest_difference(&decided(&far, &labels), &expected) < 1e-5);
        // Samples and features in the other order.
        let backwards: Vec<f64> = features.iter().rev().copied().collect();
        let labels_backwards: Vec<bool> = labels.iter().rev().copied().collect();
        let mut found = decided(&backwards, &labels_backwards);
        found.reverse();
        assert!(largest_difference(&found, &expected) < 1e-5);
        let swapped: Vec<bool> = labels.iter().map(|positive| !positive).collect();
        let negated: Vec<f64> = decided(&features, &swapped).iter().map(|f| -f).collect();
        assert!(largest_difference(&negated, &expected) < 1e-5);
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
        let (_, report) = train_within(&features, 4, &labels, &params(1.0, 0.5, 1e-3), 5).unwrap();
        assert_eq!((report.converged, report.n_iterations), (false, 5));
    }

    #[test]
    fn extreme_parameters_neither_panic_nor_yield_an_invalid_model() {
        let (features, labels) = random_problem(20, 2);
        for c in [f64::MIN_POSITIVE, 1e-300, 1e300, f64::MAX] {
            for gamma in [f64::MIN_POSITIVE, 1e300] {
                for scale in [1e-300, 1.0, 1e300] {
                    let scaled: Vec<f64> = features.iter().map(|x| x * scale).collect();
                    match train_within(&scaled, 2, &labels, &params(c, gamma, 1e-3), 10_000) {
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
}
