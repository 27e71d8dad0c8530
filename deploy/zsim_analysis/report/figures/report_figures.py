"""The figures of a report: of its formations, of every drone, and from above, in the order of its page."""

from collections.abc import Iterator, Sequence

from zsim.presentation import colours_of
from zsim_analysis.reading.distances import distances, separations
from zsim_analysis.reading.drone_errors import estimate_errors, velocity_responses
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.goal import goal_errors
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.figures.drone_panels import draw_drones
from zsim_analysis.report.figures.estimate_figures import draw_estimates
from zsim_analysis.report.figures.figure_mark import mark_figure
from zsim_analysis.report.figures.formation_figures import (
    ROWS_MAX,
    draw_errors,
    draw_parameters,
    numbered,
    parameter_groups,
)
from zsim_analysis.report.figures.motion_figures import PAIRS_MAX, draw_distances, draw_velocities
from zsim_analysis.report.figures.plan_view import draw_plan
from zsim_analysis.report.figures.time_marks import TAKE_OVER, TimeMarks, time_marks
from zsim_analysis.report.pages import DARK, VERMILION, ReportFigure
from zsim_analysis.report.paper import flies_paper_test
from zsim_analysis.report.summary import RunSummary

REFERENCE = (
    "Estimate − desired is what the controller sees; truth − desired is what the drones do. Until the formation is "
    "engaged, the controller takes its own estimate as the desired value."
)
GOAL = "(a) Against the target of the plan; the climb from the ground is in z_c. "
SPREAD = "Of the variables that have no row: median, 5 to 95 % and extremes of truth − desired. "


def figures(flight: RecordedFlight, formations: Sequence[Formation], summary: RunSummary) -> Iterator[ReportFigure]:
    """Yield the figures that the record has data for, the first cluster's under the plain names, marked if need be."""
    for figure in _plain(flight, formations, summary.window_s):
        if summary.shortfalls:
            mark_figure(figure.drawing, *shortfall_mark(summary))
        yield figure


def shortfall_mark(summary: RunSummary) -> tuple[str, str, str]:
    """Return what every figure of a flight with shortfalls says of it: head, what matters most of them, and colour."""
    found = [each.text for each in summary.shortfalls if each.fails or summary.as_planned]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    head, colour = ("Note", DARK) if summary.as_planned else ("Not as planned", VERMILION)
    return f"{head}{more}", found[0], colour


def _plain(
    flight: RecordedFlight, formations: Sequence[Formation], window_s: tuple[float, float]
) -> Iterator[ReportFigure]:
    for i, formation in enumerate(formations):
        yield from _of_cluster(flight, formation, window_s, f"_{formation.name}" if i else "")
    marks = time_marks(flight, formations[0] if formations else None)
    if any(len(track.t_ns) for track in flight.tracks):
        yield ReportFigure(
            "plan_view.png",
            "Plan view",
            "True paths from above, squares where they begin and dots where they end; black: desired centroid; grey: "
            "the formation at some instants of simulated time.",
            draw_plan(flight, formations),
        )
    yield from _distances(flight, marks)
    if any(len(track.t_ns) for track in flight.tracks):
        yield ReportFigure(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone.",
            draw_drones(flight, marks),
        )
    yield from _answers(flight, window_s, marks)


def _distances(flight: RecordedFlight, marks: TimeMarks) -> Iterator[ReportFigure]:
    apart = distances(flight, PAIRS_MAX)
    if apart is not None:
        what = "every two drones" if apart.pairs else "each drone to the nearest other one: median, 5 to 95 %, extremes"
        yield ReportFigure(
            "distances.png",
            "Distances between drones",
            f"True distance of {what}; below the first line the controller's guard parts them.",
            draw_distances(apart, separations(flight), colours_of([track.name for track in flight.tracks]), marks),
        )


def _answers(flight: RecordedFlight, window_s: tuple[float, float], marks: TimeMarks) -> Iterator[ReportFigure]:
    """Yield the figures of what each drone's estimator and commander published."""
    colours = colours_of([track.name for track in flight.tracks])
    if errors := estimate_errors(flight):
        yield ReportFigure(
            "estimates.png",
            "Estimates",
            "Estimate − truth with the band of two standard deviations that the estimator states, and NEES, the error "
            "of position and velocity squared and divided by its covariance: 6 on average where that is true. Shares "
            "and means, above the panels, are those of the window; the axes hold all since the engagement, and what is "
            "larger before it leaves them.",
            draw_estimates(errors, colours, window_s, marks),
        )
    if responses := velocity_responses(flight):
        yield ReportFigure(
            "velocities.png",
            "Commanded and flown velocity",
            "By the drone's heading. Flown: in truth; commanded: as sent by whoever flew the drone, without the delay "
            "of the link. Of many drones: median, 5 to 95 % and extremes of the difference.",
            draw_velocities(responses, colours, marks),
        )


def _of_cluster(
    flight: RecordedFlight, formation: Formation, window_s: tuple[float, float], suffix: str
) -> Iterator[ReportFigure]:
    marks, goal = time_marks(flight, formation), goal_errors(formation, flight.scenario)
    paper = flies_paper_test(flight, formation.name) and not marks.has(TAKE_OVER)
    reference, window = ("(b)", "(c)") if goal else ("(a)", "(b)")
    large = SPREAD if len(formation.names) > ROWS_MAX else ""
    yield ReportFigure(
        f"figure_5_errors{suffix}.png",
        f"Formation parameters' errors{numbered(5, paper)}",
        f"{GOAL if goal else ''}{reference} Against the reference, the whole run. {window} The window of the "
        f"statistics, on an axis of its own. {large}{REFERENCE}",
        draw_errors(formation, window_s, marks, goal),
    )
    for file, number, what, names in parameter_groups(formation.names):
        shown = ", ".join(names) if len(names) <= ROWS_MAX else f"of the {len(names)} variables those that move most"
        yield ReportFigure(
            f"{file}{suffix}.png",
            f"{what}{numbered(number, paper)}",
            f"Desired, measured (from the estimates) and true {shown}.",
            draw_parameters(formation, names, marks),
        )
