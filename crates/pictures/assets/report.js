// Draws a report from its data, which are in the page as JSON. Texts are never read as HTML: names come from strangers.
const byId = (id) => document.getElementById(id);
// Whole numbers that a number of JavaScript cannot hold, such as seeds, stay texts.
const read = (json) => JSON.parse(json.replace(/"(?:\\.|[^"\\])*"|-?[\d.]+(?:[eE][+-]?\d+)?/g,
  (token) => (/^-?\d{16,}$/.test(token) ? `"${token}"` : token)));
const { kind, data, drawn } = read(byId("report").textContent);
const main = document.querySelector("main");

// --- parts of a page
const make = (name, attributes = {}, ...children) => {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children.flat(Infinity));
  return element;
};
const caption = (...texts) => make("p", { class: "caption" }, ...texts);
const begin = (title, ...lead) => {
  document.title = title;
  main.append(make("h1", {}, title), make("p", { class: "lead" }, ...lead));
};
const section = (title, ...children) => main.append(make("section", {}, make("h2", {}, title), ...children));
// The first column holds texts, the others numbers. A cell is a text, or a list of texts and elements.
const table = (head, rows, { isOwn = () => false } = {}) => {
  const cells = (name, texts) => texts.map((text, idx) => make(name, { ...(name === "th" ? { scope: "col" } : {}), ...(idx < 1 ? {} : { class: "number" }) }, text));
  const body = rows.map((row, idx) => make("tr", isOwn(idx) ? { class: "own" } : {}, cells("td", row)));
  // On a small screen it is scrolled, also by keys.
  return make("div", { class: "scroll", tabindex: 0 },
    make("table", {}, make("thead", {}, make("tr", {}, cells("th", head))), make("tbody", {}, body)));
};
const facts = (pairs) => make("dl", {}, pairs.map(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
// The picture as a file: the colours of the page are written into it.
const svgText = (svg) => {
  const shades = getComputedStyle(document.documentElement);
  return new XMLSerializer().serializeToString(svg).replace(/var\((--[\w-]+)\)/g, (_, name) => shades.getPropertyValue(name).trim());
};
const figure = (picture, text = "") => {
  const save = make("button", { type: "button", class: "save" }, "Save as SVG");
  save.addEventListener("click", () => {
    const name = picture.querySelector("title").textContent.toLowerCase().replace(/[^a-z0-9]+/g, "-");
    make("a", { download: `${name}.svg`, href: URL.createObjectURL(new Blob([svgText(picture)], { type: "image/svg+xml" })) }).click();
  });
  return make("figure", { tabindex: 0 }, picture, save, text ? make("figcaption", { class: "caption" }, text) : []);
};
// Two beside each other.
const pairs = (pictures) => main.append(make("div", { class: "pairs" }, pictures.map((picture) => figure(picture))));

// --- numbers as people write them
// Of an exact tie the even digit, as the numbers on the console have it.
const fixed = (value, n_digits) => {
  const exact = value.toFixed(n_digits + 25), cut = exact.slice(0, -25).replace(/\.$/, "");
  return /^50*$/.test(exact.slice(-25)) && "02468".includes(cut.at(-1)) ? cut : value.toFixed(n_digits);
};
const minus = (text) => text.replace("-", "−");
const thousands = (n) => String(n).replace(/\B(?=(\d{3})+$)/g, ",");
const count = (n) => thousands(fixed(n, 0));
const number = (share) => minus(fixed(100 * share, 1));
const percent = (share) => `${number(share)} %`;
const part = (n, of) => (of > 0 ? percent(n / of) : "–");
const decimals = (value) => (value == null ? "–" : fixed(value, 3));
const pValue = (p) => (p >= 0.001 ? fixed(p, 3) : minus(p.toExponential(1)));
const small = (text) => make("span", { class: "interval" }, text);
// A share with its interval.
const estimate = (found) => {
  if (!found) return ["–"];
  const { value, interval } = found;
  return interval ? [percent(value), " ", small(`(${number(interval.low)}${interval.low < 0 ? " to " : "–"}${number(interval.high)})`)] : [percent(value)];
};
const spoken = (name) => name.replaceAll("_", " ");
const bold = (text) => make("b", {}, text);

// --- axes
const plain = (value) => { const text = minus(String(value)); return /^\d+$/.test(text) ? thousands(text) : text; };
const axis = (label, from, to) => ({ label, from, to, ticks: roundTicks(from, to, plain) });
const percentAxis = (label, to = 1) =>
  ({ label, from: 0, to, ticks: roundTicks(0, to, (share) => plain(Number((100 * share).toPrecision(6)))) });
const seriesColour = (idx) => `--series-${idx % 6}`;
const guide = (points) => ({ colour: "--soft", isDashed: true, points });
const HALF = { width: 566, height: 430 };

// --- the report of an evaluation
const evaluation = (report) => {
  const { made, judges } = report, n_held = report.data.n_held_unjudged, first = judges[0];
  const isSimulated = Object.values(made.labels).reduce((a, b) => a + b, 0);
  const world = isSimulated > 0 && isSimulated === made.recordings.length ? " in simulation" : "";
  begin(evaluationTitle(report), ...(first ? evaluationLead(report, first) : []));
  section(`Table I: learning performance${world}`, tableOne(report),
    caption("False positives as a share of all grasps, as the paper’s text has them (8.6 %). ",
      n_held > 0 ? `${count(n_held)} grasps were held without a judgement (no cell feels them, say), of which ${count(report.data.n_held_unjudged_stable)} are stable: they count as decided in the rows that say so, and nowhere else. ` : "",
      made.split ? "Each grasp is judged once, in the fold that holds it." : ""));
  section("Decisions", measures(report), caption(
    judges.map(({ name, about, threshold_probability }) => `${name}: ${about}; lifts from probability ${threshold_probability} on`).join(". "), ". ",
    n_held > 0 ? "All: with the grasps held without a judgement. " : "",
    `Positive is stable. Deciding always the same would be right for ${first?.judged.majority == null ? "none" : percent(first.judged.majority)}. Intervals are ${made.intervals}.`));
  if (report.looks?.length) section("By stage", stages(report.looks));
  if (report.baselines) section("Beside plain rules", plainRules(report.baselines));
  if (report.comparisons.length) section("Compared with each other", comparisons(report));
  pairs([roc(judges), precisionRecall(judges), reliability(judges), thresholds(judges)]);
  const highest = roundUp(Math.max(0, ...judges.flatMap(({ by_class }) => by_class.map(({ error_share }) => error_share))));
  main.append(...judges.map((judge) => figure(errorsByClass(judge, highest))));
  if (report.figure_1) {
    const picture = make("img", { src: `data:image/svg+xml,${encodeURIComponent(report.figure_1)}`, alt: "The words of the contact dictionary over the hand" });
    main.append(make("figure", { tabindex: 0 }, picture, make("figcaption", { class: "caption" },
      `As the paper’s Figure 1. The dictionary is ${report.dictionary.from}; each word stands for the contacts nearest to it. The hand is in the median posture of the grasps.`)));
  }
  if (first) {
    const head = ["class", "grasps", ...judges.map(({ name }) => `${name}\nerrors, false positives`)];
    const rows = first.by_class.map((of, idx) => [of.class, count(of.n_grasps), ...judges.map(({ by_class }) => by_class[idx]).filter(Boolean)
      .map((own) => `${percent(own.error_share)} (${own.n_wrong}), ${percent(own.false_positive_share)} (${own.n_false_positive})`)]);
    section("By class", make("details", {}, make("summary", {}, "The numbers of Figure 2"), table(head, rows)));
  }
  section("How this was made", facts(howMade(report)));
};
const evaluationTitle = ({ made, judges }) => {
  const names = judges.map(({ name }) => name);
  if (!made.split) return names.length === 1 ? `What ${names[0]} is worth` : `Will the grasp hold? ${names.join(", ")} judged on the same grasps`;
  return `Will the grasp hold? ${made.predictions ? names.join(", ") : "Recipes"} judged on grasps held out`;
};
const evaluationLead = ({ made, comparisons }, best) => {
  const whose = { grasp: "held out", object: "of objects never seen in training", class: "of classes never seen in training" }[made.split?.by] ?? "of these recordings";
  const { accuracy, n_grasps, false_positive_share } = best.judged;
  const against = comparisons.filter(({ first, relative_error_reduction }) => first === best.name && relative_error_reduction)
    .map(({ second, relative_error_reduction: fewer }, idx) => [idx ? ", " : " Errors: ",
      fewer.value < 0 ? `${percent(-fewer.value)} more than ` : [estimate(fewer), " fewer than "], bold(second)]);
  return [bold(best.name), " decides ", estimate(accuracy), ` of ${count(n_grasps)} grasps ${whose} rightly; `, estimate(false_positive_share),
    " of them are false positives, unstable grasps that it would lift.", against, against.length ? "." : ""];
};
const tableOne = ({ table_1 }) => table(
  ["Data set", "grasps", "stable grasps", "unstable grasps", "accuracy", "false positives"],
  table_1.map((row) => [`${row.of_paper ? "Dang & Allen: " : ""}${row.data_set}`, count(row.n_grasps), `${count(row.n_stable)} (${percent(row.stable_share)})`,
    count(row.n_unstable), estimate(row.accuracy), estimate(row.false_positive_share)]),
  { isOwn: (idx) => !table_1[idx].of_paper });
const measures = ({ judges, data: { n_held_unjudged } }) => {
  const row = ({ name, roc_auc, average_precision, reliability }, which, m, isCurve) => [`${name}${which}`,
    ...[m.accuracy, m.precision, m.recall].map(estimate), decimals(m.f1), ...[m.false_positive_share, m.false_positive_rate].map(estimate),
    ...[roc_auc, average_precision, reliability?.brier, reliability?.ece].map((value) => (isCurve ? decimals(value) : "–"))];
  const rows = judges.map((judge) => row(judge, "", judge.judged, true));
  if (n_held_unjudged > 0) rows.push(...judges.map((judge) => row(judge, ", all", judge.all, false)));
  return table(["judged grasps", "accuracy", "precision", "recall", "F1", "false positives\nof all", "false positives\nof unstable", "ROC area",
    "average\nprecision", "Brier\nscore", "calibration\nerror"], rows, { isOwn: (idx) => idx < judges.length });
};
const plainRules = ({ look, n_grasps, false_positive_rate, rules }) => [
  table(["rule", "ROC area", "recall"], rules.map(({ name, roc_area, recall }) => [name, decimals(roc_area), percent(recall)])),
  caption(`${count(n_grasps)} grasps, ${look.replaceAll("_", "-")}. Of the unstable ones the model lifts ${percent(false_positive_rate)}, and no rule ` +
    "more. A rule’s threshold is the best one on these grasps."),
];
const stages = (looks) => [
  table(["stage", "grasps", "stable", "ROC area", "calibration\nerror", "lifted by\nthe thresholds", "stable ones\nof these"],
    looks.map(({ look, n_grasps, n_stable, roc_area, ece, n_lifted, n_kept }) => [look.replaceAll("_", "-"), count(n_grasps), part(n_stable, n_grasps),
      decimals(roc_area), decimals(ece), `${count(n_lifted)} (${part(n_lifted, n_grasps)})`, `${count(n_kept)} (${part(n_kept, n_lifted)})`])),
  caption("Of the grasps that some cell feels, each by one frame. Votes and the limits of the training data are not considered: the graph lifts fewer."),
];
const comparisons = ({ comparisons, made }) => [
  table(["pair", "fewer errors", "accuracy gained", "only one right", "McNemar’s p", "at recall", "false positives", "fewer"],
    comparisons.map((pair) => {
      const equal = pair.at_equal_recall;
      return [`${pair.first} against ${pair.second}`, estimate(pair.relative_error_reduction), estimate(pair.accuracy_difference),
        `${count(pair.n_only_first_right)} : ${count(pair.n_only_second_right)}`, pValue(pair.mcnemar_p), equal ? percent(equal.recall) : "–",
        equal ? `${count(equal.first.n_false_positive)} : ${count(equal.second.n_false_positive)}` : "–", estimate(equal?.relative_reduction)];
    })),
  caption(`The same grasps${made.split ? ", the same folds" : ""}. Fewer errors: by which share of the second one’s errors the first one’s are fewer. Only one right: grasps that only the first, and only the second, decides rightly; McNemar’s exact test on them takes grasps as independent, the intervals do not. The last columns compare false positives where both lift as many of the stable grasps, at the recall that the second has at its threshold.`),
];
const howMade = (report) => {
  const { made, data } = report, { split } = made;
  const listed = (counts, word) => Object.entries(counts).map(([name, n]) => `${n}${word} ${spoken(name)}`).join(", ");
  const names = made.recordings, makers = Object.entries(made.made_by).map(([maker, n], idx) => [idx ? make("br") : [], `${n} by `, make("code", {}, maker)]);
  return [
    ["command", make("code", {}, made.command)], ["version", `blindgrasp ${made.version}`], ["hand", made.hand],
    ...(split ? [["split", `by ${split.by}, ${split.n_folds} folds, seed ${split.seed}. Dictionary, scaling and classifier of a recipe are learned from the other folds alone; the calibration, too, on decision values out of ${split.n_calibration_folds} inner folds, split alike.`]] : []),
    ...(made.predictions ? [["predictions", `${made.predictions}, taken as they are: the outside model must have made each one without having seen the grasp`]] : []),
    ["grasps", `${count(data.n_grasps)} with a label, of ${count(data.n_objects)} objects in ${count(data.n_classes)} classes; ${count(data.n_judged)} judged, ${count(data.n_held_unjudged)} held without a judgement`],
    ["left out", listed(data.n_excluded, " with") || "none"],
    ...(report.by_reason ? [["decisions", listed(report.by_reason, "")]] : []),
    ["intervals", made.intervals], ["recordings", names.length > 8 ? `${names.length}: ${names[0]} to ${names.at(-1)}` : names.join(", ")],
    ["made by", makers], ...(report.label ? [["label", report.label]] : []),
  ];
};

// --- the curves of an evaluation
const withNumber = (name, what, value) => (value == null ? name : `${name}, ${what} ${fixed(value, 3)}`);
const curves = (title, x, y, series) => lineChart({ title, ...HALF, x: percentAxis(x), y: percentAxis(y), series }).svg;
const threshold = (x, y) => (x && y ? [[x.value, y.value, 5.5]] : []);
const roc = (judges) => curves("Receiver operating characteristic (mark: the threshold)", "unstable grasps that are lifted (%)", "stable grasps that are lifted (%)",
  [guide([[0, 0], [1, 1]]), ...judges.map(({ name, roc_auc, curve, judged }, idx) => ({
    name: withNumber(name, "area", roc_auc), colour: seriesColour(idx), mark: idx,
    points: [[0, 0], ...curve.map((point) => [point.false_positive_rate, point.recall])], marks: threshold(judged.false_positive_rate, judged.recall),
  }))]);
const precisionRecall = (judges) => {
  const all = judges[0]?.curve.find(({ recall }) => recall >= 1 - 1e-12);
  return curves("Precision over recall (mark: the threshold)", "recall: stable grasps that are lifted (%)", "precision: lifted grasps that are stable (%)",
    [...(all ? [guide([[0, all.precision], [1, all.precision]])] : []), ...judges.map(({ name, average_precision, curve, judged }, idx) => ({
      name: withNumber(name, "average", average_precision), colour: seriesColour(idx), mark: idx,
      points: curve.map(({ recall, precision }) => [recall, precision]), marks: threshold(judged.recall, judged.precision),
    }))]);
};
const reliability = (judges) => curves("Reliability: what a probability is worth", "probability of stable, mean of a bin (%)", "grasps of the bin that are stable (%)",
  [guide([[0, 0], [1, 1]]), ...judges.flatMap(({ name, reliability }, idx) => {
    if (!reliability) return [];
    const most = Math.max(1, ...reliability.bins.map(({ n }) => n)), points = reliability.bins.map((bin) => [bin.mean_probability, bin.share_positive]);
    const marks = reliability.bins.map(({ n }, at) => [...points[at], 5 * Math.sqrt(n / most)]);
    return [{ name: withNumber(name, "calibration error", reliability.ece), colour: seriesColour(idx), mark: idx, points, marks }];
  })]);
const thresholds = (judges) => curves("What another threshold would do", "lift from this probability on (%)", "unstable grasps lifted, stable ones held (%)",
  judges.flatMap(({ name, curve }, idx) => [
    { name: `${name}, lifted`, colour: seriesColour(idx), points: curve.map((point) => [point.threshold, point.false_positive_rate]) },
    { name: `${name}, held`, colour: seriesColour(idx), isDashed: true, points: curve.map((point) => [point.threshold, 1 - point.recall]) },
  ]));
const errorsByClass = ({ name, by_class }, highest) => barChart({
  title: `Figure 2: errors and false positives by class, ${name}`, width: 1152, height: 330, y: percentAxis("share of the class’s grasps (%)", highest),
  groups: by_class.map((of) => of.class),
  series: [
    { name: "errors", colour: "--series-0", heights: by_class.map(({ error_share }) => error_share) },
    { name: "false positives", colour: "--series-1", heights: by_class.map(({ false_positive_share }) => false_positive_share) },
  ],
});

// --- a hand in three dimensions, on a canvas that can be turned
const stageView = (label, name) => {
  const save = make("button", { type: "button", class: "save" }, "Save picture");
  save.addEventListener("click", () => blindgrasp.hand?.savePicture(name.toLowerCase().replace(/[^a-z0-9]+/g, "-")));
  return [
    make("div", { class: "view" }, make("canvas", { id: "stage", tabindex: 0, role: "img", "aria-label": `${label} Drag or arrow keys turn it, plus and minus zoom, Home resets the view.` })),
    make("p", { id: "without-webgl", class: "caption", hidden: "" }, "This browser has no WebGL: the hand cannot be drawn."), save,
  ];
};
const forceScale = () => {
  const bar = make("span", { class: "bar" });
  bar.style.background = `linear-gradient(to right, ${drawn.colours.map((shade) => `rgb(${shade.join(" ")})`).join(", ")})`;
  return caption("Force of a cell: 0 ", bar, ` ${drawn.scale_newtons} ${drawn.cell_unit}. The axes are those of the palm.`);
};
// The modules are in the page.
const loadStage = async () => {
  const load = (id) => import(URL.createObjectURL(new Blob([byId(id).textContent], { type: "text/javascript" })));
  return { three: await load("three.js"), ...await load("stage.js") };
};

// --- frames: a card each, and the one that is chosen on the stage
const cardRow = (frames, from, height) => make("div", { class: "cards" }, frames.map(({ title }, idx) =>
  make("button", { type: "button", class: "card", "data-frame": from + idx, "aria-pressed": false },
    make("canvas", { width: 280, height, "aria-hidden": true }), make("b", {}, title))));
const cardView = (...captions) => [stageView("The hand of the chosen picture in three dimensions.", "hand"), make("p", { id: "chosen", class: "caption" }), captions];
const drawCards = async () => {
  const { three, colourStep, makeStage } = await loadStage();
  const buttons = [...document.querySelectorAll("[data-frame]")], stage = makeStage(three, byId("stage"));
  if (!stage.renderer) byId("without-webgl").hidden = false;
  Object.assign(blindgrasp, { hand: stage, shown: null, drawn: 0 });
  // Trials look at the post from its side.
  if (kind === "trials") stage.lookFrom(-0.94);
  stage.build(drawn);
  stage.fit(drawn.frames.map(({ links }) => links));
  const colourOf = (newtons, idx) => drawn.colours[colourStep(drawn, newtons, idx, drawn.scale_newtons)] ?? drawn.silent_colour;
  const show = (idx) => {
    const { title, links, cells } = drawn.frames[idx];
    stage.show({ links, contacts: [], gravity: null }, cells.map(colourOf));
    blindgrasp.shown = title;
  };
  let chosen = 0;
  const choose = (idx) => {
    chosen = idx;
    show(idx);
    buttons.forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.frame) === idx)));
    byId("chosen").textContent = `${drawn.frames[idx].title}. A click on a card shows another one. Drag or arrow keys: turn. Double click: back.`;
  };
  for (const button of buttons) button.addEventListener("click", () => choose(Number(button.dataset.frame)));
  // One after the other, so that the page can be used meanwhile.
  for (const button of buttons) {
    await new Promise(requestAnimationFrame);
    show(Number(button.dataset.frame));
    stage.drawTo(button.querySelector("canvas"));
    blindgrasp.drawn += 1;
  }
  choose(chosen);
};

// --- the report of trials
const trials = ({ lead, tables, strips, made }) => {
  begin("Lift trials", lead);
  for (const { title, head, rows } of tables) section(title, table(head, rows));
  if (strips.length) {
    let from = 0;
    const rows = strips.map(({ caption: text, n_moments }) => {
      const row = make("figure", {}, cardRow(drawn.frames.slice(from, from + n_moments), from, 300), make("figcaption", { class: "caption" }, text));
      from += n_moments;
      return row;
    });
    section("Some of the trials", cardView(), rows);
  }
  section("How this was made", facts(made));
};

// Tests read it.
window.blindgrasp = { read, count, percent, decimals, pValue, estimate: (found) => make("p", {}, estimate(found)).textContent,
  axis, percentAxis, roundUp, lineChart, barChart };
({ evaluation, grasp: graspPage, trials })[kind](data);
if (kind === "grasp") await drawGrasp();
else if (drawn) await drawCards();
