//! `blindgrasp echo`

use std::fmt::Write as _;
use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;

use super::export::json_of;
use super::ros_messages::RosMessages;
use super::view::live::hand_of;
use super::{Outcome, completions, secs_in, stop_signal};
use blindgrasp_graph::client::observer::{Observer, Sink};
use blindgrasp_graph::client::{Connection, Heard, pick_graph};
use blindgrasp_messages::{Record, with_sample};
use blindgrasp_operator::diagnostics::{LinePrinter, print_diagnostic};
use serde_json::json;

const POLL: Duration = Duration::from_millis(20);
/// This many lines wait for the reader of stdout.
const MAX_UNREAD_LINES: usize = 1 << 14;

/// Print the samples of a running graph, one JSON object a line
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp echo decision\n          \
                        blindgrasp echo -n 1 classifier/prediction contacts/contacts\n\n\
                        The lines are those of blindgrasp export. The graph does not wait for a reader of stdout that is too slow:\n\
                        lines that are left out for that reason are counted. blindgrasp top shows rates.\n\
                        Two commands can read a graph at once: echo, record and view --foxglove.")]
pub(super) struct Arguments {
    /// Outputs to read, as NODE/PORT or by a port's name that no other node has; a node alone stands for all its outputs
    /// [default: all]
    #[arg(value_name = "NODE/PORT", add = completions::outputs())]
    edges: Vec<String>,
    /// End after so many samples
    #[arg(short = 'n', long, value_parser = clap::value_parser!(u64).range(1..))]
    samples: Option<u64>,
    /// End after so many seconds
    #[arg(long = "for", value_name = "TIME", value_parser = |text: &str| secs_in(text, 0.01..=1e8))]
    for_secs: Option<f64>,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print messages of ROS 2, as blindgrasp_ros publishes them
    ///
    /// A line is {"topic", "type", "cdr"}, the message in hexadecimal. A decision is {"decision": {…}, "valid_until_nanos"}: nobody
    /// may act upon it later (CLOCK_BOOTTIME).
    #[arg(long)]
    cdr: bool,
}

/// Prints samples until there are enough.
struct Echo {
    printer: LinePrinter,
    n_left: Arc<AtomicU64>,
    messages: Option<RosMessages>,
    /// The key of the hashes that stand for the graph's epochs.
    epochs: RandomState,
}

impl Sink for Echo {
    fn take(&mut self, topic: &str, record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        if self.printer.has_ended() {
            // The reader of stdout has gone.
            self.n_left.store(0, Ordering::Relaxed);
        }
        if self.n_left.load(Ordering::Relaxed) > 0 {
            self.print(topic, record)?;
            self.n_left.fetch_sub(1, Ordering::Relaxed);
        }
        Ok(())
    }
}

impl Echo {
    fn print(&mut self, topic: &str, mut record: Record) -> anyhow::Result<()> {
        let Some(messages) = &mut self.messages else {
            self.printer.print(&json_of(topic, &record)?.to_string());
            return Ok(());
        };
        if let Record::Decision(sample) = &record {
            let until_nanos = sample.header.valid_until_nanos();
            self.printer.print(&json!({"decision": sample.message, "valid_until_nanos": until_nanos}).to_string());
            return Ok(());
        }
        // Others can read the topics, and a user of this machine who forges samples needs the epoch.
        with_sample!(&mut record, sample => sample.header.epoch = self.epochs.hash_one(sample.header.epoch));
        for (channel, data) in messages.of(topic, &record, |_| true) {
            let channel = &messages.channels[channel];
            let mut line = format!(r#"{{"topic":"{}","type":"{}","cdr":""#, channel.topic, channel.schema);
            for byte in data {
                write!(line, "{byte:02x}")?;
            }
            line.push_str("\"}");
            self.printer.print(&line);
        }
        Ok(())
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let stop: Arc<AtomicBool> = stop_signal()?;
    let graph = pick_graph(arguments.graph.as_deref())?;
    let mut connection = Connection::open(&graph)?;
    let attachment = connection.attach(&arguments.edges, false)?;
    let n_left = Arc::new(AtomicU64::new(arguments.samples.unwrap_or(u64::MAX)));
    let printer = LinePrinter::new(std::io::stdout(), MAX_UNREAD_LINES);
    let messages = arguments.cdr.then(|| RosMessages::new(&attachment.edges, hand_of(&attachment.graph).as_ref()));
    let echo = Echo { printer, n_left: Arc::clone(&n_left), messages, epochs: RandomState::new() };
    let observer = Observer::start_attached(&attachment.domain, attachment.observed(), echo);
    let observer = observer.context("cannot read the graph's edges")?;
    let end = arguments.for_secs.map(|secs| Instant::now() + Duration::from_secs_f64(secs));
    let is_over = loop {
        let is_enough = n_left.load(Ordering::Relaxed) == 0;
        let is_interrupted = stop.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
        if is_enough || is_interrupted || observer.has_failed() {
            break false;
        }
        if let Heard::Ended(_) = connection.hear(POLL)? {
            break true;
        }
    };
    if is_over && arguments.samples.is_some() {
        print_diagnostic(&format!("graph '{graph}' has ended"));
    }
    let finished = if is_over { observer.finish() } else { observer.leave() };
    drop(connection);
    let (mut echo, _) = finished.context("cannot read the graph's edges any more")?;
    echo.printer.flush(&|| stop.load(Ordering::Relaxed));
    if let Some(error) = echo.printer.take_failure() {
        return Err(error).context("samples could not be written to stdout");
    }
    if echo.printer.n_dropped() > 0 {
        print_diagnostic(&format!(
            "blindgrasp: {} lines were not printed: stdout is read too slowly",
            echo.printer.n_dropped()
        ));
        return Ok(Outcome::FinishedWithLoss);
    }
    Ok(Outcome::Done)
}
