//! Every mistake that a dataflow file can have, with the place and words in which it is reported.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use serde_json::json;

use super::*;
use crate::operators::Operators;

mod machines;
mod settings;
mod supervision;

const GOOD: &str = "\
version: 1
name: grasp_gate
operators:
  arbiter:
    inputs: {contacts: contacts/contacts, veto: second/tactile}
  contacts: # a comment
    inputs: {tactile: source/tactile}
    params: {hand: ./hands/a.yaml}
  source:
    params:
      recording: recordings/a.mcap
      rate: 2
  second:
    run: ./ops/own
";

const SOURCE: &str = r#"{
    "protocol": 5, "operator": "source", "version": "0.1.0", "summary": "Replays",
    "outputs": [{"name": "tactile", "type": "t/Tactile/1"}, {"name": "joints", "type": "t/Joints/1"}],
    "params": [
        {"name": "recording", "kind": "path", "summary": "What to replay"},
        {"name": "rate", "kind": "number", "above": 0, "words": ["max"], "default": "max"},
        {"name": "loops", "kind": "integer", "min": 1, "max": 9, "default": 1},
        {"name": "verify", "kind": "boolean", "default": true},
        {"name": "on_end", "kind": "choice", "values": ["stop", "no", "off"], "default": "stop"},
        {"name": "label", "kind": "string", "optional": true},
        {"name": "log", "kind": "path", "must_exist": false, "optional": true}
    ]
}"#;

const CONTACTS: &str = r#"{
    "protocol": 5, "operator": "contacts", "version": "0.1.0",
    "inputs": [{"name": "tactile", "type": "t/Tactile/1"}],
    "outputs": [{"name": "contacts", "type": "t/Contacts/1"}],
    "params": [{"name": "hand", "kind": "path"}]
}"#;

const ARBITER: &str = r#"{
    "protocol": 5, "operator": "arbiter", "version": "0.1.0",
    "inputs": [
        {"name": "contacts", "type": "t/Contacts/1"},
        {"name": "veto", "type": "t/Tactile/1", "optional": true}
    ]
}"#;

const OWN: &str = r#"{
    "protocol": 5, "operator": "own", "version": "9", "outputs": [{"name": "tactile", "type": "t/Tactile/1"}]
}"#;

/// Reads the same type as it writes, so that it can be chained and looped.
const FILTER: &str = r#"{
    "protocol": 5, "operator": "filter", "version": "9",
    "inputs": [{"name": "in", "type": "t/Tactile/1"}], "outputs": [{"name": "out", "type": "t/Tactile/1"}]
}"#;

/// A source that is told what became of its samples.
const TOLD: &str = r#"{
    "protocol": 5, "operator": "told", "version": "9",
    "inputs": [{"name": "back", "type": "t/Tactile/1", "feedback": true}],
    "outputs": [{"name": "tactile", "type": "t/Tactile/1"}]
}"#;

/// A folder with a dataflow file and what it refers to; removed in the end.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        static N_FOLDERS: AtomicUsize = AtomicUsize::new(0);
        let n = N_FOLDERS.fetch_add(1, Ordering::Relaxed);
        let folder = std::env::temp_dir().join(format!("blindgrasp-dataflow-{}-{n}", std::process::id()));
        for (path, mode) in
            [("hands/a.yaml", 0o644), ("recordings/a.mcap", 0o644), ("ops/own", 0o755), ("ops/text", 0o644)]
        {
            let path = folder.join(path);
            fs::create_dir_all(path.parent().expect("it is in a folder")).expect("temporary folder");
            fs::write(&path, "").expect("temporary file");
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("mode");
        }
        Self(folder)
    }

    fn check(&self, yaml: impl AsRef<[u8]>) -> Result<Graph, DataflowError> {
        let path = self.0.join("dataflow.yaml");
        fs::write(&path, yaml).expect("dataflow file");
        check(&load(&path)?, &shipped(), &[], Scope::Everything, describe)
    }

    /// As [`Folder::check`] of the good file, with `--set` of these.
    fn check_set(&self, settings: &[&str]) -> Result<Graph, DataflowError> {
        let file = parse(&self.0.join("dataflow.yaml"), GOOD.as_bytes())?;
        let overrides: Vec<Override> =
            settings.iter().map(|text| Override::parse(text).expect("node.param=value")).collect();
        check(&file, &shipped(), &overrides, Scope::Everything, describe)
    }

    /// The diagnostics, with this folder left out.
    fn errors(&self, yaml: impl AsRef<[u8]>) -> String {
        let error = self.check(yaml).expect_err("the file has mistakes");
        error.to_string().replace(&format!("{}/", self.0.display()), "")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn shipped() -> Operators {
    let names = ["source", "contacts", "arbiter", "filter", "broken", "nonsense", "newer", "crooked"];
    Operators::in_folder(Path::new("/bin"), &names)
}

fn describe(program: &Path, args: &[String]) -> Result<OperatorDescription, String> {
    let json = match program.file_name().and_then(|name| name.to_str()) {
        Some("own") if args == ["--filter"] => FILTER,
        Some("own") if args == ["--told"] => TOLD,
        Some("own") if !args.is_empty() => return Err("it failed at --describe".to_owned()),
        Some("source") => SOURCE,
        Some("contacts") => CONTACTS,
        Some("arbiter") => ARBITER,
        Some("own") => OWN,
        Some("filter") => FILTER,
        Some("broken") => return Err("exit status 3\nno such device\n".to_owned()),
        Some("nonsense") => "Usage: nonsense",
        Some("newer") => r#"{"protocol": 6, "operator": {"id": "newer"}}"#,
        _ => {
            r#"{"protocol": 5, "operator": "crooked", "version": "1", "outputs": [
            {"name": "a", "type": "t"}, {"name": "a", "type": "t"}]}"#
        }
    };
    OperatorDescription::from_json(json).map_err(|error| error.to_string())
}

