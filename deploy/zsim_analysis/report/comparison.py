"""The comparison of several runs: differences between their scenarios and results, and the page with its figures.

In the figures, runs are overlaid where lines remain distinguishable, otherwise side by side.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from os.path import relpath
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim.errors import ReportError
from zsim.output_folder import RECORD
from zsim.presentation import colours_of
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report import figure_style as style
from zsim_analysis.report.flight_figures import (
    DRONE_PANELS,
    NAMED_MAX,
    curves,
    draw_drone_panels,
    draw_error,
    draw_obstacles,
    draw_path,
    drone_panel_heights,
    name_states,
    numbered,
    parameter_groups,
)
from zsim_analysis.report.make_report import Picture, facts, rendered, write_page
from zsim_analysis.report.summary import STATISTICS, RunSummary, flies_paper_test, judge

ABSENT = "–"
RUNS_PER_TABLE = 2  # runs side by side with all their statistics; more do not fit the page
THERE = "there"  # cell of a named item, such as a drone, that another run does not have
RUNS_NAMED, NAMES_MAX = 3, 100  # number of runs in the page's file name, and of characters of their names
MARK, HEAD_BYTES = b": comparison</title>", 4_000  # identifies comparison pages, within their first HEAD_BYTES
UNPLANNED = "†"  # after the name of a run that was not flown as planned


@dataclass
class ComparedRun:
    name: str  # unique among the runs
    directory: Path
    flight: RecordedFlight
    formations: list[Formation]
    summary: RunSummary

    @property
    def label(self) -> str:
        """The run's name in tables and figures, marked if it was not flown as planned."""
        return self.name if self.summary.as_planned else f"{self.name} {UNPLANNED}"

    def formation(self, cluster: str) -> Formation | None:
        """Return a cluster's formation; None if this run has none that can be judged."""
        return next((formation for formation in self.formations if formation.name == cluster), None)


def compare(
    directories: Sequence[Path],
    out: Path,
    progress: Callable[[str], None] = lambda _: None,
    formats: Sequence[str] = (),
) -> list[ComparedRun]:
    """Read the records of several runs and write the page that compares them; further arguments as for `write_page`.

    Raises:
        RecordError: a run has no record, or its record contains no truth of any drone.
        ReportError: a run is given twice, or the page cannot be written or would replace something else.
    """
    paths = [directory.resolve() for directory in directories]
    for number, directory in enumerate(directories):
        if paths[number] in paths[:number]:
            raise ReportError(f"{directory}: is given twice; must be given once")
    if out.exists() and MARK not in _first_bytes(out):
        raise ReportError(f"{out}: exists and is not a comparison of runs; give --out another path")
    runs = []
    for name, directory in zip(run_names(directories), directories, strict=True):
        results = judge(directory / RECORD, lambda text, name=name: progress(f"{name}: {text}"))
        runs.append(ComparedRun(name, directory, *results))
    write_page(out, comparison_figures(runs), partial(comparison_page, runs), progress, formats)
    return runs


def comparison_path(directories: Sequence[Path]) -> Path:
    """Return the default path of a comparison: beside the first run, with a name that no other comparison has."""
    names = [name.replace("/", "-") for name in run_names(directories)]
    further = f"-and-{len(names) - RUNS_NAMED}-more" if len(names) > RUNS_NAMED else ""
    stem = f"compare-{'-'.join(names[:RUNS_NAMED])[:NAMES_MAX]}{further}"
    folder, identifier = directories[0].resolve().parent, runs_id(directories).encode()
    path, number = folder / f"{stem}.html", 1
    while MARK in (start := _first_bytes(path)) and identifier not in start:
        number += 1
        path = folder / f"{stem}-{number}.html"
    return path


def _first_bytes(page: Path) -> bytes:
    """Return the first bytes of a file, empty if it does not exist."""
    if not page.is_file():
        return b""
    with page.open("rb") as file:
        return file.read(HEAD_BYTES)


