//! A heat map of scores over two parameters: where a search was, what it found, and where the best lies.

use super::colour::{Rgb, force_colour, hex, lightness};
use super::svg::{Anchor, Svg, fit_text, px, text_width};

/// What to draw.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatMap {
    /// Above the map.
    pub title: String,
    /// Below the title.
    pub about: String,
    /// What the colours mean, with its unit.
    pub quantity: String,
    /// Across and upwards.
    pub axes: [HeatMapAxis; 2],
    /// The scores; pairs without one stay grey.
    pub cells: Vec<HeatMapCell>,
}

/// A parameter and its values.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatMapAxis {
    /// The parameter.
    pub name: String,
    /// Its values, rising.
    pub values: Vec<f64>,
}

/// A pair of values and its score.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatMapCell {
    /// The values, in the order of the axes.
    pub at: [f64; 2],
    /// The score, 0 to 1; written as a percentage.
    pub share: f64,
    /// Below the score.
    pub note: String,
    /// Whether it is the one to be found at a glance.
    pub is_marked: bool,
}

const MARGIN: f64 = 40.0;
const HEAD: f64 = 112.0;
/// Left of the map: the upward axis's values and title.
const LEFT: f64 = 92.0;
/// Below the map: the other axis's.
const FOOT: f64 = 74.0;
/// The least width and height of a cell: room for its numbers.
const CELL: [f64; 2] = [92.0, 62.0];
const GAP: f64 = 2.0;
/// Right of the map: the colours' scale.
const LEGEND: f64 = 120.0;
const LEGEND_STRIPES: usize = 64;
/// Above this, the widths of cells by the logarithm differ so much that all are drawn as wide as each other.
const MOST_STRETCH: f64 = 3.0;
const SILENT: Rgb = [0.93, 0.94, 0.95];

const STYLE: &str = "text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#1f2933}\
.title{font-size:28px;font-weight:650}.sub{font-size:15px;fill:#52606d}.value{font-size:15px}\
.axis-title{font-size:17px;font-weight:600}.score{font-size:19px;font-weight:600}.note{font-size:12px}\
.tick{stroke:#52606d;stroke-width:1}.mark{fill:none;stroke:#ffffff;stroke-width:2}\
.mark-outside{fill:none;stroke:#1f2933;stroke-width:4}.mark-text{font-size:15px;font-weight:600}";

