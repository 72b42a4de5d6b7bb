//! The parameters of an operator: which values they take, and whether a given value is one of them.

use std::fmt;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::text::{did_you_mean, quote};

/// A parameter of an operator.
///
/// In JSON the fields of its kind stand beside the others:
/// `{"name": "rate", "kind": "number", "above": 0, "words": ["max"], "default": "max", "summary": "Speed of replay"}`.
// `deny_unknown_fields` stands on the kind: it is handed every field that is not named here (a test keeps that).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParamDescription {
    /// Its key under `params`, with the unit where there is one: `timeout_secs`.
    pub name: String,
    #[serde(flatten)]
    pub kind: ParamKind,
    /// The value if a node gives none; a path is relative to the dataflow file's folder. Without a default the param is
    /// required, unless it is `optional`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default: Option<Value>,
    /// It may be left out although it has no default. The operator then does not receive it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
    /// It can be changed while the operator runs.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub live: bool,
    /// One sentence for a person.
    #[serde(default)]
    pub summary: String,
}

/// The values that a param takes. `Display` completes the sentence "must be …".
// The braces of `String {}` are for serde, which would ignore the unknown fields of a variant without fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ParamKind {
    /// A file or folder, relative to the dataflow file's folder. The operator receives it absolute.
    Path {
        /// Whether it must exist before the operator starts (the default). A file that the operator writes need not.
        #[serde(default = "yes", skip_serializing_if = "is_yes")]
        must_exist: bool,
    },
    /// Any text.
    String {},
    /// `true` or `false`.
    Boolean {},
    /// A whole number of 64 bits.
    Integer {
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<i64>,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<i64>,
    },
    /// A finite number, which the operator receives as a float, or one of some words.
    Number {
        /// The value must be greater than this: 0 for a positive number.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        above: Option<f64>,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<f64>,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<f64>,
        /// Words that may stand instead of a number, like `max`.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        words: Vec<String>,
    },
    /// One of some words.
    Choice { values: Vec<String> },
}

impl ParamDescription {
    /// Whether a node must give a value.
    pub fn is_required(&self) -> bool {
        self.default.is_none() && !self.optional
    }

    /// Whether the description itself makes sense.
    pub fn validate(&self) -> Result<(), String> {
        let name = quote(&self.name);
        let fail = |what: &str| Err(format!("param {name} {what}"));
        match &self.kind {
            ParamKind::Choice { values } if values.is_empty() => return fail("has no choices"),
            ParamKind::Integer { min: Some(min), max: Some(max) } if min > max => {
                return fail("has a min greater than its max");
            }
            ParamKind::Number { above: Some(_), min: Some(_), .. } => return fail("has both 'above' and 'min'"),
            ParamKind::Number { above, min, max: Some(max), .. }
                if min.is_some_and(|min| min > *max) || above.is_some_and(|above| above >= *max) =>
            {
                return fail("has a lower bound that leaves nothing below its max");
            }
            _ => {}
        }
        match &self.default {
            Some(_) if self.optional => fail("has a default and is optional; one of them is enough"),
            Some(default) if self.kind.accept(default).is_none() => {
                fail(&format!("has the default {default}, but must be {}", self.kind))
            }
            _ => Ok(()),
        }
    }
}

impl ParamKind {
    /// The value as the operator receives it (a number always as a float), or `None` when it is not of this kind.
    pub fn accept(&self, value: &Value) -> Option<Value> {
        let is_accepted = match self {
            Self::Path { .. } => value.as_str().is_some_and(|path| !path.is_empty()),
            Self::String {} => value.is_string(),
            Self::Boolean {} => value.is_boolean(),
            Self::Integer { min, max } => value
                .as_i64()
                .is_some_and(|value| min.is_none_or(|min| value >= min) && max.is_none_or(|max| value <= max)),
            Self::Number { words, .. } if value.is_string() => is_one_of(value, words),
            Self::Number { above, min, max, .. } => {
                let number = value.as_f64().filter(|number| {
                    above.is_none_or(|above| *number > above)
                        && min.is_none_or(|min| *number >= min)
                        && max.is_none_or(|max| *number <= max)
                })?;
                return serde_json::Number::from_f64(number).map(Value::Number);
            }
            Self::Choice { values } => is_one_of(value, values),
        };
        is_accepted.then(|| value.clone())
    }

