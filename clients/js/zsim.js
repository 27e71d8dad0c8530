/**
 * The client of `zsim gateway` for browsers and Node (18 or newer): one module, no dependency.
 *
 *     import { connect } from "./zsim.js";
 *     const zsim = await connect("ws://127.0.0.1:8000/stream", { name: "laptop" });
 *     await zsim.mode("drone1", "takeoff");
 *     await zsim.subscribe("drone/drone1/truth", (truth) => console.log(truth.position_m));
 *
 * In Node the address may be that of the lines, `tcp://127.0.0.1:7470`, which needs no WebSocket (Node has one from 22
 * on). Everything that fails rejects with an Error whose message is one line. Units are SI and radians; `t_ns` are
 * simulated nanoseconds. docs/clients-js.md has first programs, docs/gateway.md what goes over the wire.
 */

const TIMEOUT_S = 5; // for a connection, and for an answer
const AGAIN_S = 0.2; // until the next try to connect: a gateway on its way up is there soon enough
const RETURN_S = 1; // more, for an answer of a gateway that waits for others' answers

/**
 * Connect and say hello; wait `timeoutS` for the gateway.
 *
 * @param {string} address `ws://HOST:8000/stream`, `wss://…`, or in Node `tcp://HOST:7470`.
 * @param {{name?: string, token?: string, timeoutS?: number}} options `name` without a dot becomes client.NAME;
 *     `token` where the gateway asks for one.
 * @returns {Promise<Zsim>}
 */
export async function connect(address, { name = "", token = "", timeoutS = TIMEOUT_S } = {}) {
  const zsim = new Zsim(timeoutS);
  const open = address.startsWith("tcp:") ? openLines : openWebSocket;
  const begun_ms = Date.now();
  while (zsim._wire === null) {
    const left_s = timeoutS - (Date.now() - begun_ms) / 1000;
    try {
      zsim._wire = await open(address, token, Math.max(left_s, AGAIN_S), zsim);
    } catch (error) {
      if (left_s < AGAIN_S || !(error instanceof NobodyThere)) throw error;
      await new Promise((resolve) => setTimeout(resolve, 1000 * AGAIN_S));
    }
  }
  try {
    await zsim.hello(name, token);
  } catch (error) {
    zsim.close();
    throw error;
  }
  return zsim;
}

function parsed(line) {
  try {
    return JSON.parse(line);
  } catch {
    return null;
  }
}

/** Nobody answers at an address, yet. */
class NobodyThere extends Error {}

/** One connection. */
export class Zsim {
  /** Who it is, such as client.laptop. */
  name = "";
  /** What the gateway said of the run: run_id (null while none goes on), mode, gate_s, t_ns, drones, clusters. */
  run = { run_id: null };
  /** Resolves with the reason when the connection has ended. */
  closed;

  constructor(timeoutS) {
    this._timeoutS = timeoutS;
    this._wire = null;
    this._id = 0;
    this._waiting = new Map(); // id of a request: { resolve, reject, timer }
    this._subscribed = new Map(); // expression: takers
    this._handlers = { run: [], lost: [], refused: [] };
    this._seat = null;
    this._onNews = () => {};
    this.closed = new Promise((resolve) => (this._resolveClosed = resolve));
  }

  /** Say who it is, and ask for `run` again. */
  async hello(name = "", token = "") {
    const { op, id, name: given, ...run } = await this.request("hello", { ...(name && { name }), ...(token && { token }) });
    this.name = given;
    this.run = run;
    return run;
  }

  /** Wait until a run goes on. */
  async untilRun() {
    while (this.run.run_id === null) await new Promise((resolve) => (this._onNews = resolve));
  }

  /**
   * Be told of what nobody asked for.
   *
   * @param {"run"|"lost"|"refused"} kind `run`: ({state, run_id}), a run begun or ended, its link lost or back;
   *     `lost`: ({lines}), values that came faster than they were read; `refused`: (Error), something said without
   *     waiting for an answer.
   */
  on(kind, handler) {
    this._handlers[kind].push(handler);
    return this;
  }

