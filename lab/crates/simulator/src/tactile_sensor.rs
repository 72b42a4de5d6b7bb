//! The sensor: readings of cells and joint encoders from true forces and angles.
//!
//! Noise, offset-corrected counts that are never negative, saturation. By option come gains and offsets that differ from cell
//! to cell or that all cells share, crosstalk between cells, and skins that spread force and lag behind it. So do dead cells
//! and stuck ones, and encoders at motor or joint with a wrong zero. Not modelled: hysteresis.

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::option_check::{OptionError, not_negative, positive, require, share, with_defaults};
use super::skin::{Bell, SkinOptions};
use blindgrasp_stages::hand::{Cell, Hand};

with_defaults! {
    /// The quality of the sensor.
    pub struct SensorOptions {
        /// Standard deviation of each cell's additive Gaussian noise. 0.01 N: assumed, a fifth of the noise threshold.
        pub noise_newtons: f64 = 0.01,
        /// Standard deviation of the logarithm of the cells' gains: 0.1 is about 10 %. 0: all cells are calibrated.
        pub gain_sigma: f64 = 0.0,
        /// Standard deviation of the logarithm of the gain that all cells share. 0.
        pub common_gain_sigma: f64 = 0.0,
        /// Standard deviation of each cell's offset: its drift since the sensor was tared. 0.
        pub offset_newtons: f64 = 0.0,
        /// Share of the force on a cell that the cells around it feel in its place, in equal parts. 0.
        pub crosstalk: f64 = 0.0,
        /// How the skin spreads force over the cells, in lifts.
        pub skin: SkinOptions = SkinOptions::default(),
        /// Longest time constant with which cells follow a force, in lifts, uniform from 0 on: seconds. 0.
        pub lag_secs: f64 = 0.0,
        /// The part of the cells that always reads 0. 0.
        pub dead_fraction: f64 = 0.0,
        /// The part of the cells that always reads the largest count. 0.
        pub stuck_fraction: f64 = 0.0,
        /// The part of the readings that are spikes, and the standard deviation of a spike, half of a normal distribution. 0; 0.4 N.
        pub spike_fraction: f64 = 0.0,
        pub spike_newtons: f64 = 0.4,
        /// Whether all grasps share gains, offsets, dead and stuck cells and the encoders' zeros, or each draws its own. All share
        /// them.
        pub faults_of: FaultsOf = FaultsOf::Hand,
        /// Counts per N/cm². 256 (the Barrett hand's tactile driver).
        pub counts_per_newton_per_cm2: f64 = 256.0,
        /// The largest count. 4095: 12 bits.
        pub largest_count: u32 = 4095,
        /// Joint values are rounded to multiples of this, those of slides to multiples of 0.1 m for each radian. 2π/4096:
        /// assumed, a 12-bit encoder; 0 rounds nothing.
        pub encoder_quantum_rad: f64 = std::f64::consts::TAU / 4096.0,
        /// Standard deviation of the zero of each encoder. 0.
        pub encoder_offset_rad: f64 = 0.0,
        /// Share of the hands whose encoders are at the joints, in lifts; others have them at the motors, whose gears give. 0.
        pub joint_encoders: f64 = 0.0,
        /// Standard deviation of the noise of each force at the wrist. 0.1 N: assumed, of a sensor for 100 N and more.
        pub wrist_noise_newtons: f64 = 0.1,
        /// Standard deviation of the noise of each torque at the wrist, newton metres. 0.005: assumed, of the same sensor.
        pub wrist_noise_torque: f64 = 0.005,
        /// Standard deviation of the noise of each joint's torque, newton metres. 0.02: assumed, a fiftieth of the range of
        /// the BH8-280's strain gauges.
        pub joint_torque_noise: f64 = 0.02,
    }
}

/// The grasps that share gains and other faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultsOf {
    /// All grasps share them, because one hand made all grasps.
    #[default]
    Hand,
    /// Every grasp has its own, as if made by another hand of the same make.
    Grasp,
}

