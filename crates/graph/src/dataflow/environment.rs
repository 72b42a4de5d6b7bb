//! Variables of the environment in the values of a dataflow file: `${NAME}`, `${NAME:-DEFAULT}`.

use crate::dataflow::diagnostic::Diagnostics;
use crate::dataflow::yaml::{Content, Value};
use blindgrasp_operator::text::quote;

/// Replaces the variables in all scalars. Keys stay as they are. `variable` looks a variable up.
pub(super) fn fill_in(value: &mut Value, variable: &dyn Fn(&str) -> Option<String>, diagnostics: &mut Diagnostics) {
    match &mut value.content {
        // In braces of YAML a variable needs quotes, and they do not make its value a text.
        Content::Scalar { text, plain } if text.contains("${") => match filled_in(text, variable) {
            Ok(filled) => (*text, *plain) = (filled, true),
            Err((message, help)) => diagnostics.push_with_help(value.at, message, Some(help)),
        },
        Content::Scalar { .. } => {}
        Content::List(items) => items.iter_mut().for_each(|item| fill_in(item, variable, diagnostics)),
        Content::Mapping(entries) => {
            entries.iter_mut().for_each(|entry| fill_in(&mut entry.value, variable, diagnostics));
        }
    }
}

/// The text with its variables, or the mistake and its remedy. A value that is filled in is not searched again.
fn filled_in(text: &str, variable: &dyn Fn(&str) -> Option<String>) -> Result<String, (String, String)> {
    let mut filled = String::new();
    let mut rest = text;
    while let Some(start) = rest.find("${") {
        let (before, from) = rest.split_at(start);
        if let Some(before) = before.strip_suffix('$') {
            filled += before;
            filled += "${";
            rest = &from[2..];
            continue;
        }
        filled += before;
        let Some((inner, after)) = from[2..].split_once('}') else {
            return Err((format!("{}: '${{' without '}}'", quote(text)), "'$${' stands for '${'".to_owned()));
        };
        let (name, default) = inner.split_once(":-").map_or((inner, None), |(name, default)| (name, Some(default)));
        let is_name = name.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
            && name.chars().all(|char| char.is_ascii_alphanumeric() || char == '_');
        if !is_name {
            let message = format!("{} is no name of a variable", quote(name));
            return Err((message, "write ${NAME} or ${NAME:-DEFAULT}; '$${' stands for '${'".to_owned()));
        }
        // As in a shell, ':-' also serves for a variable that is empty.
        match (variable(name).filter(|value| !value.is_empty() || default.is_none()), default) {
            (Some(value), _) => filled += &value,
            (None, Some(default)) => filled += default,
            (None, None) => {
                let message = format!("the variable {} is not set in the environment", quote(name));
                return Err((message, format!("set it, or give it a default: ${{{name}:-DEFAULT}}")));
            }
        }
        rest = after;
    }
    Ok(filled + rest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_and_defaults_are_filled_in_once() {
        let variable = |name: &str| match name {
            "HAND" => Some("left".to_owned()),
            "EMPTY" => Some(String::new()),
            "NESTED" => Some("${HAND}".to_owned()),
            _ => None,
        };
        for (text, expected) in [
            ("hands/${HAND}.yaml", "hands/left.yaml"),
            ("${HAND}${HAND}", "leftleft"),
            ("${NONE:-10}", "10"),
            ("${NONE:-}x", "x"),
            ("${EMPTY:-full}", "full"),
            ("a${EMPTY}b", "ab"),
            ("${NESTED}", "${HAND}"),
            ("$HAND $ 5$", "$HAND $ 5$"),
            ("$${HAND} ${HAND}", "${HAND} left"),
        ] {
            assert_eq!(filled_in(text, &variable), Ok(expected.to_owned()), "{text}");
        }
        for (text, expected) in [
            ("${NONE}", "the variable 'NONE' is not set in the environment"),
            ("${HAND", "'${HAND': '${' without '}'"),
            ("${a b}", "'a b' is no name of a variable"),
            ("${}", "'' is no name of a variable"),
        ] {
            assert_eq!(filled_in(text, &variable).expect_err(text).0, expected);
        }
    }
}
