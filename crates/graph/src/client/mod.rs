//! The clients' end of [`control`](crate::control): finds running graphs and sends requests to them.

pub mod metrics;
pub mod observer;
pub mod shadow_comparison;
pub mod usage;

use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use serde_json::Value;

use crate::control::{GraphStatus, Reply, Request};
use blindgrasp_operator::control_socket;
use blindgrasp_operator::text::is_name;

/// The time limit of requests that a graph answers at once.
pub const ANSWER_LIMIT: Duration = Duration::from_secs(3);

/// A client checks this often whether it was interrupted or the graph has ended.
const POLL: Duration = Duration::from_millis(50);
/// Separates a graph and the machine of one of its parts.
const MACHINE_MARK: char = '@';
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
    #[error("several graphs are running: {}; name one", running.join(", "))]
    SeveralRunning { running: Vec<String> },
    #[error("graph '{graph}' is run by another user ({uid})")]
    OtherUser { graph: String, uid: u32 },
    #[error(
        "graph '{graph}' (pid {pid}) has not answered within {limit_secs} s; it may be stopped (kill -CONT {pid}) or \
         hang (kill {pid})"
    )]
    NotAnswering { graph: String, pid: i32, limit_secs: f64 },
    #[error(
        "graph '{graph}' has not answered within {limit_secs} s: its machine is cut off or busy, see blindgrasp ps"
    )]
    CutOff {
        /// The graph's part, `GRAPH@MACHINE`.
        graph: String,
        limit_secs: f64,
    },
    #[error("graph '{graph}' has no node '{node}'; its nodes: {}", known.join(", "))]
    NoNode {
        graph: String,
        node: String,
        /// The nodes on each machine, and the machines that do not answer.
        known: Vec<String>,
    },
    #[error("{} run on different machines ({}): name the nodes of one machine at a time", nodes.join(", "), parts.join(", "))]
    Apart {
        nodes: Vec<String>,
        /// The parts of the graph with these nodes.
        parts: Vec<String>,
    },
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

/// A connection to a running graph. A swap begun over it is abandoned when it is dropped.
#[derive(Debug)]
pub struct Connection {
    graph: String,
    stream: UnixStream,
    launcher_pid: i32,
    received: Vec<u8>,
    /// So many of the received bytes hold no end of a line.
    n_searched: usize,
}

/// This user's running graphs, by name, whether or not they answer.
///
/// # Errors
/// The kernel's list of sockets cannot be read.
pub fn running_graphs() -> std::io::Result<Vec<String>> {
    Ok(sockets()?.into_iter().filter(|name| !name.contains(MACHINE_MARK)).collect())
}

/// The parts of this user's running graphs that run on other machines, as `GRAPH@MACHINE`, whether or not they answer.
///
/// # Errors
/// The kernel's list of sockets cannot be read.
pub fn parts_elsewhere() -> std::io::Result<Vec<String>> {
    Ok(sockets()?.into_iter().filter(|name| name.contains(MACHINE_MARK)).collect())
}

/// The name of a running graph's part on another machine, for commands on this one.
pub fn part_name(graph: &str, machine: &str) -> String {
    format!("{graph}{MACHINE_MARK}{machine}")
}

/// The machine in a name like `GRAPH@MACHINE`.
pub fn machine_of(graph: &str) -> Option<&str> {
    graph.split_once(MACHINE_MARK).map(|(_, machine)| machine)
}

fn sockets() -> std::io::Result<Vec<String>> {
    Ok(control_socket::names()?.into_iter().filter(|name| is_graph_name(name)).collect())
}

/// The graph asked for, or the only graph that is running.
///
/// # Errors
/// It is not running, or no graph is, or several are.
pub fn pick_graph(asked_for: Option<&str>) -> Result<String, ClientError> {
    let sockets = sockets().unwrap_or_default();
    let running: Vec<String> = sockets.iter().filter(|name| !name.contains(MACHINE_MARK)).cloned().collect();
    match (asked_for, running.as_slice()) {
        (Some(name), _) if !is_graph_name(name) => Err(ClientError::Name { name: name.into() }),
        (Some(name), _) if sockets.iter().any(|graph| graph == name) => Ok(name.into()),
        (Some(name), _) if machine_of(name).is_some() => {
            own_part(name).ok_or_else(|| ClientError::NotRunning { graph: name.into(), running: sockets.clone() })
        }
        (Some(name), running) => Err(ClientError::NotRunning { graph: name.into(), running: running.to_vec() }),
        (None, []) => Err(ClientError::NoneRunning),
        (None, [graph]) => Ok(graph.clone()),
        (None, running) => Err(ClientError::SeveralRunning { running: running.to_vec() }),
    }
}