impl SensorOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        not_negative("noise_newtons", self.noise_newtons)?;
        not_negative("gain_sigma", self.gain_sigma)?;
        not_negative("common_gain_sigma", self.common_gain_sigma)?;
        not_negative("offset_newtons", self.offset_newtons)?;
        self.skin.check()?;
        require("lag_secs", self.lag_secs, (0.0..=1.0).contains(&self.lag_secs), "0 to 1")?;
        share("joint_encoders", self.joint_encoders)?;
        share("crosstalk", self.crosstalk)?;
        share("dead_fraction", self.dead_fraction)?;
        share("stuck_fraction", self.stuck_fraction)?;
        share("spike_fraction", self.spike_fraction)?;
        not_negative("spike_newtons", self.spike_newtons)?;
        share("dead_fraction + stuck_fraction", self.dead_fraction + self.stuck_fraction)?;
        positive("counts_per_newton_per_cm2", self.counts_per_newton_per_cm2)?;
        require("largest_count", self.largest_count, self.largest_count >= 1, "1 or more")?;
        not_negative("encoder_quantum_rad", self.encoder_quantum_rad)?;
        not_negative("encoder_offset_rad", self.encoder_offset_rad)?;
        not_negative("wrist_noise_newtons", self.wrist_noise_newtons)?;
        not_negative("wrist_noise_torque", self.wrist_noise_torque)?;
        not_negative("joint_torque_noise", self.joint_torque_noise)
    }
}

/// A sensor with its faults.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensor {
    cells: Vec<CellState>,
    /// Empty if there are none.
    offsets_newtons: Vec<f64>,
    /// The cells around each cell, if they feel a part of its force.
    neighbours: Vec<Vec<usize>>,
    /// Empty if all encoders have the right zero.
    encoder_offsets_rad: Vec<f64>,
    common_gain: f64,
    /// `None` for the rubber's patches.
    pub(crate) bell: Option<Bell>,
    pub(crate) lag_secs: f64,
    /// Whether the encoders are at the joints, behind the gears.
    pub(crate) reads_joints: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum CellState {
    Gain(f64),
    Dead,
    Stuck,
}

/// Stream of the random numbers of the hand's own faults, which no candidate uses.
const HAND_STREAM: u64 = u64::MAX - 1;

impl Sensor {
    /// Draws a sensor's faults: the hand's from `seed`, or this grasp's from `grasp_rng`.
    pub fn draw(hand: &Hand, options: &SensorOptions, seed: u64, grasp_rng: &mut impl rand::Rng) -> Sensor {
        match options.faults_of {
            FaultsOf::Grasp => Sensor::draw_faults(hand, options, grasp_rng),
            FaultsOf::Hand => {
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                rng.set_stream(HAND_STREAM);
                Sensor::draw_faults(hand, options, &mut rng)
            }
        }
    }

    fn draw_faults(hand: &Hand, options: &SensorOptions, rng: &mut dyn rand::Rng) -> Sensor {
        let mut cells = Vec::with_capacity(hand.n_cells());
        for _ in 0..hand.n_cells() {
            let (gain, fault) = ((options.gain_sigma * gaussian(rng)).exp(), rng.random::<f64>());
            cells.push(if fault < options.dead_fraction {
                CellState::Dead
            } else if fault < options.dead_fraction + options.stuck_fraction {
                CellState::Stuck
            } else {
                CellState::Gain(gain)
            });
        }
        Sensor {
            cells,
            offsets_newtons: offsets(options.offset_newtons, hand.n_cells(), rng),
            encoder_offsets_rad: offsets(options.encoder_offset_rad, hand.joints.len(), rng),
            neighbours: if options.crosstalk > 0.0 { neighbours(hand) } else { Vec::new() },
            common_gain: offsets(options.common_gain_sigma, 1, rng).first().map_or(1.0, |gain| gain.exp()),
            lag_secs: if options.lag_secs > 0.0 { options.lag_secs * rng.random::<f64>() } else { 0.0 },
            reads_joints: options.joint_encoders > 0.0 && rng.random::<f64>() < options.joint_encoders,
            bell: options.skin.draw(rng),
        }
    }

