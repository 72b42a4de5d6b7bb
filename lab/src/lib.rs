//! The lab's house: simulated grasps, training and evaluation.

pub mod operators;
