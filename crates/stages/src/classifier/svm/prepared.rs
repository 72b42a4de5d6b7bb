//! Decision values at speed: a trained machine with its support vectors laid out for vector instructions.
//!
//! Support vectors stand side by side in blocks of [`WIDTH`], feature by feature, so that one feature of a sample meets
//! that feature of a whole block. Nothing is allocated per sample.

use std::ops::Deref;

use serde::{Deserialize, Serialize};

use super::lanes::{Aligned, InstructionSet, LANES, Lanes, exp, for_instruction_set};
use super::{RbfSvm, SvmError, check_finite};

/// Lanes that are summed side by side, so that additions need not wait for each other.
const GROUPS: usize = 4;
/// Support vectors of a block.
const WIDTH: usize = GROUPS * LANES;
/// Samples that share a pass over the support vectors, when there are several.
const SAMPLES_PER_PASS: usize = 8;

/// A consistent machine, prepared for decision values.
///
/// It is written and read as the [`RbfSvm`] that it is made of; its values equal [`RbfSvm::decision_value`] up to
/// rounding of the sum (1e-14 of `Σ |y_i α_i| K(x_i, x)`).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(try_from = "RbfSvm", into = "RbfSvm")]
pub struct PreparedSvm {
    svm: RbfSvm,
    layout: Layout,
}

#[derive(Debug, Clone)]
struct Layout {
    /// The features of each block of support vectors, `n_features` to a block.
    columns: Vec<[Aligned; GROUPS]>,
    /// The dual coefficients of each block; 0 beyond the last support vector.
    coefficients: Vec<[Aligned; GROUPS]>,
    n_features: usize,
    gamma: f64,
    instruction_set: InstructionSet,
}

impl PartialEq for PreparedSvm {
    fn eq(&self, other: &Self) -> bool {
        self.svm == other.svm
    }
}

impl Deref for PreparedSvm {
    type Target = RbfSvm;

    fn deref(&self) -> &RbfSvm {
        &self.svm
    }
}

impl TryFrom<RbfSvm> for PreparedSvm {
    type Error = SvmError;

    fn try_from(svm: RbfSvm) -> Result<Self, SvmError> {
        svm.validate()?;
        let layout = Layout::new(&svm, InstructionSet::detect());
        Ok(Self { svm, layout })
    }
}

impl From<PreparedSvm> for RbfSvm {
    fn from(prepared: PreparedSvm) -> Self {
        prepared.svm
    }
}

impl PreparedSvm {
    /// Decision value of one sample of `n_features` features; above 0 = the positive class.
    ///
    /// # Errors
    /// [`SvmError::FeatureCount`] or [`SvmError::NonFiniteFeature`] when the sample does not fit the model.
    pub fn decision_value(&self, features: &[f64]) -> Result<f64, SvmError> {
        let n_features = self.svm.n_features;
        if features.len() != n_features {
            return Err(SvmError::FeatureCount { expected: n_features, found: features.len() });
        }
        check_finite(features, n_features)?;
        let mut value = [0.0];
        kernel_sums(self.layout.instruction_set, &self.layout, features, &mut value);
        Ok(value[0] - self.svm.rho)
    }

    /// Decision values of many samples (row-major, n_samples × n_features); the same bits as one by one.
    ///
    /// # Errors
    /// [`SvmError::FeatureCount`] when the last sample is incomplete, or [`SvmError::NonFiniteFeature`].
    pub fn decision_values(&self, samples: &[f64]) -> Result<Vec<f64>, SvmError> {
        let n_features = self.svm.n_features;
        let n_left_over = samples.len() % n_features;
        if n_left_over != 0 {
            return Err(SvmError::FeatureCount { expected: n_features, found: n_left_over });
        }
        check_finite(samples, n_features)?;
        let mut values = vec![0.0; samples.len() / n_features];
        kernel_sums(self.layout.instruction_set, &self.layout, samples, &mut values);
        values.iter_mut().for_each(|value| *value -= self.svm.rho);
        Ok(values)
    }
}

