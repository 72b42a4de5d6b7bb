//! Reads a URDF into a tree of links.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{UnitVector3, Vector3};
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
    /// Meshes that cannot be used, with the reasons.
    pub(super) ignored_meshes: Vec<String>,
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
    pub(super) kind: JointKind,
    pub(super) lower: f64,
    pub(super) upper: f64,
    /// Joint, multiplier, offset.
    pub(super) mimic: Option<(String, f64, f64)>,
}

/// Reads a URDF. `hull` supplies the convex hull of a mesh file, or the reason why there is none.
pub(super) fn parse(
    path: &Path,
    text: &str,
    mut hull: impl FnMut(&str, [f64; 3]) -> Result<SharedShape, String>,
) -> Result<Tree, HandError> {
    let invalid = |message: String| HandError::Invalid { path: path.into(), message };
    let robot = urdf_xml::read(text).map_err(invalid)?;
    for (idx, link) in robot.links.iter().enumerate() {
        if robot.links[..idx].iter().any(|other| other.name == link.name) {
            return Err(invalid(format!("two links are called '{}'", link.name)));
        }
    }
    if robot.links.is_empty() {
        return Err(invalid("the URDF has no link".into()));
    }
    let mut joint_above: BTreeMap<&str, &urdf_xml::Joint> = BTreeMap::new();
    for joint in &robot.joints {
        for (end, element) in [(&joint.parent, "parent"), (&joint.child, "child")] {
            if end.is_empty() {
                return Err(invalid(format!("joint '{}': expected a <{element} link=…>, found none", joint.name)));
            }
            if !robot.links.iter().any(|link| link.name == *end) {
                return Err(invalid(format!("joint '{}' names link '{end}', which the URDF doesn't have", joint.name)));
            }
        }
        if joint_above.insert(&joint.child, joint).is_some() {
            return Err(invalid(format!("link '{}' is the child of two joints", joint.child)));
        }
    }
    let roots: Vec<_> = robot.links.iter().filter(|link| !joint_above.contains_key(link.name.as_str())).collect();
    let [root] = roots[..] else {
        let names: Vec<_> = roots.iter().map(|link| format!("'{}'", link.name)).collect();
        return Err(invalid(format!("expected one root link (child of no joint), found {}", names.join(", "))));
    };
    let mut tree = Tree { links: Vec::new(), joints: BTreeMap::new(), ignored_meshes: Vec::new() };
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
            tree_link.parent_from_joint = joint.parent_from_joint;
            tree_link.joint = moving_joint(joint, &mut tree.joints).map_err(invalid)?;
        }
        for collision in &link.collisions {
            if let Some(Geometry::Mesh { file, scale }) = &collision.geometry {
                match hull(file, *scale) {
                    Ok(core) => {
                        let link_from_shape = collision.link_from_shape;
                        tree_link.shapes.push(LinkShape { link_from_shape, core, edge_radius_m: 0.0 });
                    }
                    Err(reason) => tree.ignored_meshes.push(format!("link '{}': {reason}", link.name)),
                }
                continue;
            }
            let shape = shape(collision).map_err(|what| invalid(format!("link '{}': {what}", link.name)))?;
            tree_link.shapes.extend(shape);
        }
        tree.links.push(tree_link);
        // Reversed, so that popping visits the children in the file's order.
        for joint in robot.joints.iter().rev().filter(|joint| joint.parent == link.name) {
            let child = robot.links.iter().find(|child| child.name == joint.child);
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
    joint: &urdf_xml::Joint,
    joints: &mut BTreeMap<String, TreeJoint>,
) -> Result<Option<(String, UnitVector3<f64>)>, String> {
    let (kind, (lower, upper)) = match (joint.kind.as_str(), joint.limits) {
        ("fixed", _) => return Ok(None),
        ("continuous", _) => (JointKind::Revolute, (-std::f64::consts::PI, std::f64::consts::PI)),
        ("revolute", Some(limits)) if limits != (0.0, 0.0) => (JointKind::Revolute, limits),
        ("prismatic", Some(limits)) if limits != (0.0, 0.0) => (JointKind::Prismatic, limits),
        (kind @ ("revolute" | "prismatic"), _) => {
            return Err(format!("joint '{}' is {kind} and has no <limit lower upper>", joint.name));
        }
        (kind, _) => {
            return Err(format!("joint '{}' is {kind}: expected revolute, prismatic, continuous or fixed", joint.name));
        }
    };
    let most = match kind {
        JointKind::Revolute => MAX_LIMIT_RAD,
        JointKind::Prismatic => MAX_SLIDE_M,
    };
    if !(lower >= -most && upper <= most && lower < upper) {
        return Err(format!(
            "joint '{}': limits {lower}..{upper}, expected lower < upper, within {most:.2} {} of 0",
            joint.name,
            kind.unit()
        ));
    }
    let axis = UnitVector3::try_new(Vector3::from(joint.axis), 1e-6)
        .filter(|axis| axis.iter().all(|number| number.is_finite()))
        .ok_or_else(|| format!("joint '{}': its axis is {:?}, expected a direction", joint.name, joint.axis))?;
    let mimic = joint.mimic.clone();
    if let Some((_, multiplier, offset)) = &mimic
        && !(multiplier.abs() <= MAX_MIMIC && offset.abs() <= MAX_LIMIT_RAD)
    {
        return Err(format!(
            "joint '{}': mimic multiplier {multiplier}, offset {offset}: expected at most {MAX_MIMIC} and {MAX_LIMIT_RAD:.2}",
            joint.name
        ));
    }
    if joints.insert(joint.name.clone(), TreeJoint { kind, lower, upper, mimic }).is_some() {
        return Err(format!("two joints are called '{}'", joint.name));
    }
    Ok(Some((joint.name.clone(), axis)))
}