/// Expects these diagnostics, one a line, each without the file's name.
fn check_err(yaml: impl AsRef<[u8]>, expected: &str) {
    let found = Folder::new().errors(yaml.as_ref());
    let expected: Vec<String> = expected
        .lines()
        .map(|line| {
            let space = if line.starts_with(char::is_numeric) { "" } else { " " };
            format!("dataflow.yaml:{space}{line}")
        })
        .collect();
    assert_eq!(found, expected.join("\n"), "\n{}", String::from_utf8_lossy(yaml.as_ref()));
}

/// As [`check_err`], for what stands below `operators:` in line 3.
fn check_nodes_err(nodes: &str, expected: &str) {
    check_err(format!("version: 1\nname: g\noperators:\n{nodes}"), expected);
}

/// As [`check_err`], for a param of the source, in line 7 from column 7 on.
fn check_param_err(params: &str, expected: &str) {
    check_nodes_err(&format!("  source:\n    params:\n      recording: recordings/a.mcap\n      {params}\n"), expected);
}

#[test]
fn a_good_file_becomes_a_graph() {
    let folder = Folder::new();
    let graph = folder.check(GOOD).expect("good");
    let at = |path: &str| folder.0.join(path).to_str().expect("UTF-8").to_owned();
    assert_eq!(graph.name, "grasp_gate");
    assert_eq!(graph.file, folder.0.join("dataflow.yaml"));

    // Sources first, then by distance from them; ties as in the file.
    let ids: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
    assert_eq!(ids, ["source", "second", "contacts", "arbiter"]);
    assert_eq!(graph.node("source").map(|node| node.program.as_path()), Some(Path::new("/bin/source")));
    assert_eq!(graph.node("second").map(|node| node.program.clone()), Some(at("ops/own").into()));
    assert_eq!(graph.node("second").map(Node::outputs).map(|outputs| outputs[0].name.as_str()), Some("tactile"));
    assert_eq!(
        serde_json::Value::from(graph.nodes[0].params.clone()),
        json!({
            "recording": at("recordings/a.mcap"), "rate": 2.0, "loops": 1, "verify": true, "on_end": "stop"
        })
    );
    assert_eq!(serde_json::Value::from(graph.nodes[2].params.clone()), json!({"hand": at("hands/a.yaml")}));

    let edges: Vec<String> = graph
        .edges()
        .map(|edge| {
            format!("{}/{} -> {}/{} {}", edge.from_node, edge.from_port, edge.to_node, edge.to_port, edge.type_name)
        })
        .collect();
    assert_eq!(
        edges,
        [
            "source/tactile -> contacts/tactile t/Tactile/1",
            "contacts/contacts -> arbiter/contacts t/Contacts/1",
            "second/tactile -> arbiter/veto t/Tactile/1",
        ]
    );
}

#[test]
fn words_mean_what_the_kind_says() {
    let folder = Folder::new();
    for (given, name, expected) in [
        ("on_end: no", "on_end", json!("no")),
        ("on_end: off", "on_end", json!("off")),
        ("on_end: 'no'", "on_end", json!("no")),
        ("label: no", "label", json!("no")),
        ("label: 010", "label", json!("010")),
        ("label: 'null'", "label", json!("null")),
        ("label: ''", "label", json!("")),
        ("verify: false", "verify", json!(false)),
        ("rate: max", "rate", json!("max")),
        ("rate: 1e-3", "rate", json!(0.001)),
        ("rate: +.5", "rate", json!(0.5)),
        ("loops: 9", "loops", json!(9)),
        ("loops: +3", "loops", json!(3)),
    ] {
        let yaml = format!(
            "version: 1\nname: g\noperators: {{source: {{params: {{recording: recordings/a.mcap, {given}}}}}}}"
        );
        let graph = folder.check(yaml).expect(given);
        assert_eq!(graph.nodes[0].params.get(name), Some(&expected), "{given}");
    }
    let yaml = "version: 1\nname: g\noperators: {source: {params: {recording: /, log: new/x.log}}}";
    let graph = folder.check(yaml).expect("a path that need not exist");
    let log = folder.0.join("new/x.log");
    assert_eq!(graph.nodes[0].params.get("log").and_then(|log| log.as_str()), log.to_str());
    assert_eq!(graph.nodes[0].params.get("recording"), Some(&json!("/")));
}

