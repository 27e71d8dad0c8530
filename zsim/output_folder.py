"""Folders that commands write into: what somebody else has put there is not mixed up with it unasked."""

from collections.abc import Collection
from pathlib import Path

from zsim.errors import RunError

OTHERS_NAMED = 3  # in a refusal


def refuse_others(folder: Path, own: Collection[str], force: bool, use: str) -> None:
    """Refuse a folder that holds other files than the command's own.

    Args:
        folder: that is there.
        own: names that are in nobody's way.
        force: take it nevertheless; the files stay as they are.
        use: what the command does with it, for the error: "fly into".

    Raises:
        RunError: with what it holds.
        OSError: it cannot be read.
    """
    others = sorted(each.name for each in folder.iterdir() if each.name not in own)
    if others and not force:
        named = ", ".join(others[:OTHERS_NAMED]) + (", …" if len(others) > OTHERS_NAMED else "")
        raise RunError(f"{folder}: holds {named}; give --out an empty folder, or --force to {use} this one")
