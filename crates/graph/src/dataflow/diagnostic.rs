//! What is wrong with a dataflow file, where, and what to do about it.

use std::fmt;
use std::path::{Path, PathBuf};

use blindgrasp_operator::text::{MAX_QUOTED_CHARS, bare};
pub(super) use blindgrasp_operator::text::{did_you_mean_or_list, list, quote_path};

use crate::dataflow::settings::Override;

/// A place in a dataflow file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
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

/// Everything that is wrong with a dataflow file, in the order of the file, then with overrides. Displayed with one
/// line per mistake.
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
