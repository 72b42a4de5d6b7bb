//! Over what distances experience should count as alike, and what advice is then worth: each object's lifts judged by those of all other objects.
//!
//! `regrasp_scales EXPERIENCE.json [--scales]` leaves out one object after the other. From each of its grasps that did not hold, the
//! motion to each other grasp of it leads to a pose whose outcome is known: what the advisor says of that motion, from what was felt and the
//! other objects alone, is held against it. The advisor's own probabilities are no evidence of themselves; these outcomes are.
//!
//! * `AUC` - how often, of two motions from one grasp, it prefers the one that held (0.5: by chance).
//! * `chosen` - the share of its first choices among these motions that held; `any` - the same of all of them.
//! * `log loss` - of its probabilities; `of share` - of the object's chance as it says, without the motion.
//! * `led to` - where the first proposal of [`Advisor::advise`] leads: the outcomes of the object's own grasps, by nearness; `of`: from how
//!   many grasps there was one near.
//!
//! With `--scales` it does so for other scales around the defaults as well, one at a time.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::bail;
use blindgrasp_stages::regrasp::{Advisor, AdvisorOptions, Experience};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

/// What motions between grasps of a left-out object came to.
#[derive(Default)]
struct Sums {
    n_pairs: f64,
    n_right: f64,
    n_from: f64,
    chosen: f64,
    any: f64,
    n_motions: f64,
    log_loss: f64,
    log_loss_of_share: f64,
    n_led: f64,
    led_to: f64,
    led_by_chance: f64,
    n_advised: f64,
    n_proposals: f64,
    advising: Duration,
}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (path, is_search) = match &arguments[..] {
        [path] => (path, false),
        [path, flag] if flag == "--scales" => (path, true),
        _ => bail!("expected EXPERIENCE.json [--scales]"),
    };
    let experience = Experience::load(Path::new(path))?;
    println!(
        "{} grasps of {} objects, {:.1} % held",
        experience.grasps.len(),
        experience.objects.len(),
        100.0 * experience.share_held()
    );
    let default = AdvisorOptions::default();
    show("default", &experience, default);
    if !is_search {
        return Ok(());
    }
    for feature_scale in [1.5, 4.0] {
        show(&format!("feature_scale {feature_scale}"), &experience, AdvisorOptions { feature_scale, ..default });
    }
    for n_hypotheses in [8, 16, 64] {
        show(&format!("n_hypotheses {n_hypotheses}"), &experience, AdvisorOptions { n_hypotheses, ..default });
    }
    for position_scale_m in [0.015, 0.02, 0.045] {
        show(
            &format!("position_scale_m {position_scale_m}"),
            &experience,
            AdvisorOptions { position_scale_m, ..default },
        );
    }
    for direction_scale in [0.3, 0.45, 0.9] {
        show(&format!("direction_scale {direction_scale}"), &experience, AdvisorOptions { direction_scale, ..default });
    }
    for preshape_scale_rad in [0.2, 0.8] {
        let options = AdvisorOptions { preshape_scale_rad, ..default };
        show(&format!("preshape_scale_rad {preshape_scale_rad}"), &experience, options);
    }
    for own_object_weight in [1.0, 10.0, 100.0] {
        let options = AdvisorOptions { own_object_weight, ..default };
        show(&format!("own_object_weight {own_object_weight}"), &experience, options);
    }
    for n_prior in [1.0, 10.0, 30.0] {
        show(&format!("n_prior {n_prior}"), &experience, AdvisorOptions { n_prior, ..default });
    }
    Ok(())
}

fn show(name: &str, experience: &Experience, options: AdvisorOptions) {
    let sums = (0..experience.objects.len())
        .into_par_iter()
        .map(|object_idx| left_out(experience, object_idx, options))
        .reduce(Sums::default, |one, other| one.plus(&other));
    println!(
        "{name:26} AUC {:.3}  chosen {:.3}  any {:.3}  ({} grasps)  log loss {:.4} of share {:.4}  led to {:.3} by chance {:.3} of {}  \
         {:.1} proposals, {:.2} ms",
        sums.n_right / sums.n_pairs,
        sums.chosen / sums.n_from,
        sums.any / sums.n_from,
        sums.n_from,
        sums.log_loss / sums.n_motions,
        sums.log_loss_of_share / sums.n_motions,
        sums.led_to / sums.n_led,
        sums.led_by_chance / sums.n_led,
        sums.n_led,
        sums.n_proposals / sums.n_advised,
        1e3 * sums.advising.as_secs_f64() / sums.n_advised,
    );
}

