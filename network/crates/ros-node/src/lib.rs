//! A node of ROS 2 without ROS: publishers, subscribers and services over Zenoh, by the conventions of rmw_zenoh (Jazzy, Kilted).
//!
//! * [`node`] - a node that other nodes see, with tokens, attachments and qualities of service.

mod access;
pub mod node;
