//! The page of a graph that `run --view` serves: another process of this program.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

use super::super::view::Rights;

/// The page of a graph that ends has this time to show its end.
const PAGE_LIMIT: Duration = Duration::from_secs(3);

/// The process that serves the page of the graph. It ends when its stdin does, also if this process is killed.
pub(super) struct Page(Child);

impl Page {
    /// Starts it, and waits until the page is served.
    pub(super) fn start(graph: &str, port: u16, rights: Rights) -> anyhow::Result<Page> {
        let program = std::env::current_exe().context("the program of the page is not known")?;
        let mut command = Command::new(program);
        command.args(["view", graph, "--wait", "--port", &port.to_string()]);
        command.args(rights.options());
        // Ctrl-C is for the graph: the page shows its end.
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).process_group(0);
        let mut page = Page(command.spawn().context("cannot start the page (--view)")?);
        let mut address = String::new();
        if let Some(stdout) = page.0.stdout.take() {
            BufReader::new(stdout).read_line(&mut address).context("the page does not answer (--view)")?;
        }
        if address.is_empty() {
            bail!("the page cannot be served (--view)");
        }
        Ok(page)
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        let limit = Instant::now() + PAGE_LIMIT;
        while matches!(self.0.try_wait(), Ok(None)) && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(10));
        }
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
