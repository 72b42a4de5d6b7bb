//! `blindgrasp new`

use std::path::{Path, PathBuf};

use anyhow::Context;
use blindgrasp_operators::{PYTHON_MESSAGES, PYTHON_OPERATOR};
use clap::{Args, Subcommand};

use super::{Outcome, print_line, print_text};
use blindgrasp_cli::{check_free, in_shell, is_plain};

/// Make a folder with an operator or a hand of your own
///
/// Make a folder with an operator of your own that builds and runs at once, or with the description of your hand.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Operator(OperatorArguments),
}

/// An operator in Rust, or in Python: program, test, README with the next commands.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp new operator pads --blindgrasp ~/src/blindgrasp\n  \
                  blindgrasp new operator end_to_end --python --from TactileFrame\n  \
                  blindgrasp new operator denoise --python --like filter")]
struct OperatorArguments {
    /// The folder to make; its last part is the operator's name.
    name: PathBuf,
    /// In Python, not in Rust.
    #[arg(long)]
    python: bool,
    /// Its first task: to judge the feature of each frame, or to filter the frames of the hand.
    #[arg(long, value_parser = ["classifier", "filter"], conflicts_with_all = ["from", "to"])]
    like: Option<String>,
    /// The type of its input: TactileFrame, ContactSet or GraspFeature.
    #[arg(long, value_name = "TYPE")]
    from: Option<String>,
    /// The type of its output: Prediction, or TactileFrame from a TactileFrame.
    #[arg(long, value_name = "TYPE")]
    to: Option<String>,
    /// A folder with blindgrasp's source. An operator in Rust depends on the packages blindgrasp-messages and
    /// blindgrasp-operator, which no registry has yet: without this option, it builds once they are published.
    #[arg(long, value_name = "FOLDER", conflicts_with = "python")]
    blindgrasp: Option<PathBuf>,
}

/// The versions that blindgrasp is tested with: the new operator is built with the same.
const CARGO_LOCK: &str = include_str!("../../Cargo.lock");
const REQUIREMENTS: &str = "numpy>=1.26\n";
const MAX_NAME_CHARS: usize = 32;
/// Names that Cargo refuses, or that a dependency of the new operator has.
const TAKEN_IN_RUST: &str = "abstract alloc anyhow as async await become box break const continue core crate do dyn else \
     enum extern false final fn for gen iceoryx2 if impl in let loop macro match mod move mut override priv proc_macro pub ref \
     return self serde serde_json static std struct super test trait true try type typeof unsafe unsized use virtual where \
     while yield blindgrasp_messages blindgrasp_operator";

/// What an operator does to begin with.
struct Kind {
    from: &'static str,
    to: &'static str,
    summary: &'static str,
    /// The function that is to be replaced.
    function: &'static str,
    param: &'static str,
    /// The output that feeds it in the default graph.
    source: &'static str,
    rust: &'static str,
    python: &'static str,
    python_test: &'static str,
}