/// `None` for a mesh.
fn shape(collision: &Collision) -> Result<Option<LinkShape>, String> {
    let geometry = collision
        .geometry
        .as_ref()
        .ok_or("a <collision> without a shape: expected a <geometry> with a box, cylinder, capsule, sphere or mesh")?;
    // Sizes are checked first, because parry panics on invalid ones.
    let sizes: Vec<f64> = match *geometry {
        Geometry::Box { size_m } => size_m.to_vec(),
        Geometry::Sphere { radius_m } => vec![radius_m],
        Geometry::Cylinder { radius_m, length_m } | Geometry::Capsule { radius_m, length_m } => {
            vec![radius_m, length_m]
        }
        Geometry::Mesh { .. } => return Ok(None),
    };
    if !sizes.iter().all(|size| (MIN_SIZE_M..=MAX_LENGTH_M).contains(size)) {
        return Err(format!("a collision shape of size {sizes:?}: expected {MIN_SIZE_M} to {MAX_LENGTH_M} metres"));
    }
    let link_from_origin = collision.link_from_shape;
    let upright = link_from_origin * z_from_y();
    let (link_from_shape, core) = match *geometry {
        Geometry::Box { size_m: [x, y, z] } => (link_from_origin, SharedShape::cuboid(x / 2.0, y / 2.0, z / 2.0)),
        Geometry::Sphere { radius_m } => (link_from_origin, SharedShape::ball(radius_m)),
        Geometry::Cylinder { radius_m, length_m } => (upright, SharedShape::cylinder(length_m / 2.0, radius_m)),
        Geometry::Capsule { radius_m, length_m } => (upright, SharedShape::capsule_y(length_m / 2.0, radius_m)),
        Geometry::Mesh { .. } => return Ok(None),
    };
    Ok(Some(LinkShape { link_from_shape, core, edge_radius_m: 0.0 }))
}

/// URDF's cylinders and capsules stand along z, parry's along y.
fn z_from_y() -> nalgebra::Isometry3<f64> {
    isometry([0.0; 3], [std::f64::consts::FRAC_PI_2, 0.0, 0.0])
}
