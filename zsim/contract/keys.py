"""The keys of the contract: construction, parsing, matching, and the table of their messages.

Inside a process, keys lack the federation's prefix ("drone/drone1/truth"); the session adds it. A message class
declares its keys with `on`; decoders, access rights and the last values that the world returns are derived from the
table of these declarations, TOPICS.
"""

import re
from collections.abc import Callable
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple, TypeVar

from msgspec import Struct

from zsim.errors import BadNameError
from zsim.sensors.sensor_catalogue import STOCK

NAME = re.compile(r"[a-z0-9_.-]{1,32}")
PROCESS_NAME = re.compile(r"[a-z0-9_.-]{1,48}")  # a role, a dot, and a drone or cluster name of up to 32 characters
SENSORS = tuple(STOCK)
SIGHTINGS = "sightings"  # a sensor of drones with cameras, computed by the world; its messages vary in length

INFO = "world/info"
CLOCK = "clock"
EVENT = "world/event"
FAULTS = "world/faults"
CONTROL = "world/control"
RADIO = "world/radio"
VIEW_DRONES = "view/drones"
BATCH = "@batch"  # all messages through the hub except views and pictures, see zsim.contract.framing
GATE = "@gate"  # the world's messages about all drones at a gate
ACCESS = "@access"  # a process's permissions under access control, see zsim.transport.tls

AnyMessage = TypeVar("AnyMessage", bound=type[Struct])


class Topic(NamedTuple):
    """The declaration of a key in the contract."""

    message: Any  # type of its messages; None for a family of keys, whose members declare their own
    writers: tuple[str, ...]  # roles that publish on it; "each" means every process, on keys with its own name
    readers: tuple[str, ...]  # roles that subscribe to it, besides recorders and operators, which read everything
    last: str  # process that answers a get with the last message: "world", "writer" or "" (none)
    is_output: bool  # whether the world checks its messages against the count in the publisher's done


TOPICS: dict[str, Topic] = {}  # topics by key, with `*` in place of a name


def on(
    key: str, writers: str = "", readers: str = "", last: str = "", is_output: bool = False
) -> Callable[[AnyMessage], AnyMessage]:
    """Return a decorator that declares a message class for a key; see Topic.

    Args:
        key: key with `*` in place of a name; a second `*` makes it a family, whose members are declared individually.
        writers, readers: roles, separated by spaces.
    """

    def declare(message: AnyMessage) -> AnyMessage:
        kind = None if key.count("*") > 1 else message
        TOPICS[key] = Topic(kind, tuple(writers.split()), tuple(readers.split()), last, is_output)
        return message

    return declare


def name(text: str, what: str = "name") -> str:
    """Return `text` if it is a valid name; otherwise raise BadNameError."""
    if not isinstance(text, str) or not NAME.fullmatch(text):
        raise BadNameError(f"{what} is {text!r}; must be 1 to 32 of a-z 0-9 _ . -")
    return text


# Construction of keys


def sensor(drone: str, kind: str) -> str:
    return f"drone/{drone}/sensor/{kind}"


def sensors(drone: str) -> str:
    return f"drone/{drone}/sensor/*"


def status(drone: str) -> str:
    return f"drone/{drone}/sensor/status"


def truth(drone: str) -> str:
    return f"drone/{drone}/truth"


def estimate(drone: str) -> str:
    return f"drone/{drone}/estimate"


def command(drone: str, kind: str) -> str:
    return f"drone/{drone}/cmd/{kind}"


def accepted(drone: str, kind: str) -> str:
    return f"drone/{drone}/accepted/{kind}"


def link(drone: str) -> str:
    return f"drone/{drone}/link"


def driver(drone: str) -> str:
    return f"drone/{drone}/driver"


def reference(drone: str) -> str:
    return f"drone/{drone}/reference"


def drone_control(drone: str) -> str:
    return f"drone/{drone}/control"


def drone_request(drone: str) -> str:
    return f"drone/{drone}/request"


def control_of(request_key: str) -> str:
    """Return the control key on which a recorded request arrived."""
    return f"{request_key.rpartition('/')[0]}/control"


def camera(drone: str, name: str) -> str:
    return f"drone/{drone}/camera/{name}"


def camera_info(drone: str, name: str) -> str:
    return f"drone/{drone}/camera/{name}/info"


def detections(drone: str) -> str:
    """Return the key on which a detector publishes its sightings in pictures of a drone's cameras."""
    return f"drone/{drone}/sightings"


def gate(drone: str) -> str:
    return f"{GATE}/{drone}"


