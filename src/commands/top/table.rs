//! Tables that fit: the least important columns go first, then the first one is cut.

use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};

/// A column.
#[derive(Debug, Clone, Copy)]
pub(super) struct Column {
    pub(super) title: &'static str,
    /// The greater, the sooner it goes when there is no room; the first column stays.
    pub(super) expendable: u8,
    pub(super) is_left: bool,
    /// It is left out where all its cells are [`NOTHING`]: it would take a name's place.
    pub(super) is_rare: bool,
}

/// Cells without a count or a time.
const NOTHING: [&str; 3] = ["", "0", "0.0µs"];

/// What stands in a column.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cell {
    pub(super) text: String,
    pub(super) style: Style,
}

impl Cell {
    pub(super) fn new(text: impl Into<String>) -> Cell {
        Cell { text: text.into(), style: Style::new() }
    }

    pub(super) fn styled(text: impl Into<String>, style: Style) -> Cell {
        Cell { text: text.into(), style }
    }
}

/// Between columns.
const GAP: usize = 1;
/// The first column is not cut below this as long as there are others to drop.
const MIN_FIRST_WIDTH: usize = 24;
/// Columns as expendable as this go before the first one is cut at all.
const LUXURY: u8 = 7;

/// The title line and those of the rows, all of them: columns keep their place when one scrolls.
pub(super) fn table(columns: &[Column], rows: &[Vec<Cell>], width: usize) -> (Line<'static>, Vec<Line<'static>>) {
    let full: Vec<usize> = (0..columns.len())
        .map(|idx| {
            let cells = rows.iter().map(|row| text_width(&row[idx].text));
            cells.chain([text_width(columns[idx].title)]).max().unwrap_or(0)
        })
        .collect();
    let mut kept: Vec<usize> = (0..columns.len()).collect();
    kept.retain(|&idx| !columns[idx].is_rare || rows.iter().any(|row| !NOTHING.contains(&row[idx].text.as_str())));
    let needed = |kept: &[usize], first: usize| first + kept.iter().skip(1).map(|&idx| GAP + full[idx]).sum::<usize>();
    while let Some(least) = kept.iter().skip(1).copied().max_by_key(|&idx| columns[idx].expendable) {
        let is_luxury = columns[least].expendable >= LUXURY;
        let first = if is_luxury { full[0] } else { full[0].min(MIN_FIRST_WIDTH) };
        if needed(&kept, first) <= width {
            break;
        }
        kept.retain(|&idx| idx != least);
    }
    let first_width = full[0].min(width.saturating_sub(needed(&kept, 0)));
    let line = |cells: Vec<(String, Style)>| {
        let mut spans = Vec::new();
        for (place, (text, style)) in cells.into_iter().enumerate() {
            let idx = kept[place];
            let text = if place == 0 { shortened(&text, first_width) } else { text };
            let column_width = if place == 0 { first_width } else { full[idx] };
            let blanks = " ".repeat(column_width.saturating_sub(text_width(&text)));
            if place > 0 {
                spans.push(Span::raw(" ".repeat(GAP)));
            }
            let is_last = place + 1 == kept.len();
            if !columns[idx].is_left {
                spans.extend([Span::raw(blanks), Span::styled(text, style)]);
            } else if is_last {
                spans.push(Span::styled(text, style));
            } else {
                spans.extend([Span::styled(text, style), Span::raw(blanks)]);
            }
        }
        Line::from(spans)
    };
    let titles = kept.iter().map(|&idx| (columns[idx].title.to_string(), Style::new())).collect();
    let lines = rows.iter().map(|row| line(kept.iter().map(|&idx| (row[idx].text.clone(), row[idx].style)).collect()));
    (line(titles).patch_style(Style::new().add_modifier(Modifier::BOLD)), lines.collect())
}

/// At most so wide: cut in its middle, since names differ at their ends.
pub(super) fn shortened(text: &str, width: usize) -> String {
    let n_chars = text.chars().count();
    if n_chars <= width {
        return text.into();
    }
    let Some(n_kept) = width.checked_sub(1) else { return String::new() };
    let n_head = n_kept.div_ceil(2);
    let tail = text.chars().skip(n_chars - (n_kept - n_head));
    text.chars().take(n_head).chain(['…']).chain(tail).collect()
}

fn text_width(text: &str) -> usize {
    Span::raw(text).width()
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLUMNS: [Column; 3] = [
        Column { title: "NODE", expendable: 0, is_left: true, is_rare: false },
        Column { title: "PID", expendable: 2, is_left: false, is_rare: false },
        Column { title: "STATE", expendable: 1, is_left: true, is_rare: false },
    ];

    fn drawn(width: usize) -> Vec<String> {
        let rows = [["a", "1234567", "up"], ["a_node_with_a_long_name_that_goes_on", "2", "down"]];
        let rows: Vec<Vec<Cell>> = rows.iter().map(|row| row.iter().map(|&text| Cell::new(text)).collect()).collect();
        let (titles, lines) = table(&COLUMNS, &rows, width);
        [titles].into_iter().chain(lines).map(|line| line.to_string()).collect()
    }

    #[test]
    fn columns_go_by_importance_and_then_the_first_is_cut() {
        let long = "a_node_with_a_long_name_that_goes_on";
        let row = |node: &str, pid: &str, state: &str| format!("{node:36} {pid:>7} {state}");
        let expected = [row("NODE", "PID", "STATE"), row("a", "1234567", "up"), row(long, "2", "down")];
        assert_eq!(drawn(80), expected);
        assert_eq!(drawn(50), expected);
        // The name gives way as far as it can, then the process does.
        assert_eq!(drawn(38)[2], format!("{} {:>7} down", shortened(long, 24), "2"));
        let row = |node: &str, state: &str| format!("{node:25} {state}");
        assert_eq!(drawn(31), [row("NODE", "STATE"), row("a", "up"), row(&shortened(long, 25), "down")]);
        assert_eq!(drawn(10), ["NODE", "a", "a_nod…s_on"]);
        assert_eq!(drawn(1), ["…", "a", "…"]);
        assert_eq!(drawn(0), ["", "", ""]);
    }

    #[test]
    fn names_are_cut_in_their_middle() {
        assert_eq!(shortened("lift_arbiter", 12), "lift_arbiter");
        assert_eq!(shortened("lift_arbiter", 7), "lif…ter");
        assert_eq!((shortened("ab", 1), shortened("ab", 0)), ("…".into(), String::new()));
    }
}
