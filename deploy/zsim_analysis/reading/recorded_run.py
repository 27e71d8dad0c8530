"""The record of a run, opened to be replayed or flown again: its messages, its processes, and the inputs of each gate.

A record keeps the order in which messages passed through the world: those before a gate's clock message were received
before that gate was integrated. Two flights are compared by hashes of their messages: `OutputHashes`, of all outputs of
agents by key, show whether they are identical; `GateDigests`, checksums by key and gate, show where they first differ.
"""

import csv
import hashlib
import io
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise, zip_longest
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, Struct
from msgspec.structs import replace

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import LinkState
from zsim.errors import DecodeError, RecordError, ZsimError
from zsim.output_folder import record_at
from zsim.record import Recorded, RecordReader
from zsim.scenario import scenario_file
from zsim.scenario.faults import PROCESS_KILL
from zsim.scenario.roles import agent_roles
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim_agents.hosting import agents_of

# events of a process that was absent for part of the run
ABSENCES = ("death", "failure", "restart", "superseded", "doubled", "drop", "leave")
CAUSES = ("truth", "estimate")  # last parts of keys, in the order in which a difference spreads


class RecordedRun(NamedTuple):
    """An open record, with the run's `world/info` and scenario."""

    reader: RecordReader
    info: messages.Info
    scenario: Scenario


@contextmanager
def open_run(run_path: Path) -> Iterator[RecordedRun]:
    """Open the record of a run, given its folder or the record file.

    Raises:
        RunError: there is no record.
        RecordError: the file is not a record, or has no world/info of this version.
        ScenarioError: this version cannot read the scenario.
    """
    with RecordReader(record_at(run_path)) as reader:
        recorded = reader.last(keys.INFO)
        if recorded is None:
            raise RecordError(f"{reader.path}: has no world/info, so its run is unknown")
        try:
            info = messages.decode(keys.INFO, recorded.payload)
        except DecodeError as error:
            raise RecordError(f"{reader.path}: {error}; the record is of another version") from error
        search_modules(reader.path, info)
        yield RecordedRun(reader, info, scenario_file.from_text(info.scenario))


def search_modules(record: Path, info: messages.Info | None) -> None:
    """Let a scenario's modules be found where the run found them, beside the record, or in the working folder."""
    recorded = info.module_folders if info and info.module_folders is not UNSET else ()
    plugin.search(*(record.parent / each for each in recorded), record.parent, Path.cwd())


def scenario_of(info: messages.Info | None) -> Scenario | None:
    """Return the scenario of a run; None without `world/info`, or if this version cannot read the scenario."""
    try:
        return scenario_file.from_text(info.scenario) if info else None
    except ZsimError:
        return None


def is_answer(key: str) -> bool:
    """Return whether agents publish on a key: commands, or messages for other agents."""
    return keys.is_command(key) or messages.is_relayed(messages.type_of(key))


def answered_until_ns(reader: RecordReader, info: messages.Info) -> int:
    """Return the last gate [ns] whose answers are all in the record, because the last recorded gate needed them.

    Raises:
        RecordError: the record has no gate.
    """
    clock = reader.last(keys.CLOCK)
    if clock is None:
        raise RecordError(f"{reader.path}: contains no gate")
    return clock.t_ns - info.gate_ns - info.command_delay_ns


def sender_of(key: str, message: Any) -> str:
    """Return the name of the process that published an output: a command, or a message for other agents."""
    stated = message.controller if isinstance(message, run_messages.ClusterRequest) else message.source
    role = "estimator" if isinstance(message, flight_messages.Estimate) else "controller"
    return stated or f"{role}.{keys.thing(key)}"


def decode_or_none(recorded: Recorded) -> Any:
    """Return the message on a key of the contract; None if its payload does not match the type of the key."""
    try:
        return messages.decode(recorded.key, recorded.payload)
    except DecodeError:
        return None