def cluster_state(cluster: str) -> str:
    return f"cluster/{cluster}/state"


def cluster_control(cluster: str) -> str:
    return f"cluster/{cluster}/control"


def cluster_request(cluster: str) -> str:
    return f"cluster/{cluster}/request"


def cluster_view(cluster: str) -> str:
    return f"view/cluster/{cluster}"


def estimates_view(process_name: str) -> str:
    return f"view/estimates/{process_name}"


def process(process_name: str, topic: str) -> str:
    """Return a key of a process; `topic` is `join`, `done`, `snapshot`, `bye`, `health`, `replay` or `outputs`."""
    return f"process/{process_name}/{topic}"


def replay(process_name: str) -> str:
    """Return the key on which the world answers a process with the messages that it missed and may read."""
    return process(process_name, "replay")


def access(process_name: str) -> str:
    """Return the key on which a listening process answers with the permissions of a process's certificate."""
    return f"{ACCESS}/{process_name}"


def token(process: str) -> str:
    return f"process/{process}"


def session_token(process: str, session: str) -> str:
    """Return the token with which a process declares its Zenoh session."""
    return f"process/{process}/session/{session}"


def session_of(token_key: str) -> str:
    head, _, session = token_key.rpartition("/session/")
    return session if head else ""


# Parsing of keys


@lru_cache(maxsize=4096)
def parts(key: str) -> tuple[str, str, str]:
    """Return the parts of a key, e.g. `drone`, its name, and `cmd/mode`; missing parts are empty."""
    kind, owner, topic, *_ = *key.split("/", 2), "", ""
    return kind, owner, topic


def thing(key: str) -> str:
    return key.split("/", 2)[1]


def leaf(key: str) -> str:
    return key.rsplit("/", 1)[-1]


def is_command(key: str) -> bool:
    return key.startswith("drone/") and "/cmd/" in key


def is_accepted(key: str) -> bool:
    kind, _, topic = parts(key)
    return kind == "drone" and topic.startswith("accepted/")


def is_sensor(expression: str) -> bool:
    """Return whether a key or expression concerns a drone's sensors."""
    parts = expression.split("/")
    return len(parts) == 4 and parts[0] == "drone" and parts[2] == "sensor"


def is_status(key: str) -> bool:
    return key.endswith("/sensor/status")


@lru_cache(maxsize=4096)
def is_picture(key: str) -> bool:
    """Return whether a key carries pictures, which are large and not needed for lockstep."""
    kind, _, topic = parts(key)
    return kind == "drone" and topic.startswith("camera/") and topic.count("/") == 1


def may_drop(key: str) -> bool:
    """Return whether a full link may drop a key's messages in realtime, since newer ones follow."""
    return "/sensor/" in key or key.startswith(GATE)


# Key expressions


def matches(expression: str, key: str) -> bool:
    """Return whether a key expression matches a key, as in Zenoh; for the in-process bus and the history.

    `*` matches one chunk, `**` any number of chunks, `$*` a part of one; a chunk that begins with `@` matches only
    literally.
    """
    return expression == key or _compiled(expression).fullmatch(f"{key}/") is not None


_CHUNK = "[^/@][^/]*/"
_PART = "[^/]*"


@lru_cache(maxsize=4096)  # bounded, since requests of other processes contain expressions too
def _compiled(expression: str) -> re.Pattern[str]:
    """Return the pattern of an expression, for keys followed by "/".

    The text between two wildcards is matched at its first occurrence, without backtracking (atomic groups), so that
    no expression takes more than linear time per wildcard.
    """
    chunks = expression.split("/")
    runs = [list(run) for wild, run in groupby(chunks, lambda chunk: chunk == "**") if not wild]
    texts = ["".join(map(_chunk, run)) for run in runs]
    if "**" not in chunks:
        return re.compile(texts[0])
    head = "" if chunks[0] == "**" else texts.pop(0)
    tail = "" if chunks[-1] == "**" else texts.pop()
    middle = "".join(f"(?>(?:{_CHUNK})*?{text})" for text in texts)
    return re.compile(f"{head}{middle}(?:{_CHUNK})*{tail}")


def _chunk(chunk: str) -> str:
    """Return the pattern of one chunk of an expression, including its "/"."""
    if chunk == "*":
        return _CHUNK
    if chunk.startswith("@") or "$*" not in chunk:
        return re.escape(f"{chunk}/")
    first, *others = map(re.escape, chunk.split("$*"))
    last = others.pop()
    middle = "".join(f"(?>{_PART}?{text})" for text in others)
    return f"{'' if first else '(?!@)'}{first}{middle}{_PART}{last}/"
