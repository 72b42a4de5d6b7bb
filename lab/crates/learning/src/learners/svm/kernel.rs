//! The kernel matrix of the training samples, as much of it at a time as training needs.
//!
//! Samples stand in [`Panel`]s of columns of the matrix. A panel is worked on by one thread at a time and holds all
//! that belongs to its columns: features, gradient, and its part of the cached rows. So threads share nothing, and
//! every value is computed by itself: neither their number nor the size of the cache changes a bit.
//!
//! `‖x - z‖² = ‖x‖² + ‖z‖² - 2 x·z` leaves scalar products only, each feature of a sample meeting several samples'
//! while it is in a register. The difference cancels, so it is taken in double precision of features whose mean was
//! taken away. The kernel of samples x, z is then exact to some 1e-16 γ (‖x‖² + ‖z‖²). That is far below the single
//! precision it is kept in (as LIBSVM's is), unless γ times the spread of the features is in the millions.

use rayon::prelude::*;

use blindgrasp_stages::classifier::svm::lanes::{
    Aligned, InstructionSet, LANES, Lanes, for_instruction_set, rough_exp,
};

/// Lanes of samples that a unit of work holds: two registers' worth.
const GROUPS: usize = 2;
/// Samples in a block of columns.
pub(super) const BLOCK: usize = GROUPS * LANES;
/// Samples of a panel: its part of a cached row is a page, and its features of 64 fit into the second-level cache.
const PANEL: usize = 1024;
/// Cached rows whose memory is taken at once.
const ROWS_PER_CHUNK: usize = 64;
/// Rows whose contributions are added up in one pass over the gradient.
const ROWS_PER_PASS: usize = 8;

/// Samples in blocks of [`BLOCK`], feature by feature, with their squared norms.
pub(super) struct Columns {
    features: Vec<[Aligned; GROUPS]>,
    squared_norms: Vec<[Aligned; GROUPS]>,
    n_features: usize,
}

/// Samples that are rows of the kernel matrix.
pub(super) struct Rows {
    features: Vec<f64>,
    squared_norms: Vec<f64>,
}

impl Columns {
    fn new<'a>(samples: impl ExactSizeIterator<Item = &'a [f64]>, n_features: usize) -> Self {
        let zero = [Aligned([0.0; LANES]); GROUPS];
        let n_blocks = samples.len().div_ceil(BLOCK);
        let mut features = vec![zero; n_blocks * n_features];
        let mut squared_norms = vec![zero; n_blocks];
        for (idx, sample) in samples.enumerate() {
            let (block_idx, group, lane) = (idx / BLOCK, idx % BLOCK / LANES, idx % LANES);
            squared_norms[block_idx][group].0[lane] = squared_norm(sample);
            let block = &mut features[block_idx * n_features..][..n_features];
            block.iter_mut().zip(sample).for_each(|(column, &value)| column[group].0[lane] = value);
        }
        Self { features, squared_norms, n_features }
    }

    fn width(&self) -> usize {
        self.squared_norms.len() * BLOCK
    }
}

/// The sum that the kernel's scalar product of a sample with itself is, to the last bit where multiply-add is fused.
fn squared_norm(sample: &[f64]) -> f64 {
    sample.iter().fold(0.0, |sum, value| value.mul_add(*value, sum))
}

/// Kernel rows of the training samples, with the gradient that they are summed into.
pub(super) struct Kernel {
    /// Row-major, the mean of each feature taken away.
    centred: Vec<f64>,
    n_features: usize,
    gamma: f64,
    panels: Vec<Panel>,
    /// Where a sample's row is cached.
    slot_of_sample: Vec<Option<usize>>,
    slots: Vec<Slot>,
    max_slots: usize,
    n_requests: u64,
    instruction_set: InstructionSet,
}

struct Slot {
    sample_idx: usize,
    last_request: u64,
}

