//! The launcher's end of [`control`](crate::control): reads requests and hands them to its loop.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

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
const RETRY_PAUSE: std::time::Duration = std::time::Duration::from_millis(100);
/// The most clients at a time.
const MAX_CLIENTS: usize = 32;
/// Clients beyond them may only ask to stop the graph, within this time, as many at a time.
const MAX_LATE_CLIENTS: usize = 8;
const LATE_LIMIT: std::time::Duration = std::time::Duration::from_secs(1);

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
    let pins = Arc::new(pins);
    let accepting = listener.try_clone()?;
    let events = events.clone();
    let thread = std::thread::Builder::new().spawn(move || {
        let (next_client, n_clients) = (AtomicU64::new(0), Arc::new(AtomicUsize::new(0)));
        for stream in accepting.incoming() {
            let stream = match stream {
                Ok(stream) => stream,
                Err(error) if error.kind() == ErrorKind::InvalidInput => return,
                Err(_) => {
                    // Out of descriptors, for example; this may pass.
                    std::thread::sleep(RETRY_PAUSE);
                    continue;
                }
            };
            let Some(client_name) = own_user(&stream) else {
                continue;
            };
            let trail = Trail::new(audit.clone(), client_name);
            let n_before = n_clients.fetch_add(1, Ordering::Relaxed);
            if n_before >= MAX_CLIENTS + MAX_LATE_CLIENTS {
                n_clients.fetch_sub(1, Ordering::Relaxed);
                // It is told within the room of the socket: nothing waits for it.
                let _ = stream.set_nonblocking(true);
                let _ = refuse(&stream, too_many());
                continue;
            }
            let is_late = n_before >= MAX_CLIENTS;
            let (client, events, n_clients) =
                (next_client.fetch_add(1, Ordering::Relaxed), events.clone(), Arc::clone(&n_clients));
            let pins = Arc::clone(&pins);
            let (other_end, place) = (stream.try_clone(), Arc::clone(&n_clients));
            let attending = move || {
                if is_late {
                    attend_late(stream, client, &pins, &events, trail);
                } else {
                    attend(BufReader::new(stream), client, &pins, &events, trail);
                }
                n_clients.fetch_sub(1, Ordering::Relaxed);
            };
            if let Err(error) = std::thread::Builder::new().spawn(attending) {
                place.fetch_sub(1, Ordering::Relaxed);
                if let Ok(stream) = other_end {
                    let _ = stream.set_nonblocking(true);
                    let _ = refuse(&stream, no_thread(&error));
                }
            }
        }
    })?;
    Ok(Server { listener: listener.try_clone()?, thread: Some(thread) })
}

/// The client for the audit log, if it is of this user.
fn own_user(stream: &UnixStream) -> Option<String> {
    let peer = peer_of(stream).ok()?;
    let pid = peer.pid.map_or("of another namespace".into(), |pid| pid.to_string());
    (peer.uid == rustix::process::getuid().as_raw()).then(|| format!("uid {} pid {pid}", peer.uid))
}

fn too_many() -> String {
    format!("too many commands at work ({MAX_CLIENTS}): end some of them; stop still works")
}

fn no_thread(error: &std::io::Error) -> String {
    format!("the graph cannot make a thread for the command ({error}): try again, or raise the limit of processes")
}

/// Tells a client why it is not attended to.
fn refuse(mut stream: &UnixStream, message: String) -> std::io::Result<()> {
    let reply = Reply::Error { message, rolled_back: false };
    stream.write_all(format!("{}\n", serde_json::to_string(&reply)?).as_bytes())
}

/// Attends to a client beyond the others if its first request is to stop the graph.
fn attend_late(
    stream: UnixStream,
    client: u64,
    pins: &BTreeMap<String, Pins>,
    events: &SyncSender<Event>,
    trail: Trail,
) {
    let is_limited = stream.set_read_timeout(Some(LATE_LIMIT)).is_ok();
    let mut reader = BufReader::new(stream);
    // A request to stop fits into the reader's memory, from which it is not taken yet.
    let is_stop = is_limited
        && reader.fill_buf().is_ok_and(|bytes| {
            let line = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
            matches!(serde_json::from_slice(line), Ok(Request::Stop))
        });
    if is_stop && reader.get_ref().set_read_timeout(None).is_ok() {
        attend(reader, client, pins, events, trail);
    } else {
        // A client that does not read has gone, or goes on alone.
        let _ = refuse(reader.get_ref(), too_many());
    }
}

fn attend(
    mut reader: BufReader<UnixStream>,
    client: u64,
    pins: &BTreeMap<String, Pins>,
    events: &SyncSender<Event>,
    trail: Trail,
) {
    let Ok(writer) = reader.get_ref().try_clone() else {
        return;
    };
    let (reply, replies) = sync_channel(MAX_PENDING_REPLIES);
    let trail = Arc::new(Mutex::new(trail));
    let writing = {
        let trail = Arc::clone(&trail);
        move || write_replies(writer, &replies, &trail)
    };
    if let Err(error) = std::thread::Builder::new().spawn(writing) {
        let _ = refuse(reader.get_ref(), no_thread(&error));
        return;
    }
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
                let message = format!("not a request of this version ({error})");
                let _ = reply.try_send(Reply::Error { message, rolled_back: false });
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
        if let Ok(json) = serde_json::to_string(&reply)
            && writer.write_all(format!("{json}\n").as_bytes()).is_err()
        {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::launcher::log_writer::LogWriter;
    use crate::log::{AUDIT, LogFolder, LogFormat};

    /// Clients of the same user, or of the link, may leave no place for others.
    #[test]
    fn beyond_the_most_clients_stop_is_served_and_others_are_told() {
        let temporary = tempfile::tempdir().expect("a folder");
        let writer = LogWriter::new(LogFolder::at(temporary.path().join("graph")), LogFormat::Text);
        let socket = temporary.path().join("socket");
        let listener = UnixListener::bind(&socket).expect("bound");
        let (events, asked) = sync_channel(64);
        let _server = serve(&listener, BTreeMap::new(), &events, writer.log_if_written(AUDIT)).expect("served");
        let connect = || UnixStream::connect(&socket).expect("connected");
        let ask = |mut client: &UnixStream, request: &Request| {
            writeln!(client, "{}", serde_json::to_string(request).expect("JSON")).expect("sent");
        };
        let said = |client: &UnixStream| {
            let mut line = String::new();
            BufReader::new(client).read_line(&mut line).expect("read");
            line
        };
        let answered = |client: &UnixStream, reply: Reply| {
            let Ok(Event::Ask(asked)) = asked.recv() else { panic!("a request") };
            asked.reply.send(reply).expect("sent");
            said(client)
        };
        let clients: Vec<UnixStream> = (0..MAX_CLIENTS).map(|_| connect()).collect();
        for client in &clients {
            ask(client, &Request::Status);
            answered(client, Reply::Stopping);
        }
        let late = connect();
        ask(&late, &Request::Status);
        assert!(said(&late).contains("too many commands at work"));
        let stopping = connect();
        ask(&stopping, &Request::Stop);
        assert!(answered(&stopping, Reply::Stopping).contains("stopping"));
        // The others still have their places.
        ask(&clients[0], &Request::Status);
        answered(&clients[0], Reply::Drained);
    }
}
