//! `blindgrasp new`

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, Subcommand};

use super::{Outcome, print_line};
use blindgrasp_messages::{ContactSet, GraspFeature, Prediction, Recorded, TactileFrame};

/// Make a folder with an operator of your own that builds and runs at once.
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
                  blindgrasp new operator pads\n  \
                  blindgrasp new operator end_to_end --python --from TactileFrame\n  \
                  blindgrasp new operator denoise --like filter")]
struct OperatorArguments {
    /// The folder to make; its last part is the operator's name.
    name: PathBuf,
    /// In Python, not in Rust.
    #[arg(long)]
    python: bool,
    /// What it does to begin with: judge each frame's feature, or filter what the hand reads.
    #[arg(long, value_parser = ["classifier", "filter"], conflicts_with_all = ["from", "to"])]
    like: Option<String>,
    /// What it takes: TactileFrame, ContactSet or GraspFeature.
    #[arg(long, value_name = "TYPE")]
    from: Option<String>,
    /// What it answers: Prediction, or TactileFrame from a TactileFrame.
    #[arg(long, value_name = "TYPE")]
    to: Option<String>,
    /// Where blindgrasp's source is, on which an operator in Rust is built [default: where this program was built].
    #[arg(long, value_name = "FOLDER", conflicts_with = "python")]
    blindgrasp: Option<PathBuf>,
}

