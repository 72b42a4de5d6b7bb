//! The driver for the topics of ROS 2: joint angles, cells, and more where the robot has them.
//!
//! Each message with cells makes a frame, with the joint angles that came last. A message that cannot be read, or whose joint
//! angles are missing or of another time, is refused. Topics have one sender at a time: another one is turned away until
//! the first has been silent for two seconds.

use std::collections::BTreeMap;
use std::sync::Arc;

use rustix::event::{PollFd, PollFlags};

use super::inbox::Inbox;
use super::phases::PhaseFinder;
use super::{Arrival, DriverError, Event, Place, Reading, Refusal, RefusalKind, TactileDriver};
use blindgrasp_messages::Phase;
use blindgrasp_ros::cdr::{self, Value};
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::node::{MessageType, Network, Received, RosNode};
use blindgrasp_ros::standard;

/// A sender that has sent nothing for so long gives way to another one.
const SILENT_NANOS: u64 = 2_000_000_000;

/// The topics and how to read them.
#[derive(Debug, Clone)]
pub struct Topics {
    pub network: Network,
    pub domain: u32,
    pub namespace: String,
    /// Names of topics, with their namespace.
    pub joints: String,
    pub cells: String,
    /// The definition of the messages with cells, and the field that has them.
    pub cells_definition: Definition,
    pub cells_field: String,
    /// `std_msgs/msg/String` with the words of the line protocol; the phase is inferred without it.
    pub phase: Option<String>,
    /// `geometry_msgs/msg/WrenchStamped`, in the palm frame.
    pub wrench: Option<String>,
    /// `sensor_msgs/msg/Imu`, in the palm frame.
    pub imu: Option<String>,
    /// The hand's joints as ROS names them, in the hand's order; whether each closes with the others.
    pub joint_names: Vec<(String, bool)>,
    /// Joint angles and senses must be this near to the cells in time.
    pub tolerance_nanos: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Topic {
    Joints,
    Cells,
    Phase,
    Wrench,
    Imu,
}

/// Reads frames from topics of ROS 2.
pub struct Ros2 {
    topics: Topics,
    definitions: BTreeMap<Topic, (String, Definition, String)>,
    finder: PhaseFinder,
    inbox: Option<Arc<Inbox<(Topic, Received)>>>,
    /// The last angle of each joint, radians, and its time.
    joints: Vec<Option<(f64, u64)>>,
    phase: Phase,
    wrench: Option<(Vec<f64>, u64)>,
    gravity: Option<(Vec<f64>, u64)>,
    senders: BTreeMap<Topic, ([u8; 16], u64)>,
    /// From the sender's numbers of frames to those of the source.
    offset: i128,
    pending: Option<Event>,
}

impl Ros2 {
    pub fn new(topics: Topics, finder: PhaseFinder) -> Self {
        let joints = vec![None; topics.joint_names.len()];
        let mut definitions = BTreeMap::new();
        let mut add = |topic: Topic, name: &Option<String>, definition: Option<Definition>| {
            if let (Some(name), Some(definition)) = (name, definition) {
                let hash = definition.hash();
                definitions.insert(topic, (name.clone(), definition, hash));
            }
        };
        add(Topic::Joints, &Some(topics.joints.clone()), standard::definition("sensor_msgs/msg/JointState"));
        add(Topic::Cells, &Some(topics.cells.clone()), Some(topics.cells_definition.clone()));
        add(Topic::Phase, &topics.phase, standard::definition("std_msgs/msg/String"));
        add(Topic::Wrench, &topics.wrench, standard::definition("geometry_msgs/msg/WrenchStamped"));
        add(Topic::Imu, &topics.imu, standard::definition("sensor_msgs/msg/Imu"));
        Ros2 {
            topics,
            definitions,
            finder,
            inbox: None,
            joints,
            phase: Phase::Open,
            wrench: None,
            gravity: None,
            senders: BTreeMap::new(),
            offset: 0,
            pending: None,
        }
    }

