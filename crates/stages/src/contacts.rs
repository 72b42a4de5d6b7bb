//! The contacts stage: from cells and joint angles to contacts in the palm frame (Dang & Allen, section II, Eq. 1).
//!
//! Pure: no clock, no I/O, no state. Where links of the hand touch each other, the cells between them feel the hand and
//! not the object. They are left out and counted (Dang & Allen, section IV-F.3). A skin may spread this force beyond these
//! cells. So a pad on a link that touches another one counts only if other pads show that an object is there: see
//! [`contacts_from_frame`]. Pads' normals are not corrected.

use nalgebra::{Isometry3, Point3, Vector3};

use crate::hand::{Hand, Joint, JointKind, PosedShapes};
use crate::out_of_distribution::short;
use blindgrasp_messages::{Contact, Fault, MAX_PADS};

/// How far beyond its limits a joint may read: an encoder's offset. It counts as at the limit then.
pub const LIMIT_TOLERANCE_RAD: f64 = 0.1;
/// Greatest force on a cell. No tactile cell bears more, and sums of such forces are far from overflow.
pub const MAX_CELL_NEWTONS: f64 = 1e6;
/// A cell whose centre is this near to a link that touches its own feels that link. 5 mm: a rubber patch's semi-axis on
/// a round link (4 mm), and rounding.
const SELF_CONTACT_M: f64 = 0.005;
/// Cells that are compared together, several at once, without a branch for each. Of most blocks no cell is active.
const BLOCK: usize = 16;

/// The result for a frame beside its contacts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ContactSummary {
    /// Pads with at least one contact.
    pub n_pads_in_contact: u32,
    /// Whether links of the hand touch each other.
    pub self_collision: bool,
    /// Active cells that feel another link of the hand, or may do so. They are not among the contacts.
    pub n_self_contacts: u32,
    /// The reason why the frame cannot be used. The contacts are empty then.
    pub fault: Fault,
}

/// Writes the active cells of a frame to `contacts`, in the order of the hand's cells.
///
/// * `hand_id` - the frame's, [`Hand::id`] or 0 for unknown.
/// * `joints`, `cells_newtons` - one per joint and cell of the hand, in its order.
///
/// A cell is active when its force exceeds its noise threshold. A joint outside its range (degrees instead of radians,
/// say), or a force that is negative, not finite or beyond any hand, makes the whole frame invalid. The sensor's other
/// readings are then doubtful too.
///
/// The active cells of a pad whose link touches no other link are contacts. If its link touches others, its cells within 5 mm
/// of these are none. The rest are contacts only if one of another pad opposes them, which itself is a contact and is not on
/// a link that touches this one. So fingers that press each other on nothing feel no object.
pub fn contacts_from_frame(
    hand: &Hand,
    hand_id: u64,
    joints: &[f64],
    cells_newtons: &[f64],
    contacts: &mut Vec<Contact>,
) -> ContactSummary {
    ContactFinder::default().find(hand, hand_id, joints, cells_newtons, contacts)
}

/// Moves the joints that read beyond their limits, by at most [`LIMIT_TOLERANCE_RAD`], to the limits. A joint does not go
/// beyond its stop, and no later stage should see an encoder's zero as an unusual posture. Others stay as they are.
pub fn clip_to_limits(hand: &Hand, joints: &mut [f64]) {
    for (value, joint) in joints.iter_mut().zip(&hand.joints) {
        if joint.allows(*value, LIMIT_TOLERANCE_RAD) {
            *value = value.clamp(joint.lower, joint.upper);
        }
    }
}

