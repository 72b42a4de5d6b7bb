//! Shards of `predict`, `export` and `test`: merged, they are the whole, and a hole is refused.

use std::path::Path;

use serde_json::Value;

use crate::common::{MODEL, RECORDING, blindgrasp, fails, project, run, text};

/// The output of the command, and those of its three shards.
fn outputs(command: &[&str], output: impl Fn(&[&str]) -> Vec<u8>) -> (Vec<u8>, [Vec<u8>; 3]) {
    (output(command), ["0/3", "1/3", "2/3"].map(|shard| output(&[command, &["--shard", shard]].concat())))
}

/// The outcomes of tests without their times.
fn outcomes(json: &[u8]) -> Value {
    let mut found: Value = serde_json::from_slice(json).expect("JSON");
    found["recordings"].as_array_mut().expect("recordings").iter_mut().for_each(|case| case["secs"] = Value::Null);
    found
}

/// Writes the shards' outputs to files, and gives their paths in another order.
fn written(folder: &Path, outputs: [Vec<u8>; 3]) -> [String; 3] {
    [2, 0, 1].map(|idx: usize| {
        let path = folder.join(format!("shard-{idx}"));
        std::fs::write(&path, &outputs[idx]).expect("written");
        path.to_str().expect("UTF-8").into()
    })
}

#[test]
fn merged_shards_are_the_whole() {
    let folder = tempfile::tempdir().expect("a folder");
    // The copy has no reading of its own, and is of another shard than the first file.
    let copy = folder.path().join("copy.mcap");
    std::fs::copy(project().join(RECORDING), &copy).expect("copied");
    let files = [RECORDING, "recordings/ordinary.mcap", copy.to_str().expect("UTF-8"), "recordings/dead-pad.mcap"];

    let predict = [&["predict", MODEL, "--json"], &files[..]].concat();
    let (whole, shards) = outputs(&predict, |arguments| run(arguments, 0).stdout);
    let shards = written(folder.path(), shards);
    let [a, b, c] = shards.each_ref().map(String::as_str);
    assert!(run(&["predict", "--merge", a, b, c], 0).stdout == whole, "other lines than the whole");
    fails(&["predict", "--merge", a, c], "0/3 is missing");

    let out = folder.path().join("table.csv");
    let to = ["--out", out.to_str().expect("UTF-8"), "--overwrite"];
    let table = |arguments: &[&str]| {
        run(&[arguments, &to].concat(), 0);
        std::fs::read(&out).expect("written")
    };
    let (whole, shards) = outputs(&[&["export", "--features", MODEL], &files[..]].concat(), table);
    let shards = written(folder.path(), shards);
    let [a, b, c] = shards.each_ref().map(String::as_str);
    assert!(table(&["export", "--merge", a, b, c]) == whole, "another table than the whole");
    fails(&[&["export", "--merge", a, b], &to[..]].concat(), "1/3 is missing");
    // A table that is cut off inside a number is still CSV.
    let of_shard = std::fs::read(a).expect("read");
    std::fs::write(a, &of_shard[..of_shard.len() - 4]).expect("written");
    fails(&[&["export", "--merge", a, b, c], &to[..]].concat(), "shard-2: it is not as it was written");
    assert!(std::fs::read(&out).expect("kept") == whole, "a refused merge left another table");

    // One of the recordings fails.
    std::fs::write(copy.with_extension("expect.yaml"), "accuracy_at_least: 1.0\n").expect("written");
    let test = [&["test", "--json", "--dataflow", "dataflow.yaml"], &files[1..]].concat();
    let (whole, shards) = outputs(&test, |arguments| blindgrasp().args(arguments).output().expect("started").stdout);
    let shards = written(folder.path(), shards);
    let [a, b, c] = shards.each_ref().map(String::as_str);
    let merged = run(&["test", "--json", "--merge", a, b, c], 1).stdout;
    assert_eq!(outcomes(&merged), outcomes(&whole));
    assert_eq!(outcomes(&merged)["n_failed"], 1);
    let said = text(&run(&["test", "--merge", a, b, c], 1).stdout);
    assert!(said.contains("FAIL") && said.ends_with("3 recordings: 2 passed, 1 failed\n"), "{said}");
}
