// The page of a running graph or a recording: shows the events of /events. A running graph's last minutes are kept (history.js),
// the grasps of a recording are asked for one by one (player.js), and with a token in the address orders are sent (control.js).

byId("unloaded").remove();
const CHART_SECS = 20;
// The least time between two decisions that a screen reader says.
const SPOKEN_MS = 2000;
// The graph tells its state each second: after this time without it, the page says so.
const SILENT_MS = 3000;

// The present state, which tests read.
const shown = (window.blindgrasp = { server: null, scene: null, model: null, frame: null, decision: null, graph: null, dropped: 0, frames: 0, cellColours: [], painted: [], firstFrameMs: null });

// --- the hand
const hand = makeStage(three, byId("stage"));
if (!hand.renderer) byId("without-webgl").hidden = false;
shown.hand = hand;
byId("save").addEventListener("click", () => hand.savePicture("hand"));

// --- a frame
const isActive = (newtons, idx) => newtons !== null && newtons > shown.scene.cells[idx].threshold_newtons;
// The active cells of each pad, and their sum.
const touchOf = (frame) => shown.scene.pads.map((pad) => {
  let [n, sum] = [0, 0];
  for (let idx = pad.first_cell; idx < pad.first_cell + pad.n_cells; idx++) {
    if (isActive(frame.cells[idx], idx)) [n, sum] = [n + 1, sum + frame.cells[idx]];
  }
  return { n, sum };
});
const isShownHand = (frame) => Boolean(frame?.links && shown.scene && frame.cells.length === shown.scene.cells.length);
// The end of the scale of forces: the greatest reading so far, rounded up.
let largest = 1;
const cellColour = (newtons, idx) => {
  const step = colourStep(shown.scene, newtons, idx, largest);
  return step < 0 ? shown.scene.silent_colour : shown.scene.colours[step];
};
const showScale = () => {
  const { colours, cell_unit } = shown.scene ?? { colours: [], cell_unit: "" };
  byId("scale").hidden = colours.length === 0;
  byId("bar").style.background = `linear-gradient(to right, ${colours.map((parts) => `rgb(${parts.join(" ")})`).join(", ")})`;
  tell("half", Number((largest / 2).toPrecision(3)));
  tell("largest", `${Number(largest.toPrecision(3))} ${cell_unit}`);
};
const showFrame = (frame) => {
  const scene = shown.scene;
  if (!isShownHand(frame)) return;
  const greatest = Math.max(...frame.cells.map((newtons) => newtons ?? 0), 0);
  if (greatest > largest) {
    largest = roundUp(greatest);
    showScale();
  }
  byId("stage").classList.remove("lacking");
  shown.frame = frame;
  shown.frames += 1;
  shown.firstFrameMs ??= performance.now();
  shown.cellColours = frame.cells.map(cellColour);
  hand.show(frame, shown.cellColours);
  const more = frame.contacts.length > MAX_CONTACTS ? `; ${MAX_CONTACTS} of ${frame.contacts.length} contacts have an arrow` : "";
  tell("moment", `grasp ${frame.grasp_id}, ${spoken(frame.phase)}${more}`);
  byId("about-gravity").hidden = frame.gravity === null;
  touchOf(frame).forEach(({ n, sum }, idx) => {
    fill(byId("pads"), idx, [scene.pad_names[idx], `${n} of ${scene.pads[idx].n_cells}`, `${sum.toFixed(2)} ${scene.cell_unit}`], [1, 2]);
  });
  scene.joints.forEach((name, idx) => fill(byId("joints"), idx, [name, `${frame.joints[idx].toFixed(4)} ${scene.joint_units[idx]}`], [1]));
};

