//! The pad layout file. It turns a URDF's tree into a hand.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use nalgebra::{Isometry3, UnitVector3, Vector3};
use parry3d_f64::math::Vector;
use serde::Deserialize;

use super::urdf::{Mimic, Tree, TreeLink};
use super::{
    BareHand, Cell, CellUnit, Coupling, Hand, HandError, Joint, JointKind, Link, LinkShape, Motion, Pad,
    pose_from_isometry,
};
use crate::glitches::MAX_FILTERED_CELLS;
use blindgrasp_messages::{MAX_CELLS, MAX_JOINTS, MAX_PADS};

const FORMAT: &str = "blindgrasp-hand/1";
/// Greatest distance of a cell from its link's origin, and greatest edge of a cell. A human hand is 0.2 m long; larger
/// numbers are millimetres.
const MAX_CELL_LENGTH_M: f64 = 0.5;
/// The most keys, numbers, lists and maps in a file. A cell has 22 of them; serde-saphyr's own limit is 250,000.
const MAX_NODES: usize = 32 * MAX_CELLS;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Layout {
    format: String,
    name: String,
    pub(super) urdf: String,
    reference_link: String,
    joints: Vec<String>,
    #[serde(default)]
    couplings: Vec<LayoutCoupling>,
    #[serde(default)]
    open: BTreeMap<String, f64>,
    #[serde(default)]
    preshape_joints: Vec<String>,
    #[serde(default = "default_self_collision_margin_m")]
    self_collision_margin_m: f64,
    #[serde(default)]
    edge_radius_m: f64,
    #[serde(default)]
    cell_unit: CellUnit,
    #[serde(default)]
    median_filter: Option<bool>,
    pads: Vec<LayoutPad>,
    layouts: BTreeMap<String, Vec<LayoutCell>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LayoutCoupling {
    joint: String,
    follows: String,
    ratio: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LayoutPad {
    name: String,
    link: String,
    layout: String,
    noise_threshold_newtons: f64,
    #[serde(default)]
    falls_under_load: bool,
    #[serde(default)]
    may_be_missing: bool,
    saturates_at_newtons: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LayoutCell {
    at_m: [f64; 3],
    normal: [f64; 3],
    along: [f64; 3],
    size_m: [f64; 2],
    noise_threshold_newtons: Option<f64>,
    /// Numbers of cells along `along` and along normal × along, around `at_m`.
    grid: Option<[usize; 2]>,
    /// Distances of a grid's cells, centre to centre.
    pitch_m: Option<[f64; 2]>,
}

fn default_self_collision_margin_m() -> f64 {
    0.0005
}

pub(super) fn parse(path: &Path, text: &str) -> Result<Layout, HandError> {
    let invalid = |message: String| HandError::Invalid { path: path.into(), message };
    if text.trim_start().starts_with("<?xml") || text.trim_start().starts_with("<robot") {
        return Err(invalid("this is a URDF: expected the pad layout (.yaml) that names it; blindgrasp new hand NAME --urdf FILE makes one".into()));
    }
    let options = serde_saphyr::options! { budget: serde_saphyr::budget! { max_nodes: MAX_NODES } };
    let layout: Layout = serde_saphyr::from_str_with_options(text, options)
        .map_err(|error| invalid(format!("not a pad layout: {}", error.without_snippet())))?;
    if layout.format != FORMAT {
        return Err(invalid(format!("format '{}', expected '{FORMAT}'", layout.format)));
    }
    Ok(layout)
}

impl Layout {
    /// The layout of a hand without cells: the joints are those of the URDF that mimic no other, in its order.
    pub(super) fn without_cells(tree: &Tree, bare: &BareHand) -> Layout {
        let joints = tree.links.iter().filter_map(|link| link.joint.as_ref().map(|(name, _)| name));
        let has_value = |name: &&String| tree.joints.get(*name).is_some_and(|joint| joint.mimic.is_none());
        Layout {
            format: FORMAT.into(),
            name: bare.name.clone(),
            urdf: String::new(),
            reference_link: bare.palm.clone().unwrap_or_else(|| tree.links[0].name.clone()),
            joints: joints.filter(has_value).cloned().collect(),
            couplings: Vec::new(),
            open: bare.open.clone(),
            preshape_joints: bare.preshape_joints.clone(),
            self_collision_margin_m: default_self_collision_margin_m(),
            edge_radius_m: 0.0,
            cell_unit: CellUnit::default(),
            median_filter: None,
            pads: Vec::new(),
            layouts: BTreeMap::new(),
        }
    }

    /// Whether a link has a pad.
    pub(super) fn pads_link(&self, link: &str) -> bool {
        self.pads.iter().any(|pad| pad.link == link)
    }

    pub(super) fn into_hand(self, path: &Path, tree: Tree, least_cells: usize) -> Result<Hand, HandError> {
        self.build(tree, least_cells).map_err(|message| HandError::Invalid { path: path.into(), message })
    }

    fn build(self, tree: Tree, least_cells: usize) -> Result<Hand, String> {
        let joints = self.joints(&tree)?;
        if joints.is_empty() {
            let stand = if tree.fixed_joints.is_empty() {
                "the URDF has no joint of the type revolute, continuous or prismatic".into()
            } else {
                tree.fixed_joints.join("; ")
            };
            return Err(format!("0 joints, expected 1 to {MAX_JOINTS}: {stand}"));
        }
        let reference_link_idx = link_idx(&tree, &self.reference_link, "reference_link")?;
        let pads = self.pads(&tree)?;
        let cells = pads.iter().flat_map(|pad| &pad.cells);
        let noise_thresholds_newtons: Vec<f64> = cells.map(|cell| cell.noise_threshold_newtons).collect();
        let n_filtered = if self.median_filter == Some(true) { noise_thresholds_newtons.len() } else { 0 };
        for (what, found, least, most) in [
            ("pads", pads.len(), least_cells, MAX_PADS),
            ("cells", noise_thresholds_newtons.len(), least_cells, MAX_CELLS),
            ("joints", joints.len(), 1, MAX_JOINTS),
            ("cells with median_filter", n_filtered, 0, MAX_FILTERED_CELLS),
        ] {
            if found < least || found > most {
                return Err(format!("{found} {what}, expected {least} to {most}"));
            }
        }
        if !(0.0..=0.02).contains(&self.self_collision_margin_m) {
            return Err(format!("self_collision_margin_m is {}, expected 0 to 0.02", self.self_collision_margin_m));
        }
        if !(0.0..=0.05).contains(&self.edge_radius_m) {
            return Err(format!("edge_radius_m is {}, expected 0 to 0.05", self.edge_radius_m));
        }
        if self.name.is_empty() {
            return Err("name: expected the hand's name".into());
        }
        let mut links = links(&joints, tree.links, &tree.joints)?;
        for shape in links.iter_mut().flat_map(|link| &mut link.shapes) {
            shape.round(self.edge_radius_m);
        }
        Ok(Hand {
            name: self.name,
            joints,
            links,
            median_filter: self.median_filter.unwrap_or(noise_thresholds_newtons.len() <= MAX_FILTERED_CELLS),
            noise_thresholds_newtons,
            pads,
            ignored_shapes: tree.ignored_shapes,
            fixed_joints: tree.fixed_joints,
            cell_unit: self.cell_unit,
            id: 0,
            description_id: 0,
            files: Arc::default(),
            reference_link_idx,
            self_collision_margin_m: self.self_collision_margin_m,
            self_collision_pairs: Vec::new(),
        })
    }

    fn pads(&self, tree: &Tree) -> Result<Vec<Pad>, String> {
        let mut pads: Vec<Pad> = Vec::new();
        let mut first_cell_idx = 0;
        for pad in &self.pads {
            let used_by = format!("pad '{}'", pad.name);
            if pads.iter().any(|other| other.name == pad.name) {
                return Err(format!("two pads are called '{}'", pad.name));
            }
            let Some(entries) = self.layouts.get(&pad.layout) else {
                return Err(format!("{used_by}: there is no layout '{}' under 'layouts'", pad.layout));
            };
            let mut cells = Vec::new();
            for (idx, entry) in entries.iter().enumerate() {
                let built = entry.build(pad.noise_threshold_newtons);
                cells.extend(built.map_err(|what| format!("{used_by}, entry {idx}: {what}"))?);
            }
            if cells.is_empty() {
                return Err(format!("{used_by} has no cells"));
            }
            let n_cells = cells.len();
            let link_idx = link_idx(tree, &pad.link, &used_by)?;
            for (idx, cell) in cells.iter().enumerate() {
                check_place(cell, &tree.links[link_idx])
                    .map_err(|what| format!("{used_by}, cell {idx}, on link '{}': {what}", pad.link))?;
            }
            if pad.saturates_at_newtons.is_some_and(|reading| !reading.is_finite()) {
                return Err(format!("{used_by}: saturates_at_newtons is no finite number"));
            }
            pads.push(Pad {
                name: pad.name.clone(),
                link_idx,
                first_cell_idx,
                cells,
                falls_under_load: pad.falls_under_load,
                may_be_missing: pad.may_be_missing,
                saturates_at_newtons: pad.saturates_at_newtons,
            });
            first_cell_idx += n_cells;
        }
        Ok(pads)
    }

    fn joints(&self, tree: &Tree) -> Result<Vec<Joint>, String> {
        let mut joints: Vec<Joint> = Vec::new();
        for name in &self.joints {
            let joint = tree.joints.get(name).filter(|joint| joint.mimic.is_none()).ok_or_else(|| {
                let counts_as_fixed =
                    tree.fixed_joints.iter().find(|told| told.starts_with(&format!("joint '{name}'")));
                let why = counts_as_fixed.map_or(String::new(), |told| format!(": {told}"));
                format!("joints: the URDF has no moving joint '{name}' with a value of its own{why}")
            })?;
            if joints.iter().any(|other| other.name == *name) {
                return Err(format!("joints: '{name}' is listed twice"));
            }
            let (kind, lower, upper) = (joint.kind, joint.lower, joint.upper);
            let open = self.open.get(name).copied();
            let is_preshape = self.preshape_joints.contains(name);
            let joint = Joint { name: name.clone(), kind, lower, upper, open, coupling: None, is_preshape };
            if !joint.allows(joint.open(), 1e-9) {
                let unit = kind.unit();
                let hint = joint.degrees_hint(joint.open()).map(|hint| format!("; {hint}")).unwrap_or_default();
                return Err(format!("open: '{name}' is {}, expected {lower} to {upper} {unit}{hint}", joint.open()));
            }
            joints.push(joint);
        }
        if let Some((missing, _)) =
            tree.joints.iter().find(|(name, joint)| joint.mimic.is_none() && !self.joints.contains(name))
        {
            return Err(format!("joints: '{missing}' moves in the URDF but is not listed"));
        }
        if let Some(unknown) = self.preshape_joints.iter().find(|name| !self.joints.contains(name)) {
            return Err(format!(
                "preshape_joints: '{unknown}' is not listed under 'joints' ({})",
                self.joints.join(", ")
            ));
        }
        if let Some(unknown) = self.open.keys().find(|name| !self.joints.contains(name)) {
            return Err(format!("open: '{unknown}' is not listed under 'joints' ({})", self.joints.join(", ")));
        }
        self.couple(&mut joints)?;
        Ok(joints)
    }

    /// Couples the joints that follow others.
    fn couple(&self, joints: &mut [Joint]) -> Result<(), String> {
        for coupling in &self.couplings {
            let (follower_idx, follows_idx) =
                (self.coupled_idx(&coupling.joint)?, self.coupled_idx(&coupling.follows)?);
            if follower_idx == follows_idx || !coupling.ratio.is_finite() {
                return Err(format!(
                    "couplings: '{}' follows '{}' at {}: expected another joint and a finite ratio",
                    coupling.joint, coupling.follows, coupling.ratio
                ));
            }
            if joints[follower_idx].coupling.is_some() {
                return Err(format!("couplings: '{}' follows two joints", coupling.joint));
            }
            joints[follower_idx].coupling = Some(Coupling { follows_idx, ratio: coupling.ratio });
        }
        for joint in joints.iter() {
            if joint.coupling.is_some_and(|coupling| joints[coupling.follows_idx].coupling.is_some()) {
                return Err(format!("couplings: '{}' follows a joint that follows another", joint.name));
            }
        }
        Ok(())
    }

    fn coupled_idx(&self, name: &str) -> Result<usize, String> {
        match self.joints.iter().position(|joint| joint == name) {
            Some(idx) => Ok(idx),
            None => Err(format!("couplings: '{name}' is not listed under 'joints'")),
        }
    }
}

fn link_idx(tree: &Tree, name: &str, used_by: &str) -> Result<usize, String> {
    match tree.links.iter().position(|link| link.name == name) {
        Some(idx) => Ok(idx),
        None => {
            let known: Vec<_> = tree.links.iter().map(|link| link.name.as_str()).collect();
            Err(format!("{used_by}: the URDF has no link '{name}' (it has {})", known.join(", ")))
        }
    }
}

impl LayoutCell {
    /// The cell, or the cells of a grid, row by row: the second direction changes first.
    fn build(&self, pad_threshold_newtons: f64) -> Result<Vec<Cell>, String> {
        let normal_in_link = unit_vector(self.normal, "normal")?;
        let along_in_link = unit_vector(self.along, "along")?;
        if normal_in_link.dot(&along_in_link).abs() > 1e-3 {
            return Err("'along' is not at right angles to 'normal'".into());
        }
        let distance_m = Vector3::from(self.at_m).norm();
        if distance_m.is_nan() || distance_m > MAX_CELL_LENGTH_M {
            return Err(format!(
                "at_m is {:?}, {distance_m} m from the origin of its link, expected at most {MAX_CELL_LENGTH_M} m: \
                 write metres, not millimetres",
                self.at_m
            ));
        }
        if !self.size_m.iter().all(|number| *number > 0.0 && *number <= MAX_CELL_LENGTH_M) {
            return Err(format!(
                "size_m is {:?}, expected positive numbers of at most {MAX_CELL_LENGTH_M} m: write metres, not millimetres",
                self.size_m
            ));
        }
        let noise_threshold_newtons = self.noise_threshold_newtons.unwrap_or(pad_threshold_newtons);
        if !(noise_threshold_newtons.is_finite() && noise_threshold_newtons >= 0.0) {
            return Err("noise_threshold_newtons: expected 0 or more".into());
        }
        self.grid(Cell {
            position_in_link_m: self.at_m.into(),
            normal_in_link,
            along_in_link,
            size_m: self.size_m,
            noise_threshold_newtons,
        })
    }

    /// The cells of a grid around `middle`, or `middle` alone.
    fn grid(&self, middle: Cell) -> Result<Vec<Cell>, String> {
        let ([n_rows, n_columns], [row_pitch_m, column_pitch_m]) = match (self.grid, self.pitch_m) {
            (None, None) => return Ok(vec![middle]),
            (Some(grid), Some(pitch_m)) => (grid, pitch_m),
            _ => {
                return Err("it has 'grid' or 'pitch_m' alone: expected both, or none of them for a single cell".into());
            }
        };
        if n_rows == 0 || n_columns == 0 || n_rows.saturating_mul(n_columns) > MAX_CELLS {
            return Err(format!("grid is [{n_rows}, {n_columns}], expected 1 to {MAX_CELLS} cells"));
        }
        let along = middle.along_in_link.into_inner();
        let across = middle.normal_in_link.cross(&along);
        let mut cells = Vec::new();
        for row in 0..n_rows {
            for column in 0..n_columns {
                let row_m = from_middle(row, n_rows, row_pitch_m);
                let column_m = from_middle(column, n_columns, column_pitch_m);
                let position_in_link_m = middle.position_in_link_m + along * row_m + across * column_m;
                cells.push(Cell { position_in_link_m, ..middle.clone() });
            }
        }
        if !cells.iter().all(|cell| cell.position_in_link_m.coords.norm() <= MAX_CELL_LENGTH_M) {
            return Err(format!(
                "pitch_m is [{row_pitch_m}, {column_pitch_m}], which puts cells more than {MAX_CELL_LENGTH_M} m from the \
                 origin of their link: write metres, not millimetres"
            ));
        }
        Ok(cells)
    }
}

fn unit_vector(numbers: [f64; 3], what: &str) -> Result<UnitVector3<f64>, String> {
    let vector = Vector3::from(numbers);
    let length = vector.norm();
    if (length - 1.0).abs() > 1e-3 || !length.is_finite() {
        return Err(format!("{what} has length {length}, expected 1"));
    }
    Ok(UnitVector3::new_normalize(vector))
}

/// The distance of a grid's row or column from the grid's middle.
fn from_middle(idx: usize, n: usize, pitch_m: f64) -> f64 {
    (idx as f64 - (n as f64 - 1.0) / 2.0) * pitch_m
}

/// Refuses a cell that is far from every collision shape of its link, or whose normal points into them.
fn check_place(cell: &Cell, link: &TreeLink) -> Result<(), String> {
    /// Greatest distance between a cell and its link's shapes, which are simpler than the link.
    const MAX_OFF_M: f64 = 0.1;
    /// The distance is compared so far outside and inside of the cell.
    const PROBE_M: f64 = 0.005;
    if link.shapes.is_empty() {
        return Ok(());
    }
    let normal = cell.normal_in_link.into_inner();
    // Negative inside of the shapes.
    let distance_m = |along_normal_m: f64| {
        let point = cell.position_in_link_m + normal * along_normal_m;
        let point = Vector::new(point.x, point.y, point.z);
        let of_shape = |shape: &LinkShape| {
            let pose = pose_from_isometry(&shape.link_from_shape);
            shape.core.distance_to_point(&pose, point, false)
        };
        link.shapes.iter().map(of_shape).fold(f64::INFINITY, f64::min)
    };
    let off_m = distance_m(0.0);
    if off_m > MAX_OFF_M {
        return Err(format!(
            "it is {off_m:.3} m away from every collision shape of the link, expected at most {MAX_OFF_M} m"
        ));
    }
    if distance_m(PROBE_M) < distance_m(-PROBE_M) - PROBE_M / 2.0 {
        return Err(format!(
            "its normal {:.3?} points into the link: expected the direction out of the pad, towards the object",
            [normal.x, normal.y, normal.z]
        ));
    }
    Ok(())
}

/// Gives each link the index of the joint that moves it; a mimic joint's link is moved by the joint it mimics.
fn links(
    joints: &[Joint],
    tree_links: Vec<TreeLink>,
    tree_joints: &BTreeMap<String, super::urdf::TreeJoint>,
) -> Result<Vec<Link>, String> {
    tree_links
        .into_iter()
        .map(|link| {
            let motion = match link.joint {
                None => Motion::Fixed,
                Some((name, axis)) => {
                    let mimic = tree_joints.get(&name).and_then(|joint| joint.mimic.clone());
                    let kind = tree_joints.get(&name).map_or(JointKind::Revolute, |joint| joint.kind);
                    let Mimic { joint: moved_by, multiplier, offset } =
                        mimic.unwrap_or(Mimic { joint: name, multiplier: 1.0, offset: 0.0 });
                    let joint_idx = joints
                        .iter()
                        .position(|joint| joint.name == moved_by)
                        .ok_or_else(|| format!("joints: '{moved_by}' is not listed"))?;
                    Motion::Joint { joint_idx, kind, multiplier, offset, axis }
                }
            };
            let parent_from_joint: Isometry3<f64> = link.parent_from_joint;
            Ok(Link { name: link.name, parent_idx: link.parent_idx, parent_from_joint, motion, shapes: link.shapes })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn built(at_m: [f64; 3], size_m: [f64; 2]) -> Result<Vec<Cell>, String> {
        let (normal, along) = ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]);
        LayoutCell { at_m, normal, along, size_m, noise_threshold_newtons: None, grid: None, pitch_m: None }.build(0.1)
    }

    const GRIPPER_URDF: &str = include_str!("../../hands/parallel-gripper.urdf");
    const GRIPPER: &str = include_str!("../../hands/parallel-gripper.yaml");

    fn gripper(layout: &str, urdf: &str) -> Result<Hand, String> {
        Hand::parse(Path::new("gripper.yaml"), layout, |_| Ok(urdf.into())).map_err(|error| error.to_string())
    }

    #[test]
    fn jaws_slide_apart_and_a_grid_is_told_row_by_row() {
        let hand = gripper(GRIPPER, GRIPPER_URDF).expect("a hand");
        assert_eq!(
            (hand.joints[0].kind, hand.joints[0].open(), hand.joints[0].closed()),
            (JointKind::Prismatic, 0.0425, 0.0)
        );
        let cells = hand.cells_in_palm(&[0.02]).expect("a joint");
        // The second direction is normal x along: of the left jaw -y x z = -x.
        for (idx, x, y, z) in
            [(0, 0.006, 0.02, 0.025), (1, 0.0, 0.02, 0.025), (3, 0.006, 0.02, 0.035), (12, -0.006, -0.02, 0.025)]
        {
            let expected = nalgebra::Point3::new(x, y, z);
            assert!(
                (cells[idx].position_in_palm_m - expected).norm() < 1e-12,
                "{idx}: {}",
                cells[idx].position_in_palm_m
            );
        }
        assert!(hand.joints[0].allows(0.0425 + 0.009, 0.1) && !hand.joints[0].allows(0.0425 + 0.011, 0.1));
        assert_eq!(hand.posture([]).expect("open"), [0.0425]);
    }

    #[test]
    fn another_kind_of_joint_is_another_hand() {
        let slides = gripper(GRIPPER, GRIPPER_URDF).expect("a hand");
        let turns = gripper(GRIPPER, &GRIPPER_URDF.replace("prismatic", "revolute")).expect("a hand");
        assert_ne!(slides.id(), turns.id());
    }

    #[test]
    fn a_layout_that_makes_no_sense_is_refused() {
        let inwards = "normal: [0, 1, 0], along: [0, 0, 1]";
        for (from, to, expected) in [
            ("normal: [0, -1, 0], along: [0, 0, 1]", inwards, "pad 'left', cell 0, on link 'left_jaw': its normal"),
            ("at_m: [0, 0, 0.04]", "at_m: [0, -0.2, 0.04]", "away from every collision shape"),
            ("at_m: [0, 0, 0.04]", "at_m: [0, 0, 40]", "metres, not millimetres"),
            ("pitch_m: [0.01, 0.006]", "pitch_m: [10, 6]", "metres, not millimetres"),
            ("grid: [4, 3], ", "", "'grid' or 'pitch_m' alone"),
            ("grid: [4, 3]", "grid: [4, 0]", "grid is [4, 0]"),
            ("open: {jaw: 0.0425}", "open: {jaw: 0.5}", "open: 'jaw' is 0.5, expected 0 to 0.0425 m"),
            ("open: {jaw: 0.0425}", "open: {jaws: 0}", "open: 'jaws' is not listed"),
        ] {
            assert!(GRIPPER.contains(from), "{from}");
            let error = gripper(&GRIPPER.replacen(from, to, 1), GRIPPER_URDF).err().unwrap_or_default();
            assert!(error.contains(expected), "{to}: {error}");
        }
        let error =
            gripper(GRIPPER, &GRIPPER_URDF.replace("upper=\"0.0425\"", "upper=\"42.5\"")).expect_err("millimetres");
        assert!(error.contains("within 1.00 m of 0"), "{error}");
    }

    #[test]
    fn the_largest_hand_is_read_with_a_place_and_a_threshold_for_each_cell() {
        let text_of = |n_cells: usize| {
            let cell = |idx: usize| {
                format!(
                    "{{at_m: [{}, 0, 0.01], normal: [0, 0, 1], along: [1, 0, 0], size_m: [0.001, 0.001], \
                     noise_threshold_newtons: 0.1}}",
                    1e-5 * idx as f64
                )
            };
            format!(
                "format: blindgrasp-hand/1\nname: skin\nurdf: skin.urdf\nreference_link: arm\njoints: [elbow]\npads:\n\
                 \x20 - {{name: skin, link: arm, layout: skin, noise_threshold_newtons: 0.05}}\nlayouts:\n  skin:\n    - {}\n",
                (0..n_cells).map(cell).collect::<Vec<_>>().join("\n    - ")
            )
        };
        let urdf = "<robot name='r'><link name='arm'/><link name='hand'/><joint name='elbow' type='revolute'>\
                    <parent link='arm'/><child link='hand'/><axis xyz='0 0 1'/>\
                    <limit lower='0' upper='1' effort='1' velocity='1'/></joint></robot>";
        let hand_of = |n_cells| Hand::parse(Path::new("skin.yaml"), &text_of(n_cells), |_| Ok(urdf.into()));
        let hand = hand_of(MAX_CELLS).expect("a hand");
        assert_eq!((hand.n_cells(), hand.noise_thresholds_newtons()), (MAX_CELLS, &[0.1; MAX_CELLS][..]));
        assert!(!hand.median_filter && hand_of(MAX_FILTERED_CELLS).expect("a hand").median_filter);
        let error = hand_of(MAX_CELLS + 1).expect_err("too many").to_string();
        assert!(error.contains("16385 cells, expected 1 to 16384"), "{error}");
        let filtered = |n_cells| {
            let text = format!("{}\nmedian_filter: true\n", text_of(n_cells));
            Hand::parse(Path::new("skin.yaml"), &text, |_| Ok(urdf.into()))
        };
        let error = filtered(MAX_FILTERED_CELLS + 1).expect_err("too many").to_string();
        assert!(error.contains("2001 cells with median_filter, expected 0 to 2000"), "{error}");
    }

    #[test]
    fn a_cell_in_millimetres_is_refused() {
        assert!(built([0.0, -0.008, 0.1], [0.002, 0.003]).is_ok());
        assert!(built([0.3, 0.0, 0.4], [0.5, 0.5]).is_ok(), "the limits themselves");
        for (at_m, size_m, field) in [
            ([0.0, -8.0, 0.1], [0.002, 0.003], "at_m"),
            ([0.0, f64::NAN, 0.0], [0.002, 0.003], "at_m"),
            ([0.0, -0.008, 0.1], [2.0, 0.003], "size_m"),
            ([0.0, -0.008, 0.1], [0.002, f64::NAN], "size_m"),
        ] {
            let error = built(at_m, size_m).err().unwrap_or_default();
            assert!(error.contains(field) && error.contains("metres, not millimetres"), "{error}");
        }
    }
}