def run_names(directories: Sequence[Path]) -> list[str]:
    """Return short unique names: folder names with as many parents as needed, or numbered if that does not suffice.

    Bytes that are not UTF-8 become question marks, since matplotlib cannot draw them.
    """
    paths = [directory.resolve() for directory in directories]
    longest = max(len(path.parts) for path in paths)
    for depth in range(1, longest + 1):
        names = ["/".join(path.parts[-depth:]).encode(errors="replace").decode() for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path.name} ({number})" for number, path in enumerate(paths, start=1)]


def runs_id(directories: Sequence[Path]) -> str:
    """Return an identifier of these runs in this order; it stays the same if their folders are moved together."""
    paths = [directory.resolve() for directory in directories]
    relative_paths = "\0".join(relpath(path, paths[0].parent) for path in paths)
    return sha256(relative_paths.encode(errors="surrogateescape")).hexdigest()[:16]


def comparison_page(runs: Sequence[ComparedRun], pictures: Sequence[Picture]) -> str:
    groups = [runs[start : start + RUNS_PER_TABLE] for start in range(0, len(runs), RUNS_PER_TABLE)]
    return rendered(
        "comparison.html.j2",
        pictures,
        runs=runs,
        runs_id=runs_id([run.directory for run in runs]),
        facts=fact_rows(runs),
        notes=notes(runs),
        statistics=list(STATISTICS),
        unplanned=UNPLANNED if any(not run.summary.as_planned for run in runs) else "",
        tables={name: [(group, statistics_rows(group, name)) for group in groups] for name in clusters(runs)},
        scenario=scenario_rows(runs),
        without=[run.name for run in runs if run.flight.scenario is None],
    )


class ComparisonRow(NamedTuple):
    """A row of a table with one or more cells per run."""

    name: str
    cells: tuple[str, ...]

    @property
    def differs(self) -> bool:
        return len(set(self.cells)) > 1


def fact_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return a row for each fact on the runs' own pages, and for further facts that may differ."""
    columns = [
        dict(facts(run.summary))
        | {
            "Drones": f"{len(run.flight.tracks)}",
            "Clusters": ", ".join(f"{c.name} of {len(c.drones)}" for c in run.flight.clusters) or "none",
            "Scenario's hash": run.flight.info.scenario_sha256[:16] if run.flight.info else "not known",
            "Messages": f"{run.summary.record.messages}",
        }
        for run in runs
    ]
    names = dict.fromkeys(name for column in sorted(columns, key=len, reverse=True) for name in column)
    return [ComparisonRow(name, tuple(column.get(name, ABSENT) for column in columns)) for name in names]


def statistics_rows(runs: Sequence[ComparedRun], cluster: str) -> list[ComparisonRow]:
    """Return a row per variable of a cluster, with a cell for each of the STATISTICS of each run."""
    rows = []
    for name in parameters(runs, cluster):
        clusters_of_runs = [run.summary.clusters.get(cluster) for run in runs]
        errors = [each.errors.get(name) if each else None for each in clusters_of_runs]
        values = [getattr(each, statistic, None) for each in errors for statistic in STATISTICS.values()]
        cells = tuple(ABSENT if value is None else f"{value:.4f}" for value in values)
        rows.append(ComparisonRow(f"{name} ({unit(name)})", cells))
    return rows


