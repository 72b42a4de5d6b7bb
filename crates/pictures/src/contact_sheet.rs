//! A contact sheet: many objects in one picture, class by class.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::PictureError;
use super::png_image::{data_uri, encode_shades};
use super::raster::{Camera, SAMPLES_PER_SIDE, Samples};
use super::svg::{Anchor, Svg, fit_text, px, text_width};
use blindgrasp_objects::mesh::Mesh;

/// An object on the sheet.
#[derive(Debug, Clone)]
pub struct SheetObject {
    /// Its name, e.g. `mug-07`.
    pub name: String,
    /// Its class; a class's objects are together and in one scale.
    pub class: String,
    /// Never used for training: marked.
    pub held_out: bool,
    /// Its surface, upright along +z.
    pub mesh: Mesh,
}

/// How the objects are laid out.
struct Layout {
    n_columns: usize,
    /// An object's square, pixels.
    cell: f64,
    /// Below a square, for the name.
    caption: f64,
    /// Left of the squares, for the class.
    label: f64,
    font_size: f64,
}

const MARGIN: f64 = 40.0;
const HEAD: f64 = 96.0;
/// Pixels of the rendered images a pixel of the sheet: one class is meant to be looked at closely.
const IMAGE_SCALES: [f64; 2] = [1.0, 1.6];

