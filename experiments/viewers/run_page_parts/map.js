/** How a reading is drawn: colour, dashes, and the mark at its end. */
function readingStyle(outcome, palette) {
  if (outcome === "used") return { colour: palette.own, alpha: 0.55, dash: [], mark: null };
  if (outcome === "new") return { colour: palette.own, alpha: 0.9, dash: [], mark: "ring" };
  if (outcome === "tentative") return { colour: palette.grey, alpha: 0.9, dash: [2, 3], mark: "ring" };
  return { colour: palette.alarm, alpha: 0.9, dash: [5, 4], mark: "times" };
}

/** What the maps share: the visible part of the plane. */
class Camera {
  constructor(run) {
    this.box = this.boxAround(run);
    this.reset();
    this.closeUp = 2.6 * Math.max(2, this.longestRange(run));
  }

  longestRange(run) {
    const codes = run.arrays["reading.range"].values;
    return metres(codes.reduce((most, code) => Math.max(most, code), 0));
  }

  /** Box around paths, maps, walls and all true landmarks. */
  boxAround(run) {
    const box = { left: Infinity, right: -Infinity, low: Infinity, high: -Infinity };
    const add = (x, y) => {
      if (!Number.isFinite(x) || !Number.isFinite(y)) return;
      box.left = Math.min(box.left, x);
      box.right = Math.max(box.right, x);
      box.low = Math.min(box.low, y);
      box.high = Math.max(box.high, y);
    };
    run.truth.x.forEach((x, i) => add(x, run.truth.y[i]));
    for (const filter of run.filters) {
      filter.poses.x.forEach((x, i) => add(x, filter.poses.y[i]));
      filter.map(run.length - 1).forEach(({ x, y }) => add(x, y));
    }
    run.walls.forEach(([x0, y0, x1, y1]) => (add(x0, y0), add(x1, y1)));
    run.landmarks.forEach(({ x, y }) => add(x, y));
    return box.left > box.right ? { left: -1, right: 1, low: -1, high: 1 } : box;
  }

  reset() {
    const { left, right, low, high } = this.box;
    this.x = (left + right) / 2;
    this.y = (low + high) / 2;
    this.zoom = 1;
    this.follows = false;
  }

  /** Width over height of the whole map, within reason. */
  get aspect() {
    const { left, right, low, high } = this.box;
    return Math.min(Math.max((right - left + 1e-3) / (high - low + 1e-3), 0.8), 2.2);
  }

  /** Pixels per metre on a canvas. */
  scale(width, height) {
    const { left, right, low, high } = this.box;
    const whole = 0.9 * Math.min(width / Math.max(right - left, 1e-3), height / Math.max(high - low, 1e-3));
    const near = Math.min(width, height) / this.closeUp;
    return this.zoom * (this.follows ? Math.max(near, whole) : whole);
  }
}

/** The map of one filter on its canvas. */
class MapView {
  constructor(run, filter, camera, canvas) {
    Object.assign(this, { run, filter, camera, canvas, targets: [] });
  }

  draw(place, chosen) {
    const { context, width, height } = sharpen(this.canvas);
    Object.assign(this, { context, palette: colours(this.filter.number) });
    const pose = this.filter.pose(place);
    const centre = this.camera.follows ? pose : this.camera;
    const scale = this.camera.scale(width, height);
    this.px = (x) => width / 2 + scale * (x - centre.x);
    this.py = (y) => height / 2 - scale * (y - centre.y);
    this.scale = scale;
    this.targets = [];
    this.drawGrid(width, height, centre);
    this.drawWorld();
    this.drawPaths(place);
    const landmarks = this.filter.map(place);
    const related = chosen === null ? new Map() : this.filter.correlations(place, chosen);
    this.drawLandmarks(landmarks, chosen, related);
    this.drawCorrelations(landmarks, pose, chosen, related);
    this.drawReadings(place, pose);
    this.drawRobots(place, pose, chosen, related);
    return related;
  }

