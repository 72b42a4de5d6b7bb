//! `scripts/benchsuite`: what its subjects share, and what it refuses. It measures nothing here.

use std::process::{Command, Output};

use crate::project;

const SUITE: &str = "scripts/benchsuite";

fn python(script: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new("python3");
    command.arg(project().join(script)).args(arguments).output().expect("python3")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn what_its_subjects_share_works() {
    let output = python("tests/benchsuite_units.py", &[]);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn it_lists_its_subjects_and_each_explains_its_options() {
    let list = text(&python(SUITE, &[]).stdout);
    let subjects: Vec<&str> = list.lines().skip(2).filter_map(|line| line.split_whitespace().next()).collect();
    assert!(subjects.contains(&"runtime") && subjects.contains(&"svm"), "{list}");
    let help = python(SUITE, &[&subjects[..], &["--help"]].concat());
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
        let output = python(SUITE, arguments);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
        assert!(stderr.contains(expected), "{arguments:?}: {stderr}");
    }
}
