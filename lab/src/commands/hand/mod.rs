//! `blindgrasp new hand`: a pad layout from a URDF and a table of cells or grids of cells.

mod draft;
mod xacro;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use blindgrasp_messages::files::read_regular;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_stages::hand::{
    BareHand, Cell, Hand, find_mesh, find_mesh_alike, part_below, read_urdf, with_meshes_renamed,
};
use clap::Args;
use nalgebra::{Point3, Unit, Vector3};
use serde::Deserialize;

use blindgrasp_cli::{check_free, in_shell, joint};

use super::{Outcome, print_line, print_text};
use draft::Draft;

/// A hand: its URDF and a pad layout.
///
/// The folder gets the pad layout and the URDF (expanded, if it is a xacro file, with the collision meshes beside it).
/// Without --cells and --grid, the links and joints are listed and nothing is made.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp new hand my_gripper --urdf gripper.urdf\n  \
                  blindgrasp new hand my_gripper --urdf gripper.urdf.xacro --palm hand_base --open finger_joint=0.04 \\\n    \
                  --grid left_finger=4x3 --grid right_finger=4x3\n  \
                  blindgrasp new hand my_hand --urdf my_hand.urdf --cells cells.csv\n  \
                  blindgrasp new hand my_hand --urdf robot.urdf --base hand_base --cells cells.csv\n\n\
                  The table of cells has a column for each of: link, x, y, z (metres, in the link's frame), nx, ny, nz (the normal,\n\
                  out of the pad). It may have: pad, width and height (metres), ax, ay, az (the direction of the width), and\n\
                  threshold (newtons).")]
pub(super) struct Arguments {
    /// The folder to make; its last part is the hand's name.
    name: PathBuf,
    /// The hand's URDF. A name that ends in .xacro is expanded by the program xacro (from PyPI or ROS).
    #[arg(long, value_name = "FILE")]
    urdf: PathBuf,
    /// An argument of the xacro file. Can be repeated.
    #[arg(long, value_name = "NAME:=VALUE", value_parser = xacro::argument)]
    xacro_arg: Vec<String>,
    /// Table of the cells (CSV).
    #[arg(long, value_name = "FILE")]
    cells: Option<PathBuf>,
    /// A pad of ROWS x COLUMNS cells on the side of a link that meets the object as the hand closes. Can be repeated.
    #[arg(long = "grid", value_name = "LINK=ROWSxCOLUMNS", value_parser = grid)]
    grids: Vec<(String, [usize; 2])>,
    /// The first link of the hand, if the URDF is that of a whole robot: the hand consists of it and of the links below it.
    #[arg(long, value_name = "LINK")]
    base: Option<String>,
    /// The link in whose frame contacts are given, +z out of the palm [default: the root].
    #[arg(long, value_name = "LINK")]
    palm: Option<String>,
    /// Pose of the palm frame in that link, if its own +z does not point out of the palm. In metres and radians [default:
    /// the link's own frame, or one in which the hand closes better on a ball, which is told].
    #[arg(
        long,
        value_name = "X,Y,Z,ROLL,PITCH,YAW",
        value_delimiter = ',',
        num_args = 1,
        allow_negative_numbers = true
    )]
    palm_pose: Vec<f64>,
    /// The value of a joint of the open hand [default: 0, or a value with which the hand closes better, which is told]. The hand
    /// closes towards the limit that is farther from it.
    #[arg(long, value_name = "JOINT=VALUE,…", value_delimiter = ',', value_parser = joint)]
    open: Vec<(String, f64)>,
    /// Joints that are set before a grasp and do not close [default: those that move no pad towards an object, which are told].
    #[arg(long, value_name = "JOINT,…", value_delimiter = ',')]
    preshape: Vec<String>,
    /// Noise threshold of the cells, newtons.
    #[arg(long, default_value_t = 0.05, value_name = "NEWTONS", value_parser = threshold)]
    threshold: f64,
}

fn threshold(text: &str) -> Result<f64, String> {
    let newtons: f64 = text.parse().map_err(|_| "expected a number".to_string())?;
    if newtons >= 0.0 && newtons.is_finite() { Ok(newtons) } else { Err("expected 0 or more".into()) }
}

/// A pad of the layout to be written.
#[derive(Clone)]
struct NewPad {
    name: String,
    link: String,
    cells: Vec<Cell>,
}

