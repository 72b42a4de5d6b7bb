//! The log files of a graph: one an operator, with time stamps, bounded in size, and kept after the graph has ended.
//!
//! A line is `2026-11-21T23:18:49.123Z [classifier] WARN text`, or a [`LogLine`] as JSON; both may stand in one file.
//! Only the launcher writes them.

use std::ffi::OsString;
use std::fmt;
use std::fs::{DirBuilder, File};
use std::io::{Read, Seek, SeekFrom, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use blindgrasp_messages::files::private_file;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::{LogEntry, LogLevel};

/// The name of the audit log. No node may have it.
pub const AUDIT: &str = "audit";
/// A file that has reached this size makes room for a new one.
const MAX_FILE_BYTES: u64 = 8 << 20;
/// The number of old files: `NAME.log.1`, the newest, to `NAME.log.3`.
const N_OLD_FILES: usize = 3;
/// A log is read from its end in blocks of this size.
const BLOCK_BYTES: u64 = 64 << 10;
/// The first line of a run separates the runs in one file.
const RUN_MARKER: &str = "== new run ==";

/// The folder of a graph's logs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogFolder {
    path: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogFormat {
    Text,
    /// Each line is a [`LogLine`] in JSON.
    Json,
}

/// A line of a log file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// The time stamp in the file; empty if there is none.
    pub time: String,
    /// The file's name without `.log`: the node's id, or `run`.
    pub operator: String,
    /// `None` if the operator gave no level.
    pub level: Option<LogLevel>,
    /// The text, safe for a terminal.
    pub text: String,
    /// Values by name; in a text file they are part of the text.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub fields: Map<String, Value>,
}

/// A log file that is being written.
#[derive(Debug)]
pub struct LogFile {
    folder: LogFolder,
    name: String,
    format: LogFormat,
    max_file_bytes: u64,
    file: Option<(File, u64)>,
    /// The last line was cut off; the next write begins a new line.
    is_torn: bool,
    /// The error that it cannot be written has been printed.
    is_said: bool,
}

/// Reads an operator's log from the oldest line to the newest, and then new lines, across rotation.
#[derive(Debug)]
pub struct LogReader {
    folder: LogFolder,
    name: String,
    file: Option<File>,
    unfinished: Vec<u8>,
}

impl LogFolder {
    /// `$XDG_STATE_HOME/blindgrasp/<graph>`, or `~/.local/state/blindgrasp/<graph>`, or below the folder for temporary
    /// files where there is no home.
    pub fn of_graph(graph: &str) -> Self {
        LogFolder { path: state_folder(|name| std::env::var_os(name)).join(graph) }
    }

    pub fn at(path: PathBuf) -> Self {
        LogFolder { path }
    }

    /// The path, which need not exist.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The graph that logged last, among those in the folder of [`of_graph`](Self::of_graph).
    pub fn latest_graph() -> Option<String> {
        let entries = std::fs::read_dir(state_folder(|name| std::env::var_os(name))).ok()?;
        let graphs = entries.flatten().filter_map(|entry| {
            let folder = LogFolder { path: entry.path() };
            let names = folder.names().ok()?;
            let written =
                names.iter().filter_map(|name| folder.file(name, 0).metadata().ok()?.modified().ok()).max()?;
            Some((written, entry.file_name().to_str()?.to_string()))
        });
        graphs.max().map(|(_, graph)| graph)
    }

    /// The operators with logs, sorted by name.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn names(&self) -> std::io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in std::fs::read_dir(&self.path)? {
            let name = entry?.file_name();
            names.extend(name.to_str().and_then(|name| name.strip_suffix(".log")).map(str::to_string));
        }
        names.sort();
        Ok(names)
    }

    /// The file that is being written (age 0), or an older one.
    fn file(&self, name: &str, age: usize) -> PathBuf {
        self.path.join(if age == 0 { format!("{name}.log") } else { format!("{name}.log.{age}") })
    }

    fn create(&self) -> std::io::Result<()> {
        // Other users may not read the logs.
        DirBuilder::new().recursive(true).mode(0o700).create(&self.path)?;
        // In a folder for temporary files, another user may have made links to our files.
        if let Some(parent) = self.path.parent().filter(|parent| parent.starts_with(std::env::temp_dir())) {
            let found = std::fs::symlink_metadata(parent)?;
            if !found.is_dir() || found.uid() != rustix::process::getuid().as_raw() {
                let message = format!("{} is not a folder of this user", parent.display());
                return Err(std::io::Error::new(std::io::ErrorKind::PermissionDenied, message));
            }
        }
        Ok(())
    }
}

