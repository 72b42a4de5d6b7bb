//! A node in the file: its operator, inputs, params and supervision.

use crate::dataflow::diagnostic::{Diagnostics, Position};
use crate::dataflow::form::{accept, accept_integer, accept_number, check_name, entries_or_nothing, unknown_key};
use crate::dataflow::graph::{DEFAULT_HEARTBEAT_MILLIS, EdgeOptions, Restart, RestartPolicy};
use crate::dataflow::pins::Pins;
use crate::dataflow::process_options::{PROCESS_KEYS, ProcessOptions, read_option};
use crate::dataflow::yaml::{Content, Entry, Text, Value};
use crate::log::AUDIT;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::text::is_name;
use blindgrasp_operator::text::{did_you_mean, quote};
use blindgrasp_operator::wiring::{EdgePolicy, OnLate, Sandbox};

pub(super) const NODE_KEYS: [&str; 16] = [
    "run",
    "on",
    "args",
    "inputs",
    "params",
    "sha256",
    "sandbox",
    "memory_max_mib",
    "restart",
    "heartbeat_ms",
    PROCESS_KEYS[0],
    PROCESS_KEYS[1],
    PROCESS_KEYS[2],
    PROCESS_KEYS[3],
    PROCESS_KEYS[4],
    PROCESS_KEYS[5],
];
pub(super) const INPUT_KEYS: [&str; 7] =
    ["from", "policy", "capacity", "deadline_ms", "on_late", "tolerance_ms", "partner_wait_ms"];
pub(super) const RESTART_KEYS: [&str; 4] = ["policy", "limit", "within_s", "backoff_ms"];

/// All samples that wait on an edge are in shared memory at once.
pub(super) const MAX_CAPACITY: i64 = 4096;
/// A reader of the latest samples gets the newest only, unless it says otherwise.
const LATEST_CAPACITY: usize = 1;
pub(super) const MAX_RESTARTS: i64 = 1000;
/// Operators have a heartbeat every 100 ms. With a shorter limit, the scheduling of a busy machine would look like a
/// hang.
pub(super) const MIN_HEARTBEAT_MILLIS: f64 = 250.0;
pub(super) const HOUR_MILLIS: f64 = 3.6e6;
const FROM_ZERO: [f64; 2] = [0.0, HOUR_MILLIS];
pub(super) const DAY_SECS: f64 = 86_400.0;
/// An operator that does nothing has about this much.
pub(super) const MIN_MEMORY_MIB: i64 = 16;
pub(super) const MAX_MEMORY_MIB: i64 = 1 << 20;
/// Supervision counts in milliseconds, so a shorter window would be empty.
pub(super) const MIN_WINDOW_SECS: f64 = 0.001;

#[derive(Debug, Clone, Default)]
pub(super) struct NodeEntry {
    pub(super) id: Text,
    /// The operator; `None` if it could not be read.
    pub(super) run: Option<Text>,
    pub(super) on: Option<Text>,
    /// Whether the file has the key `on`, rightly or not.
    pub(super) has_on: bool,
    /// `None` if they could not be read: others may make the program another operator.
    pub(super) args: Option<Vec<String>>,
    pub(super) inputs: Vec<InputEntry>,
    pub(super) params: Vec<Entry>,
    pub(super) restart: Restart,
    pub(super) heartbeat_millis: Option<u64>,
    pub(super) sandbox: Sandbox,
    pub(super) memory_max_mib: Option<u64>,
    pub(super) process: ProcessOptions,
    /// The positions of errors about too many processes that poll, and about a group.
    pub(super) wait_at: Position,
    pub(super) group_at: Position,
    pub(super) pins: Vec<PinEntry>,
    /// The position of an error about a missing input.
    pub(super) inputs_at: Position,
    /// The position of an error about a missing param.
    pub(super) params_at: Position,
    /// A part could not be read, so that a missing input or param may have been meant.
    pub(super) is_damaged: bool,
}

