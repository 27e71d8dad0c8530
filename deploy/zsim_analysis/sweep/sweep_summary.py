"""summary.json of a sweep: distributions and confidence intervals at each point of its grid; names of fields.

`SweepResults` holds the rows as columns, from which the summary, tables and figures are made. This module neither reads
nor writes files.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.special import betaincinv, stdtrit

from zsim.errors import ScenarioError
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.report.summary import PAPER_TABLE_1, STATISTICS, paper_table
from zsim_analysis.sweep.design import Draw, SweepDesign, without_made
from zsim_analysis.sweep.sweep_run import FIXED, METRIC, Row, engaged_column

Samples = NDArray[np.float64]

LEVEL = 0.95  # confidence level of all intervals
RUNS_MIN = 5  # minimum number of runs for an interval; design choice: with 2, its width is 13 times their difference
SEPARATION = "min_separation_m"
OBSTACLE_DISTANCE = "min_obstacle_distance_m"
_NUMBER = re.compile(r"(?<![\w.])\d[\d.]*")  # a number in a text, but not in a name such as drone1
_COLUMN = re.compile(r"(?:clusters\.(.+?)\.)?errors\.(.+)")  # groups: the cluster's name, the parameter's name


class ConfidenceInterval(Struct, frozen=True):
    """A value with the limits of its confidence interval; these are NaN if there are too few samples."""

    value: float
    low: float
    high: float


def mean_interval(samples: Samples) -> ConfidenceInterval:
    """Return the mean of samples (n,) with Student's interval, mean ± t(n − 1) s / √n; NaN limits if n < RUNS_MIN.

    The interval is exact for normally distributed samples, and for others asymptotically (central limit theorem).
    """
    n = len(samples)
    middle = float(np.mean(samples)) if n else math.nan
    if n < RUNS_MIN:
        return ConfidenceInterval(middle, math.nan, math.nan)
    half = float(stdtrit(n - 1, (1 + LEVEL) / 2) * np.std(samples, ddof=1) / math.sqrt(n))
    return ConfidenceInterval(middle, middle - half, middle + half)


def share_interval(count: int, total: int) -> ConfidenceInterval:
    """Return count / total with the exact interval of Clopper and Pearson (Biometrika 26, 1934); total > 0.

    The coverage is at least LEVEL for every share and number of runs.
    """
    tail = (1 - LEVEL) / 2
    low = float(betaincinv(count, total - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return ConfidenceInterval(count / total, low, high)


class Distribution(Struct, frozen=True):
    """The distribution of a quantity over the runs of a point."""

    runs: int
    mean: ConfidenceInterval
    std: float
    p5: float
    median: float
    p95: float
    least: float
    greatest: float
    samples: tuple[float, ...] = ()  # all samples if they are too few for an interval; otherwise empty


def distribution(samples: Samples) -> Distribution | None:
    """Return the distribution of the finite values among samples (n,); None if there are none."""
    values = finite(samples)
    if not len(values):
        return None
    std = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    p5, median, p95, minimum, maximum = map(float, (*np.percentile(values, [5, 50, 95]), values.min(), values.max()))
    few_values = tuple(values.tolist()) if len(values) < RUNS_MIN else ()
    return Distribution(len(values), mean_interval(values), std, p5, median, p95, minimum, maximum, few_values)


def finite(samples: Samples) -> Samples:
    return samples[np.isfinite(samples)]


def count_text(count: int, total: int) -> str:
    """Return the number of runs behind a mean as text; empty if these are all runs."""
    return f"n = {count}" if count < total else ""


class FormationParameter(Struct, frozen=True):
    """A variable of a formation."""

    name: str
    cluster: str | None = None  # the formation's name; None if there is only one

    @property
    def titled(self) -> str:
        """The name with its unit, and the cluster if there are several."""
        return self.labelled(f"{self.name} ({unit(self.name)})")

    def labelled(self, text: str) -> str:
        """Prefix a text with the cluster's name if there are several."""
        return f"{self.cluster}: {text}" if self.cluster else text


def parameters(columns: Iterable[str], clusters: Sequence[str]) -> dict[str, FormationParameter]:
    """Return the formation parameters of error columns, by column prefix; names may contain dots.

    Examples of columns: errors.x_c.true_rms, and clusters.NAME.errors.x_c.true_rms for clusters after the first.
    """
    prefixes = dict.fromkeys(column.rpartition(".")[0] for column in columns)
    matches = {each: match for each in prefixes if (match := _COLUMN.fullmatch(each))}
    other_clusters = {match[1] for match in matches.values()}
    first_cluster = "/".join(name for name in clusters if name not in other_clusters) if len(clusters) > 1 else None
    return {each: FormationParameter(match[2], match[1] or first_cluster) for each, match in matches.items()}


