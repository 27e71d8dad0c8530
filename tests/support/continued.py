"""The state of a part of a run, taken over by another one as from a checkpoint on disk."""

from typing import Any

from zsim.contract.snapshot import pack, restore, saved_state, unpack


def continue_from(part: Any, successor: Any) -> None:
    """Let a successor, made anew from the same scenario, continue from the state of a part."""
    restore(successor, unpack(pack(saved_state(part))))
