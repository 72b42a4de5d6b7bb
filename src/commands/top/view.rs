//! What `top` shows, and what keys change of it.

use std::collections::VecDeque;
use std::time::Duration;

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use blindgrasp_graph::client::activity::{Look, Measured, Window, measure};

/// Between two looks, for `+` and `-`.
const INTERVALS_SECS: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0];
/// How many intervals the history reaches back: no terminal is wider.
const N_HISTORY: usize = 512;

/// The tables, from the top.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Table {
    Nodes,
    Edges,
    Decisions,
}

impl Table {
    pub(super) const ALL: [Table; 3] = [Table::Nodes, Table::Edges, Table::Decisions];
}

/// How the graph answers.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Condition {
    /// As it should.
    Answering,
    /// Not, for so long.
    Silent { secs: u64 },
    /// It has ended, or what it says is not understood: nothing more will come.
    Ended { message: String },
}

/// What is left to do after a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Then {
    Nothing,
    Quit,
    /// Show the next of the running graphs.
    NextGraph,
    /// Let the shell have the terminal until it says otherwise.
    Suspend,
}

/// What is shown.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) now: Look,
    previous: Look,
    /// Since when losses and decisions are counted; `None` since the graph's start.
    base: Option<Look>,
    /// Whether rates and ages are taken over as long, instead of the last interval.
    pub(super) is_rate_since_base: bool,
    /// The 99th percentile of the decisions' latency in each of the last intervals, the latest last.
    pub(super) p99_history_nanos: VecDeque<u64>,
    pub(super) interval: Duration,
    pub(super) condition: Condition,
    pub(super) is_paused: bool,
    pub(super) is_help_shown: bool,
    pub(super) focus: Table,
    /// How many rows of each table are scrolled out at its top.
    pub(super) offsets: [usize; 3],
    /// How many rows of each table were to be seen when it was last drawn.
    pub(super) n_visible: [usize; 3],
    /// How many processors the machine has.
    pub(super) n_processors: usize,
    /// A word to the reader, until the next key.
    pub(super) notice: Option<String>,
}

impl View {
    /// Of a graph that was looked at once.
    pub(super) fn new(first: Look, interval: Duration) -> View {
        View {
            previous: first.clone(),
            now: first,
            base: None,
            is_rate_since_base: false,
            p99_history_nanos: VecDeque::new(),
            interval,
            condition: Condition::Answering,
            is_paused: false,
            is_help_shown: false,
            focus: Table::Decisions,
            offsets: [0; 3],
            n_visible: [0; 3],
            n_processors: std::thread::available_parallelism().map_or(1, usize::from),
            notice: None,
        }
    }

    /// Takes in what the graph says now.
    pub(super) fn take(&mut self, look: Look) {
        self.condition = Condition::Answering;
        self.previous = std::mem::replace(&mut self.now, look);
        let window = Window { previous: &self.previous, rates_since: Some(&self.previous), counts_since: None };
        let p99 = measure(&self.now, window).decision_latency_nanos.map_or(0, |latency| latency.p99);
        if self.p99_history_nanos.len() == N_HISTORY {
            self.p99_history_nanos.pop_front();
        }
        self.p99_history_nanos.push_back(p99);
    }

    /// What is to be shown.
    pub(super) fn measured(&self) -> Measured {
        // After the first look there is no interval yet: what was before is better than nothing.
        let is_first = self.now.at == self.previous.at;
        let since_base = self.is_rate_since_base || is_first;
        let rates_since = if since_base { self.base.as_ref() } else { Some(&self.previous) };
        measure(&self.now, Window { previous: &self.previous, rates_since, counts_since: self.base.as_ref() })
    }

    /// Whether nothing more will come.
    pub(super) fn has_ended(&self) -> bool {
        matches!(self.condition, Condition::Ended { .. })
    }

    /// Whether losses and decisions are counted since a moment of the reader's choice.
    pub(super) fn is_counted_anew(&self) -> bool {
        self.base.is_some()
    }

