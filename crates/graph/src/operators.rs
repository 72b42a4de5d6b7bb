//! The operators that come with a program, and how they are started. The caller of [`check`](crate::dataflow::check()) gives
//! them: this crate knows none, and never starts the program that it is part of.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::dataflow::Program;
use crate::describe::program_on_path;
use blindgrasp_operator::text::{did_you_mean, list};

pub use blindgrasp_operator::description::LINK_OPERATOR;

/// The operator that has the ports of a program in another language. The launcher adds it to that program.
pub const HOST_OPERATOR: &str = "host";

/// The operators that a bare name in a dataflow file can mean. By default there are none, and each node names a program by its
/// path.
///
/// ```no_run
/// use blindgrasp_graph::operators::Operators;
///
/// let operators = Operators::of_program("/usr/bin/blindgrasp".as_ref(), ["contacts", "encoder"]);
/// assert!(operators.get("contacts").is_some());
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Operators {
    programs: BTreeMap<String, Program>,
    link: Option<Program>,
    host: Option<Program>,
    /// Those of which several can run in one process.
    sharing: BTreeSet<String>,
}

impl Operators {
    /// The operators of a program that runs each as `PROGRAM operator NAME`.
    pub fn of_program<'a>(program: &Path, names: impl IntoIterator<Item = &'a str>) -> Operators {
        Operators {
            programs: names.into_iter().map(|name| (name.to_owned(), started(program, name))).collect(),
            link: Some(started(program, LINK_OPERATOR)),
            host: Some(started(program, HOST_OPERATOR)),
            ..Operators::default()
        }
    }

    /// With this one, or the link, run by a program in the same way.
    #[must_use]
    pub fn with(mut self, name: &str, program: &Path) -> Operators {
        let started = started(program, name);
        if name == LINK_OPERATOR {
            self.link = Some(started);
        } else {
            self.programs.insert(name.into(), started);
        }
        self
    }

    /// Operators of which each is a program of its name in a folder.
    pub fn in_folder(folder: &Path, names: &[&str]) -> Operators {
        let programs = names.iter().map(|name| (name.to_string(), folder.join(name).into())).collect();
        Operators { programs, ..Operators::default() }
    }

    /// With these among them, of which the program can run several in one process, as `PROGRAM operator group`.
    #[must_use]
    pub fn sharing<'a>(mut self, names: impl IntoIterator<Item = &'a str>) -> Operators {
        self.sharing = names.into_iter().map(str::to_owned).collect();
        self
    }

    /// How the operator of this name is started.
    pub fn get(&self, name: &str) -> Option<&Program> {
        self.programs.get(name)
    }

    /// How the link to other machines is started, if there is one.
    pub fn link(&self) -> Option<&Program> {
        self.link.as_ref()
    }

    /// How the host of an operator in another language is started, if there is one.
    pub(crate) fn host(&self) -> Option<&Program> {
        self.host.as_ref()
    }

    /// All of them by their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Program)> {
        self.programs.iter().map(|(name, program)| (name.as_str(), program))
    }

    /// What `--run RUN --args ARGS` of a swap starts: one of these operators, a program by its path, relative to `folder`, or
    /// one on PATH.
    ///
    /// # Errors
    /// The path of a file that is not there.
    pub fn program_to_run(&self, run: &Path, args: &[String], folder: &Path) -> Result<Program, PathBuf> {
        let program = match run.to_str().and_then(|name| self.get(name)) {
            Some(program) => program.clone(),
            None => program_of_path(run, folder),
        };
        if !program.path.is_file() {
            return Err(program.path);
        }
        Ok(Program { args: program.args_with(args), ..program })
    }

    /// Whether a program with these arguments can run in one process with others.
    pub(crate) fn can_share_process(&self, program: &Path, args: &[String]) -> bool {
        let mut sharing = self.sharing.iter().filter_map(|name| self.get(name));
        sharing.any(|known| known.path == program && args.starts_with(&known.args))
    }

    /// The names of those that can share a process.
    pub(crate) fn sharing_names(&self) -> String {
        self.sharing.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
    }

    /// What to do instead, for a name that is no operator.
    pub(crate) fn help_for(&self, name: &str) -> String {
        if self.programs.is_empty() {
            return "there are no operators by name here".into();
        }
        let known = self.programs.keys().map(String::as_str);
        let similar = did_you_mean(name, known.clone()).map_or(String::new(), |similar| format!("{similar} "));
        format!("{similar}{}", list("operators", known))
    }
}

fn started(program: &Path, name: &str) -> Program {
    Program { path: program.into(), args: vec!["operator".into(), name.into()] }
}

fn program_of_path(run: &Path, folder: &Path) -> Program {
    let file = folder.join(run);
    if !file.exists()
        && let Some(on_path) = run.to_str().and_then(program_on_path)
    {
        return on_path.into();
    }
    file.into()
}

/// The path of the running program, also after a new build has taken its place.
///
/// # Errors
/// The path of the running program is unknown.
pub fn running_program() -> std::io::Result<PathBuf> {
    let path = std::env::current_exe()?;
    // Linux says so of a file that was replaced while it runs.
    let replaced = path.to_str().and_then(|path| path.strip_suffix(" (deleted)")).map(PathBuf::from);
    Ok(replaced.unwrap_or(path))
}
