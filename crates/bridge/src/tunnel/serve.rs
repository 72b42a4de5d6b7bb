//! The serving end: commands of another machine for this machine's part of the graph.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use super::end::{End, FromPeer, ToPeer};
use super::frame::MAX_CHUNK_BYTES;
use super::{Peer, Shared, end_of, samples};
use blindgrasp_graph::audit::summary;
use blindgrasp_graph::client::{Connection, status};
use blindgrasp_graph::control::{Reply, Request, SwapRequest};
use blindgrasp_graph::log::{LogFolder, LogTail};

/// Maximum length of a request in bytes.
const MAX_REQUEST_BYTES: usize = 1 << 20;
/// Maximum length in bytes of a line from the launcher.
const MAX_REPLY_BYTES: u64 = 4 << 20;
/// Interval at which the logs are searched for new lines.
const LOG_PAUSE: Duration = Duration::from_millis(200);
/// Maximum number of log lines that are sent first.
const MAX_LOG_LINES: usize = 10_000;
/// Maximum number of bytes of each operator's log that are read for them.
const MAX_LOG_BYTES: u64 = 4 << 20;
/// Maximum number of requests for logs of one machine at the same time.
const MAX_LOG_REQUESTS: usize = 2;
/// Minimum time between two lines of the audit log about requests of a machine that were refused here.
const REFUSAL_PAUSE: Duration = Duration::from_secs(10);
/// Number of log lines in a reply.
const LINES_PER_REPLY: usize = 200;

/// Answers the requests of a tunnel until the tunnel, the launcher or the link ends.
pub(super) async fn serve(shared: Arc<Shared>, end: End, mut stopped: watch::Receiver<bool>, _busy: mpsc::Sender<()>) {
    let peer = Arc::clone(end.peer());
    let (to_peer, pieces) = mpsc::channel(1);
    let (heard, mut from_peer) = mpsc::channel(1);
    end.answer();
    let carry = tokio::spawn(end.run(pieces, heard));
    let replies = Arc::new(Replies { to_peer: tokio::sync::Mutex::new(to_peer), is_over: AtomicBool::new(false) });
    let mut served = Served { shared, peer, replies: Arc::clone(&replies), launcher: None, work: None };
    let mut unfinished = Vec::new();
    loop {
        tokio::select! {
            heard = from_peer.recv() => {
                let Some(FromPeer::Chunk(bytes)) = heard else { break };
                unfinished.extend_from_slice(&bytes);
                let mut is_served = true;
                while is_served && let Some(newline_idx) = unfinished.iter().position(|&byte| byte == b'\n') {
                    let line: Vec<u8> = unfinished.drain(..=newline_idx).collect();
                    is_served = served.take(&line).await;
                }
                if !is_served || unfinished.len() > MAX_REQUEST_BYTES {
                    break;
                }
            }
            // The task that passes the launcher's replies on, or the stream of logs or samples, has ended.
            () = served.has_ended() => break,
            () = end_of(&mut stopped) => break,
        }
    }
    if *stopped.borrow() {
        // The graph ends: a recorder still gets the samples that were sent.
        served.finish_work().await;
    }
    replies.is_over.store(true, Ordering::Relaxed);
    drop(served);
    drop(replies);
    // The tunnel sends the remaining replies and closes. It would stop at once if `from_peer` were dropped before.
    let _ = carry.await;
    drop(from_peer);
}

/// Sends replies to the other end, each as one line.
pub(super) struct Replies {
    to_peer: tokio::sync::Mutex<mpsc::Sender<ToPeer>>,
    is_over: AtomicBool,
}

impl Replies {
    /// Whether the other end has gone.
    pub(super) fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    /// Sends a reply from a thread that may wait; returns whether the other end still reads.
    pub(super) fn send_blocking(&self, reply: &Reply) -> bool {
        let Some(line) = line_of(reply) else { return true };
        let to_peer = self.to_peer.blocking_lock();
        line.chunks(MAX_CHUNK_BYTES).all(|chunk| to_peer.blocking_send(ToPeer::Chunk(chunk.to_vec())).is_ok())
    }

