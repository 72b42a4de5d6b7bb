//! `test --sweep`: the decisions with each of several values of a param.

use std::path::PathBuf;

use serde_json::json;

use super::Outcome;
use super::case::Runner;
use crate::commands::text_table::{TextTable, percent};
use crate::commands::{print_line, print_text};
use blindgrasp_graph::dataflow::Override;
use blindgrasp_replay::checks::{Decisions, Tally};
use blindgrasp_replay::comparison::Coverage;
use blindgrasp_replay::expectations::Expectations;

/// A param and the values to try, in the order of the command line.
#[derive(Debug, Clone)]
pub(super) struct Sweep {
    param: String,
    values: Vec<Override>,
}

impl Sweep {
    /// Reads `node.param=v1,v2`.
    pub(super) fn parse(text: &str) -> Result<Sweep, String> {
        let (param, values) =
            text.split_once('=').ok_or("expected node.param=v1,v2,…, like lift_arbiter.votes=1,2,3")?;
        let values = values.split(',').map(|value| Override::parse(&format!("{param}={value}")));
        Ok(Sweep { param: param.into(), values: values.collect::<Result<_, _>>()? })
    }

    pub(super) fn run(&self, runner: &Runner<'_>, recordings: &[PathBuf], is_json: bool) -> anyhow::Result<Outcome> {
        let title = self.param.as_str();
        let titles = [title, "lifts", "holds", "accuracy", "false positives", "actions changed"];
        let (mut table, mut rows) = (TextTable::new(titles, 1), Vec::new());
        for value in &self.values {
            let overrides: Vec<Override> = runner.overrides.iter().cloned().chain([value.clone()]).collect();
            // `None` if a recording has no decisions to compare with.
            let (mut tally, mut n_changed) = (Tally::default(), Some(0));
            for recording in recordings {
                let expected = Expectations::of(recording)?.unwrap_or_default();
                let graph = runner.graph(&expected, &overrides)?;
                let (fed, decisions) = runner.decide(recording, &graph, &overrides)?;
                tally.add(decisions.tally());
                let before = Decisions::read(recording)?;
                let coverage = Coverage::of(recording, &fed.topic)?;
                let changed = decisions.changed_since(&before);
                let n = changed.iter().filter(|changed| coverage.covers_decision(changed.grasp_id)).count();
                n_changed = if before.is_empty() { None } else { n_changed.map(|so_far| so_far + n) };
            }
            let n_labelled = tally.n_labelled;
            let accuracy = (n_labelled > 0).then(|| tally.n_right as f64 / n_labelled as f64);
            table.row([
                value.text.clone(),
                tally.n_lifts.to_string(),
                tally.n_holds.to_string(),
                percent(accuracy),
                if n_labelled > 0 { tally.n_false_positive.to_string() } else { "n/a".into() },
                n_changed.map_or("n/a".into(), |n| n.to_string()),
            ]);
            rows.push(
                json!({"value": value.text, "decisions": tally, "accuracy": accuracy, "n_actions_changed": n_changed}),
            );
        }
        if is_json {
            print_text(&serde_json::to_string_pretty(&json!({"param": self.param, "values": rows}))?)?;
        } else {
            table.lines().iter().try_for_each(|line| print_line(line))?;
        }
        Ok(Outcome::Done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_param_with_its_values() {
        let sweep = Sweep::parse("lift_arbiter.votes=1,2").expect("a sweep");
        let values: Vec<String> = sweep.values.iter().map(ToString::to_string).collect();
        assert_eq!(
            (sweep.param.as_str(), values),
            ("lift_arbiter.votes", vec!["lift_arbiter.votes=1".to_string(), "lift_arbiter.votes=2".into()])
        );
        for text in ["", "votes", "=1,2", "a.b.c=1"] {
            Sweep::parse(text).expect_err(text);
        }
    }
}
