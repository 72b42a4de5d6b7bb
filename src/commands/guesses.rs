//! The hint for a word, an option or a value that a command does not have: people type what other programs call it.

use std::error::Error as _;
use std::ffi::OsString;
use std::path::Path;

use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_operator::text::{bare, did_you_mean, quote};
use blindgrasp_stages::hand::builtin_names;
use clap::Command;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// Each row: the guesses, the place, the hint. The first row that fits is taken.
///
/// A guess is a command, perhaps with its first argument (`topic list`); an option; the value of an option; or [`WORD`], any
/// argument too many. The place is the command behind which it stands, an option that this command must have (or, of a value,
/// whose value it is), or empty: any. In the hint `…` stands for the rest of the line, `{usage}` for the command's usage and
/// `{hands}` for the built-in hands.
const GUESSES: &[(&[&str], &[&str], &str)] = &[
    // Commands.
    (&["version"], ROOT, "use 'blindgrasp --version'"),
    (
        &["compare", "diff", "regression", "golden"],
        ROOT,
        "use 'blindgrasp test RECORDING', which replays a recording and compares the results with it, or 'blindgrasp evaluate \
         MODEL RECORDING', which compares decisions with labels",
    ),
    (
        &["convert", "save", "dump", "csv", "jsonl", "dataframe", "extract"],
        ROOT,
        "use 'blindgrasp export RECORDING --format csv --out FOLDER'; the other way, 'blindgrasp import' makes a recording of \
         a table",
    ),
    (&["features"], ROOT, "use 'blindgrasp export RECORDING --features MODEL --out FILE'"),
    (
        &["inspect", "describe", "show", "cat", "print", "summary", "summarize", "summarise", "details", "head"],
        ROOT,
        "use 'blindgrasp info FILE' for a recording or a hand, 'blindgrasp model show FILE' for a model, 'blindgrasp ps' for a \
         running graph",
    ),
    (&["recordings", "recording", "dataset", "data", "datasets"], ROOT, "use 'blindgrasp info FOLDER'"),
    (&["quality"], ROOT, "use 'blindgrasp info CASES.json'"),
    (
        &["serve", "ui", "gui", "web", "dashboard", "browser", "page", "rqt", "rqt_graph", "studio"],
        ROOT,
        "use 'blindgrasp view GRAPH' for a graph that runs, or 'blindgrasp run --view' to start one with its page",
    ),
    (
        &["foxglove", "rviz", "rviz2", "rerun", "plotjuggler"],
        ROOT,
        "use 'blindgrasp view GRAPH --foxglove' for a graph that runs, 'blindgrasp view RECORDING' for a recording",
    ),
    (
        &[
            "plot",
            "viz",
            "visualize",
            "visualise",
            "visualizer",
            "draw",
            "render",
            "display",
            "open",
            "picture",
            "image",
        ],
        ROOT,
        "use 'blindgrasp view …'",
    ),
    (
        &["hands", "hand", "gripper", "grippers", "robots", "robot", "layout"],
        ROOT,
        "use 'blindgrasp info NAME' for a hand, or 'blindgrasp new hand NAME --urdf FILE' for your own; built-in: {hands}",
    ),
    (&["urdf"], ROOT, "use 'blindgrasp new hand NAME --urdf FILE'"),
    (&["objects", "object", "meshes", "catalogue", "catalog", "classes"], ROOT, "use 'blindgrasp simulate --list'"),
    (&["models"], ROOT, "use 'blindgrasp model show FILE'"),
    (&["node list", "node info", "nodes", "node"], ROOT, "use 'blindgrasp ps'"),
    (
        &["operators"],
        ROOT,
        "use 'blindgrasp ps' for those of a running graph, 'blindgrasp run --check' for those of a file, 'blindgrasp new \
         operator NAME' for your own",
    ),
    (&["topic echo", "subscribe", "sub", "listen"], ROOT, "use 'blindgrasp echo NODE/PORT'"),
    (&["topic hz", "topic bw", "topic delay"], ROOT, "use 'blindgrasp top', or 'blindgrasp top --json -n 1'"),
    (&["topic pub"], ROOT, "use 'blindgrasp replay RECORDING'"),
    (
        &["topic list", "topic info", "topic", "topics", "edges", "edge"],
        ROOT,
        "use 'blindgrasp ps', which lists the edges",
    ),
    (&["hz", "bw", "rate", "delay", "latency"], ROOT, "use 'blindgrasp top', or 'blindgrasp top --json -n 1'"),
    (&["metrics", "prometheus"], ROOT, "use 'blindgrasp run --metrics PORT', or 'blindgrasp top'"),
    (&["monitor", "watch", "htop", "stats", "stat"], ROOT, "use 'blindgrasp top'"),
    (&["param set", "parameter set"], ROOT, "use 'blindgrasp set NODE.PARAM=VALUE'"),
    (&["param get", "parameter get", "get"], ROOT, "use 'blindgrasp set NODE.PARAM'"),
    (&["param", "params", "parameter", "parameters"], ROOT, "use 'blindgrasp set', which lists the parameters"),
    (&["bag record"], ROOT, "use 'blindgrasp record --out FILE'"),
    (&["bag play"], ROOT, "use 'blindgrasp replay RECORDING'"),
    (&["bag info"], ROOT, "use 'blindgrasp info RECORDING'"),
    (&["bag"], ROOT, "use 'blindgrasp record', 'blindgrasp replay' or 'blindgrasp info'"),
    (&["pub", "publish", "send", "inject", "playback"], ROOT, "use 'blindgrasp replay RECORDING'"),
    (&["capture", "rec"], ROOT, "use 'blindgrasp record --out FILE'"),
    (&["ls", "jobs", "processes", "graphs", "docker"], ROOT, "use 'blindgrasp ps'"),
    (&["kill", "destroy", "terminate", "halt", "quit", "shutdown", "exit"], ROOT, "use 'blindgrasp stop …'"),
    (
        &["delete", "rm", "remove", "clean", "prune"],
        ROOT,
        "use 'blindgrasp stop GRAPH' to end a graph; projects, recordings and models are files, for 'rm'",
    ),
    (
        &["pause", "resume", "step", "debug"],
        ROOT,
        "use 'blindgrasp replay RECORDING --step', which plays frame by frame; a running graph does not pause",
    ),
    (&["reload", "replace", "update-node", "hotswap"], ROOT, "use 'blindgrasp swap NODE'"),
    (&["attach", "exec"], ROOT, "use 'blindgrasp top GRAPH', or 'blindgrasp echo -g GRAPH'"),
    (
        &["daemon", "background", "systemd", "service", "services", "enable"],
        ROOT,
        "use 'blindgrasp run --detach'; docs/machines.md has a unit of systemd",
    ),
    (
        &["deploy", "connect", "ssh", "remote", "machines", "machine", "cluster", "daemonize"],
        ROOT,
        "use 'blindgrasp run --machine NAME' on each machine, and 'blindgrasp ps --machine NAME' for another one \
         (docs/machines.md)",
    ),
    (&["cert", "certs", "certificates", "keygen", "tls"], ROOT, "use 'blindgrasp keys FOLDER --machine NAME'"),
    (&["ros", "ros2", "bridge"], ROOT, "use the operator ros2 in a dataflow file: docs/ros2.md"),
    (
        &["create", "scaffold", "startproject", "project", "setup"],
        ROOT,
        "use 'blindgrasp init FOLDER' for a project, 'blindgrasp new operator NAME' or 'blindgrasp new hand NAME' for a part",
    ),
    (
        &["demo", "example", "examples", "tutorial", "quickstart", "docs", "doc", "guide"],
        ROOT,
        "use 'blindgrasp init demo', then 'blindgrasp run demo/dataflow.yaml'; docs/start.md goes on from there",
    ),
    (&["build", "compile", "make"], ROOT, "use 'blindgrasp run': a graph needs no build"),
    (
        &["install", "update", "upgrade", "uninstall", "self-update"],
        ROOT,
        "docs/install.md tells how blindgrasp is installed and updated; no command does it",
    ),
    (&["check", "validate", "lint", "verify"], ROOT, "use 'blindgrasp run --check …'"),
    (
        &["config", "configure", "settings", "options"],
        ROOT,
        "use 'blindgrasp set' for a running graph, 'blindgrasp run --check' for a dataflow file with all its values",
    ),
    (&["fit", "learn", "teach"], ROOT, "use 'blindgrasp train RECORDING --out MODEL'"),
    (&["retrain", "finetune", "fine-tune", "adapt"], ROOT, "use 'blindgrasp model adapt'"),
    (
        &["score", "eval", "assess", "accuracy", "roc", "cv", "crossval", "cross-validate", "confusion"],
        ROOT,
        "use 'blindgrasp evaluate …'",
    ),
    (&["classify", "infer", "inference", "decide", "judge"], ROOT, "use 'blindgrasp predict MODEL RECORDING'"),
    (
        &["explain", "why", "reason", "reasons"],
        ROOT,
        "use 'blindgrasp predict MODEL RECORDING' for recorded grasps, 'blindgrasp logs' for a graph; docs/hold.md lists the \
         reasons of HOLD",
    ),
    (
        &["calibrate", "tare", "zero", "bias", "offset"],
        ROOT,
        "use the parameter zero_when_open of the source, which subtracts the open hand's readings (docs/hardware.md), or \
         'blindgrasp sensors learn' for how a healthy hand reads",
    ),
    (
        &["bench", "benchmark", "profile", "perf"],
        ROOT,
        "use 'blindgrasp doctor' for this machine, 'blindgrasp top' for a running graph",
    ),
    (&["env", "diagnose", "diag", "sysinfo", "health"], ROOT, "use 'blindgrasp doctor'"),
    (&["sim", "generate", "sample", "synth", "synthesize", "simulation"], ROOT, "use 'blindgrasp simulate …'"),
    (&["lift", "experiment", "trial", "try", "rollout", "mujoco"], ROOT, "use 'blindgrasp trials …'"),
    (
        &["label", "annotate", "labels"],
        ROOT,
        "use 'blindgrasp import --label COLUMN' for a table, 'blindgrasp simulate' for simulated grasps; a bridge reports kept \
         and dropped objects (docs/hardware.md)",
    ),
    (&["repair", "recover", "fix"], ROOT, "use 'blindgrasp info --repair …'"),
    (
        &["merge", "concat", "join", "combine"],
        ROOT,
        "name several recordings, or their folder: train, evaluate, predict, test and info take them together",
    ),
    (
        &["cut", "trim", "slice", "split", "filter"],
        ROOT,
        "use 'blindgrasp replay RECORDING --grasps 3,7-9 --record FILE', or --from and --to",
    ),
    (&["report"], ROOT, "use 'blindgrasp run --report FILE', or 'blindgrasp evaluate MODEL RECORDING --report FILE'"),
    (&["completion", "complete", "autocomplete"], ROOT, "use 'blindgrasp completions …'"),
    (&["log", "journal", "tail", "follow"], ROOT, "use 'blindgrasp logs -f'"),
    (&["history"], ROOT, "use 'blindgrasp logs', or 'blindgrasp info RECORDING' for what was recorded"),
    (&["reset"], ROOT, "use 'blindgrasp swap NODE', which starts an operator anew"),
    (
        &["tune", "optimize", "optimise", "gridsearch", "grid", "sweep", "hyperopt"],
        ROOT,
        "use 'blindgrasp train RECORDING --out MODEL --grid'",
    ),
    (
        &["upload", "download", "push", "pull", "fetch", "sync"],
        ROOT,
        "nothing is kept elsewhere: recordings, models and projects are files",
    ),
    (
        &["importance", "shap", "ablation"],
        ROOT,
        "use 'blindgrasp evaluate RECORDING --split object --recipe boosted,raw,joints', which compares features",
    ),
    (&["sensor"], ROOT, "use 'blindgrasp sensors check' or 'blindgrasp sensors learn'"),
    (
        &["cells", "pads", "taxels", "joints", "heatmap", "tf", "forces", "contacts"],
        ROOT,
        "use 'blindgrasp info HAND' for where they are, 'blindgrasp view RECORDING' or 'blindgrasp view GRAPH' for what they \
         read",
    ),
    (
        &["grasp", "grasps"],
        ROOT,
        "use 'blindgrasp info RECORDING', or 'blindgrasp view RECORDING --grasp 3 --out grasp.html'",
    ),
    (
        &["gate", "decision", "decisions", "result", "results"],
        ROOT,
        "use 'blindgrasp echo decision' for a running graph",
    ),
    (&["trace", "strace"], ROOT, "set the environment variable RUST_LOG=debug, and use 'blindgrasp logs'"),
    (&["python"], ROOT, "use the Python package: docs/python.md"),
    (&["paper", "figures", "tables"], ROOT, "use 'blindgrasp reproduce --out FOLDER'"),
    (&["node", "component", "stage", "package", "pkg", "plugin"], &["new"], "use 'blindgrasp new operator NAME'"),
    (&["gripper", "robot", "layout", "urdf"], &["new"], "use 'blindgrasp new hand NAME --urdf FILE'"),
    (&["model", "classifier"], &["new"], "use 'blindgrasp train RECORDING --out MODEL'"),
    (&["project", "graph", "dataflow", "workspace"], &["new"], "use 'blindgrasp init FOLDER'"),
    (
        &["info", "describe", "inspect", "print", "view", "summary", "get"],
        &["model"],
        "use 'blindgrasp model show FILE'",
    ),
    (&["list", "ls"], &["model"], "models are files: use 'blindgrasp model show FILE'"),
    (&["train", "fit", "new", "create"], &["model"], "use 'blindgrasp train RECORDING --out MODEL'"),
    (&["convert", "save", "dump", "onnx"], &["model"], "use 'blindgrasp model export'"),
    (&["train", "fit", "calibrate"], &["sensors"], "use 'blindgrasp sensors learn'"),
    (&["test", "diagnose", "faults"], &["sensors"], "use 'blindgrasp sensors check'"),
    // Options.
    (&["--output", "--output-file", "--outfile", "--save", "--dest", "--to", "-o", "-O"], &["--out"], "use --out FILE"),
    (&["--to", "--with", "--program", "--by", "--operator"], &["swap"], "use --run PROGRAM, or --set model=FILE"),
    (OUTPUTS, &["new", "init"], "give the folder without an option: {usage}"),
    (OUTPUTS, &["run", "trials"], "use --record FILE for a recording of all edges, --report FILE for a page"),
    (OUTPUTS, &["evaluate"], "use --report FILE for a page, --figures FOLDER for figures, --json for stdout"),
    (OUTPUTS, &["predict"], "the decisions go to stdout: add --json > FILE"),
    (OUTPUTS, &["test"], "use --junit FILE for a report, --keep FOLDER for the recordings of the replays"),
    (OUTPUTS, &["--record"], "use --record FILE for a recording of all edges"),
    (OUTPUTS, &[], "the output goes to stdout: add > FILE"),
    (&["--record-to", "--rec"], &["--record"], "use --record FILE"),
    (&["--html", "--page"], &["--report"], "use --report FILE.html"),
    (&["--html", "--page", "--report"], &["test"], "use --junit FILE"),
    (&["--silent", "-s"], &["--quiet"], "use --quiet"),
    (&["--quiet", "-q", "--silent", "-s"], &[], "add > /dev/null for results, 2> /dev/null for progress"),
    (VERBOSE, &["test"], "each check is printed already; --keep FOLDER keeps the recording of each replay"),
    (
        VERBOSE,
        &["run", "replay", "trials"],
        "set the environment variable RUST_LOG=debug; 'blindgrasp logs' prints the logs",
    ),
    (VERBOSE, &["--json"], "use --json, which prints everything"),
    (VERBOSE, &[], "set the environment variable RUST_LOG=debug"),
    (&["--json"], &["echo"], "leave it out: the lines are JSON"),
    (&["--json"], &["train"], "use 'blindgrasp model show MODEL --json' afterwards"),
    (&["-f", "--fmt"], &["--format"], "use --format NAME"),
    (&["--format", "--fmt", "--csv"], &["info", "predict", "evaluate", "ps", "set"], "use --json"),
    (&["--csv"], &["export"], "use --format csv"),
    (&["--dry-run", "--validate", "--lint", "--no-run"], &["--check"], "use --check"),
    (&["--dry-run"], &["swap"], "use --shadow TIME, which compares and swaps nothing"),
    (&["--dry-run"], &["--print-options"], "use --print-options, which prints the options and stops"),
    (&["--dry-run", "--validate"], &[], "use 'blindgrasp run --check', which checks a dataflow file"),
    (SPEED, &["--rate"], "use --rate 2x, or --rate max"),
    (
        SPEED,
        &["run"],
        "use --set recorded_source.rate=2, or =max; 'blindgrasp replay RECORDING --rate 2x' plays another recording",
    ),
    (&["--repeat", "--forever"], &["--loop"], "use --loop"),
    (&["--loop", "--repeat", "--forever"], &["run"], "use --set recorded_source.repeat=forever"),
    (
        &["--recording", "--input", "--source", "--bag", "--data", "-i"],
        &["run"],
        "use --set recording=FILE, or 'blindgrasp replay RECORDING'",
    ),
    (&["--grasps", "--count", "-n", "--n", "--samples"], &["run"], "use 'blindgrasp replay RECORDING --grasps 0-9'"),
    (&["--headless", "--no-view", "--no-gui", "--no-ui"], &["run"], "leave it out: nothing is shown without --view"),
    (&["--once", "--no-loop"], &["run"], "leave it out: the graph ends with its source"),
    (&["--watch", "--top"], &["run"], "use 'blindgrasp top', or --view"),
    (&["--env", "-e"], &["run"], "set variables before the command, as in NAME=VALUE blindgrasp run"),
    (&["--seed"], &["replay"], "leave it out: nothing in it is random"),
    (&["--seed"], &["run"], "use --set seed=N for a simulated hand; nothing else is random"),
    (
        &["--no-color", "--no-colour", "--color", "--colour"],
        &[],
        "set the environment variable NO_COLOR=1; there are no colours without a terminal",
    ),
    (&["--delay", "-d", "-i", "--refresh", "--period"], &["--interval"], "use --interval TIME"),
    (&["--field", "--filter", "--grep", "--jq"], &["echo"], "filter the lines, as by jq"),
    (&["--csv", "--format"], &["echo"], "use 'blindgrasp record', then 'blindgrasp export RECORDING --format csv'"),
    (&["--rate", "--hz"], &["echo"], "use 'blindgrasp top'"),
    (&["-f", "--follow", "--watch", "-w"], &["echo", "top"], "leave it out: it goes on until Ctrl-C"),
    (&["-t", "--timestamps", "--time"], &["logs"], "leave it out: each line has its time"),
    (&["--node"], &["logs", "swap"], "name the node without an option: {usage}"),
    (&["--operator"], &["logs"], "name the node without an option: {usage}"),
    (&["--compression", "--compress", "--zstd"], &["--rotate-size"], "leave it out: recordings are compressed"),
    (&["--split", "--max-size", "--max-bag-size"], &["--rotate-size"], "use --rotate-size SIZE"),
    (&["--max-bag-duration"], &["--rotate-every"], "use --rotate-every TIME"),
    (&["--append"], &["--rotate-size"], "a recording is not continued: name another file"),
    (&["-l"], &["--loop"], "use --loop"),
    (&["--pause", "--start-paused", "--interactive"], &["--step"], "use --step"),
    (&["--duration", "--time", "--for"], &["replay"], "use --from TIME and --to TIME"),
    (&["--topic", "--topics"], &["replay"], "use --replace NODE: the recorded output of that node is played"),
    (
        &["--label-column", "--target", "--labels", "--y"],
        &["train", "evaluate"],
        "leave it out: labels are in the recordings; 'blindgrasp import --label COLUMN' puts them there",
    ),
    (&["--features"], &["--recipe"], "use --recipe NAME, which chooses features and learner"),
    (
        &["--kernel", "--C", "--degree"],
        &["train"],
        "use --recipe paper, an SVM with an RBF kernel, and --c and --gamma",
    ),
    (
        &["--metrics", "--metric", "--confusion-matrix", "--plot", "--roc", "--curve", "--figure"],
        &["evaluate"],
        "leave it out: all metrics are printed; --report FILE and --figures FOLDER have the curves",
    ),
    (&["--proba", "--probability", "--probabilities"], &["predict"], "leave it out: p is the probability of stable"),
    (&["--grasp", "--grasps"], &["predict"], "leave it out: every grasp is printed; --json is for jq"),
    (
        &["--render", "--gui", "--headless", "--viz", "--display", "--view", "--show"],
        &["simulate", "trials"],
        "leave it out: nothing is shown while it runs; 'blindgrasp view RECORDING' shows simulated grasps, trials --report \
         FILE draws trials",
    ),
    (&["--resume", "--continue"], &["simulate", "reproduce"], "leave it out: the same command goes on with its folder"),
    (&["--format", "--csv"], &["simulate"], "use 'blindgrasp export RECORDING --format csv' afterwards"),
    (&["--sep", "--separator", "-d"], &["--delimiter"], "use --delimiter CHARACTER, or tab"),
    (&["--degrees", "--deg", "--radians", "--rad"], &["--joint-unit"], "use --joint-unit deg or rad"),
    (&["--target", "--outcome", "--success", "--y"], &["--stable-value"], "use --label COLUMN and --stable-value TEXT"),
    (&["--object", "--objects"], &["import"], "use --group COLUMN"),
    (&["--scale", "--factor", "--gain"], &["--newtons-per-unit"], "use --newtons-per-unit N"),
    (&["--skip-errors", "--ignore-errors", "--on-bad-lines"], &["--skip-bad-rows"], "use --skip-bad-rows"),
    (
        &["--columns", "--features", "--sensors", "--taxels", "--pads"],
        &["import"],
        "use --cells PATTERNS and --joint-columns PATTERNS",
    ),
    (&["--header", "--encoding", "--no-header"], &["import"], "the table needs a line of names first, and UTF-8"),
    (&["--json", "--jsonl"], &["export"], "leave it out: JSON lines are written without --format"),
    (&["--columns", "--fields", "--select"], &["export"], "use --topic NAME, and select columns afterwards"),
    (&["--grasp", "--grasps"], &["export"], "use 'blindgrasp replay RECORDING --grasps 3,7-9 --record FILE' first"),
    (&["--all", "--summary", "--stats", "--topics", "--contents", "-a"], &["info"], "leave it out: {usage}"),
    (&["--model", "-m"], &["info"], "use 'blindgrasp model show FILE'"),
    (
        &["--host", "--address", "--bind", "--ip"],
        &["view", "run"],
        "the page is on 127.0.0.1 alone: ssh -L PORT:127.0.0.1:PORT leads to it from another machine",
    ),
    (&["--png", "--pdf", "--svg", "--html", "--image"], &["view"], "use --out FILE.svg or FILE.html"),
    (&["--force", "-f"], &["swap"], "use --allow-mismatch, if a mismatch was refused"),
    (&["-a"], &["stop"], "use --all"),
    (&["--wait"], &["stop", "swap", "set"], "leave it out: it waits"),
    (&["--repair", "--apply"], &["--fix"], "use --fix"),
    (&["--force", "-f", "--overwrite"], &["init", "new"], "choose a new name: nothing is overwritten"),
    (&["--template", "--type", "--list"], &["init"], "use --hand NAME for the project of another hand"),
    (
        &["--rust", "--lang", "--language", "-l"],
        &["--python"],
        "use --python for Python; without it the operator is in Rust",
    ),
    (
        &["--mjcf", "--xml", "--mujoco"],
        &["new"],
        "use 'python3 -P -m blindgrasp.mjcf hand.xml hand.urdf' first (docs/hand.md)",
    ),
    (&["--file", "--robot", "--model"], &["--urdf"], "use --urdf FILE"),
    (&["--node"], &["set"], "write the node before the parameter: NODE.PARAM=VALUE"),
    (&["--shell"], &["completions"], "give the shell without an option: {usage}"),
    (&["--weights", "--checkpoint", "-m"], &["--model"], "use --model FILE"),
    (
        &["--model", "--weights", "--checkpoint", "-m"],
        &["predict", "evaluate"],
        "give the model's file without an option: {usage}",
    ),
    (&["--model", "-m"], &["train"], "use --out FILE for the model's file, --recipe NAME for its kind"),
    (&["--model", "--weights", "--checkpoint", "-m"], &["view"], "use --shadow FILE, which judges by a model as well"),
    (&["--model", "--weights", "--checkpoint", "-m"], &["--set"], "use --set model=FILE"),
    (
        &["--algorithm", "--algo", "--method", "--classifier", "--learner", "--estimator"],
        &["--recipe"],
        "use --recipe NAME",
    ),
    (&["--robot", "--gripper", "--layout"], &["--hand"], "use --hand NAME"),
    (&["--hand", "--robot", "--gripper"], &["--set"], "use --set hand=FILE"),
    (&["--object", "--obj", "--class", "--item", "--mesh"], &["--objects"], "use --objects NAMES"),
    (COUNTS, &["simulate", "reproduce"], "use --grasps N"),
    (COUNTS, &["trials"], "use --trials N"),
    (&["--episodes", "--n-trials", "--num-trials", "--rollouts", "--grasps"], &["trials"], "use --trials N"),
    (COUNTS, &["replay"], "use --grasps IDS, as 0-9 for the first ten"),
    (COUNTS, &["echo"], "use --samples N (-n N)"),
    (&["--tail", "--last", "--count", "--n"], &["logs"], "use --lines N (-n N)"),
    (&["--count", "--n", "--samples"], &["top"], "use --iterations N (-n N)"),
    (&["--duration", "--time", "--seconds", "--secs", "--timeout"], &["--for"], "use --for TIME"),
    (&["--timeout"], &["swap"], "use --ready-limit TIME"),
    (
        &["--duration", "--time", "--for", "--timeout"],
        &["run"],
        "use 'timeout 10 blindgrasp run …': a run ends with its source, at Ctrl-C or by 'blindgrasp stop'",
    ),
    (&["--random-state", "--random-seed"], &["--seed"], "use --seed N"),
    (
        &["--threads", "--jobs", "-j", "--n-jobs", "--workers", "--cpus", "--parallel", "--num-workers"],
        &[],
        "all processors are used; the environment variable RAYON_NUM_THREADS=N makes it fewer",
    ),
    (&["--gpu", "--cuda"], &[], "leave it out: nothing here needs a GPU"),
    (
        &[
            "--epochs",
            "--iterations",
            "--lr",
            "--learning-rate",
            "--n-estimators",
            "--max-depth",
            "--depth",
            "--rounds",
        ],
        &["train"],
        "use --grid, which searches the learner's own parameters; --c and --gamma are those of an SVM",
    ),
    (
        &["--test-size", "--split", "--validation", "--val", "--holdout", "--cv", "--folds", "-k"],
        &["train"],
        "train cross-validates by itself; 'blindgrasp evaluate RECORDING --split object --folds 5' judges by folds",
    ),
    (&["--cv", "--kfold", "-k", "--n-splits"], &["--folds"], "use --split object --folds 5"),
    (
        &["--config", "--config-file", "--conf", "--file", "-f", "-c", "--dataflow", "--graph"],
        &["run"],
        "give the dataflow file without an option: {usage}",
    ),
    (&["--force", "-f", "--yes", "-y", "--clobber", "--replace", "--exist-ok"], &["--overwrite"], "use --overwrite"),
    (
        &["--force", "-f", "-9", "--kill", "--now", "--timeout"],
        &["stop"],
        "leave it out: what has not ended by itself is killed after the time of run --grace, 10 s by default",
    ),
    (
        &["--threshold", "--cutoff", "--min-probability"],
        &["predict"],
        "the threshold is the model's: 'blindgrasp train --threshold PROBABILITY' sets it",
    ),
    (
        &["--cutoff", "--min-probability"],
        &["evaluate"],
        "use --threshold PROBABILITY for --predictions; a model has its own",
    ),
    (
        &["--threshold", "--cutoff", "--min-probability"],
        &["--set"],
        "use --set lift_arbiter.min_probability_stable=PROBABILITY, which raises the model's threshold",
    ),
    (&["--daemon", "--background", "-b", "--bg"], &["--detach"], "use --detach"),
    (
        &["--param", "--params", "--parameter", "-p", "--define", "-D", "--override"],
        &["--set"],
        "use --set [NODE.]PARAM=VALUE",
    ),
    (&["--graph", "-g", "--running"], &["view"], "give the graph's name without an option: {usage}"),
    (&["--config", "--conf", "--graph"], &["--dataflow"], "use --dataflow FILE"),
    (&["--port", "--ui", "--web", "--gui", "--browser", "--dashboard", "--open"], &["--view"], "use --view[=PORT]"),
    (
        &["--web", "--ui", "--gui", "--browser", "--page"],
        &["view"],
        "leave it out: view opens the page of a running graph or a recording, and prints its address",
    ),
    (&["--rviz", "--rerun", "--studio"], &["--foxglove"], "use --foxglove for the samples of a running graph"),
    (
        &["--sim", "--simulate", "--simulated", "--simulation", "--mujoco"],
        &["run"],
        "use 'blindgrasp trials', which runs a graph on a simulated hand, or 'blindgrasp simulate'",
    ),
    (
        &["--live", "--real", "--hardware"],
        &["run"],
        "use 'blindgrasp run dataflow-live.yaml' and a bridge that sends the frames (docs/hardware.md)",
    ),
    (&["--topics", "--topic", "-t", "--edge"], &["--edges"], "use --edges NODE/PORT"),
    (&["--topics", "-t"], &["--topic"], "use --topic NAME"),
    (&["--topic", "--topics", "-t", "--edges", "--edge"], &["echo"], "name the outputs without an option: {usage}"),
    (&["-a", "--all"], &["ps"], "leave it out: all running graphs are shown"),
    (&["-a", "--all"], &["record"], "leave it out: all edges are recorded"),
    (&["-a", "--all"], &["logs", "echo", "set"], "leave it out: without a name all are shown"),
    (&["--since", "--until", "--level", "--grep"], &["logs"], "add --json and filter the lines, as by jq or grep"),
    (&["--once", "-1"], &["echo"], "use -n 1"),
    (&["--once", "-1"], &["top"], "use 'blindgrasp ps', or --json -n 1"),
    (&["--once"], &["view"], "use --out FILE, or --format mermaid"),
    (&["--watch", "-w", "--follow", "-f"], &["ps", "set"], "use 'blindgrasp top'"),
    (&["--name"], &["init"], "give the folder without an option: {usage}"),
    (&["--start", "--begin", "--since"], &["replay"], "use --from TIME"),
    (&["--end", "--stop", "--until"], &["replay"], "use --to TIME"),
    (
        &["--tolerance", "--atol", "--rtol", "--eps"],
        &["test"],
        "write tolerances into NAME.expect.yaml beside the recording (docs/replay.md)",
    ),
    (&["--accept", "--bless", "--write", "--record"], &["--update"], "use --update"),
    (&["--list"], &["set"], "leave it out: without a name all parameters are shown"),
    (&["--list"], ROOT, "use 'blindgrasp ps' for running graphs, 'blindgrasp simulate --list' for objects"),
    (&["--host", "--remote", "--ip", "--on"], &["--machine"], "use --machine NAME"),
    (&["--restart", "--respawn"], &["run"], "write 'restart:' at a node of the dataflow file (docs/dataflow.md)"),
    (&["--engine", "--backend", "--simulator"], &["--physics"], "use --physics NAME"),
    (&["--gate", "--no-gate"], &["trials"], "use --lift-policy decision, always or both"),
    (&["--threshold-probability"], &["train"], "use --threshold PROBABILITY"),
    (
        &["--max-false-positive-rate", "--precision", "--recall"],
        &["train"],
        "use --max-drops SHARE, for labels of lifts, or --drop-secs SECONDS",
    ),
    (
        &[
            "--data",
            "--dataset",
            "--input",
            "--in",
            "-i",
            "--recording",
            "--recordings",
            "--file",
            "-f",
            "-d",
            "--path",
            "--from",
        ],
        &["train", "predict", "evaluate", "info", "replay", "test", "export", "view", "import", "sensors"],
        "give the file without an option: {usage}",
    ),
    // Arguments too many.
    (&[WORD], &["set"], "write it as one word with '.' and '=': blindgrasp set lift_arbiter.votes=5"),
    (&[WORD], &["simulate"], "name the objects by --objects, and the number of grasps by --grasps"),
    (&[WORD], &["trials"], "name the objects by --objects, and the number of trials by --trials"),
    (&[WORD], &["run"], "name one dataflow file, parameters by --set PARAM=VALUE"),
    (&[WORD], &["replay"], "name one recording, a dataflow file by --dataflow"),
    (&[WORD], &["record", "ps", "top", "stop", "logs", "init", "view"], "name one: {usage}"),
    // Values.
    (&["svm", "svc", "libsvm", "rbf"], &["--recipe"], "use paper, which trains the paper's SVM"),
    (
        &["randomforest", "random-forest", "rf", "forest", "xgboost", "lightgbm", "gbm", "trees", "mlp", "nn", "cnn"],
        &["--recipe"],
        "use boosted, which learns boosted trees; docs/operators.md shows how a model of scikit-learn decides in a graph",
    ),
    (&["json"], &["--format"], "use jsonl, one JSON object a line"),
    (
        &["parquet", "arrow", "feather", "hdf5", "npz", "pandas", "xlsx"],
        &["--format"],
        "use csv; Python reads recordings as they are (docs/python.md)",
    ),
];

