"""The flight plan of a scenario: requests with the time from which they are due."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from zsim_agents.formation.flight_request import REFUSALS, FlightRequest, Follow, Land, Target
from zsim_agents.formation.spaces.cluster_space import ClusterSpace

RETRY_S = 0.5  # between two tries of a request that was refused


@dataclass(frozen=True)
class Scheduled:
    """A request that is due at at_s of simulated time and repeated until it is granted."""

    at_s: float
    request: FlightRequest


class FlightPlan:
    """Requests in their order; each waits for those before it, except Land, which drops them.

    A restarted controller begins it where `resume_at` of the former one says.

    Attributes:
        note: why the plan waits, empty where it does not.

    Raises:
        ValueError: a request can never be granted (unknown name, bad expression), or times run backwards.
    """

    def __init__(self, space: ClusterSpace, steps: Sequence[Scheduled] = ()) -> None:
        _check(space, steps)
        self._steps = tuple(steps)
        self._next = 0  # first step that is not done
        self._flown = 0  # first step of those that make the reference flown now, _next where none does
        self._try_s = -math.inf
        self.note = ""

    def run(self, t_s: float, request: Callable[[FlightRequest], str | None]) -> None:
        """Make the requests that are due at t_s."""
        self._drop_before_land(t_s)
        while self._next < len(self._steps) and t_s >= max(self._steps[self._next].at_s, self._try_s):
            step = self._steps[self._next].request
            refusal = request(step)
            if refusal:
                self._try_s = t_s + RETRY_S
                self.note = f"{type(step).__name__} of the plan waits: {refusal}"
                return
            flown = self._flown if isinstance(step, Target | Follow) else self._next + 1
            self._go_to(self._next + 1, flown)

    def resume_at(self, engaged: bool) -> int:
        """Return how many steps a restart leaves out: all that are done, but in flight those flown now."""
        return self._flown if engaged else self._next

    def start_at(self, step: int) -> None:
        """Leave out so many steps: they were done before a restart."""
        self._go_to(min(step, len(self._steps)))

    def overrule(self) -> None:
        """Note that the reference flown from now on is not the plan's."""
        self._flown = self._next

    def clear(self) -> None:
        """Drop everything that is not done."""
        self._go_to(len(self._steps))

    def _drop_before_land(self, t_s: float) -> None:
        for place in range(len(self._steps) - 1, self._next, -1):
            step = self._steps[place]
            if step.at_s <= t_s and isinstance(step.request, Land):
                self._go_to(place)
                return

    def _go_to(self, step: int, flown: int | None = None) -> None:
        self._next, self._flown = step, step if flown is None else flown
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
