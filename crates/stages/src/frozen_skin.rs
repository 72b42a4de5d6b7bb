//! Finds a skin that has stopped: its bus sends the last readings again, in which the fingers still feel the object.
//!
//! Some skins are coarse and read the same numbers again by chance. So the frames of the resting hand show how probable that is,
//! grasp by grasp; a skin that does not flicker at rest, or that only creeps there, is never called frozen. Pure: no clock, no I/O.

use std::hash::{DefaultHasher, Hash, Hasher};

use serde::{Deserialize, Serialize};

use blindgrasp_messages::Phase;

/// A skin is frozen if so many readings are the same in a row that a healthy one would give them with this probability.
const BY_CHANCE: f64 = 1e-6;

/// What is kept of a grasp's frames. Another instance can continue from it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct FrozenSkin {
    /// Epoch and grasp of the last frame.
    grasp: Option<(u64, u64)>,
    phase: Phase,
    /// A digest of the readings of its cells; 0 if no cell felt.
    digest: u64,
    /// The sum of its cells, and whether that was greater than the sum before.
    newtons: f64,
    is_rising: bool,
    /// How often the load of the resting hand began to rise or to fall, and how many frames read the same as the one before.
    n_turns: u32,
    n_again: u32,
    /// How many of the last frames read the same as the frame before them.
    n_in_a_row: u32,
}

impl FrozenSkin {
    /// Takes the next frame, and returns whether the skin has stopped.
    ///
    /// * `grasp` - epoch and number.
    /// * `cells_newtons` - as the source sends them.
    /// * `feels` - whether there is a contact.
    pub fn note(&mut self, grasp: (u64, u64), phase: Phase, cells_newtons: &[f64], feels: bool) -> bool {
        if self.grasp != Some(grasp) {
            *self = FrozenSkin { grasp: Some(grasp), ..FrozenSkin::default() };
        }
        let mut digest = DefaultHasher::new();
        cells_newtons.iter().for_each(|newtons| newtons.to_bits().hash(&mut digest));
        let digest = if feels { digest.finish() } else { 0 };
        let before = std::mem::replace(&mut self.digest, digest);
        let is_at_rest = std::mem::replace(&mut self.phase, phase) == phase && phase.decides();
        if feels && digest == before {
            self.n_in_a_row += 1;
            return self.is_frozen();
        }
        // Readings of a skin that has stopped do not show how often a healthy one repeats its readings.
        if !self.is_frozen() {
            self.n_again += self.n_in_a_row;
        }
        self.n_in_a_row = 0;
        let newtons = cells_newtons.iter().sum();
        let is_rising = newtons > std::mem::replace(&mut self.newtons, newtons);
        let has_turned = std::mem::replace(&mut self.is_rising, is_rising) != is_rising;
        self.n_turns += u32::from(is_at_rest && feels && before != 0 && has_turned);
        false
    }

    fn is_frozen(&self) -> bool {
        let again = f64::from(self.n_again + 1) / f64::from(self.n_again + self.n_turns + 1);
        again.powi(self.n_in_a_row as i32) <= BY_CHANCE
    }

    /// That the skin has stopped in the grasp of the last frame, if it has, and the grasp has this number: for people.
    pub fn said(&self, grasp_id: u64) -> Option<String> {
        let is_of_it = self.grasp.is_some_and(|(_, of_frame)| of_frame == grasp_id);
        (is_of_it && self.is_frozen()).then(|| {
            format!(
                "all cells repeat their readings in {} frames, and flickered before: has the skin or its bus stopped?",
                self.n_in_a_row + 1
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In which of these frames the skin has stopped. A letter is a reading of the cells, `-` of an empty hand; those before `|` are
    /// of the settled hand, the others of one that moves.
    fn frozen(frames: &str) -> String {
        let (mut skin, mut phase) = (FrozenSkin::default(), Phase::Settled);
        let mut found = String::new();
        for letter in frames.chars() {
            if letter == '|' {
                phase = Phase::TestLifting;
                continue;
            }
            let is_frozen = skin.note((0, 3), phase, &[f64::from(u32::from(letter)), 0.0], letter != '-');
            assert_eq!(skin.said(3).is_some(), is_frozen);
            assert_eq!(skin.said(4), None);
            found.push(if is_frozen { '!' } else { '.' });
        }
        found
    }

    #[test]
    fn a_skin_that_stops_is_found_unless_it_is_coarse_or_feels_nothing() {
        // Five turns: the next reading is the same with a probability of 1/6, and eight are with less than 1e-6.
        assert_eq!(frozen("bacbdce|ggggggggggh"), "...............!!.");
        assert_eq!(frozen("bacbdce|-----------"), "..................");
        // It stops when the hand has just settled.
        assert_eq!(frozen("bacbbbbbbbbbbbbbbbb"), ".............!!!!!!");
        // A source that sends one frame again and again, a coarse skin, and one that creeps to rest.
        assert_eq!(frozen("aaaaaaaaaaaaaaaaaaaaaaaa"), ".".repeat(24));
        assert_eq!(frozen("aabbaabbaabb|gggggggggggggggggggg"), ".".repeat(32));
        assert_eq!(frozen("abcdefg|gggggggggggggggggggg"), ".".repeat(27));
        // It goes on, and stops again.
        assert_eq!(frozen("bacbdce|gggggggggghggggggggg"), "...............!!.........!");
    }
}
