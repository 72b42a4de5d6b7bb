// Charts drawn as SVG, for reports and for the page of a graph: axes with ticks, lines, marks, intervals and bars. Colours are
// variables of the page's style sheet, so that charts follow its theme. Values beyond an axis are moved to its edge.

const FONT = "Inter, 'Segoe UI', 'Helvetica Neue', Helvetica, Arial, sans-serif";
const LEGEND_ROW = 20;
const ruler = document.createElement("canvas").getContext("2d");

const px = (value) => Math.round(value * 100) / 100;
const textWidth = (text, size) => {
  ruler.font = `${size}px ${FONT}`;
  return ruler.measureText(text).width;
};
const fitText = (text, size, width) => {
  if (textWidth(text, size) <= width) return text;
  let cut = text;
  while (cut && textWidth(`${cut}…`, size) > width) cut = cut.slice(0, -1);
  return `${cut.trimEnd()}…`;
};

// An element in a picture.
export const add = (parent, name, attributes, text = null) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  parent.append(element);
  return element;
};
export const write = (svg, text, x, y, anchor, attributes = {}) =>
  add(svg, "text", { x: px(x), y: px(y), "text-anchor": anchor, fill: "var(--soft)", "font-size": 12, ...attributes }, text);

// Texts that both pages write.
export const time = (nanos) => nanos < 1e6 ? `${(nanos / 1e3).toFixed(0)} µs` : nanos < 1e9 ? `${(nanos / 1e6).toFixed(1)} ms` : `${(nanos / 1e9).toFixed(1)} s`;
// The first round value from this one on.
export const roundUp = (value) => {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 1.5, 2, 2.5, 3, 4, 5, 6, 8].find((step) => step * power >= value * (1 - 1e-9)) ?? 10);
};
// About five round values of an axis, with their texts.
export const roundTicks = (from, to, textOf) => {
  const rough = Math.max((to - from) / 5, 1e-9), power = 10 ** Math.floor(Math.log10(rough)), ticks = [];
  const step = power * ([1, 2, 2.5, 5].find((step) => step * power >= rough) ?? 10);
  for (let n = Math.ceil(from / step - 1e-9); n <= to / step + 1e-9; n++) {
    const value = Number((n * step).toPrecision(12));
    ticks.push([value, textOf(value)]);
  }
  return ticks;
};

const shareOf = ({ from, to }, value) => Math.min(1, Math.max(0, (value - from) / Math.max(1e-12, to - from)));

// The grid and the names of two axes (`from`, `to`, `ticks`, `label`); gives where a value is. Bars have no axis to the right.
const drawAxes = (svg, { left, right, top, bottom }, x, y) => {
  const at = {
    x: (value) => px(left + shareOf(x, value) * (right - left)),
    y: (value) => px(bottom - shareOf(y, value) * (bottom - top)),
  };
  for (const [value, text] of y.ticks) {
    add(svg, "path", { d: `M${left} ${at.y(value)}H${right}`, stroke: "var(--line)" });
    write(svg, text, left - 8, at.y(value) + 4, "end");
  }
  const middle = px((top + bottom) / 2);
  if (y.label) write(svg, y.label, 22, middle, "middle", { transform: `rotate(-90 22 ${middle})`, "font-size": 13, fill: "var(--text)" });
  for (const [value, text] of x?.ticks ?? []) {
    add(svg, "path", { d: `M${at.x(value)} ${top}V${bottom}`, stroke: "var(--line)" });
    write(svg, text, at.x(value), bottom + 16, "middle");
  }
  add(svg, "path", { d: `M${left} ${top}V${bottom}H${right}`, fill: "none", stroke: "var(--soft)" });
  return at;
};

// Marks are told apart by their shape, too.
const shapes = [
  (x, y, r) => `M${px(x - r)} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`,
  (x, y, r) => `M${px(x - r)} ${px(y - r)}h${2 * r}v${2 * r}h${-2 * r}z`,
  (x, y, r) => `M${x} ${px(y - 1.2 * r)}l${px(1.2 * r)} ${2 * r}h${px(-2.4 * r)}z`,
  (x, y, r) => `M${x} ${px(y - 1.3 * r)}l${px(1.3 * r)} ${px(1.3 * r)}l${px(-1.3 * r)} ${px(1.3 * r)}l${px(-1.3 * r)} ${px(-1.3 * r)}z`,
];
const shape = (idx) => shapes[idx % shapes.length];

