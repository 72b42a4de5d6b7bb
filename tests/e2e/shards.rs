//! Shards of `predict`, `export` and `test`: merged, they are the whole, and a hole is refused.

use std::path::Path;

use serde_json::Value;

use crate::common::{MODEL, RECORDING, fails, json_of, project, run, text};

/// Runs the command whole and in three shards, and gives the outputs: what `output` finds for the whole and each shard.
fn outputs(command: &[&str], output: impl Fn(&str, &[&str]) -> Vec<u8>) -> (Vec<u8>, [Vec<u8>; 3]) {
    let of_shard = |shard| output(shard, &[command, &["--shard", shard]].concat());
    (output("whole", command), ["0/3", "1/3", "2/3"].map(of_shard))
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
    let (whole, shards) = outputs(&predict, |_, arguments| run(arguments, 0).stdout);
    let shards = written(folder.path(), shards);
    let [a, b, c] = shards.each_ref().map(String::as_str);
    assert!(run(&["predict", "--merge", a, b, c], 0).stdout == whole, "other lines than the whole");
    fails(&["predict", "--merge", a, c], "0/3 is missing");

    let out = folder.path().join("table.csv");
    let to = ["--out", out.to_str().expect("UTF-8"), "--overwrite"];
    let table = |_: &str, arguments: &[&str]| {
        run(&[arguments, &to].concat(), 0);
        std::fs::read(&out).expect("written")
    };
    let (whole, shards) = outputs(&[&["export", "--features", MODEL], &files[..]].concat(), table);
    let shards = written(folder.path(), shards);
    let [a, b, c] = shards.each_ref().map(String::as_str);
    assert!(table("merged", &["export", "--merge", a, b, c]) == whole, "another table than the whole");
    fails(&[&["export", "--merge", a, b], &to[..]].concat(), "1/3 is missing");
    // A number that is cut off is a number.
    let of_shard = std::fs::read(a).expect("read");
    std::fs::write(a, &of_shard[..of_shard.len() - 4]).expect("written");
    fails(&[&["export", "--merge", a, b, c], &to[..]].concat(), "shard-2: expected a whole table");
    assert!(std::fs::read(&out).expect("kept") == whole, "a refused merge left another table");

    let (_, shards) = outputs(&["test", "--json"], |_, arguments| run(arguments, 0).stdout);
    let [a, b, c] = written(folder.path(), shards);
    let merged = json_of(&["test", "--json", "--merge", &a, &b, &c]);
    assert_eq!(merged["recordings"].as_array().map(Vec::len), Some(10), "{merged}");
    // A failure in a shard is one of the whole.
    let mut failed: Value = serde_json::from_slice(&std::fs::read(&a).expect("read")).expect("JSON");
    failed["recordings"][0]["checks"][0]["has_passed"] = false.into();
    std::fs::write(&a, failed.to_string()).expect("written");
    let output = run(&["test", "--merge", &a, &b, &c], 1);
    assert!(text(&output.stdout).ends_with("10 recordings: 9 passed, 1 failed\n"), "{}", text(&output.stdout));
}
