//! What is wrong with a dataflow file, where, and what to do about it.

use std::fmt;
use std::path::{Path, PathBuf};

use super::settings::Override;

/// Longest piece of the file's text that a message repeats, in characters.
const MAX_QUOTED_CHARS: usize = 60;
/// Longest path in a message: what Linux allows (PATH_MAX), so that no usable path is cut.
const MAX_PATH_CHARS: usize = 4096;
/// Most names that a message lists.
const MAX_LISTED_NAMES: usize = 16;
/// Longest text for which a similar name is looked for: the cost grows with the square of it, names have 32.
const MAX_SUGGESTED_CHARS: usize = 64;

/// A place in a dataflow file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Position {
    /// Line, from 1.
    pub line: usize,
    /// Column in characters (not bytes), from 1.
    pub column: usize,
}

/// One mistake in a dataflow file, or in what is to be set instead. Displayed on one line, as
/// `file:line:column: message; help` or `--set node.param=value: message; help`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// The dataflow file, as the caller named it.
    pub file: PathBuf,
    /// The key or value at fault; `None` when the file could not be read at all, or is not at fault.
    pub at: Option<Position>,
    /// The override at fault, if it is one.
    pub setting: Option<Override>,
    pub message: String,
    /// What to do about it.
    pub help: Option<String>,
}

/// Everything that is wrong with a dataflow file, in the order of the file, then with overrides. Displayed with one line per mistake.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", lines(.diagnostics))]
pub struct DataflowError {
    /// The mistakes, at least one.
    pub diagnostics: Vec<Diagnostic>,
}

/// Collects the mistakes of one file.
#[derive(Debug, Clone)]
pub(super) struct Diagnostics {
    file: PathBuf,
    found: Vec<Diagnostic>,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.setting, self.at) {
            (Some(setting), _) => write!(f, "--set {}:", bare(MAX_QUOTED_CHARS, &setting.to_string()))?,
            (None, Some(Position { line, column })) => write!(f, "{}:{line}:{column}:", self.file.display())?,
            (None, None) => write!(f, "{}:", self.file.display())?,
        }
        write!(f, " {}", self.message)?;
        if let Some(help) = &self.help {
            write!(f, "; {help}")?;
        }
        Ok(())
    }
}

impl Diagnostics {
    pub(super) fn new(file: &Path) -> Self {
        Self { file: file.to_owned(), found: Vec::new() }
    }

    pub(super) fn push(&mut self, at: impl Into<Option<Position>>, message: impl AsRef<str>) {
        self.push_with_help(at, message, None);
    }

    pub(super) fn push_with_help(
        &mut self,
        at: impl Into<Option<Position>>,
        message: impl AsRef<str>,
        help: Option<String>,
    ) {
        self.add(at.into(), None, message.as_ref(), help);
    }

    pub(super) fn push_of_setting(&mut self, setting: &Override, message: impl AsRef<str>, help: Option<String>) {
        self.add(None, Some(setting.clone()), message.as_ref(), help);
    }

    pub(super) fn len(&self) -> usize {
        self.found.len()
    }

    pub(super) fn into_error(mut self) -> DataflowError {
        self.found.sort_by_key(|diagnostic| (diagnostic.setting.is_some(), diagnostic.at));
        DataflowError { diagnostics: self.found }
    }

    fn add(&mut self, at: Option<Position>, setting: Option<Override>, message: &str, help: Option<String>) {
        let (message, help) = (one_line(message), help.map(|help| one_line(&help)));
        self.found.push(Diagnostic { file: self.file.clone(), at, setting, message, help });
    }
}

/// Text from the file, in quotes, without control characters, cut when it is long.
pub(super) fn quote(text: &str) -> String {
    quote_up_to(MAX_QUOTED_CHARS, text)
}

/// As [`quote`], but whole.
pub(super) fn quote_path(path: &Path) -> String {
    quote_up_to(MAX_PATH_CHARS, &path.display().to_string())
}

/// `did you mean 'x'?` when a known name is similar.
pub(super) fn did_you_mean<'a>(wrong: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let n_chars = wrong.chars().count();
    if n_chars > MAX_SUGGESTED_CHARS {
        return None;
    }
    // A third of the letters: 'inptus' is 'inputs', 'a' is not 'b'.
    let max_distance = (n_chars / 3).clamp(1, 3);
    known
        .into_iter()
        .filter(|name| lacks_unit(wrong, name) || name.chars().count().abs_diff(n_chars) <= max_distance)
        .map(|name| (if lacks_unit(wrong, name) { 1 } else { distance(wrong, name) }, name))
        .filter(|&(distance, name)| distance <= max_distance && distance < name.chars().count())
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, name)| format!("did you mean {}?", quote(name)))
}

/// `known keys: a, b`, or that there are none.
pub(super) fn list<'a>(what: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let mut known = known.into_iter();
    let names: Vec<&str> = known.by_ref().take(MAX_LISTED_NAMES).collect();
    if names.is_empty() {
        return format!("there are no {what}");
    }
    let n_more = known.count();
    let more = if n_more == 0 { String::new() } else { format!(" and {n_more} more") };
    format!("known {what}: {}{more}", names.join(", "))
}

/// The similar name, or else all known ones.
pub(super) fn did_you_mean_or_list<'a, I>(wrong: &str, what: &str, known: I) -> Option<String>
where
    I: IntoIterator<Item = &'a str> + Clone,
{
    did_you_mean(wrong, known.clone()).or_else(|| Some(list(what, known)))
}

fn quote_up_to(max_chars: usize, text: &str) -> String {
    format!("'{}'", bare(max_chars, text))
}

/// As it stands between quotes.
fn bare(max_chars: usize, text: &str) -> String {
    let mut shown = String::new();
    for (char_idx, char) in text.chars().enumerate() {
        if char_idx == max_chars {
            shown.push('…');
            break;
        }
        if char.is_control() {
            shown.extend(char.escape_default());
        } else {
            shown.push(char);
        }
    }
    shown
}

/// Whether a name is this one and one more word, as when a unit was left out: 'deadline' for 'deadline_ms'.
fn lacks_unit(wrong: &str, name: &str) -> bool {
    name.strip_prefix(wrong).and_then(|rest| rest.strip_prefix('_')).is_some_and(|unit| !unit.contains('_'))
}

/// Edits between two names; letter case and `-` for `_` count as none.
fn distance(a: &str, b: &str) -> usize {
    let plain = |text: &str| text.to_lowercase().replace('-', "_");
    strsim::osa_distance(&plain(a), &plain(b))
}

/// A program's own error text may have several lines; a diagnostic has one.
fn one_line(text: &str) -> String {
    if !text.contains(char::is_control) {
        return text.to_owned();
    }
    let lines = text.split(char::is_control).map(str::trim).filter(|line| !line.is_empty());
    lines.collect::<Vec<_>>().join(" | ")
}

fn lines(diagnostics: &[Diagnostic]) -> String {
    diagnostics.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}
