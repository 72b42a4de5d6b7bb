//! A plain rule in the place of a learned function: several fingers feel the object, and together they feel enough. The palm
//! counts as a finger.

use serde::{Deserialize, Serialize};

/// The loads that a grasp must have. It needs no training, and of the hand only its fingers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoadRule {
    /// Values of a feature.
    pub n_features: usize,
    /// For each finger the places of its pads' loads among the values of a feature.
    pub fingers: Vec<Vec<usize>>,
    /// The least number of fingers that feel something.
    pub least_fingers: usize,
    /// The least load of all fingers together, newtons.
    pub least_newtons: f64,
}

impl LoadRule {
    /// The load beyond the least one, newtons. If too few fingers feel something, it is one newton below that of an empty hand.
    pub fn decision_value(&self, values: &[f64]) -> f64 {
        let (mut n_fingers, mut newtons) = (0, 0.0);
        for pads in &self.fingers {
            let load: f64 = pads.iter().map(|idx| values[*idx]).sum();
            n_fingers += usize::from(load > 0.0);
            newtons += load;
        }
        if n_fingers < self.least_fingers { -self.least_newtons - 1.0 } else { newtons - self.least_newtons }
    }

    /// Checks a rule that was read from a file.
    ///
    /// # Errors
    /// A description of the first problem.
    pub fn validate(&self) -> Result<(), String> {
        let outside = self.fingers.iter().flatten().find(|idx| **idx >= self.n_features);
        if let Some(idx) = outside {
            return Err(format!("the rule of loads reads value {idx}, and a feature has {}", self.n_features));
        }
        if !(self.least_newtons >= 0.0 && self.least_newtons.is_finite()) {
            return Err(format!("the rule of loads asks for {} newtons, expected 0 or more", self.least_newtons));
        }
        Ok(())
    }

    /// A short description for people.
    pub fn summary(&self) -> String {
        format!(
            "a plain rule: {} of {} (fingers, palm) feel, together {} newtons or more",
            self.least_fingers,
            self.fingers.len(),
            self.least_newtons
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_fingers_feel_enough_together() {
        let rule =
            LoadRule { n_features: 5, fingers: vec![vec![0, 1], vec![3]], least_fingers: 2, least_newtons: 10.0 };
        for (values, expected) in [
            ([4.0, 3.0, 9.0, 5.0, 9.0], 2.0),
            ([4.0, 3.0, 9.0, 1.0, 9.0], -2.0),
            ([40.0, 3.0, 9.0, 0.0, 9.0], -11.0),
            ([0.0; 5], -11.0),
        ] {
            assert_eq!(rule.decision_value(&values), expected, "{values:?}");
        }
        assert_eq!(rule.validate(), Ok(()));
        for bad in [LoadRule { n_features: 3, ..rule.clone() }, LoadRule { least_newtons: f64::NAN, ..rule }] {
            assert!(bad.validate().is_err());
        }
    }
}
