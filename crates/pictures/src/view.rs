//! One view of a grasp: the rendered hand and object, and over them, as vectors, the contacts.

use nalgebra::{Point3, Vector3};

use super::PictureError;
use super::colour::{HAND, OBJECT, Rgb, SILENT_CELL, force_colour, lit};
use super::geometry::{cells_in_link, link_mesh, quad_mesh};
use super::grasp::{ContactKind, ContactMark, Placed};
use super::png_image::{Image, data_uri};
use super::raster::{Camera, SAMPLES_PER_SIDE, Samples};
use super::svg::{Anchor, Svg, px};
use blindgrasp_mesh::Mesh;
use blindgrasp_stages::hand::{Hand, Motion};

/// Pixels of the rendered image a pixel of the picture: sharp on fine screens.
const IMAGE_SCALE: f64 = 1.6;
/// How much of what is behind the object it hides.
const OBJECT_OPACITY: f64 = 0.62;
/// Room around the scene.
const MARGIN: f64 = 26.0;
/// This part of the view's height fades out at the lower edge.
const FADE: f64 = 0.09;
/// The largest force's arrow.
const LONGEST_ARROW_M: f64 = 0.032;
/// Even the smallest force's arrow can be seen.
const SHORTEST_ARROW_M: f64 = 0.010;
/// Radius of a contact's number.
const LABEL_RADIUS: f64 = 8.5;

/// The scene as surfaces in the palm frame, made once for all views.
pub(super) struct Surfaces {
    links: Vec<Mesh>,
    cells: Vec<(Mesh, Rgb)>,
    object: Option<Mesh>,
}

impl Surfaces {
    pub(super) fn new(placed: &Placed<'_>) -> Self {
        let hand = placed.hand;
        let links = hand
            .links
            .iter()
            .zip(&placed.palm_from_links)
            .map(|(link, palm_from_link)| {
                let mut mesh = link_mesh(link);
                mesh.transform(palm_from_link);
                mesh
            })
            .collect();
        let cells = hand
            .cells()
            .zip(cells_in_link(hand))
            .enumerate()
            .map(|(idx, ((pad_idx, cell), corners))| {
                let palm_from_link = &placed.palm_from_links[hand.pads[pad_idx].link_idx];
                let active = placed.active_newtons(idx, cell.noise_threshold_newtons);
                let colour = active.map_or(SILENT_CELL, |newtons| force_colour(newtons / placed.scale_newtons));
                (quad_mesh(corners.map(|corner| palm_from_link * corner)), colour)
            })
            .collect();
        Surfaces { links, cells, object: placed.object_in_palm.clone() }
    }

    /// What must be in the picture: the object, the cells and whatever moves. A hand's body may be cut off.
    pub(super) fn points(&self, hand: &Hand) -> Vec<Point3<f64>> {
        let mut moves: Vec<bool> = Vec::with_capacity(hand.links.len());
        for link in &hand.links {
            let parent_moves = link.parent_idx.is_some_and(|idx| moves[idx]);
            moves.push(parent_moves || matches!(link.motion, Motion::Joint { .. }));
        }
        let moving = self.links.iter().zip(moves).filter_map(|(mesh, moves)| moves.then_some(mesh));
        let all = moving.chain(self.cells.iter().map(|(mesh, _)| mesh)).chain(&self.object);
        all.flat_map(|mesh| mesh.vertices_m.iter().copied()).collect()
    }

    fn hand_samples(&self, camera: &Camera, width: usize, height: usize) -> Samples {
        let mut samples = Samples::new(width, height);
        for (idx, link) in self.links.iter().enumerate() {
            samples.draw_mesh(camera, link, (idx + 1) as u16);
        }
        for (idx, (cell, _)) in self.cells.iter().enumerate() {
            samples.draw_mesh(camera, cell, (self.links.len() + idx + 1) as u16);
        }
        samples
    }

    fn colour(&self, surface: u16) -> Rgb {
        let idx = usize::from(surface) - 1;
        if idx < self.links.len() { HAND } else { self.cells[idx - self.links.len()].1 }
    }
}