/// The place of a command, and of an option before any command.
const ROOT: &[&str] = &["blindgrasp"];
/// A hint repeats so much of the line.
const MAX_REST_CHARS: usize = 200;
/// Stands for an argument too many that is no option.
const WORD: &str = "WORD";
const OUTPUTS: &[&str] = &["--output", "--output-file", "--outfile", "--out", "-o", "--save", "--to"];
const VERBOSE: &[&str] = &["-v", "-vv", "--verbose", "--debug", "--log-level", "--loglevel", "--trace"];
const SPEED: &[&str] = &["--speed", "--rate", "-r", "--factor", "--fps", "--hz", "--freq", "--frequency", "--realtime"];
const COUNTS: &[&str] = &[
    "--n",
    "-n",
    "--count",
    "-c",
    "--num",
    "--number",
    "--size",
    "--num-grasps",
    "--n-grasps",
    "--num-samples",
    "--samples",
];

/// The error with a hint: the command, the option or the value that is probably meant.
///
/// `root` is the command line's definition, and `words` are those that were typed, the program's name first.
pub(super) fn with_hint(mut error: clap::Error, root: Command, words: &[OsString]) -> clap::Error {
    let words: Vec<String> = words.iter().map(|word| word.to_string_lossy().into_owned()).collect();
    let place = Place::of(root, &words);
    let hint = match error.kind() {
        ErrorKind::InvalidSubcommand => {
            error.remove(ContextKind::SuggestedSubcommand);
            place.command_hint()
        }
        ErrorKind::UnknownArgument => {
            // Clap advises to pass the option as a value, '-- --x', and likens names that are not alike.
            error.remove(ContextKind::Suggested);
            error.remove(ContextKind::SuggestedArg);
            // Clap's usage would have the likened option.
            error.insert(ContextKind::Usage, ContextValue::StyledStr(place.command.clone().render_usage()));
            place.argument_hint(&text_of(&error, ContextKind::InvalidArg).unwrap_or_default())
        }
        ErrorKind::InvalidValue | ErrorKind::ValueValidation => value_hint(&error),
        _ => None,
    };
    if let Some(hint) = hint {
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint.into()]));
    }
    error
}

