/**
 * Flies drone1 along a 2 m square in the lockstep, with its own position controller, and lands.
 *
 *     node examples/js/fly.mjs [tcp://HOST:PORT | ws://HOST:PORT/stream]
 */
import { connect } from "../../clients/js/zsim.js";

const DRONE = "drone1";
const GAIN_1_S = 0.8; // speed per metre of error
const SPEED_M_S = 0.8; // maximum on each axis
const NEAR_M = 0.25; // distance at which a corner counts as reached; the estimate is not more accurate
const LEG_S = 8; // maximum time for a corner; then the drone flies to the next one
const CORNERS = [[0, 0, 1.5], [2, 0, 1.5], [2, 2, 1.5], [0, 2, 1.5], [0, 0, 1.5]]; // from its start

const zsim = await connect(process.argv[2] ?? "tcp://127.0.0.1:7470", { name: "square", timeoutS: 30 });
await zsim.untilRun();

const reads = [`drone/${DRONE}/estimate`, `drone/${DRONE}/sensor/status`];
const square = flight();
for await (const gate of await zsim.join("square", { periodS: 0.02, reads })) {
  const { position_m } = gate.input(`drone/${DRONE}/estimate`) ?? {};
  const { state } = gate.input(`drone/${DRONE}/sensor/status`) ?? {};
  if (position_m === undefined) continue;
  if (state === "landed" && square.over) {
    console.log(`landed at t = ${(gate.t_ns / 1e9).toFixed(2)} s`);
    break;
  }
  if (state === "landed") square.startsAt(position_m, gate);
  else if (square.over) gate.mode(DRONE, "land");
  else if (state === "hovering" || state === "flying") square.fly(position_m, gate);
}
zsim.close();

/** Return a flight to each corner in turn; it is over after the last one. */
function flight() {
  let start = [0, 0, 0];
  let corner = 0;
  let since_s;
  return {
    get over() {
      return corner === CORNERS.length;
    },
    startsAt(position_m, gate) {
      start = [position_m[0], position_m[1], 0];
      gate.mode(DRONE, "takeoff");
    },
    fly(position_m, gate) {
      const t_s = gate.t_ns / 1e9;
      since_s ??= t_s;
      const error_m = position_m.map((at, i) => start[i] + CORNERS[corner][i] - at);
      const far_m = Math.hypot(...error_m);
      gate.velocity(DRONE, error_m.map((e) => Math.max(-SPEED_M_S, Math.min(SPEED_M_S, GAIN_1_S * e))), 0, "world");
      if (far_m > NEAR_M && t_s - since_s < LEG_S) return;
      const at = position_m.map((x) => x.toFixed(2)).join(" ");
      console.log(`t = ${t_s.toFixed(2)} s  corner ${corner}  at ${at} m, ${far_m.toFixed(2)} m away`);
      since_s = t_s;
      corner += 1;
    },
  };
}
