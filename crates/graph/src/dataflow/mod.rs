//! The graph of operator processes: its file, and the check whether it can run.
//!
//! A dataflow file (YAML, version 1) names the nodes of a graph, the operator that each runs, where each input comes
//! from, and each node's params. [`load`] reads it, [`check()`] compares it with the descriptions of the operators
//! ([`OperatorDescription`], the answer to `--describe`). It returns a [`Graph`] in which every program, edge and param
//! is settled, or every mistake at once, each with its line and column.
//!
//! ```yaml
//! version: 1
//! name: grasp_gate                 # letters, digits, _ and -, at most 32
//! params: {model: models/a.json}   # for each node that has the param and does not say otherwise
//! operators:
//!   recorded_source:
//!     run: recorded_source         # an operator, a program on PATH, with a '/' a path; default: the id's operator
//!     args: []                     # what it is started with
//!     params: {recording: recordings/a.mcap, rate: max}
//!   contacts:
//!     inputs:
//!       tactile: {from: recorded_source/tactile, policy: lossless, capacity: 256, deadline_ms: 50, on_late: hold}
//!     params: {hand: hands/barrett-bh8-280.yaml}
//!     restart: {policy: on-failure, limit: 5, within_s: 60, backoff_ms: 10}    # or only the policy
//!     heartbeat_ms: 2000           # or off
//!     sandbox: on                  # or off, required
//!     memory_max_mib: 256
//!     group: judge                 # the nodes of a group share a process
//!     wait: event                  # or poll, {poll_us: 50}
//!     scheduling: {policy: fifo, priority: 60}                                  # or round_robin
//!     cpus: [2, 3]
//!     nice: 5
//!     lock_memory: true
//!     sha256: {hand: 6d0c…}        # or a list; of run: the program's
//! ```
//!
//! A graph on several machines names them, and each node says where it runs:
//!
//! ```yaml
//! machines:
//!   robot: {}                      # listens nowhere: it connects to those that do
//!   brain: {listen: tls/192.168.1.10:7447}
//! link: {keys: keys, deadline_ms: 150, buffer: 8192}            # or router: tls/gateway:7447; insecure: true
//! operators:
//!   contacts: {on: robot, …}
//! ```
//!
//! `${NAME}` in a value is the variable of the environment, `${NAME:-TEXT}` with a default, and `$${` is `${`.
//!
//! An input may also be only `node/output port`; all keys of a node have a default. An input with a `?` behind its name is left
//! out if the operator has no such input: `"decision?": lift_arbiter/decision` serves several sources.
//!
//! An **operator** is a program; a **node** is one instance of it in the graph. Relative paths are relative to the
//! file's folder, in an [`Override`] to the current one. A value means what its param's kind says: `no` is a word where
//! a choice is expected, never a boolean.
//!
//! This module starts no process: the caller says which operators there are and how to ask a program for its
//! description. It knows types only by name.

mod check;
mod crossing;
mod diagnostic;
mod endpoint;
mod environment;
mod file;
mod form;
mod graph;
mod machines;
mod machines_entry;
mod node;
mod order;
pub mod pins;
mod process_options;
mod program;
mod schema;
mod scope;
mod settings;
#[cfg(test)]
mod tests;
mod yaml;

pub use blindgrasp_operator::description::{DescriptionError, OperatorDescription, PROTOCOL, PortDescription};
pub use blindgrasp_operator::param::{ParamDescription, ParamKind};
pub use blindgrasp_operator::text::is_name;
pub use blindgrasp_operator::wiring::EdgePolicy;
pub use check::check;
pub use diagnostic::{DataflowError, Diagnostic, Position};
pub use endpoint::Endpoint;
pub use file::{DataflowFile, load, load_with, parse};
pub use graph::{
    DEFAULT_HEARTBEAT_MILLIS, DEFAULT_PARTNER_WAIT_MILLIS, DEFAULT_TOLERANCE_MILLIS, Edge, EdgeOptions, Graph, Input,
    Node, Restart, RestartPolicy,
};
pub use machines::{LINK, LinkSettings, LocalView, Machine, Machines};
pub use process_options::{ProcessOptions, Scheduling, SchedulingPolicy};
pub use program::Program;
pub use schema::schema;
pub use scope::{Scope, UNKNOWN_TYPE, UNKNOWN_VERSION};
pub use settings::{Override, accept_param, accept_param_value, live_param};
