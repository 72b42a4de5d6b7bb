//! Two or three links and what a stranger does with their bytes.

use std::path::Path;

use super::*;
use crate::keys::{KeyRequest, make, revoke};
use crate::peer::{Change, Own, Peer, Rejection};
use blindgrasp_graph::link::config::{LinkConfig, key_files};
use blindgrasp_operator::link_status::PeerState;

const DEADLINE_NANOS: u64 = 150_000_000;

/// One end of a conversation.
struct End {
    own: Own,
    peer: Peer,
    protection: Protection,
    now_nanos: u64,
}

#[derive(Debug, PartialEq, Eq)]
enum Taken {
    Hello(Option<Change>, bool),
    Frame(Option<Change>),
    Rejected(Rejection),
    Refused(WireError),
}

fn keys(machines: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let request = KeyRequest {
        folder: folder.path().into(),
        machines: machines.iter().map(ToString::to_string).collect(),
        days: 90,
        ..KeyRequest::default()
    };
    make(&request, OffsetDateTime::now_utc()).expect("made");
    folder
}

/// A link of `machine` with the keys of `signer`.
fn end_as(folder: Option<&Path>, [machine, signer, peer]: [&str; 3], instance: u64) -> End {
    let config = LinkConfig {
        graph: "g".into(),
        machine: signer.into(),
        keys: folder.map(|folder| key_files(folder, signer)),
        ..LinkConfig::default()
    };
    let identity = Identity::load(&config, OffsetDateTime::now_utc()).expect("fit").map(Arc::new);
    let agreement = |_: &Arc<Identity>| Agreement::new(&config.key_prefix(), machine, peer, instance).expect("made");
    let agreement = identity.as_ref().map(agreement);
    let protection = identity.zip(agreement.as_ref());
    let protection =
        protection.map(|(identity, agreement)| Protection::new(identity, peer, agreement)).unwrap_or_default();
    let own = Own {
        instance,
        machine: machine.into(),
        fingerprint: 9,
        run: instance,
        is_ready: true,
        is_eager_until_nanos: 0,
    };
    End {
        own,
        peer: Peer::new(peer.into(), Vec::new(), Vec::new(), DEADLINE_NANOS, agreement),
        protection,
        now_nanos: 0,
    }
}

fn end(folder: Option<&Path>, machine: &str, peer: &str, instance: u64) -> End {
    end_as(folder, [machine, machine, peer], instance)
}

impl End {
    fn frame(&mut self, body: Body<'_>) -> Vec<u8> {
        let mut bytes = Vec::new();
        let counter = self.peer.next_counter(KeyKind::Link);
        Frame { instance: self.own.instance, counter, body }.encode_into(&mut bytes).expect("encoded");
        bytes
    }

    fn hello(&mut self) -> Vec<u8> {
        let hello = self.peer.hello(&self.own, self.now_nanos);
        let mut bytes = self.frame(hello);
        self.protection.sign(&mut bytes).expect("signed");
        bytes
    }

    fn ping(&mut self) -> Vec<u8> {
        let mut bytes = self.frame(Body::Ping { sent_nanos: 7 });
        assert!(self.protection.encrypt(KeyKind::Link, &mut bytes));
        bytes
    }

    fn take(&mut self, bytes: &[u8]) -> Taken {
        let opened = self.protection.open(KeyKind::Link, bytes);
        let frame = match opened.as_ref().map_err(WireError::clone).and_then(Opened::frame) {
            Ok(frame) => frame,
            Err(error) => return Taken::Refused(error),
        };
        let Frame { instance, counter, body } = frame;
        match &body {
            Body::Hello(hello) => match self.peer.on_hello(&self.own, instance, counter, hello, self.now_nanos) {
                Ok((change, is_to_answer)) => Taken::Hello(change, is_to_answer),
                Err(rejection) => Taken::Rejected(rejection),
            },
            _ => self
                .peer
                .on_frame(KeyKind::Link, instance, counter, self.now_nanos)
                .map_or_else(Taken::Rejected, Taken::Frame),
        }
    }
}

/// Exchanges hellos until no answer is due; returns all of them.
fn greet(first: &mut End, second: &mut End) -> Vec<Vec<u8>> {
    let mut said = Vec::new();
    let (mut speaker, mut listener) = (first, second);
    for _ in 0..8 {
        let hello = speaker.hello();
        let taken = listener.take(&hello);
        said.push(hello);
        match taken {
            Taken::Hello(_, true) => std::mem::swap(&mut speaker, &mut listener),
            Taken::Hello(_, false) => return said,
            other => panic!("{other:?}"),
        }
    }
    panic!("they never stop");
}