/// A row of the table of cells.
#[derive(Debug, Deserialize)]
struct Row {
    link: String,
    pad: Option<String>,
    x: f64,
    y: f64,
    z: f64,
    nx: f64,
    ny: f64,
    nz: f64,
    ax: Option<f64>,
    ay: Option<f64>,
    az: Option<f64>,
    width: Option<f64>,
    height: Option<f64>,
    threshold: Option<f64>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = &arguments.name;
    let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    check_free(folder)?;
    let (source, urdf) = source_urdf(arguments)?;
    let mut table = Vec::new();
    if let Some(cells) = &arguments.cells {
        table = read_table(cells, arguments.threshold)?;
    }
    let of_table = table.iter().map(|pad| pad.link.clone());
    let bare = BareHand {
        padded_links: of_table.chain(arguments.grids.iter().map(|(link, _)| link.clone())).collect(),
        name: name.into(),
        palm: arguments.palm.clone(),
        open: arguments.open.iter().cloned().collect(),
        preshape_joints: arguments.preshape.clone(),
    };
    let draft = Draft::new(&source, urdf, bare, palm_pose(arguments)?);
    let mut draft = draft.map_err(|error| with_base_advice(error, arguments))?;
    print_parts(&draft.hand)?;
    if let Some(joint) = draft.hand.joint_above_palm() {
        bail!("joint '{}' moves the palm: give the first link of the hand with --base", joint.name);
    }
    if arguments.cells.is_none() && arguments.grids.is_empty() {
        print_text(
            "\nnothing is made yet: give a table of the cells with --cells, or pads with --grid LINK=ROWSxCOLUMNS",
        )?;
        return Ok(Outcome::Done);
    }
    draft.move_to_bodies(&mut table)?;
    size_by_neighbours(&mut table)?;
    draft.fit(&table, arguments)?;
    let pads = draft.laid_pads(&table, arguments)?;
    draft.warn(&pads)?;
    draft.tell_felt(&pads)?;
    let Draft { urdf, hand, bare, .. } = draft;
    let (urdf, meshes) = with_meshes_beside(&urdf, source.parent().unwrap_or(Path::new("")))?;
    let layout = layout(name, &hand, &pads, &bare);
    std::fs::create_dir(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let written = write_folder(folder, name, &urdf, &layout, &meshes);
    if written.is_err() {
        let _ = std::fs::remove_dir_all(folder);
    }
    let hand = written?;
    let layout_path = folder.join(format!("{name}.yaml"));
    let shown = in_shell(&layout_path.display().to_string());
    print_text(&format!(
        "\n{}: {} pads, {} cells\nnext:\n  blindgrasp view {shown} --out hand.html      look at it, turn it, close it\n  \
         blindgrasp learn {shown}      lift in simulation, train, and print how to start",
        layout_path.display(),
        hand.pads.len(),
        hand.n_cells()
    ))?;
    Ok(Outcome::Done)
}

/// The URDF of the hand, and the file that it is from.
fn source_urdf(arguments: &Arguments) -> anyhow::Result<(PathBuf, String)> {
    let (source, urdf) = (arguments.urdf.clone(), urdf_text(&arguments.urdf, &arguments.xacro_arg)?);
    let Some(base) = &arguments.base else { return Ok((source, urdf)) };
    let part = part_below(&urdf, base).map_err(|reason| anyhow::anyhow!("--base: {reason}"))?;
    Ok((source, part))
}

/// Writes all files, and reads the hand from them.
fn write_folder(
    folder: &Path,
    name: &str,
    urdf: &str,
    layout: &str,
    meshes: &[(PathBuf, String)],
) -> anyhow::Result<Hand> {
    let write = |extension: &str, text: &str| {
        let path = folder.join(format!("{name}.{extension}"));
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
        anyhow::Ok(path)
    };
    if !meshes.is_empty() {
        std::fs::create_dir(folder.join("meshes")).context("cannot make the folder of the meshes")?;
    }
    for (from, to) in meshes {
        std::fs::copy(from, folder.join(to)).with_context(|| format!("cannot copy {}", from.display()))?;
    }
    write("urdf", urdf)?;
    let hand = Hand::load(&write("yaml", layout)?)?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    Ok(hand)
}

/// The text of the URDF. A xacro file is expanded.
fn urdf_text(path: &Path, xacro_arguments: &[String]) -> anyhow::Result<String> {
    if path.extension().is_some_and(|extension| extension == "xacro") {
        return xacro::expanded(path, xacro_arguments);
    }
    if !xacro_arguments.is_empty() {
        bail!("--xacro-arg is of no use to {}: its name does not end in .xacro", path.display());
    }
    Ok(read_urdf(path)?)
}

/// Adds the remedy to an error that the URDF of a whole robot makes.
fn with_base_advice(error: anyhow::Error, arguments: &Arguments) -> anyhow::Error {
    let text = format!("{error:#}");
    if let Some(base) = &arguments.base
        && text.contains(": 0 joints")
    {
        return anyhow::anyhow!("{text}; below --base {base} nothing moves: name a link above it");
    }
    // The lift of an arm is longer than any slide of a hand.
    let is_large = ["more than 256 links", "joints, expected 1 to", " m of 0"].iter().any(|found| text.contains(found));
    if !is_large || arguments.base.is_some() || text.contains(" 0 joints") {
        return error;
    }
    anyhow::anyhow!("{text}; if it is a whole robot, give the first link of the hand with --base LINK")
}

/// The farthest that the frame of a palm lies from that of its link.
const MAX_PALM_OFFSET_M: f64 = 2.0;

/// The pose of --palm-pose.
fn palm_pose(arguments: &Arguments) -> anyhow::Result<Option<[f64; 6]>> {
    let pose = &arguments.palm_pose;
    match <[f64; 6]>::try_from(pose.as_slice()) {
        Ok(pose) if pose[..3].iter().any(|length| length.abs() > MAX_PALM_OFFSET_M) => {
            bail!("--palm-pose: x, y and z are {:?}: expected metres, each at most {MAX_PALM_OFFSET_M}", &pose[..3])
        }
        Ok(pose) if pose[3..].iter().any(|angle| angle.abs() > std::f64::consts::TAU) => bail!(
            "--palm-pose: roll, pitch and yaw are {:?}: expected radians, each at most 6.2832; 90 degrees are 1.5708",
            &pose[3..]
        ),
        Ok(pose) if arguments.palm.is_some() => Ok(Some(pose)),
        Ok(_) => bail!("--palm-pose needs --palm: the link in which it is given"),
        Err(_) if pose.is_empty() => Ok(None),
        Err(_) => bail!("--palm-pose: expected X,Y,Z,ROLL,PITCH,YAW, found {} numbers", pose.len()),
    }
}

fn print_parts(hand: &Hand) -> anyhow::Result<()> {
    print_line("joint            kind        from      to        open      closes to")?;
    for joint in &hand.joints {
        let kind = format!("{:?}", joint.kind).to_lowercase();
        let closed =
            if joint.is_preshape { "-".into() } else { format!("{:.4} {}", joint.closed(), joint.kind.unit()) };
        let (lower, upper, open) = (joint.lower, joint.upper, joint.open());
        print_line(&format!("{:<16} {kind:<9} {lower:>8.4}  {upper:>8.4}  {open:>8.4}   {closed}", joint.name))?;
    }
    print_text("\nlink             collision shapes")?;
    for link in &hand.links {
        print_line(&format!("{:<16} {}", link.name, link.shapes.len()))?;
    }
    for fixed in &hand.fixed_joints {
        print_diagnostic(fixed);
    }
    for ignored in &hand.ignored_shapes {
        print_diagnostic(&format!("a collision shape is left out: {ignored}"));
    }
    if hand.links.iter().all(|link| link.shapes.is_empty()) {
        print_diagnostic(
            "no link has a collision shape, with which fingers touch objects in simulation: give each link that touches objects a \
             <collision> in the URDF (mostly with the <geometry> of its <visual>), then call this command again",
        );
    }
    Ok(())
}

/// The columns that a table of cells must have.
const CELL_COLUMNS: [&str; 7] = ["link", "x", "y", "z", "nx", "ny", "nz"];

/// Cells of the table, pad by pad; their sizes are NaN if it has none.
fn read_table(path: &Path, threshold_newtons: f64) -> anyhow::Result<Vec<NewPad>> {
    let text = read_regular(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(text.as_bytes());
    let header = reader.headers().with_context(|| path.display().to_string())?;
    if let Some(missing) = CELL_COLUMNS.iter().find(|column| !header.iter().any(|found| found == **column)) {
        bail!(
            "{}: line 1: the column '{missing}' is missing: expected {}, found {}",
            path.display(),
            CELL_COLUMNS.join(", "),
            header.iter().take(12).collect::<Vec<_>>().join(", ")
        );
    }
    let mut pads: Vec<NewPad> = Vec::new();
    let mut is_sized = true;
    for row in reader.deserialize() {
        let row: Row = row.with_context(|| format!("{}", path.display()))?;
        let normal = Unit::try_new(Vector3::new(row.nx, row.ny, row.nz), 1e-6)
            .with_context(|| format!("{}: a normal without a direction on link '{}'", path.display(), row.link))?;
        let along = match (row.ax, row.ay, row.az) {
            (Some(x), Some(y), Some(z)) => Vector3::new(x, y, z),
            // Of the frame's axes the one that is nearest to the cell's plane; z, x, y where they are alike.
            _ => [Vector3::z(), Vector3::x(), Vector3::y()]
                .into_iter()
                .min_by(|a, b| normal.dot(a).abs().total_cmp(&normal.dot(b).abs()))
                .unwrap_or_else(Vector3::z),
        };
        let along_in_link = Unit::try_new(along - normal.into_inner() * normal.dot(&along), 1e-6)
            .with_context(|| format!("{}: ax, ay, az run along the normal on link '{}'", path.display(), row.link))?;
        is_sized &= row.width.is_some() && row.height.is_some();
        let cell = Cell {
            position_in_link_m: [row.x, row.y, row.z].into(),
            normal_in_link: normal,
            along_in_link,
            size_m: [row.width.unwrap_or(0.0), row.height.unwrap_or(0.0)],
            noise_threshold_newtons: row.threshold.unwrap_or(threshold_newtons),
        };
        let name = row.pad.unwrap_or_else(|| row.link.clone());
        match pads.iter_mut().find(|pad| pad.name == name) {
            Some(pad) if pad.link != row.link => {
                bail!("{}: pad '{name}' has cells on the links '{}' and '{}'", path.display(), pad.link, row.link)
            }
            Some(pad) => pad.cells.push(cell),
            None => pads.push(NewPad { name, link: row.link, cells: vec![cell] }),
        }
    }
    if !is_sized {
        pads.iter_mut().flat_map(|pad| &mut pad.cells).for_each(|cell| cell.size_m = [f64::NAN; 2]);
    }
    Ok(pads)
}

/// Gives sizes to the cells of a table that has none, by the nearest cell on the same link.
fn size_by_neighbours(pads: &mut [NewPad]) -> anyhow::Result<()> {
    let mut places: Vec<(String, Point3<f64>)> = Vec::new();
    for pad in &*pads {
        places.extend(pad.cells.iter().map(|cell| (pad.link.clone(), cell.position_in_link_m)));
    }
    let mut idx = 0;
    let mut is_sized = true;
    for pad in pads {
        for cell in &mut pad.cells {
            let others = places.iter().enumerate().filter(|(other, (link, _))| *other != idx && *link == pad.link);
            let nearest_m = others.map(|(_, (_, place))| (place - places[idx].1).norm()).fold(f64::INFINITY, f64::min);
            idx += 1;
            if !cell.size_m[0].is_nan() {
                continue;
            }
            is_sized = false;
            // A cell alone on its link has no neighbour.
            let size_m = if nearest_m.is_finite() { 0.8 * nearest_m } else { 0.005 };
            cell.size_m = [size_m; 2];
        }
    }
    if !is_sized {
        print_text(
            "\nno width and height in the table: a cell is 0.8 times as wide and high as the nearest one is away",
        )?;
    }
    Ok(())
}

/// The URDF with the names of collision meshes changed to files beside it, and the files to copy there.
fn with_meshes_beside(urdf: &str, urdf_folder: &Path) -> anyhow::Result<(String, Vec<(PathBuf, String)>)> {
    let mut copies: BTreeMap<PathBuf, String> = BTreeMap::new();
    let text = with_meshes_renamed(urdf, |named| {
        let Ok(file) = find_mesh_alike(named, urdf_folder) else { return Ok(None) };
        if !find_mesh(named, urdf_folder).is_ok_and(|named| named.is_file()) && !copies.contains_key(&file) {
            print_diagnostic(&format!("mesh {named} is not there: {} is taken, whose path ends alike", file.display()));
        }
        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or("mesh.stl").to_owned();
        let (n, taken) = (copies.len(), copies.values().any(|other| *other == format!("meshes/{name}")));
        let beside = copies
            .entry(file)
            .or_insert_with(|| if taken { format!("meshes/{n}-{name}") } else { format!("meshes/{name}") });
        Ok(Some(beside.clone()))
    });
    Ok((text.map_err(anyhow::Error::msg)?, copies.into_iter().collect()))
}

fn layout(name: &str, hand: &Hand, pads: &[NewPad], bare: &BareHand) -> String {
    // Quoted as in JSON, which YAML reads: a name such as 3.0 is no number.
    let quoted = |name: &str| serde_json::Value::from(name).to_string();
    let joints: Vec<String> = hand.joints.iter().map(|joint| quoted(&joint.name)).collect();
    let palm = quoted(bare.palm.as_ref().unwrap_or(&hand.links[0].name));
    let (name, urdf) = (quoted(name), quoted(&format!("{name}.urdf")));
    let mut text = format!(
        "# Made by: blindgrasp new hand. The keys are explained in hands/README.md of blindgrasp.\n\
         format: blindgrasp-hand/1\nname: {name}\nurdf: {urdf}\n\
         # Contacts are expressed in this link's frame; +z points out of the palm.\nreference_link: {palm}\n\
         joints: [{}]\n",
        joints.join(", ")
    );
    if !bare.preshape_joints.is_empty() {
        let preshape: Vec<String> = bare.preshape_joints.iter().map(|name| quoted(name)).collect();
        let _ = writeln!(text, "preshape_joints: [{}]", preshape.join(", "));
    }
    if !bare.open.is_empty() {
        let open: Vec<String> = bare.open.iter().map(|(name, value)| format!("{}: {value}", quoted(name))).collect();
        let _ = writeln!(text, "open: {{{}}}", open.join(", "));
    }
    text.push_str("pads:\n");
    for pad in pads {
        let threshold = pad.cells.first().map_or(0.0, |cell| cell.noise_threshold_newtons);
        let (name, link) = (quoted(&pad.name), quoted(&pad.link));
        let _ =
            writeln!(text, "  - {{name: {name}, link: {link}, layout: {name}, noise_threshold_newtons: {threshold}}}");
    }
    text.push_str("layouts:\n");
    for pad in pads {
        let _ = writeln!(text, "  {}:", quoted(&pad.name));
        let of_pad = pad.cells.first().map_or(0.0, |cell| cell.noise_threshold_newtons);
        for cell in &pad.cells {
            let own = cell.noise_threshold_newtons;
            let threshold = if own == of_pad { String::new() } else { format!(", noise_threshold_newtons: {own}") };
            let _ = writeln!(
                text,
                "    - {{at_m: {}, normal: {}, along: {}, size_m: {}{threshold}}}",
                numbers(cell.position_in_link_m.coords.as_slice(), 1e6),
                numbers(cell.normal_in_link.as_slice(), 1e9),
                numbers(cell.along_in_link.as_slice(), 1e9),
                numbers(&cell.size_m, 1e6),
            );
        }
    }
    text
}

/// A list in YAML, rounded to parts of `per_unit`.
fn numbers(values: &[f64], per_unit: f64) -> String {
    // Adding 0 makes a 0 of a -0.
    let rounded = values.iter().map(|value| ((value * per_unit).round() / per_unit + 0.0).to_string());
    format!("[{}]", rounded.collect::<Vec<_>>().join(", "))
}

fn grid(text: &str) -> Result<(String, [usize; 2]), String> {
    let parsed = text.rsplit_once('=').and_then(|(link, size)| {
        let (rows, columns) = size.split_once('x')?;
        Some((link.to_owned(), [rows.parse().ok()?, columns.parse().ok()?]))
    });
    parsed
        .filter(|(_, [rows, columns])| (1..=256).contains(rows) && (1..=256).contains(columns))
        .ok_or_else(|| "expected LINK=ROWSxCOLUMNS, as in left_finger=4x3, of 1 to 256 each".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_link_may_have_an_equals_sign() {
        assert_eq!(grid("finger=3=4x2"), Ok(("finger=3".into(), [4, 2])));
        assert!(grid("finger").is_err() && grid("finger=4").is_err() && grid("finger=0x2").is_err());
    }
}
