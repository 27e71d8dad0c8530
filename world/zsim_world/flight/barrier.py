"""Who takes part in the lockstep, how far each has come, and whom the world waits for.

Pure bookkeeping: no session, no clock; wall times are passed in. To integrate from t on, the world needs
every gating participant's done for t minus the command delay. That is the only wait there is.
"""

from dataclasses import dataclass

from zsim.contract import keys
from zsim.contract.messages import Done, Join, Waiting
from zsim.scenario.rights import WORLD


@dataclass
class Participant:
    """One process that has joined, by its newest incarnation.

    Attributes:
        from_ns: first gate that it is waited for.
        serves: names of expected processes for which it stands.
        done_ns: newest gate that it is through with.
        received: outputs that came in since its last done.
        missing: outputs that it counted in its dones and that have not come in.
        done_seq: number of its newest done, None before the first of its process.
        doubtful: whether a done was lost, and with it the count of what else was.
        again: whether another incarnation of its name was there before.
        since_wall_ns: when it was last heard of: join, done or death.
        joined_wall_ns: when this incarnation joined.
    """

    name: str
    incarnation: int
    role: str
    host: str
    pid: int
    period_ns: int
    fingerprint: str
    from_ns: int
    serves: tuple[str, ...] = ()
    done_ns: int = -1
    received: int = 0
    missing: int = 0
    done_seq: int | None = None
    doubtful: bool = False
    again: bool = False
    alive: bool = True
    since_wall_ns: int = 0
    joined_wall_ns: int = 0
    deadline_misses: int = 0

    @property
    def gating(self) -> bool:
        return self.period_ns > 0

    @property
    def duties(self) -> set[str]:
        """Return the names of the processes whose work it does."""
        return {self.name, *self.serves}

    def required_ns(self, need_ns: int) -> int | None:
        """Return the done that it owes for `need_ns`, None if it owes none yet."""
        if not self.gating:
            return None
        required = need_ns // self.period_ns * self.period_ns
        return required if required >= self.from_ns else None

    def number(self, seq: int) -> None:
        """Take the number of a done; a gap shows that one was lost."""
        if self.done_seq is not None and seq > self.done_seq + 1:
            self.doubtful = True
        self.done_seq = seq if self.done_seq is None else max(seq, self.done_seq)

    def refuse(self, seq: int) -> None:
        """Take the number of a done that is refused, if it is the next of the same process: it was not lost."""
        if self.done_seq is not None and seq == self.done_seq + 1:
            self.done_seq = seq

    def settle(self, sent: int) -> None:
        """Set what a done counts against what came in; a surplus belongs to the next done."""
        balance = self.received - self.missing - sent
        self.received, self.missing = max(0, balance), max(0, -balance)

    def write_off(self) -> int:
        """Close the account of outputs, once it was asked for them again; return how many are missing for good.

        A surplus would hide the next loss: outputs that belong to the next done do not come while some are missing.
        """
        missing, self.missing, self.received, self.doubtful = self.missing, 0, 0, False
        return missing

    def owes(self, need_ns: int) -> bool:
        """Tell whether its done (or an output that it counted) is not in yet."""
        required = self.required_ns(need_ns)
        return required is not None and (self.done_ns < required or self.missing > 0 or self.doubtful)


