"""A report made while the terminal says how far it is, and its table."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

Say = Callable[[str], None]


def show(folder: Path, reading: str, make: Callable[[Path, Say], Any], table: Callable[[Any], Any]) -> None:
    """Make a folder's report, and print its table.

    Args:
        reading: said at first.
        make: makes report.html in the folder, and returns its figures.
        table: of these figures, for a terminal.
    """
    from rich.console import Console

    with Console(stderr=True).status(reading) as status:
        figures = make(folder, lambda text: status.update(text))
    Console().print(table(figures))
    print(f"report: {folder / 'report.html'}")
