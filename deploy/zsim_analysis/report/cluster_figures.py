"""The paper's figures of a cluster: errors (5), position (6), orientation (7) and shape (8)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.flight import Array
from zsim_analysis.reading.formation import Formation
from zsim_analysis.report.canvas import DESIRED, MEASURED, TRUE, dress, label_time, legend_above, line, new_figure

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
ROWS_MAX = 24  # parameters in one figure; 6 drones
SYMBOLS = {
    "x_c": "$x_c$",
    "y_c": "$y_c$",
    "z_c": "$z_c$",
    "roll": "roll",
    "pitch": "pitch",
    "yaw": "yaw",
    "p": "$p$",
    "q": "$q$",
    "beta": "$\\beta$",
}
GREEK = {"phi": "\\phi", "rho": "\\rho"}


def label(name: str) -> str:
    """Return the label of a parameter at an axis, with its unit."""
    stem, _, number = name.partition("_")
    greek = f"${GREEK[stem]}_{{{number}}}$" if stem in GREEK else name
    return f"{SYMBOLS.get(name, greek)} ({unit(name)})"


def draw_errors(formation: Formation, window_s: tuple[float, float]) -> Figure:
    """Return Figure 5: a row per parameter, the whole run on the left, the window on the right."""
    names = formation.names[:ROWS_MAX]
    figure = new_figure(12, 1.0 + 1.15 * len(names))
    grid = figure.subplots(len(names), 2, squeeze=False, sharex="col", width_ratios=(1, 1))
    rows = formation.within(window_s)
    for name, (whole, zoom) in zip(names, grid, strict=True):
        draw_error(whole, formation, name, np.ones(len(rows), bool))
        whole.axvspan(*window_s, color="#eef2f6", zorder=0)
        whole.set_ylabel(label(name), fontsize=10)
        draw_error(zoom, formation, name, rows)
        _write_statistics(zoom, formation, name, rows)
    grid[0, 0].set_title("whole run (shaded: window)", fontsize=10)
    grid[0, 1].set_title(f"window, {window_s[0]:g} to {window_s[1]:g} s", fontsize=10)
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0])
    return figure


def draw_error(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Draw the errors of a parameter, estimated and true, at some instants."""
    i = formation.column(name)
    dress(axes)
    axes.axhline(0, color="#000000", lw=0.6, zorder=1)
    line(axes, formation.t_s[rows], formation.true_error[rows, i], label="truth − desired", **TRUE)
    line(axes, formation.t_s[rows], formation.est_error[rows, i], label="estimate − desired", **MEASURED)


def _write_statistics(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Write standard deviations beside the axes, in the colours of their lines."""
    i = formation.column(name)
    for y, error, style in ((0.68, formation.est_error, MEASURED), (0.32, formation.true_error, TRUE)):
        known = error[rows, i][np.isfinite(error[rows, i])]
        text = f"std {known.std():.4f}\nmean {known.mean():+.4f}" if len(known) else "no data"
        axes.text(1.02, y, text, transform=axes.transAxes, fontsize=8.5, color=_darker(style["color"]), va="center")


def _darker(colour: str) -> str:
    """Return a colour that can be read as small print on white."""
    return {"#e69f00": "#9a6a00"}.get(colour, colour)


def draw_parameters(formation: Formation, names: Sequence[str], title: str) -> Figure:
    """Return Figure 6, 7 or 8: desired, measured and true values of some parameters over the run."""
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(11, 1.2 + 2.1 * max(1, len(shown)))
    grid = figure.subplots(max(1, len(shown)), 1, squeeze=False, sharex=True)[:, 0]
    for name, axes in zip(shown, grid, strict=False):
        dress(axes, label(name))
        desired, measured, true = curves(formation, name)
        line(axes, formation.t_s, measured, label="measured (estimates)", **MEASURED)
        line(axes, formation.t_s, true, label="true", **TRUE)
        line(axes, formation.t_s, desired, label="desired", **DESIRED)
    label_time(grid[-1:])
    grid[0].set_title(f"{title}, cluster {formation.name}", fontsize=11, loc="left")
    figure.align_ylabels(grid)
    legend_above(figure, grid[0])
    return figure


def curves(formation: Formation, name: str) -> tuple[Array, Array, Array]:
    """Return desired, measured and true values of a parameter; angles without jumps at ±π."""
    i = formation.column(name)
    desired = formation.desired[:, i].copy()
    known = np.isfinite(desired)
    if unit(name) == "rad":
        desired[known] = np.unwrap(desired[known])
    return desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]


def parameter_groups(names: Sequence[str]) -> list[tuple[str, int, str, list[str]]]:
    """Return the paper's figures of parameters over time: file, number, title, and which of the names each shows."""
    shape = [name for name in names if name not in POSITION + ORIENTATION and "phi" not in name]
    return [
        ("figure_6_position", 6, "Position of the formation", [name for name in POSITION if name in names]),
        ("figure_7_orientation", 7, "Orientation of the formation", [name for name in ORIENTATION if name in names]),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ]
