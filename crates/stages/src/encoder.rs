//! The feature encoder turns a frame's contacts and joint angles into one row of numbers for the classifier.
//!
//! The paper's feature is the histogram over the dictionary (`crate::histogram`, Dang & Allen, Eq. 2-4) alone. A recipe
//! may add blocks: the force on each cell, the joint angles, and the load of each pad as a whole. All blocks are
//! computed from the output of the contacts stage. Pure: no clock, no I/O, no state.

use serde::{Deserialize, Serialize};

use crate::dictionary::Dictionary;
use crate::hand::{Coupling, Hand, Pad};
use crate::histogram::histogram;
use blindgrasp_messages::{Contact, Fault, MAX_FEATURES, Sense, Senses};

/// Values of [`Block::Pads`] for each pad.
pub(crate) const N_PAD_VALUES: usize = PAD_VALUES.len();

/// Names of the values of [`Block::Pads`], behind the name of the pad, in the order of `FeatureExtractor::write_pads`.
const PAD_VALUES: [&str; 15] = [
    "load",
    "n_contacts",
    "max_force",
    "centre_x",
    "centre_y",
    "centre_z",
    "normal_x",
    "normal_y",
    "normal_z",
    "spread_x",
    "spread_y",
    "spread_z",
    "centre_in_link_x",
    "centre_in_link_y",
    "centre_in_link_z",
];

/// Names of the values of [`Block::Gravity`].
const GRAVITY_VALUES: [&str; 3] = ["gravity_x", "gravity_y", "gravity_z"];

/// Names of the values of [`Block::Wrist`], in the order of [`wrist_values`].
const WRIST_VALUES: [&str; 6] = [
    "wrist_force_along_gravity",
    "wrist_force_across_gravity",
    "wrist_torque_x",
    "wrist_torque_y",
    "wrist_torque_z",
    "wrist_torque",
];

/// A value with a smaller standard deviation is constant but for rounding.
const LEAST_DEVIATION: f64 = 1e-12;

/// A part of a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Block {
    /// The scaled histogram of the contacts over the dictionary, one value per word (Dang & Allen, Eq. 2-4).
    Histogram,
    /// The force on each cell that is a contact, newtons; 0 on all others.
    Cells,
    /// The force on each cell relative to its pad: minus the mean of the pad's cells, divided by their standard
    /// deviation. All are 0 for a pad whose cells all feel the same.
    RelativeCells,
    /// Each joint's angle, radians.
    Joints,
    /// The angle by which each coupled joint has gone beyond its coupling, radians. It shows contacts that no cell
    /// feels.
    Breakaways,
    /// For each pad: its load, its number of contacts, the greatest force. In the palm frame come the centre of its
    /// load, its mean normal and the spread of the load; then the centre of its load in the frame of its link. Each is
    /// weighted by force; newtons and metres. All 0 for a pad without contact.
    Pads,
    /// The direction of gravity in the palm frame, a unit vector. It needs the sense gravity.
    Gravity,
    /// The load on the wrist: its force along gravity and at right angles to it, newtons; its torque about each axis of
    /// the palm frame, and in all, newton metres. It needs the senses gravity and wrench.
    Wrist,
    /// The torque of each joint, newton metres. It needs that sense.
    JointTorques,
}

impl Block {
    /// The block in the words of reports.
    pub fn about(self) -> &'static str {
        match self {
            Block::Histogram => "contact histogram",
            Block::Cells => "force on each cell",
            Block::RelativeCells => "force on each cell relative to its pad",
            Block::Joints => "joint angles",
            Block::Breakaways => "breakaway of coupled joints",
            Block::Pads => "load of each pad",
            Block::Gravity => "direction of gravity",
            Block::Wrist => "load on the wrist",
            Block::JointTorques => "joint torques",
        }
    }
}

/// A frame as the encoder sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeltReading<'a> {
    /// Radians, or metres for a joint that slides, in the hand's order.
    pub joints: &'a [f64],
    /// As [`crate::contacts::contacts_from_frame`] finds them.
    pub contacts: &'a [Contact],
    pub senses: Senses<'a>,
}

impl<'a> FeltReading<'a> {
    /// A frame without senses beside joint angles and cells.
    pub fn new(joints: &'a [f64], contacts: &'a [Contact]) -> Self {
        FeltReading { joints, contacts, senses: Senses::default() }
    }
}

