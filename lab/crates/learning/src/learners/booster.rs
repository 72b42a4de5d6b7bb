//! Grows boosted trees by second-order boosting of the logistic loss on binned values (Chen & Guestrin, "XGBoost: A
//! Scalable Tree Boosting System", KDD 2016, sections 2.2 and 3.2).
//!
//! With the probability p of a sample and its target y, the loss has the gradient g = p - y and the second
//! derivative h = p (1 - p). A leaf whose samples have the sums G and H takes the value -G / (H + lambda), times the
//! learning rate.
//! A split gains G_l² / (H_l + lambda) + G_r² / (H_r + lambda) - G² / (H + lambda). Trees grow level by level.
//!
//! Every sum runs over the samples in their order, so that the trees are the same on any number of threads.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use blindgrasp_stages::classifier::boosting::{BoostedTrees, BoostingError, BoostingParams, Tree, TreeNode};

/// Bins of a column. An index of a bin fits into a byte.
const MAX_BINS: usize = 256;

/// Least gain of a split. Rounding alone stays far below it.
const LEAST_GAIN: f64 = 1e-6;

/// Least sum of second derivatives in a leaf, whatever the parameters say. It keeps leaves from being empty.
const LEAST_WEIGHT: f64 = 1e-6;

/// The base is the log-odds of the mean target, which is kept this far from 0 and 1.
const LEAST_PROBABILITY: f64 = 1e-6;

/// Grows trees that predict the `targets`: each sample's probability of the positive class, 0 or 1 where it is certain.
/// The first trees are the same for any number of rounds.
///
/// * `features` - row-major, n_samples × `n_features`.
/// * `seed` - decides which samples a tree sees and which columns a split may choose from.
///
/// # Errors
/// Shapes that do not fit each other, values that are not finite in single precision, or parameters out of range.
pub fn train_boosted(
    features: &[f64],
    n_features: usize,
    targets: &[f64],
    params: &BoostingParams,
    seed: u64,
) -> Result<BoostedTrees, BoostingError> {
    let n_labels = targets.len();
    if n_features == 0 || n_features > usize::from(u16::MAX) || n_labels == 0 || features.len() != n_labels * n_features
    {
        return Err(BoostingError::Shape { n_values: features.len(), n_labels, n_features });
    }
    params.validate()?;
    if !features.iter().all(|value| (*value as f32).is_finite()) || !targets.iter().all(|y| (0.0..=1.0).contains(y)) {
        return Err(BoostingError::Values);
    }
    let column = |idx: usize| Column::of(features.iter().skip(idx).step_by(n_features).map(|value| *value as f32));
    let columns: Vec<Column> = (0..n_features).into_par_iter().map(column).collect();

    let mean = targets.iter().sum::<f64>() / n_labels as f64;
    let mean = mean.clamp(LEAST_PROBABILITY, 1.0 - LEAST_PROBABILITY);
    let mut grown = BoostedTrees { n_features, base: (mean / (1.0 - mean)).ln(), trees: Vec::new() };
    let mut log_odds = vec![grown.base; n_labels];
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..params.n_rounds {
        let derivatives: Vec<Derivatives> =
            log_odds.iter().zip(targets).map(|(log_odds, y)| Derivatives::of(*log_odds, *y)).collect();
        let mut seen = Vec::with_capacity(n_labels);
        for label_idx in 0..n_labels as u32 {
            if random.random_bool(params.subsample) {
                seen.push(label_idx);
            }
        }
        let tree = grow(&columns, &derivatives, seen, params, &mut random);
        let samples = features.par_chunks(n_features);
        log_odds.par_iter_mut().zip(samples).for_each(|(log_odds, sample)| *log_odds += f64::from(tree.value(sample)));
        grown.trees.push(tree);
    }
    Ok(grown)
}

/// The first and second derivative of the loss by the log-odds, of a sample or summed over several.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Derivatives {
    first: f64,
    second: f64,
}

impl Derivatives {
    fn of(log_odds: f64, target: f64) -> Self {
        let probability = 1.0 / (1.0 + (-log_odds).exp());
        Derivatives { first: probability - target, second: probability * (1.0 - probability) }
    }