class GridPoint(Struct, frozen=True):
    """One combination of the grid's values."""

    label: str
    values: dict[str, Any]  # by path; empty if only seeds and drawn values vary
    names: dict[str, str]  # abbreviated values by path, distinct within each field
    runs: int  # number of finished runs
    ended_well: ConfidenceInterval | None  # share of the finished runs; None if no run is finished
    # share of the runs that ended well in which no drone collided or crashed
    without_collision: ConfidenceInterval | None
    # runs that ended well with every cluster engaged at some time within the judged window; None without clusters
    engaged: int | None
    as_planned: ConfidenceInterval | None  # of the runs that ended well, the share that followed their plan
    spreads: dict[str, Distribution]  # by column, over the runs that ended well and followed their plan
    excluded: int = 0  # runs that ended well without following their plan, which are in neither spreads nor differences
    least_separation_m: float | None = None  # over all runs that ended well; None if unknown
    # by column: value minus that of the run with the same seed at the first point, over the pairs with both runs in the
    # spreads; empty at the first point, and if seeds are not paired
    differences: dict[str, Distribution] = {}

    def count(self, column: str) -> str:
        """Return the number of runs behind a mean as text; empty if these are all that ended well."""
        well = round(self.ended_well.value * self.runs) if self.ended_well else 0
        spread = self.spreads.get(column)
        return count_text(spread.runs, well) if spread else ""


class SweepSummary(Struct, frozen=True):
    """summary.json of a sweep."""

    scenario: str
    seed: int
    vary: tuple[str, ...]
    changed: tuple[str, ...] | None  # overrides `a.b.c=value` from the command line; None: unknown
    # when the first and the last run were flown (ISO 8601, UTC); None if no run has a date
    dates: tuple[str, str] | None
    runs: int
    finished: int
    failed: dict[str, int]
    not_engaged: int  # runs that ended well, but with a cluster that was never engaged within the judged window
    # number of runs that ended well without following their plan, by the first deviation; texts that differ only in
    # numbers count as one
    not_as_planned: dict[str, int]
    judged_unengaged: int  # runs that ended well, but with a cluster that was not engaged throughout the window
    # span of the judged windows of all runs: earliest start and latest end; None if no run has one
    windows_s: tuple[float, float] | None
    paper_std: dict[str, float]  # Table I by parameter, empty except for Test 1
    level: float
    flown_wall_s: float
    hosts: dict[str, int]
    fingerprints: dict[str, int]
    version: str
    parameters: dict[str, FormationParameter]  # parameters of the formations, by column prefix
    metrics: tuple[str, ...]  # columns of the user's metrics
    unmeasured: dict[str, int]  # number of runs without the user's metrics, by reason
    points: list[GridPoint]
    window_notes: dict[str, int] = {}  # runs that ended well, by the reason why their window is not the scenario's

    @property
    def flown(self) -> list[GridPoint]:
        return [point for point in self.points if point.runs]

    @property
    def known(self) -> set[str]:
        """The columns with a number in at least one run."""
        return {column for point in self.points for column in point.spreads}


