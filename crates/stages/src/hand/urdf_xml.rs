//! Reads the XML of a URDF: the links with their collision shapes, and the joints. Visuals, inertias and elements of
//! other programs are passed over.
//!
//! The XML is read once, element by element and without recursion, so that time and memory grow with its length alone.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use quick_xml::Reader;
use quick_xml::escape::unescape;
use quick_xml::events::{BytesStart, Event};

use super::isometry;

/// Greatest distance of a part of a hand from the part that bears it.
pub(super) const MAX_LENGTH_M: f64 = 10.0;
/// Greatest joint limit: two turns.
pub(super) const MAX_LIMIT_RAD: f64 = 4.0 * std::f64::consts::PI;
/// Greatest nesting of the XML. A URDF is nested five deep.
const MAX_DEPTH: usize = 64;
/// Most links, and most joints. A humanoid with two hands has about 150. Checks for self-collision take their cube.
const MAX_LINKS: usize = 256;
/// Most collision shapes of all links together. Checks for self-collision take their square.
const MAX_SHAPES: usize = 1024;

/// The links and joints of a `<robot>` in the file's order. Nothing is checked but the form of each element.
#[derive(Default)]
pub(super) struct Robot {
    pub(super) links: Vec<Link>,
    pub(super) joints: Vec<Joint>,
}

pub(super) struct Link {
    pub(super) name: String,
    pub(super) collisions: Vec<Collision>,
}

#[derive(Default)]
pub(super) struct Collision {
    pub(super) link_from_shape: Isometry3<f64>,
    /// The first known shape.
    pub(super) geometry: Option<Geometry>,
    has_origin: bool,
}

/// A shape with its sizes in metres.
#[derive(Clone)]
pub(super) enum Geometry {
    Box { size_m: [f64; 3] },
    Cylinder { radius_m: f64, length_m: f64 },
    Capsule { radius_m: f64, length_m: f64 },
    Sphere { radius_m: f64 },
    Mesh { file: String, scale: [f64; 3] },
}

pub(super) struct Joint {
    pub(super) name: String,
    /// The word of the attribute `type`.
    pub(super) kind: String,
    /// The parent link's name; empty if the joint names none.
    pub(super) parent: String,
    /// The child link's name; empty if the joint names none.
    pub(super) child: String,
    pub(super) parent_from_joint: Isometry3<f64>,
    pub(super) axis: [f64; 3],
    /// Lower and upper limit, radians or metres.
    pub(super) limits: Option<(f64, f64)>,
    /// Joint, multiplier, offset.
    pub(super) mimic: Option<(String, f64, f64)>,
    /// The elements that have been read: of several of one name the first counts, as urdfdom reads it.
    parts: Vec<String>,
}

/// Reads the text of a URDF.
pub(super) fn read(text: &str) -> Result<Robot, String> {
    let mut reader = Reader::from_str(text);
    let mut reading = UrdfReading::default();
    loop {
        let event = reader.read_event();
        let line = || {
            let end = usize::try_from(reader.buffer_position()).unwrap_or(usize::MAX).min(text.len());
            1 + text.as_bytes()[..end].iter().filter(|byte| **byte == b'\n').count()
        };
        match event {
            Ok(Event::Start(element)) => {
                reading.enter(&element).map_err(|what| format!("line {}: {what}", line()))?;
            }
            Ok(Event::Empty(element)) => {
                reading.enter(&element).map_err(|what| format!("line {}: {what}", line()))?;
                reading.path.pop();
            }
            Ok(Event::End(_)) => {
                reading.path.pop();
            }
            Ok(Event::Eof) => return reading.finish(),
            // Comments and texts mean nothing in a URDF.
            Ok(_) => {}
            Err(error) => {
                let line = line();
                return Err(format!("line {line}: not a URDF, or cut off: {error}; expected XML with one <robot>"));
            }
        }
    }
}

/// What has been read so far.
#[derive(Default)]
struct UrdfReading {
    /// The names of the open elements, from the outermost.
    path: Vec<String>,
    robot: Option<Robot>,
    n_shapes: usize,
}

