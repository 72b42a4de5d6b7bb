//! Finds glitches of cells, readings of one frame that no contact makes, and leaves them out unless the hand's layout says no.
//!
//! With `median_filter`, a cell reads the median of its last three readings in a phase of a grasp; of the first two, the smaller
//! one. So a spike of one frame is no contact, and a cell that one frame misses still feels. A contact comes and goes a frame later.
//! Some readings count as they are: the first one of a phase, because frames of another phase are of another posture; a frame
//! without any active cell, because the object may have gone; and all while the arm lifts, because its watch should not wait.
//!
//! Pure: no clock, no I/O. [`GlitchFilter`] is the state.

use serde::{Deserialize, Serialize};

use crate::contacts::are_forces;
use crate::hand::Hand;
use blindgrasp_messages::Phase;

/// The most cells of a hand whose readings are filtered. A node saves 256 KiB, and a cell that feels takes 64 bytes of an answer, 16
/// of this filter and 24 of the watch for faulty sensors.
pub(crate) const MAX_FILTERED_CELLS: usize = 2000;

/// A spike is so many noise thresholds high. A load at the threshold goes to and fro about it.
const SPIKE_THRESHOLDS: f64 = 3.0;
/// A grasp flickers if so many readings are spikes, and one in so many frames. A sliding contact makes single ones.
const MIN_SPIKES: u32 = 10;
const FRAMES_A_SPIKE: u32 = 5;

/// What is kept of a grasp's frames. Another filter can continue from it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GlitchFilter {
    /// Epoch, grasp and phase of the last frame.
    place: Option<(u64, u64, Phase)>,
    /// The cells of the last frame and of the one before, if they are of this phase: newtons; 0 if not active.
    before: [Vec<f64>; 2],
    n_before: u32,
    spikes: Spikes,
    /// As many values as the hand has cells, used again.
    #[serde(skip)]
    steady: Vec<f64>,
}

/// The spikes of a grasp.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Spikes {
    n_frames: u32,
    n_spikes: u32,
    /// The cell with the highest one, and its height in noise thresholds.
    highest: Option<(u32, f64)>,
}

impl GlitchFilter {
    /// The cells of a frame, filtered unless the hand's layout says no.
    ///
    /// * `epoch`, `grasp_id` - the frame's.
    /// * `cells_newtons` - one value per cell of the hand. A frame that cannot be used comes back as it is.
    pub fn steady<'a>(
        &'a mut self,
        hand: &Hand,
        (epoch, grasp_id): (u64, u64),
        phase: Phase,
        cells_newtons: &'a [f64],
    ) -> &'a [f64] {
        let thresholds = hand.noise_thresholds_newtons();
        if cells_newtons.len() != thresholds.len() || !are_forces(cells_newtons) {
            self.n_before = 0;
            return cells_newtons;
        }
        if self.place.is_none_or(|(of_epoch, of_grasp, _)| (of_epoch, of_grasp) != (epoch, grasp_id)) {
            self.spikes = Spikes::default();
        }
        let place = Some((epoch, grasp_id, phase));
        if self.place != place || self.before.iter().any(|cells| cells.len() != thresholds.len()) {
            self.place = place;
            self.n_before = 0;
            for cells in &mut self.before {
                cells.clear();
                cells.resize(thresholds.len(), 0.0);
            }
        }
        self.note_spikes(thresholds, cells_newtons);
        let feels = cells_newtons.iter().zip(thresholds).any(|(now, threshold)| now > threshold);
        let is_filtered = hand.median_filter && self.n_before > 0 && phase != Phase::Lifting && feels;
        if is_filtered {
            self.steady.clear();
            for (cell, now) in cells_newtons.iter().enumerate() {
                let (last, earlier) = (self.before[0][cell], self.before[1][cell]);
                let smaller = now.min(last);
                let median = if self.n_before < 2 { smaller } else { smaller.max(earlier.min(now.max(last))) };
                self.steady.push(median);
            }
        }
        self.remember(thresholds, cells_newtons);
        if is_filtered { &self.steady } else { cells_newtons }
    }

    /// Counts the cells that were active in the last frame, and neither before nor after it.
    fn note_spikes(&mut self, thresholds: &[f64], cells_newtons: &[f64]) {
        if self.n_before < 2 {
            return;
        }
        self.spikes.n_frames += 1;
        let [last, earlier] = &self.before;
        for (cell, threshold) in thresholds.iter().enumerate() {
            let height = last[cell] / threshold;
            if height > SPIKE_THRESHOLDS && earlier[cell] == 0.0 && cells_newtons[cell] <= *threshold {
                self.spikes.n_spikes += 1;
                if self.spikes.highest.is_none_or(|(_, highest)| height > highest) {
                    self.spikes.highest = Some((cell as u32, height));
                }
            }
        }
    }

    fn remember(&mut self, thresholds: &[f64], cells_newtons: &[f64]) {
        self.before.swap(0, 1);
        self.n_before = (self.n_before + 1).min(2);
        for ((kept, now), threshold) in self.before[0].iter_mut().zip(cells_newtons).zip(thresholds) {
            *kept = if now > threshold { *now } else { 0.0 };
        }
    }

    /// That cells flicker in the grasp of the last frame, if they do, and it has this number: for people.
    pub fn flicker(&self, hand: &Hand, grasp_id: u64) -> Option<String> {
        let Spikes { n_frames, n_spikes, highest } = &self.spikes;
        let is_of_grasp = self.place.is_some_and(|(_, of_grasp, _)| of_grasp == grasp_id);
        if !is_of_grasp || *n_spikes < MIN_SPIKES || n_spikes * FRAMES_A_SPIKE < *n_frames {
            return None;
        }
        let cell_idx = highest.as_ref()?.0 as usize;
        let pad = hand.pads.iter().rfind(|pad| pad.first_cell_idx <= cell_idx)?;
        let of_pad = cell_idx - pad.first_cell_idx;
        let found = format!(
            "cells flicker: {n_spikes} spikes of one frame in {n_frames} frames, the highest at cell {of_pad} of pad {}",
            pad.name
        );
        let is_off = !hand.median_filter && hand.n_cells() <= MAX_FILTERED_CELLS;
        let remedy = if is_off { "; without median_filter: false in the hand's layout they are left out" } else { "" };
        Some(found + remedy)
    }
}