/// What an operator begins with. Words that the templates hold in double braces, and what stands for them.
type Words = Vec<(&'static str, String)>;

const OPERATOR_PY: &str = include_str!("../../operators/blindgrasp_operator.py");
const MESSAGES_PY: &str = include_str!("../../operators/blindgrasp_messages.py");
/// The versions that blindgrasp is tested with: the new operator is built with the same.
const CARGO_LOCK: &str = include_str!("../../Cargo.lock");
const REQUIREMENTS: &str = "iceoryx2==0.10.0\nnumpy>=1.26\n";
const MAX_NAME_CHARS: usize = 32;
/// Names that are taken in Rust or Python: a program or module of that name would not build, or stand in another's way.
#[rustfmt::skip]
const TAKEN: &[&str] = &[
    // Rust's words, and packages that the operator is built with.
    "abstract", "as", "async", "await", "become", "box", "break", "const", "continue", "core", "crate", "do", "dyn", "else", "enum",
    "extern", "false", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro", "match", "mod", "move", "mut",
    "override", "priv", "proc_macro", "pub", "ref", "return", "self", "static", "std", "struct", "super", "test", "trait", "true",
    "try", "type", "typeof", "unsafe", "use", "virtual", "where", "while", "yield", "alloc", "anyhow", "blindgrasp", "iceoryx2",
    "serde", "serde_json",
    // Python's words, its library, and modules that the operator consists of or uses.
    "abc", "aifc", "and", "antigravity", "argparse", "array", "assert", "ast", "asynchat", "asyncio", "asyncore", "atexit",
    "audioop", "base64", "bdb", "binascii", "bisect", "blindgrasp_messages", "blindgrasp_operator", "builtins", "bz2",
    "calendar", "cgi", "cgitb", "chunk", "class", "cmath", "cmd", "code", "codecs", "codeop", "collections", "colorsys",
    "compileall", "concurrent", "configparser", "contextlib", "contextvars", "copy", "copyreg", "crypt", "csv", "ctypes",
    "curses", "dataclasses", "datetime", "dbm", "decimal", "def", "del", "difflib", "dis", "distutils", "doctest", "elif",
    "email", "encodings", "ensurepip", "errno", "except", "faulthandler", "fcntl", "filecmp", "fileinput", "finally",
    "fnmatch", "fractions", "from", "ftplib", "functools", "gc", "genericpath", "getopt", "getpass", "gettext", "glob",
    "global", "graphlib", "grp", "gzip", "hashlib", "heapq", "hmac", "html", "http", "idlelib", "imaplib", "imghdr", "imp",
    "import", "importlib", "inspect", "io", "ipaddress", "is", "itertools", "joblib", "json", "keyword", "lambda", "lib2to3",
    "linecache", "locale", "logging", "lzma", "mailbox", "mailcap", "marshal", "math", "mimetypes", "mmap", "modulefinder",
    "msilib", "msvcrt", "multiprocessing", "netrc", "nis", "nntplib", "nonlocal", "not", "nt", "ntpath", "nturl2path",
    "numbers", "numpy", "opcode", "operator", "optparse", "or", "os", "ossaudiodev", "pandas", "pass", "pathlib", "pdb",
    "pickle", "pickletools", "pipes", "pkgutil", "platform", "plistlib", "poplib", "posix", "posixpath", "pprint", "profile",
    "pstats", "pty", "pwd", "py_compile", "pyclbr", "pydoc", "pydoc_data", "pyexpat", "queue", "quopri", "raise", "random",
    "re", "readline", "reprlib", "resource", "rlcompleter", "runpy", "sched", "scipy", "secrets", "select", "selectors",
    "shelve", "shlex", "shutil", "signal", "site", "sklearn", "smtpd", "smtplib", "sndhdr", "socket", "socketserver", "spwd",
    "sqlite3", "sre_compile", "sre_constants", "sre_parse", "ssl", "stat", "statistics", "string", "stringprep",
    "subprocess", "sunau", "symtable", "sys", "sysconfig", "syslog", "tabnanny", "tarfile", "telnetlib", "tempfile",
    "termios", "textwrap", "this", "threading", "time", "timeit", "tkinter", "token", "tokenize", "tomllib", "torch",
    "trace", "traceback", "tracemalloc", "tty", "turtle", "turtledemo", "types", "typing", "unicodedata", "unittest",
    "urllib", "uu", "uuid", "venv", "warnings", "wave", "weakref", "webbrowser", "winreg", "winsound", "with", "wsgiref",
    "xdrlib", "xml", "xmlrpc", "zipapp", "zipfile", "zipimport", "zlib", "zoneinfo",
];

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let What::Operator(arguments) = &arguments.what;
    let folder = &arguments.name;
    let name = checked_name(folder)?;
    let kind = Kind::of(arguments)?;
    let mut words = kind.words();
    words.push(("NAME", name.clone()));
    let program = if arguments.python { format!("{name}.py") } else { format!("target/release/{name}") };
    let run = folder.join(&program).display().to_string();
    let is_in_sight = run.starts_with('/') || run.starts_with("./") || run.starts_with("../");
    let run = if is_in_sight { run } else { format!("./{run}") };
    words.push(("SNIPPET", kind.snippet(&name, &run)));
    let absolute = std::path::absolute(folder)?.join(&program);
    let try_it = kind.try_it(&absolute);
    words.push(("TRY", try_it.clone()));
    let files = if arguments.python { python_files(&name, kind) } else { rust_files(kind, arguments, &mut words)? };
    write_files(folder, &files, &words)?;

    let (language, shown) = (if arguments.python { "Python" } else { "Rust" }, folder.display());
    print_line(&format!("{shown}: the operator '{name}' in {language}: {}", kind.takes_and_gives()))?;
    print_line(&format!("next:\n  cd {}", in_shell(&shown.to_string())))?;
    print_line(if arguments.python {
        "  python3 -m venv .venv && .venv/bin/pip install -r requirements.txt\n  .venv/bin/python -m unittest"
    } else {
        "  cargo build --release\n  cargo test"
    })?;
    print_line(&format!("  {}", try_it.replace('\n', "\n  ")))?;
    print_line(&format!("in a dataflow file:\n{}", kind.snippet(&name, &run)))?;
    Ok(Outcome::Done)
}

/// The operator's name, if it can be one in both languages, and nothing is there yet.
fn checked_name(folder: &Path) -> anyhow::Result<String> {
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
    if TAKEN.contains(&name) {
        anyhow::bail!("'{name}' means something else in Rust or Python: choose another name, like my_{name}");
    }
    if folder.symlink_metadata().is_ok() {
        anyhow::bail!("{} is there already, and nothing is overwritten: choose another name", folder.display());
    }
    match folder.parent() {
        Some(parent) if parent != Path::new("") && !parent.is_dir() => {
            anyhow::bail!("there is no folder {} to make it in: make it first", parent.display())
        }
        _ => Ok(name.into()),
    }
}

/// As a shell takes it for one word.
fn in_shell(path: &str) -> String {
    if is_plain(path) { path.into() } else { format!("'{}'", path.replace('\'', "'\\''")) }
}

/// As YAML takes it for a text.
fn in_yaml(path: &str) -> String {
    if is_plain(path) { path.into() } else { serde_json::Value::from(path).to_string() }
}

