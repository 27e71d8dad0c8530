"""How well the drones are estimated: error with its band and NEES, a column for each of few, a summary of many."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import chdtri

from zsim_analysis.reading.drone_errors import DEGREES, POSITION, SIGMAS, EstimateErrors
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.report.figures.spread import draw_spread
from zsim_analysis.report.figures.time_marks import TimeMarks, draw_marks
from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    PAGE_IN,
    PAPER_PT,
    dress,
    label_time,
    legend_above,
    letter_panels,
    line,
    new_figure,
    thinned,
)

EACH_MAX = 4  # drones with a column of their own on a page
QUANTITIES = ("x (m)", "y (m)", "z (m)", "yaw (rad)")
INSIDE = 0.9545  # share of a normal error within SIGMAS standard deviations
SMALL_PT, NOTE_PAD_PT = PAPER_PT - 1.5, 2.0  # of a figure of merit above its axes
CONSISTENT = "95 % of χ²"  # the range of NEES that nineteen of twenty have whose covariance is true
BAND_GREY = "#9aa5b1"  # of no time mark's colour
CHI_BAND: dict[str, Any] = {"fc": "none", "ec": BAND_GREY, "hatch": "////", "lw": 0.0}
FLOOR = 0.1  # of NEES on its axis, which is logarithmic


def draw_estimates(
    errors: Mapping[str, EstimateErrors], colours: Mapping[str, str], window_s: tuple[float, float], marks: TimeMarks
) -> Figure:
    """Return estimate − truth with its band and NEES of every drone, or of many their spread."""
    if len(errors) > EACH_MAX:
        return _draw_many(errors, colours, window_s, marks)
    figure = new_figure(PAGE_IN, 0.8 + 0.95 * (len(QUANTITIES) + 1))
    grid = figure.subplots(len(QUANTITIES) + 1, len(errors), squeeze=False, sharex=True, sharey="row")
    for (name, each), column in zip(errors.items(), grid.T, strict=True):
        column[0].set_title(name, loc="left", fontsize=PAPER_PT)
        _draw_drone(column, each, colours[name], _rows(each, window_s))
        draw_marks(column, marks)
    _share_ranges(grid, errors.values(), marks.engaged_s)
    for axes, quantity in zip(grid[:, 0], (*QUANTITIES, "NEES"), strict=True):
        axes.set_ylabel(quantity, fontsize=PAPER_PT)
    letter_panels(grid[0])
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0], columns=7)
    return figure


def _rows(errors: EstimateErrors, window_s: tuple[float, float]) -> np.ndarray:
    """Return which instants are within the window; all where none is."""
    rows = (errors.t_s >= window_s[0]) & (errors.t_s <= window_s[1])
    return rows if rows.any() else np.ones(len(rows), bool)


def _draw_drone(column: Sequence[Axes], errors: EstimateErrors, colour: str, rows: np.ndarray) -> None:
    inside = errors.share_inside(rows)
    for i, axes in enumerate(column[:-1]):
        dress(axes)
        draw_band(axes, errors.t_s, SIGMAS * errors.sigma[:, i])
        line(
            axes,
            errors.t_s,
            errors.error[:, i],
            color=colour,
            lw=0.6,
            zorder=3,
            label="estimate − truth",
        )
        _note(axes, f"{100 * inside[i]:.0f} % in {SIGMAS:g}σ")
    _draw_nees(column[-1], errors.t_s, errors.nees, colour)
    known = errors.nees[rows][np.isfinite(errors.nees[rows])]
    _note(column[-1], f"mean {known.mean():.3g}, of {DEGREES}" if len(known) else "P is singular")


def draw_band(axes: Axes, t_s: Array, half: Array) -> None:
    """Draw a band of a half width around zero."""
    at, width = thinned(t_s, half)
    axes.fill_between(at, -width, width, color=BAND_GREY, alpha=0.45, lw=0, zorder=1, label=f"±{SIGMAS:g}σ as stated")
    axes.axhline(0, color=BLACK, lw=0.5, zorder=1)


def _note(axes: Axes, text: str) -> None:
    """Write a figure of merit above axes, where it covers no curve."""
    axes.set_title(text, loc="right", fontsize=SMALL_PT, pad=NOTE_PAD_PT)


def _draw_nees(axes: Axes, t_s: Array, nees: Array, colour: str, of: int = 1) -> None:
    """Draw NEES, or its mean over `of` drones, with the range of nineteen of twenty consistent ones."""
    dress(axes)
    low, high = (float(chdtri(of * DEGREES, share)) / of for share in (0.975, 0.025))
    axes.axhspan(low, high, zorder=0.6, label=CONSISTENT, **CHI_BAND)
    line(axes, t_s, np.maximum(nees, FLOOR), color=colour, lw=0.6, zorder=3)
    axes.set_yscale("log")
    axes.tick_params(which="both", labelsize=PAPER_PT - 1)


def _share_ranges(grid: Any, errors: Any, engaged_s: float | None) -> None:
    """Give each row the range of all errors and bands since the engagement: the start's large sigmas leave it."""
    for i, row in enumerate(grid[:-1]):
        reach = 0.0
        for each in errors:
            rows = each.t_s >= (-np.inf if engaged_s is None else engaged_s)
            seen = np.maximum(np.abs(each.error[rows, i]), SIGMAS * each.sigma[rows, i])
            reach = max(reach, float(np.nanmax(seen, initial=0.0)))
        if reach > 0:
            row[0].set_ylim(-1.05 * reach, 1.05 * reach)


