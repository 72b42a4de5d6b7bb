//! Reads the dataflow file and checks its form. `check` resolves its names.

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::dataflow::diagnostic::{DataflowError, Diagnostics, Position};
use crate::dataflow::environment::fill_in;
use crate::dataflow::form::{check_name, entries_or_nothing, unknown_key};
use crate::dataflow::machines_entry::{
    LinkEntry, MachinesEntry, check_no_places, check_places, check_security, read_link, read_machines,
};
use crate::dataflow::node::{NodeEntry, read_node};
use crate::dataflow::yaml::{self, Content, Entry, Text, Value};
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::open_regular;
use blindgrasp_operator::text::{did_you_mean, quote_path};

/// Far above any graph that a machine can run; a file beyond it is not a dataflow file.
const MAX_FILE_BYTES: usize = 1 << 20;
/// Each node is a process. The bound also keeps the searches over all nodes short.
const MAX_NODES: usize = 256;

pub(super) const FILE_KEYS: [&str; 6] = ["version", "name", "params", "machines", "link", "operators"];

/// A dataflow file that was read. It keeps mistakes of form that leave the rest readable, so that `check` can report
/// all mistakes together.
#[derive(Debug, Clone)]
pub struct DataflowFile {
    path: PathBuf,
    pub(super) absolute_path: PathBuf,
    pub(super) name: String,
    /// For each node that has a param of the name and gives it no value.
    pub(super) params: Vec<Entry>,
    pub(super) nodes: Vec<NodeEntry>,
    pub(super) machines: Option<MachinesEntry>,
    pub(super) link: LinkEntry,
    /// It has no key `machines`, nor one like it.
    pub(super) is_for_one_machine: bool,
    pub(super) diagnostics: Diagnostics,
}

impl DataflowFile {
    /// The file, as the caller named it.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where a node stands in it.
    pub fn position_of(&self, node: &str) -> Option<Position> {
        self.nodes.iter().find(|entry| entry.id.text == node).map(|entry| entry.id.at)
    }

    /// The machines that it names, in its order; none if all operators run on one.
    pub fn machines(&self) -> Vec<&str> {
        self.machines.iter().flat_map(MachinesEntry::names).collect()
    }
}

/// Reads a dataflow file.
///
/// # Errors
/// When the file cannot be read, is larger than 1 MiB, is not UTF-8, is not YAML without anchors, aliases and tags, is
/// of another version, or is no mapping. Other mistakes are left to [`crate::dataflow::check()`].
pub fn load(path: &Path) -> Result<DataflowFile, DataflowError> {
    load_with(path, &|name| std::env::var(name).ok())
}

/// As [`load`], with other variables than those of the environment.
///
/// # Errors
/// As [`load`].
pub fn load_with(path: &Path, variable: &dyn Fn(&str) -> Option<String>) -> Result<DataflowFile, DataflowError> {
    match read(path) {
        Ok(bytes) => parse_with(path, &bytes, variable),
        Err(error) => {
            let mut diagnostics = Diagnostics::new(path);
            let in_folder = path.join("dataflow.yaml");
            let help = if in_folder.is_file() {
                Some(format!("did you mean {}?", quote_path(&in_folder)))
            } else if error.kind() == std::io::ErrorKind::NotFound || path.is_dir() {
                Some("blindgrasp init DIR makes a project with one".to_string())
            } else {
                None
            };
            diagnostics.push_with_help(None, format!("cannot read the file: {error}"), help);
            Err(diagnostics.into_error())
        }
    }
}

/// Reads the content of a dataflow file, as [`load`] does; `path` says where it stands.
///
/// # Errors
/// As [`load`].
pub fn parse(path: &Path, content: &[u8]) -> Result<DataflowFile, DataflowError> {
    parse_with(path, content, &|name| std::env::var(name).ok())
}

fn parse_with(
    path: &Path,
    content: &[u8],
    variable: &dyn Fn(&str) -> Option<String>,
) -> Result<DataflowFile, DataflowError> {
    let mut diagnostics = Diagnostics::new(path);
    match read_file(path, content, variable, &mut diagnostics) {
        Some(file) => Ok(DataflowFile { diagnostics, ..file }),
        None => Err(diagnostics.into_error()),
    }
}

/// Reads at most one byte more than is allowed, also of an endless device.
fn read(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut content = Vec::new();
    open_regular(path)?.take(MAX_FILE_BYTES as u64 + 1).read_to_end(&mut content)?;
    Ok(content)
}

fn read_file(
    path: &Path,
    content: &[u8],
    variable: &dyn Fn(&str) -> Option<String>,
    diagnostics: &mut Diagnostics,
) -> Option<DataflowFile> {
    let text = text_of(content, diagnostics)?;
    let absolute_path = match std::path::absolute(path) {
        Ok(absolute_path) => absolute_path,
        Err(error) => {
            diagnostics.push(None, format!("cannot make the path absolute: {error}"));
            return None;
        }
    };
    let root = read_root(text, variable, diagnostics)?;
    let start = root.at;
    let entries = entries_of_this_version(root, diagnostics)?;
    let mut file = DataflowFile {
        path: path.to_owned(),
        absolute_path,
        name: String::new(),
        params: Vec::new(),
        nodes: Vec::new(),
        machines: None,
        link: LinkEntry::default(),
        is_for_one_machine: true,
        diagnostics: Diagnostics::new(path),
    };
    let (mut has_name, mut has_nodes, mut link_at) = (false, false, None);
    for entry in entries {
        match entry.key.text.as_str() {
            "version" => {}
            "name" => (has_name, file.name) = (true, read_name(&entry.value, diagnostics)),
            "params" => file.params = entries_or_nothing(entry.value, "params", diagnostics).unwrap_or_default(),
            "operators" => (has_nodes, file.nodes) = (true, read_nodes(entry, diagnostics)),
            "machines" => {
                file.is_for_one_machine = false;
                file.machines = read_machines(entry, diagnostics);
            }
            "link" => (link_at, file.link) = (Some(entry.key.at), read_link(entry, diagnostics)),
            _ => {
                unknown_key(&entry.key, "", &FILE_KEYS, diagnostics);
                // A key that was meant to be 'machines' is mistake enough.
                file.is_for_one_machine &= did_you_mean(&entry.key.text, ["machines"]).is_none();
            }
        }
    }
    if !has_name {
        let help = Some("give the graph a name, like 'name: grasp_gate'".to_owned());
        diagnostics.push_with_help(start, "the key 'name' is missing", help);
    }
    if !has_nodes {
        diagnostics.push(start, "the key 'operators' is missing");
    }
    check_places_and_link(&file, link_at, diagnostics);
    Some(file)
}

