//! `blindgrasp test`

mod case;
mod faults;
mod init;
mod report;
mod scratch;
mod settings;
mod sweep;

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::{Context, bail};
use clap::Args;

use self::case::{Case, Runner};
use self::scratch::Scratch;
use self::sweep::Sweep;
use super::{Outcome, check_output, stop_requests};
use blindgrasp_cli::shard::{Place, Shard};
use blindgrasp_graph::dataflow::Override;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_replay::expectations::{self, Expectations};

/// Replay recordings and compare the results with them
///
/// Replay recordings and compare the results with the recordings and their expectations.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp test --junit report.xml\n  \
                        blindgrasp test run.mcap --replace contacts --keep /tmp/found\n  \
                        blindgrasp test run.mcap --update\n  \
                        blindgrasp test --init recordings/robot-20261127T101500Z-dropped.mcap --dataflow dataflow-live.yaml\n  \
                        blindgrasp test --sweep lift_arbiter.votes=1,2,3,5\n  \
                        blindgrasp test --faults\n\n\
                        NAME.expect.yaml beside NAME.mcap says what else is expected. Exit code 1 when anything fails.")]
pub(super) struct Arguments {
    /// Recordings (MCAP); default: those in the folder recordings beside the dataflow file that have expectations.
    #[arg(value_name = "FILE")]
    recordings: Vec<PathBuf>,
    /// The dataflow file, for recordings whose expectations name no other.
    #[arg(long, default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// The node that the recordings replace; only the nodes behind it run. Default: the source.
    #[arg(long, value_name = "NODE")]
    replace: Option<String>,
    /// Write a report (JUnit XML).
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Append a summary (Markdown), as for $GITHUB_STEP_SUMMARY.
    #[arg(long, value_name = "FILE")]
    summary: Option<PathBuf>,
    /// Give a param another value than the dataflow file does. Can be repeated.
    #[arg(long = "set", value_name = "[NODE.]PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Write NAME.expect.yaml beside each recording, from the decisions of its replay; a lift that dropped its object is
    /// expected to be held.
    #[arg(long, conflicts_with_all = ["update", "junit", "summary"])]
    init: bool,
    /// Compare no samples: replay with each of these values, and print the decisions.
    #[arg(long, value_name = "[NODE.]PARAM=V1,V2,…", value_parser = Sweep::parse,
          conflicts_with_all = ["update", "junit", "summary", "keep", "init"])]
    sweep: Option<Sweep>,
    /// Compare no samples: replay with faults of sensors and transports, and print the decisions that change. Fails if a grasp
    /// is lifted that is held without the fault.
    #[arg(long, conflicts_with_all = ["update", "junit", "summary", "keep", "init", "sweep"])]
    faults: bool,
    /// Replace the results in the recordings by those of the replay; expectations stay as they are.
    #[arg(long)]
    update: bool,
    /// Test only every N-th recording, from the I-th on (0/N to N-1/N). --json has the shard's place in the whole.
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Merge the JSON of all shards into the report of the whole.
    #[arg(long, value_name = "FILE", num_args = 1..,
          conflicts_with_all = ["recordings", "dataflow", "replace", "overrides", "init", "sweep", "faults", "update", "shard", "keep"])]
    merge: Vec<PathBuf>,
    /// Keep the recording of each replay in this folder, under the recording's name.
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if !arguments.merge.is_empty() {
        check_outputs(arguments, &arguments.merge)?;
        let cases = report::merged(&arguments.merge)?;
        if !arguments.json {
            cases.iter().try_for_each(report::print_case)?;
        }
        let n_failed = report(arguments, &cases, None)?;
        anyhow::ensure!(n_failed == 0, "{n_failed} of {} recordings failed", cases.len());
        return Ok(Outcome::Done);
    }
    let all = match arguments.recordings.as_slice() {
        [] if arguments.init => init::without_expectations(&arguments.dataflow)?,
        [] => with_expectations(&arguments.dataflow)?,
        named => named.to_vec(),
    };
    let recordings = arguments.shard.unwrap_or_default().of(all.clone());
    check_outputs(arguments, &recordings)?;
    let n_stops = stop_requests()?;
    let runner = Runner {
        dataflow: &arguments.dataflow,
        overrides: &arguments.overrides,
        replace: arguments.replace.as_deref(),
        scratch: Scratch::new(arguments.keep.as_deref(), &recordings)?,
        n_stops: &n_stops,
    };
    if arguments.init {
        return init::write(&runner, &recordings, arguments.json);
    }
    if let Some(sweep) = &arguments.sweep {
        return sweep.run(&runner, &recordings, arguments.json);
    }
    if arguments.faults {
        return faults::run(&runner, &recordings, arguments.json);
    }
    let asked_for = if arguments.json { arguments.shard } else { None };
    let place = asked_for.map(|shard| place_of(arguments, shard, &runner, &all));
    let mut cases: Vec<Case> = Vec::new();
    for recording in &recordings {
        // Those before a stop are reported.
        let Some(case) = runner.test(recording, arguments.update) else { break };
        if !arguments.json {
            // Without a reader, the exit code still tells failures.
            let _ = report::print_case(&case);
        }
        cases.push(case);
    }
    let is_whole = cases.len() == recordings.len();
    let n_failed = report(arguments, &cases, if is_whole { place } else { None })?;
    if !is_whole {
        bail!("stopped after {} of {} recordings, of which {n_failed} failed", cases.len(), recordings.len());
    }
    anyhow::ensure!(n_failed == 0, "{n_failed} of {} recordings failed", cases.len());
    Ok(Outcome::Done)
}

