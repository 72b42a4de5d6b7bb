//! An operator that reads tactile frames and says how long they took, for `scripts/benchsuite tactile-source`: from the stamp
//! that the bridge gave them, which must be this machine's CLOCK_BOOTTIME, and from the source's publishing.

use std::collections::BTreeMap;
use std::process::ExitCode;

use blindgrasp_messages::{Prediction, Recorded, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::operator::{self, Operator};
use blindgrasp_operator::stage::{self, Answers, Stage};

#[derive(Default)]
struct Latency {
    from_bridge_nanos: Vec<u64>,
    from_source_nanos: Vec<u64>,
    last_seq: u64,
}

fn main() -> ExitCode {
    let description = OperatorDescription::new("tactile_latency", "Says how long tactile frames took to arrive")
        .input("tactile", TactileFrame::TYPE_NAME, "Frames stamped with this machine's CLOCK_BOOTTIME")
        .output("nothing", Prediction::TYPE_NAME, "Nothing: it answers no frame");
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    stage::run(operator, "tactile", "nothing", 0, BTreeMap::new(), Latency::default())
}

impl Stage for Latency {
    type In = TactileFrame;
    type Out = Prediction;

    fn answer(&mut self, head: &TactileFrameHead, _items: &[f64], now_nanos: u64, _answers: &mut Answers<Prediction>) {
        self.from_bridge_nanos.push(now_nanos.saturating_sub(head.header.stamp_nanos));
        self.from_source_nanos.push(now_nanos.saturating_sub(head.header.origin_nanos));
        self.last_seq = head.header.seq;
    }

    fn on_end(&mut self, _answers: &mut Answers<Prediction>) {
        let quantiles = |nanos: &mut Vec<u64>| {
            nanos.sort_unstable();
            let at = |share: f64| nanos.get((nanos.len() as f64 * share) as usize).or(nanos.last()).copied();
            serde_json::json!({"p50": at(0.5), "p90": at(0.9), "p99": at(0.99), "max": nanos.last()})
        };
        let n_frames = self.from_bridge_nanos.len();
        let report = serde_json::json!({
            "frames": n_frames,
            "last_seq": self.last_seq,
            "from_bridge_nanos": quantiles(&mut self.from_bridge_nanos),
            "from_source_nanos": quantiles(&mut self.from_source_nanos),
        });
        print_diagnostic(&format!("latency {report}"));
    }
}
