"""Draws the figures of `zsim_analysis.board.papers`, and writes them with the table of numbers into a folder."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from zsim.errors import ReportError
from zsim.presentation import Column, FittedTable
from zsim_analysis.board.papers import FLOCK, STARTS, FlockTrack, Line, R, bearing_flight, free_flock, lines
from zsim_analysis.report.figure_style import (
    BLUE,
    DARK,
    GREY,
    PAGE_IN,
    PAPER_PT,
    VERMILION,
    ReportFigure,
    dress,
    label_time,
    legend_above,
    letter_panels,
    new_figure,
)


def write_papers(out: Path, progress: Callable[[str], None]) -> list[Line]:
    """Write papers.md, flocking.png and bearings.png into a folder; return the numbers.

    Raises:
        ReportError: it cannot be written.
    """
    found = list(lines(progress))
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "papers.md").write_text(markdown(found), encoding="utf-8")
        for figure in figures(progress):
            (out / figure.name).write_bytes(figure.png())
    except OSError as error:
        raise ReportError(f"{out}: cannot be written ({error.strerror}); give --out another folder") from error
    return found


def cells(line: Line) -> list[str]:
    found = f"{line.found:.4g}" if line.found > 1e-4 else f"{line.found:.0e}"
    return [line.paper, line.what, f"{line.expected:.4g}", found]


def markdown(found: Sequence[Line]) -> str:
    rows = (f"| {' | '.join(cells(line))} |\n" for line in found)
    return f"| paper | | expected | here |\n|---|---|--:|--:|\n{''.join(rows)}"


def terminal_table(found: Sequence[Line]) -> FittedTable:
    columns = [Column("paper", "text"), Column("", "text"), Column("expected", right=True), Column("here", right=True)]
    return FittedTable(columns, [cells(line) for line in found])


def figures(progress: Callable[[str], None] = lambda _: None) -> Iterator[ReportFigure]:
    progress("drawing the flock …")
    yield _flocking(free_flock(), free_flock(with_aim=False))
    progress("drawing figures by bearings …")
    yield _bearings()


def _flocking(led: FlockTrack, free: FlockTrack) -> ReportFigure:
    figure = new_figure(PAGE_IN, 4.6)
    panels = figure.subplots(2, 3)
    named = {"with the group's aim (algorithm 2)": (led, BLUE), "without it (algorithm 1)": (free, VERMILION)}
    measures = (("relative connectivity", "connectivity"), ("deviation energy / d²", "energy"),
                ("velocity mismatch (m/s)", "mismatch"))  # fmt: skip
    for axes, (title, name) in zip(panels[0], measures, strict=True):
        for label, (track, colour) in named.items():
            axes.plot(track.t_s, getattr(track, name), color=colour, lw=1.0, label=label)
        dress(axes, title)
        axes.set_ylim(bottom=0.0)
    label_time(panels[0])
    for axes, (label, (track, colour)) in zip(panels[1], named.items(), strict=False):
        p = track.p
        z = np.linalg.norm(p[:, None] - p[None], axis=2)
        for i, j in zip(*np.nonzero(np.triu(z < R, 1)), strict=True):
            axes.plot(*p[[i, j]].T, color=GREY, lw=0.4, zorder=1)
        axes.plot(*p.T, "o", color=colour, ms=1.6, zorder=2)
        dress(axes)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x (m)", fontsize=PAPER_PT)
        axes.set_title(f"{label.partition(' (')[0]}, {track.t_s[-1]:.0f} s", fontsize=PAPER_PT, color=DARK)
    panels[1, 2].set_visible(False)
    letter_panels([*panels[0], *panels[1, :2]])
    legend_above(figure, panels[0, 0])
    caption = f"{FLOCK} agents, d = 7 m, r = 1.2 d, from starts of 50 m standard deviation."
    return ReportFigure("flocking.png", "Flocking in free space, after Olfati-Saber 2006", caption, figure)


def _bearings() -> ReportFigure:
    figure = new_figure(PAGE_IN, 2.4)
    panels = figure.subplots(1, 2)
    for seed in range(1, STARTS + 1):
        track = bearing_flight(seed)
        panels[0].semilogy(track.t_s, track.error, color=BLUE, lw=0.7)
        panels[1].semilogy(track.t_s, track.distance, color=BLUE, lw=0.7)
    dress(panels[0], "sum of |g − g*|")
    dress(panels[1], "|p − p*| (m)")
    label_time(panels)
    letter_panels(panels)
    caption = f"A pentagon with two diagonals, from {STARTS} random starts."
    return ReportFigure("bearings.png", "Formation by bearings alone, after Zhao and Zelazo 2016", caption, figure)
