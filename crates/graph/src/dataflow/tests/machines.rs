//! Graphs on several machines: where nodes run, how the machines are linked, what must be there on one of them.

use super::*;
use blindgrasp_messages::{ContactSet, LiftDecision, MESSAGE_TYPES, Prediction, Recorded, TactileFrame};

const SPLIT: &str = "\
version: 1
name: grasp_gate
machines:
  robot: {}
  brain: {listen: [tls/192.168.1.10:7447, 'tls/[fd00::1]:7447']}
  laptop: {}
link: {keys: ./keys, deadline_ms: 50, buffer: 100}
operators:
  sense: {on: robot}
  judge:
    on: brain
    inputs: {tactile: sense/tactile}
    params: {model: models/a.json}
  gate: {on: robot, inputs: {prediction: judge/prediction}}
";

/// As the operators that come with blindgrasp: samples of its own types.
fn describe(program: &Path, _: &[String]) -> Result<OperatorDescription, String> {
    let name = program.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let operator = OperatorDescription::new(name, "");
    let path = || ParamKind::Path { must_exist: true };
    Ok(match name {
        "sense" => operator.output("tactile", TactileFrame::TYPE_NAME, "").output("raw", "t/Raw/1", ""),
        "arm" => operator.feedback_input("decision", LiftDecision::TYPE_NAME, "").output(
            "tactile",
            TactileFrame::TYPE_NAME,
            "",
        ),
        "judge" => operator
            .input("tactile", TactileFrame::TYPE_NAME, "")
            .output("prediction", Prediction::TYPE_NAME, "")
            .param("model", path(), None, "")
            .param("k", ParamKind::Integer { min: Some(1), max: None }, Some(json!(3)), ""),
        "gate" => {
            operator.input("prediction", Prediction::TYPE_NAME, "").output("decision", LiftDecision::TYPE_NAME, "")
        }
        "peek" => operator.input("raw", "t/Raw/1", ""),
        _ => return Err("it is for another computer".to_owned()),
    })
}

fn shipped_with(names: &[&str]) -> Operators {
    Operators::in_folder(Path::new("/bin"), names)
}

fn check_in(folder: &Folder, yaml: &str, scope: Scope, names: &[&str], set: &[&str]) -> Result<Graph, String> {
    let overrides: Vec<Override> = set.iter().map(|text| Override::parse(text).expect("node.param=value")).collect();
    let checked = parse(&folder.0.join("dataflow.yaml"), yaml.as_bytes())
        .and_then(|file| check(&file, &shipped_with(names), &overrides, scope, describe));
    checked.map_err(|error| error.to_string().replace(&format!("{}/", folder.0.display()), ""))
}

const ALL: [&str; 5] = ["sense", "arm", "judge", "gate", "peek"];

/// Expects these diagnostics of the whole graph, one a line, each without the file's name.
fn check_split_err(yaml: &str, expected: &str) {
    let folder = Folder::new();
    fs::create_dir_all(folder.0.join("models")).expect("folder");
    fs::write(folder.0.join("models/a.json"), "").expect("file");
    let found = check_in(&folder, yaml, Scope::Everything, &ALL, &[]).expect_err(yaml);
    let expected: Vec<String> = expected.lines().map(|line| format!("dataflow.yaml:{line}")).collect();
    assert_eq!(found, expected.join("\n"), "\n{yaml}");
}

/// As [`check_split_err`], with one piece of the good file replaced.
fn check_instead(piece: &str, by: &str, expected: &str) {
    assert_eq!(SPLIT.matches(piece).count(), 1, "{piece}");
    check_split_err(&SPLIT.replace(piece, by), expected);
}

#[test]
fn machines_become_part_of_the_graph() {
    let folder = Folder::new();
    fs::create_dir_all(folder.0.join("models")).expect("folder");
    fs::write(folder.0.join("models/a.json"), "").expect("file");
    let graph = check_in(&folder, SPLIT, Scope::Everything, &ALL, &[]).expect("good");
    let machine = |name: &str, listen: &[&str]| Machine {
        name: name.into(),
        listen: listen.iter().map(ToString::to_string).collect(),
    };
    let expected = Machines {
        machines: vec![
            machine("robot", &[]),
            machine("brain", &["tls/192.168.1.10:7447", "tls/[fd00::1]:7447"]),
            machine("laptop", &[]),
        ],
        link: LinkSettings {
            keys: Some(folder.0.join("keys")),
            deadline_millis: 50,
            buffer: 100,
            ..LinkSettings::default()
        },
    };
    assert_eq!(graph.machines, Some(expected));
    let places: Vec<_> = graph.nodes.iter().map(|node| (node.id.as_str(), node.machine.as_deref())).collect();
    assert_eq!(places, [("sense", Some("robot")), ("judge", Some("brain")), ("gate", Some("robot"))]);
    let crossings: Vec<_> = graph.edges().map(|edge| graph.crossing(&edge)).collect();
    assert_eq!(crossings, [Some(("robot", "brain")), Some(("brain", "robot"))]);

    let file = parse(Path::new("/x.yaml"), SPLIT.as_bytes()).expect("form");
    assert_eq!(file.machines(), ["robot", "brain", "laptop"]);
}

