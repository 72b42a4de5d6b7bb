//! How the process of an operator is started.

use std::path::PathBuf;

/// A program with the arguments that make it an operator: a shipped operator is `blindgrasp operator NAME`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Program {
    pub path: PathBuf,
    pub args: Vec<String>,
}

impl Program {
    /// The arguments of the program, then further ones.
    pub fn args_with(&self, more: &[String]) -> Vec<String> {
        [self.args.as_slice(), more].concat()
    }
}

impl From<PathBuf> for Program {
    fn from(path: PathBuf) -> Self {
        Program { path, args: Vec::new() }
    }
}
