//! The asking end: commands of this machine for another one.

use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, watch};

use super::end::{End, FromPeer, ToPeer};
use super::frame::MAX_CHUNK_BYTES;
use super::{MAX_TUNNELS, Peer, Shared, end_of, random};
use blindgrasp_graph::client::part_name;
use blindgrasp_graph::control::Reply;
use blindgrasp_operator::control_socket::ControlSocket;

/// Pause before the next attempt to bind a socket that is taken, or to accept a client.
const RETRY_PAUSE: Duration = Duration::from_millis(500);
/// Maximum length in bytes of a line from the other machine.
const MAX_LINE_BYTES: usize = 4 << 20;
const LINK_HAS_ENDED: &str = "the link of this machine has ended";

/// Serves the control socket of the graph's part on `peer` until the link ends.
pub(super) async fn listen(
    shared: Arc<Shared>,
    peer: Arc<Peer>,
    mut stopped: watch::Receiver<bool>,
    busy: mpsc::Sender<()>,
) {
    let graph = part_name(&shared.config.running_graph, &peer.config.machine);
    let mut is_said = false;
    let (_socket, listener) = loop {
        match bind(&graph) {
            Ok(bound) => break bound,
            Err(error) if !is_said => {
                tracing::warn!("commands for '{graph}' cannot be accepted: the name of its socket is taken: {error}");
                is_said = true;
            }
            Err(_) => {}
        }
        tokio::select! {
            () = end_of(&mut stopped) => return,
            () = tokio::time::sleep(RETRY_PAUSE) => {}
        }
    };
    loop {
        let stream = tokio::select! {
            () = end_of(&mut stopped) => return,
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => stream,
                Err(_) => {
                    // For example, too many open files; this may be over soon.
                    tokio::time::sleep(RETRY_PAUSE).await;
                    continue;
                }
            },
        };
        let client = rustix::net::sockopt::socket_peercred(stream.as_fd());
        if client.is_ok_and(|client| client.uid == rustix::process::getuid()) {
            tokio::spawn(attend(Arc::clone(&shared), Arc::clone(&peer), stream, stopped.clone(), busy.clone()));
        }
    }
}

/// The name is free again when the socket is dropped.
fn bind(graph: &str) -> std::io::Result<(ControlSocket, UnixListener)> {
    let socket = ControlSocket::bind(graph)?;
    let listener = socket.listener().try_clone()?;
    listener.set_nonblocking(true)?;
    Ok((socket, UnixListener::from_std(listener)?))
}

/// Serves a client of this machine until the client or the other machine ends the connection.
async fn attend(
    shared: Arc<Shared>,
    peer: Arc<Peer>,
    stream: UnixStream,
    mut stopped: watch::Receiver<bool>,
    _busy: mpsc::Sender<()>,
) {
    let (from_client, mut to_client) = stream.into_split();
    let end = tokio::select! {
        opened = open(shared, peer) => opened,
        () = end_of(&mut stopped) => Err(LINK_HAS_ENDED.into()),
    };
    let end = match end {
        Ok(end) => end,
        Err(reason) => return refuse(&mut to_client, reason).await,
    };
    let (to_peer, pieces) = mpsc::channel(1);
    let (heard, from_peer) = mpsc::channel(1);
    let carry = tokio::spawn(end.run(pieces, heard));
    let up = tokio::spawn(pass_up(from_client, to_peer));
    let passed_down = tokio::select! {
        passed_down = pass_down(from_peer, &mut to_client) => passed_down,
        () = end_of(&mut stopped) => Some(LINK_HAS_ENDED.into()),
    };
    if let Some(reason) = passed_down {
        refuse(&mut to_client, reason).await;
    }
    // The serving end learns that the client has gone.
    up.abort();
    let _ = carry.await;
}

async fn open(shared: Arc<Shared>, peer: Arc<Peer>) -> Result<End, String> {
    let machine = &peer.config.machine;
    let (place, inbox) = peer
        .take_in((true, random()?), None)
        .ok_or_else(|| format!("{MAX_TUNNELS} commands are at work on machine '{machine}' already"))?;
    let mut end = End::new(place, 0, inbox, shared);
    end.open().await?;
    Ok(end)
}

/// Passes the client's bytes to the other machine until the client has gone.
async fn pass_up(mut from_client: OwnedReadHalf, to_peer: mpsc::Sender<ToPeer>) {
    let mut chunk = vec![0; MAX_CHUNK_BYTES];
    while let Ok(n_bytes @ 1..) = from_client.read(&mut chunk).await {
        if to_peer.send(ToPeer::Chunk(chunk[..n_bytes].to_vec())).await.is_err() {
            return;
        }
    }
}

/// Passes whole lines from the other machine to the client, so that an error of the tunnel has a line of its own.
/// Returns this error.
async fn pass_down(mut from_peer: mpsc::Receiver<FromPeer>, to_client: &mut OwnedWriteHalf) -> Option<String> {
    let mut unfinished: Vec<u8> = Vec::new();
    while let Some(received) = from_peer.recv().await {
        let bytes = match received {
            FromPeer::Chunk(bytes) => bytes,
            FromPeer::Failed(reason) => return Some(reason),
        };
        let n_whole = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |newline_idx| newline_idx + 1);
        let (whole, rest) = bytes.split_at(n_whole);
        if n_whole > 0 {
            unfinished.extend_from_slice(whole);
            if to_client.write_all(&unfinished).await.is_err() {
                return None;
            }
            unfinished.clear();
        }
        unfinished.extend_from_slice(rest);
        if unfinished.len() > MAX_LINE_BYTES {
            return Some(format!("the other machine answered with a line of more than {MAX_LINE_BYTES} bytes"));
        }
    }
    None
}

async fn refuse(to_client: &mut OwnedWriteHalf, message: String) {
    if let Ok(line) = serde_json::to_string(&Reply::Error { message, rolled_back: false }) {
        let _ = to_client.write_all(format!("{line}\n").as_bytes()).await;
    }
}