  /** Send any request of docs/gateway.md and return its answer. */
  request(op, fields = {}, timeoutS = this._timeoutS) {
    return new Promise((resolve, reject) => {
      const id = this._say(op, fields);
      const late = () => this._settle(id)?.reject(new Error(`${op}: no answer within ${timeoutS} s`));
      this._waiting.set(id, { resolve, reject, timer: setTimeout(late, 1000 * timeoutS) });
    });
  }

  /** Publish a value. `t_ns`, `seq` and `source` are filled in. */
  async put(key, value) {
    await this.request("put", { key, value });
  }

  /** Publish a value and wait for nothing; `on("refused")` is told if the gateway does not take it. */
  send(key, value) {
    this._say("put", { key, value, quiet: true });
  }

  /** Fly a drone [m/s, rad/s] without waiting. `frame`: "heading" (x forward, y left, z up) or "world". */
  velocity(drone, velocity_m_s, yaw_rate_rad_s = 0, frame = "heading") {
    this.send(`drone/${drone}/cmd/velocity`, { velocity_m_s, yaw_rate_rad_s, frame });
  }

  /** @param {"takeoff"|"land"|"emergency"|"reset"} mode */
  async mode(drone, mode) {
    await this.put(`drone/${drone}/cmd/mode`, { mode });
  }

  /** Return the last value of a key; undefined if there is none. */
  async latest(key) {
    return (await this.latestOf(key))[0]?.value;
  }

  /** Return the last values of all keys that an expression takes, as a list of { key, value }. */
  async latestOf(expression) {
    return (await this.request("latest", { key: expression })).values;
  }

  /**
   * Be told of every value on an expression: `taker(value, key)`. Returns a function that ends it.
   * A value that two different expressions take comes once for each: let them not overlap.
   */
  async subscribe(expression, taker) {
    const takers = this._subscribed.get(expression) ?? [];
    this._subscribed.set(expression, [...takers, taker]);
    if (takers.length === 0) {
      await this.request("subscribe", { key: expression }).catch((error) => {
        this._subscribed.delete(expression);
        throw error;
      });
    }
    return () => this._unsubscribe(expression, taker);
  }

  async _unsubscribe(expression, taker) {
    const left = (this._subscribed.get(expression) ?? []).filter((each) => each !== taker);
    this._subscribed.set(expression, left);
    if (left.length > 0 || !this._subscribed.delete(expression)) return;
    await this.request("unsubscribe", { key: expression });
  }

  /** Ask the world or a controller: `ask("cluster/main/control", "engage")`. Rejects with the reason if it refuses. */
  async ask(key, request, args = {}) {
    const fields = { key, request, args, timeout_s: this._timeoutS };
    const answer = await this.request("ask", fields, this._timeoutS + RETURN_S);
    if (!answer.ok) throw new Error(`${key} ${request}: ${answer.error ?? "refused"}`);
    return answer.result;
  }

  /**
   * Take a seat in the lockstep: from now on simulated time waits for this program.
   *
   *     for await (const gate of await zsim.join("square", { reads: ["drone/drone1/estimate"] })) {
   *       gate.velocity("drone1", steer(gate.input("drone/drone1/estimate")));
   *     }
   *
   * A gate is done when the loop comes round; leaving the loop leaves the seat. Losing the seat, and a refused output,
   * are thrown out of the loop.
   *
   * @param {{periodS?: number, reads?: string[], gates?: string[]}} options `periodS` is the gate if not given.
   */
  async join(name, { periodS = this.run.gate_s, reads = [], gates = [] } = {}) {
    if (this._seat !== null) throw new Error("join: has a seat already; leave it first, or use another connection");
    const seat = new Seat(this);
    this._seat = seat; // before the answer: the first gate may come with it
    try {
      const answer = await this.request("join", { name, period_s: periodS, reads, gates });
      this.name = answer.name;
    } catch (error) {
      this._seat = null;
      throw error;
    }
    return seat;
  }

