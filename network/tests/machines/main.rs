//! One graph on several machines, each a network namespace with its own shared memory. Needs root; elsewhere these
//! tests are skipped.

#[path = "../../../tests/common/mod.rs"]
mod common;
mod hosts;
mod split;

mod fleet;
mod security;
mod split_graph;
