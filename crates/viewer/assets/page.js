// Small helpers of the page: elements, tables, colours, and texts of times. The server joins page.js, timeline.js, list.js,
// history.js, player.js, control.js and app.js, in this order, into one module: over a slow line each file more would cost a round trip.
import * as three from "/three.js";
import { MAX_CONTACTS, colourStep, makeStage } from "/stage.js";
import { add, lineChart, roundUp, time, write } from "/chart.js";

const byId = (id) => document.getElementById(id);

// A row of a table: its texts are set, not made again, so that nothing flickers and a selection stays. A null leaves its cell.
const fill = (body, idx, texts, numbers, troubles = []) => {
  while (body.rows.length <= idx) body.insertRow();
  const row = body.rows[idx];
  texts.forEach((text, n) => {
    const cell = row.cells[n] ?? row.insertCell();
    if (text !== null && cell.textContent !== String(text)) cell.textContent = text;
    cell.className = [numbers.includes(n) ? "num" : "", troubles.includes(n) ? "trouble" : ""].join(" ").trim();
  });
};
const cut = (body, n) => { while (body.rows.length > n) body.deleteRow(n); };
// Sets a text only if it is another one.
const tell = (id, text) => { if (byId(id).textContent !== text) byId(id).textContent = text; };
const say = (text, isTrouble) => {
  tell("state", text);
  byId("state").className = isTrouble ? "trouble" : "";
};

const pen = (canvas) => {
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
  const made = canvas.getContext("2d");
  made.scale(ratio, ratio);
  return made;
};
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
// The colours of pads and of parts of a feature; beyond eight they begin again.
const seriesColour = (idx) => `--series-${idx % 8}`;
const actionColour = (action) => ({ lift: "--lift", hold: "--hold" })[action] ?? "--probe";
// A lift and a hold differ by their mark, too, and a wrong one has a cross.
const marked = (decision) => {
  const mark = { lift: "▲ ", hold: "▼ " }[decision.action] ?? "";
  return `${mark}${spoken(decision.action)}${verdict(decision).startsWith("false") ? " ✗" : ""}`;
};
// Swatches, or marks, with their texts: name, colour and perhaps a mark each.
const showKeys = (element, keys) => {
  const text = JSON.stringify(keys);
  if (element.dataset.keys === text) return;
  element.dataset.keys = text;
  element.replaceChildren(...keys.flatMap(([name, colourName, mark]) => {
    const key = document.createElement("span");
    key.className = "key";
    if (mark) key.dataset.mark = mark;
    key.style.setProperty("--key", `var(${colourName})`);
    key.textContent = name;
    return [key, " "];
  }));
};

const counted = (n, noun) => `${n} ${noun}${n === 1 ? "" : "s"}`;
// A name as it is written in a sentence.
const spoken = (name) => name.replaceAll("_", " ");
const clock = (millis) => new Date(millis).toLocaleTimeString([], { hour12: false });
// The outcome of a decision by the label, which is null or missing where it is not known.
const verdict = ({ action, truth }) => {
  if (action === null || truth === null || truth === undefined) return "other";
  if (action === "lift") return truth ? "right" : "false-positive";
  if (action !== "hold") return "other";
  return truth ? "false-negative" : "right";
};