def scenario_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the fields in which the resolved scenarios differ, by path; a field that a run lacks is ABSENT.

    Named items that some runs lack, such as drones, are listed without their fields.
    """
    flat = [dict(flattened(msgspec.to_builtins(run.flight.scenario))) if run.flight.scenario else {} for run in runs]
    paths = dict.fromkeys(path for each in flat for path in each)
    partial_paths = [path for path in paths if any(path not in each for each in flat)]
    items = tuple(f"{path}." for path in partial_paths if any(each.get(path) == THERE for each in flat))
    return [
        ComparisonRow(path, tuple(_text(each[path]) if path in each else ABSENT for each in flat))
        for path in paths
        if not path.startswith(items)
        and (path in partial_paths or any(each[path] != flat[0][path] for each in flat))  # texts may coincide
    ]


def flattened(value: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    """Yield the path and value of every leaf; named items are identified by their names, whatever their order.

    Items without names are identified by their indices, each with all its fields as one value; empty lists are omitted.
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
    """Return remarks: shortfalls, identical flights, drones and clusters of only some runs; then each run's notes."""
    lines = [
        f"{run.name}: {'not as planned: ' * each.fails}{each.text}" for run in runs for each in run.summary.shortfalls
    ]
    by_hash: dict[str, list[str]] = {}
    for run in runs:
        by_hash.setdefault(run.summary.truth_sha256, []).append(run.name)
    lines += [f"{_listed(names)} are bit-identical." for names in by_hash.values() if len(names) > 1]
    lines += _missing("Drone", {run.name: [track.name for track in run.flight.tracks] for run in runs})
    lines += _missing("Cluster", {run.name: [formation.name for formation in run.formations] for run in runs})
    for cluster in clusters(runs):
        if len({each.names for run in runs if (each := run.formation(cluster))}) > 1:
            lines.append(f"Cluster {cluster} does not have the same variables in all runs; each has its own.")
    if len({run.summary.window_s for run in runs}) > 1:
        ranges = "; ".join(f"{run.name}: {span_text(run.summary.window_s)}" for run in runs)
        lines.append(f"The windows of the statistics differ ({ranges}).")
    return [*lines, *(f"{run.name}: {note}" for run in runs for note in run.summary.notes)]


