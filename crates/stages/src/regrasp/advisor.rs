//! A one-step policy from experience: from the feature of a grasp to the pose of the next one.
//!
//! 1. The grasps with the most similar features are hypotheses: of the object's identity and of its pose in the hand.
//! 2. From each hypothesis a motion leads to each grasp that held on its object. These motions are the candidates.
//! 3. The value of a candidate is the share of grasps that held around the pose that the motion would lead to, over all
//!    hypotheses. Grasps of the hypothesis' own object count more than those of others. Where there are neither, the
//!    object's share counts.

use nalgebra::Isometry3;

use crate::regrasp::experience::{Experience, LiftedGrasp};
use crate::regrasp::pose_field::{PoseField, PoseScales};
use blindgrasp_messages::{MAX_PROPOSALS, RegraspProposal};

/// Greatest number of motions from one hypothesis. They lead to the grasps of its object around which most grasps held.
const MOST_MOTIONS: usize = 6;
/// All candidates are judged by this many most probable hypotheses first, and the best candidates then by all.
const N_FIRST_HYPOTHESES: usize = 4;

/// Distances within which experience is similar. The defaults were chosen by `examples/regrasp_scales.rs`, which
/// predicts each object's lifts from all other objects' (docs/regrasp.md).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdvisorOptions {
    /// Number of hypotheses: the grasps with the most similar features.
    pub n_hypotheses: usize,
    /// Scale of the distance of features, in standard deviations. A hypothesis has the weight exp(-d²/2) of its
    /// distance beyond the nearest one.
    pub feature_scale: f64,
    /// Scale of the distance of an object's centre of mass in the palm frame, metres.
    pub position_scale_m: f64,
    /// Scale of the difference of the object's z axis: the length of the difference of the unit vectors.
    pub direction_scale: f64,
    /// Scale of the difference of preshape joints, radians.
    pub preshape_scale_rad: f64,
    /// Weight of a grasp of the hypothesis' own object; a grasp of another object has the weight 1.
    pub own_object_weight: f64,
    /// Weight of the object's own share, in grasps, beside the grasps around a pose.
    pub n_prior: f64,
}

impl Default for AdvisorOptions {
    fn default() -> Self {
        AdvisorOptions {
            n_hypotheses: 32,
            feature_scale: 2.5,
            position_scale_m: 0.02,
            direction_scale: 0.4,
            preshape_scale_rad: 0.4,
            own_object_weight: 5.0,
            n_prior: 2.0,
        }
    }
}

/// Similar grasps of experience, each with its probability; the probabilities sum to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Hypotheses(Vec<(usize, f64)>);

/// Experience, prepared so that advice takes milliseconds.
#[derive(Debug, Clone)]
pub struct Advisor {
    experience: Experience,
    options: AdvisorOptions,
    scales: PoseScales,
    field: PoseField,
    objects: Vec<KnownObject>,
}

/// The experience with one object.
#[derive(Debug, Clone)]
struct KnownObject {
    field: PoseField,
    /// Share of its grasps that held, drawn towards the share of all objects.
    share_held: f64,
    /// The grasps to which motions lead, the best first.
    held_idxs: Vec<usize>,
}

struct Candidate {
    palm_from_next: Isometry3<f64>,
    grasp_idx: usize,
    probability_held: f64,
}

