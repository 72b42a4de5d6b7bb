//! `blindgrasp simulate --list`

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, bail};
use serde::Serialize;

use super::{Outcome, print_line, print_text};
use blindgrasp_mesh::write_off;
use blindgrasp_objects::{Object, objects_named};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_simulator::trial::targets::targets_named;

#[derive(Serialize)]
struct Row<'a> {
    name: &'a str,
    class: &'a str,
    size_m: [f64; 3],
    mass_kg: f64,
    n_triangles: usize,
    split: &'static str,
}

/// Lists objects, and writes them to a folder of meshes if one is given.
pub(super) fn list(objects: &str, folder: Option<&Path>, as_json: bool) -> anyhow::Result<Outcome> {
    let (objects, warnings) = match objects.split('/').next() {
        Some("paper") => (paper_objects(objects)?, Vec::new()),
        _ => objects_named(objects)?,
    };
    warnings.iter().for_each(|warning| print_diagnostic(&format!("warning: {warning}")));
    if let Some(folder) = folder {
        write_folder(folder, &objects)?;
    }
    let rows: Vec<Row<'_>> = objects.iter().map(row).collect();
    match folder {
        _ if as_json => print_text(&serde_json::to_string_pretty(&rows)?)?,
        Some(folder) => {
            print_line(&format!("{} and catalogue.csv written to {}", counted(rows.len(), "object"), folder.display()))?
        }
        None => print_table(&rows)?,
    }
    Ok(Outcome::Done)
}

/// The objects of the paper's lift trials, by their names there.
fn paper_objects(text: &str) -> anyhow::Result<Vec<Object>> {
    Ok(targets_named(text)?.into_iter().map(|target| target.object).collect())
}

fn row(object: &Object) -> Row<'_> {
    let mesh = object.to_mesh();
    let [least, most] = mesh.bounds();
    Row {
        name: &object.name,
        class: &object.class,
        size_m: (most - least).into(),
        mass_kg: object.mass_kg,
        n_triangles: mesh.triangles.len(),
        split: if object.held_out { "held-out" } else { "train" },
    }
}

fn print_table(rows: &[Row<'_>]) -> anyhow::Result<()> {
    let name_width = rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(4);
    let class_width = rows.iter().map(|row| row.class.chars().count()).max().unwrap_or(0).max(5);
    print_line(&format!(
        "{:name_width$} {:class_width$}      size x × y × z mm    mass g  triangles  split",
        "name", "class"
    ))?;
    for Row { name, class, size_m, mass_kg, n_triangles, split } in rows {
        let [x, y, z] = size_m.map(|metres| 1000.0 * metres);
        let mass = format!("{:.0}", 1000.0 * mass_kg);
        print_line(&format!(
            "{name:name_width$} {class:class_width$} {x:>7.1} × {y:>5.1} × {z:>5.1} {mass:>9} {n_triangles:>10}  {split}"
        ))?;
    }
    Ok(())
}

/// Writes meshes, and a catalogue with which the folder can be read again.
fn write_folder(folder: &Path, objects: &[Object]) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let path = folder.join("catalogue.csv");
    let cannot_write = || format!("cannot write {}", path.display());
    let mut catalogue = csv::Writer::from_path(&path).with_context(cannot_write)?;
    catalogue.write_record(["file", "name", "class", "scale", "mass_kg", "split"])?;
    let mut files = BTreeSet::new();
    for object in objects {
        let file = format!("{}.off", file_stem(&object.name));
        if !files.insert(file.clone()) {
            bail!("two objects would be written to {file}: give '{}' another name", object.name);
        }
        write_off(&folder.join(&file), &object.to_mesh())?;
        let split = if object.held_out { "held-out" } else { "train" };
        // All meshes are written in metres.
        let mass_kg = object.mass_kg.to_string();
        let row = [file.as_str(), &object.name, &object.class, "1", &mass_kg, split];
        catalogue.write_record(row).with_context(cannot_write)?;
    }
    catalogue.flush().with_context(cannot_write)
}

/// The characters of a name that every system allows in a file's name.
fn file_stem(name: &str) -> String {
    name.chars().map(|letter| if letter.is_alphanumeric() || "-_.".contains(letter) { letter } else { '_' }).collect()
}