/// Encodes features. A model keeps it, so that its features need no hand or recipe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureExtractor {
    /// The parts of a feature, in order.
    pub blocks: Vec<Block>,
    /// The contact dictionary, metres in the palm frame.
    pub dictionary: Dictionary,
    /// σ of Eq. 3, metres.
    pub sigma_m: f64,
    /// The centres of each pad's cells, metres in the frame of the pad's link.
    pub cells_in_link_m: Vec<Vec<[f64; 3]>>,
    /// For each joint, the joint that it follows until that is blocked.
    pub couplings: Vec<Option<Coupling>>,
    /// Applied to each value; `None` leaves values as they are.
    pub scaling: Option<Scaling>,
}

/// An affine map of each value: to mean 0 and standard deviation 1 over the training data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    pub mean: Vec<f64>,
    /// One over the standard deviation of each value; 0 for a value that is always the same.
    pub per_deviation: Vec<f64>,
}

impl FeatureExtractor {
    /// An extractor for a hand, without scaling.
    pub fn new(hand: &Hand, blocks: &[Block], dictionary: Dictionary, sigma_m: f64) -> Self {
        let cells =
            |pad: &Pad| pad.cells.iter().map(|cell| cell.position_in_link_m.coords.into()).collect::<Vec<[f64; 3]>>();
        FeatureExtractor {
            blocks: blocks.to_vec(),
            dictionary,
            sigma_m,
            cells_in_link_m: hand.pads.iter().map(cells).collect(),
            couplings: hand.joints.iter().map(|joint| joint.coupling).collect(),
            scaling: None,
        }
    }

    /// Values of a feature.
    pub fn len(&self) -> usize {
        self.blocks.iter().map(|block| self.block_len(*block)).sum()
    }

    /// Whether a feature has no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Values of a part of a feature.
    pub fn block_len(&self, block: Block) -> usize {
        match block {
            Block::Histogram => self.dictionary.len(),
            Block::Cells | Block::RelativeCells => self.n_cells(),
            Block::Joints => self.couplings.len(),
            Block::Breakaways => self.couplings.iter().flatten().count(),
            Block::Pads => N_PAD_VALUES * self.cells_in_link_m.len(),
            Block::Gravity => GRAVITY_VALUES.len(),
            Block::Wrist => WRIST_VALUES.len(),
            Block::JointTorques => self.couplings.len(),
        }
    }

    fn n_cells(&self) -> usize {
        self.cells_in_link_m.iter().map(Vec::len).sum()
    }

    /// Writes the feature of a frame to `values`, and returns the number of pads with contact.
    ///
    /// # Errors
    /// The fault, with `values` empty: no contact ([`Fault::NoContact`]: there is no feature), or not as many joints as
    /// the hand has ([`Fault::WrongLength`]). Others are an impossible number, pad or cell ([`Fault::InvalidValue`]), or a
    /// sense that a block needs and the frame does not have ([`Fault::MissingReading`]).
    pub fn extract(&self, reading: &FeltReading<'_>, values: &mut Vec<f64>) -> Result<u32, Fault> {
        values.clear();
        let outcome = self.check(reading).and_then(|()| self.write_blocks(reading, values));
        if outcome.is_err() {
            values.clear();
        }
        outcome
    }

    fn check(&self, reading: &FeltReading<'_>) -> Result<(), Fault> {
        let FeltReading { joints, contacts, .. } = *reading;
        if joints.len() != self.couplings.len() {
            return Err(Fault::WrongLength);
        }
        let is_cell = |contact: &Contact| {
            self.cells_in_link_m.get(contact.pad as usize).map(Vec::len) > Some(contact.cell as usize)
        };
        let is_finite = |contact: &Contact| contact.normal.iter().all(|number| number.is_finite());
        if !joints.iter().all(|angle| angle.is_finite())
            || !contacts.iter().all(|contact| is_cell(contact) && is_finite(contact))
        {
            return Err(Fault::InvalidValue);
        }
        Ok(())
    }

