//! The pages that people read: their links lead somewhere, and the book has all of them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use crate::{files_below, project, read};

#[test]
fn every_relative_link_leads_to_a_file_and_a_heading() {
    let mut broken = Vec::new();
    for page in pages() {
        for link in links(&read(&page)) {
            if is_external(&link) {
                continue;
            }
            let (path, anchor) = link.split_once('#').unwrap_or((link.as_str(), ""));
            let folder = page.parent().expect("a folder");
            let target = if path.is_empty() { page.clone() } else { folder.join(path) };
            if !target.exists() {
                broken.push(format!("{}: {link}: there is no such file", page.display()));
            } else if !anchor.is_empty() && !anchors(&read(&target)).contains(anchor) {
                broken.push(format!("{}: {link}: there is no such heading", page.display()));
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn the_book_has_every_page_of_docs_once() {
    let docs = project().join("docs");
    let entries = links(&read(&docs.join("SUMMARY.md")));
    let listed: BTreeSet<String> = entries.iter().cloned().collect();
    assert_eq!(listed.len(), entries.len(), "docs/SUMMARY.md names a page twice");
    let found: BTreeSet<String> = files_below(&docs, "md")
        .iter()
        .map(|page| page.strip_prefix(&docs).expect("below docs").to_string_lossy().into_owned())
        .filter(|name| name != "SUMMARY.md")
        .collect();
    assert_eq!(listed, found, "left: docs/SUMMARY.md, right: docs");
}

#[test]
fn anchors_and_links_are_found_as_github_does() {
    let text = "# What `set` does\n\n## Foxglove, RViz & more\n\n## Same\n\n## Same\n\n### See [it](a.md)\n\n\
                ```sh\n# no heading [x](y)\n```\n\n[a](b.md#c) `[d](e)` ![f](g.svg)\n";
    let expected = ["what-set-does", "foxglove-rviz--more", "same", "same-1", "see-it"].map(str::to_owned);
    assert_eq!(anchors(text), BTreeSet::from(expected));
    assert_eq!(links(text), ["a.md", "b.md#c", "g.svg"]);
}

/// README, ARCHITECTURE, CONTRIBUTING, all pages of docs and benches, and the README of each folder that has one.
fn pages() -> Vec<PathBuf> {
    let root = project();
    let mut pages: Vec<PathBuf> =
        ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"].map(|name| root.join(name)).into();
    pages.extend(files_below(&root.join("docs"), "md"));
    pages.extend(files_below(&root.join("benches"), "md"));
    let of_folders = ["hands", "recordings", "examples", "packaging"].map(|folder| root.join(folder).join("README.md"));
    pages.extend(of_folders.into_iter().filter(|page| page.exists()));
    pages
}

/// Whether a link names its scheme, such as `https:`.
fn is_external(link: &str) -> bool {
    link.split_once(':').is_some_and(|(scheme, _)| scheme.chars().all(|letter| letter.is_ascii_alphabetic()))
}

/// The lines outside of code blocks.
fn prose(text: &str) -> Vec<&str> {
    let mut is_code = false;
    let mut lines = Vec::new();
    for line in text.lines() {
        if line.trim_start().starts_with("```") {
            is_code = !is_code;
        } else if !is_code {
            lines.push(line);
        }
    }
    lines
}

/// The targets of links and pictures, without those in code spans. A link may begin on one line and end on the next.
fn links(text: &str) -> Vec<String> {
    let prose = prose(text).join("\n");
    // Every second part is in a code span; a span of pages is never empty.
    let outside: String = prose.split('`').step_by(2).collect();
    let mut targets = Vec::new();
    for part in outside.split("](").skip(1) {
        let target = part.split(')').next().unwrap_or_default();
        if !target.contains(char::is_whitespace) {
            targets.push(target.to_owned());
        }
    }
    targets
}

/// The anchors that GitHub gives a page's headings: small letters, digits, `-` and `_`, a hyphen for each space, and a
/// number behind headings that come again.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let mut anchors = BTreeSet::new();
    for line in prose(text) {
        let level = line.chars().take_while(|&letter| letter == '#').count();
        if !(1..=6).contains(&level) {
            continue;
        }
        let Some(heading) = line[level..].strip_prefix(' ') else { continue };
        let name: String = without_targets(heading)
            .trim()
            .to_lowercase()
            .chars()
            .filter(|&letter| letter.is_alphanumeric() || matches!(letter, '-' | '_' | ' '))
            .map(|letter| if letter == ' ' { '-' } else { letter })
            .collect();
        let n = counts.entry(name.clone()).or_default();
        anchors.insert(if *n == 0 { name } else { format!("{name}-{n}") });
        *n += 1;
    }
    anchors
}

/// A heading's text, with links replaced by what they show.
fn without_targets(heading: &str) -> String {
    let mut parts = heading.split("](");
    let mut text = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        text.push_str(part.split_once(')').map_or(part, |(_, rest)| rest));
    }
    text
}
