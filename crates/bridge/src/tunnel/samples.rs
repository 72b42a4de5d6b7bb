//! Reads the edges of the graph here for a client on another machine.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::DescribeRecording;
use super::serve::Replies;
use blindgrasp_graph::client::observer::{ObservedEdge, Observer, Sink, can_observe};
use blindgrasp_graph::client::{ANSWER_LIMIT, ClientError, Connection};
use blindgrasp_graph::control::{AttachedEdge, Attachment, Reply, Request, SampleBatch, Sampling};
use blindgrasp_graph::recorded_graph::Beginning;
use blindgrasp_graph::sample_batch;
use blindgrasp_messages::Record;
use blindgrasp_operator::cursors::{SampleId, SharedCursors};

/// Maximum number of bytes that wait for a slow link. Further samples are left out and counted, and the client sees the
/// gap.
const MAX_WAITING_BYTES: usize = 32 << 20;
/// Maximum time for which a batch waits for more samples.
const BATCH_PAUSE: Duration = Duration::from_millis(10);
/// Time for which the launcher is listened to between two batches.
const WORD_WAIT: Duration = Duration::from_millis(1);
/// Interval at which the client learns the progress of the graph while there are no samples.
const NEWS_PAUSE: Duration = Duration::from_millis(50);

/// Attaches to the graph for the machine `asker` and sends its samples until the graph ends or the client has gone.
pub(super) fn stream(graph: &str, asker: &str, ports: &[String], replies: &Replies, describe: DescribeRecording) {
    if let Err(error) = attach(graph, asker, ports, replies, describe) {
        let message = format!("{error:#}");
        replies.send_blocking(&Reply::Error { message, rolled_back: false });
    }
}

