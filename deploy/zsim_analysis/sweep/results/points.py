"""What a sweep came to at each point of its grid: distributions, and intervals of their means."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim_analysis.sweep.axes import Draw, text_of
from zsim_analysis.sweep.design import Design
from zsim_analysis.sweep.results import intervals
from zsim_analysis.sweep.results.intervals import Interval
from zsim_analysis.sweep.results.row import FIXED, Row, engaged_column

_BEGINNING = re.compile(r"(?:clusters\.(.+?)\.)?errors\.(.+)")  # of a column: its cluster's name, and its own
STATISTICS = ("est_std", "true_std", "true_rms", "true_mean")


class Parameter(Struct, frozen=True):
    """A variable of a formation.

    Attributes:
        cluster: the formation's name, None where there is only one.
    """

    name: str
    cluster: str | None = None

    def labelled(self, text: str) -> str:
        """Return a text about the variable, with the cluster's name where one is needed."""
        return f"{self.cluster}: {text}" if self.cluster else text


class Spread(Struct, frozen=True):
    """How a quantity is distributed over the runs of a point that ended well."""

    runs: int
    mean: Interval
    std: float
    p5: float
    median: float
    p95: float
    least: float
    greatest: float


class Point(Struct, frozen=True):
    """One combination of the grid's values.

    Attributes:
        values: by path; empty where nothing but seeds and draws varies.
        runs: finished ones.
        ended_well: share of them; None without a run.
        without_collision: share of those that ended well.
        engaged: runs that ended well and had every cluster engaged at some instant of the judged window; None where
            no run has a cluster.
        spreads: by column of the table, of those that ended well.
    """

    label: str
    values: dict[str, Any]
    runs: int
    ended_well: Interval | None
    without_collision: Interval | None
    engaged: int | None
    spreads: dict[str, Spread]


class SweepSummary(Struct, frozen=True):
    """summary.json of a sweep.

    Attributes:
        not_engaged: runs that ended well, but a cluster was never engaged within the judged window.
        parameters: of the formations, by the beginning of their columns.
    """

    scenario: str
    seed: int
    vary: tuple[str, ...]
    runs: int
    finished: int
    failed: dict[str, int]
    not_engaged: int
    level: float
    flown_wall_s: float
    hosts: dict[str, int]
    fingerprints: dict[str, int]
    version: str
    parameters: dict[str, Parameter]
    points: list[Point]

    def json(self) -> bytes:
        """Return the text of summary.json; what is not known is null."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"

    @property
    def grid(self) -> str:
        """Return what the labels of the points are values of."""
        return " · ".join(path.rpartition(".")[2] or path for path in self.points[0].values) or "point"

    @property
    def flown(self) -> list[Point]:
        """Return the points that a run has finished."""
        return [point for point in self.points if point.runs]


class Results:
    """The rows of a sweep in columns.

    Args:
        design: of the sweep.
        rows: of the finished runs.
    """

    def __init__(self, design: Design, rows: Sequence[Row]) -> None:
        self.design = design
        self.rows = rows
        self.points = np.array([row["point"] for row in rows], np.int64)
        self.well = np.array([row["failure"] is None for row in rows], bool)
        self.errors = _error_columns(rows)
        self.clusters = _clusters(rows)
        self.drawn = [axis.path for axis in design.axes if isinstance(axis, Draw)]

    def values(self, column: str, point: int | None = None) -> NDArray[np.float64]:
        """Return what a column holds for the runs that ended well, at one point or all; NaN where unknown."""
        chosen = self.well if point is None else self.well & (self.points == point)
        cells = [row.get(column) for row, is_chosen in zip(self.rows, chosen, strict=True) if is_chosen]
        return np.array([np.nan if cell is None else cell for cell in cells], np.float64)

    def parameters(self) -> dict[str, Parameter]:
        """Return the formation parameters, by the beginning of their columns."""
        return parameters(self.errors, self.clusters)

    def ended_well(self, point: int) -> tuple[int, int]:
        """Return how many of a point's finished runs ended well, and how many there are."""
        there = self.points == point
        return int((there & self.well).sum()), int(there.sum())

    def without_collision(self, point: int) -> tuple[int, int]:
        """Return how many of a point's runs that ended well had no collision, and how many there are."""
        collisions = self.values("collisions", point)
        return int((collisions == 0).sum()), len(collisions)

    def engaged(self, point: int | None = None) -> tuple[int, int]:
        """Return how many runs that ended well had every cluster engaged, and how many have a cluster."""
        engaged = self.values("engaged", point)
        return int((engaged == 1).sum()), int(np.isfinite(engaged).sum())

    def label(self, point: int) -> str:
        """Return the values of a point in a few words; "all runs" where there is no grid."""
        values = self.design.at(point).values()
        return " · ".join(_shown(value) for value in values) or "all runs"

    def summary(self) -> SweepSummary:
        """Return what all of it came to."""
        plan = self.design.plan
        rows = self.rows
        engaged, of = self.engaged()
        return SweepSummary(
            scenario=str(plan.document["name"]),
            seed=self.design.seed,
            vary=plan.vary,
            runs=plan.runs,
            finished=len(rows),
            failed=dict(Counter(row["failure"] for row in rows if row["failure"]).most_common()),
            not_engaged=of - engaged,
            level=intervals.LEVEL,
            flown_wall_s=sum(row["wall_s"] or 0.0 for row in rows),
            hosts=dict(Counter(row["host"] for row in rows if row["host"])),
            fingerprints=dict(Counter(row["fingerprint"] for row in rows if row["fingerprint"])),
            version=plan.version,
            parameters=self.parameters(),
            points=[self._point(point) for point in range(self.design.points)],
        )

    def _point(self, point: int) -> Point:
        well, runs = self.ended_well(point)
        engaged, of = self.engaged(point)
        columns = ("min_separation_m", *self.errors)
        spreads = {column: found for column in columns if (found := spread(self.values(column, point)))}
        return Point(
            label=self.label(point),
            values=self.design.at(point),
            runs=runs,
            ended_well=intervals.share(well, runs) if runs else None,
            without_collision=intervals.share(*self.without_collision(point)) if well else None,
            engaged=engaged if of else None,
            spreads=spreads,
        )