/// The map as a picture (SVG). Cells are as wide as the steps of the parameters' logarithms, darker = more, evenly in
/// lightness from the least score to the greatest, so that it can be read in greyscale too.
pub fn heat_map_svg(map: &HeatMap) -> String {
    let columns = Scale::of(&map.axes[0].values, CELL[0]);
    let rows = Scale::of(&map.axes[1].values, CELL[1]);
    let [left, top] = [MARGIN + LEFT, HEAD];
    let (right, bottom) = (left + columns.length(), top + rows.length().max(3.0 * CELL[1]));
    let width = (right + LEGEND + MARGIN).max(760.0);
    let mut svg = Svg::default();
    svg.text([MARGIN, 54.0], Anchor::Start, "title", &fit_text(&map.title, 28.0, width - 2.0 * MARGIN));
    svg.text([MARGIN, 82.0], Anchor::Start, "sub", &fit_text(&map.about, 15.0, width - 2.0 * MARGIN));
    let range = Range::of(map);
    let draw = |svg: &mut Svg, column: usize, row: usize| {
        let [x0, x1] = columns.cell(column).map(|x| left + x);
        let [y1, y0] = rows.cell(row).map(|y| bottom - y);
        let at = [map.axes[0].values[column], map.axes[1].values[row]];
        let cell = map.cells.iter().find(|cell| cell.at == at);
        let colour = cell.map_or(SILENT, |cell| force_colour(range.place(cell.share)));
        rectangle(svg, [x0, y0, x1, y1], 0.5 * GAP, &[("fill", &hex(colour))]);
        let Some(cell) = cell else { return };
        let ink = if lightness(colour) < 0.62 { "#ffffff" } else { "#1f2933" };
        let (x, y) = (0.5 * (x0 + x1), 0.5 * (y0 + y1));
        let style = format!("fill:{ink}");
        let score = format!("{:.1}", 100.0 * cell.share);
        svg.text_with([x, y + 2.0], Anchor::Middle, "score", &score, &[("style", &style)]);
        let note = fit_text(&cell.note, 12.0, x1 - x0 - 8.0);
        svg.text_with([x, y + 19.0], Anchor::Middle, "note", &note, &[("style", &style)]);
        if cell.is_marked {
            rectangle(svg, [x0, y0, x1, y1], 2.0, &[("class", &"mark-outside")]);
            rectangle(svg, [x0, y0, x1, y1], 5.0, &[("class", &"mark")]);
        }
    };
    for row in 0..map.axes[1].values.len() {
        (0..map.axes[0].values.len()).for_each(|column| draw(&mut svg, column, row));
    }
    draw_axes(&mut svg, map, (&columns, &rows), [left, bottom]);
    draw_legend(&mut svg, map, &range, [right + 36.0, top], bottom);
    if let Some(marked) = map.cells.iter().find(|cell| cell.is_marked) {
        let [first, second] = [0, 1].map(|idx| format!("{} {}", map.axes[idx].name, marked.at[idx]));
        let text = format!("framed: {first}, {second}: {:.1} %", 100.0 * marked.share);
        svg.text([left, bottom + FOOT + 12.0], Anchor::Start, "mark-text", &text);
    }
    svg.finish(width, bottom + FOOT + MARGIN, &map.title, STYLE)
}

fn draw_axes(svg: &mut Svg, map: &HeatMap, (columns, rows): (&Scale, &Scale), [left, bottom]: [f64; 2]) {
    let title = |axis: usize, scale: &Scale| {
        format!("{}{}", map.axes[axis].name, if scale.is_logarithmic { ", logarithmic" } else { "" })
    };
    for (idx, value) in map.axes[0].values.iter().enumerate() {
        let x = left + columns.centre(idx);
        tick(svg, [x, bottom + 2.0], [x, bottom + 8.0]);
        svg.text([x, bottom + 26.0], Anchor::Middle, "value", &value.to_string());
    }
    let middle = left + 0.5 * columns.length();
    svg.text([middle, bottom + 54.0], Anchor::Middle, "axis-title", &title(0, columns));
    for (idx, value) in map.axes[1].values.iter().enumerate() {
        let y = bottom - rows.centre(idx);
        tick(svg, [left - 2.0, y], [left - 8.0, y]);
        svg.text([left - 13.0, y + 5.0], Anchor::End, "value", &value.to_string());
    }
    let (x, y) = (MARGIN + 14.0, bottom - 0.5 * rows.length());
    let turned = format!("rotate(-90 {} {})", px(x), px(y));
    svg.text_with([x, y], Anchor::Middle, "axis-title", &title(1, rows), &[("transform", &turned)]);
}

/// The colours from the least score to the greatest.
fn draw_legend(svg: &mut Svg, map: &HeatMap, range: &Range, [left, top]: [f64; 2], bottom: f64) {
    let (bar_top, bar_width) = (top + 26.0, 22.0);
    let quantity_width = text_width(&map.quantity, 15.0);
    svg.text([left.min(left + LEGEND - 36.0 - quantity_width), top + 12.0], Anchor::Start, "value", &map.quantity);
    let stripe = (bottom - bar_top) / LEGEND_STRIPES as f64;
    for idx in 0..LEGEND_STRIPES {
        let colour = force_colour((idx as f64 + 0.5) / LEGEND_STRIPES as f64);
        let y = bottom - (idx + 1) as f64 * stripe;
        // Half a pixel over the one above, or the card would shine through between them.
        let height = px(stripe + if idx > 0 { 0.5 } else { 0.0 });
        svg.element(
            "rect",
            &[("x", &px(left)), ("y", &px(y)), ("width", &bar_width), ("height", &height), ("fill", &hex(colour))],
        );
    }
    for idx in 0..=4 {
        let place = f64::from(idx) / 4.0;
        let y = bottom - place * (bottom - bar_top);
        tick(svg, [left + bar_width + 2.0, y], [left + bar_width + 7.0, y]);
        let value = format!("{:.1}", 100.0 * range.value(place));
        svg.text([left + bar_width + 12.0, y + 5.0], Anchor::Start, "value", &value);
    }
}