/// The frames of a grasp, with the cells that the contacts stage makes of them one after the other.
pub fn without_glitches<'a>(hand: &Hand, frames: impl Iterator<Item = (Phase, &'a mut Vec<f64>)>) {
    let mut filter = GlitchFilter::default();
    for (phase, cells_newtons) in frames {
        let steady = filter.steady(hand, (0, 0), phase, cells_newtons).to_vec();
        *cells_newtons = steady;
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn hand(median_filter: bool) -> Hand {
        let mut hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        hand.median_filter = median_filter;
        hand
    }

    /// A frame in which one cell reads so many newtons, and another one 1 N.
    fn frame(hand: &Hand, newtons: f64) -> Vec<f64> {
        let mut cells = vec![0.01; hand.n_cells()];
        (cells[7], cells[30]) = (newtons, 1.0);
        cells
    }

    #[test]
    fn a_spike_of_one_frame_is_left_out_and_a_contact_comes_a_frame_later() {
        let hand = hand(true);
        let mut filter = GlitchFilter::default();
        let readings = [0.5, 0.0, 0.0, 3.0, 0.0, 2.0, 2.1, 0.0, 2.2, 0.0, 0.0];
        let expected = [0.5, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 2.1, 0.0, 0.0];
        for (reading, expected) in readings.into_iter().zip(expected) {
            let steady = filter.steady(&hand, (1, 2), Phase::Settled, &frame(&hand, reading))[7];
            assert_eq!(steady, expected, "{reading}");
        }
        // Where no cell feels any more, the object may have gone.
        filter.steady(&hand, (1, 2), Phase::Settled, &frame(&hand, 2.0));
        let nothing = vec![0.0; hand.n_cells()];
        assert_eq!(filter.steady(&hand, (1, 2), Phase::Settled, &nothing), nothing);
        // A phase, a grasp and a lift begin with the reading itself.
        for (grasp, phase) in [(2, Phase::Squeezing), (3, Phase::Squeezing), (3, Phase::Lifting), (3, Phase::Lifting)] {
            assert_eq!(filter.steady(&hand, (1, grasp), phase, &frame(&hand, 4.0))[7], 4.0);
        }
    }

    #[test]
    fn without_the_filter_nothing_is_changed_and_flicker_is_named() {
        let (hand, mut filter) = (hand(false), GlitchFilter::default());
        for idx in 0..60 {
            let cells = frame(&hand, if idx % 3 == 0 { 0.4 } else { 0.0 });
            assert_eq!(filter.steady(&hand, (1, 2), Phase::Closing, &cells), cells);
        }
        let said = filter.flicker(&hand, 2).expect("it flickers");
        assert!(said.contains("cell 7 of pad palm") && said.contains("median_filter"), "{said}");
        // A load that comes and stays is none.
        for idx in 0..60 {
            filter.steady(&hand, (1, 3), Phase::Closing, &frame(&hand, f64::from(idx / 10)));
        }
        assert_eq!(filter.flicker(&hand, 3), None);
    }

    #[test]
    fn a_frame_that_cannot_be_used_comes_back_as_it_is() {
        let (hand, mut filter) = (hand(true), GlitchFilter::default());
        filter.steady(&hand, (1, 2), Phase::Settled, &frame(&hand, 1.0));
        assert!(filter.steady(&hand, (1, 2), Phase::Settled, &frame(&hand, f64::NAN))[7].is_nan());
        assert_eq!(filter.steady(&hand, (1, 2), Phase::Settled, &[1.0]), [1.0]);
        assert_eq!(filter.steady(&hand, (1, 2), Phase::Settled, &frame(&hand, 0.0))[7], 0.0);
    }
}
