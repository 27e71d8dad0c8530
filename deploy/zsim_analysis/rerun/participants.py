"""Who took part in a run on record, and whether its agents can be run again. Pure, but for the record that it reads."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.errors import DecodeError
from zsim.record import RecordReader
from zsim.scenario.fault_kinds import PROCESS_KILL
from zsim.scenario.role_table import AGENTS
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import agents_of

LOST = ("death", "restart", "superseded", "doubled", "drop", "leave")  # events of who did not stay all the time


class Team(NamedTuple):
    """A process of ours: its name, and the names of all whose work it did."""

    name: str
    members: tuple[str, ...]

    def __str__(self) -> str:
        others = ", ".join(member for member in self.members if member != self.name)
        return f"{self.name} (with {others})" if others else self.name


class Cast(NamedTuple):
    """Who took part.

    Attributes:
        teams: the processes whose agents can be run again; empty where there is a reason not to.
        why_not: that reason.
        requests: what their controllers were asked, in order.
        fingerprints: numeric ones, with which ours computed.
        truth_sha256: that the world told at the end of the run, None where the record has no end.
    """

    teams: tuple[Team, ...]
    why_not: str
    requests: tuple[tuple[str, messages.ClusterRequest], ...]
    fingerprints: frozenset[str]
    truth_sha256: str | None

    @property
    def played(self) -> frozenset[str]:
        """Return the names of all processes that are run again."""
        return frozenset(name for team in self.teams for name in (team.name, *team.members))


def cast_of(reader: RecordReader, info: messages.Info, scenario: Scenario) -> Cast:
    """Return who took part in the run of a record."""
    known = set(agents_of(scenario)) if scenario.drones else set()
    joins = [(keys.thing(key), join) for key, join in _read(reader, "process/*/join")]
    ours = [(name, join) for name, join in joins if _is_ours(name, join, known)]
    found = [Team(name, (*join.serves, name)) for name, join in dict(ours).items()]
    teams = tuple(sorted(found, key=lambda team: ([*AGENTS].index(team.name.partition(".")[0]), team.name)))
    names = frozenset(name for team in teams for name in team.members)
    events: list[messages.Event] = [event for _, event in _read(reader, keys.EVENT)]
    why_not = _reason(info, scenario, events, names)
    requests = tuple(_read(reader, "cluster/*/request"))
    fingerprints = frozenset(join.fingerprint for _, join in ours)
    told = next((event.data.get("truth_sha256") for event in reversed(events) if event.kind == "end"), None)
    return Cast(() if why_not else teams, why_not, requests, fingerprints, told)


def _is_ours(name: str, join: messages.Join, known: set[str]) -> bool:
    """Tell whether a process was one of zsim's agents: others do not say by which numeric fingerprint they compute."""
    return bool(join.version and join.fingerprint) and {name, *join.serves} <= known


def _reason(info: messages.Info, scenario: Scenario, events: Sequence[messages.Event], names: frozenset[str]) -> str:
    """Return why the agents are not run again, empty if they can be."""
    if info.mode == "realtime":
        return "in realtime it is not in the scenario when they answered"
    if not names:
        return "none of zsim's took part"
    if any(fault.get("kind") == PROCESS_KILL for fault in scenario.faults):
        return f"a {PROCESS_KILL} was planned"
    for event in events:
        if event.kind == "end":
            break
        if event.kind in LOST and event.subject in names:
            return f"{event.kind} of {event.subject} at {event.t_ns / 1e9:.2f} s"
        if event.kind == "outputs_missing" and event.subject in names:
            return f"outputs of {event.subject} were lost at {event.t_ns / 1e9:.2f} s"
        if event.kind == "join" and event.subject in names and event.data.get("from_ns", 0):
            return f"{event.subject} joined at {event.t_ns / 1e9:.2f} s, after the start"
        if event.kind == "control" and event.data.get("ok") and _asks_kill(event):
            return f"a {PROCESS_KILL} was asked for at {event.t_ns / 1e9:.2f} s"
    return ""


def _asks_kill(event: messages.Event) -> bool:
    args = event.data.get("args")
    return event.subject == "fault_add" and isinstance(args, dict) and args.get("kind") == PROCESS_KILL


def _read(reader: RecordReader, expression: str) -> Iterator[tuple[str, Any]]:
    """Yield key and message of what can be read on an expression, as it was written."""
    wanted = [key for key in reader.topics() if keys.matches(expression, key)]
    for recorded in reader.messages(wanted, by_time=False):
        try:
            yield recorded.key, messages.decode(recorded.key, recorded.payload)
        except DecodeError:
            continue  # the world, or the controller, refused it too
