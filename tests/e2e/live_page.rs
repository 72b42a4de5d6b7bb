//! The page of a running graph or a recording, in headless Chromium (`tests/browser.py`).

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::process::Command;

use crate::common::browser::{Browser, Running};
use crate::common::python::python;
use crate::common::{Graph, RECORDING, blindgrasp, project, run, swap, unique_name, wait_until};
use blindgrasp_messages::Action;
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::hand::Hand;
use serde_json::{Value, json};

/// Plays at the speed of a robot, so that a busy machine keeps up.
fn launch(name: &str) -> Graph {
    let settings = ["--set", "recorded_source.repeat=forever", "--set", "recorded_source.rate=1"];
    Graph::launch(name, &project().join("dataflow.yaml"), &settings)
}

fn model_file() -> Value {
    let text = std::fs::read(project().join("models/barrett-bh8-280.json")).expect("a model");
    serde_json::from_slice(&text).expect("JSON")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(|number| number.as_f64().expect("a number")).collect()
}

fn assert_near(found: &[f64], expected: &[f64], what: &str) {
    let is_near = found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 2e-5);
    assert!(is_near, "{what}: {found:?}, expected {expected:?}");
}

#[test]
fn a_browser_shows_a_graph_as_it_runs() {
    let name = unique_name();
    let graph = launch(&name);
    graph.wait_for_decisions(1);
    let (page, address) = Running::page_with(&name, 0, &["--shadow", "models/barrett-bh8-280.json"]);
    let Some(mut browser) = Browser::open(&address) else { return };
    browser.keep_waits();
    browser.wait_for_frames(20);
    browser.wait_until("blindgrasp.decision !== null && blindgrasp.graph !== null");

    // The posture, as three.js draws it, is that of a frame of the recording; so are the colours of the cells.
    let shown = browser.ask(
        "(({ frame, hand, cellColours, scene }) => ({ frame, cellColours, silent: scene.silent_colour, \
         meshes: hand.meshes().map((mesh) => [...mesh.matrix.elements]), drawn: hand.colouredCells() }))(blindgrasp)",
    );
    let frame = &shown["frame"];
    let recorded = RecordingReader::open(&project().join(RECORDING)).expect("a recording").find_map(|record| {
        let Record::Tactile(sample) = record.expect("a record").1 else { return None };
        let is_it = sample.message.joints == numbers(&frame["joints"])
            && sample.message.cells_newtons == numbers(&frame["cells"]);
        is_it.then_some(sample.message)
    });
    let recorded = recorded.expect("a frame of the recording");
    let hand = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
    let poses = hand.palm_from_links(&recorded.joints).expect("a posture");
    for (idx, pose) in poses.iter().enumerate() {
        // Column by column, as nalgebra's.
        assert_near(&numbers(&shown["meshes"][idx]), pose.to_homogeneous().as_slice(), &hand.links[idx].name);
    }
    for (idx, (newtons, (_, cell))) in recorded.cells_newtons.iter().zip(hand.cells()).enumerate() {
        let is_silent = shown["cellColours"][idx] == shown["silent"];
        assert_eq!(is_silent, *newtons <= cell.noise_threshold_newtons, "cell {idx}: {newtons} N");
        let wanted: Vec<f64> = numbers(&shown["cellColours"][idx]).iter().map(|part| part / 255.0).collect();
        let drawn = numbers(&shown["drawn"][idx]);
        assert!(wanted.iter().zip(&drawn).all(|(a, b)| (a - b).abs() < 0.01), "cell {idx}: {drawn:?}, {wanted:?}");
    }
    assert!(browser.ask("blindgrasp.hand.renderer.info.render.triangles").as_u64() > Some(500));

    // The texts of the page.
    let decision = browser.text("action");
    assert!(["lift", "hold"].contains(&decision.as_str()), "{decision}");
    let why = browser.text("why");
    // Two digits of a number from 0 to 1: 0.996 is 1.00.
    assert!(why.contains("probability 0.") || why.contains("probability 1.00"), "{why}");
    assert_eq!(browser.ask("document.getElementById('nodes').rows.length"), 5);
    assert!(browser.text("edges").contains("contacts/contacts"), "{}", browser.text("edges"));
    assert!(browser.text("spoken").contains("Grasp "));
    // Feature, words, thresholds, votes and log.
    let model = browser.ask("blindgrasp.model");
    assert_eq!(model["threshold"].as_f64(), model_file()["classifier"]["threshold_probability"].as_f64());
    browser.wait_until("document.getElementById('blocks').textContent.includes('histogram')");
    browser.wait_for_waits("waits for 3 settled predictions that agree");
    browser.wait_until("blindgrasp.hand.wordCount() > 2");
    browser.wait_until(
        "/^The model beside: (LIFT|HOLD) for grasp \\d/.test(document.getElementById('shadow').textContent)",
    );
    browser.wait_until("/^decisions in \\d/.test(document.getElementById('latency').textContent)");
    browser.wait_until("document.getElementById('state').textContent === 'running'");
    browser.wait_until(
        "document.body.className === '' && /^decided \\d+ s ago$/.test(document.getElementById('decided').textContent)",
    );
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    browser.ask("size 400 800");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    assert_eq!(browser.ask("document.documentElement.scrollWidth <= window.innerWidth"), true);
    assert_eq!(browser.ask("errors"), Value::Array(vec![]));
    if let Ok(path) = std::env::var("BLINDGRASP_PICTURE") {
        browser.ask("size 1280 1000");
        browser.wait_for_frames(5);
        browser.ask(&format!("picture {path}"));
    }

    // The chart has a mark at each probability and at each decision, and its legend.
    browser.wait_until("document.querySelectorAll('#chart path[fill=\"var(--mark)\"]').length === 1");
    browser.wait_until("/lift|hold/.test(document.getElementById('chart').textContent)");
    // The legends of chart and 3-D view.
    assert!(browser.text("chart-key").contains("threshold") && browser.text("chart-key").contains("model beside"));
    browser.choose("quantity", "force");
    browser.wait_until("document.getElementById('chart-key').textContent.includes('palm')");
    assert!(browser.text("largest").ends_with(" N"), "{}", browser.text("largest"));
    let guides = browser.ask("document.querySelector('.guides').textContent");
    let guides = guides.as_str().expect("a text");
    assert!(guides.starts_with("xyz") && guides.ends_with(" mm"), "{guides}");
    assert!(browser.text("joints").contains(" rad"), "{}", browser.text("joints"));

    // A swap, the end of the graph, and its next run.
    swap(&graph, &["classifier"], 0);
    browser.wait_until("blindgrasp.graph.nodes.some((node) => node.n_swaps === 1)");
    browser.wait_for_frames(10);
    graph.stop();
    browser.wait_until("document.getElementById('state').textContent.includes('has ended; waiting for it')");
    browser.wait_until("document.body.className === 'stale'");
    let graph = launch(&name);
    browser.wait_for_frames(10);
    browser.wait_until("blindgrasp.decision !== null && blindgrasp.decision.truth !== null");
    browser.wait_until("document.getElementById('state').className === ''");

    // The page's server goes and comes.
    let port = address.rsplit(':').next().and_then(|port| port.parse().ok()).expect("a port");
    drop(page);
    browser.wait_until("document.getElementById('state').textContent.startsWith('the connection is broken')");
    let _page = Running::page(&name, port);
    // The page loads again, because it is another server's.
    browser.wait_until("typeof blindgrasp === 'object' && blindgrasp.frames > 10");
    assert_eq!(graph.node("recorded_source")["n_restarts"], 0);
    graph.stop();
}

