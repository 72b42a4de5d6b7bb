use super::*;
use blindgrasp_messages::ContactSet;
use blindgrasp_messages::Recorded as _;
use blindgrasp_operator::wiring::EdgePolicy;

const MILLIS: u64 = 1_000_000;
const DEADLINE_NANOS: u64 = 150 * MILLIS;

/// A machine with one peer.
pub(crate) struct Side {
    pub(crate) own: Own,
    pub(crate) peer: Peer,
}

pub(crate) fn own(machine: &str, instance: u64) -> Own {
    Own { instance, machine: machine.into(), fingerprint: 9, run: instance, is_ready: true, is_eager_until_nanos: 0 }
}

/// A link from robot to brain, with contacts as the only channel.
pub(crate) fn pair() -> [Side; 2] {
    let channel = Channel {
        port: "contacts/contacts".into(),
        type_name: ContactSet::TYPE_NAME.into(),
        from: "robot".into(),
        to: "brain".into(),
        policy: EdgePolicy::Lossless,
        capacity: 256,
        is_from_source: true,
        is_to_source: false,
        is_urgent: false,
    };
    let robot = Peer::new("brain".into(), vec![channel.clone()], vec![], DEADLINE_NANOS, None);
    let brain = Peer::new("robot".into(), vec![], vec![channel], DEADLINE_NANOS, None);
    [Side { own: own("robot", 1), peer: robot }, Side { own: own("brain", 2), peer: brain }]
}

impl Side {
    fn hello(&mut self, now_nanos: u64) -> (u64, u64, Hello) {
        let Body::Hello(hello) = self.peer.hello(&self.own, now_nanos) else { panic!("a hello") };
        (self.own.instance, self.peer.next_counter(KeyKind::Link), hello)
    }

    fn hear(
        &mut self,
        (instance, counter, hello): &(u64, u64, Hello),
        now_nanos: u64,
    ) -> Result<(Option<Change>, bool), Rejection> {
        self.peer.on_hello(&self.own, *instance, *counter, hello, now_nanos)
    }

    fn ping(&mut self, from: &mut Side, now_nanos: u64) -> Result<Option<Change>, Rejection> {
        let counter = from.peer.next_counter(KeyKind::Link);
        self.peer.on_frame(KeyKind::Link, from.own.instance, counter, now_nanos)
    }
}

/// Exchanges hellos until no answer is due.
fn greet(first: &mut Side, second: &mut Side, now_nanos: u64) -> [Option<Change>; 2] {
    let mut changes = [None, None];
    let mut is_firsts_turn = true;
    for _ in 0..8 {
        let (speaker, listener) =
            if is_firsts_turn { (&mut *first, &mut *second) } else { (&mut *second, &mut *first) };
        let hello = speaker.hello(now_nanos);
        let (change, is_to_answer) = listener.hear(&hello, now_nanos).expect("taken");
        let slot = &mut changes[usize::from(is_firsts_turn)];
        *slot = change.or(*slot);
        if !is_to_answer {
            return changes;
        }
        is_firsts_turn = !is_firsts_turn;
    }
    panic!("they never stop");
}

#[test]
fn two_links_find_each_other_in_either_order() {
    for robot_begins in [true, false] {
        let [mut robot, mut brain] = pair();
        let changes = if robot_begins { greet(&mut robot, &mut brain, 0) } else { greet(&mut brain, &mut robot, 0) };
        assert_eq!(changes, [Some(Change::Found); 2]);
        assert!(robot.peer.is_ready() && brain.peer.is_ready());
        assert_eq!((robot.peer.state, robot.peer.n_times_up), (PeerState::Up, 1));
    }
}

#[test]
fn frames_of_strangers_and_replays_are_rejected() {
    let [mut robot, mut brain] = pair();
    assert_eq!(brain.ping(&mut robot, 0), Err(Rejection::Stranger));
    greet(&mut robot, &mut brain, 0);
    assert_eq!(brain.ping(&mut robot, MILLIS), Ok(None));
    assert_eq!(brain.peer.on_frame(KeyKind::Link, 1, 1, 2 * MILLIS), Err(Rejection::Replayed));
    assert_eq!(brain.peer.on_frame(KeyKind::Link, 77, 1000, 2 * MILLIS), Err(Rejection::Stranger));
    // Each key has its own counter.
    assert_eq!(brain.peer.on_frame(KeyKind::Data, 1, 1, 2 * MILLIS), Ok(None));
    assert_eq!(brain.peer.on_frame(KeyKind::Data, 1, 1, 2 * MILLIS), Err(Rejection::Replayed));
}