/// Two cameras that see the grasp well: of directions all around, a little from above, the one that sees most contacts
/// and sees their arrows from the side; then the best of those at about right angles to it.
pub(super) fn choose_cameras(placed: &Placed<'_>, surfaces: &Surfaces, size: [f64; 2]) -> [Camera; 2] {
    const N_AROUND: u32 = 24;
    /// Above the horizon: low enough to see fingers from the side, high enough to see into the hand.
    const ELEVATIONS_RAD: [f64; 2] = [0.30, 0.60];
    let points = surfaces.points(placed.hand);
    let interesting: Vec<(Point3<f64>, Vector3<f64>)> = if placed.contacts.is_empty() {
        active_cells(placed).into_iter().map(|(point, normal, _)| (point, normal)).collect()
    } else {
        placed.contacts.iter().map(|contact| (contact.point_in_palm_m, contact.inward_normal_in_palm)).collect()
    };
    let mut found: Vec<(f64, f64, Camera)> = Vec::new();
    for (elevation, around) in ELEVATIONS_RAD.into_iter().flat_map(|rad| (0..N_AROUND).map(move |idx| (rad, idx))) {
        let azimuth = std::f64::consts::TAU * (f64::from(around) + 0.5) / f64::from(N_AROUND);
        let to_eye = Vector3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
        let camera = Camera::new(Point3::origin(), to_eye, Vector3::z(), size).fit(&points, MARGIN);
        // A small picture tells what hides what.
        let small = camera.scaled(0.25);
        let (width, height) = ((size[0] * 0.25) as usize, (size[1] * 0.25) as usize);
        let hand = surfaces.hand_samples(&small, width, height);
        let score: f64 = interesting
            .iter()
            .map(|(point, normal)| {
                // Half a centimetre inside the object: the point itself lies on the link's surface.
                let seen = small.project(&(point + normal * 0.005));
                let (x, y) = (seen.x.clamp(0.0, width as f64 - 1.0), seen.y.clamp(0.0, height as f64 - 1.0));
                let is_hidden = f64::from(hand.nearness[y as usize * width + x as usize]) > seen.nearness;
                let sideways = camera.direction(normal).xy().norm();
                if is_hidden { 0.25 * sideways } else { 0.5 + sideways }
            })
            .sum();
        found.push((score + 1e-3 * camera.pixels_per_m() / 1000.0, azimuth, camera));
    }
    let best = |among: &dyn Fn(f64) -> bool| {
        let candidates = found.iter().filter(|(_, azimuth, _)| among(*azimuth));
        // The first of equals: max_by would take the last.
        candidates.reduce(|best, other| if other.0 > best.0 + 1e-9 { other } else { best })
    };
    let angle = |a: f64, b: f64| (a - b).sin().atan2((a - b).cos()).abs();
    let first = best(&|_| true).unwrap_or(&found[0]);
    let second = best(&|azimuth| (1.2..=2.0).contains(&angle(azimuth, first.1))).unwrap_or(first);
    [first.2.clone(), second.2.clone()]
}

/// Active cells: centre and normal in the palm frame, newtons.
fn active_cells(placed: &Placed<'_>) -> Vec<(Point3<f64>, Vector3<f64>, f64)> {
    let hand = placed.hand;
    hand.cells()
        .enumerate()
        .filter_map(|(idx, (pad_idx, cell))| {
            let newtons = placed.active_newtons(idx, cell.noise_threshold_newtons)?;
            let palm_from_link = &placed.palm_from_links[hand.pads[pad_idx].link_idx];
            let normal = palm_from_link.rotation * cell.normal_in_link.into_inner();
            Some((palm_from_link * cell.position_in_link_m, normal, newtons))
        })
        .collect()
}

