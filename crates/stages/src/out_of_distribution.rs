//! Checks whether a grasp is like the training grasps of the model. The classifier's result for another grasp means
//! nothing.
//!
//! It compares a few quantities, which a person can check on the robot, with their limits. They are joint angles,
//! breakaways of coupled joints, the load of each pad and its spread, the distance of contacts from the dictionary's
//! words, and the mass of the histogram. The limits are the range of the training grasps, widened by the resolution of
//! each quantity and by a margin that is the same for all in units of their standard deviations. They are cut to the
//! values that are possible. Contacts of a pad and breakaways have no other limits than these, and a load may be twice
//! that of the training: another skin or gear reads them otherwise, and the grasp is the same. docs/trust.md says what
//! this finds. Distances in the space of all quantities (Mahalanobis, nearest neighbours, K-means) found less.
//!
//! Pure: no clock, no I/O, no state, and no allocation for a frame within the limits.

use std::fmt;
use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use crate::encoder::FeatureExtractor;
use crate::hand::{Hand, Pad};
use blindgrasp_messages::{Contact, Fault, MAX_PADS};

/// The limits of a model's training grasps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRange {
    /// One for each quantity.
    pub limits: Vec<Limits>,
    /// The share of the training grasps that was flagged by limits of other objects' grasps and the same margin.
    pub share_flagged: f64,
}

/// The limits of a quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Its name and unit.
    pub quantity: String,
    /// The least value that is like the training.
    pub lower: f64,
    /// The greatest value that is like the training.
    pub upper: f64,
}

/// The skin of another hand may have twice the gain. Without a limit, 7 of 61 simulated lifts with a saturated pad dropped.
const LOAD_FACTOR: f64 = 2.0;

impl Limits {
    /// Whether a grasp with this value may be like those of the training. For contacts and breakaways, which the hand itself
    /// bounds, a file of an older version has the last values seen.
    fn allow(&self, value: f64) -> bool {
        if (self.lower..=self.upper).contains(&value) {
            return true;
        }
        match self.quantity.split_once(" of ") {
            Some(("contacts" | "breakaway", _)) => true,
            Some(("load", _)) => (self.lower..=LOAD_FACTOR * self.upper).contains(&value),
            _ => false,
        }
    }
}

/// A value outside its limits.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Violation {
    #[serde(flatten)]
    pub limits: Limits,
    pub value: f64,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Limits { quantity, lower, upper } = &self.limits;
        write!(f, "{quantity}: {}, trained from {} to {}", short(self.value), short(*lower), short(*upper))
    }
}

/// The quantities that are told of a grasp; a wrong unit violates all limits.
const N_TOLD: usize = 3;
/// A force that is so many times the greatest one of the training is of another unit, as a rule.
const UNIT_FACTOR: f64 = 20.0;

impl Violation {
    /// How far the value is outside, in widths of its range.
    fn excess(&self) -> f64 {
        let Limits { lower, upper, .. } = self.limits;
        (self.value - upper).max(lower - self.value) / (upper - lower).max(f64::MIN_POSITIVE)
    }

    /// The worst violations in words, and the number of the others.
    pub fn most(violations: &[Violation]) -> Vec<String> {
        let mut worst: Vec<&Violation> = violations.iter().collect();
        worst.sort_by(|a, b| b.excess().total_cmp(&a.excess()));
        let mut said: Vec<String> = worst.iter().take(N_TOLD).map(ToString::to_string).collect();
        if violations.len() > N_TOLD {
            said.push(format!("{} more quantities are outside", violations.len() - N_TOLD));
        }
        let is_other_unit =
            |it: &&Violation| it.limits.quantity.ends_with(", newtons") && it.value > UNIT_FACTOR * it.limits.upper;
        if worst.first().is_some_and(is_other_unit) {
            said.push("are the readings in another unit, as counts or grams?".into());
        }
        said
    }
}

