//! A world for one attempt, in the frame of the palm: the engine's sets, the stand, the target, and the forces between.
//!
//! The palm stands still and everything else moves: a frame that moves without turning differs from one at rest by its
//! acceleration only, which is taken off gravity. So the arm needs no motors, and lifting is the stand going away.

use nalgebra::{Isometry3, Point3, UnitVector3, Vector3};
use rapier3d_f64::dynamics::{
    GenericJoint, JointAxis, MotorModel, MultibodyJointHandle, PrismaticJointBuilder, RevoluteJointBuilder,
    RigidBodyBuilder, RigidBodyHandle,
};
use rapier3d_f64::geometry::{
    ColliderBuilder, ColliderHandle, ContactPair, Group, InteractionGroups, InteractionTestMode, NEW_CONTACT_BIT,
};
use rapier3d_f64::math::{Pose, Vector};
use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::parry::shape::{Shape, SharedShape};
use rapier3d_f64::pipeline::PhysicsWorld;
use rapier3d_f64::prelude::CoefficientCombineRule;

use super::engine::{AxleCommand, Engine, GRAVITY, HandPlan, Side, StandForce, Touch};
use super::{LiftTarget, PhysicsOptions, TrialError};
use blindgrasp_stages::hand::{JointKind, pose_from_isometry};

/// Groups of colliders, as bits.
/// Each link of the hand has a group of its own among the first; the last four are for other things.
pub(super) const MAX_LINKS_APART: u32 = 28;
const HAND: Group = Group::from_bits_truncate((1 << MAX_LINKS_APART) - 1);
const TARGET: Group = Group::GROUP_29;
const STAND: Group = Group::GROUP_30;
/// The target as the stand sees it: its convex hull, which rests without rattling.
const FOOT: Group = Group::GROUP_31;

/// The engine with a stand and a target.
pub(super) struct World {
    pub(super) engine: PhysicsWorld,
    pub(super) target: RigidBodyHandle,
    stand: RigidBodyHandle,
    /// The vertical, in the palm frame.
    up: Vector3<f64>,
    shapes: Vec<ShapeCollider>,
    axles: Vec<(MultibodyJointHandle, JointKind)>,
}

/// A collider and its shape of the hand.
#[derive(Debug, Clone, Copy)]
struct ShapeCollider {
    collider: ColliderHandle,
    /// Index into the mechanism's shapes.
    shape_idx: usize,
    link_idx: usize,
}