impl UrdfReading {
    fn enter(&mut self, element: &BytesStart<'_>) -> Result<(), String> {
        let name = element.name().as_ref().to_owned();
        if self.path.is_empty() && (name != "robot" || self.robot.is_some()) {
            let converter = if name == "mujoco" {
                ": make a URDF of it with python3 -P -m blindgrasp.mjcf FILE.xml FILE.urdf"
            } else if name == "mujocoinclude" {
                ": a part of a MuJoCo model; convert the file that includes it with python3 -P -m blindgrasp.mjcf FILE.xml FILE.urdf"
            } else {
                ""
            };
            return Err(format!("not a URDF: expected XML with one <robot>, found <{name}>{converter}"));
        }
        if name.starts_with("xacro:") {
            return Err("it is a xacro file: give it a name that ends in .xacro, so that it is expanded".into());
        }
        self.path.push(name);
        if self.path.len() > MAX_DEPTH {
            return Err(format!("not a URDF: XML elements nested deeper than {MAX_DEPTH}"));
        }
        let attributes = Attributes::of(element);
        let read = attributes.and_then(|attributes| self.read_element(&attributes));
        read.map_err(|what| format!("{}<{}>: {what}", self.owner(), self.path.last().map_or("", String::as_str)))
    }

    /// The link or joint that is being read, as the beginning of a message.
    fn owner(&self) -> String {
        let robot = self.robot.as_ref();
        match self.path.get(1).map(String::as_str) {
            Some("link") => robot.and_then(|robot| robot.links.last()).map(|link| format!("link '{}': ", link.name)),
            Some("joint") => {
                robot.and_then(|robot| robot.joints.last()).map(|joint| format!("joint '{}': ", joint.name))
            }
            _ => None,
        }
        .unwrap_or_default()
    }