/// Draws a view with its upper left corner at `[left, top]`.
pub(super) fn draw_view(
    svg: &mut Svg,
    placed: &Placed<'_>,
    surfaces: &Surfaces,
    camera: &Camera,
    [left, top]: [f64; 2],
    [width, height]: [f64; 2],
) -> Result<(), PictureError> {
    let image = render(surfaces, camera, [width, height], IMAGE_SCALE);
    let transform = format!("translate({} {})", px(left), px(top));
    svg.start("g", &[("transform", &transform)]);
    let href = data_uri(&image.to_png()?);
    svg.element("image", &[("width", &px(width)), ("height", &px(height)), ("href", &href)]);
    if placed.contacts.is_empty() {
        draw_cell_forces(svg, placed, camera);
    } else {
        draw_contacts(svg, &placed.contacts, camera, [width, height]);
    }
    draw_axes(svg, camera, [34.0, height - 30.0]);
    draw_scale_bar(svg, camera, [width - 14.0, height - 12.0]);
    svg.end("g");
    Ok(())
}

/// Draws the surfaces, in an image that is small as a file, and a line from each active cell.
pub(super) fn draw_small_view(
    svg: &mut Svg,
    placed: &Placed<'_>,
    surfaces: &Surfaces,
    camera: &Camera,
    [left, top]: [f64; 2],
    [width, height]: [f64; 2],
) -> Result<(), PictureError> {
    let href = data_uri(&render(surfaces, camera, [width, height], 1.0).to_small_png()?);
    svg.start("g", &[("transform", &format!("translate({} {})", px(left), px(top)))]);
    svg.element("image", &[("width", &px(width)), ("height", &px(height)), ("href", &href)]);
    draw_cell_forces(svg, placed, camera);
    svg.end("g");
    Ok(())
}

/// With `scale` pixels to a pixel of the picture.
fn render(surfaces: &Surfaces, camera: &Camera, [width, height]: [f64; 2], scale: f64) -> Image {
    let (width, height) = ((width * scale).round() as usize, (height * scale).round() as usize);
    let camera = camera.scaled(scale * SAMPLES_PER_SIDE as f64);
    let (n_x, n_y) = (width * SAMPLES_PER_SIDE, height * SAMPLES_PER_SIDE);
    let hand = surfaces.hand_samples(&camera, n_x, n_y);
    let mut object = Samples::new(n_x, n_y);
    if let Some(mesh) = &surfaces.object {
        object.draw_mesh(&camera, mesh, 1);
    }
    Image::from_samples(width, height, SAMPLES_PER_SIDE, |x, y| {
        let idx = y * n_x + x;
        let surface = hand.surface[idx];
        let (mut colour, mut opacity) = ([1.0; 3], 0.0);
        if surface != 0 {
            let edge = if hand.is_edge(x, y, 2) { 0.55 } else { 1.0 };
            colour = lit(surfaces.colour(surface), f64::from(hand.light[idx])).map(|channel| channel * edge);
            // What the lower edge cuts off fades out.
            opacity = ((n_y - y) as f64 / (FADE * n_y as f64)).min(1.0);
        }
        if object.surface[idx] != 0 {
            let is_in_front = object.nearness[idx] > hand.nearness[idx];
            let is_edge = object.is_edge(x, y, 3);
            // Where the hand hides the object, its outline still shows.
            let part = match (is_in_front, is_edge) {
                (true, false) => OBJECT_OPACITY,
                (true, true) => 0.95,
                (false, true) => 0.45,
                (false, false) => 0.0,
            };
            let light = f64::from(object.light[idx]) * if is_edge { 0.6 } else { 1.0 };
            let of_object = lit(OBJECT, light);
            colour = std::array::from_fn(|channel| {
                (part * of_object[channel] + (1.0 - part) * opacity * colour[channel])
                    / (part + (1.0 - part) * opacity).max(1e-9)
            });
            opacity = part + (1.0 - part) * opacity;
        }
        (colour, opacity)
    })
}

