//! The clients' end of [`control`](crate::control): finds running graphs and sends requests to them.

pub mod activity;
pub mod metrics;
pub mod observer;
pub mod poller;
pub mod shadow_comparison;
pub mod usage;
pub mod words;

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::io::Errno;

use self::observer::{ObservedEdge, can_observe};
use crate::control::{Attachment, GraphStatus, Reply, Request};
use crate::recorded_graph::Ending;
use blindgrasp_operator::control_socket;
use blindgrasp_operator::peer::peer_of;
use blindgrasp_operator::text::is_name;

/// The time limit of requests that a graph answers at once.
pub const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// A launcher that has closed its connections frees its name within this time.
const CLEANUP_LIMIT: Duration = Duration::from_secs(60);

/// A client checks this often whether it was interrupted or the graph has ended.
const POLL: Duration = Duration::from_millis(50);
/// Longer lines are not replies.
const MAX_LINE_BYTES: usize = 16 << 20;

/// Why a graph could not be asked, or did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    #[error("graph name '{name}': expected letters, digits, _ and -, at most 32")]
    Name { name: String },
    #[error("no graph is running; start one with: blindgrasp run")]
    NoneRunning,
    #[error("no graph '{graph}' is running; {}", listed(running))]
    NotRunning { graph: String, running: Vec<String> },
    #[error("several graphs are running: {}; name one of them", running.join(", "))]
    SeveralRunning { running: Vec<String> },
    #[error("graph '{graph}' is run by another user ({uid})")]
    OtherUser { graph: String, uid: u32 },
    #[error(
        "graph '{graph}' (pid {pid}) has not answered within {limit_secs} s; it may be stopped (kill -CONT {pid}) or \
         hang (kill {pid})"
    )]
    NotAnswering { graph: String, pid: i32, limit_secs: f64 },
    #[error("graph '{graph}' does not answer: its queue of clients is full; its launcher may be stopped or hang")]
    QueueFull { graph: String },
    #[error("graph '{graph}' has ended before it answered")]
    Ended { graph: String },
    /// The answer is not a reply, or not one to the request.
    #[error("graph '{graph}' answered with {found}; is it run by another version of blindgrasp?")]
    Unexpected { graph: String, found: String },
    /// The graph refused the request.
    #[error("{message}")]
    Refused {
        message: String,
        /// Whether a replacement had taken over and the old operator is active again.
        rolled_back: bool,
    },
    #[error("interrupted")]
    Interrupted,
    #[error("cannot talk to graph '{graph}'")]
    Io { graph: String, source: std::io::Error },
}

/// A graph that was started right before has its name after this time, unless its check fails or takes long.
const NAME_LIMIT: Duration = Duration::from_millis(300);
const NAME_POLL: Duration = Duration::from_millis(10);

/// A connection to a running graph. A swap begun over it is abandoned when it is dropped.
#[derive(Debug)]
pub struct Connection {
    graph: String,
    stream: UnixStream,
    /// 0 if it is in another PID namespace.
    launcher_pid: i32,
    received: Vec<u8>,
    /// So many of the received bytes hold no end of a line.
    n_searched: usize,
}

/// The news of a graph for an attached client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heard {
    Nothing,
    /// Somebody asks the flight recorders for a file.
    Keep,
    /// The graph has ended: whole, or [`Ending::Broken`].
    Ended(Ending),
}

impl Attachment {
    /// The edges of known types, for an observer that they do not wake.
    pub fn observed(&self) -> Vec<ObservedEdge> {
        let known = self.edges.iter().filter(|edge| can_observe(&edge.input.service.type_name));
        let observed =
            known.map(|edge| ObservedEdge { topic: edge.topic.clone(), input: edge.input.clone(), is_prompt: false });
        observed.collect()
    }
}

/// This user's running graphs, by name, whether or not they answer.
pub fn running_graphs() -> Vec<String> {
    control_socket::names().into_iter().filter(|name| is_graph_name(name)).collect()
}

