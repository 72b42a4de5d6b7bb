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
use super::ros2_cells::cells;
use super::transforms::Transforms;
use blindgrasp_messages::{OwnedSenses, Phase, Sense};
use blindgrasp_ros::cdr::{self, Value};
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::network::Network;
use blindgrasp_ros::standard;
use blindgrasp_ros_node::node::{
    Convention, MAX_RECEIVED_BYTES, MessageType, Quality, Received, Rights, RosNode, open,
};
use blindgrasp_tactile::{Arrival, DriverError, Event, Place, Reading, Refusal, TactileDriver};

/// A sender that has sent nothing for so long gives way to another one.
const SILENT_NANOS: u64 = 2_000_000_000;

/// Transforms must be this near to the cells in time: `robot_state_publisher` sends 20 a second.
const TRANSFORM_NANOS: u64 = 100_000_000;
/// The static transforms of a publisher that come to a subscriber later.
const N_STATIC: usize = 100;
/// Angles of a topic that is slower than this are missed.
const SLOWEST_NANOS: u64 = 150_000_000;
const SEC_NANOS: u64 = 1_000_000_000;
/// Gravity at sea level, in metres per second squared.
const GRAVITY_M_PER_S2: f64 = 9.81;

/// The topics and how to read them.
#[derive(Debug, Clone)]
pub(crate) struct Topics {
    pub network: Network,
    pub convention: Convention,
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
    /// `tf2_msgs/msg/TFMessage`, and the frames that tell gravity: the z axis of the first points upwards, the second is the palm
    /// frame. The static transforms are on the topic of this name with `_static` behind it.
    pub gravity: Option<(String, [String; 2])>,
    /// The hand's joints, in the hand's order.
    pub hand_joints: Vec<JointTopic>,
    /// Joint angles and senses must be this near to the cells in time. Angles of a slower topic hold until the next one is due.
    pub tolerance_nanos: u64,
    /// A joint that is slower stands still, per second.
    pub still_per_s: f64,
}

/// A joint of the hand, as the topic has it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JointTopic {
    pub name: String,
    /// The joint's value is this times that of the topic, plus `offset`.
    pub scale: f64,
    /// Radians, or metres.
    pub offset: f64,
    /// The change of the joint's value while the hand closes by a radian; `None` for a joint that does not close.
    pub closing_rate: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Topic {
    Joints,
    Cells,
    Phase,
    Wrench,
    Imu,
    Transforms,
    StaticTransforms,
}

/// The last angle of a joint.
#[derive(Debug, Clone, Copy)]
struct JointAngle {
    /// Radians, or metres.
    value: f64,
    stamp_nanos: u64,
    sender: [u8; 16],
    at_nanos: u64,
    /// Time since the angle before, and the change since then.
    period_nanos: u64,
    change: f64,
}

impl JointAngle {
    /// Whether it holds for cells of that time, though it is older than the tolerance: the topic is slower than the cells, and the
    /// next angle is not due yet. Of a hand that holds an object, the joint must stand still.
    fn is_last_of_a_slow_topic(&self, cells_nanos: u64, is_held: bool, still_per_s: f64) -> bool {
        let due_nanos = (self.period_nanos + self.period_nanos / 2).min(SLOWEST_NANOS);
        let is_due = cells_nanos.saturating_sub(self.stamp_nanos) > due_nanos || cells_nanos < self.stamp_nanos;
        let stands = self.change.abs() <= still_per_s * self.period_nanos as f64 / SEC_NANOS as f64;
        !is_due && (stands || !is_held)
    }
}

/// Reads frames from topics of ROS 2.
pub(crate) struct Ros2 {
    topics: Topics,
    definitions: BTreeMap<Topic, (String, Definition, String)>,
    finder: PhaseFinder,
    inbox: Option<Arc<Inbox<(Topic, Received)>>>,
    joints: Vec<Option<JointAngle>>,
    /// The joint that two nodes sent, and when.
    contradiction: Option<(String, u64)>,
    /// The phase and its arrival; `None` until one is known.
    phase: Option<(Phase, u64)>,
    wrench: Option<(Vec<f64>, u64)>,
    gravity: Option<(Vec<f64>, u64)>,
    transforms: Transforms,
    senders: BTreeMap<Topic, ([u8; 16], u64)>,
    /// From the sender's numbers of frames to those of the source.
    offset: i128,
    pending: Option<Event>,
}