/// The object's grasps that did not hold, judged by all other objects.
fn left_out(experience: &Experience, object_idx: usize, options: AdvisorOptions) -> Sums {
    let mut sums = Sums::default();
    let mut others = experience.clone();
    others.grasps.retain(|grasp| grasp.object_idx != object_idx);
    let own: Vec<_> = experience.grasps.iter().filter(|grasp| grasp.object_idx == object_idx).collect();
    if own.len() < 3 || others.grasps.is_empty() {
        return sums;
    }
    let advisor = Advisor::new(others, options);
    let deviations = |feature: &[i8]| -> Vec<f64> {
        let scaling = &experience.scaling;
        let value = |((code, mean), per): ((&i8, &f64), &f64)| match per {
            0.0 => *mean,
            per => mean + f64::from(*code) / 16.0 / per,
        };
        feature.iter().zip(&scaling.mean).zip(&scaling.per_deviation).map(value).collect()
    };
    for (from_idx, from) in own.iter().enumerate().filter(|(_, grasp)| !grasp.held) {
        let hypotheses = advisor.hypotheses(&from.feature);
        let chance = advisor.chance_held(&hypotheses);
        let mut judged: Vec<(f64, bool)> = Vec::new();
        for (_, to) in own.iter().enumerate().filter(|(to_idx, _)| *to_idx != from_idx) {
            let palm_from_next = from.palm_from_object * to.palm_from_object.inverse();
            let probability = advisor.probability_held(&hypotheses, &palm_from_next, &to.open_joints_rad);
            judged.push((probability, to.held));
            let loss = |probability: f64| -(if to.held { probability } else { 1.0 - probability }).ln();
            sums.n_motions += 1.0;
            sums.log_loss += loss(probability);
            sums.log_loss_of_share += loss(chance);
        }
        for (better, _) in judged.iter().filter(|(_, held)| *held) {
            for (worse, _) in judged.iter().filter(|(_, held)| !held) {
                sums.n_pairs += 1.0;
                sums.n_right += if better > worse {
                    1.0
                } else if better == worse {
                    0.5
                } else {
                    0.0
                };
            }
        }
        let share = judged.iter().filter(|(_, held)| *held).count() as f64 / judged.len() as f64;
        sums.n_from += 1.0;
        sums.any += share;
        let chosen = judged.iter().max_by(|one, other| one.0.total_cmp(&other.0));
        sums.chosen += f64::from(u8::from(chosen.is_some_and(|(_, held)| *held)));
        let begun = Instant::now();
        let advice = advisor.advise(&deviations(&from.feature));
        sums.advising += begun.elapsed();
        sums.n_advised += 1.0;
        sums.n_proposals += advice.len() as f64;
        let Some(best) = advice.first() else { continue };
        let palm_from_next = Isometry3::from_parts(
            Translation3::from(Vector3::from(best.palm_position_m)),
            UnitQuaternion::from_quaternion(Quaternion::from(best.palm_rotation_xyzw)),
        );
        let next_from_object = palm_from_next.inverse() * from.palm_from_object;
        let (mut near, mut held) = (0.0, 0.0);
        for to in own.iter().enumerate().filter(|(to_idx, _)| *to_idx != from_idx).map(|(_, to)| to) {
            let centre = (next_from_object.translation.vector - to.palm_from_object.translation.vector).norm();
            let up = (next_from_object.rotation * Vector3::z() - to.palm_from_object.rotation * Vector3::z()).norm();
            let preshape =
                experience.preshape_rad(&best.open_joints_rad).zip(experience.preshape_rad(&to.open_joints_rad));
            let preshape: f64 = preshape.map(|(one, other)| ((one - other) / 0.5).powi(2)).sum();
            let squared = (centre / 0.025).powi(2) + (up / 0.5).powi(2) + preshape;
            let kernel = (1.0 - squared / 8.0).max(0.0).powi(4);
            near += kernel;
            held += kernel * f64::from(u8::from(to.held));
        }
        // Fewer would say more of one grasp that happens to lie there than of where the advice leads.
        if near > 0.2 {
            sums.n_led += 1.0;
            sums.led_to += held / near;
            sums.led_by_chance += share;
        }
    }
    sums
}

impl Sums {
    fn plus(self, other: &Sums) -> Sums {
        Sums {
            n_pairs: self.n_pairs + other.n_pairs,
            n_right: self.n_right + other.n_right,
            n_from: self.n_from + other.n_from,
            chosen: self.chosen + other.chosen,
            any: self.any + other.any,
            n_motions: self.n_motions + other.n_motions,
            log_loss: self.log_loss + other.log_loss,
            log_loss_of_share: self.log_loss_of_share + other.log_loss_of_share,
            n_led: self.n_led + other.n_led,
            led_to: self.led_to + other.led_to,
            led_by_chance: self.led_by_chance + other.led_by_chance,
            n_advised: self.n_advised + other.n_advised,
            n_proposals: self.n_proposals + other.n_proposals,
            advising: self.advising + other.advising,
        }
    }
}
