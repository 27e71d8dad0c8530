"""The participants of the lockstep, their progress, and those that the world waits for.

Pure bookkeeping without session or clock: wall times are passed in. To integrate from t, the world needs the done
message of every gating participant for t minus `RunClock.ahead_ns`, or for the end of its last period before that. The
done of a participant that does not gate but has slack may be older by the slack.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from msgspec import UNSET

from zsim.contract import keys
from zsim.contract.run_messages import Bye, Done, Join, Waiting
from zsim.contract.snapshot import Saved
from zsim.scenario.roles import WORLD
from zsim_world.run.outbox import Refusal


@dataclass
class Participant:
    """A process that has joined, in its newest incarnation."""

    name: str
    join: Join
    from_ns: int  # first gate at which the world waits for it
    done_ns: int = -1  # newest gate that it has completed
    surplus: int = 0  # outputs that have arrived since its last done
    missing: int = 0  # outputs that its dones counted but that have not arrived
    done_seq: int | None = None  # sequence number of its newest done; None before its process's first
    lost_done: bool = False  # a done was lost, and with it the count of the preceding outputs
    was_incomplete: bool = False  # outputs were missing at the last gate, in realtime
    rejoined: bool = False  # another incarnation of this name joined before
    repeats: bool = False  # it may republish outputs that were already counted
    successor: bool = False  # it replaced a living process
    alive: bool = True
    since_wall_ns: int = 0  # when it last joined, sent a done or died
    joined_wall_ns: int = 0  # when this incarnation joined
    deadline_misses: int = 0  # number of dones that were late in realtime
    away: bool = False  # it has not yet rejoined a restarted world
    silent_wall_ns: int | None = None  # when its last health message arrived, if it has been silent since
    # A bye that names no incarnation and may therefore come from another process: it takes effect when the token is
    # lost, and the next done cancels it.
    farewell: Bye | None = None

    def __str__(self) -> str:
        return f"{self.name} on {self.join.host} (pid {self.join.pid})"

    @property
    def location(self) -> dict[str, Any]:
        """The host and process id, for the data of an event."""
        return {"host": self.join.host, "pid": self.join.pid}

    @property
    def is_missed(self) -> bool:
        """Whether it is dead, silent or away."""
        return not self.alive or self.away or self.silent_wall_ns is not None

    @property
    def gating(self) -> bool:
        return self.join.period_ns > 0

    @property
    def is_waited_for(self) -> bool:
        return self.gating or self.join.slack_ns > 0

    def is_process_of(self, join: Join) -> bool:
        """Return whether another join comes from the same process, in the same role."""
        fields = ("host", "pid", "role", "period_ns", "slack_ns", "serves")
        return all(getattr(self.join, name) == getattr(join, name) for name in fields)

    @property
    def served_names(self) -> set[str]:
        return {self.name, *self.join.serves}

    @property
    def incomplete(self) -> bool:
        """Whether some of its outputs, or a done, were lost or are still in transit."""
        return self.missing > 0 or self.lost_done

    def required_ns(self, need_ns: int) -> int | None:
        """Return the gate whose done `need_ns` requires of this participant; None if none is required yet."""
        join = self.join
        if join.period_ns > 0:
            required = need_ns - need_ns % join.period_ns
        elif join.slack_ns:
            required = need_ns - join.slack_ns
        else:
            return None
        return required if required >= self.from_ns else None

    def blocks(self, need_ns: int) -> bool:
        """Return whether the done required for `need_ns`, or an output counted by a done, has not arrived."""
        required = self.required_ns(need_ns)
        return required is not None and (self.done_ns < required or self.incomplete)

    def reset_counts(self) -> int:
        """Reset the counts after lost outputs were requested again; return how many are still missing.

        A remaining surplus would hide the next loss: no outputs of the next done arrive while some are missing.
        Outputs repeated after a rejoin may have been counted before; those are not missing.
        """
        missing = 0 if self.repeats else self.missing
        self.missing, self.surplus, self.lost_done, self.repeats = 0, 0, False, False
        return missing

    def waiting(self, wall_ns: int, held_by: tuple[str, ...] = (), since_ns: int | None = None) -> Waiting:
        """Return its entry in `clock`; `since_ns`: start of the wait, by default the last done, join or death."""
        since_ns = self.since_wall_ns if since_ns is None else since_ns
        return Waiting(self.name, self.join.host, (wall_ns - since_ns) / 1e9, held_by)


class Barrier:
    """The participants of a run.

    Args:
        run_id: id of this run; joins and dones of other runs are refused.
        gate_ns: gate interval [ns]; every period is a multiple of it.
        expected: names of the processes required at the start.
    """

    SAVED: ClassVar[Saved] = {"_expected": list[str], "participants": dict[str, Participant]}

    def __init__(self, run_id: str, gate_ns: int, expected: list[str]) -> None:
        self._run_id = run_id
        self._gate_ns = gate_ns
        self._expected = [*dict.fromkeys(expected)]
        self.participants: dict[str, Participant] = {}

    def expect(self, name: str) -> None:
        if name not in self._expected:
            self._expected.append(name)

    # Joins

    def join(self, name: str, message: Join, next_gate_ns: int, wall_ns: int) -> Refusal | None:
        """Admit a participant; return the refusal, or None.

        A new incarnation of a known name continues from the progress of the former one; likewise, a participant that
        does all the work of dead participants replaces them and continues from theirs. A repeated join only shows that
        the participant is not away.
        """
        if refusal := self.join_refusal(name, message):
            return refusal
        former = self.participants.get(name)
        if former is not None and former.alive and former.join.incarnation == message.incarnation:
            former.away = False
            return None
        replaced = self.replaced(name, message)
        for dead in replaced:
            del self.participants[dead.name]
        predecessors = [*([former] if former else []), *replaced]
        self.participants[name] = Participant(
            name=name,
            join=message,
            from_ns=min((each.from_ns for each in predecessors if each.is_waited_for), default=next_gate_ns),
            done_ns=min((each.done_ns for each in predecessors), default=-1),
            since_wall_ns=wall_ns,
            joined_wall_ns=wall_ns,
            deadline_misses=former.deadline_misses if former else 0,
            done_seq=former.done_seq if former and former.is_process_of(message) else None,
            rejoined=former is not None,
            repeats=former is not None,
            successor=former is not None and former.alive and not former.is_process_of(message),
        )
        return None

    def would_replace(self, name: str, message: Join) -> bool:
        """Return whether a join would replace another process."""
        if self.join_refusal(name, message):
            return False
        former = self.participants.get(name)
        return (former is not None and not former.is_process_of(message)) or bool(self.replaced(name, message))

    def replaced(self, name: str, message: Join) -> list[Participant]:
        """Return the dead participants whose work a newcomer with another name would take over."""
        served = {name, *message.serves}
        return [p for p in self.participants.values() if not p.alive and p.name != name and p.served_names <= served]

    def join_refusal(self, name: str, message: Join) -> Refusal | None:
        """Return the refusal of a join that does not fit this run, or None."""
        if name == WORLD or not keys.PROCESS_NAME.fullmatch(name):
            return Refusal("name", repr(name[:60]), f"must be a role, a dot and a name of a-z 0-9 _ . -, not {WORLD!r}")
        if message.run_id != self._run_id:
            return self._run_id_refusal(message.run_id)
        if message.period_ns < 0 or message.period_ns % self._gate_ns:
            return Refusal("period_ns", str(message.period_ns), f"must be 0 or a multiple of {self._gate_ns}")
        return None

    def _run_id_refusal(self, run_id: str) -> Refusal:
        return Refusal("run_id", repr(run_id[:40]), f"must be {self._run_id!r} (read world/info)")

    # Dones, outputs and byes

    def done(self, name: str, message: Done, now_ns: int, wall_ns: int) -> Refusal | None:
        """Note that a participant has completed the gate `done_ns` of its message; return the refusal, or None.

        A gap in the sequence numbers shows that a done was lost. Outputs beyond its `sent` belong to the next done.
        """
        participant = self.participants.get(name)
        if participant is None:
            return Refusal("join", "missing", f"must publish process/{name}/join first")
        if message.run_id != self._run_id:
            return self._run_id_refusal(message.run_id)
        former = participant.done_seq
        if message.incarnation != participant.join.incarnation:
            if former is not None and message.seq == former + 1:  # this done was refused, not lost
                participant.done_seq = message.seq
            return _incarnation_refusal(participant, str(message.incarnation))
        if message.done_ns > now_ns:
            return Refusal("done_ns", str(message.done_ns), f"must be <= {now_ns}, the newest gate")
        participant.away = False
        if message.done_ns > participant.done_ns:
            participant.done_ns = message.done_ns
            participant.since_wall_ns = wall_ns
        if participant.gating and former is not None and message.seq > former + 1:
            participant.lost_done = True
        participant.done_seq = message.seq if former is None else max(message.seq, former)
        balance = participant.surplus - participant.missing - message.sent
        participant.surplus, participant.missing = max(0, balance), max(0, -balance)
        return None

    def count_output(self, name: str) -> None:
        """Count an output from a participant, or from a process whose work a participant does."""
        participant = self.participants.get(name)
        if participant is None:
            participant = next((each for each in self.participants.values() if name in each.join.serves), None)
        if participant is None:
            return
        if participant.missing:
            participant.missing -= 1
        else:
            participant.surplus += 1

    def give_up_late(self) -> None:
        """At a gate in realtime, treat outputs that were already missing at the previous gate as lost.

        They are not requested again; still expecting them would make every later gate a deadline miss of their sender.
        """
        for participant in self.participants.values():
            if participant.incomplete and participant.was_incomplete:
                participant.reset_counts()
            participant.was_incomplete = participant.incomplete

    def bye_refusal(self, participant: Participant, message: Bye) -> Refusal | None:
        """Return the refusal of a bye that names another run or incarnation, or None."""
        if message.run_id not in (UNSET, self._run_id):
            return self._run_id_refusal(str(message.run_id))
        if message.incarnation not in (UNSET, participant.join.incarnation):
            return _incarnation_refusal(participant, str(message.incarnation))
        return None

    def has_farewell(self, name: str) -> bool:
        """Return whether a participant leaves as soon as its token is lost."""
        participant = self.participants.get(name)
        return participant is not None and participant.farewell is not None

    def retract_bye(self, name: str) -> Refusal | None:
        """Drop the bye that another process sent for a participant that continues; return its refusal, or None."""
        participant = self.participants[name]
        if participant.farewell is None:
            return None
        participant.farewell = None
        return _incarnation_refusal(participant, "missing")

    def remove(self, name: str) -> None:
        """Remove a participant that has said bye or is dropped, and stop expecting it."""
        removed = self.participants.pop(name, None)
        removed_names = (name, *(removed.join.serves if removed else ()))
        self._expected = [expected for expected in self._expected if expected not in removed_names]

    # Losses

    def mark_dead(self, name: str, wall_ns: int) -> Participant | None:
        """Mark a participant as dead, once; it stays until it is removed or rejoins."""
        participant = self.participants.get(name)
        if participant is None or not participant.alive:
            return None
        participant.alive = participant.away = False
        participant.since_wall_ns = wall_ns
        return participant

    def await_return(self, wall_ns: int, all_died: bool) -> None:
        """In a restarted world, mark awaited participants as away until they rejoin; with `all_died`, all are dead."""
        for participant in self.participants.values():
            participant.since_wall_ns = participant.joined_wall_ns = wall_ns
            participant.alive = participant.alive and not all_died
            participant.away = participant.is_waited_for and (participant.alive or all_died)

    # Presence and waiting

    def is_gating(self, name: str) -> bool:
        """Return whether a process gates, even if it is marked dead: its outputs may arrive before it rejoins."""
        participant = self.participants.get(name)
        return participant is not None and participant.gating

    def substitute(self, name: str) -> Participant | None:
        """Return a living participant that also does all the work of this one, or None."""
        served = self.participants[name].served_names
        others = (p for p in self.participants.values() if p.name != name and p.alive)
        return next((p for p in others if served <= p.served_names), None)

    def duplicates(self, name: str) -> dict[str, set[str]]:
        """Return the names that other living participants serve in common with this one, by participant."""
        served = self.participants[name].served_names
        others = (p for p in self.participants.values() if p.name != name and p.alive)
        return {p.name: shared for p in others if (shared := served & p.served_names)}

    def absent(self) -> list[str]:
        """Return the expected names that have not joined yet."""
        present = {name for p in self.participants.values() for name in p.served_names}
        return [name for name in self._expected if name not in present]

    def away(self) -> list[Participant]:
        """Return the participants that have not yet rejoined a restarted world."""
        return [p for p in self.participants.values() if p.away]

    def blocking(self, need_ns: int) -> list[Participant]:
        """Return the participants whose done for `need_ns`, or an output counted by a done, has not arrived."""
        return [p for p in self.participants.values() if p.blocks(need_ns)]

    def incomplete(self) -> list[Participant]:
        """Return the participants with outputs or a done that were lost or are still in transit."""
        return [p for p in self.participants.values() if p.incomplete]

    def waiting_for(
        self, need_ns: int, wall_ns: int, start_wall_ns: int, feeds: Callable[[str, str], bool]
    ) -> tuple[Waiting, ...]:
        """Return the processes that the world waits for, as entries of `clock`.

        Absent ones come first, then the dead, then the others, those waited for longest first. `feeds(writer, reader)`
        returns whether the reader may be waiting for the writer's outputs.
        """
        absent = [Waiting(name, "", (wall_ns - start_wall_ns) / 1e9) for name in self.absent()]
        rank = {name: index for index, name in enumerate(self._expected)}
        awaited = {p.name: p for p in (*self.away(), *self.blocking(need_ns))}.values()
        blockers = sorted(awaited, key=lambda p: (p.alive, p.since_wall_ns, rank.get(p.name, len(rank))))
        waiting = []
        for victim in blockers:  # which may itself be waiting for outputs of other late participants
            read_by = victim.served_names if victim.gating and victim.alive and not victim.away else ()
            others = (p for p in blockers if p is not victim and p.gating)
            held_by = (p.name for p in others if any(feeds(w, r) for w in p.served_names for r in read_by))
            waiting.append(victim.waiting(wall_ns, tuple(held_by)))
        return (*absent, *waiting)


def _incarnation_refusal(participant: Participant, actual: str) -> Refusal:
    return Refusal("incarnation", actual, f"must be {participant.join.incarnation}, the newest to join")
