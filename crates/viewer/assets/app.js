// The page of a running graph or a recording: draws the events of /events, and grasps of a recording. With a token in its address it
// sends orders.
import * as three from "/three.js";
import { MAX_CONTACTS, makeStage } from "/stage.js";

const byId = (id) => document.getElementById(id);
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

// --- a frame
const cellColour = (newtons, idx) => {
  const { cells, colours, silent_colour } = shown.scene;
  if (newtons === null || !(newtons > cells[idx].threshold_newtons)) return silent_colour;
  return colours[Math.round(Math.min(1, newtons / largest) * (colours.length - 1))];
};
// The end of the scale of forces: the greatest reading so far, rounded up.
let largest = 1;
const roundUp = (newtons) => {
  const power = 10 ** Math.floor(Math.log10(newtons));
  return power * ([1, 1.5, 2, 3, 4, 5, 6, 8].find((step) => step * power >= newtons) ?? 10);
};
const showFrame = (frame) => {
  const scene = shown.scene;
  if (!scene || frame.cells.length !== scene.cells.length) return;
  const greatest = Math.max(...frame.cells.map((newtons) => newtons ?? 0), 0);
  if (greatest > largest) largest = roundUp(greatest);
  shown.frame = frame;
  shown.frames += 1;
  shown.firstFrameMs ??= performance.now();
  shown.cellColours = frame.cells.map(cellColour);
  hand.show(frame, shown.cellColours);
  byId("moment").textContent = `grasp ${frame.grasp_id}, ${frame.phase}`;
  const more = frame.contacts.length > MAX_CONTACTS ? `; ${MAX_CONTACTS} of ${frame.contacts.length} contacts have an arrow` : "";
  byId("scale").textContent = `(the colours end at ${largest} ${scene.cell_unit}${more})`;
  scene.pads.forEach((pad, idx) => {
    const cells = frame.cells.slice(pad.first_cell, pad.first_cell + pad.n_cells);
    const active = cells.filter((newtons, n) => newtons !== null && newtons > scene.cells[pad.first_cell + n].threshold_newtons);
    const sum = active.reduce((total, newtons) => total + newtons, 0);
    fill(byId("pads"), idx, [scene.pad_names[idx], `${active.length} of ${pad.n_cells}`, `${sum.toFixed(2)} ${scene.cell_unit}`], [1, 2]);
  });
  scene.joints.forEach((name, idx) => fill(byId("joints"), idx, [name, frame.joints[idx].toFixed(4)], [1]));
};

// A row of a table: its texts are set, not made again, so that nothing flickers and a selection stays.
const fill = (body, idx, texts, numbers, troubles = []) => {
  while (body.rows.length <= idx) body.insertRow();
  const row = body.rows[idx];
  texts.forEach((text, n) => {
    const cell = row.cells[n] ?? row.insertCell();
    if (cell.textContent !== String(text)) cell.textContent = text;
    cell.className = [numbers.includes(n) ? "num" : "", troubles.includes(n) ? "trouble" : ""].join(" ").trim();
  });
};
const cut = (body, n) => { while (body.rows.length > n) body.deleteRow(n); };

// --- decisions
const colours = { lift: "--lift", hold: "--hold" };
let spokenAt = -Infinity;
const showDecision = (decision) => {
  shown.decision = decision;
  const action = byId("action");
  action.textContent = decision.action.replaceAll("_", " ");
  action.className = `action ${decision.action in colours ? decision.action : "probe"}`;
  const wrong = decision.action === "lift" && decision.truth === false ? " This lift is wrong: the grasp is known to be unstable." : "";
  byId("why").textContent = `Grasp ${decision.grasp_id}: ${decision.reason.replaceAll("_", " ")}, probability ` +
    `${decision.probability_stable.toFixed(2)}.${decision.why ?? wrong}`;
  // When it was on the screen, which scripts/benchsuite view reads.
  requestAnimationFrame(() => setTimeout(() => {
    shown.painted.push([decision.grasp_id, Date.now()]);
    if (shown.painted.length > 100) shown.painted.shift();
  }));
  if (performance.now() - spokenAt > SPOKEN_MS) {
    spokenAt = performance.now();
    byId("spoken").textContent = `${action.textContent}. ${byId("why").textContent}`;
  }
};