fn tick(svg: &mut Svg, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
    svg.element("line", &[("x1", &px(x1)), ("y1", &px(y1)), ("x2", &px(x2)), ("y2", &px(y2)), ("class", &"tick")]);
}

/// A rectangle from corner to corner, moved inwards by `inset`.
fn rectangle(svg: &mut Svg, [x0, y0, x1, y1]: [f64; 4], inset: f64, attributes: &[(&str, &dyn std::fmt::Display)]) {
    let (x, y) = (px(x0 + inset), px(y0 + inset));
    let (width, height) = (px(x1 - x0 - 2.0 * inset), px(y1 - y0 - 2.0 * inset));
    let mut all: Vec<(&str, &dyn std::fmt::Display)> =
        vec![("x", &x), ("y", &y), ("width", &width), ("height", &height)];
    all.extend(attributes);
    svg.element("rect", &all);
}

/// Where the cells of an axis lie: borders half-way between the logarithms of the values.
struct Scale {
    /// One more than values, pixels from the start.
    borders: Vec<f64>,
    /// Where each value lies.
    centres: Vec<f64>,
    is_logarithmic: bool,
}

impl Scale {
    fn of(values: &[f64], least_cell: f64) -> Scale {
        let logarithms: Vec<f64> = values.iter().map(|value| value.ln()).collect();
        let steps: Vec<f64> = logarithms.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let (least, most) = (steps.iter().copied().fold(f64::MAX, f64::min), steps.iter().copied().fold(0.0, f64::max));
        let is_logarithmic = least > 0.0 && most > 0.0 && most <= MOST_STRETCH * least;
        let places: Vec<f64> = if is_logarithmic {
            logarithms.iter().map(|value| value / least).collect()
        } else {
            (0..values.len()).map(|idx| idx as f64).collect()
        };
        let between = |left: usize, right: usize| 0.5 * (places[left] + places[right]);
        let last = places.len().saturating_sub(1);
        let (first_border, last_border) = match last {
            0 => (-0.5, 0.5),
            _ => (2.0 * places[0] - between(0, 1), 2.0 * places[last] - between(last - 1, last)),
        };
        let mut borders = vec![first_border];
        borders.extend((0..last).map(|idx| between(idx, idx + 1)));
        borders.push(last_border);
        let pixels = |place: &f64| (place - first_border) * least_cell;
        Scale {
            centres: places.iter().map(pixels).collect(),
            borders: borders.iter().map(pixels).collect(),
            is_logarithmic,
        }
    }

    fn length(&self) -> f64 {
        self.borders.last().copied().unwrap_or(0.0)
    }

    fn cell(&self, idx: usize) -> [f64; 2] {
        [self.borders[idx], self.borders[idx + 1]]
    }

    fn centre(&self, idx: usize) -> f64 {
        self.centres[idx]
    }
}

/// The scores that the palest and the darkest colour stand for.
struct Range {
    least: f64,
    most: f64,
}

impl Range {
    fn of(map: &HeatMap) -> Range {
        let shares = || map.cells.iter().map(|cell| cell.share);
        let (least, most) = (shares().fold(f64::INFINITY, f64::min), shares().fold(f64::NEG_INFINITY, f64::max));
        if most - least >= 0.001 {
            return Range { least, most };
        }
        // One score, or none: no difference to show, so none is made up.
        let middle = if most.is_finite() { 0.5 * (least + most) } else { 0.5 };
        Range { least: middle - 0.01, most: middle + 0.01 }
    }

