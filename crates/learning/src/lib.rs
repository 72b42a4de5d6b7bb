//! From recordings to a model, and what a model is worth on recordings.
//!
//! * [`dataset`] - recordings as data sets. [`import`] - tables of tactile readings as recordings.
//! * [`training`] - the model.
//! * [`evaluation`] - decisions compared with labels. [`promise`] - bounds for the drops to come. [`trials`] - lift trials counted and shown.

pub mod dataset;
pub mod evaluation;
pub mod import;
pub mod promise;
pub mod sensors;
pub mod training;
pub mod trials;
