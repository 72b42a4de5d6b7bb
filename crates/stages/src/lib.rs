//! The science that runs online: pure functions of their inputs, without a clock and without input or output.
//!
//! * [`hand`] - any hand, from a URDF and a pad layout: kinematics, cells, self-collision.
//! * [`contacts`], [`encoder`] (with [`dictionary`] and [`histogram`]), [`classifier`], [`lift_arbiter`] - the stages.
//! * [`out_of_distribution`] - whether a grasp is like those that the model was trained on.
//! * [`model`] - the model file. [`recipe`] and [`training_summary`] - how a model was trained, as the file says.
//! * [`promise_monitor`] - whether lifts drop more often than was promised.
//!
//! Units are SI and `f64` throughout. Frames are named target first: `palm_from_link`. Every contact is in the
//! **palm frame**: its origin the centre of the palm pad's surface, +z out of the palm.

pub mod approach;
pub mod classifier;
pub mod contacts;
pub mod day;
mod decided;
pub mod dictionary;
pub mod encoder;
pub mod hand;
pub mod histogram;
pub mod label;
pub mod lift_arbiter;
pub mod model;
pub mod out_of_distribution;
pub mod probe;
pub mod promise_monitor;
pub mod recipe;
pub mod sensors;
pub mod training_summary;
