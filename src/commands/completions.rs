//! `blindgrasp completions`, and the words that it completes: of a running graph they are asked of the graph.

use std::collections::BTreeSet;
use std::ffi::OsStr;

use anyhow::Context;
use blindgrasp_graph::client::{ANSWER_LIMIT, Connection, running_graphs};
use blindgrasp_graph::control::{GraphStatus, Reply, Request};
use blindgrasp_objects::catalogue_specs;
use blindgrasp_stages::hand::builtin_names;
use clap::{Args, CommandFactory};
use clap_complete::engine::ValueCompleter;
use clap_complete::env::{CompleteEnv, Shells};
use clap_complete::{ArgValueCandidates, ArgValueCompleter, CompletionCandidate, PathCompleter, Shell};

use super::{Cli, Outcome};

/// A script of [`run`] starts the program with this variable to ask for words.
const VARIABLE: &str = "BLINDGRASP_COMPLETE";

/// Print a script that completes commands in a shell
///
/// Also completes the names of running graphs, their nodes, outputs and parameters, of hands and of objects.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp completions bash > ~/.local/share/bash-completion/completions/blindgrasp\n  \
                        blindgrasp completions zsh > \"${fpath[1]}/_blindgrasp\"\n  \
                        blindgrasp completions fish > ~/.config/fish/completions/blindgrasp.fish")]
pub(super) struct Arguments {
    /// The shell.
    shell: Shell,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let shells = Shells::builtins();
    let shell = shells.completer(&arguments.shell.to_string()).context("this shell cannot be served")?;
    let mut script = Vec::new();
    shell.write_registration(VARIABLE, "blindgrasp", "blindgrasp", "blindgrasp", &mut script)?;
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(Outcome::Done)
}

/// Answers a shell that asks for words, and ends the process then.
pub(super) fn answer_shell() {
    CompleteEnv::with_factory(Cli::command).var(VARIABLE).complete();
}

pub(super) fn graphs() -> ArgValueCandidates {
    ArgValueCandidates::new(|| candidates(running_graphs().unwrap_or_default()))
}

/// The other machines of the running graphs.
pub(super) fn machines() -> ArgValueCandidates {
    of_status(|status| {
        let peers = status.link.iter().flat_map(|link| &link.peers);
        peers.map(|peer| peer.machine.clone()).collect()
    })
}

pub(super) fn nodes() -> ArgValueCandidates {
    of_status(|status| status.nodes.iter().map(|node| node.node.clone()).collect())
}

/// NODE/PORT
pub(super) fn outputs() -> ArgValueCandidates {
    of_status(|status| status.edges.iter().map(|edge| edge.from.clone()).collect())
}

/// NODE.PARAM=
pub(super) fn assignments() -> ArgValueCandidates {
    of_status(|status| {
        let of = status.nodes.iter().flat_map(|node| node.params.keys().map(move |param| (&node.node, param)));
        of.map(|(node, param)| format!("{node}.{param}=")).collect()
    })
}

/// The built-in hands, and files.
pub(super) fn hands() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| with_files(current, builtin_names()))
}

/// Splits and classes of the built-in objects, after a comma as well, and files.
pub(super) fn objects() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let classes: BTreeSet<&str> = catalogue_specs().map(|spec| spec.class()).collect();
        with_files(current, ["all", "held-out", "train", "paper"].into_iter().chain(classes).collect())
    })
}

/// The words that go on as the typed one begins, and the files that do.
fn with_files(current: &OsStr, words: Vec<&str>) -> Vec<CompletionCandidate> {
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
        let status = |graph: String| match Connection::open(&graph).ok()?.ask(&Request::Status, ANSWER_LIMIT) {
            Ok(Reply::Status(status)) => Some(words(&status)),
            _ => None,
        };
        candidates(running_graphs().unwrap_or_default().into_iter().filter_map(status).flatten().collect())
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
    fn hands_and_objects_are_completed_by_their_names() {
        let of = |typed: &str, words: Vec<&str>| -> Vec<String> {
            let found = with_files(OsStr::new(typed), words);
            found.iter().map(|word| word.get_value().to_string_lossy().into_owned()).collect()
        };
        assert_eq!(of("shadow", builtin_names()), ["shadow-biotac-sp"]);
        assert_eq!(of("mug,tea", vec!["mug", "teapot", "train"]), ["mug,teapot"]);
        let classes: Vec<&str> = catalogue_specs().map(|spec| spec.class()).collect();
        assert!(classes.contains(&"mug"), "{classes:?}");
    }
}
