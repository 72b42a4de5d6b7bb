//! Graphs across machines. One process on each machine, the link, carries the edges between machines over Zenoh.
//!
//! Each machine runs its own operators under its own launcher. For an edge between two machines, the link on the
//! writer's machine reads the port like any other consumer, and the link on the reader's machine publishes the samples
//! as the writer itself would. Operators do not notice the link.
//!
//! A **channel** is an output port whose samples go to one other machine. Zenoh may lose, delay and repeat messages. A
//! channel does not lose or repeat samples: the receiving link requests samples from some sample on, and the sending
//! link keeps them until the receiver's readers have answered them ([`outgoing`], [`incoming`]).
//!
//! * [`wire`] - the frames that links exchange. [`sample`] - a message as the body of a frame.
//! * [`outgoing`], [`incoming`] - the two ends of a channel. [`clock`] - the other machine's clock. They do no I/O.
//! * [`session`] - Zenoh's configuration: endpoints, TLS. [`access`] - its access control. [`keys`] - makes
//!   certificates. [`certificates`] - reads and checks certificates.
//! * [`identity`] - signs and verifies hellos. [`agreement`] - agrees on keys. [`protection`] - applies both to frames.
//! * [`peer`] - the state of another machine's link. `uplink`, `downlink` - the local ports of a channel; `spool` - the file of
//!   the samples that a channel keeps.
//!   `peer_connection` - the Zenoh side.
//! * [`outside`] - sessions with programs that are no part of the graph.
//! * [`operator`] - the process.

pub mod access;
pub mod agreement;
pub mod certificates;
pub mod clock;
mod downlink;
mod envelope;

pub mod identity;
pub mod incoming;
pub mod keys;
pub mod operator;
pub mod outgoing;
pub mod outside;
pub mod peer;
mod peer_connection;
pub mod protection;
pub mod sample;
pub mod session;
mod spool;
mod uplink;
pub mod wire;
