//! A message as paths and values, exactly: JSON would lose NaN, and the difference between 0 and -0.

use std::fmt;

use serde::ser::{self, Serialize};

use blindgrasp_messages::Recorded;
use blindgrasp_recording::Record;

/// A value in a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Leaf {
    /// A count, an index or an identity.
    Unsigned(u64),
    /// A number that may be negative.
    Signed(i64),
    /// A measured or computed number.
    Float(f64),
    /// A flag.
    Bool(bool),
    /// A name, or the word of a coded value.
    Text(String),
}

impl fmt::Display for Leaf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Leaf::Unsigned(number) => write!(f, "{number}"),
            Leaf::Signed(number) => write!(f, "{number}"),
            // Enough digits to tell any two numbers apart.
            Leaf::Float(number) => write!(f, "{number:?}"),
            Leaf::Bool(flag) => write!(f, "{flag}"),
            Leaf::Text(text) => f.write_str(text),
        }
    }
}

/// All values of a message, with their paths, like `contacts[2].position_m[0]`, in the message's order.
///
/// # Errors
/// A message with something else in it than numbers, flags, texts, lists and structs: none of ours.
pub fn fields(record: &Record) -> Result<Vec<(String, Leaf)>, FieldError> {
    match record {
        Record::Tactile(sample) => flatten(&sample.message),
        Record::Contacts(sample) => flatten(&sample.message),
        Record::Feature(sample) => flatten(&sample.message),
        Record::Prediction(sample) => flatten(&sample.message),
        Record::Decision(sample) => flatten(&sample.message),
        Record::Truth(sample) => flatten(&sample.message),
        Record::Outcome(sample) => flatten(&sample.message),
        Record::Advice(sample) => flatten(&sample.message),
        Record::Scene(sample) => flatten(&sample.message),
    }
}

/// Why a message cannot be taken apart.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a message cannot be taken apart: {0}")]
pub struct FieldError(String);

impl ser::Error for FieldError {
    fn custom<T: fmt::Display>(message: T) -> Self {
        FieldError(message.to_string())
    }
}

fn flatten<M: Recorded>(message: &M) -> Result<Vec<(String, Leaf)>, FieldError> {
    let mut flattener = Flattener::default();
    message.serialize(&mut flattener)?;
    Ok(flattener.found)
}

/// Goes through a message, with the path to where it is.
#[derive(Default)]
struct Flattener {
    path: String,
    found: Vec<(String, Leaf)>,
}

/// The inside of a list or a struct.
struct Inside<'a> {
    flattener: &'a mut Flattener,
    n_items: usize,
}

impl Flattener {
    fn add(&mut self, leaf: Leaf) -> Result<(), FieldError> {
        self.found.push((self.path.clone(), leaf));
        Ok(())
    }

    fn below(&mut self, step: &str, value: &(impl Serialize + ?Sized)) -> Result<(), FieldError> {
        let n_bytes = self.path.len();
        self.path.push_str(step);
        let outcome = value.serialize(&mut *self);
        self.path.truncate(n_bytes);
        outcome
    }
}

impl Inside<'_> {
    fn item(&mut self, value: &(impl Serialize + ?Sized)) -> Result<(), FieldError> {
        let step = format!("[{}]", self.n_items);
        self.n_items += 1;
        self.flattener.below(&step, value)
    }
}

impl<'a> ser::Serializer for &'a mut Flattener {
    type Ok = ();
    type Error = FieldError;
    type SerializeSeq = Inside<'a>;
    type SerializeTuple = Inside<'a>;
    type SerializeTupleStruct = ser::Impossible<(), FieldError>;
    type SerializeTupleVariant = ser::Impossible<(), FieldError>;
    type SerializeMap = ser::Impossible<(), FieldError>;
    type SerializeStruct = Inside<'a>;
    type SerializeStructVariant = ser::Impossible<(), FieldError>;

    fn serialize_bool(self, value: bool) -> Result<(), FieldError> {
        self.add(Leaf::Bool(value))
    }

    fn serialize_i8(self, value: i8) -> Result<(), FieldError> {
        self.add(Leaf::Signed(value.into()))
    }

    fn serialize_i16(self, value: i16) -> Result<(), FieldError> {
        self.add(Leaf::Signed(value.into()))
    }

    fn serialize_i32(self, value: i32) -> Result<(), FieldError> {
        self.add(Leaf::Signed(value.into()))
    }

    fn serialize_i64(self, value: i64) -> Result<(), FieldError> {
        self.add(Leaf::Signed(value))
    }

    fn serialize_u8(self, value: u8) -> Result<(), FieldError> {
        self.add(Leaf::Unsigned(value.into()))
    }

    fn serialize_u16(self, value: u16) -> Result<(), FieldError> {
        self.add(Leaf::Unsigned(value.into()))
    }

    fn serialize_u32(self, value: u32) -> Result<(), FieldError> {
        self.add(Leaf::Unsigned(value.into()))
    }

