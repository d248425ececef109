// The viewer of a report: one panorama or photo at a time, decoded when it is chosen.

const nameOf = (kind) => (kind === "truth" ? "ground truth" : kind);

class Viewer {
  constructor(section) {
    this.section = section;
    this.canvas = this.find("canvas");
    this.classes = JSON.parse(document.getElementById("classes").textContent);
    this.nearToFar = JSON.parse(document.getElementById("distances").textContent);
    this.hidden = new Set();
    this.layer = "overlay";
    this.opacity = 0.4;
    this.swipe = 0;
    this.views = [new View(), new Scene()];
    this.inPoints = false;
    this.surface = this.open();
    this.connect();
    this.choose(this.items[0]);
  }

  find(selector) {
    return this.section.querySelector(selector);
  }

  get view() {
    return this.views[Number(this.inPoints)];
  }

  get items() {
    return [...this.section.querySelectorAll(".gallery button")];
  }

  open() {
    try {
      const surface = GlSurface.open(this.canvas);
      if (surface) return surface;
      this.say("This browser offers no WebGL 2: images are shown flat, without points.");
    } catch (error) {
      this.say(`WebGL does not work here, images are shown flat, without points. ${error.message}`);
      const fresh = this.canvas.cloneNode(); // one that had a context cannot have another
      this.canvas.replaceWith(fresh);
      this.canvas = fresh;
    }
    this.views[0].projection = "flat";
    return new FlatSurface(this.canvas);
  }

  say(text) {
    this.find(".message").textContent = text;
  }

  // Images ------------------------------------------------------------------------------------

  async choose(item) {
    for (const other of this.items) other.setAttribute("aria-current", String(other === item));
    this.bringIntoStrip(item);
    this.current = item;
    this.section.classList.add("busy");
    try {
      const data = JSON.parse(item.nextElementSibling.textContent);
      const image = await decodeImage(data, this.surface.mostPixels);
      if (this.current === item) this.show(data, image);
    } catch (error) {
      this.say(`${item.textContent.trim()} cannot be shown: ${error.message}`);
    } finally {
      if (this.current === item) this.section.classList.remove("busy");
    }
  }

  // Not scrollIntoView, which would move the page as well.
  bringIntoStrip(item) {
    const strip = this.find(".gallery");
    const [outer, inner] = [strip.getBoundingClientRect(), item.getBoundingClientRect()];
    const [left, right] = [outer.left + 8 - inner.left, inner.right + 8 - outer.right];
    strip.scrollLeft += Math.max(0, right) - Math.max(0, left);
  }

  show(data, image) {
    this.data = data;
    this.distances = data.scale && new Distances(data.scale, data.sphere, this.nearToFar);
    const aspect = image.input.width / image.input.height;
    this.surface.load(image, data.sphere, this.distances);
    this.paint();
    const [view, scene] = this.views;
    view.show({ sphere: data.sphere, aspect });
    if (this.surface.projections.length === 1) view.projection = "flat";
    this.find(".points").hidden = this.surface.projections.length === 1 || !this.distances?.hasPoints;
    if (this.find(".points").hidden) this.inPoints = false;
    else scene.show(data.scale, data.sphere);
    this.find(".caption").textContent = [data.name, data.note].filter(Boolean).join(" · ");
    this.offerLayers();
    this.offerProjections();
    this.fillLegend();
    this.find(".object").replaceChildren();
    this.redraw();
  }

  paint() {
    const colors = this.distances?.colors ?? this.classes.map(({ rgb }) => rgb);
    this.surface.paint(colors, this.distances ? new Set() : this.hidden);
  }

  offers(layer) {
    const { truth, prediction } = this.data;
    if (layer === "input") return true;
    if (layer === "error") return Boolean(truth && prediction);
    if (layer === "overlay") return Boolean(truth || prediction);
    return Boolean(this.data[layer]);
  }

  offerLayers() {
    for (const radio of this.section.querySelectorAll("input[name=layer]")) {
      radio.closest("label").hidden = !this.offers(radio.value);
    }
    this.setLayer(this.offers(this.layer) ? this.layer : "input");
  }

  setLayer(layer) {
    if (!this.data || !this.offers(layer)) return;
    this.layer = layer;
    this.find(`input[name=layer][value=${layer}]`).checked = true;
    this.find(".opacity").hidden = layer !== "overlay";
    this.find(".errors").hidden = layer !== "error" || this.distances !== null;
    this.fillScale();
    this.redraw();
  }

  offerProjections() {
    const select = this.find(".projection");
    const several = this.data.sphere && this.surface.projections.length > 1;
    select.hidden = !several || this.inPoints;
    select.value = this.views[0].projection;
    this.find(".points").setAttribute("aria-pressed", String(this.inPoints));
  }

  turnPoints() {
    if (this.find(".points").hidden) return;
    this.inPoints = !this.inPoints;
    this.offerProjections();
  }