fn is_plain(path: &str) -> bool {
    path.chars().all(|char| char.is_ascii_alphanumeric() || "/._-+".contains(char))
}

/// What an operator does to begin with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    JudgeFrames,
    JudgeContacts,
    JudgeFeatures,
    Filter,
}

impl Kind {
    fn of(arguments: &OperatorArguments) -> anyhow::Result<Kind> {
        if arguments.like.as_deref() == Some("filter") {
            return Ok(Kind::Filter);
        }
        // `blindgrasp/GraspFeature/2` means the same.
        let type_of = |given: &Option<String>, default: &str| -> String {
            let given = given.as_deref().unwrap_or(default);
            given.trim_start_matches("blindgrasp/").split('/').next().unwrap_or_default().into()
        };
        let (from, to) = (type_of(&arguments.from, "GraspFeature"), type_of(&arguments.to, "Prediction"));
        match (from.as_str(), to.as_str()) {
            ("TactileFrame", "Prediction") => Ok(Kind::JudgeFrames),
            ("ContactSet", "Prediction") => Ok(Kind::JudgeContacts),
            ("GraspFeature", "Prediction") => Ok(Kind::JudgeFeatures),
            ("TactileFrame", "TactileFrame") => Ok(Kind::Filter),
            _ => anyhow::bail!(
                "no operator begins as one from {from} to {to}: expected --from TactileFrame, ContactSet or GraspFeature with \
                 --to Prediction, or --from TactileFrame --to TactileFrame. Begin with one of these and change its types, or \
                 with blindgrasp's own in operators/"
            ),
        }
    }

    fn takes_and_gives(self) -> String {
        let (from, to) = match self {
            Kind::JudgeFrames => (TactileFrame::TYPE_NAME, Prediction::TYPE_NAME),
            Kind::JudgeContacts => (ContactSet::TYPE_NAME, Prediction::TYPE_NAME),
            Kind::JudgeFeatures => (GraspFeature::TYPE_NAME, Prediction::TYPE_NAME),
            Kind::Filter => (TactileFrame::TYPE_NAME, TactileFrame::TYPE_NAME),
        };
        format!("{from} in, {to} out")
    }

