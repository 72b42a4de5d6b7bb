//! The Polygon File Format (Stanford PLY), as text and binary of both byte orders.

use crate::read::{Problem, Soup, quoted};

/// Reads PLY: the element `vertex` with `x`, `y` and `z`, and the element `face` with a list of indices. Other elements
/// and properties are skipped.
///
/// # Errors
/// A damaged file, or one without these elements.
pub(crate) fn parse(bytes: &[u8]) -> Result<Soup, Problem> {
    let mut file = File { rest: bytes, n_lines: 0 };
    let (encoding, elements) = read_header(&mut file)?;
    check_header(&elements)?;
    let mut soup = Soup::default();
    for element in elements.iter().filter(|element| !element.properties.is_empty()) {
        for _ in 0..element.n_rows {
            let line = match encoding {
                Encoding::Text => Some(file.n_lines + 1),
                Encoding::Little | Encoding::Big => None,
            };
            let row = element.read_row(&mut file, encoding)?;
            match element.name.as_str() {
                "vertex" => soup.push_vertex(row.position, line),
                // Some programs write loose points and lines as faces of one or two vertices, which have no area.
                "face" if row.idxs.len() >= 3 => soup.push_polygon(&row.idxs, line)?,
                _ => {}
            }
        }
    }
    Ok(soup)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Text,
    Little,
    Big,
}

/// The part of a file that has not been read yet.
struct File<'a> {
    rest: &'a [u8],
    n_lines: usize,
}

impl<'a> File<'a> {
    fn line(&mut self) -> Option<std::borrow::Cow<'a, str>> {
        if self.rest.is_empty() {
            return None;
        }
        let end = self.rest.iter().position(|byte| *byte == b'\n');
        let (line, rest) = self.rest.split_at(end.map_or(self.rest.len(), |end| end + 1));
        self.rest = rest;
        self.n_lines += 1;
        Some(String::from_utf8_lossy(line.trim_ascii_end()))
    }
}

/// A number's type in binary files.
#[derive(Debug, Clone, Copy)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn named(name: &str) -> Option<Kind> {
        Some(match name {
            "char" | "int8" => Kind::I8,
            "uchar" | "uint8" => Kind::U8,
            "short" | "int16" => Kind::I16,
            "ushort" | "uint16" => Kind::U16,
            "int" | "int32" => Kind::I32,
            "uint" | "uint32" => Kind::U32,
            "float" | "float32" => Kind::F32,
            "double" | "float64" => Kind::F64,
            _ => return None,
        })
    }

    /// Takes a number off the front of `bytes`.
    fn take(self, bytes: &mut &[u8], encoding: Encoding) -> Option<f64> {
        macro_rules! number {
            ($type:ty) => {{
                let (number, rest) = bytes.split_first_chunk()?;
                *bytes = rest;
                f64::from(match encoding {
                    Encoding::Big => <$type>::from_be_bytes(*number),
                    Encoding::Little | Encoding::Text => <$type>::from_le_bytes(*number),
                })
            }};
        }
        Some(match self {
            Kind::I8 => number!(i8),
            Kind::U8 => number!(u8),
            Kind::I16 => number!(i16),
            Kind::U16 => number!(u16),
            Kind::I32 => number!(i32),
            Kind::U32 => number!(u32),
            Kind::F32 => number!(f32),
            Kind::F64 => number!(f64),
        })
    }
}

struct Property {
    name: String,
    kind: Kind,
    /// The type of a list's length.
    length: Option<Kind>,
}

struct Element {
    name: String,
    n_rows: u64,
    properties: Vec<Property>,
}

/// The values of a row that a mesh needs.
#[derive(Default)]
struct Row {
    position: [f64; 3],
    idxs: Vec<i64>,
}

impl Element {
    fn has(&self, names: &[&str]) -> bool {
        self.properties.iter().any(|property| names.contains(&property.name.as_str()))
    }

    fn read_row(&self, file: &mut File<'_>, encoding: Encoding) -> Result<Row, Problem> {
        let expected = "rows as the header announces them";
        if encoding != Encoding::Text {
            let rest = &mut file.rest;
            return self.read_values(|kind| kind.take(rest, encoding)).ok_or_else(|| Problem::cut_off(None, expected));
        }
        let Some(text) = file.line() else { return Err(Problem::cut_off(Some(file.n_lines), expected)) };
        let mut words = text.split_whitespace();
        let row = self.read_values(|_| words.next()?.parse().ok());
        row.ok_or_else(|| Problem::new(Some(file.n_lines), expected, quoted(&text)))
    }

    fn read_values(&self, mut number: impl FnMut(Kind) -> Option<f64>) -> Option<Row> {
        let mut row = Row::default();
        for Property { name, kind, length } in &self.properties {
            let n_values = length.map_or(Some(1.0), &mut number)?;
            let is_idxs = matches!(name.as_str(), "vertex_indices" | "vertex_index");
            for _ in 0..n_values as u64 {
                let value = number(*kind)?;
                match name.as_str() {
                    "x" => row.position[0] = value,
                    "y" => row.position[1] = value,
                    "z" => row.position[2] = value,
                    _ if is_idxs && value.fract() == 0.0 => row.idxs.push(value as i64),
                    _ if is_idxs => return None,
                    _ => {}
                }
            }
        }
        Some(row)
    }
}

fn read_header(file: &mut File<'_>) -> Result<(Encoding, Vec<Element>), Problem> {
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    while let Some(text) = file.line() {
        let line = Some(file.n_lines);
        let wrong = || Problem::new(line, "a PLY header", quoted(&text));
        let words: Vec<&str> = text.split_whitespace().collect();
        match (&words[..], file.n_lines) {
            (["ply"], 1) => {}
            (_, 1) => return Err(wrong()),
            (["format", name, _], _) => {
                encoding = Some(match *name {
                    "ascii" => Encoding::Text,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return Err(wrong()),
                });
            }
            (["comment" | "obj_info", ..] | [], _) => {}
            (["element", name, n_rows], _) => {
                let n_rows = n_rows.parse().map_err(|_| wrong())?;
                elements.push(Element { name: (*name).into(), n_rows, properties: Vec::new() });
            }
            (["property", kinds @ .., name], _) => {
                let (kind, length) = match kinds {
                    [kind] => (Kind::named(kind), None),
                    ["list", length, kind] => (Kind::named(kind), Some(Kind::named(length).ok_or_else(wrong)?)),
                    _ => return Err(wrong()),
                };
                let property = Property { name: (*name).into(), kind: kind.ok_or_else(wrong)?, length };
                elements.last_mut().ok_or_else(wrong)?.properties.push(property);
            }
            (["end_header"], _) => {
                let missing = || Problem::new(line, "a line 'format' in the header", "none");
                return Ok((encoding.ok_or_else(missing)?, elements));
            }
            _ => return Err(wrong()),
        }
    }
    Err(Problem::cut_off(Some(file.n_lines), "a PLY header"))
}

/// A mesh needs positions and faces.
fn check_header(elements: &[Element]) -> Result<(), Problem> {
    for (element, names) in
        [("vertex", &["x"][..]), ("vertex", &["y"]), ("vertex", &["z"]), ("face", &["vertex_indices", "vertex_index"])]
    {
        if !elements.iter().any(|found| found.name == element && found.has(names)) {
            let expected = format!("a property {} of an element {element}", names.join(" or "));
            return Err(Problem::new(None, expected, "none in the header"));
        }
    }
    Ok(())
}
