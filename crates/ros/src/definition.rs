//! Message definitions in the form `ros2msg`: the fields of a message, then those of the messages in it, each behind a line
//! of `=` and a line `MSG: package/Name`.

use std::collections::{BTreeMap, BTreeSet};

use hiroz_schema::{FieldDescription, FieldTypeDescription, TypeDescription, TypeDescriptionMsg, calculate_hash};

/// No message of a robot is nested deeper.
const MAX_DEPTH: usize = 16;
/// From a type's number in type_description_interfaces/FieldType to that of a list of it.
const FIXED_LIST: u8 = 48;
const BOUNDED_LIST: u8 = 96;
const LIST: u8 = 144;
const NESTED: u8 = 1;
const BOUNDED_STRING: u8 = 21;

/// A message type with the types in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Definition {
    /// Like `sensor_msgs/msg/JointState`.
    pub name: String,
    pub fields: Vec<Field>,
    parts: BTreeMap<String, Vec<Field>>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    pub name: String,
    pub element: Element,
    pub count: Count,
}

/// The type of a field, or of the items of its list.
#[derive(Debug, Clone, PartialEq)]
pub enum Element {
    Bool,
    Byte,
    Int8,
    UInt8,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Int64,
    UInt64,
    Float32,
    Float64,
    /// Of at most so many bytes, if there is a bound.
    Text(Option<u64>),
    /// The full name of a message type.
    Message(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Count {
    One,
    Fixed(u64),
    AtMost(u64),
    Any,
}

/// Why a text is no definition.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DefinitionError {
    #[error("line {line}: '{text}' is no field of a message: expected TYPE NAME")]
    Field { line: usize, text: String },
    #[error("line {line}: the type '{found}' is unknown here")]
    Type { line: usize, found: String },
    #[error("the definition of {name} is missing: append it behind a line of '=' and a line 'MSG: {name}'")]
    Missing { name: String },
    #[error("{name} contains itself, or is nested more than {MAX_DEPTH} deep")]
    Nested { name: String },
    #[error("'{0}' is no name of a message type: expected PACKAGE/msg/NAME")]
    Name(String),
}

impl Definition {
    /// Parses the definition of a message type `name`, like `sensor_msgs/msg/JointState`.
    ///
    /// # Errors
    /// See [`DefinitionError`].
    pub fn parse(name: &str, text: &str) -> Result<Definition, DefinitionError> {
        let name = match full_name(name, "") {
            Some(full) if name.contains('/') => full,
            _ => return Err(DefinitionError::Name(name.into())),
        };
        let mut parts: BTreeMap<String, Vec<Field>> = BTreeMap::new();
        let (mut current, mut fields) = (name.clone(), Vec::new());
        for (idx, line) in text.lines().enumerate() {
            let line_number = idx + 1;
            let line = line.trim();
            if line.starts_with("====") {
                continue;
            }
            if let Some(next) = line.strip_prefix("MSG:") {
                let next = full_name(next.trim(), "").ok_or_else(|| DefinitionError::Name(next.trim().into()))?;
                parts.insert(std::mem::replace(&mut current, next), std::mem::take(&mut fields));
                continue;
            }
            fields.extend(field(line, line_number, &current)?);
        }
        parts.insert(current, fields);
        let fields = parts.remove(&name).unwrap_or_default();
        let definition = Definition { name, fields, parts };
        definition.check(&definition.name, &definition.fields, 0)?;
        Ok(definition)
    }

    /// The fields of a message type in it.
    pub fn part(&self, name: &str) -> Option<&[Field]> {
        self.parts.get(name).map(Vec::as_slice)
    }

    fn check(&self, name: &str, fields: &[Field], depth: usize) -> Result<(), DefinitionError> {
        if depth > MAX_DEPTH {
            return Err(DefinitionError::Nested { name: name.into() });
        }
        for field in fields {
            if let Element::Message(part) = &field.element {
                let fields = self.part(part).ok_or_else(|| DefinitionError::Missing { name: part.clone() })?;
                self.check(part, fields, depth + 1)?;
            }
        }
        Ok(())
    }

    /// The hash by which ROS 2 tells types from those of the same name with other fields, like `RIHS01_b1a8…`.
    pub fn hash(&self) -> String {
        let mut used = BTreeSet::new();
        self.add_used(&self.fields, &mut used);
        let describe = |name: &str, fields: &[Field]| TypeDescription {
            type_name: name.into(),
            fields: fields.iter().map(Field::described).collect(),
        };
        let part = |name: &&str| describe(name, self.part(name).unwrap_or_default());
        calculate_hash(&TypeDescriptionMsg {
            type_description: describe(&self.name, &self.fields),
            referenced_type_descriptions: used.iter().map(part).collect(),
        })
        .to_rihs_string()
    }

    fn add_used<'a>(&'a self, fields: &'a [Field], used: &mut BTreeSet<&'a str>) {
        for field in fields {
            if let Element::Message(name) = &field.element
                && used.insert(name)
            {
                self.add_used(self.part(name).unwrap_or_default(), used);
            }
        }
    }
}

impl Field {
    fn described(&self) -> FieldDescription {
        let (list, capacity) = match self.count {
            Count::One => (0, 0),
            Count::Fixed(n) => (FIXED_LIST, n),
            Count::AtMost(n) => (BOUNDED_LIST, n),
            Count::Any => (LIST, 0),
        };
        let (string_capacity, nested_type_name) = match &self.element {
            Element::Text(bound) => (bound.unwrap_or(0), String::new()),
            Element::Message(name) => (0, name.clone()),
            _ => (0, String::new()),
        };
        let type_id = self.element.number() + list;
        let field_type = FieldTypeDescription { type_id, capacity, string_capacity, nested_type_name };
        FieldDescription { name: self.name.clone(), field_type, default_value: String::new() }
    }
}

