/** Tests zsim.js with a fake gateway: `node --test clients/js/tests`. */
import assert from "node:assert/strict";
import { createServer } from "node:net";
import { once } from "node:events";
import { test } from "node:test";

import { connect, matches } from "../zsim.js";

const RUN = { run_id: "r1", federation: "zsim", mode: "lockstep", gate_s: 0.02, t_ns: 0, drones: ["drone1"], clusters: [] };

/** A gateway that sends what the test specifies; it serves one connection. */
class FakeGateway {
  async open() {
    this._server = createServer((socket) => this._serve(socket)).listen(0, "127.0.0.1");
    await once(this._server, "listening");
    this.address = `tcp://127.0.0.1:${this._server.address().port}`;
    this._requests = [];
    return this;
  }

  _serve(socket) {
    let begun = "";
    this.socket = socket.setEncoding("utf8");
    socket.on("data", (text) => {
      const lines = (begun + text).split("\n");
      begun = lines.pop();
      this._requests.push(...lines.map(JSON.parse));
      this._wake?.();
    });
  }

  async hears(op) {
    while (this._requests.length === 0) await new Promise((resolve) => (this._wake = resolve));
    const request = this._requests.shift();
    assert.equal(request.op, op);
    return request;
  }

  async answers(op, fields = {}) {
    const request = await this.hears(op);
    this.says({ op, id: request.id, ...fields });
    return request;
  }

  says(message) {
    this.socket.write(`${JSON.stringify(message)}\n`);
  }

  close() {
    this.socket?.destroy();
    this._server.close();
  }
}

/** Run a test with a client that has said hello. */
function connected(name, run) {
  test(name, async () => {
    const fake = await new FakeGateway().open();
    const [zsim] = await Promise.all([
      connect(fake.address, { name: "me", timeoutS: 5 }),
      fake.answers("hello", { name: "client.me", ...RUN }),
    ]);
    try {
      await run(zsim, fake);
    } finally {
      zsim.close();
      fake.close();
    }
  });
}

test("expressions take keys", () => {
  assert.ok(matches("a/b", "a/b") && matches("drone/*/truth", "drone/drone1/truth") && matches("**", "a/b/c"));
  assert.ok(matches("drone/**", "drone") && matches("a/**/c", "a/c") && matches("a/**/c", "a/b/b/c"));
  assert.ok(matches("drone/drone$*/truth", "drone/drone12/truth") && matches("a.b/*", "a.b/c"));
  assert.ok(!matches("drone/*", "drone/a/b") && !matches("a.b/*", "axb/c") && !matches("*/truth", "truth"));
});

test("nobody there, and a wrong token, are told in a line", async () => {
  await assert.rejects(connect("tcp://127.0.0.1:1", { timeoutS: 0.3 }), /tcp:\/\/127.0.0.1:1: no gateway answers there/);
  const fake = await new FakeGateway().open();
  const refused = assert.rejects(connect(fake.address, { token: "wrong" }), /^Error: no token, or a wrong one$/);
  const { id, token } = await fake.hears("hello");
  assert.equal(token, "wrong");
  fake.says({ op: "error", error: "no token, or a wrong one", id });
  await refused;
  fake.close();
});

connected("what it knows of the run", async (zsim, fake) => {
  assert.equal(zsim.name, "client.me");
  assert.deepEqual(zsim.run, RUN);
  const news = [];
  zsim.on("run", ({ state }) => news.push([state, zsim.run.run_id]));
  fake.says({ op: "run", state: "ended", run_id: "r1" });
  fake.says({ op: "run", state: "begun", run_id: "r2" });
  await fake.answers("hello", { name: "client.me", ...RUN, run_id: "r2" });
  await zsim.untilRun();
  while (news.length < 2) await new Promise(setImmediate);
  assert.deepEqual(news, [["ended", null], ["begun", "r2"]]);
});

connected("values go to whom they are for, however they are cut", async (zsim, fake) => {
  const heard = [];
  const done = Promise.all([fake.answers("subscribe"), zsim.subscribe("drone/*/truth", (value, key) => heard.push([key, value]))]);
  const [, unsubscribe] = await done;
  const line = `${JSON.stringify({ op: "value", key: "drone/ä/truth", value: { n: "ä" } })}\n`;
  for (const byte of Buffer.from(line)) fake.socket.write(Buffer.from([byte]));
  fake.says({ op: "value", key: "clock", value: 1 });
  await Promise.all([fake.answers("latest", { values: [{ key: "clock", value: 7 }] }), zsim.latest("clock")]);
  assert.deepEqual(heard, [["drone/ä/truth", { n: "ä" }]]);
  await Promise.all([fake.answers("unsubscribe"), unsubscribe()]);
});

