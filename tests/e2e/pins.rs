//! Files whose content the dataflow file fixes by its SHA-256.

use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::process::Signal;

use crate::common::{
    FAST_FOREVER, Graph, MODEL, classifier_runs, dataflow_with, of_node, operator, paper_model, project, run, script,
    signal, swap, text, unique_name, wait_until,
};

/// What `sha256sum` says of a file.
fn digest(file: &Path) -> String {
    let output = Command::new("sha256sum").arg(file).output().expect("sha256sum");
    text(&output.stdout).split_whitespace().next().expect("a digest").into()
}

/// The project's graph, whose classifier has a model of the test's own, with one of these digests.
fn pinned(folder: &Path, digests: &[String]) -> (PathBuf, PathBuf) {
    let model = folder.join("model.json");
    std::fs::copy(project().join(MODEL), &model).expect("copied");
    let replace = [
        classifier_runs(Path::new("classifier"), &format!("{{model: {}}}", model.display())),
        of_node("classifier", &[&format!("sha256: {{model: [{}]}}", digests.join(", "))]),
    ];
    (dataflow_with(folder, &replace), model)
}

#[test]
fn a_graph_starts_with_the_content_that_its_file_fixes_and_no_other() {
    let folder = tempfile::tempdir().expect("a folder");
    let right = digest(&project().join(MODEL));
    let (flow, model) = pinned(folder.path(), std::slice::from_ref(&right));
    let flow = flow.to_str().expect("UTF-8");
    run(&["run", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow], 0);
    std::fs::copy(paper_model(), &model).expect("copied");
    let found = digest(&model);
    for arguments in [&["run", "--check", flow][..], &["run", "--name", &unique_name(), flow]] {
        let said = text(&run(arguments, 1).stderr);
        let what = format!("node 'classifier': param 'model' is {}, whose SHA-256 is {found}", model.display());
        assert!(said.contains(&what) && said.contains(&format!("expected {right}")), "{said}");
    }
}

#[test]
fn a_program_is_compared_before_it_is_run_for_the_first_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let trace = folder.path().join("has_run");
    let program =
        script(folder.path(), "mine", &format!("touch {}; exec {} \"$@\"", trace.display(), operator("classifier")));
    let runs = || classifier_runs(&program, &format!("{{model: {MODEL}}}"));
    let with = |digest: &str| {
        let pin = of_node("classifier", &[&format!("sha256: {{run: {digest}}}")]);
        dataflow_with(folder.path(), &[runs(), pin])
    };
    let wrong = with(&"0".repeat(64));
    let said = text(&run(&["run", "--check", wrong.to_str().expect("UTF-8")], 1).stderr);
    assert!(said.contains("node 'classifier': the program is ") && !trace.exists(), "{said}");
    let right = with(&digest(&program));
    run(&["run", "--check", right.to_str().expect("UTF-8")], 0);
    assert!(trace.exists());

    // A replacement as well.
    let graph = Graph::start(&right, &FAST_FOREVER);
    let other_trace = folder.path().join("other_has_run");
    let other = script(folder.path(), "other", &format!("touch {}", other_trace.display()));
    let (_, said) = swap(&graph, &["classifier", "--run", other.to_str().expect("UTF-8")], 1);
    assert!(said.contains("the program is ") && said.contains("expected") && !other_trace.exists(), "{said}");
    graph.stop().assert_undisturbed("a refused swap");
}

#[test]
fn a_replacement_and_a_restart_must_have_a_content_that_the_file_fixes() {
    let folder = tempfile::tempdir().expect("a folder");
    let digests = [digest(&project().join(MODEL)), digest(paper_model())];
    let (flow, model) = pinned(folder.path(), &digests);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let set = |path: &Path| format!("model={}", path.display());
    let other = folder.path().join("other.json");
    std::fs::write(&other, "{}").expect("written");
    let (_, said) = swap(&graph, &["classifier", "--set", &set(&other)], 1);
    assert!(said.contains("node 'classifier' is not started: param 'model' is "), "{said}");
    let allowed = ["classifier", "--allow-mismatch", "--probation", "0.1", "--set", &set(paper_model())];
    swap(&graph, &allowed, 0);
    swap(&graph, &["classifier", "--probation", "0.1", "--set", &set(&model)], 0);
    graph.kill("classifier");
    graph.wait_for_decisions(3);
    std::fs::copy(&other, &model).expect("copied");
    signal(graph.pid_of("classifier"), Signal::KILL);
    let refused = "node 'classifier' node 'classifier' is not started: param 'model' is ";
    wait_until(|| graph.said().contains(refused), || graph.said());
}
