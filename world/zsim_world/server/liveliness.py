"""Who has died: the news that tokens went, looked at again before it is believed."""

import time
from collections.abc import Callable
from typing import NamedTuple

from zsim.contract import keys
from zsim.contract.messages import Join
from zsim.transport.session import Session
from zsim_world.flight.coordinator import Hub

BYE_NS = 100_000_000  # wall time by which a bye may come after the news that the token of its process went
NEW_TOKEN_NS = 1_500_000_000  # wall time within which a router knows a new token; up to 1 s measured
LOOK_S = 1.0  # a router answers which tokens it knows within milliseconds
SILENT_S = 10  # seconds of health in a row that one that only reads may leave out; its link is given up after as many


class Doubt(NamedTuple):
    """When to look again at a process whose token seemed to go, and whether once more after that."""

    due_ns: int
    again: bool = True


class Deaths:
    """Judges whose token seemed to go.

    Args:
        link: of the hub.
        world: told of deaths.
        take_in: reads what has arrived; a bye may be among it.
    """

    def __init__(self, link: Session, world: Hub, take_in: Callable[[], None]) -> None:
        self._link = link
        self._world = world
        self._take_in = take_in
        self._doubted: dict[str, Doubt] = {}
        self._silent_s: dict[str, int] = {}  # of those that tell of their health

    def heard(self, name: str) -> None:
        """Take the news that a process told of its health."""
        self._silent_s[name] = 0

    def second(self) -> None:
        """Count a second in which the world itself ran.

        Who only reads and tells nothing for long is dead: it may be stopped, and Zenoh does not always tell that it has
        closed the full link of one that takes nothing. For one that gates time stands, and somebody looks.
        """
        for name in list(self._silent_s):
            participant = self._world.barrier.participants.get(name)
            if participant is None or not participant.alive or participant.gating:
                del self._silent_s[name]
                continue
            self._silent_s[name] += 1
            if self._silent_s[name] > SILENT_S:
                self._world.died(name, time.monotonic_ns())

    def suspect(self, name: str) -> None:
        """Take the news that a token went: its process is not dead yet, since its bye may come after it."""
        participant = self._world.barrier.participants.get(name)
        if participant and participant.alive:
            self._doubted[name] = Doubt(time.monotonic_ns() + BYE_NS)

    def joins(self, name: str, join: Join) -> None:
        """Take the news that a process is about to join: another of its name whose token went has died before."""
        former = self._world.barrier.participants.get(name)
        if name in self._doubted and former and former.alive and (former.host, former.pid) != (join.host, join.pid):
            del self._doubted[name]
            self._world.died(name, time.monotonic_ns())

    def judge_due(self) -> None:
        """Look again at those of whom it is time."""
        now_ns = time.monotonic_ns()
        for name in [name for name, doubt in self._doubted.items() if doubt.due_ns <= now_ns]:
            self._take_in()
            self._judge(name, self._doubted.pop(name), now_ns)

    def _judge(self, name: str, doubt: Doubt, now_ns: int) -> None:
        """Take the death of a process that has no token; look once more where one is found, or may be too new to be."""
        participant = self._world.barrier.participants.get(name)
        if participant is None:
            return
        if keys.token(name) in self._link.tokens(keys.token(name), timeout_s=LOOK_S):
            if doubt.again:  # a successor's, or one that Zenoh has not forgotten yet
                self._doubted[name] = Doubt(now_ns + NEW_TOKEN_NS, again=False)
        elif now_ns - participant.joined_wall_ns < NEW_TOKEN_NS:  # a new token is not always found at once
            self._doubted[name] = Doubt(participant.joined_wall_ns + NEW_TOKEN_NS, doubt.again)
        else:
            self._world.died(name, time.monotonic_ns())