impl Ros2 {
    pub(crate) fn new(topics: Topics, finder: PhaseFinder) -> Self {
        let joints = vec![None; topics.hand_joints.len()];
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
        if let Some((topic, _)) = &topics.gravity {
            let definition = standard::definition("tf2_msgs/msg/TFMessage");
            add(Topic::Transforms, &Some(topic.clone()), definition.clone());
            add(Topic::StaticTransforms, &Some(format!("{topic}_static")), definition);
        }
        Ros2 {
            topics,
            definitions,
            finder,
            inbox: None,
            joints,
            contradiction: None,
            phase: None,
            wrench: None,
            gravity: None,
            transforms: Transforms::default(),
            senders: BTreeMap::new(),
            offset: 0,
            pending: None,
        }
    }

    fn take(&mut self, topic: Topic, received: Received, at_nanos: u64, place: &Place) -> Option<Event> {
        let sender = received.sender.unwrap_or_default();
        let (current, last_nanos) = *self.senders.get(&topic).unwrap_or(&(sender, 0));
        // Joint angles and transforms may come from several nodes, each with a part of them.
        let is_single = !matches!(topic, Topic::Joints | Topic::Transforms | Topic::StaticTransforms);
        if is_single && current != sender && at_nanos.saturating_sub(last_nanos) < SILENT_NANOS {
            return Some(Event::TurnedAway);
        }
        let is_new = self.senders.insert(topic, (sender, at_nanos)).is_none_or(|(before, _)| before != sender);
        let begins = topic == Topic::Cells && is_new;
        if begins {
            // A gap before its first frame: frames may be missing.
            let first = i128::from(received.seq.unwrap_or(0));
            self.offset = place.seq.map_or(0, |last| i128::from(last) + 2 - first);
            // The phase that an earlier sender left says nothing of this one's grasp.
            let is_given = self.topics.phase.is_some();
            self.phase = self.phase.filter(|(_, came_nanos)| !is_given || *came_nanos > last_nanos);
        }
        let event = self.take_known(topic, &received, at_nanos).unwrap_or_else(|why| {
            let why = format!("{}: {why}", self.definitions[&topic].0);
            Some(Event::Refused(Refusal::malformed(why)))
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
        if received.n_bytes > MAX_RECEIVED_BYTES {
            return Err(format!("it has {} bytes, expected at most {MAX_RECEIVED_BYTES}", received.n_bytes));
        }
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
            Topic::Joints => {
                self.take_joints(&value, received.sender.unwrap_or_default(), stamp_nanos, at_nanos)?;
            }
            Topic::Phase => self.phase = Some((phase_of(&value)?, at_nanos)),
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
            Topic::Transforms | Topic::StaticTransforms => {
                let is_static = topic == Topic::StaticTransforms;
                self.transforms.take(&value, is_static, received.sender.unwrap_or_default(), at_nanos);
            }
            Topic::Cells => return self.frame(&value, received, stamp, stamp_nanos, at_nanos).map(Some),
        }
        Ok(None)
    }

    fn take_joints(&mut self, value: &Value, sender: [u8; 16], stamp_nanos: u64, at_nanos: u64) -> Result<(), String> {
        let names = value.at("name");
        let names = names.as_ref().and_then(Value::texts).unwrap_or_default();
        let angles = value.at("position").and_then(|position| position.numbers()).unwrap_or_default();
        if angles.len() != names.len() {
            return Err(format!("{} names and {} positions", names.len(), angles.len()));
        }
        for wanted in &self.topics.hand_joints {
            if names.iter().filter(|name| **name == wanted.name).count() > 1 {
                return Err(format!("joint '{}' stands in it twice: one node must send each joint once", wanted.name));
            }
        }
        let mut has_any = false;
        for (wanted, joint) in self.topics.hand_joints.iter().zip(&mut self.joints) {
            if let Some(idx) = names.iter().position(|name| *name == wanted.name) {
                let value = wanted.scale * angles[idx] + wanted.offset;
                let before = joint.filter(|before| before.sender == sender && before.stamp_nanos <= stamp_nanos);
                if joint.is_some_and(|other| {
                    other.sender != sender && at_nanos.saturating_sub(other.at_nanos) < SILENT_NANOS
                }) {
                    self.contradiction = Some((wanted.name.clone(), at_nanos));
                }
                let (period_nanos, change) = before.map_or((0, f64::INFINITY), |before| {
                    match stamp_nanos - before.stamp_nanos {
                        // A message that repeats an angle says nothing new.
                        0 => (before.period_nanos, before.change),
                        period_nanos => (period_nanos, value - before.value),
                    }
                });
                *joint = Some(JointAngle { value, stamp_nanos, sender, at_nanos, period_nanos, change });
                has_any = true;
            }
        }
        if has_any && self.topics.phase.is_none() {
            let joints = self.topics.hand_joints.iter().zip(&self.joints);
            let fingers = joints.filter_map(|(it, joint)| Some((it.closing_rate?, joint)));
            let fingers: Option<Vec<f64>> =
                fingers.map(|(rate, joint)| joint.map(|joint| joint.value / rate)).collect();
            if let Some(fingers) = fingers {
                self.phase = Some((self.finder.phase(stamp_nanos, &fingers), at_nanos));
            }
        }
        Ok(())
    }

    /// Gravity in the palm frame by the transforms, if these are its source.
    ///
    /// # Errors
    /// They do not tell it, for a person.
    fn take_gravity(&mut self, stamp_nanos: u64, at_nanos: u64) -> Result<(), String> {
        let Some((topic, [upright, palm])) = &self.topics.gravity else { return Ok(()) };
        let palm_from_upright = self.transforms.rotation(palm, upright, stamp_nanos, TRANSFORM_NANOS, at_nanos);
        let palm_from_upright = palm_from_upright.ok_or_else(|| {
            format!(
                "gravity is not known: the transforms of {topic} and {topic}_static do not lead from frame '{palm}' up to \
                 '{upright}', each from one node and within 0.1 s of the cells"
            )
        })?;
        let gravity = palm_from_upright * nalgebra::Vector3::new(0.0, 0.0, -GRAVITY_M_PER_S2);
        self.gravity = Some((gravity.as_slice().to_vec(), stamp_nanos));
        Ok(())
    }

    fn frame(
        &mut self,
        value: &Value,
        received: &Received,
        stamp: Option<u64>,
        stamp_nanos: u64,
        at_nanos: u64,
    ) -> Result<Event, String> {
        let cells_newtons = cells(value, &self.topics.cells_field)?;
        self.take_gravity(stamp_nanos, at_nanos)?;
        let joints = self.joints_at(stamp_nanos, at_nanos)?;
        let (phase, _) = self
            .phase
            .ok_or_else(|| format!("no phase has come on {}", self.topics.phase.as_deref().unwrap_or_default()))?;
        let gravity_topic = self.topics.imu.as_ref().or(self.topics.gravity.as_ref().map(|(topic, _)| topic));
        let named = [
            (Sense::Gravity, gravity_topic, &self.gravity),
            (Sense::WristWrench, self.topics.wrench.as_ref(), &self.wrench),
        ];
        let mut senses = OwnedSenses::default();
        // A frame has all senses that the parameters name: a model must not decide without one.
        for (sense, topic, last) in named {
            match (topic, last) {
                (None, _) => {}
                (Some(_), Some((values, at))) if self.are_near(*at, stamp_nanos) => senses.set(sense, values),
                (Some(topic), _) => {
                    return Err(format!("no message of {topic} has come that is near the cells in time"));
                }
            }
        }
        let seq = received.seq.and_then(|seq| u64::try_from(i128::from(seq) + self.offset).ok());
        let reading = Reading { joints, cells_newtons, phase, senses, seq, stamp_nanos: stamp, ..Reading::default() };
        Ok(Event::Frame(reading, Arrival { at_nanos, waited_nanos: 0 }))
    }

    fn are_near(&self, nanos: u64, other_nanos: u64) -> bool {
        nanos.abs_diff(other_nanos) <= self.topics.tolerance_nanos
    }

    /// The joints of a frame.
    ///
    /// # Errors
    /// An angle is missing, too old or contradicted, for a person.
    fn joints_at(&self, stamp_nanos: u64, at_nanos: u64) -> Result<Vec<f64>, String> {
        if let Some((joint, since)) = &self.contradiction
            && at_nanos.saturating_sub(*since) < SILENT_NANOS
        {
            return Err(format!(
                "two nodes send the angle of joint '{joint}' on {}: end one of them (joint_state_publisher beside the hand's own \
                 driver?), or give another joints_topic",
                self.topics.joints
            ));
        }
        let is_held = self.phase.is_none_or(|(phase, _)| !matches!(phase, Phase::Open | Phase::Closing));
        let mut joints = Vec::with_capacity(self.joints.len());
        for (JointTopic { name, .. }, joint) in self.topics.hand_joints.iter().zip(&self.joints) {
            let angle =
                joint.ok_or_else(|| format!("no angle of joint '{name}' has come on {}", self.topics.joints))?;
            let is_slow = angle.is_last_of_a_slow_topic(stamp_nanos, is_held, self.topics.still_per_s);
            if !(self.are_near(angle.stamp_nanos, stamp_nanos) || is_slow) {
                let distance_nanos = angle.stamp_nanos.abs_diff(stamp_nanos);
                let [distance_ms, tolerance_ms, period_ms] =
                    [distance_nanos, self.topics.tolerance_nanos, angle.period_nanos].map(|nanos| nanos as f64 / 1e6);
                return Err(format!(
                    "the angle of joint '{name}' is {distance_ms:.1} ms from the cells in time, tolerance_ms is \
                     {tolerance_ms:.1}, and {} comes each {period_ms:.1} ms",
                    self.topics.joints
                ));
            }
            joints.push(angle.value);
        }
        Ok(joints)
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
            let takes = wanted.iter().map(|(_, name, _)| topics.convention.key(topics.domain, name)).collect();
            let rights = Rights { takes, ..Rights::default() };
            let session = open(&topics.network, &rights).map_err(|error| error.to_string())?;
            let node =
                RosNode::new(session, topics.convention, topics.domain, &topics.namespace, "blindgrasp_tactile_source");
            let mut node = node.map_err(|error| error.to_string())?;
            let mut subscribers = Vec::new();
            for (topic, name, message) in &wanted {
                let (topic, inbox) = (*topic, Arc::clone(inbox));
                let quality =
                    if topic == Topic::StaticTransforms { Quality::KeepLast(N_STATIC) } else { Quality::Sensor };
                let subscriber = node.subscriber(name, message, quality, move |received| {
                    let n_bytes = received.bytes.len();
                    // Only cells complete a frame.
                    inbox.put((topic, received), n_bytes, topic == Topic::Cells);
                });
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
        let Some(inbox) = self.inbox.clone() else { return Ok(None) };
        loop {
            match inbox.next() {
                Ok(None) => return Ok(None),
                Ok(Some(((topic, received), at_nanos))) => {
                    if let Some(event) = self.take(topic, received, at_nanos, place) {
                        return Ok(Some(event));
                    }
                }
                Err(refusal) => return Ok(Some(Event::Refused(refusal))),
            }
        }
    }

    fn refused(&mut self, _refusal: &Refusal, _now_nanos: u64) {}
}

fn phase_of(value: &Value) -> Result<Phase, String> {
    let word = value.at("data");
    let word = word.as_ref().and_then(Value::text).unwrap_or_default();
    serde_json::from_value(word.into()).map_err(|_| format!("'{word}' is no phase"))
}

#[cfg(test)]
mod tests {
    use blindgrasp_recording::cdr::encode;
    use serde::Serialize;

    use super::*;

    fn joint(name: &str) -> JointTopic {
        JointTopic { name: name.into(), scale: 1.0, offset: 0.0, closing_rate: Some(1.0) }
    }

    /// A driver for a hand with the joints `a` and `b`, whose cells have this type.
    fn driver(cells_type: &str, cells_field: &str) -> Ros2 {
        let topics = Topics {
            network: Network::default(),
            convention: Convention::default(),
            domain: 0,
            namespace: "/".into(),
            joints: "/joint_states".into(),
            cells: "/cells".into(),
            cells_definition: standard::definition(cells_type).expect("known"),
            cells_field: cells_field.into(),
            phase: Some("/phase".into()),
            wrench: Some("/wrench".into()),
            imu: Some("/imu".into()),
            gravity: None,
            hand_joints: vec![joint("a"), joint("b")],
            tolerance_nanos: 20_000_000,
            still_per_s: 0.05,
        };
        Ros2::new(topics, PhaseFinder::new(0.05, 200_000_000))
    }

    type Header = (i32, u32, &'static str);

    fn header(nanos: u64) -> Header {
        ((nanos / SEC_NANOS) as i32, (nanos % SEC_NANOS) as u32, "palm")
    }

    /// A message as the driver expects it on a topic, sent and received at this time.
    fn message(driver: &Ros2, topic: Topic, value: &impl Serialize, nanos: u64) -> Received {
        let (_, definition, hash) = &driver.definitions[&topic];
        let mut bytes = Vec::new();
        encode(value, &mut bytes).expect("CDR");
        Received {
            message: MessageType { name: definition.name.clone(), hash: hash.clone() },
            n_bytes: bytes.len(),
            bytes,
            source_nanos: Some(nanos),
            seq: None,
            sender: Some([1; 16]),
        }
    }

    fn joints(driver: &Ros2, names: &[&str], angles: &[f64], nanos: u64) -> Received {
        message(driver, Topic::Joints, &(header(nanos), names, angles, [0.0; 0].as_slice(), [0.0; 0].as_slice()), nanos)
    }

    fn floats(driver: &Ros2, values: &[f64], nanos: u64, seq: u64) -> Received {
        let layout: (Vec<()>, u32) = (vec![], 0);
        Received { seq: Some(seq), ..message(driver, Topic::Cells, &(layout, values), nanos) }
    }

    fn take(driver: &mut Ros2, topic: Topic, received: Received, at: u64, last: Option<u64>) -> Option<Event> {
        driver.take(topic, received, at, &Place { seq: last, ..Place::default() })
    }

    fn why(event: Option<Event>) -> String {
        match event {
            Some(Event::Refused(Refusal { why, .. })) => why,
            other => panic!("expected a refusal, found {other:?}"),
        }
    }

    #[test]
    fn a_frame_has_the_joints_by_name_and_the_senses_that_are_near() {
        let mut driver = driver("std_msgs/msg/Float64MultiArray", "data");
        let t = 5 * SEC_NANOS;
        let early = floats(&driver, &[1.0], t, 7);
        assert_eq!(take(&mut driver, Topic::Cells, early, t, None), Some(Event::Began));
        assert!(why(driver.pending.take()).contains("no angle of joint 'a' has come"));
        // The joints come in two messages, in another order, with one of the arm.
        let second = joints(&driver, &["elbow", "b"], &[9.0, 0.2], t);
        let first = joints(&driver, &["a"], &[0.1], t);
        assert_eq!(take(&mut driver, Topic::Joints, second, t, None), None);
        assert_eq!(take(&mut driver, Topic::Joints, first, t, None), None);
        let wrench = message(&driver, Topic::Wrench, &(header(t), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), t);
        assert_eq!(take(&mut driver, Topic::Wrench, wrench, t, None), None);
        let covariance = [0.0; 9];
        let imu = (header(t), [0.0; 4], covariance, [0.0; 3], covariance, [0.0, 0.0, 9.8], covariance);
        let imu = message(&driver, Topic::Imu, &imu, t);
        assert_eq!(take(&mut driver, Topic::Imu, imu, t, None), None);
        let phase = message(&driver, Topic::Phase, &"settled", t);
        assert_eq!(take(&mut driver, Topic::Phase, phase, t, None), None);
        let frame = floats(&driver, &[1.0, 2.0], t, 8);
        let Some(Event::Frame(reading, _)) = take(&mut driver, Topic::Cells, frame, t, None) else {
            panic!("no frame");
        };
        assert_eq!((reading.joints, reading.cells_newtons), (vec![0.1, 0.2], vec![1.0, 2.0]));
        assert_eq!(reading.senses.get(Sense::WristWrench), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(reading.senses.get(Sense::Gravity), [0.0, 0.0, -9.8]);
        assert_eq!((reading.phase, reading.seq, reading.stamp_nanos), (Phase::Settled, Some(8), Some(t)));
        // A frame without a sense that the parameters name is refused.
        driver.wrench = None;
        let lacking = floats(&driver, &[1.0, 2.0], t, 9);
        assert!(why(take(&mut driver, Topic::Cells, lacking, t, Some(8))).contains("no message of /wrench has come"));
        // Angles of another time are no angles, and a lost message leaves a gap in the numbers.
        let later = t + 30_000_000;
        let old = floats(&driver, &[1.0], later, 9);
        assert!(
            why(take(&mut driver, Topic::Cells, old, later, Some(8))).contains("is 30.0 ms from the cells in time")
        );
    }

    /// A driver of joints and cells alone, whose phase is this.
    fn plain(phase: &str) -> Ros2 {
        let mut topics = driver("std_msgs/msg/Float64MultiArray", "data").topics;
        (topics.imu, topics.wrench) = (None, None);
        let mut driver = Ros2::new(topics, PhaseFinder::new(0.05, 200_000_000));
        let phase = message(&driver, Topic::Phase, &phase, SEC_NANOS);
        assert_eq!(take(&mut driver, Topic::Phase, phase, SEC_NANOS, None), None);
        driver
    }

    #[test]
    fn angles_of_a_slow_topic_hold_until_the_next_ones_are_due() {
        let millis = 1_000_000;
        // Each 40 ms; the joints move, or stand.
        for (phase, moves, age, is_taken) in [
            ("settled", false, 38, true),
            ("settled", true, 38, false),
            ("settled", true, 19, true),
            ("closing", true, 38, true),
            ("settled", false, 70, false),
        ] {
            let mut driver = plain(phase);
            let mut t = 5 * SEC_NANOS;
            for step in 0..3 {
                t += 40 * millis;
                let angle = if moves { 0.1 * f64::from(step) } else { 0.1 };
                let angles = joints(&driver, &["a", "b"], &[angle, 0.2], t);
                assert_eq!(take(&mut driver, Topic::Joints, angles, t, None), None);
            }
            let at = t + age * millis;
            let frame = floats(&driver, &[1.0, 2.0], at, 8);
            assert_eq!(take(&mut driver, Topic::Cells, frame, at, Some(7)), Some(Event::Began));
            match driver.pending.take() {
                Some(Event::Frame(..)) => assert!(is_taken, "{phase} {moves} {age}"),
                other => {
                    let why = why(other);
                    assert!(!is_taken && why.contains("tolerance_ms is 20.0") && why.contains("each 40.0 ms"), "{why}");
                }
            }
        }
    }

    #[test]
    fn two_nodes_that_send_one_joint_are_told() {
        let mut driver = plain("settled");
        let t = 5 * SEC_NANOS;
        let sent = |driver: &mut Ros2, sender: u8, names: [&str; 2], at: u64, seq: u64| {
            let angles = Received { sender: Some([sender; 16]), ..joints(driver, &names, &[0.1, 0.2], at) };
            assert_eq!(take(driver, Topic::Joints, angles, at, None), None);
            let frame = floats(driver, &[1.0, 2.0], at, seq);
            let event = take(driver, Topic::Cells, frame, at, Some(seq - 1));
            if event == Some(Event::Began) { driver.pending.take() } else { event }
        };
        assert!(why(sent(&mut driver, 1, ["a", "elbow"], t, 8)).contains("no angle of joint 'b'"));
        assert!(
            matches!(sent(&mut driver, 2, ["b", "wrist"], t, 9), Some(Event::Frame(..))),
            "each joint has one node"
        );
        let told = why(sent(&mut driver, 3, ["a", "elbow"], t, 10));
        assert!(told.contains("two nodes send the angle of joint 'a' on /joint_states"), "{told}");
        let later = t + 3 * SEC_NANOS;
        let is_old = why(sent(&mut driver, 3, ["a", "elbow"], later, 11));
        assert!(is_old.contains("the angle of joint 'b' is 3000.0 ms"), "one of them has ended: {is_old}");
        assert!(matches!(sent(&mut driver, 3, ["a", "b"], later, 12), Some(Event::Frame(..))));
    }

    #[test]
    fn transforms_tell_gravity_while_they_are_new() {
        let mut topics = driver("std_msgs/msg/Float64MultiArray", "data").topics;
        (topics.imu, topics.wrench) = (None, None);
        topics.gravity = Some(("/tf".into(), ["world".into(), "palm".into()]));
        let mut driver = Ros2::new(topics, PhaseFinder::new(0.05, 200_000_000));
        let t = 5 * SEC_NANOS;
        let turned = std::f64::consts::FRAC_1_SQRT_2;
        // The arm is turned by 90 degrees about x; the palm is fixed to it, turned by 90 degrees about z.
        let transform = |parent: &'static str, child: &'static str, xyzw: [f64; 4], nanos: u64| {
            vec![(((nanos / SEC_NANOS) as i32, (nanos % SEC_NANOS) as u32, parent), child, [0.1, 0.2, 0.3], xyzw)]
        };
        let arm = message(&driver, Topic::Transforms, &(transform("world", "arm", [turned, 0.0, 0.0, turned], t),), t);
        let palm = transform("arm", "palm", [0.0, 0.0, turned, turned], 0);
        let palm = message(&driver, Topic::StaticTransforms, &(palm,), t);
        let gravity = |driver: &mut Ros2, nanos: u64| {
            let angles = joints(driver, &["a", "b"], &[0.1, 0.2], nanos);
            take(driver, Topic::Joints, angles, nanos, None);
            let settled = message(driver, Topic::Phase, &"settled", nanos);
            take(driver, Topic::Phase, settled, nanos, None);
            let cells = floats(driver, &[1.0], nanos, nanos);
            let event = take(driver, Topic::Cells, cells, nanos, None);
            match driver.pending.take().or(event) {
                Some(Event::Frame(reading, _)) => Ok(reading.senses.get(Sense::Gravity).to_vec()),
                refused => Err(why(refused)),
            }
        };
        take(&mut driver, Topic::StaticTransforms, palm, t, None);
        let refused = gravity(&mut driver, t).expect_err("no transform of the arm");
        assert!(refused.contains("do not lead from frame 'palm' up to 'world'"), "{refused}");
        take(&mut driver, Topic::Transforms, arm, t, None);
        let found = gravity(&mut driver, t + 100_000_000).expect("gravity");
        // In the arm's frame gravity is along -y, in the palm's along -x.
        assert!(found.iter().zip([-9.81, 0.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        assert!(gravity(&mut driver, t + SEC_NANOS).is_err());
    }

    #[test]
    fn a_jaw_whose_value_falls_closes() {
        let mut driver = driver("std_msgs/msg/Float64MultiArray", "data");
        driver.topics.phase = None;
        // 0.1 m count as a radian: 20 mm/s are a speed of 0.2 rad/s.
        driver.topics.hand_joints = vec![JointTopic { closing_rate: Some(-0.1), ..joint("jaw") }];
        driver.joints = vec![None];
        let mut phases = Vec::new();
        for step in 0..20 {
            let (nanos, jaw) = (SEC_NANOS + step * 60_000_000, 0.04 - 0.0012 * step.min(8) as f64);
            let joints = joints(&driver, &["jaw"], &[jaw], nanos);
            assert!(take(&mut driver, Topic::Joints, joints, nanos, None).is_none());
            phases.push(driver.phase.expect("a phase").0);
        }
        phases.dedup();
        assert_eq!(phases, [Phase::Open, Phase::Closing, Phase::Settled]);
    }

    #[test]
    fn another_sender_waits_until_the_first_is_silent_and_leaves_a_gap() {
        let mut driver = driver("std_msgs/msg/Float64MultiArray", "data");
        (driver.topics.imu, driver.topics.wrench) = (None, None);
        let t = 5 * SEC_NANOS;
        let angles = joints(&driver, &["a", "b"], &[0.1, 0.2], t);
        take(&mut driver, Topic::Joints, angles, t, None);
        let settled = message(&driver, Topic::Phase, &"settled", t);
        take(&mut driver, Topic::Phase, settled, t, None);
        let first = floats(&driver, &[1.0], t, 100);
        assert_eq!(take(&mut driver, Topic::Cells, first, t, None), Some(Event::Began));
        let other = |driver: &Ros2| Received { sender: Some([2; 16]), ..floats(driver, &[1.0], t, 3) };
        let second = other(&driver);
        assert_eq!(take(&mut driver, Topic::Cells, second, t + SEC_NANOS, Some(100)), Some(Event::TurnedAway));
        let second = other(&driver);
        assert_eq!(take(&mut driver, Topic::Cells, second, t + 3 * SEC_NANOS, Some(100)), Some(Event::Began));
        assert_eq!(why(driver.pending.take()), "/cells: no phase has come on /phase");
        let open = Received { sender: Some([2; 16]), ..message(&driver, Topic::Phase, &"open", t) };
        assert_eq!(take(&mut driver, Topic::Phase, open, t + 3 * SEC_NANOS, Some(100)), None);
        let next = Received { seq: Some(4), ..other(&driver) };
        let frame = take(&mut driver, Topic::Cells, next, t + 3 * SEC_NANOS, Some(100));
        // 102 was the refused one.
        assert!(matches!(frame, Some(Event::Frame(Reading { seq: Some(103), .. }, _))), "{frame:?}");
    }

    #[test]
    fn messages_of_other_fields_or_lengths_are_refused() {
        let mut driver = driver("std_msgs/msg/Float64MultiArray", "data");
        let good = floats(&driver, &[1.0], 1, 1);
        take(&mut driver, Topic::Cells, good.clone(), 1, None);
        driver.pending = None;
        let mut refused = |received: Received| why(take(&mut driver, Topic::Cells, received, 1, None));
        let other_hash = MessageType { hash: "RIHS01_00".into(), ..good.message.clone() };
        assert!(refused(Received { message: other_hash, ..good.clone() }).contains("has other fields: the hash is"));
        assert!(refused(Received { bytes: vec![1; 7], ..good.clone() }).contains("it is no plain CDR"));
        assert!(refused(Received { bytes: vec![0, 1, 0, 0, 9], ..good.clone() }).contains("it ends within"));
        let large = Received { bytes: vec![], n_bytes: 10 << 20, ..good };
        assert!(refused(large).contains("it has 10485760 bytes"));
        let torn = joints(&driver, &["a", "b"], &[0.1], 1);
        assert_eq!(why(take(&mut driver, Topic::Joints, torn, 1, None)), "/joint_states: 2 names and 1 positions");
        let twice = joints(&driver, &["a", "a"], &[0.1, 0.2], 1);
        assert_eq!(
            why(take(&mut driver, Topic::Joints, twice, 1, None)),
            "/joint_states: joint 'a' stands in it twice: one node must send each joint once"
        );
        let phase = message(&driver, Topic::Phase, &"asleep", 1);
        assert_eq!(why(take(&mut driver, Topic::Phase, phase, 1, None)), "/phase: 'asleep' is no phase");
    }
}