/// Four significant digits.
pub(crate) fn short(value: f64) -> String {
    // Without the sign of a zero.
    let text = (format!("{value:.3e}").parse::<f64>().unwrap_or(value) + 0.0).to_string();
    if text.len() > 12 { format!("{value:.3e}") } else { text }
}

impl TrainingRange {
    /// Whether a frame that has a feature lies within all limits.
    ///
    /// # Errors
    /// [`Fault::OutOfDistribution`].
    pub fn check(&self, features: &FeatureExtractor, joints: &[f64], contacts: &[Contact]) -> Result<(), Fault> {
        let is_within = self.violations(features, joints, contacts).is_empty();
        if is_within { Ok(()) } else { Err(Fault::OutOfDistribution) }
    }

    /// The limits that a frame with a feature violates, each with the value found.
    pub fn violations(&self, features: &FeatureExtractor, joints: &[f64], contacts: &[Contact]) -> Vec<Violation> {
        let mut limits = self.limits.iter();
        let mut found = Vec::new();
        for_each_quantity(features, joints, contacts, |value| {
            let violated = limits.next().filter(|limits| !limits.allow(value));
            found.extend(violated.map(|limits| Violation { limits: limits.clone(), value }));
        });
        found
    }

    /// Checks a range that was read from a file.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn validate(&self, features: &FeatureExtractor) -> Result<(), String> {
        let expected = n_of_posture(features) + N_PAD_QUANTITIES * features.cells_in_link_m.len() + 2;
        if self.limits.len() != expected {
            return Err(format!("{} limits, expected {expected}", self.limits.len()));
        }
        match self.limits.iter().find(|limits| !(limits.lower.is_finite() && limits.upper.is_finite())) {
            Some(limits) => Err(format!("the limits of {} are not finite", limits.quantity)),
            None => Ok(()),
        }
    }
}

/// A quantity, and what is known of it without training.
#[derive(Debug, Clone, PartialEq)]
pub struct Quantity {
    /// Its name and unit.
    pub name: String,
    /// The values that a hand can read. For a joint, these are its limits.
    pub possible: RangeInclusive<f64>,
    /// How far apart two healthy hands of one make may read the same grasp: the whole range for contacts, as a thick skin
    /// feels with more cells, and for breakaways, which depend on where encoders are and how far gears give.
    pub resolution: f64,
    /// The same as a share of the training grasps' range, if that is more: the gain of a force sensor.
    pub gain_resolution: f64,
}

/// An encoder's zero and the play of a gear. A joint that slides has a tenth of it, metres.
const ANGLE_RESOLUTION_RAD: f64 = 0.05;
/// A skin's hysteresis.
const FORCE_RESOLUTION_NEWTONS: f64 = 0.5;
/// The gains of a skin's cells.
const FORCE_GAIN_RESOLUTION: f64 = 0.1;
/// One cell more or less among a few.
const OVER_MEAN_RESOLUTION: f64 = 0.5;
/// A part of the distance of two cells, in which a load may move.
const SPREAD_RESOLUTION_M: f64 = 0.002;
/// How far [`ANGLE_RESOLUTION_RAD`] moves a contact on a finger of 6 cm.
const DISTANCE_RESOLUTION_M: f64 = 0.003;
/// [`DISTANCE_RESOLUTION_M`] changes the part of a word by up to 0.07 if σ is 36 mm, and a word or two are near.
const MASS_RESOLUTION: f64 = 0.1;

/// Quantities of each pad.
const N_PAD_QUANTITIES: usize = 5;

/// The number of quantities that depend on the joints alone. They come first.
pub fn n_of_posture(features: &FeatureExtractor) -> usize {
    features.couplings.len() + features.couplings.iter().flatten().count()
}

