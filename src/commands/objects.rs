//! `blindgrasp objects`

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::{Outcome, print_line};
use blindgrasp_objects::mesh::Mesh;
use blindgrasp_objects::mesh::folder::read_folder;
use blindgrasp_objects::mesh::write::write_mesh;
use blindgrasp_objects::{Object, object_of_mesh, objects_named, select};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_simulator::trial::things::things_named;

/// List the objects there are to grasp, or write them as meshes.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp objects --class can --out /tmp/cans\n\n\
                        --out writes a mesh for each object, catalogue.csv (which a folder of meshes is read back with) .")]
pub(super) struct Arguments {
    /// Which objects: all, train or held-out of the built-in ones, names and classes of them, a folder of meshes, or
    /// paper for the things of the paper's lift trials (paper/mug: only the mugs).
    #[arg(long, default_value = "all")]
    objects: String,
    /// Only this class.
    #[arg(long)]
    class: Option<String>,
    /// Write the objects to this folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// The meshes' format.
    #[arg(long, default_value = "off", requires = "out")]
    format: Format,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A mesh file's kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Off,
    Obj,
    Stl,
    Ply,
}

/// An object as it is listed.
struct Listed {
    name: String,
    class: String,
    held_out: bool,
    mass_kg: f64,
    mesh: Mesh,
}

#[derive(Serialize)]
struct Row<'a> {
    name: &'a str,
    class: &'a str,
    size_m: [f64; 3],
    mass_kg: f64,
    n_triangles: usize,
    split: &'a str,
}

impl Listed {
    fn row(&self) -> Row<'_> {
        let [least, most] = self.mesh.bounds();
        Row {
            name: &self.name,
            class: &self.class,
            size_m: (most - least).into(),
            mass_kg: self.mass_kg,
            n_triangles: self.mesh.triangles.len(),
            split: if self.held_out { "held-out" } else { "train" },
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let (objects, warnings) = match arguments.objects.split('/').next() {
        Some("paper") => (paper_objects(&arguments.objects)?, Vec::new()),
        _ => objects_named(&arguments.objects)?,
    };
    warnings.iter().for_each(|warning| print_diagnostic(&format!("warning: {warning}")));
    let objects = chosen(listed(objects), arguments.class.as_deref())?;
    if let Some(folder) = &arguments.out {
        write_folder(folder, &objects, arguments)?;
    }
    let rows: Vec<Row<'_>> = objects.iter().map(Listed::row).collect();
    if arguments.json {
        print_line(&serde_json::to_string_pretty(&rows)?)?;
        return Ok(Outcome::Done);
    }
    if let Some(folder) = &arguments.out {
        let n = objects.len();
        print_line(&format!("{n} objects and catalogue.csv written to {}", folder.display()))?;
        return Ok(Outcome::Done);
    }
    let name_width = rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(4);
    let class_width = rows.iter().map(|row| row.class.chars().count()).max().unwrap_or(0).max(5);
    print_line(&format!(
        "{:name_width$} {:class_width$}      size x × y × z mm    mass g  triangles  split",
        "name", "class"
    ))?;
    for row in &rows {
        let [x, y, z] = row.size_m.map(|metres| 1000.0 * metres);
        let mass = format!("{:.0}", 1000.0 * row.mass_kg);
        let (name, class, n_triangles, split) = (row.name, row.class, row.n_triangles, row.split);
        print_line(&format!(
            "{name:name_width$} {class:class_width$} {x:>7.1} × {y:>5.1} × {z:>5.1} {mass:>9} {n_triangles:>10}  {split}"
        ))?;
    }
    Ok(Outcome::Done)
}

/// The mesh of an object: of the folder's, if one is given, else of the built-in one of that name.
pub(super) fn find_mesh(name: &str, folder: Option<&Path>) -> anyhow::Result<Option<Mesh>> {
    if let Some(folder) = folder {
        let entry = read_folder(folder)?.into_iter().find(|entry| entry.name == name);
        return entry.map(|entry| Ok(object_of_mesh(&entry)?.0.to_mesh())).transpose();
    }
    // What is selected by a name may be a class or a split; an object has exactly this name.
    let found = select(name).ok().and_then(|found| found.into_iter().find(|object| object.name == name));
    Ok(found.map(|object| object.to_mesh()))
}

/// The things of lift trials, as objects by the things' names.
fn paper_objects(text: &str) -> anyhow::Result<Vec<Object>> {
    let things = things_named(text)?;
    Ok(things.into_iter().map(|thing| Object { name: thing.name, ..thing.object }).collect())
}

fn listed(objects: Vec<Object>) -> Vec<Listed> {
    objects
        .into_iter()
        .map(|object| {
            let mesh = object.to_mesh();
            let Object { name, class, held_out, mass_kg, .. } = object;
            Listed { name, class, held_out, mass_kg, mesh }
        })
        .collect()
}

fn chosen(objects: Vec<Listed>, class: Option<&str>) -> anyhow::Result<Vec<Listed>> {
    let Some(class) = class else { return Ok(objects) };
    let mut known: Vec<String> = objects.iter().map(|object| object.class.clone()).collect();
    known.dedup();
    let chosen: Vec<Listed> = objects.into_iter().filter(|object| object.class == class).collect();
    if chosen.is_empty() {
        bail!("no class '{class}': expected one of {}", known.join(", "));
    }
    Ok(chosen)
}

/// Meshes and catalogue.
fn write_folder(folder: &Path, objects: &[Listed], arguments: &Arguments) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let extension = arguments.format.to_possible_value().map_or(String::new(), |value| value.get_name().to_string());
    let mut catalogue = String::from("file,name,class,scale,mass_kg,split\n");
    let mut files = BTreeSet::new();
    for object in objects {
        let file = format!("{}.{extension}", file_stem(&object.name));
        if !files.insert(file.clone()) {
            bail!("two objects would be written to {file}: give '{}' another name", object.name);
        }
        write_mesh(&folder.join(&file), &object.mesh)?;
        let row = object.row();
        let mass_kg = object.mass_kg;
        let (name, class) = (csv_field(row.name), csv_field(row.class));
        // Whatever they were read from, they are written in metres.
        catalogue.push_str(&format!("{file},{name},{class},1,{mass_kg},{}\n", row.split));
    }
    write_file(&folder.join("catalogue.csv"), catalogue.as_bytes())
}

/// An object's name as far as it can be a file's on any system.
fn file_stem(name: &str) -> String {
    name.chars().map(|letter| if letter.is_alphanumeric() || "-_.".contains(letter) { letter } else { '_' }).collect()
}

/// A field of a CSV file, in quotes where it must be.
fn csv_field(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.into() }
}

fn write_file(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
