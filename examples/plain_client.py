"""Reads drone1's IMU, flies it by velocity commands, and keeps the lockstep: with zenoh and msgpack alone."""

import os
import sys

import msgpack
import zenoh

ENDPOINT, SECONDS = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447", 10.0
ME, DRONE = "plain.client", "zsim/drone/drone1"
_ = "/" in ENDPOINT or sys.exit("usage: python examples/plain_client.py [ENDPOINT]     e.g. tcp/127.0.0.1:7447")
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{ENDPOINT}"]')
config.insert_json5("scouting/multicast/enabled", "false")
seq, last, t_ns = {}, {}, 0

with zenoh.open(config) as session:

    def put(key, **fields):  # BLOCK: for a message that zenoh drops the world would wait
        seq[key] = seq.get(key, -1) + 1
        session.put(key, msgpack.packb({"seq": seq[key], **fields}), congestion_control=zenoh.CongestionControl.BLOCK)

    info = next(msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in session.get("zsim/world/info") if reply.ok)
    run = {"run_id": info["run_id"], "incarnation": int.from_bytes(os.urandom(7), "big")}
    sensors = session.declare_subscriber(f"{DRONE}/sensor/*", zenoh.handlers.FifoChannel(10_000))
    token = session.liveliness().declare_token(f"zsim/process/{ME}")
    put(f"zsim/process/{ME}/join", t_ns=0, **run, role="plain", host="here", pid=os.getpid(), period_ns=info["gate_ns"])
    while t_ns < SECONDS * 1e9:
        sample = sensors.recv()
        last[str(sample.key_expr).rsplit("/", 1)[1]] = msgpack.unpackb(sample.payload.to_bytes())
        if str(sample.key_expr).endswith("/status"):  # the gate is complete: answer it, then say done
            t_ns, flying = last["status"]["t_ns"], last["status"]["state"] in ("hovering", "flying")
            if flying:
                put(f"{DRONE}/cmd/velocity", t_ns=t_ns, source=ME, velocity_m_s=[0.5, 0, 0], yaw_rate_rad_s=0)
            else:
                put(f"{DRONE}/cmd/mode", t_ns=t_ns, source=ME, mode="takeoff")
            put(f"zsim/process/{ME}/done", t_ns=t_ns, **run, done_ns=t_ns, sent=1)
    print(f"t = {t_ns / 1e9:.2f} s, {last['status']['state']}, accelerometer {last['imu']['accel_m_s2']}")
    put(f"zsim/process/{ME}/bye", t_ns=t_ns, reason="shown")
