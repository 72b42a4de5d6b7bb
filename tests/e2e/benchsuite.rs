//! `scripts/benchsuite`: one subject on a real graph. The figures of the others are measured by hand.

use serde_json::Value;

use crate::common::python::benchsuite;
use crate::common::text;

#[test]
fn a_quick_run_measures_a_graph_watched_by_top() {
    let output = benchsuite(&["top", "--quick", "--no-build", "--json"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for (side, figure) in [("alone", "latency_p50_micros"), ("watched", "top_cpu_percent")] {
        let measured = found["results"]["top"]["medians"][side][figure].as_f64().expect("a figure");
        assert!(measured > 0.0, "{found}");
    }
    assert!(found["command"].as_str().is_some_and(|command| command.contains("top --quick")), "{found}");
}