/// The part of a graph that has all of these nodes: the part here, or another machine's, as `GRAPH@MACHINE`. A name
/// with a machine is returned as it is.
///
/// # Errors
/// No part has the nodes, or they are on different machines.
pub fn locate(graph: &str, nodes: &[String]) -> Result<String, ClientError> {
    let elsewhere = parts_elsewhere().unwrap_or_default();
    let elsewhere: Vec<String> = elsewhere
        .into_iter()
        .filter(|part| part.split_once(MACHINE_MARK).is_some_and(|(own, _)| own == graph))
        .collect();
    if elsewhere.is_empty() || machine_of(graph).is_some() {
        return Ok(graph.into());
    }
    let mut parts = Vec::new();
    let mut known = Vec::new();
    let mut left: Vec<&String> = nodes.iter().collect();
    for part in std::iter::once(graph.to_string()).chain(elsewhere) {
        if left.is_empty() {
            break;
        }
        match status(&part) {
            Ok(status) => {
                let has = |node: &String| status.nodes.iter().any(|own| own.node == *node);
                let n_before = left.len();
                left.retain(|node| !has(node));
                if left.len() < n_before {
                    parts.push(part);
                } else {
                    let names: Vec<&str> = status.nodes.iter().map(|node| node.node.as_str()).collect();
                    let on = machine_of(&part).map_or_else(String::new, |machine| format!(" on {machine}"));
                    known.push(format!("{}{on}", names.join(", ")));
                }
            }
            // The part here must answer.
            Err(error) if machine_of(&part).is_none() => return Err(error),
            Err(error) => known.push(format!("unknown on {} ({error})", machine_of(&part).unwrap_or_default())),
        }
    }
    match (left.first(), parts.as_slice()) {
        (None, [part]) => Ok(part.clone()),
        // The launcher reports the unknown node.
        (None, []) => Ok(graph.into()),
        (None, _) => Err(ClientError::Apart { nodes: nodes.to_vec(), parts }),
        (Some(node), _) => Err(ClientError::NoNode { graph: graph.into(), node: node.to_string(), known }),
    }
}

/// The graph here, if the machine of `GRAPH@MACHINE` is this one.
fn own_part(name: &str) -> Option<String> {
    let (graph, machine) = name.split_once(MACHINE_MARK)?;
    let link = status(graph).ok()?.link?;
    (link.machine == machine).then(|| graph.into())
}