/// On a busy machine one link can miss a deadline that the other one does not miss.
#[test]
fn a_peer_that_was_cut_off_on_one_side_only_is_asked_for_its_requests_until_they_come() {
    for is_found_by_hello in [false, true] {
        let [mut robot, mut brain] = pair();
        greet(&mut robot, &mut brain, 0);
        let late_nanos = 2 * DEADLINE_NANOS;
        assert_eq!(robot.peer.check_deadline(late_nanos), Some(Change::CutOff));
        let found = if is_found_by_hello {
            let hello = brain.hello(late_nanos);
            robot.hear(&hello, late_nanos).expect("taken").0
        } else {
            robot.ping(&mut brain, late_nanos).expect("taken")
        };
        assert_eq!(found, Some(Change::Found));
        // A hello that is lost is repeated.
        for _ in 0..2 {
            let hello = robot.hello(late_nanos);
            assert!(!hello.2.is_cut_off);
            assert_eq!(brain.hear(&hello, late_nanos), Ok((Some(Change::Asked), false)));
        }
        robot.peer.on_requests();
        let hello = robot.hello(late_nanos);
        assert_eq!(brain.hear(&hello, late_nanos), Ok((None, false)));
    }
}

/// A machine that was refused, because another one spoke in its name, may not know that either.
#[test]
fn a_peer_that_was_refused_for_another_one_is_asked_for_its_requests() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    robot.peer.check_deadline(2 * DEADLINE_NANOS);
    let (_, _, hello) = brain.hello(2 * DEADLINE_NANOS);
    let other = (77, 1, Hello { heard: None, fingerprint: 8, ..hello });
    assert!(matches!(robot.hear(&other, 2 * DEADLINE_NANOS), Err(Rejection::Refused(_))));
    robot.peer.state = PeerState::Refused;
    let hello = brain.hello(2 * DEADLINE_NANOS);
    assert_eq!(robot.hear(&hello, 2 * DEADLINE_NANOS).expect("taken").0, Some(Change::Found));
    assert!(robot.hello(2 * DEADLINE_NANOS).2.lacks_request);
}

/// A link that was started again requests samples by itself: a second request would send the first samples twice.
#[test]
fn a_new_instance_is_not_asked() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    let channels = brain.peer.imports.clone();
    let peer = Peer::new("robot".into(), vec![], channels, DEADLINE_NANOS, None);
    let mut again = Side { own: Own { run: 2, ..own("brain", 7) }, peer };
    greet(&mut again, &mut robot, MILLIS);
    assert_eq!(robot.peer.state, PeerState::Up);
    assert!(!robot.hello(MILLIS).2.lacks_request);
}

/// Brain sends nothing to robot, and needs no request.
#[test]
fn a_peer_without_channels_from_here_is_not_asked() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    brain.peer.check_deadline(2 * DEADLINE_NANOS);
    assert_eq!(brain.ping(&mut robot, 2 * DEADLINE_NANOS), Ok(Some(Change::Found)));
    assert!(!brain.hello(2 * DEADLINE_NANOS).2.lacks_request);
}

#[test]
fn after_the_first_pings_few_are_answered_until_a_new_instance_comes() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    let pause_nanos = brain.peer.ping_pause_nanos();
    let answered_within = |brain: &mut Side, begin: u64, n_pings: u64| {
        (0..n_pings).filter(|&n| brain.peer.answers_ping(begin + n * pause_nanos)).count() as u64
    };
    assert_eq!(answered_within(&mut brain, 0, N_FIRST_PONGS), N_FIRST_PONGS);
    let n_pings = 10 * PONG_PAUSE_NANOS / pause_nanos;
    let n_answered = answered_within(&mut brain, N_FIRST_PONGS * pause_nanos, n_pings);
    assert!((5..=10).contains(&n_answered), "{n_answered}");
    let mut again =
        Side { own: Own { run: 1, ..own("robot", 5) }, peer: pair().into_iter().next().expect("robot").peer };
    greet(&mut again, &mut brain, MILLIS);
    assert_eq!(answered_within(&mut brain, 0, 3), 3);
}

#[test]
fn a_new_instance_takes_over_and_frames_of_the_old_one_are_rejected() {
    let [mut robot, mut brain] = pair();
    let old_hello = robot.hello(0);
    greet(&mut robot, &mut brain, 0);
    let late_hello = robot.hello(0);
    let mut again =
        Side { own: Own { run: 1, ..own("robot", 5) }, peer: pair().into_iter().next().expect("robot").peer };
    // Only the link was restarted: the run of robot's part goes on.
    assert_eq!(greet(&mut again, &mut brain, MILLIS), [Some(Change::Found); 2]);
    assert_eq!(brain.ping(&mut again, 2 * MILLIS), Ok(None));
    for stale in [old_hello, late_hello] {
        assert_eq!(brain.hear(&stale, 3 * MILLIS), Err(Rejection::Replayed));
    }
    assert_eq!(brain.ping(&mut robot, 3 * MILLIS), Err(Rejection::Replayed));
    assert_eq!(brain.ping(&mut again, 4 * MILLIS), Ok(None));
    assert_eq!(brain.peer.state, PeerState::Up);
}

