//! MuJoCo as the physics engine: a second robot, which shares nothing with the first one's contacts.
//!
//! A Python process (`mujoco.py`) runs the engine, because MuJoCo comes from PyPI. It is told a model as MJCF, which is made
//! from the hand's own description, and then goes on step by step. A process serves one attempt after another.
//!
//! The palm is a heavy body that really moves. Links have weight. Rounded edges are contact margins. An object of a mesh is
//! cut into convex parts by CoACD.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write as _};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::{Mutex, PoisonError};

use nalgebra::{Isometry3, Point3, Quaternion, UnitQuaternion, UnitVector3, Vector3};
use parry3d_f64::shape::{Shape, TypedShape};
use rapier3d_f64::parry::mass_properties::MassProperties;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use super::engine::{AxleCommand, Engine, GRAVITY, HandPlan, Side, StandForce, Touch};
use super::{LiftTarget, MujocoOptions, PhysicsOptions, TrialError};
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_stages::hand::JointKind;

const SCRIPT: &str = include_str!("mujoco.py");

/// The variable with the Python interpreter that has MuJoCo.
const PYTHON: &str = "BLINDGRASP_PYTHON";
/// The interpreter where the variable is not set. Tests have an environment of their own.
const DEFAULT_PYTHON: &str =
    if cfg!(test) { concat!(env!("CARGO_MANIFEST_DIR"), "/../../../target/python-env/bin/python") } else { "python3" };

/// Processes that wait for an attempt.
static IDLE: Mutex<Vec<Process>> = Mutex::new(Vec::new());

/// Kinds of bodies, as bits of MuJoCo's contype and conaffinity. The target stands on its convex hull, its foot.
const HAND: u32 = 1;
const TARGET: u32 = 2;
const STAND: u32 = 4;
const FOOT: u32 = 8;

/// A Python process with the engine.
struct Process {
    child: Child,
    commands: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Process {
    fn start() -> Result<Process, String> {
        let python = std::env::var(PYTHON).unwrap_or_else(|_| DEFAULT_PYTHON.into());
        let started = Command::new(&python)
            .args(["-c", SCRIPT])
            .env("PYTHONPATH", std::env::join_paths(python_path()).unwrap_or_default())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            // One thread for each process: there are as many processes as threads.
            .env("OMP_NUM_THREADS", "1")
            .env("OPENBLAS_NUM_THREADS", "1")
            .spawn();
        let mut child = started.map_err(|error| format!("{python} does not start ({error}): set {PYTHON}"))?;
        let (commands, answers) = (child.stdin.take(), child.stdout.take());
        let (Some(commands), Some(answers)) = (commands, answers) else {
            return Err(format!("{python} has no standard input or output"));
        };
        Ok(Process { child, commands, answers: BufReader::new(answers) })
    }

    fn ask(&mut self, command: &Value) -> Result<Value, String> {
        let mut line = String::new();
        // A process that has ended may still have said why.
        let written = writeln!(self.commands, "{command}").and_then(|()| self.commands.flush());
        let n_read = self.answers.read_line(&mut line).map_err(|error| format!("MuJoCo does not answer: {error}"))?;
        if n_read == 0 {
            let why = written.err().map_or(String::new(), |error| format!(": {error}"));
            return Err(format!("the process of MuJoCo has ended{why}"));
        }
        let answer: Value = serde_json::from_str(&line).map_err(|error| format!("MuJoCo's answer: {error}"))?;
        match answer.get("error").and_then(Value::as_str) {
            Some(error) => Err(error.into()),
            None => Ok(answer),
        }
    }
}

fn read_answer<T: DeserializeOwned>(answer: Value) -> Result<T, String> {
    serde_json::from_value(answer).map_err(|error| format!("MuJoCo's answer: {error}"))
}

fn refused(reason: String) -> TrialError {
    TrialError::Engine { reason }
}

/// The entries of PYTHONPATH, without empty ones: these mean the current folder, whose files must not decide what runs.
pub fn python_path() -> Vec<PathBuf> {
    let places = std::env::var_os("PYTHONPATH").unwrap_or_default();
    std::env::split_paths(&places).filter(|place| !place.as_os_str().is_empty()).collect()
}

/// The bodies after a step.
#[derive(Debug, Clone, Default, Deserialize)]
struct State {
    travels: Vec<f64>,
    /// Position, and rotation as w, x, y, z.
    place: [f64; 7],
    velocity: [f64; 3],
}

/// The answer to a step.
#[derive(Deserialize)]
#[serde(untagged)]
enum Stepped {
    To(State),
    /// The engine has lost the bodies.
    Diverged {
        #[serde(rename = "diverged")]
        _is: bool,
    },
}

/// A force between two bodies: the pressed shape of the hand, or -1 for the target; the other side, -2 for the stand; the
/// point, the normal out of the other side, newtons.
#[derive(Debug, Clone, Copy, Deserialize)]
struct Force(i64, i64, [f64; 3], [f64; 3], f64);

/// MuJoCo with a hand, a stand and a target.
pub(super) struct Mujoco {
    /// `None` once it has failed.
    process: Mutex<Option<Process>>,
    failure: Mutex<Option<String>>,
    state: State,
    /// The link of each shape.
    links: Vec<usize>,
    up: Vector3<f64>,
    acceleration: Vector3<f64>,
    velocity: Vector3<f64>,
    jumps: bool,
    commands: Option<Vec<AxleCommand>>,
    step_secs: f64,
}

impl Mujoco {
    /// Builds the model; the arguments are as of the other engine.
    ///
    /// # Errors
    /// Python, MuJoCo or CoACD is missing, or the model is refused.
    pub(super) fn new(
        target: &LiftTarget,
        world_from_target: &Isometry3<f64>,
        palm_from_world: &Isometry3<f64>,
        hand: &HandPlan,
        options: &PhysicsOptions,
    ) -> Result<Mujoco, TrialError> {
        let idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut process = match idle {
            Some(process) => process,
            None => Process::start().map_err(refused)?,
        };
        let begin = json!({"begin": {
            "xml": model(target, world_from_target, palm_from_world, hand, options),
            "mesh": concave(target, options),
            "n_axles": hand.bodies.len(),
            "step_secs": options.mujoco.step_secs,
        }});
        let state = process.ask(&begin).and_then(read_answer).map_err(refused)?;
        Ok(Mujoco {
            process: Mutex::new(Some(process)),
            failure: Mutex::new(None),
            state,
            links: hand.shapes.iter().map(|shape| shape.link_idx).collect(),
            up: palm_from_world.rotation * Vector3::z(),
            acceleration: Vector3::zeros(),
            velocity: Vector3::zeros(),
            jumps: false,
            commands: None,
            step_secs: options.step_secs,
        })
    }

