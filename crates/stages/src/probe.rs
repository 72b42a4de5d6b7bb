//! Judges a grasp after a probe: from the reading that decides and from the readings before it.
//!
//! A probe is a small movement that shows more of a grasp: the hand tightens to the force of a lift, and then the arm may lift
//! by a few millimetres and rest. The load that arrives on the fingers, moves over their cells or goes away again says more
//! about the lift than the settled grasp does. (Chebotar et al., "Self-supervised regrasping using spatio-temporal tactile
//! features and reinforcement learning", 2016, predict from the early lift). [`ProbeModel`] takes the feature of the frame,
//! that of the last frame of the phase before, their difference, and loads relative to the hand's own grip.
//!
//! Pure: no clock, no I/O. [`GraspHistory`] is the state.

use serde::{Deserialize, Serialize};

use crate::classifier::{Classifier, Verdict};
use crate::encoder::{Block, FeatureExtractor, N_PAD_VALUES};
use crate::out_of_distribution::TrainingRange;
use blindgrasp_messages::{Fault, Phase};

/// The learned judgement of the readings after a probe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeModel {
    /// It takes the values of [`GraspHistory::compose`].
    pub classifier: Classifier,
    /// What the frames look like that decide.
    pub training_range: TrainingRange,
    /// Area under the ROC curve over folds of objects.
    pub cross_validated_roc_area: f64,
    /// Expected calibration error over the same folds.
    pub cross_validated_ece: f64,
}

impl ProbeModel {
    /// Checks a probe that was read from a file.
    ///
    /// # Errors
    /// The first problem found.
    pub(crate) fn validate(&self, features: &FeatureExtractor) -> Result<(), String> {
        self.training_range.validate(features).map_err(|error| format!("the training range: {error}"))?;
        self.classifier.validate(n_values(features))
    }
}

/// Values that a probe's classifier takes.
pub fn n_values(features: &FeatureExtractor) -> usize {
    3 * features.len() + (N_TRACK_VALUES + N_SHARES) * signals(features).len()
}

/// Values of a [`Track`] for each signal.
const N_TRACK_VALUES: usize = 4;

/// Values of each signal that do not change if all cells read the same factor more: see `shares`.
const N_SHARES: usize = 4;

/// Where the signals that are followed while the hand moves stand among a feature's values: the load of each pad, and the
/// load on the wrist along gravity, as far as the feature has them.
pub fn signals(features: &FeatureExtractor) -> Vec<usize> {
    let (mut signals, mut start) = (Vec::new(), 0);
    for block in &features.blocks {
        let len = features.block_len(*block);
        match block {
            Block::Pads => signals.extend((start..start + len).step_by(N_PAD_VALUES)),
            Block::Wrist => signals.push(start),
            _ => {}
        }
        start += len;
    }
    signals
}

/// What all pads together feel, by the values of a feature that is not scaled: newtons; `None` if it does not have it.
pub fn pad_newtons(features: &FeatureExtractor, values: &[f64]) -> Option<f64> {
    Some(pads(features, values)?.map(|pad| pad[0]).sum())
}

/// The values of each pad, of a feature that is not scaled: its load, its number of contacts, and the others of [`Block::Pads`];
/// `None` if the feature does not have them.
pub(crate) fn pads<'a>(features: &FeatureExtractor, values: &'a [f64]) -> Option<impl Iterator<Item = &'a [f64]>> {
    if features.scaling.is_some() {
        return None;
    }
    let place = features.blocks.iter().position(|block| *block == Block::Pads)?;
    let start: usize = features.blocks[..place].iter().map(|block| features.block_len(*block)).sum();
    Some(values.get(start..start + features.block_len(Block::Pads))?.chunks_exact(N_PAD_VALUES))
}

/// The course of the signals while the hand moves.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Track {
    phase: Phase,
    last: Vec<f64>,
    greatest: Vec<f64>,
    least: Vec<f64>,
    /// The sum of all steps up and down.
    travelled: Vec<f64>,
    greatest_step: Vec<f64>,
}

impl Track {
    fn add(&mut self, phase: Phase, signals: impl Iterator<Item = f64> + Clone) {
        if self.phase != phase || self.last.is_empty() {
            let begin: Vec<f64> = signals.collect();
            let still = vec![0.0; begin.len()];
            *self = Track {
                phase,
                last: begin.clone(),
                greatest: begin.clone(),
                least: begin,
                travelled: still.clone(),
                greatest_step: still,
            };
            return;
        }
        for (idx, now) in signals.enumerate() {
            let step = (now - self.last[idx]).abs();
            self.last[idx] = now;
            self.greatest[idx] = self.greatest[idx].max(now);
            self.least[idx] = self.least[idx].min(now);
            self.travelled[idx] += step;
            self.greatest_step[idx] = self.greatest_step[idx].max(step);
        }
    }
}

/// What is left of the last frame of a phase: its feature, or the fault for which it has none. `None` before the first one.
type Look = Option<Result<Vec<f64>, Fault>>;

