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
    cells: Vec<CellSense>,
    open_hand: Option<Vec<OpenReading>>,
    /// Whether a frame of the open hand has come.
    was_open: bool,
}

/// The keys of the layout for a cell.
#[derive(Debug, Clone, Copy)]
struct CellSense {
    noise_threshold: f64,
    /// Whether its reading falls under load.
    falls: bool,
    may_be_missing: bool,
    /// The reading that it has at its greatest load and above.
    saturates_at: Option<f64>,
}

/// The mean reading of a cell while the hand was open.
#[derive(Debug, Clone, Copy, Default)]
struct OpenReading {
    n_frames: f64,
    mean: f64,
}

/// A reading of which forces were made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Zeroed {
    /// A cell read less than 0 and counts as 0: with the open hand's zero, by more than its noise threshold; without, by less.
    pub is_below_zero: bool,
    /// A cell that may be missing was, and counts as 0.
    pub has_missing: bool,
}

/// The readings that the cells of a hand may have.
#[derive(Debug, Clone, PartialEq)]
pub struct AllowedReadings {
    /// For each cell, the least reading, and whether it may be missing (not a number).
    cells: Vec<(f64, bool)>,
}

impl AllowedReadings {
    /// Refuses other readings. Where none are given, forces are allowed.
    ///
    /// # Errors
    /// The first such reading, for a person.
    pub fn check(allowed: Option<&AllowedReadings>, cells: &[f64]) -> Result<(), String> {
        for (idx, reading) in cells.iter().enumerate() {
            let (least, may_be_missing) = allowed.map_or((0.0, false), |allowed| allowed.cells[idx]);
            let expected = if reading.is_nan() {
                if may_be_missing {
                    continue;
                }
                "expected a number; a pad whose cells may be missing says may_be_missing in the hand's layout".into()
            } else if reading.is_finite() && *reading >= least {
                continue;
            } else if least == f64::NEG_INFINITY || !reading.is_finite() {
                "expected a finite number".into()
            } else {
                let noise = if least < 0.0 { ", the cell's noise threshold below 0" } else { "" };
                format!("expected at least {least}{noise}: a sensor that is tared or drifts needs zero_when_open")
            };
            let found = if reading.is_nan() { "missing".into() } else { reading.to_string() };
            return Err(format!("cells_newtons[{idx}] is {found}: {expected}"));
        }
        Ok(())
    }

    /// Whether these are readings of so many cells.
    pub fn has_cells(&self, n_cells: usize) -> bool {
        self.cells.len() == n_cells
    }
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
        let cells = hand.cells().map(|(pad_idx, cell)| {
            let pad = &hand.pads[pad_idx];
            CellSense {
                noise_threshold: cell.noise_threshold_newtons,
                falls: pad.falls_under_load,
                may_be_missing: pad.may_be_missing,
                saturates_at: pad.saturates_at_newtons,
            }
        });
        let cells: Vec<CellSense> = cells.collect();
        let open_hand = zero_when_open.then(|| vec![OpenReading::default(); cells.len()]);
        Ok(CellZeros { cells, open_hand, was_open: false })
    }

    /// The readings that the cells may have.
    pub fn allowed(&self) -> AllowedReadings {
        let is_zeroed = self.open_hand.is_some();
        let cells = self
            .cells
            .iter()
            .map(|cell| (if is_zeroed { f64::NEG_INFINITY } else { -cell.noise_threshold }, cell.may_be_missing));
        AllowedReadings { cells: cells.collect() }
    }

    /// Makes forces of the readings of the cells. An open hand's reading is counted first.
    ///
    /// # Errors
    /// The zero of a cell is not known, for a person: no open frame came, or the cell was at its greatest load in all of them.
    pub fn apply(&mut self, reading: &mut Reading) -> Result<Zeroed, String> {
        let is_zeroed = self.open_hand.is_some();
        if let Some(open_hand) = &mut self.open_hand {
            if reading.phase == Phase::Open {
                self.was_open = true;
                for ((open, cell), found) in open_hand.iter_mut().zip(&self.cells).zip(&reading.cells_newtons) {
                    if cell.is_saturated(*found) {
                        // Something presses it, or it is stuck: its earlier zero holds no longer.
                        *open = OpenReading::default();
                    } else if found.is_finite() {
                        open.n_frames = (open.n_frames + 1.0).min(N_FRAMES);
                        open.mean += (found - open.mean) / open.n_frames;
                    }
                }
            }
            let cells = reading.cells_newtons.iter_mut().zip(open_hand).zip(&self.cells).enumerate();
            for (idx, ((found, open), cell)) in cells {
                if open.n_frames > 0.0 {
                    *found = if cell.falls { open.mean - *found } else { *found - open.mean };
                } else if cell.may_be_missing && self.was_open && !cell.is_saturated(*found) {
                    // Its zero is not known, so its reading counts as missing.
                    *found = f64::NAN;
                } else if self.was_open {
                    return Err(format!(
                        "zero_when_open: cell {idx} has no zero, because it was at its greatest load while the hand was open: \
                         expected a cell that nothing touches; free it, or see whether it is broken"
                    ));
                } else {
                    return Err(
                        "zero_when_open: no frame of the open hand came before it, expected the phase open first"
                            .into(),
                    );
                }
            }
        }
        let mut zeroed = Zeroed::default();
        for (found, cell) in reading.cells_newtons.iter_mut().zip(&self.cells) {
            zeroed.has_missing |= found.is_nan();
            zeroed.is_below_zero |= *found < if is_zeroed { -cell.noise_threshold } else { 0.0 };
            // A missing reading becomes 0, too.
            *found = found.max(0.0);
        }
        Ok(zeroed)
    }
}

