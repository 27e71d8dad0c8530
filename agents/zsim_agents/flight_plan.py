"""The flight plan of a scenario: requests with the time from which they are due."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from zsim_agents.cluster_space import ClusterSpace
from zsim_agents.flight_request import REFUSALS, FlightRequest, Follow, Land, Target

RETRY_S = 0.5  # between two tries of a request that was refused


@dataclass(frozen=True)
class Scheduled:
    """A request that is due at at_s of simulated time and repeated until it is granted."""

    at_s: float
    request: FlightRequest


class FlightPlan:
    """Requests in their order; each waits for those before it, except Land, which drops them.

    Attributes:
        note: why the plan waits, empty where it does not.

    Raises:
        ValueError: a request can never be granted (unknown name, bad expression), or times run backwards.
    """

    def __init__(self, space: ClusterSpace, steps: Sequence[Scheduled] = ()) -> None:
        _check(space, steps)
        self._steps = deque(steps)
        self._try_s = -math.inf
        self.note = ""

    def run(self, t_s: float, request: Callable[[FlightRequest], str | None]) -> None:
        """Make the requests that are due at t_s."""
        self._drop_before_land(t_s)
        while self._steps and t_s >= max(self._steps[0].at_s, self._try_s):
            refusal = request(self._steps[0].request)
            if refusal:
                self._try_s = t_s + RETRY_S
                self.note = f"{type(self._steps[0].request).__name__} of the plan waits: {refusal}"
                return
            self._steps.popleft()
            self._try_s, self.note = -math.inf, ""

    def skip(self, kinds: tuple[type, ...]) -> None:
        """Drop the leading requests of these kinds: they were granted before a restart."""
        while self._steps and isinstance(self._steps[0].request, kinds):
            self._steps.popleft()

    def clear(self) -> None:
        """Drop everything that is not done."""
        self._steps.clear()
        self.note = ""

    def _drop_before_land(self, t_s: float) -> None:
        lands = [i for i, step in enumerate(self._steps) if step.at_s <= t_s and isinstance(step.request, Land)]
        for _ in range(lands[-1] if lands else 0):
            self._steps.popleft()
            self._try_s, self.note = -math.inf, ""


def _check(space: ClusterSpace, steps: Sequence[Scheduled]) -> None:
    base = np.zeros(space.size)
    earlier_s = 0.0
    for number, step in enumerate(steps, start=1):
        if not earlier_s <= step.at_s < math.inf:
            raise ValueError(f"plan step {number}: at_s is {step.at_s:g}; allowed: {earlier_s:g} s or later")
        earlier_s = step.at_s
        try:
            if isinstance(step.request, Target):
                step.request.goal(space, base)
            elif isinstance(step.request, Follow):
                step.request.trajectory(space, base).value(0.0)
        except REFUSALS as error:
            raise ValueError(f"plan step {number}: {error}") from None
