//! The values of a node's params, from the file, `--set` on the command line, or a running graph.

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use crate::dataflow::diagnostic::{Diagnostics, did_you_mean_or_list, list, quote_path};
use crate::dataflow::node::NodeEntry;
use crate::dataflow::yaml::{Content, Entry, Value as Written};
use blindgrasp_messages::files::neighbours;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::param::{ParamDescription, ParamKind};
use blindgrasp_operator::text::is_name;
use blindgrasp_operator::text::{did_you_mean, quote};

/// A param with another value than the file's: `node.param=value`, or `param=value` for each node that has the param.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Override {
    /// `None` for all nodes that have the param.
    pub node: Option<String>,
    pub param: String,
    /// The value, in the form of the param's kind. A path is relative to the current folder.
    pub text: String,
}

impl Override {
    /// Reads `node.param=value` or `param=value`, as it stands after `--set`.
    ///
    /// # Errors
    /// The form is wrong, or a name is not one of a node or param.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wrong =
            || format!("expected node.param=value, like lift_arbiter.votes=5, or param=value, found {}", quote(text));
        let (place, value) = text.split_once('=').ok_or_else(wrong)?;
        let (node, param) = place.split_once('.').map_or((None, place), |(node, param)| (Some(node), param));
        if !is_name(param) || node.is_some_and(|node| !is_name(node)) {
            return Err(wrong());
        }
        Ok(Self { node: node.map(str::to_owned), param: param.to_owned(), text: value.to_owned() })
    }

    /// Whether it sets a param of this node, if the node has the param.
    #[must_use]
    pub fn is_of(&self, node: &str) -> bool {
        self.node.as_deref().is_none_or(|own| own == node)
    }
}

impl fmt::Display for Override {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(node) = &self.node {
            write!(f, "{node}.")?;
        }
        write!(f, "{}={}", self.param, self.text)
    }
}

/// The value of a param, given as text without quotes (`name=value` on a command line).
///
/// A relative path is relative to `folder`, which may itself be relative to the current folder.
///
/// # Errors
/// The operator has no such param, the value is not of its kind, or a path that must exist does not; for a person to
/// read.
pub fn accept_param(description: &OperatorDescription, name: &str, text: &str, folder: &Path) -> Result<Value, String> {
    let of = of_operator(description);
    let param = find_param(&description.params, name, &of)?;
    Ok(accept_text(param, text, &of, folder)?)
}

/// As [`accept_param`], for a value of JSON.
///
/// # Errors
/// As [`accept_param`].
pub fn accept_param_value(
    description: &OperatorDescription,
    name: &str,
    value: &Value,
    folder: &Path,
) -> Result<Value, String> {
    let of = of_operator(description);
    let param = find_param(&description.params, name, &of)?;
    let (found, help) = match value {
        Value::Null => ("nothing".to_owned(), None),
        Value::Bool(_) | Value::Number(_) => (quote(&value.to_string()), None),
        Value::String(text) => (format!("the string {}", quote(text)), param.kind.help(text, false)),
        Value::Array(_) => ("a list".to_owned(), None),
        Value::Object(_) => ("a mapping".to_owned(), None),
    };
    let Some(accepted) = param.kind.accept(value) else {
        return Err(wrong(param, &of, &found, help).into());
    };
    Ok(settle(param, accepted, &of, folder)?)
}

/// The param of this name, if it can be changed while the operator runs.
///
/// # Errors
/// There is no such param, or it is not live; for a person to read, with the live ones and what else can be done.
pub fn live_param<'a>(description: &'a OperatorDescription, name: &str) -> Result<&'a ParamDescription, String> {
    let of = of_operator(description);
    let param = find_param(&description.params, name, &of)?;
    if param.live {
        return Ok(param);
    }
    let live = description.params.iter().filter(|param| param.live).map(|param| param.name.as_str());
    Err(format!(
        "param {} of {of} cannot be changed while it runs; {}; the others change with: blindgrasp swap NODE --set \
         {name}=VALUE",
        quote(name),
        list("live params", live)
    ))
}

