//! The launcher's end of [`control`](crate::control): reads requests and hands them to its loop.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::control::{Reply, Request, SwapRequest};
use crate::dataflow::pins::Pins;
use crate::describe::describe;
use crate::launcher::Event;
use crate::launcher::audit::Trail;
use crate::launcher::log_writer::Log;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::peer::peer_of;

/// Longer requests are refused.
const MAX_REQUEST_BYTES: u64 = 1 << 20;
/// This many replies may wait for a client to read them; further replies are dropped.
const MAX_PENDING_REPLIES: usize = 256;
/// The pause after a failure to accept a client.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// The most clients at a time.
const MAX_CLIENTS: usize = 32;
/// Clients beyond them may only ask to stop the graph, within this time, as many at a time.
const MAX_LATE_CLIENTS: usize = 8;
const LATE_LIMIT: Duration = Duration::from_secs(1);
const LATE_PAUSE: Duration = Duration::from_millis(20);

/// A request and where to answer.
pub(super) struct Ask {
    pub(super) client: u64,
    pub(super) request: Request,
    /// The description of the new program of a swap.
    pub(super) description: Option<Result<OperatorDescription, String>>,
    /// Used with `try_send`, because a client may not read.
    pub(super) reply: SyncSender<Reply>,
}

/// Accepts clients until it is dropped.
pub(super) struct Server {
    listener: UnixListener,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Server {
    /// Waits for the thread, which holds the graph's name: the next graph of this process may need it.
    fn drop(&mut self) {
        let is_shut = rustix::net::shutdown(&self.listener, rustix::net::Shutdown::Both).is_ok();
        if let Some(thread) = self.thread.take()
            && is_shut
        {
            let _ = thread.join();
        }
    }
}

/// Serves clients on threads of their own, and keeps the audit log. `pins` are those of the graph's nodes.
///
/// # Errors
/// The listener cannot be used.
pub(super) fn serve(
    listener: &UnixListener,
    pins: BTreeMap<String, Pins>,
    events: &SyncSender<Event>,
    audit: Log,
) -> std::io::Result<Server> {
    let (late, late_clients) = channel();
    let accepting = Accepting {
        listener: listener.try_clone()?,
        late,
        spare: File::open("/dev/null").ok(),
        n_clients: Arc::default(),
        pins: Arc::new(pins),
        events: events.clone(),
    };
    let events = events.clone();
    std::thread::Builder::new().spawn(move || attend_late(&late_clients, &events))?;
    let thread = std::thread::Builder::new().spawn(move || accepting.accept(&audit))?;
    Ok(Server { listener: listener.try_clone()?, thread: Some(thread) })
}

/// The thread that accepts clients.
struct Accepting {
    listener: UnixListener,
    /// The thread for clients that get none of their own.
    late: Sender<LateClient>,
    /// A descriptor that is given up for a client that asks the graph to stop when there is no other.
    spare: Option<File>,
    n_clients: Arc<AtomicUsize>,
    pins: Arc<BTreeMap<String, Pins>>,
    events: SyncSender<Event>,
}

impl Accepting {
    fn accept(mut self, audit: &Log) {
        for client in 0.. {
            let stream = loop {
                match self.listener.accept() {
                    Ok((stream, _)) => break stream,
                    Err(error) if error.kind() == ErrorKind::InvalidInput => return,
                    // Out of descriptors, for example.
                    Err(_) if self.spare.take().is_some() => {}
                    Err(_) => std::thread::sleep(RETRY_PAUSE),
                }
            };
            if self.spare.is_none() {
                self.spare = File::open("/dev/null").ok();
            }
            let Some(client_name) = own_user(&stream) else {
                continue;
            };
            let trail = Trail::new(audit.clone(), client_name);
            let refusal = match self.attend(&stream, client, trail.clone()) {
                Ok(true) => continue,
                Ok(false) => format!("too many commands at work ({MAX_CLIENTS}): end some of them"),
                Err(error) => format!("the graph has no thread or descriptor for the command ({error})"),
            };
            let refusal = format!("{refusal}; stop still works");
            let late = LateClient { stream, client, trail, refusal, since: Instant::now(), replies: None };
            // Its thread lives as long as this one.
            let _ = self.late.send(late);
        }
    }

