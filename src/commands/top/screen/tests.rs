//! What is seen, on a terminal in memory.

use std::collections::VecDeque;

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;

use super::*;
use blindgrasp_graph::testing::made_looks;

fn view() -> View {
    let (before, now) = made_looks();
    let mut view = View::new(before, Duration::from_secs(1));
    view.take(now);
    view
}

fn buffer(view: &mut View, width: u16, height: u16) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("in memory");
    terminal.draw(|frame| view.n_visible = draw(frame, view)).expect("drawn");
    terminal.backend().buffer().clone()
}

fn lines(buffer: &Buffer) -> Vec<String> {
    let width = usize::from(buffer.area.width);
    let symbols: Vec<&str> = buffer.content.iter().map(|cell| cell.symbol()).collect();
    symbols.chunks(width).map(|row| row.concat().trim_end().to_string()).collect()
}

fn words(line: &str) -> Vec<&str> {
    line.split_whitespace().collect()
}

/// The style where a text begins.
fn style_of(buffer: &Buffer, text: &str) -> Style {
    let lines = lines(buffer);
    let (y, line) = lines.iter().enumerate().find(|(_, line)| line.contains(text)).expect("on the screen");
    let x = line[..line.find(text).expect("there")].chars().count();
    buffer[(x as u16, y as u16)].style()
}

#[test]
fn a_terminal_of_80_by_24_shows_it_all() {
    let mut view = view();
    let buffer = buffer(&mut view, 80, 24);
    let lines = lines(&buffer);
    assert!(lines[0].starts_with("gate  DEGRADED  up 1h 2m 7s  pid 4242  cpu 26.0 %  load 0.75 of "), "{}", lines[0]);
    assert_eq!(lines[1], "classifier was given up after 5 restarts");
    let titles = ["NODE", "STATE", "PID", "CPU%", "MEMORY", "RESTARTS", "SWAPS", "HEARTBEAT", "COUNTS"];
    assert_eq!(words(&lines[2]), titles);
    assert_eq!(words(&lines[3]), ["contacts", "running", "4243+", "25.0", "3.0M", "2", "1", "12ms", "refused", "3"]);
    assert_eq!(words(&lines[4]), ["classifier", "FAILED", "-", "-", "-", "0", "0", "-", "refused", "3"]);
    assert!(lines[5].starts_with("EDGE") && lines[5].contains("LATE"), "{}", lines[5]);
    assert!(lines[6].starts_with("contacts/contacts → classifier"), "{}", lines[6]);
    assert!(words(&lines[6]).contains(&"999") && words(&lines[6]).contains(&"205µs"), "{}", lines[6]);
    assert!(lines[7].starts_with("classifier/prediction → run"), "{}", lines[7]);
    assert!(lines[8].starts_with("source to decision  p50 205µs  p90 205µs  p99 1.0ms  "), "{}", lines[8]);
    assert!(lines[8].ends_with('█'), "{}", lines[8]);
    assert_eq!(lines[9], "decided 0.5/s  LIFT 60  HOLD 41  FALSE POSITIVES 1");
    assert!(lines[10].starts_with("GRASP DECISION REASON"), "{}", lines[10]);
    let row = words(&lines[11]);
    assert_eq!((&row[..4], row[6]), (&["100", "HOLD", "unstable", "0.875"][..], "unstable"));
    assert!(lines[12].starts_with("99    LIFT") && lines[12].ends_with("UNSTABLE"), "{}", lines[12]);
    assert!(lines[23].starts_with(" q quit  ? help  p pause  +- 1 s  r counts from start "), "{}", lines[23]);
}

