use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use blindgrasp_messages::zerocopy::IntoBytes as _;
use blindgrasp_messages::{
    Action, Contact, ContactSet, Fault, GraspFeature, GraspScene, GraspTruth, Header, LiftDecision, LiftOutcome,
    MAX_CELLS, MAX_FEATURES, MAX_JOINTS, MESSAGE_TYPES, OwnedSenses, Phase, Prediction, Reason, Recorded, Sense,
    TactileFrame,
};

/// Any bits: NaNs with payloads, subnormals, negative zeros.
fn any_f64(rng: &mut ChaCha8Rng) -> f64 {
    match rng.random_range(0..4) {
        0 => f64::from_bits(0x7ff0_0000_0000_0001 | rng.next_u64()),
        1 => f64::from_bits(rng.next_u64()),
        2 => -0.0,
        _ => rng.random_range(-3.0..3.0),
    }
}

fn any_list(rng: &mut ChaCha8Rng, most: usize) -> Vec<f64> {
    let n_items = if rng.random_bool(0.1) { most } else { rng.random_range(0..=most.min(20)) };
    (0..n_items).map(|_| any_f64(rng)).collect()
}

fn any_of<T: Copy>(rng: &mut ChaCha8Rng, all: &[T]) -> T {
    all[rng.random_range(0..all.len())]
}

fn bits(value: &f64) -> u64 {
    value.to_bits()
}

/// The head as it came in is the head as it went out, but for `origin_nanos`; as are the items.
fn check<M: Message>(rng: &mut ChaCha8Rng, message: &M) {
    let header = Header {
        seq: rng.next_u64() >> rng.random_range(0..64),
        stamp_nanos: rng.next_u64(),
        epoch: rng.next_u64(),
        hand_id: rng.next_u64(),
        origin_nanos: rng.next_u64(),
        valid_nanos: rng.next_u64(),
        made_by: rng.next_u64(),
    };
    let (head, items) = message.to_parts(header);
    let mut bytes = vec![7; 3];
    encode::<M>(&head, &items, &mut bytes).expect("a sound message");
    let sample = decode::<M>(&bytes).expect("what was encoded");
    assert_eq!(sample.header, Header { origin_nanos: 0, ..header });
    let (found_head, found_items) = sample.message.to_parts(header);
    // Printed, floats lose what is in a NaN: those are compared as they lie in memory.
    assert_eq!(found_head.as_bytes(), head.as_bytes(), "{message:?}");
    assert_eq!(found_items.as_bytes(), items.as_bytes(), "{message:?}");
    // Nothing shorter or longer passes for it.
    assert!(decode::<M>(&bytes[..bytes.len() - 1]).is_err());
    bytes.push(0);
    let error = decode::<M>(&bytes).expect_err("too long").to_string();
    assert!(error.contains("1 bytes too many") && error.contains(M::TYPE_NAME), "{error}");
}

