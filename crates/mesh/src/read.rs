//! Reading meshes: OFF, OBJ, STL (ASCII and binary), PLY (ASCII and binary), COLLADA and binary glTF.
//!
//! Only the shape is read. No memory is allocated because of a header's counts: it is bounded by the file's length.

use std::collections::HashMap;
use std::io::Read;
use std::path::Path;

use nalgebra::Point3;

use crate::{Mesh, MeshError, obj, off, ply, scene, stl};

/// Greatest size of a mesh file: scans of a million triangles take 50 to 100 MiB.
const MAX_BYTES: u64 = 256 << 20;

/// Reads a mesh file, by its extension, and multiplies its lengths by `scale` (0.001 for a file in millimetres).
///
/// Polygons become fans of triangles. Vertices at equal positions become one.
///
/// # Errors
/// A file that cannot be read, is empty or larger than 256 MiB, damaged or cut off, has no triangles, or names missing vertices; with the line
/// where the format has lines. A scale that is not positive.
pub fn read_mesh(path: &Path, scale: f64) -> Result<Mesh, MeshError> {
    if !(scale.is_finite() && scale > 0.0) {
        return Err(MeshError::Scale { found: scale });
    }
    let Some(parse) = parser_of(path) else { return Err(MeshError::UnknownFormat { path: path.into() }) };
    let bytes = read_file(path).map_err(|source| MeshError::Read { path: path.into(), source })?;
    if bytes.is_empty() {
        return Err(MeshError::Empty { path: path.into() });
    }
    if bytes.starts_with(b"version https://git-lfs.github.com/spec/") {
        return Err(MeshError::GitLfsPointer { path: path.into() });
    }
    let mesh = parse(&bytes).and_then(|soup| soup.into_mesh(scale)).map_err(|Problem { line, expected, found }| {
        MeshError::Malformed { path: path.into(), line, expected, found }
    })?;
    if mesh.triangles.is_empty() {
        return Err(MeshError::NoTriangles { path: path.into(), n_vertices: mesh.vertices_m.len() });
    }
    Ok(mesh)
}

/// Whether a file's extension is that of a format that can be read.
pub fn is_mesh_file(path: &Path) -> bool {
    parser_of(path).is_some()
}

type Parser = fn(&[u8]) -> Result<Soup, Problem>;

/// The parser of the format that a file's extension says, in upper or lower case.
fn parser_of(path: &Path) -> Option<Parser> {
    let extension = path.extension()?.to_string_lossy().to_ascii_lowercase();
    Some(match extension.as_str() {
        "off" => off::parse,
        "obj" => obj::parse,
        "stl" => stl::parse,
        "ply" => ply::parse,
        "dae" => scene::parse_dae,
        "glb" => scene::parse_glb,
        _ => return None,
    })
}

/// Refuses pipes and devices, which may never end, and files that would take all memory.
fn read_file(path: &Path) -> std::io::Result<Vec<u8>> {
    if !std::fs::metadata(path)?.is_file() {
        return Err(std::io::Error::other("not a file"));
    }
    let mut bytes = Vec::new();
    std::fs::File::open(path)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MAX_BYTES {
        let most = MAX_BYTES >> 20;
        return Err(std::io::Error::other(format!("more than {most} MiB: expected a mesh with fewer triangles")));
    }
    Ok(bytes)
}

/// A fault of a file, and its place.
#[derive(Debug)]
pub(crate) struct Problem {
    pub(crate) line: Option<usize>,
    pub(crate) expected: String,
    pub(crate) found: String,
}

impl Problem {
    pub(crate) fn new(line: Option<usize>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Problem { line, expected: expected.into(), found: found.into() }
    }

    pub(crate) fn cut_off(line: Option<usize>, expected: impl Into<String>) -> Self {
        Problem::new(line, expected, "the end of the file (is it cut off?)")
    }
}

/// Vertices and triangles as a file lists them, not merged and with unchecked indices.
#[derive(Debug, Default)]
pub(crate) struct Soup {
    /// In the file's unit, with the line.
    vertices: Vec<(Point3<f64>, Option<usize>)>,
    /// Indices into the vertices, from 0, with the line.
    triangles: Vec<([i64; 3], Option<usize>)>,
    /// Number of the first vertex in the file's format, for messages only.
    first_idx: i64,
}

