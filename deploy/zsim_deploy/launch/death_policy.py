"""What a launcher does when one of its processes ends while the run goes on."""

import time
from collections import defaultdict, deque
from typing import NamedTuple

from zsim.scenario.roles import is_needed, lets_drop, on_death, on_overdue
from zsim.scenario.scenario import OnDeath, Processes
from zsim_deploy import USER_FAULT

RESTARTS_MAX = 5  # of one process within RESTART_WINDOW_S; more is a fault that a restart does not heal
RESTART_WINDOW_S = 20.0
SUPERSEDED = 3  # exit code of a role whose place another process of its name has taken


class DeathDecision(NamedTuple):
    """What is to be done, and why, for people."""

    action: OnDeath
    why: str


class DeathPolicy:
    """Decides by what the scenario says of deaths, and by how often a process has died.

    Args:
        processes: of the scenario.
    """

    def __init__(self, processes: Processes) -> None:
        self._processes = processes
        self._deaths: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RESTARTS_MAX + 1))

    def decide(self, name: str, code: int | None, flies: bool) -> DeathDecision:
        """Take the death of a process; return what is to be done.

        Args:
            name: of the process.
            code: with which it ended.
            flies: whether the run has begun.
        """
        action = on_death(self._processes.on_death, name)
        if action == "end":
            return DeathDecision("end", "on_death: end")
        is_settled = flies and (action == "wait" or lets_drop(self._processes.on_death, name))  # by the scenario itself
        if code == USER_FAULT and not is_settled:
            return self._without(name, flies, "a restart would not help", is_needed(name))
        if action == "restart" and self._dies_too_often(name):
            return self._without(name, flies, f"more than {RESTARTS_MAX} restarts within {RESTART_WINDOW_S:g} s")
        return DeathDecision(action, f"on_death: {action}")

    def _without(self, name: str, flies: bool, why: str, ends: bool = False) -> DeathDecision:
        """Return what is to be done where no restart brings a process back."""
        overdue = on_overdue(self._processes.on_overdue or {}, name, gating=self._processes.gating or ())
        ends = ends or overdue == "end" or self._processes.gates(name.partition(".")[0])
        is_awaited = not flies and not is_needed(name) and name in (self._processes.expect or ())
        if ends or is_awaited:  # a run that has not begun would wait for it for ever
            return DeathDecision("end", f"{why}; the run ends")
        return DeathDecision("drop", f"{why}; it is given up, and the run goes on without it")

    def _dies_too_often(self, name: str) -> bool:
        """Count a death; return whether there were too many in a row for another restart."""
        deaths = self._deaths[name]
        deaths.append(time.monotonic())
        return len(deaths) > RESTARTS_MAX and deaths[-1] - deaths[0] < RESTART_WINDOW_S
