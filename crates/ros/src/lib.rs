//! The world outside of a graph, without a network.
//!
//! * [`standard`] - the definitions of the standard messages of ROS 2 that blindgrasp writes.
//! * [`network`] - the endpoints and certificates of a connection over Zenoh.

pub mod network;
pub mod standard;
