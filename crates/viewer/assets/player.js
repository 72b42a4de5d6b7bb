// A recording: its grasps in a row, and one of them frame by frame.

// Colour, top and height of the bar of a grasp: a wrong lift stands out above, a wrong hold below.
const BARS = { right: ["--lift", 14, 14], "false-positive": ["--trouble", 3, 25], "false-negative": ["--hold", 14, 23], other: ["--soft", 18, 6] };

// `list` is the list of the page. Its other functions show parts of the page: `surround` an object, `isShownHand` says whether a frame fits the hand, `showFrame`, `showDecision`, `showShadow`, and `chart`.
const makePlayer = ({ list, surround, isShownHand, showFrame, showDecision, showShadow, chart }) => {
  // `decided` is the number of the frame that decided: without a decision, of the last one of the settled hand; or null.
  const state = { grasps: [], at: -1, frames: [], n: 0, decided: null, isPlaying: false, verdict, go, start };
  let opening = 0, abort = null, run = 0, due = 0, wholeStep = 1;
  const bars = () => {
    const canvas = byId("grasps"), draw = pen(canvas), width = canvas.clientWidth / state.grasps.length;
    state.grasps.forEach((grasp, idx) => {
      const [name, top, height] = BARS[verdict(grasp)];
      draw.fillStyle = colour(name);
      draw.fillRect(idx * width, top, Math.max(1, width - (width > 4 ? 1 : 0)), height);
    });
    // The one that is shown stands between two lines.
    draw.fillStyle = colour("--text");
    for (const x of [state.at * width - 2, (state.at + 1) * width]) draw.fillRect(x, 0, 2, 40);
  };
  const showAt = (n) => {
    const frame = state.frames[n], grasp = state.grasps[state.at];
    if (!frame) return;
    state.n = n;
    byId("frame").value = n;
    const nth = wholeStep > 1 ? ` (every ${wholeStep}th is shown)` : "";
    const decided = n !== state.decided ? "" : grasp.action === null ? ", the last settled one" : ", which decided";
    byId("when").textContent = isShownHand(frame)
      ? `grasp ${grasp.id}, ${frame.since_start_ms.toFixed(0)} ms, frame ${n + 1} of ${state.frames.length}${nth}${decided}`
      : `grasp ${grasp.id}, frame ${n + 1}${decided}: its joints or cells are not those of the hand, an earlier frame stays drawn`;
    if (isShownHand(frame)) showFrame(frame);
    chart();
  };
  // Shows a grasp, at its first frame or at the one that decided; false if another one was asked for meanwhile, or there is no
  // answer.
  const open = async (idx, isFirst = false) => {
    const mine = ++opening, grasp = state.grasps[idx];
    abort?.abort();
    abort = new AbortController();
    [state.at, state.frames, state.n, state.decided] = [idx, [], 0, null];
    byId("when").textContent = `loading grasp ${grasp.id}`;
    surround(null);
    showShadow(null);
    bars();
    list.mark(grasp);
    setAddress(grasp, state.grasps);
    const label = grasp.truth === null ? "" : grasp.truth ? " It was stable." : " It was not stable.";
    const object = grasp.object === "" ? "" : ` Object: ${grasp.object}.`;
    if (grasp.action !== null) showDecision({ ...grasp, why: label + object });
    else {
      byId("action").textContent = "no decision recorded";
      byId("action").className = "action none";
      byId("why").textContent = `Grasp ${grasp.id}.${label}${object}`;
    }
    try {
      const answer = await fetch(`/grasps/${idx}`, { signal: abort.signal });
      if (!answer.ok) throw new Error(await answer.text());
      const { frames, decided, object, step, shadow } = await answer.json();
      if (mine !== opening) return false;
      [state.frames, state.decided, wholeStep, due] = [frames, decided, step, performance.now()];
      byId("frame").max = Math.max(0, frames.length - 1);
      surround(object);
      showShadow(shadow);
      showAt(isFirst ? 0 : decided ?? 0);
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
    // A grasp that was opened at the frame that decided is played from its beginning.
    if (state.n === state.frames.length - 1 || state.n === state.decided) showAt(0);
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
        const shownNext = await open(state.at + 1, true);
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
  const toggle = () => (state.isPlaying ? stop() : play());
  function go(idx) { if (idx >= 0 && idx < state.grasps.length) open(idx, state.isPlaying); }
  byId("before").addEventListener("click", () => go(state.at - 1));
  byId("after").addEventListener("click", () => go(state.at + 1));
  byId("mistake").addEventListener("click", () => {
    const isMistake = (grasp) => verdict(grasp).startsWith("false");
    const idx = state.grasps.findIndex((grasp, idx) => idx > state.at && isMistake(grasp));
    stop();
    go(idx >= 0 ? idx : state.grasps.findIndex(isMistake));
  });
  byId("play").addEventListener("click", toggle);
  byId("frame").addEventListener("input", () => showAt(Number(byId("frame").value)));
  byId("grasps").addEventListener("click", (event) => go(Math.floor(event.offsetX / byId("grasps").clientWidth * state.grasps.length)));
  new ResizeObserver(() => { if (state.grasps.length) { bars(); chart(); } }).observe(byId("grasps"));
  function start({ file, first, grasps }) {
    // The same recording, after a broken connection.
    if (state.grasps.length) return say(state.summary, false);
    document.body.classList.add("recorded");
    byId("recording").hidden = false;
    state.grasps = grasps.map((grasp) => ({ ...grasp, grasp_id: grasp.id, first: grasp.object }));
    byId("first-column").textContent = "object";
    list.owner = { choose: (grasp) => go(state.grasps.indexOf(grasp)), toggle };
    list.show(state.grasps);
    const n = (kind) => grasps.filter((grasp) => verdict(grasp) === kind).length;
    const isKnown = n("other") < grasps.length;
    byId("graph").textContent = file.split("/").at(-1);
    document.title = `${byId("graph").textContent} - blindgrasp`;
    byId("mistake").disabled = !isKnown;
    const without = grasps.every((grasp) => grasp.action === null) ? "no decisions" : "no labels of decided grasps";
    const other = n("other") > 0 ? `, ${n("other")} not known` : "";
    state.summary = isKnown
      ? `${counted(grasps.length, "grasp")}, ${counted(n("false-positive"), "false positive")}, ${counted(n("false-negative"), "false negative")}${other}`
      : `${counted(grasps.length, "grasp")}, ${without} in the recording`;
    say(state.summary, false);
    if (list.asked !== null) list.goTo(list.asked);
    if (state.at < 0) open(first);
  }
  return state;
};