    /// Asks the process. `None` once it has failed, or its answer cannot be read.
    fn ask<T: DeserializeOwned>(&self, command: &Value) -> Option<T> {
        let mut process = self.process.lock().unwrap_or_else(PoisonError::into_inner);
        match process.as_mut()?.ask(command).and_then(read_answer) {
            Ok(answer) => Some(answer),
            Err(error) => {
                *process = None;
                *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
                None
            }
        }
    }

    /// The forces between two bodies.
    fn forces(&self) -> Vec<Force> {
        self.ask(&json!({"touches": {}})).unwrap_or_default()
    }

    /// The link of a shape of the hand, and the shape.
    fn link_and_shape(&self, shape: i64) -> Option<(usize, usize)> {
        let shape_idx = usize::try_from(shape).ok()?;
        Some((*self.links.get(shape_idx)?, shape_idx))
    }
}

impl Drop for Mujoco {
    fn drop(&mut self) {
        let process = self.process.lock().unwrap_or_else(PoisonError::into_inner).take();
        IDLE.lock().unwrap_or_else(PoisonError::into_inner).extend(process);
    }
}

impl Engine for Mujoco {
    fn travel(&self, axle: usize) -> f64 {
        self.state.travels.get(axle).copied().unwrap_or(0.0)
    }

    fn drive(&mut self, commands: &[AxleCommand]) {
        self.commands = Some(commands.to_vec());
    }

    fn set_palm_motion(&mut self, velocity: &Vector3<f64>, acceleration: &Vector3<f64>) {
        (self.velocity, self.acceleration) = (*velocity, *acceleration);
    }

    fn push_off(&mut self, velocity: &Vector3<f64>) {
        (self.velocity, self.jumps) = (*velocity, true);
    }

    fn stop_palm(&mut self, _velocity: &Vector3<f64>) {
        (self.velocity, self.jumps) = (Vector3::zeros(), true);
    }

