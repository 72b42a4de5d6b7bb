//! The file's keys `machines` and `link`, and what `on` of a node refers to.

use std::path::Path;

use crate::dataflow::diagnostic::{Diagnostics, Position, did_you_mean_or_list, list};
use crate::dataflow::endpoint::Endpoint;
use crate::dataflow::form::{accept, accept_integer, check_name, entries_or_nothing, unknown_key};
use crate::dataflow::machines::{LinkSettings, Machine, Machines};
use crate::dataflow::node::NodeEntry;
use crate::dataflow::settings::absolute;
use crate::dataflow::yaml::{Content, Entry, Text, Value};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::text::quote;

pub(super) const MACHINE_KEYS: [&str; 1] = ["listen"];
pub(super) const LINK_KEYS: [&str; 5] = ["router", "keys", "insecure", "deadline_ms", "buffer"];
/// Each machine is linked to each that it shares an edge with.
const MAX_MACHINES: usize = 64;
/// With a shorter deadline, the scheduling of a busy machine would look like a cut.
pub(super) const MIN_DEADLINE_MILLIS: i64 = 20;
pub(super) const MAX_DEADLINE_MILLIS: i64 = 60_000;
/// About as many of the largest frames fit into a machine's memory.
pub(super) const MAX_BUFFER: i64 = 1_000_000;
/// Ids that a machine's part needs for itself: the link, and the launching command.
const RESERVED_IDS: [(&str, &str); 2] =
    [("link", "the process that links the machines"), ("run", "the launching command")];

#[derive(Debug, Clone)]
pub(super) struct MachinesEntry {
    pub(super) at: Position,
    pub(super) machines: Vec<MachineEntry>,
}

#[derive(Debug, Clone)]
pub(super) struct MachineEntry {
    pub(super) name: Text,
    listen: Vec<(Text, Endpoint)>,
    /// Whether the file wants it to listen, rightly written or not.
    pub(super) listens: bool,
}

#[derive(Debug, Clone, Default)]
pub(super) struct LinkEntry {
    router: Vec<(Text, Endpoint)>,
    /// Whether the file wants a router, rightly written or not.
    pub(super) has_router: bool,
    keys: Option<String>,
    has_keys: bool,
    settings: LinkSettings,
}

impl MachinesEntry {
    pub(super) fn names(&self) -> impl Iterator<Item = &str> + Clone {
        self.machines.iter().map(|machine| machine.name.text.as_str())
    }

    pub(super) fn find(&self, name: &str) -> Option<&MachineEntry> {
        self.machines.iter().find(|machine| machine.name.text == name)
    }

    /// As a graph has them; a path is relative to `folder`.
    pub(super) fn settle(&self, link: &LinkEntry, folder: &Path) -> Machines {
        let machines = self
            .machines
            .iter()
            .map(|machine| Machine { name: machine.name.text.clone(), listen: as_written(&machine.listen) });
        let link = LinkSettings {
            router: as_written(&link.router),
            keys: link.keys.as_ref().map(|keys| absolute(folder, keys)),
            ..link.settings.clone()
        };
        Machines { machines: machines.collect(), link }
    }
}

fn as_written(endpoints: &[(Text, Endpoint)]) -> Vec<String> {
    endpoints.iter().map(|(text, _)| text.text.clone()).collect()
}

/// The machines of the file; `None` when they cannot be known.
pub(super) fn read_machines(entry: Entry, diagnostics: &mut Diagnostics) -> Option<MachinesEntry> {
    let at = entry.key.at;
    let mut entries = entries_or_nothing(entry.value, "machines", diagnostics)?;
    if entries.is_empty() {
        let help = "name them, like 'machines: {robot: {}, brain: {listen: tls/192.168.1.10:7447}}', or leave it out";
        diagnostics.push_with_help(at, "there are no machines", Some(help.to_owned()));
        return None;
    }
    if let Some(first_beyond) = entries.get(MAX_MACHINES) {
        let message = format!("{} machines, at most {MAX_MACHINES} are allowed", entries.len());
        diagnostics.push(first_beyond.key.at, message);
        entries.truncate(MAX_MACHINES);
    }
    let machines = entries.into_iter().map(|entry| read_machine(entry, diagnostics)).collect();
    let machines = MachinesEntry { at, machines };
    check_endpoints(&machines, diagnostics);
    Some(machines)
}

