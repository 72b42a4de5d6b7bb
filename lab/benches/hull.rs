//! Times our 6-D hull on the wrenches of simulated grasps, one thread.
//!
//! `cargo bench -p blindgrasp-lab --bench hull -- [--json] [--grasps N] [--seed N]` prints the machine and the time per hull. `--
//! --serve` is for `scripts/benchsuite hull`, which times Qhull beside it. It prints the wrenches, grasp by grasp, as one line of
//! JSON, then answers each line `FIRST END` with the times and qualities of those grasps.

use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use blindgrasp_objects::select;
use blindgrasp_simulator::hull::{Hull, HullError, convex_hull};
use blindgrasp_simulator::simulator::{SimulatorOptions, simulate_all};
use blindgrasp_simulator::wrench_space::{GraspCase, wrenches};
use blindgrasp_stages::hand::Hand;
use serde_json::{Value, json};

/// Each hull is timed this often; its time is the least of them, the rest is other programs'.
const N_REPEATS: usize = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (mut as_json, mut serve, mut n_grasps, mut seed) = (false, false, 1000, 0);
    while let Some(argument) = arguments.next() {
        let mut number =
            || arguments.next().ok_or(format!("{argument} needs a number"))?.parse::<u64>().map_err(|e| e.to_string());
        match argument.as_str() {
            "--json" => as_json = true,
            "--serve" => serve = true,
            "--grasps" => n_grasps = number()?,
            "--seed" => seed = number()?,
            // Cargo's own.
            "--bench" => {}
            _ => {
                return Err(
                    format!("unknown argument '{argument}': expected --json, --serve, --grasps N or --seed N").into()
                );
            }
        }
    }
    let cases = simulated_cases(n_grasps as usize, seed)?;
    if serve { answer(&cases) } else { report(&cases, as_json) }
}

/// The grasps that blind exploration brings, stable or not, with at least two contacts: what the simulator judges.
fn simulated_cases(n_grasps: usize, seed: u64) -> Result<Vec<GraspCase>, Box<dyn std::error::Error>> {
    let hand = Hand::load(Path::new("barrett-bh8-280"))?;
    let objects = select("all")?;
    let options = SimulatorOptions { n_grasps: 2 * n_grasps, seed, stable_fraction: None, ..Default::default() };
    let mut cases = Vec::new();
    simulate_all(&hand, &objects, &options, |grasp| {
        cases.push(GraspCase::from(&grasp.scene));
        Ok::<(), std::convert::Infallible>(())
    })?;
    cases.retain(|case| case.contacts.len() >= 2);
    cases.truncate(n_grasps);
    Ok(cases)
}

fn seconds_of<T>(run: impl Fn() -> T) -> (f64, T) {
    let start = Instant::now();
    let result = std::hint::black_box(run());
    (start.elapsed().as_secs_f64(), result)
}

fn least_seconds_of<T>(run: impl Fn() -> T) -> (f64, T) {
    let (mut least, mut result) = seconds_of(&run);
    for _ in 1..N_REPEATS {
        let (seconds, again) = seconds_of(&run);
        (least, result) = (least.min(seconds), again);
    }
    (least, result)
}

fn report(cases: &[GraspCase], as_json: bool) -> Result<(), Box<dyn std::error::Error>> {
    let mut hull_ms = Vec::new();
    let (mut n_facets, mut n_flat, mut n_failed, mut n_retries) = (0, 0, 0, 0);
    for case in cases {
        let points = wrenches(case);
        let (seconds, hull) = least_seconds_of(|| convex_hull(&points));
        match hull {
            Ok(Hull { facets, n_retries: retries, .. }) => {
                n_facets += facets.len();
                n_retries += usize::from(retries > 0);
                hull_ms.push(1e3 * seconds);
            }
            Err(HullError::NotFullDimensional { .. }) => n_flat += 1,
            Err(_) => n_failed += 1,
        }
    }
    let all = json!({
        "machine": machine(),
        "n_grasps": cases.len(),
        "n_repeats": N_REPEATS,
        "n_flat": n_flat,
        "n_failed": n_failed,
        "n_hulls_with_retries": n_retries,
        "mean_facets": n_facets as f64 / hull_ms.len().max(1) as f64,
        "hull_ms": summary(&hull_ms),
    });
    println!("{}", if as_json { serde_json::to_string(&all)? } else { serde_json::to_string_pretty(&all)? });
    Ok(())
}

fn summary(values: &[f64]) -> Value {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let quantile = |share: f64| sorted.get((share * (sorted.len() as f64 - 1.0)).round() as usize);
    json!({
        "n": sorted.len(),
        "mean": sorted.iter().sum::<f64>() / sorted.len().max(1) as f64,
        "p10": quantile(0.1),
        "median": quantile(0.5),
        "p90": quantile(0.9),
        "max": sorted.last(),
    })
}

fn answer(cases: &[GraspCase]) -> Result<(), Box<dyn std::error::Error>> {
    let all: Vec<_> = cases.iter().map(wrenches).collect();
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{}", json!({"machine": machine(), "wrenches": all}))?;
    stdout.flush()?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (first, end) = line.split_once(' ').ok_or("expected FIRST END")?;
        let found: Vec<Value> = all[first.parse()?..end.parse()?]
            .iter()
            .map(|points| {
                let (seconds, hull) = seconds_of(|| convex_hull(points));
                match hull {
                    Ok(hull) => json!({
                        "seconds": seconds,
                        "least_offset": hull.least_offset(),
                        "volume": hull.volume,
                        "n_facets": hull.facets.len(),
                    }),
                    Err(error) => json!({"seconds": seconds, "error": error.to_string()}),
                }
            })
            .collect();
        writeln!(stdout, "{}", Value::from(found))?;
        stdout.flush()?;
    }
    Ok(())
}

fn machine() -> Value {
    let cpu_info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpu_info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let rustc = std::process::Command::new("rustc").arg("--version").output();
    let rustc = rustc.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    json!({
        "cpu": model.map_or("unknown", |(_, name)| name),
        "cores": std::thread::available_parallelism().map_or(0, std::num::NonZero::get),
        "rustc": rustc.unwrap_or_else(|_| "unknown".into()),
    })
}