/// The reason to refuse a value, in the two parts of a diagnostic.
struct Refusal {
    message: String,
    help: Option<String>,
}

impl From<Refusal> for String {
    fn from(Refusal { message, help }: Refusal) -> Self {
        match help {
            Some(help) => format!("{message}; {help}"),
            None => message,
        }
    }
}

/// The params of a node as the overrides, the node, or the file for all nodes say, with defaults filled in and paths
/// absolute.
pub(super) fn check_params(
    entry: &NodeEntry,
    descriptions: &[ParamDescription],
    shared: &[Entry],
    overrides: &[Override],
    folder: &Path,
    diagnostics: &mut Diagnostics,
) -> Map<String, Value> {
    let of = format!("node {}", quote(&entry.id.text));
    let mut misspelled = Vec::new();
    for Entry { key, .. } in &entry.params {
        if let Err(Refusal { message, help }) = find_param(descriptions, &key.text, &of) {
            diagnostics.push_with_help(key.at, message, help);
            misspelled.push(key.text.as_str());
        }
    }
    let mut sets: Vec<_> = overrides.iter().filter(|set| set.node.as_ref() == Some(&entry.id.text)).collect();
    for set in &sets {
        if let Err(Refusal { message, help }) = find_param(descriptions, &set.param, &of) {
            diagnostics.push_of_setting(set, message, help);
            misspelled.push(set.param.as_str());
        }
    }
    // Of this node alone before those of all nodes.
    sets.extend(overrides.iter().filter(|set| set.node.is_none()));

    let mut params = Map::new();
    for param in descriptions {
        let set = sets.iter().find(|set| set.param == param.name);
        if param.optional && set.is_some_and(|set| param.kind.is_left_out(&set.text)) {
            continue;
        }
        let value = if let Some(set) = set {
            let accepted = accept_text(param, &set.text, &of, Path::new(""));
            accepted.map_err(|Refusal { message, help }| diagnostics.push_of_setting(set, message, help)).ok()
        } else if let Some(Entry { value, .. }) =
            entry.params.iter().chain(shared).find(|given| given.key.text == param.name)
        {
            let settled = accept_written(param, value, &of, folder);
            settled.map_err(|Refusal { message, help }| diagnostics.push_with_help(value.at, message, help)).ok()
        } else if let Some(accepted) = param.default.as_ref().and_then(|default| param.kind.accept(default)) {
            let settled = settle(param, accepted, &format!("{of}, by default"), folder);
            settled.map_err(|Refusal { message, help }| diagnostics.push_with_help(entry.params_at, message, help)).ok()
        } else {
            let is_misspelled = misspelled.iter().any(|wrong| did_you_mean(wrong, [param.name.as_str()]).is_some());
            if param.is_required() && !entry.is_damaged && !is_misspelled {
                let message = format!("{of} lacks the param {}, {}", quote(&param.name), param.kind);
                let help = Some(param.summary.clone()).filter(|summary| !summary.is_empty());
                diagnostics.push_with_help(entry.params_at, message, help);
            }
            None
        };
        if let Some(value) = value {
            params.insert(param.name.clone(), value);
        }
    }
    params
}

/// A value of the file.
fn accept_written(param: &ParamDescription, value: &Written, of: &str, folder: &Path) -> Result<Value, Refusal> {
    let Content::Scalar { text, plain } = &value.content else {
        return Err(wrong(param, of, &value.found(), None));
    };
    match param.kind.accept_scalar(text, *plain) {
        Some(accepted) => settle(param, accepted, of, folder),
        None => Err(wrong(param, of, &value.found(), param.kind.help(text, *plain))),
    }
}

