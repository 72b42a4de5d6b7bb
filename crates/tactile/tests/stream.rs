//! The clients that may send frames: real sockets, made-up time.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};

use blindgrasp_tactile::stream::{Link, Stream};
use blindgrasp_tactile::{Event, ExpectedHand, Place, TactileDriver};

const SEC: u64 = 1_000_000_000;
const FRAME: &[u8] = b"{\"joints\":[0.5],\"cells_newtons\":[0,1],\"phase\":\"open\"}\n";

fn source(path: &std::path::Path) -> Stream {
    let hand = ExpectedHand {
        hand: "test".into(),
        hand_id: "0".into(),
        n_joints: 1,
        n_cells: 2,
        joints: vec!["j".into()],
        pads: Vec::new(),
        cell_unit: "newtons",
    };
    Stream::new(Link::Listen { address: format!("unix:{}", path.display()) }, hand, None)
}

fn events(source: &mut Stream, now_nanos: u64) -> Vec<Event> {
    std::iter::from_fn(|| source.poll(now_nanos, &Place::default()).expect("it goes on")).collect()
}

#[test]
fn a_socket_file_is_the_users_own_and_one_that_was_left_is_replaced() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hand.sock");
    // A process that was killed leaves its socket.
    drop(UnixListener::bind(&path).expect("free"));
    let mut source = source(&path);
    source.open(0).expect("replaced");
    assert_eq!(std::fs::metadata(&path).expect("made").permissions().mode() & 0o777, 0o600);
    let mut bridge = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, SEC), [Event::Began]);
    bridge.write_all(FRAME).expect("sent");
    assert!(matches!(events(&mut source, SEC)[..], [Event::Frame(..)]));
    // A file that is no socket is somebody's.
    let file = folder.path().join("file");
    std::fs::write(&file, "mine").expect("written");
    assert!(self::source(&file).open(0).is_err() && file.exists());
    let mut another = self::source(&path);
    assert!(another.open(0).expect_err("taken").to_string().contains("hand.sock"));
    drop(another);
    assert!(path.exists());
    source.close();
    assert!(!path.exists());
}

#[test]
fn frames_of_another_hand_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hand.sock");
    let mut source = source(&path);
    source.open(0).expect("free");
    let mut bridge = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, SEC), [Event::Began]);
    let of_hand = |hand: &str| {
        let frame = std::str::from_utf8(FRAME).expect("UTF-8");
        frame.replacen('{', &format!("{{\"hand\":\"{hand}\","), 1)
    };
    bridge.write_all(of_hand("left").as_bytes()).expect("sent");
    let [Event::Refused(refusal)] = &events(&mut source, SEC)[..] else { panic!("expected a refusal") };
    assert!(refusal.why.starts_with("the frame is of the hand left: expected test (hand_id 0);"), "{}", refusal.why);
    for own in ["test", "0"] {
        bridge.write_all(of_hand(own).as_bytes()).expect("sent");
        assert!(matches!(events(&mut source, SEC)[..], [Event::Frame(..)]), "{own}");
    }
}

#[test]
fn a_client_that_says_nothing_gives_way_and_a_sender_does_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("hand.sock");
    let mut source = source(&path);
    source.open(0).expect("free");
    let mut squatter = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, SEC), [Event::Began]);
    // Lines that are no frames do not count.
    squatter.write_all(b"{}\n").expect("sent");
    assert!(matches!(events(&mut source, 2 * SEC)[..], [Event::Refused(_)]));
    let early = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, 2 * SEC), [Event::TurnedAway]);
    let mut told = String::new();
    BufReader::new(early).read_line(&mut told).expect("told");
    assert!(told.contains("busy"), "{told}");
    let mut bridge = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, 4 * SEC), [Event::Began]);
    bridge.write_all(FRAME).expect("sent");
    assert!(matches!(events(&mut source, 5 * SEC)[..], [Event::Frame(..)]));
    let _late = UnixStream::connect(&path).expect("connected");
    assert_eq!(events(&mut source, 6 * SEC), [Event::TurnedAway]);
}