impl Element {
    /// Its number in type_description_interfaces/FieldType.
    fn number(&self) -> u8 {
        match self {
            Element::Message(_) => NESTED,
            Element::Int8 => 2,
            Element::UInt8 => 3,
            Element::Int16 => 4,
            Element::UInt16 => 5,
            Element::Int32 => 6,
            Element::UInt32 => 7,
            Element::Int64 => 8,
            Element::UInt64 => 9,
            Element::Float32 => 10,
            Element::Float64 => 11,
            Element::Bool => 15,
            Element::Byte => 16,
            Element::Text(None) => 17,
            Element::Text(Some(_)) => BOUNDED_STRING,
        }
    }

    fn parse(word: &str, package: &str) -> Option<Element> {
        Some(match word {
            "bool" => Element::Bool,
            "byte" => Element::Byte,
            "char" | "uint8" => Element::UInt8,
            "int8" => Element::Int8,
            "int16" => Element::Int16,
            "uint16" => Element::UInt16,
            "int32" => Element::Int32,
            "uint32" => Element::UInt32,
            "int64" => Element::Int64,
            "uint64" => Element::UInt64,
            "float32" => Element::Float32,
            "float64" => Element::Float64,
            "string" => Element::Text(None),
            _ => match word.strip_prefix("string<=") {
                Some(bound) => Element::Text(Some(bound.parse().ok()?)),
                None => Element::Message(full_name(word, package)?),
            },
        })
    }
}

/// A line's field; `None` for a comment, an empty line or a constant.
fn field(line: &str, line_number: usize, of_message: &str) -> Result<Option<Field>, DefinitionError> {
    let code = line.split('#').next().unwrap_or_default().trim();
    if code.is_empty() {
        return Ok(None);
    }
    let refused = || DefinitionError::Field { line: line_number, text: line.into() };
    let (type_word, rest) = code.split_once(char::is_whitespace).ok_or_else(refused)?;
    let rest = rest.trim();
    let name: String = rest.chars().take_while(|char| char.is_ascii_alphanumeric() || *char == '_').collect();
    // `uint8 FLOAT32=7` is a constant; `float64 w 1` a field with a default.
    if name.is_empty() {
        return Err(refused());
    }
    if rest[name.len()..].trim_start().starts_with('=') {
        return Ok(None);
    }
    let unknown = || DefinitionError::Type { line: line_number, found: type_word.into() };
    let (element, count) = match type_word.strip_suffix(']').and_then(|word| word.rsplit_once('[')) {
        None => (type_word, Count::One),
        Some((element, "")) => (element, Count::Any),
        Some((element, size)) => match size.strip_prefix("<=") {
            Some(most) => (element, Count::AtMost(most.parse().map_err(|_| unknown())?)),
            None => (element, Count::Fixed(size.parse().map_err(|_| unknown())?)),
        },
    };
    let package = of_message.split('/').next().unwrap_or_default();
    let element = Element::parse(element, package).ok_or_else(unknown)?;
    Ok(Some(Field { name, element, count }))
}

/// `package/msg/Name` of `package/msg/Name`, `package/Name` or, in a message of the same package, `Name`. The messages of a
/// service are `package/srv/Name`.
fn full_name(name: &str, package: &str) -> Option<String> {
    let parts: Vec<&str> = name.split('/').collect();
    let (package, kind, name) = match parts.as_slice() {
        [name] => (package, "msg", *name),
        [package, name] => (*package, "msg", *name),
        [package, kind @ ("msg" | "srv"), name] => (*package, *kind, *name),
        _ => return None,
    };
    let is_word = |word: &str| {
        word.starts_with(|first: char| first.is_ascii_alphabetic())
            && word.chars().all(|char| char.is_ascii_alphanumeric() || char == '_')
    };
    (is_word(package) && is_word(name)).then(|| format!("{package}/{kind}/{name}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_defaults_constants_and_bounds_are_read() {
        let text = "uint8 A=1 # one\nHeader header\nfloat64 w 1\nstring<=5[<=3] names\nint8[2] pair\n\
                    ====\nMSG: p/Header\nstring id\n";
        let definition = Definition::parse("p/msg/M", text).expect("a definition");
        let names: Vec<&str> = definition.fields.iter().map(|field| field.name.as_str()).collect();
        assert_eq!(names, ["header", "w", "names", "pair"]);
        assert_eq!(definition.fields[2].element, Element::Text(Some(5)));
        assert_eq!(definition.fields[2].count, Count::AtMost(3));
        assert_eq!(definition.part("p/msg/Header").map(<[_]>::len), Some(1));
    }

    #[test]
    fn a_text_that_is_no_definition_is_refused_with_its_line() {
        let said = |text: &str| Definition::parse("p/msg/M", text).expect_err("refused").to_string();
        assert!(said("float64 x\nnonsense\n").starts_with("line 2: 'nonsense' is no field"));
        assert!(said("float99[x] y\n").starts_with("line 1: the type"));
        assert!(said("Other other\n").contains("p/msg/Other is missing"));
        assert!(said("M again\n").contains("p/msg/M is missing"));
        assert!(said("A a\n===\nMSG: p/A\n").contains("is no field"));
        assert!(said("A a\n====\nMSG: p/A\nA a\n").contains("contains itself"));
        assert!(Definition::parse("M", "").is_err());
    }
}
