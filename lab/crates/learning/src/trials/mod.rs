//! Lift trials counted and shown: the paper's experiment (Dang & Allen, section IV-E).

pub mod late_decisions;
pub mod page;
pub mod tables;
pub mod tally;