struct Panel {
    columns: Columns,
    /// `Σ_j K_ij β_j` of its samples.
    sums: Vec<f64>,
    /// Its part of the cached rows, [`ROWS_PER_CHUNK`] to a chunk.
    cache: Vec<Vec<f32>>,
    scratch: Vec<f32>,
}

/// A row to be added: its weight, where it is cached, and its place among the rows to be computed first.
#[derive(Clone, Copy)]
struct Request {
    weight: f64,
    slot: Option<usize>,
    to_compute: Option<usize>,
}

impl Kernel {
    /// Of samples (row-major), with at most `cache_bytes` of cached rows.
    pub(super) fn new(features: &[f64], n_features: usize, gamma: f64, cache_bytes: usize) -> Self {
        let n_samples = features.len() / n_features;
        let mut means = vec![0.0; n_features];
        for sample in features.chunks_exact(n_features) {
            means.iter_mut().zip(sample).for_each(|(mean, value)| *mean += value / n_samples as f64);
        }
        let mut centred = features.to_vec();
        for sample in centred.chunks_exact_mut(n_features) {
            sample.iter_mut().zip(&means).for_each(|(value, mean)| *value -= mean);
        }
        let panels: Vec<Panel> = centred
            .par_chunks(PANEL * n_features)
            .map(|samples| {
                let columns = Columns::new(samples.chunks_exact(n_features), n_features);
                let sums = vec![0.0; columns.width()];
                Panel { columns, sums, cache: Vec::new(), scratch: Vec::new() }
            })
            .collect();
        let row_bytes = panels.iter().map(|panel| panel.columns.width() * size_of::<f32>()).sum::<usize>();
        Self {
            centred,
            n_features,
            gamma,
            panels,
            slot_of_sample: vec![None; n_samples],
            slots: Vec::new(),
            max_slots: cache_bytes / row_bytes,
            n_requests: 0,
            instruction_set: InstructionSet::detect(),
        }
    }

    /// Whether no squared norm overflows.
    pub(super) fn is_finite(&self) -> bool {
        self.centred.chunks_exact(self.n_features).all(|sample| squared_norm(sample).is_finite())
    }

    fn sample(&self, sample_idx: usize) -> &[f64] {
        &self.centred[sample_idx * self.n_features..][..self.n_features]
    }

    fn rows(&self, sample_idxs: &[usize]) -> Rows {
        Rows {
            features: sample_idxs.iter().flat_map(|&idx| self.sample(idx)).copied().collect(),
            squared_norms: sample_idxs.iter().map(|&idx| squared_norm(self.sample(idx))).collect(),
        }
    }

    /// The kernel among some samples, row by row, and the length of a row in memory: a multiple of [`BLOCK`], 0 beyond
    /// the last sample.
    pub(super) fn among(&self, sample_idxs: &[usize]) -> (Vec<f32>, usize) {
        let columns = Columns::new(sample_idxs.iter().map(|&idx| self.sample(idx)), self.n_features);
        let width = columns.width();
        let mut values = vec![0.0; sample_idxs.len() * width];
        const ROWS_PER_TASK: usize = 32;
        values.par_chunks_mut(ROWS_PER_TASK * width).zip(sample_idxs.par_chunks(ROWS_PER_TASK)).for_each(
            |(values, row_idxs)| {
                let mut out: Vec<&mut [f32]> = values.chunks_exact_mut(width).collect();
                kernel_rows(self.instruction_set, &columns, &self.rows(row_idxs), self.gamma, &mut out);
                out.into_iter().for_each(|row| row[sample_idxs.len()..].fill(0.0));
            },
        );
        (values, width)
    }

