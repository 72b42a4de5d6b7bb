//! What an operator process of a graph needs: its ports over iceoryx2, how it starts, takes over and hands over, its
//! parameters and what it says about itself.
//!
//! An operator is a program whose `main` calls [`run`] with a description and its work:
//!
//! ```no_run
//! use std::collections::BTreeMap;
//! use std::process::ExitCode;
//!
//! use blindgrasp_messages::{GraspFeature, Prediction, PredictionHead, Recorded};
//! use blindgrasp_operator::{Operator, OperatorDescription, run, stage};
//!
//! fn main() -> ExitCode {
//!     let description = OperatorDescription::new("pessimist", "Calls every grasp unstable")
//!         .answers_each()
//!         .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
//!         .output("prediction", Prediction::TYPE_NAME, "Unstable, always");
//!     run(&description, work)
//! }
//!
//! fn work(operator: &Operator) -> anyhow::Result<()> {
//!     let answer = stage::from_fn::<GraspFeature, Prediction, _>(|head, _values, _items| PredictionHead {
//!         header: head.header,
//!         grasp_id: head.grasp_id,
//!         phase: head.phase,
//!         ..PredictionHead::default()
//!     });
//!     stage::run(operator, "feature", "prediction", 0, BTreeMap::new(), answer)
//! }
//! ```
//!
//! * [`operator`] - what all operator processes have in common.
//! * [`stage`] - an operator that answers samples. [`source`] - an operator that has samples of its own.
//! * [`description`] and [`param`] - what an operator says about itself (`--describe`).
//! * [`port`] - publisher and subscriber of one message type. [`sequencer`] - puts samples of several publishers in
//!   order, each once. [`waiter`] - waits for several ports at once.
//! * [`written`] - the order of a writer's samples across epochs.
//! * [`cursors`] - how far each of a graph's processes has come. [`ages`] - how old samples are when a reader gets them.
//! * [`host`] - gives the samples of an operator to a program in any language, over two pipes.
//! * [`wiring`] - what the launcher tells an operator and what the operator tells the launcher.
//! * [`namespace`] - a running graph's own folder in shared memory, and how it is left clean. [`private_service`] - iceoryx2 in
//!   that folder.
//! * [`sandbox`] - what an operator process gives up once it is ready.
//! * [`link_status`] - what a machine knows of the other machines of its graph.
//! * [`diagnostics`] - lines for people. [`text`] - names and quotes.

pub mod ages;
pub mod bell;
pub mod control_socket;
mod credit;
pub mod cursors;
pub mod description;
mod descriptors;
pub mod diagnostics;
mod engine;
pub mod host;
mod identity;
pub mod link_status;
pub mod namespace;
pub mod operator;
mod outbox;
pub mod param;
pub mod partner;
pub mod peer;
pub mod port;
pub mod private_service;
#[cfg(test)]
mod recovery_model;
mod reports;
mod runner;
pub mod sandbox;
mod saved;
pub mod sequencer;
pub mod source;
pub mod stage;
pub mod text;
mod trace;
pub mod waiter;
pub mod wiring;
pub mod written;

pub use description::OperatorDescription;
pub use operator::{Operator, parse_params, run};
pub use param::ParamKind;

/// CLOCK_BOOTTIME, nanoseconds: the same for all processes of a machine. It never goes back, and it counts the time for which
/// the machine was suspended: samples from before are old.
pub fn monotonic_nanos() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// When a time of [`monotonic_nanos`] comes; now, if it is over.
pub(crate) fn instant_of(deadline_nanos: u64) -> std::time::Instant {
    std::time::Instant::now() + std::time::Duration::from_nanos(deadline_nanos.saturating_sub(monotonic_nanos()))
}