class SweepResults:
    """The rows of a sweep's finished runs, as columns."""

    def __init__(self, design: SweepDesign, rows: Sequence[Row]) -> None:
        self.design = design
        self.rows = rows
        self.points = np.array([row["point"] for row in rows], np.int64)
        self.well = np.array([row["failure"] is None for row in rows], bool)
        columns = dict.fromkeys(name for row in rows for name in row if name not in FIXED)
        cluster_columns = [name for name in columns if name.startswith(("errors.", "clusters."))]
        self.errors = [name for name in cluster_columns if name.endswith(tuple(STATISTICS.values()))]
        prefix, suffix = engaged_column(" ").split(" ")
        engaged = [name for name in cluster_columns if name.startswith(prefix) and name.endswith(suffix)]
        self.parameters = parameters(self.errors, [name[len(prefix) : -len(suffix)] for name in engaged])
        self.metrics = [name for name in columns if name.startswith(METRIC)]
        report = design.plan.document.get("report")
        functions = (report.get("metrics") or ()) if isinstance(report, Mapping) else ()
        names = [functions] if isinstance(functions, str) else functions
        self.metrics_function = " and ".join(map(without_made, names))  # with its module unless that was generated
        self.has_seeds = design.seeds is not None
        self.drawn = [axis.path for axis in design.axes if isinstance(axis, Draw)]
        self.paper_std: Mapping[str, float] = {}
        if not self.drawn:
            scenarios = (design.scenario(point) for point in range(design.points))
            with suppress(ScenarioError):
                if all(len(each.clusters) == 1 and paper_table(each, each.clusters[0].name) for each in scenarios):
                    self.paper_std = PAPER_TABLE_1

    def values(self, column: str, point: int | None = None) -> Samples:
        """Return a column for the runs that ended well, at one point or at all; NaN where unknown."""
        selection = self.well if point is None else self.well & (self.points == point)
        cells = [row.get(column) for row, is_selected in zip(self.rows, selection, strict=True) if is_selected]
        return np.array([np.nan if cell is None else cell for cell in cells], np.float64)

    def planned_values(self, column: str, point: int | None = None) -> Samples:
        """Return `values` with NaN for runs that did not follow their plan, which would bias the statistics."""
        return np.where(self.values("as_planned", point) == 0, np.nan, self.values(column, point))

    def differences(self, column: str, point: int) -> Samples:
        """Return value − value at the first point for each pair of runs with equal seeds, both in `planned_values`.

        Empty at the first point, and if seeds are not paired.
        """
        if not self.design.paired or point == 0:
            return np.zeros(0)
        at_first, at_point = (
            dict(zip(self.values("run", at), self.planned_values(column, at), strict=True)) for at in (0, point)
        )
        return finite(
            np.array([value - at_first.get(run - point, np.nan) for run, value in at_point.items()], np.float64)
        )

    def ended_well(self, point: int) -> tuple[int, int]:
        """Return how many runs of a point ended well, and how many are finished."""
        at_point = self.points == point
        return int((at_point & self.well).sum()), int(at_point.sum())

    def without_collision(self, point: int) -> tuple[int, int]:
        """Return how many of a point's runs that ended well had no collision or crash, and how many ended well."""
        collisions, crashed = self.values("collisions", point), self.values("crashed", point)
        return int(((collisions == 0) & (crashed != 1)).sum()), len(collisions)

    def count(self, flag: str, point: int | None = None) -> tuple[int, int]:
        """Return for how many runs that ended well a flag such as `as_planned` is set, and for how many it is known."""
        flags = self.values(flag, point)
        return int((flags == 1).sum()), int(np.isfinite(flags).sum())

    def never_as_planned(self) -> list[int]:
        """Return the points with finished runs of which none ended well and followed its plan."""
        points = []
        for point in range(self.design.points):
            (well, runs), (planned, judged_count) = self.ended_well(point), self.count("as_planned", point)
            if runs and not planned and (judged_count or not well):  # a run without a verdict counts neither way
                points.append(point)
        return points

    def windows_s(self) -> tuple[float, float] | None:
        """Return the earliest start and the latest end of the judged windows [s]; None if no run has one."""
        start, end = (self.values(f"window_{side}_s") for side in ("from", "to"))
        is_known = np.isfinite(start) & np.isfinite(end)
        return (float(start[is_known].min()), float(end[is_known].max())) if is_known.any() else None

    def summary(self) -> SweepSummary:
        def texts(rows: Iterable[Row], column: str) -> list[str]:
            return [row[column] for row in rows if row.get(column)]

        def counted(texts: Iterable[str]) -> dict[str, int]:
            """Count texts, most frequent first; texts that differ only in numbers count as the first of them."""
            first: dict[str, str] = {}
            return dict(Counter(first.setdefault(_NUMBER.sub("#", text), text) for text in texts).most_common())

        plan, rows = self.design.plan, self.rows
        well = [row for row, is_well in zip(rows, self.well, strict=True) if is_well]
        engaged, clustered = self.count("engaged")
        dates = sorted(row["date"] for row in rows if row.get("date"))
        return SweepSummary(
            scenario=str(plan.document["name"]),
            seed=self.design.seed,
            vary=plan.vary,
            changed=plan.changed,
            dates=(dates[0], dates[-1]) if dates else None,
            runs=plan.runs,
            finished=len(rows),
            failed=dict(Counter(texts(rows, "failure")).most_common()),
            not_engaged=clustered - engaged,
            not_as_planned=counted(texts(well, "shortfall")),
            judged_unengaged=sum(row.get("engaged_throughout") is False for row in well),
            window_notes=counted(texts(well, "window_note")),
            windows_s=self.windows_s(),
            paper_std=dict(self.paper_std),
            level=LEVEL,
            flown_wall_s=sum(row["wall_s"] or 0.0 for row in rows),
            hosts=dict(Counter(texts(rows, "host"))),
            fingerprints=dict(Counter(texts(rows, "fingerprint"))),
            version=plan.version,
            parameters=self.parameters,
            metrics=tuple(self.metrics),
            unmeasured=dict(Counter(texts(rows, "metrics_failure")).most_common()),
            points=[self._point(point) for point in range(self.design.points)],
        )

    def _point(self, point: int) -> GridPoint:
        well, runs = self.ended_well(point)
        engaged, clustered = self.count("engaged", point)
        planned, judged = self.count("as_planned", point)
        columns = (SEPARATION, OBSTACLE_DISTANCE, *self.errors, *self.metrics)
        rms = (each for each in self.errors if each.endswith(".true_rms"))
        compared = (*self.metrics, SEPARATION, OBSTACLE_DISTANCE, *rms)
        names = self.design.names(point)
        return GridPoint(
            label=" · ".join(names.values()) or "all runs",
            values=self.design.point_values(point),
            names=names,
            runs=runs,
            ended_well=share_interval(well, runs) if runs else None,
            without_collision=share_interval(*self.without_collision(point)) if well else None,
            engaged=engaged if clustered else None,
            as_planned=share_interval(planned, judged) if judged else None,
            excluded=judged - planned,
            spreads={column: each for column in columns if (each := distribution(self.planned_values(column, point)))},
            least_separation_m=min(finite(self.values(SEPARATION, point)).tolist(), default=None),
            differences={
                column: each for column in compared if (each := distribution(self.differences(column, point)))
            },
        )


