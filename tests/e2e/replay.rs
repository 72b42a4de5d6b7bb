//! Recordings are replayed: the same bytes at any rate and on any number of cores, parts of them, and compared with
//! the recorded edges.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use crate::common::{
    MODEL, assert_nothing_left, dataflow, fails, json_lines, program, project, run, shared_folder, text, unique_name,
};
use blindgrasp_messages::{Header, Prediction, Recorded, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingInfo, RecordingReader, RecordingWriter};
use blindgrasp_stages::model::Model;
use serde_json::Value;

const STAGES: [&str; 4] = ["/contacts", "/feature", "/prediction", "/decision"];

/// Samples with their topics.
type Records = Vec<(String, Record)>;

/// A folder of all tests here: `frames.mcap` with a dozen grasps, and `edges.mcap`, a run of it.
fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let folder = shared_folder("replay");
        let frames = utf8(&folder.join("frames.mcap"));
        let objects = ["--objects", "held-out", "--grasps", "12", "--seed", "5", "--out", &frames];
        run(&[&["simulate"], &objects[..]].concat(), 0);
        let flow = utf8(&flow(&folder));
        let edges = utf8(&folder.join("edges.mcap"));
        let (name, rate) = (unique_name(), ["--rate", "max", "--record", &edges]);
        run(&[&["replay", &frames, "--dataflow", &flow, "--name", &name], &rate[..]].concat(), 0);
        assert_nothing_left(&name);
        folder
    })
}

/// The project's graph, for the recordings here.
fn flow(folder: &Path) -> PathBuf {
    let frames = folder.join("frames.mcap");
    dataflow(folder, &[("recordings/held-out.mcap", &utf8(&frames))])
}

fn utf8(path: &Path) -> String {
    path.to_str().expect("UTF-8").into()
}

/// A folder of a test's own, with a copy of `edges.mcap` and the dataflow file.
struct Own {
    folder: tempfile::TempDir,
    recording: String,
    flow: String,
}

fn own() -> Own {
    let edges = folder().join("edges.mcap");
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("edges.mcap");
    std::fs::copy(edges, &recording).expect("copied");
    std::fs::copy(self::folder().join("frames.mcap"), folder.path().join("frames.mcap")).expect("copied");
    let flow = utf8(&flow(folder.path()));
    Own { recording: utf8(&recording), flow, folder }
}

impl Own {
    fn path(&self, name: &str) -> String {
        utf8(&self.folder.path().join(name))
    }

    fn test(&self, arguments: &[&str], exit_code: i32) -> Output {
        run(&[&["test", &self.recording, "--dataflow", &self.flow], arguments].concat(), exit_code)
    }

    fn replay(&self, arguments: &[&str]) -> Output {
        let name = unique_name();
        let fixed = ["replay", &self.recording, "--dataflow", &self.flow, "--name", &name, "--json"];
        let output = run(&[&fixed, arguments].concat(), 0);
        assert_nothing_left(&name);
        output
    }

    /// Writes the recording anew, as `edit` says.
    fn edit(&self, edit: impl FnOnce(&mut Records)) {
        let reader = RecordingReader::open(Path::new(&self.recording)).expect("opened");
        let info = reader.info().clone();
        let mut records: Vec<_> = reader.collect::<Result<_, _>>().expect("read");
        edit(&mut records);
        let mut writer = RecordingWriter::create(Path::new(&self.recording), &info).expect("created");
        records.iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
        writer.finish().expect("finished");
    }

    fn expect(&self, expectations: &str) {
        let text = format!("version: 1\n{expectations}");
        std::fs::write(self.path("edges.expect.yaml"), text).expect("written");
    }
}

/// The samples of a recording by topic, as text that shows every bit.
fn topics(path: &str) -> BTreeMap<String, Vec<String>> {
    let mut topics: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for record in RecordingReader::open(Path::new(path)).expect("opened") {
        let (topic, record) = record.expect("read");
        topics.entry(topic).or_default().push(format!("{record:?}"));
    }
    topics
}

