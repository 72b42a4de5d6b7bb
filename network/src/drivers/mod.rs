//! The driver of `tactile_source` that speaks Zenoh: frames on a key.

mod inbox;
pub(crate) mod zenoh_key;