const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#1f2933}\
.title{font-size:34px;font-weight:650}.sub{font-size:18px;fill:#52606d}.class{font-weight:650}.note{fill:#52606d}\
.held-out{fill:#a8480b}.rule{stroke:#e1e5ea;stroke-width:1}.axis{stroke:#52606d;stroke-width:1.6;fill:none}";

/// All objects in one picture (SVG): each class in one scale of its own, with a bar that says which; grouped by class
/// in the order in which the classes first appear.
///
/// # Errors
/// No objects.
pub fn contact_sheet(title: &str, objects: &[SheetObject]) -> Result<String, PictureError> {
    let mut classes: Vec<(&str, Vec<&SheetObject>)> = Vec::new();
    let mut place_of: BTreeMap<&str, usize> = BTreeMap::new();
    for object in objects {
        let place = *place_of.entry(&object.class).or_insert(classes.len());
        if place == classes.len() {
            classes.push((&object.class, Vec::new()));
        }
        classes[place].1.push(object);
    }
    let layout = match (classes.as_slice(), classes.iter().map(|(_, objects)| objects.len()).max()) {
        ([], _) | (_, None) => return Err(PictureError::NoObjects),
        ([_], Some(most)) => {
            Layout { n_columns: most.min(6), cell: 220.0, caption: 30.0, label: 170.0, font_size: 16.0 }
        }
        (_, Some(most)) => Layout { n_columns: most.min(30), cell: 88.0, caption: 18.0, label: 170.0, font_size: 12.0 },
    };
    let image_scale = IMAGE_SCALES[usize::from(classes.len() == 1)];
    let width = 2.0 * MARGIN + layout.label + layout.n_columns as f64 * layout.cell;
    // A sheet of few columns still has room for its title.
    let width = width.max(900.0);
    let mut svg = Svg::default();
    svg.text([MARGIN, 58.0], Anchor::Start, "title", &fit_text(title, 34.0, width - 2.0 * MARGIN));
    let n_held_out = objects.iter().filter(|object| object.held_out).count();
    let n_classes = classes.len();
    let about = format!("{} objects, {n_classes} classes, each class in its own scale", objects.len());
    let about = about.replace("1 objects", "1 object").replace(" 1 classes, each class in its own scale", " 1 class");
    let held_out = if n_held_out > 0 { format!("; {n_held_out} held out (•)") } else { String::new() };
    svg.text([MARGIN, 86.0], Anchor::Start, "sub", &(about + &held_out));
    let mut y = HEAD + 14.0;
    for (class, objects) in classes {
        y = draw_class(&mut svg, class, &objects, &layout, image_scale, y, width)?;
    }
    Ok(svg.finish(width, y + MARGIN - 20.0, title, STYLE))
}

/// A class's block; returns where it ends.
fn draw_class(
    svg: &mut Svg,
    class: &str,
    objects: &[&SheetObject],
    layout: &Layout,
    image_scale: f64,
    top: f64,
    width: f64,
) -> Result<f64, PictureError> {
    let (cell, row_height) = (layout.cell, layout.cell + layout.caption);
    svg.element(
        "line",
        &[("x1", &MARGIN), ("x2", &px(width - MARGIN)), ("y1", &px(top)), ("y2", &px(top)), ("class", &"rule")],
    );
    let pixels_per_m = scale_of(objects, cell);
    let class_text = fit_text(class, 20.0, layout.label - 16.0);
    svg.text_with([MARGIN, top + 34.0], Anchor::Start, "class", &class_text, &[("font-size", &20)]);
    let n_text = if objects.len() == 1 { "1 object".into() } else { format!("{} objects", objects.len()) };
    svg.text_with([MARGIN, top + 54.0], Anchor::Start, "note", &n_text, &[("font-size", &14)]);
    // The longest bar that fits beside the class.
    let bar_mm = [200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0]
        .into_iter()
        .find(|mm| mm / 1000.0 * pixels_per_m <= 0.6 * layout.label)
        .unwrap_or(1.0);
    let bar = bar_mm / 1000.0 * pixels_per_m;
    let line = format!("M{} {}v5h{}v-5", px(MARGIN), px(top + 66.0), px(bar));
    svg.element("path", &[("d", &line), ("class", &"axis")]);
    let at = [MARGIN + bar + 8.0, top + 74.0];
    svg.text_with(at, Anchor::Start, "note", &format!("{bar_mm} mm"), &[("font-size", &12)]);
    let n_rows = objects.len().div_ceil(layout.n_columns);
    for row in 0..n_rows {
        let of_row = &objects[row * layout.n_columns..objects.len().min((row + 1) * layout.n_columns)];
        let (left, row_top) = (MARGIN + layout.label, top + 6.0 + row as f64 * row_height);
        let png = render_row(of_row, pixels_per_m, cell, image_scale)?;
        svg.element(
            "image",
            &[
                ("x", &px(left)),
                ("y", &px(row_top)),
                ("width", &px(cell * of_row.len() as f64)),
                ("height", &px(cell)),
                ("href", &data_uri(&png)),
            ],
        );
        for (idx, object) in of_row.iter().enumerate() {
            let text = name_in_class(object, layout.font_size, cell - 4.0);
            let at = [left + (idx as f64 + 0.5) * cell, row_top + cell + layout.font_size];
            let class = if object.held_out { "held-out" } else { "note" };
            svg.text_with(at, Anchor::Middle, class, &text, &[("font-size", &layout.font_size)]);
        }
    }
    Ok(top + 6.0 + (n_rows as f64 * row_height).max(90.0) + 10.0)
}

/// The object's name with the mark of what is held out; where there is no room, without the class before it.
fn name_in_class(object: &SheetObject, font_size: f64, width: f64) -> String {
    let marked = |name: &str| format!("{name}{}", if object.held_out { " •" } else { "" });
    let whole = marked(&object.name);
    let in_class = object.name.strip_prefix(&object.class).and_then(|rest| rest.strip_prefix('-'));
    match in_class {
        Some(rest) if text_width(&whole, font_size) > width => fit_text(&marked(rest), font_size, width),
        _ => fit_text(&whole, font_size, width),
    }
}

/// From the front, a little to the side and from above.
fn camera(mesh: &Mesh, size: f64) -> Camera {
    let [least, most] = mesh.bounds();
    let to_eye = Vector3::new(0.55, -1.0, 0.62);
    Camera::new(Point3::origin(), to_eye, Vector3::z(), [size, size]).fit(&corners(least, most), 0.06 * size)
}

/// The scale in which the largest object of a class just fits.
fn scale_of(objects: &[&SheetObject], size: f64) -> f64 {
    objects.iter().map(|object| camera(&object.mesh, size).pixels_per_m()).fold(f64::MAX, f64::min)
}

fn corners(least: Point3<f64>, most: Point3<f64>) -> Vec<Point3<f64>> {
    (0..8)
        .map(|idx| {
            Point3::from(std::array::from_fn(|axis| if idx >> axis & 1 == 0 { least[axis] } else { most[axis] }))
        })
        .collect()
}

/// A row of objects side by side, as a PNG.
fn render_row(
    objects: &[&SheetObject],
    pixels_per_m: f64,
    cell: f64,
    image_scale: f64,
) -> Result<Vec<u8>, PictureError> {
    let size = (cell * image_scale).round() as usize;
    let images: Vec<Vec<u8>> =
        objects.par_iter().map(|object| render(&object.mesh, pixels_per_m, cell, size)).collect();
    let rows = (0..size).flat_map(|y| images.iter().map(move |image| &image[y * size..(y + 1) * size]));
    encode_shades(size * objects.len(), size, &rows.flatten().copied().collect::<Vec<u8>>())
}

fn render(mesh: &Mesh, pixels_per_m: f64, cell: f64, size: usize) -> Vec<u8> {
    let n = size * SAMPLES_PER_SIDE;
    let mut samples = Samples::new(n, n);
    let camera = camera(mesh, cell).with_pixels_per_m(pixels_per_m).scaled(n as f64 / cell);
    samples.draw_mesh(&camera, mesh, 1);
    // The palette's middle is the object's own colour, its end the white of the card.
    let shade = |x: usize, y: usize| {
        let idx = y * n + x;
        match samples.surface[idx] {
            0 => 1.0,
            _ if samples.is_edge(x, y, 2) => 0.2,
            _ => (f64::from(samples.light[idx]) / 1.8 - 0.06).clamp(0.0, 0.85),
        }
    };
    let n_samples = (SAMPLES_PER_SIDE * SAMPLES_PER_SIDE) as f64;
    let mut pixels = Vec::with_capacity(size * size);
    for y in 0..size {
        for x in 0..size {
            let of_pixel = (0..SAMPLES_PER_SIDE * SAMPLES_PER_SIDE).map(|idx| {
                shade(x * SAMPLES_PER_SIDE + idx % SAMPLES_PER_SIDE, y * SAMPLES_PER_SIDE + idx / SAMPLES_PER_SIDE)
            });
            // 64 shades look like 256 here, and compress to a third less.
            pixels.push((63.0 * of_pixel.sum::<f64>() / n_samples).round() as u8);
        }
    }
    pixels
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_objects::mesh::shape::mesh_of_shape;
    use parry3d_f64::shape::SharedShape;

    fn object(name: &str, class: &str, half_m: f64, held_out: bool) -> SheetObject {
        let mesh = mesh_of_shape(&SharedShape::cuboid(half_m, half_m, 2.0 * half_m));
        SheetObject { name: name.into(), class: class.into(), held_out, mesh }
    }

    #[test]
    fn a_class_has_one_scale_and_every_object_its_name() {
        let objects =
            [object("a-0", "a", 0.01, false), object("b-0", "b", 0.05, false), object("a-1", "a", 0.02, true)];
        let sheet = contact_sheet("Things", &objects).expect("a sheet");
        for expected in
            ["Things", "3 objects, 2 classes", "1 held out", ">a-0<", ">a-1 •<", ">b-0<", ">100 mm<", ">200 mm<"]
        {
            assert!(sheet.contains(expected), "{expected}");
        }
        assert_eq!(sheet.matches("<image").count(), 2, "a row for each class");
        assert_eq!(sheet, contact_sheet("Things", &objects).expect("a sheet"), "the same bytes again");
        assert!(matches!(contact_sheet("Nothing", &[]), Err(PictureError::NoObjects)));
        let long = object("glasses_case-07", "glasses_case", 0.02, true);
        assert_eq!(name_in_class(&long, 12.0, 84.0), "07 •");
        assert_eq!(name_in_class(&long, 12.0, 200.0), "glasses_case-07 •");
        // Twice as large, drawn twice as large.
        let both: Vec<&SheetObject> = vec![&objects[0], &objects[2]];
        let scale = scale_of(&both, 88.0);
        let dark = |object: &SheetObject| {
            render(&object.mesh, scale, 88.0, 88).iter().filter(|shade| **shade < 60).count() as f64
        };
        assert!(
            (dark(&objects[2]) / dark(&objects[0]) - 4.0).abs() < 0.4,
            "{} {}",
            dark(&objects[2]),
            dark(&objects[0])
        );
    }
}
