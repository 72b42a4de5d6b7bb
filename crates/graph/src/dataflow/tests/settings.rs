//! Params that are set from outside of the file.

use super::*;

#[test]
fn overrides_are_read() {
    let read = |text: &str| Override::parse(text);
    let of = |node: &str, param: &str, text: &str| {
        Ok(Override { node: Some(node.into()), param: param.into(), text: text.into() })
    };
    let for_all = Override { node: None, param: "votes".into(), text: "5".into() };
    assert_eq!(for_all.to_string(), "votes=5");
    assert_eq!(read("votes=5"), Ok(for_all));
    assert_eq!(read("lift_arbiter.votes=5"), of("lift_arbiter", "votes", "5"));
    assert_eq!(read("a.b=./x.y=z"), of("a", "b", "./x.y=z"));
    assert_eq!(read("a.b="), of("a", "b", ""));
    assert_eq!(read("a.b=5").expect("good").to_string(), "a.b=5");
    for wrong in ["", "votes", "a.votes", ".votes=5", "a.=5", "a.b.c=5", "a b.c=5", "=.", "=5"] {
        let expected = format!("expected node.param=value, like lift_arbiter.votes=5, or param=value, found '{wrong}'");
        assert_eq!(read(wrong), Err(expected));
    }
}

#[test]
fn overrides_count_as_if_the_file_said_so() {
    let folder = Folder::new();
    let param = |settings: &[&str], name: &str| folder.check_set(settings).expect("good").nodes[0].params[name].clone();
    assert_eq!(param(&["source.rate=3", "source.loops=2"], "rate"), json!(3.0));
    assert_eq!(param(&["source.rate=3", "source.loops=2"], "loops"), json!(2));
    assert_eq!(param(&["source.rate=max"], "rate"), json!("max"));
    assert_eq!(param(&["source.verify=false"], "verify"), json!(false));
    // There are no quotes on a command line with which to say that this is a text.
    assert_eq!(param(&["source.label="], "label"), json!(""));
    assert_eq!(param(&["source.label=null"], "label"), json!("null"));
    // A path is relative to the current folder.
    let here = std::env::current_dir().expect("current folder").join("x.log");
    assert_eq!(param(&["source.log=./x.log"], "log"), json!(here));
    let absolute = folder.0.join("ops/own");
    assert_eq!(param(&[&format!("source.recording={}", absolute.display())], "recording"), json!(absolute));

    // What the file says instead doesn't matter any more, nor whether it says anything.
    let set = [Override::parse(&format!("source.recording={}", absolute.display())).expect("good")];
    for params in ["{recording: absent.mcap}", "{}", "{recording: [x]}"] {
        let yaml = format!("version: 1\nname: g\noperators: {{source: {{params: {params}}}}}");
        let file = parse(&folder.0.join("dataflow.yaml"), yaml.as_bytes()).expect("form");
        let graph = check(&file, &shipped(), &set, Scope::Everything, describe).expect("good");
        assert_eq!(graph.nodes[0].params["recording"], json!(absolute), "{params}");
    }
}

