//! A skin that spreads force: each contact's force falls on the cells around it as a bell.
//!
//! It stands beside the rubber of [`crate::soft_finger`], whose cells feel nothing between and beyond them. Real skins lie
//! between one that loses that part and one that keeps all of it. The width grows with the fourth root of the force, as that of a
//! patch on an elastic mattress does.

use nalgebra::{Isometry3, Point3, UnitVector3};
use rand::RngExt;

use super::option_check::{OptionError, require, share, with_defaults};
use blindgrasp_stages::hand::Hand;

with_defaults! {
    /// How skins spread force. The hands that differ draw each their own.
    pub struct SkinOptions {
        /// Share of the hands whose skin spreads force as a bell; the others have the rubber's patches. 0.
        pub bell_share: f64 = 0.0,
        /// Range of the bell's standard deviation at 1 N, metres, its logarithm uniform. 1 to 4 mm.
        pub bell_m: [f64; 2] = [0.001, 0.004],
        /// Range of the share of the force between and beyond cells that the cells around feel all the same, uniform: 0 loses it, 1
        /// keeps it. `[0, 1]`.
        pub kept: [f64; 2] = [0.0, 1.0],
    }
}

impl SkinOptions {
    pub(crate) fn is_default(&self) -> bool {
        *self == SkinOptions::default()
    }

    pub(crate) fn check(&self) -> Result<(), OptionError> {
        share("skin.bell_share", self.bell_share)?;
        let [least, most] = self.bell_m;
        let is_range = least > 0.0 && least <= most && most <= 0.1;
        require("skin.bell_m", format!("[{least}, {most}]"), is_range, "two ascending lengths above 0, at most 0.1")?;
        let [least, most] = self.kept;
        let is_range = 0.0 <= least && least <= most && most <= 1.0;
        require("skin.kept", format!("[{least}, {most}]"), is_range, "two ascending shares from 0 to 1")
    }

    /// The bell of a hand; `None` for the rubber's patches.
    pub(crate) fn draw(&self, rng: &mut dyn rand::Rng) -> Option<Bell> {
        // Drawn only where there is a choice: the noise of other hands stays as it was.
        if self.bell_share == 0.0 {
            return None;
        }
        let [is_bell, width, kept] = [(); 3].map(|()| rng.random::<f64>());
        let ([low_m, high_m], [least, most]) = (self.bell_m.map(f64::ln), self.kept);
        let bell = Bell { sigma_m: (low_m + (high_m - low_m) * width).exp(), kept: least + (most - least) * kept };
        (is_bell < self.bell_share).then_some(bell)
    }
}

/// A skin that spreads force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bell {
    /// Standard deviation along each direction of the skin at 1 N, metres.
    sigma_m: f64,
    kept: f64,
}

/// A force on a link, in the palm frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pressure {
    pub(crate) link_idx: usize,
    pub(crate) point_m: Point3<f64>,
    /// The direction in which the link is pushed.
    pub(crate) direction: UnitVector3<f64>,
    pub(crate) newtons: f64,
}

/// Cells feel forces up to so far above or below them, metres.
const CELL_DEPTH_M: f64 = 0.006;
/// A skin that keeps force gives cells at most so many times the part of the bell that lies on them: of a force far beside the
/// pad they feel little.
const MOST_GAIN: f64 = 3.0;

/// The part of a logistic bell in a strip that is `x_m` beside it.
fn part_within(x_m: f64, width_m: f64, scale_m: f64) -> f64 {
    let [to, from] = [x_m + width_m / 2.0, x_m - width_m / 2.0].map(|x_m| 1.0 / (1.0 + (-x_m / scale_m).exp()));
    to - from
}