  /** Hang up. */
  close() {
    this._wire?.close();
    this._end("closed");
  }

  _say(op, fields) {
    if (this._wire === null) throw new Error(`${op}: the connection has ended; connect again`);
    const id = ++this._id;
    this._wire.send(JSON.stringify({ op, id, ...fields }));
    return id;
  }

  _settle(id) {
    const waiting = this._waiting.get(id);
    if (waiting === undefined) return undefined;
    clearTimeout(waiting.timer);
    this._waiting.delete(id);
    return waiting;
  }

  _take(line) {
    if (this._wire === null) return; // closed: what came with the last line is for nobody
    const message = parsed(line);
    if (message === null) {
      this._wire?.close();
      this._end("what came is no JSON; is this a gateway?");
      return;
    }
    if (message.op === "value") this._onValue(message);
    else if (message.op === "gate") this._seat?._onGate(message);
    else if (message.op === "left") this._loseSeat(message.reason);
    else if (message.op === "run") this._onRun(message);
    else if (message.op === "lost") this._tell("lost", message);
    else if (message.op === "error") this._onError(message);
    else this._settle(message.id)?.resolve(message);
  }

  _onValue({ key, value }) {
    for (const [expression, takers] of this._subscribed) {
      if (matches(expression, key)) takers.forEach((taker) => taker(value, key));
    }
  }

  /** Know the next run before anybody is told that it has begun. */
  async _onRun(message) {
    if (message.state === "begun") await this.hello().catch((error) => this._tell("refused", error));
    if (message.state === "ended") this.run = { run_id: null };
    this._onNews();
    this._tell("run", message);
  }

  _onError({ id, error }) {
    const refusal = new Error(error);
    const waiting = this._settle(id);
    if (waiting) waiting.reject(refusal);
    else if (!this._seat?._onRefused(id, refusal)) this._tell("refused", refusal);
  }

  _tell(kind, what) {
    if (kind === "refused" && this._handlers.refused.length === 0) console.warn(`zsim: ${what.message}`);
    this._handlers[kind].forEach((handler) => handler(what));
  }

  _loseSeat(reason) {
    this._seat?._fail(new Error(`the seat is lost: ${reason}`));
    this._seat = null;
  }

  _end(reason) {
    this._wire = null;
    for (const id of [...this._waiting.keys()]) this._settle(id).reject(new Error(`the connection has ended: ${reason}`));
    this._loseSeat(reason);
    this._resolveClosed(reason);
  }
}

/** A seat in the lockstep; see `Zsim.join`. */
class Seat {
  constructor(zsim) {
    this._zsim = zsim;
    this._come = []; // gates that have come
    this._open = null; // the gate that is worked on
    this._doneId = 0;
    this._failed = null;
    this._wake = () => {};
  }

  [Symbol.asyncIterator]() {
    return this;
  }

  async next() {
    this._open?.done();
    while (this._come.length === 0) {
      if (this._failed) await this._giveUp();
      await new Promise((resolve) => (this._wake = resolve));
    }
    this._open = this._come.shift();
    return { done: false, value: this._open };
  }

  /** Leave; called by a loop that is left. */
  async return() {
    this._open?.done();
    await this._leave();
    return { done: true, value: undefined };
  }

  async _leave() {
    if (this._zsim._seat !== this) return;
    this._zsim._seat = null;
    await this._zsim.request("leave");
  }

  /** Let time go on without it, and say why. */
  async _giveUp() {
    await this._leave().catch(() => undefined); // what was refused is what counts
    throw this._failed;
  }

  _onGate(message) {
    this._come.push(new Gate(this, message));
    this._wake();
  }

  _onRefused(id, error) {
    if (id !== this._doneId) return false;
    this._fail(error);
    return true;
  }

  _fail(error) {
    this._failed ??= error;
    this._wake();
  }

  _done(t_ns, outputs) {
    if (this._failed === null) this._doneId = this._zsim._say("done", { t_ns, outputs });
  }
}

