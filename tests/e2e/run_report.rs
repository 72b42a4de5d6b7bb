//! `run --report`: the page of a run says the same as its summary.

use serde_json::Value;

use crate::common::{Graph, json_lines, project, report_data, run, swap, unique_name};

#[test]
fn the_report_of_a_run_shows_its_decisions_edges_and_mistakes() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("run.html");
    let flow = project().join("dataflow.yaml");
    let (flow, path) = (flow.to_str().expect("UTF-8"), page.to_str().expect("UTF-8"));
    let fastest = ["--set", "recorded_source.rate=max", "--name"];
    let name = unique_name();
    let ended = run(&[&["run", flow, "--json", "--report", path][..], &fastest, &[&name]].concat(), 0);
    let lines = json_lines(&ended.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    let html = std::fs::read_to_string(&page).expect("a page");
    let page = report_data(&html);
    let (data, cards) = (&page["data"], page["drawn"]["frames"].as_array().expect("cards"));
    for (name, value) in data["summary"].as_object().expect("a summary") {
        assert_eq!(*value, summary[name], "{name}");
    }
    let n_wrong_lifts = summary["false_positives"].as_u64().expect("a number");
    let is_wrong_hold = |line: &&Value| line["action"] == "hold" && line["truth"]["stable"] == true;
    let n_wrong_holds = lines.iter().filter(is_wrong_hold).count() as u64;
    for (wrong, n) in [("wrong_lifts", n_wrong_lifts), ("wrong_holds", n_wrong_holds)] {
        let wrong = &data[wrong];
        assert_eq!((&wrong["n"], &wrong["shown"]), (&n.into(), &n.min(6).into()));
        assert_eq!(wrong["points"].as_array().map(Vec::len), Some(n as usize));
    }
    let n_others = data["others"].as_array().expect("points").len() as u64;
    assert_eq!(Value::from(n_others + n_wrong_lifts + n_wrong_holds), summary["grasps"]);
    // A card of each grasp, which the page draws by itself.
    assert_eq!(cards.len() as u64, n_wrong_lifts.min(6) + n_wrong_holds.min(6));
    let told = cards[0]["lines"].to_string();
    assert!(
        told.contains("known to be unstable; object ") && told.contains("palm: "),
        "the label and the pads: {told}"
    );
    let names = ["http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink", "http://www.w3.org/1999/xhtml"];
    let addresses = names.iter().fold(html.clone(), |html, name| html.replace(name, ""));
    for loads in ["http:", "https:", "src=", "@import", "url("] {
        assert!(!addresses.contains(loads), "{loads}: it needs nothing else");
    }

    // Mistakes are refused before the start, and no file is overwritten by one.
    let same = folder.path().join("same.html");
    let same = same.to_str().expect("UTF-8");
    for (arguments, expected) in [
        (&["--report", "absent/run.html"][..], "absent"),
        (&["--report", "models/barrett-bh8-280.json"], "models/barrett-bh8-280.json"),
        (&["--report", "run.txt"], ".html"),
        (&["--report", same, "--record", same], "choose two files"),
    ] {
        let wrong = run(&[&["run", flow][..], arguments].concat(), 1);
        let said = String::from_utf8_lossy(&wrong.stderr).into_owned();
        assert!(said.contains(expected) && wrong.stdout.is_empty(), "{arguments:?}: {said}");
    }
}

#[test]
fn the_report_of_a_run_tells_its_changes() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("run.html");
    let options = ["--set", "recorded_source.repeat=forever", "--report", page.to_str().expect("UTF-8")];
    let graph = Graph::launch(&unique_name(), &project().join("dataflow.yaml"), &options);
    graph.wait_for_decisions(3);
    run(&["set", "lift_arbiter.votes=2", "--graph", &graph.name], 0);
    swap(&graph, &["classifier", "--probation", "0"], 0);
    graph.kill("contacts");
    graph.wait_for_restart("contacts", 1);
    graph.stop();
    let html = std::fs::read_to_string(&page).expect("a page");
    for change in ["set lift_arbiter.votes=2", "'classifier' swapped after", "node 'contacts'"] {
        assert!(html.contains(change), "{change}");
    }
    let summary = &report_data(&html)["data"]["summary"];
    assert_eq!((&summary["restarts"], &summary["swaps"]), (&1.into(), &1.into()), "{summary}");
}