impl fmt::Display for LogLine {
    /// The line of a text file, safe for a terminal.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.time.is_empty() {
            write!(f, "{} ", self.time)?;
        }
        let entry = LogEntry { level: self.level, text: self.text.clone(), fields: self.fields.clone() };
        write!(f, "[{}] {}", self.operator, printable(&entry.to_string()))
    }
}

impl LogFile {
    /// Opens the log of an operator behind the lines of earlier runs, and marks the new run. If a log cannot be
    /// written, one message on stderr says so, here or later, and the graph goes on.
    pub fn open(folder: &LogFolder, name: &str, format: LogFormat) -> LogFile {
        LogFile::open_bounded(folder, name, format, MAX_FILE_BYTES)
    }

    /// Writes an entry with the time and the operator's name. As text, each line of the entry is a line of the log,
    /// safe for a terminal.
    pub fn write(&mut self, entry: &LogEntry) {
        let time = humantime::format_rfc3339_millis(SystemTime::now()).to_string();
        // One write for all lines, so that a reader mostly sees whole lines.
        let mut lines = String::from(if self.is_torn { "\n" } else { "" });
        match self.format {
            LogFormat::Text => {
                for line in entry.to_string().lines() {
                    lines += &format!("{time} [{}] {}\n", self.name, printable(line));
                }
            }
            LogFormat::Json => {
                let LogEntry { level, text, fields } = entry.clone();
                let line = LogLine { time, operator: self.name.clone(), level, text, fields };
                lines += &fit_for_a_terminal(&serde_json::to_string(&line).unwrap_or_default());
                lines.push('\n');
            }
        }
        if let Err(error) = self.append(lines.as_bytes())
            && !self.is_said
        {
            self.is_said = true;
            let path = self.folder.file(&self.name, 0);
            print_diagnostic(&format!("blindgrasp: the log {} cannot be written: {error}", path.display()));
        }
    }

    fn open_bounded(folder: &LogFolder, name: &str, format: LogFormat, max_file_bytes: u64) -> LogFile {
        let (folder, name) = (folder.clone(), name.to_string());
        let mut log = LogFile { folder, name, format, max_file_bytes, file: None, is_torn: false, is_said: false };
        log.write(&LogEntry::plain(RUN_MARKER));
        log
    }

    fn append(&mut self, lines: &[u8]) -> std::io::Result<()> {
        let (mut file, mut n_bytes) = match self.file.take() {
            Some(open) => open,
            None => {
                self.folder.create()?;
                self.open_newest()?
            }
        };
        if n_bytes > 0 && n_bytes + lines.len() as u64 > self.max_file_bytes {
            self.rotate()?;
            (file, n_bytes) = self.open_newest()?;
        }
        self.is_torn = true;
        file.write_all(lines)?;
        self.is_torn = false;
        self.file = Some((file, n_bytes + lines.len() as u64));
        Ok(())
    }

    fn open_newest(&self) -> std::io::Result<(File, u64)> {
        let path = self.folder.file(&self.name, 0);
        let file = private_file().append(true).create(true).open(path)?;
        let n_bytes = file.metadata()?.len();
        Ok((file, n_bytes))
    }

