"""mosaik: its scheduler steps the world, which runs in the same process, and then every agent, each in its own.

The world's output goes to the agents within a step, and their answers reach the world at its next step, as with all
contenders. mosaik cannot be told to stop at a wall time, so the number of steps is fixed beforehand.
"""
# pyright: reportMissingImports=false

import argparse
import json
import logging
import sys
import time
from typing import Any

import mosaik
import mosaik_api_v3

from benchmarks.exchange.lap import PAYLOAD

TEXT = "x" * len(PAYLOAD)
WARM_STEPS = 20
STEPS_S = 1200  # assumed steps/s of all simulators together, the world's included; sets the number of steps
META: mosaik_api_v3.types.Meta = {
    "api_version": "3.0",
    "type": "time-based",
    "models": {"Node": {"public": True, "params": [], "attrs": ["down", "up"]}},
    "extra_methods": [],
}


class Node(mosaik_api_v3.Simulator):
    """A simulator of entities that send the same text at every step."""

    def __init__(self) -> None:
        super().__init__(META)

    def create(self, num: int, model: str, **params: Any) -> list[Any]:
        return [{"eid": f"n{k}", "type": model} for k in range(num)]

    def step(self, time: int, inputs: Any, max_advance: int) -> int:
        return time + 1

    def get_data(self, outputs: Any) -> Any:
        return {eid: dict.fromkeys(attributes, TEXT) for eid, attributes in outputs.items()}


class Stopwatch(Node):
    """The world's simulator, which runs inside the scheduler's process and records when it is stepped."""

    began: list[float] = []  # noqa: RUF012 - mosaik makes the only instance and does not hand it out

    def step(self, time: int, inputs: Any, max_advance: int) -> int:
        self.began.append(clock())
        return time + 1


clock = time.perf_counter


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--agents", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0, help="approximate wall time counted")
    given = parser.parse_args()
    steps = WARM_STEPS + max(20, int(given.seconds * STEPS_S / (1 + given.agents)))
    run(given.agents, steps)
    counted = Stopwatch.began[WARM_STEPS:]
    rate = (len(counted) - 1) / (counted[-1] - counted[0])
    print(json.dumps({"steps_per_s": rate, "steps": len(counted) - 1}), flush=True)


def run(count: int, steps: int) -> None:
    module = "benchmarks.exchange.mosaik_simulators"
    config: Any = {
        "World": {"python": f"{module}:Stopwatch"},
        "Agent": {"cmd": f"{sys.executable} -m {module} %(addr)s"},
    }
    with mosaik.World(config, skip_greetings=True) as world:
        hub = world.start("World").Node()
        for _ in range(count):
            agent = world.start("Agent").Node()
            world.connect(hub, agent, ("down", "down"))
            world.connect(agent, hub, ("up", "up"), time_shifted=True, initial_data={"up": TEXT})
        world.run(until=steps, print_progress=False)


def serve() -> None:
    """Run an agent's simulator, as mosaik starts it."""
    logging.disable()
    mosaik_api_v3.start_simulation(Node())


if __name__ == "__main__":
    sys.modules["benchmarks.exchange.mosaik_simulators"] = sys.modules["__main__"]  # mosaik imports it by that name
    if sys.argv[1:2] and not sys.argv[1].startswith("-"):
        serve()
    else:
        main()