    /// Gives all further replies the lowest priority.
    pub(super) fn go_bulk(&self) -> bool {
        self.to_peer.blocking_lock().blocking_send(ToPeer::Bulk).is_ok()
    }

    async fn send(&self, reply: &Reply) -> bool {
        match line_of(reply) {
            Some(line) => self.pass(&line).await,
            None => true,
        }
    }

    async fn pass(&self, line: &[u8]) -> bool {
        let to_peer = self.to_peer.lock().await;
        for chunk in line.chunks(MAX_CHUNK_BYTES) {
            if to_peer.send(ToPeer::Chunk(chunk.to_vec())).await.is_err() {
                return false;
            }
        }
        true
    }

    async fn refuse(&self, message: impl Into<String>) -> bool {
        self.send(&Reply::Error { message: message.into(), rolled_back: false }).await
    }
}

fn line_of(reply: &Reply) -> Option<Vec<u8>> {
    // Replies can always be written as JSON.
    let mut line = serde_json::to_vec(reply).ok()?;
    line.push(b'\n');
    Some(line)
}

/// The requests of one tunnel.
struct Served {
    shared: Arc<Shared>,
    peer: Arc<Peer>,
    replies: Arc<Replies>,
    /// The connection to the launcher, and the task that passes its replies on.
    launcher: Option<(OwnedWriteHalf, JoinHandle<()>)>,
    /// The task that streams logs or samples.
    work: Option<JoinHandle<()>>,
}

impl Served {
    /// Takes a request; returns whether the tunnel can go on.
    async fn take(&mut self, line: &[u8]) -> bool {
        let request = match serde_json::from_slice::<Request>(line) {
            Ok(request) => request,
            Err(error) => {
                self.shared.reject("malformed");
                return self.replies.refuse(format!("not a request of this version ({error})")).await;
            }
        };
        if let Err(message) = self.check_right(&request) {
            self.shared.reject("unauthorised");
            tracing::warn!("{message}");
            if request.is_control() {
                self.note_refusal(&request, &message);
            }
            return self.replies.refuse(message).await;
        }
        match request {
            Request::Asker { .. } | Request::Refused { .. } => {
                self.shared.reject("malformed");
                self.replies.refuse(format!("'{}' is not for other machines", request.word())).await
            }
            Request::Attach { .. } => {
                let machine = &self.shared.config.machine;
                let message =
                    format!("attaching needs the shared memory of machine '{machine}'; ask for samples instead");
                self.replies.refuse(message).await
            }
            Request::Samples { .. } | Request::Logs { .. } if self.work.is_some() => {
                self.replies.refuse("this connection is streaming already").await
            }
            Request::Samples { ports } => {
                let describe = self.shared.describe;
                let (graph, replies) = (self.shared.config.running_graph.clone(), Arc::clone(&self.replies));
                let asker = self.peer.config.machine.clone();
                self.work = Some(tokio::task::spawn_blocking(move || {
                    samples::stream(&graph, &asker, &ports, &replies, describe);
                }));
                true
            }
            Request::Logs { operator, n_lines, follow } => {
                let Some(place) = LogPlace::take(&self.peer.n_log_requests) else {
                    let (asker, here) = (&self.peer.config.machine, &self.shared.config.machine);
                    let message = format!(
                        "machine '{asker}' reads logs of machine '{here}' {MAX_LOG_REQUESTS} times already: end one of \
                         these commands first"
                    );
                    return self.replies.refuse(message).await;
                };
                let (graph, replies) = (self.shared.config.running_graph.clone(), Arc::clone(&self.replies));
                self.work = Some(tokio::task::spawn_blocking(move || {
                    // The launcher may have another environment, and so another folder of logs.
                    let of_launcher = status(&graph).map(|status| LogFolder::at(status.log_folder));
                    let folder = of_launcher.unwrap_or_else(|_| LogFolder::of_graph(&graph));
                    stream_logs(folder, operator.as_deref(), n_lines, follow, &replies);
                    drop(place);
                }));
                true
            }
            Request::Swap(swap) => match self.prepare_swap(swap.clone()).await {
                Ok(request) => self.pass_on(&Request::Swap(request)).await,
                Err(message) => {
                    self.note_refusal(&Request::Swap(swap), &message);
                    self.replies.refuse(message).await
                }
            },
            request => self.pass_on(&request).await,
        }
    }

