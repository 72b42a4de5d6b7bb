//! The phase of a grasp, inferred from the fingers' motion, for robots that do not say it.

use blindgrasp_messages::Phase;

/// Speeds are measured over this time: joint angles are noisy from one reading to the next.
const WINDOW_NANOS: u64 = 50_000_000;

/// Finds the phase from joint angles. The hand is open until its fingers close, settled once they have stood still, and open
/// again, for the next grasp, as soon as they go back.
#[derive(Debug, Clone)]
pub(crate) struct PhaseFinder {
    /// Fingers that move more slowly stand still.
    moving_rad_per_s: f64,
    still_nanos: u64,
    phase: Phase,
    /// The posture at the start of the window.
    anchor: Option<(u64, Vec<f64>)>,
    still_since_nanos: Option<u64>,
}

impl PhaseFinder {
    pub(crate) fn new(moving_rad_per_s: f64, still_nanos: u64) -> Self {
        PhaseFinder { moving_rad_per_s, still_nanos, phase: Phase::Open, anchor: None, still_since_nanos: None }
    }

    /// The phase at a posture of the fingers: for each, how far it has closed, radians, from anywhere on.
    pub(crate) fn phase(&mut self, stamp_nanos: u64, fingers_rad: &[f64]) -> Phase {
        let Some((since_nanos, before)) = &self.anchor else {
            self.anchor = Some((stamp_nanos, fingers_rad.to_vec()));
            return self.phase;
        };
        let Some(nanos) = stamp_nanos.checked_sub(*since_nanos) else {
            // The clock has jumped back.
            self.anchor = Some((stamp_nanos, fingers_rad.to_vec()));
            self.still_since_nanos = None;
            return self.phase;
        };
        if nanos < WINDOW_NANOS {
            return self.phase;
        }
        let secs = nanos as f64 / 1e9;
        let speeds = fingers_rad.iter().zip(before).map(|(now, before)| (now - before) / secs);
        let is_moving = speeds.clone().any(|speed| speed.abs() > self.moving_rad_per_s);
        let is_closing = speeds.sum::<f64>() > 0.0;
        if is_moving {
            self.still_since_nanos = None;
            self.phase = match (self.phase, is_closing) {
                (Phase::Open, true) => Phase::Closing,
                (phase, true) => phase,
                (_, false) => Phase::Open,
            };
        } else {
            let since_nanos = *self.still_since_nanos.get_or_insert(*since_nanos);
            if self.phase == Phase::Closing && stamp_nanos - since_nanos >= self.still_nanos {
                self.phase = Phase::Settled;
            }
        }
        self.anchor = Some((stamp_nanos, fingers_rad.to_vec()));
        self.phase
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Phases of a hand that moves as `speeds` say, one for each 10 ms, without repetitions.
    fn phases(speeds: &[(usize, f64)]) -> Vec<Phase> {
        let mut finder = PhaseFinder::new(0.05, 200_000_000);
        let (mut at, mut stamp, mut found) = (0.0, 0, Vec::new());
        for (n, speed) in speeds {
            for _ in 0..*n {
                (at, stamp) = (at + speed * 0.01, stamp + 10_000_000);
                let noise = if stamp % 20_000_000 == 0 { 2e-4 } else { -2e-4 };
                found.push(finder.phase(stamp, &[at + noise, 0.5 * at]));
            }
        }
        found.dedup();
        found
    }

    #[test]
    fn a_hand_that_closes_stops_and_opens_again_has_two_grasps() {
        let grasp = [Phase::Open, Phase::Closing, Phase::Settled];
        assert_eq!(phases(&[(50, 0.0), (100, 1.0), (60, 0.0)]), grasp);
        let two = [(20, 0.0), (100, 1.0), (60, 0.0), (100, -1.0), (20, 0.0), (100, 1.0), (60, 0.0)];
        assert_eq!(phases(&two), [grasp, grasp].concat());
    }

    #[test]
    fn a_short_stop_is_not_settled_and_a_settled_hand_that_tightens_stays_so() {
        let stops = [(20, 0.0), (50, 1.0), (10, 0.0), (50, 1.0), (60, 0.0), (30, 0.2), (60, 0.0)];
        assert_eq!(phases(&stops), [Phase::Open, Phase::Closing, Phase::Settled]);
    }

    #[test]
    fn a_hand_that_begins_closed_is_open_until_it_closes() {
        assert_eq!(phases(&[(60, 0.0), (50, -1.0), (60, 0.0)]), [Phase::Open]);
    }
}