/// Overrides of nodes that are not there, and a param given twice.
pub(super) fn check_overrides(overrides: &[Override], nodes: &[NodeEntry], diagnostics: &mut Diagnostics) {
    for (set_idx, set) in overrides.iter().enumerate() {
        // In a file without nodes, only that is the mistake.
        if let Some(id) = set.node.as_deref().filter(|id| !nodes.iter().any(|node| node.id.text == *id))
            && !nodes.is_empty()
        {
            let help = did_you_mean_or_list(id, "nodes", nodes.iter().map(|node| node.id.text.as_str()));
            diagnostics.push_of_setting(set, format!("there is no node {}", quote(id)), help);
        }
        let mut before = overrides[..set_idx].iter();
        if let Some(first) = before.find(|other| other.node == set.node && other.param == set.param) {
            diagnostics.push_of_setting(set, format!("given twice, first as {}", quote(&first.to_string())), None);
        }
    }
}

/// Params for all nodes that no node has. `descriptions` are those of all nodes.
pub(super) fn check_shared(
    shared: &[Entry],
    overrides: &[Override],
    descriptions: &[&OperatorDescription],
    diagnostics: &mut Diagnostics,
) {
    let names: BTreeSet<&str> =
        descriptions.iter().flat_map(|of| &of.params).map(|param| param.name.as_str()).collect();
    for Entry { key, .. } in shared {
        if !names.contains(key.text.as_str()) {
            let help = did_you_mean_or_list(&key.text, "params", names.iter().copied());
            diagnostics.push_with_help(key.at, format!("no node has the param {}", quote(&key.text)), help);
        }
    }
    for set in overrides {
        if set.node.is_none() && !names.contains(set.param.as_str()) {
            let help = did_you_mean_or_list(&set.param, "params", names.iter().copied());
            diagnostics.push_of_setting(set, format!("no node has the param {}", quote(&set.param)), help);
        }
    }
}

/// A path made absolute, `./` and the like dropped.
pub(super) fn absolute(folder: &Path, path: &str) -> PathBuf {
    let path = folder.join(path);
    // This fails only if the current folder is needed and gone.
    std::path::absolute(&path).unwrap_or(path)
}

fn of_operator(description: &OperatorDescription) -> String {
    format!("operator {}", quote(&description.operator))
}

fn find_param<'a>(params: &'a [ParamDescription], name: &str, of: &str) -> Result<&'a ParamDescription, Refusal> {
    params.iter().find(|param| param.name == name).ok_or_else(|| Refusal {
        message: format!("unknown param {} of {of}", quote(name)),
        help: did_you_mean_or_list(name, "params", params.iter().map(|param| param.name.as_str())),
    })
}

/// A text without quotes: for a param of any text, `null` and nothing are texts, too.
fn accept_text(param: &ParamDescription, text: &str, of: &str, folder: &Path) -> Result<Value, Refusal> {
    let plain = !matches!(param.kind, ParamKind::Path { .. } | ParamKind::String {});
    match param.kind.accept_scalar(text, plain) {
        Some(accepted) => settle(param, accepted, of, folder),
        None => Err(wrong(param, of, &quote(text), param.kind.help(text, plain))),
    }
}

/// Makes a path absolute and checks that it exists; other values stay as they are.
fn settle(param: &ParamDescription, accepted: Value, of: &str, folder: &Path) -> Result<Value, Refusal> {
    let (ParamKind::Path { must_exist }, Value::String(path)) = (&param.kind, &accepted) else {
        return Ok(accepted);
    };
    let path = absolute(folder, path);
    let shown = quote_path(&path);
    let refuse = |problem: String, help| Refusal {
        message: format!("param {} of {of}: {shown} {problem}", quote(&param.name)),
        help,
    };
    if *must_exist {
        match path.try_exists() {
            Ok(true) => {}
            Ok(false) => return Err(refuse("does not exist".to_owned(), neighbours(&path))),
            Err(error) => return Err(refuse(format!("cannot be reached: {error}"), None)),
        }
    }
    match path.into_os_string().into_string() {
        Ok(path) => Ok(Value::from(path)),
        Err(_) => Err(refuse("is not UTF-8".to_owned(), None)),
    }
}

fn wrong(param: &ParamDescription, of: &str, found: &str, help: Option<String>) -> Refusal {
    Refusal { message: format!("param {} of {of} must be {}, found {found}", quote(&param.name), param.kind), help }
}
