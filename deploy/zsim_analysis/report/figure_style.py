"""Common style of all figures: colours, axes, lines, legends, spreads of many lines, and time marks."""

import io
from collections.abc import Iterable, Iterator
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from msgspec import Struct

from zsim.contract.run_messages import ADMISSIONS
from zsim.scenario.faults import PROCESS_KILL
from zsim.scenario.roles import PILOT
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight

COLUMN_IN, PAGE_IN = 3.5, 7.16  # widths of a column and of a page of IEEE's conference papers
DPI = 200  # resolution of PNG files
PAPER_PT = 8.0  # text size [pt], that of a paper's captions
LETTER_EMS, ENTRY_EMS = 0.6, 3.4  # width of a letter, and of a legend entry without its name [em]
LETTER_PAD_PT = 3.0  # distance between a panel's letter and its axes
MARK_EMS, LINE_EMS = 0.75, 1.25  # width of a bold letter, and height of a line [em]
MARK_LINES, MARK_PAD_IN = 4, 0.05  # maximum number of lines of a warning's reason, and margin above a warning
FONTS: Any = {"pdf.fonttype": 42, "svg.hashsalt": "zsim"}  # TrueType: IEEE does not accept Type 3
POINTS = 2000  # maximum number of points per line: more than a page has pixels across
# Okabe and Ito's colours, distinguishable with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
GREY, DARK, GRID = "#8c959f", "#444c56", "#c9d1d9"
AMBER = "#9a6a00"  # an orange that is legible as small print on white
DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": (0, (5, 3)), "zorder": 4}
MEASURED: dict[str, Any] = {"color": ORANGE, "lw": 1.1, "zorder": 2}  # wide enough to be visible behind the truth
TRUE: dict[str, Any] = {"color": BLUE, "lw": 0.6, "zorder": 3}
SPREAD = (5.0, 50.0, 95.0)  # percentiles drawn
SPREAD_INSTANTS = 1000  # number of times at which percentiles are computed
SYMBOLS = {"x_c": "$x_c$", "y_c": "$y_c$", "z_c": "$z_c$", "p": "$p$", "q": "$q$", "beta": "$\\beta$"}
GREEK = {"phi": "\\phi", "rho": "\\rho"}


