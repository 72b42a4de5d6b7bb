// Shows a grasp in three dimensions and its frames in time. The modules that it needs are in the page.
const data = JSON.parse(document.getElementById("grasp").textContent);
const byId = (id) => document.getElementById(id);
const load = (id) => import(URL.createObjectURL(new Blob([byId(id).textContent], { type: "text/javascript" })));
const three = await load("three.js"), { colourStep, makeStage } = await load("stage.js");
const slider = byId("frame");
const rgb = (c) => `rgb(${c[0]} ${c[1]} ${c[2]})`;
let frameIdx = data.shown;

// Colour of a cell in a frame, and whether writing on it is white.
const cellColour = (newtons, idx) => {
  const step = colourStep(data, newtons, idx, data.scale_newtons);
  if (step < 0) return { colour: data.silent_colour, active: false };
  return { colour: data.colours[step], active: true, dark: step >= data.first_dark_colour };
};

// --- the hand, the object, and the contacts with their numbers
const stage = makeStage(three, byId("stage"));
if (!stage.renderer) byId("without-webgl").hidden = false;
window.blindgrasp = { hand: stage }; // Tests read it.
stage.lookFrom(data.azimuth_rad);
stage.build(data);
stage.surround(data.object);
const contactColours = { sensed: 0xc92a2a, unsensed: 0x343a46, "on-hand": 0x6741d9 };
const contacts = data.contacts.map(({ kind, point_m, inward_normal, force_newtons }) =>
  [...point_m, ...inward_normal, force_newtons, contactColours[kind]]);
const numbers = data.contacts.map((contact, idx) => {
  const number = document.createElement("span");
  number.className = contact.kind;
  number.textContent = idx + 1;
  byId("numbers").append(number);
  return number;
});
stage.onDrawn = () => numbers.forEach((number, idx) => {
  const { point_m, inward_normal } = data.contacts[idx];
  [number.style.left, number.style.top] = stage.project(point_m.map((x, axis) => x - 0.009 * inward_normal[axis])).map((x) => `${x}px`);
});

// --- heat maps and slider
const pads = byId("pads");
const cellRects = [...pads.querySelectorAll("[data-cell]")];
// A hand that is shown by itself feels nothing: its cells are coloured so that they are seen, and no force is written.
const texts = (name) => (data.is_hand_alone ? [] : [...pads.querySelectorAll(`[data-${name}]`)]);
const cellTexts = new Map(texts("force").map((text) => [Number(text.dataset.force), text]));
const padTexts = texts("pad");
const showFrame = (idx) => {
  frameIdx = idx;
  const frame = data.frames[idx];
  slider.value = idx;
  byId("when").textContent =
    `frame ${idx + 1} of ${data.frames.length}, ${frame.phase}, ${frame.since_start_ms.toFixed(0)} ms`;
  for (const rect of cellRects) {
    const cell = Number(rect.dataset.cell);
    const newtons = frame.cells[cell];
    const { colour, active, dark } = cellColour(newtons, cell);
    rect.setAttribute("fill", rgb(colour));
    const text = cellTexts.get(cell);
    if (text) {
      text.textContent = active ? newtons.toFixed(newtons < 9.95 ? 1 : 0) : "";
      text.setAttribute("class", dark ? "cell-force on-dark" : "cell-force");
    }
  }
  for (const text of padTexts) {
    const pad = data.pads[Number(text.dataset.pad)];
    let n = 0, sum = 0;
    for (let cell = pad.first_cell; cell < pad.first_cell + pad.n_cells; cell++) {
      const newtons = frame.cells[cell];
      if (cellColour(newtons, cell).active) { n += 1; sum += newtons; }
    }
    text.textContent = n === 0 ? "no contact" : `${sum.toFixed(1)} ${data.cell_unit}, ${n} cell${n === 1 ? "" : "s"}`;
  }
  // Contacts are those of the closed hand.
  const isClosed = frame.phase === data.frames[data.shown].phase;
  numbers.forEach((number) => { number.hidden = !isClosed || !stage.renderer; });
  stage.show({ links: frame.links, contacts: isClosed ? contacts : [], gravity: null },
    frame.cells.map((newtons, cell) => cellColour(newtons, cell).colour));
};
slider.max = data.frames.length - 1;
slider.addEventListener("input", () => showFrame(Number(slider.value)));
let timer = null;
const stop = () => { clearInterval(timer); timer = null; byId("play").textContent = "Play"; };
byId("play").addEventListener("click", () => {
  if (timer !== null) return stop();
  byId("play").textContent = "Stop";
  if (frameIdx === data.frames.length - 1) showFrame(0);
  timer = setInterval(() => {
    if (frameIdx + 1 >= data.frames.length) return stop();
    showFrame(frameIdx + 1);
  }, 250);
});
showFrame(data.shown);