#[test]
fn a_graph_without_machines_has_none() {
    let folder = Folder::new();
    let graph = folder.check(GOOD).expect("good");
    assert_eq!(graph.machines, None);
    assert!(graph.nodes.iter().all(|node| node.machine.is_none()));
    assert!(graph.edges().all(|edge| graph.crossing(&edge).is_none()));
    let json = serde_json::to_string(&graph).expect("JSON");
    assert!(!json.contains("machine"), "{json}");
    assert!(parse(Path::new("/x.yaml"), GOOD.as_bytes()).expect("form").machines().is_empty());
}

#[test]
fn one_machine_and_a_router_need_no_listener() {
    let folder = Folder::new();
    for (machines, on) in [
        ("machines: {one: {}, other: }\n", "one"),
        ("machines: {one: {}, other: {}}\nlink: {router: tls/gateway:7447, keys: /etc/keys}\n", "other"),
        ("machines: {one: {}, other: {}}\nlink: {router: [tcp/gateway:7447], insecure: true}\n", "other"),
        ("machines: {one: {}, other: {listen: unix/gate}}\nlink:\n", "other"),
        ("machines: {one: {listen: [unix/gate, unix/gate_2]}, other: {}}\n", "other"),
    ] {
        let yaml = format!(
            "version: 1\nname: g\n{machines}operators:\n  sense: {{on: {on}}}\n  judge: {{on: one, params: {{model: \
             recordings/a.mcap}}, inputs: {{tactile: sense/tactile}}}}\n"
        );
        let graph = check_in(&folder, &yaml, Scope::Everything, &ALL, &[]).expect(&yaml);
        assert_eq!(graph.machines.map(|machines| machines.machines.len()), Some(2));
    }
}

#[test]
fn the_form_of_machines() {
    let file = |machines: &str| format!("version: 1\nname: g\n{machines}operators: {{sense: {{on: a}}}}\n");
    for (machines, expected) in [
        (
            "machines:\n",
            "3:1: there are no machines; name them, like 'machines: {robot: {}, brain: {listen: \
             tls/192.168.1.10:7447}}', or leave it out",
        ),
        ("machines: [a]\n", "3:11: machines must be a mapping, found a list"),
        ("machines: {a: tcp/127.0.0.1:1}\n", "3:15: machine 'a' must be a mapping, found 'tcp/127.0.0.1:1'"),
        ("machines: {a: {}, b c: {}}\n", "3:19: machine 'b c' must be letters (a-z, A-Z), digits, _ and -, at most 32"),
        ("machines: {a: {}, a: {}}\n", "3:19: duplicate key 'a', first given in line 3"),
        ("machines: {a: {lisen: x}}\n", "3:16: unknown key 'lisen' in machine 'a'; did you mean 'listen'?"),
        ("machines: {a: {address: x}}\n", "3:16: unknown key 'address' in machine 'a'; known keys: listen"),
        (
            "machines: {a: {listen: }}\n",
            "3:16: 'listen' of machine 'a' must be a text or a list of texts, found nothing; write it like \
             tls/192.168.1.10:7447, or leave it out",
        ),
        (
            "machines: {a: {listen: {tcp: 7447}}}\n",
            "3:24: 'listen' of machine 'a' must be a text or a list of texts, found a mapping; write it like \
             tls/192.168.1.10:7447",
        ),
        (
            "machines: {a: {listen: [[x], ~]}}\n",
            "\
3:25: 'listen' of machine 'a' must be a text or a list of texts, found a list in it
3:30: 'listen' of machine 'a' must be a text or a list of texts, found nothing in it",
        ),
        (
            "machines: {a: {listen: udp/10.0.0.1:7447}}\n",
            "3:24: 'listen' of machine 'a' must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found 'udp/10.0.0.1:7447'; machines \
             are linked by tls, tcp or unix only; write it like tls/192.168.1.10:7447",
        ),
        (
            "machines: {a: {listen: ['tcp/::1:7447']}}\n",
            "3:25: 'listen' of machine 'a' must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found 'tcp/::1:7447'; an IPv6 \
             address stands in brackets, like tls/[fd00::1]:7447",
        ),
        (
            "machines: {a: {listen: tcp/localhost:0}}\n",
            "3:24: 'listen' of machine 'a' must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found 'tcp/localhost:0'; a port is a \
             number from 1 to 65535",
        ),
        (
            "machines: {a: {listen: tls/0.0.0.0:7447}}\n",
            "3:24: 'listen' of machine 'a': nobody can connect to 'tls/0.0.0.0:7447'; write the address by which the \
             others reach it; to listen elsewhere than they connect to: run --listen",
        ),
        (
            "machines: {a: {listen: unix/gate}, b: {listen: unix/gate}}\n",
            "3:48: 'listen' of machine 'b': machine 'a' listens at 'unix/gate' already",
        ),
    ] {
        check_split_err(&file(machines), expected);
    }
    let many: String = (0..65).map(|idx| format!("  m{idx}: {{}}\n")).collect();
    check_split_err(&file(&format!("machines:\n  a: {{}}\n{many}")), "68:3: 66 machines, at most 64 are allowed");
}

