//! Names and quotes in messages for people.

use std::path::Path;

/// Longest piece of the file's text that a message repeats, in characters.
pub const MAX_QUOTED_CHARS: usize = 60;
/// Longest path in a message: what Linux allows (PATH_MAX), so that no usable path is cut.
const MAX_PATH_CHARS: usize = 4096;
/// Most names that a message lists.
const MAX_LISTED_NAMES: usize = 16;
/// Longest text for which a similar name is looked for: the cost grows with the square of it, names have 32.
const MAX_SUGGESTED_CHARS: usize = 64;
/// A name becomes part of service and file names, whose length the system limits.
pub const MAX_NAME_CHARS: usize = 32;

/// Whether a text can name a graph, node, port or param.
pub fn is_name(text: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&text.len())
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-')
}

/// Text from the file, in quotes, without control characters, cut when it is long.
pub fn quote(text: &str) -> String {
    quote_up_to(MAX_QUOTED_CHARS, text)
}

/// As [`quote`], but whole.
pub fn quote_path(path: &Path) -> String {
    quote_up_to(MAX_PATH_CHARS, &path.display().to_string())
}

/// `did you mean 'x'?` when a known name is similar.
pub fn did_you_mean<'a>(wrong: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let n_chars = wrong.chars().count();
    if n_chars > MAX_SUGGESTED_CHARS {
        return None;
    }
    // A third of the letters may differ: 'inptus' is 'inputs', 'a' is not 'b'.
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
pub fn list<'a>(what: &str, known: impl IntoIterator<Item = &'a str>) -> String {
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
pub fn did_you_mean_or_list<'a, I>(wrong: &str, what: &str, known: I) -> Option<String>
where
    I: IntoIterator<Item = &'a str> + Clone,
{
    did_you_mean(wrong, known.clone()).or_else(|| Some(list(what, known)))
}

fn quote_up_to(max_chars: usize, text: &str) -> String {
    format!("'{}'", bare(max_chars, text))
}

/// As it stands between quotes.
pub fn bare(max_chars: usize, text: &str) -> String {
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
