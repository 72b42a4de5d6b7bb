//! The ROS 2 message definitions that recordings carry, made of the declarations.

use crate::{Codes, Header, Recorded};

/// The longest comment line in a definition.
const MAX_COMMENT_COLUMNS: usize = 116;

/// A field's type in a ROS 2 definition.
pub(crate) trait RosType {
    /// E.g. `float64[3]`.
    fn ros_name() -> String;

    /// The comment on each field of this type.
    fn ros_comment() -> String {
        String::new()
    }

    /// The lines of a field of this type.
    fn ros_lines(name: &str) -> String {
        format!("{}{} {name}\n", Self::ros_comment(), Self::ros_name())
    }

    /// The definition of the struct that it consists of; empty for other types.
    fn ros_part() -> String {
        String::new()
    }
}

macro_rules! ros_types {
    ($($type:ty: $name:literal,)+) => {
        $(impl RosType for $type { fn ros_name() -> String { $name.into() } })+
    };
}
ros_types! { bool: "bool", i32: "int32", u32: "uint32", u64: "uint64", f64: "float64", String: "string", }

impl<T: RosType> RosType for Vec<T> {
    fn ros_name() -> String {
        format!("{}[]", T::ros_name())
    }
    fn ros_part() -> String {
        T::ros_part()
    }
}

impl<T: RosType, const N: usize> RosType for [T; N] {
    fn ros_name() -> String {
        format!("{}[{N}]", T::ros_name())
    }
}

/// The definition of a message with these fields and the structs that they consist of.
pub(crate) fn message(fields: &str, parts: &str) -> String {
    // These are not serialised.
    let header = ["origin_nanos", "valid_nanos", "made_by"]
        .iter()
        .fold(Header::ros_part(), |part, field| part.replace(&format!("uint64 {field}\n"), ""));
    format!("blindgrasp_msgs/Header header\n{fields}{header}{parts}")
}

/// The definition of a struct, as it follows that of a message.
pub(crate) fn part(name: &str, fields: &str) -> String {
    format!("{}\nMSG: blindgrasp_msgs/{name}\n{fields}", "=".repeat(80))
}

/// `# 0 open, 1 closing`, in as many lines as it takes.
pub(crate) fn comment_of_codes(codes: &Codes) -> String {
    let mut lines = vec![String::from("#")];
    for (idx, (word, code)) in codes.words.iter().enumerate() {
        let comma = if idx + 1 < codes.words.len() { "," } else { "" };
        let entry = format!(" {code} {word}{comma}");
        match lines.last_mut() {
            Some(line) if line.len() + entry.len() <= MAX_COMMENT_COLUMNS => line.push_str(&entry),
            _ => lines.push(format!("#{entry}")),
        }
    }
    lines.join("\n") + "\n"
}

/// The fields of a message and of the structs in it: changes with them and not with comments.
pub fn signature<M: Recorded>() -> String {
    significant_lines(&M::definition()).collect::<Vec<_>>().join("\n")
}

/// The first line in which two definitions differ, as found and as expected; comments and blank space aside. A line
/// that one of them lacks is empty.
pub fn first_difference(found: &str, expected: &str) -> Option<(String, String)> {
    let (mut found, mut expected) = (significant_lines(found), significant_lines(expected));
    loop {
        match (found.next(), expected.next()) {
            (None, None) => return None,
            (found, expected) if found != expected => {
                return Some((found.unwrap_or_default(), expected.unwrap_or_default()));
            }
            _ => {}
        }
    }
}

fn significant_lines(definition: &str) -> impl Iterator<Item = String> {
    definition.lines().filter_map(|line| {
        let code = line.split('#').next().unwrap_or_default();
        // A type of the same package may be named with it or without.
        let words: Vec<&str> =
            code.split_whitespace().map(|word| word.strip_prefix("blindgrasp_msgs/").unwrap_or(word)).collect();
        (!words.is_empty()).then(|| words.join(" "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn definitions_differ_by_their_fields_only() {
        let ours = "# what\nuint64  seq\n\nfloat64[] values # in order\n";
        assert_eq!(first_difference("uint64 seq\nfloat64[] values\n", ours), None);
        assert_eq!(first_difference("Header header", "blindgrasp_msgs/Header header"), None);
        let other = first_difference("uint64 seq\nfloat32[] values", ours);
        assert_eq!(other, Some(("float32[] values".into(), "float64[] values".into())));
        assert_eq!(first_difference("uint64 seq", ours), Some((String::new(), "float64[] values".into())));
    }
}
