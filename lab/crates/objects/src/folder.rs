//! A folder of mesh files as a collection of objects, with or without a catalogue.

use std::collections::{BTreeMap, HashMap};
use std::path::{Component, Path, PathBuf};

use crate::HELD_OUT_EVERY;
use blindgrasp_mesh::read::is_mesh_file;
use blindgrasp_messages::MAX_NAME_BYTES;

/// The catalogue's name within the folder.
pub const CATALOGUE_FILE: &str = "catalogue.csv";

/// The class of a mesh that lies in no class's folder.
const DEFAULT_CLASS: &str = "mesh";
/// Most bad rows that an error shows.
const MAX_SHOWN: usize = 10;

/// A mesh file with its entry in the catalogue.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshEntry {
    pub path: PathBuf,
    /// Unique; at most [`MAX_NAME_BYTES`].
    pub name: String,
    /// The kind of object; at most [`MAX_NAME_BYTES`].
    pub class: String,
    /// Metres per unit of the file.
    pub scale: f64,
    /// Mass, if known.
    pub mass_kg: Option<f64>,
    /// Density, if known.
    pub density_kg_per_m3: Option<f64>,
    /// Whether the mesh is never used for training.
    pub held_out: bool,
}

/// Why a folder of meshes was refused.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{}: expected a folder, or a mesh file that ends in .off, .obj, .stl, .ply, .dae or .glb", path.display())]
    NoMeshFile { path: PathBuf },
    #[error("{}: no meshes: expected a {CATALOGUE_FILE} with rows, or files that end in .off, .obj, .stl, .ply, .dae or .glb, here or below",
        path.display())]
    NoMeshes { path: PathBuf },
    /// The catalogue is not CSV, or lacks its header.
    #[error("{}: {reason}", path.display())]
    Catalogue { path: PathBuf, reason: String },
    /// Rows of the catalogue, or files of the folder, cannot be used. Each problem names its line or file.
    #[error("{}: {} of the meshes cannot be used:{}", path.display(), problems.len(), listed(problems))]
    Entries { path: PathBuf, problems: Vec<String> },
}

/// The meshes of a folder: those of its `catalogue.csv`, or, without one, every mesh file in it and below.
///
/// The catalogue has a header; `file` (relative to the folder, without `..`) is required; `name`, `class`, `scale`, `mass_kg`,
/// `density_kg_per_m3` and `split` (`train` or `held-out`) are optional; other columns are ignored. Where there is no name,
/// it is the file's path in the folder without extension, shortened from the left to fit; where there is no class, it is
/// the folder that the file lies in. Hidden files and links to folders are passed over. Without `split`, of the meshes of
/// a class every third is held out. A mesh file instead of a folder is a folder of one.
///
/// # Errors
/// A folder that cannot be read or has no meshes; a broken catalogue; every row that cannot be used, by its line.
pub fn read_folder(path: &Path) -> Result<Vec<MeshEntry>, FolderError> {
    let failed = |source| FolderError::Read { path: path.into(), source };
    if !std::fs::metadata(path).map_err(failed)?.is_dir() {
        if !is_mesh_file(path) {
            return Err(FolderError::NoMeshFile { path: path.into() });
        }
        let row = Row { file: PathBuf::from(path.file_name().unwrap_or_default()), ..Row::default() };
        return entries(path.parent().unwrap_or(Path::new("")), path, vec![row], Vec::new());
    }
    let catalogue = path.join(CATALOGUE_FILE);
    let (source, rows, problems) = if catalogue.is_file() {
        let (rows, problems) = read_catalogue(&catalogue, path)?;
        (catalogue.as_path(), rows, problems)
    } else {
        let mut files = Vec::new();
        collect_files(path, Path::new(""), &mut files)?;
        files.sort();
        let rows = files.into_iter().map(|file| Row { file, ..Row::default() }).collect();
        (path, rows, Vec::new())
    };
    if rows.is_empty() && problems.is_empty() {
        return Err(FolderError::NoMeshes { path: path.into() });
    }
    entries(path, source, rows, problems)
}