/// The joint or cell that makes a frame invalid, with its value and what was expected: for people.
pub fn invalid_reading(hand: &Hand, joints: &[f64], cells_newtons: &[f64]) -> Option<String> {
    let (n_joints, n_cells) = (hand.joints.len(), hand.n_cells());
    if joints.len() != n_joints || cells_newtons.len() != n_cells {
        let (found_joints, found_cells) = (joints.len(), cells_newtons.len());
        return Some(format!(
            "it has {found_joints} joints and {found_cells} cells, expected {n_joints} and {n_cells}"
        ));
    }
    let outside =
        || joints.iter().zip(&hand.joints).filter(|(value, joint)| !joint.allows(**value, LIMIT_TOLERANCE_RAD));
    if let Some((value, joint)) = outside().next() {
        let (lower, upper, unit) = (short(joint.lower), short(joint.upper), joint.kind.unit());
        let mut found = format!("joint {} reads {}, expected {lower} to {upper} {unit}", joint.name, short(*value));
        let fits = |(value, joint): (&f64, &Joint)| joint.allows(in_si(joint, *value), LIMIT_TOLERANCE_RAD);
        let is_far = outside().any(|(value, joint)| is_far(joint, *value));
        if value.is_finite() && is_far && outside().filter(|(value, _)| value.is_finite()).all(fits) {
            let other_unit = if joint.kind == JointKind::Revolute { "degrees" } else { "millimetres" };
            found += &format!(": {other_unit}? ({} {unit})", short(in_si(joint, *value)));
        }
        match outside().count() - 1 {
            0 => {}
            1 => found += "; another joint is outside its range, too",
            n_others => found += &format!("; {n_others} other joints are outside their range, too"),
        }
        if value.is_finite() && !is_far {
            found += ": are sign, zero and order of the joints those of the hand's layout?";
        }
        return Some(found);
    }
    let (cell_idx, newtons) = cells_newtons.iter().enumerate().find(|(_, newtons)| !are_forces(&[**newtons]))?;
    let (cell, unit) = (name_of_cell(hand, cell_idx)?, hand.cell_unit.word());
    Some(format!("{cell} reads {}, expected 0 to {MAX_CELL_NEWTONS} {unit}", short(*newtons)))
}

fn name_of_cell(hand: &Hand, cell_idx: usize) -> Option<String> {
    let pad = hand.pads.iter().rfind(|pad| pad.first_cell_idx <= cell_idx)?;
    Some(format!("cell {} of pad {}", cell_idx - pad.first_cell_idx, pad.name))
}

/// Whether a value is more than a turn or a metre: a smaller one is more likely a wrong zero than another unit.
fn is_far(joint: &Joint, value: f64) -> bool {
    value.abs() > if joint.kind == JointKind::Revolute { std::f64::consts::TAU } else { 1.0 }
}

/// A value in degrees or millimetres, in radians or metres.
fn in_si(joint: &Joint, value: f64) -> f64 {
    if joint.kind == JointKind::Revolute { value.to_radians() } else { value / 1000.0 }
}

/// Finds the contacts of frame after frame as [`contacts_from_frame`] does, in memory that it keeps.
#[derive(Debug, Default)]
pub struct ContactFinder {
    /// Within their limits.
    joints: Vec<f64>,
    palm_from_links: Vec<Isometry3<f64>>,
    shapes: PosedShapes,
    /// The links that touch each other.
    touching: Vec<(usize, usize)>,
}

impl ContactFinder {
    /// See [`contacts_from_frame`]. Of the cells that are not active it looks at nothing but the force.
    pub fn find(
        &mut self,
        hand: &Hand,
        hand_id: u64,
        joints: &[f64],
        cells_newtons: &[f64],
        contacts: &mut Vec<Contact>,
    ) -> ContactSummary {
        contacts.clear();
        let faulty = |fault| ContactSummary { fault, ..ContactSummary::default() };
        if hand_id != 0 && hand_id != hand.id() {
            return faulty(Fault::WrongHand);
        }
        let thresholds_newtons = hand.noise_thresholds_newtons();
        if joints.len() != hand.joints.len() || cells_newtons.len() != thresholds_newtons.len() {
            return faulty(Fault::WrongLength);
        }
        self.joints.clear();
        self.joints.extend_from_slice(joints);
        clip_to_limits(hand, &mut self.joints);
        if !are_forces(cells_newtons)
            || !self.joints.iter().zip(&hand.joints).all(|(value, joint)| joint.allows(*value, 0.0))
            || hand.write_palm_from_links(&self.joints, &mut self.palm_from_links).is_err()
        {
            return faulty(Fault::InvalidValue);
        }
        let palm_from_links = &self.palm_from_links;
        self.shapes.place(hand, palm_from_links);
        self.touching.clear();
        self.touching.extend(hand.touching_pairs(&self.shapes));
        let mut n_self_contacts = 0;
        for (pad_idx, pad) in hand.pads.iter().enumerate() {
            let palm_from_link = &palm_from_links[pad.link_idx];
            let cells = pad.first_cell_idx..pad.first_cell_idx + pad.cells.len();
            for cell_idx in active_idxs(&cells_newtons[cells.clone()], &thresholds_newtons[cells.clone()]) {
                let cell = &pad.cells[cell_idx];
                let position = palm_from_link * cell.position_in_link_m;
                if self.feels_hand(hand, pad.link_idx, &position) {
                    n_self_contacts += 1;
                    continue;
                }
                contacts.push(Contact {
                    position_m: position.coords.into(),
                    normal: (palm_from_link.rotation * cell.normal_in_link).into_inner().into(),
                    force_newtons: cells_newtons[pad.first_cell_idx + cell_idx],
                    pad: pad_idx as u32,
                    cell: cell_idx as u32,
                });
            }
        }
        let n_active = contacts.len();
        let is_object = pads_on_the_object(hand, &self.touching, contacts);
        contacts.retain(|contact| is_object[contact.pad as usize]);
        n_self_contacts += (n_active - contacts.len()) as u32;
        let n_pads_in_contact = contacts.chunk_by(|a, b| a.pad == b.pad).count() as u32;
        let fault = if contacts.is_empty() { Fault::NoContact } else { Fault::None };
        ContactSummary { n_pads_in_contact, self_collision: !self.touching.is_empty(), n_self_contacts, fault }
    }

