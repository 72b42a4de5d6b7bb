//! An operator of one's own, outside `operators/`: a classifier that calls every grasp it has a feature of stable.
//!
//! Wire it in by its path (`run: ./target/release/examples/stubborn_classifier`). The tests use it to see that the arbiter holds
//! although every prediction says "stable": with `skip_seq` it leaves one sample unanswered, with `garble_seq` it answers one
//! with nonsense. Its other params make it slow, die or hang, as a bad replacement in a swap would, take memory, or try what
//! its sandbox denies it.

use std::collections::BTreeMap;
use std::io::{Error, ErrorKind};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::process::{Command, ExitCode};
use std::time::Duration;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::stage::{self, Answers, Stage};
use blindgrasp_operator::{Operator, OperatorDescription, ParamKind, run};
use serde::Deserialize;

#[derive(Deserialize)]
struct Stubborn {
    skip_seq: i64,
    garble_seq: i64,
    die_seq: i64,
    die_after: i64,
    hang_after: i64,
    pause_ms: f64,
    start_secs: f64,
    knows_all: bool,
    intrudes: bool,
    hoarded_mib: usize,
}

fn main() -> ExitCode {
    let seq = || ParamKind::Integer { min: Some(-1), max: None };
    let time = || ParamKind::Number { above: None, min: Some(0.0), max: Some(1e6), words: vec![] };
    let description = OperatorDescription::new("stubborn_classifier", "Calls every grasp with contacts stable")
        .answers_each()
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "Stable, always")
        .param("skip_seq", seq(), Some((-1).into()), "The sample not to answer; -1 for none")
        .param("garble_seq", seq(), Some((-1).into()), "The sample to answer with nonsense; -1 for none")
        .param("die_seq", seq(), Some((-1).into()), "The sample on which it aborts; -1 for none")
        .param("die_after", seq(), Some((-1).into()), "How many samples to answer before it aborts; -1 for all")
        .param("hang_after", seq(), Some((-1).into()), "How many samples to answer before it hangs; -1 for all")
        .param("pause_ms", time(), Some(0.0.into()), "How long each answer takes")
        .param("start_secs", time(), Some(0.0.into()), "How long it takes until it is ready")
        .param(
            "knows_all",
            ParamKind::Boolean {},
            Some(false.into()),
            "Also calls grasps stable that are unlike all training data",
        )
        .param(
            "intrudes",
            ParamKind::Boolean {},
            Some(false.into()),
            "Tries at its first sample to run a program, read and write files, and connect",
        )
        .param(
            "hoarded_mib",
            ParamKind::Integer { min: Some(0), max: Some(1 << 20) },
            Some(0.into()),
            "Memory to take at its first sample",
        );
    run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let stubborn: Stubborn = operator.params()?;
    std::thread::sleep(Duration::from_secs_f64(stubborn.start_secs));
    stage::run(operator, "feature", "prediction", 0, BTreeMap::new(), stubborn)
}

impl Stage for Stubborn {
    type In = GraspFeature;
    type Out = Prediction;

    fn answer(&mut self, head: &GraspFeatureHead, _values: &[f64], _now: u64, answers: &mut Answers<Prediction>) {
        if self.die_after == 0 || head.header.seq as i64 == self.die_seq {
            std::process::abort();
        }
        if self.hang_after == 0 {
            loop {
                std::thread::sleep(Duration::from_secs(1));
            }
        }
        if std::mem::take(&mut self.intrudes) {
            intrude();
        }
        if self.hoarded_mib > 0 {
            let hoard = vec![1_u8; std::mem::take(&mut self.hoarded_mib) << 20];
            eprintln!("has {} MiB", std::hint::black_box(hoard).len() >> 20);
        }
        self.die_after -= i64::from(self.die_after > 0);
        self.hang_after -= i64::from(self.hang_after > 0);
        std::thread::sleep(Duration::from_secs_f64(self.pause_ms / 1e3));
        let seq = head.header.seq as i64;
        let fault = Fault::from_code(head.fault).unwrap_or(Fault::Malformed);
        let fault = if self.knows_all && fault == Fault::OutOfDistribution { Fault::None } else { fault };
        let is_felt = fault == Fault::None;
        if seq != self.skip_seq {
            answers.push(PredictionHead {
                header: head.header,
                grasp_id: head.grasp_id,
                decision_value: f64::from(is_felt),
                probability_stable: if is_felt { 0.9 } else { 0.0 },
                phase: head.phase,
                stable: is_felt.into(),
                fault: if seq == self.garble_seq { 99 } else { fault.code() },
                unsure: 0,
            });
        }
    }
}

/// Logs for each attempt whether it succeeded.
fn intrude() {
    let file = std::env::temp_dir().join(format!("intruder-{}", std::process::id()));
    let attempts = [
        ("run a program", Command::new("/bin/true").status().map(drop)),
        ("read a file", std::fs::read("/etc/hostname").map(drop)),
        ("write a file", std::fs::write(&file, "intruded")),
        ("listen", TcpListener::bind("127.0.0.1:0").map(drop)),
        // Nobody listens: it may try if that is the only reason.
        ("connect", allowed_to_try(TcpStream::connect("127.0.0.1:1").map(drop))),
        ("reach a launcher", allowed_to_try(UnixStream::connect("/tmp/no-such-launcher.sock").map(drop))),
    ];
    let _ = std::fs::remove_file(file);
    for (what, outcome) in attempts {
        let outcome = outcome.map_or_else(|error| format!("{:?}", error.kind()), |()| "done".into());
        eprintln!("{what}: {outcome}");
    }
}

fn allowed_to_try(outcome: std::io::Result<()>) -> std::io::Result<()> {
    let is_absent = |error: &Error| [ErrorKind::ConnectionRefused, ErrorKind::NotFound].contains(&error.kind());
    outcome.or_else(|error| if is_absent(&error) { Ok(()) } else { Err(error) })
}
