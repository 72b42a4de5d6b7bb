use super::*;
use crate::sample;
use blindgrasp_messages::{Header, Message, Phase, Stamped, TactileFrame};

fn bodies(message: &[u8]) -> Vec<Body<'_>> {
    let key = SampleId { epoch: u64::MAX, seq: 7 };
    let channel = ExportedChannel {
        port: "contacts/contacts".into(),
        type_name: "blindgrasp/ContactSet/7".into(),
        schema_id: u32::MAX,
    };
    let hello = Hello {
        version: "0.1.0".into(),
        machine: "robot".into(),
        heard: Some(3),
        key: Some([7; 32]),
        fingerprint: u64::MAX,
        run: 5,
        is_cut_off: true,
        lacks_request: true,
        exports: vec![channel; 3],
        is_ready: true,
        ..Hello::default()
    };
    let sample = SampleFrame {
        channel: 3,
        run: 4,
        index: 1 << 40,
        schema_id: 5,
        echo_nanos: 0,
        age_nanos: None,
        sent_nanos: u64::MAX,
        message,
    };
    vec![
        Body::Hello(Hello { heard: None, exports: Vec::new(), is_ready: false, ..hello.clone() }),
        Body::Hello(hello),
        Body::Ping { sent_nanos: 1 },
        Body::Pong { sent_nanos: 1, received_nanos: u64::MAX, answered_nanos: 2 },
        Body::Resume { channel: u16::MAX, run: u32::MAX, after: Some(key) },
        Body::Resume { channel: 0, run: 0, after: None },
        Body::Sample(sample.clone()),
        Body::Sample(SampleFrame { age_nanos: Some(u64::MAX), message: &[], ..sample }),
        Body::Ack { channel: 1, run: 2, n_received: 3, answered: Some(key) },
        Body::End { channel: 1, run: 2, last: None },
        Body::Ended { channel: 1 },
        Body::Leaving,
    ]
}

fn encoded(frame: &Frame) -> Vec<u8> {
    let mut bytes = b"what was there".to_vec();
    frame.encode_into(&mut bytes).expect("encoded");
    bytes
}

#[test]
fn every_frame_arrives_as_it_was_and_no_other_does() {
    let message: Vec<u8> = (0..=255).collect();
    for body in bodies(&message) {
        let frame = Frame { instance: u64::MAX, counter: 250, body };
        let bytes = encoded(&frame);
        assert_eq!(Frame::decode(&bytes).as_ref(), Ok(&frame));
        for n_bytes in 0..bytes.len() {
            let error = Frame::decode(&bytes[..n_bytes]).expect_err("cut off");
            let expected_foreign = n_bytes < 3;
            assert_eq!(error == WireError::Foreign, expected_foreign, "{n_bytes}: {error}");
            assert!(expected_foreign || matches!(error, WireError::Malformed(_)), "{n_bytes}: {error}");
        }
        let longer = [&bytes[..], &[0, 0]].concat();
        assert_eq!(Frame::decode(&longer), Err(WireError::Malformed("2 bytes too many".into())));
    }
}

#[test]
fn foreign_newer_and_too_long_frames_are_told_apart() {
    let bytes = encoded(&Frame { instance: 1, counter: 2, body: Body::Leaving });
    assert_eq!(Frame::decode(b"GET / HTTP/1.1\r\n"), Err(WireError::Foreign));
    let mut newer = bytes.clone();
    newer[2] = PROTOCOL + 1;
    let error = Frame::decode(&newer).expect_err("another version");
    assert_eq!(error, WireError::Version { found: PROTOCOL + 1 });
    assert!(error.to_string().contains("install the same version on all"), "{error}");
    let mut longer = bytes.clone();
    longer.resize(MAX_FRAME_BYTES + 1, 0);
    assert_eq!(Frame::decode(&longer), Err(WireError::Oversized));
    let mut rejected = Rejected::with_zeros();
    for bytes in [&b"no"[..], &newer, &longer, &longer, &bytes[..4], &encode_refusal("no")] {
        let error = Frame::decode(bytes).expect_err("none of them");
        error.reason().into_iter().for_each(|reason| rejected.count(reason));
    }
    let counted = ["foreign", "version", "oversized", "malformed"].map(|reason| rejected.by_reason()[reason]);
    assert_eq!((counted, rejected.by_reason()["stale"], rejected.by_reason().len()), ([1, 1, 2, 1], 0, 7));
}

#[test]
fn a_frame_that_is_too_long_is_an_error_and_leaves_no_bytes() {
    let message = vec![7; MAX_FRAME_BYTES];
    let sample = SampleFrame {
        channel: 0,
        run: 1,
        index: 0,
        schema_id: 1,
        echo_nanos: 0,
        age_nanos: None,
        sent_nanos: 0,
        message: &message,
    };
    let mut bytes = b"of the frame before".to_vec();
    let error = Frame { instance: 1, counter: 1, body: Body::Sample(sample) }.encode_into(&mut bytes);
    assert!(matches!(error, Err(WireError::Unsendable(_))), "{error:?}");
    assert_eq!(bytes, b"");
}