    fn write_blocks(&self, reading: &FeltReading<'_>, values: &mut Vec<f64>) -> Result<u32, Fault> {
        let FeltReading { joints, contacts, senses } = *reading;
        // The histogram is computed for all blocks, because it checks positions and forces.
        let n_pads_in_contact = histogram(&self.dictionary, self.sigma_m, contacts, values)?;
        let n_words = values.len();
        for block in &self.blocks {
            match block {
                Block::Histogram => values.extend_from_within(..n_words),
                Block::Cells => self.write_cells(contacts, values),
                Block::RelativeCells => {
                    let start = values.len();
                    self.write_cells(contacts, values);
                    self.make_relative(&mut values[start..]);
                }
                Block::Joints => values.extend_from_slice(joints),
                Block::Breakaways => {
                    let breakaway = |(angle, coupling): (&f64, &Option<Coupling>)| {
                        coupling.map(|coupling| angle - coupling.ratio * joints[coupling.follows_idx])
                    };
                    values.extend(joints.iter().zip(&self.couplings).filter_map(breakaway));
                }
                Block::Pads => self.write_pads(contacts, values),
                Block::Gravity => values.extend(down(&senses)?),
                Block::Wrist => values.extend(wrist_values(&senses)?),
                Block::JointTorques => {
                    let torques = senses.get(Sense::JointTorques);
                    if torques.len() != joints.len() {
                        return Err(Fault::MissingReading);
                    }
                    values.extend_from_slice(torques);
                }
            }
        }
        values.drain(..n_words);
        if let Some(scaling) = &self.scaling {
            for ((value, mean), per_deviation) in values.iter_mut().zip(&scaling.mean).zip(&scaling.per_deviation) {
                *value = (*value - mean) * per_deviation;
            }
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(Fault::InvalidValue);
        }
        Ok(n_pads_in_contact)
    }

    /// The name of each value of a feature of this hand, in the order in which [`FeatureExtractor::extract`] writes them:
    /// `hist_3`, `finger_1.load`, `spread.position`. A name begins with that of the pad or joint, and no name comes twice
    /// unless a block does.
    pub fn value_names(&self, hand: &Hand) -> Vec<String> {
        let mut parts = PartNames::default();
        for joint in &hand.joints {
            parts.joints.push(&joint.name);
            if joint.coupling.is_some() {
                parts.coupled.push(&joint.name);
            }
        }
        parts.pads = hand.pads.iter().map(|pad| pad.name.as_str()).collect();
        self.names_of_values(&parts)
    }

    /// As [`FeatureExtractor::value_names`], from the names of the hand's parts.
    pub(crate) fn names_of_values(&self, parts: &PartNames<'_>) -> Vec<String> {
        self.blocks.iter().flat_map(|block| self.block_names(*block, parts)).collect()
    }

    /// A value of a feature before it was scaled; the mean where it does not vary.
    pub fn unscaled(&self, idx: usize, value: f64) -> f64 {
        match &self.scaling {
            Some(Scaling { mean, per_deviation }) if per_deviation[idx] > 0.0 => value / per_deviation[idx] + mean[idx],
            Some(Scaling { mean, .. }) => mean[idx],
            None => value,
        }
    }

    fn block_names(&self, block: Block, parts: &PartNames<'_>) -> Vec<String> {
        let of = |names: &[&str], value: &str| names.iter().map(|name| format!("{name}.{value}")).collect();
        match block {
            Block::Histogram => (0..self.dictionary.len()).map(|word_idx| format!("hist_{word_idx}")).collect(),
            Block::Cells => self.cell_names(parts, "cell"),
            Block::RelativeCells => self.cell_names(parts, "relative_cell"),
            Block::Joints => of(&parts.joints, "position"),
            Block::Breakaways => of(&parts.coupled, "breakaway"),
            Block::Pads => {
                let of_pad = |pad: &&str| PAD_VALUES.map(|value| format!("{pad}.{value}"));
                parts.pads.iter().flat_map(of_pad).collect()
            }
            Block::Gravity => GRAVITY_VALUES.map(String::from).into(),
            Block::Wrist => WRIST_VALUES.map(String::from).into(),
            Block::JointTorques => of(&parts.joints, "torque"),
        }
    }

    /// The names of the cells of all pads; a pad's cells are numbered from 0.
    fn cell_names(&self, parts: &PartNames<'_>, value: &str) -> Vec<String> {
        let mut names = Vec::new();
        for (pad, cells) in parts.pads.iter().zip(&self.cells_in_link_m) {
            for cell_idx in 0..cells.len() {
                names.push(format!("{pad}.{value}_{cell_idx}"));
            }
        }
        names
    }