/// The graph asked for, or the only graph that is running.
///
/// # Errors
/// It is not running, or no graph is, or several are.
pub fn pick_graph(asked_for: Option<&str>) -> Result<String, ClientError> {
    let running = running_graphs();
    match (asked_for, running.as_slice()) {
        (Some(name), _) if !is_graph_name(name) => Err(ClientError::Name { name: name.into() }),
        (Some(name), _) if running.iter().any(|graph| graph == name) => Ok(name.into()),
        (Some(name), running) => Err(ClientError::NotRunning { graph: name.into(), running: running.to_vec() }),
        (None, []) => Err(ClientError::NoneRunning),
        (None, [graph]) => Ok(graph.clone()),
        (None, running) => Err(ClientError::SeveralRunning { running: running.to_vec() }),
    }
}

/// As [`pick_graph`], for a command right after the start of a graph: waits for a moment until the graph has its name.
///
/// # Errors
/// As [`pick_graph`].
pub fn pick_starting_graph(asked_for: Option<&str>) -> Result<String, ClientError> {
    let start = Instant::now();
    loop {
        let picked = pick_graph(asked_for);
        let is_missing = matches!(picked, Err(ClientError::NotRunning { .. } | ClientError::NoneRunning));
        if !is_missing || start.elapsed() > NAME_LIMIT {
            return picked;
        }
        std::thread::sleep(NAME_POLL);
    }
}

/// Whether a running graph can have this name: a file's name, or that with a number behind it.
pub fn is_graph_name(text: &str) -> bool {
    let is_numbered = |(name, number): (&str, &str)| is_name(name) && number.parse::<u32>().is_ok();
    is_name(text) || text.rsplit_once('-').is_some_and(is_numbered)
}

/// The status of a graph.
///
/// # Errors
/// The graph does not run or does not answer.
pub fn status(graph: &str) -> Result<GraphStatus, ClientError> {
    let mut connection = Connection::open(graph)?;
    match connection.ask(&Request::Status, ANSWER_LIMIT)? {
        Reply::Status(status) => Ok(*status),
        other => Err(connection.unexpected(&other)),
    }
}

impl Connection {
    /// Connects to a graph.
    ///
    /// # Errors
    /// It does not run, or is another user's.
    pub fn open(graph: &str) -> Result<Connection, ClientError> {
        let failed = |errno: Errno| match errno {
            Errno::NOENT | Errno::CONNREFUSED | Errno::CONNRESET => {
                ClientError::NotRunning { graph: graph.into(), running: running_graphs() }
            }
            Errno::AGAIN => ClientError::QueueFull { graph: graph.into() },
            errno => ClientError::Io { graph: graph.into(), source: errno.into() },
        };
        let uid = rustix::process::getuid().as_raw();
        let socket = control_socket::connect(graph).map_err(failed)?;
        let peer = peer_of(&socket).map_err(|source| ClientError::Io { graph: graph.into(), source })?;
        if peer.uid != uid {
            return Err(ClientError::OtherUser { graph: graph.into(), uid: peer.uid });
        }
        let stream = UnixStream::from(socket);
        let launcher_pid = peer.pid.unwrap_or(0);
        let connection = Connection { graph: graph.into(), stream, launcher_pid, received: Vec::new(), n_searched: 0 };
        connection.stream.set_nonblocking(false).map_err(|error| connection.broken(error))?;
        // Requests are short: one that cannot be sent has no reader.
        connection.stream.set_write_timeout(Some(ANSWER_LIMIT)).map_err(|error| connection.broken(error))?;
        Ok(connection)
    }

    /// Sends a request. If the other side has already hung up, [`receive`](Self::receive) tells: it may have sent a
    /// reason.
    ///
    /// # Errors
    /// The connection failed.
    pub fn send(&mut self, request: &Request) -> Result<(), ClientError> {
        let mut line = serde_json::to_string(request).map_err(|error| self.broken(error.into()))?;
        line.push('\n');
        match self.stream.write_all(line.as_bytes()) {
            Err(error) if has_hung_up(&error) => Ok(()),
            written => written.map_err(|error| self.broken(error)),
        }
    }

