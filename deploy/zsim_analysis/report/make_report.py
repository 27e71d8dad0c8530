"""Makes the report of a run: record in; summary.json, figures/*.png and report.html out.

A page is self-contained, figures included; it loads nothing from the network. The same functions write the pages of
comparisons and sweeps.
"""

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from zsim.errors import ReportError
from zsim.output_folder import RECORD
from zsim.presentation import colours_of
from zsim_analysis.reading.drone_errors import (
    distances,
    estimate_errors,
    reference_errors,
    separations,
    velocity_responses,
)
from zsim_analysis.reading.formation import Formation, goal_errors
from zsim_analysis.reading.recorded_flight import RadioSummary, RecordedFlight
from zsim_analysis.reading.shortfall import percent_text, seconds_text, span_text
from zsim_analysis.report import FORMATS, indented_json
from zsim_analysis.report.figure_style import DARK, TAKE_OVER, VERMILION, ReportFigure, mark_figure, time_marks
from zsim_analysis.report.flight_figures import (
    PAIRS_MAX,
    ROWS_MAX,
    draw_distances,
    draw_drones,
    draw_errors,
    draw_estimates,
    draw_parameters,
    draw_plan,
    draw_radio,
    draw_references,
    draw_velocities,
    numbered,
    parameter_groups,
)
from zsim_analysis.report.summary import (
    PAPER_COLUMN,
    PAPER_NOTE,
    RunSummary,
    error_table,
    flies_paper_test,
    judge,
    tracking_table,
)

FAULTS_MAX = 6  # largest number of faults listed at the top of a page
REFERENCE = (
    "Estimate − desired is what the controller sees; truth − desired is what the drones do. Until the formation is "
    "engaged, the controller takes its own estimate as the desired value."
)
GOAL = "(a) Against the target of the plan; the climb from the ground is in z_c. "
SPREAD = "For variables without a row: median, 5 to 95 % and extremes of truth − desired. "

Picture = tuple[ReportFigure, bytes]  # a figure and its PNG file


def make_report(
    directory: Path, progress: Callable[[str], None] = lambda _: None, formats: Sequence[str] = ()
) -> RunSummary:
    """Read DIR/run.mcap and write DIR/summary.json, DIR/figures/*.png and DIR/report.html, as `write_report` does.

    Raises:
        RecordError: there is no record, or it contains no truth of any drone.
        ReportError: the directory cannot be written.
    """
    flight, formations, summary = judge(directory / RECORD, progress, answers=True)
    drawings = figures(flight, formations, summary)
    write_report(directory, summary, drawings, partial(page, summary), progress, formats)
    return summary


# Figures, in the order of the page


def figures(flight: RecordedFlight, formations: Sequence[Formation], summary: RunSummary) -> Iterator[ReportFigure]:
    """Yield the figures for which the record has data, with a mark if the flight has shortfalls."""
    return (draw_marked(each, summary) for each in planned_figures(flight, formations, summary.window_s))


class PlannedFigure(NamedTuple):
    """A figure that has not been drawn yet; see `ReportFigure`."""

    name: str
    title: str
    caption: str
    draw: Callable[[], Figure]


def draw_marked(planned: PlannedFigure, summary: RunSummary) -> ReportFigure:
    """Draw a figure, with a mark if the flight has shortfalls."""
    drawing = planned.draw()
    if summary.shortfalls:
        texts = [each.text for each in summary.shortfalls if each.fails or summary.as_planned]
        further = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        heading, colour = ("Note", DARK) if summary.as_planned else ("Not as planned", VERMILION)
        mark_figure(drawing, f"{heading}{further}", texts[0], colour)
    return ReportFigure(planned.name, planned.title, planned.caption, drawing)


