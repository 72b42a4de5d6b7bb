//! What a command does with the samples of a run: it prints decisions and outcomes, and records.

use std::io::IsTerminal;

use serde::Serialize;

use crate::recorder::Recorder;
use crate::run::Tap;
use blindgrasp_graph::log::printable;
use blindgrasp_graph::run::{RunSink, SeenDecision};
use blindgrasp_messages::{Action, GraspTruth, LiftOutcome};
use blindgrasp_operator::diagnostics::{LinePrinter, print_diagnostic};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::text::harmless;
use blindgrasp_recording::Record;

/// This many lines wait for the reader of stdout.
const MAX_UNREAD_LINES: usize = 1 << 16;

/// Colours of a terminal (ECMA-48, Select Graphic Rendition).
pub const RED: u8 = 31;
const GREEN: u8 = 32;
pub const YELLOW: u8 = 33;

pub fn paint(text: &str, colour: u8) -> String {
    format!("\x1b[{colour}m{text}\x1b[0m")
}

/// Whether text on stdout may have colours: stdout is a terminal, and the environment does not say no.
pub fn is_coloured() -> bool {
    let variable = |name| std::env::var_os(name).unwrap_or_default();
    std::io::stdout().is_terminal() && variable("NO_COLOR").is_empty() && variable("TERM") != "dumb"
}

pub(super) struct Console {
    json: bool,
    is_quiet: bool,
    /// Actions and mistakes have colours.
    is_coloured: bool,
    /// Decisions are made and recorded whether or not stdout is read.
    pub(super) printer: LinePrinter,
    has_said_that_nobody_reads: bool,
    pub(super) recorder: Option<Recorder>,
    tap: Option<Tap>,
}

#[derive(Serialize)]
struct DecisionLine<'a> {
    grasp_id: u64,
    action: Action,
    reason: &'a str,
    probability_stable: f64,
    latency_nanos: Option<u64>,
    /// Nobody may act upon it later (CLOCK_BOOTTIME).
    valid_until_nanos: Option<u64>,
    seq: u64,
    stamp_nanos: u64,
    truth: Option<&'a GraspTruth>,
}

#[derive(Serialize)]
struct OutcomeLine<'a> {
    outcome: &'a LiftOutcome,
}

impl Console {
    pub(super) fn new(json: bool, is_quiet: bool, recorder: Option<Recorder>, tap: Option<Tap>) -> Console {
        let printer = LinePrinter::new(std::io::stdout(), MAX_UNREAD_LINES);
        Console {
            json,
            is_quiet,
            is_coloured: is_coloured(),
            printer,
            has_said_that_nobody_reads: false,
            recorder,
            tap,
        }
    }
}

impl RunSink for Console {
    fn sample(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        if let Some(tap) = &mut self.tap {
            tap(topic, &record, received_nanos)?;
        }
        if let Some(recorder) = &mut self.recorder {
            recorder.push(topic, record);
        }
        Ok(())
    }

    fn decision(&mut self, seen: &SeenDecision<'_>) -> anyhow::Result<()> {
        if self.is_quiet {
            return Ok(());
        }
        if self.printer.has_ended() && !std::mem::replace(&mut self.has_said_that_nobody_reads, true) {
            print_diagnostic(
                "blindgrasp: stdout takes no more lines: the graph goes on, and its decisions are not printed",
            );
        }
        let SeenDecision { header, decision, latency_nanos, truth } = *seen;
        let mut decision = decision.clone();
        // A program that reads the lines may move an arm.
        decision.expire(header.valid_until_nanos(), monotonic_nanos());
        let (action, reason) = (decision.action, decision.reason.as_str());
        let line = if self.json {
            let json = serde_json::to_string(&DecisionLine {
                grasp_id: decision.grasp_id,
                action,
                reason,
                probability_stable: decision.probability_stable,
                latency_nanos,
                valid_until_nanos: header.valid_until_nanos(),
                seq: header.seq,
                stamp_nanos: header.stamp_nanos,
                truth,
            })?;
            harmless(&json).into_owned()
        } else if action == Action::GoOn {
            // Several a second, for programs alone.
            return Ok(());
        } else {
            let latency = latency_nanos.map_or("-".into(), |nanos| format!("{:.0} µs", nanos as f64 / 1e3));
            let painted = |text: &str, colour| if self.is_coloured { paint(text, colour) } else { text.to_owned() };
            let truth = truth.map_or(String::new(), |truth| {
                let text = format!(
                    "label: {} ({})",
                    if truth.stable { "stable" } else { "unstable" },
                    printable(&truth.object)
                );
                let is_false_positive = action == Action::Lift && !truth.stable;
                format!("  {}", if is_false_positive { painted(&text, RED) } else { text })
            });
            let (grasp_id, p) = (decision.grasp_id, decision.probability_stable);
            let action = painted(action.shown(), if action == Action::Lift { GREEN } else { YELLOW });
            format!("grasp {grasp_id:>5}  {action}  p {p:.3}  {reason:<14} {latency:>9}{truth}")
        };
        self.printer.print_styled(line);
        Ok(())
    }

    /// Prints the outcome of a lift; the decision says enough of a grasp that was not lifted.
    fn outcome(&mut self, outcome: &LiftOutcome) -> anyhow::Result<()> {
        if self.is_quiet || !(outcome.lifted || self.json) {
            return Ok(());
        }
        let line = if self.json {
            serde_json::to_string(&OutcomeLine { outcome })?
        } else {
            format!(
                "grasp {:>5}  {}  slip {:.1} mm  turn {:.1}°  ({})",
                outcome.grasp_id,
                if outcome.held { "kept   " } else { "DROPPED" },
                outcome.slip_m * 1e3,
                outcome.turn_rad.to_degrees(),
                printable(&outcome.thing)
            )
        };
        self.printer.print(&line);
        Ok(())
    }
}
