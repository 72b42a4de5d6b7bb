//! The report of trials as a page.
//!
//! Its pictures are simulated again: an attempt is a function of seed, trial and attempt alone.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use serde::Serialize;

use super::tables::{Table, TrialsReport, tables};
use super::tally::TrialRecord;
use blindgrasp_mesh::Mesh;
use blindgrasp_pictures::{DrawnFrames, PictureError, PosedScene, ReportKind, report_html};
use blindgrasp_simulator::trial::{
    Attempt, LiftTarget, ProbeMove, Snapshot, TrialError, TrialOptions, choose_start, sensor_seed,
};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::Hand;

/// Moments of a lift that are drawn: from when it begins to its end.
const N_MOMENTS: usize = 4;
/// A target that has gone so far in the hand has left it.
const DROPPED_M: f64 = 0.09;

/// A lift, or a grasp that was not lifted, as a strip of pictures. The page draws them.
#[derive(Debug, Clone)]
pub struct Strip {
    caption: String,
    thing: Mesh,
    moments: Vec<PosedScene>,
}

#[derive(Serialize)]
struct ShownStrip<'a> {
    caption: &'a str,
    n_moments: usize,
}

/// The data of the page.
#[derive(Serialize)]
struct TrialsPage<'a> {
    lead: String,
    tables: Vec<Table>,
    strips: Vec<ShownStrip<'a>>,
    /// How this was made: names and values.
    made: [(&'static str, &'a str); 6],
}

/// The page, with strips of the hand, if there are any.
///
/// # Errors
/// Joints that are not this hand's, or data that cannot be written as JSON.
pub fn trials_page(hand: Option<&Hand>, report: &TrialsReport, strips: &[Strip]) -> Result<String, PictureError> {
    let TrialsReport { n_trials, max_attempts, seed, .. } = report;
    let trials = format!("{n_trials}, {max_attempts} attempts each at most, seed {seed}");
    let page = TrialsPage {
        lead: lead(report),
        tables: tables(report),
        strips: strips.iter().map(|it| ShownStrip { caption: &it.caption, n_moments: it.moments.len() }).collect(),
        made: [
            ("command", &report.command),
            ("objects", &report.objects),
            ("model", &report.model),
            ("trials", &trials),
            ("intervals", "95 %, Wilson's; lifts count as independent"),
            ("assumed", "the objects' sizes and their friction; the paper's masses"),
        ],
    };
    let (Some(hand), [_, ..]) = (hand, strips) else { return report_html(ReportKind::Trials, &page, None) };
    let stand_radius_m = report.options.physics.stand_radius_m.min(DRAWN_STAND_M);
    let scenes: Vec<_> = strips.iter().map(|strip| (&strip.thing, &strip.moments[..])).collect();
    report_html(ReportKind::Trials, &page, Some(&DrawnFrames::of_scenes(hand, stand_radius_m, &scenes)?))
}

/// Of each group, with the gate (or without, if there was none), the first grasp that held, the first that was dropped
/// and the first that was held back.
pub fn telling_records(report: &TrialsReport) -> Vec<&TrialRecord> {
    let records =
        if report.records_with_gate.is_empty() { &report.records_without_gate } else { &report.records_with_gate };
    let mut seen: Vec<(&str, bool, bool)> = Vec::new();
    let mut telling: Vec<&TrialRecord> = Vec::new();
    // What a watched hand did while it lifted is not made again.
    for record in records.iter().filter(|record| !record.tightened && !record.set_down) {
        let kind = (record.group.as_str(), record.lifted, record.held);
        if !seen.contains(&kind) {
            seen.push(kind);
            telling.push(record);
        }
    }
    telling.sort_by(|a, b| (&a.group, !a.held, !a.lifted).cmp(&(&b.group, !b.held, !b.lifted)));
    telling
}

/// Of a wide table, the part that is drawn: the hand should fill the picture.
const DRAWN_STAND_M: f64 = 0.08;

/// How attempts were made.
#[derive(Debug, Clone, Copy)]
pub struct Made<'a> {
    pub options: &'a TrialOptions,
    /// It chose among approaches.
    pub prior: Option<&'a ApproachPrior>,
    /// The probe of attempts that had one.
    pub probe: Option<ProbeMove>,
}

/// Simulates an attempt again, for pictures of its lift, or of the settled grasp if it was not lifted.
///
/// # Errors
/// It cannot be simulated.
pub fn strip(
    hand: &Hand,
    target: &LiftTarget,
    made: Made<'_>,
    seed: u64,
    record: &TrialRecord,
) -> Result<Strip, TrialError> {
    let Made { options, prior, probe } = made;
    let start = choose_start(hand, target, options, prior, seed, record.trial, record.attempt)?;
    let mut attempt = Attempt::begin(hand, target, options, &start, sensor_seed(seed, record.trial, record.attempt))?;
    while attempt.next_frame(record.grasp_id).is_some() {}
    let mut snapshots = vec![attempt.snapshot()];
    // A lift after a test lift had both probes. Of an attempt that was not lifted, only the squeeze is known.
    let probes: &[ProbeMove] = match probe {
        Some(ProbeMove::TestLift) if record.probed && record.lifted => &[ProbeMove::Squeeze, ProbeMove::TestLift],
        Some(_) if record.probed => &[ProbeMove::Squeeze],
        _ => &[],
    };
    for probe in probes {
        attempt.probe(*probe);
        attempt.skip_frame();
        while attempt.next_frame(record.grasp_id).is_some() {}
        snapshots.push(attempt.snapshot());
    }
    if record.lifted {
        attempt.lift(|snapshot| snapshots.push(snapshot.clone()));
    }
    let moments =
        if record.lifted && !record.held { moments_of_a_drop(&snapshots) } else { moments_of_a_lift(&snapshots) };
    let moments = moments.into_iter().map(scene).collect();
    Ok(Strip { caption: caption(record), thing: target.object.to_mesh(), moments })
}