    /// Adds `Σ_j weight_j K_ij` to the sum of every sample i.
    pub(super) fn add_rows(&mut self, rows: &[(usize, f64)]) {
        self.n_requests += 1;
        let mut to_compute = Vec::new();
        let n_misses = rows.iter().filter(|(sample_idx, _)| self.slot_of_sample[*sample_idx].is_none()).count();
        for &(sample_idx, _) in rows {
            if let Some(slot_idx) = self.slot_of_sample[sample_idx] {
                self.slots[slot_idx].last_request = self.n_requests;
            }
        }
        let mut free_slots = self.free_slots(n_misses).into_iter();
        let requests: Vec<Request> = rows
            .iter()
            .map(|&(sample_idx, weight)| {
                if let Some(slot) = self.slot_of_sample[sample_idx] {
                    return Request { weight, slot: Some(slot), to_compute: None };
                }
                let slot = free_slots.next();
                if let Some(slot_idx) = slot {
                    self.slots[slot_idx] = Slot { sample_idx, last_request: self.n_requests };
                    self.slot_of_sample[sample_idx] = slot;
                }
                to_compute.push(sample_idx);
                Request { weight, slot, to_compute: Some(to_compute.len() - 1) }
            })
            .collect();
        let to_compute = self.rows(&to_compute);
        let (instruction_set, gamma, n_slots) = (self.instruction_set, self.gamma, self.slots.len());
        self.panels.par_iter_mut().for_each(|panel| {
            panel.make_room(n_slots);
            for requests in requests.chunks(ROWS_PER_PASS) {
                panel.add_rows(instruction_set, requests, &to_compute, gamma);
            }
        });
    }

    /// `Σ_j K_ij β_j` of every sample, in order.
    pub(super) fn sums(&self) -> impl Iterator<Item = f64> {
        self.panels.iter().flat_map(|panel| panel.sums.iter().copied()).take(self.slot_of_sample.len())
    }

    /// Up to `n` slots for new rows: new ones while there is room, then those not asked for for longest, but none of
    /// the present request.
    fn free_slots(&mut self, n: usize) -> Vec<usize> {
        let n_new = n.min(self.max_slots - self.slots.len());
        let first_new = self.slots.len();
        self.slots.extend((0..n_new).map(|_| Slot { sample_idx: 0, last_request: self.n_requests }));
        let mut free: Vec<usize> = (first_new..first_new + n_new).collect();
        if n > n_new {
            let mut old: Vec<usize> =
                (0..first_new).filter(|&slot_idx| self.slots[slot_idx].last_request < self.n_requests).collect();
            old.sort_by_key(|&slot_idx| self.slots[slot_idx].last_request);
            old.truncate(n - n_new);
            old.iter().for_each(|&slot_idx| self.slot_of_sample[self.slots[slot_idx].sample_idx] = None);
            free.append(&mut old);
        }
        free
    }
}

impl Panel {
    fn make_room(&mut self, n_slots: usize) {
        while self.cache.len() * ROWS_PER_CHUNK < n_slots {
            self.cache.push(vec![0.0; ROWS_PER_CHUNK * self.columns.width()]);
        }
    }