    /// The cells' readings of the forces `cells_newtons` (one value per cell of the hand), newtons.
    pub fn read_cells(
        &self,
        hand: &Hand,
        cells_newtons: &[f64],
        options: &SensorOptions,
        rng: &mut impl rand::Rng,
    ) -> Vec<f64> {
        let mut pressed_newtons = cells_newtons.to_vec();
        for (idx, around) in self.neighbours.iter().enumerate().filter(|(_, around)| !around.is_empty()) {
            let lost_newtons = options.crosstalk * cells_newtons[idx];
            pressed_newtons[idx] -= lost_newtons;
            for near in around {
                pressed_newtons[*near] += lost_newtons / around.len() as f64;
            }
        }
        for (newtons, offset) in pressed_newtons.iter_mut().zip(&self.offsets_newtons) {
            *newtons += offset;
        }
        if options.spike_fraction > 0.0 {
            for newtons in &mut pressed_newtons {
                if rng.random::<f64>() < options.spike_fraction {
                    *newtons += (options.spike_newtons * gaussian(rng)).abs();
                }
            }
        }
        hand.cells()
            .zip(&self.cells)
            .zip(pressed_newtons)
            .map(|(((_, cell), state), newtons)| {
                let area_cm2 = cell.size_m[0] * cell.size_m[1] * 1e4;
                // Drawn for dead cells too, so that a fault changes no other cell's reading.
                let noise_newtons = options.noise_newtons * gaussian(rng);
                let largest = f64::from(options.largest_count);
                let counts = match state {
                    CellState::Dead => 0.0,
                    CellState::Stuck => largest,
                    CellState::Gain(gain) => {
                        let read_newtons = gain * self.common_gain * newtons + noise_newtons;
                        (read_newtons / area_cm2 * options.counts_per_newton_per_cm2).round().clamp(0.0, largest)
                    }
                };
                // Small negative noise rounds to -0.
                (counts + 0.0) / options.counts_per_newton_per_cm2 * area_cm2
            })
            .collect()
    }

    /// The encoders' readings of `joints`, within the joints' limits but for wrong zeros.
    pub fn read_joints(&self, hand: &Hand, joints: &[f64], options: &SensorOptions) -> Vec<f64> {
        let quantum_rad = options.encoder_quantum_rad;
        let offsets_rad = self.encoder_offsets_rad.iter().copied().chain(std::iter::repeat(0.0));
        hand.joints
            .iter()
            .zip(joints)
            .zip(offsets_rad)
            .map(|((joint, value), offset_rad)| {
                let per_radian = joint.kind.per_radian();
                let quantum = quantum_rad * per_radian;
                let read = value + offset_rad * per_radian;
                let rounded = if quantum > 0.0 { (read / quantum).round() * quantum } else { read };
                let off = offset_rad * per_radian;
                rounded.clamp(joint.lower + off.min(0.0), joint.upper + off.max(0.0))
            })
            .collect()
    }
}

/// The cells around each cell on its pad: those up to half as far again as the nearest one.
fn neighbours(hand: &Hand) -> Vec<Vec<usize>> {
    let cells: Vec<(usize, &Cell)> = hand.cells().collect();
    let mut neighbours = Vec::with_capacity(cells.len());
    for (idx, (pad_idx, cell)) in cells.iter().enumerate() {
        let mut others = Vec::new();
        for (other, (other_pad_idx, other_cell)) in cells.iter().enumerate() {
            if other != idx && other_pad_idx == pad_idx {
                others.push((other, (cell.position_in_link_m - other_cell.position_in_link_m).norm()));
            }
        }
        let nearest_m = others.iter().map(|(_, far_m)| *far_m).fold(f64::INFINITY, f64::min);
        others.retain(|(_, far_m)| *far_m <= 1.5 * nearest_m);
        neighbours.push(others.into_iter().map(|(other, _)| other).collect());
    }
    neighbours
}

/// Drawn only where there are any: the noise of other sensors stays as it was.
fn offsets(sigma: f64, n: usize, rng: &mut dyn rand::Rng) -> Vec<f64> {
    if sigma > 0.0 { (0..n).map(|_| sigma * gaussian(rng)).collect() } else { Vec::new() }
}

