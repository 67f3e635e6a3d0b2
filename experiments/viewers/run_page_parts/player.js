const SECONDS = 20; // to play the whole run at 1×
const get = (id) => document.getElementById(id);

function make(tag, parent, text = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  parent.append(element);
  return element;
}

/** The page: one step shown in all maps and charts, and what changes it. */
class Player {
  constructor(run) {
    this.run = run;
    this.place = 0;
    this.chosen = null;
    this.timer = null;
    this.camera = new Camera(run);
    this.shown = run.filters.filter((_, i) => i < (window.innerWidth < 640 ? 1 : 3));
    get("slider").max = run.length - 1;
    get("viewer").hidden = false;
    this.makeFilters();
    this.makeMaps();
    this.makeCharts();
    this.makeLegend();
    this.listen();
    this.show(0);
  }

  // ---- parts ----

  makeFilters() {
    for (const filter of this.run.filters) {
      const button = make("button", get("filters"));
      button.type = "button";
      const swatch = make("span", button);
      swatch.className = "swatch";
      button.append(filter.name);
      button.addEventListener("click", () => this.toggle(filter));
      filter.button = button;
    }
  }

  makeMaps() {
    get("maps").replaceChildren();
    const count = this.shown.length;
    get("viewer").classList.toggle("single", count === 1);
    this.views = this.shown.map((filter) => {
      const figure = make("figure", get("maps"));
      if (this.run.filters.length > 1) {
        const title = make("h2", figure);
        make("span", title).className = "swatch";
        title.append(filter.name);
      }
      const canvas = make("canvas", figure);
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `Map of ${filter.name}; its values stand in the table below`);
      const least = window.innerWidth < 640 ? 0.9 : window.innerWidth < 1024 ? 1.7 : 1.2; // charts stand beside it if wide
      canvas.style.aspectRatio = String(count === 1 ? Math.max(this.camera.aspect, least) : this.camera.aspect);
      canvas.style.maxHeight = count > 2 ? "20rem" : "min(62vh, 38rem)";
      const view = new MapView(this.run, filter, this.camera, canvas);
      this.handleMap(view);
      return view;
    });
    for (const filter of this.run.filters) filter.button.setAttribute("aria-pressed", String(this.shown.includes(filter)));
  }

  makeCharts() {
    const { run } = this;
    const constant = run.facts.bands.nees;
    const specs = [
      ["nees", "NEES / 3", "NEES of the pose / 3", () => () => constant],
      ["nis", "NIS / degree", "NIS by degree of freedom", (filter) => (k) => [filter.array("nis_low")[k], filter.array("nis_high")[k]]],
    ];
    const charts = specs.map(([key, name, title, band]) => {
      const figure = make("figure", get("charts"));
      make("h2", figure, title);
      const canvas = make("canvas", figure);
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${title} over the steps`);
      const chart = new Chart(run, canvas, key, name, band);
      if (chart.isEmpty) figure.remove(); // such as the NEES without truth
      else this.handleChart(chart);
      return chart;
    });
    this.charts = charts.filter((chart) => !chart.isEmpty);
  }

  makeLegend() {
    const entries = this.legendEntries();
    get("legend").replaceChildren();
    for (const [text, drawn] of entries) {
      const item = make("li", get("legend"));
      const canvas = make("canvas", item);
      item.append(text);
      const { context } = sharpen(canvas);
      context.lineWidth = 1.6;
      drawn(context);
    }
  }

  legendEntries() {
    const palette = colours(this.shown.length ? this.shown[0].number : 0);
    const inked = (colour, draw) => (context) => {
      context.strokeStyle = context.fillStyle = colour;
      draw(context);
    };
    const reading = (outcome) => (context) => {
      const style = readingStyle(outcome, palette);
      context.strokeStyle = context.fillStyle = style.colour;
      shapes.line(context, 1, 9, 21, 9, style.dash);
      if (style.mark) shapes[style.mark](context, 22, 9, 4);
      else shapes.dot(context, 22, 9, 2);
    };
    const entries = [
      ["robot, estimated", inked(palette.own, (c) => (shapes.robot(c, 13, 9, 0, 8), c.fill()))],
      ["landmark with 3σ", inked(palette.own, (c) => {
        c.beginPath();
        c.ellipse(14, 9, 12, 7, 0, 0, 2 * Math.PI);
        c.stroke();
        c.globalAlpha = 0.14;
        c.fill();
        c.globalAlpha = 1;
        shapes.dot(c, 14, 9, 2.5);
      })],
    ];
    if (this.run.hasTruth) {
      entries.push(["robot and path, true", inked(palette.ink, (c) => {
        shapes.robot(c, 10, 9, 0, 7);
        c.stroke();
        c.strokeStyle = palette.grey;
        shapes.line(c, 19, 9, 28, 9);
      })]);
    }
    if (this.run.landmarks.length) entries.push(["landmark, true", inked(palette.ink, (c) => shapes.cross(c, 14, 9, 5))]);
    entries.push(["reading used", reading("used")]);
    const codes = new Set(this.run.filters.flatMap((filter) => Array.from(new Set(filter.columns.outcome))));
    if (codes.has(2)) entries.push(["adds a landmark", reading("new")]);
    if (codes.has(5)) entries.push(["tentative", reading("tentative")]);
    if ([0, 3, 4, 6].some((code) => codes.has(code))) entries.push(["not used", reading("not used")]);
    if (this.run.arrays["reading.true"].values.includes(-1)) {
      entries.push(["clutter, in truth", inked(palette.alarm, (c) => c.strokeRect(8, 2.5, 13, 13))]);
    }
    return entries;
  }

  // ---- the shown step ----

  show(place) {
    this.place = Math.min(Math.max(Math.round(place), 0), this.run.length - 1);
    get("slider").value = this.place;
    get("clock").textContent = clockText(this.run, this.place);
    get("slider").setAttribute("aria-valuetext", clockText(this.run, this.place));
    this.redraw();
    if (this.pointed) this.pointed();
  }

  redraw() {
    const related = this.views.map((view) => view.draw(this.place, this.chosen));
    for (const chart of this.charts) chart.draw(this.place, this.shown);
    this.writeChosen(related);
    this.writeValues();
    for (const filter of this.run.filters) {
      const { own } = colours(filter.number);
      filter.button.style.setProperty("--own", own);
    }
    this.views.forEach((view) => view.canvas.parentElement.style.setProperty("--own", view.palette.own));
  }

  writeChosen(related) {
    if (this.chosen === null) {
      get("chosen").textContent = "Click a landmark or the robot to see its correlations.";
      return;
    }
    const said = this.views.map((view, i) => {
      const values = [...related[i].entries()].filter(([id]) => id !== "robot").map(([, rho]) => rho);
      if (!related[i].size) return `${view.filter.name}: no correlations here`;
      const parts = [];
      if (related[i].has("robot")) parts.push(`${related[i].get("robot").toFixed(2)} with the robot`);
      if (values.length) {
        const [low, high] = [Math.min(...values).toFixed(2), Math.max(...values).toFixed(2)];
        parts.push(`${low === high ? low : `${low} to ${high}`} with ${values.length} landmark${values.length > 1 ? "s" : ""}`);
      }
      return `${view.filter.name}: ${parts.join(", ")}`;
    });
    get("chosen").textContent = `Correlation of ${nodeName(this.chosen)}. ${said.join("; ")}`;
  }

  writeValues() {
    const table = get("values");
    table.replaceChildren();
    const head = make("tr", make("thead", table));
    const columns = ["filter", "position error [m]", "heading error [rad]", "NEES / 3", "NIS / degree", "landmarks"];
    for (const column of columns) make("th", head, column).scope = "col";
    const body = make("tbody", table);
    const { run, place } = this;
    for (const filter of this.shown) {
      const pose = filter.pose(place);
      const gap = Math.hypot(pose.x - run.truth.x[place], pose.y - run.truth.y[place]);
      const turn = wrapped(pose.theta - run.truth.theta[place]);
      const row = make("tr", body);
      make("th", row, filter.name).scope = "row";
      const fixed = (value) => (Number.isFinite(value) ? value.toFixed(3).replace(/^-(0\.0+)$/, "$1") : "–");
      const count = filter.starts[place + 1] - filter.starts[place];
      for (const text of [fixed(gap), fixed(turn), short(filter.array("nees")[place]), short(filter.array("nis")[place]), count]) {
        make("td", row, String(text));
      }
    }
  }

  // ---- what changes it ----

  get isPlaying() {
    return this.timer !== null;
  }

  play() {
    if (this.isPlaying) return this.pause();
    if (this.place === this.run.length - 1) this.show(0);
    let [last, due] = [performance.now(), this.place];
    const tick = (now) => {
      const rate = Math.min(Math.max(this.run.length / SECONDS, 4), 120) * Number(get("speed").value);
      due += ((now - last) / 1000) * rate;
      last = now;
      if (Math.floor(due) > this.place) this.show(Math.floor(due));
      if (this.place >= this.run.length - 1) this.pause();
      else if (this.isPlaying) this.timer = requestAnimationFrame(tick);
    };
    this.timer = requestAnimationFrame(tick);
    this.labelPlay(true);
    return undefined;
  }

  pause() {
    cancelAnimationFrame(this.timer);
    this.timer = null;
    this.labelPlay(false);
  }

  labelPlay(isPlaying) {
    get("play").classList.toggle("playing", isPlaying);
    get("play").setAttribute("aria-label", isPlaying ? "Pause" : "Play");
  }

  go(place) {
    this.pause();
    this.show(place);
  }

  toggle(filter) {
    const isShown = this.shown.includes(filter);
    if (isShown && this.shown.length === 1) return;
    this.shown = this.run.filters.filter((one) => (one === filter ? !isShown : this.shown.includes(one)));
    this.makeMaps();
    this.makeLegend();
    this.redraw();
  }

  choose(node) {
    this.chosen = node === undefined || node === this.chosen ? null : node;
    this.redraw();
  }

  zoomBy(factor) {
    this.camera.zoom = Math.min(Math.max(this.camera.zoom * factor, 0.2), 500);
    this.redraw();
  }

  follow(on) {
    if (on === this.camera.follows) return;
    this.camera.reset();
    this.camera.follows = on;
    get("follow").setAttribute("aria-pressed", String(on));
    this.redraw();
  }

  listen() {
    get("play").addEventListener("click", () => this.play());
    get("first").addEventListener("click", () => this.go(0));
    get("end").addEventListener("click", () => this.go(this.run.length - 1));
    get("slider").addEventListener("input", (event) => this.go(Number(event.target.value)));
    get("follow").addEventListener("click", () => this.follow(!this.camera.follows));
    get("closer").addEventListener("click", () => this.zoomBy(1.5));
    get("wider").addEventListener("click", () => this.zoomBy(1 / 1.5));
    get("whole").addEventListener("click", () => {
      this.follow(false);
      this.camera.reset();
      this.redraw();
    });
    document.addEventListener("keydown", (event) => this.press(event));
    const restyle = () => (this.makeLegend(), this.redraw());
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
    new ResizeObserver(() => this.redraw()).observe(get("viewer"));
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const many = event.shiftKey ? 10 : 1;
    const actions = {
      ArrowLeft: () => this.go(this.place - many),
      ArrowRight: () => this.go(this.place + many),
      Home: () => this.go(0),
      End: () => this.go(this.run.length - 1),
      Escape: () => this.choose(),
    };
    if (event.target.tagName !== "BUTTON") actions[" "] = () => this.play();
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }

  handleMap(view) {
    const { canvas } = view;
    const pointers = new Map();
    let moved = 0;
    canvas.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, event);
      moved = 0;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return this.hintAt(view, event);
      moved += Math.hypot(event.clientX - before.clientX, event.clientY - before.clientY);
      if (pointers.size === 1 && moved > 5) this.drag(view, event.clientX - before.clientX, event.clientY - before.clientY);
      if (pointers.size === 2) this.pinch(pointers, event);
      pointers.set(event.pointerId, event);
      return undefined;
    });
    const release = (event) => {
      const wasOnly = pointers.delete(event.pointerId) && pointers.size === 0;
      if (event.type !== "pointerup" || !wasOnly || moved > 5) return;
      const target = view.find(event.offsetX, event.offsetY, ({ node }) => node !== undefined);
      this.choose(target?.node);
      this.hintAt(view, event);
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointerleave", (event) => this.leave(event));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 200));
    }, { passive: false });
  }

  drag(view, dx, dy) {
    if (this.camera.follows) return;
    this.camera.x -= dx / view.scale;
    this.camera.y += dy / view.scale;
    this.hint();
    this.redraw();
  }

  pinch(pointers, event) {
    const other = [...pointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
    const before = pointers.get(event.pointerId);
    const gap = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
    if (gap(before) > 0) this.zoomBy(gap(event) / gap(before));
  }

  handleChart(chart) {
    const { canvas } = chart;
    const point = (event) => {
      const place = chart.placeAt(event.offsetX);
      if (event.buttons) this.go(place);
      this.hint(event, () => chart.describe(place, this.shown));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      point(event);
    });
    canvas.addEventListener("pointermove", point);
    canvas.addEventListener("pointerleave", (event) => this.leave(event));
  }

  /** Hide the values when the mouse leaves; those under a finger stay until the next touch. */
  leave(event) {
    if (event.pointerType !== "touch") this.hint();
  }

  hintAt(view, { clientX, clientY, offsetX, offsetY }) {
    this.hint({ clientX, clientY }, () => view.find(offsetX, offsetY)?.describe());
  }

  /** Show values beside the pointer, or nothing; they follow the step. */
  hint(event, describe = () => undefined) {
    const box = get("hint");
    const text = describe();
    this.pointed = text ? () => this.hint(event, describe) : null;
    box.hidden = !text;
    if (!text) return;
    box.textContent = text;
    const { offsetWidth: width, offsetHeight: height } = box;
    const left = event.clientX + 16 + width > window.innerWidth ? event.clientX - 16 - width : event.clientX + 16;
    box.style.left = `${Math.max(left, 4)}px`;
    box.style.top = `${Math.max(Math.min(event.clientY + 14, window.innerHeight - height - 6), 4)}px`;
  }
}

let player; // for the browser's console

async function start() {
  const facts = JSON.parse(get("facts").textContent);
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old: it cannot unpack the data");
  const run = new Run(facts, await unpack(get("arrays").textContent, facts.arrays));
  player = new Player(run);
  document.documentElement.dataset.ready = "true";
}

start().catch((error) => {
  get("failure").textContent = `The run cannot be shown: ${error.message}`;
  get("failure").hidden = false;
});