fn attach(
    graph: &str,
    asker: &str,
    ports: &[String],
    replies: &Replies,
    describe: DescribeRecording,
) -> anyhow::Result<()> {
    let mut connection = Connection::open(graph)?;
    connection.send(&Request::Asker { machine: asker.into() })?;
    let attachment = match connection.ask(&Request::Attach { ports: ports.to_vec() }, ANSWER_LIMIT)? {
        Reply::Attached(attachment) => attachment,
        other => return Err(connection.unexpected(&other).into()),
    };
    let Attachment { domain, edges, graph, is_at_start } = attachment;
    let (edges, others): (Vec<AttachedEdge>, Vec<_>) =
        edges.into_iter().partition(|edge| can_observe(&edge.input.service.type_name));
    // The files of the hand and of the model are on this machine.
    let about = describe(&graph, if is_at_start { Beginning::Start } else { Beginning::Attached })?;
    let cursors = SharedCursors::open(std::path::Path::new(&domain.cursors))?;
    let observed = edges.iter().map(|edge| ObservedEdge {
        topic: edge.topic.clone(),
        input: edge.input.clone(),
        is_prompt: false,
    });
    let waiting = Arc::new(Waiting::default());
    let sink =
        Collector { topics: edges.iter().map(|edge| edge.topic.clone()).collect(), waiting: Arc::clone(&waiting) };
    let observer = Observer::start_attached(&domain, observed.collect(), sink)?;
    let observed_places = Places::of(&edges);
    let sampling = Sampling {
        unreadable: others.into_iter().map(|edge| edge.port).collect(),
        places: waiting.lock().places.clone(),
        edges,
        about,
    };
    let mut has_reader = replies.send_blocking(&Reply::Sampling(Box::new(sampling))) && replies.go_bulk();
    let mut last_sent = Instant::now();
    let ending = loop {
        if !has_reader || replies.is_over() || observer.has_failed() {
            break Ended::Left;
        }
        if waiting.wait(BATCH_PAUSE) || last_sent.elapsed() >= NEWS_PAUSE {
            last_sent = Instant::now();
            has_reader = replies.send_blocking(&Reply::Samples(waiting.take(&observed_places, &cursors)));
        }
        match connection.receive_within(WORD_WAIT) {
            Ok(None) => {}
            Ok(Some(Reply::Drained)) => break Ended::Drained,
            // A launcher that was killed says nothing before.
            Err(ClientError::Ended { .. }) => break Ended::Broken,
            Ok(Some(other)) => return Err(connection.unexpected(&other).into()),
            Err(error) => return Err(error.into()),
        }
    };
    let finished = if ending == Ended::Left { observer.leave() } else { observer.finish() };
    // A graph that ends waits for this connection; it must not wait for the other machine.
    drop(connection);
    finished?;
    while has_reader && ending != Ended::Left && waiting.has_some() {
        has_reader = replies.send_blocking(&Reply::Samples(waiting.take(&observed_places, &cursors)));
    }
    if ending == Ended::Drained {
        // The final progress of the graph.
        let _ = replies.send_blocking(&Reply::Samples(waiting.take(&observed_places, &cursors)));
        replies.send_blocking(&Reply::Drained);
    }
    Ok(())
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ended {
    /// The client has gone.
    Left,
    /// The graph has ended.
    Drained,
    /// The launcher was killed.
    Broken,
}

/// The places on the cursors that the client follows.
struct Places {
    answered: Vec<usize>,
    sent: Vec<usize>,
}

impl Places {
    fn of(edges: &[AttachedEdge]) -> Places {
        Places {
            answered: edges.iter().flat_map(|edge| edge.answered_cells.iter().copied()).collect(),
            sent: edges.iter().map(|edge| edge.input.writer_cell).collect(),
        }
    }
}

/// Samples that were read and not yet sent.
#[derive(Default)]
struct Waiting {
    queue: Mutex<Queue>,
    come: Condvar,
}

#[derive(Default)]
struct Queue {
    places: Vec<Option<SampleId>>,
    samples: VecDeque<Vec<u8>>,
    n_bytes: usize,
    n_left_out: u64,
}

impl Waiting {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn has_some(&self) -> bool {
        !self.lock().samples.is_empty()
    }

    /// Waits until a batch is full, at most for `limit`; returns whether there are samples to send.
    fn wait(&self, limit: Duration) -> bool {
        let queue = self.lock();
        let is_waiting = |queue: &mut Queue| queue.n_bytes < sample_batch::FULL_BYTES;
        let waited = self.come.wait_timeout_while(queue, limit, is_waiting);
        let (queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        !queue.samples.is_empty()
    }

    /// The next batch and the progress of the graph.
    fn take(&self, places: &Places, cursors: &SharedCursors) -> SampleBatch {
        let mut samples = Vec::new();
        let mut queue = self.lock();
        while samples.len() < sample_batch::FULL_BYTES
            && let Some(sample) = queue.samples.pop_front()
        {
            queue.n_bytes -= sample.len();
            samples.extend(sample);
        }
        let n_left_out = queue.n_left_out;
        drop(queue);
        // Answers are read before the sent samples, so that what was sent includes what was answered.
        let answered = places.answered.iter().map(|&cell| (cell, cursors.input(cell).key())).collect();
        let sent = places.sent.iter().map(|&cell| (cell, cursors.output(cell).key())).collect();
        SampleBatch { samples: sample_batch::to_text(&samples), answered, sent, n_left_out }
    }
}

/// Keeps the samples of an observer until they are sent.
struct Collector {
    topics: Vec<String>,
    waiting: Arc<Waiting>,
}

impl Sink for Collector {
    fn take(&mut self, topic: &str, record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        let Some(edge_idx) = self.topics.iter().position(|known| known == topic) else { return Ok(()) };
        let sample = sample_batch::encode(edge_idx as u16, &record)?;
        let mut queue = self.waiting.lock();
        if queue.n_bytes + sample.len() > MAX_WAITING_BYTES {
            queue.n_left_out += 1;
            return Ok(());
        }
        queue.n_bytes += sample.len();
        queue.samples.push_back(sample);
        let is_full = queue.n_bytes >= sample_batch::FULL_BYTES;
        drop(queue);
        if is_full {
            self.waiting.come.notify_one();
        }
        Ok(())
    }

    fn begin(&mut self, places: &[Option<SampleId>]) {
        self.waiting.lock().places = places.to_vec();
    }
}