    /// Attends to a client on threads of its own; false if there are too many clients.
    ///
    /// # Errors
    /// There is no thread or descriptor left.
    fn attend(&self, stream: &UnixStream, client: u64, trail: Trail) -> std::io::Result<bool> {
        let place = Arc::clone(&self.n_clients);
        // This thread alone adds to it.
        if place.load(Ordering::Relaxed) >= MAX_CLIENTS {
            return Ok(false);
        }
        let (reader, writer) = (BufReader::new(stream.try_clone()?), stream.try_clone()?);
        let (reply, replies) = sync_channel(MAX_PENDING_REPLIES);
        let trail = Arc::new(Mutex::new(trail));
        let its_trail = Arc::clone(&trail);
        std::thread::Builder::new().spawn(move || write_replies(writer, &replies, &its_trail))?;
        let (pins, events) = (Arc::clone(&self.pins), self.events.clone());
        place.fetch_add(1, Ordering::Relaxed);
        let attending = move || {
            attend(reader, client, &pins, &events, &reply, &trail);
            place.fetch_sub(1, Ordering::Relaxed);
        };
        let spawned = std::thread::Builder::new().spawn(attending);
        if spawned.is_err() {
            self.n_clients.fetch_sub(1, Ordering::Relaxed);
        }
        spawned.map(|_| true)
    }
}

/// The client for the audit log, if it is of this user.
fn own_user(stream: &UnixStream) -> Option<String> {
    let peer = peer_of(stream).ok()?;
    let pid = peer.pid.map_or("of another namespace".into(), |pid| pid.to_string());
    (peer.uid == rustix::process::getuid().as_raw()).then(|| format!("uid {} pid {pid}", peer.uid))
}

/// A client without a place of its own. It may only ask the graph to stop.
struct LateClient {
    stream: UnixStream,
    client: u64,
    trail: Trail,
    /// The answer to everything else.
    refusal: String,
    since: Instant,
    /// Once it has asked the graph to stop.
    replies: Option<Receiver<Reply>>,
}

/// Attends to clients that get no thread of their own. This thread is there from the start, so that a graph that lacks threads
/// or descriptors can be stopped.
fn attend_late(clients: &Receiver<LateClient>, events: &SyncSender<Event>) {
    let mut attended: Vec<LateClient> = Vec::new();
    loop {
        let pause = if attended.is_empty() { LATE_LIMIT } else { LATE_PAUSE };
        match clients.recv_timeout(pause) {
            Ok(client) if attended.len() < MAX_LATE_CLIENTS => attended.push(client),
            Ok(mut client) => client.tell(&Reply::refusal(&client.refusal)),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        attended.retain_mut(|client| client.go_on(events));
    }
}

impl LateClient {
    /// Listens to it, or passes on the graph's answers; false when it is attended to.
    fn go_on(&mut self, events: &SyncSender<Event>) -> bool {
        if let Some(replies) = &self.replies {
            let reply = replies.try_recv();
            if let Ok(reply) = &reply {
                self.tell(reply);
            }
            return !matches!(reply, Err(TryRecvError::Disconnected));
        }
        let mut bytes = [0; 256];
        match self.stream.set_nonblocking(true).and_then(|()| self.stream.read(&mut bytes)) {
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::WouldBlock && self.since.elapsed() < LATE_LIMIT => return true,
            Err(_) => {}
        }
        let line = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
        if let Ok(request @ Request::Stop) = serde_json::from_slice(line) {
            self.trail.asked(&request);
            let (reply, replies) = sync_channel(MAX_PENDING_REPLIES);
            self.replies = Some(replies);
            return events
                .send(Event::Ask(Box::new(Ask { client: self.client, request, description: None, reply })))
                .is_ok();
        }
        // A client that does not read has gone, or goes on alone.
        self.tell(&Reply::refusal(&self.refusal));
        false
    }

    /// Nothing waits for a client that does not read.
    fn tell(&mut self, reply: &Reply) {
        self.trail.answered(reply);
        let _ = write_reply(&mut self.stream, reply);
    }
}

fn write_reply(stream: &mut UnixStream, reply: &Reply) -> std::io::Result<()> {
    stream.write_all(format!("{}\n", serde_json::to_string(reply)?).as_bytes())
}

/// Reads the requests of a client until it goes.
fn attend(
    mut reader: BufReader<UnixStream>,
    client: u64,
    pins: &BTreeMap<String, Pins>,
    events: &SyncSender<Event>,
    reply: &SyncSender<Reply>,
    trail: &Mutex<Trail>,
) {
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(MAX_REQUEST_BYTES).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => break,
            Ok(_) => {}
        }
        match serde_json::from_slice(&line) {
            Ok(request) => {
                trail.lock().unwrap_or_else(PoisonError::into_inner).asked(&request);
                let reply = reply.clone();
                let description = describe_replacement(&request, pins);
                if events.send(Event::Ask(Box::new(Ask { client, request, description, reply }))).is_err() {
                    return;
                }
            }
            Err(error) => {
                let _ = reply.try_send(Reply::refusal(format!("not a request of this version ({error})")));
            }
        }
    }
    trail.lock().unwrap_or_else(PoisonError::into_inner).ended();
    let _ = events.send(Event::ClientGone(client));
}

