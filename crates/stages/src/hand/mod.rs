//! A hand: its kinematic tree, collision shapes and tactile pads, read from a URDF and a pad layout.
//!
//! The URDF holds links, joints and collision shapes. The pad layout, a YAML file that names the URDF, adds the palm
//! link, the position and size of each tactile cell, and the joints that follow others until they are blocked. A
//! collision mesh counts as its convex hull.

mod kinematics;
mod layout;
mod meshes;
mod self_collision;
mod urdf;
mod urdf_part;
mod urdf_text;
mod urdf_xml;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::open_regular;
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, UnitVector3, Vector3};
use parry3d_f64::math::Vector;
use parry3d_f64::shape::SharedShape;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use layout::Layout;

pub use kinematics::{CellPose, JointError};
pub use meshes::{find as find_mesh, find_alike as find_mesh_alike, find_package};
pub(crate) use self_collision::PosedShapes;
pub use self_collision::pose_from_isometry;
pub use urdf_part::{part_below, with_meshes_renamed};
pub use urdf_text::{decode_urdf, read_urdf};

/// A hand of any make: kinematic tree, collision shapes and tactile pads.
#[derive(Debug, Clone)]
pub struct Hand {
    /// The layout's name for the hand, e.g. `barrett-bh8-280`.
    pub name: String,
    /// The joints in the order of `TactileFrame::joints`.
    pub joints: Vec<Joint>,
    /// The links, parents before children.
    pub links: Vec<Link>,
    /// The pads in the order of the layout; cells are numbered through them in order.
    pub pads: Vec<Pad>,
    /// Collision shapes that could not be used, each with its link and the reason.
    pub ignored_shapes: Vec<String>,
    /// Joints of the URDF that could move but count as fixed, each with the reason.
    pub fixed_joints: Vec<String>,
    /// The unit of the cells' readings.
    pub cell_unit: CellUnit,
    /// Whether the median of three frames counts of each cell: see [`crate::glitches`].
    pub median_filter: bool,
    /// The noise threshold of each cell, through all pads: in a row, because each frame is compared with all of them.
    noise_thresholds_newtons: Vec<f64>,
    id: u64,
    description_id: u64,
    /// The texts of the pad layout and the URDF.
    files: Arc<[String; 2]>,
    reference_link_idx: usize,
    self_collision_margin_m: f64,
    /// Pairs of links that may not touch, as indices into `links`.
    self_collision_pairs: Vec<(usize, usize)>,
}

/// The unit of a cell's reading. The fields called `…_newtons` of messages and pads are in this unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CellUnit {
    /// A force.
    #[default]
    Newtons,
    /// A converter's raw counts, without a known relation to force.
    Counts,
}

impl CellUnit {
    /// The name in pad layouts and commands.
    pub fn word(self) -> &'static str {
        match self {
            CellUnit::Newtons => "newtons",
            CellUnit::Counts => "counts",
        }
    }

    /// The symbol behind a number in pictures.
    pub fn symbol(self) -> &'static str {
        match self {
            CellUnit::Newtons => "N",
            CellUnit::Counts => "counts",
        }
    }
}

/// A joint with its own value: radians, or metres of a slide.
#[derive(Debug, Clone, Serialize)]
pub struct Joint {
    pub name: String,
    pub kind: JointKind,
    pub lower: f64,
    pub upper: f64,
    /// The value of the open hand, if the layout gives one.
    pub open: Option<f64>,
    /// The joint that this one follows until it is blocked.
    pub coupling: Option<Coupling>,
    /// Whether the joint is set before a grasp and kept while the others close, like the Barrett hand's spread.
    pub is_preshape: bool,
}

impl Joint {
    /// The value of the open hand: the layout's, or 0 as far as the limits allow.
    pub fn open(&self) -> f64 {
        self.open.unwrap_or_else(|| 0.0_f64.clamp(self.lower, self.upper))
    }

    /// The limit towards which a joint that follows no other closes: the one farther from the open value.
    pub fn closed(&self) -> f64 {
        if self.upper - self.open() >= self.open() - self.lower { self.upper } else { self.lower }
    }