#[test]
fn the_form_of_the_link() {
    let link = "link: {keys: ./keys, deadline_ms: 50, buffer: 100}";
    for (by, expected) in [
        ("link: tls", "7:7: link must be a mapping, found 'tls'"),
        ("link: {keys: k, buffers: 1}", "7:17: unknown key 'buffers' in link; did you mean 'buffer'?"),
        (
            "link: {keys: k, retries: 1}",
            "7:17: unknown key 'retries' in link; known keys: router, keys, insecure, deadline_ms, buffer",
        ),
        ("link: {keys: k, deadline: 50}", "7:17: unknown key 'deadline' in link; did you mean 'deadline_ms'?"),
        (
            "link: {keys: k, deadline_ms: 19}",
            "7:30: 'deadline_ms' of link must be an integer at least 20 and at most 60000, found '19'",
        ),
        (
            "link: {keys: k, deadline_ms: 60001}",
            "7:30: 'deadline_ms' of link must be an integer at least 20 and at most 60000, found '60001'",
        ),
        (
            "link: {keys: k, buffer: 0}",
            "7:25: 'buffer' of link must be an integer at least 1 and at most 1000000, found '0'",
        ),
        (
            "link: {keys: k, buffer: 1000001}",
            "7:25: 'buffer' of link must be an integer at least 1 and at most 1000000, found '1000001'",
        ),
        ("link: {keys: k, insecure: yes}", "7:27: 'insecure' of link must be true or false, found 'yes'; write true"),
        ("link: {keys: }", "7:8: 'keys' of link must be a path, found nothing; name the machines' folder of keys"),
        (
            "link: {keys: k, router: gateway}",
            "7:25: 'router' of link must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found 'gateway'; write it like \
             tls/192.168.1.10:7447",
        ),
    ] {
        check_instead(link, by, expected);
    }
}

#[test]
fn what_goes_beyond_this_computer_needs_tls() {
    check_instead(
        "keys: ./keys, ",
        "",
        "5:20: 'tls/192.168.1.10:7447' needs certificates, but 'link' has no 'keys'; make them with 'blindgrasp keys' \
         and write 'link: {keys: FOLDER}'",
    );
    let (listen, keys) = ("[tls/192.168.1.10:7447, 'tls/[fd00::1]:7447']", "keys: ./keys, ");
    let open = |endpoint: &str, tls: &str, at: &str| {
        format!(
            "{at}: '{endpoint}' has no TLS: anybody who can reach it could be any machine; write {tls} with 'keys' in \
             'link', or unix/NAME if the machines are one computer, or 'insecure: true' in 'link' for a network that you \
             trust"
        )
    };
    let yaml = SPLIT.replace(keys, "");
    for (endpoint, tls) in [
        ("tcp/192.168.1.10:7447", "tls/192.168.1.10:7447"),
        ("tcp/gateway:7447", "tls/gateway:7447"),
        // Other users of this computer can reach it.
        ("tcp/127.0.0.1:7447", "tls/127.0.0.1:7447"),
    ] {
        check_split_err(&yaml.replace(listen, endpoint), &open(endpoint, tls, "5:19"));
    }
    check_split_err(
        &yaml.replace(listen, "unix/gate").replace("deadline_ms: 50", "router: tcp/10.0.0.1:7447"),
        &open("tcp/10.0.0.1:7447", "tls/10.0.0.1:7447", "7:16"),
    );
    let folder = Folder::new();
    for yaml in [
        yaml.replace(listen, "tcp/192.168.1.10:7447").replace("deadline_ms: 50", "insecure: true"),
        yaml.replace(listen, "unix/gate"),
        SPLIT.replace(keys, "").replace(listen, "unix/gate"),
    ] {
        check_in(&folder, &yaml.replace("models/a.json", "hands/a.yaml"), Scope::Everything, &ALL, &[])
            .expect("allowed");
    }
}

