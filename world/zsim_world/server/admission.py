"""Whose join counts: who takes the place of one that lives shows that it is there; who joins has a token and a done.

A join is only a message, which anybody can publish in any name. What shows that a process is there is a token of its
own session, or, of a program that has none of these, the done that follows the join. Time never stands for a stranger
without a token: under fresh names many of them would stop it for good.
"""

from dataclasses import dataclass

from zsim.contract import keys, messages
from zsim.contract.run_messages import Join
from zsim.transport.link_watch import Sessions, SessionTokens
from zsim_world.flight.barrier import Participant
from zsim_world.flight.coordinator import Coordinator
from zsim_world.journal.journal_entries import Entry, FalselyJoined, Joined, NotShown
from zsim_world.journal.run_journal import RunJournal

TOKEN_NS = 3_000_000_000  # wall time by which a token is there; the hub knows one behind routers within 1 s (measured)
SHOWN_NS = 10_000_000_000  # wall time by which one whose token is not its own publishes a done; first steps take 1 s
HELD_NS = 1_000_000_000  # wall time that time stands for one that lives from which on another may take its place
DONE_NS = 10_000_000_000  # wall time that time may stand for one that never published a done; first steps take 1 s
LOOK_NS = 200_000_000  # wall time between two looks at those who still have to show that they are there
NO_TOKEN = "has no liveliness token"
WITHHELD_MAX = 1000  # joins of strangers that wait for their tokens
NO_DONE = "has never published a done"


@dataclass
class _Withheld:
    """A join in another's place, or of a stranger; since when there is one, and whether a done has followed it."""

    join: Join
    since_ns: int
    has_done: bool = False


