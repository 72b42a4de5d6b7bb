//! Learns which grasps are like the training grasps: the limits of
//! [`blindgrasp_stages::out_of_distribution::TrainingRange`].

use std::collections::BTreeSet;

use blindgrasp_stages::encoder::{FeatureExtractor, FeltReading};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::out_of_distribution::{
    Limits, Quantity, TrainingRange, for_each_quantity, n_of_posture, quantities,
};

/// Share of the grasps of new objects that the margin flags. A flagged grasp is held. That costs one lift in 200, which
/// is little beside the errors of a classifier.
pub const FALSE_ALARM_SHARE: f64 = 0.005;

/// Learns limits from grasps: the range of each quantity, its resolution, and the least margin with which at most the share
/// [`FALSE_ALARM_SHARE`] of a fold's grasps is outside the limits of all other folds. The last value seen is no limit: it is
/// that of one sensor, and another one may read beyond. All grasps of an object should be in one fold. Grasps
/// without a feature are ignored.
pub fn learn_training_range(
    hand: &Hand,
    features: &FeatureExtractor,
    grasps: &[FeltReading<'_>],
    folds: &[usize],
) -> TrainingRange {
    let quantities = quantities(hand);
    let mut values = Vec::new();
    let mut rows: Vec<(usize, Vec<f64>)> = Vec::new();
    for (reading, fold) in grasps.iter().zip(folds) {
        let FeltReading { joints, contacts, .. } = *reading;
        if features.extract(reading, &mut values).is_ok() {
            let mut row = Vec::with_capacity(quantities.len());
            for_each_quantity(features, joints, contacts, |quantity| row.push(quantity));
            rows.push((*fold, row));
        }
    }
    let all = ranges(rows.iter().map(|row| &row.1), quantities.len());
    let rooms: Vec<f64> = quantities
        .iter()
        .zip(&all)
        .map(|(quantity, (lower, upper))| quantity.resolution.max(quantity.gain_resolution * (upper - lower)))
        .collect();
    // A quantity that hardly varied is not measured in units of its noise.
    let units: Vec<f64> = rooms.iter().enumerate().map(|(idx, room)| deviation(&rows, idx).max(*room)).collect();
    let fold_names: BTreeSet<usize> = rows.iter().map(|(fold, _)| *fold).collect();
    let mut excesses: Vec<f64> = Vec::new();
    for fold in fold_names {
        let ranges = ranges(rows.iter().filter(|row| row.0 != fold).map(|row| &row.1), quantities.len());
        let excess = |row: &Vec<f64>| {
            let beyond = |idx: usize| (ranges[idx].0 - row[idx]).max(row[idx] - ranges[idx].1);
            (0..row.len()).map(|idx| (beyond(idx) - rooms[idx]) / units[idx]).fold(0.0, f64::max)
        };
        excesses.extend(rows.iter().filter(|row| row.0 == fold).map(|row| excess(&row.1)));
    }
    excesses.sort_by(f64::total_cmp);
    let n_flagged = (FALSE_ALARM_SHARE * excesses.len() as f64) as usize;
    let margin = excesses.len().checked_sub(n_flagged + 1).map_or(0.0, |idx| excesses[idx]);
    let share_flagged =
        excesses.iter().filter(|excess| **excess > margin).count() as f64 / excesses.len().max(1) as f64;
    let limits = |(idx, quantity): (usize, Quantity)| {
        let (room, possible) = (rooms[idx] + margin * units[idx], quantity.possible);
        Limits {
            quantity: quantity.name,
            lower: (all[idx].0 - room).max(*possible.start()),
            upper: (all[idx].1 + room).min(*possible.end()),
        }
    };
    let limits = quantities.into_iter().enumerate().map(limits).collect();
    TrainingRange { limits, share_flagged }
}

/// The same limits for postures, and wider ones for cells, by the range on both sides: the cells of another day may read
/// more or less, and are judged relative to that day (see [`blindgrasp_stages::day`]).
#[must_use]
pub fn widened_for_other_days(mut range: TrainingRange, features: &FeatureExtractor) -> TrainingRange {
    for limits in range.limits.iter_mut().skip(n_of_posture(features)) {
        let width = limits.upper - limits.lower;
        (limits.lower, limits.upper) = (limits.lower - width, limits.upper + width);
    }
    range
}

/// Least and greatest value of each quantity.
fn ranges<'a>(rows: impl Iterator<Item = &'a Vec<f64>>, n_quantities: usize) -> Vec<(f64, f64)> {
    let mut ranges: Option<Vec<(f64, f64)>> = None;
    for row in rows {
        let ranges = ranges.get_or_insert_with(|| row.iter().map(|value| (*value, *value)).collect());
        for ((lower, upper), value) in ranges.iter_mut().zip(row) {
            (*lower, *upper) = (lower.min(*value), upper.max(*value));
        }
    }
    ranges.unwrap_or_else(|| vec![(0.0, 0.0); n_quantities])
}

