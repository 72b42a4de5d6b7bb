//! A graph as SVG.

use super::lanes::{FRAME_PADDING, order_of};
use super::layout::{EdgePath, Sizes, layout};
use super::{DrawnEdge, DrawnGraph, DrawnGroup, DrawnNode, tint};
use crate::svg::{Anchor, Svg, fit_text, px, text_width};

const NAME_SIZE: f64 = 15.0;
const NOTE_SIZE: f64 = 12.0;
const NAME_LINE: f64 = 20.0;
const NOTE_LINE: f64 = 16.0;
/// Around the text of a box.
const PADDING: [f64; 2] = [16.0, 12.0];
/// Around all, and above for the title.
const MARGIN: f64 = 22.0;
const TITLE_HEIGHT: f64 = 34.0;
const ARROW: [f64; 2] = [9.0, 4.5];
/// How far an arrow that goes back runs below what is above it, its text aside.
const FEEDBACK_GAP: f64 = 24.0;

/// [`super::CROSSING`] is in it, too.
pub(super) const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#1f2933}\
.title{font-size:17px;font-weight:650}.name{font-size:15px;font-weight:600}.note{font-size:12px;fill:#52606d}\
.loud{font-size:12px;font-weight:600;fill:#b42318}\
.edge{stroke:#fff;stroke-width:4px;paint-order:stroke;stroke-linejoin:round}\
.box{fill:#e8f1fa;stroke:#3a78b5;stroke-width:1.6}.outside{fill:#fdf0dd;stroke:#c77f1a;stroke-width:1.6}\
.failed{fill:#fdecea;stroke:#b42318;stroke-width:2}\
.line{fill:none;stroke:#33414e;stroke-width:1.6}.line-loud{fill:none;stroke:#b42318;stroke-width:2}\
.dashed{stroke-dasharray:6 4}.frame{stroke-width:1.3}.group{font-size:14px;font-weight:650}\
.line-crossing{fill:none;stroke:#7a4fb5;stroke-width:2;stroke-dasharray:10 5}.tip-crossing{fill:#7a4fb5}\
.crossing{font-size:12px;font-weight:600;fill:#7a4fb5}.tip{fill:#33414e}.tip-loud{fill:#b42318}";

/// A graph from left to right: boxes by how far they are from a source, curved arrows with their texts. The same graph
/// gives the same bytes; groups are framed lanes below each other; it needs no script and nothing from elsewhere, and brings its own light ground.
pub fn graph_svg(graph: &DrawnGraph) -> String {
    let (lanes, joined) = lanes_of(graph);
    let order = order_of(graph.groups.len(), &joined);
    let n_frames = order.len();
    // Feedback is drawn below all others, which stand as if there were none.
    let (feedback, forward): (Vec<&DrawnEdge>, Vec<&DrawnEdge>) = graph.edges.iter().partition(|edge| edge.is_feedback);
    let sizes = Sizes {
        lanes: lanes.iter().map(|lane| order.get(*lane).copied().unwrap_or(n_frames)).collect(),
        n_frames,
        nodes: graph.nodes.iter().map(box_size).collect(),
        edges: forward.iter().map(|edge| (edge.from, edge.to, label_size(edge))).collect(),
    };
    let placed = layout(&sizes);
    let frame_padding = if n_frames > 0 { FRAME_PADDING } else { 0.0 };
    let moved = |[x, y]: [f64; 2]| [x + MARGIN + frame_padding, y + MARGIN + TITLE_HEIGHT];
    let inner_width = placed.width + 2.0 * frame_padding;
    let mut svg = Svg::default();
    svg.text([MARGIN, MARGIN + 13.0], Anchor::Start, "title", &graph.title);
    for (group_idx, (group, &place)) in graph.groups.iter().zip(&order).enumerate() {
        let [top, bottom] = placed.frames[place];
        draw_frame(&mut svg, group, group_idx, moved([-frame_padding, top]), [inner_width, bottom - top]);
    }
    for (edge, path) in forward.iter().zip(&placed.edges) {
        draw_arrow(&mut svg, edge, path, moved);
    }
    for ((node, &at), size) in graph.nodes.iter().zip(&placed.nodes).zip(&sizes.nodes) {
        draw_box(&mut svg, node, moved(at), *size);
    }
    // Over all lines: a text that an arrow runs through cannot be read.
    let mut height = placed.height;
    for edge in feedback {
        let bottom = |idx: usize| moved([placed.nodes[idx][0], placed.nodes[idx][1] + sizes.nodes[idx][1] / 2.0]);
        let [_, label_height] = label_size(edge);
        height += FEEDBACK_GAP + label_height;
        let [_, level] = moved([0.0, height]);
        draw_feedback(&mut svg, edge, [bottom(edge.from), bottom(edge.to)], level);
    }
    for ((edge, path), (_, _, size)) in forward.iter().zip(&placed.edges).zip(&sizes.edges) {
        if path.is_beside {
            draw_label_beside(&mut svg, edge, moved([path.label[0] - size[0] / 2.0, path.label[1]]), size[1]);
        } else {
            draw_label(&mut svg, edge, moved(path.label), size[1], path.pieces.len() > 2);
        }
    }
    let title_width = text_width(&graph.title, 17.0);
    let width = inner_width.max(title_width) + 2.0 * MARGIN;
    svg.finish(width, height + 2.0 * MARGIN + TITLE_HEIGHT, &graph.title, STYLE)
}

/// The group of each node, and the next number for those in none; which groups are joined by edges.
fn lanes_of(graph: &DrawnGraph) -> (Vec<usize>, Vec<(usize, usize)>) {
    let n_groups = graph.groups.len();
    let lanes: Vec<usize> = graph.nodes.iter().map(|node| node.group.unwrap_or(n_groups).min(n_groups)).collect();
    let ends = graph.edges.iter().map(|edge| (lanes[edge.from], lanes[edge.to]));
    let joined = ends.filter(|&(from, to)| from < n_groups && to < n_groups).collect();
    (lanes, joined)
}

fn draw_frame(svg: &mut Svg, group: &DrawnGroup, group_idx: usize, [x, y]: [f64; 2], [width, height]: [f64; 2]) {
    let [fill, border] = tint(group_idx);
    svg.element(
        "rect",
        &[
            ("x", &px(x)),
            ("y", &px(y)),
            ("width", &px(width)),
            ("height", &px(height)),
            ("rx", &12.0),
            ("fill", &fill),
            ("stroke", &border),
            ("class", &"frame"),
        ],
    );
    let baseline = y + 23.0;
    svg.text([x + 14.0, baseline], Anchor::Start, "group", &group.name);
    let name_width = text_width(&group.name, 14.0) + 30.0;
    let note = fit_text(&group.note, NOTE_SIZE, width - name_width - 14.0);
    svg.text([x + name_width, baseline], Anchor::Start, "note", &note);
}

fn box_size(node: &DrawnNode) -> [f64; 2] {
    let lines = || node.notes.iter().chain(&node.warnings);
    let widest = lines().map(|line| text_width(line, NOTE_SIZE)).fold(text_width(&node.name, NAME_SIZE), f64::max);
    [widest + 2.0 * PADDING[0], NAME_LINE + NOTE_LINE * lines().count() as f64 + 2.0 * PADDING[1]]
}

fn label_size(edge: &DrawnEdge) -> [f64; 2] {
    let widest = edge.lines().map(|line| text_width(line, NOTE_SIZE)).fold(0.0, f64::max);
    [widest, NOTE_LINE * edge.lines().count() as f64]
}

fn draw_box(svg: &mut Svg, node: &DrawnNode, [x, y]: [f64; 2], [width, height]: [f64; 2]) {
    let class = match node {
        node if !node.warnings.is_empty() => "failed",
        node if node.is_outside => "outside",
        _ => "box",
    };
    let radius = if node.is_outside { height / 2.0 } else { 9.0 };
    svg.element(
        "rect",
        &[
            ("x", &px(x - width / 2.0)),
            ("y", &px(y - height / 2.0)),
            ("width", &px(width)),
            ("height", &px(height)),
            ("rx", &px(radius)),
            ("class", &class),
        ],
    );
    let mut line_y = y - height / 2.0 + PADDING[1] + 15.0;
    svg.text([x, line_y], Anchor::Middle, "name", &node.name);
    line_y += NAME_LINE - NOTE_LINE + 1.0;
    let notes = node.notes.iter().map(|line| ("note", line));
    for (class, line) in notes.chain(node.warnings.iter().map(|line| ("loud", line))) {
        line_y += NOTE_LINE;
        svg.text([x, line_y], Anchor::Middle, class, line);
    }
}

fn draw_arrow(svg: &mut Svg, edge: &DrawnEdge, path: &EdgePath, moved: impl Fn([f64; 2]) -> [f64; 2]) {
    let pieces: Vec<[[f64; 2]; 2]> = path.pieces.iter().map(|piece| piece.map(&moved)).collect();
    let Some(&[_, [tip_x, tip_y]]) = pieces.last() else { return };
    let [[x, y], _] = pieces[0];
    let mut way = format!("M{} {}", px(x), px(y));
    for pair in pieces.windows(2) {
        let ([x0, y0], [[x1, y1], _]) = (pair[0][1], pair[1]);
        // The line ends inside the tip.
        let x1 = if x1 == tip_x { x1 - ARROW[0] * 0.7 } else { x1 };
        let middle = px((x0 + x1) / 2.0);
        way += &format!("C{middle} {} {middle} {} {} {}", px(y0), px(y1), px(x1), px(y1));
        let [through_x, through_y] = pair[1][1];
        if through_x != tip_x {
            way += &format!("L{} {}", px(through_x), px(through_y));
        }
    }
    let is_loud = !edge.warnings.is_empty();
    let kind = if is_loud {
        "-loud"
    } else if edge.carrier.is_some() {
        "-crossing"
    } else {
        ""
    };
    let is_dashed = edge.is_dashed || (edge.carrier.is_some() && is_loud);
    let class = if is_dashed { format!("line{kind} dashed") } else { format!("line{kind}") };
    svg.element("path", &[("d", &way), ("class", &class)]);
    let (back, half) = (px(tip_x - ARROW[0]), ARROW[1]);
    let tip = format!("{back},{} {},{} {back},{}", px(tip_y - half), px(tip_x), px(tip_y), px(tip_y + half));
    svg.element("polygon", &[("points", &tip), ("class", &format!("tip{kind}"))]);
}

/// From below one box along a level line to below another, with its text above the line.
fn draw_feedback(svg: &mut Svg, edge: &DrawnEdge, [[from_x, from_y], [to_x, to_y]]: [[f64; 2]; 2], level: f64) {
    let bend = FEEDBACK_GAP.min((from_x - to_x).abs() / 2.0).copysign(from_x - to_x);
    let way = format!(
        "M{} {}C{} {} {} {} {} {}L{} {}C{} {} {} {} {} {}",
        px(from_x),
        px(from_y),
        px(from_x),
        px(level),
        px(from_x),
        px(level),
        px(from_x - bend),
        px(level),
        px(to_x + bend),
        px(level),
        px(to_x),
        px(level),
        px(to_x),
        px(level),
        px(to_x),
        px(to_y + ARROW[0] * 0.7)
    );
    let kind = if edge.warnings.is_empty() { "" } else { "-loud" };
    svg.element("path", &[("d", &way), ("class", &format!("line{kind} dashed"))]);
    let (back, half) = (px(to_y + ARROW[0]), ARROW[1]);
    let tip = format!("{},{back} {},{} {},{back}", px(to_x - half), px(to_x), px(to_y), px(to_x + half));
    svg.element("polygon", &[("points", &tip), ("class", &format!("tip{kind}"))]);
    draw_label(svg, edge, [(from_x + to_x) / 2.0, level], label_size(edge)[1], true);
}

/// A line of text above the arrow and the rest below; all of it above an arrow that only passes by.
fn draw_label(svg: &mut Svg, edge: &DrawnEdge, [x, y]: [f64; 2], height: f64, is_above: bool) {
    let mut line_y = if is_above { y - height - 7.0 } else { y - height / 2.0 - 4.0 };
    let n_lines = edge.lines().count();
    // The arrow runs between the first line and the others, where there are others.
    if !is_above {
        line_y = if n_lines > 1 { y - NOTE_LINE - 6.0 } else { line_y - 8.0 };
    }
    for (line_idx, (class, line)) in classed_lines(edge).enumerate() {
        line_y += NOTE_LINE;
        if line_idx == 1 && !is_above {
            line_y += 5.0;
        }
        svg.text([x, line_y], Anchor::Middle, class, line);
    }
}

/// Right of the arrow, which runs from one frame to another.
fn draw_label_beside(svg: &mut Svg, edge: &DrawnEdge, [x, y]: [f64; 2], height: f64) {
    let mut baseline = y - height / 2.0 - 4.0;
    for (class, line) in classed_lines(edge) {
        baseline += NOTE_LINE;
        svg.text([x, baseline], Anchor::Start, class, line);
    }
}

fn classed_lines(edge: &DrawnEdge) -> impl Iterator<Item = (&'static str, &String)> {
    let notes = edge.notes.iter().map(|line| ("note edge", line));
    let carrier = edge.carrier.iter().map(|line| ("crossing edge", line));
    notes.chain(carrier).chain(edge.warnings.iter().map(|line| ("loud edge", line)))
}
