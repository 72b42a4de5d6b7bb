//! `blindgrasp reproduce`

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use serde_json::{Value, json};

use super::init;
use super::model::write_at_once;
use super::{Outcome, percent, print_line, stop_signal};
use blindgrasp_messages::files::{partial_path, read_regular};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// The paper trains on 24,640 grasps and tests on 12,320: three folds.
const N_PAPER_GRASPS: u64 = 36_960;
/// The pause between two looks at whether a step has ended.
const POLL: Duration = Duration::from_millis(50);

/// Make the paper's tables and figures, by its method and by ours
///
/// Make Table I, Figures 1 and 2, and Tables II to IV of "Learning Grasp Stability" in a folder, by the paper's method (recipe
/// paper) and by ours (recipe boosted; lifts with a test lift). README.md in the folder has the numbers beside the paper's.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp reproduce --out reproduced\n\n\
                        Ctrl-C interrupts it. The same command then goes on with the step that was interrupted; finished steps \
                        are not repeated.")]
pub(super) struct Arguments {
    /// The folder; made if it is not there.
    #[arg(short, long)]
    out: PathBuf,
    /// Number of simulated grasps: a third is tested, fold by fold.
    #[arg(long, default_value_t = N_PAPER_GRASPS, value_parser = clap::value_parser!(u64).range(60..=10_000_000))]
    grasps: u64,
    /// Number of lift trials of each method.
    #[arg(long, default_value_t = 110, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    trials: u64,
    /// The seed of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON: the steps, and the rows of Table I.
    #[arg(long)]
    json: bool,
}

/// A command whose result is a file: the file is there when the step is done.
struct Step {
    /// The file that gets what the command prints.
    result: &'static str,
    about: &'static str,
    arguments: Vec<String>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = &arguments.out;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    claim(folder, arguments)?;
    for (name, content) in graphs()? {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap_or(folder))?;
        std::fs::write(&path, content).with_context(|| format!("{}", path.display()))?;
    }
    let (steps, stop) = (steps(arguments), stop_signal()?);
    for (idx, step) in steps.iter().enumerate() {
        let result = folder.join(step.result);
        let is_done = result.exists();
        let state = if is_done { "done before" } else { "…" };
        print_diagnostic(&format!("{} of {}: {}, {} {state}", idx + 1, steps.len(), step.about, step.result));
        if !is_done {
            let start = Instant::now();
            carry_out(step, &result, &stop)?;
            print_diagnostic(&format!("{}: {:.0} s", step.result, start.elapsed().as_secs_f64()));
        }
    }
    let table_1 = table_1(folder)?;
    let summary = folder.join("README.md");
    write_at_once(&summary, &summary_text(folder, &table_1)?)?;
    if arguments.json {
        let results: Vec<&str> = steps.iter().map(|step| step.result).collect();
        print_line(
            &json!({ "folder": folder.display().to_string(), "results": results, "table_1": table_1 }).to_string(),
        )?;
    } else {
        print_line(&read_regular(&summary)?)?;
        print_line(&format!("{}: tables, figures and reports", folder.display()))?;
    }
    Ok(Outcome::Done)
}

/// Writes the options to the folder. A folder with other options, or with other files, is refused.
fn claim(folder: &Path, arguments: &Arguments) -> anyhow::Result<()> {
    let path = folder.join("reproduce.json");
    let mine = json!({
        "grasps": arguments.grasps,
        "trials": arguments.trials,
        "seed": arguments.seed,
        "version": env!("CARGO_PKG_VERSION"),
    });
    match read_regular(&path) {
        Ok(text) if serde_json::from_str::<Value>(&text).ok().as_ref() == Some(&mine) => Ok(()),
        Ok(text) => bail!(
            "{} was begun with other options ({}): expected the same ones, or another folder",
            folder.display(),
            text.trim()
        ),
        Err(_) => match std::fs::read_dir(folder)?.next() {
            Some(_) => bail!("{} holds other files: expected a new folder", folder.display()),
            None => write_at_once(&path, &format!("{mine}\n")),
        },
    }
}

