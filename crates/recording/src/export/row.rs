//! A sample as a row of values.

use serde::ser::{Impossible, SerializeMap, SerializeSeq, SerializeStruct, SerializeTuple};
use serde::{Serialize, Serializer};

use super::ExportError;
use super::exemplar::exemplar;
use crate::Record;
use blindgrasp_messages::{Recorded, Stamped};

/// What a column holds of a sample, as in JSON but with the types of numbers, and with NaN and infinity.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// A truth value.
    Bool(bool),
    /// A signed number of at most 32 bits.
    I32(i32),
    /// A signed number of 64 bits.
    I64(i64),
    /// An unsigned number of at most 32 bits.
    U32(u32),
    /// An unsigned number of 64 bits.
    U64(u64),
    /// A floating-point number.
    F64(f64),
    /// A text, a word of an enum or an identity.
    Text(String),
    /// Values of one kind.
    List(Vec<Value>),
    /// Named values.
    Struct(Vec<(&'static str, Value)>),
}

/// The columns of a sample: the header's fields, then the message's.
pub type Row = Vec<(&'static str, Value)>;

macro_rules! of_any_type {
    ($record:expr, $function:ident) => {
        match $record {
            Record::Tactile(sample) => $function(sample),
            Record::Contacts(sample) => $function(sample),
            Record::Feature(sample) => $function(sample),
            Record::Prediction(sample) => $function(sample),
            Record::Decision(sample) => $function(sample),
            Record::Truth(sample) => $function(sample),
            Record::Outcome(sample) => $function(sample),
            Record::Advice(sample) => $function(sample),
            Record::Scene(sample) => $function(sample),
        }
    };
}

/// A sample as a row.
///
/// # Errors
/// [`ExportError::Shape`].
pub fn row(record: &Record) -> Result<Row, ExportError> {
    of_any_type!(record, row_of)
}

/// A row of the same type in which every list of any length has one element: its columns are known without data.
pub(super) fn exemplar_row(record: &Record) -> Result<Row, ExportError> {
    fn like<M: Recorded>(_: &Stamped<M>) -> Result<Row, ExportError> {
        row_of(&exemplar::<Stamped<M>>()?)
    }
    of_any_type!(record, like)
}

/// The type of a sample's message, [`Recorded::TYPE_NAME`].
pub fn type_name(record: &Record) -> &'static str {
    fn name<M: Recorded>(_: &Stamped<M>) -> &'static str {
        M::TYPE_NAME
    }
    of_any_type!(record, name)
}

fn row_of<M: Recorded>(sample: &Stamped<M>) -> Result<Row, ExportError> {
    let mut row = fields(&sample.header)?;
    for (name, value) in &mut row {
        // The header holds it as a number; wherever people see it, it is hex, as the messages' own identities are.
        if let ("hand_id", Value::U64(id)) = (*name, &*value) {
            *value = Value::Text(format!("{id:016x}"));
        }
    }
    row.extend(fields(&sample.message)?);
    Ok(row)
}

fn fields<T: Serialize>(of: &T) -> Result<Row, ExportError> {
    match of.serialize(ToValue)? {
        Value::Struct(fields) => Ok(fields),
        other => Err(ExportError::Shape(format!("expected a struct with named fields, found {other:?}"))),
    }
}

/// For cells of a table that hold JSON; NaN and infinity are null, as in JSON lines.
impl Serialize for Value {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Value::Bool(value) => serializer.serialize_bool(*value),
            Value::I32(value) => serializer.serialize_i32(*value),
            Value::I64(value) => serializer.serialize_i64(*value),
            Value::U32(value) => serializer.serialize_u32(*value),
            Value::U64(value) => serializer.serialize_u64(*value),
            Value::F64(value) => serializer.serialize_f64(*value),
            Value::Text(value) => serializer.serialize_str(value),
            Value::List(items) => serializer.collect_seq(items),
            Value::Struct(fields) => {
                let mut map = serializer.serialize_map(Some(fields.len()))?;
                for (name, value) in fields {
                    map.serialize_entry(name, value)?;
                }
                map.end()
            }
        }
    }
}

/// A serializer that makes a [`Value`]: words for enums, as in JSON.
struct ToValue;

struct ToList(Vec<Value>);