    fn step(&mut self) {
        let (mut controls, mut most) = (Value::Null, Value::Null);
        if let Some(commands) = self.commands.take() {
            controls = commands.iter().map(control).collect();
            most = commands.iter().map(|command| command.most).collect();
        }
        let step = json!({"step": {
            "controls": controls,
            "most": most,
            "velocity": [self.velocity.x, self.velocity.y, self.velocity.z],
            "jumps": std::mem::take(&mut self.jumps),
            "secs": self.step_secs,
        }});
        match self.ask(&step) {
            Some(Stepped::To(state)) => self.state = state,
            // A target nowhere is one that is not held.
            Some(Stepped::Diverged { .. }) => self.state.place = [f64::NAN; 7],
            None => {}
        }
    }

    fn set_step(&mut self, secs: f64) {
        self.step_secs = secs;
    }

    fn palm_from_target(&self) -> Isometry3<f64> {
        let [x, y, z, w, i, j, k] = self.state.place;
        Isometry3::from_parts(
            Vector3::new(x, y, z).into(),
            UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k)),
        )
    }

    fn target_velocity(&self) -> Vector3<f64> {
        self.state.velocity.into()
    }

    fn touches(&self) -> Vec<Touch> {
        let mut touches = Vec::new();
        for Force(own, other, point_m, outward, newtons) in self.forces() {
            let Some((link_idx, shape_idx)) = self.link_and_shape(own) else { continue };
            let side = match (other, self.link_and_shape(other)) {
                (-1, _) => Side::Target,
                (-2, _) => Side::Stand,
                (_, Some((link_idx, shape_idx))) => Side::Hand { link_idx, shape_idx },
                (_, None) => continue,
            };
            let (point_m, outward) = (point_m.into(), UnitVector3::new_normalize(outward.into()));
            touches.push(Touch { link_idx, shape_idx, side, point_m, outward, newtons });
        }
        touches
    }

    fn stand_forces(&self) -> Vec<StandForce> {
        let mut forces = Vec::new();
        for Force(own, other, point_m, onto_target, newtons) in self.forces() {
            if (own, other) == (-1, -2) {
                forces.push(StandForce { point_m: point_m.into(), onto_target: onto_target.into(), newtons });
            }
        }
        forces
    }

    fn gravity_in_palm(&self) -> Vector3<f64> {
        self.up * -GRAVITY - self.acceleration
    }

    fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The place to which a motor is driven: its speed is a place ahead of its target.
fn control(command: &AxleCommand) -> f64 {
    command.target + command.speed * command.damping / command.stiffness
}

/// The mesh of a target that is not convex, and how its parts touch; `null` of a convex one.
fn concave(target: &LiftTarget, options: &PhysicsOptions) -> Value {
    let TypedShape::TriMesh(_) = target.object.shape.as_typed_shape() else { return Value::Null };
    let mesh = mesh_of_shape(&target.object.shape);
    let MujocoOptions { contact_secs, .. } = options.mujoco;
    json!({
        "points_m": mesh.vertices_m.iter().map(|point| [point.x, point.y, point.z]).collect::<Vec<_>>(),
        "triangles": mesh.triangles,
        "geom": {
            "contype": TARGET, "conaffinity": HAND, "condim": 4, "priority": 1,
            "friction": friction(target.friction, options),
            "solref": [contact_secs, 1.0],
        },
    })
}

/// Friction along the surface, about its normal (metres), and of rolling (metres).
fn friction(sliding: f64, options: &PhysicsOptions) -> [f64; 3] {
    [sliding, sliding * options.mujoco.torsion_m, 1e-4]
}