impl Layout {
    fn new(svm: &RbfSvm, instruction_set: InstructionSet) -> Self {
        let n_blocks = svm.n_support_vectors().div_ceil(WIDTH);
        let zero = [Aligned([0.0; LANES]); GROUPS];
        let mut columns = vec![zero; n_blocks * svm.n_features];
        let mut coefficients = vec![zero; n_blocks];
        let support = svm.support_vectors.chunks_exact(svm.n_features).zip(&svm.dual_coefficients);
        for (support_idx, (support_vector, &coefficient)) in support.enumerate() {
            let (block_idx, group, lane) = (support_idx / WIDTH, support_idx % WIDTH / LANES, support_idx % LANES);
            coefficients[block_idx][group].0[lane] = coefficient;
            let block = &mut columns[block_idx * svm.n_features..][..svm.n_features];
            for (column, &feature) in block.iter_mut().zip(support_vector) {
                column[group].0[lane] = feature;
            }
        }
        Self { columns, coefficients, n_features: svm.n_features, gamma: svm.gamma, instruction_set }
    }
}

for_instruction_set! {
    /// `Σ_i y_i α_i K(x_i, x)` of each sample x.
    fn kernel_sums(layout: &Layout, samples: &[f64], sums: &mut [f64]) = kernel_sums_body
}

#[inline(always)]
fn kernel_sums_body(layout: &Layout, samples: &[f64], sums: &mut [f64]) {
    let n_features = layout.n_features;
    let minus_gamma = Lanes::splat(-layout.gamma);
    let passes = samples.chunks(SAMPLES_PER_PASS * n_features).zip(sums.chunks_mut(SAMPLES_PER_PASS));
    for (samples, sums) in passes {
        let mut lane_sums = [[Lanes::splat(0.0); GROUPS]; SAMPLES_PER_PASS];
        for (columns, coefficients) in layout.columns.chunks_exact(n_features).zip(&layout.coefficients) {
            for (sample, lane_sums) in samples.chunks_exact(n_features).zip(&mut lane_sums) {
                let squared = squared_distances(columns, sample);
                for group in 0..GROUPS {
                    let kernel = exp(squared[group].multiply(minus_gamma));
                    lane_sums[group] = Lanes::load(&coefficients[group].0).multiply_add(kernel, lane_sums[group]);
                }
            }
        }
        for (sum, lane_sums) in sums.iter_mut().zip(&lane_sums) {
            let mut lanes = [0.0; LANES];
            lane_sums[0].add(lane_sums[1]).add(lane_sums[2].add(lane_sums[3])).store(&mut lanes);
            *sum = ((lanes[0] + lanes[4]) + (lanes[1] + lanes[5])) + ((lanes[2] + lanes[6]) + (lanes[3] + lanes[7]));
        }
    }
}

