// The list of decisions of a running graph or a recording, and the ways to one of them: a click, the arrow keys in the list, its
// number in the field, n and p anywhere, and the address, which follows the page: #grasp=500, and &epoch=2 if another run of the
// source has such a number.

const WRONG = { "false-positive": ": a wrong lift", "false-negative": ": a wrong hold" };
const graspInAddress = () => /^#grasp=(?<id>\d+)(?:&epoch=(?<epoch>\d+))?$/.exec(location.hash)?.groups ?? null;
const labelOf = ({ truth }) => (truth === null || truth === undefined ? "not known" : truth ? "stable" : "not stable");

// Rows are decisions, with a text for the first column. `owner` is the history of a graph or the player of a recording: it can
// `choose` a row and `toggle` between going on and standing still. The rows of a graph have the newest first.
const makeList = (owner) => {
  const body = byId("decisions"), region = body.closest("div");
  const state = { rows: [], chosen: null, owner, asked: graspInAddress(), show, mark, goTo };
  // The one row that is a stop of the tab order.
  let stop = 0;
  const buttonAt = (idx) => body.rows[idx]?.querySelector("button");
  const moveStop = (idx) => {
    buttonAt(stop)?.setAttribute("tabindex", -1);
    stop = Math.max(0, Math.min(idx, state.rows.length - 1));
    buttonAt(stop)?.setAttribute("tabindex", 0);
  };
  function show(rows) {
    state.rows = rows;
    byId("no-decisions").hidden = rows.length > 0;
    rows.forEach((decision, idx) => {
      const kind = verdict(decision), { first, grasp_id, action, reason, probability_stable } = decision;
      fill(body, idx, [first, null, action === null ? "none" : marked(decision), spoken(reason ?? ""), probability_stable?.toFixed(2) ?? "",
        labelOf(decision) + (WRONG[kind] ?? "")], [4], kind.startsWith("false") ? [5] : []);
      const cell = body.rows[idx].cells[1];
      body.rows[idx].cells[2].style.color = `var(${actionColour(action)})`;
      let button = cell.firstElementChild;
      if (!button) {
        button = document.createElement("button");
        button.type = "button";
        button.tabIndex = -1;
        cell.replaceChildren(button);
      }
      if (button.textContent !== grasp_id) button.textContent = grasp_id;
    });
    cut(body, rows.length);
    mark(state.chosen);
  }
  // Marks the row that is shown, and brings it into view.
  function mark(chosen) {
    for (const row of body.querySelectorAll(".chosen")) {
      row.classList.remove("chosen");
      row.querySelector("button").removeAttribute("aria-current");
    }
    const isOther = state.chosen !== chosen, idx = state.rows.indexOf(chosen), row = body.rows[idx];
    state.chosen = chosen;
    if (!body.contains(document.activeElement)) moveStop(idx >= 0 ? idx : stop);
    if (!row) return;
    row.classList.add("chosen");
    buttonAt(idx).setAttribute("aria-current", "true");
    if (!isOther) return;
    const { top, bottom } = row.getBoundingClientRect(), seen = region.getBoundingClientRect();
    if (top < seen.top || bottom > seen.bottom) region.scrollTop += top - seen.top - seen.height / 2;
  }
  // Says why if the grasp is not in the list.
  function goTo({ id, epoch }) {
    const { rows } = state, found = rows.find((row) => row.grasp_id === id && (epoch === undefined || row.epoch === epoch));
    const all = rows.length === 0 ? "it is empty" : `its first one is ${rows[0].grasp_id}, its last one ${rows.at(-1).grasp_id}`;
    tell("go-answer", found ? "" : `grasp ${id} is not in the list: ${all}`);
    if (found) state.owner.choose(found);
  }
  // To the next grasp in time, or to the one before.
  const step = (n) => {
    const next = state.rows[state.rows.indexOf(state.chosen) + (state.owner.isNewestFirst ? -n : n)];
    if (next) state.owner.choose(next);
  };
  body.addEventListener("click", ({ target }) => {
    if (target.matches("button")) state.owner.choose(state.rows[target.closest("tr").sectionRowIndex]);
  });
  body.addEventListener("focusin", ({ target }) => moveStop(target.closest("tr").sectionRowIndex));
  body.addEventListener("keydown", (event) => {
    const to = { ArrowDown: stop + 1, ArrowUp: stop - 1, Home: 0, End: state.rows.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    buttonAt(to)?.focus();
  });
  byId("go").addEventListener("submit", (event) => {
    event.preventDefault();
    goTo({ id: byId("go-to").value.trim() });
  });
  window.addEventListener("hashchange", () => { if (graspInAddress() !== null) goTo(graspInAddress()); });
  document.addEventListener("keydown", (event) => {
    const isIn = (selector) => event.target.matches?.(selector);
    if (event.ctrlKey || event.metaKey || event.altKey || isIn("input:not([type=range]), select")) return;
    if (event.key === "n") step(1);
    else if (event.key === "p") step(-1);
    else if (event.key === " " && !isIn("button, summary")) state.owner.toggle();
    else return;
    event.preventDefault();
  });
  return state;
};
// The address of the grasp that is shown, one of the rows, or of the page.
const setAddress = (shown, rows) => {
  const hasNamesake = rows.some(({ grasp_id, epoch }) => grasp_id === shown?.grasp_id && epoch !== shown.epoch);
  const hash = shown === null ? "" : `#grasp=${shown.grasp_id}${hasNamesake ? `&epoch=${shown.epoch}` : ""}`;
  if (location.hash !== hash) history.replaceState(null, "", hash || location.pathname);
};
