//! Cargo does not compile a file of Rust that no other one declares, and says nothing of it.

use std::path::Path;

use crate::{files_below, project, read};

#[test]
fn each_file_of_rust_is_compiled() {
    let files = files_below(project(), "rs");
    let mut paths: String = files_below(project(), "toml").iter().map(|path| read(path)).collect();
    for path in &files {
        let text = read(path);
        paths.extend(text.lines().filter(|line| line.trim_start().starts_with("#[path = ")));
    }
    let dead: Vec<String> = files
        .iter()
        .filter(|path| !is_found_by_cargo(path) && !is_declared(path, &paths))
        .map(|path| path.display().to_string())
        .collect();
    assert!(dead.is_empty(), "no `mod` and no Cargo.toml names these files: delete them\n{}", dead.join("\n"));
}

fn is_found_by_cargo(path: &Path) -> bool {
    let folder = path.parent().expect("a folder");
    path.ends_with("main.rs")
        || path.ends_with("lib.rs")
        || path.ends_with("build.rs")
        || ["tests", "benches", "examples"].iter().any(|name| folder.ends_with(name))
}

/// Whether the module above declares the file, or one of these paths names it.
fn is_declared(path: &Path, paths: &str) -> bool {
    let (folder, file) = (path.parent().expect("a folder"), path.file_name().expect("a name").to_string_lossy());
    let within = folder.file_name().expect("a name").to_string_lossy();
    if paths.contains(&format!("{within}/{file}\"")) || paths.contains(&format!("\"{file}\"")) {
        return true;
    }
    // A module in a folder of its own has the folder's name.
    let module = if file == "mod.rs" { folder } else { path };
    let folder = module.parent().expect("a folder");
    let declaration = format!("mod {};", module.file_stem().expect("a name").to_string_lossy());
    let above = [folder.join("mod.rs"), folder.join("lib.rs"), folder.join("main.rs"), folder.with_extension("rs")];
    above.iter().any(|path| path.exists() && read(path).contains(&declaration))
}
