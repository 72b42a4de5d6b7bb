// The chart over time: the probability that the grasp is stable, or the force of each pad. It is drawn from moments: `secs` on the
// axis, `probabilities`, `shadow`, `forces` (one of each pad) and `decisions`.

// Labels of decisions that are nearer would overlap.
const LABEL_PX = 32;

// The dashed lines in words.
const dashesOf = ({ threshold, unsure_from }) => {
  const unsure = unsure_from < threshold ? `unsure from ${unsure_from.toFixed(2)} on, ` : "";
  return `dashed, the model's thresholds: ${unsure}stable ${threshold < 1 ? `from ${threshold.toFixed(2)} on` : "only after a probe"}`;
};

// `ticks` are pairs of seconds and text; `cursor` are the seconds of the moment that is shown, or null.
const drawChart = ({ moments, from, to, ticks, title, cursor, scene, model, hasShadow }) => {
  const svg = byId("chart"), { width, height } = svg.getBoundingClientRect();
  const isForce = byId("quantity").value === "force", pads = scene?.pad_names ?? [];
  let most = 1;
  if (isForce) for (const { forces } of moments) for (const newtons of forces ?? []) most = Math.max(most, newtons);
  if (isForce) most = roundUp(most);
  // Of several values at a time, a line from the least to the most, and a mark at the last one.
  const values = (colour, valuesOf) => {
    const marks = [], intervals = [];
    for (const moment of moments) {
      const all = valuesOf(moment);
      if (!all.length) continue;
      marks.push([moment.secs, all.at(-1), 2]);
      intervals.push([moment.secs, Math.min(...all), Math.max(...all)]);
    }
    return { colour, mark: 1, marks, intervals, cap: 0 };
  };
  const felt = moments.filter(({ forces }) => forces), ofPad = (idx) => felt.map(({ secs, forces }) => [secs, forces[idx]]);
  const thresholds = [...new Set(model ? [model.threshold, model.unsure_from] : [])];
  const series = isForce ? pads.map((_, idx) => ({ colour: seriesColour(idx), width: 1.6, isDashed: idx >= 8, points: ofPad(idx) }))
    : [...thresholds.map((p) => ({ colour: "--soft", isDashed: true, points: [[from, p], [to, p]] })),
      values("--probe", ({ shadow }) => shadow), values("--mark", ({ probabilities }) => probabilities)];
  const frame = { left: 44, right: width - 12, top: 20, bottom: height - 34 };
  const y = { from: 0, to: most, ticks: [0, 0.5, 1].map((share) => [share * most, Number((share * most).toPrecision(3))]) };
  const { at } = lineChart({ svg, width, height, frame, x: { from, to, ticks, label: title }, y, series });
  if (isForce) write(svg, scene?.cell_unit ?? "", 2, 12, "start");
  let labelled = -Infinity;
  for (const { secs, decisions } of moments) {
    for (const decision of decisions) {
      const { action } = decision, x = at.x(secs), colour = `var(${actionColour(action)})`;
      const shape = { lift: "l5 10h-10z", hold: "m-5 0h10l-5 10z" }[action] ?? "l4 5l-4 5l-4 -5z";
      const fill = verdict(decision).startsWith("false") ? "var(--card)" : colour;
      add(svg, "path", { d: `M${x} 17${shape}`, fill, stroke: colour, "stroke-width": 1.6 });
      if (x - labelled < LABEL_PX) continue;
      labelled = x;
      const isAtEdge = x > width - 30;
      write(svg, spoken(action), isAtEdge ? width - 1 : x, 13, isAtEdge ? "end" : "middle", { fill: colour });
    }
  }
  if (cursor !== null) add(svg, "path", { d: `M${at.x(cursor)} 20V${height - 34}`, stroke: "var(--text)", "stroke-width": 2 });
  const ofProbability = [["probability", "--mark"], ...(hasShadow ? [["the model beside (--shadow)", "--probe"]] : []),
    ...(model ? [[dashesOf(model), "--soft", "┄"]] : [])];
  showKeys(byId("chart-key"), [
    ...(isForce ? pads.map((name, idx) => [`${spoken(name)}${idx < 8 ? "" : ", dashed"}`, seriesColour(idx)]) : ofProbability),
    ["lift", "--lift", "▲"], ["hold", "--hold", "▼"], ["hollow: a wrong one", "--soft", "△"],
  ]);
};
