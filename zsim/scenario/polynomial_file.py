"""Files of polynomial pieces, as uav_trajectories and Crazyswarm write and read them.

A header line, then a line for each piece of 33 numbers: its duration [s], and the coefficients of t^0 to t^7 in x, y, z
[m] and yaw [rad], t being the time from the beginning of the piece. https://github.com/whoenig/uav_trajectories
"""

import csv
import math
from pathlib import Path
from typing import Any

from zsim.errors import DocumentError
from zsim.schema.checker import show

AXES = ("x", "y", "z", "yaw")
TERMS = 8
HEADER = ("duration", *(f"{axis}^{power}" for axis in AXES for power in range(TERMS)))
BYTES_MAX = 2_000_000  # of a file: five thousand pieces


def pieces_of(path: Path, where: str) -> list[dict[str, Any]]:
    """Return the pieces of a file as a scenario has them: `duration_s`, and `x`, `y`, `z`, `yaw` as lists.

    Args:
        where: path of the field that names the file.

    Raises:
        DocumentError: it cannot be read, or a line for each that is not as it must be.
    """
    try:
        if path.stat().st_size > BYTES_MAX:
            raise DocumentError(
                [f"{where} is {show(str(path))}, which has more than {BYTES_MAX} bytes; must have less"]
            )
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DocumentError([f"{where} is {show(str(path))}, which cannot be read ({error})"]) from error
    rows = [_without_end([cell.strip() for cell in row]) for row in rows]
    header = tuple(cell.lower().replace(" ", "") for cell in rows[0]) if rows else ()
    if header != HEADER:
        needed = f"must begin with the header duration, x^0 to x^7, y^0, …, yaw^7: {len(HEADER)} columns"
        raise DocumentError([f"{where} is {show(str(path))}, which does not; {needed}"])
    pieces, wrong = [], []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            numbers = [float(cell) for cell in row]
        except ValueError:
            numbers = []
        if len(numbers) != len(HEADER) or not all(map(math.isfinite, numbers)):
            found = f"has {len(row)} entries: {', '.join(row)[:40]}"
            wrong.append(f"{where} is {show(str(path))}, whose line {number} {found}; must be {len(HEADER)} numbers")
            continue
        axes = {axis: numbers[1 + k * TERMS : 1 + (k + 1) * TERMS] for k, axis in enumerate(AXES)}
        pieces.append({"duration_s": numbers[0], **axes})
    if wrong or not pieces:
        raise DocumentError(wrong or [f"{where} is {show(str(path))}, which has no piece; must have one or more"])
    return pieces


def _without_end(row: list[str]) -> list[str]:
    """Return a row without empty cells at its end: files of Crazyswarm have a comma there."""
    while row and not row[-1]:
        row.pop()
    return row
