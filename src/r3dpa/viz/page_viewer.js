// The page around the point clouds: panes, camera, colours, legend and readout.
(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("page").textContent);
  const element = (id) => document.getElementById(id);
  /** New last child of an element. */
  const add = (parent, tag, fields) =>
    Object.assign(parent.appendChild(document.createElement(tag)), fields);
  const MODES = {
    height: "Height", range: "Range", intensity: "Intensity",
    semantic: "Label", instance: "Instance", origin: "Made by",
  };
  const VIEWS = {
    orbit: { target: [7, 0, -1], distance: 40, yaw: 0.5, pitch: 0.45, flat: false },
    above: { target: [0, 0, page.ground_m], distance: 95, yaw: 0, pitch: Math.PI / 2, flat: true },
    sensor: { target: [0, 0, 0], distance: 0.4, yaw: 0, pitch: 0.04, flat: false },
  };
  const RINGS_M = [10, 20, 40, 80];
  const PIXEL_BUDGET = 3.2e6; // of all panes: keeps a turn of the camera smooth on a laptop
  const PICK_RADIUS = 7;

  const tables = { instance: null };
  for (const [mode, scale] of Object.entries(page.scales)) {
    const bytes = Cloud.bytesOf(scale.rgb);
    const colours = Uint32Array.from({ length: 256 }, (_, i) =>
      Cloud.pack(bytes[3 * i], bytes[3 * i + 1], bytes[3 * i + 2]));
    tables[mode] = { ...scale, colours };
  }
  const names = {};
  for (const [mode, rows] of Object.entries(page.categories)) {
    tables[mode] = new Map(rows.map(([id, , colour]) => [id, Cloud.packHex(colour)]));
    names[mode] = new Map(rows.map(([id, name]) => [id, name]));
  }
  const hidden = { semantic: new Set(), origin: new Set() };

  const state = { scan: 0, mode: page.mode, size: 1.5, camera: { ...VIEWS.orbit }, view: "orbit" };
  let picked = null; // {pane, point, pinned}
  let wanted = 0; // number of requested scans: an older one that arrives late is not shown

  const clouds = new Map();
  function cloudOf(number) {
    if (!clouds.has(number)) {
      const header = page.scans[number];
      clouds.set(number, Cloud.unpack(header, element(`points-${number}`).textContent));
    }
    return clouds.get(number);
  }

  class Pane {
    constructor() {
      this.root = add(element("stage"), "div", { className: "pane" });
      this.ground = add(this.root, "canvas", { className: "ground" });
      this.canvas = add(this.root, "canvas", { className: "points" });
      this.marker = add(this.root, "div", { className: "marker", hidden: true });
      const caption = add(this.root, "div", { className: "caption" });
      this.name = add(caption, "b");
      this.note = add(caption, "span");
      this.cloud = null;
    }

    show(header, cloud) {
      Object.assign(this, { header, cloud });
      this.colour();
    }

    colour() {
      if (!this.cloud) return;
      const { mode } = state;
      this.colours = Cloud.colourise(this.cloud, mode, tables[mode], hidden[mode]);
      this.name.textContent = this.header.name;
      const notes = [`${this.header.count.toLocaleString("en")} points`];
      const scans = element("scans").options;
      if (this === panes[0] && scans.length > 1) notes.unshift(`${state.scan + 1} of ${scans.length}`);
      if (mode !== "height" && !this.cloud[mode]) notes.push("grey: not known for this scan");
      this.note.textContent = notes.join(" · ");
    }

    resize(ratio) {
      const { clientWidth, clientHeight } = this.root;
      const [width, height] = [clientWidth, clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
      this.ratio = ratio;
      if (this.frame && this.frame.width === width && this.frame.height === height) return;
      for (const canvas of [this.ground, this.canvas]) [canvas.width, canvas.height] = [width, height];
      this.frame = Cloud.newFrame(width, height);
      this.image = new ImageData(new Uint8ClampedArray(this.frame.colour.buffer), width, height);
    }

    draw() {
      if (!this.cloud) return;
      const { width, height } = this.frame;
      this.projection = Cloud.projectionOf(state.camera, width, height);
      this.drawGround();
      const size = state.size * this.ratio;
      // Range colours show the distance themselves and must match the legend.
      const fade = state.mode === "range" ? null : page.background;
      Cloud.drawPoints(this.frame, this.projection, this.cloud, this.colours, size, fade);
      this.canvas.getContext("2d").putImageData(this.image, 0, 0);
      this.drawMarker();
    }

    /** Distance rings and the ego vehicle on the road, behind all points. */
    drawGround() {
      const context = this.ground.getContext("2d");
      context.clearRect(0, 0, this.ground.width, this.ground.height);
      const line = (corners) => {
        context.beginPath();
        let drawing = false;
        for (const [x, y] of corners) {
          const at = Cloud.project(this.projection, x, y, page.ground_m);
          if (at) drawing ? context.lineTo(at[0], at[1]) : context.moveTo(at[0], at[1]);
          drawing = at !== null;
        }
      };
      context.lineWidth = this.ratio;
      context.font = `${11 * this.ratio}px system-ui, sans-serif`;
      for (const radius of RINGS_M) {
        const turn = Array.from({ length: 181 }, (_, i) => (i * Math.PI) / 90);
        line(turn.map((angle) => [radius * Math.cos(angle), radius * Math.sin(angle)]));
        context.strokeStyle = "rgba(255, 255, 255, 0.16)";
        context.stroke();
        const side = state.camera.yaw - Math.PI / 4;
        const at = Cloud.project(
          this.projection, radius * Math.cos(side), radius * Math.sin(side), page.ground_m);
        context.fillStyle = "rgba(255, 255, 255, 0.55)";
        if (at) context.fillText(`${radius} m`, at[0] + 4 * this.ratio, at[1] - 4 * this.ratio);
      }
      line([...page.ego, page.ego[0]]);
      context.fillStyle = "rgba(214, 69, 65, 0.55)";
      context.fill();
      context.strokeStyle = "rgba(255, 160, 150, 0.9)";
      context.stroke();
    }

    drawMarker() {
      const mine = picked && picked.pane === this;
      const at = mine && Cloud.project(this.projection, ...this.position(picked.point));
      this.marker.hidden = !at;
      if (!at) return;
      this.marker.classList.toggle("pinned", picked.pinned);
      this.marker.style.left = `${at[0] / this.ratio}px`;
      this.marker.style.top = `${at[1] / this.ratio}px`;
    }

    position(point) {
      return this.cloud.xyz.subarray(3 * point, 3 * point + 3);
    }

    pick(event) {
      const box = this.root.getBoundingClientRect();
      const column = (event.clientX - box.left) * this.ratio;
      const row = (event.clientY - box.top) * this.ratio;
      return Cloud.pick(this.frame, column, row, PICK_RADIUS * this.ratio);
    }

    /** [what, value] of one point, as text. */
    describe(point) {
      const { cloud } = this;
      const [x, y, z] = this.position(point);
      const place = [x, y, z].map((v) => v.toFixed(2)).join("  ");
      const rows = [["x, y, z", `${place} m`], ["range", `${cloud.range[point].toFixed(2)} m`]];
      if (cloud.intensity) rows.push(["intensity", cloud.intensity[point].toFixed(2)]);
      for (const mode of ["semantic", "origin"]) {
        if (cloud[mode]) rows.push([MODES[mode].toLowerCase(), names[mode].get(cloud[mode][point])]);
      }
      if (cloud.instance && cloud.instance[point]) rows.push(["instance", cloud.instance[point]]);
      return rows;
    }
  }

  const panes = [new Pane()];
  if (page.beside.length) panes.push(new Pane());

  let scheduled = false;
  function redraw() {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame(() => {
      scheduled = false;
      for (const pane of panes) pane.draw();
    });
  }

  function resize() {
    // On a plain screen too, more pixels than it has: the browser averages them into smooth edges.
    const ratio = Math.min(2, Math.sqrt(PIXEL_BUDGET / (innerWidth * innerHeight)));
    for (const pane of panes) pane.resize(ratio);
    redraw();
  }

  async function showScan(number) {
    const ticket = ++wanted;
    const count = element("scans").options.length;
    const scan = (number + count) % count;
    const [cloud, other] = await Promise.all([scan, ...page.beside.slice(scan, scan + 1)].map(cloudOf));
    if (ticket !== wanted) return;
    if (other) panes[1].show(page.scans[page.beside[scan]], other);
    state.scan = scan;
    element("scans").value = String(scan);
    for (const tile of element("film").querySelectorAll("button")) {
      tile.setAttribute("aria-pressed", String(tile.dataset.scan === String(scan)));
    }
    choose(null);
    panes[0].show(page.scans[scan], cloud);
    const known = Object.keys(MODES).filter((mode) => mode === "height" || cloud[mode]);
    if (!known.includes(state.mode)) state.mode = "height";
    element("mode").replaceChildren(...known.map((mode) => new Option(MODES[mode], mode)));
    showMode(state.mode);
  }

  function showMode(mode) {
    state.mode = element("mode").value = mode;
    for (const pane of panes) pane.colour();
    showLegend();
    redraw();
  }

  function showLegend() {
    const { mode } = state;
    const scale = page.scales[mode];
    const title = mode === "origin" ? "What made the point" : MODES[mode];
    element("legend").querySelector("h2").textContent = scale ? scale.label : title;
    element("scale").hidden = !scale;
    element("entries").replaceChildren();
    if (scale) showScale(mode);
    else if (mode === "instance") showInstances();
    else showCategories(mode);
  }

  function showScale(mode) {
    const scale = tables[mode];
    const bar = new ImageData(new Uint8ClampedArray(scale.colours.buffer), 256, 1);
    element("bar").getContext("2d").putImageData(bar, 0, 0);
    element("ticks").replaceChildren();
    for (const [value, textContent] of scale.ticks) {
      const share = ((value - scale.low) / (scale.high - scale.low)) ** scale.power;
      add(element("ticks"), "span", { textContent }).style.left = `${100 * share}%`;
    }
  }

  function showInstances() {
    const counts = Cloud.countValues(panes[0].cloud.instance);
    const rest = counts.get(0) || 0;
    counts.delete(0);
    const known = panes[0].cloud.count - rest;
    entry(`${counts.size} instances`, known, Cloud.instanceColour(1)).disabled = true;
    entry("no instance", rest, Cloud.instanceColour(0)).disabled = true;
  }

  function showCategories(mode) {
    const counts = Cloud.countValues(panes[0].cloud[mode]);
    const beside = panes[1] ? Cloud.countValues(panes[1].cloud[mode] || []) : [];
    for (const [id, count] of beside) if (!counts.has(id)) counts.set(id, count);
    const present = [...counts].sort((a, b) => b[1] - a[1]);
    const entries = present.map(([id, count]) => {
      const made = entry(names[mode].get(id), count, tables[mode].get(id));
      made.title = "Click to hide or show, shift-click for this one alone";
      made.onclick = (event) => {
        if (event.shiftKey) {
          const others = present.map(([other]) => other).filter((other) => other !== id);
          const alone = !hidden[mode].has(id) && others.every((other) => hidden[mode].has(other));
          hidden[mode] = new Set(alone ? [] : others);
        } else if (!hidden[mode].delete(id)) hidden[mode].add(id);
        press();
        for (const pane of panes) pane.colour();
        redraw();
      };
      return made;
    });
    const press = () => entries.forEach((made, place) => {
      made.setAttribute("aria-pressed", String(!hidden[mode].has(present[place][0])));
    });
    press();
  }

  function entry(name, count, colour) {
    const made = add(element("entries"), "button", { className: "entry" });
    add(made, "i").style.background = Cloud.cssColour(colour);
    add(made, "span", { textContent: name });
    add(made, "small", { textContent: count.toLocaleString("en") });
    return made;
  }

  function choose(choice, event) {
    picked = choice;
    const readout = element("readout");
    readout.hidden = !choice;
    for (const pane of panes) if (pane.cloud && pane.projection) pane.drawMarker();
    if (!choice) return;
    const table = document.createElement("table");
    for (const texts of choice.pane.describe(choice.point)) {
      const row = table.insertRow();
      for (const text of texts) row.insertCell().textContent = text;
    }
    readout.replaceChildren(table);
    const { offsetWidth, offsetHeight } = readout;
    const left = event.clientX + 18 + offsetWidth < innerWidth
      ? event.clientX + 18 : event.clientX - 18 - offsetWidth;
    readout.style.left = `${Math.max(4, left)}px`;
    readout.style.top = `${Math.max(4, Math.min(event.clientY + 14, innerHeight - offsetHeight - 4))}px`;
  }

  function setCamera(camera, view) {
    state.camera = camera;
    state.view = view;
    for (const button of element("views").children) {
      button.classList.toggle("on", button.dataset.view === view);
    }
    redraw();
  }

  function goTo(view) {
    const from = state.camera, to = VIEWS[view];
    const turns = Math.round((from.yaw - to.yaw) / (2 * Math.PI)) * 2 * Math.PI;
    const start = performance.now();
    const duration = matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 350;
    state.view = view;
    const step = (now) => {
      if (state.view !== view) return; // another movement has begun
      const time = duration ? Math.min(1, Math.max(0, now - start) / duration) : 1;
      const part = time * time * (3 - 2 * time);
      const mix = (a, b) => a + part * (b - a);
      setCamera(time === 1 ? { ...to } : {
        target: to.target.map((value, axis) => mix(from.target[axis], value)),
        distance: Math.exp(mix(Math.log(from.distance), Math.log(to.distance))),
        yaw: mix(from.yaw, to.yaw + turns),
        pitch: mix(from.pitch, to.pitch),
        flat: from.flat && to.flat,
      }, view);
      if (time < 1) requestAnimationFrame(step);
    };
    step(start);
  }

  function turn(dx, dy) {
    const { camera } = state;
    const pitch = Math.min(Math.PI / 2, Math.max(-1.2, camera.pitch + dy * 0.006));
    const yaw = camera.yaw - dx * 0.006;
    setCamera({ ...camera, yaw, pitch, flat: camera.flat && pitch === Math.PI / 2 }, null);
  }

  function move(pane, dx, dy) {
    const { camera } = state;
    const { right, up, focal } = Cloud.projectionOf(camera, pane.frame.width, pane.frame.height);
    const metres = (Math.max(camera.distance, 4) / focal) * pane.ratio;
    const target = camera.target.map(
      (value, axis) => value + metres * (dy * up[axis] - dx * right[axis]));
    setCamera({ ...camera, target }, null);
  }

  function zoom(factor) {
    // The added metre lets the wheel leave the sensor's place, where a factor alone would crawl.
    const distance = Math.min(400, Math.max(0.4, (state.camera.distance + 1) * factor - 1));
    setCamera({ ...state.camera, distance }, null);
  }

  function listen(pane) {
    const held = new Map();
    const { root } = pane;
    let moved = 0;
    root.addEventListener("pointerdown", (event) => {
      root.setPointerCapture(event.pointerId);
      held.set(event.pointerId, event);
      moved = 0;
    });
    root.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) {
        if (picked && picked.pinned) return;
        const point = pane.cloud ? pane.pick(event) : -1;
        choose(point < 0 ? null : { pane, point, pinned: false }, event);
        return;
      }
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
      moved += Math.abs(dx) + Math.abs(dy);
      if (moved > 4 && picked && !picked.pinned) choose(null);
      if (held.size > 1) {
        const other = [...held].find(([id]) => id !== event.pointerId)[1];
        const gap = (at) => Math.hypot(at.clientX - other.clientX, at.clientY - other.clientY);
        zoom(Math.max(1, gap(before)) / Math.max(1, gap(event)));
        move(pane, dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons > 1) move(pane, dx, dy);
      else turn(dx, dy);
      held.set(event.pointerId, event);
    });
    root.addEventListener("pointerup", (event) => {
      held.delete(event.pointerId);
      if (moved > 4 || !pane.cloud) return;
      const point = pane.pick(event);
      choose(point < 0 ? null : { pane, point, pinned: true }, event);
    });
    root.addEventListener("pointercancel", (event) => held.delete(event.pointerId));
    root.addEventListener("pointerleave", () => picked && !picked.pinned && choose(null));
    root.addEventListener("contextmenu", (event) => event.preventDefault());
    root.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      zoom(Math.exp(Math.min(120, Math.max(-120, event.deltaY * lines)) * 0.0015));
    }, { passive: false });
  }

  function resizePoints(size) {
    state.size = Math.min(5, Math.max(0.5, size));
    element("size").value = String(state.size);
    redraw();
  }

  function nextMode() {
    const { options, selectedIndex } = element("mode");
    showMode(options[(selectedIndex + 1) % options.length].value);
  }

  const KEYS = {
    ArrowLeft: () => showScan(state.scan - 1),
    ArrowRight: () => showScan(state.scan + 1),
    1: () => goTo("orbit"),
    2: () => goTo("above"),
    3: () => goTo("sensor"),
    r: () => goTo("orbit"),
    c: nextMode,
    "+": () => resizePoints(state.size + 0.25),
    "=": () => resizePoints(state.size + 0.25),
    "-": () => resizePoints(state.size - 0.25),
    Escape: () => choose(null),
  };

  function fail(error) {
    element("failure").hidden = false;
    element("failure").textContent = `This page cannot be shown: ${error.message || error}. ` +
      "It needs a browser of 2023 or newer.";
  }

  /** Strips of range images, grouped under headings; a click shows the cloud. */
  function showFilm() {
    const film = element("film");
    add(film, "h1", { textContent: document.title });
    for (const textContent of page.film.about) add(film, "p", { textContent });
    for (const { title, tiles } of page.film.groups) {
      add(film, "h2", { textContent: title });
      for (const { scan, note, pictures } of tiles) {
        const tile = add(film, "button", { onclick: () => showScan(scan) });
        tile.dataset.scan = scan;
        add(tile, "span", { textContent: page.scans[scan].name });
        add(tile, "small", { textContent: note && ` · ${note}` });
        for (const [name, src] of pictures) add(tile, "img", { src, alt: name, title: name });
      }
    }
    film.hidden = false;
    document.body.classList.add("film");
  }

  async function begin() {
    if (page.film) showFilm();
    const scans = page.scans.slice(0, page.shown);
    element("scans").replaceChildren(
      ...scans.map((header, number) => new Option(`${number + 1} · ${header.name}`, number)));
    element("steps").hidden = element("leaf").hidden = scans.length < 2;
    element("scans").onchange = (event) => showScan(Number(event.target.value));
    element("previous").onclick = KEYS.ArrowLeft;
    element("next").onclick = KEYS.ArrowRight;
    element("mode").onchange = (event) => showMode(event.target.value);
    element("size").oninput = (event) => resizePoints(Number(event.target.value));
    for (const button of element("views").children) button.onclick = () => goTo(button.dataset.view);
    addEventListener("resize", resize);
    addEventListener("keydown", (event) => {
      const typing = ["SELECT", "INPUT"].includes(event.target.tagName);
      if (event.ctrlKey || event.metaKey || event.altKey || typing || !KEYS[event.key]) return;
      event.preventDefault();
      KEYS[event.key]();
    });
    panes.forEach(listen);
    resize();
    setCamera(state.camera, "orbit");
    await showScan(0);
    document.documentElement.dataset.ready = "true";
  }

  addEventListener("unhandledrejection", (event) => fail(event.reason));
  begin();
})();
