//! A world for one attempt, in the frame of the palm: the engine's sets, the stand, the target, and the forces between.
//!
//! The palm stands still and everything else moves: a frame that moves without turning differs from one at rest by its
//! acceleration only, which is taken off gravity. So the arm needs no motors, and lifting is the stand going away.

use nalgebra::{Isometry3, Point3, UnitVector3, Vector3};
use rapier3d_f64::dynamics::{RigidBodyBuilder, RigidBodyHandle};
use rapier3d_f64::geometry::{
    ColliderBuilder, ColliderHandle, ContactPair, Group, InteractionGroups, InteractionTestMode, NEW_CONTACT_BIT,
};
use rapier3d_f64::math::{Pose, Vector};
use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::parry::shape::SharedShape;
use rapier3d_f64::pipeline::PhysicsWorld;
use rapier3d_f64::prelude::CoefficientCombineRule;

use super::hand_body::ShapeCollider;
use super::{LiftTarget, PhysicsOptions};
use blindgrasp_stages::hand::pose_from_isometry;

/// Groups of colliders, as bits.
/// Each link of the hand has a group of its own among the first; the last four are for other things.
pub(super) const MAX_LINKS_WITH_SHAPES: u32 = 28;
const HAND: Group = Group::from_bits_truncate((1 << MAX_LINKS_WITH_SHAPES) - 1);
const TARGET: Group = Group::GROUP_29;
const STAND: Group = Group::GROUP_30;
/// The target as the stand sees it: its convex hull, which rests without rattling.
const FOOT: Group = Group::GROUP_31;

/// m/s².
pub(super) const GRAVITY: f64 = 9.81;

/// The body that the hand touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Target,
    Stand,
    Hand { link_idx: usize, shape_idx: usize },
}

/// A force that presses on a link of the hand, in the palm frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Touch {
    pub(super) link_idx: usize,
    /// Index into the mechanism's shapes.
    pub(super) shape_idx: usize,
    pub(super) side: Side,
    /// The point on the surface of the touched body.
    pub(super) point_m: Point3<f64>,
    /// The normal out of the touched body.
    pub(super) outward: UnitVector3<f64>,
    /// The force at right angles to the surface.
    pub(super) newtons: f64,
}

/// The engine with a stand and a target.
pub(super) struct World {
    pub(super) engine: PhysicsWorld,
    pub(super) target: RigidBodyHandle,
    stand: RigidBodyHandle,
    /// The vertical, in the palm frame.
    up: Vector3<f64>,
}

impl World {
    /// Puts a target on the stand. `palm_from_world` is how the palm is placed at the beginning, `world_from_target`
    /// how the target stands.
    pub(super) fn new(
        target: &LiftTarget,
        world_from_target: &Isometry3<f64>,
        palm_from_world: &Isometry3<f64>,
        options: &PhysicsOptions,
    ) -> World {
        let mut engine = PhysicsWorld::new();
        let parameters = &mut engine.integration_parameters;
        parameters.dt = options.step_secs;
        parameters.length_unit = LENGTH_UNIT_M;
        parameters.num_solver_iterations = options.n_solver_iterations;
        parameters.contact_softness.natural_frequency = options.contact_hertz;
        parameters.contact_softness.damping_ratio = options.contact_damping_ratio;
        parameters.static_contact_softness = parameters.contact_softness;
        parameters.normalized_contact_recycle_distance = RECYCLE_M / LENGTH_UNIT_M;
        parameters.friction_model = rapier3d_f64::dynamics::FrictionModel::Coulomb;
        let up = palm_from_world.rotation * Vector3::z();
        engine.gravity = to_engine(&(up * -GRAVITY));

        let stand_pose = palm_from_world * world_from_stand(options);
        let (stand, _) = engine.insert(
            RigidBodyBuilder::kinematic_velocity_based().pose(pose_from_isometry(&stand_pose)),
            ColliderBuilder::new(stand_shape(options))
                .friction(options.stand_friction)
                .friction_combine_rule(CoefficientCombineRule::Min)
                .collision_groups(groups(STAND, HAND | FOOT)),
        );

        let object = &target.object;
        let palm_from_target = palm_from_world * world_from_target;
        // Colliders have no mass: the target's is its own, its inertia that of its hull about its centre of mass.
        let centre = Vector::new(object.centre_of_mass_m.x, object.centre_of_mass_m.y, object.centre_of_mass_m.z);
        let body = RigidBodyBuilder::dynamic()
            .pose(pose_from_isometry(&palm_from_target))
            .can_sleep(false)
            .additional_mass_properties(target.mass_properties(centre));
        let target_handle = engine.insert_body(body);
        let surface = |builder: ColliderBuilder| builder.density(0.0).friction(target.friction);
        engine.insert_collider(
            surface(ColliderBuilder::new(object.shape.clone())).collision_groups(groups(TARGET, HAND)),
            Some(target_handle),
        );
        engine.insert_collider(
            surface(ColliderBuilder::new(target.hull.clone()))
                .friction(1.0)
                .friction_combine_rule(CoefficientCombineRule::Min)
                .collision_groups(groups(FOOT, STAND)),
            Some(target_handle),
        );
        World { engine, target: target_handle, stand, up }
    }

