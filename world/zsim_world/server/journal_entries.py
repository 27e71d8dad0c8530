"""What a world is handed, as entries of its journal: handed once more in the same order, it is the same world."""

from typing import Any

import msgspec


class Entry(msgspec.Struct, array_like=True, tag_field="kind", tag=True):
    """Something that the world was handed."""


class Taken(Entry, tag=0):
    """A message of somebody else's."""

    wall_ns: int
    key: str
    payload: bytes


class Advanced(Entry, tag=1):
    """Permission to go on by a gate, which came too late or not."""

    wall_ns: int
    late: bool


class Died(Entry, tag=2):
    """The death of a process."""

    wall_ns: int
    name: str


class Controlled(Entry, tag=3):
    """A request on `world/control`."""

    request: bytes


class GivenUp(Entry, tag=4):
    """Outputs of a participant that are lost."""

    name: str


class Kept(Entry, tag=5):
    """A message of the world's own beside those of gates."""

    key: str
    payload: bytes


class Resumed(Entry, tag=6):
    """That another incarnation of the world went on here."""

    wall_ns: int
    all_died: bool


class Joined(Entry, tag=7):
    """A join that was admitted."""

    wall_ns: int
    name: str
    join: bytes


class FalselyJoined(Entry, tag=8):
    """A join in the place of another, behind which nobody is."""

    name: str
    join: bytes
    reason: str


class NotShown(Entry, tag=9):
    """A participant that never showed that it is there."""

    wall_ns: int
    name: str
    reason: str


class FellSilent(Entry, tag=10):
    """That a process publishes its health no longer since a wall time, or does again."""

    name: str
    since_wall_ns: int | None


class ReaderClosed(Entry, tag=11):
    """That a reader has lost its link."""

    text: str
    data: dict[str, Any]


class Expired(Entry, tag=12):
    """That a process has not come back in its time."""

    name: str


_OfWorld = Advanced | Kept | Resumed
_OfOthers = Taken | Controlled | GivenUp | Joined | ReaderClosed
_OfLosses = Died | FalselyJoined | NotShown | FellSilent | Expired
encode = msgspec.msgpack.Encoder().encode
decode = msgspec.msgpack.Decoder(list[_OfWorld | _OfOthers | _OfLosses]).decode