impl Advisor {
    /// Prepares experience.
    pub fn new(experience: Experience, options: AdvisorOptions) -> Advisor {
        let scales = PoseScales {
            position_m: options.position_scale_m,
            direction: options.direction_scale,
            preshape_rad: options.preshape_scale_rad,
        };
        let pose = |grasp: &LiftedGrasp| {
            (scales.scaled(&grasp.palm_from_object, experience.preshape_rad(&grasp.open_joints_rad)), grasp.held)
        };
        let mut of_objects: Vec<Vec<usize>> = vec![Vec::new(); experience.objects.len()];
        for (grasp_idx, grasp) in experience.grasps.iter().enumerate() {
            if let Some(of_object) = of_objects.get_mut(grasp.object_idx) {
                of_object.push(grasp_idx);
            }
        }
        let share_of_all = experience.share_held();
        let known = |idxs: Vec<usize>| {
            let grasps = || idxs.iter().map(|idx| &experience.grasps[*idx]);
            let field = PoseField::new(grasps().map(pose).collect());
            let n_held = grasps().filter(|grasp| grasp.held).count() as f64;
            let share_held = (options.n_prior * share_of_all + n_held) / (options.n_prior + idxs.len() as f64);
            let mut held: Vec<(f64, usize)> = idxs
                .iter()
                .filter(|idx| experience.grasps[**idx].held)
                .map(|idx| {
                    let around = field.around(&pose(&experience.grasps[*idx]).0);
                    ((around.held + share_held) / (around.weight + 1.0), *idx)
                })
                .collect();
            held.sort_by(|one, other| other.0.total_cmp(&one.0).then(one.1.cmp(&other.1)));
            held.truncate(MOST_MOTIONS + 1);
            KnownObject { field, share_held, held_idxs: held.into_iter().map(|(_, idx)| idx).collect() }
        };
        let field = PoseField::new(experience.grasps.iter().map(pose).collect());
        let objects = of_objects.into_iter().map(known).collect();
        Advisor { options, scales, field, objects, experience }
    }

    pub fn experience(&self) -> &Experience {
        &self.experience
    }

    /// Proposes the next grasp from the settled feature of a grasp, encoded by the experience's model: the best first,
    /// at most [`MAX_PROPOSALS`], and only those better than a random grasp of such objects.
    pub fn advise(&self, values: &[f64]) -> Vec<RegraspProposal> {
        if values.len() != self.experience.scaling.mean.len() {
            return Vec::new();
        }
        let hypotheses = self.hypotheses(&self.experience.code(values));
        let mut candidates = self.candidates(&hypotheses);
        // All candidates by the most probable hypotheses, then the best ones by all.
        let first = hypotheses.first(N_FIRST_HYPOTHESES);
        self.judge(&mut candidates, &first);
        let mut candidates = self.thinned(candidates);
        self.judge(&mut candidates, &hypotheses);
        let least = self.chance_held(&hypotheses);
        candidates.retain(|candidate| candidate.probability_held > least);
        candidates.iter().map(|candidate| self.proposal(candidate)).collect()
    }

