//! Times training and prediction of our support vector machine, for `scripts/benchsuite svm`, which times LIBSVM beside it.
//!
//! `cargo bench -p blindgrasp-lab --bench svm -- features RECORDING MODEL N OUT` writes the features of N grasps, by the model's
//! dictionary, as LIBSVM's problem file. `-- train PROBLEM C GAMMA TOLERANCE OUT` trains on one and writes LIBSVM's model file,
//! and beside it the machine as blindgrasp's JSON. `-- predict JSON PROBLEM` times single decision values. `-- export MODEL OUT`
//! writes a model's machine and calibration as LIBSVM's model file. Results are lines of JSON on stdout.

use std::fmt::Write;
use std::path::Path;
use std::time::Instant;

use blindgrasp_grasps::dataset::{hand_of, read_grasps};
use blindgrasp_learning::learners::svm::train_svm;
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::Predictor;
use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::svm::{PreparedSvm, RbfSvm, SvmParams};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::model::Model;
use serde_json::json;

type Failure = Box<dyn std::error::Error>;

/// Decision values that are timed together; one alone is too short for the clock.
const N_TIMED: usize = 200;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["features", recording, model, n, out] => write_features(recording, model, n.parse()?, out),
        ["train", problem, c, gamma, tolerance, out] => {
            let params = SvmParams {
                c: c.parse()?,
                gamma: gamma.parse()?,
                tolerance: tolerance.parse()?,
                ..SvmParams::default()
            };
            time_training(problem, &params, out)
        }
        ["export", model, out] => export(model, out),
        ["predict", model, problem] => time_prediction(model, problem),
        [] => {
            eprintln!("run by scripts/benchsuite svm");
            Ok(())
        }
        _ => Err(format!("unknown arguments {arguments:?}: see the top of benches/svm.rs").into()),
    }
}

fn write_features(recording: &str, model: &str, n_samples: usize, out: &str) -> Result<(), Failure> {
    let model = Model::load(Path::new(model))?;
    let hand = hand_of(Path::new(recording), None)?;
    let (mut text, mut n_written, mut contacts, mut values) = (String::new(), 0, Vec::new(), Vec::new());
    let grasps = read_grasps(Path::new(recording), &hand, |_, frames| {
        let frame = frames.into_iter().find(|frame| frame.message.phase == Phase::Settled)?;
        let (joints, cells) = (&frame.message.joints, &frame.message.cells_newtons);
        contacts_from_frame(&hand, frame.header.hand_id, joints, cells, &mut contacts);
        model.features.extract(&FeltReading::new(joints, &contacts), &mut values).ok()?;
        Some(values.clone())
    })?;
    for (values, truth) in grasps.into_iter().filter_map(|grasp| Some((grasp.value?, grasp.truth?))).take(n_samples) {
        text += if truth.stable { "+1" } else { "-1" };
        for (idx, value) in values.iter().enumerate().filter(|(_, value)| **value != 0.0) {
            write!(text, " {}:{value:?}", idx + 1)?;
        }
        text.push('\n');
        n_written += 1;
    }
    std::fs::write(out, text)?;
    println!("{}", json!({ "n_samples": n_written, "n_features": model.features.len() }));
    Ok(())
}

struct Problem {
    features: Vec<f64>,
    n_features: usize,
    labels: Vec<bool>,
}

fn read_problem(path: &str) -> Result<Problem, Failure> {
    let text = std::fs::read_to_string(path)?;
    let mut rows = Vec::new();
    let mut labels = Vec::new();
    for line in text.lines() {
        let mut words = line.split_ascii_whitespace();
        labels.push(words.next().is_some_and(|label| label.starts_with('+')));
        let mut row = Vec::new();
        for word in words {
            let (index, value) = word.split_once(':').ok_or("expected index:value")?;
            row.push((index.parse::<usize>()?.checked_sub(1).ok_or("expected indices from 1 on")?, value.parse()?));
        }
        rows.push(row);
    }
    let n_features = rows.iter().flatten().map(|(idx, _)| idx + 1).max().unwrap_or(0);
    let mut features = vec![0.0; rows.len() * n_features];
    for (row, values) in rows.iter().zip(features.chunks_exact_mut(n_features)) {
        row.iter().for_each(|&(idx, value): &(usize, f64)| values[idx] = value);
    }
    Ok(Problem { features, n_features, labels })
}

