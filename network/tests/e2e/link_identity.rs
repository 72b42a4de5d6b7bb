//! Strangers whose bytes Zenoh delivers: whatever they send in another machine's name, links refuse it. The sessions have
//! no TLS and no access control, so that nothing but the links' own protocol stands between them.

use std::path::Path;
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use blindgrasp_bridge::agreement::Agreement;
use blindgrasp_bridge::identity::Identity;
use blindgrasp_bridge::peer::{Own, Peer};
use blindgrasp_bridge::protection::{Opened, Protection};
use blindgrasp_bridge::session::open;
use blindgrasp_bridge::wire::{Body, Frame, Hello, WireError};
use blindgrasp_graph::link::config::{Endpoints, KeyKind, LinkConfig};
use blindgrasp_operator::link_status::PeerState;
use blindgrasp_operator::monotonic_nanos;
use serde_json::json;
use time::OffsetDateTime;
use zenoh::{Session, Wait};

use crate::link_security::{by_router, config, connect, free_endpoint, keys, listen, stranger_as, wait_until};

const KINDS: [KeyKind; 2] = [KeyKind::Link, KeyKind::Data];

/// A link as far as its protocol goes.
struct Link {
    own: Own,
    peer: Peer,
    protection: Protection,
    config: LinkConfig,
    session: Session,
    inbox: Receiver<(KeyKind, Vec<u8>)>,
    n_taken: u64,
    n_forged: u64,
    n_others: u64,
}

fn protection(config: &LinkConfig, machine: &str, peer: &str, instance: u64) -> (Agreement, Protection) {
    let identity = Identity::load(config, OffsetDateTime::now_utc()).expect("fit").expect("with keys");
    let agreement = Agreement::new(&config.key_prefix(), machine, peer, instance).expect("made");
    let protection = Protection::new(Arc::new(identity), peer, &agreement);
    (agreement, protection)
}

impl Link {
    fn open(machine: &str, peer: &str, endpoints: Endpoints, folder: &Path, instance: u64) -> Link {
        let config = LinkConfig { insecure: true, ..config(machine, endpoints, Some(folder)) };
        let session = open(&config).expect("open");
        let (tell, inbox) = channel();
        for kind in KINDS {
            let tell = tell.clone();
            session
                .declare_subscriber(config.key(peer, machine, kind))
                .callback(move |sample| drop(tell.send((kind, sample.payload().to_bytes().into_owned()))))
                .background()
                .wait()
                .expect("subscribed");
        }
        let own = Own {
            instance,
            machine: machine.into(),
            fingerprint: 0,
            run: 1,
            is_ready: true,
            is_eager_until_nanos: u64::MAX,
        };
        let (agreement, protection) = protection(&config, machine, peer, instance);
        // Silence is not what this is about.
        let peer = Peer::new(peer.into(), Vec::new(), Vec::new(), u64::MAX / 2, Some(agreement));
        Link { own, peer, protection, config, session, inbox, n_taken: 0, n_forged: 0, n_others: 0 }
    }

    fn key(&self) -> String {
        self.config.key(&self.own.machine, &self.peer.machine, KeyKind::Link)
    }

    fn say(&mut self, body: Body<'_>) {
        let (is_hello, counter) = (matches!(body, Body::Hello(_)), self.peer.next_counter(KeyKind::Link));
        let mut bytes = Vec::new();
        Frame { instance: self.own.instance, counter, body }.encode_into(&mut bytes).expect("encoded");
        let is_protected = if is_hello {
            self.protection.sign(&mut bytes).is_ok()
        } else {
            self.protection.encrypt(KeyKind::Link, &mut bytes)
        };
        if is_protected {
            self.session.put(self.key(), bytes).wait().expect("put");
        }
    }

