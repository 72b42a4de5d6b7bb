//! The dataflow file: reading it, and its form. What its names refer to is checked in `check`.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::diagnostic::{DataflowError, Diagnostics, Position, did_you_mean_or_list, quote};
use super::yaml::{self, Content, Entry, Text, Value};

/// Far above any graph that a machine can run; a file beyond it is not a dataflow file.
const MAX_FILE_BYTES: usize = 1 << 20;
/// Each node is a process. The bound also keeps the searches over all nodes short.
const MAX_NODES: usize = 256;
/// A name becomes part of service and file names, whose length the system limits.
const MAX_NAME_CHARS: usize = 32;

const FILE_KEYS: [&str; 3] = ["version", "name", "operators"];
const NODE_KEYS: [&str; 3] = ["run", "inputs", "params"];

/// A dataflow file that was read. Only `check` says whether it is right: mistakes of form that leave the rest
/// readable are kept in it, so that they can be reported together with the others.
#[derive(Debug, Clone)]
pub struct DataflowFile {
    path: PathBuf,
    pub(super) absolute_path: PathBuf,
    pub(super) name: String,
    pub(super) nodes: Vec<NodeEntry>,
    pub(super) diagnostics: Diagnostics,
}

/// A node as the file describes it.
#[derive(Debug, Clone)]
pub(super) struct NodeEntry {
    pub(super) id: Text,
    /// What it runs; `None` when that could not be read.
    pub(super) run: Option<Text>,
    pub(super) inputs: Vec<InputEntry>,
    pub(super) params: Vec<Entry>,
    /// Where to say that an input is missing.
    pub(super) inputs_at: Position,
    /// Where to say that a param is missing.
    pub(super) params_at: Position,
    /// Something of it could not be read, so that what is missing may have been meant.
    pub(super) is_damaged: bool,
}

#[derive(Debug, Clone)]
pub(super) struct InputEntry {
    pub(super) port: Text,
    /// `None` when it has not the form node/port.
    pub(super) source: Option<Source>,
}

#[derive(Debug, Clone)]
pub(super) struct Source {
    pub(super) node: String,
    pub(super) port: String,
    pub(super) at: Position,
}

impl DataflowFile {
    /// The file, as the caller named it.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// Reads a dataflow file.
///
/// # Errors
/// When the file cannot be read, is larger than 1 MiB, is not UTF-8, is not YAML without anchors, aliases and tags, is
/// of another version, or is no mapping. Other mistakes are left to [`super::check()`].
pub fn load(path: &Path) -> Result<DataflowFile, DataflowError> {
    match read(path) {
        Ok(bytes) => parse(path, &bytes),
        Err(error) => {
            let mut diagnostics = Diagnostics::new(path);
            diagnostics.push(None, format!("cannot read the file: {error}"));
            Err(diagnostics.into_error())
        }
    }
}

/// Reads the content of a dataflow file, as [`load`] does; `path` says where it stands.
///
/// # Errors
/// As [`load`].
pub fn parse(path: &Path, content: &[u8]) -> Result<DataflowFile, DataflowError> {
    let mut diagnostics = Diagnostics::new(path);
    match read_file(path, content, &mut diagnostics) {
        Some((absolute_path, name, nodes)) => {
            Ok(DataflowFile { path: path.to_owned(), absolute_path, name, nodes, diagnostics })
        }
        None => Err(diagnostics.into_error()),
    }
}

/// Whether a text can name a graph, node, port or param.
pub fn is_name(text: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&text.len())
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-')
}

/// At most one byte more than is allowed, also of a device that never ends.
fn read(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut content = Vec::new();
    File::open(path)?.take(MAX_FILE_BYTES as u64 + 1).read_to_end(&mut content)?;
    Ok(content)
}

