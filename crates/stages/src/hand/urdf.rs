//! Reads a URDF into a tree of links.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, UnitVector3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::urdf_xml::{self, Collision, Geometry, MAX_LENGTH_M, MAX_LIMIT_RAD};
use super::{HandError, JointKind, LinkShape, isometry};

/// A collision shape smaller than a micrometre is a mistake in its units.
const MIN_SIZE_M: f64 = 1e-6;
/// Greatest joint limit of a slide. A hand that opens wider is given in millimetres.
const MAX_SLIDE_M: f64 = 1.0;
/// Greatest multiplier of a mimic joint.
const MAX_MIMIC: f64 = 100.0;

/// A URDF's links, parents before children, its moving joints by name.
pub(super) struct Tree {
    pub(super) links: Vec<TreeLink>,
    pub(super) joints: BTreeMap<String, TreeJoint>,
    /// Collision shapes that cannot be used, with the reasons.
    pub(super) ignored_shapes: Vec<String>,
    /// Moving joints that count as fixed, with the reasons.
    pub(super) fixed_joints: Vec<String>,
}

pub(super) struct TreeLink {
    pub(super) name: String,
    pub(super) parent_idx: Option<usize>,
    pub(super) parent_from_joint: Isometry3<f64>,
    /// The moving joint's name and axis.
    pub(super) joint: Option<(String, UnitVector3<f64>)>,
    pub(super) shapes: Vec<LinkShape>,
}

/// A joint that can move.
pub(super) struct TreeJoint {
    pub(super) kind: JointKind,
    pub(super) lower: f64,
    pub(super) upper: f64,
    /// A joint that mimics no other, multiplier, offset.
    pub(super) mimic: Option<Mimic>,
}

/// The value of a joint that mimics another one is `multiplier` times that joint's value, plus `offset`.
#[derive(Clone)]
pub(super) struct Mimic {
    pub(super) joint: String,
    pub(super) multiplier: f64,
    pub(super) offset: f64,
}

/// Reads a URDF. `hull` supplies the convex hull of a mesh file of a link, by the link's name, the file's and the scale, or the
/// reason why there is none.
pub(super) fn parse(
    path: &Path,
    text: &str,
    hull: impl FnMut(&str, &str, [f64; 3]) -> Result<SharedShape, String>,
) -> Result<Tree, HandError> {
    read_tree(text, hull).map_err(|message| HandError::Invalid { path: path.into(), message })
}

fn read_tree(
    text: &str,
    mut hull: impl FnMut(&str, &str, [f64; 3]) -> Result<SharedShape, String>,
) -> Result<Tree, String> {
    let robot = urdf_xml::read(text)?;
    let joint_above = joints_above(&robot)?;
    let roots: Vec<_> = robot.links.iter().filter(|link| !joint_above.contains_key(link.name.as_str())).collect();
    let [root] = roots[..] else {
        let names: Vec<_> = roots.iter().map(|link| format!("'{}'", link.name)).collect();
        let found = if names.is_empty() { "none, as its joints form a loop".into() } else { names.join(", ") };
        return Err(format!("expected one root link (child of no joint), found {found}"));
    };
    let joints = motions(&robot.joints)?;
    let mut tree =
        Tree { links: Vec::new(), joints: BTreeMap::new(), ignored_shapes: Vec::new(), fixed_joints: Vec::new() };
    let mut pending = vec![(root, None)];
    while let Some((link, parent_idx)) = pending.pop() {
        let link_idx = tree.links.len();
        let mut tree_link = TreeLink {
            name: link.name.clone(),
            parent_idx,
            parent_from_joint: Isometry3::identity(),
            joint: None,
            shapes: Vec::new(),
        };
        if let Some(joint) = joint_above.get(link.name.as_str()) {
            tree_link.parent_from_joint = joint.parent_from_joint;
            match &joints[joint.name.as_str()] {
                JointMotion::Fixed => {}
                JointMotion::Standing { pose, why } => {
                    tree_link.parent_from_joint *= pose;
                    tree.fixed_joints.push(format!("joint '{}' {why}", joint.name));
                }
                JointMotion::Moving { axis, .. } => tree_link.joint = Some((joint.name.clone(), *axis)),
            }
        }
        for collision in &link.collisions {
            let of_link = |file: &str, scale| hull(&link.name, file, scale);
            match shape(collision, of_link).map_err(|what| format!("link '{}': {what}", link.name))? {
                Ok(shape) => tree_link.shapes.push(shape),
                Err(reason) => tree.ignored_shapes.push(format!("link '{}': {reason}", link.name)),
            }
        }
        tree.links.push(tree_link);
        // Reversed, so that popping visits the children in the file's order.
        for joint in robot.joints.iter().rev().filter(|joint| joint.parent == link.name) {
            let child = robot.links.iter().find(|child| child.name == joint.child);
            pending.extend(child.map(|child| (child, Some(link_idx))));
        }
    }
    if tree.links.len() != robot.links.len() {
        return Err("the joints form a cycle".into());
    }
    for (name, motion) in joints {
        if let JointMotion::Moving { joint, .. } = motion {
            tree.joints.insert(name.to_owned(), joint);
        }
    }
    Ok(tree)
}