    /// The hint that a value beyond the limits, of which the same number of degrees is within them, needs radians.
    pub fn degrees_hint(&self, value: f64) -> Option<String> {
        let is_angle = self.kind == JointKind::Revolute;
        let in_rad = value.to_radians();
        (is_angle && !self.allows(value, 1e-6) && self.allows(in_rad, 1e-6))
            .then(|| format!("{value} degrees are {in_rad:.4} rad"))
    }

    /// Whether `value` is within the limits, or beyond them by at most so many radians.
    pub fn allows(&self, value: f64, tolerance_rad: f64) -> bool {
        let tolerance = tolerance_rad * self.kind.per_radian();
        (self.lower - tolerance..=self.upper + tolerance).contains(&value)
    }
}

/// The motion of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// It turns; its value is an angle in radians. The kinds `revolute` and `continuous` of a URDF.
    Revolute,
    /// It slides; its value is a length in metres.
    Prismatic,
}

impl JointKind {
    /// The symbol behind a value.
    pub fn unit(self) -> &'static str {
        match self {
            JointKind::Revolute => "rad",
            JointKind::Prismatic => "m",
        }
    }

    /// The pose of a link relative to its joint's origin, at a value of the joint.
    fn displacement(self, axis: &UnitVector3<f64>, value: f64) -> Isometry3<f64> {
        match self {
            JointKind::Revolute => Isometry3::from_parts(Translation3::identity(), rotation(axis, value)),
            JointKind::Prismatic => Translation3::from(axis.into_inner() * value).into(),
        }
    }

    /// The change of value that counts as a radian where speeds and tolerances of all joints are given in radians. A
    /// slide's is 0.1 m: the tip of a finger of that length moves as far.
    pub fn per_radian(self) -> f64 {
        match self {
            JointKind::Revolute => 1.0,
            JointKind::Prismatic => 0.1,
        }
    }
}

/// A follower is `ratio` times as far from its open value as the joint followed, while nothing blocks that joint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coupling {
    /// Index of the joint followed.
    pub follows_idx: usize,
    /// Change of the follower's value per change of the followed joint's value.
    pub ratio: f64,
}

/// A rigid link and its joint to its parent.
#[derive(Debug, Clone)]
pub struct Link {
    pub name: String,
    /// Index of the parent link; `None` for the root.
    pub parent_idx: Option<usize>,
    /// The joint's origin in the parent's frame.
    pub parent_from_joint: Isometry3<f64>,
    /// Motion relative to the joint's origin.
    pub motion: Motion,
    /// Convex collision shapes; their union is the link.
    pub shapes: Vec<LinkShape>,
}

/// The motion of a link relative to its joint's origin.
#[derive(Debug, Clone, Copy)]
pub enum Motion {
    Fixed,
    /// It turns about `axis`, or slides along it, by `multiplier * joints[joint_idx] + offset`.
    Joint {
        /// Index into [`Hand::joints`].
        joint_idx: usize,
        /// The motion of this link; that of the joint it mimics may differ.
        kind: JointKind,
        /// 1, unless it is a URDF mimic joint.
        multiplier: f64,
        /// Radians or metres. 0, unless it is a URDF mimic joint.
        offset: f64,
        /// The axis in the joint's frame.
        axis: UnitVector3<f64>,
    },
}

impl Motion {
    /// `joint_from_link` for the joints' values.
    pub fn joint_from_link(&self, joints: &[f64]) -> Isometry3<f64> {
        let Motion::Joint { joint_idx, kind, multiplier, offset, axis } = *self else { return Isometry3::identity() };
        kind.displacement(&axis, multiplier * joints[joint_idx] + offset)
    }
}

/// A convex collision shape in its link's frame: all points within `edge_radius_m` of a core.
#[derive(Clone)]
pub struct LinkShape {
    /// Places the core in its link's frame.
    pub link_from_shape: Isometry3<f64>,
    /// The convex core. Grown by the edge radius, it is the URDF's shape with rounded edges.
    pub core: SharedShape,
    /// Radius of its edges, metres; 0 leaves them sharp.
    pub edge_radius_m: f64,
}

