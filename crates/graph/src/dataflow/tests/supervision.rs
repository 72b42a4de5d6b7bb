//! Arguments, restarts, heartbeats, edges: what is written, what it means, what is refused.

use super::*;
use blindgrasp_operator::wiring::{OnLate, WaitMode};

#[test]
fn defaults_of_supervision_and_edges() {
    let graph = Folder::new().check(GOOD).expect("good");
    for node in &graph.nodes {
        assert_eq!(node.args, Vec::<String>::new());
        assert_eq!(node.restart, Restart::default());
        assert_eq!(node.heartbeat_millis, Some(2000));
        for input in &node.inputs {
            let expected = EdgeOptions::default();
            assert_eq!(
                (expected.policy, expected.capacity, expected.on_late),
                (EdgePolicy::Lossless, 256, OnLate::Count)
            );
            assert_eq!(input.edge, expected);
        }
    }
}

#[test]
fn arguments() {
    let folder = Folder::new();
    // The description, and with it what is right, is that of the program with its arguments.
    let graph = folder
        .check(
            "version: 1\nname: g\noperators:\n  a: {run: ops/own, args: }\n  b:\n    inputs: {in: a/tactile}\n    \
             run: ops/own\n    args:\n      - --filter\n",
        )
        .expect("good");
    assert_eq!(graph.nodes[0].args, Vec::<String>::new());
    assert_eq!(graph.nodes[1].args, ["--filter"]);
    let graph = folder
        .check("version: 1\nname: g\noperators: {filter: {args: [-v, 'x y', 010, no, ''], inputs: {in: o/tactile}}, o: {run: ops/own}}")
        .expect("any text");
    assert_eq!(graph.nodes[1].args, ["-v", "x y", "010", "no", ""]);

    check_nodes_err(
        "  a: {run: ops/own, args: --filter}\n",
        "4:27: 'args' of node 'a' must be a list of texts, found '--filter'; write [--filter]",
    );
    check_nodes_err(
        "  a: {run: ops/own, args: {verbose: true}}\n",
        "4:27: 'args' of node 'a' must be a list of texts, found a mapping",
    );
    check_nodes_err(
        "  a:\n    run: ops/own\n    args: [-v, ~, [x], {y: z}, \"a\\0b\"]\n",
        "\
6:16: 'args' of node 'a' must be a list of texts, found nothing in it; an empty argument is ''
6:19: 'args' of node 'a' must be a list of texts, found a list in it
6:24: 'args' of node 'a' must be a list of texts, found a mapping in it
6:32: 'args' of node 'a': no argument can hold a zero byte, found 'a\\u{0}b'",
    );
    check_nodes_err(
        "  a: {run: ops/own, args: [--fast, x]}\n",
        "4:12: program 'ops/own' with the arguments '--fast x' cannot be used: it failed at --describe",
    );
    // The program is not asked with half its arguments: nothing is said of its ports.
    check_nodes_err(
        "  a: {run: ops/own, args: [[]], inputs: {x: b/out}}\n  b: {run: ops/own}\n",
        "\
4:28: 'args' of node 'a' must be a list of texts, found a list in it
4:45: node 'b' has no output 'out'; known outputs: tactile",
    );
}

/// The second node of a graph of two, a filter, with this in it.
fn filter_with(key: &str) -> Node {
    let yaml = format!(
        "version: 1\nname: g\noperators:\n  own: {{run: ops/own}}\n  filter:\n    inputs: {{in: own/tactile}}\n    {key}\n"
    );
    Folder::new().check(yaml).expect(key).nodes.remove(1)
}

/// The edge of a filter whose input is written so.
fn edge_of(input: &str) -> EdgeOptions {
    let yaml =
        format!("version: 1\nname: g\noperators:\n  own: {{run: ops/own}}\n  filter: {{inputs: {{in: {input}}}}}\n");
    Folder::new().check(yaml).expect(input).nodes[1].inputs[0].edge
}

