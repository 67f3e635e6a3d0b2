const CODES = 2000;
const NEAR = 0.8; // NEES / 3 of the smallest ellipses that the verdict calls consistent
const WORDS = { "consistent": "good", "nearly consistent": "near", "not consistent": "bad", "not shown": "open" };
const get = (id) => document.getElementById(id);
const plain = (value) => (value === null ? "–" : value >= 1e4 || value < 1e-3 ? value.toExponential(0) : String(+value.toPrecision(2)));

/** Make an element with a class and a text. */
function made(tag, text = "", name = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (name) element.className = name;
  return element;
}

/** Numbers in groups of so many. */
function* groups(numbers, size) {
  for (let i = 0; i + size <= numbers.length; i += size) yield numbers.slice(i, i + size);
}

/** The curves of one cell, as the chart of the page of a run reads series. */
class NeesChart extends Chart {
  constructor(explorer, canvas) {
    const { facts, cells } = explorer;
    const series = (cell) => cell.filters.map((one, number) => {
      const values = one.curve.map((code) => 10 ** (code / 100));
      return { number, array: () => values };
    });
    const longest = Math.max(...cells.flatMap((cell) => cell.filters.map((one) => one.curve.length)));
    const t = Array.from({ length: longest }, (_, k) => 1 + ((facts.steps - 1) * k) / Math.max(longest - 1, 1));
    const all = cells.flatMap((cell) => cell.filters.map((one) => one.curve.map((code) => 10 ** (code / 100))));
    const run = { t, length: longest, facts: { unit: "step" }, filters: all.map((values) => ({ array: () => values })) };
    super(run, canvas, "nees", "NEES / 3", () => () => facts.band);
    this.series = series;
  }

  drawCursor() {}

  show(cell) {
    this.draw(0, this.series(cell));
  }
}

class Explorer {
  constructor(facts, cells) {
    Object.assign(this, { facts, cells });
    this.sliders = [get("motion"), get("measurement")];
    this.unchanged = facts.factors.indexOf(1);
    this.build();
    for (const slider of this.sliders) slider.addEventListener("input", () => this.show());
    get("reset").addEventListener("click", () => this.go(this.unchanged, this.unchanged));
    document.addEventListener("keydown", (event) => this.press(event));
    window.addEventListener("resize", () => this.show());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
    get("explorer").hidden = false;
    this.show();
  }

  build() {
    const { facts } = this;
    this.maps = facts.filters.map((name, number) => this.addFigure("maps", name, number, made("canvas")));
    const curve = made("canvas");
    this.addFigure("charts", "NEES / 3 over the steps", null, curve);
    this.chart = new NeesChart(this, curve);
    this.maps.forEach((canvas, number) => canvas.setAttribute("aria-label", `map of ${facts.filters[number]}`));
    curve.setAttribute("role", "img");
    curve.setAttribute("aria-label", "NEES / 3 over the steps");
    this.grids = facts.filters.map((name, number) => this.addGrid(name, number));
    const palette = { line: "true path and landmarks", own: "estimated path", oval: "3σ ellipses of poses and landmarks" };
    for (const [key, text] of Object.entries(palette)) {
      const item = made("li");
      const canvas = made("canvas");
      canvas.dataset.key = key;
      item.append(canvas, text);
      get("legend").append(item);
    }
  }

  addFigure(place, title, number, content) {
    const figure = made("figure");
    const head = made("h2", title);
    if (number !== null) {
      head.prepend(made("span", "", "swatch"));
      figure.className = "own";
      figure.style.setProperty("--own", `var(--${["blue", "orange", "teal", "purple", "sky"][number % 5]})`);
    }
    figure.append(head, content);
    get(place).append(figure);
    return content;
  }

  /** The NEES of all cells of a filter, coloured by its verdicts. */
  addGrid(name, number) {
    const { factors } = this.facts;
    const grid = made("div", "", "grid");
    for (let row = factors.length - 1; row >= 0; row--) {
      grid.append(made("span", `×${factors[row]}`));
      factors.forEach((_, column) => {
        const one = this.cell(column, row).filters[number];
        const kind = WORDS[one.word] === "bad" && one.nees < NEAR ? "large" : WORDS[one.word];
        const button = made("button", plain(one.nees), kind);
        button.type = "button";
        button.tabIndex = -1; // the sliders serve the keyboard
        button.title = `motion ×${factors[column]}, measurement ×${factors[row]}: ${one.word}`;
        button.addEventListener("click", () => this.go(column, row));
        grid.append(button);
      });
    }
    grid.append(made("span"), ...factors.map((factor) => made("span", `×${factor}`)));
    return this.addFigure("grids", `${name}: NEES / 3 at every noise`, number, grid);
  }

  cell(motion, measurement) {
    return this.cells[measurement * this.facts.factors.length + motion];
  }