    /// A collider of the hand, with its link's own group and those of the links that it may touch. Its friction is the
    /// target's alone.
    pub(super) fn hand_collider(
        shape: SharedShape,
        link_from_shape: &Isometry3<f64>,
        (own, touched): (Group, Group),
    ) -> ColliderBuilder {
        ColliderBuilder::new(shape)
            .position(pose_from_isometry(link_from_shape))
            .density(0.0)
            .friction(1.0)
            .friction_combine_rule(CoefficientCombineRule::Multiply)
            .collision_groups(groups(own, touched | TARGET | STAND))
    }

    /// Lets the palm move with `velocity` and `acceleration` in the world, both in the palm frame, for the next step.
    pub(super) fn set_palm_motion(&mut self, velocity: &Vector3<f64>, acceleration: &Vector3<f64>) {
        self.engine.gravity = to_engine(&(self.up * -GRAVITY - acceleration));
        if let Some(stand) = self.engine.bodies.get_mut(self.stand) {
            stand.set_linvel(to_engine(&-velocity), true);
        }
    }

    /// The stand and the target come towards the palm with `palm_velocity` from now on.
    pub(super) fn push_off(&mut self, palm_velocity: &Vector3<f64>) {
        self.set_palm_motion(palm_velocity, &Vector3::zeros());
        if let Some(target) = self.engine.bodies.get_mut(self.target) {
            target.set_linvel(to_engine(&-palm_velocity), true);
        }
    }

    /// The palm stops at once, and the target stays where it is.
    pub(super) fn stop_palm(&mut self, palm_velocity: &Vector3<f64>) {
        self.set_palm_motion(&Vector3::zeros(), &Vector3::zeros());
        if let Some(target) = self.engine.bodies.get_mut(self.target) {
            let linvel = target.linvel() + to_engine(palm_velocity);
            target.set_linvel(linvel, true);
        }
    }

    pub(super) fn step(&mut self) {
        self.engine.step();
    }

    pub(super) fn palm_from_target(&self) -> Isometry3<f64> {
        from_engine(self.engine.bodies[self.target].position())
    }

    /// The forces on the hand.
    pub(super) fn touches(&self, shapes: &[ShapeCollider]) -> Vec<Touch> {
        let of_hand = |collider: ColliderHandle| shapes.iter().find(|shape| shape.collider == collider);
        let mut touches = Vec::new();
        for pair in self.engine.narrow_phase.contact_pairs() {
            let sides = [pair.collider1, pair.collider2];
            for (idx, shape) in sides.iter().enumerate().filter_map(|(idx, side)| Some((idx, of_hand(*side)?))) {
                let other = sides[1 - idx];
                let side = match of_hand(other) {
                    Some(other) => Side::Hand { link_idx: other.link_idx, shape_idx: other.shape_idx },
                    None if self.engine.colliders[other].parent() == Some(self.target) => Side::Target,
                    None => Side::Stand,
                };
                for_each_force(&self.engine, pair, |points, normal, newtons| {
                    // The normal goes from the first to the second.
                    let outward = if idx == 0 { -normal } else { normal };
                    touches.push(Touch {
                        link_idx: shape.link_idx,
                        shape_idx: shape.shape_idx,
                        side,
                        point_m: points[1 - idx],
                        outward: UnitVector3::new_normalize(outward),
                        newtons,
                    });
                });
            }
        }
        touches
    }