impl Bell {
    /// The forces on the cells of a hand, newtons.
    pub(crate) fn cells_newtons(
        &self,
        hand: &Hand,
        palm_from_links: &[Isometry3<f64>],
        pressures: impl IntoIterator<Item = Pressure>,
    ) -> Vec<f64> {
        let mut cells_newtons = vec![0.0; hand.n_cells()];
        let mut felt: Vec<(usize, f64)> = Vec::new();
        for Pressure { link_idx, point_m, direction, newtons } in pressures {
            let palm_from_link = &palm_from_links[link_idx];
            let point = palm_from_link.inverse_transform_point(&point_m);
            let direction = palm_from_link.rotation.inverse() * direction.into_inner();
            // Of a logistic bell: its standard deviation is π/√3 times its scale.
            let scale_m = self.sigma_m * newtons.powf(0.25) * 3.0_f64.sqrt() / std::f64::consts::PI;
            felt.clear();
            let mut on_cells = 0.0;
            for pad in hand.pads.iter().filter(|pad| pad.link_idx == link_idx) {
                for (cell_idx, cell) in pad.cells.iter().enumerate() {
                    let across = cell.normal_in_link.cross(&cell.along_in_link);
                    let (from_cell, along_normal) =
                        (point - cell.position_in_link_m, -cell.normal_in_link.dot(&direction));
                    if along_normal <= 0.0 || from_cell.dot(&cell.normal_in_link).abs() > CELL_DEPTH_M {
                        continue;
                    }
                    let part = part_within(from_cell.dot(&cell.along_in_link), cell.size_m[0], scale_m)
                        * part_within(from_cell.dot(&across), cell.size_m[1], scale_m);
                    on_cells += part;
                    felt.push((pad.first_cell_idx + cell_idx, part * along_normal));
                }
            }
            let gain = 1.0 - self.kept + self.kept * (1.0 / on_cells).min(MOST_GAIN);
            for (idx, part) in &felt {
                cells_newtons[*idx] += newtons * gain * part;
            }
        }
        cells_newtons
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// What the cells of the Barrett's palm feel of 4 N at a place of its frame.
    fn felt(bell: Bell, x_m: f64, y_m: f64) -> Vec<f64> {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let links = hand.palm_from_links(&hand.open_joints()).expect("links");
        let direction = -nalgebra::Vector3::z_axis();
        let link_idx = hand.pads[0].link_idx;
        let pressure = Pressure { link_idx, point_m: Point3::new(x_m, y_m, 0.0), direction, newtons: 4.0 };
        bell.cells_newtons(&hand, &links, [pressure])
    }

    #[test]
    fn a_skin_keeps_force_or_loses_it() {
        let sum = |cells: &[f64]| cells.iter().sum::<f64>();
        let (wide, narrow) = (0.004, 0.0005);
        // Between cells and over the edge of the pad.
        for (x_m, y_m) in [(0.008, 0.0), (0.011, 0.0159)] {
            let kept = felt(Bell { sigma_m: wide, kept: 1.0 }, x_m, y_m);
            let lost = felt(Bell { sigma_m: wide, kept: 0.0 }, x_m, y_m);
            assert!((sum(&kept) - 4.0).abs() < 1e-9, "{}", sum(&kept));
            assert!(sum(&lost) < 0.95 * sum(&kept) && sum(&lost) > 0.1, "{}", sum(&lost));
        }
        // The centre of a cell: a narrow bell presses it alone.
        let cells = felt(Bell { sigma_m: narrow, kept: 0.0 }, 0.011, 0.0159);
        assert!(cells[1] > 3.9 && (sum(&cells) - cells[1]) < 0.1, "{cells:?}");
        let beside = felt(Bell { sigma_m: narrow, kept: 1.0 }, 0.5, 0.0);
        assert!(sum(&beside) < 1e-6, "nothing is felt of a force far away: {}", sum(&beside));
    }

    #[test]
    fn hands_draw_skins_within_the_range() {
        use rand::SeedableRng;
        let options = SkinOptions { bell_share: 0.5, bell_m: [0.001, 0.004], kept: [0.25, 0.75] };
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let bells: Vec<Bell> = (0..400).filter_map(|_| options.draw(&mut rng)).collect();
        assert!((160..240).contains(&bells.len()), "{}", bells.len());
        assert!(bells.iter().all(|bell| (0.001..=0.004).contains(&bell.sigma_m) && (0.25..=0.75).contains(&bell.kept)));
    }
}
