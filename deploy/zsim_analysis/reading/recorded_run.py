"""The record of a run, opened to be played back or flown again: its messages, who took part, and each gate's inputs.

The order of a record is the order in which messages passed the world: what stands before the clock of a gate was
received before that gate was integrated.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.errors import DecodeError, RecordError, ZsimError
from zsim.output_folder import record_at
from zsim.record import Recorded, RecordReader
from zsim.scenario import scenario_file
from zsim.scenario.faults import PROCESS_KILL
from zsim.scenario.roles import AGENTS
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim_agents.hosting import agents_of

# events of a process that did not take part all the time
ABSENCES = ("death", "failure", "restart", "superseded", "doubled", "drop", "leave")
PROCESS_MESSAGES = ("join", "done", "bye")  # from processes to the world


class RecordedRun(NamedTuple):
    """An open record, and the run's `world/info` and scenario on it."""

    reader: RecordReader
    info: messages.Info
    scenario: Scenario


@contextmanager
def open_run(place: Path) -> Iterator[RecordedRun]:
    """Yield the record in a run's folder, or in a file.

    Raises:
        RunError: there is none.
        RecordError: it is no record, or has no world/info.
        ScenarioError: this version cannot read its scenario.
    """
    with RecordReader(record_at(place)) as reader:
        info = _info(reader)
        search_modules(reader.path, info)
        yield RecordedRun(reader, info, scenario_file.from_text(info.scenario))


def _info(reader: RecordReader) -> messages.Info:
    recorded = reader.last(keys.INFO)
    if recorded is None:
        raise RecordError(f"{reader.path}: has no world/info; the run that it is of is not known")
    try:
        return messages.decode(keys.INFO, recorded.payload)
    except DecodeError as error:
        raise RecordError(f"{reader.path}: {error}; the record is of another version") from error


def search_modules(record: Path, info: messages.Info | None) -> None:
    """Let modules that a run's scenario names be found where the run found them, beside its record, or where we are."""
    recorded = info.module_folders if info and info.module_folders is not UNSET else ()
    plugin.search(*map(Path, recorded), record.parent, Path.cwd())


def scenario_of(info: messages.Info | None) -> Scenario | None:
    """Return the scenario of a run; None without `world/info`, or if this version cannot read the scenario."""
    try:
        return scenario_file.from_text(info.scenario) if info else None
    except ZsimError:
        return None


def decode_or_none(recorded: Recorded) -> Any:
    """Return the message of a key of the contract, None if its payload is not of the key's type."""
    try:
        return messages.decode(recorded.key, recorded.payload)
    except DecodeError:
        return None


def command_age_ms(path: Path) -> dict[str, float] | None:
    """Return p50, p99 and max [ms] of the wall time from a drone's status to the command that answers it.

    Both times are those at which the recorder received the messages. For runs whose world ended before it reported
    its own figures; None when no command answers a status on record.
    """
    with RecordReader(path) as reader:
        wanted = {k for k in reader.topics() if keys.leaf(k) in ("status", "velocity") and not keys.is_accepted(k)}
        status_wall_ns: dict[tuple[str, int], int] = {}
        ages_ns = []
        for message in reader.messages(wanted, by_time=False):
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


class AgentProcess(NamedTuple):
    """A process of zsim's agents: its name, and the names of all the agents that it ran."""

    name: str
    members: tuple[str, ...]

    def __str__(self) -> str:
        others = ", ".join(member for member in self.members if member != self.name)
        return f"{self.name} (with {others})" if others else self.name


class RecordedAgents(NamedTuple):
    """The agents that took part in a run.

    Attributes:
        processes: those whose agents can be run again; empty if there is a reason not to.
        why_not: that reason.
        requests: to their controllers, in order.
        fingerprints: numeric, of these processes.
        truth_sha256: as the world reported it at the end of the run, None if the record has no end.
        failure: of a user's code in one of these processes, which ended the run; empty if none did.
    """

    processes: tuple[AgentProcess, ...]
    why_not: str
    requests: tuple[tuple[str, run_messages.ClusterRequest], ...]
    fingerprints: frozenset[str]
    truth_sha256: str | None
    failure: str

    @property
    def names(self) -> frozenset[str]:
        """Return the names of all processes and agents that are run again."""
        return frozenset(name for process in self.processes for name in (process.name, *process.members))