def _draw_many(
    errors: Mapping[str, EstimateErrors], colours: Mapping[str, str], window_s: tuple[float, float], marks: TimeMarks
) -> Figure:
    """Return position error and mean NEES over time, and the figures of each drone within the window."""
    figure = new_figure(PAGE_IN, 3.6)
    grid = figure.subplots(2, 2, width_ratios=(1.3, 1), sharex="col")
    t_s, distance, nees = _together(errors)
    dress(grid[0, 0], "position error (m)")
    draw_spread(grid[0, 0], t_s, distance, BLUE)
    judged = t_s >= (marks.engaged_s or 0.0)  # before it, the start's noise would set the scale
    grid[0, 0].set_ylim(0.0, 1.1 * float(np.max(distance[judged], initial=0.0)) or None)
    _draw_nees(grid[1, 0], t_s, nees.mean(axis=1), BLUE, of=len(errors))
    grid[1, 0].set_yscale("linear")
    grid[1, 0].set_ylabel(f"NEES, mean of {len(errors)}", fontsize=PAPER_PT)
    draw_marks(grid[:, 0], marks)
    label_time(grid[1:, 0])
    _draw_each(grid[:, 1], errors, colours, window_s)
    letter_panels(list(grid.flat))
    figure.align_ylabels()
    legend_above(figure, grid[0, 0], columns=6)
    return figure


def _together(errors: Mapping[str, EstimateErrors]) -> tuple[Array, Array, Array]:
    """Return the instants that all drones have, and their position errors [m] and NEES there, (K, N) each."""
    t_s = reduce(np.intersect1d, (each.t_s for each in errors.values()))
    places = [np.searchsorted(each.t_s, t_s) for each in errors.values()]
    pairs = list(zip(errors.values(), places, strict=True))
    distance = [np.linalg.norm(each.error[place][:, POSITION], axis=1) for each, place in pairs]
    return t_s, np.column_stack(distance), np.column_stack([each.nees[place] for each, place in pairs])


def _draw_each(
    panels: Sequence[Axes],
    errors: Mapping[str, EstimateErrors],
    colours: Mapping[str, str],
    window_s: tuple[float, float],
) -> None:
    """Draw RMS position error, true and stated, and the share within SIGMAS of every drone."""
    numbers, tints = np.arange(1, len(errors) + 1), [colours[name] for name in errors]
    rms, stated, inside = np.array([_figures(each, _rows(each, window_s)) for each in errors.values()]).T
    dress(panels[0], "RMS (m)")
    panels[0].scatter(numbers, rms, c=tints, s=14, zorder=3, clip_on=False)
    panels[0].plot(numbers, stated, "_", color=BLACK, ms=5, zorder=2, label="σ as stated", clip_on=False)
    panels[0].set_ylim(bottom=0)
    panels[0].set_title("each drone, within the window", fontsize=PAPER_PT)
    dress(panels[1], f"x, y, z in {SIGMAS:g}σ (%)")
    panels[1].scatter(numbers, 100 * inside, c=tints, s=14, zorder=3, clip_on=False)
    panels[1].axhline(100 * INSIDE, color=BLACK, lw=0.7, ls="--", label=f"share of a normal error in {SIGMAS:g}σ")
    panels[1].set_ylim(top=101)
    panels[1].set_xlabel("drone, in the order of the scenario", fontsize=PAPER_PT)


def _figures(errors: EstimateErrors, rows: np.ndarray) -> tuple[float, float, float]:
    """Return RMS position error [m], the one stated [m], and the mean share of x, y and z within SIGMAS."""
    rms = np.sqrt(np.mean(np.sum(errors.error[rows][:, POSITION] ** 2, axis=1)))
    stated = np.sqrt(np.mean(np.sum(errors.sigma[rows][:, POSITION] ** 2, axis=1)))
    return float(rms), float(stated), float(errors.share_inside(rows)[list(POSITION)].mean())
