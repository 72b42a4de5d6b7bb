// A chart over time: the probability that the grasp is stable, or the force of each pad. It is drawn from moments: `secs` on the
// axis, `probabilities`, `shadow`, `forces` (one of each pad) and `decisions`.

const LEFT = 44, RIGHT = 12, TOP = 20, BOTTOM = 34;
// Labels of decisions that are nearer would overlap.
const LABEL_PX = 32;

// `ticks` are pairs of seconds and text; `cursor` are the seconds of the moment that is shown, or null.
const drawChart = ({ moments, from, to, ticks, title, cursor, scene, model, hasShadow }) => {
  const canvas = byId("chart"), draw = pen(canvas), width = canvas.clientWidth, height = canvas.clientHeight;
  const isForce = byId("quantity").value === "force", pads = scene?.pad_names ?? [];
  let most = 1;
  if (isForce) for (const { forces } of moments) for (const newtons of forces ?? []) most = Math.max(most, newtons);
  if (isForce) most = roundUp(most);
  const x = (secs) => LEFT + (width - LEFT - RIGHT) * (secs - from) / Math.max(1e-9, to - from);
  const y = (value) => TOP + (height - TOP - BOTTOM) * (1 - value / most);
  const line = (colourName, corners, size = 1) => {
    draw.strokeStyle = colour(colourName);
    draw.lineWidth = size;
    draw.beginPath();
    corners.forEach(([x, y], idx) => (idx ? draw.lineTo(x, y) : draw.moveTo(x, y)));
    draw.stroke();
  };
  const write = (text, x, y, align, colourName = "--soft") => {
    draw.textAlign = align;
    draw.fillStyle = colour(colourName);
    draw.fillText(text, x, y);
  };
  draw.font = "12px sans-serif";
  for (const share of [0, 0.5, 1]) {
    line("--line", [[LEFT, y(share * most)], [width - RIGHT, y(share * most)]]);
    write(Number((share * most).toPrecision(3)), LEFT - 6, y(share * most) + 4, "right");
  }
  write(isForce ? scene?.cell_unit ?? "" : "", 2, 12, "left");
  for (const [secs, text] of ticks) {
    line("--line", [[x(secs), TOP], [x(secs), height - BOTTOM]]);
    write(text, x(secs), height - BOTTOM + 14, "center");
  }
  write(title, (LEFT + width - RIGHT) / 2, height - 4, "center");
  draw.save();
  draw.beginPath();
  draw.rect(LEFT, 0, width - LEFT - RIGHT + 1, height - BOTTOM + 3);
  draw.clip();
  if (!isForce) {
    draw.setLineDash([5, 4]);
    for (const p of new Set(model ? [model.threshold, model.unsure_from] : [])) line("--soft", [[LEFT, y(p)], [width - RIGHT, y(p)]]);
    draw.setLineDash([]);
  }
  // Of several values at a time, a line from the least to the most, and a dot at the last one.
  const dots = (colourName, valuesOf) => {
    draw.fillStyle = colour(colourName);
    for (const moment of moments) {
      const values = valuesOf(moment);
      if (!values.length) continue;
      const at = x(moment.secs), top = y(Math.max(...values)), bottom = y(Math.min(...values));
      draw.fillRect(at - 0.5, top, 1, bottom - top);
      draw.fillRect(at - 2, y(values.at(-1)) - 2, 4, 4);
    }
  };
  if (isForce) {
    pads.forEach((_, idx) => {
      draw.setLineDash(idx < 8 ? [] : [4, 3]);
      const corners = moments.filter(({ forces }) => forces).map(({ secs, forces }) => [x(secs), y(forces[idx])]);
      line(seriesColour(idx), corners, 1.6);
    });
    draw.setLineDash([]);
  } else {
    dots("--probe", ({ shadow }) => shadow);
    dots("--mark", ({ probabilities }) => probabilities);
  }
  let labelled = -Infinity;
  for (const { secs, decisions } of moments) {
    for (const { action } of decisions) {
      line(actionColour(action), [[x(secs), TOP - 4], [x(secs), TOP + 8]], 2);
      if (x(secs) - labelled < LABEL_PX) continue;
      labelled = x(secs);
      write(spoken(action), x(secs), TOP - 7, "center", actionColour(action));
    }
  }
  if (cursor !== null) line("--text", [[x(cursor), TOP], [x(cursor), height - BOTTOM]], 2);
  draw.restore();
  const ofProbability = [["probability", "--mark"], ...(hasShadow ? [["the model beside (--shadow)", "--probe"]] : []), ["threshold, dashed", "--soft"]];
  showKeys(byId("chart-key"), [
    ...(isForce ? pads.map((name, idx) => [`${spoken(name)}${idx < 8 ? "" : ", dashed"}`, seriesColour(idx)]) : ofProbability),
    ["lift", "--lift"], ["hold", "--hold"],
  ]);
};
