//! Where K-means starts: greedy k-means++.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use rayon::prelude::*;

use super::DictionaryError;
use super::blocks::{BLOCK, Block, CHUNK, sum};

/// Squared distances from the positions of a block to the nearest word so far.
struct Squared {
    /// 0 where the block has no position.
    of_positions: [f64; BLOCK],
    sum: f64,
    max: f64,
}

impl Squared {
    /// Before there is any word.
    fn infinite(block: &Block) -> Self {
        let of_positions = std::array::from_fn(|lane| if lane < block.len() { f64::INFINITY } else { 0.0 });
        Self { of_positions, sum: f64::INFINITY, max: f64::INFINITY }
    }

    /// The distances with one more word, unless it changes nothing.
    #[inline(always)]
    fn with(&self, block: &Block, word: &[f64; 3]) -> Option<[f64; BLOCK]> {
        if block.least_squared_distance(word) >= self.max {
            return None;
        }
        let mut squared = block.squared_distances(word);
        for (squared, so_far) in squared.iter_mut().zip(&self.of_positions) {
            *squared = if *so_far < *squared { *so_far } else { *squared };
        }
        Some(squared)
    }

    fn sum_with(&self, block: &Block, word: &[f64; 3]) -> f64 {
        self.with(block, word).map_or(self.sum, |squared| sum(&squared))
    }

    fn add_word(&mut self, block: &Block, word: &[f64; 3]) {
        if let Some(squared) = self.with(block, word) {
            self.sum = sum(&squared);
            self.max = squared.iter().copied().fold(0.0, f64::max);
            self.of_positions = squared;
        }
    }
}

/// Greedy k-means++ (Arthur and Vassilvitskii 2007, with 2 + ln k trials a word as in scikit-learn). Each further word
/// is a position drawn in proportion to the squared distance from the words so far, the best of the trials by the
/// inertia left.
pub(super) fn seed_words(
    blocks: &[Block],
    n_clusters: usize,
    rng: &mut ChaCha8Rng,
) -> Result<Vec<[f64; 3]>, DictionaryError> {
    let too_few = |n_distinct| DictionaryError::TooFewDistinct { n_distinct, n_clusters };
    let n_positions: usize = blocks.iter().map(Block::len).sum();
    if n_positions == 0 {
        return Err(too_few(0));
    }
    let n_trials = 2 + (n_clusters as f64).ln() as usize;
    let first_idx = ((uniform(rng) * n_positions as f64) as usize).min(n_positions - 1);
    let mut words = vec![blocks[first_idx / BLOCK].position(first_idx % BLOCK)];
    let mut squared: Vec<Squared> = blocks.iter().map(Squared::infinite).collect();
    loop {
        let word = words[words.len() - 1];
        squared.par_iter_mut().zip(blocks).for_each(|(squared, block)| squared.add_word(block, &word));
        if words.len() == n_clusters {
            return Ok(words);
        }
        let mut total = 0.0;
        let cumulative: Vec<f64> = squared
            .iter()
            .map(|squared| {
                total += squared.sum;
                total
            })
            .collect();
        // Every position coincides with a word: the words so far are all the distinct positions
        // there are.
        if total <= 0.0 {
            return Err(too_few(words.len()));
        }
        let trials: Vec<[f64; 3]> =
            (0..n_trials).map(|_| draw(blocks, &squared, &cumulative, uniform(rng) * total)).collect();
        let chunk_inertias: Vec<Vec<f64>> = blocks
            .par_chunks(CHUNK)
            .zip(squared.par_chunks(CHUNK))
            .map(|(blocks, squared)| {
                let inertia_with =
                    |trial| blocks.iter().zip(squared).map(|(block, squared)| squared.sum_with(block, trial)).sum();
                trials.iter().map(inertia_with).collect()
            })
            .collect();
        let inertia_of = |trial_idx: usize| chunk_inertias.iter().map(|inertias| inertias[trial_idx]).sum::<f64>();
        let mut best = (0, inertia_of(0));
        for trial_idx in 1..n_trials {
            let inertia = inertia_of(trial_idx);
            if inertia < best.1 {
                best = (trial_idx, inertia);
            }
        }
        words.push(trials[best.0]);
    }
}

/// The position at which the running sum of the squared distances first exceeds `drawn`. There the sum has just grown,
/// so it is not a word yet.
fn draw(blocks: &[Block], squared: &[Squared], cumulative: &[f64], drawn: f64) -> [f64; 3] {
    let total = cumulative[cumulative.len() - 1];
    // `drawn` may have been rounded up to the total; then the position that completed the total is meant.
    let block_idx = cumulative.partition_point(|&sum| sum <= drawn).min(cumulative.partition_point(|&sum| sum < total));
    let mut sum = if block_idx == 0 { 0.0 } else { cumulative[block_idx - 1] };
    let mut drawn_lane = 0;
    for (lane, &squared) in squared[block_idx].of_positions.iter().enumerate().filter(|(_, squared)| **squared > 0.0) {
        drawn_lane = lane;
        sum += squared;
        if sum > drawn {
            break;
        }
    }
    blocks[block_idx].position(drawn_lane)
}

/// A number in [0, 1) with 53 random bits, spelled out so that the seed means the same with every
/// version of `rand`.
pub(super) fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}