/// The last minutes: a decision is chosen from the list and shows the frame that decided, and the page goes on live.
#[test]
fn a_browser_pauses_and_looks_at_past_decisions() {
    let name = unique_name();
    let graph = launch(&name);
    graph.wait_for_decisions(1);
    let (_page, address) = Running::page(&name, 0);
    let Some(mut browser) = Browser::open(&address) else { return };
    browser.wait_until("window.blindgrasp?.past.decisions.filter((decision) => decision.frame?.links).length > 5");
    // Each has a frame of its own grasp. Of the first ones, none may have been read.
    let is_of_another = "({ frame, grasp_id }, idx) => (frame ? frame.grasp_id !== grasp_id : idx > 2)";
    assert_eq!(browser.ask(&format!("blindgrasp.past.decisions.filter({is_of_another})")), Value::Array(vec![]));
    // The two values that spoke most against an unstable grasp.
    browser.wait_until("blindgrasp.past.decisions.some(({ reason }) => reason === 'unstable')");
    let against =
        "blindgrasp.past.decisions.filter(({ reason }) => reason === 'unstable').map(({ against }) => against)";
    let against = browser.ask(against);
    assert!(
        against.as_array().expect("texts").iter().all(|text| text.to_string().contains("most against it: ")),
        "{against}"
    );
    // A grasp that is decided does not wait, at any moment.
    browser.ask(
        "(window.contradictions = [], setInterval(() => { \
           const id = (element) => /Grasp (\\d+)/.exec(document.getElementById(element).textContent)?.[1]; \
           const isFinal = ['lift', 'hold'].includes(document.getElementById('action').textContent); \
           if (isFinal && id('why') === id('waits')) contradictions.push(id('why')); }, 3), null)",
    );
    browser.wait_for_frames(60);
    assert_eq!(browser.ask("contradictions"), Value::Array(vec![]));

    let rows = "[...document.querySelectorAll('#decisions tr')]";
    let is_shown = |text: &str| format!("{rows}.some((row) => row.textContent.includes('{text}'))");
    browser.wait_until(&is_shown("stable"));
    browser.wait_until(&format!("!{}", is_shown("not known")));
    // On a busy machine a decision may come so late that its frame is no more kept.
    browser.ask(&format!(
        "(() => {{ const row = {rows}.findLast(({{ cells }}) => blindgrasp.past.decisions.some(({{ grasp_id, frame }}) => \
           frame?.links && grasp_id === cells[1].textContent)); \
           row.querySelector('button').click(); }})() ?? null"
    ));
    let chosen = browser.ask("document.querySelector('#decisions .chosen button').textContent");
    assert_eq!(browser.ask("location.hash"), format!("#grasp={}", chosen.as_str().expect("a number")));
    assert_eq!(browser.ask("document.getElementById('pause').textContent"), "Go on live");
    assert!(browser.text("why").starts_with(&format!("Grasp {}:", chosen.as_str().expect("a number"))));
    assert!(browser.text("ago").starts_with("the frame that decided grasp"), "{}", browser.text("ago"));
    // It is a frame of that grasp, of a closed hand.
    assert_eq!(browser.ask("blindgrasp.frame.grasp_id"), chosen);
    assert_ne!(browser.ask("blindgrasp.frame.phase"), "open");
    // The page stands still, and the graph goes on.
    let n_frames = browser.ask("blindgrasp.frames");
    let n_kept = browser.ask("blindgrasp.past.moments.length").as_u64().expect("a number");
    browser.wait_until(&format!("blindgrasp.past.moments.length > {}", n_kept + 20));
    assert_eq!(browser.ask("blindgrasp.frames"), n_frames);
    assert_eq!(browser.ask("document.body.className"), "");
    // The list is one stop of the tab order, in which arrow keys move; n and p choose.
    let stops = "[...document.querySelectorAll('#decisions button')].filter(({ tabIndex }) => tabIndex === 0)";
    assert_eq!(
        browser.ask(&format!("{stops}.map(({{ textContent }}) => textContent)")),
        Value::from(vec![chosen.clone()])
    );
    let below = "document.querySelector('#decisions .chosen').nextElementSibling";
    let press = |key: &str, at: &str| {
        format!("{at}.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))")
    };
    if browser.ask(&format!("{below} !== null")) == true {
        let older = browser.ask(&format!("{below}.querySelector('button').textContent"));
        browser.ask(&press("ArrowDown", "document.querySelector('#decisions .chosen button')"));
        assert_eq!(browser.ask("document.activeElement.textContent"), older);
        browser.ask(&press("p", "document"));
        assert_eq!(browser.ask("document.querySelector('#decisions .chosen button').textContent"), older);
        browser.ask(&press("n", "document"));
    }
    assert_eq!(browser.ask("document.querySelector('#decisions .chosen button').textContent"), chosen);
    // A decision whose frame is not kept shows no other grasp's hand.
    let lacking = "(({ past }, decision) => { const { frame } = decision; decision.frame = undefined; past.choose(decision); \
                   decision.frame = frame; return document.getElementById('moment').textContent; })\
                   (blindgrasp, blindgrasp.past.list.chosen)";
    let said = browser.ask(lacking);
    assert!(said.as_str().is_some_and(|text| text.ends_with("is not kept: no hand is drawn")), "{said}");
    assert_eq!(browser.ask("getComputedStyle(document.getElementById('stage')).visibility"), "hidden");
    assert_eq!(browser.text("pads"), "");
    // Back through the moments, one by one.
    // At once: a frame that comes between sets the slider back.
    browser.ask(
        "(slider => { slider.value = 3; return slider.dispatchEvent(new Event('input')); })\
         (document.getElementById('moment-slider'))",
    );
    assert_eq!(browser.ask("blindgrasp.past.at === blindgrasp.past.moments[3].at"), true);
    assert!(browser.text("ago").ends_with("s before the last frame"), "{}", browser.text("ago"));
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    browser.ask("size 400 800");
    browser.ask("dark");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    assert_eq!(browser.ask("document.documentElement.scrollWidth <= window.innerWidth"), true);
    browser.ask(&press(" ", "document"));
    browser.wait_for_frames(5);
    assert_eq!(browser.ask("location.hash"), "");
    // A decision has its frame as long as it is in the list, also until the list is drawn again.
    let pushed_out = "(() => {\
        const { past } = blindgrasp, row = past.list.rows.findLast(({ frame }) => frame);\
        const decisions = Array.from({ length: 200 }, () => ({ ...row }));\
        past.push({ at: performance.now(), probabilities: [], shadow: [], decisions });\
        const before = 'frame' in row;\
        past.refresh();\
        return [before, 'frame' in row, past.list.rows.includes(row)]; })()";
    assert_eq!(browser.ask(pushed_out), json!([true, false, false]));
    assert_eq!(browser.ask("errors"), Value::Array(vec![]));
    // The log says the same, once for a grasp.
    let log = run(&["logs", "classifier", "--graph", &name], 0);
    let log = String::from_utf8_lossy(&log.stdout).into_owned();
    assert!(log.contains(" seems unstable: of pads and joints, most against it: "), "{log}");
    graph.stop();
}