    fn read_element(&mut self, attributes: &Attributes) -> Result<(), String> {
        let path: Vec<&str> = self.path.iter().skip(1).map(String::as_str).collect();
        let robot = self.robot.get_or_insert_default();
        match path[..] {
            ["link"] => {
                require_fewer(robot.links.len(), MAX_LINKS, "links")?;
                robot.links.push(Link { name: attributes.required("name")?, collisions: Vec::new() });
            }
            ["joint"] => {
                require_fewer(robot.joints.len(), MAX_LINKS, "joints")?;
                robot.joints.push(Joint::new(attributes)?);
            }
            ["joint", part] => {
                if let Some(joint) = robot.joints.last_mut() {
                    joint.read_part(part, attributes)?;
                }
            }
            ["link", "collision"] => {
                require_fewer(self.n_shapes, MAX_SHAPES, "collision shapes")?;
                self.n_shapes += 1;
                if let Some(link) = robot.links.last_mut() {
                    link.collisions.push(Collision::default());
                }
            }
            ["link", "collision", ref parts @ ..] => {
                if let Some(collision) = robot.links.last_mut().and_then(|link| link.collisions.last_mut()) {
                    collision.read_part(parts, attributes)?;
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn finish(self) -> Result<Robot, String> {
        match (self.path.last(), self.robot) {
            (Some(open), _) => Err(format!("not a URDF, or cut off: it ends inside of <{open}>")),
            (None, None) => Err("not a URDF: expected XML with one <robot>, found none".into()),
            (None, Some(robot)) => Ok(robot),
        }
    }
}

impl Collision {
    fn read_part(&mut self, path: &[&str], attributes: &Attributes) -> Result<(), String> {
        match path {
            ["origin"] if !self.has_origin => {
                self.link_from_shape = attributes.origin()?;
                self.has_origin = true;
            }
            ["geometry", shape] if self.geometry.is_none() => self.geometry = Geometry::read(shape, attributes)?,
            _ => {}
        }
        Ok(())
    }
}

impl Geometry {
    /// `None` for an element that is no shape.
    fn read(shape: &str, attributes: &Attributes) -> Result<Option<Geometry>, String> {
        let number = |name: &str| attributes.required_numbers::<1>(name).map(|[number]| number);
        Ok(Some(match shape {
            "box" => Geometry::Box { size_m: attributes.required_numbers("size")? },
            "sphere" => Geometry::Sphere { radius_m: number("radius")? },
            "cylinder" => Geometry::Cylinder { radius_m: number("radius")?, length_m: number("length")? },
            "capsule" => Geometry::Capsule { radius_m: number("radius")?, length_m: number("length")? },
            "mesh" => Geometry::Mesh {
                file: attributes.required("filename")?,
                scale: attributes.numbers("scale")?.unwrap_or([1.0; 3]),
            },
            _ => return Ok(None),
        }))
    }
}

impl Joint {
    fn new(attributes: &Attributes) -> Result<Joint, String> {
        Ok(Joint {
            name: attributes.required("name")?,
            kind: attributes.required("type")?,
            parent: String::new(),
            child: String::new(),
            parent_from_joint: Isometry3::identity(),
            axis: [1.0, 0.0, 0.0],
            limits: None,
            mimic: None,
            parts: Vec::new(),
        })
    }

    fn read_part(&mut self, part: &str, attributes: &Attributes) -> Result<(), String> {
        const READ: [&str; 6] = ["parent", "child", "origin", "axis", "limit", "mimic"];
        if !READ.contains(&part) || self.parts.iter().any(|read| read == part) {
            return Ok(());
        }
        self.parts.push(part.into());
        match part {
            "parent" => self.parent = attributes.required("link")?,
            "child" => self.child = attributes.required("link")?,
            "origin" => self.parent_from_joint = attributes.origin()?,
            "axis" => self.axis = attributes.required_numbers("xyz")?,
            "limit" => self.limits = Some((attributes.number_or("lower", 0.0)?, attributes.number_or("upper", 0.0)?)),
            "mimic" => {
                let (multiplier, offset) =
                    (attributes.number_or("multiplier", 1.0)?, attributes.number_or("offset", 0.0)?);
                self.mimic = Some((attributes.required("joint")?, multiplier, offset));
            }
            _ => {}
        }
        Ok(())
    }
}

/// An element's attributes by name.
pub(super) struct Attributes(BTreeMap<String, String>);

impl Attributes {
    pub(super) fn of(element: &BytesStart<'_>) -> Result<Attributes, String> {
        let mut by_name = BTreeMap::new();
        // The reader's own check for duplicates names their places, not the attribute.
        for attribute in element.attributes().with_checks(false) {
            let attribute = attribute.map_err(|error| error.to_string())?;
            let name = attribute.key.as_ref().to_owned();
            let value = unescape(&attribute.value).map_err(|error| format!("attribute '{name}': {error}"))?;
            if by_name.insert(name.clone(), value.into_owned()).is_some() {
                return Err(format!("two attributes are called '{name}'"));
            }
        }
        Ok(Attributes(by_name))
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value.as_str()))
    }

    pub(super) fn required(&self, name: &str) -> Result<String, String> {
        self.0.get(name).cloned().ok_or_else(|| format!("expected an attribute '{name}', found none"))
    }

    /// Numbers with spaces between them.
    fn numbers<const N: usize>(&self, name: &str) -> Result<Option<[f64; N]>, String> {
        let Some(text) = self.0.get(name) else { return Ok(None) };
        let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
        match numbers.map(<[f64; N]>::try_from) {
            Some(Ok(numbers)) => Ok(Some(numbers)),
            _ if N == 1 => Err(format!("{name} is '{text}', expected a number")),
            _ => Err(format!("{name} is '{text}', expected {N} numbers with spaces between them")),
        }
    }

    fn required_numbers<const N: usize>(&self, name: &str) -> Result<[f64; N], String> {
        self.numbers(name)?.ok_or_else(|| format!("expected an attribute '{name}', found none"))
    }

    fn number_or(&self, name: &str, default: f64) -> Result<f64, String> {
        Ok(self.numbers(name)?.map_or(default, |[number]| number))
    }

    /// The pose of an `<origin>`. Its rotation is roll, pitch and yaw, or since URDF 1.1 a quaternion.
    fn origin(&self) -> Result<Isometry3<f64>, String> {
        let xyz = self.numbers("xyz")?.unwrap_or_default();
        let rpy = self.numbers("rpy")?;
        let quaternion = self.numbers::<4>("quat_xyzw")?;
        let are_within = |numbers: [f64; 3], most: f64| numbers.iter().all(|number| number.abs() <= most);
        if !(are_within(xyz, MAX_LENGTH_M) && are_within(rpy.unwrap_or_default(), MAX_LIMIT_RAD)) {
            return Err(format!(
                "xyz {xyz:?} rpy {:?}: expected numbers within {MAX_LENGTH_M} m and {MAX_LIMIT_RAD:.2} rad",
                rpy.unwrap_or_default()
            ));
        }
        let Some([x, y, z, w]) = quaternion else { return Ok(isometry(xyz, rpy.unwrap_or_default())) };
        if rpy.is_some() {
            return Err("it has rpy and quat_xyzw: expected one of them".into());
        }
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6)
            .filter(|rotation| rotation.coords.iter().all(|number| number.is_finite()))
            .ok_or_else(|| format!("quat_xyzw {:?}: expected a quaternion of length 1", [x, y, z, w]))?;
        Ok(Isometry3::from_parts(nalgebra::Vector3::from(xyz).into(), rotation))
    }
}

fn require_fewer(n_found: usize, most: usize, what: &str) -> Result<(), String> {
    if n_found < most { Ok(()) } else { Err(format!("more than {most} {what}: expected the URDF of one hand")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error_of(text: &str) -> String {
        read(text).err().unwrap_or_default()
    }

    #[test]
    fn nesting_that_comments_hide_is_refused() {
        for hidden in ["<!--</a>-->", "<![CDATA[</a>]]>", "<?a </a>?>"] {
            let nested = format!("<robot>{}{}</robot>", format!("<a>{hidden}").repeat(20_000), "</a>".repeat(20_000));
            assert!(error_of(&nested).contains("nested deeper than 64"), "{hidden}");
        }
        assert!(error_of(&format!("<robot>{}", "<a b='/>'>".repeat(20_000))).contains("nested deeper than 64"));
    }

    #[test]
    fn a_long_file_is_read_in_linear_time() {
        // Each took seconds to hours: elements compared with each other, attributes compared with each other.
        let many = |text: &str| text.repeat(200_000);
        assert!(read(&format!("<robot>{}</robot>", many("<!--</a>--><gazebo><a/></gazebo>"))).is_ok());
        assert!(error_of(&format!("<robot>{}</robot>", many("<link name='a'/>"))).contains("more than 256 links"));
        let shapes = format!("<robot><link name='a'>{}</link></robot>", many("<collision/>"));
        assert!(error_of(&shapes).contains("link 'a': <collision>: more than 1024 collision shapes"));
        let attributes: String = (0..200_000).map(|idx| format!(" a{idx}=''")).collect();
        assert!(read(&format!("<robot{attributes}/>")).is_ok());
    }

    #[test]
    fn mistakes_say_where_they_are() {
        for (text, expected) in [
            ("", "found none"),
            ("a robot", "found none"),
            ("<hand/>", "one <robot>, found <hand>"),
            ("<robot/><robot/>", "one <robot>, found <robot>"),
            ("<mujocoinclude/>", "a part of a MuJoCo model; convert the file that includes it"),
            ("<mujoco/>", "found <mujoco>: make a URDF of it with python3 -P -m blindgrasp.mjcf"),
            ("<robot>\n<link name='a'>", "cut off: it ends inside of <link>"),
            ("<robot>\n<!-- ", "line 2: not a URDF, or cut off"),
            ("<robot>\n<link name='a'>\n</robot>", "line 3: not a URDF, or cut off"),
            ("<robot>\n<link/></robot>", "line 2: <link>: expected an attribute 'name'"),
            ("<robot><link name='a' name='b'/></robot>", "two attributes are called 'name'"),
            (
                "<robot><joint name='j' type='fixed'><axis xyz='1 x 0'/></joint></robot>",
                "joint 'j': <axis>: xyz is '1 x 0', expected 3 numbers",
            ),
            (
                "<robot><joint name='j' type='fixed'><origin rpy='0 0 0' quat_xyzw='0 0 0 1'/></joint></robot>",
                "joint 'j': <origin>: it has rpy and quat_xyzw",
            ),
            (
                "<robot><link name='a'><collision><origin xyz='80 0 0'/></collision></link></robot>",
                "link 'a': <origin>: xyz [80.0, 0.0, 0.0]",
            ),
        ] {
            let error = error_of(text);
            assert!(error.contains(expected), "expected {expected:?} in {error:?}");
        }
    }

    #[test]
    fn a_quaternion_is_the_rotation_of_its_roll_pitch_and_yaw() {
        let origin = |rotation: &str| {
            let text = format!("<robot><joint name='j' type='fixed'><origin xyz='1 2 3' {rotation}/></joint></robot>");
            read(&text).expect("a robot").joints[0].parent_from_joint
        };
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let difference = origin(&format!("quat_xyzw='0 0 {half} {half}'")).inverse()
            * origin(&format!("rpy='0 0 {}'", std::f64::consts::FRAC_PI_2));
        assert!(difference.rotation.angle() < 1e-12 && difference.translation.vector.norm() < 1e-12);
    }
}
