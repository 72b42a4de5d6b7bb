//! Recordings replayed through a graph, and the results compared with the recording.
//!
//! * [`selection`] - the part of a recording that is played, and the numbers of its samples.
//! * [`played`] - the messages that a recording can feed a graph with; [`playback`] - the samples in playing order.
//! * [`player`] - a recording played once or several times, from the position of its readers.
//! * [`rewrite`] - a graph in which a recording takes the place of a node.
//! * [`comparison`] - two recordings of one graph, edge by edge.
//! * [`expectations`] - the file beside a recording that says what its replay must come to.
//! * [`checks`] - a replay held against recording and expectations.
//! * [`faults`] - faults of sensors and transports, put into recorded frames.
//! * [`update`] - a recording written anew with the results of a replay.

pub mod checks;
pub mod comparison;
pub mod expectations;
pub mod faults;
pub mod playback;
pub mod played;
pub mod player;
pub mod rewrite;
mod samples;
pub mod selection;
pub mod update;