fn read_machine(entry: Entry, diagnostics: &mut Diagnostics) -> MachineEntry {
    let name = entry.key;
    check_name(&name, "machine", diagnostics);
    let machine_name = format!("machine {}", quote(&name.text));
    let mut machine = MachineEntry { listen: Vec::new(), listens: false, name };
    let Some(entries) = entries_or_nothing(entry.value, &machine_name, diagnostics) else {
        machine.listens = true;
        return machine;
    };
    for Entry { key, value } in entries {
        let what = format!("{} of {machine_name}", quote(&key.text));
        match key.text.as_str() {
            "listen" => {
                let texts = read_texts(value, &what, "tls/192.168.1.10:7447", diagnostics);
                machine.listens = texts.as_ref().is_none_or(|texts| !texts.is_empty());
                machine.listen = read_endpoints(texts, &what, diagnostics);
            }
            _ => {
                unknown_key(&key, &format!(" in {machine_name}"), &MACHINE_KEYS, diagnostics);
                // It may have been meant to be 'listen'.
                machine.listens = true;
            }
        }
    }
    machine
}

pub(super) fn read_link(entry: Entry, diagnostics: &mut Diagnostics) -> LinkEntry {
    let mut link = LinkEntry::default();
    let Some(entries) = entries_or_nothing(entry.value, "link", diagnostics) else {
        (link.has_router, link.has_keys, link.settings.insecure) = (true, true, true);
        return link;
    };
    for Entry { key, value } in entries {
        let what = format!("{} of link", quote(&key.text));
        match key.text.as_str() {
            "router" => {
                let texts = read_texts(value, &what, "tls/gateway:7447", diagnostics);
                link.has_router = texts.as_ref().is_none_or(|texts| !texts.is_empty());
                link.router = read_endpoints(texts, &what, diagnostics);
            }
            "keys" => {
                link.has_keys = true;
                let kind = ParamKind::Path { must_exist: false };
                let accepted = accept(&value, &kind, &what, Some("name the machines' folder of keys"), diagnostics);
                link.keys = accepted.and_then(|keys| keys.as_str().map(str::to_owned));
            }
            "insecure" => {
                let accepted = accept(&value, &ParamKind::Boolean {}, &what, None, diagnostics);
                // A value that cannot be read is not reported as missing, too.
                link.settings.insecure = accepted.is_none_or(|insecure| insecure == true);
            }
            "deadline_ms" => {
                let bounds = [MIN_DEADLINE_MILLIS, MAX_DEADLINE_MILLIS];
                let accepted = accept_integer(&value, bounds, &what, None, diagnostics);
                link.settings.deadline_millis = accepted.unwrap_or(link.settings.deadline_millis);
            }
            "buffer" => {
                let accepted = accept_integer(&value, [1, MAX_BUFFER], &what, None, diagnostics);
                link.settings.buffer = accepted.unwrap_or(link.settings.buffer);
            }
            _ => {
                unknown_key(&key, " in link", &LINK_KEYS, diagnostics);
                (link.has_router, link.has_keys, link.settings.insecure) = (true, true, true);
            }
        }
    }
    link
}

/// A text, or a list of texts.
fn read_texts(value: Value, what: &str, like: &str, diagnostics: &mut Diagnostics) -> Option<Vec<Text>> {
    let must_be = format!("{what} must be a text or a list of texts");
    let items = match value.content {
        _ if value.is_null() => {
            let help = format!("write it like {like}, or leave it out");
            diagnostics.push_with_help(value.at, format!("{must_be}, found nothing"), Some(help));
            return None;
        }
        Content::List(items) => items,
        Content::Scalar { .. } => vec![value],
        Content::Mapping(_) => {
            let help = format!("write it like {like}");
            diagnostics.push_with_help(value.at, format!("{must_be}, found a mapping"), Some(help));
            return None;
        }
    };
    let mut texts = Vec::with_capacity(items.len());
    for item in &items {
        match &item.content {
            Content::Scalar { text, .. } if !item.is_null() => texts.push(Text { text: text.clone(), at: item.at }),
            _ => diagnostics.push(item.at, format!("{must_be}, found {} in it", item.found())),
        }
    }
    if texts.len() == items.len() { Some(texts) } else { None }
}

/// Reads endpoints, and refuses addresses to which no machine can connect.
fn read_endpoints(texts: Option<Vec<Text>>, what: &str, diagnostics: &mut Diagnostics) -> Vec<(Text, Endpoint)> {
    let mut endpoints = Vec::new();
    for text in texts.unwrap_or_default() {
        match Endpoint::parse(&text.text) {
            Err(help) => {
                let message =
                    format!("{what} must be tls/HOST:PORT, tcp/HOST:PORT or unix/NAME, found {}", quote(&text.text));
                diagnostics.push_with_help(text.at, message, Some(help));
            }
            Ok(endpoint) if endpoint.is_unspecified() => {
                let message = format!("{what}: nobody can connect to {}", quote(&text.text));
                let help = "write the address by which the others reach it; to listen elsewhere than they connect to: \
                            run --listen";
                diagnostics.push_with_help(text.at, message, Some(help.to_owned()));
            }
            Ok(endpoint) => endpoints.push((text, endpoint)),
        }
    }
    endpoints
}