/// The place of a shard of the tests of these recordings, of which each has its graph.
fn place_of(arguments: &Arguments, shard: Shard, runner: &Runner<'_>, all: &[PathBuf]) -> Place {
    let (mut graphs, mut files) = (Vec::new(), all.to_vec());
    for recording in all {
        let expected = Expectations::of(recording).ok().flatten().unwrap_or_default();
        let graph = runner.graph(&expected, &arguments.overrides);
        graphs.push(graph.and_then(|graph| Ok(graph.content_id(None)?)).map_err(|error| error.to_string()));
        files.push(expectations::path_of(recording));
    }
    Place::new(shard, (&arguments.replace, graphs), &files)
}

/// Writes and prints the outcome, and gives the number of recordings that failed.
fn report(arguments: &Arguments, cases: &[Case], place: Option<Place>) -> anyhow::Result<usize> {
    if let Some(junit) = &arguments.junit {
        report::write_junit(junit, cases)?;
    }
    if let Some(summary) = &arguments.summary {
        report::append_markdown(summary, cases)?;
    }
    let printed = report::print_summary(cases, arguments.json, place);
    if let Some(folder) = &arguments.keep {
        print_diagnostic(&format!("kept in {}", folder.display()));
    }
    match cases.iter().filter(|case| !case.has_passed()).count() {
        0 => printed.map(|()| 0),
        n_failed => Ok(n_failed),
    }
}

/// Refuses files to write that are read as well, and a file of another kind.
fn check_outputs(arguments: &Arguments, recordings: &[PathBuf]) -> anyhow::Result<()> {
    if let Some(junit) = &arguments.junit {
        let expectations = recordings.iter().map(|recording| expectations::path_of(recording));
        check_output(junit, &recordings.iter().cloned().chain(expectations).collect::<Vec<_>>())?;
        if junit.is_file() && junit.extension().is_none_or(|extension| extension != "xml") {
            bail!("{} (--junit): the file exists, and only a file .xml is replaced", junit.display());
        }
    }
    if let Some(summary) = &arguments.summary {
        check_output(summary, recordings)?;
    }
    Ok(())
}

impl Runner<'_> {
    /// Fails if Ctrl-C was pressed.
    fn check_stop(&self) -> anyhow::Result<()> {
        if self.n_stops.load(Ordering::Relaxed) > 0 {
            bail!("stopped before all recordings were tested");
        }
        Ok(())
    }
}

/// The project's recordings that have expectations.
fn with_expectations(dataflow: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let (folder, files) = project_recordings(dataflow)?;
    for path in files {
        // Expectations without their recording are a failed test.
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(stem) = name.strip_suffix(expectations::SUFFIX) {
            found.push(path.with_file_name(format!("{stem}.mcap")));
        }
    }
    if found.is_empty() {
        bail!(
            "no recording in {} has expectations: `blindgrasp test --init` writes them from the decisions of today, or name the recordings to test",
            folder.display()
        );
    }
    Ok(found)
}

/// The folder of the project's recordings, and the files in it, by name.
fn project_recordings(dataflow: &Path) -> anyhow::Result<(PathBuf, Vec<PathBuf>)> {
    let folder = dataflow.parent().unwrap_or(Path::new("")).join("recordings");
    let entries = std::fs::read_dir(&folder)
        .with_context(|| format!("no folder {}: name the recordings to test", folder.display()))?;
    let files = entries.map(|entry| Ok(entry.with_context(|| folder.display().to_string())?.path()));
    let mut files = files.collect::<anyhow::Result<Vec<PathBuf>>>()?;
    files.sort();
    Ok((folder, files))
}