#[test]
fn a_refusal_is_read_by_every_version_and_moves_no_cursor() {
    assert_eq!(encode_refusal("grüße"), b"bg\0gr\xc3\xbc\xc3\x9fe");
    assert_eq!(Frame::decode(&encode_refusal("grüße")), Err(WireError::Refused("grüße".into())));
    let evil = "a\x1b[2Jb\u{202e}c\rd\n";
    let Err(WireError::Refused(text)) = Frame::decode(&encode_refusal(evil)) else { panic!("a refusal") };
    assert_eq!(text, "a\\u{1b}[2Jb\\u{202e}c\\rd");
    assert_eq!(Frame::decode(b"bg\0\xff"), Err(WireError::Refused("\u{fffd}".into())));
    // Both ends cut a longer text, and not within a letter.
    let long = format!("a{}", "ü".repeat(MAX_REFUSAL_BYTES));
    assert_eq!(encode_refusal(&long).len(), 3 + MAX_REFUSAL_BYTES - 1);
    let forged = [&b"bg\0"[..], long.as_bytes()].concat();
    let Err(WireError::Refused(text)) = Frame::decode(&forged) else { panic!("a refusal") };
    assert!(text.chars().count() <= MAX_REFUSAL_BYTES && text.starts_with("aüü"), "{}", text.len());
}

#[test]
fn names_are_short_and_printable_and_lists_are_not_endless() {
    let hello = |version: &str, n_exports| {
        let channel = ExportedChannel { port: "a/b".into(), type_name: "c".into(), schema_id: 1 };
        let body = Body::Hello(Hello {
            version: version.into(),
            machine: "robot".into(),
            exports: vec![channel; n_exports],
            ..Hello::default()
        });
        let bytes = encoded(&Frame { instance: 1, counter: 1, body });
        Frame::decode(&bytes).map(|_| ()).map_err(|error| error.to_string())
    };
    assert_eq!(hello("0.1.0", MAX_CHANNELS), Ok(()));
    let error = hello("0.1.0", MAX_CHANNELS + 1).expect_err("too many");
    assert!(error.contains("more than 4096 items"), "{error}");
    assert_eq!(hello(&"v".repeat(MAX_WIRE_NAME_BYTES), 0), Ok(()));
    let error = hello(&"v".repeat(MAX_WIRE_NAME_BYTES + 1), 0).expect_err("too long");
    assert!(error.contains("a name of 257 bytes, expected at most 256"), "{error}");
    let error = hello("\x1b[2J", 0).expect_err("it would clear a terminal");
    assert!(error.contains("cannot be printed") && !error.contains('\x1b'), "{error}");
}

/// The largest possible frame around a message.
#[test]
fn a_barrett_frame_takes_a_tenth_more_than_its_message_at_most() {
    let header = Header {
        seq: 1 << 33,
        stamp_nanos: u64::MAX,
        epoch: u64::MAX,
        hand_id: u64::MAX,
        origin_nanos: u64::MAX,
        ..Header::default()
    };
    let frame = TactileFrame {
        grasp_id: u64::MAX,
        phase: Phase::Settled,
        joints: vec![0.5; 7],
        cells_newtons: vec![0.25; 96],
        ..TactileFrame::default()
    };
    let (head, items) = frame.to_parts(header);
    let mut message = Vec::new();
    sample::encode::<TactileFrame>(&head, &items, &mut message).expect("encoded");
    let stamped = Stamped { header, message: frame };
    let bare = bincode::serde::encode_to_vec(&stamped, bincode::config::standard()).expect("encoded").len();
    let worst = SampleFrame {
        channel: u16::MAX,
        run: u32::MAX,
        index: u64::MAX,
        schema_id: u32::MAX,
        echo_nanos: u64::MAX,
        age_nanos: Some(u64::MAX),
        sent_nanos: u64::MAX,
        message: &message,
    };
    let n_bytes = encoded(&Frame { instance: u64::MAX, counter: u64::MAX, body: Body::Sample(worst) }).len();
    println!("{n_bytes} bytes for {bare}");
    assert!(10 * n_bytes <= 11 * bare, "{n_bytes} bytes for {bare}");
}

#[test]
fn the_largest_messages_fit_into_a_frame() {
    use blindgrasp_messages::{Contact, ContactSet, MAX_CELLS, MAX_JOINTS};
    let contact = Contact { pad: u32::MAX, cell: u32::MAX, ..Contact::default() };
    let contacts =
        ContactSet { joints: vec![0.0; MAX_JOINTS], contacts: vec![contact; MAX_CELLS], ..ContactSet::default() };
    let (head, items) = contacts.to_parts(Header::default());
    let mut message = Vec::new();
    sample::encode::<ContactSet>(&head, &items, &mut message).expect("encoded");
    // The names of a channel and a signature, which are added to a message, take less than the rest.
    assert!(3 * message.len() < 2 * MAX_FRAME_BYTES, "{}", message.len());
}