impl Soup {
    pub(crate) fn counted_from(first_idx: i64) -> Soup {
        Soup { first_idx, ..Soup::default() }
    }

    pub(crate) fn n_vertices(&self) -> usize {
        self.vertices.len()
    }

    pub(crate) fn n_corners(&self) -> usize {
        3 * self.triangles.len()
    }

    pub(crate) fn push_vertex(&mut self, position: [f64; 3], line: Option<usize>) {
        self.vertices.push((position.into(), line));
    }

    /// Adds a polygon as a fan of triangles around its first corner.
    ///
    /// # Errors
    /// Fewer than three corners.
    pub(crate) fn push_polygon(&mut self, idxs: &[i64], line: Option<usize>) -> Result<(), Problem> {
        let [first, rest @ ..] = idxs else {
            return Err(Problem::new(line, "a face of at least 3 vertices", "none"));
        };
        if rest.len() < 2 {
            return Err(Problem::new(line, "a face of at least 3 vertices", idxs.len().to_string()));
        }
        self.triangles.extend(rest.windows(2).map(|pair| ([*first, pair[0], pair[1]], line)));
        Ok(())
    }

    /// Scales the vertices, merges those at equal positions, and checks the indices.
    fn into_mesh(self, scale: f64) -> Result<Mesh, Problem> {
        let mut mesh = Mesh::default();
        let mut merged = Vec::with_capacity(self.vertices.len());
        let mut idx_by_position = HashMap::with_capacity(self.vertices.len());
        for (position, line) in &self.vertices {
            // Adding zero turns -0 into 0, so that equal positions have equal bits.
            let scaled = position.map(|coordinate| coordinate * scale + 0.0);
            if !scaled.iter().all(|coordinate| coordinate.is_finite()) {
                let found = format!("({}, {}, {})", position.x, position.y, position.z);
                return Err(Problem::new(*line, "finite coordinates", found));
            }
            let idx = *idx_by_position.entry([scaled.x, scaled.y, scaled.z].map(f64::to_bits)).or_insert_with(|| {
                mesh.vertices_m.push(scaled);
                mesh.vertices_m.len() - 1
            });
            let idx = u32::try_from(idx).map_err(|_| Problem::new(*line, "at most 2^32 vertices", "more"))?;
            merged.push(idx);
        }
        for (triangle, line) in &self.triangles {
            let mut corners = [0; 3];
            for (corner, idx) in corners.iter_mut().zip(triangle) {
                *corner = *usize::try_from(*idx).ok().and_then(|idx| merged.get(idx)).ok_or_else(|| {
                    let last = self.vertices.len() as i64 - 1 + self.first_idx;
                    let expected = format!("the index of a vertex ({} to {last})", self.first_idx);
                    Problem::new(*line, expected, idx.saturating_add(self.first_idx).to_string())
                })?;
            }
            mesh.triangles.push(corners);
        }
        Ok(mesh)
    }
}

/// The lines of a text file, numbered from 1, without byte order mark and line ends. Bytes that are no text become `�`.
pub(crate) fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, std::borrow::Cow<'_, str>)> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    bytes.split(|byte| *byte == b'\n').map(String::from_utf8_lossy).enumerate().map(|(idx, line)| (idx + 1, line))
}

pub(crate) fn coordinates<'a>(words: &mut impl Iterator<Item = &'a str>, line: usize) -> Result<[f64; 3], Problem> {
    let mut coordinates = [0.0; 3];
    for (coordinate, axis) in coordinates.iter_mut().zip(["x", "y", "z"]) {
        let expected = || format!("a vertex' {axis} coordinate");
        let word = words.next().ok_or_else(|| Problem::new(Some(line), expected(), "the end of the line"))?;
        *coordinate = word.parse().map_err(|_| Problem::new(Some(line), expected(), quoted(word)))?;
    }
    Ok(coordinates)
}

/// A word of a file for a message, in quotes and shortened.
pub(crate) fn quoted(word: &str) -> String {
    const MAX_CHARS: usize = 40;
    let shown: String = word.chars().take(MAX_CHARS).collect();
    let dots = if word.chars().nth(MAX_CHARS).is_some() { "…" } else { "" };
    format!("{:?}", shown + dots)
}
