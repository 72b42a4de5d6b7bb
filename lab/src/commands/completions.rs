//! The words of the lab that a shell completes.

use std::collections::BTreeSet;
use std::ffi::OsStr;

pub(super) use blindgrasp_cli::completions::hands;
use blindgrasp_cli::completions::with_files;
use blindgrasp_objects::catalogue_specs;
use clap_complete::ArgValueCompleter;

/// Splits and classes of the built-in objects, after a comma as well, and files.
pub(super) fn objects() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let classes: BTreeSet<&str> = catalogue_specs().map(|spec| spec.class()).collect();
        with_files(current, ["all", "held-out", "train", "paper"].into_iter().chain(classes).collect())
    })
}
