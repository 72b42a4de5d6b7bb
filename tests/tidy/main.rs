//! The repository's own tests: its weight, its words, its pages, and the work of others in it. They read files, and start no
//! program of the product.

mod benchsuite;
mod dead_files;
mod dependencies;
mod docs;
mod plain_statements;
mod weight;

use std::path::{Path, PathBuf};

fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The files below a folder that have this extension, in order. Hidden folders and what Cargo makes are left out.
fn files_below(folder: &Path, extension: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let entry = entry.expect("an entry");
        let (path, name) = (entry.path(), entry.file_name());
        // A link to a folder is not followed.
        if !entry.file_type().expect("a type").is_dir() {
            if path.extension().is_some_and(|found| found == extension) {
                files.push(path);
            }
        } else if name != "target" && !name.to_string_lossy().starts_with('.') {
            files.extend(files_below(&path, extension));
        }
    }
    files.sort();
    files
}
