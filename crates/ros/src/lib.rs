//! ROS 2 without ROS: messages by their definitions. Nodes are in the network's house.
//!
//! ```
//! use blindgrasp_ros::definition::Definition;
//!
//! let definition = Definition::parse("std_msgs/msg/String", "string data")?;
//! assert_eq!(definition.hash(), "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18");
//! # Ok::<(), blindgrasp_ros::definition::DefinitionError>(())
//! ```
//!
//! * [`definition`] - parses definitions as recordings carry them, and computes the hash that names a type (RIHS01).
//! * [`cdr`] - reads any message whose definition is known into a [`cdr::Value`].
//! * [`standard`] - the definitions of the standard messages that blindgrasp reads.
//! * [`network`] - the endpoints and keys of a connection to other nodes.

pub mod cdr;
pub mod definition;
pub mod network;
pub mod standard;
