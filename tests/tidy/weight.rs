//! The weight of the project, which may only fall: its numbers stand in weight.txt.

use crate::{files_below, project, read};

/// A longer function does more than one thing.
const MAX_FUNCTION_LINES: usize = 60;
/// A longer sentence is read twice.
const MAX_SENTENCE_WORDS: usize = 35;

/// Methods that hide an `if` or a loop.
const COMBINATORS: &str = "map map_or map_or_else and_then filter filter_map flat_map zip unwrap_or_else ok_or_else then \
                           then_some is_some_and is_none_or find_map take_while skip_while fold chain transpose or_else \
                           get_or_insert_with";

/// These may stand before the `fn` of a function, after `pub(…)`.
const QUALIFIERS: [&str; 6] = ["pub ", "default ", "const ", "async ", "unsafe ", "extern \"C\" "];

#[test]
fn nothing_has_grown() {
    let path = project().join("tests/tidy/weight.txt");
    let text = read(&path);
    let present = weigh(&houses(&text));
    if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
        std::fs::write(&path, remade(&text, &present)).expect("written");
        return;
    }
    let limits = numbers(&text);
    let mut grown = String::new();
    for (name, number) in &present {
        let limit = limits.iter().find(|(of, _)| of == name);
        let Some((_, limit)) = limit else { panic!("tests/tidy/weight.txt has no number of '{name}': add it") };
        if number > limit {
            let by = one_decimal(number - limit);
            grown += &format!("{name}: {number}, which is {by} above the {limit} in tests/tidy/weight.txt\n");
        }
    }
    assert!(
        grown.is_empty(),
        "{grown}Delete something, or raise the number in tests/tidy/weight.txt and say why in the commit."
    );
    assert_eq!(
        limits.len(),
        present.len(),
        "tests/tidy/weight.txt has a number that nothing is compared with: delete it"
    );
}

#[test]
fn only_lines_outside_tests_count_as_the_products() {
    let text = "fn one() {\n}\n#[cfg(test)]\nmod tests {\n    fn two() {}\n}\nfn three() {}";
    assert_eq!(product_lines(text), ["fn one() {", "}", "fn three() {}"]);
    for (path, is_test) in [
        ("tests/e2e/main.rs", true),
        ("crates/stages/tests/arbiter_histories.rs", true),
        ("network/crates/bridge/src/wire/tests.rs", true),
        ("crates/stages/src/shift_test.rs", true),
        ("operators/allocations.rs", true),
        ("src/commands/test/mod.rs", false),
        ("src/commands/tests_of.rs", false),
        ("operators/fit.rs", false),
    ] {
        assert_eq!(is_of_tests(path), is_test, "{path}");
    }
}

#[test]
fn functions_are_as_long_as_from_their_name_to_their_end() {
    let text = "fn a() {}\n    pub(crate) const fn b(\n        x: u8,\n    ) -> u8 {\n        x\n    }\n\n    fn c(&self);\nlet fn_d = 1;";
    assert_eq!(function_lengths(&text.lines().collect::<Vec<_>>()), [1, 5]);
}

#[test]
fn closures_with_a_name_are_counted() {
    let text = "let mut a = |x: u8| x;\nlet b_1 = move || 1;\nlet c = d | e;\nlet (f, g) = |x| x;\na.map(|x| x)";
    assert_eq!(n_local_closures(text), 2);
}

#[test]
fn sentences_are_counted_outside_of_code_and_tables() {
    let long = "word ".repeat(40);
    let text = format!("Short. {long}end.\n```sh\n{long}\n```\n| {long} |\n{}end!\n", "word ".repeat(34));
    assert_eq!(n_long_sentences(&text), 1);
}

/// A house and the beginnings of its paths. What belongs to none of them is the robot's.
type House<'a> = (&'a str, Vec<&'a str>);

/// The lines `house NAME PATH…` of weight.txt.
fn houses(text: &str) -> Vec<House<'_>> {
    let mut houses = Vec::new();
    for line in text.lines() {
        let mut words = line.split_whitespace();
        if words.next() == Some("house") {
            houses.push((words.next().expect("the name of a house"), words.collect()));
        }
    }
    houses
}

/// The other lines of weight.txt, without comments: a name and a number.
fn numbers(text: &str) -> Vec<(String, f64)> {
    let mut numbers = Vec::new();
    for line in text.lines().filter(|line| !is_of_head(line)) {
        let (name, number) =
            line.split_once(' ').unwrap_or_else(|| panic!("weight.txt: '{line}': expected NAME NUMBER"));
        let number = number.parse().unwrap_or_else(|_| panic!("weight.txt: '{line}': expected NAME NUMBER"));
        numbers.push((name.to_owned(), number));
    }
    numbers
}

fn is_of_head(line: &str) -> bool {
    line.is_empty() || line.starts_with('#') || line.starts_with("house ")
}

/// The text of weight.txt with the present numbers.
fn remade(text: &str, present: &[(String, f64)]) -> String {
    let mut remade = String::new();
    for line in text.lines().filter(|line| is_of_head(line)) {
        remade += &format!("{line}\n");
    }
    for (name, number) in present {
        remade += &format!("{name} {number}\n");
    }
    remade
}