/// A row of the catalogue; missing values are `None`.
#[derive(Default)]
struct Row {
    /// Line of the catalogue; 0 without one.
    line: u64,
    /// Relative to the folder.
    file: PathBuf,
    name: Option<String>,
    class: Option<String>,
    scale: Option<f64>,
    mass_kg: Option<f64>,
    density_kg_per_m3: Option<f64>,
    held_out: Option<bool>,
}

impl Row {
    fn stem(&self) -> String {
        slashed(&self.file.with_extension(""))
    }

    fn problem(&self, text: &str) -> String {
        if self.line == 0 { format!("{}: {text}", self.file.display()) } else { format!("line {}: {text}", self.line) }
    }
}

pub(crate) fn listed(problems: &[String]) -> String {
    let shown: String = problems.iter().take(MAX_SHOWN).map(|problem| format!("\n  {problem}")).collect();
    match problems.len().saturating_sub(MAX_SHOWN) {
        0 => shown,
        n_more => format!("{shown}\n  and {n_more} more"),
    }
}

fn collect_files(folder: &Path, relative: &Path, files: &mut Vec<PathBuf>) -> Result<(), FolderError> {
    let here = folder.join(relative);
    let failed = |source| FolderError::Read { path: here.clone(), source };
    for item in std::fs::read_dir(&here).map_err(failed)? {
        let item = item.map_err(failed)?;
        let name = item.file_name();
        if name.to_string_lossy().starts_with('.') {
            continue;
        }
        let inner = relative.join(&name);
        // Links to folders are not followed: they may lead in a circle.
        if item.file_type().map_err(failed)?.is_dir() {
            collect_files(folder, &inner, files)?;
        } else if is_mesh_file(&inner) && folder.join(&inner).is_file() {
            files.push(inner);
        }
    }
    Ok(())
}

/// The valid rows, and the faults of the others.
fn read_catalogue(catalogue: &Path, folder: &Path) -> Result<(Vec<Row>, Vec<String>), FolderError> {
    let refused = |reason: String| FolderError::Catalogue { path: catalogue.into(), reason };
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(catalogue)
        .map_err(|error| refused(error.to_string()))?;
    let header = reader.headers().map_err(|error| refused(error.to_string()))?.clone();
    let column = |name: &str| header.iter().position(|column| column.eq_ignore_ascii_case(name));
    let Some(file_column) = column("file") else {
        let found = header.iter().collect::<Vec<_>>().join(",");
        return Err(refused(format!("expected a header with a column file, found {found:?}")));
    };
    let columns = ["name", "class", "scale", "mass_kg", "density_kg_per_m3", "split"].map(column);
    let (mut rows, mut problems) = (Vec::new(), Vec::new());
    for record in reader.records() {
        let record = match record {
            Ok(record) => record,
            Err(error) => {
                problems.push(csv_problem(&error));
                continue;
            }
        };
        let line = record.position().map_or(0, csv::Position::line);
        let cell = |column: Option<usize>| column.and_then(|column| record.get(column)).filter(|cell| !cell.is_empty());
        match read_row(cell(Some(file_column)), columns.map(cell), columns[5].is_some(), folder) {
            Ok(row) => rows.push(Row { line, ..row }),
            Err(problem) => problems.push(format!("line {line}: {problem}")),
        }
    }
    Ok((rows, problems))
}

fn csv_problem(error: &csv::Error) -> String {
    let line = error.position().map_or(0, csv::Position::line);
    match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("line {line}: expected {expected_len} columns, as the header has, found {len}")
        }
        csv::ErrorKind::Utf8 { .. } => format!("line {line}: expected UTF-8"),
        _ => error.to_string(),
    }
}

