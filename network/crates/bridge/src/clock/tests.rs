use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

const MILLI: u64 = 1_000_000;
const DEADLINE_NANOS: u64 = 200 * MILLI;

#[test]
fn the_offset_is_half_the_difference_of_both_directions() {
    let mut clock = ClockOffset::default();
    assert_eq!(clock.estimate(0), None);
    // The clock is 1000 ahead; 40 there, 20 back, 5 in between. The error is half the difference, at most half the
    // trip.
    assert!(clock.add(100, 1140, 1145, 165));
    let estimate = clock.estimate(165).expect("measured");
    assert_eq!(estimate, Estimate { offset_nanos: 1010, uncertainty_nanos: 31, round_trip_nanos: 60 });
    // A shorter trip is better, until it is so old that the clocks may have drifted.
    assert!(clock.add(1_000, 1_950, 1_960, 1_030));
    assert_eq!(clock.estimate(1_030).expect("measured").offset_nanos, 940);
    let later = clock.estimate(1_030 + 1_000 * MILLI).expect("measured");
    assert_eq!(later.uncertainty_nanos, 11 + 100_000);
    assert_eq!(later.round_trip_nanos, 60);
    assert!(clock.add(5_000 * MILLI, 5_000 * MILLI, 5_000 * MILLI, 5_000 * MILLI + 300));
    let newest = clock.estimate(5_000 * MILLI + 300).expect("measured");
    assert_eq!((newest.offset_nanos, newest.uncertainty_nanos), (-150, 151));
}

#[test]
fn times_that_cannot_be_are_not_taken() {
    let mut clock = ClockOffset::default();
    for [sent, received, answered, arrived] in [
        [100, 1, 2, 99],
        [100, 5, 4, 200],
        // The time between receipt and answer is longer than the trip.
        [100, 0, 500, 200],
        [100, 0, u64::MAX, 200],
        [0, u64::MAX, u64::MAX, 1],
        [0, 0, 0, LONGEST_ROUND_TRIP_NANOS + 1],
    ] {
        assert!(!clock.add(sent, received, answered, arrived), "{sent} {received} {answered} {arrived}");
    }
    assert_eq!(clock.estimate(1000), None);
}

/// The clocks differ and drift, and the delay of both directions varies.
#[test]
fn the_true_offset_is_within_the_uncertainty() {
    for seed in 0..200 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let apart: i64 = rng.random_range(-1_000_000_000_000..1_000_000_000_000);
        let drift_ppm = rng.random_range(-(DRIFT_PPM as i64)..=DRIFT_PPM as i64);
        let begun_nanos: u64 = 2_000_000_000_000;
        let offset = |nanos: u64| apart + (nanos - begun_nanos) as i64 / 1_000_000 * drift_ppm;
        let theirs = |nanos: u64| nanos.checked_add_signed(offset(nanos)).expect("in range");
        let mut clock = ClockOffset::default();
        let mut now_nanos = begun_nanos;
        for _ in 0..300 {
            now_nanos += rng.random_range(0..100 * MILLI);
            if rng.random_bool(0.5) {
                let sent = now_nanos;
                let received = sent + rng.random_range(20_000..10 * MILLI);
                let answered = received + rng.random_range(0..MILLI);
                now_nanos = answered + rng.random_range(20_000..10 * MILLI);
                assert!(clock.add(sent, theirs(received), theirs(answered), now_nanos));
            }
            let Some(estimate) = clock.estimate(now_nanos) else { continue };
            let error = estimate.offset_nanos.abs_diff(offset(now_nanos));
            // The tolerance covers the drift within a trip and the steps of `offset`.
            let slack = 3 * DRIFT_PPM;
            assert!(error <= estimate.uncertainty_nanos + slack, "{seed}: {error} {estimate:?}");
        }
    }
}

