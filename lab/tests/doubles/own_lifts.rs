//! What a robot's own lifts are worth to a model: the figures of docs/results.md, "Own lifts".
//!
//! `own_lifts MODEL live|adapt|scratch N_ORDERS N_OUTCOMES,… RECORDING…` takes recordings of one robot whose grasps were all lifted.
//! In each order half of the objects, drawn at random, give outcomes. After so many the grasps of the other half are decided.
//!
//! * `live`: as a graph with `classifier.adapt=on` learns, of the grasps that its gate lifts.
//! * `adapt`: as `blindgrasp model adapt` learns, of the first grasps, each lifted whatever the gate would say.
//! * `scratch`: a model that was trained on the same grasps alone.
//!
//! `own_lifts MODEL changed N_ORDERS N_BEFORE,… GAIN RECORDING… -- OTHER…` says after how many grasps of `OTHER`, with cells that read so
//! many times as much, the change from `RECORDING` is noticed, and how often one is noticed within `RECORDING`. Each grasp counts
//! as a lift.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context;
use blindgrasp_grasps::dataset::{hand_of, read_grasps};
use blindgrasp_learning::training::{Aim, Examples, TrainingOptions, adapt_on, train};
use blindgrasp_messages::{Action, GraspTruth, Header, Phase, Stamped, TactileFrame};
use blindgrasp_stages::own_lifts::Adapt;
use blindgrasp_stages::promise_monitor::drops_at_most;
use blindgrasp_stages::{ArbiterOptions, Hand, Judge, Model, Probe};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

struct Grasp {
    frames: Vec<Stamped<TactileFrame>>,
    truth: GraspTruth,
}

/// Sums over orders, at one number of outcomes.
#[derive(Default, Clone, Copy)]
struct Sums {
    n_outcomes: usize,
    n_lifted: usize,
    n_kept: usize,
    n_stable: usize,
    at_most: f64,
}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, which, n_orders, numbers, recordings @ ..] = &arguments[..] else {
        anyhow::bail!("usage: own_lifts MODEL live|adapt|scratch N_ORDERS N_OUTCOMES,… RECORDING…");
    };
    let model = Model::load(Path::new(model))?;
    if which == "changed" {
        return changed(model, n_orders.parse()?, numbers, recordings);
    }
    let recordings: Vec<PathBuf> = recordings.iter().map(PathBuf::from).collect();
    let hand = hand_of(recordings.first().context("no recording")?, None)?;
    let numbers: Vec<usize> = numbers.split(',').map(str::parse).collect::<Result<_, _>>()?;
    let grasps = read(&recordings, &hand)?;
    let of_order = |seed: u64| -> anyhow::Result<Vec<Sums>> {
        let options = ArbiterOptions { probe: Probe::TestLift, ..ArbiterOptions::default() };
        let judge = |model: Model| Judge::with_options(hand.clone(), model, options);
        if which == "live" {
            return Ok(Robot { judge: judge(model.clone())?, n_grasps: 0 }.learn(&grasps, &numbers, seed));
        }
        let (own, others) = halves(&grasps, seed);
        let of_number = |number: &usize| -> anyhow::Result<Sums> {
            let own = own.iter().take(*number).map(|grasp| (grasp.frames.clone(), grasp.truth.clone()));
            let examples = Examples::of_grasps(&hand, own)?;
            let training = TrainingOptions { aim: Some(Aim::DropSecs(300.0)), ..TrainingOptions::default() };
            let model = match which.as_str() {
                "scratch" => train(&hand, &examples, &[], &training, |_| {})?,
                _ if *number == 0 => model.clone(),
                // So few grasps may have too few that can be judged: then the model stays.
                _ => adapt_on(&hand, &model, &examples, &[]).unwrap_or(model.clone()),
            };
            let judged = Robot { judge: judge(model)?, n_grasps: 0 }.judge_all(&others);
            Ok(Sums { n_outcomes: examples.examples.len(), ..judged })
        };
        numbers.iter().map(of_number).collect()
    };
    let orders: anyhow::Result<Vec<Vec<Sums>>> = (0..n_orders.parse()?).into_par_iter().map(of_order).collect();
    let orders = orders?;
    println!("outcomes  (mean)  lifts  kept  of lifts  recall  promise");
    for (idx, number) in numbers.iter().enumerate() {
        let of = |part: fn(&Sums) -> f64| orders.iter().map(|order| part(&order[idx])).sum::<f64>();
        let (n_lifted, n_kept) = (of(|sums| sums.n_lifted as f64), of(|sums| sums.n_kept as f64));
        let n = orders.len() as f64;
        println!(
            "{number:>8} {:>7.1} {:>6.1} {:>5.1} {:>7.1} % {:>7.3} {:>6.1} %",
            of(|sums| sums.n_outcomes as f64) / n,
            n_lifted / n,
            n_kept / n,
            100.0 * n_kept / n_lifted,
            n_kept / of(|sums| sums.n_stable as f64),
            100.0 * of(|sums| sums.at_most) / n
        );
    }
    Ok(())
}

