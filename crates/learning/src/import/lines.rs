//! The line of a text on which each row begins, as editors count lines.
//!
//! The line numbers of the crate csv are those of the end of the row before: one line early after CRLF, more after blank
//! lines.

/// Counts lines on the way through a text.
#[derive(Debug)]
pub(crate) struct Lines<'a> {
    text: &'a [u8],
    at: usize,
    line: u64,
}

impl<'a> Lines<'a> {
    pub(crate) fn new(text: &'a [u8]) -> Self {
        Lines { text, at: 0, line: 1 }
    }

    /// The line, from 1, of the row that begins at this byte, or behind the line ends at this byte. Call it in the order of
    /// the rows.
    pub(crate) fn line_of(&mut self, byte: u64) -> u64 {
        let is_end = |byte: u8| byte == b'\n' || byte == b'\r';
        while let Some(&found) = self.text.get(self.at).filter(|found| (self.at as u64) < byte || is_end(**found)) {
            let is_half = found == b'\r' && self.text.get(self.at + 1) == Some(&b'\n');
            self.line += u64::from(is_end(found) && !is_half);
            self.at += 1;
        }
        self.line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_an_editors() {
        for (text, expected) in [
            ("h\na\nb\n", vec![1, 2, 3]),
            ("h\r\na\r\nb", vec![1, 2, 3]),
            ("h\ra\rb", vec![1, 2, 3]),
            ("\n\nh\n\n\na\n\nb", vec![3, 6, 8]),
            ("h\r\n\r\na\r\n\r\n\r\nb\r\n", vec![1, 3, 6]),
            ("h\r\n\"a\r\n\r\na\"\r\nb\r\n", vec![1, 2, 5]),
        ] {
            let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(text.as_bytes());
            let mut lines = Lines::new(text.as_bytes());
            let of = |row: csv::Result<csv::StringRecord>| {
                lines.line_of(row.expect("a row").position().expect("a place").byte())
            };
            assert_eq!(reader.records().map(of).collect::<Vec<_>>(), expected, "{text:?}");
        }
    }
}
