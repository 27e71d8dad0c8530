"""Messages about the run: time, events, who takes part, injected faults, and requests. The contract, version 1."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from msgspec import UNSET, Struct, UnsetType, field

from zsim.contract.keys import on
from zsim.schema.message import Count, Message, Number, Whole

GATES_MAX = 1_000_000  # of one `step`: 5.5 hours at 20 ms
RATE_MAX = 1000.0  # simulated per wall second; beyond it nothing paces
PRIORITY_MAX = 100  # programs have 0, operators 10
SOON_S = 0.5  # wall


class Waiting(Struct, frozen=True):
    """A process that the world waits for, its host, and the wall time since when [s].

    `held_by` names those among the others whose outputs it reads: it is not the cause, and may only wait for them.
    """

    name: str
    host: str
    since_wall_s: Number
    held_by: tuple[str, ...] = ()


def holding_up(state: str, waiting: Sequence[Waiting]) -> Sequence[Waiting]:
    """Return the processes that hold up a run whose clock is in `state`: of those waited for, the causes if known.

    While it runs, it often waits for up to SOON_S, which holds up nothing.
    """
    late = [each for each in waiting if state == "waiting" or each.since_wall_s > SOON_S]
    return [each for each in late if not each.held_by] or late


@on("clock", writers="world", readers="each", last="world")
class Clock(Message, frozen=True):
    """The gate that the world has published; its `rate` is measured. `waiting_for` is filled while time stands."""

    run_id: str
    step: Count
    state: Literal["waiting", "running", "paused", "stopped"]
    rate: Number
    waiting_for: tuple[Waiting, ...] = ()


EVENT_KINDS = (
    "join", "restart", "superseded", "doubled", "no_show", "slow_reader", "silent", "silent_end", "standstill", "leave",
    "death", "drop", "failure", "overdue", "fingerprint", "commander", "release", "mode", "command", "control",
    "refused", "outputs_missing", "fault", "fault_end", "fault_clear", "collision", "emergency", "landing", "flip",
    "impact", "battery", "touchdown", "mission", "diverged", "end",
)  # fmt: skip
"""All kinds of events; docs/protocol.md says when each comes."""


@on("world/radio", writers="world", readers="each", last="world")
class RadioLinks(Message, frozen=True):
    """Who hears whom at a gate, among the agents of drones that exchange messages; where the scenario has a radio.

    Drones are known by their places in `world/info`; the place after the last one is that of the ground station, whose
    agents are of clusters or of the run, where the radio's `station_m` says that it has one. `hears` has, for each
    place, those whose messages come through, in rising order; `reception` the probability of each, before the radio's
    `loss`, and is empty where all are 1.
    """

    hears: tuple[tuple[Count, ...], ...]
    reception: tuple[tuple[Number, ...], ...] = ()


@on("world/event", writers="world", readers="each")
class Event(Message, frozen=True):
    """Something that happened once: what (one of EVENT_KINDS), by whom, about whom, in words, and in figures."""

    kind: str
    source: str
    subject: str
    text: str
    data: dict[str, Any] = field(default_factory=dict)

    def fault(self) -> str | None:
        return _infinite_fault("data", self.data)


@on("process/*/join", writers="each")
class Join(Message, frozen=True):
    """A process takes part from now on; the newest of several random incarnations counts.

    `period_ns` is how often it publishes done: a multiple of the gate, 0 for never. `serves` names processes that need
    not join, since this one does what they would. `slack_ns` is by how much the world may be ahead of the dones of one
    that has no period, 0 for any.
    """

    run_id: str
    incarnation: int
    role: str
    host: str
    pid: int
    period_ns: Whole
    version: str = ""
    fingerprint: str = ""
    serves: tuple[str, ...] = ()
    slack_ns: Count = 0


@on("process/*/done", writers="each")
class Done(Message, frozen=True):
    """Everything stamped up to `done_ns` is handled and answered; `sent` outputs were sent since the last done."""

    run_id: str
    incarnation: int
    done_ns: Whole
    sent: Count


@on("process/*/snapshot", writers="each", last="world")
class Snapshot(Message, frozen=True):
    """The whole state of a participant after the gate `t_ns`, by which another incarnation of it can go on.

    `version` is that of the layout of `state`, which only programs of its kind read.
    """

    source: str
    version: Count
    state: bytes


@on("process/*/bye", writers="each")
class Bye(Message, frozen=True):
    """A process leaves of its own will; `failed`: since it cannot go on, and would fail again if it were restarted.

    `run_id` and `incarnation` are those of the join that it ends. Clients of contract 1.0 name neither: their byes
    count once the liveliness token is gone as well, or the run is over.
    """

    reason: str
    failed: bool | UnsetType = UNSET
    run_id: str | UnsetType = UNSET
    incarnation: int | UnsetType = UNSET


RUN_ENDED = "the run ended"  # reason of whoever leaves because the run is over


@on("process/*/health", writers="each")
class Health(Message, frozen=True):
    role: str
    host: str
    pid: int
    step_us: dict[str, Number]
    lag_ns: Whole
    dropped: Count
    refused: Count
    rss_bytes: Count
    received: Count = 0
    reads: tuple[str, ...] = ()


class Fault(Struct, frozen=True):
    """An injected fault: a kind and parameters of docs/faults.md, a drone, link, cluster or process as its target.

    It acts in the gates after `from_ns` up to `until_ns`, or until it is cleared. `source` is "scenario", or who asked.
    `rank` counts those of the same kind, target and start before it: each of them has a stream of its own.
    """

    id: Count
    kind: str
    target: str
    parameters: dict[str, Any]
    from_ns: Count
    until_ns: Count | None = None
    source: str = ""
    rank: Count = 0


@on("world/faults", writers="world", readers="each", last="world")
class Faults(Message, frozen=True):
    """The faults that are planned or act, in the order of their ids; published before the gate that a change is in."""

    faults: tuple[Fault, ...] = ()


class ControlRequest(Struct, frozen=True):
    """What is asked of `world/control`, `cluster/{c}/control` and `drone/{d}/control`."""

    op: str
    args: dict[str, Any] = {}
    source: str = ""

    def fault(self) -> str | None:
        return _infinite_fault("args", self.args)


class ControlAnswer(Struct, frozen=True):
    """Whether a request was done; if not, why; and what it asked for."""

    ok: bool
    error: str = ""
    result: Any = None
    more: Count | None = None

    def fault(self) -> str | None:
        return _infinite_fault("result", self.result)


@on("cluster/*/request", writers="controller", is_output=True)
@on("drone/*/request", writers="reference", is_output=True)
class ClusterRequest(Message, frozen=True):
    """A request on `cluster/{c}/control` or `drone/{d}/control` as it was taken, before the outputs of the gate `t_ns`.

    `source` is who asked; `error` is why it is refused. `controller` is the process that answered.
    """

    op: str
    args: dict[str, Any]
    source: str
    ok: bool
    error: str = ""
    controller: str = ""

    def fault(self) -> str | None:
        return _infinite_fault("args", self.args)


def _infinite_fault(field: str, value: Any) -> str | None:
    """Return the fault of a field of any content whose numbers must be finite."""
    infinite = next((number for number in _numbers(value) if not math.isfinite(number)), None)
    return None if infinite is None else f"{field} holds {infinite}; must be finite numbers"


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(key)
            yield from _numbers(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
