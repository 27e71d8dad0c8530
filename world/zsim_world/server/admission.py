"""Whose join counts: who takes another's place has a token of its own; who joins has one, and publishes a done.

A join is only a message, which anybody can publish in any name. A token goes with a session: Zenoh knows whose it is.
"""

from typing import NamedTuple

from zsim.contract import keys, messages
from zsim.contract.run_messages import Join
from zsim.transport.admin_space import AdminSpace
from zsim_world.flight.barrier import Participant
from zsim_world.flight.coordinator import Coordinator
from zsim_world.journal.journal_entries import Entry, FalselyJoined, Joined, NotShown
from zsim_world.journal.run_journal import RunJournal

TOKEN_NS = 3_000_000_000  # wall time by which a token is there; the hub knows one behind routers within 1 s (measured)
DONE_NS = 10_000_000_000  # wall time that time may stand for one that never published a done; first steps take 1 s
LOOK_NS = 200_000_000  # wall time between two looks at those who still have to show that they are there
NO_TOKEN = "has no liveliness token of its own"
NO_DONE = "has never published a done"

Holders = frozenset[str]  # sessions, by Zenoh's names


class _Withheld(NamedTuple):
    """A join in another's place, and the wall time until which its token may come."""

    join: Join
    until_ns: int


class Admission:
    """Hands the joins to a world, and tells it of those behind which nobody is.

    Args:
        space: knows who holds which token.
        world: that is joined.
        trusts: whether access control lets nobody join in another's name.
        journal: of what the world is handed.
    """

    def __init__(self, space: AdminSpace, world: Coordinator, trusts: bool, journal: RunJournal | None = None) -> None:
        self._journal = journal or RunJournal(None)
        self._space = space
        self._world = world
        self._barrier = world.barrier
        self._trusts = trusts
        self._holders: dict[str, Holders] = {}  # of the tokens by which somebody takes part, or did
        self._withheld: dict[str, _Withheld] = {}
        self._standing_ns: dict[str, int] = {}  # of those without a token or a done so far: how long time stood for it
        self._look_wall_ns = 0

    def take(self, name: str, join: Join, wall_ns: int) -> None:
        """Take a join, or withhold it until its token is there."""
        if self._trusts or not self._barrier.takes_place(name, join):
            self._admit(name, join, wall_ns)
        elif not self._admit_holder(name, join, self._token_holders(), wall_ns):
            former = self._withheld.get(name)
            self._withheld[name] = _Withheld(join, former.until_ns if former else wall_ns + TOKEN_NS)

    def _admit_holder(self, name: str, join: Join, holders: dict[str, Holders], wall_ns: int) -> bool:
        """Take a join in the place of another if a session has a token for it; each session can do so once."""
        present, former = holders.get(name, Holders()), self._holders.get(name, Holders())
        if not present - former:
            return False
        self._admit(name, join, wall_ns)
        self._holders[name] = (present & former) | {min(present - former)}
        return True

    def _admit(self, name: str, join: Join, wall_ns: int) -> None:
        self._withheld.pop(name, None)
        if name not in self._barrier.participants:
            self._holders.pop(name, None)
        self._world.handle(keys.process(name, "join"), join, wall_ns)
        self._note(Joined(wall_ns, name, messages.encode(join)))
        participant = self._barrier.participants.get(name)
        if participant is not None and participant.join is join:
            self._standing_ns[name] = 0

    def _token_holders(self) -> dict[str, Holders]:
        found = self._space.token_holders(keys.token("*"))
        return {keys.thing(key): sessions for key, sessions in found.items() if sessions}

    def check_due(self, wall_ns: int) -> None:
        """Look at those who still have to show that they are there."""
        passed_ns = wall_ns - self._look_wall_ns
        if passed_ns < LOOK_NS or not (self._withheld or self._standing_ns):
            return
        self._look_wall_ns = wall_ns
        holders = {} if self._trusts else self._token_holders()
        self._check_withheld(holders, wall_ns)
        self._check_admitted(holders, wall_ns)
        self._count_standing(min(passed_ns, 2 * LOOK_NS), wall_ns)

    def _check_withheld(self, holders: dict[str, Holders], wall_ns: int) -> None:
        for name, (join, until_ns) in list(self._withheld.items()):
            if not self._barrier.takes_place(name, join):
                self._admit(name, join, wall_ns)
            elif not self._admit_holder(name, join, holders, wall_ns) and wall_ns >= until_ns:
                del self._withheld[name]
                self._world.handle_false_join(name, join, NO_TOKEN)
                self._note(FalselyJoined(name, messages.encode(join), NO_TOKEN))

    def _check_admitted(self, holders: dict[str, Holders], wall_ns: int) -> None:
        """Note who has a token, and tell the world of those who have had the time and have none."""
        for name in list(self._standing_ns):
            participant = self._barrier.participants.get(name)
            if participant is None or not participant.alive:
                del self._standing_ns[name]
                continue
            self._holders[name] = self._holders.get(name) or holders.get(name, Holders())
            has_token = bool(self._trusts or self._holders[name])
            if has_token and not _owes_done(participant):
                del self._standing_ns[name]
            elif not has_token and wall_ns - participant.joined_wall_ns >= TOKEN_NS:
                self._handle_no_show(name, NO_TOKEN, wall_ns)

    def _count_standing(self, passed_ns: int, wall_ns: int) -> None:
        """Count how long time stands for nobody but those that have never published a done, as victims may have not."""
        blocking = self._world.standing_for()
        if not blocking or any(p.name not in self._standing_ns or not _owes_done(p) for p in blocking):
            return
        for participant in blocking:
            if not self._world.must_wait_for(participant):
                self._standing_ns[participant.name] += passed_ns
                if self._standing_ns[participant.name] >= DONE_NS:
                    self._handle_no_show(participant.name, NO_DONE, wall_ns)

    def _handle_no_show(self, name: str, reason: str, wall_ns: int) -> None:
        self._world.handle_no_show(name, reason, wall_ns)
        self._note(NotShown(wall_ns, name, reason))

    def _note(self, entry: Entry) -> None:
        if self._world.ended is None:
            self._journal.note(entry)


def _owes_done(participant: Participant) -> bool:
    return participant.is_waited_for and participant.done_seq is None
