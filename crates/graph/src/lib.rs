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
//! * [`describe`] - asks programs what they are.
//! * [`plan`] - the readers and writers of a graph, and their cursor slots.
//! * [`pins`] - files whose content the dataflow file fixes.
//! * [`launcher`] - starts, supervises, swaps and stops a graph's processes. It never touches samples.
//! * [`attached`] - clients that read a running graph's edges and must miss nothing.
//! * [`run`] - a graph from its start to its end in this process.
//! * [`control`] - the requests to a running graph and its replies; [`client`] - the connection to it.
//! * [`shadow_comparison`] - compares a replacement with the running operator, sample by sample.
//! * [`log`] - the graph's log files. [`usage`] - the processor time and memory of a process.
//! * [`audit`] - who has asked for a change, and what came of it.
//! * [`metrics`] - its figures for Prometheus.
//! * [`doctor`] - checks whether a machine is fit to run a graph.
//! * [`observer`] - a reader of any edges beside the operators.

pub mod attached;
pub mod audit;
pub mod client;
mod clients;
pub mod control;
pub mod dataflow;
pub mod describe;
pub mod doctor;
pub mod launcher;
mod link_book;
pub mod log;
mod log_writer;
pub mod metrics;
pub mod observer;
pub mod pins;
pub mod plan;
mod process;
pub mod recorded_graph;
pub mod run;
pub mod sample_batch;
mod server;
mod service;
pub mod shadow_comparison;
mod slow_nodes;
mod supervision;
mod swap;
#[doc(hidden)]
pub mod testing;
pub mod usage;