    /// How many rows a table has.
    pub(super) fn n_rows(&self, table: Table) -> usize {
        let status = &self.now.status;
        match table {
            Table::Nodes => status.nodes.len(),
            Table::Edges => status.edges.len(),
            Table::Decisions => status.decisions.latest.len(),
        }
    }

    /// What a key does.
    pub(super) fn on_key(&mut self, key: KeyEvent) -> Then {
        self.notice = None;
        if key.modifiers.contains(KeyModifiers::CONTROL) {
            return match key.code {
                KeyCode::Char('c') => Then::Quit,
                KeyCode::Char('z') => Then::Suspend,
                _ => Then::Nothing,
            };
        }
        let page = self.n_visible[self.focus as usize].max(1) as isize;
        match key.code {
            KeyCode::Char('q' | 'Q') => return Then::Quit,
            // As everywhere, Esc leaves the innermost thing first.
            KeyCode::Esc if self.is_help_shown => self.is_help_shown = false,
            KeyCode::Esc => return Then::Quit,
            KeyCode::Char('?' | 'h') | KeyCode::F(1) => self.is_help_shown = !self.is_help_shown,
            KeyCode::Char(' ' | 'p') => self.is_paused = !self.is_paused,
            KeyCode::Char('+' | '=') => self.change_interval(1),
            KeyCode::Char('-' | '_') => self.change_interval(-1),
            KeyCode::Char('w') => self.is_rate_since_base = !self.is_rate_since_base,
            KeyCode::Char('r') => {
                self.base = if self.base.is_none() { Some(self.now.clone()) } else { None };
            }
            KeyCode::Char('g') => return Then::NextGraph,
            KeyCode::Tab => self.change_focus(1),
            KeyCode::BackTab => self.change_focus(2),
            KeyCode::Up | KeyCode::Char('k') => self.scroll(-1),
            KeyCode::Down | KeyCode::Char('j') => self.scroll(1),
            KeyCode::PageUp => self.scroll(-page),
            KeyCode::PageDown => self.scroll(page),
            KeyCode::Home => self.scroll(isize::MIN),
            KeyCode::End => self.scroll(isize::MAX),
            _ => {}
        }
        Then::Nothing
    }

    fn change_focus(&mut self, n_tables: usize) {
        self.focus = Table::ALL[(self.focus as usize + n_tables) % Table::ALL.len()];
    }

    fn scroll(&mut self, n_rows: isize) {
        let idx = self.focus as usize;
        let last = self.n_rows(self.focus).saturating_sub(self.n_visible[idx]);
        self.offsets[idx] = self.offsets[idx].saturating_add_signed(n_rows).min(last);
    }