/// Closer together at the beginning, where the target rises; later it is still.
fn moments_of_a_lift(snapshots: &[Snapshot]) -> Vec<&Snapshot> {
    let n_moments = N_MOMENTS.min(snapshots.len());
    let last = snapshots.len() - 1;
    let share = |moment: usize| (moment as f64 / (n_moments - 1).max(1) as f64).powi(2);
    (0..n_moments).map(|moment| &snapshots[(share(moment) * last as f64).round() as usize]).collect()
}

/// From the grasp until the target has left the hand, at equal steps of its way in the hand.
fn moments_of_a_drop(snapshots: &[Snapshot]) -> Vec<&Snapshot> {
    let in_palm = |snapshot: &Snapshot| {
        let scene = scene(snapshot);
        scene.world_from_palm.inverse_transform_point(&scene.world_from_thing.translation.vector.into())
    };
    let first = in_palm(&snapshots[0]);
    let way = |snapshot: &&Snapshot| (in_palm(snapshot) - first).norm();
    let most = snapshots.iter().map(|snapshot| way(&snapshot)).fold(0.0, f64::max).min(DROPPED_M);
    let goals = (0..N_MOMENTS).map(|moment| most * moment as f64 / (N_MOMENTS - 1) as f64);
    let mut moments: Vec<&Snapshot> =
        goals.filter_map(|goal| snapshots.iter().find(|snapshot| way(snapshot) >= goal)).collect();
    moments.dedup_by_key(|snapshot| snapshot.elapsed_nanos);
    moments
}

fn caption(record: &TrialRecord) -> String {
    let what = match (record.lifted, record.held) {
        (true, true) => format!(
            "lifted and kept; it slipped {:.1} mm and turned {:.1}° in the hand",
            1000.0 * record.slip_m,
            record.turn_rad.to_degrees()
        ),
        (true, false) => "lifted and dropped".into(),
        (false, _) => "held".into(),
    };
    let epsilon = record.epsilon.map_or(String::new(), |epsilon| format!("; epsilon {epsilon:.3}"));
    format!("{}: {what} (trial {}, attempt {}{epsilon})", record.thing, record.trial, record.attempt)
}

fn scene(snapshot: &Snapshot) -> PosedScene {
    let pose = |position_m: [f64; 3], xyzw: [f64; 4]| {
        Isometry3::from_parts(position_m.into(), UnitQuaternion::from_quaternion(Quaternion::from(xyzw)))
    };
    PosedScene {
        secs: snapshot.elapsed_nanos as f64 / 1e9,
        world_from_palm: pose(snapshot.palm_position_m, snapshot.palm_rotation_xyzw),
        joints: snapshot.joints.clone(),
        world_from_thing: pose(snapshot.target_position_m, snapshot.target_rotation_xyzw),
    }
}

/// The result in one paragraph.
fn lead(report: &TrialsReport) -> String {
    let mut parts = report.in_four_numbers();
    if let Some(effect) = &report.effect {
        parts.push(format!("Of {} drops, {} were avoided.", effect.n_dropped_without, effect.n_avoided));
    }
    parts.extend(report.late.and_then(|late| late.advice()).map(|advice| format!("{advice}.")));
    if report.end != "finished" {
        parts.push(format!("The run was {} before all {} trials were done.", report.end, report.n_trials));
    }
    parts.join(" ")
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::tables::tests::both;
    use super::*;
    use blindgrasp_simulator::trial::targets::targets_named;

    #[test]
    fn the_page_holds_the_tables_and_the_strips_and_asks_for_nothing() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
        let targets = targets_named("paper").expect("things");
        let report = both();
        let telling = telling_records(&report);
        let kinds: Vec<_> = telling.iter().map(|record| (record.group.as_str(), record.lifted, record.held)).collect();
        assert_eq!(
            kinds,
            [
                ("canteen", true, false),
                ("canteen", false, false),
                ("mug", true, true),
                ("mug", false, false),
                ("rock", false, false)
            ]
        );
        let strips: Vec<Strip> = telling
            .iter()
            .map(|record| {
                let target = targets.iter().find(|target| target.object.name == record.thing).expect("a thing");
                let made = Made { options: &TrialOptions::default(), prior: None, probe: None };
                strip(&hand, target, made, 1, record).expect("a strip")
            })
            .collect();
        let page = trials_page(Some(&hand), &report, &strips).expect("a page");
        for expected in [
            "with the gate: 4 reached the object, 3 lifted it, 2 kept it, in 8 attempts.",
            "Of 2 drops, 2 were avoided.",
            "\"2 of 2, 100 % (34-100)\"",
            "Table IV: the mug by mass",
            "decorative rock: held (trial 3, attempt 0; epsilon -0.100)",
            "models/\\u003cany>.json",
            "\"title\":\"After ",
        ] {
            assert!(page.contains(expected), "no '{expected}'");
        }
        assert!(!page.contains("https:") && page.matches("<script").count() == 4);
        assert!(page.len() < 3_000_000, "{}", page.len());
    }
}
