//! The samples of a graph as messages of ROS 2: those of recordings, and standard ones from which other programs draw hand,
//! cells and contacts.

use std::time::{Duration, Instant};

use blindgrasp_graph::control::AttachedEdge;
use blindgrasp_messages::{Record, Recorded, of_each_type, with_sample};
use blindgrasp_operators::{cell_points, hand_markers};
use blindgrasp_recording::cdr;
use blindgrasp_stages::hand::Hand;
use blindgrasp_viewer::Channel;

/// The definition of `visualization_msgs/msg/MarkerArray`, with those of the types in it.
const MARKER_ARRAY: &str = include_str!("marker_array.msg");
/// The hand is drawn at most so often: its markers are large.
const MARKER_PAUSE: Duration = Duration::from_millis(33);
const POINTS: &str = "/contact_points";
const JOINTS: &str = "/joint_states";
const CELLS: &str = "/cell_points";
const MARKERS: &str = "/hand_markers";

/// Turns samples into messages.
pub(super) struct RosMessages {
    pub(super) channels: Vec<Channel>,
    hand: Option<Hand>,
    hand_id: Option<u64>,
    joint_names: Vec<String>,
    markers_due: Instant,
}

/// Name, ROS 2 name and definition of a type.
fn described<M: Recorded>() -> (&'static str, &'static str, String) {
    (M::TYPE_NAME, M::SCHEMA, M::definition())
}

impl RosMessages {
    /// The channels of a graph. Joints, cells and markers need the hand.
    pub(super) fn new(edges: &[AttachedEdge], hand: Option<&Hand>) -> RosMessages {
        let types = of_each_type!(described);
        let mut channels: Vec<Channel> = Vec::new();
        for edge in edges {
            let known = types.iter().find(|(name, ..)| *name == edge.input.service.type_name);
            if let Some((_, schema, definition)) = known
                && !channels.iter().any(|channel| channel.topic == edge.topic)
            {
                let (schema, definition) = ((*schema).into(), definition.clone());
                channels.push(Channel { topic: edge.topic.clone(), schema, definition });
            }
        }
        let standard = [
            (POINTS, "sensor_msgs/msg/PointCloud2", cdr::POINT_CLOUD),
            (JOINTS, "sensor_msgs/msg/JointState", cdr::JOINT_STATE),
            (CELLS, "sensor_msgs/msg/PointCloud2", cdr::POINT_CLOUD),
            (MARKERS, "visualization_msgs/msg/MarkerArray", MARKER_ARRAY),
        ];
        for (topic, schema, definition) in &standard[..if hand.is_some() { 4 } else { 1 }] {
            let (topic, schema) = ((*topic).into(), (*schema).into());
            channels.push(Channel { topic, schema, definition: (*definition).into() });
        }
        let joint_names = hand.iter().flat_map(|hand| &hand.joints).map(|joint| joint.name.clone()).collect();
        let hand_id = hand.map(Hand::id);
        RosMessages { channels, hand: hand.cloned(), hand_id, joint_names, markers_due: Instant::now() }
    }

    /// The wanted messages of a sample, each with the place of its channel and in CDR. The standard ones are there if the sample
    /// is of this hand: a graph may have several. A message that cannot be made is left out: the samples of a graph were checked where they
    /// were made.
    pub(super) fn of(
        &mut self,
        topic: &str,
        record: &Record,
        is_wanted: impl Fn(usize) -> bool,
    ) -> Vec<(usize, Vec<u8>)> {
        // 0 stands for an unknown hand.
        let hand_id = record.header().hand_id;
        let is_shown = hand_id == 0 || self.hand_id.is_none_or(|shown| shown == hand_id);
        let channels = &self.channels;
        let mut messages = Vec::new();
        let mut add = |topic: &str, make: &dyn Fn(&mut Vec<u8>) -> Result<(), String>| {
            let channel = channels.iter().position(|channel| channel.topic == topic);
            let mut data = Vec::new();
            if let Some(channel) = channel
                && is_wanted(channel)
                && make(&mut data).is_ok()
            {
                messages.push((channel, data));
            }
        };
        add(topic, &|data| with_sample!(record, sample => cdr::encode(sample, data)));
        match record {
            Record::Contacts(sample) if is_shown => {
                add(POINTS, &|data| cdr::contact_points(&sample.header, &sample.message, data));
            }
            Record::Tactile(sample) if is_shown && sample.message.joints.len() == self.joint_names.len() => {
                add(JOINTS, &|data| cdr::joint_state(&sample.header, &self.joint_names, &sample.message, data));
                let Some(hand) = &self.hand else { return messages };
                add(CELLS, &|data| cell_points(hand, sample, data));
                if Instant::now() >= self.markers_due {
                    self.markers_due = Instant::now() + MARKER_PAUSE;
                    add(MARKERS, &|data| hand_markers(hand, sample, data));
                }
            }
            _ => {}
        }
        messages
    }
}