/** One gate: what came since the last one, and what is said to it. */
class Gate {
  constructor(seat, { t_ns, inputs }) {
    this._seat = seat;
    this._outputs = [];
    this._isDone = false;
    /** Simulated time [ns]. */
    this.t_ns = t_ns;
    /** List of { key, value }, in order of time. */
    this.inputs = inputs;
  }

  /** Return the newest input on a key; undefined if there is none. */
  input(key) {
    return this.inputs.findLast((entry) => entry.key === key)?.value;
  }

  /** Publish a value, stamped with this gate. */
  put(key, value) {
    this._outputs.push({ key, value });
  }

  velocity(drone, velocity_m_s, yaw_rate_rad_s = 0, frame = "heading") {
    this.put(`drone/${drone}/cmd/velocity`, { velocity_m_s, yaw_rate_rad_s, frame });
  }

  mode(drone, mode) {
    this.put(`drone/${drone}/cmd/mode`, { mode });
  }

  /** Say now, rather than when the loop comes round, that this is all. */
  done() {
    if (this._isDone) return;
    this._isDone = true;
    this._seat._done(this.t_ns, this._outputs);
  }
}

/** Tell whether a key expression takes a key: `*` is one part of it, `**` any number, `$*` any piece of a part. */
export function matches(expression, key) {
  if (expression === key) return true;
  return expression.includes("*") && pattern(expression).test(key);
}

const patterns = new Map();

function pattern(expression) {
  if (!patterns.has(expression)) {
    const parts = expression.split("/").map((part) => {
      if (part === "**") return "(?:/[^/]+)*";
      if (part === "*") return "/[^/]+";
      return `/${part.split("$*").map((piece) => piece.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")).join("[^/]*")}`;
    });
    patterns.set(expression, new RegExp(`^${parts.join("")}$`));
  }
  const found = patterns.get(expression);
  return { test: (key) => found.test(`/${key}`) };
}

/** Open a WebSocket; a browser can show a token only in the address. */
function openWebSocket(address, token, timeoutS, zsim) {
  if (typeof WebSocket === "undefined") {
    throw new Error("this Node has no WebSocket (22 has one); connect to the lines: tcp://HOST:7470");
  }
  const url = new URL(address);
  if (token) url.searchParams.set("token", token);
  return new Promise((resolve, reject) => {
    const socket = new WebSocket(url);
    const late = setTimeout(() => socket.close(), 1000 * timeoutS);
    socket.onopen = () => {
      clearTimeout(late);
      socket.onclose = (event) => zsim._end(event.reason || "the gateway hung up");
      resolve({ send: (text) => socket.send(text), close: () => socket.close() });
    };
    socket.onmessage = (event) => zsim._take(event.data);
    socket.onclose = () => {
      clearTimeout(late);
      reject(new NobodyThere(`${url.origin}: no gateway answers there, or it wants a token`));
    };
  });
}

/** Open a connection to the lines, in Node. */
async function openLines(address, token, timeoutS, zsim) {
  const { createConnection } = await import("node:net");
  const { hostname, port } = new URL(address.replace(/^tcp:/, "http:"));
  return new Promise((resolve, reject) => {
    const socket = createConnection({ host: hostname.replace(/^\[|\]$/g, ""), port: Number(port || 80), noDelay: true });
    const late = setTimeout(() => socket.destroy(new Error("no answer")), 1000 * timeoutS);
    let begun = "";
    socket.setEncoding("utf8");
    socket.on("data", (text) => {
      const lines = (begun + text).split("\n");
      begun = lines.pop();
      lines.forEach((line) => zsim._take(line));
    });
    socket.on("error", (error) => {
      clearTimeout(late);
      reject(new NobodyThere(`${address}: no gateway answers there (${error.code ?? error.message})`));
    });
    socket.on("connect", () => {
      clearTimeout(late);
      socket.on("close", () => zsim._end("the gateway hung up"));
      resolve({ send: (text) => socket.write(`${text}\n`), close: () => socket.end() });
    });
  });
}
