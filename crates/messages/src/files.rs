//! Files that are complete or not there, and files that can be read to their end.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Seek, Write};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// The search for files beside a missing one ends after so many.
const MAX_NEIGHBOURS: usize = 10_000;
/// The flag of Linux by which the opening of a pipe does not wait for its other end.
const O_NONBLOCK: i32 = 0o4000;
/// Most names of files that an error shows.
const MAX_SHOWN_NEIGHBOURS: usize = 5;

/// The size limit of a text that is read whole: that of a model.
const MAX_TEXT_BYTES: u64 = 128 << 20;

/// Where a file is written until it is complete: beside its place, so that a rename puts it there at once.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

/// Opens a file to read it. A pipe, a device, a socket or a folder is refused: its reading might wait for ever, or never end.
///
/// # Errors
/// The file cannot be opened, is no regular file, or is a pointer of Git LFS in the place of the file. Of a file that is not
/// there the error names the files of its kind that are.
pub fn open_regular(path: &Path) -> std::io::Result<File> {
    let kind = match std::fs::metadata(path) {
        Ok(found) => found.file_type(),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let text = neighbours(path).map_or(error.to_string(), |neighbours| format!("{error}; {neighbours}"));
            return Err(std::io::Error::new(error.kind(), text));
        }
        Err(error) => return Err(error),
    };
    if kind.is_file() {
        // Another process may have put a pipe in its place since.
        let mut file = File::options().read(true).custom_flags(O_NONBLOCK).open(path)?;
        if !file.metadata()?.is_file() {
            return Err(std::io::Error::new(ErrorKind::InvalidInput, "it has changed, expected a regular file"));
        }
        refuse_git_lfs_pointer(&mut file)?;
        return Ok(file);
    }
    let found = if kind.is_dir() {
        let names = names_in(path, |file| file.is_file());
        let names = names.map(|names| format!("; it has {names}")).unwrap_or_default();
        let text = format!("it is a folder, expected a regular file{names}");
        return Err(std::io::Error::new(ErrorKind::InvalidInput, text));
    } else if kind.is_fifo() {
        "a pipe"
    } else if kind.is_socket() {
        "a socket"
    } else {
        "a device"
    };
    Err(std::io::Error::new(ErrorKind::InvalidInput, format!("it is {found}, expected a regular file")))
}

/// What a folder has in the place of a missing file: its files whose names end alike, to stand behind the error; `None` if it
/// has none.
pub fn neighbours(missing: &Path) -> Option<String> {
    let folder = match missing.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let extension = missing.extension()?;
    Some(format!("its folder has {}", names_in(folder, |file| file.extension() == Some(extension))?))
}