    fn write_cells(&self, contacts: &[Contact], values: &mut Vec<f64>) {
        let start = values.len();
        values.resize(start + self.n_cells(), 0.0);
        for contact in contacts {
            let first_of_pad: usize = self.cells_in_link_m[..contact.pad as usize].iter().map(Vec::len).sum();
            values[start + first_of_pad + contact.cell as usize] += contact.force_newtons;
        }
    }

    fn make_relative(&self, mut cells: &mut [f64]) {
        for n_cells in self.cells_in_link_m.iter().map(Vec::len) {
            let (of_pad, rest) = cells.split_at_mut(n_cells);
            let mean_of = |of: &dyn Fn(f64) -> f64| of_pad.iter().map(|cell| of(*cell)).sum::<f64>() / n_cells as f64;
            let mean = mean_of(&|cell| cell);
            let deviation = mean_of(&|cell| (cell - mean).powi(2)).sqrt();
            let per_deviation = if deviation > LEAST_DEVIATION { 1.0 / deviation } else { 0.0 };
            of_pad.iter_mut().for_each(|cell| *cell = (*cell - mean) * per_deviation);
            cells = rest;
        }
    }

    fn write_pads(&self, contacts: &[Contact], values: &mut Vec<f64>) {
        for (pad_idx, cells_in_link_m) in self.cells_in_link_m.iter().enumerate() {
            let of_pad = || contacts.iter().filter(|contact| contact.pad as usize == pad_idx);
            let load: f64 = of_pad().map(|contact| contact.force_newtons).sum();
            if load <= 0.0 {
                values.resize(values.len() + N_PAD_VALUES, 0.0);
                continue;
            }
            let mean = |of: &dyn Fn(&Contact) -> [f64; 3]| -> [f64; 3] {
                std::array::from_fn(|axis| {
                    of_pad().map(|contact| contact.force_newtons / load * of(contact)[axis]).sum()
                })
            };
            let centre = mean(&|contact| contact.position_m);
            let variance =
                mean(&|contact| std::array::from_fn(|axis| (contact.position_m[axis] - centre[axis]).powi(2)));
            values.push(load);
            values.push(of_pad().count() as f64);
            values.push(of_pad().map(|contact| contact.force_newtons).fold(0.0, f64::max));
            values.extend(centre);
            values.extend(mean(&|contact| contact.normal));
            values.extend(variance.map(f64::sqrt));
            values.extend(mean(&|contact| cells_in_link_m[contact.cell as usize]));
        }
    }

    /// Checks an extractor that was read from a file.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn validate(&self) -> Result<(), String> {
        if !(self.sigma_m.is_finite() && self.sigma_m > 0.0) {
            return Err(format!("sigma_m is {}, expected positive metres", self.sigma_m));
        }
        if self.dictionary.is_empty() || !self.dictionary.words_m.as_flattened().iter().all(|x| x.is_finite()) {
            return Err("the dictionary is empty or not finite".into());
        }
        if self.is_empty() || self.len() + self.dictionary.len() > MAX_FEATURES {
            return Err(format!("{} values, expected 1 to {}", self.len(), MAX_FEATURES - self.dictionary.len()));
        }
        let n_joints = self.couplings.len();
        if self
            .couplings
            .iter()
            .flatten()
            .any(|coupling| coupling.follows_idx >= n_joints || !coupling.ratio.is_finite())
        {
            return Err("a joint follows one that the hand doesn't have".into());
        }
        if !self.cells_in_link_m.iter().flatten().flatten().all(|x| x.is_finite()) {
            return Err("a cell's place is not finite".into());
        }
        if let Some(Scaling { mean, per_deviation }) = &self.scaling {
            if mean.len() != self.len() || per_deviation.len() != self.len() {
                return Err(format!("scaling of {} values, expected {}", mean.len(), self.len()));
            }
            if !mean.iter().chain(per_deviation).all(|x| x.is_finite()) {
                return Err("the scaling is not finite".into());
            }
        }
        Ok(())
    }
}

