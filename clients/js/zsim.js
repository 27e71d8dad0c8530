/**
 * Client for `zsim gateway`, for browsers and Node (18 or newer): one module without dependencies.
 *
 *     import { connect } from "./zsim.js";
 *     const zsim = await connect("ws://127.0.0.1:8000/stream", { name: "laptop" });
 *     await zsim.mode("drone1", "takeoff");
 *     await zsim.subscribe("drone/drone1/truth", (truth) => console.log(truth.position_m));
 *
 * In Node the address may also be that of the TCP lines, `tcp://127.0.0.1:7470`, which needs no WebSocket (available
 * from Node 22 on). Failures reject with an Error whose message is one line. Units are SI and radians; `t_ns` is in
 * simulated nanoseconds. docs/clients-js.md has first programs; docs/gateway.md describes the protocol.
 */

const TIMEOUT_S = 5; // default timeout for a connection and for each answer
const AGAIN_S = 0.2; // between two attempts to connect, while a gateway may be starting
const RETURN_S = 1; // additional timeout if the gateway itself waits for an answer

/**
 * Connect and say hello; wait up to `timeoutS` for the gateway.
 *
 * @param {string} address `ws://HOST:8000/stream`, `wss://…`, or in Node `tcp://HOST:7470`.
 * @param {{name?: string, token?: string, timeoutS?: number}} options A `name` without a dot becomes
 *     client.NAME; `token` is needed if the gateway requires one.
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

/** Raised when no gateway answers at an address yet. */
class NobodyThere extends Error {}

/** One connection to a gateway. */
export class Zsim {
  /** Name of this client, e.g. client.laptop. */
  name = "";
  /** The run, as reported by the gateway: run_id (null if there is no run), mode, gate_s, t_ns, drones, clusters. */
  run = { run_id: null };
  /** A promise of the reason why the connection ended. */
  closed;

  constructor(timeoutS) {
    this._timeoutS = timeoutS;
    this._wire = null;
    this._id = 0;
    this._waiting = new Map(); // id of a request: { resolve, reject, timer }
    this._subscribed = new Map(); // expression: list of takers
    this._handlers = { run: [], lost: [], refused: [] };
    this._seat = null;
    this._onNews = () => {};
    this.closed = new Promise((resolve) => (this._resolveClosed = resolve));
  }

  /** Tell the gateway the name of this client, and update `run`. */
  async hello(name = "", token = "") {
    const { op, id, name: given, ...run } = await this.request("hello", { ...(name && { name }), ...(token && { token }) });
    this.name = given;
    this.run = run;
    return run;
  }

  /** Wait until there is a run. */
  async untilRun() {
    while (this.run.run_id === null) await new Promise((resolve) => (this._onNews = resolve));
  }

  /**
   * Add a handler for messages that do not answer a request.
   *
   * @param {"run"|"lost"|"refused"} kind `run`: called with {state, run_id} when a run has begun or ended, or the link
   *     to its world is lost or back; `lost`: with {lines}, the number of values dropped because they arrived faster
   *     than they were read; `refused`: with an Error, when a message sent without waiting was refused.
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

  /** Publish a value, and wait for the gateway's answer. `t_ns`, `seq` and `source` are filled in. */
  async put(key, value) {
    await this.request("put", { key, value });
  }

  /** Publish a value without waiting; if the gateway refuses it, the handlers of `on("refused")` are called. */
  send(key, value) {
    this._say("put", { key, value, quiet: true });
  }

  /** Command a velocity [m/s, rad/s] without waiting. `frame`: "heading" (x forward, y left, z up) or "world". */
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

  /** Return the last values of all keys that match an expression, as a list of { key, value }. */
  async latestOf(expression) {
    return (await this.request("latest", { key: expression })).values;
  }

  /**
   * Call `taker(value, key)` for every value on an expression. Returns a function that ends the subscription.
   * A value that matches two subscribed expressions is delivered twice, so expressions should not overlap.
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

  /**
   * Send a request to the world or a controller: `ask("cluster/main/control", "engage")`. Rejects with the reason if
   * it is refused.
   */
  async ask(key, request, args = {}) {
    const fields = { key, request, args, timeout_s: this._timeoutS };
    const answer = await this.request("ask", fields, this._timeoutS + RETURN_S);
    if (!answer.ok) throw new Error(`${key} ${request}: ${answer.error ?? "refused"}`);
    return answer.result;
  }

  /**
   * Start a lockstep session: from now on simulated time waits for this program.
   *
   *     for await (const gate of await zsim.join("square", { reads: ["drone/drone1/estimate"] })) {
   *       gate.velocity("drone1", steer(gate.input("drone/drone1/estimate")));
   *     }
   *
   * The end of the loop body answers a gate; leaving the loop ends the session. The loop throws an Error if the session
   * is lost, or if an output is refused.
   *
   * @param {{periodS?: number, reads?: string[], gates?: string[]}} options `periodS` is one gate by default.
   */
  async join(name, { periodS = this.run.gate_s, reads = [], gates = [] } = {}) {
    if (this._seat !== null) throw new Error("join: has a seat already; leave it first, or use another connection");
    const seat = new Seat(this);
    this._seat = seat; // set before the answer, because the first gate may arrive with it
    try {
      const answer = await this.request("join", { name, period_s: periodS, reads, gates });
      this.name = answer.name;
    } catch (error) {
      this._seat = null;
      throw error;
    }
    return seat;
  }

  /** Close the connection. */
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
    if (this._wire === null) return; // closed: ignore the remaining lines
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

  /** Update `run` before the handlers learn that the next run has begun. */
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

/** A lockstep session; see `Zsim.join`. */
class Seat {
  constructor(zsim) {
    this._zsim = zsim;
    this._come = []; // gates that have arrived, oldest first
    this._open = null; // the gate not answered yet
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

  /** Leave; called when the loop is left. */
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

  /** Leave, so that simulated time continues without this program, and throw the reason. */
  async _giveUp() {
    await this._leave().catch(() => undefined); // report the original failure, not this one
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

/** One gate: the inputs since the last one, and the outputs that answer it. */
class Gate {
  constructor(seat, { t_ns, inputs }) {
    this._seat = seat;
    this._outputs = [];
    this._isDone = false;
    /** Simulated time [ns]. */
    this.t_ns = t_ns;
    /** List of { key, value }, in time order. */
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

  /** Answer the gate now rather than at the end of the loop body. */
  done() {
    if (this._isDone) return;
    this._isDone = true;
    this._seat._done(this.t_ns, this._outputs);
  }
}

/** Return whether a key matches an expression: `*` is one part, `**` any number of parts, `$*` any piece of a part. */
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

/** Open a WebSocket; a browser can send a token only in the address. */
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

/** Open a TCP connection for lines; only in Node. */
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
