"""A replay: the hub of a run that was flown before, which says again what stands in its record.

It does everything else that a world does: it keeps time, waits for who takes part, answers for the last values,
and is paused, stepped and stopped. Nobody can be flown.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
import numpy as np

from zsim.contract import keys, messages
from zsim.contract.framing import KINDS, GateMessages, key_table
from zsim.contract.messages import ControlAnswer, ControlRequest
from zsim.errors import DecodeError, RecordError
from zsim.record import Recorded, RecordReader
from zsim.runtime.agent import Output
from zsim.scenario import rights
from zsim.scenario.fault_kinds import PROCESS_KILL
from zsim.scenario.scenario import Scenario
from zsim_world.flight.barrier import Participant
from zsim_world.flight.control_requests import TimeRequests
from zsim_world.flight.coordinator import Hub
from zsim_world.playback.gate_reader import Gate, Tape
from zsim_world.playback.playback_views import Views

NOBODY = "a replay: nobody can be flown"
FLIGHT = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # what is asked of a flight alone
VIEWS = (messages.ViewDrones, messages.ViewCluster, messages.ViewEstimates)  # made here, as often as eyes can follow


class Choice(NamedTuple):
    """What is played of a record.

    Attributes:
        from_ns, to_ns: first and last gate [ns]; None for the end.
        keys: expressions; what matches none is not played.
        paused: whether it stands still after its first gate.
    """

    from_ns: int = 0
    to_ns: int | None = None
    keys: tuple[str, ...] = ("**",)
    paused: bool = False


class Playback(Hub):
    """Plays a record.

    What a process that takes part says in place of one on record (by its name: `estimator.drone1`) is not played.

    Args:
        reader: of the record; it stays open.
        scenario: the one on record.
        info: the one on record.
        choice: what is played.
        rate: simulated per wall seconds; 0 = as fast as possible.
        wall_ns: monotonic wall time.
        run_id: given by tests that compare.

    Raises:
        RecordError: there is nothing to play.
    """

    def __init__(
        self,
        reader: RecordReader,
        scenario: Scenario,
        info: messages.Info,
        choice: Choice = Choice(),  # noqa: B008 - immutable
        rate: float = 1.0,
        wall_ns: Callable[[], int] = lambda: 0,
        run_id: str | None = None,
    ) -> None:
        super().__init__(scenario, "lockstep", rate, wall_ns, run_id, [])
        self._recorded = info
        self._choice = choice
        self._requests = _Requests(self)
        self.also_asked = tuple(keys.cluster_control(cluster.name) for cluster in scenario.clusters)
        self._table = key_table(self.names)
        self._place = {key: place for place, key in enumerate(self._table)}
        self._views = Views(self.names, [cluster.name for cluster in scenario.clusters])
        self._last: dict[str, bytes] = {}
        topics = reader.topics()
        wanted = {key for key in topics if _is_played(key, choice.keys)}
        self._counts_again = any(keys.is_sensor(key) and key not in wanted for key in topics)
        self._reader = reader
        self._plays_faults = keys.FAULTS in wanted
        self._tape = Tape(reader, self.gate_ns, self.delay_ns, wanted | ({keys.VIEW_DRONES} & topics.keys()))
        self._now_ns = 0
        self._wind(choice.from_ns)
        if self._coming is None or (choice.to_ns is not None and self._coming.t_ns > choice.to_ns):
            until = "on" if choice.to_ns is None else f"to {choice.to_ns / 1e9:.12g} s"
            where = f"from {choice.from_ns / 1e9:.12g} s {until}"
            raise RecordError(f"{reader.path}: holds no gate {where}; nothing can be played")

    @property
    def now_ns(self) -> int:
        return self._now_ns

    @property
    def next_ns(self) -> int:
        return self._coming.t_ns if self._coming else self._now_ns + self.gate_ns

    def info(self) -> messages.Info:
        """Return the `world/info` on record, as that of a replay."""
        return msgspec.structs.replace(
            self._recorded,
            federation=self.scenario.federation,
            run_id=self.run_id,
            mode="lockstep",
            rate=self.rate,
            replay_of=self._recorded.run_id,
        )

    # Time

    def advance(self, wall_ns: int) -> None:
        """Play the next gate."""
        gate = self._coming
        if gate is None:
            self.stop("the record is over")
            return
        if self.state == "waiting":
            self.state = "paused" if self._choice.paused else "running"
        else:
            self.steps_allowed = max(0, self.steps_allowed - 1)
        self._now_ns = gate.t_ns
        self._play(gate, wall_ns)
        self._coming = next(self._gates, None)
        to_ns = self._choice.to_ns
        if self._coming is None:
            self.stop("the record is over")
        elif to_ns is not None and self._coming.t_ns > to_ns:
            self.stop(f"played to {to_ns / 1e9:g} s")

    def seek(self, t_s: float) -> str | None:
        """Go on from another gate; return why not. Whoever is waited for would miss what lies between."""
        gating = [p.name for p in self.barrier.participants.values() if p.gating]
        if gating:
            return f"{', '.join(gating)} takes part in the lockstep; seek needs nobody who is waited for"
        former = self._gates, self._coming, self._standing
        self._wind(round(t_s * 1e9))
        if self._coming is None:
            self._gates, self._coming, self._standing = former
            return f"t_s is {t_s:g}; must be a time on record"
        self._forget(self._coming.t_ns)
        self.leaps += 1
        return None

    def _forget(self, t_ns: int) -> None:
        """Forget what was said before a leap to the gate t_ns: there it may never have been."""
        self._last.clear()
        self._measured.rate.leap()
        if self._plays_faults and self._standing is None:
            none = messages.encode(messages.Faults(t_ns, 0, ()))
            self._standing = Recorded(keys.FAULTS, none, t_ns, 0)

    def _wind(self, from_ns: int) -> None:
        self._gates = self._tape.gates(from_ns)
        self._coming: Gate | None = next(self._gates, None)
        self._standing = self._faults_before(from_ns) if self._plays_faults and from_ns > 0 else None

    def _faults_before(self, t_ns: int) -> Recorded | None:
        """Return what the world said last of its faults before a time: it says so only when they change."""
        said = self._reader.messages([keys.FAULTS], by_time=False)
        return max((m for m in said if m.t_ns < t_ns), key=lambda m: m.t_ns, default=None)

    # What is played

    def _play(self, gate: Gate, wall_ns: int) -> None:
        live = {duty for p in self.barrier.participants.values() for duty in p.duties}
        self._last.update((m.key, m.payload) for m in gate.said if m.key in self._views.sources)
        heard = [m for m in gate.said if m.key in self._place]
        faults = [m for m in (self._standing, *gate.said) if m is not None and m.key == keys.FAULTS]
        self._standing = None
        for recorded in faults:  # they are known before the gate
            self._say(recorded)
        if heard:
            self.outbox.append((keys.GATE, self._gate_messages(gate.t_ns, heard)))
        self._measured.gate(gate.t_ns, wall_ns)
        self.tell_clock()
        for recorded in (m for m in gate.said if m.key not in self._place and m.key != keys.FAULTS):
            if not (live and _author(recorded) in live):
                self._say(recorded)

    def _say(self, recorded: Recorded) -> None:
        """Say one message again, byte by byte, but for events, since ours are among them, and kills of processes."""
        key, payload = recorded.key, recorded.payload
        if key == keys.EVENT:
            self._say_event(payload)
        elif key == keys.FAULTS:
            self.outbox.append((key, msgspec.Raw(_without_kills(payload))))
        elif key != keys.VIEW_DRONES:
            self.outbox.append((key, msgspec.Raw(payload)))

    def _say_event(self, payload: bytes) -> None:
        try:
            event: messages.Event = messages.decode(keys.EVENT, payload)
        except DecodeError:
            return
        if event.kind != "end":  # the replay has an end of its own
            self.outbox.append((keys.EVENT, msgspec.structs.replace(event, seq=self._next_seq(keys.EVENT))))

    def _gate_messages(self, t_ns: int, heard: list[Recorded]) -> GateMessages:
        """Return what the world said of its drones, as it said it: drone by drone, the status last."""
        heard.sort(key=lambda m: self._place[m.key] // len(KINDS))
        which = np.array([self._place[m.key] for m in heard])
        first = np.searchsorted(which // len(KINDS), np.arange(len(self.names) + 1)).tolist()
        payloads = [m.payload for m in heard]
        if self._counts_again:
            _count(payloads, which.tolist(), first)
        pairs = list(zip([m.key for m in heard], payloads, strict=True))
        return GateMessages.of(t_ns, t_ns // self.gate_ns, self._table, pairs, [m.t_ns for m in heard], first)

    def views(self, seq: int) -> Sequence[Output]:
        live = {duty for p in self.barrier.participants.values() for duty in p.duties}
        made = self._views.made(self._last, self._now_ns, seq)
        return [output for output in made if not _is_of(output.key, live)]

    def result(self) -> dict[str, Any]:
        """Return what the replay measured of itself."""
        measured = self._measured.result(self.barrier.participants.values())
        about = {"replay_of": self._recorded.run_id, "refused": self.refused}
        return {"reason": self.ended, "last_ns": self._now_ns, **measured, **about}

    # What is refused, and who leaves

    def _command(self, drone: str, kind: str, message: Any) -> bool:
        source = message.source if keys.PROCESS_NAME.fullmatch(message.source) else "somebody"
        self.refuse(source, f"drone/{drone[:40]}/cmd/{kind}", NOBODY)
        return True

    def refusal_at(self, key: str) -> str | None:
        controller = f"controller.{keys.thing(key)}"
        live = any(controller in p.duties for p in self.barrier.participants.values())
        return None if live else NOBODY

    def _after_leaving(self, participant: Participant, reason: str) -> None:
        """Go on: the record is there already."""

    def _fate(self, participant: Participant) -> str:
        return "drop"


class _Requests(TimeRequests):
    """Answers what may be asked of a replay."""

    def __init__(self, playback: Playback) -> None:
        super().__init__(playback)
        self._playback = playback
        self._operations["seek"] = self._seek

    def answer(self, request: ControlRequest) -> ControlAnswer:
        return ControlAnswer(False, NOBODY) if request.op in FLIGHT else super().answer(request)

    def _seek(self, request: ControlRequest) -> str | None:
        t_s = request.args.get("t_s")
        if isinstance(t_s, bool) or not isinstance(t_s, int | float) or not t_s >= 0:
            return f"t_s is {t_s!r:.40}; must be a number of seconds >= 0"
        return self._playback.seek(t_s)


class _Sourced(msgspec.Struct):
    source: str = ""


_sourced = msgspec.msgpack.Decoder(_Sourced).decode


def _is_played(key: str, expressions: Sequence[str]) -> bool:
    """Tell whether what stands on a key is said again: not what processes said of themselves, that are not there."""
    own = key in (keys.INFO, keys.CLOCK) or key.startswith("process/") or messages.type_of(key) in VIEWS
    return not own and rights.permits(expressions, key)


def _without_kills(payload: bytes) -> bytes:
    """Return a list of faults without those of which a process dies: who takes part now is not who was meant."""
    try:
        told: messages.Faults = messages.decode(keys.FAULTS, payload)
    except DecodeError:
        return payload
    others = tuple(fault for fault in told.faults if fault.kind != PROCESS_KILL)
    return payload if others == told.faults else messages.encode(msgspec.structs.replace(told, faults=others))


def _author(recorded: Recorded) -> str:
    """Return the name of the process that said something beside the world, empty where it was none of a known role."""
    kind = messages.type_of(recorded.key)
    if kind is messages.Estimate:
        return f"estimator.{keys.thing(recorded.key)}"
    if kind in (messages.ClusterState, messages.ClusterRequest):
        return f"controller.{keys.thing(recorded.key)}"
    if kind is None or not issubclass(kind, messages.Command):
        return ""
    try:
        return _sourced(recorded.payload).source
    except messages.REFUSALS:
        return ""


def _is_of(view: str, live: set[str]) -> bool:
    """Tell whether somebody who takes part shows a view itself."""
    _, kind, whose = (*view.split("/", 2), "")[:3]
    return (kind == "cluster" and f"controller.{whose}" in live) or (kind == "estimates" and whose in live)


def _count(payloads: list[bytes], which: list[int], first: list[int]) -> None:
    """Let each status count what is played of its drone's sensors: what is left out would be waited for."""
    truth, status = KINDS.index("truth"), KINDS.index("status")
    for begin, end in pairwise(first):
        kinds = [place % len(KINDS) for place in which[begin:end]]
        for m, kind in enumerate(kinds, begin):
            if kind == status:
                message = messages.decode_as(messages.Status, payloads[m], "status")
                count = sum(kind != truth for kind in kinds)
                payloads[m] = messages.encode(msgspec.structs.replace(message, count=count))
