"""What the summary of a sweep holds: of each point of its grid, distributions and confidence intervals. Pure."""

from typing import Any

import msgspec
from msgspec import Struct

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.sweep.intervals import ConfidenceInterval


class FormationParameter(Struct, frozen=True):
    """A variable of a formation.

    Attributes:
        cluster: the formation's name, None where there is only one.
    """

    name: str
    cluster: str | None = None

    @property
    def unit(self) -> str:
        """Return the unit, m or rad."""
        return unit(self.name)

    @property
    def titled(self) -> str:
        """Return the name with its unit, and the cluster's where one is needed."""
        return self.labelled(f"{self.name} ({self.unit})")

    def labelled(self, text: str) -> str:
        """Return a text about the variable, with the cluster's name where one is needed."""
        return f"{self.cluster}: {text}" if self.cluster else text


class Distribution(Struct, frozen=True):
    """How a quantity is distributed over runs of a point.

    Attributes:
        samples: all of them where they are too few for an interval, else empty.
    """

    runs: int
    mean: ConfidenceInterval
    std: float
    p5: float
    median: float
    p95: float
    least: float
    greatest: float
    samples: tuple[float, ...] = ()


class GridPoint(Struct, frozen=True):
    """One combination of the grid's values.

    Attributes:
        values: by path; empty where only seeds and drawn values vary.
        names: the values in short, no two of a field alike.
        runs: finished ones.
        ended_well: share of them; None without a run.
        without_collision: share of those that ended well in which no drone ran into another or an obstacle, or fell.
        engaged: runs that ended well and had every cluster engaged at some instant of the judged window; None where
            no run has a cluster.
        as_planned: share of those that ended well that did what their plan says.
        excluded: runs that ended well and did not do what their plan says: they are in no spread and no difference.
        spreads: by column of the table, of those that ended well and did what their plan says.
        least_separation_m: of all that ended well, None where no run has any.
        differences: by column, of its value less that at the first point in the run with the same seed, over the pairs
            of runs of which both are in the spreads; empty at the first point, and where seeds are not paired.
    """

    label: str
    values: dict[str, Any]
    names: dict[str, str]
    runs: int
    ended_well: ConfidenceInterval | None
    without_collision: ConfidenceInterval | None
    engaged: int | None
    as_planned: ConfidenceInterval | None
    spreads: dict[str, Distribution]
    excluded: int = 0
    least_separation_m: float | None = None
    differences: dict[str, Distribution] = {}

    @property
    def well(self) -> int:
        """Return how many runs ended well."""
        return round(self.ended_well.value * self.runs) if self.ended_well else 0

    def count(self, column: str) -> str:
        """Return of how many runs a mean is, "" where it is of all that ended well."""
        spread = self.spreads.get(column)
        return count_text(spread.runs, self.well) if spread else ""


class SweepSummary(Struct, frozen=True):
    """summary.json of a sweep.

    Attributes:
        changed: texts `a.b.c=value` by which the scenario was changed against its file; None: not known.
        dates: when the first and the last run were flown (ISO 8601, UTC); None where no run has a date.
        not_engaged: runs that ended well, but a cluster was never engaged within the judged window.
        not_as_planned: by what the first of them did not do, how many runs ended well and did not do what their plan
            says; texts that differ in figures only are one.
        judged_unengaged: runs that ended well whose window holds instants at which a cluster was not engaged.
        window_notes: by why their window is not that of the scenario, how many runs ended well.
        windows_s: the judged windows, least start and greatest end of all runs; None where no run has one.
        paper_std: Table I by parameter, empty for any flight but Test 1.
        parameters: of the formations, by the beginning of their columns.
        metrics: columns of the figures of the user's own.
        unmeasured: by the reason, how many runs have none of those.
    """

    scenario: str
    seed: int
    vary: tuple[str, ...]
    changed: tuple[str, ...] | None
    dates: tuple[str, str] | None
    runs: int
    finished: int
    failed: dict[str, int]
    not_engaged: int
    not_as_planned: dict[str, int]
    judged_unengaged: int
    windows_s: tuple[float, float] | None
    paper_std: dict[str, float]
    level: float
    flown_wall_s: float
    hosts: dict[str, int]
    fingerprints: dict[str, int]
    version: str
    parameters: dict[str, FormationParameter]
    metrics: tuple[str, ...]
    unmeasured: dict[str, int]
    points: list[GridPoint]
    window_notes: dict[str, int] = {}

    def json(self) -> bytes:
        """Return the text of summary.json; what is not known is null."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"

    @property
    def flown(self) -> list[GridPoint]:
        """Return the points that a run has finished."""
        return [point for point in self.points if point.runs]

    @property
    def known(self) -> set[str]:
        """Return the columns that some run at some point has a number of."""
        return {column for point in self.points for column in point.spreads}


def count_text(count: int, of: int) -> str:
    """Return the number of runs behind a mean where it is less than the whole, else ""."""
    return f"n = {count}" if count < of else ""