    fn param(self) -> &'static str {
        if self == Kind::JudgeFeatures { "min_pads" } else { "min_newtons" }
    }

    fn default_value(self) -> &'static str {
        match self {
            Kind::JudgeFrames | Kind::JudgeContacts => "5.0",
            Kind::JudgeFeatures => "2.0",
            Kind::Filter => "0.1",
        }
    }

    fn words(self) -> Words {
        let [type_name, port, summary, measure_doc] = match self {
            Kind::JudgeFrames => [
                "TactileFrame",
                "tactile",
                "Calls a grasp stable if all cells together feel enough force",
                "The force that all cells feel together, newtons.",
            ],
            Kind::JudgeContacts => [
                "ContactSet",
                "contacts",
                "Calls a grasp stable if its contacts together feel enough force",
                "The force that all contacts feel together, newtons.",
            ],
            Kind::JudgeFeatures => [
                "GraspFeature",
                "histogram",
                "Calls a grasp stable if enough pads are in contact",
                "How many pads are in contact; the values are the model's feature.",
            ],
            Kind::Filter => ["TactileFrame", "tactile", "Passes on what the hand reads without its noise", ""],
        };
        let rust = match self {
            Kind::JudgeContacts => RustWords {
                types: "Contact, ContactSet, ContactSetHead",
                item: "Contact",
                items: "contacts",
                measure: "    match Fault::from_code(head.fault).unwrap_or(Fault::Malformed) {\n        \
                          Fault::None => Ok(contacts.iter().map(|contact| contact.force_newtons).sum()),\n        \
                          fault => Err(fault),\n    }\n",
                example: "{\n            let contact = |force_newtons| Contact { force_newtons, ..Contact::default() };\n            \
                          (ContactSetHead::default(), [contact(1.0), contact(2.0)])\n        }",
                faulty: "(ContactSetHead { fault: Fault::NoContact.code(), ..ContactSetHead::default() }, [])",
                fault: "NoContact",
            },
            Kind::JudgeFeatures => RustWords {
                types: "GraspFeature, GraspFeatureHead",
                item: "f64",
                items: "_values",
                measure: "    match Fault::from_code(head.fault).unwrap_or(Fault::Malformed) {\n        \
                          Fault::None => Ok(f64::from(head.n_pads_in_contact)),\n        \
                          fault => Err(fault),\n    }\n",
                example: "(GraspFeatureHead { n_pads_in_contact: 3, ..GraspFeatureHead::default() }, [0.5; 4])",
                faulty: "(GraspFeatureHead { fault: Fault::WrongHand.code(), ..GraspFeatureHead::default() }, [])",
                fault: "WrongHand",
            },
            Kind::JudgeFrames | Kind::Filter => RustWords {
                types: "TactileFrame, TactileFrameHead",
                item: "f64",
                items: "items",
                measure: "    let (_joints_rad, cells_newtons) = head.split(items).map_err(|_| Fault::Malformed)?;\n    \
                          if cells_newtons.iter().any(|force| force.is_nan() || *force < 0.0) {\n        \
                          return Err(Fault::InvalidValue);\n    }\n    \
                          match cells_newtons.iter().sum() {\n        0.0 => Err(Fault::NoContact),\n        sum => Ok(sum),\n    }\n",
                example: "(TactileFrameHead { n_joints: 1, ..TactileFrameHead::default() }, [0.7, 1.0, 2.0])",
                faulty: "(TactileFrameHead { n_joints: 5, ..TactileFrameHead::default() }, [0.7])",
                fault: "Malformed",
            },
        };
        let python = match self {
            Kind::JudgeContacts => PythonWords {
                items: "contacts",
                measure: "    return fault_of(head), contacts[\"force_newtons\"].sum()\n",
                example: "ContactSetHead(), np.zeros(2, CONTACT)\n        items[\"force_newtons\"] = [1, 2]",
                faulty: "ContactSetHead(fault=Fault.NO_CONTACT), np.zeros(0, CONTACT)",
                fault: "NO_CONTACT",
            },
            Kind::JudgeFeatures => PythonWords {
                items: "values",
                measure: "    return fault_of(head), head.n_pads_in_contact\n",
                example: "GraspFeatureHead(n_pads_in_contact=3), np.full(4, 0.5)",
                faulty: "GraspFeatureHead(fault=Fault.WRONG_HAND), np.zeros(0)",
                fault: "WRONG_HAND",
            },
            Kind::JudgeFrames | Kind::Filter => PythonWords {
                items: "items",
                measure: "    cells_newtons = items[head.n_joints :]\n    if head.n_joints > len(items):\n        \
                          return Fault.MALFORMED, 0.0\n    if not (cells_newtons >= 0).all():\n        \
                          return Fault.INVALID_VALUE, 0.0\n    sum_newtons = cells_newtons.sum()\n    \
                          return (Fault.NONE if sum_newtons > 0 else Fault.NO_CONTACT), sum_newtons\n",
                example: "TactileFrameHead(n_joints=1), np.array([0.7, 1, 2])",
                faulty: "TactileFrameHead(n_joints=5), np.array([0.7])",
                fault: "MALFORMED",
            },
        };
        let function = if self == Kind::Filter { "filtered" } else { "measure" };
        let words = [
            ("TYPE", type_name),
            ("PORT", port),
            ("SUMMARY", summary),
            ("MEASURE_DOC", measure_doc),
            ("PARAM", self.param()),
            ("DEFAULT", self.default_value()),
            ("FUNCTION", function),
            ("RUST_TYPES", rust.types),
            ("RUST_ITEM", rust.item),
            ("RUST_ITEMS", rust.items),
            ("RUST_MEASURE", rust.measure),
            ("RUST_EXAMPLE", rust.example),
            ("RUST_FAULTY", rust.faulty),
            ("FAULT_RUST", rust.fault),
            ("PYTHON_ITEMS", python.items),
            ("PYTHON_MEASURE", python.measure),
            ("PYTHON_EXAMPLE", python.example),
            ("PYTHON_FAULTY", python.faulty),
            ("FAULT_PYTHON", python.fault),
        ];
        words.into_iter().map(|(word, text)| (word, text.to_string())).collect()
    }

    /// Its node in a dataflow file that lies where the command was typed.
    fn snippet(self, name: &str, run: &str) -> String {
        let (node, from) = match self {
            Kind::JudgeFrames => ("classifier", "recorded_source/tactile"),
            Kind::JudgeContacts => ("classifier", "contacts/contacts"),
            Kind::JudgeFeatures => ("classifier", "histogram/histogram"),
            Kind::Filter => (name, "recorded_source/tactile"),
        };
        let port = from.split('/').next_back().unwrap_or_default();
        let own = format!(
            "  {node}:\n    run: {}\n    inputs: {{{port}: {from}}}\n    params: {{{}: {}}}",
            in_yaml(run),
            self.param(),
            self.default_value()
        );
        match self {
            Kind::Filter => format!("{own}\n  contacts:\n    inputs: {{tactile: {name}/tactile}}"),
            _ => own,
        }
    }

    /// How it is tried in a graph.
    fn try_it(self, program: &Path) -> String {
        let program = in_shell(&program.display().to_string());
        match self {
            Kind::JudgeFeatures => format!(
                "blindgrasp swap classifier --run {program}      # in a graph that runs; back: --run classifier --set model=…"
            ),
            _ => format!("{program} --describe        # then wire it into a dataflow file and run that"),
        }
    }
}