/// Decisions by grasp, without the fields that differ from run to run.
fn decisions(output: &Output) -> BTreeMap<u64, Value> {
    let lines = json_lines(&output.stdout).into_iter().filter(|line| line.get("action").is_some());
    let decided = lines.map(|mut line| {
        let fields = line.as_object_mut().expect("an object");
        ["latency_nanos", "valid_until_nanos", "seq", "truth"].iter().for_each(|field| drop(fields.remove(*field)));
        (line["grasp_id"].as_u64().expect("an id"), line)
    });
    decided.collect()
}

fn report(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {}", text(&output.stdout)))
}

/// The check of that name.
fn check<'a>(report: &'a Value, name: &str) -> &'a Value {
    let checks = report["recordings"][0]["checks"].as_array().expect("checks");
    checks.iter().find(|check| check["name"] == name).unwrap_or_else(|| panic!("no check {name} in {report}"))
}

#[test]
fn the_same_bytes_come_out_at_any_rate_on_any_number_of_cores() {
    let own = own();
    let expected = topics(&own.recording);
    assert_eq!(expected["/prediction"].len(), expected["/tactile"].len());
    assert_eq!(expected["/decision"].len(), 12);
    let found = own.path("found.mcap");
    for rate in ["max", "50x"] {
        own.replay(&["--rate", rate, "--record", &found, "--overwrite"]);
        assert_eq!(topics(&found), expected, "at rate {rate}");
    }
    for cores in ["0", "0,1"] {
        let name = unique_name();
        let program = program();
        let mut command = Command::new("taskset");
        command.args(["-c", cores, program, "replay", &own.recording, "--dataflow", &own.flow, "--name", &name]);
        command.args(["--rate", "max", "--record", &found, "--overwrite"]).env("XDG_STATE_HOME", own.folder.path());
        let output = command.output().expect("taskset is there");
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert_eq!(topics(&found), expected, "on cores {cores}");
    }
}

/// More repeated frames than the queues have places.
#[test]
fn repeated_frames_are_lost_at_no_rate() {
    let own = own();
    own.edit(|records| {
        records.retain(|(topic, _)| ["/tactile", "/truth"].contains(&topic.as_str()));
        let times = |topic: &str| if topic == "/tactile" { 4 } else { 1 };
        *records = records.iter().flat_map(|record| vec![record.clone(); times(&record.0)]).collect();
    });
    let sent = topics(&own.recording)["/tactile"].clone();
    assert!(sent.len() > 2 * 256, "{}", sent.len());
    let found = own.path("found.mcap");
    let replayed = ["max", "50x"].map(|rate| {
        let output = own.replay(&["--rate", rate, "--record", &found, "--overwrite"]);
        let summary = json_lines(&output.stdout).pop().expect("a summary")["summary"].clone();
        assert_eq!((&summary["samples_lost"], &summary["undecided"]), (&0.into(), &0.into()), "{rate}: {summary}");
        topics(&found)
    });
    assert_eq!(replayed[0], replayed[1]);
    assert_eq!(replayed[0]["/tactile"], sent);
}

#[test]
fn a_part_of_a_recording_is_decided_as_in_the_whole() {
    let own = own();
    let whole = decisions(&own.replay(&["--rate", "max"]));
    assert_eq!(whole.len(), 12);
    let some = decisions(&own.replay(&["--rate", "max", "--grasps", "3,7-9"]));
    assert_eq!(some.keys().copied().collect::<Vec<_>>(), [3, 7, 8, 9]);
    let from = decisions(&own.replay(&["--rate", "max", "--from", "0.5", "--to", "1500ms"]));
    assert!(!from.is_empty() && from.len() < 12, "{from:?}");
    for (grasp_id, decision) in some.iter().chain(&from) {
        assert_eq!(decision, &whole[grasp_id]);
    }
    // Its numbers begin at 0, and none is missing.
    let found = own.path("found.mcap");
    own.replay(&["--rate", "max", "--grasps", "3,7-9", "--record", &found]);
    for topic in ["/tactile", "/truth", "/prediction", "/decision"] {
        let records = RecordingReader::open(Path::new(&found)).expect("opened").map(|record| record.expect("read"));
        let seqs: Vec<u64> = records.filter(|(of, _)| of == topic).map(|(_, record)| record.header().seq).collect();
        assert_eq!(seqs, (0..seqs.len() as u64).collect::<Vec<_>>(), "{topic}");
        assert!(seqs.len() >= 4, "{topic}");
    }
}

