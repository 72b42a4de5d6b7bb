//! Other users of the machine, and files and programs of strangers: they reach no graph, no terminal and no other file.

use std::io::Write;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use blindgrasp_recording::{Record, RecordingInfo, RecordingReader, RecordingWriter};
use rustix::process::{Signal, getuid};

use crate::common::python::utf8;
use crate::common::{
    A_FEW_GRASPS, FAST_FOREVER, Graph, HAND, MODEL, NODES, RECORDING, REPORTS, blindgrasp, classifier_runs, dataflow,
    dataflow_with, operator, program, project, run, script, skipped, swap, text, unique_name, wait_until,
};

/// It names the terminal's window, rings, clears the screen, and turns text around.
const EVIL: &str = "\u{1b}]0;own\u{7}\u{1b}[2J\u{9b}1m\u{202e}";

/// The files of a graph: its folder with all that is in it.
fn files_of(name: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![PathBuf::from("/dev/shm")];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).expect("readable").flatten().map(|entry| entry.path()) {
            let is_of_graph = utf8(&path).contains("blindgrasp") && utf8(&path).contains(name);
            if is_of_graph && path.is_dir() {
                folders.push(path.clone());
            }
            if is_of_graph {
                found.push(path);
            }
        }
    }
    found
}

#[test]
fn another_user_cannot_touch_a_running_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::fast();
    let files = files_of(&graph.name[..graph.name.len().min(11)]);
    assert!(files.len() > 20, "{files:?}");
    for path in &files {
        // Some go while the graph runs.
        if let Ok(metadata) = std::fs::symlink_metadata(path) {
            // iceoryx2 lets the group read folders, which lie in the graph's folder, which no other user can enter.
            let of_others = if metadata.is_dir() { 0o027 } else { 0o077 };
            assert_eq!(metadata.mode() & of_others, 0, "{}: {:o}", path.display(), metadata.mode());
        }
    }
    if getuid().is_root() {
        let empty_all = "for file; do (: > \"$file\") 2>/dev/null && echo \"$file\"; done; true";
        let output = Command::new("setpriv")
            .args(["--reuid=65534", "--regid=65534", "--clear-groups", "sh", "-c", empty_all, "sh"])
            .args(files.iter().filter(|path| path.is_file()))
            .output()
            .expect("started");
        assert_eq!(text(&output.stdout), "", "{}", text(&output.stderr));
    } else {
        skipped("acting as another user (needs root)");
    }
    // Processes still join it.
    graph.kill("classifier");
    let recording = folder.path().join("some.mcap");
    run(&["record", &graph.name, "--for", "0.2", "--out", utf8(&recording)], 0);
    let table = folder.path().join("lines.jsonl");
    run(&["export", utf8(&recording), "--out", utf8(&table)], 0);
    for file in [&recording, &table] {
        assert_eq!(std::fs::metadata(file).expect("there").mode() & 0o777, 0o600, "{}", file.display());
    }
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("beside another user");
}