    fn add(&mut self, other: Derivatives) {
        self.first += other.first;
        self.second += other.second;
    }

    fn minus(self, other: Derivatives) -> Self {
        Derivatives { first: self.first - other.first, second: self.second - other.second }
    }

    /// What the samples' loss falls by, doubled, if they become a leaf.
    fn score(self, lambda: f64) -> f64 {
        self.first * self.first / (self.second + lambda)
    }

    fn leaf_value(self, lambda: f64) -> f64 {
        if self.second + lambda > 0.0 { -self.first / (self.second + lambda) } else { 0.0 }
    }
}

/// One column of the features, in bins of about equally many samples.
#[derive(Debug, PartialEq)]
struct Column {
    /// Least value of each bin but the first, rising.
    cuts: Vec<f32>,
    /// The bin of each sample.
    bins: Vec<u8>,
}

impl Column {
    fn of(values: impl Iterator<Item = f32> + Clone) -> Self {
        let mut sorted: Vec<f32> = values.clone().collect();
        sorted.sort_by(f32::total_cmp);
        let cuts = cuts(&sorted);
        let bins = values.map(|value| cuts.partition_point(|cut| *cut <= value) as u8).collect();
        Column { cuts, bins }
    }
}

/// Cuts midway between neighbouring values, so that no bin has more than its share of the samples unless all of them
/// have one value.
fn cuts(sorted: &[f32]) -> Vec<f32> {
    let mut cuts = Vec::new();
    let mut n_done = 0;
    let mut n_in_bin = 0;
    for same in sorted.chunk_by(|a, b| a == b) {
        let n_bins_left = MAX_BINS - cuts.len();
        let share = (sorted.len() - n_done).div_ceil(n_bins_left);
        if n_in_bin > 0 && n_in_bin + same.len() > share && n_bins_left > 1 {
            n_done += n_in_bin;
            n_in_bin = 0;
            let below = sorted[n_done - 1];
            let middle = below + (same[0] - below) / 2.0;
            cuts.push(if below < middle && middle.is_finite() { middle } else { same[0] });
        }
        n_in_bin += same.len();
    }
    cuts
}

/// A node that may still be split.
struct Open {
    node_idx: usize,
    /// The samples in it, rising.
    samples: Vec<u32>,
}

struct Split {
    gain: f64,
    column_idx: usize,
    /// Samples in this bin and those above it go right.
    first_right_bin: usize,
}

fn grow(
    columns: &[Column],
    derivatives: &[Derivatives],
    seen: Vec<u32>,
    params: &BoostingParams,
    random: &mut ChaCha8Rng,
) -> Tree {
    let mut nodes = vec![TreeNode::leaf(0.0)];
    let mut level = vec![Open { node_idx: 0, samples: seen }];
    for depth in 0..=params.max_depth {
        let tried: Vec<(Open, Vec<usize>)> = level
            .into_iter()
            .map(|open| {
                (open, if depth < params.max_depth { draw_columns(columns.len(), params, random) } else { vec![] })
            })
            .collect();
        let splits: Vec<(Derivatives, Option<Split>)> = tried
            .par_iter()
            .map(|(open, column_idxs)| best_split(columns, column_idxs, derivatives, &open.samples, params))
            .collect();
        level = Vec::new();
        for ((open, _), (sum, split)) in tried.into_iter().zip(splits) {
            let Some(split) = split else {
                nodes[open.node_idx].threshold = (params.learning_rate * sum.leaf_value(params.lambda)) as f32;
                continue;
            };
            let Column { cuts, bins } = &columns[split.column_idx];
            let left_idx = nodes.len();
            let (threshold, feature) = (cuts[split.first_right_bin - 1], split.column_idx as u16);
            nodes[open.node_idx] = TreeNode { threshold, left: left_idx as u32, feature };
            let goes_left = |sample: &u32| usize::from(bins[*sample as usize]) < split.first_right_bin;
            let (left, right) = open.samples.into_iter().partition(goes_left);
            for (node_idx, samples) in [(left_idx, left), (left_idx + 1, right)] {
                nodes.push(TreeNode::leaf(0.0));
                level.push(Open { node_idx, samples });
            }
        }
    }
    Tree { nodes }
}

