//! The real programs as their users run them. One program, so that it is linked once; each module has a subject.

#[path = "../common/mod.rs"]
mod common;

mod bad_input;
mod check;
mod days;
mod evaluate;
mod export;
mod graph;
mod grid;
mod import;
mod launcher;
mod libsvm;
mod link_identity;
mod link_security;
mod main_job;
mod many_cells;
mod meshes;
mod metrics;
mod picture;
mod pins;
mod python;
mod quality;
mod readers;
mod record;
mod recording_files;
mod reference_data;
mod regrasp;
mod regression;
mod replay;
mod reproduce;
mod sandbox;
mod scaffold;
mod sensors;
mod service;
mod simulate;
mod start;
mod supervision;
mod swap;
mod tactile_source;
mod top;
mod train;
mod trials;
mod trials_graph;
mod trials_regrasp;
mod tunnel;
