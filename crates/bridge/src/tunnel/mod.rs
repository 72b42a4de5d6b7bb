//! Commands for a graph's part on another machine.
//!
//! The link listens on the control socket of `GRAPH@MACHINE` as if a graph of that name ran here. Each connection becomes
//! a **tunnel** over Zenoh to the link on MACHINE, which looks at each request, whether the asking machine may make it, and
//! passes it on to its own launcher (`serve`). What needs the other machine's shared memory or files, samples and logs, it
//! answers itself.
//!
//! A tunnel loses nothing, or it ends: pieces of the stream are numbered, and a gap closes it with an error. The
//! other end says how many pieces it has taken, so that neither holds more than 32 of them. An end that has heard
//! nothing for 2.5 s closes. It runs on threads of its own, beside the link's samples, and its messages go after
//! them.

mod ask;
pub mod batch;
mod end;
mod frame;
mod samples;
mod serve;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::io::Read;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, anyhow};
use tokio::sync::{mpsc, watch};
use zenoh::Wait;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};

use self::end::{End, Heard};
use self::frame::{Body, Frame};
use super::config::{KeyKind, LinkConfig, PeerConfig};

/// How many pieces of the stream may be on their way to an end that has not taken them: half a mebibyte.
const WINDOW: u64 = 32;
/// How many frames may wait for an end: a window, and what is said of it.
const INBOX: usize = 3 * WINDOW as usize;
/// How many tunnels a machine may have here, and this one there.
const MAX_TUNNELS: usize = 32;
/// How many ends that are gone are remembered: what comes late for them is nothing odd.
const N_REMEMBERED: usize = 128;
/// How long the other machine may take to open a tunnel: less than a client waits for an answer.
const OPEN_LIMIT: Duration = Duration::from_millis(1500);
/// How often an end says that it lives.
const ALIVE_PAUSE: Duration = Duration::from_millis(500);
/// An end that has heard nothing for so long closes.
const SILENCE_LIMIT: Duration = Duration::from_millis(2500);
/// How long ends may take to say what they have when the link ends.
const END_LIMIT: Duration = Duration::from_millis(1000);
/// How long Zenoh gets to send what was said last.
const FLUSH_PAUSE: Duration = Duration::from_millis(20);

/// The tunnels between this machine and the others. Dropping it closes them.
pub struct Tunnels {
    shared: Arc<Shared>,
    /// Dropped before the threads end: nothing more comes in.
    subscribers: Vec<Subscriber<()>>,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    /// Zenoh's publishers and subscribers live as long as one of these.
    _session: zenoh::Session,
}

/// What all tunnels have in common.
struct Shared {
    config: Arc<LinkConfig>,
    /// What was dropped, by why.
    rejected: Mutex<BTreeMap<&'static str, u64>>,
}

/// Another machine.
struct Peer {
    config: PeerConfig,
    /// For commands and their replies.
    prompt: Publisher<'static>,
    /// For samples: after everything else.
    bulk: Publisher<'static>,
    ends: Mutex<Ends>,
    /// A refusal for want of room is on its way.
    is_refusing: AtomicBool,
}

/// The ends of tunnels here, by whether this is the asking end, and number.
#[derive(Default)]
struct Ends {
    open: HashMap<(bool, u64), OpenEnd>,
    gone: VecDeque<(bool, u64)>,
}

struct OpenEnd {
    /// `None` at an asking end until the other one has answered.
    token: Option<u64>,
    inbox: mpsc::Sender<Heard>,
}

/// Takes an end off the books when it is dropped.
struct Place {
    peer: Arc<Peer>,
    at: (bool, u64),
}