    fn serialize_u64(self, value: u64) -> Result<(), FieldError> {
        self.add(Leaf::Unsigned(value))
    }

    fn serialize_f32(self, value: f32) -> Result<(), FieldError> {
        self.add(Leaf::Float(value.into()))
    }

    fn serialize_f64(self, value: f64) -> Result<(), FieldError> {
        self.add(Leaf::Float(value))
    }

    fn serialize_char(self, value: char) -> Result<(), FieldError> {
        self.add(Leaf::Text(value.into()))
    }

    fn serialize_str(self, value: &str) -> Result<(), FieldError> {
        self.add(Leaf::Text(value.into()))
    }

    fn serialize_bytes(self, _value: &[u8]) -> Result<(), FieldError> {
        unsupported("bytes")
    }

    fn serialize_none(self) -> Result<(), FieldError> {
        unsupported("an option")
    }

    fn serialize_some<T: Serialize + ?Sized>(self, _value: &T) -> Result<(), FieldError> {
        unsupported("an option")
    }

    fn serialize_unit(self) -> Result<(), FieldError> {
        unsupported("a unit")
    }

    fn serialize_unit_struct(self, name: &'static str) -> Result<(), FieldError> {
        unsupported(name)
    }

    fn serialize_unit_variant(self, _: &'static str, _: u32, variant: &'static str) -> Result<(), FieldError> {
        self.add(Leaf::Text(variant.into()))
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, value: &T) -> Result<(), FieldError> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<(), FieldError> {
        unsupported(name)
    }

    fn serialize_seq(self, _: Option<usize>) -> Result<Inside<'a>, FieldError> {
        Ok(Inside { flattener: self, n_items: 0 })
    }

    fn serialize_tuple(self, _: usize) -> Result<Inside<'a>, FieldError> {
        Ok(Inside { flattener: self, n_items: 0 })
    }

    fn serialize_tuple_struct(self, name: &'static str, _: usize) -> Result<Self::SerializeTupleStruct, FieldError> {
        unsupported(name)
    }

    fn serialize_tuple_variant(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeTupleVariant, FieldError> {
        unsupported(name)
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Self::SerializeMap, FieldError> {
        unsupported("a map")
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Inside<'a>, FieldError> {
        Ok(Inside { flattener: self, n_items: 0 })
    }

    fn serialize_struct_variant(
        self,
        name: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeStructVariant, FieldError> {
        unsupported(name)
    }
}

impl ser::SerializeSeq for Inside<'_> {
    type Ok = ();
    type Error = FieldError;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), FieldError> {
        self.item(value)
    }

    fn end(self) -> Result<(), FieldError> {
        Ok(())
    }
}

impl ser::SerializeTuple for Inside<'_> {
    type Ok = ();
    type Error = FieldError;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), FieldError> {
        self.item(value)
    }

    fn end(self) -> Result<(), FieldError> {
        Ok(())
    }
}

impl ser::SerializeStruct for Inside<'_> {
    type Ok = ();
    type Error = FieldError;

    fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, value: &T) -> Result<(), FieldError> {
        let is_outermost = self.flattener.path.is_empty();
        let step = if is_outermost { name.to_string() } else { format!(".{name}") };
        self.flattener.below(&step, value)
    }

    fn end(self) -> Result<(), FieldError> {
        Ok(())
    }
}

fn unsupported<T>(what: &str) -> Result<T, FieldError> {
    Err(FieldError(format!("{what} in it")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{Contact, ContactSet, Fault, GraspFeature, Header, Phase, SceneContact, Stamped};

    #[test]
    fn every_value_has_its_path() {
        let contact = Contact { position_m: [0.1, -0.0, f64::NAN], pad: 3, ..Contact::default() };
        let message = ContactSet {
            grasp_id: 7,
            phase: Phase::Settled,
            joints_rad: vec![],
            contacts: vec![Contact::default(), contact],
            self_collision: true,
            fault: Fault::NoContact,
            ..ContactSet::default()
        };
        let found = fields(&Record::Contacts(Stamped { header: Header::default(), message })).expect("fields");
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
        // Two numbers, then nine for each contact, then four.
        assert_eq!(shown.len(), 2 + 2 * 9 + 4);
    }

    #[test]
    fn identities_are_words_and_negative_numbers_stay_negative() {
        let feature = GraspFeature { dictionary_id: 255, ..GraspFeature::default() };
        let found = fields(&Record::Feature(Stamped { header: Header::default(), message: feature })).expect("fields");
        assert!(found.contains(&("dictionary_id".into(), Leaf::Text("00000000000000ff".into()))), "{found:?}");
        let mut scene = blindgrasp_messages::GraspScene::default();
        scene.contacts.push(SceneContact { other_link: -1, ..SceneContact::default() });
        let found = fields(&Record::Scene(Stamped { header: Header::default(), message: scene })).expect("fields");
        assert!(found.contains(&("contacts[0].other_link".into(), Leaf::Signed(-1))), "{found:?}");
    }
}
