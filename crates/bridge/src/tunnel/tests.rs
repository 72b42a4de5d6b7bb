//! Sends single frames to a serving end.

use std::net::TcpListener;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, channel};

use zenoh::Wait;

use super::*;
use crate::config::Endpoints;

const LIMIT: Duration = Duration::from_secs(60);
const REQUEST: &[u8] = b"{\"request\":\"attach\",\"ports\":[]}\n";

fn session(role: &str, port: u16) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let other = if role == "listen" { "connect" } else { "listen" };
    for (key, value) in [
        ("mode".to_string(), "\"peer\"".to_string()),
        (format!("{role}/endpoints"), format!("[\"tcp/127.0.0.1:{port}\"]")),
        (format!("{other}/endpoints"), "[]".into()),
        ("scouting/multicast/enabled".into(), "false".into()),
        ("scouting/gossip/enabled".into(), "false".into()),
    ] {
        config.insert_json5(&key, &value).expect("a key of Zenoh's");
    }
    zenoh::open(config).wait().expect("open")
}

/// The link on `brain`, and a machine `robot` that can send any frame.
struct Raw {
    brain: Tunnels,
    publisher: Arc<Publisher<'static>>,
    heard: Receiver<Vec<u8>>,
    /// The number and the token of the tunnel that is kept alive.
    alive: Arc<(AtomicU64, AtomicU64)>,
    _subscriber: Subscriber<()>,
    _session: zenoh::Session,
}

