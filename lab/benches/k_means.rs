//! Times K-means over contact positions, for `scripts/benchsuite k-means`, which times scikit-learn's beside it.
//!
//! `cargo bench -p blindgrasp-lab --bench k_means -- contacts N OUT RECORDING …` writes the first N contact positions of the
//! grasps of recordings, taken as training takes them, as little-endian doubles x, y, z. `-- learn POSITIONS N_CLUSTERS N_INIT
//! TOLERANCE MAX_ITER SEED` learns words from such a file. Results are lines of JSON on stdout.

use std::path::Path;
use std::time::Instant;

use blindgrasp_grasps::dataset::{hand_of, read_grasps};
use blindgrasp_learning::learners::k_means::{KMeansParams, learn_dictionary};
use blindgrasp_messages::Phase;
use blindgrasp_stages::contacts::contacts_from_frame;
use serde_json::json;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["contacts", n, out, ref recordings @ ..] => write_contacts(n.parse()?, out, recordings),
        ["learn", positions, n_clusters, n_init, tolerance, max_iter, seed] => {
            let params = KMeansParams {
                n_clusters: n_clusters.parse()?,
                n_init: n_init.parse()?,
                max_iter: max_iter.parse()?,
                tolerance: tolerance.parse()?,
                seed: seed.parse()?,
            };
            time_learning(positions, &params)
        }
        [] => {
            eprintln!("run by scripts/benchsuite k-means");
            Ok(())
        }
        _ => Err(format!("unknown arguments {arguments:?}: see the top of lab/benches/k_means.rs").into()),
    }
}

fn write_contacts(n_wanted: usize, out: &str, recordings: &[&str]) -> Result<(), Failure> {
    let mut bytes = Vec::new();
    let (mut n_written, mut contacts) = (0, Vec::new());
    for recording in recordings.iter().map(Path::new) {
        let hand = hand_of(recording, None)?;
        read_grasps(recording, &hand, |_, frames| {
            let Some(frame) = frames.into_iter().find(|frame| frame.message.phase == Phase::Settled) else { return };
            let (joints, cells) = (&frame.message.joints, &frame.message.cells_newtons);
            contacts_from_frame(&hand, frame.header.hand_id, joints, cells, &mut contacts);
            for contact in contacts.iter().take(n_wanted - n_written) {
                bytes.extend(contact.position_m.iter().flat_map(|coordinate| coordinate.to_le_bytes()));
                n_written += 1;
            }
        })?;
    }
    std::fs::write(out, bytes)?;
    println!("{}", json!({ "n_positions": n_written }));
    Ok(())
}

fn time_learning(positions: &str, params: &KMeansParams) -> Result<(), Failure> {
    let bytes = std::fs::read(positions)?;
    let positions_m: Vec<[f64; 3]> = bytes
        .as_chunks::<24>()
        .0
        .iter()
        .map(|row| std::array::from_fn(|axis| f64::from_le_bytes(std::array::from_fn(|idx| row[8 * axis + idx]))))
        .collect();
    let start = Instant::now();
    let learned = learn_dictionary(&positions_m, params)?;
    let secs = start.elapsed().as_secs_f64();
    println!(
        "{}",
        json!({
            "secs": secs,
            "inertia": learned.inertia,
            "n_iter": learned.n_iter,
            "n_threads": rayon::current_num_threads(),
            "words_m": learned.dictionary.words_m,
        })
    );
    Ok(())
}
