//! The JSON Schema of the dataflow file, as an independent validator reads it.

use std::path::Path;

use blindgrasp_graph::dataflow;
use blindgrasp_graph::operators::LINK_OPERATOR;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operators::SHIPPED;
use blindgrasp_operators::houses::OTHER_HOUSES;

use crate::common::python::{python, shell, utf8};
use crate::common::{json_lines, project, run, text};

/// The mistakes that the validator finds in files with these contents.
fn errors(folder: &Path, contents: &[&str]) -> Vec<Vec<String>> {
    let schema = folder.join("schema.json");
    std::fs::write(&schema, run(&["schema"], 0).stdout).expect("written");
    let files: Vec<_> = (0..contents.len()).map(|idx| folder.join(format!("{idx}.yaml"))).collect();
    for (file, content) in files.iter().zip(contents) {
        std::fs::write(file, content).expect("written");
    }
    let script = project().join("tests/validate_dataflow.py");
    let arguments: Vec<&str> = [&script, &schema].into_iter().chain(&files).map(|path| utf8(path)).collect();
    let output = shell(folder, python(), &arguments, 0);
    let texts = |line: serde_json::Value| serde_json::from_value(line["errors"].clone()).expect("texts");
    json_lines(&output.stdout).into_iter().map(texts).collect()
}

#[test]
fn the_schema_accepts_good_files_and_names_mistakes() {
    let folder = tempfile::tempdir().expect("a folder");
    let shipped = ["dataflow", "dataflow-live", "dataflow-machines"];
    let mut files: Vec<String> =
        shipped.map(|name| std::fs::read_to_string(project().join(format!("{name}.yaml"))).expect("a file")).into();
    let good = &files[0];
    let cases = [
        ("votes: 3", "vots: 3", "'vots' was unexpected"),
        ("votes: 3", "votes: 0.5", "0.5"),
        ("rate: 10", "rate: fast", "fast"),
        ("    sandbox: on", "    sandbox: sometimes", "'sometimes' is not valid"),
        ("inputs: {contacts: contacts/contacts}", "inputs: {contcts: contacts/contacts}", "'contcts' does not match"),
        ("inputs: {feature: encoder/feature}", "inputs: {feature: encoder}", "'encoder'"),
        ("  classifier:\n    inputs:", "  judge:\n    run: classifier\n    inpts:", "'inpts' was unexpected"),
        ("version: 1", "version: 2", "1 was expected"),
    ];
    let wrong: Vec<String> = cases
        .iter()
        .map(|(part, by, _)| {
            assert!(good.contains(part), "dataflow.yaml has no '{part}'");
            good.replacen(part, by, 1)
        })
        .collect();
    let other_good = [
        good.replace("rate: 10", "rate: ${RATE:-10}").replace("votes: 3", "votes: ${VOTES}").replacen(
            "    sandbox: on",
            "    sandbox: \"${S:-on}\"",
            1,
        ),
        good.replace("  classifier:\n", "  judge:\n    run: classifier\n").replace("classifier/", "judge/"),
        good.replace("  classifier:\n", "  judge:\n    run: ./mine.py\n    restart: {policy: always, limit: 3}\n"),
    ];
    files.extend(other_good);
    let n_good = files.len();
    files.extend(wrong);
    let found = errors(folder.path(), &files.iter().map(String::as_str).collect::<Vec<_>>());
    for (errors, file) in found.iter().zip(&files).take(n_good) {
        assert!(errors.is_empty(), "{errors:?}\n{file}");
    }
    for (errors, (part, by, expected)) in found[n_good..].iter().zip(cases) {
        assert!(errors.iter().any(|error| error.contains(expected)), "{part} -> {by}: {errors:?}");
    }
}

/// The program and editors that open the project's dataflow files read the schema there. BLINDGRASP_REMAKE=1 writes it.
#[test]
fn the_committed_schema_is_that_of_the_operators() {
    let names = SHIPPED.iter().map(|shipped| shipped.name).chain(OTHER_HOUSES.iter().map(|(name, _)| *name));
    let operators = names.filter(|name| *name != LINK_OPERATOR).map(|name| {
        let description = run(&["operator", name, "--describe"], 0).stdout;
        OperatorDescription::from_json(&text(&description)).expect("a description")
    });
    let schema = format!("{:#}\n", dataflow::schema(&operators.collect::<Vec<_>>()));
    let path = project().join("docs/dataflow.schema.json");
    if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
        std::fs::write(&path, &schema).expect("written");
    }
    let committed = std::fs::read_to_string(&path).expect("docs/dataflow.schema.json");
    assert!(committed == schema, "docs/dataflow.schema.json is another: write it with BLINDGRASP_REMAKE=1");
}
