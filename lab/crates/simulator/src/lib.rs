//! The simulator of grasps, their contacts, tactile readings and quality.
//!
//! ```
//! use blindgrasp_objects::select;
//! use blindgrasp_simulator::options::SimulatorOptions;
//! use blindgrasp_simulator::simulator::simulate_all;
//! use blindgrasp_stages::hand::Hand;
//!
//! let hand = Hand::load("barrett-bh8-280".as_ref())?;
//! let options = SimulatorOptions { n_grasps: 2, ..SimulatorOptions::default() };
//! let mut grasps = Vec::new();
//! let report = simulate_all(&hand, &select("bottle-00")?, &options, |grasp| {
//!     grasps.push(grasp);
//!     Ok::<(), std::convert::Infallible>(())
//! })?;
//! assert_eq!((report.n_grasps, grasps.len()), (2, 2));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The path of a candidate: an object of [`blindgrasp_objects`] and a random start (or the [`planner`]'s)
//! -> [`protocol`] (the palm comes, the fingers close; by the distances of [`distance`] and the joints of [`mechanism`]) ->
//! [`contact_points`] -> [`loaded_contacts`] ([`soft_finger`] patches, cell forces) -> [`wrench_space`] (over [`hull`]) ->
//! [`tactile_sensor`] (cell readings; of skins that spread force, [`skin`]). [`candidate`] connects these steps. [`simulator`] goes through the candidates of a
//! part and keeps those that fill the asked-for numbers of stable and unstable grasps; [`options`] has its options. With
//! the label `lift`, the physics of [`crate::trial`] replace the steps between the object and the label.
//!
//! Without physics this is a geometric simulator: the object does not move, nothing has mass or speed while the fingers
//! close, and links are rigid but for the contact patch.

pub mod candidate;
pub mod contact_points;
pub mod distance;
pub mod hull;
pub mod loaded_contacts;
pub mod mechanism;
pub(crate) mod option_check;
pub mod options;
pub mod pad_grid;
pub mod palm_frame;
pub mod planner;
pub mod protocol;
pub mod simulator;
pub mod skin;
pub mod soft_finger;
pub mod tactile_sensor;
pub mod touches;
pub mod trial;
pub mod wrench_space;

pub use option_check::OptionError;
