"use strict";
// Shows a grasp in three dimensions and its frames in time. No library: two shaders, a handful of vectors.
(() => {
  const data = JSON.parse(document.getElementById("grasp").textContent);
  const byId = (id) => document.getElementById(id);
  const slider = byId("frame");
  const rgb = (c) => `rgb(${c[0]} ${c[1]} ${c[2]})`;
  let frameIdx = data.shown;

  // Colour of a cell in a frame, and whether writing on it is white.
  const cellColour = (newtons, idx) => {
    if (newtons === null || !(newtons > data.cells[idx].threshold_newtons)) return { colour: data.silent_colour, active: false };
    const share = Math.min(1, newtons / data.scale_newtons);
    const step = Math.round(share * (data.colours.length - 1));
    return { colour: data.colours[step], active: true, dark: step >= data.first_dark_colour };
  };

  // --- heat maps and slider
  const pads = byId("pads");
  const cellRects = [...pads.querySelectorAll("[data-cell]")];
  const cellTexts = new Map([...pads.querySelectorAll("[data-force]")].map((text) => [Number(text.dataset.force), text]));
  const padTexts = [...pads.querySelectorAll("[data-pad]")];
  const showFrame = (idx) => {
    frameIdx = idx;
    const frame = data.frames[idx];
    slider.value = idx;
    byId("when").textContent =
      `frame ${idx + 1} of ${data.frames.length}, ${frame.phase}, ${frame.since_start_ms.toFixed(0)} ms`;
    for (const rect of cellRects) {
      const cell = Number(rect.dataset.cell);
      const newtons = frame.cells_newtons[cell];
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
        const newtons = frame.cells_newtons[cell];
        if (cellColour(newtons, cell).active) { n += 1; sum += newtons; }
      }
      text.textContent = n === 0 ? "no contact" : `${sum.toFixed(1)} ${data.cell_unit}, ${n} cell${n === 1 ? "" : "s"}`;
    }
    requestDraw();
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

  // --- vectors
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const add = (a, b, t = 1) => [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
  const transform = (m, p) => [0, 4, 8].map((r) => m[r] * p[0] + m[r + 1] * p[1] + m[r + 2] * p[2] + m[r + 3]);

  // Corners with normals: the mean of the faces around a corner that meet at less than 0.6 rad.
  const withNormals = (positions, triangles) => {
    const at = (i) => positions.slice(3 * i, 3 * i + 3);
    const around = new Map(), faces = [];
    for (let t = 0; t < triangles.length; t += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => at(triangles[t + k]));
      const normal = cross(sub(b, a), sub(c, a));
      faces.push(normal);
      for (const corner of [a, b, c]) {
        const key = corner.join();
        if (!around.has(key)) around.set(key, []);
        around.get(key).push(normal);
      }
    }
    const out = [];
    for (let t = 0; t < triangles.length; t++) {
      const corner = at(triangles[t]), own = unit(faces[Math.floor(t / 3)]);
      let sum = [0, 0, 0];
      for (const normal of around.get(corner.join())) {
        if (dot(own, unit(normal)) > Math.cos(0.6)) sum = add(sum, normal);
      }
      out.push(...corner, ...unit(sum));
    }
    return out;
  };

  // A contact's arrow along its normal: a shaft (dashed where no cell feels it) and a head.
  const arrow = (contact, length) => {
    const z = unit(contact.inward_normal);
    const x = unit(cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), y = cross(z, x);
    const ring = (radius, height, n = 16) => Array.from({ length: n }, (_, k) => {
      const angle = 2 * Math.PI * k / n;
      return add(add(add(contact.point_m, z, height), x, radius * Math.cos(angle)), y, radius * Math.sin(angle));
    });
    const out = [], shaft = 0.0011, head = Math.min(0.008, length);
    const band = (low, high) => low.forEach((_, k) => {
      const next = (k + 1) % low.length;
      for (const tri of [[low[k], low[next], high[next]], [low[k], high[next], high[k]]]) {
        const normal = unit(cross(sub(tri[1], tri[0]), sub(tri[2], tri[0])));
        for (const corner of tri) out.push(...corner, ...normal);
      }
    });
    const dash = contact.kind === "sensed" ? length : contact.kind === "unsensed" ? 0.004 : 0.0018;
    for (let from = 0; from < length - head; from += 1.8 * dash) {
      const to = Math.min(from + dash, length - head);
      band(ring(shaft, from), ring(shaft, to));
    }
    band(ring(0.0034, length - head), ring(0.00001, length));
    band(ring(0.00001, length - head), ring(0.0034, length - head));
    return out;
  };

  // --- WebGL
  const canvas = byId("stage");
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  let requestDraw = () => {};
  if (!gl) {
    byId("without-webgl").hidden = false;
    return showFrame(frameIdx);
  }
  const compile = (type, source) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  };
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl.VERTEX_SHADER, `#version 300 es
    in vec3 position; in vec3 normal;
    uniform mat4 palm_from_mesh, view_from_palm, clip_from_view;
    out vec3 normal_in_view;
    void main() {
      mat4 view_from_mesh = view_from_palm * palm_from_mesh;
      normal_in_view = mat3(view_from_mesh) * normal;
      gl_Position = clip_from_view * view_from_mesh * vec4(position, 1.0);
    }`));
  gl.attachShader(program, compile(gl.FRAGMENT_SHADER, `#version 300 es
    precision highp float;
    in vec3 normal_in_view; uniform vec4 colour; out vec4 shown;
    void main() {
      vec3 n = normalize(normal_in_view);
      if (n.z < 0.0) n = -n;
      vec3 lamp = normalize(vec3(-0.45, 0.70, 0.55));
      float light = 0.46 + 0.40 * max(0.0, dot(n, lamp)) + 0.14 * (0.5 + 0.5 * n.y) + 0.16 * n.z
        + 0.10 * pow(max(0.0, dot(n, normalize(lamp + vec3(0.0, 0.0, 1.0)))), 40.0);
      float highlight = clamp(light - 1.0, 0.0, 1.0);
      shown = vec4(colour.rgb * min(light, 1.0) * (1.0 - highlight) + highlight, colour.a);
    }`));
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const [palmFromMesh, viewFromPalm, clipFromView, colour] =
    ["palm_from_mesh", "view_from_palm", "clip_from_view", "colour"].map(uniform);
  const upload = (vertices) => {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
    ["position", "normal"].forEach((name, k) => {
      const place = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 24, 12 * k);
    });
    return { array, n: vertices.length / 6 };
  };
  const links = data.links.map((link) => upload(withNormals(link.positions_m, link.triangles)));
  const cells = data.cells.map((cell) => upload(withNormals(cell.corners_m, [0, 1, 2, 0, 2, 3])));
  const object = data.object && upload(withNormals(data.object.positions_m, data.object.triangles));
  const largest = Math.max(1e-9, ...data.contacts.map((contact) => contact.force_newtons));
  const contactColours = { sensed: [201, 42, 42], unsensed: [52, 58, 70], "on-hand": [103, 65, 217] };
  const arrows = data.contacts.map((contact) =>
    upload(arrow(contact, Math.max(0.010, 0.032 * contact.force_newtons / largest))));

  // What is in the middle: whatever is there in the frame that the picture shows.
  const corners = [];
  data.links.forEach((link, idx) => {
    for (let k = 0; k < link.positions_m.length; k += 3) {
      corners.push(transform(data.frames[data.shown].palm_from_links[idx], link.positions_m.slice(k, k + 3)));
    }
  });
  if (data.object) {
    for (let k = 0; k < data.object.positions_m.length; k += 3) corners.push(data.object.positions_m.slice(k, k + 3));
  }
  const least = [0, 1, 2].map((axis) => corners.reduce((a, p) => Math.min(a, p[axis]), Infinity));
  const most = [0, 1, 2].map((axis) => corners.reduce((a, p) => Math.max(a, p[axis]), -Infinity));
  const middle = [0, 1, 2].map((axis) => (least[axis] + most[axis]) / 2);
  const radius = Math.hypot(...sub(most, least)) / 2;

  const home = { azimuth: data.azimuth_rad, elevation: 0.35, zoom: 1 };
  let view = { ...home };
  const labels = data.contacts.map((contact, idx) => {
    const label = document.createElement("span");
    label.className = contact.kind;
    label.textContent = idx + 1;
    byId("numbers").append(label);
    return label;
  });

  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const { azimuth, elevation, zoom } = view;
    const eye = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const right = unit(cross([0, 0, 1], eye)), up = cross(eye, right);
    const distance = 5 * radius / zoom;
    const row = (axis) => [...axis, -dot(axis, middle)];
    const rows = [row(right), row(up), row(eye)];
    rows[2][3] -= distance;
    const view4 = [0, 1, 2, 3].flatMap((c) => [rows[0][c], rows[1][c], rows[2][c], c === 3 ? 1 : 0]);
    const focal = 5 / 0.78 * Math.min(1, width / height), near = Math.max(0.01 * radius, distance - 3 * radius), far = distance + 3 * radius;
    const clip = [focal * height / width, 0, 0, 0, 0, focal, 0, 0, 0, 0, (near + far) / (near - far), -1, 0, 0, 2 * near * far / (near - far), 0];
    gl.uniformMatrix4fv(viewFromPalm, false, view4);
    gl.uniformMatrix4fv(clipFromView, false, clip);
    const frame = data.frames[frameIdx];
    const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
    const show = (mesh, m, c, alpha) => {
      gl.uniformMatrix4fv(palmFromMesh, false, [0, 1, 2, 3].flatMap((k) => [m[k], m[4 + k], m[8 + k], k === 3 ? 1 : 0]));
      gl.uniform4f(colour, c[0] / 255, c[1] / 255, c[2] / 255, alpha);
      gl.bindVertexArray(mesh.array);
      gl.drawArrays(gl.TRIANGLES, 0, mesh.n);
    };
    links.forEach((link, idx) => show(link, frame.palm_from_links[idx], data.hand_colour, 1));
    cells.forEach((cell, idx) =>
      show(cell, frame.palm_from_links[data.cells[idx].link], cellColour(frame.cells_newtons[idx], idx).colour, 1));
    // Contacts are those of the closed hand.
    const isClosed = frame.phase === data.frames[data.shown].phase;
    if (isClosed) arrows.forEach((mesh, idx) => show(mesh, identity, contactColours[data.contacts[idx].kind], 1));
    if (object) {
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      // Depth first, so that only the object's nearest surface is blended in.
      gl.colorMask(false, false, false, false);
      show(object, identity, data.object_colour, 0);
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.LEQUAL);
      show(object, identity, data.object_colour, 0.55);
      gl.depthFunc(gl.LESS);
      gl.disable(gl.BLEND);
    }
    labels.forEach((label, idx) => {
      const contact = data.contacts[idx];
      const p = add(contact.point_m, contact.inward_normal, -0.009);
      const seen = rows.map((r) => r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]);
      label.style.left = `${width / 2 * (1 + focal * height / width * seen[0] / -seen[2])}px`;
      label.style.top = `${height / 2 * (1 - focal * seen[1] / -seen[2])}px`;
      label.hidden = !isClosed;
    });
  };
  let isRequested = false;
  requestDraw = () => {
    if (isRequested) return;
    isRequested = true;
    requestAnimationFrame(() => { isRequested = false; draw(); });
  };
  const turn = (dx, dy) => {
    view.azimuth -= 0.008 * dx;
    view.elevation = Math.max(-1.5, Math.min(1.5, view.elevation + 0.008 * dy));
    requestDraw();
  };
  const zoom = (factor) => { view.zoom = Math.max(0.4, Math.min(6, view.zoom * factor)); requestDraw(); };
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (canvas.hasPointerCapture(event.pointerId)) turn(event.movementX, event.movementY);
  });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom(Math.exp(-0.002 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { view = { ...home }; requestDraw(); });
  canvas.addEventListener("keydown", (event) => {
    const turns = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };
    if (turns[event.key]) turn(...turns[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(1.15);
    else if (event.key === "-") zoom(1 / 1.15);
    else return;
    event.preventDefault();
  });
  new ResizeObserver(() => requestDraw()).observe(canvas);
  showFrame(frameIdx);
})();
