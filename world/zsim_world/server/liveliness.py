"""Who has died: lost liveliness tokens, checked again before they are believed, and readers that fell silent."""

import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from zsim.contract import keys
from zsim.contract.run_messages import Join
from zsim.transport.session import Session
from zsim_world.flight.barrier import Barrier
from zsim_world.server.health_watch import HealthWatch

BYE_NS = 100_000_000  # wall time by which a bye may come after the loss of its process's token
RETURN_NS = 5_000_000_000  # wall time in which a process is back at a world that was started again; 1 s measured
START_NS = 60_000_000_000  # wall time in which one that has to be started again is there; a small computer needs 20 s
NEW_TOKEN_NS = 1_500_000_000  # wall time within which a router knows a new token; up to 1 s measured
TOKENS_S = 1.0  # a router answers which tokens it knows within milliseconds
SILENT_S = 10  # seconds of health in a row that one that only reads may leave out; its link is given up after as many


class _Check(NamedTuple):
    """When to check a process whose token seems lost, and whether once more after that."""

    due_ns: int
    again: bool = True


class LivelinessMonitor:
    """Finds out which participants have died.

    Args:
        link: the listening session.
        barrier: who takes part.
        handle_death: called with name and wall time of each death.
        take_in: reads what has arrived; a bye may be among it.
        handle_silence: as for HealthWatch.
    """

    def __init__(
        self,
        link: Session,
        barrier: Barrier,
        handle_death: Callable[[str, int], None],
        take_in: Callable[[], None],
        handle_silence: Callable[[str, int | None], None],
    ) -> None:
        self._link = link
        self._participants = barrier.participants
        self._handle_death = handle_death
        self._take_in = take_in
        self._lost: deque[str] = deque()  # news of other threads: whose token seems lost
        self._checks: dict[str, _Check] = {}
        self._health = HealthWatch(handle_silence)
        self._silent_s: dict[str, int] = {}  # of those that publish their health

    def token_lost(self, name: str) -> None:
        """Take the news that a token went, from any thread: its process is not dead yet, its bye may come after it."""
        self._lost.append(name)

    def health_received(self, name: str) -> None:
        """Note that a process has published its health."""
        self._silent_s[name] = 0
        self._health.received(name, time.monotonic_ns())

    def count_second(self) -> None:
        """Count a second in which the world itself ran.

        Who only reads and publishes nothing for long is dead: it may be stopped, and Zenoh does not always notice that
        it has closed the full link of one that takes nothing. For one that gates, time stands, and `clock` names it.
        """
        for name in list(self._silent_s):
            participant = self._participants.get(name)
            if participant is None or not participant.alive or participant.gating:
                del self._silent_s[name]
                continue
            self._silent_s[name] += 1
            if self._silent_s[name] > SILENT_S:
                self._handle_death(name, time.monotonic_ns())

    def check_all(self) -> None:
        """Check, after the time that it takes to come back, everybody who took part before the world was restarted."""
        for name, participant in self._participants.items():
            wait_ns = RETURN_NS if participant.alive else START_NS
            if participant.away or participant.alive:
                self._checks[name] = _Check(time.monotonic_ns() + wait_ns, again=False)

    def before_join(self, name: str, join: Join) -> None:
        """Prepare for a join: another process of that name whose token is lost has died before."""
        self._take_lost()
        former = self._participants.get(name)
        if name in self._checks and former and former.alive and not former.is_process_of(join):
            del self._checks[name]
            self._handle_death(name, time.monotonic_ns())

    def check_due(self) -> None:
        """Check those processes of which it is time."""
        self._take_lost()
        now_ns = time.monotonic_ns()
        for name in self._health.look(now_ns):
            participant = self._participants.get(name)
            if participant is None or not participant.alive:
                self._health.forget(name)
        for name in [name for name, check in self._checks.items() if check.due_ns <= now_ns]:
            self._take_in()
            if name in self._checks:  # a join that was taken in settles it
                self._check(name, self._checks.pop(name), now_ns)

    def _take_lost(self) -> None:
        while self._lost:
            name = self._lost.popleft()
            participant = self._participants.get(name)
            if participant and participant.alive:
                self._checks[name] = _Check(time.monotonic_ns() + BYE_NS)

    def _check(self, name: str, check: _Check, now_ns: int) -> None:
        """Take the death of a process without a token; check once more where there is one, or it may be too new."""
        participant = self._participants.get(name)
        if participant is None:
            return
        participant.away = False  # from here on it is dead, or one that does not join again
        if keys.token(name) in self._link.tokens(keys.token(name), timeout_s=TOKENS_S):
            if check.again:  # a successor's, or one that Zenoh has not forgotten yet
                self._checks[name] = _Check(now_ns + NEW_TOKEN_NS, again=False)
        elif now_ns - participant.joined_wall_ns < NEW_TOKEN_NS:  # a new token is not always found at once
            self._checks[name] = _Check(participant.joined_wall_ns + NEW_TOKEN_NS, check.again)
        else:
            self._handle_death(name, time.monotonic_ns())
