//! Damages frames in many ways: the link never panics, no length that a frame claims takes
//! memory, and an accepted frame or sample decodes to the same again after encoding.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use blindgrasp_bridge::sample;
use blindgrasp_bridge::wire::{
    Body, ExportedChannel, Frame, Hello, MAX_FRAME_BYTES, SampleFrame, WireError, encode_refusal,
};
use blindgrasp_messages::{
    Contact, ContactSet, GraspFeature, GraspTruth, Header, LiftDecision, LiftOutcome, Message, Prediction, Recorded,
    TactileFrame, WithMessage, with_message,
};
use blindgrasp_operator::cursors::SampleId;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::seeds::seeds;

/// A few seconds' worth.
const N_CASES: u64 = 200_000;

/// Counts the bytes that each thread allocates.
struct Counting;

thread_local! {
    static N_BYTES: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: the system's allocator does all the work.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        N_BYTES.set(N_BYTES.get() + layout.size());
        // SAFETY: as asked.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as asked.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The memory that a decoder may take: buffers grow in steps, and two lists are reserved before their items come.
fn most_bytes(n_bytes: usize) -> usize {
    32 * n_bytes + MAX_FRAME_BYTES + 2 * (64 << 10)
}

fn counted<T>(n_bytes: usize, decode: impl FnOnce() -> T) -> T {
    let before = N_BYTES.get();
    let decoded = decode();
    let taken = N_BYTES.get() - before;
    assert!(taken <= most_bytes(n_bytes), "{taken} bytes of memory for {n_bytes} bytes");
    decoded
}

const TYPES: [&str; 7] = [
    TactileFrame::TYPE_NAME,
    ContactSet::TYPE_NAME,
    GraspFeature::TYPE_NAME,
    Prediction::TYPE_NAME,
    LiftDecision::TYPE_NAME,
    GraspTruth::TYPE_NAME,
    LiftOutcome::TYPE_NAME,
];

fn samples(rng: &mut ChaCha8Rng) -> Vec<Vec<u8>> {
    fn encoded<M: Message>(rng: &mut ChaCha8Rng, message: &M) -> Vec<u8> {
        let header = Header {
            seq: rng.next_u64() >> 40,
            stamp_nanos: rng.next_u64(),
            epoch: 3,
            hand_id: 1,
            ..Header::default()
        };
        let (head, items) = message.to_parts(header);
        let mut bytes = Vec::new();
        sample::encode::<M>(&head, &items, &mut bytes).expect("sound");
        bytes
    }
    let numbers = |rng: &mut ChaCha8Rng, most: usize| -> Vec<f64> {
        (0..rng.random_range(0..most)).map(|_| f64::from_bits(rng.next_u64())).collect()
    };
    let (joints, cells_newtons, values) = (numbers(rng, 9), numbers(rng, 100), numbers(rng, 300));
    let contacts = vec![Contact { force_newtons: 1.0, ..Contact::default() }; rng.random_range(0..20)];
    let truth = GraspTruth { object: "bücher".into(), object_class: "book".into(), ..GraspTruth::default() };
    let outcome = LiftOutcome { thing: "bücher".into(), group: "book".into(), ..LiftOutcome::default() };
    vec![
        encoded(rng, &TactileFrame { joints: joints.clone(), cells_newtons, ..TactileFrame::default() }),
        encoded(rng, &ContactSet { joints, contacts, ..ContactSet::default() }),
        encoded(rng, &GraspFeature { values, ..GraspFeature::default() }),
        encoded(rng, &Prediction { stable: true, ..Prediction::default() }),
        encoded(rng, &LiftDecision::default()),
        encoded(rng, &truth),
        encoded(rng, &outcome),
    ]
}

fn frame(rng: &mut ChaCha8Rng, message: &[u8]) -> Vec<u8> {
    let key = rng.random_bool(0.5).then(|| SampleId { epoch: rng.next_u64(), seq: rng.next_u64() });
    let number = rng.next_u64() >> rng.random_range(0..64);
    let (channel, run) = (rng.random_range(0..4), rng.next_u32());
    let body = match rng.random_range(0..8) {
        0 => {
            let channel = ExportedChannel { port: "a/b".into(), type_name: TYPES[0].into(), schema_id: run };
            let exports = vec![channel; rng.random_range(0..5)];
            let (version, machine) = ("0.1.0".into(), "robot".into());
            Body::Hello(Hello {
                version,
                machine,
                heard: Some(number),
                key: Some([7; 32]),
                fingerprint: 7,
                exports,
                is_ready: true,
                ..Hello::default()
            })
        }
        1 => Body::Pong { sent_nanos: number, received_nanos: number, answered_nanos: 3 },
        2 => Body::Resume { channel, run, after: key },
        3 => Body::Ack { channel, run, n_received: number, answered: key },
        4 => Body::End { channel, run, last: key },
        5 => Body::Leaving,
        _ => {
            let (index, sent_nanos) = (number, number);
            let age_nanos = rng.random_bool(0.5).then_some(number);
            let sample =
                SampleFrame { channel, run, index, schema_id: 5, echo_nanos: 9, age_nanos, sent_nanos, message };
            Body::Sample(sample)
        }
    };
    let mut bytes = Vec::new();
    Frame { instance: rng.next_u64(), counter: number, body }.encode_into(&mut bytes).expect("encoded");
    bytes
}

fn damage(bytes: &mut Vec<u8>, other: &[u8], rng: &mut ChaCha8Rng) {
    for _ in 0..rng.random_range(0..=3) {
        if bytes.len() < 4 {
            return;
        }
        // Early, where the lengths are, or anywhere.
        let at = if rng.random_bool(0.5) {
            rng.random_range(0..bytes.len().min(64))
        } else {
            rng.random_range(0..bytes.len())
        };
        match rng.random_range(0..7) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes[at] = rng.random(),
            2 => bytes.truncate(at),
            3 => {
                let from = rng.random_range(0..other.len());
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            // Any length, as bincode writes it.
            4 => {
                let length: u64 = [u64::MAX, 1 << 60, 1 << 40, u64::from(u32::MAX), 1 << 18][rng.random_range(0..5)];
                let marked = [&[253], &length.to_le_bytes()[..]].concat();
                bytes.splice(at..at + 1, marked);
            }
            5 => {
                let marked = [&[252], &(rng.next_u32() >> rng.random_range(0..16)).to_le_bytes()[..]].concat();
                bytes.splice(at..at + 1, marked);
            }
            _ => bytes.extend(std::iter::repeat_n(rng.random::<u8>(), rng.random_range(1..200))),
        }
    }
}

/// Decodes a sample as each type that there is.
struct CheckSample<'a>(&'a [u8]);