/// A graph that no hand speaks to yet.
#[test]
fn an_empty_page_names_the_socket_that_it_waits_at() {
    let folder = tempfile::tempdir().expect("a folder");
    let socket = format!("unix:{}", folder.path().join("hand.sock").display());
    let settings = ["--view", "--set", &format!("source.address={socket}")];
    let graph = Graph::launch(&unique_name(), &project().join("dataflow-live.yaml"), &settings);
    wait_until(|| graph.said().contains("in a browser on this machine: http://"), || graph.said());
    let said = graph.said();
    let address = said.split("this machine: ").nth(1).and_then(|rest| rest.lines().next()).expect("an address");
    let Some(mut browser) = Browser::open(&format!("{}/#grasp=5", address.trim())) else { return };
    browser.wait_until("window.blindgrasp?.graph !== undefined && blindgrasp.graph !== null");
    browser.wait_until("document.getElementById('moment').textContent.includes('waits for')");
    let moment = browser.text("moment");
    assert!(moment.contains(&format!("waits for a bridge at {socket}; docs/hardware.md")), "{moment}");
    assert_eq!(browser.ask("document.getElementById('action').className"), "action none");
    assert_eq!(browser.text("go-answer"), "grasp 5 is not in the list: it is empty");
    assert_eq!(browser.ask("getComputedStyle(document.getElementById('stage')).visibility"), "hidden");
    // Colours that colour-blind eyes tell apart come with marks, and the dashed lines with words.
    browser.wait_until("document.getElementById('chart-key').textContent.includes('thresholds')");
    let marks =
        "[...document.querySelectorAll('#chart-key .key')].map(({ dataset }) => dataset.mark).filter(Boolean).join('')";
    assert_eq!(browser.ask(marks), "┄▲▼△");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    graph.stop();
}

