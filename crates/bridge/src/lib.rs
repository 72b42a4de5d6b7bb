//! A graph across machines: what crosses is carried by one process a machine, the link, over Zenoh.
//!
//! Each machine runs its own operators under a launcher of its own. An edge whose ends lie on two machines ends, on the
//! writer's machine, in the link, which reads it as any other consumer would; on the reader's machine the link writes it
//! as the writer itself would. Operators know nothing of that.
//!
//! A **channel** is an output port on its way to one other machine. Zenoh may lose, delay and repeat; the channel does
//! not: the receiving link says from where on it wants samples, the sending link keeps them until the receiver's readers
//! have answered them ([`outgoing`], [`incoming`]).
//!
//! * [`local`] - one machine's part of a graph. [`config`] - what a link is told by its launcher.
//! * [`wire`] - the frames that links exchange, and their bytes. [`sample`] - a message as the body of a frame.
//! * [`outgoing`], [`incoming`] - the two ends of a channel. [`clock`] - the other machine's clock. They do no I/O.
//! * [`session`] - Zenoh: endpoints, TLS. [`access`] - who may do what. [`keys`] - certificates for a start.
//!   [`certificates`] - whether those that lie there can be used.
//! * [`tunnel`] - commands for a graph's part on another machine.
//! * [`peer`] - whether another machine is there. `export`, `import`, `line` - ports and Zenoh around all that.
//! * [`operator`] - the process.

pub mod access;
pub mod certificates;
pub mod clock;
pub mod config;
mod export;
mod import;
pub mod incoming;
pub mod keys;
mod line;
pub mod local;
pub mod operator;
pub mod outgoing;
pub mod peer;
pub mod sample;
pub mod session;
pub mod tunnel;
pub mod wire;