#[test]
fn mistakes_in_overrides() {
    let folder = Folder::new();
    for (settings, expected) in [
        (&["sorce.rate=1"][..], "--set sorce.rate=1: there is no node 'sorce'; did you mean 'source'?"),
        (
            &["camera.rate=1"],
            "--set camera.rate=1: there is no node 'camera'; known nodes: arbiter, contacts, source, second",
        ),
        (&["source.rat=1"], "--set source.rat=1: unknown param 'rat' of node 'source'; did you mean 'rate'?"),
        (&["arbiter.rate=1"], "--set arbiter.rate=1: unknown param 'rate' of node 'arbiter'; there are no params"),
        (
            &["source.rate=0"],
            "--set source.rate=0: param 'rate' of node 'source' must be a number above 0 or 'max', found '0'",
        ),
        (
            &["source.rate='1'"],
            "--set source.rate='1': param 'rate' of node 'source' must be a number above 0 or 'max', found ''1''",
        ),
        (
            &["source.on_end=stpo"],
            "--set source.on_end=stpo: param 'on_end' of node 'source' must be one of 'stop', 'no', 'off', \
             found 'stpo'; did you mean 'stop'?",
        ),
        (
            &["source.recording="],
            "--set source.recording=: param 'recording' of node 'source' must be a path, found ''",
        ),
        (
            &["source.recording=/absent.mcap"],
            "--set source.recording=/absent.mcap: param 'recording' of node 'source': '/absent.mcap' does not exist",
        ),
        (
            &["source.rate=1", "source.loops=2", "source.rate=2"],
            "--set source.rate=2: given twice, first as 'source.rate=1'",
        ),
        // Each on one line, whatever it holds.
        (
            &["source.loops=1\n2"],
            "--set source.loops=1\\n2: param 'loops' of node 'source' must be an integer at least 1 and at most 9, \
             found '1\\n2'",
        ),
    ] {
        let error = folder.check_set(settings).expect_err(settings[0]);
        assert_eq!(error.to_string(), expected);
        let found: Vec<_> = error.diagnostics.iter().map(|diagnostic| diagnostic.setting.clone()).collect();
        assert_eq!(found, [Override::parse(settings[settings.len() - 1]).ok()]);
    }

    // After the file's; a misspelled one is not missed as well.
    let yaml = "version: 1\nname: g\noperators: {source: {params: {rate: -1}}}";
    let file = parse(Path::new("/x.yaml"), yaml.as_bytes()).expect("form");
    let set = [Override::parse("source.recordin=a").expect("good")];
    let error = check(&file, &shipped(), &set, Scope::Everything, describe).expect_err("two mistakes");
    assert_eq!(
        error.to_string(),
        "\
/x.yaml:3:37: param 'rate' of node 'source' must be a number above 0 or 'max', found '-1'
--set source.recordin=a: unknown param 'recordin' of node 'source'; did you mean 'recording'?"
    );
}

#[test]
fn params_of_the_file_serve_each_node_that_has_them() {
    let folder = Folder::new();
    let yaml = |params: &str| {
        format!(
            "version: 1\nname: g\nparams: {params}\noperators:\n  source: {{params: {{loops: 2}}}}\n  other: {{run: source}}\n"
        )
    };
    let path = folder.0.join("recordings/a.mcap");
    let graph = folder.check(yaml("{recording: recordings/a.mcap, loops: 3}")).expect("good");
    let loops = |graph: &Graph| graph.nodes.iter().map(|node| node.params["loops"].clone()).collect::<Vec<_>>();
    assert!(graph.nodes.iter().all(|node| node.params["recording"] == json!(path)));
    assert_eq!(loops(&graph), [json!(2), json!(3)]);
    // --set for all nodes counts more than the file, and --set for one node counts most.
    let file = parse(&folder.0.join("dataflow.yaml"), yaml("{recording: recordings/a.mcap}").as_bytes()).expect("form");
    let set: Vec<Override> = ["other.loops=5", "loops=4"].map(|text| Override::parse(text).expect("good")).into();
    assert_eq!(
        loops(&check(&file, &shipped(), &set, Scope::Everything, describe).expect("good")),
        [json!(4), json!(5)]
    );
    let set = [Override::parse("lops=4").expect("good")];
    let error = check(&file, &shipped(), &set, Scope::Everything, describe).expect_err("no such param");
    assert_eq!(error.to_string(), "--set lops=4: no node has the param 'lops'; did you mean 'loops'?");
    let error = folder.check(yaml("{recording: recordings/a.mcap, lops: 3}")).expect_err("no such param");
    let expected = ":3:40: no node has the param 'lops'; did you mean 'loops'?";
    assert!(error.to_string().ends_with(expected) && error.diagnostics.len() == 1, "{error}");
}

#[test]
fn variables_of_the_environment_are_filled_in() {
    let folder = Folder::new();
    let yaml = |value: &str| {
        format!(
            "version: 1\nname: g\noperators:\n  source: {{params: {{recording: recordings/a.mcap, loops: {value}}}}}\n"
        )
    };
    let loops = |value: &str| Ok::<_, DataflowError>(folder.check(yaml(value))?.nodes[0].params["loops"].clone());
    assert_eq!(loops("'${BLINDGRASP_NO_SUCH_VARIABLE:-7}'").expect("good"), json!(7));
    let without_quotes = loops("${BLINDGRASP_NO_SUCH_VARIABLE:-7}").expect_err("no YAML").to_string();
    assert!(without_quotes.contains("in braces, a value with ${ needs quotes"), "{without_quotes}");
    let error = folder.check(yaml("\"${BLINDGRASP_NO_SUCH_VARIABLE}\"")).expect_err("not set");
    let expected = "the variable 'BLINDGRASP_NO_SUCH_VARIABLE' is not set in the environment; set it, or give it a \
                    default: ${BLINDGRASP_NO_SUCH_VARIABLE:-DEFAULT}";
    assert!(error.to_string().contains(expected), "{error}");
}

