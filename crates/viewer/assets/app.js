// The page of a running graph: draws the events of /events. It sends nothing.
import {
  ArrowHelper, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, Group, HemisphereLight, Mesh, MeshBasicMaterial,
  MeshLambertMaterial, OrbitControls, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from "/three.js";

const byId = (id) => document.getElementById(id);
const CHART_SECS = 20;
const MAX_CONTACTS = 64;
// A screen reader is told a decision at most so often.
const SPOKEN_MS = 2000;

// What is shown, for tests and for the curious.
const shown = (window.blindgrasp = { scene: null, frame: null, decision: null, graph: null, dropped: 0, frames: 0, cellColours: [] });

// --- the hand
const hand = (() => {
  const canvas = byId("stage");
  let renderer;
  try {
    renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    byId("without-webgl").hidden = false;
    return { build() {}, show() {} };
  }
  shown.renderer = renderer;
  const scene = new Scene(), camera = new PerspectiveCamera(35, 1, 0.01, 10);
  camera.up.set(0, 0, 1);
  scene.add(new HemisphereLight(0xffffff, 0x8090a0, 2.2));
  const lamp = new DirectionalLight(0xffffff, 1.6);
  lamp.position.set(-0.5, 0.4, 0.8);
  scene.add(lamp);
  const controls = new OrbitControls(camera, canvas);
  let parts = new Group(), links = [], pads = [], isDue = false;
  const contacts = Array.from({ length: MAX_CONTACTS }, () => arrow(0xc92a2a));
  const gravity = arrow(0x1f6feb);

  function arrow(colour) {
    const made = new ArrowHelper(new Vector3(0, 0, 1), new Vector3(), 0.03, colour, 0.010, 0.006);
    made.visible = false;
    scene.add(made);
    return made;
  }
  function draw() {
    if (isDue) return;
    isDue = true;
    requestAnimationFrame(() => {
      isDue = false;
      renderer.render(scene, camera);
    });
  }
  // The middle and the size of the hand in its first posture.
  const size = { middle: new Vector3(0, 0, 0.08), radius: 0.15, isKnown: false };
  function measure() {
    const least = new Vector3(Infinity, Infinity, Infinity), most = least.clone().negate(), corner = new Vector3();
    for (const link of links) {
      const positions = link.geometry.getAttribute("position");
      for (let k = 0; k < positions.count; k++) {
        corner.fromBufferAttribute(positions, k).applyMatrix4(link.matrix);
        least.min(corner);
        most.max(corner);
      }
    }
    size.middle.addVectors(least, most).multiplyScalar(0.5);
    size.radius = least.distanceTo(most) / 2;
    size.isKnown = true;
    home();
  }
  function home() {
    controls.target.copy(size.middle);
    camera.position.set(0.5, -0.66, 0.56).multiplyScalar(3.4 * size.radius).add(size.middle);
    controls.update();
    draw();
  }
  function resize() {
    const { clientWidth, clientHeight } = canvas;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / Math.max(1, clientHeight);
    camera.updateProjectionMatrix();
    draw();
  }
  function turn(right, up) {
    const offset = camera.position.clone().sub(controls.target);
    const side = new Vector3().crossVectors(camera.up, offset).normalize();
    offset.applyAxisAngle(camera.up, right);
    const tilted = offset.clone().applyAxisAngle(side, up);
    // Not over the pole.
    if (Math.abs(tilted.clone().normalize().z) < 0.99) offset.copy(tilted);
    camera.position.copy(controls.target).add(offset);
    controls.update();
  }
  controls.addEventListener("change", draw);
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
    const zoom = { "+": 0.87, "=": 0.87, "-": 1.15 }[event.key];
    if (turns[event.key]) turn(...turns[event.key]);
    else if (zoom) {
      camera.position.sub(controls.target).multiplyScalar(zoom).add(controls.target);
      controls.update();
    } else if (event.key === "Home") home();
    else return;
    event.preventDefault();
  });
  new ResizeObserver(resize).observe(canvas);
  home();

  function geometry(positions, index) {
    const made = new BufferGeometry();
    made.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
    made.setIndex(index);
    made.computeVertexNormals();
    return made;
  }
  // The colour of each cell as it is drawn, red, green, blue from 0 to 1.
  function colouredCells() {
    const found = [], colour = new Color();
    for (const { idxs, colours } of pads) {
      idxs.forEach((cell, n) => { found[cell] = colour.fromBufferAttribute(colours, 4 * n).getRGB({}, "srgb"); });
    }
    return found.map(({ r, g, b }) => [r, g, b]);
  }
  return {
    build(data) {
      scene.remove(parts);
      parts.traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
      parts = new Group();
      const skin = new MeshLambertMaterial({ color: new Color(...data.hand_colour.map((part) => part / 255)), flatShading: true });
      links = data.links.map((link) => {
        const mesh = new Mesh(geometry(link.positions_m, link.triangles), skin);
        mesh.matrixAutoUpdate = false;
        parts.add(mesh);
        return mesh;
      });
      // The cells of a link are one mesh with a colour for each corner.
      pads = data.links.map((_, link) => data.cells.map((cell, idx) => ({ ...cell, idx })).filter((cell) => cell.link === link))
        .map((cells, link) => {
          if (cells.length === 0) return null;
          const made = geometry(cells.flatMap((cell) => cell.corners_m), cells.flatMap((_, n) => [0, 1, 2, 0, 2, 3].map((k) => 4 * n + k)));
          made.setAttribute("color", new BufferAttribute(new Float32Array(12 * cells.length), 3));
          links[link].add(new Mesh(made, new MeshBasicMaterial({ vertexColors: true, side: DoubleSide })));
          return { idxs: cells.map((cell) => cell.idx), colours: made.getAttribute("color") };
        }).filter((pad) => pad !== null);
      scene.add(parts);
      size.isKnown = false;
      shown.meshes = links;
      shown.colouredCells = colouredCells;
      draw();
    },
    show(frame, cellColours) {
      frame.links.forEach((rows, idx) => {
        if (!links[idx]) return;
        links[idx].matrix.set(...rows, 0, 0, 0, 1);
        links[idx].matrixWorldNeedsUpdate = true;
      });
      if (!size.isKnown) measure();
      const colour = new Color();
      for (const { idxs, colours } of pads) {
        idxs.forEach((cell, n) => {
          colour.setRGB(...cellColours[cell].map((part) => part / 255), "srgb");
          for (let corner = 4 * n; corner < 4 * n + 4; corner++) colours.setXYZ(corner, colour.r, colour.g, colour.b);
        });
        colours.needsUpdate = true;
      }
      contacts.forEach((made, idx) => {
        const contact = frame.contacts[idx];
        made.visible = contact !== undefined;
        if (!contact) return;
        made.position.set(...contact.slice(0, 3));
        made.setDirection(new Vector3(...contact.slice(3, 6)).normalize());
        made.setLength(0.012 + 0.02 * Math.min(1, contact[6] / 2), 0.010, 0.006);
      });
      gravity.visible = frame.gravity !== null;
      if (frame.gravity) {
        gravity.position.copy(size.middle).add(new Vector3(-0.8 * size.radius, 0.8 * size.radius, 0.5 * size.radius));
        gravity.setDirection(new Vector3(...frame.gravity).normalize());
        gravity.setLength(0.06, 0.018, 0.010);
      }
      draw();
    },
  };
})();

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
  shown.cellColours = frame.cells.map(cellColour);
  hand.show(frame, shown.cellColours);
  byId("moment").textContent = `grasp ${frame.grasp_id}, ${frame.phase}`;
  byId("scale").textContent = `(darkest cell: ${largest} ${scene.cell_unit})`;
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
    `${decision.probability_stable.toFixed(2)}.${wrong}`;
  if (performance.now() - spokenAt > SPOKEN_MS) {
    spokenAt = performance.now();
    byId("spoken").textContent = `${action.textContent}. ${byId("why").textContent}`;
  }
};

