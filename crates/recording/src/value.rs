//! A sample as values with names: exact, unlike JSON, which has neither NaN nor infinity.

use std::fmt;

use serde::ser::{Impossible, SerializeSeq, SerializeStruct, SerializeTuple};
use serde::{Serialize, Serializer};

use crate::Record;
use blindgrasp_messages::with_sample;

/// A value in a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Bool(bool),
    Signed(i64),
    Unsigned(u64),
    Float(f64),
    /// A text, the word of an enum, or an identity in hexadecimal digits.
    Text(String),
    List(Vec<Value>),
    Struct(Vec<(&'static str, Value)>),
}

/// A message has a field that is no number, flag, text, list or struct.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a message cannot be taken apart: it holds {0}; expected numbers, flags, text, lists and structs")]
pub struct ValueError(String);

impl serde::ser::Error for ValueError {
    fn custom<T: fmt::Display>(message: T) -> Self {
        ValueError(message.to_string())
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::Bool(value) => write!(f, "{value}"),
            Value::Signed(value) => write!(f, "{value}"),
            Value::Unsigned(value) => write!(f, "{value}"),
            // The fewest digits that read back exactly, with an exponent where plain digits would be many.
            Value::Float(value) => write!(f, "{value:?}"),
            Value::Text(value) => f.write_str(value),
            Value::List(_) | Value::Struct(_) => fmt::Debug::fmt(self, f),
        }
    }
}

/// All numbers, flags and texts of a message with their paths, like `contacts[2].position_m[0]`, in the message's order.
///
/// # Errors
/// See [`ValueError`].
pub fn leaves(record: &Record) -> Result<Vec<(String, Value)>, ValueError> {
    fn add(path: String, value: Value, found: &mut Vec<(String, Value)>) {
        match value {
            Value::List(items) => {
                items.into_iter().enumerate().for_each(|(idx, item)| add(format!("{path}[{idx}]"), item, found));
            }
            Value::Struct(fields) => {
                fields.into_iter().for_each(|(name, value)| add(format!("{path}.{name}"), value, found));
            }
            leaf => found.push((path, leaf)),
        }
    }
    let Value::Struct(fields) = with_sample!(record, sample => sample.message.serialize(ToValue))? else {
        return Err(ValueError("no fields".into()));
    };
    let mut found = Vec::new();
    fields.into_iter().for_each(|(name, value)| add(name.into(), value, &mut found));
    Ok(found)
}

/// A serializer that makes a [`Value`].
struct ToValue;

struct Items(Vec<Value>);

