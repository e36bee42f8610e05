// The live view of a scene: sliders, pictures of float32 planes, read-outs. One module for the page of `fspt view`,
// which talks over a WebSocket, and for the widget of a notebook, which talks over the notebook's channel.
//
// Units: W on a pixel; J_n in W/mm²; lengths in mm. Planes have row 0 at the top.

const REST = 150; // ms without a change after which the picture is computed in full
const MAPS = { // 33 colours of matplotlib's maps, dark to bright
  inferno: "0000040403120b0724150b37210c4a2f0a5b3d09654a0c6b57106e64156e71196e7d1e6d8a226a972766a32c61b0315bbc3754c73e4cd24644db503be45a31eb6628f1731df68013f98e09fb9d07fcac11fbbc21f9cb35f5db4cf2ea69f3f68afcffa4",
  viridis: "440154470d6048186a482374472d7b4537814240863e49893b528b375b8d33638d2f6b8e2c728e297a8e26828e23898e21918c1f988b1fa08822a78528ae8032b67a3fbc734ec36b5ec96270cf5784d44b98d83eaddc30c2df23d8e219ece51bfde725",
  grey: "000000ffffff",
  difference: "0530610e41791752901f63a82a71b23480b93f8ec0529dc86bacd184bcd99bc9e0aed3e6c2ddecd4e6f1e0ecf3ecf2f5f7f6f6f9eee7fbe5d8fddcc9fbccb4f8bb9ef5aa89ee9677e48066db6b55d05548c53e3dba2832ab162a930e267c072267001f",
};
const QUANTITIES = { power: "power", error: "error", coverage: "coverage" };
const UNITS = { W: "W/pixel", photons: "photons/s/pixel", radiance: "p/s/cm²/sr" };
const POWER_IN = { W: "power", photons: "photon rate", radiance: "radiance" }; // what the power is called in each unit
const MARKS = { cross: "#4fc3f7", region: "#7cff6b", disc: "#ffffff" };
const PANELS = { a: "lens", b: "second lens", difference: "difference, lens − second lens" };
// What the page's address keeps of the display: choices, switches and numbers, `:NAME=VALUE`; plain names are parameters.
const CHOICES = { quantity: QUANTITIES, unit: UNITS, map: { inferno: "inferno", viridis: "viridis", grey: "grey" } };
const SWITCHES = ["log", "each"];
const NUMBERS = { wavelength: 200, decades: 0.1 }; // and the least value of each
const DEFAULTS = { quantity: "power", unit: "W", wavelength: 660, map: "inferno", log: false, decades: 3, lock: false, each: false };
const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";

let instances = 0;

// ------------------------------------------------------------------ helpers without state

/** An element with attributes and children; `on…` are listeners, `text` is its text. */
function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== undefined && value !== null) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

const palettes = new Map();

/** 256 colours of a map, RGBA bytes, linear between those of `MAPS`. */
function palette(name) {
  if (!palettes.has(name)) palettes.set(name, newPalette(name));
  return palettes.get(name);
}

function newPalette(name) {
  const hex = MAPS[name];
  const count = hex.length / 6;
  const colour = (k) => [0, 2, 4].map((at) => parseInt(hex.substr(6 * k + at, 2), 16));
  const out = new Uint8ClampedArray(256 * 4).fill(255);
  for (let i = 0; i < 256; i++) {
    const place = (i / 255) * (count - 1);
    const k = Math.min(Math.floor(place), count - 2);
    const one = colour(k), next = colour(k + 1);
    for (let c = 0; c < 3; c++) out[4 * i + c] = one[c] + (place - k) * (next[c] - one[c]);
  }
  return out;
}

/** A number with significant digits as a person writes it. */
function digits(value, count = 4) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (value !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(count - 1).replace("e+", "e");
  return String(Number(value.toPrecision(count)));
}

/** Values at ticks of a scale from low to high. */
function ticks(low, high, log) {
  const found = [];
  if (log) {
    for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.floor(Math.log10(high) + 1e-9); e++) found.push(10 ** e);
    return found.length > 1 ? found : [low, high];
  }
  const span = high - low;
  if (!(span > 0)) return [low];
  const decade = 10 ** Math.floor(Math.log10(span));
  const step = [0.2, 0.5, 1, 2].map((s) => s * decade).find((s) => span / s <= 6) ?? 2 * decade;
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high * (1 + 1e-9); k++) found.push(k * step);
  return found;
}

/** A power of ten as a person writes it. */
function powerOfTen(exponent) {
  return `10${exponent < 0 ? "⁻" : ""}${[...String(Math.abs(exponent))].map((digit) => SUPERSCRIPTS[digit]).join("")}`;
}

/** Ticks of an axis from low to high, [value, text] each, and the power of ten that all texts leave out. */
function axis(low, high, log) {
  const values = ticks(low, high, log);
  if (log) {
    const whole = (value) => Math.abs(Math.log10(value) - Math.round(Math.log10(value))) < 1e-9;
    return { marks: values.map((value) => [value, whole(value) ? powerOfTen(Math.round(Math.log10(value))) : digits(value, 2)]), factor: "" };
  }
  const most = Math.max(Math.abs(low), Math.abs(high));
  const exponent = most >= 0.01 && most < 1e4 ? 0 : 3 * Math.floor(Math.log10(most) / 3);
  return { marks: values.map((value) => [value, digits(value / 10 ** exponent, 3)]), factor: exponent ? powerOfTen(exponent) : "" };
}

/** A quantity with its unit and the factor that its numbers leave out. */
function withUnit(quantity, factor, unit) {
  const inside = [factor, unit].filter(Boolean).join(" ");
  return inside ? `${quantity} [${inside}]` : quantity;
}

/** Title and table of rows of texts, the first of each a heading. */
function tableOf(caption, head, rows) {
  const line = ([first, ...others]) => make("tr", {}, make("th", { scope: "row", text: first }), ...others.map((text) => make("td", { text })));
  const title = make("p", { class: "head", text: caption });
  return [title, make("table", { "aria-label": caption },
    ...(head.length ? [make("thead", {}, make("tr", {}, make("td"), ...head.map((text) => make("th", { scope: "col", text }))))] : []),
    make("tbody", {}, ...rows.map(line)))];
}

