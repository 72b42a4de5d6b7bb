//! The first commands of a new user: `init`, `doctor`, `completions`, `--help`; and errors that say what to do next.

use std::os::unix::fs::DirBuilderExt;
use std::process::Command;

use crate::common::{Graph, assert_nothing_left, blindgrasp, dataflow, json_lines, program, run, text, unique_name};

#[test]
fn a_new_project_runs_and_is_never_overwritten() {
    let folder = tempfile::tempdir().expect("a folder");
    let project = folder.path().join("robots/first");
    let told = run(&["init", project.to_str().expect("UTF-8"), "--json"], 0);
    let told = &json_lines(&told.stdout)[0];
    let files: Vec<&str> = told["files"].as_array().expect("files").iter().filter_map(|file| file.as_str()).collect();
    assert!(files.contains(&"dataflow.yaml") && files.iter().all(|file| project.join(file).is_file()), "{told}");

    // It runs from another folder: nothing in the project may depend on the current one.
    let name = unique_name();
    let mut command = blindgrasp();
    command.current_dir(folder.path()).args(["run", "robots/first/dataflow.yaml", "--json", "--name", &name]);
    let output = command.args(["--set", "recorded_source.rate=max"]).output().expect("started");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let lines = json_lines(&output.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    assert_eq!((summary["grasps"].as_u64(), summary["samples_lost"].as_u64()), (Some(240), Some(0)));
    assert_nothing_left(&name);

    let checked = run(&["run", "--check", project.join("dataflow-machines.yaml").to_str().expect("UTF-8")], 0);
    let checked = text(&checked.stdout);
    assert!(["robot", "brain", "contacts/contacts"].iter().all(|word| checked.contains(word)), "{checked}");

    let out =
        Command::new(project.join("tactile_bridge.py")).arg("--help").output().expect("a program that can be run");
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));

    std::fs::remove_file(project.join("hands/barrett-bh8-280.yaml")).expect("removed");
    std::fs::write(project.join("dataflow.yaml"), "mine").expect("written");
    let refused = text(&run(&["init", project.to_str().expect("UTF-8")], 1).stderr);
    assert!(refused.contains("has dataflow.yaml") && refused.contains("choose a new folder"), "{refused}");
    assert!(!project.join("hands/barrett-bh8-280.yaml").exists(), "half a project was written");
    assert_eq!(std::fs::read(project.join("dataflow.yaml")).expect("there"), b"mine");
}

#[test]
fn without_a_dataflow_file_the_error_says_how_to_get_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = blindgrasp().current_dir(folder.path()).arg("run").output().expect("started");
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("blindgrasp init DIR"), "{}", text(&output.stderr));
}

#[test]
fn commands_of_other_programs_are_handed_over_or_say_what_to_install() {
    for words in [["help", "simulate"], ["simulate", "--help"]] {
        let told = text(&run(&words, 0).stdout);
        assert!(told.contains("Usage: blindgrasp simulate"), "{told}");
    }

    let alone = tempfile::tempdir().expect("a folder");
    let program_alone = alone.path().join("blindgrasp");
    std::fs::copy(program(), &program_alone).expect("copied");
    for (words, missing) in [
        (&["simulate", "--list"][..], "blindgrasp-lab"),
        (&["keys", "folder"], "blindgrasp-network"),
        (&["run", "--check", "dataflow-live.yaml", "--set", "source.driver=zenoh"], "blindgrasp-network"),
    ] {
        let mut command = Command::new(&program_alone);
        let output = command.args(words).current_dir(crate::common::project()).output().expect("started");
        let told = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{words:?}: {told}");
        assert!(told.contains(missing) && told.contains("cargo build --release --workspace"), "{words:?}: {told}");
    }
}

