//! Finds readings that a healthy hand does not give, without training: cells that stand still among others that flicker, loads in
//! the open hand, loads and joints that move in a hand at rest, and values that are the same in each grasp.
//!
//! They decide nothing. The sentences are for people who ask why grasps are held, or fall. Pure: no clock, no I/O.

use crate::hand::{Hand, Pad};
use crate::out_of_distribution::short;
use blindgrasp_messages::{Contact, MAX_PADS, Phase};

/// A pad's cells stand still if so many do: others are coarse, and repeat their readings by chance.
const MIN_STILL_CELLS: u32 = 4;
/// Successive readings of still cells, summed over them. If one in three changes by chance, none of so many does in a grasp of 10^6.
const MIN_REPEATED: u32 = 36;
/// Frames before anything is said to stand still.
const MIN_FRAMES: u32 = 10;
/// Frames of a grasp that are looked at for still cells.
const MAX_FRAMES: u32 = 1000;
/// A joint at rest moves by less. An encoder's noise is 0.01 rad.
const AT_REST_RAD: f64 = 0.03;
/// A joint that closes moves by more in a grasp.
const CLOSING_RAD: f64 = 0.1;
/// A pad's load has changed if it is so many times another, and differs by so many noise thresholds, in so many frames in a row.
/// A skin's creep is less.
const LOAD_FACTOR: f64 = 2.0;
const LOAD_THRESHOLDS: f64 = 10.0;
const LOAD_FRAMES: u32 = 3;
/// A load that changes by more than this part of it from frame to frame is noise: 1 over so many.
const NOISE_STEPS: f64 = 4.0;
/// Grasps in a row in which a value is the same number: a finger may be blocked from the start in one or two of them.
const SAME_GRASPS: u32 = 5;

/// The readings of a grasp's frames so far, and the values that stayed the same in the grasps before it.
#[derive(Debug, Default)]
pub struct OddReadings {
    /// Epoch and grasp of the last frame.
    grasp: Option<(u64, u64)>,
    n_frames: u32,
    /// Those of the last frame.
    cells_newtons: Vec<f64>,
    /// For each cell: in how many frames it read another number than in the one before, and in how many of them it felt nothing.
    changes: Vec<[u32; 2]>,
    /// The least and the greatest value of each joint in the grasp.
    joint_ranges: Vec<[f64; 2]>,
    /// The least load of each pad in the open hand; infinity without a frame of it.
    open_newtons: [f64; MAX_PADS],
    /// The phase in which the hand rests, its joints when that had just begun, and the loads of its pads.
    rest: Option<Phase>,
    rest_joints: Vec<f64>,
    rest_newtons: [f64; MAX_PADS],
    /// For each pad: in how many frames in a row its load has been another one.
    n_changed: [u32; MAX_PADS],
    /// The sentence about a joint or a load that has moved in the resting hand.
    unrest: Option<String>,
    /// The greatest force of a contact of the settled hand.
    greatest_newtons: f64,
    /// Of the grasps before, for each joint and for the greatest reading: the value, and in how many of them in a row it was this one.
    same_joints: Vec<(f64, u32)>,
    same_newtons: (f64, u32),
}

impl OddReadings {
    /// Takes the next frame, which is valid and has these contacts.
    pub fn note(
        &mut self,
        hand: &Hand,
        grasp: (u64, u64),
        phase: Phase,
        (joints, cells_newtons): (&[f64], &[f64]),
        contacts: &[Contact],
    ) {
        if phase.is_over() {
            return;
        }
        if self.grasp != Some(grasp)
            || self.joint_ranges.len() != joints.len()
            || self.changes.len() != cells_newtons.len()
        {
            self.begin(hand, grasp, joints, cells_newtons);
        }
        for (range, now) in self.joint_ranges.iter_mut().zip(joints) {
            *range = [range[0].min(*now), range[1].max(*now)];
        }
        let (mut newtons, mut steps_newtons) = ([0.0; MAX_PADS], [0.0; MAX_PADS]);
        for Contact { pad, cell, force_newtons, .. } in contacts {
            let pad_idx = *pad as usize;
            let before = self.cells_newtons[hand.pads[pad_idx].first_cell_idx + *cell as usize];
            newtons[pad_idx] += force_newtons;
            steps_newtons[pad_idx] += (force_newtons - before).abs();
        }
        if phase == Phase::Open {
            for ((least, now), step) in self.open_newtons.iter_mut().zip(newtons).zip(steps_newtons) {
                *least = if now > NOISE_STEPS * step { least.min(now) } else { 0.0 };
            }
        }
        if self.n_frames < MAX_FRAMES {
            self.count_changes(hand.noise_thresholds_newtons(), cells_newtons);
        } else {
            self.cells_newtons.copy_from_slice(cells_newtons);
        }
        let rest = phase.decides().then_some(phase);
        let was_at_rest = std::mem::replace(&mut self.rest, rest) == rest;
        if rest.is_none() {
            return;
        }
        if phase == Phase::Settled {
            for contact in contacts {
                self.greatest_newtons = self.greatest_newtons.max(contact.force_newtons);
            }
        }
        if !was_at_rest {
            self.rest_joints.clear();
            self.rest_joints.extend_from_slice(joints);
            (self.rest_newtons, self.n_changed) = (newtons, [0; MAX_PADS]);
        } else if self.unrest.is_none() {
            self.unrest = self.find_unrest(hand, phase, joints, &newtons, &steps_newtons);
        }
    }

