//! Reads a URDF into a tree of links.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{UnitVector3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::{HandError, LinkShape, isometry};

/// Greatest size and distance of a part of a hand.
const MAX_LENGTH_M: f64 = 10.0;
/// A collision shape smaller than a micrometre is a mistake in its units.
const MIN_SIZE_M: f64 = 1e-6;
/// Greatest joint limit: two turns.
const MAX_LIMIT_RAD: f64 = 4.0 * std::f64::consts::PI;
/// Greatest multiplier of a mimic joint.
const MAX_MIMIC: f64 = 100.0;
/// Greatest nesting of the XML. A URDF is nested five deep.
const MAX_DEPTH: usize = 64;

/// A URDF's links, parents before children, its moving joints by name.
pub(super) struct Tree {
    pub(super) links: Vec<TreeLink>,
    pub(super) joints: BTreeMap<String, TreeJoint>,
    pub(super) n_ignored_shapes: usize,
}

pub(super) struct TreeLink {
    pub(super) name: String,
    pub(super) parent_idx: Option<usize>,
    pub(super) parent_from_joint: nalgebra::Isometry3<f64>,
    /// The moving joint's name and axis.
    pub(super) joint: Option<(String, UnitVector3<f64>)>,
    pub(super) shapes: Vec<LinkShape>,
}

pub(super) struct TreeJoint {
    pub(super) lower_rad: f64,
    pub(super) upper_rad: f64,
    /// Joint, multiplier, offset.
    pub(super) mimic: Option<(String, f64, f64)>,
}

pub(super) fn parse(path: &Path, text: &str) -> Result<Tree, HandError> {
    let invalid = |message: String| HandError::Invalid { path: path.into(), message };
    check_depth(text).map_err(invalid)?;
    let robot = urdf_rs::read_from_string(text)
        .map_err(|error| invalid(format!("not a URDF, or cut off: {error}; expected XML with one <robot>")))?;
    for (idx, link) in robot.links.iter().enumerate() {
        if robot.links[..idx].iter().any(|other| other.name == link.name) {
            return Err(invalid(format!("two links are called '{}'", link.name)));
        }
    }
    if robot.links.is_empty() {
        return Err(invalid("the URDF has no link".into()));
    }
    let mut joint_above: BTreeMap<&str, &urdf_rs::Joint> = BTreeMap::new();
    for joint in &robot.joints {
        for end in [&joint.parent.link, &joint.child.link] {
            if !robot.links.iter().any(|link| link.name == *end) {
                return Err(invalid(format!("joint '{}' names link '{end}', which the URDF doesn't have", joint.name)));
            }
        }
        if joint_above.insert(&joint.child.link, joint).is_some() {
            return Err(invalid(format!("link '{}' is the child of two joints", joint.child.link)));
        }
    }
    let roots: Vec<_> = robot.links.iter().filter(|link| !joint_above.contains_key(link.name.as_str())).collect();
    let [root] = roots[..] else {
        let names: Vec<_> = roots.iter().map(|link| format!("'{}'", link.name)).collect();
        return Err(invalid(format!("expected one root link (child of no joint), found {}", names.join(", "))));
    };
    let mut tree = Tree { links: Vec::new(), joints: BTreeMap::new(), n_ignored_shapes: 0 };
    let mut pending = vec![(root, None)];
    while let Some((link, parent_idx)) = pending.pop() {
        let link_idx = tree.links.len();
        let above = joint_above.get(link.name.as_str()).copied();
        let mut tree_link = TreeLink {
            name: link.name.clone(),
            parent_idx,
            parent_from_joint: nalgebra::Isometry3::identity(),
            joint: None,
            shapes: Vec::new(),
        };
        if let Some(joint) = above {
            check_origin(&joint.origin).map_err(|what| invalid(format!("joint '{}': {what}", joint.name)))?;
            tree_link.parent_from_joint = isometry(joint.origin.xyz.0, joint.origin.rpy.0);
            tree_link.joint = moving_joint(joint, &mut tree.joints).map_err(invalid)?;
        }
        for collision in &link.collision {
            match shape(collision).map_err(|what| invalid(format!("link '{}': {what}", link.name)))? {
                Some(shape) => tree_link.shapes.push(shape),
                None => tree.n_ignored_shapes += 1,
            }
        }
        tree.links.push(tree_link);
        // Reversed, so that popping visits the children in the file's order.
        for joint in robot.joints.iter().rev().filter(|joint| joint.parent.link == link.name) {
            let child = robot.links.iter().find(|child| child.name == joint.child.link);
            pending.extend(child.map(|child| (child, Some(link_idx))));
        }
    }
    if tree.links.len() != robot.links.len() {
        return Err(invalid("the joints form a cycle".into()));
    }
    for (name, joint) in &tree.joints {
        if let Some((followed, _, _)) = &joint.mimic
            && tree.joints.get(followed).is_none_or(|followed| followed.mimic.is_some())
        {
            return Err(invalid(format!(
                "joint '{name}' mimics '{followed}': expected a moving joint that mimics no other"
            )));
        }
    }
    Ok(tree)
}

