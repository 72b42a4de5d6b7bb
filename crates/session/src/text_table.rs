//! Tables in text: columns as wide as their longest entry.

/// A table with a row of titles. The first columns are texts, aligned left; the others are numbers, aligned right.
pub struct TextTable {
    rows: Vec<Vec<String>>,
    n_text_columns: usize,
}

impl TextTable {
    pub fn new<T: Into<String>>(titles: impl IntoIterator<Item = T>, n_text_columns: usize) -> TextTable {
        TextTable { rows: vec![titles.into_iter().map(Into::into).collect()], n_text_columns }
    }

    /// A table of texts only.
    pub fn of_texts<T: Into<String>>(titles: impl IntoIterator<Item = T>) -> TextTable {
        TextTable::new(titles, usize::MAX)
    }

    pub fn row(&mut self, entries: impl IntoIterator<Item = String>) {
        self.rows.push(entries.into_iter().collect());
    }

    pub fn is_empty(&self) -> bool {
        self.rows.len() == 1
    }

    /// The lines of the table, without space at their ends.
    pub fn lines(&self) -> Vec<String> {
        let n_columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            self.rows.iter().filter_map(|row| row.get(column)).map(|entry| entry.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..n_columns).map(width).collect();
        let line = |row: &Vec<String>| {
            let entries = row.iter().zip(&widths).enumerate().map(|(column, (entry, &width))| {
                if column < self.n_text_columns { format!("{entry:<width$}") } else { format!("{entry:>width$}") }
            });
            entries.collect::<Vec<_>>().join("  ").trim_end().to_string()
        };
        self.rows.iter().map(line).collect()
    }
}

/// A share as a percentage.
pub fn percent(share: Option<f64>) -> String {
    share.map_or("n/a".into(), |share| format!("{:.1} %", 100.0 * share))
}