#[test]
fn every_message_arrives_bit_by_bit() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for _ in 0..300 {
        let rng = &mut rng;
        let (grasp_id, phase, fault) = (rng.next_u64(), any_of(rng, Phase::ALL), any_of(rng, Fault::ALL));
        let joints = any_list(rng, MAX_JOINTS);
        let cells_newtons = any_list(rng, MAX_CELLS);
        let sense = |rng: &mut ChaCha8Rng, n: usize| {
            let n = if rng.random() { n } else { 0 };
            (0..n).map(|_| any_f64(rng)).collect::<Vec<f64>>()
        };
        let mut senses = OwnedSenses::default();
        Sense::ALL.into_iter().for_each(|one| senses.set(one, &sense(rng, one.len(joints.len()))));
        let day = rng.next_u32();
        let frame =
            TactileFrame { grasp_id, phase, joints: joints.clone(), cells_newtons, senses: senses.clone(), day };
        check(rng, &frame);
        let n_contacts = if rng.random_bool(0.1) { MAX_CELLS } else { rng.random_range(0..10) };
        let contact = |rng: &mut ChaCha8Rng| Contact {
            position_m: [(); 3].map(|()| any_f64(rng)),
            normal: [(); 3].map(|()| any_f64(rng)),
            force_newtons: any_f64(rng),
            pad: rng.next_u32(),
            cell: rng.next_u32(),
        };
        let contacts = ContactSet {
            grasp_id,
            phase,
            joints,
            contacts: (0..n_contacts).map(|_| contact(rng)).collect(),
            n_pads_in_contact: rng.random_range(0..=32),
            self_collision: rng.random(),
            n_self_contacts: rng.random_range(0..=1024),
            fault,
            senses,
            day,
        };
        check(rng, &contacts);
        let values = any_list(rng, MAX_FEATURES);
        let dictionary_id = rng.next_u64();
        check(rng, &GraspFeature { grasp_id, phase, values, n_pads_in_contact: 3, dictionary_id, fault, day });
        let prediction = Prediction {
            grasp_id,
            phase,
            decision_value: any_f64(rng),
            probability_stable: any_f64(rng),
            stable: rng.random(),
            unsure: rng.random(),
            fault,
        };
        check(rng, &prediction);
        let (action, reason) = (any_of(rng, Action::ALL), any_of(rng, Reason::ALL));
        let decision = LiftDecision { grasp_id, action, reason, probability_stable: any_f64(rng) };
        check(rng, &decision);
        let truth = GraspTruth {
            grasp_id,
            epsilon: any_f64(rng),
            volume: any_f64(rng),
            stable: rng.random(),
            object: "bücher-1".chars().take(rng.random_range(0..9)).collect(),
            object_class: "ü".repeat(rng.random_range(0..=32)),
        };
        check(rng, &truth);
        let outcome = LiftOutcome {
            grasp_id,
            trial: rng.next_u64(),
            attempt: rng.next_u32(),
            lifted: rng.random(),
            held: rng.random(),
            has_quality: rng.random(),
            slip_m: any_f64(rng),
            turn_rad: any_f64(rng),
            epsilon: any_f64(rng),
            volume: any_f64(rng),
            mass_kg: any_f64(rng),
            friction: any_f64(rng),
            thing: "bücher, 0.5 kg".chars().take(rng.random_range(0..15)).collect(),
            group: "ü".repeat(rng.random_range(0..=32)),
            probed: rng.random(),
            disturbed: rng.random(),
        };
        check(rng, &outcome);
    }
    // The comparison is one of bits.
    assert_ne!(bits(&f64::NAN), bits(&f64::from_bits(f64::NAN.to_bits() | 1)));
    assert_ne!(f64::NAN.as_bytes(), f64::from_bits(f64::NAN.to_bits() | 1).as_bytes());
}

#[test]
fn what_cannot_be_is_refused_on_both_ends() {
    let (mut head, items) = TactileFrame::default().to_parts(Header::default());
    head.phase = 11;
    let mut out = vec![1];
    let error = encode::<TactileFrame>(&head, &items, &mut out).expect_err("no such phase");
    assert_eq!(
        (error.to_string().as_str(), out),
        ("a blindgrasp/TactileFrame/5 whose phase has the unknown code 11", vec![])
    );

    let too_long = TactileFrame { cells_newtons: vec![0.0; MAX_CELLS + 1], ..TactileFrame::default() };
    let too_long = Stamped { header: Header::default(), message: too_long };
    let bytes = bincode::serde::encode_to_vec((0u64, 0u64, &too_long), bincode::config::standard()).expect("encoded");
    let error = decode::<TactileFrame>(&bytes).expect_err("too long").to_string();
    assert!(error.contains("cells_newtons has length 16385, expected 0 to 16384"), "{error}");

    let bytes =
        bincode::serde::encode_to_vec((0u64, 0u64, Header::default(), 7u64, 11u32), bincode::config::standard());
    let error = decode::<Prediction>(&bytes.expect("encoded")).expect_err("no such phase").to_string();
    assert!(error.contains("unknown code 11") && error.contains("blindgrasp/Prediction/4"), "{error}");
}

#[test]
fn schema_numbers_tell_types_apart_and_stay_as_they_are() {
    // A change here means: machines with the version before refuse each other. A type's name changes then, too.
    let found = MESSAGE_TYPES.map(|type_name| schema_id(type_name).expect("it can cross"));
    assert_eq!(found, [2761762759, 2685038448, 3215498353, 1254893153, 2891020063, 312201359, 412222848]);
    let others = [GraspScene::TYPE_NAME, "blindgrasp/TactileFrame/2", ""];
    assert!(others.iter().all(|type_name| schema_id(type_name).is_none()));
}

#[test]
fn what_stands_for_an_unreadable_sample_is_no_message_of_any_type() {
    use blindgrasp_operator::cursors::SampleId;
    let key = SampleId { epoch: u64::MAX, seq: 7 };
    let bytes = encode_unreadable(key);
    assert_eq!(decode_unreadable(&bytes), Some(key));
    assert_eq!(decode_unreadable(&bytes[..15]), None);
    assert!(decode::<Prediction>(&bytes).is_err() && decode::<GraspFeature>(&bytes).is_err());
}