/// Endpoints that two machines listen at.
fn check_endpoints(entry: &MachinesEntry, diagnostics: &mut Diagnostics) {
    for (machine_idx, machine) in entry.machines.iter().enumerate() {
        let of = format!("of machine {}", quote(&machine.name.text));
        let before = &entry.machines[..machine_idx];
        for (text, endpoint) in &machine.listen {
            for other in before {
                if other.listen.iter().any(|(_, other)| address(other) == address(endpoint)) {
                    let (other, address) = (quote(&other.name.text), quote(&text.text));
                    diagnostics.push(text.at, format!("'listen' {of}: machine {other} listens at {address} already"));
                    break;
                }
            }
        }
    }
}

/// Host and port, or the name of a socket.
fn address(endpoint: &Endpoint) -> (&str, u16) {
    match endpoint {
        Endpoint::Unix { name } => (name, 0),
        Endpoint::Tls { host, port } | Endpoint::Tcp { host, port } => (host, *port),
    }
}

/// Checks the keys of the link against the machines' endpoints.
pub(super) fn check_security(machines: &MachinesEntry, link: &LinkEntry, diagnostics: &mut Diagnostics) {
    let endpoints: Vec<_> = machines.machines.iter().flat_map(|machine| &machine.listen).chain(&link.router).collect();
    let first_tls = endpoints.iter().find(|(_, endpoint)| matches!(endpoint, Endpoint::Tls { .. }));
    if let (Some((text, _)), false) = (first_tls, link.has_keys) {
        let message = format!("{} needs certificates, but 'link' has no 'keys'", quote(&text.text));
        let help = "make them with 'blindgrasp keys' and write 'link: {keys: FOLDER}'".to_owned();
        diagnostics.push_with_help(text.at, message, Some(help));
    }
    for (text, endpoint) in endpoints {
        let Endpoint::Tcp { host, port } = endpoint else {
            continue;
        };
        if !link.settings.insecure {
            let message = format!("{} has no TLS: anybody who can reach it could be any machine", quote(&text.text));
            let help = format!(
                "write {} with 'keys' in 'link', or unix/NAME if the machines are one computer, or 'insecure: true' in \
                 'link' for a network that you trust",
                Endpoint::Tls { host: host.clone(), port: *port }
            );
            diagnostics.push_with_help(text.at, message, Some(help));
        }
    }
}

/// Whether each node says where it runs, and none takes a name that a machine's part needs.
pub(super) fn check_places(machines: &MachinesEntry, nodes: &[NodeEntry], diagnostics: &mut Diagnostics) {
    for node in nodes {
        let node_name = format!("node {}", quote(&node.id.text));
        if let Some((id, whose)) = RESERVED_IDS.iter().find(|(id, _)| node.id.text == *id) {
            let message = format!("node id '{id}' is taken: where a file names machines it is {whose}");
            diagnostics.push_with_help(node.id.at, message, Some("choose another".to_owned()));
        }
        match &node.on {
            Some(on) if machines.find(&on.text).is_none() => {
                let help = did_you_mean_or_list(&on.text, "machines", machines.names());
                let message = format!("'on' of {node_name}: there is no machine {}", quote(&on.text));
                diagnostics.push_with_help(on.at, message, help);
            }
            None if !node.has_on && !node.is_damaged => {
                let first = machines.names().next().unwrap_or_default();
                let help = format!("write where it runs, like 'on: {first}'; {}", list("machines", machines.names()));
                diagnostics.push_with_help(node.id.at, format!("{node_name} lacks the key 'on'"), Some(help));
            }
            _ => {}
        }
    }
}

/// Reports the first node with a machine in a file that names none; the others follow from it.
pub(super) fn check_no_places(nodes: &[NodeEntry], diagnostics: &mut Diagnostics) {
    if let Some((node, on)) = nodes.iter().find_map(|node| Some((node, node.on.as_ref()?))) {
        let message =
            format!("node {} is on {}, but the file names no machines", quote(&node.id.text), quote(&on.text));
        let help = format!("leave 'on' out, or name them, like 'machines: {{{}: {{}}}}'", on.text);
        diagnostics.push_with_help(on.at, message, Some(help));
    }
}
