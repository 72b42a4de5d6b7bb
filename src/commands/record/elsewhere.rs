//! Records a graph's part on another machine: the link there reads the edges and sends the samples.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};

use super::span::{EdgeSpan, Places, Span};
use super::{Arguments, POLL, Summary};
use blindgrasp_graph::client::observer::Sink;
use blindgrasp_graph::client::{ClientError, Connection};
use blindgrasp_graph::control::{Reply, Request, SampleBatch, Sampling};
use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_graph::sample_batch;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_session::recorder::Recorder;

/// The other machine must begin to read its edges within this time.
const BEGIN_LIMIT: Duration = Duration::from_secs(10);
/// At the end, the recorder waits this long for the last samples of the recording.
const LEAVE_LIMIT: Duration = Duration::from_secs(3);

/// The progress of the graph there when the latest samples were sent.
#[derive(Default)]
struct Told {
    answered: BTreeMap<usize, Option<SampleId>>,
    sent: BTreeMap<usize, Option<SampleId>>,
}

impl Places for Told {
    fn answered(&self, cell: usize) -> Option<SampleId> {
        self.answered.get(&cell).copied().flatten()
    }

    fn sent(&self, cell: usize) -> Option<SampleId> {
        self.sent.get(&cell).copied().flatten()
    }
}

struct Incoming {
    /// Topic and type of each edge.
    edges: Vec<(String, String)>,
    span: Span<Told>,
    has_said_left_out: bool,
}

pub(super) fn record(
    arguments: &Arguments,
    mut connection: Connection,
    is_interrupted: &dyn Fn() -> bool,
) -> anyhow::Result<Summary> {
    connection.send(&Request::Samples { ports: arguments.edges.clone() })?;
    let Sampling { edges, unreadable, places, about } = match connection.receive(BEGIN_LIMIT, is_interrupted)? {
        Reply::Sampling(sampling) => *sampling,
        other => return Err(connection.unexpected(&other).into()),
    };
    let start = Instant::now();
    for port in unreadable {
        print_diagnostic(&format!("blindgrasp: {port} is not recorded: its type is unknown"));
    }
    if edges.is_empty() {
        bail!("graph '{}' has no edge that can be recorded", connection.graph());
    }
    let recorder = Recorder::create(&arguments.out, about, &arguments.recording.options())?;
    let failed = Arc::new(AtomicBool::new(false));
    let mut span = Span::new(Told::default(), edges.iter().map(EdgeSpan::of).collect(), recorder, Arc::clone(&failed));
    span.begin(&places);
    let of_edges = edges.into_iter().map(|edge| (edge.topic, edge.input.service.type_name)).collect();
    let mut incoming = Incoming { edges: of_edges, span, has_said_left_out: false };
    print_diagnostic(&format!(
        "recording {} edges of graph '{}' to {}; Ctrl-C ends the recording",
        incoming.edges.len(),
        connection.graph(),
        arguments.out.display()
    ));
    let end = arguments.for_secs.map(|secs| start + Duration::from_secs_f64(secs));
    let mut leaving: Option<Instant> = None;
    let (ending, error) = loop {
        let is_due = is_interrupted() || failed.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
        if is_due && leaving.is_none() {
            leaving = Some(Instant::now());
            incoming.span.leave();
        }
        if leaving.is_some_and(|since| incoming.span.has_enough() || since.elapsed() > LEAVE_LIMIT) {
            break (Ending::Detached, None);
        }
        let left = end.map_or(POLL, |end| end.saturating_duration_since(Instant::now()).min(POLL));
        let left = if leaving.is_some() { POLL } else { left };
        match connection.receive_within(left) {
            Ok(None) => {}
            Ok(Some(Reply::Samples(batch))) => incoming.take(batch)?,
            Ok(Some(Reply::Drained)) => break (Ending::Graph, None),
            Err(ClientError::Ended { .. }) => break (Ending::Broken, None),
            // The link between the machines failed: the samples so far are recorded.
            Err(ClientError::Refused { message, .. }) => break (Ending::Broken, Some(message)),
            Ok(Some(other)) => return Err(connection.unexpected(&other).into()),
            Err(error) => return Err(error.into()),
        }
    };
    let graph = connection.graph().to_string();
    drop(connection);
    let secs = start.elapsed().as_secs_f64();
    let (edges, mut recorded) = incoming.span.finish(ending);
    if let Some(error) = error {
        print_diagnostic(&format!("blindgrasp: recording has ended: {error}"));
        recorded.error.get_or_insert(error);
    }
    let missing = edges.iter().map(|edge| edge.missing).sum();
    Ok(Summary { graph, ended: ending.word(), secs, edges, missing, recorded })
}

impl Incoming {
    fn take(&mut self, batch: SampleBatch) -> anyhow::Result<()> {
        let SampleBatch { samples, answered, sent, n_left_out } = batch;
        if n_left_out > 0 && !self.has_said_left_out {
            self.has_said_left_out = true;
            print_diagnostic("blindgrasp: the link to the other machine is too slow for all samples: some are missing");
        }
        for (edge_idx, record) in
            sample_batch::samples(&samples).map_err(|message| anyhow!("the other machine sent {message}"))?
        {
            let Some((topic, type_name)) = self.edges.get(usize::from(edge_idx)) else {
                bail!("the other machine sent a sample of edge {edge_idx} of {}", self.edges.len());
            };
            if record.type_name() != type_name {
                bail!("the other machine sent a {} on {topic}, which carries {type_name}", record.type_name());
            }
            self.span.take(topic, record, 0)?;
        }
        *self.span.places_mut() = Told { answered: answered.into_iter().collect(), sent: sent.into_iter().collect() };
        Ok(())
    }
}