struct ToStruct(Vec<(&'static str, Value)>);

fn unsupported<T>(what: &str) -> Result<T, ExportError> {
    Err(ExportError::Shape(format!("{what}: tables have columns for numbers, text, lists and structs only")))
}

impl Serializer for ToValue {
    type Ok = Value;
    type Error = ExportError;
    type SerializeSeq = ToList;
    type SerializeTuple = ToList;
    type SerializeTupleStruct = Impossible<Value, ExportError>;
    type SerializeTupleVariant = Impossible<Value, ExportError>;
    type SerializeMap = Impossible<Value, ExportError>;
    type SerializeStruct = ToStruct;
    type SerializeStructVariant = Impossible<Value, ExportError>;

    fn serialize_bool(self, value: bool) -> Result<Value, ExportError> {
        Ok(Value::Bool(value))
    }

    fn serialize_i8(self, value: i8) -> Result<Value, ExportError> {
        Ok(Value::I32(value.into()))
    }

    fn serialize_i16(self, value: i16) -> Result<Value, ExportError> {
        Ok(Value::I32(value.into()))
    }

    fn serialize_i32(self, value: i32) -> Result<Value, ExportError> {
        Ok(Value::I32(value))
    }

    fn serialize_i64(self, value: i64) -> Result<Value, ExportError> {
        Ok(Value::I64(value))
    }

    fn serialize_u8(self, value: u8) -> Result<Value, ExportError> {
        Ok(Value::U32(value.into()))
    }

    fn serialize_u16(self, value: u16) -> Result<Value, ExportError> {
        Ok(Value::U32(value.into()))
    }

    fn serialize_u32(self, value: u32) -> Result<Value, ExportError> {
        Ok(Value::U32(value))
    }

    fn serialize_u64(self, value: u64) -> Result<Value, ExportError> {
        Ok(Value::U64(value))
    }

    fn serialize_f32(self, value: f32) -> Result<Value, ExportError> {
        Ok(Value::F64(value.into()))
    }

    fn serialize_f64(self, value: f64) -> Result<Value, ExportError> {
        Ok(Value::F64(value))
    }

    fn serialize_char(self, value: char) -> Result<Value, ExportError> {
        Ok(Value::Text(value.into()))
    }

    fn serialize_str(self, value: &str) -> Result<Value, ExportError> {
        Ok(Value::Text(value.into()))
    }

    fn serialize_bytes(self, _: &[u8]) -> Result<Value, ExportError> {
        unsupported("bytes")
    }

    fn serialize_none(self) -> Result<Value, ExportError> {
        unsupported("an optional value")
    }

    fn serialize_some<T: Serialize + ?Sized>(self, _: &T) -> Result<Value, ExportError> {
        unsupported("an optional value")
    }

    fn serialize_unit(self) -> Result<Value, ExportError> {
        unsupported("a unit")
    }

    fn serialize_unit_struct(self, name: &'static str) -> Result<Value, ExportError> {
        unsupported(name)
    }

    fn serialize_unit_variant(self, name: &'static str, _: u32, _: &'static str) -> Result<Value, ExportError> {
        unsupported(name)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, of: &T) -> Result<Value, ExportError> {
        of.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<Value, ExportError> {
        unsupported(name)
    }

    fn serialize_seq(self, len: Option<usize>) -> Result<ToList, ExportError> {
        Ok(ToList(Vec::with_capacity(len.unwrap_or_default())))
    }

    fn serialize_tuple(self, len: usize) -> Result<ToList, ExportError> {
        Ok(ToList(Vec::with_capacity(len)))
    }

    fn serialize_tuple_struct(self, name: &'static str, _: usize) -> Result<Self::SerializeTupleStruct, ExportError> {
        unsupported(name)
    }

    fn serialize_tuple_variant(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeTupleVariant, ExportError> {
        unsupported(name)
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Self::SerializeMap, ExportError> {
        unsupported("a map")
    }

    fn serialize_struct(self, _: &'static str, len: usize) -> Result<ToStruct, ExportError> {
        Ok(ToStruct(Vec::with_capacity(len)))
    }

    fn serialize_struct_variant(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeStructVariant, ExportError> {
        unsupported(name)
    }
}

impl SerializeSeq for ToList {
    type Ok = Value;
    type Error = ExportError;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, item: &T) -> Result<(), ExportError> {
        self.0.push(item.serialize(ToValue)?);
        Ok(())
    }

    fn end(self) -> Result<Value, ExportError> {
        Ok(Value::List(self.0))
    }
}

impl SerializeTuple for ToList {
    type Ok = Value;
    type Error = ExportError;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, item: &T) -> Result<(), ExportError> {
        SerializeSeq::serialize_element(self, item)
    }

    fn end(self) -> Result<Value, ExportError> {
        SerializeSeq::end(self)
    }
}

impl SerializeStruct for ToStruct {
    type Ok = Value;
    type Error = ExportError;

    fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, of: &T) -> Result<(), ExportError> {
        self.0.push((name, of.serialize(ToValue)?));
        Ok(())
    }

    fn end(self) -> Result<Value, ExportError> {
        Ok(Value::Struct(self.0))
    }
}