#[test]
fn recorded_contacts_are_judged_as_the_frames_they_came_from() {
    let own = own();
    let expected = topics(&own.recording);
    let found = own.path("found.mcap");
    let output = own.replay(&["--rate", "max", "--replace", "contacts", "--record", &found]);
    let found = topics(&found);
    for topic in STAGES {
        assert_eq!(found[topic], expected[topic], "{topic}");
    }
    assert!(!found.contains_key("/tactile"));
    let lines = json_lines(&output.stdout);
    let nodes = lines.last().expect("a summary")["summary"]["operators"].as_array().expect("operators").len();
    assert_eq!(nodes, 4);
}

#[test]
fn selections_that_do_not_fit_are_refused_before_the_start() {
    let own = own();
    let refused = |arguments: &[&str], expected: &str| {
        let fixed = ["replay", &own.recording, "--dataflow", &own.flow, "--rate", "max"];
        let output = run(&[&fixed, arguments].concat(), 1);
        assert!(text(&output.stderr).contains(expected), "{arguments:?}: {}", text(&output.stderr));
    };
    refused(&["--grasps", "99"], "nothing is selected: no grasp is one of 99; it has the grasps 0 to 11");
    refused(&["--from", "2", "--to", "1"], "expected an earlier --from");
    refused(&["--replace", "lift_arbiter"], "nothing lies behind node 'lift_arbiter'");
    refused(&["--set", "recorded_source.rate=1"], "node 'recorded_source' does not run");
    let frames = own.path("frames.mcap");
    let output = run(&["replay", &frames, "--dataflow", &own.flow, "--replace", "contacts"], 1);
    assert!(text(&output.stderr).contains("it holds no /contacts to replay; it has /scene, /tactile, /truth"));

    let other_hand = own.path("other.mcap");
    let info = RecordingInfo { hand: "left".into(), hand_id: 7, made_by: "a test".into(), version: "0".into() };
    RecordingWriter::create(Path::new(&other_hand), &info).expect("created").finish().expect("finished");
    fails(&["replay", &other_hand, "--dataflow", &own.flow], "is of the hand left (0000000000000007)");
}

#[test]
fn a_large_recording_begins_at_once() {
    let own = own();
    let big = own.path("big.mcap");
    let info = RecordingReader::open(Path::new(&own.recording)).expect("opened").info().clone();
    let mut writer = RecordingWriter::create(Path::new(&big), &info).expect("created");
    // Numbers that no compression makes fewer: 70 MiB and more.
    let mut bits = 1_u64;
    let mut number = || {
        bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (bits >> 11) as f64 / (1_u64 << 53) as f64
    };
    for seq in 0..9_000 {
        let header = Header { seq, stamp_nanos: seq * 20_000_000, hand_id: info.hand_id, ..Header::default() };
        let cells_newtons = (0..1_024).map(|_| number()).collect();
        let message = TactileFrame { grasp_id: seq / 100, cells_newtons, ..TactileFrame::default() };
        writer.write("/tactile", &Stamped { header, message }).expect("written");
    }
    writer.finish().expect("finished");
    // It is damaged far behind the beginning.
    let mut bytes = std::fs::read(&big).expect("read");
    assert!(bytes.len() > 64 << 20, "{} bytes", bytes.len());
    let at = bytes.len() / 10 * 9;
    bytes[at] ^= 1;
    std::fs::write(&big, bytes).expect("written");
    let found = own.path("found.mcap");
    let (name, part) = (unique_name(), ["--to", "4", "--rate", "max", "--record", &found]);
    run(&[&["replay", &big, "--dataflow", &own.flow, "--name", &name], &part[..]].concat(), 0);
    assert_eq!(topics(&found)["/contacts"].len(), 200);
    let output = run(&["test", &big, "--dataflow", &own.flow, "--json"], 1);
    let report = report(&output);
    assert!(check_text(&report, "error").contains("cut off or damaged after"), "{report}");
}

