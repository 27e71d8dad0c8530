"""A driver that needs only zenoh and msgpack, for an external drone that follows velocity commands with a lag.

Where this program computes the motion, a real driver would talk to an aircraft. Give the drone `body: external` in a
scenario:

    zsim run SCENARIO --realtime          then          python examples/external_drone.py drone3 X Y Z
"""

import math
import os
import sys
from queue import Empty, SimpleQueue
from typing import Any

import msgpack
import zenoh

WORDS = sys.argv[1:]
ENDPOINT = WORDS.pop(0) if WORDS and "/" in WORDS[0] else "tcp/127.0.0.1:7447"
_ = len(WORDS) in (1, 4) or sys.exit("usage: python examples/external_drone.py [ENDPOINT] DRONE [X Y Z]")
DRONE, PLACE = WORDS[0], [float(x) for x in WORDS[1:]] or [0.0, 0.0, 0.05]
ME, G_M_S2, LAG_S, TAKEOFF_M, CLIMB_M_S = f"driver.{DRONE}", 9.80665, 0.3, 1.0, 0.7
HOVER_S, LAND_S = 0.5, 2.0  # time without a command before the drone hovers; further time before it lands
SILENCE_S = 10.0  # wall time; even while simulated time stands still, the world publishes its clock once a second


class Aircraft:
    """Position, velocity and state of a body that is always level."""

    def __init__(self, p, yaw, state="landed"):
        self.p, self.v, self.a, self.yaw, self.yaw_rate, self.state = [*p], [0.0] * 3, [0.0] * 3, yaw, 0.0, state
        self.wanted, self.commander, self.set_s = (0.0, 0.0, 0.0, 0.0), None, math.inf  # wanted: v in W, yaw rate

    def obey(self, kind, m, t_s):
        if kind == "mode":
            target = {"takeoff": "taking_off", "land": "landing", "emergency": "emergency", "reset": "landed"}
            self.state, self.wanted = target[m["mode"]], (0.0, 0.0, 0.0, 0.0)
        elif m["source"] == "world":  # the world has withdrawn the last command
            self.state, self.wanted, self.commander, self.set_s = "hovering", (0.0, 0.0, 0.0, 0.0), None, math.inf
        elif kind == "velocity":
            (x, y, z), yaw = m["velocity_m_s"], 0.0 if m.get("frame") == "world" else self.yaw
            c, s = math.cos(yaw), math.sin(yaw)
            self.wanted, self.state = (c * x - s * y, s * x + c * y, z, m["yaw_rate_rad_s"]), "flying"
            self.commander, self.set_s = m["source"], t_s

    def step(self, t_s, dt):
        if self.state == "flying" and t_s - self.set_s > HOVER_S:
            self.state, self.wanted = "hovering", (0.0, 0.0, 0.0, 0.0)
        if self.state == "hovering" and t_s - self.set_s > HOVER_S + LAND_S:
            self.state = "landing"
        climb = {"taking_off": CLIMB_M_S, "landing": -CLIMB_M_S, "emergency": -2.0}.get(self.state)
        x, y, z, self.yaw_rate = self.wanted
        wanted = [x, y, z] if climb is None else [0.0, 0.0, climb]
        if self.state == "landed":
            wanted, self.v = [0.0] * 3, [0.0] * 3
        share = 1 - math.exp(-dt / LAG_S)
        before, self.v = self.v, [v + share * (w - v) for v, w in zip(self.v, wanted, strict=True)]
        self.a = [(v - b) / dt for v, b in zip(self.v, before, strict=True)]
        self.p = [p + dt * (v + b) / 2 for p, v, b in zip(self.p, self.v, before, strict=True)]
        self.yaw += dt * self.yaw_rate
        if self.state == "taking_off" and self.p[2] >= TAKEOFF_M:
            self.state, self.set_s = "hovering", math.inf
        elif self.state in ("landing", "emergency") and self.p[2] <= 0.05:
            self.state, self.p[2], self.v, self.a = "landed", 0.05, [0.0] * 3, [0.0] * 3


config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{ENDPOINT}"]')
config.insert_json5("connect/timeout_ms", "60000")
config.insert_json5("scouting/multicast/enabled", "false")
seq: dict[str, int] = {}