struct RustWords {
    types: &'static str,
    item: &'static str,
    items: &'static str,
    measure: &'static str,
    example: &'static str,
    faulty: &'static str,
    fault: &'static str,
}

struct PythonWords {
    items: &'static str,
    measure: &'static str,
    example: &'static str,
    faulty: &'static str,
    fault: &'static str,
}

/// A file to write: where below the folder, its text or template, whether it is a program.
type File = (String, &'static str, bool);

fn rust_files(kind: Kind, arguments: &OperatorArguments, words: &mut Words) -> anyhow::Result<Vec<File>> {
    let built = Path::new(env!("CARGO_MANIFEST_DIR"));
    let source = arguments.blindgrasp.as_deref().unwrap_or(built);
    let manifest = source.join("Cargo.toml");
    let is_ours = std::fs::read_to_string(&manifest).is_ok_and(|text| text.contains("name = \"blindgrasp\""));
    if !is_ours {
        anyhow::bail!(
            "{} is not blindgrasp's source, on which an operator in Rust is built: say where it is with --blindgrasp FOLDER, or \
             make one in Python with --python",
            source.display()
        );
    }
    let source = source.canonicalize().with_context(|| source.display().to_string())?;
    // A JSON string is one of TOML, too.
    words.push(("BLINDGRASP", serde_json::to_string(source.to_str().context("a path that is UTF-8")?)?));
    let program = match kind {
        Kind::Filter => include_str!("templates/filter.rs.in"),
        _ => include_str!("templates/judge.rs.in"),
    };
    Ok(vec![
        ("Cargo.toml".into(), include_str!("templates/Cargo.toml.in"), false),
        ("Cargo.lock".into(), CARGO_LOCK, false),
        ("src/main.rs".into(), program, false),
        ("README.md".into(), include_str!("templates/README-rust.md.in"), false),
        (".gitignore".into(), "/target\n", false),
    ])
}

fn python_files(name: &str, kind: Kind) -> Vec<File> {
    let (program, test) = match kind {
        Kind::Filter => (include_str!("templates/filter.py.in"), include_str!("templates/test_filter.py.in")),
        _ => (include_str!("templates/judge.py.in"), include_str!("templates/test_judge.py.in")),
    };
    vec![
        (format!("{name}.py"), program, true),
        (format!("test_{name}.py"), test, false),
        ("blindgrasp_operator.py".into(), OPERATOR_PY, false),
        ("blindgrasp_messages.py".into(), MESSAGES_PY, false),
        ("requirements.txt".into(), REQUIREMENTS, false),
        ("README.md".into(), include_str!("templates/README-python.md.in"), false),
        (".gitignore".into(), "/.venv\n__pycache__/\n", false),
    ]
}

/// Writes the files into a new folder, which is gone again if that fails.
fn write_files(folder: &Path, files: &[File], words: &Words) -> anyhow::Result<()> {
    std::fs::create_dir(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let written = files.iter().try_for_each(|(path, text, is_program)| {
        let path = folder.join(path);
        // What is the same for all is copied as it is.
        let is_template = ![OPERATOR_PY, MESSAGES_PY, CARGO_LOCK].contains(text);
        let filled = words
            .iter()
            .filter(|_| is_template)
            .fold(text.to_string(), |text, (word, by)| text.replace(&format!("{{{{{word}}}}}"), by));
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
