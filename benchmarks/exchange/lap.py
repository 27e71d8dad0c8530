"""The parts shared by the contenders of the exchange: clock of a run, agent processes, options, result."""

import argparse
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

PAYLOAD = bytes(100)  # payload each way per agent and step, about the size of a drone's status
WARM_S = 0.3  # wall time of the first steps, which are not counted: caches fill, threads start
PATIENCE_S = 60.0  # wall time within which an agent must leave when told to


class Lap:
    """Counts steps for a number of wall seconds after a warm-up.

    Attributes:
        steps: number of steps counted so far.
    """

    def __init__(self, seconds: float, warm_s: float = WARM_S) -> None:
        self._seconds = seconds
        self._warm_s = warm_s
        self._begin_s: float | None = None
        self._start_s: float | None = None
        self._last_s = 0.0
        self.steps = 0

    def more(self) -> bool:
        """Note that a step begins (at the first call: that everything is set up); return whether to make the step."""
        self._last_s = now_s = time.perf_counter()
        if self._begin_s is None:
            self._begin_s = now_s
        elif self._start_s is None:
            if now_s - self._begin_s > self._warm_s:
                self._start_s = now_s
        else:
            self.steps += 1
        return self._start_s is None or now_s - self._start_s < self._seconds

    @property
    def steps_per_s(self) -> float:
        assert self._start_s is not None, "no step was counted"
        return self.steps / (self._last_s - self._start_s)

    def report(self) -> None:
        """Print the result in the form that the benchmarks read."""
        print(json.dumps({"steps_per_s": self.steps_per_s, "steps": self.steps}), flush=True)


def parser(text: str | None) -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=(text or "").splitlines()[0])
    made.add_argument("--agents", type=int, default=1, help="number of agent processes")
    made.add_argument("--seconds", type=float, default=1.0, help="wall time over which steps are counted")
    made.add_argument("--lookahead", action="store_true", help="begin a step while answers to the previous are due")
    made.add_argument("--agent", type=int, help="act as this agent (passed to child processes)")
    made.add_argument("--at", help="address of the world (passed to child processes)")
    return made


@contextmanager
def agents(module: str, count: int, *options: str) -> Iterator[Sequence[subprocess.Popen[bytes]]]:
    """Run `count` agents of a contender, and wait until all have left; after an error, kill them."""
    command = [sys.executable, "-m", module, "--agents", str(count), *options]
    started = [subprocess.Popen([*command, "--agent", str(number)]) for number in range(count)]
    try:
        yield started
        for process in started:
            process.wait(PATIENCE_S)
    finally:
        for process in started:
            process.kill()
            process.wait()


def free_port() -> int:
    """Return a TCP port on loopback that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
