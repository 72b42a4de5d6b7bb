//! Files that a command is to write, checked before the work begins.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use blindgrasp_messages::files::{write_private, write_whole};

/// As [`check_output`], for a file that another one takes the place of once it is complete. It also refuses to replace a
/// file, unless the user has asked for that, and anything else that bears the name.
pub fn check_new(out: &Path, inputs: &[PathBuf], overwrite: bool) -> anyhow::Result<()> {
    check_output(out, inputs)?;
    match std::fs::symlink_metadata(out).map(|found| found.file_type()) {
        Ok(found) if found.is_symlink() => {
            anyhow::bail!("{} is a link, which would be replaced: name the file that it leads to", out.display())
        }
        Ok(found) if !found.is_file() => {
            anyhow::bail!("{} is a device or a pipe, which would be replaced: name a file", out.display())
        }
        Ok(_) if !overwrite => {
            anyhow::bail!("{}: the file exists; choose another name, or replace it with --overwrite", out.display())
        }
        _ => Ok(()),
    }
}

/// As [`check_output`], for a page, which takes the place of a file of its name.
pub fn check_page(out: &Path, inputs: &[PathBuf]) -> anyhow::Result<()> {
    check_output(out, inputs)?;
    if !out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html")) {
        anyhow::bail!("{} (--report): expected a name that ends in .html", out.display());
    }
    if out.is_symlink() {
        anyhow::bail!("{} is a link, which would be replaced: name the file that it leads to", out.display());
    }
    Ok(())
}

/// Refuses to write where one of the inputs lies.
pub fn check_output(out: &Path, inputs: &[PathBuf]) -> anyhow::Result<()> {
    // By device and number: a file may have several names.
    let place = |path: &Path| std::fs::metadata(path).ok().map(|found| (found.dev(), found.ino()));
    match inputs.iter().find(|input| place(out).is_some_and(|out| place(input) == Some(out))) {
        Some(input) => anyhow::bail!("{} is an input: writing there would destroy it", input.display()),
        None if out.parent().is_some_and(|folder| folder != Path::new("") && !folder.is_dir()) => anyhow::bail!(
            "{}: there is no such folder to write to; make it first",
            out.parent().unwrap_or(out).display()
        ),
        None if out.is_dir() => anyhow::bail!("{} is a folder: expected the name of a file to write", out.display()),
        None => check_writable(out),
    }
}

/// Refuses a place where no file can be made, before work of hours ends there.
fn check_writable(out: &Path) -> anyhow::Result<()> {
    if out.exists() {
        return Ok(());
    }
    let folder = match out.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let trial = folder.join(format!(".blindgrasp-{}.partial", std::process::id()));
    if let Err(error) = std::fs::File::create(&trial) {
        let folder = folder.display();
        anyhow::bail!("{}: no file can be made in {folder}: {error}; choose another folder", out.display());
    }
    let _ = std::fs::remove_file(&trial);
    Ok(())
}

/// Writes a text as an output file: whole or not at all. A link, a pipe or a device is written to as it is.
///
/// # Errors
/// It cannot be written; nothing is left of it.
pub fn write_out(path: &Path, text: &str) -> anyhow::Result<()> {
    let written = if is_special(path) { std::fs::write(path, text) } else { write_whole(path, text) };
    written.map_err(|error| cannot_write(path, &error))
}

/// As [`write_out`], for a report of a user's data, which no other user may read.
///
/// # Errors
/// As [`write_out`].
pub fn write_report(path: &Path, text: &str) -> anyhow::Result<()> {
    let written = if is_special(path) { std::fs::write(path, text) } else { write_private(path, text) };
    written.map_err(|error| cannot_write(path, &error))
}

/// Whether it is a link, a pipe or a device.
fn is_special(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|found| !found.is_file())
}

fn cannot_write(path: &Path, error: &std::io::Error) -> anyhow::Error {
    anyhow::anyhow!("cannot write {}: {error}", path.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_where_nothing_can_be_written_is_refused_before_the_work() {
        let error = check_output(Path::new("/proc/model.json"), &[]).expect_err("no file can be made there");
        let text = error.to_string();
        assert!(text.contains("/proc/model.json: no file can be made in /proc") && text.contains("choose"), "{text}");
        let folder = std::env::temp_dir().join(format!("blindgrasp-output-{}", std::process::id()));
        std::fs::create_dir(&folder).expect("made");
        check_output(&folder.join("model.json"), &[]).expect("a place to write");
        std::fs::remove_dir(&folder).expect("the trial leaves nothing");
    }
}