/// Asks the program here, because it may take its time, and the launcher must not wait. A program that a node's pins exclude
/// is not asked: that would run it.
fn describe_replacement(
    request: &Request,
    pins: &BTreeMap<String, Pins>,
) -> Option<Result<OperatorDescription, String>> {
    match request {
        Request::Swap(SwapRequest { nodes, program: Some(program), args, .. }) => {
            let mut pins = nodes.iter().filter_map(|node| pins.get(node));
            let checked = pins.try_for_each(|pins| pins.check_program(program)).map_err(|error| error.to_string());
            Some(checked.and_then(|()| describe(program, args.as_deref().unwrap_or_default())))
        }
        _ => None,
    }
}

fn write_replies(mut writer: UnixStream, replies: &Receiver<Reply>, trail: &Mutex<Trail>) {
    for reply in replies {
        trail.lock().unwrap_or_else(PoisonError::into_inner).answered(&reply);
        if write_reply(&mut writer, &reply).is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd;

    use rustix::net::{AddressFamily, SocketAddrUnix, SocketType};
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

    use super::*;
    use crate::launcher::log_writer::LogWriter;
    use crate::log::{AUDIT, LogFolder, LogFormat};

    /// A served socket.
    struct Served {
        socket: std::path::PathBuf,
        asked: Receiver<Event>,
        _server: Server,
        _folder: tempfile::TempDir,
    }

    fn served() -> Served {
        let folder = tempfile::tempdir().expect("a folder");
        let writer = LogWriter::new(LogFolder::at(folder.path().join("graph")), LogFormat::Text);
        let socket = folder.path().join("socket");
        let listener = UnixListener::bind(&socket).expect("bound");
        let (events, asked) = sync_channel(64);
        let server = serve(&listener, BTreeMap::new(), &events, writer.log_if_written(AUDIT)).expect("served");
        Served { socket, asked, _server: server, _folder: folder }
    }

    impl Served {
        fn connect(&self) -> UnixStream {
            UnixStream::connect(&self.socket).expect("connected")
        }

        fn answered(&self, client: &UnixStream, reply: Reply) -> String {
            let Ok(Event::Ask(asked)) = self.asked.recv() else { panic!("a request") };
            asked.reply.send(reply).expect("sent");
            said(client)
        }
    }

    /// The server's threads wait for clients then.
    fn wait_until_all_others_sleep() {
        let own = rustix::thread::gettid().as_raw_nonzero().to_string();
        let is_awake = |task: &std::fs::DirEntry| {
            let stat = std::fs::read_to_string(task.path().join("stat")).unwrap_or_default();
            task.file_name() != own.as_str() && !stat.contains(") S ")
        };
        while std::fs::read_dir("/proc/self/task").expect("readable").flatten().any(|task| is_awake(&task)) {
            std::thread::sleep(RETRY_PAUSE);
        }
    }

    fn ask(mut client: &UnixStream, request: &Request) {
        writeln!(client, "{}", serde_json::to_string(request).expect("JSON")).expect("sent");
    }

    fn said(client: &UnixStream) -> String {
        let mut line = String::new();
        BufReader::new(client).read_line(&mut line).expect("read");
        line
    }

    /// Clients of the same user, or of the link, may leave no place for others.
    #[test]
    fn beyond_the_most_clients_stop_is_served_and_others_are_told() {
        let served = served();
        let clients: Vec<UnixStream> = (0..MAX_CLIENTS).map(|_| served.connect()).collect();
        for client in &clients {
            ask(client, &Request::Status);
            served.answered(client, Reply::Stopping);
        }
        let silent: Vec<UnixStream> = (0..MAX_LATE_CLIENTS / 2).map(|_| served.connect()).collect();
        let late = served.connect();
        ask(&late, &Request::Status);
        assert!(said(&late).contains("too many commands at work"));
        let stopping = served.connect();
        ask(&stopping, &Request::Stop);
        assert!(served.answered(&stopping, Reply::Stopping).contains("stopping"));
        assert!(silent.iter().all(|client| said(client).contains("stop still works")));
        // The others still have their places.
        ask(&clients[0], &Request::Status);
        served.answered(&clients[0], Reply::Drained);
    }

    /// The limits of a process are those of all its tests: this one has a process of its own.
    #[test]
    fn a_graph_without_threads_and_descriptors_can_be_stopped_and_says_why_it_does_nothing_else() {
        const VARIABLE: &str = "BLINDGRASP_TEST_LACKS";
        if std::env::var_os(VARIABLE).is_none() {
            let mut lacking = std::process::Command::new(std::env::current_exe().expect("this program"));
            let name = "a_graph_without_threads_and_descriptors_can_be_stopped_and_says_why_it_does_nothing_else";
            lacking.args(["--exact", &format!("launcher::server::tests::{name}")]).env(VARIABLE, "1");
            let output = lacking.output().expect("started");
            let said = String::from_utf8_lossy(&output.stdout);
            return assert!(output.status.success() && said.contains("1 passed"), "{said}");
        }
        let served = served();
        let [silent, stopping] = [(); 2].map(|()| {
            let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None).expect("a socket");
            UnixStream::from(socket)
        });
        let connect = |client: &UnixStream| {
            rustix::net::connect(client, &SocketAddrUnix::new(&served.socket).expect("a path")).expect("connected");
        };
        wait_until_all_others_sleep();
        let limit = getrlimit(Resource::Nofile);
        let lowest_free = File::open("/dev/null").expect("opened").as_raw_fd() as u64;
        setrlimit(Resource::Nofile, Rlimit { current: Some(lowest_free), ..limit }).expect("lowered");
        // The system has a descriptor ready for the first one, and the spare one is for the second.
        connect(&silent);
        connect(&stopping);
        ask(&stopping, &Request::Stop);
        let answer = served.answered(&stopping, Reply::Stopping);
        ask(&silent, &Request::Status);
        let refusal = said(&silent);
        setrlimit(Resource::Nofile, limit).expect("raised");
        assert!(answer.contains("stopping"), "{answer}");
        assert!(refusal.contains("no thread or descriptor") && refusal.contains("os error 24"), "{refusal}");
    }
}