/// The joint above each link that has one, by the link's name.
fn joints_above(robot: &urdf_xml::Robot) -> Result<BTreeMap<&str, &urdf_xml::Joint>, String> {
    for (idx, link) in robot.links.iter().enumerate() {
        if robot.links[..idx].iter().any(|other| other.name == link.name) {
            return Err(format!("two links are called '{}'", link.name));
        }
    }
    if robot.links.is_empty() {
        return Err("the URDF has no link".into());
    }
    let mut joint_above: BTreeMap<&str, &urdf_xml::Joint> = BTreeMap::new();
    for joint in &robot.joints {
        for (end, element) in [(&joint.parent, "parent"), (&joint.child, "child")] {
            if end.is_empty() {
                return Err(format!("joint '{}': expected a <{element} link=…>, found none", joint.name));
            }
            if !robot.links.iter().any(|link| link.name == *end) {
                return Err(format!("joint '{}' names link '{end}', which the URDF doesn't have", joint.name));
            }
        }
        if joint_above.insert(&joint.child, joint).is_some() {
            return Err(format!("link '{}' is the child of two joints", joint.child));
        }
    }
    Ok(joint_above)
}

/// The motion that a joint of the URDF allows.
enum JointMotion {
    /// A joint of the kind `fixed`.
    Fixed,
    /// A joint of another kind that cannot move, or whose motion no hand has. It adds `pose` to its origin.
    Standing {
        pose: Isometry3<f64>,
        why: String,
    },
    Moving {
        axis: UnitVector3<f64>,
        joint: TreeJoint,
    },
}

/// The motion of each joint, by name.
fn motions(joints: &[urdf_xml::Joint]) -> Result<BTreeMap<&str, JointMotion>, String> {
    let mut by_name: BTreeMap<&str, &urdf_xml::Joint> = BTreeMap::new();
    for joint in joints {
        if by_name.insert(&joint.name, joint).is_some() {
            return Err(format!("two joints are called '{}'", joint.name));
        }
    }
    let mut motions = BTreeMap::new();
    for (name, joint) in &by_name {
        motions.insert(*name, motion(joint, &by_name).map_err(|what| format!("joint '{name}' {what}"))?);
    }
    Ok(motions)
}

fn motion(joint: &urdf_xml::Joint, by_name: &BTreeMap<&str, &urdf_xml::Joint>) -> Result<JointMotion, String> {
    let kind = match joint.kind.as_str() {
        "fixed" => return Ok(JointMotion::Fixed),
        "continuous" | "revolute" => JointKind::Revolute,
        "prismatic" => JointKind::Prismatic,
        "floating" | "planar" => {
            let why = format!("is {}: it counts as fixed", joint.kind);
            return Ok(JointMotion::Standing { pose: Isometry3::identity(), why });
        }
        other => return Err(format!("is {other}: expected revolute, prismatic, continuous or fixed")),
    };
    let mimic = mimic(joint, by_name)?;
    // A joint that mimics another one needs no limits: it has no value of its own.
    let (lower, upper) = if mimic.is_some() { (0.0, 0.0) } else { range(joint)? };
    let still = match &mimic {
        None => (lower == upper).then(|| (lower, format!("has the limits {lower} and {upper}"))),
        Some(mimic) => match by_name[mimic.joint.as_str()] {
            followed if can_move(followed)? => None,
            followed => {
                // Limits that a fixed joint has kept mean nothing.
                let moves = matches!(followed.kind.as_str(), "revolute" | "prismatic");
                let value = if moves { followed.limits.map_or(0.0, |(lower, _)| lower) } else { 0.0 };
                Some((mimic.multiplier * value + mimic.offset, format!("mimics '{}', which stands", mimic.joint)))
            }
        },
    };
    let axis = UnitVector3::try_new(Vector3::from(joint.axis), 1e-6)
        .filter(|axis| axis.iter().all(|number| number.is_finite()))
        .ok_or_else(|| format!("has the axis {:?}, expected a direction", joint.axis))?;
    Ok(match still {
        Some((value, why)) => JointMotion::Standing {
            pose: kind.displacement(&axis, value),
            why: format!("{why}: it counts as fixed at {value} {}", kind.unit()),
        },
        None => JointMotion::Moving { axis, joint: TreeJoint { kind, lower, upper, mimic } },
    })
}

/// Whether a joint that mimics no other has a range.
fn can_move(joint: &urdf_xml::Joint) -> Result<bool, String> {
    match joint.kind.as_str() {
        "continuous" | "revolute" | "prismatic" => range(joint).map(|(lower, upper)| lower < upper),
        _ => Ok(false),
    }
}