// --- the chart: times are those of the page's clock
const points = [], marks = [];
const chart = () => {
  const canvas = byId("chart"), ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  pen.scale(ratio, ratio);
  const now = performance.now(), left = 30, bottom = 6;
  const x = (at) => left + (width - left) * (1 - (now - at) / 1000 / CHART_SECS), y = (p) => bottom + (height - 2 * bottom) * (1 - p);
  pen.font = "11px sans-serif";
  pen.fillStyle = colour("--soft");
  pen.strokeStyle = colour("--line");
  for (const p of [0, 0.5, 1]) {
    pen.fillText(p.toFixed(1), 2, y(p) + 4);
    pen.beginPath();
    pen.moveTo(left, y(p));
    pen.lineTo(width, y(p));
    pen.stroke();
  }
  const old = (list) => { while (list.length && now - list[0].at > CHART_SECS * 1000) list.shift(); };
  old(points);
  old(marks);
  for (const mark of marks) {
    pen.strokeStyle = colour(colours[mark.action] ?? "--probe");
    pen.beginPath();
    pen.moveTo(x(mark.at), height);
    pen.lineTo(x(mark.at), height - 14);
    pen.stroke();
  }
  pen.fillStyle = colour("--mark");
  for (const point of points) pen.fillRect(x(point.at) - 1, y(point.p) - 1, 2, 2);
};
setInterval(() => { if (!document.hidden) chart(); }, 100);

// --- the graph
const time = (nanos) => nanos < 1e6 ? `${(nanos / 1e3).toFixed(0)} µs` : nanos < 1e9 ? `${(nanos / 1e6).toFixed(1)} ms` : `${(nanos / 1e9).toFixed(1)} s`;
const say = (text, isTrouble) => {
  if (byId("state").textContent !== text) byId("state").textContent = text;
  byId("state").className = isTrouble ? "trouble" : "";
};
const showGraph = (graph) => {
  shown.graph = graph;
  byId("graph").textContent = graph.graph;
  document.title = `${graph.graph} - blindgrasp`;
  const latency = graph.decision_latency_nanos ? `, decisions in ${time(graph.decision_latency_nanos.p50)}` : "";
  say(graph.warnings.length ? graph.warnings.join("; ") : `${graph.state}${latency}`, graph.warnings.length > 0);
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
};

// --- the stream
const source = new EventSource("/events");
const on = (name, take) => source.addEventListener(name, (event) => take(JSON.parse(event.data)));
on("scene", (scene) => {
  shown.scene = scene;
  [largest, shown.frame] = [1, null];
  for (const id of ["pads", "joints"]) cut(byId(id), 0);
  hand.build(scene);
});
on("frame", (frame) => {
  const now = performance.now();
  for (const p of frame.probabilities) points.push({ at: now, p });
  for (const action of frame.actions) marks.push({ at: now, action });
  if (frame.links) showFrame(frame);
});
on("decision", showDecision);
on("graph", showGraph);
on("ended", (why) => say(why, true));
on("dropped", (n) => {
  shown.dropped += n;
  byId("missed").textContent = `This browser is too slow: it missed ${shown.dropped} updates of the page. The graph lost nothing.`;
});
source.addEventListener("error", () => say("the connection is broken; trying again", true));
