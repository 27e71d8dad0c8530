"""A replay: plays the record of a run onto its keys in place of a world.

It does everything else that a world does: it keeps time, waits for its participants, answers for the last values,
and can be paused, stepped and stopped. No drone can be flown.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
import numpy as np

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.camera_messages import CameraImage, CameraInfo, Sightings
from zsim.contract.framing import KINDS, GateMessages, run_key_table
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import DecodeError, RecordError
from zsim.record import Recorded, RecordReader
from zsim.runtime.agent import Output
from zsim.scenario.role_table import OnDeath
from zsim.scenario.scenario import Scenario
from zsim_world.run.barrier import Participant
from zsim_world.run.coordinator import FLIGHT_REQUESTS, Coordinator
from zsim_world.run.outbox import Refusal
from zsim_world.run.recorded_gates import Gate, PlaybackViews, RecordedGates, author, is_played, without_kills
from zsim_world.run.run_clock import number, refused_argument

RECORD_OVER = "the record is over"  # why a replay of the whole record ended

NOT_FLYABLE = "a replay: nobody can be flown"
SEEK_MAX_S = 1e9  # beyond it, nanoseconds are no int64
VIEWED_MAX = 10_000  # drones times instants in one answer to `views`: 2 MB
VIEWED_MAX_S = 60.0  # simulated, in one answer to `views`; chosen: the replay stands while it reads them
BEFORE_NS = 1_000_000_000  # in which each key that views are made of is published once
OF_CAMERAS = {CameraImage: "camera", CameraInfo: "camera", Sightings: "detector"}  # roles that publish these
MARKS_MAX = 400  # on a timeline; more would be narrower than a pixel
LEFT_OUT = frozenset({"command", "end"})  # kinds of events: too many commands to be marked
TEXT_MAX = 120  # characters


class PlaybackRange(NamedTuple):
    """What is played of a record.

    Attributes:
        from_ns, to_ns: first and last gate [ns]; None for the end.
        keys: expressions; what matches none is not played.
        paused: whether it stands still after its first gate.
        holds: whether it stands still after its last one, so that one can go back, rather than end.
    """

    from_ns: int = 0
    to_ns: int | None = None
    keys: tuple[str, ...] = ("**",)
    paused: bool = False
    holds: bool = False


class Playback(Coordinator):
    """Plays a record.

    Outputs that a participant publishes itself (recognised by its name, `estimator.drone1`; pictures and detections by
    their drone) are not played.

    Args:
        reader: of the record; it stays open.
        scenario: the one on record.
        info: the one on record.
        played: what is played of it.
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
        played: PlaybackRange = PlaybackRange(),  # noqa: B008 - immutable
        rate: float = 1.0,
        wall_ns: Callable[[], int] = lambda: 0,
        run_id: str | None = None,
    ) -> None:
        super().__init__(scenario, "lockstep", rate, wall_ns, run_id, [])
        self._recorded = info
        self._played = played
        self._operations |= {"seek": self._seek, "timeline": self._timeline, "views": self._views_of_past}
        self.refused_queries = tuple(keys.cluster_control(cluster.name) for cluster in scenario.clusters)
        self._table = run_key_table(info)
        self._kinds = len(self._table) // len(self.names)  # of messages about a drone
        self._place = {key: place for place, key in enumerate(self._table)}
        self._views = PlaybackViews(self.names, [cluster.name for cluster in scenario.clusters])
        self._last: dict[str, bytes] = {}
        topics = reader.topics()
        wanted = {key for key in topics if is_played(key, played.keys)}
        self._viewed = self._views.sources & wanted
        self._recounts = any(keys.is_sensor(key) and key not in wanted for key in topics)
        self._reader = reader
        self._plays_faults = keys.FAULTS in wanted
        self._camera_infos = frozenset(key for key in wanted if messages.type_of(key) is CameraInfo)
        gate_keys = wanted | ({keys.VIEW_DRONES} & topics.keys())
        self._recorded_gates = RecordedGates(reader, self.clock.gate_ns, self.clock.delay_ns, gate_keys)
        self._wind(played.from_ns)
        if self._coming is None or (played.to_ns is not None and self._coming.t_ns > played.to_ns):
            until = "on" if played.to_ns is None else f"to {played.to_ns / 1e9:.12g} s"
            window = f"from {played.from_ns / 1e9:.12g} s {until}"
            raise RecordError(f"{reader.path}: holds no gate {window}; nothing can be played")

    def info(self) -> messages.Info:
        """Return the `world/info` on record, as that of a replay."""
        return msgspec.structs.replace(
            self._recorded,
            federation=self.scenario.federation,
            run_id=self.run_id,
            mode="lockstep",
            rate=self.clock.rate,
            replay_of=self._recorded.run_id,
        )

    # Time

    def advance(self, wall_ns: int) -> None:
        """Play the next gate."""
        gate, over = self._coming, self._over()
        if gate is None or over:
            self._end(over)
            return
        if self.clock.state == "waiting":
            self.clock.start(gate.t_ns, self._played.paused)
        else:
            self.clock.advance(gate.t_ns)
        self._play(gate, wall_ns)
        self._read_next()
        if over := self._over():
            self._end(over)

    def _over(self) -> str:
        """Return why there is nothing more to play; empty while there is something."""
        to_ns = self._played.to_ns
        if self._coming is None:
            return RECORD_OVER
        return f"played to {to_ns / 1e9:g} s" if to_ns is not None and self._coming.t_ns > to_ns else ""

    def _end(self, reason: str) -> None:
        if self._played.holds:
            self.clock.hold()
        else:
            self.clock.stop(reason)

    def _timeline(self, _: ControlRequest) -> ControlAnswer:
        """Answer how far the record goes and what happened when [s]: of many events those of each kind thinned out."""
        last = self._reader.last(keys.CLOCK)
        first = next(self._reader.messages([keys.CLOCK]), last)
        span = {"from_s": first.t_ns / 1e9, "to_s": last.t_ns / 1e9} if first and last else {}
        return ControlAnswer(True, result={**span, "marks": timeline_marks(self._reader)})

    def _views_of_past(self, request: ControlRequest) -> Refusal | ControlAnswer:
        """Answer the views of instants on record, `every_s` apart, for curves and trails."""
        from_s, to_s, every_s = (number(request.args.get(name)) for name in ("from_s", "to_s", "every_s"))
        if from_s is None or not 0.0 <= from_s < SEEK_MAX_S:
            return refused_argument(request, "from_s", "a time on record [s]")
        if to_s is None or not from_s <= to_s <= from_s + VIEWED_MAX_S:
            return refused_argument(request, "to_s", f"from from_s to {VIEWED_MAX_S:g} s after it")
        count_max = max(1, VIEWED_MAX // len(self.names))
        if every_s is None or not every_s > 0.0 or (to_s - from_s) / every_s >= count_max:
            return refused_argument(request, "every_s", f"above 0, for {count_max} instants of this run at most")
        instants = [round((from_s + k * every_s) * 1e9) for k in range(int((to_s - from_s) / every_s) + 1)]
        last: dict[str, bytes] = {}
        found: list[tuple[str, bytes]] = []
        for seq, (t_ns, passed) in enumerate(self._recorded_gates.before(instants, self._viewed, BEFORE_NS)):
            last |= passed
            if any(key.endswith("/truth") for key in passed):  # else the record has a gap there, or has ended
                found += [(view.key, messages.encode(view.message)) for view in self._views.views(last, t_ns, seq)]
        return ControlAnswer(True, result=found)

    def control(self, request: ControlRequest) -> ControlAnswer:
        """Answer a request; `views` are asked for again and again, and are no event."""
        return self._answer(request) if request.op == "views" else super().control(request)

    def _seek(self, request: ControlRequest) -> Refusal | None:
        """Continue from another gate. Refused while anybody is waited for, who would miss what lies between."""
        t_s = number(request.args.get("t_s"))
        if t_s is None or not 0 <= t_s < SEEK_MAX_S:
            return refused_argument(request, "t_s", "a time on record [s]")
        gating = [p.name for p in self.barrier.participants.values() if p.gating]
        if gating:
            return Refusal(", ".join(gating), "in the lockstep", "seek needs nobody who is waited for")
        former = self._gates, self._coming, self._pending_faults, self._pending_infos
        self._wind(round(t_s * 1e9))
        if self._coming is None:
            self._gates, self._coming, self._pending_faults, self._pending_infos = former
            return refused_argument(request, "t_s", "a time on record [s]")
        self._forget(self._coming.t_ns)
        self.clock.jumps += 1
        return None

    def _forget(self, t_ns: int) -> None:
        """Forget what was played before a jump to the gate t_ns."""
        self._last.clear()
        self.statistics.rate.jump()
        if self._plays_faults and self._pending_faults is None:
            none = messages.encode(run_messages.Faults(t_ns, 0, ()))
            self._pending_faults = Recorded(keys.FAULTS, none, t_ns, 0)

    def _wind(self, from_ns: int) -> None:
        self._gates = self._recorded_gates.gates(from_ns)
        self._read_next()
        # the last list of faults, and info of each camera, before: they are published only when they change
        before = self._last_before(from_ns, {keys.FAULTS} if self._plays_faults else set())
        self._pending_faults: Recorded | None = before[0] if before else None
        self._pending_infos = self._last_before(from_ns, self._camera_infos)

    def _read_next(self) -> None:
        self._coming: Gate | None = next(self._gates, None)
        if self._coming is not None:
            self.clock.next_ns = self._coming.t_ns

    def _last_before(self, t_ns: int, wanted: Collection[str]) -> list[Recorded]:
        """Return the last message of each key before a time."""
        if not wanted or t_ns <= 0:
            return []
        before = (m for m in self._reader.messages(wanted, by_time=False) if m.t_ns < t_ns)
        return list({m.key: m for m in sorted(before, key=lambda m: m.t_ns)}.values())

    # What is played

    def _live(self) -> LiveProcesses:
        return LiveProcesses(self.scenario, self.barrier.participants.values())

    def _play(self, gate: Gate, wall_ns: int) -> None:
        live = self._live()
        self._last.update((m.key, m.payload) for m in gate.messages if m.key in self._views.sources)
        of_drones = [m for m in gate.messages if m.key in self._place]
        faults = [m for m in (self._pending_faults, *gate.messages) if m is not None and m.key == keys.FAULTS]
        self._pending_faults = None
        for recorded in faults:  # they are known before the gate
            self._publish(recorded)
        if of_drones:
            self.outbox.put(keys.GATE, self._gate_messages(gate.t_ns, of_drones))
        self.statistics.gate(gate.t_ns, wall_ns)
        self.outbox.put(keys.CLOCK, self.clock_message(self.missed(wall_ns)))
        infos, self._pending_infos = self._pending_infos, []
        for recorded in (m for m in (*infos, *gate.messages) if m.key not in self._place and m.key != keys.FAULTS):
            if not live.replace(recorded):
                self._publish(recorded)

    def _publish(self, recorded: Recorded) -> None:
        """Publish a message again, byte by byte, except events, which are numbered anew, and kills of processes."""
        key, payload = recorded.key, recorded.payload
        if key == keys.EVENT:
            with suppress(DecodeError):
                event: run_messages.Event = messages.decode(keys.EVENT, payload)
                if event.kind != "end":  # the replay has an end of its own
                    self.outbox.put(key, msgspec.structs.replace(event, seq=self.outbox.next_seq(key)))
        elif key == keys.FAULTS:
            self.outbox.put(key, msgspec.Raw(without_kills(payload)))
        elif key != keys.VIEW_DRONES:
            self.outbox.put(key, msgspec.Raw(payload))

    def _gate_messages(self, t_ns: int, of_drones: list[Recorded]) -> GateMessages:
        """Return the world's messages about its drones as the world published them: drone by drone, status last."""
        of_drones.sort(key=lambda m: self._place[m.key] // self._kinds)
        which = np.array([self._place[m.key] for m in of_drones])
        first = np.searchsorted(which // self._kinds, np.arange(len(self.names) + 1)).tolist()
        payloads = [m.payload for m in of_drones]
        if self._recounts:
            _recount(payloads, (which % self._kinds).tolist(), first)
        pairs = list(zip([m.key for m in of_drones], payloads, strict=True))
        stamps = [m.t_ns for m in of_drones]
        return GateMessages.of(t_ns, t_ns // self.clock.gate_ns, self._table, pairs, stamps, first)

    def views(self, seq: int) -> Sequence[Output]:
        live = self._live().names
        views = self._views.views(self._last, self.now_ns, seq)
        return [output for output in views if not _is_of(output.key, live)]

    def result(self) -> dict[str, Any]:
        """Return the figures of the replay so far."""
        statistics = self.statistics.result(self.barrier.participants.values())
        about = {"replay_of": self._recorded.run_id, "refused": self.outbox.refusals.count}
        return {"reason": self.ended, "last_ns": self.now_ns, **statistics, **about}

    # What is refused, and who leaves

    def _handle_command(self, drone: str, kind: str, message: Any) -> bool:
        source = message.source if keys.PROCESS_NAME.fullmatch(message.source) else "somebody"
        self.outbox.refuse(source, f"drone/{drone[:40]}/cmd/{kind}", NOT_FLYABLE)
        return True

    def _perform(self, request: ControlRequest) -> Refusal | ControlAnswer | None:
        return ControlAnswer(False, NOT_FLYABLE) if request.op in FLIGHT_REQUESTS else super()._perform(request)

    def refusal_at(self, key: str) -> str | None:
        return None if f"controller.{keys.thing(key)}" in self._live().names else NOT_FLYABLE

    def _after_bye(self, participant: Participant, reason: str) -> None:
        """Go on also without a recorder."""

    def _is_missed_from_now(self, participant: Participant) -> bool:
        return False

    def on_death(self, participant: Participant) -> OnDeath:
        return "drop"


def _is_of(view: str, live: set[str]) -> bool:
    """Tell whether a participant publishes a view itself."""
    _, kind, whose = (*view.split("/", 2), "")[:3]
    return (kind == "cluster" and f"controller.{whose}" in live) or (kind == "estimates" and whose in live)


def _recount(payloads: list[bytes], kinds: list[int], first: list[int]) -> None:
    """Let each status count the sensor messages that are played; agents would wait for the others."""
    truth, status = KINDS.index("truth"), KINDS.index("status")
    for begin, end in pairwise(first):
        for m in range(begin, end):
            if kinds[m] == status:
                message = messages.decode_as(flight_messages.Status, payloads[m], "status")
                count = sum(kind != truth for kind in kinds[begin:end])
                payloads[m] = messages.encode(msgspec.structs.replace(message, count=count))


class LiveProcesses:
    """The processes that take part at a gate, whose outputs are not played.

    A camera or detector is recognised by the drones that it declares, whatever its name is; one that declares none, as
    a program of the user's own may, by its name.

    Args:
        scenario: of the record.
        participants: alive.

    Attributes:
        names: of the processes whose work they do.
    """

    def __init__(self, scenario: Scenario, participants: Iterable[Participant]) -> None:
        served = [each.served_names for each in participants]
        self._cameras = {drone.name: drone.sensors.cameras() for drone in scenario.drones}
        self._by_name = {name for names in served if not any(map(self._is_of_cameras, names)) for name in names}
        self.names = {name for names in served for name in names}

    def _is_of_cameras(self, name: str) -> bool:
        role, _, drone = name.partition(".")
        return role in OF_CAMERAS.values() and drone in self._cameras

    def replace(self, recorded: Recorded) -> bool:
        """Tell whether one of them publishes a message in place of one on record."""
        role = OF_CAMERAS.get(messages.type_of(recorded.key))
        if role is None:
            return bool(self.names) and author(recorded) in self.names
        if f"{role}.{keys.thing(recorded.key)}" in self.names and self._is_drawn(recorded.key):
            return True
        return bool(self._by_name) and author(recorded) in self._by_name

    def _is_drawn(self, key: str) -> bool:
        """Tell whether the scenario has a camera; where a drone has none there, any counts."""
        _, drone, what = keys.parts(key)
        cameras, camera = self._cameras.get(drone), what.removeprefix("camera/").removesuffix("/info")
        return not cameras or camera == what or camera in cameras


def timeline_marks(reader: RecordReader) -> list[dict[str, Any]]:
    """Return the events on record, but for commands: t_s, kind and text of each; of many, evenly thinned out."""
    marks = []
    for recorded in reader.messages([keys.EVENT]):
        with suppress(DecodeError):
            event: run_messages.Event = messages.decode(keys.EVENT, recorded.payload)
            if event.kind not in LEFT_OUT:
                text = f"{event.subject}: {event.text}" if event.subject else event.text
                marks.append({"t_s": event.t_ns / 1e9, "kind": event.kind, "text": text[:TEXT_MAX]})
    return marks[:: -(-len(marks) // MARKS_MAX) or 1]
