//! The offline half's ground truth: a simulator of blind grasps, their contacts, tactile readings and quality.
//!
//! The path of a candidate: an object of [`objects`] (built in, or a [`mesh`]) and a random start (or the [`planner`]'s)
//! -> [`protocol`] (the palm comes, the fingers close, by the distances of [`gap`] and the joints of [`mechanism`]) ->
//! [`contact_points`] -> [`pressed`] ([`soft_finger`] patches, cell forces) -> [`wrench_space`] (over [`hull`]: stable?) ->
//! [`tactile_sensor`] (what the cells would have said); [`candidate`] holds these together. [`simulator`] goes through
//! the candidates of a part and keeps those that fill the asked-for numbers of stable and unstable grasps. By option the
//! physics of [`crate::trial`] take the place of all between the object and the label ([`simulator::Label`]).
//!
//! Whether a grasp is stable, without its quality, is told by [`weak_direction`] and [`inner_ball`] without a hull.
//! [`quality_metrics`] are further qualities for users, [`case_file`] how they give their grasps.
//!
//! Otherwise it is a geometric simulator: the object does not move, nothing has mass or speed while the fingers close, links are
//! rigid but for the contact patch.

pub mod candidate;
pub mod case_file;
pub mod contact_points;
pub mod gap;
pub mod hull;
pub mod inner_ball;
mod lifted;
pub mod mechanism;
pub mod planner;
pub mod pressed;
pub mod protocol;
pub mod quality_metrics;
pub mod simulator;
pub mod soft_finger;
pub mod tactile_sensor;
pub mod trial;
pub mod weak_direction;
pub mod wrench_space;