#[test]
fn a_page_with_the_token_sets_swaps_and_stops() {
    let name = unique_name();
    let graph = launch(&name);
    graph.wait_for_decisions(1);
    let (_page, address) = Running::page_with(&name, 0, &["--view-control"]);
    let (without, token) = address.split_once("/#").expect("a token");
    let Some(mut reader) = Browser::open(without) else { return };
    reader.wait_until("!!window.blindgrasp?.graph");
    assert_eq!(reader.ask("document.getElementById('control').hidden"), true);
    let Some(mut browser) = Browser::open(&address) else { return };
    browser.wait_until("document.getElementById('set-param').options.length > 5");
    browser.keep_waits();
    assert_eq!(browser.ask("location.hash"), "", "the token stays out of the address");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    let fill = |browser: &mut Browser, id: &str, value: &str| {
        browser.ask(&format!("document.getElementById('{id}').value = '{value}'"));
    };
    let click = |browser: &mut Browser, button: &str| {
        browser.ask(&format!("document.querySelector('{button}').click()"));
        browser.wait_until("!document.querySelector('#swap button').disabled");
    };
    browser.wait_until("document.getElementById('log').textContent.includes('recorded_source')");
    assert_eq!(reader.text("log"), "", "other users may not read the log");
    fill(&mut browser, "set-param", "lift_arbiter.votes");
    fill(&mut browser, "set-value", "5");
    click(&mut browser, "#set button");
    assert!(browser.text("answer").contains("lift_arbiter.votes: 3 → 5"), "{}", browser.text("answer"));
    assert_eq!(graph.node("lift_arbiter")["params"]["votes"], 5);
    browser.wait_for_waits("waits for 5 settled");
    fill(&mut browser, "set-value", "many");
    click(&mut browser, "#set button");
    assert_eq!(browser.ask("document.getElementById('answer').className"), "answer trouble");
    fill(&mut browser, "swap-node", "classifier");
    fill(&mut browser, "swap-compare", "1");
    if let Ok(path) = std::env::var("BLINDGRASP_PICTURE") {
        browser.ask("document.getElementById('control').scrollIntoView()");
        browser.ask(&format!("picture {path}.control.png"));
    }
    click(&mut browser, "#swap button");
    assert_eq!(graph.node("classifier")["n_swaps"], 1, "{}", browser.text("answer"));
    // The audit log has the orders.
    let log = run(&["logs", "audit", "--graph", &name], 0);
    let log = String::from_utf8_lossy(&log.stdout).into_owned();
    assert!(log.contains("set lift_arbiter.votes=5") && !log.contains(token), "{log}");
    browser.ask("document.getElementById('stop').click()");
    assert_eq!(graph.node("classifier")["state"], "running", "the first click asks");
    browser.ask("document.getElementById('stop').click()");
    browser.wait_until("document.getElementById('state').textContent.includes('has ended')");
    graph.finish();
}

