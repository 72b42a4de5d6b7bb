//! Texts and files with damage, which a parser reads or refuses.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::seeds::seeds;

/// Words that are at the edge of something.
const WORDS: [&str; 18] = [
    "",
    "-1",
    "0",
    "1e308",
    "1e-320",
    "nan",
    "inf",
    "4294967296",
    "18446744073709551616",
    "[",
    "{",
    "<a>",
    "<!--",
    "-->",
    "\\\n",
    "\u{feff}",
    "\0",
    ",",
];

/// A text with a few changes: bytes replaced, pieces cut out, repeated or moved, numbers replaced by words.
fn damaged(rng: &mut ChaCha8Rng, original: &[u8]) -> Vec<u8> {
    let mut bytes = original.to_vec();
    for _ in 0..rng.random_range(1..5) {
        if bytes.is_empty() {
            break;
        }
        let start = rng.random_range(0..bytes.len());
        let end = (start + rng.random_range(0..40)).min(bytes.len());
        match rng.random_range(0..6) {
            0 => bytes[start] = rng.random(),
            1 => drop(bytes.drain(start..end)),
            2 => {
                let piece = bytes[start..end].repeat(rng.random_range(1..2000));
                drop(bytes.splice(end..end, piece));
            }
            3 => bytes.truncate(start),
            4 => {
                let word = WORDS[rng.random_range(0..WORDS.len())].repeat(rng.random_range(1..50));
                drop(bytes.splice(start..end, word.into_bytes()));
            }
            _ => {
                let is_digit = |byte: &u8| byte.is_ascii_digit();
                let Some(first) = bytes[start..].iter().position(is_digit).map(|idx| start + idx) else { continue };
                let n_digits = bytes[first..].iter().take_while(|byte| is_digit(byte)).count();
                let word = WORDS[rng.random_range(0..WORDS.len())].bytes();
                drop(bytes.splice(first..first + n_digits, word));
            }
        }
    }
    bytes
}

/// Reads `n_cases` damaged versions of a file, and says how many of them are still read.
pub(crate) fn check(n_cases: u64, original: &[u8], mut is_read: impl FnMut(&[u8]) -> bool) {
    assert!(is_read(original), "the original is refused");
    let mut n_read = 0;
    let mut n_tried = 0;
    for seed in seeds(n_cases) {
        n_read += u64::from(is_read(&damaged(&mut ChaCha8Rng::seed_from_u64(seed), original)));
        n_tried += 1;
    }
    println!("{n_read} of {n_tried} damaged versions are read, the others refused");
    assert!(n_read < n_tried || n_tried == 1, "no damage was noticed");
}
