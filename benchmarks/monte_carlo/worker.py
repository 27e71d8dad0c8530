"""Shared by all programs that fly the paths of Test 1: a process with its own core that serves flights.

The process answers each line {"seed": n} of stdin on stdout until stdin ends; the first answer includes compilation.
"""

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.kernel.stopwatch import answer
from benchmarks.monte_carlo.way import Way, read


class Flown(NamedTuple):
    """Results of one or more flights."""

    flights: float  # number of flights of three drones; a part of a flight counts as a fraction
    rms_m: float  # root mean square distance from the paths, over all flights
    closest_m: float  # least distance between two drones in any flight


Fly = Callable[[int], Flown]  # flies with a seed


def serve(build: Callable[[Way, argparse.Namespace], Fly], **options: Any) -> None:
    """Answer each {"seed": n} with a `Flown` and its CPU time; `options` maps command-line options to defaults."""
    parser = argparse.ArgumentParser()
    parser.add_argument("way", type=Path)
    parser.add_argument("worker", type=int, help="0 or 1: number of this process and its core")
    for name, default in options.items():
        if isinstance(default, bool):
            parser.add_argument(f"--{name}", action="store_true")
        else:
            parser.add_argument(f"--{name}", type=type(default), default=default)
    given = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[given.worker % len(cores)]})
    fly: Fly | None = None

    def find(asked: dict[str, Any]) -> dict[str, Any]:
        nonlocal fly
        fly = fly or build(read(given.way), given)
        start_s = time.process_time()  # user and system time of all threads
        flown = fly(asked["seed"])
        cpu_s = time.process_time() - start_s
        return {**flown._asdict(), "cpu_s": cpu_s} if math.isfinite(flown.rms_m) else {"refused": "its state diverged"}

    answer(find)
