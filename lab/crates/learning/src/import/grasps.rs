//! Grasps from the rows of a table: one row each, or the rows that name the same grasp.

use std::collections::{BTreeMap, BTreeSet};

use super::BadRow;
use super::columns::shortened;
use blindgrasp_messages::Phase;

/// Puts the rows of a grasp together.
#[derive(Default)]
pub(super) struct Grasps {
    /// The grasp whose rows are being read.
    open: Option<OpenGrasp>,
    /// The names of earlier grasps.
    closed: BTreeSet<String>,
    /// Whether the row before is a bad one: it may be of the next grasp.
    is_after_bad: bool,
    /// The first line of each value of the label.
    pub(super) first_lines: BTreeMap<String, u64>,
    pub(super) bad_rows: Vec<BadRow>,
}

struct OpenGrasp {
    name: String,
    grasp: TableGrasp,
    has_bad_row: bool,
}

impl Grasps {
    /// Adds a row, with the name of its grasp if rows have one, and returns the grasp that is complete. A row without a name is a
    /// grasp.
    ///
    /// # Errors
    /// A grasp whose rows do not follow each other.
    pub(super) fn add(
        &mut self,
        name: Option<String>,
        row: Result<TableGrasp, BadRow>,
        line: u64,
    ) -> Result<Option<TableGrasp>, String> {
        let row = match row {
            Ok(row) => row,
            Err(bad) => {
                self.add_bad(bad);
                return Ok(None);
            }
        };
        let is_after_bad = std::mem::take(&mut self.is_after_bad);
        self.first_lines.entry(row.label.clone()).or_insert(line);
        let Some(name) = name else { return Ok(Some(row)) };
        if let Some(open) = &mut self.open
            && open.name == name
        {
            if let Err(problem) = open.grasp.add(row) {
                self.add_bad(BadRow { line, problem });
            }
            return Ok(None);
        }
        let complete = self.close();
        if self.closed.contains(&name) {
            let expected = "expected the rows of a grasp one after another; sort the table";
            return Err(format!("line {line}: grasp '{}' again: {expected}", shortened(&name)));
        }
        self.open = Some(OpenGrasp { name, grasp: row, has_bad_row: is_after_bad });
        Ok(complete)
    }

    fn add_bad(&mut self, bad: BadRow) {
        self.bad_rows.push(bad);
        self.is_after_bad = true;
        if let Some(open) = &mut self.open {
            open.has_bad_row = true;
        }
    }

    /// The open grasp.
    pub(super) fn close(&mut self) -> Option<TableGrasp> {
        let OpenGrasp { name, grasp, has_bad_row } = self.open.take()?;
        let has_settled = grasp.readings.iter().any(|reading| reading.phase == Phase::Settled);
        // The settled frame may be in the bad row.
        if !has_settled && !has_bad_row {
            let problem = format!("grasp '{}' has no settled frame", shortened(&name));
            self.bad_rows.push(BadRow { line: grasp.line, problem });
        }
        self.closed.insert(name);
        Some(grasp)
    }
}

/// A grasp of the table.
pub(super) struct TableGrasp {
    /// The line of its first row.
    pub(super) line: u64,
    /// Of each row.
    pub(super) readings: Vec<TableReading>,
    pub(super) label: String,
    pub(super) stable: bool,
    pub(super) object: String,
    pub(super) class: String,
    /// Its name and its number.
    pub(super) day: Option<(String, u32)>,
}

/// A row's reading.
pub(super) struct TableReading {
    pub(super) phase: Phase,
    pub(super) cells: Vec<f64>,
    pub(super) joints: Vec<f64>,
}

impl TableGrasp {
    /// Adds the frame of the grasp's next row; an error if it does not fit.
    fn add(&mut self, next: TableGrasp) -> Result<(), String> {
        let first = self.line;
        let day = |grasp: &TableGrasp| grasp.day.as_ref().map(|(name, _)| name.clone()).unwrap_or_default();
        for (what, ours, theirs) in [
            ("label", &self.label, &next.label),
            ("object", &self.object, &next.object),
            ("class", &self.class, &next.class),
            ("day", &day(self), &day(&next)),
        ] {
            if ours != theirs {
                let (ours, theirs) = (shortened(ours), shortened(theirs));
                return Err(format!("{what} '{theirs}', but '{ours}' in line {first} of the same grasp"));
            }
        }
        if let (Some(before), Some(after)) = (self.readings.last(), next.readings.last())
            && after.phase.is_before(before.phase)
        {
            return Err(format!("phase '{}' after '{}'", after.phase.as_str(), before.phase.as_str()));
        }
        self.readings.extend(next.readings);
        Ok(())
    }
}