#[test]
fn paths_are_relative_to_the_file_not_to_the_working_folder() {
    let folder = Folder::new();
    fs::write(folder.0.join("hands/graph.yaml"), GOOD.replace("./", "../").replace("recordings", "../recordings"))
        .expect("write");
    let file = load(&folder.0.join("hands/graph.yaml")).expect("form");
    let graph = check(&file, &shipped(), &[], Scope::Everything, describe).expect("good");
    assert_eq!(graph.nodes[0].params["recording"], json!(folder.0.join("hands/../recordings/a.mcap")));
}

#[test]
fn a_program_is_asked_once_for_the_same_arguments() {
    let folder = Folder::new();
    let yaml = b"version: 1\nname: g\noperators: {a: {run: ./ops/own}, b: {run: ops/own}, \
                 c: {run: ops/own, args: [--filter], inputs: {in: a/tactile}}, \
                 d: {run: ops/own, args: ['--filter'], inputs: {in: b/tactile}}}";
    let file = parse(&folder.0.join("dataflow.yaml"), yaml).expect("form");
    let mut asked = Vec::new();
    let graph = check(&file, &shipped(), &[], Scope::Everything, |program, args| {
        asked.push((program.to_owned(), args.to_vec()));
        describe(program, args)
    });
    assert_eq!(graph.expect("good").nodes.len(), 4);
    let own = folder.0.join("ops/own");
    assert_eq!(asked, [(own.clone(), vec![]), (own, vec!["--filter".to_owned()])]);
}

#[test]
fn unreadable_files() {
    let folder = Folder::new();
    let error = load(&folder.0.join("absent.yaml")).expect_err("missing").to_string();
    assert!(error.contains("absent.yaml: cannot read the file: No such file or directory (os error 2)"), "{error}");
    assert!(error.ends_with("; blindgrasp init DIR makes a project with one"), "{error}");
    let error = load(&folder.0).expect_err("a folder").to_string();
    assert!(error.contains(": cannot read the file: it is a folder, expected a regular file"), "{error}");
    let error = load(Path::new("/dev/zero")).expect_err("endless").to_string();
    assert_eq!(error, "/dev/zero: cannot read the file: it is a device, expected a regular file");

    check_err(b"version: 1\nname: \xc3\xa9\xff\n", "2:8: not UTF-8 text");
    check_err("", "1:1: the file is empty");
    check_err("# nothing\n\n", "1:1: the file is empty");
    check_err("---\n...\n", "1:1: the file is empty");
    check_err("~\n", "1:1: the file is empty");
    check_err(" ".repeat((1 << 20) + 1), "larger than 1 MiB, so it is not a dataflow file");
}

#[test]
fn not_the_yaml_we_read() {
    check_err("version: 1\nname: [a\n", "2:7: not valid YAML: unclosed bracket '['");
    check_err("version: 1\nname: a: b\n", "2:8: not valid YAML: mapping values are not allowed in this context");
    check_err("version: 1\nname: @a\n", "2:7: not valid YAML: unexpected character: `@'");
    check_err("version: 1\n\tname: a\n", "2:1: a tab in the indentation; indent with spaces");
    check_err("a:\n  b: 1\n  \tc: 1\n", "3:3: a tab in the indentation; indent with spaces");
    check_err("version: 1\n---\nname: a\n", "2:1: a second document; a dataflow file is one document");
    check_err("%YAML 1.1\n---\nname: a\n", "1:1: not valid YAML: YAML directives are disallowed");
    check_err("name: &a x\nb: *a\n", "1:10: an anchor is not allowed in a dataflow file; write the value out");
    check_err("name: *a\n", "1:7: not valid YAML: while parsing node, found unknown anchor");
    check_err("name: !!str x\n", "1:13: a tag is not allowed in a dataflow file; write the value out");
    check_err("? [a, b]\n: 1\n", "1:3: a key must be text, found a list");
    for (yaml, found) in [("- version: 1\n", "a list"), ("hello\n", "'hello'"), ("version:1\n", "'version:1'")] {
        check_err(
            yaml,
            &format!(
                "1:1: a dataflow file is a mapping, found {found}; \
                 it begins with 'version: 1' and has the keys version, name, params, machines, link, operators"
            ),
        );
    }
    // An alias bomb stops at its first anchor.
    check_err(
        "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n",
        "1:7: an anchor is not allowed in a dataflow file; write the value out",
    );
}