/// The columns that one split may choose from, rising.
fn draw_columns(n_columns: usize, params: &BoostingParams, random: &mut ChaCha8Rng) -> Vec<usize> {
    let n_drawn = ((params.colsample_bynode * n_columns as f64) as usize).max(1);
    let mut drawn = Vec::with_capacity(n_drawn);
    // Each column is drawn with the probability that leaves every choice of n_drawn columns equally likely.
    for column_idx in 0..n_columns {
        if random.random_range(0..n_columns - column_idx) < n_drawn - drawn.len() {
            drawn.push(column_idx);
        }
    }
    drawn
}

/// The sum over the samples, and the split of greatest gain; of equal ones that of the first column and the lowest bin.
fn best_split(
    columns: &[Column],
    column_idxs: &[usize],
    derivatives: &[Derivatives],
    samples: &[u32],
    params: &BoostingParams,
) -> (Derivatives, Option<Split>) {
    let of_samples: Vec<Derivatives> = samples.iter().map(|sample| derivatives[*sample as usize]).collect();
    let mut sum = Derivatives::default();
    of_samples.iter().for_each(|of_sample| sum.add(*of_sample));
    if sum.second < 2.0 * params.min_child_weight {
        return (sum, None);
    }
    let of_column =
        |column_idx: &usize| {
            best_of_column(&columns[*column_idx], samples, &of_samples, sum, params)
                .map(|(gain, first_right_bin)| Split { gain, column_idx: *column_idx, first_right_bin })
        };
    let splits: Vec<Option<Split>> = column_idxs.par_iter().map(of_column).collect();
    (sum, splits.into_iter().flatten().reduce(|best, split| if split.gain > best.gain { split } else { best }))
}

