//! The contact dictionary: K-means over contact positions (Dang & Allen, section III-A).
//!
//! Only positions are clustered, by Euclidean distance in the palm frame: a hand's reachable
//! contacts leave each position little choice of orientation. This module does not decide which
//! contacts to learn from (those of training grasps only) and does not weigh words for a grasp,
//! which is the histogram's work.
//!
//! The same positions, parameters and seed give the same bytes on any number of threads: work is
//! cut into chunks of fixed size, and sums over chunks are taken in the chunks' order.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The representative contacts ĉ_1 .. ĉ_k of Dang & Allen, section III-A.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dictionary {
    /// Cluster centres, metres in the palm frame; learned ones are sorted by x, then y, then z.
    pub words_m: Vec<[f64; 3]>,
}

impl Dictionary {
    /// Number of words, k.
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
    /// The cluster centres.
    pub dictionary: Dictionary,
    /// Sum over all positions of the squared distance to the nearest word, m².
    pub inertia: f64,
    /// Lloyd iterations of the restart that was kept.
    pub n_iter: usize,
}

/// Why no dictionary could be learned.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DictionaryError {
    /// A dictionary without words was asked for.
    #[error("n_clusters is 0: ask for at least one word")]
    NoClusters,
    /// No restart was asked for.
    #[error("n_init is 0: ask for at least one restart")]
    NoRestarts,
    /// The tolerance is negative or not a number.
    #[error("tolerance is {tolerance}: it must be finite and at least 0")]
    Tolerance {
        /// The tolerance given.
        tolerance: f64,
    },
    /// A position is NaN, infinite or absurdly far from the palm.
    #[error("position {index} is {position_m:?} m: every coordinate must be finite and within ±{MAX_COORDINATE_M} m")]
    InvalidPosition {
        /// Index of the position.
        index: usize,
        /// What was found there, metres.
        position_m: [f64; 3],
    },
    /// There are more clusters than places to put them.
    #[error(
        "{n_distinct} distinct positions cannot make {n_clusters} clusters: give more contacts or ask for fewer words"
    )]
    TooFewDistinct {
        /// Number of distinct positions.
        n_distinct: usize,
        /// Number of clusters asked for.
        n_clusters: usize,
    },
}

