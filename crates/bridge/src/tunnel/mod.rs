//! Commands for a graph's part on another machine.
//!
//! The link listens on the control socket of `GRAPH@MACHINE` as if a graph of that name ran here. Each connection
//! becomes a **tunnel** over Zenoh to the link on MACHINE. The link there checks for each request whether the asking
//! machine has the right to make it, and passes it on to its own launcher (`serve`). It answers requests for samples
//! and logs itself, since these need the shared memory and the files of MACHINE.
//!
//! A tunnel delivers the whole stream, or it ends with an error: pieces are numbered, and a gap closes the tunnel. Each
//! end reports how many pieces it has taken, so that neither end holds more than 32 of them. An end closes after 2.5 s
//! of silence. Tunnels run on threads of their own, beside the link's samples, and have a lower priority.
//!
//! Zenoh's queryables do not replace this: a query has a time limit and its replies have no flow control, but `logs -f`
//! runs for hours and `record` must not fill the memory of either link. The side that answers a query also does not
//! learn that the client has gone, and a swap must be abandoned then.

mod ask;
mod end;
mod frame;
mod samples;
mod serve;

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use blindgrasp_graph::operators::Operators;
use blindgrasp_graph::recorded_graph::{Beginning, RecordedGraph};
use tokio::sync::{mpsc, watch};
use zenoh::Wait;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Sample, SampleKind};

use self::end::End;
use self::frame::{Body, Frame};
use super::config::{KeyKind, LinkConfig, PeerConfig};
use super::protection::Protection;
use super::wire::{Rejected, WireError};

/// Maximum number of pieces that were sent and not yet taken by the other end: half a mebibyte.
const WINDOW: u64 = 32;
/// Maximum number of frames that wait for an end: a window, and the frames about it.
const INBOX: usize = 3 * WINDOW as usize;
/// Maximum number of tunnels from one machine to another.
const MAX_TUNNELS: usize = 32;
/// Number of closed tunnels that are remembered: late frames for them are not counted as rejected.
const N_REMEMBERED: usize = 128;
/// Time limit for the other machine to open a tunnel. It is shorter than a client waits for an answer.
const OPEN_LIMIT: Duration = Duration::from_millis(1500);
/// Interval at which an end says that it is alive.
const ALIVE_PAUSE: Duration = Duration::from_millis(500);
/// An end closes after this silence of the other end.
const SILENCE_LIMIT: Duration = Duration::from_millis(2500);
/// Time limit for the ends to send their last frames when the link ends.
const END_LIMIT: Duration = Duration::from_millis(1000);
/// Time for Zenoh to send the last frames.
const FLUSH_PAUSE: Duration = Duration::from_millis(20);

/// Makes the metadata of a recording from the description of a graph. It reads the files of the hand and of the models,
/// which this crate does not know.
pub type DescribeRecording = fn(&serde_json::Value, Beginning) -> anyhow::Result<RecordedGraph>;

/// The tunnels between this machine and the others. They are closed when this is dropped.
pub struct Tunnels {
    shared: Arc<Shared>,
    subscribers: Vec<Subscriber<()>>,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    /// Zenoh's publishers and subscribers need an open session.
    _session: zenoh::Session,
}

struct Shared {
    config: Arc<LinkConfig>,
    describe: DescribeRecording,
    operators: Operators,
    rejected: Mutex<Rejected>,
}

/// Another machine.
struct Peer {
    config: PeerConfig,
    protection: Arc<Protection>,
    /// For commands and their replies.
    prompt: Publisher<'static>,
    /// For samples, with the lowest priority.
    bulk: Publisher<'static>,
    ends: Mutex<Ends>,
    /// The number of its requests for logs that are being answered.
    n_log_requests: Arc<AtomicUsize>,
    /// When the launcher was told last that a request of it was refused.
    refusal_noted: Mutex<Option<Instant>>,
    /// Whether a refusal of a tunnel is being sent.
    is_refusing: AtomicBool,
}

/// The ends of tunnels on this machine. The key is whether it is the asking end, and the number of the tunnel.
#[derive(Default)]
struct Ends {
    open: HashMap<(bool, u64), OpenEnd>,
    gone: VecDeque<(bool, u64)>,
}

