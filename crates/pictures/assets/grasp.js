// The page of one grasp, or of a hand by itself. Its functions are used by report.js, of whose helpers it is made.
const rgb = (colour) => `rgb(${colour.join(" ")})`;
// Whether writing on this colour is white.
const isDark = ([red, green, blue]) => 0.299 * red + 0.587 * green + 0.114 * blue < 152;
const contactColours = { sensed: 0xc92a2a, unsensed: 0x343a46, "on-hand": 0x6741d9 };
const contactWords = { sensed: "yes", unsensed: "no", "on-hand": "hand on hand" };
const badge = ({ kind }, idx) => make("span", { class: `badge ${kind}` }, String(idx + 1));

const graspPage = (page) => {
  const { title, is_hand_alone, facts: known, notes, contacts, joints } = page;
  begin(title, ...notes);
  section(is_hand_alone ? "Hand" : "Grasp", facts(known));
  const time = make("div", { class: "time" }, make("button", { id: "play", type: "button" }, "Play"),
    make("input", { id: "frame", type: "range", min: 0, max: drawn.frames.length - 1, step: 1, "aria-label": "frame" }), make("output", { id: "when" }));
  section("In three dimensions", stageView("The hand in three dimensions.", title), time,
    caption("Drag or arrow keys: turn. Wheel, + and −: zoom. Double click: back.",
      is_hand_alone ? " A red needle is the normal of a cell: it points to the object." : "",
      page.object ? " The object is shown where the grasp ends." : "",
      contacts.length ? " An arrow is a contact: red where cells feel it, grey where none does, purple where the hand touches itself." : ""));
  section("Cells", make("div", { id: "pads", class: "scroll", tabindex: 0 }, page.flat_pads.map(padMap)), is_hand_alone ? [] : forceScale());
  if (contacts.length) {
    section("Contacts", table(["#", "link", "on", "felt by cells", "point x, y, z (mm, palm frame)", "force (N)", "felt (N)"],
      contacts.map((contact, idx) => [badge(contact, idx), contact.link, contact.touches, contactWords[contact.kind],
        contact.point_m.map((metres) => minus(fixed(1000 * metres, 1))).join(", "), fixed(contact.force_newtons, 2), fixed(contact.felt_newtons, 2)]),
      { nTexts: 4 }));
  }
  section("Joints", table(["joint", "unit", "value", "from", "to"],
    joints.map(({ name, unit, value, lower, upper }) => [name, unit, ...[value, lower, upper].map((value) => minus(fixed(value, 3)))]), { nTexts: 2 }));
};

// A pad laid flat: a rectangle for each cell, and its force where there is room.
const padMap = ({ cells_m, width_m, height_m }, pad) => {
  const longest_m = Math.max(...data.flat_pads.flatMap(({ width_m, height_m }) => [width_m, height_m]));
  const scale = Math.min(4500, 340 / longest_m);
  const map = make("div", {}, make("b", {}, spoken(drawn.pad_names[pad])), make("p", { class: "caption", "data-pad": pad }));
  const svg = add(map, "svg", { width: scale * width_m, height: scale * height_m });
  cells_m.forEach((cell, idx) => {
    const [x, y, width, height] = cell.map((metres) => scale * metres), at = drawn.pads[pad].first_cell + idx;
    add(svg, "rect", { x: x + 0.5, y: y + 0.5, width: Math.max(1, width - 1), height: Math.max(1, height - 1), rx: 1.5, "data-cell": at });
    const hasRoom = width >= 15 && height >= 10.5 && !data.is_hand_alone;
    if (hasRoom) add(svg, "text", { x: x + width / 2, y: y + height / 2 + 3.2, "text-anchor": "middle", "font-size": 9, "data-force": at });
  });
  return map;
};

const drawGrasp = async () => {
  const { three, colourStep, makeStage } = await loadStage();
  const { contacts, is_closed } = data, stage = makeStage(three, byId("stage"));
  if (!stage.renderer) byId("without-webgl").hidden = false;
  blindgrasp.hand = stage;
  stage.surround(data.object);
  stage.build(drawn, data.is_hand_alone);
  const arrows = contacts.map(({ kind, point_m, inward_normal, force_newtons }) => [...point_m, ...inward_normal, force_newtons, contactColours[kind]]);
  const numbers = contacts.map(badge);
  byId("stage").after(make("div", { id: "numbers", "aria-hidden": true }, numbers));
  stage.onDrawn = () => numbers.forEach((number, idx) => {
    const { point_m, inward_normal } = contacts[idx];
    [number.style.left, number.style.top] = stage.project(point_m.map((x, axis) => x - 0.009 * inward_normal[axis])).map((x) => `${x}px`);
  });
  // Cells and pads in numbers. Those of a hand by itself are only coloured, so that they are seen.
  const showCells = ({ cells }, colours) => {
    const isActive = (cell) => cells[cell] > drawn.cells[cell].threshold_newtons;
    for (const rect of document.querySelectorAll("[data-cell]")) rect.setAttribute("fill", rgb(colours[rect.dataset.cell]));
    for (const text of document.querySelectorAll("[data-force]")) {
      const cell = Number(text.dataset.force);
      text.textContent = isActive(cell) ? cells[cell].toFixed(cells[cell] < 9.95 ? 1 : 0) : "";
      text.setAttribute("fill", isDark(colours[cell]) ? "#ffffff" : "#1f2933");
    }
    for (const text of document.querySelectorAll("[data-pad]")) {
      const { first_cell, n_cells } = drawn.pads[text.dataset.pad];
      const active = [...Array(n_cells).keys()].map((idx) => first_cell + idx).filter((cell) => data.is_hand_alone || isActive(cell));
      const counted = `${active.length} cell${active.length === 1 ? "" : "s"}`, sum = active.reduce((sum, cell) => sum + cells[cell], 0);
      if (data.is_hand_alone) text.textContent = counted;
      else text.textContent = active.length === 0 ? "no contact" : `${sum.toFixed(1)} ${drawn.cell_unit}, ${counted}`;
    }
  };
  const slider = byId("frame");
  const show = (idx) => {
    const frame = drawn.frames[idx];
    const colours = frame.cells.map((newtons, cell) => drawn.colours[colourStep(drawn, newtons, cell, drawn.scale_newtons)] ?? drawn.silent_colour);
    slider.value = idx;
    byId("when").textContent = `frame ${idx + 1} of ${drawn.frames.length}, ${frame.title}`;
    showCells(frame, colours);
    numbers.forEach((number) => { number.hidden = !is_closed[idx] || !stage.renderer; });
    stage.show({ links: frame.links, contacts: is_closed[idx] ? arrows : [], gravity: null }, colours);
  };
  slider.addEventListener("input", () => show(Number(slider.value)));
  let timer = null;
  const stop = () => { clearInterval(timer); timer = null; byId("play").textContent = "Play"; };
  byId("play").addEventListener("click", () => {
    if (timer !== null) return stop();
    byId("play").textContent = "Stop";
    if (Number(slider.value) === drawn.frames.length - 1) show(0);
    timer = setInterval(() => {
      if (Number(slider.value) + 1 >= drawn.frames.length) return stop();
      show(Number(slider.value) + 1);
    }, 250);
  });
  show(data.shown);
};