#[test]
fn a_hello_that_answers_somebody_else_does_not_end_a_link_that_is_up() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    let (_, _, hello) = robot.hello(0);
    let stranger = (99, 1, Hello { heard: Some(1234), ..hello });
    assert_eq!(brain.hear(&stranger, MILLIS), Ok((None, true)));
    assert_eq!(brain.ping(&mut robot, 2 * MILLIS), Ok(None));
}

#[test]
fn a_new_run_of_the_other_part_is_told_from_the_same() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    let mut anew = Side { own: own("robot", 5), peer: pair().into_iter().next().expect("robot").peer };
    let [_, at_brain] = greet(&mut anew, &mut brain, MILLIS);
    assert_eq!(at_brain, Some(Change::FoundAnew));
}

#[test]
fn silence_is_noticed_at_the_deadline_and_a_word_ends_it() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    assert_eq!(brain.peer.check_deadline(DEADLINE_NANOS), None);
    assert_eq!(brain.peer.check_deadline(DEADLINE_NANOS + 1), Some(Change::CutOff));
    assert_eq!((brain.peer.state, brain.peer.check_deadline(10 * DEADLINE_NANOS)), (PeerState::Down, None));
    assert_eq!(brain.ping(&mut robot, 11 * DEADLINE_NANOS), Ok(Some(Change::Found)));
    assert_eq!((brain.peer.state, brain.peer.n_times_up), (PeerState::Up, 2));
}

#[test]
fn a_link_that_alone_was_cut_off_is_asked_for_its_samples() {
    let [mut robot, mut brain] = pair();
    greet(&mut robot, &mut brain, 0);
    // Only the frames to robot are lost, so that brain notices nothing.
    assert_eq!(robot.peer.check_deadline(DEADLINE_NANOS + 1), Some(Change::CutOff));
    let hello = robot.hello(DEADLINE_NANOS + 2);
    assert!(hello.2.is_cut_off);
    assert_eq!(brain.hear(&hello, DEADLINE_NANOS + 3), Ok((Some(Change::Asked), true)));
}

#[test]
fn other_files_and_types_are_refused_in_words() {
    let [mut robot, mut brain] = pair();
    robot.own.fingerprint = 10;
    let hello = robot.hello(0);
    let Err(Rejection::Refused(reason)) = brain.hear(&hello, 0) else { panic!("refused") };
    assert!(reason.contains("'robot'") && reason.contains("'brain'") && reason.contains("dataflow files"), "{reason}");
    robot.own.fingerprint = 9;
    let (instance, counter, mut hello) = robot.hello(0);
    hello.exports[0].schema_id ^= 1;
    let Err(Rejection::Refused(reason)) = brain.hear(&(instance, counter, hello), 0) else { panic!("refused") };
    assert!(reason.contains(ContactSet::TYPE_NAME), "{reason}");
    assert_ne!(brain.peer.state, PeerState::Up);
    // A corrected hello is accepted.
    assert_eq!(greet(&mut robot, &mut brain, MILLIS), [Some(Change::Found); 2]);
}

#[test]
fn the_next_due_time_is_always_in_the_future() {
    let [mut robot, mut brain] = pair();
    let mut now_nanos = 0;
    let mut bodies = Vec::new();
    for round in 0..2000 {
        if round == 500 {
            greet(&mut robot, &mut brain, now_nanos);
        }
        bodies.clear();
        robot.peer.check_deadline(now_nanos);
        robot.peer.due(&robot.own, now_nanos, &mut bodies);
        let next_nanos = robot.peer.next_due_nanos();
        assert!(next_nanos > now_nanos, "round {round}, {:?}: {next_nanos} at {now_nanos}", robot.peer.state);
        now_nanos = next_nanos;
    }
    assert_eq!(robot.peer.state, PeerState::Down);
}

/// A refusal is not signed. It is the state of a peer that was never found, and only shown of one that was.
#[test]
fn a_refusal_changes_no_state_of_a_peer_that_was_found() {
    let [mut robot, mut brain] = pair();
    assert!(robot.peer.on_refusal("another version") && robot.peer.state == PeerState::Refused);
    greet(&mut robot, &mut brain, 0);
    assert!(robot.peer.state == PeerState::Up && !robot.peer.on_refusal("forged"));
    robot.peer.on_leaving(PeerState::Down);
    assert!(robot.peer.on_refusal("forged") && robot.peer.state == PeerState::Down);
    assert_eq!(robot.peer.reason.as_deref(), Some("it refuses: forged"));
}