/// The digests that a file of the node may have.
#[derive(Debug, Clone)]
pub(super) struct PinEntry {
    /// A param, or [`RUN`](crate::dataflow::pins::RUN).
    pub(super) of: Text,
    pub(super) digests: Vec<String>,
}

#[derive(Debug, Clone)]
pub(super) struct InputEntry {
    pub(super) port: Text,
    /// Written with a '?' behind the port: it is left out if the operator has no such input.
    pub(super) is_left_out_without_port: bool,
    /// `None` without the form node/port.
    pub(super) source: Option<Source>,
    pub(super) edge: EdgeOptions,
}

#[derive(Debug, Clone)]
pub(super) struct Source {
    pub(super) node: String,
    pub(super) port: String,
    pub(super) at: Position,
}

impl NodeEntry {
    /// A node of which the file says nothing but its id.
    fn new(id: Text) -> NodeEntry {
        NodeEntry {
            run: Some(id.clone()),
            args: Some(Vec::new()),
            heartbeat_millis: Some(DEFAULT_HEARTBEAT_MILLIS),
            wait_at: id.at,
            group_at: id.at,
            inputs_at: id.at,
            params_at: id.at,
            id,
            ..NodeEntry::default()
        }
    }

    fn read_key(&mut self, key: Text, value: Value, node_name: &str, diagnostics: &mut Diagnostics) {
        let what = format!("{} of {node_name}", quote(&key.text));
        match key.text.as_str() {
            "run" => self.run = read_run(value, &what, diagnostics),
            "on" => {
                self.has_on = true;
                self.on = read_on(&value, &what, diagnostics);
            }
            "args" => self.args = read_args(value, &what, diagnostics),
            "inputs" => {
                self.inputs_at = key.at;
                match entries_or_nothing(value, &what, diagnostics) {
                    Some(entries) => self.inputs = read_inputs(entries, node_name, diagnostics),
                    None => self.is_damaged = true,
                }
            }
            "params" => {
                self.params_at = key.at;
                match entries_or_nothing(value, &what, diagnostics) {
                    Some(entries) => self.params = entries,
                    None => self.is_damaged = true,
                }
            }
            "restart" => self.restart = read_restart(value, &what, diagnostics),
            "heartbeat_ms" => self.heartbeat_millis = read_heartbeat(&value, &what, diagnostics),
            "sandbox" => {
                let choices = [Sandbox::Off, Sandbox::On, Sandbox::Required];
                self.sandbox = one_of(&choices, &value, &what, None, diagnostics).unwrap_or_default();
            }
            "memory_max_mib" => {
                let bounds = [MIN_MEMORY_MIB, MAX_MEMORY_MIB];
                self.memory_max_mib = accept_integer(&value, bounds, &what, None, diagnostics);
            }
            "sha256" => {
                let entries = entries_or_nothing(value, &what, diagnostics).unwrap_or_default();
                self.pins = entries.into_iter().filter_map(|pin| read_pin(pin, &what, diagnostics)).collect();
            }
            text if PROCESS_KEYS.contains(&text) => {
                match text {
                    "wait" => self.wait_at = value.at,
                    "group" => self.group_at = value.at,
                    _ => {}
                }
                read_option(&mut self.process, text, value, &what, diagnostics);
            }
            _ => {
                unknown_key(&key, &format!(" in {node_name}"), &NODE_KEYS, diagnostics);
                self.is_damaged = true;
            }
        }
    }

    pub(super) fn pins(&self) -> Pins {
        Pins(self.pins.iter().map(|pin| (pin.of.text.clone(), pin.digests.clone())).collect())
    }

    /// The position of an error about a pinned file.
    pub(super) fn pin_at(&self, of: &str) -> Position {
        self.pins.iter().find(|pin| pin.of.text == of).map_or(self.id.at, |pin| pin.of.at)
    }
}

