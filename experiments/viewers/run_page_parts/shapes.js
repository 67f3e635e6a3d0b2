const SIGMAS = 3;
const REACH = 16; // of the pointer [px]
const MOST_VALUES = 14; // correlations written beside their landmarks

/** Colours of the page, which follow the reader's light or dark setting. */
function colours(filter) {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  const names = ["blue", "orange", "teal", "purple", "sky"];
  return {
    own: read(names[filter % names.length]),
    ink: read("ink"), grey: read("grey"), pale: read("pale"), paper: read("paper"), alarm: read("alarm"),
  };
}

/** Half axes and angle of the 1σ ellipse. */
function ellipseAxes({ std_x, std_y, rho }) {
  const [a, b, c] = [std_x ** 2, rho * std_x * std_y, std_y ** 2];
  const middle = (a + c) / 2;
  const spread = Math.hypot((a - c) / 2, b);
  return {
    long: Math.sqrt(middle + spread),
    short: Math.sqrt(Math.max(middle - spread, 0)),
    angle: Math.atan2(2 * b, a - c) / 2,
  };
}

/** Make a canvas as sharp as the screen; return its context, in CSS pixels. */
function sharpen(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Shapes in pixels, the same in the map and in its legend. */
const shapes = {
  cross(context, x, y, size) {
    context.beginPath();
    context.moveTo(x - size, y);
    context.lineTo(x + size, y);
    context.moveTo(x, y - size);
    context.lineTo(x, y + size);
    context.stroke();
  },
  times(context, x, y, size) {
    context.beginPath();
    context.moveTo(x - size, y - size);
    context.lineTo(x + size, y + size);
    context.moveTo(x - size, y + size);
    context.lineTo(x + size, y - size);
    context.stroke();
  },
  dot(context, x, y, size) {
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.fill();
  },
  ring(context, x, y, size) {
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.stroke();
  },
  line(context, x0, y0, x1, y1, dash) {
    context.setLineDash(dash || []);
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    context.stroke();
    context.setLineDash([]);
  },
  robot(context, x, y, heading, size) {
    context.beginPath();
    for (const [along, left] of [[1.25, 0], [-0.85, 0.8], [-0.4, 0], [-0.85, -0.8]]) {
      const [c, s] = [Math.cos(heading), Math.sin(heading)];
      context.lineTo(x + size * (c * along - s * left), y - size * (s * along + c * left));
    }
    context.closePath();
  },
};