const KINDS: [Kind; 4] = [
    Kind {
        from: "TactileFrame",
        to: "Prediction",
        summary: "Calls a grasp stable if all cells together feel enough force",
        function: "measure",
        param: "min_newtons: 5.0",
        source: "recorded_source/tactile",
        rust: include_str!("templates/judge_frames.rs.in"),
        python: include_str!("templates/judge_frames.py.in"),
        python_test: include_str!("templates/test_judge_frames.py.in"),
    },
    Kind {
        from: "ContactSet",
        to: "Prediction",
        summary: "Calls a grasp stable if its contacts together feel enough force",
        function: "measure",
        param: "min_newtons: 5.0",
        source: "contacts/contacts",
        rust: include_str!("templates/judge_contacts.rs.in"),
        python: include_str!("templates/judge_contacts.py.in"),
        python_test: include_str!("templates/test_judge_contacts.py.in"),
    },
    Kind {
        from: "GraspFeature",
        to: "Prediction",
        summary: "Calls a grasp stable if enough pads are in contact",
        function: "measure",
        param: "min_pads: 2.0",
        source: "encoder/feature",
        rust: include_str!("templates/judge_features.rs.in"),
        python: include_str!("templates/judge_features.py.in"),
        python_test: include_str!("templates/test_judge_features.py.in"),
    },
    Kind {
        from: "TactileFrame",
        to: "TactileFrame",
        summary: "Passes on what the hand reads without its noise",
        function: "filtered",
        param: "min_newtons: 0.1",
        source: "recorded_source/tactile",
        rust: include_str!("templates/filter.rs.in"),
        python: include_str!("templates/filter.py.in"),
        python_test: include_str!("templates/test_filter.py.in"),
    },
];

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let What::Operator(arguments) = &arguments.what;
    let folder = &arguments.name;
    let name = checked_name(folder, arguments.python)?;
    let kind = Kind::of(arguments)?;
    let program = if arguments.python { "main.py".to_owned() } else { format!("target/release/{name}") };
    let run = folder.join(&program).display().to_string();
    let is_in_sight = run.starts_with('/') || run.starts_with("./") || run.starts_with("../");
    let snippet = kind.snippet(&name, &if is_in_sight { run } else { format!("./{run}") });
    let try_it = kind.try_it(&std::path::absolute(folder)?.join(&program));
    let words = [
        ("{{NAME}}", name.clone()),
        ("{{SUMMARY}}", kind.summary.into()),
        ("{{FUNCTION}}", kind.function.into()),
        ("{{SNIPPET}}", snippet.clone()),
        ("{{TRY}}", try_it.clone()),
        ("{{VERSION}}", env!("CARGO_PKG_VERSION").into()),
        ("{{PATCH}}", arguments.blindgrasp.as_deref().map(patch).transpose()?.unwrap_or_default()),
    ];
    let files = if arguments.python { python_files(kind) } else { rust_files(kind) };
    write_files(folder, &files, &words)?;

    let (language, shown) = (if arguments.python { "Python" } else { "Rust" }, folder.display());
    print_line(&format!("{shown}: the operator '{name}' in {language}: {} in, {} out", kind.from, kind.to))?;
    print_text(&format!("next:\n  cd {}", in_shell(&shown.to_string())))?;
    print_text(if arguments.python {
        "  python3 -m venv .venv && .venv/bin/pip install -r requirements.txt\n  .venv/bin/python -m unittest"
    } else {
        "  cargo build --release\n  cargo test"
    })?;
    print_text(&format!("  {}", try_it.replace('\n', "\n  ")))?;
    print_text(&format!("in a dataflow file:\n{snippet}"))?;
    if !arguments.python && arguments.blindgrasp.is_none() {
        print_line(
            "note: no registry has blindgrasp-operator yet; make it with --blindgrasp FOLDER to build on a source tree",
        )?;
    }
    Ok(Outcome::Done)
}

/// The operator's name, if it can be one and nothing is there yet.
fn checked_name(folder: &Path, is_python: bool) -> anyhow::Result<String> {
    let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_word = name.starts_with(|first: char| first.is_ascii_lowercase())
        && name.chars().all(|char| char.is_ascii_lowercase() || char.is_ascii_digit() || char == '_');
    if !is_word || name.len() > MAX_NAME_CHARS {
        anyhow::bail!(
            "'{}' is not a name for an operator: expected a lower-case letter, then lower-case letters, digits and _, at most \
             {MAX_NAME_CHARS}, like my_classifier",
            folder.display()
        );
    }
    if !is_python && TAKEN_IN_RUST.split(' ').any(|taken| taken == name) {
        anyhow::bail!("'{name}' means something else in Rust: choose another name, like my_{name}");
    }
    check_free(folder)?;
    Ok(name.into())
}

/// A path as a text in YAML.
fn in_yaml(path: &str) -> String {
    if is_plain(path) { path.into() } else { serde_json::Value::from(path).to_string() }
}