pub(super) fn read_node(entry: Entry, diagnostics: &mut Diagnostics) -> NodeEntry {
    let mut node = NodeEntry::new(entry.key);
    check_name(&node.id, "node id", diagnostics);
    if node.id.text == AUDIT {
        let message = format!("node id '{AUDIT}' is taken: it is the name of the audit log");
        diagnostics.push_with_help(node.id.at, message, Some("choose another".to_owned()));
    }
    let node_name = format!("node {}", quote(&node.id.text));
    let Some(entries) = entries_or_nothing(entry.value, &node_name, diagnostics) else {
        node.is_damaged = true;
        return node;
    };
    for Entry { key, value } in entries {
        node.read_key(key, value, &node_name, diagnostics);
    }
    node
}

fn read_run(value: Value, what: &str, diagnostics: &mut Diagnostics) -> Option<Text> {
    match value.content {
        Content::Scalar { ref text, .. } if !value.is_null() && !text.is_empty() => {
            Some(Text { text: text.clone(), at: value.at })
        }
        _ => {
            let message = format!("{what} must be an operator's name or path, found {}", value.found());
            diagnostics.push(value.at, message);
            None
        }
    }
}

/// One digest, or a list of those that the file may have.
fn read_pin(entry: Entry, what: &str, diagnostics: &mut Diagnostics) -> Option<PinEntry> {
    let Entry { key: of, value } = entry;
    let values = match value.content {
        Content::List(items) => items,
        _ => vec![value],
    };
    let mut digests = Vec::with_capacity(values.len());
    for value in &values {
        match &value.content {
            Content::Scalar { text, .. } if is_digest(text) => digests.push(text.to_ascii_lowercase()),
            _ => {
                let message =
                    format!("{} in {what} must be 64 hexadecimal digits, found {}", quote(&of.text), value.found());
                diagnostics.push_with_help(value.at, message, Some("sha256sum FILE prints them".to_owned()));
            }
        }
    }
    (digests.len() == values.len()).then_some(PinEntry { of, digests })
}

