//! `blindgrasp top`, as a person at a terminal and as a script runs it.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::OpenOptionsExt as _;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use crate::common::{Graph, NODES, blindgrasp, fails, json_lines, run, signal, text, unique_name, wait_until};
use crate::over_ssh::Sshd;
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Termios, Winsize, tcgetattr, tcsetwinsize};

/// `top` on a terminal of its own, whose screen is put together from what it writes.
struct OnTerminal {
    child: Child,
    terminal: File,
    /// The other side, kept open so that its settings can be read.
    line: OwnedFd,
    before: Termios,
    screen: Arc<Mutex<vt100::Parser>>,
}

impl OnTerminal {
    fn start(arguments: &[&str], rows: u16, columns: u16) -> OnTerminal {
        OnTerminal::of(blindgrasp(), arguments, rows, columns)
    }

    fn of(command: Command, arguments: &[&str], rows: u16, columns: u16) -> OnTerminal {
        let (terminal, line, before, child) = start(command, arguments, rows, columns);
        let screen = Arc::new(Mutex::new(vt100::Parser::new(cells(rows), cells(columns), 0)));
        let (mut reader, written) = (terminal.try_clone().expect("cloned"), Arc::clone(&screen));
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(n @ 1..) = reader.read(&mut bytes) {
                written.lock().expect("not poisoned").process(&bytes[..n]);
            }
        });
        OnTerminal { child, terminal, line, before, screen }
    }

    fn text(&self) -> String {
        self.screen.lock().expect("not poisoned").screen().contents()
    }

    fn wait_for(&self, wanted: &str) {
        self.wait_while(|text| !text.contains(wanted), wanted);
    }

    fn wait_while(&self, is_so: impl Fn(&str) -> bool, wanted: &str) {
        wait_until(|| !is_so(&self.text()), || format!("no '{wanted}' in\n{}", self.text()));
    }

    fn press(&mut self, keys: &str) {
        self.terminal.write_all(keys.as_bytes()).expect("pressed");
    }

    fn resize(&self, rows: u16, columns: u16) {
        self.screen.lock().expect("not poisoned").screen_mut().set_size(cells(rows), cells(columns));
        tcsetwinsize(&self.terminal, size(rows, columns)).expect("sized");
    }

    /// Waits for its end with this exit code, after which the terminal must be as it was.
    fn finish(mut self, code: Option<i32>) {
        assert_eq!(self.child.wait().expect("waited").code(), code, "{}", self.text());
        let is_given_back = || {
            let parser = self.screen.lock().expect("not poisoned");
            !parser.screen().alternate_screen() && !parser.screen().hide_cursor()
        };
        wait_until(is_given_back, || format!("not given back:\n{}", self.text()));
        let (now, before) = (tcgetattr(&self.line).expect("settings"), &self.before);
        let modes =
            |termios: &Termios| (termios.input_modes, termios.output_modes, termios.control_modes, termios.local_modes);
        assert_eq!(modes(&now), modes(before));
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// `top` on a new terminal: its two sides, the settings that it began with, and the process.
fn start(mut command: Command, arguments: &[&str], rows: u16, columns: u16) -> (File, OwnedFd, Termios, Child) {
    let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a terminal");
    grantpt(&terminal).expect("granted");
    unlockpt(&terminal).expect("unlocked");
    let path = ptsname(&terminal, Vec::new()).expect("named").into_string().expect("UTF-8");
    // It is the terminal of `top`, and not that of the tests.
    let no_terminal = OpenptFlags::NOCTTY.bits() as i32;
    let line = File::options().read(true).write(true).custom_flags(no_terminal).open(path).expect("opened");
    tcsetwinsize(&line, size(rows, columns)).expect("sized");
    let before = tcgetattr(&line).expect("settings");
    let stdio = || Stdio::from(line.try_clone().expect("cloned"));
    command.arg("top").args(arguments).env("TERM", "xterm-256color").env_remove("NO_COLOR");
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
    (File::from(terminal), line.into(), before, child)
}

fn cells(n: u16) -> std::num::NonZero<u16> {
    n.try_into().expect("at least one")
}

fn size(rows: u16, columns: u16) -> Winsize {
    Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 }
}

