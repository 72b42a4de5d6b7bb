//! From the engine's contact forces to the forces on cells: the same soft patches and cells as in the training
//! data (`grasp::soft_finger`, `grasp::tactile_sensor`), with the forces that really act.

use nalgebra::{Isometry3, Point3, UnitVector3, Vector3};

use super::engine::{Side, Touch};
use super::{LiftTarget, PhysicsOptions};
use crate::contact_points::{ContactPoint, OtherLink};
use crate::loaded_contacts::{LoadedPoint, SimulatedContact, press};
use crate::mechanism::Mechanism;

/// The patches of the forces on the hand. Touches of one link that lie near to each other are merged.
pub(super) fn patches(
    mut touches: Vec<Touch>,
    palm_from_target: &Isometry3<f64>,
    mechanism: &Mechanism<'_>,
    palm_from_links: &[Isometry3<f64>],
    target: &LiftTarget,
    options: &PhysicsOptions,
) -> Vec<SimulatedContact> {
    let mut pressed = Vec::new();
    touches.retain(|touch| touch.newtons >= LEAST_NEWTONS);
    touches.sort_by_key(sides);
    for group in touches.chunk_by(|a, b| sides(a) == sides(b)) {
        for merged in merge(group, options) {
            let other = match merged.side {
                Side::Hand { link_idx, shape_idx } => Some(OtherLink { link_idx, shape_idx }),
                Side::Target | Side::Stand => None,
            };
            pressed.push(LoadedPoint {
                point: ContactPoint {
                    link_idx: merged.link_idx,
                    shape_idx: merged.shape_idx,
                    other,
                    point_in_palm_m: merged.point_m,
                    object_normal_in_palm: merged.outward,
                    distance_m: 0.0,
                },
                load_newtons: merged.newtons,
                object: (merged.side == Side::Target).then_some(&target.object),
            });
        }
    }
    press(mechanism, palm_from_links, palm_from_target, &pressed, &options.soft_finger)
}

/// Link and other side of a touch.
fn sides(touch: &Touch) -> (usize, usize) {
    let other = match touch.side {
        Side::Target => 0,
        Side::Stand => 1,
        Side::Hand { link_idx, .. } => 2 + link_idx,
    };
    (touch.link_idx, other)
}

/// Weaker forces are ignored.
const LEAST_NEWTONS: f64 = 1e-3;

/// The strongest touches that are apart from each other, at most as many as a link may have; each weaker one is added
/// to the nearest of them.
fn merge(touches: &[Touch], options: &PhysicsOptions) -> Vec<Touch> {
    let mut by_strength: Vec<&Touch> = touches.iter().collect();
    by_strength.sort_by(|a, b| b.newtons.total_cmp(&a.newtons));
    let mut chosen: Vec<(Point3<f64>, Vec<&Touch>)> = Vec::new();
    for touch in by_strength {
        let far = |at: &Point3<f64>| (touch.point_m - at).norm();
        let nearest = (0..chosen.len()).min_by(|a, b| far(&chosen[*a].0).total_cmp(&far(&chosen[*b].0)));
        let is_full = chosen.len() >= options.contacts.contacts_per_link;
        match nearest {
            Some(idx) if is_full || far(&chosen[idx].0) < options.contacts.separation_m => chosen[idx].1.push(touch),
            _ => chosen.push((touch.point_m, vec![touch])),
        }
    }
    let mut merged = Vec::with_capacity(chosen.len());
    for (_, members) in chosen {
        let newtons: f64 = members.iter().map(|member| member.newtons).sum();
        let (mut point, mut outward) = (Vector3::zeros(), Vector3::zeros());
        for member in &members {
            point += member.point_m.coords * member.newtons;
            outward += member.outward.into_inner() * member.newtons;
        }
        merged.push(Touch {
            point_m: (point / newtons).into(),
            outward: UnitVector3::try_new(outward / newtons, 1e-6).unwrap_or(members[0].outward),
            newtons,
            ..*members[0]
        });
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_near_a_stronger_touch_is_one_with_it_and_no_force_is_lost() {
        let touch = |x_m: f64, newtons: f64| Touch {
            link_idx: 3,
            shape_idx: 1,
            side: Side::Target,
            point_m: Point3::new(x_m, 0.0, 0.0),
            outward: Vector3::z_axis(),
            newtons,
        };
        let options = PhysicsOptions::default();
        let apart_m = options.contacts.separation_m;
        let found = merge(&[touch(0.0, 1.0), touch(0.1 * apart_m, 3.0), touch(2.0 * apart_m, 2.0)], &options);
        let found: Vec<(f64, f64)> = found.iter().map(|touch| (touch.point_m.x / apart_m, touch.newtons)).collect();
        // (0 · 1 + 0.1 · 3) / 4.
        assert_eq!(found.len(), 2);
        assert!((found[0].0 - 0.075).abs() < 1e-12 && found[0].1 == 4.0 && found[1] == (2.0, 2.0), "{found:?}");

        let many: Vec<Touch> = (0..20).map(|idx| touch(f64::from(idx) * 3.0 * apart_m, 1.0 + f64::from(idx))).collect();
        let found = merge(&many, &options);
        assert_eq!(found.len(), options.contacts.contacts_per_link);
        let sum = |touches: &[Touch]| touches.iter().map(|touch| touch.newtons).sum::<f64>();
        assert!((sum(&found) - sum(&many)).abs() < 1e-9);
    }
}
