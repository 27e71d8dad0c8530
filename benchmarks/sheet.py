"""Results of one part of the benchmarks: a value per contender, size and repeat; their medians, spreads and ratios."""

import json
import math
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Spread:
    """A median with the minimum and the maximum."""

    median: float
    low: float
    high: float


@dataclass
class Sheet:
    """Results of one run of a part.

    Attributes:
        part: letter of the part.
        unit: unit of the values.
        values: by contender and size, in order of the repeats; None for a repeat without a value.
        refused: why a contender has no value, by contender or by `contender@size`.
        notes: further results.
        machine: the machine, and the versions of the packages.
    """

    part: str
    unit: str
    values: dict[str, dict[int, list[float | None]]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)

    def add(self, contender: str, size: int, value: float | None) -> None:
        """Append the value of the next repeat, or None if it has no value."""
        self.values.setdefault(contender, {}).setdefault(size, []).append(value)

    def refuse(self, contender: str, size: int, reason: str, rows: Sequence[str]) -> str:
        """Note why a contender has no value at a size in this repeat; add None to each of `rows`; return the reason."""
        self.refused[f"{contender}@{size}"] = reason
        for row in rows:
            self.add(row, size, None)
        return reason

    def sizes(self) -> list[int]:
        return sorted({size for by_size in self.values.values() for size in by_size})

    def spread(self, contender: str, size: int) -> Spread | None:
        """Return median, minimum and maximum over the repeats; None if there are no values."""
        return spread(self.values.get(contender, {}).get(size, []))

    def ratio(self, contender: str, reference: str, size: int) -> Spread | None:
        """Return the spread of the repeats' ratios of a contender to the reference; None if no ratio is known."""
        mine = self.values.get(contender, {}).get(size, [])
        its = self.values.get(reference, {}).get(size, [])
        return spread([a / b if a is not None and b else None for a, b in zip(mine, its, strict=False)])

    def best(self, contenders: list[str], size: int) -> str | None:
        """Return the contender with the highest median at a size; None if none has values."""
        found = {name: s.median for name in contenders if (s := self.spread(name, size))}
        return max(found, key=lambda name: found[name]) if found else None

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")


def read(path: Path) -> Sheet:
    content = json.loads(path.read_text())
    values = {name: {int(size): v for size, v in by_size.items()} for name, by_size in content.pop("values").items()}
    return Sheet(values=values, **content)


def spread(values: Sequence[float | None]) -> Spread | None:
    """Return median, minimum and maximum of the values that are not None; None if all are."""
    found = [value for value in values if value is not None]
    return Spread(statistics.median(found), min(found), max(found)) if found else None


def exponent(points: dict[int, float]) -> float:
    """Return the least-squares slope of log value against log size; 1 means proportional to the size.

    Raises:
        StatisticsError: there are fewer than two points.
    """
    logs = [(math.log(size), math.log(value)) for size, value in points.items()]
    return statistics.linear_regression([x for x, _ in logs], [y for _, y in logs]).slope


class Progress:
    """Prints the progress of a part.

    Args:
        part: letter of the part.
        total: number of measurements.
    """

    def __init__(self, part: str, total: int) -> None:
        self._part = part
        self._total = total
        self._done = 0
        self._start_s = time.monotonic()

    def tell(self, text: str) -> None:
        self._done += 1
        spent_s = time.monotonic() - self._start_s
        left_s = spent_s / self._done * max(0, self._total - self._done)
        print(f"{self._part} {self._done}/{self._total}  {text}  ({left_s:.0f} s to go)", file=sys.stderr, flush=True)
