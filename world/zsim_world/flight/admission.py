"""What is told of a process that has joined."""

from collections.abc import Iterator
from typing import Any

from zsim.contract.fingerprint import fingerprint
from zsim.contract.messages import Join
from zsim_world.flight.barrier import Barrier, Participant

Warned = tuple[str, str, dict[str, Any]]  # kind, text and data of an event


def data_of(joined: Participant, message: Join) -> dict[str, Any]:
    """Return the data of the event that tells of a join."""
    return {
        "incarnation": message.incarnation,
        "host": message.host,
        "pid": message.pid,
        "from_ns": joined.from_ns,
        "done_ns": joined.done_ns,
        **({"serves": message.serves} if message.serves else {}),
    }


def warnings(barrier: Barrier, name: str, message: Join) -> Iterator[Warned]:
    """Yield what is to be known: that it computes with other bits, or does the work of others too."""
    if message.fingerprint and message.fingerprint != fingerprint():
        text = f"{name} on {message.host} computes with another numeric fingerprint; the same bits are not promised"
        yield "fingerprint", text, {"found": message.fingerprint, "expected": fingerprint()}
    for other, both in barrier.doubles(name).items():
        text = f"{name} and {other} both do the work of {', '.join(sorted(both))}; end one of them"
        yield "doubled", text, {"other": other}
