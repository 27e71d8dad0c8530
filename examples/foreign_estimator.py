"""A lockstep estimator for drone1 that needs only zenoh and msgpack, not zsim.

    zsim world scenarios/step.yaml --set 'processes.expect=[foreign.drone1]' --duration 60
    python examples/foreign_estimator.py tcp/127.0.0.1:7447

Fixed gains combine GPS, barometer and flow, except that the first GPS fixes are averaged; the heading comes from the
magnetometer as if the drone were level.
"""

import math
import os
import sys
import time
from queue import Empty, SimpleQueue
from typing import Any

import msgpack
import zenoh

ENDPOINT = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
ME, DRONE = "foreign.drone1", "zsim/drone/drone1"
BEARING = math.atan2(17.8, -2.8)  # rad; direction of the default environment.magnetic_field_ut, from east towards north
START_S = 60.0  # wall time; the world may still be starting and compiling its kernel
SILENCE_S = 10.0  # wall time; even while simulated time stands still, the world publishes its clock once a second
FIX_GAIN, HEIGHT_GAIN = 0.02, 0.1
SIGMAS = (0.2, 0.2, 0.05, 0.1, 0.1, 0.1)  # m, m/s; residual noise of preset `paper` with these gains
YAW_SIGMA_RAD = 0.06


class State:
    """Estimated state of the drone."""

    def __init__(self) -> None:
        self.p, self.v, self.yaw, self.fixes = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0, 0

    def take(self, kind: str, m: dict[str, Any]) -> None:
        if kind == "gps":
            self.fixes += 1
            gain = max(FIX_GAIN, 1 / self.fixes)
            self.p[:2] = [p + gain * (z - p) for p, z in zip(self.p[:2], m["position_m"][:2], strict=True)]
        elif kind == "baro":
            self.p[2] += HEIGHT_GAIN * (m["altitude_m"] - self.p[2])
        elif kind == "mag":
            self.yaw = BEARING - math.atan2(m["field_ut"][1], m["field_ut"][0])
        elif kind == "flow":
            (x, y, z), c, s = m["velocity_m_s"], math.cos(self.yaw), math.sin(self.yaw)
            self.v = [c * x - s * y, s * x + c * y, z]

    def estimate(self, dt: float) -> dict[str, Any]:
        """Advance by dt [s] and return the fields of `Estimate`."""
        self.p = [p + v * dt for p, v in zip(self.p, self.v, strict=True)]
        yaw = math.remainder(self.yaw, math.tau)
        return {
            "position_m": self.p,
            "velocity_m_s": self.v,
            "orientation_wxyz": [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)],
            "yaw_rad": yaw,
            "covariance": [SIGMAS[i] ** 2 if i == j else 0.0 for i in range(6) for j in range(6)],
            "yaw_sigma_rad": YAW_SIGMA_RAD,
            "gyro_bias_rad_s": [0.0, 0.0, 0.0],
            "sensors": {"gps": [self.fixes, 0]},
            "source": ME,
        }


class Participant:
    """Joins the run, answers every gate, and leaves when the clock stops or the world falls silent."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._seq: dict[str, int] = {}
        info = world_info(session)
        self._gate_ns = info["gate_ns"]
        self._run = {"run_id": info["run_id"], "incarnation": int.from_bytes(os.urandom(7), "big")}
        self._inbox: SimpleQueue[zenoh.Sample] = SimpleQueue()
        # By default each subscriber has its own thread, so messages of different keys may arrive out of order.
        in_order = zenoh.handlers.Callback(self._inbox.put, indirect=False)
        self._kept = [
            session.declare_subscriber(f"{DRONE}/sensor/*", in_order),
            session.declare_subscriber("zsim/clock", in_order),
            session.liveliness().declare_token(f"zsim/process/{ME}"),
        ]
        about = {"role": "foreign", "host": "here", "pid": os.getpid(), "period_ns": self._gate_ns}
        self._put(f"zsim/process/{ME}/join", t_ns=0, **self._run, **about)

    def _put(self, key: str, **fields: Any) -> None:
        self._seq[key] = self._seq.get(key, -1) + 1
        payload = msgpack.packb({"seq": self._seq[key], **fields})
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def run(self) -> int:
        """Answer gates until the run ends; return their number.

        Raises:
            SystemExit: nothing came from the world for SILENCE_S.
        """
        state, gates = State(), 0
        while True:
            sample = self._next(gates)
            kind, m = str(sample.key_expr).rsplit("/", 1)[1], msgpack.unpackb(sample.payload.to_bytes())
            state.take(kind, m)
            if kind == "status":  # the last sensor message of a gate, so all others have arrived
                gates += 1
                self._answer(m["t_ns"], state)
            elif m.get("state") == "stopped":
                self._put(f"zsim/process/{ME}/bye", t_ns=m["t_ns"], **self._run, reason="the run ended")
                return gates

    def _next(self, gates: int) -> zenoh.Sample:
        try:
            return self._inbox.get(timeout=SILENCE_S)
        except Empty:
            text = f"the world on {ENDPOINT} has been silent for {SILENCE_S:g} s; {gates} gates were answered before"
            raise SystemExit(f"{ME}: {text}") from None

    def _answer(self, t_ns: int, state: State) -> None:
        self._put(f"{DRONE}/estimate", t_ns=t_ns, **state.estimate(self._gate_ns / 1e9))
        self._put(f"zsim/process/{ME}/done", t_ns=t_ns, **self._run, done_ns=t_ns, sent=1)


def world_info(session: zenoh.Session) -> dict[str, Any]:
    """Return `world/info`; retry while the world listens but does not answer yet; raise SystemExit after START_S."""
    until_s = time.monotonic() + START_S
    while time.monotonic() < until_s:
        for reply in session.get("zsim/world/info", timeout=1.0):
            if reply.ok is not None:
                return msgpack.unpackb(reply.ok.payload.to_bytes())
        time.sleep(0.1)
    raise SystemExit(f"{ME}: no world answers on {ENDPOINT} within {START_S:g} s")


def main() -> None:
    if "/" not in ENDPOINT:
        raise SystemExit("usage: python examples/foreign_estimator.py [ENDPOINT]     e.g. tcp/127.0.0.1:7447")
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{ENDPOINT}"]')
    config.insert_json5("connect/timeout_ms", f"{1000 * START_S:.0f}")
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        print(f"answered {Participant(session).run()} gates")


if __name__ == "__main__":
    main()