struct Fields(Vec<(&'static str, Value)>);

macro_rules! scalars {
    ($($method:ident($type:ty) $variant:ident;)+) => {$(
        fn $method(self, value: $type) -> Result<Value, ValueError> {
            Ok(Value::$variant(value.into()))
        }
    )+};
}

macro_rules! unsupported {
    ($($method:ident($($type:ty),*) -> $returned:ty;)+) => {$(
        fn $method(self, $(_: $type),*) -> Result<$returned, ValueError> {
            Err(ValueError(stringify!($method).replace("serialize_", "a field of the kind ")))
        }
    )+};
}

type Never = Impossible<Value, ValueError>;

impl Serializer for ToValue {
    type Ok = Value;
    type Error = ValueError;
    type SerializeSeq = Items;
    type SerializeTuple = Items;
    type SerializeTupleStruct = Never;
    type SerializeTupleVariant = Never;
    type SerializeMap = Never;
    type SerializeStruct = Fields;
    type SerializeStructVariant = Never;

    scalars! {
        serialize_bool(bool) Bool;
        serialize_i8(i8) Signed;
        serialize_i16(i16) Signed;
        serialize_i32(i32) Signed;
        serialize_i64(i64) Signed;
        serialize_u8(u8) Unsigned;
        serialize_u16(u16) Unsigned;
        serialize_u32(u32) Unsigned;
        serialize_u64(u64) Unsigned;
        serialize_f32(f32) Float;
        serialize_f64(f64) Float;
        serialize_char(char) Text;
        serialize_str(&str) Text;
    }

    unsupported! {
        serialize_bytes(&[u8]) -> Value;
        serialize_none() -> Value;
        serialize_unit() -> Value;
        serialize_unit_struct(&'static str) -> Value;
        serialize_unit_variant(&'static str, u32, &'static str) -> Value;
        serialize_tuple_struct(&'static str, usize) -> Never;
        serialize_tuple_variant(&'static str, u32, &'static str, usize) -> Never;
        serialize_map(Option<usize>) -> Never;
        serialize_struct_variant(&'static str, u32, &'static str, usize) -> Never;
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<Value, ValueError> {
        value.serialize(self)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, value: &T) -> Result<Value, ValueError> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<Value, ValueError> {
        Err(ValueError(format!("the enum {name}, which has fields")))
    }

    fn serialize_seq(self, len: Option<usize>) -> Result<Items, ValueError> {
        Ok(Items(Vec::with_capacity(len.unwrap_or_default())))
    }

    fn serialize_tuple(self, len: usize) -> Result<Items, ValueError> {
        Ok(Items(Vec::with_capacity(len)))
    }

    fn serialize_struct(self, _: &'static str, len: usize) -> Result<Fields, ValueError> {
        Ok(Fields(Vec::with_capacity(len)))
    }
}

macro_rules! as_items {
    ($($trait:ident)+) => {$(
        impl $trait for Items {
            type Ok = Value;
            type Error = ValueError;

            fn serialize_element<T: Serialize + ?Sized>(&mut self, item: &T) -> Result<(), ValueError> {
                self.0.push(item.serialize(ToValue)?);
                Ok(())
            }

            fn end(self) -> Result<Value, ValueError> {
                Ok(Value::List(self.0))
            }
        }
    )+};
}
as_items!(SerializeSeq SerializeTuple);

impl SerializeStruct for Fields {
    type Ok = Value;
    type Error = ValueError;

    fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, value: &T) -> Result<(), ValueError> {
        self.0.push((name, value.serialize(ToValue)?));
        Ok(())
    }

    fn end(self) -> Result<Value, ValueError> {
        Ok(Value::Struct(self.0))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use blindgrasp_messages::{Contact, ContactSet, Fault, GraspScene, Header, Phase, SceneContact, Stamped};

    use super::*;
    use crate::tests::records;

    #[test]
    fn every_type_is_taken_apart_as_json_has_it() {
        for (_, record) in records() {
            let found = leaves(&record).expect("leaves");
            let names: BTreeSet<&str> = found.iter().filter_map(|(path, _)| path.split(['[', '.']).next()).collect();
            let json = record.to_json().expect("JSON");
            let fields = json.as_object().expect("an object").iter();
            // An empty list has no leaves.
            let expected: BTreeSet<&str> =
                fields.filter(|(_, value)| **value != serde_json::json!([])).map(|(name, _)| name.as_str()).collect();
            assert_eq!(names, expected, "{}", record.type_name());
        }
    }

    #[test]
    fn every_value_of_a_message_has_its_path() {
        let contact = Contact { position_m: [0.1, -0.0, f64::NAN], pad: 3, ..Contact::default() };
        let message = ContactSet {
            grasp_id: 7,
            phase: Phase::Settled,
            joints: vec![],
            contacts: vec![Contact::default(), contact],
            self_collision: true,
            fault: Fault::NoContact,
            ..ContactSet::default()
        };
        let found = leaves(&Record::Contacts(Stamped { header: Header::default(), message })).expect("leaves");
        let shown: Vec<String> = found.iter().map(|(path, leaf)| format!("{path}={leaf}")).collect();
        let expected = [
            "grasp_id=7",
            "phase=settled",
            "contacts[1].position_m[0]=0.1",
            "contacts[1].position_m[1]=-0.0",
            "contacts[1].position_m[2]=NaN",
            "contacts[1].pad=3",
            "self_collision=true",
            "fault=no_contact",
        ];
        for line in expected {
            assert!(shown.iter().any(|shown| shown == line), "{line} in {shown:?}");
        }
        // Two numbers, then nine for each contact, then five.
        assert_eq!(shown.len(), 2 + 2 * 9 + 5);

        let mut message = GraspScene::default();
        message.contacts.push(SceneContact { other_link: -1, ..SceneContact::default() });
        let found = leaves(&Record::Scene(Stamped { header: Header::default(), message })).expect("leaves");
        assert!(found.contains(&("contacts[0].other_link".into(), Value::Signed(-1))), "{found:?}");
    }
}