class Admission:
    """Hands the joins to a world, and tells it of those behind which nobody is.

    Args:
        tokens: of all processes.
        world: that is joined.
        trusts: whether access control lets nobody join in another's name.
        journal: of what the world is handed.
    """

    def __init__(
        self, tokens: SessionTokens, world: Coordinator, trusts: bool, journal: RunJournal | None = None
    ) -> None:
        self._journal = journal or RunJournal(None)
        self._tokens = tokens
        self._world = world
        self._barrier = world.barrier
        self._trusts = trusts
        self._sessions: dict[str, Sessions] = {}  # by whose tokens somebody takes part, or did
        self._withheld: dict[str, _Withheld] = {}
        self._standing_ns: dict[str, int] = {}  # of those without a token or a done so far: how long time stood for it
        self._look_wall_ns = 0

    def take(self, name: str, join: Join, wall_ns: int) -> None:
        """Take a join, or withhold it until it is clear that somebody is behind it."""
        if self._is_clear(name, join):
            self._admit(name, join, wall_ns)
            return
        former = self._withheld.get(name)
        if former is None and len(self._withheld) >= WITHHELD_MAX and name not in self._barrier.participants:
            self._handle_false_join(name, join, NO_TOKEN)
            return
        self._withheld[name] = _Withheld(join, former.since_ns if former else wall_ns)
        self._check(name, wall_ns)

    def _is_clear(self, name: str, join: Join) -> bool:
        """Tell whether a join costs nobody his place, and time nothing, though nobody may be behind it."""
        return not (self._barrier.takes_place(name, join) or self._is_stranger(name, join))

    def _is_stranger(self, name: str, join: Join) -> bool:
        """Tell whether time would stand for a newcomer that the start does not wait for, and that has no token."""
        stands = (join.period_ns > 0 or join.slack_ns > 0) and self._barrier.accepts(name, join)
        if not stands or name in self._barrier.participants:
            return False
        return not (self._trusts or name in self._barrier.absent() or self._tokens.is_alive(name))

    def done_received(self, name: str, incarnation: int, wall_ns: int) -> None:
        """Take the news that a process has published a done, before the world has it."""
        withheld = self._withheld.get(name)
        if withheld is not None and withheld.join.incarnation == incarnation:
            withheld.has_done = True
            self._check(name, wall_ns)

    def _admit(self, name: str, join: Join, wall_ns: int) -> None:
        self._withheld.pop(name, None)
        former, present = self._sessions.get(name, Sessions()), self._tokens.sessions(name)
        if name not in self._barrier.participants:
            former = Sessions()
        self._world.handle(keys.process(name, "join"), join, wall_ns)
        self._note(Joined(wall_ns, name, messages.encode(join)))
        participant = self._barrier.participants.get(name)
        if participant is not None and participant.join is join:
            self._sessions[name] = (present & former) | frozenset(sorted(present - former)[:1])  # one for each join
            self._standing_ns[name] = 0

    def check_due(self, wall_ns: int) -> None:
        """Look at those who still have to show that they are there."""
        passed_ns = wall_ns - self._look_wall_ns
        if passed_ns < LOOK_NS or not (self._withheld or self._standing_ns):
            return
        self._look_wall_ns = wall_ns
        self._check_withheld(wall_ns)
        self._check_admitted(wall_ns)
        self._count_standing(min(passed_ns, 2 * LOOK_NS), wall_ns)

    def _check_withheld(self, wall_ns: int) -> None:
        for name in list(self._withheld):
            self._check(name, wall_ns)

    def _check(self, name: str, wall_ns: int) -> None:
        """Admit a join that was withheld, once it may be, or give it up after its time."""
        withheld = self._withheld[name]
        join = withheld.join
        if self._is_clear(name, join) or self._may_take_place(name, withheld, wall_ns):
            self._admit(name, join, wall_ns)
            return
        reason = NO_DONE if self._tokens.is_alive(name) else NO_TOKEN
        if wall_ns - withheld.since_ns >= (SHOWN_NS if reason == NO_DONE else TOKEN_NS):
            del self._withheld[name]
            self._handle_false_join(name, join, reason)

    def _handle_false_join(self, name: str, join: Join, reason: str) -> None:
        self._world.losses.falsely_joined(name, join, reason)
        self._note(FalselyJoined(name, messages.encode(join), reason))

    def _may_take_place(self, name: str, withheld: _Withheld, wall_ns: int) -> bool:
        """Tell whether somebody is behind a join in the place of another, or the other is not there any more."""
        if self._is_stranger(name, withheld.join):
            return False
        if self._trusts or withheld.has_done or self._tokens.sessions(name) - self._sessions.get(name, Sessions()):
            return True
        former = self._barrier.participants.get(name)
        if former is None or not former.alive:
            return self._tokens.is_alive(name)
        held_up = former in self._world.standing_for() and wall_ns - former.since_wall_ns >= HELD_NS
        return held_up or former.silent_wall_ns is not None

    def _check_admitted(self, wall_ns: int) -> None:
        """Note who has a token, and tell the world of those who have had the time and have none."""
        for name in list(self._standing_ns):
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                del self._standing_ns[name]
                continue
            self._sessions[name] = self._sessions.get(name) or self._tokens.sessions(name)
            has_token = self._trusts or self._tokens.is_alive(name)
            if has_token and not _owes_done(participant):
                del self._standing_ns[name]
            elif not has_token and wall_ns - participant.joined_wall_ns >= TOKEN_NS:
                self._handle_no_show(name, NO_TOKEN, wall_ns)

    def _count_standing(self, passed_ns: int, wall_ns: int) -> None:
        """Count how long those have owed their first done that never published one, and drop them in the end.

        In lockstep only while time stands for nobody else, as victims of others may not have published any; in
        realtime, where time stands for nobody, all the time.
        """
        owing = self._owing() if self._world.clock.mode == "realtime" else self._world.standing_for()
        if any(p.name not in self._standing_ns or not _owes_done(p) for p in owing):
            return
        for participant in owing:
            if not self._world.must_wait_for(participant):
                self._standing_ns[participant.name] += passed_ns
                if self._standing_ns[participant.name] >= DONE_NS:
                    self._handle_no_show(participant.name, NO_DONE, wall_ns)

    def _owing(self) -> list[Participant]:
        """Return, in realtime, whose first done is due while time runs."""
        clock = self._world.clock
        runs = clock.state == "running" and not clock.is_halted
        due = self._world.blocking() if runs else ()
        return [p for p in due if p.alive and p.name in self._standing_ns and _owes_done(p)]

    def _handle_no_show(self, name: str, reason: str, wall_ns: int) -> None:
        self._world.losses.not_shown(name, reason, wall_ns)
        self._note(NotShown(wall_ns, name, reason))

    def _note(self, entry: Entry) -> None:
        if self._world.ended is None:
            self._journal.note(entry)


def _owes_done(participant: Participant) -> bool:
    return participant.is_waited_for and participant.done_seq is None
