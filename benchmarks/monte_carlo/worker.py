"""What all peers that fly Test 1's ways share: a process on a core of its own that is asked for flights.

It is asked by lines {"seed": n} on stdin and answers on stdout, until its end; what compiles does so at the first.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.monte_carlo.way import Way, read


class Flown(NamedTuple):
    """What came of flights.

    Attributes:
        flights: whole flights of three drones, or fractions.
        rms_m: root of the mean square distance from the ways, over all flights.
        closest_m: least distance of two drones in any of them.
    """

    flights: float
    rms_m: float
    closest_m: float


Fly = Callable[[int], Flown]  # from a seed


def serve(build: Callable[[Way, argparse.Namespace], Fly], **options: Any) -> None:
    """Answer until stdin ends; `options` are options of the command with their defaults."""
    given = _arguments(options)
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[given.worker % len(cores)]})
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what peers print is no answer
    fly: Fly | None = None
    for line in sys.stdin:
        try:
            fly = fly or build(read(given.way), given)
            found = _flown(fly, json.loads(line)["seed"])
        except Exception as error:
            found = {"refused": f"{type(error).__name__}: {error}"[:200]}
        answers.write(json.dumps(found) + "\n")
        answers.flush()


def _flown(fly: Fly, seed: int) -> dict[str, Any]:
    start_s = time.process_time()  # user and system time of all threads
    flown = fly(seed)
    cpu_s = time.process_time() - start_s
    if not math.isfinite(flown.rms_m):
        return {"refused": "its state diverged"}
    return {**flown._asdict(), "cpu_s": cpu_s}


def _arguments(options: dict[str, Any]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("way", type=Path)
    parser.add_argument("worker", type=int, help="0 or 1: of which core")
    for name, default in options.items():
        if isinstance(default, bool):
            parser.add_argument(f"--{name}", action="store_true")
        else:
            parser.add_argument(f"--{name}", type=type(default), default=default)
    return parser.parse_args()
