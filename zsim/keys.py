"""The keys of the contract: built and taken apart here, nowhere else.

Keys inside a process are without the federation's prefix ("drone/drone1/truth"); the session adds it.
"""

import re

from zsim.errors import BadNameError

NAME = re.compile(r"[a-z0-9_.-]{1,32}")
SENSORS = ("imu", "gps", "mag", "baro", "sonar", "flow")
COMMANDS = ("velocity", "ardrone", "attitude", "rotors", "mode")

INFO = "world/info"
CLOCK = "clock"
EVENT = "world/event"
CONTROL = "world/control"
VIEW_DRONES = "view/drones"


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


def truth(drone: str) -> str:
    return f"drone/{drone}/truth"


def command(drone: str, kind: str) -> str:
    return f"drone/{drone}/cmd/{kind}"


def estimate(drone: str) -> str:
    return f"drone/{drone}/estimate"


def cluster_state(cluster: str) -> str:
    return f"cluster/{cluster}/state"


def cluster_control(cluster: str) -> str:
    return f"cluster/{cluster}/control"


def token(process: str) -> str:
    return f"process/{process}"


def process(process_name: str, what: str) -> str:
    """Return the key of `join`, `done`, `bye` or `health` of a process."""
    return f"process/{process_name}/{what}"


def thing(key: str) -> str:
    """Return the second part of a key: the drone, cluster or process that it is about."""
    return key.split("/", 2)[1]


def leaf(key: str) -> str:
    """Return the last part of a key."""
    return key.rsplit("/", 1)[-1]


def matches(expression: str, key: str) -> bool:
    """Tell whether a key expression with `*` and `**` takes a key (the in-process bus; Zenoh has its own)."""
    return _compiled(expression).fullmatch(key) is not None


_cache: dict[str, re.Pattern[str]] = {}


def _compiled(expression: str) -> re.Pattern[str]:
    if expression not in _cache:
        pattern = re.escape(expression).replace(r"\*\*/", "(?:.*/)?").replace(r"/\*\*", "(?:/.*)?")
        pattern = pattern.replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
        _cache[expression] = re.compile(pattern)
    return _cache[expression]