/// Whether a running graph can have this name: a file's name, or that with a number behind it, or `GRAPH@MACHINE` for
/// its part on another machine.
pub fn is_graph_name(text: &str) -> bool {
    let (text, machine) = text.split_once(MACHINE_MARK).map_or((text, None), |(text, machine)| (text, Some(machine)));
    if machine.is_some_and(|machine| !is_name(machine)) {
        return false;
    }
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
        Reply::Status(status) => Ok(status),
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
                ClientError::NotRunning { graph: graph.into(), running: running_graphs().unwrap_or_default() }
            }
            Errno::AGAIN => ClientError::QueueFull { graph: graph.into() },
            errno => ClientError::Io { graph: graph.into(), source: errno.into() },
        };
        let uid = rustix::process::getuid().as_raw();
        let socket = control_socket::connect(graph).map_err(failed)?;
        let peer = rustix::net::sockopt::socket_peercred(socket.as_fd()).map_err(failed)?;
        if peer.uid.as_raw() != uid {
            return Err(ClientError::OtherUser { graph: graph.into(), uid: peer.uid.as_raw() });
        }
        let stream = UnixStream::from(socket);
        let launcher_pid = peer.pid.as_raw_nonzero().get();
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
            if left.is_zero() && machine_of(&self.graph).is_some() {
                return Err(ClientError::CutOff { graph: self.graph.clone(), limit_secs: limit.as_secs_f64() });
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

    /// Waits until the graph has ended: its name is free, or another launcher has it.
    ///
    /// # Errors
    /// The connection failed.
    pub fn wait_until_ended(mut self) -> Result<(), ClientError> {
        let is_elsewhere = machine_of(&self.graph).is_some();
        loop {
            match self.receive_within(Duration::from_secs(1)) {
                Err(error @ ClientError::Refused { .. }) if is_elsewhere => return Err(error),
                Ok(_) | Err(ClientError::Refused { .. }) => {}
                Err(ClientError::Ended { .. }) => break,
                Err(error) => return Err(error),
            }
        }
        if is_elsewhere {
            // This machine's link listens under that name.
            return Ok(());
        }
        // The launcher frees the name after it has cleaned up.
        loop {
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

    /// The bare connection, to pass on requests and replies.
    pub fn into_stream(self) -> UnixStream {
        self.stream
    }

    /// The error for a reply that does not belong to the request.
    pub fn unexpected(&self, reply: &Reply) -> ClientError {
        let found = serde_json::to_string(reply).unwrap_or_else(|_| format!("{reply:?}"));
        ClientError::Unexpected { graph: self.graph.clone(), found: shortened(&found) }
    }

    fn reply(&self, line: &[u8]) -> Result<Reply, ClientError> {
        let reply = match machine_of(&self.graph) {
            Some(_) => reply_from_elsewhere(line),
            None => serde_json::from_slice(line),
        };
        match reply {
            Ok(Reply::Status(status)) if machine_of(&self.graph).is_some() => {
                // It has another name there, maybe the name of a graph here.
                Ok(Reply::Status(GraphStatus { graph: self.graph.clone(), ..status }))
            }
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

/// Another machine may have sent anything: characters that a terminal would obey are escaped.
fn reply_from_elsewhere(line: &[u8]) -> serde_json::Result<Reply> {
    if line.is_ascii() && !line.contains(&b'\\') {
        return serde_json::from_slice(line);
    }
    serde_json::from_value(printable_json(serde_json::from_slice(line)?))
}

fn printable_json(value: Value) -> Value {
    match value {
        Value::String(text) => Value::String(crate::log::printable(&text)),
        Value::Array(values) => Value::Array(values.into_iter().map(printable_json).collect()),
        Value::Object(values) => {
            let fit = |(key, value): (String, Value)| (crate::log::printable(&key), printable_json(value));
            Value::Object(values.into_iter().map(fit).collect())
        }
        other => other,
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
    if running.is_empty() { "none is".into() } else { format!("running: {}", running.join(", ")) }
}

fn shortened(text: &str) -> String {
    let text: String = text.chars().take(200).collect();
    format!("'{}'", crate::log::printable(&text))
}

#[cfg(test)]
mod tests {

    use super::*;
    use crate::control::NodeStatus;
    use crate::testing::{listen, made_status, serve};

    /// A name that no other test, and no test of another process, has.
    fn unique(name: &str) -> String {
        format!("{name}-{}", std::process::id())
    }

    #[test]
    fn a_graph_is_found_asked_and_seen_to_end() {
        let graph = unique("found");
        let answers = vec![
            (Request::Status, vec![Reply::Status(made_status(&graph))]),
            (Request::Stop, vec![Reply::Stopping, Reply::Progress { message: "draining".into() }]),
        ];
        let server = serve(&graph, answers);
        assert!(running_graphs().expect("listed").contains(&graph));
        assert_eq!(pick_graph(Some(&graph)).expect("running"), graph);
        let mut connection = Connection::open(&graph).expect("connected");
        let found = connection.ask(&Request::Status, ANSWER_LIMIT).expect("answered");
        assert_eq!(found, Reply::Status(made_status(&graph)));
        assert_eq!(connection.ask(&Request::Stop, ANSWER_LIMIT).expect("answered"), Reply::Stopping);
        connection.wait_until_ended().expect("ended");
        assert!(!running_graphs().expect("listed").contains(&graph));
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
        let line = serde_json::to_string(&Reply::Status(made_status(&graph))).expect("JSON");
        let (first, second) = line.split_at(line.len() / 2);
        stream.write_all(first.as_bytes()).expect("sent");
        assert_eq!(connection.receive_within(Duration::from_millis(20)).expect("connected"), None);
        writeln!(stream, "{second}\n{{\"reply\":\"stopping\"}}").expect("sent");
        let whole = connection.receive(ANSWER_LIMIT, &|| false).expect("a reply");
        assert_eq!(whole, Reply::Status(made_status(&graph)));
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
    fn a_node_is_found_on_whichever_machine_it_runs() {
        let graph = unique("located");
        let brain = part_name(&graph, "brain");
        let of = |graph: &str, nodes: &[&str]| {
            let mut status = made_status(graph);
            let node = status.nodes.remove(0);
            status.nodes = nodes.iter().map(|id| NodeStatus { node: id.to_string(), ..node.clone() }).collect();
            vec![(Request::Status, vec![Reply::Status(status)])]
        };
        let located = |nodes: &[&str], is_brain_asked: bool| {
            let here = serve(&graph, of(&graph, &["contacts", "link"]));
            // Another name there does not matter, nor does what it does to a terminal.
            let there = serve(&brain, of("other", &["classifier", "his\u{1b}togram"]));
            let nodes: Vec<String> = nodes.iter().map(|node| node.to_string()).collect();
            let found = locate(&graph, &nodes);
            here.join().expect("asked as expected");
            if !is_brain_asked {
                let status = status(&brain).expect("answered");
                assert_eq!((status.graph, status.nodes[1].node.as_str()), (brain.clone(), "his\\u{1b}togram"));
            }
            there.join().expect("asked as expected");
            found
        };
        assert_eq!(located(&["contacts"], false).expect("here"), graph);
        assert_eq!(located(&["classifier"], true).expect("there"), brain);
        let apart = located(&["classifier", "contacts"], true).expect_err("on two machines");
        assert!(
            matches!(&apart, ClientError::Apart { parts, .. } if *parts == [graph.clone(), brain.clone()]),
            "{apart}"
        );
        let unknown = located(&["clasifier"], true).expect_err("nowhere").to_string();
        let expected = "has no node 'clasifier'; its nodes: contacts, link, classifier, his\\u{1b}togram on brain";
        assert!(unknown.ends_with(expected), "{unknown}");
        // Without other machines nobody is asked; a name that says the machine is taken at its word.
        assert_eq!(locate(&graph, &["x".into()]).expect("as it is"), graph);
        assert_eq!(locate(&brain, &["x".into()]).expect("as it is"), brain);
    }

    #[test]
    fn another_machines_part_is_no_other_graph() {
        let graph = unique("parts");
        let brain = part_name(&graph, "brain");
        let (_own, part) = (listen(&graph), listen(&brain));
        let running = running_graphs().expect("listed");
        assert!(running.contains(&graph) && !running.contains(&brain), "{running:?}");
        assert!(parts_elsewhere().expect("listed").contains(&brain));
        assert_eq!(pick_graph(Some(&brain)).expect("reachable"), brain);
        assert!(is_graph_name(&brain) && !is_graph_name("a@") && !is_graph_name("@b") && !is_graph_name("a@b@c"));
        // Who does not answer is another machine, not a process of this one.
        let mut connection = Connection::open(&brain).expect("connected");
        let silent = connection.ask(&Request::Status, Duration::from_millis(60)).expect_err("no answer");
        assert!(matches!(silent, ClientError::CutOff { .. }), "{silent:?}");
        drop((connection, part));
        let gone = pick_graph(Some(&part_name(&format!("{graph}-7"), "brain"))).expect_err("not there");
        assert!(matches!(gone, ClientError::NotRunning { .. }), "{gone:?}");
    }

    #[test]
    fn names_of_graphs_are_told_from_other_names() {
        let longest = "a".repeat(32);
        assert!(is_graph_name(&longest) && is_graph_name(&format!("{longest}-64")));
        assert!(!is_graph_name(&format!("{longest}-x")) && !is_graph_name("a/b") && !is_graph_name(""));
    }
}
