//! The graph of operator processes: how it is written down, and whether it can run.
//!
//! A dataflow file (YAML, version 1) names the nodes of a graph, the operator that each runs, where each input comes
//! from, and each node's params. [`load`] reads it, [`check()`] holds it against what the operators say about
//! themselves ([`OperatorDescription`], the answer to `--describe`) and returns a [`Graph`] in which every program,
//! edge and param is settled, or every mistake at once, each with its line and column.
//!
//! ```yaml
//! version: 1
//! name: grasp_gate                 # letters, digits, _ and -, at most 32
//! operators:
//!   recorded_source:
//!     run: recorded_source         # the default is the node's id; with a '/' it is a path to a program
//!     params: {recording: recordings/a.mcap, rate: max}
//!   contacts:
//!     inputs: {tactile: recorded_source/tactile}     # input port: node/output port
//!     params: {hand: hands/barrett-bh8-280.yaml}
//! ```
//!
//! An **operator** is a program; a **node** is one instance of it in the graph. Relative paths are relative to the
//! file's folder. A value means what its param's kind says: `no` is a word where a choice is expected, never a boolean.
//!
//! This module starts no process: the caller says which operators there are and how to ask a program for its
//! description. It knows types only by name.

mod check;
mod description;
mod diagnostic;
mod file;
mod graph;
mod order;
mod param;
#[cfg(test)]
mod tests;
mod yaml;

pub use check::check;
pub use description::{DescriptionError, OperatorDescription, PROTOCOL, PortDescription};
pub use diagnostic::{DataflowError, Diagnostic, Position};
pub use file::{DataflowFile, is_name, load, parse};
pub use graph::{DEFAULT_HEARTBEAT_MILLIS, Edge, EdgeOptions, EdgePolicy, Graph, Input, Node, Restart, RestartPolicy};
pub use param::{ParamDescription, ParamKind};
