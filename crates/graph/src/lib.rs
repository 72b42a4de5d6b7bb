//! The online half: operators as processes, their ports over iceoryx2, and the launcher.
//!
//! It knows messages and the graph, not the science.
//!
//! * [`describe`] - asks programs what they are.
//! * [`plan`] - who reads and writes what, and where its place on the board is.
//! * [`launcher`] - starts, supervises, swaps and stops a graph's processes. It never touches samples.
//! * [`guest`] - clients that read a running graph's edges and must miss nothing.
//! * [`control`] - what commands ask a running graph and what it answers; [`client`] - how they reach it.
//! * [`agreement`] - whether a replacement says what the running operator says.
//! * [`log`] - the graph's log files. [`usage`] - what a process has used.
//! * [`metrics`] - its figures for Prometheus.
//! * [`doctor`] - whether a machine is fit to run a graph.
//! * [`observer`] - a consumer beside the operators: reads any edges of a running graph.

pub mod agreement;
pub mod client;
pub mod control;
pub mod dataflow;
pub mod describe;
pub mod doctor;
pub mod guest;
pub mod launcher;
pub mod log;
pub mod metrics;
pub mod observer;
pub mod plan;
mod process;
pub mod recording_of_graph;
mod server;
mod supervision;
mod swap;
#[doc(hidden)]
pub mod testing;
pub mod usage;
