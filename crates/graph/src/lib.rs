//! The online half: operators as processes, their ports over iceoryx2, and the launcher.
//!
//! A dataflow file is read and checked before anything starts, and a mistake says where it stands:
//!
//! ```
//! use blindgrasp_graph::dataflow;
//!
//! let error = dataflow::parse("two.yaml".as_ref(), b"name: *a").expect_err("there is no a");
//! assert!(error.to_string().contains("two.yaml:1:7"), "{error}");
//! ```
//!
//! It knows messages and the graph, not the science.
//!
//! * [`dataflow`] - the dataflow file, checked; it starts nothing. [`operators`] - the operators that come with a program.
//!   [`describe`] - asks programs what they are.
//! * [`plan`] - the readers and writers of a graph, and their cursor slots.
//! * [`launcher`] - starts, supervises, swaps and stops a graph's processes. It never touches samples.
//! * [`link`] - one machine's part of a graph that runs on several.
//! * [`run`] - a graph from its start to its end in this process.
//! * [`control`] - the requests to a running graph and its replies. [`client`] - what asks, watches and compares from outside.
//! * [`log`] - the graph's log files. [`recorded_graph`] - the facts about a graph that its recording holds.
//! * [`doctor`] - checks whether a machine is fit to run a graph.

pub mod client;
pub mod control;
pub mod dataflow;
pub mod describe;
pub mod doctor;
pub mod launcher;
pub mod link;
pub mod log;
pub mod operators;
pub mod plan;
pub mod recorded_graph;
pub mod run;
#[doc(hidden)]
pub mod testing;
