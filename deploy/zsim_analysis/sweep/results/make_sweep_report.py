"""Makes the report of a sweep: table in, summary, figures and page out."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.table import Table

from zsim.errors import ReportError
from zsim_analysis.report import report_folder
from zsim_analysis.sweep.results.points import Results, SweepSummary
from zsim_analysis.sweep.results.sweep_figures import figures
from zsim_analysis.sweep.results.sweep_page import OVERVIEW, overview, page
from zsim_analysis.sweep.sweep_folder import load

SHOWN_MAX = 40  # points on a terminal


def make_sweep_report(directory: Path, progress: Callable[[str], None] = lambda _: None) -> SweepSummary:
    """Read the finished runs, write DIR/summary.json, DIR/figures/*.png and DIR/report.html; it may fly meanwhile.

    Args:
        directory: of the sweep.
        progress: told in words what is being done.

    Raises:
        RunError: it holds no sweep.
        ReportError: no run is finished yet, or the directory cannot be written.
    """
    sweep = load(directory)
    rows = sweep.rows()
    if not rows:
        raise ReportError(f"{directory}: no run of this sweep is finished yet; there is nothing to report")
    results = Results(sweep.design, rows)
    summary = results.summary()
    report_folder.write(directory, summary.json(), figures(results), partial(page, summary), progress)
    return summary


def table(summary: SweepSummary) -> Table:
    """Return the table of all points, for the terminal."""
    caption = f"± and [ ]: {100 * summary.level:g} % confidence intervals"
    shown = Table(title=f"{summary.scenario}: {summary.finished} of {summary.runs} runs", caption=caption)
    shown.add_column(summary.grid)
    for column in OVERVIEW:
        shown.add_column(column, justify="right")
    for point in summary.flown[:SHOWN_MAX]:
        shown.add_row(point.label, *overview(point))
    if len(summary.flown) > SHOWN_MAX:
        shown.add_row(f"… and {len(summary.flown) - SHOWN_MAX} more")
    return shown