    /// The hypotheses for a feature in the steps of [`Experience::code`].
    pub fn hypotheses(&self, feature: &[i8]) -> Hypotheses {
        let mut nearest: Vec<(f64, usize)> = self
            .experience
            .grasps
            .iter()
            .enumerate()
            .map(|(idx, grasp)| (Experience::distance_squared(feature, &grasp.feature), idx))
            .collect();
        let by_distance =
            |one: &(f64, usize), other: &(f64, usize)| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1));
        let n_kept = self.options.n_hypotheses.min(nearest.len());
        if n_kept > 0 {
            nearest.select_nth_unstable_by(n_kept - 1, by_distance);
        }
        nearest.truncate(n_kept);
        nearest.sort_by(by_distance);
        let least = nearest.first().map_or(0.0, |(squared, _)| *squared);
        let weight = |squared: f64| (-(squared - least) / (2.0 * self.options.feature_scale.powi(2))).exp();
        Hypotheses(nearest.into_iter().map(|(squared, idx)| (idx, weight(squared))).collect()).normalised()
    }

    /// Probability that the grasp at `palm_from_next` from the current one holds, over all `hypotheses`.
    pub fn probability_held(
        &self,
        hypotheses: &Hypotheses,
        palm_from_next: &Isometry3<f64>,
        open_joints_rad: &[f64],
    ) -> f64 {
        let next_from_palm = palm_from_next.inverse();
        let of_one = |(grasp_idx, weight): &(usize, f64)| {
            let grasp = &self.experience.grasps[*grasp_idx];
            let object = &self.objects[grasp.object_idx];
            let preshape_rad = self.experience.preshape_rad(open_joints_rad);
            let pose = self.scales.scaled(&(next_from_palm * grasp.palm_from_object), preshape_rad);
            let (of_all, of_own) = (self.field.around(&pose), object.field.around(&pose));
            // Its own object's grasps are among all.
            let extra = self.options.own_object_weight - 1.0;
            let n_prior = self.options.n_prior;
            let held = n_prior * object.share_held + of_all.held + extra * of_own.held;
            weight * held / (n_prior + of_all.weight + extra * of_own.weight)
        };
        hypotheses.0.iter().map(of_one).sum()
    }

    /// Probability that a random grasp of objects like the hypotheses' holds.
    pub fn chance_held(&self, hypotheses: &Hypotheses) -> f64 {
        let share =
            |(idx, weight): &(usize, f64)| weight * self.objects[self.experience.grasps[*idx].object_idx].share_held;
        hypotheses.0.iter().map(share).sum()
    }

    /// The motions from each hypothesis to grasps that held on its object.
    fn candidates(&self, hypotheses: &Hypotheses) -> Vec<Candidate> {
        let motions = |&(from_idx, _): &(usize, f64)| {
            let from = &self.experience.grasps[from_idx];
            let others = self.objects[from.object_idx].held_idxs.iter().copied().filter(move |idx| *idx != from_idx);
            others.take(MOST_MOTIONS).map(move |grasp_idx| Candidate {
                palm_from_next: from.palm_from_object * self.experience.grasps[grasp_idx].palm_from_object.inverse(),
                grasp_idx,
                probability_held: 0.0,
            })
        };
        hypotheses.0.iter().flat_map(motions).collect()
    }

    /// Sets the probability of each and sorts by it, the best first.
    fn judge(&self, candidates: &mut [Candidate], hypotheses: &Hypotheses) {
        for candidate in candidates.iter_mut() {
            let open_joints_rad = &self.experience.grasps[candidate.grasp_idx].open_joints_rad;
            candidate.probability_held = self.probability_held(hypotheses, &candidate.palm_from_next, open_joints_rad);
        }
        candidates.sort_by(|one, other| other.probability_held.total_cmp(&one.probability_held));
    }

    /// The best ones, without those that are similar to a better one.
    fn thinned(&self, candidates: Vec<Candidate>) -> Vec<Candidate> {
        let mut kept: Vec<Candidate> = Vec::new();
        for candidate in candidates {
            if kept.len() == MAX_PROPOSALS {
                break;
            }
            if !kept.iter().any(|better| self.are_alike(better, &candidate)) {
                kept.push(candidate);
            }
        }
        kept
    }

    /// Within half of all scales of each other.
    fn are_alike(&self, one: &Candidate, other: &Candidate) -> bool {
        let between = one.palm_from_next.inv_mul(&other.palm_from_next);
        let joints = |candidate: &Candidate| {
            let grasp = &self.experience.grasps[candidate.grasp_idx];
            self.experience.preshape_rad(&grasp.open_joints_rad).collect::<Vec<f64>>()
        };
        between.translation.vector.norm() < 0.5 * self.options.position_scale_m
            && between.rotation.angle() < 0.5 * self.options.direction_scale
            && joints(one)
                .iter()
                .zip(joints(other))
                .all(|(one, other)| (one - other).abs() < 0.5 * self.options.preshape_scale_rad)
    }

    fn proposal(&self, candidate: &Candidate) -> RegraspProposal {
        RegraspProposal {
            palm_position_m: candidate.palm_from_next.translation.vector.into(),
            palm_rotation_xyzw: candidate.palm_from_next.rotation.coords.into(),
            open_joints_rad: self.experience.grasps[candidate.grasp_idx].open_joints_rad.clone(),
            // A mean of shares, which rounding may put above 1.
            probability_held: candidate.probability_held.min(1.0),
        }
    }
}

impl Hypotheses {
    /// The first ones: the most probable.
    fn first(&self, n: usize) -> Hypotheses {
        Hypotheses(self.0.iter().take(n).copied().collect()).normalised()
    }

    fn normalised(mut self) -> Hypotheses {
        let sum: f64 = self.0.iter().map(|(_, weight)| weight).sum();
        self.0.iter_mut().for_each(|(_, weight)| *weight /= sum);
        self
    }
}

