//! The layouts of heads and items and the enums' codes, written down for Python: `operators/blindgrasp_messages.py`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use iceoryx2::prelude::ZeroCopySend;
use serde_json::{Map, Value, json};

use crate::*;

/// In Python, a head whose items are several lists finds them by these names.
const LISTS: &str = r#"

class Lists:
    """The lists among the items of a frame: `joints`, `cells`, and by name the `senses` that are there.

    Each can be set. A head that came with a sample has its `items`; give a head of your own its items first.
    """

    n_joints: int
    has_senses: int
    items: typing.Any

    def _spans(self) -> dict[str, slice]:
        if self.has_senses >> len(SENSES):
            raise ValueError(f"a frame has the unknown senses {self.has_senses}: expected at most {len(SENSES)} bits")
        spans, end = {"joints": slice(0, self.n_joints)}, self.n_joints
        for bit, (name, n_values) in enumerate(SENSES.items()):
            is_there = self.has_senses >> bit & 1
            start, end = end, end + is_there * (n_values or self.n_joints)
            spans[name] = slice(start, end)
        if end > len(self.items):
            raise ValueError(f"a frame of {len(self.items)} items says that it has {end} beside its cells: expected at most as many")
        spans["cells"] = slice(end, len(self.items))
        return spans

    def _set(self, lists: dict[str, typing.Any]) -> None:
        spans = self._spans()
        if all(len(values) == len(range(*spans[name].indices(len(self.items)))) for name, values in lists.items()):
            for name, values in lists.items():
                self.items[spans[name]] = values
            return
        parts = {name: lists.get(name, self.items[span]) for name, span in spans.items()}
        for name, n_values in SENSES.items():
            n_expected = n_values or len(parts["joints"])
            if len(parts[name]) not in (0, n_expected):
                raise ValueError(f"{name} has {len(parts[name])} values: expected {n_expected}, or none at all")
        values = [value for part in parts.values() for value in part]
        is_numpy = hasattr(self.items, "astype")
        self.items = type(self.items)(len(values)) if is_numpy else (ctypes.c_double * len(values))()
        self.items[:] = values
        self.n_joints = len(parts["joints"])
        self.has_senses = sum(1 << bit for bit, name in enumerate(SENSES) if len(parts[name]))

    @property
    def joints(self) -> typing.Any:
        """The joints' positions, in the hand's order: radians, and metres of joints that slide."""
        return self.items[self._spans()["joints"]]

    @joints.setter
    def joints(self, values: typing.Any) -> None:
        self._set({"joints": values})

    @property
    def cells(self) -> typing.Any:
        """The force on each cell, pad after pad."""
        return self.items[self._spans()["cells"]]

    @cells.setter
    def cells(self, values: typing.Any) -> None:
        self._set({"cells": values})

    @property
    def senses(self) -> dict[str, typing.Any]:
        """The lists of the other senses that the frame has, by name."""
        named = ((name, self.items[span]) for name, span in self._spans().items() if name not in ("joints", "cells"))
        return {name: values for name, values in named if len(values)}

    @senses.setter
    def senses(self, lists: dict[str, typing.Any]) -> None:
        unknown = lists.keys() - SENSES.keys()
        if unknown:
            raise ValueError(f"{', '.join(unknown)}: no such sense, expected some of {', '.join(SENSES)}")
        self._set({name: lists.get(name, ()) for name in SENSES})
"#;

/// A field's type in Python: as it is written there, and its name in the comparison.
pub(crate) trait Portable {
    fn python() -> String;
    fn name() -> String;
}

macro_rules! portable {
    ($($type:ty: $python:literal, $name:literal;)+) => {$(
        impl Portable for $type {
            fn python() -> String { $python.into() }
            fn name() -> String { $name.into() }
        }
    )+};
}

portable! {
    u8: "ctypes.c_uint8", "c_ubyte";
    u32: "ctypes.c_uint32", "c_uint";
    u64: "ctypes.c_uint64", "c_ulong";
    f64: "ctypes.c_double", "c_double";
    Header: "Header", "Header";
    Contact: "Contact", "Contact";
}