def command_age_ms(path: Path) -> dict[str, float] | None:
    """Return p50, p99 and max [ms] of the wall time from a drone's status to the command that answers it.

    Both times are those at which the recorder received the messages. This is for runs whose world ended before it
    reported its own statistics. None if no recorded command answers a status.
    """
    with RecordReader(path) as reader:
        selected_keys = {
            k for k in reader.topics() if keys.leaf(k) in ("status", "velocity") and not keys.is_accepted(k)
        }
        status_wall_ns: dict[tuple[str, int], int] = {}
        ages_ns = []
        for message in reader.messages(selected_keys, by_time=False):
            instant = (keys.thing(message.key), message.t_ns)
            if keys.leaf(message.key) == "status":
                status_wall_ns[instant] = message.wall_ns
            elif instant in status_wall_ns:
                ages_ns.append(message.wall_ns - status_wall_ns[instant])
    if not ages_ns:
        return None
    ages = np.array(ages_ns) / 1e6
    p50, p99 = np.percentile(ages, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(ages.max())}


class DriverLink(Struct, frozen=True):
    """Quality of the link to one external drone over a run; None for values that its driver did not report."""

    peer: str  # address of the aircraft
    age_max_ms: float | None  # largest reported age of the newest datagram in wall time
    # loss_mean_percent, loss_max_percent: loss of the datagrams that the aircraft sent
    loss_mean_percent: float | None
    loss_max_percent: float | None
    round_trip_ms: float | None  # median
    lost: int  # how often the link was lost, that is, silent for a second
    lost_s: float  # total duration of the losses in simulated time
    refused: int  # number of datagrams that were malformed or from another sender, over all consecutive drivers

    def __str__(self) -> str:
        values = (
            ("loss {:.1f} %", self.loss_mean_percent),
            ("at most {:.1f} %", self.loss_max_percent),
            ("age at most {:.0f} ms", self.age_max_ms),
            ("round trip {:.0f} ms", self.round_trip_ms),
        )
        parts = [text.format(value) for text, value in values if value is not None]
        times = "once" if self.lost == 1 else f"{self.lost} times"
        lost = f"lost {times}, for {self.lost_s:.1f} s" if self.lost else "never lost"
        refused = [f"{self.refused} message{'' if self.refused == 1 else 's'} refused"] if self.refused else []
        return ", ".join([self.peer, *parts, lost, *refused])


def driver_links(path: Path) -> dict[str, DriverLink]:
    """Return the links of a record by drone, from the reports that drivers published once a second.

    Raises:
        RecordError: there is no such record.
    """
    by_drone: defaultdict[str, list[LinkState]] = defaultdict(list)
    with RecordReader(path) as reader:
        for key, report in _read(reader, "drone/*/link"):
            by_drone[keys.thing(key)].append(report)
    links = {}
    for drone, reports in sorted(by_drone.items()):
        pairs = list(pairwise(reports))
        ages, losses, trips = (
            [value for report in reports if (value := getattr(report, name)) is not None]
            for name in ("age_ms", "loss_percent", "round_trip_ms")
        )
        links[drone] = DriverLink(
            peer=reports[-1].peer,
            age_max_ms=max(ages, default=None),
            loss_mean_percent=sum(losses) / len(losses) if losses else None,
            loss_max_percent=max(losses, default=None),
            round_trip_ms=median(trips) if trips else None,
            lost=sum(before.state != "lost" and after.state == "lost" for before, after in pairs),
            lost_s=sum(after.t_ns - before.t_ns for before, after in pairs if before.state == "lost") / 1e9,
            refused=sum(before.refused for before, after in pairs if after.seq == 0) + reports[-1].refused,
        )
    return links


class AgentProcess(NamedTuple):
    """A process of zsim's agents: its name, and the names of all agents in it."""

    name: str
    members: tuple[str, ...]

    def __str__(self) -> str:
        others = ", ".join(member for member in self.members if member != self.name)
        return f"{self.name} (with {others})" if others else self.name


class RecordedAgents(NamedTuple):
    """The agents that took part in a run."""

    processes: tuple[AgentProcess, ...]  # those whose agents can be run again; empty if `why_not`
    why_not: str  # why no agents can be run again; empty if they can
    requests: tuple[tuple[str, run_messages.ClusterRequest], ...]  # to controllers and pilots, in order for each
    fingerprints: frozenset[str]  # numeric fingerprints of these processes
    truth_sha256: str | None  # as the world reported it at the end of the run; None if the record has no end
    failure: str  # failure of a user's code in these processes that ended the run; empty if none did

    @property
    def names(self) -> frozenset[str]:
        """Names of all processes and agents that are run again."""
        return frozenset(name for process in self.processes for name in (process.name, *process.members))