def recorded_agents(reader: RecordReader, info: messages.Info, scenario: Scenario) -> RecordedAgents:
    """Return the agents that took part in the run of a record."""
    known = set(agents_of(scenario)) if scenario.drones else set()
    joins = [(keys.thing(key), join) for key, join in _read(reader, "process/*/join")]
    ours = [(name, join) for name, join in joins if _is_ours(name, join, known)]
    unsorted = [AgentProcess(name, (*join.serves, name)) for name, join in dict(ours).items()]
    processes = tuple(sorted(unsorted, key=_by_role))
    names = frozenset(name for process in processes for name in process.members)
    events: list[run_messages.Event] = [event for _, event in _read(reader, keys.EVENT)]
    why_not = _reason(info, scenario, events, names)
    requests = tuple(_read(reader, "cluster/*/request"))
    fingerprints = frozenset(join.fingerprint for _, join in ours)
    sha256 = next((event.data.get("truth_sha256") for event in reversed(events) if event.kind == "end"), None)
    failure = next((event.text for event in events if _is_end_by_failure(event, names)), "")
    return RecordedAgents(() if why_not else processes, why_not, requests, fingerprints, sha256, failure)


def _by_role(process: AgentProcess) -> tuple[int, str]:
    return [*AGENTS].index(process.name.partition(".")[0]), process.name


def _is_ours(name: str, join: run_messages.Join, known: set[str]) -> bool:
    """Return whether a process was one of zsim's agents: others do not announce a numeric fingerprint."""
    return bool(join.version and join.fingerprint) and {name, *join.serves} <= known


def _reason(
    info: messages.Info, scenario: Scenario, events: Sequence[run_messages.Event], names: frozenset[str]
) -> str:
    """Return why the agents are not run again, empty if they can be."""
    if info.mode == "realtime":
        return "in realtime it is not in the scenario when they answered"
    if not names:
        return "none of zsim's took part"
    if any(fault.get("kind") == PROCESS_KILL for fault in scenario.faults):
        return f"a {PROCESS_KILL} was planned"
    for event in events:
        if event.kind == "end" or _is_end_by_failure(event, names):
            break
        if event.kind in ABSENCES and event.subject in names:
            return f"{event.kind} of {event.subject} at {event.t_ns / 1e9:.2f} s"
        if event.kind == "outputs_missing" and event.subject in names:
            return f"outputs of {event.subject} were lost at {event.t_ns / 1e9:.2f} s"
        if event.kind == "join" and event.subject in names and event.data.get("from_ns", 0):
            return f"{event.subject} joined at {event.t_ns / 1e9:.2f} s, after the start"
        if event.kind == "control" and event.data.get("ok") and _is_kill_request(event):
            return f"a {PROCESS_KILL} was asked for at {event.t_ns / 1e9:.2f} s"
    return ""


def _is_end_by_failure(event: run_messages.Event, names: frozenset[str]) -> bool:
    """Return whether a user's code in one of these agents has failed, and the run ended by that."""
    return event.kind == "failure" and event.subject in names and event.data.get("on_death") == "end"


def _is_kill_request(event: run_messages.Event) -> bool:
    args = event.data.get("args")
    return event.subject == "fault_add" and isinstance(args, dict) and args.get("kind") == PROCESS_KILL


def _read(reader: RecordReader, expression: str) -> Iterator[tuple[str, Any]]:
    """Yield key and message on an expression, as they were written; the world too refused those that are left out."""
    wanted = [key for key in reader.topics() if keys.matches(expression, key)]
    for recorded in reader.messages(wanted, by_time=False):
        if (message := decode_or_none(recorded)) is not None:
            yield recorded.key, message


class GateInputs(NamedTuple):
    """What a record holds of a gate.

    Attributes:
        t_ns: of the gate.
        inputs: received by the world since the gate before, in order.
        truth: payloads at the gate, by drone.
    """

    t_ns: int
    inputs: list[Recorded]
    truth: dict[str, bytes]


def gates(reader: RecordReader, drones: list[str]) -> Iterator[GateInputs]:
    """Yield the inputs of each gate of a record, as far as it is whole."""
    truth_keys = {keys.truth(drone): drone for drone in drones}
    wanted = {key for key in reader.topics() if key in truth_keys or key == keys.CLOCK or _is_input(key)}
    inputs: list[Recorded] = []
    truth: dict[str, bytes] = {}
    last_ns = -1
    for recorded in reader.messages(wanted, by_time=False):
        if recorded.key in truth_keys:
            truth[truth_keys[recorded.key]] = recorded.payload
        elif recorded.key != keys.CLOCK:
            inputs.append(recorded)
        elif recorded.t_ns > last_ns and truth:  # while time stands, the clock of a gate is repeated
            yield GateInputs(recorded.t_ns, inputs, truth)
            inputs, truth, last_ns = [], {}, recorded.t_ns


def _is_input(key: str) -> bool:
    kind, _, what = keys.parts(key)
    if kind == "process":
        return what in PROCESS_MESSAGES
    if kind == "drone" and what == keys.SIGHTINGS:  # of a detector
        return True
    return key == keys.EVENT or keys.is_command(key) or messages.type_of(key) in messages.RELAYED
