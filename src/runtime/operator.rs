//! What all operator processes have in common: `--describe`, joining the graph, readiness, draining, reports.
//!
//! An operator's `main` calls [`run`] with its description and a function that opens its ports, says that it is ready
//! and works until it is asked to stop. [`run_stage`] is that function's whole body for a stage that answers each
//! sample with one.

use std::collections::BTreeMap;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use iceoryx2::prelude::{Node, ipc};

use super::domain;
use super::port::{PortError, PortSample, Publisher, Subscriber};
use super::wiring::{GO, PortCounts, REPORT_PREFIX, Report, ServiceWiring, WIRING_VARIABLE, Wiring};
use crate::dataflow::OperatorDescription;
use crate::diagnostics::print_diagnostic;
use crate::message::Message;

/// How long an operator waits for samples before it looks at its signals again.
pub const WAIT: Duration = Duration::from_millis(20);
/// How often an operator that waits for its consumers looks for them.
const READY_POLL: Duration = Duration::from_millis(1);

/// An operator's place in a running graph.
pub struct Operator {
    wiring: Wiring,
    node: Node<ipc::Service>,
    stop: Arc<AtomicBool>,
    go: Arc<AtomicBool>,
    quit: Arc<AtomicBool>,
}

/// The `main` of an operator: answers `--describe`, or joins the graph and calls `work`.
///
/// `work` gets an operator that has not opened its ports yet. Its error is reported to the launcher, which prints it.
pub fn run(description: &OperatorDescription, work: impl FnOnce(&Operator) -> anyhow::Result<()>) -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--describe"] => match serde_json::to_string_pretty(description) {
            Ok(json) => {
                let written = std::io::stdout().lock().write_all(format!("{json}\n").as_bytes());
                return if written.is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE };
            }
            Err(error) => print_diagnostic(&format!("{}: {error}", description.operator)),
        },
        [] if std::env::var_os(WIRING_VARIABLE).is_some() => match join_and_work(work) {
            Ok(()) => return ExitCode::SUCCESS,
            Err(error) => report(&Report::Failed { message: format!("{error:#}") }),
        },
        _ => {
            print_diagnostic(&format!(
                "{}: {}\n\nAn operator: blindgrasp starts it as part of a graph (blindgrasp run dataflow.yaml).\n\
                 With --describe it prints its ports and parameters.",
                description.operator, description.summary
            ));
            return ExitCode::from(2);
        }
    }
    ExitCode::FAILURE
}

/// Answers each sample of `input` with one on `output`, until asked to stop; then drains and reports.
///
/// `stage` gets a sample, borrowed from shared memory, and writes the items of its answer to the vector, which it finds
/// empty. `max_items` is the most items that an answer has.
///
/// # Errors
/// A port's.
pub fn run_stage<In: Message, Out: Message>(
    operator: &Operator,
    input: &str,
    output: &str,
    max_items: usize,
    mut stage: impl FnMut(&PortSample<In>, &mut Vec<Out::Item>) -> Out::Head,
) -> anyhow::Result<()> {
    let mut subscriber = operator.subscriber::<In>(input)?;
    let mut publisher = operator.publisher::<Out>(output, max_items)?;
    operator.ready(|| Ok(subscriber.connect()? && publisher.has_all_consumers()))?;
    let mut items = Vec::with_capacity(max_items);
    loop {
        // Looked at before the last look at the input: whatever was sent before the request is still taken in.
        let stop = operator.should_stop();
        while let Some(sample) = subscriber.receive()? {
            items.clear();
            let head = stage(&sample, &mut items);
            publisher.send(head, &items)?;
            if operator.should_quit() {
                break;
            }
        }
        if stop {
            break;
        }
        subscriber.wait(WAIT);
    }
    operator.drained(PortCounts {
        received: BTreeMap::from([(input.into(), subscriber.counts())]),
        sent: BTreeMap::from([(output.into(), publisher.n_sent())]),
    });
    Ok(())
}