/// The model as MJCF. Its world is the palm's frame at the beginning.
fn model(
    target: &LiftTarget,
    world_from_target: &Isometry3<f64>,
    palm_from_world: &Isometry3<f64>,
    hand: &HandPlan,
    options: &PhysicsOptions,
) -> String {
    let MujocoOptions { step_secs, impratio, noslip_iterations, contact_secs, .. } = options.mujoco;
    let gravity = palm_from_world.rotation * Vector3::new(0.0, 0.0, -GRAVITY);
    let mut meshes = Meshes::default();
    let mut bodies = String::new();
    let roots = (0..hand.bodies.len()).filter(|idx| hand.bodies[*idx].parent.is_none());
    for root in roots {
        write_body(hand, root, &mut meshes, &mut bodies);
    }
    let on_palm = write_shapes(hand, None, &mut meshes);

    let palm_from_stand = palm_from_world * Isometry3::translation(0.0, 0.0, -options.stand_height_m / 2.0);
    let stand = meshes.geom(&prism(options.stand_radius_m, options.stand_height_m / 2.0));
    let ground = palm_from_world * Isometry3::translation(0.0, 0.0, -options.stand_height_m - 0.05);
    let target = target_body(target, &(palm_from_world * world_from_target), options, &mut meshes);
    let on_stand = format!(
        r#"contype="{STAND}" conaffinity="{}" priority="2" friction="{} 0 0" solref="{contact_secs} 1""#,
        HAND | FOOT,
        options.stand_friction
    );
    format!(
        r#"<mujoco>
<compiler angle="radian" autolimits="false" balanceinertia="true" boundmass="1e-6" boundinertia="1e-9"/>
<option timestep="{step_secs}" gravity="{}" cone="elliptic" impratio="{impratio}" noslip_iterations="{noslip_iterations}" integrator="implicitfast">
<flag multiccd="enable"/></option>
<size memory="64M"/>
<default><geom contype="{HAND}" conaffinity="{HAND}" condim="4" friction="1 0.005 0.0001" solref="{contact_secs} 1"/></default>
<asset>{}</asset>
<worldbody>
<geom name="stand" {on_stand} {stand} {}/>
<geom name="stand_ground" {on_stand} type="box" size="5 5 0.05" {}/>
<body name="palm" gravcomp="1">
<joint name="palm_x" type="slide" axis="1 0 0"/><joint name="palm_y" type="slide" axis="0 1 0"/><joint name="palm_z" type="slide" axis="0 0 1"/>
<inertial pos="0 0 0" mass="3000" diaginertia="300 300 300"/>
{on_palm}{bodies}</body>
{target}
</worldbody>
<contact>{}</contact>
<actuator>{}</actuator>
</mujoco>"#,
        vector(&gravity),
        meshes.assets,
        pose(&palm_from_stand),
        pose(&ground),
        exclusions(hand),
        actuators(hand, options),
    )
}

