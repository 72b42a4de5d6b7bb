//! The outcome of the tests: for people, for scripts, for continuous integration.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use quick_xml::events::BytesText;
use quick_xml::writer::Writer;
use serde::Deserialize;
use serde_json::{Value, json};

use super::case::Case;
use super::scratch::file_name;
use crate::commands::{print_line, print_text, write_out};
use blindgrasp_cli::shard::{Place, hash, merge_files};
use blindgrasp_messages::files::read_regular;
use blindgrasp_operator::text::counted;
use blindgrasp_replay::checks::Check;

pub(super) fn print_case(case: &Case) -> anyhow::Result<()> {
    print_line(&case.recording.display().to_string())?;
    for Check { name, has_passed, text, .. } in &case.checks {
        print_line(&format!("  {}  {name:<24} {text}", if *has_passed { "ok  " } else { "FAIL" }))?;
    }
    for note in &case.notes {
        print_line(&format!("        {note}"))?;
    }
    Ok(())
}

/// Prints a table, and how many recordings passed.
pub(super) fn print_summary(cases: &[Case], is_json: bool, place: Option<Place>) -> anyhow::Result<()> {
    let n_failed = cases.iter().filter(|case| !case.has_passed()).count();
    let n_passed = cases.len() - n_failed;
    if is_json {
        let cases: Vec<_> = cases
            .iter()
            .map(|case| {
                json!({
                    "recording": case.recording.display().to_string(), "has_passed": case.has_passed(),
                    "checks": case.checks, "changed_actions": case.changed, "notes": case.notes, "secs": case.secs
                })
            })
            .collect();
        let mut line = json!({"recordings": cases, "n_passed": n_passed, "n_failed": n_failed});
        if let Some(place) = place {
            let content_id = hash(line["recordings"].to_string());
            line["place"] = serde_json::to_value(place.of_output(vec![1; n_passed + n_failed], content_id))?;
        }
        return Ok(print_text(&serde_json::to_string_pretty(&line)?)?);
    }
    print_line("")?;
    print_line(&format!(
        "{:<32} {:>7} {:>10} {:>10} {:>8}  failed",
        "recording", "checks", "samples", "differing", "time"
    ))?;
    for case in cases {
        let edges: Vec<_> = case.checks.iter().filter_map(|check| check.edge.as_ref()).collect();
        let failed: Vec<&str> =
            case.checks.iter().filter(|check| !check.has_passed).map(|check| check.name.as_str()).collect();
        print_line(&format!(
            "{:<32} {:>7} {:>10} {:>10} {:>7.1}s  {}",
            file_name(&case.recording),
            case.checks.len(),
            edges.iter().map(|edge| edge.n_recorded).sum::<u64>(),
            edges.iter().map(|edge| edge.n_differing).sum::<u64>(),
            case.secs,
            if failed.is_empty() { "-".into() } else { failed.join(", ") }
        ))?;
    }
    print_line(&format!("{}: {n_passed} passed, {n_failed} failed", counted(cases.len(), "recording")))?;
    Ok(())
}

/// The outcomes of all recordings, from the JSON of all shards.
pub(super) fn merged(paths: &[PathBuf]) -> anyhow::Result<Vec<Case>> {
    #[derive(Deserialize)]
    struct Printed {
        recordings: Value,
        place: Place,
    }
    merge_files(paths, |path| {
        let printed = serde_json::from_str(&read_regular(path)?);
        let Printed { recordings, place } = printed.context("expected the JSON of test --shard I/N --json")?;
        Ok((place, hash(recordings.to_string()), serde_json::from_value(recordings)?))
    })
}