    /// The force with which the stand carries the target, at right angles to it.
    pub(super) fn stand_newtons(&self) -> f64 {
        let mut sum = 0.0;
        self.for_each_stand_force(|_, _, newtons| sum += newtons);
        sum
    }

    pub(super) fn target_velocity(&self) -> Vector3<f64> {
        from_engine_vector(self.engine.bodies[self.target].linvel())
    }

    /// Force and torque about the palm's origin with which the target loads the wrist, in the palm frame, given the
    /// target's `acceleration` against the palm: its weight and inertia, less what the stand carries. The stand's
    /// friction and the target's turning are left out.
    pub(super) fn load_on_wrist(&self, mass_kg: f64, acceleration: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let body = &self.engine.bodies[self.target];
        let centre = from_engine_vector(body.center_of_mass());
        let mut force = (from_engine_vector(self.engine.gravity) - acceleration) * mass_kg;
        let mut torque = centre.cross(&force);
        self.for_each_stand_force(|point, onto_target, newtons| {
            let carried = onto_target * newtons;
            force += carried;
            torque += point.coords.cross(&carried);
        });
        (force, torque)
    }

    /// The forces of the stand on the target: a point, the direction, newtons.
    fn for_each_stand_force(&self, mut visit: impl FnMut(Point3<f64>, Vector3<f64>, f64)) {
        for &collider in self.engine.bodies[self.stand].colliders() {
            for pair in self.engine.narrow_phase.contact_pairs_with(collider) {
                let is_first = pair.collider1 == collider;
                let other = if is_first { pair.collider2 } else { pair.collider1 };
                if self.engine.colliders[other].parent() == Some(self.target) {
                    let sign = if is_first { 1.0 } else { -1.0 };
                    for_each_force(&self.engine, pair, |points, normal, newtons| {
                        visit(points[usize::from(is_first)], normal * sign, newtons);
                    });
                }
            }
        }
    }
}

/// The typical size of objects, with which the engine's tolerances scale.
const LENGTH_UNIT_M: f64 = 0.1;

/// Where bodies have moved less against each other than this since contacts were last looked for, the engine keeps them
/// and moves them along.
const RECYCLE_M: f64 = 1e-4;

/// A post, its axis along y as the engine has cylinders.
pub(super) fn stand_shape(options: &PhysicsOptions) -> SharedShape {
    SharedShape::cylinder(options.stand_height_m / 2.0, options.stand_radius_m)
}

/// Upright, its upper face at z = 0.
pub(super) fn world_from_stand(options: &PhysicsOptions) -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.0, 0.0, -options.stand_height_m / 2.0), Vector3::x() * std::f64::consts::FRAC_PI_2)
}

fn groups(member: Group, filter: Group) -> InteractionGroups {
    InteractionGroups::new(member, filter, InteractionTestMode::And)
}

/// The forces of a pair: where on either, the normal from the first to the second, newtons.
fn for_each_force(
    engine: &PhysicsWorld,
    pair: &ContactPair,
    mut visit: impl FnMut([Point3<f64>; 2], Vector3<f64>, f64),
) {
    for manifold in pair.solver_manifolds() {
        let normal = from_engine_vector(manifold.data.normal);
        for contact in &manifold.data.solver_contacts {
            let point_idx = (contact.contact_id[0] & !NEW_CONTACT_BIT) as usize;
            let Some(point) = manifold.points.get(point_idx).filter(|point| point.data.impulse > 0.0) else { continue };
            let (first, second) = manifold.data.solver_contact_world_points(contact, &engine.bodies);
            let points = [first, second].map(|point| Point3::from(from_engine_vector(point)));
            visit(points, normal, point.data.impulse / engine.integration_parameters.dt);
        }
    }
}

pub(super) fn to_engine(vector: &Vector3<f64>) -> Vector {
    Vector::new(vector.x, vector.y, vector.z)
}

pub(super) fn from_engine_vector(vector: Vector) -> Vector3<f64> {
    Vector3::new(vector.x, vector.y, vector.z)
}