#[test]
fn a_recording_passes_until_the_model_is_changed() {
    let own = own();
    own.expect("reasons: {out_of_order: 0}\n");
    let passed = report(&own.test(&["--json"], 0));
    assert_eq!((&passed["n_passed"], &passed["n_failed"]), (&1.into(), &0.into()));
    for topic in ["/tactile", "/truth"].iter().chain(&STAGES) {
        let check = check(&passed, topic);
        assert_eq!((&check["has_passed"], &check["edge"]["n_differing"]), (&true.into(), &0.into()), "{check}");
        assert!(check["edge"]["n_recorded"].as_u64() > Some(0), "{check}");
    }

    // A model that differs in one constant.
    let mut model = Model::load(&project().join(MODEL)).expect("a model");
    model.classifier.calibration.b += 1e-9;
    let changed = own.path("changed.json");
    model.save(Path::new(&changed)).expect("saved");
    let flow = std::fs::read_to_string(&own.flow).expect("read");
    let old_model = utf8(&project().join(MODEL));
    std::fs::write(&own.flow, flow.replace(&old_model, &changed)).expect("written");
    let failed = report(&own.test(&["--json"], 1));
    assert_eq!(check(&failed, "/feature")["has_passed"], true);
    let first = &check(&failed, "/prediction")["edge"]["first"];
    assert_eq!((&first["what"], &first["path"]), (&"field".into(), &"probability_stable".into()), "{first}");
    let number = |field: &str| first[field].as_str().expect("a text").parse::<f64>().expect("a number");
    assert_eq!(number("found") - number("expected"), number("difference"));
    assert!(number("difference") != 0.0 && number("difference").abs() < 1e-8, "{first}");
    let table = text(&own.test(&[], 1).stdout);
    assert!(table.contains("FAIL  /prediction") && table.contains("1 recording: 0 passed, 1 failed"), "{table}");

    // Within a tolerance it passes, and after an update.
    own.expect("tolerances:\n  /prediction: {absolute: 1e-6}\n  /decision: {absolute: 1e-6}\n");
    own.test(&[], 0);
    own.expect("");
    own.test(&[], 1);
    let before = topics(&own.recording);
    own.test(&["--update"], 0);
    let after = topics(&own.recording);
    assert_eq!(
        (&after["/tactile"], &after["/truth"], &after["/contacts"]),
        (&before["/tactile"], &before["/truth"], &before["/contacts"])
    );
    assert_ne!(after["/prediction"], before["/prediction"]);
    own.test(&[], 0);
}

#[test]
fn missing_extra_reordered_and_differing_samples_are_found() {
    let prediction = |record: &Record| matches!(record, Record::Prediction(_));
    let nth = |records: &[(String, Record)], n: usize| {
        let mut at = records.iter().enumerate().filter(|(_, (_, record))| prediction(record)).map(|(idx, _)| idx);
        at.nth(n).expect("a prediction")
    };
    let own = own();
    let original = std::fs::read(&own.recording).expect("read");
    let first = |edit: &dyn Fn(&mut Records)| {
        std::fs::write(&own.recording, &original).expect("restored");
        own.edit(edit);
        let report = report(&own.test(&["--json"], 1));
        let edge = check(&report, Prediction::TOPIC)["edge"].clone();
        assert_eq!(check(&report, "/feature")["edge"]["n_differing"], 0);
        (edge["n_differing"].as_u64(), edge["first"]["what"].clone(), edge["first"]["seq"].as_u64())
    };
    let found = first(&|records| drop(records.remove(nth(records, 20))));
    assert_eq!(found, (Some(1), "extra".into(), Some(20)), "what is not recorded comes in addition");
    let found = first(&|records| {
        let (topic, mut record) = records[nth(records, 20)].clone();
        let Record::Prediction(sample) = &mut record else { panic!("no prediction") };
        sample.header.seq = 1_000_000;
        records.push((topic, record));
    });
    assert_eq!(found, (Some(1), "missing".into(), Some(1_000_000)));
    let found = first(&|records| {
        let (one, other) = (nth(records, 20), nth(records, 22));
        records.swap(one, other);
    });
    assert_eq!((found.1, found.2), ("reordered".into(), Some(22)));
    let found = first(&|records| {
        let at = nth(records, 20);
        let Record::Prediction(sample) = &mut records[at].1 else { panic!("no prediction") };
        sample.message.decision_value = f64::NAN;
    });
    assert_eq!(found, (Some(1), "field".into(), Some(20)));
    // The recording lacks an edge of the graph.
    std::fs::write(&own.recording, &original).expect("restored");
    own.edit(|records| records.retain(|(topic, _)| topic != "/feature"));
    let report = report(&own.test(&["--json"], 1));
    assert_eq!(check(&report, "/feature")["has_passed"], false);
}

