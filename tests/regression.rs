//! The project's recordings, through the real processes: every edge as recorded, every expectation met.

mod common;

use common::{run, text};
use serde_json::Value;

#[test]
fn the_projects_recordings_come_out_as_recorded() {
    let output = run(&["test", "--json"], 0);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text(&output.stdout)));
    assert!(report["n_passed"].as_u64() >= Some(1), "{report}");
    assert_eq!(report["n_failed"], 0, "{report}");
}