impl<T: Portable, const N: usize> Portable for [T; N] {
    fn python() -> String {
        format!("{} * {N}", T::python())
    }
    fn name() -> String {
        format!("{}_Array_{N}", T::name())
    }
}

/// A struct in shared memory. `shared!` writes down all its fields.
pub(crate) trait Shared: ZeroCopySend {
    fn layout() -> Struct;
}

pub(crate) struct Struct {
    name: &'static str,
    doc: &'static str,
    type_name: &'static str,
    n_bytes: usize,
    alignment: usize,
    fields: Vec<Field>,
}

pub(crate) struct Field {
    name: &'static str,
    offset: usize,
    n_bytes: usize,
    python: String,
    type_name: String,
}

pub(crate) struct MessageLayout {
    name: String,
    type_name: &'static str,
    head: Struct,
    /// In Python, and its name in the comparison.
    item: [String; 2],
}

pub(crate) fn field<T: Portable>(name: &'static str, offset: usize) -> Field {
    Field { name, offset, n_bytes: size_of::<T>(), python: T::python(), type_name: T::name() }
}

pub(crate) fn of_struct<T: ZeroCopySend>(name: &'static str, doc: &'static str, fields: Vec<Field>) -> Struct {
    // SAFETY: only the name is wanted.
    let type_name = unsafe { <T as ZeroCopySend>::type_name() };
    Struct { name, doc: doc.trim(), type_name, n_bytes: size_of::<T>(), alignment: align_of::<T>(), fields }
}

pub(crate) fn of_message<M: Message>() -> MessageLayout
where
    M::Head: Shared,
    M::Item: Portable,
{
    let name = M::SCHEMA.rsplit('/').next().unwrap_or_default().into();
    MessageLayout { name, type_name: M::TYPE_NAME, head: M::Head::layout(), item: [M::Item::python(), M::Item::name()] }
}

fn structs() -> Vec<Struct> {
    [Header::layout(), Contact::layout()].into_iter().chain(layouts().into_iter().map(|message| message.head)).collect()
}

const LIMITS: [(&str, usize); 5] = [
    ("MAX_JOINTS", MAX_JOINTS),
    ("MAX_PADS", MAX_PADS),
    ("MAX_CELLS", MAX_CELLS),
    ("MAX_FEATURES", MAX_FEATURES),
    ("MAX_NAME_BYTES", MAX_NAME_BYTES),
];

fn python_text() -> String {
    let mut text = String::from(
        "\"\"\"The samples of blindgrasp as they lie in shared memory: heads, items, enums' codes.\n\n\
         Generated from crates/messages; do not edit. What each field means is said there and in docs/messages.md.\n\
         Needs nothing but Python.\n\"\"\"\n\n\
         import ctypes\nimport enum\nimport typing\n\n",
    );
    for (name, limit) in LIMITS {
        let _ = writeln!(text, "{name} = {limit}");
    }
    text += "\n# The senses of a frame in order, each with the number of its values; None: one for each joint.\n";
    let senses = Sense::ALL.map(|sense| {
        let n_values = sense.n_values().map_or("None".into(), |n_values| n_values.to_string());
        format!("\"{}\": {n_values}", sense.name())
    });
    let _ = writeln!(text, "SENSES: dict[str, int | None] = {{{}}}", senses.join(", "));
    for Codes { name, words, .. } in coded_enums() {
        let _ = writeln!(text, "\n\nclass {name}(enum.IntEnum):");
        for (word, code) in words {
            let _ = writeln!(text, "    {} = {code}", word.to_uppercase());
        }
    }
    text += LISTS;
    for Struct { name, doc, type_name, fields, .. } in structs() {
        let has_lists = name == "TactileFrameHead";
        let bases = if has_lists { "Lists, ctypes.Structure" } else { "ctypes.Structure" };
        let _ = write!(text, "\n\nclass {name}({bases}):\n    \"\"\"{doc}\"\"\"\n\n    _fields_ = [\n");
        for Field { name, python, .. } in fields {
            let _ = writeln!(text, "        (\"{name}\", {python}),");
        }
        let _ =
            write!(text, "    ]\n\n    @staticmethod\n    def type_name() -> str:\n        return \"{type_name}\"\n");
    }
    text += "\n\nclass Message:\n    \"\"\"What travels along an edge: the name of its type, its head, an item.\"\"\"\n\n    \
             TYPE_NAME: str\n    Head: type[ctypes.Structure]\n    Item: type\n";
    for MessageLayout { name, type_name, head: Struct { name: head, .. }, item: [item, _] } in layouts() {
        let _ = write!(
            text,
            "\n\nclass {name}(Message):\n    TYPE_NAME = \"{type_name}\"\n    Head = {head}\n    Item = {item}\n"
        );
    }
    text + "\n\nMESSAGES: dict[str, type[Message]] = {message.TYPE_NAME: message for message in Message.__subclasses__()}\n"
}