/// The files of the two graphs that lift: by the paper's method, and by ours.
fn graphs() -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    let file = |name: &str| {
        let found = init::FILES.iter().find(|(known, _)| *known == name);
        found.map(|(_, content)| content.to_vec()).with_context(|| format!("no file {name}"))
    };
    let ours = String::from_utf8(file("dataflow-live.yaml")?)?;
    let mut papers = ours.clone();
    for (there, instead) in
        [("${PROBE:-test_lift}", "none"), ("${MODEL:-models/barrett-bh8-280-lifts.json}", "paper.json")]
    {
        if !papers.contains(there) {
            bail!("dataflow-live.yaml has no '{there}'");
        }
        papers = papers.replace(there, instead);
    }
    Ok(vec![
        ("dataflow-paper.yaml", papers.into_bytes()),
        ("dataflow-ours.yaml", ours.into_bytes()),
        ("hands/barrett-bh8-280.yaml", file("hands/barrett-bh8-280.yaml")?),
        ("hands/barrett-bh8-280.urdf", file("hands/barrett-bh8-280.urdf")?),
        ("models/barrett-bh8-280-lifts.json", file("models/barrett-bh8-280-lifts.json")?),
    ])
}

fn steps(arguments: &Arguments) -> Vec<Step> {
    let at = |name: &str| arguments.out.join(name).to_string_lossy().into_owned();
    let (grasps, trials, seed) =
        (arguments.grasps.to_string(), arguments.trials.to_string(), arguments.seed.to_string());
    let step = |result, about, words: &[&str]| Step {
        result,
        about,
        arguments: words.iter().map(|word| (*word).to_string()).collect(),
    };
    let data = at("grasps");
    let evaluate = |result, about, split, folds, recipes, more: &[&str]| {
        let words =
            ["evaluate", &data, "--split", split, "--folds", folds, "--recipe", recipes, "--seed", &seed, "--json"];
        step(result, about, &[&words[..], more].concat())
    };
    let lift = |result, about, graph, report| {
        let (graph, report) = (at(graph), at(report));
        let words = ["trials", "--dataflow", &graph, "--trials", &trials, "--seed", &seed, "--report", &report];
        step(result, about, &words)
    };
    vec![
        step(
            "grasps.json",
            "simulate planned grasps",
            &[
                "simulate",
                "--objects",
                "all",
                "--protocol",
                "planned",
                "--grasps",
                &grasps,
                "--seed",
                &seed,
                "--out",
                &data,
                "--json",
            ],
        ),
        evaluate(
            "by-grasp.json",
            "test on other grasps of the same objects, as the paper (Table I, Figures 1 and 2)",
            "grasp",
            "3",
            "paper,boosted,joints",
            &["--report", &at("by-grasp.html"), "--figures", &at("figures")],
        ),
        evaluate(
            "by-object.json",
            "test on new objects",
            "object",
            "3",
            "paper,boosted,joints",
            &["--report", &at("by-object.html")],
        ),
        evaluate(
            "by-class.json",
            "test on new classes",
            "class",
            "3",
            "paper,boosted,joints",
            &["--report", &at("by-class.html")],
        ),
        step(
            "paper.txt",
            "train the paper's SVM for lifts",
            &["train", &data, "--recipe", "paper", "--seed", &seed, "--out", &at("paper.json")],
        ),
        lift("tables-2-to-4-paper.txt", "lift by the paper's method", "dataflow-paper.yaml", "lifts-paper.html"),
        lift("tables-2-to-4-ours.txt", "lift by ours", "dataflow-ours.yaml", "lifts-ours.html"),
    ]
}

/// Runs a step in a process of its own. The result is written only if the step succeeded and was not interrupted: an
/// interrupted step may succeed with a part of its work.
fn carry_out(step: &Step, result: &Path, stop: &AtomicBool) -> anyhow::Result<()> {
    let partial = partial_path(result);
    let out = File::create(&partial).with_context(|| format!("{}", partial.display()))?;
    let program = std::env::current_exe().context("cannot find the running program")?;
    let mut command = Command::new(program);
    command.args(&step.arguments).stdin(Stdio::null()).stdout(out);
    let mut child = command.spawn().context("cannot start a step")?;
    let mut is_told = false;
    let status = loop {
        if let Some(status) = child.try_wait().context("cannot wait for a step")? {
            break status;
        }
        if stop.load(Ordering::Relaxed) && !is_told {
            is_told = true;
            let _ =
                rustix::process::kill_process(rustix::process::Pid::from_child(&child), rustix::process::Signal::TERM);
        }
        std::thread::sleep(POLL);
    };
    let is_interrupted = stop.load(Ordering::Relaxed);
    if is_interrupted || !status.success() {
        let _ = std::fs::remove_file(&partial);
        let end = if is_interrupted { "interrupted".into() } else { status.to_string() };
        bail!("blindgrasp {}: {end}; the same command of reproduce goes on from here", step.arguments.join(" "));
    }
    std::fs::rename(&partial, result).with_context(|| format!("{}", result.display()))
}