/// The names of a hand's joints, of the coupled ones among them, and of its pads, each in the hand's order.
#[derive(Default)]
pub(crate) struct PartNames<'a> {
    pub(crate) joints: Vec<&'a str>,
    pub(crate) coupled: Vec<&'a str>,
    pub(crate) pads: Vec<&'a str>,
}

/// The direction of gravity in the palm frame.
fn down(senses: &Senses<'_>) -> Result<[f64; 3], Fault> {
    let [x, y, z] = *senses.get(Sense::Gravity) else { return Err(Fault::MissingReading) };
    let norm = (x * x + y * y + z * z).sqrt();
    if norm > 0.0 { Ok([x / norm, y / norm, z / norm]) } else { Err(Fault::InvalidValue) }
}

/// The values of [`Block::Wrist`].
///
/// # Errors
/// [`Fault::MissingReading`] without gravity or wrench, [`Fault::InvalidValue`] for a gravity of 0.
pub fn wrist_values(senses: &Senses<'_>) -> Result<[f64; WRIST_VALUES.len()], Fault> {
    let down = down(senses)?;
    let [fx, fy, fz, tx, ty, tz] = *senses.get(Sense::WristWrench) else { return Err(Fault::MissingReading) };
    let along = fx * down[0] + fy * down[1] + fz * down[2];
    let across = (fx * fx + fy * fy + fz * fz - along * along).max(0.0).sqrt();
    Ok([along, across, tx, ty, tz, (tx * tx + ty * ty + tz * tz).sqrt()])
}

impl Scaling {
    /// The scaling of `rows`, which have `n_values` each, to mean 0 and standard deviation 1.
    pub fn of(rows: &[f64], n_values: usize) -> Self {
        let n_rows = (rows.len() / n_values) as f64;
        let column_mean = |idx: usize, of: &dyn Fn(f64) -> f64| {
            rows.iter().skip(idx).step_by(n_values).map(|value| of(*value)).sum::<f64>() / n_rows
        };
        let mean: Vec<f64> = (0..n_values).map(|idx| column_mean(idx, &|value| value)).collect();
        let deviations = (0..n_values).map(|idx| column_mean(idx, &|value| (value - mean[idx]).powi(2)).sqrt());
        Scaling::new(mean.clone(), deviations)
    }

    /// The scaling of values with these means and standard deviations.
    pub fn new(mean: Vec<f64>, deviations: impl Iterator<Item = f64>) -> Self {
        let per = |deviation: f64| if deviation > LEAST_DEVIATION { 1.0 / deviation } else { 0.0 };
        Scaling { mean, per_deviation: deviations.map(per).collect() }
    }

