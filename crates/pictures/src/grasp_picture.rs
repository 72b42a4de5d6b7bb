//! The picture of a grasp as one sheet: views, heat maps, contacts, joints, and what is known of the grasp.

use super::PictureError;
use super::grasp::{ContactKind, Placed, RecordedGrasp};
use super::pads::draw_pads;
use super::raster::Camera;
use super::svg::{Anchor, Svg, fit_text, px, text_width};
use super::view::{Surfaces, choose_cameras, draw_arrow, draw_number, draw_view};
use blindgrasp_stages::hand::{Hand, JointKind};

const WIDTH: f64 = 1200.0;
const MARGIN: f64 = 28.0;
/// Where the views begin.
const TOP: f64 = 112.0;
/// A view's width and height.
pub(super) const VIEW: [f64; 2] = [420.0, 430.0];
/// Left edge of the column of heat maps and joints.
const COLUMN: f64 = 900.0;
const ROW: f64 = 20.0;
/// Contacts in one column of the table, before there are three columns.
const N_ROWS: usize = 8;

/// Colours of contacts: apart in lightness and hue, and each kind has a shape of its own besides.
const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#1f2933;\
font-size:13px}.title{font-size:25px;font-weight:650}.sub{font-size:14px;fill:#52606d}.strong{font-weight:600}\
.head{font-weight:600;fill:#52606d;font-size:12px}.note{fill:#52606d;font-size:12px}.tiny{fill:#52606d;font-size:10px;\
paint-order:stroke;stroke:#ffffff;stroke-opacity:.8;stroke-width:3px}\
.num{font-variant-numeric:tabular-nums}.chip{font-size:14px;font-weight:600}.light{fill:#ffffff}\
.cell{stroke:#c3cad3;stroke-width:.6}.cell-force{font-size:9px;font-variant-numeric:tabular-nums}.on-dark{fill:#ffffff}\
.rule{stroke:#e1e5ea;stroke-width:1}.axis{stroke:#52606d;stroke-width:1.4;fill:none}\
.seam{stroke:#ffffff;stroke-width:5.5;stroke-opacity:.85;fill:none;stroke-linejoin:round;stroke-linecap:round}\
.arrow .shaft{stroke-width:2.6;fill:none}.arrow .head{stroke-width:1.4;stroke-linejoin:round}\
.arrow .dot{stroke:#ffffff;stroke-width:1.2}\
.arrow.sensed .shaft,.arrow.sensed .head{stroke:#c92a2a}.arrow.sensed .head,.arrow.sensed .dot{fill:#c92a2a}\
.arrow.unsensed .shaft,.arrow.unsensed .head{stroke:#343a46}.arrow.unsensed .shaft{stroke-dasharray:4 3}\
.arrow.unsensed .head{fill:#ffffff}.arrow.unsensed .dot{fill:#ffffff;stroke:#343a46;stroke-width:1.8}\
.arrow.on-hand .shaft,.arrow.on-hand .head{stroke:#6741d9}.arrow.on-hand .shaft{stroke-dasharray:1.5 3;stroke-linecap:round}\
.arrow.on-hand .head,.arrow.on-hand .dot{fill:#6741d9}\
.number{stroke-width:1.6}.number.sensed{fill:#c92a2a;stroke:#ffffff}.number.unsensed{fill:#ffffff;stroke:#343a46}\
.number.on-hand{fill:#6741d9;stroke:#ffffff}.digits{font-size:10px;font-weight:700;fill:#ffffff}\
.digits.unsensed{fill:#343a46}.leader{stroke-width:1.2}.leader.sensed{stroke:#c92a2a}.leader.unsensed{stroke:#343a46}\
.leader.on-hand{stroke:#6741d9}.cell-arrow{stroke:#c92a2a;stroke-width:1.6;stroke-linecap:round}.cell-tip{fill:#c92a2a}";

/// A grasp as SVG.
///
/// # Errors
/// Frames, joints or contacts that are not this hand's.
pub fn grasp_svg(hand: &Hand, grasp: &RecordedGrasp) -> Result<String, PictureError> {
    let placed = Placed::new(hand, grasp)?;
    let surfaces = Surfaces::new(&placed);
    draw(&placed, &surfaces, &choose_cameras(&placed, &surfaces, VIEW))
}

/// The style sheet of pictures of grasps, for pages that hold parts of them.
pub(super) fn style() -> &'static str {
    STYLE
}

/// What a grasp is called: its object, if the recording says.
pub(super) fn title(grasp: &RecordedGrasp) -> String {
    match &grasp.truth {
        Some(truth) => truth.object.clone(),
        None => format!("Grasp {}", grasp.grasp_id),
    }
}

/// The sheet, with the grasp as these cameras see it.
pub(super) fn draw(placed: &Placed<'_>, surfaces: &Surfaces, cameras: &[Camera; 2]) -> Result<String, PictureError> {
    let mut svg = Svg::default();
    draw_header(&mut svg, placed);
    for (idx, camera) in cameras.iter().enumerate() {
        let left = MARGIN + idx as f64 * (VIEW[0] + 8.0);
        draw_view(&mut svg, placed, surfaces, camera, [left, TOP], VIEW)?;
    }
    let below = TOP + VIEW[1] + 20.0;
    let column_width = WIDTH - MARGIN - COLUMN;
    svg.text(
        [COLUMN, TOP + 2.0],
        Anchor::Start,
        "head",
        &if placed.grasp.is_hand_alone {
            "CELLS".into()
        } else {
            format!("CELLS, {} FRAME", placed.frame.phase.as_str().to_uppercase())
        },
    );
    let pads_height = draw_pads(&mut svg, placed, [COLUMN, TOP + 16.0], column_width, VIEW[1] - 16.0)?;
    // A hand with few joints has them under its pads, aligned with the contacts where there is room.
    let joints_top = (TOP + 16.0 + pads_height + 20.0).max(below);
    let left_end = draw_contacts(&mut svg, placed, below);
    let right_end = draw_joints(&mut svg, placed, joints_top, column_width);
    let height = left_end.max(right_end) + MARGIN - 6.0;
    Ok(svg.finish(WIDTH, height, &page_title(placed), STYLE))
}

/// The title of the document.
pub(super) fn page_title(placed: &Placed<'_>) -> String {
    match placed.grasp {
        grasp if grasp.is_hand_alone => format!("Hand {}", placed.hand.name),
        grasp => format!("Grasp {} of {}", grasp.grasp_id, title(grasp)),
    }
}

fn draw_header(svg: &mut Svg, placed: &Placed<'_>) {
    let grasp = placed.grasp;
    let title = if grasp.is_hand_alone { placed.hand.name.clone() } else { title(grasp) };
    let title = fit_text(&title, 25.0, 420.0);
    svg.text([MARGIN, 50.0], Anchor::Start, "title", &title);
    let mut about = Vec::new();
    if let Some(truth) = &grasp.truth {
        about.push(format!("class {}", truth.class));
        about.push(format!("grasp {}", grasp.grasp_id));
    }
    if grasp.is_hand_alone {
        about.push("the hand and its cells".into())
    } else {
        about.push(format!("hand {}", placed.hand.name))
    }
    if let Some(scene) = &grasp.scene {
        about.push(format!("{:.0} g", 1000.0 * scene.mass_kg));
        about.push(format!("friction {}", px(scene.friction)));
    }
    svg.text([MARGIN, 76.0], Anchor::Start, "sub", &fit_text(&about.join("  ·  "), 14.0, 600.0));
    draw_chips(&mut Chips { svg, right: WIDTH - MARGIN }, placed);
    svg.element("line", &[("x1", &MARGIN), ("x2", &(WIDTH - MARGIN)), ("y1", &93), ("y2", &93), ("class", &"rule")]);
}

/// Draws a row of chips from the right: the decision, the prediction, the label.
fn draw_chips(chips: &mut Chips<'_>, placed: &Placed<'_>) {
    let grasp = placed.grasp;
    let (green, red, grey) = ("#2b8a3e", "#c92a2a", "#eceff3");
    if let Some(decision) = &grasp.decision {
        let text = format!("{}: {}", decision.action.as_str(), decision.reason.as_str().replace('_', " "));
        chips.draw(&text, "decided", grey, "");
    }
    if let Some(prediction) = &grasp.prediction {
        let text = match prediction.fault {
            blindgrasp_messages::Fault::None => format!("p(stable) {:.2}", prediction.probability_stable),
            fault => fault.as_str().replace('_', " "),
        };
        chips.draw(&text, "predicted", grey, "");
    }
    match &grasp.truth {
        Some(truth) => {
            // NaN where nobody computed them.
            if !truth.epsilon.is_nan() {
                chips.draw(&number(truth.volume), "volume", grey, "");
                let note = if truth.epsilon < 0.0 { "epsilon: no force closure" } else { "epsilon" };
                chips.draw(&format!("ε {}", number(truth.epsilon)), note, grey, "");
            }
            let (text, fill) = if truth.stable { ("stable", green) } else { ("unstable", red) };
            chips.draw(text, "true label", fill, "light");
        }
        None if grasp.is_hand_alone => {
            let (n_joints, n_pads) = (placed.hand.joints.len(), placed.hand.pads.len());
            chips.draw(&placed.hand.n_cells().to_string(), "cells", grey, "");
            chips.draw(&n_pads.to_string(), "pads", grey, "");
            chips.draw(&n_joints.to_string(), "joints", grey, "");
        }
        None => chips.draw("not labelled", "true label", grey, ""),
    }
}

/// Chips, each with a note below, from the right to the left.
struct Chips<'a> {
    svg: &'a mut Svg,
    /// The right edge of the next one.
    right: f64,
}

impl Chips<'_> {
    fn draw(&mut self, text: &str, note: &str, fill: &str, class: &str) {
        let width = text_width(text, 14.5).max(text_width(note, 12.0) - 16.0) + 28.0;
        let left = self.right - width;
        self.svg.element(
            "rect",
            &[("x", &px(left)), ("y", &28), ("width", &px(width)), ("height", &30), ("rx", &15), ("fill", &fill)],
        );
        let middle = left + width / 2.0;
        self.svg.text([middle, 48.0], Anchor::Middle, &format!("chip {class}"), text);
        self.svg.text([middle, 75.0], Anchor::Middle, "note", note);
        self.right = left - 14.0;
    }
}

/// Three significant digits.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let n_decimals = (2 - value.abs().log10().floor() as i32).clamp(0, 8) as usize;
    let text = format!("{value:.n_decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    text.replace('-', "−")
}

/// The legend, the notes and the table of contacts; returns where they end.
fn draw_contacts(svg: &mut Svg, placed: &Placed<'_>, top: f64) -> f64 {
    let width = 2.0 * VIEW[0] + 8.0;
    let mut y = top;
    for note in &placed.notes {
        svg.text([MARGIN, y + 4.0], Anchor::Start, "sub", &fit_text(note, 14.0, width));
        y += 24.0;
    }
    if placed.contacts.is_empty() {
        if placed.grasp.is_hand_alone {
            let note = "lines: the normal of each cell, towards the object; joint values are below the pads";
            svg.text([MARGIN, y + 4.0], Anchor::Start, "note", note);
        } else if placed.grasp.scene.is_none() {
            let what = format!(
                "lines: reading of each active cell along its normal; the longest possible is {} {}",
                px(placed.scale_newtons),
                placed.hand.cell_unit.symbol()
            );
            svg.text([MARGIN, y + 4.0], Anchor::Start, "note", &what);
        }
        return y + ROW;
    }
    draw_legend(svg, placed, y, width);
    draw_table(svg, placed, y + 30.0, width)
}

/// The kinds of contacts, with their numbers, and the scale of the arrows.
fn draw_legend(svg: &mut Svg, placed: &Placed<'_>, y: f64, width: f64) {
    let largest = placed.contacts.iter().map(|contact| contact.force_newtons).fold(0.0, f64::max);
    let mut x = MARGIN;
    for (kind, what) in [
        (ContactKind::Sensed, "felt by cells"),
        (ContactKind::Unsensed, "felt by no cell"),
        (ContactKind::OnHand, "hand on hand"),
    ] {
        let n = placed.n_contacts(kind);
        if n > 0 {
            draw_arrow(svg, kind, [x + 4.0, y], [x + 34.0, y], 0);
            let text = format!("{n} {what}");
            svg.text([x + 42.0, y + 4.5], Anchor::Start, "", &text);
            x += 42.0 + text_width(&text, 13.0) + 26.0;
        }
    }
    let scale = format!("arrow length is force, the longest {} N", number(largest));
    svg.text([MARGIN + width, y + 4.5], Anchor::End, "note", &scale);
}

/// The table of contacts; returns where it ends.
fn draw_table(svg: &mut Svg, placed: &Placed<'_>, y: f64, width: f64) -> f64 {
    let n_columns = placed.contacts.len().div_ceil(N_ROWS).min(3);
    let n_rows = placed.contacts.len().div_ceil(n_columns);
    let column_width = (width - 24.0 * (n_columns as f64 - 1.0)) / n_columns as f64;
    // A single column as wide as the views would pull its numbers away from its names.
    let column_width = column_width.min(400.0);
    for (column, contacts) in placed.contacts.chunks(n_rows).enumerate() {
        let left = MARGIN + column as f64 * (column_width + 24.0);
        let right = left + column_width;
        let columns = [right - 128.0, right - 62.0, right];
        svg.text([left + 28.0, y], Anchor::Start, "head", "LINK");
        for (x, name) in columns.into_iter().zip(["ON", "FORCE N", "FELT N"]) {
            svg.text([x, y], Anchor::End, "head", name);
        }
        let line_y = y + 6.0;
        svg.element(
            "line",
            &[("x1", &px(left)), ("x2", &px(right)), ("y1", &line_y), ("y2", &line_y), ("class", &"rule")],
        );
        for (row, contact) in contacts.iter().enumerate() {
            let at = y + 22.0 + row as f64 * ROW;
            draw_number(svg, contact.kind, [left + 9.0, at - 4.0], column * n_rows + row + 1);
            let room = (column_width - 28.0 - 128.0 - 10.0) / 2.0;
            svg.text([left + 28.0, at], Anchor::Start, "", &fit_text(&contact.link, 13.0, room + 30.0));
            svg.text([columns[0], at], Anchor::End, "", &fit_text(&contact.touches, 13.0, room));
            for (x, newtons) in columns[1..].iter().zip(&[contact.force_newtons, contact.felt_newtons]) {
                svg.text([*x, at], Anchor::End, "num", &format!("{:.2}", px(*newtons)));
            }
        }
    }
    y + 22.0 + (n_rows as f64 - 1.0) * ROW
}

/// Joint angles within their limits; returns where they end.
fn draw_joints(svg: &mut Svg, placed: &Placed<'_>, top: f64, width: f64) -> f64 {
    let slides = placed.hand.joints.iter().any(|joint| joint.kind == JointKind::Prismatic);
    let unit = if slides { "RAD, M" } else { "RAD" };
    svg.text([COLUMN, top + 4.0], Anchor::Start, "head", "JOINTS");
    svg.text([COLUMN + width, top + 4.0], Anchor::End, "head", unit);
    let (bar_left, bar_right) = (COLUMN + 92.0, COLUMN + width - 48.0);
    for (idx, (joint, value)) in placed.hand.joints.iter().zip(placed.joints).enumerate() {
        let y = top + 28.0 + idx as f64 * ROW;
        let name = fit_text(&joint.name.replace('_', " "), 13.0, 84.0);
        svg.text([COLUMN, y], Anchor::Start, "", &name);
        let share = ((value - joint.lower) / (joint.upper - joint.lower).max(1e-9)).clamp(0.0, 1.0);
        let (bar_y, length) = (px(y - 7.0), bar_right - bar_left);
        for (part, fill) in [(1.0, "#eceff3"), (share, "#7b8794")] {
            svg.element(
                "rect",
                &[
                    ("x", &px(bar_left)),
                    ("y", &bar_y),
                    ("width", &px(part * length)),
                    ("height", &5),
                    ("rx", &2.5),
                    ("fill", &fill),
                ],
            );
        }
        svg.text([COLUMN + width, y], Anchor::End, "num", &format!("{value:.3}"));
    }
    top + 28.0 + (placed.hand.joints.len() as f64 - 1.0) * ROW
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        for (value, expected) in
            [(0.07123, "0.0712"), (-1.0, "−1"), (1234.5, "1234"), (0.0, "0"), (3.004, "3"), (1e-5, "0.00001")]
        {
            assert_eq!(number(value), expected);
        }
    }
}
