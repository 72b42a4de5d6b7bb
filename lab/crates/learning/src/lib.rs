//! From recordings to a model, and what a model is worth on recordings.
//!
//! ```
//! use blindgrasp_learning::evaluation::evaluate;
//! use blindgrasp_stages::{ArbiterOptions, Hand, Model};
//!
//! let hand = Hand::load("barrett-bh8-280".as_ref())?;
//! let model = Model::load("../../../models/barrett-bh8-280.json".as_ref())?;
//! let recordings = [std::path::PathBuf::from("../../../recordings/held-out.mcap")];
//! let evaluated = evaluate(&hand, &model, &recordings, &ArbiterOptions::default())?;
//! assert!(evaluated.evaluation.score.accuracy > Some(0.85));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`training::train`] makes such a model of the grasps of recordings, or of grasps in memory ([`training::Examples`]).
//!
//! * [`import`] - tables of tactile readings as recordings.
//! * [`training`] - the model, by the [`learners`]. [`plain_rule`] - one that learns nothing.
//! * [`evaluation`] - decisions compared with labels. [`promise`] - bounds for the drops to come. [`trials`] - lift trials counted and shown.

pub mod evaluation;
pub mod import;
pub mod learners;
pub mod plain_rule;
pub mod promise;
pub mod sensors;
pub mod training;
pub mod trials;

/// The name of a file, for people.
pub fn file_name(path: &std::path::Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
