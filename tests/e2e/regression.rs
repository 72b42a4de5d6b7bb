//! The project's recordings through the real processes: every edge is as recorded, and every expectation is met.

use crate::common::{project, run, text};
use serde_json::Value;

#[test]
fn the_projects_recordings_come_out_as_recorded() {
    let output = run(&["test", "--json"], 0);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text(&output.stdout)));
    let files = std::fs::read_dir(project().join("recordings")).expect("readable").flatten();
    let n_expected = files.filter(|file| file.file_name().to_string_lossy().ends_with(".expect.yaml")).count();
    assert_eq!((report["n_passed"].as_u64(), n_expected), (Some(10), 10), "{report}");
    assert_eq!(report["n_failed"], 0, "{report}");
}