#[test]
fn the_doctor_finds_what_a_dead_graph_left_and_removes_only_that() {
    let folder_of = |name: &str| {
        let folder = std::path::PathBuf::from(format!("/dev/shm/blindgrasp_{name}.42424242"));
        std::fs::DirBuilder::new().mode(0o700).create(&folder).expect("made");
        folder
    };
    // A living launcher holds the lock of its folder. Another test's graph may sweep the folder before it is locked.
    let (held, lock) = loop {
        let folder = folder_of(&format!("{}-a", unique_name()));
        if let Ok(lock) = std::fs::File::open(&folder)
            && lock.try_lock().is_ok()
            && folder.exists()
        {
            break (folder, lock);
        }
    };
    std::fs::write(held.join("cursors"), [0; 64]).expect("written");
    // One that was killed with all its operators holds it no more.
    let dead = format!("{}-d", unique_name());
    let left = folder_of(&dead);

    // Another test's graph may start meanwhile and clean up: only the files at the end are certain.
    let found = json_lines(&run(&["doctor", "--quick", "--json"], 0).stdout);
    let findings = found[0]["findings"].as_array().expect("findings");
    let check = |name: &str| findings.iter().find(|finding| finding["check"] == name).expect("a finding").clone();
    let leftovers = check("leftovers of dead graphs");
    let found = leftovers["found"].as_str().expect("text");
    if left.exists() {
        assert!(found.contains(&format!("{dead}.42424242")), "{leftovers}");
        assert!(leftovers["advice"].as_str().expect("text").contains("doctor --fix"), "{leftovers}");
    }
    let held_id = held.to_string_lossy().replace("/dev/shm/blindgrasp_", "");
    assert!(!found.contains(&held_id), "{leftovers}");
    assert_eq!(check("shared memory")["verdict"], "ok");
    assert_eq!(check("operators")["verdict"], "ok");

    let fixed = text(&run(&["doctor", "--quick", "--fix"], 0).stdout);
    assert!(!left.exists(), "{fixed}");
    assert!(held.join("cursors").exists(), "{fixed}");
    drop(lock);
    run(&["doctor", "--quick", "--fix"], 0);
    assert!(!held.exists());
}

#[test]
fn completions_know_the_commands_and_bash_takes_them() {
    for shell in ["bash", "zsh", "fish"] {
        let script = text(&run(&["completions", shell], 0).stdout);
        assert!(script.contains("BLINDGRASP_COMPLETE"), "{shell}: {script}");
    }
    let script = run(&["completions", "bash"], 0).stdout;
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("completions");
    std::fs::write(&path, script).expect("written");
    // In bash the function is found by the command's name, which is on PATH.
    let completed = |words: &[&str]| {
        let complete = "source \"$1\"; shift; COMP_TYPE=9; COMP_WORDS=(blindgrasp \"$@\"); COMP_CWORD=$#; \
                        $(complete -p blindgrasp | grep -o '_[a-z_]*' | head -1) blindgrasp \"${@: -1}\"; echo \"${COMPREPLY[@]}\"";
        let program = std::path::Path::new(program()).parent().expect("a folder");
        let mut command = Command::new("bash");
        command.env("PATH", format!("{}:/usr/bin:/bin", program.display()));
        let output = command.args(["-c", complete, "-"]).arg(&path).args(words).output().expect("bash");
        text(&output.stdout).trim().to_owned() + &text(&output.stderr)
    };
    assert_eq!(completed(&["sw"]), "swap");
    // The lab's program answers.
    assert_eq!(completed(&["simulate", "--grasps"]), "--grasps");
    // Words of a running graph.
    let graph = Graph::start(&dataflow(folder.path(), &[]), &["--set", "recorded_source.repeat=forever"]);
    graph.wait_for_decisions(1);
    let found = completed(&["set", "lift_arbiter.vo"]);
    assert!(found.contains("lift_arbiter.votes="), "{found}");
    assert!(completed(&["stop", &graph.name]).contains(&graph.name));
    assert!(completed(&["echo", "contacts/"]).contains("contacts/contacts"));
    graph.stop();
}

#[test]
fn every_command_shows_an_example() {
    let help = text(&run(&["--help"], 0).stdout);
    let commands = help.lines().skip_while(|line| *line != "Run:").take_while(|line| *line != "Options:");
    let commands = commands.filter(|line| line.starts_with("  "));
    let names: Vec<&str> = commands.filter_map(|line| line.split_whitespace().next()).collect();
    assert!(names.len() > 20, "{help}");
    assert!(help.contains("Example"), "{help}");
    for name in names.iter().filter(|name| **name != "help") {
        let help = text(&run(&[name, "--help"], 0).stdout);
        let own = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
        let own: Vec<String> = own.filter_map(|line| line.split_whitespace().next().map(str::to_string)).collect();
        if own.is_empty() {
            assert!(help.contains("Example"), "{name}: {help}");
        }
        for command in own.iter().filter(|command| *command != "help") {
            let help = text(&run(&[name, command, "--help"], 0).stdout);
            assert!(help.contains("Example"), "{name} {command}: {help}");
        }
    }
}
