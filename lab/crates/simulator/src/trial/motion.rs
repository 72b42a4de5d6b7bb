//! How the arm moves while it lifts, holds and shakes: a path, smooth in position, speed and acceleration.

use nalgebra::Vector3;

use crate::trial::TrialProtocol;

/// A straight way up or down.
pub(super) struct Path {
    /// Height at its beginning, over where the hand closed.
    pub(super) from_m: f64,
    /// How far it goes up.
    pub(super) by_m: f64,
    pub(super) secs: f64,
}

impl Path {
    /// The palm's place over where it closed, in the world: metres, after `secs`.
    pub(super) fn place_m(&self, secs: f64) -> Vector3<f64> {
        Vector3::new(0.0, 0.0, self.from_m + self.by_m * smooth(secs / self.secs))
    }

    /// Velocity and acceleration by differences over a time step.
    pub(super) fn motion(&self, secs: f64, step_secs: f64) -> (Vector3<f64>, Vector3<f64>) {
        differences(|secs| self.place_m(secs), secs, step_secs)
    }
}

/// The arm's way in a test lift: up, and then a shake sideways if there is one.
pub(super) struct TestLiftPath<'a>(pub(super) &'a TrialProtocol);

impl TestLiftPath<'_> {
    /// As [`Path::place_m`].
    pub(super) fn place_m(&self, secs: f64) -> Vector3<f64> {
        let TrialProtocol { test_lift_m, test_lift_secs, test_shake_m, test_shake_secs, .. } = *self.0;
        let part = (secs - test_lift_secs) / test_shake_secs;
        let envelope = if (0.0..=1.0).contains(&part) { (std::f64::consts::PI * part).sin().powi(2) } else { 0.0 };
        let sideways_m = test_shake_m * envelope * (std::f64::consts::TAU * part).sin();
        Path { from_m: 0.0, by_m: test_lift_m, secs: test_lift_secs }.place_m(secs) + Vector3::x() * sideways_m
    }

    /// As [`Path::motion`].
    pub(super) fn motion(&self, secs: f64, step_secs: f64) -> (Vector3<f64>, Vector3<f64>) {
        differences(|secs| self.place_m(secs), secs, step_secs)
    }

    /// How long it takes, without the rest after it.
    pub(super) fn secs(&self) -> f64 {
        self.0.test_lift_secs + if self.0.test_shake_m > 0.0 { self.0.test_shake_secs } else { 0.0 }
    }
}

/// The arm's way while it lifts, holds and shakes.
pub(super) struct LiftPath<'a> {
    /// How far it has lifted already.
    pub(super) from_m: f64,
    pub(super) protocol: &'a TrialProtocol,
}

impl LiftPath<'_> {
    /// The palm's place over where it closed, in the world: metres, after `secs`.
    pub(super) fn place_m(&self, secs: f64) -> Vector3<f64> {
        let protocol = self.protocol;
        let by_m = protocol.lift_m - self.from_m;
        let up = Path { from_m: self.from_m, by_m, secs: protocol.lift_secs };
        let shaking_since = secs - protocol.lift_secs - protocol.hold_secs;
        let [x, z] = [shaking_since, shaking_since - protocol.shake_secs].map(|secs| self.shake_m(secs));
        up.place_m(secs) + Vector3::new(x, 0.0, z)
    }

    fn shake_m(&self, secs: f64) -> f64 {
        let protocol = self.protocol;
        if secs <= 0.0 || secs >= protocol.shake_secs {
            return 0.0;
        }
        // It comes and goes gently.
        let envelope = (std::f64::consts::PI * secs / protocol.shake_secs).sin().powi(2);
        protocol.shake_m * envelope * (std::f64::consts::TAU * protocol.shake_hertz * secs).sin()
    }

    /// How long it takes in all.
    pub(super) fn secs(&self) -> f64 {
        self.protocol.lift_secs + self.protocol.hold_secs + 2.0 * self.protocol.shake_secs
    }

    /// Velocity and acceleration by differences over a time step.
    pub(super) fn motion(&self, secs: f64, step_secs: f64) -> (Vector3<f64>, Vector3<f64>) {
        differences(|secs| self.place_m(secs), secs, step_secs)
    }
}

fn differences(place_m: impl Fn(f64) -> Vector3<f64>, secs: f64, step_secs: f64) -> (Vector3<f64>, Vector3<f64>) {
    let [before, now, after] = [-1.0, 0.0, 1.0].map(|steps: f64| place_m(secs + steps * step_secs));
    ((after - now) / step_secs, (after - 2.0 * now + before) / (step_secs * step_secs))
}

/// From 0 to 1 with the least jerk.
fn smooth(part: f64) -> f64 {
    let part = part.clamp(0.0, 1.0);
    part.powi(3) * (10.0 - 15.0 * part + 6.0 * part * part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_lifts_holds_shakes_and_ends_where_it_lifted_to() {
        let protocol = TrialProtocol::default();
        for from_m in [0.0, 0.005] {
            let path = LiftPath { from_m, protocol: &protocol };
            assert_eq!(path.place_m(0.0), Vector3::new(0.0, 0.0, from_m));
            let end = path.place_m(path.secs());
            assert!((end - Vector3::new(0.0, 0.0, protocol.lift_m)).norm() < 1e-12, "{end}");
            let steps = (0..4000).map(|idx| f64::from(idx) * 1e-3);
            let accelerations: Vec<f64> = steps.map(|secs| path.motion(secs, 1e-3).1.norm()).collect();
            let most = accelerations.iter().copied().fold(0.0, f64::max);
            // Amplitude · (2π · 2 Hz)² is 1.6 m/s²; lifting takes 5.77 · 0.2 m / (1 s)².
            assert!((1.0..2.5).contains(&most), "{most}");
            let jumps = accelerations.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
            assert!(jumps < 0.1, "{jumps}");
        }
    }

    #[test]
    fn motion_is_the_paths_derivative() {
        let protocol = TrialProtocol::default();
        let (velocity, _) = LiftPath { from_m: 0.0, protocol: &protocol }.motion(0.5, 1e-4);
        // The steepest place of the least-jerk path: 15/8.
        assert!((velocity.z - 1.875 * protocol.lift_m / protocol.lift_secs).abs() < 1e-3);
    }
}