pub(super) fn from_engine(pose: &Pose) -> Isometry3<f64> {
    let (t, q) = (pose.translation, pose.rotation);
    Isometry3::from_parts(
        Vector3::new(t.x, t.y, t.z).into(),
        nalgebra::UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(q.w, q.x, q.y, q.z)),
    )
}

impl LiftTarget {
    /// Mass, centre and inertia: the inertia that of the convex hull, scaled to the mass.
    fn mass_properties(&self, centre: Vector) -> MassProperties {
        let hull = self.hull.mass_properties(1.0);
        let inertia = hull.reconstruct_inertia_matrix() * (self.mass_kg / hull.mass());
        MassProperties::with_inertia_matrix(centre, self.mass_kg, inertia)
    }
}

#[cfg(test)]
mod tests {
    //! The engine against closed formulas.

    use rapier3d_f64::dynamics::LockedAxes;

    use super::*;
    use blindgrasp_objects::Object;

    const MASS_KG: f64 = 0.4;

    /// A cube of 60 mm: a box, or a mesh.
    #[derive(Debug, Clone, Copy)]
    enum Made {
        Box,
        Mesh,
    }

    fn cube(friction: f64, made: Made) -> LiftTarget {
        let solid = SharedShape::cuboid(0.03, 0.03, 0.03);
        let mut object = Object::new("cube".into(), "cube".into(), solid, 1000.0, false);
        if let Made::Mesh = made {
            let (vertices, indices) = object.shape.as_cuboid().expect("a box").to_trimesh();
            object.shape = SharedShape::trimesh(vertices, indices).expect("a mesh");
        }
        LiftTarget::new("cube".into(), "cube".into(), object, MASS_KG, friction)
    }

    fn standing(target: &LiftTarget, options: &PhysicsOptions) -> World {
        World::new(target, &Isometry3::translation(0.0, 0.0, 0.03), &Isometry3::identity(), options)
    }

    fn run(world: &mut World, secs: f64) {
        for _ in 0..(secs / world.engine.integration_parameters.dt).round() as usize {
            world.step();
        }
    }

    #[test]
    fn a_resting_target_weighs_what_it_weighs() {
        for step_secs in [0.005, 0.0025] {
            let options = PhysicsOptions { step_secs, ..PhysicsOptions::default() };
            let mut world = standing(&cube(1.0, Made::Box), &options);
            run(&mut world, 1.0);
            let weight_newtons = MASS_KG * GRAVITY;
            let found = world.stand_newtons();
            assert!((found / weight_newtons - 1.0).abs() < 0.01, "{found} N, expected {weight_newtons} N");
            assert!(world.palm_from_target().translation.vector.xy().norm() < 1e-4);
        }
    }

    #[test]
    fn a_block_on_an_incline_slips_beyond_the_angle_of_friction() {
        // Steeper, the cube stands on one edge, and creeps by 10 mm/s before it slides.
        for friction in [0.3_f64, 0.5] {
            let critical_rad = friction.atan();
            let slid_m = |slope_rad: f64| {
                let options = PhysicsOptions { stand_friction: friction, ..PhysicsOptions::default() };
                let mut world = standing(&cube(1.0, Made::Box), &options);
                run(&mut world, 0.2);
                // Tilted slowly, so that nothing swings.
                for part in 1..=100 {
                    let (sin, cos) = (slope_rad * f64::from(part) / 100.0).sin_cos();
                    world.engine.gravity = to_engine(&(Vector3::new(sin, 0.0, -cos) * GRAVITY));
                    run(&mut world, 0.005);
                }
                let begin = world.palm_from_target().translation.vector;
                run(&mut world, 0.3);
                (world.palm_from_target().translation.vector - begin).norm()
            };
            let (below, above) = (slid_m(critical_rad - 0.02), slid_m(critical_rad + 0.02));
            // 0.02 rad beyond it accelerates by g·0.02/cos(atan μ): 9 mm or more in 0.3 s.
            assert!(below < 3e-4 && above > 5e-3, "friction {friction}: {below} m and {above} m");
        }
    }

