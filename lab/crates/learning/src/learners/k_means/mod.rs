//! Learns the contact dictionary: K-means over contact positions (Dang & Allen, section III-A).
//!
//! Only positions are clustered, by Euclidean distance in the palm frame: a hand's reachable
//! contacts leave each position little choice of orientation. This module does not decide which
//! contacts to learn from (those of training grasps only) and does not weigh words for a grasp,
//! which is the histogram's work.
//!
//! The same positions, parameters and seed give the same bytes on any number of threads: work is
//! cut into chunks of fixed size, and sums over chunks are taken in the chunks' order. Nor does the
//! order of the positions change a bit.

mod blocks;
mod seeding;

use blindgrasp_stages::dictionary::{Dictionary, nearest_word, squared_distance};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use thiserror::Error;

use blocks::{Block, Clusters, assign, blocks_of, inertia};
use seeding::seed_words;

/// Parameters of K-means, named as in scikit-learn's `KMeans`.
#[derive(Debug, Clone, PartialEq)]
pub struct KMeansParams {
    /// Number of words, k; 64 in Dang & Allen, section IV-D.
    pub n_clusters: usize,
    /// Number of restarts, of which the one with the least inertia is kept.
    pub n_init: usize,
    /// Largest number of Lloyd iterations per restart.
    pub max_iter: usize,
    /// Stop when the squared movement of all centres together is at most this share of the mean
    /// variance of x, y and z.
    pub tolerance: f64,
    /// Seed of everything random.
    pub seed: u64,
}

impl Default for KMeansParams {
    /// The paper's 64 words, four restarts, otherwise scikit-learn's defaults.
    fn default() -> Self {
        Self { n_clusters: 64, n_init: 4, max_iter: 300, tolerance: 1e-4, seed: 1 }
    }
}

/// A learned dictionary and how well it fits the positions it was learned from.
#[derive(Debug, Clone, PartialEq)]
pub struct KMeans {
    pub dictionary: Dictionary,
    /// Sum over all positions of the squared distance to the nearest word, m².
    pub inertia: f64,
    /// Lloyd iterations of the restart that was kept.
    pub n_iter: usize,
}

/// Why no dictionary could be learned.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DictionaryError {
    /// A position is NaN, infinite or absurdly far from the palm.
    #[error("position {index} is {position_m:?} m: every coordinate must be finite and within ±{MAX_COORDINATE_M} m")]
    InvalidPosition {
        index: usize,
        /// What was found there, metres.
        position_m: [f64; 3],
    },
    /// There are more clusters than places to put them.
    #[error(
        "{n_distinct} distinct positions cannot make {n_clusters} clusters: give more contacts or ask for fewer words"
    )]
    TooFewDistinct { n_distinct: usize, n_clusters: usize },
}