    fn rotate(&self) -> std::io::Result<()> {
        for age in (0..N_OLD_FILES).rev() {
            match std::fs::rename(self.folder.file(&self.name, age), self.folder.file(&self.name, age + 1)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        Ok(())
    }
}

impl LogReader {
    /// A reader of an operator's log, which need not be there yet.
    pub fn new(folder: &LogFolder, name: &str) -> LogReader {
        LogReader { folder: folder.clone(), name: name.into(), file: None, unfinished: Vec::new() }
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// The whole lines since the last call.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn read(&mut self) -> std::io::Result<Vec<LogLine>> {
        let mut content = std::mem::take(&mut self.unfinished);
        loop {
            // Before the file is read to its end: once there is a newer file, nothing more is added to this one.
            let newer = self.newer_file()?;
            if let Some(file) = &mut self.file {
                file.read_to_end(&mut content)?;
            }
            let Some(newer) = newer else { break };
            self.file = Some(newer);
            if !content.is_empty() && !content.ends_with(b"\n") {
                content.push(b'\n');
            }
        }
        let end = content.iter().rposition(|&byte| byte == b'\n').map_or(0, |newline_idx| newline_idx + 1);
        self.unfinished = content.split_off(end);
        Ok(parse_lines(&self.name, &content))
    }

    /// The last `n_lines` lines; [`read`](Self::read) goes on behind them. Only these lines are read.
    ///
    /// # Errors
    /// A file cannot be read.
    fn read_newest(&mut self, n_lines: usize) -> std::io::Result<Vec<LogLine>> {
        let mut tail = Tail { n_more: n_lines, blocks: Vec::new() };
        let mut inodes = Vec::new();
        for age in 0..=N_OLD_FILES {
            let mut file = match File::open(self.folder.file(&self.name, age)) {
                Ok(file) => file,
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                Err(error) => return Err(error),
            };
            // A file that was renamed meanwhile is met again.
            let inode = file.metadata()?.ino();
            if inodes.contains(&inode) {
                continue;
            }
            inodes.push(inode);
            let is_whole = tail.add(&mut file)?;
            if self.file.is_none() {
                let newest = tail.blocks.concat();
                let end = newest.iter().rposition(|&byte| byte == b'\n').map_or(0, |newline_idx| newline_idx + 1);
                self.unfinished = newest[end..].to_vec();
                tail.blocks = vec![newest[..end].to_vec()];
                self.file = Some(file);
            }
            if !is_whole {
                break;
            }
        }
        let mut lines = parse_lines(&self.name, &tail.blocks.concat());
        lines.drain(..lines.len().saturating_sub(n_lines));
        Ok(lines)
    }

    /// The file after the one that is being read; the oldest file at first.
    fn newer_file(&self) -> std::io::Result<Option<File>> {
        let inode = |file: &File| Ok::<u64, std::io::Error>(file.metadata()?.ino());
        // While a file is open, no other file gets its inode number.
        let current = self.file.as_ref().map(inode).transpose()?;
        let mut newer = None;
        for age in 0..=N_OLD_FILES {
            let file = match File::open(self.folder.file(&self.name, age)) {
                Ok(file) => file,
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                Err(error) => return Err(error),
            };
            if Some(inode(&file)?) == current {
                break;
            }
            newer = Some(file);
        }
        Ok(newer)
    }
}

/// The last lines of a log, collected from the newest to the oldest.
struct Tail {
    /// The number of lines that are missing.
    n_more: usize,
    /// Whole lines, the oldest first.
    blocks: Vec<Vec<u8>>,
}

impl Tail {
    /// Adds the last lines of a file before the others; returns whether that is the whole file, and more lines are
    /// missing. The file is then read from its end.
    fn add(&mut self, file: &mut File) -> std::io::Result<bool> {
        let end = file.seek(SeekFrom::End(0))?;
        let (mut start, mut n_newlines, mut blocks) = (end, 0, Vec::new());
        // The newline before the first wanted line is read as well.
        while start > 0 && n_newlines <= self.n_more {
            let n_bytes = start.min(BLOCK_BYTES);
            start -= n_bytes;
            let mut block = vec![0; n_bytes as usize];
            file.seek(SeekFrom::Start(start))?;
            file.read_exact(&mut block)?;
            n_newlines += block.iter().filter(|&&byte| byte == b'\n').count();
            blocks.insert(0, block);
        }
        file.seek(SeekFrom::Start(end))?;
        let mut content = blocks.concat();
        if start > 0 {
            let partial = content.iter().position(|&byte| byte == b'\n').map_or(content.len(), |idx| idx + 1);
            content.drain(..partial);
        }
        // A line of an older file that was cut off ends there.
        if !self.blocks.is_empty() && !content.is_empty() && !content.ends_with(b"\n") {
            content.push(b'\n');
        }
        self.n_more = self.n_more.saturating_sub(n_newlines);
        self.blocks.insert(0, content);
        Ok(start == 0 && self.n_more > 0)
    }
}

/// Reads the logs of a graph's operators together: the newest lines, and then new ones.
#[derive(Debug)]
pub struct LogTail {
    folder: LogFolder,
    operator: Option<String>,
    readers: Vec<LogReader>,
}

impl LogTail {
    /// The last `n_lines` lines of all operators together, or of one.
    ///
    /// # Errors
    /// There are no such logs, or they cannot be read.
    pub fn open(folder: LogFolder, operator: Option<&str>, n_lines: usize) -> std::io::Result<(LogTail, Vec<LogLine>)> {
        let mut tail = LogTail { folder, operator: operator.map(str::to_string), readers: Vec::new() };
        tail.find_new()?;
        if tail.readers.is_empty() {
            let names = tail.folder.names()?.join(", ");
            let known = if names.is_empty() { "there are no logs".into() } else { format!("there are: {names}") };
            let whose = operator.unwrap_or("any operator");
            let message = format!("no log of {whose} in {}; {known}", tail.folder.path().display());
            return Err(std::io::Error::new(std::io::ErrorKind::NotFound, message));
        }
        let logs = tail.readers.iter_mut().map(|reader| reader.read_newest(n_lines));
        let mut lines = merge(logs.collect::<std::io::Result<_>>()?);
        lines.drain(..lines.len().saturating_sub(n_lines));
        Ok((tail, lines))
    }

    /// The lines since the last call, including those of new logs.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn more(&mut self) -> std::io::Result<Vec<LogLine>> {
        self.find_new()?;
        Ok(merge(self.readers.iter_mut().map(LogReader::read).collect::<std::io::Result<_>>()?))
    }

    fn find_new(&mut self) -> std::io::Result<()> {
        for name in self.folder.names()? {
            let is_wanted = self.operator.as_ref().is_none_or(|operator| *operator == name);
            if is_wanted && !self.readers.iter().any(|reader| reader.name() == name) {
                self.readers.push(LogReader::new(&self.folder, &name));
            }
        }
        Ok(())
    }
}

/// Merges logs by time. Each log keeps its order, even if the clock was put back.
pub fn merge(logs: Vec<Vec<LogLine>>) -> Vec<LogLine> {
    let mut lines = Vec::new();
    for log in logs {
        let mut latest = String::new();
        for line in log {
            latest = latest.max(line.time.clone());
            lines.push((latest.clone(), line));
        }
    }
    lines.sort_by(|(first, _), (second, _)| first.cmp(second));
    lines.into_iter().map(|(_, line)| line).collect()
}

/// Escapes characters that move a terminal's cursor, change its colours or reverse its text, like `\u{1b}`.
pub fn printable(text: &str) -> String {
    let mut printable = String::with_capacity(text.len());
    for char in text.trim_end_matches(['\r', '\n']).chars() {
        let turns_around = matches!(char, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        if (char.is_control() && char != '\t') || turns_around {
            printable.extend(char.escape_default());
        } else {
            printable.push(char);
        }
    }
    printable
}

/// As [`printable`], with JSON's escapes, so that the meaning stays the same.
fn fit_for_a_terminal(json: &str) -> String {
    let escaped = |char: char| match char {
        '\u{7f}'..='\u{9f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
            format!("\\u{:04x}", u32::from(char))
        }
        char => char.into(),
    };
    json.chars().map(escaped).collect()
}

/// The folder of the logs of all graphs of this user.
fn state_folder(variable: impl Fn(&str) -> Option<OsString>) -> PathBuf {
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let home = absolute("XDG_STATE_HOME").or_else(|| Some(absolute("HOME")?.join(".local/state")));
    match home {
        Some(home) => home.join("blindgrasp"),
        // Not `blindgrasp-UID-…`: folders of running graphs have such names, and are removed.
        None => std::env::temp_dir().join(format!("blindgrasp-state-{}", rustix::process::getuid().as_raw())),
    }
}

fn parse_lines(name: &str, content: &[u8]) -> Vec<LogLine> {
    let text = String::from_utf8_lossy(content);
    text.lines().filter(|line| !line.is_empty()).map(|line| parse_line(name, line)).collect()
}

fn parse_line(name: &str, line: &str) -> LogLine {
    if let Some(line) = line.starts_with('{').then(|| serde_json::from_str::<LogLine>(line).ok()).flatten() {
        return LogLine { text: printable(&line.text), operator: name.into(), ..line };
    }
    let whole = || LogLine { operator: name.into(), text: printable(line), ..LogLine::default() };
    let Some((time, rest)) = line.split_once(' ') else { return whole() };
    let said = rest.strip_prefix('[').and_then(|rest| rest.strip_prefix(name)).and_then(|rest| rest.strip_prefix("] "));
    match said {
        Some(said) if humantime::parse_rfc3339(time).is_ok() => {
            let leveled = LogLevel::ALL.iter().find_map(|level| Some((*level, said.strip_prefix(level.word())?)));
            let (level, text) = match leveled.and_then(|(level, rest)| Some((level, rest.strip_prefix(' ')?))) {
                Some((level, text)) => (Some(level), text),
                None => (None, said),
            };
            LogLine { time: time.into(), operator: name.into(), level, text: printable(text), fields: Map::new() }
        }
        _ => whole(),
    }
}

/// The last lines of a node's log, as the end of a message.
pub(crate) fn log_tail(log: &[String]) -> String {
    if log.is_empty() {
        return String::new();
    }
    format!("; its last words:\n  {}", log.join("\n  "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> (tempfile::TempDir, LogFolder) {
        let temporary = tempfile::tempdir().expect("a folder");
        let folder = LogFolder::at(temporary.path().join("blindgrasp/graph"));
        (temporary, folder)
    }

    fn all(folder: &LogFolder, name: &str) -> Vec<LogLine> {
        LogReader::new(folder, name).read().expect("readable")
    }

    fn texts(lines: &[LogLine]) -> Vec<&str> {
        lines.iter().map(|line| line.text.as_str()).filter(|text| *text != RUN_MARKER).collect()
    }

    #[test]
    fn lines_bear_time_and_operator_and_runs_are_told_apart() {
        let (_temporary, folder) = folder();
        for run in ["first", "second"] {
            LogFile::open(&folder, "classifier", LogFormat::Text).write(&LogEntry::plain(run));
        }
        let content = std::fs::read_to_string(folder.file("classifier", 0)).expect("written");
        let lines: Vec<&str> = content.lines().collect();
        assert_eq!(lines.len(), 4);
        for (line, end) in lines.iter().zip([RUN_MARKER, "first", RUN_MARKER, "second"]) {
            let (time, rest) = line.split_at("2026-11-21T23:18:49.123Z".len());
            humantime::parse_rfc3339(time).expect("a time");
            assert_eq!(rest, format!(" [classifier] {end}"));
        }
        assert_eq!(folder.names().expect("readable"), ["classifier"]);
    }

    #[test]
    fn a_line_can_break_neither_file_nor_terminal() {
        let (_temporary, folder) = folder();
        let mut log = LogFile::open(&folder, "wild", LogFormat::Text);
        log.write(&LogEntry::plain(String::from_utf8_lossy(b"\x1b[2Jgone \xff\xfe \x07\x9b\r\n")));
        log.write(&LogEntry::plain("turned \u{202e}around\tand\u{85}so"));
        log.write(&LogEntry::plain("two\nlines"));
        log.write(&LogEntry::plain(""));
        let content = std::fs::read(folder.file("wild", 0)).expect("written");
        let content = String::from_utf8(content).expect("UTF-8");
        assert!(!content.chars().any(|char| char.is_control() && char != '\n' && char != '\t'), "{content:?}");
        let lines = all(&folder, "wild");
        let expected =
            ["\\u{1b}[2Jgone \u{fffd}\u{fffd} \\u{7}\u{fffd}", "turned \\u{202e}around\tand\\u{85}so", "two", "lines"];
        assert_eq!(texts(&lines), expected);
    }

    #[test]
    fn levels_and_fields_are_read_back_from_either_format() {
        let entry = LogEntry {
            level: Some(LogLevel::Warn),
            text: "slow\n\u{9b}2J".into(),
            fields: [("seq".to_string(), Value::from(7))].into_iter().collect(),
        };
        let (_temporary, folder) = folder();
        LogFile::open(&folder, "a", LogFormat::Json).write(&entry);
        // Another run in another format: one log holds both.
        let mut log = LogFile::open(&folder, "a", LogFormat::Text);
        log.write(&entry);
        log.write(&LogEntry::plain("INFORMAL is no level"));
        let lines = all(&folder, "a");
        assert_eq!(texts(&lines), ["slow\\n\\u{9b}2J", "slow", "\\u{9b}2J seq=7", "INFORMAL is no level"]);
        let levels: Vec<_> = lines.iter().map(|line| line.level).collect();
        assert_eq!(levels, [None, Some(LogLevel::Warn), None, Some(LogLevel::Warn), None, None]);
        assert_eq!(lines[1].fields, entry.fields);
        assert!(lines.iter().all(|line| humantime::parse_rfc3339(&line.time).is_ok() && line.operator == "a"));
        assert!(lines[1].to_string().ends_with(" [a] WARN slow\\n\\u{9b}2J seq=7"), "{}", lines[1]);
        let content = std::fs::read_to_string(folder.file("a", 0)).expect("UTF-8");
        assert!(!content.contains('\u{9b}'), "{content:?}");
        let json: LogLine = serde_json::from_str(content.lines().nth(1).expect("a line")).expect("a line of JSON");
        assert_eq!((json.text, json.level), (entry.text, entry.level));
    }

    #[test]
    fn old_files_make_room_and_the_newest_lines_are_read_across_them() {
        let (_temporary, folder) = folder();
        // A line is 24 + 5 + 2 + 1 bytes: four fit.
        let mut log = LogFile::open_bounded(&folder, "a", LogFormat::Text, 128);
        let numbers: Vec<String> = (10..40).map(|number| number.to_string()).collect();
        numbers.iter().for_each(|number| log.write(&LogEntry::plain(number)));
        let sizes: Vec<u64> =
            (0..=N_OLD_FILES).map(|age| folder.file("a", age).metadata().expect("there").len()).collect();
        assert!(sizes.iter().all(|&n_bytes| n_bytes <= 128), "{sizes:?}");
        assert!(!folder.file("a", N_OLD_FILES + 1).exists());
        let kept = all(&folder, "a");
        assert_eq!(texts(&kept), numbers[numbers.len() - kept.len()..].to_vec());
        assert!(kept.len() > 9, "{} lines", kept.len());
        // A new run goes on where the last one ended, in size too.
        drop(log);
        let mut log = LogFile::open_bounded(&folder, "a", LogFormat::Text, 128);
        (40..43).for_each(|number| log.write(&LogEntry::plain(number.to_string())));
        assert!(folder.file("a", 0).metadata().expect("there").len() <= 128);
        assert!(texts(&all(&folder, "a")).ends_with(&["39", "40", "41", "42"]));
    }

    #[test]
    fn following_misses_nothing_however_often_the_log_is_rotated() {
        let (_temporary, folder) = folder();
        let mut log = LogFile::open_bounded(&folder, "a", LogFormat::Text, 128);
        log.write(&LogEntry::plain("before"));
        let mut reader = LogReader::new(&folder, "a");
        assert_eq!(texts(&reader.read().expect("readable")), ["before"]);
        assert_eq!(reader.read().expect("readable"), []);
        let mut number = 0;
        // Within a file, over one end of a file, over two.
        for n_lines in [1, 3, 7, 1, 5] {
            let expected: Vec<String> = (number..number + n_lines).map(|number| number.to_string()).collect();
            expected.iter().for_each(|line| log.write(&LogEntry::plain(line)));
            number += n_lines;
            assert_eq!(texts(&reader.read().expect("readable")), expected);
        }
        let mut late = LogReader::new(&folder, "b");
        assert_eq!(late.read().expect("readable"), []);
        LogFile::open(&folder, "b", LogFormat::Text).write(&LogEntry::plain("begun"));
        assert_eq!(texts(&late.read().expect("readable")), ["begun"]);
    }

    #[test]
    fn the_newest_lines_are_read_from_the_end_across_files_and_new_ones_follow() {
        let (_temporary, folder) = folder();
        let mut log = LogFile::open_bounded(&folder, "a", LogFormat::Text, 128);
        (10..40).for_each(|number| log.write(&LogEntry::plain(number.to_string())));
        let kept = all(&folder, "a");
        for n_lines in 0..kept.len() + 3 {
            let mut reader = LogReader::new(&folder, "a");
            let newest = reader.read_newest(n_lines).expect("readable");
            assert_eq!(newest, kept[kept.len().saturating_sub(n_lines)..], "{n_lines}");
            assert_eq!(reader.read().expect("readable"), []);
        }
        let mut reader = LogReader::new(&folder, "a");
        reader.read_newest(1).expect("readable");
        (40..50).for_each(|number| log.write(&LogEntry::plain(number.to_string())));
        let expected: Vec<String> = (40..50).map(|number| number.to_string()).collect();
        assert_eq!(texts(&reader.read().expect("readable")), expected);
        // A line that is not finished yet comes once it is.
        let mut reader = LogReader::new(&folder, "a");
        let mut file = File::options().append(true).open(folder.file("a", 0)).expect("opened");
        file.write_all(b"half").expect("written");
        assert_eq!(texts(&reader.read_newest(1).expect("readable")), ["49"]);
        file.write_all(b" and half\n").expect("written");
        assert_eq!(texts(&reader.read().expect("readable")), ["half and half"]);
        assert_eq!(LogReader::new(&folder, "none").read_newest(5).expect("readable"), []);
    }

    #[test]
    fn a_line_is_read_once_it_is_whole() {
        let (_temporary, folder) = folder();
        folder.create().expect("made");
        let path = folder.file("a", 0);
        let mut reader = LogReader::new(&folder, "a");
        let line = "2026-11-21T23:18:49.123Z [a] whole\n";
        std::fs::write(&path, &line[..20]).expect("written");
        assert_eq!(reader.read().expect("readable"), []);
        let mut file = File::options().append(true).open(&path).expect("opened");
        file.write_all(&line.as_bytes()[20..]).expect("written");
        let found = reader.read().expect("readable");
        let expected = LogLine {
            time: "2026-11-21T23:18:49.123Z".into(),
            operator: "a".into(),
            text: "whole".into(),
            ..LogLine::default()
        };
        assert_eq!(found, [expected]);
    }

    #[test]
    fn logs_are_merged_by_time_and_each_keeps_its_order() {
        let line = |time: &str, operator: &str, text: &str| LogLine {
            time: time.into(),
            operator: operator.into(),
            text: text.into(),
            ..LogLine::default()
        };
        // The clock of the first was put back; a line of the second has no time.
        let first = vec![line("03", "a", "1"), line("01", "a", "2"), line("09", "a", "3")];
        let second = vec![line("02", "b", "4"), line("", "b", "5"), line("04", "b", "6")];
        assert_eq!(texts(&merge(vec![first, second])), ["4", "5", "1", "2", "6", "3"]);
    }

    #[test]
    fn a_log_that_cannot_be_written_is_said_once_and_stops_nothing() {
        let temporary = tempfile::tempdir().expect("a folder");
        let in_the_way = temporary.path().join("graph");
        std::fs::write(&in_the_way, "a file").expect("written");
        let mut log = LogFile::open(&LogFolder::at(in_the_way.clone()), "a", LogFormat::Text);
        assert!(log.is_said);
        log.write(&LogEntry::plain("lost"));
        // And it is written again once it can be.
        std::fs::remove_file(&in_the_way).expect("removed");
        log.write(&LogEntry::plain("there"));
        assert_eq!(texts(&all(&LogFolder::at(in_the_way), "a")), ["there"]);
    }

    #[test]
    fn the_folder_is_where_the_desktop_standard_says() {
        let state = |variables: &[(&str, &str)]| {
            state_folder(|name| {
                variables.iter().find(|(known, _)| *known == name).map(|(_, value)| OsString::from(value))
            })
        };
        assert_eq!(state(&[("HOME", "/home/a"), ("XDG_STATE_HOME", "/s")]), Path::new("/s/blindgrasp"));
        assert_eq!(state(&[("HOME", "/home/a")]), Path::new("/home/a/.local/state/blindgrasp"));
        // The standard says that relative paths are to be ignored.
        let relative = state(&[("HOME", "/home/a"), ("XDG_STATE_HOME", "s")]);
        assert_eq!(relative, Path::new("/home/a/.local/state/blindgrasp"));
        assert!(state(&[("HOME", "")]).starts_with(std::env::temp_dir()));
    }
}