#[test]
fn a_browser_shows_the_grasps_of_a_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    let path = recording.to_str().expect("UTF-8");
    let flow = project().join("dataflow.yaml");
    let flow = flow.to_str().expect("UTF-8");
    run(&["run", flow, "--name", &unique_name(), "--set", "recorded_source.rate=max", "--record", path], 0);
    let (mut lifts, mut stable, mut frames) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::<u64, Vec<_>>::new());
    let (mut decided, mut stamps) = (BTreeMap::new(), BTreeMap::<u64, Vec<u64>>::new());
    for record in RecordingReader::open(&recording).expect("a recording") {
        match record.expect("a record").1 {
            Record::Decision(it) => {
                lifts.insert(it.message.grasp_id, it.message.action == Action::Lift);
                decided.insert(it.message.grasp_id, it.header.stamp_nanos);
            }
            Record::Truth(it) => drop(stable.insert(it.message.grasp_id, it.message.stable)),
            Record::Tactile(it) => {
                stamps.entry(it.message.grasp_id).or_default().push(it.header.stamp_nanos);
                frames.entry(it.message.grasp_id).or_default().push(it.message);
            }
            _ => {}
        }
    }
    let n_wrong = |lifted: bool| lifts.iter().filter(|(id, lift)| **lift == lifted && stable[*id] != lifted).count();
    let (n_false_positives, n_false_negatives) = (n_wrong(true), n_wrong(false));
    assert!(n_false_positives > 0 && n_false_negatives > 0);
    let (_page, address) = Running::page(path, 0);
    let Some(mut browser) = Browser::open(&address) else { return };
    browser.wait_until("window.blindgrasp?.player.frames.length > 0 && blindgrasp.frame !== null");
    let said = browser.text("state");
    assert_eq!(
        said,
        format!("{} grasps, {n_false_positives} false positives, {n_false_negatives} false negatives", lifts.len())
    );
    browser.ask("document.getElementById('mistake').click()");
    browser.wait_until(
        "window.blindgrasp?.player.verdict(blindgrasp.player.grasps[blindgrasp.player.at]).startsWith('false')",
    );
    browser.wait_until("blindgrasp.frame.grasp_id === blindgrasp.player.grasps[blindgrasp.player.at].id");
    let id: u64 = browser.ask("blindgrasp.frame.grasp_id").as_str().and_then(|id| id.parse().ok()).expect("a number");
    assert_ne!(lifts[&id], stable[&id]);
    assert!(browser.text("why").contains(if stable[&id] { "It was stable." } else { "It was not stable." }));
    // It shows the frame that decided.
    let expected = stamps[&id].iter().position(|stamp| *stamp == decided[&id]).expect("the frame of the decision");
    assert_eq!(browser.ask("blindgrasp.player.n"), expected);
    assert!(browser.text("when").ends_with(", which decided"), "{}", browser.text("when"));
    assert!(browser.text("why").contains("Object: "), "{}", browser.text("why"));
    let expected = &frames[&id];
    assert_eq!(browser.ask("blindgrasp.player.frames.length"), expected.len());
    for (idx, frame) in expected.iter().enumerate().step_by(5) {
        let at = format!("blindgrasp.player.frames[{idx}]");
        assert_eq!(numbers(&browser.ask(&format!("{at}.joints"))), frame.joints);
        assert_eq!(numbers(&browser.ask(&format!("{at}.cells"))), frame.cells_newtons);
    }
    assert!(browser.ask("blindgrasp.player.frames.at(-1).probability").is_f64());
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    if let Ok(path) = std::env::var("BLINDGRASP_PICTURE") {
        browser.ask("document.getElementById('frame').value = 12");
        browser.ask("document.getElementById('frame').dispatchEvent(new Event('input'))");
        browser.ask(&format!("picture {path}.recording.png"));
    }
    // The wrong decision is marked, in the list as well.
    assert!(
        browser.ask("document.getElementById('action').className").as_str().is_some_and(|it| it.ends_with(" wrong"))
    );
    assert!(browser.ask("document.querySelector('#decisions .chosen').textContent").to_string().contains('✗'));
    assert_eq!(browser.ask("document.getElementById('decisions').rows.length"), lifts.len());
    // The address names the grasp and is obeyed, as is the field; n and p go on from there.
    assert_eq!(browser.ask("location.hash"), format!("#grasp={id}"));
    let is_shown = |id: u64| format!("blindgrasp.frame.grasp_id === '{id}' && location.hash === '#grasp={id}'");
    browser.ask("(document.getElementById('go-to').value = '100', document.querySelector('#go button').click(), null)");
    browser.wait_until(&is_shown(100));
    for (key, id) in [("n", 101), ("p", 100)] {
        browser.ask(&format!("document.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))"));
        browser.wait_until(&is_shown(id));
    }
    browser
        .ask("(document.getElementById('go-to').value = '99999', document.querySelector('#go button').click(), null)");
    assert_eq!(browser.text("go-answer"), "grasp 99999 is not in the list: its first one is 0, its last one 239");
    // A number that two runs of the source have is given with the run.
    browser.ask(
        "(Object.assign(blindgrasp.player.grasps[50], { grasp_id: '0', epoch: '2' }), location.hash = '#grasp=0&epoch=2', null)",
    );
    browser.wait_until("blindgrasp.player.at === 50 && location.hash === '#grasp=0&epoch=2'");
    browser.ask("(Object.assign(blindgrasp.player.grasps[50], { grasp_id: '50', epoch: '1' }), null)");
    browser.ask(&format!("(location.hash = '#grasp={id}', null)"));
    browser.wait_until(&is_shown(id));
    // It plays to the end of the grasp, and goes on.
    browser.ask("document.getElementById('play').click()");
    browser.wait_until(&format!("Number(blindgrasp.frame.grasp_id) > {id} && blindgrasp.player.n > 2"));
    browser.ask("document.getElementById('play').click()");
    assert_eq!(browser.ask("blindgrasp.player.isPlaying"), false);
    assert_eq!(browser.ask("errors"), Value::Array(vec![]));
    // A recording is not old, however late it comes over a slow line.
    browser.ask("latency 600");
    browser.ask("(window.isOld = true, location.reload())");
    browser.wait_until("typeof isOld === 'undefined' && window.blindgrasp?.player?.frames.length > 0");
    assert_ne!(browser.ask("blindgrasp.player.grasps[blindgrasp.player.at].id"), "0", "that of the address");
    browser.ask("(window.n_checks = 0, setInterval(() => { n_checks += 1; }, 300), null)");
    browser.wait_until("n_checks > 3");
    assert_eq!(browser.ask("document.body.className"), "recorded");
    // Another model beside: the decisions of this one are those of the recording, grasp by grasp.
    let model = project().join("models/barrett-bh8-280.json");
    let (_page, address) = Running::page_with(path, 0, &["--shadow", model.to_str().expect("UTF-8")]);
    let Some(mut browser) = Browser::open(&address) else { return };
    for idx in [0, 1, 7] {
        browser.ask(&format!("blindgrasp.player.go({idx})"));
        browser.wait_until(&format!("blindgrasp.player.at === {idx} && blindgrasp.player.frames.length > 0"));
        let grasp = browser.ask(&format!("blindgrasp.player.grasps[{idx}]"));
        let action = grasp["action"].as_str().expect("an action").to_uppercase();
        let said = browser.text("shadow");
        assert!(
            said.contains(&format!("{action} for grasp {}", grasp["id"].as_str().expect("an id"))),
            "{said}, {grasp}"
        );
        let last = browser.ask("blindgrasp.player.frames.at(-1)");
        assert_eq!(last["shadow"], last["probability"]);
    }
    browser.wait_until("document.getElementById('chart-key').textContent.includes('model beside')");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    // A recording of the simulator has the object, and no decisions.
    let (_page, address) = Running::page(project().join(RECORDING).to_str().expect("UTF-8"), 0);
    let Some(mut browser) = Browser::open(&address) else { return };
    browser.wait_until("window.blindgrasp?.player.frames.length > 0 && blindgrasp.frame !== null");
    assert!(browser.text("state").ends_with("grasps, no decisions in the recording"), "{}", browser.text("state"));
    assert!(browser.ask("blindgrasp.hand.objectTriangles()").as_u64() > Some(10));
    let wrong = run(&["view", path, "--grasp", "99999"], 1);
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("has no grasp 99999"));
}

