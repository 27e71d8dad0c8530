"""Reads the IMU of drone1, takes it over with velocity commands, and keeps the lockstep: zenoh and msgpack only."""

import os
import sys

import msgpack
import zenoh

ME, SECONDS = "plain.client", float(sys.argv[2]) if len(sys.argv) > 2 else 10.0
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"}"]')
config.insert_json5("scouting/multicast/enabled", "false")
seq = {}

with zenoh.open(config) as session:

    def put(key, **fields):
        seq[key] = seq.get(key, -1) + 1
        session.put(f"zsim/{key}", msgpack.packb({"seq": seq[key], **fields}))

    info = next(msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in session.get("zsim/world/info") if reply.ok)
    sensors = session.declare_subscriber("zsim/drone/drone1/sensor/*", zenoh.handlers.FifoChannel(10000))
    token = session.liveliness().declare_token(f"zsim/process/{ME}")
    run = {"run_id": info["run_id"], "incarnation": 1}
    put(f"process/{ME}/join", t_ns=0, **run, role="example", host="here", pid=os.getpid(), period_ns=info["gate_ns"])

    while True:
        sample = sensors.recv()
        message, kind = msgpack.unpackb(sample.payload.to_bytes()), str(sample.key_expr).rsplit("/", 1)[1]
        if kind == "imu":
            imu = message
        elif kind == "status":  # the last of a gate: everything of drone1 stamped up to t_ns is here
            t_ns = message["t_ns"]
            if message["state"] == "landed":
                put("drone/drone1/cmd/mode", t_ns=t_ns, source=ME, mode="takeoff")
            elif message["state"] in ("hovering", "flying"):
                put("drone/drone1/cmd/velocity", t_ns=t_ns, source=ME, velocity_m_s=[0.5, 0, 0], yaw_rate_rad_s=0.0)
            put(f"process/{ME}/done", t_ns=t_ns, **run, done_ns=t_ns, sent=int(message["state"] != "taking_off"))
            if t_ns >= SECONDS * 1e9:
                break
    print(f"t = {t_ns / 1e9:.2f} s, {message['state']}, flown by {message['commander']}, accel {imu['accel_m_s2']}")
    put(f"process/{ME}/bye", t_ns=t_ns, reason="shown")
