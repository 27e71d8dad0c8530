"""The state of an agent as bytes: maps, lists, texts, numbers and plain arrays; reading it runs no code of its own."""

from typing import Any

import msgspec
import numpy as np
from msgspec.msgpack import Ext

from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError

VERSION = 1  # of what `pack` writes, the field `version` of the message
ARRAY = 1  # code of a msgpack extension: (type, shape, numbers) of an array
TYPES = ("<f8", "<i8", "<i4", "<u8", "|i1", "|b1")  # that an array may have

State = dict[str, Any]  # names and values: numbers, texts, bytes, None, lists and maps of them, and arrays of numbers


class _Array(msgspec.Struct, array_like=True):
    kind: str
    shape: tuple[int, ...]
    numbers: bytes


def pack(state: State) -> bytes:
    """Return a state as bytes; the same for the same state; TypeError if it holds something else than a State may."""
    return _ENCODER.encode(state)


def unpack(payload: bytes) -> State:
    """Return the state that was packed; DecodeError if the payload is not one that `pack` writes."""
    try:
        return _DECODER.decode(payload)
    except REFUSALS as error:
        raise DecodeError(f"state: {error}; must be as this version of zsim packs it") from error


def _packed(value: Any) -> Any:
    if isinstance(value, np.bool_ | np.integer | np.float64):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.str in TYPES:
        return Ext(ARRAY, _ENCODER.encode(_Array(value.dtype.str, value.shape, value.tobytes())))
    raise TypeError(f"a state holds {type(value).__name__}; must be numbers, texts, bytes, lists, maps or arrays")


def _unpacked(code: int, data: memoryview) -> Any:
    if code != ARRAY:
        raise ValueError(f"extension {code} is unknown; must be {ARRAY}, an array")
    array = _ARRAYS.decode(data)
    if array.kind not in TYPES:
        raise ValueError(f"array of {array.kind!r}; must be one of {', '.join(TYPES)}")
    return np.frombuffer(array.numbers, dtype=array.kind).reshape(array.shape).copy()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_packed)
_ARRAYS = msgspec.msgpack.Decoder(_Array)
_DECODER = msgspec.msgpack.Decoder(State, ext_hook=_unpacked)
