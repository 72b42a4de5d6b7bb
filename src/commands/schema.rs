//! `blindgrasp schema`

use clap::Args;

use super::{Outcome, print_text};

/// Print a JSON Schema of the dataflow file, for editors
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp schema > dataflow.schema.json\n\n\
                        An editor with a YAML language server completes and checks a file that begins with:\n  \
                        # yaml-language-server: $schema=dataflow.schema.json")]
pub(super) struct Arguments {}

/// The schema with the operators of all programs of blindgrasp; a test (tests/e2e/schema.rs) makes it from their descriptions.
pub(super) const SCHEMA: &str = include_str!("../../docs/dataflow.schema.json");

pub(super) fn run(_: &Arguments) -> anyhow::Result<Outcome> {
    print_text(SCHEMA.trim_end())?;
    Ok(Outcome::Done)
}
