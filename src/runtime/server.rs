//! The launcher's end of [`control`](super::control): takes in requests and hands them to its loop.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel};
use std::sync::{Arc, Mutex, PoisonError};

use super::control::{Reply, Request, SwapRequest};
use super::describe::describe;
use super::launcher::Event;
use crate::dataflow::OperatorDescription;

/// A longer request is none.
const MAX_REQUEST_BYTES: u64 = 1 << 20;
/// How many clients are served at a time.
const MAX_CLIENTS: usize = 32;

/// A request and where to answer.
pub(super) struct Ask {
    /// Which connection.
    pub(super) client: u64,
    /// What it asks.
    pub(super) request: Request,
    /// For a swap to another program: what that says of itself.
    pub(super) description: Option<Result<OperatorDescription, String>>,
    /// Where to answer; dropping it ends the client's request.
    pub(super) reply: Sender<Reply>,
}

/// Serves clients on threads of their own until the process ends.
///
/// # Errors
/// The listener cannot be used.
pub(super) fn serve(listener: &UnixListener, events: &SyncSender<Event>) -> std::io::Result<()> {
    let listener = listener.try_clone()?;
    let events = events.clone();
    std::thread::spawn(move || {
        let (next_client, n_clients) = (AtomicU64::new(0), Arc::new(AtomicUsize::new(0)));
        for stream in listener.incoming().map_while(Result::ok) {
            if !is_own_user(&stream) || n_clients.load(Ordering::Relaxed) >= MAX_CLIENTS {
                continue;
            }
            n_clients.fetch_add(1, Ordering::Relaxed);
            let (client, events, n_clients) =
                (next_client.fetch_add(1, Ordering::Relaxed), events.clone(), Arc::clone(&n_clients));
            std::thread::spawn(move || {
                attend(stream, client, &events);
                n_clients.fetch_sub(1, Ordering::Relaxed);
            });
        }
    });
    Ok(())
}

/// Abstract sockets have no owner in the file system.
fn is_own_user(stream: &UnixStream) -> bool {
    let peer = rustix::net::sockopt::socket_peercred(stream);
    peer.is_ok_and(|peer| peer.uid == rustix::process::getuid())
}

fn attend(stream: UnixStream, client: u64, events: &SyncSender<Event>) {
    let Ok(writer) = stream.try_clone() else {
        return;
    };
    let writer = Arc::new(Mutex::new(writer));
    let mut reader = BufReader::new(stream);
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(MAX_REQUEST_BYTES).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => break,
            Ok(_) => {}
        }
        let (reply, replies) = channel();
        match serde_json::from_slice(&line) {
            Ok(request) => {
                let writer = Arc::clone(&writer);
                std::thread::spawn(move || write_replies(&writer, &replies));
                let description = describe_replacement(&request);
                if events.send(Event::Ask(Box::new(Ask { client, request, description, reply }))).is_err() {
                    return;
                }
            }
            Err(error) => {
                let message = format!("not a request of this version ({error})");
                let _ = reply.send(Reply::Error { message, rolled_back: false });
                drop(reply);
                write_replies(&writer, &replies);
            }
        }
    }
    let _ = events.send(Event::ClientGone(client));
}

/// Asked here, because a program may take its time to answer, and the launcher has other things to do.
fn describe_replacement(request: &Request) -> Option<Result<OperatorDescription, String>> {
    match request {
        Request::Swap(SwapRequest { program: Some(program), args, .. }) => {
            Some(describe(program, args.as_deref().unwrap_or_default()))
        }
        _ => None,
    }
}

fn write_replies(writer: &Mutex<UnixStream>, replies: &Receiver<Reply>) {
    for reply in replies {
        if let Ok(json) = serde_json::to_string(&reply) {
            let mut writer = writer.lock().unwrap_or_else(PoisonError::into_inner);
            let _ = writer.write_all(format!("{json}\n").as_bytes());
        }
    }
}
