"""Messages about the run, contract version 1: time, events, participation, injected faults, and requests."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from msgspec import UNSET, Struct, UnsetType, field

from zsim.contract.keys import on
from zsim.schema.message import Count, Message, Number, Whole

GATES_MAX = 1_000_000  # per `step` request: 5.5 hours with gates of 20 ms
RATE_MAX = 1000.0  # simulated per wall time; faster rates cannot be paced
PRIORITY_MAX = 100  # programs use 0, operators 10
SOON_S = 0.5  # wall time [s] for which waiting is normal
WAITING_SHOWN = 4  # maximum number of processes named in a line


class Waiting(Struct, frozen=True):
    """A process that the world waits for, its host, and for how long [s of wall time].

    `held_by` names the other awaited processes whose outputs it reads: it may merely be waiting for those.
    """

    name: str
    host: str
    since_wall_s: Number
    held_by: tuple[str, ...] = ()

    def __str__(self) -> str:
        on = f" on {self.host}" if self.host else ""
        holders = f", held by {', '.join(self.held_by)}" if self.held_by else ""
        return f"{self.name}{on} ({self.since_wall_s:.1f} s{holders})"


def holding_up(state: str, waiting: Sequence[Waiting]) -> Sequence[Waiting]:
    """Return the awaited processes that block a run with its clock in `state`; if known, only the causes.

    Unless the state is `waiting`, waits of up to SOON_S are normal and do not count.
    """
    delayed = [each for each in waiting if state == "waiting" or each.since_wall_s > SOON_S]
    return [each for each in delayed if not each.held_by] or delayed


def waiting_text(state: str, waiting: Sequence[Waiting]) -> str:
    """Return "waiting for" and the processes that hold up a run (see `holding_up`); empty if there are none."""
    blocking = holding_up(state, waiting)
    remainder = [f"{len(blocking) - WAITING_SHOWN} more"] if len(blocking) > WAITING_SHOWN else []
    return f"waiting for {', '.join([*map(str, blocking[:WAITING_SHOWN]), *remainder])}" if blocking else ""


@on("clock", writers="world", readers="each", last="world")
class Clock(Message, frozen=True):
    """The newest gate of the world, and the measured rate of time.

    `waiting_for` names the processes that the world waits for; in realtime, those that are dead, silent or away.
    """

    run_id: str
    step: Count
    state: Literal["waiting", "running", "paused", "stopped"]
    rate: Number
    waiting_for: tuple[Waiting, ...] = ()


ADMISSIONS = ("join", "restart", "superseded")  # kinds of events of a process that has joined or rejoined
INCIDENTS = ("emergency", "flip", "impact", "touchdown", "battery")  # kinds of events of a drone that fails in flight
EVENT_KINDS = (
    *ADMISSIONS, "doubled", "no_show", "slow_reader", "silent", "silent_end", "standstill", "leave", "death", "drop",
    "failure", "overdue", "fingerprint", "commander", "release", "mode", "command", "control", "refused",
    "outputs_missing", "fault", "fault_end", "fault_clear", "collision", *INCIDENTS, "landing", "mission", "diverged",
    "end",
)  # fmt: skip
"""All kinds of events, explained in docs/protocol.md."""


@on("world/radio", writers="world", readers="each", last="world")
class RadioLinks(Message, frozen=True):
    """The connectivity at a gate between the agents of drones that exchange messages, if the scenario has a radio.

    Drones are given by their indices in `world/info`; the index after the last one is the ground station of the agents
    of clusters and of the run, if the radio has a `station_m`. `hears` has, for each index, the indices from which it
    receives messages, ascending; `reception` has the probability for each of these, before the radio's `loss`, and is
    empty if all are 1.
    """

    hears: tuple[tuple[Count, ...], ...]
    reception: tuple[tuple[Number, ...], ...] = ()


FURTHER_COUNTED = " (further ones are counted only)"
"""The end of the last event of many equal refusals, in records of all versions."""


@on("world/event", writers="world", readers="each")
class Event(Message, frozen=True):
    """An event: kind (one of EVENT_KINDS), source, subject, text and data."""

    kind: str
    source: str
    subject: str
    text: str
    data: dict[str, Any] = field(default_factory=dict)

    def fault(self) -> str | None:
        return _infinite_fault("data", self.data)


@on("process/*/join", writers="each")
class Join(Message, frozen=True):
    """A process joins the run; of several incarnations (random numbers), the newest counts.

    `period_ns` is the interval of its dones: a multiple of the gate, 0 if not fixed. `serves` names processes that need
    not join, since this one replaces them. `slack_ns` is how far the world may be ahead of the dones of a process
    without a period, 0 for any distance.
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
    """All messages up to `done_ns` have been processed and answered; `sent` outputs were sent since the last done."""

    run_id: str
    incarnation: int
    done_ns: Whole
    sent: Count


@on("process/*/snapshot", writers="each", last="world")
class Snapshot(Message, frozen=True):
    """The state of a participant after the gate `t_ns`, from which another incarnation of it can continue.

    `version` numbers the layout of `state`, which is specific to the program.
    """

    source: str
    version: Count
    state: bytes


@on("process/*/bye", writers="each")
class Bye(Message, frozen=True):
    """A process leaves voluntarily; `failed` if it cannot continue and would fail again after a restart.

    `run_id` and `incarnation` are those of the join that it ends. Clients of contract 1.0 name neither: their byes
    take effect once the liveliness token is lost as well, or the run is over.
    """

    reason: str
    failed: bool | UnsetType = UNSET
    run_id: str | UnsetType = UNSET
    incarnation: int | UnsetType = UNSET


RUN_ENDED = "the run ended"  # reason of a bye at the end of a run


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
    """An injected fault: kind and parameters as in docs/faults.md; its target is a drone, link, cluster or process.

    It acts in the gates after `from_ns`, up to `until_ns` or until it is cleared. `source` is "scenario" or the process
    that requested it. `rank` counts earlier faults of the same kind, target and start: each has its own random stream.
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
    """The planned and acting faults, in order of their ids; published before the gate in which they change."""

    faults: tuple[Fault, ...] = ()


class ControlRequest(Struct, frozen=True):
    """A request on `world/control`, `cluster/{c}/control` or `drone/{d}/control`."""

    op: str
    args: dict[str, Any] = {}
    source: str = ""

    def fault(self) -> str | None:
        return _infinite_fault("args", self.args)


class ControlAnswer(Struct, frozen=True):
    """The answer to a request: whether it was carried out, the error if not, and the result.

    `more` is the number of the next page of a replay; None if there is none.
    """

    ok: bool
    error: str = ""
    result: Any = None
    more: Count | None = None

    def fault(self) -> str | None:
        return _infinite_fault("result", self.result)


@on("cluster/*/request", writers="controller", is_output=True)
@on("drone/*/request", writers="reference", is_output=True)
class ClusterRequest(Message, frozen=True):
    """A request answered on `cluster/{c}/control` or `drone/{d}/control` before the outputs of the gate `t_ns`.

    `source` is the requesting process; `error` is the reason for a refusal. `controller` is the process that answered.
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
    """Return the fault of a field with arbitrary content if it contains a number that is not finite."""
    infinite = next((number for number in _numbers(value) if not math.isfinite(number)), None)
    return None if infinite is None else f"{field} contains {infinite}; its numbers must be finite"


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