/// The hint for a word that stands where the name of a graph does, as `hands` in `list hands`.
pub(super) fn hint_for_word(word: &str, root: Command) -> Option<String> {
    let place = Place::of(root, &["blindgrasp".into(), word.into()]);
    place.row(word).map(|hint| place.filled_in(hint, place.rest.len()))
}

/// The command that the words lead to.
struct Place {
    /// The names of all commands.
    commands: Vec<String>,
    command: Command,
    /// Its name behind the program's, or the program's.
    name: String,
    /// The words behind it.
    rest: Vec<String>,
}

impl Place {
    fn of(mut root: Command, words: &[String]) -> Place {
        root.build();
        let visible = root.get_subcommands().filter(|command| !command.is_hide_set());
        let commands = visible.map(|command| command.get_name().to_owned()).collect();
        let rest = words.iter().skip(1).cloned().collect();
        let mut place = Place { commands, name: root.get_name().into(), command: root, rest };
        // The first command's name is that of the place: `model show` is `model`.
        let mut n_commands = 0;
        while let Some(word) = place.rest.first()
            && let Some(found) = place.command.find_subcommand(word).cloned()
        {
            if n_commands == 0 {
                place.name = found.get_name().into();
            }
            n_commands += 1;
            place.command = found;
            place.rest.remove(0);
        }
        place
    }