fn deviation(rows: &[(usize, Vec<f64>)], idx: usize) -> f64 {
    let mean = |of: &dyn Fn(f64) -> f64| rows.iter().map(|row| of(row.1[idx])).sum::<f64>() / rows.len().max(1) as f64;
    let centre = mean(&|value| value);
    mean(&|value| (value - centre).powi(2)).sqrt()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_messages::{Contact, Fault};
    use blindgrasp_stages::contacts::clip_to_limits;
    use blindgrasp_stages::dictionary::Dictionary;
    use blindgrasp_stages::encoder::Block;

    /// A contact of the Barrett hand's pad 1, in the palm frame at x.
    fn contact(cell: u32, x_m: f64, force_newtons: f64) -> Contact {
        Contact { position_m: [x_m, 0.0, 0.0], normal: [0.0, 0.0, 1.0], force_newtons, pad: 1, cell }
    }

    fn barrett() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    fn extractor() -> FeatureExtractor {
        let hand = barrett();
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [0.04, 0.0, 0.0]] };
        FeatureExtractor::new(&hand, &[Block::Histogram], dictionary, 0.02)
    }

    /// A posture whose first finger has closed by `angle_rad`, its distal joint `breakaway_rad` further.
    fn posture(angle_rad: f64, breakaway_rad: f64) -> [f64; 7] {
        [0.0, angle_rad, 1.0, 1.0, 45.0 / 140.0 * angle_rad + breakaway_rad, 0.4, 0.4]
    }

    /// Grasps of 100 objects, two each.
    fn grasps() -> Vec<([f64; 7], Vec<Contact>)> {
        (0..200)
            .map(|idx| {
                let share = f64::from(idx) / 199.0;
                (posture(0.5 + share, 0.3 * share), vec![contact(0, 0.01 * share, 1.0 + share), contact(3, 0.0, 1.0)])
            })
            .collect()
    }

    fn range(features: &FeatureExtractor, grasps: &[([f64; 7], Vec<Contact>)]) -> TrainingRange {
        let views: Vec<FeltReading<'_>> =
            grasps.iter().map(|(joints, contacts)| FeltReading::new(joints, contacts)).collect();
        let folds: Vec<usize> = (0..grasps.len()).map(|idx| idx / 2 % 5).collect();
        learn_training_range(&barrett(), features, &views, &folds)
    }

    #[test]
    fn a_joint_at_its_stop_passes_whatever_the_zero_of_its_encoder() {
        let (features, hand) = (extractor(), barrett());
        let (stop_rad, contacts) = (hand.joints[4].upper, vec![contact(0, 0.005, 1.5), contact(3, 0.0, 1.0)]);
        // The last count of an encoder with 4096 counts a turn is 0.2 mrad before the stop.
        let last_count_rad = 546.0 * std::f64::consts::TAU / 4096.0;
        assert!(last_count_rad < stop_rad);
        let distal = |angle_rad: f64| [0.0, 1.4, 1.0, 1.0, angle_rad, 0.4, 0.4];
        let grasps = |idx: usize| (distal(last_count_rad - 0.3 * (idx as f64 / 199.0)), contacts.clone());
        let range = range(&features, &(0..200).map(grasps).collect::<Vec<_>>());
        assert_eq!(range.limits[4].upper, stop_rad);
        for zero_rad in [-0.01, 0.0, 0.01] {
            let mut joints = distal(stop_rad).map(|angle| angle + zero_rad);
            clip_to_limits(&hand, &mut joints);
            assert_eq!(range.check(&features, &joints, &contacts), Ok(()), "{zero_rad} rad");
        }
        for far in [[0.2, 1.4, 1.0, 1.0, 0.8, 0.4, 0.4], distal(0.3), [0.0, 1.4, 1.0, 1.6, 0.8, 0.4, 0.4]] {
            assert_eq!(range.check(&features, &far, &contacts), Err(Fault::OutOfDistribution), "{far:?}");
        }
    }

    #[test]
    fn what_was_trained_on_passes_and_strangers_are_named() {
        let features = extractor();
        let range = range(&features, &grasps());
        assert_eq!(range.validate(&features), Ok(()));
        assert!(range.share_flagged <= FALSE_ALARM_SHARE);
        for (joints, contacts) in grasps() {
            assert_eq!(range.check(&features, &joints, &contacts), Ok(()));
        }
        let usual = || vec![contact(0, 0.005, 1.5), contact(3, 0.0, 1.0)];
        let stuck = vec![contact(0, 0.005, 1.5), contact(3, 0.0, 15.0)];
        let far = vec![contact(0, 0.1, 1.5), contact(3, 0.0, 1.0)];
        for (joints, contacts, named) in [
            (posture(2.4, 0.1), usual(), "position of joint finger_1,"),
            (posture(1.0, 0.1), stuck, "greatest force on a cell of pad finger_1,"),
            (posture(1.0, 0.1), far, "greatest distance"),
            (posture(1.0, 0.1), vec![Contact { pad: 2, ..contact(0, 0.005, 1.5) }], "load of pad finger_2,"),
        ] {
            assert_eq!(range.check(&features, &joints, &contacts), Err(Fault::OutOfDistribution));
            let violations = range.violations(&features, &joints, &contacts);
            assert!(
                violations.iter().any(|violation| violation.limits.quantity.contains(named)),
                "{named}: {violations:?}"
            );
        }
    }

    #[test]
    fn the_hand_bounds_contacts_and_breakaways_and_a_load_may_be_doubled() {
        let features = extractor();
        let mut range = range(&features, &grasps());
        let limits = |range: &TrainingRange, quantity: &str| {
            let is_of = |limits: &&Limits| limits.quantity.starts_with(quantity);
            let limits = range.limits.iter().find(is_of).expect("a limit");
            (limits.lower, limits.upper)
        };
        assert_eq!(limits(&range, "contacts of pad finger_1"), (0.0, 24.0));
        let joints = barrett().joints;
        let expected = (-45.0 / 140.0 * joints[1].upper, joints[4].upper);
        assert_eq!(limits(&range, "breakaway of joint distal_1,"), expected);
        // A file of an older version has the last values seen.
        for limits in &mut range.limits {
            if limits.quantity.starts_with("contacts of ") || limits.quantity.starts_with("breakaway of ") {
                (limits.lower, limits.upper) = (0.0, 0.0);
            }
        }
        let (_, most_newtons) = limits(&range, "load of pad finger_1,");
        // The training had two contacts in each grasp: more of them bear more, and none more than one of these did.
        let pressed = |n: usize| {
            let cells = [0, 3].into_iter().cycle().take(n);
            cells.map(|cell| contact(cell, 0.005, 0.45 * most_newtons)).collect::<Vec<_>>()
        };
        assert_eq!(range.check(&features, &posture(1.0, -0.2), &pressed(4)), Ok(()));
        let violations = range.violations(&features, &posture(1.0, -0.2), &pressed(5));
        assert_eq!(violations.len(), 1, "{violations:?}");
        assert!(violations[0].to_string().starts_with("load of pad finger_1, newtons: "), "{violations:?}");
    }

    #[test]
    fn order_of_contacts_does_not_matter_and_a_range_fits_its_features() {
        let features = extractor();
        let range = range(&features, &grasps());
        let contacts = [contact(0, 0.005, 1.5), contact(3, 0.0, 1.0)];
        let reversed = [contacts[1], contacts[0]];
        for joints in [posture(1.0, 0.1), posture(2.4, 0.1)] {
            assert_eq!(range.check(&features, &joints, &contacts), range.check(&features, &joints, &reversed));
        }
        let cut_off = TrainingRange { limits: range.limits[1..].to_vec(), ..range.clone() };
        assert!(cut_off.validate(&features).is_err());
        assert_eq!(cut_off.check(&features, &posture(1.0, 0.1), &contacts), Err(Fault::OutOfDistribution));
        let mut damaged = range;
        damaged.limits[0].upper = f64::NAN;
        assert!(damaged.validate(&features).is_err());
    }

    #[test]
    fn nothing_to_learn_from_lets_nothing_pass() {
        let features = extractor();
        let range = learn_training_range(&barrett(), &features, &[], &[]);
        assert_eq!(range.validate(&features), Ok(()));
        let outcome = range.check(&features, &posture(1.0, 0.1), &[contact(0, 0.0, 1.0)]);
        assert_eq!(outcome, Err(Fault::OutOfDistribution));
    }
}