    /// Says what is due and takes what has come.
    fn step(&mut self) {
        let mut bodies = Vec::new();
        self.peer.due(&self.own, monotonic_nanos(), &mut bodies);
        bodies.into_iter().for_each(|body| self.say(body));
        while let Ok((kind, bytes)) = self.inbox.try_recv() {
            let opened = self.protection.open(kind, &bytes);
            let frame = match opened.as_ref().map_err(WireError::clone).and_then(Opened::frame) {
                Ok(frame) => frame,
                Err(error) => {
                    let is_forged = error.reason() == Some("forged");
                    *(if is_forged { &mut self.n_forged } else { &mut self.n_others }) += 1;
                    continue;
                }
            };
            let (Frame { instance, counter, body }, now_nanos) = (frame, monotonic_nanos());
            let taken = match &body {
                Body::Hello(hello) => {
                    let taken = self.peer.on_hello(&self.own, instance, counter, hello, now_nanos);
                    taken.map(|(_, is_to_answer)| is_to_answer)
                }
                _ => self.peer.on_frame(kind, instance, counter, now_nanos).map(|_| false),
            };
            match taken {
                Ok(true) => {
                    let hello = self.peer.hello(&self.own, now_nanos);
                    self.say(hello);
                }
                Ok(false) => self.n_taken += 1,
                Err(_) => self.n_others += 1,
            }
        }
    }
}

/// A key and what was sent under it.
type Message = (String, Vec<u8>);

/// A session that breaks the rules, with the keys of laptop.
struct Stranger {
    session: Session,
    heard: Arc<Mutex<Vec<Message>>>,
}

impl Stranger {
    fn new(session: Session) -> Stranger {
        let heard = Arc::<Mutex<Vec<_>>>::default();
        let into = Arc::clone(&heard);
        session
            .declare_subscriber("blindgrasp/**")
            .allowed_origin(zenoh::sample::Locality::Remote)
            .callback(move |sample| {
                let bytes = sample.payload().to_bytes().into_owned();
                into.lock().expect("not poisoned").push((sample.key_expr().to_string(), bytes));
            })
            .background()
            .wait()
            .expect("subscribed");
        Stranger { session, heard }
    }

    /// Says hello and more to `to` in the name of `from`, and repeats everything that it has heard.
    fn forge(&self, folder: &Path, from: &Link, to: &mut Link, counter: u64) {
        let laptop = config("laptop", Endpoints::default(), Some(folder));
        let (_, protection) = protection(&laptop, "laptop", &to.own.machine, 77);
        // It knows the latest public key of `to`, as if it had read its hello.
        let Body::Hello(answered) = to.peer.hello(&to.own, 0) else { panic!("a hello") };
        let hello = |instance: u64| {
            let hello = Hello {
                machine: from.own.machine.clone(),
                heard: Some(to.own.instance),
                key: Some([9; 32]),
                heard_key: answered.key,
                ..answered.clone()
            };
            let mut bytes = Vec::new();
            Frame { instance, counter, body: Body::Hello(hello) }.encode_into(&mut bytes).expect("encoded");
            bytes
        };
        let mut forged = vec![hello(77), hello(from.own.instance)];
        for mut bytes in [hello(77), hello(from.own.instance)] {
            protection.sign(&mut bytes).expect("signed");
            forged.push(bytes);
        }
        for body in [Body::Leaving, Body::Ping { sent_nanos: u64::MAX }] {
            let mut bytes = Vec::new();
            Frame { instance: from.own.instance, counter, body }.encode_into(&mut bytes).expect("encoded");
            forged.push(bytes.clone());
            // As if it were encrypted.
            bytes[3] = 2;
            bytes.resize(64, 7);
            forged.push(bytes);
        }
        for bytes in forged {
            self.session.put(from.key(), bytes).wait().expect("put");
        }
        let heard: Vec<_> = self.heard.lock().expect("not poisoned").iter().rev().take(32).cloned().collect();
        for (key, bytes) in heard {
            self.session.put(key, bytes).wait().expect("put");
        }
    }
}

