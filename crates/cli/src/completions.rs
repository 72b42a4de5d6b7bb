//! The words that a shell completes: those of a running graph are asked of the graph.

use std::ffi::OsStr;

use blindgrasp_graph::client::{ANSWER_LIMIT, Connection, running_graphs};
use blindgrasp_graph::control::{GraphStatus, Reply, Request};
use blindgrasp_stages::hand::builtin_names;
use clap::Command;
use clap_complete::engine::ValueCompleter;
use clap_complete::env::CompleteEnv;
use clap_complete::{ArgValueCandidates, ArgValueCompleter, CompletionCandidate, PathCompleter};

/// The script of `blindgrasp completions` starts the program with this variable to ask for words.
pub const VARIABLE: &str = "BLINDGRASP_COMPLETE";

/// Answers a shell that asks for words, and ends the process then.
pub fn answer_shell(command: impl Fn() -> Command) {
    CompleteEnv::with_factory(command).var(VARIABLE).complete();
}

pub fn graphs() -> ArgValueCandidates {
    ArgValueCandidates::new(|| candidates(running_graphs()))
}

pub fn nodes() -> ArgValueCandidates {
    of_status(|status| status.nodes.iter().map(|node| node.node.clone()).collect())
}

/// NODE/PORT
pub fn outputs() -> ArgValueCandidates {
    of_status(|status| status.edges.iter().map(|edge| edge.from.clone()).collect())
}

/// NODE.PARAM=
pub fn assignments() -> ArgValueCandidates {
    of_status(|status| {
        let of = status.nodes.iter().flat_map(|node| node.params.keys().map(move |param| (&node.node, param)));
        of.map(|(node, param)| format!("{node}.{param}=")).collect()
    })
}

/// The built-in hands, and files.
pub fn hands() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| with_files(current, builtin_names()))
}

/// The words that go on as the typed one begins, and the files that do.
pub fn with_files(current: &OsStr, words: Vec<&str>) -> Vec<CompletionCandidate> {
    let typed = current.to_string_lossy();
    let (before, last) = match typed.rfind(',') {
        Some(at) => typed.split_at(at + 1),
        None => ("", &*typed),
    };
    let begun = words.into_iter().filter(|word| word.starts_with(last));
    let mut candidates: Vec<CompletionCandidate> =
        begun.map(|word| CompletionCandidate::new(format!("{before}{word}"))).collect();
    candidates.extend(PathCompleter::any().complete(current));
    candidates
}

/// Words of all running graphs: the others of the command line are not known here.
fn of_status(words: fn(&GraphStatus) -> Vec<String>) -> ArgValueCandidates {
    ArgValueCandidates::new(move || {
        let mut found = Vec::new();
        for graph in running_graphs() {
            if let Ok(mut connection) = Connection::open(&graph)
                && let Ok(Reply::Status(status)) = connection.ask(&Request::Status, ANSWER_LIMIT)
            {
                found.extend(words(&status));
            }
        }
        candidates(found)
    })
}

fn candidates(mut words: Vec<String>) -> Vec<CompletionCandidate> {
    words.sort_unstable();
    words.dedup();
    words.into_iter().map(CompletionCandidate::new).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hands_are_completed_by_their_names() {
        let of = |typed: &str, words: Vec<&str>| -> Vec<String> {
            let found = with_files(OsStr::new(typed), words);
            found.iter().map(|word| word.get_value().to_string_lossy().into_owned()).collect()
        };
        assert_eq!(of("shadow", builtin_names()), ["shadow-biotac-sp"]);
        assert_eq!(of("mug,tea", vec!["mug", "teapot", "train"]), ["mug,teapot"]);
    }
}