/** Give a canvas as many pixels as the screen shows, and return its context in CSS pixels with the size. */
function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  const size = [width, height].map((length) => Math.max(1, Math.round(length * ratio)));
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width + 1, height + 1);
  return [context, width, height];
}

function save(name, blob) {
  const address = URL.createObjectURL(blob);
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

// ------------------------------------------------------------------ a picture: planes and what they mean

class Picture {
  /** record: what the program says of it; data: DataView or buffer of float32 planes, one after the other. */
  constructor(record, planes) {
    Object.assign(this, record);
    this.count = this.width * this.height;
    this.plane = {};
    record.planes.forEach((name, k) => { this.plane[name] = planes.subarray(k * this.count, (k + 1) * this.count); });
  }

  /** Factor from W on pixel `i` to a unit; NaN where it is unknown. */
  factor(unit, wavelength, i) {
    if (unit === "W") return 1;
    const photons = wavelength * this.photons_per_joule_nm;
    if (unit === "photons") return photons;
    const etendue = this.plane.etendue;
    return etendue ? (etendue[i] > 0 ? (100 * photons * this.surface_ratio) / etendue[i] : 0) : NaN;
  }

  /** Values of a quantity, shape (h, w) row by row, in a unit. */
  values(quantity, unit, wavelength) {
    const plane = this.plane[quantity];
    if (quantity === "coverage" || unit === "W") return plane;
    const out = new Float64Array(this.count);
    for (let i = 0; i < this.count; i++) out[i] = plane[i] * this.factor(unit, wavelength, i);
    return out;
  }

  /** Error of a sum: errors of the integral add up at most, standard errors of Monte Carlo are independent. */
  get together() { return this.method === "integral" ? (sum, error) => sum + error : Math.hypot; }

  /** Total power of the picture and its error [W]. */
  total() {
    const { power, error } = this.plane, { together } = this;
    let sum = 0, whole = 0;
    for (let i = 0; i < this.count; i++) {
      sum += power[i];
      whole = together(whole, error[i]);
    }
    return [sum, whole];
  }

  /** Middle of a pixel [mm] on the virtual detector plane, x to the right and y up; null if its side is unknown. */
  place(column, row) {
    if (!this.side) return null;
    return [this.corner[0] + column * this.side, this.corner[1] - row * this.side];
  }
}

// ------------------------------------------------------------------ channels

/** Channel of the page: binary messages with a JSON header; it connects again when the program is there again. */
function socketChannel(onMessage, onState) {
  let socket, closed = false;
  const open = () => {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    address.hash = "";
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => onState(true);
    socket.onmessage = ({ data }) => {
      const length = new DataView(data).getUint32(0, true);
      const record = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      onMessage(record, data, 4 + length);
    };
    socket.onclose = () => {
      onState(false);
      if (!closed) setTimeout(open, 1500);
    };
  };
  open();
  return {
    window: 2,
    send: (record) => { if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(record)); },
    close: () => { closed = true; socket.close(); },
  };
}

/** Channel of a notebook's widget. */
function widgetChannel(model, onMessage, onState) {
  const take = (record, buffers) => {
    const parts = buffers.map((b) => new Uint8Array(b.buffer ?? b, b.byteOffset ?? 0, b.byteLength));
    const bytes = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
    parts.reduce((at, part) => (bytes.set(part, at), at + part.length), 0);
    onMessage(record, bytes.buffer, 0);
  };
  model.on("msg:custom", take);
  onState(true);
  setTimeout(() => model.send({ kind: "hello" }), 0);
  return { window: 1, send: (record) => model.send(record), close: () => model.off("msg:custom", take) };
}

// ------------------------------------------------------------------ the view

class View {
  constructor(root, connect, keepsHash) {
    this.root = root;
    this.id = `fspt${instances++}`;
    this.keepsHash = keepsHash;
    this.sliders = [];
    this.shows = []; // functions that show the value of a slider again
    this.values = { a: {}, b: {} };
    this.models = { a: "", b: "" };
    this.pictures = {};
    this.progress = { a: { sent: 0, answered: 0, dirty: false }, b: { sent: 0, answered: 0, dirty: false } };
    this.number = 0;
    this.faults = {};
    this.second = false;
    this.options = { ...DEFAULTS };
    this.cursor = null; // column and row under the crosshair
    this.region = null; // [column, row, columns, rows]
    this.limits = null;
    this.times = [];
    this.panels = {};
    this.build();
    this.channel = connect((...message) => this.take(...message), (there) => this.connected(there));
    this.resize = new ResizeObserver(() => this.draw());
    this.resize.observe(this.nodes.pictures);
    this.dark = window.matchMedia("(prefers-color-scheme: dark)");
    this.redraw = () => this.draw();
    this.dark.addEventListener("change", this.redraw);
    this.theme = new MutationObserver(this.redraw); // JupyterLab's
    this.theme.observe(document.body, { attributeFilter: ["data-jp-theme-light"] });
  }

  close() {
    this.channel.close();
    this.resize.disconnect();
    this.theme.disconnect();
    this.dark.removeEventListener("change", this.redraw);
  }

  // ---- elements

