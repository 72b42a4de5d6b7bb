//! Links, ROS 2 and Zenoh as their users run them.

#[path = "../../../tests/common/mod.rs"]
mod common;

mod link_identity;
mod link_security;
mod ros2;
mod ros2_access;
mod ros2_commands;
mod ros2_installed;
