//! The picture of a grasp as a page: the same sheet, the grasp to turn by hand, its frames in time, its contacts.

use std::fmt::Write;

use serde::Serialize;

use super::PictureError;
use super::colour::{Rgb, force_colour, lightness};
use super::grasp::{ContactKind, Placed, RecordedGrasp};
use super::grasp_picture::{VIEW, draw, page_title, style};
use super::pads::draw_pads;
use super::report::{json_for_page, stage_modules};
use super::scene::{HandScene, N_COLOURS, ObjectScene, link_poses, point, rounded};
use super::svg::{Svg, escape};
use super::view::{Surfaces, choose_cameras};
use blindgrasp_stages::hand::Hand;

const SCRIPT: &str = include_str!("../assets/sheet.js");
const STYLE: &str = include_str!("../assets/sheet.css");
/// More frames than this are thinned out evenly: a robot's recording may hold minutes.
const MOST_FRAMES: usize = 150;

/// The page's script draws from this. Lengths in metres, to hundredths of a millimetre.
#[derive(Serialize)]
struct Data<'a> {
    #[serde(flatten)]
    scene: HandScene,
    object: Option<ObjectScene>,
    contacts: Vec<ContactData<'a>>,
    /// The forces only show the cells' normals: they are not written.
    is_hand_alone: bool,
    frames: Vec<FrameData<'a>>,
    /// The frame that the picture shows.
    shown: usize,
    /// The side from which it is looked at first.
    azimuth_rad: f64,
    scale_newtons: f64,
    /// From this colour on, writing on it is white.
    first_dark_colour: usize,
}

#[derive(Serialize)]
struct ContactData<'a> {
    kind: &'a str,
    point_m: [f64; 3],
    inward_normal: [f64; 3],
    force_newtons: f64,
}

#[derive(Serialize)]
struct FrameData<'a> {
    since_start_ms: f64,
    phase: &'a str,
    links: Vec<Vec<f64>>,
    cells: Vec<Option<f64>>,
}

/// A grasp as an HTML page that needs nothing else.
///
/// # Errors
/// As [`grasp_svg`](super::grasp_svg).
pub fn grasp_html(hand: &Hand, grasp: &RecordedGrasp) -> Result<String, PictureError> {
    let placed = Placed::new(hand, grasp)?;
    let surfaces = Surfaces::new(&placed);
    let cameras = choose_cameras(&placed, &surfaces, VIEW);
    let picture = draw(&placed, &surfaces, &cameras)?;
    let mut drawn_pads = Svg::default();
    let height = draw_pads(&mut drawn_pads, &placed, [14.0, 14.0], 272.0, 400.0)?;
    let pads = drawn_pads.finish(300.0, height + 28.0, "Cells of the frame chosen", style());
    let data = json_for_page(&data(&placed, cameras[0].azimuth_rad())?)?;
    let title = escape(&page_title(&placed));
    Ok(format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n<figure tabindex=\"0\">\n{picture}</figure>\n\
         <section>\n<h2>3-D view</h2>\n<div class=\"scene\">\n\
         <div class=\"stage\"><canvas id=\"stage\" tabindex=\"0\" aria-label=\"the hand in three dimensions\"></canvas>\
         <div id=\"numbers\"></div><p id=\"without-webgl\" hidden>This browser has no WebGL: the 3-D view cannot be \
         shown.</p></div>\n<div id=\"pads\">{pads}</div>\n</div>\n\
         <div class=\"time\"><button id=\"play\" type=\"button\">Play</button>\
         <input id=\"frame\" type=\"range\" min=\"0\" step=\"1\" aria-label=\"frame\"><output id=\"when\"></output></div>\n\
         <p class=\"hint\">Drag or arrow keys: turn. Wheel, + and −: zoom. Double click: back.{}</p>\n\
         </section>\n{}</main>\n<script type=\"application/json\" id=\"grasp\">{}</script>\n\
         {}<script type=\"module\">\n{SCRIPT}</script>\n</body>\n</html>\n",
        if placed.object_in_palm.is_some() { " The object is shown where the grasp ends." } else { "" },
        contact_table(&placed),
        data,
        stage_modules(),
    ))
}