    fn count_changes(&mut self, thresholds_newtons: &[f64], cells_newtons: &[f64]) {
        self.n_frames += 1;
        let readings = self.cells_newtons.iter_mut().zip(cells_newtons).zip(thresholds_newtons);
        for (((before, now), threshold), [n_all, n_idle]) in readings.zip(&mut self.changes) {
            let has_changed = *before != *now;
            *n_all += u32::from(has_changed);
            *n_idle += u32::from(has_changed & (*before <= *threshold) & (*now <= *threshold));
            *before = *now;
        }
    }

    /// Ends the grasp before, and begins another one.
    fn begin(&mut self, hand: &Hand, grasp: (u64, u64), joints: &[f64], cells_newtons: &[f64]) {
        let mut has_closed = false;
        for ([least, greatest], joint) in self.joint_ranges.iter().zip(&hand.joints) {
            has_closed |= greatest - least > CLOSING_RAD * joint.kind.per_radian();
        }
        self.same_joints.resize(joints.len(), (f64::NAN, 0));
        if has_closed {
            for (same, [least, greatest]) in self.same_joints.iter_mut().zip(&self.joint_ranges) {
                count_same(same, if least == greatest { *least } else { f64::NAN });
            }
        }
        if self.greatest_newtons > 0.0 {
            count_same(&mut self.same_newtons, self.greatest_newtons);
        }
        self.grasp = Some(grasp);
        (self.n_frames, self.greatest_newtons) = (0, 0.0);
        (self.rest, self.unrest) = (None, None);
        self.cells_newtons.clear();
        self.cells_newtons.extend_from_slice(cells_newtons);
        self.changes.clear();
        self.changes.resize(cells_newtons.len(), [0; 2]);
        self.joint_ranges.clear();
        self.joint_ranges.extend(joints.iter().map(|value| [*value; 2]));
        self.open_newtons = [f64::INFINITY; MAX_PADS];
    }

    /// The odd readings of the grasp of the last frame so far, a sentence each; none of another grasp.
    pub fn said(&self, hand: &Hand, grasp_id: u64) -> Vec<String> {
        let mut said = Vec::new();
        if self.grasp.is_none_or(|(_, of_grasp)| of_grasp != grasp_id) {
            return said;
        }
        let unit = hand.cell_unit.word();
        let mut feel = Vec::new();
        for (pad, newtons) in hand.pads.iter().zip(self.open_newtons) {
            if newtons.is_finite() && newtons > 0.0 {
                feel.push(format!("{} {} {unit}", pad.name, short(newtons)));
            }
        }
        if !feel.is_empty() {
            said.push(format!(
                "pads feel in the open hand ({}): are zeros wrong, cells stuck or late, or does something touch them?",
                feel.join(", ")
            ));
        }
        for ((value, n_grasps), joint) in self.same_joints.iter().zip(&hand.joints) {
            if *n_grasps >= SAME_GRASPS && !joint.is_preshape {
                let (name, value, unit) = (&joint.name, short(*value), joint.kind.unit());
                said.push(format!(
                    "joint {name} read {value} {unit} throughout the {n_grasps} grasps before: is it stuck?"
                ));
            }
        }
        let (newtons, n_grasps) = self.same_newtons;
        if n_grasps >= SAME_GRASPS {
            let newtons = short(newtons);
            said.push(format!(
                "the greatest force in each of the {n_grasps} grasps before is {newtons} {unit}: do cells end there, or is one stuck?"
            ));
        }
        said.extend(self.still_cells(hand));
        said.extend(self.unrest.clone());
        said
    }