#[test]
fn params_of_a_running_operator() {
    let mut source = OperatorDescription::from_json(SOURCE).expect("good");
    let nowhere = Path::new("/nowhere");
    let accept = |name: &str, text: &str| accept_param(&source, name, text, nowhere);
    assert_eq!(accept("rate", "3"), Ok(json!(3.0)));
    assert_eq!(accept("label", "null"), Ok(json!("null")));
    assert_eq!(accept("log", "./x.log"), Ok(json!("/nowhere/x.log")));
    assert_eq!(accept("recording", "/"), Ok(json!("/")));
    for (name, text, expected) in [
        ("rat", "3", "unknown param 'rat' of operator 'source'; did you mean 'rate'?"),
        (
            "color",
            "3",
            "unknown param 'color' of operator 'source'; \
             known params: recording, rate, loops, verify, on_end, label, log",
        ),
        ("loops", "ten", "param 'loops' of operator 'source' must be an integer at least 1 and at most 9, found 'ten'"),
        ("verify", "yes", "param 'verify' of operator 'source' must be true or false, found 'yes'; write true"),
        ("recording", "a", "param 'recording' of operator 'source': '/nowhere/a' does not exist"),
    ] {
        assert_eq!(accept(name, text), Err(expected.to_owned()));
    }

    let accept = |name: &str, value| accept_param_value(&source, name, &value, nowhere);
    assert_eq!(accept("rate", json!(3)), Ok(json!(3.0)));
    assert_eq!(accept("rate", json!("max")), Ok(json!("max")));
    assert_eq!(accept("loops", json!(9)), Ok(json!(9)));
    assert_eq!(accept("log", json!("x.log")), Ok(json!("/nowhere/x.log")));
    let of = "of operator 'source' must be";
    for (name, value, expected) in [
        ("rat", json!(3), "unknown param 'rat' of operator 'source'; did you mean 'rate'?".to_owned()),
        ("loops", json!(10), format!("param 'loops' {of} an integer at least 1 and at most 9, found '10'")),
        ("loops", json!(2.5), format!("param 'loops' {of} an integer at least 1 and at most 9, found '2.5'")),
        (
            "loops",
            json!("2"),
            format!(
                "param 'loops' {of} an integer at least 1 and at most 9, found the string '2'; leave the quotes out"
            ),
        ),
        (
            "rate",
            json!("mx"),
            format!("param 'rate' {of} a number above 0 or 'max', found the string 'mx'; did you mean 'max'?"),
        ),
        ("verify", json!(null), format!("param 'verify' {of} true or false, found nothing")),
        ("verify", json!([true]), format!("param 'verify' {of} true or false, found a list")),
        ("label", json!({}), format!("param 'label' {of} a string, found a mapping")),
        ("label", json!(true), format!("param 'label' {of} a string, found 'true'")),
        ("recording", json!("a"), "param 'recording' of operator 'source': '/nowhere/a' does not exist".to_owned()),
    ] {
        assert_eq!(accept(name, value), Err(expected));
    }

    let live = |source: &OperatorDescription, name: &str| live_param(source, name).map(|param| param.name.clone());
    assert_eq!(
        live(&source, "rate"),
        Err("param 'rate' of operator 'source' cannot be changed while it runs; there are no live params; the others \
             change with: blindgrasp swap NODE --set rate=VALUE"
            .to_owned())
    );
    for name in ["rate", "loops"] {
        source.params.iter_mut().find(|param| param.name == name).expect("there").live = true;
    }
    assert_eq!(live(&source, "rate"), Ok("rate".to_owned()));
    assert_eq!(
        live(&source, "label"),
        Err("param 'label' of operator 'source' cannot be changed while it runs; known live params: rate, loops; the \
             others change with: blindgrasp swap NODE --set label=VALUE"
            .to_owned())
    );
    assert_eq!(live(&source, "rat"), Err("unknown param 'rat' of operator 'source'; did you mean 'rate'?".to_owned()));
}
