"""The keys of the contract: built and taken apart here, nowhere else.

Keys inside a process are without the federation's prefix ("drone/drone1/truth"); the session adds it.
"""

import re
from functools import lru_cache
from itertools import groupby

from zsim.errors import BadNameError
from zsim.sensors.sensor_catalogue import STOCK

NAME = re.compile(r"[a-z0-9_.-]{1,32}")
PROCESS_NAME = re.compile(r"[a-z0-9_.-]{1,48}")  # a role, a dot, and a thing of up to 32
SENSORS = tuple(STOCK)
SIGHTINGS = "sightings"  # a sensor of drones with cameras, computed by the world; its messages have any length

INFO = "world/info"
CLOCK = "clock"
EVENT = "world/event"
FAULTS = "world/faults"
CONTROL = "world/control"
VIEW_DRONES = "view/drones"
BATCH = "@batch"  # everything that passed the hub, see zsim.contract.framing
GATE = "@gate"  # the world's messages about all drones at a gate
ACCESS = "@access"  # what access control lets a process do, see zsim.transport.tls


def name(text: str, what: str = "name") -> str:
    """Return `text` if it is a name of the contract.

    Raises:
        BadNameError: with what was found and what is allowed.
    """
    if not isinstance(text, str) or not NAME.fullmatch(text):
        raise BadNameError(f"{what} is {text!r}; must be 1 to 32 of a-z 0-9 _ . -")
    return text


def sensor(drone: str, kind: str) -> str:
    return f"drone/{drone}/sensor/{kind}"


def sensors(drone: str) -> str:
    return f"drone/{drone}/sensor/*"


def status(drone: str) -> str:
    return f"drone/{drone}/sensor/status"


def camera(drone: str, name: str) -> str:
    return f"drone/{drone}/camera/{name}"


def camera_info(drone: str, name: str) -> str:
    return f"drone/{drone}/camera/{name}/info"


@lru_cache(maxsize=4096)
def is_picture(key: str) -> bool:
    """Tell whether a key has pictures: large, and never needed by the lockstep."""
    kind, _, what = parts(key)
    return kind == "drone" and what.startswith("camera/") and what.count("/") == 1


def detections(drone: str) -> str:
    """Return the key on which a detector publishes what it found in pictures of a drone's cameras."""
    return f"drone/{drone}/sightings"


def gate(drone: str) -> str:
    """Return the key of the world's messages about one drone at a gate."""
    return f"{GATE}/{drone}"


def truth(drone: str) -> str:
    return f"drone/{drone}/truth"


def command(drone: str, kind: str) -> str:
    return f"drone/{drone}/cmd/{kind}"


def accepted(drone: str, kind: str) -> str:
    """Return the key on which the world repeats a command to an external drone that it accepts."""
    return f"drone/{drone}/accepted/{kind}"


def is_accepted(key: str) -> bool:
    """Tell whether a key has commands to an external drone as the world repeats them."""
    kind, _, what = parts(key)
    return kind == "drone" and what.startswith("accepted/")


def link(drone: str) -> str:
    """Return the key on which a driver publishes the state of its link to an external drone."""
    return f"drone/{drone}/link"


def driver(drone: str) -> str:
    """Return the key on which the driver of an external drone answers requests."""
    return f"drone/{drone}/driver"


def estimate(drone: str) -> str:
    return f"drone/{drone}/estimate"


def cluster_state(cluster: str) -> str:
    return f"cluster/{cluster}/state"


def cluster_control(cluster: str) -> str:
    return f"cluster/{cluster}/control"


def cluster_request(cluster: str) -> str:
    """Return the key on which a controller publishes the requests that it took."""
    return f"cluster/{cluster}/request"


def cluster_view(cluster: str) -> str:
    return f"view/cluster/{cluster}"


def estimates_view(process_name: str) -> str:
    """Return the key on which an estimator publishes its estimates for displays."""
    return f"view/estimates/{process_name}"


def token(process: str) -> str:
    return f"process/{process}"


def session_token(process: str, session: str) -> str:
    """Return the token by which a process says which session of Zenoh's is its own."""
    return f"process/{process}/session/{session}"


def session_of(token_key: str) -> str:
    """Return the session that a token is about, empty if it is about none."""
    head, _, session = token_key.rpartition("/session/")
    return session if head else ""


def process(process_name: str, what: str) -> str:
    """Return the key of `join`, `done`, `snapshot`, `bye` or `health` of a process."""
    return f"process/{process_name}/{what}"


@lru_cache(maxsize=4096)
def parts(key: str) -> tuple[str, str, str]:
    """Return what a key is about, whose it is, and what of it; empty where it is shorter: `drone`, name, `cmd/mode`."""
    kind, whose, what, *_ = *key.split("/", 2), "", ""
    return kind, whose, what


def replay(process_name: str) -> str:
    """Return the key on which the world answers a process for what it may read and missed."""
    return process(process_name, "replay")


def access(process_name: str) -> str:
    """Return the key on which whoever listens answers what the certificate of a process lets it do."""
    return f"{ACCESS}/{process_name}"


def is_command(key: str) -> bool:
    """Tell whether a key is that of commands to a drone."""
    return key.startswith("drone/") and "/cmd/" in key


def is_sensor(expression: str) -> bool:
    """Tell whether a key, or an expression, is about a drone's sensors."""
    parts = expression.split("/")
    return len(parts) == 4 and parts[0] == "drone" and parts[2] == "sensor"


def may_drop(key: str) -> bool:
    """Tell whether a full link may lose messages of a key in realtime, as it may sensors: newer ones come."""
    return "/sensor/" in key or key.startswith(GATE)


def is_status(key: str) -> bool:
    """Tell whether a key is a drone's status."""
    return key.endswith("/sensor/status")


def thing(key: str) -> str:
    """Return the second part of a key: the drone, cluster or process that it is about."""
    return key.split("/", 2)[1]


def leaf(key: str) -> str:
    """Return the last part of a key."""
    return key.rsplit("/", 1)[-1]


def matches(expression: str, key: str) -> bool:
    """Tell whether a key expression takes a key, as Zenoh does (the in-process bus and the history ask here).

    `*` stands for one chunk, `**` for any number of them, `$*` for a part of one; a chunk that begins
    with `@` is taken only by itself.
    """
    return expression == key or _compiled(expression).fullmatch(f"{key}/") is not None


_CHUNK = "[^/@][^/]*/"
_PART = "[^/]*"


@lru_cache(maxsize=4096)  # expressions come from other processes too, in requests
def _compiled(expression: str) -> re.Pattern[str]:
    """Return the pattern of an expression, for keys with "/" at their end.

    What stands between two wildcards is matched at its first place and kept (atomic groups), so that no
    expression, however contrived, takes more than linear time per wildcard.
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
    """Return the pattern of one chunk of an expression, "/" included."""
    if chunk == "*":
        return _CHUNK
    if chunk.startswith("@") or "$*" not in chunk:
        return re.escape(f"{chunk}/")
    first, *others = map(re.escape, chunk.split("$*"))
    last = others.pop()
    middle = "".join(f"(?>{_PART}?{text})" for text in others)
    return f"{'' if first else '(?!@)'}{first}{middle}{_PART}{last}/"
