//! The line of a text on which each row begins, as editors count lines, and a limit of a row's size.
//!
//! The line numbers of the crate csv are those of the end of the row before: one line early after CRLF, more after blank
//! lines.

use std::io::{Error, ErrorKind, Read};

/// The size limit of a row: a header of tens of thousands of cells. A quote that is not closed makes the rest of a table one row.
const MAX_ROW_BYTES: usize = 4 << 20;

/// A text for the crate csv, which would put a row of any size into memory, several times.
pub(crate) struct RowLimit<'a> {
    text: &'a [u8],
    n_row_bytes: usize,
}

impl<'a> RowLimit<'a> {
    pub(crate) fn new(text: &'a [u8]) -> Self {
        RowLimit { text, n_row_bytes: 0 }
    }

    /// Says that the next row begins.
    pub(crate) fn begin_row(&mut self) {
        self.n_row_bytes = 0;
    }
}

impl Read for RowLimit<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        if self.n_row_bytes > MAX_ROW_BYTES {
            let found =
                format!("a row of more than {} MiB: expected that quotes in it are closed", MAX_ROW_BYTES >> 20);
            return Err(Error::new(ErrorKind::InvalidData, found));
        }
        let n_read = self.text.read(buffer)?;
        self.n_row_bytes += n_read;
        Ok(n_read)
    }
}

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
    fn a_quote_that_is_not_closed_takes_no_more_than_a_row_may() {
        let text = [b"a,b\n1,2\n\"", &b"x,\n".repeat(3 << 20)[..]].concat();
        let mut unlimited = csv::Reader::from_reader(&text[..]);
        let rest = unlimited.records().nth(1).expect("a row").expect_err("the rest of the table is one field");
        assert!(rest.to_string().contains("found record with 1 field"), "{rest}");
        let mut limited = csv::Reader::from_reader(RowLimit::new(&text));
        let mut records = limited.records();
        records.next().expect("a row").expect("whole");
        records.reader_mut().get_mut().begin_row();
        let error = records.next().expect("a row").expect_err("no end of the row");
        assert_eq!(error.to_string(), "a row of more than 4 MiB: expected that quotes in it are closed");
        assert!(limited.get_ref().text.len() > text.len() - MAX_ROW_BYTES - (1 << 20), "the rest is not read");
    }

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