  drawGrid(width, height, centre) {
    const { context, palette, scale } = this;
    const rough = 90 / scale;
    const power = 10 ** Math.floor(Math.log10(rough));
    const gap = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough);
    context.strokeStyle = palette.pale;
    context.fillStyle = palette.grey;
    context.lineWidth = 1;
    context.font = "11px system-ui, sans-serif";
    const digits = Math.max(0, -Math.floor(Math.log10(gap)));
    const first = (middle, size) => Math.ceil((middle - size / 2 / scale) / gap);
    const last = (middle, size) => Math.floor((middle + size / 2 / scale) / gap);
    const across = [];
    const up = [];
    for (let i = first(centre.x, width); i <= last(centre.x, width); i++) {
      const x = Math.round(this.px(i * gap)) + 0.5;
      shapes.line(context, x, 0, x, height);
      if (x > 34 && x < width - 40) across.push([(i * gap).toFixed(digits), x, height - 5]);
    }
    for (let i = first(centre.y, height); i <= last(centre.y, height); i++) {
      const y = Math.round(this.py(i * gap)) + 0.5;
      shapes.line(context, 0, y, width, y);
      if (y < height - 22 && y > 14) up.push([(i * gap).toFixed(digits), 5, y - 3]);
    }
    context.textAlign = "center"; // after all lines, which would hide a minus
    for (const each of across) this.label(...each);
    context.textAlign = "left";
    for (const each of up) this.label(...each);
    context.textAlign = "right";
    context.fillText("m", width - 6, height - 5);
  }

  drawWorld() {
    const { context, palette, run } = this;
    context.strokeStyle = palette.grey;
    context.lineWidth = 3;
    context.lineCap = "round";
    for (const [x0, y0, x1, y1] of run.walls) {
      shapes.line(context, this.px(x0), this.py(y0), this.px(x1), this.py(y1));
    }
    context.lineCap = "butt";
    context.strokeStyle = palette.ink;
    const many = run.landmarks.length > 150;
    context.lineWidth = many ? 0.8 : 1.4;
    for (const { id, x, y } of run.landmarks) {
      const [px, py] = [this.px(x), this.py(y)];
      shapes.cross(context, px, py, many ? 2.5 : 5);
      this.aim(px, py, 0, () => `true landmark ${id}\n(${x.toFixed(3)}, ${y.toFixed(3)}) m`);
    }
  }

  drawPaths(place) {
    const { context, palette, run, filter } = this;
    context.lineJoin = "round";
    if (run.hasTruth) this.path(run.truth.x, run.truth.y, run.length - 1, palette.grey, 1.3);
    context.globalAlpha = 0.25;
    this.path(filter.poses.x, filter.poses.y, run.length - 1, palette.own, 1.2);
    context.globalAlpha = 1;
    this.path(filter.poses.x, filter.poses.y, place, palette.own, 2);
  }

  path(x, y, last, colour, width) {
    const { context } = this;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    let isOn = false;
    for (let k = 0; k <= last; k++) {
      const known = Number.isFinite(x[k]) && Number.isFinite(y[k]);
      if (known && isOn) context.lineTo(this.px(x[k]), this.py(y[k]));
      else if (known) context.moveTo(this.px(x[k]), this.py(y[k]));
      isOn = known;
    }
    context.stroke();
  }

  ellipse(belief, fill) {
    const { context, scale } = this;
    const { long, short, angle } = ellipseAxes(belief);
    const [a, b] = [SIGMAS * long * scale, SIGMAS * short * scale];
    if (!Number.isFinite(a) || a > 1e5) return;
    context.beginPath();
    context.ellipse(this.px(belief.x), this.py(belief.y), a, b, -angle, 0, 2 * Math.PI);
    const alpha = context.globalAlpha;
    context.globalAlpha = alpha * fill;
    context.fill();
    context.globalAlpha = alpha;
    context.stroke();
  }

  drawLandmarks(landmarks, chosen, related) {
    const { context, palette } = this;
    context.fillStyle = context.strokeStyle = palette.own;
    for (const landmark of landmarks) {
      const isChosen = landmark.id === chosen;
      context.globalAlpha = chosen === null || isChosen || related.has(landmark.id) ? 1 : 0.35;
      context.lineWidth = isChosen ? 2.6 : 1.3;
      this.ellipse(landmark, isChosen ? 0.35 : 0.14);
      shapes.dot(context, this.px(landmark.x), this.py(landmark.y), isChosen ? 4 : 2.5);
      const rho = related.get(landmark.id);
      this.aim(this.px(landmark.x), this.py(landmark.y), 2, () => this.describeLandmark(landmark, chosen, rho), landmark.id);
    }
    context.globalAlpha = 1;
  }

  describeLandmark(landmark, chosen, rho) {
    const lines = [
      `landmark ${landmark.id}`,
      `x ${landmark.x.toFixed(3)} ± ${landmark.std_x.toFixed(3)} m`,
      `y ${landmark.y.toFixed(3)} ± ${landmark.std_y.toFixed(3)} m`,
    ];
    const truth = this.filter.truth.get(landmark.id);
    if (truth) {
      const [dx, dy] = [landmark.x - truth[0], landmark.y - truth[1]];
      const [u, v] = [dx / landmark.std_x, dy / landmark.std_y];
      const square = (u * u - 2 * landmark.rho * u * v + v * v) / (1 - landmark.rho ** 2);
      lines.push(`error ${Math.hypot(dx, dy).toFixed(3)} m, ${Math.sqrt(Math.max(square, 0)).toFixed(1)} σ (Mahalanobis)`);
    }
    if (rho !== undefined) lines.push(`correlation with ${nodeName(chosen)} ${rho.toFixed(2)}`);
    return lines.join("\n");
  }

  drawCorrelations(landmarks, pose, chosen, related) {
    const { context, palette } = this;
    const nodes = new Map(landmarks.map((landmark) => [landmark.id, landmark]));
    nodes.set("robot", pose);
    const from = nodes.get(chosen);
    if (!from) return;
    context.strokeStyle = context.fillStyle = palette.ink;
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "left";
    for (const [id, rho] of related) {
      const to = nodes.get(id);
      if (!to) continue;
      context.globalAlpha = 0.08 + 0.62 * rho ** 2;
      context.lineWidth = 0.5 + 1.5 * rho;
      const [x, y] = [this.px(to.x), this.py(to.y)];
      shapes.line(context, this.px(from.x), this.py(from.y), x, y);
      context.globalAlpha = 1;
      if (related.size <= MOST_VALUES) this.label(rho.toFixed(2), x + 8, y - 7);
    }
  }

  label(text, x, y) {
    const { context, palette } = this;
    context.lineWidth = 3;
    context.strokeStyle = palette.paper;
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
    context.strokeStyle = palette.ink;
  }

  drawReadings(place, pose) {
    const { context, palette } = this;
    for (const reading of this.run.readings(place, this.filter)) {
      const angle = pose.theta + reading.bearing;
      const x = this.px(pose.x + reading.range * Math.cos(angle));
      const y = this.py(pose.y + reading.range * Math.sin(angle));
      const style = readingStyle(reading.outcome, palette);
      context.strokeStyle = context.fillStyle = style.colour;
      context.globalAlpha = style.alpha;
      context.lineWidth = 1.2;
      shapes.line(context, this.px(pose.x), this.py(pose.y), x, y, style.dash);
      context.lineWidth = 1.8;
      if (style.mark) shapes[style.mark](context, x, y, 4);
      else shapes.dot(context, x, y, 2);
      if (reading.trueId === -1) this.drawClutter(x, y);
      context.globalAlpha = 1;
      this.aim(x, y, 1, () => describeReading(reading));
    }
  }

  drawClutter(x, y) {
    this.context.strokeStyle = this.palette.alarm;
    this.context.globalAlpha = 1;
    this.context.strokeRect(x - 6.5, y - 6.5, 13, 13);
  }

  drawRobots(place, pose, chosen, related) {
    const { context, palette, run } = this;
    const [tx, ty, heading] = [run.truth.x[place], run.truth.y[place], run.truth.theta[place]];
    context.fillStyle = context.strokeStyle = palette.own;
    context.lineWidth = 1.3;
    this.ellipse(pose, 0.14);
    if (Number.isFinite(tx)) {
      context.strokeStyle = palette.ink;
      context.lineWidth = 1.6;
      if (Number.isFinite(heading)) {
        shapes.robot(context, this.px(tx), this.py(ty), heading, 10);
        context.stroke();
      } else shapes.ring(context, this.px(tx), this.py(ty), 5);
      this.aim(this.px(tx), this.py(ty), 1, () => `true robot\n(${tx.toFixed(3)}, ${ty.toFixed(3)}) m, heading ${wrapped(heading).toFixed(3)} rad`);
    }
    shapes.robot(context, this.px(pose.x), this.py(pose.y), pose.theta, 9);
    context.fill();
    context.lineWidth = chosen === "robot" ? 2.4 : 1;
    context.strokeStyle = chosen === "robot" ? palette.ink : palette.paper;
    context.stroke();
    this.aim(this.px(pose.x), this.py(pose.y), 3, () => describePose(pose, chosen, related.get("robot")), "robot");
  }

  /** Note what a pointer near a place finds; of equal distance, the higher rank. */
  aim(x, y, rank, describe, node) {
    this.targets.push({ x, y, rank, describe, node });
  }

  /** The nearest target to a place [px] that fits, or undefined. */
  find(x, y, fits = () => true) {
    let best;
    let least = REACH;
    for (const target of this.targets) {
      const gap = Math.hypot(target.x - x, target.y - y) - target.rank;
      if (gap < least && fits(target)) [best, least] = [target, gap];
    }
    return best;
  }
}

const wrapped = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
const nodeName = (node) => (node === "robot" ? "the robot" : `landmark ${node}`);

function describePose(pose, chosen, rho) {
  const lines = [
    "estimated robot",
    `x ${pose.x.toFixed(3)} ± ${pose.std_x.toFixed(3)} m`,
    `y ${pose.y.toFixed(3)} ± ${pose.std_y.toFixed(3)} m`,
    `heading ${wrapped(pose.theta).toFixed(3)} ± ${pose.std_theta.toFixed(3)} rad`,
  ];
  if (rho !== undefined) lines.push(`correlation with ${nodeName(chosen)} ${rho.toFixed(2)}`);
  return lines.join("\n");
}

function describeReading({ bearing, range, outcome, id, trueId }) {
  const lines = [`This reading is ${outcome}.`, `bearing ${wrapped(bearing).toFixed(3)} rad, range ${range.toFixed(3)} m`];
  if (id >= 0) lines.push(`given to landmark ${id}`);
  if (trueId === -1) lines.push("in truth clutter");
  else if (trueId >= 0 && trueId !== id) lines.push(`in truth of landmark ${trueId}`);
  return lines.join("\n");
}