    fn take(&mut self, topic: Topic, received: Received, at_nanos: u64, place: &Place) -> Option<Event> {
        let sender = received.sender.unwrap_or_default();
        let (current, last_nanos) = *self.senders.get(&topic).unwrap_or(&(sender, 0));
        // Joint angles may come from several nodes, each with a part of them.
        let is_single = topic != Topic::Joints;
        if is_single && current != sender && at_nanos.saturating_sub(last_nanos) < SILENT_NANOS {
            return Some(Event::TurnedAway);
        }
        let is_new = self.senders.insert(topic, (sender, at_nanos)).is_none_or(|(before, _)| before != sender);
        let begins = topic == Topic::Cells && is_new;
        if begins {
            // A gap before its first frame: frames may be missing.
            let first = i128::from(received.seq.unwrap_or(0));
            self.offset = place.seq.map_or(0, |last| i128::from(last) + 2 - first);
        }
        let event = self.take_known(topic, &received, at_nanos).unwrap_or_else(|why| {
            let why = format!("{}: {why}", self.definitions[&topic].0);
            Some(Event::Refused(Refusal { kind: RefusalKind::Malformed, why }))
        });
        if begins {
            self.pending = event;
            return Some(Event::Began);
        }
        event
    }

    /// The frame that a message completes.
    ///
    /// # Errors
    /// Why the message cannot be read, for a person.
    fn take_known(&mut self, topic: Topic, received: &Received, at_nanos: u64) -> Result<Option<Event>, String> {
        let (_, definition, hash) = &self.definitions[&topic];
        if received.message.name != definition.name {
            return Err(format!("its type is {}, expected {}", received.message.name, definition.name));
        }
        if received.message.hash.starts_with("RIHS") && received.message.hash != *hash {
            return Err(format!(
                "its {} has other fields: the hash is {}, expected {hash}",
                definition.name, received.message.hash
            ));
        }
        let value = cdr::read(definition, &received.bytes).map_err(|error| error.to_string())?;
        let stamp = value.stamp_nanos().filter(|stamp| *stamp > 0).or(received.source_nanos);
        let stamp_nanos = stamp.unwrap_or(at_nanos);
        match topic {
            Topic::Joints => self.take_joints(&value, stamp_nanos)?,
            Topic::Phase => self.phase = phase_of(&value)?,
            Topic::Wrench => {
                let wrench = value.at("wrench").and_then(|wrench| wrench.numbers()).ok_or("it has no wrench")?;
                self.wrench = Some((wrench, stamp_nanos));
            }
            Topic::Imu => {
                let acceleration = value.at("linear_acceleration").and_then(|it| it.numbers());
                let acceleration = acceleration.ok_or("it has no linear_acceleration")?;
                // A sensor at rest measures the force that keeps it from falling.
                self.gravity = Some((acceleration.iter().map(|part| -part).collect(), stamp_nanos));
            }
            Topic::Cells => return self.frame(&value, received, stamp, stamp_nanos, at_nanos).map(Some),
        }
        Ok(None)
    }

    fn take_joints(&mut self, value: &Value, stamp_nanos: u64) -> Result<(), String> {
        let names = value.at("name");
        let names = names.as_ref().and_then(Value::texts).unwrap_or_default();
        let angles = value.at("position").and_then(|position| position.numbers()).unwrap_or_default();
        if angles.len() != names.len() {
            return Err(format!("{} names and {} positions", names.len(), angles.len()));
        }
        let mut has_any = false;
        for ((wanted, _), joint) in self.topics.joint_names.iter().zip(&mut self.joints) {
            if let Some(idx) = names.iter().position(|name| name == wanted) {
                *joint = Some((angles[idx], stamp_nanos));
                has_any = true;
            }
        }
        if has_any && self.topics.phase.is_none() {
            let fingers = self.topics.joint_names.iter().zip(&self.joints).filter(|((_, closes), _)| *closes);
            let fingers: Option<Vec<f64>> = fingers.map(|(_, joint)| joint.map(|(angle, _)| angle)).collect();
            if let Some(fingers) = fingers {
                self.phase = self.finder.phase(stamp_nanos, &fingers);
            }
        }
        Ok(())
    }