#[test]
fn restarts() {
    let restart =
        |policy, limit, within_millis, backoff_millis| Restart { policy, limit, within_millis, backoff_millis };
    for (given, expected) in [
        ("restart: never", restart(RestartPolicy::Never, 5, 60_000, 10)),
        ("restart: on-failure", restart(RestartPolicy::OnFailure, 5, 60_000, 10)),
        ("restart: 'always'", restart(RestartPolicy::Always, 5, 60_000, 10)),
        ("restart: {}", restart(RestartPolicy::OnFailure, 5, 60_000, 10)),
        ("restart: {policy: never}", restart(RestartPolicy::Never, 5, 60_000, 10)),
        ("restart: {limit: 1000}", restart(RestartPolicy::OnFailure, 1000, 60_000, 10)),
        ("restart: {within_s: 0.0016, backoff_ms: 0}", restart(RestartPolicy::OnFailure, 5, 2, 0)),
        (
            "restart: {policy: always, limit: 1, within_s: 86400, backoff_ms: 3.6e6}",
            restart(RestartPolicy::Always, 1, 86_400_000, 3_600_000),
        ),
    ] {
        assert_eq!(filter_with(given).restart, expected, "{given}");
    }

    // In line 4, the value from column 30 on.
    let check = |given: &str, expected: &str| {
        check_nodes_err(&format!("  own: {{run: ops/own, restart: {given}}}\n"), expected);
    };
    let policies = "must be one of 'never', 'on-failure', 'always'";
    let of_node = "'restart' of node 'own'";
    check("on_failure", &format!("4:32: {of_node} {policies}, found 'on_failure'; did you mean 'on-failure'?"));
    check("alway", &format!("4:32: {of_node} {policies}, found 'alway'; did you mean 'always'?"));
    check("true", &format!("4:32: {of_node} {policies}, found 'true'"));
    check("", &format!("4:23: {of_node} {policies}, found nothing"));
    check(
        "[always, 5]",
        &format!(
            "4:32: {of_node} {policies}, found a list; or a mapping with the keys policy, limit, within_s, backoff_ms"
        ),
    );
    check("{policy: nevr}", &format!("4:41: 'policy' of {of_node} {policies}, found 'nevr'; did you mean 'never'?"));
    check("{limits: 5}", &format!("4:33: unknown key 'limits' in {of_node}; did you mean 'limit'?"));
    check("{within: 5}", &format!("4:33: unknown key 'within' in {of_node}; did you mean 'within_s'?"));
    check("{backoff: 5}", &format!("4:33: unknown key 'backoff' in {of_node}; did you mean 'backoff_ms'?"));
    check(
        "{max: 5}",
        &format!("4:33: unknown key 'max' in {of_node}; known keys: policy, limit, within_s, backoff_ms"),
    );
    for (given, must_be) in [
        ("limit: 0", "an integer at least 1 and at most 1000, found '0'; to never restart it write 'restart: never'"),
        ("limit: 1001", "an integer at least 1 and at most 1000, found '1001'"),
        ("within_s: 0", "a number at least 0.001 and at most 86400, found '0'"),
        ("within_s: 86401", "a number at least 0.001 and at most 86400, found '86401'"),
        ("within_s: a day", "a number at least 0.001 and at most 86400, found 'a day'"),
        ("backoff_ms: -1", "a number at least 0 and at most 3600000, found '-1'"),
        ("backoff_ms: '1'", "a number at least 0 and at most 3600000, found the string '1'; leave the quotes out"),
    ] {
        let (key, value) = given.split_once(": ").expect("key: value");
        let column = 33 + given.len() - value.len();
        check(&format!("{{{given}}}"), &format!("4:{column}: '{key}' of {of_node} must be {must_be}"));
    }
    // In whatever order they come.
    check(
        "{limit: 5, policy: never, backoff_ms: 1}",
        &format!(
            "\
4:33: 'limit' of {of_node} has no meaning with the policy 'never'; leave it out
4:58: 'backoff_ms' of {of_node} has no meaning with the policy 'never'; leave it out"
        ),
    );
}

#[test]
fn heartbeats() {
    for (given, expected) in [
        ("heartbeat_ms: 250", Some(250)),
        ("heartbeat_ms: 2.5e3", Some(2500)),
        ("heartbeat_ms: 3600000", Some(3_600_000)),
        ("heartbeat_ms: off", None),
        ("heartbeat_ms: 'off'", None),
    ] {
        assert_eq!(filter_with(given).heartbeat_millis, expected, "{given}");
    }
    for (given, at, found) in [
        ("99", "37", "'99'"),
        ("0", "37", "'0'"),
        ("3600001", "37", "'3600001'"),
        ("no", "37", "'no'"),
        ("of", "37", "'of'; did you mean 'off'?"),
        ("", "23", "nothing"),
        ("{}", "37", "a mapping"),
    ] {
        check_nodes_err(
            &format!("  own: {{run: ops/own, heartbeat_ms: {given}}}\n"),
            &format!(
                "4:{at}: 'heartbeat_ms' of node 'own' must be a number at least 250 and at most 3600000 or 'off', \
                 found {found}"
            ),
        );
    }
    check_nodes_err(
        "  own: {run: ops/own, heartbeat: 100}\n",
        "4:23: unknown key 'heartbeat' in node 'own'; did you mean 'heartbeat_ms'?",
    );
}

