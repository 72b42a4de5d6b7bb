//! `blindgrasp completions`, and the words that it completes: of a running graph they are asked of the graph.

use anyhow::Context;
use blindgrasp_graph::client::{ANSWER_LIMIT, Connection, running_graphs};
use blindgrasp_graph::control::{GraphStatus, Reply, Request};
use clap::{Args, CommandFactory};
use clap_complete::env::{CompleteEnv, Shells};
use clap_complete::{ArgValueCandidates, CompletionCandidate, Shell};

use super::{Cli, Outcome};

/// A script of [`run`] starts the program with this variable to ask for words.
const VARIABLE: &str = "BLINDGRASP_COMPLETE";

/// Print a script that completes commands in a shell
///
/// Also completes the names of running graphs, their nodes, outputs and parameters.
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