fn read_row(
    file: Option<&str>,
    [name, class, scale, mass, density, split]: [Option<&str>; 6],
    has_split: bool,
    folder: &Path,
) -> Result<Row, String> {
    let file = PathBuf::from(file.ok_or("file: expected the path of a mesh file, found nothing")?);
    if file.is_absolute() {
        return Err(format!("file: expected a path relative to the folder, found {}", file.display()));
    }
    if file.components().any(|part| part == Component::ParentDir) {
        let found = file.display();
        return Err(format!(
            "file: expected a path without .., found {found}: move the file into the catalogue's folder"
        ));
    }
    if !is_mesh_file(&file) {
        return Err(format!(
            "file: expected a name that ends in .off, .obj, .stl, .ply, .dae or .glb, found {}",
            file.display()
        ));
    }
    if !folder.join(&file).is_file() {
        return Err(format!("file: there is no file {} in the folder", file.display()));
    }
    let held_out = match split {
        _ if !has_split => None,
        Some(split) if split.eq_ignore_ascii_case("train") => Some(false),
        Some(split) if split.eq_ignore_ascii_case("held-out") => Some(true),
        other => return Err(format!("split: expected train or held-out, found {:?}", other.unwrap_or_default())),
    };
    Ok(Row {
        line: 0,
        file,
        name: name.map(Into::into),
        class: class.map(Into::into),
        scale: positive("scale", scale)?,
        mass_kg: positive("mass_kg", mass)?,
        density_kg_per_m3: positive("density_kg_per_m3", density)?,
        held_out,
    })
}

fn positive(column: &str, cell: Option<&str>) -> Result<Option<f64>, String> {
    let Some(cell) = cell else { return Ok(None) };
    match cell.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(Some(value)),
        _ => Err(format!("{column}: expected a positive number, found {cell:?}")),
    }
}

/// Fills in missing values, and checks names. `source` is the file or folder that errors name.
fn entries(
    folder: &Path,
    source: &Path,
    rows: Vec<Row>,
    mut problems: Vec<String>,
) -> Result<Vec<MeshEntry>, FolderError> {
    // Two files that differ in nothing but the extension keep it.
    let mut n_by_stem: HashMap<String, usize> = HashMap::new();
    for row in rows.iter().filter(|row| row.name.is_none()) {
        *n_by_stem.entry(row.stem()).or_default() += 1;
    }
    let mut first_by_name: HashMap<String, String> = HashMap::new();
    let mut n_by_class: BTreeMap<String, usize> = BTreeMap::new();
    let mut entries = Vec::new();
    for row in rows {
        let name = match &row.name {
            Some(name) => name.clone(),
            None if n_by_stem[&row.stem()] > 1 => shortened(slashed(&row.file)),
            None => shortened(row.stem()),
        };
        let parent = row.file.parent().and_then(Path::file_name).map(|name| name.to_string_lossy().into_owned());
        let class = row.class.clone().or(parent).unwrap_or_else(|| DEFAULT_CLASS.into());
        for (what, text) in [("name", &name), ("class", &class)] {
            if text.len() > MAX_NAME_BYTES {
                let text = format!("{what}: expected at most {MAX_NAME_BYTES} bytes, found {} ({text})", text.len());
                problems.push(row.problem(&text));
            }
        }
        let place = if row.line == 0 { row.file.display().to_string() } else { format!("line {}", row.line) };
        if let Some(first) = first_by_name.insert(name.clone(), place) {
            let text = format!(
                "name: expected names that differ, found {name:?} again (first: {first}): give names in {CATALOGUE_FILE}"
            );
            problems.push(row.problem(&text));
        }
        let n_before = n_by_class.entry(class.clone()).or_default();
        let is_every_third = *n_before % HELD_OUT_EVERY == HELD_OUT_EVERY - 1;
        *n_before += 1;
        entries.push(MeshEntry {
            path: folder.join(&row.file),
            name,
            class,
            scale: row.scale.unwrap_or(1.0),
            mass_kg: row.mass_kg,
            density_kg_per_m3: row.density_kg_per_m3,
            held_out: row.held_out.unwrap_or(is_every_third),
        });
    }
    if problems.is_empty() { Ok(entries) } else { Err(FolderError::Entries { path: source.into(), problems }) }
}