/// What another user tries while a graph starts, and an operator of it is started again and swapped. It tries to see names of
/// its files, and to put a pipe, a link and a large sparse file where the graph could open them.
const PLANTER: &str = "
while [ -e \"$1\" ]; do
    for graph in /dev/shm/blindgrasp_$2.*; do
        [ -d \"$graph\" ] || continue
        ls \"$graph\"/* 2> /dev/null && echo 'it sees names'
        for place in \"$graph/ports/x\" \"$graph/x\"; do
            mkfifo \"$place.pipe\" 2> /dev/null && echo 'it made a pipe'
            ln -s /etc/passwd \"$place.link\" 2> /dev/null && echo 'it made a link'
            truncate -s 1T \"$place.data\" 2> /dev/null && echo 'it made a file'
        done
        mv \"$graph\" \"$graph.mine\" 2> /dev/null && echo 'it moved the folder'
    done
    mkfifo \"/dev/shm/blindgrasp_$2.pipe\" 2> /dev/null
    truncate -s 1T \"/dev/shm/blindgrasp_$2.data\" 2> /dev/null
done
rm -f /dev/shm/blindgrasp_$2.pipe /dev/shm/blindgrasp_$2.data
echo tried";

#[test]
fn another_user_cannot_plant_files_where_a_graph_opens_its_own() {
    if !getuid().is_root() {
        return skipped("acting as another user (needs root)");
    }
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o755)).expect("readable");
    let goes_on = folder.path().join("goes-on");
    std::fs::write(&goes_on, "").expect("written");
    let name = unique_name();
    let begin = &name[..name.len().min(11)];
    let mut planter = Command::new("setpriv");
    planter.args(["--reuid=65534", "--regid=65534", "--clear-groups", "sh", "-c", PLANTER, "sh"]);
    let planter = planter.arg(&goes_on).arg(begin).stdout(Stdio::piped()).spawn().expect("started");
    let pipe = PathBuf::from(format!("/dev/shm/blindgrasp_{begin}.pipe"));
    wait_until(|| pipe.exists(), || "the other user makes a pipe".into());

    let graph = Graph::launch(&name, &dataflow(folder.path(), &[]), &FAST_FOREVER);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.kill("classifier");
    let model = format!("model={MODEL}");
    swap(&graph, &["classifier", "--run", "classifier", "--set", &model, "--probation", "0.1"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // Each process has mapped files of this user's folder alone.
    let pids = NODES.map(|node| graph.pid_of(node));
    for pid in pids.into_iter().chain([graph.pid()]) {
        let maps = std::fs::read_to_string(format!("/proc/{pid}/maps")).expect("there");
        let shared: Vec<&str> = maps.lines().filter_map(|line| Some(line.split_once("/dev/shm/")?.1)).collect();
        assert!(!shared.is_empty(), "{maps}");
        let is_own = |path: &&&str| path.starts_with(&format!("blindgrasp_{begin}.")) && path.contains('/');
        let foreign: Vec<&&str> = shared.iter().filter(|path| !is_own(path)).collect();
        assert!(foreign.is_empty(), "{foreign:?}");
    }
    std::fs::remove_file(&goes_on).expect("removed");
    let tried = planter.wait_with_output().expect("ended");
    assert_eq!(text(&tried.stdout), "tried\n");
    graph.stop().assert_undisturbed("beside another user's files");
}

/// The project's recording by a stranger: its objects, its maker and the name of its hand are what they like.
fn recording_of_stranger(path: &Path, hand: &str) {
    let reader = RecordingReader::open(&project().join(RECORDING)).expect("a recording");
    let info = RecordingInfo { hand: hand.into(), made_by: format!("me{EVIL}"), ..reader.info().clone() };
    let mut writer = RecordingWriter::create(path, &info).expect("made");
    for record in reader {
        let (topic, record) = record.expect("read");
        match record {
            Record::Truth(mut truth) => {
                truth.message.object = format!("mug{EVIL}\ngrasp 1 LIFT");
                truth.message.object_class = format!("cup{EVIL}\ngrasp 1 LIFT");
                writer.write_record(&topic, &Record::Truth(truth)).expect("written");
            }
            record @ Record::Tactile(_) => writer.write_record(&topic, &record).expect("written"),
            _ => {}
        }
    }
    let metadata = std::collections::BTreeMap::from([("key".to_owned(), "value".to_owned())]);
    writer.write_metadata(&format!("note{EVIL}\ngrasp 1 LIFT"), metadata).expect("written");
    writer.finish().expect("finished");
}

fn assert_harmless(said: &[u8], what: &str) {
    let said = text(said);
    let evil = said.chars().find(|char| (char.is_control() && *char != '\n' && *char != '\t') || *char == '\u{202e}');
    assert_eq!(evil, None, "{what}: {said:?}");
}

#[test]
fn nothing_of_a_stranger_commands_the_terminal() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("evil.mcap");
    recording_of_stranger(&recording, "barrett-bh8-280");
    for arguments in [
        &["info", utf8(&recording)][..],
        &["info", "--json", utf8(&recording)],
        &["predict", MODEL, utf8(&recording)],
        &["evaluate", MODEL, utf8(&recording)],
    ] {
        let output = run(arguments, 0);
        let said = text(&output.stdout);
        assert!(said.contains("grasp 1 LIFT") && !said.lines().any(|line| line.starts_with("grasp 1 LIFT")), "{said}");
        assert_harmless(&[output.stdout, output.stderr].concat(), arguments[0]);
    }
    // An operator that prints what it was sent, as lines and as log entries.
    let body = format!(
        "case \"$*\" in *--describe*) ;; *) printf 'chat\\033]0;own\\007 \\302\\2331m\\n' >&2; printf \
         '{{\"report\":\"log\",\"level\":\"warn\",\"message\":\"a\\\\u001b[2J\\\\n[lift_arbiter] b\"}}\\n' \
         >{REPORTS};; esac\nexec {} \"$@\"",
        operator("classifier")
    );
    let chatty = script(folder.path(), "chatty", &body);
    let runs = classifier_runs(&chatty, &format!("{{model: {MODEL}}}"));
    let flow = dataflow_with(folder.path(), &[runs]);
    let of_stranger = format!("recorded_source.recording={}", utf8(&recording));
    for json in [&[][..], &["--json"]] {
        let mut command = blindgrasp();
        command.args(["run", "--name", &unique_name(), "--set", &of_stranger, "--set", "recorded_source.rate=max"]);
        let output = command.args(json).arg(&flow).output().expect("started");
        let (stdout, stderr) = (text(&output.stdout), text(&output.stderr));
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        assert_harmless(stdout.as_bytes(), "the lines of decisions");
        assert_harmless(stderr.as_bytes(), "the lines of operators");
        assert!(stdout.contains("mug\\u"), "{stdout}");
        assert!(!stdout.lines().any(|line| line.starts_with("grasp 1 LIFT")), "{stdout}");
        assert!(stderr.contains("[classifier] chat\\u"), "{stderr}");
        assert!(!stderr.lines().any(|line| line.starts_with("[lift_arbiter] b")), "{stderr}");
    }
}

/// A classifier that prints a line for each sample.
const CHATTERER: &str = r#"
import sys
sys.path.insert(0, "OPERATORS")
from blindgrasp_operator import Description, Stage, run
from blindgrasp_messages import GraspFeature, Prediction, PredictionHead

def answer(head, _items):
    print("""LINE""", flush=True)
    print("""LINE""", file=sys.stderr, flush=True)
    return PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault)