impl LinkShape {
    /// Rounds the edges of a box or a cylinder, whose outer sizes stay the same. The radius is at most 0.9 of the
    /// smallest half extent. Other shapes have no edges.
    fn round(&mut self, edge_radius_m: f64) {
        let within = |half_extents_m: &[f64]| {
            edge_radius_m.min(0.9 * half_extents_m.iter().copied().fold(f64::INFINITY, f64::min))
        };
        if let Some(cuboid) = self.core.as_cuboid() {
            let half = cuboid.half_extents;
            self.edge_radius_m = within(&[half.x, half.y, half.z]);
            let [x, y, z] = [half.x, half.y, half.z].map(|extent| extent - self.edge_radius_m);
            self.core = SharedShape::cuboid(x, y, z);
        } else if let Some(cylinder) = self.core.as_cylinder() {
            let (half_height, radius) = (cylinder.half_height, cylinder.radius);
            self.edge_radius_m = within(&[half_height, radius]);
            self.core = SharedShape::cylinder(half_height - self.edge_radius_m, radius - self.edge_radius_m);
        }
    }
}

impl LinkShape {
    /// The whole shape, its edges cut into flat pieces.
    pub fn rounded(&self) -> SharedShape {
        /// Directions around and between the poles.
        const N_AROUND: u32 = 32;
        let core = match self.core.as_support_map() {
            Some(core) if self.edge_radius_m > 0.0 => core,
            _ => return self.core.clone(),
        };
        let points: Vec<Vector> = (0..=N_AROUND / 2)
            .flat_map(|latitude| (0..N_AROUND).map(move |longitude| (latitude, longitude)))
            .map(|(latitude, longitude)| {
                let angle = |part: f64| libm::sincos(std::f64::consts::TAU * part / f64::from(N_AROUND));
                let ((sin, cos), (sin_around, cos_around)) = (angle(f64::from(latitude)), angle(f64::from(longitude)));
                // Slightly off the axes, so that each direction has one point of the core.
                let normal = Vector::new(sin * cos_around + 1e-3, sin * sin_around + 1e-3, cos + 1e-3).normalize();
                core.local_support_point(normal) + normal * self.edge_radius_m
            })
            .collect();
        SharedShape::convex_hull(&points).unwrap_or_else(|| self.core.clone())
    }
}

impl std::fmt::Debug for LinkShape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?} + {} m at {}", self.core.shape_type(), self.edge_radius_m, self.link_from_shape)
    }
}

/// A tactile pad: cells on one link.
#[derive(Debug, Clone, Default)]
pub struct Pad {
    /// The layout's name, e.g. `finger_1`.
    pub name: String,
    /// Index of the link that bears it.
    pub link_idx: usize,
    /// Index of its first cell among all cells of the hand.
    pub first_cell_idx: usize,
    pub cells: Vec<Cell>,
    /// Whether a cell reads less the more it is loaded. Messages hold forces, which rise.
    pub falls_under_load: bool,
    /// Whether a reading may be missing (null, or not a number). It then counts as 0.
    pub may_be_missing: bool,
    /// The reading of a cell at its greatest load. An open hand with such a reading has no zero.
    pub saturates_at_newtons: Option<f64>,
}

impl Pad {
    /// The mean of its cells' centres, in its link's frame.
    pub fn middle_in_link_m(&self) -> Point3<f64> {
        let sum: Vector3<f64> = self.cells.iter().map(|cell| cell.position_in_link_m.coords).sum();
        Point3::from(sum / self.cells.len() as f64)
    }
}

/// A tactile cell in its link's frame: a flat rectangle.
#[derive(Debug, Clone, Serialize)]
pub struct Cell {
    /// Centre, metres.
    pub position_in_link_m: Point3<f64>,
    /// Outward normal.
    pub normal_in_link: UnitVector3<f64>,
    /// Direction of `size_m[0]`, at right angles to the normal; `size_m[1]` runs along normal × along.
    pub along_in_link: UnitVector3<f64>,
    /// Edge lengths, metres.
    pub size_m: [f64; 2],
    /// A reading above this makes the cell active (section 2 of the paper; the threshold is the sensor's).
    pub noise_threshold_newtons: f64,
}

/// The name of the link that stands for a palm frame that no link of the URDF has.
pub const PALM_FRAME: &str = "blindgrasp_palm";