/// The features of the open grasp from which a probe is judged.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GraspHistory {
    /// Epoch and number of the grasp.
    grasp: Option<(u64, u64)>,
    /// The settled hand.
    settled: Look,
    /// The tight hand, before the arm moved.
    squeezed: Look,
    track: Track,
    /// What all pads together felt after the test lift.
    borne_newtons: Option<f64>,
}

impl GraspHistory {
    /// Takes the feature of the next frame, or its fault. `signals` are [`signals`].
    pub fn add(
        &mut self,
        (epoch, grasp_id): (u64, u64),
        phase: Phase,
        values: Result<&[f64], Fault>,
        signals: &[usize],
    ) {
        if self.grasp != Some((epoch, grasp_id)) {
            *self = GraspHistory { grasp: Some((epoch, grasp_id)), ..GraspHistory::default() };
        }
        match phase {
            Phase::Settled => self.settled = Some(values.map(<[f64]>::to_vec)),
            Phase::Squeezed => self.squeezed = Some(values.map(<[f64]>::to_vec)),
            // Pads without contact have no load.
            Phase::Squeezing | Phase::TestLifting => {
                let values = values.unwrap_or_default();
                self.track.add(phase, signals.iter().map(|idx| values.get(*idx).copied().unwrap_or(0.0)));
            }
            // The hand has moved again.
            Phase::Open | Phase::Closing => *self = GraspHistory { grasp: self.grasp, ..GraspHistory::default() },
            Phase::TestLifted | Phase::Lifting | Phase::Ended | Phase::Kept | Phase::Dropped => {}
        }
    }

    /// Keeps what all pads together feel after the test lift.
    pub fn bears(&mut self, newtons: f64) {
        self.borne_newtons = Some(newtons);
    }

    /// Judges a frame while the arm lifts, in which all pads together feel so much.
    ///
    /// # Errors
    /// [`Fault::MissingReading`] without a frame after the test lift in which the pads felt something.
    pub fn judge_lifting(&self, newtons: f64) -> Result<Verdict, Fault> {
        let before = self.borne_newtons.filter(|before| *before > LEAST_NEWTONS).ok_or(Fault::MissingReading)?;
        Ok(lifting_verdict(newtons / before))
    }

    /// Writes the values from which a frame of the grasp is judged: the feature of the phase before, the frame's own, how it
    /// differs. Of each signal while the hand moved in between come its greatest and least value, the sum of its steps and
    /// the greatest one, and its values relative to the grip.
    ///
    /// # Errors
    /// The fault of the phase before; [`Fault::MissingReading`] if no frame of it came, or the hand has not been seen to move.
    pub fn compose(
        &self,
        phase: Phase,
        values: &[f64],
        signals: &[usize],
        composed: &mut Vec<f64>,
    ) -> Result<(), Fault> {
        composed.clear();
        let (before, moving) = match phase {
            Phase::Squeezed => (&self.settled, Phase::Squeezing),
            _ => (&self.squeezed, Phase::TestLifting),
        };
        let before = before.as_ref().ok_or(Fault::MissingReading)?.as_ref().map_err(|fault| *fault)?;
        let track = &self.track;
        if before.len() != values.len() || track.phase != moving || track.last.len() != signals.len() {
            return Err(Fault::MissingReading);
        }
        composed.extend_from_slice(before);
        composed.extend_from_slice(values);
        composed.extend(values.iter().zip(before).map(|(now, before)| now - before));
        for part in [&track.greatest, &track.least, &track.travelled, &track.greatest_step] {
            composed.extend_from_slice(part);
        }
        composed.extend(signals.iter().zip(&track.travelled).flat_map(|(idx, travelled)| {
            let sum = |of: &[f64]| signals.iter().map(|idx| of[*idx].abs()).sum::<f64>();
            shares((before[*idx], sum(before)), (values[*idx], sum(values)), *travelled)
        }));
        Ok(())
    }
}

/// The judgement of a frame while the arm lifts, by the part of the load after the test lift that the pads still feel.
/// Contacts that creep lose their load over seconds before the object falls.
fn lifting_verdict(part: f64) -> Verdict {
    Verdict {
        decision_value: part,
        probability_stable: part.clamp(0.0, 1.0),
        stable: part >= TIGHTEN_BELOW,
        unsure: (SET_DOWN_BELOW..TIGHTEN_BELOW).contains(&part),
    }
}

/// A hand that feels less than this part of the load should tighten, and below the other set the object down: chosen on 2,500 lifts of
/// training objects in rapier and MuJoCo (benches/archive.md).
const TIGHTEN_BELOW: f64 = 0.85;
const SET_DOWN_BELOW: f64 = 0.5;

/// A signal relative to the hand's own grip, from the signal before and now, each with the sum of all signals. It is told as its
/// shares of the sums, its part now of before and now, and how far it travelled for each newton of these. 0 of nothing. Skins
/// differ in their gain, and in how much force they lose between cells; these values do not.
fn shares((before, all_before): (f64, f64), (now, all_now): (f64, f64), travelled: f64) -> [f64; N_SHARES] {
    let part = |of: f64, whole: f64| if whole.abs() > LEAST_NEWTONS { of / whole } else { 0.0 };
    let both = before.abs() + now.abs();
    [part(before, all_before), part(now, all_now), part(now, both), part(travelled, both)]
}

