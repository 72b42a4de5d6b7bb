//! `blindgrasp top`

pub(super) mod screen;
mod table;
mod view;

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};

use self::view::{Condition, Then, View};
use super::elsewhere::MachineArgument;
use super::{Outcome, completions, print_line, secs_in};
use blindgrasp_graph::client::activity::{Look, Window, measure};
use blindgrasp_graph::client::poller::Poller;
use blindgrasp_graph::client::{ClientError, pick_graph, running_graphs};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// Watch a running graph: its operators, edges and decisions
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp top grasp_gate --interval 0.5\n\n\
                        Keys: ? shows them, q quits. For scripts: --json, or blindgrasp ps.\n\
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
    #[command(flatten)]
    machine: MachineArgument,
}

/// Keys wait this long for an answer that is due; it usually comes at once.
const ANSWER_WAIT: Duration = Duration::from_millis(20);
/// An answer waits this long for keys.
const KEY_WAIT: Duration = Duration::from_millis(50);
/// Signals are checked this often.
const SIGNAL_POLL: Duration = Duration::from_millis(250);
/// After this time without an answer, the screen says so.
const SILENT_AFTER: Duration = Duration::from_secs(1);

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if !arguments.json && !std::io::stdout().is_terminal() {
        anyhow::bail!("stdout is no terminal to draw on; use blindgrasp top --json, or blindgrasp ps for one look");
    }
    if let Some(destination) = arguments.machine.destination()? {
        return if arguments.json { destination.run() } else { destination.run_on_terminal() };
    }
    let graph = pick_graph(arguments.graph.as_deref())?;
    let (poller, first) = Poller::connect(&graph)?;
    let interval = Duration::from_secs_f64(arguments.interval);
    if arguments.json {
        print_lines(poller, first, interval, arguments.iterations)?;
    } else {
        show(poller, View::new(first, interval), arguments.iterations)?;
    }
    Ok(Outcome::Done)
}

fn print_lines(
    mut poller: Poller,
    mut previous: Look,
    interval: Duration,
    n_intervals: Option<u64>,
) -> anyhow::Result<()> {
    let mut due = Instant::now();
    let mut n_left = n_intervals;
    while n_left != Some(0) {
        due += interval;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let now = match poller.look() {
            Ok(look) => look,
            Err(ClientError::Ended { graph }) => {
                print_diagnostic(&format!("graph '{graph}' has ended"));
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        let window = Window { previous: &previous, rates_since: Some(&previous), counts_since: None };
        print_line(&serde_json::to_string(&measure(&now, window))?)?;
        previous = now;
        n_left = n_left.map(|n_left| n_left - 1);
    }
    Ok(())
}

/// The terminal in raw mode. It is restored in any case, also by a panic.
struct Screen {
    // Dropped first: it shows the cursor again.
    terminal: DefaultTerminal,
    _restore: Restore,
}

struct Restore;

impl Drop for Restore {
    fn drop(&mut self) {
        // The terminal may be gone.
        let _ = ratatui::try_restore();
    }
}

impl Screen {
    fn open() -> anyhow::Result<Screen> {
        let _restore = Restore;
        let terminal = ratatui::try_init().context("cannot draw on this terminal")?;
        Ok(Screen { terminal, _restore })
    }

    fn draw(&mut self, view: &mut View) -> std::io::Result<()> {
        let mut n_visible = view.n_visible;
        self.terminal.draw(|frame| n_visible = screen::draw(frame, view))?;
        view.n_visible = n_visible;
        Ok(())
    }
}

fn show(mut poller: Poller, mut view: View, n_intervals: Option<u64>) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }
    let mut screen = Screen::open()?;
    let mut n_left = n_intervals;
    let mut asked = Instant::now();
    screen.draw(&mut view)?;
    while !stop.load(Ordering::Relaxed) && n_left != Some(0) {
        let mut is_dirty = false;
        if poller.waited().is_none() && !view.has_ended() && !view.is_paused && asked.elapsed() >= view.interval {
            // From the time when it was due, so that the rhythm keeps; from about now, if that is long ago.
            asked = (asked + view.interval).max(Instant::now() - view.interval / 2);
            if let Err(error) = poller.ask() {
                view.condition = ended(&error);
                is_dirty = true;
            }
        }
        if poller.waited().is_some() && !view.has_ended() {
            is_dirty |= take_answer(&mut poller, &mut view, &mut n_left);
        }
        if is_dirty {
            screen.draw(&mut view)?;
        }
        // Waits for a key, a new size, or the next look.
        let mut limit = match poller.waited() {
            _ if n_left == Some(0) => Duration::ZERO,
            _ if view.has_ended() || view.is_paused => SIGNAL_POLL,
            Some(_) => KEY_WAIT,
            None => view.interval.saturating_sub(asked.elapsed()).min(SIGNAL_POLL),
        };
        let mut is_dirty = false;
        while event::poll(limit).context("cannot read keys")? {
            limit = Duration::ZERO;
            is_dirty = true;
            let Event::Key(key) = event::read().context("cannot read keys")? else { continue };
            match view.on_key(key) {
                Then::Nothing => {}
                Then::Quit => return Ok(()),
                Then::NextGraph => next_graph(&mut poller, &mut view),
                Then::Suspend => {
                    drop(screen);
                    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::TSTP);
                    screen = Screen::open()?;
                }
            }
        }
        if is_dirty {
            screen.draw(&mut view)?;
        }
    }
    Ok(())
}

/// Takes the answer, if it comes; true if the screen is another one.
fn take_answer(poller: &mut Poller, view: &mut View, n_left: &mut Option<u64>) -> bool {
    match poller.answer_within(ANSWER_WAIT) {
        Ok(Some(look)) => {
            view.take(look);
            *n_left = n_left.map(|n_left| n_left - 1);
        }
        Ok(None) => return say_if_silent(poller, view),
        Err(error) => view.condition = ended(&error),
    }
    true
}

fn ended(error: &ClientError) -> Condition {
    let message = match error {
        ClientError::Ended { graph } => format!("graph '{graph}' has ended; this is its last picture"),
        other => other.to_string(),
    };
    Condition::Ended { message }
}

/// Notes how long the graph has not answered; true if that has changed.
fn say_if_silent(poller: &Poller, view: &mut View) -> bool {
    let Some(waited) = poller.waited().filter(|&waited| waited >= SILENT_AFTER) else { return false };
    let condition = Condition::Silent { secs: waited.as_secs() };
    let has_changed = view.condition != condition;
    view.condition = condition;
    has_changed
}

/// Goes on to the next running graph by name; to the same, if it runs anew.
fn next_graph(poller: &mut Poller, view: &mut View) {
    let shown = view.now.status.graph.clone();
    let has_ended = view.has_ended();
    let mut graphs = running_graphs();
    let n_before = graphs.partition_point(|graph| *graph <= shown);
    graphs.rotate_left(n_before);
    let next = graphs.into_iter().find(|graph| *graph != shown || has_ended);
    match next.as_deref().map(Poller::connect) {
        Some(Ok((connected, first))) => {
            *poller = connected;
            *view = View::new(first, view.interval);
        }
        Some(Err(error)) => view.notice = Some(error.to_string()),
        None if has_ended => {
            view.condition = Condition::Ended { message: format!("graph '{shown}' has ended and no other runs") }
        }
        None => view.notice = Some("no other graph is running".into()),
    }
}