/// A hand as its URDF alone does not say it.
#[derive(Debug, Clone, Default)]
pub struct BareHand {
    pub name: String,
    /// The link whose frame is the palm frame; the root if none is given.
    pub palm: Option<String>,
    /// Values of joints of the open hand.
    pub open: BTreeMap<String, f64>,
    pub preshape_joints: Vec<String>,
    /// Links that will have pads: the hulls of their meshes are finer.
    pub padded_links: Vec<String>,
}

/// Why a hand could not be read.
#[derive(Debug, thiserror::Error)]
pub enum HandError {
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// The file is invalid: the problem, and the file's expected content.
    #[error("{}: {message}", path.display())]
    Invalid { path: PathBuf, message: String },
    /// Neither a file nor the name of a built-in hand.
    #[error(
        "no hand '{name}': expected a pad layout (a .yaml file that names its URDF) or a built-in hand ({})",
        builtin_names().join(", ")
    )]
    Unknown { name: String },
}

/// Name, pad layout and URDF of a hand of the folder `hands`.
macro_rules! builtin {
    ($name:literal) => {
        (
            $name,
            include_str!(concat!("../../hands/", $name, ".yaml")),
            include_str!(concat!("../../hands/", $name, ".urdf")),
        )
    };
}

/// The hands that come with the program.
const BUILTIN: [(&str, &str, &str); 8] = [
    builtin!("allegro"),
    builtin!("barrett-bh8-280"),
    builtin!("inspire-rh56dftp"),
    builtin!("parallel-gripper"),
    builtin!("robotiq-2f85-tsf85"),
    builtin!("shadow-biotac-sp"),
    builtin!("unitree-dex3-1"),
    builtin!("uskin"),
];

/// The pad layout and the URDF of a hand that comes with the program.
pub fn builtin_files(name: &str) -> Option<(&'static str, &'static str)> {
    BUILTIN.iter().find(|(known, ..)| *known == name).map(|(_, layout, urdf)| (*layout, *urdf))
}

impl Hand {
    /// The link whose frame is the palm frame.
    pub fn palm_link(&self) -> &Link {
        &self.links[self.reference_link_idx]
    }

    /// Index of the link whose frame is the palm frame.
    pub fn palm_link_idx(&self) -> usize {
        self.reference_link_idx
    }

    /// The same hand with another palm frame, at a pose in the frame of its palm link. Its identity stays that of this hand.
    pub fn with_palm_frame(&self, link_from_palm: Isometry3<f64>) -> Hand {
        let mut hand = self.clone();
        hand.reference_link_idx = hand.links.len();
        hand.links.push(Link {
            name: PALM_FRAME.into(),
            parent_idx: Some(self.reference_link_idx),
            parent_from_joint: link_from_palm,
            motion: Motion::Fixed,
            shapes: Vec::new(),
        });
        hand
    }

    /// The same hand with another value of a joint in the open hand.
    pub fn with_open_joint(&self, joint_idx: usize, value: f64) -> Hand {
        let mut hand = self.clone();
        hand.joints[joint_idx].open = Some(value);
        hand.self_collision_pairs = self_collision::pairs(&hand);
        hand
    }

    /// The same hand without the pads of links that do not move against the palm.
    pub fn with_moving_pads(&self) -> Hand {
        let moves = |link_idx: usize| {
            let above = std::iter::successors(Some(link_idx), |idx| self.links[*idx].parent_idx);
            above.into_iter().any(|idx| matches!(self.links[idx].motion, Motion::Joint { .. }))
        };
        let mut hand = self.clone();
        hand.pads.retain(|pad| moves(pad.link_idx));
        hand
    }

    /// The finger of a link: its first moving link behind the palm, or the palm for one that does not move against it.
    pub fn finger_of(&self, link_idx: usize) -> usize {
        let above = |link_idx| std::iter::successors(Some(link_idx), |idx: &usize| self.links[*idx].parent_idx);
        let of_palm: Vec<usize> = above(self.palm_link_idx()).collect();
        let moves = |idx: &usize| matches!(self.links[*idx].motion, Motion::Joint { .. });
        let moving = above(link_idx).filter(|idx| !of_palm.contains(idx) && moves(idx));
        moving.last().unwrap_or(self.palm_link_idx())
    }

