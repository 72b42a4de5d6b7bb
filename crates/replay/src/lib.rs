//! Recordings played through a graph again, and what comes out held against what was recorded.
//!
//! * [`selection`] - which part of a recording is played, and under which numbers.
//! * [`played`] - the messages that a recording can feed a graph with; [`playback`] - as they go out again.
//! * [`player`] - a recording played once or several times, from wherever its readers are.
//! * [`rewrite`] - a graph in which a recording takes the place of a node.
//! * [`fields`] - a message as paths and values.
//! * [`comparison`] - two recordings of one graph, edge by edge.
//! * [`expectations`] - what a person demands of a recording's replay.
//! * [`bare_chain`] - what passing samples along costs on this machine, without blindgrasp.

pub mod bare_chain;
pub mod comparison;
pub mod expectations;
pub mod fields;
pub mod playback;
pub mod played;
pub mod player;
pub mod rewrite;
pub mod selection;