// --- a model beside the graph
const showShadow = (decision) => {
  byId("shadow").textContent = decision === null ? "" : `The model beside: ${decision.action.replaceAll("_", " ").toUpperCase()} for grasp ` +
    `${decision.grasp_id}, ${decision.reason.replaceAll("_", " ")}, probability ${decision.probability_stable.toFixed(2)}.`;
};
const showKey = (hasShadow) => { if (hasShadow) byId("chart-key").hidden = false; };

// --- the chart: the last seconds by the page's clock, or the frames of a recorded grasp
const points = [], shadows = [], marks = [];
const trim = (now) => {
  for (const list of [points, shadows, marks]) {
    const n = list.findIndex((item) => now - item.at <= CHART_SECS * 1000);
    if (n !== 0) list.splice(0, n < 0 ? list.length : n);
  }
};
const pen = (canvas) => {
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
  const made = canvas.getContext("2d");
  made.scale(ratio, ratio);
  return made;
};
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const chart = () => {
  const canvas = byId("chart"), draw = pen(canvas);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight], left = 30, bottom = 6;
  const now = performance.now(), y = (p) => bottom + (height - 2 * bottom) * (1 - p);
  const line = (colourName, ...corners) => {
    draw.strokeStyle = colour(colourName);
    draw.beginPath();
    corners.forEach(([x, y], idx) => (idx ? draw.lineTo(x, y) : draw.moveTo(x, y)));
    draw.stroke();
  };
  draw.font = "11px sans-serif";
  draw.fillStyle = colour("--soft");
  for (const p of [0, 0.5, 1]) {
    draw.fillText(p.toFixed(1), 2, y(p) + 4);
    line("--line", [left, y(p)], [width, y(p)]);
  }
  const x = (share) => left + (width - left) * share;
  const dot = (at, p, size) => draw.fillRect(at - size / 2, y(p) - size / 2, size, size);
  if (player.grasps.length) {
    if (!player.frames.length) return;
    const end = player.frames.at(-1).since_start_ms || 1, at = (frame) => x(frame.since_start_ms / end);
    const present = player.frames[player.n];
    line("--soft", [at(present), 0], [at(present), height]);
    draw.fillStyle = colour("--probe");
    for (const frame of player.frames) if (frame.shadow !== null) dot(at(frame), frame.shadow, 5);
    draw.fillStyle = colour("--mark");
    for (const frame of player.frames) if (frame.probability !== null) dot(at(frame), frame.probability, 5);
    return;
  }
  trim(now);
  draw.setLineDash([5, 4]);
  for (const p of new Set(shown.model ? [shown.model.threshold, shown.model.unsure_from] : [])) line("--soft", [left, y(p)], [width, y(p)]);
  draw.setLineDash([]);
  const at = (item) => x(1 - (now - item.at) / 1000 / CHART_SECS);
  for (const mark of marks) line(colours[mark.action] ?? "--probe", [at(mark), height], [at(mark), height - 14]);
  draw.fillStyle = colour("--probe");
  for (const point of shadows) dot(at(point), point.p, 2);
  draw.fillStyle = colour("--mark");
  for (const point of points) dot(at(point), point.p, 2);
};

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
  // The parts of the feature have colours in turn.
  const ends = [];
  for (const block of shown.model?.blocks ?? []) ends.push((ends.at(-1) ?? 0) + block.n_values);
  feature.forEach((value, idx) => {
    const part = Math.max(0, ends.findIndex((end) => idx < end));
    draw.fillStyle = colour(["--mark", "--soft"][part % 2]);
    const [top, bottom] = [Math.min(y(value), y(0)), Math.max(y(value), y(0))];
    draw.fillRect(idx * step, top, Math.max(1, step - (step > 4 ? 1 : 0)), Math.max(1, bottom - top));
  });
  const parts = (shown.model?.blocks ?? []).map(({ name, n_values }) => `${name.replaceAll("_", " ")} (${n_values})`).join(", ");
  const text = `${feature.length} values from ${least.toFixed(2)} to ${most.toFixed(2)}${parts && `: ${parts}`}`;
  if (byId("blocks").textContent !== text) byId("blocks").textContent = text;
};