  build() {
    const nodes = (this.nodes = {});
    nodes.title = make("h1", { text: "fspt view" });
    nodes.state = make("span", { class: "state", role: "status" });
    nodes.fault = make("p", { class: "fault", role: "alert" });
    nodes.notice = make("p", { class: "notice", role: "status" });
    nodes.sliders = make("fieldset", {}, make("legend", { text: "Scene" }));
    nodes.second = make("fieldset", {}, make("legend", { text: "Second lens" }));
    nodes.display = make("fieldset", {}, make("legend", { text: "Display" }));
    nodes.files = make("fieldset", {}, make("legend", { text: "Save" }));
    nodes.pictures = make("main", { class: "pictures" });
    nodes.readout = make("div", { class: "readout", text: "Point at a pixel for its power. Drag for a region, click for the surface point." });
    nodes.point = make("p", { class: "point", role: "status" });
    nodes.region = make("div", { class: "region" });
    nodes.profiles = make("div", { class: "profiles" });
    for (const along of ["row", "column"]) {
      nodes[along] = make("canvas", { class: "profile", role: "img" });
      nodes[`${along}Title`] = make("figcaption");
      nodes.profiles.append(make("figure", {}, nodes[`${along}Title`], nodes[along]));
    }
    this.buildDisplay();
    this.buildFiles();
    this.root.classList.add("fspt");
    this.root.replaceChildren(
      make("header", {}, nodes.title, nodes.state), nodes.fault, nodes.notice,
      make("div", { class: "body" },
        make("form", { "aria-label": "Parameters", onsubmit: (e) => e.preventDefault() },
          nodes.sliders, nodes.second, nodes.display, nodes.files),
        nodes.pictures,
        make("section", { class: "readouts", "aria-label": "Read-outs" }, nodes.readout, nodes.region, nodes.point),
        make("section", { class: "details", "aria-label": "Profiles" }, nodes.profiles)),
    );
    this.addPanel("a");
  }

  choice(name, label, entries) {
    const id = `${this.id}-${name}`;
    const select = make("select", { id, name, onchange: () => this.setOption(name, select.value) });
    for (const [value, text] of Object.entries(entries)) select.append(make("option", { value, text }));
    select.value = this.options[name];
    return make("div", { class: "option" }, make("label", { for: id, text: label }), select);
  }

  check(name, label) {
    const id = `${this.id}-${name}`;
    const box = make("input", { type: "checkbox", id, name, onchange: () => this.setOption(name, box.checked) });
    return make("div", { class: "check" }, box, make("label", { for: id, text: label }));
  }

  figure(name, label, unit, low) {
    const id = `${this.id}-${name}`;
    const field = make("input", { type: "number", id, name, min: low, step: "any", value: this.options[name],
      onchange: () => {
        if (Number(field.value) >= low) this.setOption(name, Number(field.value));
        else field.value = this.options[name];
      } });
    const text = make("label", { for: id }, label, make("span", { class: "unit", text: unit ? ` [${unit}]` : "" }));
    return make("div", { class: "option" }, text, field);
  }

  buildDisplay() {
    this.nodes.wavelength = this.figure("wavelength", "wavelength", "nm", NUMBERS.wavelength);
    this.nodes.decades = this.figure("decades", "decades", "", NUMBERS.decades);
    this.nodes.wavelength.hidden = this.nodes.decades.hidden = true;
    this.nodes.display.append(
      this.choice("quantity", "show", QUANTITIES), this.choice("unit", "unit", UNITS), this.nodes.wavelength,
      this.choice("map", "colours", CHOICES.map),
      this.check("log", "log scale"), this.nodes.decades, this.check("lock", "hold the scale"),
    );
  }

  buildFiles() {
    this.nodes.command = make("code", { tabindex: 0, "aria-label": "command line that makes this picture" });
    this.nodes.files.append(
      make("div", { class: "choices" },
        make("button", { type: "button", name: "png", text: "PNG", onclick: () => this.savePng() }),
        make("button", { type: "button", name: "exr", text: "EXR", onclick: () => this.ask("exr", "a") }),
        make("button", { type: "button", name: "exr-b", text: "EXR, second lens", hidden: true, onclick: () => this.ask("exr", "b") }),
        make("button", { type: "button", name: "copy", text: "copy command", onclick: () => this.copyCommand() })),
      this.nodes.command,
    );
  }

  copyCommand() {
    navigator.clipboard?.writeText(this.nodes.command.textContent).then(() => this.tell("command copied"), () => {});
  }

  addPanel(name) {
    const canvas = make("canvas", { width: 1, height: 1, role: "application", tabindex: 0, "data-panel": name,
      "aria-label": `picture, ${PANELS[name]}: arrow keys move the crosshair, with Shift the region's corner, Enter asks for the surface point` });
    const marks = make("canvas", { class: "marks", "aria-hidden": "true" });
    const bar = make("canvas", { class: "bar", role: "img" });
    const caption = make("figcaption");
    const frame = make("div", { class: "frame" }, canvas, marks);
    const figure = make("figure", {}, caption, make("div", { class: "shown" }, frame, make("div", { class: "side" }, bar)));
    this.panels[name] = { canvas, marks, bar, caption, figure, frame };
    this.nodes.pictures.append(figure);
    this.listen(name, frame, canvas);
  }

