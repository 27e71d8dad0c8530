"""What a sweep came to at each point of its grid: distributions, and confidence intervals of means and shares. Pure."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.special import betaincinv, stdtrit

from zsim_analysis.sweep.axes import Draw, text_of
from zsim_analysis.sweep.design import SweepDesign
from zsim_analysis.sweep.sweep_run import FIXED, Row, engaged_column

LEVEL = 0.95  # of all intervals of a report
STATISTICS = ("est_std", "true_std", "true_rms", "true_mean")
_COLUMN = re.compile(r"(?:clusters\.(.+?)\.)?errors\.(.+)")  # start of a column: its cluster's name, and its own


class ConfidenceInterval(Struct, frozen=True):
    """A value with the ends of its confidence interval; NaN ends where one sample shows no spread."""

    value: float
    low: float
    high: float


def mean_interval(samples: NDArray[np.float64], level: float = LEVEL) -> ConfidenceInterval:
    """Return the mean of samples (n,) with Student's interval: mean ± t(n − 1) s / √n.

    It holds for normal samples, and for others by the central limit theorem as n grows.
    """
    n = len(samples)
    middle = float(np.mean(samples)) if n else math.nan
    if n < 2:
        return ConfidenceInterval(middle, math.nan, math.nan)
    half = float(stdtrit(n - 1, (1 + level) / 2) * np.std(samples, ddof=1) / math.sqrt(n))
    return ConfidenceInterval(middle, middle - half, middle + half)


def share_interval(count: int, of: int, level: float = LEVEL) -> ConfidenceInterval:
    """Return count / of with the exact interval of Clopper and Pearson (Biometrika 26, 1934); of > 0.

    It covers the true share at least as often as `level` says, whatever the share and the number of runs.
    """
    tail = (1 - level) / 2
    low = float(betaincinv(count, of - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, of - count, 1 - tail)) if count < of else 1.0
    return ConfidenceInterval(count / of, low, high)


class FormationParameter(Struct, frozen=True):
    """A variable of a formation.

    Attributes:
        cluster: the formation's name, None where there is only one.
    """

    name: str
    cluster: str | None = None

    def labelled(self, text: str) -> str:
        """Return a text about the variable, with the cluster's name where one is needed."""
        return f"{self.cluster}: {text}" if self.cluster else text


class Distribution(Struct, frozen=True):
    """How a quantity is distributed over the runs of a point that ended well."""

    runs: int
    mean: ConfidenceInterval
    std: float
    p5: float
    median: float
    p95: float
    least: float
    greatest: float


class GridPoint(Struct, frozen=True):
    """One combination of the grid's values.

    Attributes:
        values: by path; empty where only seeds and drawn values vary.
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
    ended_well: ConfidenceInterval | None
    without_collision: ConfidenceInterval | None
    engaged: int | None
    spreads: dict[str, Distribution]


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
    parameters: dict[str, FormationParameter]
    points: list[GridPoint]

    def json(self) -> bytes:
        """Return the text of summary.json; what is not known is null."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"

    @property
    def grid(self) -> str:
        """Return what the labels of the points are values of."""
        return " · ".join(path.rpartition(".")[2] or path for path in self.points[0].values) or "point"

    @property
    def flown(self) -> list[GridPoint]:
        """Return the points that a run has finished."""
        return [point for point in self.points if point.runs]


class SweepResults:
    """The rows of a sweep in columns.

    Args:
        design: of the sweep.
        rows: of the finished runs.
    """

    def __init__(self, design: SweepDesign, rows: Sequence[Row]) -> None:
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

    def parameters(self) -> dict[str, FormationParameter]:
        """Return the formation parameters, by the beginning of their columns."""
        return parameters(self.errors, self.clusters)

    def ended_well(self, point: int) -> tuple[int, int]:
        """Return how many of a point's finished runs ended well, and how many there are."""
        at_point = self.points == point
        return int((at_point & self.well).sum()), int(at_point.sum())

    def without_collision(self, point: int) -> tuple[int, int]:
        """Return how many of a point's runs that ended well had no collision, and how many there are."""
        collisions = self.values("collisions", point)
        return int((collisions == 0).sum()), len(collisions)

    def engaged(self, point: int | None = None) -> tuple[int, int]:
        """Return how many runs that ended well had every cluster engaged, and how many have a cluster."""
        engaged = self.values("engaged", point)
        return int((engaged == 1).sum()), int(np.isfinite(engaged).sum())

    def label(self, point: int) -> str:
        """Return the values of a point in short; "all runs" where there is no grid."""
        values = self.design.at(point).values()
        return " · ".join(_shown(value) for value in values) or "all runs"

    def summary(self) -> SweepSummary:
        """Return the content of summary.json."""
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
            level=LEVEL,
            flown_wall_s=sum(row["wall_s"] or 0.0 for row in rows),
            hosts=dict(Counter(row["host"] for row in rows if row["host"])),
            fingerprints=dict(Counter(row["fingerprint"] for row in rows if row["fingerprint"])),
            version=plan.version,
            parameters=self.parameters(),
            points=[self._point(point) for point in range(self.design.points)],
        )

    def _point(self, point: int) -> GridPoint:
        well, runs = self.ended_well(point)
        engaged, of = self.engaged(point)
        columns = ("min_separation_m", *self.errors)
        spreads = {column: each for column in columns if (each := distribution(self.values(column, point)))}
        return GridPoint(
            label=self.label(point),
            values=self.design.at(point),
            runs=runs,
            ended_well=share_interval(well, runs) if runs else None,
            without_collision=share_interval(*self.without_collision(point)) if well else None,
            engaged=engaged if of else None,
            spreads=spreads,
        )


def parameters(columns: Iterable[str], clusters: Sequence[str]) -> dict[str, FormationParameter]:
    """Return the formation parameters of columns of errors, by the columns' beginning; names may hold points.

    Args:
        columns: names such as errors.x_c.true_rms, or clusters.NAME.errors.x_c.true_rms of a second cluster.
        clusters: names of all of them.
    """
    beginnings = dict.fromkeys(column.rpartition(".")[0] for column in columns)
    matches = {each: match for each in beginnings if (match := _COLUMN.fullmatch(each))}
    others = {match[1] for match in matches.values()}
    first = "/".join(name for name in clusters if name not in others) if len(clusters) > 1 else None
    return {each: FormationParameter(match[2], match[1] or first) for each, match in matches.items()}


def _clusters(rows: Sequence[Row]) -> list[str]:
    """Return the names of all clusters."""
    beginning, end = engaged_column(" ").split(" ")
    names = dict.fromkeys(name for row in rows for name in row)
    return [name[len(beginning) : -len(end)] for name in names if name.startswith(beginning) and name.endswith(end)]


def distribution(samples: NDArray[np.float64]) -> Distribution | None:
    """Return the distribution of samples (n,), not finite ones left out; None without any."""
    known = samples[np.isfinite(samples)]
    if not len(known):
        return None
    p5, median, p95 = (float(value) for value in np.percentile(known, [5, 50, 95]))
    std = float(np.std(known, ddof=1)) if len(known) > 1 else float("nan")
    return Distribution(len(known), mean_interval(known), std, p5, median, p95, float(known.min()), float(known.max()))


def _error_columns(rows: Sequence[Row]) -> list[str]:
    names = dict.fromkeys(name for row in rows for name in row if name not in FIXED)
    return [name for name in names if name.startswith(("errors.", "clusters.")) and name.endswith(STATISTICS)]


def _shown(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else text_of(value)
    return text if len(text) <= 24 else f"{text[:23]}…"
