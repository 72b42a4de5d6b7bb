//! Damaged input of many kinds. Each run has the same cases.
//!
//! `BLINDGRASP_FUZZ_SECS` sets for how long each test goes on; its first seed then comes from the clock.
//! `BLINDGRASP_FUZZ_SEED` sets the first seed. A failure names the seed that repeats it at once.

mod damage;
mod parsers;
mod recording;
mod seeds;
