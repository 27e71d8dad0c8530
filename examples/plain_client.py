"""Read drone1's IMU, fly the drone by velocity commands, and take part in the lockstep, with only zenoh and msgpack."""

import os
import queue
import sys

import msgpack
import zenoh

ENDPOINT, SECONDS = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447", 10.0
ME, DRONE = "plain.client", "zsim/drone/drone1"
_ = "/" in ENDPOINT or sys.exit("usage: python examples/plain_client.py [ENDPOINT]     e.g. tcp/127.0.0.1:7447")
config = f'{{mode: "client", connect: {{endpoints: ["{ENDPOINT}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
seq, last, inbox, gates, t_ns = {}, {}, queue.SimpleQueue(), 0, 0

with zenoh.open(zenoh.Config.from_json5(config)) as session:

    def put(key, **fields):  # BLOCK, as the world would wait for ever for a message dropped by zenoh
        seq[key] = seq.get(key, -1) + 1
        session.put(key, msgpack.packb({"seq": seq[key], **fields}), congestion_control=zenoh.CongestionControl.BLOCK)

    info = next(msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in session.get("zsim/world/info") if reply.ok)
    run = {"run_id": info["run_id"], "incarnation": int.from_bytes(os.urandom(7), "big")}
    in_order = zenoh.handlers.Callback(inbox.put, indirect=False)
    kept = [session.declare_subscriber(key, in_order) for key in (f"{DRONE}/sensor/*", "zsim/clock")]
    token = session.liveliness().declare_token(f"zsim/process/{ME}")
    put(f"zsim/process/{ME}/join", t_ns=0, **run, role="plain", host="here", pid=os.getpid(), period_ns=info["gate_ns"])
    while gates * info["gate_ns"] <= SECONDS * 1e9 and last.get("clock", {}).get("state") != "stopped":
        try:
            sample = inbox.get(timeout=10)  # s; the clock comes once a second even while time stands still
        except queue.Empty:
            sys.exit("the world is silent")
        last[kind := str(sample.key_expr).rsplit("/", 1)[1]] = msgpack.unpackb(sample.payload.to_bytes())
        if kind == "status":  # the gate is complete: answer it, then report it as done
            t_ns, gates, flying = last["status"]["t_ns"], gates + 1, last["status"]["state"] in ("hovering", "flying")
            command = {"velocity_m_s": [0.5, 0, 0], "yaw_rate_rad_s": 0} if flying else {"mode": "takeoff"}
            put(f"{DRONE}/cmd/{'velocity' if flying else 'mode'}", t_ns=t_ns, source=ME, **command)
            put(f"zsim/process/{ME}/done", t_ns=t_ns, **run, done_ns=t_ns, sent=1)
    print(f"t = {t_ns / 1e9:.2f} s, {last['status']['state']}, accelerometer {last['imu']['accel_m_s2']}")
    put(f"zsim/process/{ME}/bye", t_ns=t_ns, **run, reason="shown")