def planned_figures(
    flight: RecordedFlight, formations: Sequence[Formation], window_s: tuple[float, float]
) -> Iterator[PlannedFigure]:
    """Yield the figures for which the record has data."""
    for i, formation in enumerate(formations):  # figures of the first cluster have no suffix
        yield from _cluster_figures(flight, formation, window_s, f"_{formation.name}" if i else "")
    marks = time_marks(flight, formations[0] if formations else None)
    colours = colours_of([track.name for track in flight.tracks])
    has_truth = any(len(track.t_ns) for track in flight.tracks)
    if has_truth:
        yield PlannedFigure(
            "plan_view.png",
            "Plan view",
            "True paths from above; squares: start, dots: end; black: desired centroid; grey: "
            "the formation at several simulated times.",
            partial(draw_plan, flight, formations),
        )
    if separation := distances(flight, PAIRS_MAX):
        pairing = (
            "the drones of each pair"
            if separation.pairs
            else "each drone and the one nearest to it: median, 5 to 95 %, extremes"
        )
        yield PlannedFigure(
            "distances.png",
            "Distances between drones",
            f"True distance between {pairing}; lines: the controllers' guard and alarm, and contact of two hulls.",
            partial(draw_distances, separation, separations(flight), colours, marks),
        )
    if tracking_errors := reference_errors(flight):
        yield PlannedFigure(
            "references.png",
            "Errors against the drones' references",
            "Truth − reference of each drone that flies on its own, while in the air: thick on its path, thin while "
            "approaching it or holding a position. For many drones: median, 5 to 95 % and extremes.",
            partial(draw_references, tracking_errors, colours, marks),
        )
    if flight.radio:
        yield PlannedFigure(
            "radio.png",
            "Radio",
            "(a) Share of a drone's messages that arrive at another drone, over the whole run, given range and loss. "
            "(b) Expected number of drones heard. Grey: some drone cannot reach all others, not even via relays, over "
            "links that carry at least half of the messages.",
            partial(draw_radio, flight.radio, [track.name for track in flight.tracks], marks),
        )
    if has_truth:
        yield PlannedFigure(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone.",
            partial(draw_drones, flight, marks),
        )
    if errors := estimate_errors(flight):
        yield PlannedFigure(
            "estimates.png",
            "Estimates",
            "Estimate − truth with the band of two standard deviations that the estimator states, and the NEES, the "
            "squared error of position and velocity normalised by its covariance, which is 6 on average for a "
            "consistent estimator. Shares and means above the panels are those of the window; the axes cover all "
            "errors since the engagement, so larger ones before it may be cut off. For many drones: the spread of the "
            "position errors, the mean NEES, and statistics of each drone.",
            partial(draw_estimates, errors, colours, window_s, marks),
        )
    if responses := velocity_responses(flight):
        yield PlannedFigure(
            "velocities.png",
            "Commanded and flown velocity",
            "In the drone's heading frame. Flown: true velocity; commanded: as sent by whoever flew the drone, without "
            "the delay of the link. For many drones: median, 5 to 95 % and extremes of the difference.",
            partial(draw_velocities, responses, colours, marks),
        )


def _cluster_figures(
    flight: RecordedFlight, formation: Formation, window_s: tuple[float, float], suffix: str
) -> Iterator[PlannedFigure]:
    marks, goal = time_marks(flight, formation), goal_errors(formation, flight.scenario)
    paper = flies_paper_test(flight, formation.name) and not marks.has(TAKE_OVER)
    reference, window = ("(b)", "(c)") if goal else ("(a)", "(b)")
    large = SPREAD if len(formation.names) > ROWS_MAX else ""
    yield PlannedFigure(
        f"figure_5_errors{suffix}.png",
        f"Formation parameters' errors{numbered(5, paper)}",
        f"{GOAL if goal else ''}{reference} Against the reference, over the whole run. {window} The window of the "
        f"statistics, on an axis of its own. {large}{REFERENCE}",
        partial(draw_errors, formation, window_s, marks, goal),
    )
    for file, number, group_name, names in parameter_groups(formation.names):
        shown = (
            ", ".join(names)
            if len(names) <= ROWS_MAX
            else f"values of those of the {len(names)} variables that move most"
        )
        yield PlannedFigure(
            f"{file}{suffix}.png",
            f"{group_name}{numbered(number, paper)}",
            f"Desired, measured (from the estimates) and true {shown}.",
            partial(draw_parameters, formation, names, marks),
        )


# Page