    /// Scales `rows` in place.
    pub fn apply(&self, rows: &mut [f64]) {
        for row in rows.chunks_mut(self.mean.len()) {
            for ((value, mean), per_deviation) in row.iter_mut().zip(&self.mean).zip(&self.per_deviation) {
                *value = (*value - mean) * per_deviation;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hand::builtin_names;
    use crate::recipe::Recipe;
    use blindgrasp_messages::OwnedSenses;
    use std::collections::{BTreeMap, BTreeSet};
    use std::path::Path;

    const ALL_BLOCKS: [Block; 9] = [
        Block::Histogram,
        Block::Cells,
        Block::RelativeCells,
        Block::Joints,
        Block::Breakaways,
        Block::Pads,
        Block::Gravity,
        Block::Wrist,
        Block::JointTorques,
    ];

    fn extractor(blocks: &[Block]) -> FeatureExtractor {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        FeatureExtractor::new(&hand, blocks, Dictionary { words_m: vec![[0.0; 3], [0.03, 0.0, 0.0]] }, 0.03)
    }

    fn contact(position_m: [f64; 3], normal: [f64; 3], force_newtons: f64, pad: u32, cell: u32) -> Contact {
        Contact { position_m, normal, force_newtons, pad, cell }
    }

    const JOINTS: [f64; 7] = [0.1, 1.4, 0.7, 0.0, 0.45, 0.5, 0.0];

    fn of(extractor: &FeatureExtractor, contacts: &[Contact]) -> Result<Vec<f64>, Fault> {
        let mut values = vec![7.0];
        let outcome = extractor.extract(&FeltReading::new(&JOINTS, contacts), &mut values);
        assert_eq!(outcome.is_err(), values.is_empty());
        outcome.map(|_| values)
    }

    #[test]
    fn blocks_by_hand() {
        let contacts = [
            contact([0.0, 0.02, 0.0], [0.0, 0.0, 1.0], 1.0, 1, 0),
            contact([0.0, 0.06, 0.0], [0.0, 1.0, 0.0], 3.0, 1, 5),
        ];
        let values = of(&extractor(&[Block::Cells]), &contacts).expect("valid");
        let felt: Vec<(usize, f64)> = values.iter().copied().enumerate().filter(|(_, force)| *force > 0.0).collect();
        assert_eq!((values.len(), felt), (96, vec![(24, 1.0), (29, 3.0)]));

        // Of 24 cells one feels 1 N and one 3 N: mean 1/6, mean square 10/24.
        let values = of(&extractor(&[Block::RelativeCells]), &contacts).expect("valid");
        let deviation = (10.0_f64 / 24.0 - 1.0 / 36.0).sqrt();
        for (idx, newtons) in [(24, 1.0), (25, 0.0), (29, 3.0)] {
            assert!((values[idx] - (newtons - 1.0 / 6.0) / deviation).abs() < 1e-12, "{values:?}");
        }
        assert!(values[..24].iter().chain(&values[48..]).all(|value| *value == 0.0));

        let values = of(&extractor(&[Block::Breakaways, Block::Joints]), &contacts).expect("valid");
        // 45/140 of 1.4 rad is 0.45 rad: no breakaway; of 0.7 rad it is 0.225.
        let expected: Vec<f64> = [0.0, 0.275, 0.0].into_iter().chain(JOINTS).collect();
        assert!(values.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "{values:?}");

        let values = of(&extractor(&[Block::Pads]), &contacts).expect("valid");
        assert_eq!(values.len(), 60);
        assert!(values[..15].iter().chain(&values[30..]).all(|value| *value == 0.0));
        // Weights 1/4 and 3/4: the centre at y = 0.05, 0.03 and 0.01 from it. Cells 0 and 5 of the finger's first two
        // rows.
        let spread = (0.25 * 0.03_f64.powi(2) + 0.75 * 0.01_f64.powi(2)).sqrt();
        let expected = [
            [4.0, 2.0, 3.0],
            [0.0, 0.05, 0.0],
            [0.0, 0.75, 0.25],
            [0.0, spread, 0.0],
            [0.25 * 0.02225 + 0.75 * 0.02825, 0.0095, 0.25 * 0.0052 - 0.75 * 0.0052],
        ];
        for (value, expected) in values[15..30].iter().zip(expected.as_flattened()) {
            assert!((value - expected).abs() < 1e-12, "{values:?}");
        }

        let plain = of(&extractor(&[Block::Histogram]), &contacts).expect("valid");
        let mut expected = Vec::new();
        let one = extractor(&[Block::Histogram]);
        histogram(&one.dictionary, one.sigma_m, &contacts, &mut expected).expect("valid");
        assert_eq!(plain, expected);
    }

    #[test]
    fn every_recipe_and_hand_has_a_name_for_each_value() {
        for name in builtin_names() {
            let hand = Hand::load(Path::new(name)).expect("built in");
            let of_recipes = Recipe::NAMES.map(|recipe| Recipe::named(recipe).expect("known").blocks);
            for blocks in of_recipes.into_iter().chain([ALL_BLOCKS.to_vec()]) {
                let dictionary = Dictionary { words_m: vec![[0.0; 3]; 8] };
                let extractor = FeatureExtractor::new(&hand, &blocks, dictionary, 0.03);
                let names = extractor.value_names(&hand);
                assert_eq!(names.len(), extractor.len(), "{name}, {blocks:?}");
                let distinct: BTreeSet<&String> = names.iter().collect();
                assert_eq!(distinct.len(), names.len(), "{name}, {blocks:?}");
            }
        }
    }

    #[test]
    fn a_name_says_what_its_value_is() {
        let contacts = [
            contact([0.0, 0.02, 0.0], [0.0, 0.0, 1.0], 1.0, 1, 0),
            contact([0.0, 0.06, 0.0], [0.0, 1.0, 0.0], 3.0, 1, 5),
        ];
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let all = extractor(&ALL_BLOCKS);
        let senses = OwnedSenses::default()
            .with(Sense::Gravity, &[0.0, 0.0, -9.81])
            .with(Sense::WristWrench, &[3.0, 4.0, -5.0, 0.0, 0.3, 0.4])
            .with(Sense::JointTorques, &[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]);
        let mut values = Vec::new();
        let reading = FeltReading { senses: senses.view(), ..FeltReading::new(&JOINTS, &contacts) };
        all.extract(&reading, &mut values).expect("valid");
        let named: BTreeMap<String, f64> = all.value_names(&hand).into_iter().zip(values).collect();
        let pad = &hand.pads[1].name;
        let joint = |idx: usize| &hand.joints[idx].name;
        for (name, expected) in [
            (format!("{pad}.cell_5"), 3.0),
            (format!("{pad}.load"), 4.0),
            (format!("{pad}.n_contacts"), 2.0),
            (format!("{pad}.max_force"), 3.0),
            (format!("{pad}.centre_y"), 0.05),
            (format!("{pad}.normal_z"), 0.25),
            (format!("{pad}.centre_in_link_y"), 0.0095),
            (format!("{}.position", joint(1)), 1.4),
            (format!("{}.breakaway", joint(5)), 0.275),
            (format!("{}.torque", joint(6)), 0.7),
            ("gravity_z".into(), -1.0),
            ("wrist_force_along_gravity".into(), 5.0),
            ("wrist_force_across_gravity".into(), 5.0),
            ("wrist_torque_z".into(), 0.4),
            ("wrist_torque".into(), 0.5),
        ] {
            let found = named.get(&name).unwrap_or_else(|| panic!("no {name}: {:?}", named.keys()));
            assert!((found - expected).abs() < 1e-6, "{name}: {found}");
        }
        assert!(named[&format!("{pad}.relative_cell_5")] > named[&format!("{pad}.relative_cell_0")]);
        assert!(named["hist_0"] > 0.0 && named["hist_1"] > 0.0);
    }

    #[test]
    fn scaled_values_have_mean_0_and_deviation_1() {
        let mut rows = vec![1.0, 5.0, 3.0, 5.0, 8.0, 5.0];
        let scaling = Scaling::of(&rows, 2);
        scaling.apply(&mut rows);
        assert!(rows.iter().sum::<f64>().abs() < 1e-12 && rows[1] == 0.0);
        assert!((rows.iter().map(|value| value * value).sum::<f64>() / 3.0 - 1.0).abs() < 1e-12);
        // On the way online the same is done.
        let mut joints = extractor(&[Block::Joints]);
        let contacts = [contact([0.0; 3], [0.0, 0.0, 1.0], 1.0, 0, 0)];
        joints.scaling = Some(Scaling { mean: vec![0.1; 7], per_deviation: vec![2.0; 7] });
        let values = of(&joints, &contacts).expect("valid");
        assert!(values.iter().zip(JOINTS).all(|(value, joint)| (value - 2.0 * (joint - 0.1)).abs() < 1e-12));
    }

    #[test]
    fn what_cannot_be_is_a_fault() {
        let all = extractor(&[Block::Histogram, Block::Cells, Block::Joints, Block::Breakaways, Block::Pads]);
        let good = contact([0.0; 3], [0.0, 0.0, 1.0], 1.0, 0, 0);
        assert_eq!(of(&all, &[good]).map(|values| values.len()), Ok(2 + 96 + 7 + 3 + 60));
        assert_eq!(all.len(), 168);
        assert_eq!(of(&all, &[]), Err(Fault::NoContact));
        for bad in [
            Contact { pad: 4, ..good },
            Contact { cell: 24, ..good },
            Contact { normal: [f64::NAN, 0.0, 0.0], ..good },
            Contact { force_newtons: -1.0, ..good },
            Contact { position_m: [f64::INFINITY, 0.0, 0.0], ..good },
        ] {
            assert_eq!(of(&all, &[good, bad]), Err(Fault::InvalidValue), "{bad:?}");
        }
        let mut values = vec![];
        assert_eq!(all.extract(&FeltReading::new(&JOINTS[..6], &[good]), &mut values), Err(Fault::WrongLength));
        assert_eq!(all.extract(&FeltReading::new(&[f64::NAN; 7], &[good]), &mut values), Err(Fault::InvalidValue));
    }
}