    /// A joint that moves the palm itself, as those of an arm do.
    pub fn joint_above_palm(&self) -> Option<&Joint> {
        let above = std::iter::successors(Some(self.palm_link()), |link| Some(&self.links[link.parent_idx?]));
        above.into_iter().find_map(|link| match link.motion {
            Motion::Joint { joint_idx, .. } => Some(&self.joints[joint_idx]),
            Motion::Fixed => None,
        })
    }

    /// The hand of that name that comes with the program.
    pub fn built_in(name: &str) -> Option<Hand> {
        let (_, layout, urdf) = BUILTIN.iter().find(|(known, _, _)| *known == name)?;
        Hand::parse(&PathBuf::from(format!("built-in {name}.yaml")), layout, |_| Ok((*urdf).into())).ok()
    }

    /// Reads a hand from a pad layout file, or takes the built-in hand of that name.
    ///
    /// # Errors
    /// Neither such a file nor such a built-in hand, or a file that cannot be read or is inconsistent.
    pub fn load(path_or_name: &Path) -> Result<Hand, HandError> {
        if !path_or_name.exists()
            && let Some(name) = path_or_name.to_str()
        {
            if let Some(hand) = Hand::built_in(name) {
                return Ok(hand);
            }
            if path_or_name.extension().is_none() && !name.contains('/') {
                return Err(HandError::Unknown { name: name.into() });
            }
        }
        let layout = read(path_or_name)?;
        let folder = path_or_name.parent().unwrap_or(Path::new("")).to_path_buf();
        let hull = |urdf: &Path, mesh: &str, scale, has_pad| {
            let urdf_folder = folder.join(urdf).parent().unwrap_or(Path::new("")).to_path_buf();
            meshes::hull(&meshes::find(mesh, &urdf_folder)?, scale, has_pad)
        };
        Hand::parse_with_meshes(path_or_name, &layout, |urdf| read_urdf(&folder.join(urdf)), hull)
    }

    /// A hand from the texts of a pad layout and of the URDF it names, which `read_urdf` supplies. Collision meshes are
    /// ignored.
    ///
    /// # Errors
    /// As [`Hand::load`].
    pub fn parse(
        layout_path: &Path,
        layout_text: &str,
        read_urdf: impl FnOnce(&Path) -> Result<String, HandError>,
    ) -> Result<Hand, HandError> {
        let no_hull = |_: &Path, mesh: &str, _, _| Err(format!("{mesh} is not read"));
        Hand::parse_with_meshes(layout_path, layout_text, read_urdf, no_hull)
    }

    /// A hand without cells, from the text of a URDF alone: a layout is made for it. Its identity is 0.
    ///
    /// # Errors
    /// A URDF that is inconsistent, or names in `bare` that it does not have.
    pub fn without_cells(urdf_path: &Path, urdf: &str, bare: &BareHand) -> Result<Hand, HandError> {
        let folder = urdf_path.parent().unwrap_or(Path::new(""));
        let tree = urdf::parse(urdf_path, urdf, |link, mesh, scale| {
            meshes::hull(
                &meshes::find_alike(mesh, folder)?,
                scale,
                bare.padded_links.iter().any(|padded| padded == link),
            )
        })?;
        let mut hand = Layout::without_cells(&tree, bare).into_hand(urdf_path, tree, 0)?;
        hand.self_collision_pairs = self_collision::pairs(&hand);
        Ok(hand)
    }

    fn parse_with_meshes(
        layout_path: &Path,
        layout_text: &str,
        read_urdf: impl FnOnce(&Path) -> Result<String, HandError>,
        hull: impl Fn(&Path, &str, [f64; 3], bool) -> Result<SharedShape, String>,
    ) -> Result<Hand, HandError> {
        let layout = layout::parse(layout_path, layout_text)?;
        let urdf_path = layout_path.parent().unwrap_or(Path::new("")).join(&layout.urdf);
        let urdf = read_urdf(Path::new(&layout.urdf))?;
        let tree = urdf::parse(&urdf_path, &urdf, |link, mesh, scale| {
            hull(Path::new(&layout.urdf), mesh, scale, layout.pads_link(link))
        })?;
        let mut hand = layout.into_hand(layout_path, tree, 1)?;
        let mut description = Sha256::new().chain_update(layout_text).chain_update(&urdf);
        let shapes = hand.links.iter().flat_map(|link| &link.shapes);
        for corner in shapes.filter_map(|shape| shape.core.as_convex_polyhedron()).flat_map(|hull| hull.points()) {
            corner.to_array().iter().for_each(|number| description.update(number.to_le_bytes()));
        }
        hand.description_id = first_bytes(description);
        hand.self_collision_pairs = self_collision::pairs(&hand);
        hand.id = hand.digest();
        hand.files = Arc::new([layout_text.into(), urdf]);
        Ok(hand)
    }

