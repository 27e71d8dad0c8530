"""The state of an agent or a run as plain values (maps, lists, texts, numbers, arrays), and as bytes.

Reading it runs no foreign code. An agent provides its own state (`snapshot`). An object of a world lists in its class's
`SAVED` all attributes that change during a run and cannot be recomputed from the scenario, and how to restore each:

    a type    the value, as this type (msgspec.convert)
    IN_PLACE  an array, or a list of arrays, to whose memory compiled code refers: the numbers are copied into it
    PART      another such object, a list of them, or None
"""

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from msgspec.msgpack import Ext

from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError, UserCodeError
from zsim.schema import plugin
from zsim.schema.checker import show

VERSION = 1  # version of the format of `pack`; the field `version` of an agent's Snapshot
ARRAY = 1  # code of a msgpack extension: (type, shape, numbers) of an array
TYPES = ("<f8", "<i8", "<i4", "<u8", "|i1", "|b1")  # numpy types allowed in arrays

State = dict[str, Any]  # names and values: numbers, texts, bytes, None, lists and maps of them, and arrays of numbers
IN_PLACE, PART = "in place", "part"
Saved = dict[str, Any]


class _Array(msgspec.Struct, array_like=True):
    kind: str
    shape: tuple[int, ...]
    numbers: bytes


def pack(state: State) -> bytes:
    """Return a state as bytes, equal for equal states in equal order; raise one of REFUSALS if it is not a State."""
    return _ENCODER.encode(state)


def unpack(payload: bytes) -> State:
    """Return the state in a payload; raise DecodeError if it was not written by `pack`."""
    try:
        return _DECODER.decode(payload)
    except REFUSALS as error:
        raise DecodeError(f"state: {error}; must have been packed by this version of zsim") from error


def checked(state: Any, owner: type) -> State | None:
    """Return the checked result of a user's `snapshot`, a state or None.

    Raises:
        UserCodeError: it is not a state; the text names the class, and the first invalid value with its path.
    """
    if state is None:
        return None
    context = f"{plugin.full_name(owner)}.snapshot returns"
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise UserCodeError(
            f"{context} {show(state)}; must be a map of plain values by name, {{}} if there is no state"
        )
    try:
        pack(state)
    except (TypeError, *REFUSALS) as error:
        path, actual = next(_flaws(state), ("a value", str(error)))
        allowed = "must be numbers, texts, bytes, lists, maps by name, or arrays of numbers"
        raise UserCodeError(f"{context} {path} = {actual}; {allowed}") from error
    return state


def _flaws(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and type of each value of a state that cannot be packed."""
    if isinstance(value, dict):
        for name, each in value.items():
            if not path and _is_too_deep(each):  # perhaps it contains itself
                yield str(name), "a map or list nested too deeply"
                continue
            yield from _flaws(name, f"a key of {path}")
            yield from _flaws(each, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value):
            yield from _flaws(each, f"{path}[{index}]")
    else:
        try:
            _ENCODER.encode(value)
        except OverflowError:
            yield path, "an int of more than 64 bits"
        except (TypeError, *REFUSALS):
            kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
            yield path, kind


def _is_too_deep(value: Any) -> bool:
    try:
        _ENCODER.encode(value)
    except RecursionError:
        return True
    except (TypeError, *REFUSALS):
        return False
    return False


def _packed(value: Any) -> Any:
    if isinstance(value, np.bool_ | np.integer | np.float64):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.str in TYPES:
        return Ext(ARRAY, _ENCODER.encode(_Array(value.dtype.str, value.shape, value.tobytes())))
    raise TypeError(f"a state contains {type(value).__name__}; must be numbers, texts, bytes, lists, maps or arrays")


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


def saved_state(part: Any) -> State:
    """Return the state of an object and all its parts, for `pack`."""
    state = {}
    for name, how in part.SAVED.items():
        value = getattr(part, name)
        if how is PART and value is not None:
            value = [*map(saved_state, value)] if isinstance(value, list) else saved_state(value)
        state[name] = sorted(value) if isinstance(value, set) else value
    return state


def restore(part: Any, state: State) -> None:
    """Set the state of an object that was newly created from the same scenario.

    Raises:
        KeyError, TypeError, ValueError: the state is from another scenario or version.
    """
    for name, how in part.SAVED.items():
        value = state[name]
        if how is PART or how is IN_PLACE:
            former = getattr(part, name)
            pairs = zip(former, value, strict=True) if isinstance(former, list) else ((former, value),)
            for each, saved in pairs:
                if how is IN_PLACE:
                    _copy(saved, each)
                elif each is not None:
                    restore(each, saved)
        else:
            setattr(part, name, msgspec.convert(value, how))
    if hasattr(part, "restored"):  # recomputes derived attributes
        part.restored()


def _copy(saved: Any, array: Any) -> None:
    if saved.shape != array.shape:
        raise ValueError(f"an array has the shape {saved.shape}; must be {array.shape}")
    array[...] = saved