/// The quantities of a hand's grasps, in the order of [`for_each_quantity`].
pub fn quantities(hand: &Hand) -> Vec<Quantity> {
    let quantity =
        |name: String, resolution| Quantity { name, possible: 0.0..=f64::INFINITY, resolution, gain_resolution: 0.0 };
    let force = |name| Quantity { gain_resolution: FORCE_GAIN_RESOLUTION, ..quantity(name, FORCE_RESOLUTION_NEWTONS) };
    let mut quantities = Vec::new();
    for joint in &hand.joints {
        let name = format!("position of joint {}, {}", joint.name, joint.kind.unit());
        let resolution = ANGLE_RESOLUTION_RAD * joint.kind.per_radian();
        quantities.push(Quantity { possible: joint.lower..=joint.upper, ..quantity(name, resolution) });
    }
    for joint in &hand.joints {
        let Some(coupling) = joint.coupling else { continue };
        let followed = &hand.joints[coupling.follows_idx];
        let (open, closed) = (coupling.ratio * followed.lower, coupling.ratio * followed.upper);
        let (lower, upper) = (joint.lower - open.max(closed), joint.upper - open.min(closed));
        let name = format!("breakaway of joint {}, {}", joint.name, joint.kind.unit());
        quantities.push(Quantity { possible: lower..=upper, ..quantity(name, upper - lower) });
    }
    for Pad { name: pad, cells, .. } in &hand.pads {
        let n_cells = cells.len() as f64;
        let of_pad: [Quantity; N_PAD_QUANTITIES] = [
            force(format!("load of pad {pad}, newtons")),
            Quantity { possible: 0.0..=n_cells, ..quantity(format!("contacts of pad {pad}"), n_cells) },
            force(format!("greatest force on a cell of pad {pad}, newtons")),
            quantity(format!("greatest over mean force on the cells of pad {pad}"), OVER_MEAN_RESOLUTION),
            quantity(format!("spread of the load of pad {pad}, m"), SPREAD_RESOLUTION_M),
        ];
        quantities.extend(of_pad);
    }
    quantities.push(quantity("greatest distance of a contact to its nearest word, m".into(), DISTANCE_RESOLUTION_M));
    quantities.push(quantity("mass of the histogram".into(), MASS_RESOLUTION));
    quantities
}

/// Passes the quantities of a frame with a feature to `visit`.
pub fn for_each_quantity(
    features: &FeatureExtractor,
    joints: &[f64],
    contacts: &[Contact],
    mut visit: impl FnMut(f64),
) {
    joints.iter().for_each(|angle| visit(*angle));
    for (angle, coupling) in joints.iter().zip(&features.couplings) {
        if let Some(coupling) = coupling {
            visit(angle - coupling.ratio * joints[coupling.follows_idx]);
        }
    }
    let mut pad_newtons = [0.0; MAX_PADS];
    for (pad, (newtons, cells_in_link_m)) in pad_newtons.iter_mut().zip(&features.cells_in_link_m).enumerate() {
        let of_pad = || contacts.iter().filter(|contact| contact.pad as usize == pad);
        let n_contacts = of_pad().count() as f64;
        let greatest = of_pad().map(|contact| contact.force_newtons).fold(0.0, f64::max);
        *newtons = of_pad().map(|contact| contact.force_newtons).sum();
        let (over_mean, spread_m) = if *newtons > 0.0 {
            (greatest * n_contacts / *newtons, spread_m(of_pad(), cells_in_link_m, *newtons))
        } else {
            (0.0, 0.0)
        };
        [*newtons, n_contacts, greatest, over_mean, spread_m].into_iter().for_each(&mut visit);
    }
    let sigma_squared = features.sigma_m * features.sigma_m;
    let n_pads_in_contact = pad_newtons.iter().filter(|newtons| **newtons > 0.0).count() as f64;
    let mut farthest_squared: f64 = 0.0;
    let mut mass = 0.0;
    for contact in contacts {
        let mut nearest_squared = f64::INFINITY;
        let mut near_words = 0.0;
        for word in &features.dictionary.words_m {
            let squared: f64 = contact.position_m.iter().zip(word).map(|(c, w)| (c - w) * (c - w)).sum();
            nearest_squared = nearest_squared.min(squared);
            near_words += libm::exp(-squared / sigma_squared);
        }
        farthest_squared = farthest_squared.max(nearest_squared);
        mass += near_words * contact.force_newtons / pad_newtons[contact.pad as usize] / n_pads_in_contact;
    }
    visit(farthest_squared.sqrt());
    visit(mass);
}

