use super::*;

const PLAIN: &[u8] = b"bg\x04\0a frame";

fn hello(agreement: &Agreement, candidate: Option<PublicKey>) -> Hello {
    let (key, heard_key) = agreement.for_hello(candidate);
    Hello { key: Some(key), heard_key, ..Hello::default() }
}

fn agreements() -> [Agreement; 2] {
    let robot = Agreement::new("blindgrasp/_/g", "robot", "brain", 1).expect("made");
    let brain = Agreement::new("blindgrasp/_/g", "brain", "robot", 2).expect("made");
    [robot, brain]
}

/// Two agreements that have settled on each other.
fn settled() -> [Agreement; 2] {
    let [mut robot, mut brain] = agreements();
    let asked = hello(&robot, None);
    let answer = hello(&brain, asked.key);
    assert!(robot.is_answered(&answer, false) && !brain.is_answered(&asked, false));
    robot.settle(2, answer.key.expect("a key")).expect("settled");
    let answered = hello(&robot, None);
    assert!(brain.is_answered(&answered, false));
    brain.settle(1, answered.key.expect("a key")).expect("settled");
    assert!(robot.is_answered(&hello(&brain, None), true) && brain.is_answered(&hello(&robot, None), true));
    [robot, brain]
}

fn pairs() -> [Arc<PairKeys>; 2] {
    settled().map(|agreement| agreement.pair().expect("keys"))
}

fn encrypted(keys: &PairKeys, kind: KeyKind) -> Vec<u8> {
    let mut frame = PLAIN.to_vec();
    keys.encrypt(kind, &mut frame);
    frame
}

#[test]
fn both_ends_derive_the_same_keys() {
    let [robot, brain] = pairs();
    for (from, to) in [(&robot, &brain), (&brain, &robot)] {
        for kind in [KeyKind::Link, KeyKind::Data] {
            let frame = encrypted(from, kind);
            assert!(!frame.windows(5).any(|bytes| bytes == b"frame"), "readable");
            assert_eq!(to.decrypt(kind, &frame).as_deref(), Ok(PLAIN));
        }
    }
    // The same frame is never the same bytes.
    assert_ne!(encrypted(&robot, KeyKind::Link), encrypted(&robot, KeyKind::Link));
}

#[test]
fn changed_reflected_and_moved_frames_are_forged() {
    let [robot, brain] = pairs();
    let frame = encrypted(&robot, KeyKind::Link);
    for idx in 0..frame.len() {
        let mut changed = frame.clone();
        changed[idx] ^= 1;
        let is_id = (HEAD_BYTES..HEAD_BYTES + ID_BYTES).contains(&idx);
        let expected = if is_id { WireError::OtherKeys } else { WireError::Forged };
        assert_eq!(brain.decrypt(KeyKind::Link, &changed), Err(expected), "byte {idx}");
    }
    for n_bytes in 0..frame.len() {
        assert_eq!(brain.decrypt(KeyKind::Link, &frame[..n_bytes]), Err(WireError::Forged), "{n_bytes} bytes");
    }
    assert_eq!(brain.decrypt(KeyKind::Data, &frame), Err(WireError::Forged));
    // Back to its sender, also under the id of the other direction.
    assert_eq!(robot.decrypt(KeyKind::Link, &frame), Err(WireError::OtherKeys));
    let mut reflected = frame.clone();
    reflected[HEAD_BYTES..][..ID_BYTES].copy_from_slice(&robot.receiving_id);
    assert_eq!(robot.decrypt(KeyKind::Link, &reflected), Err(WireError::Forged));
}

#[test]
fn frames_of_other_agreements_are_told_apart() {
    let [robot, _] = pairs();
    let [_, brain] = pairs();
    assert_eq!(brain.decrypt(KeyKind::Link, &encrypted(&robot, KeyKind::Link)), Err(WireError::OtherKeys));
}

/// The keys depend on names, instances and graph, and not on the public keys alone.
#[test]
fn machines_that_mean_different_conversations_have_different_keys() {
    let with = |prefix: &str, name: &str, instance: u64| {
        let mut robot = Agreement::new("blindgrasp/_/g", "robot", "brain", 1).expect("made");
        let mut brain = Agreement::new(prefix, "brain", name, 2).expect("made");
        let keys = [robot.next.1, brain.next.1];
        robot.settle(2, keys[1]).expect("settled");
        brain.settle(instance, keys[0]).expect("settled");
        let frame = encrypted(&robot.pair().expect("keys"), KeyKind::Link);
        brain.pair().expect("keys").decrypt(KeyKind::Link, &frame).map(drop)
    };
    assert_eq!(with("blindgrasp/_/g", "robot", 1), Ok(()));
    assert_eq!(with("blindgrasp/7/g", "robot", 1), Err(WireError::Forged));
    assert_eq!(with("blindgrasp/_/g", "laptop", 1), Err(WireError::Forged));
    assert_eq!(with("blindgrasp/_/g", "robot", 3), Err(WireError::Forged));
}

#[test]
fn an_answer_to_used_keys_answers_nothing() {
    let [mut robot, brain] = agreements();
    let asked = hello(&robot, None);
    let answer = hello(&brain, asked.key);
    robot.settle(2, answer.key.expect("a key")).expect("settled");
    let withheld = hello(&Agreement::new("blindgrasp/_/g", "brain", "robot", 3).expect("made"), asked.key);
    assert!(!robot.is_answered(&withheld, false));
    let keys = robot.pair().expect("keys");
    // No secret comes of this public key.
    assert_eq!(robot.settle(4, [0; 32]), Err(NoAgreement));
    assert!(Arc::ptr_eq(&keys, &robot.pair().expect("keys")) && robot.is_answered(&hello(&brain, asked.key), true));
}
