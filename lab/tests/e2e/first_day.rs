//! docs/start.md, "From your hand to a gated arm": its commands, as they stand on the page, make a graph that lifts.

use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use crate::common::{Graph, blindgrasp, program, project, text, unique_name, wait_until};

/// The blocks of a language in a part of the page.
fn blocks(part: &str, language: &str) -> String {
    let begin = format!("```{language}\n");
    let blocks = part.split(&begin).skip(1).map(|rest| rest.split("```").next().expect("the end of a block"));
    blocks.collect::<Vec<_>>().join("\n")
}

/// Runs commands in a folder, in which `blindgrasp` is the program of this build, and returns what they print.
fn run_script(folder: &Path, programs: &Path, script: &str) -> String {
    let path = std::env::var_os("PATH").expect("a PATH");
    let path = std::env::join_paths([programs.to_path_buf()].into_iter().chain(std::env::split_paths(&path)));
    let mut bash = Command::new("bash");
    bash.args(["-euxc", script]).current_dir(folder).env("PATH", path.expect("a path"));
    // Logs of its graphs are where those of the other tests are.
    bash.envs(blindgrasp().get_envs().filter_map(|(name, value)| Some((name, value?))));
    let output = bash.output().expect("started");
    let stdout = text(&output.stdout);
    assert!(output.status.success(), "{script}\n{stdout}\n{}", text(&output.stderr));
    stdout.to_owned()
}

#[test]
fn the_commands_of_the_first_day_make_a_graph_that_lifts() {
    let page = std::fs::read_to_string(project().join("docs/start.md")).expect("the page");
    let parts: Vec<&str> = page.split("\n## ").collect();
    let part = |number: usize| {
        let found = parts.iter().find(|part| part.starts_with(&format!("{number}. ")));
        found.unwrap_or_else(|| panic!("docs/start.md has no part {number}"))
    };
    let folder = tempfile::tempdir().expect("a folder");
    symlink(program(), folder.path().join("blindgrasp")).expect("linked");
    let urdf = folder.path().join("trio.urdf");
    std::fs::write(&urdf, blocks(part(1), "xml")).expect("written");

    let start = blocks(parts[0], "sh").replace(
        "blindgrasp run dataflow.yaml",
        &format!("blindgrasp run dataflow.yaml --quiet --set recorded_source.rate=max --name {}", unique_name()),
    );
    run_script(folder.path(), folder.path(), &start);
    let demo = folder.path().join("demo");
    std::fs::copy(&urdf, demo.join("trio.urdf")).expect("copied");
    let hint = run_script(&demo, folder.path(), &blocks(part(1), "sh"));
    let learn = blocks(part(2), "sh");
    assert!(hint.contains(learn.trim()), "{hint}");
    // Fewer lifts, at a bound that so few can keep. Of slippery objects nearly as many lifts fail as succeed, so that few are enough to
    // learn from. With long time steps they take half the time.
    let slippery = "{friction: 0.6, planner: {n_approaches: 4}, lift: {step_secs: 0.02}}";
    std::fs::write(demo.join("slippery.yaml"), slippery).expect("written");
    let few = format!("{} --lifts 125 --max-drops 0.5 --options slippery.yaml", learn.trim());
    let learned = run_script(&demo, folder.path(), &few);

    // Part 3 in two terminals; other tests have sockets of their own.
    let live = blocks(part(3), "sh").replace(" \\\n    ", " ");
    let mut lines = live.lines().filter(|line| !line.trim().is_empty());
    let (run, bridge) = (lines.next().expect("the graph"), lines.next().expect("the bridge"));
    assert_eq!(lines.next(), None, "{live}");
    // So few lifts may ask for another probe.
    let known = run.split(" --set probe=").next().expect("the command of the page");
    let printed = learned.lines().map(str::trim).find(|line| line.starts_with(known)).expect("the same command");
    let arguments: Vec<&str> = printed.split_whitespace().collect();
    let socket = format!("unix:{}", demo.join("hand.sock").display());
    let address = format!("source.address={socket}");
    let mut command = blindgrasp();
    command.current_dir(&demo);
    let params = [&arguments[3..], &["--set", &address, "--set", "lift_arbiter.max_age_ms=60000"]].concat();
    let graph = Graph::launch_on(command, &unique_name(), Path::new("dataflow-live.yaml"), &params);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    assert!(!graph.said().contains("warning"), "{}", graph.said());
    // The first grasps: the bridge plays them as slowly as they were.
    let some = bridge.replace(" | python3", " | head -n 2000 | python3");
    assert_ne!(some, bridge);
    run_script(&demo, folder.path(), &format!("{some} --address {socket}"));
    wait_until(|| graph.n_decisions() >= 6, || graph.said());
    let ended = graph.stop();
    let n_lifts = ended.decisions.iter().filter(|decision| decision["action"] == "lift").count();
    assert!(n_lifts > 0, "{:?}", ended.decisions);
    bounds_that_the_lifts_cannot_keep(folder.path());
}

/// The same lifts with lower bounds, in a folder without a dataflow file.
fn bounds_that_the_lifts_cannot_keep(folder: &Path) {
    let learn = "blindgrasp learn demo/trio/trio.yaml --out demo/trio-gate --options demo/slippery.yaml --lifts 125 --max-drops";
    // The model promises the bound that it can keep, and the answer says how to reach the other one.
    let said = run_script(folder, folder, &format!("{learn} 0.03 2>&1 && exit 9 || [ $? = 1 ]"));
    for part in ["the bound of 3.0 % is not reached", "--lifts 250 goes on", "--set promised_drops=0."] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let begin = "blindgrasp run demo/trio-gate/dataflow-live.yaml ";
    let start = said.lines().find(|line| line.trim().starts_with(begin)).expect("a command");
    let checked = run_script(folder, folder, &format!("{start} --check 2>&1"));
    assert!(!checked.contains("warning"), "{checked}");
    assert!(folder.join("demo/trio-gate/report.html").is_file());
    // No number of kept objects among so few shows this bound.
    let said = run_script(folder, folder, &format!("{learn} 0.001 2>&1 && exit 9 || [ $? = 1 ]"));
    let expected = "125 lifts of 125 objects, all kept, show that at most 2.37 % drop; expected 0.0237 or more";
    assert!(said.contains(expected), "{said}");
}
