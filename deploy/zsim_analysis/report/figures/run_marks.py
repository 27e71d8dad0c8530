"""What happened when in runs that are drawn over each other: a lane for each above the curves, in its colour."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from msgspec import Struct

from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.comparison import ComparedRun
from zsim_analysis.report.figures.run_style import RunStyle, run_style
from zsim_analysis.report.figures.time_marks import FAULT, TAKE_OVER, TimeMarks, time_marks
from zsim_analysis.report.pages import DARK, PAPER_PT

LANE_IN = 0.24  # height of a lane
HATCHES = {"assembly": "////", "held": "xxxx", "landing": "....", FAULT: "", TAKE_OVER: "\\\\\\\\"}
POINTS = {"take-off": "^", "engagement": "D", "collision": "X"}
FACE, FAULT_FACE = 0.35, 0.65
EMPTY, GREY_FACE = "#e6eaee", "#b6bfc9"  # of a lane in which nothing is, and of a bar in the legend
NAME_MAX = 20  # characters of a run's name beside its lane


class RunMarks(Struct, frozen=True):
    """The marks of a run; its collisions by their times [s]."""

    name: str
    marks: TimeMarks
    collisions_s: tuple[float, ...] = ()

    def points(self) -> list[tuple[str, float]]:
        """Return kind and time [s] of what happened at one instant."""
        first = [("take-off", self.marks.takeoff_s), ("engagement", self.marks.engaged_s)]
        return [(kind, t_s) for kind, t_s in first if t_s is not None] + [("collision", t) for t in self.collisions_s]


def run_marks(runs: Sequence[ComparedRun], cluster: str) -> list[RunMarks]:
    """Return the marks of all runs, phases and engagement being those of a cluster."""
    return [
        RunMarks(run.label, time_marks(run.flight, run.formation(cluster)), _collisions_s(run.flight)) for run in runs
    ]


def _collisions_s(flight: RecordedFlight) -> tuple[float, ...]:
    return tuple(event.t_ns / 1e9 for event in flight.events if event.kind == "collision")


def draw_lanes(lanes: Axes, marks: Sequence[RunMarks], named: bool) -> None:
    """Draw a lane for each run, the first one uppermost: bars for what lasted, marks for instants.

    Args:
        lanes: axes of their own, on the time axis of the curves below.
        marks: by run.
        named: whether the runs' names stand beside the lanes.
    """
    for place, each in enumerate(marks):
        _draw_lane(lanes, each, run_style(place), place)
    lanes.set_ylim(len(marks) - 0.5, -0.5)
    short = [each.name if len(each.name) <= NAME_MAX else f"…{each.name[1 - NAME_MAX :]}" for each in marks]
    lanes.set_yticks(range(len(marks)), short)
    for place, text in enumerate(lanes.get_yticklabels()):
        text.set_color(run_style(place).color)
    lanes.tick_params(axis="y", length=0, labelsize=PAPER_PT - 1, labelleft=named)
    lanes.tick_params(axis="x", length=0, labelbottom=False)
    lanes.spines[:].set_visible(False)


def _draw_lane(lanes: Axes, run: RunMarks, look: RunStyle, place: int) -> None:
    lanes.axhline(place, color=EMPTY, lw=1.0, zorder=1)
    for band in run.marks.bands:
        lanes.broken_barh(
            [(band.from_s, band.to_s - band.from_s)],
            (place - 0.36, 0.72),
            facecolor=(look.color, FAULT_FACE if band.kind == FAULT else FACE),
            edgecolor=look.color,
            hatch=HATCHES.get(band.kind, ""),
            lw=0.8,
            zorder=2,
        )
    for kind, t_s in run.points():
        lanes.plot([t_s], [place], POINTS[kind], color=look.color, ms=8, mec="white", mew=0.8, zorder=4, clip_on=False)


def draw_instants(axes: Axes, marks: Sequence[RunMarks]) -> None:
    """Draw through axes of curves when each run took off, engaged and collided, in its colour."""
    for place, each in enumerate(marks):
        for kind, t_s in each.points():
            dashes = {"take-off": ":", "engagement": "-."}.get(kind, "-")
            axes.axvline(t_s, color=run_style(place).color, lw=0.9, ls=dashes, alpha=0.7, zorder=1.5)


def name_marks(axes: Axes, marks: Sequence[RunMarks]) -> None:
    """Name in the legend of axes what the lanes hold, without the colour of any run."""
    for kind in dict.fromkeys(band.kind for each in marks for band in each.marks.bands):
        face = DARK if kind == FAULT else GREY_FACE
        axes.fill_between([], [], facecolor=face, edgecolor=DARK, hatch=HATCHES.get(kind, ""), lw=0.8, label=kind)
    for kind in dict.fromkeys(kind for each in marks for kind, _ in each.points()):
        axes.plot([], [], POINTS[kind], color=DARK, ms=7, label=kind)
