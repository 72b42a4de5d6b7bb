//! The zero of each cell: its mean reading while the hand is open and touches nothing. It makes forces, which are not negative,
//! of the readings of sensors that are tared, drift, or fall under load.

use blindgrasp_messages::Phase;
use blindgrasp_stages::hand::Hand;

use super::Reading;

/// The number of open frames whose mean counts. Half a second at 100 Hz, which drift does not notice, and a tenth of one frame's
/// noise.
const N_FRAMES: f64 = 50.0;

/// Takes the readings of the open hand from those that follow, if it is to, and leaves none below 0.
#[derive(Debug, Clone)]
pub struct CellZeros {
    /// Of each cell.
    noise_thresholds: Vec<f64>,
    /// Whether the reading of a cell falls under load.
    falls: Vec<bool>,
    open_hand: Option<OpenHand>,
}

#[derive(Debug, Clone, Default)]
struct OpenHand {
    n_frames: f64,
    mean: Vec<f64>,
}

/// The result of zeroing a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Zeroed {
    /// No open frame has come yet: its zeros are not known.
    Unknown,
    /// Forces, of which none was below 0 but by noise.
    Forces,
    /// A cell read less than 0 and counts as 0: with the open hand's zero, by more than its noise threshold; without, by less.
    BelowZero,
}

/// Refuses readings below the least that each cell may have, which is 0 where none is given.
///
/// # Errors
/// The first such reading, for a person.
pub fn check_readings(cells: &[f64], least_readings: Option<&[f64]>) -> Result<(), String> {
    let least = |idx: usize| least_readings.map_or(0.0, |readings| readings[idx]);
    let wrong = cells.iter().enumerate().find(|(idx, reading)| !(reading.is_finite() && **reading >= least(*idx)));
    let Some((idx, reading)) = wrong else { return Ok(()) };
    let expected = match least(idx) {
        f64::NEG_INFINITY => "expected a finite number".into(),
        least if reading.is_finite() => format!(
            "expected at least {least}, the cell's noise threshold below 0: a sensor that is tared or drifts needs zero_when_open"
        ),
        _ => "expected a force, which is not negative".to_owned(),
    };
    Err(format!("cells_newtons[{idx}] is {reading}: {expected}"))
}

impl CellZeros {
    /// The cells of a hand, with the mean of the open hand as zero or without.
    ///
    /// # Errors
    /// Cells whose readings fall under load have no force without such a zero.
    pub fn new(hand: &Hand, zero_when_open: bool) -> Result<CellZeros, String> {
        if let Some(pad) = hand.pads.iter().find(|pad| pad.falls_under_load && !zero_when_open) {
            return Err(format!("the readings of pad '{}' fall under load: set zero_when_open", pad.name));
        }
        Ok(CellZeros {
            noise_thresholds: hand.cells().map(|(_, cell)| cell.noise_threshold_newtons).collect(),
            falls: hand.cells().map(|(pad_idx, _)| hand.pads[pad_idx].falls_under_load).collect(),
            open_hand: zero_when_open.then(OpenHand::default),
        })
    }

    /// The least reading that each cell may have.
    pub fn least_readings(&self) -> Vec<f64> {
        let least = |threshold: &f64| if self.open_hand.is_some() { f64::NEG_INFINITY } else { -threshold };
        self.noise_thresholds.iter().map(least).collect()
    }

    /// Makes forces of the readings of the cells. An open hand's reading is counted first.
    pub fn apply(&mut self, reading: &mut Reading) -> Zeroed {
        let cells = &mut reading.cells_newtons;
        if let Some(OpenHand { n_frames, mean }) = &mut self.open_hand {
            if reading.phase == Phase::Open {
                *n_frames = (*n_frames + 1.0).min(N_FRAMES);
                mean.resize(cells.len(), 0.0);
                mean.iter_mut().zip(&*cells).for_each(|(mean, cell)| *mean += (cell - *mean) / *n_frames);
            }
            if *n_frames == 0.0 {
                return Zeroed::Unknown;
            }
            for ((cell, zero), falls) in cells.iter_mut().zip(mean).zip(&self.falls) {
                *cell = if *falls { *zero - *cell } else { *cell - *zero };
            }
        }
        let is_zeroed = self.open_hand.is_some();
        let mut is_below = false;
        for (cell, threshold) in cells.iter_mut().zip(&self.noise_thresholds) {
            is_below |= *cell < if is_zeroed { -threshold } else { 0.0 };
            *cell = cell.max(0.0);
        }
        if is_below { Zeroed::BelowZero } else { Zeroed::Forces }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Two pads of one cell each with a threshold of 0.1, the second of which may fall.
    fn zeros(falls: bool, zero_when_open: bool) -> Result<CellZeros, String> {
        let mut hand = Hand::load(Path::new("parallel-gripper")).expect("built in");
        hand.pads.truncate(2);
        for pad in &mut hand.pads {
            pad.cells.truncate(1);
            pad.cells[0].noise_threshold_newtons = 0.1;
        }
        hand.pads[1].falls_under_load = falls;
        CellZeros::new(&hand, zero_when_open)
    }

    fn reading(phase: Phase, cells: &[f64]) -> Reading {
        Reading { phase, cells_newtons: cells.to_vec(), ..Reading::default() }
    }

    #[test]
    fn the_mean_of_the_open_hand_is_zero() {
        let mut zeros = zeros(true, true).expect("zeros");
        assert_eq!(zeros.least_readings(), [f64::NEG_INFINITY; 2]);
        assert_eq!(
            zeros.apply(&mut reading(Phase::Closing, &[1.0, 1.0])),
            Zeroed::Unknown,
            "no open frame came before"
        );
        for cells in [[-0.375, 0.5], [-0.125, 0.5]] {
            assert_eq!(zeros.apply(&mut reading(Phase::Open, &cells)), Zeroed::Forces);
        }
        for (cells, expected, zeroed) in [
            ([0.75, 0.25], [1.0, 0.25], Zeroed::Forces),
            ([-0.3125, 0.5625], [0.0, 0.0], Zeroed::Forces),
            ([-0.5, 0.25], [0.0, 0.25], Zeroed::BelowZero),
        ] {
            let mut settled = reading(Phase::Settled, &cells);
            assert_eq!((zeros.apply(&mut settled), &settled.cells_newtons[..]), (zeroed, &expected[..]), "{cells:?}");
        }
    }

    #[test]
    fn without_it_noise_around_zero_is_no_force() {
        let mut plain = zeros(false, false).expect("zeros");
        assert_eq!(plain.least_readings(), [-0.1; 2]);
        let mut settled = reading(Phase::Settled, &[-0.05, 0.5]);
        assert_eq!((plain.apply(&mut settled), &settled.cells_newtons[..]), (Zeroed::BelowZero, &[0.0, 0.5][..]));
        assert_eq!(plain.apply(&mut reading(Phase::Settled, &[0.0, 0.5])), Zeroed::Forces);
        assert!(zeros(true, false).expect_err("no zero").contains("zero_when_open"));
    }

    #[test]
    fn the_zero_follows_a_drift() {
        let mut zeros = zeros(false, true).expect("zeros");
        for step in 0..2000 {
            assert_ne!(zeros.apply(&mut reading(Phase::Open, &[f64::from(step) * 1e-3, 0.0])), Zeroed::Unknown);
        }
        let mut settled = reading(Phase::Settled, &[3.0, 0.0]);
        assert_eq!(zeros.apply(&mut settled), Zeroed::Forces);
        assert!((settled.cells_newtons[0] - 1.0).abs() < 0.06, "{settled:?}");
    }
}