    /// The next reply, if it comes within `limit`.
    ///
    /// # Errors
    /// The connection failed or ended, or the answer is not a reply. [`Reply::Error`] becomes [`ClientError::Refused`].
    pub fn receive_within(&mut self, limit: Duration) -> Result<Option<Reply>, ClientError> {
        let deadline = Instant::now() + limit;
        loop {
            let newline = self.received[self.n_searched..].iter().position(|&byte| byte == b'\n');
            if let Some(newline_idx) = newline.map(|idx| self.n_searched + idx) {
                let line: Vec<u8> = self.received.drain(..=newline_idx).collect();
                self.n_searched = 0;
                return self.reply(&line).map(Some);
            }
            self.n_searched = self.received.len();
            if self.received.len() > MAX_LINE_BYTES {
                let found = format!("a line of more than {MAX_LINE_BYTES} bytes");
                return Err(ClientError::Unexpected { graph: self.graph.clone(), found });
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            let read = self.stream.set_read_timeout(Some(left)).and_then(|()| self.read_some());
            match read {
                Ok(0) => return Err(ClientError::Ended { graph: self.graph.clone() }),
                Ok(_) => {}
                Err(error) if is_not_yet(&error) => {}
                Err(error) => return Err(self.broken(error)),
            }
        }
    }

    /// The next reply. `is_interrupted` is checked while waiting.
    ///
    /// # Errors
    /// See [`receive_within`](Self::receive_within); or no reply came in time, or the wait was interrupted.
    pub fn receive(&mut self, limit: Duration, is_interrupted: &dyn Fn() -> bool) -> Result<Reply, ClientError> {
        let deadline = Instant::now() + limit;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if let Some(reply) = self.receive_within(left.min(POLL))? {
                return Ok(reply);
            }
            if is_interrupted() {
                return Err(ClientError::Interrupted);
            }
            if left.is_zero() {
                let (graph, pid) = (self.graph.clone(), self.launcher_pid);
                return Err(ClientError::NotAnswering { graph, pid, limit_secs: limit.as_secs_f64() });
            }
        }
    }

    /// Sends a request and waits for its reply.
    ///
    /// # Errors
    /// See [`receive`](Self::receive).
    pub fn ask(&mut self, request: &Request, limit: Duration) -> Result<Reply, ClientError> {
        self.send(request)?;
        self.receive(limit, &|| false)
    }

    /// Attaches to these outputs, or to all if none is named.
    ///
    /// # Errors
    /// See [`receive`](Self::receive).
    pub fn attach(&mut self, ports: &[String], is_flight_recorder: bool) -> Result<Attachment, ClientError> {
        match self.ask(&Request::Attach { ports: ports.to_vec(), is_flight_recorder }, ANSWER_LIMIT)? {
            Reply::Attached(attachment) => Ok(attachment),
            other => Err(self.unexpected(&other)),
        }
    }

    /// The next news for an attached client, if it comes within `limit`.
    ///
    /// # Errors
    /// The connection failed, or the answer is no news.
    pub fn hear(&mut self, limit: Duration) -> Result<Heard, ClientError> {
        match self.receive_within(limit) {
            Ok(None) => Ok(Heard::Nothing),
            Ok(Some(Reply::Keep)) => Ok(Heard::Keep),
            Ok(Some(Reply::Drained)) => Ok(Heard::Ended(Ending::Graph)),
            Ok(Some(other)) => Err(self.unexpected(&other)),
            Err(ClientError::Ended { .. }) => Ok(Heard::Ended(Ending::Broken)),
            Err(error) => Err(error),
        }
    }

    /// Waits until the graph has ended: its name is free, or another launcher has it.
    ///
    /// # Errors
    /// The connection failed, or the launcher has closed it and does not end.
    pub fn wait_until_ended(mut self) -> Result<(), ClientError> {
        loop {
            match self.receive_within(Duration::from_secs(1)) {
                Ok(_) | Err(ClientError::Refused { .. }) => {}
                Err(ClientError::Ended { .. }) => break,
                Err(error) => return Err(error),
            }
        }
        // The launcher frees the name after it has cleaned up.
        let closed = Instant::now();
        loop {
            if closed.elapsed() > CLEANUP_LIMIT {
                let (graph, pid) = (self.graph, self.launcher_pid);
                return Err(ClientError::NotAnswering { graph, pid, limit_secs: CLEANUP_LIMIT.as_secs_f64() });
            }
            match Connection::open(&self.graph) {
                Ok(other) if other.launcher_pid == self.launcher_pid => std::thread::sleep(POLL),
                Err(ClientError::QueueFull { .. }) => std::thread::sleep(POLL),
                _ => return Ok(()),
            }
        }
    }

