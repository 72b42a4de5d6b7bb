// The last minutes of a running graph: kept in the browser, to be looked at again. Pausing holds the page, not the graph.

const KEPT_MS = 180_000;
// Numbers in all that are kept, a few dozen megabytes: of a hand with many cells, fewer seconds.
const MAX_KEPT_NUMBERS = 3e6;
const MAX_DECISIONS = 200;

const keyOf = ({ epoch, grasp_id }) => `${epoch} ${grasp_id}`;
const isProbe = (decision) => ["squeeze", "test_lift"].includes(decision.action);

// `show` draws a moment, and knows the decision whose frame is not kept; `chart` draws the chart.
const makeHistory = ({ show, chart }) => {
  // `at` is the time of the page's clock in milliseconds of the moment that is shown, null at present.
  const state = { moments: [], decisions: [], at: null, decided: new Set(), push, label, pause, resume, clear, isDecided, end, choose, toggle, isNewestFirst: true, isOver: () => isOver };
  let n_kept = 0, chosen = null, isOver = false, isListDue = true, listed = [];
  const last = () => state.moments.at(-1);

  function drop() {
    while (state.moments.length > 1 && (last().at - state.moments[0].at > KEPT_MS || n_kept > MAX_KEPT_NUMBERS)) {
      n_kept -= state.moments.shift().n;
    }
  }
  // While the page is paused, nothing of the past is dropped; beyond the limit nothing more is kept.
  function push(moment) {
    const { frame, feature, words, probabilities, shadow } = moment;
    moment.n = 50 + (frame ? frame.cells.length + 12 * frame.links.length + 7 * frame.contacts.length : 0)
      + (feature?.length ?? 0) + (words?.length ?? 0) + probabilities.length + shadow.length;
    for (const decision of moment.decisions) {
      decision.at = moment.at;
      decision.first = clock(Date.now());
      decide(decision);
      state.decisions.push(decision);
      isListDue = true;
      if (state.decisions.length > MAX_DECISIONS) {
        const dropped = state.decisions.shift();
        // Moments keep their decisions, but no frame that cannot be chosen any more.
        if (!listed.includes(dropped)) delete dropped.frame;
      }
    }
    if (state.at !== null && n_kept > MAX_KEPT_NUMBERS) return;
    // The hand stays as it was until its next frame.
    const before = last();
    for (const name of ["frame", "forces", "feature", "words"]) moment[name] ??= before?.[name];
    state.moments.push(moment);
    n_kept += moment.n;
    if (state.at === null) drop();
  }
  function decide(decision) {
    if (isProbe(decision)) return;
    state.decided.add(keyOf(decision));
    if (state.decided.size > MAX_DECISIONS) state.decided.delete(state.decided.values().next().value);
  }
  state.decide = decide;
  function isDecided(frame) { return state.decided.has(keyOf(frame)); }
  // A label may come after its decision.
  function label([epoch, grasp_id, truth]) {
    for (const decision of state.decisions) if (keyOf(decision) === keyOf({ epoch, grasp_id })) decision.truth = truth;
    isListDue = true;
  }
  function pause(at, decision = null) {
    if (!state.moments.length) return;
    state.at = Math.min(at, last().at);
    chosen = decision;
    present();
  }
  function resume() {
    if (isOver) return;
    [state.at, chosen] = [null, null];
    drop();
    present();
  }
  // The graph's run is over: its last minutes can be looked at.
  function end() {
    isOver = true;
    if (state.at === null && state.moments.length) pause(last().at);
    else present();
  }
  function clear() {
    [state.moments, state.decisions, state.at, n_kept, chosen, isOver] = [[], [], null, 0, null, false];
    state.decided.clear();
    present();
  }
  const idxAt = (at) => {
    const idx = state.moments.findLastIndex((moment) => moment.at <= at);
    return Math.max(0, idx);
  };
  // The last decision at a time.
  state.decisionAt = (at) => state.decisions.findLast((decision) => decision.at <= at) ?? null;
  function choose(decision) { pause(decision.at, decision); }
  function toggle() { if (state.at === null) pause(Infinity); else resume(); }

  function present() {
    const isPaused = state.at !== null;
    const moment = isPaused ? state.moments[idxAt(state.at)] : last();
    if (moment) {
      // The frame that decided is exact; moments are 30 a second, mostly of other grasps.
      const ofChosen = { ...moment, frame: chosen?.frame, feature: undefined };
      show(chosen ? ofChosen : moment, chosen ?? (isPaused ? state.decisionAt(state.at) : state.decisions.at(-1) ?? null), isPaused, chosen?.frame ? null : chosen);
    }
    controls();
    // The list may be that of a recording.
    if (decisionList.owner === state) {
      setAddress(chosen, state.decisions);
      list();
      decisionList.mark(chosen);
    }
    chart();
  }
  function controls() {
    const isPaused = state.at !== null, slider = byId("moment-slider");
    byId("pause").hidden = isOver;
    byId("pause").disabled = !state.moments.length;
    tell("pause", isPaused ? "Go on live" : "Pause");
    slider.max = Math.max(0, state.moments.length - 1);
    slider.value = isPaused ? idxAt(state.at) : slider.max;
    slider.disabled = !state.moments.length;
    const secs = isPaused ? (last().at - state.at) / 1000 : 0;
    const before = `${secs.toFixed(1)} s before the last frame`;
    const kept = state.moments.length ? (last().at - state.moments[0].at) / 1000 : 0;
    const text = !state.moments.length ? "nothing yet" : !isPaused ? `live; the last ${kept.toFixed(0)} s are kept`
      : chosen?.frame ? `the frame that decided grasp ${chosen.grasp_id}, ${before}` : before;
    tell("ago", text);
    slider.setAttribute("aria-valuetext", isPaused ? text : "live");
  }
  // The newest first. While the page is paused the rows stay where they are.
  function list() {
    isListDue = false;
    if (state.at === null || isOver || !listed.length) {
      for (const row of listed) if (!state.decisions.includes(row)) delete row.frame;
      listed = state.decisions.slice().reverse();
    }
    decisionList.show(listed);
  }
  // Called several times a second.
  state.refresh = () => {
    controls();
    if (isListDue && (state.at === null || isOver)) list();
  };
  byId("pause").addEventListener("click", toggle);
  byId("moment-slider").addEventListener("input", () => pause((state.moments[Number(byId("moment-slider").value)] ?? last())?.at ?? Infinity));
  const decisionList = makeList(state);
  state.list = decisionList;
  return state;
};