def page(summary: RunSummary, pictures: Sequence[Picture]) -> str:
    events = [(f"{each.t_s:.2f}", each.kind, each.source, each.subject, each.text) for each in summary.events]
    participants = [
        (p["name"], p["host"], p["pid"], summary.versions.get(p["name"], ""), p["incarnations"], p["left"])
        for p in summary.participants
    ]
    return rendered(
        "page.html.j2",
        pictures,
        summary=summary,
        facts=facts(summary),
        window=span_text(summary.window_s),
        paper_column=PAPER_COLUMN,
        tables={name: error_table(cluster) for name, cluster in summary.clusters.items()},
        tracking=tracking_table(summary) if summary.tracking else None,
        paper_note=PAPER_NOTE if any(cluster.paper_std for cluster in summary.clusters.values()) else "",
        events=events,
        participants=participants,
    )


def facts(summary: RunSummary) -> list[tuple[str, str]]:
    """Return label and value of each line at the top of the page."""
    age = summary.command_age_ms
    ages = f"p50 {age['p50']:.2f} ms, p99 {age['p99']:.2f} ms, max {age['max']:.2f} ms" if age else "not known"
    factor = "not known" if summary.real_time_factor is None else f"{summary.real_time_factor:.1f}"
    seed = "–" if summary.seed is None else summary.seed
    separation, radio, nearest = summary.min_separation_m, summary.radio, summary.obstacle_distance_m
    versions = dict.fromkeys(version for name, version in summary.versions.items() if name != "report")
    kinds, misses = {each.kind for each in summary.shortfalls}, "not known"
    exceptions = {
        "as far as the run went": "early" in kinds,
        "except for what others requested or flew": bool(kinds & {"override", "request"}),
        "except for a short hold": "held" in kinds,
    }
    planned = ", ".join(part for part, holds in exceptions.items() if holds) or "yes"
    injected = [event for event in summary.events if event.kind == "fault"]
    faults = [f"{event.text.removesuffix(' begins')} at {seconds_text(event.t_s)} s" for event in injected[:FAULTS_MAX]]
    faults += [f"{len(injected) - FAULTS_MAX} more"] if len(injected) > FAULTS_MAX else []
    if summary.deadline_misses is not None:
        by_process = ", ".join(f"{name} {count}" for name, count in summary.deadline_misses_by.items() if count)
        misses = f"{summary.deadline_misses} of {summary.deadlines or 0}{f' ({by_process})' if by_process else ''}"
    return [
        ("Scenario", f"{summary.scenario or 'not known'}, seed {seed}"),
        ("Changed", changed_text(summary.changed)),
        ("Date", date_text(summary.date)),
        ("Version", ", ".join(versions) or "not known"),
        ("Mode", summary.mode or "not known"),
        ("Ended", summary.ended),
        ("Flown as planned", planned if summary.as_planned else "no"),
        *([("Injected faults", ", ".join(faults))] if faults else []),
        ("Record", summary.record.state),
        ("Simulated", f"{summary.sim_s:.2f} s in {summary.wall_s:.2f} s of wall time, real-time factor {factor}"),
        ("Deadlines missed", misses),
        ("Command age", ages),
        *((f"Link of {drone}", str(link)) for drone, link in summary.links.items()),
        ("Least separation", "no two drones in the air" if separation is None else f"{separation:.2f} m (true)"),
        *([("Distance to obstacles", obstacle_text(nearest))] if nearest else []),
        *([("Radio", radio_text(radio))] if radio else []),
        ("Truth", f"SHA-256 {summary.truth_sha256}"),
        ("Fingerprint", summary.fingerprint or "not known"),
    ]


def changed_text(changed: Sequence[str] | None) -> str:
    """Describe how a scenario differs from its file."""
    return "not known" if changed is None else ", ".join(changed) or "nothing"


def obstacle_text(distances_m: Mapping[str, float]) -> str:
    """Describe the minimum distance of any drone from obstacles."""
    nearest = min(distances_m, key=lambda drone: distances_m[drone])
    return f"at least {distances_m[nearest]:.2f} m, from the true centre of {nearest} to a surface"


def radio_text(radio: RadioSummary) -> str:
    connected = f"all are connected {percent_text(radio.connected_share)} % of the time"
    return f"within the window, a drone hears {radio.heard_mean:.2f} others on average, and {connected}"


