//! Times the stages of hands with few and with many cells, of which the same ten are active. One thread.
//!
//! `cargo bench --bench cells -- [--json] [--frames N] [--rounds N]` prints, for 100, 1,000 and 10,000 cells, the median
//! time per frame of the contacts stage and of the encoder behind it. `-- --only CELLS` stays with one hand, for profilers.
//! The hands have the links, joints and collision shapes of the Barrett hand, and four pads of many cells.

use std::fmt::Write;
use std::path::Path;
use std::time::Instant;

use blindgrasp_stages::contacts::ContactFinder;
use blindgrasp_stages::dictionary::Dictionary;
use blindgrasp_stages::encoder::{Block, FeatureExtractor, FeltReading};
use blindgrasp_stages::hand::{Hand, HandError};
use serde_json::{Value, json};

const N_CELLS: [usize; 3] = [100, 1_000, 10_000];
const N_PADS: usize = 4;
/// Active cells of each pad: ten in all.
const N_ACTIVE: [usize; N_PADS] = [1, 3, 3, 3];
/// The hand is nearly open, so that its links do not touch each other.
const JOINTS_RAD: [f64; 7] = [0.3, 0.9, 0.9, 0.9, 0.3, 0.3, 0.3];

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (mut as_json, mut n_frames, mut n_rounds, mut only) = (false, 2000, 21, None);
    while let Some(argument) = arguments.next() {
        let mut number = || anyhow::Ok(arguments.next().unwrap_or_default().parse::<usize>()?);
        match argument.as_str() {
            "--json" => as_json = true,
            "--frames" => n_frames = number()?,
            "--rounds" => n_rounds = number()?,
            "--only" => only = Some(number()?),
            // Cargo's own.
            "--bench" => {}
            _ => anyhow::bail!(
                "unknown argument '{argument}': expected --json, --frames N, --rounds N or --only CELLS, see benches/cells.rs"
            ),
        }
    }
    let sizes = only.map_or(N_CELLS.to_vec(), |n_cells| vec![n_cells]);
    let mut benches = sizes.iter().map(|n_cells| Bench::new(*n_cells)).collect::<Result<Vec<_>, _>>()?;
    // The hands take turns, so that another program's load falls on all of them.
    for _ in 0..n_rounds {
        benches.iter_mut().for_each(|bench| bench.run(n_frames));
    }
    let results: Vec<Value> = benches.iter_mut().map(Bench::result).collect();
    if as_json {
        println!("{}", json!({ "n_frames": n_frames, "n_rounds": n_rounds, "hands": results }));
        return Ok(());
    }
    println!("{:>8}{:>10}{:>17}{:>16}", "cells", "contacts", "contacts stage", "encoder");
    for result in &results {
        let micros = |stage: &str| format!("{:.2} µs", result[stage].as_f64().unwrap_or(f64::NAN));
        println!(
            "{:>8}{:>10}{:>17}{:>16}",
            result["n_cells"].to_string(),
            result["n_contacts"].to_string(),
            micros("contacts_us"),
            micros("encoder_us")
        );
    }
    Ok(())
}

struct Bench {
    hand: Hand,
    cells_newtons: Vec<f64>,
    finder: ContactFinder,
    extractor: FeatureExtractor,
    n_contacts: usize,
    contacts_us: Vec<f64>,
    encoder_us: Vec<f64>,
}

impl Bench {
    fn new(n_cells: usize) -> anyhow::Result<Self> {
        let hand = hand_of(n_cells)?;
        // Noise below the threshold of 0.05 N, and ten forces above it.
        let mut cells_newtons: Vec<f64> = (0..hand.n_cells()).map(|idx| 0.001 * (idx % 40) as f64).collect();
        for (pad, n_active) in hand.pads.iter().zip(N_ACTIVE) {
            for active_idx in 0..n_active {
                cells_newtons[pad.first_cell_idx + cell_idx(active_idx, pad.cells.len())] =
                    1.0 + 0.25 * active_idx as f64;
            }
        }
        let words_m = (0..64).map(f64::from).map(|x| [0.001 * x - 0.03, 0.05 - 0.001 * x, 0.0015 * x]).collect();
        let blocks = [Block::Histogram, Block::Pads, Block::Joints, Block::Breakaways];
        let extractor = FeatureExtractor::new(&hand, &blocks, Dictionary { words_m }, 0.03);
        Ok(Bench {
            hand,
            cells_newtons,
            finder: ContactFinder::default(),
            extractor,
            n_contacts: 0,
            contacts_us: Vec::new(),
            encoder_us: Vec::new(),
        })
    }

