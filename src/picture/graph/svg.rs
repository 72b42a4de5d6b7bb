//! A graph as SVG.

use super::layout::{EdgePath, Sizes, layout};
use super::{DrawnEdge, DrawnGraph, DrawnNode};
use crate::picture::svg::{Anchor, Svg, px, text_width};

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

const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#1f2933}\
.title{font-size:17px;font-weight:650}.name{font-size:15px;font-weight:600}.note{font-size:12px;fill:#52606d}\
.loud{font-size:12px;font-weight:600;fill:#b42318}\
.edge{stroke:#fff;stroke-width:4px;paint-order:stroke;stroke-linejoin:round}\
.box{fill:#e8f1fa;stroke:#3a78b5;stroke-width:1.6}.outside{fill:#fdf0dd;stroke:#c77f1a;stroke-width:1.6}\
.failed{fill:#fdecea;stroke:#b42318;stroke-width:2}\
.line{fill:none;stroke:#33414e;stroke-width:1.6}.line-loud{fill:none;stroke:#b42318;stroke-width:2}\
.dashed{stroke-dasharray:6 4}.tip{fill:#33414e}.tip-loud{fill:#b42318}";

/// A graph from left to right: boxes by how far they are from a source, curved arrows with their texts. The same graph
/// gives the same bytes; it needs no script and nothing from elsewhere, and brings its own light ground.
pub fn graph_svg(graph: &DrawnGraph) -> String {
    let sizes = Sizes {
        nodes: graph.nodes.iter().map(box_size).collect(),
        edges: graph.edges.iter().map(|edge| (edge.from, edge.to, label_size(edge))).collect(),
    };
    let placed = layout(&sizes);
    let moved = |[x, y]: [f64; 2]| [x + MARGIN, y + MARGIN + TITLE_HEIGHT];
    let mut svg = Svg::default();
    svg.text([MARGIN, MARGIN + 13.0], Anchor::Start, "title", &graph.title);
    for (edge, path) in graph.edges.iter().zip(&placed.edges) {
        draw_arrow(&mut svg, edge, path, moved);
    }
    for ((node, &at), size) in graph.nodes.iter().zip(&placed.nodes).zip(&sizes.nodes) {
        draw_box(&mut svg, node, moved(at), *size);
    }
    // Over all lines: a text that an arrow runs through cannot be read.
    for ((edge, path), (_, _, size)) in graph.edges.iter().zip(&placed.edges).zip(&sizes.edges) {
        draw_label(&mut svg, edge, moved(path.label), size[1], path.pieces.len() > 2);
    }
    let title_width = text_width(&graph.title, 17.0);
    let width = placed.width.max(title_width) + 2.0 * MARGIN;
    svg.finish(width, placed.height + 2.0 * MARGIN + TITLE_HEIGHT, &graph.title, STYLE)
}

fn box_size(node: &DrawnNode) -> [f64; 2] {
    let lines = || node.notes.iter().chain(&node.warnings);
    let widest = lines().map(|line| text_width(line, NOTE_SIZE)).fold(text_width(&node.name, NAME_SIZE), f64::max);
    [widest + 2.0 * PADDING[0], NAME_LINE + NOTE_LINE * lines().count() as f64 + 2.0 * PADDING[1]]
}

fn label_size(edge: &DrawnEdge) -> [f64; 2] {
    let lines = || edge.notes.iter().chain(&edge.warnings);
    [lines().map(|line| text_width(line, NOTE_SIZE)).fold(0.0, f64::max), NOTE_LINE * lines().count() as f64]
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
    let line = if is_loud { "line-loud" } else { "line" };
    let class = if edge.is_dashed { format!("{line} dashed") } else { line.into() };
    svg.element("path", &[("d", &way), ("class", &class)]);
    let (back, half) = (px(tip_x - ARROW[0]), ARROW[1]);
    let tip = format!("{back},{} {},{} {back},{}", px(tip_y - half), px(tip_x), px(tip_y), px(tip_y + half));
    svg.element("polygon", &[("points", &tip), ("class", &if is_loud { "tip-loud" } else { "tip" })]);
}

/// A line of text above the arrow and the rest below; all of it above an arrow that only passes by.
fn draw_label(svg: &mut Svg, edge: &DrawnEdge, [x, y]: [f64; 2], height: f64, is_above: bool) {
    let mut line_y = if is_above { y - height - 7.0 } else { y - height / 2.0 - 4.0 };
    let n_lines = edge.notes.len() + edge.warnings.len();
    // The arrow runs between the first line and the others, where there are others.
    if !is_above {
        line_y = if n_lines > 1 { y - NOTE_LINE - 6.0 } else { line_y - 8.0 };
    }
    let notes = edge.notes.iter().map(|line| ("note edge", line));
    for (line_idx, (class, line)) in notes.chain(edge.warnings.iter().map(|line| ("loud edge", line))).enumerate() {
        line_y += NOTE_LINE;
        if line_idx == 1 && !is_above {
            line_y += 5.0;
        }
        svg.text([x, line_y], Anchor::Middle, class, line);
    }
}