/// One file, opened from the disk: the same hand, drawn by the same code.
#[test]
fn the_page_of_a_picture_draws_the_grasp() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("grasp.html");
    let page = page.to_str().expect("UTF-8");
    run(&["view", project().join(RECORDING).to_str().expect("UTF-8"), "--out", page], 0);
    let Some(mut browser) = Browser::open(&format!("file://{page}")) else { return };
    browser.wait_until("typeof blindgrasp === 'object' && document.getElementById('when').textContent !== ''");
    browser.wait_until("blindgrasp.hand.renderer.info.render.triangles > 500");
    assert!(browser.ask("blindgrasp.hand.objectTriangles()").as_u64() > Some(10));
    let n_contacts = browser.ask("document.querySelectorAll('table .badge').length").as_u64().expect("a number");
    assert!(n_contacts > 2);
    let n_numbers =
        "[...document.querySelectorAll('#numbers span')].filter((it) => it.style.left !== '' && !it.hidden)";
    browser.wait_until(&format!("{n_numbers}.length === {n_contacts}"));
    let drawn = browser.ask("JSON.stringify(blindgrasp.hand.colouredCells())");
    if let Ok(path) = std::env::var("BLINDGRASP_PICTURE") {
        browser.ask("document.getElementById('stage').scrollIntoView()");
        browser.ask(&format!("picture {path}.sheet.png"));
    }
    // Its first frame is of the open hand.
    browser.ask("document.getElementById('frame').value = 0");
    browser.ask("document.getElementById('frame').dispatchEvent(new Event('input'))");
    assert_eq!(browser.ask(&format!("{n_numbers}.length")), 0);
    assert_ne!(browser.ask("JSON.stringify(blindgrasp.hand.colouredCells())"), drawn);
    // The picture of the hand as a file: a white one would be smaller.
    browser.ask(
        "(window.saved = {}, HTMLAnchorElement.prototype.click = function () { saved.name = this.download; }, null)",
    );
    browser.ask("(URL.createObjectURL = (blob) => { Object.assign(saved, { type: blob.type, n_bytes: blob.size }); return '#'; }, null)");
    browser.click(".save");
    browser.wait_until("saved.name !== undefined");
    let saved = browser.ask("saved");
    assert!(saved["name"].as_str().is_some_and(|name| name.starts_with("grasp-") && name.ends_with(".png")), "{saved}");
    assert!(saved["type"] == "image/png" && saved["n_bytes"].as_u64() > Some(10_000), "{saved}");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    assert_eq!(browser.ask("errors"), Value::Array(vec![]));
}