/// Learns a contact dictionary from contact positions (metres, palm frame) by K-means.
///
/// Greedy k-means++ seeds, Lloyd's iterations, the best of `n_init` restarts by inertia. The paper
/// does not say how its K-means was started; this is scikit-learn's way.
///
/// Takes some 34 bytes of memory per position beside `positions_m`.
///
/// # Errors
/// When a position is not finite, or fewer positions are distinct than clusters asked for.
pub fn learn_dictionary(positions_m: &[[f64; 3]], params: &KMeansParams) -> Result<KMeans, DictionaryError> {
    let in_range = |x: &f64| x.abs() <= MAX_COORDINATE_M;
    if let Some((index, &position_m)) = positions_m.iter().enumerate().find(|(_, p)| !p.iter().all(in_range)) {
        return Err(DictionaryError::InvalidPosition { index, position_m });
    }

    let blocks = blocks_of(positions_m);
    let max_squared_shift = params.tolerance * mean_variance(&blocks);
    let restart = |stream: usize| {
        let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
        rng.set_stream(stream as u64);
        let seeds = seed_words(&blocks, params.n_clusters, &mut rng)?;
        Ok(lloyd(&blocks, seeds, params.max_iter, max_squared_shift))
    };
    let mut best = restart(0)?;
    for stream in 1..params.n_init {
        let learned = restart(stream)?;
        if learned.inertia < best.inertia {
            best = learned;
        }
    }
    best.dictionary.words_m.sort_by(|left, right| {
        left.iter()
            .zip(right)
            .map(|(l, r)| l.total_cmp(r))
            .find(|order| order.is_ne())
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    Ok(best)
}

/// The largest coordinate accepted. No hand reaches a kilometre: beyond it the unit is wrong, and
/// squares stay far from overflowing.
const MAX_COORDINATE_M: f64 = 1e3;

fn mean_variance(blocks: &[Block]) -> f64 {
    let n = blocks.iter().map(Block::len).sum::<usize>() as f64;
    let mean_over =
        |value: &dyn Fn([f64; 3]) -> f64| blocks.iter().flat_map(Block::positions).map(value).sum::<f64>() / n;
    let variance = |axis: usize| {
        let mean = mean_over(&|position| position[axis]);
        mean_over(&|position| (position[axis] - mean).powi(2))
    };
    (variance(0) + variance(1) + variance(2)) / 3.0
}

/// Lloyd's algorithm from the given words.
fn lloyd(blocks: &[Block], mut words: Vec<[f64; 3]>, max_iter: usize, max_squared_shift: f64) -> KMeans {
    let mut n_iter = 0;
    while n_iter < max_iter {
        n_iter += 1;
        let moved = update_words(blocks, &words, &assign(blocks, &words));
        let squared_shift: f64 = words.iter().zip(&moved).map(|(from, to)| squared_distance(from, to)).sum();
        words = moved;
        // When no position has changed its cluster, no word moves at all.
        if squared_shift <= max_squared_shift {
            break;
        }
    }
    KMeans { inertia: inertia(blocks, &words), dictionary: Dictionary { words_m: words }, n_iter }
}

/// Moves each word to the mean of its cluster, and the word of an empty cluster to the position farthest from all
/// others, where it lowers the inertia most. The next assignment gives it its members.
fn update_words(blocks: &[Block], words: &[[f64; 3]], clusters: &Clusters) -> Vec<[f64; 3]> {
    let mut moved = words.to_vec();
    let mut placed = Vec::with_capacity(words.len());
    for ((word, sum), &count) in moved.iter_mut().zip(&clusters.sums).zip(&clusters.counts) {
        if count > 0 {
            *word = sum.map(|sum| sum / count as f64);
            placed.push(*word);
        }
    }
    for (word, _) in moved.iter_mut().zip(&clusters.counts).filter(|(_, count)| **count == 0) {
        if let Some(position) = farthest_position(blocks, &placed) {
            *word = position;
            placed.push(position);
        }
    }
    moved
}

/// The position farthest from its nearest word, the first of equally far ones; `None` when all
/// coincide with words.
fn farthest_position(blocks: &[Block], words: &[[f64; 3]]) -> Option<[f64; 3]> {
    let mut farthest = (None, 0.0);
    for position in blocks.iter().flat_map(Block::positions) {
        let (_, squared) = nearest_word(words, &position);
        if squared > farthest.1 {
            farthest = (Some(position), squared);
        }
    }
    farthest.0
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::blocks::{BLOCK, CHUNK};
    use super::seeding::uniform;
    use super::*;

    fn params(n_clusters: usize) -> KMeansParams {
        KMeansParams { n_clusters, ..KMeansParams::default() }
    }

    /// `n` positions spread over a box of 0.2 m.
    fn cloud(n: usize) -> Vec<[f64; 3]> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        (0..n).map(|_| [(); 3].map(|()| 0.2 * uniform(&mut rng) - 0.1)).collect()
    }

    #[test]
    fn two_blobs_by_hand() {
        let positions = [[1.0, 0.0, 0.0], [1.0, 0.2, 0.0], [-1.0, 0.0, 0.1], [-1.0, 0.0, -0.1], [-1.0, 0.0, 0.3]];
        let learned = learn_dictionary(&positions, &params(2)).unwrap();
        let expected = [[-1.0, 0.0, 0.1], [1.0, 0.1, 0.0]];
        for (word, expected) in learned.dictionary.words_m.iter().zip(&expected) {
            assert!(squared_distance(word, expected) < 1e-24, "{word:?}");
        }
        // 2 * 0.1² in the first blob; 0 + 2 * 0.2² in the second.
        assert!((learned.inertia - 0.1).abs() < 1e-12, "{}", learned.inertia);
    }

    #[test]
    fn as_many_clusters_as_distinct_positions() {
        let positions = [[0.0; 3], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.0; 3], [0.0, 0.0, 0.1]];
        let learned = learn_dictionary(&positions, &params(3)).unwrap();
        assert_eq!(learned.inertia, 0.0);
        assert_eq!(
            learn_dictionary(&positions, &params(4)),
            Err(DictionaryError::TooFewDistinct { n_distinct: 3, n_clusters: 4 })
        );
    }

    #[test]
    fn number_of_threads_and_order_of_positions_change_no_bit() {
        // Some coincide, so that ties are sorted too.
        let mut positions = cloud(3 * CHUNK * BLOCK + 17);
        positions.extend_from_within(..BLOCK);
        let mut others = positions.clone();
        others.reverse();
        others.rotate_left(33);
        let learn = |positions: &[[f64; 3]], n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            let params = KMeansParams { n_init: 2, max_iter: 20, ..params(16) };
            pool.install(|| learn_dictionary(positions, &params)).unwrap()
        };
        let learned = learn(&positions, 1);
        for (positions, n_threads) in [(&positions, 2), (&positions, 3), (&others, 2)] {
            assert_eq!(learn(positions, n_threads), learned, "{n_threads} threads");
        }
    }

    #[test]
    fn blocks_find_the_nearest_of_all_words() {
        // A cloud, a grid on which words are equally near to many, and many positions that coincide.
        let grid = (0..1000).map(|idx| [idx % 10, idx / 10 % 10, idx / 100].map(|steps: usize| steps as f64 / 64.0));
        let coinciding = std::iter::repeat_n([0.05, 0.02, -0.01], 300);
        let positions: Vec<[f64; 3]> = cloud(2 * CHUNK * BLOCK + 7).into_iter().chain(grid).chain(coinciding).collect();
        let blocks = blocks_of(&positions);
        let mut sorted: Vec<[f64; 3]> = blocks.iter().flat_map(Block::positions).collect();
        let mut expected = positions.clone();
        for positions in [&mut sorted, &mut expected] {
            positions.sort_by(|left, right| left.partial_cmp(right).unwrap());
        }
        assert_eq!(sorted, expected);
        for n_words in [1, 2, 7, 64] {
            // Some words are positions of the grid, and two are the same.
            let mut words: Vec<[f64; 3]> = positions.iter().rev().step_by(17).skip(17).take(n_words).copied().collect();
            words[n_words - 1] = words[0];
            let mut counts = vec![0; n_words];
            let mut sums = vec![[0.0; 3]; n_words];
            let mut squared_sum = 0.0;
            for position in &positions {
                let (word_idx, squared) = nearest_word(&words, position);
                squared_sum += squared;
                counts[word_idx] += 1;
                sums[word_idx].iter_mut().zip(position).for_each(|(sum, coordinate)| *sum += coordinate);
            }
            let clusters = assign(&blocks, &words);
            assert_eq!(clusters.counts, counts);
            for (found, expected) in clusters.sums.as_flattened().iter().zip(sums.as_flattened()) {
                assert!((found - expected).abs() < 1e-10, "{found} {expected}");
            }
            assert!((inertia(&blocks, &words) - squared_sum).abs() < 1e-12 * positions.len() as f64);
        }
    }

    #[test]
    fn seeds_are_distinct_positions_drawn_by_distance() {
        // Far from the cloud there is a position that no seeding by distance can miss.
        let mut positions = cloud(5 * BLOCK);
        positions.push([900.0, 0.0, 0.0]);
        let blocks = blocks_of(&positions);
        let mut words = seed_words(&blocks, 30, &mut ChaCha8Rng::seed_from_u64(3)).unwrap();
        assert!(words.iter().all(|word| positions.contains(word)), "{words:?}");
        assert!(words.iter().take(2).any(|word| word[0] == 900.0), "{words:?}");
        words.sort_by(|left, right| left.partial_cmp(right).unwrap());
        words.dedup();
        assert_eq!(words.len(), 30);
    }

    #[test]
    fn words_are_sorted_and_each_is_the_mean_of_its_cluster() {
        let positions = cloud(500);
        let learned = learn_dictionary(&positions, &KMeansParams { tolerance: 0.0, ..params(8) }).unwrap();
        let words = &learned.dictionary.words_m;
        assert!(words.windows(2).all(|pair| pair[0] < pair[1]), "{words:?}");
        let blocks = blocks_of(&positions);
        let clusters = assign(&blocks, words);
        for ((word, sum), &count) in words.iter().zip(&clusters.sums).zip(&clusters.counts) {
            assert!(squared_distance(word, &sum.map(|sum| sum / count as f64)) < 1e-24, "{word:?}");
        }
        assert!((inertia(&blocks, words) - learned.inertia).abs() < 1e-12);
    }

    #[test]
    fn more_iterations_and_restarts_never_raise_the_inertia() {
        let positions = cloud(2000);
        let inertia = |n_init, max_iter| {
            learn_dictionary(&positions, &KMeansParams { n_init, max_iter, ..params(12) }).unwrap().inertia
        };
        let by_iterations: Vec<f64> = [0, 1, 2, 5, 50].iter().map(|&max_iter| inertia(1, max_iter)).collect();
        assert!(by_iterations.windows(2).all(|pair| pair[1] < pair[0]), "{by_iterations:?}");
        assert!(inertia(6, 50) <= inertia(1, 50));
    }

    #[test]
    fn words_of_empty_clusters_move_to_the_farthest_positions() {
        let positions = [[0.0; 3], [0.2, 0.0, 0.0], [1.0, 0.0, 0.0], [1.1, 0.0, 0.0], [9.0, 0.0, 0.0]];
        // Words 1 and 3 are too far from everything to win a position.
        let words = [[0.1, 0.0, 0.0], [50.0; 3], [1.0, 0.0, 0.0], [60.0; 3]];
        let blocks = blocks_of(&positions);
        let clusters = assign(&blocks, &words);
        assert_eq!(clusters.counts, [2, 0, 3, 0]);
        let moved = update_words(&blocks, &words, &clusters);
        // The mean of 1.0, 1.1 and 9.0 is 3.7. The farthest is 9.0 (5.3 away), then 1.0 (0.9 from 0.1 and 2.7 from 3.7)
        // and 1.1 (1.0 from 0.1), of which 1.1 is the farther one.
        assert_eq!((moved[1], moved[3]), ([9.0, 0.0, 0.0], [1.1, 0.0, 0.0]));
        assert!((moved[2][0] - 3.7).abs() < 1e-12);
        assert_eq!(farthest_position(&blocks_of(&positions[..1]), &[[0.0; 3]]), None);
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let positions = [[0.0; 3], [0.1, 0.0, f64::NAN], [2e3, 0.0, 0.0]];
        assert!(matches!(
            learn_dictionary(&positions, &params(1)),
            Err(DictionaryError::InvalidPosition { index: 1, .. })
        ));
        assert!(matches!(
            learn_dictionary(&positions[2..], &params(1)),
            Err(DictionaryError::InvalidPosition { index: 0, .. })
        ));
        assert_eq!(
            learn_dictionary(&[], &params(1)),
            Err(DictionaryError::TooFewDistinct { n_distinct: 0, n_clusters: 1 })
        );
        let error = learn_dictionary(&positions[..1], &params(usize::MAX)).unwrap_err();
        assert_eq!(error, DictionaryError::TooFewDistinct { n_distinct: 1, n_clusters: usize::MAX });
        assert!(error.to_string().contains("1 distinct positions"), "{error}");
    }
}
