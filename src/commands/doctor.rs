//! `blindgrasp doctor`

use clap::Args;
use serde_json::json;

use super::{Outcome, print_line};
use blindgrasp_cli::houses::robot_program;
use blindgrasp_graph::doctor::{Fitness, Measurement, examine};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::namespace::{left_over, sweep};
use blindgrasp_operators::installed_operators_of;

/// Check whether this machine can run a graph
///
/// Checks shared memory, permissions, leftovers, operators, clock, cores and limits. It measures for two seconds how late
/// threads wake up: for one second it keeps all cores busy.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp doctor --fix\n\n\
                        Exit code 1 if a graph cannot run here; warnings are no failure.")]
pub(super) struct Arguments {
    /// Remove the files of dead graphs; running graphs are not touched
    #[arg(long)]
    fix: bool,
    /// Do not measure how late threads wake up
    #[arg(long)]
    quick: bool,
    /// Print JSON
    ///
    /// {"verdict", "removed", "findings": [{"check", "verdict", "found", "advice"}]}. The findings "wake-up latency, ..." also have
    /// "idle" and "under_load": {"n_wake_ups", "p50_us", "p99_us", "p999_us", "worst_us"}
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let mut removed = Vec::new();
    if arguments.fix {
        removed.extend(left_over().into_iter().map(|(_, path)| path));
        let failed = sweep();
        removed.retain(|path| !failed.iter().any(|(left, _)| left == path));
        for (path, error) in failed {
            print_diagnostic(&format!("blindgrasp: cannot remove {}: {error}", path.display()));
        }
    }
    let measurement = if arguments.quick { Measurement::Skipped } else { Measurement::TwoSeconds };
    let findings = examine(measurement, &installed_operators_of(&robot_program()?));
    let verdict = findings.iter().map(|finding| finding.verdict).max().unwrap_or(Fitness::Ok);
    if arguments.json {
        print_line(&json!({ "verdict": verdict, "removed": removed, "findings": findings }).to_string())?;
    } else {
        removed.iter().try_for_each(|path| print_line(&format!("removed  {}", path.display())))?;
        let width = findings.iter().map(|finding| finding.check.chars().count()).max().unwrap_or(0);
        for finding in &findings {
            print_line(&format!("{:<8} {:<width$}  {}", finding.verdict, finding.check, finding.found))?;
            if let Some(advice) = &finding.advice {
                print_line(&format!("         {:<width$}  → {advice}", ""))?;
            }
        }
    }
    match verdict {
        Fitness::Failure => anyhow::bail!("a graph cannot run here"),
        Fitness::Ok | Fitness::Warning => Ok(Outcome::Done),
    }
}
