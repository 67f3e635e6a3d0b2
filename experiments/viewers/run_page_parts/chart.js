const MARGIN = { left: 44, right: 10, top: 8, bottom: 22 };

/** Round numbers for the ticks of a linear axis. */
function roundTicks(low, high, most) {
  const rough = (high - low) / most || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const gap = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough);
  const ticks = [];
  for (let i = Math.ceil(low / gap); i <= Math.floor(high / gap); i++) ticks.push(i * gap);
  return ticks;
}

/** A series of each filter over the steps on a logarithmic axis, with band and cursor. */
class Chart {
  constructor(run, canvas, key, name, band) {
    Object.assign(this, { run, canvas, key, name, band });
    const all = run.filters.flatMap((filter) => Array.from(filter.array(key)).filter((v) => v > 0 && v < Infinity));
    this.isEmpty = all.length === 0;
    const least = all.reduce((a, b) => Math.min(a, b), 0.1);
    const most = all.reduce((a, b) => Math.max(a, b), 4);
    this.low = Math.log10(Math.max(least, 0.02));
    this.high = Math.log10(most * 1.3);
  }

  draw(place, shown) {
    const { context, width, height } = sharpen(this.canvas);
    const { run } = this;
    const palette = colours(0);
    Object.assign(this, { context, width, height, palette });
    const span = Math.max(run.t[run.length - 1] - run.t[0], 1e-9);
    const inner = width - MARGIN.left - MARGIN.right;
    this.px = (k) => MARGIN.left + (inner * (run.t[k] - run.t[0])) / span;
    this.py = (value) => {
      const share = (Math.log10(Math.max(value, 1e-9)) - this.low) / (this.high - this.low);
      return height - MARGIN.bottom - (height - MARGIN.bottom - MARGIN.top) * Math.min(Math.max(share, 0), 1);
    };
    this.drawBand(shown[0]);
    this.drawAxes();
    for (const filter of shown) this.drawSeries(filter);
    this.drawCursor(place, shown);
  }

  drawBand(filter) {
    const { context, palette, run } = this;
    const bounds = this.band(filter);
    const known = (k) => Number.isFinite(bounds(k)[1]);
    context.fillStyle = palette.grey;
    context.globalAlpha = 0.2;
    for (let from = 0; from < run.length; from++) {
      if (!known(from)) continue;
      let to = from;
      while (to + 1 < run.length && known(to + 1)) to++;
      this.fillBetween(bounds, from, to);
      from = to;
    }
    context.globalAlpha = 1;
  }

  /** Fill between two bounds, constant around each step. */
  fillBetween(bounds, from, to) {
    const { context, run } = this;
    const edge = (k) => (this.px(Math.max(k, 0)) + this.px(Math.min(k + 1, run.length - 1))) / 2;
    context.beginPath();
    for (let k = from; k <= to; k++) {
      const y = this.py(bounds(k)[1]);
      context.lineTo(edge(k - 1), y);
      context.lineTo(edge(k), y);
    }
    for (let k = to; k >= from; k--) {
      const y = this.py(bounds(k)[0]);
      context.lineTo(edge(k), y);
      context.lineTo(edge(k - 1), y);
    }
    context.fill();
  }

  drawAxes() {
    const { context, palette, run, width, height } = this;
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = palette.grey;
    context.strokeStyle = palette.pale;
    context.lineWidth = 1;
    context.textAlign = "right";
    for (let power = Math.ceil(this.low); power <= this.high; power++) {
      const y = Math.round(this.py(10 ** power)) + 0.5;
      context.strokeStyle = power === 0 ? palette.grey : palette.pale;
      shapes.line(context, MARGIN.left, y, width - MARGIN.right, y);
      const text = Math.abs(power) > 3 ? `1e${power}` : String(+(10 ** power).toPrecision(1));
      context.fillText(text, MARGIN.left - 6, y + 4);
    }
    context.textAlign = "center";
    const [from, to] = [run.t[0], run.t[run.length - 1]];
    for (const t of roundTicks(from, to, width / 90)) {
      const x = MARGIN.left + ((width - MARGIN.left - MARGIN.right) * (t - from)) / Math.max(to - from, 1e-9);
      if (x < width - 62) context.fillText(String(+t.toPrecision(6)), x, height - 7);
    }
    context.textAlign = "right";
    context.fillText(run.facts.unit, width - MARGIN.right, height - 7);
  }

  drawSeries(filter) {
    const { context, run } = this;
    const values = filter.array(this.key);
    context.strokeStyle = context.fillStyle = colours(filter.number).own;
    context.lineWidth = 1.4;
    context.lineJoin = "round";
    context.beginPath();
    let isOn = false;
    for (let k = 0; k < run.length; k++) {
      const known = Number.isFinite(values[k]);
      if (known && isOn) context.lineTo(this.px(k), this.py(values[k]));
      else if (known) {
        context.moveTo(this.px(k), this.py(values[k]));
        context.lineTo(this.px(k) + 0.01, this.py(values[k]));
      }
      isOn = known;
    }
    context.stroke();
  }

  drawCursor(place, shown) {
    const { context, palette, height } = this;
    const x = this.px(place);
    context.strokeStyle = palette.ink;
    context.lineWidth = 1.2;
    shapes.line(context, x, MARGIN.top - 4, x, height - MARGIN.bottom);
    for (const filter of shown) {
      const value = filter.array(this.key)[place];
      if (!Number.isFinite(value)) continue;
      context.fillStyle = colours(filter.number).own;
      shapes.dot(context, x, this.py(value), 4);
      context.strokeStyle = palette.paper;
      shapes.ring(context, x, this.py(value), 4.5);
    }
  }

  /** The step nearest to a place [px]. */
  placeAt(x) {
    const { run } = this;
    let [low, high] = [0, run.length - 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.px(middle) < x) low = middle;
      else high = middle;
    }
    return x - this.px(low) < this.px(high) - x ? low : high;
  }

  describe(place, shown) {
    const lines = [clockText(this.run, place)];
    for (const filter of shown) lines.push(`${filter.name}: ${this.name} ${short(filter.array(this.key)[place])}`);
    const [low, high] = this.band(shown[0])(place);
    if (Number.isFinite(high)) lines.push(`95 % band ${short(low)} … ${short(high)}`);
    return lines.join("\n");
  }
}

const short = (value) => (Number.isFinite(value) ? (value >= 1e4 ? value.toExponential(1) : value.toPrecision(3)) : "–");

function clockText(run, place) {
  const step = `step ${run.steps[place]} of ${run.facts.last}`;
  return run.facts.unit === "s" ? `${step}, ${run.t[place].toFixed(2)} s` : step;
}