/// A hundredth of what a cell's noise comes to: no share is known of less.
const LEAST_NEWTONS: f64 = 1e-3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_the_same_for_a_skin_that_reads_twice_as_much() {
        let of = |gain: f64| shares((1.0 * gain, 4.0 * gain), (3.0 * gain, 5.0 * gain), 2.0 * gain);
        assert_eq!(of(1.0), [0.25, 0.6, 0.75, 0.5]);
        assert_eq!(of(2.0), of(1.0));
        assert_eq!(shares((0.0, 0.0), (0.0, 0.0), 0.0), [0.0; N_SHARES]);
    }

    #[test]
    fn a_lift_is_judged_by_the_load_that_is_left() {
        let mut history = GraspHistory::default();
        assert_eq!(history.judge_lifting(4.0), Err(Fault::MissingReading), "there was no test lift");
        history.bears(0.0);
        assert_eq!(history.judge_lifting(4.0), Err(Fault::MissingReading), "nothing was felt");
        history.bears(8.0);
        for (newtons, part, stable, unsure) in
            [(12.0, 1.0, true, false), (6.8, 0.85, true, false), (4.0, 0.5, false, true), (3.9, 0.4875, false, false)]
        {
            let verdict = Verdict { decision_value: newtons / 8.0, probability_stable: part, stable, unsure };
            assert_eq!(history.judge_lifting(newtons), Ok(verdict));
        }
        history.add((0, 0), Phase::Settled, Ok(&[1.0]), &[]);
        assert_eq!(history.judge_lifting(4.0), Err(Fault::MissingReading), "another grasp");
    }

    #[test]
    fn a_reading_is_compared_with_the_phase_before_of_the_same_grasp() {
        const SIGNALS: [usize; 1] = [1];
        let mut history = GraspHistory::default();
        let mut composed = Vec::new();
        let mut add = |phase, values: &[f64]| history.add((0, 7), phase, Ok(values), &SIGNALS);
        add(Phase::Settled, &[1.0, 2.0]);
        add(Phase::Settled, &[1.0, 3.0]);
        add(Phase::Squeezing, &[9.0, 4.0]);
        add(Phase::Squeezing, &[9.0, 7.0]);
        history.add((0, 7), Phase::Squeezing, Err(Fault::NoContact), &SIGNALS);
        let of = |history: &GraspHistory, phase, values: &[f64], composed: &mut Vec<f64>| {
            history.compose(phase, values, &SIGNALS, composed)
        };
        assert_eq!(of(&history, Phase::Squeezed, &[2.0, 5.0], &mut composed), Ok(()));
        assert_eq!(composed[..10], [1.0, 3.0, 2.0, 5.0, 1.0, 2.0, 7.0, 0.0, 10.0, 7.0]);
        assert_eq!(composed[10..], [1.0, 1.0, 5.0 / 8.0, 10.0 / 8.0]);
        let missing = Err(Fault::MissingReading);
        assert_eq!(of(&history, Phase::TestLifted, &[2.0, 5.0], &mut composed), missing);
        history.add((0, 7), Phase::Squeezed, Ok(&[2.0, 5.0]), &SIGNALS);
        assert_eq!(of(&history, Phase::TestLifted, &[2.0, 5.0], &mut composed), missing, "it has not been lifted");
        history.add((0, 7), Phase::TestLifting, Ok(&[2.0, 4.0]), &SIGNALS);
        assert_eq!(of(&history, Phase::TestLifted, &[2.0, 4.0], &mut composed), Ok(()));
        assert_eq!(composed[4..10], [0.0, -1.0, 4.0, 4.0, 0.0, 0.0]);
        assert_eq!(composed[10..], [1.0, 1.0, 4.0 / 9.0, 0.0]);
        // There is no history after the hand has closed again, of another grasp, and of a source that began anew.
        for (grasp, phase) in [((0, 7), Phase::Closing), ((0, 8), Phase::Settled), ((1, 7), Phase::Settled)] {
            let mut other = history.clone();
            other.add(grasp, phase, Ok(&[0.0, 0.0]), &SIGNALS);
            assert_eq!(of(&other, Phase::TestLifted, &[2.0, 4.0], &mut composed), missing);
        }
        // A frame without a feature leaves its fault behind, until the next one.
        for fault in [Fault::NoContact, Fault::OutOfDistribution] {
            history.add((0, 7), Phase::Squeezed, Err(fault), &SIGNALS);
            let state = serde_json::to_string(&history).expect("written");
            let restored = serde_json::from_str(&state).expect("read");
            assert_eq!(of(&restored, Phase::TestLifted, &[2.0, 4.0], &mut composed), Err(fault));
        }
        history.add((0, 7), Phase::Squeezed, Ok(&[2.0, 5.0]), &SIGNALS);
        assert_eq!(of(&history, Phase::TestLifted, &[2.0, 4.0], &mut composed), Ok(()));
    }
}