    /// Adds up to [`ROWS_PER_PASS`] rows, which lie in the cache or, where it has no room for them, in `scratch`.
    fn add_rows(&mut self, instruction_set: InstructionSet, requests: &[Request], all: &Rows, gamma: f64) {
        let width = self.columns.width();
        let n_features = self.columns.n_features;
        self.scratch.resize(ROWS_PER_PASS * width, 0.0);
        let to_compute: Vec<&Request> = requests.iter().filter(|request| request.to_compute.is_some()).collect();
        if !to_compute.is_empty() {
            let row_idxs: Vec<usize> = to_compute.iter().filter_map(|request| request.to_compute).collect();
            let rows = Rows {
                features: row_idxs
                    .iter()
                    .flat_map(|&idx| &all.features[idx * n_features..][..n_features])
                    .copied()
                    .collect(),
                squared_norms: row_idxs.iter().map(|&idx| all.squared_norms[idx]).collect(),
            };
            let mut out: Vec<&mut [f32]> = self.scratch.chunks_exact_mut(width).take(row_idxs.len()).collect();
            kernel_rows(instruction_set, &self.columns, &rows, gamma, &mut out);
            for (request, row) in to_compute.iter().zip(out) {
                if let Some(slot) = request.slot {
                    self.cache[slot / ROWS_PER_CHUNK][slot % ROWS_PER_CHUNK * width..][..width].copy_from_slice(row);
                }
            }
        }
        let mut n_scratch = 0;
        let mut rows: [&[f32]; ROWS_PER_PASS] = [&self.scratch[..width]; ROWS_PER_PASS];
        let mut weights = [0.0; ROWS_PER_PASS];
        for ((row, weight), request) in rows.iter_mut().zip(&mut weights).zip(requests) {
            *weight = request.weight;
            *row = match request.slot {
                _ if request.to_compute.is_some() => {
                    n_scratch += 1;
                    &self.scratch[(n_scratch - 1) * width..][..width]
                }
                Some(slot) => &self.cache[slot / ROWS_PER_CHUNK][slot % ROWS_PER_CHUNK * width..][..width],
                None => continue,
            };
        }
        add_weighted(instruction_set, &rows, &weights, &mut self.sums);
    }
}

for_instruction_set! {
    /// `out[i][j] = exp(-gamma ‖row_i - column_j‖²)`.
    fn kernel_rows(columns: &Columns, rows: &Rows, gamma: f64, out: &mut [&mut [f32]]) = kernel_rows_body
}

#[inline(always)]
fn kernel_rows_body(columns: &Columns, rows: &Rows, gamma: f64, out: &mut [&mut [f32]]) {
    let n_features = columns.n_features;
    let mut done = 0;
    while done < out.len() {
        let (features, squared_norms) = (&rows.features[done * n_features..], &rows.squared_norms[done..]);
        let out = &mut out[done..];
        if out.len() >= 2 {
            kernel_tiles::<2>(columns, features, squared_norms, gamma, out);
            done += 2;
        } else {
            kernel_tiles::<1>(columns, features, squared_norms, gamma, out);
            done += 1;
        }
    }
}

/// The first `N` rows. Their scalar products with a block of columns stay in registers.
#[inline(always)]
fn kernel_tiles<const N: usize>(
    columns: &Columns,
    features: &[f64],
    squared_norms: &[f64],
    gamma: f64,
    out: &mut [&mut [f32]],
) {
    let n_features = columns.n_features;
    let rows: [&[f64]; N] = std::array::from_fn(|row| &features[row * n_features..][..n_features]);
    let minus_gamma = Lanes::splat(-gamma);
    let blocks = columns.features.chunks_exact(n_features).zip(&columns.squared_norms).enumerate();
    for (block_idx, (block, column_norms)) in blocks {
        let mut products = [[Lanes::splat(0.0); GROUPS]; N];
        for (feature_idx, column) in block.iter().enumerate() {
            let column: [Lanes; GROUPS] = [Lanes::load(&column[0].0), Lanes::load(&column[1].0)];
            for row in 0..N {
                let value = Lanes::splat(rows[row][feature_idx]);
                products[row][0] = value.multiply_add(column[0], products[row][0]);
                products[row][1] = value.multiply_add(column[1], products[row][1]);
            }
        }
        for row in 0..N {
            let out = out[row][block_idx * BLOCK..][..BLOCK].as_chunks_mut::<LANES>().0;
            for group in 0..GROUPS {
                let norms = Lanes::splat(squared_norms[row]).add(Lanes::load(&column_norms[group].0));
                let squared =
                    products[row][group].negated_multiply_add(Lanes::splat(2.0), norms).max(Lanes::splat(0.0));
                rough_exp(squared.multiply(minus_gamma)).store_f32(&mut out[group]);
            }
        }
    }
}

