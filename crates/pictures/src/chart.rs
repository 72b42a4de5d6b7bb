//! Charts: lines, points with intervals, and bars, over axes with ticks. The caller says what range an axis has; whatever
//! lies outside is moved to its edge.

use super::svg::{Anchor, Svg, fit_text, px, text_width};

/// Points, lines and intervals over two axes.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Above it.
    pub title: String,
    /// Width and height, pixels.
    pub size: [f64; 2],
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
    /// What is drawn, the first one first.
    pub series: Vec<Series>,
}

/// Groups of bars side by side.
#[derive(Debug, Clone, PartialEq)]
pub struct BarChart {
    /// Above it.
    pub title: String,
    /// Width and height, pixels.
    pub size: [f64; 2],
    /// Upwards, from 0.
    pub y: Axis,
    /// Below each group.
    pub groups: Vec<String>,
    /// A bar of each in every group: name, colour, heights.
    pub series: Vec<(String, &'static str, Vec<f64>)>,
}

/// An axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// What it measures, with the unit.
    pub label: String,
    /// From where to where.
    pub range: [f64; 2],
    /// How its numbers are written.
    pub format: NumberFormat,
}

/// How numbers are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberFormat {
    /// 0.25 as 25.
    Percent,
    /// With thousands apart.
    Count,
}

/// What is drawn in one colour.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// In the legend; empty for none.
    pub name: String,
    /// `#rrggbb`.
    pub colour: &'static str,
    /// How its points are joined.
    pub line: Line,
    /// The points, x and y.
    pub points: Vec<[f64; 2]>,
    /// Discs: x, y and radius in pixels.
    pub discs: Vec<[f64; 3]>,
    /// Intervals: x, and the lower and the upper end in y.
    pub intervals: Vec<[f64; 3]>,
}

/// How points are joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// By a line.
    Solid,
    /// By a line for comparison.
    Dashed,
}

/// Colours for series: apart in lightness and hue.
pub const COLOURS: [&str; 6] = ["#1864ab", "#e8590c", "#2b8a3e", "#9c36b5", "#495057", "#c2255c"];

const STYLE: &str = ".chart text{font-family:Inter,'Segoe UI','Helvetica Neue',Helvetica,Arial,sans-serif;fill:#52606d;\
font-size:12px;font-weight:400;font-variant-numeric:tabular-nums}.chart text.chart-title{font-size:15px;font-weight:650;\
fill:#1f2933}.chart text.chart-label{font-size:13px;fill:#1f2933}.chart text.chart-legend{font-size:12.5px;fill:#1f2933}\
.chart .grid{stroke:#e9ecf0;stroke-width:1}.chart .edge{stroke:#9aa5b1;stroke-width:1;fill:none}\
.chart .series{fill:none;stroke-width:2;stroke-linejoin:round}.chart .dashed{stroke-dasharray:5 4;stroke-width:1.3}\
.chart .interval{stroke-width:1.4}.chart .disc{stroke:#ffffff;stroke-width:1.2}";

const LEFT: f64 = 68.0;
const RIGHT: f64 = 24.0;
const TITLE: f64 = 32.0;
const LEGEND_ROW: f64 = 20.0;

/// Where the axes are.
struct Frame {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

impl Frame {
    fn x(&self, axis: &Axis, value: f64) -> f64 {
        self.left + axis.share(value) * (self.right - self.left)
    }

    fn y(&self, axis: &Axis, value: f64) -> f64 {
        self.bottom - axis.share(value) * (self.bottom - self.top)
    }
}

impl Axis {
    /// How far along the axis a value is, 0 to 1.
    fn share(&self, value: f64) -> f64 {
        ((value - self.range[0]) / (self.range[1] - self.range[0]).max(1e-12)).clamp(0.0, 1.0)
    }

