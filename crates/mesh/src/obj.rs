//! Wavefront OBJ: the lines `v` and `f`.

use crate::read::{Problem, Soup, coordinates, lines, quoted};

/// Reads OBJ. All objects and groups of the file become one mesh. A fourth coordinate (a weight, for curves), colours,
/// texture coordinates, normals, points, lines and curves are ignored.
///
/// # Errors
/// Vertices without three coordinates; faces with fewer than three vertices, or with a vertex that is not there.
pub(crate) fn parse(bytes: &[u8]) -> Result<Soup, Problem> {
    let mut soup = Soup::counted_from(1);
    let mut idxs = Vec::new();
    let mut lines = lines(bytes);
    while let Some((number, line)) = lines.next() {
        let mut text = line.split('#').next().unwrap_or_default().trim_end().to_string();
        // A backslash continues a line on the next one.
        while text.ends_with('\\') {
            text.pop();
            text.push(' ');
            text.push_str(lines.next().map(|(_, line)| line).unwrap_or_default().trim_end());
        }
        let mut words = text.split_whitespace();
        match words.next() {
            Some("v") => soup.push_vertex(coordinates(&mut words, number)?, Some(number)),
            Some("f") => {
                idxs.clear();
                for word in words {
                    idxs.push(vertex_idx(word, soup.n_vertices(), number)?);
                }
                soup.push_polygon(&idxs, Some(number))?;
            }
            // Other lines are extensions.
            Some(_) | None => {}
        }
    }
    Ok(soup)
}

/// The first index of `v`, `v/vt`, `v//vn` or `v/vt/vn`, from 0. Negative ones count back from the last vertex so far.
fn vertex_idx(word: &str, n_vertices: usize, line: usize) -> Result<i64, Problem> {
    let number: Option<i64> = word.split('/').next().and_then(|number| number.parse().ok());
    match number {
        // The number of vertices is checked at the end, because vertices may follow the face.
        Some(number) if number > 0 => Ok(number - 1),
        Some(number) if number < 0 && number.unsigned_abs() <= n_vertices as u64 => Ok(n_vertices as i64 + number),
        Some(number) => {
            let expected = format!("the index of a vertex (1 to {n_vertices}, or -{n_vertices} to -1)");
            Err(Problem::new(Some(line), expected, number.to_string()))
        }
        None => Err(Problem::new(Some(line), "a vertex' index, like 7 or 7/2/5", quoted(word))),
    }
}