/// The text of a file that may be a dataflow file.
fn text_of<'a>(content: &'a [u8], diagnostics: &mut Diagnostics) -> Option<&'a str> {
    // JSON is YAML as well.
    match FileKind::of(content) {
        None | Some(FileKind::Dataflow | FileKind::Empty | FileKind::Json) => {}
        Some(other) => {
            let message = format!("not a dataflow file: expected YAML with operators, found {}", other.description());
            diagnostics.push(None, message);
            return None;
        }
    }
    if content.len() > MAX_FILE_BYTES {
        diagnostics.push(None, "larger than 1 MiB, so it is not a dataflow file");
        return None;
    }
    match std::str::from_utf8(content) {
        Ok(text) => Some(text),
        Err(error) => {
            diagnostics.push(position_after(&content[..error.valid_up_to()]), "not UTF-8 text");
            None
        }
    }
}

/// The document with its variables filled in.
fn read_root(text: &str, variable: &dyn Fn(&str) -> Option<String>, diagnostics: &mut Diagnostics) -> Option<Value> {
    let mut root = yaml::parse(text, diagnostics)?;
    let n_before = diagnostics.len();
    fill_in(&mut root, variable, diagnostics);
    // A value that is not known would be a second mistake.
    if diagnostics.len() > n_before { None } else { Some(root) }
}

/// The keys of a file with their values. In another version, the other keys may mean something else.
fn entries_of_this_version(root: Value, diagnostics: &mut Diagnostics) -> Option<Vec<Entry>> {
    let start = root.at;
    let Content::Mapping(entries) = root.content else {
        let help = format!("it begins with 'version: 1' and has the keys {}", FILE_KEYS.join(", "));
        let message = format!("a dataflow file is a mapping, found {}", root.found());
        diagnostics.push_with_help(start, message, Some(help));
        return None;
    };
    let Some(version) = entries.iter().find(|entry| entry.key.text == "version") else {
        let help = Some("write 'version: 1'".to_owned());
        diagnostics.push_with_help(start, "the key 'version' is missing", help);
        return Some(entries);
    };
    match &version.value.content {
        Content::Scalar { text, plain: true } if text == "1" => Some(entries),
        _ => {
            let message = format!("version must be 1, found {}", version.value.found());
            diagnostics.push(version.value.at, message);
            None
        }
    }
}

/// Checks that the nodes' places, the machines and the link fit together.
fn check_places_and_link(file: &DataflowFile, link_at: Option<Position>, diagnostics: &mut Diagnostics) {
    if file.is_for_one_machine {
        if let Some(at) = link_at {
            let help = Some("leave it out, or name the machines that it links".to_owned());
            diagnostics.push_with_help(at, "'link' has no meaning without the key 'machines'", help);
        }
        check_no_places(&file.nodes, diagnostics);
    } else if let Some(machines) = &file.machines {
        check_security(machines, &file.link, diagnostics);
        check_places(machines, &file.nodes, diagnostics);
    }
}

fn read_name(value: &Value, diagnostics: &mut Diagnostics) -> String {
    match &value.content {
        Content::Scalar { text, .. } if !value.is_null() => {
            check_name(&Text { text: text.clone(), at: value.at }, "name", diagnostics);
            text.clone()
        }
        _ => {
            diagnostics.push(value.at, format!("name must be text, found {}", value.found()));
            String::new()
        }
    }
}

fn read_nodes(operators: Entry, diagnostics: &mut Diagnostics) -> Vec<NodeEntry> {
    let at = operators.key.at;
    let Some(mut entries) = entries_or_nothing(operators.value, "operators", diagnostics) else {
        return Vec::new();
    };
    if entries.is_empty() {
        diagnostics.push(at, "there are no operators");
    }
    if let Some(first_beyond) = entries.get(MAX_NODES) {
        let message = format!("{} operators, at most {MAX_NODES} are allowed", entries.len());
        diagnostics.push(first_beyond.key.at, message);
        entries.truncate(MAX_NODES);
    }
    entries.into_iter().map(|entry| read_node(entry, diagnostics)).collect()
}

/// Where the text after these bytes begins, which are UTF-8.
fn position_after(valid: &[u8]) -> Position {
    let line_start = valid.iter().rposition(|&byte| byte == b'\n').map_or(0, |newline_idx| newline_idx + 1);
    let n_lines_before = valid.iter().filter(|&&byte| byte == b'\n').count();
    let n_chars_before = String::from_utf8_lossy(&valid[line_start..]).chars().count();
    Position { line: n_lines_before + 1, column: n_chars_before + 1 }
}