    fn frame(
        &self,
        value: &Value,
        received: &Received,
        stamp: Option<u64>,
        stamp_nanos: u64,
        at_nanos: u64,
    ) -> Result<Event, String> {
        let cells_newtons = cells(value, &self.topics.cells_field)?;
        let is_near = |other: u64| other.abs_diff(stamp_nanos) <= self.topics.tolerance_nanos;
        let mut joints_rad = Vec::with_capacity(self.joints.len());
        for ((name, _), joint) in self.topics.joint_names.iter().zip(&self.joints) {
            let (angle, at) =
                joint.ok_or_else(|| format!("no angle of joint '{name}' has come on {}", self.topics.joints))?;
            if !is_near(at) {
                let millis = at.abs_diff(stamp_nanos) as f64 / 1e6;
                return Err(format!("the angle of joint '{name}' is {millis:.1} ms from the cells in time"));
            }
            joints_rad.push(angle);
        }
        let sense = |sense: &Option<(Vec<f64>, u64)>| {
            sense.as_ref().filter(|(_, at)| is_near(*at)).map(|(values, _)| values.clone()).unwrap_or_default()
        };
        let seq = received.seq.and_then(|seq| u64::try_from(i128::from(seq) + self.offset).ok());
        let reading = Reading {
            joints_rad,
            cells_newtons,
            phase: self.phase,
            gravity_m_per_s2: sense(&self.gravity),
            wrist_wrench: sense(&self.wrench),
            seq,
            stamp_nanos: stamp,
            ..Reading::default()
        };
        Ok(Event::Frame(reading, Arrival { at_nanos, waited_nanos: 0 }))
    }
}

impl TactileDriver for Ros2 {
    fn open(&mut self, _now_nanos: u64) -> Result<(), DriverError> {
        let inbox = Inbox::new().map_err(DriverError::Inbox)?;
        let topics = self.topics.clone();
        let wanted: Vec<_> = self
            .definitions
            .iter()
            .map(|(topic, (name, definition, hash))| {
                (*topic, name.clone(), MessageType { name: definition.name.clone(), hash: hash.clone() })
            })
            .collect();
        let name = wanted.iter().map(|(_, name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
        inbox.keep(name, move |inbox| {
            let session = topics.network.open().map_err(|error| error.to_string())?;
            let node = RosNode::new(session, topics.domain, &topics.namespace, "blindgrasp_tactile_source");
            let mut node = node.map_err(|error| error.to_string())?;
            let mut subscribers = Vec::new();
            for (topic, name, message) in &wanted {
                let (topic, inbox) = (*topic, Arc::clone(inbox));
                let subscriber = node.subscriber(name, message, move |received| inbox.put((topic, received)));
                subscribers.push(subscriber.map_err(|error| error.to_string())?);
            }
            Ok((node, subscribers))
        });
        self.inbox = Some(inbox);
        Ok(())
    }

    fn close(&mut self) {
        if let Some(inbox) = self.inbox.take() {
            inbox.close();
        }
    }

    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        fds.extend(self.inbox.iter().map(|inbox| PollFd::new(inbox.as_ref(), PollFlags::IN)));
    }

    fn due_nanos(&self) -> Option<u64> {
        None
    }

    fn poll(&mut self, _now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError> {
        if let Some(event) = self.pending.take() {
            return Ok(Some(event));
        }
        let Some(inbox) = self.inbox.clone() else {
            return Ok(None);
        };
        let n_dropped = inbox.take_dropped();
        if n_dropped > 0 {
            let why = format!("{n_dropped} messages were dropped, because the source was too slow for them");
            return Ok(Some(Event::Refused(Refusal { kind: RefusalKind::Late, why })));
        }
        while let Some(((topic, received), at_nanos)) = inbox.take() {
            if let Some(event) = self.take(topic, received, at_nanos, place) {
                return Ok(Some(event));
            }
        }
        Ok(None)
    }

    fn refused(&mut self, _refusal: &Refusal, _now_nanos: u64) {}
}

fn phase_of(value: &Value) -> Result<Phase, String> {
    let word = value.at("data");
    let word = word.as_ref().and_then(Value::text).unwrap_or_default();
    serde_json::from_value(word.into()).map_err(|_| format!("'{word}' is no phase"))
}

/// The readings of the cells in a message: the numbers of a field, the pixels of an image, or a field of the points of a
/// cloud.
fn cells(value: &Value, field: &str) -> Result<Vec<f64>, String> {
    let is_big = || value.at("is_bigendian").and_then(|it| it.numbers()).is_some_and(|it| it.first() == Some(&1.0));
    let whole = |name: &str| {
        value
            .at(name)
            .and_then(|it| it.integer())
            .and_then(|it| usize::try_from(it).ok())
            .ok_or(format!("it has no {name}"))
    };
    if let (Some(encoding), Some(Value::Bytes(data))) = (value.at("encoding"), value.at("data")) {
        let encoding = encoding.text().unwrap_or_default().to_owned();
        let kind = match encoding.as_str() {
            "mono8" | "8UC1" => Scalar::U8,
            "mono16" | "16UC1" => Scalar::U16,
            "32FC1" => Scalar::F32,
            "64FC1" => Scalar::F64,
            _ => {
                return Err(format!("its encoding is {encoding}, expected mono8, mono16, 8UC1, 16UC1, 32FC1 or 64FC1"));
            }
        };
        let (height, width, step) = (whole("height")?, whole("width")?, whole("step")?);
        let offsets = (0..height).flat_map(|row| (0..width).map(move |column| (row, column)));
        return scalars(&data, offsets.map(|(row, column)| row * step + column * kind.n_bytes()), kind, is_big());
    }
    if let (Some(Value::List(fields)), Some(Value::Bytes(data))) = (value.at("fields"), value.at("data")) {
        let is_it = |found: &&Value| found.at("name").as_ref().and_then(Value::text) == Some(field);
        let found = fields.iter().find(is_it).ok_or_else(|| format!("its points have no field '{field}'"))?;
        let part = |name: &str| found.at(name).and_then(|it| it.integer()).unwrap_or(-1);
        let kind = match part("datatype") {
            2 => Scalar::U8,
            4 => Scalar::U16,
            7 => Scalar::F32,
            8 => Scalar::F64,
            other => return Err(format!("its field '{field}' has the datatype {other}, expected 2, 4, 7 or 8")),
        };
        let offset = usize::try_from(part("offset")).map_err(|_| "its field has no offset")?;
        let (n, step) = (whole("height")?.saturating_mul(whole("width")?), whole("point_step")?);
        return scalars(&data, (0..n).map(|point| point.saturating_mul(step).saturating_add(offset)), kind, is_big());
    }
    let found = value.at(field).ok_or_else(|| format!("it has no field '{field}'"))?;
    found.numbers().ok_or_else(|| format!("its field '{field}' is no number or list of numbers"))
}

#[derive(Clone, Copy)]
enum Scalar {
    U8,
    U16,
    F32,
    F64,
}

impl Scalar {
    fn n_bytes(self) -> usize {
        match self {
            Scalar::U8 => 1,
            Scalar::U16 => 2,
            Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }
}

/// The numbers at these offsets.
fn scalars(data: &[u8], offsets: impl Iterator<Item = usize>, kind: Scalar, is_big: bool) -> Result<Vec<f64>, String> {
    let n = kind.n_bytes();
    let mut numbers = Vec::new();
    for offset in offsets {
        let end = offset.checked_add(n);
        let bytes = end.and_then(|end| data.get(offset..end)).ok_or("its data are too short for its size")?;
        let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
        let bits = if is_big { bytes.iter().fold(0, add) } else { bytes.iter().rev().fold(0, add) };
        numbers.push(match kind {
            Scalar::U8 | Scalar::U16 => bits as f64,
            Scalar::F32 => f32::from_bits(bits as u32).into(),
            Scalar::F64 => f64::from_bits(bits),
        });
    }
    Ok(numbers)
}
