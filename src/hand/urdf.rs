//! From a URDF to a tree of links.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{UnitVector3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::{HandError, LinkShape, isometry};

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
    let robot = urdf_rs::read_from_string(text).map_err(|error| invalid(format!("not a URDF: {error}")))?;
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
        return Err(invalid(format!("expected one root link, found {}", roots.len())));
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
            let numbers = joint.origin.xyz.iter().chain(joint.origin.rpy.iter()).chain(joint.axis.xyz.iter());
            if !numbers.clone().all(|number| number.is_finite()) {
                return Err(invalid(format!("joint '{}': origin or axis is not finite", joint.name)));
            }
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
        Revolute => (joint.limit.lower, joint.limit.upper),
        Continuous => (-std::f64::consts::PI, std::f64::consts::PI),
        _ => {
            return Err(format!(
                "joint '{}' is {:?}: expected revolute, continuous or fixed (a hand's fingers turn)",
                joint.name, joint.joint_type
            ));
        }
    };
    if !(lower_rad.is_finite() && upper_rad.is_finite() && lower_rad < upper_rad) {
        return Err(format!("joint '{}': limits {lower_rad}..{upper_rad}, expected lower < upper", joint.name));
    }
    let axis = UnitVector3::try_new(Vector3::from(joint.axis.xyz.0), 1e-6)
        .ok_or_else(|| format!("joint '{}': its axis has no length", joint.name))?;
    let mimic = joint
        .mimic
        .as_ref()
        .map(|mimic| (mimic.joint.clone(), mimic.multiplier.unwrap_or(1.0), mimic.offset.unwrap_or(0.0)));
    if joints.insert(joint.name.clone(), TreeJoint { lower_rad, upper_rad, mimic }).is_some() {
        return Err(format!("two joints are called '{}'", joint.name));
    }
    Ok(Some((joint.name.clone(), axis)))
}

/// `None` for a mesh.
fn shape(collision: &urdf_rs::Collision) -> Result<Option<LinkShape>, String> {
    use urdf_rs::Geometry;
    let mut link_from_shape = isometry(collision.origin.xyz.0, collision.origin.rpy.0);
    let (shape, sizes): (_, Vec<f64>) = match &collision.geometry {
        Geometry::Box { size } => {
            (SharedShape::cuboid(size[0] / 2.0, size[1] / 2.0, size[2] / 2.0), size.iter().copied().collect())
        }
        Geometry::Sphere { radius } => (SharedShape::ball(*radius), vec![*radius]),
        Geometry::Cylinder { radius, length } => {
            link_from_shape *= z_from_y();
            (SharedShape::cylinder(length / 2.0, *radius), vec![*radius, *length])
        }
        Geometry::Capsule { radius, length } => {
            link_from_shape *= z_from_y();
            (SharedShape::capsule_y(length / 2.0, *radius), vec![*radius, *length])
        }
        Geometry::Mesh { .. } => return Ok(None),
    };
    if !sizes.iter().all(|size| size.is_finite() && *size > 0.0) {
        return Err(format!("a collision shape of size {sizes:?}: expected positive metres"));
    }
    Ok(Some(LinkShape { link_from_shape, shape }))
}

/// URDF's cylinders and capsules stand along z, parry's along y.
fn z_from_y() -> nalgebra::Isometry3<f64> {
    isometry([0.0; 3], [std::f64::consts::FRAC_PI_2, 0.0, 0.0])
}