/// The standard deviation of a pad's load about its centre, in the frame of the pad's link.
fn spread_m<'a>(
    contacts: impl Iterator<Item = &'a Contact> + Clone,
    cells_in_link_m: &[[f64; 3]],
    load_newtons: f64,
) -> f64 {
    let mean = |axis: usize, of: &dyn Fn(f64) -> f64| -> f64 {
        let weighted = |contact: &Contact| contact.force_newtons * of(cells_in_link_m[contact.cell as usize][axis]);
        contacts.clone().map(weighted).sum::<f64>() / load_newtons
    };
    (0..3)
        .map(|axis| {
            let centre = mean(axis, &|x| x);
            mean(axis, &|x| (x - centre).powi(2))
        })
        .sum::<f64>()
        .sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dictionary::Dictionary;
    use crate::encoder::{Block, FeltReading};
    use std::path::Path;

    /// A contact of the Barrett hand's pad 1, in the palm frame at x.
    fn contact(cell: u32, x_m: f64, force_newtons: f64) -> Contact {
        Contact { position_m: [x_m, 0.0, 0.0], normal: [0.0, 0.0, 1.0], force_newtons, pad: 1, cell }
    }

    fn barrett() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    fn extractor() -> FeatureExtractor {
        let hand = barrett();
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [0.04, 0.0, 0.0]] };
        FeatureExtractor::new(&hand, &[Block::Histogram], dictionary, 0.02)
    }

    /// A posture whose first finger has closed by `angle_rad`, its distal joint `breakaway_rad` further.
    fn posture(angle_rad: f64, breakaway_rad: f64) -> [f64; 7] {
        [0.0, angle_rad, 1.0, 1.0, 45.0 / 140.0 * angle_rad + breakaway_rad, 0.4, 0.4]
    }

    #[test]
    fn quantities_by_hand() {
        let features = extractor();
        let mut found = Vec::new();
        let contacts = [contact(0, 0.0, 3.0), contact(3, 0.03, 1.0)];
        for_each_quantity(&features, &posture(1.4, 0.2), &contacts, |value| found.push(value));
        let quantities = quantities(&barrett());
        assert_eq!(found.len(), quantities.len());
        let value = |name: &str| found[quantities.iter().position(|of| of.name.contains(name)).expect(name)];
        // One row of cells lies 6 mm from the next; a quarter of the load is on the second.
        let spread = (0.75_f64 * 0.25).sqrt() * 0.006;
        let e = |squared_mm: f64| libm::exp(-squared_mm / 400.0);
        let mass = 0.75 * (1.0 + e(1600.0)) + 0.25 * (e(900.0) + e(100.0));
        for (name, expected) in [
            ("position of joint finger_1,", 1.4),
            ("breakaway of joint distal_1,", 0.2),
            ("load of pad palm,", 0.0),
            ("load of pad finger_1,", 4.0),
            ("contacts of pad finger_1", 2.0),
            ("greatest force on a cell of pad finger_1", 3.0),
            ("greatest over mean force on the cells of pad finger_1", 1.5),
            ("spread of the load of pad finger_1", spread),
            ("greatest distance", 0.01),
            ("mass", mass),
        ] {
            assert!((value(name) - expected).abs() < 1e-6, "{name}: {} for {expected}", value(name));
        }
    }

    #[test]
    fn the_mass_is_that_of_the_histogram() {
        let features = extractor();
        let contacts = [contact(0, 0.013, 3.0), contact(3, 0.03, 1.0), Contact { pad: 0, ..contact(2, -0.01, 0.5) }];
        let mut values = Vec::new();
        features.extract(&FeltReading::new(&[0.0; 7], &contacts), &mut values).expect("a feature");
        let mut last = 0.0;
        for_each_quantity(&features, &[0.0; 7], &contacts, |value| last = value);
        assert!((values.iter().sum::<f64>() - last).abs() < 1e-12);
    }
}