fn weigh(houses: &[House<'_>]) -> Vec<(String, f64)> {
    let mut of_houses = vec![0; houses.len()];
    let (mut n_robot, mut n_tests, mut n_long_functions) = (0, 0, 0);
    let (mut n_combinators, mut n_closures) = (0, 0);
    for path in files_below(project(), "rs") {
        let text = read(&path);
        let name = path.strip_prefix(project()).expect("below").to_str().expect("UTF-8");
        let lines = if is_of_tests(name) { Vec::new() } else { product_lines(&text) };
        n_tests += text.split('\n').count() - lines.len();
        match houses.iter().position(|(_, paths)| paths.iter().any(|begin| name.starts_with(begin))) {
            Some(idx) => of_houses[idx] += lines.len(),
            None => n_robot += lines.len(),
        }
        n_long_functions += function_lengths(&lines).iter().filter(|length| **length > MAX_FUNCTION_LINES).count();
        let product = lines.join("\n");
        n_combinators += n_combinators_of(&product);
        n_closures += n_local_closures(&product);
    }
    let pages: Vec<String> = files_below(&project().join("docs"), "md").iter().map(|page| read(page)).collect();

    let mut found = vec![("lines_of_robot".to_owned(), n_robot as f64)];
    for ((house, _), n) in houses.iter().zip(of_houses) {
        found.push((format!("lines_of_{house}"), n as f64));
    }
    for (name, number) in [
        ("lines_of_tests", n_tests as f64),
        ("packages_in_lock", read(&project().join("Cargo.lock")).matches("\nname = ").count() as f64),
        ("combinators", n_combinators as f64),
        ("local_closures", n_closures as f64),
        ("functions_over_60_lines", n_long_functions as f64),
        ("docs_words", pages.iter().map(|page| n_words(page)).sum::<usize>() as f64),
        ("docs_pages", pages.len() as f64),
        ("docs_sentences_over_35_words", pages.iter().map(|page| n_long_sentences(page)).sum::<usize>() as f64),
        ("readme_words", n_words(&read(&project().join("README.md"))) as f64),
    ] {
        found.push((name.to_owned(), number));
    }
    found
}

fn one_decimal(number: f64) -> f64 {
    (10.0 * number).round() / 10.0
}

fn is_of_tests(path: &str) -> bool {
    if path.starts_with("src/commands/test/") {
        return false;
    }
    let mut folders: Vec<&str> = path.split('/').collect();
    let file = folders.pop().unwrap_or_default();
    let is_in = |folder: &str| folders.contains(&folder);
    is_in("tests")
        || is_in("benches")
        || is_in("examples")
        || path.starts_with("fuzz/")
        || ["test.rs", "tests.rs"].contains(&file) && !folders.is_empty()
        || ["_test.rs", "_tests.rs", "recovery_model.rs", "allocations.rs"].iter().any(|end| file.ends_with(end))
        || path.ends_with("outgoing/model.rs")
}

/// The lines outside `#[cfg(test)]`. What stands under it ends with the next brace in the first column.
fn product_lines(text: &str) -> Vec<&str> {
    let mut lines = Vec::new();
    let mut is_test = false;
    for line in text.split('\n') {
        is_test |= line.starts_with("#[cfg(test)]");
        if !is_test {
            lines.push(line);
        }
        if line.starts_with('}') {
            is_test = false;
        }
    }
    lines
}

fn n_combinators_of(text: &str) -> usize {
    COMBINATORS.split(' ').map(|name| text.matches(&format!(".{name}(")).count()).sum()
}

/// Counts `let name = |…|`, with `mut` and `move`.
fn n_local_closures(text: &str) -> usize {
    let mut n = 0;
    for statement in text.split("let ").skip(1) {
        let statement = statement.strip_prefix("mut ").unwrap_or(statement);
        let is_in_name = |letter: char| letter.is_ascii_lowercase() || letter.is_ascii_digit() || letter == '_';
        let value = statement.trim_start_matches(is_in_name);
        let Some(value) = value.strip_prefix(" = ") else { continue };
        if value.strip_prefix("move ").unwrap_or(value).starts_with('|') {
            n += 1;
        }
    }
    n
}

/// How many lines each function has. rustfmt puts its last brace below its `fn`.
fn function_lengths(lines: &[&str]) -> Vec<usize> {
    let mut lengths = Vec::new();
    for (idx, line) in lines.iter().enumerate() {
        let line = line.trim_end();
        if !begins_function(line) || line.ends_with(';') {
            continue;
        }
        if line.ends_with('}') && line.contains('{') {
            lengths.push(1);
            continue;
        }
        let below = &lines[idx + 1..];
        let n_below = below.iter().position(|below| ends_function(below, indent(line))).unwrap_or(below.len());
        lengths.push(n_below + 2);
    }
    lengths
}

fn begins_function(line: &str) -> bool {
    let mut rest = line.trim_start();
    if let Some((_, behind)) = rest.strip_prefix("pub(").and_then(|visible| visible.split_once(") ")) {
        rest = behind;
    }
    for qualifier in QUALIFIERS {
        rest = rest.strip_prefix(qualifier).unwrap_or(rest);
    }
    rest.starts_with("fn ")
}

/// Whether a line ends the function, or the declaration of a trait's function, that begins with this indent.
fn ends_function(line: &str, of_function: usize) -> bool {
    if indent(line) != of_function {
        return false;
    }
    let line = line.trim();
    line.starts_with('}') || line.starts_with(';') || line.ends_with(';')
}

fn indent(line: &str) -> usize {
    line.len() - line.trim_start().len()
}

fn n_words(text: &str) -> usize {
    text.split_whitespace().count()
}

/// Counts the sentences that are too long, without those of code blocks and tables.
fn n_long_sentences(page: &str) -> usize {
    let prose: String = page.split("```").step_by(2).collect();
    let (mut n_long, mut n_words) = (0, 0);
    let is_of_text = |line: &&str| !line.starts_with('|');
    for word in prose.lines().filter(is_of_text).flat_map(str::split_whitespace) {
        n_words += 1;
        // Each long sentence counts once.
        if n_words == MAX_SENTENCE_WORDS + 1 {
            n_long += 1;
        }
        if word.ends_with(['.', '!', '?']) {
            n_words = 0;
        }
    }
    n_long
}
