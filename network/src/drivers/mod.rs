//! Drivers of `tactile_source` that speak Zenoh: topics of ROS 2, and frames on a key.

mod inbox;
pub(crate) mod phases;
pub(crate) mod ros2;
mod ros2_cells;
mod transforms;
pub(crate) mod zenoh_key;