def recorded_agents(reader: RecordReader, info: messages.Info, scenario: Scenario) -> RecordedAgents:
    """Return the agents that took part in the run of a record.

    Processes that announce no version or fingerprint, or serve names that are not agents of the scenario, are left out.
    """
    expected = set(agents_of(scenario)) if scenario.drones else set()
    joins = [(keys.thing(key), join) for key, join in _read(reader, "process/*/join")]
    agent_joins = [(name, j) for name, j in joins if j.version and j.fingerprint and {name, *j.serves} <= expected]
    processes = [AgentProcess(name, (*join.serves, name)) for name, join in dict(agent_joins).items()]
    roles = [*agent_roles(scenario)]
    processes.sort(key=lambda process: (roles.index(process.name.partition(".")[0]), process.name))
    names = frozenset(name for process in processes for name in process.members)
    events: list[run_messages.Event] = [event for _, event in _read(reader, keys.EVENT)]
    why_not = _why_not(info, scenario, events, names)
    return RecordedAgents(
        processes=() if why_not else tuple(processes),
        why_not=why_not,
        requests=(*_read(reader, "cluster/*/request"), *_read(reader, "drone/*/request")),
        fingerprints=frozenset(join.fingerprint for _, join in agent_joins),
        truth_sha256=next((e.data.get("truth_sha256") for e in reversed(events) if e.kind == "end"), None),
        failure=next((event.text for event in events if _ends_by_failure(event, names)), ""),
    )


def _why_not(
    info: messages.Info, scenario: Scenario, events: Sequence[run_messages.Event], names: frozenset[str]
) -> str:
    """Return why the agents cannot be run again; empty if they can."""
    if info.mode == "realtime":
        return "in realtime, the times of their answers do not follow from the scenario"
    if not names:
        return "none of zsim's took part"
    if any(fault.get("kind") == PROCESS_KILL for fault in scenario.faults):
        return f"a {PROCESS_KILL} was planned"
    for event in events:
        at_time, is_agent = f"at {event.t_ns / 1e9:.2f} s", event.subject in names
        if event.kind == "end" or _ends_by_failure(event, names):
            break
        if event.kind in ABSENCES and is_agent:
            return f"{event.kind} of {event.subject} {at_time}"
        if event.kind == "outputs_missing" and is_agent:
            return f"outputs of {event.subject} were lost {at_time}"
        if event.kind == "join" and is_agent and event.data.get("from_ns", 0):
            return f"{event.subject} joined {at_time}, after the start"
        is_fault = event.kind == "control" and event.data.get("ok") and event.subject == "fault_add"
        fault = event.data.get("args") if is_fault else None
        if isinstance(fault, dict) and fault.get("kind") == PROCESS_KILL:
            return f"a {PROCESS_KILL} was requested {at_time}"
    return ""


def _ends_by_failure(event: run_messages.Event, names: frozenset[str]) -> bool:
    """Return whether an event is the failure of a user's code in one of these agents that ended the run."""
    return event.kind == "failure" and event.subject in names and event.data.get("on_death") == "end"


def _read(reader: RecordReader, expression: str) -> Iterator[tuple[str, Any]]:
    """Yield the valid messages on a key expression, with their keys, in the order of the record."""
    matching_keys = [key for key in reader.topics() if keys.matches(expression, key)]
    for recorded in reader.messages(matching_keys, by_time=False):
        if (message := decode_or_none(recorded)) is not None:
            yield recorded.key, message


class GateInputs(NamedTuple):
    """The content of a record for one gate."""

    t_ns: int
    inputs: list[Recorded]  # messages received by the world since the previous gate, in order
    truth: dict[str, bytes]  # payloads at the gate, by drone