#[test]
fn the_estimate_selects_a_time_between_certain_bounds() {
    let estimate = |offset_nanos| Estimate { offset_nanos, uncertainty_nanos: 1, round_trip_nanos: 1 };
    let passage = Passage { arrival_nanos: 10_000, echo_nanos: 9_000, sent_nanos: 50_000, age_nanos: Some(300) };
    let origin = |passage: &Passage, offset| origin_on_arrival(passage, offset, 2_000);
    assert_eq!(origin(&passage, Some(estimate(40_400))), 9_300);
    // A wrong clock moves the time at most to the bounds.
    for (offset_nanos, expected) in
        [(60_000, 8_700), (i64::MAX, 8_700), (0, 9_700), (-60_000, 9_700), (i64::MIN, 8_700)]
    {
        assert_eq!(origin(&passage, Some(estimate(offset_nanos))), expected, "{offset_nanos}");
    }
    assert_eq!(origin(&passage, None), 8_700);
    // An echo that is too old, missing or in the future gives the maximum age.
    let young = estimate(40_000);
    assert_eq!(origin(&Passage { echo_nanos: 7_999, ..passage }, Some(young)), 7_699);
    assert_eq!(origin(&Passage { echo_nanos: 0, ..passage }, Some(young)), 0);
    assert_eq!(origin(&Passage { echo_nanos: 10_001, ..passage }, Some(young)), 0);
    assert_eq!(origin(&Passage { age_nanos: None, ..passage }, Some(young)), 0);
    assert_eq!(origin(&Passage { age_nanos: Some(u64::MAX), ..passage }, Some(young)), 0);
}

/// The other clock may have any value, jump and stand still.
#[test]
fn no_other_clock_makes_a_sample_look_younger_by_more_than_the_deadline() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..20_000 {
        let origin_nanos: u64 = rng.random_range(10_000 * MILLI..20_000 * MILLI);
        let age_nanos = rng.random_range(0..500 * MILLI);
        let sent_nanos = origin_nanos + age_nanos;
        let arrival_nanos = sent_nanos + rng.random_range(0..500 * MILLI);
        // The sender has the time of a ping that was sent before.
        let echo_nanos = if rng.random_bool(0.1) { 0 } else { sent_nanos - rng.random_range(0..300 * MILLI) };
        let passage = Passage { arrival_nanos, echo_nanos, sent_nanos: rng.random(), age_nanos: Some(age_nanos) };
        let estimate =
            Estimate { offset_nanos: rng.random(), uncertainty_nanos: rng.random(), round_trip_nanos: rng.random() };
        let estimate = rng.random_bool(0.9).then_some(estimate);
        let found_nanos = origin_on_arrival(&passage, estimate, DEADLINE_NANOS);
        assert!(found_nanos <= origin_nanos + DEADLINE_NANOS, "{passage:?} {estimate:?}");
        assert!(found_nanos <= arrival_nanos);
    }
}

#[test]
fn an_answer_has_the_origin_of_its_sample() {
    let key = |seq| SampleId { epoch: 1, seq };
    let mut origins = Origins::new(3);
    (0..5).for_each(|seq| origins.remember(key(seq), 100 + seq));
    let found: Vec<_> = (0..6).map(|seq| origins.origin_nanos(&key(seq))).collect();
    assert_eq!(found, [None, None, Some(102), Some(103), Some(104), None]);
    // The same key again takes no room, and the oldest time counts; a sample without an origin time is ignored.
    origins.remember(key(3), 90);
    origins.remember(key(3), 500);
    origins.remember(key(9), 0);
    assert_eq!([2, 3, 9].map(|seq| origins.origin_nanos(&key(seq))), [Some(102), Some(90), None]);
    assert_eq!(origins.origin_nanos(&SampleId { epoch: 2, seq: 3 }), None);
}

#[test]
fn an_answer_to_a_sample_that_was_not_sent_from_here_is_as_old_as_can_be() {
    let key = |seq| SampleId { epoch: 1, seq };
    let mut sent = Origins::new(3);
    (0..5).for_each(|seq| sent.remember(key(seq), 100 + seq));
    // Sample 1 was sent too long ago, sample 5 never. What the other machine says does not count.
    let origins = |sent: &Origins| [0, 1, 2, 4, 5].map(|seq| origin_of_answer(&key(seq), sent, || 999));
    assert_eq!(origins(&sent), [0, 0, 102, 104, 0]);
    // An earlier process of this link has sent sample 0.
    sent.begin_after(key(0));
    assert_eq!(origins(&sent), [999, 0, 102, 104, 0]);
    assert_eq!(origin_of_answer(&SampleId { epoch: 2, seq: 0 }, &sent, || 999), 0);
}