    /// Warnings about self-collision: collision shapes that were not read, or a hand without any.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        warnings.extend(self.ignored_shapes.iter().map(|ignored| {
            format!("{}: a collision shape is left out, and its link touches nothing with it: {ignored}", self.name)
        }));
        if self.self_collision_pairs.is_empty() {
            warnings.push(format!(
                "{}: no two links can be seen to touch each other; fingers on fingers will go unnoticed",
                self.name
            ));
        }
        warnings
    }

    /// Cells of all pads together.
    pub fn n_cells(&self) -> usize {
        self.pads.iter().map(|pad| pad.cells.len()).sum()
    }

    /// The noise threshold of each cell, in the order of [`Hand::cells`].
    pub(crate) fn noise_thresholds_newtons(&self) -> &[f64] {
        &self.noise_thresholds_newtons
    }

    /// All cells in order, each with the index of its pad.
    pub fn cells(&self) -> impl Iterator<Item = (usize, &Cell)> {
        self.pads.iter().enumerate().flat_map(|(pad_idx, pad)| pad.cells.iter().map(move |cell| (pad_idx, cell)))
    }

    /// The joints' values of the open hand.
    pub fn open_joints(&self) -> Vec<f64> {
        self.joints.iter().map(Joint::open).collect()
    }

    /// The change of a joint's value while the hand closes by a radian: towards the closed limit, of a follower the coupling's
    /// ratio of its leader's.
    pub fn closing_rate(&self, joint_idx: usize) -> f64 {
        let of_leader = |idx: usize| {
            let joint = &self.joints[idx];
            (joint.closed() - joint.open()).signum() * joint.kind.per_radian()
        };
        match self.joints[joint_idx].coupling {
            Some(coupling) => coupling.ratio * of_leader(coupling.follows_idx),
            None => of_leader(joint_idx),
        }
    }

    /// The progress of closing, of which [`Hand::closing_rate`] is the change for each unit, at which a joint that was open is at its
    /// closed end.
    pub fn closing_end(&self, joint_idx: usize) -> f64 {
        let rate = self.closing_rate(joint_idx);
        if rate == 0.0 {
            return 0.0;
        }
        let joint = &self.joints[joint_idx];
        let limit = if rate > 0.0 { joint.upper } else { joint.lower };
        ((limit - joint.open()) / rate).max(0.0)
    }

    /// The joints' values while the hand closes on nothing from a posture on, in so many steps of equal progress. Links pass
    /// through each other.
    pub fn closing_postures(&self, from: &[f64], n_steps: usize) -> Vec<Vec<f64>> {
        let closing: Vec<usize> = (0..self.joints.len()).filter(|idx| !self.joints[*idx].is_preshape).collect();
        let end = closing.iter().map(|idx| self.closing_end(*idx)).fold(0.0, f64::max);
        let mut postures = Vec::new();
        for step in 0..=n_steps {
            let mut posture = from.to_vec();
            let progress = end * step as f64 / n_steps as f64;
            for idx in &closing {
                let joint = &self.joints[*idx];
                posture[*idx] = (from[*idx] + self.closing_rate(*idx) * progress).clamp(joint.lower, joint.upper);
            }
            postures.push(posture);
        }
        postures
    }

    /// Index of the joint of that name.
    pub fn joint_idx(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Identifies the hand in messages, models and recordings: it depends on kinematics, cells and unit alone, not on
    /// the file. Collision shapes and thresholds do not change it, because they change no contact's meaning. It is
    /// never 0.
    pub fn id(&self) -> u64 {
        self.id
    }

    /// The texts of the pad layout and the URDF that the hand was read from; empty of a hand without cells.
    pub fn files(&self) -> &[String; 2] {
        &self.files
    }

    /// Identifies the text that the hand was read from, including collision shapes and thresholds.
    pub fn description_id(&self) -> u64 {
        self.description_id
    }

    /// Whether both are the same in all but the text that they were read from.
    pub fn is_same(&self, other: &Hand) -> bool {
        if self.description_id == other.description_id {
            return true;
        }
        let [own, others] = [self, other].map(|hand| Hand { description_id: 0, files: Arc::default(), ..hand.clone() });
        format!("{own:?}") == format!("{others:?}")
    }

    fn digest(&self) -> u64 {
        let mut hasher = Sha256::new();
        let mut number = |value: f64| hasher.update(value.to_le_bytes());
        for link in &self.links {
            let origin = &link.parent_from_joint;
            number(link.parent_idx.map_or(-1.0, |idx| idx as f64));
            origin.translation.vector.iter().chain(origin.rotation.coords.iter()).for_each(|value| number(*value));
            if let Motion::Joint { joint_idx, kind, multiplier, offset, axis } = link.motion {
                [joint_idx as f64, multiplier, offset, axis.x, axis.y, axis.z].into_iter().for_each(&mut number);
                // Links that turn add nothing, so that hands from before slides keep their identity.
                if kind == JointKind::Prismatic {
                    number(-1.0);
                }
            }
        }
        number(self.reference_link_idx as f64);
        for pad in &self.pads {
            number(pad.link_idx as f64);
            for cell in &pad.cells {
                cell.position_in_link_m.iter().chain(cell.normal_in_link.iter()).for_each(|value| number(*value));
            }
        }
        for joint in &self.joints {
            hasher.update(joint.name.as_bytes());
        }
        // Newtons add nothing, so that hands from before other units keep their identity.
        if self.cell_unit != CellUnit::Newtons {
            hasher.update(self.cell_unit.word().as_bytes());
        }
        first_bytes(hasher).max(1)
    }
}