class Barrier:
    """The participants of a run.

    Args:
        run_id: joins and dones of other runs are refused.
        gate_ns: every period is a multiple of it.
        expected: names without which the run does not start.
    """

    def __init__(self, run_id: str, gate_ns: int, expected: list[str]) -> None:
        self._run_id = run_id
        self._gate_ns = gate_ns
        self._expected = dict.fromkeys(expected, 0)
        self.participants: dict[str, Participant] = {}

    def expect(self, name: str) -> None:
        """Do not start without this one either."""
        self._expected[name] = 0

    def join(self, name: str, message: Join, next_gate_ns: int, wall_ns: int) -> str | None:
        """Take a participant in; return the reason if it is refused.

        A known name keeps what it has done: the new incarnation goes on from there. So does a participant that does
        all the work of others that are dead: it takes their place. The same join again changes nothing.
        """
        reason = self._join_fault(name, message)
        if reason:
            return reason
        former = self.participants.get(name)
        if former is not None and former.alive and former.incarnation == message.incarnation:
            return None
        replaced = self.replaced(name, message)
        for gone in replaced:
            del self.participants[gone.name]
        before = [*([former] if former else []), *replaced]
        self.participants[name] = Participant(
            name=name,
            incarnation=message.incarnation,
            role=message.role,
            host=message.host,
            pid=message.pid,
            period_ns=message.period_ns,
            fingerprint=message.fingerprint,
            from_ns=min((each.from_ns for each in before if each.gating), default=next_gate_ns),
            serves=message.serves,
            done_ns=min((each.done_ns for each in before), default=-1),
            since_wall_ns=wall_ns,
            joined_wall_ns=wall_ns,
            deadline_misses=former.deadline_misses if former else 0,
            done_seq=former.done_seq if former and (former.host, former.pid) == (message.host, message.pid) else None,
            again=former is not None,
        )
        return None

    def replaced(self, name: str, message: Join) -> list[Participant]:
        """Return the dead whose work a newcomer of another name is to do."""
        duties = {name, *message.serves}
        return [p for p in self.participants.values() if not p.alive and p.name != name and p.duties <= duties]

    def _join_fault(self, name: str, message: Join) -> str | None:
        if name == WORLD or not keys.PROCESS_NAME.fullmatch(name):
            return f"name is {name[:60]!r}; must be a role, a dot and a name of a-z 0-9 _ . -, not {WORLD!r}"
        if message.run_id != self._run_id:
            return f"run_id is {message.run_id[:40]!r}; must be {self._run_id!r} (read world/info)"
        if message.period_ns < 0 or message.period_ns % self._gate_ns:
            return f"period_ns is {message.period_ns}; must be 0 or a multiple of {self._gate_ns}"
        return None

    def done(self, name: str, message: Done, now_ns: int, wall_ns: int) -> str | None:
        """Note that a participant is through with `done_ns`; return the reason if it is refused."""
        participant = self.participants.get(name)
        if participant is None:
            return f"has not joined; must publish process/{name}/join first"
        if message.run_id != self._run_id:
            return f"run_id is {message.run_id[:40]!r}; must be {self._run_id!r} (read world/info)"
        if message.incarnation != participant.incarnation:
            participant.refuse(message.seq)
            return f"incarnation is {message.incarnation}; must be {participant.incarnation}, the newest to join"
        if message.done_ns > now_ns:
            return f"done_ns is {message.done_ns}; must be <= {now_ns}, the newest gate"
        if message.done_ns > participant.done_ns:
            participant.done_ns = message.done_ns
            participant.since_wall_ns = wall_ns
        participant.number(message.seq)
        participant.settle(message.sent)
        return None

    def received(self, name: str) -> None:
        """Count one output of a participant that has come in."""
        participant = self.participants.get(name)
        if participant is not None:
            if participant.missing:
                participant.missing -= 1
            else:
                participant.received += 1

    def is_gating(self, name: str) -> bool:
        """Tell whether a process is waited for, also one that seems dead: what it sent may come before its return."""
        participant = self.participants.get(name)
        return participant is not None and participant.gating

    def died(self, name: str, wall_ns: int) -> Participant | None:
        """Mark a participant as dead; it stays in the barrier until it is dropped or rejoins."""
        participant = self.participants.get(name)
        if participant is None or not participant.alive:
            return None
        participant.alive = False
        participant.since_wall_ns = wall_ns
        return participant

    def stand_in(self, name: str) -> Participant | None:
        """Return who lives and does all the work of a participant beside its own."""
        duties = self.participants[name].duties
        others = (p for p in self.participants.values() if p.name != name and p.alive)
        return next((p for p in others if duties <= p.duties), None)

    def doubles(self, name: str) -> dict[str, set[str]]:
        """Return whose work a participant does that others who live do as well, by their names."""
        mine = self.participants[name].duties
        others = (p for p in self.participants.values() if p.name != name and p.alive)
        return {p.name: both for p in others if (both := mine & p.duties)}

    def remove(self, name: str) -> Participant | None:
        """Take a participant out: it said bye or is dropped."""
        removed = self.participants.pop(name, None)
        for gone in (name, *(removed.serves if removed else ())):
            self._expected.pop(gone, None)
        return removed

    def absent(self) -> list[str]:
        """Return the expected names that have not joined yet."""
        there = {each for p in self.participants.values() for each in (p.name, *p.serves)}
        return [name for name in self._expected if name not in there]

    def blocking(self, need_ns: int) -> list[Participant]:
        """Return who owes a done for `need_ns`."""
        return [p for p in self.participants.values() if p.owes(need_ns)]

    def short(self) -> list[Participant]:
        """Return who counted more outputs in its done than have come in, or of whom a done was lost."""
        return [p for p in self.participants.values() if p.missing or p.doubtful]

    def waiting_for(self, need_ns: int, wall_ns: int, start_wall_ns: int) -> tuple[Waiting, ...]:
        """Return whom the world waits for, as `clock` names them: first the dead, then who is silent for longest.

        Who only waits for another's outputs spoke after that one, and is expected after it.
        """
        absent = [Waiting(name, "", (wall_ns - start_wall_ns) / 1e9) for name in self.absent()]
        rank = {name: place for place, name in enumerate(self._expected)}
        owing = sorted(self.blocking(need_ns), key=lambda p: (p.alive, p.since_wall_ns, rank.get(p.name, len(rank))))
        late = [Waiting(p.name, p.host, (wall_ns - p.since_wall_ns) / 1e9) for p in owing]
        return (*absent, *late)
