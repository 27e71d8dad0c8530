"""Several runs side by side: how their scenarios and their results differ. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from os.path import relpath
from pathlib import Path
from typing import Any

import msgspec

from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.window_text import span_text
from zsim_analysis.report.summary import RunSummary

ABSENT = "–"
UNPLANNED = "†"  # behind the name of a run that did not fly as planned
RUNS_PER_TABLE = 2  # beside each other with all their statistics: what the page is wide enough for
THERE = "there"  # cell of an item with a name, such as a drone, that another run does not have


@dataclass
class ComparedRun:
    """One of several runs.

    Attributes:
        name: unique among the runs.
    """

    name: str
    directory: Path
    flight: RecordedFlight
    formations: list[Formation]
    summary: RunSummary

    @property
    def label(self) -> str:
        """Return its name with a mark if it did not fly as planned: what tables and figures call it."""
        return self.name if self.summary.as_planned else f"{self.name} {UNPLANNED}"

    def formation(self, cluster: str) -> Formation | None:
        """Return a cluster's formation, None if this run has none that can be judged."""
        return next((formation for formation in self.formations if formation.name == cluster), None)


def run_names(directories: Sequence[Path]) -> list[str]:
    """Return short names, no two the same: the folders' own, with as many parents as it takes, then a number.

    What is no UTF-8 is a question mark: matplotlib can draw nothing else.
    """
    paths = [directory.resolve() for directory in directories]
    longest = max(len(path.parts) for path in paths)
    for depth in range(1, longest + 1):
        names = ["/".join(path.parts[-depth:]).encode(errors="replace").decode() for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path.name} ({number})" for number, path in enumerate(paths, start=1)]


def table_groups(runs: Sequence[ComparedRun]) -> list[Sequence[ComparedRun]]:
    """Return runs in groups that have room beside each other in a table of errors."""
    return [runs[start : start + RUNS_PER_TABLE] for start in range(0, len(runs), RUNS_PER_TABLE)]


def runs_id(directories: Sequence[Path]) -> str:
    """Return an identifier of these runs in this order: the same wherever their folders are moved together."""
    paths = [directory.resolve() for directory in directories]
    places = "\0".join(relpath(path, paths[0].parent) for path in paths)
    return sha256(places.encode(errors="surrogateescape")).hexdigest()[:16]


def clusters(runs: Iterable[ComparedRun]) -> list[str]:
    """Return the clusters of all runs, in the order of their first run."""
    return list(dict.fromkeys(formation.name for run in runs for formation in run.formations))


def parameters(runs: Iterable[ComparedRun], cluster: str) -> list[str]:
    """Return the variables of a cluster in all runs."""
    judged = (run.summary.clusters.get(cluster) for run in runs)
    return list(dict.fromkeys(name for each in judged if each for name in each.errors))


@dataclass(frozen=True)
class ComparisonRow:
    """A line of a table with a cell per run.

    Attributes:
        differs: the cells are not all the same.
    """

    name: str
    cells: tuple[str, ...]

    @property
    def differs(self) -> bool:
        return len(set(self.cells)) > 1


def scenario_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the fields in which the resolved scenarios differ, by path; a field that a run does not have is absent.

    The fields of a drone, or of another item with a name, that some runs do not have are left out.
    """
    flat = [dict(flattened(msgspec.to_builtins(run.flight.scenario))) if run.flight.scenario else {} for run in runs]
    paths = dict.fromkeys(path for each in flat for path in each)
    partly = tuple(f"{path}." for path in paths if _is_partly(path, flat))
    shown = [path for path in paths if not path.startswith(partly) and _differ(path, flat)]
    return [
        ComparisonRow(path, tuple(_text(each[path]) if path in each else ABSENT for each in flat)) for path in shown
    ]


def _differ(path: str, flat: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a field does not have the same value in all runs; its text may be the same."""
    return any(path not in each for each in flat) or any(each[path] != flat[0][path] for each in flat)


def _is_partly(path: str, flat: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a path is an item with a name that only some of the runs have."""
    return any(each.get(path) == THERE for each in flat) and any(path not in each for each in flat)


def flattened(value: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    """Yield path and value of every leaf; items that have a name go by it, so that their order makes no difference.

    Items without a name go by their number, each with all its fields as one value; an empty list yields nothing.
    """
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from flattened(item, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list | tuple) and value and all(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            if "name" in item:
                yield f"{path}.{item['name']}", THERE
                yield from flattened(item, f"{path}.{item['name']}")
            else:
                yield f"{path}.{number}", item
    elif value != [] and value != ():
        yield path, value


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items() if item is not None)
    return "none" if value is None else str(value)


def notes(runs: Sequence[ComparedRun]) -> list[str]:
    """Return what a reader has to know before comparing: what only some runs have, and which are the same flight."""
    own = [f"{run.name}: {note}" for run in runs for note in run.summary.notes]
    short = [
        f"{run.name}: {'not as planned: ' * each.fails}{each.text}" for run in runs for each in run.summary.shortfalls
    ]
    return [*short, *_alike(runs), *_drones(runs), *_clusters(runs), *_windows(runs), *own]


def _alike(runs: Sequence[ComparedRun]) -> list[str]:
    """Return which runs flew the same bits."""
    by_hash: dict[str, list[str]] = {}
    for run in runs:
        by_hash.setdefault(run.summary.truth_sha256, []).append(run.name)
    return [f"{_listed(names)} flew the same bits." for names in by_hash.values() if len(names) > 1]


def _drones(runs: Sequence[ComparedRun]) -> list[str]:
    every = dict.fromkeys(track.name for run in runs for track in run.flight.tracks)
    return _missing("Drone", every, {run.name: {track.name for track in run.flight.tracks} for run in runs})


def _clusters(runs: Sequence[ComparedRun]) -> list[str]:
    every = clusters(runs)
    lines = _missing("Cluster", every, {run.name: {each.name for each in run.formations} for run in runs})
    for cluster in every:
        conventions = {each.names for run in runs if (each := run.formation(cluster))}
        if len(conventions) > 1:
            lines.append(f"Cluster {cluster} does not have the same variables in all runs; each has its own.")
    return lines


def _missing(what: str, every: Iterable[str], there: Mapping[str, set[str]]) -> list[str]:
    """Return a line for the drones or clusters that the same runs have and the others do not."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in every:
        having = tuple(run for run, names in there.items() if name in names)
        if len(having) < len(there):
            groups.setdefault(having, []).append(name)
    return [
        f"{what}{'s' * (len(names) > 1)} {_listed(names)}: in {_listed(having)} only."
        for having, names in groups.items()
    ]


def _windows(runs: Sequence[ComparedRun]) -> list[str]:
    windows = {run.summary.window_s for run in runs}
    if len(windows) < 2:
        return []
    ranges = "; ".join(f"{run.name}: {span_text(run.summary.window_s)}" for run in runs)
    return [f"The windows of the statistics differ ({ranges})."]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