    /// The cells that repeat their readings, if healthy ones would not.
    fn still_cells(&self, hand: &Hand) -> Vec<String> {
        let n_frames = self.n_frames;
        let n_still = self.changes.iter().filter(|changes| changes[0] == 0).count();
        if n_frames < MIN_FRAMES || n_still == 0 {
            return Vec::new();
        }
        let n_not_0 = self.cells_newtons.iter().filter(|newtons| **newtons > 0.0).count();
        if n_still == self.changes.len() && 4 * n_not_0 > n_still {
            let joints =
                if self.joint_ranges.iter().all(|range| range[0] == range[1]) { "joints and cells" } else { "cells" };
            return vec![format!(
                "all {joints} repeat their readings in {n_frames} frames: is an old frame sent again?"
            )];
        }
        let n_changes: u32 = self.changes.iter().map(|changes| changes[1]).sum();
        let n_flickering = (self.changes.len() - n_still) as u32;
        // Where idle cells read the same number as a rule, a still one is healthy.
        if 3 * n_changes < n_flickering * (n_frames - 1) || n_flickering < MIN_STILL_CELLS {
            return Vec::new();
        }
        let mut said = Vec::new();
        for Pad { name, first_cell_idx, cells, .. } in &hand.pads {
            let n_cells = cells.len() as u32;
            let of_pad = &self.changes[*first_cell_idx..][..cells.len()];
            let n_still = of_pad.iter().filter(|changes| changes[0] == 0).count() as u32;
            if n_still >= MIN_STILL_CELLS.min(n_cells) && n_still * (n_frames - 1) >= MIN_REPEATED {
                said.push(format!(
                    "{n_still} of {n_cells} cells of pad {name} repeat their readings in {n_frames} frames, and others do not: are they dead?"
                ));
            }
        }
        said
    }

    /// The first joint, or the first pad's load, that is not as it was, for people.
    fn find_unrest(
        &mut self,
        hand: &Hand,
        phase: Phase,
        joints: &[f64],
        newtons: &[f64; MAX_PADS],
        steps_newtons: &[f64; MAX_PADS],
    ) -> Option<String> {
        for ((before, now), joint) in self.rest_joints.iter().zip(joints).zip(&hand.joints) {
            if (now - before).abs() > AT_REST_RAD * joint.kind.per_radian() {
                let (name, before, now, unit) = (&joint.name, short(*before), short(*now), joint.kind.unit());
                return Some(format!(
                    "joint {name} moves from {before} to {now} {unit} in phase {}: does the phase come early, or do the motors give way?",
                    phase.as_str()
                ));
            }
        }
        // An object that slips while it is lifted is what the model judges.
        if phase != Phase::Settled {
            return None;
        }
        for (idx, pad) in hand.pads.iter().enumerate() {
            let (before, now) = (self.rest_newtons[idx], newtons[idx]);
            let (low, high) = (before.min(now), before.max(now));
            let least_change = LOAD_THRESHOLDS * hand.noise_thresholds_newtons()[pad.first_cell_idx];
            let least_change = least_change.max(NOISE_STEPS * steps_newtons[idx]);
            let has_changed = high > LOAD_FACTOR * low && high - low > least_change;
            self.n_changed[idx] = if has_changed { self.n_changed[idx] + 1 } else { 0 };
            if self.n_changed[idx] == LOAD_FRAMES {
                let (name, before, now, unit) = (&pad.name, short(before), short(now), hand.cell_unit.word());
                return Some(format!(
                    "the load of pad {name} goes from {before} to {now} {unit} in phase settled while the joints rest: do its cells come \
                     late, do the motors give way, or does the object slip?"
                ));
            }
        }
        None
    }
}