with zenoh.open(config) as session:

    def put(key: str, **fields: Any) -> None:
        seq[key] = seq.get(key, -1) + 1
        session.put(f"zsim/{key}", msgpack.packb({"seq": seq[key], **fields}))

    def get(key: str) -> dict[str, Any] | None:
        good = [reply.ok for reply in session.get(f"zsim/{key}") if reply.ok]
        return msgpack.unpackb(good[0].payload.to_bytes()) if good else None

    link = {"source": ME, "peer": "its own model", "age_ms": 0.0, "loss_percent": 0.0, "round_trip_ms": None}
    armed = []  # holds True while an operator has armed the drone, else empty

    def answer(query: zenoh.Query) -> None:
        op = msgpack.unpackb(query.payload.to_bytes())["op"] if query.payload else ""
        armed[:] = {"arm": [True], "disarm": [], "kill": []}.get(op, armed)
        if op == "kill":
            aircraft.obey("mode", {"mode": "emergency"}, 0.0)
        known = op in ("arm", "disarm", "kill")
        refusal = "" if known else f"op is {op!r}; must be arm, disarm or kill"
        query.reply(f"zsim/drone/{DRONE}/driver", msgpack.packb({"ok": known, "error": refusal}))

    def next_clock() -> dict[str, Any]:
        try:
            return msgpack.unpackb(clocks.get(timeout=SILENCE_S).payload.to_bytes())
        except Empty:
            sys.exit(f"{ME}: the world on {ENDPOINT} has been silent for {SILENCE_S:g} s")

    clocks: SimpleQueue[zenoh.Sample] = SimpleQueue()
    kept = session.declare_subscriber("zsim/clock", zenoh.handlers.Callback(clocks.put, indirect=False))
    accepted = session.declare_subscriber(f"zsim/drone/{DRONE}/accepted/*", zenoh.handlers.FifoChannel(10_000))
    while (info := get("world/info")) is None:
        next_clock()  # retry at the next clock message, which comes once a second while the world waits
    place = next(drone for drone in info["drones"] if drone["name"] == DRONE)
    truth, status = get(f"drone/{DRONE}/truth"), get(f"drone/{DRONE}/sensor/status")  # left by an earlier driver
    own = truth or {"position_m": PLACE, "orientation_wxyz": [1, 0, 0, 0]}
    w, _, _, z = own["orientation_wxyz"]
    aircraft = Aircraft(own["position_m"], 2 * math.atan2(z, w), status["state"] if status else "landed")
    queryable = session.declare_queryable(f"zsim/drone/{DRONE}/driver", answer)
    token = session.liveliness().declare_token(f"zsim/process/{ME}")
    run = {"run_id": info["run_id"], "incarnation": int.from_bytes(os.urandom(7), "big")}
    put(f"process/{ME}/join", t_ns=0, **run, role="driver", host="here", pid=os.getpid(), period_ns=0)
    last_ns, link_ns, east_m = -1, -1, 111_319.49 * math.cos(math.radians(info["origin"]["latitude_deg"]))
    while (clock := next_clock())["state"] != "stopped":
        t_ns = clock["t_ns"]
        while (sample := accepted.try_recv()) is not None:
            kind, command = str(sample.key_expr).rsplit("/", 1)[1], msgpack.unpackb(sample.payload.to_bytes())
            is_stop = command.get("mode") == "emergency"
            if armed or is_stop:
                aircraft.obey(kind, command, t_ns / 1e9)
            if is_stop:
                armed.clear()
        if t_ns <= last_ns:
            continue  # simulated time stands still
        if last_ns >= 0:
            aircraft.step(t_ns / 1e9, (t_ns - last_ns) / 1e9)
        a, p, v, yaw, last_ns = aircraft.a, aircraft.p, aircraft.v, aircraft.yaw, t_ns
        c, s = math.cos(yaw), math.sin(yaw)
        body, count = lambda x, c=c, s=s: [c * x[0] + s * x[1], c * x[1] - s * x[0], x[2]], 7
        at, key = {"t_ns": t_ns, "t_sample_ns": t_ns}, f"drone/{DRONE}"
        put(
            f"{key}/sensor/imu",
            **at,
            accel_m_s2=body([a[0], a[1], a[2] + G_M_S2]),
            gyro_rad_s=[0, 0, aircraft.yaw_rate],
        )
        origin, place_deg = info["origin"], {"altitude_m": info["origin"]["height_m"] + p[2]}
        place_deg |= {"latitude_deg": origin["latitude_deg"] + p[1] / 111_319.49}
        place_deg |= {"longitude_deg": origin["longitude_deg"] + p[0] / east_m}
        put(f"{key}/sensor/gps", **at, **place_deg, position_m=p, velocity_m_s=v, sigma_m=0.1, fix=3, satellites=9)
        put(f"{key}/sensor/mag", **at, field_ut=body([-2.8, 17.8, 14.0]))  # field of the default environment, in W
        put(f"{key}/sensor/baro", **at, pressure_pa=101_325.0 - 12.0 * p[2], altitude_m=p[2])
        put(f"{key}/sensor/sonar", **at, range_m=p[2], valid=p[2] < 4.0)
        put(f"{key}/sensor/flow", **at, velocity_m_s=body(v), quality=1.0)
        q, rotors = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], 360.0 * (aircraft.state != "landed")
        rates = {"angular_velocity_rad_s": [0, 0, aircraft.yaw_rate], "rotor_rad_s": [rotors] * len(place["rotors"])}
        put(f"{key}/truth", t_ns=t_ns, position_m=p, velocity_m_s=v, orientation_wxyz=q, accel_m_s2=a, **rates)
        about = {"state": aircraft.state, "battery_percent": 90.0, "collision": False, "commander": aircraft.commander}
        put(f"{key}/sensor/status", t_ns=t_ns, **about, count=count)
        if t_ns - link_ns >= 1e9 or link_ns < 0:
            link_ns, state = t_ns, "armed" if armed else "connected"
            put(f"{key}/link", t_ns=t_ns, **link, state=state, clock_offset_ms=None, refused=0)
    put(f"process/{ME}/bye", t_ns=last_ns, **run, reason="the run ended")
