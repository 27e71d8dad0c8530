"""Which processes have died, have fallen silent, or take nothing from their links; and which are admitted.

A lost liveliness token is checked again before it is believed.
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from zsim.contract import keys
from zsim.contract.run_messages import Health, Join
from zsim.transport.link_watch import Awaited, LinkWatch, Sessions, SessionTokens
from zsim.transport.session import Session
from zsim_world.run.barrier import Participant
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
TOKEN_NS = 3_000_000_000  # wall time by which a token is there; the hub knows one behind routers within 1 s (measured)
SHOWN_NS = 10_000_000_000  # wall time by which one whose token is not its own publishes a done; first steps take 1 s
HELD_NS = 1_000_000_000  # wall time that time has to stand for a living process before another may replace it
DONE_NS = 10_000_000_000  # wall time that time may stand for one that never published a done; first steps take 1 s
LOOK_NS = 200_000_000  # wall time between two checks of those that still have to prove that they exist
WITHHELD_MAX = 1000  # joins of strangers that wait for their tokens
NO_TOKEN = "has no liveliness token"
NO_DONE = "has never published a done"


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


@dataclass
class _Withheld:
    """A join that waits for a proof; since when the name has one, and whether a done has followed it."""

    join: Join
    since_ns: int
    has_done: bool = False


class Admission:
    """Passes joins to a world, and reports those without a process behind them.

    Who replaces a living process has to prove that it exists, and so has every newcomer: a join is only a message,
    which anybody can publish under any name. A process proves it by a liveliness token of its own session, or, if it is
    a program without one, by the done that follows its join. Time never waits for a stranger without a token: somebody
    who joins under ever new names could stop it for good.

    Args:
        tokens: of all processes.
        trusts: whether access control lets nobody join in another's name.
    """

    def __init__(self, tokens: SessionTokens, run: Run, trusts: bool) -> None:
        self._tokens = tokens
        self._run = run
        self._world = run.world
        self._barrier = run.world.barrier
        self._trusts = trusts
        self._sessions: dict[str, Sessions] = {}  # by whose tokens a process takes part, or did
        self._withheld: dict[str, _Withheld] = {}
        self._standing_ns: dict[str, int] = {}  # of those without a token or a done so far: how long time stood for it
        self._look_wall_ns = 0

    def take(self, name: str, join: Join, wall_ns: int) -> None:
        """Admit a join, or withhold it until it is clear that a process is behind it."""
        if self._needs_no_proof(name, join):
            self._admit(name, join, wall_ns)
            return
        former = self._withheld.get(name)
        if former is None and len(self._withheld) >= WITHHELD_MAX and name not in self._barrier.participants:
            self._run.call("falsely_joined", name, join, NO_TOKEN)
            return
        self._withheld[name] = _Withheld(join, former.since_ns if former else wall_ns)
        self._check(name, wall_ns)

    def done_received(self, name: str, incarnation: int, wall_ns: int) -> None:
        """Note that a process has published a done, before the world has it."""
        withheld = self._withheld.get(name)
        if withheld is not None and withheld.join.incarnation == incarnation:
            withheld.has_done = True
            self._check(name, wall_ns)

    def check_due(self, wall_ns: int) -> None:
        """Check those that still have to prove that they exist."""
        passed_ns = wall_ns - self._look_wall_ns
        if passed_ns < LOOK_NS or not (self._withheld or self._standing_ns):
            return
        self._look_wall_ns = wall_ns
        for name in list(self._withheld):
            self._check(name, wall_ns)
        for name in list(self._standing_ns):  # forget who has proved to exist, report who never had a token
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                del self._standing_ns[name]
                continue
            self._sessions[name] = self._sessions.get(name) or self._tokens.sessions(name)
            has_token = self._trusts or self._tokens.is_alive(name)
            if has_token and not _owes_done(participant):
                del self._standing_ns[name]
            elif not has_token and wall_ns - participant.joined_wall_ns >= TOKEN_NS:
                self._run.call("not_shown", name, NO_TOKEN, wall_ns)
        self._count_standing(min(passed_ns, 2 * LOOK_NS), wall_ns)

    def _needs_no_proof(self, name: str, join: Join) -> bool:
        """Tell whether to admit a join without proof: it replaces no process, and time does not wait for it."""
        return not (self._barrier.takes_place(name, join) or self._is_stranger(name, join))

    def _is_stranger(self, name: str, join: Join) -> bool:
        """Tell whether time would wait for a newcomer without a token that the start does not wait for."""
        stands = (join.period_ns > 0 or join.slack_ns > 0) and not self._barrier.join_refusal(name, join)
        if not stands or name in self._barrier.participants:
            return False
        return not (self._trusts or name in self._barrier.absent() or self._tokens.is_alive(name))

    def _admit(self, name: str, join: Join, wall_ns: int) -> None:
        self._withheld.pop(name, None)
        former, present = self._sessions.get(name, Sessions()), self._tokens.sessions(name)
        if name not in self._barrier.participants:
            former = Sessions()
        self._run.call("join", name, join, wall_ns)
        participant = self._barrier.participants.get(name)
        if participant is not None and participant.join is join:
            self._sessions[name] = (present & former) | frozenset(sorted(present - former)[:1])  # one for each join
            self._standing_ns[name] = 0

    def _check(self, name: str, wall_ns: int) -> None:
        """Admit a join that was withheld, once it may be, or reject it after its time."""
        withheld = self._withheld[name]
        join = withheld.join
        if self._needs_no_proof(name, join) or self._may_take_place(name, withheld, wall_ns):
            self._admit(name, join, wall_ns)
            return
        reason = NO_DONE if self._tokens.is_alive(name) else NO_TOKEN
        if wall_ns - withheld.since_ns >= (SHOWN_NS if reason == NO_DONE else TOKEN_NS):
            del self._withheld[name]
            self._run.call("falsely_joined", name, join, reason)

    def _may_take_place(self, name: str, withheld: _Withheld, wall_ns: int) -> bool:
        """Tell whether a process is behind a join in the place of another, or the other is not there any more."""
        if self._is_stranger(name, withheld.join):
            return False
        if self._trusts or withheld.has_done or self._tokens.sessions(name) - self._sessions.get(name, Sessions()):
            return True
        former = self._barrier.participants.get(name)
        if former is None or not former.alive:
            return self._tokens.is_alive(name)
        held_up = former in self._world.blocking_clock() and wall_ns - former.since_wall_ns >= HELD_NS
        return held_up or former.silent_wall_ns is not None

    def _count_standing(self, passed_ns: int, wall_ns: int) -> None:
        """Count how long participants have owed their first done, and report those that never publish one.

        In lockstep only while time waits for nobody else, since those others may be why it has not come; in realtime,
        where time waits for nobody, whenever it is due and time runs.
        """
        clock = self._world.clock
        if clock.mode == "realtime":
            due = self._world.blocking() if clock.state == "running" and not clock.is_halted else ()
            owing = [p for p in due if p.alive and p.name in self._standing_ns and _owes_done(p)]
        else:
            owing = self._world.blocking_clock()
        if any(p.name not in self._standing_ns or not _owes_done(p) for p in owing):
            return
        for participant in owing:
            if not self._world.must_wait_for(participant):
                self._standing_ns[participant.name] += passed_ns
                if self._standing_ns[participant.name] >= DONE_NS:
                    self._run.call("not_shown", participant.name, NO_DONE, wall_ns)


def _owes_done(participant: Participant) -> bool:
    return participant.is_waited_for and participant.done_seq is None