  listen(name, frame, canvas) {
    let start = null;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      const clamp = (share, count) => Math.max(0, Math.min(count - 1, Math.floor(share * count)));
      return [clamp((event.clientX - box.left) / box.width, canvas.width), clamp((event.clientY - box.top) / box.height, canvas.height)];
    };
    frame.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      start = at(event);
      frame.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
    });
    frame.addEventListener("pointermove", (event) => {
      this.cursor = at(event);
      if (start && (start[0] !== this.cursor[0] || start[1] !== this.cursor[1])) this.region = between(start, this.cursor);
      this.drawReadouts();
    });
    frame.addEventListener("pointerup", (event) => {
      const end = at(event);
      if (start && start[0] === end[0] && start[1] === end[1]) this.askPoint(name, end);
      start = null;
    });
    canvas.addEventListener("keydown", (event) => this.key(name, canvas, event));
  }

  key(name, canvas, event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const middle = [canvas.width >> 1, canvas.height >> 1];
    if (event.key === "Escape") this.region = null;
    else if (event.key === "Enter") this.askPoint(name, this.cursor ?? middle);
    else if (steps) {
      const before = this.cursor ?? middle;
      const far = event.ctrlKey ? 10 : 1;
      const size = [canvas.width, canvas.height];
      this.cursor = before.map((n, k) => Math.max(0, Math.min(size[k] - 1, n + far * steps[k])));
      if (event.shiftKey) {
        this.anchor ??= before;
        this.region = between(this.anchor, this.cursor);
      } else this.anchor = null;
      this.nodes.readout.setAttribute("role", "status"); // spoken where keys move it
    } else return;
    event.preventDefault();
    this.drawReadouts();
  }

  // ---- sliders

  hello(record) {
    const cut = record.scene.lastIndexOf("/") + 1;
    this.nodes.title.replaceChildren(make("span", { class: "folder", text: record.scene.slice(0, cut) }), record.scene.slice(cut));
    document.title = this.keepsHash ? `${record.scene.slice(cut)} – fspt view` : document.title;
    this.allModels = record.models;
    const first = !this.sliders.length;
    this.sliders = record.sliders;
    const kept = new URLSearchParams(this.keepsHash ? location.hash.slice(1) : "");
    const number = (text, other) => (text !== null && text !== "" && Number.isFinite(Number(text)) ? Number(text) : other);
    for (const { name, value } of this.sliders) {
      this.values.a[name] = first ? number(kept.get(name), value) : this.values.a[name] ?? value;
      this.values.b[name] ??= number(kept.get(`b:${name}`), this.values.a[name]);
    }
    if (first) {
      this.nodes.sliders.append(...this.sliders.map((slider) => this.sliderRow(slider, "a")));
      if (!this.sliders.length) this.nodes.sliders.append(make("p", { text: "The scene has no numeric <default>." }));
      this.buildSecond();
      this.restore(kept);
    }
    for (const slot of this.second ? ["a", "b"] : ["a"]) {
      this.draft(slot);
      this.ask("picture", slot);
    }
  }

  sliderRow(slider, slot) {
    const id = `${this.id}-${slot}-${slider.name}`;
    const value = this.values[slot][slider.name];
    const shape = scaleOf(slider);
    const range = make("input", { type: "range", id, name: `${slot}:${slider.name}`, min: shape.low, max: shape.high, step: shape.step });
    const field = make("input", { type: "number", step: "any", "aria-label": `${slider.name}${slider.unit ? `, ${slider.unit}` : ""}` });
    const show = (number, source) => {
      if (source !== field) field.value = number;
      field.style.width = `max(6.5em, ${field.value.length + 4}ch)`; // all digits
      if (source !== range) range.value = shape.position(number);
      range.setAttribute("aria-valuetext", `${digits(number)} ${slider.unit}`.trim());
    };
    show(value);
    if (slot === "a") this.shows.push(() => show(this.values.a[slider.name]));
    const set = (number, source) => {
      this.values[slot][slider.name] = number;
      show(number, source);
      this.changed(slot);
    };
    range.addEventListener("input", () => set(shape.value(Number(range.value)), range));
    field.addEventListener("input", () => {
      if (field.value !== "" && Number.isFinite(Number(field.value))) set(Number(field.value), field);
    });
    field.addEventListener("change", () => show(this.values[slot][slider.name])); // in place of an empty field
    const label = make("label", { for: id }, slider.name, make("span", { class: "unit", text: slider.unit ? ` [${slider.unit}]` : "" }));
    return make("div", { class: "slider" }, label, field, range);
  }

  buildSecond() {
    const id = `${this.id}-second`;
    const box = make("input", { type: "checkbox", id, name: "second", onchange: () => this.setSecond(box.checked) });
    this.nodes.secondRows = make("div", { hidden: true });
    const models = (slot) => {
      const of = `${this.id}-model-${slot}`;
      const select = make("select", { id: of, name: `model-${slot}`, onchange: () => { this.models[slot] = select.value; this.changed(slot); } },
        make("option", { value: "", text: "of the scene" }), ...this.allModels.map((name) => make("option", { value: name, text: name })));
      return make("div", { class: "option" }, make("label", { for: of, text: "lens model" }), select);
    };
    this.nodes.sliders.append(models("a"), make("div", { class: "choices" }, make("button", { type: "button", name: "reset", text: "values of the scene", onclick: () => this.reset() })));
    this.nodes.secondRows.append(...this.sliders.filter((s) => s.lens).map((s) => this.sliderRow(s, "b")), models("b"));
    this.nodes.secondRows.append(this.check("each", "a colour scale for each"));
    this.nodes.second.append(make("div", { class: "check" }, box, make("label", { for: id, text: "beside the first, with their difference" })), this.nodes.secondRows);
  }

  /** Give the first lens and the scene the values again that the program was started with. */
  reset() {
    this.models.a = this.root.querySelector('[name="model-a"]').value = "";
    for (const slider of this.sliders) this.values.a[slider.name] = slider.value;
    for (const show of this.shows) show();
    this.changed("a");
  }

  setSecond(on) {
    this.second = on;
    this.nodes.secondRows.hidden = !on;
    this.root.querySelector('[name="exr-b"]').hidden = !on;
    delete this.faults.b;
    for (const name of ["b", "difference"]) {
      if (on) this.addPanel(name);
      else {
        this.panels[name].figure.remove();
        delete this.panels[name];
      }
    }
    delete this.pictures.b;
    if (this.asked?.slot === "b") {
      this.asked = this.place = null;
      this.tell("");
    }
    if (on) this.changed("b");
    this.keep();
    this.draw();
  }

  setOption(name, value) {
    this.options[name] = value;
    if (name === "lock") this.limits = value ? this.scale() : null;
    else if (["quantity", "unit", "log", "wavelength", "decades", "each"].includes(name)) this.limits = null;
    this.nodes.wavelength.hidden = this.options.unit === "W";
    this.nodes.decades.hidden = !this.options.log;
    this.keep();
    const lacks = this.options.unit === "radiance" && Object.values(this.pictures).some((p) => !p.plane.etendue);
    if (lacks) for (const slot of Object.keys(this.pictures)) this.ask("picture", slot);
    this.draw();
    if (name === "lock" && value) this.limits = this.scale();
  }

  /** A value of a slot has changed: drafts now, the full picture after a rest. */
  changed(slot) {
    const slots = slot === "a" && this.second ? ["a", "b"] : [slot];
    for (const one of slots) this.draft(one);
    clearTimeout(this.rest);
    this.rest = setTimeout(() => {
      for (const one of this.second ? ["a", "b"] : ["a"]) this.ask("picture", one);
      this.keep();
    }, REST);
  }

  /** Put values, the second lens and the display into the page's address, as far as they differ from the start. */
  keep() {
    if (!this.keepsHash || !this.sliders) return;
    const kept = new URLSearchParams();
    for (const { name, value } of this.sliders) if (this.values.a[name] !== value) kept.set(name, this.values.a[name]);
    if (this.models.a) kept.set(":model-a", this.models.a);
    if (this.second) {
      kept.set(":second", 1);
      for (const { name, lens } of this.sliders) if (lens && this.values.b[name] !== this.values.a[name]) kept.set(`b:${name}`, this.values.b[name]);
      if (this.models.b) kept.set(":model-b", this.models.b);
    }
    for (const name of [...Object.keys(CHOICES), ...SWITCHES, ...Object.keys(NUMBERS)]) {
      if (this.options[name] !== DEFAULTS[name]) kept.set(`:${name}`, SWITCHES.includes(name) ? 1 : this.options[name]);
    }
    history.replaceState(null, "", `#${kept}`);
  }

  /** Display, lens models and second lens as the page's address has them; values that make no sense are left out. */
  restore(kept) {
    const control = (name) => this.root.querySelector(`[name="${name}"]`);
    for (const [name, entries] of Object.entries(CHOICES)) if (Object.hasOwn(entries, kept.get(`:${name}`))) this.options[name] = control(name).value = kept.get(`:${name}`);
    for (const name of SWITCHES) if (kept.has(`:${name}`)) this.options[name] = control(name).checked = true;
    for (const [name, low] of Object.entries(NUMBERS)) if (Number(kept.get(`:${name}`)) >= low) this.options[name] = control(name).value = Number(kept.get(`:${name}`));
    for (const slot of ["a", "b"]) {
      const model = kept.get(`:model-${slot}`);
      if (this.allModels.includes(model)) this.models[slot] = control(`model-${slot}`).value = model;
    }
    this.nodes.wavelength.hidden = this.options.unit === "W";
    this.nodes.decades.hidden = !this.options.log;
    if (kept.has(":second")) {
      control("second").checked = true;
      this.setSecond(true);
    }
  }

  // ---- requests and answers

  draft(slot) {
    const progress = this.progress[slot];
    if (progress.sent - progress.answered >= this.channel.window) progress.dirty = true;
    else {
      progress.sent += 1;
      progress.dirty = false;
      progress.last = this.ask("picture", slot, { fine: false });
    }
  }

  ask(kind, slot, more = {}) {
    const values = {};
    for (const slider of this.sliders) {
      const own = slot === "b" && slider.lens ? this.values.b : this.values.a;
      values[slider.name] = String(own[slider.name]);
    }
    this.number += 1;
    const etendue = this.options.unit === "radiance";
    this.channel.send({ kind, slot, number: this.number, values, model: this.models[slot] || null, fine: true, etendue, ...more });
    return this.number;
  }

  askPoint(panel, pixel) {
    this.cursor = pixel;
    this.asked = { slot: panel === "b" ? "b" : "a", pixel };
    this.ask("point", this.asked.slot, { pixel });
    this.drawReadouts();
  }

  take(record, buffer, offset) {
    if (record.kind === "hello") this.hello(record);
    else if (record.kind === "exr") save(record.name, new Blob([new Uint8Array(buffer, offset)], { type: "image/x-exr" }));
    else if (record.kind === "point") this.takePoint(record);
    else {
      if (record.number) this.answered(record);
      if (record.kind === "error") this.setFault(record.slot, record.message);
      else this.takePicture(record, new Float32Array(buffer, offset));
    }
  }

  answered(record) {
    const progress = this.progress[record.slot];
    if (record.number >= (progress.last ?? 0)) progress.answered = progress.sent;
    else if (!record.fine) progress.answered = Math.min(progress.sent, progress.answered + 1);
    if (progress.dirty) this.draft(record.slot);
  }

  takePicture(record, planes) {
    const { slot } = record;
    if ((slot === "b" && !this.second) || record.number < (this.pictures[slot]?.number ?? 0)) return;
    this.pictures[slot] = new Picture(record, planes);
    if (record.wavelength_nm && record.wavelength_nm !== this.options.wavelength) {
      this.options.wavelength = record.wavelength_nm;
      this.nodes.wavelength.querySelector("input").value = record.wavelength_nm;
    }
    this.setFault(slot, "");
    this.times = [...this.times, performance.now()].filter((t) => t > performance.now() - 1000);
    if (this.asked?.slot === slot) this.followPoint(record);
    this.draw();
    this.root.dataset.shown = Number(this.root.dataset.shown ?? 0) + 1;
    this.root.dataset.stage = this.isFine() ? "fine" : "draft";
  }

  /** True once all pictures are those of a rest, and no drafts. */
  isFine() { return (this.second ? ["a", "b"] : ["a"]).every((slot) => this.pictures[slot]?.fine); }

  /** The surface point and its disc belong to the picture that is shown: ask again for those of a new one. */
  followPoint(record) {
    const { slot, pixel } = this.asked;
    const gone = pixel[0] >= record.width || pixel[1] >= record.height;
    this.place = null;
    this.nodes.point.classList.add("old");
    if (gone) {
      this.asked = null;
      this.tell("");
    } else if (record.fine) this.ask("point", slot, { pixel });
  }

  takePoint(record) {
    if (!this.asked || record.slot !== this.asked.slot) return;
    const found = record.point;
    this.place = found ? { ...found, slot: record.slot } : null;
    const [column, row] = record.pixel;
    if (!found) this.tell(`Column ${column}, row ${row}: its line of sight meets no surface.`);
    else {
      const at = found.position.map((x) => digits(x, 5)).join(", ");
      const glow = found.exitance === null ? "does not glow" : `J_n = ${digits(found.exitance, 5)} W/mm²`;
      const blur = found.radius === null ? "unbounded" : `${digits(Math.round(found.radius * 1e3) / 1e3, 3)} pixels`;
      this.tell(`Column ${column}, row ${row}: surface point (${at}) mm on '${found.shape}'${found.by_way_of.length ? ` by way of ${found.by_way_of.join(", ")}` : ""}, ${glow}, depth ${digits(found.depth, 5)} mm, blur disc of radius ${blur}.`);
    }
    this.drawMarks();
  }

  tell(text) {
    this.nodes.point.classList.remove("old");
    this.nodes.point.textContent = text;
  }

  setFault(slot, message) {
    this.faults[slot] = message;
    const text = Object.entries(this.faults).filter(([, line]) => line)
      .map(([where, line]) => (where === "b" ? `Second lens: ${line}` : line)).join(" ");
    if (this.nodes.fault.textContent !== text) this.nodes.fault.textContent = text;
  }

  connected(there) {
    if (there) {
      for (const progress of Object.values(this.progress)) Object.assign(progress, { answered: progress.sent, dirty: false });
    }
    this.setFault("channel", there ? "" : "The program behind this page has ended or cannot be reached. Start 'fspt view' again; the last picture stays.");
  }

  // ---- drawing

  /** What is shown, as texts call it. */
  quantityText() { return this.options.quantity === "power" ? POWER_IN[this.options.unit] : this.options.quantity; }

  unitText() { return this.options.quantity === "coverage" ? "" : UNITS[this.options.unit]; }

  shownValues(slot) {
    const { quantity, unit, wavelength } = this.options;
    return this.pictures[slot]?.values(quantity, unit, wavelength);
  }

  /** Ends of the colour scale in the shown unit, common to both lenses unless each has its own. */
  scale(slot = "a", each = this.options.each) {
    if (this.limits) return this.limits;
    let high = 0;
    for (const one of each ? [slot] : Object.keys(this.pictures)) for (const value of this.shownValues(one)) if (value > high) high = value;
    if (!(high > 0)) high = 1;
    return this.options.log ? [high / 10 ** this.options.decades, high] : [0, high];
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      if (this.pictures.a) this.drawAll();
    });
  }

  /** True where the shown unit needs étendue that a picture does not have yet; one that never will is told of. */
  waits() {
    const pictures = this.options.unit === "radiance" ? Object.values(this.pictures).filter((p) => !p.plane.etendue) : [];
    this.setFault("unit", pictures.find((p) => p.lacks)?.lacks ?? "");
    return pictures.some((p) => !p.lacks);
  }

  drawAll() {
    if (this.waits()) return;
    const { log, map } = this.options;
    const aspect = this.pictures.a.width / this.pictures.a.height;
    this.root.classList.toggle("wide", aspect > 2);
    this.root.style.setProperty("--aspect", aspect.toFixed(3));
    for (const [name, panel] of Object.entries(this.panels)) {
      if (name === "difference") this.drawDifference(panel);
      else if (this.pictures[name]) this.drawPanel(panel, this.pictures[name], this.shownValues(name), ...this.scale(name), log, map);
    }
    for (const [name, panel] of Object.entries(this.panels)) this.drawCaption(name, panel);
    const picture = this.pictures.a;
    const fine = this.isFine(), stage = fine ? "" : ", draft";
    const rtol = picture.rtol ? `, rtol ${digits(picture.rtol)}${stage}` : stage;
    this.nodes.state.textContent = `${picture.width} × ${picture.height}, ${picture.method}${rtol}${!fine && this.times.length > 2 ? `, ${this.times.length} pictures/s` : ""}`;
    if (this.nodes.notice.textContent !== picture.warnings) this.nodes.notice.textContent = picture.warnings;
    this.nodes.command.textContent = picture.command || "No command line makes this picture: it needs a scene file, and the lens model of the scene.";
    this.drawReadouts();
  }

  drawPanel(panel, picture, values, low, high, log, map, quantity = this.quantityText()) {
    const { canvas } = panel;
    if (canvas.width !== picture.width || canvas.height !== picture.height) Object.assign(canvas, { width: picture.width, height: picture.height });
    const context = canvas.getContext("2d");
    const pixels = context.createImageData(picture.width, picture.height);
    const colours = palette(map);
    const words = new Uint32Array(pixels.data.buffer), colourWords = new Uint32Array(colours.buffer);
    const base = Math.log(low), span = log ? Math.log(high) - base : high - low;
    for (let i = 0; i < picture.count; i++) {
      const value = values[i];
      const share = log ? (value > 0 ? (Math.log(value) - base) / span : 0) : (value - low) / span;
      words[i] = colourWords[share > 0 ? (share < 1 ? (255 * share + 0.5) | 0 : 255) : 0];
    }
    context.putImageData(pixels, 0, 0);
    this.drawBar(panel.bar, low, high, log, colours, quantity);
  }

  drawDifference(panel) {
    const { a, b } = this.pictures;
    if (!a || !b || a.count !== b.count) return;
    const one = this.shownValues("a"), other = this.shownValues("b");
    const values = Float64Array.from(one, (value, i) => value - other[i]);
    const reach = values.reduce((most, value) => Math.max(most, Math.abs(value)), 0) || 1;
    panel.values = values;
    this.drawPanel(panel, a, values, -reach, reach, false, "difference", `difference of ${this.quantityText()}`);
  }

  drawBar(canvas, low, high, log, colours, quantity) {
    const { marks, factor } = axis(low, high, log);
    const label = withUnit(quantity, factor, this.unitText());
    canvas.paint = (context, width, height) => this.paintBar(context, width, height, low, high, log, colours, label, marks);
    canvas.paint(...sharp(canvas));
    canvas.setAttribute("aria-label", `colour bar: ${withUnit(quantity, "", this.unitText())}${log ? ", logarithmic," : ""} from ${digits(low)} to ${digits(high)}`);
    Object.assign(canvas.dataset, { low, high, log });
  }

  paintBar(context, width, height, low, high, log, colours, label, marks) {
    const style = getComputedStyle(this.root);
    context.save();
    const top = 8, tall = height - 2 * top, wide = 14;
    for (let y = 0; y < tall; y++) {
      const k = 4 * Math.round(255 * (1 - y / tall));
      context.fillStyle = `rgb(${colours[k]}, ${colours[k + 1]}, ${colours[k + 2]})`;
      context.fillRect(0, top + y, wide, 1.5);
    }
    context.fillStyle = context.strokeStyle = style.color;
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const [value, text] of marks) {
      const share = log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
      const y = top + tall * (1 - share);
      context.fillRect(wide, y, 4, 1);
      context.fillText(text, wide + 7, y, width - wide - 22);
    }
    context.translate(width - 7, height / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText(label, 0, 0, height);
    context.restore();
  }

  drawCaption(name, panel) {
    const picture = this.pictures[name === "b" ? "b" : "a"];
    if (!picture) return;
    if (name === "difference") panel.caption.textContent = `Difference, lens − second lens`;
    else {
      const [total, error] = picture.total();
      const { f_number: stop, focal_length: focal, magnification: t } = picture.lens;
      panel.caption.textContent = `${name === "b" ? "Second lens" : "Lens"}${picture.model ? ` (${picture.model})` : ""}: F = ${digits(focal)} mm, f/${digits(stop)}, magnification ${digits(t)}, total ${digits(total)} ± ${digits(error, 2)} W`;
    }
  }

  drawReadouts() {
    if (!this.pictures.a) return;
    this.drawMarks();
    this.drawReadout();
    this.drawRegion();
    this.drawProfiles();
  }

  drawReadout() {
    if (!this.cursor) return;
    const [column, row] = this.cursor;
    const { unit, wavelength } = this.options;
    const found = {};
    for (const [slot, picture] of Object.entries(this.pictures)) {
      const i = row * picture.width + column;
      if (column >= picture.width || row >= picture.height) continue;
      const factor = picture.factor(unit, wavelength, i);
      found[slot] = ["power", "error", "coverage"].map((name) => picture.plane[name][i] * (name === "coverage" ? 1 : factor));
    }
    const rows = Object.entries(found).map(([slot, [power, error, coverage]]) =>
      [this.second ? PANELS[slot] : "", digits(power, 7), digits(error, 2), digits(coverage, 3)]);
    if (found.a && found.b) {
      const { together } = this.pictures.a;
      rows.push(["difference", digits(found.a[0] - found.b[0], 5), digits(together(found.a[1], found.b[1]), 2), ""]);
      rows.push(["ratio", found.b[0] ? digits(found.a[0] / found.b[0], 5) : "–", "", ""]);
    }
    const mm = this.pictures.a.place(column, row);
    const where = mm ? ` (x ${digits(mm[0])} mm, y ${digits(mm[1])} mm)` : "";
    this.nodes.readout.replaceChildren(...tableOf(`Column ${column}, row ${row}${where}`, [`${POWER_IN[unit]} [${UNITS[unit]}]`, "± error", "coverage"], rows));
  }

  drawRegion() {
    if (!this.region) return this.nodes.region.replaceChildren();
    const [left, top, columns, rows] = this.region;
    const found = Object.values(this.pictures).map((picture) => this.measure(picture));
    const { unit } = this.options;
    const whole = unit === "radiance" ? "W" : UNITS[unit].replace("/pixel", "");
    const line = (name, count, key) => [name, ...found.map((one) => digits(one[key], count))];
    this.nodes.region.replaceChildren(...tableOf(
      `Region of ${columns} × ${rows} pixels from column ${left}, row ${top}`, this.second ? [PANELS.a, PANELS.b].slice(0, found.length) : [], [
        line(`total [${whole}]`, 6, "total"), line("± error", 2, "error"), line(`mean [${UNITS[unit]}]`, 4, "mean"),
        line("largest", 4, "most"), line("standard deviation", 4, "sd"), line("area [mm²]", 4, "area"), line("pixels", 7, "count"),
      ]));
  }

  /** Total, mean and other numbers of the region of a picture, in the shown unit; the total of radiance in W. */
  measure(picture) {
    const [left, top, columns, rows] = this.region;
    const { unit, wavelength } = this.options, { together } = picture;
    let total = 0, error = 0, sum = 0, squares = 0, most = -Infinity, count = 0;
    for (let row = top; row < Math.min(top + rows, picture.height); row++) {
      for (let column = left; column < Math.min(left + columns, picture.width); column++) {
        const i = row * picture.width + column;
        const factor = picture.factor(unit, wavelength, i), whole = unit === "radiance" ? 1 : factor;
        const value = picture.plane.power[i] * factor;
        total += picture.plane.power[i] * whole;
        error = together(error, picture.plane.error[i] * whole);
        sum += value;
        squares += value * value;
        count += 1;
        most = Math.max(most, value);
      }
    }
    const mean = sum / count;
    return { total, error, mean, most, count, sd: Math.sqrt(Math.max(0, squares / count - mean * mean)), area: picture.side ? count * picture.side ** 2 : NaN };
  }

  drawMarks() {
    for (const [name, panel] of Object.entries(this.panels)) {
      const [context, width, height] = sharp(panel.marks);
      const across = width / panel.canvas.width, down = height / panel.canvas.height;
      if (this.cursor) {
        context.fillStyle = MARKS.cross;
        context.globalAlpha = 0.6;
        context.fillRect((this.cursor[0] + 0.5) * across - 0.5, 0, 1, height);
        context.fillRect(0, (this.cursor[1] + 0.5) * down - 0.5, width, 1);
        context.globalAlpha = 1;
      }
      if (this.region) {
        const [left, top, columns, rows] = this.region;
        context.strokeStyle = MARKS.region;
        context.strokeRect(left * across, top * down, columns * across, rows * down);
      }
      if (this.place?.radius && this.place.slot === (name === "b" ? "b" : "a")) {
        context.strokeStyle = MARKS.disc;
        context.lineWidth = 1.5;
        context.beginPath();
        context.ellipse(this.place.column * across, this.place.row * down, Math.max(2, this.place.radius * across), Math.max(2, this.place.radius * down), 0, 0, 2 * Math.PI);
        context.stroke();
      }
    }
  }

  drawProfiles() {
    const { width, height } = this.pictures.a;
    const [column, row] = this.cursor ?? [width >> 1, height >> 1];
    const slots = ["b", "a"].filter((slot) => this.pictures[slot]?.width === width && this.pictures[slot]?.height === height);
    const curves = slots.map((slot) => [slot, this.shownValues(slot)]);
    for (const along of ["row", "column"]) {
      const [at, across, count] = along === "row" ? [row, column, width] : [column, row, height];
      const lines = curves.map(([slot, values]) =>
        [slot, Float64Array.from({ length: count }, (_, k) => values[along === "row" ? row * width + k : k * width + column])]);
      this.paintProfile(this.nodes[along], lines, across, along);
      this.nodes[`${along}Title`].textContent = `Profile along ${along} ${at}`;
      const [low, high] = [Math.min, Math.max].map((end) => digits(lines.at(-1)[1].reduce((most, value) => end(most, value))));
      this.nodes[along].setAttribute("aria-label", `profile along ${along} ${at}: ${low} to ${high} ${this.unitText()}`);
    }
  }

  /** Draw profiles, [slot, values] each, `along` a row or column, with axes in pixels and in mm; `across`: number of the
   * pixel under the crosshair. */
  paintProfile(canvas, lines, across, along) {
    const [context, wide, tall] = sharp(canvas);
    const style = getComputedStyle(this.root);
    const colour = { a: style.getPropertyValue("--accent"), b: style.getPropertyValue("--other") };
    const faint = style.getPropertyValue("--faint"), rule = style.getPropertyValue("--line");
    const { side } = this.pictures.a;
    const left = 38, right = 10, top = 22, bottom = side ? 36 : 20, count = lines[0][1].length;
    const { log } = this.options;
    const [low, high] = this.scale("a", false);
    const { marks, factor } = axis(low, high, log);
    const share = (value) => (log ? (value > 0 ? Math.log(value / low) / Math.log(high / low) : -1) : (value - low) / (high - low));
    const y = (value) => tall - bottom - (tall - top - bottom) * Math.max(0, Math.min(1, share(value)));
    const edge = (k) => left + (k / count) * (wide - left - right); // left edge of a pixel
    const x = (k) => edge(k + 0.5);
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const [value, text] of marks) {
      context.fillStyle = rule;
      context.fillRect(left, y(value), wide - left - right, 0.5);
      context.fillStyle = faint;
      context.textAlign = "right";
      context.fillText(text, left - 5, y(value), left - 6);
    }
    context.textAlign = "center";
    const first = tall - bottom + 11, second = first + 15; // lines of the numbers below the axis
    for (const k of ticks(0, count - 1, false).filter(Number.isInteger)) context.fillText(String(k), x(k), first);
    if (side) {
      const [start, end] = [-0.5, count - 0.5].map((k) => this.pictures.a.place(k, k));
      const place = (mm) => edge((along === "row" ? mm - start[0] : start[1] - mm) / side);
      for (const mm of along === "row" ? ticks(start[0], end[0], false) : ticks(end[1], start[1], false)) {
        context.fillRect(place(mm), tall - bottom, 1, 4);
        context.fillText(digits(mm, 3), place(mm), second);
      }
    }
    context.textAlign = "left";
    context.fillText(along === "row" ? "column" : "row", 0, first, left - 2);
    if (side) context.fillText(along === "row" ? "x [mm]" : "y [mm]", 0, second, left - 2);
    context.fillText(withUnit(this.quantityText(), factor, this.unitText()), 4, top / 2);
    context.fillStyle = MARKS.cross;
    context.fillRect(x(across) - 0.5, top, 1, tall - top - bottom);
    let end = wide - right;
    for (const [slot, values] of lines) {
      context.strokeStyle = context.fillStyle = colour[slot];
      context.lineWidth = 1.5;
      context.beginPath();
      values.forEach((value, k) => context.lineTo(x(k), y(value)));
      context.stroke();
      context.beginPath();
      context.arc(x(across), y(values[across]), 3, 0, 2 * Math.PI);
      context.fill();
      if (lines.length > 1) {
        context.textAlign = "right";
        context.fillText(PANELS[slot], end, top / 2);
        end -= context.measureText(PANELS[slot]).width + 12;
      }
    }
  }

  /** One PNG of all panels with their colour bars and captions, pictures enlarged to a whole multiple. */
  savePng() {
    if (!this.pictures.a) return;
    const { width, height } = this.pictures.a;
    const times = Math.max(1, Math.round(512 / width)), bar = 106, gap = 12, line = 18;
    const panels = Object.values(this.panels);
    const one = width * times + bar + gap;
    const sheet = make("canvas", { width: panels.length * one + gap, height: height * times + 2 * gap + 2 * line });
    const context = sheet.getContext("2d");
    const style = getComputedStyle(this.root);
    context.fillStyle = style.getPropertyValue("--back");
    context.fillRect(0, 0, sheet.width, sheet.height);
    context.fillStyle = style.color;
    context.font = "13px system-ui, sans-serif";
    context.imageSmoothingEnabled = false;
    panels.forEach((panel, k) => {
      const left = gap + k * one;
      context.fillText(panel.caption.textContent + (this.isFine() ? "" : " (draft)"), left, gap + 12, one - gap);
      context.drawImage(panel.canvas, left, gap + line, width * times, height * times);
      context.save();
      context.translate(left + width * times + 6, gap + line);
      panel.bar.paint?.(context, bar - 6, height * times);
      context.restore();
    });
    context.fillText(this.nodes.command.textContent, gap, sheet.height - gap, sheet.width - 2 * gap);
    sheet.toBlob((blob) => save(`${this.nodes.title.textContent.split("/").pop().replace(/\.xml$/, "")}.png`, blob));
  }
}

/** Rectangle [column, row, columns, rows] that holds two pixels. */
function between(one, other) {
  const left = Math.min(one[0], other[0]), top = Math.min(one[1], other[1]);
  return [left, top, Math.abs(one[0] - other[0]) + 1, Math.abs(one[1] - other[1]) + 1];
}

/** Positions of a slider's handle and the values that they stand for. */
function scaleOf({ scale, low, high, step }) {
  if (scale === "linear") return { low, high, step, position: (value) => value, value: (position) => position };
  const shown = (value) => Number(value.toPrecision(3));
  return { low: Math.log(low), high: Math.log(high), step: Math.log(1 + step), position: Math.log, value: (position) => shown(Math.exp(position)) };
}

/** The widget of a notebook. */
export default {
  render({ model, el }) {
    const root = make("div");
    el.append(root);
    const view = new View(root, (take, state) => widgetChannel(model, take, state), false);
    return () => view.close();
  },
};

const page = document.getElementById("fspt-view");
if (page) new View(page, socketChannel, true);
