//! Grasps of another recording day: judged by the day's baseline, or held because the day is unlike those of the training; the
//! same in a graph as offline, however often the classifier is killed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::common::{Graph, fails, json_lines, json_of, reference, run, swap, text, unique_name};
use crate::import::pincer;
use rand::{Rng as _, RngExt as _};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use serde_json::Value;

/// A grasp is stable if the left pad's first cell reads more than its second one, but for the offsets of the day.
fn table(days: &[(&str, [f64; 3])], n_objects: usize, n_grasps: usize, seed: u64) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut rows = Vec::new();
    for (day, offsets) in days {
        for object in 0..n_objects {
            for _ in 0..n_grasps {
                let felt: [f64; 3] = std::array::from_fn(|_| rng.random_range(1.0..3.0));
                let is_stable = felt[0] + rng.random_range(-0.2..0.2) > felt[1];
                let [a, b, c] = std::array::from_fn(|idx| felt[idx] + offsets[idx]);
                let row = format!("{seed}-{object},{day},{},{a},{b},{c}", if is_stable { "yes" } else { "no" });
                rows.push((rng.next_u64(), row));
            }
        }
    }
    rows.sort();
    rows.iter().fold("object,day,held,l_1,l_2,r_1\n".into(), |mut text: String, (_, row)| {
        writeln!(text, "{row}").expect("written");
        text
    })
}

struct Lab {
    folder: tempfile::TempDir,
    hand: String,
}

impl Lab {
    fn new() -> Lab {
        let folder = tempfile::tempdir().expect("a folder");
        let hand = pincer(folder.path());
        Lab { folder, hand }
    }

    fn at(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().expect("UTF-8").into()
    }

    fn import(&self, table: &str, name: &str, more: &[&str]) -> String {
        let (csv, out) = (self.at("table.csv"), self.at(name));
        std::fs::write(&csv, table).expect("written");
        let fixed = ["--cells", "l_*,r_*", "--label", "held", "--stable-value", "yes", "--group", "object", "--joints"];
        let arguments =
            [&["import", &csv, "--hand", &self.hand], &fixed[..], &["left=0.5", "--out", &out], more].concat();
        run(&arguments, 0);
        out
    }

    fn train(&self, recordings: &[&str], name: &str, more: &[&str]) -> String {
        let out = self.at(name);
        run(
            &[&["train"], recordings, &["--hand", &self.hand, "--recipe", "raw", "--words", "3", "--out", &out], more]
                .concat(),
            0,
        );
        out
    }

    fn evaluate(&self, model: &str, recording: &str) -> Value {
        let output = run(&["evaluate", model, recording, "--hand", &self.hand, "--json"], 0);
        serde_json::from_slice(&output.stdout).expect("JSON")
    }

    fn flow(&self, model: &str, recording: &str) -> PathBuf {
        let hand = &self.hand;
        let path = self.folder.path().join("flow.yaml");
        let text = format!(
            "version: 1\nname: days\noperators:\n  recorded_source:\n    params: {{recording: {recording}, rate: max}}\n  \
             contacts:\n    inputs: {{tactile: recorded_source/tactile}}\n    params: {{hand: {hand}}}\n  encoder:\n    \
             inputs: {{contacts: contacts/contacts}}\n    params: {{model: {model}}}\n  classifier:\n    \
             restart: {{policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}}\n    \
             inputs: {{feature: encoder/feature}}\n    params: {{model: {model}}}\n  lift_arbiter:\n    \
             inputs: {{prediction: classifier/prediction}}\n    params: {{max_age_ms: 600000}}\n"
        );
        std::fs::write(&path, text).expect("written");
        path
    }
}

fn share_right(evaluation: &Value) -> f64 {
    evaluation["score_judged"]["accuracy"].as_f64().expect("judged grasps")
}

/// Decisions by grasp, as lines without times.
fn decided(lines: &[Value]) -> Vec<String> {
    let decisions = lines.iter().filter(|line| line.get("summary").is_none());
    let mut decided: Vec<(u64, String)> = decisions
        .map(|line| (line["grasp_id"].as_u64().expect("an id"), format!("{} {}", line["action"], line["reason"])))
        .collect();
    decided.sort();
    decided.into_iter().map(|(_, words)| words).collect()
}