#[test]
fn faults_of_a_recording_are_faults_of_its_replay() {
    let own = own();
    own.edit(|records| {
        records.retain(|(topic, _)| ["/tactile", "/truth"].contains(&topic.as_str()));
        let at = |records: &Records, seq: u64| {
            let is_it = |(topic, record): &(String, Record)| topic == "/tactile" && record.header().seq == seq;
            records.iter().position(is_it).expect("a frame")
        };
        // One frame is lost, one comes twice, two change places: each fault is in another grasp.
        records.remove(at(records, 20));
        let twice = records[at(records, 30)].clone();
        records.insert(at(records, 30), twice);
        let (one, other) = (at(records, 60), at(records, 61));
        records.swap(one, other);
    });
    own.expect("reasons: {out_of_order: 3}\n");
    let report = report(&own.test(&["--update", "--json"], 0));
    assert_eq!(check_text(&report, "replay"), "12 grasps decided, nothing lost");
    let recorded = topics(&own.recording);
    let passed = self::report(&own.test(&["--json"], 0));
    for topic in STAGES {
        let edge = &check(&passed, topic)["edge"];
        assert_eq!((&edge["n_recorded"], &edge["n_differing"]), (&recorded[topic].len().into(), &0.into()), "{edge}");
    }
    assert_eq!(recorded["/prediction"].len(), recorded["/tactile"].len());
    // A part of the recording is decided alike.
    let whole = decisions(&own.replay(&["--rate", "max"]));
    let some = decisions(&own.replay(&["--rate", "max", "--grasps", "1-5"]));
    assert_eq!(some.len(), 5);
    some.iter().for_each(|(grasp_id, decision)| assert_eq!(decision, &whole[grasp_id]));
}

#[test]
fn a_recording_attached_midway_is_compared_from_where_it_begins() {
    let own = own();
    own.edit(|records| {
        // It begins within the second grasp.
        records.retain(|(topic, record)| match topic.as_str() {
            "/truth" | "/decision" => record.header().seq >= 1,
            _ => record.header().seq >= 20,
        });
    });
    let report = report(&own.test(&["--json"], 0));
    let notes = report["recordings"][0]["notes"].to_string();
    assert!(notes.contains("attached midway"), "{notes}");
    // The median filter has seen frames that were not recorded.
    assert_eq!(check(&report, "/contacts")["edge"]["n_not_compared"], 2);
    assert_eq!(check(&report, "/decision")["edge"]["n_recorded"], 10);
    // All edges with the source's numbers begin with the same sample: a sample that one of them lacks is missing.
    own.edit(|records| records.retain(|(topic, record)| topic != "/contacts" || record.header().seq >= 24));
    let report = self::report(&own.test(&["--json"], 1));
    let contacts = check(&report, "/contacts");
    assert_eq!((&contacts["has_passed"], &contacts["edge"]["n_differing"]), (&false.into(), &2.into()));
}

#[test]
fn expectations_are_compared_with_the_decisions() {
    let own = own();
    let frames = own.path("frames.mcap");
    let test = |exit_code: i32| run(&["test", &frames, "--dataflow", &own.flow, "--json"], exit_code);
    let failed = report(&test(1));
    assert!(check_text(&failed, "error").contains("nothing to compare"), "{failed}");

    let decided = decisions(&own.replay(&["--rate", "max"]));
    let word = |grasp_id: u64, field: &str| decided[&grasp_id][field].as_str().expect("a word").to_string();
    let right = format!("{} {}", word(3, "action"), word(3, "reason"));
    let wrong = if word(4, "action") == "lift" { "hold" } else { "lift" };
    let write =
        |text: &str| std::fs::write(own.path("frames.expect.yaml"), format!("version: 1\n{text}")).expect("written");
    write(&format!("accuracy_at_least: 0\nfalse_positives_at_most: 12\ndecisions: {{3: {right}}}\n"));
    let passed = report(&test(0));
    assert_eq!(check_text(&passed, "decisions"), "1 grasp as expected");
    write(&format!("decisions: {{4: {wrong}, 99: hold}}\nreasons: {{stale: 1}}\n"));
    let failed = report(&test(1));
    let said = check_text(&failed, "decisions");
    assert!(said.contains(&format!("grasp 4: expected {wrong}, found {}", word(4, "action"))), "{said}");
    assert!(said.contains("grasp 99: expected hold, found no decision"), "{said}");
    assert_eq!(check_text(&failed, "reasons"), "stale 0, expected 1");
}

