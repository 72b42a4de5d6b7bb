//! Names, mappings and values in a dataflow file.

use crate::dataflow::diagnostic::{Diagnostics, did_you_mean_or_list};
use crate::dataflow::yaml::{Content, Entry, Text, Value};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::text::quote;
use blindgrasp_operator::text::{MAX_NAME_CHARS, is_name};

pub(super) fn check_name(name: &Text, what: &str, diagnostics: &mut Diagnostics) {
    if !is_name(&name.text) {
        let message = format!(
            "{what} {} must be letters (a-z, A-Z), digits, _ and -, at most {MAX_NAME_CHARS}",
            quote(&name.text)
        );
        diagnostics.push(name.at, message);
    }
}

/// The entries of a mapping; none if nothing is there, for example if every line below a key is commented out.
pub(super) fn entries_or_nothing(value: Value, what: &str, diagnostics: &mut Diagnostics) -> Option<Vec<Entry>> {
    if value.is_null() {
        return Some(Vec::new());
    }
    if let Content::Mapping(entries) = value.content {
        return Some(entries);
    }
    diagnostics.push(value.at, format!("{what} must be a mapping, found {}", value.found()));
    None
}

pub(super) fn unknown_key(key: &Text, place: &str, known: &[&str], diagnostics: &mut Diagnostics) {
    let help = did_you_mean_or_list(&key.text, "keys", known.iter().copied());
    diagnostics.push_with_help(key.at, format!("unknown key {}{place}", quote(&key.text)), help);
}

/// An integer within bounds, which the type holds; see [`accept`].
pub(super) fn accept_integer<T: TryFrom<i64>>(
    value: &Value,
    [min, max]: [i64; 2],
    what: &str,
    help: Option<&str>,
    diagnostics: &mut Diagnostics,
) -> Option<T> {
    let kind = ParamKind::Integer { min: Some(min), max: Some(max) };
    T::try_from(accept(value, &kind, what, help, diagnostics)?.as_i64()?).ok()
}

/// A number within bounds; see [`accept`].
pub(super) fn accept_number(
    value: &Value,
    [min, max]: [f64; 2],
    what: &str,
    diagnostics: &mut Diagnostics,
) -> Option<f64> {
    let kind = ParamKind::Number { above: None, min: Some(min), max: Some(max), words: Vec::new() };
    accept(value, &kind, what, None, diagnostics)?.as_f64()
}

/// The value, if it is of this kind; otherwise a diagnostic, with `help` if the kind has no hint of its own.
pub(super) fn accept(
    value: &Value,
    kind: &ParamKind,
    what: &str,
    help: Option<&str>,
    diagnostics: &mut Diagnostics,
) -> Option<serde_json::Value> {
    let (accepted, hint) = match &value.content {
        Content::Scalar { text, plain } => (kind.accept_scalar(text, *plain), kind.help(text, *plain)),
        Content::List(_) | Content::Mapping(_) => (None, None),
    };
    if accepted.is_none() {
        let help = hint.or_else(|| help.map(str::to_owned));
        diagnostics.push_with_help(value.at, format!("{what} must be {kind}, found {}", value.found()), help);
    }
    accepted
}