    pub fn graph(&self) -> &str {
        &self.graph
    }

    /// The error for a reply that does not belong to the request.
    pub fn unexpected(&self, reply: &Reply) -> ClientError {
        let found = serde_json::to_string(reply).unwrap_or_else(|_| format!("{reply:?}"));
        ClientError::Unexpected { graph: self.graph.clone(), found: shortened(&found) }
    }

    fn reply(&self, line: &[u8]) -> Result<Reply, ClientError> {
        match serde_json::from_slice(line) {
            Ok(Reply::Error { message, rolled_back }) => Err(ClientError::Refused { message, rolled_back }),
            Ok(reply) => Ok(reply),
            Err(_) => {
                let found = shortened(String::from_utf8_lossy(line).trim_end());
                Err(ClientError::Unexpected { graph: self.graph.clone(), found })
            }
        }
    }

    fn read_some(&mut self) -> std::io::Result<usize> {
        let mut chunk = [0; 16 << 10];
        let n_bytes = self.stream.read(&mut chunk)?;
        self.received.extend_from_slice(&chunk[..n_bytes]);
        Ok(n_bytes)
    }

    fn broken(&self, source: std::io::Error) -> ClientError {
        let graph = self.graph.clone();
        if has_hung_up(&source) { ClientError::Ended { graph } } else { ClientError::Io { graph, source } }
    }
}

/// Whether a read with a time limit has found no data yet.
fn is_not_yet(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    [Interrupted, TimedOut, WouldBlock].contains(&error.kind())
}

/// Whether the other side has closed the connection. Its earlier replies can still be read.
fn has_hung_up(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{BrokenPipe, ConnectionReset};
    [BrokenPipe, ConnectionReset].contains(&error.kind())
}

fn listed(running: &[String]) -> String {
    if running.is_empty() {
        "none is; start one with: blindgrasp run".into()
    } else {
        format!("running: {}", running.join(", "))
    }
}