// --- votes: the arbiter waits for so many settled predictions that agree
const showVotes = ({ side, n }, frame) => {
  const votes = Object.values(shown.graph?.params ?? {}).find((params) => "votes" in params)?.votes;
  if (!votes) return;
  const isOpen = shown.decision?.grasp_id !== frame.grasp_id || ["squeeze", "test_lift"].includes(shown.decision.action);
  const isProbed = !["open", "closing", "settled", "ended", "lifting"].includes(frame.phase);
  const wanted = `${votes} settled predictions that agree`;
  const text = !isOpen ? "" : isProbed ? `Grasp ${frame.grasp_id} is probed; the hand is ${frame.phase.replaceAll("_", " ")}.` : n === 0 ? `Grasp ${frame.grasp_id} waits for ${wanted}; the hand is ${frame.phase}.`
    : `Grasp ${frame.grasp_id} waits for ${wanted}; the last ${n} say ${side}.`;
  byId("waits").textContent = text;
};

// --- a recording
const player = (() => {
  const state = { grasps: [], at: -1, frames: [], n: 0, isPlaying: false, verdict };
  let opening = 0, abort = null, run = 0, due = 0, wholeStep = 1;
  // The outcome of a grasp, by decision and label.
  function verdict({ action, truth }) {
    if (action === null || truth === null) return "other";
    if (action === "lift") return truth ? "right" : "false-positive";
    if (action !== "hold") return "other";
    return truth ? "false-negative" : "right";
  }
  const colourOf = { right: "--lift", "false-positive": "--hold", "false-negative": "--probe", other: "--soft" };
  const bars = () => {
    const canvas = byId("grasps"), draw = pen(canvas), width = canvas.clientWidth / state.grasps.length;
    state.grasps.forEach((grasp, idx) => {
      const isShown = idx === state.at;
      draw.fillStyle = colour(colourOf[verdict(grasp)]);
      draw.fillRect(idx * width, isShown ? 0 : 12, Math.max(1, width - (width > 4 ? 1 : 0)), isShown ? 40 : 22);
    });
  };
  const showAt = (n) => {
    const frame = state.frames[n], grasp = state.grasps[state.at];
    if (!frame) return;
    state.n = n;
    byId("frame").value = n;
    const nth = wholeStep > 1 ? ` (every ${wholeStep}th is shown)` : "";
    byId("when").textContent = frame.links
      ? `grasp ${grasp.id}, ${frame.since_start_ms.toFixed(0)} ms, frame ${n + 1} of ${state.frames.length}${nth}`
      : `grasp ${grasp.id}, frame ${n + 1}: its joints are not those of the hand`;
    if (frame.links) showFrame(frame);
    chart();
  };
  // Shows a grasp; false if another one was asked for meanwhile, or there is no answer.
  const open = async (idx) => {
    const mine = ++opening, grasp = state.grasps[idx];
    abort?.abort();
    abort = new AbortController();
    [state.at, state.frames, state.n] = [idx, [], 0];
    byId("when").textContent = `loading grasp ${grasp.id}`;
    hand.surround(null);
    showShadow(null);
    bars();
    const label = grasp.truth === null ? "" : grasp.truth ? " It was stable." : " It was not stable.";
    if (grasp.action !== null) showDecision({ ...grasp, grasp_id: grasp.id, why: label });
    else {
      byId("action").textContent = "not recorded";
      byId("action").className = "action";
      byId("why").textContent = `Grasp ${grasp.id}.${label}`;
    }
    try {
      const answer = await fetch(`/grasps/${idx}`, { signal: abort.signal });
      if (!answer.ok) throw new Error(await answer.text());
      const { frames, object, step, shadow } = await answer.json();
      if (mine !== opening) return false;
      [state.frames, wholeStep, due] = [frames, step, performance.now()];
      byId("frame").max = Math.max(0, frames.length - 1);
      hand.surround(object);
      showShadow(shadow);
      showKey(shadow !== null);
      showAt(0);
      return frames.length > 0;
    } catch (error) {
      if (mine === opening) byId("when").textContent = `grasp ${grasp.id} cannot be shown: ${error.message}`;
      return false;
    }
  };
  const setPlaying = (isPlaying) => {
    state.isPlaying = isPlaying;
    byId("play").textContent = isPlaying ? "Pause" : "Play";
    byId("play").setAttribute("aria-pressed", String(isPlaying));
  };
  // Plays at the recording's own pace, and goes on with the next grasp.
  const play = async () => {
    const mine = ++run;
    setPlaying(true);
    if (state.n === state.frames.length - 1) showAt(0);
    due = performance.now();
    while (mine === run) {
      const now = await new Promise(requestAnimationFrame);
      if (mine !== run) return;
      const speed = Number(byId("speed").value), frames = state.frames;
      if (!frames.length) continue;
      const pause = (n) => (frames[n + 1].since_start_ms - frames[n].since_start_ms) / speed;
      let n = state.n;
      while (n + 1 < frames.length && now - due >= pause(n)) {
        due += pause(n);
        n += 1;
      }
      if (n !== state.n) showAt(n);
      else if (n + 1 >= frames.length && now - due > 500 / speed) {
        if (state.at + 1 >= state.grasps.length) break;
        const shownNext = await open(state.at + 1);
        // Another grasp that was chosen meanwhile is played.
        if (!shownNext && byId("when").textContent.includes("cannot be shown")) break;
      }
    }
    if (mine === run) setPlaying(false);
  };
  const stop = () => {
    run += 1;
    setPlaying(false);
  };
  const go = (idx) => { if (idx >= 0 && idx < state.grasps.length) open(idx); };
  byId("before").addEventListener("click", () => go(state.at - 1));
  byId("after").addEventListener("click", () => go(state.at + 1));
  byId("mistake").addEventListener("click", () => {
    const isMistake = (grasp) => verdict(grasp).startsWith("false");
    const idx = state.grasps.findIndex((grasp, idx) => idx > state.at && isMistake(grasp));
    go(idx >= 0 ? idx : state.grasps.findIndex(isMistake));
  });
  byId("play").addEventListener("click", () => (state.isPlaying ? stop() : play()));
  byId("frame").addEventListener("input", () => showAt(Number(byId("frame").value)));
  byId("grasps").addEventListener("click", (event) => go(Math.floor(event.offsetX / byId("grasps").clientWidth * state.grasps.length)));
  new ResizeObserver(() => { if (state.grasps.length) { bars(); chart(); } }).observe(byId("grasps"));
  state.go = go;
  state.start = ({ file, first, grasps }) => {
    // The same recording, after a broken connection.
    if (state.grasps.length) return;
    document.body.classList.add("recorded");
    byId("recording").hidden = false;
    state.grasps = grasps;
    const n = (kind) => grasps.filter((grasp) => verdict(grasp) === kind).length;
    const isKnown = n("other") < grasps.length;
    byId("graph").textContent = file.split("/").at(-1);
    document.title = `${byId("graph").textContent} - blindgrasp`;
    byId("mistake").disabled = !isKnown;
    const without = grasps.every((grasp) => grasp.action === null) ? "no decisions" : "no labels of decided grasps";
    const other = n("other") > 0 ? `, ${n("other")} not known` : "";
    state.summary = isKnown
      ? `${grasps.length} grasps, ${n("false-positive")} false positives, ${n("false-negative")} false negatives${other}`
      : `${grasps.length} grasps, ${without} in the recording`;
    say(state.summary, false);
    open(first);
  };
  return state;
})();
shown.player = player;
setInterval(() => {
  if (document.hidden || player.grasps.length) return;
  chart();
  if (words === null) return;
  showFeature();
  hand.showWords(shown.model?.words_m ?? [], words);
  words = null;
}, 100);

