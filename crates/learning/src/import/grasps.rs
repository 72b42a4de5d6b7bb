//! Grasps from the rows of a table: one row each, or the rows that name the same grasp.

use std::collections::{BTreeMap, BTreeSet};

use super::BadRow;
use super::columns::shortened;
use blindgrasp_messages::Phase;

/// Puts the rows of a grasp together.
#[derive(Default)]
pub(super) struct Grasps {
    by_name: bool,
    /// The grasp whose rows are being read.
    open: Option<OpenGrasp>,
    /// The names of earlier grasps.
    closed: BTreeSet<String>,
    /// Whether the row before has no name that can be read: it may be the first one of the next grasp.
    is_after_nameless: bool,
    /// The first line of each value of the label.
    pub(super) first_lines: BTreeMap<String, u64>,
    pub(super) bad_rows: Vec<BadRow>,
    pub(super) n_grasps_left_out: usize,
    /// The rows of these grasps, and rows that name none.
    pub(super) n_rows_left_out: usize,
}

struct OpenGrasp {
    name: String,
    /// `None` in the place of one with a bad row.
    grasp: Option<TableGrasp>,
    n_rows: usize,
}

impl Grasps {
    /// `by_name`: whether rows name their grasp. Otherwise each row is one.
    pub(super) fn new(by_name: bool) -> Self {
        Grasps { by_name, ..Grasps::default() }
    }

    /// Adds a row with the name of its grasp, and returns the grasp that is complete. A row without a name that can be read may be
    /// of the grasp before it or after it, so neither is complete.
    ///
    /// # Errors
    /// A grasp whose rows do not follow each other.
    pub(super) fn add(
        &mut self,
        (name, row): (Option<String>, Result<TableGrasp, BadRow>),
        line: u64,
    ) -> Result<Option<TableGrasp>, String> {
        if let Ok(grasp) = &row {
            self.first_lines.entry(grasp.label.clone()).or_insert(line);
        }
        let row = row.map_err(|bad| self.bad_rows.push(bad)).ok();
        if !self.by_name {
            if row.is_none() {
                self.leave_out(1);
            }
            return Ok(row);
        }
        let is_after_nameless = std::mem::replace(&mut self.is_after_nameless, name.is_none());
        match (&mut self.open, name) {
            (Some(OpenGrasp { name: open, grasp, n_rows }), name) if name.as_ref().is_none_or(|name| name == open) => {
                *n_rows += 1;
                let so_far = grasp.take();
                *grasp = match so_far.zip(row).map(|(so_far, next)| so_far.followed_by(next)) {
                    Some(Err(problem)) => {
                        self.bad_rows.push(BadRow { line, problem });
                        None
                    }
                    joined => joined.and_then(Result::ok),
                };
                Ok(None)
            }
            (_, None) => {
                self.n_rows_left_out += 1;
                Ok(None)
            }
            (_, Some(name)) => {
                let complete = self.close();
                if self.closed.contains(&name) {
                    let expected = "expected the rows of a grasp one after another; sort the table";
                    return Err(format!("line {line}: grasp '{}' again: {expected}", shortened(&name)));
                }
                self.open = Some(OpenGrasp { name, grasp: if is_after_nameless { None } else { row }, n_rows: 1 });
                Ok(complete)
            }
        }
    }

    /// The open grasp, if it is complete.
    pub(super) fn close(&mut self) -> Option<TableGrasp> {
        let OpenGrasp { name, grasp, n_rows } = self.open.take()?;
        let grasp = grasp.filter(|grasp| {
            let has_settled = grasp.readings.iter().any(|reading| reading.phase == Phase::Settled);
            if !has_settled {
                let problem = format!("grasp '{}' has no settled frame", shortened(&name));
                self.bad_rows.push(BadRow { line: grasp.line, problem });
            }
            has_settled
        });
        self.closed.insert(name);
        if grasp.is_none() {
            self.leave_out(n_rows);
        }
        grasp
    }

    fn leave_out(&mut self, n_rows: usize) {
        self.n_grasps_left_out += 1;
        self.n_rows_left_out += n_rows;
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
    /// The grasp with the frames of its next row; an error if they do not fit together.
    fn followed_by(mut self, next: TableGrasp) -> Result<TableGrasp, String> {
        let first = self.line;
        let day = |grasp: &TableGrasp| grasp.day.as_ref().map(|(name, _)| name.clone()).unwrap_or_default();
        for (what, ours, theirs) in [
            ("label", &self.label, &next.label),
            ("object", &self.object, &next.object),
            ("class", &self.class, &next.class),
            ("day", &day(&self), &day(&next)),
        ] {
            if ours != theirs {
                let (ours, theirs) = (shortened(ours), shortened(theirs));
                return Err(format!("{what} '{theirs}', but '{ours}' in line {first} of the same grasp"));
            }
        }
        let phase = |grasp: &TableGrasp| grasp.readings.last().map(|reading| reading.phase);
        if let (Some(before), Some(after)) = (phase(&self), phase(&next))
            && after.is_before(before)
        {
            return Err(format!("phase '{}' after '{}'", after.as_str(), before.as_str()));
        }
        self.readings.extend(next.readings);
        Ok(self)
    }
}
