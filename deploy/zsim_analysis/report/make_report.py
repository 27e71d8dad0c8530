"""Makes a report: record in, summary, figures and page out."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from zsim.errors import RecordError
from zsim.record.run_folder import RECORD
from zsim_analysis.reading.flight import Flight
from zsim_analysis.reading.flight_reader import read_flight
from zsim_analysis.reading.formation_variables import Formation, formation
from zsim_analysis.report import report_folder
from zsim_analysis.report.figures.run_figures import figures
from zsim_analysis.report.report_page import page
from zsim_analysis.report.summary import Summary, summarise


def judge(record: Path, progress: Callable[[str], None] = lambda _: None) -> tuple[Flight, list[Formation], Summary]:
    """Return what a record says, and what that amounts to; nothing is written.

    Raises:
        RecordError: there is no record, or no drone moves on it.
    """
    progress("reading the record")
    flight = read_flight(record)
    if all(len(track.t_ns) == 0 for track in flight.tracks):
        damaged = f" ({flight.damaged} of its chunks are damaged)" if flight.damaged else ""
        held = f"holds {flight.messages} messages and no truth" if flight.messages else "holds no message"
        raise RecordError(f"{record}: {held}{damaged}; there is nothing to report")
    progress("computing the formation's errors")
    formations = formations_of(flight)
    return flight, formations, summarise(flight, formations, record)


def formations_of(flight: Flight) -> list[Formation]:
    """Return the clusters of a flight that can be judged."""
    each = (formation(states, flight.tracks, flight.scenario) for states in flight.clusters)
    return [found for found in each if found]


def make_report(directory: Path, progress: Callable[[str], None] = lambda _: None) -> Summary:
    """Read DIR/run.mcap, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    Args:
        directory: the run directory.
        progress: told in words what is being done.

    Raises:
        RecordError: there is no record, or no drone moves on it.
        ReportError: the directory cannot be written.
    """
    flight, formations, summary = judge(directory / RECORD, progress)
    drawings = figures(flight, formations, summary.window_s)
    report_folder.write(directory, summary.json(), drawings, partial(page, summary), progress)
    return summary