def parameters(columns: Iterable[str], clusters: Sequence[str]) -> dict[str, Parameter]:
    """Return the formation parameters of columns of errors, by the columns' beginning; names may hold points.

    Args:
        columns: names such as errors.x_c.true_rms, or clusters.NAME.errors.x_c.true_rms of a second cluster.
        clusters: names of all of them.
    """
    beginnings = dict.fromkeys(column.rpartition(".")[0] for column in columns)
    matches = {each: match for each in beginnings if (match := _BEGINNING.fullmatch(each))}
    others = {match[1] for match in matches.values()}
    first = "/".join(name for name in clusters if name not in others) if len(clusters) > 1 else None
    return {each: Parameter(match[2], match[1] or first) for each, match in matches.items()}


def _clusters(rows: Sequence[Row]) -> list[str]:
    """Return the names of all clusters."""
    beginning, end = engaged_column(" ").split(" ")
    names = dict.fromkeys(name for row in rows for name in row)
    return [name[len(beginning) : -len(end)] for name in names if name.startswith(beginning) and name.endswith(end)]


def spread(samples: NDArray[np.float64]) -> Spread | None:
    """Return the distribution of samples (n,), not finite ones left out; None without any."""
    known = samples[np.isfinite(samples)]
    if not len(known):
        return None
    p5, median, p95 = (float(value) for value in np.percentile(known, [5, 50, 95]))
    std = float(np.std(known, ddof=1)) if len(known) > 1 else float("nan")
    return Spread(len(known), intervals.mean(known), std, p5, median, p95, float(known.min()), float(known.max()))


def _error_columns(rows: Sequence[Row]) -> list[str]:
    names = dict.fromkeys(name for row in rows for name in row if name not in FIXED)
    return [name for name in names if name.startswith(("errors.", "clusters.")) and name.endswith(STATISTICS)]


def _shown(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else text_of(value)
    return text if len(text) <= 24 else f"{text[:23]}…"