/// Gain and first bin on the right of a column's best split.
fn best_of_column(
    column: &Column,
    samples: &[u32],
    of_samples: &[Derivatives],
    sum: Derivatives,
    params: &BoostingParams,
) -> Option<(f64, usize)> {
    let mut bins = [Derivatives::default(); MAX_BINS];
    for (sample, of_sample) in samples.iter().zip(of_samples) {
        bins[usize::from(column.bins[*sample as usize])].add(*of_sample);
    }
    let least_weight = params.min_child_weight.max(LEAST_WEIGHT);
    let unsplit = sum.score(params.lambda);
    let mut left = Derivatives::default();
    let mut last_bin_idx: Option<usize> = None;
    let mut best: Option<(f64, usize)> = None;
    let is_filled = |(_, bin): &(usize, &Derivatives)| bin.second > 0.0;
    for (bin_idx, bin) in bins[..=column.cuts.len()].iter().enumerate().filter(is_filled) {
        let right = sum.minus(left);
        if let Some(last_bin_idx) = last_bin_idx
            && left.second >= least_weight
            && right.second >= least_weight
        {
            let gain = left.score(params.lambda) + right.score(params.lambda) - unsplit;
            if gain > best.map_or(LEAST_GAIN, |(gain, _)| gain) {
                // Midway between the samples on either side.
                best = Some((gain, (last_bin_idx + 1 + bin_idx).div_ceil(2)));
            }
        }
        left.add(*bin);
        last_bin_idx = Some(bin_idx);
    }
    best
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// One tree of one split on all samples and columns.
    fn stump() -> BoostingParams {
        BoostingParams {
            n_rounds: 1,
            learning_rate: 0.5,
            max_depth: 1,
            subsample: 1.0,
            colsample_bynode: 1.0,
            min_child_weight: 0.5,
            lambda: 1.0,
        }
    }

    #[test]
    fn one_split_by_hand() {
        // All probabilities are a half, so g is 0.5, 0.5, -0.5, -0.5 and h is 0.25. Between the second and the third
        // sample G is 1 and H a half on the left: the leaf is 0.5 * -1 / (0.5 + 1). The first column tells nothing.
        let features = [7.0, 1.0, 7.0, 2.0, 7.0, 3.0, 7.0, 5.0];
        let targets = [0.0, 0.0, 1.0, 1.0];
        let trees = train_boosted(&features, 2, &targets, &stump(), 1).unwrap();
        assert_eq!(trees.base, 0.0);
        let third = 1.0_f32 / 3.0;
        let [left, right] = [-third, third].map(TreeNode::leaf);
        let expected = Tree { nodes: vec![TreeNode { threshold: 2.5, left: 1, feature: 1 }, left, right] };
        assert_eq!(trees.trees, [expected]);
        // Each side has the weight 0.5, which is too little here.
        let params = BoostingParams { min_child_weight: 0.6, ..stump() };
        let trees = train_boosted(&features, 2, &targets, &params, 1).unwrap();
        assert_eq!(trees.trees, [Tree { nodes: vec![TreeNode::leaf(0.0)] }]);
    }

    #[test]
    fn gains_by_hand() {
        // G and H: -1 and 0.5 of the first two samples, 1.5 and 1 of the next two, 0.5 and 1.5 of all; lambda is 1. The
        // gain of the split between them is 1/1.5 + 2.25/2 - 0.25/2.5; the other two splits gain less.
        let derivatives =
            [(-0.5, 0.25), (-0.5, 0.25), (0.75, 0.5), (0.75, 0.5)].map(|(first, second)| Derivatives { first, second });
        let columns = [Column::of([1.0, 2.0, 3.0, 4.0].into_iter())];
        let params = BoostingParams { min_child_weight: 0.0, ..stump() };
        let (sum, split) = best_split(&columns, &[0], &derivatives, &[0, 1, 2, 3], &params);
        let split = split.unwrap();
        assert_eq!((sum.first, sum.second, split.first_right_bin), (0.5, 1.5, 2));
        assert!((split.gain - (1.0 / 1.5 + 2.25 / 2.0 - 0.1)).abs() < 1e-12);
    }

    #[test]
    fn bins_by_hand() {
        let column = Column::of([4.0, 1.0, 2.0, 1.0].into_iter());
        assert_eq!(column, Column { cuts: vec![1.5, 3.0], bins: vec![2, 0, 1, 0] });
        assert_eq!(Column::of([3.0; 5].into_iter()), Column { cuts: vec![], bins: vec![0; 5] });
        // No single-precision number lies between these two.
        let next = 1.0_f32.next_up();
        assert_eq!(cuts(&[1.0, next]), [next]);
        // Half of the values are 0. They have a bin of their own, and the others share 255 bins.
        let sorted: Vec<f32> = (0..2000).map(|idx| if idx < 1000 { 0.0 } else { (idx - 999) as f32 }).collect();
        let column = Column::of(sorted.into_iter());
        assert_eq!(column.cuts[0], 0.5);
        let n_in_bin = |bin: usize| column.bins.iter().filter(|of_sample| usize::from(**of_sample) == bin).count();
        assert_eq!(column.cuts.len(), 255);
        assert!((1..256).all(|bin| (1..=4).contains(&n_in_bin(bin))));
    }

    #[test]
    fn columns_are_drawn_evenly() {
        let params = BoostingParams { colsample_bynode: 0.4, ..stump() };
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut n_drawn = [0; 10];
        for _ in 0..10_000 {
            let drawn = draw_columns(10, &params, &mut random);
            assert!(drawn.len() == 4 && drawn.is_sorted_by(|a, b| a < b));
            drawn.into_iter().for_each(|column_idx| n_drawn[column_idx] += 1);
        }
        assert!(n_drawn.iter().all(|n| (3800..4200).contains(n)), "{n_drawn:?}");
        assert_eq!(draw_columns(2, &params, &mut random).len(), 1);
    }

    /// Two values each. The positive class is where both are on the same side of a half.
    fn samples() -> (Vec<f64>, Vec<f64>) {
        let value = |idx: usize, column: usize| ((idx * idx * 37 + idx * 101 * (column + 1)) % 1009) as f64 / 1009.0;
        let features: Vec<f64> = (0..2000).flat_map(|idx| [value(idx, 0), value(idx, 1)]).collect();
        let targets = features.chunks(2).map(|row| f64::from(u8::from((row[0] > 0.5) == (row[1] > 0.5)))).collect();
        (features, targets)
    }

    fn params() -> BoostingParams {
        BoostingParams { n_rounds: 60, learning_rate: 0.3, max_depth: 4, ..BoostingParams::default() }
    }

    #[test]
    fn learns_classes_that_no_line_separates() {
        let (features, targets) = samples();
        let trees = train_boosted(&features, 2, &targets, &params(), 1).unwrap();
        trees.validate().unwrap();
        let right =
            features.chunks(2).zip(&targets).filter(|(row, y)| (trees.decision_value(row) > 0.0) == (**y > 0.5));
        assert!(right.count() > 1950);
        assert!(trees.decision_value(&[0.9, 0.9]) > 1.0 && trees.decision_value(&[0.9, 0.1]) < -1.0);
    }

    #[test]
    fn probabilities_are_learned_from_probabilities() {
        let (features, classes) = samples();
        let targets: Vec<f64> = classes.iter().map(|y| 0.2 + 0.6 * y).collect();
        let trees = train_boosted(&features, 2, &targets, &params(), 1).unwrap();
        let log_odds = (0.8_f64 / 0.2).ln();
        for (sample, expected) in [([0.9, 0.9], log_odds), ([0.9, 0.1], -log_odds)] {
            assert!((trees.decision_value(&sample) - expected).abs() < 0.2, "{}", trees.decision_value(&sample));
        }
        // Nothing is left to learn when all targets are the base.
        let trees = train_boosted(&features, 2, &[0.25; 2000], &params(), 1).unwrap();
        assert!((trees.decision_value(&[0.3, 0.3]) - (1.0_f64 / 3.0).ln()).abs() < 1e-6);
    }

    #[test]
    fn number_of_threads_and_rounds_change_no_tree() {
        let (features, targets) = samples();
        let grow = |n_threads, n_rounds| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            let params = BoostingParams { n_rounds, ..params() };
            pool.install(|| train_boosted(&features, 2, &targets, &params, 7)).unwrap()
        };
        let all = grow(1, 60);
        assert_eq!(all, grow(3, 60));
        assert_eq!(all.trees[..20], grow(2, 20).trees);
        assert_ne!(all, train_boosted(&features, 2, &targets, &params(), 8).unwrap());
    }

    #[test]
    fn one_class_and_few_samples_grow_valid_trees() {
        for targets in [vec![1.0], vec![0.0; 3], vec![0.0, 1.0]] {
            let features: Vec<f64> = (0..targets.len()).map(|idx| idx as f64).collect();
            let params = BoostingParams { lambda: 0.0, min_child_weight: 0.0, ..params() };
            train_boosted(&features, 1, &targets, &params, 1).unwrap().validate().unwrap();
        }
    }

    #[test]
    fn input_out_of_range_is_refused() {
        let error = |features: &[f64], targets: &[f64], params: &BoostingParams| {
            train_boosted(features, 2, targets, params, 1).unwrap_err()
        };
        assert!(matches!(error(&[1.0], &[1.0], &params()), BoostingError::Shape { .. }));
        assert!(matches!(error(&[], &[], &params()), BoostingError::Shape { .. }));
        assert_eq!(error(&[1.0, 1e39], &[1.0], &params()), BoostingError::Values);
        assert_eq!(error(&[1.0, f64::NAN], &[1.0], &params()), BoostingError::Values);
        assert_eq!(error(&[1.0, 1.0], &[1.5], &params()), BoostingError::Values);
        for bad in [
            BoostingParams { learning_rate: 0.0, ..params() },
            BoostingParams { subsample: 1.1, ..params() },
            BoostingParams { colsample_bynode: 0.0, ..params() },
            BoostingParams { min_child_weight: -1.0, ..params() },
            BoostingParams { lambda: f64::NAN, ..params() },
        ] {
            assert!(matches!(error(&[1.0, 1.0], &[1.0], &bad), BoostingError::Params { .. }), "{bad:?}");
        }
    }
}
