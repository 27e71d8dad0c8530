"""Makes a report: record in, summary, figures and page out."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

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
    try:
        with TemporaryDirectory(dir=directory, prefix=".report-") as new:
            drawn = Path(new) / "figures"
            drawn.mkdir()
            shown = []
            for figure in figures(flight, formations, summary.window_s):
                progress(f"drawing {figure.name}")
                figure.drawing.savefig(drawn / figure.name)
                shown.append(figure)
            progress("writing the page")
            (Path(new) / "summary.json").write_bytes(summary.json())
            (Path(new) / "report.html").write_text(page(summary, shown, drawn), encoding="utf-8")
            put_in_place(Path(new), directory)
    except OSError as error:
        raise ReportError(f"{directory}: the report cannot be written ({error.strerror})") from error
    return summary


def put_in_place(new: Path, directory: Path) -> None:
    """Put a report in its place when all of it is made: a full disk or Ctrl-C leaves no half of one."""
    (directory / "figures").mkdir(exist_ok=True)
    for path in sorted(new.rglob("*.*")):
        path.replace(directory / path.relative_to(new))
