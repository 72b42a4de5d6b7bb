//! The lab's commands as their users run them.

#[path = "../../../tests/common/mod.rs"]
mod common;

mod bad_input;
mod days;
mod evaluate;
mod first_day;
mod hands;
mod import;
mod meshes;
mod mujoco;
mod own_lifts;
mod reference_data;
mod reproduce;
mod sensors;
mod simulate;
mod train;
mod trials;
mod trials_graph;