fn moving_joint(
    joint: &urdf_rs::Joint,
    joints: &mut BTreeMap<String, TreeJoint>,
) -> Result<Option<(String, UnitVector3<f64>)>, String> {
    use urdf_rs::JointType::{Continuous, Fixed, Revolute};
    let (lower_rad, upper_rad) = match joint.joint_type {
        Fixed => return Ok(None),
        Revolute if joint.limit.lower == 0.0 && joint.limit.upper == 0.0 => {
            return Err(format!("joint '{}' is revolute and has no <limit lower upper>", joint.name));
        }
        Revolute => (joint.limit.lower, joint.limit.upper),
        Continuous => (-std::f64::consts::PI, std::f64::consts::PI),
        _ => {
            return Err(format!(
                "joint '{}' is {:?}: expected revolute, continuous or fixed (a hand's fingers turn)",
                joint.name, joint.joint_type
            ));
        }
    };
    if !(lower_rad >= -MAX_LIMIT_RAD && upper_rad <= MAX_LIMIT_RAD && lower_rad < upper_rad) {
        return Err(format!(
            "joint '{}': limits {lower_rad}..{upper_rad}, expected lower < upper, within {MAX_LIMIT_RAD:.2} rad of 0",
            joint.name
        ));
    }
    let axis = UnitVector3::try_new(Vector3::from(joint.axis.xyz.0), 1e-6)
        .ok_or_else(|| format!("joint '{}': its axis has no length", joint.name))?;
    let mimic = joint
        .mimic
        .as_ref()
        .map(|mimic| (mimic.joint.clone(), mimic.multiplier.unwrap_or(1.0), mimic.offset.unwrap_or(0.0)));
    if let Some((_, multiplier, offset)) = &mimic
        && !(multiplier.abs() <= MAX_MIMIC && offset.abs() <= MAX_LIMIT_RAD)
    {
        return Err(format!(
            "joint '{}': mimic multiplier {multiplier}, offset {offset}: expected at most {MAX_MIMIC} and {MAX_LIMIT_RAD:.2}",
            joint.name
        ));
    }
    if joints.insert(joint.name.clone(), TreeJoint { lower_rad, upper_rad, mimic }).is_some() {
        return Err(format!("two joints are called '{}'", joint.name));
    }
    Ok(Some((joint.name.clone(), axis)))
}

/// `None` for a mesh.
fn shape(collision: &urdf_rs::Collision) -> Result<Option<LinkShape>, String> {
    use urdf_rs::Geometry;
    check_origin(&collision.origin).map_err(|what| format!("a collision shape: {what}"))?;
    // Sizes are checked first, because parry panics on invalid ones.
    let sizes: Vec<f64> = match &collision.geometry {
        Geometry::Box { size } => size.to_vec(),
        Geometry::Sphere { radius } => vec![*radius],
        Geometry::Cylinder { radius, length } | Geometry::Capsule { radius, length } => vec![*radius, *length],
        Geometry::Mesh { .. } => return Ok(None),
    };
    if !sizes.iter().all(|size| (MIN_SIZE_M..=MAX_LENGTH_M).contains(size)) {
        return Err(format!("a collision shape of size {sizes:?}: expected {MIN_SIZE_M} to {MAX_LENGTH_M} metres"));
    }
    let link_from_origin = isometry(collision.origin.xyz.0, collision.origin.rpy.0);
    let (link_from_shape, shape) = match &collision.geometry {
        Geometry::Box { size } => (link_from_origin, SharedShape::cuboid(size[0] / 2.0, size[1] / 2.0, size[2] / 2.0)),
        Geometry::Sphere { radius } => (link_from_origin, SharedShape::ball(*radius)),
        Geometry::Cylinder { radius, length } => {
            (link_from_origin * z_from_y(), SharedShape::cylinder(length / 2.0, *radius))
        }
        Geometry::Capsule { radius, length } => {
            (link_from_origin * z_from_y(), SharedShape::capsule_y(length / 2.0, *radius))
        }
        Geometry::Mesh { .. } => return Ok(None),
    };
    Ok(Some(LinkShape { link_from_shape, core: shape, edge_radius_m: 0.0 }))
}

fn check_origin(origin: &urdf_rs::Pose) -> Result<(), String> {
    let (xyz, rpy) = (origin.xyz.0, origin.rpy.0);
    let is_fine =
        xyz.iter().all(|number| number.abs() <= MAX_LENGTH_M) && rpy.iter().all(|number| number.abs() <= MAX_LIMIT_RAD);
    if is_fine {
        return Ok(());
    }
    Err(format!("origin xyz {xyz:?} rpy {rpy:?}: expected numbers within {MAX_LENGTH_M} m and {MAX_LIMIT_RAD:.2} rad"))
}

/// Refuses XML that is nested deeper than any URDF: the parser would overflow the stack. It counts start and end tags
/// roughly; the parser refuses malformed tags later.
fn check_depth(text: &str) -> Result<(), String> {
    let mut depth = 0_usize;
    for tag in text.split('<').skip(1) {
        if tag.starts_with('/') {
            depth = depth.saturating_sub(1);
        } else if !tag.starts_with(['?', '!']) && !tag.split('>').next().is_some_and(|tag| tag.ends_with('/')) {
            depth += 1;
        }
        if depth > MAX_DEPTH {
            return Err(format!("not a URDF: XML elements nested deeper than {MAX_DEPTH}"));
        }
    }
    Ok(())
}

/// URDF's cylinders and capsules stand along z, parry's along y.
fn z_from_y() -> nalgebra::Isometry3<f64> {
    isometry([0.0; 3], [std::f64::consts::FRAC_PI_2, 0.0, 0.0])
}
