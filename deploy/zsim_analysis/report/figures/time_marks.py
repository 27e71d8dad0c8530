"""What happened when, on every time axis: take-off and engagement as lines; phases, faults and take-overs as bands."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from msgspec import Struct

from zsim.contract.run_messages import Event
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.pages import DARK, GREEN, ORANGE, PURPLE, SKY, VERMILION

FAULT, TAKE_OVER = "fault", "taken over"
COLOURS = {
    "assembly": SKY,
    "held": ORANGE,
    "landing": GREEN,
    FAULT: VERMILION,
    TAKE_OVER: PURPLE,
}
ALPHA = 0.16
ASSEMBLY = {"taking_off": "assembly", "assembling": "assembly"}
CONTROLLER = "controller."  # how the names of those begin that fly by the plan


class Band(Struct, frozen=True):
    """Something that lasted, from and to simulated time."""

    kind: str
    from_s: float
    to_s: float


class TimeMarks(Struct, frozen=True):
    """What is marked on the time axes of a flight; times [s], None where it never happened.

    Attributes:
        takeoff_s, engaged_s: of the first drone, and of the formation.
        bands: what lasted.
        span_s: the run, which every time axis shows all of; None: what is drawn.
    """

    takeoff_s: float | None = None
    engaged_s: float | None = None
    bands: tuple[Band, ...] = ()
    span_s: tuple[float, float] | None = None


def time_marks(flight: RecordedFlight, formation: Formation | None = None) -> TimeMarks:
    """Return the marks of a flight, phases and engagement being those of a formation."""
    bands = [*fault_bands(flight), *take_over_bands(flight), *(phase_bands(formation) if formation else ())]
    start_s = flight.first_ns / 1e9 if flight.replay_of else 0.0  # a replay may begin anywhere
    span_s = (start_s, flight.last_ns / 1e9)
    return TimeMarks(_takeoff_s(flight), formation.engaged_s if formation else None, tuple(bands), span_s)


def _takeoff_s(flight: RecordedFlight) -> float | None:
    """Return when the first drone left the ground."""
    starts = (
        track.status_t_ns[k] / 1e9
        for track in flight.tracks
        for k in [next((k for k, state in enumerate(track.states) if state == "taking_off"), -1)]
        if k >= 0
    )
    return min(starts, default=None)


def phase_bands(formation: Formation) -> Iterator[Band]:
    """Yield the phases of a formation but for idle and engaged."""
    phases = np.array(formation.phases)
    if not len(phases):
        return
    starts = np.flatnonzero(np.r_[True, phases[1:] != phases[:-1]])
    ends = np.r_[formation.t_s[starts[1:]], formation.t_s[-1]]
    for start, end_s in zip(starts, ends, strict=True):
        kind = ASSEMBLY.get(str(phases[start]), str(phases[start]))
        if kind in COLOURS:
            yield Band(kind, float(formation.t_s[start]), float(end_s))


def fault_bands(flight: RecordedFlight) -> Iterator[Band]:
    """Yield the injected faults, to the end of the flight where nothing ends them."""
    ends = {event.data.get("id"): event for event in flight.events if event.kind in ("fault_end", "fault_clear")}
    for event in flight.events:
        if event.kind == "fault":
            end = ends.get(event.data.get("id"))
            yield Band(FAULT, event.t_ns / 1e9, (end.t_ns if end else flight.last_ns) / 1e9)


def take_over_bands(flight: RecordedFlight) -> Iterator[Band]:
    """Yield how long others than a controller flew a drone."""
    for place, event in enumerate(flight.events):
        if event.kind == "commander" and not event.source.startswith(CONTROLLER):
            end_ns = next(_ends(event, flight.events[place + 1 :]), flight.last_ns)
            yield Band(TAKE_OVER, event.t_ns / 1e9, end_ns / 1e9)


def _ends(begun: Event, later: Sequence[Event]) -> Iterator[int]:
    """Yield the times [ns] of what ends that a program flies a drone."""
    for event in later:
        if event.subject == begun.subject and event.kind in ("commander", "release"):
            yield event.t_ns


def draw_marks(axes: Sequence[Axes], marks: TimeMarks, whole: bool = True) -> None:
    """Draw marks into axes that hold their lines already; the first ones name them.

    Args:
        axes: of one time axis.
        marks: of the flight.
        whole: the axes show the whole run; else what is drawn, which the marks do not widen.
    """
    for number, each in enumerate(axes):
        if whole and marks.span_s:
            each.update_datalim([(t_s, 0.0) for t_s in marks.span_s], updatey=False)
            each.autoscale_view(scaley=False)
        _draw(each, marks, named=number == 0)


def _draw(axes: Axes, marks: TimeMarks, named: bool) -> None:
    low, high = axes.dataLim.intervalx
    seen: set[str] = set()
    for band in marks.bands:
        start, end = max(band.from_s, low), min(band.to_s, high)
        if start < end:
            name = band.kind if named and band.kind not in seen else None
            axes.axvspan(start, end, color=COLOURS[band.kind], alpha=ALPHA, lw=0, zorder=0.5, label=name)
            seen.add(band.kind)
    for name, t_s, dashes in (("take-off", marks.takeoff_s, ":"), ("engagement", marks.engaged_s, "-.")):
        if t_s is not None and low <= t_s <= high:
            axes.axvline(t_s, color=DARK, lw=1.0, ls=dashes, zorder=1.5, label=name if named else None)