run(Description("chatterer", "", ("feature", GraspFeature), ("prediction", Prediction)), lambda params: Stage(answer))
"#;

/// Lines that programs print, panics and tracebacks may have text of strangers, such as the name of an object.
#[test]
fn a_printed_line_is_a_line_of_the_log_and_no_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("chatterer.py");
    let report = r#"{"report":"unfit","message":"by a message"}"#;
    let lines = format!("no object of the name @blindgrasp {report}\n@blindgrasp {report}\n{report}");
    let body = format!(
        "case \"$*\" in *--describe*) ;; *) echo '{lines}'; echo '{lines}' >&2;; esac\nexec {} \"$@\"",
        operator("classifier")
    );
    let in_rust = script(folder.path(), "chatty", &body);
    let program = CHATTERER.replace("OPERATORS", utf8(&project().join("operators"))).replace("LINE", &lines);
    std::fs::write(&path, program).expect("written");
    let in_python = script(folder.path(), "chatterer", &format!("exec python3 -B {} \"$@\"", path.display()));
    for (program, params) in [(in_rust, format!("{{model: {MODEL}}}")), (in_python, "{}".to_owned())] {
        let flow = dataflow_with(folder.path(), &[classifier_runs(&program, &params)]);
        let graph = Graph::start(&flow, &FAST_FOREVER);
        let log = || text(&run(&["logs", "classifier", "--graph", &graph.name], 0).stdout);
        wait_until(|| log().matches(report).count() >= 2 * 3, log);
        graph.wait_for_decisions(2);
        let ended = graph.stop();
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    }
}

#[test]
fn a_recording_names_a_hand_that_is_built_in_and_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("path.mcap");
    let hand = project().join(HAND);
    recording_of_stranger(&recording, utf8(&hand));
    let refused = run(&["info", utf8(&recording)], 1);
    let said = text(&refused.stderr);
    assert!(said.contains("name its pad layout with --hand"), "{said}");
    run(&["info", utf8(&recording), "--hand", HAND], 0);
}

#[test]
fn what_is_no_regular_file_is_refused_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let pipe = folder.path().join("pipe.json");
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, rustix::fs::Mode::from_raw_mode(0o600), 0)
        .expect("made");
    let (pipe, out) = (utf8(&pipe), folder.path().join("out.mcap"));
    let out = utf8(&out);
    for path in [pipe, "/dev/zero", "/dev/null"] {
        for arguments in [
            &["info", path][..],
            &["export", path],
            &["run", path],
            &["run", "--check", path],
            &["model", "show", path],
            &["info", RECORDING, "--hand", path],
            &["evaluate", path, RECORDING],
            &["predict", MODEL, path],
            &["import", "--lines", path, "--hand", HAND, "--out", out],
        ] {
            let output = blindgrasp().args(arguments).output().expect("started");
            let said = text(&output.stderr);
            assert!(matches!(output.status.code(), Some(1 | 2)), "{arguments:?}: {said}");
            assert!(said.contains("regular file") || said.contains("expected a model first"), "{arguments:?}: {said}");
        }
    }
}

