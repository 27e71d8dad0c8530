"""Makes a report: record in, summary, figures and page out."""

from collections.abc import Callable
from pathlib import Path

from zsim.errors import RecordError, ReportError
from zsim_deploy.report.figures import figures
from zsim_deploy.report.flight import Flight
from zsim_deploy.report.formation import Formation, formation
from zsim_deploy.report.page import page
from zsim_deploy.report.reading import read_flight
from zsim_deploy.report.summary import Summary, summarise

RECORD = "run.mcap"


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
    formations = [found for states in flight.clusters if (found := formation(states, flight.tracks))]
    return flight, formations, summarise(flight, formations, record)


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
    try:
        _write(directory / "summary.json", summary.json())
        (directory / "figures").mkdir(exist_ok=True)
        shown = []
        for figure in figures(flight, formations, summary.window_s):
            progress(f"drawing {figure.name}")
            figure.drawing.savefig(directory / "figures" / figure.name)
            shown.append(figure)
        progress("writing the page")
        _write(directory / "report.html", page(summary, shown, directory / "figures").encode())
    except OSError as error:
        raise ReportError(f"{directory}: the report cannot be written ({error.strerror})") from error
    return summary


def _write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: a full disk leaves no half of it, nor harms a former one."""
    new = path.with_name(f".{path.name}.new")
    try:
        new.write_bytes(content)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