impl Tunnels {
    /// Listens for commands to the other machines, and for theirs to this one.
    ///
    /// # Errors
    /// Zenoh's reason, or threads cannot be started. A control socket that is taken is said in the log, and tried again.
    pub fn start(session: zenoh::Session, config: Arc<LinkConfig>) -> anyhow::Result<Tunnels> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("tunnels")
            .enable_all()
            .build()
            .context("cannot start threads for commands to other machines")?;
        let shared = Arc::new(Shared { config: Arc::clone(&config), rejected: Mutex::default() });
        let (stop, stopped) = watch::channel(false);
        // Closed once all who hold it have ended.
        let (busy, mut all_done) = mpsc::channel::<()>(1);
        let mut subscribers = Vec::new();
        let mut peers = Vec::new();
        for peer in &config.peers {
            let peer = Arc::new(Peer::new(&session, &config, peer)?);
            let key = config.key(&peer.config.machine, &config.machine, KeyKind::Ask);
            let hear = {
                let (shared, peer, handle) = (Arc::clone(&shared), Arc::clone(&peer), runtime.handle().clone());
                let (stopped, busy) = (stopped.clone(), busy.downgrade());
                move |sample: zenoh::sample::Sample| {
                    if sample.kind() == zenoh::sample::SampleKind::Put {
                        hear(&shared, &peer, &handle, &sample.payload().to_bytes(), &stopped, &busy);
                    }
                }
            };
            let subscriber = session.declare_subscriber(key.clone()).callback(hear).wait();
            subscribers.push(subscriber.map_err(|error| anyhow!("cannot subscribe to {key}: {error}"))?);
            peers.push(peer);
        }
        for peer in peers {
            runtime.spawn(ask::listen(Arc::clone(&shared), peer, stopped.clone(), busy.clone()));
        }
        drop(busy);
        let thread = std::thread::Builder::new().name("tunnels".into()).spawn({
            let mut stopped = stopped.clone();
            move || {
                runtime.block_on(async {
                    end_of(&mut stopped).await;
                    let _ = tokio::time::timeout(END_LIMIT, all_done.recv()).await;
                    // What was said last is on its way.
                    tokio::time::sleep(FLUSH_PAUSE).await;
                });
                runtime.shutdown_timeout(Duration::from_millis(100));
            }
        })?;
        Ok(Tunnels { shared, subscribers, stop, thread: Some(thread), _session: session })
    }

    /// Messages that were dropped, by why: as in [`LinkStatus`](blindgrasp_operator::link_status::LinkStatus), and `unknown`, of
    /// no tunnel that there is, and `flooded`, more than an end may send.
    pub fn rejected(&self) -> BTreeMap<String, u64> {
        let rejected = lock(&self.shared.rejected);
        rejected.iter().map(|(why, count)| (why.to_string(), *count)).collect()
    }
}

impl Drop for Tunnels {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        // What the other ends say is heard meanwhile.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.subscribers.clear();
    }
}

impl Shared {
    fn reject(&self, why: &'static str) {
        *lock(&self.rejected).entry(why).or_default() += 1;
    }
}

impl Peer {
    fn new(session: &zenoh::Session, config: &LinkConfig, peer: &PeerConfig) -> anyhow::Result<Peer> {
        let key = config.key(&config.machine, &peer.machine, KeyKind::Ask);
        // Blocking, because a tunnel that loses a message ends; on threads that nothing else waits for.
        let publisher = |priority| {
            let publisher = session.declare_publisher(key.clone()).congestion_control(CongestionControl::Block);
            publisher.priority(priority).wait().map_err(|error| anyhow!("cannot publish under {key}: {error}"))
        };
        Ok(Peer {
            config: peer.clone(),
            prompt: publisher(Priority::InteractiveLow)?,
            bulk: publisher(Priority::Background)?,
            ends: Mutex::default(),
            is_refusing: AtomicBool::new(false),
        })
    }

    /// Takes a new end in, if there is room. Its number is not one that there is.
    fn take_in(self: &Arc<Self>, at: (bool, u64), token: Option<u64>) -> Option<(Place, mpsc::Receiver<Heard>)> {
        let mut ends = lock(&self.ends);
        let n_like = ends.open.keys().filter(|other| other.0 == at.0).count();
        if n_like >= MAX_TUNNELS || ends.open.contains_key(&at) {
            return None;
        }
        let (inbox, heard) = mpsc::channel(INBOX);
        ends.open.insert(at, OpenEnd { token, inbox });
        Some((Place { peer: Arc::clone(self), at }, heard))
    }