fn target_body(
    target: &LiftTarget,
    palm_from_target: &Isometry3<f64>,
    options: &PhysicsOptions,
    meshes: &mut Meshes,
) -> String {
    let [slide, twist, roll] = friction(target.friction, options);
    let contact_secs = options.mujoco.contact_secs;
    let surface = format!(r#"condim="4" priority="1" friction="{slide} {twist} {roll}" solref="{contact_secs} 1""#);
    let solid = match target.object.shape.as_typed_shape() {
        TypedShape::TriMesh(_) => String::new(),
        _ => {
            let geom = geom(&*target.object.shape, &Isometry3::identity(), meshes);
            format!(r#"<geom name="target" contype="{TARGET}" conaffinity="{HAND}" {surface} {geom}/>"#)
        }
    };
    let foot = meshes.geom(&mesh_of_shape(&target.hull).vertices_m);
    let centre = target.object.centre_of_mass_m;
    let mass = target.mass_properties(parry3d_f64::math::Vector::new(centre.x, centre.y, centre.z));
    format!(
        r#"<body name="target" {}><freejoint/>{}{solid}
<geom name="foot" contype="{FOOT}" conaffinity="{STAND}" friction="1 0 0" {foot}/></body>"#,
        pose(palm_from_target),
        inertial(&mass),
    )
}

/// The corners of the stand, which MuJoCo has as a prism of 32 sides.
fn prism(radius_m: f64, half_height_m: f64) -> Vec<Point3<f64>> {
    let mut corners = Vec::new();
    for idx in 0..32 {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(idx) / 32.0).sin_cos();
        corners.extend([-1.0, 1.0].map(|z| Point3::new(radius_m * cos, radius_m * sin, z * half_height_m)));
    }
    corners
}

fn exclusions(hand: &HandPlan) -> String {
    let mut excluded = String::new();
    for (a, b) in apart(hand) {
        let _ = writeln!(excluded, r#"<exclude body1="{}" body2="{}"/>"#, body_name(a), body_name(b));
    }
    excluded
}

fn actuators(hand: &HandPlan, options: &PhysicsOptions) -> String {
    let mut actuators = String::new();
    for (idx, body) in hand.bodies.iter().enumerate() {
        let per_radian = body.kind.per_radian();
        let stiffness = options.gear_stiffness / (per_radian * per_radian);
        let damping = options.gear_damping / (per_radian * per_radian);
        let _ = writeln!(
            actuators,
            r#"<general joint="axle{idx}" gainprm="{stiffness}" biastype="affine" biasprm="0 -{stiffness} -{damping}" forcelimited="true" forcerange="-1 1"/>"#
        );
    }
    actuators
}

fn body_name(body: Option<usize>) -> String {
    body.map_or_else(|| "palm".into(), |idx| format!("body{idx}"))
}

/// The pairs of bodies that have links which are built into each other.
fn apart(hand: &HandPlan) -> Vec<(Option<usize>, Option<usize>)> {
    let mut pairs = Vec::new();
    for (idx, a) in hand.shapes.iter().enumerate() {
        for b in &hand.shapes[..idx] {
            let may_touch = (a.touched & b.own) == b.own;
            if !may_touch && a.body != b.body && !pairs.contains(&(b.body, a.body)) {
                pairs.push((b.body, a.body));
            }
        }
    }
    pairs
}

fn write_body(hand: &HandPlan, idx: usize, meshes: &mut Meshes, out: &mut String) {
    let body = &hand.bodies[idx];
    let parent_from_body = body.parent_from_axis * body.body_from_axis.inverse();
    let axis = body.body_from_axis.rotation * Vector3::x();
    let kind = match body.kind {
        JointKind::Revolute => "hinge",
        JointKind::Prismatic => "slide",
    };
    let _ = writeln!(
        out,
        r#"<body name="body{idx}" {}><joint name="axle{idx}" type="{kind}" axis="{}" armature="{}"/>{}"#,
        pose(&parent_from_body),
        vector(&axis),
        body.armature,
        inertial(&body.mass)
    );
    out.push_str(&write_shapes(hand, Some(idx), meshes));
    for child in (0..hand.bodies.len()).filter(|child| hand.bodies[*child].parent == Some(idx)) {
        write_body(hand, child, meshes, out);
    }
    out.push_str("</body>\n");
}

fn write_shapes(hand: &HandPlan, body: Option<usize>, meshes: &mut Meshes) -> String {
    let mut geoms = String::new();
    for shape in hand.shapes.iter().filter(|shape| shape.body == body) {
        let geom = geom(&*shape.core, &shape.body_from_shape, meshes);
        let (idx, margin) = (shape.shape_idx, shape.edge_radius_m);
        let _ = writeln!(geoms, r#"<geom name="shape{idx}" margin="{margin}" {geom}/>"#);
    }
    geoms
}

/// Meshes of the model, by their corners: MuJoCo takes their convex hulls.
#[derive(Default)]
struct Meshes {
    n: usize,
    assets: String,
}

impl Meshes {
    /// The attributes of a geom of these corners.
    fn geom(&mut self, corners: &[Point3<f64>]) -> String {
        let idx = self.n;
        self.n += 1;
        let corners: Vec<String> = corners.iter().map(|corner| vector(&corner.coords)).collect();
        let _ = writeln!(self.assets, r#"<mesh name="mesh{idx}" vertex="{}"/>"#, corners.join(" "));
        format!(r#"type="mesh" mesh="mesh{idx}""#)
    }
}

/// The attributes of a geom with a shape and its place.
fn geom(shape: &dyn Shape, body_from_shape: &Isometry3<f64>, meshes: &mut Meshes) -> String {
    // Cylinders of MuJoCo stand along z, parry's along y.
    let y_to_z = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2);
    let upright = body_from_shape * Isometry3::from_parts(Default::default(), y_to_z);
    match shape.as_typed_shape() {
        TypedShape::Ball(ball) => format!(r#"type="sphere" size="{}" {}"#, ball.radius, pose(body_from_shape)),
        TypedShape::Cuboid(cuboid) => {
            let half = cuboid.half_extents;
            format!(r#"type="box" size="{} {} {}" {}"#, half.x, half.y, half.z, pose(body_from_shape))
        }
        TypedShape::Cylinder(cylinder) => {
            format!(r#"type="cylinder" size="{} {}" {}"#, cylinder.radius, cylinder.half_height, pose(&upright))
        }
        _ => {
            let corners = mesh_of_shape(&parry3d_f64::shape::SharedShape(shape.clone_dyn().into())).vertices_m;
            format!("{} {}", meshes.geom(&corners), pose(body_from_shape))
        }
    }
}

fn inertial(mass: &MassProperties) -> String {
    let inertia = mass.reconstruct_inertia_matrix();
    let [x, y, z] = [0, 1, 2].map(|column| inertia.col(column));
    let centre = mass.local_com;
    format!(
        r#"<inertial pos="{} {} {}" mass="{}" fullinertia="{} {} {} {} {} {}"/>"#,
        centre.x,
        centre.y,
        centre.z,
        mass.mass(),
        x[0],
        y[1],
        z[2],
        y[0],
        z[0],
        z[1]
    )
}

fn pose(isometry: &Isometry3<f64>) -> String {
    let rotation = isometry.rotation.coords;
    let position = vector(&isometry.translation.vector);
    format!(r#"pos="{position}" quat="{} {} {} {}""#, rotation.w, rotation.x, rotation.y, rotation.z)
}

fn vector(vector: &Vector3<f64>) -> String {
    format!("{} {} {}", vector.x, vector.y, vector.z)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::trial::engine::stand_newtons;
    use blindgrasp_objects::{Object, select};

    /// An object on the table, if the environment of the tests is there, which `scripts/python-env` makes.
    fn standing(test: &str, name: &str) -> Option<Mujoco> {
        if std::env::var_os(PYTHON).is_none() && !Path::new(DEFAULT_PYTHON).exists() {
            eprintln!("SKIPPED {test}: target/python-env is missing, scripts/python-env makes it");
            return None;
        }
        let object = select(name).expect("an object").remove(0);
        let target = LiftTarget::new(Object { mass_kg: 0.4, ..object }, 1.0);
        let stands = crate::trial::start::world_from_standing(&target, 0.3);
        // The palm is far away, and tilted.
        let palm_from_world = Isometry3::new(Vector3::new(0.1, 0.2, 1.0), Vector3::new(0.5, -0.4, 0.2));
        let options = PhysicsOptions::default();
        let engine = Mujoco::new(&target, &stands, &palm_from_world, &HandPlan::default(), &options);
        Some(engine.expect("MuJoCo"))
    }

    fn run(engine: &mut Mujoco, secs: f64) {
        for _ in 0..(secs / engine.step_secs).round() as usize {
            engine.step();
        }
        assert_eq!(engine.failure(), None);
    }

    #[test]
    fn a_target_on_the_table_weighs_what_it_weighs_and_stays() {
        // Convex, and a vessel that CoACD cuts.
        for name in ["box-00", "can-00"] {
            let Some(mut engine) = standing("mujoco::a_target_on_the_table", name) else { return };
            run(&mut engine, 0.5);
            let begin = engine.palm_from_target();
            run(&mut engine, 0.5);
            let (end, newtons) = (engine.palm_from_target(), stand_newtons(&engine));
            assert!((newtons / (0.4 * GRAVITY) - 1.0).abs() < 0.02, "{name}: {newtons} N");
            assert!((end.translation.vector - begin.translation.vector).norm() < 1e-3, "{name}: {begin} {end}");
            assert!(engine.touches().is_empty(), "there is no hand");
        }
    }

    #[test]
    fn the_palm_moves_and_the_target_does_not() {
        let Some(mut engine) = standing("mujoco::the_palm_moves", "box-00") else { return };
        run(&mut engine, 0.3);
        let begin = engine.palm_from_target().translation.vector;
        let velocity = Vector3::new(0.02, 0.0, 0.01);
        engine.push_off(&velocity);
        run(&mut engine, 1.0);
        let moved = engine.palm_from_target().translation.vector - begin;
        assert!((moved + velocity).norm() < 1e-3, "{moved}");
        engine.stop_palm(&velocity);
        run(&mut engine, 0.2);
        assert!((engine.palm_from_target().translation.vector - begin + velocity).norm() < 1e-3);
    }

    #[test]
    fn a_process_that_ends_is_told() {
        let Some(mut engine) = standing("mujoco::a_process_that_ends", "box-00") else { return };
        engine.process.lock().expect("a lock").as_mut().expect("a process").child.kill().expect("killed");
        engine.step();
        assert!(engine.failure().is_some_and(|reason| reason.contains("the process of MuJoCo has ended")));
    }
}
