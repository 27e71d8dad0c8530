"""The figures of a report: the paper's Figures 5 to 8 per cluster, a plan view and the drones' own panel."""

from collections.abc import Iterator, Sequence

from matplotlib.figure import Figure
from msgspec import Struct

from zsim_analysis.reading.flight import Flight
from zsim_analysis.reading.formation_variables import Formation
from zsim_analysis.report.figures.cluster_figures import draw_errors, draw_parameters
from zsim_analysis.report.figures.flight_figures import draw_drones, draw_plan

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")


class Named(Struct, frozen=True):
    """A figure with its file name and its words on the page."""

    name: str
    title: str
    caption: str
    drawing: Figure


def figures(flight: Flight, formations: Sequence[Formation], window_s: tuple[float, float]) -> Iterator[Named]:
    """Yield the figures that the record has data for, the first cluster's under the plain names."""
    for i, formation in enumerate(formations):
        yield from _of_cluster(formation, window_s, f"_{formation.name}" if i else "")
    if any(len(track.t_ns) for track in flight.tracks):
        yield Named(
            "plan_view.png",
            "Plan view",
            "True paths from above, with the formation drawn at some instants of simulated time.",
            draw_plan(flight, formations),
        )
        yield Named(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone.",
            draw_drones(flight),
        )


def _of_cluster(formation: Formation, window_s: tuple[float, float], suffix: str) -> Iterator[Named]:
    yield Named(
        f"figure_5_errors{suffix}.png",
        "Formation parameters' errors (the paper's Figure 5)",
        "Left: the whole run. Right: the window of the statistics, on an axis of its own. "
        "Estimate − desired is what the controller sees; truth − desired is what the drones do. "
        "Until the formation is engaged, the controller takes its own estimate as the desired value.",
        draw_errors(formation, window_s),
    )
    shape = tuple(name for name in formation.names if name not in POSITION + ORIENTATION and "phi" not in name)
    for file, number, what, names in (
        ("figure_6_position", 6, "Position of the formation", POSITION),
        ("figure_7_orientation", 7, "Orientation of the formation", ORIENTATION),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ):
        present = [name for name in names if name in formation.names]
        yield Named(
            f"{file}{suffix}.png",
            f"{what} (the paper's Figure {number})",
            f"Desired, measured (from the estimates) and true {', '.join(present)}.",
            draw_parameters(formation, present, what),
        )
