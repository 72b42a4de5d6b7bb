//! The contact dictionary (Dang & Allen, section III-A): representative contacts, to which the contacts of a grasp are
//! compared.
//!
//! Only positions count, by Euclidean distance in the palm frame: a hand's reachable contacts leave each position little
//! choice of orientation. The crate `learning` learns the dictionary; the histogram weighs its words for a grasp.

use serde::{Deserialize, Serialize};

/// The representative contacts ĉ_1 .. ĉ_k of Dang & Allen, section III-A.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dictionary {
    /// Cluster centres, metres in the palm frame; learned ones are sorted by x, then y, then z.
    pub words_m: Vec<[f64; 3]>,
}

impl Dictionary {
    pub fn len(&self) -> usize {
        self.words_m.len()
    }

    /// Whether there is no word at all.
    pub fn is_empty(&self) -> bool {
        self.words_m.is_empty()
    }

    /// Index of the word nearest to a point in the palm frame (metres), and its distance in metres.
    ///
    /// Of words equally near, the first. `None` when the dictionary is empty or no distance is
    /// finite.
    pub fn nearest(&self, point_m: [f64; 3]) -> Option<(usize, f64)> {
        let (word_idx, squared) = nearest_word(&self.words_m, &point_m);
        squared.is_finite().then(|| (word_idx, squared.sqrt()))
    }
}

/// Index and squared distance of the nearest word; an infinite distance when there is none.
pub fn nearest_word(words: &[[f64; 3]], point: &[f64; 3]) -> (usize, f64) {
    let mut nearest = (0, f64::INFINITY);
    for (word_idx, word) in words.iter().enumerate() {
        let squared = squared_distance(word, point);
        if squared < nearest.1 {
            nearest = (word_idx, squared);
        }
    }
    nearest
}

/// ‖left - right‖².
#[inline]
pub fn squared_distance(left: &[f64; 3], right: &[f64; 3]) -> f64 {
    let (dx, dy, dz) = (left[0] - right[0], left[1] - right[1], left[2] - right[2]);
    dx * dx + dy * dy + dz * dz
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn nearest_word_and_its_distance() {
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [0.3, 0.0, 0.0], [0.3, 0.0, 0.0]] };
        assert_eq!((dictionary.len(), dictionary.is_empty()), (3, false));
        let (word_idx, distance_m) = dictionary.nearest([0.3, 0.4, 0.0]).unwrap();
        assert_eq!(word_idx, 1);
        assert!((distance_m - 0.4).abs() < 1e-15);
        assert_eq!(dictionary.nearest([f64::NAN, 0.0, 0.0]), None);
        assert_eq!(Dictionary { words_m: Vec::new() }.nearest([0.0; 3]), None);
    }
}