fn data<'a>(placed: &'a Placed<'_>, azimuth_rad: f64) -> Result<Data<'a>, PictureError> {
    let hand = placed.hand;
    let all = &placed.grasp.frames;
    let shown = all.iter().position(|frame| std::ptr::eq(&frame.message, placed.frame)).unwrap_or(0);
    let step = all.len().div_ceil(MOST_FRAMES).max(1);
    // Counted from the frame shown, so that it is never thinned out.
    let chosen: Vec<usize> = (0..all.len()).filter(|idx| idx % step == shown % step).collect();
    let start_nanos = all.first().map_or(0, |frame| frame.header.stamp_nanos);
    let frames = chosen
        .iter()
        .map(|idx| {
            let frame = &all[*idx];
            let links = link_poses(hand, &frame.message.joints)
                .map_err(|source| PictureError::Joints { grasp_id: placed.grasp.grasp_id, source })?;
            Ok(FrameData {
                since_start_ms: frame.header.stamp_nanos.saturating_sub(start_nanos) as f64 / 1e6,
                phase: frame.message.phase.as_str(),
                links,
                cells: frame
                    .message
                    .cells_newtons
                    .iter()
                    .map(|force| force.is_finite().then(|| rounded(*force)))
                    .collect(),
            })
        })
        .collect::<Result<_, PictureError>>()?;
    let mut scale = (0..N_COLOURS).map(|idx| force_colour(idx as f64 / (N_COLOURS - 1) as f64));
    Ok(Data {
        scene: HandScene::new(hand),
        object: placed.object_in_palm.as_ref().map(ObjectScene::placed),
        contacts: placed
            .contacts
            .iter()
            .map(|contact| ContactData {
                kind: contact.kind.word(),
                point_m: point(&contact.point_in_palm_m),
                inward_normal: contact.inward_normal_in_palm.map(rounded).into(),
                force_newtons: rounded(contact.force_newtons),
            })
            .collect(),
        is_hand_alone: placed.grasp.is_hand_alone,
        frames,
        azimuth_rad: rounded(azimuth_rad),
        shown: chosen.iter().position(|idx| *idx == shown).unwrap_or(0),
        scale_newtons: placed.scale_newtons,
        first_dark_colour: scale.position(|colour: Rgb| lightness(colour) < super::pads::DARK).unwrap_or(N_COLOURS),
    })
}

fn contact_table(placed: &Placed<'_>) -> String {
    if placed.contacts.is_empty() {
        return String::new();
    }
    let mut table = String::from(
        "<section tabindex=\"0\">\n<h2>Contacts</h2>\n<table>\n<thead><tr><th>#</th><th>link</th><th>on</th>\
         <th class=\"num\">point x, y, z (mm, palm frame)</th><th class=\"num\">force (N)</th>\
         <th class=\"num\">felt (N)</th><th>felt by cells</th></tr></thead>\n<tbody>\n",
    );
    for (idx, contact) in placed.contacts.iter().enumerate() {
        let [x, y, z] = point(&contact.point_in_palm_m).map(|metres| 1000.0 * metres);
        let felt = match contact.kind {
            ContactKind::Sensed => "yes",
            ContactKind::Unsensed => "no",
            ContactKind::OnHand => "hand on hand",
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            table,
            "<tr class=\"{}\"><td><span class=\"badge\">{}</span></td><td>{}</td><td>{}</td>\
             <td class=\"num\">{x:.1}, {y:.1}, {z:.1}</td><td class=\"num\">{:.2}</td><td class=\"num\">{:.2}</td>\
             <td>{felt}</td></tr>",
            contact.kind.word(),
            idx + 1,
            escape(&contact.link),
            escape(&contact.touches),
            contact.force_newtons,
            contact.felt_newtons + 0.0,
        );
    }
    table.push_str("</tbody>\n</table>\n</section>\n");
    table
}
