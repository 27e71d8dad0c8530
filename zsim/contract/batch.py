"""Many messages in one: what recorders read, and who reads many drones.

Put one by one, the messages of a gate cost a reader and the hub a piece of work and a wake-up each. The keys are
outside of the contract and begin with `@`, which no wildcard of Zenoh matches: whoever subscribes to `**` hears the
messages themselves, and does not hear these.
"""

from typing import Any

import msgspec

from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError

KEY = "@batch"  # everything that passed the hub; what the world says of its drones at a gate under GATE
GATE = "@gate"  # everything that the world says at a gate
Batch = list[tuple[str, bytes]]
MESSAGES_MAX = 5_000  # of one batch; a flood of somebody's messages goes into several


def gate(drone: str) -> str:
    """Return the key of everything that the world says of a drone at a gate."""
    return f"{GATE}/{drone}"


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Batch)


def encode(passed: Batch) -> bytes:
    """Return the payload that carries (key, payload) in the order in which they passed."""
    return _encoder.encode(passed)


def decode(payload: bytes) -> Batch:
    """Return what passed.

    Raises:
        DecodeError: it is no batch.
    """
    try:
        return _decoder.decode(payload)
    except REFUSALS as error:
        raise DecodeError(f"{KEY}: {error}; must be a list of [key, payload]") from error


def of(result: Any) -> Batch:
    """Return the [key, payload] pairs in the result of an answer.

    Raises:
        DecodeError: it is anything else.
    """
    try:
        return msgspec.convert(result, Batch, builtin_types=(bytes,))  # or texts would pass as base64
    except REFUSALS as error:
        raise DecodeError(f"result: {error}; must be a list of [key, payload]") from error
