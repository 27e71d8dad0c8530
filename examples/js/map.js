/** Draws the drones from above on a canvas: east to the right, north up, in metres. */

const LEAST_M = 4; // minimum of half the side of the area shown
const STEPS_M = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]; // possible spacings of the grid
const LINES_MAX = 12; // maximum number of grid lines in each direction
const COLOURS = ["#2f7de1", "#e1632f", "#2fa85a", "#a84fd0", "#c7a21a", "#20a5a8"];

/**
 * Draw the drones of a message on `view/drones`.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {{name: string, position_m: number[], orientation_wxyz: number[]}[]} drones
 * @param {Map<string, number[][]>} trails past positions of each drone: [[east, north], …]
 */
export function draw(canvas, drones, trails) {
  const pen = canvas.getContext("2d");
  const ratio = window.devicePixelRatio;
  const side = canvas.clientWidth;
  canvas.width = canvas.height = Math.round(side * ratio);
  pen.scale(ratio, ratio);
  pen.font = "12px system-ui, sans-serif";
  const view = fitted(drones, side);
  grid(pen, view);
  drones.forEach((drone, i) => {
    pen.strokeStyle = pen.fillStyle = colour(i);
    trail(pen, view, trails.get(drone.name) ?? []);
    body(pen, view, drone);
  });
}

/** Return the colour of the i-th drone. */
export function colour(i) {
  return COLOURS[i % COLOURS.length];
}

/** Return the area shown: its middle, half its side, and `place`, which maps a point of the world to the canvas. */
function fitted(drones, side) {
  const [east, north] = [0, 1].map((axis) => {
    const all = drones.map((drone) => drone.position_m[axis]);
    return { low: Math.min(...all, 0), high: Math.max(...all, 0) };
  });
  const middle = [(east.low + east.high) / 2, (north.low + north.high) / 2];
  const half_m = Math.max(LEAST_M, 0.6 * Math.max(east.high - east.low, north.high - north.low));
  const scale = side / (2 * half_m);
  const place = ([x, y]) => [side / 2 + (x - middle[0]) * scale, side / 2 - (y - middle[1]) * scale];
  return { middle, half_m, scale, side, place };
}

function grid(pen, { middle, half_m, side, place }) {
  const step_m = STEPS_M.find((step) => (2 * half_m) / step <= LINES_MAX) ?? STEPS_M.at(-1);
  pen.strokeStyle = "#8884";
  pen.fillStyle = "#888";
  pen.beginPath();
  for (const axis of [0, 1]) {
    for (let at = Math.ceil((middle[axis] - half_m) / step_m) * step_m; at < middle[axis] + half_m; at += step_m) {
      const [x, y] = place([at, at]);
      pen.moveTo(axis ? 0 : x, axis ? y : 0);
      pen.lineTo(axis ? side : x, axis ? y : side);
      pen.fillText(`${at}`, axis ? 2 : x + 2, axis ? y - 2 : side - 3);
    }
  }
  pen.stroke();
}

function trail(pen, { place }, points) {
  pen.globalAlpha = 0.4;
  pen.beginPath();
  points.forEach((point) => pen.lineTo(...place(point)));
  pen.stroke();
  pen.globalAlpha = 1;
}

/** Draw a drone as a disc with a line ahead, and its name and height beside it. */
function body(pen, { place }, { name, position_m, orientation_wxyz }) {
  const [x, y] = place(position_m);
  const [w, i, j, k] = orientation_wxyz;
  const yaw_rad = Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));
  pen.beginPath();
  pen.arc(x, y, 6, 0, 2 * Math.PI);
  pen.fill();
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(x, y);
  pen.lineTo(x + 14 * Math.cos(yaw_rad), y - 14 * Math.sin(yaw_rad));
  pen.stroke();
  pen.lineWidth = 1;
  const label = `${name}  ${position_m[2].toFixed(1)} m`;
  const right_px = pen.canvas.clientWidth - pen.measureText(label).width - 4; // the label stays within the canvas
  pen.fillText(label, Math.min(x + 10, right_px), y + 16);
}
