//! `blindgrasp-lab quality`, which `blindgrasp info CASES.json` calls: epsilon and volume of a user's grasps.

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;

use super::{Outcome, print_line};
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_simulator::case_file::parse_cases;
use blindgrasp_simulator::wrench_space::{Quality, quality};

/// Print epsilon and volume of grasp cases
#[derive(Debug, Args)]
#[command(hide = true)]
pub(super) struct Arguments {
    /// Grasp cases (JSON, docs/simulator.md), - for stdin.
    file: PathBuf,
    /// Print a line of JSON for each case
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row<'a> {
    case: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    #[serde(flatten)]
    judged: Judged,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Judged {
    Failed {
        error: String,
    },
    Quality {
        #[serde(flatten)]
        quality: Quality,
        stable: bool,
    },
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let (path, as_json) = (arguments.file.as_path(), arguments.json);
    let shown = if path == Path::new("-") { "stdin".into() } else { path.display().to_string() };
    if let Some(kind) = FileKind::at(path).filter(|kind| !matches!(kind, FileKind::GraspCases | FileKind::Json)) {
        bail!("{shown}: expected grasp cases (JSON), found {}", kind.description());
    }
    let text = read(path).with_context(|| shown.clone())?;
    let cases = parse_cases(&text).with_context(|| shown.clone())?;
    if !as_json {
        print_line("   case    epsilon      volume  wrenches  closure  stable  name")?;
    }
    let (n_cases, mut n_failed) = (cases.len(), 0);
    for (case_idx, named) in cases.into_iter().enumerate() {
        let found = named.case.map_err(anyhow::Error::from).and_then(|case| Ok(quality(&case)?));
        let judged = match found {
            Ok(quality) => Judged::Quality { stable: quality.is_stable(), quality },
            Err(error) => {
                print_diagnostic(&format!("{shown}: case {case_idx}: {error:#}"));
                n_failed += 1;
                Judged::Failed { error: format!("{error:#}") }
            }
        };
        let row = Row { case: case_idx, name: named.name.as_deref(), judged };
        print_line(&if as_json { serde_json::to_string(&row)? } else { table_row(&row) })?;
    }
    if n_failed > 0 {
        bail!("{shown}: {n_failed} of {n_cases} cases have no quality; the lines above say why");
    }
    Ok(Outcome::Done)
}

fn read(path: &Path) -> std::io::Result<String> {
    if path != Path::new("-") {
        return blindgrasp_messages::files::read_regular(path);
    }
    let mut text = String::new();
    std::io::stdin().lock().read_to_string(&mut text)?;
    Ok(text)
}

fn table_row(row: &Row<'_>) -> String {
    let yes_no = |is_so| if is_so { "yes" } else { "no" };
    let judged = match &row.judged {
        Judged::Failed { .. } => format!("{:>10}", "failed"),
        Judged::Quality { quality: Quality { epsilon, volume, n_wrenches, force_closure, .. }, stable } => {
            let (closure, stable) = (yes_no(*force_closure), yes_no(*stable));
            format!("{epsilon:>10.6}  {volume:>10.6}  {n_wrenches:>8}  {closure:>7}  {stable:>6}")
        }
    };
    format!("{:>7} {judged}  {}", row.case, row.name.unwrap_or_default()).trim_end().into()
}
