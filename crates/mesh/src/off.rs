//! The Object File Format: `OFF`, counts, vertices, polygons.

use std::fmt::Write;
use std::path::Path;

use crate::read::{Problem, Soup, coordinates, lines, quoted};
use crate::{Mesh, MeshError};

/// Reads OFF. Colours, normals and texture coordinates behind a vertex' coordinates or a face's indices are ignored.
///
/// # Errors
/// A file whose vertices and faces differ from its counts.
pub(crate) fn parse(bytes: &[u8]) -> Result<Soup, Problem> {
    let mut n_lines = 0;
    let mut lines = lines(bytes).map(|(number, line)| (number, line.split('#').next().unwrap_or_default().to_string()));
    // Blank lines and lines with nothing but a comment don't count.
    let mut next_line = |expected: &dyn Fn() -> String| {
        let found = lines.by_ref().inspect(|(number, _)| n_lines = *number).find(|(_, text)| !text.trim().is_empty());
        found.ok_or_else(|| Problem::cut_off(Some(n_lines), expected()))
    };

    let (number, first) = next_line(&|| "OFF".into())?;
    let mut counts_text = after_magic(&first, number)?.to_string();
    let mut counts_line = number;
    if counts_text.trim().is_empty() {
        (counts_line, counts_text) = next_line(&|| "the numbers of vertices, faces and edges".into())?;
    }
    let mut words = counts_text.split_whitespace();
    let n_vertices = count(words.next(), "the number of vertices", counts_line)?;
    let n_faces = count(words.next(), "the number of faces", counts_line)?;

    let mut soup = Soup::default();
    for vertex_idx in 0..n_vertices {
        let (number, text) =
            next_line(&|| format!("vertex {vertex_idx} of {n_vertices} (line {counts_line} says how many)"))?;
        soup.push_vertex(coordinates(&mut text.split_whitespace(), number)?, Some(number));
    }
    let mut idxs = Vec::new();
    for face_idx in 0..n_faces {
        let (number, text) = next_line(&|| format!("face {face_idx} of {n_faces} (line {counts_line} says how many)"))?;
        let mut words = text.split_whitespace();
        let n_corners = count(words.next(), "a face's number of vertices", number)?;
        idxs.clear();
        for corner_idx in 0..n_corners {
            let expected = || format!("index {corner_idx} of a face of {n_corners} vertices");
            let word = words.next().ok_or_else(|| Problem::new(Some(number), expected(), "the end of the line"))?;
            idxs.push(word.parse().map_err(|_| Problem::new(Some(number), expected(), quoted(word)))?);
        }
        // Some programs write loose points and lines as faces of one or two vertices: they have no area.
        if n_corners >= 3 {
            soup.push_polygon(&idxs, Some(number))?;
        }
    }
    match next_line(&String::new) {
        Ok((number, text)) => {
            let expected = format!("the end after {n_faces} faces (line {counts_line} says how many)");
            Err(Problem::new(Some(number), expected, quoted(text.trim())))
        }
        Err(_) => Ok(soup),
    }
}

/// Writes a mesh as OFF.
///
/// # Errors
/// A file that cannot be written.
pub fn write_off(path: &Path, mesh: &Mesh) -> Result<(), MeshError> {
    std::fs::write(path, format(mesh)).map_err(|source| MeshError::Write { path: path.into(), source })
}

/// Formats a mesh as OFF, with coordinates as short as they can be without loss.
fn format(mesh: &Mesh) -> String {
    let mut text = format!("OFF\n{} {} 0\n", mesh.vertices_m.len(), mesh.triangles.len());
    for vertex in &mesh.vertices_m {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{} {} {}", vertex.x, vertex.y, vertex.z);
    }
    for [a, b, c] in &mesh.triangles {
        let _ = writeln!(text, "3 {a} {b} {c}");
    }
    text
}

/// The rest of the magic word's line: nothing, or the counts, which some programs put there.
fn after_magic(line: &str, number: usize) -> Result<&str, Problem> {
    let word = line.trim_start();
    // Texture coordinates, colours and normals follow the coordinates and are ignored; 4OFF and nOFF aren't in space.
    let prefix = ["STCN", "STC", "STN", "ST", "CN", "C", "N", ""].into_iter();
    let rest = prefix.into_iter().find_map(|prefix| word.strip_prefix(prefix)?.strip_prefix("OFF"));
    let found = quoted(word.split_whitespace().next().unwrap_or_default());
    let rest = rest.ok_or_else(|| Problem::new(Some(number), "OFF (or COFF, NOFF, STOFF)", found))?;
    if rest.trim_start().to_ascii_uppercase().starts_with("BINARY") {
        return Err(Problem::new(Some(number), "OFF as text", "binary OFF, which is not read"));
    }
    Ok(rest)
}

fn count(word: Option<&str>, expected: &str, line: usize) -> Result<usize, Problem> {
    let word = word.ok_or_else(|| Problem::new(Some(line), expected, "the end of the line"))?;
    word.parse().map_err(|_| Problem::new(Some(line), expected, quoted(word)))
}
