//! Damaged frames of links, with the seeds of `tests/fuzz`.

#[path = "../../../tests/fuzz/seeds.rs"]
mod seeds;
mod wire;
