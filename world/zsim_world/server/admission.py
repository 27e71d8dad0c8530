"""Admission of joins: who replaces a living process has to prove that it exists, and so has every newcomer.

A join is only a message, which anybody can publish under any name. A process proves that it exists by a liveliness
token of its own session, or, if it is a program without one, by the done that follows its join. Time never waits for a
stranger without a token: somebody who joins under ever new names could stop it for good.
"""

from dataclasses import dataclass

from zsim.contract.run_messages import Join
from zsim.transport.link_watch import Sessions, SessionTokens
from zsim_world.run.barrier import Participant
from zsim_world.run.inputs import Run

TOKEN_NS = 3_000_000_000  # wall time by which a token is there; the hub knows one behind routers within 1 s (measured)
SHOWN_NS = 10_000_000_000  # wall time by which one whose token is not its own publishes a done; first steps take 1 s
HELD_NS = 1_000_000_000  # wall time that time has to stand for a living process before another may replace it
DONE_NS = 10_000_000_000  # wall time that time may stand for one that never published a done; first steps take 1 s
LOOK_NS = 200_000_000  # wall time between two checks of those that still have to prove that they exist
WITHHELD_MAX = 1000  # joins of strangers that wait for their tokens
NO_TOKEN = "has no liveliness token"
NO_DONE = "has never published a done"


@dataclass
class _Withheld:
    """A join that waits for a proof; since when the name has one, and whether a done has followed it."""

    join: Join
    since_ns: int
    has_done: bool = False


class Admission:
    """Passes joins to a world, and reports those without a process behind them.

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
