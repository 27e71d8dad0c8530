"""The transfer of a component's state to its successor, as from a checkpoint on disk."""

from typing import Any

from zsim.contract.snapshot import pack, restore, saved_state, unpack


def continue_from(part: Any, successor: Any) -> None:
    """Let a successor, newly created from the same scenario, continue from the state of a component."""
    restore(successor, unpack(pack(saved_state(part))))