#[inline(always)]
fn squared_distances(columns: &[[Aligned; GROUPS]], sample: &[f64]) -> [Lanes; GROUPS] {
    let mut squared = [Lanes::splat(0.0); GROUPS];
    for (column, &x) in columns.iter().zip(sample) {
        let x = Lanes::splat(x);
        for group in 0..GROUPS {
            let difference = Lanes::load(&column[group].0).subtract(x);
            squared[group] = difference.multiply_add(difference, squared[group]);
        }
    }
    squared
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    use super::*;

    fn uniform(rng: &mut ChaCha8Rng) -> f64 {
        f64::from(rng.next_u32()) / f64::from(u32::MAX) * 2.0 - 1.0
    }

    fn random_svm(n_support_vectors: usize, n_features: usize) -> RbfSvm {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        RbfSvm {
            gamma: 0.4,
            rho: 0.3,
            n_features,
            dual_coefficients: (0..n_support_vectors).map(|_| 100.0 * uniform(&mut rng)).collect(),
            support_vectors: (0..n_support_vectors * n_features).map(|_| uniform(&mut rng)).collect(),
        }
    }

    fn prepared(svm: &RbfSvm, instruction_set: InstructionSet) -> PreparedSvm {
        PreparedSvm { svm: svm.clone(), layout: Layout::new(svm, instruction_set) }
    }

    #[test]
    fn two_support_vectors_by_hand() {
        let svm = RbfSvm {
            gamma: 0.5,
            rho: 0.25,
            n_features: 2,
            dual_coefficients: vec![2.0, -1.0],
            support_vectors: vec![0.0, 0.0, 1.0, 2.0],
        };
        let prepared = PreparedSvm::try_from(svm).unwrap();
        // At the first vector: 2 · 1 - exp(-5/2) - 1/4.
        let value = prepared.decision_value(&[0.0, 0.0]).unwrap();
        assert!((value - (1.75 - libm::exp(-2.5))).abs() < 1e-15, "{value}");
        // So far away that no kernel is left.
        assert_eq!(prepared.decision_value(&[1e200, 0.0]), Ok(-0.25));
    }

    #[test]
    fn every_instruction_set_agrees_with_the_plain_sum_and_gives_the_same_bits() {
        for (n_support_vectors, n_features) in [(1, 1), (31, 3), (32, 64), (33, 7), (500, 64)] {
            let svm = random_svm(n_support_vectors, n_features);
            // Coefficients of both signs cancel, so rounding counts against the sum of their sizes.
            let dual_coefficients = svm.dual_coefficients.iter().map(|coefficient| coefficient.abs()).collect();
            let sizes = RbfSvm { dual_coefficients, rho: 0.0, ..svm.clone() };
            for sample in random_svm(11, n_features).support_vectors.chunks_exact(n_features) {
                let expected = svm.decision_value(sample).unwrap();
                let scale = sizes.decision_value(sample).unwrap() + svm.rho;
                let mut first = None;
                for instruction_set in InstructionSet::available() {
                    let value = prepared(&svm, instruction_set).decision_value(sample).unwrap();
                    assert!((value - expected).abs() < 1e-14 * scale, "{instruction_set:?}: {value} {expected}");
                    assert_eq!(value.to_bits(), *first.get_or_insert(value.to_bits()), "{instruction_set:?}");
                }
            }
        }
    }

    #[test]
    fn many_samples_are_the_same_as_one_by_one() {
        let svm = PreparedSvm::try_from(random_svm(70, 5)).unwrap();
        let samples = random_svm(4 * SAMPLES_PER_PASS + 3, 5).support_vectors;
        let one_by_one: Vec<f64> = samples.chunks_exact(5).map(|sample| svm.decision_value(sample).unwrap()).collect();
        assert_eq!(svm.decision_values(&samples), Ok(one_by_one));
        assert_eq!(svm.decision_values(&[]), Ok(Vec::new()));
        assert_eq!(svm.decision_values(&samples[1..]), Err(SvmError::FeatureCount { expected: 5, found: 4 }));
        assert_eq!(svm.decision_value(&samples[..4]), Err(SvmError::FeatureCount { expected: 5, found: 4 }));
        assert!(matches!(
            svm.decision_values(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, f64::NAN, 0.0, 0.0, 0.0]),
            Err(SvmError::NonFiniteFeature { row: 1, column: 1, .. })
        ));
    }

    #[test]
    fn it_is_written_and_read_as_the_plain_machine() {
        let svm = random_svm(3, 2);
        let prepared = PreparedSvm::try_from(svm.clone()).unwrap();
        let text = serde_json::to_string(&prepared).unwrap();
        assert_eq!(text, serde_json::to_string(&svm).unwrap());
        assert_eq!(serde_json::from_str::<PreparedSvm>(&text).unwrap(), prepared);
        let broken = RbfSvm { gamma: -1.0, ..svm };
        assert!(serde_json::from_str::<PreparedSvm>(&serde_json::to_string(&broken).unwrap()).is_err());
        assert!(matches!(PreparedSvm::try_from(broken), Err(SvmError::Model { .. })));
    }
}