impl Operator {
    /// The node's parameters.
    ///
    /// # Errors
    /// Parameters that are not what `T` expects: `--describe` and `T` disagree.
    pub fn params<T: serde::de::DeserializeOwned>(&self) -> anyhow::Result<T> {
        serde_json::from_value(self.wiring.params.clone().into())
            .with_context(|| format!("parameters of node '{}'", self.wiring.node))
    }

    /// Opens an output port.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn publisher<M: Message>(&self, port: &str, max_items: usize) -> anyhow::Result<Publisher<M>> {
        Ok(Publisher::open(&self.node, service(&self.wiring.outputs, port)?, max_items)?)
    }

    /// Opens an input port.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn subscriber<M: Message>(&self, port: &str) -> anyhow::Result<Subscriber<M>> {
        Ok(Subscriber::open(&self.node, service(&self.wiring.inputs, port)?)?)
    }

    /// Waits until `is_connected` (every input to its publisher, every output to all its consumers), then says "ready".
    ///
    /// # Errors
    /// They are not connected within the start-up limit.
    pub fn ready(&self, mut is_connected: impl FnMut() -> Result<bool, PortError>) -> anyhow::Result<()> {
        let limit = Duration::from_millis(self.wiring.startup_limit_millis);
        let start = Instant::now();
        while !is_connected()? {
            if self.should_stop() {
                // The graph ends before it began; there is nothing to take in.
                return Ok(());
            }
            if start.elapsed() > limit {
                bail!("not all its ports were connected within {} ms", limit.as_millis());
            }
            std::thread::sleep(READY_POLL);
        }
        report(&Report::Ready);
        Ok(())
    }

    /// For sources: waits until the whole graph is ready; false if it is to stop instead.
    pub fn wait_for_go(&self) -> bool {
        while !self.go.load(Ordering::Relaxed) && !self.should_stop() {
            std::thread::sleep(READY_POLL);
        }
        !self.should_stop()
    }

    /// Whether the launcher has asked for an end: take in what is there, then call [`Operator::drained`].
    pub fn should_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || self.should_quit()
    }

    /// Whether to exit now: the launcher has all it needs, or is gone.
    pub fn should_quit(&self) -> bool {
        self.quit.load(Ordering::Relaxed)
    }

    /// Says that a source has sent all it had, and keeps its ports open until the graph is drained.
    pub fn finished(&self, counts: PortCounts) {
        report(&Report::Finished { counts });
        self.wait_for_quit();
    }

    /// Says that all inputs are drained, and keeps the ports open until the launcher has all it needs: a publisher that
    /// goes too early could take unread samples with it.
    pub fn drained(&self, counts: PortCounts) {
        report(&Report::Drained { counts });
        self.wait_for_quit();
    }

    fn wait_for_quit(&self) {
        while !self.should_quit() {
            std::thread::sleep(READY_POLL);
        }
    }
}

fn join_and_work(work: impl FnOnce(&Operator) -> anyhow::Result<()>) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }
    let (go, quit) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    std::thread::spawn({
        let (go, quit) = (Arc::clone(&go), Arc::clone(&quit));
        move || {
            for line in std::io::stdin().lines().map_while(Result::ok) {
                if line == GO {
                    go.store(true, Ordering::Relaxed);
                }
            }
            quit.store(true, Ordering::Relaxed);
        }
    });
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wiring: Wiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    let graph = wiring.graph.clone();
    let node = domain::join(&wiring.domain, &wiring.node)?;
    let operator = Operator { wiring, node, stop, go, quit };
    let outcome = work(&operator);
    drop(operator);
    domain::clear_orphaned(&graph);
    outcome
}

fn service<'a>(services: &'a BTreeMap<String, ServiceWiring>, port: &str) -> anyhow::Result<&'a ServiceWiring> {
    services.get(port).with_context(|| format!("the wiring has no port '{port}'"))
}

/// One write, so that lines of two threads don't mix. A launcher that is gone cannot be told anything.
fn report(report: &Report) {
    if let Ok(json) = serde_json::to_string(report) {
        let mut stdout = std::io::stdout().lock();
        let _ = stdout.write_all(format!("{REPORT_PREFIX}{json}\n").as_bytes()).and_then(|()| stdout.flush());
    }
}
