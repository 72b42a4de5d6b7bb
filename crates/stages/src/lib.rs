//! The science that runs online: whether a grasp will hold, from tactile cells and joint angles.
//!
//! [`Judge`] is all that most programs need. It checks that hand and model belong together, remembers what the model
//! needs of earlier frames, and decides each grasp once, LIFT or HOLD with its [`Reason`]:
//!
//! ```
//! use blindgrasp_stages::{Action, Hand, Judge, Model, Phase, Reason, TactileFrame};
//!
//! let hand = Hand::load("barrett-bh8-280".as_ref())?;
//! let model = Model::load("../../models/barrett-bh8-280.json".as_ref())?;
//! let closed_on_nothing = TactileFrame {
//!     grasp_id: 1,
//!     phase: Phase::Settled,
//!     joints: vec![0.5; hand.joints.len()],
//!     cells_newtons: vec![0.0; hand.n_cells()],
//!     ..TactileFrame::default()
//! };
//!
//! let mut judge = Judge::new(hand, model)?;
//! let decisions = judge.frame(0, &closed_on_nothing);
//! assert_eq!(decisions.len(), 1, "decided at once: no cell feels anything");
//! assert_eq!((decisions[0].action, decisions[0].reason), (Action::Hold, Reason::NoContact));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The modules are the parts of it. All are pure functions of their inputs, without a clock and without input or output
//! besides the files of hand and model; none starts a thread or needs shared memory. Learning is in
//! `blindgrasp_learning`.
//!
//! * [`hand`] - any hand, from a URDF and a pad layout: kinematics, cells, self-collision.
//! * [`contacts`], [`encoder`] (with [`dictionary`] and [`histogram`]), [`classifier`], [`lift_arbiter`] (with [`lift_watch`]) - the
//!   stages. [`steps`] - the first three, from message to message.
//! * [`out_of_distribution`] - whether a grasp is like those that the model was trained on.
//! * [`odd_readings`] and [`frozen_skin`] - faults of hands that can be told without training.
//! * [`model`] - the model file. [`recipe`] and [`training_summary`] - how a model was trained, as the file says.
//! * [`own_lifts`] - corrections of a model by the lifts of its robot. [`promise_monitor`] - whether lifts drop more often than was
//!   promised, and the bound that they allow.
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
pub mod frozen_skin;
pub mod glitches;
pub mod hand;
pub mod histogram;
mod judge;
pub mod label;
pub mod lift_arbiter;
pub mod lift_watch;
pub mod model;
pub mod odd_readings;
pub mod out_of_distribution;
pub mod own_lifts;
pub mod probe;
pub mod promise_monitor;
pub mod recipe;
pub mod sensors;
mod shift_test;
mod source_pace;
pub mod steps;
pub mod training_summary;

pub use blindgrasp_messages::{
    Action, Fault, Header, LiftDecision, Phase, Prediction, Reason, Senses, Stamped, TactileFrame,
};
pub use hand::{Hand, HandError};
pub use judge::{Judge, Judged};
pub use lift_arbiter::{ArbiterOptions, Probe};
pub use model::{Model, ModelError, OtherHand};