    fn run(&mut self, n_frames: usize) {
        let (mut contacts, mut values) = (Vec::with_capacity(64), Vec::with_capacity(256));
        let micros = |start: Instant| start.elapsed().as_secs_f64() * 1e6 / n_frames as f64;
        let start = Instant::now();
        for _ in 0..n_frames {
            let cells_newtons = std::hint::black_box(&self.cells_newtons);
            std::hint::black_box(self.finder.find(&self.hand, 0, &JOINTS_RAD, cells_newtons, &mut contacts));
        }
        self.contacts_us.push(micros(start));
        let start = Instant::now();
        for _ in 0..n_frames {
            let reading = FeltReading::new(&JOINTS_RAD, std::hint::black_box(&contacts));
            let n_pads = self.extractor.extract(&reading, &mut values);
            assert_eq!(std::hint::black_box(n_pads), Ok(N_PADS as u32));
        }
        self.encoder_us.push(micros(start));
        self.n_contacts = contacts.len();
    }

    fn result(&mut self) -> Value {
        json!({
            "n_cells": self.hand.n_cells(),
            "n_contacts": self.n_contacts,
            "contacts_us": median(&mut self.contacts_us),
            "encoder_us": median(&mut self.encoder_us),
        })
    }
}

fn median(times: &mut [f64]) -> Option<f64> {
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied()
}

/// Active cells lie far apart among the cells of a pad.
fn cell_idx(active_idx: usize, n_cells: usize) -> usize {
    (2 * active_idx + 1) * n_cells / 6
}

/// The Barrett hand with pads of other cells. The active ones are in the same places whatever the number of the others is.
fn hand_of(n_cells: usize) -> Result<Hand, HandError> {
    let n_of_pad = n_cells / N_PADS;
    let mut text = String::from(
        "format: blindgrasp-hand/1\nname: many-cells\nurdf: barrett-bh8-280.urdf\nreference_link: palm\n\
         joints: [spread, finger_1, finger_2, finger_3, distal_1, distal_2, distal_3]\npreshape_joints: [spread]\n\
         couplings:\n  - {joint: distal_1, follows: finger_1, ratio: 0.32}\n  - {joint: distal_2, follows: finger_2, ratio: 0.32}\n  \
         - {joint: distal_3, follows: finger_3, ratio: 0.32}\nedge_radius_m: 0.002\npads:\n",
    );
    for link in ["palm", "distal_1", "distal_2", "distal_3"] {
        let _ = writeln!(text, "  - {{name: {link}, link: {link}, layout: skin, noise_threshold_newtons: 0.05}}");
    }
    text += "layouts:\n  skin:\n";
    let active_idxs = [0, 1, 2].map(|active_idx| cell_idx(active_idx, n_of_pad));
    for idx in 0..n_of_pad {
        let (x_m, z_m) = match active_idxs.iter().position(|active| *active == idx) {
            Some(active_idx) => (0.02 + 0.005 * active_idx as f64, 0.0),
            None => (0.02 + 0.02 * idx as f64 / n_of_pad as f64, 0.005),
        };
        let _ = writeln!(
            text,
            "    - {{at_m: [{x_m}, 0.0095, {z_m}], normal: [0, 1, 0], along: [1, 0, 0], size_m: [0.001, 0.001]}}"
        );
    }
    Hand::parse(Path::new("many-cells.yaml"), &text, |_| Ok(include_str!("../hands/barrett-bh8-280.urdf").into()))
}
