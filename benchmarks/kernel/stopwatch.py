"""Shared by the contenders of parts b and f: timing a step in CPU time of all threads, and serving measurements."""

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

WARM_CALLS = 3


class Flight(NamedTuple):
    """Drones ready to be stepped."""

    advance: Callable[[], object]  # simulates the next `span_s`; called repeatedly
    span_s: float  # simulated time per call


def answer(find: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Answer each line of JSON on stdin with one on stdout until stdin ends; an exception is answered as a refusal."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a peer prints must not pass for an answer
    for line in sys.stdin:
        try:
            found = find(json.loads(line))
        except Exception as error:
            found = {"refused": f"{type(error).__name__}: {error}"[:200]}
        answers.write(json.dumps(found) + "\n")
        answers.flush()


def serve(build: Callable[[int], Flight]) -> None:
    """Answer each {"drones": N, "cpu_s": S} with {"drone_s_per_cpu_s": …}."""
    flights: dict[int, Flight] = {}

    def find(asked: dict[str, Any]) -> dict[str, Any]:
        count = asked["drones"]
        if count not in flights:
            flights[count] = build(count)
        return {"drone_s_per_cpu_s": count * rate(flights[count], asked["cpu_s"])}

    answer(find)


def rate(flight: Flight, cpu_s: float) -> float:
    """Return the simulated seconds per CPU second, measured over at least `cpu_s`."""
    for _ in range(WARM_CALLS):
        flight.advance()
    start, calls = time.process_time(), 0  # user and system time of all threads
    while (spent := time.process_time() - start) < cpu_s:
        for _ in range(10 if calls > 100 else 1):
            flight.advance()
            calls += 1
    return calls * flight.span_s / spent


def single() -> None:
    """Pin this process to one core: libraries then start one thread, or their threads share the core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