  // Legend ------------------------------------------------------------------------------------

  fillLegend() {
    const columns = this.distances ? [] : MAPS.slice(0, 2).filter((kind) => this.data[kind]);
    this.find(".legend").hidden = columns.length === 0;
    this.find(".shares").textContent = columns.length ? `share of ${columns.map(nameOf).join(" / ")}, %` : "";
    const entries = this.data.shares.map(([index, ...shares]) => this.legendEntry(index, shares));
    this.find(".legend strong").textContent = `Classes (${entries.length})`;
    this.find(".legend ul").replaceChildren(...entries);
  }

  fillScale() {
    const scale = this.find(".scale");
    const isConfidence = this.layer === "confidence";
    scale.hidden = this.layer === "input" || !(this.distances || isConfidence);
    if (scale.hidden) return;
    if (isConfidence) {
      this.drawScale("confidence", [UNSURE, Array(3).fill(242)], ["0", "50 %", "100 %"]);
      return;
    }
    const { noun, unit, limits, colors } = this.distances;
    const isError = this.layer === "error";
    const shown = isError ? [Array(3).fill(242), WRONG] : colors;
    const middle = Math.sqrt(limits[0] * limits[1]); // colors follow the logarithm
    const numbers = [limits[0], middle, limits[1]].map((value) => this.distances.number(value));
    const ends = isError ? ["0", "0.11", "≥ 0.22"] : numbers;
    const title = isError ? "|ln(prediction / ground truth)|" : `${noun}, ${unit}`;
    this.drawScale(title, shown, ends);
  }

  drawScale(title, colors, ends) {
    const scale = this.find(".scale");
    const shown = colors.map((rgb) => `rgb(${rgb.join(" ")})`);
    scale.querySelector(".title").textContent = title;
    scale.querySelector(".ramp").style.background = `linear-gradient(to right, ${shown.join(", ")})`;
    scale.querySelectorAll(".ends span").forEach((end, k) => (end.textContent = ends[k]));
  }

  legendEntry(index, shares) {
    const entry = document.getElementById("legend-entry").content.cloneNode(true);
    const box = entry.querySelector("input");
    [box.checked, box.value] = [!this.hidden.has(index), index];
    entry.querySelector(".swatch").style.background = `rgb(${this.classes[index].rgb.join(" ")})`;
    entry.querySelector(".name").textContent = this.classes[index].name;
    const percent = (share) => (share === 0 ? "–" : share < 5e-4 ? "< 0.1" : (100 * share).toFixed(1));
    entry.querySelector(".share").textContent = shares.map(percent).join(" / ");
    return entry;
  }

  toggle(boxes, checked) {
    for (const box of boxes) {
      box.checked = checked;
      this.hidden[checked ? "delete" : "add"](Number(box.value));
    }
    this.paint();
    this.redraw();
  }

  // Drawing -----------------------------------------------------------------------------------

