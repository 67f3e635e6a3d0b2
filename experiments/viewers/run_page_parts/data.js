"use strict";

const NO_POSITION = -2147483648;
const NO_DEVIATION = -32768;
const KINDS = { float32: Float32Array, int32: Int32Array, int16: Int16Array, uint8: Uint8Array };

/** Add up the differences between frames, in place; return where each frame begins. */
function sumFrames(values, counts) {
  const starts = new Int32Array(counts.length + 1);
  for (let k = 0; k < counts.length; k++) {
    const from = starts[k];
    const before = k ? starts[k - 1] : 0;
    const common = k ? Math.min(counts[k], counts[k - 1]) : 0;
    for (let i = 0; i < common; i++) values[from + i] += values[before + i];
    starts[k + 1] = from + counts[k];
  }
  return starts;
}

/** Read the arrays that packed_arrays.py has written, by name; frames have `starts`. */
async function unpack(text, table) {
  const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const arrays = {};
  let offset = 0;
  for (const [name, entry] of Object.entries(table)) {
    const Kind = KINDS[entry.type];
    const values = new Kind(buffer, offset, entry.length);
    offset += Math.ceil(values.byteLength / 4) * 4;
    arrays[name] = { values };
    if (entry.counts) arrays[name].starts = sumFrames(values, arrays[entry.counts].values);
  }
  return arrays;
}

const metres = (code) => (code === NO_POSITION ? NaN : code / 1e4);
const deviation = (code) => (code === NO_DEVIATION ? 0 : Math.exp(code / 2000));

/** One filter's beliefs. */
class FilterRun {
  constructor(arrays, number, name) {
    this.number = number;
    this.name = name;
    this.array = (key) => arrays[`${number}.${key}`].values;
    this.starts = arrays[`${number}.id`].starts;
    this.columns = Object.fromEntries(
      ["id", "x", "y", "std_x", "std_y", "rho", "outcome", "row_id"].map((key) => [key, this.array(key)]),
    );
    this.poses = Object.fromEntries(
      ["x", "y", "theta", "std_x", "std_y", "std_theta", "rho"].map((key) => [key, this.array(`pose.${key}`)]),
    );
    this.readPairs(arrays);
    const ids = this.array("final.id");
    const x = this.array("final.x");
    const y = this.array("final.y");
    this.truth = new Map();
    ids.forEach((id, i) => Number.isNaN(x[i]) || this.truth.set(id, [x[i], y[i]]));
  }

  readPairs(arrays) {
    this.pairPlaces = this.array("pairs.place");
    this.pairIds = arrays[`${this.number}.pairs.id`];
    this.pairValues = arrays[`${this.number}.pairs.value`];
  }

  pose(place) {
    return Object.fromEntries(Object.entries(this.poses).map(([key, values]) => [key, values[place]]));
  }

  /** The landmarks after a step. */
  map(place) {
    const { id, x, y, std_x, std_y, rho } = this.columns;
    const landmarks = [];
    for (let i = this.starts[place]; i < this.starts[place + 1]; i++) {
      landmarks.push({
        id: id[i], x: metres(x[i]), y: metres(y[i]),
        std_x: deviation(std_x[i]), std_y: deviation(std_y[i]), rho: rho[i] / 32000,
      });
    }
    return landmarks;
  }

  /** Correlations of a node with all others, by their ids; the robot's id is "robot". */
  correlations(place, node) {
    let frame = this.pairPlaces.length - 1;
    while (frame >= 0 && this.pairPlaces[frame] > place) frame--;
    const found = new Map();
    if (frame < 0) return found;
    const ids = this.pairIds.values.subarray(this.pairIds.starts[frame], this.pairIds.starts[frame + 1]);
    const values = this.pairValues.values;
    const from = this.pairValues.starts[frame];
    const own = node === "robot" ? 0 : ids.indexOf(node) + 1;
    if (node !== "robot" && own === 0) return found;
    for (let other = 0; other <= ids.length; other++) {
      if (other === own) continue;
      const row = Math.max(own, other);
      const at = from + (row * (row - 1)) / 2 + Math.min(own, other);
      found.set(other ? ids[other - 1] : "robot", values[at] / 255);
    }
    return found;
  }
}

/** All that the page shows: the world, its readings, and the filters. */
class Run {
  constructor(facts, arrays) {
    Object.assign(this, { facts, arrays, walls: facts.walls, outcomes: facts.outcomes });
    const values = (key) => arrays[key].values;
    this.steps = values("step");
    this.t = values("t");
    this.truth = { x: values("true.x"), y: values("true.y"), theta: values("true.theta") };
    const [ids, x, y] = [values("landmark.id"), values("landmark.x"), values("landmark.y")];
    this.landmarks = Array.from(ids, (id, i) => ({ id, x: x[i], y: y[i] }));
    this.filters = facts.filters.map((name, i) => new FilterRun(arrays, i, name));
    this.length = this.steps.length;
    this.hasTruth = this.truth.x.some((value) => !Number.isNaN(value));
  }

  /** The readings of a step as one filter has used them. */
  readings(place, filter) {
    const { starts } = this.arrays["reading.true"];
    const found = [];
    for (let i = starts[place]; i < starts[place + 1]; i++) {
      found.push({
        bearing: this.arrays["reading.bearing"].values[i] / 1e4,
        range: metres(this.arrays["reading.range"].values[i]),
        trueId: this.arrays["reading.true"].values[i],
        outcome: this.outcomes[filter.columns.outcome[i]],
        id: filter.columns.row_id[i],
      });
    }
    return found;
  }
}
