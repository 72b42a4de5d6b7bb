//! How many attempts a judge would need that is never wrong: the bound of every gate, and the worth of choosing among approaches.
//!
//! `perfect_judge MODEL OBJECTS SEED N_TRIALS N_APPROACHES…` lifts every attempt at an object (as `blindgrasp trials --objects` names
//! them) until one is kept, at most 20 times. It prints a line for each number of approaches from which the model's prior chooses; 1
//! is at random. It runs on all cores.

use std::path::Path;

use anyhow::Context;
use blindgrasp_simulator::trial::targets::{target_of_trial, targets_named};
use blindgrasp_simulator::trial::{Attempt, LiftTarget, ProbeMove, TrialOptions, choose_start, sensor_seed};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use rayon::prelude::*;

const MOST_ATTEMPTS: u32 = 20;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, objects, seed, n_trials, n_approaches @ ..] = &arguments[..] else {
        anyhow::bail!("usage: perfect_judge MODEL OBJECTS SEED N_TRIALS N_APPROACHES…");
    };
    let model = Model::load(Path::new(model))?;
    let hand = Hand::load(Path::new(&model.hand.name))?;
    let prior = model.approach.context("the model knows nothing of approaches")?;
    let (things, seed, n_trials) = (targets_named(objects)?, seed.parse::<u64>()?, n_trials.parse::<u64>()?);
    println!("approaches  first kept  attempts per kept  given up");
    for n_approaches in n_approaches {
        let mut options = TrialOptions::default();
        options.protocol.n_approaches = n_approaches.parse()?;
        let ended: anyhow::Result<Vec<Option<u32>>> = (0..n_trials)
            .into_par_iter()
            .map(|trial| {
                let thing = target_of_trial(&things, trial).context("no object")?;
                kept_at(&hand, thing, &options, &prior, seed, trial)
            })
            .collect();
        let ended = ended?;
        let n_kept = ended.iter().flatten().count();
        let n_attempts: u32 = ended.iter().map(|kept_at| kept_at.map_or(MOST_ATTEMPTS, |attempt| attempt + 1)).sum();
        println!(
            "{n_approaches:>10} {:>11} {:>18.2} {:>9}",
            ended.iter().flatten().filter(|attempt| **attempt == 0).count(),
            f64::from(n_attempts) / n_kept as f64,
            ended.len() - n_kept
        );
    }
    Ok(())
}

/// The attempt that kept the object, if one did.
fn kept_at(
    hand: &Hand,
    thing: &LiftTarget,
    options: &TrialOptions,
    prior: &ApproachPrior,
    seed: u64,
    trial: u64,
) -> anyhow::Result<Option<u32>> {
    for number in 0..MOST_ATTEMPTS {
        let start = choose_start(hand, thing, options, Some(prior), seed, trial, number)?;
        let mut attempt = Attempt::begin(hand, thing, options, &start, sensor_seed(seed, trial, number))?;
        while attempt.next_frame(0).is_some() {}
        attempt.probe(ProbeMove::TestLift);
        while attempt.next_frame(0).is_some() {}
        if attempt.lift(|_| {}).held {
            return Ok(Some(number));
        }
    }
    Ok(None)
}