#[test]
fn deep_and_large_files_are_refused_quickly() {
    check_err(format!("a: {}", "[".repeat(500_000)), "1:20: not valid YAML: recursion limit exceeded");
    check_err("{a: ".repeat(200_000), "1:65: not valid YAML: recursion limit exceeded");
    check_err("- ".repeat(400_000), "1:33: not valid YAML: recursion limit exceeded");
    let keys: String = (0..60_000).map(|key| format!("k{key}: 1\n")).collect();
    let errors = Folder::new().errors(format!("version: 1\nname: g\noperators: {{source: }}\n{keys}"));
    assert_eq!(errors.lines().count(), 60_001);
    let nodes: String = (0..300).map(|node| format!("  n{node}: {{run: ops/own}}\n")).collect();
    check_nodes_err(&nodes, "260:3: 300 operators, at most 256 are allowed");
}

#[test]
fn the_top_level() {
    let nodes = "operators: {a: {run: ops/own}}\n";
    check_err(format!("name: g\n{nodes}"), "1:1: the key 'version' is missing; write 'version: 1'");
    check_err("version: 2\nnew: x\n", "1:10: version must be 1, found '2'");
    check_err("version: '1'\n", "1:10: version must be 1, found the string '1'");
    check_err("version: {}\n", "1:10: version must be 1, found a mapping");
    check_err("version:\n", "1:1: version must be 1, found nothing");
    check_err(
        format!("version: 1\n{nodes}"),
        "1:1: the key 'name' is missing; give the graph a name, like 'name: grasp_gate'",
    );
    check_err("version: 1\nname: g\n", "1:1: the key 'operators' is missing");
    check_err("version: 1\nname: g\noperators:\n", "3:1: there are no operators");
    check_err("version: 1\nname: g\noperators: {}\n", "3:1: there are no operators");
    check_err("version: 1\nname: g\noperators:\n  - a\n", "4:3: operators must be a mapping, found a list");
    check_err("version: 1\nname: g\noperators: a\n", "3:12: operators must be a mapping, found 'a'");
    check_err(
        format!("version: 1\nname: g\noperator: {{}}\n{nodes}"),
        "3:1: unknown key 'operator'; did you mean 'operators'?",
    );
    check_err(
        format!("version: 1\nname: g\nrobots: {{}}\n{nodes}"),
        "3:1: unknown key 'robots'; known keys: version, name, params, machines, link, operators",
    );
    check_err(format!("version: 1\nname: g\nname: h\n{nodes}"), "3:1: duplicate key 'name', first given in line 2");
    check_err(format!("version: 1\nname: [g]\n{nodes}"), "2:7: name must be text, found a list");
    check_err(format!("version: 1\nname:\n{nodes}"), "2:1: name must be text, found nothing");
    check_err(
        format!("version: 1\nname: grasp gate\n{nodes}"),
        "2:7: name 'grasp gate' must be letters (a-z, A-Z), digits, _ and -, at most 32",
    );
    check_err(
        format!("version: 1\nname: {}\n{nodes}", "a".repeat(33)),
        "2:7: name 'aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa' must be letters (a-z, A-Z), digits, _ and -, at most 32",
    );
    check_err(
        format!("version: 1\nname: \"a\\n\\e[1m\"\n{nodes}"),
        "2:7: name 'a\\n\\u{1b}[1m' must be letters (a-z, A-Z), digits, _ and -, at most 32",
    );
}

#[test]
fn the_form_of_a_node() {
    check_nodes_err(
        "  grün: {run: ops/own}\n",
        "4:3: node id 'grün' must be letters (a-z, A-Z), digits, _ and -, at most 32",
    );
    check_nodes_err("  a: {run: ops/own}\n  a: {run: ops/own}\n", "5:3: duplicate key 'a', first given in line 4");
    check_nodes_err("  arbiter: contacts\n", "4:12: node 'arbiter' must be a mapping, found 'contacts'");
    check_nodes_err(
        "  contacts:\n    inptus: {tactile: a/tactile}\n",
        "5:5: unknown key 'inptus' in node 'contacts'; did you mean 'inputs'?",
    );
    check_nodes_err(
        "  a: {run: ops/own, respawn: true}\n",
        "4:21: unknown key 'respawn' in node 'a'; known keys: run, on, args, inputs, params, sha256, sandbox, memory_max_mib, restart, heartbeat_ms, group, wait, scheduling, cpus, lock_memory, nice",
    );
    for (run, at, found) in [("[ops/own]", "4:14", "a list"), ("", "4:9", "nothing"), ("''", "4:14", "the string ''")] {
        check_nodes_err(
            &format!("  own: {{run: {run}}}\n"),
            &format!("{at}: 'run' of node 'own' must be an operator's name or path, found {found}"),
        );
    }
    check_nodes_err("  own: {rnu: ops/own}\n", "4:9: unknown key 'rnu' in node 'own'; did you mean 'run'?");
}