  redraw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      if (this.data) this.draw();
    });
  }

  draw() {
    const { canvas, view } = this;
    const density = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * density));
    const height = Math.max(1, Math.round(canvas.clientHeight * density));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    view.resize(canvas.clientWidth, canvas.clientHeight);
    this.surface.draw(view, this.layer, this.opacity, this.swipe, this.gestures.pointer);
    this.find(".swipe").hidden = this.inPoints || this.layer === "input";
    this.find(".looking").textContent = this.inPoints ? this.seenFrom(view) : this.lookingAt(view);
    this.readOut();
  }

  lookingAt(view) {
    const closer = (view.limits.most / view.extent).toFixed(1);
    const zoom = view.projection === "flat" ? `× ${closer}` : `${view.extent.toFixed(0)}° wide`;
    return `Looking at ${this.place(view)} · ${zoom}`;
  }

  seenFrom({ longitude, latitude, away }) {
    const along = this.degrees(longitude, latitude);
    return `Looking along ${along} · ${this.distances.text(away)} to the middle`;
  }

  place({ u, v }) {
    const { sphere, width, height } = this.data;
    if (!sphere) return `column ${Math.floor(u * width)}, row ${Math.floor(v * height)}`;
    return this.degrees((u - 0.5) * 360, (0.5 - v) * 180);
  }

  degrees(...angles) {
    const text = (value) => `${value.toFixed(1).replace(/^-0\.0$/, "0.0").replace("-", "−")}°`;
    const [longitude, latitude] = angles.map(text);
    return `longitude ${longitude}, latitude ${latitude}`;
  }

  readOut() {
    const { pointer } = this.gestures;
    const inImage = () => (pointer ? this.view.locate(...pointer) : this.view);
    const at = this.inPoints ? this.surface.picked : inImage();
    const found = at ? MAPS.map((kind) => this.valueText(kind, at)).filter(Boolean) : [];
    const where = at && (pointer || this.inPoints) ? this.place(at) : "in the middle";
    const shown = at && (pointer || found.length);
    this.find(".readout").textContent = shown ? [where, ...found].join(" · ") : "";
  }

  valueText(kind, at) {
    const bytes = this.surface.valueAt(kind, at);
    if (!bytes) return null;
    if (kind === "confidence") return `${kind}: ${Math.round(bytes[0] / 2.55)} %`;
    const object = kind === "prediction" && this.data.objects?.[bytes[1]];
    if (object) return `${nameOf(kind)}: ${object.class} ${object.number}`;
    if (!this.distances) return `${nameOf(kind)}: ${this.classes[bytes[0]]?.name ?? bytes[0]}`;
    const log = this.distances.log(bytes[0], bytes[1]);
    return `${nameOf(kind)}: ${log === null ? "unknown" : this.distances.text(Math.exp(log))}`;
  }

  // Show the row of the object at a pixel of the canvas in the table of objects, or nothing.
  showObject(x, y) {
    const objects = this.data?.objects;
    const at = objects && this.view.locate(x, y);
    const row = at && objects[this.surface.valueAt("prediction", at)[1]];
    const cell = (kind, text) => Object.assign(document.createElement(kind), { textContent: text });
    const cells = ([name, value]) => [cell("dt", name), cell("dd", value ?? "unknown")];
    this.find(".object").replaceChildren(...Object.entries(row ?? {}).flatMap(cells));
  }

  // Events ------------------------------------------------------------------------------------

  connect() {
    const { canvas, section } = this;
    this.gestures = new Gestures(this);
    section.addEventListener("keydown", (event) => this.key(event));
    section.addEventListener("change", (event) => this.changed(event.target));
    section.addEventListener("click", (event) => this.clicked(event.target.closest("button")));
    this.find(".opacity input").addEventListener("input", (event) => {
      this.opacity = event.target.value / 100;
      this.redraw();
    });
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      [this.data, this.surface.sizes] = [null, null];
      this.say("The graphics card was taken away; the picture comes back with it.");
    });
    canvas.addEventListener("webglcontextrestored", () => {
      this.surface.build();
      this.say("");
      this.choose(this.current);
    });
    this.find(".swipe input").addEventListener("input", (event) => {
      this.swipe = event.target.value / 100;
      this.redraw();
    });
    this.find(".full").hidden = !document.fullscreenEnabled;
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  changed(control) {
    if (control.name === "layer") this.setLayer(control.value);
    else if (control.name === "class") this.toggle([control], control.checked);
    else if (control.classList.contains("projection")) {
      this.view.project(control.value);
      this.redraw();
    }
  }

  clicked(button) {
    if (!button) return;
    const boxes = this.section.querySelectorAll("input[name=class]");
    const actions = {
      all: () => this.toggle(boxes, true),
      none: () => this.toggle(boxes, false),
      in: () => this.view.zoom(1.3),
      out: () => this.view.zoom(1 / 1.3),
      reset: () => this.view.reset(),
      full: () => this.fullScreen(),
      points: () => this.turnPoints(),
    };
    if (button.closest(".gallery")) this.choose(button);
    actions[button.dataset.action]?.();
    this.redraw();
  }

  fullScreen() {
    if (!document.fullscreenEnabled) return;
    if (document.fullscreenElement) document.exitFullscreen();
    else this.find(".panel").requestFullscreen();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const elsewhere = event.target !== this.canvas;
    if (event.target.matches("select, input[type=range]")) return;
    if (elsewhere && /^(Arrow|Enter)/.test(event.key)) return; // of radio buttons and buttons
    const { view } = this;
    const step = view.half / 8;
    const drag = event.shiftKey ? "shift" : "pan";
    const actions = {
      ArrowLeft: () => view[drag](step, 0),
      ArrowRight: () => view[drag](-step, 0),
      ArrowUp: () => view[drag](0, step),
      ArrowDown: () => view[drag](0, -step),
      "+": () => view.zoom(1.25),
      "=": () => view.zoom(1.25),
      "-": () => view.zoom(0.8),
      0: () => view.reset(),
      Home: () => view.reset(),
      Enter: () => this.showObject(...view.canvas.map((side) => side / 2)),
      PageUp: () => this.neighbor(-1),
      PageDown: () => this.neighbor(1),
      f: () => this.fullScreen(),
      p: () => this.turnPoints(),
    };
    LAYERS.forEach((layer, k) => (actions[k + 1] = () => this.setLayer(layer)));
    if (!actions[event.key]) return;
    event.preventDefault();
    this.gestures.pointer = null; // the readout follows the middle
    actions[event.key]();
    this.redraw();
  }

  neighbor(step) {
    const { items } = this;
    this.choose(items[(items.indexOf(this.current) + step + items.length) % items.length]);
  }
}

const section = document.getElementById("viewer");
if (section) new Viewer(section);
