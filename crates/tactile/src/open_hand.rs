//! The zero of each cell: its mean reading while the hand is open and touches nothing.

use blindgrasp_messages::Phase;

use super::Reading;

/// The number of open frames whose mean counts. Half a second at 100 Hz, which drift does not notice, and a tenth of one frame's
/// noise.
const N_FRAMES: f64 = 50.0;

/// Takes the readings of the open hand from those that follow.
#[derive(Debug, Clone, Default)]
pub struct OpenHand {
    n_frames: f64,
    mean: Vec<f64>,
}

impl OpenHand {
    /// Subtracts each cell's zero from a reading. The result is 0 where it would be negative. An open hand's reading is counted
    /// first. False if no open frame has come yet.
    pub fn subtract_from(&mut self, reading: &mut Reading) -> bool {
        let cells = &mut reading.cells_newtons;
        if reading.phase == Phase::Open {
            self.n_frames = (self.n_frames + 1.0).min(N_FRAMES);
            self.mean.resize(cells.len(), 0.0);
            for (mean, cell) in self.mean.iter_mut().zip(&*cells) {
                *mean += (cell - *mean) / self.n_frames;
            }
        }
        cells.iter_mut().zip(&self.mean).for_each(|(cell, zero)| *cell = (*cell - zero).max(0.0));
        self.n_frames > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading(phase: Phase, cells: &[f64]) -> Reading {
        Reading { phase, cells_newtons: cells.to_vec(), ..Reading::default() }
    }

    #[test]
    fn the_mean_of_the_open_hand_is_zero() {
        let mut zero = OpenHand::default();
        assert!(!zero.subtract_from(&mut reading(Phase::Closing, &[1.0, 1.0])), "no open frame came before");
        for cells in [[0.125, 0.5], [0.375, 0.5]] {
            assert!(zero.subtract_from(&mut reading(Phase::Open, &cells)));
        }
        let mut settled = reading(Phase::Settled, &[1.25, 0.25]);
        assert!(zero.subtract_from(&mut settled));
        assert_eq!(settled.cells_newtons, [1.0, 0.0]);
    }

    #[test]
    fn the_zero_follows_a_drift() {
        let mut zero = OpenHand::default();
        for step in 0..2000 {
            assert!(zero.subtract_from(&mut reading(Phase::Open, &[f64::from(step) * 1e-3])));
        }
        let mut settled = reading(Phase::Settled, &[3.0]);
        assert!(zero.subtract_from(&mut settled));
        assert!((settled.cells_newtons[0] - 1.0).abs() < 0.06, "{settled:?}");
    }
}