/// The triangles of the links, with the cells and all else that is on them.
const N_TRIANGLES: &str = "(() => { let n = 0; blindgrasp.hand.meshes().forEach((link) => link.traverse((part) => \
                           { n += part.geometry.index.count / 3; })); return n; })()";

/// The hand by itself touches nothing: no force is written.
#[test]
fn the_page_of_a_hand_writes_no_forces() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("hand.html");
    let page = page.to_str().expect("UTF-8");
    run(&["view", "barrett-bh8-280", "--out", page], 0);
    let Some(mut browser) = Browser::open(&format!("file://{page}")) else { return };
    browser.wait_until("typeof blindgrasp === 'object' && document.getElementById('when').textContent !== ''");
    let pads = browser.text("pads");
    assert!(pads.contains("24 cells") && !pads.contains(" N") && !pads.contains("1.0"), "{pads}");
    // Needles show the normals: two triangles for each of the 96 cells, beside the two of the cell.
    let with_needles = browser.ask(N_TRIANGLES).as_u64().expect("a number");
    browser.ask("(blindgrasp.hand.build(JSON.parse(document.getElementById('report').textContent).drawn), null)");
    assert_eq!(browser.ask(N_TRIANGLES), with_needles - 2 * 96);
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    browser.ask("size 400 800");
    assert_eq!(browser.ask("document.documentElement.scrollWidth <= window.innerWidth"), true);
}