fn is_digest(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

fn read_on(value: &Value, what: &str, diagnostics: &mut Diagnostics) -> Option<Text> {
    match &value.content {
        Content::Scalar { text, .. } if !value.is_null() => Some(Text { text: text.clone(), at: value.at }),
        _ => {
            diagnostics.push(value.at, format!("{what} must be a machine's name, found {}", value.found()));
            None
        }
    }
}

fn read_args(value: Value, what: &str, diagnostics: &mut Diagnostics) -> Option<Vec<String>> {
    if value.is_null() {
        return Some(Vec::new());
    }
    let Content::List(items) = value.content else {
        let help = match &value.content {
            Content::Scalar { text, .. } => Some(format!("write [{text}]")),
            _ => None,
        };
        let message = format!("{what} must be a list of texts, found {}", value.found());
        diagnostics.push_with_help(value.at, message, help);
        return None;
    };
    let mut args = Vec::with_capacity(items.len());
    let mut is_right = true;
    for item in items {
        match item.content {
            Content::Scalar { text, .. } if text.contains('\0') => {
                diagnostics.push(item.at, format!("{what}: no argument can hold a zero byte, found {}", quote(&text)));
                is_right = false;
            }
            Content::Scalar { ref text, .. } if !item.is_null() => args.push(text.clone()),
            _ => {
                let message = format!("{what} must be a list of texts, found {} in it", item.found());
                let help = item.is_null().then(|| "an empty argument is ''".to_owned());
                diagnostics.push_with_help(item.at, message, help);
                is_right = false;
            }
        }
    }
    is_right.then_some(args)
}

fn read_inputs(entries: Vec<Entry>, node_name: &str, diagnostics: &mut Diagnostics) -> Vec<InputEntry> {
    let mut inputs: Vec<InputEntry> = Vec::with_capacity(entries.len());
    for entry in entries {
        let input = read_input(entry, node_name, diagnostics);
        let port = &input.port;
        if inputs.iter().any(|other| other.port.text == port.text) {
            let message = format!("input {} of {node_name} is given with a '?' and without", quote(&port.text));
            diagnostics.push_with_help(port.at, message, Some("leave one of them out".to_owned()));
        }
        inputs.push(input);
    }
    inputs
}

/// `node/port`, or a mapping with `from` and the edge's options.
fn read_input(entry: Entry, node_name: &str, diagnostics: &mut Diagnostics) -> InputEntry {
    let Entry { key: mut port, value } = entry;
    let is_left_out_without_port = port.text.ends_with('?');
    if is_left_out_without_port {
        port.text.pop();
    }
    let what = format!("input {} of {node_name}", quote(&port.text));
    let at = value.at;
    let Content::Mapping(entries) = value.content else {
        let source = read_source(&value, &port.text, &what, diagnostics);
        return InputEntry { port, is_left_out_without_port, source, edge: EdgeOptions::default() };
    };
    let mut source = None;
    let mut edge = EdgeOptions::default();
    let mut capacity = None;
    let mut has_from = false;
    let (mut has_deadline, mut late_at) = (false, None);
    for Entry { key, value } in entries {
        let of_what = format!("{} of {what}", quote(&key.text));
        match key.text.as_str() {
            "from" => {
                has_from = true;
                source = read_source(&value, "from", &of_what, diagnostics);
            }
            "policy" => {
                let policies = [EdgePolicy::Lossless, EdgePolicy::Latest];
                edge.policy = one_of(&policies, &value, &of_what, None, diagnostics).unwrap_or(edge.policy);
            }
            "capacity" => capacity = accept_integer(&value, [1, MAX_CAPACITY], &of_what, None, diagnostics),
            "deadline_ms" => {
                let kind = ParamKind::Number { above: Some(0.0), min: None, max: Some(HOUR_MILLIS), words: Vec::new() };
                let accepted = accept(&value, &kind, &of_what, None, diagnostics);
                edge.deadline_millis = accepted.and_then(|deadline| deadline.as_f64());
                has_deadline = true;
            }
            "tolerance_ms" => edge.tolerance_millis = accept_number(&value, FROM_ZERO, &of_what, diagnostics),
            "partner_wait_ms" => edge.partner_wait_millis = accept_number(&value, FROM_ZERO, &of_what, diagnostics),
            "on_late" => {
                let choices = [OnLate::Count, OnLate::Hold, OnLate::Stop];
                edge.on_late = one_of(&choices, &value, &of_what, None, diagnostics).unwrap_or_default();
                late_at = Some(key.at);
            }
            _ => {
                unknown_key(&key, &format!(" in {what}"), &INPUT_KEYS, diagnostics);
                has_from |= did_you_mean(&key.text, ["from"]).is_some();
            }
        }
    }
    if !has_from {
        let help = Some("write which output it reads, like 'from: camera/image'".to_owned());
        diagnostics.push_with_help(at, format!("{what} lacks the key 'from'"), help);
    }
    if let (Some(at), false) = (late_at, has_deadline) {
        let help = Some("write from which age on a sample is late, like 'deadline_ms: 20'".to_owned());
        diagnostics.push_with_help(at, format!("'on_late' of {what} has no meaning without 'deadline_ms'"), help);
    }
    let by_default = if edge.policy == EdgePolicy::Latest { LATEST_CAPACITY } else { edge.capacity };
    edge.capacity = capacity.unwrap_or(by_default);
    InputEntry { port, is_left_out_without_port, source, edge }
}

fn read_source(value: &Value, key: &str, what: &str, diagnostics: &mut Diagnostics) -> Option<Source> {
    let source = match &value.content {
        Content::Scalar { text, .. } => text.split_once('/').filter(|(node, port)| is_name(node) && is_name(port)),
        _ => None,
    };
    if source.is_none() {
        let message = format!("{what} must be node/port, found {}", value.found());
        let help = is_name(key).then(|| format!("write which output it reads, like '{key}: camera/image'"));
        diagnostics.push_with_help(value.at, message, help);
    }
    source.map(|(node, port)| Source { node: node.to_owned(), port: port.to_owned(), at: value.at })
}

/// A policy, or a mapping with the policy and its numbers.
fn read_restart(value: Value, what: &str, diagnostics: &mut Diagnostics) -> Restart {
    let mut restart = Restart::default();
    let Content::Mapping(entries) = value.content else {
        restart.policy = read_policy(&value, what, diagnostics).unwrap_or(restart.policy);
        return restart;
    };
    let mut numbers = Vec::new();
    for Entry { key, value } in entries {
        let of_what = format!("{} of {what}", quote(&key.text));
        match key.text.as_str() {
            "policy" => {
                restart.policy = read_policy(&value, &of_what, diagnostics).unwrap_or(restart.policy);
                continue;
            }
            "limit" => {
                let is_none = matches!(&value.content, Content::Scalar { text, .. } if text == "0");
                let help = is_none.then_some("to never restart it write 'restart: never'");
                let accepted = accept_integer(&value, [1, MAX_RESTARTS], &of_what, help, diagnostics);
                restart.limit = accepted.unwrap_or(restart.limit);
            }
            "within_s" => {
                let accepted = accept_number(&value, [MIN_WINDOW_SECS, DAY_SECS], &of_what, diagnostics);
                restart.within_millis = accepted.map_or(restart.within_millis, |secs| whole(1000.0 * secs));
            }
            "backoff_ms" => {
                let accepted = accept_number(&value, FROM_ZERO, &of_what, diagnostics);
                restart.backoff_millis = accepted.map_or(restart.backoff_millis, whole);
            }
            _ => {
                unknown_key(&key, &format!(" in {what}"), &RESTART_KEYS, diagnostics);
                continue;
            }
        }
        numbers.push(key);
    }
    if restart.policy == RestartPolicy::Never {
        for key in numbers {
            let message = format!("{} of {what} has no meaning with the policy 'never'", quote(&key.text));
            diagnostics.push_with_help(key.at, message, Some("leave it out".to_owned()));
        }
    }
    restart
}

fn read_policy(value: &Value, what: &str, diagnostics: &mut Diagnostics) -> Option<RestartPolicy> {
    let help = format!("or a mapping with the keys {}", RESTART_KEYS.join(", "));
    let help = matches!(value.content, Content::List(_)).then_some(help.as_str());
    let policies = [RestartPolicy::Never, RestartPolicy::OnFailure, RestartPolicy::Always];
    one_of(&policies, value, what, help, diagnostics)
}

/// `None` if it is not watched, or could not be read.
fn read_heartbeat(value: &Value, what: &str, diagnostics: &mut Diagnostics) -> Option<u64> {
    let kind = ParamKind::Number {
        above: None,
        min: Some(MIN_HEARTBEAT_MILLIS),
        max: Some(HOUR_MILLIS),
        words: vec!["off".to_owned()],
    };
    accept(value, &kind, what, None, diagnostics)?.as_f64().map(whole)
}

pub(super) fn one_of<T: Copy + ToString>(
    choices: &[T],
    value: &Value,
    what: &str,
    help: Option<&str>,
    diagnostics: &mut Diagnostics,
) -> Option<T> {
    let kind = ParamKind::Choice { values: choices.iter().map(T::to_string).collect() };
    let word = accept(value, &kind, what, help, diagnostics)?;
    choices.iter().copied().find(|choice| word == choice.to_string())
}

/// Rounds an accepted number, which is neither negative nor too large.
fn whole(millis: f64) -> u64 {
    millis.round() as u64
}