for_instruction_set! {
    /// `sums[j] += Σ_i weights[i] rows[i][j]`, in the order of i.
    fn add_weighted(rows: &[&[f32]; ROWS_PER_PASS], weights: &[f64; ROWS_PER_PASS], sums: &mut [f64]) = add_weighted_body
}

#[inline(always)]
fn add_weighted_body(rows: &[&[f32]; ROWS_PER_PASS], weights: &[f64; ROWS_PER_PASS], sums: &mut [f64]) {
    let weights: [Lanes; ROWS_PER_PASS] = weights.map(Lanes::splat);
    let rows: [&[[f32; LANES]]; ROWS_PER_PASS] = rows.map(|row| row.as_chunks().0);
    for (idx, sums) in sums.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        let mut sum = Lanes::load(sums);
        for row in 0..ROWS_PER_PASS {
            sum = Lanes::load_f32(&rows[row][idx]).multiply_add(weights[row], sum);
        }
        sum.store(sums);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn samples(n_samples: usize, n_features: usize) -> Vec<f64> {
        (0..n_samples * n_features).map(|idx| (0.7 * idx as f64).sin() + 0.3).collect()
    }

    fn expected(features: &[f64], n_features: usize, gamma: f64, i: usize, j: usize) -> f64 {
        let sample = |idx: usize| &features[idx * n_features..][..n_features];
        let squared: f64 = sample(i).iter().zip(sample(j)).map(|(x, z)| (x - z) * (x - z)).sum();
        (-gamma * squared).exp()
    }

    #[test]
    fn values_are_the_kernel_rounded_to_single_precision() {
        for (n_samples, n_features) in [(5, 1), (40, 3), (17, 64)] {
            let features = samples(n_samples, n_features);
            for instruction_set in InstructionSet::available() {
                let mut kernel = Kernel::new(&features, n_features, 0.1, 0);
                kernel.instruction_set = instruction_set;
                let all: Vec<usize> = (0..n_samples).collect();
                let (values, width) = kernel.among(&all);
                for i in 0..n_samples {
                    for j in 0..n_samples {
                        let value = f64::from(values[i * width + j]);
                        let expected = expected(&features, n_features, 0.1, i, j);
                        assert!((value - expected).abs() < 3.1e-8, "{instruction_set:?} {value} {expected}");
                    }
                    assert_eq!(values[i * width + i], 1.0);
                }
            }
        }
    }

    #[test]
    fn sums_are_those_of_the_rows_whatever_is_cached() {
        let (n_samples, n_features, gamma) = (PANEL + 30, 3, 0.4);
        let features = samples(n_samples, n_features);
        let row_bytes = n_samples.next_multiple_of(BLOCK) * size_of::<f32>();
        let requests: [&[usize]; 4] = [&[0, 5, 9], &[5, 1050, 7, 9, 2, 3, 4, 11, 12, 13], &[9, 0], &[1, 5, 6]];
        for n_cached in [0, 1, 2, 5, 100] {
            let mut kernel = Kernel::new(&features, n_features, gamma, n_cached * row_bytes);
            let mut beta = vec![0.0; n_samples];
            for request in requests {
                let weights: Vec<(usize, f64)> = request.iter().map(|&idx| (idx, 0.5 - 0.01 * idx as f64)).collect();
                kernel.add_rows(&weights);
                weights.iter().for_each(|(idx, weight)| beta[*idx] += weight);
                let n_kept = kernel.slot_of_sample.iter().flatten().count();
                assert!(n_kept <= n_cached, "{n_kept} rows of {n_cached}");
                for (i, sum) in kernel.sums().enumerate() {
                    let expected: f64 =
                        (0..n_samples).map(|j| beta[j] * expected(&features, n_features, gamma, i, j)).sum();
                    assert!((sum - expected).abs() < 1e-5, "{n_cached} rows cached: sum {i} is {sum}, not {expected}");
                }
            }
        }
    }
}