// --- decisions
let saidAt = -Infinity;
const showDecision = (decision) => {
  shown.decision = decision;
  const action = byId("action"), name = decision === null ? "none yet" : spoken(decision.action);
  tell("action", name);
  if (decision === null) {
    action.className = "action none";
    return tell("why", "");
  }
  const isFinal = ["lift", "hold"].includes(decision.action), isWrong = verdict(decision).startsWith("false");
  action.className = `action ${isFinal ? decision.action : "probe"} ${isWrong ? "wrong" : ""}`.trim();
  const against = decision.against ? `; ${decision.against}` : "";
  const wrong = decision.action === "lift" && decision.truth === false ? " This lift is wrong: the grasp is known to be unstable." : "";
  tell("why", `Grasp ${decision.grasp_id}: ${spoken(decision.reason)}, probability ` +
    `${decision.probability_stable.toFixed(2)}${against}.${decision.why ?? wrong}`);
};
// A new decision: when it was on the screen, which scripts/benchsuite view reads, and in words.
const announce = (decision) => {
  requestAnimationFrame(() => setTimeout(() => {
    shown.painted.push([decision.grasp_id, Date.now()]);
    if (shown.painted.length > 100) shown.painted.shift();
  }));
  if (performance.now() - saidAt > SPOKEN_MS) {
    saidAt = performance.now();
    byId("spoken").textContent = `${byId("action").textContent}. ${byId("why").textContent}`;
  }
};

// --- a model beside the graph
let hasShadow = false;
const showShadow = (decision) => {
  hasShadow ||= decision !== null;
  tell("shadow", decision === null ? "" : `The model beside: ${spoken(decision.action).toUpperCase()} for grasp ` +
    `${decision.grasp_id}, ${spoken(decision.reason)}, probability ${decision.probability_stable.toFixed(2)}.`);
};

// --- the chart: 20 s of a graph, or the frames of a recorded grasp
const liveChart = () => {
  const isPaused = past.at !== null, now = isPaused ? past.at : isOver() ? past.moments.at(-1)?.at ?? 0 : performance.now();
  // A moment of the past has as much after it as there is, up to half of the chart.
  const end = isPaused ? Math.min(Math.max(past.moments.at(-1).at, now), now + CHART_SECS * 500) : now;
  const secs = (at) => (at - now) / 1000, from = secs(end) - CHART_SECS;
  const moments = past.moments.filter((moment) => secs(moment.at) >= from && moment.at <= end).map((moment) => ({ ...moment, secs: secs(moment.at) }));
  const ticks = [];
  for (let n = Math.ceil(from / 5) * 5; n <= secs(end); n += 5) ticks.push([n, n === 0 ? isPaused ? "0" : "now" : `${n > 0 ? "+" : "−"}${Math.abs(n)} s`]);
  const title = isPaused ? "seconds from the moment shown" : "seconds before now";
  drawChart({ moments, from, to: secs(end), ticks, title, cursor: isPaused ? 0 : null, scene: shown.scene, model: shown.model, hasShadow });
};
const recordedChart = () => {
  const { frames, grasps, at, n, decided } = player;
  const to = frames.length ? Math.max(frames.at(-1).since_start_ms / 1000, 0.001) : 1, step = roundUp(to / 5), ticks = [];
  for (let k = 0; k * step <= to * 1.0001; k++) ticks.push([k * step, `${Number((k * step).toPrecision(3))} s`]);
  const moments = frames.map((frame, idx) => ({
    secs: frame.since_start_ms / 1000,
    probabilities: frame.probability === null ? [] : [frame.probability],
    shadow: frame.shadow === null ? [] : [frame.shadow],
    forces: byId("quantity").value === "force" && isShownHand(frame) ? touchOf(frame).map(({ sum }) => sum) : null,
    decisions: idx === decided && grasps[at].action !== null ? [grasps[at]] : [],
  }));
  drawChart({ moments, from: 0, to, ticks, title: "seconds since the grasp began", cursor: moments[n]?.secs ?? null, scene: shown.scene, model: null, hasShadow });
};
const chart = () => (player.grasps.length ? recordedChart() : liveChart());
byId("quantity").addEventListener("change", () => chart());

