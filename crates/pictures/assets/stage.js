// A hand in three dimensions, with an object, contacts and gravity, on a canvas. All lengths are in metres in the palm frame.
export const MAX_CONTACTS = 64;

// The place of a cell's force among the colours of the scale that ends at `largest`; -1 if the cell feels nothing.
export const colourStep = ({ cells, colours }, newtons, idx, largest) => {
  if (newtons === null || !(newtons > cells[idx].threshold_newtons)) return -1;
  return Math.round(Math.min(1, newtons / largest) * (colours.length - 1));
};

// `three` is the module of scripts/vendor-three. Without WebGL the stage has no `renderer` and draws nothing.
export const makeStage = (three, canvas) => {
  const {
    ArrowHelper, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, Group, HemisphereLight, Mesh, MeshBasicMaterial,
    MeshLambertMaterial, OrbitControls, PerspectiveCamera, Scene, Vector3, WebGLRenderer,
  } = three;
  let renderer;
  try {
    renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    return { renderer: null, build() {}, show() {}, fit() {}, surround() {}, showWords() {}, wordCount: () => 0, lookFrom() {}, drawTo() {}, savePicture() {}, project: () => null };
  }
  const scene = new Scene(), camera = new PerspectiveCamera(35, 1, 0.01, 10);
  camera.up.set(0, 0, 1);
  scene.add(new HemisphereLight(0xffffff, 0x8090a0, 2.2));
  const lamp = new DirectionalLight(0xffffff, 1.6);
  lamp.position.set(-0.5, 0.4, 0.8);
  scene.add(lamp);
  const controls = new OrbitControls(camera, canvas);
  let parts = new Group(), links = [], pads = [], object = null, isDue = false;
  // Towards the camera at first.
  let side = new Vector3(0.5, -0.66, 0.56);
  const contacts = Array.from({ length: MAX_CONTACTS }, () => arrow(0xc92a2a));
  const gravity = arrow(0x1f6feb);

  function arrow(colour) {
    const made = new ArrowHelper(new Vector3(0, 0, 1), new Vector3(), 0.03, colour, 0.010, 0.006);
    made.visible = false;
    scene.add(made);
    return made;
  }
  const guides = makeGuides(three, camera, controls, canvas);
  function render() {
    isDue = false;
    renderer.render(scene, camera);
    guides();
    stage.onDrawn();
  }
  function draw() {
    if (isDue) return;
    isDue = true;
    requestAnimationFrame(render);
  }
  // Poses of links, as the upper three rows of their matrices; a link without one is not there.
  function place(poses) {
    links.forEach((link, idx) => {
      link.visible = Boolean(poses[idx]);
      if (!poses[idx]) return;
      link.matrix.set(...poses[idx], 0, 0, 0, 1);
      link.matrixWorldNeedsUpdate = true;
    });
  }
  // The middle and the size of the hand in its first posture, or in these, and of the object.
  const size = { middle: new Vector3(0, 0, 0.08), radius: 0.15, isKnown: false };
  function measure(postures) {
    const least = new Vector3(Infinity, Infinity, Infinity), most = least.clone().negate(), corner = new Vector3();
    for (const poses of postures) {
      place(poses);
      for (const part of object ? [...links, object] : links) {
        const positions = part.geometry.getAttribute("position");
        for (let k = 0; part.visible && k < positions.count; k++) {
          corner.fromBufferAttribute(positions, k).applyMatrix4(part.matrix);
          least.min(corner);
          most.max(corner);
        }
      }
    }
    size.middle.addVectors(least, most).multiplyScalar(0.5);
    size.radius = least.distanceTo(most) / 2;
    size.isKnown = true;
    home();
  }
  function home() {
    controls.target.copy(size.middle);
    camera.position.copy(side).multiplyScalar(3.4 * size.radius).add(size.middle);
    controls.update();
    draw();
  }
  function resize() {
    const { clientWidth, clientHeight } = canvas;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / Math.max(1, clientHeight);
    camera.updateProjectionMatrix();
    // At once: a new size has emptied the canvas.
    render();
  }
  function turn(right, up) {
    const offset = camera.position.clone().sub(controls.target);
    const across = new Vector3().crossVectors(camera.up, offset).normalize();
    offset.applyAxisAngle(camera.up, right);
    const tilted = offset.clone().applyAxisAngle(across, up);
    // The camera does not pass over the pole.
    if (Math.abs(tilted.clone().normalize().z) < 0.99) offset.copy(tilted);
    camera.position.copy(controls.target).add(offset);
    controls.update();
  }
  controls.addEventListener("change", draw);
  // A page that is scrolled past the canvas scrolls on.
  canvas.addEventListener("wheel", (event) => {
    controls.enableZoom = event.ctrlKey || event.metaKey || document.activeElement === canvas;
  }, { capture: true, passive: true });
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
  canvas.addEventListener("dblclick", home);
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
  function geometry(positions, index) {
    const made = new BufferGeometry();
    made.setAttribute("position", new BufferAttribute(new Float32Array(positions), 3));
    made.setIndex(index);
    made.computeVertexNormals();
    return made;
  }
  const shade = (bytes) => new Color(...bytes.map((part) => part / 255));
  // Two thin triangles for each cell, which stand on it along its normal.
  function needles(cells) {
    const positions = cells.flatMap(({ corners_m }) => {
      const [a, b, c, d] = [0, 3, 6, 9].map((at) => new Vector3(...corners_m.slice(at, at + 3)));
      const middle = a.clone().add(c).multiplyScalar(0.5), along = b.sub(a).normalize(), across = d.sub(a).normalize();
      const tip = new Vector3().crossVectors(along, across).multiplyScalar(0.006).add(middle);
      return [along, across].flatMap((side) =>
        [-0.0003, 0.0003].flatMap((metres) => [...side.clone().multiplyScalar(metres).add(middle)]).concat([...tip]));
    });
    const made = geometry(positions, [...Array(positions.length / 3).keys()]);
    return new Mesh(made, new MeshBasicMaterial({ color: 0xc92a2a, side: DoubleSide }));
  }
  let words = [];
  const octahedron = geometry([1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1],
    [0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]);
  const wordSkin = new MeshLambertMaterial({ color: 0x8f6cf0, flatShading: true, transparent: true, opacity: 0.7 });
  // The colour of each cell as it is drawn, red, green, blue from 0 to 1.
  function colouredCells() {
    const found = [], colour = new Color();
    for (const { idxs, colours } of pads) {
      idxs.forEach((cell, n) => { found[cell] = colour.fromBufferAttribute(colours, 4 * n).getRGB({}, "srgb"); });
    }
    return found.map(({ r, g, b }) => [r, g, b]);
  }
  const stage = {
    renderer,
    // Called after each picture.
    onDrawn() {},
    // The links, and the colours of the cells as they are drawn; tests read them.
    meshes: () => links,
    colouredCells,
    wordCount: () => words.length,
    objectTriangles: () => (object ? object.geometry.index.count / 3 : 0),
    // The place of a point on the canvas, in pixels.
    project(point) {
      const { x, y } = new Vector3(...point).project(camera);
      return [canvas.clientWidth / 2 * (1 + x), canvas.clientHeight / 2 * (1 - y)];
    },
    // Draws the middle of the present picture on another canvas as well.
    drawTo(other) {
      render();
      const width = Math.min(canvas.width, canvas.height * other.width / other.height), height = width * other.height / other.width;
      const [left, top] = [(canvas.width - width) / 2, (canvas.height - height) / 2];
      other.getContext("2d").drawImage(canvas, left, top, width, height, 0, 0, other.width, other.height);
    },
    // Saves the present picture as a file: PNG, on white.
    savePicture(name) {
      const other = document.createElement("canvas");
      [other.width, other.height] = [canvas.width, canvas.height];
      other.getContext("2d").fillStyle = "#ffffff";
      other.getContext("2d").fillRect(0, 0, other.width, other.height);
      this.drawTo(other);
      other.toBlob((blob) => {
        const link = document.createElement("a");
        [link.download, link.href] = [`${name}.png`, URL.createObjectURL(blob)];
        link.click();
      });
    },
    // Looks from a distance that all of these postures can be seen from.
    fit: measure,
    // Looks from this side of the hand.
    lookFrom(azimuth_rad) {
      side = new Vector3(Math.cos(0.35) * Math.cos(azimuth_rad), Math.cos(0.35) * Math.sin(azimuth_rad), Math.sin(0.35));
    },
    // Shows the words of a dictionary as bodies of the size of their weight; none without points.
    showWords(points_m, weights) {
      words.forEach((word) => scene.remove(word));
      words = [];
      const most = Math.max(...weights, 1e-9);
      points_m.forEach((point, idx) => {
        if (!(weights[idx] > 0.02 * most)) return;
        const word = new Mesh(octahedron, wordSkin);
        word.position.set(...point);
        word.scale.setScalar(0.002 + 0.007 * Math.sqrt(weights[idx] / most));
        scene.add(word);
        words.push(word);
      });
      draw();
    },
    // Shows the surface of an object, half transparent, or none.
    surround(data) {
      if (object) scene.remove(object);
      object?.geometry.dispose();
      object?.material.dispose();
      object = null;
      if (data) {
        object = new Mesh(geometry(data.positions_m, data.triangles),
          new MeshLambertMaterial({ color: shade(data.colour), transparent: true, opacity: 0.45, depthWrite: false }));
        scene.add(object);
      }
      draw();
    },
    // Builds a hand, if wanted with a needle for the normal of each cell.
    build(data, hasNeedles = false) {
      scene.remove(parts);
      parts.traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
      parts = new Group();
      const skin = (colour) => new MeshLambertMaterial({ color: shade(colour), flatShading: true });
      const handSkin = skin(data.hand_colour);
      links = data.links.map((link) => {
        const mesh = new Mesh(geometry(link.positions_m, link.triangles), link.colour ? skin(link.colour) : handSkin);
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
          if (hasNeedles) links[link].add(needles(cells));
          return { idxs: cells.map((cell) => cell.idx), colours: made.getAttribute("color") };
        }).filter((pad) => pad !== null);
      scene.add(parts);
      size.isKnown = false;
      draw();
    },
    // Shows a frame: the poses of the links, the colours of the cells (0 to 255), contacts as point, direction, force and perhaps
    // colour, and gravity or null.
    show(frame, cellColours) {
      if (size.isKnown) place(frame.links);
      else measure([frame.links]);
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
        if (contact[7]) made.setColor(contact[7]);
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
  home();
  resize();
  new ResizeObserver(resize).observe(canvas);
  return stage;
};

// The axes of the palm and a bar of a round length, drawn over the canvas; the function that is returned draws them anew.
const makeGuides = ({ Vector3 }, camera, controls, canvas) => {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("aria-hidden", "true");
  Object.assign(svg.style, { position: "absolute", left: 0, bottom: 0, width: "100%", height: "80px", pointerEvents: "none" });
  svg.setAttribute("class", "guides");
  canvas.after(svg);
  const add = (name, attributes) => {
    const made = svg.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    for (const [attribute, value] of Object.entries(attributes)) made.setAttribute(attribute, value);
    return made;
  };
  const path = () => add("path", { fill: "none", stroke: "currentColor", "stroke-width": 1.4 });
  const text = (content) => Object.assign(add("text", { fill: "currentColor", "font-size": 12, "text-anchor": "middle" }), { textContent: content });
  const axes = ["x", "y", "z"].map((name, idx) => ({ direction: new Vector3().setComponent(idx, 1), line: path(), label: text(name) }));
  const bar = path(), length = text("");
  return () => {
    camera.updateMatrixWorld();
    for (const { direction, line, label } of axes) {
      const { x, y } = direction.clone().transformDirection(camera.matrixWorldInverse);
      line.setAttribute("d", `M40 40l${24 * x} ${-24 * y}`);
      label.setAttribute("x", 40 + 33 * x);
      label.setAttribute("y", 44 - 33 * y);
      // An axis that points to the eye has no place for its name.
      label.setAttribute("opacity", Math.hypot(x, y) > 0.3 ? 1 : 0);
    }
    const distance = camera.position.distanceTo(controls.target);
    const pixels_per_m = canvas.clientHeight / (2 * distance * Math.tan(camera.fov * Math.PI / 360));
    const metres = [1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005].find((metres) => metres * pixels_per_m < 130) ?? 0.002;
    const right = canvas.clientWidth - 14, width = metres * pixels_per_m;
    bar.setAttribute("d", `M${right - width} 60v6h${width}v-6`);
    length.textContent = `${metres * 1000} mm`;
    length.setAttribute("x", right - width / 2);
    length.setAttribute("y", 58);
  };
};