fn first_bytes(hasher: Sha256) -> u64 {
    let mut first = [0; 8];
    first.copy_from_slice(&hasher.finalize()[..8]);
    u64::from_le_bytes(first)
}

/// The names of the hands that come with the program.
pub fn builtin_names() -> Vec<&'static str> {
    BUILTIN.iter().map(|(name, _, _)| *name).collect()
}

/// Greatest size of a URDF or layout. It stops the reading of an endless file such as `/dev/zero`.
const MAX_BYTES: u64 = 16 << 20;

fn read(path: &Path) -> Result<String, HandError> {
    let invalid = |message: String| HandError::Invalid { path: path.into(), message };
    let bytes = read_bytes(path)?;
    // The layout's reader says what a URDF is; JSON is YAML as well.
    let is_other =
        |kind: &FileKind| !matches!(kind, FileKind::PadLayout | FileKind::Urdf | FileKind::Empty | FileKind::Json);
    if let Some(kind) = FileKind::of(&bytes).filter(is_other) {
        return Err(invalid(format!(
            "not a pad layout: expected YAML that names a URDF, found {}",
            kind.description()
        )));
    }
    String::from_utf8(bytes).map_err(|_| invalid("not UTF-8: expected a pad layout (YAML)".into()))
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, HandError> {
    let mut bytes = Vec::new();
    open_regular(path)
        .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes))
        .map_err(|source| HandError::Read { path: path.into(), source })?;
    let invalid = |message: &str| HandError::Invalid { path: path.into(), message: message.into() };
    if bytes.len() as u64 > MAX_BYTES {
        return Err(invalid("more than 16 MiB: expected a pad layout (YAML) or a URDF"));
    }
    Ok(bytes)
}

fn isometry(xyz: [f64; 3], rpy: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(
        Vector3::from(xyz).into(),
        rotation(&Vector3::z_axis(), rpy[2])
            * rotation(&Vector3::y_axis(), rpy[1])
            * rotation(&Vector3::x_axis(), rpy[0]),
    )
}

/// The rotation about an axis, the same bits on any processor: nalgebra's takes sine and cosine from the system's library.
fn rotation(axis: &UnitVector3<f64>, angle_rad: f64) -> UnitQuaternion<f64> {
    let (sin, cos) = libm::sincos(0.5 * angle_rad);
    UnitQuaternion::new_unchecked(Quaternion::from_parts(cos, axis.into_inner() * sin))
}
