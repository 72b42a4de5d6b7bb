//! The layouts of heads and items and the enums' codes, written down for Python: `operators/blindgrasp_messages.py`.
//!
//! The tables below name every field with its type; a field that is forgotten here does not compile.

use std::fmt::Write as _;
use std::mem::offset_of;
use std::path::{Path, PathBuf};
use std::process::Command;

use iceoryx2::prelude::ZeroCopySend;
use serde_json::{Value, json};

use super::*;

/// What a field is in Python, and the words for it in the comparison.
trait Portable {
    fn python() -> String;
    fn word() -> String;
}

macro_rules! portable {
    ($($type:ty: $python:literal, $word:literal;)+) => {$(
        impl Portable for $type {
            fn python() -> String { $python.into() }
            fn word() -> String { $word.into() }
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
    fn word() -> String {
        format!("{}_Array_{N}", T::word())
    }
}

struct Struct {
    name: &'static str,
    doc: &'static str,
    type_name: &'static str,
    n_bytes: usize,
    alignment: usize,
    fields: Vec<Field>,
}

struct Field {
    name: &'static str,
    offset: usize,
    n_bytes: usize,
    python: String,
    word: String,
}

macro_rules! structs {
    ($($name:ident, $doc:literal { $($field:ident: $type:ty),+ $(,)? })+) => {
        vec![$({
            // All its fields, with their types, or it does not compile.
            let _ = |$name { $($field),+ }: $name| -> ($($type),+) { ($($field),+) };
            Struct {
                name: stringify!($name),
                doc: $doc,
                // SAFETY: only the name is wanted.
                type_name: unsafe { <$name as ZeroCopySend>::type_name() },
                n_bytes: size_of::<$name>(),
                alignment: align_of::<$name>(),
                fields: vec![$(Field {
                    name: stringify!($field),
                    offset: offset_of!($name, $field),
                    n_bytes: size_of::<$type>(),
                    python: <$type>::python(),
                    word: <$type>::word(),
                }),+],
            }
        }),+]
    };
}

fn structs() -> Vec<Struct> {
    structs! {
        Header, "On each sample: which one it is and where it comes from." {
            seq: u64, stamp_nanos: u64, epoch: u64, hand_id: u64, origin_nanos: u64,
        }
        Contact, "One active cell, in the palm frame." {
            position_m: [f64; 3], normal: [f64; 3], force_newtons: f64, pad: u32, cell: u32,
        }
        TactileFrameHead, "The items are `n_joints` joint angles in radians, then the cells' forces in newtons." {
            header: Header, grasp_id: u64, phase: u32, n_joints: u32,
        }
        ContactSetHead, "The items are the contacts." {
            header: Header, grasp_id: u64, phase: u32, n_pads_in_contact: u32, self_collision: u32,
            n_self_contacts: u32, fault: u32, n_joints: u32, joints_rad: [f64; MAX_JOINTS],
        }
        GraspFeatureHead, "The items are the values, in the order of the model's feature blocks." {
            header: Header, grasp_id: u64, dictionary_id: u64, phase: u32, n_pads_in_contact: u32, fault: u32,
            reserved: u32,
        }
        PredictionHead, "There are no items." {
            header: Header, grasp_id: u64, decision_value: f64, probability_stable: f64, phase: u32, stable: u32,
            fault: u32, unsure: u32,
        }
        LiftDecisionHead, "There are no items." {
            header: Header, grasp_id: u64, probability_stable: f64, action: u32, reason: u32,
        }
        GraspTruthHead, "The items are the UTF-8 bytes of the object's name, then of its class." {
            header: Header, grasp_id: u64, epsilon: f64, volume: f64, stable: u32, n_object_bytes: u32,
        }
        LiftOutcomeHead, "The items are the UTF-8 bytes of the thing's name, then of its group." {
            header: Header, grasp_id: u64, trial: u64, slip_m: f64, turn_rad: f64, epsilon: f64, volume: f64,
            mass_kg: f64, friction: f64, attempt: u32, lifted: u32, held: u32, has_quality: u32, n_thing_bytes: u32,
            advised: u32,
        }
        RegraspAdviceHead, "The items are the proposals: position, rotation, probability, `n_joints` joint angles each." {
            header: Header, grasp_id: u64, n_proposals: u32, n_joints: u32,
        }
    }
}

/// An enum: name, and each word with its code.
type Codes = (&'static str, Vec<(&'static str, u32)>);

fn enums() -> Vec<Codes> {
    macro_rules! enums {
        ($($name:ident)+) => {
            vec![$((stringify!($name), $name::ALL.iter().map(|value| (value.word(), value.code())).collect())),+]
        };
    }
    enums! { Phase Fault Action Reason }
}

/// A message: name, type name, head, item in Python, item's word.
fn messages() -> Vec<[String; 5]> {
    fn message<M: Message>(name: &str) -> [String; 5]
    where
        M::Item: Portable,
    {
        let head = std::any::type_name::<M::Head>().rsplit("::").next().expect("a name");
        [name.into(), M::TYPE_NAME.into(), head.into(), M::Item::python(), M::Item::word()]
    }
    macro_rules! messages {
        ($($name:ident)+) => { vec![$(message::<$name>(stringify!($name))),+] };
    }
    messages! { TactileFrame ContactSet GraspFeature Prediction LiftDecision GraspTruth LiftOutcome RegraspAdvice }
}

const LIMITS: [(&str, usize); 6] = [
    ("MAX_JOINTS", MAX_JOINTS),
    ("MAX_PADS", MAX_PADS),
    ("MAX_CELLS", MAX_CELLS),
    ("MAX_FEATURES", MAX_FEATURES),
    ("MAX_NAME_BYTES", MAX_NAME_BYTES),
    ("MAX_PROPOSALS", MAX_PROPOSALS),
];

fn python_text() -> String {
    let mut text = String::from(
        "\"\"\"The samples of blindgrasp as they lie in shared memory: heads, items, enums' codes.\n\n\
         Generated from src/message.rs; do not edit. What each field means is said there and in docs/messages.md.\n\
         Needs nothing but Python.\n\"\"\"\n\n\
         import ctypes\nimport enum\n\n",
    );
    for (name, limit) in LIMITS {
        let _ = writeln!(text, "{name} = {limit}");
    }
    for (name, codes) in enums() {
        let _ = writeln!(text, "\n\nclass {name}(enum.IntEnum):");
        for (word, code) in codes {
            let _ = writeln!(text, "    {} = {code}", word.to_uppercase());
        }
    }
    for Struct { name, doc, type_name, fields, .. } in structs() {
        let _ = write!(text, "\n\nclass {name}(ctypes.Structure):\n    \"\"\"{doc}\"\"\"\n\n    _fields_ = [\n");
        for Field { name, python, .. } in fields {
            let _ = writeln!(text, "        (\"{name}\", {python}),");
        }
        let _ =
            write!(text, "    ]\n\n    @staticmethod\n    def type_name() -> str:\n        return \"{type_name}\"\n");
    }
    text += "\n\nclass Message:\n    \"\"\"What travels along an edge: the name of its type, its head, an item.\"\"\"\n\n    \
             TYPE_NAME: str\n    Head: type[ctypes.Structure]\n    Item: type\n";
    for [name, type_name, head, item, _] in messages() {
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
fn what_is_written_down_for_python_is_up_to_date() {
    let (path, text) = (python_file(), python_text());
    if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
        std::fs::write(&path, &text).expect("written");
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == text,
        "{} is not what src/message.rs says; remake it: BLINDGRASP_REMAKE=1 cargo test --release --lib layout",
        path.display()
    );
}

/// What Python itself says of the classes in the file.
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
    let structs: serde_json::Map<String, Value> = structs()
        .into_iter()
        .map(|Struct { name, type_name, n_bytes, alignment, fields, .. }| {
            let fields: Vec<Value> =
                fields.iter().map(|field| json!([field.name, field.offset, field.n_bytes, field.word])).collect();
            let layout = json!({"type_name": type_name, "n_bytes": n_bytes, "alignment": alignment, "fields": fields});
            (name.to_string(), layout)
        })
        .collect();
    let enums: serde_json::Map<String, Value> = enums()
        .into_iter()
        .map(|(name, codes)| {
            (
                name.into(),
                codes
                    .into_iter()
                    .map(|(word, code)| (word.to_string(), code.into()))
                    .collect::<serde_json::Map<String, Value>>()
                    .into(),
            )
        })
        .collect();
    let messages: serde_json::Map<String, Value> =
        messages().into_iter().map(|[name, type_name, head, _, item]| (name, json!([type_name, head, item]))).collect();
    let limits: serde_json::Map<String, Value> =
        LIMITS.into_iter().map(|(name, limit)| (name.into(), limit.into())).collect();
    let expected = json!({"structs": structs, "enums": enums, "messages": messages, "limits": limits});
    assert_eq!(seen, expected);
}