    /// Tells the launcher, for its audit log, that a request was refused here. A machine that asks again and again must
    /// not push the other lines out of the log.
    fn note_refusal(&self, request: &Request, message: &str) {
        {
            let mut noted = super::lock(&self.peer.refusal_noted);
            if noted.is_some_and(|noted| noted.elapsed() < REFUSAL_PAUSE) {
                return;
            }
            *noted = Some(Instant::now());
        }
        let (graph, machine) = (self.shared.config.running_graph.clone(), self.peer.config.machine.clone());
        let refused = Request::Refused { what: summary(request), message: message.into() };
        tokio::task::spawn_blocking(move || {
            let mut launcher = Connection::open(&graph)?;
            launcher.send(&Request::Asker { machine })?;
            launcher.send(&refused)
        });
    }

    /// Checks that the dataflow file gives the other machine the right to make this request.
    fn check_right(&self, request: &Request) -> Result<(), String> {
        let (asker, here) = (&self.peer.config.machine, &self.shared.config.machine);
        let right = request.right(&self.shared.operators);
        if self.peer.config.may(right) {
            return Ok(());
        }
        let (what, key, narrow) = match right {
            Some(right) => ("change the", "control", format!(", or for this alone with '{}'", right.key())),
            None => ("look at the", "read", String::new()),
        };
        Err(format!(
            "machine '{asker}' may not {what} operators of machine '{here}' ({}): its dataflow file would allow it with \
             machines.{here}.{key}: [{asker}]{narrow}",
            request.word()
        ))
    }

    /// The swap for the launcher here. Program names and paths in the request are those of this machine.
    async fn prepare_swap(&self, request: SwapRequest) -> Result<SwapRequest, String> {
        let here = &self.shared.config.machine;
        if request.shadow_limit_millis > 0 {
            return Err(format!(
                "--shadow compares in the shared memory of machine '{here}': run this swap there, or without --shadow"
            ));
        }
        let graph = self.shared.config.running_graph.clone();
        let asked = tokio::task::spawn_blocking(move || status(&graph)).await;
        let status = asked.map_err(|error| error.to_string())?.map_err(|error| error.to_string())?;
        let folder = status.file.parent().unwrap_or(Path::new("/")).to_path_buf();
        let Some(run) = &request.program else {
            return Ok(SwapRequest { folder, ..request });
        };
        let program = self
            .shared
            .operators
            .program_to_run(run, request.args.as_deref().unwrap_or_default(), &folder)
            .map_err(|missing| {
            format!("--run {}: there is no such program on machine '{here}' ({})", run.display(), missing.display())
        })?;
        Ok(SwapRequest { folder, program: Some(program.path), args: Some(program.args), ..request })
    }

    /// Passes a request on to the launcher here, and from then on the launcher's replies to the other end.
    async fn pass_on(&mut self, request: &Request) -> bool {
        if self.launcher.is_none() {
            let graph = self.shared.config.running_graph.clone();
            let connected = tokio::task::spawn_blocking(move || Connection::open(&graph)).await;
            let stream = match connected {
                Ok(Ok(connection)) => in_tokio(connection),
                Ok(Err(error)) => return self.replies.refuse(format!("{:#}", anyhow::Error::from(error))).await,
                Err(error) => return self.replies.refuse(error.to_string()).await,
            };
            match stream {
                Ok(stream) => {
                    let (from_launcher, to_launcher) = stream.into_split();
                    let replies = Arc::clone(&self.replies);
                    self.launcher = Some((to_launcher, tokio::spawn(pass_back(from_launcher, replies))));
                }
                Err(error) => return self.replies.refuse(format!("the launcher cannot be reached: {error}")).await,
            }
        }
        let asker = Request::Asker { machine: self.peer.config.machine.clone() };
        let said: &[&Request] = if request.is_control() { &[&asker, request] } else { &[request] };
        let lines = said.iter().map(|said| serde_json::to_string(said).map(|line| line + "\n"));
        let lines: Result<Vec<String>, _> = lines.collect();
        let (Some((to_launcher, _)), Ok(lines)) = (&mut self.launcher, lines) else {
            return false;
        };
        // If the launcher has closed the connection, its last replies and the end are still passed back.
        let _ = to_launcher.write_all(lines.concat().as_bytes()).await;
        true
    }