fn python_file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../operators/blindgrasp_messages.py")
}

#[test]
fn the_python_file_is_up_to_date() {
    let (path, text) = (python_file(), python_text());
    if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
        std::fs::write(&path, &text).expect("written");
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == text,
        "{} does not match crates/messages; remake it: BLINDGRASP_REMAKE=1 cargo test -p blindgrasp-messages layout",
        path.display()
    );
}

/// Ports read the header of any message there.
#[test]
fn each_head_begins_with_the_header() {
    for MessageLayout { name, head, .. } in layouts() {
        let first = &head.fields[0];
        assert_eq!((first.name, first.offset, first.type_name.as_str()), ("header", 0, "Header"), "{name}");
    }
}

/// Prints what Python itself knows of the classes in the file.
const LOOK: &str = r#"
import ctypes, json, sys
sys.dont_write_bytecode = True
sys.path.insert(0, sys.argv[1])
import blindgrasp_messages as m
name = lambda t: t.__name__
structs = [c for c in vars(m).values() if isinstance(c, type) and issubclass(c, ctypes.Structure)]
enums = [c for c in vars(m).values() if isinstance(c, type) and issubclass(c, m.enum.IntEnum)]
print(json.dumps({
    "structs": {name(c): {"type_name": c.type_name(), "n_bytes": ctypes.sizeof(c), "alignment": ctypes.alignment(c),
        "fields": [[f, getattr(c, f).offset, getattr(c, f).size, name(t)] for f, t in c._fields_]} for c in structs},
    "enums": {name(c): {e.name.lower(): int(e) for e in c} for c in enums},
    "messages": {name(c): [c.TYPE_NAME, name(c.Head), name(c.Item)] for c in m.MESSAGES.values()},
    "limits": {k: v for k, v in vars(m).items() if k.startswith("MAX_")},
}))
"#;

#[test]
fn python_sees_every_field_where_rust_puts_it() {
    let folder = python_file();
    let output = Command::new("python3")
        .args(["-c", LOOK])
        .arg(folder.parent().expect("a folder"))
        .output()
        .expect("python3 is there; scripts/python-env installs it");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let seen: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let structs: Map<String, Value> = structs()
        .into_iter()
        .map(|Struct { name, type_name, n_bytes, alignment, fields, .. }| {
            let fields: Vec<Value> =
                fields.iter().map(|field| json!([field.name, field.offset, field.n_bytes, field.type_name])).collect();
            let layout = json!({"type_name": type_name, "n_bytes": n_bytes, "alignment": alignment, "fields": fields});
            (name.to_string(), layout)
        })
        .collect();
    let enums: Map<String, Value> = coded_enums()
        .into_iter()
        .map(|Codes { name, words, .. }| {
            let codes: Map<String, Value> =
                words.into_iter().map(|(word, code)| (word.to_string(), code.into())).collect();
            (name.into(), codes.into())
        })
        .collect();
    let messages: Map<String, Value> = layouts()
        .into_iter()
        .map(|message| (message.name, json!([message.type_name, message.head.name, message.item[1]])))
        .collect();
    let limits: Map<String, Value> = LIMITS.into_iter().map(|(name, limit)| (name.into(), limit.into())).collect();
    let expected = json!({"structs": structs, "enums": enums, "messages": messages, "limits": limits});
    assert_eq!(seen, expected);
}