/// Some names of files in a folder.
fn names_in(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Option<String> {
    let files = std::fs::read_dir(folder).ok()?.take(MAX_NEIGHBOURS).filter_map(|entry| Some(entry.ok()?.path()));
    let name = |file: PathBuf| Some(file.file_name()?.to_string_lossy().into_owned());
    let mut names: Vec<String> = files.filter(|file| is_wanted(file)).filter_map(name).collect();
    names.sort_unstable();
    let n_more = names.len().saturating_sub(MAX_SHOWN_NEIGHBOURS);
    names.truncate(MAX_SHOWN_NEIGHBOURS);
    match n_more {
        _ if names.is_empty() => None,
        0 => Some(names.join(", ")),
        _ => Some(format!("{} and {n_more} more", names.join(", "))),
    }
}

/// Refuses the text that a checkout without Git LFS has in the place of a large file.
fn refuse_git_lfs_pointer(file: &mut File) -> std::io::Result<()> {
    const BEGIN: &[u8] = b"version https://git-lfs.github.com/spec/";
    let mut begin = Vec::new();
    file.take(BEGIN.len() as u64).read_to_end(&mut begin)?;
    if begin == BEGIN {
        let what = "it is a pointer of Git LFS, not the file itself: run `git lfs pull`, or check out with LFS";
        return Err(std::io::Error::new(ErrorKind::InvalidData, what));
    }
    file.rewind()
}

/// Reads a text by [`open_regular`].
///
/// # Errors
/// The file cannot be opened or read, is no regular file, has more than 128 MiB, or is not UTF-8.
pub fn read_regular(path: &Path) -> std::io::Result<String> {
    let bytes = read_regular_bytes(path)?;
    String::from_utf8(bytes).map_err(|_| std::io::Error::new(ErrorKind::InvalidData, "it is no text in UTF-8"))
}

/// As [`read_regular`], for a text in any encoding.
///
/// # Errors
/// As [`read_regular`].
pub fn read_regular_bytes(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_regular(path)?.take(MAX_TEXT_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MAX_TEXT_BYTES {
        let text = format!("it has more than {} MiB, expected a smaller file", MAX_TEXT_BYTES >> 20);
        return Err(std::io::Error::new(ErrorKind::InvalidData, text));
    }
    Ok(bytes)
}

/// How a file that holds a user's data is opened to be written: one that is made has mode 0600, whatever the umask says, and
/// one that is there keeps its mode.
pub fn private_file() -> OpenOptions {
    let mut options = File::options();
    options.write(true).mode(0o600);
    options
}

/// Gives a file that will replace another one the mode of that one.
///
/// # Errors
/// The mode cannot be set.
pub fn keep_mode(file: &File, replaced: &Path) -> std::io::Result<()> {
    match std::fs::metadata(replaced) {
        Ok(replaced) => file.set_permissions(replaced.permissions()),
        Err(_) => Ok(()),
    }
}

/// Writes a file whole or not at all: under [`partial_path`], onto the disk, and then into its place. A new file has the mode
/// of the umask, for it is made to be shared.
///
/// # Errors
/// The file cannot be written; nothing is left of it, and what was in its place still is.
pub fn write_whole(path: &Path, content: impl AsRef<[u8]>) -> std::io::Result<()> {
    write_opened(File::options().write(true), path, content.as_ref())
}

/// As [`write_whole`], for a user's data: see [`private_file`].
///
/// # Errors
/// As [`write_whole`].
pub fn write_private(path: &Path, content: impl AsRef<[u8]>) -> std::io::Result<()> {
    write_opened(&mut private_file(), path, content.as_ref())
}

fn write_opened(options: &mut OpenOptions, path: &Path, content: &[u8]) -> std::io::Result<()> {
    let partial = partial_path(path);
    // A killed process may have left one, and another user a link to any file.
    let _ = std::fs::remove_file(&partial);
    let written = options
        .create_new(true)
        .open(&partial)
        .and_then(|mut file| {
            keep_mode(&file, path)?;
            file.write_all(content)?;
            file.sync_all()
        })
        .and_then(|()| std::fs::rename(&partial, path));
    if written.is_err() {
        let _ = std::fs::remove_file(&partial);
    }
    written
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn no_other_user_reads_private_files_until_their_owner_says_so() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let mode = |name: &str| std::fs::metadata(at(name)).expect("there").permissions().mode() & 0o777;
        File::create(at("of the umask")).expect("made");
        write_whole(&at("shared"), "a model").expect("written");
        write_private(&at("private"), "a report").expect("written");
        private_file().create_new(true).open(at("new")).expect("made");
        assert_eq!((mode("shared"), mode("private"), mode("new")), (mode("of the umask"), 0o600, 0o600));
        std::fs::set_permissions(at("private"), Permissions::from_mode(0o640)).expect("shared");
        write_private(&at("private"), "the next report").expect("written");
        assert_eq!(mode("private"), 0o640);
    }

    #[test]
    fn a_planted_link_is_replaced_and_not_followed() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mine, path) = (folder.path().join("mine"), folder.path().join("report"));
        std::fs::write(&mine, "mine").expect("written");
        std::os::unix::fs::symlink(&mine, partial_path(&path)).expect("planted");
        write_whole(&path, "a report").expect("written");
        assert_eq!(std::fs::read(&path).expect("there"), b"a report");
        assert_eq!(std::fs::read(&mine).expect("there"), b"mine");
    }

    #[test]
    fn only_regular_files_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let (file, socket) = (folder.path().join("file"), folder.path().join("socket"));
        std::fs::write(&file, "text").expect("written");
        assert_eq!(read_regular(&file).expect("read"), "text");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).expect("bound");
        let of_folder = open_regular(folder.path()).expect_err("a folder").to_string();
        assert_eq!(of_folder, "it is a folder, expected a regular file; it has file");
        for (path, found) in [(socket.as_path(), "a socket"), (Path::new("/dev/zero"), "a device")] {
            let error = open_regular(path).expect_err(found).to_string();
            assert_eq!(error, format!("it is {found}, expected a regular file"));
        }
        File::create(&file).and_then(|file| file.set_len(1 << 40)).expect("a file of 1 TiB that takes no room");
        let error = read_regular(&file).expect_err("a long file").to_string();
        assert_eq!(error, "it has more than 128 MiB, expected a smaller file");
        let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n";
        std::fs::write(&file, pointer).expect("written");
        let error = open_regular(&file).expect_err("a pointer").to_string();
        assert!(error.contains("git lfs pull"), "{error}");
        let missing = open_regular(&folder.path().join("missing")).expect_err("missing");
        assert_eq!(missing.kind(), ErrorKind::NotFound);
        for name in ["b.mcap", "a.mcap", "a.json"] {
            std::fs::write(folder.path().join(name), "").expect("written");
        }
        let missing = open_regular(&folder.path().join("c.mcap")).expect_err("missing");
        assert_eq!(missing.kind(), ErrorKind::NotFound);
        assert!(missing.to_string().ends_with("; its folder has a.mcap, b.mcap"), "{missing}");
    }
}
