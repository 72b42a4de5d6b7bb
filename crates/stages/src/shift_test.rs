//! Notices that the readings of a robot have changed: another skin, another gain.
//!
//! Outcomes of lifts before such a change say little of the lifts after it. The test is conformal (Vovk, Gammerman and Shafer,
//! "Algorithmic Learning in a Random World", 2005, chapter 7). While grasps come in random order, each rank of a new grasp
//! among the earlier ones is as probable as any other. A gambler bets on extreme ranks, and the Shiryaev-Roberts statistic R
//! becomes (1 + R) times his gain; its mean after n grasps is n at most. So the mean number of grasps until a false alarm is
//! [`NOTICED_FROM`] at least, whatever the readings are like. Grasps of one object after another are not in random order.
//!
//! Pure: no clock, no input or output. [`ShiftTest`] is the state.

use serde::{Deserialize, Serialize};

use crate::encoder::FeatureExtractor;
use crate::probe::pads;

/// The evidence from which a change is noticed: the least mean number of grasps between two false alarms.
const NOTICED_FROM: f64 = 1000.0;
/// Grasps that new ones are compared with. Later ones are not added.
const MOST_GRASPS: usize = 200;
/// The gambler's gain at the rank p is this exponent times p to the exponent less 1: its mean over all ranks is 1.
const EXPONENT: f64 = 0.35;

const N_NUMBERS: usize = 3;

/// The numbers of a settled grasp that the test compares. They are the logarithm of the load of all pads, the number of contacts
/// of a pad that touches, and the logarithm of the load of a contact.
pub(crate) type Numbers = [f32; N_NUMBERS];

/// The numbers of a grasp; `None` if the feature does not have them, or nothing is touched.
pub(crate) fn numbers(features: &FeatureExtractor, values: &[f64]) -> Option<Numbers> {
    let (mut load, mut n_contacts, mut n_pads) = (0.0, 0.0, 0.0);
    for pad in pads(features, values)?.filter(|pad| pad[0] > 0.0) {
        load += pad[0];
        n_contacts += pad[1];
        n_pads += 1.0;
    }
    (load > 0.0)
        .then(|| [libm::log(load), n_contacts / n_pads, libm::log(load / n_contacts)].map(|number| number as f32))
}

/// The grasps so far, and the evidence for a change.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ShiftTest {
    grasps: Vec<Numbers>,
    /// For each number, that it fell and that it rose.
    evidence: [[f64; 2]; N_NUMBERS],
}

impl ShiftTest {
    /// Takes a grasp, and says whether a change is noticed: then it begins anew, with this grasp.
    pub(crate) fn observe(&mut self, grasp: Numbers) -> bool {
        for (idx, evidence) in self.evidence.iter_mut().enumerate() {
            let earlier = || self.grasps.iter().map(|grasp| grasp[idx]);
            let n_below = earlier().filter(|number| *number < grasp[idx]).count() as f64;
            let n_equal = earlier().filter(|number| *number == grasp[idx]).count() as f64;
            // The ranks that it may have, as parts of all.
            let n = self.grasps.len() as f64 + 1.0;
            let (from, to) = (n_below / n, (n_below + n_equal + 1.0) / n);
            let gain = |from: f64, to: f64| (libm::pow(to, EXPONENT) - libm::pow(from, EXPONENT)) / (to - from);
            evidence[0] = (1.0 + evidence[0]) * gain(from, to);
            evidence[1] = (1.0 + evidence[1]) * gain(1.0 - to, 1.0 - from);
        }
        let mean = self.evidence.iter().flatten().sum::<f64>() / (2 * N_NUMBERS) as f64;
        let is_noticed = mean >= NOTICED_FROM;
        if is_noticed {
            *self = ShiftTest::default();
        }
        if self.grasps.len() < MOST_GRASPS {
            self.grasps.push(grasp);
        }
        is_noticed
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A grasp whose numbers vary by about 0.3, as a skin's do.
    fn grasp(random: &mut ChaCha8Rng, shift: f32) -> Numbers {
        let mut normal = || (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0;
        [0.6 * normal(), (8.0 + 1.8 * normal()).round(), 0.3 * normal() + shift]
    }

    #[test]
    fn a_skin_that_reads_half_is_noticed_within_20_grasps() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut n_late = 0;
        for _ in 0..40 {
            let mut test = ShiftTest::default();
            let is_false = (0..60).any(|_| test.observe(grasp(&mut random, 0.0)));
            let is_noticed = (0..20).any(|_| test.observe(grasp(&mut random, 0.5_f32.ln())));
            n_late += i32::from(is_false || !is_noticed);
        }
        assert!(n_late <= 2, "{n_late}");
    }

    #[test]
    fn a_false_alarm_comes_after_a_thousand_grasps_or_more() {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        let mut test = ShiftTest::default();
        let n_alarms: i32 = (0..40_000).map(|_| i32::from(test.observe(grasp(&mut random, 0.0)))).sum();
        assert!(n_alarms <= 40, "{n_alarms}");
    }

    #[test]
    fn grasps_that_are_all_alike_say_nothing() {
        let mut test = ShiftTest::default();
        // The evidence is the number of grasps then.
        assert!(!(1..NOTICED_FROM as u32).any(|_| test.observe([1.0, 2.0, 3.0])));
    }
}
