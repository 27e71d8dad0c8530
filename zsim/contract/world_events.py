"""The events of the world that a process acts on, with their data checked: anybody may publish on `world/event`."""

from typing import NamedTuple

import msgspec
from msgspec import Struct

from zsim.contract import keys, messages, run_messages
from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError
from zsim.schema.message import Count, Whole


class NoData(Struct, frozen=True):
    """Data of which nothing is used."""


class RunEnd(Struct, frozen=True):
    """The run is over; `last_ns` is its last gate."""

    last_ns: Count


class ProcessEntry(Struct, frozen=True):
    """A process has been taken in.

    Attributes:
        from_ns: first gate that it is waited for.
        done_ns: newest gate that it, or its former incarnation, is through with; -1 for none.
        former_pid: of the incarnation whose place it takes.
    """

    incarnation: int
    host: str
    pid: int
    from_ns: Count
    done_ns: Whole = -1
    former_pid: int | None = None


class WorldEvent(NamedTuple):
    """An event of a kind that processes act on."""

    kind: str
    subject: str
    data: Struct


_EVENT_DATA: dict[str, type[Struct]] = {
    "end": RunEnd,
    "join": ProcessEntry,
    "restart": ProcessEntry,
    "superseded": ProcessEntry,
    "leave": NoData,
    "drop": NoData,
}


def read_event(payload: bytes) -> WorldEvent | None:
    """Return the notice in an event, None for an event of another kind.

    Raises:
        DecodeError: it is no event, or its data is not what its kind has.
    """
    event: run_messages.Event = messages.decode(keys.EVENT, payload)
    kind = _EVENT_DATA.get(event.kind)
    if kind is None:
        return None
    try:
        return WorldEvent(event.kind, event.subject, msgspec.convert(event.data, kind))
    except REFUSALS as error:
        raise DecodeError(f"{keys.EVENT}: data of {event.kind!r} is refused ({error}); see docs/protocol.md") from error
