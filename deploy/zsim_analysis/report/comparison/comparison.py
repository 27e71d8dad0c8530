"""Several runs side by side: what differs in what was asked, and in what came of it. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from os.path import relpath
from pathlib import Path
from typing import Any

import msgspec

from zsim_analysis.reading.flight import Flight
from zsim_analysis.reading.formation_variables import Formation
from zsim_analysis.report.summary import Summary

ABSENT = "–"
THERE = "there"  # what is said of a thing with a name, such as a drone, that another run has not


@dataclass
class Compared:
    """One of several runs.

    Attributes:
        name: by which it is told from the others.
    """

    name: str
    directory: Path
    flight: Flight
    formations: list[Formation]
    summary: Summary

    def formation(self, cluster: str) -> Formation | None:
        """Return a cluster's formation, None if this run has none that can be judged."""
        return next((formation for formation in self.formations if formation.name == cluster), None)


def run_names(directories: Sequence[Path]) -> list[str]:
    """Return short names, no two the same: the folders' own, with as many parents as it takes, then a number."""
    paths = [directory.resolve() for directory in directories]
    longest = max(len(path.parts) for path in paths)
    for depth in range(1, longest + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path.name} ({number})" for number, path in enumerate(paths, start=1)]


def runs_id(directories: Sequence[Path]) -> str:
    """Return a word for these runs in this order: the same wherever their folders are moved together."""
    paths = [directory.resolve() for directory in directories]
    places = "\0".join(relpath(path, paths[0].parent) for path in paths)
    return sha256(places.encode(errors="surrogateescape")).hexdigest()[:16]


def clusters(runs: Iterable[Compared]) -> list[str]:
    """Return the clusters of all runs, in the order in which they are met."""
    return list(dict.fromkeys(formation.name for run in runs for formation in run.formations))


def parameters(runs: Iterable[Compared], cluster: str) -> list[str]:
    """Return the variables of a cluster in all runs."""
    found = (run.summary.clusters.get(cluster) for run in runs)
    return list(dict.fromkeys(name for each in found if each for name in each.errors))


@dataclass(frozen=True)
class Row:
    """A line of a table with a cell per run.

    Attributes:
        differs: the cells are not all the same.
    """

    name: str
    cells: tuple[str, ...]

    @property
    def differs(self) -> bool:
        return len(set(self.cells)) > 1


def scenario_rows(runs: Sequence[Compared]) -> list[Row]:
    """Return the fields in which the resolved scenarios differ, by path; a field that a run has not is absent.

    Of a drone, or another thing with a name, that some runs have not, the fields are left out.
    """
    flat = [dict(flattened(msgspec.to_builtins(run.flight.scenario))) if run.flight.scenario else {} for run in runs]
    paths = dict.fromkeys(path for each in flat for path in each)
    partly = tuple(f"{path}." for path in paths if _is_partly(path, flat))
    told = [path for path in paths if not path.startswith(partly) and _differ(path, flat)]
    return [Row(path, tuple(_text(each[path]) if path in each else ABSENT for each in flat)) for path in told]


def _differ(path: str, flat: Sequence[Mapping[str, Any]]) -> bool:
    """Tell whether a field has not the same value in all runs; its text may be the same."""
    return any(path not in each for each in flat) or any(each[path] != flat[0][path] for each in flat)


def _is_partly(path: str, flat: Sequence[Mapping[str, Any]]) -> bool:
    """Tell whether a path is a thing with a name that some runs have and others not."""
    return any(each.get(path) == THERE for each in flat) and any(path not in each for each in flat)


def flattened(value: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    """Yield path and value of every leaf; items that have a name go by it, so that their order tells nothing.

    Others are told as a whole by their number; of none there is nothing to tell.
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


def notes(runs: Sequence[Compared]) -> list[str]:
    """Return what a reader has to know before comparing: what some runs have not, and which are one flight."""
    said = [f"{run.name}: {note}" for run in runs for note in run.summary.notes]
    return [*_alike(runs), *_drones(runs), *_clusters(runs), *_windows(runs), *said]


def _alike(runs: Sequence[Compared]) -> list[str]:
    """Return which runs flew the same bits."""
    by_hash: dict[str, list[str]] = {}
    for run in runs:
        by_hash.setdefault(run.summary.truth_sha256, []).append(run.name)
    return [f"{_listed(names)} flew the same bits." for names in by_hash.values() if len(names) > 1]


def _drones(runs: Sequence[Compared]) -> list[str]:
    every = dict.fromkeys(track.name for run in runs for track in run.flight.tracks)
    return _missing("Drone", every, {run.name: {track.name for track in run.flight.tracks} for run in runs})


def _clusters(runs: Sequence[Compared]) -> list[str]:
    every = clusters(runs)
    found = _missing("Cluster", every, {run.name: {each.name for each in run.formations} for run in runs})
    for cluster in every:
        conventions = {each.names for run in runs if (each := run.formation(cluster))}
        if len(conventions) > 1:
            found.append(f"Cluster {cluster} does not have the same variables in all runs; each has its own.")
    return found


def _missing(what: str, every: Iterable[str], there: Mapping[str, set[str]]) -> list[str]:
    """Return a line for all things that the same runs have, where others have not."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in every:
        having = tuple(run for run, names in there.items() if name in names)
        if len(having) < len(there):
            groups.setdefault(having, []).append(name)
    return [
        f"{what}{'s' * (len(names) > 1)} {_listed(names)}: in {_listed(having)} only."
        for having, names in groups.items()
    ]


def _windows(runs: Sequence[Compared]) -> list[str]:
    windows = {run.summary.window_s for run in runs}
    if len(windows) < 2:
        return []
    told = "; ".join("{}: {:.5g} to {:.5g} s".format(run.name, *run.summary.window_s) for run in runs)
    return [f"The windows of the statistics differ ({told})."]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