fn assert_talk(robot: &mut End, brain: &mut End) {
    assert_eq!((robot.peer.state, brain.peer.state), (PeerState::Up, PeerState::Up));
    assert_eq!(brain.take(&robot.ping()), Taken::Frame(None));
    assert_eq!(robot.take(&brain.ping()), Taken::Frame(None));
}

fn pair(folder: &Path) -> [End; 2] {
    let mut pair = [end(Some(folder), "robot", "brain", 1), end(Some(folder), "brain", "robot", 2)];
    let [robot, brain] = &mut pair;
    greet(robot, brain);
    assert_talk(robot, brain);
    pair
}

#[test]
fn machines_without_keys_talk_in_plain_frames() {
    let [mut robot, mut brain] = [end(None, "robot", "brain", 1), end(None, "brain", "robot", 2)];
    greet(&mut robot, &mut brain);
    assert_talk(&mut robot, &mut brain);
    let Ok(Frame { instance: 1, body: Body::Ping { sent_nanos: 7 }, .. }) = Frame::decode(&robot.ping()) else {
        panic!("a plain frame")
    };
}

#[test]
fn keys_on_one_side_alone_are_refused_in_words() {
    let folder = keys(&["robot", "brain"]);
    let [mut robot, mut brain] = [end(Some(folder.path()), "robot", "brain", 1), end(None, "brain", "robot", 2)];
    let Taken::Refused(WireError::Unverified(reason)) = brain.take(&robot.hello()) else { panic!("refused") };
    assert!(reason.contains("this machine has no keys") && reason.contains("--keys DIR"), "{reason}");
    let Taken::Refused(WireError::Unverified(reason)) = robot.take(&brain.hello()) else { panic!("refused") };
    assert!(reason.contains("machine 'brain' does not sign") && reason.contains("--machine brain"), "{reason}");
    let before = robot.peer.state;
    assert_eq!((before, brain.peer.state), (PeerState::Waiting, PeerState::Waiting));
}

/// Another machine of the graph has a right certificate, knows everything that was ever said, and delivers what it
/// wants.
#[test]
fn a_stranger_with_a_right_certificate_changes_nothing() {
    let folder = keys(&["robot", "brain", "laptop"]);
    let [mut robot, mut brain] = pair(folder.path());
    // It says hello as brain, with its own key.
    let mut laptop = end_as(Some(folder.path()), ["brain", "laptop", "robot"], 3);
    laptop.protection.0.as_mut().expect("with keys").peer = "robot".into();
    let robots = robot.hello();
    let Taken::Refused(WireError::Unverified(_)) = robot.take(&laptop.hello()) else { panic!("refused") };
    assert_talk(&mut robot, &mut brain);
    // It sends brain's own words back, or robot's words to robot, or changes one byte of them.
    assert!(matches!(robot.take(&robots), Taken::Refused(WireError::Unverified(_))));
    let ping = brain.ping();
    for idx in 0..ping.len() {
        let mut changed = ping.clone();
        changed[idx] ^= 1;
        assert!(matches!(robot.take(&changed), Taken::Refused(_)), "byte {idx}");
    }
    let hello = brain.hello();
    for idx in 0..hello.len() {
        let mut changed = hello.clone();
        changed[idx] ^= 1;
        assert!(matches!(robot.take(&changed), Taken::Refused(_)), "byte {idx}");
    }
    for n_bytes in 0..hello.len() {
        assert!(matches!(robot.take(&hello[..n_bytes]), Taken::Refused(_)), "{n_bytes} bytes");
    }
    // A plain frame is none, whoever may have sent it.
    let (instance, counter) = (brain.own.instance, u64::MAX);
    let mut plain = Vec::new();
    Frame { instance, counter, body: Body::Leaving }.encode_into(&mut plain).expect("encoded");
    assert!(matches!(robot.take(&plain), Taken::Refused(WireError::Unverified(_))));
    // What was not changed is taken once.
    assert!(matches!(robot.take(&ping), Taken::Frame(None)));
    assert_eq!(robot.take(&ping), Taken::Rejected(Rejection::Replayed));
    assert!(matches!(robot.take(&hello), Taken::Hello(None, _)));
    assert_eq!(robot.take(&hello), Taken::Rejected(Rejection::Replayed));
    assert_talk(&mut robot, &mut brain);
}