fn read(recordings: &[PathBuf], hand: &Hand) -> anyhow::Result<Vec<Grasp>> {
    let mut grasps = Vec::new();
    for path in recordings {
        let read = read_grasps(path, hand, |_, frames| frames)?;
        grasps.extend(read.into_iter().filter_map(|grasp| Some(Grasp { frames: grasp.value, truth: grasp.truth? })));
    }
    Ok(grasps)
}

/// Grasps of another hand or skin after those of a robot.
fn changed(model: Model, n_orders: u64, numbers: &str, arguments: &[String]) -> anyhow::Result<()> {
    let [gain, recordings @ ..] = arguments else { anyhow::bail!("no gain") };
    let (gain, split) = (gain.parse::<f64>()?, recordings.iter().position(|word| word == "--").context("no --")?);
    let paths = |words: &[String]| words.iter().map(PathBuf::from).collect::<Vec<_>>();
    let (own, other) = (paths(&recordings[..split]), paths(&recordings[split + 1..]));
    let hand = hand_of(own.first().context("no recording")?, None)?;
    let (own, mut other) = (read(&own, &hand)?, read(&other, &hand)?);
    for frame in other.iter_mut().flat_map(|grasp| &mut grasp.frames) {
        frame.message.cells_newtons.iter_mut().for_each(|newtons| *newtons *= gain);
    }
    let robot = |n_grasps| -> anyhow::Result<Robot> {
        let mut judge = Judge::new(hand.clone(), model.clone())?;
        judge.adapt(Adapt::On);
        Ok(Robot { judge, n_grasps })
    };
    let shuffled = |grasps: &'_ [Grasp], seed: u64| {
        let mut idxs: Vec<usize> = (0..grasps.len()).collect();
        idxs.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        idxs
    };
    let (mut n_false, mut n_all) = (0, 0);
    for order in 0..n_orders {
        let mut robot = robot(0)?;
        for idx in shuffled(&own, order) {
            robot.lift(&own[idx]);
        }
        (n_false, n_all) = (n_false + robot.judge.own_lifts().n_changes(), n_all + own.len());
    }
    println!("noticed without a change: {n_false} times in {n_all} grasps");
    for number in numbers.split(',') {
        let n_before: usize = number.parse()?;
        let mut waited = Vec::new();
        for order in 0..n_orders {
            let mut robot = robot(0)?;
            for idx in shuffled(&own, order).into_iter().take(n_before) {
                robot.lift(&own[idx]);
            }
            let n_changes = robot.judge.own_lifts().n_changes();
            let noticed = shuffled(&other, 1000 + order).into_iter().position(|idx| {
                robot.lift(&other[idx]);
                robot.judge.own_lifts().n_changes() > n_changes
            });
            waited.push(noticed.map_or(usize::MAX, |idx| idx + 1));
        }
        waited.sort_unstable();
        let part = |share: usize| waited[(waited.len() * share / 100).min(waited.len() - 1)];
        let n_missed = waited.iter().filter(|n| **n == usize::MAX).count();
        println!(
            "after {n_before} grasps: {} in the median, {} in nine of ten, missed in {n_missed}",
            part(50),
            part(90)
        );
    }
    Ok(())
}

