"""The state of a run as plain values, from which another process continues it to the same bits.

Every object whose attributes change as the run proceeds, and cannot be computed again from the scenario, lists them in
its class's `SAVED`, each with how it is restored:

    a type    the value, as this type (msgspec.convert)
    IN_PLACE  numbers are copied into the array, or the list of arrays: compiled code holds on to their memory
    PART      another such object, a list of them, or None
"""

from typing import Any

import msgspec

from zsim.contract.snapshot import State

IN_PLACE, PART = "in place", "part"
Saved = dict[str, Any]


def saved_state(part: Any) -> State:
    """Return the state of an object and of all that it consists of; `zsim.contract.snapshot.pack` encodes it."""
    state = {}
    for name, how in part.SAVED.items():
        value = getattr(part, name)
        if how is PART and value is not None:
            value = [*map(saved_state, value)] if isinstance(value, list) else saved_state(value)
        state[name] = sorted(value) if isinstance(value, set) else value
    return state


def restore(part: Any, state: State) -> None:
    """Let an object, made anew from the same scenario, continue from an unpacked state.

    Raises:
        KeyError, TypeError, ValueError: the state is of another scenario or version.
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
    if hasattr(part, "restored"):  # computes what follows from the state
        part.restored()


def _copy(saved: Any, array: Any) -> None:
    if saved.shape != array.shape:
        raise ValueError(f"an array has the shape {saved.shape}; must be {array.shape}")
    array[...] = saved
