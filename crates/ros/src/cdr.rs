//! Reads messages in plain CDR, whose definition is known.

use crate::definition::{Count, Definition, Element, Field};

/// A message, or a part of it.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Number(f64),
    /// An integer, exact.
    Integer(i128),
    Text(String),
    /// A list of numbers.
    Numbers(Vec<f64>),
    /// A list of bytes.
    Bytes(Vec<u8>),
    List(Vec<Value>),
    Message(Vec<(String, Value)>),
}

/// Why bytes are no message of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    #[error("it is no plain CDR")]
    Encapsulation,
    #[error("it ends within '{field}'")]
    Short { field: String },
    #[error("'{field}' has {found} items, at most {most} are allowed")]
    Long { field: String, found: u64, most: u64 },
    #[error("'{field}' is not UTF-8")]
    Text { field: String },
    #[error("it has {0} bytes too many")]
    Rest(usize),
}

/// Reads a message.
///
/// # Errors
/// The bytes are not a message of this definition.
pub fn read(definition: &Definition, bytes: &[u8]) -> Result<Value, CdrError> {
    let (&[_, representation, ..], Some(body)) = (bytes, bytes.get(4..)) else {
        return Err(CdrError::Encapsulation);
    };
    if bytes[0] != 0 || representation > 1 {
        return Err(CdrError::Encapsulation);
    }
    let mut reader = Reader { definition, body, at: 0, is_little: representation == 1 };
    let value = reader.message(&definition.fields)?;
    // Writers may pad the end to four bytes.
    match body.len() - reader.at {
        0..=3 => Ok(value),
        rest => Err(CdrError::Rest(rest)),
    }
}

struct Reader<'a> {
    definition: &'a Definition,
    body: &'a [u8],
    at: usize,
    is_little: bool,
}

impl<'a> Reader<'a> {
    fn message(&mut self, fields: &[Field]) -> Result<Value, CdrError> {
        let read = |field: &Field| Ok((field.name.clone(), self.field(field)?));
        Ok(Value::Message(fields.iter().map(read).collect::<Result<_, CdrError>>()?))
    }

    fn field(&mut self, field: &Field) -> Result<Value, CdrError> {
        let n = match field.count {
            Count::One => return self.element(&field.element, &field.name),
            Count::Fixed(n) => n,
            Count::AtMost(most) => {
                let found = self.length(&field.name)?;
                if found > most {
                    return Err(CdrError::Long { field: field.name.clone(), found, most });
                }
                found
            }
            Count::Any => self.length(&field.name)?,
        };
        // Each item takes a byte at least: a false length takes no memory.
        let left = (self.body.len() - self.at) as u64;
        if n > left {
            return Err(CdrError::Short { field: field.name.clone() });
        }
        match field.element {
            Element::UInt8 | Element::Byte => Ok(Value::Bytes(self.take(n as usize, 1, &field.name)?.to_vec())),
            Element::Text(_) | Element::Message(_) => {
                let items: Result<_, _> = (0..n).map(|_| self.element(&field.element, &field.name)).collect();
                Ok(Value::List(items?))
            }
            _ => {
                let items: Result<_, _> = (0..n).map(|_| self.number(&field.element, &field.name)).collect();
                Ok(Value::Numbers(items?))
            }
        }
    }

    fn element(&mut self, element: &Element, field: &str) -> Result<Value, CdrError> {
        match element {
            Element::Text(bound) => {
                let n = self.length(field)?;
                if let Some(most) = bound.filter(|most| n > most + 1) {
                    return Err(CdrError::Long { field: field.into(), found: n, most });
                }
                let n = usize::try_from(n).map_err(|_| CdrError::Short { field: field.into() })?;
                let bytes = self.take(n, 1, field)?;
                let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
                let text = std::str::from_utf8(bytes).map_err(|_| CdrError::Text { field: field.into() })?;
                Ok(Value::Text(text.into()))
            }
            Element::Message(name) => {
                let definition = self.definition;
                self.message(definition.part(name).unwrap_or_default())
            }
            Element::Float32 | Element::Float64 => self.number(element, field).map(Value::Number),
            _ => self.integer(element, field).map(Value::Integer),
        }
    }

    fn number(&mut self, element: &Element, field: &str) -> Result<f64, CdrError> {
        match element {
            Element::Float32 => Ok(f32::from_bits(self.unsigned::<4>(field)? as u32).into()),
            Element::Float64 => Ok(f64::from_bits(self.unsigned::<8>(field)?)),
            _ => self.integer(element, field).map(|integer| integer as f64),
        }
    }

    fn integer(&mut self, element: &Element, field: &str) -> Result<i128, CdrError> {
        Ok(match element {
            Element::Int8 => i128::from(self.unsigned::<1>(field)? as i8),
            Element::Int16 => i128::from(self.unsigned::<2>(field)? as i16),
            Element::Int32 => i128::from(self.unsigned::<4>(field)? as i32),
            Element::Int64 => i128::from(self.unsigned::<8>(field)? as i64),
            Element::UInt16 => self.unsigned::<2>(field)?.into(),
            Element::UInt32 => self.unsigned::<4>(field)?.into(),
            Element::UInt64 => self.unsigned::<8>(field)?.into(),
            _ => self.unsigned::<1>(field)?.into(),
        })
    }

