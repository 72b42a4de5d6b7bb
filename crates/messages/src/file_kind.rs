//! The kind of a file that was named in the place of another one, so that an error can say which command takes it.

use std::io::Read;
use std::path::Path;

use crate::files::open_regular;

/// The kind of a file shows in so many bytes.
const MAX_BYTES: u64 = 1 << 16;

/// A kind of file that people give to a command which takes another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum FileKind {
    Empty,
    Recording,
    Model,
    Sensors,
    Dataflow,
    PadLayout,
    FrameLines,
    Json,
    Urdf,
    Table,
    Database,
    Picture,
    Archive,
    Array,
    Pickle,
}

/// Bytes with which a file of that kind begins.
const BEGINNINGS: [(&[u8], FileKind); 13] = [
    (b"\x89MCAP", FileKind::Recording),
    (b"SQLite format 3", FileKind::Database),
    (b"#ROSBAG", FileKind::Database),
    (b"\x89PNG", FileKind::Picture),
    (b"\xff\xd8\xff", FileKind::Picture),
    (b"GIF8", FileKind::Picture),
    (b"%PDF", FileKind::Picture),
    (b"PK\x03\x04", FileKind::Archive),
    (b"\x1f\x8b", FileKind::Archive),
    (b"\x28\xb5\x2f\xfd", FileKind::Archive),
    (b"\x89HDF", FileKind::Array),
    (b"\x93NUMPY", FileKind::Array),
    (b"PAR1", FileKind::Array),
];

impl FileKind {
    /// The kind of a file that begins like this; `None` if it is not known.
    pub fn of(beginning: &[u8]) -> Option<FileKind> {
        if beginning.is_empty() {
            return Some(FileKind::Empty);
        }
        if let Some((_, kind)) = BEGINNINGS.iter().find(|(bytes, _)| beginning.starts_with(bytes)) {
            return Some(*kind);
        }
        // The protocols of pickle that are in use; a text does not begin so.
        if beginning.len() > 1 && beginning[0] == 0x80 && (2..=5).contains(&beginning[1]) {
            return Some(FileKind::Pickle);
        }
        of_text(text(&beginning[..beginning.len().min(MAX_BYTES as usize)])?)
    }

    /// The kind of the file at `path`; `None` if it is not known, or cannot be read.
    pub fn at(path: &Path) -> Option<FileKind> {
        let mut beginning = Vec::new();
        open_regular(path).ok()?.take(MAX_BYTES).read_to_end(&mut beginning).ok()?;
        FileKind::of(&beginning)
    }

    /// What the file is and which command takes it, to stand behind "found".
    pub fn description(self) -> &'static str {
        match self {
            FileKind::Empty => "an empty file",
            FileKind::Recording => {
                "a recording: blindgrasp view shows it, blindgrasp replay plays it, blindgrasp info sums it up"
            }
            FileKind::Model => {
                "a model: blindgrasp model show describes it, and blindgrasp predict MODEL RECORDING decides by it"
            }
            FileKind::Sensors => "a description of healthy sensors: blindgrasp sensors check takes it",
            FileKind::Dataflow => "a dataflow file: blindgrasp run starts it, and blindgrasp view draws it",
            FileKind::PadLayout => {
                "the pad layout of a hand: --hand takes it, blindgrasp info prints it, blindgrasp view draws it"
            }
            FileKind::FrameLines => "frames as lines of JSON: blindgrasp import --lines makes a recording of them",
            FileKind::Json => "JSON of another kind",
            FileKind::Urdf => "a URDF: blindgrasp new hand NAME --urdf FILE makes a hand of it",
            FileKind::Table => "a table: blindgrasp import makes a recording of a table of readings",
            FileKind::Database => {
                "a bag of ROS or a database: write its readings to a table (CSV) for blindgrasp import"
            }
            FileKind::Picture => "a picture or a PDF",
            FileKind::Archive => {
                "a compressed file (.xlsx, .npz and .pt are such files as well): unpack it (.mcap.zstd: zstd -d FILE), or read it in \
                 Python and give the table to blindgrasp.from_table (docs/python.md)"
            }
            FileKind::Array => {
                "a file of arrays: read it in Python and give the table to blindgrasp.from_table (docs/python.md)"
            }
            FileKind::Pickle => "a pickle of Python: docs/operators.md shows how such a model decides in a graph",
        }
    }
}