impl World {
    /// Puts a target on the stand, and a hand before it. `palm_from_world` is how the palm is placed at the beginning,
    /// `world_from_target` how the target stands.
    ///
    /// # Errors
    /// The name of a link whose joint cannot be made.
    pub(super) fn new(
        target: &LiftTarget,
        world_from_target: &Isometry3<f64>,
        palm_from_world: &Isometry3<f64>,
        hand: &HandPlan,
        options: &PhysicsOptions,
    ) -> Result<World, TrialError> {
        let mut engine = empty_world(options);
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

        let ground = Isometry3::translation(0.0, -options.stand_height_m / 2.0 - GROUND_HALF_M, 0.0);
        engine.insert_collider(
            ColliderBuilder::cuboid(5.0, GROUND_HALF_M, 5.0)
                .position(pose_from_isometry(&ground))
                .friction(options.stand_friction)
                .friction_combine_rule(CoefficientCombineRule::Min)
                .collision_groups(groups(STAND, HAND | FOOT)),
            Some(stand),
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
        engine.insert_collider(
            ColliderBuilder::new(object.shape.clone())
                .density(0.0)
                .friction(target.friction)
                .collision_groups(groups(TARGET, HAND)),
            Some(target_handle),
        );
        engine.insert_collider(
            ColliderBuilder::new(target.hull.clone())
                .density(0.0)
                .friction(1.0)
                .friction_combine_rule(CoefficientCombineRule::Min)
                .collision_groups(groups(FOOT, STAND)),
            Some(target_handle),
        );
        let mut world = World { engine, target: target_handle, stand, up, shapes: Vec::new(), axles: Vec::new() };
        world.build(hand)?;
        Ok(world)
    }

    /// Puts the hand there.
    fn build(&mut self, hand: &HandPlan) -> Result<(), TrialError> {
        let palm = self.engine.insert_body(RigidBodyBuilder::fixed());
        let mut handles: Vec<RigidBodyHandle> = Vec::with_capacity(hand.bodies.len());
        for plan in &hand.bodies {
            let body = self.engine.insert_body(
                RigidBodyBuilder::dynamic()
                    .pose(pose_from_isometry(&plan.palm_from_body))
                    .can_sleep(false)
                    .gravity_scale(0.0)
                    .additional_mass_properties(plan.mass),
            );
            let mut data: GenericJoint = match plan.kind {
                JointKind::Revolute => RevoluteJointBuilder::new(to_engine(&Vector3::x())).into(),
                JointKind::Prismatic => PrismaticJointBuilder::new(to_engine(&Vector3::x())).into(),
            };
            data.set_local_frame1(pose_from_isometry(&plan.parent_from_axis));
            data.set_local_frame2(pose_from_isometry(&plan.body_from_axis));
            data.set_contacts_enabled(false);
            // Each finger is a multibody of its own, with a root that stands where the palm does: a step takes more time by the
            // cube of a multibody's joints.
            let parent = match plan.parent {
                Some(parent) => handles[parent],
                None => self.engine.insert_body(RigidBodyBuilder::fixed()),
            };
            let Some(handle) = self.engine.insert_multibody_joint(parent, body, data) else {
                let reason = format!("joint {} cannot be hung on its link", handles.len());
                return Err(TrialError::Engine { reason });
            };
            handles.push(body);
            self.axles.push((handle, plan.kind));
        }
        for plan in &hand.shapes {
            let body = plan.body.map_or(palm, |body| handles[body]);
            let shape = grown(&*plan.core, plan.edge_radius_m);
            let builder = World::hand_collider(shape, &plan.body_from_shape, (plan.own, plan.touched));
            let collider = self.engine.insert_collider(builder, Some(body));
            self.shapes.push(ShapeCollider { collider, shape_idx: plan.shape_idx, link_idx: plan.link_idx });
        }
        for ((handle, _), plan) in self.axles.iter().zip(&hand.bodies) {
            if let Some((multibody, link_id)) = self.engine.multibody_joints.get_mut(*handle) {
                multibody.set_self_contacts_enabled(true);
                if let Some(dof) = multibody.link(link_id).map(|link| link.assembly_id()) {
                    multibody.armature_mut()[dof] = plan.armature;
                }
            }
        }
        Ok(())
    }

    fn shape_of(&self, collider: ColliderHandle) -> Option<&ShapeCollider> {
        self.shapes.iter().find(|shape| shape.collider == collider)
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
}

impl Engine for World {
    fn travel(&self, axle: usize) -> f64 {
        let (handle, kind) = self.axles[axle];
        let Some((multibody, link_id)) = self.engine.multibody_joints.get(handle) else { return 0.0 };
        let Some(link) = multibody.link(link_id) else { return 0.0 };
        // Three shifts, then the turn about x.
        match kind {
            JointKind::Prismatic => link.joint.coords()[0],
            JointKind::Revolute => link.joint.coords()[3],
        }
    }

    fn drive(&mut self, commands: &[AxleCommand]) {
        for ((handle, kind), command) in self.axles.iter().zip(commands) {
            let Some((multibody, link_id)) = self.engine.multibody_joints.get_mut(*handle) else { continue };
            let Some(link) = multibody.link_mut(link_id) else { continue };
            let axis = match kind {
                JointKind::Revolute => JointAxis::AngX,
                JointKind::Prismatic => JointAxis::LinX,
            };
            let data = &mut link.joint.data;
            data.set_motor_model(axis, MotorModel::ForceBased);
            data.set_motor(axis, command.target, command.speed, command.stiffness, command.damping);
            data.set_motor_max_force(axis, command.most);
        }
    }

    /// The palm stands still in the engine, and the stand goes the other way.
    fn set_palm_motion(&mut self, velocity: &Vector3<f64>, acceleration: &Vector3<f64>) {
        self.engine.gravity = to_engine(&(self.up * -GRAVITY - acceleration));
        if let Some(stand) = self.engine.bodies.get_mut(self.stand) {
            stand.set_linvel(to_engine(&-velocity), true);
        }
    }

    fn push_off(&mut self, velocity: &Vector3<f64>) {
        self.set_palm_motion(velocity, &Vector3::zeros());
        if let Some(target) = self.engine.bodies.get_mut(self.target) {
            target.set_linvel(to_engine(&-velocity), true);
        }
    }

    fn stop_palm(&mut self, velocity: &Vector3<f64>) {
        self.set_palm_motion(&Vector3::zeros(), &Vector3::zeros());
        if let Some(target) = self.engine.bodies.get_mut(self.target) {
            let linvel = target.linvel() + to_engine(velocity);
            target.set_linvel(linvel, true);
        }
    }

    fn step(&mut self) {
        self.engine.step();
    }

    fn set_step(&mut self, secs: f64) {
        self.engine.integration_parameters.dt = secs;
    }

    fn palm_from_target(&self) -> Isometry3<f64> {
        from_engine(self.engine.bodies[self.target].position())
    }

    fn target_velocity(&self) -> Vector3<f64> {
        from_engine_vector(self.engine.bodies[self.target].linvel())
    }

    fn touches(&self) -> Vec<Touch> {
        let mut touches = Vec::new();
        for pair in self.engine.narrow_phase.contact_pairs() {
            let sides = [pair.collider1, pair.collider2];
            for idx in [0, 1] {
                let Some(shape) = self.shape_of(sides[idx]) else { continue };
                let other = sides[1 - idx];
                let side = match self.shape_of(other) {
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

    fn stand_forces(&self) -> Vec<StandForce> {
        let mut forces = Vec::new();
        for &collider in self.engine.bodies[self.stand].colliders() {
            for pair in self.engine.narrow_phase.contact_pairs_with(collider) {
                let is_first = pair.collider1 == collider;
                let other = if is_first { pair.collider2 } else { pair.collider1 };
                if self.engine.colliders[other].parent() == Some(self.target) {
                    let sign = if is_first { 1.0 } else { -1.0 };
                    for_each_force(&self.engine, pair, |points, normal, newtons| {
                        let point_m = points[usize::from(is_first)];
                        forces.push(StandForce { point_m, onto_target: normal * sign, newtons });
                    });
                }
            }
        }
        forces
    }

    fn gravity_in_palm(&self) -> Vector3<f64> {
        from_engine_vector(self.engine.gravity)
    }
}

/// The typical size of objects, with which the engine's tolerances scale.
const LENGTH_UNIT_M: f64 = 0.1;

/// Where bodies have moved less against each other than this since contacts were last looked for, the engine keeps them
/// and moves them along.
const RECYCLE_M: f64 = 1e-4;

/// Half the thickness of the ground under the stand.
const GROUND_HALF_M: f64 = 0.05;

fn empty_world(options: &PhysicsOptions) -> PhysicsWorld {
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
    engine
}

/// A table or post, its axis along y as the engine has cylinders.
pub(super) fn stand_shape(options: &PhysicsOptions) -> SharedShape {
    SharedShape::cylinder(options.stand_height_m / 2.0, options.stand_radius_m)
}

/// Upright, its upper face at z = 0.
pub(super) fn world_from_stand(options: &PhysicsOptions) -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.0, 0.0, -options.stand_height_m / 2.0), Vector3::x() * std::f64::consts::FRAC_PI_2)
}

/// A core with its rounded edges.
fn grown(core: &dyn Shape, edge_radius_m: f64) -> SharedShape {
    if edge_radius_m > 0.0 {
        if let Some(cuboid) = core.as_cuboid() {
            let half = cuboid.half_extents;
            return SharedShape::round_cuboid(half.x, half.y, half.z, edge_radius_m);
        }
        if let Some(cylinder) = core.as_cylinder() {
            return SharedShape::round_cylinder(cylinder.half_height, cylinder.radius, edge_radius_m);
        }
    }
    SharedShape(core.clone_dyn().into())
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
    pub(super) fn mass_properties(&self, centre: Vector) -> MassProperties {
        let hull = self.hull.mass_properties(1.0);
        let inertia = hull.reconstruct_inertia_matrix() * (self.object.mass_kg / hull.mass());
        MassProperties::with_inertia_matrix(centre, self.object.mass_kg, inertia)
    }
}

#[cfg(test)]
mod tests {
    //! The engine against closed formulas.

    use rapier3d_f64::dynamics::LockedAxes;

    use super::*;
    use crate::trial::engine::{load_on_wrist, stand_newtons};
    use blindgrasp_objects::Object;

    const MASS_KG: f64 = 0.4;

    fn load(world: &World) -> (Vector3<f64>, Vector3<f64>) {
        let centre = Point3::from(world.palm_from_target().translation.vector);
        load_on_wrist(world, MASS_KG, &centre, &Vector3::zeros())
    }

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
        object.mass_kg = MASS_KG;
        LiftTarget::new(object, friction)
    }

    fn standing(target: &LiftTarget, options: &PhysicsOptions) -> World {
        let standing = Isometry3::translation(0.0, 0.0, 0.03);
        World::new(target, &standing, &Isometry3::identity(), &HandPlan::default(), options).expect("a world")
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
            let found = stand_newtons(&world);
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
                let options =
                    PhysicsOptions { stand_friction: friction, stand_radius_m: 0.04, ..PhysicsOptions::default() };
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
        let at_height = Isometry3::translation(0.0, 0.0, 0.5);
        let no_hand = HandPlan::default();
        let mut world = World::new(&target, &at_height, &Isometry3::identity(), &no_hand, &options).expect("a world");
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
        assert!(stand_newtons(&world) < 0.01 * MASS_KG * GRAVITY, "{}", stand_newtons(&world));
    }

    #[test]
    fn the_wrist_bears_what_the_stand_does_not() {
        let mut world = standing(&cube(1.0, Made::Box), &PhysicsOptions::default());
        run(&mut world, 0.5);
        let (force, _) = load(&world);
        assert!(force.norm() < 0.01 * MASS_KG * GRAVITY, "it stands: {force}");
        // The stand is taken away: all of the weight would hang on the hand, off its axis by where the cube is.
        world.set_palm_motion(&Vector3::new(0.0, 0.0, 1.0), &Vector3::zeros());
        run(&mut world, 0.05);
        let (force, torque) = load(&world);
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