// --- the feature: a bar for each value, up or down from 0, and the words on the hand
let feature = null;
// Those that are not drawn yet.
let words = null;
const showFeature = () => {
  byId("feature-part").hidden = feature === null;
  if (feature === null) return;
  const canvas = byId("feature"), draw = pen(canvas), [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const most = Math.max(...feature, 1e-9), least = Math.min(...feature, 0), step = width / feature.length;
  const y = (value) => 4 + (height - 8) * (most - value) / (most - least);
  const blocks = shown.model?.blocks ?? [], ends = [];
  for (const block of blocks) ends.push((ends.at(-1) ?? 0) + block.n_values);
  feature.forEach((value, idx) => {
    draw.fillStyle = colour(seriesColour(Math.max(0, ends.findIndex((end) => idx < end))));
    const [top, bottom] = [Math.min(y(value), y(0)), Math.max(y(value), y(0))];
    draw.fillRect(idx * step, top, Math.max(1, step - (step > 4 ? 1 : 0)), Math.max(1, bottom - top));
  });
  tell("feature-range", `${feature.length} values from ${least.toFixed(2)} to ${most.toFixed(2)}`);
  showKeys(byId("blocks"), blocks.map(({ name, n_values }, idx) => [`${spoken(name)} (${n_values})`, seriesColour(idx)]));
};
const showWords = () => {
  hand.showWords(shown.model?.words_m ?? [], words ?? []);
  byId("about-words").hidden = hand.wordCount() === 0;
  words = null;
};

// --- votes: the arbiter waits for so many settled predictions that agree
const showVotes = (frame) => {
  const votes = Object.values(shown.graph?.params ?? {}).find((params) => "votes" in params)?.votes;
  if (!votes) return;
  const isProbed = !["open", "closing", "settled", "ended", "lifting"].includes(frame.phase);
  tell("waits", past.isDecided(frame) ? "" : isProbed ? `Grasp ${frame.grasp_id} is probed; the hand is ${spoken(frame.phase)}.`
    : `Grasp ${frame.grasp_id} waits for ${votes} settled predictions that agree; the hand is ${frame.phase}.`);
};

// --- a moment of a running graph, present or past
const past = makeHistory({
  chart: () => { if (!player.grasps.length) liveChart(); },
  show: (moment, decision, isPaused, lacking) => {
    showDecision(decision);
    if (lacking !== null) {
      byId("stage").classList.add("lacking");
      tell("moment", `the frame that decided grasp ${lacking.grasp_id} is not kept: no hand is drawn`);
      for (const id of ["pads", "joints"]) cut(byId(id), 0);
    }
    showFrame(moment.frame);
    if (isPaused && moment.frame && !isShownHand(moment.frame)) tell("moment", "this frame lacks readings of the hand: an earlier one stays drawn");
    if (isPaused || !moment.frame) tell("waits", "");
    else showVotes(moment.frame);
    // No feature is kept of the frame that decided, and that of another moment would mislead.
    [feature, words] = [moment.feature ?? null, moment.feature ? moment.words : null];
    showFeature();
    showWords();
  },
});
shown.past = past;
const player = makePlayer({ list: past.list, surround: hand.surround, isShownHand, showFrame, showDecision, showShadow, chart });
shown.player = player;
setInterval(() => {
  if (document.hidden || player.grasps.length) return;
  past.refresh();
  if (past.at !== null) return;
  liveChart();
  if (words === null) return;
  showFeature();
  showWords();
}, 100);

// --- the graph
const showGraph = (graph) => {
  shown.graph = graph;
  tell("graph", graph.graph);
  document.title = `${graph.graph} - blindgrasp`;
  graphAt = performance.now();
  ended = null;
  tell("latency", graph.decision_latency_nanos ? `decisions in ${time(graph.decision_latency_nanos.p50)}` : "");
  say(graph.warnings.length ? graph.warnings.join("; ") : graph.state, graph.warnings.length > 0);
  graph.nodes.forEach((node, idx) => {
    const isWell = node.state === "running" || node.state === "done";
    fill(byId("nodes"), idx, [node.node, node.state, node.pid ?? "-", node.cpu_percent?.toFixed(1) ?? "-", node.n_restarts, node.n_swaps, (graph.said[node.node] ?? []).join(", ")],
      [2, 3, 4, 5], [...(isWell ? [] : [1]), ...(node.n_restarts ? [4] : [])]);
  });
  cut(byId("nodes"), graph.nodes.length);
  graph.edges.forEach((edge, idx) => {
    const lost = edge.policy === "lossless" && edge.dropped > 0;
    fill(byId("edges"), idx, [edge.from, edge.to, edge.rate_hz.toFixed(1), edge.age_nanos ? time(edge.age_nanos.p50) : "-",
      edge.age_nanos ? time(edge.age_nanos.p99) : "-", edge.n_queued, edge.dropped, edge.missing], [2, 3, 4, 5, 6, 7],
      [...(lost ? [6] : []), ...(edge.missing ? [7] : [])]);
  });
  cut(byId("edges"), graph.edges.length);
  showChoices(graph);
  if (past.list.asked !== null) past.list.goTo(past.list.asked);
  past.list.asked = null;
  if (shown.frame === null && graph.listens) tell("moment", `no frame yet: waits for a bridge at ${graph.listens}; docs/hardware.md says what it sends`);
};

// --- ages: an old state must not look like the present one
let graphAt = null, frameAt = null, decidedAt = null;
// The event that says that there is nothing to come: `ended` may be followed by the next run, `finished` by another server.
let ended = null;
function isOver() { return ended !== null; }
const age = (at) => `${Math.max(0, (performance.now() - at) / 1000).toFixed(0)} s`;
setInterval(() => {
  // A recording is never old, nor is a moment that was chosen.
  const isLive = !player.grasps.length && past.at === null;
  const isSilent = graphAt === null || performance.now() - graphAt > SILENT_MS;
  const isFrameOld = frameAt === null || performance.now() - frameAt > SILENT_MS;
  if (isLive && graphAt !== null && isSilent && !isOver()) say(`no news of the graph since ${age(graphAt)}`, true);
  document.body.classList.toggle("stale", isLive && isSilent);
  byId("stage").classList.toggle("old", isLive && isFrameOld);
  tell("decided", isLive && decidedAt !== null ? `decided ${age(decidedAt)} ago` : "");
  tell("frame-age", isLive && frameAt !== null && isFrameOld ? `last frame ${age(frameAt)} ago` : "");
}, 500);

readLog();

// --- the stream
const source = new EventSource(eventsAddress());
const on = (name, take) => source.addEventListener(name, (event) => take(JSON.parse(event.data)));
on("server", (server) => {
  // Another server at the same address: the page begins anew.
  if (shown.server !== null && shown.server !== server) location.reload();
  shown.server = server;
});
on("scene", (scene) => {
  // It comes again after a broken connection. The scene of the next run begins anew.
  if (shown.scene && !isOver() && JSON.stringify(shown.scene) === JSON.stringify(scene)) return;
  shown.scene = scene;
  [largest, shown.frame, feature, words] = [1, null, null, null];
  past.clear();
  showWords();
  showFeature();
  showScale();
  showDecision(null);
  tell("waits", "");
  showShadow(null);
  for (const id of ["pads", "joints"]) cut(byId(id), 0);
  tell("moment", scene ? "no frame yet" : "the graph has no hand that can be shown");
  // Without a frame its posture is not known.
  byId("stage").classList.add("lacking");
  hand.build(scene ?? { links: [], cells: [], hand_colour: [0, 0, 0] });
});
on("frame", (event) => {
  const now = performance.now(), { probabilities, shadow, decisions, labels, feature: values, words: weights } = event;
  const frame = isShownHand(event) ? event : undefined;
  hasShadow ||= shadow.length > 0;
  past.push({
    at: now, probabilities: probabilities.filter((p) => p !== null), shadow: shadow.filter((p) => p !== null), decisions, frame,
    forces: frame && touchOf(frame).map(({ sum }) => sum), feature: values?.length ? values : undefined, words: values?.length ? weights : undefined,
  });
  for (const label of labels) {
    past.label(label);
    const [epoch, grasp_id, truth] = label;
    if (shown.decision && keyOf(shown.decision) === keyOf({ epoch, grasp_id })) showDecision({ ...shown.decision, truth });
  }
  if (frame) frameAt = now;
  if (past.at !== null) return;
  if (frame) {
    showFrame(frame);
    showVotes(frame);
  }
  if (values?.length) [feature, words] = [values, weights];
});
on("decision", (decision) => {
  decidedAt = performance.now();
  past.decide(decision);
  if (past.at !== null) return;
  showDecision(decision);
  // The grasp on the page waits no more.
  if (shown.frame && past.isDecided(shown.frame)) tell("waits", "");
  announce(decision);
});
on("shadow", showShadow);
on("graph", showGraph);
on("model", (model) => {
  shown.model = model;
  hand.showWords([], []);
  if (feature) showFeature();
});
on("recording", (recording) => player.start(recording));
on("ended", (why) => {
  [graphAt, ended] = [null, why];
  say(why, true);
});
// The server ends, too.
on("finished", (why) => {
  ended = why;
  say(why, false);
  past.end();
});
on("dropped", (n) => {
  shown.dropped += n;
  byId("missed").textContent = `This browser is too slow: it missed ${shown.dropped} updates of the page. The graph lost nothing.`;
});
source.addEventListener("error", () => { if (!past.isOver()) say("the connection is broken; trying again", true); });
