//! The part of YAML that a dataflow file uses, as a tree with positions.
//!
//! Scalars stay text: the reader of a value decides what `no` or `1e3` means. Anchors, aliases, tags, directives and
//! further documents are refused, so nothing can be larger than it is written. Keys are unique.

use blindgrasp_operator::param::is_null;
use std::collections::HashMap;

use granit_parser::{Event, Parser, ScalarStyle, Span, StrInput};

use crate::dataflow::diagnostic::{Diagnostics, Position};
use blindgrasp_operator::text::quote;

/// A dataflow file needs five levels; the bound keeps the recursion here shallow.
const MAX_DEPTH: usize = 16;

/// A value of the file.
#[derive(Debug, Clone)]
pub(super) struct Value {
    pub(super) at: Position,
    pub(super) content: Content,
}

#[derive(Debug, Clone)]
pub(super) enum Content {
    /// `plain` when without quotes.
    Scalar {
        text: String,
        plain: bool,
    },
    List(Vec<Value>),
    Mapping(Vec<Entry>),
}

#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) key: Text,
    pub(super) value: Value,
}

/// A piece of text and where it stands.
#[derive(Debug, Clone, Default)]
pub(super) struct Text {
    pub(super) text: String,
    pub(super) at: Position,
}

struct Reader<'a, 'd> {
    parser: Parser<'a, StrInput<'a>>,
    text: &'a str,
    diagnostics: &'d mut Diagnostics,
}

impl Value {
    /// Nothing at all, `~` or `null`.
    pub(super) fn is_null(&self) -> bool {
        matches!(&self.content, Content::Scalar { text, plain: true } if is_null(text))
    }

    /// The value in the words of an error.
    pub(super) fn found(&self) -> String {
        match &self.content {
            Content::Scalar { text, plain: true } if is_null(text) => "nothing".to_owned(),
            Content::Scalar { text, plain: true } => quote(text),
            Content::Scalar { text, plain: false } => format!("the string {}", quote(text)),
            Content::List(_) => "a list".to_owned(),
            Content::Mapping(_) => "a mapping".to_owned(),
        }
    }
}

/// Reads one document. `None`, with a diagnostic, if the text is empty or not such YAML.
pub(super) fn parse(text: &str, diagnostics: &mut Diagnostics) -> Option<Value> {
    if let Some(at) = indenting_tab(text) {
        diagnostics.push_with_help(at, "a tab in the indentation", Some("indent with spaces".to_owned()));
        return None;
    }
    let mut options = granit_parser::options! {
        disallow_directives: true,
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH,
    };
    options.set_emit_comments(false);
    let mut reader = Reader { parser: Parser::new_from_str_with_options(text, options), text, diagnostics };
    reader.document()
}

impl<'a> Reader<'a, '_> {
    fn document(&mut self) -> Option<Value> {
        let mut root = None;
        loop {
            match self.next()? {
                (Event::DocumentStart(..), span) if root.is_some() => {
                    self.diagnostics.push(position(span), "a second document; a dataflow file is one document");
                    return None;
                }
                (Event::StreamStart | Event::DocumentStart(..) | Event::DocumentEnd, _) => {}
                (Event::StreamEnd, _) => break,
                (event, span) => root = Some(self.value(event, span)?),
            }
        }
        let is_missing = root.as_ref().is_none_or(Value::is_null);
        if is_missing {
            self.diagnostics.push(Position { line: 1, column: 1 }, "the file is empty");
            return None;
        }
        root
    }

    fn next(&mut self) -> Option<(Event<'a>, Span)> {
        match self.parser.next() {
            Some(Ok(event)) => Some(event),
            Some(Err(error)) => {
                let at = Position { line: error.marker().line(), column: error.marker().col() + 1 };
                let line = self.text.lines().nth(at.line - 1).unwrap_or_default();
                let help = (line.contains("${") && line.replace("${", "").contains('{'))
                    .then(|| "in braces, a value with ${ needs quotes: {rate: \"${RATE:-10}\"}".to_owned());
                self.diagnostics.push_with_help(at, format!("not valid YAML: {}", error.info()), help);
                None
            }
            // The parser ends with `StreamEnd` or an error, and this is not called afterwards.
            None => Some((Event::StreamEnd, Span::default())),
        }
    }

    fn value(&mut self, event: Event<'a>, span: Span) -> Option<Value> {
        let at = position(span);
        let refused = match &event {
            Event::Alias(_) | Event::UnresolvedAlias(_) => Some("an alias"),
            Event::Scalar(_, _, anchor, tag) => refused_property(*anchor, tag.is_some()),
            Event::SequenceStart(_, anchor, tag) | Event::MappingStart(_, anchor, tag) => {
                refused_property(*anchor, tag.is_some())
            }
            _ => None,
        };
        if let Some(what) = refused {
            let help = Some("write the value out".to_owned());
            self.diagnostics.push_with_help(at, format!("{what} is not allowed in a dataflow file"), help);
            return None;
        }
        let content = match event {
            Event::Scalar(text, style, ..) => {
                Content::Scalar { text: text.into_owned(), plain: style == ScalarStyle::Plain }
            }
            Event::SequenceStart(..) => self.list()?,
            Event::MappingStart(..) => self.mapping()?,
            _ => {
                self.diagnostics.push(at, "not valid YAML: expected a value");
                return None;
            }
        };
        Some(Value { at, content })
    }

    fn list(&mut self) -> Option<Content> {
        let mut items = Vec::new();
        loop {
            match self.next()? {
                (Event::SequenceEnd, _) => return Some(Content::List(items)),
                (event, span) => items.push(self.value(event, span)?),
            }
        }
    }

    fn mapping(&mut self) -> Option<Content> {
        let mut entries = Vec::new();
        let mut first_lines: HashMap<String, usize> = HashMap::new();
        loop {
            let key = match self.next()? {
                (Event::MappingEnd, _) => return Some(Content::Mapping(entries)),
                (event, span) => self.value(event, span)?,
            };
            let at = key.at;
            let Content::Scalar { text, .. } = key.content else {
                self.diagnostics.push(at, format!("a key must be text, found {}", key.found()));
                return None;
            };
            let (event, span) = self.next()?;
            let mut value = self.value(event, span)?;
            if span.is_empty() && matches!(value.content, Content::Scalar { .. }) {
                // A missing value has no position of its own.
                value.at = at;
            }
            match first_lines.get(&text) {
                Some(line) => {
                    let message = format!("duplicate key {}, first given in line {line}", quote(&text));
                    self.diagnostics.push(at, message);
                }
                None => {
                    first_lines.insert(text.clone(), at.line);
                    entries.push(Entry { key: Text { text, at }, value });
                }
            }
        }
    }
}

fn refused_property(anchor: usize, has_tag: bool) -> Option<&'static str> {
    match (anchor, has_tag) {
        (0, false) => None,
        (0, true) => Some("a tag"),
        _ => Some("an anchor"),
    }
}

/// The first tab that indents something. YAML forbids most of them, the parser finds some late and takes others.
fn indenting_tab(text: &str) -> Option<Position> {
    text.lines().enumerate().find_map(|(line_idx, line)| {
        let content = line.trim_start_matches([' ', '\t']);
        let tab_idx = line[..line.len() - content.len()].find('\t')?;
        let indents = !content.trim_end().is_empty() && !content.starts_with('#');
        indents.then_some(Position { line: line_idx + 1, column: tab_idx + 1 })
    })
}

fn position(span: Span) -> Position {
    Position { line: span.start.line(), column: span.start.col() + 1 }
}