#[test]
fn where_nodes_run() {
    let on = "on: brain\n";
    check_instead(on, "on: brian\n", "11:9: 'on' of node 'judge': there is no machine 'brian'; did you mean 'brain'?");
    check_instead(
        on,
        "on: cloud\n",
        "11:9: 'on' of node 'judge': there is no machine 'cloud'; known machines: robot, brain, laptop",
    );
    check_instead(on, "on: [brain]\n", "11:9: 'on' of node 'judge' must be a machine's name, found a list");
    check_instead(on, "on:\n", "11:5: 'on' of node 'judge' must be a machine's name, found nothing");
    check_instead(
        "    on: brain\n",
        "",
        "10:3: node 'judge' lacks the key 'on'; write where it runs, like 'on: robot'; known machines: robot, brain, \
         laptop",
    );
    check_instead(
        "  gate: {on: robot,",
        "  link: {run: gate, on: robot,",
        "14:3: node id 'link' is taken: where a file names machines it is the process that links the machines; choose \
         another",
    );
    check_instead(
        "  gate: {on: robot,",
        "  run: {run: gate, on: robot,",
        "14:3: node id 'run' is taken: where a file names machines it is the launching command; choose another",
    );
    // Without machines these ids are as good as any, and there is nowhere to be on.
    let folder = Folder::new();
    folder.check("version: 1\nname: g\noperators: {link: {run: ops/own}, run: {run: ops/own}}").expect("good");
    check_split_err(
        "version: 1\nname: g\noperators:\n  sense: {on: robot}\n  gate: {on: brain, inputs: {prediction: judge/prediction}}\n  \
         judge: {on: robot, inputs: {tactile: sense/tactile}, params: {model: /}}\n",
        "4:15: node 'sense' is on 'robot', but the file names no machines; leave 'on' out, or name them, like 'machines: \
         {robot: {}}'",
    );
    check_split_err(
        "version: 1\nname: g\nlink: {buffer: 1}\noperators: {sense: }\n",
        "3:1: 'link' has no meaning without the key 'machines'; leave it out, or name the machines that it links",
    );
    // A misspelled key is mistake enough.
    check_split_err(
        "version: 1\nname: g\nmachine: {robot: {}}\nlink: {buffer: 1}\noperators: {sense: {on: robot}}\n",
        "3:1: unknown key 'machine'; did you mean 'machines'?",
    );
}

#[test]
fn of_two_machines_with_an_edge_one_listens() {
    let brain = "  brain: {listen: [tls/192.168.1.10:7447, 'tls/[fd00::1]:7447']}\n";
    check_instead(
        brain,
        "  brain: {}\n",
        "3:1: no machine listens, but edges cross: sense/tactile → judge/tactile goes from robot to brain; let one \
         listen, like 'brain: {listen: tls/192.168.1.10:7447}', or name a 'router' in 'link'",
    );
    let laptop = "  laptop: {}\n";
    let yaml = SPLIT.replace(brain, "  brain: {}\n").replace(laptop, "  laptop: {listen: tls/192.168.1.11:7447}\n");
    // Only once for both directions.
    check_split_err(
        &yaml,
        "12:23: sense/tactile → judge/tactile goes from robot to brain, but neither of them listens; let one listen, \
         like 'brain: {listen: tls/192.168.1.10:7447}', or name a 'router' in 'link'",
    );
    // One that cannot be read was meant to be one.
    check_instead(
        brain,
        "  brain: {listen: here}\n",
        "5:19: 'listen' of machine 'brain' must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found 'here'; write it like \
         tls/192.168.1.10:7447",
    );
}

