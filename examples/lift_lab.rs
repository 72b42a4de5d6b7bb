//! Lab.
use blindgrasp::grasp::objects::select;
use blindgrasp::hand::Hand;
use blindgrasp::trial::*;
use std::path::Path;
use std::time::Instant;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let what = args.get(1).map_or("box-03", String::as_str).to_string();
    let n: u64 = args.get(2).and_then(|t| t.parse().ok()).unwrap_or(3);
    let friction: f64 = args.get(3).and_then(|t| t.parse().ok()).unwrap_or(1.0);
    let verbose = args.get(4).is_some();
    let hand = Hand::load(Path::new("barrett-bh8-280")).unwrap();
    let options = TrialOptions::default();
    for object in select(&what).unwrap() {
        let thing =
            Thing { name: object.name.clone(), group: object.class.clone(), mass_kg: object.mass_kg, friction, object };
        for trial in 0..n {
            let start = match draw_start(&hand, &thing, &options, 1, trial, 0) {
                Ok(s) => s,
                Err(e) => {
                    println!("{e}");
                    continue;
                }
            };
            let begun = Instant::now();
            let mut attempt = Attempt::begin(&hand, &thing, &options, &start, trial).unwrap();
            let mut last = None;
            let mut k = 0;
            while let Some(f) = attempt.next_frame(trial) {
                if verbose && k % 20 == 0 {
                    let s = attempt.snapshot();
                    println!(
                        "  {:5.2} {:?} j {:.2?} thing {:.3?} palm {:.3?} cells {:.2}",
                        f.offset_nanos as f64 * 1e-9,
                        f.frame.phase,
                        f.frame.joints_rad,
                        s.thing_position_m,
                        s.palm_position_m,
                        f.frame.cells_newtons.iter().sum::<f64>()
                    );
                }
                k += 1;
                last = Some(f);
            }
            let closed = begun.elapsed();
            let f = last.unwrap();
            let q = attempt.quality();
            let nc = attempt.grasp_case(1.0).contacts.len();
            let begun = Instant::now();
            let mut k = 0;
            let r = attempt.lift(|s| {
                k += 1;
                if verbose && k % 20 == 0 {
                    println!(
                        "  L {:5.2} thing {:.3?} palm {:.3?}",
                        s.elapsed_nanos as f64 * 1e-9,
                        s.thing_position_m,
                        s.palm_position_m
                    );
                }
            });
            println!(
                "{} {:.3} kg trial {trial}: {:.2} s sim, {:?} closing; {nc} contacts, cells {:.2} N, quality {:.3?}; held {} slip {:.1} mm turn {:.2}; {:?}",
                thing.name,
                thing.mass_kg,
                f.offset_nanos as f64 * 1e-9,
                closed,
                f.frame.cells_newtons.iter().sum::<f64>(),
                q,
                r.held,
                r.slip_m * 1e3,
                r.turn_rad,
                begun.elapsed()
            );
        }
    }
}
