//! The grasps that were decided last: a late sample does not decide one of them again.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

/// Decided grasps in the order of their decisions. Most sources count their grasps, so that a few runs of numbers hold all.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Decided {
    runs: VecDeque<Run>,
}

/// Grasps of one epoch whose numbers follow each other.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Run {
    epoch: u64,
    first: u64,
    n: u64,
}

impl Decided {
    pub(crate) fn contains(&self, (epoch, grasp_id): (u64, u64)) -> bool {
        let is_in = |run: &Run| run.epoch == epoch && grasp_id.checked_sub(run.first).is_some_and(|idx| idx < run.n);
        self.runs.iter().any(is_in)
    }

    /// Adds a grasp, and forgets the oldest ones beyond `n_remembered`.
    pub(crate) fn push(&mut self, (epoch, grasp_id): (u64, u64), n_remembered: usize) {
        match self.runs.back_mut() {
            Some(run) if run.epoch == epoch && run.first.checked_add(run.n) == Some(grasp_id) => run.n += 1,
            _ => self.runs.push_back(Run { epoch, first: grasp_id, n: 1 }),
        }
        let mut n_to_forget = self.runs.iter().map(|run| run.n).sum::<u64>().saturating_sub(n_remembered as u64);
        while let Some(oldest) = self.runs.front_mut()
            && n_to_forget > 0
        {
            if oldest.n > n_to_forget {
                (oldest.first, oldest.n) = (oldest.first + n_to_forget, oldest.n - n_to_forget);
                return;
            }
            n_to_forget -= oldest.n;
            self.runs.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_remembers_what_a_list_of_all_grasps_remembers() {
        let mut random = 1_u64;
        for n_remembered in [0, 1, 2, 5, 12] {
            let (mut decided, mut list) = (Decided::default(), VecDeque::new());
            for _ in 0..400 {
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let (epoch, jump) = (random >> 62 & 1, random >> 40 & 7);
                let last = list.back().map_or(0, |(_, grasp_id)| *grasp_id);
                // Mostly the next number; now and then another one, or one again.
                let grasp = (epoch, if jump < 5 { last + 1 } else { random >> 50 & 15 });
                list.push_back(grasp);
                decided.push(grasp, n_remembered);
                if list.len() > n_remembered {
                    list.pop_front();
                }
                for grasp in (0..2).flat_map(|epoch| (0..40).map(move |grasp_id| (epoch, grasp_id))) {
                    assert_eq!(decided.contains(grasp), list.contains(&grasp), "{grasp:?}: {decided:?} {list:?}");
                }
            }
        }
        let mut last = Decided::default();
        last.push((0, u64::MAX), 4);
        last.push((0, 0), 4);
        assert!(last.contains((0, u64::MAX)) && last.contains((0, 0)) && !last.contains((0, 1)));
    }
}