fn read_file(path: &Path, content: &[u8], diagnostics: &mut Diagnostics) -> Option<(PathBuf, String, Vec<NodeEntry>)> {
    if content.len() > MAX_FILE_BYTES {
        diagnostics.push(None, "larger than 1 MiB, so it is not a dataflow file");
        return None;
    }
    let absolute_path = std::path::absolute(path)
        .map_err(|error| diagnostics.push(None, format!("cannot make the path absolute: {error}")))
        .ok()?;
    let text = std::str::from_utf8(content)
        .map_err(|error| diagnostics.push(position_after(&content[..error.valid_up_to()]), "not UTF-8 text"))
        .ok()?;
    let root = yaml::parse(text, diagnostics)?;
    let start = root.at;
    let Content::Mapping(entries) = root.content else {
        let help = format!("it begins with 'version: 1' and has the keys {}", FILE_KEYS.join(", "));
        let message = format!("a dataflow file is a mapping, found {}", root.found());
        diagnostics.push_with_help(start, message, Some(help));
        return None;
    };

    // Of another version nothing else can be said.
    let version = entries.iter().find(|entry| entry.key.text == "version");
    match version.map(|entry| (entry, &entry.value.content)) {
        None => {
            let help = Some("write 'version: 1'".to_owned());
            diagnostics.push_with_help(start, "the key 'version' is missing", help);
        }
        Some((_, Content::Scalar { text, plain: true })) if text == "1" => {}
        Some((entry, _)) => {
            let message = format!("version must be 1, found {}", entry.value.found());
            diagnostics.push(entry.value.at, message);
            return None;
        }
    }

    let mut name = None;
    let mut nodes = None;
    for entry in entries {
        match entry.key.text.as_str() {
            "version" => {}
            "name" => name = Some(read_name(&entry.value, diagnostics)),
            "operators" => nodes = Some(read_nodes(entry, diagnostics)),
            _ => unknown_key(&entry.key, "", &FILE_KEYS, diagnostics),
        }
    }
    if name.is_none() {
        let help = Some("give the graph a name, like 'name: grasp_gate'".to_owned());
        diagnostics.push_with_help(start, "the key 'name' is missing", help);
    }
    if nodes.is_none() {
        diagnostics.push(start, "the key 'operators' is missing");
    }
    Some((absolute_path, name.unwrap_or_default(), nodes.unwrap_or_default()))
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

fn read_node(entry: Entry, diagnostics: &mut Diagnostics) -> NodeEntry {
    let id = entry.key;
    check_name(&id, "node id", diagnostics);
    let node_name = format!("node {}", quote(&id.text));
    let mut node = NodeEntry {
        run: Some(id.clone()),
        inputs: Vec::new(),
        params: Vec::new(),
        inputs_at: id.at,
        params_at: id.at,
        is_damaged: false,
        id,
    };
    let Some(entries) = entries_or_nothing(entry.value, &node_name, diagnostics) else {
        node.is_damaged = true;
        return node;
    };
    for Entry { key, value } in entries {
        let what = format!("'{}' of {node_name}", key.text);
        match key.text.as_str() {
            "run" => match value.content {
                Content::Scalar { ref text, .. } if !value.is_null() && !text.is_empty() => {
                    node.run = Some(Text { text: text.clone(), at: value.at });
                }
                _ => {
                    let message = format!("{what} must be an operator's name or path, found {}", value.found());
                    diagnostics.push(value.at, message);
                    node.run = None;
                }
            },
            "inputs" => {
                node.inputs_at = key.at;
                match entries_or_nothing(value, &what, diagnostics) {
                    Some(entries) => {
                        let inputs = entries.into_iter().map(|entry| read_input(entry, &node_name, diagnostics));
                        node.inputs = inputs.collect();
                    }
                    None => node.is_damaged = true,
                }
            }
            "params" => {
                node.params_at = key.at;
                match entries_or_nothing(value, &what, diagnostics) {
                    Some(entries) => node.params = entries,
                    None => node.is_damaged = true,
                }
            }
            _ => {
                unknown_key(&key, &format!(" in {node_name}"), &NODE_KEYS, diagnostics);
                node.is_damaged = true;
            }
        }
    }
    node
}

fn read_input(entry: Entry, node_name: &str, diagnostics: &mut Diagnostics) -> InputEntry {
    let Entry { key: port, value } = entry;
    let source = match &value.content {
        Content::Scalar { text, .. } => text.split_once('/').filter(|(node, port)| is_name(node) && is_name(port)),
        _ => None,
    };
    let source = source.map(|(node, port)| Source { node: node.to_owned(), port: port.to_owned(), at: value.at });
    if source.is_none() {
        let message = format!("input {} of {node_name} must be node/port, found {}", quote(&port.text), value.found());
        let help = Some(format!("write which output it reads, like '{}: camera/image'", port.text));
        diagnostics.push_with_help(value.at, message, help.filter(|_| is_name(&port.text)));
    }
    InputEntry { port, source }
}

/// The entries of a mapping; none when nothing is there, as when every line below a key is commented out.
fn entries_or_nothing(value: Value, what: &str, diagnostics: &mut Diagnostics) -> Option<Vec<Entry>> {
    if value.is_null() {
        return Some(Vec::new());
    }
    if let Content::Mapping(entries) = value.content {
        return Some(entries);
    }
    diagnostics.push(value.at, format!("{what} must be a mapping, found {}", value.found()));
    None
}

fn check_name(name: &Text, what: &str, diagnostics: &mut Diagnostics) {
    if !is_name(&name.text) {
        let message = format!(
            "{what} {} must be letters (a-z, A-Z), digits, _ and -, at most {MAX_NAME_CHARS}",
            quote(&name.text)
        );
        diagnostics.push(name.at, message);
    }
}

fn unknown_key(key: &Text, place: &str, known: &[&str], diagnostics: &mut Diagnostics) {
    let help = did_you_mean_or_list(&key.text, "keys", known.iter().copied());
    diagnostics.push_with_help(key.at, format!("unknown key {}{place}", quote(&key.text)), help);
}

/// Where the text after these bytes begins, which are UTF-8.
fn position_after(valid: &[u8]) -> Position {
    let line_start = valid.iter().rposition(|&byte| byte == b'\n').map_or(0, |newline_idx| newline_idx + 1);
    let n_lines_before = valid.iter().filter(|&&byte| byte == b'\n').count();
    let n_chars_before = String::from_utf8_lossy(&valid[line_start..]).chars().count();
    Position { line: n_lines_before + 1, column: n_chars_before + 1 }
}