impl Kind {
    fn of(arguments: &OperatorArguments) -> anyhow::Result<&'static Kind> {
        let default_from = if arguments.like.as_deref() == Some("filter") { "TactileFrame" } else { "GraspFeature" };
        let default_to = if arguments.like.as_deref() == Some("filter") { "TactileFrame" } else { "Prediction" };
        // `blindgrasp/GraspFeature/4` means the same as `GraspFeature`.
        let [from, to] = [(&arguments.from, default_from), (&arguments.to, default_to)].map(|(given, default)| {
            let given = given.as_deref().unwrap_or(default);
            given.trim_start_matches("blindgrasp/").split('/').next().unwrap_or_default()
        });
        KINDS.iter().find(|kind| kind.from == from && kind.to == to).with_context(|| {
            format!(
                "there is no template from {from} to {to}: expected --from TactileFrame, ContactSet or GraspFeature with \
                 --to Prediction, or --from TactileFrame --to TactileFrame; make one of these and change its types"
            )
        })
    }

    /// Its node in a dataflow file that lies in the current folder.
    fn snippet(&self, name: &str, run: &str) -> String {
        let Kind { source, param, .. } = self;
        let port = source.split('/').next_back().unwrap_or_default();
        let node = if self.to == "Prediction" { "classifier" } else { name };
        let own =
            format!("  {node}:\n    run: {}\n    inputs: {{{port}: {source}}}\n    params: {{{param}}}", in_yaml(run));
        match self.to {
            "Prediction" => own,
            _ => format!("{own}\n  contacts:\n    inputs: {{tactile: {name}/tactile}}"),
        }
    }

    /// How it is tried in a graph.
    fn try_it(&self, program: &Path) -> String {
        let program = in_shell(&program.display().to_string());
        match self.from {
            "GraspFeature" => format!(
                "blindgrasp swap classifier --run {program}      # in a running graph; back: --run classifier --set model=…"
            ),
            _ => format!("{program} --describe        # then wire it into a dataflow file and run that"),
        }
    }
}

/// A file to write: its path below the folder, its text or template, whether it is a program.
type File = (&'static str, &'static str, bool);

/// Lets Cargo find blindgrasp's packages in a source tree.
fn patch(source: &Path) -> anyhow::Result<String> {
    let mut patch = "\n[patch.crates-io]\n".to_owned();
    for package in ["messages", "operator"] {
        let folder = source.join("crates").join(package);
        let manifest = folder.join("Cargo.toml");
        let is_ours =
            std::fs::read_to_string(&manifest).is_ok_and(|text| text.contains(&format!("\"blindgrasp-{package}\"")));
        if !is_ours {
            anyhow::bail!(
                "{} is not there, so {} is not blindgrasp's source: give its folder with --blindgrasp FOLDER, or make an \
                 operator in Python with --python",
                manifest.display(),
                source.display()
            );
        }
        let folder = folder.canonicalize().with_context(|| folder.display().to_string())?;
        // A JSON string is a string in TOML, too.
        let folder = serde_json::to_string(folder.to_str().context("the path of blindgrasp's source is not UTF-8")?)?;
        patch += &format!("blindgrasp-{package} = {{ path = {folder} }}\n");
    }
    Ok(patch)
}

fn rust_files(kind: &Kind) -> Vec<File> {
    vec![
        ("Cargo.toml", include_str!("templates/Cargo.toml.in"), false),
        ("Cargo.lock", CARGO_LOCK, false),
        ("src/main.rs", kind.rust, false),
        ("README.md", include_str!("templates/README-rust.md.in"), false),
        (".gitignore", "/target\n", false),
    ]
}

fn python_files(kind: &Kind) -> Vec<File> {
    // The program is called main.py whatever its name is: a file like json.py would stand in for a module of Python.
    vec![
        ("main.py", kind.python, true),
        ("test_main.py", kind.python_test, false),
        ("blindgrasp_operator.py", PYTHON_OPERATOR, false),
        ("blindgrasp_messages.py", PYTHON_MESSAGES, false),
        ("requirements.txt", REQUIREMENTS, false),
        ("README.md", include_str!("templates/README-python.md.in"), false),
        (".gitignore", "/.venv\n__pycache__/\n", false),
    ]
}

/// Writes the files into a new folder, and removes the folder if that fails.
fn write_files(folder: &Path, files: &[File], words: &[(&str, String)]) -> anyhow::Result<()> {
    std::fs::create_dir(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let written = files.iter().try_for_each(|(path, text, is_program)| {
        let path = folder.join(path);
        let is_template = ![PYTHON_OPERATOR, PYTHON_MESSAGES, CARGO_LOCK].contains(text);
        let mut filled = text.to_string();
        if is_template {
            for (word, by) in words {
                filled = filled.replace(word, by);
            }
        }
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent)?;
        }
        std::fs::write(&path, filled)?;
        if *is_program {
            std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o755))?;
        }
        Ok(())
    });
    written.map_err(|error: std::io::Error| {
        let _ = std::fs::remove_dir_all(folder);
        anyhow::Error::new(error).context(format!("cannot write into {}", folder.display()))
    })
}