#[test]
fn only_losses_and_failures_are_loud() {
    let mut view = view();
    view.now.status.edges[0].policy = EdgePolicy::Lossless;
    let buffer = buffer(&mut view, 120, 30);
    for text in ["DEGRADED", "FAILED", "LIFT    ", "UNSTABLE", "FALSE POSITIVES"] {
        assert_eq!(style_of(&buffer, text).fg, Some(Color::Red), "{text}");
    }
    for text in ["running", "HOLD  ", "unstable", "contacts ", "12ms"] {
        assert_ne!(style_of(&buffer, text).fg, Some(Color::Red), "{text}");
    }
    // Lost on the lossless edge, older than the deadline; and nothing is loud of what is 0.
    let edge_row = lines(&buffer).iter().position(|line| line.starts_with("contacts/contacts")).expect("an edge");
    let red = (0..120).filter(|&x| buffer[(x, edge_row as u16)].style().fg == Some(Color::Red));
    let red: String = red.map(|x| buffer[(x, edge_row as u16)].symbol().to_string()).collect();
    assert_eq!(red, "10138");
    assert_eq!(lines(&buffer)[edge_row + 1].split_whitespace().filter(|word| *word == "0").count(), 2);
}

#[test]
fn no_size_is_too_small() {
    let mut view = view();
    for height in 1..30 {
        for width in [1, 2, 3, 7, 20, 41, 80, 300] {
            for is_help_shown in [false, true] {
                view.is_help_shown = is_help_shown;
                let lines = lines(&buffer(&mut view, width, height));
                assert!(is_help_shown || lines[0].starts_with('g'), "{width} x {height}: {lines:?}");
            }
        }
    }
}

#[test]
fn a_row_of_each_table_first_and_what_is_left_by_turns() {
    let wanted = [6, 7, 2, 33];
    let of = |total| heights(total, 2, wanted);
    assert_eq!(of(24), Heights { header: 2, parts: [6, 7, 2, 6], footer: 1 });
    assert_eq!(of(100), Heights { header: 2, parts: wanted.map(|height| height as u16), footer: 1 });
    assert_eq!(of(10), Heights { header: 2, parts: [2, 2, 1, 2], footer: 1 });
    assert_eq!(of(3), Heights { header: 1, parts: [2, 0, 0, 0], footer: 0 });
    assert_eq!(of(0), Heights { header: 0, parts: [0; 4], footer: 0 });
    for total in 0..60 {
        let Heights { header, parts, footer } = of(total);
        assert!(header + parts.iter().sum::<u16>() + footer <= total);
    }
}

#[test]
fn what_does_not_fit_is_scrolled_to() {
    let mut view = view();
    let mut latest: VecDeque<DecidedGrasp> = view.now.status.decisions.latest.clone();
    (101..120).for_each(|grasp_id| latest.push_back(DecidedGrasp { grasp_id, ..latest[1].clone() }));
    view.now.status.decisions.latest = latest;
    let shown = lines(&buffer(&mut view, 80, 24));
    assert!(shown[10].ends_with("▸1-12 of 21") && shown[11].starts_with("119 "), "{shown:?}");
    view.offsets[Table::Decisions as usize] = 9;
    let shown = lines(&buffer(&mut view, 80, 24));
    assert!(shown[10].ends_with("▸10-21 of 21") && shown[22].starts_with("99 "), "{shown:?}");
}

#[test]
fn what_is_wrong_is_said_and_what_others_say_is_made_harmless() {
    let mut view = view();
    view.now.status.message = Some("\u{1b}[2Jgone\u{202e}".into());
    let shown = lines(&buffer(&mut view, 80, 24));
    assert_eq!(shown[1], "\\u{1b}[2Jgone\\u{202e}");
    view.condition = Condition::Silent { secs: 4 };
    let shown = lines(&buffer(&mut view, 80, 24));
    assert!(shown[0].contains("NOT ANSWERING") && shown[1].starts_with("no answer for 4 s; "), "{shown:?}");
    assert!(shown[1].contains("kill -CONT 4242"), "{shown:?}");
    view.condition = Condition::Ended { message: "graph 'gate' has ended".into() };
    let shown = lines(&buffer(&mut view, 80, 24));
    assert!(shown[0].contains("ended") && shown[1] == "graph 'gate' has ended", "{shown:?}");
    assert_eq!(shown[23], " q quit  g another running graph");
    view.is_paused = true;
    assert!(lines(&buffer(&mut view, 80, 24))[0].ends_with("PAUSED"));
}

#[test]
fn counts_take_little_room() {
    assert_eq!([99_999, 100_000, 12_345_678].map(short_count), ["99999", "100k", "12M"]);
}
