//! The network's house: the only program of blindgrasp that speaks Zenoh.

mod drivers;
pub mod operators;
