"""A custom sensor as a separate program in lockstep: noisy ranges between two drones, from their true positions.

    zsim run scenarios/step.yaml --set 'processes.expect=[range.drone1]' --duration 60
    python examples/range_sensor.py tcp/127.0.0.1:7447

Publishes `drone/drone1/range/drone2` five times per simulated second. The key is not part of the contract: only
`zsim echo` and the recorder read it, and its messages are not counted in `sent`, unlike commands, estimates and cluster
states.
"""

import math
import os
import random
import sys
import time
from queue import Empty, SimpleQueue
from typing import Any

import msgpack
import zenoh

ENDPOINT = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
ME, PAIR = "range.drone1", ("drone1", "drone2")
PERIOD_NS, SIGMA_M = 200_000_000, 0.1
START_S = 60.0  # wall time; the world may still be starting and compiling its kernel
SILENCE_S = 10.0  # wall time; even while simulated time stands still, the world publishes its clock once a second


def measure(truths: dict[str, dict[str, Any]], rng: random.Random) -> float:
    """Return the distance between the two drones, with white noise [m]."""
    here, there = (truths[drone]["position_m"] for drone in PAIR)
    return math.dist(here, there) + rng.gauss(0.0, SIGMA_M)


class RangeSensor:
    """Reads the truth of two drones, and reports each gate as done once its range, if due, has been published."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._seq: dict[str, int] = {}
        info = world_info(session)
        names = [drone["name"] for drone in info["drones"]]
        if missing := [drone for drone in PAIR if drone not in names]:  # whose truth would never come
            raise SystemExit(f"{ME}: {missing[0]} is not in the run; its drones are {', '.join(names)}")
        self._rng = random.Random(f"{info['seed']}/{ME}")  # a random stream of its own, reproducible from the seed
        self._run = {"run_id": info["run_id"], "incarnation": int.from_bytes(os.urandom(7), "big")}
        self._inbox: SimpleQueue[zenoh.Sample] = SimpleQueue()
        # By default each subscriber has its own thread, so messages of different keys may arrive out of order.
        in_order = zenoh.handlers.Callback(self._inbox.put, indirect=False)
        expressions = [*(f"zsim/drone/{drone}/truth" for drone in PAIR), "zsim/clock"]
        self._kept = [session.declare_subscriber(e, in_order) for e in expressions]
        self._token = session.liveliness().declare_token(f"zsim/process/{ME}")
        about = {"role": "range", "host": "here", "pid": os.getpid(), "period_ns": info["gate_ns"]}
        self._put(f"zsim/process/{ME}/join", t_ns=0, **self._run, **about)

    def _put(self, key: str, **fields: Any) -> None:
        self._seq[key] = self._seq.get(key, -1) + 1
        payload = msgpack.packb({"seq": self._seq[key], **fields})
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def run(self) -> int:
        """Publish ranges until the run ends; return their number.

        Raises:
            SystemExit: nothing came from the world for SILENCE_S.
        """
        truths: dict[str, dict[str, Any]] = {}
        while True:
            sample = self._next()
            key, m = str(sample.key_expr), msgpack.unpackb(sample.payload.to_bytes())
            if key.endswith("/truth"):
                truths[key.split("/")[2]] = m
                if len(truths) == len(PAIR):
                    self._answer(m["t_ns"], truths)
                    truths = {}
            elif m["state"] == "stopped":
                self._put(f"zsim/process/{ME}/bye", t_ns=m["t_ns"], **self._run, reason="the run ended")
                return self._count()

    def _next(self) -> zenoh.Sample:
        try:
            return self._inbox.get(timeout=SILENCE_S)
        except Empty:
            text = f"the world on {ENDPOINT} has been silent for {SILENCE_S:g} s; {self._count()} ranges came before"
            raise SystemExit(f"{ME}: {text}") from None

    def _count(self) -> int:
        return self._seq.get(self._key(), -1) + 1

    def _answer(self, t_ns: int, truths: dict[str, dict[str, Any]]) -> None:
        if t_ns % PERIOD_NS == 0:
            self._put(self._key(), t_ns=t_ns, t_sample_ns=t_ns, range_m=measure(truths, self._rng))
        self._put(f"zsim/process/{ME}/done", t_ns=t_ns, **self._run, done_ns=t_ns, sent=0)

    @staticmethod
    def _key() -> str:
        return f"zsim/drone/{PAIR[0]}/range/{PAIR[1]}"


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
        raise SystemExit("usage: python examples/range_sensor.py [ENDPOINT]     e.g. tcp/127.0.0.1:7447")
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{ENDPOINT}"]')
    config.insert_json5("connect/timeout_ms", f"{1000 * START_S:.0f}")
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        print(f"measured {RangeSensor(session).run()} ranges")


if __name__ == "__main__":
    main()
