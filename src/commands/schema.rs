//! `blindgrasp schema`

use blindgrasp_graph::dataflow;
use blindgrasp_graph::operators::LINK_OPERATOR;
use blindgrasp_operators::SHIPPED;
use clap::Args;

use super::{Outcome, print_text};

/// Print a JSON Schema of the dataflow file, for editors
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp schema > dataflow.schema.json\n\n\
                        An editor with a YAML language server completes and checks a file that begins with:\n  \
                        # yaml-language-server: $schema=dataflow.schema.json")]
pub(super) struct Arguments {}

pub(super) fn run(_: &Arguments) -> anyhow::Result<Outcome> {
    print_text(schema().trim_end())?;
    Ok(Outcome::Done)
}

/// The schema as a file holds it, with the operators that come with blindgrasp.
pub(super) fn schema() -> String {
    let in_files = SHIPPED.iter().filter(|shipped| shipped.name != LINK_OPERATOR);
    let operators: Vec<_> = in_files.map(|shipped| (shipped.form.describe)()).collect();
    format!("{:#}\n", dataflow::schema(&operators))
}

#[cfg(test)]
mod tests {
    /// Editors that open the project's dataflow files read the schema there. BLINDGRASP_REMAKE=1 writes it.
    #[test]
    fn the_committed_schema_is_that_of_the_operators() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/dataflow.schema.json");
        let schema = super::schema();
        if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
            std::fs::write(&path, &schema).expect("written");
        }
        let committed = std::fs::read_to_string(&path).expect("docs/dataflow.schema.json");
        assert!(committed == schema, "docs/dataflow.schema.json is another: blindgrasp schema > {}", path.display());
    }
}