    fn command_hint(&self) -> Option<String> {
        // Options may come before.
        let at = self.rest.iter().position(|word| !word.starts_with('-'))?;
        let word = &self.rest[at];
        let next = self.rest.get(at + 1).map(|next| format!("{word} {next}"));
        if let Some(hint) = next.and_then(|both| self.row(&both)).or_else(|| self.row(word)) {
            return Some(self.filled_in(hint, at + 1));
        }
        if self.name == "new" {
            let project = || format!("use 'blindgrasp init {word}' for a project of that name");
            return did_you_mean(word, ["operator", "hand"]).or_else(|| Some(project()));
        }
        if self.is_command(word) {
            return Some(self.filled_in(&format!("use 'blindgrasp {word} …'"), at + 1));
        }
        if let Some(kind) = FileKind::at(Path::new(word)) {
            return Some(format!("the command is missing before {}: it is {}", quote(word), kind.description()));
        }
        if let Some((command, _)) = word.split_once(['-', '_'])
            && !word.contains('.')
            && self.is_command(command)
        {
            return Some(self.filled_in(&format!("use 'blindgrasp {command} …'"), at + 1));
        }
        let subcommands = || self.command.get_subcommands().filter(|command| !command.is_hide_set());
        let names: Vec<&str> =
            subcommands().flat_map(|known| known.get_all_aliases().chain([known.get_name()])).collect();
        did_you_mean(word, names)
    }