#[test]
fn a_person_watches_a_graph() {
    let graph = Graph::fast();
    let mut top = OnTerminal::start(&[&graph.name, "--interval", "0.2"], 24, 80);
    top.wait_for("LIFT");
    let text = top.text();
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].starts_with(&format!("{}  running  up ", graph.name)), "{text}");
    assert!(lines[1].ends_with("dataflow.yaml"), "{text}");
    assert!(lines[2].starts_with("NODE "), "{text}");
    for (line, node) in lines[3..].iter().zip(NODES) {
        let words: Vec<&str> = line.split_whitespace().collect();
        assert_eq!((words[0], words[1]), (node, "running"), "{text}");
        assert_eq!(words[2], graph.pid_of(node).to_string(), "{text}");
    }
    for edge in
        ["recorded_source/tactile → contacts", "classifier/prediction → lift_arbiter", "lift_arbiter/decision → run"]
    {
        assert!(lines[8..].iter().any(|line| line.starts_with(edge)), "{text}");
    }
    assert!(text.contains("source to decision  p50 "), "{text}");
    {
        let parser = top.screen.lock().expect("not poisoned");
        assert!(parser.screen().alternate_screen() && parser.screen().hide_cursor());
    }

    top.press("?");
    top.wait_for("the next running graph");
    top.press("\u{1b}");
    top.wait_while(|text| text.contains("the next running graph"), "no help any more");
    top.press("p");
    top.wait_for("PAUSED");
    top.press("p");
    top.wait_while(|text| text.contains("PAUSED"), "no pause any more");
    top.press("+");
    top.wait_for("+- 0.5 s");
    top.press("-");
    top.wait_for("+- 0.2 s");
    top.press("r");
    top.wait_for("r counts from r");
    top.press("g");
    // The next graph is another test's, which may be ending: a line of its own then says why it is not shown.
    let has_gone_on = |text: &str| {
        text.contains("no other graph is running") || text.contains("graph '") || !text.starts_with(&graph.name)
    };
    wait_until(|| has_gone_on(&top.text()), || top.text());
    top.press("q");
    top.finish(Some(0));
    graph.stop();
}

#[test]
fn restarts_a_silent_launcher_and_the_end_are_seen() {
    let graph = Graph::fast();
    let top = OnTerminal::start(&[&graph.name, "--interval", "0.1"], 24, 80);
    top.wait_for("lift_arbiter/decision → run");
    let restarts = |text: &str| {
        let row = text.lines().find(|line| line.starts_with("classifier "))?;
        row.split_whitespace().nth(5)?.parse::<u32>().ok()
    };
    top.wait_while(|text| restarts(text) != Some(0), "0 restarts");
    signal(graph.pid_of("classifier"), Signal::KILL);
    top.wait_while(|text| restarts(text) != Some(1), "1 restart");

    signal(graph.pid(), Signal::STOP);
    top.wait_for("NOT ANSWERING");
    assert!(top.text().contains(&format!("kill -CONT {}", graph.pid())), "{}", top.text());
    signal(graph.pid(), Signal::CONT);
    top.wait_while(|text| text.contains("NOT ANSWERING"), "an answer");

    let name = graph.name.clone();
    graph.stop();
    top.wait_for(&format!("graph '{name}' has ended; this is its last picture"));
    assert!(top.text().contains("lift_arbiter/decision → run"), "{}", top.text());
    let mut top = top;
    top.press("q");
    top.finish(Some(0));
}

#[test]
fn every_terminal_size_works_and_any_end_gives_the_terminal_back() {
    let graph = Graph::fast();
    for (rows, columns) in [(1, 1), (2, 20), (10, 40), (60, 250)] {
        let mut top = OnTerminal::start(&[&graph.name, "--interval", "0.1"], rows, columns);
        top.wait_for(&graph.name[..1]);
        top.resize(24, 80);
        top.wait_for("q quit");
        top.wait_for("source to decision");
        top.resize(rows, columns);
        top.press("q");
        top.finish(Some(0));
    }
    for end in [Some(Signal::TERM), Some(Signal::HUP), Some(Signal::INT), None] {
        let mut top = OnTerminal::start(&[&graph.name], 24, 80);
        top.wait_for("q quit");
        match end {
            Some(end) => signal(top.child.id() as i32, end),
            None => top.press("\u{3}"),
        }
        top.finish(Some(0));
    }
    // It ends with its terminal, before it has begun to draw, and while it does.
    for millis in [0, 100, 600] {
        let (terminal, line, _, mut child) = start(blindgrasp(), &[&graph.name, "--interval", "0.1"], 24, 80);
        std::thread::sleep(std::time::Duration::from_millis(millis));
        drop((terminal, line));
        let pid = child.id() as i32;
        wait_until(
            || child.try_wait().expect("looked").is_some(),
            || {
                signal(pid, Signal::KILL);
                "top goes on without a terminal".into()
            },
        );
    }
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
fn top_without_a_graph_or_a_terminal_is_refused() {
    let name = unique_name();
    fails(&["top", &name, "--json"], &format!("no graph '{name}' is running"));
    fails(&["top", &name], "stdout is no terminal");
    fails(&["top", &name], "--json");
    let top = OnTerminal::start(&[&name], 24, 80);
    top.wait_for(&format!("no graph '{name}' is running"));
    top.finish(Some(1));
    run(&["top", "--interval", "0", "--json"], 2);
    run(&["top", "-n", "0", "--json"], 2);
}

#[test]
fn a_person_watches_a_graph_over_ssh() {
    let Some(sshd) = Sshd::start() else { return };
    let graph = Graph::fast();
    let there = [&graph.name, "--machine", "brain", "--interval", "0.2"];
    let mut top = OnTerminal::of(sshd.blindgrasp(), &there, 24, 80);
    top.wait_for("LIFT");
    top.resize(30, 100);
    // A key, and Ctrl-C: on the terminal of the other machine.
    top.press("?");
    top.wait_for("q Esc Ctrl-C");
    top.press("\x03");
    top.finish(Some(0));
    graph.stop();
}
