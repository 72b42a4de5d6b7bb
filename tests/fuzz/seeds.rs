//! The cases of the fuzz tests: the same in every check, unless others are asked for.

use std::time::{Duration, Instant, SystemTime};

/// Where the cases of a check begin.
const FIRST_SEED: u64 = 1;

/// The seeds of `n_cases` cases. `BLINDGRASP_FUZZ_SEED` says where to begin, `BLINDGRASP_FUZZ_SECS` to go on for so
/// long instead, and to begin anywhere if no seed is given.
pub(crate) fn seeds(n_cases: u64) -> impl Iterator<Item = u64> {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().expect("a number"));
    let limit = number("BLINDGRASP_FUZZ_SECS").map(Duration::from_secs);
    let first_seed = number("BLINDGRASP_FUZZ_SEED").unwrap_or_else(|| match limit {
        None => FIRST_SEED,
        Some(_) => SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("after 1970").as_nanos() as u64,
    });
    println!("BLINDGRASP_FUZZ_SEED={first_seed}");
    let begun = Instant::now();
    let is_to_go_on = move |n_done: &u64| match limit {
        None => *n_done < n_cases,
        // One in any case.
        Some(limit) => *n_done == 0 || begun.elapsed() < limit,
    };
    (0..).take_while(is_to_go_on).map(move |n_done| first_seed.wrapping_add(n_done))
}