def gates(reader: RecordReader, drones: list[str]) -> Iterator[GateInputs]:
    """Yield the inputs and truth of each gate for which a record has truth."""
    truth_keys = {keys.truth(drone): drone for drone in drones}
    gate_keys = {keys.CLOCK, keys.EVENT, *truth_keys}
    for key in reader.topics():
        kind, _, leaf = keys.parts(key)
        if kind == "process":
            is_input = leaf in ("join", "done", "bye")
        else:
            is_detection = kind == "drone" and leaf == keys.SIGHTINGS
            is_input = is_detection or is_answer(key)
        if is_input:
            gate_keys.add(key)
    gate_keys &= reader.topics().keys()
    inputs: list[Recorded] = []
    truth: dict[str, bytes] = {}
    last_ns = -1
    for recorded in reader.messages(gate_keys, by_time=False):
        if recorded.key in truth_keys:
            truth[truth_keys[recorded.key]] = recorded.payload
        elif recorded.key != keys.CLOCK:
            inputs.append(recorded)
        elif recorded.t_ns > last_ns and truth:  # the clock of a gate is repeated while simulated time stands still
            yield GateInputs(recorded.t_ns, inputs, truth)
            inputs, truth, last_ns = [], {}, recorded.t_ns


def content_of(message: Any) -> bytes:
    """Return an agent's output as on the wire, but without the name of its process, which agents may share."""
    return messages.encode(
        replace(message, **{"controller" if isinstance(message, run_messages.ClusterRequest) else "source": ""})
    )


class OutputHashes:
    """SHA-256 of the outputs of agents up to a gate, by key.

    Args:
        until_ns: time of the last gate whose outputs are hashed; those of later gates may be missing from the record.
    """

    def __init__(self, until_ns: int) -> None:
        self._until_ns = until_ns
        self._hashes: dict[str, hashlib._Hash] = {}

    def add(self, key: str, t_ns: int, content: bytes) -> None:
        """Add an output, as `content_of` returns it, in the order of publication for each key."""
        if t_ns <= self._until_ns:
            self._hashes.setdefault(key, hashlib.sha256()).update(len(content).to_bytes(4, "little") + content)

    def hexdigests(self) -> dict[str, str]:
        return {key: digest.hexdigest() for key, digest in sorted(self._hashes.items())}


class GateDigests:
    """Checksums of the messages on each key at each gate; `until_ns` as in OutputHashes."""

    def __init__(self, until_ns: int) -> None:
        self._until_ns = until_ns
        self._sums: dict[int, dict[str, int]] = {}

    def add(self, key: str, t_ns: int, payload: bytes) -> None:
        if t_ns <= self._until_ns:
            sums = self._sums.setdefault(t_ns, {})
            sums[key] = sums.get(key, 0) + zlib.crc32(payload) & 0xFFFFFFFF

    def csv(self) -> bytes:
        """Return a CSV table: `t_ns`, then a column per key, whose cells are 8 hexadecimal digits or empty."""
        names = sorted({key for sums in self._sums.values() for key in sums})
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t_ns", *names])
        for t_ns, sums in sorted(self._sums.items()):
            writer.writerow([t_ns, *(f"{sums[name]:08x}" if name in sums else "" for name in names)])
        return file.getvalue().encode()


def first_difference(expected: bytes, found: bytes) -> tuple[int, str] | None:
    """Return the first time [ns] and key at which two tables of `GateDigests.csv` differ; None if they are equal.

    Among keys that differ at the same time, the likely cause comes first: truth, then estimates, then others.

    Raises:
        ValueError: one of them is not such a table.
    """
    rows = zip_longest(_rows(expected), _rows(found), fillvalue=(0, dict[str, str]()))
    for (t_ns, a), (other_ns, b) in rows:
        if differing := [key for key in {*a, *b} if a.get(key, "") != b.get(key, "")]:
            return t_ns or other_ns, min(differing, key=lambda key: (*(keys.leaf(key) != each for each in CAUSES), key))
    return None


def _rows(table: bytes) -> Iterator[tuple[int, dict[str, str]]]:
    try:
        for row in csv.DictReader(io.StringIO(table.decode()), strict=True):
            yield int(row.pop("t_ns")), {key: digits for key, digits in row.items() if digits}
    except (csv.Error, KeyError, TypeError) as error:
        raise ValueError(f"not a table of digests: {error}") from error
