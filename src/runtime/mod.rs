//! The online half: operators as processes, their ports over iceoryx2, and the launcher.
//!
//! It knows messages and the graph, not the science.
//!
//! * [`wiring`] - what the launcher tells an operator and what the operator tells the launcher.
//! * [`domain`] - a running graph's own corner of shared memory, and how it is left clean.
//! * [`board`] - what a graph's processes know of each other: how far each has come.
//! * [`ages`] - how old samples are when a reader gets them.
//! * [`port`] - publisher and subscriber of one message type.
//! * [`sequencer`] - puts samples of several publishers in order, each once.
//! * [`waiter`] - waits for several ports at once.
//! * [`operator`] - what all operator processes have in common.
//! * `trace` - what an operator says with `tracing` goes to the log. `zenoh_log` - what Zenoh says there.
//! * [`stage`] - an operator that answers samples, can be killed and swapped.
//! * [`describe`] - asks programs what they are.
//! * [`plan`] - who reads and writes what, and where its place on the board is.
//! * [`launcher`] - starts, supervises, swaps and stops a graph's processes. It never touches samples.
//! * [`attached`] - clients that read a running graph's edges and must miss nothing.
//! * [`control`] - what commands ask a running graph and what it answers; [`client`] - how they reach it.
//! * [`shadow_comparison`] - compares a replacement with the running operator.
//! * [`run`] - a graph from its start to its end.
//! * [`link_status`] - what a machine knows of the others of its graph.
//! * [`log`] - the graph's log files. [`usage`] - what a process has used.
//! * [`metrics`] - its figures for Prometheus.
//! * [`doctor`] - whether a machine is fit to run a graph.
//! * [`observer`] - a consumer beside the operators: reads any edges of a running graph.

pub mod ages;
#[cfg(feature = "full")]
pub mod shadow_comparison;
pub mod board;
#[cfg(feature = "full")]
pub mod client;
#[cfg(feature = "full")]
mod clients;
#[cfg(feature = "full")]
pub mod control;
#[cfg(feature = "full")]
pub mod describe;
#[cfg(feature = "full")]
pub mod doctor;
pub mod domain;
#[cfg(feature = "full")]
pub mod attached;
#[cfg(feature = "full")]
pub mod launcher;
#[cfg(feature = "full")]
mod link_book;
pub mod link_status;
#[cfg(feature = "full")]
pub mod log;
#[cfg(feature = "full")]
pub mod metrics;
#[cfg(feature = "full")]
pub mod observer;
pub mod operator;
#[cfg(feature = "full")]
pub mod plan;
pub mod port;
#[cfg(feature = "full")]
mod process;
#[cfg(feature = "full")]
pub mod run;
#[cfg(feature = "full")]
pub mod sample_batch;
pub mod sequencer;
#[cfg(feature = "full")]
mod server;
pub mod stage;
#[cfg(feature = "full")]
mod supervision;
#[cfg(feature = "full")]
mod swap;
mod trace;
#[cfg(feature = "full")]
pub mod usage;
pub mod waiter;
pub mod wiring;
mod zenoh_log;

/// CLOCK_MONOTONIC, nanoseconds: the same for all processes of a machine.
pub fn monotonic_nanos() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