fn check_text(report: &Value, name: &str) -> String {
    check(report, name)["text"].as_str().expect("a text").to_string()
}

#[test]
fn a_report_for_continuous_integration_names_every_check() {
    let own = own();
    own.expect("accuracy_at_least: 1.0\nfalse_positives_at_most: 0\ndecisions: {99: lift}\n");
    let junit = own.path("report.xml");
    own.test(&["--junit", &junit], 1);
    let xml = std::fs::read_to_string(&junit).expect("a report");
    let mut reader = quick_xml::Reader::from_str(&xml);
    let (mut cases, mut n_failures) = (Vec::new(), 0);
    loop {
        use quick_xml::events::Event;
        match reader.read_event().expect("well-formed") {
            Event::Start(element) if element.name().as_ref() == "testcase" => {
                let name = element.try_get_attribute("name").expect("attributes").expect("a name");
                cases.push(name.value.into_owned());
            }
            Event::Start(element) if element.name().as_ref() == "failure" => n_failures += 1,
            Event::Eof => break,
            _ => {}
        }
    }
    for name in ["replay", "/prediction", "/decision", "accuracy_at_least", "false_positives_at_most", "decisions"] {
        assert!(cases.iter().any(|case| case == name), "{name} in {cases:?}");
    }
    assert!(n_failures >= 1 && xml.contains("grasp 99: expected lift, found no decision"), "{xml}");
    assert!(xml.contains(&format!("failures=\"{n_failures}\"")), "{xml}");
}

#[test]
fn a_replay_with_another_model_compared_with_the_graphs_own() {
    let own = own();
    let mut model = Model::load(&project().join(MODEL)).expect("a model");
    (model.classifier.threshold_probability, model.classifier.unsure_from_probability) = (1.0, 1.0);
    let timid = own.path("timid.json");
    model.save(Path::new(&timid)).expect("saved");
    let other = own.path("other.mcap");
    own.replay(&[
        "--rate",
        "max",
        "--set",
        &format!("classifier.model={timid}"),
        "--set",
        "lift_arbiter.votes=4",
        "--record",
        &other,
    ]);
    let found = report(&run(&["test", &other, "--dataflow", &own.flow, "--json"], 1));
    let lifted = decisions(&own.replay(&["--rate", "max"])).into_values().filter(|line| line["action"] == "lift");
    let lifted: Vec<_> = lifted.map(|line| line["grasp_id"].clone()).collect();
    assert!(!lifted.is_empty(), "the graph's own model lifts nothing");
    let differing = check(&found, "/decision")["edge"]["grasps"].as_array().expect("grasps");
    assert!(lifted.iter().all(|grasp_id| differing.contains(grasp_id)), "{lifted:?} in {differing:?}");
    let notes = found["recordings"][0]["notes"].to_string();
    for setting in ["classifier.model was another model", "lift_arbiter.votes was 4 and is 3"] {
        assert!(notes.contains(setting), "{notes}");
    }
    assert_eq!(check(&found, "/feature")["has_passed"], true);
}

#[test]
fn the_ready_made_workflows_are_yaml_that_installs_tests_and_uploads() {
    for file in ["github.yml", "gitlab.yml"] {
        let text = std::fs::read_to_string(project().join("docs/ci").join(file)).expect("a workflow");
        let workflow: Value = serde_saphyr::from_str(&text).unwrap_or_else(|error| panic!("{file}: {error}"));
        let job = if file == "github.yml" { &workflow["jobs"]["recordings"] } else { &workflow["recordings"] };
        let job = job.to_string();
        for part in ["cargo install --git", "blindgrasp test --junit report.xml", "--summary", "always"] {
            assert!(job.contains(part), "{file}: no {part} in {job}");
        }
    }
}
