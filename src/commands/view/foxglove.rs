//! The samples of a graph for Foxglove, as messages of ROS 2.

use blindgrasp_graph::control::AttachedEdge;
use blindgrasp_messages::Record;
use blindgrasp_stages::hand::Hand;
use blindgrasp_viewer::Viewer;

use super::super::ros_messages::RosMessages;

/// Sends messages to the clients that want them.
pub(super) struct Streams {
    viewer: Viewer,
    messages: RosMessages,
}

impl Streams {
    /// Advertises the topics of a graph.
    pub(super) fn begin(viewer: &Viewer, edges: &[AttachedEdge], hand: Option<&Hand>) -> Streams {
        let messages = RosMessages::new(edges, hand);
        viewer.advertise(messages.channels.clone());
        Streams { viewer: viewer.clone(), messages }
    }

    /// Sends a sample, and the standard messages that follow from it.
    pub(super) fn send(&mut self, topic: &str, record: &Record) {
        for (channel, data) in self.messages.of(topic, record, |channel| self.viewer.is_wanted(channel)) {
            self.viewer.send_to_foxglove(channel, &data);
        }
    }
}