/// The reading of the load on the wrist: force, then torque.
pub(crate) fn read_wrench(
    force: &Vector3<f64>,
    torque: &Vector3<f64>,
    options: &SensorOptions,
    rng: &mut impl rand::Rng,
) -> Vec<f64> {
    let force = force.map(|exact| exact + options.wrist_noise_newtons * gaussian(rng));
    let torque = torque.map(|exact| exact + options.wrist_noise_torque * gaussian(rng));
    force.iter().chain(&torque).copied().collect()
}

/// The readings of the joints' torques.
pub(crate) fn read_torques(torques: &[f64], options: &SensorOptions, rng: &mut impl rand::Rng) -> Vec<f64> {
    torques.iter().map(|exact| exact + options.joint_torque_noise * gaussian(rng)).collect()
}

/// Standard normal (Box & Muller).
pub fn gaussian(rng: &mut (impl rand::Rng + ?Sized)) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn sensor(options: &SensorOptions) -> (Hand, Sensor, ChaCha8Rng) {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let sensor = Sensor::draw(&hand, options, 7, &mut rng);
        (hand, sensor, rng)
    }

    #[test]
    fn readings_are_counts_between_zero_and_saturation() {
        let quiet = SensorOptions { noise_newtons: 0.0, ..SensorOptions::default() };
        let (hand, sensor, mut rng) = sensor(&quiet);
        let mut forces = vec![0.0; hand.n_cells()];
        forces[0] = 1.0;
        forces[1] = 1000.0;
        let readings = sensor.read_cells(&hand, &forces, &quiet, &mut rng);
        // 1 N on 0.97 cm² is 263.9 counts, read as 264.
        assert!((readings[0] - 264.0 / 256.0 * 0.97).abs() < 1e-12);
        assert!((readings[1] - 4095.0 / 256.0 * 0.97).abs() < 1e-12);
        assert!(readings[2..].iter().all(|reading| *reading == 0.0));
    }

    #[test]
    fn noise_has_the_stated_size() {
        let options = SensorOptions { noise_newtons: 0.05, ..SensorOptions::default() };
        let (hand, sensor, mut rng) = sensor(&options);
        let forces = vec![2.0; hand.n_cells()];
        let squares: Vec<f64> = (0..100)
            .flat_map(|_| sensor.read_cells(&hand, &forces, &options, &mut rng))
            .map(|reading| (reading - 2.0).powi(2))
            .collect();
        let sigma = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!((sigma - 0.05).abs() < 0.002, "{sigma}");
    }

    #[test]
    fn spikes_have_the_stated_share_and_size() {
        let quiet = SensorOptions { noise_newtons: 0.0, spike_fraction: 0.03, ..SensorOptions::default() };
        let (hand, sensor, mut rng) = sensor(&quiet);
        let (mut squares, mut n_spikes, mut n_readings) = (0.0, 0, 0);
        for _ in 0..200 {
            for newtons in sensor.read_cells(&hand, &vec![2.0; hand.n_cells()], &quiet, &mut rng) {
                n_readings += 1;
                if newtons > 2.02 {
                    n_spikes += 1;
                    squares += (newtons - 2.0).powi(2);
                }
            }
        }
        let share = f64::from(n_spikes) / f64::from(n_readings);
        let sigma = (squares / f64::from(n_spikes)).sqrt();
        assert!((0.025..0.032).contains(&share) && (0.35..0.45).contains(&sigma), "{share}, {sigma} N");
    }

    #[test]
    fn gains_spread_cells_die_or_stick_and_the_others_read_as_before() {
        let quiet = SensorOptions { noise_newtons: 0.0, faults_of: FaultsOf::Grasp, ..SensorOptions::default() };
        let faulty = SensorOptions { gain_sigma: 0.1, dead_fraction: 0.1, stuck_fraction: 0.05, ..quiet.clone() };
        let (hand, _, mut rng) = sensor(&quiet);
        // Below saturation of the smallest cell, at the fingers' tips.
        let forces = vec![1.0; hand.n_cells()];
        let (mut n_dead, mut n_stuck, mut logs) = (0, 0, Vec::new());
        for _ in 0..100 {
            let sensor = Sensor::draw(&hand, &faulty, 7, &mut rng);
            let readings = sensor.read_cells(&hand, &forces, &faulty, &mut rng);
            for (reading, (_, cell)) in readings.iter().zip(hand.cells()) {
                let largest = 4095.0 / 256.0 * cell.size_m[0] * cell.size_m[1] * 1e4;
                if *reading == 0.0 {
                    n_dead += 1;
                } else if (reading - largest).abs() < 1e-12 {
                    n_stuck += 1;
                } else {
                    logs.push(reading.ln());
                }
            }
        }
        // 9600 cells: 960 ± 29 dead, 480 ± 21 stuck.
        assert!((850..1070).contains(&n_dead) && (390..570).contains(&n_stuck), "{n_dead} {n_stuck}");
        let sigma = (logs.iter().map(|log| log * log).sum::<f64>() / logs.len() as f64).sqrt();
        assert!((sigma - 0.1).abs() < 0.01, "{sigma}");
    }

    #[test]
    fn crosstalk_moves_force_to_the_cells_around_and_offsets_add_to_all() {
        let quiet = SensorOptions { noise_newtons: 0.0, counts_per_newton_per_cm2: 1e6, ..SensorOptions::default() };
        let quiet = SensorOptions { largest_count: u32::MAX, ..quiet };
        let (hand, exact, mut rng) = sensor(&quiet);
        let mut forces = vec![0.0; hand.n_cells()];
        forces[30] = 2.0;
        let crosstalk = SensorOptions { crosstalk: 0.25, ..quiet.clone() };
        let read = Sensor::draw(&hand, &crosstalk, 7, &mut rng).read_cells(&hand, &forces, &crosstalk, &mut rng);
        assert!((read[30] - 1.5).abs() < 1e-3 && (read.iter().sum::<f64>() - 2.0).abs() < 1e-3, "{read:?}");
        let around: Vec<usize> = (0..read.len()).filter(|idx| *idx != 30 && read[*idx] > 0.0).collect();
        let pad = hand.cells().nth(30).expect("a cell").0;
        assert!((2..=8).contains(&around.len()), "{around:?}");
        assert!(around.iter().all(|idx| hand.cells().nth(*idx).expect("a cell").0 == pad), "{around:?}");

        let drifted = SensorOptions { offset_newtons: 0.1, encoder_offset_rad: 0.05, ..quiet.clone() };
        let drawn = Sensor::draw(&hand, &drifted, 7, &mut rng);
        let forces = vec![5.0; hand.n_cells()];
        let squares =
            drawn.read_cells(&hand, &forces, &drifted, &mut rng).iter().map(|read| (read - 5.0).powi(2)).sum::<f64>();
        let sigma = (squares / hand.n_cells() as f64).sqrt();
        assert!((0.07..0.13).contains(&sigma), "{sigma}");
        let joints: Vec<f64> = hand.joints.iter().map(|joint| 0.5 * (joint.lower + joint.upper)).collect();
        let moved = |sensor: &Sensor| {
            let read = sensor.read_joints(&hand, &joints, &drifted);
            read.iter().zip(&joints).map(|(read, exact)| (read - exact).abs()).fold(0.0, f64::max)
        };
        assert!(moved(&exact) < 1e-3 && moved(&drawn) > 0.01, "{} {}", moved(&exact), moved(&drawn));
    }

    #[test]
    fn one_hands_faults_are_the_same_in_every_grasp() {
        let options = SensorOptions { gain_sigma: 0.2, ..SensorOptions::default() };
        let (hand, one, mut rng) = sensor(&options);
        assert_eq!(one, Sensor::draw(&hand, &options, 7, &mut rng));
        assert_ne!(one, Sensor::draw(&hand, &options, 8, &mut rng));
    }

    #[test]
    fn encoders_round_within_limits() {
        let (hand, sensor, _) = sensor(&SensorOptions::default());
        let read = sensor.read_joints(&hand, &[0.5, 2.4435, 0.0, 1e-4, 0.8378, 0.1, 0.2], &SensorOptions::default());
        assert!((read[0] - 0.5).abs() <= std::f64::consts::PI / 4096.0);
        assert!(read[1] <= 2.4435 && read[4] <= 0.8378 && read[3] == 0.0);
    }
}