    fn length(&mut self, field: &str) -> Result<u64, CdrError> {
        self.unsigned::<4>(field)
    }

    fn unsigned<const N: usize>(&mut self, field: &str) -> Result<u64, CdrError> {
        let is_little = self.is_little;
        let bytes = self.take(N, N, field)?;
        let add = |sum: u64, byte: &u8| sum << 8 | u64::from(*byte);
        Ok(if is_little { bytes.iter().rev().fold(0, add) } else { bytes.iter().fold(0, add) })
    }

    fn take(&mut self, n: usize, align: usize, field: &str) -> Result<&'a [u8], CdrError> {
        let start = self.at.next_multiple_of(align);
        let found = start.checked_add(n).and_then(|end| self.body.get(start..end));
        self.at = start.saturating_add(n);
        found.ok_or_else(|| CdrError::Short { field: field.into() })
    }
}

impl Value {
    /// The part at a path like `header.stamp.sec`. In a list of messages, the rest of the path is taken of each of them.
    pub fn at(&self, path: &str) -> Option<Value> {
        let (first, rest) = path.split_once('.').map_or((path, None), |(first, rest)| (first, Some(rest)));
        match self {
            Value::Message(fields) => {
                let (_, value) = fields.iter().find(|(name, _)| name == first)?;
                rest.map_or_else(|| Some(value.clone()), |rest| value.at(rest))
            }
            Value::List(items) => Some(Value::List(items.iter().map(|item| item.at(path)).collect::<Option<_>>()?)),
            _ => None,
        }
    }

    /// All numbers in it, in their order; `None` if there is a text.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        match self {
            Value::Number(number) => Some(vec![*number]),
            Value::Integer(integer) => Some(vec![*integer as f64]),
            Value::Numbers(numbers) => Some(numbers.clone()),
            Value::Bytes(bytes) => Some(bytes.iter().map(|byte| f64::from(*byte)).collect()),
            Value::List(items) => {
                items.iter().map(Value::numbers).collect::<Option<Vec<_>>>().map(|lists| lists.concat())
            }
            Value::Message(fields) => {
                let lists: Option<Vec<_>> = fields.iter().map(|(_, value)| value.numbers()).collect();
                lists.map(|lists| lists.concat())
            }
            Value::Text(_) => None,
        }
    }

    pub fn integer(&self) -> Option<i128> {
        match self {
            Value::Integer(integer) => Some(*integer),
            _ => None,
        }
    }

    pub fn text(&self) -> Option<&str> {
        match self {
            Value::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The texts of a list.
    pub fn texts(&self) -> Option<Vec<&str>> {
        match self {
            Value::List(items) => items.iter().map(Value::text).collect(),
            _ => None,
        }
    }

    /// The stamp of a `std_msgs/Header` in the field `header`, nanoseconds; `None` without one, or before 1970.
    pub fn stamp_nanos(&self) -> Option<u64> {
        let part = |name: &str| self.at(&format!("header.stamp.{name}"))?.integer();
        u64::try_from(part("sec")? * 1_000_000_000 + part("nanosec")?).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn definition() -> Definition {
        let text = "uint8 a\nfloat64 b\nstring c\nP[] d\nfloat32[2] e\n====\nMSG: p/P\nint16 x\nuint8[] y\n";
        Definition::parse("p/msg/M", text).expect("a definition")
    }

    fn bytes() -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 0, 7];
        bytes.extend([0; 7]);
        bytes.extend(1.5_f64.to_le_bytes());
        bytes.extend([3, 0, 0, 0, b'h', b'i', 0, 0]);
        bytes.extend([1, 0, 0, 0, 0xFE, 0xFF, 0, 0, 2, 0, 0, 0, 8, 9, 0, 0]);
        bytes.extend(2.0_f32.to_le_bytes());
        bytes.extend((-1.0_f32).to_le_bytes());
        bytes
    }

    #[test]
    fn a_message_is_read_with_its_alignment() {
        let value = read(&definition(), &bytes()).expect("a message");
        assert_eq!(value.at("a"), Some(Value::Integer(7)));
        assert_eq!(value.at("b"), Some(Value::Number(1.5)));
        assert_eq!(value.at("c").as_ref().and_then(Value::text), Some("hi"));
        assert_eq!(value.at("d.x").and_then(|part| part.numbers()), Some(vec![-2.0]));
        assert_eq!(value.at("d.y").and_then(|part| part.numbers()), Some(vec![8.0, 9.0]));
        assert_eq!(value.at("e"), Some(Value::Numbers(vec![2.0, -1.0])));
        assert_eq!(value.at("f"), None);
    }

    #[test]
    fn damaged_bytes_are_refused_and_take_no_memory() {
        let good = bytes();
        for n in 0..good.len() {
            assert!(read(&definition(), &good[..n]).is_err(), "{n} bytes");
        }
        for idx in 0..good.len() {
            for byte in [0, 0x7F, 0xFF] {
                let mut damaged = good.clone();
                damaged[idx] = byte;
                // An error or other values, and no panic.
                let _ = read(&definition(), &damaged);
            }
        }
        let longer = [good, vec![0; 4]].concat();
        assert_eq!(read(&definition(), &longer), Err(CdrError::Rest(4)));
    }
}
