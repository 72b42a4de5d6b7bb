//! The sensor: what cells and joint encoders would say of true forces and angles.
//!
//! Noise, offset-corrected counts that are never negative, saturation. Gains that differ from cell to cell and dead
//! cells are not modelled.

use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::hand::Hand;

/// How good the sensor is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorOptions {
    /// Standard deviation of each cell's additive Gaussian noise. 0.01 N: assumed, a fifth of the noise threshold.
    pub noise_newtons: f64,
    /// Counts per N/cm². 256 (the Barrett hand's tactile driver).
    pub counts_per_newton_per_cm2: f64,
    /// The largest count. 4095: 12 bits.
    pub largest_count: u32,
    /// Joint angles are rounded to multiples of this. 2π/4096: assumed, a 12-bit encoder; 0 rounds nothing.
    pub encoder_quantum_rad: f64,
}

impl Default for SensorOptions {
    fn default() -> Self {
        SensorOptions {
            noise_newtons: 0.01,
            counts_per_newton_per_cm2: 256.0,
            largest_count: 4095,
            encoder_quantum_rad: std::f64::consts::TAU / 4096.0,
        }
    }
}

/// What the cells say of `cells_newtons` (one value per cell of the hand), newtons.
pub fn read_cells(hand: &Hand, cells_newtons: &[f64], options: &SensorOptions, rng: &mut impl rand::Rng) -> Vec<f64> {
    hand.cells()
        .zip(cells_newtons)
        .map(|((_, cell), newtons)| {
            let area_cm2 = cell.size_m[0] * cell.size_m[1] * 1e4;
            let noisy_newtons = newtons + options.noise_newtons * gaussian(rng);
            let counts = (noisy_newtons / area_cm2 * options.counts_per_newton_per_cm2).round();
            counts.clamp(0.0, f64::from(options.largest_count)) / options.counts_per_newton_per_cm2 * area_cm2
        })
        .collect()
}

/// What the encoders say of `joints_rad`, within the joints' limits.
pub fn read_joints(hand: &Hand, joints_rad: &[f64], options: &SensorOptions) -> Vec<f64> {
    let quantum_rad = options.encoder_quantum_rad;
    hand.joints
        .iter()
        .zip(joints_rad)
        .map(|(joint, angle_rad)| {
            let rounded = if quantum_rad > 0.0 { (angle_rad / quantum_rad).round() * quantum_rad } else { *angle_rad };
            rounded.clamp(joint.lower_rad, joint.upper_rad)
        })
        .collect()
}

/// Standard normal (Box & Muller).
fn gaussian(rng: &mut impl rand::Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use std::path::Path;

    #[test]
    fn readings_are_counts_between_zero_and_saturation() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut forces = vec![0.0; hand.n_cells()];
        forces[0] = 1.0;
        forces[1] = 1000.0;
        let quiet = SensorOptions { noise_newtons: 0.0, ..SensorOptions::default() };
        let readings = read_cells(&hand, &forces, &quiet, &mut rng);
        // 1 N on 0.97 cm² is 263.9 counts, read as 264.
        assert!((readings[0] - 264.0 / 256.0 * 0.97).abs() < 1e-12);
        assert!((readings[1] - 4095.0 / 256.0 * 0.97).abs() < 1e-12);
        assert!(readings[2..].iter().all(|reading| *reading == 0.0));
    }

    #[test]
    fn noise_has_the_stated_size() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let forces = vec![2.0; hand.n_cells()];
        let options = SensorOptions { noise_newtons: 0.05, ..SensorOptions::default() };
        let squares: Vec<f64> = (0..100)
            .flat_map(|_| read_cells(&hand, &forces, &options, &mut rng))
            .map(|reading| (reading - 2.0).powi(2))
            .collect();
        let sigma = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!((sigma - 0.05).abs() < 0.002, "{sigma}");
    }

    #[test]
    fn encoders_round_within_limits() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let read = read_joints(&hand, &[0.5, 2.4435, 0.0, 1e-4, 0.8378, 0.1, 0.2], &SensorOptions::default());
        assert!((read[0] - 0.5).abs() <= std::f64::consts::PI / 4096.0);
        assert!(read[1] <= 2.4435 && read[4] <= 0.8378 && read[3] == 0.0);
    }
}