    /// Waits until a task of this tunnel has ended; for ever if there is none.
    async fn has_ended(&mut self) {
        match (&mut self.launcher, &mut self.work) {
            (Some((_, passing)), Some(work)) => {
                tokio::select! {
                    _ = passing => {}
                    _ = work => {}
                }
            }
            (Some((_, passing)), None) => drop(passing.await),
            (None, Some(work)) => drop(work.await),
            (None, None) => std::future::pending().await,
        }
    }

    async fn finish_work(&mut self) {
        if let Some(work) = self.work.as_mut().filter(|work| !work.is_finished()) {
            let _ = tokio::time::timeout(super::END_LIMIT / 2, work).await;
        }
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        if let Some((_, passing)) = &self.launcher {
            passing.abort();
        }
    }
}

/// One of a machine's requests for logs.
struct LogPlace(Arc<AtomicUsize>);

impl LogPlace {
    fn take(n_requests: &Arc<AtomicUsize>) -> Option<LogPlace> {
        let more = |n: usize| (n < MAX_LOG_REQUESTS).then_some(n + 1);
        n_requests.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok()?;
        Some(LogPlace(Arc::clone(n_requests)))
    }
}

impl Drop for LogPlace {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

fn in_tokio(connection: Connection) -> std::io::Result<UnixStream> {
    let stream = connection.into_stream();
    stream.set_nonblocking(true)?;
    UnixStream::from_std(stream)
}

/// Passes the launcher's replies on until it ends the connection.
async fn pass_back(from_launcher: OwnedReadHalf, replies: Arc<Replies>) {
    let mut reader = BufReader::new(from_launcher);
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(MAX_REPLY_BYTES).read_until(b'\n', &mut line).await {
            Ok(1..) if line.ends_with(b"\n") => {}
            _ => return,
        }
        if !replies.pass(&line).await {
            return;
        }
    }
}

/// Sends the logs of operators, and with `follow` new lines too, until the client has gone.
fn stream_logs(folder: LogFolder, operator: Option<&str>, n_lines: usize, follow: bool, replies: &Replies) {
    let refuse = |message: String| replies.send_blocking(&Reply::Error { message, rolled_back: false });
    let (mut tail, mut lines) = match LogTail::open(folder, operator, n_lines.min(MAX_LOG_LINES), MAX_LOG_BYTES) {
        Ok(opened) => opened,
        Err(error) => {
            refuse(error.to_string());
            return;
        }
    };
    let mut is_first = true;
    loop {
        while is_first || !lines.is_empty() {
            let rest = lines.split_off(lines.len().min(LINES_PER_REPLY));
            let is_all = rest.is_empty();
            if !replies.send_blocking(&Reply::LogLines { lines: std::mem::replace(&mut lines, rest), is_all }) {
                return;
            }
            is_first &= !is_all;
        }
        if !follow {
            return;
        }
        std::thread::sleep(LOG_PAUSE);
        if replies.is_over() {
            return;
        }
        match tail.more() {
            Ok(more) => lines = more,
            Err(error) => {
                refuse(format!("the logs can no longer be read: {error}"));
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_has_two_places_for_requests_of_logs() {
        let n_requests = Arc::default();
        let (first, second) = (LogPlace::take(&n_requests), LogPlace::take(&n_requests));
        assert!(first.is_some() && second.is_some() && LogPlace::take(&n_requests).is_none());
        drop(first);
        let third = LogPlace::take(&n_requests);
        assert!(third.is_some() && LogPlace::take(&n_requests).is_none());
    }
}
