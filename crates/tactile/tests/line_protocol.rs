//! The line protocol and the gate behind it: cases by hand, and random streams.

use blindgrasp_messages::{Phase, Sense};
use blindgrasp_tactile::gate::{FrameFilter, RESET_NANOS, Shape};
use blindgrasp_tactile::line_protocol::{LineSplitter, Piece, parse};
use blindgrasp_tactile::{Arrival, Place, Reading, RefusalKind};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const MS: u64 = 1_000_000;
const SHAPE: Shape = Shape { n_joints: 1, n_cells: 2 };

fn reading(phase: Phase) -> Reading {
    Reading { joints: vec![0.5], cells_newtons: vec![0.0, 1.0], phase, ..Reading::default() }
}

fn stamped(stamp_nanos: u64) -> Reading {
    Reading { stamp_nanos: Some(stamp_nanos), ..reading(Phase::Open) }
}

fn sent(seq: u64, stamp_nanos: u64) -> Reading {
    Reading { seq: Some(seq), ..stamped(stamp_nanos) }
}

fn of_grasp(grasp_id: u64) -> Reading {
    Reading { grasp_id: Some(grasp_id), ..reading(Phase::Open) }
}

fn gate() -> FrameFilter {
    let mut gate = FrameFilter::new(SHAPE, 100 * MS, 0, Place::default(), None);
    gate.began();
    gate
}

/// The gate of a process that takes over where another one stood.
fn after(gate: &FrameFilter) -> FrameFilter {
    let mut successor = FrameFilter::new(SHAPE, 100 * MS, 0, *gate.place(), Some(0));
    successor.began();
    successor
}

fn at(nanos: u64) -> Arrival {
    Arrival { at_nanos: nanos, waited_nanos: 0 }
}

/// The outgoing number and grasp of an accepted reading, or the reason for its refusal.
fn take(gate: &mut FrameFilter, reading: &Reading, arrival: Arrival) -> Result<(u64, u64), RefusalKind> {
    let taken = gate.take(reading, &arrival).map_err(|refusal| refusal.kind)?;
    // A frame of a grasp that is far from the last one waits for the next frame: here, for itself again.
    let passed = match taken {
        Some(passed) => passed,
        None => {
            let again = gate.take(reading, &arrival);
            let (_, released) = gate.released().ok_or(RefusalKind::OutOfOrder)?;
            again.ok().flatten().unwrap_or(released)
        }
    };
    Ok((passed.seq, passed.grasp_id))
}

