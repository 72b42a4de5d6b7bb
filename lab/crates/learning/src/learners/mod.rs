//! What learns from examples: support vector machines, boosted trees, K-means, Platt's calibration and the limits of
//! training grasps.
//!
//! The learners use all threads and seeded randomness, and give the same bytes on any number of threads. What they make
//! is judged by `blindgrasp_stages`, which needs neither.

pub mod booster;
pub mod k_means;
pub mod platt;
pub mod svm;
pub mod training_range;

use blindgrasp_stages::classifier::Predictor;
use blindgrasp_stages::classifier::svm::SvmError;
use rayon::prelude::*;

/// Rows of a unit of parallel work.
const ROWS_PER_TASK: usize = 32;

/// As [`Predictor::decision_values`], on all threads; the same bits.
///
/// # Errors
/// An incomplete last row, or a value that is not finite.
pub fn decision_values(predictor: &Predictor, rows: &[f64]) -> Result<Vec<f64>, SvmError> {
    let tasks = rows.par_chunks(ROWS_PER_TASK * predictor.n_features());
    let values: Vec<Vec<f64>> = tasks.map(|rows| predictor.decision_values(rows)).collect::<Result<_, _>>()?;
    Ok(values.concat())
}
