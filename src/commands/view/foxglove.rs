//! The samples of a graph for Foxglove: the topics of a recording, and standard messages from which it draws hand and contacts.

use std::time::{Duration, Instant};

use blindgrasp_graph::control::AttachedEdge;
use blindgrasp_messages::{Record, Recorded, of_each_type, with_sample};
use blindgrasp_operators::hand_markers;
use blindgrasp_recording::cdr;
use blindgrasp_stages::hand::Hand;
use blindgrasp_viewer::{Channel, Viewer};

/// The hand is drawn at most so often: its markers are large.
const MARKER_PAUSE: Duration = Duration::from_millis(33);
const MARKERS: &str = "/hand_markers";
const JOINTS: &str = "/joint_states";
const POINTS: &str = "/contact_points";

/// Turns samples into messages for the clients that want them.
pub(super) struct Streams {
    viewer: Viewer,
    hand: Option<Hand>,
    joint_names: Vec<String>,
    topics: Vec<String>,
    markers_due: Instant,
    /// The message at hand; kept for its memory.
    data: Vec<u8>,
}

/// Name, ROS 2 name and definition of a type.
fn described<M: Recorded>() -> (&'static str, &'static str, String) {
    (M::TYPE_NAME, M::SCHEMA, M::definition())
}

impl Streams {
    /// Advertises the topics of a graph.
    pub(super) fn begin(viewer: &Viewer, edges: &[AttachedEdge], hand: Option<&Hand>) -> Streams {
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
            (POINTS, "sensor_msgs/msg/PointCloud2"),
            (JOINTS, "sensor_msgs/msg/JointState"),
            (MARKERS, "visualization_msgs/msg/MarkerArray"),
        ];
        // Joints and markers need the hand.
        for (topic, schema) in &standard[..if hand.is_some() { 3 } else { 1 }] {
            let definition = blindgrasp_ros::standard::text(schema).unwrap_or_default();
            channels.push(Channel { topic: (*topic).into(), schema: (*schema).into(), definition });
        }
        let topics = channels.iter().map(|channel| channel.topic.clone()).collect();
        viewer.advertise(channels);
        Streams {
            viewer: viewer.clone(),
            hand: hand.cloned(),
            joint_names: hand.iter().flat_map(|hand| &hand.joints).map(|joint| joint.name.clone()).collect(),
            topics,
            markers_due: Instant::now(),
            data: Vec::new(),
        }
    }

    /// Sends a sample, and the standard messages that follow from it, if they are of the hand that is shown.
    pub(super) fn send(&mut self, topic: &str, record: &Record, is_shown: bool) {
        self.pass_on(topic, |_, data| with_sample!(record, sample => cdr::encode(sample, data)));
        match record {
            Record::Contacts(sample) if is_shown => {
                self.pass_on(POINTS, |_, data| cdr::contact_points(&sample.header, &sample.message, data));
            }
            Record::Tactile(sample) if is_shown && sample.message.joints.len() == self.joint_names.len() => {
                self.pass_on(JOINTS, |streams, data| {
                    cdr::joint_state(&sample.header, &streams.joint_names, &sample.message, data)
                });
                if Instant::now() >= self.markers_due {
                    self.markers_due = Instant::now() + MARKER_PAUSE;
                    self.pass_on(MARKERS, |streams, data| match &streams.hand {
                        Some(hand) => hand_markers(hand, sample, data),
                        None => Err("no hand".into()),
                    });
                }
            }
            _ => {}
        }
    }

    /// A message that cannot be made is left out: the samples of a graph were checked where they were made.
    fn pass_on(&mut self, topic: &str, make: impl FnOnce(&Streams, &mut Vec<u8>) -> Result<(), String>) {
        let Some(channel) = self.topics.iter().position(|known| known == topic) else { return };
        if !self.viewer.is_wanted(channel) {
            return;
        }
        let mut data = std::mem::take(&mut self.data);
        if make(self, &mut data).is_ok() {
            self.viewer.send_to_foxglove(channel, &data);
        }
        self.data = data;
    }
}