#[test]
fn a_line_is_a_frame_or_is_refused_in_words() {
    let frame = parse(br#"{"joints":[0.5],"cells_newtons":[0,1.0],"phase":"open"}"#).expect("a frame");
    assert_eq!(frame, reading(Phase::Open));
    let all = br#"{"phase":"settled","stamp_nanos":3,"seq":2,"grasp_id":1,"joints":[],"cells_newtons":[]}"#;
    let frame = parse(all).expect("a frame");
    assert_eq!((frame.grasp_id, frame.seq, frame.stamp_nanos), (Some(1), Some(2), Some(3)));
    for (line, word) in [
        (&br#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"open","grasp":1}"#[..], "unknown field `grasp`"),
        (br#"{"joints":[0.5],"phase":"open"}"#, "missing field `cells_newtons`"),
        (br#"{"joints":[0.5],"cells_newtons":[Infinity,1],"phase":"open"}"#, "expected value"),
        (br#"{"joints":[0.5],"cells_newtons":[1e999,1],"phase":"open"}"#, "number out of range"),
        (br#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"close"}"#, "unknown variant `close`"),
        (br#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"open","seq":-1}"#, "seq"),
        (br#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"open"} x"#, "trailing characters"),
        (b"\xff\xfe", "not UTF-8"),
        (b"hello", "not a frame"),
        (b"[1]", "expected an object with joints, cells_newtons and phase"),
    ] {
        let refusal = parse(line).expect_err("refused");
        assert_eq!(refusal.kind, RefusalKind::Malformed);
        let is_named = refusal.why.contains(word) || word == "seq" && refusal.why.contains("invalid value");
        assert!(is_named, "expected '{word}' in '{}'", refusal.why);
    }
}

#[test]
fn a_line_with_a_checksum_is_refused_if_a_byte_changes() {
    let bare = r#"{"joints":[0.5],"cells_newtons":[0,1],"phase":"open","seq":12}"#;
    // By zlib's crc32.
    let line = format!("{},\"crc\":{}}}", bare.strip_suffix('}').expect("an object"), 1_429_317_490);
    assert_eq!(parse(line.as_bytes()).expect("a frame").seq, Some(12));
    for wrong in [line.replace("12,", "92,"), line.replace("\"crc\":1", "\"crc\":2"), line.replace("90}", "}")] {
        let refusal = parse(wrong.as_bytes()).expect_err("it has changed");
        assert!(refusal.why.contains("crc is") && refusal.kind == RefusalKind::Malformed, "{}", refusal.why);
    }
    let amid = line.replace("1429317490", "x").replace("seq", "crc");
    assert!(parse(amid.as_bytes()).expect_err("no number").why.contains("last key"));
}

#[test]
fn a_number_that_is_none_is_a_missing_one() {
    let line = r#"{"joints":[NaN],"cells_newtons":[0,NaN,null],"phase":"open","object":"a NaN"}"#;
    let found = parse(line.as_bytes()).expect("a frame");
    assert!(found.joints[0].is_nan() && found.cells_newtons[1].is_nan() && found.cells_newtons[2].is_nan());
    assert_eq!((found.cells_newtons[0], found.object.as_deref()), (0.0, Some("a NaN")));
    for wrong in ["Infinity", "nan"] {
        parse(line.replace("[NaN]", &format!("[{wrong}]")).as_bytes()).expect_err(wrong);
    }
}

#[test]
fn values_that_no_hand_has_are_refused() {
    for (joints, cells_newtons, word) in [
        (vec![], vec![0.0, 0.0], "joints has 0 numbers, the hand 1"),
        (vec![0.0], vec![0.0; 3], "cells_newtons has 3 numbers, the hand 2"),
        (vec![f64::NAN], vec![0.0; 2], "joints[0] is NaN"),
        (vec![0.0], vec![0.0, -0.1], "cells_newtons[1] is -0.1"),
        (vec![0.0], vec![f64::INFINITY, 0.0], "cells_newtons[0] is inf"),
    ] {
        let mut gate = gate();
        let refusal = gate.take(&Reading { joints, cells_newtons, ..Reading::default() }, &at(1)).expect_err("refused");
        assert!(refusal.why.contains(word), "expected '{word}' in '{}'", refusal.why);
        assert_eq!(gate.counts().malformed, 1);
        // The next one knows that something is missing before it.
        assert_eq!(take(&mut gate, &reading(Phase::Open), at(2)), Ok((1, 0)));
    }
}

#[test]
fn phases_separate_grasps_without_numbers() {
    use Phase::{Closing, Open, Settled};
    let mut gate = gate();
    let phases = [Open, Open, Closing, Settled, Open, Closing, Settled, Settled, Closing, Open, Settled];
    let grasps: Vec<u64> =
        phases.iter().map(|phase| take(&mut gate, &reading(*phase), at(1)).expect("in order").1).collect();
    assert_eq!(grasps, [0, 0, 0, 0, 1, 1, 1, 1, 2, 3, 3]);
    // After a lost connection it may be another grasp.
    gate.began();
    assert_eq!(take(&mut gate, &reading(Settled), at(1)), Ok((12, 4)));
}

#[test]
fn a_probe_belongs_to_its_grasp() {
    use Phase::{Closing, Ended, Open, Settled, Squeezed, Squeezing, TestLifted, TestLifting};
    let mut gate = gate();
    let probed = [Open, Closing, Settled, Squeezing, Squeezed, TestLifting, TestLifted, Ended];
    let grasps: Vec<u64> = (0..)
        .zip(probed.into_iter().chain([Settled, Squeezed, Closing]))
        .map(|(idx, phase)| take(&mut gate, &reading(phase), at(idx * 10 * MS)).expect("accepted").1)
        .collect();
    assert_eq!(grasps, [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 2]);
}

#[test]
fn other_senses_are_whole_and_in_all_frames_or_in_none() {
    let line = br#"{"joints":[0.5],"cells_newtons":[0,1.0],"phase":"open","gravity_m_per_s2":[0,0,-9.8],
        "wrist_wrench":[0,0,1,0,0,0.5],"joint_torques":[0.25]}"#;
    let felt = parse(line).expect("a frame");
    assert_eq!(Sense::ALL.map(|sense| felt.senses.get(sense).len()), [3, 6, 1]);
    let mut gate = gate();
    take(&mut gate, &felt, at(0)).expect("accepted");
    for (sense, values, said) in [
        (Sense::Gravity, &[0.0; 2][..], "gravity_m_per_s2 has 2 numbers: expected 3"),
        (Sense::WristWrench, &[f64::NAN; 6], "wrist_wrench[0] is NaN: expected a finite number"),
        (Sense::JointTorques, &[0.0; 2], "joint_torques has 2 numbers: expected 1"),
        (Sense::Gravity, &[], "gravity_m_per_s2 is missing"),
    ] {
        let changed = Reading { senses: felt.senses.clone().with(sense, values), ..felt.clone() };
        let refusal = gate.take(&changed, &at(10 * MS)).expect_err("refused");
        assert!(refusal.kind == RefusalKind::Malformed && refusal.why.contains(said), "{}", refusal.why);
    }
}

#[test]
fn a_source_that_begins_amid_a_grasp_does_not_begin_with_number_0() {
    for (phase, seq, first) in [
        (Phase::Open, None, 0),
        (Phase::Open, Some(7), 0),
        (Phase::Closing, None, 1),
        (Phase::Settled, Some(7), 1),
        (Phase::Settled, Some(0), 0),
    ] {
        assert_eq!(take(&mut gate(), &Reading { seq, ..reading(phase) }, at(1)), Ok((first, 0)));
    }
}

#[test]
fn the_senders_numbers_show_missed_and_reordered_frames() {
    let mut gate = gate();
    let numbered = |seq| Reading { seq: Some(seq), ..reading(Phase::Open) };
    assert_eq!(take(&mut gate, &numbered(5), at(1)), Ok((0, 0)));
    assert_eq!(take(&mut gate, &numbered(6), at(1)), Ok((1, 0)));
    assert_eq!(take(&mut gate, &numbered(9), at(1)), Ok((4, 0)));
    assert_eq!(gate.counts().missed, 2);
    for seq in [9, 8, 0, 1 << 60] {
        assert_eq!(take(&mut gate, &numbered(seq), at(1)), Err(RefusalKind::OutOfOrder), "{seq}");
    }
    assert_eq!(take(&mut gate, &numbered(10), at(1)), Ok((9, 0)));
    // A refused frame does not count as missed as well.
    gate.refused(RefusalKind::Malformed);
    assert_eq!(take(&mut gate, &numbered(12), at(1)), Ok((11, 0)));
    gate.refused(RefusalKind::Oversized);
    assert_eq!(take(&mut gate, &numbered(15), at(1)), Ok((14, 0)));
    assert_eq!((gate.counts().missed, gate.counts().out_of_order), (3, 4));
    // After a new connection it may count from anywhere.
    gate.began();
    assert_eq!(take(&mut gate, &numbered(0), at(1)), Ok((16, 1)));
    gate.began();
    assert_eq!(take(&mut gate, &numbered(3), at(1)), Ok((19, 2)));
    assert_eq!(gate.counts().missed, 5);
    // A sender that gives its numbers now and then has none.
    assert_eq!(take(&mut gate, &reading(Phase::Open), at(1)), Err(RefusalKind::Malformed));
}

#[test]
fn an_earlier_grasp_never_comes_again_and_one_far_ahead_is_refused() {
    let mut gate = self::gate();
    assert_eq!(take(&mut gate, &of_grasp(u64::MAX), at(1)), Err(RefusalKind::Malformed));
    assert_eq!(take(&mut gate, &of_grasp(7), at(1)), Ok((2, 7)));
    assert_eq!(take(&mut gate, &of_grasp(1 << 60), at(1)), Err(RefusalKind::OutOfOrder));
    assert_eq!(take(&mut gate, &of_grasp(8), at(1)), Ok((4, 8)));

    let mut gate = self::gate();
    assert_eq!(take(&mut gate, &of_grasp(7), at(1)), Ok((1, 7)));
    assert_eq!(take(&mut gate, &of_grasp(6), at(1)), Err(RefusalKind::OutOfOrder));
    gate.began();
    assert_eq!(take(&mut gate, &of_grasp(6), at(10 * RESET_NANOS)), Err(RefusalKind::OutOfOrder));
    let mut successor = after(&gate);
    assert_eq!(take(&mut successor, &of_grasp(6), at(1)), Err(RefusalKind::OutOfOrder));
    assert_eq!(take(&mut successor, &of_grasp(7), at(1)), Ok((2, 7)));
    // Without numbers of the sender's own, the successor goes on with a new one.
    let mut successor = after(&gate);
    assert_eq!(take(&mut successor, &reading(Phase::Settled), at(1)), Ok((2, 8)));
}

#[test]
fn a_frame_is_late_by_its_stamp_with_any_sender_clock() {
    // A clock of another epoch, and one that is ahead.
    for offset in [0, 1_700_000_000_000_000_000] {
        let mut gate = gate();
        let mut stamp = offset;
        for idx in 0..10 {
            stamp += 10 * MS;
            assert_eq!(take(&mut gate, &stamped(stamp), at(idx * 10 * MS + 50)), Ok((idx, 0)));
        }
        // 99 ms late is in time, 101 ms is not, and what follows in time is.
        assert_eq!(take(&mut gate, &stamped(stamp + 10 * MS), at(199 * MS)), Ok((10, 0)));
        assert_eq!(take(&mut gate, &stamped(stamp + 20 * MS), at(212 * MS)), Err(RefusalKind::Late));
        assert_eq!(take(&mut gate, &stamped(stamp + 130 * MS), at(220 * MS)), Ok((12, 0)));
        // A clock that goes 150 ppm slow for half an hour is no reason.
        let mut now = 220 * MS;
        for _ in 0..1800 {
            (stamp, now) = (stamp.max(offset + 230 * MS) + 999_850_000, now + 1_000_000_000);
            assert!(take(&mut gate, &stamped(stamp), at(now)).is_ok());
        }
        assert_eq!(gate.counts().late, 1);
    }
}

#[test]
fn frames_without_stamps_that_may_have_waited_are_late() {
    let mut gate = gate();
    let waited = |nanos| Arrival { at_nanos: 1000 * MS, waited_nanos: nanos };
    assert_eq!(take(&mut gate, &reading(Phase::Open), waited(100 * MS)), Ok((0, 0)));
    assert_eq!(take(&mut gate, &reading(Phase::Open), waited(101 * MS)), Err(RefusalKind::Late));
    // Also with a stamp, while there is nothing to compare it with.
    let mut gate = self::gate();
    let stamped = Reading { stamp_nanos: Some(5), ..reading(Phase::Open) };
    assert_eq!(take(&mut gate, &stamped, waited(101 * MS)), Err(RefusalKind::Late));
    assert_eq!(take(&mut gate, &stamped, waited(0)), Ok((1, 0)));
    // A late frame may be the first of a grasp.
    let mut gate = self::gate();
    assert_eq!(take(&mut gate, &reading(Phase::Settled), waited(0)), Ok((1, 0)));
    assert_eq!(take(&mut gate, &reading(Phase::Open), waited(101 * MS)), Err(RefusalKind::Late));
    assert_eq!(take(&mut gate, &reading(Phase::Settled), waited(0)), Ok((3, 1)));
}

#[test]
fn a_sender_that_restarts_its_count_is_accepted_after_a_while() {
    let mut gate = gate();
    for idx in 0..100 {
        assert!(take(&mut gate, &sent(1000 + idx, 900_000 * MS + idx * 10 * MS), at(idx * 10 * MS)).is_ok());
    }
    // Its controller was reset: number and clock begin at 0.
    let begin = 1000 * MS;
    let mut n_refused = 0;
    for idx in 0..300 {
        match take(&mut gate, &sent(idx, idx * 10 * MS), at(begin + idx * 10 * MS)) {
            Err(kind) => {
                assert_eq!(kind, RefusalKind::OutOfOrder);
                n_refused += 1;
            }
            Ok((seq, _)) => assert_eq!(seq, 100 + idx),
        }
    }
    assert_eq!(n_refused, RESET_NANOS / (10 * MS));
    assert_eq!((gate.counts().resets, gate.counts().frames), (1, 200));
    // A silence is no reset.
    assert!(take(&mut gate, &sent(300, 20_000 * MS), at(begin + 20_000 * MS)).is_ok());
    assert_eq!(gate.counts().resets, 1);
}

/// What lay in a buffer somewhere is as old as its stamps say, whatever was before it: a copied frame, a silence, a new
/// connection.
#[test]
fn a_backlog_is_never_accepted_as_fresh() {
    for stall_ms in [3_000, 11_000, 130_000] {
        for (is_copied, is_new_connection) in [(false, false), (true, false), (false, true), (true, true)] {
            let what = format!("{stall_ms} ms, copied {is_copied}, new connection {is_new_connection}");
            let mut gate = gate();
            for idx in 0..100 {
                assert!(take(&mut gate, &sent(idx, idx * 10 * MS), at(idx * 10 * MS)).is_ok());
            }
            if is_copied {
                assert_eq!(take(&mut gate, &sent(99, 990 * MS), at(995 * MS)), Err(RefusalKind::OutOfOrder));
            }
            if is_new_connection {
                gate.began();
            }
            // It comes at ten times the speed at which it was taken, until it has caught up.
            let (mut now_ms, mut n_late) = (990 + stall_ms, 0);
            for idx in 100.. {
                let stamp_ms = idx * 10;
                now_ms = (now_ms + 1).max(stamp_ms);
                let is_old = now_ms - stamp_ms > 101;
                let outcome = take(&mut gate, &sent(idx, stamp_ms * MS), at(now_ms * MS));
                // The clocks may have drifted apart by the 200 ppm that are allowed for.
                let is_about = now_ms - stamp_ms <= 101 + stall_ms / 1000;
                assert!(outcome.is_err() == is_old || is_about, "{what}: {outcome:?} at {now_ms}, stamp {stamp_ms}");
                n_late += u64::from(is_old);
                if now_ms == stamp_ms {
                    break;
                }
            }
            assert!(n_late > 100, "{what}");
            assert_eq!(gate.counts().resets, 0, "{what}");
        }
    }
}

#[test]
fn frames_kept_while_the_source_was_away_keep_their_age() {
    let mut gate = gate();
    assert_eq!(take(&mut gate, &stamped(500 * MS), at(1000 * MS)), Ok((0, 0)));
    let mut successor = after(&gate);
    assert_eq!(take(&mut successor, &stamped(600 * MS), at(3000 * MS)), Err(RefusalKind::Late));
    assert_eq!(take(&mut successor, &stamped(2510 * MS), at(3010 * MS)), Ok((3, 1)));
}

#[test]
fn a_new_connection_has_a_new_clock_only_if_it_is_far_off_and_steady() {
    let day = 86_400_000 * MS;
    let mut gate = gate();
    for idx in 0..100 {
        assert!(take(&mut gate, &stamped(day + idx * 10 * MS), at(idx * 10 * MS)).is_ok());
    }
    // The same clock, and a link that has become slow for good.
    gate.began();
    for idx in 0..1000 {
        let outcome = take(&mut gate, &stamped(day + (1000 + idx * 10) * MS), at((2500 + idx * 10) * MS));
        assert_eq!(outcome, Err(RefusalKind::Late), "{idx}");
    }
    // A bridge that was started anew, whose clock begins at 0.
    gate.began();
    let n_passed =
        (0..400).filter(|idx| take(&mut gate, &stamped(idx * 10 * MS), at((20_000 + idx * 10) * MS)).is_ok());
    assert_eq!(n_passed.count(), 200);
    assert_eq!(gate.counts().resets, 1);
}

/// A UART changes digits. One frame with a wrong number costs that frame, and the grasp that it is in, but no more.
#[test]
fn one_wrong_number_does_not_end_a_stream() {
    let frame = |idx: u64| Reading {
        grasp_id: Some(12 + idx / 20),
        seq: Some(idx),
        stamp_nanos: Some(1_000_000_000 + idx * 10 * MS),
        ..reading(Phase::Open)
    };
    let wrong: [fn(&mut Reading); 7] = [
        |frame| frame.grasp_id = Some(12 + (1 << 55)),
        |frame| frame.grasp_id = Some(92),
        |frame| frame.grasp_id = Some(2),
        |frame| frame.seq = frame.seq.map(|seq| seq + 1_000_000),
        |frame| frame.seq = frame.seq.map(|seq| seq / 2 + 500),
        |frame| frame.stamp_nanos = frame.stamp_nanos.map(|stamp| stamp + 900_000_000),
        |frame| frame.stamp_nanos = Some(7),
    ];
    for (case, make_wrong) in wrong.into_iter().enumerate() {
        for at_idx in [0, 1, 30] {
            let mut gate = gate();
            let mut seqs = Vec::new();
            for idx in 0..330 {
                let mut frame = frame(idx);
                if idx == at_idx {
                    make_wrong(&mut frame);
                }
                let taken = gate.take(&frame, &at(5_000_000_000 + idx * 10 * MS));
                let released = gate.released().map(|(_, accepted)| accepted);
                let accepted = released.into_iter().chain(taken.ok().flatten());
                // Right frames keep their grasp.
                seqs.extend(
                    accepted.inspect(|it| assert!(it.grasp_id == 12 + idx / 20 || idx <= at_idx + 1)).map(|it| it.seq),
                );
            }
            assert!(seqs.is_sorted_by(|one, next| one < next), "case {case} at {at_idx}: {:?}", &seqs[..5]);
            let n_gaps = seqs.windows(2).filter(|pair| pair[1] > pair[0] + 1).count();
            // The stamp of the very first frame has no other one beside it: a new clock is believed after 2 s.
            let n_least = if at_idx == 0 && case >= 5 { 120 } else { 327 };
            assert!(seqs.len() >= n_least, "case {case} at {at_idx}: {} of 330 frames accepted", seqs.len());
            assert!(gate.counts().missed < 10, "case {case} at {at_idx}: {:?}", gate.counts());
            assert!(n_gaps >= 1 || seqs[0] > 0 || at_idx == 0, "case {case} at {at_idx}: no gap");
        }
    }
}

#[test]
fn a_bridge_that_numbers_grasps_by_its_clock_loses_no_frame() {
    let mut gate = gate();
    let mut seqs = Vec::new();
    for idx in 0..100 {
        let frame = Reading { grasp_id: Some((idx / 10) << 40), seq: Some(idx), ..reading(Phase::Open) };
        let taken = gate.take(&frame, &at(idx * MS)).expect("in order");
        seqs.extend(
            gate.released().map(|(_, accepted)| accepted).into_iter().chain(taken).map(|accepted| accepted.seq),
        );
    }
    assert_eq!(seqs, (0..100).collect::<Vec<_>>());
}

/// Whatever bytes come, in whatever portions: each line is there once, as it would be had it been cut at leisure.
#[test]
fn random_bytes_are_cut_into_lines_and_each_is_accounted_for() {
    const MAX: usize = 64;
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let (mut n_lines, mut n_long, mut n_frames) = (0, 0, 0);
    for _ in 0..2000 {
        let good = br#"{"joints":[0],"cells_newtons":[1,2],"phase":"open"}"#;
        let mut bytes = Vec::new();
        for _ in 0..rng.random_range(0..20) {
            match rng.random_range(0..6) {
                0 => bytes.extend_from_slice(good),
                1 => bytes.extend((0..rng.random_range(0..3 * MAX)).map(|_| rng.random_range(0..=255_u8))),
                2 => bytes.extend(std::iter::repeat_n(b'x', rng.random_range(MAX - 2..MAX + 3))),
                3 => bytes.push(b'\r'),
                _ => {}
            }
            if rng.random_bool(0.8) {
                bytes.push(b'\n');
            }
        }
        let mut expected: Vec<Option<Vec<u8>>> = Vec::new();
        let mut lines: Vec<&[u8]> = bytes.split(|byte| *byte == b'\n').collect();
        let rest = lines.pop().expect("at least one");
        for line in lines {
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            if !line.is_empty() {
                expected.push((line.len() <= MAX).then(|| line.to_vec()));
            }
        }
        if rest.len() > MAX + 1 {
            expected.push(None);
        }
        let mut splitter = LineSplitter::new(MAX);
        let mut gate = FrameFilter::new(SHAPE, 100 * MS, 0, Place::default(), None);
        gate.began();
        let mut found = Vec::new();
        let mut left = &bytes[..];
        while !left.is_empty() {
            let space = splitter.space();
            let n = rng.random_range(1..=left.len().min(200)).min(space.len());
            space[..n].copy_from_slice(&left[..n]);
            splitter.filled(n, 0);
            left = &left[n..];
            while let Some(piece) = splitter.next_piece() {
                match piece {
                    Piece::TooLong => {
                        gate.refused(RefusalKind::Oversized);
                        found.push(None);
                    }
                    Piece::Line(line, _) => {
                        match parse(line) {
                            Ok(reading) => n_frames += u32::from(gate.take(&reading, &at(1)).is_ok()),
                            Err(refusal) => gate.refused(refusal.kind),
                        }
                        found.push(Some(line.to_vec()));
                    }
                }
            }
        }
        assert_eq!(found, expected);
        assert_eq!(splitter.is_amid_a_line(), !rest.is_empty() && rest.len() <= MAX + 1);
        let counts = gate.counts();
        assert_eq!(counts.frames + counts.malformed + counts.oversized, expected.len() as u64);
        n_lines += expected.len();
        n_long += expected.iter().filter(|line| line.is_none()).count();
    }
    assert!(n_lines > 5000 && n_long > 1000 && n_frames > 1000, "{n_lines} {n_long} {n_frames}");
}

/// Whatever a sender does: the outgoing numbers grow, grasps never come again, two frames have numbers that follow one
/// another only if the sender sent them so with nothing in between, and everything is counted.
#[test]
fn every_fault_leaves_a_gap() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let (mut n_frames, mut n_gaps) = (0, 0);
    for round in 0..500 {
        let (has_seq, has_stamp, has_grasp) = (rng.random_bool(0.7), rng.random_bool(0.5), rng.random_bool(0.5));
        let mut gate = gate();
        let (mut now, mut sent, mut grasp_id) = (1, 0_u64, 0);
        // The sender's number of the last frame that passed, its outgoing number, its grasp.
        let mut last: Option<(u64, u64, u64)> = None;
        let mut waiting_number = None;
        let mut is_whole = true;
        let mut n_given = 0;
        for _ in 0..200 {
            now += 10 * MS;
            let mut number = sent;
            sent += 1;
            match rng.random_range(0..30) {
                0 => {
                    gate.refused([RefusalKind::Malformed, RefusalKind::Oversized][rng.random_range(0..2)]);
                    (is_whole, n_given) = (false, n_given + 1);
                    continue;
                }
                // Lost on the way: without numbers nobody can know.
                1 if has_seq => continue,
                2 if has_seq => (number, sent) = (number.saturating_sub(rng.random_range(1..5)), sent - 1),
                3 => {
                    gate.began();
                    is_whole = false;
                }
                4 => grasp_id += 1,
                _ => {}
            }
            let reading = Reading {
                seq: has_seq.then_some(number),
                stamp_nanos: has_stamp.then_some(now),
                grasp_id: has_grasp.then(|| if rng.random_bool(0.01) { 0 } else { grasp_id }),
                ..reading([Phase::Open, Phase::Closing, Phase::Settled][rng.random_range(0..3)])
            };
            let waited_nanos = if rng.random_bool(0.02) { 200 * MS } else { 0 };
            let at_nanos = now + waited_nanos;
            n_given += 1;
            let taken = gate.take(&reading, &Arrival { at_nanos, waited_nanos });
            let released = gate.released().map(|(_, accepted)| accepted);
            let waited = waiting_number.take().zip(Some(released));
            if taken == Ok(None) {
                waiting_number = Some(number);
            }
            let now_taken = match taken {
                Ok(accepted) => accepted.map(|accepted| (number, Some(accepted))),
                Err(_) => Some((number, None)),
            };
            for (number, accepted) in waited.into_iter().chain(now_taken) {
                match accepted.map(|accepted| (accepted.seq, accepted.grasp_id)) {
                    Some((seq, grasp)) => {
                        if let Some((last_number, last_seq, last_grasp)) = last {
                            is_whole &= !has_seq || number == last_number + 1;
                            assert!(seq > last_seq && grasp >= last_grasp, "round {round}");
                            assert_eq!(seq == last_seq + 1, is_whole, "round {round}: {seq} after {last_seq}");
                            n_gaps += u32::from(!is_whole);
                        }
                        last = Some((number, seq, grasp));
                        is_whole = true;
                        n_frames += 1;
                    }
                    None => is_whole = false,
                }
            }
            now = at_nanos;
        }
        let counts = gate.counts();
        let n_refused = counts.malformed + counts.oversized + counts.late + counts.out_of_order + counts.cut_off;
        assert_eq!(counts.frames + n_refused, n_given, "round {round}: {counts:?}");
    }
    assert!(n_frames > 50_000 && n_gaps > 5000, "{n_frames} {n_gaps}");
}
