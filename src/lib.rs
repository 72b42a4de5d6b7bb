//! Decides from tactile cells and joint angles alone whether a grasp will hold, before the arm lifts.
//!
//! The method is Dang & Allen, "Learning Grasp Stability". The path of a sample, each arrow a process boundary:
//!
//! ```text
//! recorded_source -> contacts -> histogram -> classifier -> lift_arbiter
//!   TactileFrame     ContactSet  GraspFeature  Prediction    LiftDecision
//! ```
//!
//! * [`message`] - the samples that travel along the edges.
//! * [`hand`] - any hand, from a URDF and a pad layout: kinematics, cells, self-collision.
//! * [`contacts`], [`feature`] (with [`dictionary`] and [`histogram`]), [`classifier`], [`lift_arbiter`] - the stages:
//!   pure functions of their inputs, without clock or I/O. Operators, training and evaluation call the same functions.
//! * [`regrasp`] - how to grasp better after a grasp that is not lifted, from experience.
//! * [`novelty`] - whether a grasp is like those trained on; part of the feature stage.
//! * [`model`] - what training makes and the operators run on: one file.
//! * [`grasp`] - the offline half's simulator and ground truth.
//! * [`dataset`], [`training`], [`evaluation`] - from recordings to a model, and what a model is worth on recordings.
//! * [`import`] - tables of tactile readings, one grasp a row, as recordings.
//! * [`trial`] - lift trials in physics: a hand on an arm, an object on a table.
//! * [`tactile`] - drivers that bring a hand's live frames into the graph.
//! * [`recording`] - MCAP in and out. Recordings are also the data sets.
//! * [`export`] - recordings as tables: CSV and Parquet.
//! * [`replay`] - recordings played again, and what comes out held against what was recorded.
//! * [`picture`] - pictures of grasps and objects: SVG, HTML, contact sheets.
//! * [`dataflow`] - the graph's description and its checks.
//! * [`runtime`] - ports over iceoryx2, operators as processes, the launcher.
//! * [`link`] - the edges of a graph that go to another machine, over Zenoh.
//! * [`diagnostics`] - lines for people.
//! * [`cli`] - one file per command.
//!
//! Without the default feature `full` there is only what an operator of one's own needs: [`message`], [`dataflow`],
//! [`diagnostics`] and, of [`runtime`], the operator's side.
//!
//! Units are SI and `f64` throughout. Frames are named target first: `palm_from_link`. Every contact is in the
//! **palm frame**: its origin the centre of the palm pad's surface, +z out of the palm.

#[cfg(feature = "full")]
pub mod classifier;
#[cfg(feature = "full")]
pub mod cli;
#[cfg(feature = "full")]
pub mod contacts;
pub mod dataflow;
#[cfg(feature = "full")]
pub mod dataset;
pub mod diagnostics;
#[cfg(feature = "full")]
pub mod dictionary;
#[cfg(feature = "full")]
pub mod evaluation;
#[cfg(feature = "full")]
pub mod export;
#[cfg(feature = "full")]
pub mod feature;
#[cfg(feature = "full")]
pub mod grasp;
#[cfg(feature = "full")]
pub mod hand;
#[cfg(feature = "full")]
pub mod histogram;
#[cfg(feature = "full")]
pub mod import;
#[cfg(feature = "full")]
pub mod lift_arbiter;
#[cfg(feature = "full")]
pub mod link;
pub mod message;
#[cfg(feature = "full")]
pub mod model;
#[cfg(feature = "full")]
pub mod novelty;
#[cfg(feature = "full")]
pub mod picture;
#[cfg(feature = "full")]
pub mod recording;
#[cfg(feature = "full")]
pub mod regrasp;
#[cfg(feature = "full")]
pub mod replay;
pub mod runtime;
#[cfg(feature = "full")]
pub mod tactile;
#[cfg(feature = "full")]
pub mod training;
#[cfg(feature = "full")]
pub mod trial;