impl Raw {
    fn new() -> Raw {
        let port = TcpListener::bind("127.0.0.1:0").expect("bound").local_addr().expect("an address").port();
        let config = Arc::new(LinkConfig {
            run: 1,
            graph: "g".into(),
            running_graph: format!("raw-{}-{port}", std::process::id()),
            namespace: Some("n".into()),
            machine: "brain".into(),
            fingerprint: 1,
            peers: vec![PeerConfig { machine: "robot".into(), may_read: true, may_control: true, may: Vec::new() }],
            exports: Vec::new(),
            imports: Vec::new(),
            endpoints: Endpoints::default(),
            keys: None,
            insecure: false,
            deadline_millis: 200,
            buffer: 8,
        });
        let describe = |_: &serde_json::Value, _| anyhow::bail!("no recording here");
        let operators = blindgrasp_graph::operators::Operators::default();
        let listening = session("listen", port);
        let brain =
            Tunnels::start(listening, Arc::clone(&config), &[Arc::default()], describe, operators).expect("started");
        let session = session("connect", port);
        let (tell, heard) = channel();
        let key = config.key("brain", "robot", KeyKind::Ask);
        let hear = move |sample: zenoh::sample::Sample| drop(tell.send(sample.payload().to_bytes().to_vec()));
        let subscriber = session.declare_subscriber(key).callback(hear).wait().expect("subscribed");
        let key = config.key("robot", "brain", KeyKind::Ask);
        let publisher = session.declare_publisher(key).congestion_control(CongestionControl::Block).wait();
        let publisher = Arc::new(publisher.expect("declared"));
        let alive = Arc::new((AtomicU64::new(0), AtomicU64::new(0)));
        let (weak, of) = (Arc::downgrade(&publisher), Arc::clone(&alive));
        std::thread::spawn(move || {
            while let Some(publisher) = weak.upgrade() {
                let (id, token) = (of.0.load(Ordering::Relaxed), of.1.load(Ordering::Relaxed));
                if id != 0 {
                    let frame = Frame { id, token, is_from_asker: true, body: Body::Alive };
                    let _ = publisher.put(frame.encode().expect("encoded")).wait();
                }
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        Raw { brain, publisher, heard, alive, _subscriber: subscriber, _session: session }
    }

    fn say(&self, id: u64, token: u64, body: Body<'_>) {
        let frame = Frame { id, token, is_from_asker: true, body };
        self.publisher.put(frame.encode().expect("encoded")).wait().expect("put");
    }

    /// Waits for a frame for which `wanted` returns a value.
    fn wait_for<T>(&self, wanted: impl Fn(&Frame<'_>) -> Option<T>) -> T {
        loop {
            let bytes = self.heard.recv_timeout(LIMIT).expect("said");
            let frame = Frame::decode(&bytes).expect("a frame");
            assert!(!frame.is_from_asker);
            if let Some(found) = wanted(&frame) {
                return found;
            }
        }
    }

    fn open(&self, id: u64) -> u64 {
        self.say(id, 0, Body::Open);
        let token = self.wait_for(|frame| (frame.id == id && frame.body == Body::Opened).then_some(frame.token));
        self.alive.1.store(token, Ordering::Relaxed);
        self.alive.0.store(id, Ordering::Relaxed);
        token
    }

    fn count(&self, why: &str) -> u64 {
        self.brain.rejected().by_reason().get(why).copied().unwrap_or(0)
    }

    fn wait_for_count(&self, why: &str, count: u64) {
        let start = std::time::Instant::now();
        while self.count(why) < count {
            assert!(start.elapsed() < LIMIT, "{:?}", self.brain.rejected());
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(self.count(why), count);
    }

    fn wait_for_close(&self, id: u64) -> String {
        self.wait_for(|frame| match &frame.body {
            Body::Close { reason } if frame.id == id => Some(reason.clone().expect("a reason")),
            _ => None,
        })
    }
}

/// Opens a tunnel as soon as the machines have found each other.
fn connected() -> (Raw, u64) {
    let raw = Raw::new();
    let matching = || raw.publisher.matching_status().wait().is_ok_and(|status| status.matching());
    let start = std::time::Instant::now();
    while !matching() {
        assert!(start.elapsed() < LIMIT);
        std::thread::sleep(Duration::from_millis(5));
    }
    let token = raw.open(1);
    (raw, token)
}

#[test]
fn replayed_frames_are_rejected_and_a_gap_ends_the_tunnel() {
    let (raw, token) = connected();
    raw.say(1, token, Body::Data { index: 0, bytes: REQUEST.into() });
    let answer = raw.wait_for(|frame| match &frame.body {
        Body::Data { index: 0, bytes } => Some(String::from_utf8_lossy(bytes).into_owned()),
        _ => None,
    });
    assert!(answer.contains("shared memory"), "{answer}");
    // The opening of the tunnel and a piece of the stream are sent again.
    raw.say(1, 0, Body::Open);
    raw.wait_for_count("replayed", 1);
    raw.say(1, token, Body::Data { index: 0, bytes: REQUEST.into() });
    raw.wait_for_count("replayed", 2);
    // Frames of a tunnel that does not exist, and with the token of another tunnel.
    raw.say(99, token, Body::Alive);
    raw.wait_for_count("unknown", 1);
    raw.say(1, token.wrapping_add(1), Body::Data { index: 1, bytes: REQUEST.into() });
    raw.wait_for_count("unknown", 2);
    // None of these was answered; the next piece in order is.
    raw.say(1, token, Body::Data { index: 1, bytes: REQUEST.into() });
    raw.wait_for(|frame| matches!(frame.body, Body::Data { index: 1, .. }).then_some(()));
    raw.say(1, token, Body::Data { index: 3, bytes: REQUEST.into() });
    let reason = raw.wait_for_close(1);
    assert!(reason.contains("was lost on the way"), "{reason}");
    // A late frame is not counted; the opening of a tunnel that has ended is.
    raw.say(1, token, Body::Alive);
    raw.say(1, 0, Body::Open);
    raw.wait_for_count("replayed", 3);
    let second = raw.open(2);
    assert_ne!(second, token);
    raw.say(2, token, Body::Data { index: 0, bytes: REQUEST.into() });
    raw.wait_for_count("unknown", 3);
}

#[test]
fn an_end_that_sends_too_much_or_nothing_is_cut_off() {
    let (raw, token) = connected();
    // This end takes no answer, so that the serving end takes no further request.
    for index in 0..20 * WINDOW {
        raw.say(1, token, Body::Data { index, bytes: REQUEST.into() });
    }
    let reason = raw.wait_for_close(1);
    assert!(reason.contains("more than it may") || reason.contains("lost on the way"), "{reason}");
    assert!(raw.count("flooded") > 0, "{:?}", raw.brain.rejected());

    raw.open(2);
    raw.alive.0.store(0, Ordering::Relaxed);
    let reason = raw.wait_for_close(2);
    assert!(reason.starts_with("machine 'robot' is cut off"), "{reason}");
}
