//! The Python package: its own tests with this build's program, and its wheel as pip installs it.

use std::path::Path;
use std::process::Command;

use crate::common::python::{python, shell, utf8};
use crate::common::{program, project, text};

#[test]
fn the_python_packages_own_tests_pass() {
    let mut command = Command::new(python());
    command.current_dir(project()).args(["-m", "unittest", "discover", "--verbose", "python/tests"]);
    command.env("PYTHONPATH", project().join("python")).env("PYTHONDONTWRITEBYTECODE", "1");
    // Logs of the tests' graphs stay out of the user's state folder.
    let state = Path::new(env!("CARGO_TARGET_TMPDIR")).join("state");
    command.env("BLINDGRASP_PROGRAM", program()).env("XDG_STATE_HOME", state);
    let output = command.output().expect("started");
    let said = text(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(!said.contains("skipped"), "{said}");
}

#[test]
fn a_wheel_with_the_program_installs_package_operator_modules_and_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let script = project().join("scripts/python-wheel");
    let arguments = ["--with-program", program(), "--python", utf8(python()), "--out", utf8(folder)];
    let wheel = text(&shell(folder, &script, &arguments, 0).stdout).trim().to_string();
    assert!(wheel.contains("-py3-none-manylinux_2_") && wheel.ends_with("_x86_64.whl"), "{wheel}");
    // The environment has the dependencies, so that nothing is downloaded.
    let installed = folder.join("installed");
    let offline = ["-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", utf8(&installed), &wheel];
    shell(folder, python(), &offline, 0);
    let asks = "import blindgrasp, blindgrasp_messages, blindgrasp_operator; print(blindgrasp.program())";
    let run = |program: &Path, arguments: &[&str]| {
        let mut command = Command::new(program);
        command.current_dir(folder).args(arguments).env("PYTHONPATH", &installed).env_remove("BLINDGRASP_PROGRAM");
        let output = command.output().expect("started");
        assert!(output.status.success(), "{}", text(&output.stderr));
        text(&output.stdout).trim().to_string()
    };
    assert_eq!(run(python(), &["-c", asks]), utf8(&installed.join("blindgrasp/bin/blindgrasp")));
    // pytest finds the fixture by the wheel's entry point.
    let fixtures = run(python(), &["-m", "pytest", "--fixtures", "-p", "no:cacheprovider"]);
    assert!(fixtures.contains("\nreplay -- "), "{fixtures}");
    let version = run(Path::new(program()), &["--version"]);
    assert_eq!(run(&installed.join("bin/blindgrasp"), &["--version"]), version);
    // The lab's program is beside it.
    assert!(run(&installed.join("bin/blindgrasp"), &["simulate", "--help"]).contains("--grasps"));
}
