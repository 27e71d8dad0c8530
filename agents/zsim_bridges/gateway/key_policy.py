"""Who speaks where: clients on some keys, only the world or a process in its own name on others. Pure."""

from collections.abc import Sequence

from zsim.contract import keys
from zsim.errors import DecodeError
from zsim_bridges.gateway.http.http_errors import ForbiddenError

COUNTED_KEYS = (
    keys.command("*", "*"),
    keys.estimate("*"),
    keys.cluster_state("*"),
)  # contract: `sent` of a done
CLIENT_KEYS = (*COUNTED_KEYS, keys.cluster_view("*"), keys.estimates_view("*"))
"""Of the keys of the contract, those on which clients speak."""
CONTROL_KEYS = (keys.CONTROL, keys.cluster_control("*"))  # requests go there
RESERVED_KEYS = (
    "world/**",
    keys.CLOCK,
    "process/**",
    keys.VIEW_DRONES,
    "drone/*/sensor/**",
    keys.truth("*"),
    CONTROL_KEYS[1],
    keys.cluster_request("*"),
)
"""Keys on which the world, or a process in its own name, speaks: what a client said there would be taken for it."""


def is_counted_key(key: str) -> bool:
    """Tell whether a done counts what is said on a key."""
    return _among(COUNTED_KEYS, key)


def is_client_key(key: str) -> bool:
    """Tell whether a key is one of the contract's on which clients speak."""
    return _among(CLIENT_KEYS, key)


def is_control_key(key: str) -> bool:
    """Tell whether requests go to a key."""
    return _among(CONTROL_KEYS, key)


def is_reserved(key: str) -> bool:
    """Tell whether only somebody else speaks on a key."""
    return _among(RESERVED_KEYS, key) or key.startswith("@") or "/@" in key


def check_not_reserved(key: str) -> None:
    """Refuse a key on which a client has nothing to say.

    Raises:
        DecodeError: it is no key.
        ForbiddenError: somebody else speaks there.
    """
    if "*" in key or not key:
        raise DecodeError(f"{key[:80]!r}: is no key; must be names with / between them")
    if is_reserved(key):
        raise ForbiddenError(
            f"{key[:80]}: only the process that this is about speaks here; a client may speak on "
            f"{', '.join(CLIENT_KEYS).replace('*', '…')} and keys of its own"
        )


def _among(expressions: Sequence[str], key: str) -> bool:
    return any(keys.matches(expression, key) for expression in expressions)