#[cfg(test)]
pub(super) mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::regrasp::experience::tests::{experience, grasp};

    /// Two objects that feel different. The ball holds only where its middle is before the palm, at x = 0, and so does
    /// the box at x = 50 mm.
    pub(in super::super) fn two_objects() -> Experience {
        let ball = [-0.04, -0.02, 0.0, 0.02, 0.04].map(|x_m| grasp(0, x_m == 0.0, x_m, [(x_m * 800.0) as i8, 0]));
        let of_box = [0.01, 0.03, 0.05, 0.07].map(|x_m| grasp(1, x_m == 0.05, x_m, [(x_m * 800.0) as i8, 100]));
        experience(ball.into_iter().chain(of_box).collect())
    }

    pub(in super::super) fn options() -> AdvisorOptions {
        AdvisorOptions { position_scale_m: 0.01, feature_scale: 0.5, ..AdvisorOptions::default() }
    }

    #[test]
    fn advice_leads_to_where_objects_that_feel_so_were_held() {
        let advisor = Advisor::new(two_objects(), options());
        // As the ball at x = -20 mm feels: the palm has to go there, so that it is at 0.
        let values = |codes: [f64; 2]| [1.0 + codes[0] / 32.0, codes[1] / 16.0];
        let advice = advisor.advise(&values([-16.0, 0.0]));
        let best = &advice[0];
        assert!((best.palm_position_m[0] + 0.02).abs() < 1e-9, "{best:?}");
        assert_eq!((best.palm_rotation_xyzw, &best.open_joints_rad), ([0.0, 0.0, 0.0, 1.0], &vec![0.5, 0.0]));
        assert!(best.probability_held > 0.5 && best.probability_held < 1.0, "{best:?}");
        assert!(advice.windows(2).all(|pair| pair[0].probability_held >= pair[1].probability_held));
        // As the box at x = 70 mm.
        let best = &advisor.advise(&values([56.0, 100.0]))[0];
        assert!((best.palm_position_m[0] - 0.02).abs() < 1e-9, "{best:?}");
        // Of another model's length.
        assert!(advisor.advise(&[0.0; 3]).is_empty());
    }

    #[test]
    fn nothing_is_proposed_where_nothing_ever_held() {
        let mut grim = two_objects();
        grim.grasps.iter_mut().for_each(|grasp| grasp.held = false);
        assert!(Advisor::new(grim, options()).advise(&[1.0, 0.0]).is_empty());
    }

    #[test]
    fn hypotheses_are_what_felt_alike() {
        let advisor = Advisor::new(two_objects(), AdvisorOptions { n_hypotheses: 2, ..options() });
        let Hypotheses(found) = advisor.hypotheses(&[-16, 0]);
        assert_eq!(found.iter().map(|(idx, _)| *idx).collect::<Vec<_>>(), [1, 0]);
        // The other is 16 steps away: a deviation.
        let expected = 1.0 / (1.0 + (-0.5_f64 / 0.25).exp());
        assert!((found[0].1 - expected).abs() < 1e-12 && (found[0].1 + found[1].1 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn turning_hand_and_world_together_changes_nothing() {
        let advisor = Advisor::new(two_objects(), options());
        // What is proposed is where the object comes to be: the same if all poses in the experience are said from
        // another frame of the object.
        let mut turned = two_objects();
        for grasp in &mut turned.grasps {
            grasp.palm_from_object *= Isometry3::rotation(Vector3::z() * 0.7);
        }
        let other = Advisor::new(turned, options());
        let (found, expected) = (other.advise(&[0.5, 0.0]), advisor.advise(&[0.5, 0.0]));
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found.probability_held - expected.probability_held).abs() < 1e-5, "{found:?} {expected:?}");
            assert!((found.palm_position_m[0] - expected.palm_position_m[0]).abs() < 1e-9);
        }
    }

    #[test]
    fn proposals_are_few_and_unlike_each_other() {
        // Hundreds of grasps that held within millimetres.
        let many = (0..300).map(|idx| grasp(0, idx % 4 > 0, 1e-4 * f64::from(idx % 100), [idx as i8, 0]));
        let advisor = Advisor::new(experience(many.collect()), options());
        let advice = advisor.advise(&[1.0, 0.0]);
        assert!(advice.len() <= MAX_PROPOSALS);
        for (idx, one) in advice.iter().enumerate() {
            for other in &advice[..idx] {
                assert!((one.palm_position_m[0] - other.palm_position_m[0]).abs() >= 0.005, "{one:?} {other:?}");
            }
        }
    }
}
