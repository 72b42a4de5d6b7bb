// Draws the grasps of a report: one on the stage, to be turned, and each on its card. The modules that it needs are in the page.
const data = JSON.parse(document.getElementById("grasps").textContent);
const byId = (id) => document.getElementById(id);
const load = (id) => import(URL.createObjectURL(new Blob([byId(id).textContent], { type: "text/javascript" })));
const three = await load("three.js"), { colourStep, makeStage } = await load("stage.js");
const cards = [...document.querySelectorAll("[data-grasp]")];

const stage = makeStage(three, byId("stage"));
if (!stage.renderer) byId("without-webgl").hidden = false;
window.blindgrasp = { hand: stage, shown: null, drawn: 0 }; // Tests read it.
stage.build(data);
const colourOf = (newtons, idx) => {
  const step = colourStep(data, newtons, idx, data.scale_newtons);
  return step < 0 ? data.silent_colour : data.colours[step];
};
const show = (idx) => {
  const { grasp_id, links, cells } = data.frames[idx];
  stage.show({ links, contacts: [], gravity: null }, cells.map(colourOf));
  blindgrasp.shown = grasp_id;
};
let chosen = 0;
const choose = (idx) => {
  chosen = idx;
  show(idx);
  cards.forEach((card) => card.setAttribute("aria-pressed", String(Number(card.dataset.grasp) === idx)));
  byId("chosen").textContent = `Grasp ${data.frames[idx].grasp_id}. A click on a card shows another one. Drag or arrow keys: turn. Double click: back.`;
};
cards.forEach((card) => card.addEventListener("click", () => choose(Number(card.dataset.grasp))));
// One after the other, so that the page can be used meanwhile.
for (const card of cards) {
  await new Promise(requestAnimationFrame);
  show(Number(card.dataset.grasp));
  stage.drawTo(card.querySelector("canvas"));
  blindgrasp.drawn += 1;
}
choose(chosen);