#[test]
fn a_loop_may_cross_but_not_its_feedback() {
    let arm = "  sense: {run: arm, on: robot, inputs: {decision: gate/decision}}\n";
    let folder = Folder::new();
    let yaml = SPLIT.replace("models/a.json", "hands/a.yaml").replace("  sense: {on: robot}\n", arm);
    let graph = check_in(&folder, &yaml, Scope::Everything, &ALL, &[]).expect("feedback on one machine");
    check_in(&folder, &yaml, Scope::Machine("laptop"), &[], &[])
        .expect("an operator that is not here may have feedback");
    assert_eq!(graph.nodes.iter().map(|node| node.id.as_str()).collect::<Vec<_>>(), ["sense", "judge", "gate"]);
    check_instead(
        "  sense: {on: robot}\n",
        &arm.replace("robot", "brain"),
        "9:51: gate/decision → sense/decision goes from robot to brain, but feedback cannot go between machines; let \
         both nodes run on one machine",
    );
}

#[test]
fn only_messages_of_blindgrasp_cross() {
    let peek = "  gate: {on: robot,";
    let types = MESSAGE_TYPES.join(", ");
    check_instead(
        peek,
        &format!("  peek: {{on: brain, inputs: {{raw: sense/raw}}}}\n{peek}"),
        &format!(
            "14:35: sense/raw → peek/raw goes from robot to brain, but 't/Raw/1' cannot go between machines; let both \
             nodes run on one machine; known types that can: {types}"
        ),
    );
    let folder = Folder::new();
    let yaml = SPLIT.replace("models/a.json", "hands/a.yaml");
    let here = yaml.replace(peek, &format!("  peek: {{on: robot, inputs: {{raw: sense/raw}}}}\n{peek}"));
    check_in(&folder, &here, Scope::Everything, &ALL, &[]).expect("an edge that does not cross");
    assert!(MESSAGE_TYPES.contains(&ContactSet::TYPE_NAME));
}

#[test]
fn a_machine_needs_its_own_programs_and_files_only() {
    let folder = Folder::new();
    let robot = Scope::Machine("robot");
    // The judge's model is not here, whether or not its program is.
    let error = check_in(&folder, SPLIT, Scope::Everything, &ALL, &[]).expect_err("no model");
    assert_eq!(error, "dataflow.yaml:13:21: param 'model' of node 'judge': 'models/a.json' does not exist");
    let graph = check_in(&folder, SPLIT, robot, &ALL, &[]).expect("good");
    let judge = graph.node("judge").expect("there");
    assert_eq!(judge.params["model"], json!(folder.0.join("models/a.json")));
    assert_eq!((&judge.params["k"], judge.description.version.as_str()), (&json!(3), env!("CARGO_PKG_VERSION")));

    let graph = check_in(&folder, SPLIT, robot, &["sense", "gate"], &[]).expect("good");
    let judge = graph.node("judge").expect("there");
    assert_eq!((judge.machine.as_deref(), judge.program.as_path()), (Some("brain"), Path::new("judge")));
    assert_eq!((judge.description.operator.as_str(), judge.description.version.as_str()), ("judge", UNKNOWN_VERSION));
    let types = |ports: &[PortDescription]| -> Vec<String> {
        ports.iter().map(|port| format!("{}: {}", port.name, port.type_name)).collect()
    };
    assert_eq!(types(judge.outputs()), [format!("prediction: {}", Prediction::TYPE_NAME)]);
    assert_eq!(types(&judge.description.inputs), [format!("tactile: {}", TactileFrame::TYPE_NAME)]);
    assert_eq!(graph.edges().count(), 2);
    assert!(judge.params.is_empty() && judge.description.validate().is_ok());

    // And the other way round: what both ends of an edge expect is not known here.
    let graph = check_in(
        &folder,
        &SPLIT.replace("models", "hands").replace("a.json", "a.yaml"),
        Scope::Machine("brain"),
        &["judge"],
        &[],
    );
    let graph = graph.expect("good");
    assert_eq!(types(graph.node("sense").expect("there").outputs()), [format!("tactile: {}", TactileFrame::TYPE_NAME)]);
    assert_eq!(graph.node("gate").expect("there").inputs[0].type_name, Prediction::TYPE_NAME);
    // A machine without operators needs no program at all.
    let graph = check_in(&folder, SPLIT, Scope::Machine("laptop"), &[], &[]).expect("good");
    assert_eq!(types(graph.node("sense").expect("there").outputs()), [format!("tactile: {UNKNOWN_TYPE}")]);
    assert_eq!(graph.edges().map(|edge| edge.type_name).collect::<Vec<_>>(), [UNKNOWN_TYPE; 2]);

    // A program by its path, which is not there or not for this computer.
    for run in ["./ops/absent", "./ops/text", "./ops/own"] {
        let yaml = SPLIT.replace("    on: brain\n", &format!("    on: brain\n    run: {run}\n"));
        let graph = check_in(&folder, &yaml, robot, &["sense", "gate"], &[]).expect(run);
        assert_eq!(graph.node("judge").map(|judge| judge.program.clone()), Some(folder.0.join(&run[2..])));
    }
}