fn time_training(problem: &str, params: &SvmParams, out: &str) -> Result<(), Failure> {
    let problem = read_problem(problem)?;
    let start = Instant::now();
    let (svm, report) = train_svm(&problem.features, problem.n_features, &problem.labels, params)?;
    let secs = start.elapsed().as_secs_f64();
    std::fs::write(out, write_libsvm(&svm, None))?;
    std::fs::write(Path::new(out).with_extension("json"), serde_json::to_string(&svm)?)?;
    println!(
        "{}",
        json!({
            "secs": secs,
            "objective": report.objective,
            "n_iterations": report.n_iterations,
            "converged": report.converged,
            "n_support_vectors": svm.n_support_vectors(),
            "rho": svm.rho,
        })
    );
    Ok(())
}

fn time_prediction(model: &str, problem: &str) -> Result<(), Failure> {
    let problem = read_problem(problem)?;
    let svm: RbfSvm = serde_json::from_str(&std::fs::read_to_string(model)?)?;
    let svm = PreparedSvm::try_from(svm)?;
    let samples: Vec<&[f64]> = problem.features.chunks_exact(problem.n_features).take(N_TIMED).collect();
    // Once to warm up, then what counts.
    for sample in &samples {
        std::hint::black_box(svm.decision_value(sample)?);
    }
    let start = Instant::now();
    let values = samples.iter().map(|sample| svm.decision_value(sample)).collect::<Result<Vec<f64>, _>>()?;
    let secs = start.elapsed().as_secs_f64() / samples.len() as f64;
    println!("{}", json!({ "secs": secs, "n_support_vectors": svm.n_support_vectors(), "decision_values": values }));
    Ok(())
}

fn export(model: &str, out: &str) -> Result<(), Failure> {
    let classifier = Model::load(Path::new(model))?.classifier;
    let Predictor::Svm(svm) = &classifier.predictor else { return Err("expected a model with an SVM".into()) };
    std::fs::write(out, write_libsvm(svm, Some(&classifier.calibration)))?;
    println!("{}", json!({ "n_support_vectors": svm.n_support_vectors() }));
    Ok(())
}

/// Writes a machine and its calibration as LIBSVM's model file. Labels are 1 (stable) and -1; the support vectors of
/// label 1 come first, as LIBSVM wants, each class in the order of `svm`.
fn write_libsvm(svm: &RbfSvm, calibration: Option<&PlattCalibration>) -> String {
    let support = || svm.dual_coefficients.iter().zip(svm.support_vectors.chunks_exact(svm.n_features.max(1)));
    let n_stable = svm.dual_coefficients.iter().filter(|coefficient| **coefficient > 0.0).count();
    let n_unstable = svm.n_support_vectors() - n_stable;
    let mut text = format!(
        "svm_type c_svc\nkernel_type rbf\ngamma {}\nnr_class 2\ntotal_sv {}\nrho {}\nlabel 1 -1\n",
        number(svm.gamma),
        svm.n_support_vectors(),
        number(svm.rho)
    );
    if let Some(calibration) = calibration {
        text += &format!("probA {}\nprobB {}\n", number(calibration.a), number(calibration.b));
    }
    text += &format!("nr_sv {n_stable} {n_unstable}\nSV\n");
    for of_stable in [true, false] {
        for (coefficient, vector) in support().filter(|(coefficient, _)| (**coefficient > 0.0) == of_stable) {
            text += &number(*coefficient);
            for (idx, value) in vector.iter().enumerate().filter(|(_, value)| **value != 0.0) {
                // Writing to a String cannot fail.
                let _ = write!(text, " {}:{}", idx + 1, number(*value));
            }
            text += " \n";
        }
    }
    text
}

/// The shortest decimals that are read back as the same number, with an exponent where plain digits would be many.
fn number(value: f64) -> String {
    format!("{value:?}")
}