#[test]
fn edges() {
    let edge =
        |policy, capacity, deadline_millis| EdgeOptions { policy, capacity, deadline_millis, ..EdgeOptions::default() };
    for (given, expected) in [
        ("own/tactile", edge(EdgePolicy::Lossless, 256, None)),
        ("{from: own/tactile}", edge(EdgePolicy::Lossless, 256, None)),
        ("{from: own/tactile, policy: lossless, capacity: 1}", edge(EdgePolicy::Lossless, 1, None)),
        ("{from: own/tactile, policy: latest}", edge(EdgePolicy::Latest, 1, None)),
        ("{capacity: 4096, policy: latest, from: own/tactile}", edge(EdgePolicy::Latest, 4096, None)),
        ("{from: own/tactile, deadline_ms: 0.5}", edge(EdgePolicy::Lossless, 256, Some(0.5))),
        ("{from: own/tactile, policy: 'latest', deadline_ms: 3600000}", edge(EdgePolicy::Latest, 1, Some(3.6e6))),
    ] {
        assert_eq!(edge_of(given), expected, "{given}");
    }

    // In line 5, the mapping from column 25 on, its first key from column 26 on.
    let check = |given: &str, expected: &str| {
        check_nodes_err(&format!("  own: {{run: ops/own}}\n  filter: {{inputs: {{in: {{{given}}}}}}}\n"), expected);
    };
    let of_input = "of input 'in' of node 'filter'";
    let lacks = "5:25: input 'in' of node 'filter' lacks the key 'from'; \
                 write which output it reads, like 'from: camera/image'";
    check("", lacks);
    check("policy: latest", lacks);
    check("frm: own/tactile", "5:26: unknown key 'frm' in input 'in' of node 'filter'; did you mean 'from'?");
    check(
        "from: own",
        &format!(
            "5:32: 'from' {of_input} must be node/port, found 'own'; \
             write which output it reads, like 'from: camera/image'"
        ),
    );
    check(
        "from: own/tactile, queu_size: 8",
        "5:45: unknown key 'queu_size' in input 'in' of node 'filter'; known keys: from, policy, capacity, deadline_ms, on_late, \
         tolerance_ms, partner_wait_ms",
    );
    check(
        "from: own/tactile, deadline: 8",
        "5:45: unknown key 'deadline' in input 'in' of node 'filter'; did you mean 'deadline_ms'?",
    );
    check("from: onw/tactile, capacity: 8", "5:32: there is no node 'onw'; did you mean 'own'?");
    for (given, must_be) in [
        ("policy: latets", "one of 'lossless', 'latest', found 'latets'; did you mean 'latest'?"),
        ("policy: drop", "one of 'lossless', 'latest', found 'drop'"),
        ("capacity: 0", "an integer at least 1 and at most 4096, found '0'"),
        ("capacity: 4097", "an integer at least 1 and at most 4096, found '4097'"),
        ("capacity: 1.5", "an integer at least 1 and at most 4096, found '1.5'"),
        ("capacity: [8]", "an integer at least 1 and at most 4096, found a list"),
        ("deadline_ms: 0", "a number above 0 and at most 3600000, found '0'"),
        ("deadline_ms: 3600001", "a number above 0 and at most 3600000, found '3600001'"),
        ("deadline_ms: off", "a number above 0 and at most 3600000, found 'off'"),
    ] {
        let (key, value) = given.split_once(": ").expect("key: value");
        let column = 45 + given.len() - value.len();
        check(&format!("from: own/tactile, {given}"), &format!("5:{column}: '{key}' {of_input} must be {must_be}"));
    }
}

#[test]
fn sandboxes_and_memory() {
    use blindgrasp_operator::wiring::Sandbox;

    let node = filter_with("heartbeat_ms: off");
    assert_eq!((node.sandbox, node.memory_max_mib), (Sandbox::Off, None));
    for (word, expected) in [("on", Sandbox::On), ("off", Sandbox::Off), ("required", Sandbox::Required)] {
        assert_eq!(filter_with(&format!("sandbox: {word}")).sandbox, expected);
    }
    assert_eq!(filter_with("memory_max_mib: 256").memory_max_mib, Some(256));
    check_nodes_err(
        "  a:\n    run: ops/own\n    sandbox: yes\n    memory_max_mib: 1\n",
        "\
6:14: 'sandbox' of node 'a' must be one of 'off', 'on', 'required', found 'yes'
7:21: 'memory_max_mib' of node 'a' must be an integer at least 16 and at most 1048576, found '1'",
    );
}

