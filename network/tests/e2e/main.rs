//! Links and keys of Zenoh as their users run them.

#[path = "../../../tests/common/mod.rs"]
mod common;

mod link_identity;
mod link_security;
mod zenoh;
mod zenoh_access;
