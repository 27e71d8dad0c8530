"""Messages of users' agents: classes with a key, declared in `world/info` for readers without the class.

class State(zsim.AgentMessage, frozen=True):
    key = "swarm/{drone}/state"  # each drone's agent publishes on the key of its own drone
    position_m: tuple[float, float, float]
    is_leader: bool = False

State.of()  # "swarm/*/state", to read those of all
"""

import math
import re
from typing import ClassVar

from msgspec import Struct

from zsim.schema.message import FieldType, Whole, declared_type, field_types

KEY = re.compile(r"([a-z][a-z0-9_]{0,31})/\{(drone|cluster|run)\}/([a-z][a-z0-9_]{0,31})")
KEY_ALLOWED = "swarm/{drone}/state: a word, {drone}, {cluster} or {run}, and a word, of a-z 0-9 _"
NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
CONTRACT_WORDS = frozenset({"drone", "cluster", "process", "world", "view", "clock"})  # with which its keys begin


class AgentMessage(Struct, frozen=True, kw_only=True, gc=False):
    """Base of the messages of users' agents: `zsim.AgentMessage`.

    A subclass has `key`, in which `{drone}`, `{cluster}` or `{run}` stands for the name of what the agent is of, and
    fields: numbers, tuples and lists of numbers, whole numbers, true and false, text. zsim fills in t_ns, the gate at
    which it is published, seq, which counts the messages of a key from 0, and source, the process that publishes it.
    """

    key: ClassVar[str] = ""

    t_ns: Whole = -1
    seq: Whole = -1
    source: str = ""

    @classmethod
    def of(cls, thing: str = "*") -> str:
        """Return the key of the messages of one drone's or cluster's agent; by default the expression of all keys.

        Raises:
            ValueError: the class's key is invalid.
        """
        parts = KEY.fullmatch(cls.key)
        if parts is None:
            raise ValueError(f"{cls.__name__}.key is {cls.key!r:.60}; must be like {KEY_ALLOWED}")
        return f"{parts[1]}/{thing}/{parts[3]}"

    def fault(self) -> str | None:
        """Return the fault of a received message; a class may declare its numbers as plain floats."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name in ("t_ns", "seq") and value < 0:
                return f"{name} is missing or negative; must be >= 0"
            for number in value if isinstance(value, tuple | list) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    return f"{name} is {number}; must be finite"
        return None


class MessageInfo(Struct, frozen=True, omit_defaults=True):
    """A message of users' agents: `key` has `*` in place of a name; `fields` by name, beside t_ns, seq and source.

    `role` is the first part of the names of the processes that publish it.
    """

    key: str
    message: str
    fields: dict[str, FieldType]
    role: str = ""

    def declares(self, kind: object) -> bool:
        """Tell whether a class is one of these messages."""
        if not (isinstance(kind, type) and issubclass(kind, AgentMessage)):
            return False
        return kind.__name__ == self.message and field_types(kind, AgentMessage) == self.fields

    def is_sound(self) -> bool:
        """Tell whether a class can be made of it."""
        head, star, leaf = (*self.key.split("/"), "", "")[:3]
        key_is_sound = star == "*" and self.key.count("/") == 2 and head not in CONTRACT_WORDS
        return key_is_sound and all(map(NAME.fullmatch, (head, leaf, self.message.lower(), *self.fields)))


def message_info(kind: type[AgentMessage]) -> MessageInfo:
    """Return the declaration of a class of messages for other processes.

    Raises:
        TypeError: a field has a type not allowed in messages.
        ValueError: its key or its name is not allowed.
    """
    parts = KEY.fullmatch(kind.key)
    if not parts or parts[1] in CONTRACT_WORDS:
        reserved = f"must be like {KEY_ALLOWED}; not beginning with {', '.join(sorted(CONTRACT_WORDS))}"
        raise ValueError(f"{kind.__name__}.key is {kind.key!r:.60}; {reserved}")
    info = MessageInfo(f"{parts[1]}/*/{parts[3]}", kind.__name__, field_types(kind, AgentMessage))
    if not info.is_sound():
        raise ValueError(f"{kind.__name__}, or a field of it, is no name; must be letters, a-z 0-9 _, at most 32")
    return info


def type_of_info(info: MessageInfo) -> type[AgentMessage]:
    """Return a class made from a declaration, for processes without the user's class."""
    return declared_type(info.message, info.fields, AgentMessage, (("key", info.key),))


def about(kind: type[AgentMessage]) -> str:
    """Return the scope of the agents that publish a class: "drone", "cluster" or "run"."""
    parts = KEY.fullmatch(kind.key)
    return parts[2] if parts else ""
