"""An agent of one's own: lands every drone that leaves a circle around the origin, by its estimate.

python examples/geofence.py 4.0 --in-process scenarios/step.yaml --duration 60   everything in this process
python examples/geofence.py 4.0 --connect tcp/127.0.0.1:7447                     beside a running federation
"""

import argparse
import math
import os
import time
from pathlib import Path
from typing import Any

from msgspec import Struct

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.transport.connection import find_world
from zsim_analysis.in_process import agents
from zsim_world.run.world import World


class Geofence(Agent):
    """Reads states and estimates of all drones; a drone in the air that is outside is sent `land`."""

    def __init__(self, info: messages.Info, radius_m: float) -> None:
        super().__init__()
        names = [drone.name for drone in info.drones]
        self.name = "fence.main"
        self.period_ns = info.gate_ns
        self.reads = (keys.status("*"), keys.estimate("*"))
        self.gate_keys = (*map(keys.status, names), *map(keys.estimate, names))
        self._radius_m = radius_m
        self._flying: set[str] = set()
        self._outside: set[str] = set()

    def receive(self, key: str, message: Any) -> None:
        if isinstance(message, flight_messages.Status):
            _put_in(self._flying, keys.thing(key), message.state in ("hovering", "flying"))
        else:
            _put_in(self._outside, keys.thing(key), math.hypot(*message.position_m[:2]) > self._radius_m)

    def step(self, t_ns: int) -> list[Output]:
        return [self._land(t_ns, drone) for drone in sorted(self._flying & self._outside)]

    def _land(self, t_ns: int, drone: str) -> Output:
        key = keys.command(drone, "mode")
        return Output(key, flight_messages.Mode(t_ns, self.next_seq(key), self.name, "land"))


def _put_in(group: set[str], name: str, belongs: bool) -> None:
    if belongs:
        group.add(name)
    else:
        group.discard(name)


def say(key: str, message: Struct) -> None:
    if isinstance(message, run_messages.Event) and message.kind in ("mode", "refused"):
        print(f"{message.t_ns / 1e9:8.2f} s  {message.text}", flush=True)


def in_process(path: Path, radius_m: float, duration_s: float) -> None:
    world = World(scenario_file.load(path, duration_s=duration_s))
    bus = Bus(world, [*agents(world), Geofence(world.info(), radius_m)], time.monotonic_ns, say)
    bus.join()
    while bus.turn():
        pass
    bus.end()


def on_zenoh(endpoint: str, radius_m: float) -> None:
    with find_world(endpoint, "zsim", wait_s=60.0, say=print) as (link, info):
        link.declare_subscriber(keys.EVENT, lambda sample: say(sample.key, messages.decode(sample.key, sample.payload)))
        print(Runner(link, info, Geofence(info, radius_m), say=print).run())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("radius_m", type=float)
    parser.add_argument("--in-process", type=Path, metavar="SCENARIO")
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--connect", default=os.environ.get("ZSIM_CONNECT", "tcp/127.0.0.1:7447"))
    args = parser.parse_args()
    if args.in_process:
        in_process(args.in_process, args.radius_m, args.duration)
    else:
        on_zenoh(args.connect, args.radius_m)


if __name__ == "__main__":
    main()