// --- the graph
const time = (nanos) => nanos < 1e6 ? `${(nanos / 1e3).toFixed(0)} µs` : nanos < 1e9 ? `${(nanos / 1e6).toFixed(1)} ms` : `${(nanos / 1e9).toFixed(1)} s`;
function say(text, isTrouble) {
  if (byId("state").textContent !== text) byId("state").textContent = text;
  byId("state").className = isTrouble ? "trouble" : "";
}
const showGraph = (graph) => {
  shown.graph = graph;
  byId("graph").textContent = graph.graph;
  document.title = `${graph.graph} - blindgrasp`;
  graphAt = performance.now();
  byId("latency").textContent = graph.decision_latency_nanos ? `decisions in ${time(graph.decision_latency_nanos.p50)}` : "";
  say(graph.warnings.length ? graph.warnings.join("; ") : graph.state, graph.warnings.length > 0);
  graph.nodes.forEach((node, idx) => {
    const counts = Object.entries(node.counts).filter(([, n]) => n > 0).map(([name, n]) => `${name} ${n}`).join(", ");
    const isWell = node.state === "running" || node.state === "done";
    fill(byId("nodes"), idx, [node.node, node.state, node.pid ?? "-", node.cpu_percent?.toFixed(1) ?? "-", node.n_restarts, node.n_swaps, counts],
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
  if (token) showChoices(graph);
};

// --- orders and the log: with the token that the command has printed in the address
const remembered = (() => { try { return sessionStorage; } catch { return null; } })();
let token = remembered?.getItem("token") ?? null;
const takeToken = () => {
  if (location.hash.length < 2) return;
  token = location.hash.slice(1);
  remembered?.setItem("token", token);
  // It is not seen over a shoulder, nor kept in the history.
  history.replaceState(null, "", location.pathname);
};
takeToken();
window.addEventListener("hashchange", takeToken);
const headers = () => ({ Authorization: `Bearer ${token}`, "Content-Type": "application/json" });
const showLog = (lines) => {
  const body = byId("log"), region = body.closest("div");
  const isAtEnd = region.scrollTop + region.clientHeight >= region.scrollHeight - 4;
  lines.forEach(({ time, operator, level, text, fields }, idx) => {
    const values = Object.entries(fields ?? {}).map(([name, value]) => ` ${name}=${JSON.stringify(value)}`).join("");
    fill(body, idx, [time, operator, level ?? "", text + values], [], ["error", "warn"].includes(level) ? [2] : []);
  });
  cut(body, lines.length);
  if (isAtEnd) region.scrollTop = region.scrollHeight;
};
// A server that knows the token gives the log, and takes orders.
const readLog = async () => {
  let answer = null;
  try {
    if (token && !document.hidden) answer = await fetch("/log", { headers: headers() });
  } catch { /* The stream of events says that the connection is broken. */ }
  if (answer !== null) for (const id of ["control", "log-part"]) byId(id).hidden = !answer.ok;
  if (answer?.ok) showLog(await answer.json());
  setTimeout(readLog, 1000);
};
const order = async (order) => {
  // To stop is possible at any time.
  const buttons = byId("control").querySelectorAll("form button");
  buttons.forEach((button) => { button.disabled = true; });
  byId("answer").textContent = order.compare_secs > 0 ? `compares for ${order.compare_secs} s` : "…";
  byId("answer").classList.remove("trouble");
  try {
    const answer = await fetch("/orders", { method: "POST", headers: headers(), body: JSON.stringify(order) });
    byId("answer").textContent = await answer.text();
    byId("answer").classList.toggle("trouble", !answer.ok);
  } catch (error) {
    byId("answer").textContent = `no answer: ${error.message}`;
    byId("answer").classList.add("trouble");
  }
  buttons.forEach((button) => { button.disabled = false; });
};
// Choices are made again only if they are others, so that a choice stays.
const choose = (id, texts) => {
  const known = [...byId(id).options].map((option) => option.text);
  if (known.join("\n") !== texts.join("\n")) byId(id).replaceChildren(...texts.map((text) => new Option(text)));
};
const presentValue = () => {
  const [node, ...param] = byId("set-param").value.split(".");
  byId("set-value").value = shown.graph?.params[node]?.[param.join(".")] ?? "";
};
const showChoices = ({ nodes, params }) => {
  const before = byId("set-param").value;
  choose("set-param", Object.entries(params).flatMap(([node, of]) => Object.keys(of).map((name) => `${node}.${name}`)));
  choose("swap-node", nodes.map(({ node }) => node));
  if (byId("set-param").value !== before) presentValue();
};
byId("set-param").addEventListener("change", presentValue);
byId("set").addEventListener("submit", (event) => {
  event.preventDefault();
  const [node, ...param] = byId("set-param").value.split(".");
  order({ order: "set", node, param: param.join("."), value: byId("set-value").value });
});
byId("swap").addEventListener("submit", (event) => {
  event.preventDefault();
  const changes = byId("swap-changes").value.split(/\s+/).filter((change) => change !== "");
  order({
    order: "swap", node: byId("swap-node").value, changes, compare_secs: Number(byId("swap-compare").value),
    min_agreement: Number(byId("swap-agreement").value),
  });
});
// The first click asks, the second stops.
const unsure = () => {
  byId("stop").textContent = "Stop the graph";
  byId("stop").classList.remove("sure");
};
byId("stop").addEventListener("blur", unsure);
byId("stop").addEventListener("click", () => {
  if (!byId("stop").classList.contains("sure")) {
    byId("stop").textContent = "Click again to stop the graph";
    byId("stop").classList.add("sure");
    return;
  }
  unsure();
  order({ order: "stop" });
});

// --- ages: an old state must not look like the present one
let graphAt = null, frameAt = null, decidedAt = null;
const age = (at) => (at === null ? "" : `, ${Math.max(0, (performance.now() - at) / 1000).toFixed(0)} s ago`);
setInterval(() => {
  if (player.grasps.length) return;
  const isSilent = graphAt === null || performance.now() - graphAt > SILENT_MS;
  if (graphAt !== null && isSilent) say(`no news of the graph${age(graphAt).replace(", ", " since ").replace(" ago", "")}`, true);
  document.body.classList.toggle("stale", isSilent);
  byId("decided").textContent = decidedAt === null ? "" : `decided${age(decidedAt).slice(1)}`;
  byId("frame-age").textContent = frameAt !== null && performance.now() - frameAt > SILENT_MS ? `last frame${age(frameAt).slice(1)}` : "";
  byId("stage").classList.toggle("old", frameAt === null || performance.now() - frameAt > SILENT_MS);
}, 500);

readLog();

// --- the stream
const source = new EventSource(token ? `/events?token=${encodeURIComponent(token)}` : "/events");
const on = (name, take) => source.addEventListener(name, (event) => take(JSON.parse(event.data)));
on("server", (server) => {
  // Another server at the same address: the page begins anew.
  if (shown.server !== null && shown.server !== server) location.reload();
  shown.server = server;
});
on("scene", (scene) => {
  shown.scene = scene;
  [largest, shown.frame, shown.decision, feature, words] = [1, null, null, null, null];
  hand.showWords([], []);
  showFeature();
  byId("waits").textContent = "";
  showShadow(null);
  for (const id of ["pads", "joints"]) cut(byId(id), 0);
  byId("moment").textContent = scene ? "no frame yet" : "the graph has no hand that can be shown";
  for (const id of ["scale", "why"]) byId(id).textContent = "";
  byId("action").textContent = "none yet";
  byId("action").className = "action";
  hand.build(scene ?? { links: [], cells: [], hand_colour: [0, 0, 0] });
});
on("frame", (frame) => {
  const now = performance.now();
  trim(now);
  for (const p of frame.probabilities) if (p !== null) points.push({ at: now, p });
  for (const p of frame.shadow) if (p !== null) shadows.push({ at: now, p });
  showKey(frame.shadow.length > 0);
  for (const action of frame.actions) marks.push({ at: now, action });
  if (frame.links) {
    frameAt = now;
    showFrame(frame);
    showVotes(frame.votes, frame);
  }
  if (frame.feature?.length) {
    feature = frame.feature;
    words = frame.words;
  }
});
on("decision", (decision) => {
  decidedAt = performance.now();
  showDecision(decision);
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
  graphAt = null;
  say(why, true);
});
on("dropped", (n) => {
  shown.dropped += n;
  byId("missed").textContent = `This browser is too slow: it missed ${shown.dropped} updates of the page. The graph lost nothing.`;
});
source.addEventListener("error", () => say("the connection is broken; trying again", true));