impl CellSense {
    /// Whether a reading is that of the greatest load.
    fn is_saturated(&self, reading: f64) -> bool {
        self.saturates_at.is_some_and(|limit| if self.falls { reading <= limit } else { reading >= limit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const FORCES: Result<Zeroed, String> = Ok(Zeroed { is_below_zero: false, has_missing: false });
    const BELOW_ZERO: Result<Zeroed, String> = Ok(Zeroed { is_below_zero: true, has_missing: false });

    /// Two pads of one cell each with a threshold of 0.1, the second of which may fall.
    fn zeros(falls: bool, zero_when_open: bool) -> Result<CellZeros, String> {
        CellZeros::new(&hand(falls), zero_when_open)
    }

    fn hand(falls: bool) -> Hand {
        let mut hand = Hand::load(Path::new("parallel-gripper")).expect("built in");
        hand.pads.truncate(2);
        for pad in &mut hand.pads {
            pad.cells.truncate(1);
            pad.cells[0].noise_threshold_newtons = 0.1;
        }
        hand.pads[1].falls_under_load = falls;
        hand
    }

    fn reading(phase: Phase, cells: &[f64]) -> Reading {
        Reading { phase, cells_newtons: cells.to_vec(), ..Reading::default() }
    }

    #[test]
    fn the_mean_of_the_open_hand_is_zero() {
        let mut zeros = zeros(true, true).expect("zeros");
        let refused = zeros.apply(&mut reading(Phase::Closing, &[1.0, 1.0])).expect_err("no zero");
        assert!(refused.contains("no frame of the open hand came before"), "{refused}");
        for cells in [[-0.375, 0.5], [-0.125, 0.5]] {
            assert_eq!(zeros.apply(&mut reading(Phase::Open, &cells)), FORCES);
        }
        for (cells, expected, zeroed) in [
            ([0.75, 0.25], [1.0, 0.25], FORCES),
            ([-0.3125, 0.5625], [0.0, 0.0], FORCES),
            ([-0.5, 0.25], [0.0, 0.25], BELOW_ZERO),
        ] {
            let mut settled = reading(Phase::Settled, &cells);
            assert_eq!((zeros.apply(&mut settled), &settled.cells_newtons[..]), (zeroed, &expected[..]), "{cells:?}");
        }
    }

    #[test]
    fn without_it_noise_around_zero_is_no_force() {
        let mut plain = zeros(false, false).expect("zeros");
        assert_eq!(AllowedReadings::check(Some(&plain.allowed()), &[-0.05, 0.5]), Ok(()));
        let refused = AllowedReadings::check(Some(&plain.allowed()), &[0.0, -0.125]).expect_err("below the noise");
        assert!(refused.contains("cells_newtons[1] is -0.125: expected at least -0.1"), "{refused}");
        let mut settled = reading(Phase::Settled, &[-0.05, 0.5]);
        assert_eq!((plain.apply(&mut settled), &settled.cells_newtons[..]), (BELOW_ZERO, &[0.0, 0.5][..]));
        assert_eq!(plain.apply(&mut reading(Phase::Settled, &[0.0, 0.5])), FORCES);
        assert!(zeros(true, false).expect_err("no zero").contains("zero_when_open"));
    }

    #[test]
    fn the_zero_follows_a_drift() {
        let mut zeros = zeros(false, true).expect("zeros");
        for step in 0..2000 {
            zeros.apply(&mut reading(Phase::Open, &[f64::from(step) * 1e-3, 0.0])).expect("a zero");
        }
        let mut settled = reading(Phase::Settled, &[3.0, 0.0]);
        assert_eq!(zeros.apply(&mut settled), FORCES);
        assert!((settled.cells_newtons[0] - 1.0).abs() < 0.06, "{settled:?}");
    }

    #[test]
    fn a_missing_cell_feels_nothing_where_the_layout_allows_it() {
        let mut hand = hand(false);
        let zeros = CellZeros::new(&hand, true).expect("zeros");
        let refused = AllowedReadings::check(Some(&zeros.allowed()), &[0.0, f64::NAN]).expect_err("a missing cell");
        assert!(refused.contains("cells_newtons[1] is missing") && refused.contains("may_be_missing"), "{refused}");
        hand.pads[1].may_be_missing = true;
        for zero_when_open in [false, true] {
            let mut zeros = CellZeros::new(&hand, zero_when_open).expect("zeros");
            assert_eq!(AllowedReadings::check(Some(&zeros.allowed()), &[0.0, f64::NAN]), Ok(()));
            let early = zeros.apply(&mut reading(Phase::Settled, &[5.0, f64::NAN]));
            assert_eq!(early.is_err(), zero_when_open, "no frame of the open hand came before it");
            zeros.apply(&mut reading(Phase::Open, &[0.0, f64::NAN])).expect("the zero of the other cell");
            // Its zero is not known, so its reading counts as missing.
            let mut settled = reading(Phase::Settled, &[0.5, if zero_when_open { 2.0 } else { f64::NAN }]);
            assert_eq!(zeros.apply(&mut settled), Ok(Zeroed { is_below_zero: false, has_missing: true }));
            assert_eq!(settled.cells_newtons, [0.5, 0.0]);
        }
    }

    #[test]
    fn a_saturated_cell_of_the_open_hand_has_no_zero() {
        for (falls, full, light) in [(false, 4.0, 0.25), (true, 0.25, 4.0)] {
            let mut hand = hand(falls);
            hand.pads[1].saturates_at_newtons = Some(full);
            let mut zeros = CellZeros::new(&hand, true).expect("zeros");
            let refused = zeros.apply(&mut reading(Phase::Open, &[0.0, full])).expect_err("something presses it");
            assert!(refused.contains("cell 1") && refused.contains("its greatest load"), "{refused}");
            assert_eq!(zeros.apply(&mut reading(Phase::Open, &[0.0, light])), FORCES);
            let mut settled = reading(Phase::Settled, &[0.0, full]);
            assert_eq!(zeros.apply(&mut settled), FORCES);
            assert_eq!(settled.cells_newtons, [0.0, 3.75]);
            // It sticks later: the grasp is not judged by a load that nobody put on it.
            zeros.apply(&mut reading(Phase::Open, &[0.0, full])).expect_err("it is stuck");
            zeros.apply(&mut reading(Phase::Settled, &[0.0, full])).expect_err("its zero is not known");
        }
    }
}
