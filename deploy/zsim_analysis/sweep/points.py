"""What a sweep came to at each point of its grid: distributions, and confidence intervals of means and shares. Pure."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from zsim.errors import ScenarioError
from zsim.scenario.scenario import Scenario
from zsim_analysis.report.paper import PAPER_TABLE_1, paper_table
from zsim_analysis.sweep.axes import Draw
from zsim_analysis.sweep.design import SweepDesign
from zsim_analysis.sweep.intervals import LEVEL, RUNS_MIN, mean_interval, share_interval
from zsim_analysis.sweep.metrics import metric_columns, metrics_function
from zsim_analysis.sweep.sweep_run import FIXED, Row, engaged_column
from zsim_analysis.sweep.sweep_summary import Distribution, FormationParameter, GridPoint, SweepSummary

STATISTICS = ("est_std", "true_std", "true_rms", "true_mean")
_FIGURE = re.compile(r"(?<![\w.])\d[\d.]*")  # in a text, but not in a name such as drone1
_COLUMN = re.compile(r"(?:clusters\.(.+?)\.)?errors\.(.+)")  # start of a column: its cluster's name, and its own


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
        self.metrics = metric_columns(rows)
        self.metrics_function = metrics_function(design.plan.document)
        self.has_seeds = design.seeds is not None
        self.drawn = [axis.path for axis in design.axes if isinstance(axis, Draw)]
        self.paper_std = _paper_std(design)

    def values(self, column: str, point: int | None = None) -> NDArray[np.float64]:
        """Return what a column holds for the runs that ended well, at one point or all; NaN where unknown."""
        chosen = self.well if point is None else self.well & (self.points == point)
        cells = [row.get(column) for row, is_chosen in zip(self.rows, chosen, strict=True) if is_chosen]
        return np.array([np.nan if cell is None else cell for cell in cells], np.float64)

    def flown(self, column: str, point: int | None = None) -> NDArray[np.float64]:
        """Return `values`, NaN where a run did not do what its plan says: statistics would look better by it."""
        return np.where(self.values("as_planned", point) == 0, np.nan, self.values(column, point))

    def differences(self, column: str, point: int) -> NDArray[np.float64]:
        """Return value − value at the first point of each pair of runs with one seed that are both of `flown`.

        Empty at the first point, and where seeds are not paired.
        """
        if not self.design.paired or point == 0:
            return np.zeros(0)
        first, own = (dict(zip(self.values("run", at), self.flown(column, at), strict=True)) for at in (0, point))
        pairs = np.array([value - first.get(run - point, np.nan) for run, value in own.items()], np.float64)
        return pairs[np.isfinite(pairs)]

    def parameters(self) -> dict[str, FormationParameter]:
        """Return the formation parameters, by the beginning of their columns."""
        return parameters(self.errors, self.clusters)

    def ended_well(self, point: int) -> tuple[int, int]:
        """Return how many of a point's finished runs ended well, and how many there are."""
        at_point = self.points == point
        return int((at_point & self.well).sum()), int(at_point.sum())

    def without_collision(self, point: int) -> tuple[int, int]:
        """Return in how many of a point's runs that ended well no drone collided or fell, and how many there are."""
        collisions, crashed = self.values("collisions", point), self.values("crashed", point)
        return int(((collisions == 0) & (crashed != 1)).sum()), len(collisions)

    def engaged(self, point: int | None = None) -> tuple[int, int]:
        """Return how many runs that ended well had every cluster engaged, and how many have a cluster."""
        engaged = self.values("engaged", point)
        return int((engaged == 1).sum()), int(np.isfinite(engaged).sum())

    def as_planned(self, point: int) -> tuple[int, int]:
        """Return how many of a point's runs that ended well did what their plan says, and how many are judged."""
        planned = self.values("as_planned", point)
        return int((planned == 1).sum()), int(np.isfinite(planned).sum())

    def never_as_planned(self) -> list[int]:
        """Return the points with finished runs of which none ended well and did what its plan says."""
        return [point for point in range(self.design.points) if self._is_never_as_planned(point)]

    def _is_never_as_planned(self, point: int) -> bool:
        (well, runs), (planned, of) = self.ended_well(point), self.as_planned(point)
        return bool(runs and not planned and (of or not well))  # without a cluster no run that ended well is judged

    def windows_s(self) -> tuple[float, float] | None:
        """Return the least start and the greatest end [s] of the judged windows, None where no run has one."""
        start, end = (self.values(f"window_{side}_s") for side in ("from", "to"))
        known = np.isfinite(start) & np.isfinite(end)
        return (float(start[known].min()), float(end[known].max())) if known.any() else None

    def _well(self) -> list[Row]:
        return [row for row, well in zip(self.rows, self.well, strict=True) if well]

    def label(self, point: int) -> str:
        """Return the values of a point in short; "all runs" where there is no grid."""
        return " · ".join(self.design.names(point).values()) or "all runs"

    def summary(self) -> SweepSummary:
        """Return the content of summary.json."""
        plan = self.design.plan
        rows = self.rows
        engaged, of = self.engaged()
        dates = sorted(row["date"] for row in rows if row.get("date"))
        return SweepSummary(
            scenario=str(plan.document["name"]),
            seed=self.design.seed,
            vary=plan.vary,
            changed=plan.changed,
            dates=(dates[0], dates[-1]) if dates else None,
            runs=plan.runs,
            finished=len(rows),
            failed=dict(Counter(row["failure"] for row in rows if row["failure"]).most_common()),
            not_engaged=of - engaged,
            not_as_planned=_counted(row["shortfall"] for row in self._well() if row.get("shortfall")),
            judged_unengaged=sum(row.get("engaged_throughout") is False for row in self._well()),
            window_notes=_counted(row["window_note"] for row in self._well() if row.get("window_note")),
            windows_s=self.windows_s(),
            paper_std=dict(self.paper_std),
            level=LEVEL,
            flown_wall_s=sum(row["wall_s"] or 0.0 for row in rows),
            hosts=dict(Counter(row["host"] for row in rows if row["host"])),
            fingerprints=dict(Counter(row["fingerprint"] for row in rows if row["fingerprint"])),
            version=plan.version,
            parameters=self.parameters(),
            metrics=tuple(self.metrics),
            unmeasured=dict(
                Counter(row["metrics_failure"] for row in rows if row.get("metrics_failure")).most_common()
            ),
            points=[self._point(point) for point in range(self.design.points)],
        )

    def _point(self, point: int) -> GridPoint:
        well, runs = self.ended_well(point)
        engaged, of = self.engaged(point)
        columns = ("min_separation_m", *self.errors, *self.metrics)
        spreads = {column: each for column in columns if (each := distribution(self.flown(column, point)))}
        compared = (*self.metrics, "min_separation_m", *(each for each in self.errors if each.endswith(".true_rms")))
        differences = {column: each for column in compared if (each := distribution(self.differences(column, point)))}
        separations, (planned, judged) = self.values("min_separation_m", point), self.as_planned(point)
        return GridPoint(
            label=self.label(point),
            values=self.design.at(point),
            names=self.design.names(point),
            runs=runs,
            ended_well=share_interval(well, runs) if runs else None,
            without_collision=share_interval(*self.without_collision(point)) if well else None,
            engaged=engaged if of else None,
            as_planned=share_interval(planned, judged) if judged else None,
            excluded=judged - planned,
            spreads=spreads,
            least_separation_m=float(np.nanmin(separations)) if np.isfinite(separations).any() else None,
            differences=differences,
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
    few = tuple(known.tolist()) if len(known) < RUNS_MIN else ()
    ends = float(known.min()), float(known.max())
    return Distribution(len(known), mean_interval(known), std, p5, median, p95, *ends, few)


def _counted(texts: Iterable[str]) -> dict[str, int]:
    """Return how often each text occurs, most often first; those that differ in figures only count as the first one."""
    first: dict[str, str] = {}
    counts = Counter(first.setdefault(_FIGURE.sub("#", text), text) for text in texts)
    return dict(counts.most_common())


def _error_columns(rows: Sequence[Row]) -> list[str]:
    names = dict.fromkeys(name for row in rows for name in row if name not in FIXED)
    return [name for name in names if name.startswith(("errors.", "clusters.")) and name.endswith(STATISTICS)]


def _paper_std(design: SweepDesign) -> Mapping[str, float]:
    """Return Table I where every point flies Test 1; empty where only some do, or a field other than seed is drawn."""
    if any(isinstance(axis, Draw) for axis in design.axes):
        return {}
    try:
        flown = all(_flies_test_1(design.scenario(point)) for point in range(design.points))
        return PAPER_TABLE_1 if flown else {}
    except ScenarioError:
        return {}


def _flies_test_1(scenario: Scenario) -> bool:
    return len(scenario.clusters) == 1 and bool(paper_table(scenario, scenario.clusters[0].name))