#[test]
fn another_day_is_judged_by_its_own_baseline_or_held() {
    const TRAINING: [(&str, [f64; 3]); 3] =
        [("2026-11-02", [1.0, 1.0, 0.0]), ("2026-11-03", [3.0, 1.0, 2.0]), ("2026-11-04", [0.5, 2.0, 1.0])];
    let lab = Lab::new();
    let column = ["--day-column", "day"];
    let training = lab.import(&table(&TRAINING, 15, 20, 1), "training.mcap", &column);
    let frames = json_lines(&run(&["export", &training, "--topic", "/tactile"], 0).stdout);
    assert!(frames.iter().any(|frame| frame["data"]["day"] == 20_261_103));
    let another = [("2026-11-24", [1.0, 5.0, 4.0])];
    let other_day = lab.import(&table(&another, 8, 20, 2), "other-day.mcap", &column);

    // Offsets of days hide what a grasp is, unless it is judged by others of its day.
    let baseline = lab.train(&[&training], "baseline.json", &["--day-baseline"]);
    let evaluation = lab.evaluate(&baseline, &other_day);
    assert_eq!(
        evaluation["by_reason"]["no_baseline"], 30,
        "{} {}",
        evaluation["by_reason"], evaluation["score_judged"]
    );
    assert!(share_right(&evaluation) > 0.85, "{} {}", evaluation["by_reason"], evaluation["score_judged"]);

    let out = lab.at("never.json");
    let bound = ["--day-baseline", "--max-drops", "0.1"];
    let fixed = ["train", &training, "--hand", &lab.hand, "--recipe", "raw", "--words", "3", "--out", &out];
    fails(&[&fixed[..], &bound].concat(), "without --day-baseline");

    // A model without a baseline that knows days holds on this one.
    let plain = lab.train(&[&training], "plain.json", &[]);
    let evaluation = lab.evaluate(&plain, &other_day);
    let held = ["no_baseline", "unlike_day", "out_of_distribution"]
        .map(|reason| evaluation["by_reason"][reason].as_u64().unwrap_or_default());
    assert_eq!(
        (held[0] <= 10, held.iter().sum::<u64>()),
        (true, 160),
        "{} {}",
        evaluation["by_reason"],
        evaluation["score_judged"]
    );
    // New grasps of new objects of a known day are judged.
    let known_day = lab.import(&table(&TRAINING[1..2], 8, 20, 3), "known-day.mcap", &column);
    let evaluation = lab.evaluate(&plain, &known_day);
    assert!(evaluation["by_reason"].get("unlike_day").is_none(), "{}", evaluation["by_reason"]);

    // The graph decides the same, although its classifier is killed and swapped.
    let offline = &lab.evaluate(&baseline, &other_day)["by_reason"];
    let flow = lab.flow(&baseline, &other_day);
    let undisturbed = run(&["run", "--json", "--name", &unique_name(), flow.to_str().expect("UTF-8")], 0);
    let lines = json_lines(&undisturbed.stdout);
    assert_eq!(&lines.last().expect("a summary")["summary"]["reasons"], offline);
    let graph = Graph::launch(&unique_name(), &flow, &["--set", "recorded_source.rate=3"]);
    graph.wait_for_decisions(10);
    graph.kill("classifier");
    graph.wait_for_decisions(20);
    swap(&graph, &["classifier", "--probation", "0"], 0);
    graph.wait_for_decisions(20);
    graph.kill("classifier");
    assert_eq!(decided(&graph.finish().decisions), decided(&lines));
}

#[test]
fn labelled_grasps_of_a_day_correct_a_model_for_it() {
    let lab = Lab::new();
    let days = [("a", [1.0, 1.0, 0.0]), ("b", [3.0, 1.0, 2.0])];
    let training = lab.import(&table(&days, 20, 12, 4), "training.mcap", &["--day-column", "day"]);
    let model = lab.train(&[&training], "model.json", &["--day-baseline"]);
    // The same day again, by its name.
    let today = lab.import(&table(&[("c", [2.0, 2.0, 1.0])], 6, 5, 5), "today.mcap", &["--day", "2026-11-24"]);
    let later = lab.import(&table(&[("c", [2.0, 2.0, 1.0])], 6, 10, 6), "later.mcap", &["--day", "20261124"]);
    let adapted = lab.at("today.json");
    let adapt = |recordings: &[&str], exit_code| {
        let fixed = ["--hand", &lab.hand, "--overwrite", "--out", &adapted];
        run(&[&["model", "adapt", &model], recordings, &fixed].concat(), exit_code)
    };
    let said = text(&adapt(&[&today], 0).stdout).to_string();
    assert!(said.contains("of day 20261124") && said.contains("by 30 labelled grasps"), "{said}");
    // The day has its baseline from the first grasp on, and its labelled grasps are left out.
    let evaluation = lab.evaluate(&adapted, &later);
    assert!(
        evaluation["by_reason"].get("no_baseline").is_none(),
        "{} {}",
        evaluation["by_reason"],
        evaluation["score_judged"]
    );
    assert!(share_right(&evaluation) > 0.85, "{} {}", evaluation["by_reason"], evaluation["score_judged"]);
    fails(&["evaluate", &adapted, &today, "--hand", &lab.hand], "trained on every grasp");
    assert_eq!(lab.evaluate(&model, &later)["by_reason"]["no_baseline"], 30);
    // Another day is as before.
    let other = lab.import(&table(&[("d", [2.0, 2.0, 1.0])], 6, 10, 7), "other.mcap", &["--day", "2026-11-25"]);
    assert_eq!(lab.evaluate(&adapted, &other)["by_reason"], lab.evaluate(&model, &other)["by_reason"]);
    for (recordings, expected) in
        [(vec![&today, &other], "grasps of one day"), (vec![&training], "the model was trained on")]
    {
        let recordings: Vec<&str> = recordings.into_iter().map(String::as_str).collect();
        let refused = adapt(&recordings, 1);
        assert!(text(&refused.stderr).contains(expected), "{}", text(&refused.stderr));
    }
    assert!(Path::new(&adapted).exists());
}

