//! The packages of a release, and the package of cargo.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::common::python::python;
use crate::common::{program, project, skipped, text};

/// The tools of `scripts/release` that a machine with Rust may lack.
const TOOLS: [&str; 4] = ["git", "python3", "readelf", "dpkg-deb"];

#[test]
fn the_same_program_is_packed_into_the_same_bytes_and_runs_from_them() {
    if let Some(missing) = missing() {
        return skipped(&missing);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    release(&first);
    release(&second);
    let names = file_names(&first);
    assert_eq!(names, file_names(&second));
    for name in &names {
        let bytes = std::fs::read(first.join(name)).expect("readable");
        assert!(bytes == std::fs::read(second.join(name)).expect("readable"), "{name} has other bytes the second time");
    }
    succeed(Command::new("sha256sum").args(["--check", "--strict", "SHA256SUMS"]).current_dir(&first));

    let version = format!("blindgrasp {}\n", env!("CARGO_PKG_VERSION"));
    let package = first.join(one(&names, ".deb"));
    let field = |name: &str| succeed(Command::new("dpkg-deb").arg("--field").arg(&package).arg(name)).trim().to_owned();
    assert_eq!(field("Package"), "blindgrasp");
    assert_eq!(field("Version"), env!("CARGO_PKG_VERSION"));
    assert!(field("Depends").contains("libc6 (>= 2."), "{}", field("Depends"));
    let root = folder.path().join("root");
    succeed(Command::new("dpkg-deb").arg("--extract").arg(&package).arg(&root));
    for file in [
        "usr/bin/blindgrasp-lab",
        "usr/bin/blindgrasp-network",
        "usr/lib/systemd/system/blindgrasp@.service",
        "usr/share/bash-completion/completions/blindgrasp",
        "usr/share/doc/blindgrasp/README.md",
        "usr/share/doc/blindgrasp/changelog.gz",
        "usr/share/doc/blindgrasp/copyright",
        "usr/share/doc/blindgrasp/docs/command-line.md",
        "usr/share/doc/blindgrasp/docs/install.md",
        "usr/share/doc/blindgrasp/third-party-licences.txt.gz",
        "usr/share/fish/vendor_completions.d/blindgrasp.fish",
        "usr/share/man/man1/blindgrasp-keys.1.gz",
        "usr/share/man/man1/blindgrasp-simulate.1.gz",
        "usr/share/man/man1/blindgrasp.1.gz",
        "usr/share/zsh/vendor-completions/_blindgrasp",
    ] {
        assert!(root.join(file).is_file(), "{file} is missing in {}", package.display());
    }
    assert_eq!(succeed(Command::new(root.join("usr/bin/blindgrasp")).arg("--version")), version);
    let help = succeed(Command::new(root.join("usr/bin/blindgrasp")).args(["simulate", "--help"]));
    assert!(help.contains("--grasps"), "{help}");

    let tarball = first.join(one(&names, ".tar.gz"));
    succeed(Command::new("tar").arg("-xf").arg(&tarball).arg("-C").arg(folder.path()));
    let name = one(&names, ".tar.gz").trim_end_matches(".tar.gz");
    let unpacked = folder.path().join(name);
    assert_eq!(succeed(Command::new(unpacked.join("bin/blindgrasp")).arg("--version")), version);
    assert!(unpacked.join("LICENSE").is_file() && unpacked.join("share/man/man1/blindgrasp.1").is_file());

    let sbom = std::fs::read_to_string(first.join(one(&names, ".cdx.json"))).expect("readable");
    let sbom: serde_json::Value = serde_json::from_str(&sbom).expect("JSON");
    let components = sbom["components"].as_array().expect("a list");
    let has = |name: &str| components.iter().any(|component| component["name"] == name);
    assert!(has("iceoryx2") && has("zenoh") && has("blindgrasp-stages") && has("three"), "{components:?}");
    // It is a dependency of tests alone.
    assert!(!has("loom"), "{components:?}");
}

#[test]
fn the_package_of_cargo_has_all_files_that_init_writes() {
    let folder = tempfile::tempdir().expect("a folder");
    let demo = folder.path().join("demo");
    crate::common::run(&["init", "--ros2", demo.to_str().expect("UTF-8")], 0);
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["package", "--list", "--allow-dirty", "--offline", "--package", "blindgrasp"]).current_dir(project());
    let listed = succeed(&mut cargo);
    for file in files_below(&demo) {
        let name = file.strip_prefix(&demo).expect("below").to_str().expect("UTF-8").to_owned();
        let example = format!("examples/{name}");
        // The schema is made from the operators, and README is another.
        let is_made = name.ends_with("schema.json") || name == "README.md";
        assert!(
            is_made || listed.lines().any(|line| line == name || line == example),
            "Cargo.toml's include has no {name}"
        );
    }
}

