//! `blindgrasp replay`

mod feed;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use clap::Args;
use serde_json::{Value, json};

pub(super) use self::feed::{Fed, Feed};
use super::recording_arguments::RecordingArguments;
use super::{Outcome, stop_requests};
use blindgrasp_cli::graph_file::{OnMisfit, fitting};
use blindgrasp_cli::secs_in;
use blindgrasp_graph::dataflow::{self, Override};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_replay::selection::{GraspIds, Selection};
use blindgrasp_session::run::Session;

/// Play a recording in the place of a graph's source or stage
///
/// Play a recording through a graph, in place of its source or of a stage.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp replay recordings/held-out.mcap --rate max\n  \
                        blindgrasp replay run.mcap --grasps 3,7-9\n  \
                        blindgrasp replay run.mcap --replace contacts --set classifier.model=new.json --record new.mcap\n\n\
                        The same recording and graph give the same bytes on every edge, at any rate: stages use the \
                        recording's clock.")]
pub(super) struct Arguments {
    /// The recording (MCAP).
    recording: PathBuf,
    /// The dataflow file.
    #[arg(long, default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// Name of the running graph; default: the file's.
    #[arg(long)]
    name: Option<String>,
    /// The speed: recorded, a multiple of it like 2x, or max for as fast as the graph can.
    #[arg(long, default_value = "recorded", value_parser = rate)]
    rate: Value,
    /// Leave out grasps that begin earlier: seconds since the recording's first sample, or 1m30s.
    #[arg(long, value_name = "T", value_parser = nanos)]
    from: Option<u64>,
    /// Leave out grasps that begin then or later.
    #[arg(long, value_name = "T", value_parser = nanos)]
    to: Option<u64>,
    /// Play only these grasps, like 3,7-9.
    #[arg(long, value_name = "IDS")]
    grasps: Option<GraspIds>,
    /// Repeat the recording until Ctrl-C; numbers, times and grasps continue.
    #[arg(long = "loop")]
    is_loop: bool,
    /// The node that the recording replaces; only the nodes behind it run. Default: the source.
    #[arg(long, value_name = "NODE")]
    replace: Option<String>,
    /// Record every edge to this file (MCAP).
    #[arg(long)]
    record: Option<PathBuf>,
    #[command(flatten)]
    recording_options: RecordingArguments,
    /// Give a param another value than the file does; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "[NODE.]PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Print JSON: one line per decision, and a last one with "summary".
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let selection = Selection { from_nanos: arguments.from, to_nanos: arguments.to, grasps: arguments.grasps.clone() };
    if let (Some(from), Some(to)) = (arguments.from, arguments.to)
        && from >= to
    {
        bail!("--from is {} s and --to {} s: expected an earlier --from", from as f64 / 1e9, to as f64 / 1e9);
    }
    let file = dataflow::load(&arguments.dataflow)?;
    let graph = fitting(&file, &arguments.overrides, dataflow::Scope::Everything, OnMisfit::Warn)?;
    let name = arguments.name.as_deref().unwrap_or(&graph.name);
    if !dataflow::is_name(name) {
        bail!("--name '{name}': expected letters, digits, _ and -, at most 32");
    }
    let feed = Feed {
        recording: &arguments.recording,
        replace: arguments.replace.as_deref(),
        selection: &selection,
        rate: arguments.rate.clone(),
        repeat: if arguments.is_loop { json!("forever") } else { json!(1.0) },
    };
    let fed = feed.into_graph(&graph, &arguments.overrides)?;
    let n_stops = stop_requests()?;
    let session = Session {
        launch: LaunchOptions { startup_limit: Duration::from_secs(60), ..LaunchOptions::default() },
        clock: Clock::Recording,
        record: arguments.record.clone(),
        record_options: arguments.recording_options.options(),
        json: arguments.json,
        ..Session::default()
    };
    Ok(Outcome::of(session.run(&fed.graph, name, &n_stops)?.is_lossy))
}

/// Parses the player's param.
fn rate(text: &str) -> Result<Value, String> {
    let number = text.strip_suffix('x').unwrap_or(text).parse::<f64>();
    match (text, number) {
        ("recorded", _) => Ok(json!(1.0)),
        ("max", _) => Ok(json!("max")),
        (_, Ok(times)) if times > 0.0 && times.is_finite() => Ok(json!(times)),
        _ => Err("expected recorded, max, or a multiple of the recorded speed, like 2x".into()),
    }
}

fn nanos(text: &str) -> Result<u64, String> {
    secs_in(text, 0.0..=1e9).map(|secs| (1e9 * secs).round() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_and_times_are_as_people_write_them() {
        assert_eq!(rate("recorded"), Ok(json!(1.0)));
        assert_eq!(rate("0.5x"), Ok(json!(0.5)));
        assert_eq!(rate("50"), Ok(json!(50.0)));
        assert_eq!(rate("max"), Ok(json!("max")));
        for text in ["", "x", "0", "-1x", "infx", "fast"] {
            rate(text).expect_err(text);
        }
        assert_eq!(nanos("1.5"), Ok(1_500_000_000));
        assert_eq!(nanos("1m30s"), Ok(90_000_000_000));
        for text in ["", "-1", "1 fortnight", "NaN", "1e30"] {
            nanos(text).expect_err(text);
        }
    }
}