struct OpenEnd {
    /// `None` at an asking end until the serving end has answered.
    token: Option<u64>,
    inbox: mpsc::Sender<Frame<'static>>,
}

/// The entry of an end in [`Ends`]. It is removed when this is dropped.
struct Place {
    peer: Arc<Peer>,
    at: (bool, u64),
}

impl Tunnels {
    /// Listens for commands to the other machines, and for their commands to this machine. There is a protection for
    /// each peer of the configuration.
    ///
    /// # Errors
    /// Zenoh or the threads cannot be started. A control socket that is taken is no error: it is logged and tried
    /// again.
    pub fn start(
        session: zenoh::Session,
        config: Arc<LinkConfig>,
        protections: &[Arc<Protection>],
        describe: DescribeRecording,
        operators: Operators,
    ) -> anyhow::Result<Tunnels> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("tunnels")
            .enable_all()
            .build()
            .context("cannot start threads for commands to other machines")?;
        let shared = Arc::new(Shared { config: Arc::clone(&config), describe, operators, rejected: Mutex::default() });
        let (stop, stopped) = watch::channel(false);
        // Each end holds a sender; the channel closes when all of them have ended.
        let (busy, mut all_done) = mpsc::channel::<()>(1);
        let mut subscribers = Vec::new();
        let mut peers = Vec::new();
        for (peer, protection) in config.peers.iter().zip(protections) {
            let peer = Arc::new(Peer::new(&session, &config, peer, Arc::clone(protection))?);
            let key = config.key(&peer.config.machine, &config.machine, KeyKind::Ask);
            let receiver = Receiver {
                shared: Arc::clone(&shared),
                peer: Arc::clone(&peer),
                runtime: runtime.handle().clone(),
                stopped: stopped.clone(),
                busy: busy.downgrade(),
            };
            let hear = move |sample: Sample| {
                if sample.kind() == SampleKind::Put {
                    receiver.hear(&sample.payload().to_bytes());
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
                    tokio::time::sleep(FLUSH_PAUSE).await;
                });
                runtime.shutdown_timeout(Duration::from_millis(100));
            }
        })?;
        Ok(Tunnels { shared, subscribers, stop, thread: Some(thread), _session: session })
    }

    /// The messages that were dropped, by reason. `unknown` are frames of tunnels that do not exist, `flooded` are
    /// frames beyond the number that an end may send.
    pub fn rejected(&self) -> Rejected {
        lock(&self.shared.rejected).clone()
    }
}

impl Drop for Tunnels {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        // The other ends are still heard while the thread ends.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.subscribers.clear();
    }
}

impl Shared {
    fn reject(&self, reason: &'static str) {
        lock(&self.rejected).count(reason);
    }
}

impl Peer {
    fn new(
        session: &zenoh::Session,
        config: &LinkConfig,
        peer: &PeerConfig,
        protection: Arc<Protection>,
    ) -> anyhow::Result<Peer> {
        let key = config.key(&config.machine, &peer.machine, KeyKind::Ask);
        // Publishers block, because a tunnel that loses a message ends. Only tunnels wait for these threads.
        let publisher = |priority| {
            let publisher = session.declare_publisher(key.clone()).congestion_control(CongestionControl::Block);
            publisher.priority(priority).wait().map_err(|error| anyhow!("cannot publish under {key}: {error}"))
        };
        Ok(Peer {
            config: peer.clone(),
            protection,
            prompt: publisher(Priority::InteractiveLow)?,
            bulk: publisher(Priority::Background)?,
            ends: Mutex::default(),
            n_log_requests: Arc::default(),
            refusal_noted: Mutex::default(),
            is_refusing: AtomicBool::new(false),
        })
    }