#[test]
fn programs() {
    let known = "known operators: arbiter, broken, contacts, crooked, filter, newer, nonsense, source; \
                 no program of this name is on PATH; a path to a program has a '/'";
    // An id alone is looked for among the operators, not on PATH.
    let of_id = known.replace("no program of this name is on PATH; ", "");
    check_nodes_err("  ls:\n", &format!("4:3: unknown operator 'ls'; {of_id}"));
    check_nodes_err("  a: {run: sorce}\n", &format!("4:12: unknown operator 'sorce'; did you mean 'source'? {known}"));
    check_nodes_err(
        "  a: {run: ops/absent}\n",
        "4:12: program 'ops/absent' cannot be used: No such file or directory (os error 2)",
    );
    check_nodes_err("  a: {run: ./ops}\n", "4:12: program 'ops' is not a file");
    check_nodes_err("  a:\n    run: ops/text\n", "5:10: program 'ops/text' is not executable; chmod +x makes it so");
    check_nodes_err("  broken: {}\n", "4:3: program '/bin/broken' cannot be used: exit status 3 | no such device");
    check_nodes_err(
        "  nonsense: {}\n",
        "4:3: program '/bin/nonsense' cannot be used: not a description: expected value at line 1 column 1",
    );
    check_nodes_err(
        "  newer: {}\n",
        "4:3: program '/bin/newer' cannot be used: speaks protocol 6, but this blindgrasp speaks protocol 5",
    );
    check_nodes_err(
        "  crooked: {}\n",
        "4:3: program '/bin/crooked' cannot be used: contradictory description: output 'a' is there twice",
    );
}

#[test]
fn inputs() {
    let own = "  own: {run: ops/own}\n";
    check_nodes_err(
        &format!("{own}  filter:\n    inputs: {{inn: own/tactile}}\n"),
        "6:14: unknown input 'inn' of node 'filter'; did you mean 'in'?",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs: {{picture: own/tactile}}\n"),
        "\
6:5: node 'filter' lacks the input 'in', a t/Tactile/1; known outputs of that type: own/tactile, filter/out
6:14: unknown input 'picture' of node 'filter'; known inputs: in",
    );
    check_nodes_err(
        "  own: {run: ops/own, inputs: {a: own2/tactile}}\n  own2: {run: ops/own}\n",
        "4:32: unknown input 'a' of node 'own'; there are no inputs",
    );
    check_nodes_err("  arbiter:\n", "4:3: node 'arbiter' lacks the input 'contacts', a t/Contacts/1");
    for value in ["own", "own/", "/tactile", "own/tactile/1", "o n/tactile", "''"] {
        let found = if value == "''" { "the string ''".to_owned() } else { format!("'{value}'") };
        check_nodes_err(
            &format!("{own}  filter: {{inputs: {{in: {value}}}}}\n"),
            &format!(
                "5:25: input 'in' of node 'filter' must be node/port, found {found}; \
                 write which output it reads, like 'in: camera/image'"
            ),
        );
    }
    check_nodes_err(
        &format!("{own}  filter:\n    inputs:\n      in: [own/tactile]\n"),
        "7:11: input 'in' of node 'filter' must be node/port, found a list; \
         write which output it reads, like 'in: camera/image'",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs: own/tactile\n"),
        "6:13: 'inputs' of node 'filter' must be a mapping, found 'own/tactile'",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs:\n      in: onw/tactile\n"),
        "7:11: there is no node 'onw'; did you mean 'own'?",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs:\n      in: camera/tactile\n"),
        "7:11: there is no node 'camera'; known nodes: own, filter",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs:\n      in: own/tactil\n"),
        "7:11: node 'own' has no output 'tactil'; did you mean 'tactile'?",
    );
    check_nodes_err(
        &format!("{own}  filter:\n    inputs:\n      in: own/picture\n"),
        "7:11: node 'own' has no output 'picture'; known outputs: tactile",
    );
    check_nodes_err(
        &format!("{own}  arbiter:\n    inputs:\n      contacts: own/tactile\n"),
        "7:17: input 'contacts' of node 'arbiter' takes t/Contacts/1, but own/tactile gives t/Tactile/1",
    );
    check_nodes_err(
        "  source: {params: {recording: /}}\n  filter: {inputs: {in: source/joints}}\n",
        "5:25: input 'in' of node 'filter' takes t/Tactile/1, but source/joints gives t/Joints/1; \
         known outputs of that type: source/tactile, filter/out",
    );
    // What cannot be known of a node without a description is not guessed.
    check_nodes_err(
        "  broken: {}\n  filter: {inputs: {in: broken/x}}\n",
        "4:3: program '/bin/broken' cannot be used: exit status 3 | no such device",
    );
}