# Names of fields

UNITS = {  # units by name suffix, longer suffixes first
    "_kg_m2": "kg m²", "_kg_m3": "kg/m³", "_nm_s2": "N m s²", "_rad_s": "rad/s", "_deg_s": "deg/s", "_n_s_m": "N s/m",
    "_n_s2": "N s²", "_1_s2": "1/s²", "_m_s2": "m/s²", "_percent": "%", "_1_s": "1/s", "_m_s": "m/s", "_px2": "px²",
    "_deg": "deg", "_rad": "rad", "_mah": "mAh", "_px": "px", "_kg": "kg", "_hz": "Hz", "_ms": "ms", "_ut": "µT",
    "_m": "m", "_s": "s",
}  # fmt: skip
CHANNEL_UNITS = {  # units of noise parameters, relative to the unit of their channel; see zsim.sensors
    "noise": "", "density": "/√Hz", "bias": "", "bias_walk": "/√s", "bias_instability": "", "quantum": "",
}  # fmt: skip
SECTIONS = ("environment", "sensors", "drones", "clusters", "agents", "metrics")  # omitted from names of fields
WORDS = {
    "gps": "GPS", "imu": "IMU", "mag": "magnetometer", "baro": "barometer", "accel": "accelerometer",
    "gyro": "gyroscope", "takeoff": "take-off",
}  # fmt: skip
VARIABLE_SECTIONS = ("target", "values", "expressions")  # maps in a plan, keyed by the variables of its cluster
CLASS_SECTIONS = ("parameters", "law_parameters", "space_parameters")  # likewise omitted from field names
_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]")  # as in zsim.scenario.scenario_file


class FieldName(Struct, frozen=True):
    """The name of a field in words, and its unit, which may be empty."""

    words: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.words} ({self.unit})" if self.unit else self.words

    def at(self, value: str) -> str:
        """Return the field with an abbreviated value, e.g. "wind gust 1.5 m/s"."""
        return f"{self.words} {value} {self.unit}".rstrip()


def field_name(path: str) -> FieldName:
    """Return the name of a scenario field, or of a column `metrics.NAME`, given its path.

    For example, sensors.gps.position_m.noise is the "GPS position noise" in m.
    """
    steps: list[str] = [word or bracket for word, bracket in _STEP.findall(path)] or [path]
    path_steps = steps[1:] if steps[0] in SECTIONS and len(steps) > (1 if steps[0] == "metrics" else 2) else steps
    path_steps = [step for step in path_steps[:-1] if step not in CLASS_SECTIONS] + path_steps[-1:]
    path_steps = (
        [f"{steps[0].removesuffix('s')} {path_steps[0]}", *path_steps[1:]] if path_steps[0].isdigit() else path_steps
    )
    named_steps: list[tuple[str, str]] = []  # words and unit of each step of the path
    for step in path_steps:
        end = next((end for end in UNITS if step.endswith(end) and step != end), "")
        words = " ".join(WORDS.get(word, word) for word in step.removesuffix(end).split("_"))
        named_steps.append((words, UNITS.get(end, "")))
    if steps[0] == "clusters" and "plan" in steps[2:-2] and steps[-2] in VARIABLE_SECTIONS:
        name = steps[-1]  # a variable; angles are in rad unless the name ends in _deg
        named_steps[-1] = (name[:-4], "deg") if name.endswith("_deg") else (name, unit(name))
    measure = named_steps[-1][1]
    if path_steps[-1] in CHANNEL_UNITS and len(path_steps) > 1 and named_steps[-2][1]:
        measure = named_steps[-2][1] + CHANNEL_UNITS[path_steps[-1]]
    return FieldName(" ".join(words for words, _ in named_steps), measure)
