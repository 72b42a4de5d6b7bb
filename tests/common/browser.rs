//! Pages in headless Chromium (`tests/browser.py`).

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use serde_json::Value;

use super::python::python;
use super::{blindgrasp, project, skipped, wait_until};

/// A program whose lines are read; it ends with this.
pub(crate) struct Running {
    child: Child,
    stdout: BufReader<std::process::ChildStdout>,
}

impl Running {
    pub(crate) fn start(command: &mut Command) -> Running {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("started");
        let stdout = BufReader::new(child.stdout.take().expect("stdout"));
        Running { child, stdout }
    }

    pub(crate) fn line(&mut self) -> String {
        let mut line = String::new();
        assert!(self.stdout.read_line(&mut line).expect("read") > 0, "it has ended");
        line.trim_end().to_owned()
    }

    /// The page of a graph, and its address.
    pub(crate) fn page(graph: &str, port: u16) -> (Running, String) {
        Running::page_with(graph, port, &[])
    }

    pub(crate) fn page_with(graph: &str, port: u16, options: &[&str]) -> (Running, String) {
        let mut page = Running::start(blindgrasp().args(["view", graph, "--port", &port.to_string()]).args(options));
        let address = page.line();
        (page, address)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(crate) struct Browser(Running);

impl Drop for Browser {
    /// Without input the program ends the browser. If it were killed, the browser would go on.
    fn drop(&mut self) {
        drop(self.0.child.stdin.take());
        let _ = self.0.child.wait();
    }
}

impl Browser {
    /// The test is skipped without a browser.
    #[track_caller]
    pub(crate) fn open(address: &str) -> Option<Browser> {
        if !Path::new("/usr/bin/chromedriver").exists() {
            skipped("no chromium-driver: scripts/test installs it on Debian");
            return None;
        }
        let mut command = Command::new(python());
        command.arg(project().join("tests/browser.py")).arg(address).env("PYTHONDONTWRITEBYTECODE", "1");
        let mut browser = Running::start(&mut command);
        assert_eq!(browser.line(), "null");
        Some(Browser(browser))
    }

    /// The value of an expression, or the answer to another word.
    pub(crate) fn ask(&mut self, line: &str) -> Value {
        writeln!(self.0.child.stdin.as_mut().expect("stdin"), "{line}").expect("written");
        let answer = self.0.line();
        serde_json::from_str(&answer).unwrap_or_else(|error| panic!("{line}: {answer}: {error}"))
    }

    pub(crate) fn wait_until(&mut self, expression: &str) {
        let mut last = Value::Null;
        wait_until(
            || {
                last = self.ask(expression);
                last == true
            },
            || format!("{expression} is not true"),
        );
    }

    /// Keeps every text of a grasp that waits: such a text stays for some milliseconds only.
    pub(crate) fn keep_waits(&mut self) {
        self.ask(
            "(window.waits = [], new MutationObserver(([{ target }]) => waits.push(target.textContent)) \
             .observe(document.getElementById('waits'), { childList: true }), null)",
        );
    }

    pub(crate) fn wait_for_waits(&mut self, part: &str) {
        self.wait_until(&format!("waits.some((text) => text.includes('{part}'))"));
    }

    pub(crate) fn text(&mut self, id: &str) -> String {
        self.ask(&format!("document.getElementById('{id}').textContent")).as_str().expect("a text").to_owned()
    }

    /// Chooses an option, as a user does.
    pub(crate) fn choose(&mut self, id: &str, value: &str) {
        self.ask(&format!("document.getElementById('{id}').value = '{value}'"));
        self.ask(&format!("document.getElementById('{id}').dispatchEvent(new Event('change'))"));
    }

    pub(crate) fn click(&mut self, selector: &str) {
        self.ask(&format!("document.querySelector('{selector}').click()"));
    }

    /// So many frames more than now.
    pub(crate) fn wait_for_frames(&mut self, n: u64) {
        let shown = self.ask("blindgrasp.frames").as_u64().expect("a number");
        self.wait_until(&format!("blindgrasp.frames >= {}", shown + n));
    }
}