    /// Registers a new end; `None` if there are too many or the number is taken.
    fn take_in(
        self: &Arc<Self>,
        at: (bool, u64),
        token: Option<u64>,
    ) -> Option<(Place, mpsc::Receiver<Frame<'static>>)> {
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
        let mut bytes = match frame.encode() {
            Ok(bytes) => bytes,
            // The other end notices the missing piece and closes the tunnel.
            Err(error) => return tracing::error!("a command for machine '{}': {error}", self.config.machine),
        };
        if !self.protection.encrypt(KeyKind::Ask, &mut bytes) {
            // The other machine is not there, so that nothing would be answered.
            return;
        }
        // This may wait for a connection that is full, so that other tasks of this thread move to another one. If it
        // fails, the other end falls silent, and its silence ends the tunnel.
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

/// Receives the frames of another machine, on a thread of Zenoh: nothing here may wait.
struct Receiver {
    shared: Arc<Shared>,
    peer: Arc<Peer>,
    runtime: tokio::runtime::Handle,
    stopped: watch::Receiver<bool>,
    busy: mpsc::WeakSender<()>,
}

impl Receiver {
    fn hear(&self, bytes: &[u8]) {
        let opened = self.peer.protection.open_command(bytes);
        let frame = match opened.as_ref().map_err(WireError::clone).and_then(|bytes| Frame::decode(bytes)) {
            Ok(frame) => frame,
            Err(error) => return error.reason().into_iter().for_each(|reason| self.shared.reject(reason)),
        };
        match (&frame.body, frame.is_from_asker) {
            (Body::Open, true) => self.open(frame.id),
            _ => self.pass_on(frame),
        }
    }

    /// Makes the serving end of a new tunnel.
    fn open(&self, id: u64) {
        let Some(busy) = self.busy.upgrade().filter(|_| !*self.stopped.borrow()) else { return };
        let at = (false, id);
        let is_repeated = {
            let ends = lock(&self.peer.ends);
            ends.open.contains_key(&at) || ends.gone.contains(&at)
        };
        if is_repeated {
            return self.shared.reject("replayed");
        }
        let token = match random() {
            Ok(token) => token,
            Err(error) => return self.refuse(id, format!("machine '{}': {error}", self.shared.config.machine)),
        };
        match self.peer.take_in(at, Some(token)) {
            Some((place, inbox)) => {
                let end = End::new(place, token, inbox, Arc::clone(&self.shared));
                self.runtime.spawn(serve::serve(Arc::clone(&self.shared), end, self.stopped.clone(), busy));
            }
            None => {
                self.shared.reject("flooded");
                let (asker, machine) = (&self.peer.config.machine, &self.shared.config.machine);
                self.refuse(id, format!("machine '{asker}' has {MAX_TUNNELS} commands at work on '{machine}' already"));
            }
        }
    }

    /// Refuses a tunnel. Only one refusal is sent at a time; other asking ends reach their own time limit.
    fn refuse(&self, id: u64, reason: String) {
        if self.peer.is_refusing.swap(true, Ordering::AcqRel) {
            return;
        }
        let peer = Arc::clone(&self.peer);
        self.runtime.spawn(async move {
            let body = Body::Close { reason: Some(reason) };
            peer.say(&Frame { id, token: 0, is_from_asker: false, body }, false);
            peer.is_refusing.store(false, Ordering::Release);
        });
    }

    /// Passes a frame on to the end that it is for.
    fn pass_on(&self, frame: Frame<'_>) {
        let at = (!frame.is_from_asker, frame.id);
        let mut ends = lock(&self.peer.ends);
        let is_gone = ends.gone.contains(&at);
        let Some(open) = ends.open.get_mut(&at) else {
            if !is_gone {
                self.shared.reject("unknown");
            }
            return;
        };
        match (open.token, &frame.body) {
            (None, Body::Opened) => open.token = Some(frame.token),
            // The other machine refuses the tunnel.
            (None, Body::Close { .. }) => {}
            (Some(token), Body::Open) if token == frame.token => return self.shared.reject("replayed"),
            (Some(token), _) if token == frame.token => {}
            _ => return self.shared.reject("unknown"),
        }
        // If a piece of the stream is dropped here, its gap ends the tunnel.
        if open.inbox.try_send(frame.into_owned()).is_err() {
            self.shared.reject("flooded");
        }
    }
}

/// Waits until the link ends.
async fn end_of(stopped: &mut watch::Receiver<bool>) {
    let _ = stopped.wait_for(|is_stopped| *is_stopped).await;
}

/// A number above 0 that nobody can guess.
///
/// # Errors
/// The operating system has no random numbers. A number that others could guess is never used in their place.
pub(super) fn random() -> Result<u64, String> {
    let drawn = getrandom::u64();
    drawn.map(|number| number.max(1)).map_err(|error| format!("the operating system gives no random numbers: {error}"))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