/// The text of these bytes, without a character that is cut off at their end.
fn text(bytes: &[u8]) -> Option<&str> {
    match std::str::from_utf8(bytes) {
        Ok(text) => Some(text),
        Err(error) if error.error_len().is_none() => std::str::from_utf8(&bytes[..error.valid_up_to()]).ok(),
        Err(_) => None,
    }
}

fn of_text(text: &str) -> Option<FileKind> {
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if text.starts_with('<') {
        return text.contains("<robot").then_some(FileKind::Urdf);
    }
    if text.starts_with(['{', '[']) {
        return Some(of_json(text));
    }
    let has_line = |beginning: &str| text.lines().any(|line| line.starts_with(beginning));
    if has_line("format: blindgrasp-hand") {
        return Some(FileKind::PadLayout);
    }
    if has_line("operators:") {
        return Some(FileKind::Dataflow);
    }
    is_table(text).then_some(FileKind::Table)
}

fn of_json(text: &str) -> FileKind {
    let begin: String = text.chars().take(256).filter(|char| !char.is_whitespace()).collect();
    if begin.contains("\"blindgrasp-model/") {
        FileKind::Model
    } else if begin.contains("\"blindgrasp-sensors/") {
        FileKind::Sensors
    } else if text.contains("\"operators\"") || text.contains("operators:") {
        FileKind::Dataflow
    } else if begin.starts_with('{') && ["\"topic\"", "\"cells\""].iter().any(|key| text.contains(key)) {
        FileKind::FrameLines
    } else {
        FileKind::Json
    }
}

/// Whether the first two lines are divided by the same separator into equally many fields, and are no YAML.
fn is_table(text: &str) -> bool {
    let mut lines = text.lines().filter(|line| !line.trim().is_empty());
    let (Some(header), Some(row)) = (lines.next(), lines.next()) else { return false };
    let n_fields = |line: &str, separator: char| line.matches(separator).count() + 1;
    !header.starts_with(['#', '%', '-'])
        && !header.contains(": ")
        && [',', ';', '\t'].iter().any(|separator| {
            n_fields(header, *separator) > 1 && n_fields(header, *separator) == n_fields(row, *separator)
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_known_by_their_beginning() {
        for (beginning, expected) in [
            (b"".as_slice(), Some(FileKind::Empty)),
            (b"\x89MCAP0\r\n", Some(FileKind::Recording)),
            (b"\x89PNG\r\n", Some(FileKind::Picture)),
            (b"\x80\x04\x95", Some(FileKind::Pickle)),
            (b"{\"format\":\"blindgrasp-model/2\",", Some(FileKind::Model)),
            (b"{\n  \"format\": \"blindgrasp-sensors/1\",", Some(FileKind::Sensors)),
            (b"{\"topic\":\"/tactile\",", Some(FileKind::FrameLines)),
            (b"{\"operators\":{\"a\":{\"params\":{\"topic\":\"/x\"}}}}", Some(FileKind::Dataflow)),
            (b"{version: 1, operators: {}}", Some(FileKind::Dataflow)),
            (b"{\"a\": 1}", Some(FileKind::Json)),
            (b"<?xml version=\"1.0\"?>\n<robot name=\"x\">", Some(FileKind::Urdf)),
            (b"<html>", None),
            (b"# A hand.\nformat: blindgrasp-hand/1\n", Some(FileKind::PadLayout)),
            (b"version: 1\noperators:\n  source:\n", Some(FileKind::Dataflow)),
            (b"a,b\n1,2\n", Some(FileKind::Table)),
            (b"\xef\xbb\xbfa;b\n1;2\n", Some(FileKind::Table)),
            (b"a\tb\n1\t2\n", Some(FileKind::Table)),
            (b"a,b\n", None),
            (b"a: 1, 2\nb: 3, 4\n", None),
            (b"hello\n", None),
            (b"name: \xc3\xa9\xff\n", None),
        ] {
            assert_eq!(FileKind::of(beginning), expected, "{}", String::from_utf8_lossy(beginning));
        }
    }

    #[test]
    fn a_character_that_is_cut_off_hides_no_kind() {
        assert_eq!(FileKind::of(b"a,b\n1,\xc3"), Some(FileKind::Table));
    }
}
