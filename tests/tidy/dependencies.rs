//! The work of others that the project uses: crates with known faults, and the actions of workflows.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};

use crate::{project, read};

#[test]
fn a_version_has_a_fault_from_the_first_to_before_the_mended_one() {
    let advisories = "# of some day\nA one 0.0.0-0..0.11.6 0.12.0..0.12.1\nB two 1.0.0..\nC three 0.0.0-0..9.0.0\n";
    for (name, version, expected) in [
        ("one", "0.10.0", vec!["A"]),
        ("one", "0.11.6", vec![]),
        ("one", "0.12.0", vec!["A"]),
        ("one", "0.12.1+spec-1.1.0", vec![]),
        ("two", "0.9.9", vec![]),
        ("two", "1.0.0", vec!["B"]),
        ("four", "1.0.0", vec![]),
    ] {
        let lock = format!("version = 4\n\n[[package]]\nname = \"{name}\"\nversion = \"{version}\"\n");
        let found: Vec<&str> = faults(advisories, &lock).into_keys().collect();
        assert_eq!(found, expected, "{name} {version}");
    }
}

#[test]
fn each_known_fault_of_a_crate_is_answered_and_no_other() {
    let [advisories, lock, deny] =
        ["tests/advisories.txt", "Cargo.lock", "deny.toml"].map(|name| read(&project().join(name)));
    let faults = faults(&advisories, &lock);
    let answers: Vec<&str> = deny.split("{ id = \"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    for (id, crate_name) in &faults {
        assert!(
            answers.contains(id),
            "{id} is a fault of {crate_name}: use another version, or answer it in deny.toml"
        );
    }
    for id in answers {
        assert!(faults.contains_key(id), "deny.toml answers {id}, which no crate of Cargo.lock has: delete the answer");
    }
}

/// The advisories on crates that a Cargo.lock names, each with such a crate and its version.
fn faults<'a>(advisories: &'a str, lock: &str) -> BTreeMap<&'a str, String> {
    let mut found = BTreeMap::new();
    for package in lock.split("[[package]]").skip(1) {
        let mut values = package.split('"').skip(1).step_by(2);
        let (Some(name), Some(version)) = (values.next(), values.next()) else { panic!("a package: {package}") };
        for line in advisories.lines().filter(|line| !line.starts_with('#')) {
            let mut words = line.split(' ');
            let (Some(id), Some(of)) = (words.next(), words.next()) else { panic!("an advisory: {line}") };
            if of == name && words.any(|range| is_within(version, range)) {
                found.insert(id, format!("{name} {version}"));
            }
        }
    }
    found
}

/// A range is FIRST..AFTER, without AFTER if no version is mended.
fn is_within(version: &str, range: &str) -> bool {
    let (first, after) = range.split_once("..").expect("a range");
    numbers(first) <= numbers(version) && (after.is_empty() || numbers(version) < numbers(after))
}

/// The three numbers of a version. A pre-release counts as its release.
fn numbers(version: &str) -> Vec<u64> {
    let end = version.find(['-', '+']).unwrap_or(version.len());
    version[..end].split('.').map(|number| number.parse().expect("a number")).collect()
}

/// Also for its tests, so that each house is built and tested by itself.
#[test]
fn no_house_needs_the_crates_of_another() {
    let lock = read(&project().join("Cargo.lock"));
    let of_lab = [packages_in("lab"), packages_in("lab/crates"), vec!["rapier3d-f64".into()]].concat();
    let of_network = [packages_in("network"), packages_in("network/crates"), vec!["zenoh".into()]].concat();
    let robot = ["blindgrasp".to_owned()];
    for (program, others) in [
        ("blindgrasp", [&of_lab[..], &of_network].concat()),
        ("blindgrasp-lab", [&robot[..], &of_network].concat()),
        ("blindgrasp-network", [&robot[..], &of_lab].concat()),
    ] {
        let needed = needed_by(&lock, program);
        assert!(needed.len() > 10 && others.len() > 3, "{needed:?}, {others:?}");
        for other in &others {
            assert!(
                !needed.contains(other.as_str()),
                "{program} depends on {other}, which is of another house: ARCHITECTURE.md"
            );
        }
    }
}

/// The names of the packages in a folder and its folders.
fn packages_in(folder: &str) -> Vec<String> {
    let folder = project().join(folder);
    let below = std::fs::read_dir(&folder).expect("a folder").flatten().map(|entry| entry.path());
    let manifests = below.chain([folder.clone()]).map(|folder| folder.join("Cargo.toml"));
    let texts = manifests.filter(|manifest| manifest.is_file()).map(|manifest| read(&manifest));
    let name =
        |text: String| text.split_once("name = \"").and_then(|(_, rest)| Some(rest.split_once('"')?.0.to_owned()));
    texts.filter_map(name).collect()
}

/// What a package of Cargo.lock depends on, over others as well.
fn needed_by<'a>(lock: &'a str, package: &'a str) -> BTreeSet<&'a str> {
    let mut needed = BTreeSet::new();
    let mut ahead = vec![package];
    while let Some(name) = ahead.pop() {
        let head = format!("\nname = \"{name}\"\n");
        for of_name in lock.split("[[package]]").filter(|package| package.starts_with(&head)) {
            let dependencies = of_name.split_once("dependencies = [").unwrap_or_default().1;
            for words in dependencies.split('"').skip(1).step_by(2) {
                // A version follows the name where there are several.
                let dependency = words.split(' ').next().unwrap_or_default();
                if needed.insert(dependency) {
                    ahead.push(dependency);
                }
            }
        }
    }
    needed
}

/// A tag of an action can be moved to other content, and a checkout's credentials can be read by all later steps.
#[test]
fn workflows_run_actions_of_one_content_and_keep_no_credentials() {
    for folder in [".github/workflows", "docs/ci"] {
        for entry in std::fs::read_dir(project().join(folder)).expect("readable") {
            let path = entry.expect("readable").path();
            let workflow: Value = serde_saphyr::from_str(&read(&path)).expect("YAML");
            // Those of GitLab have no actions.
            for (_, job) in workflow["jobs"].as_object().into_iter().flatten() {
                for step in job["steps"].as_array().expect("steps") {
                    assert_step_is_pinned(step, &path.display().to_string());
                }
            }
        }
    }
}

#[test]
fn the_workflow_of_a_release_builds_on_both_machines_before_it_publishes() {
    let workflow = read(&project().join(".github/workflows/release.yml"));
    let workflow: Value = serde_saphyr::from_str(&workflow).expect("YAML");
    let build = &workflow["jobs"]["build"];
    assert_eq!(build["strategy"]["matrix"]["runner"], json!(["ubuntu-22.04", "ubuntu-22.04-arm"]));
    assert_eq!(workflow["jobs"]["publish"]["needs"], "build");
}

fn assert_step_is_pinned(step: &Value, file: &str) {
    if let Some(script) = step["run"].as_str().filter(|run| run.starts_with("scripts/")) {
        let path = project().join(script.split(' ').next().expect("a word"));
        assert!(path.is_file(), "{file}: {} is not there", path.display());
    }
    let Some((action, commit)) = step["uses"].as_str().and_then(|action| action.split_once('@')) else { return };
    let is_commit = commit.len() == 40 && commit.bytes().all(|byte| byte.is_ascii_hexdigit());
    assert!(is_commit, "{file}: {action} is used by '{commit}', expected a commit");
    if action == "actions/checkout" {
        assert_eq!(step["with"]["persist-credentials"], false, "{file}: {step}");
    }
}
