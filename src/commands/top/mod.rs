//! `blindgrasp top`

mod page;

use std::io::{IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use rustix::process::{Signal, getpid, kill_process};

use self::page::lines;
use super::{Outcome, completions, print_line, secs_in, stop_signal};
use blindgrasp_graph::client::activity::{Look, measure};
use blindgrasp_graph::client::poller::Poller;
use blindgrasp_graph::client::{ClientError, pick_graph};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_session::console::{RED, is_coloured, paint};

/// Watch a running graph: its operators, edges and decisions
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp top grasp_gate --interval 0.5\n\n\
                        Ctrl-C ends it. For scripts: --json, or blindgrasp ps.\n\
                        Exit code 1 if no graph runs, or it does not answer.")]
pub(super) struct Arguments {
    /// Graph [default: the only one running]
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    /// Update every so many seconds
    #[arg(long, value_name = "TIME", default_value = "1", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    interval: f64,
    /// Print JSON, one object a line and interval
    #[arg(long)]
    json: bool,
    /// End after so many intervals
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    iterations: Option<u64>,
}

/// Signals and answers are waited for so long at a time.
const POLL: Duration = Duration::from_millis(250);
/// After this time without an answer, the screen says so.
const SILENT_AFTER: Duration = Duration::from_secs(1);
/// Control sequences of a terminal (ECMA-48 and DEC): the cursor hidden, the screen cleared from its top.
/// Lines that are too long are cut by the terminal, also where characters are wide.
const CLEARED: &str = "\x1b[?7l\x1b[?25l\x1b[H\x1b[J";
const CURSOR_SHOWN: &str = "\n\x1b[?7h\x1b[?25h";

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let is_on_terminal = !arguments.json && std::io::stdout().is_terminal();
    let graph = pick_graph(arguments.graph.as_deref())?;
    let (mut poller, first) = Poller::connect(&graph)?;
    let screen = if is_on_terminal { Some(Screen::open()?) } else { None };
    let watched = watch(arguments, &mut poller, first, screen.as_ref());
    // The cursor is shown before anything is said.
    drop(screen);
    match watched {
        Err(error) if matches!(error.downcast_ref(), Some(ClientError::Ended { .. })) => {
            print_diagnostic(&format!("graph '{graph}' has ended"));
            Ok(Outcome::Done)
        }
        watched => watched.map(|()| Outcome::Done),
    }
}

/// Shows the graph, or prints it where there is no screen.
fn watch(arguments: &Arguments, poller: &mut Poller, first: Look, screen: Option<&Screen>) -> anyhow::Result<()> {
    let interval = Duration::from_secs_f64(arguments.interval);
    if let Some(screen) = screen {
        screen.draw(&first, None)?;
    }
    let mut previous = first;
    let mut due = Instant::now();
    let mut n_left = arguments.iterations;
    while n_left != Some(0) {
        // From the time when it was due, so that the rhythm keeps; from now, if that is past.
        due = (due + interval).max(Instant::now());
        let look = if let Some(screen) = screen {
            let Some(look) = screen.next_look(poller, due, previous.status.pid)? else { return Ok(()) };
            screen.draw(&look, Some(&previous))?;
            look
        } else {
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            let look = poller.look()?;
            if arguments.json {
                print_line(&serde_json::to_string(&measure(&look, Some(&previous)))?)?;
            } else {
                for line in lines(&look, Some(&previous), usize::MAX, usize::MAX) {
                    print_line(&line.text)?;
                }
                print_line("")?;
            }
            look
        };
        previous = look;
        n_left = n_left.map(|n_left| n_left - 1);
    }
    Ok(())
}

/// The terminal. Its cursor is shown again at any end, also after a panic.
struct Screen {
    must_stop: Arc<AtomicBool>,
    /// Ctrl-Z was pressed.
    must_suspend: Arc<AtomicBool>,
}

impl Screen {
    fn open() -> anyhow::Result<Screen> {
        let must_suspend = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(signal_hook::consts::SIGTSTP, Arc::clone(&must_suspend))
            .context("cannot listen for signals")?;
        Ok(Screen { must_stop: stop_signal()?, must_suspend })
    }

    fn draw(&self, now: &Look, before: Option<&Look>) -> std::io::Result<()> {
        let size = rustix::termios::tcgetwinsize(std::io::stdout())?;
        let (n_rows, n_columns) = match (size.ws_row, size.ws_col) {
            // A terminal on a serial line knows no size.
            (0, _) | (_, 0) => (24, 80),
            (n_rows, n_columns) => (n_rows.into(), n_columns.into()),
        };
        let is_coloured = is_coloured();
        let mut text = CLEARED.to_string();
        for (idx, line) in lines(now, before, n_rows, n_columns).into_iter().enumerate() {
            // Without a line break at the end: it would scroll a full screen.
            if idx > 0 {
                text.push('\n');
            }
            match line.style {
                Some(style) if is_coloured => text.push_str(&paint(&line.text, style)),
                _ => text.push_str(&line.text),
            }
        }
        write(&text)
    }

    /// The look that is due then; `None` if the command is to stop. The screen says how long the graph has not answered.
    fn next_look(&self, poller: &mut Poller, due: Instant, pid: u32) -> anyhow::Result<Option<Look>> {
        while !self.must_stop.load(Ordering::Relaxed) {
            if self.must_suspend.swap(false, Ordering::Relaxed) {
                write(CURSOR_SHOWN)?;
                kill_process(getpid(), Signal::STOP)?;
            }
            let left = due.saturating_duration_since(Instant::now());
            if !left.is_zero() {
                std::thread::sleep(left.min(POLL));
                continue;
            }
            poller.ask()?;
            if let Some(look) = poller.answer_within(POLL)? {
                return Ok(Some(look));
            }
            if let Some(waited) = poller.waited()
                && waited >= SILENT_AFTER
            {
                let secs = waited.as_secs();
                let said = format!(
                    "NOT ANSWERING for {secs} s: the launcher may be stopped (kill -CONT {pid}) or hang (kill {pid})"
                );
                let said = if is_coloured() { paint(&said, RED) } else { said };
                // In the first line; the cursor goes back to its place.
                write(&format!("\x1b7\x1b[H\x1b[2K{said}\x1b8"))?;
            }
        }
        Ok(None)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // The terminal may be gone.
        let _ = write(CURSOR_SHOWN);
    }
}

fn write(text: &str) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}
