"""What a sweep flies, as it is kept in its folder."""

from pathlib import Path
from typing import Any

from msgspec import Struct

from zsim import __version__
from zsim.scenario.overrides import whole_path

FILE = "plan.json"
RUNS_MAX = 1_000_000


class Plan(Struct, frozen=True, kw_only=True):
    """One scenario and its variations: the same plan gives the same runs, whoever flies them, in whatever order.

    Attributes:
        source: name of the scenario's file, for messages.
        document: the file with what the command line says of it, presets not yet expanded.
        vary: texts of `--vary`, in their order.
        runs: how many; a plan of more runs begins with the same ones.
        records: whether every run keeps its record.
        version: of zsim; another one need not give the same numbers.
    """

    source: str
    document: dict[str, Any]
    vary: tuple[str, ...]
    runs: int
    records: bool = False
    version: str = __version__


def difference(there: Plan, here: Plan) -> str | None:
    """Return in which way two plans are not the same sweep, None if `here` goes on with what is `there`."""
    if there.version != here.version:
        return f"it was begun by zsim {there.version}, this is {here.version}"
    if there.document != here.document:
        keys = sorted(there.document.keys() | here.document.keys())
        other = next(key for key in keys if there.document.get(key) != here.document.get(key))
        return f"{other} of its scenario is another one"
    if _whole(there.vary) != _whole(here.vary):
        return f"it varies {' '.join(there.vary) or 'nothing'}, not {' '.join(here.vary) or 'nothing'}"
    if there.records != here.records:
        return f"it {'keeps' if there.records else 'does not keep'} records"
    if here.runs < there.runs:
        return f"it has {there.runs} runs, more than {here.runs}"
    return None


def _whole(vary: tuple[str, ...]) -> list[str]:
    """Return texts of `--vary` with their paths from the top of the scenario."""
    parts = [text.partition("=") for text in vary]
    return [f"{whole_path(path.strip())}{equals}{given}" for path, equals, given in parts]


def is_sweep(folder: Path) -> bool:
    """Tell whether a folder holds a sweep."""
    return (folder / FILE).is_file()