#[test]
fn digests_of_files() {
    // `sha256sum /dev/null`; all files of the folder are empty.
    let empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
    let nodes = |pins: &str| {
        format!(
            "version: 1\nname: g\noperators:\n  own: {{run: ops/own}}\n  contacts:\n    inputs: {{tactile: own/tactile}}\n    \
             params: {{hand: hands/a.yaml}}\n    sha256: {pins}\n"
        )
    };
    let folder = Folder::new();
    let wrong = "0".repeat(64);
    let graph = folder.check(nodes(&format!("{{hand: [{wrong}, {}]}}", empty.to_uppercase()))).expect("right");
    assert_eq!(graph.nodes[1].sha256.0["hand"], [wrong.as_str(), empty]);
    let found = folder.errors(nodes(&format!("{{hand: {wrong}}}")));
    let expected = format!(
        "dataflow.yaml:8:14: node 'contacts': param 'hand' is hands/a.yaml, whose SHA-256 is {empty}, expected {wrong}"
    );
    assert!(found.starts_with(&expected), "{found}");
    check_err(
        nodes(&format!("{{hnd: {empty}, hand: 12, recording: [x, {empty}]}}")),
        "\
8:14: 'sha256' of node 'contacts': there is no file 'hnd'; did you mean 'hand'?
8:91: 'hand' in 'sha256' of node 'contacts' must be 64 hexadecimal digits, found '12'; sha256sum FILE prints them
8:107: 'recording' in 'sha256' of node 'contacts' must be 64 hexadecimal digits, found 'x'; sha256sum FILE prints them",
    );
    // A program is not asked what it is before its content is right.
    let found = folder.errors(format!(
        "version: 1\nname: g\noperators:\n  a: {{run: ops/own, args: [x], sha256: {{run: {wrong}}}}}\n"
    ));
    assert!(
        found.contains("4:41: node 'a': the program is ops/own, whose SHA-256") && !found.contains("--describe"),
        "{found}"
    );
}

#[test]
fn a_nodes_process_options_are_read_and_wrong_ones_refused() {
    let errors = |nodes: &str| Folder::new().errors(format!("version: 1\nname: g\noperators:\n{nodes}").as_bytes());
    let node = filter_with("sandbox: off");
    assert_eq!(node.process, ProcessOptions::default());
    // As programs write it that take the word on for a truth.
    assert_eq!(filter_with("sandbox: true").sandbox, filter_with("sandbox: on").sandbox);
    assert_eq!(filter_with("heartbeat_ms: false").heartbeat_millis, None);
    for (given, wait) in [("wait: event", WaitMode::Event), ("wait: {poll_us: 50}", WaitMode::PollMicros(50))] {
        assert_eq!(filter_with(given).process.wait, wait);
    }
    let fifo = Scheduling { policy: SchedulingPolicy::Fifo, priority: 60 };
    assert_eq!(filter_with("scheduling: {policy: fifo, priority: 60}").process.scheduling, Some(fifo));
    assert_eq!(filter_with("cpus: [0, 3]").process.cpus, [0, 3]);
    assert_eq!(filter_with("nice: -5").process.nice, Some(-5));
    assert!(filter_with("lock_memory: true").process.lock_memory);
    for (given, said) in [
        ("wait: often", "4:29: 'wait' of node 'own' must be one of 'event', 'poll', found 'often'; or {poll_us: N}"),
        ("wait: {poll_us: 0}", "'poll_us' of 'wait' of node 'own' must be an integer at least 1 and at most 1000000"),
        ("scheduling: {policy: fifo}", "'scheduling' of node 'own' needs a policy and a priority"),
        ("scheduling: {policy: fifo, priority: 100}", "must be an integer at least 1 and at most 99"),
        ("cpus: 2", "'cpus' of node 'own' must be a list of CPU numbers, found '2'; write [2, 3]"),
        ("nice: 30", "must be an integer at least -20 and at most 19"),
        ("lock_memory: maybe", "'lock_memory' of node 'own' must be"),
    ] {
        let found = errors(&format!("  own: {{run: ops/own, {given}}}\n"));
        assert!(found.contains(said), "{given}: {found}");
    }
    let found = errors("  own: {run: ops/own}\n  filter: {inputs: {in: {from: own/tactile, on_late: hold}}}\n");
    assert!(found.contains("'on_late' of input 'in' of node 'filter' has no meaning without 'deadline_ms'"), "{found}");
    for key in ["tolerance_ms", "partner_wait_ms"] {
        let found = errors(&format!(
            "  own: {{run: ops/own}}\n  filter: {{inputs: {{in: {{from: own/tactile, {key}: 0}}}}}}\n"
        ));
        assert!(found.contains("have no meaning for input 'in' of node 'filter'"), "{found}");
    }
    // More processes that poll than the machine has cores.
    let many: String = (0..200).map(|idx| format!("  own{idx}: {{run: ops/own, wait: poll}}\n")).collect();
    let found = errors(&many);
    assert!(found.contains("'wait: poll' takes a core, and of the"), "{found}");
}