    /// Reads a scalar of the file; `plain` when it had no quotes. The kind alone decides what the text means.
    pub fn accept_scalar(&self, text: &str, plain: bool) -> Option<Value> {
        let text = match (self, text) {
            // Programs that read YAML 1.1 write the words on and off as true and false.
            (Self::Choice { values: words } | Self::Number { words, .. }, "true" | "false") if plain => {
                let (word, other) = if text == "true" { ("on", "yes") } else { ("off", "no") };
                let is_it = words.iter().any(|known| known == word) && words.iter().all(|known| known != other);
                if is_it { word } else { text }
            }
            _ => text,
        };
        let value = match self {
            Self::Path { .. } | Self::String {} if plain && is_null(text) => None,
            Self::Path { .. } | Self::String {} | Self::Choice { .. } => Some(Value::from(text)),
            Self::Number { words, .. } if words.iter().any(|word| word == text) => Some(Value::from(text)),
            _ if !plain => None,
            Self::Boolean {} => text.parse::<bool>().ok().map(Value::from),
            Self::Integer { .. } => integer(text).map(Value::from),
            Self::Number { .. } => number(text).map(Value::from),
        };
        self.accept(&value?)
    }

    /// Whether this text (`--set NAME=`) leaves out an optional param: nothing, where nothing is no value.
    pub fn is_left_out(&self, text: &str) -> bool {
        text.is_empty() && self.accept_scalar(text, false).is_none()
    }

    /// A hint about a scalar that was not accepted.
    pub fn help(&self, text: &str, plain: bool) -> Option<String> {
        if !plain && self.accept_scalar(text, true).is_some() {
            return Some("leave the quotes out".to_owned());
        }
        match self {
            Self::Choice { values: words } | Self::Number { words, .. } => {
                did_you_mean(text, words.iter().map(String::as_str))
            }
            Self::Boolean {} => match text.to_lowercase().as_str() {
                "yes" | "on" | "true" => Some("write true".to_owned()),
                "no" | "off" | "false" => Some("write false".to_owned()),
                _ => None,
            },
            _ => None,
        }
    }
}

impl fmt::Display for ParamKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Path { .. } => f.write_str("a path"),
            Self::String {} => f.write_str("a string"),
            Self::Boolean {} => f.write_str("true or false"),
            Self::Integer { min, max } => {
                let bounds = [bound("at least", min.map(show)), bound("at most", max.map(show))];
                write!(f, "an integer{}", joined(bounds))
            }
            Self::Number { above, min, max, words } => {
                let bounds = [
                    bound("above", above.map(show)),
                    bound("at least", min.map(show)),
                    bound("at most", max.map(show)),
                ];
                write!(f, "a number{}", joined(bounds))?;
                words.iter().try_for_each(|word| write!(f, " or {}", quote(word)))
            }
            Self::Choice { values } => {
                let values: Vec<String> = values.iter().map(|value| quote(value)).collect();
                match values.as_slice() {
                    [only] => f.write_str(only),
                    _ => write!(f, "one of {}", values.join(", ")),
                }
            }
        }
    }
}

fn bound(word: &str, bound: Option<String>) -> Option<String> {
    Some(format!("{word} {}", bound?))
}

fn is_one_of(value: &Value, words: &[String]) -> bool {
    value.as_str().is_some_and(|value| words.iter().any(|word| word == value))
}

/// Decimal only: `010` is 8 in YAML 1.1 and 10 in 1.2, so it is neither here.
fn integer(text: &str) -> Option<i64> {
    let digits = text.trim_start_matches(['+', '-']);
    let is_octal = digits.len() > 1 && digits.starts_with('0');
    if is_octal { None } else { text.parse().ok() }
}

/// A finite decimal number, which Rust's words for the others (`inf`, `NaN`, `infinity`) are not.
fn number(text: &str) -> Option<f64> {
    let is_decimal = text.chars().all(|char| matches!(char, '0'..='9' | '.' | '+' | '-' | 'e' | 'E'));
    text.parse().ok().filter(|number: &f64| is_decimal && number.is_finite())
}

fn show(number: impl ToString) -> String {
    number.to_string()
}

fn joined<const N: usize>(bounds: [Option<String>; N]) -> String {
    let bounds: Vec<String> = bounds.into_iter().flatten().collect();
    if bounds.is_empty() { String::new() } else { format!(" {}", bounds.join(" and ")) }
}

/// Whether a plain scalar means "no value" (YAML 1.2, core schema).
pub fn is_null(text: &str) -> bool {
    matches!(text, "" | "~" | "null" | "Null" | "NULL")
}

fn yes() -> bool {
    true
}

fn is_yes(value: &bool) -> bool {
    *value
}