connected("whoever closes hears nothing more", async (zsim, fake) => {
  const heard = [];
  const taker = (value) => heard.push(value) && zsim.close();
  await Promise.all([fake.answers("subscribe"), zsim.subscribe("a", taker)]);
  const line = (value) => `${JSON.stringify({ op: "value", key: "a", value })}\n`;
  fake.socket.write(line(1) + line(2));
  assert.equal(await zsim.closed, "closed");
  await new Promise(setImmediate);
  assert.deepEqual(heard, [1]);
});

connected("refusals", async (zsim, fake) => {
  const [{ id }, told] = [await send(zsim, fake), new Promise((resolve) => zsim.on("refused", resolve))];
  fake.says({ op: "error", error: "velocity_m_s is short", id });
  assert.equal((await told).message, "velocity_m_s is short");
  const refused = assert.rejects(zsim.mode("drone1", "fly"), /mode is fly/);
  fake.says({ op: "error", error: "mode is fly", id: (await fake.hears("put")).id });
  await refused;
  const denied = assert.rejects(zsim.ask("world/control", "pause"), /world\/control pause: is paused/);
  await fake.answers("ask", { op: "answer", ok: false, error: "is paused" });
  await denied;
  assert.equal((await Promise.all([zsim.ask("a", "b"), fake.answers("ask", { op: "answer", ok: true, result: 5 })]))[0], 5);
});

async function send(zsim, fake) {
  zsim.velocity("drone1", [1, 0]);
  const put = await fake.hears("put");
  assert.deepEqual(put.value, { velocity_m_s: [1, 0], yaw_rate_rad_s: 0, frame: "heading" });
  assert.ok(put.quiet);
  return put;
}

connected("answers that do not come", async (zsim) => {
  await assert.rejects(zsim.request("latest", { key: "clock" }, 0.05), /latest: no answer within 0.05 s/);
});

async function seat(zsim, fake) {
  const [joined, join] = await Promise.all([zsim.join("square", { reads: ["clock"] }), fake.answers("join", { name: "client.square" })]);
  assert.deepEqual([join.name, join.period_s, join.reads], ["square", 0.02, ["clock"]]);
  return joined;
}

connected("a gate is done when the loop comes round, and leaving the loop leaves the seat", async (zsim, fake) => {
  const joined = await seat(zsim, fake);
  const inputs = [{ key: "clock", value: 1 }, { key: "clock", value: 2 }];
  fake.says({ op: "gate", t_ns: 0, inputs });
  const loop = (async () => {
    for await (const gate of joined) {
      assert.equal(gate.input("clock"), 2);
      assert.equal(gate.input("truth"), undefined);
      gate.mode("drone1", gate.t_ns === 0 ? "takeoff" : "land");
      if (gate.t_ns > 0) break;
    }
  })();
  const done = await fake.hears("done");
  assert.deepEqual([done.t_ns, done.outputs], [0, [{ key: "drone/drone1/cmd/mode", value: { mode: "takeoff" } }]]);
  fake.says({ op: "gate", t_ns: 20_000_000, inputs });
  assert.equal((await fake.hears("done")).outputs[0].value.mode, "land");
  await fake.answers("leave");
  await loop;
});

for (const [what, said] of [["a refused output", "error"], ["a lost seat", "left"], ["a lost connection", null]]) {
  connected(`${what} is thrown out of the loop`, async (zsim, fake) => {
    const joined = await seat(zsim, fake);
    fake.says({ op: "gate", t_ns: 0, inputs: [] });
    const loop = assert.rejects(async () => {
      for await (const gate of joined) gate.velocity("drone1", [NaN, 0, 0]);
    }, said === "error" ? /^Error: it is null$/ : /the seat is lost: /);
    const { id } = await fake.hears("done");
    if (said === "error") fake.says({ op: "error", error: "it is null", id });
    else if (said === "left") fake.says({ op: "left", reason: "the run ended" });
    else fake.socket.destroy();
    if (said === "error") await fake.answers("leave");
    await loop;
  });
}

connected("a connection that ends rejects what waits, and everything after", async (zsim, fake) => {
  const waiting = assert.rejects(zsim.latest("clock"), /the connection has ended: the gateway hung up/);
  await fake.hears("latest");
  fake.socket.destroy();
  await waiting;
  assert.equal(await zsim.closed, "the gateway hung up");
  await assert.rejects(zsim.latest("clock"), /connect again/);
});
