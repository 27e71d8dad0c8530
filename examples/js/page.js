/**
 * The page of index.html: the drones from above, and buttons. `?gateway=ws://HOST:8000/stream&token=TOKEN` selects a
 * gateway other than port 8000 of the page's own host.
 */
import { connect } from "../../clients/js/zsim.js";
import { colour, draw } from "./map.js";

const OPERATOR = 10; // priority; that of programs is 0
const HOLD_EVERY_MS = 100; // wall time; a drone without commands for 0.5 s of simulated time hovers, and later lands
const AGAIN_MS = 1000; // between two attempts to connect
const NEWS_MAX = 6;

const given = new URLSearchParams(location.search);
const address = given.get("gateway") ?? `ws://${location.hostname || "127.0.0.1"}:8000/stream`;
const me = `page-${Math.random().toString(36).slice(2, 8)}`;
const find = (id) => document.getElementById(id);
const trails = new Map(); // drone: [[east, north], …]
const held = new Set(); // drones whose position this page holds
const rows = new Map(); // drone: its row in the table
let zsim = null;
let held_ms = 0; // when the held drones last received a command

/** Follow one gateway indefinitely, and reconnect after every failure. */
async function main() {
  for (;;) {
    try {
      zsim = await connect(address, { name: me, token: given.get("token") ?? "", timeoutS: 2 });
      await follow();
      show(await zsim.closed);
    } catch (error) {
      zsim?.close(); // after a failed request: keep only the next connection
      show(error.message);
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
}

async function follow() {
  zsim.on("run", ({ state }) => (state === "lost" ? show("the gateway has lost its world") : onRun()));
  zsim.on("refused", (error) => tell(error.message, "refused"));
  await zsim.subscribe("view/drones", onView);
  await zsim.subscribe("cluster/*/state", onCluster);
  await zsim.subscribe("world/event", onEvent);
  onRun();
}

function onRun() {
  const { run_id, mode, clusters = [] } = zsim.run;
  show(run_id ? `run ${run_id}, ${mode}, as ${zsim.name}` : "no run goes on");
  held.clear();
  trails.clear();
  rows.forEach((row) => row.remove());
  rows.clear();
  find("clusters").replaceChildren(...clusters.map(clusterRow));
}

function onView({ drones }) {
  for (const drone of drones) {
    const row = rows.get(drone.name) ?? addRow(drone.name);
    fill(row, drone);
    const trail = trails.get(drone.name) ?? [];
    trails.set(drone.name, [...trail.slice(-300), drone.position_m.slice(0, 2)]);
  }
  draw(find("map"), drones, trails);
  keepHolding();
}

function onCluster({ phase, reason }, key) {
  const cell = document.querySelector(`[data-cluster="${key.split("/")[1]}"] .phase`);
  if (cell) cell.textContent = reason ? `${phase}: ${reason}` : phase;
}

function onEvent({ kind, text, t_ns }) {
  if (kind !== "command") tell(text, kind, `${(t_ns / 1e9).toFixed(2)} s  `);
}

// Buttons

const takeOff = (drone) => zsim.mode(drone, "takeoff");

/** Land a drone, even if another program flies it. */
async function land(drone) {
  held.delete(drone);
  await zsim.ask("world/control", "acquire", { drone, priority: OPERATOR });
  await zsim.mode(drone, "land");
  await zsim.ask("world/control", "release", { drone });
}

/** Take over a drone and hold its position, or let it go. */
async function hold(drone) {
  if (held.delete(drone)) {
    await zsim.ask("world/control", "release", { drone });
    return;
  }
  await zsim.ask("world/control", "acquire", { drone, priority: OPERATOR });
  held.add(drone);
}

/** Command held drones to stand still; called at each view, since browsers slow down the timers of hidden pages. */
function keepHolding() {
  if (performance.now() - held_ms < HOLD_EVERY_MS) return;
  held_ms = performance.now();
  held.forEach((drone) => zsim.velocity(drone, [0, 0, 0]));
}

function button(text, what, action) {
  const made = label(document.createElement("button"), text, what);
  made.onclick = () => action(what).catch((error) => tell(error.message, "refused"));
  return made;
}

function label(made, text, what) {
  made.textContent = text;
  made.setAttribute("aria-label", `${text} ${what}`);
  return made;
}

// The table

function addRow(drone) {
  const row = find("drones").insertRow();
  row.insertCell().textContent = drone;
  for (const kind of ["state", "position", "battery"]) row.insertCell().className = kind;
  row.insertCell().append(button("Take off", drone, takeOff), button("Land", drone, land), button("Hold", drone, hold));
  row.cells[0].style.color = colour(rows.size);
  rows.set(drone, row);
  return row;
}

function fill(row, { name, state, position_m, battery_percent }) {
  row.querySelector(".state").textContent = held.has(name) ? `${state}, held` : state;
  row.querySelector(".position").textContent = position_m.map((x) => x.toFixed(2)).join(" ");
  row.querySelector(".battery").textContent = `${battery_percent.toFixed(0)} %`;
  label(row.querySelector("button:last-child"), held.has(name) ? "Let go" : "Hold", name);
}

function clusterRow({ name }) {
  const row = document.createElement("tr");
  row.dataset.cluster = name;
  row.insertCell().textContent = name;
  row.insertCell().className = "phase";
  const ask = (request) => (cluster) => zsim.ask(`cluster/${cluster}/control`, request);
  const asked = { "Take off": "takeoff", Engage: "engage", Hold: "hold", Rejoin: "rejoin", Land: "land" };
  row.insertCell().append(...Object.entries(asked).map(([text, request]) => button(text, name, ask(request))));
  return row;
}

function show(text) {
  find("link").textContent = text;
}

/** Add a line to the news; a text that is repeated is shown once. */
function tell(text, kind, when = "") {
  const last = find("news").firstChild;
  if (last?.dataset.text === text) last.remove();
  const line = document.createElement("li");
  line.textContent = when + text;
  line.dataset.text = text;
  line.className = kind;
  find("news").prepend(line);
  while (find("news").childElementCount > NEWS_MAX) find("news").lastChild.remove();
}

main();
