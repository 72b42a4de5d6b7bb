//! A value of a type, from the type alone.

use serde::de::{DeserializeSeed, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::ExportError;

/// A value whose numbers are 0, whose texts are empty and whose lists have one element each, arrays all of theirs.
///
/// It says what a type is made of where the data may not: a list that is empty in every sample still has a type.
pub(super) fn exemplar<T: for<'de> Deserialize<'de>>() -> Result<T, ExportError> {
    T::deserialize(Exemplar)
}

struct Exemplar;

/// As many exemplars as it says.
struct Several(usize);

impl<'de> SeqAccess<'de> for Several {
    type Error = ExportError;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, ExportError> {
        if self.0 == 0 {
            return Ok(None);
        }
        self.0 -= 1;
        seed.deserialize(Exemplar).map(Some)
    }
}

macro_rules! zeros {
    ($($deserialize:ident $visit:ident $zero:expr;)+) => {$(
        fn $deserialize<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ExportError> {
            visitor.$visit($zero)
        }
    )+};
}

impl<'de> Deserializer<'de> for Exemplar {
    type Error = ExportError;

    /// Enums are codes then, of which 0 is always one; a word could not be guessed.
    fn is_human_readable(&self) -> bool {
        false
    }

    zeros! {
        deserialize_bool visit_bool false;
        deserialize_i8 visit_i8 0;
        deserialize_i16 visit_i16 0;
        deserialize_i32 visit_i32 0;
        deserialize_i64 visit_i64 0;
        deserialize_u8 visit_u8 0;
        deserialize_u16 visit_u16 0;
        deserialize_u32 visit_u32 0;
        deserialize_u64 visit_u64 0;
        deserialize_f32 visit_f32 0.0;
        deserialize_f64 visit_f64 0.0;
        deserialize_char visit_char '0';
        deserialize_str visit_str "";
        deserialize_string visit_str "";
        deserialize_seq visit_seq Several(1);
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, len: usize, visitor: V) -> Result<V::Value, ExportError> {
        visitor.visit_seq(Several(len))
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ExportError> {
        visitor.visit_seq(Several(fields.len()))
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _: &'static str, visitor: V) -> Result<V::Value, ExportError> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, ExportError> {
        Err(ExportError::Shape("a message has a field of a kind that tables have no column for".into()))
    }

    serde::forward_to_deserialize_any! {
        i128 u128 bytes byte_buf option unit unit_struct tuple_struct map enum identifier ignored_any
    }
}