impl WithMessage for CheckSample<'_> {
    type Output = bool;

    fn with<M: Message>(self) -> bool {
        let decoded = counted(self.0.len(), || sample::decode::<M>(self.0));
        let Ok(sample) = decoded else { return false };
        let (head, items) = sample.message.to_parts(sample.header);
        let mut bytes = Vec::new();
        sample::encode::<M>(&head, &items, &mut bytes).expect("what was accepted can travel on");
        let again = sample::decode::<M>(&bytes).expect("what was accepted is accepted again");
        let mut bytes_again = Vec::new();
        let (head, items) = again.message.to_parts(again.header);
        sample::encode::<M>(&head, &items, &mut bytes_again).expect("as before");
        // Bytes, since a NaN is equal to nothing.
        assert_eq!(bytes_again, bytes);
        assert_eq!(again.header, sample.header);
        true
    }
}

/// Whether it passed for a frame, and how many types its message passed for.
fn check(bytes: &[u8]) -> (bool, usize) {
    let as_types =
        |bytes: &[u8]| TYPES.iter().filter(|name| with_message(name, CheckSample(bytes)).expect("known")).count();
    match counted(bytes.len(), || Frame::decode(bytes)) {
        Ok(frame) => {
            let mut again = Vec::new();
            frame.encode_into(&mut again).expect("encoded");
            assert_eq!(Frame::decode(&again).as_ref(), Ok(&frame));
            let n_types = if let Body::Sample(sample) = &frame.body { as_types(sample.message) } else { 0 };
            (true, n_types)
        }
        Err(WireError::Refused(text) | WireError::Malformed(text)) => {
            assert!(!text.contains(|char: char| char.is_control() && char != '\t'), "{text:?}");
            (false, 0)
        }
        Err(_) => (false, 0),
    }
}

#[test]
fn damaged_frames_are_dropped_or_decode_consistently() {
    let (mut n_done, mut n_accepted, mut n_samples) = (0, 0, 0);
    for seed in seeds(N_CASES) {
        let outcome = std::panic::catch_unwind(|| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut samples = samples(&mut rng);
            let other = samples[rng.random_range(0..TYPES.len())].clone();
            let sample = &mut samples[rng.random_range(0..TYPES.len())];
            // The message, the frame around it, or both.
            if rng.random_bool(0.5) {
                damage(sample, &other, &mut rng);
            }
            let mut bytes = frame(&mut rng, sample);
            let refusal = encode_refusal("no, because");
            let other = if rng.random_bool(0.1) { refusal } else { frame(&mut rng, &other) };
            if rng.random_bool(0.5) {
                damage(&mut bytes, &other, &mut rng);
            }
            check(&bytes)
        });
        let Ok((is_frame, n_types)) = outcome else {
            panic!("it fails at once with BLINDGRASP_FUZZ_SEED={seed}");
        };
        n_done += 1;
        n_accepted += u64::from(is_frame);
        n_samples += n_types as u64;
    }
    println!("{n_done} frames, {n_accepted} accepted, {n_samples} times a sample");
    // A few cases prove nothing.
    if n_done >= 1000 {
        assert!(n_accepted > n_done / 4 && n_samples > n_done / 20 && n_accepted < n_done);
    }
}