    fn place(&self, share: f64) -> f64 {
        (share - self.least) / (self.most - self.least)
    }

    fn value(&self, place: f64) -> f64 {
        self.least + place * (self.most - self.least)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(firsts: &[f64], seconds: &[f64], shares: &[f64]) -> HeatMap {
        let axis = |name: &str, values: &[f64]| HeatMapAxis { name: name.into(), values: values.to_vec() };
        let pairs = seconds.iter().flat_map(|second| firsts.iter().map(move |first| [*first, *second]));
        let cell = |(at, share): ([f64; 2], &f64)| HeatMapCell {
            at,
            share: *share,
            note: "FP 8.1".into(),
            is_marked: *share == 0.9,
        };
        HeatMap {
            title: "A < B".into(),
            about: "made up".into(),
            quantity: "accuracy, %".into(),
            axes: [axis("c", firsts), axis("gamma", seconds)],
            cells: pairs.zip(shares).map(cell).collect(),
        }
    }

    #[test]
    fn every_pair_has_its_numbers_and_the_best_a_frame() {
        let shares = [0.7, 0.75, 0.8, 0.85, 0.9, 0.8];
        let svg = heat_map_svg(&map(&[1.0, 10.0, 100.0], &[0.1, 1.0], &shares));
        for expected in
            ["A &lt; B", ">c, logarithmic<", ">gamma, logarithmic<", ">100<", ">0.1<", ">70.0<", ">75.0<", ">90.0<"]
        {
            assert!(svg.contains(expected), "{expected} in {svg}");
        }
        assert_eq!(svg.matches(">FP 8.1<").count(), 6);
        assert_eq!((svg.matches("\"mark\"").count(), svg.matches("\"mark-outside\"").count()), (1, 1));
        assert!(svg.contains("framed: c 10, gamma 1: 90.0 %"), "{svg}");
        // The ends of the colours are the ends of the scores: each in one cell, and not in the scale's middles.
        for share in [0.0, 1.0] {
            assert_eq!(svg.matches(&hex(force_colour(share))).count(), 1);
        }
    }

    #[test]
    fn cells_follow_the_logarithm_unless_that_leaves_no_room() {
        let scale = Scale::of(&[1.0, 2.0, 8.0], 90.0);
        assert!(scale.is_logarithmic);
        for (found, expected) in scale.borders.iter().zip([0.0, 90.0, 225.0, 405.0]) {
            assert!((found - expected).abs() < 1e-9, "{:?}", scale.borders);
        }
        for (found, expected) in scale.centres.iter().zip([45.0, 135.0, 315.0]) {
            assert!((found - expected).abs() < 1e-9, "{:?}", scale.centres);
        }
        for values in [&[1.0, 1.1, 1000.0][..], &[0.0, 1.0, 2.0]] {
            let scale = Scale::of(values, 90.0);
            assert!(!scale.is_logarithmic);
            assert_eq!(scale.borders, [0.0, 90.0, 180.0, 270.0]);
        }
        assert_eq!(Scale::of(&[5.0], 90.0).borders, [0.0, 90.0]);
    }

    #[test]
    fn a_map_of_one_score_or_of_none_is_a_picture_too() {
        let one = heat_map_svg(&map(&[1.0], &[2.0], &[0.5]));
        assert!(one.contains(">50.0<") && !one.contains("NaN") && !one.contains("inf"), "{one}");
        let none = heat_map_svg(&map(&[1.0, 2.0], &[2.0], &[]));
        assert_eq!(none.matches(&hex(SILENT)).count(), 2, "{none}");
        assert!(!none.contains("NaN") && !none.contains("inf"), "{none}");
    }
}