  go(motion, measurement) {
    const last = this.facts.factors.length - 1;
    [motion, measurement].forEach((value, i) => {
      this.sliders[i].value = Math.min(Math.max(value, 0), last);
    });
    this.show();
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, .wide")) {
      if (event.key !== "0") return;
    }
    const [motion, measurement] = this.sliders.map((slider) => +slider.value);
    const moves = {
      ArrowRight: [motion + 1, measurement], ArrowLeft: [motion - 1, measurement],
      ArrowUp: [motion, measurement + 1], ArrowDown: [motion, measurement - 1],
      0: [this.unchanged, this.unchanged],
    };
    if (!(event.key in moves)) return;
    event.preventDefault();
    this.go(...moves[event.key]);
  }

  show() {
    const [motion, measurement] = this.sliders.map((slider) => +slider.value);
    const cell = this.cell(motion, measurement);
    this.write("motion", motion, this.facts.motion, ["m", "m", "rad"]);
    this.write("measurement", measurement, this.facts.measurement, this.facts.units);
    this.fill(cell);
    this.maps.forEach((canvas, number) => this.drawMap(canvas, cell, number));
    this.chart.show(cell);
    document.querySelectorAll("#legend canvas").forEach((canvas) => this.drawKey(canvas));
    const size = this.facts.factors.length;
    const chosen = (size - 1 - measurement) * size + motion;
    for (const grid of this.grids) {
      grid.querySelectorAll("button").forEach((button, i) => button.setAttribute("aria-pressed", i === chosen));
    }
  }

  write(id, place, std, units) {
    const factor = this.facts.factors[place];
    const values = std.map((value, i) => [+(factor * value).toPrecision(3), units[i]]);
    const text = values.map(([value, unit], i) => (unit === (values[i + 1] || [])[1] ? value : `${value} ${unit}`)).join(", ");
    get(`${id}-value`).textContent = factor === 1 ? `unchanged: ${text}` : `×${factor}: ${text}`;
    get(id).setAttribute("aria-valuetext", `times ${factor}`);
  }

  fill(cell) {
    const table = get("values");
    table.replaceChildren();
    const head = table.createTHead().insertRow();
    for (const text of ["filter", "NEES / 3", "verdict", ""]) {
      const one = made("th", text);
      one.scope = "col";
      head.append(one);
    }
    const body = table.createTBody();
    cell.filters.forEach((one, number) => {
      const row = body.insertRow();
      row.style.setProperty("--own", `var(--${["blue", "orange", "teal", "purple", "sky"][number % 5]})`);
      const name = made("th", this.facts.filters[number]);
      name.scope = "row";
      name.prepend(made("span", "", "swatch"));
      const kind = { near: "good" }[WORDS[one.word]] || WORDS[one.word];
      row.append(name, made("td", plain(one.nees)), made("td", one.word, `word ${kind}`), made("td", one.reason));
    });
  }

  drawMap(canvas, cell, number) {
    const { context, width, height } = sharpen(canvas);
    const palette = colours(number);
    const px = (code) => (width * code) / CODES;
    const py = (code) => height - (height * code) / CODES;
    const one = cell.filters[number];
    const path = (codes) => {
      context.beginPath();
      for (const [x, y] of groups(codes, 2)) context.lineTo(px(x), py(y));
      context.stroke();
    };
    context.lineWidth = 2;
    context.strokeStyle = palette.ink;
    for (const [x, y, u, v] of groups(this.facts.walls, 4)) shapes.line(context, px(x), py(y), px(u), py(v));
    context.lineWidth = 1.2;
    context.strokeStyle = palette.grey;
    context.setLineDash([5, 4]);
    path(cell.truth);
    context.setLineDash([]);
    for (const [x, y] of groups(this.facts.landmarks, 2)) shapes.times(context, px(x), py(y), 4);
    context.strokeStyle = context.fillStyle = palette.own;
    context.lineWidth = 1.6;
    path(one.path);
    for (const [marks, alpha] of [[one.poses, 0.1], [one.map, 0.2]]) {
      for (const [x, y, long, short, angle] of groups(marks, 5)) {
        context.lineWidth = 1;
        context.beginPath();
        context.ellipse(px(x), py(y), px(long), px(short), (-angle * Math.PI) / 180, 0, 2 * Math.PI);
        context.globalAlpha = alpha;
        context.fill();
        context.globalAlpha = 1;
        context.stroke();
        shapes.dot(context, px(x), py(y), 1.6);
      }
    }
  }

  drawKey(canvas) {
    const { context, width, height } = sharpen(canvas);
    const palette = colours(0);
    const middle = height / 2;
    if (canvas.dataset.key === "oval") {
      context.strokeStyle = context.fillStyle = palette.ink;
      context.beginPath();
      context.ellipse(width / 2, middle, width / 2 - 3, middle - 3, 0, 0, 2 * Math.PI);
      context.globalAlpha = 0.15;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
      return;
    }
    const isTrue = canvas.dataset.key === "line";
    context.strokeStyle = isTrue ? palette.grey : palette.own;
    context.lineWidth = 1.6;
    shapes.line(context, 1, middle, width - 1, middle, isTrue ? [5, 4] : []);
    if (isTrue) shapes.times(context, width / 2, middle, 4);
  }
}

let explorer; // for the browser's console

async function start() {
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old: it cannot unpack the data");
  const facts = JSON.parse(get("facts").textContent);
  const packed = Uint8Array.from(atob(get("cells").textContent.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  explorer = new Explorer(facts, await new Response(stream).json());
  document.documentElement.dataset.ready = "true";
}

start().catch((error) => {
  get("failure").textContent = `The page cannot be shown: ${error.message}`;
  get("failure").hidden = false;
});
