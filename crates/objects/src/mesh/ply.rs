//! The Polygon File Format (Stanford PLY), as text and binary of both byte orders.

use ply_rs_bw::parser::{ParseError, Parser, Reader};
use ply_rs_bw::ply::{Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType};

use super::Mesh;
use super::read::{Problem, Soup};

/// Reads PLY: the element `vertex` with `x`, `y`, `z`, the element `face` with a list of indices. Everything else is
/// skipped.
///
/// # Errors
/// A broken file, and one without these elements.
pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Problem> {
    let mut reader = Reader::new(bytes);
    let parser = Parser::<Element>::new();
    let header = parser.read_header(&mut reader).map_err(|error| problem(&error, "a PLY header", true))?;
    check_header(&header, reader.get_ref().len())?;
    let is_text = header.encoding == Encoding::Ascii;
    let mut soup = Soup::default();
    for (name, element) in &header.elements {
        // In text, an element has a line of its own. Lines of binary data mean nothing.
        let first_line = is_text.then(|| reader.line());
        let rows = parser
            .read_payload_for_element(&mut reader, element, &header)
            .map_err(|error| problem(&error, "rows as the header announces them", is_text))?;
        for (row_idx, row) in rows.into_iter().enumerate() {
            let line = first_line.map(|first| first + row_idx);
            match name.as_str() {
                "vertex" => soup.push_vertex(row.position, line),
                // Some programs write loose points and lines as faces of one or two vertices: they have no area.
                "face" if row.idxs.len() >= 3 => soup.push_polygon(&row.idxs, line)?,
                _ => {}
            }
        }
    }
    Ok(soup)
}

/// A mesh as binary PLY, little-endian, in `f64`.
pub(super) fn format(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty double x\nproperty double y\n\
         property double z\nelement face {}\nproperty list uchar uint vertex_indices\nend_header\n",
        mesh.vertices_m.len(),
        mesh.triangles.len()
    )
    .into_bytes();
    for coordinate in mesh.vertices_m.iter().flat_map(|vertex| vertex.iter()) {
        bytes.extend_from_slice(&coordinate.to_le_bytes());
    }
    for triangle in &mesh.triangles {
        bytes.push(3);
        triangle.iter().for_each(|idx| bytes.extend_from_slice(&idx.to_le_bytes()));
    }
    bytes
}

/// One row of any element: only what a vertex or a face needs is kept.
#[derive(Debug)]
struct Element {
    position: [f64; 3],
    idxs: Vec<i64>,
}

impl PropertyAccess for Element {
    fn new() -> Self {
        Element { position: [0.0; 3], idxs: Vec::new() }
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let place = match name {
            "x" => &mut self.position[0],
            "y" => &mut self.position[1],
            "z" => &mut self.position[2],
            "vertex_indices" | "vertex_index" => {
                self.idxs = match property {
                    Property::ListChar(idxs) => idxs.into_iter().map(i64::from).collect(),
                    Property::ListUChar(idxs) => idxs.into_iter().map(i64::from).collect(),
                    Property::ListShort(idxs) => idxs.into_iter().map(i64::from).collect(),
                    Property::ListUShort(idxs) => idxs.into_iter().map(i64::from).collect(),
                    Property::ListInt(idxs) => idxs.into_iter().map(i64::from).collect(),
                    Property::ListUInt(idxs) => idxs.into_iter().map(i64::from).collect(),
                    _ => return PropertyAccessResult::UnsupportedType,
                };
                return PropertyAccessResult::Set;
            }
            _ => return PropertyAccessResult::Ignored,
        };
        *place = match property {
            Property::Char(value) => value.into(),
            Property::UChar(value) => value.into(),
            Property::Short(value) => value.into(),
            Property::UShort(value) => value.into(),
            Property::Int(value) => value.into(),
            Property::UInt(value) => value.into(),
            Property::Float(value) => value.into(),
            Property::Double(value) => value,
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

/// The header must describe a mesh, and announce no more than the rest of the file can hold.
fn check_header(header: &Header, n_payload_bytes: usize) -> Result<(), Problem> {
    let has = |element: &str, properties: &[&str]| {
        let element = header.elements.get(element);
        element.is_some_and(|element| properties.iter().any(|name| element.properties.contains_key(*name)))
    };
    for axis in ["x", "y", "z"] {
        if !has("vertex", &[axis]) {
            return Err(Problem::new(None, format!("a property {axis} of an element vertex"), "none in the header"));
        }
    }
    if !has("face", &["vertex_indices", "vertex_index"]) {
        let expected = "a property vertex_indices (or vertex_index) of an element face";
        return Err(Problem::new(None, expected, "none in the header"));
    }
    for (name, element) in &header.elements {
        let is_list = |kind: &PropertyType| matches!(kind, PropertyType::List(..));
        let has_list = element.properties.values().any(|property| is_list(&property.data_type));
        // An element without properties takes no bytes, so that any number of them would fit.
        let least_bytes = element.properties.len() as u64;
        let n_bytes = (element.count as u64).saturating_mul(least_bytes);
        if element.count > 0 && (least_bytes == 0 || n_bytes > n_payload_bytes as u64) {
            let list = if has_list { " and lists" } else { "" };
            let expected = format!("{} times element {name} with {least_bytes} properties{list}", element.count);
            return Err(Problem::new(
                None,
                expected,
                format!("{n_payload_bytes} bytes after the header (is it cut off?)"),
            ));
        }
    }
    Ok(())
}

fn problem(error: &ParseError, expected: &str, has_lines: bool) -> Problem {
    let text = error.to_string();
    // The line is said elsewhere; the parser's further lines repeat the input.
    let text =
        text.strip_prefix("Line ").and_then(|text| text.split_once(": ")).map_or(text.as_str(), |(_, text)| text);
    let found = text.split_whitespace().collect::<Vec<_>>().join(" ");
    Problem::new(error.line().filter(|_| has_lines), expected, found.chars().take(300).collect::<String>())
}