/// Every contact: an arrow from its point into what is touched, as long as its force, and its number.
fn draw_contacts(svg: &mut Svg, contacts: &[ContactMark], camera: &Camera, size: [f64; 2]) {
    let largest = contacts.iter().map(|contact| contact.force_newtons).fold(1e-9, f64::max);
    let dots: Vec<[f64; 2]> = contacts
        .iter()
        .map(|contact| {
            let seen = camera.project(&contact.point_in_palm_m);
            [seen.x, seen.y]
        })
        .collect();
    let mut labels: Vec<[f64; 2]> = Vec::new();
    for (idx, contact) in contacts.iter().enumerate() {
        let share = (contact.force_newtons / largest).clamp(0.0, 1.0);
        let length_m = (LONGEST_ARROW_M * share).max(SHORTEST_ARROW_M);
        let tip = camera.project(&(contact.point_in_palm_m + contact.inward_normal_in_palm * length_m));
        let dot = dots[idx];
        draw_arrow(svg, contact.kind, dot, [tip.x, tip.y], idx + 1);
        labels.push(place_label(dot, [tip.x, tip.y], &dots, &labels, size));
    }
    for (idx, (contact, at)) in contacts.iter().zip(&labels).enumerate() {
        let dot = dots[idx];
        let distance = (at[0] - dot[0]).hypot(at[1] - dot[1]);
        if distance > LABEL_RADIUS + 8.0 {
            let towards = |axis: usize| at[axis] + (dot[axis] - at[axis]) * LABEL_RADIUS / distance;
            let class = format!("leader {}", contact.kind.word());
            svg.element(
                "line",
                &[
                    ("x1", &px(towards(0))),
                    ("y1", &px(towards(1))),
                    ("x2", &px(dot[0])),
                    ("y2", &px(dot[1])),
                    ("class", &class),
                ],
            );
        }
    }
    for (idx, (contact, at)) in contacts.iter().zip(&labels).enumerate() {
        draw_number(svg, contact.kind, *at, idx + 1);
    }
}

/// A contact's number in the shape and colour of its kind.
pub(super) fn draw_number(svg: &mut Svg, kind: ContactKind, at: [f64; 2], number: usize) {
    let class = format!("number {}", kind.word());
    svg.element("circle", &[("cx", &px(at[0])), ("cy", &px(at[1])), ("r", &LABEL_RADIUS), ("class", &class)]);
    let class = format!("digits {}", kind.word());
    svg.text([at[0], at[1] + 3.6], Anchor::Middle, &class, &number.to_string());
}

/// An arrow with a white seam, so that it stands out from whatever is behind it.
pub(super) fn draw_arrow(svg: &mut Svg, kind: ContactKind, from: [f64; 2], to: [f64; 2], number: usize) {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let length = dx.hypot(dy).max(1e-6);
    let (ux, uy) = (dx / length, dy / length);
    // Seen end on, an arrow has no room for its shaft.
    let head = 9.0_f64.min(length);
    let neck = [to[0] - ux * head * 0.8, to[1] - uy * head * 0.8];
    let wing = |side: f64| {
        let back = [to[0] - ux * head, to[1] - uy * head];
        format!("{} {}", px(back[0] - side * uy * head * 0.5), px(back[1] + side * ux * head * 0.5))
    };
    let class = format!("arrow {}", kind.word());
    svg.start("g", &[("class", &class), ("data-contact", &number)]);
    let shaft = format!("M{} {}L{} {}", px(from[0]), px(from[1]), px(neck[0]), px(neck[1]));
    let tip = format!("M{} {}L{}L{}Z", px(to[0]), px(to[1]), wing(1.0), wing(-1.0));
    svg.element("path", &[("d", &shaft), ("class", &"seam")]);
    svg.element("path", &[("d", &tip), ("class", &"seam")]);
    svg.element("path", &[("d", &shaft), ("class", &"shaft")]);
    svg.element("path", &[("d", &tip), ("class", &"head")]);
    svg.element("circle", &[("cx", &px(from[0])), ("cy", &px(from[1])), ("r", &3.2), ("class", &"dot")]);
    svg.end("g");
}

