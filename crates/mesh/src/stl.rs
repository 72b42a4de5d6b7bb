//! STL: triangles without shared corners, as text or binary.

use crate::read::{Problem, Soup, coordinates, lines, quoted};

/// Length of a comment of 80 bytes and the number of triangles.
const HEADER_BYTES: usize = 84;
/// Length of a normal and three corners of three `f32` each, and two bytes without meaning.
const TRIANGLE_BYTES: usize = 50;

/// Reads STL. Normals are ignored: the order of the corners defines the outside. Several solids become one mesh.
///
/// # Errors
/// A file that is neither text nor binary STL, is damaged, or is shorter or longer than its header says.
pub(crate) fn parse(bytes: &[u8]) -> Result<Soup, Problem> {
    // Binary files may begin with "solid" too (some programs put their name there), so their length decides first.
    if binary_len(bytes).is_some_and(|expected| expected == bytes.len() as u64) || !looks_like_text(bytes) {
        parse_binary(bytes)
    } else {
        parse_text(bytes)
    }
}

/// Length of a binary file with this header.
fn binary_len(bytes: &[u8]) -> Option<u64> {
    let count = bytes.get(HEADER_BYTES - 4..HEADER_BYTES)?;
    let n_triangles = u32::from_le_bytes(count.try_into().ok()?);
    Some(HEADER_BYTES as u64 + u64::from(n_triangles) * TRIANGLE_BYTES as u64)
}

fn looks_like_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(512)];
    let start = start.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(start).trim_ascii_start();
    start.len() >= 5 && start[..5].eq_ignore_ascii_case(b"solid") && !start.contains(&0)
}

fn parse_binary(bytes: &[u8]) -> Result<Soup, Problem> {
    let n_found = bytes.len() as u64;
    let Some(n_expected) = binary_len(bytes) else {
        let expected = format!("'solid' (text) or a binary header of {HEADER_BYTES} bytes");
        return Err(Problem::new(None, expected, format!("{n_found} bytes")));
    };
    // Some programs end the file with a line break.
    if !(n_expected..n_expected + TRIANGLE_BYTES as u64).contains(&n_found) {
        let n_triangles = (n_expected - HEADER_BYTES as u64) / TRIANGLE_BYTES as u64;
        let expected = format!("{n_expected} bytes of binary STL for the {n_triangles} triangles that its header says");
        let hint = if n_found < n_expected { " (is it cut off?)" } else { "" };
        return Err(Problem::new(None, expected, format!("{n_found} bytes{hint}")));
    }
    let mut soup = Soup::default();
    let (triangles, _) = bytes[HEADER_BYTES..].as_chunks::<TRIANGLE_BYTES>();
    for triangle in triangles {
        let (numbers, _) = triangle.as_chunks::<4>();
        let number = |idx: usize| f64::from(f32::from_le_bytes(numbers[idx]));
        let first_idx = soup.n_vertices() as i64;
        for corner in 1..4 {
            soup.push_vertex([number(3 * corner), number(3 * corner + 1), number(3 * corner + 2)], None);
        }
        soup.push_polygon(&[first_idx, first_idx + 1, first_idx + 2], None)?;
    }
    Ok(soup)
}

fn parse_text(bytes: &[u8]) -> Result<Soup, Problem> {
    let mut soup = Soup::default();
    let mut facet: Vec<i64> = Vec::new();
    let mut is_in_solid = false;
    let mut is_in_facet = false;
    let mut n_lines = 0;
    for (number, text) in lines(bytes) {
        n_lines = number;
        let mut words = text.split_whitespace();
        let Some(word) = words.next() else { continue };
        match (word.to_ascii_lowercase().as_str(), is_in_solid, is_in_facet) {
            ("solid", false, false) => is_in_solid = true,
            ("endsolid", true, false) => is_in_solid = false,
            ("facet", true, false) => is_in_facet = true,
            ("outer" | "endloop", true, true) => {}
            ("vertex", true, true) => {
                facet.push(soup.n_vertices() as i64);
                soup.push_vertex(coordinates(&mut words, number)?, Some(number));
            }
            ("endfacet", true, true) => {
                soup.push_polygon(&facet, Some(number))?;
                facet.clear();
                is_in_facet = false;
            }
            _ => return Err(Problem::new(Some(number), expected_word(is_in_solid, is_in_facet), quoted(text.trim()))),
        }
    }
    if is_in_solid {
        return Err(Problem::cut_off(Some(n_lines), expected_word(is_in_solid, is_in_facet)));
    }
    Ok(soup)
}

fn expected_word(is_in_solid: bool, is_in_facet: bool) -> &'static str {
    match (is_in_solid, is_in_facet) {
        (_, true) => "vertex or endfacet",
        (true, false) => "facet or endsolid",
        (false, false) => "solid",
    }
}
