//! `blindgrasp top`, as a person at a terminal and as a script runs it.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::OpenOptionsExt as _;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use crate::common::{Graph, NODES, blindgrasp, fails, json_lines, run, signal, text, unique_name, wait_until};
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};

const CLEARED: &str = "\x1b[H\x1b[J";
const HIDDEN: &str = "\x1b[?7l\x1b[?25l";
const SHOWN: &str = "\x1b[?7h\x1b[?25h";

/// `top` on a terminal of its own.
struct OnTerminal {
    child: Child,
    terminal: File,
    /// The side of `top`, kept open: without it the last output cannot be read.
    _line: OwnedFd,
    written: Arc<Mutex<Vec<u8>>>,
}

impl OnTerminal {
    fn start(mut command: Command, arguments: &[&str], rows: u16) -> OnTerminal {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a terminal");
        grantpt(&terminal).expect("granted");
        unlockpt(&terminal).expect("unlocked");
        let path = ptsname(&terminal, Vec::new()).expect("named").into_string().expect("UTF-8");
        // It is the terminal of `top`, and not that of the tests.
        let no_terminal = OpenptFlags::NOCTTY.bits() as i32;
        let line = File::options().read(true).write(true).custom_flags(no_terminal).open(path).expect("opened");
        tcsetwinsize(&line, size(rows)).expect("sized");
        let stdio = || Stdio::from(line.try_clone().expect("cloned"));
        command.arg("top").args(arguments).env("TERM", "xterm-256color");
        command.stdin(stdio()).stdout(stdio()).stderr(stdio());
        // SAFETY: both calls are safe between fork and exec.
        unsafe {
            command.pre_exec(|| {
                rustix::process::setsid()?;
                rustix::process::ioctl_tiocsctty(rustix::stdio::stdin())?;
                Ok(())
            });
        }
        let child = command.spawn().expect("started");
        let terminal = File::from(terminal);
        let written = Arc::new(Mutex::new(Vec::new()));
        let (mut reader, kept) = (terminal.try_clone().expect("cloned"), Arc::clone(&written));
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(n @ 1..) = reader.read(&mut bytes) {
                kept.lock().expect("not poisoned").extend(&bytes[..n]);
            }
        });
        OnTerminal { child, terminal, _line: line.into(), written }
    }

    /// What was written since the screen was cleared last.
    fn text(&self) -> String {
        let written = text(&self.written.lock().expect("not poisoned"));
        written.rsplit(CLEARED).next().unwrap_or_default().replace(HIDDEN, "")
    }

    fn wait_for(&self, wanted: &str) -> String {
        self.wait_until(|text| text.contains(wanted), wanted)
    }

    /// The text that is so.
    fn wait_until(&self, is_so: impl Fn(&str) -> bool, wanted: &str) -> String {
        let mut text = String::new();
        let found = || {
            text = self.text();
            is_so(&text)
        };
        wait_until(found, || format!("no '{wanted}' in\n{}", self.text()));
        text
    }

    fn is_cursor_shown(&self) -> bool {
        let written = text(&self.written.lock().expect("not poisoned"));
        written.rfind(SHOWN) > written.rfind(HIDDEN)
    }

    fn wait_until_cursor_is_shown(&self, is_shown: bool) {
        wait_until(|| self.is_cursor_shown() == is_shown, || format!("cursor shown: not {is_shown}\n{}", self.text()));
    }

    fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    fn press(&mut self, keys: &str) {
        self.terminal.write_all(keys.as_bytes()).expect("pressed");
    }

    /// Waits for its end without an error, after which the cursor must be shown.
    fn finish(mut self) {
        assert_eq!(self.child.wait().expect("waited").code(), Some(0), "{}", self.text());
        self.wait_until_cursor_is_shown(true);
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Of 80 columns.
fn size(rows: u16) -> Winsize {
    Winsize { ws_row: rows, ws_col: 80, ws_xpixel: 0, ws_ypixel: 0 }
}

#[test]
fn a_person_watches_a_graph() {
    let graph = Graph::fast();
    let mut command = blindgrasp();
    command.env("NO_COLOR", "1");
    let mut top = OnTerminal::start(command, &[&graph.name, "--interval", "0.2"], 24);
    let picture = top.wait_until(|text| text.contains(" LIFT      ") && text.contains(" more decision"), "LIFT");
    let lines: Vec<&str> = picture.lines().collect();
    assert!(lines[0].starts_with(&format!("{}  running  up ", graph.name)), "{picture}");
    assert!(lines[1].ends_with("dataflow.yaml"), "{picture}");
    assert!(lines[2].starts_with("NODE "), "{picture}");
    for (line, node) in lines[3..].iter().zip(NODES) {
        let words: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(
            (words[0], words[1], words[2]),
            (node, "running", graph.pid_of(node).to_string().as_str()),
            "{picture}"
        );
    }
    for edge in
        ["recorded_source/tactile → contacts", "classifier/prediction → lift_arbiter", "lift_arbiter/decision → run"]
    {
        assert!(lines[8..].iter().any(|line| line.starts_with(edge)), "{picture}");
    }
    assert!(picture.contains("source to decision  p50 ") && !picture.contains("\x1b[1m"), "{picture}");
    assert_eq!(lines.len(), 24, "{picture}");

    // On a smaller terminal, rows of all tables are counted.
    tcsetwinsize(&top.terminal, size(12)).expect("sized");
    let picture = top.wait_until(|text| text.contains("… 3 more nodes, ") && text.contains(" more decision"), "nodes");
    assert_eq!(picture.lines().count(), 12, "{picture}");

    top.wait_until_cursor_is_shown(false);
    top.press("\x1a");
    top.wait_until_cursor_is_shown(true);
    // The process may not have stopped yet.
    let is_running = || {
        signal(top.pid(), Signal::CONT);
        !top.is_cursor_shown()
    };
    wait_until(is_running, || top.text());
    top.press("\x03");
    top.finish();
    graph.stop();
}

#[test]
fn restarts_a_silent_launcher_and_the_end_are_seen() {
    let graph = Graph::fast();
    let mut command = blindgrasp();
    command.env_remove("NO_COLOR");
    let top = OnTerminal::start(command, &[&graph.name, "--interval", "0.1"], 24);
    let restarts = |text: &str| {
        let row = text.lines().find(|line| line.contains("classifier "))?;
        row.split_whitespace().nth(5)?.trim_end_matches("\x1b[0m").parse::<u32>().ok()
    };
    top.wait_until(|text| restarts(text) == Some(0), "0 restarts");
    signal(graph.pid_of("classifier"), Signal::KILL);
    top.wait_until(|text| restarts(text) == Some(1) && text.contains("\x1b[31mclassifier "), "1 restart");

    signal(graph.pid(), Signal::STOP);
    let picture = top.wait_for("NOT ANSWERING");
    assert!(picture.contains("lift_arbiter/decision → run"), "{picture}");
    top.wait_for(&format!("kill -CONT {}", graph.pid()));
    signal(graph.pid(), Signal::CONT);
    top.wait_until(|text| text.contains("classifier ") && !text.contains("NOT ANSWERING"), "an answer");

    let name = graph.name.clone();
    graph.stop();
    let ended = top.wait_for(&format!("graph '{name}' has ended"));
    assert!(ended.contains("lift_arbiter/decision → run"), "{ended}");
    top.finish();
}

#[test]
fn any_end_shows_the_cursor_again() {
    let graph = Graph::fast();
    for end in [Signal::TERM, Signal::HUP, Signal::INT] {
        let top = OnTerminal::start(blindgrasp(), &[&graph.name], 24);
        top.wait_for("source to decision");
        signal(top.pid(), end);
        top.finish();
    }
    let top = OnTerminal::start(blindgrasp(), &[&graph.name, "-n", "1", "--interval", "0.1"], 24);
    top.finish();
    graph.stop();
}

#[test]
fn a_script_reads_a_line_an_interval() {
    let graph = Graph::fast();
    graph.wait_for_decisions(50);
    let output = run(&["top", &graph.name, "--json", "-n", "2", "--interval", "0.3"], 0);
    let lines = json_lines(&output.stdout);
    assert_eq!(lines.len(), 2);
    for line in &lines {
        assert_eq!((line["graph"].as_str(), line["state"].as_str()), (Some(graph.name.as_str()), Some("running")));
        let nodes: Vec<&str> =
            line["nodes"].as_array().expect("nodes").iter().filter_map(|node| node["node"].as_str()).collect();
        assert_eq!(nodes, NODES);
        assert!(line["interval_secs"].as_f64().expect("a number") >= 0.2, "{line}");
        for edge in line["edges"].as_array().expect("edges") {
            assert!(edge["rate_hz"].as_f64().expect("a number") > 0.0, "{edge}");
            assert!(edge["age_nanos"]["p50"].as_u64() <= edge["age_nanos"]["p99"].as_u64(), "{edge}");
            let waiting = edge["sent"].as_u64().expect("a count") - edge["received"].as_u64().expect("a count");
            assert_eq!(edge["n_queued"].as_u64(), Some(waiting), "{edge}");
        }
        assert!(line["decision_latency_nanos"]["p50"].as_u64().expect("decisions") > 0);
    }
    // Decisions that are new in the second line were not in the first.
    let ids = |line: &serde_json::Value| -> Vec<u64> {
        let new = line["decisions"]["new"].as_array().expect("decisions");
        new.iter().filter_map(|decided| decided["grasp_id"].as_u64()).collect()
    };
    let (first, second) = (ids(&lines[0]), ids(&lines[1]));
    assert!(!first.is_empty() && first.iter().max() < second.iter().min(), "{first:?} {second:?}");

    // Without --json and a terminal, the tables of each interval.
    let printed = text(&run(&["top", &graph.name, "-n", "2", "--interval", "0.3"], 0).stdout);
    assert_eq!(printed.lines().filter(|line| line.starts_with("NODE ")).count(), 2, "{printed}");
    assert!(printed.contains("\nlift_arbiter/decision → run ") && !printed.contains('\x1b'), "{printed}");

    // The reader closes the pipe.
    let mut child = blindgrasp()
        .args(["top", &graph.name, "--json", "--interval", "0.1"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    let mut begun = [0];
    child.stdout.take().expect("piped").read_exact(&mut begun).expect("a line");
    let ended = child.wait_with_output().expect("waited");
    assert_eq!((ended.status.code(), text(&ended.stderr).as_str()), (Some(0), ""));

    // The graph ends.
    let mut command = blindgrasp();
    command.args(["top", &graph.name, "--json", "--interval", "0.1"]).stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = command.spawn().expect("started");
    graph.wait_for_decisions(20);
    let name = graph.name.clone();
    graph.stop();
    let ended = child.wait_with_output().expect("waited");
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    assert_eq!(text(&ended.stderr), format!("graph '{name}' has ended\n"));
    assert!(!ended.stdout.is_empty());
}

#[test]
fn top_without_a_graph_is_refused() {
    let name = unique_name();
    fails(&["top", &name, "--json"], &format!("no graph '{name}' is running"));
    let mut top = OnTerminal::start(blindgrasp(), &[&name], 24);
    top.wait_for(&format!("no graph '{name}' is running"));
    assert_eq!(top.child.wait().expect("waited").code(), Some(1));
    run(&["top", "--interval", "0", "--json"], 2);
    run(&["top", "-n", "0", "--json"], 2);
}