/// Near the point, rather behind the arrow, where no other point or number is.
fn place_label(dot: [f64; 2], tip: [f64; 2], dots: &[[f64; 2]], labels: &[[f64; 2]], size: [f64; 2]) -> [f64; 2] {
    let backwards = (dot[1] - tip[1]).atan2(dot[0] - tip[0]);
    let cost = |at: [f64; 2], turn: f64, radius: f64| {
        let overlap = |other: &[f64; 2], apart: f64| (apart - (at[0] - other[0]).hypot(at[1] - other[1])).max(0.0);
        let on_labels: f64 = labels.iter().map(|label| overlap(label, 2.0 * LABEL_RADIUS + 2.0)).sum();
        let on_dots: f64 = dots.iter().map(|dot| overlap(dot, LABEL_RADIUS + 5.0)).sum();
        let outside = (0..2)
            .map(|axis| (LABEL_RADIUS + 2.0 - at[axis]).max(at[axis] + LABEL_RADIUS + 2.0 - size[axis]).max(0.0))
            .sum::<f64>();
        10.0 * on_labels + 6.0 * on_dots + 20.0 * outside + 0.8 * turn.abs() + 0.15 * radius
    };
    let mut best = (f64::MAX, dot);
    for radius in [16.0, 24.0, 34.0, 46.0] {
        for step in 0..16 {
            // 0, then to either side by turns.
            let turn =
                std::f64::consts::TAU / 16.0 * f64::from((step + 1) / 2) * if step % 2 == 0 { 1.0 } else { -1.0 };
            let at = [dot[0] + radius * (backwards + turn).cos(), dot[1] + radius * (backwards + turn).sin()];
            let found = cost(at, turn, radius);
            if found < best.0 - 1e-9 {
                best = (found, at);
            }
        }
    }
    best.1
}

/// Without a scene: what each active cell pushes, along its normal.
fn draw_cell_forces(svg: &mut Svg, placed: &Placed<'_>, camera: &Camera) {
    let cells = active_cells(placed);
    for (point, normal, newtons) in cells {
        let length_m = LONGEST_ARROW_M * newtons / placed.scale_newtons;
        let (from, to) = (camera.project(&point), camera.project(&(point + normal * length_m)));
        let line = format!("M{} {}L{} {}", px(from.x), px(from.y), px(to.x), px(to.y));
        svg.element("path", &[("d", &line), ("class", &"cell-arrow")]);
        svg.element("circle", &[("cx", &px(to.x)), ("cy", &px(to.y)), ("r", &1.8), ("class", &"cell-tip")]);
    }
}

/// The palm frame's axes.
fn draw_axes(svg: &mut Svg, camera: &Camera, [x, y]: [f64; 2]) {
    svg.element("circle", &[("cx", &px(x)), ("cy", &px(y)), ("r", &33), ("fill", &"#ffffff"), ("fill-opacity", &0.75)]);
    for (name, axis) in [("x", Vector3::x()), ("y", Vector3::y()), ("z", Vector3::z())] {
        let seen = camera.direction(&axis);
        let end = [x + 20.0 * seen.x, y - 20.0 * seen.y];
        let line = format!("M{} {}L{} {}", px(x), px(y), px(end[0]), px(end[1]));
        svg.element("path", &[("d", &line), ("class", &"axis")]);
        let at = [x + 28.0 * seen.x, y - 28.0 * seen.y + 3.5];
        if seen.xy().norm() > 0.3 {
            svg.text(at, Anchor::Middle, "tiny", name);
        }
    }
}

/// A bar of 50 mm at the depth of the grasp's middle.
fn draw_scale_bar(svg: &mut Svg, camera: &Camera, [right, y]: [f64; 2]) {
    let length = 0.05 * camera.pixels_per_m();
    let line = format!("M{} {}v5h{}v-5", px(right - length), px(y - 5.0), px(length));
    svg.element("path", &[("d", &line), ("class", &"axis")]);
    svg.text([right - length / 2.0, y - 7.0], Anchor::Middle, "tiny", "50 mm");
}
