//! The online half: operators as processes, their ports over iceoryx2, and the launcher.
//!
//! It knows messages and the graph, not the science.
//!
//! * [`wiring`] - what the launcher tells an operator and what the operator tells the launcher.
//! * [`domain`] - a running graph's own corner of shared memory, and how it is left clean.
//! * [`port`] - publisher and subscriber of one message type; every edge is lossless.
//! * [`operator`] - what all operator processes have in common.
//! * [`describe`] - asks programs what they are.
//! * [`launcher`] - starts, watches and stops a graph's processes. It never touches samples.
//! * [`observer`] - a consumer beside the operators: reads any edges of a running graph.

pub mod describe;
pub mod domain;
pub mod launcher;
pub mod observer;
pub mod operator;
pub mod port;
pub mod wiring;

/// CLOCK_MONOTONIC, nanoseconds: the same for all processes of a machine.
pub fn monotonic_nanos() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