/// A path with `/` between its parts, on every platform.
fn slashed(path: &Path) -> String {
    let parts: Vec<_> = path.components().map(|part| part.as_os_str().to_string_lossy()).collect();
    parts.join("/")
}

/// The end of a long name, which tells files apart better than its beginning, behind an ellipsis.
fn shortened(name: String) -> String {
    const ELLIPSIS: &str = "…";
    if name.len() <= MAX_NAME_BYTES {
        return name;
    }
    let room = MAX_NAME_BYTES - ELLIPSIS.len();
    let start = (name.len() - room..name.len()).find(|start| name.is_char_boundary(*start)).unwrap_or(name.len());
    format!("{ELLIPSIS}{}", &name[start..])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with these files.
    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a folder");
        for (file, text) in files {
            let path = folder.path().join(file);
            std::fs::create_dir_all(path.parent().expect("a parent")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        folder
    }

    fn error_of(files: &[(&str, &str)]) -> String {
        read_folder(folder(files).path()).expect_err("no collection").to_string()
    }

    #[test]
    fn without_a_catalogue_folders_are_classes() {
        let names = ["cup/b.off", "cup/a.STL", "cup/old/a.ply", "cup/c.obj", "top.off", ".git/x.off", "cup/readme.txt"];
        let entries = read_folder(folder(&names.map(|name| (name, ""))).path()).expect("meshes");
        let found: Vec<_> = entries.iter().map(|e| (e.name.as_str(), e.class.as_str(), e.held_out)).collect();
        let expected = [
            ("cup/a", "cup", false),
            ("cup/b", "cup", false),
            ("cup/c", "cup", true),
            ("cup/old/a", "old", false),
            ("top", "mesh", false),
        ];
        assert_eq!(found, expected);
        assert!(entries.iter().all(|entry| entry.scale == 1.0 && entry.mass_kg.is_none()));
        assert!(entries[0].path.ends_with("cup/a.STL"));
    }

    #[test]
    fn a_catalogue_says_what_is_what() {
        let text = "\u{feff}File, name ,class,scale,mass_kg,density_kg_per_m3,split,colour\n\
                    a.off,Cup one,cup,0.001,0.3,,train,red\n\n\
                    \"b.off\",,,,,900,HELD-OUT,\n";
        let folder = folder(&[("catalogue.csv", text), ("a.off", ""), ("b.off", ""), ("c.off", "")]);
        let entries = read_folder(folder.path()).expect("a catalogue");
        let a = MeshEntry {
            path: folder.path().join("a.off"),
            name: "Cup one".into(),
            class: "cup".into(),
            scale: 0.001,
            mass_kg: Some(0.3),
            density_kg_per_m3: None,
            held_out: false,
        };
        let b = MeshEntry {
            path: folder.path().join("b.off"),
            name: "b".into(),
            class: "mesh".into(),
            scale: 1.0,
            mass_kg: None,
            density_kg_per_m3: Some(900.0),
            held_out: true,
        };
        assert_eq!(entries, [a, b]);
    }

    #[test]
    fn a_file_is_a_folder_of_one() {
        let folder = folder(&[("spoon.ply", ""), ("notes.txt", "")]);
        let entries = read_folder(&folder.path().join("spoon.ply")).expect("one mesh");
        assert_eq!((entries.len(), entries[0].name.as_str(), entries[0].class.as_str()), (1, "spoon", "mesh"));
        assert_eq!(entries[0].path, folder.path().join("spoon.ply"));
        assert!(matches!(read_folder(&folder.path().join("notes.txt")), Err(FolderError::NoMeshFile { .. })));
        assert!(matches!(read_folder(&folder.path().join("none")), Err(FolderError::Read { .. })));
    }

    #[test]
    fn every_bad_row_is_named() {
        let text = "file,name,scale,mass_kg,density_kg_per_m3,split\n\
                    a.off,,x,,,train\na.off,,,-1,,train\na.off,,,,inf,train\na.off,,,,,test\na.off,,,,,\n,,,,,train\n\
                    a.txt,,,,,train\nb.off,,,,,train\n/a.off,,,,,train\na.off,,\na.off,first,,,,train\n\
                    a.off,first,,,,train\na.off,00000000001111111111222222222233333333334444444444555555555566666,,,,train\n";
        let folder = folder(&[("catalogue.csv", text), ("a.off", "")]);
        let Err(FolderError::Entries { problems, .. }) = read_folder(folder.path()) else { panic!("no collection") };
        let expected = [
            "line 2: scale: expected a positive number, found \"x\"",
            "line 3: mass_kg: expected a positive number, found \"-1\"",
            "line 4: density_kg_per_m3: expected a positive number, found \"inf\"",
            "line 5: split: expected train or held-out, found \"test\"",
            "line 6: split: expected train or held-out, found \"\"",
            "line 7: file: expected the path of a mesh file, found nothing",
            "line 8: file: expected a name that ends in .off, .obj, .stl, .ply, .dae or .glb, found a.txt",
            "line 9: file: there is no file b.off in the folder",
            "line 10: file: expected a path relative to the folder, found /a.off",
            "line 11: expected 6 columns, as the header has, found 3",
            "line 13: name: expected names that differ, found \"first\" again (first: line 12): give names in catalogue.csv",
            "line 14: name: expected at most 64 bytes, found 65 (00000000001111111111222222222233333333334444444444555555555566666)",
        ];
        assert_eq!(problems, expected);
        let error = read_folder(folder.path()).expect_err("bad").to_string();
        assert!(error.contains("catalogue.csv: 12 of the meshes cannot be used:\n  line 2"), "{error}");
        assert!(error.ends_with("line 11: expected 6 columns, as the header has, found 3\n  and 2 more"), "{error}");
    }

    #[test]
    fn files_outside_of_the_folder_are_refused() {
        let files = ["../a.off", "cup/../../a.off", "cup/../b.off"];
        for file in files {
            let catalogue = format!("file\n{file}\n");
            let folder = folder(&[
                ("a.off", ""),
                ("inner/catalogue.csv", &catalogue),
                ("inner/cup/b.off", ""),
                ("inner/b.off", ""),
            ]);
            let error = read_folder(&folder.path().join("inner")).expect_err("outside").to_string();
            assert!(error.contains(&format!("line 2: file: expected a path without .., found {file}")), "{error}");
        }
    }

    #[test]
    fn folders_without_meshes_and_catalogues_without_header() {
        assert!(
            error_of(&[("a.txt", "")]).contains("no meshes: expected a catalogue.csv with rows, or files that end in")
        );
        assert!(error_of(&[("catalogue.csv", "file\n"), ("a.off", "")]).contains("no meshes"));
        let error = error_of(&[("catalogue.csv", "path,class\na.off,cup\n"), ("a.off", "")]);
        assert!(error.ends_with("expected a header with a column file, found \"path,class\""), "{error}");
        assert!(error_of(&[("catalogue.csv", ""), ("a.off", "")]).ends_with("a column file, found \"\""));
    }

    #[test]
    fn names_differ_and_fit() {
        let class = "éclair".repeat(10);
        let error = error_of(&[(&format!("{class}/a.off"), "")]);
        assert!(error.contains(&format!("class: expected at most 64 bytes, found 70 ({class})")), "{error}");
        let long = format!("{}/{}", "é".repeat(20), "spoon".repeat(9));
        let files = ["a.off", "a.stl", &format!("{long}.off")];
        let entries = read_folder(folder(&files.map(|file| (file, ""))).path()).expect("meshes");
        let names: Vec<&str> = entries.iter().map(|entry| entry.name.as_str()).collect();
        assert_eq!(names[..2], ["a.off", "a.stl"]);
        assert!(names[2].len() <= MAX_NAME_BYTES && names[2].starts_with("…é"), "{}", names[2]);
        assert!(names[2].ends_with(&"spoon".repeat(9)));
    }
}