/// Messages decoded by rosbags, from a connection by websockets: neither was written here.
#[test]
fn foxglove_reads_the_samples_of_a_graph() {
    let name = unique_name();
    let graph = launch(&name);
    graph.wait_for_decisions(1);
    let (_page, address) = Running::page_with(&name, 0, &["--foxglove"]);
    let address = address.replace("http://", "ws://") + "/foxglove";
    let peer = |arguments: &[&str]| {
        let mut command = Command::new(python());
        command.arg(project().join("tests/foxglove_peer.py")).arg(&address).args(arguments);
        command.env("PYTHONDONTWRITEBYTECODE", "1").output().expect("started")
    };
    for (subprotocol, origin) in
        [("foxglove.sdk.v1", "https://app.foxglove.dev"), ("foxglove.websocket.v1", "http://localhost:8080")]
    {
        let output = peer(&[subprotocol, origin]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let schema = |topic: &str| found[topic]["schema"].as_str().map(str::to_owned);
        assert_eq!(schema("/prediction").as_deref(), Some("blindgrasp_msgs/msg/Prediction"), "{found}");
        assert_eq!(schema("/decision").as_deref(), Some("blindgrasp_msgs/msg/LiftDecision"));
        let tactile = &found["/tactile"]["fields"];
        let epoch = tactile["header"]["epoch"].as_u64().expect("a number");
        assert_eq!(found["/prediction"]["fields"]["header"]["epoch"], epoch, "one source");
        let is_recorded = RecordingReader::open(&project().join(RECORDING)).expect("a recording").any(|record| {
            let Record::Tactile(sample) = record.expect("a record").1 else { return false };
            assert_ne!(sample.header.epoch, epoch, "the epoch of the graph");
            sample.message.joints == numbers(&tactile["joints"])
                && sample.message.cells_newtons == numbers(&tactile["cells_newtons"])
        });
        assert!(is_recorded, "{tactile}");
        assert_eq!(found["/joint_states"]["fields"]["name"].as_array().map(Vec::len), Some(7));
        assert_eq!(found["/contact_points"]["fields"]["header"]["frame_id"], "palm");
        assert!(found["/hand_markers"]["fields"]["markers"].as_array().is_some_and(|markers| markers.len() > 10));
        // The layout names topics that there are.
        let layout = std::fs::read_to_string(project().join("docs/foxglove-layout.json")).expect("a layout");
        for (topic, _) in found.as_object().expect("topics").iter().filter(|(topic, _)| topic.starts_with("/hand")) {
            assert!(layout.contains(topic), "{topic}");
        }
    }
    for wrong in [&["foxglove.sdk.v1", "https://robot.example"][..], &["chat.v1"]] {
        let output = peer(wrong);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && (said.contains("403") || said.contains("400")), "{wrong:?}: {said}");
    }
    let (_page, address) = Running::page_with(&name, 0, &[]);
    let mut command = Command::new(python());
    command.arg(project().join("tests/foxglove_peer.py")).arg(address.replace("http://", "ws://") + "/foxglove");
    let output = command.arg("foxglove.sdk.v1").output().expect("started");
    assert!(String::from_utf8_lossy(&output.stderr).contains("404"), "without --foxglove nothing is served");
    graph.stop().assert_undisturbed("clients of Foxglove");
}

/// The run is over, and nothing is wrong: the page says so, and its last minutes can be looked at.
#[test]
fn the_page_of_a_run_that_has_ended_keeps_its_last_minutes() {
    let flow = project().join("dataflow.yaml");
    let graph = Graph::launch(&unique_name(), &flow, &["--set", "recorded_source.repeat=forever", "--view"]);
    wait_until(|| graph.said().contains("in a browser on this machine: http://"), || graph.said());
    let said = graph.said();
    let address = said.split("this machine: ").nth(1).and_then(|rest| rest.lines().next()).expect("an address");
    let Some(mut browser) = Browser::open(address.trim()) else { return };
    browser.wait_until("window.blindgrasp?.past.decisions.length > 3");
    graph.stop();
    browser.wait_until("document.getElementById('state').textContent.startsWith('the run has ended')");
    browser.wait_until("document.body.className === ''");
    // Also after it has tried to reach the server again, and has failed.
    browser.wait_until("performance.getEntriesByName(`${location.origin}/events`).length > 1");
    assert_eq!(browser.ask("document.getElementById('state').className"), "");
    assert!(browser.text("state").starts_with("the run has ended"), "{}", browser.text("state"));
    browser.click("#decisions tr:nth-child(2) button");
    let chosen = browser.ask("document.querySelector('#decisions .chosen button').textContent");
    assert!(browser.text("why").starts_with(&format!("Grasp {}:", chosen.as_str().expect("a number"))));
    assert_eq!(browser.ask("document.body.className"), "");
}

#[test]
fn run_starts_the_page_and_ends_it() {
    let name = unique_name();
    let graph =
        Graph::launch(&name, &project().join("dataflow.yaml"), &["--set", "recorded_source.repeat=forever", "--view"]);
    wait_until(|| graph.said().contains("in a browser on this machine: http://"), || graph.said());
    let said = graph.said();
    let address = said.split("this machine: http://").nth(1).and_then(|rest| rest.lines().next()).expect("an address");
    let events = || -> std::io::Result<String> {
        let mut client = std::net::TcpStream::connect(address.trim())?;
        std::io::Write::write_all(&mut client, format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes())?;
        let mut lines = BufReader::new(client).lines();
        lines.find(|line| line.as_ref().map_or(true, |line| line.starts_with("event: frame"))).expect("a line")
    };
    assert!(events().is_ok());
    graph.stop();
    wait_until(|| events().is_err(), || format!("{address} still answers"));
}

#[test]
fn a_page_needs_a_graph_that_runs() {
    let output = blindgrasp().args(["view", "no_such_graph"]).output().expect("started");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("no_such_graph"), "{said}");
    let output =
        blindgrasp().args(["view", "dataflow.yaml", "--port", "1"]).current_dir(project()).output().expect("started");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(2)
            && said.contains("--port and --shadow are for the page of a running graph or a recording"),
        "{said}"
    );
}