#[test]
fn cycles() {
    check_nodes_err(
        "  filter: {inputs: {in: filter/out}}\n",
        "4:25: node 'filter' reads its own output; no node is a source; at least one must have no inputs",
    );
    check_nodes_err(
        "  own: {run: ops/own}\n  a: {run: filter, inputs: {in: c/out}}\n  b: {run: filter, inputs: {in: a/out}}\n  \
         c: {run: filter, inputs: {in: b/out}}\n",
        "6:33: the nodes form a cycle: a -> b -> c -> a",
    );
    let ring: String = (0..200)
        .map(|node| format!("  n{node}: {{run: filter, inputs: {{in: n{}/out}}}}\n", (node + 199) % 200))
        .collect();
    check_nodes_err(
        &ring,
        "5:34: the nodes form a cycle: n0 -> n1 -> n2 -> n3 -> n4 -> n5 -> n6 -> n7 -> … -> n193 -> n194 -> n195 -> \
         n196 -> n197 -> n198 -> n199 -> n0; no node is a source; at least one must have no inputs",
    );
}

#[test]
fn feedback_closes_no_cycle() {
    let told = |back: &str| format!("  told: {{run: ops/own, args: [--told], inputs: {back}}}\n");
    let checked = |nodes: String| Folder::new().check(format!("version: 1\nname: g\noperators:\n{nodes}"));
    let nodes = "  b: {run: filter, inputs: {in: a/out}}\n  a: {run: filter, inputs: {in: told/tactile}}\n";
    let graph = checked(format!("{nodes}{}", told("{back: b/out}"))).expect("no cycle");
    let ids: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
    assert_eq!(ids, ["told", "a", "b"]);
    assert!(graph.nodes[0].is_source() && graph.nodes[0].inputs[0].feedback && !graph.nodes[1].is_source());
    // Its own output, too, may come back.
    assert!(checked(told("{back: told/tactile}")).expect("no cycle").nodes[0].is_source());
    // It is a required input like any other.
    check_nodes_err(
        &told("{}"),
        "4:40: node 'told' lacks the input 'back', a t/Tactile/1; known outputs of that type: told/tactile",
    );
    // Others still close a cycle.
    let rest = "  a: {run: filter, inputs: {in: b/out}}\n  b: {run: filter, inputs: {in: a/out}}\n";
    check_nodes_err(&format!("{}{rest}", told("{back: a/out}")), "6:33: the nodes form a cycle: a -> b -> a");
}

