//! Forms that make a reader stop, and for which no lint of Clippy looks.

use crate::{files_below, project, read};

/// These ask something of each value. If the closure ignores the value, it is an `if` in disguise.
const ASKING: [&str; 5] = [".filter(", ".take_while(", ".skip_while(", ".is_some_and(", ".is_none_or("];
/// These may ignore a value, as `(0..n).map(|_| draw())` does. A name hides that the value is ignored.
const MAPPING: [&str; 4] = [".map(", ".and_then(", ".filter_map(", ".flat_map("];

#[test]
fn no_closure_hides_that_it_ignores_its_argument() {
    let mut found = Vec::new();
    for path in files_below(project(), "rs") {
        if path.ends_with(file!()) {
            continue;
        }
        let text = read(&path);
        for at in ignored_arguments(&text) {
            let line_idx = text[..at].matches('\n').count();
            let line = text.lines().nth(line_idx).unwrap_or_default().trim();
            found.push(format!("{}:{}: {line}", path.display(), line_idx + 1));
        }
    }
    assert!(found.is_empty(), "write an if instead, or `_` for a value that `map` ignores:\n{}", found.join("\n"));
}

#[test]
fn ignored_arguments_are_found_with_and_without_a_name() {
    for (text, is_banned) in [
        ("a.filter(|_| b)", true),
        ("a.filter(|_reason| b)", true),
        ("a.filter(\n    move |(_, _place): &(u8, u8)| b)", true),
        ("a.is_some_and(|_x| b)", true),
        ("a.map(|_component| b)", true),
        ("a.and_then(|&_x| b)", true),
        ("a.map(|_| b)", false),
        ("a.filter(|(_, x)| x.b)", false),
        ("a.filter(|x| b(x) || c)", false),
        ("a.map(|(_key, value)| value)", false),
        ("a.map(|()| b)", false),
        ("a.filter(is_new)", false),
    ] {
        assert_eq!(!ignored_arguments(text).is_empty(), is_banned, "{text}");
    }
}

/// The places of closures that ignore their argument. The compiler finds those whose argument has a name without `_`.
fn ignored_arguments(text: &str) -> Vec<usize> {
    let mut places = Vec::new();
    for form in ASKING.iter().chain(&MAPPING) {
        for (at, _) in text.match_indices(form) {
            let closure = text[at + form.len()..].trim_start();
            let Some(closure) = closure.strip_prefix("move ").unwrap_or(closure).strip_prefix('|') else { continue };
            let argument = closure.split(['|', ':']).next().unwrap_or_default();
            let is_in_name = |letter: char| letter.is_alphanumeric() || letter == '_';
            let names: Vec<&str> =
                argument.split(|letter| !is_in_name(letter)).filter(|name| !name.is_empty()).collect();
            let is_ignored = names.iter().all(|name| name.starts_with('_'));
            let is_named = names.iter().any(|name| *name != "_");
            if is_ignored && (is_named || ASKING.contains(form)) {
                places.push(at);
            }
        }
    }
    places
}
