//! The examples that a user would copy do what they say.

use std::process::Command;

use crate::common::{example, project, run, text};

fn output_of(command: &mut Command) -> String {
    let output = command.current_dir(project()).output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn a_judge_without_a_graph_decides_as_predict_does() {
    let (model, recording) = ("models/barrett-bh8-280.json", "recordings/held-out.mcap");
    let judged = output_of(Command::new(example("judge_frame")).args([model, recording]));
    let n_lifts = judged.lines().filter(|line| line.contains(": lift (")).count();
    let predicted = text(&run(&["predict", model, recording, "--json"], 0).stdout);
    let n_predicted = predicted.lines().filter(|line| line.contains(r#""action":"lift""#)).count();
    assert_eq!((judged.lines().count(), n_lifts), (240, n_predicted), "{judged}");
}
