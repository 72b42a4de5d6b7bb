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

/// Runs commands in a folder, in which `blindgrasp` is the program of this build.
fn run_script(folder: &Path, programs: &Path, script: &str) {
    let path = std::env::var_os("PATH").expect("a PATH");
    let path = std::env::join_paths([programs.to_path_buf()].into_iter().chain(std::env::split_paths(&path)));
    let mut bash = Command::new("bash");
    bash.args(["-euxc", script]).current_dir(folder).env("PATH", path.expect("a path"));
    // Logs of its graphs are where those of the other tests are.
    bash.envs(blindgrasp().get_envs().filter_map(|(name, value)| Some((name, value?))));
    let output = bash.output().expect("started");
    assert!(output.status.success(), "{script}\n{}\n{}", text(&output.stdout), text(&output.stderr));
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
    std::fs::write(&urdf, blocks(part(2), "xml")).expect("written");

    // Fewer lifts, at a bound that so few can keep, and a faster recording. On slippery objects as many lifts fail as succeed, so
    // that few are enough to learn from.
    let mut replaced = [false; 5];
    let mut commands = |number: usize| {
        let mut script = blocks(part(number), "sh");
        let changes = [
            ("blindgrasp run dataflow.yaml", "blindgrasp run dataflow.yaml --quiet --set recorded_source.rate=max"),
            ("--label lift", "--label lift --options slippery.yaml"),
            ("--grasps 2000", "--grasps 160"),
            ("--grasps 200 ", "--grasps 24 "),
            ("--max-drops 0.1", "--max-drops 0.6"),
        ];
        for ((what, by), is_replaced) in changes.into_iter().zip(&mut replaced) {
            *is_replaced |= script.contains(what);
            script = script.replace(what, by);
        }
        script
    };
    run_script(
        folder.path(),
        folder.path(),
        &commands(1).replace("run dataflow.yaml", &format!("run dataflow.yaml --name {}", unique_name())),
    );
    let demo = folder.path().join("demo");
    std::fs::copy(&urdf, demo.join("trio.urdf")).expect("copied");
    std::fs::write(demo.join("slippery.yaml"), "{friction: 0.4, planner: {n_approaches: 4}}").expect("written");
    for number in 2..=4 {
        run_script(&demo, folder.path(), &commands(number));
    }

    // Part 5 in two terminals. So few lifts teach nothing about test lifts; other tests have sockets of their own.
    let live = commands(5);
    assert_eq!(replaced, [true; 5], "docs/start.md has other commands than this test shortens");
    let mut lines = live.lines().filter(|line| !line.trim().is_empty());
    let (run, bridge) = (lines.next().expect("the graph"), lines.next().expect("the bridge"));
    assert_eq!(lines.next(), None, "{live}");
    let arguments: Vec<&str> = run.split_whitespace().collect();
    assert_eq!(arguments[..3], ["blindgrasp", "run", "dataflow-live.yaml"], "{run}");
    let socket = format!("unix:{}", demo.join("hand.sock").display());
    let address = format!("source.address={socket}");
    let mut command = blindgrasp();
    command.current_dir(&demo).env("PROBE", "none");
    let params = [&arguments[3..], &["--set", &address, "--set", "lift_arbiter.max_age_ms=60000"]].concat();
    let graph = Graph::launch_on(command, &unique_name(), Path::new("dataflow-live.yaml"), &params);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    assert!(graph.said().contains("after a test lift") || !graph.said().contains("warning"), "{}", graph.said());
    run_script(&demo, folder.path(), &format!("{bridge} --address {socket}"));
    wait_until(|| graph.n_decisions() >= 20, || graph.said());
    let ended = graph.stop();
    let n_lifts = ended.decisions.iter().filter(|decision| decision["action"] == "lift").count();
    assert!(n_lifts > 0, "{:?}", ended.decisions);
}