/// Writes JUnit XML: a test suite per recording, a test case per check.
pub(super) fn write_junit(path: &Path, cases: &[Case]) -> anyhow::Result<()> {
    let mut xml = Vec::new();
    xml.extend_from_slice(b"<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n");
    let mut writer = Writer::new_with_indent(&mut xml, b' ', 2);
    let checks: Vec<_> = cases.iter().flat_map(|case| &case.checks).collect();
    let n_failed = checks.iter().filter(|check| !check.has_passed).count();
    writer
        .create_element("testsuites")
        .with_attribute(("name", "blindgrasp test"))
        .with_attribute(("tests", checks.len().to_string().as_str()))
        .with_attribute(("failures", n_failed.to_string().as_str()))
        .write_inner_content(|writer| cases.iter().try_for_each(|case| write_suite(writer, case)))
        .context("the JUnit report cannot be made")?;
    xml.push(b'\n');
    write_out(path, &String::from_utf8(xml)?)
}

fn write_suite<W: Write>(writer: &mut Writer<W>, case: &Case) -> std::io::Result<()> {
    let name = allowed(&case.recording.display().to_string());
    let n_failed = case.checks.iter().filter(|check| !check.has_passed).count();
    writer
        .create_element("testsuite")
        .with_attribute(("name", name.as_str()))
        .with_attribute(("tests", case.checks.len().to_string().as_str()))
        .with_attribute(("failures", n_failed.to_string().as_str()))
        .with_attribute(("time", format!("{:.3}", case.secs).as_str()))
        .write_inner_content(|writer| {
            for check in &case.checks {
                let element = writer
                    .create_element("testcase")
                    .with_attribute(("classname", name.as_str()))
                    .with_attribute(("name", allowed(&check.name).as_str()));
                let text = allowed(&check.text);
                element.write_inner_content(|writer| {
                    let said = if check.has_passed {
                        writer.create_element("system-out")
                    } else {
                        writer.create_element("failure").with_attribute(("message", text.as_str()))
                    };
                    said.write_text_content(BytesText::new(&text))?;
                    Ok(())
                })?;
            }
            if !case.notes.is_empty() {
                let notes = allowed(&case.notes.join("\n"));
                writer.create_element("system-out").write_text_content(BytesText::new(&notes))?;
            }
            Ok(())
        })?;
    Ok(())
}

/// Appends a summary in Markdown: a table of the recordings, then the failed checks and the changed actions.
pub(super) fn append_markdown(path: &Path, cases: &[Case]) -> anyhow::Result<()> {
    let n_failed = cases.iter().filter(|case| !case.has_passed()).count();
    let mut text = format!("## blindgrasp test: {} passed, {n_failed} failed\n\n", cases.len() - n_failed);
    text += "| recording | result | actions changed | failed checks |\n|---|---|---|---|\n";
    for case in cases {
        let failed: Vec<String> = failed(case).map(|check| cell(&check.name)).collect();
        let result = if case.has_passed() { "passed" } else { "**failed**" };
        let name = cell(&file_name(&case.recording));
        text += &format!("| {name} | {result} | {} | {} |\n", case.changed.len(), failed.join(", "));
    }
    for case in cases.iter().filter(|case| !case.has_passed()) {
        text += &format!("\n### {}\n\n", cell(&file_name(&case.recording)));
        for check in failed(case) {
            text += &format!("- {}: {}\n", cell(&check.name), cell(&check.text));
        }
        for note in &case.notes {
            text += &format!("- {}\n", cell(note));
        }
    }
    let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
    let written = file.and_then(|mut file| file.write_all(text.as_bytes()));
    written.with_context(|| format!("{} (--summary) cannot be written", path.display()))
}

fn failed(case: &Case) -> impl Iterator<Item = &Check> {
    case.checks.iter().filter(|check| !check.has_passed)
}

/// A text of one line that Markdown shows as it is.
fn cell(text: &str) -> String {
    let mut escaped = String::new();
    for char in allowed(text).replace('\n', " ").chars() {
        if matches!(char, '|' | '<' | '*' | '_' | '`' | '[' | '\\') {
            escaped.push('\\');
        }
        escaped.push(char);
    }
    escaped
}

/// Without the characters that XML cannot hold.
fn allowed(text: &str) -> String {
    text.chars().filter(|char| !char.is_control() || matches!(char, '\n' | '\t')).collect()
}