/// A row for each split and recipe, with intervals: of the grasps with contact, and of all, among which those without contact
/// are held.
fn table_1(folder: &Path) -> anyhow::Result<Vec<Value>> {
    let mut rows = Vec::new();
    for split in ["grasp", "object", "class"] {
        let path = folder.join(format!("by-{split}.json"));
        let text = read_regular(&path).with_context(|| format!("{}", path.display()))?;
        let report: Value = serde_json::from_str(&text).with_context(|| format!("{}", path.display()))?;
        for judge in report["judges"].as_array().into_iter().flatten() {
            let (judged, all) = (&judge["judged"], &judge["all"]);
            rows.push(json!({
                "new": split,
                "recipe": judge["name"],
                "n_grasps": judged["n_grasps"],
                "accuracy": judged["accuracy"],
                "false_positive_share": judged["false_positive_share"],
                "false_positive_rate": judged["false_positive_rate"],
                "precision": judged["precision"],
                "n_grasps_of_all": all["n_grasps"],
                "accuracy_of_all": all["accuracy"],
                "false_positive_share_of_all": all["false_positive_share"],
            }));
        }
    }
    Ok(rows)
}

fn summary_text(folder: &Path, table_1: &[Value]) -> anyhow::Result<String> {
    let share = |estimate: &Value| {
        let value = percent(estimate["value"].as_f64());
        let interval = ["low", "high"].map(|end| estimate["interval"][end].as_f64());
        match interval {
            [Some(low), Some(high)] => format!("{value} ({:.1}..{:.1})", 100.0 * low, 100.0 * high),
            _ => value,
        }
    };
    let mut text = String::from(
        "# The paper's tables and figures\n\nDang & Allen, \"Learning Grasp Stability\". A robot drops the \
         *lifted ones that are unstable*. In brackets: 95 % intervals, by object where objects or classes are new.\n\n## Table I\n\n| new in the test | \
         recipe | grasps | accuracy | false positives | with contact | accuracy of these | false positives of these | of the \
         unstable of these | lifted ones that are unstable |\n|---|---|---|---|---|---|---|---|---|---|\n| grasps | Dang & Allen \
         | 12,320 | 81.0 % | 8.6 % | | | | | |\n",
    );
    for row in table_1 {
        let dropped = row["precision"]["value"].as_f64().map(|precision| 1.0 - precision);
        text += &format!(
            "| {}s | {} | {} | {} | {} | {} | {} | {} | {} | {} |\n",
            row["new"].as_str().unwrap_or_default().replace("class", "classe"),
            row["recipe"].as_str().unwrap_or_default(),
            row["n_grasps_of_all"],
            share(&row["accuracy_of_all"]),
            share(&row["false_positive_share_of_all"]),
            row["n_grasps"],
            share(&row["accuracy"]),
            share(&row["false_positive_share"]),
            share(&row["false_positive_rate"]),
            percent(dropped),
        );
    }
    text += "\nFalse positives are a share of all grasps, or of those *with contact*, which some cell feels; the others are held. \
             Unlike the paper's, the recipe `paper` leaves out cells that feel the hand itself, sums the forces of a pad over its \
             contacts only (Eq. 2), and decides by a calibrated probability of 0.5. Reports: by-grasp.html, by-object.html, by-class.html.\n\n## Figures\n\nfigures/figure-1.svg is the contact \
             dictionary of the recipe `paper`; figures/figure-2-*.svg are errors by class.\n";
    for (title, name) in [
        ("by the paper's method", "tables-2-to-4-paper.txt"),
        ("with a test lift, by a model of lifts", "tables-2-to-4-ours.txt"),
    ] {
        let path = folder.join(name);
        let table = read_regular(&path).with_context(|| format!("{}", path.display()))?;
        text += &format!("\n## Tables II to IV, {title}\n\n```text\n{}\n```\n", table.trim());
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_graph_of_the_papers_method_makes_no_probe() {
        let graphs = graphs().expect("the files of both");
        let text = String::from_utf8(graphs[0].1.clone()).expect("UTF-8");
        assert!(text.contains("probe: none\n") && text.contains("model: paper.json\n"), "{text}");
        assert!(!text.contains("lifts.json"), "{text}");
    }
}