/// The grasps of half of the objects in random order, and those of the others.
fn halves(grasps: &[Grasp], seed: u64) -> (Vec<&Grasp>, Vec<&Grasp>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let objects: BTreeSet<&String> = grasps.iter().map(|grasp| &grasp.truth.object).collect();
    let mut objects: Vec<&String> = objects.into_iter().collect();
    objects.shuffle(&mut random);
    let own: BTreeSet<&String> = objects[..objects.len() / 2].iter().copied().collect();
    let (mut own, others): (Vec<&Grasp>, Vec<&Grasp>) =
        grasps.iter().partition(|grasp| own.contains(&grasp.truth.object));
    own.shuffle(&mut random);
    (own, others)
}

struct Robot {
    judge: Judge,
    n_grasps: u64,
}

impl Robot {
    fn learn(mut self, grasps: &[Grasp], numbers: &[usize], seed: u64) -> Vec<Sums> {
        let (own, others) = halves(grasps, seed);
        let mut own = own.into_iter();
        let [mut n_kept, mut n_dropped] = [0, 0];
        let mut found = Vec::new();
        for number in numbers {
            self.judge.adapt(Adapt::On);
            while n_kept + n_dropped < *number as u64
                && let Some(grasp) = own.next()
            {
                if self.decide(grasp) {
                    self.report(grasp);
                    *(if grasp.truth.stable { &mut n_kept } else { &mut n_dropped }) += 1;
                }
            }
            self.judge.adapt(Adapt::Frozen);
            let (n_outcomes, at_most) = ((n_kept + n_dropped) as usize, drops_at_most(n_kept, n_dropped));
            found.push(Sums { n_outcomes, at_most, ..self.judge_all(&others) });
        }
        found
    }

    fn judge_all(&mut self, grasps: &[&Grasp]) -> Sums {
        let mut sums = Sums::default();
        for grasp in grasps {
            let is_lifted = self.decide(grasp);
            sums.n_lifted += usize::from(is_lifted);
            sums.n_kept += usize::from(is_lifted && grasp.truth.stable);
            sums.n_stable += usize::from(grasp.truth.stable);
        }
        sums
    }

    fn lift(&mut self, grasp: &Grasp) {
        self.decide(grasp);
        self.report(grasp);
    }

    /// Whether the grasp is lifted: its frames as a source of their own that begins with them.
    fn decide(&mut self, grasp: &Grasp) -> bool {
        self.n_grasps += 1;
        let frames = grasp.frames.iter().filter(|frame| frame.message.phase != Phase::Lifting);
        let mut is_lifted = false;
        for (seq, frame) in frames.enumerate() {
            let header = Header { seq: seq as u64, epoch: self.n_grasps, ..frame.header };
            let message = TactileFrame { grasp_id: self.n_grasps, ..frame.message.clone() };
            let judged = self.judge.sample(&Stamped { header, message });
            is_lifted |= judged.decisions.iter().any(|decision| decision.action == Action::Lift);
        }
        is_lifted
    }

    /// Reports how the lift of the grasp that was decided last ended.
    fn report(&mut self, grasp: &Grasp) {
        let Some(last) = grasp.frames.last() else { return };
        let phase = if grasp.truth.stable { Phase::Kept } else { Phase::Dropped };
        let header = Header { seq: u64::MAX, epoch: self.n_grasps, ..last.header };
        let message = TactileFrame { grasp_id: self.n_grasps, phase, ..last.message.clone() };
        self.judge.sample(&Stamped { header, message });
    }
}