def date_text(date: str | None) -> str:
    """Format an ISO 8601 date to the minute."""
    return f"{date[:16].replace('T', ' ')} UTC" if date else "not known"


def rendered(name: str, pictures: Iterable[Picture], package: str = "zsim_analysis.report", **values: Any) -> str:
    """Return the page that a template of `package` makes of figures and `values`; it may use the report's templates."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package, "."), PackageLoader("zsim_analysis.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    sources = [(figure, "data:image/png;base64," + base64.b64encode(png).decode()) for figure, png in pictures]
    return environment.get_template(name).render(figures=sources, **values)


# Files


def write_report(
    directory: Path,
    summary: object,
    figures: Iterable[ReportFigure],
    page: Callable[[Sequence[Picture]], str],
    progress: Callable[[str], None],
    formats: Sequence[str] = (),
) -> None:
    """Write DIR/summary.json, DIR/figures/*.png and DIR/report.html, all or none of them.

    Outdated files of these figures in other formats, left by an earlier report, are removed.

    Args:
        directory: directory of the run or the sweep.
        summary: content of summary.json.
        figures: figures, which are drawn one by one.
        page: returns the page with the given pictures.
        progress: called with a text at each step.
        formats: further formats of the figures besides PNG, from `zsim_analysis.report.FORMATS`.

    Raises:
        ReportError: the directory cannot be written.
    """
    with _put_in_place(directory, directory, directory / "figures") as new:
        pictures = _render(figures, new / "figures", progress, formats)
        for figure, png in pictures:
            (new / "figures" / figure.name).write_bytes(png)
        (new / "summary.json").write_bytes(indented_json(summary))
        (new / "report.html").write_text(page(pictures), encoding="utf-8")
    _remove_others(pictures, directory / "figures", formats)


def write_page(
    out: Path,
    figures: Iterable[ReportFigure],
    page: Callable[[Sequence[Picture]], str],
    progress: Callable[[str], None],
    formats: Sequence[str] = (),
) -> None:
    """Write one page, which replaces an earlier one once it is complete; arguments and errors as in `write_report`.

    Figures in other formats are written into a folder beside the page, NAME-figures.
    """
    folder = f"{out.stem}-figures"
    with _put_in_place(out.parent, out, out.parent / folder) as new:
        pictures = _render(figures, new / folder, progress, formats)
        (new / out.name).write_text(page(pictures), encoding="utf-8")
    _remove_others(pictures, out.parent / folder, formats)


def _render(
    figures: Iterable[ReportFigure], folder: Path, progress: Callable[[str], None], formats: Sequence[str]
) -> list[Picture]:
    """Render figures one by one and write their files in other formats into a new folder."""
    folder.mkdir()
    pictures = []
    for figure in figures:
        progress(f"drawing {figure.name}")
        pictures.append((figure, figure.png()))
        for form in formats:
            (folder / figure.name).with_suffix(f".{form}").write_bytes(figure.vector(form))
    progress("writing the page")
    return pictures


def _remove_others(pictures: Iterable[Picture], folder: Path, formats: Sequence[str]) -> None:
    """Remove the figures' files in those of FORMATS that are not given."""
    for figure, _ in pictures:
        for form in set(FORMATS) - set(formats):
            if (earlier := (folder / figure.name).with_suffix(f".{form}")).is_file():
                earlier.unlink()


@contextmanager
def _put_in_place(directory: Path, report: Path, figures: Path) -> Iterator[Path]:
    """Yield a folder; move its files into a directory once all are complete, or none on a full disk or Ctrl-C.

    Raises:
        ReportError: the directory cannot be written (the error names `report`), or `figures` in it is a symbolic link,
            through which files elsewhere would be written and removed.
    """
    if figures.is_symlink():
        raise ReportError(f"{figures}: is a symbolic link to {figures.readlink()}; must be a folder; remove the link")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=directory, prefix=".report-") as folder:
            yield Path(folder)
            for path in sorted(path for path in Path(folder).rglob("*") if path.is_file()):
                target = directory / path.relative_to(folder)
                target.parent.mkdir(exist_ok=True)
                path.replace(target)
    except OSError as error:
        raise ReportError(f"{report}: the report cannot be written ({error.strerror})") from error