/// Robot and brain find each other and stay so, whatever the strangers send.
fn check(topology: &str, folder: &Path, mut robot: Link, mut brain: Link, strangers: &[Stranger]) {
    let mut both = |what: &str, is_so: &mut dyn FnMut(&mut Link, &mut Link) -> bool| {
        wait_until(&format!("{topology}: {what}"), || {
            robot.step();
            brain.step();
            is_so(&mut robot, &mut brain)
        });
    };
    both("they are up", &mut |robot, brain| robot.peer.state == PeerState::Up && brain.peer.state == PeerState::Up);
    let mut n_rounds = 0;
    both("forged frames have come", &mut |robot, brain| {
        n_rounds += 1;
        for stranger in strangers {
            stranger.forge(folder, brain, robot, u64::MAX - 1000 + n_rounds);
            stranger.forge(folder, robot, brain, u64::MAX - 1000 + n_rounds);
        }
        n_rounds >= 30 && robot.n_forged + brain.n_forged > 100
    });
    let before = [robot.n_taken, brain.n_taken];
    wait_until(&format!("{topology}: they still hear each other"), || {
        robot.step();
        brain.step();
        robot.n_taken > before[0] + 5 && brain.n_taken > before[1] + 5
    });
    for link in [&robot, &brain] {
        assert_eq!((link.peer.state, link.peer.n_times_up), (PeerState::Up, 1), "{topology}");
    }
    for stranger in strangers {
        for (key, bytes) in stranger.heard.lock().expect("not poisoned").iter() {
            let plain = Frame::decode(bytes);
            assert!(plain.is_err(), "{topology}: the stranger can read {key}: {plain:?}");
        }
    }
}

fn tcp() -> String {
    free_endpoint("tcp")
}

fn stranger(id: Option<&Session>, endpoints: &Endpoints) -> Stranger {
    Stranger::new(stranger_as(id.map(|session| session.zid().to_string()), endpoints, json!({}), 2))
}

/// Robot listens and dials brain. Strangers dial both, with their own Zenoh ids and with those of the machines.
#[test]
fn two_machines_that_listen_and_a_stranger() {
    let (folder, endpoints) = (keys(&["robot", "brain", "laptop"]), [tcp(), tcp()]);
    let folder = folder.path();
    let brain = Link::open("brain", "robot", listen(&endpoints[1]), folder, 1);
    let both =
        Endpoints { listen: vec![endpoints[0].clone()], connect: vec![endpoints[1].clone()], ..Endpoints::default() };
    let robot = Link::open("robot", "brain", both, folder, 2);
    let everywhere = Endpoints { connect: endpoints.to_vec(), ..Endpoints::default() };
    let strangers = [
        stranger(None, &everywhere),
        stranger(Some(&brain.session), &connect(&endpoints[0])),
        stranger(Some(&robot.session), &connect(&endpoints[1])),
    ];
    check("two that listen", folder, robot, brain, &strangers);
}

/// Robot dials brain and a machine that answers with a Zenoh id of its own or with that of brain.
#[test]
fn a_dialled_machine_that_lies() {
    for lies in [false, true] {
        let (folder, endpoints) = (keys(&["robot", "brain", "laptop"]), [tcp(), tcp(), tcp()]);
        let folder = folder.path();
        let brain = Link::open("brain", "robot", listen(&endpoints[0]), folder, 1);
        let dials = Endpoints { connect: endpoints.to_vec(), ..Endpoints::default() };
        let liar = stranger(lies.then_some(&brain.session), &listen(&endpoints[1]));
        let honest = stranger(None, &listen(&endpoints[2]));
        let mut robot = Link::open("robot", "brain", dials, folder, 2);
        if !lies {
            check("a dialled machine", folder, robot, brain, &[liar, honest]);
            continue;
        }
        // A liar that comes first keeps brain out until it leaves: that is all it gets.
        let mut brain = brain;
        for round in 0..50 {
            liar.forge(folder, &brain, &mut robot, round);
            robot.step();
            brain.step();
            std::thread::sleep(Duration::from_millis(5));
        }
        liar.session.close().wait().expect("closed");
        check("a liar that has left", folder, robot, brain, &[honest]);
    }
}

/// The router itself is the stranger. It has no keys and no certificate.
#[test]
fn a_router_cannot_read_or_forge() {
    let (folder, endpoint) = (keys(&["robot", "brain", "laptop"]), tcp());
    let folder = folder.path();
    let router = json!({
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "adminspace": {"enabled": false},
        "transport": {"shared_memory": {"enabled": false}},
    });
    let router = zenoh::Config::from_json5(&router.to_string()).expect("a configuration");
    let router = Stranger::new(zenoh::open(router).wait().expect("open"));
    let brain = Link::open("brain", "robot", by_router(&endpoint), folder, 1);
    let robot = Link::open("robot", "brain", by_router(&endpoint), folder, 2);
    check("a router", folder, robot, brain, &[router]);
}
