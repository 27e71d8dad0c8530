"""Detection of processes that have died, are silent or do not read from their links, and admission of newcomers.

The loss of a liveliness token is verified before it counts as a death.
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

BYE_NS = 100_000_000  # wall time within which a bye may still arrive after the loss of its process's token
RETURN_NS = 5_000_000_000  # wall time within which a process rejoins a restarted world; 1 s measured
START_NS = 60_000_000_000  # wall time within which a restarted process joins; a small computer needs 20 s
NEW_TOKEN_NS = 1_500_000_000  # wall time within which a router learns of a new token; up to 1 s measured
TOKENS_S = 1.0  # timeout of a token query, which a router answers within milliseconds
SILENT_NS = 1_800_000_000  # wall time without health, which is published once a second: silence is reported within 2 s
DEAD_NS = 10_000_000_000  # wall time without health after which a process that does not gate counts as dead
STALL_NS = 300_000_000  # wall time between checks that indicates that the world or its machine was stopped
SHOWN = 5  # maximum number of key expressions shown for a closed link
_decode_health = msgspec.msgpack.Decoder(Health).decode
TOKEN_NS = 3_000_000_000  # wall time limit for a token to appear; behind routers it takes up to 1 s (measured)
FIRST_DONE_NS = 10_000_000_000  # wall time limit for a first done that proves a process; a first step takes 1 s
BLOCKED_MIN_NS = 1_000_000_000  # wall time for which a living process must block the clock before it may be replaced
DONE_NS = 10_000_000_000  # wall time for which a process may block the clock before its first done, which takes 1 s
LOOK_NS = 200_000_000  # wall time between checks of unproven processes
WITHHELD_MAX = 1000  # maximum number of withheld joins of unknown processes
NO_TOKEN = "has no liveliness token"
NO_DONE = "has never published a done"


class _Check(NamedTuple):
    """When to check a process whose token seems lost, and whether to check it again later."""

    due_ns: int
    again: bool = True


class LivelinessMonitor:
    """Detects which participants of a run have died.

    Args:
        link: the listening session.
        take_in: enters newly arrived messages, possibly a bye, into the run.
    """

    def __init__(self, link: Session, run: Run, take_in: Callable[[], None]) -> None:
        self._link = link
        self._run = run
        self._barrier = run.world.barrier
        self._take_in = take_in
        self._lost: deque[str] = deque()  # names whose token seems lost, reported by other threads
        self._checks: dict[str, _Check] = {}
        self._health = HealthWatch(lambda name, since_ns: run.call("silence_changed", name, since_ns))

    def token_lost(self, name: str) -> None:
        """Note the loss of a process's token; its bye may still follow. Callable from any thread."""
        self._lost.append(name)

    def health_received(self, name: str) -> None:
        self._health.received(name, time.monotonic_ns())

    def check_all(self) -> None:
        """In a restarted world, schedule a check of each former participant for when it must have rejoined."""
        for name, participant in self._barrier.participants.items():
            wait_ns = RETURN_NS if participant.alive else START_NS
            if participant.away or participant.alive:
                self._checks[name] = _Check(time.monotonic_ns() + wait_ns, again=False)

    def before_join(self, name: str, join: Join) -> None:
        """Before a join is handled, report the death of a former process of the same name whose token is lost."""
        self._take_lost()
        former = self._barrier.participants.get(name)
        if name in self._checks and former and former.alive and not former.is_process_of(join):
            del self._checks[name]
            self._report_death(name)

    def check_due(self) -> None:
        """Check the processes whose check is due.

        A process without a token is dead, unless its token may be too new to be known; in that case it is checked
        again, as is a process that has a token. A process that does not gate also counts as dead after DEAD_NS without
        health, since Zenoh does not always report that it has closed the full link of a stopped process. A gating
        process instead blocks the clock and is named in `clock`.
        """
        self._take_lost()
        now_ns = time.monotonic_ns()
        for name, silent_ns in self._health.look(now_ns).items():
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                self._health.forget(name)
            elif silent_ns > DEAD_NS and not participant.gating:
                self._report_death(name)
        for name in [name for name, check in self._checks.items() if check.due_ns <= now_ns]:
            self._take_in()
            participant = self._barrier.participants.get(name)
            check = self._checks.pop(name, None)
            if participant is None or check is None:  # settled by a message just taken in
                continue
            participant.away = False  # it is dead, or alive but has not rejoined
            if keys.token(name) in self._link.tokens(keys.token(name), timeout_s=TOKENS_S):
                if check.again:  # the token may be a successor's, or not yet forgotten by Zenoh
                    self._checks[name] = _Check(now_ns + NEW_TOKEN_NS, again=False)
            elif now_ns - participant.joined_wall_ns < NEW_TOKEN_NS:  # a new token may not be known yet
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
    """Tracks when each process last published its health.

    Args:
        handle_silence: called with a process's name and the wall time of its last health message when it falls silent,
            and with its name and None when its health resumes.
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
        """Stop expecting health messages from a process that has left or died."""
        self._last_wall_ns.pop(name, None)
        self._silent.discard(name)

    def look(self, wall_ns: int) -> dict[str, int]:
        """Report processes that have fallen silent; return the time since each process's last health message [ns].

        Must be called at least once every STALL_NS.
        """
        stall_ns = wall_ns - self._look_wall_ns
        self._look_wall_ns = wall_ns
        if stall_ns > STALL_NS:  # messages that arrived during the stall have not been read yet
            self._last_wall_ns = {name: min(last + stall_ns, wall_ns) for name, last in self._last_wall_ns.items()}
        for name, last_ns in list(self._last_wall_ns.items()):
            if name not in self._silent and wall_ns - last_ns >= SILENT_NS:
                self._silent.add(name)
                self._handle_silence(name, last_ns)
        return {name: wall_ns - last_ns for name, last_ns in self._last_wall_ns.items()}


class SlowReaders:
    """Reports closed links as events, and names the link that blocks the world.

    Args:
        link: the listening session.
        tokens: tokens of all processes.
        run: the run; its history contains the readers' health messages.

    Attributes:
        watch: closes the links of readers that do not keep up.
    """

    def __init__(self, link: Session, tokens: SessionTokens, run: Run) -> None:
        self._run = run
        self._own_host = link.host
        self.watch = LinkWatch(link, tokens, self._awaited)

    def _awaited(self) -> list[Awaited]:
        """Return the processes that must not lose any message; called from another thread."""
        participants = list(self._run.world.barrier.participants.values())
        return [Awaited((p.name, *p.join.serves), p.join.pid) for p in participants if p.is_waited_for]

    def report(self) -> None:
        """Report the links closed since the last call, with the keys that their processes read by their own account."""
        while self.watch.closed:
            closed = self.watch.closed.popleft()
            host = self._own_host if closed.process else closed.address.rpartition(":")[0].strip("[]")
            reads: list[str] = []
            for name in closed.names:
                for _, payload in self._run.history.last(keys.process(name, "health")):
                    with suppress(msgspec.MsgspecError):
                        reads += _decode_health(payload).reads
            names = ", ".join(closed.names) or "no process of the run"
            ellipsis = " …" if len(reads) > SHOWN else ""
            clause = f", which reads {', '.join(reads[:SHOWN])}{ellipsis}," if reads else ""
            reader = f"{closed.process or 'somebody'} at {closed.address} on {host}"
            size = f"{closed.held_bytes / 1e6:.1f} MB"
            text = f"{reader} ({names}){clause} read none of {size}; its link is closed ({closed.times} times so far)"
            self._run.call("reader_closed", text, {**closed._asdict(), "host": host, "reads": reads})

    def stuck(self) -> str:
        """Return a text that names the blocked link."""
        names = self.watch.stuck()
        return f"the link to {names[0]} accepts no data" if names else "no link is known to be full"


@dataclass
class _Withheld:
    """A join withheld until the process behind it is proved to exist."""

    join: Join
    since_ns: int  # wall time at which the first join of that name was withheld
    has_done: bool = False  # whether a done has followed the join


class Admission:
    """Passes joins to a world, and reports joins without a process behind them.

    A newcomer, or a process that replaces a living one, must prove that it exists, since any program can publish a join
    under any name. The proof is a liveliness token of its own session or, for a program without a token, the done that
    follows its join. Time never waits for an unknown process without a token, since joins under ever new names could
    otherwise stop it for good.

    Args:
        tokens: tokens of all processes.
        trusts: whether access control prevents joins under another process's name.
    """

    def __init__(self, tokens: SessionTokens, run: Run, trusts: bool) -> None:
        self._tokens = tokens
        self._run = run
        self._world = run.world
        self._barrier = run.world.barrier
        self._trusts = trusts
        self._sessions: dict[str, Sessions] = {}  # by process, the sessions whose tokens have proved it
        self._withheld: dict[str, _Withheld] = {}
        self._blocked_ns: dict[str, int] = {}  # how long processes without a token or a done have blocked the clock
        self._look_wall_ns = 0

    def take(self, name: str, join: Join, wall_ns: int) -> None:
        """Admit a join, or withhold it until the process behind it is proved to exist."""
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
        """Note a process's done before the world handles it."""
        withheld = self._withheld.get(name)
        if withheld is not None and withheld.join.incarnation == incarnation:
            withheld.has_done = True
            self._check(name, wall_ns)

    def check_due(self, wall_ns: int) -> None:
        """Check the processes that are not yet proved to exist."""
        passed_ns = wall_ns - self._look_wall_ns
        if passed_ns < LOOK_NS or not (self._withheld or self._blocked_ns):
            return
        self._look_wall_ns = wall_ns
        for name in list(self._withheld):
            self._check(name, wall_ns)
        for name in list(self._blocked_ns):  # forget proved processes, and report those that never had a token
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                del self._blocked_ns[name]
                continue
            self._sessions[name] = self._sessions.get(name) or self._tokens.sessions(name)
            has_token = self._trusts or self._tokens.is_alive(name)
            if has_token and not _owes_done(participant):
                del self._blocked_ns[name]
            elif not has_token and wall_ns - participant.joined_wall_ns >= TOKEN_NS:
                self._run.call("not_shown", name, NO_TOKEN, wall_ns)
        self._count_blocked(min(passed_ns, 2 * LOOK_NS), wall_ns)

    def _needs_no_proof(self, name: str, join: Join) -> bool:
        """Return whether a join needs no proof: it replaces no process and is not a stranger's."""
        return not (self._barrier.would_replace(name, join) or self._is_stranger(name, join))

    def _is_stranger(self, name: str, join: Join) -> bool:
        """Return whether a join is from an unexpected newcomer without a token, for which time would wait."""
        would_block = (join.period_ns > 0 or join.slack_ns > 0) and not self._barrier.join_refusal(name, join)
        if not would_block or name in self._barrier.participants:
            return False
        return not (self._trusts or name in self._barrier.absent() or self._tokens.is_alive(name))

    def _admit(self, name: str, join: Join, wall_ns: int) -> None:
        self._withheld.pop(name, None)
        former, current = self._sessions.get(name, Sessions()), self._tokens.sessions(name)
        if name not in self._barrier.participants:
            former = Sessions()
        self._run.call("join", name, join, wall_ns)
        participant = self._barrier.participants.get(name)
        if participant is not None and participant.join is join:
            self._sessions[name] = (current & former) | frozenset(sorted(current - former)[:1])  # each join uses up one
            self._blocked_ns[name] = 0

    def _check(self, name: str, wall_ns: int) -> None:
        """Admit a withheld join once its process is proved to exist; reject it after its time limit."""
        withheld = self._withheld[name]
        join = withheld.join
        if self._needs_no_proof(name, join) or self._may_replace(name, withheld, wall_ns):
            self._admit(name, join, wall_ns)
            return
        fault = NO_DONE if self._tokens.is_alive(name) else NO_TOKEN
        if wall_ns - withheld.since_ns >= (FIRST_DONE_NS if fault == NO_DONE else TOKEN_NS):
            del self._withheld[name]
            self._run.call("falsely_joined", name, join, fault)

    def _may_replace(self, name: str, withheld: _Withheld, wall_ns: int) -> bool:
        """Return whether a join may replace a process: the new one is proved, or the former one is gone or stuck."""
        if self._is_stranger(name, withheld.join):
            return False
        if self._trusts or withheld.has_done or self._tokens.sessions(name) - self._sessions.get(name, Sessions()):
            return True
        former = self._barrier.participants.get(name)
        if former is None or not former.alive:
            return self._tokens.is_alive(name)
        held_up = former in self._world.blocking_clock() and wall_ns - former.since_wall_ns >= BLOCKED_MIN_NS
        return held_up or former.silent_wall_ns is not None

    def _count_blocked(self, passed_ns: int, wall_ns: int) -> None:
        """Count how long participants have owed their first done, and report those that exceed the limit.

        In lockstep, time counts only while the world waits for no other process, since that may be the cause; in
        realtime, it counts whenever a done is due and time runs.
        """
        clock = self._world.clock
        if clock.mode == "realtime":
            due = self._world.blocking() if clock.state == "running" and not clock.is_halted else ()
            owing = [p for p in due if p.alive and p.name in self._blocked_ns and _owes_done(p)]
        else:
            owing = self._world.blocking_clock()
        if any(p.name not in self._blocked_ns or not _owes_done(p) for p in owing):
            return
        for participant in owing:
            if not self._world.must_wait_for(participant):
                self._blocked_ns[participant.name] += passed_ns
                if self._blocked_ns[participant.name] >= DONE_NS:
                    self._run.call("not_shown", participant.name, NO_DONE, wall_ns)


def _owes_done(participant: Participant) -> bool:
    return participant.is_waited_for and participant.done_seq is None