    /// Why the last frame has no contact, for people: no cell feels, or cells only on links that touch each other.
    pub fn no_contact(&self, hand: &Hand, cells_newtons: &[f64]) -> Option<String> {
        let thresholds_newtons = hand.noise_thresholds_newtons();
        let mut links_that_feel = Vec::new();
        for pad in &hand.pads {
            let cells = pad.first_cell_idx..pad.first_cell_idx + pad.cells.len();
            if active_idxs(&cells_newtons[cells.clone()], &thresholds_newtons[cells]).next().is_some() {
                links_that_feel.push(pad.link_idx);
            }
        }
        let mut pairs = Vec::new();
        for (a, b) in &self.touching {
            if links_that_feel.contains(a) || links_that_feel.contains(b) {
                pairs.push(format!("{} and {}", hand.links[*a].name, hand.links[*b].name));
            }
        }
        if links_that_feel.is_empty() {
            let readings = cells_newtons.iter().enumerate();
            let (cell_idx, newtons) = readings.max_by(|(_, a), (_, b)| a.total_cmp(b))?;
            let (cell, unit) = (name_of_cell(hand, cell_idx)?, hand.cell_unit.word());
            return Some(format!(
                "no cell feels: the greatest reading is {} {unit}, of {cell}, which feels above {} {unit}",
                short(*newtons),
                short(thresholds_newtons[cell_idx])
            ));
        }
        if pairs.is_empty() {
            return None;
        }
        Some(format!("cells feel, but only on links that touch each other: {}", pairs.join("; ")))
    }

    /// Whether a point of a link, in the palm frame, is near to a link that touches that link.
    fn feels_hand(&self, hand: &Hand, link_idx: usize, position: &Point3<f64>) -> bool {
        for &(a, b) in &self.touching {
            for (own, other) in [(a, b), (b, a)] {
                if own == link_idx && hand.distance_to_link_m(position, other, &self.palm_from_links) <= SELF_CONTACT_M
                {
                    return true;
                }
            }
        }
        false
    }
}

/// For each pad, whether its contacts are with the object: those of links that touch no other link, and those that are
/// opposed by such contacts, or by contacts that are opposed in turn. Opposed are a contact and the mean normal of a pad that
/// are more than a right angle apart: with friction up to 1, nothing is held between others.
fn pads_on_the_object(hand: &Hand, touching: &[(usize, usize)], contacts: &[Contact]) -> [bool; MAX_PADS] {
    let touch = |a, b| touching.contains(&(a, b)) || touching.contains(&(b, a));
    let mut is_object = [false; MAX_PADS];
    for (is_object, pad) in is_object.iter_mut().zip(&hand.pads) {
        *is_object = !touching.iter().any(|&(a, b)| a == pad.link_idx || b == pad.link_idx);
    }
    // Each round finds a pad, or is the last one.
    loop {
        let mut found = None;
        for of_pad in contacts.chunk_by(|a, b| a.pad == b.pad) {
            let pad_idx = of_pad[0].pad as usize;
            if is_object[pad_idx] {
                continue;
            }
            let link_idx = hand.pads[pad_idx].link_idx;
            let sum: Vector3<f64> = of_pad.iter().map(|contact| Vector3::from(contact.normal)).sum();
            let is_opposed = contacts.iter().any(|other| {
                is_object[other.pad as usize]
                    && !touch(link_idx, hand.pads[other.pad as usize].link_idx)
                    && sum.dot(&Vector3::from(other.normal)) < 0.0
            });
            if is_opposed {
                found = Some(pad_idx);
                break;
            }
        }
        let Some(pad_idx) = found else { return is_object };
        is_object[pad_idx] = true;
    }
}