#[test]
fn a_graph_is_stopped_right_after_its_start() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[]);
    let name = unique_name();
    let mut stop = blindgrasp();
    let stop = stop.args(["stop", &name]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
    let graph = Graph::launch(&name, &flow, &FAST_FOREVER);
    let output = stop.wait_with_output().expect("ended");
    if output.status.success() {
        assert_eq!(graph.finish().code, Some(0));
        return;
    }
    // On a busy machine the graph may come later than the command waits.
    assert!(text(&output.stderr).contains("no graph"), "{}", text(&output.stderr));
    wait_until(|| graph.said().contains("Error") || graph.n_decisions() > 0, || graph.said());
    graph.stop();
}

/// Shared memory of 64 MB that only the processes of this test see. Only root can make it.
#[test]
fn a_graph_goes_on_when_shared_memory_was_full() {
    let mount = "mount -t tmpfs -o size=64m none /dev/shm && exec \"$@\"";
    let within = |arguments: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", mount, "sh"]).args(arguments).current_dir(project());
        command.env("XDG_STATE_HOME", Path::new(env!("CARGO_TARGET_TMPDIR")).join("state"));
        command
    };
    if !within(&["true"]).stderr(Stdio::null()).status().is_ok_and(|status| status.success()) {
        return skipped("no file system can be mounted here (needs root)");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[]);
    let graph = Graph::launch_on(within(&[program()]), &unique_name(), &flow, &FAST_FOREVER);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // The folder as the graph sees it.
    let shm = Path::new("/proc").join(graph.pid().to_string()).join("root/dev/shm");
    let is_over = Arc::new(AtomicBool::new(false));
    let (fills_on, filler) = (Arc::clone(&is_over), shm.join("filler"));
    // It takes all that becomes free, until it is told to end or the graph has ended, as after a failure of this test.
    let filling = std::thread::spawn(move || {
        let mut file = std::fs::File::create(&filler).expect("a file");
        while !fills_on.load(Ordering::Relaxed) && filler.exists() {
            if file.write(&[0; 1 << 14]).is_err() {
                std::thread::sleep(Duration::from_micros(200));
            }
        }
        let _ = std::fs::remove_file(&filler);
    });
    let n_free_kib = || rustix::fs::statvfs(&shm).map_or(0, |stats| stats.f_bavail * stats.f_frsize / 1024);
    wait_until(|| n_free_kib() == 0, || format!("{} KiB are free", n_free_kib()));
    // What the graph needs is its own: it goes on while the rest is full.
    graph.wait_for_decisions(5 * A_FEW_GRASPS);
    assert_eq!(graph.node("contacts")["n_restarts"], 0, "{}", graph.said());
    // A process that is started again has no room, and waits for it. It may be faster than the filler, and is killed again.
    let waits_for_room = || {
        let contacts = graph.node("contacts");
        if contacts["state"] == "running"
            && let Some(pid) = contacts["pid"].as_i64().and_then(|pid| rustix::process::Pid::from_raw(pid as i32))
        {
            // It may have ended meanwhile.
            let _ = rustix::process::kill_process(pid, Signal::KILL);
        }
        graph.said().contains("when there is room in /dev/shm")
    };
    wait_until(waits_for_room, || graph.said());
    is_over.store(true, Ordering::Relaxed);
    filling.join().expect("ended");
    wait_until(|| graph.node("contacts")["state"] == "running", || graph.said());
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert!(!graph.said().contains("given up"), "{}", graph.said());
    graph.stop().assert_undisturbed("full shared memory");
}

#[test]
fn the_socket_of_a_dead_launcher_is_named_and_removed() {
    let folder = tempfile::tempdir().expect("a folder");
    let name = unique_name();
    let graph = Graph::launch(&name, &dataflow(folder.path(), &[]), &FAST_FOREVER);
    graph.wait_for_decisions(1);
    let socket = blindgrasp_operator::control_socket::folder().expect("a folder").join(format!("{name}.sock"));
    assert!(socket.exists());
    crate::common::signal(graph.pid(), Signal::KILL);
    drop(graph);
    // Other tests' graphs start meanwhile, and remove it as well.
    let doctor = || text(&run(&["doctor", "--quick", "--fix"], 0).stdout);
    wait_until(|| doctor().lines().count() > 0 && !socket.exists(), || format!("{} is left", socket.display()));
}