/// A maintainer's command, in a clone: mistakes are listed before anything is made, and without --go nothing is tagged.
#[test]
fn a_version_is_published_only_if_it_is_the_same_everywhere() {
    if let Some(missing) = missing() {
        return skipped(&missing);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let (clone, out) = (folder.path().join("clone"), folder.path().join("dist"));
    succeed(Command::new("git").args(["clone", "--quiet", "--no-tags"]).arg(project()).arg(&clone));
    let version = env!("CARGO_PKG_VERSION");
    let changelog = clone.join("CHANGELOG.md");
    let of_this_tree = |name: &str| assert!(std::fs::copy(project().join(name), clone.join(name)).is_ok(), "{name}");
    ["CHANGELOG.md", "CITATION.cff", "Cargo.toml", "scripts/publish", "scripts/release", "scripts/python-wheel"]
        .into_iter()
        .for_each(of_this_tree);
    let written = std::fs::read_to_string(&changelog).expect("readable");
    let dated = |date: &str| {
        let begin = written.find("\n## ").expect("a heading") + 1;
        let end = begin + written[begin..].find('\n').expect("more lines");
        let dated = format!("{}## {version} ({date}){}", &written[..begin], &written[end..]);
        std::fs::write(&changelog, dated).expect("written");
    };
    let commit = || {
        let author = ["-c", "user.name=a", "-c", "user.email=a@example.org"];
        let commit = ["commit", "--quiet", "--allow-empty", "--all", "--message", "a version"];
        succeed(Command::new("git").args(author).args(commit).current_dir(&clone));
    };
    let publish = |is_right: bool| {
        let mut command = Command::new(clone.join("scripts/publish"));
        command.arg("--program").arg(program()).arg("--out").arg(&out).arg("--fast");
        command.env("PATH", path_with_python()).env_remove("CARGO_TARGET_DIR");
        let output = output(&mut command).expect("started");
        let said = format!("{}{}", text(&output.stdout), text(&output.stderr));
        assert_eq!(output.status.success(), is_right, "{said}");
        said
    };
    dated("unreleased");
    let citation = std::fs::read_to_string(clone.join("CITATION.cff")).expect("readable");
    let other = citation.replace(&format!("version: {version}"), "version: 9.9.9");
    std::fs::write(clone.join("CITATION.cff"), other).expect("written");
    let said = publish(false);
    for mistake in ["has version 9.9.9", "CHANGELOG.md begins", "not committed", "your name", "its address"] {
        assert!(said.contains(mistake), "{mistake}: {said}");
    }
    assert!(!out.exists(), "{said}");

    dated("2026-11-27");
    std::fs::write(clone.join("CITATION.cff"), citation).expect("written");
    let names = "sed -i -e s/example.org/grasps.dev/ -e 's/The founders of blindgrasp/A. Person/' Cargo.toml CITATION.cff $(git ls-files '*package.xml')";
    succeed(Command::new("sh").args(["-c", names]).current_dir(&clone));
    commit();
    let said = publish(true);
    let places = ["blindgrasp-messages", "blindgrasp-stages", "blindgrasp-operators"]
        .map(|name| said.find(&format!("  {name}\n")));
    assert!(places.is_sorted() && places[0].is_some(), "{said}");
    let names = file_names(&out);
    for end in [".deb", ".tar.gz", ".cdx.json", "_x86_64.whl"] {
        one(&names, end);
    }
    let tags = succeed(Command::new("git").args(["tag", "--list"]).current_dir(&clone));
    assert!(!tags.contains(&format!("v{version}")), "{tags}");

    succeed(Command::new("git").args(["tag", &format!("v{version}")]).current_dir(&clone));
    assert!(publish(false).contains("is there already"));
}

/// The search path, with the Python of the tests first: it builds wheels without PyPI.
fn path_with_python() -> String {
    let others = std::env::var("PATH").unwrap_or_default();
    format!("{}:{others}", python().parent().expect("a folder").display())
}

/// The part that a release needs and this machine lacks.
fn missing() -> Option<String> {
    if let Some(tool) = TOOLS.iter().find(|tool| output(Command::new(tool).arg("--version")).is_none()) {
        return Some(format!("{tool} is missing"));
    }
    if project().join(".git").exists() { None } else { Some("the source is no clone of git".into()) }
}

/// Packs the program of this build.
fn release(out: &Path) {
    let mut command = Command::new(project().join("scripts/release"));
    command.arg("--program").arg(program()).arg("--out").arg(out).arg("--fast");
    succeed(&mut command);
}

/// Runs a program that must succeed, and returns its stdout.
fn succeed(command: &mut Command) -> String {
    let output = output(command).unwrap_or_else(|| panic!("{command:?} does not start"));
    assert!(output.status.success(), "{command:?}\n{}\n{}", text(&output.stdout), text(&output.stderr));
    text(&output.stdout)
}

fn output(command: &mut Command) -> Option<Output> {
    command.stdin(Stdio::null()).output().ok()
}

fn file_names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = files_below(folder)
        .iter()
        .map(|path| path.file_name().expect("a name").to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// The one file whose name ends like this.
fn one<'a>(names: &'a [String], end: &str) -> &'a str {
    let found: Vec<&String> = names.iter().filter(|name| name.ends_with(end)).collect();
    assert_eq!(found.len(), 1, "{end}: {names:?}");
    found[0]
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).expect("readable") {
        let path = entry.expect("readable").path();
        if path.is_dir() {
            files.extend(files_below(&path));
        } else {
            files.push(path);
        }
    }
    files
}