    fn argument_hint(&self, argument: &str) -> Option<String> {
        if argument.parse::<f64>().is_ok() && argument.starts_with('-') {
            return Some(format!("'{argument}' is read as an option: no number below zero is expected here"));
        }
        // `--name=value` is named without its value.
        let guess = if argument.starts_with('-') { argument } else { WORD };
        if let Some(hint) = self.row(guess) {
            return Some(self.filled_in(hint, self.rest.len()));
        }
        if self.name == ROOT[0] && self.rest.iter().any(|word| self.command.find_subcommand(word).is_some()) {
            return Some("options stand behind the command".into());
        }
        if !argument.starts_with("--") {
            return None;
        }
        let known: Vec<&str> = self.options().collect();
        let alike = did_you_mean(argument.trim_start_matches('-'), known);
        alike.map(|alike| alike.replacen('\'', "'--", 1)).or_else(|| {
            let has = |wanted: &str| self.options().any(|option| option == wanted);
            if has("print-options") {
                return Some("--print-options prints what a file of --options can change".into());
            }
            has("set").then(|| "a parameter of an operator is given by --set [NODE.]PARAM=VALUE".into())
        })
    }

    fn is_command(&self, word: &str) -> bool {
        self.commands.iter().any(|command| command == word)
    }

    /// The hint of the first row for a guess at this place.
    fn row(&self, guess: &str) -> Option<&'static str> {
        let is_here = |place: &str| match place.strip_prefix("--") {
            Some(wanted) => self.options().any(|option| option == wanted),
            None => place == self.name,
        };
        let fits = |places: &[&str]| places.is_empty() || places.iter().any(|place| is_here(place));
        let row = GUESSES.iter().find(|(guesses, places, _)| guesses.contains(&guess) && fits(places))?;
        Some(row.2)
    }

    /// The long options of the command.
    fn options(&self) -> impl Iterator<Item = &str> {
        self.command.get_arguments().filter(|argument| !argument.is_hide_set()).filter_map(clap::Arg::get_long)
    }

    /// A hint whose gaps are filled with the words from `from` on, and with what is known here.
    fn filled_in(&self, hint: &str, from: usize) -> String {
        let rest = bare(MAX_REST_CHARS, &self.rest.get(from..).unwrap_or_default().join(" "));
        let usage = self.command.clone().render_usage().to_string();
        hint.replace(" …", if rest.is_empty() { "" } else { " …" })
            .replace('…', &rest)
            .replace("{usage}", usage.trim_start_matches("Usage: "))
            .replace("{hands}", &builtin_names().join(", "))
    }
}