fn shortened(text: &str) -> String {
    let text: String = text.chars().take(200).collect();
    format!("'{}'", crate::log::printable(&text))
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::testing::{listen, made_status, serve};

    /// A name that no other test, and no test of another process, has.
    fn unique(name: &str) -> String {
        format!("{name}-{}", std::process::id())
    }

    #[test]
    fn a_graph_is_found_asked_and_seen_to_end() {
        let graph = unique("found");
        let answers = vec![
            (Request::Status, vec![Reply::Status(Box::new(made_status(&graph)))]),
            (Request::Stop, vec![Reply::Stopping, Reply::Progress { message: "draining".into() }]),
        ];
        let server = serve(&graph, answers);
        assert!(running_graphs().contains(&graph));
        assert_eq!(pick_graph(Some(&graph)).expect("running"), graph);
        let mut connection = Connection::open(&graph).expect("connected");
        let found = connection.ask(&Request::Status, ANSWER_LIMIT).expect("answered");
        assert_eq!(found, Reply::Status(Box::new(made_status(&graph))));
        assert_eq!(connection.ask(&Request::Stop, ANSWER_LIMIT).expect("answered"), Reply::Stopping);
        connection.wait_until_ended().expect("ended");
        assert!(!running_graphs().contains(&graph));
        let refused = pick_graph(Some(&graph)).expect_err("ended");
        assert!(refused.to_string().starts_with(&format!("no graph '{graph}' is running")), "{refused}");
        server.join().expect("as expected");
    }

    #[test]
    fn a_refusal_and_nonsense_are_errors() {
        let graph = unique("refusing");
        let error = Reply::Error { message: "no node 'x'".into(), rolled_back: true };
        let server = serve(&graph, vec![(Request::Abandon, vec![error]), (Request::Promote, vec![Reply::Abandoned])]);
        let mut connection = Connection::open(&graph).expect("connected");
        let refused = connection.ask(&Request::Abandon, ANSWER_LIMIT).expect_err("refused");
        assert!(matches!(&refused, ClientError::Refused { rolled_back: true, .. }), "{refused:?}");
        let other = connection.ask(&Request::Promote, ANSWER_LIMIT).expect("a reply");
        assert!(connection.unexpected(&other).to_string().contains("abandoned"));
        let ended = connection.receive(ANSWER_LIMIT, &|| false).expect_err("it is gone");
        assert!(matches!(ended, ClientError::Ended { .. }), "{ended:?}");
        server.join().expect("as expected");

        let socket = listen(&graph);
        let mut connection = Connection::open(&graph).expect("connected");
        let (mut stream, _) = socket.listener().accept().expect("a client");
        stream.write_all(b"\x1b[2Jwelcome\n").expect("sent");
        let nonsense = connection.receive(ANSWER_LIMIT, &|| false).expect_err("no reply");
        assert!(nonsense.to_string().contains("'\\u{1b}[2Jwelcome'"), "{nonsense}");
    }

    #[test]
    fn what_was_said_before_the_other_side_hung_up_is_heard() {
        let graph = unique("hung-up");
        let socket = listen(&graph);
        // With a request that the other side has not read, which resets the connection, and without.
        for n_before in [0, 1, 2] {
            let mut connection = Connection::open(&graph).expect("connected");
            let (mut stream, _) = socket.listener().accept().expect("a client");
            for _ in 0..n_before {
                connection.send(&Request::Status).expect("sent");
            }
            let refusal = Reply::Error { message: "no more than 8 clients at a time".into(), rolled_back: false };
            writeln!(stream, "{}", serde_json::to_string(&refusal).expect("JSON")).expect("sent");
            drop(stream);
            let refused = connection.ask(&Request::Status, ANSWER_LIMIT).expect_err("refused");
            assert!(matches!(refused, ClientError::Refused { .. }), "{refused:?}");
            for _ in 0..2 {
                let ended = connection.ask(&Request::Status, ANSWER_LIMIT).expect_err("it has hung up");
                assert!(matches!(ended, ClientError::Ended { .. }), "{ended:?}");
            }
        }
    }

    #[test]
    fn a_reply_may_come_in_pieces() {
        let graph = unique("pieces");
        let socket = listen(&graph);
        let mut connection = Connection::open(&graph).expect("connected");
        let (mut stream, _) = socket.listener().accept().expect("a client");
        let line = serde_json::to_string(&Reply::Status(Box::new(made_status(&graph)))).expect("JSON");
        let (first, second) = line.split_at(line.len() / 2);
        stream.write_all(first.as_bytes()).expect("sent");
        assert_eq!(connection.receive_within(Duration::from_millis(20)).expect("connected"), None);
        writeln!(stream, "{second}\n{{\"reply\":\"stopping\"}}").expect("sent");
        let whole = connection.receive(ANSWER_LIMIT, &|| false).expect("a reply");
        assert_eq!(whole, Reply::Status(Box::new(made_status(&graph))));
    }

    #[test]
    fn a_launcher_that_is_stopped_hangs_nobody() {
        // It listens, as the kernel does for a stopped process, and accepts nobody.
        let graph = unique("stopped");
        let socket = listen(&graph);
        let mut connection = Connection::open(&graph).expect("the kernel connects");
        let error = connection.ask(&Request::Status, Duration::from_millis(60)).expect_err("no answer");
        assert!(matches!(error, ClientError::NotAnswering { .. }), "{error:?}");
        assert!(error.to_string().contains(&format!("kill -CONT {}", std::process::id())), "{error}");
        let interrupted = connection.receive(ANSWER_LIMIT, &|| true).expect_err("no answer");
        assert!(matches!(interrupted, ClientError::Interrupted), "{interrupted:?}");
        // So many that the queue is full: also then, nobody waits.
        rustix::net::listen(socket.listener(), 1).expect("a short queue");
        let mut clients = Vec::new();
        let full = loop {
            match Connection::open(&graph) {
                Ok(client) => clients.push(client),
                Err(error) => break error,
            }
            assert!(clients.len() < 10, "the queue has no end");
        };
        assert!(matches!(full, ClientError::QueueFull { .. }), "{full:?}");
    }

    #[test]
    fn names_of_graphs_are_told_from_other_names() {
        let longest = "a".repeat(32);
        assert!(is_graph_name(&longest) && is_graph_name(&format!("{longest}-64")));
        assert!(!is_graph_name(&format!("{longest}-x")) && !is_graph_name("a/b") && !is_graph_name(""));
    }
}
