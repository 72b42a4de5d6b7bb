//! `blindgrasp quality`

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;

use super::{Outcome, print_line};
use crate::diagnostics::print_diagnostic;
use crate::grasp::case_file::parse_cases;
use crate::grasp::wrench_space::{Quality, quality};

/// Judge grasps by their contacts: epsilon and volume of the grasp wrench space.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp quality grasps.json --json\n\n\
                  A case: {\"centre_of_mass_m\", \"max_radius_m\", \"contacts\": [{\"point_m\", \"inward_normal\", \
                  \"tangent\", \"friction\", \"torsion_m\"}]}; docs/quality.md explains it. A case that fails is said, \
                  the others are judged all the same, and the exit code is 1.")]
pub(super) struct Arguments {
    /// JSON file with a grasp case, a list of cases, or a case per line; - is stdin.
    file: PathBuf,
    /// Print a JSON object per case.
    #[arg(long)]
    json: bool,
}

/// A line of JSON.
#[derive(Serialize)]
struct Row<'a> {
    case: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<&'a str>,
    #[serde(flatten)]
    found: Found,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Found {
    Failed {
        error: String,
    },
    Judged {
        #[serde(flatten)]
        quality: Quality,
        stable: bool,
    },
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let path = &arguments.file;
    let cases = parse_cases(&read(path)?).with_context(|| shown(path))?;
    if !arguments.json {
        print_line("   case    epsilon      volume  wrenches  force closure  stable  name")?;
    }
    let n_cases = cases.len();
    let mut n_failed = 0;
    for (case_idx, named) in cases.into_iter().enumerate() {
        let judged = named
            .case
            .map_err(anyhow::Error::from)
            .and_then(|case| Ok(quality(&case)?))
            .map(|quality| Found::Judged { stable: quality.is_stable(), quality });
        let found = judged.unwrap_or_else(|error| {
            print_diagnostic(&format!("{}: case {case_idx}: {error:#}", shown(path)));
            n_failed += 1;
            Found::Failed { error: format!("{error:#}") }
        });
        let row = Row { case: case_idx, name: named.name.as_deref(), found };
        print_line(&if arguments.json { serde_json::to_string(&row)? } else { table_row(&row) })?;
    }
    if n_failed > 0 {
        bail!("{}: {n_failed} of {n_cases} cases have no quality, as said above", shown(path));
    }
    Ok(Outcome::Done)
}

fn read(path: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    let read = if path == Path::new("-") {
        std::io::stdin().lock().read_to_string(&mut text)
    } else {
        std::fs::File::open(path).and_then(|mut file| file.read_to_string(&mut text))
    };
    read.with_context(|| shown(path))?;
    Ok(text)
}

fn shown(path: &Path) -> String {
    if path == Path::new("-") { "stdin".into() } else { path.display().to_string() }
}

fn table_row(row: &Row<'_>) -> String {
    let yes_no = |so| if so { "yes" } else { "no" };
    let values = match &row.found {
        Found::Failed { .. } => format!("{:>10}  {:>10}  {:>8}  {:>13}  {:>6}", "failed", "", "", "", ""),
        Found::Judged { quality: Quality { epsilon, volume, n_wrenches, force_closure, .. }, stable } => format!(
            "{epsilon:>10.6}  {volume:>10.6}  {n_wrenches:>8}  {:>13}  {:>6}",
            yes_no(*force_closure),
            yes_no(*stable)
        ),
    };
    format!("{:>7} {values}  {}", row.case, row.name.unwrap_or_default()).trim_end().into()
}
