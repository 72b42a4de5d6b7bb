//! Contact positions in blocks of neighbours, so that most of them need not be compared with most words.
//!
//! Positions are split in half along their widest axis, again and again, until [`BLOCK`] are left (a k-d tree of which
//! only the leaves and [`CHUNK`]s of leaves are kept). To the positions in a box only those words can be nearest that
//! are not farther than some other word from all of the box. These are some three of 64 for a block, whose distances
//! are then computed side by side. This is the filtering of Kanungo et al. (An efficient k-means clustering algorithm,
//! 2002, section 2); it leaves nothing out that a search of all words would find. Positions that coincide, as those of
//! the palm's cells do, end up in blocks of one word. A dictionary of 120,000 contacts takes 0.25 s so, and 3.0 s by
//! comparing all words (4 restarts, 2 cores); its words differ in the last bit then, and with them a model made again.
//!
//! Blocks and their order follow from the set of positions alone, whatever order they come in.

use std::cmp::Ordering;

use blindgrasp_stages::dictionary::squared_distance;
use rayon::prelude::*;

/// Positions in a block.
pub(super) const BLOCK: usize = 64;
/// Blocks per unit of parallel work; fixed, because it decides the order in which sums are rounded.
pub(super) const CHUNK: usize = 16;
/// Numbers that [`sum`] adds up side by side.
const LANES: usize = 8;
/// Squared distances that differ by less, relatively, count as equal when words are ruled out: far more than the
/// rounding of a few operations.
const ROUNDING: f64 = 1e-12;

/// At most [`BLOCK`] positions that are near each other.
#[derive(Debug)]
pub(super) struct Block {
    /// x of all, y of all, z of all; filled up with copies of the last position.
    axes: [[f64; BLOCK]; 3],
    len: usize,
    sum: [f64; 3],
    bounds: Bounds,
}

/// The smallest box, parallel to the axes, around some positions.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
}

/// A word that may be the nearest one to a position of a block.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    word_idx: usize,
    word: [f64; 3],
    squared_from_centre: f64,
}

/// What an assignment of positions to their nearest words amounts to.
#[derive(Debug)]
pub(super) struct Clusters {
    pub(super) sums: Vec<[f64; 3]>,
    pub(super) counts: Vec<usize>,
}

/// Sorts positions into blocks; only the last may not be full.
pub(super) fn blocks_of(positions: &[[f64; 3]]) -> Vec<Block> {
    let mut order: Vec<usize> = (0..positions.len()).collect();
    sort_into_blocks(positions, &mut order);
    order.par_chunks(BLOCK).map(|idxs| Block::new(positions, idxs)).collect()
}

/// Sums and counts of the positions nearest to each word.
pub(super) fn assign(blocks: &[Block], words: &[[f64; 3]]) -> Clusters {
    let empty = || Clusters { sums: vec![[0.0; 3]; words.len()], counts: vec![0; words.len()] };
    let of_chunks: Vec<Clusters> = blocks
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut clusters = empty();
            for_each_block(chunk, words, |block, candidates| block.add_to(&mut clusters, candidates));
            clusters
        })
        .collect();
    let mut total = empty();
    for of_chunk in &of_chunks {
        for (count, of_chunk) in total.counts.iter_mut().zip(&of_chunk.counts) {
            *count += of_chunk;
        }
        for (sum, of_chunk) in total.sums.as_flattened_mut().iter_mut().zip(of_chunk.sums.as_flattened()) {
            *sum += of_chunk;
        }
    }
    total
}

/// Sum over all positions of the squared distance to the nearest word.
pub(super) fn inertia(blocks: &[Block], words: &[[f64; 3]]) -> f64 {
    let chunk_sums: Vec<f64> = blocks
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut chunk_sum = 0.0;
            for_each_block(chunk, words, |block, candidates| {
                let mut squared = block.nearest(candidates).0;
                squared[block.len..].fill(0.0);
                chunk_sum += sum(&squared);
            });
            chunk_sum
        })
        .collect();
    chunk_sums.iter().sum()
}

/// The sum in a fixed order that vector instructions can follow.
pub(super) fn sum(values: &[f64; BLOCK]) -> f64 {
    let mut sums = [0.0; LANES];
    for values in values.as_chunks::<LANES>().0 {
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value;
        }
    }
    sums.iter().sum()
}

/// Calls `visit` with each block of a chunk and the words that may be nearest to its positions, in their order.
fn for_each_block(chunk: &[Block], words: &[[f64; 3]], mut visit: impl FnMut(&Block, &[Candidate])) {
    let bounds = Bounds::around(chunk.iter().flat_map(|block| [block.bounds.low, block.bounds.high]));
    let mut of_chunk: Vec<Candidate> = words
        .iter()
        .enumerate()
        .map(|(word_idx, &word)| Candidate { word_idx, word, squared_from_centre: 0.0 })
        .collect();
    bounds.rule_out(&mut of_chunk);
    let mut of_block = Vec::with_capacity(of_chunk.len());
    for block in chunk {
        of_block.clone_from(&of_chunk);
        block.bounds.rule_out(&mut of_block);
        visit(block, &of_block);
    }
}