/// Whether all are from 0 to [`MAX_CELL_NEWTONS`]. NaN is not.
pub(crate) fn are_forces(cells_newtons: &[f64]) -> bool {
    let is_force = |force: &f64| (*force >= 0.0) & (*force <= MAX_CELL_NEWTONS);
    cells_newtons.chunks(BLOCK).all(|block| block.iter().fold(true, |all, force| all & is_force(force)))
}

/// Indices of the cells whose forces exceed their thresholds.
fn active_idxs(cells_newtons: &[f64], thresholds_newtons: &[f64]) -> impl Iterator<Item = usize> {
    let blocks = cells_newtons.chunks(BLOCK).zip(thresholds_newtons.chunks(BLOCK)).enumerate();
    let any_active = |(_, (forces, thresholds)): &(usize, (&[f64], &[f64]))| {
        forces.iter().zip(*thresholds).fold(false, |any, (force, threshold)| any | (force > threshold))
    };
    blocks.filter(any_active).flat_map(|(block_idx, (forces, thresholds))| {
        let is_active = |(_, (force, threshold)): &(usize, (&f64, &f64))| force > threshold;
        let active = forces.iter().zip(thresholds).enumerate().filter(is_active);
        active.map(move |(idx, _)| block_idx * BLOCK + idx)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Fingers that touch each other.
    const TOUCHING: [f64; 7] = [0.5, 1.7, 1.7, 1.7, 0.55, 0.55, 0.55];

    fn hand() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    fn run(hand_id: u64, joints: &[f64], cells_newtons: &[f64]) -> (ContactSummary, Vec<Contact>) {
        let hand = hand();
        let mut contacts = vec![Contact::default()];
        (contacts_from_frame(&hand, hand_id, joints, cells_newtons, &mut contacts), contacts)
    }

    #[test]
    fn only_cells_above_their_threshold_are_contacts() {
        let mut cells = [0.0; 96];
        (cells[0], cells[1], cells[24], cells[95]) = (0.05, 0.06, 1.0, 2.0);
        let (summary, contacts) = run(0, &[0.0; 7], &cells);
        assert_eq!(contacts.iter().map(|c| (c.pad, c.cell)).collect::<Vec<_>>(), [(0, 1), (1, 0), (3, 23)]);
        assert_eq!(summary, ContactSummary { n_pads_in_contact: 3, ..ContactSummary::default() });
        assert_eq!(contacts[0].position_m, [0.011, 0.0159, 0.0]);
        assert_eq!(contacts[0].normal, [0.0, 0.0, 1.0]);
    }

    #[test]
    fn bad_frames_have_a_fault_and_no_contacts() {
        let (mut nan, mut negative) = ([1.0; 96], [1.0; 96]);
        (nan[5], negative[95]) = (f64::NAN, -0.1);
        for (joints, cells, fault) in [
            (&[0.0; 7][..], &[0.0; 96][..], Fault::NoContact),
            (&[0.0; 7], &[1.0; 95], Fault::WrongLength),
            (&[0.0; 6], &[1.0; 96], Fault::WrongLength),
            (&[0.0; 7], &nan, Fault::InvalidValue),
            (&[0.0; 7], &negative, Fault::InvalidValue),
            (&[f64::NAN; 7], &[1.0; 96], Fault::InvalidValue),
            (&[0.0; 7], &[f64::INFINITY; 96], Fault::InvalidValue),
            (&[0.0; 7], &[1.7e308; 96], Fault::InvalidValue),
            (&[0.0, 45.0, 45.0, 45.0, 14.0, 14.0, 14.0], &[1.0; 96], Fault::InvalidValue),
            (&[-0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], &[1.0; 96], Fault::InvalidValue),
        ] {
            let (summary, contacts) = run(0, joints, cells);
            assert_eq!((summary.fault, contacts.len()), (fault, 0));
        }
        assert_eq!(run(1, &[0.0; 7], &[1.0; 96]).0.fault, Fault::WrongHand);
    }

    #[test]
    fn the_reading_that_makes_a_frame_invalid_is_named() {
        let hand = hand();
        let mut joints = [0.0; 7];
        let mut cells = [0.0; 96];
        let found = |joints: &[f64], cells: &[f64]| invalid_reading(&hand, joints, cells);
        assert_eq!(found(&joints, &cells), None);
        joints[1] = 39.4;
        let degrees = "joint finger_1 reads 39.4, expected 0 to 2.443 rad: degrees? (0.6877 rad)";
        assert_eq!(found(&joints, &cells).as_deref(), Some(degrees));
        joints[2] = f64::NAN;
        assert_eq!(found(&joints, &cells), Some(format!("{degrees}; another joint is outside its range, too")));
        // A wrong zero is no other unit.
        let asked = ": are sign, zero and order of the joints those of the hand's layout?";
        let near = found(&[0.0, 2.6, 0.0, 0.0, 0.0, 0.0, 0.0], &cells);
        assert_eq!(near.as_deref(), Some(&format!("joint finger_1 reads 2.6, expected 0 to 2.443 rad{asked}")[..]));
        // The first of them could be in degrees, the others not.
        joints = [2048.0; 7];
        joints[0] = 170.0;
        let ticks = "joint spread reads 170, expected 0 to 3.142 rad; 6 other joints are outside their range, too";
        assert_eq!(found(&joints, &cells).as_deref(), Some(ticks));
        cells[25] = f64::NAN;
        let cell = "cell 1 of pad finger_1 reads NaN, expected 0 to 1000000 newtons";
        assert_eq!(found(&[0.0; 7], &cells).as_deref(), Some(cell));
        assert_eq!(found(&[], &cells).as_deref(), Some("it has 0 joints and 96 cells, expected 7 and 96"));
    }

    #[test]
    fn a_joint_that_reads_beyond_its_stop_is_at_it() {
        let hand = hand();
        let stops: Vec<f64> = hand.joints.iter().map(|joint| joint.upper).collect();
        let beyond = |rad: f64| stops.iter().map(|stop| stop + rad).collect::<Vec<f64>>();
        assert_eq!(run(0, &beyond(0.09), &[1.0; 96]), run(0, &stops, &[1.0; 96]));
        let mut joints = beyond(0.09);
        clip_to_limits(&hand, &mut joints);
        assert_eq!(joints, stops);
        // Farther is no zero of an encoder, and is shown as it is.
        let mut joints = beyond(0.11);
        clip_to_limits(&hand, &mut joints);
        assert_eq!((joints, run(0, &beyond(0.11), &[1.0; 96]).0.fault), (beyond(0.11), Fault::InvalidValue));
    }

    #[test]
    fn active_cells_are_found_wherever_they_are() {
        for n_cells in [1, 15, 16, 17, 100] {
            // Half of them have the threshold 0, and a force at its threshold is not above it.
            let thresholds: Vec<f64> = (0..n_cells).map(|idx| f64::from(idx % 2) * 0.05).collect();
            assert_eq!(active_idxs(&thresholds, &thresholds).count(), 0);
            for step in 1..=n_cells {
                let is_active = |idx: &u32| (idx + 1).is_multiple_of(step);
                let active: Vec<usize> = (0..n_cells).filter(is_active).map(|idx| idx as usize).collect();
                let mut forces = thresholds.clone();
                active.iter().for_each(|idx| forces[*idx] += 0.01);
                assert_eq!(active_idxs(&forces, &thresholds).collect::<Vec<_>>(), active);
                assert!(are_forces(&forces));
                for bad in [-0.1, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1.000001e6] {
                    let mut forces = forces.clone();
                    forces[step as usize - 1] = bad;
                    assert!(!are_forces(&forces), "{bad} at {step} of {n_cells}");
                }
            }
        }
        assert!(are_forces(&[0.0, -0.0, MAX_CELL_NEWTONS]) && are_forces(&[]));
    }

    #[test]
    fn a_finder_that_is_used_again_finds_the_same() {
        let hand = hand();
        let mut finder = ContactFinder::default();
        let mut found = Vec::new();
        for joints in [TOUCHING, [f64::NAN; 7], [0.0; 7], TOUCHING] {
            let summary = finder.find(&hand, 0, &joints, &[1.0; 96], &mut found);
            assert_eq!((summary, found.clone()), run(0, &joints, &[1.0; 96]));
        }
    }

    #[test]
    fn cells_between_fingers_that_touch_are_left_out_and_counted() {
        let (summary, contacts) = run(0, &TOUCHING, &[1.0; 96]);
        assert!(summary.self_collision && summary.n_self_contacts > 0, "{summary:?}");
        assert_eq!((contacts.len() + summary.n_self_contacts as usize, summary.fault), (96, Fault::None));
        assert!(contacts.iter().filter(|contact| contact.pad == 0).count() == 24, "no finger reaches the palm's cells");
    }

    /// Forces of 1 N on the cells so near to a link that touches theirs.
    fn pressed_by_links(hand: &Hand, joints: &[f64], within_m: f64) -> [f64; 96] {
        let palm_from_links = hand.palm_from_links(joints).expect("7 joints");
        let mut shapes = PosedShapes::default();
        shapes.place(hand, &palm_from_links);
        let touching: Vec<(usize, usize)> = hand.touching_pairs(&shapes).collect();
        let mut cells_newtons = [0.0; 96];
        for (newtons, (pad_idx, cell)) in cells_newtons.iter_mut().zip(hand.cells()) {
            let link_idx = hand.pads[pad_idx].link_idx;
            let position = palm_from_links[link_idx] * cell.position_in_link_m;
            let is_near = |other| hand.distance_to_link_m(&position, other, &palm_from_links) <= within_m;
            let presses = |&(a, b): &(usize, usize)| (a == link_idx && is_near(b)) || (b == link_idx && is_near(a));
            *newtons = f64::from(u8::from(touching.iter().any(presses)));
        }
        cells_newtons
    }

    #[test]
    fn fingers_that_press_each_other_on_nothing_feel_no_object() {
        let [touched, spread] = [SELF_CONTACT_M, 0.012].map(|within_m| pressed_by_links(&hand(), &TOUCHING, within_m));
        let [n_touched, n_spread] = [touched, spread].map(|cells| cells.iter().sum::<f64>() as u32);
        assert!(n_touched > 0 && n_spread > n_touched, "the skin spreads it");
        for (pressed, n_pressed) in [(touched, n_touched), (spread, n_spread)] {
            let (summary, contacts) = run(0, &TOUCHING, &pressed);
            let found = (summary.fault, summary.n_self_contacts, contacts.len());
            assert_eq!(found, (Fault::NoContact, n_pressed, 0));
            let mut finder = ContactFinder::default();
            finder.find(&hand(), 0, &TOUCHING, &pressed, &mut Vec::new());
            let said = finder.no_contact(&hand(), &pressed).expect("cells feel");
            assert!(said.ends_with(": distal_1 and distal_3; distal_2 and distal_3"), "{said}");
            let mut faint = [0.0; 96];
            faint[25] = 0.04;
            let said = finder.no_contact(&hand(), &faint).expect("the greatest reading");
            let expected = "no cell feels: the greatest reading is 0.04 newtons, of cell 1 of pad finger_1, which feels above 0.05 newtons";
            assert_eq!(said, expected);
        }
    }

    #[test]
    fn an_object_between_finger_and_palm_is_felt_by_fingers_that_touch_each_other_as_well() {
        let hand = hand();
        // Fingers 2 and 3 touch; finger 1 and the palm touch nothing.
        let joints = [0.5, 1.2, 1.7, 1.7, 0.4, 0.55, 0.55];
        let pressed = pressed_by_links(&hand, &joints, 0.1);
        assert!(
            pressed[..48].iter().all(|newtons| *newtons == 0.0) && pressed[48..].iter().all(|newtons| *newtons > 0.0)
        );
        let between: f64 = pressed_by_links(&hand, &joints, SELF_CONTACT_M).iter().sum();
        let (summary, contacts) = run(0, &joints, &[1.0; 96]);
        assert_eq!((summary.n_pads_in_contact, summary.n_self_contacts), (4, between as u32));
        assert_eq!(contacts.len() + between as usize, 96);
        // Without anything that opposes them, they feel each other.
        assert_eq!(run(0, &joints, &pressed).0.fault, Fault::NoContact);
    }
}