/// Counts that a value is the number that it was before. NaN is no number.
fn count_same(same: &mut (f64, u32), value: f64) {
    *same = if same.0 == value { (value, same.1 + 1) } else { (value, u32::from(!value.is_nan())) };
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::contacts::contacts_from_frame;

    struct Frame {
        grasp: u64,
        idx: usize,
        joints: Vec<f64>,
        cells: Vec<f64>,
    }

    /// The sentences about the last of some grasps: 2 frames open, 6 closing, 20 settled. Idle cells flicker, and cells of two fingers
    /// feel. `spoil` makes the fault.
    fn said(n_grasps: u64, spoil: impl Fn(&mut Frame)) -> String {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let (mut odd, mut contacts) = (OddReadings::default(), Vec::new());
        for grasp in 0..n_grasps {
            for idx in 0..28_usize {
                let phase = [Phase::Open, Phase::Closing, Phase::Settled][usize::from(idx > 1) + usize::from(idx > 7)];
                let closed = 0.15 * idx.min(8) as f64;
                let joints = vec![0.5, closed, closed, closed, closed / 3.0, closed / 3.0, closed / 3.0];
                let flicker = |cell: u64| {
                    let hash = (grasp * 1_000_003 + idx as u64 * 7919 + cell + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                    ((hash ^ (hash >> 29)).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f64 % 5.0 * 0.005
                };
                let mut cells: Vec<f64> = (0..hand.n_cells() as u64).map(flicker).collect();
                if idx > 4 {
                    cells[30] += 0.5 * (idx.min(8) - 4) as f64 + 0.01 * grasp as f64;
                    cells[54] += 0.5 * (idx.min(8) - 4) as f64;
                }
                let mut frame = Frame { grasp, idx, joints, cells };
                spoil(&mut frame);
                let Frame { joints, cells, .. } = frame;
                contacts_from_frame(&hand, 0, &joints, &cells, &mut contacts);
                odd.note(&hand, (0, grasp), phase, (&joints, &cells), &contacts);
            }
        }
        assert_eq!(odd.said(&hand, n_grasps), [""; 0], "of another grasp");
        odd.said(&hand, n_grasps - 1).join("; ")
    }

    #[test]
    fn a_healthy_hand_is_not_odd() {
        assert_eq!(said(30, |_| {}), "");
        // Cells that cut off their noise stand still as a rule.
        assert_eq!(
            said(3, |frame| frame.cells.iter_mut().for_each(|cell| *cell = if *cell < 0.05 { 0.0 } else { *cell })),
            ""
        );
        // A finger may be blocked from the start in one grasp.
        assert_eq!(said(10, |frame| frame.joints[2] *= if frame.grasp == 3 { 0.0 } else { 1.0 }), "");
    }

    #[test]
    fn each_fault_is_named_with_its_part() {
        let noisy = said(1, |frame| frame.cells.iter_mut().for_each(|cell| *cell *= 10.0));
        assert_eq!(noisy, "");
        let dead = said(1, |frame| frame.cells[48..72].fill(0.0));
        assert!(dead.starts_with("24 of 24 cells of pad finger_2 repeat their readings in 28 frames"), "{dead}");
        let half = said(1, |frame| (0..96).step_by(2).for_each(|cell| frame.cells[cell] = 0.01));
        assert_eq!(half.matches("12 of 24 cells of pad ").count(), 4, "{half}");
        let frozen = said(1, |frame| frame.cells = (0..96).map(|cell| f64::from(cell) * 0.001).collect());
        assert!(frozen.contains("all cells repeat their readings in 28 frames"), "{frozen}");
        let old = said(1, |frame| (frame.joints, frame.cells) = (vec![0.5; 7], vec![0.01; 96]));
        assert!(old.starts_with("all joints and cells repeat"), "{old}");
        let zero = said(1, |frame| frame.cells[24..48].iter_mut().for_each(|cell| *cell += 0.2));
        assert!(
            zero.starts_with("pads feel in the open hand (finger_1 ") && zero.contains(" newtons): are zeros wrong, "),
            "{zero}"
        );
        let opening = said(1, |frame| frame.joints[1] -= 0.004 * frame.idx.saturating_sub(8) as f64);
        assert!(opening.starts_with("joint finger_1 moves from 1.2 to 1.168 rad in phase settled: "), "{opening}");
        let late = said(1, |frame| frame.cells[54] *= f64::from(u8::from(frame.idx > 15)));
        assert!(late.starts_with("the load of pad finger_2 goes from 0 to 2"), "{late}");
        let stuck = said(6, |frame| frame.joints[2] = 0.3);
        assert!(stuck.starts_with("joint finger_2 read 0.3 rad throughout the 5 grasps before: "), "{stuck}");
        assert_eq!(said(5, |frame| frame.joints[2] = 0.3), "");
        let capped = said(6, |frame| frame.cells.iter_mut().for_each(|cell| *cell = cell.min(0.5)));
        assert!(capped.starts_with("the greatest force in each of the 5 grasps before is 0.5 newtons: "), "{capped}");
    }
}