#[test]
fn a_model_leaves_out_the_grasps_that_it_was_trained_on() {
    let lab = Lab::new();
    let days = [("a", [1.0, 1.0, 0.0])];
    let rows = table(&days, 12, 12, 8);
    let training = lab.import(&rows, "training.mcap", &[]);
    let model = lab.train(&[&training], "model.json", &[]);
    fails(&["evaluate", &model, &training, "--hand", &lab.hand], "trained on every grasp");
    let shown = json_of(&["model", "show", &model, "--json"]);
    let trained_on = shown["training"]["trained_on"].as_object().expect("objects");
    assert_eq!((trained_on["objects"].as_array().map(Vec::len), trained_on.len()), (Some(12), 1));
    // New grasps of the same objects, and of others, beside those of the training.
    let same_objects = table(&days, 12, 5, 8).replace(".", ".0");
    let mixed = [rows.as_str(), body(&same_objects), body(&table(&days, 4, 5, 9))].concat();
    let mixed = lab.import(&mixed, "mixed.mcap", &[]);
    let trained = &lab.evaluate(&model, &mixed)["trained"];
    let counts = ["trained_objects", "new_objects"].map(|row| trained[row]["n_grasps"].as_u64());
    assert_eq!((&trained["n_left_out"], counts), (&144.into(), [Some(60), Some(20)]), "{trained}");
    let table = run(&["evaluate", &model, &mixed, "--hand", &lab.hand], 0);
    let table = text(&table.stdout).to_string();
    assert!(table.contains("left out: 144 grasps that the model was trained on"), "{table}");
    assert!(table.contains("\ntrained objects ") && table.contains("\nnew objects "), "{table}");
}

/// What docs/results.md says of real grasps on another day.
#[test]
fn a_real_hand_on_another_day_is_judged_or_held() {
    let Some(data) = reference("biotac-sp") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let tables = [
        ("bts3v2_palm_down", "0", "0"),
        ("bts3v2_palm_45", "0.7854", "10000"),
        ("bts3v2_palm_side", "1.5708", "20000"),
        ("other-day-palm_side", "1.5708", "30000"),
    ];
    let recordings = tables.map(|(name, pitch, first)| {
        let (csv, out, pitch) =
            (data.join(format!("{name}.csv")), at(&format!("{name}.mcap")), format!("palm_pitch={pitch}"));
        let csv = csv.to_str().expect("UTF-8");
        let cells = "ff_biotac_*,mf_biotac_*,th_biotac_*";
        let table =
            ["import", csv, "--hand", "shadow-biotac-sp", "--joints", &pitch, "--cells", cells, "--label", "slipped"];
        let rest =
            ["--stable-value", "0", "--group", "object", "--grasp-id-start", first, "--day", name, "--out", &out];
        run(&[&table[..], &rest].concat(), 0);
        out
    });
    let [down, tilted, side, other] = &recordings;
    let judged = |recipe: &str, more: &[&str]| -> Value {
        let model = at(&format!("{recipe}.json"));
        run(&[&["train", down, tilted, side, "--recipe", recipe, "--out", &model], more].concat(), 0);
        json_of(&["evaluate", &model, other, "--json"])
    };
    // The days of the grasps hold, whatever judges them; this recipe is the faster one.
    let plain = judged("boosted", &[]);
    assert_eq!(plain["score"]["n_lift"], 0, "{}", plain["by_reason"]);
    let score = &judged("blend", &["--day-baseline"])["score_judged"];
    let share = |name: &str| score[name].as_f64().expect("a number");
    assert!(share("accuracy") > 0.82 && share("false_positive_rate") < 0.25, "{score}");
}

/// A table without its header.
fn body(table: &str) -> &str {
    table.split_once('\n').expect("a header").1
}
