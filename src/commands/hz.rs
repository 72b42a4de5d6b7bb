//! `blindgrasp hz`

use std::time::Duration;

use anyhow::bail;
use clap::Args;

use super::text_table::TextTable;
use super::top::poller::Poller;
use super::top::sample::{MeasuredEdge, Quantiles, Window, measure};
use super::top::screen::short_time;
use super::{Outcome, completions, print_line, secs_in};
use blindgrasp_graph::client::pick_graph;

/// Measure rates and ages on the edges of a running graph
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp hz lift_arbiter/decision --for 5s")]
pub(super) struct Arguments {
    /// Outputs to measure [default: all]
    #[arg(value_name = "NODE/PORT", add = completions::outputs())]
    edges: Vec<String>,
    /// Measure for this time
    #[arg(long = "for", value_name = "TIME", default_value = "2", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    for_secs: f64,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON, one object an edge, as in top --json
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graph = pick_graph(arguments.graph.as_deref())?;
    let (mut poller, first) = Poller::connect(&graph)?;
    if let Some(unknown) =
        arguments.edges.iter().find(|edge| first.status.edges.iter().all(|known| known.from != **edge))
    {
        let mut known: Vec<&str> = first.status.edges.iter().map(|edge| edge.from.as_str()).collect();
        known.dedup();
        bail!("graph '{graph}' has no output {unknown}; its outputs: {}", known.join(", "));
    }
    std::thread::sleep(Duration::from_secs_f64(arguments.for_secs));
    let now = poller.look()?;
    let measured = measure(&now, Window { previous: &first, rates_since: Some(&first), counts_since: Some(&first) });
    let is_wanted = |edge: &&MeasuredEdge| arguments.edges.is_empty() || arguments.edges.contains(&edge.from);
    let edges = measured.edges.iter().filter(is_wanted);
    if arguments.json {
        for edge in edges {
            print_line(&serde_json::to_string(edge)?)?;
        }
        return Ok(Outcome::Done);
    }
    let mut table = TextTable::new(["edge", "rate/s", "p50", "p90", "p99", "dropped", "missing"], 1);
    for edge in edges {
        let age = |of: fn(&Quantiles) -> u64| edge.age_nanos.as_ref().map_or("-".into(), |ages| short_time(of(ages)));
        table.row([
            format!("{} → {}", edge.from, edge.to),
            format!("{:.1}", edge.rate_hz),
            age(|ages| ages.p50),
            age(|ages| ages.p90),
            age(|ages| ages.p99),
            edge.dropped.to_string(),
            edge.missing.to_string(),
        ]);
    }
    for line in table.lines() {
        print_line(&line)?;
    }
    Ok(Outcome::Done)
}
