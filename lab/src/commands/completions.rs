//! The words of the lab that a shell completes.

use std::collections::BTreeSet;
use std::ffi::OsStr;

pub(super) use blindgrasp_cli::completions::hands;
use blindgrasp_cli::completions::with_files;
use blindgrasp_objects::catalogue_specs;
use clap_complete::{ArgValueCompleter, CompletionCandidate};

/// Splits and classes of the built-in objects, after a comma as well, and files.
pub(super) fn objects() -> ArgValueCompleter {
    ArgValueCompleter::new(words_of_objects)
}

fn words_of_objects(current: &OsStr) -> Vec<CompletionCandidate> {
    let classes: BTreeSet<&str> = catalogue_specs().map(|spec| spec.class()).collect();
    with_files(current, ["all", "held-out", "train", "paper"].into_iter().chain(classes).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_of_objects_are_completed_behind_a_comma() {
        let found = words_of_objects(OsStr::new("all,mu"));
        assert!(found.iter().any(|word| word.get_value() == "all,mug"), "{found:?}");
    }
}