/// Splits at the median of the widest axis, at whole chunks as long as there are several. Ties are broken by the other
/// axes, so that only equal positions can change places.
fn sort_into_blocks(positions: &[[f64; 3]], order: &mut [usize]) {
    let widest_axis = if order.is_empty() {
        0
    } else {
        let bounds = Bounds::around(order.iter().map(|&idx| positions[idx]));
        let extent = |axis: &usize| bounds.high[*axis] - bounds.low[*axis];
        (1..3).fold(0, |widest, axis| if extent(&axis) > extent(&widest) { axis } else { widest })
    };
    let compare = |&left: &usize, &right: &usize| {
        (0..3)
            .map(|step| (widest_axis + step) % 3)
            .map(|axis| positions[left][axis].total_cmp(&positions[right][axis]))
            .find(|order| order.is_ne())
            .unwrap_or(Ordering::Equal)
    };
    if order.len() <= BLOCK {
        order.sort_unstable_by(compare);
        return;
    }
    let unit = if order.len() > CHUNK * BLOCK { CHUNK * BLOCK } else { BLOCK };
    let middle = order.len().div_ceil(unit) / 2 * unit;
    order.select_nth_unstable_by(middle, compare);
    let (left, right) = order.split_at_mut(middle);
    rayon::join(|| sort_into_blocks(positions, left), || sort_into_blocks(positions, right));
}

impl Bounds {
    fn around(positions: impl Iterator<Item = [f64; 3]>) -> Self {
        let nothing = Self { low: [f64::INFINITY; 3], high: [f64::NEG_INFINITY; 3] };
        positions.fold(nothing, |bounds, position| Self {
            low: std::array::from_fn(|axis| bounds.low[axis].min(position[axis])),
            high: std::array::from_fn(|axis| bounds.high[axis].max(position[axis])),
        })
    }

    /// Leaves the words that are, somewhere in the box, at least as near as the word `best` nearest to its centre c.
    ///
    /// At c + v, a word w is farther than `best` by `‖w - c‖² - ‖best - c‖² - 2 v·(w - best)` in squared distance. This
    /// is least in the corner where v has the signs of `w - best`.
    fn rule_out(&self, candidates: &mut Vec<Candidate>) {
        let centre: [f64; 3] = std::array::from_fn(|axis| 0.5 * (self.low[axis] + self.high[axis]));
        let extent: [f64; 3] = std::array::from_fn(|axis| self.high[axis] - self.low[axis]);
        let mut best = ([0.0; 3], f64::INFINITY);
        for candidate in candidates.iter_mut() {
            candidate.squared_from_centre = squared_distance(&candidate.word, &centre);
            if candidate.squared_from_centre < best.1 {
                best = (candidate.word, candidate.squared_from_centre);
            }
        }
        let (best, best_squared) = best;
        candidates.retain(|Candidate { word, squared_from_centre, .. }| {
            let reach: f64 = (0..3).map(|axis| extent[axis] * (word[axis] - best[axis]).abs()).sum();
            squared_from_centre - best_squared <= reach + ROUNDING * (squared_from_centre + reach)
        });
    }

    /// Squared distance from a point to the nearest point of the box.
    fn squared_distance(&self, point: &[f64; 3]) -> f64 {
        let outside = |axis: usize| (self.low[axis] - point[axis]).max(point[axis] - self.high[axis]).max(0.0);
        squared_distance(&[outside(0), outside(1), outside(2)], &[0.0; 3])
    }
}

impl Block {
    fn new(positions: &[[f64; 3]], idxs: &[usize]) -> Self {
        let position = |lane: usize| positions[idxs[lane.min(idxs.len() - 1)]];
        let axes: [[f64; BLOCK]; 3] = std::array::from_fn(|axis| std::array::from_fn(|lane| position(lane)[axis]));
        Self {
            sum: axes.map(|values| values[..idxs.len()].iter().sum()),
            bounds: Bounds::around((0..idxs.len()).map(position)),
            len: idxs.len(),
            axes,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn position(&self, lane: usize) -> [f64; 3] {
        std::array::from_fn(|axis| self.axes[axis][lane])
    }

    pub(super) fn positions(&self) -> impl Iterator<Item = [f64; 3]> {
        (0..self.len).map(|lane| self.position(lane))
    }

    /// Squared distances from a word to the positions.
    #[inline(always)]
    pub(super) fn squared_distances(&self, word: &[f64; 3]) -> [f64; BLOCK] {
        let mut squared = [0.0; BLOCK];
        for (lane, squared) in squared.iter_mut().enumerate() {
            *squared = squared_distance(&[self.axes[0][lane], self.axes[1][lane], self.axes[2][lane]], word);
        }
        squared
    }

    /// No position is nearer to the point, in squared distance.
    pub(super) fn least_squared_distance(&self, point: &[f64; 3]) -> f64 {
        self.bounds.squared_distance(point)
    }

    /// Squared distance and index of the word nearest to each position, of equally near ones the first.
    #[inline(always)]
    fn nearest(&self, candidates: &[Candidate]) -> ([f64; BLOCK], [usize; BLOCK]) {
        let (mut nearest, mut word_idxs) = ([f64::INFINITY; BLOCK], [0; BLOCK]);
        for candidate in candidates {
            let squared = self.squared_distances(&candidate.word);
            for ((nearest, word_idx), squared) in nearest.iter_mut().zip(&mut word_idxs).zip(squared) {
                let is_nearer = squared < *nearest;
                *word_idx = if is_nearer { candidate.word_idx } else { *word_idx };
                *nearest = if is_nearer { squared } else { *nearest };
            }
        }
        (nearest, word_idxs)
    }

    fn add_to(&self, clusters: &mut Clusters, candidates: &[Candidate]) {
        let mut add = |word_idx: usize, count, position: [f64; 3]| {
            clusters.counts[word_idx] += count;
            for (sum, coordinate) in clusters.sums[word_idx].iter_mut().zip(position) {
                *sum += coordinate;
            }
        };
        if let [only] = candidates {
            add(only.word_idx, self.len, self.sum);
            return;
        }
        let (_, word_idxs) = self.nearest(candidates);
        for (position, &word_idx) in self.positions().zip(&word_idxs) {
            add(word_idx, 1, position);
        }
    }
}
