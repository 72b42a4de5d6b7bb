//! Names and quotes in messages for people.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::Write;
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

/// A number with its noun: "1 grasp", "240 grasps".
pub fn counted(n: impl Display, noun: &str) -> String {
    let n = n.to_string();
    let ending = if n == "1" { "" } else { "s" };
    format!("{n} {noun}{ending}")
}

/// Lines for a terminal: characters that move its cursor, change its colours or reverse its text are escaped as in JSON, like
/// `\u001b`, so that a line of JSON keeps its meaning. Ends of lines and tabulators stay.
pub fn harmless(lines: &str) -> Cow<'_, str> {
    if !lines.chars().any(commands_a_terminal) {
        return Cow::Borrowed(lines);
    }
    let mut harmless = String::with_capacity(lines.len() + 16);
    for char in lines.chars() {
        if commands_a_terminal(char) {
            harmless += &format!("\\u{:04x}", u32::from(char));
        } else {
            harmless.push(char);
        }
    }
    Cow::Owned(harmless)
}

fn commands_a_terminal(char: char) -> bool {
    let turns_around = matches!(char, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    (char.is_control() && char != '\n' && char != '\t') || turns_around
}

/// Writes whole lines as [`harmless`] text. Bytes that are not UTF-8 are replaced.
pub struct HarmlessWriter<W: Write> {
    to: W,
    /// The begin of a line.
    line: Vec<u8>,
}

impl<W: Write> HarmlessWriter<W> {
    pub fn new(to: W) -> Self {
        HarmlessWriter { to, line: Vec::new() }
    }

    fn write_line(&mut self) -> std::io::Result<()> {
        let line = std::mem::take(&mut self.line);
        self.to.write_all(harmless(&String::from_utf8_lossy(&line)).as_bytes())
    }
}

impl<W: Write> Write for HarmlessWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        for part in bytes.split_inclusive(|byte| *byte == b'\n') {
            self.line.extend_from_slice(part);
            if part.ends_with(b"\n") {
                self.write_line()?;
            }
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.write_line()?;
        self.to.flush()
    }
}

impl<W: Write> Drop for HarmlessWriter<W> {
    fn drop(&mut self) {
        let _ = self.flush();
    }
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
    let [a, b] = [a, b].map(|text| text.to_lowercase().replace('-', "_"));
    strsim::osa_distance(&a, &b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_thing_is_counted_in_the_singular() {
        assert_eq!([0, 1, 2].map(|n| counted(n, "grasp")), ["0 grasps", "1 grasp", "2 grasps"]);
    }

    #[test]
    fn no_byte_of_a_stranger_commands_a_terminal() {
        let evil = "\u{1b}]0;own\u{7}a\u{9b}2Jb\rc\u{202e}\td\n";
        let expected = "\\u001b]0;own\\u0007a\\u009b2Jb\\u000dc\\u202e\td\n";
        assert_eq!(harmless(evil), expected);
        assert!(matches!(harmless("plain, µ, ✓\n"), Cow::Borrowed(_)));
        // JSON keeps its meaning.
        let json = serde_json::json!({ "name": evil }).to_string();
        let read: serde_json::Value = serde_json::from_str(&harmless(&json)).expect("JSON");
        assert_eq!(read["name"], evil);
        let mut written = Vec::new();
        let mut writer = HarmlessWriter::new(&mut written);
        // Two writes divide a character.
        writer.write_all(&evil.as_bytes()[..10]).expect("written");
        writer.write_all(&evil.as_bytes()[10..]).expect("written");
        writer.write_all(b"last").expect("written");
        drop(writer);
        assert_eq!(String::from_utf8(written).expect("UTF-8"), format!("{expected}last"));
    }
}