#[test]
fn params() {
    let of_source = "of node 'source'";
    check_param_err("rat: 1", &format!("7:7: unknown param 'rat' {of_source}; did you mean 'rate'?"));
    check_param_err(
        "color: red",
        &format!(
            "7:7: unknown param 'color' {of_source}; \
             known params: recording, rate, loops, verify, on_end, label, log"
        ),
    );
    check_nodes_err(
        "  own: {run: ops/own, params: {color: red}}\n",
        "4:32: unknown param 'color' of node 'own'; there are no params",
    );
    check_nodes_err(
        "  source: {params: {rate: 1}}\n",
        "4:12: node 'source' lacks the param 'recording', a path; What to replay",
    );
    check_nodes_err("  source:\n", "4:3: node 'source' lacks the param 'recording', a path; What to replay");
    check_nodes_err("  source: {params: [a]}\n", "4:20: 'params' of node 'source' must be a mapping, found a list");
    check_nodes_err(
        "  source: {params: {rate: -1, recording: no.mcap}}\n",
        "\
4:27: param 'rate' of node 'source' must be a number above 0 or 'max', found '-1'
4:42: param 'recording' of node 'source': 'no.mcap' does not exist",
    );
    // A path is shown whole.
    let long = format!("{}/a.mcap", "recordings/".repeat(30));
    check_nodes_err(
        &format!("  source: {{params: {{recording: {long}}}}}\n"),
        &format!("4:32: param 'recording' of node 'source': '{}' does not exist", long.replace("//", "/")),
    );
    for (given, must_be, found) in [
        ("rate: 0", "a number above 0 or 'max'", "'0'"),
        ("rate: .inf", "a number above 0 or 'max'", "'.inf'"),
        ("rate: nan", "a number above 0 or 'max'", "'nan'"),
        ("rate: 1e999", "a number above 0 or 'max'", "'1e999'"),
        ("rate: [1]", "a number above 0 or 'max'", "a list"),
        ("loops: 0", "an integer at least 1 and at most 9", "'0'"),
        ("loops: 10", "an integer at least 1 and at most 9", "'10'"),
        ("loops: 2.0", "an integer at least 1 and at most 9", "'2.0'"),
        ("loops: 07", "an integer at least 1 and at most 9", "'07'"),
        ("loops: 99999999999999999999", "an integer at least 1 and at most 9", "'99999999999999999999'"),
        ("loops: {}", "an integer at least 1 and at most 9", "a mapping"),
        ("verify: 1", "true or false", "'1'"),
        ("on_end: quit", "one of 'stop', 'no', 'off'", "'quit'"),
        ("on_end: false", "one of 'stop', 'no', 'off'", "'false'"),
        ("label: [x]", "a string", "a list"),
    ] {
        let (name, value) = given.split_once(": ").expect("name: value");
        let column = 7 + given.len() - value.len();
        check_param_err(given, &format!("7:{column}: param '{name}' {of_source} must be {must_be}, found {found}"));
    }
    for (given, at, found) in [
        ("rate: mx", "7:13", "must be a number above 0 or 'max', found 'mx'; did you mean 'max'?"),
        ("rate: '1'", "7:13", "must be a number above 0 or 'max', found the string '1'; leave the quotes out"),
        ("rate:", "7:7", "must be a number above 0 or 'max', found nothing"),
        ("verify: no", "7:15", "must be true or false, found 'no'; write false"),
        ("verify: 'true'", "7:15", "must be true or false, found the string 'true'; leave the quotes out"),
        ("on_end: stpo", "7:15", "must be one of 'stop', 'no', 'off', found 'stpo'; did you mean 'stop'?"),
        ("log: ''", "7:12", "must be a path, found the string ''"),
        ("log: ~", "7:12", "must be a path, found nothing"),
    ] {
        let name = given.split(':').next().expect("a name");
        check_param_err(given, &format!("{at}: param '{name}' {of_source} {found}"));
    }
}

#[test]
fn all_mistakes_are_reported_in_the_order_of_the_file() {
    check_err(
        "\
version: 1
nmae: g
operators:
  arbiter:
    inputs: {contacts: contacts/contact}
  contacts:
    inputs: {tactile: sorce/tactile}
    params: {hand: hands/b.yaml, hand: x}
    rnu: contacts
  source: {params: {recordin: a}}
",
        "\
1:1: the key 'name' is missing; give the graph a name, like 'name: grasp_gate'
2:1: unknown key 'nmae'; did you mean 'name'?
5:24: node 'contacts' has no output 'contact'; did you mean 'contacts'?
7:23: there is no node 'sorce'; did you mean 'source'?
8:20: param 'hand' of node 'contacts': 'hands/b.yaml' does not exist; its folder has a.yaml
8:34: duplicate key 'hand', first given in line 8
9:5: unknown key 'rnu' in node 'contacts'; did you mean 'run'?
10:21: unknown param 'recordin' of node 'source'; did you mean 'recording'?",
    );
}

