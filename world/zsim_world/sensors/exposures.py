"""The sampling instants of sensors computed after a gate, and the states of the fleet around them."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim_world.physics.fleet_arrays import STATE
from zsim_world.run_state import Saved

Array = NDArray[np.float64]


class Between(NamedTuple):
    """The states of all drones at two gates, (N, STATE.size) each, for `poses_between`."""

    former: Array
    former_ns: int
    now: Array
    now_ns: int


class Exposures:
    """The instants n / rate of some sensors, gate by gate."""

    SAVED: ClassVar[Saved] = {
        "_counts": list[int],
        "_due_ns": list[int],
        "_next_ns": int,
        "_former": np.ndarray,
        "_former_ns": int,
    }

    def __init__(self, rates_hz: Sequence[float], gate_ns: int) -> None:
        self._rates_hz, self._gate_ns = rates_hz, gate_ns
        self._counts = [0] * len(rates_hz)
        self._due_ns = [0] * len(rates_hz)  # the next sample of each
        self._next_ns = 0  # the soonest of all
        self._former = np.empty((0, STATE.size))  # states of the last gate before a sample
        self._former_ns = 0

    def until(self, state: Array, now_ns: int) -> tuple[list[tuple[int, int]], Between | None]:
        """Return instants and indices of the sensors whose samples are due by a gate, sorted, and the states.

        Args:
            state: states of all drones at the gate, (N, STATE.size or more).
        """
        due, between = [], None
        if self._next_ns <= now_ns:
            now = state[:, : STATE.size].copy()
            for place, rate_hz in enumerate(self._rates_hz):
                while self._due_ns[place] <= now_ns:
                    due.append((self._due_ns[place], place))
                    self._counts[place] += 1
                    self._due_ns[place] = round(self._counts[place] * 1e9 / rate_hz)
            due.sort()
            self._next_ns = min(self._due_ns)
            former, former_ns = (self._former, self._former_ns) if len(self._former) else (now, now_ns)
            between = Between(former, former_ns, now, now_ns)
        if self._next_ns <= now_ns + self._gate_ns:  # a sample before the next gate needs this state
            self._former, self._former_ns = state[:, : STATE.size].copy(), now_ns
        return due, between