    fn say(&self, frame: &Frame<'_>, is_bulk: bool) {
        let publisher = if is_bulk { &self.bulk } else { &self.prompt };
        let bytes = frame.encode();
        // It may wait for a link that is full; what else this thread would do goes on elsewhere. Who does not get it falls
        // silent, and that is seen.
        let _ = tokio::task::block_in_place(|| publisher.put(bytes).wait());
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut ends = lock(&self.peer.ends);
        ends.open.remove(&self.at);
        if ends.gone.len() == N_REMEMBERED {
            ends.gone.pop_front();
        }
        ends.gone.push_back(self.at);
    }
}

/// Takes in a message of another machine: on Zenoh's thread, so it waits for nothing.
fn hear(
    shared: &Arc<Shared>,
    peer: &Arc<Peer>,
    runtime: &tokio::runtime::Handle,
    bytes: &[u8],
    stopped: &watch::Receiver<bool>,
    busy: &mpsc::WeakSender<()>,
) {
    let frame = match Frame::decode(bytes) {
        Ok(frame) => frame,
        Err(error) => return shared.reject(error.word()),
    };
    let at = (!frame.is_from_asker, frame.id);
    if let (Body::Open, true) = (&frame.body, frame.is_from_asker) {
        let Some(busy) = busy.upgrade().filter(|_| !*stopped.borrow()) else { return };
        let token = random();
        let is_repeated = {
            let ends = lock(&peer.ends);
            ends.open.contains_key(&at) || ends.gone.contains(&at)
        };
        match peer.take_in(at, Some(token)).filter(|_| !is_repeated) {
            _ if is_repeated => shared.reject("replayed"),
            Some((place, inbox)) => {
                let end = End::new(place, token, inbox, Arc::clone(shared));
                runtime.spawn(serve::serve(Arc::clone(shared), end, stopped.clone(), busy));
            }
            None => {
                shared.reject("flooded");
                let (asker, machine) = (&peer.config.machine, &shared.config.machine);
                let reason = format!("machine '{asker}' has {MAX_TUNNELS} commands at work on '{machine}' already");
                // One at a time: whoever asks faster than that learns it by its own limit.
                if !peer.is_refusing.swap(true, Ordering::AcqRel) {
                    let peer = Arc::clone(peer);
                    runtime.spawn(async move {
                        let body = Body::Close { reason: Some(&reason) };
                        peer.say(&Frame { id: at.1, token: 0, is_from_asker: false, body }, false);
                        peer.is_refusing.store(false, Ordering::Release);
                    });
                }
            }
        }
        return;
    }
    let mut ends = lock(&peer.ends);
    let is_gone = ends.gone.contains(&at);
    let Some(open) = ends.open.get_mut(&at) else {
        if !is_gone {
            shared.reject("unknown");
        }
        return;
    };
    match (open.token, &frame.body) {
        (None, Body::Opened) => open.token = Some(frame.token),
        // It was refused.
        (None, Body::Close { .. }) => {}
        (Some(token), _) if token == frame.token => {}
        _ => return shared.reject("unknown"),
    }
    let heard = match frame.body {
        Body::Open => return shared.reject("replayed"),
        Body::Opened => Heard::Opened { token: frame.token },
        Body::Data { index, bytes } => Heard::Data { index, bytes: bytes.to_vec() },
        Body::Credit { n_taken } => Heard::Credit { n_taken },
        Body::Alive => Heard::Alive,
        Body::Close { reason } => Heard::Close { reason: reason.map(str::to_string) },
    };
    if open.inbox.try_send(heard).is_err() {
        // A piece of the stream among it leaves a gap, which ends the tunnel.
        shared.reject("flooded");
    }
}

/// Waits until the link ends.
async fn end_of(stopped: &mut watch::Receiver<bool>) {
    let _ = stopped.wait_for(|is_stopped| *is_stopped).await;
}

/// A number that nobody can guess.
fn random() -> u64 {
    let mut bytes = [0; 8];
    let read = std::fs::File::open("/dev/urandom").and_then(|mut source| source.read_exact(&mut bytes));
    // Where there is none, as in an odd container, the clock has to do.
    let drawn = read.map(|()| u64::from_le_bytes(bytes)).unwrap_or_else(|_| blindgrasp_operator::monotonic_nanos());
    drawn.max(1)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
