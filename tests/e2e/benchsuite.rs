//! `scripts/benchsuite`: what it refuses, what its subjects share, and one subject on a real graph. The figures of the others are
//! measured by hand.

use std::process::{Command, Output};

use serde_json::Value;

use crate::common::python::python;
use crate::common::{blindgrasp, project, text};

/// Runs the suite with the program of this build.
pub(crate) fn benchsuite(arguments: &[&str]) -> Output {
    Command::new(python())
        .arg(project().join("scripts/benchsuite"))
        .args(arguments)
        .env("BLINDGRASP", blindgrasp().get_program())
        .output()
        .expect("started")
}

#[test]
fn what_its_subjects_share_works() {
    let tests = project().join("tests/benchsuite_units.py");
    let output = Command::new(python()).arg(tests).output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn it_lists_its_subjects_and_each_explains_its_options() {
    let list = text(&benchsuite(&[]).stdout);
    let subjects: Vec<&str> = list.lines().skip(2).filter_map(|line| line.split_whitespace().next()).collect();
    assert!(subjects.contains(&"runtime") && subjects.contains(&"svm"), "{list}");
    let help = benchsuite(&[&subjects[..], &["--help"]].concat());
    let (stdout, stderr) = (text(&help.stdout), text(&help.stderr));
    assert!(help.status.success(), "{stderr}");
    for expected in ["--rounds", "default 3", "--sequences", "--quick"] {
        assert!(stdout.contains(expected), "'{expected}' in\n{stdout}");
    }
}

#[test]
fn wrong_words_are_refused_before_anything_is_built_or_measured() {
    for (arguments, expected) in [
        (&["runtimes"][..], "unknown subject 'runtimes', expected some of runtime,"),
        (&["runtime", "--rates", "1000,x"], "--rates is '1000,x', expected values with commas between them"),
        (&["runtime", "--rounds", "0"], "--rounds is '0', expected a whole number of at least 1"),
        (&["top", "--rates", "1000"], "unrecognized arguments: --rates"),
        (&["slip"], "slip needs --sequences: the folder csvs of BioTacSP-DoS"),
        (&["top", "--page"], "expected subjects of the page: runtime, rate-max, hull, k-means, svm"),
    ] {
        let output = benchsuite(arguments);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
        assert!(stderr.contains(expected), "{arguments:?}: {stderr}");
    }
}

#[test]
fn a_quick_run_measures_a_graph_watched_by_top() {
    let output = benchsuite(&["top", "--quick", "--no-build", "--json"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for (side, figure) in [("alone", "latency_p50_micros"), ("watched", "top_cpu_percent")] {
        let measured = found["results"]["top"]["medians"][side][figure].as_f64().expect("a figure");
        assert!(measured > 0.0, "{found}");
    }
    assert!(found["command"].as_str().is_some_and(|command| command.contains("top --quick")), "{found}");
}