class ReportFigure(Struct, frozen=True):
    """A figure with its file name, and its title and caption on the page."""

    name: str
    title: str
    caption: str
    drawing: Figure

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the PNG file, for a browser's layout before the image is loaded."""
        width, height = self.drawing.get_size_inches() * self.drawing.dpi
        return round(width), round(height)

    @property
    def is_column(self) -> bool:
        """Whether the figure is at most a column wide, so that two fit side by side on a page."""
        return self.drawing.get_size_inches()[0] <= COLUMN_IN

    def png(self) -> bytes:
        """Return the figure as a PNG file; this fixes the layout for its files in other formats."""
        file = io.BytesIO()
        self.drawing.savefig(file, format="png")
        self.drawing.set_layout_engine("none")
        return file.getvalue()

    def vector(self, form: str) -> bytes:
        """Return the figure as a file in one of `zsim_analysis.report.FORMATS`, the same bytes each time."""
        file = io.BytesIO()
        stamp = "CreationDate" if form == "pdf" else "Date"
        with rc_context(FONTS):
            self.drawing.savefig(file, format=form, metadata={stamp: None})
        return file.getvalue()


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure with automatic layout; matplotlib's global state is not used."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def dress(axes: Axes, label: str = "") -> None:
    """Set the grid, spines and text size of axes, and their y label."""
    axes.grid(True, color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(which="both", labelsize=PAPER_PT - 1)
    axes.margins(x=0.01)
    if label:
        axes.set_ylabel(label, fontsize=PAPER_PT)


def label_time(axes: Iterable[Axes]) -> None:
    for each in axes:
        each.set_xlabel("simulated time (s)", fontsize=PAPER_PT)


def label(name: str) -> str:
    """Return the label of a parameter with its unit."""
    stem, _, number = name.partition("_")
    greek = f"${GREEK[stem]}_{{{number}}}$" if stem in GREEK else name
    return f"{SYMBOLS.get(name, greek)} ({unit(name)})"


def scale(axes: Axes, *values: Array, pad: float = 0.06) -> None:
    """Set the range of a y axis to that of `values`, padded, unless it is empty or a single value."""
    if limits := padded_range(np.concatenate(values), pad):
        axes.set_ylim(limits)


def padded_range(samples: Array, share: float) -> tuple[float, float] | None:
    """Return the range of the finite samples, padded at each end by `share` of it; None if empty or a single value."""
    finite = samples[np.isfinite(samples)]
    if not len(finite) or finite.max() <= finite.min():
        return None
    padding = share * (finite.max() - finite.min())
    return float(finite.min() - padding), float(finite.max() + padding)


def line(axes: Axes, x: Array, y: Array, **style: Any) -> None:
    """Draw a line with at most POINTS points."""
    axes.plot(*thinned(x, y), **style)


def thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Reduce a line to at most POINTS points, the minimum and maximum of each bin, so that all extremes remain."""
    if len(x) <= POINTS:
        return x, y
    size = -(-len(x) // (POINTS // 2))
    starts = np.arange(0, len(x), size)
    bins = np.full((len(starts), size), np.nan)
    bins.flat[: len(x)] = y
    unknown = np.isnan(bins)  # picked only in bins without a known value
    minima, maxima = (np.where(unknown, fill, bins) for fill in (np.inf, -np.inf))
    indices = np.unique((starts + minima.argmin(axis=1), starts + maxima.argmax(axis=1)))
    return x[indices], y[indices]


def draw_spread(axes: Axes, t_s: Array, values: Array, colour: str) -> None:
    """Draw many lines as their median, the band from 5 to 95 %, and all their extremes.

    t_s (K,) is simulated time, values (K, N) are NaN where unknown.
    """
    is_known = np.isfinite(values).any(axis=1)
    t_s, values = t_s[is_known], values[is_known]
    if not len(t_s):
        return
    step = -(-len(t_s) // SPREAD_INSTANTS)
    sampled_s, starts = t_s[::step], np.arange(0, len(values), step)
    low, middle, high = np.nanpercentile(values[::step], SPREAD, axis=1)
    minima = np.minimum.reduceat(np.nanmin(values, axis=1), starts)
    maxima = np.maximum.reduceat(np.nanmax(values, axis=1), starts)
    axes.fill_between(sampled_s, low, high, color=colour, alpha=0.25, lw=0, zorder=2, label="5 to 95 %")
    axes.plot(sampled_s, middle, color=colour, lw=1.0, zorder=3, label="median")
    axes.plot(sampled_s, minima, color=colour, lw=0.4, alpha=0.7, zorder=2, label="minimum and maximum")
    axes.plot(sampled_s, maxima, color=colour, lw=0.4, alpha=0.7, zorder=2)


def letter_panels(panels: Iterable[Axes]) -> None:
    """Letter panels (a), (b) and so on, in reading order; a single panel gets no letter."""
    panels = list(panels)
    for number, axes in enumerate(panels if len(panels) > 1 else ()):
        letters = chr(ord("a") + number % 26) * (1 + number // 26)
        alignment = "center" if axes.get_title() else "left"
        title = axes.get_title(loc=alignment)
        look: Any = {"fontsize": PAPER_PT, "pad": LETTER_PAD_PT}
        if title:
            axes.set_title(f"({letters}) {title}", loc=alignment, **look)
        else:
            axes.set_title(f"({letters})", loc=alignment, ha="right", **look)  # left of other text above the axes


def finish(figure: Figure, lettered: Iterable[Axes], grid: Any, legend_columns: int) -> None:
    """Finish a grid of panels over time: letters, time labels, aligned labels, and the legend above it."""
    letter_panels(lettered)
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0], legend_columns)


def legend_above(figure: Figure, axes: Axes, columns: int = 8) -> None:
    """Put a legend above a figure, with every name of all axes once, those of `axes` first."""
    handles_by_name: dict[str, Any] = {}
    for each in (axes, *figure.axes):
        for handle, name in zip(*each.get_legend_handles_labels(), strict=True):
            handles_by_name.setdefault(name, handle)
    if handles_by_name:
        longest = (ENTRY_EMS + LETTER_EMS * max(map(len, handles_by_name))) * PAPER_PT / 72  # inches
        columns = min(columns, max(1, int(figure.get_size_inches()[0] / longest)), len(handles_by_name))
        look: Any = {"frameon": False, "fontsize": PAPER_PT, "columnspacing": 1.2, "handlelength": 1.6}
        figure.legend(
            list(handles_by_name.values()), list(handles_by_name), loc="outside upper center", ncols=columns, **look
        )


def mark_figure(figure: Figure, heading: str, reason: str, colour: str) -> None:
    """Write a warning about the flight above a complete figure, which grows by the warning's height.

    `heading` is the first line; `reason` is wrapped below it, and cut off after MARK_LINES lines.
    """
    width_in, height_in = figure.get_size_inches()
    letters = int(72 * width_in / (MARK_EMS * PAPER_PT))
    lines = [heading, *wrap(reason, letters, max_lines=MARK_LINES, placeholder=" …")]
    total_in = height_in + len(lines) * LINE_EMS * PAPER_PT / 72 + MARK_PAD_IN
    mark = figure.suptitle("\n".join(lines), va="top", color=colour, fontsize=PAPER_PT, fontweight="bold")
    mark.set_y(1 - MARK_PAD_IN / total_in)
    mark.set_in_layout(False)  # matplotlib would place it over a legend above the axes
    figure.set_size_inches(width_in, total_in)
    top, room_px = height_in / total_in, 0.0  # the axes and the legends above them are below this height
    for legend, box in [(legend, legend.get_window_extent()) for legend in figure.legends]:
        if box.y0 > figure.bbox.height / 2:  # a legend above the axes
            room_px = max(room_px, box.height + figure.dpi * PAPER_PT / 72)
            legend.set_bbox_to_anchor((0.0, 0.0, 1.0, top), figure.transFigure)
    if isinstance(engine := figure.get_layout_engine(), ConstrainedLayoutEngine):  # the engine ignores anchored legends
        engine.set(rect=(0.0, 0.0, 1.0, top - room_px / figure.bbox.height))


# Time marks

FAULT, TAKE_OVER = "fault", "taken over"
COLOURS = {"assembly": SKY, "held": ORANGE, "landing": GREEN, FAULT: VERMILION, TAKE_OVER: PURPLE}
ALPHA = 0.22
SHORT, HAIRLINE_PT = 0.005, 0.8  # bands shorter than this share of the axis also get a line of this width
WINDOW = "window of the statistics"
WINDOW_GREY = "#e7ebf0"  # lighter than the grid lines
ASSEMBLY = {"taking_off": "assembly", "assembling": "assembly"}


class Band(Struct, frozen=True):
    """An interval of simulated time."""

    kind: str
    from_s: float
    to_s: float


class TimeMarks(Struct, frozen=True):
    """Marks on the time axes of a flight [s]; None for events that did not occur."""

    takeoff_s: float | None = None  # take-off of the first drone
    engaged_s: float | None = None  # engagement of the formation
    bands: tuple[Band, ...] = ()  # phases, faults and take-overs
    span_s: tuple[float, float] | None = None  # the whole run, which every time axis shows; None: the range of the data

    def has(self, kind: str) -> bool:
        return any(band.kind == kind for band in self.bands)


def time_marks(flight: RecordedFlight, formation: Formation | None = None) -> TimeMarks:
    """Return the marks of a flight, with the phases and the engagement of a formation."""
    bands = [*_faults(flight), *_take_overs(flight)]
    if formation and formation.phases:  # phases except idle and engaged
        phases = np.array(formation.phases)
        starts = np.flatnonzero(np.r_[True, phases[1:] != phases[:-1]])
        ends = np.r_[formation.t_s[starts[1:]], formation.t_s[-1]]
        for start, end_s in zip(starts, ends, strict=True):
            kind = ASSEMBLY.get(str(phases[start]), str(phases[start]))
            if kind in COLOURS:
                bands.append(Band(kind, float(formation.t_s[start]), float(end_s)))
    climbing = [track for track in flight.tracks if "taking_off" in track.states]
    takeoffs_s = [track.status_t_ns[track.states.index("taking_off")] / 1e9 for track in climbing]
    start_s = flight.first_ns / 1e9 if flight.replay_of else 0.0  # a replay may begin at any time
    engaged_s = formation.engaged_s if formation else None
    kinds = list(dict.fromkeys(band.kind for band in bands))
    merged: list[Band] = []  # overlapping or adjacent bands of a kind, e.g. of several drones, are merged
    for band in sorted(bands, key=lambda band: (kinds.index(band.kind), band.from_s)):
        if merged and merged[-1].kind == band.kind and band.from_s <= merged[-1].to_s:
            merged[-1] = Band(band.kind, merged[-1].from_s, max(merged[-1].to_s, band.to_s))
        else:
            merged.append(band)
    return TimeMarks(min(takeoffs_s, default=None), engaged_s, tuple(merged), (start_s, flight.last_ns / 1e9))


def _faults(flight: RecordedFlight) -> Iterator[Band]:
    """Yield the injected faults; those without an end last to the flight's end, kills until the process is back."""
    ends = {event.data.get("id"): event.t_ns for event in flight.events if event.kind in ("fault_end", "fault_clear")}
    for index, event in enumerate(flight.events):
        if event.kind == "fault":
            end_ns = ends.get(event.data.get("id"))
            if end_ns is None and event.data.get("kind") == PROCESS_KILL:  # until the process takes part again
                later = (each for each in flight.events[index + 1 :] if each.subject == event.subject)
                if back := next((each for each in later if each.kind in ADMISSIONS), None):
                    done_ns = back.data.get("done_ns", back.t_ns)  # last gate that its predecessor completed
                    is_known = isinstance(done_ns, int)
                    end_ns = max(event.t_ns, min(back.t_ns, done_ns)) if is_known else back.t_ns
            yield Band(FAULT, event.t_ns / 1e9, (flight.last_ns if end_ns is None else end_ns) / 1e9)


def _take_overs(flight: RecordedFlight) -> Iterator[Band]:
    """Yield the flights of drones by processes other than the scenario's agents, from acquisition or first command."""
    since_ns: dict[str, int] = {}
    planned = {"controller", PILOT, *(flight.scenario.own_agents if flight.scenario else ())}
    for event in flight.events:
        op, drone, args = event.kind, event.subject, event.data.get("args")
        if event.kind == "control" and event.data.get("ok") is True and isinstance(args, dict):
            op, drone = event.subject, args.get("drone")
        if op not in ("commander", "acquire", "release") or not isinstance(drone, str):
            continue
        commander = "" if op == "release" else event.source
        if commander and commander.partition(".")[0] not in planned:
            since_ns.setdefault(drone, event.t_ns)
        elif (begun_ns := since_ns.pop(drone, None)) is not None:
            yield Band(TAKE_OVER, begun_ns / 1e9, event.t_ns / 1e9)
    for begun_ns in since_ns.values():
        yield Band(TAKE_OVER, begun_ns / 1e9, flight.last_ns / 1e9)


def draw_marks(axes: Iterable[Axes], marks: TimeMarks, extend: bool = True) -> None:
    """Draw marks on time axes that already contain their data; with `extend`, extend the axes to the whole run."""
    for each in axes:
        if extend and marks.span_s:
            each.update_datalim([(t_s, 0.0) for t_s in marks.span_s], updatey=False)
            each.autoscale_view(scaley=False)
        low, high = each.dataLim.intervalx
        for band in marks.bands:
            start, end, colour = max(band.from_s, low), min(band.to_s, high), COLOURS[band.kind]
            if start < end:
                each.axvspan(start, end, color=colour, alpha=ALPHA, lw=0, zorder=0.5, label=band.kind)
                if end - start < SHORT * (high - low):
                    each.axvline((start + end) / 2, color=colour, lw=HAIRLINE_PT, zorder=0.6)
        for name, t_s, dashes in (("take-off", marks.takeoff_s, ":"), ("engagement", marks.engaged_s, "-.")):
            if t_s is not None and low <= t_s <= high:
                each.axvline(t_s, color=DARK, lw=1.0, ls=dashes, zorder=1.5, label=name)


def shade_window(axes: Axes, window_s: tuple[float, float]) -> None:
    axes.axvspan(*window_s, color=WINDOW_GREY, lw=0, zorder=0, label=WINDOW)
