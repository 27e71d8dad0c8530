"""Which processes have died, have fallen silent, or take nothing from their links.

A lost liveliness token is checked again before it is believed.
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import msgspec

from zsim.contract import keys
from zsim.contract.run_messages import Health, Join
from zsim.transport.link_watch import Awaited, LinkWatch, SessionTokens
from zsim.transport.session import Session
from zsim_world.run.inputs import Run

BYE_NS = 100_000_000  # wall time by which a bye may come after the loss of its process's token
RETURN_NS = 5_000_000_000  # wall time in which a process is back at a world that was started again; 1 s measured
START_NS = 60_000_000_000  # wall time in which one that has to be started again is there; a small computer needs 20 s
NEW_TOKEN_NS = 1_500_000_000  # wall time within which a router knows a new token; up to 1 s measured
TOKENS_S = 1.0  # a router answers which tokens it knows within milliseconds
SILENT_S = 10  # seconds of health in a row that one that only reads may leave out; its link is given up after as many
SILENT_NS = 1_800_000_000  # wall time without health, which comes once a second; so a stop is named within 2 s
STALL_NS = 300_000_000  # wall time between two checks from which on the world itself, or its machine, was stopped
SHOWN = 5  # expressions of one that subscribes to many
_decode_health = msgspec.msgpack.Decoder(Health).decode


class _Check(NamedTuple):
    """When to check a process whose token seems lost, and whether once more after that."""

    due_ns: int
    again: bool = True


class LivelinessMonitor:
    """Finds out which participants of a run have died.

    Args:
        link: the listening session.
        take_in: reads what has arrived; a bye may be among it.
    """

    def __init__(self, link: Session, run: Run, take_in: Callable[[], None]) -> None:
        self._link = link
        self._run = run
        self._barrier = run.world.barrier
        self._take_in = take_in
        self._lost: deque[str] = deque()  # reported by other threads: whose token seems lost
        self._checks: dict[str, _Check] = {}
        self._health = HealthWatch(lambda name, since_ns: run.call("silence_changed", name, since_ns))
        self._silent_s: dict[str, int] = {}  # of those that publish their health

    def token_lost(self, name: str) -> None:
        """Note, from any thread, that a token is gone: its process is not dead yet, its bye may come after it."""
        self._lost.append(name)

    def health_received(self, name: str) -> None:
        self._silent_s[name] = 0
        self._health.received(name, time.monotonic_ns())

    def count_second(self) -> None:
        """Count a second in which the world itself ran.

        A process that only reads is dead if it publishes no health for long: it may be stopped, and Zenoh does not
        always notice that it has closed the full link of one that takes nothing. For one that gates, time stands, and
        `clock` names it.
        """
        for name in list(self._silent_s):
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive or participant.gating:
                del self._silent_s[name]
                continue
            self._silent_s[name] += 1
            if self._silent_s[name] > SILENT_S:
                self._report_death(name)

    def check_all(self) -> None:
        """Check, after the time that it takes to come back, everybody who took part before the world was restarted."""
        for name, participant in self._barrier.participants.items():
            wait_ns = RETURN_NS if participant.alive else START_NS
            if participant.away or participant.alive:
                self._checks[name] = _Check(time.monotonic_ns() + wait_ns, again=False)

    def before_join(self, name: str, join: Join) -> None:
        """Prepare for a join: another process of that name whose token is lost has died before."""
        self._take_lost()
        former = self._barrier.participants.get(name)
        if name in self._checks and former and former.alive and not former.is_process_of(join):
            del self._checks[name]
            self._report_death(name)

    def check_due(self) -> None:
        """Check the processes that are due.

        A process without a token is dead, unless it is so new that its token may not be known yet. That one is checked
        again, and so is one that has a token.
        """
        self._take_lost()
        now_ns = time.monotonic_ns()
        for name in self._health.look(now_ns):
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                self._health.forget(name)
        for name in [name for name, check in self._checks.items() if check.due_ns <= now_ns]:
            self._take_in()
            participant = self._barrier.participants.get(name)
            check = self._checks.pop(name, None)
            if participant is None or check is None:  # a join that was taken in settles it
                continue
            participant.away = False  # from here on it is dead, or one that does not join again
            if keys.token(name) in self._link.tokens(keys.token(name), timeout_s=TOKENS_S):
                if check.again:  # a successor's, or one that Zenoh has not forgotten yet
                    self._checks[name] = _Check(now_ns + NEW_TOKEN_NS, again=False)
            elif now_ns - participant.joined_wall_ns < NEW_TOKEN_NS:  # a new token is not always found at once
                self._checks[name] = _Check(participant.joined_wall_ns + NEW_TOKEN_NS, check.again)
            else:
                self._report_death(name)

    def _take_lost(self) -> None:
        while self._lost:
            name = self._lost.popleft()
            participant = self._barrier.participants.get(name)
            if participant and participant.alive:
                self._checks[name] = _Check(time.monotonic_ns() + BYE_NS)

    def _report_death(self, name: str) -> None:
        self._run.call("died", name, time.monotonic_ns())


class HealthWatch:
    """Notes when each process has last published its health.

    Args:
        handle_silence: called with name and wall time of its last health when a process falls silent, and with None
            for that when its health comes again.
    """

    def __init__(self, handle_silence: Callable[[str, int | None], object]) -> None:
        self._handle_silence = handle_silence
        self._last_wall_ns: dict[str, int] = {}
        self._silent: set[str] = set()
        self._look_wall_ns = 0

    def received(self, name: str, wall_ns: int) -> None:
        self._last_wall_ns[name] = wall_ns
        if name in self._silent:
            self._silent.discard(name)
            self._handle_silence(name, None)

    def forget(self, name: str) -> None:
        """Expect nothing of a process any more: it has left, or is dead."""
        self._last_wall_ns.pop(name, None)
        self._silent.discard(name)

    def look(self, wall_ns: int) -> list[str]:
        """Report who has fallen silent; return the processes whose health is expected. To be called all the time."""
        stall_ns = wall_ns - self._look_wall_ns
        self._look_wall_ns = wall_ns
        if stall_ns > STALL_NS:  # what came meanwhile was not read
            self._last_wall_ns = {name: last_ns + stall_ns for name, last_ns in self._last_wall_ns.items()}
        for name, last_ns in list(self._last_wall_ns.items()):
            if name not in self._silent and wall_ns - last_ns >= SILENT_NS:
                self._silent.add(name)
                self._handle_silence(name, last_ns)
        return list(self._last_wall_ns)


class SlowReaders:
    """Reports closed links: an event names the reader that took nothing, the terminal the one that blocks the world.

    Args:
        link: the listening session.
        tokens: of all processes.
        run: whose readers they were; its history has the health of those that publish it.

    Attributes:
        watch: closes the links.
    """

    def __init__(self, link: Session, tokens: SessionTokens, run: Run) -> None:
        self._run = run
        self._own_host = link.host
        self.watch = LinkWatch(link, tokens, self._awaited)

    def _awaited(self) -> list[Awaited]:
        """Return those that must not lose any message; called by another thread."""
        participants = list(self._run.world.barrier.participants.values())
        return [Awaited((p.name, *p.join.serves), p.join.pid) for p in participants if p.is_waited_for]

    def report(self) -> None:
        """Report the links that were closed since the last time, with what their processes read by their health."""
        while self.watch.closed:
            closed = self.watch.closed.popleft()
            host = self._own_host if closed.process else closed.address.rpartition(":")[0].strip("[]")
            reads: list[str] = []
            for name in closed.names:
                for _, payload in self._run.history.last(keys.process(name, "health")):
                    with suppress(msgspec.MsgspecError):
                        reads += _decode_health(payload).reads
            names = ", ".join(closed.names) or "no process of the run"
            more = " …" if len(reads) > SHOWN else ""
            which = f", which reads {', '.join(reads[:SHOWN])}{more}," if reads else ""
            who = f"{closed.process or 'somebody'} at {closed.address} on {host}"
            held = f"{closed.held_bytes / 1e6:.1f} MB"
            text = f"{who} ({names}){which} took nothing of {held}; its link is closed ({closed.times} so far)"
            self._run.call("reader_closed", text, {**closed._asdict(), "host": host, "reads": reads})

    def stuck(self) -> str:
        """Return which link takes nothing, as text."""
        named = self.watch.stuck()
        return f"the link takes nothing of {named[0]}" if named else "no link is known to be full"