    /// About five round values within the range, as numbers and as they are written.
    fn ticks(&self) -> Vec<(f64, String)> {
        let [from, to] = self.range;
        let rough = ((to - from) / 5.0).max(1e-9);
        let power = 10_f64.powf(rough.log10().floor());
        let step = power * [1.0, 2.0, 2.5, 5.0, 10.0].into_iter().find(|step| step * power >= rough).unwrap_or(10.0);
        let first = (from / step - 1e-9).ceil() as i64;
        let last = (to / step + 1e-9).floor() as i64;
        (first..=last).map(|idx| idx as f64 * step).map(|value| (value, self.format.text(value))).collect()
    }
}

impl NumberFormat {
    fn text(self, value: f64) -> String {
        let rounded = |value: f64| ((value * 1e6).round() / 1e6 + 0.0).to_string().replace('-', "−");
        match self {
            NumberFormat::Percent => rounded(100.0 * value),
            NumberFormat::Count => {
                let digits = rounded(value);
                if digits.bytes().all(|byte| byte.is_ascii_digit()) { thousands(&digits) } else { digits }
            }
        }
    }
}

/// Digits with commas between thousands.
pub fn thousands(digits: &str) -> String {
    let mut text = String::new();
    for (idx, digit) in digits.chars().enumerate() {
        if idx > 0 && (digits.len() - idx).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// The smallest range from 0 that holds all values and ends at a round number; to 1 without values.
pub fn range_from_zero(values: impl IntoIterator<Item = f64>) -> [f64; 2] {
    let most = values.into_iter().fold(0.0, f64::max);
    if most <= 0.0 {
        return [0.0, 1.0];
    }
    let power = 10_f64.powf(most.log10().floor());
    let steps = [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0];
    [0.0, power * steps.into_iter().find(|step| step * power >= most * (1.0 - 1e-9)).unwrap_or(10.0)]
}

/// A chart as SVG: a light card, whatever is behind it.
pub fn chart_svg(chart: &Chart) -> String {
    let [width, height] = chart.size;
    let mut svg = Svg::default();
    svg.start("g", &[("class", &"chart")]);
    let named = chart.series.iter().filter(|series| !series.name.is_empty());
    let names: Vec<Named<'_>> = named.map(|series| (series.name.as_str(), series.colour, swatch(series))).collect();
    let top = draw_head(&mut svg, &chart.title, &names, width);
    let frame = Frame { left: LEFT, right: width - RIGHT, top, bottom: height - 56.0 };
    draw_y_axis(&mut svg, &frame, &chart.y);
    for (value, text) in chart.x.ticks() {
        let x = px(frame.x(&chart.x, value));
        svg.element(
            "line",
            &[("x1", &x), ("x2", &x), ("y1", &px(frame.top)), ("y2", &px(frame.bottom)), ("class", &"grid")],
        );
        svg.text([x, frame.bottom + 18.0], Anchor::Middle, "", &text);
    }
    svg.text([(frame.left + frame.right) / 2.0, frame.bottom + 40.0], Anchor::Middle, "chart-label", &chart.x.label);
    draw_edge(&mut svg, &frame);
    for series in &chart.series {
        draw_series(&mut svg, &frame, chart, series);
    }
    svg.end("g");
    svg.finish(width, height, &chart.title, STYLE)
}

/// A bar chart as SVG: a light card, whatever is behind it.
pub fn bar_chart_svg(chart: &BarChart) -> String {
    let [width, height] = chart.size;
    let mut svg = Svg::default();
    svg.start("g", &[("class", &"chart")]);
    let named = chart.series.iter().filter(|(name, _, _)| !name.is_empty());
    let names: Vec<Named<'_>> = named.map(|(name, colour, _)| (name.as_str(), *colour, Swatch::Bar)).collect();
    let top = draw_head(&mut svg, &chart.title, &names, width);
    let slot = (width - LEFT - RIGHT) / chart.groups.len().max(1) as f64;
    let longest = chart.groups.iter().map(|group| text_width(group, 12.0)).fold(0.0, f64::max).min(140.0);
    // Names that don't fit side by side hang down at a slant.
    let is_slanted = longest > slot - 4.0;
    let below = if is_slanted { 0.75 * longest + 22.0 } else { 30.0 };
    let frame = Frame { left: LEFT, right: width - RIGHT, top, bottom: height - below };
    draw_y_axis(&mut svg, &frame, &chart.y);
    let bar = (0.8 * slot / chart.series.len().max(1) as f64).min(40.0);
    for (group_idx, group) in chart.groups.iter().enumerate() {
        let middle = frame.left + (group_idx as f64 + 0.5) * slot;
        for (idx, (_, colour, heights)) in chart.series.iter().enumerate() {
            let height = heights.get(group_idx).copied().unwrap_or(0.0);
            let left = middle + (idx as f64 - chart.series.len() as f64 / 2.0) * bar;
            let top = frame.y(&chart.y, height);
            svg.element(
                "rect",
                &[
                    ("x", &px(left + 0.5)),
                    ("y", &px(top)),
                    ("width", &px(bar - 1.0)),
                    ("height", &px(frame.bottom - top)),
                    ("fill", colour),
                ],
            );
        }
        let text = fit_text(group, 12.0, 140.0);
        if is_slanted {
            let (x, y) = (px(middle + 4.0), px(frame.bottom + 14.0));
            let transform = format!("rotate(-45 {x} {y})");
            svg.text_with([x, y], Anchor::End, "", &text, &[("transform", &transform)]);
        } else {
            svg.text([middle, frame.bottom + 18.0], Anchor::Middle, "", &text);
        }
    }
    draw_edge(&mut svg, &frame);
    svg.end("g");
    svg.finish(width, height, &chart.title, STYLE)
}

/// The sign of a series in the legend.
#[derive(Clone, Copy)]
enum Swatch {
    Bar,
    Line(Line),
    Disc,
}

/// A series in the legend: name, colour, sign.
type Named<'a> = (&'a str, &'a str, Swatch);

fn swatch(series: &Series) -> Swatch {
    if series.points.is_empty() && !series.discs.is_empty() { Swatch::Disc } else { Swatch::Line(series.line) }
}

/// Title and legend; returns where the axes may begin.
fn draw_head(svg: &mut Svg, title: &str, names: &[Named<'_>], width: f64) -> f64 {
    svg.text([20.0, TITLE - 4.0], Anchor::Start, "chart-title", &fit_text(title, 15.0, width - 40.0));
    let (mut x, mut y) = (20.0, TITLE + 16.0);
    for (name, colour, swatch) in names {
        let name = fit_text(name, 12.5, width - 80.0);
        let needed = 30.0 + text_width(&name, 12.5) + 18.0;
        if x + needed > width - 10.0 && x > 20.0 {
            (x, y) = (20.0, y + LEGEND_ROW);
        }
        match swatch {
            Swatch::Bar => {
                let (left, top) = (px(x + 5.0), px(y - 10.0));
                svg.element("rect", &[("x", &left), ("y", &top), ("width", &14), ("height", &11), ("fill", colour)]);
            }
            Swatch::Disc => {
                let (cx, cy) = (px(x + 14.0), px(y - 4.0));
                svg.element("circle", &[("cx", &cx), ("cy", &cy), ("r", &4.5), ("class", &"disc"), ("fill", colour)]);
            }
            Swatch::Line(line) => {
                let class = if *line == Line::Dashed { "series dashed" } else { "series" };
                let line = format!("M{} {}h22", px(x), px(y - 4.0));
                svg.element("path", &[("d", &line), ("class", &class), ("stroke", colour)]);
            }
        }
        svg.text([x + 28.0, y], Anchor::Start, "chart-legend", &name);
        x += needed;
    }
    if names.is_empty() { TITLE + 16.0 } else { y + 18.0 }
}

fn draw_y_axis(svg: &mut Svg, frame: &Frame, axis: &Axis) {
    for (value, text) in axis.ticks() {
        let y = px(frame.y(axis, value));
        svg.element(
            "line",
            &[("x1", &px(frame.left)), ("x2", &px(frame.right)), ("y1", &y), ("y2", &y), ("class", &"grid")],
        );
        svg.text([frame.left - 8.0, y + 4.0], Anchor::End, "", &text);
    }
    let (x, y) = (22.0, px((frame.top + frame.bottom) / 2.0));
    let transform = format!("rotate(-90 {x} {y})");
    svg.text_with([x, y], Anchor::Middle, "chart-label", &axis.label, &[("transform", &transform)]);
}

fn draw_edge(svg: &mut Svg, frame: &Frame) {
    let edge = format!("M{} {}V{}H{}", px(frame.left), px(frame.top), px(frame.bottom), px(frame.right));
    svg.element("path", &[("d", &edge), ("class", &"edge")]);
}

fn draw_series(svg: &mut Svg, frame: &Frame, chart: &Chart, series: &Series) {
    let at = |x: f64, y: f64| (px(frame.x(&chart.x, x)), px(frame.y(&chart.y, y)));
    for [x, low, high] in &series.intervals {
        let ((x, low), (_, high)) = (at(*x, *low), at(*x, *high));
        let line = format!("M{} {low}h8m-4 0V{high}m-4 0h8", px(x - 4.0));
        svg.element("path", &[("d", &line), ("class", &"series interval"), ("stroke", &series.colour)]);
    }
    if series.points.len() > 1 {
        let line: String = series
            .points
            .iter()
            .enumerate()
            .map(|(idx, [x, y])| {
                let (x, y) = at(*x, *y);
                format!("{}{x} {y}", if idx == 0 { 'M' } else { 'L' })
            })
            .collect();
        let class = if series.line == Line::Dashed { "series dashed" } else { "series" };
        svg.element("path", &[("d", &line), ("class", &class), ("stroke", &series.colour)]);
    }
    for [x, y, radius] in &series.discs {
        let (x, y) = at(*x, *y);
        svg.element(
            "circle",
            &[("cx", &x), ("cy", &y), ("r", &px(*radius)), ("class", &"disc"), ("fill", &series.colour)],
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(range: [f64; 2], format: NumberFormat) -> Axis {
        Axis { label: "a & b (%)".into(), range, format }
    }

    #[test]
    fn ticks_are_round_and_within_the_range() {
        for (range, format, expected) in [
            ([0.0, 1.0], NumberFormat::Percent, vec!["0", "20", "40", "60", "80", "100"]),
            ([0.0, 0.25], NumberFormat::Percent, vec!["0", "5", "10", "15", "20", "25"]),
            ([0.7, 0.93], NumberFormat::Percent, vec!["70", "75", "80", "85", "90"]),
            ([0.0, 16_000.0], NumberFormat::Count, vec!["0", "5,000", "10,000", "15,000"]),
            ([-1.0, 1.0], NumberFormat::Count, vec!["−1", "−0.5", "0", "0.5", "1"]),
        ] {
            let found: Vec<String> = axis(range, format).ticks().into_iter().map(|(_, text)| text).collect();
            assert_eq!(found, expected);
        }
        assert_eq!(range_from_zero([0.03, 0.21]), [0.0, 0.25]);
        assert_eq!(range_from_zero([]), [0.0, 1.0]);
    }

    #[test]
    fn a_point_is_drawn_where_it_belongs() {
        let chart = Chart {
            title: "T < 1".into(),
            size: [68.0 + 24.0 + 200.0, 300.0],
            x: axis([0.0, 2.0], NumberFormat::Count),
            y: axis([0.0, 1.0], NumberFormat::Percent),
            series: vec![Series {
                name: String::new(),
                colour: COLOURS[0],
                line: Line::Solid,
                points: vec![[0.0, 0.0], [2.0, 5.0]],
                discs: vec![[1.0, 0.5, 3.0]],
                intervals: vec![[1.0, 0.25, 0.75]],
            }],
        };
        let svg = chart_svg(&chart);
        // The axes span 48 to 244 downwards and 68 to 268 to the right; 5 is moved to the edge.
        for expected in ["M68 244L268 48", "cx=\"168\" cy=\"146\"", "M164 195h8m-4 0V97", "T &lt; 1", "a &amp; b"] {
            assert!(svg.contains(expected), "{expected}: {svg}");
        }
    }

    #[test]
    fn every_group_has_its_bars_and_its_name() {
        let chart = BarChart {
            title: "Errors".into(),
            size: [250.0, 300.0],
            y: axis([0.0, 0.5], NumberFormat::Percent),
            groups: vec!["mug".into(), "a class with quite a long name".into()],
            series: vec![("errors".into(), COLOURS[0], vec![0.5, 0.25]), ("both".into(), COLOURS[1], vec![0.1, 0.0])],
        };
        let svg = bar_chart_svg(&chart);
        // The card, two swatches, four bars.
        assert_eq!(svg.matches("<rect").count(), 1 + 2 + 4);
        assert!(svg.contains(">mug<") && svg.contains("rotate(-45") && svg.contains("height=\"0\""), "{svg}");
    }
}