#[test]
fn mistakes_that_a_machine_sees() {
    let folder = Folder::new();
    let robot = Scope::Machine("robot");
    let here = ["sense", "gate"];
    for (piece, by, expected) in [
        (
            "{on: robot, inputs: {prediction",
            "{on: robot, inputs: {predictoin",
            "dataflow.yaml:14:30: unknown input 'predictoin' of node 'gate'; did you mean 'prediction'?",
        ),
        (
            "sense/tactile",
            "sense/tactil",
            "dataflow.yaml:12:23: node 'sense' has no output 'tactil'; did you mean 'tactile'?",
        ),
        ("sense/tactile", "snese/tactile", "dataflow.yaml:12:23: there is no node 'snese'; did you mean 'sense'?"),
        (
            "    on: brain\n",
            "    on: brain\n    args: x\n",
            "dataflow.yaml:12:11: 'args' of node 'judge' must be a list of texts, found 'x'; write [x]",
        ),
        (
            "sense: {on",
            "sense: {run: snse, on",
            "dataflow.yaml:9:16: unknown operator 'snse'; did you mean 'sense'? known operators: gate, sense; no program of this name is on PATH; a path to \
             a program has a '/'",
        ),
    ] {
        let error = check_in(&folder, &SPLIT.replace(piece, by), robot, &here, &[]).expect_err(by);
        assert_eq!(error, expected, "{by}");
    }
    // What the first reader expects is held against the others.
    let peek = "gate: {on: robot,";
    let yaml = SPLIT.replace(peek, &format!("peek: {{on: robot, inputs: {{raw: judge/prediction}}}}\n  {peek}"));
    let error = check_in(&folder, &yaml, robot, &["sense", "gate", "peek"], &[]).expect_err("two types");
    let expected = format!(
        "input 'prediction' of node 'gate' takes {}, but judge/prediction gives t/Raw/1",
        Prediction::TYPE_NAME
    );
    assert!(error.contains(&expected) && error.contains("'t/Raw/1' cannot go between machines"), "{error}");
    let of_machine = |name: &str, yaml: &str| check_in(&folder, yaml, Scope::Machine(name), &ALL, &[]).expect_err(name);
    assert!(
        of_machine("brian", SPLIT).starts_with("dataflow.yaml: there is no machine 'brian'; did you mean 'brain'?")
    );
    assert_eq!(
        of_machine("brain", "version: 1\nname: g\noperators: {sense: }"),
        "dataflow.yaml: there is no machine 'brain': the file names none; leave --machine out"
    );

    let error = check_in(&folder, SPLIT, robot, &here, &["judge.k=0", "judge.x=1"]).expect_err("set elsewhere");
    assert_eq!(
        error,
        "\
--set judge.k=0: node 'judge' runs on machine 'brain'; give --set there
--set judge.x=1: node 'judge' runs on machine 'brain'; give --set there"
    );
}

#[test]
fn damaged_machines_give_errors_not_panics() {
    let folder = Folder::new();
    for at in 0..SPLIT.len() {
        for byte in b"\0\n :-,[]{}'/a0".iter().copied() {
            let mut changed = SPLIT.as_bytes().to_vec();
            changed[at] = byte;
            for scope in [Scope::Everything, Scope::Machine("robot")] {
                let checked = parse(&folder.0.join("dataflow.yaml"), &changed)
                    .and_then(|file| check(&file, &shipped_with(&["sense", "gate"]), &[], scope, describe));
                if let Err(error) = checked {
                    assert_eq!(error.to_string().lines().count(), error.diagnostics.len(), "{error}");
                }
            }
        }
    }
}