// One of `series`: `points` are joined by a line, dashed or not; `marks` are x, y and radius; `intervals` are x and both ends in y.
const drawSeries = (svg, at, { colour, points = [], isDashed, width = isDashed ? 1.3 : 2, marks = [], mark = 0, intervals = [], cap = 4 }) => {
  const stroke = `var(${colour})`;
  if (intervals.length) {
    const d = intervals.map(([x, low, high]) =>
      `M${at.x(x) - cap} ${at.y(low)}h${2 * cap}m${-cap} 0V${at.y(high)}m${-cap} 0h${2 * cap}`).join("");
    add(svg, "path", { d, stroke, fill: "none", "stroke-width": cap ? 1.4 : 1 });
  }
  if (points.length > 1) {
    const d = points.map(([x, y], idx) => `${idx ? "L" : "M"}${at.x(x)} ${at.y(y)}`).join("");
    const dashes = isDashed ? { "stroke-dasharray": "5 4" } : {};
    add(svg, "path", { d, stroke, fill: "none", "stroke-width": width, "stroke-linejoin": "round", ...dashes });
  }
  if (marks.length) {
    const d = marks.map(([x, y, radius]) => shape(mark)(at.x(x), at.y(y), px(radius))).join("");
    add(svg, "path", { d, fill: stroke, stroke: "var(--card)", "stroke-width": marks.length > 100 ? 0.4 : 1.2 });
  }
};

// A card with its title and a legend of the named series; gives where the axes may begin.
const drawHead = (svg, title, series, width, height) => {
  add(svg, "rect", { x: 0.5, y: 0.5, width: width - 1, height: height - 1, rx: 12, fill: "var(--card)", stroke: "var(--line)" });
  write(svg, fitText(title, 15, width - 40), 20, 28, "start", { "font-size": 15, "font-weight": 650, fill: "var(--text)" });
  const named = series.filter(({ name }) => name);
  let x = 20, y = 48;
  for (const { name, colour, heights, points = [], isDashed, marks = [], mark = 0 } of named) {
    const text = fitText(name, 12.5, width - 80), needed = textWidth(text, 12.5) + 48;
    if (x > 20 && x + needed > width - 10) [x, y] = [20, y + LEGEND_ROW];
    const fill = `var(${colour})`;
    if (heights) add(svg, "rect", { x: x + 5, y: y - 10, width: 14, height: 11, fill });
    else if (points.length) add(svg, "path", { d: `M${px(x)} ${y - 4}h22`, stroke: fill, "stroke-width": isDashed ? 1.3 : 2, ...(isDashed ? { "stroke-dasharray": "5 4" } : {}) });
    if (marks.length || !(heights || points.length)) add(svg, "path", { d: shape(mark)(px(x + 11), y - 4, 4.5), fill });
    write(svg, text, x + 28, y, "start", { "font-size": 12.5, fill: "var(--text)" });
    x += needed;
  }
  return named.length ? y + 18 : 48;
};

const beginChart = (svg, width, height, title) => {
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("font-family", FONT);
  svg.replaceChildren();
  if (title) add(svg, "title", {}, title);
};
const newSvg = (width, height) =>
  add(document.createDocumentFragment(), "svg", { class: "chart", role: "img", width, height });

// Series over two axes, in a new picture or in `svg`, which fills its `frame` without title and legend; gives picture and places.
export const lineChart = ({ svg = null, title = "", width, height, frame = null, x, y, series }) => {
  const picture = svg ?? newSvg(width, height);
  beginChart(picture, width, height, title);
  const own = frame ?? { left: 68, right: width - 24, top: drawHead(picture, title, series, width, height), bottom: height - 56 };
  const at = drawAxes(picture, own, x, y);
  write(picture, x.label, (own.left + own.right) / 2, height - (frame ? 4 : 16), "middle", frame ? {} : { "font-size": 13, fill: "var(--text)" });
  for (const one of series) drawSeries(picture, at, one);
  return { svg: picture, at };
};

// Groups of bars side by side: each of `series` has a bar in every group. Names that do not fit hang down at a slant.
export const barChart = ({ title, width, height, y, groups, series }) => {
  const svg = newSvg(width, height), [left, right] = [68, width - 24], slot = (right - left) / Math.max(1, groups.length);
  beginChart(svg, width, height, title);
  const longest = Math.min(140, Math.max(0, ...groups.map((group) => textWidth(group, 12)))), isSlanted = longest > slot - 4;
  const bottom = px(height - (isSlanted ? 0.75 * longest + 22 : 30));
  const at = drawAxes(svg, { left, right, top: drawHead(svg, title, series, width, height), bottom }, null, y);
  const bar = Math.min(40, 0.8 * slot / Math.max(1, series.length));
  groups.forEach((group, idx) => {
    const middle = left + (idx + 0.5) * slot;
    series.forEach(({ colour, heights }, n) => {
      const top = at.y(heights[idx]), x = px(middle + (n - series.length / 2) * bar + 0.5);
      add(svg, "rect", { x, y: top, width: px(bar - 1), height: px(bottom - top), fill: `var(${colour})` });
    });
    const text = fitText(group, 12, 140), [x, below] = [px(middle + 4), bottom + 14];
    if (isSlanted) write(svg, text, x, below, "end", { transform: `rotate(-45 ${x} ${below})` });
    else write(svg, text, middle, bottom + 18, "middle");
  });
  return svg;
};