    /// The cube between two plates that press on it with a force each, nothing under it; how far it falls.
    fn fallen_m(friction: f64, newtons: f64, made: Made) -> f64 {
        let options = PhysicsOptions::default();
        let target = cube(friction, made);
        let mut world = World::new(&target, &Isometry3::translation(0.0, 0.0, 0.5), &Isometry3::identity(), &options);
        let plate = || {
            let groups = (Group::GROUP_1, Group::NONE);
            World::hand_collider(SharedShape::cuboid(0.005, 0.02, 0.02), &Isometry3::identity(), groups)
        };
        let at = |x: f64| pose_from_isometry(&Isometry3::translation(x, 0.0, 0.5));
        world.engine.insert(RigidBodyBuilder::fixed().pose(at(-0.035)), plate());
        let only_x = LockedAxes::ROTATION_LOCKED | LockedAxes::TRANSLATION_LOCKED_Y | LockedAxes::TRANSLATION_LOCKED_Z;
        let pushing = RigidBodyBuilder::dynamic().pose(at(0.035)).locked_axes(only_x).can_sleep(false);
        let (pushing, _) = world.engine.insert(pushing.additional_mass(0.2), plate());
        world.engine.bodies[pushing].add_force(to_engine(&Vector3::new(-newtons, 0.0, 0.0)), true);
        // Without gravity until the plates have closed.
        world.engine.gravity = to_engine(&Vector3::zeros());
        run(&mut world, 0.2);
        let begin = world.palm_from_target().translation.vector;
        for part in 1..=100 {
            world.engine.gravity = to_engine(&Vector3::new(0.0, 0.0, -GRAVITY * f64::from(part) / 100.0));
            run(&mut world, 0.005);
        }
        run(&mut world, 0.2);
        (world.palm_from_target().translation.vector - begin).norm()
    }

    #[test]
    fn a_pinched_block_falls_when_friction_cannot_carry_it() {
        for (friction, made) in [(0.4, Made::Box), (1.0, Made::Box), (0.4, Made::Mesh), (1.0, Made::Mesh)] {
            let critical_newtons = MASS_KG * GRAVITY / (2.0 * friction);
            let fallen_m = |part: f64| fallen_m(friction, part * critical_newtons, made);
            let (held_m, lost_m) = (fallen_m(1.1), fallen_m(0.9));
            assert!(held_m < 1e-3 && lost_m > 5e-3, "{made:?}, friction {friction}: {held_m} m and {lost_m} m");
        }
    }

    #[test]
    fn a_palm_that_falls_with_the_target_leaves_it_without_weight() {
        let mut world = standing(&cube(1.0, Made::Box), &PhysicsOptions::default());
        run(&mut world, 0.5);
        world.set_palm_motion(&Vector3::zeros(), &Vector3::new(0.0, 0.0, -GRAVITY));
        run(&mut world, 0.2);
        assert!(world.stand_newtons() < 0.01 * MASS_KG * GRAVITY, "{}", world.stand_newtons());
    }

    #[test]
    fn the_wrist_bears_what_the_stand_does_not() {
        let mut world = standing(&cube(1.0, Made::Box), &PhysicsOptions::default());
        run(&mut world, 0.5);
        let (force, _) = world.load_on_wrist(MASS_KG, &Vector3::zeros());
        assert!(force.norm() < 0.01 * MASS_KG * GRAVITY, "it stands: {force}");
        // The stand is taken away: all of the weight would hang on the hand, off its axis by where the cube is.
        world.set_palm_motion(&Vector3::new(0.0, 0.0, 1.0), &Vector3::zeros());
        run(&mut world, 0.05);
        let (force, torque) = world.load_on_wrist(MASS_KG, &Vector3::zeros());
        assert!((force + Vector3::new(0.0, 0.0, MASS_KG * GRAVITY)).norm() < 1e-9, "{force}");
        assert!(torque.norm() < 1e-3, "{torque}");
    }

    #[test]
    fn a_target_stays_where_it_stands_when_the_palm_stops() {
        let mut world = standing(&cube(1.0, Made::Box), &PhysicsOptions::default());
        let velocity = Vector3::new(0.0, 0.03, 0.0);
        run(&mut world, 0.2);
        world.push_off(&velocity);
        run(&mut world, 0.5);
        world.stop_palm(&velocity);
        let stopped = world.palm_from_target().translation.vector;
        assert!((stopped.y + 0.015).abs() < 5e-4, "{stopped}");
        run(&mut world, 0.3);
        assert!((world.palm_from_target().translation.vector - stopped).norm() < 1e-4);
    }
}