#[test]
fn hellos_of_before_displace_nobody() {
    let folder = keys(&["robot", "brain"]);
    let [mut robot, mut old_brain] =
        [end(Some(folder.path()), "robot", "brain", 1), end(Some(folder.path()), "brain", "robot", 2)];
    // A process of brain that robot never hears answers robot's hello.
    let asked = robot.hello();
    let mut withheld_brain = end(Some(folder.path()), "brain", "robot", 3);
    assert_eq!(withheld_brain.take(&asked), Taken::Hello(None, true));
    let withheld = withheld_brain.hello();
    let recorded = greet(&mut old_brain, &mut robot);
    assert_talk(&mut robot, &mut old_brain);
    let late = old_brain.ping();
    // Brain is started again.
    let mut brain = end(Some(folder.path()), "brain", "robot", 4);
    greet(&mut brain, &mut robot);
    assert_talk(&mut robot, &mut brain);

    assert_eq!(robot.take(&withheld), Taken::Hello(None, true), "it is answered, and changes nothing");
    for old in &recorded {
        assert!(!matches!(robot.take(old), Taken::Hello(Some(_), _) | Taken::Frame(_)));
    }
    assert_eq!(robot.take(&late), Taken::Refused(WireError::OtherKeys));
    assert_talk(&mut robot, &mut brain);
    // The true brain clears the process that is not there from robot's next hello.
    let hello = brain.hello();
    assert!(matches!(robot.take(&hello), Taken::Hello(None, _)));
    assert!(matches!(brain.take(&robot.hello()), Taken::Hello(None, _)));
    assert_talk(&mut robot, &mut brain);
}

#[test]
fn lost_hellos_are_made_up_for() {
    let folder = keys(&["robot", "brain"]);
    // Both may begin, and each of the first hellos may be lost.
    for lost in 0..64_u32 {
        let [mut robot, mut brain] =
            [end(Some(folder.path()), "robot", "brain", 1), end(Some(folder.path()), "brain", "robot", 2)];
        for n in 0..12 {
            let (speaker, listener) = if n % 2 == 0 { (&mut robot, &mut brain) } else { (&mut brain, &mut robot) };
            let hello = speaker.hello();
            if n >= 6 || lost & (1 << n) == 0 {
                assert!(matches!(listener.take(&hello), Taken::Hello(..)));
            }
        }
        assert_talk(&mut robot, &mut brain);
    }
}

/// Frames alone do not keep a machine in the graph: its hellos must go on to be believed.
#[test]
fn a_machine_that_is_revoked_is_cut_off_until_it_has_a_new_certificate() {
    let folder = keys(&["robot", "brain"]);
    let [mut robot, mut brain] = pair(folder.path());
    let mut now_nanos = 0;
    let mut second = |robot: &mut End, brain: &mut End, is_revoked: bool| {
        let hello = robot.hello();
        assert_eq!(matches!(brain.take(&hello), Taken::Refused(WireError::Unverified(_))), is_revoked);
        let mut is_heard = true;
        for _ in 0..10 {
            now_nanos += 100_000_000;
            (robot.now_nanos, brain.now_nanos) = (now_nanos, now_nanos);
            is_heard = matches!(brain.take(&robot.ping()), Taken::Frame(_));
            brain.peer.check_deadline(now_nanos);
        }
        is_heard
    };
    for _ in 0..20 {
        assert!(second(&mut robot, &mut brain, false));
    }
    revoke(folder.path(), "robot", None, OffsetDateTime::now_utc()).expect("revoked");
    let n_heard = (0..20).map(|_| second(&mut robot, &mut brain, true)).filter(|is_heard| *is_heard).count();
    assert!((1..12).contains(&n_heard), "{n_heard} s");
    assert_eq!(brain.peer.state, PeerState::Down);
    let mut frame = brain.frame(Body::Leaving);
    assert!(!brain.protection.encrypt(KeyKind::Link, &mut frame), "it hears nothing either");
    // Brain's hellos do not keep robot up, so that robot knows that it is cut off.
    assert_eq!(robot.take(&brain.hello()), Taken::Hello(None, true));
    assert_eq!(robot.peer.check_deadline(robot.now_nanos), Some(Change::CutOff));
    assert_eq!(robot.take(&brain.hello()), Taken::Hello(None, true));
    assert_eq!(robot.peer.state, PeerState::Down);

    let request = KeyRequest {
        folder: folder.path().into(),
        machines: vec!["robot".into()],
        days: 90,
        renew: true,
        ..KeyRequest::default()
    };
    make(&request, OffsetDateTime::now_utc()).expect("renewed");
    assert!(second(&mut robot, &mut brain, false));
    greet(&mut robot, &mut brain);
    assert_talk(&mut robot, &mut brain);
}

#[test]
fn a_long_silence_ends_with_the_same_processes() {
    let folder = keys(&["robot", "brain"]);
    for n_lost in 0..4 {
        let [mut robot, mut brain] = pair(folder.path());
        for end in [&mut robot, &mut brain] {
            end.now_nanos = 3_600_000_000_000;
            assert_eq!(end.peer.check_deadline(end.now_nanos), Some(Change::CutOff));
        }
        for _ in 0..n_lost {
            robot.take(&brain.hello());
        }
        greet(&mut robot, &mut brain);
        assert_talk(&mut robot, &mut brain);
    }
}