/// Learns a contact dictionary from contact positions (metres, palm frame) by K-means.
///
/// Greedy k-means++ seeds, Lloyd's iterations, the best of `n_init` restarts by inertia. The paper
/// does not say how its K-means was started; this is scikit-learn's way.
///
/// # Errors
/// When a parameter is out of range, a position is not finite, or fewer positions are distinct than
/// clusters asked for.
pub fn learn_dictionary(positions_m: &[[f64; 3]], params: &KMeansParams) -> Result<KMeans, DictionaryError> {
    if params.n_clusters == 0 {
        return Err(DictionaryError::NoClusters);
    }
    if params.n_init == 0 {
        return Err(DictionaryError::NoRestarts);
    }
    if !params.tolerance.is_finite() || params.tolerance < 0.0 {
        return Err(DictionaryError::Tolerance { tolerance: params.tolerance });
    }
    let in_range = |x: &f64| x.abs() <= MAX_COORDINATE_M;
    if let Some((index, &position_m)) = positions_m.iter().enumerate().find(|(_, p)| !p.iter().all(in_range)) {
        return Err(DictionaryError::InvalidPosition { index, position_m });
    }

    let max_squared_shift = params.tolerance * mean_variance(positions_m);
    let mut best: Option<KMeans> = None;
    for restart in 0..params.n_init {
        let mut rng = ChaCha8Rng::seed_from_u64(params.seed);
        rng.set_stream(restart as u64);
        let seeds = seed_words(positions_m, params.n_clusters, &mut rng)?;
        let learned = lloyd(positions_m, seeds, params.max_iter, max_squared_shift);
        if best.as_ref().is_none_or(|best| learned.inertia < best.inertia) {
            best = Some(learned);
        }
    }
    // `n_init` is at least 1, so there is a best one.
    let mut best = best.ok_or(DictionaryError::NoRestarts)?;
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
/// Positions per unit of parallel work; fixed, because it decides the order in which sums are
/// rounded.
const CHUNK: usize = 4096;
/// The label of a position that was not assigned yet.
const UNASSIGNED: usize = usize::MAX;

fn squared_distance(left: &[f64; 3], right: &[f64; 3]) -> f64 {
    let (dx, dy, dz) = (left[0] - right[0], left[1] - right[1], left[2] - right[2]);
    dx * dx + dy * dy + dz * dz
}

/// Index and squared distance of the nearest word; an infinite distance when there is none.
fn nearest_word(words: &[[f64; 3]], point: &[f64; 3]) -> (usize, f64) {
    let mut nearest = (0, f64::INFINITY);
    for (word_idx, word) in words.iter().enumerate() {
        let squared = squared_distance(word, point);
        if squared < nearest.1 {
            nearest = (word_idx, squared);
        }
    }
    nearest
}

fn inertia(positions: &[[f64; 3]], words: &[[f64; 3]]) -> f64 {
    let chunk_sums: Vec<f64> = positions
        .par_chunks(CHUNK)
        .map(|chunk| chunk.iter().map(|position| nearest_word(words, position).1).sum())
        .collect();
    chunk_sums.iter().sum()
}

fn mean_variance(positions: &[[f64; 3]]) -> f64 {
    let n = positions.len() as f64;
    let variance = |axis: usize| {
        let mean = positions.iter().map(|position| position[axis]).sum::<f64>() / n;
        positions.iter().map(|position| (position[axis] - mean).powi(2)).sum::<f64>() / n
    };
    (variance(0) + variance(1) + variance(2)) / 3.0
}

/// A number in [0, 1) with 53 random bits, spelled out so that the seed means the same with every
/// version of `rand`.
fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

/// Greedy k-means++ (Arthur and Vassilvitskii 2007, with 2 + ln k trials a word as in
/// scikit-learn): each further word is a position drawn in proportion to the squared distance from
/// the words so far, the best of the trials by the inertia left.
fn seed_words(
    positions: &[[f64; 3]],
    n_clusters: usize,
    rng: &mut ChaCha8Rng,
) -> Result<Vec<[f64; 3]>, DictionaryError> {
    let too_few = |n_distinct| DictionaryError::TooFewDistinct { n_distinct, n_clusters };
    if positions.is_empty() {
        return Err(too_few(0));
    }
    let n_trials = 2 + (n_clusters as f64).ln() as usize;
    let first_idx = (uniform(rng) * positions.len() as f64) as usize;
    let mut words = vec![positions[first_idx.min(positions.len() - 1)]];
    let mut squared: Vec<f64> = positions.par_iter().map(|position| squared_distance(position, &words[0])).collect();
    while words.len() < n_clusters {
        let mut total = 0.0;
        let cumulative: Vec<f64> = squared
            .iter()
            .map(|squared| {
                total += squared;
                total
            })
            .collect();
        // Every position coincides with a word: the words so far are all the distinct positions
        // there are.
        if total <= 0.0 {
            return Err(too_few(words.len()));
        }
        let trials: Vec<[f64; 3]> = (0..n_trials)
            .map(|_| {
                let drawn = uniform(rng) * total;
                // Where the sum first exceeds the number drawn it has just grown, so that position
                // is not a word yet. The product may round up to the total; then the position that
                // completed the total is meant.
                let position_idx = cumulative.partition_point(|&sum| sum <= drawn);
                positions[position_idx.min(cumulative.partition_point(|&sum| sum < total))]
            })
            .collect();
        let chunk_inertias: Vec<Vec<f64>> = positions
            .par_chunks(CHUNK)
            .zip(squared.par_chunks(CHUNK))
            .map(|(positions, squared)| {
                let inertia_with = |trial: &[f64; 3]| {
                    positions.iter().zip(squared).map(|(position, &d)| d.min(squared_distance(position, trial))).sum()
                };
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
        let word = trials[best.0];
        squared
            .par_iter_mut()
            .zip(positions)
            .for_each(|(squared, position)| *squared = squared.min(squared_distance(position, &word)));
        words.push(word);
    }
    Ok(words)
}

/// Lloyd's algorithm from the given words.
fn lloyd(positions: &[[f64; 3]], mut words: Vec<[f64; 3]>, max_iter: usize, max_squared_shift: f64) -> KMeans {
    let mut labels = vec![UNASSIGNED; positions.len()];
    let mut n_iter = 0;
    while n_iter < max_iter {
        n_iter += 1;
        let clusters = assign(positions, &words, &mut labels);
        if clusters.n_changed == 0 {
            break;
        }
        let moved = update_words(positions, &words, &clusters);
        let squared_shift: f64 = words.iter().zip(&moved).map(|(from, to)| squared_distance(from, to)).sum();
        words = moved;
        if squared_shift <= max_squared_shift {
            break;
        }
    }
    KMeans { inertia: inertia(positions, &words), dictionary: Dictionary { words_m: words }, n_iter }
}

/// What an assignment of positions to their nearest words amounts to.
struct Clusters {
    sums: Vec<[f64; 3]>,
    counts: Vec<usize>,
    n_changed: usize,
}

impl Clusters {
    fn empty(n_clusters: usize) -> Self {
        Self { sums: vec![[0.0; 3]; n_clusters], counts: vec![0; n_clusters], n_changed: 0 }
    }
}

/// Labels every position with its nearest word and sums the positions of each cluster.
fn assign(positions: &[[f64; 3]], words: &[[f64; 3]], labels: &mut [usize]) -> Clusters {
    let of_chunks: Vec<Clusters> = positions
        .par_chunks(CHUNK)
        .zip(labels.par_chunks_mut(CHUNK))
        .map(|(positions, labels)| {
            let mut clusters = Clusters::empty(words.len());
            for (position, label) in positions.iter().zip(labels) {
                let (word_idx, _) = nearest_word(words, position);
                clusters.n_changed += usize::from(*label != word_idx);
                *label = word_idx;
                clusters.counts[word_idx] += 1;
                for (sum, coordinate) in clusters.sums[word_idx].iter_mut().zip(position) {
                    *sum += coordinate;
                }
            }
            clusters
        })
        .collect();
    let mut total = Clusters::empty(words.len());
    for of_chunk in &of_chunks {
        total.n_changed += of_chunk.n_changed;
        for (count, of_chunk) in total.counts.iter_mut().zip(&of_chunk.counts) {
            *count += of_chunk;
        }
        for (sum, of_chunk) in total.sums.as_flattened_mut().iter_mut().zip(of_chunk.sums.as_flattened()) {
            *sum += of_chunk;
        }
    }
    total
}

/// Moves each word to the mean of its cluster, and the word of an empty cluster to the position
/// farthest from all others, where it lowers the inertia most; the next assignment gives it its
/// members.
fn update_words(positions: &[[f64; 3]], words: &[[f64; 3]], clusters: &Clusters) -> Vec<[f64; 3]> {
    let mut moved = words.to_vec();
    let mut placed = Vec::with_capacity(words.len());
    for ((word, sum), &count) in moved.iter_mut().zip(&clusters.sums).zip(&clusters.counts) {
        if count > 0 {
            *word = sum.map(|sum| sum / count as f64);
            placed.push(*word);
        }
    }
    for (word, _) in moved.iter_mut().zip(&clusters.counts).filter(|(_, count)| **count == 0) {
        if let Some(position) = farthest_position(positions, &placed) {
            *word = position;
            placed.push(position);
        }
    }
    moved
}

/// The position farthest from its nearest word, the first of equally far ones; `None` when all
/// coincide with words.
fn farthest_position(positions: &[[f64; 3]], words: &[[f64; 3]]) -> Option<[f64; 3]> {
    let mut farthest = (None, 0.0);
    for position in positions {
        let (_, squared) = nearest_word(words, position);
        if squared > farthest.1 {
            farthest = (Some(*position), squared);
        }
    }
    farthest.0
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
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
    fn nearest_word_and_its_distance() {
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [0.3, 0.0, 0.0], [0.3, 0.0, 0.0]] };
        assert_eq!((dictionary.len(), dictionary.is_empty()), (3, false));
        let (word_idx, distance_m) = dictionary.nearest([0.3, 0.4, 0.0]).unwrap();
        assert_eq!(word_idx, 1);
        assert!((distance_m - 0.4).abs() < 1e-15);
        assert_eq!(dictionary.nearest([f64::NAN, 0.0, 0.0]), None);
        assert_eq!(Dictionary { words_m: Vec::new() }.nearest([0.0; 3]), None);
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
    fn number_of_threads_changes_no_bit() {
        let positions = cloud(3 * CHUNK + 17);
        let learn = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            pool.install(|| learn_dictionary(&positions, &KMeansParams { n_init: 2, max_iter: 20, ..params(16) }))
                .unwrap()
        };
        assert_eq!(learn(1), learn(2));
        assert_eq!(learn(1), learn(3));
    }

    #[test]
    fn order_of_well_separated_positions_changes_nothing() {
        let corners = [[0.0; 3], [5.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 5.0], [5.0; 3]];
        let mut positions: Vec<[f64; 3]> = cloud(200)
            .iter()
            .zip(corners.iter().cycle())
            .map(|(offset, corner)| std::array::from_fn(|axis| corner[axis] + offset[axis]))
            .collect();
        let learned = learn_dictionary(&positions, &params(5)).unwrap();
        positions.reverse();
        positions.rotate_left(33);
        let permuted = learn_dictionary(&positions, &params(5)).unwrap();
        for (left, right) in learned.dictionary.words_m.iter().zip(&permuted.dictionary.words_m) {
            assert!(squared_distance(left, right) < 1e-24, "{left:?} {right:?}");
        }
    }

    #[test]
    fn words_are_sorted_and_each_is_the_mean_of_its_cluster() {
        let positions = cloud(500);
        let learned = learn_dictionary(&positions, &KMeansParams { tolerance: 0.0, ..params(8) }).unwrap();
        let words = &learned.dictionary.words_m;
        assert!(words.windows(2).all(|pair| pair[0] < pair[1]), "{words:?}");
        let clusters = assign(&positions, words, &mut vec![UNASSIGNED; positions.len()]);
        for ((word, sum), &count) in words.iter().zip(&clusters.sums).zip(&clusters.counts) {
            assert!(squared_distance(word, &sum.map(|sum| sum / count as f64)) < 1e-24, "{word:?}");
        }
        assert!((inertia(&positions, words) - learned.inertia).abs() < 1e-12);
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
        let clusters = assign(&positions, &words, &mut [UNASSIGNED; 5]);
        assert_eq!(clusters.counts, [2, 0, 3, 0]);
        let moved = update_words(&positions, &words, &clusters);
        // The mean of 1.0, 1.1 and 9.0 is 3.7: the farthest is 9.0 (5.3 away), then 1.0 (0.9 from
        // 0.1 and 2.7 from 3.7) and 1.1 (1.0 from 0.1), of which 1.1 is the farther one.
        assert_eq!((moved[1], moved[3]), ([9.0, 0.0, 0.0], [1.1, 0.0, 0.0]));
        assert!((moved[2][0] - 3.7).abs() < 1e-12);
        assert_eq!(farthest_position(&positions[..1], &[[0.0; 3]]), None);
    }

    #[test]
    fn errors_say_what_is_wrong() {
        let positions = [[0.0; 3], [0.1, 0.0, f64::NAN], [2e3, 0.0, 0.0]];
        assert_eq!(learn_dictionary(&positions, &params(0)), Err(DictionaryError::NoClusters));
        assert_eq!(
            learn_dictionary(&positions, &KMeansParams { n_init: 0, ..params(1) }),
            Err(DictionaryError::NoRestarts)
        );
        assert!(matches!(
            learn_dictionary(&positions, &params(1)),
            Err(DictionaryError::InvalidPosition { index: 1, .. })
        ));
        assert!(matches!(
            learn_dictionary(&positions[2..], &params(1)),
            Err(DictionaryError::InvalidPosition { index: 0, .. })
        ));
        for tolerance in [-1.0, f64::NAN, f64::INFINITY] {
            let result = learn_dictionary(&positions[..1], &KMeansParams { tolerance, ..params(1) });
            assert!(matches!(result, Err(DictionaryError::Tolerance { .. })), "{tolerance}");
        }
        assert_eq!(
            learn_dictionary(&[], &params(1)),
            Err(DictionaryError::TooFewDistinct { n_distinct: 0, n_clusters: 1 })
        );
        let error = learn_dictionary(&positions[..1], &params(usize::MAX)).unwrap_err();
        assert_eq!(error, DictionaryError::TooFewDistinct { n_distinct: 1, n_clusters: usize::MAX });
        assert!(error.to_string().contains("1 distinct positions"), "{error}");
    }
}