    /// To the next longer or shorter of the usual intervals.
    fn change_interval(&mut self, steps: i32) {
        let secs = self.interval.as_secs_f64();
        let next = if steps > 0 {
            INTERVALS_SECS.iter().find(|&&other| other > secs + 1e-9)
        } else {
            INTERVALS_SECS.iter().rfind(|&&other| other < secs - 1e-9)
        };
        if let Some(&secs) = next {
            self.interval = Duration::from_secs_f64(secs);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_graph::testing::made_looks;

    fn view() -> View {
        let (before, now) = made_looks();
        let mut view = View::new(before, Duration::from_secs(1));
        view.take(now);
        view
    }

    fn press(view: &mut View, codes: &[KeyCode]) -> Then {
        codes.iter().map(|&code| view.on_key(KeyEvent::new(code, KeyModifiers::NONE))).last().expect("a key")
    }

    #[test]
    fn keys_as_in_htop() {
        let mut view = view();
        assert_eq!(press(&mut view, &[KeyCode::Char('q')]), Then::Quit);
        assert_eq!(press(&mut view, &[KeyCode::Char('h'), KeyCode::Esc]), Then::Nothing);
        assert!(!view.is_help_shown);
        assert_eq!(press(&mut view, &[KeyCode::Esc]), Then::Quit);
        let control = |letter| KeyEvent::new(KeyCode::Char(letter), KeyModifiers::CONTROL);
        assert_eq!((view.on_key(control('c')), view.on_key(control('z'))), (Then::Quit, Then::Suspend));
        assert_eq!(view.on_key(control('q')), Then::Nothing);
        press(&mut view, &[KeyCode::Char('p')]);
        assert!(view.is_paused);
        press(&mut view, &[KeyCode::Char(' ')]);
        assert!(!view.is_paused);
        assert_eq!(press(&mut view, &[KeyCode::Char('g')]), Then::NextGraph);
    }

    #[test]
    fn the_interval_has_a_longest_and_a_shortest() {
        let mut view = view();
        press(&mut view, &[KeyCode::Char('+')]);
        assert_eq!(view.interval, Duration::from_secs(2));
        press(&mut view, &[KeyCode::Char('+'); 20]);
        assert_eq!(view.interval, Duration::from_secs(60));
        press(&mut view, &[KeyCode::Char('-'); 20]);
        assert_eq!(view.interval, Duration::from_millis(100));
        view.interval = Duration::from_secs(3);
        press(&mut view, &[KeyCode::Char('-')]);
        assert_eq!(view.interval, Duration::from_secs(2));
    }

    #[test]
    fn a_table_scrolls_as_far_as_it_has_rows() {
        let mut view = view();
        view.n_visible = [1, 2, 1];
        press(&mut view, &[KeyCode::Tab]);
        assert_eq!(view.focus, Table::Nodes);
        press(&mut view, &[KeyCode::Down, KeyCode::Down, KeyCode::Down]);
        assert_eq!(view.offsets, [1, 0, 0]);
        press(&mut view, &[KeyCode::Home]);
        assert_eq!(view.offsets, [0, 0, 0]);
        press(&mut view, &[KeyCode::End, KeyCode::PageUp, KeyCode::PageDown]);
        assert_eq!(view.offsets, [1, 0, 0]);
        press(&mut view, &[KeyCode::Tab, KeyCode::PageDown, KeyCode::BackTab, KeyCode::BackTab, KeyCode::Down]);
        assert_eq!((view.focus, view.offsets), (Table::Decisions, [1, 0, 1]));
    }

    #[test]
    fn counts_begin_anew_and_again_at_the_start() {
        let mut view = view();
        assert_eq!(view.measured().edges[0].missing, 13);
        press(&mut view, &[KeyCode::Char('r')]);
        assert_eq!((view.measured().edges[0].missing, view.measured().decisions.n_lift), (0, 0));
        // Rates are still the last interval's.
        assert!((view.measured().edges[0].rate_hz - 999.0).abs() < 1e-6);
        press(&mut view, &[KeyCode::Char('w')]);
        assert_eq!(view.measured().edges[0].rate_hz, 0.0);
        press(&mut view, &[KeyCode::Char('r')]);
        assert_eq!(view.measured().edges[0].missing, 13);
        assert!((view.measured().edges[0].rate_hz - 2988.0 / 3727.4).abs() < 1e-9);
    }

    #[test]
    fn the_first_look_shows_the_run_so_far_and_history_grows_with_each_further_one() {
        let (before, now) = made_looks();
        let mut view = View::new(before, Duration::from_secs(1));
        assert!((view.measured().edges[0].rate_hz - 990.0 / 3725.4).abs() < 1e-9);
        assert!(view.p99_history_nanos.is_empty());
        view.take(now.clone());
        // The slowest of the 2988 decisions that came.
        assert_eq!(view.p99_history_nanos, [1_024_000]);
        (0..2 * N_HISTORY).for_each(|_| view.take(now.clone()));
        assert_eq!(view.p99_history_nanos.len(), N_HISTORY);
    }
}
