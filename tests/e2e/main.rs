//! The robot's programs as their users run them. One program, so that it is linked once; each module has a subject.

#[path = "../common/mod.rs"]
mod common;

mod bad_input;
mod benchsuite;
mod check;
mod docs;
mod echo;
mod examples;
mod export;
mod flight_recorder;
mod graph;
mod hosted;
mod launcher;
mod live_page;
mod losses;
mod main_job;
mod many_cells;
mod metrics;
mod own_program;
mod package;
mod partners;
mod picture;
mod pins;
mod predict;
mod processes;
mod python;
mod python_package;
mod readers;
mod record;
mod recording_files;
mod regression;
mod replay;
mod ros2;
mod sandbox;
mod scaffold;
mod schema;
mod service;
mod shards;
mod start;
mod strangers;
mod supervision;
mod swap;
mod tactile_source;
mod top;