def _missing(kind: str, present: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a line for each set of drones or clusters that only some runs have."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in dict.fromkeys(name for names in present.values() for name in names):
        owners = tuple(run for run, names in present.items() if name in names)
        if len(owners) < len(present):
            groups.setdefault(owners, []).append(name)
    return [
        f"{kind}{'s' * (len(names) > 1)} {_listed(names)}: in {_listed(owners)} only."
        for owners, names in groups.items()
    ]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


# Figures

COLUMNS = 3  # maximum number of runs in a row of a figure
MARGIN_SHARE = 0.03  # margin beyond the largest RMS, as a share of the axis, so that its mark is not cut off
ROWS_MAX = 24  # maximum number of parameters in one figure: those of 6 drones
DESIRED: dict[str, Any] = {"color": style.BLACK, "lw": 1.0, "ls": (0, (1, 2)), "zorder": 6}
LANE_IN = 0.24  # height of a run's lane of marks
HATCHES = {"assembly": "////", "held": "xxxx", "landing": "....", style.FAULT: "", style.TAKE_OVER: "\\\\\\\\"}
POINTS = {"take-off": "^", "engagement": "D", "collision": "X"}
FACE, FAULT_FACE = 0.35, 0.65
EMPTY, GREY_FACE = "#e6eaee", "#b6bfc9"  # colours of an empty lane and of a bar in the legend
NAME_MAX = 20  # maximum number of characters of a run's name beside its lane


def clusters(runs: Iterable[ComparedRun]) -> list[str]:
    """Return the names of the clusters of all runs."""
    return list(dict.fromkeys(formation.name for run in runs for formation in run.formations))


def parameters(runs: Iterable[ComparedRun], cluster: str) -> list[str]:
    """Return the variables of a cluster that any run has."""
    summaries = (run.summary.clusters.get(cluster) for run in runs)
    return list(dict.fromkeys(name for each in summaries if each for name in each.errors))


class RunStyle(NamedTuple):
    """Colour, dashes and marker of a run, distinguishable in black and white as well."""

    color: str
    dashes: Any
    marker: str


STYLES = (
    RunStyle(style.BLUE, "-", "o"),
    RunStyle(style.VERMILION, (0, (6, 2)), "s"),
    RunStyle(style.GREEN, (0, (6, 2, 1.5, 2)), "^"),
    RunStyle(style.PURPLE, (0, (2.5, 1.5)), "D"),
    RunStyle(style.ORANGE, (0, (10, 3)), "v"),
    RunStyle(style.SKY, (0, (6, 2, 1.5, 2, 1.5, 2)), "P"),
)


def run_style(index: int) -> RunStyle:
    """Return the style of a run; from the seventh run on, colours repeat with other dashes."""
    repeats, position = divmod(index, len(STYLES))
    return STYLES[position]._replace(dashes=STYLES[(index + repeats) % len(STYLES)].dashes)


def comparison_figures(runs: Sequence[ComparedRun]) -> Iterator[style.ReportFigure]:
    """Yield the figures for which the records have data."""
    for cluster in clusters(runs):
        yield from _cluster_figures(runs, cluster)
    if any(len(track.t_ns) for run in runs for track in run.flight.tracks):
        yield style.ReportFigure(
            "plan_view.png",
            "Plan view",
            "True paths from above, on one scale; squares: start, dots: end.",
            _draw_plans(runs),
        )
        yield style.ReportFigure(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone, run by run on the same axes.",
            _draw_drones(runs),
        )


def _across(runs: Sequence[ComparedRun]) -> int:
    """Return the number of runs in a row, with rows of about equal length."""
    rows = -(-len(runs) // COLUMNS)
    return -(-len(runs) // rows)


def _cluster_figures(runs: Sequence[ComparedRun], cluster: str) -> Iterator[style.ReportFigure]:
    names = parameters(runs, cluster)
    paper = all(
        flies_paper_test(run.flight, cluster) and not style.time_marks(run.flight).has(style.TAKE_OVER) for run in runs
    )
    suffix = f", cluster {cluster}" if len(clusters(runs)) > 1 else ""
    yield style.ReportFigure(
        f"rms_{cluster}.png",
        f"Errors of the formation's parameters{suffix}",
        "Root mean square of truth − desired (filled marks) and of estimate − desired (hollow marks) within the "
        "window of each run.",
        _draw_rms(runs, cluster, names[:ROWS_MAX]),
    )
    for number, start in enumerate(range(0, len(runs), _across(runs))):
        some = runs[start : start + _across(runs)]
        if any(run.formation(cluster) for run in some):
            yield style.ReportFigure(
                f"figure_5_errors_{cluster}_{number}.png",
                f"Formation parameters' errors{numbered(5, paper)}{suffix}",
                "Runs side by side; each row has one scale, set by the windows (shaded); larger errors are cut off.",
                _draw_errors(some, runs, cluster, names[:ROWS_MAX]),
            )
    for file, number, group_name, group in parameter_groups(names):
        if shown := group[:ROWS_MAX]:
            yield style.ReportFigure(
                f"{file}_{cluster}.png",
                f"{group_name}{numbered(number, paper)}{suffix}",
                f"(a) True and (b) measured (from the estimates) {', '.join(shown)}; dotted: desired. "
                "Above: each run's marks.",
                _draw_parameters(runs, cluster, shown),
            )


def _draw_rms(runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> Figure:
    """Draw the RMS errors, with a panel for metres and one for radians."""
    groups = {each: [name for name in names if unit(name) == each] for each in dict.fromkeys(map(unit, names))}
    figure = style.new_figure(style.PAGE_IN, 1.0 + len(groups) * 0.4 + 0.16 * (len(runs) + 1) * len(names))
    heights = [len(group) for group in groups.values()]
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (measure, group) in zip(panels, groups.items(), strict=True):
        style.dress(axes)
        lane = 1.0 / (len(runs) + 1)
        for i, run in enumerate(runs):
            summary, look = run.summary.clusters.get(cluster), run_style(i)
            for row, name in enumerate(group):
                errors = summary.errors.get(name) if summary else None
                y = row + (i - (len(runs) - 1) / 2) * lane
                for value, face in ((errors and errors.true_rms, look.color), (errors and errors.est_rms, "white")):
                    if value is not None:
                        axes.plot(value, y, look.marker, color=look.color, mfc=face, ms=7, zorder=3, clip_on=False)
        axes.set_yticks(range(len(group)), [style.label(name) for name in group])
        axes.set_ylim(len(group) - 0.5, -0.5)
        axes.margins(x=MARGIN_SHARE)
        axes.set_xlim(left=0)
        for row in range(1, len(group)):
            axes.axhline(row - 0.5, color=style.GRID, lw=0.6, zorder=1)
        axes.grid(False, axis="y")
        axes.set_xlabel(f"RMS error ({measure})", fontsize=style.PAPER_PT)
    style.letter_panels(panels)
    for i, run in enumerate(runs):
        look = run_style(i)
        panels[0].plot([], [], look.marker, color=look.color, ms=7, label=run.label)
    style.legend_above(figure, panels[0])
    return figure


def _draw_errors(
    some: Sequence[ComparedRun], runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]
) -> Figure:
    """Draw the errors of a few runs side by side; all runs determine the scale of a row."""
    figure = style.new_figure(style.PAGE_IN, 0.9 + 0.7 * len(names))
    grid = figure.subplots(len(names), len(some), squeeze=False, sharex=True, sharey="row")
    for run, column in zip(some, grid.T, strict=True):
        formation = run.formation(cluster)
        column[0].set_title(run.label, fontsize=style.PAPER_PT)
        style.label_time(column[-1:])
        for name, axes in zip(names, column, strict=True):
            if formation and name in formation.names:
                draw_error(axes, formation, name, np.ones(len(formation.t_s), bool))
                style.shade_window(axes, run.summary.window_s)
                style.draw_marks([axes], style.time_marks(run.flight, formation))
            else:
                style.dress(axes)
                look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": style.PAPER_PT - 1}
                axes.text(0.5, 0.5, "not in this run", transform=axes.transAxes, color="#57606a", **look)
    style.letter_panels(grid[0])
    for name, axes in zip(names, grid[:, 0], strict=True):
        axes.set_ylabel(style.label(name), fontsize=style.PAPER_PT)
        limit = 0.0  # largest error within the window, over all runs
        for run in runs:
            formation = run.formation(cluster)
            if formation and name in formation.names:
                rows, i = formation.within(run.summary.window_s), formation.column(name)
                errors = np.abs(np.r_[formation.true_error[rows, i], formation.est_error[rows, i]])
                limit = max(limit, float(np.max(errors[np.isfinite(errors)], initial=0.0)))
        if limit:
            axes.set_ylim(-1.15 * limit, 1.15 * limit)
    figure.align_ylabels(grid[:, 0])
    style.legend_above(figure, next((axes for axes in grid[0] if axes.lines), grid[0, 0]))
    return figure


def _draw_parameters(runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> Figure:
    """Draw variables over time: true on the left, measured on the right, with the runs overlaid."""
    lanes_in, marks = LANE_IN * len(runs), []
    for run in runs:
        times = style.time_marks(run.flight, run.formation(cluster))
        once = (("take-off", times.takeoff_s), ("engagement", times.engaged_s))
        points = [(kind, t_s) for kind, t_s in once if t_s is not None]
        points += [("collision", event.t_ns / 1e9) for event in run.flight.events if event.kind == "collision"]
        marks.append(RunMarks(run.label, times, points))
    figure = style.new_figure(style.PAGE_IN, 0.9 + 1.4 * len(names) + lanes_in)
    heights = [lanes_in, *[1.35] * len(names)]
    lanes, *grid = figure.subplots(len(heights), 2, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    for name, (true_axes, measured_axes) in zip(names, grid, strict=True):
        style.dress(true_axes, style.label(name))
        style.dress(measured_axes)
        curve_values: list[Array] = []
        for i, run in enumerate(runs):
            formation = run.formation(cluster)
            if formation is None or name not in formation.names:
                continue
            desired, measured, true = curves(formation, name)
            look: dict[str, Any] = {"color": run_style(i).color, "ls": run_style(i).dashes, "lw": 1.3, "zorder": 3}
            style.line(true_axes, formation.t_s, true, label=run.label, **look)
            style.line(measured_axes, formation.t_s, measured, **look)
            for axes in (true_axes, measured_axes):
                style.line(axes, formation.t_s, np.where(formation.engaged, desired, np.nan), **DESIRED)
            since = formation.since_engaged
            curve_values += [true, measured[since], desired[since]]
        if curve_values:
            style.scale(true_axes, *curve_values)
        for index, each in enumerate(marks):  # take-off, engagement and collisions, in the colour of the run
            for kind, t_s in each.points:
                dashes = {"take-off": ":", "engagement": "-."}.get(kind, "-")
                for axes in (true_axes, measured_axes):
                    axes.axvline(t_s, color=run_style(index).color, lw=0.9, ls=dashes, alpha=0.7, zorder=1.5)
    for axes, title in zip(lanes, ("true", "measured (estimates)"), strict=True):
        _draw_lanes(axes, marks, show_names=axes is lanes[0])
        axes.set_title(title, fontsize=style.PAPER_PT)
    style.letter_panels(lanes)
    first = grid[0][0]
    first.plot([], [], label="desired, while engaged", **DESIRED)
    for kind in dict.fromkeys(band.kind for each in marks for band in each.marks.bands):  # in neutral colours
        face = style.DARK if kind == style.FAULT else GREY_FACE
        first.fill_between(
            [], [], facecolor=face, edgecolor=style.DARK, hatch=HATCHES.get(kind, ""), lw=0.8, label=kind
        )
    for kind in dict.fromkeys(kind for each in marks for kind, _ in each.points):
        first.plot([], [], POINTS[kind], color=style.DARK, ms=7, label=kind)
    style.label_time(grid[-1])
    figure.align_ylabels([row[0] for row in grid])
    style.legend_above(figure, first)
    return figure


class RunMarks(NamedTuple):
    """The marks of a run: bands, and kind and time [s] of instantaneous events."""

    name: str
    marks: style.TimeMarks
    points: list[tuple[str, float]]


def _draw_lanes(lanes: Axes, marks: Sequence[RunMarks], show_names: bool) -> None:
    """Draw a lane for each run, the first at the top: bars for bands, markers for instantaneous events."""
    for lane, run in enumerate(marks):
        colour = run_style(lane).color
        lanes.axhline(lane, color=EMPTY, lw=1.0, zorder=1)
        for band in run.marks.bands:
            face, hatch = FAULT_FACE if band.kind == style.FAULT else FACE, HATCHES.get(band.kind, "")
            span, look = (band.from_s, band.to_s - band.from_s), {"edgecolor": colour, "lw": 0.8, "zorder": 2}
            lanes.broken_barh([span], (lane - 0.36, 0.72), facecolor=(colour, face), hatch=hatch, **look)
        for kind, t_s in run.points:
            lanes.plot([t_s], [lane], POINTS[kind], color=colour, ms=8, mec="white", mew=0.8, zorder=4, clip_on=False)
    lanes.set_ylim(len(marks) - 0.5, -0.5)
    labels = [each.name if len(each.name) <= NAME_MAX else f"…{each.name[1 - NAME_MAX :]}" for each in marks]
    lanes.set_yticks(range(len(marks)), labels)
    for lane, text in enumerate(lanes.get_yticklabels()):
        text.set_color(run_style(lane).color)
    lanes.tick_params(axis="y", length=0, labelsize=style.PAPER_PT - 1, labelleft=show_names)
    lanes.tick_params(axis="x", length=0, labelbottom=False)
    lanes.spines[:].set_visible(False)


def _draw_plans(runs: Sequence[ComparedRun]) -> Figure:
    """Draw the true paths from above, a plan per run, all on one scale."""
    across, colours = _across(runs), _drone_colours(runs)
    rows = -(-len(runs) // across)
    figure = style.new_figure(style.PAGE_IN, 0.8 + rows * style.PAGE_IN / across)
    grid = figure.subplots(rows, across, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(runs) :]:
        axes.set_axis_off()
    for run, axes in zip(runs, grid.flat, strict=False):
        style.dress(axes)
        axes.set_title(run.label, fontsize=style.PAPER_PT)
        axes.set_aspect("equal", adjustable="box")
        draw_obstacles(axes, run.flight.scenario)
        for track in run.flight.tracks:
            draw_path(axes, track, colours[track.name], named=False)
    for axes in grid.flat[len(runs) - across : len(runs)]:
        axes.set_xlabel("east x (m)", fontsize=style.PAPER_PT)
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("north y (m)", fontsize=style.PAPER_PT)
    (left, right), (low, high) = grid[0, 0].get_xlim(), grid[0, 0].get_ylim()
    half = 0.52 * max(right - left, high - low)  # half the side of the square range of all plans
    grid[0, 0].set_xlim((left + right) / 2 - half, (left + right) / 2 + half)
    grid[0, 0].set_ylim((low + high) / 2 - half, (low + high) / 2 + half)
    style.letter_panels(grid.flat[: len(runs)])
    _name_drones(figure, grid[0, 0], colours)
    return figure


def _draw_drones(runs: Sequence[ComparedRun]) -> Figure:
    """Draw true altitude, state and battery of every drone, a column per run."""
    heights = drone_panel_heights(max(len(run.flight.tracks) for run in runs))
    across, colours = _across(runs), _drone_colours(runs)
    rows = -(-len(runs) // across)
    figure = style.new_figure(style.PAGE_IN, (1.0 + 0.6 * sum(heights)) * rows)
    grid = figure.subplots(3 * rows, across, squeeze=False, sharex=True, height_ratios=heights * rows)
    for axes in grid.flat:
        axes.set_axis_off()
    for index, run in enumerate(runs):
        row, column = divmod(index, across)
        panels = list(grid[3 * row : 3 * row + 3, column])
        for axes, quantity in zip(panels, DRONE_PANELS, strict=True):
            axes.set_axis_on()
            style.dress(axes, quantity if column == 0 and quantity != "state" else "")
        panels[0].set_title(run.label, fontsize=style.PAPER_PT)
        draw_drone_panels(panels, run.flight.tracks, colours, named_count=0)
        panels[-1].tick_params(labelbottom=True)
        style.draw_marks(panels, style.time_marks(run.flight, run.formations[0] if run.formations else None))
    style.letter_panels([grid[3 * (index // across), index % across] for index in range(len(runs))])
    for kind in (0, 2):  # all runs have the same range of altitude and of charge
        non_empty = [each for each in grid[kind::3].flat if each.lines]
        limits = [each.get_ylim() for each in non_empty]
        for each in non_empty:
            each.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    name_states(figure, [track for run in runs for track in run.flight.tracks])
    _name_drones(figure, grid[0, 0], colours)
    return figure


def _drone_colours(runs: Sequence[ComparedRun]) -> dict[str, str]:
    """Return a colour for each drone name of all runs."""
    return colours_of(list(dict.fromkeys(track.name for run in runs for track in run.flight.tracks)))


def _name_drones(figure: Figure, axes: Axes, colours: Mapping[str, str]) -> None:
    """Add the drones to the legend; of many drones, only the first and the last."""
    items = list(colours.items())
    for name, colour in items if len(items) <= NAMED_MAX else (items[0], items[-1]):
        axes.plot([], [], color=colour, lw=1.1, label=name)
    style.legend_above(figure, axes)
