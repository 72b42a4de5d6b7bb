//! `blindgrasp new hand`

use clap::{Args, Subcommand};

use super::{Outcome, hand};

/// Describe a hand of your own
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Hand(Box<hand::Arguments>),
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let What::Hand(arguments) = &arguments.what;
    hand::run(arguments)
}
