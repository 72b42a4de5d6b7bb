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

/// Longer requests are refused.
const MAX_REQUEST_BYTES: u64 = 1 << 20;
/// This many replies may wait for a client to read them; further replies are dropped.
const MAX_PENDING_REPLIES: usize = 256;
/// The pause after a failure to accept a client.
const RETRY_PAUSE: std::time::Duration = std::time::Duration::from_millis(100);
/// The most clients at a time.
const MAX_CLIENTS: usize = 32;

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
    let thread = std::thread::spawn(move || {
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
            if n_clients.load(Ordering::Relaxed) >= MAX_CLIENTS {
                continue;
            }
            let Some(client_name) = own_user(&stream) else {
                continue;
            };
            let trail = Trail::new(audit.clone(), client_name);
            n_clients.fetch_add(1, Ordering::Relaxed);
            let (client, events, n_clients) =
                (next_client.fetch_add(1, Ordering::Relaxed), events.clone(), Arc::clone(&n_clients));
            let pins = Arc::clone(&pins);
            std::thread::spawn(move || {
                attend(stream, client, &pins, &events, trail);
                n_clients.fetch_sub(1, Ordering::Relaxed);
            });
        }
    });
    Ok(Server { listener: listener.try_clone()?, thread: Some(thread) })
}

/// The client for the audit log, if it is of this user.
fn own_user(stream: &UnixStream) -> Option<String> {
    let peer = rustix::net::sockopt::socket_peercred(stream).ok()?;
    (peer.uid == rustix::process::getuid())
        .then(|| format!("uid {} pid {}", peer.uid.as_raw(), peer.pid.as_raw_nonzero()))
}

fn attend(stream: UnixStream, client: u64, pins: &BTreeMap<String, Pins>, events: &SyncSender<Event>, trail: Trail) {
    let Ok(writer) = stream.try_clone() else {
        return;
    };
    let (reply, replies) = sync_channel(MAX_PENDING_REPLIES);
    let trail = Arc::new(Mutex::new(trail));
    std::thread::spawn({
        let trail = Arc::clone(&trail);
        move || write_replies(writer, &replies, &trail)
    });
    let mut reader = BufReader::new(stream);
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