/// The limits of a joint that mimics no other.
fn range(joint: &urdf_xml::Joint) -> Result<(f64, f64), String> {
    let (most, unit) = match joint.kind.as_str() {
        "continuous" => return Ok((-std::f64::consts::PI, std::f64::consts::PI)),
        "prismatic" => (MAX_SLIDE_M, JointKind::Prismatic.unit()),
        _ => (MAX_LIMIT_RAD, JointKind::Revolute.unit()),
    };
    let (lower, upper) = joint.limits.ok_or_else(|| format!("is {} and has no <limit lower upper>", joint.kind))?;
    if !(lower >= -most && upper <= most && lower <= upper) {
        let [from, to] = [lower, upper].map(f64::to_radians);
        let is_degrees = most == MAX_LIMIT_RAD && lower <= upper && from >= -most && to <= most;
        let hint =
            if is_degrees { format!(": {lower}..{upper} degrees are {from:.4}..{to:.4} rad") } else { String::new() };
        return Err(format!(
            "has the limits {lower}..{upper}, expected lower <= upper, within {most:.2} {unit} of 0{hint}"
        ));
    }
    Ok((lower, upper))
}

/// The joint that a joint mimics in the end, where joints mimic joints that mimic others: multipliers are multiplied, offsets
/// passed on.
fn mimic(joint: &urdf_xml::Joint, by_name: &BTreeMap<&str, &urdf_xml::Joint>) -> Result<Option<Mimic>, String> {
    let Some((first, mut multiplier, mut offset)) = joint.mimic.clone() else { return Ok(None) };
    let mut followed = first;
    for _ in 0..by_name.len() {
        if !(multiplier.abs() <= MAX_MIMIC && offset.abs() <= MAX_LIMIT_RAD) {
            return Err(format!(
                "mimics with multiplier {multiplier} and offset {offset}: expected at most {MAX_MIMIC} and {MAX_LIMIT_RAD:.2}"
            ));
        }
        let next = by_name.get(followed.as_str()).ok_or_else(|| {
            format!("mimics '{followed}', which the URDF does not have: add that joint, or remove the <mimic>")
        })?;
        match &next.mimic {
            Some((name, by, plus)) if next.kind != "fixed" => {
                offset += multiplier * plus;
                multiplier *= by;
                followed = name.clone();
            }
            _ => return Ok(Some(Mimic { joint: followed, multiplier, offset })),
        }
    }
    Err(format!("mimics '{followed}', and that joint mimics it: expected a joint that mimics no other at the end"))
}

/// The shape of a `<collision>`, or the reason why it has none that can be used.
///
/// # Errors
/// A size that is no length of a hand in metres.
fn shape(
    collision: &Collision,
    hull: impl FnOnce(&str, [f64; 3]) -> Result<SharedShape, String>,
) -> Result<Result<LinkShape, String>, String> {
    let Some(geometry) = &collision.geometry else {
        return Ok(Err("a <collision> without a shape: expected a box, cylinder, capsule, sphere or mesh".into()));
    };
    let (sizes, name) = match *geometry {
        Geometry::Box { size_m } => (size_m.to_vec(), "box"),
        Geometry::Sphere { radius_m } => (vec![radius_m], "sphere"),
        Geometry::Cylinder { radius_m, length_m } => (vec![radius_m, length_m], "cylinder"),
        Geometry::Capsule { radius_m, length_m } => (vec![radius_m, length_m], "capsule"),
        Geometry::Mesh { ref file, scale } => {
            let link_from_shape = collision.link_from_shape;
            return Ok(hull(file, scale).map(|core| LinkShape { link_from_shape, core, edge_radius_m: 0.0 }));
        }
    };
    // Sizes are checked first, because parry panics on invalid ones.
    if !sizes.iter().all(|size| (0.0..=MAX_LENGTH_M).contains(size)) {
        return Err(format!("a collision shape of size {sizes:?}: expected {MIN_SIZE_M} to {MAX_LENGTH_M} metres"));
    }
    if !sizes.iter().all(|size| *size >= MIN_SIZE_M) {
        return Ok(Err(format!("a {name} of size {sizes:?}: expected at least {MIN_SIZE_M} metres")));
    }
    let link_from_origin = collision.link_from_shape;
    let upright = link_from_origin * z_from_y();
    let (link_from_shape, core) = match *geometry {
        Geometry::Box { size_m: [x, y, z] } => (link_from_origin, SharedShape::cuboid(x / 2.0, y / 2.0, z / 2.0)),
        Geometry::Cylinder { radius_m, length_m } => (upright, SharedShape::cylinder(length_m / 2.0, radius_m)),
        Geometry::Capsule { radius_m, length_m } => (upright, SharedShape::capsule_y(length_m / 2.0, radius_m)),
        Geometry::Sphere { .. } | Geometry::Mesh { .. } => (link_from_origin, SharedShape::ball(sizes[0])),
    };
    Ok(Ok(LinkShape { link_from_shape, core, edge_radius_m: 0.0 }))
}

/// URDF's cylinders and capsules stand along z, parry's along y.
fn z_from_y() -> Isometry3<f64> {
    isometry([0.0; 3], [std::f64::consts::FRAC_PI_2, 0.0, 0.0])
}
