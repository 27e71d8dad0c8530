"""What happened when, on every time axis: take-off and engagement as lines; phases, faults and take-overs as bands."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from msgspec import Struct

from zsim.contract.run_messages import Event
from zsim.scenario.faults import PROCESS_KILL
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
ALPHA = 0.22
SHORT, HAIRLINE_PT = 0.005, 0.8  # of bands shorter than this share of their axis a line of this width is seen
WINDOW = "window of the statistics"
WINDOW_GREY = "#e7ebf0"  # between white and the lines of a grid, which are seen on it
ASSEMBLY = {"taking_off": "assembly", "assembling": "assembly"}
CONTROLLER = "controller."  # how the names of those begin that fly by the plan
RETURNS = ("restart", "superseded", "join")  # events of a process that takes part again


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

    def has(self, kind: str) -> bool:
        """Return whether a band of a kind is among them."""
        return any(band.kind == kind for band in self.bands)


def time_marks(flight: RecordedFlight, formation: Formation | None = None) -> TimeMarks:
    """Return the marks of a flight, phases and engagement being those of a formation."""
    bands = united([*fault_bands(flight), *take_over_bands(flight), *(phase_bands(formation) if formation else ())])
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


def united(bands: Iterable[Band]) -> list[Band]:
    """Return bands with those of a kind that overlap or touch as one: what lasted is marked once, not by drone."""
    by_kind: dict[str, list[Band]] = {}
    for band in bands:
        by_kind.setdefault(band.kind, []).append(band)
    one: list[Band] = []
    for kind, own in by_kind.items():
        for band in sorted(own, key=lambda band: band.from_s):
            if one and one[-1].kind == kind and band.from_s <= one[-1].to_s:
                one[-1] = Band(kind, one[-1].from_s, max(one[-1].to_s, band.to_s))
            else:
                one.append(band)
    return one


def fault_bands(flight: RecordedFlight) -> Iterator[Band]:
    """Yield the injected faults, to the end of the flight where nothing ends them."""
    ends = {event.data.get("id"): event.t_ns for event in flight.events if event.kind in ("fault_end", "fault_clear")}
    for place, event in enumerate(flight.events):
        if event.kind == "fault":
            end_ns = ends.get(event.data.get("id"))
            if end_ns is None and event.data.get("kind") == PROCESS_KILL:
                end_ns = _return_ns(event, flight.events[place + 1 :])
            yield Band(FAULT, event.t_ns / 1e9, (flight.last_ns if end_ns is None else end_ns) / 1e9)


def _return_ns(kill: Event, later: Sequence[Event]) -> int | None:
    """Return from which simulated instant on a killed process takes part again, None if it never does."""
    for event in later:
        if event.kind in RETURNS and event.subject == kill.subject:
            done_ns = event.data.get("done_ns", event.t_ns)  # how far its former self had come: there it goes on
            return max(kill.t_ns, min(event.t_ns, done_ns)) if isinstance(done_ns, int) else event.t_ns
    return None


def take_over_bands(flight: RecordedFlight) -> Iterator[Band]:
    """Yield how long others than a controller flew a drone: from acquisition or first command to release."""
    since_ns: dict[str, int] = {}
    for event in flight.events:
        if (change := _commander(event)) is None:
            continue
        drone, commander = change
        if commander and not commander.startswith(CONTROLLER):
            since_ns.setdefault(drone, event.t_ns)
        elif (begun_ns := since_ns.pop(drone, None)) is not None:
            yield Band(TAKE_OVER, begun_ns / 1e9, event.t_ns / 1e9)
    for begun_ns in since_ns.values():
        yield Band(TAKE_OVER, begun_ns / 1e9, flight.last_ns / 1e9)


def _commander(event: Event) -> tuple[str, str] | None:
    """Return the drone whose commander an event changes, and the new one, "" for nobody; None for other events."""
    if event.kind in ("commander", "release"):
        return event.subject, event.source if event.kind == "commander" else ""
    args = event.data.get("args")
    if event.kind != "control" or event.data.get("ok") is not True or not isinstance(args, dict):
        return None
    drone = args.get("drone")
    if not isinstance(drone, str) or event.subject not in ("acquire", "release"):
        return None
    return drone, event.source if event.subject == "acquire" else ""


def draw_marks(axes: Sequence[Axes], marks: TimeMarks, whole: bool = True) -> None:
    """Draw marks into axes that hold their lines already.

    Args:
        axes: of one time axis.
        marks: of the flight.
        whole: the axes show the whole run; else what is drawn, which the marks do not widen.
    """
    for each in axes:
        if whole and marks.span_s:
            each.update_datalim([(t_s, 0.0) for t_s in marks.span_s], updatey=False)
            each.autoscale_view(scaley=False)
        _draw(each, marks)


def shade_window(axes: Axes, window_s: tuple[float, float]) -> None:
    """Shade the window of the statistics on a time axis."""
    axes.axvspan(*window_s, color=WINDOW_GREY, lw=0, zorder=0, label=WINDOW)


def _draw(axes: Axes, marks: TimeMarks) -> None:
    low, high = axes.dataLim.intervalx
    for band in marks.bands:
        start, end = max(band.from_s, low), min(band.to_s, high)
        if start < end:
            axes.axvspan(start, end, color=COLOURS[band.kind], alpha=ALPHA, lw=0, zorder=0.5, label=band.kind)
            if end - start < SHORT * (high - low):
                axes.axvline((start + end) / 2, color=COLOURS[band.kind], lw=HAIRLINE_PT, zorder=0.6)
    for name, t_s, dashes in (("take-off", marks.takeoff_s, ":"), ("engagement", marks.engaged_s, "-.")):
        if t_s is not None and low <= t_s <= high:
            axes.axvline(t_s, color=DARK, lw=1.0, ls=dashes, zorder=1.5, label=name)