/// The hint for a value that an option does not take.
fn value_hint(error: &clap::Error) -> Option<String> {
    let value = text_of(error, ContextKind::InvalidValue)?;
    let option = text_of(error, ContextKind::InvalidArg)?;
    let name = option.split(' ').next().unwrap_or_default();
    // An option of the same name may take other values.
    let is_possible = |hint: &str| match error.get(ContextKind::ValidValue) {
        Some(ContextValue::Strings(valid)) => valid.iter().any(|valid| hint.starts_with(&format!("use {valid}"))),
        _ => true,
    };
    let row = GUESSES.iter().find(|(guesses, places, hint)| {
        places.contains(&name) && guesses.contains(&value.as_str()) && is_possible(hint)
    });
    if let Some((_, _, hint)) = row {
        return Some((*hint).into());
    }
    // Rust's own words for a number that is none.
    match error.source()?.to_string().as_str() {
        "invalid digit found in string" | "cannot parse integer from empty string" => {
            Some("expected a whole number, without a unit".into())
        }
        "invalid float literal" | "cannot parse float from empty string" => {
            Some("expected a number like 0.5, without a unit".into())
        }
        _ => None,
    }
}

fn text_of(error: &clap::Error, kind: ContextKind) -> Option<String> {
    match error.get(kind)? {
        ContextValue::String(text) => Some(text.clone()),
        ContextValue::StyledStr(text) => Some(text.to_string()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::super::{Cli, help};
    use super::*;

    /// The text of the error for a line, with its hint.
    fn told(line: &str) -> String {
        let words: Vec<OsString> = std::iter::once("blindgrasp").chain(line.split(' ')).map(OsString::from).collect();
        let error = help::grouped(Cli::command()).try_get_matches_from(&words).expect_err("a mistake");
        with_hint(error, help::grouped(Cli::command()), &words).to_string()
    }

    /// Lines that people who know another program type, each with a part of its hint.
    const LINES: [(&str, &str); 108] = [
        ("plot a.mcap", "tip: use 'blindgrasp view a.mcap'"),
        ("compare a.mcap b.mcap", "'blindgrasp test RECORDING'"),
        ("diff a.mcap b.mcap", "'blindgrasp test RECORDING'"),
        ("convert a.mcap a.csv", "blindgrasp export RECORDING --format csv"),
        ("inspect a.mcap", "'blindgrasp info FILE'"),
        ("ui", "blindgrasp view GRAPH"),
        ("hands", "shadow-biotac-sp"),
        ("objects", "'blindgrasp simulate --list'"),
        ("param list", "'blindgrasp set', which lists"),
        ("param get lift_arbiter votes", "'blindgrasp set NODE.PARAM'"),
        ("param set lift_arbiter votes 4", "'blindgrasp set NODE.PARAM=VALUE'"),
        ("node list", "'blindgrasp ps'"),
        ("topic list", "'blindgrasp ps'"),
        ("topic echo /decision", "'blindgrasp echo NODE/PORT'"),
        ("topic hz /decision", "'blindgrasp top'"),
        ("bag record -o x.mcap", "'blindgrasp record --out FILE'"),
        ("bag play x.mcap", "'blindgrasp replay RECORDING'"),
        ("check dataflow.yaml", "'blindgrasp run --check dataflow.yaml'"),
        ("lint dataflow.yaml", "'blindgrasp run --check dataflow.yaml'"),
        ("kill one", "'blindgrasp stop one'"),
        ("rm one", "'blindgrasp stop GRAPH'"),
        ("reload classifier", "'blindgrasp swap NODE'"),
        ("version", "blindgrasp --version"),
        ("eval m.json a.mcap", "'blindgrasp evaluate m.json a.mcap'"),
        ("classify m.json a.mcap", "'blindgrasp predict MODEL RECORDING'"),
        ("calibrate", "zero_when_open"),
        ("bench", "blindgrasp doctor"),
        ("install", "docs/install.md"),
        ("update", "docs/install.md"),
        ("merge a.mcap b.mcap", "several recordings"),
        ("completion bash", "'blindgrasp completions bash'"),
        ("evalute m.json", "did you mean 'evaluate'?"),
        ("new demo", "'blindgrasp init demo'"),
        ("new node filter", "'blindgrasp new operator NAME'"),
        ("new project demo", "'blindgrasp init FOLDER'"),
        ("model list", "'blindgrasp model show FILE'"),
        ("model info m.json", "'blindgrasp model show FILE'"),
        ("run --dry-run", "use --check"),
        ("run --chek", "'--check'"),
        ("run --speed 2", "recorded_source.rate"),
        ("run --rate 2", "recorded_source.rate"),
        ("run -v", "RUST_LOG"),
        ("run --verbose", "RUST_LOG"),
        ("run --record-to x.mcap", "use --record FILE"),
        ("run -o x.mcap", "use --record FILE"),
        ("run --output x.mcap", "use --record FILE"),
        ("run --daemon", "use --detach"),
        ("run --param votes=4", "use --set"),
        ("run --votes 4", "given by --set"),
        ("run --model m.json", "use --set model=FILE"),
        ("run --hand allegro", "use --set hand=FILE"),
        ("run --port 8080", "use --view"),
        ("run -f dataflow.yaml", "without an option: blindgrasp run [OPTIONS] [DATAFLOW]"),
        ("run --loop", "recorded_source.repeat=forever"),
        ("run --timeout 10", "timeout 10 blindgrasp run"),
        ("run --sim", "'blindgrasp trials'"),
        ("run a.yaml votes=4", "--set PARAM=VALUE"),
        ("--json ps", "behind the command"),
        ("replay a.mcap --speed 2", "use --rate 2x"),
        ("replay a.mcap --repeat", "use --loop"),
        ("replay a.mcap --rate -1", "no number below zero"),
        ("train --data a.mcap", "without an option: blindgrasp train"),
        ("train a.mcap --output m.json", "use --out FILE"),
        ("train a.mcap -o m.json --model svm", "--recipe NAME"),
        ("train a.mcap -o m.json --recipe svm", "use paper"),
        ("train a.mcap -o m.json --recipe randomforest", "use boosted"),
        ("train a.mcap -o m.json --epochs 5", "use --grid"),
        ("train a.mcap -o m.json --cv 5", "blindgrasp evaluate RECORDING --split"),
        ("train a.mcap -o m.json --n-jobs 2", "RAYON_NUM_THREADS"),
        ("train a.mcap -o m.json --force", "use --overwrite"),
        ("predict --model m.json a.mcap", "without an option: blindgrasp predict"),
        ("predict m.json a.mcap -o out.csv", "--json > FILE"),
        ("predict m.json a.mcap --format csv", "use --json"),
        ("predict m.json a.mcap --threshold 0.9", "blindgrasp train --threshold"),
        ("evaluate m.json a.mcap --output r.html", "use --report FILE"),
        ("simulate --n 10 --out x.mcap", "use --grasps N"),
        ("simulate --count 10 --out x.mcap", "use --grasps N"),
        ("simulate --threads 4", "RAYON_NUM_THREADS"),
        ("simulate --dry-run", "--print-options"),
        ("simulate --grasps many --out x.mcap", "a whole number"),
        ("simulate mug --out x.mcap", "--objects"),
        ("trials --n 5", "use --trials N"),
        ("trials --gate on", "--lift-policy"),
        ("echo decision --count 1", "use --samples N"),
        ("echo --topic decision", "without an option: blindgrasp echo"),
        ("ps -a", "leave it out"),
        ("logs --tail 5", "use --lines N"),
        ("record -o x.mcap --duration 5", "use --for TIME"),
        ("record -o x.mcap --topics /decision", "use --edges"),
        ("stop --force", "--grace"),
        ("set lift_arbiter.votes 4", "set lift_arbiter.votes=5"),
        ("test --verbose", "--keep"),
        ("run --once", "ends with its source"),
        ("run --recording a.mcap", "--set recording=FILE"),
        ("run --fancy", "given by --set"),
        ("simulate --noise 1", "--print-options"),
        ("simulate --render", "blindgrasp view RECORDING"),
        ("import t.csv --sep ;", "use --delimiter"),
        ("import t.csv --degrees", "use --joint-unit deg"),
        ("top --delay 1", "use --interval TIME"),
        ("record -o x.mcap --split 1GB", "use --rotate-size"),
        ("view a.mcap --host 0.0.0.0", "ssh -L"),
        ("swap classifier --with x", "use --run PROGRAM"),
        ("model predict m.json a.mcap", "'blindgrasp predict m.json a.mcap'"),
        ("train-model a.mcap", "'blindgrasp train a.mcap'"),
        ("tune", "--grid"),
        ("completions --shell bash", "blindgrasp completions <SHELL>"),
        ("init x --force", "choose a new name"),
    ];

    #[test]
    fn guesses_are_answered_with_what_does_it_here() {
        for (line, expected) in LINES {
            let text = told(line);
            assert!(text.contains(expected), "blindgrasp {line}: expected '{expected}' in\n{text}");
            assert!(!text.contains("as a value") && !text.contains("similar argument"), "{line}: {text}");
        }
    }

    #[test]
    fn a_file_in_the_place_of_the_command_says_what_it_is() {
        let text = told("Cargo.toml/none");
        assert!(!text.contains("tip"), "{text}");
        let text = told(concat!(env!("CARGO_MANIFEST_DIR"), "/dataflow.yaml"));
        assert!(text.contains("the command is missing before") && text.contains("blindgrasp run"), "{text}");
    }

    #[test]
    fn no_guess_hides_a_command_and_each_hint_names_commands_that_there_are() {
        let command = Cli::command();
        for (guesses, places, hint) in GUESSES {
            if *places == ROOT {
                let known = guesses.iter().find(|guess| command.find_subcommand(guess).is_some());
                assert_eq!(known, None, "a command of that name exists");
            }
            for place in places.iter().filter(|place| !place.starts_with("--") && **place != ROOT[0]) {
                assert!(command.find_subcommand(place).is_some(), "no command '{place}'");
            }
            for named in hint.split("blindgrasp ").skip(1) {
                let name = named.split([' ', '\'', ',', ';', ':', '.']).next().unwrap_or_default();
                let is_command = name.starts_with("--") || command.find_subcommand(name).is_some();
                // A sentence about the program.
                let is_prose = named.starts_with("is ");
                assert!(is_command || is_prose, "'{hint}' names '{name}'");
            }
        }
    }

    #[test]
    fn each_guess_is_found_where_it_is_written() {
        for (idx, (guesses, places, _)) in GUESSES.iter().enumerate() {
            for guess in *guesses {
                let same = |other: &&[&str]| other.iter().any(|place| places.contains(place)) || other.is_empty();
                let before = GUESSES[..idx].iter().find(|(others, at, _)| others.contains(guess) && same(at));
                assert!(before.is_none(), "'{guess}' of row {idx} is hidden by an earlier row");
            }
        }
    }
}