#[test]
fn descriptions_are_strict() {
    for (json, expected) in [
        (r#"{"protocol": 5, "operator": "a", "version": "1", "input": []}"#, "unknown field `input`"),
        (r#"{"operator": "a", "version": "1"}"#, "missing field `protocol`"),
        (r#"{"protocol": 5, "version": "1"}"#, "missing field `operator`"),
    ] {
        let error = OperatorDescription::from_json(json).expect_err(json).to_string();
        assert!(error.contains(expected), "{error}");
    }
    for (part, expected) in [
        (r#""inputs": [{"name": "a", "type": "t", "optinal": true}]"#, "unknown field `optinal`"),
        (r#""inputs": [{"name": "a/b", "type": "t"}]"#, "'a/b' is not a name for an input"),
        (r#""inputs": [{"name": "a", "type": ""}]"#, "port 'a' has no type"),
        (r#""outputs": [{"name": "a", "type": "t", "optional": true}]"#, "output 'a' is optional; every output is"),
        (
            r#""outputs": [{"name": "a", "type": "t", "feedback": true}]"#,
            "output 'a' is feedback; only an input can be",
        ),
        (r#""params": [{"name": "a", "kind": "strong"}]"#, "unknown variant `strong`"),
        (r#""params": [{"name": "a", "kind": "string", "min": 1}]"#, "unknown field `min`"),
        (r#""params": [{"name": "a", "kind": "path", "defualt": "x"}]"#, "unknown field `defualt`"),
        (r#""params": [{"name": "a", "kind": "choice"}]"#, "missing field `values`"),
        (r#""params": [{"name": "a", "kind": "choice", "values": []}]"#, "param 'a' has no choices"),
        (r#""params": [{"name": "a", "kind": "integer", "min": 2, "max": 1}]"#, "a min greater than its max"),
        (r#""params": [{"name": "a", "kind": "number", "above": 2, "max": 2}]"#, "leaves nothing below its max"),
        (r#""params": [{"name": "a", "kind": "number", "above": 2, "min": 2}]"#, "both 'above' and 'min'"),
        (
            r#""params": [{"name": "a", "kind": "integer", "min": 2, "default": 1}]"#,
            "param 'a' has the default 1, but must be an integer at least 2",
        ),
        (
            r#""params": [{"name": "a", "kind": "string", "default": "x", "optional": true}]"#,
            "param 'a' has a default and is optional; one of them is enough",
        ),
    ] {
        let json = format!(r#"{{"protocol": 5, "operator": "a", "version": "1", {part}}}"#);
        let error = OperatorDescription::from_json(&json).expect_err(part).to_string();
        assert!(error.contains(expected), "{part}: {error}");
    }
}

#[test]
fn descriptions_survive_json() {
    for json in [SOURCE, CONTACTS, ARBITER, OWN, FILTER] {
        let description = OperatorDescription::from_json(json).expect("good");
        let again = serde_json::to_string(&description).expect("JSON");
        assert_eq!(OperatorDescription::from_json(&again).expect("good"), description);
    }
}

#[test]
fn damaged_files_give_errors_not_panics() {
    let folder = Folder::new();
    let path = folder.0.join("dataflow.yaml");
    let attempt = |bytes: &[u8]| {
        let result = parse(&path, bytes).and_then(|file| check(&file, &shipped(), &[], Scope::Everything, describe));
        if let Err(error) = result {
            assert!(!error.diagnostics.is_empty());
            assert_eq!(error.to_string().lines().count(), error.diagnostics.len(), "{error}");
            let n_lines = bytes.iter().filter(|&&byte| byte == b'\n' || byte == b'\r').count() + 1;
            for Position { line, column } in error.diagnostics.iter().filter_map(|diagnostic| diagnostic.at) {
                assert!((1..=n_lines).contains(&line) && (1..=bytes.len() + 1).contains(&column), "{error}");
            }
        }
    };
    let good = [
        GOOD,
        "  filter:
    args: [-v, 'x y']
    inputs:
      in: {from: second/tactile, policy: latest, capacity: 8, deadline_ms: 50}
    restart: {policy: always, limit: 5, within_s: 60, backoff_ms: 10}
    heartbeat_ms: off
",
    ]
    .concat();
    folder.check(&good).expect("good");
    let good = good.as_bytes();
    for length in 0..good.len() {
        attempt(&good[..length]);
        attempt(&good[length..]);
    }
    for at in 0..good.len() {
        for byte in b"\0\t\n\r :-?,[]{}#&*!|>'\"%@`~/a1\xff".iter().copied() {
            let mut changed = good.to_vec();
            changed[at] = byte;
            attempt(&changed);
            changed.insert(at, good[at]);
            attempt(&changed);
        }
    }
    // Lines swapped, and thousands of pieces put together by a fixed generator (xorshift64).
    let lines: Vec<&str> = GOOD.lines().collect();
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    for _ in 0..5_000 {
        let mut text = String::new();
        for _ in 0..12 {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            let line = lines[usize::try_from(state >> 32).expect("64 bits") % lines.len()];
            text.push_str(&line[usize::try_from(state & 7).expect("small").min(line.len())..]);
            text.push('\n');
        }
        attempt(text.as_bytes());
    }
}

#[test]
fn an_input_with_a_question_mark_is_left_out_if_the_operator_has_none() {
    let folder = Folder::new();
    let nodes = "  source:\n    params: {recording: recordings/a.mcap}\n    inputs: {veto?: filter/out}\n  filter:\n    inputs: {in?: source/tactile}\n";
    let yaml = |nodes: &str| format!("version: 1\nname: g\noperators:\n{nodes}");
    let graph = folder.check(yaml(nodes)).expect("a graph");
    let edges: Vec<String> = graph.edges().map(|edge| format!("{} -> {}", edge.from_node, edge.to_node)).collect();
    assert_eq!((edges, graph.nodes[0].is_source()), (vec!["source -> filter".to_owned()], true));
    let twice = nodes.replace("{in?: source/tactile}", "{in?: source/tactile, in: source/tactile}");
    let error = folder.errors(yaml(&twice));
    assert!(error.contains("input 'in' of node 'filter' is given with a '?' and without"), "{error}");
    let nowhere = nodes.replace("filter/out", "nobody/out");
    assert!(folder.errors(yaml(&nowhere)).contains("there is no node 'nobody'"));
}
